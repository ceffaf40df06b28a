"""Forces and moments without a known cause, as functions of motion, position and time.

A pattern is a force or moment on one axis as a smooth function of one variable. Patterns compete
with the effects of the library: where one of them explains more than any effect, what is missing
has no name here, but an axis and a dependence.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rov_ident.core.linalg import interpolated, scaled_solve
from rov_ident.discrepancy.hypothesis import UNKNOWN, Key, bounds, effect_of
from rov_ident.discrepancy.linearisation import Linearisation
from rov_ident.discrepancy.multiple_shooting import Steps
from rov_ident.discrepancy.output_error import Fitted, refit
from rov_ident.discrepancy.screening import Candidate
from rov_ident.discrepancy.selection import PENALTY, scores_of
from rov_ident.discrepancy.windowed_problem import WindowedProblem
from rov_ident.model.coefficients import AXES, VELOCITIES
from rov_ident.model.equations import Array

INTERPLAY = "all|thrust of other axes"
_KNOTS = 12.0  # s between the knots of a function of time
_MOST_KNOTS = 40  # in eight minutes; of longer records only what changes more slowly is seen

# Effort: the times and rates in docs/explain-bench.md were measured with these.
_SCORED = 10  # patterns of which stepwise selection is made, of some 75
_REFITS = 4  # of a pattern whose columns follow the motion that the fit arrives at
_LEAST_PROGRESS = 0.98  # of the squared residuals; less progress ends the refits
_TRIED = 2  # patterns that are fitted


@dataclass(frozen=True)
class Pattern:
    """Columns (K, C), functions of one variable, on one axis (0 .. 5) of the body, or of the world
    as seen from the body (``direction`` (K, 3)); ``frequency`` [Hz] of a sinusoid in time."""

    axis: int
    depends_on: str
    columns: Array
    direction: Array | None = None
    frequency: float | None = None

    @property
    def keys(self) -> list[Key]:
        own = f"{AXES[self.axis]}|{self.depends_on}|{self.frequency or ''}"
        return [(UNKNOWN, f"{own}|{i}") for i in range(self.columns.shape[1])]

    def force(self) -> Array:
        out = np.zeros((len(self.columns), 6, self.columns.shape[1]))
        if self.direction is None:
            out[:, self.axis] = self.columns
        else:
            out[:, :3] = self.direction[:, :, None] * self.columns[:, None, :]
        return out


class PatternSearch:
    """Patterns along the motion of fits on the windows of a problem."""

    def __init__(self, problem: WindowedProblem) -> None:
        self._problem = problem

    def screen(self, now: Fitted) -> list[tuple[Candidate, Pattern]]:
        """Patterns that would explain something, the best first: all are ranked by what they would
        explain with all their columns; of the first few, columns are selected."""
        tried = self.patterns(now)
        penalty = choice_penalty(tried)
        gains = self._problem.map(lambda p: _gain(now.linearisation, p), tried)
        ranked = [tried[i] for i in np.argsort(-np.array(gains), kind="stable")]
        found = []
        for pattern in ranked[:_SCORED]:
            values, score = _selected(now, pattern)
            if values and score > penalty:
                name, rest = effect_of(next(iter(values))), score - penalty
                found.append((Candidate(name, values, rest, rest), pattern))
        return sorted(found, key=lambda f: -f[0].score)

    def fits(self, now: Fitted) -> dict[str, Fitted]:
        """With each of the first patterns, by their names."""
        screened = self.screen(now)[:_TRIED]
        fits = self._problem.map(lambda s: self._fit(now, *s), screened)
        return {c.name: f for (c, _), f in zip(screened, fits, strict=True) if f is not None}

    def _fit(self, now: Fitted, candidate: Candidate, pattern: Pattern) -> Fitted | None:
        """With a pattern; its columns follow the motion that the fit arrives at."""
        best: Fitted | None = None
        h, start = now.hypothesis.having(candidate.start), now.linearisation
        for _ in range(_REFITS):
            self.adopt(pattern)
            fit = refit(h, start)
            if fit is None or (best is not None and fit.rss > _LEAST_PROGRESS * best.rss):
                break
            best, start = fit, fit.linearisation
            if pattern.frequency:
                break
            pattern = next(p for p in self.patterns(best) if p.keys[0] == pattern.keys[0])
            h = best.hypothesis.having(_selected(best, pattern)[0])
        return best

    def patterns(self, now: Fitted) -> list[Pattern]:
        """Patterns along the simulated motion: the measured one has the residual's noise in it."""
        streams, steps = self._problem.streams, self._problem.steps
        middle = 0.5 * (steps.t[1:] + steps.t[:-1])
        position = None
        if streams.posed.all():
            position = interpolated(streams.t, streams.position, middle)
        found = list(_smooth(steps, position, now.linearisation.motion.middle))
        for axis in range(6):
            for frequency in now.linearisation.frequencies(1, axis):
                angle = 2.0 * np.pi * frequency * middle
                waves = np.stack([np.cos(angle), np.sin(angle)], axis=1)
                found.append(Pattern(axis, "time", waves, frequency=frequency))
        return [p for p in found if not self._problem.guided[p.axis]]

    def interplay(self, now: Fitted) -> Fitted | None:
        """With thrust along one axis that depends on the thrust along others: what the supply
        lacks, all thrusters lack, and one at an angle loses thrust with the speed along it, for
        whichever axis it works (Fossen 2021, sec. 9.5). A propeller that pushes less astern than
        ahead turns some of what is commanded along one axis into thrust along others, to the same
        side whichever way it is commanded. Which thrusters these are no wrench tells.
        """
        thrust, nu = (self._problem.thrust_of(now.hypothesis)[0], now.linearisation.motion.middle)
        scale = [np.maximum(np.sqrt(np.mean(x**2, axis=0)), 1e-6) for x in (thrust, nu)]
        load = np.abs(thrust) / scale[0]
        force = np.zeros((*thrust.shape, 18, 6))
        for i in np.flatnonzero(~self._problem.guided).tolist():
            force[:, i, i] = thrust[:, i : i + 1] * load
            force[:, i, 6 + i] = nu[:, i : i + 1] / scale[1][i] * load * scale[0][i]
            force[:, i, 12 + i] = load * scale[0][i]
        force = force.reshape(len(thrust), 6, -1)
        force = force[:, :, force.any(axis=(0, 1))]
        if not force.size:  # with all that is commanded within a dead band, say
            return None
        keys: list[Key] = [(UNKNOWN, f"{INTERPLAY}|{i}") for i in range(force.shape[2])]
        sensitivity = now.linearisation.sensitivity_to(force)
        scores = scores_of(now.linearisation, keys, sensitivity)
        found = scores.select([(k,) for k in keys], bounds)[0]
        self._problem.patterns |= {key: force[:, :, i] for i, key in enumerate(keys)}
        start = dict(zip(found.keys, found.change.tolist(), strict=True))
        return refit(now.hypothesis.having(start), now.linearisation) if start else None

    def adopt(self, pattern: Pattern) -> None:
        """Make the parameters of a pattern known to the problem."""
        force = pattern.force()
        for i, key in enumerate(pattern.keys):
            self._problem.patterns[key] = force[:, :, i]


