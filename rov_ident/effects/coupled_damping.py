"""Linear damping across axes, as far as port/starboard symmetry lets it be.

A hull that is not the same fore and aft, or above and below, couples sway, roll and yaw with each
other, and surge, heave and pitch; nothing couples the two groups.
"""

from rov_ident.effects.base import Effect

EFFECT = Effect(
    place="wrench",
    summary="Motion along one axis drags along another: the hull is not symmetric.",
    manoeuvre="steady motion along one axis at a time, both ways, the others free",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 6.4",
    coefficients=(
        *("Y_r", "N_v", "Y_p", "K_v", "K_r", "N_p"),
        *("X_q", "M_u", "Z_q", "M_w", "X_w", "Z_u"),
    ),
)
