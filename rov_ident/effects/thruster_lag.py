"""First-order lag between the demanded and the acting wrench.

``T d(acting)/dt = demand - acting``, solved exactly for a demand held during the step. The mean
over the step is returned, so that the impulse is right however long the step is.

Source: Fossen (2021), sec. 9.5: thruster dynamics as a first-order system.
"""

import math

from rov_ident.effects.base import Array, Effect, EffectParameter


def start(wrench: Array) -> Array:
    """In equilibrium with the first demand."""
    return wrench.copy()


def step(state: Array, wrench: Array, dt: float, time_constant: float) -> tuple[Array, Array]:
    if time_constant <= 0.0:
        return wrench, wrench
    if dt <= 0.0:
        return state, state
    approach = -math.expm1(-dt / time_constant)
    after = state + (wrench - state) * approach
    return after, wrench + (state - wrench) * (approach * time_constant / dt)


EFFECT = Effect(
    name="thruster_lag",
    place="input",
    summary="The thrusters follow their demand with a first-order lag, the same on every axis.",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 9.5",
    parameters=(EffectParameter("time_constant", "s", "time constant of the lag", 0.0, 0.0, 3.0),),
    start=start,
    step=step,
)
