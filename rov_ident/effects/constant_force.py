"""A force fixed in the world, at the body origin: ``f_body = R' f_world``.

A pull of the umbilical in one direction, a weight forgotten on the frame (``fz``).

Source: Fossen (2021), sec. 10.2: slowly varying environmental forces as a bias in the world frame.
"""

from rov_ident.effects.base import Effect, EffectParameter
from rov_ident.jit import kernel


@kernel
def wrench(p, t, nu, rotation, out):
    for i in range(3):
        for j in range(3):
            out[i] += rotation[j, i] * p[j]


EFFECT = Effect(
    name="constant_force",
    place="wrench",
    summary="A constant force, fixed in the world, pulls at the body origin.",
    manoeuvre="drifting without thrust at headings 90 degrees apart",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 10.2",
    parameters=(
        EffectParameter("fx", "N", "force north", 0.0, -1e5, 1e5, 2.0),
        EffectParameter("fy", "N", "force east", 0.0, -1e5, 1e5, 2.0),
        EffectParameter("fz", "N", "force down", 0.0, -1e5, 1e5, 2.0),
    ),
    wrench=wrench,
)
