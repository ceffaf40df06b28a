"""Unscented Kalman filter over body velocities and coefficients: ``init``, ``step``, ``fold``.

State ``x = [nu (6), xi (n)]`` with ``theta = scale xi``, the scale being the prior's standard
deviation. Linear: under any bent parametrisation, one that keeps signs for instance, early
information is reinterpreted whenever xi moves (N_r ended at fifteen times the Cramer-Rao bound).
Signs are for what leaves the filter (:func:`rov_ident.estimate.physical`); inside, a sigma point's
mass matrix is kept positive definite by raising the pivots of its factorisation.

Prediction: scaled sigma points (van der Merwe; as in filterpy) through one or more Runge-Kutta
steps of the equations of motion, LANES points side by side. The coefficients do not move and the
measurement is linear, so of the 2 (6 + n) + 1 points only the velocities are summed, as differences
from the centre point: with e = mean - centre and W the weight of an outer point

    cov = W sum(delta delta') + (beta - alpha^2) e e'

in which the huge central weight has cancelled exactly.

Update: odometry and gyro measure nu with independent noise, so one component after another is the
same as all at once; the covariance takes three of them together.

Coefficients whose motion is not well above its noise are *considered*, not estimated (Schmidt
1966): they stay what they are, their uncertainty is carried along. At rest a filter would else
learn from the difference between its assumed and the true noise.

Coefficients walk only on evidence: while the innovations are larger than they should be, variances
grow, up to the prior's and no further. (``ukf.random_walk`` lets them walk all the time.)

What the model leaves unexplained is found from the innovations (``process_noise``), and *standard
deviations* do not assume those white: the covariance of their summed influence on the coefficients,
with its correlation in time, stands between two covariances of the filter (the sandwich of Newey
and West 1987, with an exponential lag window).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.coefficients import EXTENDED_SIZE
from rov_ident.config import Config
from rov_ident.estimate import Estimate, Prior, calibrated, prior_of, theta_of
from rov_ident.jit import copy, inlined, inner, kernel, record, reordered
from rov_ident.model import (
    AHEAD,
    NODES,
    WEIGHTS,
    Structure,
    add_added_mass,
    generalized_force,
    in_motion,
    symmetric_product,
)
from rov_ident.process_noise import adapt, first_adaptation, interrupt, process, wrench_noise
from rov_ident.recursion import (
    FASTEST,
    INFO,
    LIGHTEST,
    RELEARNING_TIME,
    add_score,
    add_surprise,
    begin,
    steps_of,
)
from rov_ident.residual import filtered_residual
from rov_ident.samples import parts

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

LANES = 32  # sigma points side by side: with half as many their loops would not be vectorised
_PERIOD = 0.2  # s; the innovations' influence is summed and the coefficients walk this often
_ROOM = 1.5  # of the process noise: see process_noise.adapt (docs/accuracy.md)
_LOST = 2  # outliers in a row, of linear or of angular velocity, after which it is begun anew

_SETTINGS = record(
    [
        ("spread", "f8"),  # sqrt(n + lambda)
        ("weight", "f8"),  # of an outer sigma point
        ("centre", "f8"),  # beta - alpha^2
        ("gate", "f8"),
        ("changed", "f8"),  # surprise from which the vehicle is taken to have changed
        ("corner", "f8"),  # rad/s, of the published residual
    ],
)

_SCALARS = record(
    [
        ("t", "f8"),
        ("surprise", "f8", (6,)),  # normalised innovations squared, averaged: 1 when all is well
        ("refused", "i8", (2,)),  # outliers in a row, of linear and of angular velocity
        ("since", "f8"),  # s since the coefficients walked
        ("started", "?"),
    ],
)


class Problem(NamedTuple):
    """What does not change from sample to sample."""

    settings: NDArray[np.void]
    process: NDArray[np.void]  # (1,) of PROCESS
    structure: Structure
    estimated: NDArray[np.int64]  # (n,) indices into theta
    theta: Array  # (m,) held values of the coefficients that are not estimated
    scale: Array  # (n,) prior standard deviations
    start: Array  # (n,) xi of the prior
    walk: Array  # (n,) variance density of the random walk of xi, 1/s
    rigid_body: Array  # (6, 6)
    restoring: Array  # (6, 3)
    lightest: Array  # (6,) least pivots of a mass matrix


class State(NamedTuple):
    """All that the next step needs."""

    x: Array  # (6 + n,)
    p: Array  # (6 + n, 6 + n)
    residual: Array  # (4, 6): stage 1, stage 2, last input, last momentum of the published residual
    adaptation: NDArray[np.void]  # (6,) of ADAPTATION: of the process noise
    score: Array  # (n, n): covariance of the summed influence of the innovations, and of the prior
    lagged: Array  # (n,): that influence of late, under the lag window
    before: Array  # (n,): xi when it was last summed
    scalars: NDArray[np.void]  # (1,)


def problem(config: Config) -> Problem:
    """The constants of the estimation that a configuration asks for."""
    model, prior, u = config.dynamics, prior_of(config, effects=True), config.ukf
    n = len(prior.names)
    reach = u.alpha**2 * (6 + n + u.kappa)  # size of the state + lambda, van der Merwe (2004)
    settings = np.zeros(1, dtype=_SETTINGS)
    settings["weight"] = 0.5 / reach
    settings["spread"] = np.sqrt(reach)
    settings["centre"] = u.beta - u.alpha**2
    settings["gate"] = u.gate
    settings["changed"] = u.change_threshold
    settings["corner"] = config.residual_corner
    return Problem(
        settings,
        process(config),
        model.structure,
        prior.estimated,
        theta_of(config),
        prior.std,
        prior.mean / prior.std,
        (u.random_walk * prior.mean / prior.std) ** 2 / 3600.0,
        model.body.mass_matrix,
        model.body.restoring,
        # so that no hull with positive added mass is touched
        LIGHTEST * np.diag(np.linalg.cholesky(model.body.mass_matrix)) ** 2,
    )


def init(task: Problem) -> State:
    """Nothing learnt: the prior; the velocity is taken from the first measurement."""
    n = len(task.scale)
    scalars = np.zeros(1, dtype=_SCALARS)
    scalars["surprise"] = 1.0
    return State(
        np.concatenate([np.zeros(6), task.start]),
        np.eye(6 + n),
        np.zeros((4, 6)),
        first_adaptation(task.process),
        np.eye(n),
        np.zeros(n),
        task.start.copy(),
        scalars,
    )


def fold(task: Problem, state: State, samples: NDArray[np.void]) -> tuple[State, NDArray[np.void]]:
    """:func:`step` over samples (k,) of SAMPLE; info (k,) of INFO. The given state is unchanged."""
    state = State(*(part.copy() for part in state))
    info = np.zeros(len(samples), dtype=INFO)
    _fold(task, state, *parts(samples), info)
    return state, info


def step(task: Problem, state: State, sample: NDArray[np.void]) -> tuple[State, NDArray[np.void]]:
    """One sample (1,) of SAMPLE; the next state and what happened (1,) of INFO."""
    assert len(sample) == 1
    return fold(task, state, sample)


def estimate(task: Problem, state: State, prior: Prior) -> Estimate:
    """Coefficients and covariance (n, n), calibrated for coloured residuals, in their own units."""
    return Estimate(
        prior.names,
        task.scale * state.x[6:],
        calibrated(state.p[6:, 6:], state.score) * np.outer(task.scale, task.scale),
        float(state.scalars["t"][0]),
    )


def variance(task: Problem, state: State) -> Array:
    """Variances (n,) of the filter, in squared units: what excitation is judged by."""
    variances: Array = np.diag(state.p)[6:] * task.scale**2
    return variances


def condition(task: Problem, state: State) -> float:
    """Condition number of the information's root as :func:`rov_ident.rls.condition` has it."""
    return float(np.sqrt(np.linalg.cond(state.p[6:, 6:], 1)))


