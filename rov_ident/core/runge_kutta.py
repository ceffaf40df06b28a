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


@inlined
def linear_step(jacobian, work, transition, held):
    """What the step does to a small change, all (6, 6), with ``jacobian`` J = dt d nu_dot / d nu.

    ``transition`` becomes 1 + J + J^2 / 2 + J^3 / 6 + J^4 / 24, which takes a change from the begin
    to the end; ``held`` becomes 1 + J / 2 + J^2 / 6 + J^3 / 24, which makes of a change of nu_dot
    that lasts for the step its mean, so that transition = 1 + J held. A series of second order
    would be far off where drag stops a motion within a step or two.
    """
    for i in range(6):
        for j in range(6):
            held[i, j] = 0.25 * jacobian[i, j]
        held[i, i] += 1.0
    for order in (3.0, 2.0):
        multiply(jacobian, held, 1.0 / order, work)
        for i in range(6):
            for j in range(6):
                held[i, j] = work[i, j]
            held[i, i] += 1.0
    multiply(jacobian, held, 1.0, transition)
    for i in range(6):
        transition[i, i] += 1.0


@inlined
def multiply(a, b, scale, out):
    """out = scale a @ b, all (6, 6): quicker than BLAS by what a call of it costs."""
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
        for k in range(6):
            for j in range(6):
                out[i, j] += scale * a[i, k] * b[k, j]
