"""Coordinates in which what nothing tells of the thrust has the same direction everywhere.

With thrust, coefficients, rigid body and weight k times as large, the motion is the same. So data
say little along the line through the origin of thrust scale and coefficients, and where that runs
depends on the coefficients: information that is linear about some would claim, about others, to
know the scale. Both estimators keep theirs in coordinates in which all these lines are parallel.
With rho the scale over its prior mean, they are -1 / rho and coefficient / rho; where no scale is
estimated, rho is 1. In prior standard deviations, as the coefficients are.
"""

import numpy as np

from rov_ident.core.jit import inlined
from rov_ident.core.messages import Array
from rov_ident.estimation.shared import REACH, Problem


@inlined
def relative_thrust(task, deviation):
    """rho, of the coordinate of the thrust scale as it deviates from the prior's."""
    i = task.thrust
    bounded = min(max(deviation, -REACH), task.highest[i])
    return 1.0 / (1.0 - task.scale[i] / task.theta[task.estimated[i]] * bounded)


@inlined
def take_thrust(lanes, task, theta, rho):
    """theta (m, lanes) of ``theta0 + scale * deviation`` becomes that of the coefficients; rho
    (lanes,)."""
    for k in range(lanes):
        rho[k] = 1.0
    if task.thrust >= 0:
        at = task.estimated[task.thrust]
        for k in range(lanes):
            deviation = (theta[at, k] - task.theta[at]) / task.scale[task.thrust]
            rho[k] = relative_thrust(task, deviation)
            theta[at, k] = rho[k] * task.theta[at]
        for j in range(len(task.scale)):
            if task.per_thrust[j]:
                for k in range(lanes):
                    theta[task.estimated[j], k] *= rho[k]


def values_of(task: Problem, deviation: Array) -> Array:
    """Coefficients (n,) in their units, of coordinates (n,) as they deviate from the prior's."""
    values: Array = task.theta[task.estimated] + task.scale * deviation
    if task.thrust >= 0:
        rho = relative_thrust(task, deviation[task.thrust])
        values[task.per_thrust] *= rho
        values[task.thrust] = rho * task.theta[task.estimated[task.thrust]]
    return values


def jacobian_of(task: Problem, deviation: Array) -> Array:
    """Derivatives (n, n) of the coefficients, in prior deviations, with respect to coordinates."""
    out, i, scaled = np.eye(len(task.scale)), task.thrust, task.per_thrust
    if i >= 0:
        values, rho = values_of(task, deviation), relative_thrust(task, deviation[i])
        out[scaled] *= rho
        step = rho * task.scale[i] / task.theta[task.estimated[i]]
        out[scaled, i] = step * values[scaled] / task.scale[scaled]
        out[i, i] = rho**2
    return out
