"""Output-error fits: the parameters of a hypothesis that minimise its squared residuals.

Gauss-Newton over short windows whose initial velocities are estimated along with the parameters
(multiple shooting, Bock 1983), within the bounds of the parameters. Onset times, in which the
residuals are not smooth, are searched for separately.
"""

from collections.abc import Container, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import stdtrit

from rov_ident.config.prior import ONE_AXIS, cob_std, covariance_beyond_driving
from rov_ident.core.linalg import scaled_inverse, scaled_solve
from rov_ident.discrepancy.hypothesis import (
    COEFFICIENTS,
    Hypothesis,
    Key,
    bounds,
    centre,
    largest_step,
    onsets,
    role_of,
    trim_std,
)
from rov_ident.discrepancy.linearisation import Linearisation, LinearProblem, linearise
from rov_ident.discrepancy.reading_noise import DRAWS
from rov_ident.discrepancy.selection import VERY_STRONG, variance_inflation
from rov_ident.discrepancy.windowed_problem import ONSET_STEP, WindowedProblem
from rov_ident.effects import EFFECTS
from rov_ident.model.coefficients import AXES
from rov_ident.model.equations import INERTIA, Array, Indices
from rov_ident.model.scales import semi_axes
from rov_ident.sampling.raw_streams import PAUSE

_FEWEST_CLUSTERS = 8  # windows; from fewer a variance is uncertain by more than half (chi-squared)
_ITERATIONS = 15  # of Gauss-Newton; a guard: fits of the study end after at most ten
_TOLERANCE = 1e-4  # squared residuals per residual; a step that gains less ends the fit, ...
_SETTLED = 0.1  # ... or less of their variance inflation: a third of a standard deviation at most
_STEP_FACTOR = 0.4  # by which a step that gains nothing is shortened ...
_SHORTEST = 0.05  # ... until it is so short: then the minimum is reached within rounding
_NOISE_UPDATES = 4  # of the noise in turn with the parameters, and ...
_NOISE_SETTLED = 0.05  # ... the relative change of it that ends them: far below its own error
FIRST_NOISE = 0.02  # m/s and rad/s, before the first estimate of it; its size hardly matters
_ONSET_RANGE = 14.0  # s to either side in which a better onset is looked for: a window and a
# held-out block beside it (5 + 10 s) may hide it
_ONSET_EVERY = 2.0  # s: as far apart as two onsets look alike to the search
_ONSET_RSS = 4.0  # scaled squared residuals: likelihood-ratio interval of two standard deviations
_ONSET_UNKNOWN = 30.0  # s; an onset less certain than that is not known at all
_UNPREDICTED = 2.0  # simulated over predicted squared residuals: beyond it linearity has failed
_TURNED = 0.01  # rad by which thrust may be turned, half a degree, seen from the hull's middle
_STRAY = 10.0  # standard deviations of a window's initial velocity from what was measured there


