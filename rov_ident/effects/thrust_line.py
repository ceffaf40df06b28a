"""The line of thrust misses the origin: a moment in proportion to the thrust along an axis.

``K += arm_Y_K Y + arm_Z_K Z`` and so on. No frame is built, and no wake leaves a hull, to a
millimetre; at steady speed, where thrust is drag, this turns a vehicle as coupled drag does.
"""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, EffectParameter


@kernel
def wrench(p, t, position, nu, rotation, thrust, out):
    out[3] += p[0] * thrust[1] + p[1] * thrust[2]
    out[4] += p[2] * thrust[0] + p[3] * thrust[2]
    out[5] += p[4] * thrust[0] + p[5] * thrust[1]


EFFECT = Effect(
    place="wrench",
    summary="The line of thrust along an axis misses the origin, so that it turns the vehicle.",
    manoeuvre="steps of thrust along the axis from rest, and coasting without thrust",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 9.5",
    parameters=tuple(
        EffectParameter(
            f"arm_{f}_{m}", "m", f"moment {m} over thrust {f}", 0.0, -0.2, 0.2, 0.01, axis=m
        )
        for m, f in ("KY", "KZ", "MX", "MZ", "NX", "NY")
    ),
    wrench=wrench,
)
