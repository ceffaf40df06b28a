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
(filtered accelerations and products of measured velocities) would need no observer, but ends at six
times the Cramer-Rao bound instead of one and a half (docs/choices.md).

Rows that were taken about poor coefficients are taken again (``iterated_update``).

The information is kept as a triangular root R of ``R'R = sum of phi' phi / s`` (Householder; it
keeps half the digits that the covariance form loses), in coefficients scaled by their prior
standard deviation about their prior value: the prior is the unit matrix.

*Coefficients whose motion is not well above its noise* are not learnt, or it would be from the
noise; nor are those of an axis, or a factor of the thrust, while the wrench there is little above
that of its reading. But their uncertainty is that of the others, too. With their columns behind the
others', R holds the distribution of the others *given* them, and that alone takes new rows
(consider parameters, Bierman 1977, ch. VIII).

*Forgetting* waits for evidence: while the innovations of an axis are larger than they should be,
the coefficients that would show there gain variance as on a random walk, up to the prior's.
Constant forgetting, where it is asked for, touches only directions that the present motion excites
(subspace-of-information forgetting, Lai and Bernstein 2024). So nothing winds up.

*Standard deviations* do not assume white innovations: the covariance of the accumulated score
``sum of phi' e / s`` (`shared.add_scatter`) stands between two inverse informations.

