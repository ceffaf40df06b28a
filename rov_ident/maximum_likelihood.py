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

The inverse of the information ``J = sum (de/dtheta)'(de/dtheta) / s`` is the Cramer-Rao bound at
these noise levels. Coefficients' covariances are not taken from it alone, as residuals may be
coloured: the covariance of the accumulated score stands between two inverse informations.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.coefficients import EXTENDED_SIZE
from rov_ident.config import Config
from rov_ident.errors import UserError
from rov_ident.estimate import prior_of
from rov_ident.excitation import authority
from rov_ident.jit import inner, kernel
from rov_ident.model import Array, Model, Structure, columns, generalized_force, momentum_columns

_POINTS = 7  # a velocity and its displacements along the six components, for the Jacobian
_STEP = 1e-6  # m/s, rad/s; of these displacements
_LAG = 1.0  # s; window over the correlation of the score in time
_GATE = 6.0  # standard deviations; an innovation further off is an outlier
_NOISE_SAMPLES = 12_000  # of a bag, from which its noise levels are estimated
_ITERATIONS = 25
_MAX_STEP = 0.05  # s
_SMALLEST = 1e-4  # floor of the process noise, relative to the axis's authority
LIKELY = 3e-3  # the same, of what is expected of a vehicle before any fit of its noise

Samples = NDArray[np.void]


@dataclass(frozen=True)
class Noise:
    """What the residuals are made of.

    ``measurement`` (6,) multiplies the variances that the samples state; ``floor`` (6,) is the
    density of an unknown wrench [N2 s, (N m)2 s], ``relative`` the wrench's own standard deviation
    relative to itself, an error of which lasts ``correlation_time`` s, or as long as a message.
    """

    measurement: Array
    floor: Array
    relative: float
    correlation_time: float

    def process(self, samples: Samples) -> Array:
        """Density (k, 6) of the wrench's error."""
        lasting = np.maximum(self.correlation_time, samples["hold"])[:, None]
        variance = (self.relative * samples["wrench"]) ** 2 + samples["wrench_doubt"]
        density: Array = self.floor + lasting * variance
        return density


def assumed(config: Config, least: float = _SMALLEST) -> Noise:
    """The noise that a configuration states.

    ``least``: that of the wrench where there is none, relative to the axis's authority.
    """
    w = config.wrench
    smallest = least * authority(config.dynamics)
    floor = np.maximum(np.array(w.floor_std), smallest) ** 2 * w.correlation_time
    return Noise(np.ones(6), floor, w.relative_std, w.correlation_time)


class _Equations(NamedTuple):
    structure: Structure
    mass: Array  # (6, 6, _POINTS)
    inverse: Array  # (6, 6), among the free components
    theta: Array  # (m, _POINTS)
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


def total(parts: Sequence[Pass]) -> Pass:
    """The sum over bags."""
    return Pass(*(sum(values) for values in zip(*parts, strict=True)))


def free_axes(channels: Sequence[int] | None) -> NDArray[np.bool_]:
    """(6,) marks of the velocity components that are simulated; the others are as measured."""
    free = np.ones(6, dtype=bool)
    if channels is not None:
        free[:] = False
        free[list(channels)] = True
    return free


def _equations(model: Model, estimated: NDArray[np.int64], free: NDArray[np.bool_]) -> _Equations:
    mass = model.mass_matrix
    at = np.flatnonzero(free)
    inverse = np.zeros((6, 6))
    inverse[np.ix_(at, at)] = np.linalg.inv(mass[np.ix_(at, at)])
    return _Equations(
        model.structure,
        np.repeat(mass[:, :, None], _POINTS, axis=2),
        inverse,
        np.repeat(model.theta[:, None], _POINTS, axis=1),
        model.body.restoring,
        np.asarray(estimated, dtype=np.int64),
        free,
    )


