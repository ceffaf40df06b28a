"""The standard deviation of noise, in a signal that is not noise alone."""

import math

import numpy as np

from rov_ident.core.messages import Array

_NORMAL = 1.4826  # standard deviation of a normal number over the median of its absolute value


def robust_std(error: Array, axis: int | None = 0) -> Array:
    """The standard deviation of normal errors along an axis (None: of all), whatever a minority of
    them is."""
    return _NORMAL * np.median(np.abs(error), axis=axis)


def differences(signal: Array, order: int) -> Array:
    """(K - order, n) of a signal (K, n), scaled so that white noise keeps its standard deviation; a
    signal that is a polynomial of a lower order leaves nothing."""
    return np.diff(signal, order, axis=0) / math.sqrt(math.comb(2 * order, order))