# ------------------------------------------------------------------ kernels

_SCRATCH = record(
    [
        # sigma points, and the forces on them
        ("nu", "f8", (6, LANES)),
        ("mass", "f8", (6, 6, LANES)),
        ("inverse", "f8", (6, 6, LANES)),  # its lower half
        ("h", "f8", (6, LANES)),
        ("extended", "f8", (EXTENDED_SIZE, LANES)),
        ("stage", "f8", (6, LANES)),
        ("total", "f8", (6, LANES)),
        ("push", "f8", (6, LANES)),  # wrench that parameters of effects add
        # the centre point
        ("centre", "f8", (6,)),  # nu
        ("centre_inverse", "f8", (6, 6)),
        ("shift", "f8", (6,)),  # mean minus centre
        # of the sample
        ("force", "f8", (6,)),  # wrench minus restoring in mid-interval
        ("slope", "f8", (6,)),
        ("strength", "f8", (6,)),  # variance density of the wrench
        ("z", "f8", (6,)),  # nu as measured
        ("r", "f8", (6,)),  # its variance
        # the estimate, for the residual
        ("mean_nu", "f8", (6, 1)),
        ("mean_mass", "f8", (6, 6, 1)),
        ("mean_h", "f8", (6, 1)),
        ("mean_wrench", "f8", (6,)),
        ("mean_extended", "f8", (EXTENDED_SIZE, 1)),
    ],
)


