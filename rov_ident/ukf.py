"""Unscented Kalman filter over body velocities and coefficients: ``init``, ``step``, ``fold``.

State ``x = [nu (6), xi (n)]``. The coefficients are a random walk; those that physics keeps
negative are ``theta = -s (xi + sqrt(xi^2 + 4)) / 2``: negative for every xi, smooth, and linear
where the coefficient is well above its scale s, so that intervals stay those of a normal
distribution. The others are ``theta = s xi``.

Prediction: scaled sigma points (Merwe; the weights are filterpy's) through one or more Runge-Kutta
steps of the equations of motion, sixteen points side by side. The coefficients do not move and the
measurement is linear, so of the 2 (6 + n) + 1 points only the velocities are summed, as differences
from the centre point: with e = mean - centre and W the weight of an outer point

    cov = W sum(delta delta') + (beta - alpha^2) e e'

in which the huge central weight has cancelled exactly.

Update: odometry and gyro measure nu with independent noise, so one component after another is the
same as all at once.

Coefficients whose motion is not well above its noise are *considered*, not estimated (Schmidt
1966): they stay what they are, their uncertainty is carried along. At rest a filter would else
learn from the difference between its assumed and the true noise.

The random walk fades out as a variance nears its prior: without excitation nothing grows beyond it.

What the model leaves unexplained is found from the innovations: per axis, the density of the
process noise follows the difference between their square and its prediction (Mehra 1972; Myers and
Tapley 1976), down to the configured floor. A wrong structure then widens the intervals instead of
being learnt as a coefficient.
"""

from typing import NamedTuple

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints
from numpy.typing import NDArray

from rov_ident.coefficients import EXTENDED_SIZE
from rov_ident.config import Config
from rov_ident.estimate import Estimate, Prior, prior_of
from rov_ident.jit import inlined, kernel
from rov_ident.model import Structure, add_added_mass, generalized_force, in_motion
from rov_ident.rls import INFO, first_order, is_finite
from rov_ident.samples import SAMPLE

Array = NDArray[np.float64]

USED, RESTARTED, GATED, NOT_FINITE, REPAIRED, UNPREDICTABLE = range(6)
REASONS = (
    "used",
    "restarted after a gap",
    "outlier",
    "not finite",
    "covariance repaired",
    "no model moves so",
)

REFUSALS = (GATED, NOT_FINITE, REPAIRED, UNPREDICTABLE)

LANES = 16
_MAX_STEP = 0.05  # s; of one Runge-Kutta step
_LOWEST = -2.0  # of xi where theta stays negative: below, it has too little slope to come back
_ADAPTATION_TIME = 20.0  # s; over which the process noise follows the innovations
_STEADY = 4.0  # a squared innovation counts for at most this often its variance in that
_LOST = 1.0  # s of nothing but outliers after which the velocity is begun anew
_SURPRISE_TIME = 2.0  # s; over which the normalised innovation squared is averaged
_RELEARNING_TIME = 20.0  # s; in which the coefficients then become as uncertain as at first
_FASTEST = 50.0  # m/s, rad/s; no sigma point of a sane model gets there

_SETTINGS = np.dtype(
    [
        ("spread", "f8"),  # sqrt(n + lambda)
        ("weight", "f8"),  # of an outer sigma point
        ("centre", "f8"),  # beta - alpha^2
        ("gate", "f8"),
        ("changed", "f8"),  # surprise from which the vehicle is taken to have changed
        ("process", "f8", (6,)),  # variance density of the acceleration
        ("wrench", "f8"),  # relative variance of the wrench times its correlation time
        ("wrench_floor", "f8", (6,)),
        ("corner", "f8"),  # rad/s, of the published residual
    ],
    align=True,
)


