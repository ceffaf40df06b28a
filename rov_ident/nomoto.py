"""Nomoto's steering model from zigzag tests: heading psi as the response to the rudder delta.

First and second order (Nomoto 1957), with Norrbin's cubic term (Norrbin 1963)::

    T r' + r + n3 r^3 = K (delta - delta_0)
    T1 T2 r'' + (T1 + T2) r' + r + n3 r^3 = K (delta - delta_0) + K T3 delta',    psi' = r

K has the sign of the data: with SNAME axes a rudder of positive angle that turns the vehicle to
port (Prestero's N_uudr < 0) gives K < 0. ``delta_0`` is the rudder angle that keeps the course.
Inside, the model is written so that it stays regular for a vehicle without course stability (T
infinite or negative)::

    x1' = -a1 x1 + x2 + b1 (delta - delta_0)        first order: x1' = -a0 x1 - c x1^3 + b0 (...)
    x2' = -a0 x1 - c x1^3 + b0 (delta - delta_0)    r = x1

Four estimators: output error (`oe`: the simulated heading is fitted, first state estimated; white
heading noise does not bias it), forward differences (`fd`: the equation itself, least squares, as
in the literature on sparse zigzags), the same with instruments (`iv`) and recursive (`rls`).
"""

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from rov_ident import densify
from rov_ident.errors import UserError
from rov_ident.jit import kernel
from rov_ident.messages import Array
from rov_ident.model import Model
from rov_ident.result import Result, provenance
from rov_ident.zigzag import Zigzag

METHODS = ("oe", "fd", "iv", "rls")
STEP = 0.05  # s, largest of the integration
MOST_JUMPS = 200  # of a rudder, beyond which their instants are not estimated
_DIVERGED = 1e10  # rad2, the cost of a simulation that left all reason
_MIN_SAMPLES = 20


@dataclass(frozen=True, kw_only=True)
class Nomoto(Result):
    """A fitted model. Its numbers are K, T (and T1 T2 T3, n3, delta_0); T1 and T2 are left out
    where they are complex.

    ``theta`` (n,) is what was fitted: order 1 ``a0 b0 [c] delta_0``, order 2 ``a0 a1 b0 b1 [c]
    delta_0``, see the head of the module. ``unit`` is that of the input.
    """

    order: int
    nonlinear: bool
    theta: Array
    unit: str
    rmse: float  # rad, of the heading
    histories: Array | None = None  # (k, n) of theta, of the recursive estimator


def _model(
    order: int, nonlinear: bool, estimator: str, theta: Array, covariance: Array, unit: str,
    rmse: float, histories: Array | None = None,
) -> Nomoto:  # fmt: skip
    """The result that theta (n,) with its covariance (n, n) makes, by linear propagation."""
    functions = {
        name: (function, of)
        for name, (function, of) in _functions(order, nonlinear, unit).items()
        if np.isfinite(function(theta))
    }
    slopes = np.array([_gradient(function, theta) for function, _ in functions.values()])
    return Nomoto(
        estimator=estimator,
        names=tuple(functions),
        units=tuple(of for _, of in functions.values()),
        values=np.array([function(theta) for function, _ in functions.values()]),
        covariance=slopes @ covariance @ slopes.T,
        order=order,
        nonlinear=nonlinear,
        theta=theta,
        unit=unit,
        rmse=rmse,
        histories=histories,
    )


def _functions(
    order: int, nonlinear: bool, unit: str
) -> dict[str, tuple[Callable[[Array], float], str]]:
    """The numbers that theta stands for, and their units."""
    names = _names(order, nonlinear)
    b0, off = names.index("b0"), names.index("delta_0")
    rate = "1/s" if unit == "rad" else "rad/(s N m)"
    found: dict[str, tuple[Callable[[Array], float], str]] = {"K": (lambda x: x[b0] / x[0], rate)}
    if order == 1:
        found["T"] = (lambda x: 1.0 / x[0], "s")
    else:
        found["T"] = (lambda x: x[1] / x[0] - x[3] / x[b0], "s")
        found["T1"] = (lambda x: _root(x[0], x[1], 1.0), "s")
        found["T2"] = (lambda x: _root(x[0], x[1], -1.0), "s")
        found["T3"] = (lambda x: x[3] / x[b0], "s")
        found["T1T2"] = (lambda x: 1.0 / x[0], "s2")
        found["T1_plus_T2"] = (lambda x: x[1] / x[0], "s")
    if nonlinear:
        c = names.index("c")
        found["n3"] = (lambda x: x[c] / x[0], "s2/rad2")
    found["delta_0"] = (lambda x: x[off], unit)
    return found


