"""Noise of the wrench's reading: how large it is, and how much of it a simulation makes.

A model is simulated with the wrench as it was read. What is read beside the command moves the
simulated vehicle only, so that an effect which makes the model follow the reading less (a dead
band, a failure, a gain below one) predicts better although it is not there (attenuation: Fuller
1987, ch. 1). The expected squares of what noise makes are therefore taken off those of the
residuals (the corrected score of Nakamura 1990): they are then as if the command had been read.

The live watch has no fits to compare, but scores: sensitivities times residuals. These are without
bias where the wrench is smoothed with the motion first, as the best linear estimate of the commands
is not correlated with what contradicts it (the conditional score of Stefanski, Carroll 1987).
"""

import numpy as np

from rov_ident.model.equations import Array

DRAWS = 12  # of the noise: their scatter is then known to a fifth
SMALL = 0.1  # times the noise by which the thrust is differentiated, as it may have kinks
_BLOCK = 50  # commands in which noise is measured, to a fifth
_HALF = 12  # readings to either side of which the mean is taken: half a block in all
_LARGEST = 3.0  # standard deviations of noise, of which 0.3 % is larger
_OF_MEDIAN = 1.4826  # standard deviation of a normal number over the median of its size
RESTING = 0.25  # of the blocks at least that commands rest: those with the least scatter
_AS_LOUD = 1.7  # of the noise: all but 1 in 1000 blocks of noise
_AS_QUIET = 2.0  # of that quartile, which is 0.87 of the noise: all but 1 in 1000 blocks of noise


def resting_noise(demand: Array) -> Array:
    """Standard deviation (6,) of readings (K, 6) of the wrench where commands rest: that of the
    quietest blocks, 13 % below what :func:`resting` finds (docs/explain-bench.md is of this one).
    """
    if len(demand) < _BLOCK + 2:
        return np.zeros(6)
    std: Array = np.quantile(_medians(demand, _BLOCK), RESTING, axis=0)
    return _OF_MEDIAN * std


def _medians(demand: Array, size: int) -> Array:
    """Median (B, 6) of the second differences of readings (K, 6) in each block: a command that
    moves evenly adds nothing to these, steps that are few add little to their median."""
    second = np.diff(demand, 2, axis=0) / np.sqrt(6.0)
    blocks = len(second) // size
    cut = second[: blocks * size].reshape(blocks, size, 6)
    out: Array = np.median(np.abs(cut), axis=1)
    return out


def scatter(demand: Array, relative: float = 0.0) -> Array:
    """Standard deviation (B, 6) of the noise of readings (K, 6) in each block. NaN where a noise
    ``relative`` to the wrench, which is known of, makes as much by chance."""
    size = min(_BLOCK, max(len(demand) - 2, 1))
    std = _OF_MEDIAN * _medians(demand, size)
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


def jitter(demand: Array, std: Array) -> Array:
    """What of readings (K, 6) looks like noise of standard deviations (6,): the distance from the
    running mean, where the means before and after differ no more than noise makes them."""
    width = 2 * _HALF + 1
    if len(demand) < width:
        return np.zeros_like(demand)
    ends = np.pad(demand, ((_HALF + 1, _HALF), (0, 0)), mode="edge")
    total = np.cumsum(ends, axis=0)
    before, after = (
        total[_HALF : -_HALF - 1] - total[:-width],
        total[width:] - total[_HALF + 1 : -_HALF],
    )
    rests = np.abs(after - before) <= _LARGEST * np.sqrt(2.0 * _HALF) * std
    off: Array = demand - (total[width:] - total[:-width]) / width
    return np.where(rests, off, 0.0)


def draws(std: Array, count: int) -> Array:
    """Noise (DRAWS, count, 6) with standard deviations (6,): the same ones every time, so that
    models are compared under the same noise."""
    out: Array = np.random.default_rng(0).standard_normal((DRAWS, count, 6)) * std
    return out