class Problem(NamedTuple):
    """What does not change from sample to sample."""

    settings: NDArray[np.void]
    structure: Structure
    estimated: NDArray[np.int64]  # (n,) indices into theta
    theta: Array  # (m,) held values of the coefficients that are not estimated
    scale: Array  # (n,) s of the parametrisation
    negative: NDArray[np.bool_]  # (n,)
    start: Array  # (n,) xi of the prior
    prior_variance: Array  # (n,) of xi
    walk: Array  # (n,) variance density of the random walk
    rigid_body: Array  # (6, 6)
    restoring: Array  # (6, 3)


class State(NamedTuple):
    """All that the next step needs."""

    x: Array  # (6 + n,)
    p: Array  # (6 + n, 6 + n)
    residual: Array  # (4, 6): stage 1, stage 2, last input, last momentum of the published residual
    process: Array  # (6,): variance density of the acceleration, adapted
    since: Array  # (6,): s since each velocity was measured
    scalars: Array  # (4,): t, 1 once nu is known, surprise, s of nothing but outliers


def problem(config: Config) -> Problem:
    """The constants of the estimation that a configuration asks for."""
    model, prior, u = config.model, prior_of(config), config.ukf
    n = len(prior.names)
    points = MerweScaledSigmaPoints(6 + n, u.alpha, u.beta, u.kappa)
    settings = np.zeros(1, dtype=_SETTINGS)
    settings["weight"] = points.Wc[1]
    settings["spread"] = np.sqrt(0.5 / points.Wc[1])
    settings["centre"] = u.beta - u.alpha**2
    settings["gate"] = u.gate
    settings["changed"] = u.change_threshold
    settings["process"] = np.square(u.process_std)
    settings["wrench"] = config.wrench.relative_std**2 * config.wrench.correlation_time
    settings["wrench_floor"] = np.square(config.wrench.floor_std) * config.wrench.correlation_time
    settings["corner"] = config.rls.filter_corner
    # Two fifths of the prior's width: straight where the coefficient is likely, bent close to zero.
    scale = np.where(prior.negative, 0.4 * prior.std, prior.std)
    # A coefficient configured as zero starts within reach of its scale: at exactly zero the
    # parametrisation has no slope.
    size = np.where(prior.negative, np.maximum(-prior.mean, scale), prior.mean)
    start = np.where(
        prior.negative, size / scale - scale / np.where(size == 0, 1, size), size / scale
    )
    slope = np.where(prior.negative, 0.5 * (1.0 + start / np.sqrt(start**2 + 4.0)), 1.0)
    deviation = prior.std / (slope * scale)
    walk = (u.random_walk * np.abs(size) / (slope * scale)) ** 2 / 3600.0
    return Problem(
        settings,
        model.structure,
        prior.estimated,
        model.theta,
        scale,
        prior.negative,
        start,
        deviation**2,
        walk,
        model.body.mass_matrix,
        model.body.restoring,
    )


def init(task: Problem) -> State:
    """Nothing learnt: the prior; the velocity is taken from the first measurement."""
    p = np.diag(np.concatenate([np.full(6, 1.0), task.prior_variance]))
    return State(
        np.concatenate([np.zeros(6), task.start]),
        p,
        np.zeros((4, 6)),
        task.settings["process"][0].copy(),
        np.zeros(6),
        np.array([0.0, 0.0, 1.0, 0.0]),
    )


def fold(task: Problem, state: State, samples: NDArray[np.void]) -> tuple[State, NDArray[np.void]]:
    """:func:`step` over samples (k,) of SAMPLE; info (k,) of INFO. The given state is unchanged."""
    state = State(*(part.copy() for part in state))
    info = np.zeros(len(samples), dtype=INFO)
    _fold(task, state, samples, info)
    return state, info


def step(task: Problem, state: State, sample: NDArray[np.void]) -> tuple[State, NDArray[np.void]]:
    """One sample (1,) of SAMPLE; the next state and what happened (1,) of INFO."""
    assert sample.dtype == SAMPLE and len(sample) == 1
    return fold(task, state, sample)


