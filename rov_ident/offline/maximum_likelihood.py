"""Maximum likelihood from a record: output error, and with the wrench's own noise, innovations.

The motion is simulated from the thruster wrench; its error against the measured velocities has the
cost (Zhao et al. 2018, sec. 2; Ljung 1999, sec. 7.4)::

    J(theta) = sum over measurements of  e^2 / s + ln s

minimised by Newton and Raphson with the Gauss-Newton Hessian. Where the wrench is taken as exact,
``e`` is the output error and ``s = R`` follows from the residuals. A measured wrench has errors of
its own, which the velocity integrates: then a Kalman filter over the velocity, driven by the same
equations of motion, turns the output errors into independent innovations::

    M nu_dot = tau + f - h(nu, theta) - g,     f white with density q = T (rel tau)^2 + floor
    z = nu + noise of variance R

The first is the second with q = 0. The sensitivities ``de/dtheta`` are those of the filter's mean,
one recursion beside its covariance's; that the gain depends on theta, too, multiplies an earlier
innovation, which no later one is correlated with, and is left out. R, floor and rel are themselves
estimated by maximum likelihood (Fisher scoring).

Where no linear velocity is measured, the depth z is one more state, which the velocities move and
which is measured in the place of w (:mod:`rov_ident.sampling.without_velocity`)::

    z_dot = k . (v + water),   z_measured = z + noise

Then u and v hang on the model and the wrench alone, and what is not known of their coefficients is
in the information about all others, through the Munk moments and, in a tilted vehicle, the depth.

The inverse of the information ``J = sum (de/dtheta)'(de/dtheta) / s`` is the Cramer-Rao bound at
these noise levels. Coefficients' covariances are not taken from it alone, as residuals may be
coloured: the covariance of the accumulated score stands between two inverse informations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.config.prior import axis_std_of, prior_of
from rov_ident.core.jit import floats, inlined, kernel, record
from rov_ident.core.linalg import sandwich, widened
from rov_ident.core.progress import Progress, silent
from rov_ident.core.whiteness import JUDGED_TIME, summed_up
from rov_ident.effects import EFFECTS, missing_terms
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
from rov_ident.estimation.shared import (
    FOLLOWED,
    add_scatter,
    drive_sides,
    informative_axes,
    measure,
    steps_of,
    wrench_of,
)
from rov_ident.model.equations import Array, Model, Structure, momentum_columns
from rov_ident.model.scales import authority
from rov_ident.offline import constancy
from rov_ident.offline.archive import Mapper, Samples, total
from rov_ident.offline.newton import inverse_of, minimise
from rov_ident.sampling.kinematic_filter import SUREST
from rov_ident.sampling.sample import NO_SIDES, free_axes, parts
from rov_ident.sampling.wrench_scatter import SHARE

_LAG = 1.0  # s; window over the correlation of the score in time
_GATE = 6.0  # standard deviations; one of 500 million normal innovations is further off
_NOISE_SAMPLES = 12_000  # of a bag: they tell a noise level to 1 %
_ITERATIONS = 25  # a guard: Gauss-Newton steps converge in a few, or never
_DOUBTFUL = 0.03  # of the axis's working wrench, lasting a second: what may be unexplained at first
_NOISE_ITERATIONS = 20  # each by a factor of e^1.5 at most: from the first level to the least
_NEAR = 0.05  # squared standard deviations of noise levels from the most likely ones
_SMALLEST = 1e-4  # floor of the process noise over the axis's working wrench: as good as none
_ANY_DEPTH = 1e6  # m2; of a depth that nothing is known of
_MEMORY = 1.0  # s; over which drag may depend on the past: a length of a hull at working speed
_NONE = np.zeros(0)
NO_ROWS = np.zeros((3, 0, 6))
LIKELY = 3e-3  # a choice: the same before a fit of the noise, stated in docs/offline.md


@dataclass(frozen=True)
class Noise:
    """What the residuals are made of.

    ``measurement`` (6,) multiplies the variances that the samples state; ``floor`` (6,) is the
    density of an unknown wrench [N2 s, (N m)2 s], ``relative`` the wrench's own standard deviation
    relative to itself, an error of which lasts ``correlation_time`` s, or as long as a message.
    ``restoring`` (6, 3) [N, N m] times the unit vector down is the wrench of weight, which has the
    error of the measured attitude (`estimation.process_noise`); zeros: taken for exact.
    ``untaught`` (p, 6): parameters of effects that do not learn from the wrench of an axis, as it
    would teach them noise of its reading.
    """

    measurement: Array
    floor: Array
    relative: float
    correlation_time: float
    restoring: Array
    untaught: NDArray[np.bool_]

    def process(self, samples: Samples) -> Array:
        """Density (k, 6) of the wrench's error."""
        lasting = np.maximum(self.correlation_time, samples["hold"])[:, None]
        doubt = np.where(np.isfinite(samples["wrench_doubt"]), samples["wrench_doubt"], 0.0)
        variance = (self.relative * samples["wrench"]) ** 2 + doubt
        # |r x down|^2, of a unit vector
        along = (samples["down"] @ self.restoring.T) ** 2
        turned = np.maximum(np.sum(self.restoring**2, axis=1) - along, 0.0)
        return self.floor + lasting * variance + samples["tilt"][:, None] * turned


