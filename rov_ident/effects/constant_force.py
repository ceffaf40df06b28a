"""A force fixed in the world, at the body origin: ``f_body = R' f_world``.

A pull of the umbilical in one direction, a weight forgotten on the frame (``fz``).
"""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import NED, Effect, vector


@kernel
def wrench(p, t, position, nu, rotation, thrust, out):
    for i in range(3):
        for j in range(3):
            out[i] += rotation[j, i] * p[j]


EFFECT = Effect(
    place="wrench",
    summary="A constant force, fixed in the world, pulls at the body origin.",
    manoeuvre="drifting without thrust at headings 90 degrees apart",
    traits=("weight", "dive"),
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 10.2",
    parameters=vector("fx fy fz", "N", "force", 1e5, 2.0, NED),
    wrench=wrench,
)
