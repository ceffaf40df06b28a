"""Recursive least squares over the sensitivities of a model-based velocity observer.

The recursive prediction-error method (Ljung and Soderstrom 1983, sec. 3.7) as ``init``, ``step``
and ``fold``. A Kalman filter of the six velocities predicts each measured one with the present
coefficients; how the prediction would change with the coefficients, ``phi = d nu / d theta``,
follows from the same recursion, one column a coefficient::

    nu_dot = M^-1 (tau - h(nu)) + noise
    S_dot  = (d nu_dot / d nu) S - M^-1 Y(nu, nu_dot)      Y: regressor, tau = known + Y theta

and a measurement corrects nu and S alike. Every innovation e with variance s is then a row of least
squares for the deviation x from the values that the observer works with::

    e / sqrt(s) = phi / sqrt(s) x + white noise

It is *recursive least squares* still, on the rows of a linearised prediction error. Equation error
(filtered accelerations and products of measured velocities) needs no observer, but the noise of the
velocities enters its moments by way of the Munk terms, biases the products and cannot be whitened
axis by axis: six times the Cramer-Rao bound instead of one and a half (docs/accuracy.md).

The information is kept as a triangular root R of ``R'R = sum of phi' phi / s`` (Householder; it
keeps half the digits that the covariance form loses), in coefficients scaled by their prior
standard deviation about their prior value: the prior is the unit matrix.

*Coefficients whose motion is not well above its noise* are not learnt, or it would be from the
noise; but their uncertainty is that of the others, too. With their columns behind the others', R
holds the distribution of the others *given* them, and that alone takes new rows (consider
parameters, Bierman 1977, ch. VIII). Nor do the others learn from products with such motion.

*Forgetting* waits for evidence. While the innovations of an axis are larger than they should be,
the coefficients that would show there gain variance as on a random walk, up to the prior's (to
multiply the information by a factor instead takes the longer the better something was known).
Constant forgetting, where it is asked for, touches only directions that the present motion excites
(subspace-of-information forgetting, Lai and Bernstein 2024). Either way unexcited directions keep
their information, so nothing winds up.

*Standard deviations* do not assume white innovations: the covariance of the accumulated score
``sum of phi' e / s``, with its correlation in time, stands between two inverse informations (the
sandwich of Newey and West 1987, with an exponential lag window).
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
    columns,
    generalized_force,
    in_motion,
    momentum_columns,
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

USED, RESTARTED, WAITING, GATED, NOT_FINITE, UNPREDICTABLE = range(6)
REASONS = (
    "used",
    "restarted after a gap",
    "not measured",
    "outlier",
    "not finite",
    "no model moves so",
)

REFUSALS = (GATED, NOT_FINITE, UNPREDICTABLE)

_PERIOD = 0.1  # s; the observer takes over the present coefficients this often
_REACH = 10.0  # prior standard deviations; the observer's coefficients are never further off
_NOISIEST = 100.0  # times the declared variance; a measurement is never taken for worse
_WILD = 100.0  # sigma; an outlier that no change of the vehicle can be
_PATIENCE = 2.5  # lesser outliers in short order from which the vehicle has changed
_LONE = 1.9  # outliers in short order from which the observer begins anew: two in 0.3 s
_PATIENCE_TIME = 3.0  # s; over which that is counted
_STEADY = 4.0  # a squared innovation counts for at most this often its variance in the noise
_STEADY_MEAN = 0.92  # what that is in the mean, of a normal distribution
_NOISE_TIME = 20.0  # s; over which the variance of a measurement is averaged; less at first
_ROOM = 1.2  # of the process noise: see process_noise.adapt (docs/accuracy.md)
_SURPRISING = 3.0  # its value from which the vehicle has changed; 1 is expected
_PEAK_TIME = 5.0  # s; over which a peak of a velocity is remembered
_MOVING = 4.0  # that peak's square over the noise variance from which the component moves
_NOISE_PEAK = 16.0  # variances; no square of a noise is larger in a minute
_EXCITED = 0.01  # a row with less information than this, relative to the prior, excites nothing
_SHIFT = 1e-6  # m/s, rad/s; of a velocity, for the Jacobian

_SETTINGS = record(
    [
        ("corner", "f8"),  # rad/s, of the published residual
        ("gate", "f8"),
        ("forgetting_factor", "f8"),
        ("variable", "?"),
    ],
)

_SCALARS = record(
    [
        ("t", "f8"),
        ("since_update", "f8"),
        ("noise", "f8", (6,)),  # variance of a measurement over the declared one
        ("surprise", "f8", (6,)),  # normalised innovations squared, averaged: 1 when all is well
        ("peak", "f8", (6,)),  # squared velocities, their peaks of late
        ("refused", "f8"),  # outliers of late
        ("free", "i8"),  # so many of the first columns take rows
        ("started", "?"),
    ],
)


class Problem(NamedTuple):
    """What does not change from sample to sample."""

    settings: NDArray[np.void]
    process: NDArray[np.void]  # (1,) of PROCESS
    structure: Structure
    estimated: NDArray[np.int64]  # (n,) indices into theta
    theta: Array  # (m,) values of all coefficients: the prior of the estimated, the held others;
    # behind them the estimated parameters of effects
    scale: Array  # (n,) prior standard deviations
    highest: Array  # (n,) scaled deviation that the observer's coefficients do not exceed
    rigid_body: Array  # (6, 6)
    restoring: Array  # (6, 3)


class State(NamedTuple):
    """All that the next step needs. Columns of coefficients are in the order of ``order``."""

    order: NDArray[np.int64]  # (n,): indices into Problem.estimated
    root: Array  # (n, n + 1): [R | z], R upper triangular, of the scaled deviation from the prior
    score: Array  # (n, n): covariance of the accumulated score, the prior's included
    lagged: Array  # (n,): recent scores under the lag window
    solution: Array  # (n,): of R x = z when the observer was told last
    deviation: Array  # (n,): what the observer took over of it, within reason
    nu: Array  # (6,): velocities
    p: Array  # (6, 6): their covariance, the coefficients taken as known
    sensitivity: Array  # (6, n): d nu / d deviation
    adaptation: NDArray[np.void]  # (6,) of ADAPTATION: of the process noise
    residual: Array  # (4, 6): filters of the published residual
    scalars: NDArray[np.void]  # (1,)


def problem(config: Config) -> Problem:
    """The constants of the estimation that a configuration asks for."""
    model, prior = config.dynamics, prior_of(config, effects=True)
    settings = np.zeros(1, dtype=_SETTINGS)
    settings["corner"] = config.residual_corner
    settings["gate"] = config.rls.gate
    settings["forgetting_factor"] = config.rls.forgetting_factor
    settings["variable"] = config.rls.forgetting == "variable"
    return Problem(
        settings,
        process(config),
        model.structure,
        prior.estimated,
        theta_of(config),
        prior.std,
        np.where(prior.negative, np.minimum(-prior.mean / prior.std, _REACH), _REACH),
        model.body.mass_matrix,
        model.body.restoring,
    )


def init(task: Problem) -> State:
    """Nothing learnt: the prior; the velocity is taken from the first measurement."""
    n = len(task.scale)
    scalars = np.zeros(1, dtype=_SCALARS)
    scalars["surprise"] = 1.0
    scalars["noise"] = 1.0
    scalars["free"] = n
    return State(
        np.arange(n),
        np.hstack([np.eye(n), np.zeros((n, 1))]),
        np.eye(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(6),
        np.zeros((6, 6)),
        np.zeros((6, n)),
        first_adaptation(task.process),
        np.zeros((4, 6)),
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
    n, place = len(task.scale), np.argsort(state.order)
    inverse = np.linalg.solve(state.root[:, :n], np.eye(n))
    information = inverse @ inverse.T
    covariance = calibrated(information, state.score)[np.ix_(place, place)]
    return Estimate(
        prior.names,
        task.theta[task.estimated] + task.scale * (inverse @ state.root[:, n])[place],
        covariance * np.outer(task.scale, task.scale),
        float(state.scalars["t"][0]),
    )


def variance(task: Problem, state: State) -> Array:
    """Diagonal (n,) of the inverse information, in squared units: what excitation is judged by."""
    variances: Array = (inverse_of(state.root) ** 2).sum(axis=1)[np.argsort(state.order)]
    return task.scale**2 * variances


def condition(task: Problem, state: State) -> float:
    """1-norm condition number of the information's root, in units of the prior: 1 before any data.

    An estimate has about ``16 - log10(condition)`` digits; the normal equations would have twice
    that logarithm less.
    """
    root = state.root[:, : len(task.scale)]
    return float(np.linalg.norm(root, 1) * np.linalg.norm(inverse_of(state.root), 1))


# ------------------------------------------------------------------ kernels
#
# Matrices that are worked on have zeros in further columns, up to a multiple of _WIDTH, and in two
# further rows: loops along a row then leave no remainder, and may take three rows at a time.

_WIDTH = 32
_POINTS = 8  # a velocity and its displacements along six axes, side by side; one is spare

_SCRATCH = record(
    [
        ("nu", "f8", (6, _POINTS)),
        ("mass", "f8", (6, 6, _POINTS)),
        ("h", "f8", (6, _POINTS)),
        ("extended", "f8", (EXTENDED_SIZE, _POINTS)),
        ("one_nu", "f8", (6, 1)),
        ("one_mass", "f8", (6, 6, 1)),
        ("one_h", "f8", (6, 1)),
        ("one_extended", "f8", (EXTENDED_SIZE, 1)),
        ("inverse", "f8", (6, 6)),  # of the mass matrix
        ("wrench", "f8", (6,)),  # that acts
        ("force", "f8", (6,)),  # wrench less restoring in mid-interval
        ("slope", "f8", (6,)),
        ("rate", "f8", (6,)),
        ("middle", "f8", (6,)),
        ("jacobian", "f8", (6, 6)),  # d nu_dot / d nu
        ("transition", "f8", (6, 6)),
        ("into", "f8", (6, 6)),  # from a wrench in the interval to the velocity at its end
        ("noise", "f8", (6, 6)),  # variance density of the acceleration
        ("product", "f8", (6, 6)),
        ("z", "f8", (6,)),  # nu as measured
        ("r", "f8", (6,)),  # its variance
    ],
)


class Work(NamedTuple):
    """Scratch for all samples of a fold."""

    theta: Array  # (m, _POINTS): of the observer
    one_theta: Array  # (m, 1)
    estimated: NDArray[np.int64]  # (n,): indices into theta, in the order of the columns
    scale: Array  # (n,)
    place: NDArray[np.int64]  # (n,): where each column was
    moves: NDArray[np.bool_]  # (m,)
    moving: NDArray[np.uint8]  # (6,)
    momentum: Array  # (6, m): per unit of each coefficient
    of_rate: Array  # (6, m)
    of_motion: Array  # (6, m)
    change: Array  # (n,)
    gradient: Array  # (n,)
    line: Array  # (columns,)
    sensitivity: Array  # (6, columns)
    drive: Array  # (6, columns)
    direct: Array  # (6, columns): what a column adds to the measured velocity alone
    root: Array  # (n + 2, columns): [R | z]
    inverse: Array  # (n + 2, columns): R^-1 as of the last time that the observer was told
    score: Array  # (n + 2, columns)
    spare: Array  # (n + 2, columns)
    rows: Array  # (12, columns): what comes in, and what is forgotten
    basis: Array  # (6, columns): orthonormal directions to forget in
    lost: Array  # (2, 6, columns): W', D' of _forget
    scratch: NDArray[np.void]  # (1,): in one record, whose parts the compiler knows apart


@inlined
def _work(task, state):
    n, m = len(task.scale), len(task.theta)
    columns = _WIDTH * ((n + 2) // _WIDTH + 1)
    work = Work(
        np.empty((m, _POINTS)),
        np.empty((m, 1)),
        np.empty(n, dtype=np.int64),
        np.empty(n),
        np.empty(n, dtype=np.int64),
        np.empty(m, dtype=np.bool_),
        np.empty(6, dtype=np.uint8),
        np.empty((6, m)),
        np.empty((6, m)),
        np.empty((6, m)),
        np.empty(n),
        np.empty(n),
        np.empty(columns),
        np.zeros((6, columns)),
        np.zeros((6, columns)),
        np.zeros((6, columns)),
        np.zeros((n + 2, columns)),
        np.zeros((n + 2, columns)),
        np.zeros((n + 2, columns)),
        np.zeros((n + 2, columns)),
        np.zeros((12, columns)),
        np.zeros((6, columns)),
        np.zeros((2, 6, columns)),
        np.empty(1, dtype=_SCRATCH),
    )
    copy(state.root, work.root)
    copy(state.score, work.score)
    copy(state.sensitivity, work.sensitivity)
    _name_columns(task, state, work)
    return work


@inner
def _name_columns(task, state, work):
    for a in range(len(state.order)):
        work.estimated[a] = task.estimated[state.order[a]]
        work.scale[a] = task.scale[state.order[a]]


@kernel
def _fold(task, state, samples, sides, info):
    work = _work(task, state)
    _steps(task, state, work, samples, sides, info)
    copy(work.root, state.root)
    copy(work.score, state.score)
    copy(work.sensitivity, state.sensitivity)


@inner
def _steps(task, state, work, samples, sides, infos):
    """The fold itself, apart from what makes its arrays (:func:`rov_ident.jit.lean`)."""
    s, c, x = task.settings[0], state.scalars[0], work.scratch[0]
    _take_over(task, state, work)
    for k in range(len(samples)):
        sample, info, side = samples[k], infos[k], sides[k if sides.shape[2] > 0 else 0]
        if not begin(info, sample):
            info.reason = NOT_FINITE
            continue
        c.t = sample.t
        info.reason = USED
        if sample.restart or not c.started or not sample.dt > 0.0:
            info.reason = RESTARTED
            _restart(state, work, sample)
            _take_sides(task, work, sample, side)
        else:
            c.since_update += sample.dt
            _judge_motion(task, state, work, sample)
            _take_sides(task, work, sample, side)
            if _predict(task, state, work, sample, side):
                _update(task, state, work, sample, side, info)
            else:
                # The model runs away; better begin again with what was known before any data.
                info.reason = UNPREDICTABLE
                c.started = False
                for a in range(len(state.deviation)):
                    state.deviation[a] = 0.0
                _take_over(task, state, work)
                continue
            if c.since_update >= _PERIOD - 1e-6:
                _learn(task, state, work, info)
        filtered_residual(
            task.structure, work.one_theta, x.one_mass, task.restoring, s.corner, state.residual,
            sample, x.wrench, info.reason == RESTARTED, x.one_nu, x.one_h, x.one_extended,
            info.residual,
        )  # fmt: skip


@inlined
def _take_sides(task, work, sample, side):
    """What acts, with the parameters of effects as they are; the columns of what they measure."""
    wrench, k = work.scratch[0].wrench, side.shape[1]
    first = len(task.theta) - k
    for i in range(6):
        wrench[i] = sample.wrench[i]
        for j in range(k):
            wrench[i] += side[i, j] * (work.one_theta[first + j, 0] - side[12, j])
    if k > 0:
        for a in range(len(work.estimated)):
            j = work.estimated[a] - first
            for i in range(6):
                work.direct[i, a] = work.scale[a] * side[6 + i, j] if j >= 0 else 0.0


@inlined
def _restart(state, work, sample):
    """The velocity from the sample; what the coefficients have to do with it is not known."""
    c = state.scalars[0]
    c.started = True
    c.since_update = 0.0
    for i in range(6):
        for k in range(work.sensitivity.shape[1]):
            work.sensitivity[i, k] = 0.0
        for j in range(6):
            state.p[i, j] = 0.0
        state.p[i, i] = min(sample.odometry_variance[i], 1.0)
        state.nu[i] = sample.nu[i]
        c.peak[i] = 0.0
        interrupt(state.adaptation[i])
    for a in range(len(state.lagged)):
        state.lagged[a] = 0.0


# ---------------------------------------------------------------- observer


@inner
def _take_over(task, state, work):
    """The model that the observer works with."""
    s = work.scratch[0]
    for j in range(len(task.theta)):
        work.one_theta[j, 0] = task.theta[j]
    for a in range(len(work.estimated)):
        work.one_theta[work.estimated[a], 0] += work.scale[a] * state.deviation[a]
    for j in range(len(task.theta)):
        for k in range(_POINTS):
            work.theta[j, k] = work.one_theta[j, 0]
    for i in range(6):
        for j in range(6):
            s.one_mass[i, j, 0] = task.rigid_body[i, j]
    add_added_mass(task.structure, work.one_theta, s.one_mass)
    for i in range(6):
        least = LIGHTEST * task.rigid_body[i, i]
        s.one_mass[i, i, 0] = max(s.one_mass[i, i, 0], least)
    for i in range(6):
        for j in range(6):
            s.product[i, j] = s.one_mass[i, j, 0]
            s.inverse[i, j] = 1.0 if i == j else 0.0
            for k in range(_POINTS):
                s.mass[i, j, k] = s.one_mass[i, j, 0]
    # Gauss and Jordan; positive definite, or made so
    for c in range(6):
        f = 1.0 / max(s.product[c, c], LIGHTEST * task.rigid_body[c, c])
        for j in range(6):
            s.product[c, j] *= f
            s.inverse[c, j] *= f
        for i in range(6):
            f = s.product[i, c] if i != c else 0.0
            for j in range(6):
                s.product[i, j] -= f * s.product[c, j]
                s.inverse[i, j] -= f * s.inverse[c, j]


@reordered
def _predict(task, state, work, sample, side):
    """Velocities, covariance, sensitivities to the sample's time; False if out of all reason."""
    s, nu, p, sensitivity = work.scratch[0], state.nu, state.p, work.sensitivity
    noise, inverse = s.noise, s.inverse
    n, free = len(work.scale), state.scalars[0].free
    for i in range(6):
        s.force[i], s.slope[i] = s.wrench[i], sample.wrench_slope[i]
        for j in range(3):
            middle = sample.down[j] - 0.5 * sample.dt * sample.down_slope[j]
            s.force[i] += task.restoring[i, j] * middle
            s.slope[i] += task.restoring[i, j] * sample.down_slope[j]
    doubtful = wrench_noise(task.process[0], sample, s.middle)
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for a in range(6):
                total += inverse[i, a] * inverse[j, a] * s.middle[a]
            noise[i, j] = total
            noise[j, i] = total
        state.adaptation[i].since += sample.dt
        noise[i, i] += state.adaptation[i].density
        state.adaptation[i].acting = 0.0 if doubtful else noise[i, i]
    steps = steps_of(sample.dt)
    dt = sample.dt / steps
    for step in range(steps):
        _linearise(task, work, nu, step * dt - 0.5 * sample.dt, dt)
        # the regressor, in the middle of the step
        momentum_columns(task.structure, s.rate, work.of_rate)
        if free < n:
            _drive(work, task.structure, s.middle, free, n)
            for i in range(6):
                s.middle[i] *= work.moving[i]  # or products with mere noise would be learnt from
        _drive(work, task.structure, s.middle, 0, free)
        if side.shape[1] > 0:
            _drive_sides(task, work, side)
        _advance(s.transition, sensitivity, s.into, work.drive, work.rows)
        for i in range(6):
            nu[i] += dt * s.rate[i]
        for i in range(6):
            for j in range(6):
                total = 0.0
                for a in range(6):
                    total += s.transition[i, a] * p[a, j]
                s.product[i, j] = total
        for i in range(6):
            for j in range(i + 1):
                total = dt * noise[i, j]
                for a in range(6):
                    total += s.product[i, a] * s.transition[j, a]
                p[i, j] = total
                p[j, i] = total
    fastest = 0.0
    for i in range(6):
        fastest += nu[i] * nu[i]
    return fastest < FASTEST**2  # not so with NaN