class Work(NamedTuple):
    """Scratch for all samples of a fold. Zeros fill the rows of matrices to a multiple of LANES."""

    p: Array  # (6 + n, columns): the covariance
    upper: Array  # (6 + n, columns)
    root: Array  # (6 + n, columns): lower root of p; a column of zeros is the centre point
    moved: Array  # (2, 6, columns): nu of the points on the + and - side of each column
    cross: Array  # (3, columns)
    gain: Array  # (3, columns)
    block: Array  # (3, n, columns): for the covariance of the coefficients alone
    free: Array  # (columns,): 1 where a state is estimated, 0 where it is only considered
    moves: NDArray[np.bool_]  # (m,)
    theta: Array  # (m, LANES)
    mean: Array  # (m, 1)
    scratch: NDArray[np.void]  # (1,): in one record, whose parts the compiler knows apart


@inlined
def _work(task, state):
    size, m = len(state.x), len(task.theta)
    columns = LANES * (size // LANES + 1)
    work = Work(
        np.zeros((size, columns)),
        np.zeros((size, columns)),
        np.zeros((size, columns)),
        np.empty((2, 6, columns)),
        np.zeros((3, columns)),
        np.zeros((3, columns)),
        np.zeros((3, size - 6, columns)),
        np.zeros(columns),
        np.empty(m, dtype=np.bool_),
        np.empty((m, LANES)),
        np.empty((m, 1)),
        np.empty(1, dtype=_SCRATCH),
    )
    copy(state.p, work.p)
    for j in range(m):
        work.mean[j, 0] = task.theta[j]
        for k in range(LANES):
            work.theta[j, k] = task.theta[j]
    mass = work.scratch[0].mass
    for i in range(6):
        for j in range(6):
            for k in range(LANES):
                mass[i, j, k] = task.rigid_body[i, j]
    return work


@kernel
def _fold(task, state, samples, sides, info):
    work = _work(task, state)
    _steps(task, state, work, samples, sides, info)
    copy(work.p, state.p)


@inner
def _steps(task, state, work, samples, sides, infos):
    """The fold itself, apart from what makes its arrays (:func:`rov_ident.jit.lean`)."""
    c = state.scalars[0]
    for k in range(len(samples)):
        sample, info, side = samples[k], infos[k], sides[k if sides.shape[2] > 0 else 0]
        if not begin(info, sample):
            info.reason = NOT_FINITE
            continue
        c.t = sample.t
        info.reason = USED
        if sample.restart or not c.started or not sample.dt > 0.0:
            _restart(state, work.p, sample)
            for i in range(6):
                c.surprise[i] = 1.0
            info.reason = RESTARTED
        else:
            _take_root(task, work, info)
            _move(task, state.x, work, sample, side)
            if not _collect(task, state, work, sample):
                info.reason = UNPREDICTABLE
                c.started = False
                continue
            in_motion(task.structure, sample.moving, work.moves)
            for e in range(len(task.theta) - side.shape[1], len(task.theta)):
                work.moves[e] = True
            for i in range(len(state.x)):
                work.free[i] = 1.0 if i < 6 or work.moves[task.estimated[i - 6]] else 0.0
            _update(task, state, work, sample, side, info)
            _look_back(task, state, work, sample.dt)
        _residual(task, state, work, sample, side, info)


@inner
def _restart(state, p, sample):
    """The velocity is lost, the coefficients are not: begin from the measurement."""
    for i in range(6):
        for j in range(len(state.x)):
            p[i, j] = 0.0
            p[j, i] = 0.0
        state.x[i] = sample.nu[i]
        variance = sample.odometry_variance[i]
        p[i, i] = variance if variance < 1.0 else 1.0
        interrupt(state.adaptation[i])
    c = state.scalars[0]
    c.started, c.refused[0], c.refused[1] = True, 0, 0


# ---------------------------------------------------------------- prediction


@inlined
def _take_root(task, work, out):
    """work.root of work.p, which is repaired where rounding has made a direction negative."""
    p, size = work.p, len(work.p)
    for attempt in range(3):
        if _cholesky(p, work.upper, work.root):
            break
        out.reason = REPAIRED
        for i in range(size):
            if attempt == 0:  # a little of the prior
                p[i, i] += 1e-9
            else:
                for j in range(i):
                    p[i, j] = 0.0
                    p[j, i] = 0.0
                p[i, i] = max(p[i, i], 1e-9)


@reordered
def _cholesky(p, upper, root):
    """Lower root (size, columns) of p (size, columns); False where p is not positive definite.

    Three rows of the upper root at a time, so that a row below is loaded a third as often.
    """
    size, columns = p.shape
    copy(p, upper)
    for first in range(0, size, 3):
        end = min(first + 3, size)
        for j in range(first, end):
            if not upper[j, j] > 0.0:
                return False
            f = 1.0 / np.sqrt(upper[j, j])
            for k in range(columns):
                upper[j, k] *= f
            for i in range(j + 1, end):
                f = upper[j, i]
                for k in range(columns):
                    upper[i, k] -= f * upper[j, k]
        for i in range(end, size):
            f, g, h = upper[first, i], upper[first + 1, i], upper[first + 2, i]
            for k in range(columns):
                upper[i, k] -= (
                    f * upper[first, k] + g * upper[first + 1, k] + h * upper[first + 2, k]
                )
    for i in range(size):
        for j in range(i + 1):
            root[i, j] = upper[j, i]
    return True


@inlined
def _move(task, x, work, sample, side):
    """Move the sigma points to the sample's time: work.moved, and the centre's inverse mass."""
    s, spread, columns = work.scratch[0], task.settings[0].spread, work.root.shape[1]
    for i in range(6):
        s.force[i], s.slope[i] = sample.wrench[i], sample.wrench_slope[i]
        for j in range(3):
            middle = sample.down[j] - 0.5 * sample.dt * sample.down_slope[j]
            s.force[i] += task.restoring[i, j] * middle
            s.slope[i] += task.restoring[i, j] * sample.down_slope[j]
    steps = steps_of(sample.dt)
    dt = sample.dt / steps
    for sign in range(2):
        for first in range(0, columns, LANES):
            _spread(task, x, work, first, spread if sign == 0 else -spread)
            _push(task, work, side)
            for k in range(steps):
                _propagate(task.structure, work, k * dt - 0.5 * sample.dt, dt)
            for i in range(6):
                row = work.moved[sign, i, first : first + LANES]
                for k in range(LANES):
                    row[k] = s.nu[i, k]
    for i in range(6):  # the last column is one of zeros
        s.centre[i] = s.nu[i, LANES - 1]
        for j in range(i + 1):
            s.centre_inverse[i, j] = s.inverse[i, j, LANES - 1]
            s.centre_inverse[j, i] = s.inverse[i, j, LANES - 1]


@reordered
def _spread(task, x, work, first, spread):
    """Sigma points x + spread * column: their velocities, coefficients, mass matrices."""
    s, theta, structure = work.scratch[0], work.theta, task.structure
    for i in range(6):
        root = work.root[i, first : first + LANES]
        for k in range(LANES):
            s.nu[i, k] = x[i] + spread * root[k]
    for j in range(len(task.scale)):
        root = work.root[6 + j, first : first + LANES]
        e, scale, mean = task.estimated[j], task.scale[j], x[6 + j]
        for k in range(LANES):
            theta[e, k] = scale * (mean + spread * root[k])
    for i in range(6):
        for k in range(LANES):
            s.mass[i, i, k] = task.rigid_body[i, i]
    for c in range(len(structure.mass_row)):
        i, j = structure.mass_row[c], structure.mass_column[c]
        for k in range(LANES):
            s.mass[i, j, k] = task.rigid_body[i, j]
            s.mass[j, i, k] = task.rigid_body[i, j]
    add_added_mass(structure, theta, s.mass)
    _invert(s.mass, task.lightest, s.inverse)


@inlined
def _push(task, work, side):
    """What the parameters of effects add to the wrench on the sigma points."""
    s, first = work.scratch[0], len(task.theta) - side.shape[1]
    for i in range(6):
        for k in range(LANES):
            s.push[i, k] = 0.0
        for j in range(side.shape[1]):
            for k in range(LANES):
                s.push[i, k] += side[i, j] * (work.theta[first + j, k] - side[12, j])


@reordered
def _propagate(structure, work, late, dt):
    """One Runge-Kutta step of the sigma points, beginning ``late`` seconds after mid-interval."""
    s = work.scratch[0]
    nu, stage, total, h, force, slope = s.nu, s.stage, s.total, s.h, s.force, s.slope
    push = s.push
    for i in range(6):
        for k in range(LANES):
            stage[i, k] = nu[i, k]
            total[i, k] = nu[i, k]
    for n in range(4):
        generalized_force(LANES, structure, s.mass, work.theta, stage, h, s.extended)
        at = late + NODES[n] * dt
        a, b, c = force[0] + at * slope[0], force[1] + at * slope[1], force[2] + at * slope[2]
        d, e, f = force[3] + at * slope[3], force[4] + at * slope[4], force[5] + at * slope[5]
        weight, ahead = WEIGHTS[n] * dt, AHEAD[n] * dt
        for k in range(LANES):
            rest = (
                a + push[0, k] - h[0, k], b + push[1, k] - h[1, k], c + push[2, k] - h[2, k],
                d + push[3, k] - h[3, k], e + push[4, k] - h[4, k], f + push[5, k] - h[5, k],
            )  # fmt: skip
            nu_dot = symmetric_product(s.inverse, rest, k)
            for i in range(6):
                total[i, k] += weight * nu_dot[i]
                stage[i, k] = nu[i, k] + ahead * nu_dot[i]
    for i in range(6):
        for k in range(LANES):
            nu[i, k] = total[i, k]


@reordered
def _collect(task, state, work, sample):
    """Mean and covariance of the moved points: of nu, and of nu with the coefficients.

    False where the model takes a point out of all reason.
    """
    s, c = work.scratch[0], task.settings[0]
    x, p, root, plus, minus = state.x, work.p, work.root, work.moved[0], work.moved[1]
    size, columns = p.shape
    doubtful = wrench_noise(task.process[0], sample, s.strength)
    speed = 0.0
    for i in range(6):
        total = 0.0
        for k in range(columns):
            speed += plus[i, k] ** 2 + minus[i, k] ** 2
            plus[i, k] -= s.centre[i]
            minus[i, k] -= s.centre[i]
            total += plus[i, k] + minus[i, k]
        s.shift[i] = c.weight * total
    if not speed < 2 * columns * FASTEST**2:  # NaN too
        return False
    for i in range(6):
        x[i] = s.centre[i] + s.shift[i]
        for j in range(i + 1):
            total = 0.0
            for k in range(columns):
                total += plus[i, k] * plus[j, k] + minus[i, k] * minus[j, k]
            noise = state.adaptation[i].density if i == j else 0.0
            for a in range(6):
                noise += s.centre_inverse[i, a] * s.centre_inverse[j, a] * s.strength[a]
            # the last one stays: of the axis itself
            state.adaptation[i].acting = 0.0 if doubtful else noise
            total = c.weight * total + c.centre * s.shift[i] * s.shift[j] + noise * sample.dt
            p[i, j] = total
            p[j, i] = total
    for i in range(6):
        for k in range(columns):
            plus[i, k] = c.weight * c.spread * (plus[i, k] - minus[i, k])
    for j in range(6, size):
        for i in range(0, 6, 3):
            u, v, w = 0.0, 0.0, 0.0
            for k in range(columns):
                u += plus[i, k] * root[j, k]
                v += plus[i + 1, k] * root[j, k]
                w += plus[i + 2, k] * root[j, k]
            p[i, j], p[i + 1, j], p[i + 2, j] = u, v, w
            p[j, i], p[j, i + 1], p[j, i + 2] = u, v, w
    return True


# ---------------------------------------------------------------- inverse mass


@inlined
def _block(m, i, j, k):
    """The 3 x 3 block at i, j of m (6, 6, LANES) in lane k, as a tuple of rows."""
    return (
        (m[i, j, k], m[i, j + 1, k], m[i, j + 2, k]),
        (m[i + 1, j, k], m[i + 1, j + 1, k], m[i + 1, j + 2, k]),
        (m[i + 2, j, k], m[i + 2, j + 1, k], m[i + 2, j + 2, k]),
    )


@inlined
def _put(m, i, j, k, f, a):
    """Write f a to where :func:`_block` would find it."""
    m[i, j, k], m[i, j + 1, k], m[i, j + 2, k] = f * a[0][0], f * a[0][1], f * a[0][2]
    m[i + 1, j, k], m[i + 1, j + 1, k], m[i + 1, j + 2, k] = f * a[1][0], f * a[1][1], f * a[1][2]
    m[i + 2, j, k], m[i + 2, j + 1, k], m[i + 2, j + 2, k] = f * a[2][0], f * a[2][1], f * a[2][2]


@inlined
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _plus(a, f, b, c):
    """A + f B C' (3 x 3)."""
    x, y, z = c
    return (
        (a[0][0] + f * _dot(b[0], x), a[0][1] + f * _dot(b[0], y), a[0][2] + f * _dot(b[0], z)),
        (a[1][0] + f * _dot(b[1], x), a[1][1] + f * _dot(b[1], y), a[1][2] + f * _dot(b[1], z)),
        (a[2][0] + f * _dot(b[2], x), a[2][1] + f * _dot(b[2], y), a[2][2] + f * _dot(b[2], z)),
    )


@inlined
def _transposed(a):
    x, y, z = a
    return (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])