def _root(a0: float, a1: float, sign: float) -> float:
    """T1 (sign +) or T2 (-) with T1 T2 = 1/a0 and T1 + T2 = a1/a0; NaN where they are complex."""
    square = (a1 / a0) ** 2 - 4.0 / a0
    return float(0.5 * (a1 / a0 + sign * np.sqrt(square))) if square >= 0.0 else float("nan")


def _gradient(function: Callable[[Array], float], x: Array) -> Array:
    out = np.zeros(len(x))
    for i in range(len(x)):
        d = np.zeros(len(x))
        d[i] = 1e-6 * max(abs(x[i]), 1e-3)
        out[i] = (function(x + d) - function(x - d)) / (2.0 * d[i])
    return out


def _names(order: int, nonlinear: bool) -> tuple[str, ...]:
    linear = ("a0", "b0") if order == 1 else ("a0", "a1", "b0", "b1")
    return (*linear, *(("c",) if nonlinear else ()), "delta_0")


def to_json(model: Nomoto, validation: float | None = None) -> str:
    """The result as JSON; ``validation`` is the heading RMSE [rad] on another run."""
    document: dict[str, object] = {
        "order": model.order,
        **model.entries(),
        "heading_rmse_rad": model.rmse,
        "nonlinear": model.nonlinear,
        "method": model.estimator,
        "notes": list(model.notes),
        "provenance": model.provenance,
    }
    if validation is not None:
        document["validation"] = {"heading_rmse_rad": validation}
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


# ------------------------------------------------------------------ simulation


@kernel
def _respond(order, a0, a1, b0, b1, c, bias, t, rudder, held, first, max_step, out):  # type: ignore[no-untyped-def]
    """Classical Runge-Kutta; out (n,) the heading, from first = [psi, x1, x2]."""
    psi, x1, x2 = first[0], first[1], first[2]
    n = len(t)
    out[0] = psi
    for i in range(n - 1):
        span = t[i + 1] - t[i]
        steps = max(1, int(np.ceil(span / max_step - 1e-9)))
        h = span / steps
        slope = 0.0 if held else (rudder[i + 1] - rudder[i]) / span
        for s in range(steps):
            p1 = p2 = p3 = 0.0
            k0 = k1 = k2 = 0.0
            for stage in range(4):
                ahead = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
                y1, y2 = x1 + ahead * k1, x2 + ahead * k2
                d = rudder[i] + slope * (s * h + ahead) - bias
                k0 = y1
                if order == 1:
                    k1 = -a0 * y1 - c * y1 * y1 * y1 + b0 * d
                    k2 = 0.0
                else:
                    k1 = -a1 * y1 + y2 + b1 * d
                    k2 = -a0 * y1 - c * y1 * y1 * y1 + b0 * d
                weight = h / 6.0 if stage == 0 or stage == 3 else h / 3.0
                p1 += weight * k0
                p2 += weight * k1
                p3 += weight * k2
            psi += p1
            x1 += p2
            x2 += p3
        if not abs(x1) < 1e3:
            out[i + 1 :] = 1e6
            return
        out[i + 1] = psi