def estimate(task: Problem, state: State, prior: Prior) -> Estimate:
    """Coefficients and covariance (n, n) in their own units, to first order about the mean."""
    xi = state.x[6:]
    slope = _slope(task, xi)
    return Estimate(
        prior.names,
        coefficients(task, xi),
        state.p[6:, 6:] * np.outer(slope, slope),
        float(state.scalars[0]),
    )


def variance(task: Problem, state: State) -> Array:
    """Variances (n,), in squared units: what excitation is judged by."""
    variances: Array = np.diag(state.p)[6:] * _slope(task, state.x[6:]) ** 2
    return variances


def coefficients(task: Problem, xi: Array) -> Array:
    """theta (n,) of the estimated coefficients from xi (n,)."""
    out = np.empty((len(xi), 1))
    _coefficients(1, task.scale, task.negative, np.asarray(xi, dtype=float).reshape(-1, 1), out)
    return out[:, 0]


def _slope(task: Problem, xi: Array) -> Array:
    bent = -0.5 * (1.0 + xi / np.sqrt(xi**2 + 4.0))
    return task.scale * np.where(task.negative, bent, 1.0)


# ------------------------------------------------------------------ kernels


@kernel
def _coefficients(lanes, scale, negative, xi, theta):
    """theta (n, lanes) from xi (n, lanes)."""
    for j in range(len(scale)):
        if negative[j]:
            for k in range(lanes):
                theta[j, k] = -0.5 * scale[j] * (xi[j, k] + np.sqrt(xi[j, k] * xi[j, k] + 4.0))
        else:
            for k in range(lanes):
                theta[j, k] = scale[j] * xi[j, k]


@inlined
def _invert(lanes, mass, inverse, work):
    """Inverses of positive definite matrices (6, 6, lanes) by Gauss-Jordan, no pivoting."""
    for i in range(6):
        for j in range(6):
            for k in range(lanes):
                work[i, j, k] = mass[i, j, k]
                inverse[i, j, k] = 1.0 if i == j else 0.0
    for c in range(6):
        for k in range(lanes):
            work[6, 0, k] = 1.0 / work[c, c, k]
        for j in range(6):
            for k in range(lanes):
                work[c, j, k] *= work[6, 0, k]
                inverse[c, j, k] *= work[6, 0, k]
        for i in range(6):
            if i != c:
                for k in range(lanes):
                    work[6, 0, k] = work[i, c, k]
                for j in range(6):
                    for k in range(lanes):
                        work[i, j, k] -= work[6, 0, k] * work[c, j, k]
                        inverse[i, j, k] -= work[6, 0, k] * inverse[c, j, k]


@kernel
def _rates(structure, mass, inverse, theta, force, slope, late, nu, out, h, p, extended):
    """nu_dot (6, LANES) of sixteen states side by side, ``late`` seconds after mid-interval.

    force (6,) is wrench minus restoring in the mean over the interval, slope (6,) its trend.
    """
    generalized_force(LANES, structure, mass, theta, nu, h, p, extended)
    for i in range(6):
        for k in range(LANES):
            h[i, k] = force[i] + late * slope[i] - h[i, k]
    for i in range(6):
        for k in range(LANES):
            out[i, k] = inverse[i, 0, k] * h[0, k]
        for j in range(1, 6):
            for k in range(LANES):
                out[i, k] += inverse[i, j, k] * h[j, k]


@kernel
def _propagate(structure, mass, inverse, theta, force, slope, late, dt, nu, work):
    """One classical Runge-Kutta step of nu (6, LANES), in place; work (43, LANES) is scratch."""
    h, p, extended = work[0:6], work[6:12], work[12 : 12 + EXTENDED_SIZE]
    stage, rate, total = work[25:31], work[31:37], work[37:43]
    _rates(structure, mass, inverse, theta, force, slope, late, nu, rate, h, p, extended)
    for i in range(6):
        for k in range(LANES):
            total[i, k] = rate[i, k]
            stage[i, k] = nu[i, k] + 0.5 * dt * rate[i, k]
    for s in range(2):
        middle = late + 0.5 * dt
        _rates(structure, mass, inverse, theta, force, slope, middle, stage, rate, h, p, extended)
        f = 0.5 * dt if s == 0 else dt
        for i in range(6):
            for k in range(LANES):
                total[i, k] += 2.0 * rate[i, k]
                stage[i, k] = nu[i, k] + f * rate[i, k]
    _rates(structure, mass, inverse, theta, force, slope, late + dt, stage, rate, h, p, extended)
    for i in range(6):
        for k in range(LANES):
            nu[i, k] += dt / 6.0 * (total[i, k] + rate[i, k])


