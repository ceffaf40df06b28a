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
from rov_ident.jit import kernel
from rov_ident.model import Structure, columns, coriolis, in_motion
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
    model, prior = config.model, prior_of(config)
    settings = np.zeros(1, dtype=_SETTINGS)
    settings["corner"] = config.rls.filter_corner
    settings["period"] = 0.1
    settings["gate"] = config.rls.gate
    settings["forgetting_factor"] = config.rls.forgetting_factor
    settings["variable"] = config.rls.forgetting == "variable"
    settings["lag"] = 6.0 / config.rls.filter_corner
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
    return task.scale**2 * inverse_diagonal(state.root)


# ------------------------------------------------------------------ kernels


@kernel
def inverse_diagonal(root):
    """Diagonal (n,) of (R'R)^-1: squared rows of R^-1, column by column."""
    n = root.shape[0]
    out, x = np.zeros(n), np.empty(n)
    for j in range(n):
        for a in range(j, -1, -1):
            total = 1.0 if a == j else 0.0
            for b in range(a + 1, j + 1):
                total -= root[a, b] * x[b]
            x[a] = total / root[a, a]
            out[a] += x[a] ** 2
    return out


@kernel
def _fold(task, state, samples, info):
    n = len(task.scale)
    m = len(task.theta)
    momentum, force = np.empty((6, m)), np.empty((6, m))
    now = np.empty((2, 6, n + 1))  # force - corner * momentum, and momentum
    rows, moves = np.empty((6, n + 1)), np.empty(m, dtype=np.bool_)
    for k in range(len(samples)):
        _step(task, state, samples[k], info[k], momentum, force, now, rows, moves)


@kernel
def _step(task, state, sample, info, momentum, force, now, rows, moves):
    root, score, lagged, filters, scalars = state
    s, c = task.settings[0], scalars[0]
    n = len(task.scale)
    w = s.corner
    info.t = sample.t
    info.forgetting = 1.0
    for i in range(6):
        info.residual[i] = np.nan
        info.ratio[i] = np.nan

    if not is_finite(sample):
        info.reason = NOT_FINITE
        return

    # momentum and (force - w * momentum) of each estimated column; last: all that is known
    nu = sample.nu
    columns(task.structure, nu, momentum, force)
    for i in range(6):
        p, h = 0.0, 0.0
        for j in range(6):
            p += task.rigid_body[i, j] * nu[j]
        now[1, i, n] = -p
    h = coriolis(-now[1, :, n], nu)
    for i in range(6):
        for j in range(3):
            h[i] -= task.restoring[i, j] * sample.down[j]
        p = -now[1, i, n]
        for j in range(len(task.theta)):
            h[i] += force[i, j] * task.theta[j]
            p += momentum[i, j] * task.theta[j]
        now[1, i, n] = -p
        now[0, i, n] = -(h[i] - w * p)
        for j in range(n):
            e = task.estimated[j]
            now[1, i, j] = momentum[i, e] * task.scale[j]
            now[0, i, j] = (force[i, e] - w * momentum[i, e]) * task.scale[j]

    x, y, u, last = filters[0], filters[1], filters[2], filters[3]
    dt = sample.dt
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
        lagged[:] = 0.0
        info.reason = RESTARTED
        return

    a, b0, b1 = first_order(w, dt)
    for i in range(6):
        for j in range(n + 1):
            before = w * last[i, j] + x[i, j]
            x[i, j] = a * x[i, j] + b0 * u[i, j] + b1 * now[0, i, j]
            if j == n:
                x[i, j] += (1.0 - a) * sample.wrench[i]
                x[i, j] += 0.5 * dt * (b1 - b0) * sample.wrench_slope[i]
            after = w * now[1, i, j] + x[i, j]
            y[i, j] = a * y[i, j] + b0 * before + b1 * after
            u[i, j] = now[0, i, j]
            last[i, j] = now[1, i, j]
    for i in range(6):
        c.wrench[i] = a * c.wrench[i] + (1.0 - a) * sample.wrench[i]
        c.drive[i] += min(dt / _DRIVE_TIME, 1.0) * (c.wrench[i] ** 2 - c.drive[i])
    c.since_update += dt

    deviation = solution(root)
    for i in range(6):
        e = y[i, n]
        for j in range(n):
            e -= y[i, j] * deviation[j]
        info.residual[i] = e
    if c.since_update < s.period - 1e-6:
        info.reason = WAITING
        return
    in_motion(task.structure, sample.moving, moves)
    _update(task, moves, c, root, score, lagged, y, deviation, rows, info)
    c.since_update = 0.0


