"""Nomoto's model by output error: the simulated heading is fitted, every first state estimated."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from rov_ident.core.errors import UserError
from rov_ident.core.linalg import sandwich, scaled_inverse
from rov_ident.core.messages import Array
from rov_ident.steering.nomoto_model import (
    Nomoto,
    Structure,
    first_state,
    jumps_of,
    model_of,
    respond,
    rmse,
)
from rov_ident.steering.zigzag import Zigzag

_NO_CUBIC = "the cubic term would help the turn instead of resisting it and is held at zero"
_RIVAL = 3.0  # times the least RMSE: nine times the squared error is no doubt of the sign of K
_DIVERGED = 1e10  # rad2, the cost of a simulation that left all reason


def output_error(runs: Sequence[Zigzag], structure: Structure) -> Nomoto:
    """Output error, the best of several starts.

    They are the best linear model of a grid and its mirror image without course stability; for the
    second order also the fitted first-order one with a fast second time constant, and with the
    cubic term the fitted linear one. A start that ends with another sign of K is noted.

    Raises UserError if none converges.
    """
    order, nonlinear = structure
    grid = _linear_start(runs, order)
    mirrored = grid.copy()
    mirrored[0] *= -1.0
    starts = [(grid, 0.0), (mirrored, 0.0)]
    if nonlinear:
        # Of an unstable balance the cubic term is what bounds the rate, here to about that seen.
        fast = max(float(np.nanvar(np.gradient(r.heading[r.known], r.t[r.known]))) for r in runs)
        starts[1] = mirrored, 2.0 * abs(grid[0]) / fast
        starts.append((output_error(runs, Structure(order)).theta, 0.0))
    if order == 2:
        simple = output_error(runs, Structure(1, nonlinear))
        x = dict(zip(simple.structure.names, simple.theta))
        short = 0.1 * abs(x["a0"]) ** -1.0
        a0, a1, b0 = x["a0"] / short, x["a0"] + 1.0 / short, x["b0"] / short
        starts.append((np.array([a0, a1, b0, 0.0, x["delta_0"]]), x.get("c", 0.0) / short))
    found = []
    for start, c in starts:
        theta = np.insert(start, len(start) - 1, c) if nonlinear else start
        found.append(descend(runs, structure, theta))
    best = min(found, key=lambda m: m.rmse)
    if not math.isfinite(best.rmse):
        raise UserError("the fit does not converge: try --order 1 without --nonlinear")
    others = [
        m for m in found if m.rmse < _RIVAL * best.rmse and m.value("K") * best.value("K") < 0
    ]
    if others:
        other = min(others, key=lambda m: m.rmse)
        note = (
            f"from another start the fit ends at K = {other.value('K'):.3g} {best.units[0]} with a "
            f"heading RMSE of {math.degrees(other.rmse):.3g} instead of "
            f"{math.degrees(best.rmse):.3g} deg: compare the two before you use the sign of K"
        )
        best = dataclasses.replace(best, notes=(*best.notes, note))
    return best


def descend(runs: Sequence[Zigzag], structure: Structure, start: Array) -> Nomoto:
    """Least squares on the simulated headings over theta, from ``start`` (n,), every run's first
    state, and the instants of jumps that fall between two rows (:attr:`Zigzag.reversals`); an RMSE
    of infinity where it does not converge."""
    order, nonlinear = structure
    n, states = len(start), order + 1
    known = [run.known for run in runs]
    speed = max(float(np.std(np.gradient(r.heading[k], r.t[k]))) for r, k in zip(runs, known))
    names = structure.names
    # Scales: of the offset the rudder's spread, of the cubic term one that equals a0 at r_rms,
    # of b1 what T3 of the geometric mean of T1 and T2 would make it.
    scale = np.abs(start)
    if order == 2:
        scale[3] = scale[2] / np.sqrt(scale[0])
    scale[names.index("delta_0")] = 0.1 * max(float(np.std(run.rudder)) for run in runs)
    if nonlinear:
        scale[names.index("c")] = abs(start[0]) / speed**2
    scale = np.maximum(scale, 1e-9)
    jumps = [jumps_of(run) for run in runs]
    scales, x0 = [scale], [start / scale]
    lower, upper = [np.full(n, -np.inf)], [np.full(n, np.inf)]
    if nonlinear:
        # The cubic term is a resistance. One that helps the turn lets the rate run away as soon as
        # a manoeuvre is faster than those fitted.
        lower[0][names.index("c")] = 0.0
    size = np.array([0.1, *[speed] * order])
    for run, count in zip(runs, jumps):
        first, shares = first_state(structure, start, run)
        scales += [size, np.ones(count)]
        x0 += [first / size, np.clip(shares, 0.01, 0.99)]
        lower += [np.full(states, -np.inf), np.zeros(count)]
        upper += [np.full(states, np.inf), np.ones(count)]
    sizes = np.concatenate(scales)

    def residual(x: Array) -> Array:
        x = x * sizes
        parts, at = [], n
        for run, seen, count in zip(runs, known, jumps):
            first, shares = x[at : at + states], x[at + states : at + states + count]
            at += states + count
            parts.append((respond(structure, x[:n], run, first, shares) - run.heading)[seen])
        return np.concatenate(parts)

    bounded = nonlinear or any(jumps)
    result = least_squares(
        residual,
        np.concatenate(x0),
        bounds=(np.concatenate(lower), np.concatenate(upper)),
        method="trf" if bounded else "lm",
        xtol=1e-10,
        ftol=1e-10,
        gtol=1e-10,
        max_nfev=100 if bounded else 200 * len(sizes),
    )
    if not result.cost < _DIVERGED:
        zeros = np.zeros((n, n))
        return model_of(structure, "oe", start, zeros, runs[0].unit, math.inf)
    free = result.active_mask == 0  # a jump's instant on its bound is no free parameter
    lengths = [int(k.sum()) for k in known]
    covariance = np.zeros((len(sizes), len(sizes)))
    covariance[np.ix_(free, free)] = robust_covariance(result.jac[:, free], result.fun, lengths)
    covariance *= np.outer(sizes, sizes)
    theta, own = result.x[:n] * scale, covariance[:n, :n]
    model = model_of(structure, "oe", theta, own, runs[0].unit, rmse(result.fun))
    if nonlinear and not free[names.index("c")]:
        model = dataclasses.replace(model, notes=(_NO_CUBIC,))
    return model


def _linear_start(runs: Sequence[Zigzag], order: int) -> Array:
    """Start of the search: over a grid of time constants all else of the linear model is linear."""
    linear, states = Structure(order), order + 1
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
                columns[rows, column] = respond(linear, theta, driven, np.zeros(3))[run.known]
            theta = np.array([a0, 0.0, 0.0] if order == 1 else [a0, a1, 0.0, 0.0, 0.0])
            for column, first in enumerate(np.eye(states), order + 1 + states * i):
                columns[rows, column] = respond(linear, theta, run, first)[run.known]
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
    return np.array(start)


def robust_covariance(jac: Array, error: Array, lengths: Sequence[int]) -> Array:
    """Covariance (n, n) of a least-squares solution whose residuals are coloured.

    The sandwich ``(J'J)^-1 S (J'J)^-1`` with the long-run covariance S of the scores ``J e``, from
    a Bartlett window over scores prewhitened by a first-order autoregression (Andrews and Monahan
    1992), run by run: plain least squares takes a slow residual for many independent ones.
    """
    n = jac.shape[1]
    scores = jac * error[:, None]
    s = np.zeros((n, n))
    ends = np.cumsum(lengths)[:-1]
    for length, part, e in zip(lengths, np.split(scores, ends), np.split(error, ends)):
        if length < 4:
            s += part.T @ part
            continue
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
    return sandwich(scaled_inverse(jac.T @ jac), s) * len(error) / max(len(error) - n, 1)
