"""The thrusters give no more than a limit on each axis: ``sign(c) min(|c|, limit)``."""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, per_axis


@kernel
def act(p, state, t, dt, wrench):
    for i in range(6):
        wrench[i] = min(max(wrench[i], -p[i]), p[i])


EFFECT = Effect(
    place="input",
    summary="The thrusters give no more than a limit.",
    manoeuvre="steps of thrust along the axis at several levels up to the largest, from rest",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 9.5",
    parameters=per_axis(
        "limit", "most thrust", 1e5, 0.0, 1e6, 10.0, ("N", "N m"), moment=0.1, role="limit"
    ),
    act=act,
    order=46,
)
