"""What the two recursive estimators share beside their process noise and the published residual."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.config.prior import (
    THRUST_SCALE,
    axis_std_of,
    drift_of,
    moves_with_thrust,
    prior_of,
    theta_of,
)
from rov_ident.core.jit import inlined, inner, lean, record
from rov_ident.core.messages import Array
from rov_ident.effects import EFFECTS, parameter
from rov_ident.estimation.innovation_monitor import TIME
from rov_ident.estimation.process_noise import process
from rov_ident.model.coefficients import AXES
from rov_ident.model.equations import Structure, in_motion
from rov_ident.sampling.sample import parts
from rov_ident.sampling.wrench_scatter import RECENT

MAX_STEP = 0.05  # s; of one step of the prediction
LIGHTEST = 0.2  # of the rigid body's own inertia: no model that is tried is lighter
FASTEST = 50.0  # m/s, rad/s; no sane model gets there
LAG = 4.0  # s; of the window over the score's correlation
RELEARNING_TIME = 20.0  # s; after a change: coefficients become as uncertain as at first
WALK_PERIOD = 1.0  # s; parameters that change by themselves gain variance this often
REACH = 10.0  # prior standard deviations, which no coefficient is off; for RLS's observer alone

# of what looks like noise of the reading, below which the vehicle follows it ("Noise of the
# wrench's reading" in docs/choices.md)
FOLLOWED = 0.1

INFO = record(
    [
        ("t", "f8"),
        ("reason", "i8"),  # index into the estimator's REASONS
        ("residual", "f8", (6,)),  # N, N m: filtered wrench, measured minus model
        ("nis", "f8", (6,)),  # normalised innovation squared: 1 in the mean is expected
        ("forgetting", "f8"),
        ("condition", "f8"),  # as of condition(), before the sample; NaN: not looked at
    ]
)
"""What happened to a sample."""


class Problem(NamedTuple):
    """What does not change from sample to sample."""

    settings: NDArray[np.void]  # (1,) of the estimator's own record
    process: NDArray[np.void]  # (1,) of PROCESS
    structure: Structure
    estimated: NDArray[np.int64]  # (n,) indices into theta
    theta: Array  # (m,) values of all coefficients: the prior of the estimated, the held others;
    # behind them the estimated parameters of effects
    scale: Array  # (n,) prior standard deviations
    start: Array  # (n,) prior means over those
    reach: Array  # (n,) scaled deviation that they are not off by, either way
    highest: Array  # (n,) scaled deviation that the coefficients of RLS's observer do not exceed,
    # and the thrust scale of neither estimator
    drift: Array  # (n,) variance density of the random walk of scaled parameters, 1/s
    rigid_body: Array  # (6, 6)
    restoring: Array  # (6, 3)
    thrust: int  # index of thrust_scale.scale among the estimated; -1: it is not
    per_thrust: NDArray[np.bool_]  # (n,) what is proportional to the thrust in the same motion
    axis_std: Array  # (6,) or (0,): `config.prior.axis_std_of`
    absolute: NDArray[np.bool_]  # (k,) parameters of effects that are none of the thrust
    scaled: NDArray[np.bool_]  # (k, 6) parameters of effects that are factors of these components
    lightest: Array  # (6,) least pivots of a mass matrix: no hull with added mass is touched


def problem_of(config: Config, record: np.dtype[np.void], **settings: Any) -> Problem:
    """The constants that a configuration asks for; ``settings`` are the fields of ``record``."""
    body, structure, prior = config.dynamics.body, config.dynamics.structure, prior_of(config, True)
    values = np.zeros(1, dtype=record)
    for name, value in {**settings, "corner": config.residual_corner}.items():
        values[name] = value
    start = prior.mean / prior.std
    names, mean = prior.names, dict(zip(prior.names, prior.mean, strict=True))
    thrust = names.index(THRUST_SCALE) if mean.get(THRUST_SCALE, 0.0) > 0.0 else -1
    per_thrust = [thrust >= 0 and moves_with_thrust(name) for name in names]
    highest = np.where(prior.negative, np.minimum(-start, REACH), REACH)
    if thrust >= 0:  # of the coordinate, where the scale is at its bound (`thrust_coordinates`)
        s0 = mean[THRUST_SCALE]
        bound = start[thrust] * (1.0 - s0 / prior.upper[thrust])
        highest[thrust] = min(highest[thrust], bound)
    absolute = [EFFECTS[effect].act is None for effect, _ in config.estimate_effects]
    return Problem(
        values,
        process(config),
        structure,
        prior.estimated,
        theta_of(config),
        prior.std,
        start,
        np.full(len(start), REACH),
        highest,
        drift_of(config, prior.names),
        body.mass_matrix,
        body.restoring,
        thrust,
        np.array(per_thrust, dtype=bool),
        axis_std_of(config, names),
        np.array(absolute, dtype=bool),
        factors_of(config),
        LIGHTEST * np.diag(np.linalg.cholesky(body.mass_matrix)) ** 2,
    )


def factors_of(config: Config) -> NDArray[np.bool_]:
    """(k, 6): of which components of the thrust each estimated parameter of effects is a factor."""
    factors = np.zeros((len(config.estimate_effects), 6), dtype=bool)
    for k, (effect, own) in enumerate(config.estimate_effects):
        if "factor" in EFFECTS[effect].traits:
            axis = parameter(effect, own).axis
            factors[k, AXES.index(axis) if axis else slice(None)] = True
    return factors


def informative_axes(config: Config) -> NDArray[np.bool_]:
    """(n, 6): the axes from which each estimated coefficient or factor of the thrust is learnt, and
    from no other than all of these; none of other parameters of effects."""
    structure = config.dynamics.structure
    rows = np.concatenate([structure.mass_row, structure.row])
    on_axis = np.zeros((len(rows), 6), dtype=bool)
    on_axis[np.arange(len(rows)), rows] = True
    on_axis[np.arange(len(structure.mass_row)), structure.mass_column] = True
    return np.vstack([on_axis[prior_of(config).estimated], factors_of(config)])


def too_noisy(axes: NDArray[np.bool_]) -> str:
    """Why something is not learnt, and what to do, from the noisy axes (6,)."""
    names = " ".join(name for name, noisy in zip(AXES, axes, strict=True) if noisy)
    return (
        f"noise of the wrench's reading is not far below the wrench on {names}: drive harder "
        "there, or feed the command instead of what thrusters report"
    )


def noisy_axes(mass: Array, reading_noise: Array, monitor: NDArray[np.void]) -> NDArray[np.bool_]:
    """(6,) on which axes noise of the wrench's reading is known to be too large to learn from, as
    :func:`excited` decides it; ``mass`` (6, 6), ``monitor`` (6,) of MONITOR."""
    noise = np.diag(np.linalg.inv(mass)) ** 2 * reading_noise
    follows = (monitor["seen"] > TIME) & (monitor["density"] <= FOLLOWED * noise)
    return (noise > 0.0) & (noise < np.inf) & ~follows


@lean
def excited(task, moving, sample, monitor, inverse, noisy, moves):
    """Set moves (m,): which entries of theta the motion excites. Work space: noisy (6,).

    A coefficient is excited by axes that are ``moving`` (6,), well above the noise of their sensor,
    and on which the wrench is surely far above the noise of its reading; a factor of the thrust if
    that is so on all axes that it scales. What looks like noise may be a command that trembles, and
    which the vehicle follows: then the unexplained acceleration, once ``monitor`` (6,) of MONITOR
    knows it, is far below it. ``inverse`` (6, 6) is that of the mass matrix.
    """
    for i in range(6):
        noise = inverse[i, i] ** 2 * sample.reading_noise[i]
        follows = monitor[i].seen > TIME and monitor[i].density <= FOLLOWED * noise
        noisy[i] = 0.0 < noise < np.inf and not follows
    structure = task.structure
    in_motion(structure, moving, moves)
    first, rows = len(structure.mass_row), structure.row
    for c in range(first):
        if noisy[structure.mass_row[c]] or noisy[structure.mass_column[c]]:
            moves[c] = False
    for term in range(len(rows)):
        if noisy[rows[term]]:
            moves[first + term] = False
    first += len(rows)
    for e in range(first, len(moves)):
        moves[e] = True
        for i in range(6):
            # not known yet, unless another has learnt before
            unknown = sample.reading_noise[i] == np.inf and monitor[i].seen <= RECENT
            if task.scaled[e - first, i] and (noisy[i] or unknown):
                moves[e] = False


_State = TypeVar("_State", bound=tuple[Any, ...])


def folded(
    kernel: Callable[..., None], task: Problem, state: _State, samples: NDArray[np.void]
) -> tuple[_State, NDArray[np.void]]:
    """A ``kernel`` of either estimator over samples (k,) of SAMPLE; info (k,) of INFO. The given
    state is unchanged."""
    state = type(state)(*(part.copy() for part in state))
    info = np.zeros(len(samples), dtype=INFO)
    kernel(task, state, *parts(samples), info)
    return state, info


@inner
def begin(info, sample):
    """Reset the info of a sample; whether all that an estimator reads of it is finite.

    NaN for what was not measured is allowed.
    """
    info.t = sample.t
    info.forgetting = 1.0
    info.condition = np.nan
    for i in range(6):
        info.residual[i] = np.nan
        info.nis[i] = np.nan
    total = sample.t + sample.dt
    for i in range(6):
        total += sample.nu[i] + sample.wrench[i] + sample.wrench_slope[i]
    for i in range(3):
        total += sample.down[i] + sample.down_slope[i]
    for i in range(sample.inputs.shape[1]):
        total += sample.inputs[0, i] + sample.inputs[1, i]
    return np.isfinite(total)


@inlined
def measure(sample, z, r):
    """Measured velocities z (6,), NaN where there is none, and their variances r (6,).

    Where there is a gyro, the odometry's own rates are not used: mostly they are the same gyro.
    """
    for i in range(6):
        z[i], r[i] = sample.odometry[i], sample.odometry_variance[i]
        if i >= 3 and np.isfinite(sample.gyro[i - 3]):
            z[i], r[i] = sample.gyro[i - 3], sample.gyro_variance
        if not (np.isfinite(z[i]) and np.isfinite(r[i])):
            z[i] = np.nan


@inlined
def wrench_of(theta, sample, side, wrench):
    """wrench (6,) that acts, with the parameters of effects, the last of theta (m, 1), as they are.

    ``side`` (13, k) is how the sample depends on these (:func:`rov_ident.sampling.sample.parts`).
    """
    k = side.shape[1]
    first = len(theta) - k
    for i in range(6):
        wrench[i] = sample.wrench[i]
        for j in range(k):
            wrench[i] += side[i, j] * (theta[first + j, 0] - side[12, j])


@inlined
def thrust_of(task, theta, sample, side, wrench, thrust):
    """wrench (6,) as :func:`wrench_of` has it, and what of it is thrust (6,)."""
    first = len(theta) - side.shape[1]
    wrench_of(theta, sample, side, wrench)
    for i in range(6):
        thrust[i] = wrench[i] - sample.surroundings[i]
        for j in range(side.shape[1]):
            if task.absolute[j]:
                thrust[i] -= side[i, j] * (theta[first + j, 0] - side[12, j])


@inlined
def drive_sides(first, estimated, scale, side, drive):
    """The columns of drive (6, n) of parameters of effects, which are theta from ``first`` on."""
    if side.shape[1] > 0:
        for a in range(len(estimated)):
            if estimated[a] >= first:
                for i in range(6):
                    drive[i, a] = scale[a] * side[i, estimated[a] - first]


@inlined
def steps_of(dt):
    """Into how many steps an interval is divided."""
    return max(1, int(np.ceil(dt / MAX_STEP - 1e-9)))


@inlined
def add_scatter(score, fade, total, lagged):
    """Add to the covariance total (n, n) of a summed score what one more of it, (n,), adds, its
    correlation in time included.

    With an exponential lag window (Newey and West 1987): ``lagged`` (n,) is the sum of those before
    it, which fades by the factor ``fade`` from one to the next.
    """
    n = len(lagged)
    for a in range(n):
        lagged[a] *= fade
    for a in range(n):
        for b in range(n):
            total[a, b] += score[a] * (score[b] + lagged[b]) + lagged[a] * score[b]
    for a in range(n):
        lagged[a] += score[a]