@inlined
def _drive(work, structure, nu, first, end):
    """work.drive of these columns: the wrench that a unit more of each coefficient adds."""
    columns(structure, nu, work.momentum, work.of_motion, work.scratch[0].one_extended)
    for i in range(6):
        for a in range(first, end):
            e = work.estimated[a]
            work.drive[i, a] = -work.scale[a] * (work.of_rate[i, e] + work.of_motion[i, e])


@inlined
def _drive_sides(task, work, side):
    """The same of the parameters of effects."""
    first = len(task.theta) - side.shape[1]
    for a in range(len(work.estimated)):
        if work.estimated[a] >= first:
            for i in range(6):
                work.drive[i, a] = work.scale[a] * side[i, work.estimated[a] - first]


@reordered
def _advance(transition, x, into, drive, out):
    """x (6, columns) = transition x + into drive; the first six rows of out are work space."""
    columns = x.shape[1]
    for i in range(6):
        a, b, c, d, e, f = (
            transition[i, 0], transition[i, 1], transition[i, 2],
            transition[i, 3], transition[i, 4], transition[i, 5],
        )  # fmt: skip
        g, h, k, l, m, n = (
            into[i, 0], into[i, 1], into[i, 2], into[i, 3], into[i, 4], into[i, 5],
        )  # fmt: skip
        for j in range(columns):
            out[i, j] = (
                a * x[0, j] + b * x[1, j] + c * x[2, j]
                + d * x[3, j] + e * x[4, j] + f * x[5, j]
                + g * drive[0, j] + h * drive[1, j] + k * drive[2, j]
                + l * drive[3, j] + m * drive[4, j] + n * drive[5, j]
            )  # fmt: skip
    for i in range(6):
        for j in range(columns):
            x[i, j] = out[i, j]


