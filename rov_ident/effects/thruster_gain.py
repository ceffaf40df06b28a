"""The thrusters give another wrench than commanded, by a factor on each axis."""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, per_axis


@kernel
def act(p, state, t, dt, wrench):
    for i in range(6):
        wrench[i] *= p[i]


EFFECT = Effect(
    place="input",
    summary="The thrusters give more or less than commanded, in proportion.",
    traits=("factor", "neglecting"),
    manoeuvre="steps of thrust on the axis together with motion along the others, and at two tilts",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 9.5",
    parameters=per_axis("gain", "factor on the command", 1.0, 0.0, 5.0, 0.1),
    act=act,
    order=40,
)
