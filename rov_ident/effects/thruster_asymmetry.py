"""Thrusters are weaker (or stronger) astern: a factor on a negative command of each axis."""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, per_axis


@kernel
def act(p, state, t, dt, wrench):
    for i in range(6):
        if wrench[i] < 0.0:
            wrench[i] *= p[i]


EFFECT = Effect(
    place="input",
    summary="The thrusters give another share of a negative command than of a positive one.",
    manoeuvre="quick steps of equal thrust ahead and astern along the axis, from rest",
    source="Yoerger, Cooke, Slotine (1990), The influence of thruster dynamics on underwater "
    "vehicle behavior and their incorporation into control system design, "
    "IEEE J. Oceanic Eng. 15(3)",
    parameters=per_axis("gain", "factor on a negative command", 1.0, 0.0, 5.0, 0.1),
    act=act,
    order=30,
)