@kernel
def _update(task, moves, c, root, score, lagged, y, deviation, rows, info):
    """Take the filtered rows y (6, n + 1) into the estimate."""
    s = task.settings[0]
    n = root.shape[0]
    # Rows closer than the filter's memory repeat each other: they count as one.
    repeats = max(1.0, 2.0 / (s.corner * c.since_update))
    surprise, driven, gated, wild = 0.0, 0, False, False
    whitened, noise = np.empty(n), np.empty(6)
    for i in range(6):
        spread = 0.0
        for j in range(n):  # R^-T phi
            total = y[i, j]
            for b in range(j):
                total -= root[b, j] * whitened[b]
            whitened[j] = total / root[j, j]
            spread += whitened[j] ** 2
        predicted = c.variance[i] + spread
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
        weight = 1.0 / np.sqrt(c.variance[i] * repeats)
        used = weight if c.drive[i] > c.variance[i] else 0.0
        rows[i, n] = y[i, n] * used
        for j in range(n):
            # A coefficient whose motion is not above its noise stays out: least squares would
            # learn from the noise.
            free = moves[task.estimated[j]]
            rows[i, j] = y[i, j] * used if free else 0.0
            if not free:
                rows[i, n] -= y[i, j] * used * deviation[j]
    if info.forgetting < 1.0:
        _forget(root, score, deviation, rows, info.forgetting)
    gradient = rows.copy()
    _stack(root, rows)

    deviation[:] = solution(root)
    decay = np.exp(-c.since_update / s.lag)
    g = np.zeros(n)
    blend = max(c.since_update / _NOISE_TIME, 1.0 / (20.0 + c.updates))
    if c.surprise > _SURPRISING:
        blend *= 0.2
    for i in range(6):
        e = gradient[i, n]
        for j in range(n):
            e -= gradient[i, j] * deviation[j]
        for j in range(n):
            g[j] += gradient[i, j] * e
        e2 = e * e * c.variance[i] * repeats if c.drive[i] > c.variance[i] else noise[i]
        if c.updates > _SETTLED:
            e2 = min(e2, _STEADY * c.variance[i])
        c.variance[i] = max(c.variance[i] + blend * (e2 - c.variance[i]), s.floor[i] ** 2)
    for a in range(n):
        lagged[a] *= decay
    for a in range(n):
        for b in range(n):
            score[a, b] += g[a] * g[b] + g[a] * lagged[b] + lagged[a] * g[b]
    for a in range(n):
        lagged[a] += g[a]


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


@kernel
def solution(root):
    """x (n,) of R x = z by back substitution, root (n, n + 1) = [R | z]."""
    n = root.shape[0]
    x = np.empty(n)
    for a in range(n - 1, -1, -1):
        total = root[a, n]
        for b in range(a + 1, n):
            total -= root[a, b] * x[b]
        x[a] = total / root[a, a]
    return x


@kernel
def _stack(root, rows):
    """Householder: make [root; rows] upper triangular again; rows (q, n + 1) are used up."""
    n, q = root.shape[0], rows.shape[0]
    for j in range(n):
        below = 0.0
        for i in range(q):
            below += rows[i, j] ** 2
        if below == 0.0:
            continue
        pivot = root[j, j]
        alpha = -np.sqrt(pivot * pivot + below) if pivot > 0.0 else np.sqrt(pivot * pivot + below)
        head = pivot - alpha
        beta = 2.0 / (head * head + below)
        root[j, j] = alpha
        for k in range(j + 1, n + 1):
            dot = head * root[j, k]
            for i in range(q):
                dot += rows[i, j] * rows[i, k]
            dot *= beta
            root[j, k] -= dot * head
            for i in range(q):
                rows[i, k] -= dot * rows[i, j]


@kernel
def _forget(root, score, deviation, rows, factor):
    """Multiply the information by ``factor`` in the subspace that the rows excite, and only there.

    With A = R'R, u = R phi' and Q an orthonormal basis of the u of all excited rows::

        A_new = R' (I - (1 - factor) Q Q') R,     R_new = (I - (1 - sqrt(factor)) Q Q') R

    The estimate stays; the score's covariance goes with the information, ``T S T'`` with
    ``T = A_new A^-1``.
    """
    n = root.shape[0]
    basis = np.zeros((6, n))
    count = 0
    for i in range(6):
        size = 0.0
        for j in range(n):
            size += rows[i, j] ** 2
        if size < _EXCITED:
            continue
        for a in range(n):
            total = 0.0
            for b in range(a, n):
                total += root[a, b] * rows[i, b]
            basis[count, a] = total
        before = np.sqrt(np.sum(basis[count] ** 2))
        for _ in range(2):  # Gram-Schmidt, twice is enough
            for k in range(count):
                basis[count] -= np.sum(basis[count] * basis[k]) * basis[k]
        left = np.sqrt(np.sum(basis[count] ** 2))
        if left > 1e-6 * before:
            basis[count] /= left
            count += 1
    r = np.ascontiguousarray(root[:, :n])
    for k in range(count):
        q = basis[k]
        v = np.zeros(n)  # R'q
        for a in range(n):
            for b in range(a, n):
                v[b] += r[a, b] * q[a]
        w = np.empty(n)  # R^-1 q
        for a in range(n - 1, -1, -1):
            total = q[a]
            for b in range(a + 1, n):
                total -= r[a, b] * w[b]
            w[a] = total / r[a, a]
        # the projections commute, as the q are orthonormal
        sw, ws = score @ w, w @ score
        wsw = np.sum(w * sw)
        f = 1.0 - factor
        for a in range(n):
            for b in range(n):
                score[a, b] += -f * v[a] * ws[b] - f * sw[a] * v[b] + f * f * wsw * v[a] * v[b]
    new = r.copy()
    for k in range(count):
        q = basis[k]
        v = np.zeros(n)
        for a in range(n):
            for b in range(a, n):
                v[b] += r[a, b] * q[a]
        for a in range(n):
            for b in range(n):
                new[a, b] -= (1.0 - np.sqrt(factor)) * q[a] * v[b]
    root[:] = 0.0
    _stack(root, np.hstack((new, np.zeros((n, 1)))))
    for a in range(n):
        total = 0.0
        for b in range(a, n):
            total += root[a, b] * deviation[b]
        root[a, n] = total
