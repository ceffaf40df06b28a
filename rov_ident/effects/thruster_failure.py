"""A thruster fails at a time: from then on the demand of each axis is met by a factor only."""

from rov_ident.effects.base import Effect, EffectParameter, per_axis
from rov_ident.jit import kernel


@kernel
def act(p, state, t, dt, wrench):
    onset = p[6]
    if t + dt <= onset and t < onset:
        return
    after = 1.0 if t >= onset else (t + dt - onset) / dt  # share of the step
    for i in range(6):
        wrench[i] *= 1.0 - after * (1.0 - p[i])


EFFECT = Effect(
    name="thruster_failure",
    place="input",
    summary="From a time on, a part of the thrust is missing.",
    lasting=("thruster_gain",),
    manoeuvre="the same steps of thrust on every axis at the beginning and at the end of the bag",
    source="Sarkar, Podder, Antonelli (2002), Fault-accommodating thruster force allocation of an "
    "AUV considering thruster redundancy and saturation, IEEE Trans. Robotics and Automation 18(2)",
    parameters=(
        *per_axis("gain", "factor after the failure, on the demand", 1.0, 0.0, 5.0, 0.2),
        EffectParameter(
            "onset", "s", "when, since the first message", 0.0, 0.0, 1e6, 60.0, role="onset"
        ),
    ),
    act=act,
    order=42,
)