@kernel
def _cholesky(p, root):
    """Lower root (n, n) of p; False where p is not positive definite."""
    n = p.shape[0]
    for j in range(n):
        for i in range(j):
            root[i, j] = 0.0
        pivot = p[j, j]
        for k in range(j):
            pivot -= root[j, k] * root[j, k]
        if not pivot > 0.0:
            return False
        pivot = np.sqrt(pivot)
        root[j, j] = pivot
        for i in range(j + 1, n):
            total = p[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = total / pivot
    return True


@kernel
def _fold(task, state, samples, info):
    size = len(state.x)
    root = np.zeros((size, size))
    moved = np.empty((6, 2 * size))  # propagated velocities minus the centre's, + points then -
    xi = np.empty((size - 6, LANES))
    part = np.empty((size - 6, LANES))
    theta = np.empty((len(task.theta), LANES))
    mass, inverse = np.empty((6, 6, LANES)), np.empty((6, 6, LANES))
    scratch = np.empty((7, 6, LANES))
    nu, work = np.empty((6, LANES)), np.empty((43, LANES))
    moves = np.empty(len(task.theta), dtype=np.bool_)
    for k in range(len(samples)):
        sample, out = samples[k], info[k]
        out.t = sample.t
        out.forgetting = 1.0
        for i in range(6):
            out.residual[i] = np.nan
            out.ratio[i] = np.nan
        if not is_finite(sample):
            out.reason = NOT_FINITE
            continue
        state.scalars[0] = sample.t
        out.reason = USED
        if sample.restart or state.scalars[1] == 0.0 or not sample.dt > 0.0:
            _restart(state, sample)
            out.reason = RESTARTED
        else:
            in_motion(task.structure, sample.moving, moves)
            predicted = _predict(
                task, state, sample, out, root, moved, xi, part, theta, mass, inverse, scratch, nu,
                work,
            )  # fmt: skip
            if predicted:
                _update(task, state, sample, out, moves)
            else:
                out.reason = UNPREDICTABLE
                state.scalars[1] = 0.0
                continue
        _residual(task, state, sample, out, theta, mass, work, xi, part)


@kernel
def _restart(state, sample):
    """The velocity is lost, the coefficients are not: begin from the measurement."""
    for i in range(6):
        for j in range(len(state.x)):
            state.p[i, j] = 0.0
            state.p[j, i] = 0.0
        state.x[i] = sample.nu[i]
        variance = sample.odometry_variance[i]
        state.p[i, i] = variance if variance < 1.0 else 1.0
    state.scalars[1] = 1.0
    state.scalars[2] = 1.0
    state.scalars[3] = 0.0


@kernel
def _predict(
    task, state, sample, out, root, moved, xi, part, theta, mass, inverse, scratch, nu, work
):
    s = task.settings[0]
    x, p = state.x, state.p
    size, n = len(x), len(x) - 6
    if not _cholesky(p, root):
        # Rounding has made a direction negative: a little of the prior restores it.
        out.reason = REPAIRED
        for i in range(size):
            p[i, i] += 1e-9 * (task.prior_variance[i - 6] if i >= 6 else 1.0)
        if not _cholesky(p, root):
            for i in range(size):
                for j in range(size):
                    if i != j:
                        p[i, j] = 0.0
                p[i, i] = max(p[i, i], 1e-9)
            _cholesky(p, root)
    force, slope = np.empty(6), np.empty(6)
    for i in range(6):
        force[i], slope[i] = sample.wrench[i], sample.wrench_slope[i]
        for j in range(3):
            middle = sample.down[j] - 0.5 * sample.dt * sample.down_slope[j]
            force[i] += task.restoring[i, j] * middle
            slope[i] += task.restoring[i, j] * sample.down_slope[j]
    steps = max(1, int(np.ceil(sample.dt / _MAX_STEP - 1e-9)))
    dt = sample.dt / steps
    centre = np.empty(6)
    centre_inverse = np.empty((6, 6))
    # point 0 is the centre, 1 .. size the plus points, size + 1 .. 2 size the minus points
    points = 2 * size + 1
    for first in range(0, points, LANES):
        for k in range(LANES):
            point = min(first + k, points - 1)
            column = (point - 1) % size
            offset = 0.0 if point == 0 else (s.spread if point <= size else -s.spread)
            for i in range(6):
                nu[i, k] = x[i] + offset * root[i, column]
            for j in range(n):
                xi[j, k] = x[6 + j] + offset * root[6 + j, column]
        _model_of(task, xi, part, theta, mass)
        _invert(LANES, mass, inverse, scratch)
        for n_step in range(steps):
            late = n_step * dt - 0.5 * sample.dt
            _propagate(task.structure, mass, inverse, theta, force, slope, late, dt, nu, work)
        for k in range(LANES):
            point = first + k
            if point == 0:
                for i in range(6):
                    centre[i] = nu[i, 0]
                    for j in range(6):
                        centre_inverse[i, j] = inverse[i, j, 0]
            elif point < points:
                for i in range(6):
                    moved[i, point - 1] = nu[i, k] - centre[i]

    worst = 0.0
    for i in range(6):
        worst = max(worst, abs(centre[i]))
        for c in range(2 * size):
            worst = max(worst, abs(moved[i, c]))
    if not worst < _FASTEST:  # NaN too
        return False

    # covariance of the velocities and with the coefficients
    e = np.empty(6)
    for i in range(6):
        total = 0.0
        for c in range(2 * size):
            total += moved[i, c]
        e[i] = s.weight * total
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for c in range(2 * size):
                total += moved[i, c] * moved[j, c]
            noise = 0.0
            for a in range(6):
                strength = s.wrench * sample.wrench[a] ** 2 + s.wrench_floor[a]
                noise += centre_inverse[i, a] * centre_inverse[j, a] * strength
            if i == j:
                noise += state.process[i]
            p[i, j] = s.weight * total + s.centre * e[i] * e[j] + noise * sample.dt
            p[j, i] = p[i, j]
    for i in range(6):
        for j in range(n):
            total = 0.0
            for c in range(7 + j):  # the root is lower triangular
                total += (moved[i, c] - moved[i, size + c]) * root[6 + j, c]
            p[i, 6 + j] = s.weight * s.spread * total
            p[6 + j, i] = p[i, 6 + j]
        x[i] = centre[i] + e[i]
    for j in range(n):
        room = 1.0 - p[6 + j, 6 + j] / task.prior_variance[j]
        if room > 0.0:
            walk = task.walk[j]
            if state.scalars[2] > s.changed:
                walk = max(walk, task.prior_variance[j] / _RELEARNING_TIME)
            p[6 + j, 6 + j] += walk * sample.dt * room
    return True


@kernel
def _model_of(task, xi, part, theta, mass):
    """theta (m, LANES) and mass (6, 6, LANES) of the sigma points' xi (n, LANES)."""
    _coefficients(LANES, task.scale, task.negative, xi, part)
    for j in range(len(task.theta)):
        for k in range(LANES):
            theta[j, k] = task.theta[j]
    for j in range(len(task.scale)):
        for k in range(LANES):
            theta[task.estimated[j], k] = part[j, k]
    for i in range(6):
        for j in range(6):
            for k in range(LANES):
                mass[i, j, k] = task.rigid_body[i, j]
    add_added_mass(task.structure, theta, mass)


@kernel
def _update(task, state, sample, out, moves):
    """Linear and angular velocity, each behind its own gate, one component after another."""
    s = task.settings[0]
    x, p, size = state.x, state.p, len(state.x)
    z, r = np.empty(6), np.empty(6)
    for i in range(6):
        z[i], r[i] = sample.odometry[i], sample.odometry_variance[i]
        if i >= 3 and np.isfinite(sample.gyro[i - 3]):
            z[i], r[i] = sample.gyro[i - 3], sample.gyro_variance
        if not np.isfinite(r[i]):
            z[i] = np.nan
    part = np.zeros(size)
    surprise, count = 0.0, 0
    for i in range(6):
        state.since[i] += sample.dt
    for group in range(2):
        first = 3 * group
        if not np.isfinite(z[first] + z[first + 1] + z[first + 2]):
            continue
        worst = 0.0
        for i in range(first, first + 3):
            total = p[i, i] + r[i]
            out.ratio[i] = (z[i] - x[i]) ** 2 / total
            worst = max(worst, out.ratio[i])
            surprise += min(out.ratio[i], s.gate**2)
            count += 1
            excess = (min(out.ratio[i], _STEADY) - 1.0) * total
            blend = min(state.since[i] / _ADAPTATION_TIME, 0.1)
            density = state.process[i] + blend * excess / state.since[i]
            state.process[i] = max(density, s.process[i])
            state.since[i] = 0.0
        if worst > s.gate**2:
            out.reason = GATED
            continue
        state.scalars[3] = 0.0
        for i in range(first, first + 3):
            total = p[i, i] + r[i]
            innovation = z[i] - x[i]
            cross = p[:, i].copy()
            for a in range(size):
                considered = a >= 6 and not moves[task.estimated[a - 6]]
                part[a] = 0.0 if considered else cross[a] / total
                x[a] += part[a] * innovation
            for a in range(size):
                for b in range(a + 1):
                    p[a, b] -= part[a] * cross[b] + cross[a] * part[b] - total * part[a] * part[b]
                    p[b, a] = p[a, b]
    if out.reason == GATED:
        state.scalars[3] += sample.dt
        if state.scalars[3] > _LOST:
            _restart(state, sample)
            return
    if count > 0:
        blend = min(sample.dt / _SURPRISE_TIME, 1.0)
        state.scalars[2] += blend * (surprise / count - state.scalars[2])
    for j in range(len(task.scale)):
        if task.negative[j] and x[6 + j] < _LOWEST:
            x[6 + j] = _LOWEST


@kernel
def _residual(task, state, sample, out, theta, mass, work, xi, part):
    """Wrench, measured minus model at the present mean, low-passed like the RLS regression."""
    x, y, u, last = state.residual[0], state.residual[1], state.residual[2], state.residual[3]
    w, dt = task.settings[0].corner, sample.dt
    nu, h, p = work[0:6], work[6:12], work[12:18]
    extended = work[18 : 18 + EXTENDED_SIZE]
    for j in range(len(task.scale)):
        for k in range(LANES):
            xi[j, k] = state.x[6 + j]
    for i in range(6):
        for k in range(LANES):
            nu[i, k] = sample.nu[i]
    _model_of(task, xi, part, theta, mass)
    generalized_force(LANES, task.structure, mass, theta, nu, h, p, extended)
    a, b0, b1 = first_order(w, dt)
    for i in range(6):
        force = h[i, 0]
        for j in range(3):
            force -= task.restoring[i, j] * sample.down[j]
        now = w * p[i, 0] - force
        if out.reason == RESTARTED:
            x[i], y[i] = w * p[i, 0], 0.0
        else:
            before = x[i] - w * last[i]
            x[i] = a * x[i] + b0 * u[i] + b1 * now + (1.0 - a) * sample.wrench[i]
            x[i] += 0.5 * dt * (b1 - b0) * sample.wrench_slope[i]
            y[i] = a * y[i] + b0 * before + b1 * (x[i] - w * p[i, 0])
            out.residual[i] = y[i]
        u[i], last[i] = now, p[i, 0]