@inlined
def _linearise(task, work, nu, late, dt):
    """A Runge-Kutta step from nu, which begins ``late`` seconds after mid-interval.

    s.rate is the mean of nu_dot over it; s.transition is ``d nu(end) / d nu``, s.into
    ``d nu(end) / d wrench``, both to second order in dt, about s.middle.
    """
    s = work.scratch[0]
    for i in range(6):
        s.one_nu[i, 0] = nu[i]
        s.rate[i] = 0.0
    for n in range(4):
        generalized_force(
            1, task.structure, s.one_mass, work.one_theta, s.one_nu, s.one_h, s.one_extended
        )
        at = late + NODES[n] * dt
        for i in range(6):
            total = 0.0
            for j in range(6):
                total += s.inverse[i, j] * (s.force[j] + at * s.slope[j] - s.one_h[j, 0])
            s.rate[i] += WEIGHTS[n] * total
            s.one_nu[i, 0] = nu[i] + AHEAD[n] * dt * total
    for i in range(6):
        s.middle[i] = nu[i] + 0.5 * dt * s.rate[i]
        for k in range(_POINTS):
            s.nu[i, k] = s.middle[i] + (_SHIFT if k == i + 1 else 0.0)
    generalized_force(_POINTS, task.structure, s.mass, work.theta, s.nu, s.h, s.extended)
    for i in range(6):
        for k in range(6):
            total = 0.0
            for j in range(6):
                total -= s.inverse[i, j] * (s.h[j, 1 + k] - s.h[j, 0])
            s.jacobian[i, k] = total / _SHIFT
    for i in range(6):
        for j in range(6):
            unit = 1.0 if i == j else 0.0
            square, into = 0.0, 0.0
            for a in range(6):
                square += s.jacobian[i, a] * s.jacobian[a, j]
                into += s.jacobian[i, a] * s.inverse[a, j]
            s.transition[i, j] = unit + dt * (s.jacobian[i, j] + 0.5 * dt * square)
            s.into[i, j] = dt * (s.inverse[i, j] + 0.5 * dt * into)