def respond(
    order: int,
    nonlinear: bool,
    theta: Array,
    run: Zigzag,
    first: Array,
    shares: Array | None = None,
) -> Array:
    """The simulated heading (n,) [rad] of a run from its first state [psi, x1, x2].

    The rudder is linear between the rows, or where the run says so, held. ``shares`` (j,) from 0
    to 1 says when within its step each of ``run.reversals`` came about.
    """
    x = dict(zip(_names(order, nonlinear), theta))
    t, rudder, rows = run.t, run.rudder, None
    if shares is not None:
        # Two rows at every jump, the rudder before and after it.
        after = run.reversals + 1
        begin, end = t[after - 1], t[after]
        instants = begin + np.clip(shares, 1e-6, 1.0 - 1e-6) * (end - begin)
        moment = 1e-8 * (end - begin)
        twice = np.repeat(after, 2)
        rows = np.arange(len(t)) + np.searchsorted(twice, np.arange(len(t)), side="right")
        t = np.insert(t, twice, np.column_stack([instants - moment, instants + moment]).ravel())
        rudder = np.insert(
            rudder, twice, np.column_stack([rudder[after - 1], rudder[after]]).ravel()
        )
    out = np.empty(len(t))
    _respond(
        order, x["a0"], x.get("a1", 0.0), x["b0"], x.get("b1", 0.0), x.get("c", 0.0),
        x["delta_0"], t, rudder, run.held, first, STEP, out,
    )  # fmt: skip
    return out if rows is None else out[rows]


def predict(
    model: Nomoto, run: Zigzag, rudder: Zigzag | None = None, window: float | None = None
) -> tuple[Array, float]:
    """The heading (n,) that the model predicts for a run, its first state fitted; and the RMSE.

    ``rudder`` is the same run with more rows, if there is one; ``window`` [s] lets the first state
    know only so much of the run, instead of all of it. As in the fit, a rudder that jumps
    has the instants of its jumps fitted, each within its step.

    Raises
    ------
    UserError
        If the run has another kind of input than those of the fit.
    """
    if run.unit != model.unit:
        raise UserError(
            f"{run.name} has an input in {run.unit}, but the model was fitted to one in "
            f"{model.unit}: validate on a run of the same kind"
        )
    fine = run.cornered()
    if rudder is not None:
        both = np.union1d(rudder.t, run.t)
        heading = np.full(len(both), np.nan)
        heading[np.searchsorted(both, run.t)] = run.heading
        fine = dataclasses.replace(
            run, t=both, heading=heading, rudder=np.interp(both, rudder.t, rudder.rudder)
        )
    start = fine
    if window is not None:
        seen = np.where(fine.t <= fine.t[0] + window, fine.heading, np.nan)
        start = dataclasses.replace(fine, heading=seen)
    first, shares = _first_state(model.order, model.nonlinear, model.theta, start)
    heading = respond(model.order, model.nonlinear, model.theta, fine, first, shares)
    if len(fine.t) > len(run.t):
        heading = heading[np.searchsorted(fine.t, run.t)]
    return heading, _rmse(run.heading - heading)


def _rmse(error: Array) -> float:
    return float(np.sqrt(np.nanmean(error**2)))


def _states(order: int) -> int:
    return order + 1


def _jumps(run: Zigzag) -> int:
    """How many instants of jumps are to be estimated: none where the record has them."""
    count = len(run.reversals)
    return 0 if run.held or count > MOST_JUMPS else count


def _first_state(
    order: int, nonlinear: bool, theta: Array, run: Zigzag
) -> tuple[Array, Array | None]:
    """First state and shares (see :func:`respond`) that fit the heading best: Gauss-Newton."""
    known, jumps, states = run.known, _jumps(run), _states(order)
    x = np.concatenate([[run.heading[known][0]], np.zeros(order), np.full(jumps, 0.5)])

    def simulated(x: Array) -> Array:
        first = np.zeros(3)
        first[:states] = x[:states]
        return respond(order, nonlinear, theta, run, first, x[states:] if jumps else None)[known]

    for _ in range(12 if nonlinear or jumps else 2):
        base = simulated(x)
        columns = [np.ones(len(base))]
        for i in range(1, len(x)):
            moved = x.copy()
            moved[i] += 1e-5 if moved[i] < 0.5 else -1e-5
            columns.append((simulated(moved) - base) / (moved[i] - x[i]))
        step = np.linalg.lstsq(np.column_stack(columns), run.heading[known] - base, rcond=None)[0]
        if not np.isfinite(step).all():
            break
        x = x + step
        x[states:] = np.clip(x[states:], 0.0, 1.0)
        if np.abs(step).max() < 1e-9:
            break
    first = np.zeros(3)
    first[:states] = x[:states]
    return first, x[states:] if jumps else None


# ------------------------------------------------------------------ fitting


