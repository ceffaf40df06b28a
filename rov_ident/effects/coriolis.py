"""Products of velocities beyond those that the mass matrix gives.

Where the added mass in M is not that of the hull at speed (measured in oscillation, or by strip
theory), the Coriolis and Munk terms that follow from it are wrong, too.
"""

from rov_ident.effects.base import Effect

EFFECT = Effect(
    place="wrench",
    summary="Coriolis and Munk terms are not those that the mass matrix gives.",
    manoeuvre="turns, and motion along two axes at once, at several speeds",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 6.3",
    coefficients=(*("X_vr", "X_wq", "Y_ur", "Y_wp", "Z_uq", "Z_vp"), *("K_vw", "M_uw", "N_uv")),
)
