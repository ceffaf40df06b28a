"""How quickly a vehicle turns, which tells its inertia from errors of its attitude."""

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.messages import Array
from rov_ident.sampling.sample import joined

_OVER = 0.2  # s; about as long as innovations of the rates last


class AngularAcceleration:
    """Mean square of the angular acceleration in roll and pitch over all samples that were added,
    less what noise of the rates makes of it."""

    def __init__(self) -> None:
        self._waiting: list[NDArray[np.void]] = []
        self._sum, self._count = np.zeros(2), 0

    def add(self, samples: NDArray[np.void]) -> None:
        """Keep samples (k,) of SAMPLE for :meth:`follow`."""
        self._waiting.append(samples)

    def follow(self) -> None:
        """Take in what was added, from differences of means over successive _OVER seconds."""
        samples, self._waiting = joined(self._waiting), []
        block = np.floor(samples["t"] / _OVER).astype(np.int64)
        number, at, counts = np.unique(block, return_inverse=True, return_counts=True)
        rates = samples["nu"][:, 3:5]
        means = np.stack([np.bincount(at, rates[:, i]) / counts for i in (0, 1)], axis=1)
        variance = np.where(
            np.isfinite(samples["gyro"][:, :1]),
            samples["gyro_variance"][:, None],
            samples["odometry_variance"][:, 3:5],
        )
        noise = np.nanmedian(variance, axis=0) if np.isfinite(variance).any() else np.zeros(2)
        follows = np.diff(number) == 1
        change = np.diff(means, axis=0)[follows] ** 2
        expected = noise * (1.0 / counts[1:] + 1.0 / counts[:-1])[follows, None]
        self._sum = self._sum + np.sum(change - expected, axis=0)
        self._count += int(follows.sum())

    @property
    def mean_square(self) -> Array:
        """(2,) [rad2/s4] about x and y; infinite until anything is known."""
        if not self._count:
            return np.full(2, np.inf)
        out: Array = np.maximum(self._sum / self._count, 0.0) / _OVER**2
        return out