def one_pass(
    samples: Samples,
    model: Model,
    estimated: NDArray[np.int64],
    noise: Noise,
    free: NDArray[np.bool_] | None = None,
    gate: float = np.inf,
) -> Pass:
    """The likelihood of samples (k,) of SAMPLE at the model's values, with its derivatives.

    ``estimated`` (n,) are indices into theta; components not ``free`` (6,) follow the measurement.
    """
    free = np.ones(6, dtype=bool) if free is None else free
    n = len(estimated)
    information, score, scatter, sums = np.zeros((n, n)), np.zeros(n), np.zeros((n, n)), np.zeros(3)
    none = np.zeros((0, 6))
    _filter(
        _equations(model, estimated, free), samples, noise.process(samples),
        noise.measurement, gate, True, information, score, scatter, sums, none, none, none,
    )  # fmt: skip
    return Pass(information, score, scatter, float(sums[0]), int(sums[1]), int(sums[2]))


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
) -> Innovations:
    """What the filter finds in each sample."""
    free = np.ones(6, dtype=bool) if free is None else free
    k = len(samples)
    out = Innovations(np.full((k, 6), np.nan), np.full((k, 6), np.nan), np.empty((k, 6)))
    empty = np.zeros((0, 0))
    _filter(
        _equations(model, np.zeros(0, dtype=np.int64), free), samples,
        noise.process(samples), noise.measurement, gate, False,
        empty, np.zeros(0), empty, np.zeros(3), *out,
    )  # fmt: skip
    return out


# ------------------------------------------------------------------ noise


_STEP_NOISE = 0.02  # of the logarithm of a noise level, for its sensitivities
_KNOWN = np.log(30.0)  # prior standard deviation of such a logarithm


def _levels(noise: Noise) -> Array:
    """(13,) logarithms: measurement, floor, relative (as a variance)."""
    return np.log(
        np.concatenate(
            [noise.measurement, np.maximum(noise.floor, 1e-300), [max(noise.relative, 1e-5) ** 2]]
        )
    )


def _at_levels(noise: Noise, levels: Array) -> Noise:
    values = np.exp(levels)
    return replace(
        noise, measurement=values[:6], floor=values[6:12], relative=float(np.sqrt(values[12]))
    )


def noise_slope(
    samples: Samples, model: Model, noise: Noise, free: NDArray[np.bool_], process: bool
) -> tuple[Array, Array]:
    """Fisher information (13, 13) and half the likelihood's gradient (13,) about the logarithms.

    Without ``process`` only the measurements' are looked at.
    """
    samples = samples[:_NOISE_SAMPLES]
    levels = _levels(noise)
    base = innovations(samples, model, noise, free, _GATE)
    keep = np.isfinite(base.e)
    e, s = base.e[keep], base.s[keep]
    free_levels = np.concatenate([free, free & process, [process]])
    slopes = np.zeros((13, 2, len(e)))
    for i in np.flatnonzero(free_levels):
        moved = levels.copy()
        moved[i] += _STEP_NOISE
        there = innovations(samples, model, _at_levels(noise, moved), free, np.inf)
        slopes[i, 0] = (there.e[keep] - e) / (_STEP_NOISE * np.sqrt(s))
        slopes[i, 1] = np.log(there.s[keep] / s) / _STEP_NOISE
    unit = e / np.sqrt(s)
    gradient = 0.5 * slopes[:, 1] @ (unit**2 - 1.0) - slopes[:, 0] @ unit
    information = slopes[:, 0] @ slopes[:, 0].T + 0.5 * slopes[:, 1] @ slopes[:, 1].T
    return information, gradient


# ------------------------------------------------------------------ the estimate


Mapper = Callable[..., list]  # type: ignore[type-arg]
"""``mapper(function, *arguments)``: function(samples, *arguments) of every bag, in order."""


@dataclass(frozen=True)
class Likelihood:
    """The maximum: values (n,) of the estimated coefficients, their covariance (n, n).

    ``bound`` (n, n) is the Cramer-Rao bound, prior included; ``total`` the sums of the last pass.
    """

    values: Array
    covariance: Array
    bound: Array
    noise: Noise
    total: Pass
    iterations: int
    converged: bool