def fit(
    runs: Sequence[Zigzag],
    order: int = 1,
    nonlinear: bool = False,
    method: str = "oe",
    interpolate: str = "none",
    step: float | None = None,
    scale: float = 1.0,
) -> Nomoto:
    """One model for all runs.

    ``interpolate`` densifies sparse headings first (:func:`dense`), to ``step`` [s], in a plane
    of ``scale`` [s/rad] where the spiral needs one.

    Raises
    ------
    UserError
        For runs too short, at rest, of different kinds, or with which the fit does not converge.
    """
    if order not in (1, 2):
        raise UserError(f"the order is 1 or 2, not {order}")
    if method not in METHODS:
        raise UserError(f"there is no method '{method}': choose one of {', '.join(METHODS)}")
    if not runs:
        raise UserError("no run is given: name at least one file")
    for run in runs:
        check(run, order, nonlinear)
        if run.unit != runs[0].unit:
            raise UserError(
                f"{run.name} has an input in {run.unit}, but {runs[0].name} in {runs[0].unit}: fit "
                "runs of one kind together"
            )
    used = [run.cornered() for run in runs]
    if interpolate != "none":
        used = [dense(run, interpolate, step, scale) for run in runs]
    model = _output_error(used, order, nonlinear)
    if method != "oe":
        model = _equation_error(used, model, method)
    measured = np.concatenate(
        [run.heading - predict(model, run, u)[0] for run, u in zip(runs, used)]
    )
    notes = list(model.notes)
    if model.theta[0] <= 0.0:
        notes.append(
            "T is not positive: the vehicle has no course stability in this model; K and T then "
            "describe the slope of an unstable balance"
        )
    elif order == 2 and "T1" not in model.names:
        notes.append("T1 and T2 are complex: only T1T2 and T1_plus_T2 are given")
    return dataclasses.replace(
        model,
        rmse=_rmse(measured),
        notes=tuple(notes),
        provenance=provenance((run.name, run.sha256) for run in runs),
    )


def others(
    model: Nomoto, runs: Sequence[Zigzag], interpolate: str = "none", step: float | None = None
) -> dict[str, Nomoto]:
    """The same model by every other method that succeeds, by name."""
    found = {}
    for method in METHODS:
        if method == model.estimator:
            continue
        try:
            found[method] = fit(runs, model.order, model.nonlinear, method, interpolate, step)
        except (UserError, np.linalg.LinAlgError):
            continue
    return found


def of_model(model: Model, speed: float) -> Nomoto:
    """The second-order model of the equations of motion for small motions at ``speed`` [m/s].

    Sway and yaw alone, ``M (v', r') = A (v, r) + B delta``; eliminating v gives, with
    ``F = M^-1 A``, ``G = M^-1 B``: ``a0 = det F, a1 = -tr F, b1 = G_2, b0 = F_21 G_1 - F_11 G_2``.
    """
    down, still = np.array([0.0, 0.0, 1.0]), np.zeros(6)
    rows = np.array([1, 5])
    f = np.empty((2, 2))
    inverse = np.linalg.inv(model.mass_matrix[np.ix_(rows, rows)])
    for i, row in enumerate(rows):
        ends = []
        for side in (-1e-6, 1e-6):
            nu = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
            nu[row] = side
            ends.append(-inverse @ model.wrench(nu, still, down)[rows])
        f[:, i] = (ends[1] - ends[0]) / 2e-6
    g = inverse @ (model.fin_wrench(speed, {"r": 1e-6})[rows] / 1e-6)
    b0 = f[1, 0] * g[0] - f[0, 0] * g[1]
    theta = np.array([np.linalg.det(f), -np.trace(f), b0, g[1], 0.0])
    return _model(2, False, "linearised", theta, np.zeros((5, 5)), "rad", 0.0)


def check(run: Zigzag, order: int = 1, nonlinear: bool = False) -> None:
    """Whether a run can tell anything about the model.

    Raises
    ------
    UserError
        Too few headings, or a rudder or heading that never moves.
    """
    known = run.heading[run.known]
    if len(known) < _MIN_SAMPLES:
        raise UserError(
            f"{run.name} has {len(known)} headings, but a fit of order {order} needs at least "
            f"{_MIN_SAMPLES}: give a longer run"
        )
    for name, values in (("rudder", run.rudder), ("heading", known)):
        if np.ptp(values) < 1e-6:
            raise UserError(
                f"{run.name}: the {name} is constant, so nothing can be identified: give a zigzag"
            )