def assumed(config: Config, least: float = _SMALLEST) -> Noise:
    """The noise that a configuration states.

    ``least``: that of the wrench where there is none, relative to the axis's working wrench.
    """
    w = config.wrench
    smallest = least * authority(config.dynamics)
    floor = np.maximum(np.array(w.floor_std), smallest) ** 2 * w.correlation_time
    restoring = config.dynamics.body.restoring
    untaught = np.zeros((len(config.estimate_effects), 6), dtype=bool)
    return Noise(np.ones(6), floor, w.relative_std, w.correlation_time, restoring, untaught)


class _Equations(NamedTuple):
    structure: Structure
    mass: Array  # (6, 6)
    inverse: Array  # (6, 6), among the free components
    theta: Array  # (m, LANES)
    one_theta: Array  # (m, 1)
    restoring: Array  # (6, 3)
    estimated: NDArray[np.int64]  # (n,)
    free: NDArray[np.bool_]  # (6,)


class Pass(NamedTuple):
    """One pass of the filter over samples; sums over bags are sums of these.

    information (n, n); score (n,) = minus half the cost's gradient; ``scatter`` (n, n) the
    covariance of the accumulated score, correlation in time included; ``cost``; number
    of innovations ``used`` and of ``outliers``.
    """

    information: Array
    score: Array
    scatter: Array
    cost: float
    used: int
    outliers: int


def one_pass(
    samples: Samples,
    model: Model,
    estimated: NDArray[np.int64],
    noise: Noise,
    free: NDArray[np.bool_] | None = None,
    gate: float = np.inf,
    effects: Array = _NONE,
    out: Array = NO_ROWS,
    considered: Array | None = None,
) -> Pass:
    """The likelihood of samples (k,) of SAMPLE at the model's values, with its derivatives.

    ``estimated`` (n,) are indices into theta, behind which come the values (p,) of parameters of
    ``effects``, as in the columns of the samples; components not ``free`` (6,) follow the
    measurement, and those of which no wrench is known. ``out`` (3, k, 6), unless it is empty, is
    filled with :class:`Innovations`. ``considered`` (k, 6, q): what a unit of each of q errors adds
    to the wrench of each sample; these are then q more parameters behind the others.
    """
    known = free_axes(samples)
    free = known if free is None else free & known
    samples, sides = parts(samples)
    if not len(effects):
        sides = NO_SIDES
    elif noise.untaught.any():
        sides = sides.copy()
        sides[:, :6][:, noise.untaught.T] = 0.0
    if considered is not None:
        size = considered.shape[2]
        errors = np.zeros((len(samples), 13, size))
        errors[:, :6] = considered
        estimated = np.append(estimated, len(model.theta) + len(effects) + np.arange(size))
        sides = np.broadcast_to(sides, (len(samples), *sides.shape[1:]))
        effects, sides = np.append(effects, np.zeros(size)), np.concatenate([sides, errors], axis=2)
    mass, theta = model.mass_matrix, np.concatenate([model.theta, effects])[:, None]
    inverse, at = np.zeros((6, 6)), np.ix_(free, free)
    inverse[at] = np.linalg.inv(mass[at])
    equations = _Equations(
        model.structure, mass, inverse, np.repeat(theta, LANES, axis=1),
        np.ascontiguousarray(theta), model.body.restoring, estimated, free,
    )  # fmt: skip
    n = len(estimated)
    information, score, scatter, sums = np.zeros((n, n)), np.zeros(n), np.zeros((n, n)), np.zeros(3)
    _filter(
        equations, samples, sides, noise.process(samples), noise.measurement, gate,
        information, score, scatter, sums, out,
    )  # fmt: skip
    return Pass(information, score, scatter, float(sums[0]), int(sums[1]), int(sums[2]))


def with_thrust_errors(
    samples: Samples,
    model: Model,
    estimated: NDArray[np.int64],
    noise: Noise,
    free: NDArray[np.bool_] | None,
    gate: float,
    effects: Array,
    axis_std: Array,
) -> Pass:
    """:func:`one_pass`, with errors of the thrust of each axis by the standard deviations
    ``axis_std`` (q,), relative to it, of six axes or of none."""
    thrust, axes = samples["wrench"] - samples["surroundings"], np.arange(len(axis_std))
    errors = np.zeros((len(samples), 6, len(axes)))
    errors[:, axes, axes] = axis_std * thrust[:, axes]
    return one_pass(samples, model, estimated, noise, free, gate, effects, considered=errors)


def _tilt_errors(model: Model, samples: Samples) -> Array:
    """(k, 6, 2): what an error of the attitude in roll and in pitch, per radian, does to the wrench
    of weight and buoyancy."""
    turned = np.cross(samples["down"][:, None], np.eye(3)[:2])  # (k, 2, 3)
    wrench: Array = np.einsum("ij,kaj->kia", model.body.restoring, turned)
    return wrench


def _late_drag(model: Model, nu: Array, samples: Samples) -> Array:
    """(k, 6, 6): what the drag of each axis would be more if all of it were behind the motion, at
    the filtered velocity nu (k, 6) before each sample, which nothing in that sample has changed."""
    drag = model.damping_force(np.nan_to_num(nu))
    late, axes = np.zeros((len(nu), 6, 6)), np.arange(6)
    _lag(drag, samples["dt"], samples["restart"], _MEMORY)
    late[1:, axes, axes] = drag[:-1]
    return late