*The thrust of single axes*, which may be off (`prior.ONE_AXIS`), is nobody's column, but a further
right-hand side each: what the solution is wrong by if that thrust is off by its deviation.
"""

from collections import namedtuple
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.config.prior import Prior, prior_of
from rov_ident.core.jit import copy, floats, inlined, inner, kernel, record, reordered
from rov_ident.core.messages import Array
from rov_ident.estimation.innovation_monitor import (
    first_monitor,
    has_changed,
    interrupt,
    lost,
    watch,
)
from rov_ident.estimation.mass_inverse import invert_mass, invert_translation
from rov_ident.estimation.observer import (
    LANES,
    OBSERVER,
    advance,
    advance_covariance,
    correct,
    drive_of,
    force_of,
    linearised_step,
    take_guide,
    take_inputs,
)
from rov_ident.estimation.physical import Estimate, calibrated
from rov_ident.estimation.process_noise import is_guided, wrench_noise
from rov_ident.estimation.shared import (
    FASTEST,
    LAG,
    REACH,
    RELEARNING_TIME,
    WALK_PERIOD,
    Problem,
    add_scatter,
    begin,
    drive_sides,
    excited,
    folded,
    measure,
    problem_of,
    steps_of,
    thrust_of,
)
from rov_ident.estimation.square_root import (
    add_variance,
    columns_of,
    forget,
    inverse_of,
    invert,
    one_norm,
    permute,
    reorder,
    solve,
    stack,
    whiten,
)
from rov_ident.estimation.thrust_coordinates import jacobian_of, take_thrust, values_of
from rov_ident.estimation.wrench_residual import filtered_residual
from rov_ident.model.equations import add_added_mass, momentum_columns

USED, RESTARTED, WAITING, GATED, NOT_FINITE, UNPREDICTABLE = range(6)
REASONS = (
    "used", "restarted after a gap", "not measured", "outlier", "not finite", "no model moves so",
)  # fmt: skip
REFUSALS = (GATED, NOT_FINITE, UNPREDICTABLE)

_PERIOD = 0.1  # s; the observer takes over the present coefficients, and forgets, this often
_ROOM = 1.2  # for innovation_monitor.watch ("Constants of the process noise" in docs/choices.md)
_CHANGED = 3.0  # NIS from which the vehicle has changed ("Forgetting" in docs/choices.md)
# "What does not move is not learnt" in docs/choices.md
_PEAK_TIME = 5.0  # s; over which a peak of a velocity is remembered
_MOVING = 4.0  # that peak's square over the noise variance from which the component moves: 2 sigma
_NOISE_PEAK = 16.0  # variances: 4 sigma, which noise exceeds once in 16 000 samples, or minutes
_EXCITED = 0.01  # of the prior's information: a hundred such rows would tell as much as the prior

# the corner [rad/s] is that of the published residual
_SETTINGS = record(
    [*floats((), "corner gate forgetting_factor"), ("variable", "?"), ("walks", "?")]
)
_SCALARS = record(
    [
        *floats((), "t since_update since_walk"),
        ("guided", "?"),  # the vehicle turns as measured
        ("rho", "f8"),  # thrust scale over its prior mean, of the observer
        ("peak", "f8", (6,)),  # squared velocities, their peaks of late
        ("free", "i8"),  # so many of the first columns take rows
        ("started", "?"),
        ("pinned", "?"),  # the observer keeps the coefficients that it has
    ]
)


class State(NamedTuple):
    """All that the next step needs. Columns of coefficients are in the order of ``order``."""

    order: NDArray[np.int64]  # (n,): indices into Problem.estimated
    # (n, n + 1 + q): [R | z | Z], R upper triangular, of the coordinates: scaled deviations from
    # the prior; Z of the thrust of q single axes
    root: Array
    score: Array  # (n, n): covariance of the accumulated score, the prior's included
    lagged: Array  # (n,): recent scores under the lag window
    solution: Array  # (n,): of R x = z when the observer was told last
    deviation: Array  # (n,): what the observer took over of it, within reason
    nu: Array  # (6,): velocities
    p: Array  # (6, 6): their covariance, the coefficients taken as known
    sensitivity: Array  # (6, n + 1 + q): d nu / d deviation; nothing; d nu / d thrust of an axis
    monitor: NDArray[np.void]  # (6,) of MONITOR: of the innovations
    residual: Array  # (4, 6): filters of the published residual
    scalars: NDArray[np.void]  # (1,)


def problem(config: Config) -> Problem:
    """The constants of the estimation that a configuration asks for."""
    own = config.rls
    factor, variable = own.forgetting_factor, own.forgetting == "variable"
    task = problem_of(config, _SETTINGS, gate=own.gate, forgetting_factor=factor, variable=variable)
    task.settings["walks"] = task.drift.any()
    if task.thrust >= 0:
        # prior standard deviations of the coordinates
        std = np.linalg.norm(np.linalg.inv(jacobian_of(task, np.zeros(len(task.scale)))), axis=1)
        task.reach[:] = REACH * std
        task.highest[task.per_thrust] = np.minimum(-task.start, task.reach)[task.per_thrust]
        free = task.per_thrust & ~prior_of(config, True).negative
        task.highest[free] = task.reach[free]
    return task


def init(task: Problem) -> State:
    """Nothing learnt: the prior; the velocity is taken from the first measurement."""
    n, columns = len(task.scale), len(task.scale) + 1 + len(task.axis_std)
    scalars = np.zeros(1, dtype=_SCALARS)
    scalars["free"], scalars["rho"] = n, 1.0
    root = np.eye(n, columns)
    # of the prior, a unit matrix for the coefficients themselves
    root[:, :n] = np.linalg.qr(jacobian_of(task, np.zeros(n)))[1]
    return State(
        np.arange(n),
        root,
        root[:, :n].T @ root[:, :n],
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(6),
        np.zeros((6, 6)),
        np.zeros((6, columns)),
        first_monitor(task.process),
        np.zeros((4, 6)),
        scalars,
    )


def fold(task: Problem, state: State, samples: NDArray[np.void]) -> tuple[State, NDArray[np.void]]:
    """:func:`step` over samples (k,) of SAMPLE; info (k,) of INFO. The given state is unchanged."""
    return folded(_fold, task, state, samples)


def fold_about(
    task: Problem, state: State, samples: NDArray[np.void], solution: Array
) -> State | None:
    """:func:`fold` with an observer at one solution (n,), in the order of the coefficients.

    None if the velocities run away with it.
    """
    deviation = np.clip(solution, -task.reach, task.highest)[state.order]
    pinned = state.scalars.copy()
    pinned["pinned"] = True
    nu = state.nu + state.sensitivity[:, : len(deviation)] @ (deviation - state.deviation)
    state, info = fold(task, state._replace(nu=nu, deviation=deviation, scalars=pinned), samples)
    state.scalars["pinned"] = False
    return None if (info["reason"] == UNPREDICTABLE).any() else state


def step(task: Problem, state: State, sample: NDArray[np.void]) -> tuple[State, NDArray[np.void]]:
    """One sample (1,) of SAMPLE; the next state and what happened (1,) of INFO."""
    assert len(sample) == 1
    return fold(task, state, sample)


def estimate(task: Problem, state: State, prior: Prior) -> Estimate:
    """Coefficients and covariance (n, n), calibrated for coloured residuals, in their own units."""
    n, place = len(task.scale), np.argsort(state.order)
    inverse = np.linalg.solve(state.root[:, :n], np.eye(n))
    information = inverse @ inverse.T
    solutions = (inverse @ state.root[:, n:])[place]
    unit = task.scale[:, None] * jacobian_of(task, solutions[:, 0])
    covariance = calibrated(information, state.score)[np.ix_(place, place)]
    return Estimate(
        prior.names,
        values_of(task, solutions[:, 0]),
        unit @ covariance @ unit.T,
        float(state.scalars["t"][0]),
        unit @ solutions[:, 1:],
    )


def solution_of(state: State) -> tuple[Array, Array]:
    """The coordinates and their standard deviations, both (n,) in the order of the coefficients."""
    place, inverse = np.argsort(state.order), inverse_of(state.root)
    solution = inverse @ state.root[:, len(inverse)]
    return solution[place], np.linalg.norm(inverse, axis=1)[place]


def about_of(state: State) -> Array:
    """The coordinates (n,) that the next row is taken about."""
    about: Array = state.solution[np.argsort(state.order)]
    return about


def variance(task: Problem, state: State) -> Array:
    """Diagonal (n,) of the inverse information, in squared units: what excitation is judged by."""
    inverse = inverse_of(state.root)[np.argsort(state.order)]
    root = jacobian_of(task, inverse @ state.root[:, len(inverse)]) @ inverse
    variances: Array = task.scale**2 * (root**2).sum(axis=1)
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
# Matrices that are worked on are padded with zeros as square_root.py asks for.

_SCRATCH = record(
    [
        *OBSERVER,
        ("lower_inverse", "f8", (6, 6, 1)),
        ("noise", "f8", (6, 6)),  # variance density of the acceleration
        # that acts; nu as measured, its variance; covariance of nu with one component of it
        *floats((6,), "wrench thrust z r cross"),
        # what uncertain coefficients add to the variance of innovations, in the order of the rows;
        # the part of it that those add which are held, in this order and by axis
        ("spread", "f8", (3, 6)),
        ("rho", "f8", (1,)),
    ]
)

Work = namedtuple(
    "Work",
    "theta one_theta estimated scale place moves moving noisy momentum of_rate of_motion change "
    "gradient line sensitivity drive direct root inverse score spare rows basis lost solutions "
    "scratch",
)
"""Scratch for all samples of a fold."""


@inlined
def _work(task, state):
    n, m = len(task.scale), len(task.theta)
    sides = state.root.shape[1] - n
    columns = columns_of(n, sides)
    work = Work(
        np.empty((m, LANES)),  # theta of the observer
        np.empty((m, 1)),
        np.empty(n, dtype=np.int64),  # indices into theta, in the order of the columns
        np.empty(n),
        np.empty(n, dtype=np.int64),  # where each column was
        np.empty(m, dtype=np.bool_),
        np.empty(6, dtype=np.uint8),
        np.empty(6, dtype=np.bool_),
        np.empty((6, m)),  # per unit of each coefficient
        np.empty((6, m)),
        np.empty((6, m)),
        np.empty(n),
        np.empty(n),
        np.empty(columns),
        np.zeros((6, columns)),
        np.zeros((6, columns)),
        np.zeros((6, columns)),  # what a column adds to the measured velocity alone
        np.zeros((n + 2, columns)),  # [R | z | Z]
        np.zeros((n + 2, columns)),  # R^-1 when the observer last took over the coefficients
        np.zeros((n + 2, columns)),
        np.zeros((n + 2, columns)),
        np.zeros((12, columns)),  # what comes in, and what is forgotten
        np.zeros((6, columns)),  # orthonormal directions to forget in
        np.zeros((2, 6, columns)),  # work space of square_root.forget
        np.empty((n, sides)),  # work space of square_root.add_variance
        np.empty(1, dtype=_SCRATCH),  # in one record, whose parts the compiler knows apart
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
    """The fold itself, apart from what makes its arrays (:func:`rov_ident.core.jit.lean`)."""
    c, x = state.scalars[0], work.scratch[0]
    _take_over(task, state, work)
    for k in range(len(samples)):
        sample, info, side = samples[k], infos[k], sides[k if sides.shape[2] > 0 else 0]
        if not begin(info, sample):
            info.reason = NOT_FINITE
            continue
        c.t = sample.t
        if c.guided != is_guided(sample):
            c.guided = is_guided(sample)
            _take_over(task, state, work)
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
        restarted = info.reason == RESTARTED
        filtered_residual(task, work.one_theta, x, state.residual, sample, restarted, info.residual)


@inlined
def _take_sides(task, work, sample, side):
    """What acts, with the parameters of effects as they are; the columns of what they measure."""
    first = len(task.theta) - side.shape[1]
    s = work.scratch[0]
    thrust_of(task, work.one_theta, sample, side, s.wrench, s.thrust)
    if side.shape[1] > 0:
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
        interrupt(state.monitor[i])
        state.monitor[i].outliers = 0
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
    take_thrust(1, task, work.one_theta, s.rho)
    state.scalars[0].rho = s.rho[0]
    for j in range(len(task.theta)):
        for k in range(LANES):
            work.theta[j, k] = work.one_theta[j, 0]
    for i in range(6):
        for j in range(6):
            s.one_mass[i, j, 0] = task.rigid_body[i, j]
    add_added_mass(task.structure, work.one_theta, s.one_mass)
    if state.scalars[0].guided:
        invert_translation(1, s.one_mass, task.lightest, s.lower_inverse)
    else:
        invert_mass(1, s.one_mass, task.lightest, s.lower_inverse)
    for i in range(6):
        for j in range(6):
            s.inverse[i, j] = s.lower_inverse[max(i, j), min(i, j), 0]
            for k in range(LANES):
                s.mass[i, j, k] = s.one_mass[i, j, 0]


@reordered
def _predict(task, state, work, sample, side):
    """Velocities, covariance, sensitivities to the sample's time; False if out of all reason."""
    s, nu, p, sensitivity = work.scratch[0], state.nu, state.p, work.sensitivity
    noise, inverse = s.noise, s.inverse
    n = len(work.scale)
    force_of(sample, s.wrench, task.restoring, s.force, s.slope)
    take_inputs(task.structure, sample.inputs[0], s)
    doubtful, guided = wrench_noise(task.process[0], sample, s.middle), is_guided(sample)
    for i in range(6):
        s.guide[i] = 0.0
        if guided and i >= 3:
            s.guide[i] = (sample.nu[i] - nu[i]) / sample.dt
            for a in range(sensitivity.shape[1]):
                sensitivity[i, a] = 0.0
            for j in range(6):
                p[i, j] = p[j, i] = 0.0
    take_guide(s)
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for a in range(6):
                total += inverse[i, a] * inverse[j, a] * s.middle[a]
            noise[i, j] = total
            noise[j, i] = total
        if guided and i >= 3:
            continue
        state.monitor[i].since += sample.dt
        noise[i, i] += state.monitor[i].density
        state.monitor[i].acting = 0.0 if doubtful else noise[i, i]
    steps = steps_of(sample.dt)
    dt = sample.dt / steps
    for step in range(steps):
        linearised_step(
            task.structure, work.theta, work.one_theta, nu, step * dt - 0.5 * sample.dt, dt, s
        )
        momentum_columns(task.structure, s.middle_nu_dot, work.of_rate)
        drive_of(task.structure, s.middle, work.estimated, work.scale, n, work, work.drive)
        drive_sides(len(task.theta) - side.shape[1], work.estimated, work.scale, side, work.drive)
        if task.thrust >= 0:
            _by_coordinates(task, state, work)
        for axis in range(len(task.axis_std)):
            for i in range(6):
                work.drive[i, n + 1 + axis] = 0.0
            work.drive[axis, n + 1 + axis] = task.axis_std[axis] * s.thrust[axis]
        advance(s.transition, sensitivity, s.into, work.drive, work.rows)
        advance_covariance(s.transition, noise, dt, p, s.product)
        for i in range(6):
            nu[i] = s.end[i]
    fastest = 0.0
    for i in range(6):
        fastest += nu[i] * nu[i]
    return fastest < FASTEST**2  # not so with NaN