def maximise(
    each: Mapper,
    config: Config,
    model: Model,
    free: NDArray[np.bool_] | None = None,
    precision: Array | None = None,
    process: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Likelihood:
    """The coefficients of largest likelihood, from ``model``'s values on.

    ``precision`` (n,) is that of the prior about the configured values; ``process``: whether the
    wrench has errors, else pure output error.

    Raises
    ------
    UserError
        If the model cannot be simulated.
    """
    free = np.ones(6, dtype=bool) if free is None else free
    prior = prior_of(config)
    estimated, mean = prior.estimated, prior.mean
    precision = np.zeros(len(mean)) if precision is None else precision
    noise = assumed(config)
    if not process:
        noise = replace(noise, floor=np.zeros(6), relative=0.0)
    say = progress or (lambda what: None)

    def look(theta: Array, gate: float) -> tuple[Pass, float]:
        moved = model.theta.copy()
        moved[estimated] = theta
        there = model.with_theta(moved)
        if np.linalg.eigvalsh(there.mass_matrix)[0] <= 0.0:
            return nothing, np.inf
        found = total(each(one_pass, there, estimated, noise, free, gate))
        cost = float(found.cost + precision @ (theta - mean) ** 2)
        # an outlier is worth its gate, so that refusing one gains nothing
        if np.isfinite(gate):
            cost += found.outliers * gate**2
        return found, cost if np.isfinite(cost) else np.inf

    nothing = Pass(np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)), 0.0, 0, 0)
    theta, count, converged = model.theta[estimated].copy(), 0, False
    settled, at = theta.copy(), nothing
    for stage, gate in enumerate((np.inf, _GATE, _GATE)):
        far = theta - settled
        if stage == 2 and far @ at.information @ far < 0.1 * len(theta):
            break  # the noise levels would be the same
        if stage:
            settled = theta.copy()
            say("noise levels")
            moved = model.theta.copy()
            moved[estimated] = theta
            noise = _noise_levels(each, model.with_theta(moved), noise, free, process)
        at, cost = look(theta, gate)
        for _ in range(_ITERATIONS):
            say(f"step {count + 1}")
            information = at.information + np.diag(precision)
            slope = at.score + precision * (mean - theta)
            change = solved(information, slope)
            if slope @ change < 1e-6 * len(theta):
                converged = True
                break
            factor = 1.0
            while factor > 1e-3:
                found, there = look(theta + factor * change, gate)
                if there < cost:
                    break
                factor *= 0.5
            else:
                converged = True
                break
            count += 1
            theta, at, gained, cost = theta + factor * change, found, cost - there, there
            if gained < 1e-6 * len(theta):
                converged = True
                break
        else:
            converged = False
    bound = inverse_of(at.information + np.diag(precision))
    covariance = bound @ (at.scatter + np.diag(precision)) @ bound
    # From few data the scatter is itself uncertain: never thinner than the bound.
    widen = np.sqrt(np.maximum(np.diag(bound) / np.maximum(np.diag(covariance), 1e-300), 1.0))
    covariance = covariance * np.outer(widen, widen)
    return Likelihood(theta, covariance, bound, noise, at, count, converged)


def _noise_levels(
    each: Mapper, model: Model, noise: Noise, free: NDArray[np.bool_], process: bool
) -> Noise:
    levels = start = _levels(noise) if process else np.zeros(13)
    least = np.full(13, -np.inf)
    least[6:12] = np.log((_SMALLEST * authority(model)) ** 2 * noise.correlation_time)
    least[12] = np.log(1e-10)
    for _ in range(8):
        now = _at_levels(noise, levels)
        if not process:
            now = replace(now, floor=np.zeros(6), relative=0.0)
        parts = each(noise_slope, model, now, free, process)
        information = sum(p[0] for p in parts) + np.eye(13) / _KNOWN**2
        gradient = sum(p[1] for p in parts) - (levels - start) / _KNOWN**2
        change = np.clip(np.linalg.solve(information, gradient), -1.5, 1.5)
        moved = np.maximum(levels + change, least)
        change, levels = moved - levels, moved
        if np.abs(change).max() < 0.05:
            break
    noise = _at_levels(noise, levels)
    return noise if process else replace(noise, floor=np.zeros(6), relative=0.0)


def inverse_of(information: Array) -> Array:
    """Inverse of an information matrix, scaled to a unit diagonal meanwhile.

    Raises
    ------
    UserError
        If it is not finite, as the model could not be simulated.
    """
    if not np.isfinite(information).all():
        raise UserError(
            "the simulation diverges along this motion: check the signs and sizes of the "
            "coefficients and the axes of the bag"
        )
    size = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information * np.outer(size, size)
    inverse: Array = np.linalg.pinv(scaled, hermitian=True, rcond=1e-13) * np.outer(size, size)
    return inverse


def solved(information: Array, slope: Array) -> Array:
    change: Array = inverse_of(information) @ slope
    return change


# ------------------------------------------------------------------ kernels


@inner
def _pace(eq, force, nu, pace, out, work):
    """nu_dot (6,) under ``force`` (wrench less restoring); ``pace`` (6,) of guided components."""
    states, h, extended = work[:6], work[6:12], work[12:]
    for i in range(6):
        states[i, 0] = nu[i]
    generalized_force(1, eq.structure, eq.mass, eq.theta, states, h, extended)
    _resolve(eq, force, pace, h, out)