class Stretches(NamedTuple):
    """Of C stretches of a record the scores (C, n + q) and informations (C, n + q, n + q), of n
    parameters, of the q - 6 terms that the model lacks (:func:`~rov_ident.effects.missing_terms`)
    and of a memory of the drag of each axis, and the covariance (n, n) that what is left of errors
    of the attitude gives the score of all."""

    scores: Array
    informations: Array
    by_tilt: Array


def by_stretch(
    samples: Samples,
    model: Model,
    estimated: NDArray[np.int64],
    noise: Noise,
    free: NDArray[np.bool_],
    gate: float,
    effects: Array,
) -> Stretches:
    """The stretches of a record (:mod:`rov_ident.offline.constancy`)."""
    seconds, n, m = float(samples["dt"].sum()), len(estimated), len(model.theta)
    count = constancy.stretches_of(seconds)
    nu = innovations(samples, model, noise, free, gate, effects).nu
    beside = np.concatenate([_late_drag(model, nu, samples), _tilt_errors(model, samples)], axis=2)
    more = missing_terms(model)
    wider = model.with_terms(more)
    at = np.array([wider.names.index(name) for name in (*model.names, *more)], dtype=np.int64)
    ours = np.append(at[:m], len(at) + np.arange(len(effects)))[estimated]
    found = [
        one_pass(part, wider, np.append(ours, at[m:]), noise, free, gate, effects, considered=own)
        for part, own in zip(
            np.array_split(samples, count), np.array_split(beside, count), strict=True
        )
    ]
    informations = np.array([p.information for p in found])
    tilt = informations[:, :n, -2:]  # (C, n, 2)
    # The covariance of the means of an error over two stretches, as long as h times it lasts.
    h = seconds / count / max(float(np.mean(samples["tilt_lasts"])), 1e-3)
    between = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) - 1.0
    alike = np.exp(-h * np.maximum(between, 0.0)) * (1.0 - np.exp(-h)) ** 2
    alike[between < 0.0] = 2.0 * (h + np.exp(-h) - 1.0)
    alike *= float(np.mean(samples["tilt_variance"])) / h**2
    by_tilt = np.einsum("cia,dja,cd->ij", tilt, tilt, alike)
    return Stretches(np.array([p.score[:-2] for p in found]), informations[:, :-2, :-2], by_tilt)


class Innovations(NamedTuple):
    """Innovations e (k, 6) and their variances s (k, 6), NaN where nothing was measured, and the
    filtered velocity nu (k, 6)."""

    e: Array
    s: Array
    nu: Array


def innovations(
    samples: Samples,
    model: Model,
    noise: Noise,
    free: NDArray[np.bool_] | None = None,
    gate: float = np.inf,
    effects: Array = _NONE,
) -> Innovations:
    """What the filter finds in each sample."""
    out, nothing = np.full((3, len(samples), 6), np.nan), np.zeros(0, dtype=np.int64)
    one_pass(samples, model, nothing, noise, free, gate, effects, out)
    return Innovations(*out)


def whiteness(
    samples: Samples,
    model: Model,
    noise: Noise,
    free: NDArray[np.bool_],
    gate: float,
    effects: Array,
    tilt: float = 0.0,
) -> Array:
    """(2, 6): seconds in which the vehicle moved, and the integral over them of the power of
    innovations added up over a second (:mod:`rov_ident.core.whiteness`).

    The levels of the noise are those of the whole record, in which a vehicle may mostly rest. What
    an attitude that is off by ``tilt`` [rad] in roll and pitch makes of innovations lasts, and is
    expected, too.
    """
    found, out = innovations(samples, model, noise, free, gate, effects), np.zeros((2, 6))
    lasting = np.zeros((2, *found.e.shape))
    for i in range(2 * (tilt > 0.0)):
        tilted = samples.copy()
        tilted["down"] += np.cross(samples["down"], tilt * np.eye(3)[i])
        there = innovations(tilted, model, noise, free, gate, effects)
        lasting[i] = np.nan_to_num((there.e - found.e) / np.sqrt(found.s))
    _add_power(found.e / np.sqrt(found.s), lasting, parts(samples)[0], out)
    return out


# ------------------------------------------------------------------ noise


_STEP_NOISE = 0.02  # of the logarithm of a noise level: its slope is then right to 1 %
_KNOWN = np.log(30.0)  # prior standard deviation of such a logarithm: hardly anything is known


def _levels(noise: Noise) -> Array:
    """(13,) logarithms: measurement, floor, relative (as a variance)."""
    floor, relative = np.maximum(noise.floor, 1e-300), max(noise.relative, 1e-5) ** 2
    return np.log(np.concatenate([noise.measurement, floor, [relative]]))


def _at_levels(noise: Noise, levels: Array, process: bool) -> Noise:
    values = np.exp(levels)
    values[6:] *= process
    return replace(
        noise, measurement=values[:6], floor=values[6:12], relative=float(np.sqrt(values[12]))
    )


