"""Recursive least squares over the filtered 6-DOF regressor, as ``init``, ``step`` and ``fold``.

The wrench is linear in the coefficients, ``tau = d/dt(P theta) + H theta + known``
(:func:`rov_ident.model.columns`). Every channel, the measured wrench included, goes through one
low-pass filter F, so that no acceleration is measured and no phase difference biases the fit::

    F(s) = (w / (s + w))^2,   y = F[tau - known],   Phi = s F[P] + F[H],   y = Phi theta + noise

The derivative is exact: ``s w/(s + w) P = w (P - x)`` where x is the filtered P. Started with
``x(0) = P(0)`` there is no transient, so that a gap in the data costs nothing but itself.

The information is kept as a triangular root R of ``R'R = sum of Phi' Phi / sigma^2`` (Householder;
it keeps half the digits that the covariance form loses), in coefficients scaled by their prior
standard deviation about their prior value: the prior is the unit matrix.

*Columns* count where the motion they multiply is well above its noise, *rows* where the thrusters
drive their axis. Where the residual is larger than the wrench, the motion has other causes (a
tether, waves, the wash of another axis) which are correlated with it, and least squares would turn
that into coefficients.

*Forgetting* touches only directions that the present motion excites (subspace-of-information
forgetting, Lai and Bernstein 2024): unexcited ones keep their information, so nothing winds up.
What is forgotten leaves the root while the new rows come in, as rows of negative sign (hyperbolic
Householder); no direction loses more than ``1 - factor`` of its information, so that is as safe.

*Standard deviations* do not assume white residuals: the covariance of the accumulated score
``sum of Phi' e / sigma^2``, with its correlation in time, stands between two inverse informations
(the sandwich of Newey and West 1987, with an exponential lag window).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.estimate import Estimate, Prior, prior_of
from rov_ident.excitation import authority
from rov_ident.jit import inlined, inner, kernel, reordered
from rov_ident.model import Structure, columns, coriolis_of, in_motion
from rov_ident.samples import SAMPLE

Array = NDArray[np.float64]

USED, RESTARTED, WAITING, GATED, NOT_FINITE = range(5)
REASONS = (
    "used",
    "restarted after a gap",
    "between updates",
    "outlier",
    "not finite",
)

REFUSALS = (GATED, NOT_FINITE)

INFO = np.dtype(
    [
        ("t", "f8"),
        ("reason", "i8"),  # index into REASONS
        ("residual", "f8", (6,)),  # N, N m: filtered wrench, measured minus model
        ("ratio", "f8", (6,)),  # squared residual over its predicted variance
        ("forgetting", "f8"),
        ("condition", "f8"),  # as of condition(), before the sample; NaN: not looked at
    ],
    align=True,
)

_WILD = 100.0  # sigma; an outlier that no change of the vehicle can be
_PATIENCE = 1.5  # lesser outliers in short order from which the vehicle has changed
_PATIENCE_TIME = 3.0  # s; over which that is counted
_STEADY = 4.0  # a squared residual counts for at most this often its variance: a change of the
# vehicle is noticed by the surprise long before it passes for noise
_SETTLED = 100  # updates after which the residual's variance is known roughly
_SURPRISE_TIME = 2.0  # s; over which the normalised innovation is averaged
_SURPRISING = 2.0  # its value from which old data are forgotten; 1 is expected
_FORGETTING_TIME = 2.0  # s; memory while surprised
_DRIVE_TIME = 20.0  # s; memory of how strongly an axis is driven
_NOISE_TIME = 60.0  # s; memory of the residual's variance
_EXCITED = 0.01  # a row with less information than this, relative to the prior, excites nothing

_SETTINGS = np.dtype(
    [
        ("corner", "f8"),
        ("period", "f8"),
        ("gate", "f8"),
        ("forgetting_factor", "f8"),
        ("variable", "?"),
        ("lag", "f8"),  # s, of the window over the residual's correlation
        ("floor", "f8", (6,)),  # smallest residual standard deviation
    ],
    align=True,
)

_SCALARS = np.dtype(
    [
        ("t", "f8"),
        ("since_update", "f8"),
        ("variance", "f8", (6,)),  # of the filtered residual
        ("wrench", "f8", (6,)),  # filtered once
        ("drive", "f8", (6,)),  # its mean square of late
        ("surprise", "f8"),  # normalised innovation squared, averaged: 1 when all is well
        ("refused", "f8"),  # outliers of late
        ("updates", "i8"),
        ("started", "?"),
    ],
    align=True,
)


class Problem(NamedTuple):
    """What does not change from sample to sample."""

    settings: NDArray[np.void]
    structure: Structure
    estimated: NDArray[np.int64]  # indices into theta
    theta: Array  # (m,) values of all coefficients: the prior of the estimated, the held others
    scale: Array  # (n,) prior standard deviations
    rigid_body: Array  # (6, 6)
    restoring: Array  # (6, 3)


class State(NamedTuple):
    """All that the next step needs."""

    root: Array  # (n, n + 1): [R | z], R upper triangular, of the scaled deviation from the prior
    score: Array  # (n, n): covariance of the accumulated score, the prior's included
    lagged: Array  # (n,): recent scores under the lag window
    filters: Array  # (4, 6, n + 1): stage 1, stage 2, last input, last momentum; last column: known
    scalars: NDArray[np.void]  # (1,)


def problem(config: Config) -> Problem:
    """The constants of the estimation that a configuration asks for."""
    model, prior = config.dynamics, prior_of(config)
    settings = np.zeros(1, dtype=_SETTINGS)
    settings["corner"] = config.residual_corner
    settings["period"] = 0.1
    settings["gate"] = config.rls.gate
    settings["forgetting_factor"] = config.rls.forgetting_factor
    settings["variable"] = config.rls.forgetting == "variable"
    settings["lag"] = 6.0 / config.residual_corner
    settings["floor"] = 1e-3 * authority(model)
    return Problem(
        settings,
        model.structure,
        prior.estimated,
        model.theta,
        prior.std,
        model.body.mass_matrix,
        model.body.restoring,
    )


def init(task: Problem) -> State:
    """Nothing learnt: the prior."""
    n = len(task.scale)
    scalars = np.zeros(1, dtype=_SCALARS)
    scalars["surprise"] = 1.0
    scalars["variance"] = (30.0 * task.settings["floor"]) ** 2
    return State(
        np.hstack([np.eye(n), np.zeros((n, 1))]),
        np.eye(n),
        np.zeros(n),
        np.zeros((4, 6, n + 1)),
        scalars,
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
    """Coefficients and covariance (n, n), calibrated for coloured residuals, in their own units."""
    n = len(task.scale)
    r = state.root[:, :n]
    deviation = np.linalg.solve(r, state.root[:, n])
    inverse = np.linalg.solve(r, np.eye(n))
    information = inverse @ inverse.T
    covariance = information @ state.score @ information
    covariance = 0.5 * (covariance + covariance.T)
    # From a short record the sandwich is itself uncertain, and mostly too thin: never thinner than
    # the inverse information, whose rows count once for the filter's memory.
    widen = np.sqrt(np.maximum(np.diag(information) / np.diag(covariance), 1.0)) * task.scale
    return Estimate(
        prior.names,
        task.theta[task.estimated] + task.scale * deviation,
        covariance * np.outer(widen, widen),
        float(state.scalars["t"][0]),
    )


def variance(task: Problem, state: State) -> Array:
    """Diagonal (n,) of the inverse information, in squared units: what excitation is judged by."""
    variances: Array = task.scale**2 * (inverse_of(state.root) ** 2).sum(axis=1)
    return variances


def condition(task: Problem, state: State) -> float:
    """1-norm condition number of the information's root, in units of the prior: 1 before any data.

    An estimate has about ``16 - log10(condition)`` digits; the normal equations would have twice
    that logarithm less.
    """
    root = state.root[:, : len(task.scale)]
    return float(np.linalg.norm(root, 1) * np.linalg.norm(inverse_of(state.root), 1))


# ------------------------------------------------------------------ kernels
#
# Matrices that are worked on have zeros in further columns, up to a multiple of _LANES, and in two
# further rows: loops along a row then leave no remainder, and may take three rows at a time.

_LANES = 32


class Work(NamedTuple):
    """Scratch for all samples of a fold."""

    momentum: Array  # (6, m): per unit of each coefficient
    force: Array  # (6, m)
    known: Array  # (6,): momentum of the rigid body
    now: Array  # (2, 6, n + 1): force - corner * momentum, and momentum; the last column: known
    before: Array  # (6 (n + 1),)
    moves: NDArray[np.bool_]  # (m,)
    deviation: Array  # (n,): the present solution
    gradient: Array  # (n,)
    noise: Array  # (6,)
    goals: Array  # (6,)
    errors: Array  # (6,)
    line: Array  # (columns,)
    root: Array  # (n + 2, columns): [R | z]
    inverse: Array  # (n + 2, columns): R^-1
    score: Array  # (n + 2, columns)
    rows: Array  # (12, columns): what comes in, and what is forgotten
    taken: Array  # (6, columns): what came in
    basis: Array  # (6, columns): orthonormal directions to forget in
    lost: Array  # (3, 6, columns): V', W', D' of _forget
    product: Array  # (6, 6)


@inner
def _work(task, state):
    n, m = len(task.scale), len(task.theta)
    columns = _LANES * ((n + 2) // _LANES + 1)
    work = Work(
        np.empty((6, m)),
        np.empty((6, m)),
        np.empty(6),
        np.empty((2, 6, n + 1)),
        np.empty(6 * (n + 1)),
        np.empty(m, dtype=np.bool_),
        np.empty(n),
        np.empty(n),
        np.empty(6),
        np.empty(6),
        np.empty(6),
        np.empty(columns),
        np.zeros((n + 2, columns)),
        np.zeros((n + 2, columns)),
        np.zeros((n + 2, columns)),
        np.zeros((12, columns)),
        np.zeros((6, columns)),
        np.zeros((6, columns)),
        np.zeros((3, 6, columns)),
        np.empty((6, 6)),
    )
    _copy(state.root, work.root)
    _copy(state.score, work.score)
    _solve(state.root, work.deviation)
    return work


@inner
def _copy(a, b):
    """Into matrix b from a, as far as both go. (``b[:] = a`` takes a second to compile.)"""
    for i in range(min(len(a), len(b))):
        for j in range(min(a.shape[1], b.shape[1])):
            b[i, j] = a[i, j]


@kernel
def _fold(task, state, samples, info):
    work = _work(task, state)
    for k in range(len(samples)):
        _step(task, state, work, samples[k], info[k])
    _copy(work.root, state.root)
    _copy(work.score, state.score)


@inlined
def _step(task, state, work, sample, info):
    s, c = task.settings[0], state.scalars[0]
    n, w, dt = len(task.scale), s.corner, sample.dt
    info.t = sample.t
    info.forgetting = 1.0
    info.condition = np.nan
    for i in range(6):
        info.residual[i] = np.nan
        info.ratio[i] = np.nan
    if not is_finite(sample):
        info.reason = NOT_FINITE
        return

    _regress(task, work, sample)
    now = work.now
    x, y, u, last = state.filters[0], state.filters[1], state.filters[2], state.filters[3]
    c.t = sample.t
    if sample.restart or not c.started or not dt > 0.0:
        c.started = True
        for i in range(6):
            for j in range(n + 1):
                x[i, j] = -w * now[1, i, j]
                y[i, j] = 0.0
                u[i, j] = now[0, i, j]
                last[i, j] = now[1, i, j]
        c.since_update = 0.0
        for j in range(n):
            state.lagged[j] = 0.0
        info.reason = RESTARTED
        return

    a, b0, b1 = first_order(w, dt)
    _filter(state.filters, work, w, a, b0, b1)
    for i in range(6):
        # the wrench goes in a line from sample to sample, but jumps there
        wrench = (1.0 - a) * sample.wrench[i] + 0.5 * dt * (b1 - b0) * sample.wrench_slope[i]
        x[i, n] += wrench
        y[i, n] += b1 * wrench
        c.wrench[i] = a * c.wrench[i] + (1.0 - a) * sample.wrench[i]
        c.drive[i] += min(dt / _DRIVE_TIME, 1.0) * (c.wrench[i] ** 2 - c.drive[i])
    c.since_update += dt

    _residuals(y, work.deviation, info.residual)
    if c.since_update < s.period - 1e-6:
        info.reason = WAITING
        return
    in_motion(task.structure, sample.moving, work.moves)
    _update(task, state, work, y, info)
    c.since_update = 0.0


@reordered
def _regress(task, work, sample):
    """work.now: the unfiltered rows, in units of the prior about the prior."""
    momentum, force, now, p, nu = work.momentum, work.force, work.now, work.known, sample.nu
    n, w = len(task.scale), task.settings[0].corner
    columns(task.structure, nu, momentum, force)
    for i in range(6):
        p[i] = 0.0
        for j in range(6):
            p[i] += task.rigid_body[i, j] * nu[j]
    h = coriolis_of(
        (p[0], p[1], p[2], p[3], p[4], p[5]), (nu[0], nu[1], nu[2], nu[3], nu[4], nu[5])
    )
    for i in range(6):
        known_momentum, known_force = p[i], h[i]
        for j in range(3):
            known_force -= task.restoring[i, j] * sample.down[j]
        for j in range(len(task.theta)):
            known_momentum += momentum[i, j] * task.theta[j]
            known_force += force[i, j] * task.theta[j]
        for j in range(n):
            e = task.estimated[j]
            now[1, i, j] = momentum[i, e] * task.scale[j]
            now[0, i, j] = force[i, e] * task.scale[j] - w * now[1, i, j]
        now[1, i, n] = -known_momentum
        now[0, i, n] = w * known_momentum - known_force


@reordered
def _filter(filters, work, corner, a, b0, b1):
    """Two sections in series, and the derivative; all channels as one long line."""
    x, y, u = filters[0].reshape(-1), filters[1].reshape(-1), filters[2].reshape(-1)
    last, before = filters[3].reshape(-1), work.before
    force, momentum = work.now[0].reshape(-1), work.now[1].reshape(-1)
    for j in range(len(x)):
        before[j] = corner * last[j] + x[j]
    for j in range(len(x)):
        x[j] = a * x[j] + b0 * u[j] + b1 * force[j]
    for j in range(len(x)):
        y[j] = a * y[j] + b0 * before[j] + b1 * (corner * momentum[j] + x[j])
    for j in range(len(x)):
        u[j] = force[j]
    for j in range(len(x)):
        last[j] = momentum[j]


@inlined
def _update(task, state, work, y, info):
    """Take the filtered rows y (6, n + 1) into the estimate."""
    s, c, lagged = task.settings[0], state.scalars[0], state.lagged
    rows, goals, noise, deviation = work.rows, work.goals, work.noise, work.deviation
    n = len(deviation)
    _invert(work.root, work.inverse)
    info.condition = _norm(work.root, n, work.line) * _norm(work.inverse, n, work.line)
    # Rows closer than the filter's memory repeat each other: they count as one.
    repeats = max(1.0, 2.0 / (s.corner * c.since_update))
    surprise, driven, gated, wild = 0.0, 0, False, False
    for i in range(6):
        for j in range(n):
            rows[i, j] = y[i, j]
        rows[i, n] = 0.0
        predicted = c.variance[i] + _spread(work.inverse, rows[i], n, work.line)
        # what of the squared residual is noise, and not a coefficient still to be learnt
        noise[i] = info.residual[i] ** 2 * c.variance[i] / predicted
        if c.drive[i] <= c.variance[i]:
            continue
        driven += 1
        info.ratio[i] = info.residual[i] ** 2 / predicted
        surprise += min(info.ratio[i], s.gate**2)
        gated = gated or info.ratio[i] > s.gate**2
        wild = wild or info.ratio[i] > _WILD**2
    if driven > 0:
        blend = min(c.since_update / _SURPRISE_TIME, 1.0)
        c.surprise += blend * (surprise / driven - c.surprise)
    c.refused *= np.exp(-c.since_update / _PATIENCE_TIME)
    if wild or (gated and c.refused < _PATIENCE):
        c.refused += 1.0
        # The outlier would ring on in the filters; beginning anew costs nothing but their memory.
        c.started = False
        info.reason = GATED
        return
    info.reason = USED
    c.updates += 1

    if s.variable:
        if c.surprise > _SURPRISING:
            info.forgetting = np.exp(-c.since_update / _FORGETTING_TIME)
    else:
        info.forgetting = s.forgetting_factor
    for i in range(6):
        used = 1.0 / np.sqrt(c.variance[i] * repeats) if c.drive[i] > c.variance[i] else 0.0
        # What those coefficients are to explain that take part: the residual and their own share.
        goal = info.residual[i] * used
        for j in range(n):
            # A coefficient whose motion is not above its noise stays out: least squares would
            # learn from the noise.
            rows[i, j] *= used if work.moves[task.estimated[j]] else 0.0
            goal += rows[i, j] * deviation[j]
        goals[i] = goal
    if info.forgetting < 1.0:
        _forget(work, n, info.forgetting)
    for i in range(6):
        rows[i, n] = goals[i]
    _copy(rows, work.taken)
    _stack(work.root, rows, n, 12 if info.forgetting < 1.0 else 6, work.line)

    _solve(work.root, deviation)
    gradient = work.gradient
    for j in range(n):
        gradient[j] = 0.0
    blend = max(c.since_update / _NOISE_TIME, 1.0 / (20.0 + c.updates))
    if c.surprise > _SURPRISING:
        blend *= 0.2
    _residuals(work.taken, deviation, work.errors)
    for i in range(6):
        e = work.errors[i]
        for j in range(n):
            gradient[j] += work.taken[i, j] * e
        e2 = e * e * c.variance[i] * repeats if c.drive[i] > c.variance[i] else noise[i]
        if c.updates > _SETTLED:
            e2 = min(e2, _STEADY * c.variance[i])
        c.variance[i] = max(c.variance[i] + blend * (e2 - c.variance[i]), s.floor[i] ** 2)
    decay = np.exp(-c.since_update / s.lag)
    for a in range(n):
        lagged[a] *= decay
    for a in range(n):
        for b in range(n):
            work.score[a, b] += gradient[a] * (gradient[b] + lagged[b]) + lagged[a] * gradient[b]
    for a in range(n):
        lagged[a] += gradient[a]


@kernel
def first_order(corner, dt):
    """a, b0, b1 of ``x = a x + b0 u_before + b1 u_now``.

    The exact response of corner / (s + corner) to an input that is linear between samples.
    """
    a = np.exp(-corner * dt)
    b1 = 1.0 - (1.0 - a) / (corner * dt)
    return a, (1.0 - a) - b1, b1


@kernel
def is_finite(sample):
    """Whether nothing in a sample would spoil a state; NaN where not measured is no harm."""
    total = sample.t + sample.dt
    for i in range(6):
        total += sample.nu[i] + sample.wrench[i] + sample.wrench_slope[i]
    for i in range(3):
        total += sample.down[i] + sample.down_slope[i]
    return np.isfinite(total)


# ---------------------------------------------------------------- triangular


@reordered
def _solve(root, x):
    """x (n,) of R x = z by back substitution, root = [R | z]."""
    n = len(x)
    for a in range(n - 1, -1, -1):
        total = root[a, n]
        for b in range(a + 1, n):
            total -= root[a, b] * x[b]
        x[a] = total / root[a, a]


@reordered
def _residuals(rows, x, out):
    """out (6,): what rows (6, n + 1) = [phi | y] leave unexplained, y - phi x."""
    n = len(x)
    for i in range(6):
        total = 0.0
        for j in range(n):
            total += rows[i, j] * x[j]
        out[i] = rows[i, n] - total


@kernel
def inverse_of(root):
    """R^-1 (n, n) of the root (n, n + 1) = [R | z]."""
    n = len(root)
    columns = _LANES * ((n + 2) // _LANES + 1)
    padded, inverse = np.zeros((n + 2, columns)), np.zeros((n + 2, columns))
    _copy(root, padded)
    _invert(padded, inverse)
    return inverse[:n, :n].copy()


@reordered
def _invert(root, inverse):
    """inverse (n + 2, columns) = R^-1 by back substitution, root (n + 2, columns) = [R | z]."""
    n, columns = root.shape[0] - 2, root.shape[1]
    for a in range(n - 1, -1, -1):
        for k in range(columns):
            inverse[a, k] = 0.0
        inverse[a, a] = 1.0
        for b in range(a + 1, n, 3):  # what root has beyond R meets rows of zeros
            f, g, h = root[a, b], root[a, b + 1], root[a, b + 2]
            for k in range(columns):
                inverse[a, k] -= f * inverse[b, k] + g * inverse[b + 1, k] + h * inverse[b + 2, k]
        f = 1.0 / root[a, a]
        for k in range(columns):
            inverse[a, k] *= f


@reordered
def _norm(matrix, n, line):
    """The 1-norm of the first n columns: the largest sum of magnitudes in one of them."""
    columns = matrix.shape[1]
    for k in range(columns):
        line[k] = 0.0
    for i in range(0, n, 2):
        for k in range(columns):
            line[k] += abs(matrix[i, k]) + abs(matrix[i + 1, k])
    largest = 0.0
    for k in range(n):
        largest = max(largest, line[k])
    return largest


@reordered
def _spread(inverse, phi, n, line):
    """phi' (R'R)^-1 phi: variance of the prediction, in units of that of the noise."""
    _combine(phi, inverse, n, line)
    total = 0.0
    for k in range(len(line)):
        total += line[k] * line[k]
    return total


@reordered
def _stack(root, rows, n, count, dot):
    """Householder: make [root; rows] upper triangular again; the first ``count`` rows are used up.

    The first six rows come in, further ones leave: with J their signs, Q' J Q = J.
    """
    columns = root.shape[1]
    for j in range(n):
        below = 0.0
        for i in range(count):
            below += rows[i, j] ** 2 if i < 6 else -(rows[i, j] ** 2)
        if below == 0.0:
            continue
        pivot = root[j, j]
        alpha = -np.sqrt(pivot * pivot + below) if pivot > 0.0 else np.sqrt(pivot * pivot + below)
        head = pivot - alpha
        beta = 2.0 / (head * head + below)
        for k in range(columns):
            dot[k] = head * root[j, k]
        for i in range(0, count, 3):
            sign = 1.0 if i < 6 else -1.0
            f, g, h = sign * rows[i, j], sign * rows[i + 1, j], sign * rows[i + 2, j]
            for k in range(columns):
                dot[k] += f * rows[i, k] + g * rows[i + 1, k] + h * rows[i + 2, k]
        head *= beta
        for k in range(columns):
            root[j, k] -= head * dot[k]
        root[j, j] = alpha
        for i in range(count):
            f = beta * rows[i, j]
            for k in range(columns):
                rows[i, k] -= f * dot[k]
            rows[i, j] = 0.0


# ---------------------------------------------------------------- forgetting


@reordered
def _forget(work, n, factor):
    """Leave ``factor`` of the information in the subspace that the rows excite, and only there.

    With A = R'R, u = R phi' and Q an orthonormal basis of the u of all excited rows::

        A_new = R' (I - (1 - factor) Q Q') R = A - V V',     V = sqrt(1 - factor) R' Q

    V' becomes the last six rows. The estimate stays; the score's covariance S goes with the
    information: with ``T = A_new A^-1 = I - V W'``, ``W = sqrt(1 - factor) R^-1 Q``::

        T S T' = S - V D' - D V',     D = S W - V (W' S W) / 2
    """
    root, score, rows, basis = work.root, work.score, work.rows, work.basis
    v, w, d, product = work.lost[0], work.lost[1], work.lost[2], work.product
    columns, count, share = root.shape[1], 0, np.sqrt(1.0 - factor)
    for i in range(6):
        size, left = 0.0, 0.0
        for k in range(columns):
            size += rows[i, k] ** 2
            w[count, k] = rows[i, k]
        if size < _EXCITED:
            continue
        for a in range(n):
            total = 0.0
            for k in range(columns):
                total += root[a, k] * rows[i, k]
            basis[count, a] = total
            left += total * total
        whole = left
        for _ in range(2):  # Gram and Schmidt; what makes u to q makes phi to R^-1 q
            before, left = left, 0.0
            for b in range(count):
                f = 0.0
                for k in range(columns):
                    f += basis[count, k] * basis[b, k]
                for k in range(columns):
                    basis[count, k] -= f * basis[b, k]
                for k in range(columns):
                    w[count, k] -= f * w[b, k]
            for k in range(columns):
                left += basis[count, k] ** 2
            if left > 0.5 * before:
                break  # else rounding may have left something of the others: once more
        if left > 1e-12 * whole:
            f = 1.0 / np.sqrt(left)
            for k in range(columns):
                basis[count, k] *= f
            for k in range(columns):
                w[count, k] *= f
            count += 1
    for b in range(6):
        f = share if b < count else 0.0
        for k in range(columns):
            basis[b, k] *= f
        for k in range(columns):
            w[b, k] *= f
        _combine(basis[b], root, n, rows[6 + b])
        _combine(w[b], score, n, d[b])
        for k in range(columns):
            v[b, k] = rows[6 + b, k]
        v[b, n] = 0.0
    for b in range(6):
        for c in range(6):
            total = 0.0
            for k in range(columns):
                total += w[c, k] * d[b, k]
            product[b, c] = 0.5 * total
    for b in range(6):
        for c in range(6):
            f = product[b, c]
            for k in range(columns):
                d[b, k] -= f * v[c, k]
    for b in range(0, 6, 3):
        for a in range(n):
            f, g, h = v[b, a], v[b + 1, a], v[b + 2, a]
            x, y, z = d[b, a], d[b + 1, a], d[b + 2, a]
            for k in range(columns):
                forth = f * d[b, k] + g * d[b + 1, k] + h * d[b + 2, k]
                back = x * v[b, k] + y * v[b + 1, k] + z * v[b + 2, k]
                score[a, k] -= forth + back


@reordered
def _combine(weights, matrix, n, out):
    """out (columns,) = n weights, then zeros, times the rows of matrix (n + 2, columns)."""
    columns = matrix.shape[1]
    for k in range(columns):
        out[k] = 0.0
    for a in range(0, n, 3):
        f, g, h = weights[a], weights[a + 1], weights[a + 2]
        for k in range(columns):
            out[k] += f * matrix[a, k] + g * matrix[a + 1, k] + h * matrix[a + 2, k]