@inlined
def _judge_motion(task, state, work, sample):
    """Columns of coefficients first whose velocities are well above the noise of their sensor."""
    c = state.scalars[0]
    decay = np.exp(-sample.dt / _PEAK_TIME)
    for i in range(6):
        r = sample.odometry_variance[i]
        if i >= 3 and np.isfinite(sample.gyro[i - 3]):
            r = sample.gyro_variance
        # less what the observer's own noise reaches now and then
        surely = state.nu[i] ** 2 - _NOISE_PEAK * state.p[i, i]
        c.peak[i] = max(c.peak[i] * decay, surely)
        work.moving[i] = 1 if c.peak[i] > _MOVING * max(c.noise[i], 1.0) * r else 0
    in_motion(task.structure, work.moving, work.moves)
    for e in range(len(task.structure.mass_row) + len(task.structure.row), len(task.theta)):
        work.moves[e] = True
    free, sorted_already = 0, True
    for a in range(len(work.estimated)):
        if work.moves[work.estimated[a]]:
            sorted_already = sorted_already and free == a
            free += 1
    c.free = free
    if not sorted_already:
        _sort(task, state, work)


@inner
def _sort(task, state, work):
    """Columns of what moves first, all parts of the state alike."""
    n, place, at = len(state.order), work.place, 0
    for moves in (True, False):
        for a in range(n):
            if work.moves[work.estimated[a]] == moves:
                place[at] = a
                at += 1
    _permute(place, state.order, work.estimated)
    _permute(place, state.lagged, work.line)
    _permute(place, state.deviation, work.line)
    _permute(place, state.solution, work.line)
    copy(work.score, work.spare)
    for a in range(n):
        for b in range(n):
            work.score[a, b] = work.spare[place[a], place[b]]
    copy(work.sensitivity, work.drive)
    for a in range(n):
        for i in range(6):
            work.sensitivity[i, a] = work.drive[i, place[a]]
    _name_columns(task, state, work)
    # a root of the permuted information: the old one's rows, stacked below nothing
    copy(work.root, work.spare)
    for a in range(n):
        for b in range(n + 1):
            work.root[a, b] = 0.0
    for first in range(0, n, 3):
        for i in range(3):
            a = first + i
            for b in range(n):
                work.rows[i, b] = work.spare[a, place[b]] if a < n else 0.0
            work.rows[i, n] = work.spare[a, n] if a < n else 0.0
        _stack(work.root, work.rows, n, 3, 0, work.line)