def noise_slope(
    samples: Samples,
    model: Model,
    noise: Noise,
    free: NDArray[np.bool_],
    process: bool,
    effects: Array = _NONE,
) -> tuple[Array, Array]:
    """Fisher information (13, 13) and half the likelihood's gradient (13,) about the logarithms.

    Without ``process`` only the measurements' are looked at.
    """
    samples, levels = samples[:_NOISE_SAMPLES], _levels(noise)
    base = innovations(samples, model, noise, free, _GATE, effects)
    keep = np.isfinite(base.e)
    e, s = base.e[keep], base.s[keep]
    free_levels = np.concatenate([free, free & process, [process]])
    slopes = np.zeros((13, 2, len(e)))
    for i in np.flatnonzero(free_levels):
        moved = levels.copy()
        moved[i] += _STEP_NOISE
        moved_noise = _at_levels(noise, moved, process)
        there = innovations(samples, model, moved_noise, free, np.inf, effects)
        slopes[i, 0] = (there.e[keep] - e) / (_STEP_NOISE * np.sqrt(s))
        slopes[i, 1] = np.log(there.s[keep] / s) / _STEP_NOISE
    unit = e / np.sqrt(s)
    gradient = 0.5 * slopes[:, 1] @ (unit**2 - 1.0) - slopes[:, 0] @ unit
    information = slopes[:, 0] @ slopes[:, 0].T + 0.5 * slopes[:, 1] @ slopes[:, 1].T
    return information, gradient


def noise_cost(
    samples: Samples, model: Model, noise: Noise, free: NDArray[np.bool_], effects: Array = _NONE
) -> Array:
    """(6,): of the innovations along each axis, twice the negative logarithm of their likelihood;
    an outlier is worth its gate."""
    found = innovations(samples[:_NOISE_SAMPLES], model, noise, free, _GATE, effects)
    known, keep = np.isfinite(found.s), np.isfinite(found.e)
    s, e = np.where(known, found.s, 1.0), np.where(keep, found.e, 0.0)
    each = np.where(keep, e**2 / s + np.log(s), _GATE**2 * known)
    cost: Array = each.sum(axis=0)
    return cost


def _follows(
    each: Mapper,
    model: Model,
    noise: Noise,
    free: NDArray[np.bool_],
    effects: Array,
    axis: int,
    reading: float,
) -> bool:
    """Whether the vehicle follows what looks like noise of the reading along an ``axis``, of the
    variance density ``reading`` [N2 s, (N m)2 s]: a command that trembles.

    By the innovations along that axis alone. For the level that suits all axes best also stands for
    what acts on others, and lasts longer than noise: an error of the attitude seems to move the
    vehicle up and down, as the moments of a moving vehicle depend on that.
    """
    costs = []
    for density in (FOLLOWED * reading, reading):
        floor = np.where(np.arange(6) == axis, density, noise.floor)
        found = each(noise_cost, model, replace(noise, floor=floor), free, effects)
        costs.append(sum(cost[axis] for cost in found))
    return bool(costs[0] < costs[1])  # neither where nothing is measured along it


# ------------------------------------------------------------------ the estimate


@dataclass(frozen=True)
class Likelihood:
    """The maximum: values (n,) of the estimated coefficients, their covariance (n, n), and what the
    data ``asked`` (n,) for, which may be beyond the bounds (of the quadratic there).

    ``bound`` (n, n) is the Cramer-Rao bound, prior included; ``total`` the sums of the last pass.
    ``lasting`` (6,) is the power of innovations added up over a second in motion: 1 is expected,
    NaN where it is not known.
    ``by_axis`` (n, 6): what the values are wrong by if the thrust of one axis is off by its
    standard deviation (`config.prior.axis_std_of`); (n, 0) where none is supposed.
    ``reading_noise`` (6,) is the variance density [N2 s, (N m)2 s] of noise of the wrench's
    reading, on axes that would teach that; zero on others.
    ``slope`` (2, n): the largest slope of each parameter within a record, in normal deviates, and
    by how much it changes in that record.
    ``missing`` (q,): how unlikely the data are, as normal deviates, if each of the q - 6 terms that
    the model lacks is zero, and if the drag of each axis depends on the present motion alone.
    ``held`` (n,): what kept its prior, as it would be learnt from such axes: their coefficients,
    and factors of the thrust there. Other parameters of thrusters are learnt from the other axes
    (a lag would smooth the noise away).
    """

    values: Array
    asked: Array
    covariance: Array
    bound: Array
    noise: Noise
    total: Pass
    lasting: Array
    by_axis: Array
    slope: Array
    missing: Array
    held: NDArray[np.bool_]
    reading_noise: Array
    iterations: int
    converged: bool


