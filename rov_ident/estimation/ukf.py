"""Unscented Kalman filter over body velocities and coefficients: ``init``, ``step``, ``fold``.

State ``x = [nu (6), xi (n)]`` with ``theta = scale xi``, the scale being the prior's standard
deviation: linear, or early information would be reinterpreted whenever xi moves. Where the thrust
scale is estimated, xi are the coordinates of `thrust_coordinates` for the same reason. Signs are
for what leaves the filter (`physical`); inside, a sigma point's mass matrix is kept positive
definite.

Prediction: scaled sigma points (van der Merwe 2004; as in filterpy) through Runge-Kutta steps of
the equations of motion, LANES points side by side. The coefficients do not move and the measurement
is linear, so of the 2 (6 + n) + 1 points only the velocities are summed, as differences from the
centre point: with e = mean - centre and W the weight of an outer point

    cov = W sum(delta delta') + (beta - alpha^2) e e'

in which the huge central weight has cancelled exactly.

Update: odometry and gyro measure nu with independent noise, so one component after another is the
same as all at once; the covariance takes three of them together. Samples that were folded with
sigma points about poor coefficients are folded again, about better ones (``iterated_update``).

Coefficients whose motion is not well above its noise are *considered*, not estimated (Schmidt
1966): they stay what they are, their uncertainty is carried along. So are those of an axis, and a
factor of the thrust, where the wrench is little above the noise of its reading. The others walk
only on evidence: while the innovations are larger than they should be, variances grow, up to the
prior's. (``ukf.random_walk`` lets them walk all the time.)

*Standard deviations* do not assume white innovations: the covariance of their summed influence on
the coefficients (`shared.add_scatter`) stands between two covariances of the filter.

*The thrust of single axes*, which may be off (`prior.ONE_AXIS`), is no state. What the state is
wrong by, if that thrust is off by its deviation, is carried along: it moves by the linear part of
the prediction, less what the thrust itself does, and a measurement corrects it like the state.
"""

from collections import namedtuple
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.config.prior import Prior, prior_of
from rov_ident.core.jit import copy, floats, inlined, inner, kernel, record, reordered
from rov_ident.core.messages import Array
from rov_ident.core.runge_kutta import NODES, runge_kutta
from rov_ident.estimation.innovation_monitor import (
    first_monitor,
    has_changed,
    interrupt,
    lost,
    watch,
)
from rov_ident.estimation.mass_inverse import invert_mass, invert_translation
from rov_ident.estimation.observer import force_of
from rov_ident.estimation.physical import Estimate, calibrated
from rov_ident.estimation.process_noise import is_guided, wrench_noise
from rov_ident.estimation.shared import (
    FASTEST,
    LAG,
    RELEARNING_TIME,
    WALK_PERIOD,
    Problem,
    add_scatter,
    begin,
    excited,
    folded,
    measure,
    problem_of,
    steps_of,
    thrust_of,
    wrench_of,
)
from rov_ident.estimation.square_root import cholesky, cholesky_solve, multiply
from rov_ident.estimation.thrust_coordinates import jacobian_of, take_thrust, values_of
from rov_ident.estimation.wrench_residual import filtered_residual
from rov_ident.model.coefficients import EXTENDED_SIZE
from rov_ident.model.equations import (
    add_added_mass,
    extend_inputs,
    generalized_force,
    symmetric_product,
)

USED, RESTARTED, GATED, NOT_FINITE, REPAIRED, UNPREDICTABLE = range(6)
REASONS = (
    "used", "restarted after a gap", "outlier", "not finite", "covariance repaired",
    "no model moves so",
)  # fmt: skip
REFUSALS = (GATED, NOT_FINITE, REPAIRED, UNPREDICTABLE)

LANES = 32  # sigma points side by side: with half as many their loops would not be vectorised
KNOWN = 1e-12  # (rad/s)2; of a rate that is guided: as good as none, for the root to exist
_PERIOD = 0.2  # s; the innovations' influence is summed and the coefficients walk this often
_ROOM = 1.5  # for innovation_monitor.watch ("Constants of the process noise" in docs/choices.md)

# square root of the state's size + lambda (van der Merwe 2004), weight of an outer sigma point,
# beta - alpha^2; gate, NIS from which the vehicle has changed; corner of the residual [rad/s]
_SETTINGS = record(floats((), "spread weight centre gate changed corner"))
# s; since innovations were summed up, since the coefficients walked
_SCALARS = record(
    [
        *floats((), "t since since_walk"),
        ("started", "?"),
        ("pinned", "?"),  # sigma points are taken about State.about
    ]
)


