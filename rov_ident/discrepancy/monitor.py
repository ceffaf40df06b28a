"""The live monitor: what a model may lack, watched while it runs; the cheap part of `explain`.

:class:`Monitor` cuts the samples of an estimator into windows (`live_windows`) and keeps the list
of suspicions. The score of an effect is what it takes off the squared residuals, beyond what
another choice of the estimated coefficients can, over the variance inflation. It becomes a warning
where it passes a penalty that allows for the number of effects tried, and explains a share that
matters.
"""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.jit import Compiler
from rov_ident.core.linalg import scaled_solve
from rov_ident.core.messages import Array
from rov_ident.discrepancy.held_out import WINDOW
from rov_ident.discrepancy.hypothesis import (
    COEFFICIENTS,
    Key,
    axis_of,
    bounds,
    effect_of,
    may_leave_null,
    role_of,
    unit_of,
)
from rov_ident.discrepancy.linearisation import LinearProblem
from rov_ident.discrepancy.live_windows import State, Sums, Task, Window, init, step, task_of
from rov_ident.discrepancy.selection import VERY_STRONG, Scores, regressed, variance_inflation
from rov_ident.discrepancy.windowed_problem import MAX_GAP
from rov_ident.effects import EFFECTS
from rov_ident.estimation.compilation import any_vehicle
from rov_ident.model.coefficients import AXES, MOTIONS, parse
from rov_ident.sampling.sample import SAMPLE, joined

FEWEST = 12  # windows, from which on their scatter is known to about 40 % (chi-squared)

ALARM = 1e-4
"""How often chance may raise a false alarm from a memory full of windows with nothing missing."""

# Practical weight, set so that clean bags stay silent: table of false alarms in docs/live.md.
SHARE = 0.5  # of the residual's mean power in one of six components that an effect must explain
SMALLEST = 0.2  # of the size at which it matters: less is what the attitude is off by

_ERRORS = 0.5  # of the information on a parameter that errors of the smoothed wrench may be
_AS_GOOD = 0.8  # of what the best explains: a rival, as second order may make up the difference
_ALIKE = 0.9  # of what the best explains: named instead, if it has fewer parameters
_AXIS_SHARE = 0.3  # of the squared wrench on the strongest axis: acts on this one, too
_MOST = 3  # effects named at once: the rest shows when these are in the model
_FITTED = 12  # units that are scored in full; effort
_COLLINEAR = 1e-4  # smallest eigenvalue of what the base leaves of a unit: four digits


@dataclass(frozen=True)
class Suspicion:
    """An effect that the model seems to lack, or one of ``rivals`` that these data cannot tell: the
    ``axes`` (letters of XYZKMN) where it shows most, a linear estimate of its ``parameters``, what
    it takes off the scaled squared residuals (``score``) and what that must exceed (``penalty``),
    and what it explains over the mean power of a component of the residual (``share``)."""

    effect: str
    axes: str
    parameters: Mapping[str, float]
    units: Mapping[str, str]
    score: float
    penalty: float
    share: float
    rivals: tuple[str, ...]
    sentence: str

    @property
    def keys(self) -> list[Key]:
        section = COEFFICIENTS if EFFECTS[self.effect].coefficients else self.effect
        return [(section, name) for name in self.parameters]


def suspicions(task: Task, state: State) -> list[Suspicion]:
    """What the remembered windows say is missing, the plainest first; empty when nothing is."""
    if len(state.windows) < FEWEST:
        return []
    memory = _Memory(task, state.windows, [w.sums for w in state.windows])
    chosen: list[Key] = []
    found: list[Suspicion] = []
    units = list(task.units)
    while len(found) < _MOST and (best := memory.best(chosen, units)) is not None:
        found.append(best)
        chosen += best.keys
        # To second order the remainder of an effect looks like others: only its own axes follow.
        units = [u for u in units if effect_of(u[0]) == best.effect and u[0] not in chosen]
    found = [s for s in found if memory.holds_without_best_window(s.keys, chosen)]
    doubts = [w.doubt for w in state.windows]
    if all(d is None for d in doubts):
        return found
    # smoothing lends the commands what is missing, and what is lent proves nothing
    sums = [w.sums if d is None else d.as_read for w, d in zip(state.windows, doubts, strict=True)]
    as_read = _Memory(task, state.windows, sums)
    errors = np.sum([d.errors for d in doubts if d is not None], axis=0)
    found = [s for s in found if memory.are_seen(s.keys, chosen, errors)]
    return [s for s in found if as_read.holds_without_best_window(s.keys, chosen)]