def maximise(
    each: Mapper,
    config: Config,
    model: Model,
    free: NDArray[np.bool_] | None = None,
    precision: Array | None = None,
    process: bool = True,
    say: Progress = silent,
    effects: Array | None = None,
    first_noise: Noise | None = None,
) -> Likelihood:
    """The estimates of largest likelihood, starting from the values of ``model`` and those of
    ``effects`` (p,) (None: as configured). ``precision`` (n,) is the prior's, of coefficients and
    then of parameters of effects. ``process``: the wrench has errors, else pure output error.
    ``first_noise``: levels to begin with besides those of the configuration.

    Raises UserError if the model cannot be simulated.
    """
    free = np.ones(6, dtype=bool) if free is None else free
    prior = prior_of(config, effects=True)
    estimated, mean = prior.estimated, prior.mean
    own = estimated < len(model.theta)
    effects = mean[~own] if effects is None else effects
    precision = np.zeros(len(mean)) if precision is None else precision
    starts = _first_levels(config, process, first_noise)

    def model_at(theta: Array) -> Model:
        moved = model.theta.copy()
        moved[estimated[own]] = theta[own]
        return model.with_theta(moved)

    def evaluate(theta: Array, gate: float, noise: Noise) -> tuple[Pass, float]:
        moved = model_at(theta)
        if np.linalg.eigvalsh(moved.mass_matrix)[0] <= 0.0:
            return nothing, np.inf
        found = total(each(one_pass, moved, estimated, noise, free, gate, theta[~own]))
        cost = float(found.cost + precision @ (theta - mean) ** 2)
        # an outlier is worth its gate, so that refusing one gains nothing
        if np.isfinite(gate):
            cost += found.outliers * gate**2
        return found, cost if np.isfinite(cost) else np.inf

    step = count(1)

    def derivatives(theta: Array, at: Pass) -> tuple[Array, Array]:
        say(f"step {next(step)}")
        return at.score + precision * (mean - theta), at.information + np.diag(precision)

    nothing = Pass(np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)), 0.0, 0, 0)
    theta, at, steps = np.append(model.theta[estimated[own]], effects), nothing, 0
    of_noise, converged, tolerance = theta, False, 1e-6 * len(theta)
    for stage, gate in enumerate((np.inf, _GATE, _GATE, _GATE)):
        far = theta - of_noise
        if stage >= 2 and far @ at.information @ far < 0.1 * len(theta):
            break  # the noise levels would be the same
        # Before the first step, too: with less noise than there is, the likelihood of a model that
        # is not right yet has valleys far from it.
        of_noise = theta  # at which the noise levels are found
        say("noise levels")
        noise = _likeliest_noise(each, model_at(theta), starts, free, process, theta[~own])
        starts = [noise, *starts[:1]] if stage == 0 else [noise]
        there = model_at(theta), noise, free, theta[~own]
        noise, held, reading_noise = _without_noisy_axes(each, config, *there, precision)
        bounds = np.where(held, mean, prior.lower), np.where(held, mean, prior.upper)
        cost = partial(evaluate, gate=gate, noise=noise)
        theta = np.clip(theta, *bounds)
        theta, at, more, converged = minimise(
            theta, bounds, cost, derivatives, tolerance, _ITERATIONS
        )
        steps += more
    last = model_at(theta), noise, free, gate, theta[~own], config.odometry.attitude_std
    seconds, power = np.sum(each(whiteness, *last), 0)
    known = seconds > JUDGED_TIME
    lasting = np.where(known, power / np.where(known, seconds, 1.0), np.nan)
    slope, curvature = derivatives(theta, at)
    asked, inverse = theta.copy(), inverse_of(curvature[np.ix_(~held, ~held)])
    asked[~held] += inverse @ slope[~held]
    n = len(theta)
    axis_std = axis_std_of(config, prior.names)
    beside = model_at(theta), estimated, noise, free, gate, theta[~own], axis_std
    errors = total(each(with_thrust_errors, *beside)).information[:n, n:]
    by_axis = np.zeros_like(errors)
    by_axis[~held] = inverse @ errors[~held]
    records = each(by_stretch, model_at(theta), estimated, noise, free, gate, theta[~own])
    by_tilt = sum(record.by_tilt for record in records)
    scores, informations = _together(records)
    by_stretches = constancy.scatter(scores[:, :n])
    missing = constancy.lacking(scores, informations, precision, mean - theta, held)
    scatters = at.scatter + by_tilt, by_stretches + by_tilt
    bound, covariance = _with_consider_parameters(at.information, scatters, precision, held)
    found = [
        constancy.slopes(r.scores[:, :n], r.informations[:, :n, :n], curvature) for r in records
    ]
    slope = constancy.worst(found, n) * ~held  # what keeps its prior suits no stretch
    return Likelihood(
        theta, asked, covariance, bound, noise, at, lasting, by_axis, slope, missing, held,
        reading_noise, steps, converged,
    )  # fmt: skip


def _first_levels(config: Config, process: bool, also: Noise | None) -> list[Noise]:
    """The noise from which the search for its levels begins, of which the best result counts."""
    stated = assumed(config)
    if not process:
        exact = np.zeros_like(stated.restoring)
        stated = replace(stated, floor=np.zeros(6), relative=0.0, restoring=exact)
    if also is not None:
        return [stated, also]  # that of a wrong lag may be a valley far away
    if not process:
        return [stated]
    # Also from above: where there is next to no process noise, its level hardly shows, and a
    # search would stay there; from far above it ends before it is there.
    doubtful = np.maximum(stated.floor, (_DOUBTFUL * authority(config.dynamics)) ** 2)
    return [stated, replace(stated, floor=doubtful)]


def _likeliest_noise(
    each: Mapper,
    model: Model,
    starts: Sequence[Noise],
    free: NDArray[np.bool_],
    process: bool,
    effects: Array,
) -> Noise:
    """The likeliest of the levels that the search finds from each of some others."""
    levels = [_noise_levels(each, model, start, free, process, effects) for start in starts]
    if len(levels) == 1:
        return levels[0]
    costs = [np.sum(each(noise_cost, model, level, free, effects)) for level in levels]
    return levels[int(np.argmin(costs))]


