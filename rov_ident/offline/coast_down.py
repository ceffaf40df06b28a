"""Thrust, drag and added mass of the surge channel, from step-up and coast-down (Zhao et al. 2018).

    (m - X_udot) u_dot = k1 n + k2 |n| n + X_u u + X_uu |u| u

Every term is a force: multiply ``m - X_udot``, k1, k2, X_u and X_uu by one number, and the motion
is the same. Speeds alone tell the *ratios* to the inertia; one force or mass from elsewhere sets
the scale: a bollard pull, or the added mass (a spheroid's, say).

Fitted by output error: u is simulated from the shaft speed n, run by run, each from an estimated
starting speed, and compared with the measured one. Beside them are estimated, with priors about
none: a lag of the thrust, and for each run by how much measured speeds are off those through the
water, by a current or the sensor's zero. A drag that is linear in u takes up either otherwise.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.jit import kernel
from rov_ident.core.linalg import scaled_inverse
from rov_ident.io.csv_table import read_csv
from rov_ident.model.equations import Array, build
from rov_ident.reports.result import NORMAL, Result, as_json

_FIRST_NOISE = 0.01  # of the largest speed
_FIRST_LAG = 0.4  # prior standard deviations, as config.prior has it: at none it has no slope
_ROUNDS = 3  # of weighing priors against the noise that the fit before has left
_UNITS = {"k1": "N/n", "k2": "N/n2", "X_u": "N s/m", "X_uu": "N s2/m2", "X_udot": "kg"}


@dataclass(frozen=True)
class Run:
    """A run: shaft speed n (N,) held from each ``t`` (N,) [s] on, measured surge speed u (N,)."""

    t: Array
    n: Array
    u: Array


@dataclass(frozen=True, kw_only=True)
class CoastDown(Result):
    """k1 and k2 are per shaft speed n in the unit of the runs; ``rmse`` [m/s] of the simulated
    speed."""

    rmse: float

    def to_json(self) -> str:
        result = {
            "coefficients": self.entries(),
            "speed_rmse_mps": self.rmse,
            "notes": list(self.notes),
            "provenance": self.provenance,
        }
        return as_json(result)


def read_run(path: Path, columns: Mapping[str, str]) -> tuple[Run, str]:
    """A run from a CSV file with the columns `t_s`, `n` and `u`, or as ``columns`` calls them, and
    the file's sha256.

    Raises UserError if it is no such file.
    """
    if unknown := sorted(set(columns) - {"t_s", "n", "u"}):
        raise UserError(f"`{unknown[0]}` cannot be mapped: use one of t_s n u")
    table = read_csv(path)
    headings = [columns.get(name, name) for name in ("t_s", "n", "u")]
    for name, heading in zip(("t_s", "n", "u"), headings, strict=True):
        if heading not in table.cells:
            raise UserError(
                f"{path} has no column `{heading}`: it has {', '.join(table.cells)}; name the "
                f"right one with --map {name}=HEADING"
            )
    return Run(*map(table.numbers, headings)), table.sha256


def fit_coast_downs(
    runs: Sequence[Run],
    mass: float,
    *,
    added_mass: float | None = None,
    bollard: tuple[float, float] | None = None,
    mass_std: float = 0.0,
    added_mass_std: float = 0.0,
    current_std: float = 0.0,
    lag_std: float = 0.0,
) -> CoastDown:
    """Fit step-up and coast-down runs.

    ``added_mass``: X_udot [kg], not positive; or ``bollard``: a shaft speed and the thrust [N] at
    rest there. One of the two. ``mass_std`` and ``added_mass_std``: standard deviations [kg];
    ``current_std`` [m/s] of what speeds are off by, ``lag_std`` [s] of the time constant with which
    thrust follows the shaft; zero: none.

    Raises UserError if the scale is not given, or the runs lack thrust, coasting, or speed.
    """
    if (added_mass is None) == (bollard is None):
        raise UserError(
            "speeds do not tell forces: give either the added mass X_udot or one bollard pull"
        )
    if added_mass is not None and added_mass > 0.0:
        raise UserError(f"added_mass is {added_mass:g}: X_udot is negative (SNAME signs)")
    if not runs:
        raise UserError("no run was given")
    _check(runs)
    speed = max(float(np.abs(r.u).max()) for r in runs)
    shaft = max(float(np.abs(r.n).max()) for r in runs)
    rise = max(1.0, max(float(r.t[-1] - r.t[0]) for r in runs) / 10.0)
    size = np.array(
        [speed / rise / shaft, speed / rise / shaft**2, 1.0 / rise, 1.0 / (rise * speed)]
    )

    # parameters with a prior: the lag, then what each run is off by, in standard deviations
    supposed = np.array([lag_std] + [current_std] * len(runs))
    beside, first = supposed > 0.0, 4 + len(runs)

    def errors_of(x: Array) -> list[Array]:
        more = np.zeros(len(supposed))
        more[beside] = x[first:] * supposed[beside]
        return [
            r.u - off - _simulated(x[:4] * size, start, more[0], r.t, r.n)
            for start, off, r in zip(x[4:first], more[1:], runs, strict=True)
        ]

    def weighed(x: Array, noise: float) -> Array:
        return np.concatenate([*errors_of(x), noise * x[first:]])

    least = np.full(first + len(supposed), -np.inf)
    least[first] = 0.0  # of the lag
    least = least[np.append(np.ones(first, dtype=bool), beside)]
    begin = np.array([0.5, 0.5, -0.5, -0.5] + [float(np.median(r.u[:5])) for r in runs])
    x = np.append(begin, np.where(least[first:] == 0.0, _FIRST_LAG, 0.0))
    noise = _FIRST_NOISE * speed  # m/s; against which priors are weighed
    for _ in range(_ROUNDS):
        found = least_squares(weighed, x, x_scale="jac", bounds=(least, np.inf), args=(noise,))
        x, errors = found.x, errors_of(found.x)
        left = np.concatenate(errors)
        # residuals of one run are alike from point to point: allow for it by their own correlation
        variance = float(left @ left) / max(len(left) - len(x), 1) * _inflation(errors)
        noise = float(np.sqrt(variance))
    ratio = x[:4] * size
    whole = scaled_inverse(found.jac.T @ found.jac) * variance
    told = np.zeros((2, len(supposed)))
    told[:, beside] = supposed[beside] * [x[first:], np.sqrt(np.diag(whole))[first:]]
    notes = _notes(*told)
    covariance = whole[:4, :4]
    covariance = covariance * np.outer(size, size)
    if added_mass is not None:
        inertia, slope = mass - added_mass, np.zeros(4)
    else:
        assert bollard is not None
        n, thrust = bollard
        terms = np.array([n, abs(n) * n, 0.0, 0.0])
        if not float(terms @ ratio) * thrust > 0.0:
            raise UserError("the bollard pull and the runs disagree about the sign of the thrust")
        inertia = thrust / float(terms @ ratio)
        slope = -inertia * terms / float(terms @ ratio)
        if inertia <= mass:
            raise UserError(
                f"with {thrust:g} N at rest the runs make mass and added mass {inertia:.3g} kg, "
                f"less than the mass of {mass:g} kg: check the bollard pull"
            )
    # of the four and of X_udot = mass - inertia, by the four ratios
    jacobian = np.vstack([inertia * np.eye(4) + np.outer(ratio, slope), -slope])
    covariance = jacobian @ covariance @ jacobian.T
    # What the mass is off by, a bollard pull leaves to X_udot; else it scales all forces, as X_udot
    # does. No residual tells of either.
    of_mass = np.append(np.zeros(4), 1.0) if bollard else np.append(ratio, 0.0)
    of_added_mass = np.append(-ratio, 1.0)
    for by, std in ((of_mass, mass_std), (of_added_mass, 0.0 if bollard else added_mass_std)):
        covariance += std**2 * np.outer(by, by)
    return CoastDown(
        estimator="output error",
        names=tuple(_UNITS),
        units=tuple(_UNITS.values()),
        values=np.append(inertia * ratio, mass - inertia),
        covariance=covariance,
        rmse=float(np.sqrt(np.mean(left**2))),
        notes=notes,
    )


def _notes(values: Array, std: Array) -> tuple[str, ...]:
    """What runs show of the lag [s], and of how far the speeds of each are off [m/s], in words."""
    told = [f"{x:.3g} ± {NORMAL * s:.2g}" for x, s in zip(values, std, strict=True)]
    shown, notes = np.abs(values) > NORMAL * std, []
    if shown[0]:
        notes.append(f"thrust follows the shaft with a time constant of {told[0]} s: allowed for")
    if shown[1:].any():
        notes.append(
            f"speeds are off those through the water by {', '.join(told[1:])} m/s, run by run: a "
            "current, or the sensor's zero, is allowed for"
        )
    return tuple(notes)


def configured(config: Config, found: CoastDown) -> Config:
    """The configuration with X_u, X_uu and X_udot as found, also where it lacks them: one of the
    two drags alone is not that of the runs.

    Raises UserError if the values make no passive hull.
    """
    hull = {name: found.value(name) for name in ("X_u", "X_uu", "X_udot")}
    return config.with_model(build(config.model.body, {**config.model.values, **hull}))


def _check(runs: Sequence[Run]) -> None:
    for i, r in enumerate(runs):
        if not (len(r.t) == len(r.n) == len(r.u)) or len(r.t) < 10:
            raise UserError(f"run {i + 1}: t, n and u must have one length, 10 points at least")
        if not np.isfinite([r.t, r.n, r.u]).all():
            raise UserError(f"run {i + 1}: holds values that are not finite")
        if np.any(np.diff(r.t) <= 0.0):
            raise UserError(f"run {i + 1}: times must increase")
    shaft = np.abs(np.concatenate([r.n for r in runs]))
    speed = np.abs(np.concatenate([r.u for r in runs]))
    if not shaft.any():
        raise UserError("the shaft never turns: add a step-up run")
    if not np.any((shaft == 0.0) & (speed > 0.3 * speed.max())):
        raise UserError("no run coasts (n = 0 at speed): drag and thrust cannot be told apart")
    if len(np.unique(np.round(shaft[shaft > 0.0] / shaft.max(), 1))) < 2:
        raise UserError("the shaft turns at one speed only: k1 and k2 cannot be told apart")


def _inflation(residuals: Sequence[Array]) -> float:
    """By how much means of the residuals scatter more than white noise would let them.

    The sum of their correlations, by pairs of lags, to the first pair that is not positive, none
    counted for more than the one before (initial monotone sequence: Geyer 1992). The neighbour's
    correlation alone does not tell how long a slow error lasts, once white noise is on top of it.
    """
    power = sum(float(e @ e) for e in residuals)

    def correlation(lag: int) -> float:
        return sum(float(e[lag:] @ e[: len(e) - lag]) for e in residuals) / max(power, 1e-300)

    total, pair = -1.0, math.inf  # both directions, but the lag zero once
    for lag in range(0, min(map(len, residuals)) - 1, 2):
        pair = min(pair, correlation(lag) + correlation(lag + 1))
        if pair <= 0.0:
            break
        total += 2.0 * pair
    return max(total, 1.0)


@kernel
def _simulated(ratio, start, lag, t, n):
    """u (N,) from its value ``start`` at t[0], steps of 20 ms at most. Thrust follows the shaft
    with a ``lag`` [s], and has done so for long."""
    u = np.empty(len(t))
    u[0] = start
    push = ratio[0] * n[0] + ratio[1] * abs(n[0]) * n[0]
    for k in range(len(t) - 1):
        x, span = u[k], t[k + 1] - t[k]
        steps = max(1, int(np.ceil(span / 0.02)))
        dt = span / steps
        asked = ratio[0] * n[k] + ratio[1] * abs(n[k]) * n[k]
        half = math.exp(-0.5 * dt / lag) if lag > 0.0 else 0.0
        for _ in range(steps):
            a = asked + half * (push - asked) + ratio[2] * x + ratio[3] * abs(x) * x
            y = x + 0.5 * dt * a
            push = asked + half * (push - asked)
            x += dt * (push + ratio[2] * y + ratio[3] * abs(y) * y)
            push = asked + half * (push - asked)
            x = min(max(x, -50.0), 50.0)
        u[k + 1] = x
    return u