def dense(run: Zigzag, method: str, step: float | None = None, scale: float = 1.0) -> Zigzag:
    """The run with a heading at every row, or where all rows have one, at every ``step`` [s].

    The default step is a fifth of the heading's. The rudder keeps what is known of it: rows
    between headings as they are, else straight lines.
    """
    known, t, fine = run.known, run.t, run.cornered()
    if step is not None or known.all():
        step = step or run.step / 5.0
        t = t[0] + step * np.arange(int(np.floor((t[-1] - t[0]) / step + 1e-6)) + 1)
    inside = (t >= run.t[known][0] - 1e-9) & (t <= run.t[known][-1] + 1e-9)
    t = t[inside]
    heading = densify.densify(run.t[known], run.heading[known], t, method, scale)
    return dataclasses.replace(
        run, t=t, heading=heading, rudder=np.interp(t, fine.t, fine.rudder), held=False
    )


def _output_error(runs: Sequence[Zigzag], order: int, nonlinear: bool) -> Nomoto:
    """Output error from the best linear model of a grid, and for the second order also from the
    fitted first-order one with a fast second time constant: the better of the two."""
    start, firsts = _linear_start(runs, order)
    best = _descend(runs, order, nonlinear, _with_cubic(start, nonlinear), firsts)
    if order == 2:
        simple = _output_error(runs, 1, nonlinear)
        x = dict(zip(_names(1, nonlinear), simple.theta))
        fast = 0.1 * abs(x["a0"]) ** -1.0
        start = np.array([x["a0"] / fast, x["a0"] + 1.0 / fast, x["b0"] / fast, 0.0, x["delta_0"]])
        start = _with_cubic(start, nonlinear, x.get("c", 0.0) / fast)
        states = [_first_state(2, nonlinear, start, run) for run in runs]
        firsts, shares = [first for first, _ in states], [share for _, share in states]
        other = _descend(runs, 2, nonlinear, start, firsts, shares)
        best = min(best, other, key=lambda m: m.rmse)
    if not math.isfinite(best.rmse):
        raise UserError("the fit does not converge: try --order 1 without --nonlinear")
    return best


def _with_cubic(theta: Array, nonlinear: bool, c: float = 0.0) -> Array:
    return np.insert(theta, len(theta) - 1, c) if nonlinear else theta


def _descend(
    runs: Sequence[Zigzag],
    order: int,
    nonlinear: bool,
    start: Array,
    firsts: Sequence[Array],
    shares: Sequence[Array | None] = (),
) -> Nomoto:
    """Least squares on the simulated headings over theta, every run's first state, and the instants
    of jumps that fall between two rows (:attr:`Zigzag.reversals`)."""
    n, states = len(start), _states(order)
    known = [run.known for run in runs]
    speed = max(float(np.std(np.gradient(r.heading[k], r.t[k]))) for r, k in zip(runs, known))
    names = _names(order, nonlinear)
    # Scales: of the offset the rudder's spread, of the cubic term one that equals a0 at r_rms,
    # of b1 what T3 of the geometric mean of T1 and T2 would make it.
    scale = np.abs(start)
    if order == 2:
        scale[3] = scale[2] / np.sqrt(scale[0])
    scale[names.index("delta_0")] = 0.1 * max(float(np.std(run.rudder)) for run in runs)
    if nonlinear:
        scale[names.index("c")] = abs(start[0]) / speed**2
    scale = np.maximum(scale, 1e-9)
    jumps = [_jumps(run) for run in runs]
    scales, x0 = [scale], [start / scale]
    lower, upper = [np.full(n, -np.inf)], [np.full(n, np.inf)]
    for i, (first, count) in enumerate(zip(firsts, jumps)):
        guess = shares[i] if shares else None
        guess = np.full(count, 0.5) if guess is None else np.clip(guess, 0.01, 0.99)
        size = np.array([0.1, *[speed] * order])
        scales += [size, np.ones(count)]
        x0 += [first[:states] / size, guess]
        lower += [np.full(states, -np.inf), np.zeros(count)]
        upper += [np.full(states, np.inf), np.ones(count)]
    sizes = np.concatenate(scales)

    def residual(x: Array) -> Array:
        x = x * sizes
        parts, at = [], n
        for run, seen, count in zip(runs, known, jumps):
            first = np.zeros(3)
            first[:states] = x[at : at + states]
            shares = x[at + states : at + states + count] if count else None
            at += states + count
            parts.append((respond(order, nonlinear, x[:n], run, first, shares) - run.heading)[seen])
        return np.concatenate(parts)

    bounded = any(jumps)
    result = least_squares(
        residual,
        np.concatenate(x0),
        bounds=(np.concatenate(lower), np.concatenate(upper)),
        method="trf" if bounded else "lm",
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
        max_nfev=100 if bounded else 200 * len(sizes),
    )
    if not result.cost < _DIVERGED:
        zeros = np.zeros((n, n))
        return _model(order, nonlinear, "oe", start, zeros, runs[0].unit, math.inf)
    free = result.active_mask == 0  # a jump's instant on its bound is no free parameter
    lengths = [int(k.sum()) for k in known]
    covariance = np.zeros((len(sizes), len(sizes)))
    covariance[np.ix_(free, free)] = _robust_covariance(result.jac[:, free], result.fun, lengths)
    covariance *= np.outer(sizes, sizes)
    return _model(
        order, nonlinear, "oe", result.x[:n] * scale, covariance[:n, :n], runs[0].unit,
        _rmse(result.fun),
    )  # fmt: skip


