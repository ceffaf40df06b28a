"""Newton's method between bounds, for likelihoods of few parameters."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.core.linalg import scaled_inverse
from rov_ident.core.messages import Array

T = TypeVar("T")


def minimise(
    x: Array,
    bounds: tuple[Array, Array],
    evaluate: Callable[[Array], tuple[T, float]],
    derivatives: Callable[[Array, T], tuple[Array, Array]],
    tolerance: float,
    most_steps: int,
    longest: float = np.inf,
) -> tuple[Array, T, int, bool]:
    """Minimise a cost, twice the negative logarithm of a likelihood, beginning at ``x`` (n,).

    ``evaluate`` gives the result at a point, which may be of any type, and the cost there;
    ``derivatives`` gives, from point and result, minus half the gradient (n,) and half the Hessian
    (n, n). A step has components of at most ``longest`` and is halved until the cost falls. The
    search has converged where a step gains less than ``tolerance``, which is the squared distance
    from the minimum in standard deviations. Returns the last point, the result there, the number of
    steps, and whether the search has converged.
    """
    (lower, upper), (result, cost), steps = bounds, evaluate(x), 0
    while steps < most_steps:
        slope, curvature = derivatives(x, result)
        # what the data would move beyond its bound stays there
        held = ((x <= lower) & (slope < 0.0)) | ((x >= upper) & (slope > 0.0))
        slope[held] = 0.0
        curvature[held] = curvature[:, held] = 0.0
        curvature[held, held] = 1.0
        change = np.clip(inverse_of(curvature) @ slope, -longest, longest)
        if slope @ change < tolerance:
            return x, result, steps, True
        factor, gained = 1.0, -1.0
        while factor > 1e-3 and not gained > 0.0:
            moved = np.clip(x + factor * change, lower, upper)
            moved_result, moved_cost = evaluate(moved)
            factor, gained = 0.5 * factor, cost - moved_cost
        if not gained > 0.0:
            return x, result, steps, True
        x, result, cost, steps = moved, moved_result, moved_cost, steps + 1
        if gained < tolerance:
            return x, result, steps, True
    return x, result, steps, False


def inverse_of(information: Array) -> Array:
    """Inverse of an information matrix, scaled to a unit diagonal meanwhile.

    Raises UserError if it is not finite, as the model could not be simulated.
    """
    if not np.isfinite(information).all():
        raise UserError(
            "the simulation diverges along this motion: check the signs and sizes of the "
            "coefficients and the axes of the bag"
        )
    # The rounding of sums over a hundred thousand samples leaves some 1e-14 of the largest.
    return scaled_inverse(information, rcond=1e-13)