class State(NamedTuple):
    """All that the next step needs."""

    x: Array  # (6 + n,)
    p: Array  # (6 + n, 6 + n)
    residual: Array  # (4, 6): stage 1, stage 2, last input, last momentum of the published residual
    monitor: NDArray[np.void]  # (6,) of MONITOR: of the innovations
    score: Array  # (n, n): covariance of the summed influence of the innovations, and of the prior
    lagged: Array  # (n,): that influence of late, under the lag window
    before: Array  # (n,): xi when it was last summed
    about: Array  # (n,): xi that sigma points are taken about while it is pinned
    by_axis: Array  # (6 + n, q): what x is wrong by if the thrust of one of q axes is off
    scalars: NDArray[np.void]  # (1,)


def problem(config: Config) -> Problem:
    """The constants of the estimation that a configuration asks for."""
    u = config.ukf
    reach = u.alpha**2 * (6 + len(prior_of(config, effects=True).names) + u.kappa)
    task = problem_of(
        config, _SETTINGS, spread=np.sqrt(reach), weight=0.5 / reach, centre=u.beta - u.alpha**2,
        gate=u.gate, changed=u.change_threshold,
    )  # fmt: skip
    return task._replace(drift=task.drift + (u.random_walk * task.start) ** 2 / 3600.0)


def init(task: Problem) -> State:
    """Nothing learnt: the prior; the velocity is taken from the first measurement."""
    n = len(task.scale)
    # of the prior, a unit matrix for the coefficients themselves
    jacobian = jacobian_of(task, np.zeros(n))
    p = np.eye(6 + n)
    p[6:, 6:] = np.linalg.inv(jacobian.T @ jacobian)
    return State(
        np.concatenate([np.zeros(6), task.start]),
        p,
        np.zeros((4, 6)),
        first_monitor(task.process),
        jacobian.T @ jacobian,
        np.zeros(n),
        task.start.copy(),
        task.start.copy(),
        np.zeros((6 + n, len(task.axis_std))),
        np.zeros(1, dtype=_SCALARS),
    )


def fold(task: Problem, state: State, samples: NDArray[np.void]) -> tuple[State, NDArray[np.void]]:
    """:func:`step` over samples (k,) of SAMPLE; info (k,) of INFO. The given state is unchanged."""
    return folded(_fold, task, state, samples)


def fold_about(
    task: Problem, state: State, samples: NDArray[np.void], solution: Array
) -> State | None:
    """:func:`fold` with sigma points about one solution (n,); None if the velocities run away."""
    pinned = state.scalars.copy()
    pinned["pinned"] = True
    state, info = fold(task, state._replace(about=solution.copy(), scalars=pinned), samples)
    state.scalars["pinned"] = False
    return None if (info["reason"] == UNPREDICTABLE).any() else state


def step(task: Problem, state: State, sample: NDArray[np.void]) -> tuple[State, NDArray[np.void]]:
    """One sample (1,) of SAMPLE; the next state and what happened (1,) of INFO."""
    assert len(sample) == 1
    return fold(task, state, sample)


def estimate(task: Problem, state: State, prior: Prior) -> Estimate:
    """Coefficients and covariance (n, n), calibrated for coloured residuals, in their own units."""
    deviation = state.x[6:] - task.start
    unit = task.scale[:, None] * jacobian_of(task, deviation)
    return Estimate(
        prior.names,
        values_of(task, deviation),
        unit @ calibrated(state.p[6:, 6:], state.score) @ unit.T,
        float(state.scalars["t"][0]),
        unit @ state.by_axis[6:],
    )


def solution_of(state: State) -> tuple[Array, Array]:
    """The coordinates and their standard deviations, both (n,)."""
    return state.x[6:], np.sqrt(np.diag(state.p)[6:])


def about_of(state: State) -> Array:
    """The coordinates (n,) that the next sigma points are taken about."""
    return state.x[6:]


def variance(task: Problem, state: State) -> Array:
    """Variances (n,) of the filter, in squared units: what excitation is judged by."""
    unit = task.scale[:, None] * jacobian_of(task, state.x[6:] - task.start)
    variances: Array = np.sum((unit @ state.p[6:, 6:]) * unit, axis=1)
    return variances