@inlined
def _by_coordinates(task, state, work):
    """The columns of drive, of coefficients so far, become those of the coordinates.

    What the thrust scale does is taken from the whole thrust, as the model has it now: a column
    that lacked some of it (products with a lag, with motion near the noise) would not cancel with
    those of the coefficients, and what is left would claim to know the scale.
    """
    rho, drive, at = state.scalars[0].rho, work.drive, 0
    for a in range(len(work.estimated)):
        if state.order[a] == task.thrust:
            at = a
    step = rho * work.scale[at] / task.theta[work.estimated[at]]
    for i in range(6):
        total = work.scratch[0].thrust[i]
        for a in range(len(work.estimated)):
            if task.per_thrust[state.order[a]]:
                total += work.one_theta[work.estimated[a], 0] / work.scale[a] * drive[i, a]
                drive[i, a] *= rho
        drive[i, at] = step * total


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
        work.moving[i] = 1 if c.peak[i] > _MOVING * r else 0
    inverse = work.scratch[0].inverse
    excited(task, work.moving, sample, state.monitor, inverse, work.noisy, work.moves)
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
    permute(place, state.order, work.estimated)
    permute(place, state.lagged, work.line)
    permute(place, state.deviation, work.line)
    permute(place, state.solution, work.line)
    copy(work.score, work.spare)
    for a in range(n):
        for b in range(n):
            work.score[a, b] = work.spare[place[a], place[b]]
    copy(work.sensitivity, work.drive)
    for a in range(n):
        for i in range(6):
            work.sensitivity[i, a] = work.drive[i, place[a]]
    _name_columns(task, state, work)
    reorder(work.root, place, work.spare, work.rows, work.line)


