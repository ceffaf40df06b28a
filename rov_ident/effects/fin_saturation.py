"""Fins turn no further than a limit, and no faster than a rate.

``|delta| <= limit`` and ``|d(delta)/dt| <= rate``: a fin that is behind turns at its rate until it
is where the reading, limited, has got to; the reading changes in a straight line during a step.
"""

import math

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, EffectParameter, per_fin

_NO_RATE = 1e3  # rad/s; then the reading's course within a step is taken as it is


@kernel
def steer(p, state, dt, inputs):
    known, rate = state[0] != 0.0, p[3]
    state[0] = 1.0
    for i in range(3):
        begin = min(max(2.0 * inputs[0, i] - inputs[1, i], -p[i]), p[i])
        for k in range(2):
            inputs[k, i] = min(max(inputs[k, i], -p[i]), p[i])
        end, before = inputs[1, i], state[1 + i]
        if known and dt > 0.0 and rate < _NO_RATE:
            slope, behind = (end - begin) / dt, begin - before
            turn = math.copysign(rate, behind)
            closing = rate - slope * math.copysign(1.0, behind)
            late = min(abs(behind) / closing, dt) if closing > 0.0 else dt
            late = 0.0 if abs(behind) < 1e-12 else late  # rad: rounding
            then, left = min(max(slope, -rate), rate), dt - late
            if late > 0.0 or then != slope:
                met = before + turn * late
                total = 0.5 * (before + met) * late + (met + 0.5 * then * left) * left
                inputs[0, i] = total / dt
                if left == 0.0 or then != slope:
                    inputs[1, i] = met + then * left
        state[1 + i] = inputs[1, i]


EFFECT = Effect(
    place="input",
    summary="Fins turn no further than a limit, and no faster than a rate.",
    manoeuvre="zigzags with several angles up to the largest, and fast steps between them",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 9.5",
    parameters=(
        *per_fin("largest", 10.0, 0.0, 10.0, 0.2, role="limit"),
        EffectParameter("rate", "rad/s", "largest", _NO_RATE, 0.01, _NO_RATE, 0.5, role="limit"),
    ),
    steer=steer,
    order=10,
)