def _linear_start(runs: Sequence[Zigzag], order: int) -> tuple[Array, list[Array]]:
    """Start of the search: over a grid of time constants all else of the linear model is linear."""
    states = _states(order)
    total = sum(int(run.known.sum()) for run in runs)
    longest = max(run.t[-1] - run.t[0] for run in runs)
    shortest = min(float(np.median(np.diff(run.t))) for run in runs)
    grid = np.geomspace(max(shortest, 1e-3 * longest), 3.0 * longest, 25)
    pairs = (
        [(1.0 / T, 0.0) for T in grid]
        if order == 1
        else [(1.0 / (T * S), (T + S) / (T * S)) for T in grid[::2] for S in grid[::2] if S < T]
    )
    target = np.concatenate([run.heading[run.known] for run in runs])
    best, cost = None, np.inf
    for a0, a1 in pairs:
        columns = np.zeros((total, order + 1 + states * len(runs)))
        row = 0
        for i, run in enumerate(runs):
            rows = slice(row, row + int(run.known.sum()))
            row = rows.stop
            ones = dataclasses.replace(run, rudder=np.ones(len(run.t)))
            units = [(1.0, 0.0, run, 0), (1.0, 0.0, ones, order)]
            units += [(0.0, 1.0, run, 1)] if order == 2 else []
            for b0, b1, driven, column in units:
                theta = np.array([a0, b0, 0.0] if order == 1 else [a0, a1, b0, b1, 0.0])
                columns[rows, column] = respond(order, False, theta, driven, np.zeros(3))[run.known]
            theta = np.array([a0, 0.0, 0.0] if order == 1 else [a0, a1, 0.0, 0.0, 0.0])
            for j in range(states):
                first = np.eye(3)[j]
                column = order + 1 + states * i + j
                columns[rows, column] = respond(order, False, theta, run, first)[run.known]
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        solution = np.linalg.lstsq(columns / size, target, rcond=1e-10)[0] / size
        error = float(np.sum((columns @ solution - target) ** 2))
        if error < cost:
            best, cost = (a0, a1, solution), error
    if best is None or not abs(best[2][0]) > 0.0:
        raise UserError(
            f"the heading of {runs[0].name} does not follow the rudder: check the columns, and "
            "that the run is a zigzag"
        )
    a0, a1, x = best
    start = [a0, x[0], -x[1] / x[0]] if order == 1 else [a0, a1, x[0], x[1], -x[2] / x[0]]
    firsts = []
    for i in range(len(runs)):
        first = np.zeros(3)
        first[:states] = x[order + 1 + states * i : order + 1 + states * (i + 1)]
        firsts.append(first)
    return np.array(start), firsts


