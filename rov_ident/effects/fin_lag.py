"""First-order lag between the angles read of fins and those that they have.

``T d(delta)/dt = read - delta``, solved exactly for a reading that changes in a straight line
during the step. The first reading is taken to have acted for long.
"""

import math

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, EffectParameter


@kernel
def steer(p, state, dt, inputs):
    time_constant, known = p[0], state[0] != 0.0
    state[0] = 1.0
    left = math.exp(-dt / time_constant) if time_constant > 0.0 else 0.0
    for i in range(3):
        mean, end = inputs[0, i], inputs[1, i]
        if known and time_constant > 0.0 and dt > 0.0:
            begin = 2.0 * mean - end
            behind = time_constant * (end - begin) / dt  # in the long run
            off = state[1 + i] - begin + behind
            inputs[0, i] = mean - behind + off * (1.0 - left) * time_constant / dt
            inputs[1, i] = end - behind + off * left
        state[1 + i] = inputs[1, i]


EFFECT = Effect(
    place="input",
    summary="Fins follow the angles that are read with a first-order lag, all with the same.",
    manoeuvre="sharp steps of rudder and stern planes at speed, with fast odometry",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 9.5",
    parameters=(EffectParameter("time_constant", "s", "of the lag", 0.0, 0.0, 3.0, 0.1),),
    steer=steer,
    order=20,
)