def choice_penalty(tried: Sequence[Pattern]) -> float:
    """What the best of so many must explain beyond one that was meant from the outset: the largest
    of n chi-squared numbers grows by 2 log n."""
    return 2.0 * float(np.log(max(len(tried), 1)))


def _selected(now: Fitted, pattern: Pattern) -> tuple[dict[Key, float], float]:
    """Columns of a pattern that are worth adding, with their first values, and their score as if
    the residuals that they leave were white."""
    linearisation = now.linearisation
    columns = [i for i, k in enumerate(pattern.keys) if k not in now.hypothesis.values]
    keys = [pattern.keys[i] for i in columns]
    if not keys:
        return {}, 0.0
    sensitivity = linearisation.sensitivity_to(pattern.force()[:, :, columns])
    units = [keys] if pattern.frequency else [(k,) for k in keys]
    found, _, white = scores_of(linearisation, keys, sensitivity).select(units, bounds)
    values = dict(zip(found.keys, found.change.tolist(), strict=True))
    return values, white - (PENALTY if pattern.frequency else 0.0)


def _gain(linearisation: Linearisation, pattern: Pattern) -> float:
    """What all columns of a pattern could take off the squared residuals, less two for each
    (Akaike 1974)."""
    columns = linearisation.sensitivity_to(pattern.force())
    linear = linearisation.having(pattern.keys, columns)
    known = len(linearisation.linear.keys)
    normal, slope = linear.normal, linear.gradient.sum(axis=0)
    whole = slope @ scaled_solve(normal, slope, 1e-6)
    base = slope[:known] @ scaled_solve(normal[:known, :known], slope[:known], 1e-6)
    return float(whole - base - 2.0 * columns.shape[1])