@inner
def _permute(place, x, before):
    """x[a] (n,) becomes x[place[a]]; before (n,) is work space."""
    for a in range(len(x)):
        before[a] = x[a]
    for a in range(len(x)):
        x[a] = before[place[a]]


# ---------------------------------------------------------------- update


@inlined
def _update(task, state, work, sample, side, info):
    """Linear and angular velocity, one component after another; their rows into the root."""
    s, c, scratch = task.settings[0], state.scalars[0], work.scratch[0]
    nu, p, sensitivity, rows = state.nu, state.p, work.sensitivity, work.rows
    z, r, n = scratch.z, scratch.r, len(task.scale)
    count, gated, wild = 0, False, False
    for i in range(6):
        z[i], r[i] = sample.odometry[i], sample.odometry_variance[i]
        if i >= 3 and np.isfinite(sample.gyro[i - 3]):
            z[i], r[i] = sample.gyro[i - 3], sample.gyro_variance
        if not np.isfinite(z[i]) or not np.isfinite(r[i]):
            z[i] = np.nan
            continue
        # less what the parameters of effects, as they are, add to the measurement
        first = len(task.theta) - side.shape[1]
        for j in range(side.shape[1]):
            z[i] -= side[6 + i, j] * (work.one_theta[first + j, 0] - side[12, j])
        for k in range(rows.shape[1]):
            rows[count, k] = sensitivity[i, k] + work.direct[i, k]
        count += 1
    if count == 0:
        info.reason = WAITING
        return
    # what an innovation owes to coefficients still to be learnt is no surprise
    _whiten(work.root, rows, n, count, c.free, scratch.product)
    count, moving = 0, 0
    for i in range(6):
        moving += work.moving[i]
    for i in range(6):
        if np.isnan(z[i]):
            continue
        since = state.adaptation[i].since
        r[i] *= max(c.noise[i], 1.0)
        e = z[i] - nu[i] + rows[count, n]
        for a in range(n):
            e += (sensitivity[i, a] + work.direct[i, a]) * state.deviation[a]
        spread = p[i, i] + r[i] + scratch.product[0, count]
        count += 1
        info.ratio[i] = e * e / spread
        gated = gated or info.ratio[i] > s.gate**2
        wild = wild or info.ratio[i] > _WILD**2
        if moving == 0:  # on the ground, on deck: what holds it there says nothing of the dive
            interrupt(state.adaptation[i])
            add_surprise(c.surprise, i, 1.0, since)
            continue
        add_surprise(c.surprise, i, info.ratio[i], since)
        # as far as it is the noise, and not the prediction, that an innovation shows
        averaging = min(1.0 + 0.25 * state.adaptation[i].seen, _NOISE_TIME)
        excess = (min(info.ratio[i], _STEADY) - _STEADY_MEAN) * r[i] / spread
        c.noise[i] *= 1.0 + min(since / averaging, 0.1) * excess
        c.noise[i] = min(max(c.noise[i], 0.5), _NOISIEST)
        adapt(state.adaptation[i], task.process[0], i, _ROOM, e / np.sqrt(spread))
    c.refused *= np.exp(-sample.dt / _PATIENCE_TIME)
    if wild or (gated and c.refused < _PATIENCE):
        c.refused += 1.0
        # One alone is the sensor's. If it was the wrench, the next measurement is off, too, and the
        # observer would be wrong for long.
        c.started = c.refused < _LONE
        info.reason = GATED
        return
    _absorb(state, work, n)
    _stack(work.root, rows, c.free, 6, 0, work.line)