def _robust_covariance(jac: Array, error: Array, lengths: Sequence[int]) -> Array:
    """Covariance (n, n) of a least-squares solution whose residuals are coloured.

    The sandwich ``(J'J)^-1 S (J'J)^-1`` with the long-run covariance S of the scores ``J e``, from
    a Bartlett window over scores prewhitened by a first-order autoregression (Andrews and Monahan
    1992), run by run: plain least squares takes a slow residual for many independent ones.
    """
    n = jac.shape[1]
    scores = jac * error[:, None]
    s = np.zeros((n, n))
    at = 0
    for length in lengths:
        part = scores[at : at + length]
        at += length
        if length < 4:
            s += part.T @ part
            continue
        e = error[at - length : at]
        own = float(np.clip(float(e[1:] @ e[:-1]) / (float(e @ e) + 1e-300), 0.0, 0.97))
        white = part[1:] - own * part[:-1]
        power = float(np.sum(white**2)) + 1e-300
        rho = float(np.clip(float(np.sum(white[1:] * white[:-1])) / power, -0.9, 0.97))
        # Andrews (1991), eq. 6.2: the bandwidth for an AR(1) of that correlation.
        alpha = 4.0 * rho**2 / ((1.0 - rho) ** 2 * (1.0 + rho) ** 2)
        lags = int(min(1.1447 * (alpha * length) ** (1.0 / 3.0), 0.25 * length))
        long_run = white.T @ white
        for lag in range(1, lags + 1):
            gamma = white[lag:].T @ white[:-lag]
            long_run += (1.0 - lag / (lags + 1.0)) * (gamma + gamma.T)
        s += long_run / (1.0 - own) ** 2
    inverse = np.linalg.pinv(jac.T @ jac, rcond=1e-15)
    return inverse @ s @ inverse * len(error) / max(len(error) - n, 1)


# ------------------------------------------------------------------ equation error


def _equation_error(runs: Sequence[Zigzag], model: Nomoto, method: str) -> Nomoto:
    """The equation in forward differences: least squares, instruments, or recursive.

    First order, h the step, D the forward difference over h::

        D^2 psi / h^2 = b0 (delta - delta_0) - a0 D psi / h - c (D psi / h)^3

    all at t; second order one difference more. ``b0 delta_0`` is the constant column.
    """
    order, nonlinear = model.order, model.nonlinear
    even = [_evenly(run) for run in runs]
    parts = [_rows(run.t, run.heading, run.rudder, order, nonlinear) for run in even]
    y = np.concatenate([p[0] for p in parts])
    x = np.vstack([p[1] for p in parts])
    if len(y) < 4 * x.shape[1]:
        raise UserError(f"{len(y)} equations for {x.shape[1]} unknowns: give a longer run")
    solution = np.linalg.lstsq(x, y, rcond=None)[0]
    z, history = x, None
    if method == "iv":
        # The instruments are the regressors of a simulated heading, which noise has not touched.
        theta = model.theta
        for _ in range(30):
            blocks: list[Array] = []
            for run in even:
                first, shares = _first_state(order, nonlinear, theta, run)
                heading = respond(order, nonlinear, theta, run, first, shares)
                blocks.append(_rows(run.t, heading, run.rudder, order, nonlinear)[1])
            z = np.vstack(blocks)
            if not np.abs(z).max() < 1e5:
                raise UserError(
                    "the instruments diverge: the noise is too strong for `iv`; use `oe`"
                )
            new = np.linalg.solve(z.T @ x, z.T @ y)
            moved = np.abs(new - solution).max() / np.abs(new).max()
            solution = new
            theta = _from_solution(solution, order, nonlinear)
            if moved < 1e-8:
                break
    elif method == "rls":
        history = recursive(y, x)
        solution = history[-1]
    error = y - x @ solution
    # The sandwich of instruments: (Z'X)^-1 S (X'Z)^-1.
    inverse = np.linalg.pinv(z.T @ x)
    core = _robust_covariance(z, error, [len(p[0]) for p in parts])
    square = z.T @ z
    covariance = inverse @ square @ core @ square @ inverse.T
    theta = _from_solution(solution, order, nonlinear)
    jacobian = np.eye(len(theta))  # of the last alone, delta_0 = (b0 delta_0) / b0
    b0 = _names(order, nonlinear).index("b0")
    jacobian[-1, -1], jacobian[-1, b0] = 1.0 / theta[b0], -theta[-1] / theta[b0]
    histories = (
        None
        if history is None
        else np.array([_from_solution(row, order, nonlinear) for row in history])
    )
    covariance = jacobian @ covariance @ jacobian.T
    return _model(order, nonlinear, method, theta, covariance, model.unit, model.rmse, histories)


