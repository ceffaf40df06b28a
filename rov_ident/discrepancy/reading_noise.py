"""Noise of the wrench's reading: how large it is, and how much of it a simulation makes.

A model is simulated with the wrench as it was read. What is read beside the command moves the
simulated vehicle only, so that an effect which makes the model follow the reading less (a dead
band, a failure, a gain below one) predicts better although it is not there (attenuation: Fuller
1987, ch. 1). The expected squares of what noise makes are therefore taken off those of the
residuals (the corrected score of Nakamura 1990): they are then as if the command had been read.
"""

import numpy as np

from rov_ident.model.equations import Array

DRAWS = 12  # of the noise: their scatter is then known to a fifth
SMALL = 0.1  # times the noise by which the thrust is differentiated, as it may have kinks
_BLOCK = 50  # commands in which noise is measured, to a fifth
_OF_MEDIAN = 1.4826  # standard deviation of a normal number over the median of its size
RESTING = 0.25  # of the blocks at least that commands rest: those with the least scatter


def resting_noise(demand: Array) -> Array:
    """Standard deviation (6,) of readings (K, 6) of the wrench where commands rest: of second
    differences, to which a command that moves evenly adds nothing, by the median, to which steps
    that are few add little."""
    second = np.diff(demand, 2, axis=0) / np.sqrt(6.0)
    blocks = len(second) // _BLOCK
    if not blocks:
        return np.zeros(6)
    cut = second[: blocks * _BLOCK].reshape(blocks, _BLOCK, 6)
    std: Array = np.quantile(np.median(np.abs(cut), axis=1), RESTING, axis=0)
    return _OF_MEDIAN * std


def draws(std: Array, count: int) -> Array:
    """Noise (DRAWS, count, 6) with standard deviations (6,): the same ones every time, so that
    models are compared under the same noise."""
    out: Array = np.random.default_rng(0).standard_normal((DRAWS, count, 6)) * std
    return out