def _smooth(steps: Steps, position: Array | None, nu: Array) -> Iterator[Pattern]:
    """Patterns along a motion: nu (K, 6) and, if known, position (K, 3), mid-step."""
    functions = dict(_functions(steps, nu))
    for axis in range(6):
        for variable, columns in functions.items():
            yield Pattern(axis, variable, columns)
    if position is None:
        return
    depth, x, y = (z[:, None] for z in _standard(position[:, [2, 0, 1]]).T)
    there = np.hstack([np.ones_like(x), x, y, x**2, x * y, y**2])
    for axis in (0, 1):
        yield Pattern(axis, "position", there, steps.middle[:, axis])
    yield Pattern(2, "depth", depth ** np.arange(5), steps.middle[:, 2])
    for axis in (3, 4, 5):
        yield Pattern(axis, "position", there)
        yield Pattern(axis, "depth", depth ** np.arange(4))


def _functions(steps: Steps, nu: Array) -> Iterator[tuple[str, Array]]:
    z = nu / np.maximum(np.sqrt(np.mean(nu**2, axis=0)), 1e-6)
    for i, name in enumerate(VELOCITIES):
        others, own = np.delete(z, i, axis=1), z[:, i : i + 1]
        a, sign = np.abs(own), own / np.sqrt(own**2 + 0.01)
        powers = [own, a * own, own**2, own**3, a, sign * np.sqrt(a), sign]
        yield name, np.hstack([*powers, own * others, own * np.abs(others), a * others])
    r = steps.middle
    heading = np.arctan2(r[:, 1, 0], r[:, 0, 0])
    waves = [np.sin(heading), np.cos(heading), np.sin(2.0 * heading), np.cos(2.0 * heading)]
    yield "heading", np.stack(waves, axis=1)
    roll = np.arctan2(r[:, 2, 1], r[:, 2, 2])
    pitch = -np.arcsin(np.clip(r[:, 2, 0], -1.0, 1.0))
    tilt = _standard(np.stack([roll, pitch], axis=1))
    yield "roll", tilt[:, :1] ** np.arange(4)
    yield "pitch", tilt[:, 1:] ** np.arange(4)
    t = 0.5 * (steps.t[1:] + steps.t[:-1])
    count = int(np.clip((t[-1] - t[0]) / _KNOTS, 3, _MOST_KNOTS))
    knots = np.linspace(t[0], t[-1], count)  # of piecewise linear functions
    yield "time", np.stack([np.interp(t, knots, row) for row in np.eye(count)], axis=1)


def _standard(x: Array) -> Array:
    """Columns with mean zero and standard deviation one."""
    out: Array = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-6)
    return out