def penalty(size: int, tried: int) -> float:
    """What ``size`` parameters must take off the scaled squared residuals.

    Chance makes it x with a probability of at most exp(-(x - size) / 2) (x / size)^(size / 2)
    (Chernoff 1952), and that ``tried`` times.
    """
    x = 0.0
    for _ in range(50):
        x = size + size * np.log(max(x, size) / size) + 2.0 * np.log(tried / ALARM)
    return float(x)


class _Trial(NamedTuple):
    """Watched parameters, estimated from their nulls, and the linear problem with them."""

    unit: tuple[Key, ...]
    change: Array
    after: LinearProblem

    @property
    def effect(self) -> str:
        return effect_of(self.unit[0])

    @property
    def has_onset(self) -> bool:
        section = self.unit[0][0]
        return section in EFFECTS and any(p.role == "onset" for p in EFFECTS[section].parameters)


class _Memory:
    """The sum of windows; ``linear`` is their problem with all parameters at zero."""

    def __init__(self, task: Task, windows: Sequence[Window], sums: Sequence[Sums]) -> None:
        self.task, count = task, sum(w.residuals for w in windows)
        self.normals, moments, powers = map(np.array, zip(*sums, strict=True))
        keys = (*task.base, *task.watched)
        self.linear = LinearProblem(keys, self.normals.sum(axis=0), moments, powers, count)
        self.strength = np.sum([w.strength for w in windows], axis=0)

    def solve(self, extra: Sequence[Key]) -> tuple[Array, LinearProblem]:
        """The best values (B + E,) of base and extra, and the linear problem there."""
        b, keys, whole = len(self.task.base), (*self.task.base, *extra), self.linear
        at = whole.index(keys)
        prior = np.zeros(len(at))
        prior[:b] = 1e-6 * self.task.prior  # wide: only what no data reach is held by it
        moments = whole.gradient[:, at]
        n, m = whole.normal[np.ix_(at, at)] + np.diag(prior), moments.sum(axis=0)
        m[:b] += prior[:b] * self.task.centre
        value = scaled_solve(n, m, 1e-9)
        gradient = moments - self.normals[:, at[:, None], at] @ value
        rss = np.maximum(whole.rss - (moments + gradient) @ value, 0.0)
        return value, LinearProblem(keys, n, gradient, rss, whole.count)

    def best(self, chosen: list[Key], units: Sequence[tuple[Key, ...]]) -> Suspicion | None:
        """The unit most worth adding to the chosen parameters, with those that do as well."""
        _, before = self.solve(chosen)
        rss = float(before.rss.sum())
        trials = self._trials(chosen, units, penalty(1, len(self.task.units)) * rss / before.count)
        if not trials:
            return None
        several = [*trials, *self._whole_effects(chosen, trials)]
        after = min((t.after for t in several), key=lambda a: a.rss.sum())
        inflation = variance_inflation(after, np.arange(len(after.keys)))
        taken = {t.unit: rss - float(t.after.rss.sum()) for t in several}
        asked = {u: penalty(len(u), len(self.task.units)) for u in taken}
        worth = {u: taken[u] / inflation - asked[u] for u in taken}
        # the plainest of those that explain about as much
        most = max(several, key=lambda t: worth[t.unit]).unit
        alike = [t for t in several if taken[t.unit] >= _ALIKE * taken[most]]
        whole = min(alike, key=lambda t: (len(t.unit), t.has_onset, -worth[t.unit])).unit
        best = max((t for t in trials if set(t.unit) <= set(whole)), key=lambda t: worth[t.unit])
        score, share = taken[best.unit] / inflation, 6.0 * taken[best.unit] / rss
        if score < asked[best.unit] or share < SHARE:
            return None
        others = dict.fromkeys(
            t.effect
            for t in trials
            if worth[whole] - worth[t.unit] < VERY_STRONG or taken[t.unit] > _AS_GOOD * taken[whole]
        )
        others.pop(best.effect, None)
        return self._suspicion(best, float(score), asked[best.unit], float(share), tuple(others))

    def _trials(
        self, chosen: list[Key], units: Sequence[tuple[Key, ...]], least: float
    ) -> list[_Trial]:
        """The units that take at least so much off the squared residuals, and are of a size that
        matters, within their bounds."""
        trials = []
        for unit in self._promising(chosen, units, least):
            trial = self._trial(chosen, unit)
            amplitudes = [
                x for x in zip(unit, trial.change, strict=True) if role_of(x[0]) != "place"
            ]
            matters = np.abs(trial.change / [self.task.sizes[key] for key in unit]).max() > SMALLEST
            if matters and all(may_leave_null(bounds(key), delta) for key, delta in amplitudes):
                trials.append(trial)
        return trials

    def _trial(self, chosen: list[Key], unit: tuple[Key, ...]) -> _Trial:
        value, after = self.solve([*chosen, *unit])
        return _Trial(unit, value[-len(unit) :], after)

    def _suspicion(
        self, best: _Trial, score: float, asked: float, share: float, rivals: tuple[str, ...]
    ) -> Suspicion:
        axes, values, first = self._axes(best), {}, float(best.change[0])
        for key, change in zip(best.unit, best.change.tolist(), strict=True):
            values[key[1]] = bounds(key)[0] + change
            if role_of(key) == "place":
                values[key[1]] = change / first if first else 0.0
        units = {key[1]: unit_of(key) for key in best.unit}
        sentence = _sentence(best.unit[0], axes, (best.effect, *rivals))
        return Suspicion(best.effect, axes, values, units, score, asked, share, rivals, sentence)

    def holds_without_best_window(self, keys: Sequence[Key], chosen: Sequence[Key]) -> bool:
        """Whether parameters pass their penalty without the window that speaks most for them, all
        the others that are ``chosen`` in place: a gust or a knock fills one window."""
        rest = [k for k in chosen if k not in keys]
        _, before = self.solve(rest)
        _, after = self.solve([*rest, *keys])
        taken = before.rss - after.rss
        inflation = variance_inflation(after, np.arange(len(after.keys)))
        asked = penalty(len(keys), len(self.task.units))
        return bool(taken.sum() - taken.max() > asked * inflation)

    def are_seen(self, keys: Sequence[Key], chosen: Sequence[Key], errors: Array) -> bool:
        """Whether most of the information on parameters, the others refitted along, is of motion
        and commands, and not of their ``errors`` (P, P): of these how large they are is known
        only to some tenths."""
        rest = self.linear.index([*self.task.base, *(k for k in chosen if k not in keys)])
        at = self.linear.index(keys)
        turned = np.zeros((len(self.linear.keys), len(at)))
        turned[at] = np.eye(len(at))
        turned[rest] = -regressed(self.linear.normal, rest, at)
        ours, theirs = (np.diag(turned.T @ m @ turned) for m in (self.linear.normal, errors))
        return bool((theirs < _ERRORS * ours).all())

    def _whole_effects(self, chosen: list[Key], trials: Sequence[_Trial]) -> list[_Trial]:
        """All units of an effect that has several, to be compared with effects of one unit."""
        effects = dict.fromkeys(t.effect for t in trials)
        several = [[t.unit for t in trials if t.effect == effect] for effect in effects]
        return [self._trial(chosen, sum(own, ())) for own in several if len(own) > 1]

    def _promising(
        self, chosen: Sequence[Key], units: Sequence[tuple[Key, ...]], least: float
    ) -> list[tuple[Key, ...]]:
        """The units that take most off the squared residuals, and at least that much."""
        scores = Scores(self.linear, [*self.task.base, *chosen])
        size = np.sqrt(np.maximum(np.diag(self.linear.normal), 1e-30))
        gains = []
        for unit in units:
            own = size[self.linear.index(unit)]
            left = np.linalg.eigvalsh(scores.left_of(unit) / np.outer(own, own))[0]
            gains.append(scores.solve(unit)[1] if left >= _COLLINEAR else 0.0)
        order = np.argsort(gains)[::-1][:_FITTED]
        return [units[i] for i in order if gains[i] > least]

    def _axes(self, trial: _Trial) -> str:
        """Where a unit acts: as its name says, or where it moves the vehicle most."""
        own = [axis_of(key) for key in trial.unit]
        if all(own):
            return "".join(dict.fromkeys(own))
        at = self.linear.index(trial.unit) - len(self.task.base)
        strength = self.strength[:, at] @ trial.change**2
        return "".join(AXES[i] for i in np.flatnonzero(strength > _AXIS_SHARE * strength.max()))