@dataclass(frozen=True)
class Fitted:
    """The best values of a hypothesis on the windows of a :class:`WindowedProblem`."""

    hypothesis: Hypothesis
    linearisation: Linearisation
    converged: bool

    def __post_init__(self) -> None:
        # now, because the patterns of the problem may be replaced later
        _ = self.linearisation.sensitivities

    @property
    def linear(self) -> LinearProblem:
        return self.linearisation.linear

    @property
    def noise(self) -> Array:
        return self.linearisation.noise

    @property
    def rss(self) -> float:
        return self.linearisation.rss

    @cached_property
    def noise_squares(self) -> Array:
        """Squared residuals (draws,) that noise of the wrench's reading makes.

        Zeros where every draw makes more than there are: the model is then close to unstable and
        amplifies the noise far beyond what the vehicle does."""
        squares = self._squares_of_reading
        return squares if squares.min() < self.rss else np.zeros(DRAWS)

    @cached_property
    def _squares_of_reading(self) -> Array:
        problem = self.linearisation.problem
        if not problem.reading_std.any():
            return np.zeros(DRAWS)
        force = problem.noisy_thrust(self.hypothesis.effects)
        return np.sum(self.linearisation.sensitivity_to(force) ** 2, axis=0)

    @property
    def noise_counts(self) -> bool:
        """Whether noise of the wrench's reading makes as much as an effect must explain."""
        return bool(self._squares_of_reading.mean() > VERY_STRONG * self.inflation)

    @property
    def squares(self) -> float:
        """The squared residuals less those that noise of the reading is expected to make."""
        return self.rss - float(self.noise_squares.mean())

    @cached_property
    def squares_of_biases(self) -> float:
        """What biases of the angular velocities, each no larger than it may be, would take off the
        squared residuals beside the parameters."""
        base, columns = self.linearisation.columns, self.linearisation.of_biases()
        columns -= base @ scaled_solve(self.linear.normal, base.T @ columns, 1e-9)
        normal, slope = columns.T @ columns, columns.T @ self.linearisation.error
        return float(slope @ np.linalg.solve(normal + self.inflation * np.eye(3), slope))

    @cached_property
    def inflation(self) -> float:
        """The variance inflation over all parameters."""
        return _inflation(self.linear)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (P, P), with correlated residuals allowed for: the mean of that of white
        residuals times their common inflation, which varies little, and the jackknife over windows,
        which knows where each parameter comes from; and with what biases of the angular velocities
        would make of it, which all windows share. Onsets are taken as known (:func:`onset_std`).
        """
        linear, at = self.linear, self._smooth
        prior = self._prior
        normal = linear.normal[np.ix_(at, at)] + prior
        bread = scaled_inverse(normal)
        own = self.inflation * bread @ prior @ bread  # of what only the file says
        wide = self.inflation * bread - own
        moves = self.linearisation.jackknife(at, prior)
        w = len(moves)
        if w >= _FEWEST_CLUSTERS:
            few = (stdtrit(w - 1, 0.975) / 1.96) ** 2  # Student's: the scatter of few is uncertain
            wide = 0.5 * (wide + few * (w - 1) / w * moves.T @ moves)
        wide += own
        biases = self.linearisation.columns[:, at].T @ self.linearisation.of_biases()
        moves = scaled_solve(normal, biases, 1e-9)
        out = np.zeros_like(linear.normal)
        out[np.ix_(at, at)] = wide + moves @ moves.T
        return out

    @cached_property
    def covariance_of_the_file(self) -> Array:
        """What errors of the file that no window shows by itself add to the covariance (P, P),
        unless they are among the parameters: of the thrust, that of each axis and its line, of the
        rigid body, and of the height of the centre of buoyancy (consider parameters, Schmidt 1966),
        as large as the configuration says that they may be and the residuals leave them. With the
        righting moment, thrust and all coefficients times k nothing moves otherwise
        (:func:`prior.covariance_beyond_driving`, of which the velocity sensor's scale is taken as
        it is).
        """
        linear, at, h = self.linear, self._smooth, self.hypothesis
        error = self.linearisation.sensitivity_to(self._errors_of_the_file())
        base = self.linearisation.columns[:, at]
        moves = scaled_solve(linear.normal[np.ix_(at, at)] + self._prior, base.T @ error, 1e-9)
        error -= base @ moves  # what the parameters do not imitate tells how large they are
        left = np.linalg.inv(np.eye(error.shape[1]) + error.T @ error / self.inflation)
        likely = left @ (error.T @ self.linearisation.error) / self.inflation
        out = np.zeros_like(linear.normal)
        out[np.ix_(at, at)] = moves @ (left + np.outer(likely, likely)) @ moves.T
        names = tuple(name if effect == COEFFICIENTS else "" for effect, name in linear.keys)
        values = np.array([h.values[k] for k in linear.keys])
        return out + covariance_beyond_driving(h.config, names, values)

    def _errors_of_the_file(self) -> Array:
        """The wrench (K, 6, E) of one standard deviation of each error of the file."""
        h, problem, motion = self.hypothesis, self.linearisation.problem, self.linearisation.motion
        config, body = h.config, h.model.body
        fitted = {name for _, name in self.linear.keys}
        known = config.vehicle_uncertainty
        moments = np.diag(body.inertia)
        own = [known.mass_std * body.mass]
        own += [known.inertia_std * np.sqrt(moments[i] * moments[j]) for i, j in INERTIA.values()]
        thrust = problem.thrust_of(h)[0]
        stronger = thrust[:, :, None] * config.wrench.scale_std
        axes = [i for i, axis in enumerate(AXES) if f"gain_{axis}" not in fitted]
        errors = [
            problem.raising(body)[:, :, None] * cob_std(config),
            problem.of_rigid_body(body, motion) * own,
            ONE_AXIS * stronger * np.eye(6)[:, axes],
        ]
        if "thrust_scale" not in h.effects:
            errors.append(stronger)
        trim = {k: std for k, std in trim_std(config).items() if k[0] not in h.effects}
        errors.append(problem.columns(h, motion, tuple(trim)) * list(trim.values()))
        if config.wrench.scale_std > 0.0:
            beside = float(_TURNED * np.mean(semi_axes(body)))
            for arm in (p for p in EFFECTS["thrust_line"].parameters if p.name not in fitted):
                _, force, moment = arm.name.split("_")
                turning = np.zeros((*thrust.shape, 1))
                turning[:, AXES.index(moment), 0] = beside * thrust[:, AXES.index(force)]
                errors.append(turning)
        return np.concatenate(errors, axis=2)

    def leave_one_out(self) -> Array:
        """Squared residuals (W, 6) of each window, by axis, of a fit to all the others."""
        return self.linearisation.leave_one_out(self._smooth, self._prior)

    @property
    def _prior(self) -> Array:
        """The precision of the prior of these, beside the normal matrix: squared residuals count as
        if white over their variance inflation."""
        precision = self.linearisation.problem.precision(self.hypothesis)
        return self.inflation * np.diag(precision[self._smooth])

    @property
    def _smooth(self) -> Indices:
        """The parameters in which the residuals are smooth: all but onsets."""
        dates = onsets(self.hypothesis)
        return self.linear.index(k for k in self.linear.keys if k not in dates)


def _inflation(linear: LinearProblem) -> float:
    """The variance inflation over all parameters."""
    return variance_inflation(linear, np.arange(len(linear.keys)))


def fit(problem: WindowedProblem, h: Hypothesis) -> Fitted | None:
    """Fit a hypothesis from its own values and the measured initial velocities, with its noise;
    None where it cannot be simulated."""
    begin = linearise(problem, h, problem.measured_starts(), np.full(6, FIRST_NOISE))
    return None if begin is None else _with_noise(_gauss_newton(begin))


def refit(
    h: Hypothesis,
    start: Linearisation,
    iterations: int = _ITERATIONS,
    update_noise: bool = False,
    known: Hypothesis | None = None,
) -> Fitted | None:
    """Fit a hypothesis on the windows of ``start``, from its initial velocities and its noise; None
    where it cannot be simulated. ``known``: the same parameters with other values, from which the
    fit begins if these are likelier."""
    begins = [_adapted(values, start) for values in (h, known) if values is not None]
    begin = min(filter(None, begins), key=lambda x: x.rss, default=None)
    if begin is None:
        return None
    if begin.rss > start.rss:
        begin = _measured_where_better(begin)
    fitted = _gauss_newton(begin, iterations)
    return _with_noise(fitted) if update_noise else fitted


def _with_noise(fitted: Fitted) -> Fitted:
    """Noise and parameters estimated in turn until the noise settles."""
    problem = fitted.linearisation.problem
    for _ in range(_NOISE_UPDATES):
        h, before = fitted.hypothesis, fitted.linearisation
        noise = before.residual_std()
        starts = _without_strays(problem, before.starts, noise)
        settled = np.abs(np.log(noise / fitted.noise)).max() < _NOISE_SETTLED
        settled = settled and starts is before.starts
        again = linearise(problem, h, starts, noise)
        if again is None:  # from where it was it can be simulated
            again = linearise(problem, h, before.starts, noise)
        assert again is not None
        if settled:
            return Fitted(h, again, fitted.converged)
        fitted = _gauss_newton(again)
    return fitted


def _gauss_newton(linearisation: Linearisation, iterations: int = _ITERATIONS) -> Fitted:
    """Gauss-Newton with step shortening at fixed noise."""
    h, problem = linearisation.hypothesis, linearisation.problem
    precision = problem.precision(h)
    mean = np.array([centre(h.config, key) for key in h.keys])
    for _ in range(iterations):
        linear = linearisation.linear
        inflation = _inflation(linear)
        prior = inflation * precision
        value = np.array(list(h.values.values()))
        slope = linear.gradient.sum(axis=0) + prior * (mean - value)
        change = solve_bounded(linear.normal + np.diag(prior), slope, *step_limits(h, h.keys))
        least = max(_TOLERANCE * linear.count, _SETTLED * inflation)
        if slope @ change < least:
            return Fitted(h, linearisation, True)
        cost = linearisation.rss + prior @ (mean - value) ** 2
        factor = 1.0
        while factor > _SHORTEST:
            there = h.at(dict(zip(h.keys, (value + factor * change).tolist(), strict=True)))
            starts = linearisation.starts_after(factor * change, factor)
            # outliers are those from where the step began: another one would count as a loss
            good = linearisation.good
            found = linearise(problem, there, starts, linearisation.noise, good=good)
            if found is not None:
                new = found.rss + prior @ (mean - value - factor * change) ** 2
                if new < cost:
                    break
            factor *= _STEP_FACTOR
        else:
            return Fitted(h, linearisation, True)
        assert found is not None
        h, linearisation = there, found.judged_anew()
        if cost - new < least:
            return Fitted(h, linearisation, True)
    return Fitted(h, linearisation, False)


def _without_strays(problem: WindowedProblem, starts: Array, noise: Array) -> Array:
    """Initial velocities (W, 6); those far from the measured ones are measured again: where a
    vehicle tumbles, a poor model can push one so far that a better model does not find the way
    back."""
    measured = problem.measured_starts()
    far: Array = np.max(np.abs(starts - measured) / noise, axis=1, keepdims=True)
    return np.where(far > _STRAY, measured, starts) if far.max() > _STRAY else starts


def _measured_where_better(begin: Linearisation) -> Linearisation:
    """The same from measured initial velocities in the windows that these simulate better: those
    that suit a poor model can make a better one tumble."""
    problem, h = begin.problem, begin.hypothesis
    measured = linearise(problem, h, problem.measured_starts(), begin.noise)
    if measured is None:
        return begin
    better = measured.of_windows < begin.of_windows
    starts = np.where(better[:, None], measured.starts, begin.starts)
    mixed = linearise(problem, h, starts, begin.noise) if better.any() else None
    return begin if mixed is None or mixed.rss > begin.rss else mixed


def _adapted(h: Hypothesis, start: Linearisation) -> Linearisation | None:
    """A hypothesis simulated after the parameters it shares with ``start`` have been refitted
    (linearly) to those that are new or gone: a drag term that joins or leaves else throws the
    simulation far off, or into another minimum."""
    before, problem = start.hypothesis, start.problem
    added = [k for k in h.keys if k not in before.values]
    linear_in = [k for k in (*before.keys, *added) if role_of(k) == "amplitude"]
    moves = {k: d for k in linear_in if (d := h.value(k) - before.value(k)) != 0.0}
    begin = _without_strays(problem, start.starts, start.noise)
    if not moves:
        return linearise(problem, h, begin, start.noise)
    linear = start.linear
    if added:
        without = before.shaped(h.constants).having(
            {k: (before if k in linear_in else h).value(k) for k in added}
        )
        linear = start.having(added, start.sensitivity_of(without, added))
    follow = [k for k in before.keys if h.values.get(k) == before.values[k]]
    at, moved = linear.index(follow), linear.index(moves)
    far = np.array(list(moves.values()))
    slope = linear.gradient.sum(axis=0)
    normal = linear.normal[np.ix_(at, at)]
    change = np.zeros(len(linear.keys))
    change[moved] = far
    prior = _inflation(start.linear) * problem.precision(before)
    change[at] = solve_bounded(
        normal + np.diag(prior[start.linear.index(follow)]),
        slope[at] - linear.normal[np.ix_(at, moved)] @ far,
        *step_limits(h, follow),
    )
    there = h.having({k: h.values[k] + change[i] for k, i in zip(follow, at, strict=True)})
    starts = start.starts_after(change[: len(before.keys)])
    starts = _without_strays(problem, starts, start.noise)
    adapted = linearise(problem, there, starts, start.noise)
    predicted = start.rss - 2.0 * slope @ change + change @ linear.normal @ change
    if adapted is not None and adapted.rss < _UNPREDICTED * predicted:
        return adapted
    both = (adapted, linearise(problem, h, begin, start.noise))
    return min(filter(None, both), key=lambda x: x.rss, default=None)


def step_limits(h: Hypothesis, keys: Sequence[Key]) -> tuple[Array, Array]:
    """How far parameters may move in one step, downwards and upwards."""
    value = np.array([h.values[k] for k in keys])
    lower, upper = np.array([bounds(k)[1:] for k in keys]).reshape(-1, 2).T
    limit = np.array([largest_step(k) for k in keys])
    return np.maximum(lower - value, -limit), np.minimum(upper - value, limit)


def solve_bounded(normal: Array, slope: Array, lower: Array, upper: Array) -> Array:
    """The change that solves ``normal change = slope`` within bounds (active set)."""
    free = np.ones(len(slope), dtype=bool)
    change = np.zeros(len(slope))
    for _ in range(len(slope)):
        rest = slope - normal[:, ~free] @ change[~free]
        change[free] = scaled_solve(normal[np.ix_(free, free)], rest[free], 1e-10)
        beyond = free & ((change < lower) | (change > upper))
        if not beyond.any():
            break
        change[beyond] = np.clip(change[beyond], lower[beyond], upper[beyond])
        free &= ~beyond
    return change


def with_best_onsets(
    fitted: Fitted,
    keys: Container[Key] | None = None,
    around: float = _ONSET_RANGE,
    every: float = _ONSET_EVERY,
) -> Fitted:
    """The same with the best onset near by, of all effects or of these parameters, ``every`` so
    many seconds ``around`` it: between two windows no gradient tells how to move it."""
    for key in onsets(fitted.hypothesis):
        if keys is not None and key not in keys:
            continue
        now = fitted.hypothesis.values[key]
        trials = round(around / every)
        near = np.maximum(now + every * np.arange(-trials, trials + 1), 0.0).tolist()
        best = near[int(np.argmin(_rss_at(fitted, key, near)))]
        if best != now:
            there = fitted.hypothesis.having({key: best})
            again = refit(there, fitted.linearisation)
            if again is not None and again.rss < fitted.rss:
                fitted = again
        fitted = _between_records(fitted, key)
    return fitted


def _between_records(fitted: Fitted, key: Key) -> Fitted:
    """The same with an onset at the beginning of a record, where no window that is fitted lies
    between: the data do not tell the two apart, and what is there throughout one record and not
    in the last was taken up on deck, not in the last seconds of the dive, which are held out."""
    problem, now = fitted.linearisation.problem, fitted.hypothesis.values[key]
    first, last = problem.steps.t[problem.first], problem.steps.t[problem.last]
    begins = first[1:][first[1:] - last[:-1] >= PAUSE]
    for begin in begins.tolist():
        low, high = sorted((now, begin))
        if now != begin and not ((last > low) & (first < high)).any():
            there = linearise(
                problem,
                fitted.hypothesis.having({key: begin}),
                fitted.linearisation.starts,
                fitted.noise,
            )
            return fitted if there is None else Fitted(there.hypothesis, there, fitted.converged)
    return fitted


def onset_std(fitted: Fitted, key: Key) -> float:
    """Standard deviation [s] of an onset, from the likelihood ratio: its residuals are far from
    quadratic, flat between windows and steep where thrust steps."""
    now, limit = fitted.hypothesis.values[key], _ONSET_RSS * fitted.inflation

    def is_excluded(onset: float) -> bool:
        base, there = _rss_at(fitted, key, [now, onset]).tolist()
        return bool(there >= base + limit)

    ends = []
    for side in (-1.0, 1.0):
        near, far = 0.0, ONSET_STEP
        while far < _ONSET_UNKNOWN and not is_excluded(now + side * far):
            near, far = far, 2.0 * far
        for _ in range(4):  # bisection: to a sixteenth of the distance
            middle = 0.5 * (near + far)
            near, far = (near, middle) if is_excluded(now + side * middle) else (middle, far)
        ends.append(far)
    return max(ends) / np.sqrt(_ONSET_RSS)


def _rss_at(fitted: Fitted, key: Key, onsets: Sequence[float]) -> Array:
    """Squared residuals (n,) with an onset at other times and the other parameters refitted, all
    linearly: within a window, an effect that begins a little earlier or later moves the vehicle
    little."""
    line, h, linear = fitted.linearisation, fitted.hypothesis, fitted.linear
    later = [h.having({key: onset}).effects for onset in onsets]
    change = [line.problem.change(h, line.motion, EFFECTS[key[0]], of) for of in later]
    left = line.error[:, None] - line.sensitivity_to(np.stack(change, axis=2))
    others = linear.index(k for k in linear.keys if k != key)
    slope = line.columns[:, others].T @ left
    refitted = scaled_solve(linear.normal[np.ix_(others, others)], slope, 1e-6)
    rss: Array = np.sum(left**2, axis=0) - np.sum(slope * refitted, axis=0)
    return rss
