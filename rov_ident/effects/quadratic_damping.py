"""Form drag along each axis: ``|b| b``. It rules a vehicle of bluff shape from 0.1 m/s upwards."""

from rov_ident.effects.base import Effect

EFFECT = Effect(
    place="wrench",
    summary="Drag grows with the square of the velocity along an axis.",
    traits=("hull",),
    manoeuvre="steady runs along the axis at two speeds at least, the higher twice the lower",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 6.4",
    coefficients=("X_uu", "Y_vv", "Z_ww", "K_pp", "M_qq", "N_rr"),
)
