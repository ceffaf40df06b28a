"""The battery runs down: one gain on all thrust, falling evenly from 1 to ``1 - end_loss``.

The loss is reached ``duration`` seconds after the first message, and stays.
"""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, EffectParameter


@kernel
def act(p, state, t, dt, wrench):
    duration = p[1]
    if t >= duration:
        elapsed = duration
    elif t + dt <= duration:
        elapsed = t + 0.5 * dt
    else:  # the mean of min(time, duration)
        elapsed = duration - 0.5 * (duration - t) ** 2 / dt
    gain = 1.0 - p[0] * (elapsed / duration)
    for i in range(6):
        wrench[i] *= gain


EFFECT = Effect(
    place="input",
    summary="Thrust fades evenly while the battery runs down.",
    manoeuvre="the same steps of thrust at the beginning, in the middle and at the end",
    source="Blue Robotics, T200 thruster, performance charts: thrust over supply voltage",
    parameters=(
        EffectParameter("end_loss", "1", "share of thrust lost in the end", 0.0, -1.0, 1.0, 0.1),
        EffectParameter("duration", "s", "time until then", 180.0, 1.0, 1e6, 180.0, role="fixed"),
    ),
    act=act,
    order=44,
)
