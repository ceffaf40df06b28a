"""The standard deviation of noise, in a signal that is not noise alone."""

import numpy as np

from rov_ident.core.messages import Array

_NORMAL = 1.4826  # standard deviation of a normal number over the median of its absolute value


def robust_std(error: Array, axis: int | None = 0) -> Array:
    """The standard deviation of normal errors along an axis (None: of all), whatever a minority of
    them is."""
    return _NORMAL * np.median(np.abs(error), axis=axis)


def second_differences(signal: Array) -> Array:
    """(K - 2, n) of a signal (K, n), over the square root of 6: white noise keeps its standard
    deviation, and a signal that changes evenly leaves nothing."""
    return np.diff(signal, 2, axis=0) / np.sqrt(6.0)