# ---------------------------------------------------------------- update


@inlined
def _update(task, state, work, sample, side, info):
    """Linear and angular velocity, each behind its own gate; their rows into the root."""
    s, z, r, n = work.scratch[0], work.scratch[0].z, work.scratch[0].r, len(task.scale)
    effects, count, moving = len(task.theta) - side.shape[1], 0, False
    measure(sample, z, r)
    for i in range(6):
        moving |= work.moving[i] != 0
        if is_guided(sample) and i >= 3:
            z[i] = np.nan
        if np.isnan(z[i]):
            continue
        # less what the parameters of effects, as they are, add to the measurement
        for j in range(side.shape[1]):
            z[i] -= side[6 + i, j] * (work.one_theta[effects + j, 0] - side[12, j])
        for k in range(work.rows.shape[1]):
            work.rows[count, k] = work.sensitivity[i, k] + work.direct[i, k]
        count += 1
    if count == 0:
        info.reason = WAITING
        return
    # what an innovation owes to coefficients still to be learnt is expected of it
    whiten(work.root, work.rows, n, count, state.scalars[0].free, s.spread)
    count, anew, gate = 0, False, task.settings[0].gate
    for first in (0, 3):
        measured, outlier = False, False
        for i in range(first, first + 3):
            if np.isnan(z[i]):
                continue
            e = z[i] - state.nu[i] + work.rows[count, n]
            for a in range(n):
                e += (work.sensitivity[i, a] + work.direct[i, a]) * state.deviation[a]
            e /= np.sqrt(state.p[i, i] + r[i] + s.spread[0, count])
            s.spread[2, i] = s.spread[1, count]
            count += 1
            measured, info.nis[i] = True, e * e
            own = work.moving[i] != 0
            outlier |= watch(state.monitor[i], task.process[0], i, _ROOM, moving, own, gate, e, 0.0)
        if measured:
            anew |= lost(state.monitor, first, outlier)
        if outlier:
            info.reason = GATED
            for i in range(first, first + 3):
                z[i] = np.nan
    if anew:
        _restart(state, work, sample)
        return
    _absorb(task, state, work, n, effects)
    stack(work.root, work.rows, state.scalars[0].free, 6, 0, work.line)