@inner
def _resolve(eq, force, pace, h, out):
    for i in range(6):
        out[i] = pace[i]
    for j in range(6):
        total = force[j] - h[j, 0]
        for k in range(6):
            total -= eq.mass[j, k, 0] * pace[k]
        for i in range(6):
            out[i] += eq.inverse[i, j] * total


@inner
def _slope(eq, force, nu, pace, out, jacobian, work):
    """As :func:`_pace`, and its derivative (6, 6) by the velocity."""
    states, h, extended = work[:6], work[6:12], work[12:]
    for i in range(6):
        for k in range(_POINTS):
            states[i, k] = nu[i] + (_STEP if k == i + 1 else 0.0)
    generalized_force(_POINTS, eq.structure, eq.mass, eq.theta, states, h, extended)
    _resolve(eq, force, pace, h, out)
    for i in range(6):
        for k in range(6):
            jacobian[i, k] = 0.0
        for j in range(6):
            for k in range(6):
                jacobian[i, k] -= eq.inverse[i, j] * (h[j, 1 + k] - h[j, 0]) / _STEP


@inner
def _product(a, b, out):
    """out = a b, a (6, 6), b (6, c)."""
    for i in range(6):
        for k in range(b.shape[1]):
            out[i, k] = 0.0
        for j in range(6):
            f = a[i, j]
            if f != 0.0:
                for k in range(b.shape[1]):
                    out[i, k] += f * b[j, k]


