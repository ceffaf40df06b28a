"""Normal equations and covariances of parameters whose units, and so sizes, differ widely.

A symmetric matrix is scaled to a unit diagonal before it is factored: its condition number is then
within a factor n of the least that any diagonal scaling reaches (van der Sluis 1969).
"""

import numpy as np

from rov_ident.core.messages import Array

_NOTHING = 1e-30
"""A diagonal entry below it counts as it: of a parameter known to 1e15 of its unit, nothing is."""


def unit_diagonal(matrix: Array) -> tuple[Array, Array]:
    """The symmetric ``matrix`` (n, n) over ``size`` of row and column, and ``size`` (n,), the roots
    of its diagonal."""
    size = _size(matrix)
    return matrix / np.outer(size, size), size


def _size(matrix: Array) -> Array:
    return np.sqrt(np.maximum(np.diag(matrix), _NOTHING))


def scaled_solve(
    matrix: Array, right: Array, ridge: float = 0.0, size: Array | None = None
) -> Array:
    """The x (n,) or (n, k) with ``matrix @ x = right``, of a symmetric matrix (n, n).

    ``ridge`` is added to the diagonal after scaling: it decides in directions that the matrix
    knows less of than this share. ``size`` (n,) scales instead of the matrix's own diagonal.

    Raises numpy.linalg.LinAlgError if the matrix is singular, and there is no ridge.
    """
    if size is None:
        unit, size = unit_diagonal(matrix)
    else:
        unit = matrix / np.outer(size, size)
    solution: Array = np.linalg.solve(unit + ridge * np.eye(len(size)), (right.T / size).T)
    return (solution.T / size).T


def scaled_inverse(matrix: Array, rcond: float = 1e-15) -> Array:
    """Pseudo-inverse (n, n) of a symmetric, positive semi-definite matrix.

    Directions with eigenvalues below ``rcond`` of the largest, after scaling, are left out (1e-15:
    those that are zero but for rounding).
    """
    scale = 1.0 / _size(matrix)
    scale = np.outer(scale, scale)
    return np.linalg.pinv(matrix * scale, hermitian=True, rcond=rcond) * scale


def sandwich(inverse: Array, scatter: Array) -> Array:
    """Covariance (n, n) of an estimate whose score has the covariance ``scatter``, by the inverse
    of its normal matrix (Huber 1967)."""
    return inverse @ scatter @ inverse.T


def widened(covariance: Array, variance: Array) -> Array:
    """The covariance (n, n) with the same correlations and no variance below ``variance`` (n,)."""
    own = np.maximum(np.diag(covariance), 1e-300)  # zero over zero
    factor = np.sqrt(np.maximum(variance / own, 1.0))
    return covariance * np.outer(factor, factor)


def interpolated(t: Array, y: Array, at: Array) -> Array:
    """Columns y (N, n) at times t (N,), straight in between, at the times ``at`` (k,): (k, n)."""
    return np.stack([np.interp(at, t, column) for column in y.T], axis=1)


def integral(t: Array, y: Array) -> Array:
    """The integral (N, n) of columns y (N, n) from the first of the times t (N,) (trapezoids)."""
    steps = 0.5 * np.diff(t)[:, None] * (y[1:] + y[:-1])
    return np.vstack([np.zeros(y.shape[1]), np.cumsum(steps, axis=0)])