def condition(task: Problem, state: State) -> float:
    """Condition number of the information's root as `condition` has it."""
    return float(np.sqrt(np.linalg.cond(state.p[6:, 6:], 1)))


# ------------------------------------------------------------------ kernels

_SCRATCH = record(
    [
        # sigma points, and the forces on them; "push" is the wrench that parameters of effects add
        *floats((6, LANES), "nu h stage nu_dot total push"),
        *floats((6, 6, LANES), "mass inverse"),  # of the inverse the lower half
        *floats((EXTENDED_SIZE, LANES), "extended"),
        *floats((LANES,), "rho"),
        ("centre_inverse", "f8", (6, 6)),
        # nu of the centre point, mean minus centre; wrench minus restoring in mid-interval, and its
        # slope; variance density of the wrench; nu as measured, its variance
        # nu_dot of components that are guided, zero for the others
        *floats((6,), "centre shift force slope strength z r guide"),
        *floats((6,), "wrench thrust"),  # of the estimate
        *floats((6, 1), "one_nu one_h"),
        *floats((6, 6, 1), "one_mass"),
        *floats((EXTENDED_SIZE, 1), "one_extended"),
    ]
)


Work = namedtuple(
    "Work",
    "p upper root moved cross gain block free moves noisy theta mean centre pull line scratch",
)
"""Scratch for all samples of a fold. Zeros fill the rows of matrices to a multiple of LANES."""


