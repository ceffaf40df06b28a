"""Small commands do nothing: ``sign(c) max(|c| - width, 0)`` on each axis."""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, per_axis


@kernel
def act(p, state, t, dt, wrench):
    for i in range(6):
        if wrench[i] > p[i]:
            wrench[i] -= p[i]
        elif wrench[i] < -p[i]:
            wrench[i] += p[i]
        else:
            wrench[i] = 0.0


EFFECT = Effect(
    place="input",
    summary="Small commands do nothing, and larger ones lack that much.",
    traits=("neglecting",),
    manoeuvre="small steps of thrust either way around zero, from rest, beside large ones",
    source="Yoerger, Cooke, Slotine (1990), The influence of thruster dynamics on underwater "
    "vehicle behavior and their incorporation into control system design, "
    "IEEE J. Oceanic Eng. 15(3)",
    parameters=per_axis("width", "half-width", 0.0, 0.0, 1e4, 2.0, ("N", "N m"), moment=0.1),
    act=act,
    order=20,
)
