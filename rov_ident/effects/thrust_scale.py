"""The thrusters give another share of the commanded wrench, the same on every axis."""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, EffectParameter


@kernel
def act(p, state, t, dt, wrench):
    for i in range(6):
        wrench[i] *= p[0]


EFFECT = Effect(
    place="input",
    summary="All thrusters give more or less than commanded, by one factor; or mass and inertia "
    "are off by its inverse.",
    within="thruster_gain",
    traits=("likely", "factor", "neglecting"),
    manoeuvre="steps of thrust together with motion along the other axes, and at two tilts",
    source="Blue Robotics, T200 thruster, performance charts: thrust over supply voltage",
    parameters=(EffectParameter("scale", "1", "acting over commanded", 1.0, 0.0, 5.0, 0.1),),
    act=act,
    order=38,
)
