"""First-order lag between the commanded and the acting wrench.

``T d(acting)/dt = command - acting``, solved exactly for a command held during the step. The mean
over the step is returned, so that the impulse is right however long the step is. The first command
is taken to have acted for long.
"""

import math

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, EffectParameter


@kernel
def act(p, state, t, dt, wrench):
    time_constant = p[0]
    if state[0] == 0.0:
        state[0] = 1.0
        state[1:7] = wrench
    if time_constant <= 0.0:
        state[1:7] = wrench
        return
    approach = -math.expm1(-dt / time_constant)
    share = approach * time_constant / dt if dt > 0.0 else 1.0
    for i in range(6):
        before = state[1 + i]
        state[1 + i] += (wrench[i] - before) * approach
        wrench[i] += (before - wrench[i]) * share


EFFECT = Effect(
    place="input",
    summary="The thrusters follow their command with a first-order lag, the same on every axis.",
    traits=("late",),
    manoeuvre="sharp steps of thrust from rest, one axis at a time, with fast odometry",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 9.5",
    parameters=(EffectParameter("time_constant", "s", "of the lag", 0.0, 0.0, 3.0, 0.1),),
    act=act,
    order=50,
)
