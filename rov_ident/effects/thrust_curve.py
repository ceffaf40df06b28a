"""Thrust is not in proportion to its command: a bent curve on each axis.

With x = curvature |c| / (50 N or 10 N m), thrust is ``c / (1 + x)`` where it falls short (x > 0)
and ``c (1 - x)`` where it grows faster than the command: equal to first order, and smooth, odd and
rising for any size of either.
"""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import FORCE, MOMENT, Effect, per_axis


@kernel
def act(p, state, t, dt, wrench):
    for i in range(6):
        x = p[i] * abs(wrench[i]) / (FORCE if i < 3 else MOMENT)
        if x > 0.0:
            wrench[i] /= 1.0 + x
        else:
            wrench[i] *= 1.0 - x


EFFECT = Effect(
    place="input",
    summary="Thrust is not in proportion to its command.",
    traits=("neglecting",),
    manoeuvre="steps of thrust along the axis at several levels up to the largest, from rest",
    source="Bessa, Dutra, Kreuzer (2013), Dynamic positioning of underwater robotic vehicles with "
    "thruster dynamics compensation, Int. J. Advanced Robotic Systems 10(9): thrust over command; "
    "Blue Robotics, T200 thruster, performance charts",
    parameters=per_axis("curvature", "share lost at 50 N or 10 N m", 0.0, -5.0, 5.0, 0.2),
    act=act,
    order=44,
)