@inlined
def _inverse(a, least):
    """Of a symmetric 3 x 3 matrix, its pivots raised to ``least``; what that adds to its diagonal.

    ``A + E = L D L'`` with L's entries l, m (first column) and n.
    """
    d = a[0][0] if a[0][0] > least[0] else least[0]
    l, m, x = a[0][1] / d, a[0][2] / d, 1.0 / d
    pivot = a[1][1] - l * a[0][1]
    e = pivot if pivot > least[1] else least[1]
    rest = a[1][2] - l * a[0][2]
    n, y = rest / e, 1.0 / e
    last = a[2][2] - m * a[0][2] - n * rest
    f = last if last > least[2] else least[2]
    z, k = 1.0 / f, l * n - m
    ny, nz = -l * y - k * n * z, -n * z
    return (
        ((x + l * l * y + k * k * z, ny, k * z), (ny, y + n * n * z, nz), (k * z, nz, z)),
        (d - a[0][0], e - pivot, f - last),
    )


@inlined
def _invert(m, lightest, inverse):
    """Lower half of the inverses (6, 6, LANES) of symmetric m (6, 6, LANES) = [[A, B'], [B, D]].

    In 3 x 3 blocks, with V = A^-1 B', the Schur complement S = D - B V and U = V S^-1::

        m^-1 = [[A^-1 + U V', -U], [-U', S^-1]]

    The pivots of A and S are those of m. Where one is less than ``lightest`` (6,), m has no inertia
    left in some direction, as the outer points of a wide prior may have: m gets so much more on its
    diagonal that it has (as in Gill, Murray and Wright 1981, sec. 4.4.2.2).
    """
    none = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    first = lightest[0], lightest[1], lightest[2]
    last = lightest[3], lightest[4], lightest[5]
    for k in range(LANES):
        b = _block(m, 3, 0, k)
        a, more = _inverse(_block(m, 0, 0, k), first)
        v = _plus(none, 1.0, a, b)
        s, yet_more = _inverse(_plus(_block(m, 3, 3, k), -1.0, b, _transposed(v)), last)
        u = _plus(none, 1.0, v, s)
        _put(inverse, 0, 0, k, 1.0, _plus(a, 1.0, u, v))
        _put(inverse, 3, 0, k, -1.0, _transposed(u))
        _put(inverse, 3, 3, k, 1.0, s)
        m[0, 0, k], m[1, 1, k], m[2, 2, k] = (
            m[0, 0, k] + more[0], m[1, 1, k] + more[1], m[2, 2, k] + more[2],
        )  # fmt: skip
        m[3, 3, k], m[4, 4, k], m[5, 5, k] = (
            m[3, 3, k] + yet_more[0], m[4, 4, k] + yet_more[1], m[5, 5, k] + yet_more[2],
        )  # fmt: skip