def _sentence(key: Key, axes: str, effects: Sequence[str]) -> str:
    where = " and ".join(MOTIONS[AXES.index(a)] for a in axes)
    names = " or ".join(effect.replace("_", " ") for effect in effects)
    return f"residual in {where} follows {_dependence(key)}: {names} missing?"


def _dependence(key: Key) -> str:
    """What the residual follows, as a pilot would say or write it."""
    section, name = key
    if section != COEFFICIENTS:
        return _FOLLOWS[EFFECTS[section].place]
    c = parse(name)
    return f"the acceleration in {MOTIONS[c.column]}" if c.is_added_mass else c.formula


_FOLLOWS = {"input": "the thrust", "wrench": "attitude, motion or heading", "motion": "the heading"}


class Monitor:
    """Cuts samples into windows and keeps the suspicions up to date: what a node asks for. ``run``
    calls a function with its arguments, now or later (a thread's ``submit``), in their order."""

    def __init__(self, config: Config, run: Callable[..., object] | None = None) -> None:
        self._run = run or (lambda function, *arguments: function(*arguments))
        self._task = task_of(config)
        self._samples: list[NDArray[np.void]] = []
        self._demands: list[tuple[float, Array]] = []
        self._begin = np.nan
        self._forget()

    def reset(self) -> None:
        self._samples.clear()
        self._demands.clear()
        self._run(self._forget)

    def _forget(self) -> None:
        self._state = init(self._task)
        self.suspicions: list[Suspicion] = []

    def take(
        self, samples: NDArray[np.void], demands: list[tuple[float, Array]]
    ) -> tuple[NDArray[np.void], Array] | None:
        """Take samples (k,) and the commands so far, a list that is emptied; a full window."""
        self._demands += demands
        demands.clear()
        t = float(samples["t"][-1])
        if samples["restart"].any() and self._samples:
            # a lone outlier restarts the estimator's observer, but breaks no window
            steps = np.diff(samples["t"], prepend=self._samples[-1]["t"][-1])
            back = np.flatnonzero(steps < 0.0)
            if len(back) or not (steps[samples["restart"]] <= MAX_GAP).all():
                self._samples.clear()
            if len(back):  # a bag that starts again, say: what was before is of another time
                samples = samples[back[-1] :]
                self._demands = _latest(self._demands, t)
        if not self._samples:
            self._begin = float(samples["t"][0])
            self._keep_demands_from(self._begin - WINDOW)
        self._samples.append(samples)
        if t - self._begin < WINDOW:
            return None
        rows = joined(self._samples)
        told = np.array([[at, *wrench] for at, wrench in self._demands]).reshape(-1, 7)
        # a window begins at the last sample of the one before
        self._samples, self._begin = [rows[-1:]], t
        self._keep_demands_from(t - WINDOW)  # a lag remembers those before the window
        return rows, told

    def _keep_demands_from(self, t: float) -> None:
        """Forget the commands before the one that holds at t [s]."""
        first = bisect_right(self._demands, t, key=itemgetter(0)) - 1
        self._demands = self._demands[max(first, 0) :]

    def look(
        self, window: tuple[NDArray[np.void], Array], values: Mapping[str, float], credible: bool
    ) -> None:
        """Judge a window by the coefficients as they are now, when there is time for it.

        Nothing is named unless they are ``credible``: what is left over where thrust, trim or
        current are taken for what they cannot be, or before any motion has judged what was learnt,
        is not what the model lacks.
        """
        self._run(self._judge, *window, values, credible)

    def _judge(
        self, samples: NDArray[np.void], demands: Array, values: Mapping[str, float], credible: bool
    ) -> None:
        self._state = step(self._task, self._state, samples, demands, values)
        self.suspicions = suspicions(self._task, self._state) if credible else []


def _latest(demands: list[tuple[float, Array]], t: float) -> list[tuple[float, Array]]:
    """Those after the last jump backwards of their clock, which is ``t`` now."""
    for i in range(len(demands) - 1, 0, -1):
        if demands[i][0] < demands[i - 1][0]:
            return demands[i:]
    return [demand for demand in demands if demand[0] <= t]


def compiler() -> Compiler:
    """What compiles all that the monitor runs."""
    return Compiler(exercise)


def exercise() -> None:
    """One window of a vehicle at rest goes through everything."""
    config = any_vehicle()
    rest = np.zeros(101, dtype=SAMPLE)
    rest["t"] = np.linspace(0.0, WINDOW, len(rest))
    rest["measured"], rest["orientation"][:, 0], rest["down"][:, 2] = True, 1.0, 1.0
    task = task_of(config)
    step(task, init(task), rest, np.zeros((1, 7)), {"X_u": -1.0})
