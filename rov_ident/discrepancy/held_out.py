"""Data are divided into those that fits see and those held out, on which the gain of an effect is
measured: in open loop, with it and without."""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rov_ident.discrepancy.hypothesis import Hypothesis
from rov_ident.discrepancy.results import Gain, Together
from rov_ident.discrepancy.windowed_problem import Spans, WindowedProblem
from rov_ident.effects import Values, sense
from rov_ident.effects.base import Reading
from rov_ident.model.coefficients import AXES, VELOCITIES
from rov_ident.model.equations import Array
from rov_ident.sampling.raw_streams import Streams

BLOCK = 10.0
"""Seconds; held-out data are whole blocks, and windows for judging are as long (the contract)."""

WINDOW = 5.0
"""Seconds; of the windows that are fitted.

Half of a block: long enough that drag shows, short enough that a vehicle that is not stable does
not run away from its measured motion.
"""

_MARGIN = 0.25  # s cut off beside held-out blocks: five odometry messages at 20 Hz
_ENOUGH = 600.0  # s of data to fit; an hour is explained in less than a minute so
MOTIONS = dict(zip(VELOCITIES, ("surge", "sway", "heave", "roll rate", "pitch rate", "yaw rate")))

CHUNK = 2.5  # seconds; of the chunks that the bootstrap resamples: four to a block
_NEARLY = 0.5  # of what another velocity gains
PRACTICAL = 0.02  # gain from which an effect has practical weight (the contract)
_DRAWS = 2000  # of the bootstrap: the 95 % quantile is then good to half a percent
_LEAST_NOISE = 1e-3  # standard deviations of the motion: a simulated dive may have less, or none
_FAILED = 3.0  # standard deviations of the motion: a simulation further off counts as so far off


def split(duration: float) -> tuple[Spans, Spans]:
    """Spans to fit and spans to judge on: of ten blocks the second, sixth and ninth are held out,
    of a bag of less than four blocks the last third."""
    fit: Spans = []
    held: Spans = []
    count = round(duration / BLOCK)
    if count < 4:
        edge = 0.7 * duration
        return windows(0.0, edge - _MARGIN), [(edge + _MARGIN, duration)]
    for i in range(count):
        begin, end = i * BLOCK, (i + 1) * BLOCK if i + 1 < count else duration
        if (3 * i + 7) // 10 > (3 * i + 4) // 10:
            held.append((begin, end))
        else:
            fit += windows(begin + _MARGIN, end - _MARGIN)
    return fit, held


def windows(begin: float, end: float) -> Spans:
    """Windows to fit between two times [s]."""
    edges = np.linspace(begin, end, max(1, round((end - begin) / WINDOW)) + 1)
    return list(itertools.pairwise(edges.tolist()))


