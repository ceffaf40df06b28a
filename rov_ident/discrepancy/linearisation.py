"""A hypothesis linearised about its simulated motion: residuals and their sensitivities.

The initial velocity of each window is a nuisance. It is eliminated here (residuals and
sensitivities are projected on the complement of what it explains), so that any number of further
parameters can be tried on a :class:`Linearisation` without simulating again. So is an error of the
attitude that lasts as long as a window: its moment is in the residuals of the whole window, which
are whitened with what ``odometry.attitude_std`` lets expect of it.
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.frames import rotated
from rov_ident.core.linalg import scaled_solve, unit_diagonal
from rov_ident.core.noise import robust_std
from rov_ident.discrepancy.hypothesis import Hypothesis, Key, record_of, shared
from rov_ident.discrepancy.multiple_shooting import Motion, adjoint, tangent
from rov_ident.discrepancy.windowed_problem import WindowedProblem
from rov_ident.model.equations import Array, Indices
from rov_ident.model.scales import WORKING_SPEED
from rov_ident.sampling.raw_streams import MAX_STEP

_OUTLIER = 8.0
"""Robust standard deviations beyond which a residual is an outlier.

Well beyond the 3 of Hampel (1974): what is missing from a model makes large residuals, too.
"""

_RUNS_AWAY = 0.2
"""Of the working speed: where noise of a window's first velocity has grown to that, second-order
terms are as large as noise. In ordinary dives 3 of 488 windows come so far, of a vehicle with an
unstable yaw every third ("Windows that run away" in docs/explain.md)."""

_HIGHEST = 2.0  # Hz; of forces that are looked for: surface waves lie far below


@dataclass(frozen=True)
class LinearProblem:
    """Least squares in the neighbourhood of a hypothesis, in units of the noise: ``normal`` (P, P)
    = J'J over the parameters ``keys``, ``gradient`` (W, P) = J'r of each window, ``rss`` (W,) its
    squared residuals, ``count`` the residuals less initial velocities; ``normals`` (W, P, P) what
    each window adds to ``normal``, where that is known."""

    keys: tuple[Key, ...]
    normal: Array
    gradient: Array
    rss: Array
    count: int
    normals: Array | None = None

    def index(self, keys: Iterable[Key]) -> Indices:
        place = {key: i for i, key in enumerate(self.keys)}
        return np.array([place[key] for key in keys], dtype=np.int64)


class MoreNoise(NamedTuple):
    """Noise of a single window beside that of its velocities and attitude, which ``whitening`` (6
    N, 6 N) makes white with those; ``taken`` (K, 6) is the wrench of it that was taken off what
    moves the vehicle, so that residuals are as if it were still in."""

    whitening: Array
    taken: Array


class Linearisation:
    """A hypothesis simulated through all windows: residuals ``error`` (6 N,), initial velocities
    eliminated, divided by the standard deviations ``noise`` (6,), and sensitivities; ``starts`` (W,
    6) are the initial velocities. With ``more`` noise both are whitened. ``told`` (N,): which
    measurements come before their window runs away; of the others there are no residuals. ``good``
    (N, 6): which residuals are no outliers."""

    def __init__(
        self,
        problem: WindowedProblem,
        h: Hypothesis,
        starts: Array,
        noise: Array,
        motion: Motion,
        more: "MoreNoise | None" = None,
        good: NDArray[np.bool_] | None = None,
    ) -> None:
        self.problem, self.hypothesis, self.starts = problem, h, starts
        self.noise, self.motion, self.more = noise, motion, more
        error = self._raw_error()
        self.good = _without_outliers(error) if good is None else good
        self._weight = self.good / noise
        self._weight[:, problem.guided] = 0.0
        self._rows = np.flatnonzero(np.diff(problem.window, prepend=-1))  # first of each window
        self.told = problem.told(self._before_running_away)
        self._weight[~self.told] = 0.0
        error = (error * (self._weight > 0.0)).reshape(-1, 1)
        if more is not None:
            error -= self._moved(more.taken[..., None])
        self._tilts = self._of_tilts()
        error = self._whitened(error)
        j0 = self._whitened(self._moved()).reshape(-1, 6)[:, ~problem.guided]
        self._q, self._r = [], []
        for a, b in self._spans():
            q, r = np.linalg.qr(j0[6 * a : 6 * b])
            self._q.append(q)
            self._r.append(r)
        self._start_error = [x[:, 0] for x in self._eliminate(error)]
        self.error = error[:, 0]
        self._squares = np.add.reduceat(self.error**2, self.first)

    @cached_property
    def sensitivities(self) -> tuple[list[Array], Array, LinearProblem]:
        """With respect to the parameters of the hypothesis; computed when first asked for, as of a
        trial that is no better only the residuals count."""
        keys = self.hypothesis.keys
        columns = self._of(self.hypothesis, keys)
        starts = self._eliminate(columns)
        count = int(np.count_nonzero(self._weight)) - 6 * len(self.first)
        normals, gradient = self._products(columns, columns), self._gradient(columns)
        linear = LinearProblem(
            tuple(keys), normals.sum(axis=0), gradient, self._squares, count, normals
        )
        return starts, columns, linear

    @property
    def columns(self) -> Array:
        return self.sensitivities[1]

    @property
    def linear(self) -> LinearProblem:
        return self.sensitivities[2]

    @property
    def rss(self) -> float:
        """Squared residuals, those of all windows."""
        return float(self.of_windows.sum())

    @property
    def of_windows(self) -> Array:
        """Squared residuals (W,); an outlier counts as the least residual that is one, or a fit
        could improve by losing a window."""
        out = np.count_nonzero(self._weight[:, ~self.problem.guided] == 0.0, axis=1) * self.told
        return self._squares + _OUTLIER**2 * np.add.reduceat(out, self._rows)

    def judged_anew(self) -> "Linearisation":
        """The same with the outliers that there are here, not those of where it came from."""
        good = _without_outliers(self._raw_error())
        if (good == self.good).all():
            return self
        return Linearisation(
            self.problem, self.hypothesis, self.starts, self.noise, self.motion, self.more, good
        )

    def _raw_error(self) -> Array:
        """Measured less simulated velocities (N, 6) over their noise."""
        error: Array = self.problem.measured - self.motion.nu[self.problem.nodes]
        return error / self.noise

    @property
    def first(self) -> Indices:
        """Where each window begins in the residuals (6 N,)."""
        return 6 * self._rows

    def _spans(self) -> Iterable[tuple[int, int]]:
        edges = [*self._rows.tolist(), len(self.problem.nodes)]
        return itertools.pairwise(edges)

    def _eliminate(self, raw: Array) -> list[Array]:
        """Take from columns (6 N, P) what the initial velocities of each window explain, and return
        that."""
        out = []
        for q, (a, b) in zip(self._q, self._spans(), strict=True):
            part = raw[6 * a : 6 * b]
            out.append(q.T @ part)
            part -= q @ out[-1]
        return out

    def _gradient(self, columns: Array) -> Array:
        """Of each window (W, P), of columns (6 N, P)."""
        return self._products(columns, self.error[:, None])[:, :, 0]

    def _products(self, one: Array, other: Array) -> Array:
        """Of columns (6 N, P) and (6 N, Q) those of each window, (W, P, Q)."""
        spans = [slice(6 * a, 6 * b) for a, b in self._spans()]
        return np.stack([one[s].T @ other[s] for s in spans])

    def over_variance(self, error: Array) -> tuple[Array, Array]:
        """Of a single window with more noise: the residuals (N, 6) over the variance of that noise
        and their own, and the square that is expected of them."""
        back = self._whitened(np.eye(len(self.error)))
        self._eliminate(back)
        return (back.T @ error).reshape(-1, 6), np.sum(back**2, axis=0).reshape(-1, 6)

    def pushed_by(self, error: Array) -> Array:
        """The transpose of :meth:`unprojected` without whitening: (N, 6) to wrenches (K, 6)."""
        e = self.problem
        return adjoint(self.motion, e.first, e.last, error * self._weight, e.nodes)

    def sensitivity_of(self, h: Hypothesis, keys: Sequence[Key]) -> Array:
        """Sensitivities (6 N, P) of the simulated velocities to parameters of a hypothesis."""
        out = self._of(h, keys)
        self._eliminate(out)
        return out

    def _of(self, h: Hypothesis, keys: Sequence[Key]) -> Array:
        """The same with the initial velocities held. What several records have of the same
        parameter moves none of the others' windows, so that it takes one column together."""
        problem = self.problem
        force = problem.columns(h, self.motion, keys)
        kinds = [(shared(k), record_of(k) is None) for k in keys]
        together = list(dict.fromkeys(kinds))
        if len(together) == len(keys):
            return self.unprojected(force)
        at = [together.index(kind) for kind in kinds]
        packed = np.zeros((*force.shape[:2], len(together)))
        for i, column in enumerate(at):
            packed[:, :, column] += force[:, :, i]
        out: Array = self.unprojected(packed)[:, at]
        for i, key in enumerate(keys):
            if (record := record_of(key)) is not None:
                out[~self.rows_of(record), i] = 0.0
        return out

    def rows_of(self, record: int) -> NDArray[np.bool_]:
        """Which of the residuals (6 N,) are of one of several records."""
        problem = self.problem
        return np.repeat(problem.record[problem.first][problem.window] == record, 6)

    def sensitivity_to(self, force: Array) -> Array:
        """Sensitivities (6 N, C) of the simulated velocities to wrenches (K, 6, C)."""
        out = self.unprojected(force)
        self._eliminate(out)
        return out

    def unprojected(self, force: Array) -> Array:
        """The same (6 N, C) with the initial velocities held."""
        return self._whitened(self._moved(force))

    def _moved(self, force: Array | None = None) -> Array:
        """Sensitivities (6 N, C) to wrenches, without to the initial velocities, in units of the
        noise of the velocities alone."""
        moved = self._tangent(force)
        return (moved * self._weight[:, :, None]).reshape(moved[..., 0].size, -1)

    def _tangent(self, force: Array | None = None) -> Array:
        """The same (N, 6, C) in m/s and rad/s."""
        e = self.problem
        e.count(6 if force is None else force.shape[2])
        return tangent(self.motion, e.first, e.last, e.nodes, force)

    def _before_running_away(self) -> NDArray[np.bool_]:
        """Of each measurement (N,) whether noise of the first velocity has not grown too much in
        its window. Along the measured attitude no righting moment holds a simulation back; and what
        is left out must not change with what is fitted, or fits could improve by losing it."""
        odometry = self.hypothesis.config.odometry
        first = np.repeat([odometry.linear_std, odometry.angular_std], 3)
        growth = self.problem.growth(self.hypothesis)
        grown = np.sqrt(np.sum((growth * first) ** 2, axis=2)) / WORKING_SPEED
        away = np.where(self.problem.guided, 0.0, grown).max(axis=1) > _RUNS_AWAY
        told = np.ones(len(away), dtype=bool)
        for a, b in self._spans():
            told[a:b] = np.cumsum(away[a:b]) == 0
        return told

    def _of_tilts(self) -> list[tuple[Array, Array]]:
        """For each window J (6 n, 6), what errors of its attitude of one standard deviation make of
        the residuals, and M (6, 6), by which I - J M J' is the inverse root of their covariance I +
        J J'. They are those along the first motion that was simulated, as a covariance that changes
        with what is fitted would make errors larger instead of fits better."""
        problem, config = self.problem, self.hypothesis.config
        tilted = problem.tilted(lambda: self._tangent(problem.tilting(config.model.body)))
        columns = config.odometry.attitude_std * tilted * self._weight[:, :, None]
        found = []
        for a, b in self._spans():
            j = columns[a:b].reshape(-1, columns.shape[2])
            power, axes = np.linalg.eigh(j.T @ j)
            power = np.maximum(power, 1e-12)
            found.append((j, axes * ((1.0 - (1.0 + power) ** -0.5) / power) @ axes.T))
        return found

    def _whitened(self, columns: Array) -> Array:
        """Columns (6 N, P) in units of the noise of the velocities in those of all noise."""
        for (j, matrix), (a, b) in zip(self._tilts, self._spans(), strict=True):
            part = columns[6 * a : 6 * b]
            part -= j @ (matrix @ (j.T @ part))
        return columns if self.more is None else self.more.whitening @ columns

    def of_biases(self) -> Array:
        """Columns (6 N, 3): biases of the angular velocities, each as large as it may be, in the
        residuals, what is taken for the initial velocities with them."""
        biases = np.zeros((*self._weight.shape, 3))
        biases[:, 3:] = np.diag(self.problem.streams.rates_std)
        columns = self._whitened((biases * self._weight[:, :, None]).reshape(-1, 3))
        self._eliminate(columns)
        return columns

    def having(self, keys: Sequence[Key], columns: Array) -> LinearProblem:
        """With further parameters, whose sensitivities are ``columns`` (6 N, C)."""
        own, p = self.linear, len(self.linear.keys)
        assert own.normals is not None
        normals = np.empty((len(own.normals), *2 * (p + len(keys),)))
        normals[:, :p, :p], normals[:, p:, p:] = own.normals, self._products(columns, columns)
        normals[:, :p, p:] = self._products(self.columns, columns)
        normals[:, p:, :p] = normals[:, :p, p:].transpose(0, 2, 1)
        gradient = np.hstack([own.gradient, self._gradient(columns)])
        return LinearProblem(
            (*own.keys, *keys), normals.sum(axis=0), gradient, own.rss, own.count, normals
        )

    def jackknife(self, at: Indices, prior: Array) -> Array:
        """How the estimate (W, A) of the parameters ``at`` (A,), of a ``prior`` precision (A, A),
        moves as each window is left out; the other parameters are taken as known."""
        linear = self.linear
        assert linear.normals is not None
        normal, gradient = linear.normal[np.ix_(at, at)] + prior, linear.gradient[:, at]
        _, size = unit_diagonal(normal)
        each = zip(linear.normals[:, at[:, None], at], gradient, strict=True)
        return np.stack([scaled_solve(normal - own, g, 1e-9, size) for own, g in each])

    def leave_one_out(self, at: Indices, prior: Array) -> Array:
        """Squared residuals (W, 6) of each window, by axis, of a fit to all the others."""
        moves = self.jackknife(at, prior)
        window = np.repeat(np.arange(len(moves)), np.diff([*self.first, len(self.columns)]))
        error = self.error + np.einsum("rp,rp->r", self.columns[:, at], moves[window])
        return np.add.reduceat(error.reshape(-1, 6) ** 2, self._rows)

    def starts_after(self, change: Array, share: float = 1.0) -> Array:
        """The initial velocities (W, 6) that suit a change (P,) of the parameters, with a ``share``
        of how far they are off without one."""
        left = share * np.stack(self._start_error) - np.stack(self.sensitivities[0]) @ change
        # by least squares: a velocity that a poor model forgets at once has no initial value
        moves = np.linalg.pinv(np.stack(self._r)) @ left[:, :, None]
        starts = self.starts.copy()
        starts[:, ~self.problem.guided] += moves[:, :, 0]
        return starts

    def residual_std(self) -> Array:
        """Standard deviation (6,) of the residuals, less what errors of the attitude explain of
        them (whitened twice they are those over the covariance); outliers are left out."""
        good = self._weight > 0.0
        error = (self.problem.measured - self.motion.nu[self.problem.nodes]) * self._weight
        residual = self._whitened(self._whitened(error.reshape(-1, 1))).reshape(-1, 6) * self.noise
        power = np.sum(residual**2, axis=0)
        std: Array = np.sqrt(np.maximum(power / np.maximum(good.sum(axis=0), 1), 1e-16))
        return std

    def frequencies(self, count: int, axis: int | None = None) -> list[float]:
        """Frequencies [Hz] at which a force in the world, or along a body axis, would help most:
        peaks, over the median of their neighbourhood, in the spectrum of the gradient of the
        squared residuals with respect to a wrench at each step (by the adjoint equations)."""
        e = self.problem
        error = self._whitened(self.error[:, None].copy()).reshape(-1, 6) * self._weight
        wrench = adjoint(self.motion, e.first, e.last, error, e.nodes)
        in_world = rotated(e.steps.middle, wrench[:, :3])
        force = in_world if axis is None else wrench[:, axis : axis + 1]
        t = 0.5 * (e.steps.t[1:] + e.steps.t[:-1])
        step = 2.0 * MAX_STEP
        bins = ((t - t[0]) / step).astype(int)
        size = 4 * (bins[-1] + 1)  # padded: a peak between two frequencies shows
        power = np.zeros(size // 2 + 1)
        for column in force.T:
            power += np.abs(np.fft.rfft(np.bincount(bins, column), size)) ** 2
        frequency = np.fft.rfftfreq(size, step)
        power[(frequency < 1.0 / (t[-1] - t[0])) | (frequency > _HIGHEST)] = 0.0
        from scipy.ndimage import median_filter  # here: the monitor in a node does not need 13 MB

        level = median_filter(power, max(5, size // 64)) + 1e-3 * power.max()
        peaks = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
        strongest = peaks[np.argsort(-power[peaks] / np.maximum(level[peaks], 1e-300))]
        # between two frequencies by a parabola through logarithms (Smith and Serra 1987): half of
        # their distance would be a quarter of a period by the end of the record
        a, b, c = np.log(np.maximum(power[strongest[:count] + [[-1], [0], [1]]], 1e-300))
        between = 0.5 * (a - c) / np.minimum(a - 2.0 * b + c, -1e-9)
        found: list[float] = (frequency[strongest[:count]] + between * frequency[1]).tolist()
        return found


def linearise(
    problem: WindowedProblem,
    h: Hypothesis,
    starts: Array,
    noise: Array,
    more: MoreNoise | None = None,
    good: NDArray[np.bool_] | None = None,
) -> Linearisation | None:
    """Simulate a hypothesis from initial velocities (W, 6); None where that diverges."""
    motion = problem.motion(h, starts)
    return None if motion is None else Linearisation(problem, h, starts, noise, motion, more, good)


def _without_outliers(error: Array) -> NDArray[np.bool_]:
    """Which of the residuals (N, 6), over their noise, are no outliers."""
    good: NDArray[np.bool_] = np.abs(error) < _OUTLIER * np.maximum(robust_std(error), 1.0)
    return good