@reordered
def _absorb(task, state, work, n, effects):
    """Take in the measured velocities, one after the other; their rows (6, columns) of the root.

    What a row owes to coefficients that are held is noise to it: at its full weight it would tie
    the free ones to them, and undo what is known of the free ones. So is what it owes to what
    shapes the thrust (a lag) where noise of the wrench's reading is too large: a lag would smooth
    that away. ``effects`` is the first of their parameters.
    """
    s, nu, p = work.scratch[0], state.nu, state.p
    sensitivity, rows = work.sensitivity, work.rows
    columns, q = rows.shape[1], 0
    for i in range(6):
        if s.z[i] != s.z[i]:
            continue
        row, total, e = rows[q], p[i, i] + s.r[i], s.z[i] - nu[i]
        for k in range(columns):
            row[k] = sensitivity[i, k] + work.direct[i, k]
        for a in range(6):
            s.cross[a] = p[a, i]
        correct(nu, p, sensitivity, row, s.cross, total, e)
        variance, goal = total + s.spread[2, i], e
        for a in range(n):
            j = work.estimated[a] - effects
            if work.noisy[i] and j >= 0 and not (task.absolute[j] or task.scaled[j, i]):
                variance += row[a] ** 2  # as uncertain as before any data, in these units
                row[a] = 0.0
            goal += row[a] * state.deviation[a]
        weight = 1.0 / np.sqrt(variance)
        for k in range(columns):
            row[k] *= weight
        row[n] = weight * goal
        q += 1
    for i in range(q, 6):
        for k in range(columns):
            rows[i, k] = 0.0