# ---------------------------------------------------------------- update


@inlined
def _update(task, state, work, sample, side, out):
    """Linear and angular velocity, each behind its own gate."""
    s, c, scratch = task.settings[0], state.scalars[0], work.scratch[0]
    x, p, z, r = state.x, work.p, scratch.z, scratch.r
    for i in range(6):
        z[i], r[i] = sample.odometry[i], sample.odometry_variance[i]
        if i >= 3 and np.isfinite(sample.gyro[i - 3]):
            z[i], r[i] = sample.gyro[i - 3], sample.gyro_variance
        if not np.isfinite(r[i]):
            z[i] = np.nan
        for j in range(side.shape[1]):
            z[i] += side[6 + i, j] * side[12, j]
    moving = 0
    for i in range(6):
        state.adaptation[i].since += sample.dt
        moving += sample.moving[i]
    for first in (0, 3):
        if not np.isfinite(z[first] + z[first + 1] + z[first + 2]):
            continue
        worst = 0.0
        for i in range(first, first + 3):
            predicted, spread = _seen(task, x, p, side, i)
            innovation = (z[i] - predicted) / np.sqrt(spread + r[i])
            out.ratio[i] = innovation**2
            worst = max(worst, out.ratio[i])
            since = state.adaptation[i].since
            if moving == 0:  # on the ground, on deck: what holds it there says nothing of the dive
                interrupt(state.adaptation[i])
                add_surprise(c.surprise, i, 1.0, since)
                continue
            add_surprise(c.surprise, i, out.ratio[i], since)
            adapt(state.adaptation[i], task.process[0], i, _ROOM, innovation)
        if worst > s.gate**2:
            out.reason = GATED
            c.refused[first // 3] += 1
            continue
        c.refused[first // 3] = 0
        _absorb(task, x, work, side, first)
    # One alone is the sensor's. After two it was the wrench, and the velocity is lost.
    if c.refused[0] >= _LOST or c.refused[1] >= _LOST:
        _restart(state, p, sample)


@inlined
def _seen(task, x, p, side, i):
    """A velocity as measured, with what parameters of effects add to it, and its variance."""
    predicted, spread, k = x[i], p[i, i], side.shape[1]
    first, scale = len(x) - k, len(task.scale) - k
    for j in range(k):
        f = side[6 + i, j] * task.scale[scale + j]
        predicted += f * x[first + j]
        spread += 2.0 * f * p[i, first + j]
        for l in range(k):
            spread += f * side[6 + i, l] * task.scale[scale + l] * p[first + j, first + l]
    return predicted, spread


@reordered
def _absorb(task, x, work, side, first):
    """Take in three measured velocities, from ``first`` on, one after the other.

    With w the covariance with the innovation over its standard deviation, p loses w w', but for the
    block of the states that are only considered: they tell nothing of one another.
    """
    p, cross, gain, free = work.p, work.cross, work.gain, work.free
    s, size, columns = work.scratch[0], p.shape[0], p.shape[1]
    last = len(task.scale) - side.shape[1]  # so many coefficients, then parameters of effects
    for c in range(3):
        i = first + c
        for k in range(columns):
            cross[c, k] = p[i, k]
        for j in range(side.shape[1]):
            f = side[6 + i, j] * task.scale[last + j]
            for k in range(columns):
                cross[c, k] += f * p[6 + last + j, k]
        for b in range(c):
            f = cross[b, i]
            for j in range(side.shape[1]):
                f += side[6 + i, j] * task.scale[last + j] * cross[b, 6 + last + j]
            for k in range(columns):
                cross[c, k] -= f * cross[b, k]
        total, predicted = cross[c, i], x[i]
        for j in range(side.shape[1]):
            f = side[6 + i, j] * task.scale[last + j]
            total += f * cross[c, 6 + last + j]
            predicted += f * x[6 + last + j]
        f = 1.0 / np.sqrt(total + s.r[i])
        innovation = f * (s.z[i] - predicted)
        for k in range(columns):
            cross[c, k] *= f
            gain[c, k] = cross[c, k] * free[k]
        for j in range(size):
            x[j] += gain[c, j] * innovation
    for i in range(size):
        w = cross if free[i] != 0.0 else gain
        f, g, h = cross[0, i], cross[1, i], cross[2, i]
        for k in range(columns):
            p[i, k] -= f * w[0, k] + g * w[1, k] + h * w[2, k]


# ---------------------------------------------------------------- looking back


@inlined
def _look_back(task, state, work, dt):
    """Every _PERIOD: what the innovations did to the coefficients, and the random walk of these."""
    c = state.scalars[0]
    c.since += dt
    if c.since < _PERIOD:
        return
    _sum_up(state, work, c.since)
    changed = False
    for i in range(6):
        changed |= c.surprise[i] > task.settings[0].changed
    _walk(task, state, work, changed, c.since)
    c.since = 0.0


@reordered
def _sum_up(state, work, since):
    """With ``change = P g``, g is what innovations have added to the information's right side."""
    n, p = len(state.before), work.p
    matrix, upper, root = work.block[0], work.block[1], work.block[2]
    for j in range(n):
        for k in range(n):
            matrix[j, k] = p[6 + j, 6 + k]
    if not _cholesky(matrix, upper, root):
        return
    g = work.gain[0]
    for j in range(n):
        g[j] = state.x[6 + j] - state.before[j]
        state.before[j] = state.x[6 + j]
    _solve(root, n, g)
    add_score(g, state.lagged, state.score, since)


@reordered
def _walk(task, state, work, changed, elapsed):
    """Variances grow by G, less and less up to the prior's; the sandwich P S P grows alike.

    Hence with ``W = P_new^-1 G``, ``S_new = (1 - W) S (1 - W)' + W P_new^-1``.
    """
    n, p = len(state.before), work.p
    matrix, upper, root = work.block[0], work.block[1], work.block[2]
    grown, most = work.cross[0], 0.0
    for j in range(n):
        walk = task.walk[j]
        if changed:
            walk = max(walk, 1.0 / RELEARNING_TIME)
        grown[j] = elapsed * walk * max(1.0 - p[6 + j, 6 + j], 0.0)
        most = max(most, grown[j])
    if most == 0.0:
        return
    for j in range(n):
        p[6 + j, 6 + j] += grown[j]
        for k in range(n):
            matrix[j, k] = p[6 + j, 6 + k]
    if not _cholesky(matrix, upper, root):
        return
    inverse, score, lagged = upper, state.score, state.lagged
    for j in range(n):
        row = inverse[j]
        for k in range(n):
            row[k] = 1.0 if j == k else 0.0
        _solve(root, n, row)
    # T = 1 - W, then T S into matrix, then T S T' + W P_new^-1
    for j in range(n):
        for k in range(n):
            root[j, k] = (1.0 if j == k else 0.0) - inverse[j, k] * grown[k]
    for j in range(n):
        for k in range(n):
            matrix[j, k] = 0.0
        for a in range(n):
            f = root[j, a]
            for k in range(n):
                matrix[j, k] += f * score[a, k]
    for j in range(n):
        for k in range(n):
            total = 0.0
            for a in range(n):
                total += matrix[j, a] * root[k, a] + inverse[j, a] * grown[a] * inverse[a, k]
            score[j, k] = total
    for j in range(n):
        total = 0.0
        for k in range(n):
            total += root[j, k] * lagged[k]
        grown[j] = total
    for j in range(n):
        lagged[j] = grown[j]


@inner
def _solve(root, n, x):
    """x (n,) of L L' x = x, in place; L the lower root."""
    for j in range(n):
        for k in range(j):
            x[j] -= root[j, k] * x[k]
        x[j] /= root[j, j]
    for j in range(n - 1, -1, -1):
        for k in range(j + 1, n):
            x[j] -= root[k, j] * x[k]
        x[j] /= root[j, j]


# ---------------------------------------------------------------- residual


@inlined
def _residual(task, state, work, sample, side, out):
    """Wrench, measured minus model at the present mean, low-passed like the RLS regression."""
    s, theta = work.scratch[0], work.mean
    nu, mass, h, wrench = s.mean_nu, s.mean_mass, s.mean_h, s.mean_wrench
    for j in range(len(task.scale)):
        theta[task.estimated[j], 0] = task.scale[j] * state.x[6 + j]
    first = len(task.theta) - side.shape[1]
    for i in range(6):
        wrench[i] = sample.wrench[i]
        for j in range(side.shape[1]):
            wrench[i] += side[i, j] * (theta[first + j, 0] - side[12, j])
        for j in range(6):
            mass[i, j, 0] = task.rigid_body[i, j]
    add_added_mass(task.structure, theta, mass)
    filtered_residual(
        task.structure, theta, mass, task.restoring, task.settings[0].corner, state.residual,
        sample, wrench, out.reason == RESTARTED, nu, h, s.mean_extended, out.residual,
    )  # fmt: skip