def _without_noisy_axes(
    each: Mapper,
    config: Config,
    model: Model,
    noise: Noise,
    free: NDArray[np.bool_],
    effects: Array,
    precision: Array,
) -> tuple[Noise, NDArray[np.bool_], Array]:
    """The noise, with axes that teach thrusters nothing as noise of the reading would; which
    parameters (n,) are held, as only such axes teach them; and the variance density (6,) of that
    noise [N2 s, (N m)2 s]."""
    readings, wrenches, samples = np.sum(list(each(_wrench_densities)), axis=0)
    taught = informative_axes(config)
    noisy = readings > SHARE * wrenches
    for i in np.flatnonzero(noisy & taught.any(axis=0)):
        reading = readings[i] / samples[i]
        noisy[i] = not _follows(each, model, noise, free, effects, int(i), reading)
    held = (taught & noisy).any(axis=1) & (precision > 0.0)
    of_thrust = np.array([bool(EFFECTS[name].act) for name, _ in config.estimate_effects], bool)
    learning = of_thrust & ~held[len(held) - len(of_thrust) :]
    noise = replace(noise, untaught=learning[:, None] & noisy)
    return noise, held, np.where(noisy, readings / samples, 0.0)


def missing_at(
    each: Mapper, config: Config, model: Model, values: Array, free: NDArray[np.bool_]
) -> Array:
    """As the ``missing`` (q,) of :class:`Likelihood`, at the ``values`` (n,) that another estimator
    has found, which are those of the ``model``."""
    prior = prior_of(config, effects=True)
    precision, effects = 1.0 / prior.std**2, values[prior.estimated >= len(model.theta)]
    # one search is enough: what is judged is judged by its scatter between stretches
    noise = _likeliest_noise(each, model, [assumed(config)], free, True, effects)
    there = model, noise, free, effects
    noise, held, _ = _without_noisy_axes(each, config, *there, precision)
    records = each(by_stretch, model, prior.estimated, noise, free, _GATE, effects)
    return constancy.lacking(*_together(records), precision, prior.mean - values, held)


def _together(records: Sequence[Stretches]) -> tuple[Array, Array]:
    """Scores and informations of the stretches of all records."""
    return (
        np.concatenate([record.scores for record in records]),
        np.concatenate([record.informations for record in records]),
    )