@inlined
def _learn(task, state, work, info):
    """Give the observer the coefficients that follow from all rows so far."""
    s, c, n = task.settings[0], state.scalars[0], len(state.order)
    invert(work.root, work.inverse)
    info.condition = one_norm(work.root, n, work.line) * one_norm(work.inverse, n, work.line)
    _add_up(task, state, work, c.since_update)
    _take_over(task, state, work)
    if not s.variable and s.forgetting_factor < 1.0:
        info.forgetting = s.forgetting_factor
        _forget(state, work, s.forgetting_factor)
    suspect = s.variable and _suspect(state, work)
    share = min(c.since_update / RELEARNING_TIME, 1.0)
    c.since_walk += c.since_update
    c.since_update = 0.0
    walks = s.walks and c.since_walk >= WALK_PERIOD
    if not (suspect or walks):
        return
    for a in range(n):
        work.change[a] = share if suspect and work.moves[a] else 0.0
        if walks:
            work.change[a] = max(work.change[a], task.drift[state.order[a]] * c.since_walk)
    add_variance(work.root, work.inverse, work.score, work.spare, work.solutions, work.change)
    if suspect:
        info.forgetting = 1.0 - share
    if walks:
        c.since_walk = 0.0


@reordered
def _add_up(task, state, work, since):
    """The change of the solution, the observer's with it, and the score ``g = R'R change``."""
    n, root, change, gradient = len(state.order), work.root, work.change, work.gradient
    solve(root, gradient)
    for i in range(6):
        total = 0.0
        for a in range(n):
            total -= work.sensitivity[i, a] * state.deviation[a]
        state.nu[i] += total
    for a in range(n):
        change[a], state.solution[a] = gradient[a] - state.solution[a], gradient[a]
        if not state.scalars[0].pinned:
            highest = task.highest[state.order[a]]
            state.deviation[a] = min(max(gradient[a], -task.reach[state.order[a]]), highest)
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
    add_scatter(gradient, np.exp(-since / LAG), work.score, state.lagged)


# ---------------------------------------------------------------- forgetting


@inlined
def _suspect(state, work):
    """work.moves (n,): the free columns that show on an axis of large NIS; whether there are any.

    Those through which a prior standard deviation would move the velocity by more than its noise.
    """
    c, any_of_them = state.scalars[0], False
    for a in range(len(state.order)):
        work.moves[a] = False
        for i in range(6):
            if a < c.free and has_changed(state.monitor[i], _CHANGED):
                shown = work.sensitivity[i, a] ** 2
                work.moves[a] |= shown > state.p[i, i] + work.scratch[0].r[i]
        any_of_them |= work.moves[a]
    return any_of_them


@inlined
def _forget(state, work, factor):
    """Constant forgetting: of what the present sensitivities of the free columns see."""
    # not a literal 0, for which numba would compile forget, too
    w, count, free = work.lost[0], np.int64(0), state.scalars[0].free
    for i in range(6):
        size, total = 0.0, state.p[i, i] + work.scratch[0].r[i]
        for k in range(w.shape[1]):
            w[count, k] = work.sensitivity[i, k] if k < free else 0.0
            size += w[count, k] ** 2 / total
        if size > _EXCITED:  # not so with NaN
            count += 1
    forget(
        work.root, work.score, w, count, factor, work.rows, work.basis, work.lost[1],
        work.scratch[0].product, work.line,
    )  # fmt: skip
