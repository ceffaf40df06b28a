"""The classical Runge-Kutta step of fourth order (Kutta 1901), once for all simulations."""

from rov_ident.core.jit import inlined

NODES = (0.0, 0.5, 0.5, 1.0)  # when a stage is, in steps

WEIGHTS = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)
"""Of the slope of each stage in that of the whole step."""

_AHEAD = (0.5, 0.5, 1.0, 0.0)  # how far the slope of a stage takes the next one


@inlined
def runge_kutta(stage, dt, begin, slope, reached, end):
    """Use the ``slope`` that was found in stage 0 to 3 of a step from ``begin``; all (n,).

    ``reached`` becomes where the next stage has to find its slope. ``end``, which is ``begin``
    before the first stage, becomes the state after the step with the last one.
    """
    ahead, weight = _AHEAD[stage] * dt, WEIGHTS[stage] * dt
    for i in range(len(slope)):
        reached[i] = begin[i] + ahead * slope[i]
        end[i] += weight * slope[i]
