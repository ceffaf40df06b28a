"""Noise of the wrench's reading: how large it is, and how much of it a simulation makes.

A model is simulated with the wrench as read. What is read beside the command moves the simulated
vehicle only, so that an effect which makes the model follow the reading less (a dead band, a
failure, a gain below one) predicts better although it is not there (attenuation: Fuller 1987, ch.
1). The expected squares of what noise makes are therefore taken off those of the residuals (the
corrected score of Nakamura 1990). The live watch, which has scores and no fits, smooths the wrench
instead (`wrench_smoothing`).
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.messages import Array

DRAWS = 12  # of the noise: their scatter is then known to a fifth
SMALL = 0.1  # times the noise by which the thrust is differentiated, as it may have kinks
_HALF = 12  # readings to either side of which the mean is taken: half a block in all
_LARGEST = 3.0  # standard deviations of noise, of which 0.3 % is larger


def jitter(demand: Array, std: Array, lasts: NDArray[np.int64]) -> Array:
    """What of readings (K, 6) looks like noise of standard deviations (6,) that ``lasts`` (6,)
    readings: the distance from the running mean, where the means before and after differ no more
    than noise makes them."""
    width = 2 * _HALF + 1
    if len(demand) < width:
        return np.zeros_like(demand)
    ends = np.pad(demand, ((_HALF + 1, _HALF), (0, 0)), mode="edge")
    total = np.cumsum(ends, axis=0)
    before = total[_HALF : -_HALF - 1] - total[:-width]
    after = total[width:] - total[_HALF + 1 : -_HALF]
    rests = np.abs(after - before) <= _LARGEST * np.sqrt(2.0 * _HALF * lasts) * std
    off: Array = demand - (total[width:] - total[:-width]) / width
    return np.where(rests, off, 0.0)


def draws(std: Array, lasts: NDArray[np.int64], count: int) -> Array:
    """Noise (DRAWS, count, 6) with standard deviations (6,) that ``lasts`` (6,) readings: the same
    ones every time, so that models are compared under the same noise."""
    held = np.arange(count)[:, None] // lasts
    out: Array = np.take_along_axis(_normal(count), held[None], axis=1) * std
    return out


@lru_cache(maxsize=2)
def _normal(count: int) -> Array:
    out: Array = np.random.default_rng(0).standard_normal((DRAWS, count, 6))
    return out