def _with_consider_parameters(
    information: Array, scatters: Sequence[Array], precision: Array, held: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Bound and covariance (n, n) of an estimate, of which the ``held`` parameters (n,) keep their
    prior: their errors move all others (consider parameters, Schmidt 1966). The covariance is by
    the first of the ``scatters`` (n, n) of the score, with no variance below those by the others.
    """
    ours = np.ix_(~held, ~held)
    error = np.eye(len(held))  # by the score of what is estimated, and by errors of what is held
    error[ours] = inverse_of((information + np.diag(precision))[ours])
    error[np.ix_(~held, held)] = -error[ours] @ information[np.ix_(~held, held)]
    found = []
    for square in (information, *scatters):
        square = square + np.diag(precision)
        square[held] = square[:, held] = 0.0
        square[held, held] = 1.0 / precision[held]
        found.append(sandwich(error, square))
    bound, covariance, *others = found
    # From few data the scatter is itself uncertain: never thinner than the bound.
    return bound, widened(
        covariance, np.max([np.diag(other) for other in (bound, *others)], axis=0)
    )


def _wrench_densities(samples: Samples) -> Array:
    """Sums (3, 6) of the variance densities of noise of the wrench's reading, where it is loud, and
    of the wrench itself, and the number of samples."""
    samples, _ = parts(samples)
    power = samples["wrench"] ** 2 * samples["hold"][:, None]
    noise = np.where(np.isfinite(samples["reading_noise"]), samples["reading_noise"], 0.0)
    densities = (noise, power, np.ones_like(power))
    return np.array([np.sum(density, axis=0) for density in densities])


def _noise_levels(
    each: Mapper, model: Model, noise: Noise, free: NDArray[np.bool_], process: bool, effects: Array
) -> Noise:
    """The most likely levels, begun from those of ``noise``."""
    start = _levels(noise) if process else np.zeros(13)
    least = np.full(13, np.log(SUREST))
    least[6:12] = np.log((_SMALLEST * authority(model)) ** 2 * noise.correlation_time)
    least[12] = np.log(1e-10)

    def evaluate(levels: Array) -> tuple[Noise, float]:
        moved = _at_levels(noise, levels, process)
        off = np.sum((levels - start) ** 2) / _KNOWN**2
        return moved, float(np.sum(each(noise_cost, model, moved, free, effects)) + off)

    def derivatives(levels: Array, moved: Noise) -> tuple[Array, Array]:
        slopes = each(noise_slope, model, moved, free, process, effects)
        gradient = sum(s[1] for s in slopes) - (levels - start) / _KNOWN**2
        return gradient, sum(s[0] for s in slopes) + np.eye(13) / _KNOWN**2

    highest = np.full(13, np.inf)
    bounds = least, highest
    return minimise(start, bounds, evaluate, derivatives, _NEAR, _NOISE_ITERATIONS, 1.5)[1]


# ------------------------------------------------------------------ kernels


_SCRATCH = record(
    [
        *OBSERVER,
        ("noise", "f8", (6, 6)),  # variance density of the acceleration
        # that acts; nu as measured, its variance; covariance of nu with the depth
        *floats((6,), "wrench z r cross"),
    ]
)


class _Work(NamedTuple):
    of_rate: Array  # (6, m)
    momentum: Array  # (6, m)
    of_motion: Array  # (6, m)
    drive: Array  # (6, n)
    spare: Array  # (6, n)
    along: Array  # (7,)
    deep: Array  # (7,)
    scratch: NDArray[np.void]  # (1,) of _SCRATCH


@inlined
def _predict(eq, sample, side, process, x, p, sensitivity, scale, work):
    """Velocity x (6,), covariance p (6, 6), sensitivity (6, n) to the sample's time; with the depth
    behind the velocity one more of each."""
    s, n = work.scratch[0], len(eq.estimated)
    wrench_of(eq.one_theta, sample, side, s.wrench)
    force_of(sample, s.wrench, eq.restoring, s.force, s.slope)
    take_inputs(eq.structure, sample.inputs[0], s)
    take_guide(s)
    steps = steps_of(sample.dt)
    dt = sample.dt / steps
    for step in range(steps):
        late = step * dt - 0.5 * sample.dt
        if len(x) > 6:
            _add_depth_before(sample, 0.5 * dt, x, p, sensitivity, work)
        linearised_step(eq.structure, eq.theta, eq.one_theta, x, late, dt, s)
        if n > 0:
            momentum_columns(eq.structure, s.middle_nu_dot, work.of_rate)
            drive_of(eq.structure, s.middle, eq.estimated, scale, n, work, work.drive)
            drive_sides(len(eq.theta) - side.shape[1], eq.estimated, scale, side, work.drive)
            advance(s.transition, sensitivity, s.into, work.drive, work.spare)
        for i in range(6):
            x[i] = s.end[i]
            for j in range(6):
                total = 0.0
                for a in range(6):
                    total += s.into[i, a] * process[a] * s.into[j, a]
                s.noise[i, j] = total / (dt * dt)
        advance_covariance(s.transition, s.noise, dt, p, s.product)
        if len(x) > 6:
            _add_depth_after(sample, 0.5 * dt, x, p, sensitivity, work)


@inlined
def _add_depth_before(sample, half, x, p, sensitivity, work):
    """The depth's part of a step in the velocities before it: z += half k . v, by trapezoids.

    ``work.along`` (7,): covariance with k . v; ``work.deep`` (7,): with the depth after this.
    """
    for j in range(7):
        work.along[j] = 0.0
        for i in range(3):
            work.along[j] += p[j, i] * sample.down[i]
        work.deep[j] = p[6, j] + half * work.along[j]
    climb = work.along[0] * sample.down[0] + work.along[1] * sample.down[1]
    climb += work.along[2] * sample.down[2]
    p[6, 6] += half * (2.0 * work.along[6] + half * climb)
    for i in range(3):
        x[6] += half * sample.down[i] * (x[i] + 2.0 * sample.water[i])
        for j in range(sensitivity.shape[1]):
            sensitivity[6, j] += half * sample.down[i] * sensitivity[i, j]


@inlined
def _add_depth_after(sample, half, x, p, sensitivity, work):
    """The depth's part in the velocities after the step."""
    phi, cross = work.scratch[0].transition, work.scratch[0].cross
    for j in range(6):
        before, after = 0.0, 0.0
        for i in range(6):
            before += phi[j, i] * work.deep[i]
        for i in range(3):
            after += p[j, i] * sample.down[i]
        cross[j] = before + half * after
        work.along[j] = 2.0 * before + half * after
    for i in range(3):
        x[6] += half * sample.down[i] * x[i]
        p[6, 6] += half * sample.down[i] * work.along[i]
        for j in range(sensitivity.shape[1]):
            sensitivity[6, j] += half * sample.down[i] * sensitivity[i, j]
    for j in range(6):
        p[6, j] = p[j, 6] = cross[j]


@kernel
def _add_power(e, lasting, samples, out):
    """Add to out (2, 6) what :func:`whiteness` gives; e (k, 6) are normalised innovations, of which
    two errors that last are expected to make ``lasting`` (2, k, 6)."""
    for i in range(6):
        summed, expected, since, roll, pitch = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(len(samples)):
            since += samples[k].dt
            moving = False
            for j in range(6):
                moving |= samples[k].moving[j] != 0
            if samples[k].restart or not moving:
                summed, expected, since, roll, pitch = 0.0, 0.0, 0.0, 0.0, 0.0
            elif np.isfinite(e[k, i]):
                summed, expected, keep = summed_up(summed, expected, since, e[k, i])
                roll = keep * roll + lasting[0, k, i]
                pitch = keep * pitch + lasting[1, k, i]
                out[0, i] += since
                out[1, i] += since * summed * summed / (expected + roll * roll + pitch * pitch)
                since = 0.0


@kernel
def _lag(x, dt, restart, time):
    """Columns x (k, m) less what they are behind a lag of first order, negative, in place."""
    late = x[0].copy()
    for k in range(len(x)):
        share = -np.expm1(-dt[k] / time)
        for j in range(x.shape[1]):
            late[j] = x[k, j] if restart[k] else late[j] + share * (x[k, j] - late[j])
            x[k, j] = late[j] - x[k, j]


@kernel
def _filter(
    eq, samples, sides, process, measurement, gate, information, score, scatter, sums, out
):  # fmt: skip
    """Add to information (n, n), score (n,), scatter (n, n), sums (3,): cost, innovations used,
    outliers. ``out`` (3, k, 6), unless it is empty, is filled with :class:`Innovations`."""
    all_e, all_s, all_nu = out[0], out[1], out[2]
    n, m = len(eq.estimated), len(eq.theta)
    work = _Work(
        np.empty((6, m)), np.empty((6, m)), np.empty((6, m)), np.empty((6, n)), np.empty((6, n)),
        np.empty(7), np.empty(7), np.empty(1, dtype=_SCRATCH),
    )  # fmt: skip
    size = 6
    for k in range(len(samples)):
        if samples[k].depth_variance > 0.0:
            size = 7
            break
    x, old, cross = np.zeros(size), np.zeros(6), np.zeros(size)
    p, sensitivity = np.zeros((size, size)), np.zeros((size, n))
    now, lagged, row, scale = np.zeros(n), np.zeros(n), np.zeros(n), np.ones(n)
    s = work.scratch[0]
    for i in range(6):
        for j in range(6):
            s.inverse[i, j], s.one_mass[i, j, 0] = eq.inverse[i, j], eq.mass[i, j]
            for k in range(LANES):
                s.mass[i, j, k] = eq.mass[i, j]
    started = False
    for k in range(len(samples)):
        sample, side = samples[k], sides[k if sides.shape[2] > 0 else 0]
        first = len(eq.theta) - side.shape[1]
        measure(sample, s.z, s.r)
        for i in range(6):  # less what the parameters of effects, as they are, add to it
            for j in range(side.shape[1]):
                s.z[i] -= side[6 + i, j] * (eq.one_theta[first + j, 0] - side[12, j])
        if sample.restart or not started or not sample.dt > 0.0:
            started = True
            p[:] = 0.0
            for i in range(6):
                x[i] = sample.nu[i]
                old[i] = sample.nu[i]
                if eq.free[i]:
                    known = sample.odometry_variance[i]
                    if i >= 3 and sample.gyro_variance > 0.0:
                        known = sample.gyro_variance
                    p[i, i] = known * measurement[i]
                    if i < 3 and size > 6:  # as large as its working speed
                        p[i, i] = known
            if size > 6:
                x[6], p[6, 6] = sample.depth, sample.depth_variance * measurement[2]
                if not sample.depth_variance > 0.0:
                    p[6, 6] = _ANY_DEPTH
            sensitivity[:] = 0.0
            lagged[:] = 0.0
            if len(all_nu) > 0:
                for i in range(6):
                    all_nu[k, i] = x[i]
            continue
        for i in range(6):
            s.guide[i] = 0.0
            if not eq.free[i]:  # it goes from measurement to measurement
                x[i] = old[i]
                s.guide[i] = (sample.nu[i] - old[i]) / sample.dt
            old[i] = sample.nu[i]
        _predict(eq, sample, side, process[k], x, p, sensitivity, scale, work)
        now[:] = 0.0
        for i in range(6):
            if not eq.free[i]:
                x[i] = sample.nu[i]
                continue
            if size > 6 and i == 2 and sample.depth_variance > 0.0:
                # z at the sample, and how far the vehicle has sunk since it was measured
                late, e = sample.depth_age, sample.depth - x[6]
                for j in range(size):
                    cross[j] = p[j, 6]
                for j in range(n):
                    row[j] = sensitivity[6, j]
                for a in range(3):
                    back = late * sample.down[a]
                    e += back * (x[a] + sample.water[a])
                    for j in range(size):
                        cross[j] -= back * p[j, a]
                    for j in range(n):
                        row[j] -= back * sensitivity[a, j]
                total = cross[6] + sample.depth_variance * measurement[2]
                for a in range(3):
                    total -= late * sample.down[a] * cross[a]
            elif np.isnan(s.z[i]):
                continue
            else:
                e, total = s.z[i] - x[i], p[i, i] + s.r[i] * measurement[i]
                for j in range(size):
                    cross[j] = p[j, i]
                for j in range(n):
                    row[j] = sensitivity[i, j]
                    if eq.estimated[j] >= first:
                        row[j] += side[6 + i, eq.estimated[j] - first]
            if len(all_e) > 0:
                all_e[k, i] = e
                all_s[k, i] = total
            if e * e > gate * gate * total:
                sums[2] += 1.0
                if len(all_e) > 0:
                    all_e[k, i] = np.nan
                continue
            sums[0] += e * e / total + np.log(total)
            sums[1] += 1.0
            for j in range(n):
                now[j] += row[j] * (e / total)
            for g in range(n):
                f = row[g] / total
                for j in range(n):
                    information[g, j] += f * row[j]
            correct(x, p, sensitivity, row, cross, total, e)
        if len(all_nu) > 0:
            for i in range(6):
                all_nu[k, i] = x[i]
        for j in range(n):
            score[j] += now[j]
        add_scatter(now, np.exp(-sample.dt / _LAG), scatter, lagged)
