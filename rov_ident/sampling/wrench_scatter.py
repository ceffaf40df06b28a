"""Noise of the wrench's reading: how large it is, and where it is too large to learn from.

What is read beside the command moves the predicted vehicle and not the real one. A recursive
estimator finds the same noise in its innovations and in the sensitivities, which the wrench drives,
and takes what the vehicle does not follow for a weaker thrust or a heavier vehicle (attenuation:
Fuller 1987, ch. 1). On an axis that is driven far above the noise that is nothing; elsewhere a
minute of it outweighs all that the motion tells ("Noise of the wrench's reading" in
docs/choices.md).
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.messages import Array
from rov_ident.core.noise import differences, robust_std

# of differences: in those of second order, commands of 2 Hz and 15 N make noise of 0.8 N, read at
# 50 Hz, a third too large; in these 6 %
_ORDER = 4
_BLOCK = 50  # commands in which noise is measured, to a fifth
_ROUNDING = 1e-6  # of the largest command on any axis: 32 bits round by less, and thrusters that
# cancel leave no more than that of each other
RESTING = 0.25  # of the blocks at least that commands rest: those with the least scatter
_AS_LOUD = 1.7  # of the noise: all but 1 in 1000 blocks of noise
_AS_QUIET = 2.0  # of that quartile, which is 0.87 of the noise: all but 1 in 1000 blocks of noise
_MEAN = 10  # neighbouring readings, whose mean has a tenth of the variance of white noise
_MORE_THAN_WHITE = 1.5  # of that; noise that is the same for two readings leaves 1.9
_RARE = 0.05  # of the blocks, which are quieter; with noise, chance alone makes them so
_FLOOR = 0.5  # of that quartile: less in 1 % of means of five, and commands know no least
RECENT = 5.0  # s; over which the power of a component is averaged: a few moves of a stick
# of that power, which noise may be: the same section has the study
SHARE = 0.01


def resting_noise(demand: Array, order: int = _ORDER) -> Array:
    """Standard deviation (6,) of readings (K, 6) of the wrench where commands rest."""
    if len(demand) < _BLOCK + order:
        return np.zeros(6)
    return resting(scatter(demand, order=order))


def driven(demand: Array) -> Array:
    """How much of :func:`resting_noise` (6,) commands may have made that never rest: no more than
    what they add to it in differences of a lower order."""
    return np.maximum(resting_noise(demand, _ORDER - 2) - resting_noise(demand), 0.0)


def reading_noise(demand: Array, lasts: NDArray[np.int64]) -> Array:
    """Standard deviation (6,) of the noise of readings (K, 6) of the wrench, where it is known for
    how many readings (6,) that lasts."""
    return np.where(lasts > 1, noise_that_lasts(demand)[0], resting_noise(demand))


def noise_that_lasts(demand: Array) -> tuple[Array, NDArray[np.int64]]:
    """Standard deviation (6,) of readings (K, 6) within each block in which commands rest, and for
    how many readings (6,) their noise is the same; zero and one where it is white, or where it
    differs from block to block as that of commands mostly does.

    Noise that comes less often than the readings, as from telemetry of the thrusters, leaves little
    in second differences. Means of several readings have more of it than of white noise: that of
    the blocks is pooled, which are as quiet as :func:`resting` wants them."""
    std, lasts = np.zeros(6), np.ones(6, dtype=np.int64)
    count = len(demand) // _BLOCK
    if not count:
        return std, lasts
    blocks = demand[: count * _BLOCK].reshape(count, _BLOCK, 6)
    blocks = blocks - blocks.mean(axis=1, keepdims=True)
    own = np.mean(blocks**2, axis=1)
    of_means = np.mean(np.einsum("mk,bki->bmi", _running_means(), blocks) ** 2, axis=1)
    least = (_ROUNDING * np.abs(demand).max()) ** 2
    for i in range(6):
        rare, quiet = np.quantile(own[:, i], (_RARE, RESTING))
        if quiet <= least or rare < _FLOOR**2 * quiet:
            continue
        rest = own[:, i] <= _AS_QUIET**2 * quiet
        ratio = of_means[rest, i].sum() / own[rest, i].sum()
        own_left, of_means_left = _left_in_blocks().T
        if ratio > _MORE_THAN_WHITE * of_means_left[0] / own_left[0]:
            like = np.argmin(np.abs(of_means_left / own_left - ratio))
            std[i], lasts[i] = np.sqrt(own[rest, i].mean() / own_left[like]), 1 + like
    return std, lasts


@lru_cache(maxsize=1)
def _running_means() -> Array:
    """Weights (M, K) of the means of neighbours in a block."""
    each = np.arange(_BLOCK)
    first = each[: -_MEAN + 1, None]
    out: Array = ((each >= first) & (each < first + _MEAN)) / _MEAN
    return out


@lru_cache(maxsize=1)
def _left_in_blocks() -> Array:
    """The variance in a block of readings and of their running means (L, 2), of unit noise that is
    the same for 1, 2 ... L readings: its correlation is 1 - d / L between readings d apart."""
    ahead = np.abs(np.subtract.outer(np.arange(_BLOCK), np.arange(_BLOCK)))
    centred = np.eye(_BLOCK) - 1.0 / _BLOCK
    out = []
    for lasts in range(1, _BLOCK // 2 + 1):
        covariance = centred @ np.maximum(1.0 - ahead / lasts, 0.0) @ centred
        of_means = _running_means() @ covariance @ _running_means().T
        out.append((np.diag(covariance).mean(), np.diag(of_means).mean()))
    return np.array(out)


def scatter(demand: Array, relative: float = 0.0, order: int = _ORDER) -> Array:
    """Standard deviation (B, 6) of the noise of readings (K, 6) in each block, from differences of
    an ``order``. NaN where a noise ``relative`` to the wrench, which is known of, makes as much by
    chance."""
    size = min(_BLOCK, max(len(demand) - order, 1))
    trembling = differences(demand, order)  # steps of the command are too few to move their median
    blocks = len(trembling) // size
    std = robust_std(trembling[: blocks * size].reshape(blocks, size, 6), axis=1)
    std[std <= _ROUNDING * np.abs(demand).max()] = 0.0
    level = demand[: len(std) * size].reshape(len(std), size, 6)
    known = relative * np.sqrt(np.mean(level**2, axis=1))
    std[(std > 0.0) & (std <= _AS_LOUD * known)] = np.nan
    return std


def resting(std: Array) -> Array:
    """The standard deviation (6,) in those of the blocks (B, 6) in which commands rest: the mean
    of all that are as quiet as chance makes them beside the quietest ones; zero where too few tell.
    """
    out = np.zeros(6)
    for i, column in enumerate(std.T):
        own = column[np.isfinite(column)]
        if len(own) and len(own) >= RESTING * len(column):
            out[i] = own[own <= _AS_QUIET * np.quantile(own, RESTING)].mean()
    return out


class ReadingNoise:
    """Says, as readings come, on which axes noise is not far below the wrench itself.

    ``relative`` is the noise in proportion to the wrench that is known of; ``variance`` (6,) that
    of what is found beside it, zero where it has less than ``SHARE`` of the power of late, and
    infinite until a block of readings tells. ``found`` (6,) is that of late,
    however large the wrench.
    """

    def __init__(self, relative: float = 0.0) -> None:
        self.relative = relative
        self.variance = np.full(6, np.inf)
        self.found = np.zeros(6)
        self._power = np.zeros(6)
        self._t: list[float] = []
        self._readings: list[Array] = []

    def take(self, t: float, reading: Array) -> None:
        """The next reading (6,), at t [s]."""
        if self._t and t < self._t[-1]:  # the clock was stepped
            self._t, self._readings = [], []
        self._t.append(t)
        self._readings.append(reading)
        if len(self._t) < _BLOCK + _ORDER:
            if t - self._t[0] > RECENT:  # commands that come seldom are not waited for
                self.variance[np.isinf(self.variance)] = 0.0
            return
        block = np.array(self._readings)
        share = 1.0 if not self._power.any() else -math.expm1((self._t[0] - t) / RECENT)
        self._power += share * (np.mean(block**2, axis=0) - self._power)
        variance = scatter(block, self.relative)[0] ** 2
        self.found += share * np.where(np.isfinite(variance), variance - self.found, 0.0)
        self.variance = np.where(variance > SHARE * self._power, variance, 0.0)
        self._t, self._readings = [], []