@reordered
def _whiten(root, rows, n, count, free, squares):
    """rows (count, columns) -> [w | -w z], w = phi R^-1; squares[0] (count,) of w: phi P phi'.

    squares[1] (count,) is the part of it that the columns after the free ones add.
    """
    columns = root.shape[1]
    for i in range(count):
        rows[i, n], squares[0, i], squares[1, i] = 0.0, 0.0, 0.0
    for a in range(n):
        for i in range(count):  # inside, as no row waits for another
            f = rows[i, a] / root[a, a]
            squares[0, i] += f * f
            squares[1, i] += f * f if a >= free else 0.0
            for k in range(columns):
                rows[i, k] -= f * root[a, k]


@reordered
def _absorb(state, work, n):
    """Take in the measured velocities, one after the other; their rows (6, columns) of the root.

    What a row owes to coefficients that are held is noise to it: at its full weight it would tie
    the free ones to them, and undo what is known of the free ones.
    """
    s, nu, p = work.scratch[0], state.nu, state.p
    sensitivity, rows = work.sensitivity, work.rows
    columns, q = rows.shape[1], 0
    for i in range(6):
        if s.z[i] != s.z[i]:
            continue
        total = p[i, i] + s.r[i]
        weight, e = 1.0 / np.sqrt(total + s.product[1, q]), s.z[i] - nu[i]
        goal = e
        for k in range(columns):
            rows[q, k] = sensitivity[i, k] + work.direct[i, k]
        for a in range(n):
            goal += rows[q, a] * state.deviation[a]
        for k in range(columns):
            rows[q, k] *= weight
        rows[q, n] = weight * goal
        for a in range(6):
            s.middle[a] = p[a, i]
        for a in range(6):
            gain = s.middle[a] / total
            nu[a] += gain * e
            for k in range(columns):
                sensitivity[a, k] -= gain / weight * rows[q, k]
            sensitivity[a, n] = 0.0
            for b in range(6):
                p[a, b] -= gain * s.middle[b]
        q += 1
    for i in range(q, 6):
        for k in range(columns):
            rows[i, k] = 0.0