@inlined
def _work(task, state):
    size, m = len(state.x), len(task.theta)
    columns = LANES * (size // LANES + 1)
    work = Work(
        np.zeros((size, columns)),  # the covariance
        np.zeros((size, columns)),
        np.zeros((size, columns)),  # lower root of p; a column of zeros is the centre point
        np.empty((2, 6, columns)),  # nu of the points on the + and - side of each column
        np.zeros((3, columns)),
        np.zeros((3, columns)),
        np.zeros((3, size - 6, columns)),  # for the covariance of the coefficients alone
        np.zeros(columns),  # 1 where a state is estimated, 0 where it is only considered
        np.empty(m, dtype=np.bool_),
        np.empty(6, dtype=np.bool_),
        np.empty((m, LANES)),
        np.empty((m, 1)),
        np.empty(size),  # what sigma points are taken about
        np.zeros(columns),  # P_xi^-1 (xi - what they are taken about)
        np.empty(size),
        np.empty(1, dtype=_SCRATCH),  # in one record, whose parts the compiler knows apart
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
    _take_mean(task, state, work)
    return work


@kernel
def _fold(task, state, samples, sides, info):
    work = _work(task, state)
    _steps(task, state, work, samples, sides, info)
    copy(work.p, state.p)


@inner
def _steps(task, state, work, samples, sides, infos):
    """The fold itself, apart from what makes its arrays (:func:`rov_ident.core.jit.lean`)."""
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
                state.monitor[i].nis = 1.0
            info.reason = RESTARTED
        else:
            _guide(state, work, sample)
            _take_root(work, info)
            _take_centre(state, work)
            _predict(task, work.centre, work, sample, side)
            if not _collect(task, state, work, sample):
                info.reason = UNPREDICTABLE
                c.started = False
                continue
            _move_by_axis(task, state, work, sample, side)
            inverse = work.scratch[0].centre_inverse
            excited(task, sample.moving, sample, state.monitor, inverse, work.noisy, work.moves)
            for i in range(len(state.x)):
                work.free[i] = 1.0 if i < 6 or work.moves[task.estimated[i - 6]] else 0.0
            _update(task, state, work, sample, side, info)
            _end_period(task, state, work, sample.dt)
        _residual(task, state, work, sample, side, info)


@inner
def _restart(state, p, sample):
    """The velocity is lost, the coefficients are not: begin from the measurement."""
    for i in range(6):
        for j in range(len(state.x)):
            p[i, j] = 0.0
            p[j, i] = 0.0
        state.x[i] = sample.nu[i]
        for q in range(state.by_axis.shape[1]):
            state.by_axis[i, q] = 0.0
        variance = sample.odometry_variance[i]
        p[i, i] = variance if variance < 1.0 else 1.0
        interrupt(state.monitor[i])
        state.monitor[i].outliers = 0
    state.scalars[0].started = True


# ---------------------------------------------------------------- prediction


@inlined
def _guide(state, work, sample):
    """Where nothing is known of the moments, rates are as good as known, and go as measured."""
    x = state.x
    for i in range(6):
        work.scratch[0].guide[i] = 0.0
        if is_guided(sample) and i >= 3:
            work.scratch[0].guide[i] = (sample.nu[i] - x[i]) / sample.dt
            for j in range(len(x)):
                work.p[i, j] = work.p[j, i] = 0.0
            work.p[i, i] = KNOWN
            for q in range(state.by_axis.shape[1]):
                state.by_axis[i, q] = 0.0


@inlined
def _take_root(work, out):
    """work.root of work.p, which is repaired where rounding has made a direction negative."""
    p, size = work.p, len(work.p)
    for attempt in range(3):
        if cholesky(p, work.upper, work.root):
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


@inlined
def _take_centre(state, work):
    """work.centre, the velocities for the coefficients that it has: those of the estimate, or those
    that are pinned."""
    x, pull, n = state.x, work.pull, len(state.about)
    for i in range(len(x)):
        work.centre[i] = x[i]
    for j in range(n):
        pull[j] = 0.0
    if not state.scalars[0].pinned:
        return
    if not _take_block_root(work, n):
        return
    for j in range(n):
        work.centre[6 + j] = state.about[j]
        pull[j] = x[6 + j] - state.about[j]
    cholesky_solve(work.block[2], n, pull)
    for i in range(6):
        for j in range(n):
            work.centre[i] -= work.p[i, 6 + j] * pull[j]


@inlined
def _take_block_root(work, n):
    """work.block[2], the root of the covariance of the coefficients (n, n), which is copied to
    work.block[0]; False where it has none."""
    for j in range(n):
        for k in range(n):
            work.block[0, j, k] = work.p[6 + j, 6 + k]
    return cholesky(work.block[0], work.block[1], work.block[2])


@inlined
def _predict(task, x, work, sample, side):
    """Move the sigma points to the sample's time: work.moved, and the centre's inverse mass."""
    s, spread, columns = work.scratch[0], task.settings[0].spread, work.root.shape[1]
    force_of(sample, sample.wrench, task.restoring, s.force, s.slope)
    extend_inputs(LANES, task.structure, sample.inputs[0], s.extended)
    steps, guided = steps_of(sample.dt), is_guided(sample)
    dt = sample.dt / steps
    for sign in range(2):
        for first in range(0, columns, LANES):
            _spread(task, x, work, first, spread if sign == 0 else -spread)
            if guided:
                invert_translation(LANES, s.mass, task.lightest, s.inverse)
            else:
                invert_mass(LANES, s.mass, task.lightest, s.inverse)
            _add_effect_wrench(task, work, side, guided)
            for k in range(steps):
                _propagate(task.structure, work, k * dt - 0.5 * sample.dt, dt, guided)
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
    take_thrust(LANES, task, theta, s.rho)
    for i in range(6):
        for k in range(LANES):
            s.mass[i, i, k] = task.rigid_body[i, i]
    for c in range(len(structure.mass_row)):
        i, j = structure.mass_row[c], structure.mass_column[c]
        for k in range(LANES):
            s.mass[i, j, k] = task.rigid_body[i, j]
            s.mass[j, i, k] = task.rigid_body[i, j]
    add_added_mass(structure, theta, s.mass)


@inlined
def _add_effect_wrench(task, work, side, guided):
    """What parameters of effects, and guided rates, add to the wrench on the sigma points."""
    s, first = work.scratch[0], len(task.theta) - side.shape[1]
    for i in range(6):
        for k in range(LANES):
            s.push[i, k] = 0.0
        for j in range(3, 6 if guided else 3):
            for k in range(LANES):
                s.push[i, k] -= s.mass[i, j, k] * s.guide[j]
        for j in range(side.shape[1]):
            for k in range(LANES):
                s.push[i, k] += side[i, j] * (work.theta[first + j, k] - side[12, j])


@reordered
def _propagate(structure, work, late, dt, guided):
    """One Runge-Kutta step of the sigma points, beginning ``late`` seconds after mid-interval."""
    s = work.scratch[0]
    nu, reached, h, force, slope, push = s.nu, s.stage, s.h, s.force, s.slope, s.push
    for i in range(6):
        for k in range(LANES):
            reached[i, k] = nu[i, k]
            s.total[i, k] = nu[i, k]
    for stage in range(4):
        generalized_force(LANES, structure, s.mass, work.theta, reached, h, s.extended)
        at = late + NODES[stage] * dt
        a, b, c = force[0] + at * slope[0], force[1] + at * slope[1], force[2] + at * slope[2]
        d, e, f = force[3] + at * slope[3], force[4] + at * slope[4], force[5] + at * slope[5]
        for k in range(LANES):
            rest = (
                a + push[0, k] - h[0, k], b + push[1, k] - h[1, k], c + push[2, k] - h[2, k],
                d + push[3, k] - h[3, k], e + push[4, k] - h[4, k], f + push[5, k] - h[5, k],
            )  # fmt: skip
            nu_dot = symmetric_product(s.inverse, rest, k)
            for i in range(6):
                s.nu_dot[i, k] = nu_dot[i]
        for i in range(3, 6 if guided else 3):
            for k in range(LANES):
                s.nu_dot[i, k] = s.guide[i]
        for i in range(6):
            runge_kutta(stage, dt, nu[i], s.nu_dot[i], reached[i], s.total[i])
    for i in range(6):
        for k in range(LANES):
            nu[i, k] = s.total[i, k]


@reordered
def _collect(task, state, work, sample):
    """Mean and covariance of the moved points: of nu, and of nu with the coefficients.

    False where the model takes a point out of all reason.
    """
    s, c = work.scratch[0], task.settings[0]
    x, p, root, plus, minus = state.x, work.p, work.root, work.moved[0], work.moved[1]
    size, columns = p.shape
    doubtful, guided = wrench_noise(task.process[0], sample, s.strength), is_guided(sample)
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
            noise = state.monitor[i].density if i == j and not (guided and i >= 3) else 0.0
            for a in range(6):
                noise += s.centre_inverse[i, a] * s.centre_inverse[j, a] * s.strength[a]
            # the last one stays: of the axis itself
            state.monitor[i].acting = 0.0 if doubtful else noise
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
    for i in range(6):  # from what they were taken about to the estimate
        for j in range(size - 6):
            x[i] += p[i, 6 + j] * work.pull[j]
    return True


@reordered
def _move_by_axis(task, state, work, sample, side):
    """State.by_axis to the sample's time. With L the root of the covariance before, the sigma
    points have left ``F L`` in the place of their velocities (:func:`_collect`)."""
    s, by_axis, root = work.scratch[0], state.by_axis, work.root
    moved, line = work.moved[0], work.line
    thrust_of(task, work.mean, sample, side, s.wrench, s.thrust)
    for axis in range(by_axis.shape[1]):
        wrong = sample.dt * task.axis_std[axis] * s.thrust[axis]
        for i in range(len(line)):
            total = by_axis[i, axis]
            for j in range(i):
                total -= root[i, j] * line[j]
            line[i] = total / root[i, i]
        for i in range(6):
            total = -wrong * s.centre_inverse[i, axis]
            for j in range(len(line)):
                total += moved[i, j] * line[j]
            by_axis[i, axis] = total


# ---------------------------------------------------------------- update


@inlined
def _update(task, state, work, sample, side, out):
    """Linear and angular velocity, each behind its own gate."""
    s, scratch = task.settings[0], work.scratch[0]
    x, p, z, r = state.x, work.p, scratch.z, scratch.r
    measure(sample, z, r)
    moving, anew, noisy = False, False, False
    for i in range(6):
        noisy |= work.noisy[i]
        for j in range(side.shape[1]):
            z[i] += side[6 + i, j] * side[12, j]
        moving |= sample.moving[i] != 0
        if is_guided(sample) and i >= 3:
            z[i] = np.nan
        else:
            state.monitor[i].since += sample.dt
    for first in (0, 3):
        if not np.isfinite(z[first] + z[first + 1] + z[first + 2]):
            continue
        outlier = False
        for i in range(first, first + 3):
            predicted, spread = _predicted_measurement(task, x, p, side, i)
            spread += r[i]
            innovation = (z[i] - predicted) / np.sqrt(spread)
            considered = 0.0
            for j in range(6 + len(task.scale) - side.shape[1], len(x)):
                if work.free[j] == 0.0:
                    considered += p[i, j] * p[i, j] / (p[j, j] * spread)
            out.nis[i] = innovation**2
            own, ratio = sample.moving[i] != 0, 1.0
            if work.noisy[i]:
                ratio = np.sqrt(spread / _given_held(task, p, work.free, side, i, spread, r[i]))
            outlier |= watch(
                state.monitor[i], task.process[0], i, _ROOM, moving, own, ratio * s.gate,
                ratio * innovation, np.sqrt(considered),
            )  # fmt: skip
        anew |= lost(state.monitor, first, outlier)
        if outlier:
            out.reason = GATED
        elif noisy:
            _absorb_beside_noise(task, state, work, side, first)
        else:
            _absorb(task, state, work, side, first)
    if anew:
        _restart(state, p, sample)


@inlined
def _given_held(task, p, free, side, i, spread, least):
    """The variance of an innovation, of ``spread`` in all, given the coefficients that are held:
    what noise of the wrench's reading does must not pass for their uncertainty, or it would seem
    that the vehicle follows it. Not below ``least``."""
    left = spread
    for j in range(6, 6 + len(task.scale) - side.shape[1]):
        if free[j] == 0.0:
            left -= p[i, j] * p[i, j] / p[j, j]
    return max(left, least)


@inlined
def _seen(task, side, i, x):
    """What the measurement of velocity i is of x (6 + n,), effects on it included."""
    seen, scale = x[i], len(task.scale) - side.shape[1]
    for j in range(side.shape[1]):
        seen += side[6 + i, j] * task.scale[scale + j] * x[6 + scale + j]
    return seen


@inlined
def _predicted_measurement(task, x, p, side, i):
    """The predicted measurement of velocity i, effects on it included, and its variance."""
    spread, k = p[i, i], side.shape[1]
    first, scale = len(x) - k, len(task.scale) - k
    for j in range(k):
        f = side[6 + i, j] * task.scale[scale + j]
        spread += 2.0 * f * p[i, first + j]
        for l in range(k):
            spread += f * side[6 + i, l] * task.scale[scale + l] * p[first + j, first + l]
    return _seen(task, side, i, x), spread


@inlined
def _correct_by_axis(task, by_axis, side, i, gain, share):
    """State.by_axis after a measurement of velocity i, with the gain (6 + n,) times ``share``."""
    for q in range(by_axis.shape[1]):
        wrong = share * _seen(task, side, i, by_axis[:, q])
        for j in range(len(by_axis)):
            by_axis[j, q] -= gain[j] * wrong


@reordered
def _absorb(task, state, work, side, first):
    """Take in three measured velocities, from ``first`` on, one after the other.

    With w the covariance with the innovation over its standard deviation, p loses w w', but for the
    block of the states that are only considered: they tell nothing of one another.
    """
    x, p, cross, gain, free = state.x, work.p, work.cross, work.gain, work.free
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
            f = _seen(task, side, i, cross[b])
            for k in range(columns):
                cross[c, k] -= f * cross[b, k]
        f = 1.0 / np.sqrt(_seen(task, side, i, cross[c]) + s.r[i])
        innovation = f * (s.z[i] - _seen(task, side, i, x))
        for k in range(columns):
            cross[c, k] *= f
            gain[c, k] = cross[c, k] * free[k]
        for j in range(size):
            x[j] += gain[c, j] * innovation
        _correct_by_axis(task, state.by_axis, side, i, gain[c], f)
    for i in range(size):
        w = cross if free[i] != 0.0 else gain
        f, g, h = cross[0, i], cross[1, i], cross[2, i]
        for k in range(columns):
            p[i, k] -= f * w[0, k] + g * w[1, k] + h * w[2, k]


@reordered
def _absorb_beside_noise(task, state, work, side, first):
    """The same where noise of the wrench's reading is too large on some axis, which holds the scale
    of the thrust.

    Coefficients are nearly proportional to that: to gain as if its error were noise, which it is in
    no two measurements alike, would hardly teach them. So they are learnt given the scale, as RLS
    does it, and what shapes the thrust (a lag), which would smooth the noise away, from the other
    axes. For a gain k that is not the best, and w the covariance with the innovation of variance v,
    p loses ``k w' + w k' - v k k'`` (Joseph's form).
    """
    x, p, w, k, free = state.x, work.p, work.cross[0], work.gain[0], work.free
    s, size = work.scratch[0], p.shape[0]
    last, scale = size - side.shape[1], 6 + task.thrust
    given = task.thrust >= 0 and free[scale] == 0.0
    for i in range(first, first + 3):
        predicted, v = _predicted_measurement(task, x, p, side, i)
        v += s.r[i]
        for a in range(size):
            w[a] = _seen(task, side, i, p[:, a])
        share = w[scale] / p[scale, scale] if given else 0.0
        left = v - share * w[scale] if given else v
        for a in range(size):
            k[a] = free[a] * (w[a] - share * p[scale, a]) / left
        for j in range(side.shape[1]):
            if work.noisy[i] and not (task.absolute[j] or task.scaled[j, i]):
                k[last + j] = 0.0
        for a in range(size):
            x[a] += k[a] * (s.z[i] - predicted)
        _correct_by_axis(task, state.by_axis, side, i, k, 1.0)
        for a in range(size):
            for b in range(a + 1):
                p[a, b] -= k[a] * w[b] + w[a] * k[b] - v * k[a] * k[b]
                p[b, a] = p[a, b]


# ---------------------------------------------------------------- once a period


@inlined
def _end_period(task, state, work, dt):
    """Every _PERIOD: sum up what innovations did to the coefficients, and let these walk."""
    c = state.scalars[0]
    c.since += dt
    if c.since < _PERIOD:
        return
    _sum_up(state, work, c.since)
    changed = False
    for i in range(6):
        changed |= has_changed(state.monitor[i], task.settings[0].changed)
    c.since_walk += c.since
    if changed or c.since_walk >= WALK_PERIOD:
        relearnt = min(c.since / RELEARNING_TIME, 1.0) if changed else 0.0
        _walk(task, state, work, relearnt, c.since_walk)
        c.since_walk = 0.0
    c.since = 0.0


@reordered
def _sum_up(state, work, since):
    """With ``change = P g``, g is what innovations have added to the information's right side."""
    n, g = len(state.before), work.gain[0]
    if not _take_block_root(work, n):
        return
    for j in range(n):
        g[j] = state.x[6 + j] - state.before[j]
        state.before[j] = state.x[6 + j]
    cholesky_solve(work.block[2], n, g)
    add_scatter(g, np.exp(-since / LAG), state.score, state.lagged)


@reordered
def _walk(task, state, work, relearnt, elapsed):
    """Variances grow by G, less and less up to the prior's; the sandwich P S P grows alike.

    ``relearnt`` is the share of what they are short of the prior's that each grows by at least.

    Hence with ``W = P_new^-1 G``, ``S_new = (1 - W) S (1 - W)' + W P_new^-1``.
    """
    n, p, grown, most = len(state.before), work.p, work.cross[0], 0.0
    matrix, inverse, root = work.block[0], work.block[1], work.block[2]
    for j in range(n):
        share = max(task.drift[j] * elapsed, relearnt)
        grown[j] = share * max(1.0 - p[6 + j, 6 + j], 0.0)
        most = max(most, grown[j])
    if most == 0.0:
        return
    for j in range(n):
        p[6 + j, 6 + j] += grown[j]
    if not _take_block_root(work, n):
        return
    score, lagged = state.score, state.lagged
    for j in range(n):
        for k in range(n):
            inverse[j, k] = 1.0 if j == k else 0.0
        cholesky_solve(root, n, inverse[j])
    # T = 1 - W, then T S into matrix, then T S T' + W P_new^-1
    for j in range(n):
        for k in range(n):
            root[j, k] = (1.0 if j == k else 0.0) - inverse[j, k] * grown[k]
    multiply(root, score, n, matrix)
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


# ---------------------------------------------------------------- residual


@inner
def _take_mean(task, state, work):
    """work.mean (m, 1): all coefficients, of the present estimate."""
    for j in range(len(task.scale)):
        work.mean[task.estimated[j], 0] = task.scale[j] * state.x[6 + j]
    take_thrust(1, task, work.mean, work.scratch[0].rho)


@inlined
def _residual(task, state, work, sample, side, out):
    """Wrench, measured minus model at the present mean, low-passed like the RLS regression."""
    s, theta, mass = work.scratch[0], work.mean, work.scratch[0].one_mass
    _take_mean(task, state, work)
    wrench_of(theta, sample, side, s.wrench)
    for i in range(6):
        for j in range(6):
            mass[i, j, 0] = task.rigid_body[i, j]
    add_added_mass(task.structure, theta, mass)
    restarted = out.reason == RESTARTED
    filtered_residual(task, theta, s, state.residual, sample, restarted, out.residual)