def _evenly(run: Zigzag) -> Zigzag:
    """The headings on an even grid of their median step: differences need one."""
    known = run.known
    t, step = run.t[known], run.step
    if np.abs(np.diff(t) - step).max() < 0.01 * step:
        rudder = np.interp(t, run.t, run.rudder)
        return Zigzag(run.name, t, run.heading[known], rudder, run.unit)
    even = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-6) + 1)
    heading = CubicSpline(t, run.heading[known])(even)
    return Zigzag(run.name, even, heading, np.interp(even, run.t, run.rudder), run.unit)


def _rows(
    t: Array, heading: Array, rudder: Array, order: int, nonlinear: bool
) -> tuple[Array, Array]:
    """Left side (k,) and regressors (k, n) of the equation in forward differences."""
    h = float(np.median(np.diff(t)))
    rate = np.diff(heading) / h
    k = len(rate) - order
    left = np.diff(rate, order) / h**order
    columns = [-rate[:k], rudder[:k]]
    if order == 2:
        columns = [-rate[:k], -np.diff(rate)[:k] / h, rudder[:k], np.diff(rudder)[:k] / h]
    if nonlinear:
        columns.append(-(rate[:k] ** 3))
    return left, np.column_stack([*columns, -np.ones(k)])


def _from_solution(solution: Array, order: int, nonlinear: bool) -> Array:
    """theta from the solution, whose last entry is b0 delta_0."""
    theta = solution.copy()
    with np.errstate(divide="ignore", invalid="ignore"):  # b0 is zero before the rudder moves
        theta[-1] = solution[-1] / theta[_names(order, nonlinear).index("b0")]
    return theta


def recursive(y: Array, x: Array, lowest: float = 0.9, memory: float = 0.995) -> Array:
    """Recursive least squares with a dynamic forgetting factor: solutions (k, n) after each row.

    The factor falls from 1 towards ``lowest`` as the prediction error grows beyond its usual size
    (Park and Jun 1992: ``lowest + (1 - lowest) 2^-(e/sigma)^2``, here from one and a half sigma
    on), sigma by exponential averaging with ``memory`` of errors clipped at three sigma, its start
    the median of the first (0.455: that of a squared normal). What is forgotten is taken from the
    direction just excited only, so that the covariance stays bounded where nothing moves.
    """
    n = x.shape[1]
    size = np.maximum(np.sqrt(np.mean(x**2, axis=0)), 1e-300)
    p = np.eye(n) * 1e6 * max(float(np.mean(y**2)), 1e-12)
    theta = np.zeros(n)
    out = np.empty((len(y), n))
    variance, first = float(np.mean(y**2)) + 1e-300, 10 * n
    errors = np.zeros(first)
    for i in range(len(y)):
        row = x[i] / size
        error = y[i] - row @ theta
        excess = max(abs(error) / np.sqrt(variance) - 1.5, 0.0) if i > first else 0.0
        factor = lowest + (1.0 - lowest) * 2.0 ** -(excess**2)
        pr = p @ row
        power = float(row @ pr)
        if power > 1e-12:
            # Directional forgetting (Kulhavy 1987).
            beta = factor - (1.0 - factor) / power
            gain = pr / (1.0 + power)
            theta = theta + gain * error
            if abs(beta) > 1e-12:
                p = p - np.outer(pr, pr) / (1.0 / beta + power)
        if i < first:
            errors[i] = error
        elif i == first:  # by then the first guesses are past
            variance = float(np.median(errors[2 * n :] ** 2)) / 0.455 + 1e-300
        else:
            variance += (1.0 - memory) * (min(error**2, 9.0 * variance) - variance)
        out[i] = theta / size
    return out