@inlined
def _learn(task, state, work, info):
    """The observer takes over what the rows since the last time have taught."""
    s, c, n = task.settings[0], state.scalars[0], len(state.order)
    _invert(work.root, work.inverse)
    info.condition = _norm(work.root, n, work.line) * _norm(work.inverse, n, work.line)
    _add_up(task, state, work, c.since_update)
    _take_over(task, state, work)
    if not s.variable and s.forgetting_factor < 1.0:
        info.forgetting = s.forgetting_factor
        _forget(task, state, work, s.forgetting_factor)
    elif s.variable and _suspect(state, work):
        share = min(c.since_update / RELEARNING_TIME, 1.0)
        info.forgetting = 1.0 - share
        _loosen(state, work, share)
    c.since_update = 0.0


@reordered
def _add_up(task, state, work, since):
    """The change of the solution, the observer's with it, and the score ``g = R'R change``."""
    n, root, change, gradient = len(state.order), work.root, work.change, work.gradient
    _solve(root, gradient)
    for i in range(6):
        total = 0.0
        for a in range(n):
            total -= work.sensitivity[i, a] * state.deviation[a]
        state.nu[i] += total
    for a in range(n):
        change[a], state.solution[a] = gradient[a] - state.solution[a], gradient[a]
        highest = task.highest[state.order[a]]
        state.deviation[a] = min(max(gradient[a], -_REACH), highest)
        gradient[a] = 0.0
    for i in range(6):
        total = 0.0
        for a in range(n):
            total += work.sensitivity[i, a] * state.deviation[a]
        state.nu[i] += total
    for a in range(n):
        moved = 0.0
        for b in range(a, n):
            moved += root[a, b] * change[b]
        for b in range(a, n):
            gradient[b] += root[a, b] * moved
    add_score(gradient, state.lagged, work.score, since)


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


