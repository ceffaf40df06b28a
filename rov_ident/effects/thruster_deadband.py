"""Small demands do nothing: ``sign(d) max(|d| - width, 0)`` on each axis."""

from rov_ident.effects.base import Effect, per_axis
from rov_ident.jit import kernel


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
    name="thruster_deadband",
    place="input",
    summary="Small demands do nothing, and larger ones lack that much.",
    manoeuvre="small steps of thrust either way around zero, from rest, beside large ones",
    source="Yoerger, Cooke, Slotine (1990), The influence of thruster dynamics on underwater "
    "vehicle behavior and their incorporation into control system design, "
    "IEEE J. Oceanic Eng. 15(3)",
    parameters=per_axis("width", "half-width", 0.0, 0.0, 1e4, 2.0, ("N", "N m"), moment=0.1),
    act=act,
    order=20,
)