@kernel
def _filter(
    eq, samples, process, measurement, gate, tangent, information, score, scatter, sums, all_e,
    all_s, all_nu,
):  # fmt: skip
    """Add to information (n, n), score (n,), scatter (n, n), sums (3,): cost, innovations used,
    outliers. The last three arrays (k, 6) are filled unless they are empty."""
    n, m = len(eq.estimated), eq.theta.shape[0]
    work = np.empty((12 + EXTENDED_SIZE, _POINTS))
    x, old, p, s = np.zeros(6), np.zeros(6), np.zeros((6, 6)), np.zeros((6, n))
    new_p, new_s, gain = np.zeros((6, 6)), np.zeros((6, n)), np.zeros(6)
    a, b, c, d = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6)
    stage, middle, force, pace = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6)
    jacobian, square, phi = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    push, effect = np.zeros((6, 6)), np.zeros((6, n))
    of_pace, momentum, of_motion = np.zeros((6, m)), np.zeros((6, m)), np.zeros((6, m))
    extended = np.empty((EXTENDED_SIZE, 1))
    now, lagged, row, line = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(6)
    started = False
    for k in range(len(samples)):
        sample = samples[k]
        dt = sample.dt
        if sample.restart or not started or not dt > 0.0:
            started = True
            for i in range(6):
                x[i] = sample.nu[i]
                old[i] = sample.nu[i]
                for j in range(6):
                    p[i, j] = 0.0
                for j in range(n):
                    s[i, j] = 0.0
                if eq.free[i]:
                    known = sample.odometry_variance[i]
                    if i >= 3 and sample.gyro_variance > 0.0:
                        known = sample.gyro_variance
                    p[i, i] = known * measurement[i]
            for j in range(n):
                lagged[j] = 0.0
            if len(all_nu) > 0:
                for i in range(6):
                    all_nu[k, i] = x[i]
            continue
        for i in range(6):
            pace[i] = 0.0
            if not eq.free[i]:
                x[i] = old[i]
                pace[i] = (sample.nu[i] - old[i]) / dt
            old[i] = sample.nu[i]

        parts = max(1, int(np.ceil(dt / _MAX_STEP - 1e-9)))
        dt /= parts
        for step in range(parts):
            # of this part, from the middle of the sample's interval
            offset = (step + 0.5 - 0.5 * parts) * dt
            # the mean: Runge and Kutta; wrench and attitude go in a line
            for part in range(4):
                ahead = (-0.5, 0.0, 0.0, 0.5)[part] * dt
                for i in range(6):
                    force[i] = sample.wrench[i] + (offset + ahead) * sample.wrench_slope[i]
                    for j in range(3):
                        down = sample.down[j]
                        down += (offset + ahead - 0.5 * parts * dt) * sample.down_slope[j]
                        force[i] += eq.restoring[i, j] * down
                if part == 0:
                    _pace(eq, force, x, pace, a, work)
                elif part == 1:
                    for i in range(6):
                        stage[i] = x[i] + 0.5 * dt * a[i]
                    _pace(eq, force, stage, pace, b, work)
                elif part == 2:
                    for i in range(6):
                        stage[i] = x[i] + 0.5 * dt * b[i]
                        middle[i] = stage[i]
                    _slope(eq, force, stage, pace, c, jacobian, work)
                else:
                    for i in range(6):
                        stage[i] = x[i] + dt * c[i]
                    _pace(eq, force, stage, pace, d, work)
            for i in range(6):
                x[i] += dt / 6.0 * (a[i] + 2.0 * (b[i] + c[i]) + d[i])
                for j in range(6):
                    jacobian[i, j] *= dt
            _product(jacobian, jacobian, square)
            for i in range(6):
                for j in range(6):
                    unit = 1.0 if i == j else 0.0
                    phi[i, j] = unit + jacobian[i, j] + 0.5 * square[i, j]
                    square[i, j] = dt * (unit + 0.5 * jacobian[i, j] + square[i, j] / 6.0)
            _product(square, eq.inverse, push)
            if tangent:
                momentum_columns(eq.structure, c, of_pace)
                columns(eq.structure, middle, momentum, of_motion, extended)
                _product(phi, s, new_s)
                for i in range(6):
                    for j in range(n):
                        e = eq.estimated[j]
                        effect[i, j] = of_pace[i, e] + of_motion[i, e]
                for i in range(6):
                    for j in range(6):
                        f = push[i, j]
                        if f != 0.0:
                            for q in range(n):
                                new_s[i, q] -= f * effect[j, q]
                for i in range(6):
                    for j in range(n):
                        s[i, j] = new_s[i, j] if eq.free[i] else 0.0
            # the covariance: phi p phi' + push q push' / dt
            _product(phi, p, square)
            for i in range(6):
                for j in range(i + 1):
                    total = 0.0
                    for q in range(6):
                        total += square[i, q] * phi[j, q]
                        total += push[i, q] * process[k, q] * push[j, q] / dt
                    new_p[i, j] = total
                    new_p[j, i] = total
            for i in range(6):
                for j in range(6):
                    p[i, j] = new_p[i, j] if eq.free[i] and eq.free[j] else 0.0
        dt = sample.dt
        for i in range(6):
            if not eq.free[i]:
                x[i] = sample.nu[i]

        for j in range(n):
            now[j] = 0.0
        for i in range(6):
            if not eq.free[i]:
                continue
            z, variance = sample.odometry[i], sample.odometry_variance[i]
            if i >= 3 and np.isfinite(sample.gyro[i - 3]):
                z, variance = sample.gyro[i - 3], sample.gyro_variance
            if not np.isfinite(z):
                continue
            e, size = z - x[i], p[i, i] + variance * measurement[i]
            if len(all_e) > 0:
                all_e[k, i] = e
                all_s[k, i] = size
            if e * e > gate * gate * size:
                sums[2] += 1.0
                if len(all_e) > 0:
                    all_e[k, i] = np.nan
                continue
            sums[0] += e * e / size + np.log(size)
            sums[1] += 1.0
            for j in range(6):
                gain[j] = p[j, i] / size
            if tangent:
                for j in range(n):
                    row[j] = s[i, j]
                f = e / size
                for j in range(n):
                    now[j] += row[j] * f
                for g in range(n):
                    f = row[g] / size
                    for j in range(n):
                        information[g, j] += f * row[j]
                for g in range(6):
                    f = gain[g]
                    for j in range(n):
                        s[g, j] -= f * row[j]
            for j in range(6):
                line[j] = p[i, j]
            for g in range(6):
                x[g] += gain[g] * e
                for j in range(6):
                    p[g, j] -= gain[g] * line[j]
        if len(all_nu) > 0:
            for i in range(6):
                all_nu[k, i] = x[i]
        if tangent:
            fade = np.exp(-dt / _LAG)
            for j in range(n):
                lagged[j] *= fade
                score[j] += now[j]
            for g in range(n):
                f, h = now[g], lagged[g]
                for j in range(n):
                    scatter[g, j] += f * (now[j] + lagged[j]) + h * now[j]
            for j in range(n):
                lagged[j] += now[j]