def blocks(streams: Streams) -> Spans:
    """The whole bag in blocks."""
    count = max(1, int(streams.t[-1] // BLOCK))
    edges = [*(BLOCK * i for i in range(count)), float(streams.t[-1]) + 1e-6]
    return list(itertools.pairwise(edges))


def thinned(spans: Spans) -> Spans:
    """As many of the spans, evenly spread, as a fit needs: more would cost time and tell little."""
    every = sum(end - begin for begin, end in spans) / _ENOUGH
    if every <= 1.0:
        return spans
    count = round(len(spans) / every)
    return [spans[i * len(spans) // count] for i in range(count)]


class Judge:
    """Open-loop simulation on data that no fit has seen."""

    def __init__(
        self,
        problem: WindowedProblem,
        sensors: Values | None = None,
        likeliest: Hypothesis | None = None,
        left_out: Sequence[tuple[float, float]] = (),
    ) -> None:
        """``sensors``: the effects that were taken off the data, which are judged as recorded.

        ``likeliest``: a model that says how the noise of each window's first state grows. Squared
        errors then count in inverse proportion to the variance that noise gives them, of any model
        alike, and as much as ever where that is the noise of the velocity itself. Where a vehicle
        is not stable, they would tell how each window began, and nothing of a model.

        ``left_out``: when something begins, from and to [s]. From then on nothing can be predicted
        to the end of the window, which does not count."""
        self.problem, self._sensors = problem, sensors or {}
        self._counts = self._counted(left_out)
        self._guided, self.free = problem.guided, ~problem.guided  # axes (6,)
        self._limit = _FAILED * problem.measured.std(axis=0) + 1e-9
        std = np.maximum(problem.noise_std()[3:], _LEAST_NOISE * problem.measured.std(axis=0))
        self._noise, self._weight = std**2 + 1e-18, np.ones_like(problem.measured)
        if likeliest is not None:
            grown = problem.variance_of_errors(likeliest)
            self._weight = self._noise / (self._noise + grown)
        self._weight = self._weight[self._counts]
        chunk = (problem.times[self._counts] / CHUNK).astype(int)
        self._chunk = np.unique(chunk, return_inverse=True)[1]

    @property
    def count(self) -> Array:
        """(6,): of squared errors, as they count."""
        out: Array = self._weight.sum(axis=0)
        return out

    def squares(self, h: Hypothesis) -> Array:
        """Squared errors (N, 6) that count, and as they count; a simulation that fails is as far
        off as the motion is large."""
        error = np.abs(self._as_recorded(self.problem.errors(h)))[self._counts]
        capped: Array = np.where(error < self._limit, error, self._limit) ** 2
        return self._weight * capped

    def _as_recorded(self, error: Array) -> Array:
        """Errors (N, 6) of the corrected velocities as those of the recorded ones."""
        if not self._sensors:
            return error
        measured, none = self.problem.measured, np.zeros_like(error[:, :3])
        recorded, simulated = (
            sense(Reading(x[:, :3], x[:, 3:], none, none), self._sensors)
            for x in (measured, measured - error)
        )
        return np.hstack([recorded.linear - simulated.linear, error[:, 3:]])

    def rmse(self, h: Hypothesis) -> dict[str, float]:
        square = self.squares(h).sum(axis=0) / self.count
        error = np.where(self._guided, np.nan, np.sqrt(square))
        return dict(zip(VELOCITIES, error.tolist(), strict=True))

    def rmse_of_noise(self) -> Array:
        """What the errors (6,) are where nothing but noise is wrong."""
        out: Array = np.sqrt(self._noise / self._weight.mean(axis=0))
        return out

    def gain(self, before: Hypothesis, after: Hypothesis, axes: Sequence[str] = ()) -> Gain:
        """Of the component that gains most, of those that surely gain if any do. Where none surely
        gains, those of the ``axes`` on which an effect acts are looked at alone, as an interval for
        six components is wide, and then all of these together: a lag moves each a little."""
        free = np.flatnonzero(self.free)
        a, b = (self.summed(h) for h in (before, after))
        own = np.array([i for i in free if AXES[i] in axes], dtype=int)
        sets = [of for of in (free, own) if len(of)]
        gains = [
            gain_of([VELOCITIES[i] for i in of], a[:, of], b[:, of], self.count[of]) for of in sets
        ]
        found = next((g for g in gains if g.low > 0.0), gains[0])
        if found.low <= 0.0 and len(own) > 1:
            found = replace(found, together=together(a[:, own], b[:, own]))
        return found

    def gains_elsewhere(
        self, gain: Gain, before: Hypothesis, after: Hypothesis, axes: Sequence[str]
    ) -> bool:
        """Whether the ``gain`` of an effect is on an axis on which it does not act, and none of the
        ``axes`` on which it does gains nearly as much: heave that is right makes roll right, too.
        """
        own = [i for i in np.flatnonzero(self.free) if AXES[i] in axes]
        if gain.together is not None or AXES[VELOCITIES.index(gain.component)] in axes:
            return False
        if not own:
            return True
        a, b = (self.summed(h)[:, own] for h in (before, after))
        there = gain_of([VELOCITIES[i] for i in own], a, b, self.count[own])
        return there.low <= 0.0 or there.percent < _NEARLY * gain.percent

    def _counted(self, left_out: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
        """Which errors (N,) count: all where else none would."""
        e, out = self.problem, np.zeros(len(self.problem.times), dtype=bool)
        begins = e.steps.t[e.first][e.window]
        for begin, end in left_out:
            out |= (e.times >= begin) & (begins < end)
        return out if out.all() else ~out

    def better(self, rival: Hypothesis, h: Hypothesis) -> bool:
        """Whether a rival predicts better, all velocities taken together."""
        a, b = (self.summed(x)[:, self.free].sum(axis=0) for x in (rival, h))
        return bool(log_ratio(a, b).sum() < 0.0)

    def surely_better(self, rival: Hypothesis, h: Hypothesis) -> bool:
        """The same beyond chance."""
        a, b = (self.summed(x)[:, self.free] for x in (rival, h))
        return surely_less(a, b)

    def summed(self, h: Hypothesis) -> Array:
        """Squared errors (C, 6) summed over chunks of time."""
        return np.stack([np.bincount(self._chunk, x) for x in self.squares(h).T], axis=1)


def predicted(component: str) -> str:
    """What a velocity component's error is measured on, in words."""
    return f"{BLOCK:.0f} s prediction of {MOTIONS[component]}"


def improved(gain: Gain) -> str:
    """What a gain is of and how large, in words."""
    what = gain.component
    what = "agreement of the sensors" if what == "kinematic" else predicted(what)
    return f"{what} improves by {gain.percent:.0f} %"


def is_practical(gain: Gain) -> bool:
    """Whether a gain is sure, and large enough to matter."""
    part = judged(gain)
    return part.percent >= 100.0 * PRACTICAL and part.low > 0.0


def is_surely_practical(gain: Gain) -> bool:
    """Whether all of the gain's interval is large enough to matter."""
    return judged(gain).low >= 100.0 * PRACTICAL


def is_sure(gain: Gain) -> bool:
    """Whether predictions improve, be it by little."""
    return judged(gain).low > 0.0


def judged(gain: Gain) -> Gain | Together:
    """The part of a gain that decides about it."""
    return gain if gain.low > 0.0 or gain.together is None else gain.together


def gain_of(components: Sequence[str], before: Array, after: Array, count: float | Array) -> Gain:
    """Gain of one of K components, from squared errors summed over chunks of time, (C, K).

    The intervals come from resampled chunks and hold for all components at once: no deviation from
    its component's gain, in units of its spread, is larger in 95 % of the draws (Romano and Wolf
    2005). So the component that gains most of those that surely gain may be picked. ``count`` are
    the errors of each.
    """
    draws = _draws(len(before))
    change = log_ratio(after.sum(axis=0), before.sum(axis=0))
    drawn = log_ratio(draws @ after, draws @ before)
    std = drawn.std(axis=0) + 1e-12
    widest = np.quantile(np.abs((drawn - change) / std).max(axis=1), 0.95) * std
    percent, low, high = (
        100.0 * (1.0 - np.exp(0.5 * x)) for x in (change, change + widest, change - widest)
    )
    rmse = (np.sqrt(x.sum(axis=0) / count) for x in (before, after))
    best = int(np.argmax(np.where(low > 0.0, percent, -np.inf if (low > 0.0).any() else percent)))
    of = [float(x[best]) for x in (*rmse, percent, low, high)]
    return Gain(components[best], of[0], of[1], of[2], of[3], of[4])


def together(before: Array, after: Array) -> Together:
    """The gain of all components (C, K) together: one number, so nothing has been picked."""
    draws = _draws(len(before))
    change = log_ratio(after.sum(axis=0), before.sum(axis=0)).mean()
    drawn = log_ratio(draws @ after, draws @ before).mean(axis=1)
    widest = np.quantile(np.abs(drawn - change), 0.95)
    ends = change, change + widest, change - widest
    return Together(*(float(100.0 * (1.0 - np.exp(0.5 * x))) for x in ends))


def surely_less(a: Array, b: Array) -> bool:
    """Whether squared errors a are less than b, both summed over chunks of time (C, K), all
    components taken together: in 97.5 % of resampled chunks, one end of a 95 % interval."""
    draws = _draws(len(a))
    return bool(np.quantile(log_ratio(draws @ a, draws @ b).sum(axis=1), 0.975) < 0.0)


def _draws(chunks: int) -> NDArray[np.int64]:
    """How often each of so many chunks is in each draw of the bootstrap (_DRAWS, chunks)."""
    return np.random.default_rng(0).multinomial(chunks, np.full(chunks, 1.0 / chunks), _DRAWS)


def log_ratio(a: Array, b: Array) -> Array:
    """The logarithm of a / b, of squared errors that may be zero."""
    ratio: Array = np.log(np.maximum(a, 1e-300)) - np.log(np.maximum(b, 1e-300))
    return ratio
