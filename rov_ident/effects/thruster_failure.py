"""A thruster fails at a time: from then on each axis gives only a share of its command."""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import ONSET, Effect, per_axis


@kernel
def act(p, state, t, dt, wrench):
    onset = p[6]
    if t + dt <= onset and t < onset:
        return
    after = 1.0 if t >= onset else (t + dt - onset) / dt  # share of the step
    for i in range(6):
        wrench[i] *= 1.0 - after * (1.0 - p[i])


EFFECT = Effect(
    place="input",
    summary="From a time on, a part of the thrust is missing.",
    lasting=("thruster_gain",),
    traits=("neglecting",),
    manoeuvre="the same steps of thrust on every axis at the beginning and at the end of the bag",
    source="Sarkar, Podder, Antonelli (2002), Fault-accommodating thruster force allocation of an "
    "AUV considering thruster redundancy and saturation, IEEE Trans. Robotics and Automation 18(2)",
    parameters=(
        *per_axis("gain", "factor after the failure, on the command", 1.0, 0.0, 5.0, 0.2),
        ONSET,
    ),
    act=act,
    order=42,
)
