"""Offline fits of an archive: least squares, instrumental variables, maximum likelihood.

All channels together, or channel by channel: then the other components of the motion are as
measured, a channel whose open-loop simulation is good already is left alone, and one that the
motion does not show is refused, with the reason (Zhao et al. 2018).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.config.prior import (
    ONE_AXIS,
    Prior,
    attitude_covariance,
    covariance_beyond_driving,
    first_centre,
    gain_of,
    prior_of,
    rigid_body_covariance,
)
from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array
from rov_ident.core.progress import Progress, silent
from rov_ident.core.states import CONTRADICTED, IDENTIFIABLE, State, of_fit
from rov_ident.core.whiteness import JUDGED_TIME
from rov_ident.estimation.consistency import CAUSE, Test, consistency_of, worst_of
from rov_ident.estimation.physical import Estimate, physical
from rov_ident.estimation.shared import too_noisy
from rov_ident.model.coefficients import MOTIONS, VELOCITIES, Coefficient
from rov_ident.model.equations import RigidBody
from rov_ident.model.scales import authority
from rov_ident.offline import constancy, least_squares, maximum_likelihood, missing_terms, newton
from rov_ident.offline.archive import Archive, ReadBag, Samples, total
from rov_ident.offline.fit import Fit
from rov_ident.offline.prediction_error import OpenLoop, by_chance, curves, open_loop
from rov_ident.reports.result import NORMAL, provenance
from rov_ident.reports.table import with_unit
from rov_ident.sampling.records import HORIZON, UNITS, numbers
from rov_ident.sampling.sample import free_axes, thrust_axes
from rov_ident.sampling.without_velocity import is_impossible, is_without_velocity, refusal

KINDS = ("ls", "iv", "ml")

_MOVES = 2.0  # times the noise of its measurement, rms: then three quarters of the power are motion
_GOOD = 0.03  # a choice: open-loop error relative to the motion with which a channel is left alone,
_NOISY = 1.5  # or relative to the noise of what it is compared with
AT_REST = 0.05  # of the axis's working wrench, rms: a smaller wrench is that of keeping station
DRIVEN_UNSEEN = (
    "surge or sway is driven, and no velocity is measured: how fast it goes is unknown, and so are "
    "the moments and the depth that follow from it; drive heave, roll, pitch and yaw while surge "
    "and sway rest (or record a DVL)"
)
_NO_PRIOR = 1e-6  # precision that keeps what no data reach from being anything


@dataclass(frozen=True)
class Settings:
    """How a fit is made.

    ``stages``: channels, fitted one group after the other; none: all together. ``prior``: whether
    what the configuration says of the coefficients counts as one more measurement. ``weighted``:
    least squares weighs each axis by its residual. ``process``: maximum likelihood allows for
    errors of the wrench. ``readings``: at most so often bags are read for parameters of effects.
    ``unmeasured``: no bag has a linear velocity, which :func:`fit_batch` finds out.
    """

    stages: tuple[tuple[str, ...], ...] = ()
    prior: bool = True
    weighted: bool = True
    process: bool = True
    readings: int = 4
    unmeasured: bool = False


class _Stage(NamedTuple):
    names: tuple[str, ...]
    values: Array
    asked: Array  # as values, but beyond their bounds where the data would go there
    covariance: Array
    states: dict[str, State]
    more: dict[str, Any]
    unexplained: Array  # (6,): as consistency_of takes it
    lasting: Array  # (6,), too
    reading_noise: Array  # (6,), too
    noise: maximum_likelihood.Noise | None = None
    slope: Array = np.zeros((2, 0))  # (2, n): as that of a Likelihood
    missing: tuple[Test, ...] = ()


def fit_batch(
    archive: Archive,
    config: Config,
    kind: str,
    settings: Settings | None = None,
    say: Progress = silent,
) -> Fit:
    """Fit an archive.

    ``kind`` is one of KINDS.

    Raises UserError if a channel has no coefficient to estimate, or the configured model cannot be
    simulated.
    """
    config, settings = _as_measured(archive, config, kind, settings or Settings())
    say("open loop, as configured")
    read, given = archive, config
    before = open_loop(read, given)
    notes = list(archive.notes)
    effects = kind == "ml" and not settings.stages
    config = config.with_nuisance if effects else config
    prior = prior_of(config, effects)
    values, asked, covariance = prior.mean.copy(), prior.mean.copy(), np.diag(prior.std**2)
    states = dict.fromkeys(prior.names, State.HELD)
    unexplained, lasting = np.full((2, 6), np.nan)
    reading_noise = np.zeros(6)
    constant: list[Test] = []
    now, parts = config, []
    for stage in settings.stages or (MOTIONS,):
        found: _Stage | None
        if effects and config.estimate_effects:
            archive, found = _relinearised(archive, config, kind, settings, notes, say)
        else:
            found = _stage(archive, now.with_effects_held, kind, stage, settings, notes, say)
        if found is None:
            continue
        at = np.array([prior.names.index(name) for name in found.names])
        values[at], asked[at] = found.values, found.asked
        states.update(found.states)
        covariance[np.ix_(at, at)] = found.covariance
        unexplained = np.where(np.isnan(found.unexplained), unexplained, found.unexplained)
        lasting = np.where(np.isnan(found.lasting), lasting, found.lasting)
        reading_noise = np.maximum(reading_noise, found.reading_noise)
        constant += [*_of_constancy(config, prior, found), *found.missing]
        now = now.with_values(dict(zip(found.names, found.values.tolist(), strict=True)))
        parts.append({"channels": list(stage), **found.more} if settings.stages else found.more)
    say("open loop, fitted")
    judged = read.as_read_by(now, config)
    after = open_loop(judged, now)
    chance = by_chance(judged, now, prior.names, covariance, list(states.values()))
    if sum(archive.each(_time_in_motion)) <= JUDGED_TIME:
        unexplained = np.full(6, np.nan)  # not known yet, as to the recursive estimators
    sensors = worst_of(bag.contradictions for bag in judged.bags)
    std = np.sqrt(np.diag(covariance)) if kind == "ml" else None
    consistency = consistency_of(
        config, prior, asked, unexplained, lasting, sensors, std, reading_noise
    )
    consistency = consistency.with_open_loop(before.rmse, after.rmse, chance)
    consistency = replace(consistency, tests=(*consistency.tests, *constant))
    if settings.unmeasured:
        forces = np.sqrt(np.mean(archive.each(_mean_square_wrench), axis=0))
        driven = float(np.max((forces / authority(config.dynamics))[:2]))
        rest = Test("surge and sway at rest", driven, AT_REST, DRIVEN_UNSEEN)
        consistency = replace(consistency, tests=(*consistency.tests, rest))
    covariance = consistency.widened(covariance, prior.std, values - prior.mean)
    removed = 1.0 - np.diag(covariance) / prior.std**2
    motion = archive.each(_velocity_range)
    low, high = np.min(motion, axis=0)[0], np.max(motion, axis=0)[1]
    more: dict[str, Any] = {
        "open_loop_before": {"horizon_s": HORIZON, "rmse": numbers(before.rmse)},
        "range": {n: [a, b] for n, a, b in zip(VELOCITIES, low.tolist(), high.tolist())},
    }
    more |= {"stages": parts} if settings.stages else parts[0]
    return Fit(
        estimator=kind,
        names=prior.names,
        units=prior.units,
        values=values,
        covariance=covariance,
        states=consistency.of_states(states.values(), removed),
        given=config,
        fitted=now,
        samples=archive.samples,
        duration=archive.duration,
        rmse=after.rmse,
        consistency=consistency,
        provenance=provenance(((b.path.name, b.sha256) for b in archive.bags), vehicle=config.name),
        notes=tuple(notes),
        more=more,
        curves=curves(read.bags, before, after),
        has_thrust=bool(np.any(archive.each(thrust_axes))),
    )


def _as_measured(
    archive: Archive, config: Config, kind: str, settings: Settings
) -> tuple[Config, Settings]:
    """Configuration and settings, of bags without linear velocity those for such. Raises UserError
    where another fit of these than all channels by maximum likelihood is asked for, or only some of
    the bags lack it."""
    unmeasured = [bag for bag, so in zip(archive.bags, archive.each(is_without_velocity)) if so]
    if not unmeasured:
        return config, settings
    if kind != "ml" or settings.stages:
        raise refusal(unmeasured[0].path.name)
    if len(unmeasured) < len(archive.bags):
        raise UserError(
            f"{unmeasured[0].path.name} has no linear velocity, and other bags have: fit those "
            "with and those without apart (the one result as the other's configuration)"
        )
    # of a horizontal current nothing shows, and no velocity is late or scaled
    odometry = replace(config.odometry, latency_std=0.0, scale_std=0.0)
    config = replace(config, current_std=0.0, odometry=odometry)
    return config, replace(settings, readings=2 * settings.readings, unmeasured=True)


def _relinearised(
    archive: Archive, config: Config, kind: str, settings: Settings, notes: list[str], say: Progress
) -> tuple[Archive, _Stage]:
    """A fit with parameters of effects, and the archive as they have it.

    Samples are linear in these about the values with which they were made: the bags are read anew
    until the estimate stays where they were.
    """
    first = len(config.estimate)
    found: _Stage | None = None
    centre, model = first_centre(config), config.model
    while True:
        told: list[str] = []
        about = config.with_model(model).with_values(centre)
        samples = archive.reread(about, True)
        found = _stage(
            samples, config, kind, MOTIONS, settings, told, say, found, about.dynamics.body
        )
        assert found is not None
        before = np.array(list(centre.values()))
        settings = replace(settings, readings=settings.readings - 1)
        std = np.sqrt(np.diag(found.covariance))[first:]
        # what is left out is of second order in this
        moved = np.abs(found.values[first:] - before) >= 0.3 * std
        if settings.readings == 0 or not moved.any():
            if moved.any():
                which = ", ".join(n for n, far in zip(centre, moved.tolist(), strict=True) if far)
                told.append(f"{which} not settled: begin with a configuration that is nearer")
            notes += told
            return samples, found
        centre = dict(zip(centre, found.values[first:].tolist(), strict=True))
        model = model.with_values(dict(zip(found.names[:first], found.values[:first].tolist())))


def _stage(
    archive: Archive,
    config: Config,
    kind: str,
    channels: Sequence[str],
    settings: Settings,
    notes: list[str],
    say: Progress,
    before: _Stage | None = None,
    body: RigidBody | None = None,
) -> _Stage | None:
    """Fit some channels; None, and a note, where there is nothing to do.

    Maximum likelihood begins with what was found ``before``, where there is that; ``body`` is the
    one about which samples are linear (None: as configured).
    """
    free = np.array([axis in channels for axis in MOTIONS])
    name = ", ".join(channels)
    chosen = _with_estimated(archive, config, name, free, settings, notes, say)
    if chosen is None:
        return None
    config, names = chosen, chosen.estimate
    free &= np.any(archive.each(free_axes), axis=0)
    coefficients, prior = prior_of(config), prior_of(config, effects=True)
    precision = 1.0 if settings.prior else _NO_PRIOR

    def of_stage(what: str, share: float | None = None) -> None:
        say(f"{name}: {what}" if settings.stages else what, share)

    if settings.unmeasured:  # as far as it is simulated, the motion tells least squares nothing
        scale = np.outer(coefficients.std, coefficients.std)
        information = scale * predicted_information(archive, config.with_effects_held, free)
        least = Estimate(names, coefficients.mean, np.diag(coefficients.std**2), 0.0)
    else:
        solution = least_squares.solve(
            archive.each,
            config,
            free,
            instrumental=kind == "iv",
            weighted=settings.weighted,
            precision=precision,
            say=of_stage,
        )
        information = solution.information
        least = Estimate(names, solution.values, solution.covariance, 0.0)
    base = least_squares.base_parameters(names, information, coefficients.std)
    more: dict[str, Any] = {"base_parameters": _described(base)}
    found, covariance, asked = least.values, least.covariance, least.values
    noise = None
    unexplained, lasting = np.full((2, 6), np.nan)
    reading_noise, slope = np.zeros(6), np.zeros((2, 0))
    missing: tuple[Test, ...] = ()
    if kind == "ml":
        if before is not None:
            start, noise = before.values, before.noise
        else:
            start = _start(archive, config, coefficients, least, free)
        first = dict(zip(names, start.tolist(), strict=False))
        likelihood = maximum_likelihood.maximise(
            archive.each,
            config,
            replace(config.model, body=body or config.dynamics.body).with_values(first),
            free,
            precision / prior.std**2,
            settings.process,
            of_stage,
            start[len(names) :],
            noise,
        )
        names = prior.names
        found, covariance, noise = likelihood.values, likelihood.covariance, likelihood.noise
        asked, by_axis = likelihood.asked, likelihood.by_axis
        unexplained[free] = (np.sqrt(noise.floor) / authority(config.dynamics))[free]
        unexplained[:2] = np.nan if settings.unmeasured else unexplained[:2]
        lasting[free] = likelihood.lasting[free]
        reading_noise, slope = likelihood.reading_noise, likelihood.slope
        missing = missing_terms.tests_of(config.dynamics, likelihood.missing)
        more |= _numbers_of(likelihood, names, free)
        if likelihood.held.any():
            waiting = ", ".join(n for n, held in zip(names, likelihood.held, strict=True) if held)
            notes.append(f"{waiting} held: {too_noisy(reading_noise > 0.0)}")
        if not likelihood.converged:
            notes.append(f"{name}: the iteration did not settle: give a better configuration")
    gain = gain_of(covariance, prior.std) if settings.prior else None
    covariance = covariance + rigid_body_covariance(config, names, found, gain)
    covariance = covariance + attitude_covariance(config, names, archive.duration, gain)
    if kind != "ml":  # least squares takes the configured thrust for the true one
        unexplained[free] = (solution.lasting / authority(config.dynamics))[free]
        of_thrust = config.wrench.scale_std * solution.by_thrust
        by_axis = np.column_stack([of_thrust.sum(axis=1), ONE_AXIS * of_thrust])
    beyond_driving = covariance_beyond_driving(config, names, found, gain, by_axis)
    if settings.unmeasured:
        # What moments and tilt suggest of these is in the values; the intervals are the prior's.
        impossible = [n for n, c in _coefficients(config).items() if is_impossible(c)]
        for i in (names.index(n) for n in impossible):
            covariance[i] = covariance[:, i] = beyond_driving[i] = beyond_driving[:, i] = 0.0
            covariance[i, i] = prior.std[i] ** 2
        more["impossible"] = impossible
    estimate = Estimate(names, found, covariance, 0.0)
    values, states = _physical_states(config, prior, estimate, notes)
    unknown = [n for n in base.unidentified if states[n] is State.HELD]
    if unknown and not settings.stages:
        notes.append("the motion does not tell apart or does not show: " + ", ".join(unknown))
    if free[0] and not np.any(archive.each(thrust_axes), axis=0)[0]:
        notes += _scale_notes(config, names, covariance)
    return _Stage(
        names, values, asked, covariance + beyond_driving, states, more, unexplained, lasting,
        reading_noise, noise, slope, missing,
    )  # fmt: skip


def _with_estimated(
    archive: Archive,
    config: Config,
    name: str,
    free: NDArray[np.bool_],
    settings: Settings,
    notes: list[str],
    say: Progress,
) -> Config | None:
    """The configuration that estimates the coefficients of the axes ``free`` (6,), which are called
    ``name``; of a fit in stages those that the motion shows. None, and a note, where a channel is
    left alone."""
    # an added mass belongs to both axes that it couples
    names = tuple(
        n
        for n, c in _coefficients(config).items()
        if free[c.row] and (not c.is_added_mass or free[c.column])
    )
    if not names:
        raise UserError(f"no coefficient of {name} is among those to estimate (key `estimate`)")
    config = replace(config, estimate=names)
    if not settings.stages:
        return config
    if good := _is_good(archive, config, free):
        notes.append(f"{name}: left alone, {good}")
        return None
    say(f"{name}: excitation")
    known, reason = _excited(archive, config, free)
    if not known:
        notes.append(f"{name}: not fitted, {reason}")
        return None
    if held := [n for n in names if n not in known]:
        notes.append(f"{name}: {', '.join(held)} held, {reason}")
    return replace(config, estimate=known)


def _physical_states(
    config: Config, prior: Prior, estimate: Estimate, notes: list[str]
) -> tuple[Array, dict[str, State]]:
    """The values of a passive hull (n,) nearest to an estimate, and the states by name; and a note
    on each coefficient for which the data ask for more."""
    values = physical(config.dynamics, prior, estimate)
    removed = 1.0 - np.diag(estimate.covariance) / prior.std**2
    states = {}
    for i, name in enumerate(estimate.names):
        asked = estimate.values[i]
        at_bound = bool(abs(asked - values[i]) > CONTRADICTED * estimate.std[i])
        if at_bound:
            notes.append(
                f"{name}: the data ask for {asked:.4g}, which no passive hull has beside the other "
                f"coefficients; {values[i]:.4g} is kept"
            )
        states[name] = of_fit(
            values[i], estimate.std[i], prior.std[i], bool(removed[i] > IDENTIFIABLE), at_bound
        )
    return values, states


def _scale_notes(config: Config, names: Sequence[str], covariance: Array) -> list[str]:
    """A note where only speeds are measured, and not the thrust: with m - X_udot, thrust and drag
    times any number the motion is the same."""
    there = _coefficients(config)
    own = [n for n, c in there.items() if c.row == 0 and "n" in c.inputs]
    if not own or "X_udot" not in names:
        return []
    i = names.index("X_udot")
    known = NORMAL * float(np.sqrt(covariance[i, i]))
    share = 100.0 * known / (config.model.body.mass - config.model.values["X_udot"])
    return [
        "speeds tell thrust and drag only relative to the inertia, whose X_udot is known to "
        f"± {known:.2g} kg (95 %): by {share:.1f} % {', '.join(own)} and the drag may be off "
        "together, which a known X_udot or a bollard pull settles (coast-down --bollard)"
    ]


def _of_constancy(config: Config, prior: Prior, found: _Stage) -> list[Test]:
    """Whether nuisance parameters stay the same throughout each record; but for the centre of
    gravity, which an attitude that wanders for longer than a stretch seems to move."""
    supposed = {".".join(key) for key in config.nuisance_std if key[0] != "cog_offset"}
    units = dict(zip(prior.names, prior.units, strict=True))
    return [
        Test(
            f"constancy of {name}", abs(t), constancy.UNLIKELY,
            f"{name} is taken for constant, but changes by "
            f"{with_unit(f'{change:.2g}', units[name])} during a record: {CAUSE}",
        )
        for name, t, change in zip(found.names, *found.slope.tolist())
        if name in supposed and t != 0.0
    ]  # fmt: skip


def _start(
    archive: Archive, config: Config, prior: Prior, found: Estimate, free: NDArray[np.bool_]
) -> Array:
    """The values to begin with: as configured, or as found by least squares if that does better."""
    noise, none = maximum_likelihood.assumed(config), np.zeros(0, dtype=np.int64)
    effects = prior_of(config, effects=True).mean[len(config.estimate) :]
    values = (prior.mean, physical(config.dynamics, prior, found))
    costs = [
        total(
            archive.each(maximum_likelihood.one_pass, model, none, noise, free, np.inf, effects)
        ).cost
        for model in (
            config.dynamics.with_values(dict(zip(prior.names, v.tolist(), strict=True)))
            for v in values
        )
    ]
    return np.append(values[int(costs[1] < costs[0])], effects)


def _coefficients(config: Config) -> dict[str, Coefficient]:
    """Those to estimate, by name."""
    all_ = dict(zip(config.model.names, config.model.coefficients, strict=True))
    return {name: all_[name] for name in config.estimate}


def _is_good(archive: Archive, config: Config, free: NDArray[np.bool_]) -> str:
    """Why a channel needs no fit, in words, or nothing."""
    rmse = open_loop(archive, config, free).rmse[free]
    size, noise = _sizes(archive)
    share = rmse / np.maximum(size[free], 1e-9)
    if np.all((share < _GOOD) | (rmse < _NOISY * noise[free])):
        worst = 100.0 * float(np.max(share))
        return f"its open-loop error is at most {worst:.1f} % of the motion, or noise"
    return ""


def _excited(
    archive: Archive, config: Config, free: NDArray[np.bool_]
) -> tuple[tuple[str, ...], str]:
    """Names of the coefficients that the motion shows, and why not the others."""
    prior = prior_of(config)
    information = predicted_information(archive, config, free)
    covariance = newton.inverse_of(information + np.diag(prior.std**-2.0))
    std = np.sqrt(np.diag(covariance))
    size, noise = _sizes(archive)
    # A wrong trim alone makes the prediction move where the vehicle does not: look at it, too.
    moved_by = [c.column if c.is_added_mass else c.velocity for c in _coefficients(config).values()]
    known = std**2 < (1.0 - IDENTIFIABLE) * prior.std**2
    known &= (size > _MOVES * noise)[moved_by]
    uncertain = ", ".join(
        f"{n} ± {NORMAL * s:.2g} {u} (95 %)"
        for n, s, u, k in zip(prior.names, std, prior.units, known, strict=True)
        if not k
    )
    moved = ", ".join(
        f"{axis} moves {size[i]:.2g} {UNITS[i]}" for i, axis in enumerate(MOTIONS) if free[i]
    )
    return tuple(np.array(prior.names)[known].tolist()), (
        f"the motion does not show it: it would be known to {uncertain} ({moved} rms); drive it "
        "harder, in both directions"
    )


def predicted_information(
    archive: Archive, config: Config, free: NDArray[np.bool_] | None = None
) -> Array:
    """Information (n, n) about the coefficients to estimate that the bags' motion holds, at the
    configured values and noise."""
    estimated = prior_of(config).estimated
    noise = maximum_likelihood.assumed(config, maximum_likelihood.LIKELY)
    parts = archive.each(maximum_likelihood.one_pass, config.dynamics, estimated, noise, free)
    return total(parts).information


def _mean_square_wrench(samples: Samples) -> Array:
    """(6,) over the samples."""
    return np.mean(samples["wrench"] ** 2, axis=0)


def _time_in_motion(samples: Samples) -> float:
    """Seconds in which any velocity is above the noise of its sensor."""
    return float(samples["dt"][(samples["moving"] != 0).any(axis=1)].sum())


def _velocity_range(samples: Samples) -> tuple[Array, Array]:
    """Where the motion is for all but a thousandth of the time, either side."""
    low, high = np.quantile(samples["nu"], [0.001, 0.999], axis=0)
    return low, high


def _sizes(archive: Archive) -> tuple[Array, Array]:
    """Root mean square (6,) over the bags of what :func:`_size` gives."""
    size, noise = (np.sqrt(np.mean(np.square(x), axis=0)) for x in zip(*archive.each(_size)))
    return size, noise


def _size(samples: Samples) -> tuple[Array, Array]:
    """Root mean square (6,) of the motion, and of the noise of its measurement."""
    noise = np.sqrt(np.mean(samples["odometry_variance"], axis=0))
    if np.isfinite(samples["gyro"]).any():
        noise[3:] = np.sqrt(np.mean(samples["gyro_variance"]))
    return np.sqrt(np.mean(samples["nu"] ** 2, axis=0)), noise


def validation(bags: Sequence[ReadBag], before: OpenLoop, after: OpenLoop) -> dict[str, Any]:
    """RMSE of the open-loop simulation on bags that no fit has seen, with one configuration and
    another, for the JSON of a fit."""
    return {
        "horizon_s": HORIZON,
        "rmse_before": numbers(before.rmse),
        "rmse": numbers(after.rmse),
        "bags": [{"file": bag.path.name, "sha256": bag.sha256} for bag in bags],
    }


def _described(base: least_squares.BaseParameters) -> dict[str, Any]:
    """Which combinations the data identify, for the JSON of a fit."""
    return {
        "identifiable": [str(c) for c in base.combinations],
        "unidentified": list(base.unidentified),
        "not_excited": list(base.unexcited),
        "condition": base.condition if np.isfinite(base.condition) else None,
        "collinear": [{"pair": [a, b], "cosine": c} for a, b, c in base.collinear],
    }


def _numbers_of(
    found: maximum_likelihood.Likelihood, names: Sequence[str], free: NDArray[np.bool_]
) -> dict[str, Any]:
    """Bound, noise and course of a maximum-likelihood fit, for its JSON."""
    bound = np.sqrt(np.diag(found.bound))
    return {
        "cramer_rao_std": dict(zip(names, bound.tolist(), strict=True)),
        "noise": _noise(found.noise, free),
        "cost": found.total.cost,
        "iterations": found.iterations,
        "outliers": found.total.outliers,
    }


def _noise(n: maximum_likelihood.Noise, free: NDArray[np.bool_]) -> dict[str, Any]:
    axes = [a for a, f in zip(VELOCITIES, free, strict=True) if f]
    factor = np.sqrt(n.measurement[free])
    floor = np.sqrt(n.floor[free] / n.correlation_time)
    return {
        "measurement_factor": dict(zip(axes, factor.tolist(), strict=True)),
        "wrench_floor": dict(zip(axes, floor.tolist(), strict=True)),
        "wrench_relative": n.relative,
    }
