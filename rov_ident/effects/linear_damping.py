"""Skin friction and radiated waves along each axis: what damps slow motion."""

from rov_ident.effects.base import Effect

EFFECT = Effect(
    place="wrench",
    summary="Drag in proportion to the velocity along an axis.",
    traits=("hull",),
    manoeuvre="slow runs and coasting to rest along the axis, beside the fast ones",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 6.4",
    coefficients=("X_u", "Y_v", "Z_w", "K_p", "M_q", "N_r"),
)