@kernel
def inverse_of(root):
    """R^-1 (n, n) of the root (n, n + 1) = [R | z]."""
    n = len(root)
    columns = _WIDTH * ((n + 2) // _WIDTH + 1)
    padded, inverse = np.zeros((n + 2, columns)), np.zeros((n + 2, columns))
    copy(root, padded)
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
def _stack(root, rows, free, count, leaving, dot):
    """Householder: make [root; rows] upper triangular again in its first ``free`` columns.

    The first ``count`` rows come in, the ``leaving`` ones from the seventh on leave: with J their
    signs, Q' J Q = J (hyperbolic Householder). Both numbers are multiples of three. What the rows
    say about the other columns is left over.
    """
    columns = root.shape[1]
    for j in range(free):
        below = 0.0
        for i in range(count):
            below += rows[i, j] ** 2
        for i in range(6, 6 + leaving):
            below -= rows[i, j] ** 2
        if below == 0.0:
            continue
        pivot = root[j, j]
        alpha = -np.sqrt(pivot * pivot + below) if pivot > 0.0 else np.sqrt(pivot * pivot + below)
        head = pivot - alpha
        beta = 2.0 / (head * head + below)
        for k in range(columns):
            dot[k] = head * root[j, k]
        for i in range(0, count, 3):
            f, g, h = rows[i, j], rows[i + 1, j], rows[i + 2, j]
            for k in range(columns):
                dot[k] += f * rows[i, k] + g * rows[i + 1, k] + h * rows[i + 2, k]
        for i in range(6, 6 + leaving, 3):
            f, g, h = rows[i, j], rows[i + 1, j], rows[i + 2, j]
            for k in range(columns):
                dot[k] -= f * rows[i, k] + g * rows[i + 1, k] + h * rows[i + 2, k]
        head *= beta
        for k in range(columns):
            root[j, k] -= head * dot[k]
        root[j, j] = alpha
        for i in range(count):
            f = beta * rows[i, j]
            for k in range(columns):
                rows[i, k] -= f * dot[k]
            rows[i, j] = 0.0
        for i in range(6, 6 + leaving):
            f = beta * rows[i, j]
            for k in range(columns):
                rows[i, k] -= f * dot[k]
            rows[i, j] = 0.0


# ---------------------------------------------------------------- forgetting


@inlined
def _suspect(state, work):
    """work.moves (n,): of which columns a surprised axis would show a change; whether of any."""
    c, any_of_them = state.scalars[0], False
    for a in range(len(state.order)):
        work.moves[a] = False
        for i in range(6):
            if a < c.free and c.surprise[i] > _SURPRISING:
                shown = work.sensitivity[i, a] ** 2
                work.moves[a] |= shown > state.p[i, i] + work.scratch[0].r[i]
        any_of_them |= work.moves[a]
    return any_of_them


@reordered
def _loosen(state, work, share):
    """The vehicle has changed: P <- P + W, the estimate stays.

    W is diagonal, a share of the prior for each suspect as it has room to it: what it would gain on
    a random walk. With X = R^-1, P = X X', and [X W^1/2] is made triangular from the right
    (Householder, row by row from the last), which is the inverse of the new root. The score's
    covariance becomes that of a sandwich which has gained W, too.
    """
    n, root, x, extra, score = len(state.order), work.root, work.inverse, work.spare, work.score
    columns = root.shape[1]
    # score: P S P
    _transpose(x, n, extra)
    _multiply(x, extra, n, root)
    _multiply(root, score, n, extra)
    _multiply(extra, root, n, score)
    for a in range(n):
        present = 0.0
        for k in range(columns):
            extra[a, k] = 0.0
            present += x[a, k] ** 2
        if work.moves[a]:
            extra[a, a] = np.sqrt(share * max(1.0 - present, 0.0))
            score[a, a] += extra[a, a] ** 2
    for a in range(n - 1, -1, -1):
        beside = 0.0
        for k in range(columns):
            beside += extra[a, k] ** 2
        if beside == 0.0:
            continue
        pivot = x[a, a]
        alpha = -np.sqrt(pivot * pivot + beside) if pivot > 0.0 else np.sqrt(pivot * pivot + beside)
        head = pivot - alpha
        beta = 2.0 / (head * head + beside)
        for i in range(a):
            dot = head * x[i, a]
            for k in range(columns):
                dot += extra[a, k] * extra[i, k]
            dot *= beta
            x[i, a] -= dot * head
            for k in range(columns):
                extra[i, k] -= dot * extra[a, k]
        x[a, a] = alpha
    _invert(x, root)
    # score: R'R (P S P + W) R'R
    _transpose(root, n, x)
    _multiply(x, root, n, extra)
    _multiply(extra, score, n, x)
    _multiply(x, extra, n, score)
    for a in range(n):
        total = 0.0
        for b in range(a, n):
            total += root[a, b] * state.solution[b]
        root[a, n] = total


@reordered
def _multiply(a, b, n, out):
    """out = a b, (n, n) each."""
    for i in range(n):
        for k in range(n):
            out[i, k] = 0.0
        for j in range(n):
            f = a[i, j]
            for k in range(n):
                out[i, k] += f * b[j, k]


@inner
def _transpose(a, n, out):
    """out = a'."""
    for i in range(n):
        for k in range(n):
            out[i, k] = a[k, i]


@reordered
def _forget(task, state, work, factor):
    """Leave ``factor`` of the information in what the sensitivities see, and only there.

    With A = R'R, u = R phi' and Q an orthonormal basis of the u of all excited rows::

        A_new = R' (I - (1 - factor) Q Q') R = A - V V',     V = sqrt(1 - factor) R' Q

    V' leaves the root. The estimate stays; the score's covariance S goes with the information: with
    ``T = A_new A^-1 = I - V W'``, ``W = sqrt(1 - factor) R^-1 Q``::

        T S T' = S - V D' - D V',     D = S W - V (W' S W) / 2
    """
    c, n = state.scalars[0], len(state.order)
    root, score, rows, basis = work.root, work.score, work.rows, work.basis
    w, d, product = work.lost[0], work.lost[1], work.scratch[0].product
    columns, count, share = root.shape[1], 0, np.sqrt(1.0 - factor)
    for i in range(6):
        total = state.p[i, i] + work.scratch[0].r[i]
        size, left = 0.0, 0.0
        for k in range(columns):
            w[count, k] = work.sensitivity[i, k] if k < c.free else 0.0
            size += w[count, k] ** 2 / total
        if not size > _EXCITED:  # NaN, too
            continue
        for a in range(n):
            total = 0.0
            for k in range(columns):
                total += root[a, k] * w[count, k]
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
        _combine(basis[b], root, n, rows[6 + b])  # with its part of z, so that the solution stays
        _combine(w[b], score, n, d[b])
        for k in range(columns):
            basis[b, k] = rows[6 + b, k]
        basis[b, n] = 0.0
    v = basis
    for b in range(6):
        for e in range(6):
            total = 0.0
            for k in range(columns):
                total += w[e, k] * d[b, k]
            product[b, e] = 0.5 * total
    for b in range(6):
        for e in range(6):
            f = product[b, e]
            for k in range(columns):
                d[b, k] -= f * v[e, k]
    for b in range(0, 6, 3):
        for a in range(n):
            f, g, h = v[b, a], v[b + 1, a], v[b + 2, a]
            x, y, z = d[b, a], d[b + 1, a], d[b + 2, a]
            for k in range(columns):
                forth = f * d[b, k] + g * d[b + 1, k] + h * d[b + 2, k]
                back = x * v[b, k] + y * v[b + 1, k] + z * v[b + 2, k]
                score[a, k] -= forth + back
    _stack(root, rows, n, 0, 6, work.line)


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
