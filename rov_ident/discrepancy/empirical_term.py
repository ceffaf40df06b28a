"""A term for what a fit leaves and no effect explains: a smooth function of one or two variables.

For each axis of the body and of the world all variables, and pairs of them, are scored on the
linearisation of the fit by a few polynomials; of the best few a penalised spline (Eilers and Marx
1996) is fitted, its smoothness by cross-validation over windows; that of a velocity may jump where
this changes its sign. The best becomes the effect ``empirical``: its shape then stays, and its
scale is a parameter like any other.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rov_ident.core.linalg import scaled_solve
from rov_ident.discrepancy.findings import of_attitude_errors
from rov_ident.discrepancy.hypothesis import Hypothesis
from rov_ident.discrepancy.linearisation import Linearisation, linearise
from rov_ident.discrepancy.output_error import Fitted, refit, solve_bounded, step_limits
from rov_ident.discrepancy.results import Finding, Residual
from rov_ident.discrepancy.windowed_problem import WindowedProblem
from rov_ident.effects import empirical as effect
from rov_ident.effects.empirical import ALONE, EACH, HEADING, NORTH, OF, ON, ROLL, THRUST, TIME
from rov_ident.model.coefficients import AXES, VELOCITIES
from rov_ident.model.equations import Array

NAME = "empirical"
SCALE = NAME, "scale"

_SURE = 2.5  # standard deviations of the mean gain over windows: by chance in one of 160 functions
# (normal, one-sided), of which six are fitted; held-out data then decide
_PLAINER = 0.9  # of what a function of two variables gains one of a single one is preferred
_FITTED = 3  # functions of one variable, and of two, that are fitted as splines; effort
_LEAST_PROGRESS = 0.99  # of the squared residuals; a round that leaves more is the last
_STEPS = 0.5 ** np.arange(6)  # of a change of all weights, until one leaves less
_ROUNDS = 8  # in which the shape follows the motion that a fit arrives at; effort
_FOLDS = 8  # of the cross-validation, each of pairs of windows
_SMOOTHNESS = 10.0 ** np.arange(-4.0, 3.5, 0.5)  # of the penalty, over the data's own information
_RIDGE = 1e-3  # of the penalty on the size of weights, over that on their second differences
_DEGREE = 5  # of polynomials in one variable; in each of two together 2


@dataclass(frozen=True)
class Shape:
    """A function on an axis of ON, of the variables OF[first] and, unless 0, OF[second]; ``ends``
    (2, 2) are their ranges."""

    axis: int
    first: int
    second: int
    ends: Array

    def constants(self, weights: Array) -> dict[tuple[str, str], float]:
        """The parameters of the effect but for its scale."""
        low, high = self.ends.T
        names = [p.name for p in effect.EFFECT.parameters[1:]]
        head = [self.axis, self.first, self.second, low[0], high[0], low[1], high[1]]
        values = np.zeros(len(names))
        values[: len(head)] = head
        values[len(head) : len(head) + len(weights)] = weights
        return {(NAME, n): v for n, v in zip(names, values.tolist(), strict=True)}

    def penalty(self) -> Array:
        """(n, n) of the weights: of second differences, and a little of their size."""
        if not self.second:
            rough = _roughness(ALONE, _wraps(self.first))
            if _may_jump(self.first):
                rough = np.pad(rough, (0, 1))
        else:
            one, two = (_roughness(EACH, _wraps(v)) for v in (self.first, self.second))
            rough = np.kron(one, np.eye(EACH)) + np.kron(np.eye(EACH), two)
        return rough + _RIDGE * np.eye(len(rough))


def _wraps(variable: int) -> bool:
    return variable in (HEADING, TIME)


def _may_jump(variable: int) -> bool:
    return 0 < variable < ROLL


def _roughness(count: int, wraps: bool) -> Array:
    second = np.eye(count) - 2.0 * np.roll(np.eye(count), 1, 1) + np.roll(np.eye(count), 2, 1)
    second = second if wraps else second[: count - 2]
    out: Array = second.T @ second
    return out


def found(problem: WindowedProblem, now: Fitted) -> Fitted | None:
    """The fit with the term that predicts windows left out best; None where none surely does."""
    best: tuple[float, Shape] | None = None
    scored = _scored(problem, now)
    both = [[s for s in scored if bool(s.second) == pair][:_FITTED] for pair in (False, True)]
    for shape in itertools.chain(*both):
        _, without, left = _penalised(problem, now, shape)
        gain = without - left
        # Also without the window that gains most: next to one that gains twenty times as much, the
        # gain of all others looks like scatter.
        of = gain, np.sort(gain)[:-1]
        sure = max(g.sum() / max(g.std(ddof=1) * np.sqrt(len(g)), 1e-9) for g in of)
        worth = float(gain.sum()) * (_PLAINER if shape.second else 1.0)
        if sure > _SURE and (best is None or worth > best[0]):
            best = worth, shape
    return None if best is None else _fitted(problem, now, best[1])


def described(of: Finding, h: Hypothesis) -> Finding:
    """The finding of a term with words of where it acts and what it depends on."""
    axis, first, second = (int(h.effects[NAME][n]) for n in ("axis", "first", "second"))
    variables = OF[first] + (f" and {OF[second]}" if second else "")
    words = f"On {ON[axis]} something without a name depends on {variables}. "
    return dataclasses.replace(of, sentence=words + of.sentence)


def residual(of: Finding, h: Hypothesis) -> Residual:
    """What the term stands for, as what is left is told: of one along an axis of the world, on the
    axis that gains most."""
    shape, gain = h.effects[NAME], of.gain
    period = shape["first_high"] if int(shape["first"]) == TIME else 0.0
    share = 1.0 - (gain.rmse_after / gain.rmse_before) ** 2
    on = ON[int(shape["axis"])]
    axis = on if on in AXES else AXES[VELOCITIES.index(gain.component)]
    return Residual(axis, OF[int(shape["first"])], 1.0 / period if period else None, share)


def best_dependences(problem: WindowedProblem, now: Fitted, axes: Sequence[int]) -> list[Residual]:
    """What the residuals on body axes, of which nothing is sure but that they are there, depend on
    best, the largest share first, of all squared residuals. If windows predict no others on any
    axis, the first one on time."""
    scored, found = _scored(problem, now), []
    for axis in axes:
        best = next((s for s in scored if s.axis == axis and not s.second), None)
        if best is None:
            continue
        _, without, left = _penalised(problem, now, best)
        share = 1.0 - float(left.sum() / without.sum())
        if share > 0.0:
            frequency = 1.0 / float(best.ends[0, 1]) if best.first == TIME else None
            found.append(Residual(AXES[axis], OF[best.first], frequency, share, sure=False))
    none = Residual(AXES[axes[0]], "time", None, 0.0, sure=False)
    return sorted(found, key=lambda r: -r.share) or [none]


def exceeds_errors_of_attitude(problem: WindowedProblem, fitted: Fitted) -> bool:
    """Whether the term of a fit is more than errors of the attitude make of the righting moment."""
    h = fitted.hypothesis
    force = problem.columns(h, fitted.linearisation.motion, [SCALE])[:, :, 0] * h.values[SCALE]
    return bool(np.any(np.sqrt(np.mean(force**2, axis=0)) > of_attitude_errors(h)))


def _fitted(problem: WindowedProblem, now: Fitted, shape: Shape) -> Fitted | None:
    """With a term of this shape; its weights follow the motion that the fit arrives at. The other
    parameters go along with them: what the term takes over, they no longer imitate."""
    best, weights, at = None, np.zeros(len(shape.penalty())), now
    for _ in range(_ROUNDS):
        start, weights = _moved(problem, at, shape, weights)
        there = start and refit(start.hypothesis, start)
        if not there:
            break
        if best is not None and there.rss > _LEAST_PROGRESS * best.rss:
            break
        best = at = there
        weights = weights * there.hypothesis.values[SCALE]
    return best


def _moved(
    problem: WindowedProblem, at: Fitted, shape: Shape, weights: Array
) -> tuple[Linearisation | None, Array]:
    """The next weights after those that a fit has, simulated with them; shorter steps where a whole
    one makes it worse."""
    change, *_ = _penalised(problem, at, shape, weights)
    h, line = at.hypothesis, at.linearisation
    keys = [k for k in h.keys if k != SCALE]
    values = np.array([h.values[k] for k in keys])
    for factor in _STEPS:
        moved = values + factor * change[: len(keys)]
        next_weights = weights + factor * change[len(keys) :]
        there = Hypothesis(
            h.config,
            {**dict(zip(keys, moved.tolist(), strict=True)), SCALE: 1.0},
            {**h.constants, **shape.constants(next_weights)},
        )
        start = linearise(problem, there, line.starts, at.noise)
        if start is not None and start.rss < at.rss:
            break
    return start, next_weights


# ------------------------------------------------------------------ variables and functions


def _values(problem: WindowedProblem, now: Fitted, variable: int, axis: int) -> Array:
    """A variable (K,) along the simulated motion, half-way through each step."""
    steps, nu = problem.steps, now.linearisation.motion.middle
    thrust = problem.thrust_of(now.hypothesis)[0]
    t = 0.5 * (steps.t[1:] + steps.t[:-1]) - steps.begin
    rows = zip(t, steps.position, nu, steps.middle, thrust, strict=True)
    return np.array([effect.variable(variable, axis, *row) for row in rows])


def _direction(problem: WindowedProblem, axis: int) -> Array:
    """Unit wrenches (K, 6) on an axis of ON."""
    k = len(problem.steps.position)
    if axis < 6:
        return np.tile(np.eye(6)[axis], (k, 1))
    return np.hstack([problem.steps.middle[:, axis - 6], np.zeros((k, 3))])


def _scored(problem: WindowedProblem, now: Fitted) -> list[Shape]:
    """Functions by what polynomials instead of them would take off the squared residuals, less two
    for each column (Akaike 1974), the best first."""
    line = now.linearisation
    has_pose, free = problem.streams.posed.all(), ~problem.guided
    own = {v: _values(problem, now, v, 0) for v in range(1, THRUST) if has_pose or not (
        NORTH <= v < THRUST
    )}  # fmt: skip

    def of_axis(axis: int) -> list[tuple[float, Shape]]:
        if not (free[axis] if axis < 6 else free[:3].all()):
            return []
        there = dict(own) if axis < 6 else {v: x for v, x in own.items() if v >= ROLL}
        if axis < 6:
            there[THRUST] = _values(problem, now, THRUST, axis)
        ends = {v: _ends(v, x) for v, x in there.items()}
        peaks = line.frequencies(1, axis if axis < 6 else None)
        if peaks:
            there[TIME], ends[TIME] = _values(problem, now, TIME, axis), np.array([0, 1 / peaks[0]])
        columns = {v: _polynomials(v, x, ends[v]) for v, x in there.items()}
        return _gains(line, axis, columns, ends, _direction(problem, axis))

    scores = itertools.chain(*problem.map(of_axis, range(len(ON))))
    return [shape for _, shape in sorted(scores, key=lambda s: -s[0])]


def _ends(variable: int, x: Array) -> Array:
    if variable == HEADING:
        return np.array([-np.pi, np.pi])
    low, high = float(x.min()), float(x.max())
    return np.array([low, max(high, low + 1e-6)])


def _polynomials(variable: int, x: Array, ends: Array) -> Array:
    """Columns (K, _DEGREE) of a variable: Chebyshev's, or sines; the first two also for pairs. A
    jump is one more."""
    y = (x - ends[0]) / (ends[1] - ends[0])
    if _wraps(variable):
        angles = 2.0 * np.pi * y[:, None] * [1, 1, 2, 2, 3]
        return np.where([True, False, True, False, True], np.sin(angles), np.cos(angles))
    angle = np.arccos(np.clip(2.0 * y - 1.0, -1.0, 1.0))
    smooth = np.cos(angle[:, None] * np.arange(1, _DEGREE + 1))
    return np.column_stack([smooth, _jumps(x, ends)]) if _may_jump(variable) else smooth


def _jumps(x: Array, ends: Array) -> Array:
    return np.array([effect.jump(value, *ends) for value in x])


def _gains(
    line: Linearisation, axis: int, columns: Mapping[int, Array], ends: Mapping[int, Array],
    direction: Array,
) -> list[tuple[float, Shape]]:  # fmt: skip
    """What each variable of an axis, and each pair, explains."""
    of: dict[tuple[int, int], list[int]] = {}
    forces: list[Array] = []
    for v, x in columns.items():
        of[v, 0] = list(range(len(forces), len(forces) + x.shape[1]))
        forces += list(x.T)
    for v, w in itertools.combinations(columns, 2):
        both = [a * b for a in columns[v].T[:2] for b in columns[w].T[:2]]
        of[v, w] = [*of[v, 0][:_DEGREE], *of[w, 0][:_DEGREE]]
        of[v, w] += range(len(forces), len(forces) + len(both))
        forces += both
    every = np.stack(forces, axis=1)
    s = line.sensitivity_to(direction[:, :, None] * every[:, None, :])
    base = line.columns
    s -= base @ _solved(base.T @ base, base.T @ s)
    normal, slope = s.T @ s, s.T @ line.error
    none, found = np.zeros(2), []
    for (v, w), at in of.items():
        gain = slope[at] @ _solved(normal[np.ix_(at, at)], slope[at]) - 2.0 * len(at)
        found.append((float(gain), Shape(axis, v, w, np.array([ends[v], ends.get(w, none)]))))
    return found


def _basis(problem: WindowedProblem, now: Fitted, shape: Shape) -> Array:
    """The splines (K, n) of a shape along the motion."""
    count, tables = EACH if shape.second else ALONE, []
    for v, (low, high) in zip((shape.first, shape.second), shape.ends, strict=True):
        if not v:
            break
        x, out = _values(problem, now, v, shape.axis), np.zeros((len(problem.steps.middle), count))
        for k, value in enumerate(x):
            i, weights = effect.splines(value, low, high, count, _wraps(v))
            out[k, np.arange(i, i + 4) % count] = weights
        tables.append(out)
    if len(tables) == 1:
        jumps = [_jumps(x, shape.ends[0])] if _may_jump(shape.first) else []
        return np.column_stack([*tables, *jumps])
    return np.einsum("ki,kj->kij", *tables).reshape(len(tables[0]), -1)


# ------------------------------------------------------------------ penalised fits


def _penalised(
    problem: WindowedProblem, now: Fitted, shape: Shape, before: Array | float = 0.0
) -> tuple[Array, Array, Array]:
    """How the parameters of a fit but for the scale change, and the weights from those ``before``;
    and the squared residuals of each window (W,), predicted by fits to other windows, without the
    term and with it."""
    line, basis = now.linearisation, _basis(problem, now, shape)
    direction = _direction(problem, shape.axis)
    s = line.sensitivity_to(direction[:, :, None] * basis[:, None, :])
    kept = [i for i, key in enumerate(now.hypothesis.keys) if key != SCALE]
    base, n = line.columns[:, kept], s.shape[1]
    rows = np.hstack([base, s])
    edges = [*line.first.tolist(), len(rows)]
    own = [rows[a:b] for a, b in itertools.pairwise(edges)]
    errors = [line.error[a:b] for a, b in itertools.pairwise(edges)]
    fold = np.arange(len(own)) // 2 % _FOLDS
    normals, slopes = np.zeros((_FOLDS, *2 * (rows.shape[1],))), np.zeros((_FOLDS, rows.shape[1]))
    for f, x, e in zip(fold, own, errors, strict=True):
        normals[f] += x.T @ x
        slopes[f] += x.T @ e
    normal, slope = normals.sum(axis=0), slopes.sum(axis=0)
    b = len(kept)
    rough, size = shape.penalty(), float(np.trace(normal[b:, b:])) / n
    weights = np.zeros(n) + before

    def left(smoothness: float | None) -> Array:
        """Squared residuals (W,) predicted by fits without the window's fold."""
        squares = np.empty(len(own))
        for f in range(_FOLDS):
            change = change_of(normal - normals[f], slope - slopes[f], smoothness)
            for w in np.flatnonzero(fold == f):
                squares[w] = np.sum((errors[w] - own[w][:, : len(change)] @ change) ** 2)
        return squares

    lower, upper = step_limits(now.hypothesis, [now.hypothesis.keys[i] for i in kept])
    free = np.full(n, np.inf)

    def change_of(
        normal: Array, slope: Array, smoothness: float | None, bounded: bool = False
    ) -> Array:
        if smoothness is None:
            return _solved(normal[:b, :b], slope[:b])
        whole, right = normal.copy(), slope.copy()
        whole[b:, b:] += smoothness * size * rough
        right[b:] -= smoothness * size * rough @ weights
        if bounded:
            return solve_bounded(whole, right, np.append(lower, -free), np.append(upper, free))
        return _solved(whole, right)

    tried = [left(x) for x in _SMOOTHNESS]
    best = int(np.argmin([x.sum() for x in tried]))
    change = change_of(normal, slope, float(_SMOOTHNESS[best]), bounded=True)
    return change, left(None), tried[best]


def _solved(normal: Array, right: Array) -> Array:
    """The solution of normal equations (n, n), held where the data say nothing."""
    size = np.diag(normal) + 1e-9 * float(np.trace(normal)) / max(len(normal), 1) + 1e-300
    return scaled_solve(normal, right, 1e-9, np.sqrt(size))
