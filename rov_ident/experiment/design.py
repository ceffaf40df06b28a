"""Which manoeuvre to run next: safe, and best for the coefficient that is known worst.

Candidates (`closed_loop_manoeuvres`) are simulated with the present coefficients, and with some
that their uncertainty allows; those that leave the tank are made smaller. The information that each
adds is predicted along its simulated motion, and the one after which the worst coefficient is known
best is proposed. As in a fit, what no vehicle's file knows (thrust scale, lag, current, trim) is
estimated beside the coefficients, and what no driving tells is left out of the choice.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rov_ident.config import Config
from rov_ident.config.prior import (
    axis_std_of,
    covariance_beyond_driving,
    first_centre,
    gain_of,
    prior_of,
    rigid_body_covariance,
    theta_of,
    typical,
)
from rov_ident.core.errors import UserError
from rov_ident.core.progress import Progress, silent
from rov_ident.estimation.physical import is_passive
from rov_ident.experiment import closed_loop_manoeuvres
from rov_ident.experiment.closed_loop_manoeuvres import AlternatingTargets, Flight, Limits
from rov_ident.experiment.data_quality import Prospect, prospects
from rov_ident.io.write_messages import write_messages
from rov_ident.model.coefficients import parse
from rov_ident.model.equations import Array
from rov_ident.model.thruster_allocation import is_known
from rov_ident.offline.archive import Archive, total
from rov_ident.offline.maximum_likelihood import LIKELY, assumed, with_thrust_errors
from rov_ident.offline.newton import inverse_of
from rov_ident.reports.result import NORMAL, Figure, Shown, as_json
from rov_ident.reports.table import PLUS_MINUS, Table
from rov_ident.sampling.records import samples_of
from rov_ident.sampling.sample import joined
from rov_ident.sampling.smoothing import smoothed
from rov_ident.sampling.without_velocity import is_impossible, is_without_velocity
from rov_ident.simulation.virtual_sensors import Dive, Suite

__all__ = ["Limits", "Proposal", "propose"]

_TILT = 1.0  # rad; a vehicle must not lean further: the attitude of many filters fails near 90 deg
_DRAWS = 8  # vehicles within the present uncertainty, for which a manoeuvre must be safe as well:
# nine safe of nine exclude, at 95 %, that more than 28 % of such vehicles leave the tank
_SHRINK = 0.75  # of a manoeuvre that is not safe; seven times until it is the smallest
_SMALLEST = 0.15  # of the size in the library: smaller ones move a vehicle hardly more than noise
_SHORTEST = 10.0  # s; as long as the predictions by which models are judged (HORIZON)
_SHOWN = 0.99  # of the present uncertainty: more than that left is as good as nothing learnt
_OTHERS = 0.05  # weight of the mean over all coefficients, which decides where the worst is alike


@dataclass(frozen=True)
class Candidate:
    """A safe manoeuvre and the information that it is predicted to add (:func:`information_of`)."""

    manoeuvre: AlternatingTargets
    flight: Flight
    information: Array
    duration: float
    limits: Limits

    def dive(self, config: Config, seed: int = 0) -> Dive:
        """Simulate it on a vehicle."""
        return closed_loop_manoeuvres.dive(
            config, self.manoeuvre, self.duration, self.limits, Suite(), seed
        )


@dataclass(frozen=True)
class Proposal(Shown):
    """The best candidate, what is known before it and what is predicted after it, but for what no
    driving tells: the standard deviations ``beyond_driving``, which a fit adds."""

    config: Config = field(repr=False)
    best: Candidate
    worst: str
    before: tuple[Prospect, ...]
    after: tuple[Prospect, ...]
    beyond_driving: tuple[float, ...]
    others: tuple[tuple[str, float], ...]
    """Every candidate's name and the relative standard deviation of its worst coefficient."""
    left_out: tuple[str, ...]
    candidates: tuple[Candidate, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        rows = zip(self.before, self.after, self.beyond_driving, strict=True)
        now, then, beside = next(row for row in rows if row[0].name == self.worst)
        told = (
            f"{self.worst}, known worst, goes from ± {NORMAL * now.std:.2g} to "
            f"± {NORMAL * then.std:.2g} {now.unit} (95 %)"
        )
        if beside > then.std:
            told += (
                f", beside ± {NORMAL * beside:.2g} that no driving tells (mass, righting arm, "
                "scales: docs/live.md)"
            )
        return f"{self.manoeuvre}: {told}; {self.extent}"

    @property
    def manoeuvre(self) -> str:
        """What to run, for how long."""
        return f"{self.best.manoeuvre.name}, {self.best.duration:g} s"

    @property
    def extent(self) -> str:
        """Where the vehicle stays meanwhile."""
        f = self.best.flight
        return (
            f"stays within {f.reach[0]:.1f} m north, {f.reach[1]:.1f} m east, {f.reach[2]:.1f} m "
            f"down of the start and leans {np.degrees(f.tilt):.0f} deg at most"
        )

    def table(self) -> Table:
        """What is known of every coefficient now, and what after the manoeuvre."""
        rows = [
            [b.name, f"{b.value:.4g}", *(f"{NORMAL * x:.2g}" for x in (b.std, a.std, s)), b.unit]
            for b, a, s in zip(self.before, self.after, self.beyond_driving, strict=True)
        ]
        columns = (f"{PLUS_MINUS} {label}" for label in ("now", "after it", "scales"))
        head = ["", "configured", *columns, "unit"]
        return Table("what the manoeuvre would tell", head, rows, text=(5,))

    def plot(self) -> Figure:
        """How well each coefficient is known, now and after the manoeuvre."""
        from rov_ident.experiment.report import plan_picture

        return plan_picture(self)

    def page(self) -> str:
        """A self-contained HTML document."""
        from rov_ident.experiment.report import of_plan

        return of_plan(self)

    def to_json(self) -> str:
        """The manoeuvre, and what is predicted of each coefficient and of each candidate."""
        best, described = self.best, closed_loop_manoeuvres.described
        document = {
            "manoeuvre": described(best.manoeuvre, best.duration, best.limits, best.flight),
            "worst": self.worst,
            "sentence": self.sentence,
            "coefficients": {
                b.name: {"std_now": b.std, "std_after": a.std, "std_of_scales": s, "unit": b.unit}
                for b, a, s in zip(self.before, self.after, self.beyond_driving, strict=True)
            },
            "candidates": [
                {"name": n, "worst_relative_std": s if np.isfinite(s) else None}
                for n, s in self.others
            ],
            "left_out": list(self.left_out),
            "notes": list(self.notes),
        }
        return as_json(document)

    def _writers(self) -> dict[str, Callable[[Path], None]]:
        def messages(path: Path) -> None:
            write_messages(path, self.best.dive(self.config, seed=0).messages)

        return super()._writers() | {".mcap": messages}


def propose(
    config: Config,
    bags: Archive | None = None,
    duration: float = 60.0,
    limits: Limits | None = None,
    say: Progress = silent,
) -> Proposal:
    """The manoeuvre to run next, after ``bags`` or, without, from the prior alone. UserError if no
    manoeuvre is safe within the limits."""
    limits = limits or Limits()
    if not duration >= _SHORTEST:
        raise UserError(
            f"a manoeuvre of {duration:g} s shows nothing: {_SHORTEST:g} s are the least"
        )
    velocity = bags is None or not any(bags.each(is_without_velocity))
    about = supposed(config, velocity)
    now = information_of(bags.reread(about, True), about) if bags else _no_information(about)
    before = known_after(about, now)
    # what a standard deviation is compared with: the value, or a share of what matters
    prior = prior_of(config)
    size = np.maximum(np.abs(prior.mean), 0.2 * typical(config.dynamics)[prior.estimated])
    relative = np.array([p.std for p in before]) / size
    vehicles = _vehicles(config, covariance_of(about, now))
    candidates, left_out, predicted = [], [], []
    for one in closed_loop_manoeuvres.library(limits):
        if not velocity and any(one.amplitude[:2]):
            left_out.append(f"{one.name}: without a velocity sensor surge and sway have to rest")
            continue
        say(one.name)
        found = _largest_safe(vehicles, one, duration, limits)
        if found is None:
            left_out.append(f"{one.name}: not safe within the limits, however small")
            continue
        run = closed_loop_manoeuvres.dive(config, found[0], duration, limits, Suite())
        samples = smoothed(joined(list(samples_of(about, run, velocity))), about)
        information = with_thrust_errors(samples, *_model(about)).information
        std = np.array([p.std for p in known_after(about, now + information)])
        candidates.append(Candidate(*found, information, duration, limits))
        predicted.append(std / size)
    if not candidates:
        raise UserError("no manoeuvre is safe within these limits: allow more room or less thrust")
    # what no manoeuvre shows decides nothing
    shown = np.min(predicted, axis=0) < _SHOWN * relative
    if not velocity:
        shown &= [not is_impossible(parse(name)) for name in config.estimate]
    if not shown.any():
        shown[:] = True
    worst = before[int(np.argmax(np.where(shown, relative, 0.0)))].name
    scores = [float(r[shown].max() * (1.0 + _OTHERS * np.mean(r[shown]))) for r in predicted]
    best = int(np.argmin(scores))
    after = known_after(about, now + candidates[best].information)
    beyond_driving = _not_by_driving(about, now + candidates[best].information)
    others = [(c.manoeuvre.name, s) for c, s in zip(candidates, scores, strict=True)]
    return Proposal(
        config, candidates[best], worst, before, after, beyond_driving,
        tuple(sorted(others, key=lambda o: o[1])), tuple(left_out), tuple(candidates),
        _of_thrusters(config),
    )  # fmt: skip


def _of_thrusters(config: Config) -> tuple[str, ...]:
    """What a plan takes for granted of a vehicle whose thrusters are not described."""
    if is_known(config.thrusters):
        return ()
    others = " and leaves fins and shafts still" if config.model.fins else ""
    return (
        f"the plan pushes on all six axes{others}, as the file does not say what its thrusters can "
        "do (thrusters.position and .direction, or .allocation)",
    )


def supposed(config: Config, velocity: bool = True) -> Config:
    """The configuration as a fit takes it: with what no vehicle's file knows to be estimated, about
    the values at which samples are linear. Without a velocity sensor nothing shows of some of it.
    """
    if not velocity:
        odometry = replace(config.odometry, latency_std=0.0, scale_std=0.0)
        config = replace(config, current_std=0.0, odometry=odometry)
    config = config.with_nuisance
    return config.with_values(first_centre(config))


def _model(about: Config) -> tuple[Any, ...]:
    """The arguments of :func:`with_thrust_errors` for what is `supposed`."""
    prior = prior_of(about, effects=True)
    effects, axis_std = theta_of(about)[len(about.model.theta) :], axis_std_of(about, prior.names)
    noise = assumed(about, LIKELY)
    return about.dynamics, prior.estimated, noise, None, np.inf, effects, axis_std


def _no_information(about: Config) -> Array:
    names = prior_of(about, effects=True).names
    size = len(names) + len(axis_std_of(about, names))
    return np.zeros((size, size))


def information_of(bags: Archive, about: Config) -> Array:
    """Information (n + q, n + q) in the motion of bags that were read by what is `supposed`: about
    all that is estimated, then about q errors of the thrust of single axes, which are not."""
    return total(bags.each(with_thrust_errors, *_model(about))).information


def covariance_of(about: Config, information: Array) -> Array:
    """The covariance (n, n) after such information beside the prior, of all that is estimated."""
    std = prior_of(about, effects=True).std
    return inverse_of(information[: len(std), : len(std)] + np.diag(std**-2.0))


def known_after(about: Config, information: Array) -> tuple[Prospect, ...]:
    """How well each coefficient is known after such information, whatever the rest may be."""
    std = np.sqrt(np.diag(covariance_of(about, information)))
    return prospects(about, std[: len(about.estimate)])


def _not_by_driving(about: Config, information: Array) -> tuple[float, ...]:
    """The standard deviations that a fit adds, for each coefficient, after such information."""
    prior, covariance = prior_of(about, effects=True), covariance_of(about, information)
    with_data = prior.names, prior.mean, gain_of(covariance, prior.std)
    by_axis = covariance @ information[: len(covariance), len(covariance) :]
    added = rigid_body_covariance(about, *with_data)
    added += covariance_beyond_driving(about, *with_data, by_axis)
    std: list[float] = np.sqrt(np.diag(added)).tolist()
    return tuple(std[: len(about.estimate)])


def _vehicles(config: Config, covariance: Array) -> list[Config]:
    """The configured vehicle and some that what is known allows."""
    prior = prior_of(config)
    n = len(prior.names)
    covariance = covariance[:n, :n]
    rng = np.random.default_rng(0)
    found = [config]
    for values in rng.multivariate_normal(prior.mean, covariance, 30 * _DRAWS):
        if len(found) > _DRAWS:
            break
        values = np.where(prior.negative, np.minimum(values, 0.0), values)
        if is_passive(config.dynamics, prior, values):
            named = dict(zip(prior.names, values.tolist(), strict=True))
            found.append(config.with_model(config.model.with_values(named)))
    return found


def _largest_safe(
    vehicles: list[Config], one: AlternatingTargets, duration: float, limits: Limits
) -> tuple[AlternatingTargets, Flight] | None:
    """The manoeuvre as large as is safe with every vehicle."""
    factor = 1.0
    while factor >= _SMALLEST:
        trial = one.scaled(factor)
        try:
            flights = [closed_loop_manoeuvres.fly(v, trial, duration, limits) for v in vehicles]
        except UserError:
            flights = []
        if flights and all((f.reach <= limits.half).all() and f.tilt <= _TILT for f in flights):
            reach, tilt = np.max([f.reach for f in flights], axis=0), max(f.tilt for f in flights)
            return trial, replace(flights[0], reach=reach, tilt=tilt)
        factor *= _SHRINK
    return None
