"""Offline fits, all with one type of result."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rov_ident.config import Config, dump
from rov_ident.config.prior import THRUST_SCALE, prior_of, share_of_arm
from rov_ident.core.messages import Array
from rov_ident.core.states import IDENTIFIABLE, State, of_fit
from rov_ident.estimation.compilation import ensure_compiled
from rov_ident.estimation.consistency import Consistency, Test, worst_of
from rov_ident.estimation.online import Kind, OnlineEstimator
from rov_ident.io import topics as inputs
from rov_ident.io.bag_reader import Bag
from rov_ident.model.equations import Model
from rov_ident.offline import archive, missing_terms
from rov_ident.offline.prediction_error import Curves, by_chance, curves, open_loop
from rov_ident.reports.result import NORMAL, Figure, Result, Shown, as_json, provenance
from rov_ident.reports.table import Table, Tables
from rov_ident.sampling.records import HORIZON, Record, numbers
from rov_ident.sampling.sample import thrust_axes

TITLES = {"ls": "least squares", "iv": "instrumental variables", "ml": "maximum likelihood",
          "rls": "recursive least squares", "ukf": "unscented Kalman filter"}  # fmt: skip
_SHOWN = 60.0  # s of motion in the picture of a fit
_MOST = 0.5  # of a variance
_NOTICED = 0.1  # of the scale's prior standard deviation: 1.5 % of thrust


def thrust_or_mass(scale: float, std: float = 0.0) -> str:
    """What a thrust that is ``scale`` times the configured one may be instead."""
    within = f" (± {NORMAL * std:.2f}, 95 %)" if std else ""
    return (
        f"thrust is {scale:.2f}{within} times what the configuration says, or mass, inertia and "
        f"buoyancy are {1.0 / scale:.2f} times that, or the height of the centre of buoyancy above "
        "that of gravity is (hang a weight to one side: docs/live.md): motion alone cannot tell "
        "the one from the other"
    )


@dataclass(frozen=True, kw_only=True)
class Fit(Shown, Result):
    """Coefficients identified from dives.

    ``names``, ``units``, ``values``, ``std``, ``lower``, ``upper`` (n,) and ``covariance`` (n, n)
    are in the order of ``names``; ``lower`` and ``upper`` are the 95 % interval.
    ``states`` (n,) tell how well each is known: "held" where the prior and not the data made the
    value. ``rmse`` (6,) [m/s, rad/s] is of open-loop windows of HORIZON seconds. ``given`` is the
    configuration that the fit began with, ``fitted`` the same with the values found.
    ``consistency`` says whether model and data agree; where they do not, intervals are wider.
    """

    states: tuple[State, ...]
    given: Config = field(repr=False)
    fitted: Config = field(repr=False)
    samples: int
    duration: float
    rmse: Array
    consistency: Consistency
    has_thrust: bool = field(default=True, repr=False)
    """Whether thrusters ever push; else nothing tells the scale of what they do."""
    beyond_driving: Array | float = field(default=0.0, repr=False)
    """(n,) the part of the variances that no driving reduces; of batch fits not told."""
    more: dict[str, Any] = field(default_factory=dict)
    """Further parts of the JSON that only some estimators have."""
    curves: tuple[Curves, ...] = field(default=(), repr=False)
    """Of every bag that was fitted: the open-loop simulation before and after."""
    judged: tuple[Curves, ...] = field(default=(), repr=False)
    """The same of the bag that was held back for validation."""

    @property
    def model(self) -> Model:
        """The equations of motion with the values found."""
        return self.fitted.model

    @property
    def sentence(self) -> str:
        """What was fitted, by which method, to how much data."""
        bags = len(self.provenance["bags"])
        known = sum(self.identifiable)
        told = (
            f"{TITLES[self.estimator].capitalize()} on {bags} bag{'s' * (bags != 1)}, "
            f"{self.duration:.0f} s: the data determine {known} of {len(self.names)} coefficients."
        )
        if doubt := self.doubt:
            return f"{told} {doubt[0].upper()}{doubt[1:]}."
        if judged := self.more.get("validation"):
            where, before = judged["bags"][0]["file"], judged["rmse_before"]
            return f"{told} On {where}, {rmse_change(before, judged['rmse'])}."
        if before := self.more.get("open_loop_before"):
            return f"{told} On what was fitted, {rmse_change(before['rmse'], numbers(self.rmse))}."
        return told

    @property
    def doubt(self) -> str:
        """How data and model disagree, or that it is unknown; empty where they agree, and of least
        squares, which does not test that."""
        if not self.consistency.consistent:
            return f"data and model disagree: {self.consistency.sentence}"
        return self.consistency.sentence if self.consistency.doubt else ""

    def with_tests(self, tests: Sequence[Test]) -> "Fit":
        """The same, judged by further ``tests``, too: where one fails, intervals are wider, and
        nothing has converged."""
        prior = prior_of(self.given, effects=True)
        at = [prior.names.index(name) for name in self.names]
        mean, std = prior.mean[at], prior.std[at]
        consistency = replace(self.consistency, tests=(*self.consistency.tests, *tests))
        already = self.consistency.inflation
        covariance = consistency.widened(self.covariance, std, self.values - mean, already)
        return replace(
            self,
            consistency=consistency,
            covariance=covariance,
            states=consistency.of_states(self.states, 1.0 - np.diag(covariance) / std**2),
        )

    @property
    def to_measure(self) -> tuple[str, ...]:
        """What to weigh or measure of the vehicle: where its mass may be off instead of the thrust,
        and where its righting arm makes most of the intervals."""
        if THRUST_SCALE not in self.names or not self.has_thrust:
            return ()
        i, advice = self.names.index(THRUST_SCALE), []
        scale = float(self.values[i])
        # of the data alone: a mass that is off is one of the reasons that are told
        variance = self.covariance[i, i] - np.broadcast_to(self.beyond_driving, len(self.names))[i]
        least = _NOTICED * self.given.wrench.scale_std
        if (scale - 1.0) ** 2 > max(variance, least**2):
            std = math.sqrt(self.covariance[i, i])
            advice.append(f"Weigh the vehicle: {thrust_or_mass(scale, std)}.")
        of_arm = share_of_arm(self.given, scale) * scale
        turned = np.isfinite(self.rmse[3:]).any()  # by moments that are known: else no arm tells
        if turned and of_arm**2 > _MOST * self.covariance[i, i]:
            advice.append(
                "Measure the righting arm (docs/live.md): what is not known of it "
                "(vehicle.cob_std) makes most of the intervals of thrust and coefficients."
            )
        return tuple(advice)

    @property
    def advice(self) -> tuple[str, ...]:
        """What to do next, the most useful first."""
        held = [n for n, known in zip(self.names, self.identifiable) if not known]
        advice = [*self.to_measure]
        if impossible := self.more.get("impossible"):
            held = [name for name in held if name not in impossible]
            advice.append(
                f"Impossible to tell without linear velocity: {', '.join(impossible)}. A velocity "
                "sensor (DVL) would. For the rest drive heave and turns, surge and sway at rest."
            )
        if held:
            advice.append(
                f"Not determined by these data: {', '.join(held)}. rov-ident plan says which "
                "manoeuvre would tell them."
            )
        if not self.judged:
            advice.append("What a fit has seen flatters it: judge it on another dive (--validate).")
        advice.append("rov-ident explain looks for what the model itself lacks.")
        return tuple(advice)

    def table(self) -> Table | Tables:
        """Every coefficient with half of its 95 % interval, and the configured value."""
        states = [state.value for state in self.states]
        configured = [f"{self.given.value(name):.5g}" for name in self.names]
        title = f"{self.estimator}: {self.samples} samples, {self.duration:.1f} s"
        if not self.consistency.consistent:
            title += "; data and model disagree"
        parts = [self.numbers(title, {"configured": configured, "state": states})]
        if judged := self.more.get("validation"):
            rows = [
                [name, *("" if x is None else f"{x:.4f}" for x in (before, judged["rmse"][name]))]
                for name, before in judged["rmse_before"].items()
            ]
            title = f"{judged['bags'][0]['file']}, simulated in open loop: RMSE"
            parts.append(Table(title, ["", "before", "after"], rows))
        if found := self.more.get("reference"):
            title = f"after {found['duration_s']:.1f} s: our filter and filterpy's"
            head = ["", "ours", "std", "filterpy's", "std", "apart, in std"]
            rows = [
                [name, *(f"{x:.5g}" for x in row.values())]
                for name, row in found["coefficients"].items()
            ]
            parts.append(Table(title, head, rows))
        return parts[0] if len(parts) == 1 else Tables(tuple(parts))

    def plot(self) -> Figure:
        """The coefficients relative to the configured ones, and the motion simulated with both."""
        from rov_ident.reports import plots

        before = np.array([self.given.value(name) for name in self.names])
        size = np.where(before == 0.0, np.maximum(np.abs(self.values), 1e-12), np.abs(before))
        change = 100.0 * (self.values - before) / size
        half = 100.0 * self.quantile * self.std / size
        one = (self.judged or self.curves)[0]
        part = one.t < one.t[0] + _SHOWN
        models = {"as configured": one.before[part], "retuned": one.after[part]}
        return plots.fitted(self.names, (change, half), (one.t[part], one.measured[part], models))

    def page(self) -> str:
        """A self-contained HTML document: coefficients, and the simulation before and after."""
        from rov_ident.offline.report import page

        return page(self)

    def save_config(self, path: str | Path) -> None:
        """Write :attr:`fitted` as a parameter file, whatever its ending.

        Raises UserError if it cannot be written.
        """
        bags = ", ".join(bag["file"] for bag in self.provenance["bags"])
        comment = f"Fitted by rov-ident fit --estimator {self.estimator} to {bags}."
        dump(self.fitted, path, comment)

    def _writers(self) -> dict[str, Callable[[Path], None]]:
        return super()._writers() | {".yaml": self.save_config}

    @property
    def identifiable(self) -> tuple[bool, ...]:
        """(n,) whether the data, and neither prior nor a bound, decide about a coefficient."""
        unknown = (State.HELD, State.AT_BOUND, State.DIVERGED)
        return tuple(state not in unknown for state in self.states)

    def to_json(self) -> str:
        """The machine-readable result; numbers that do not exist are null."""
        coefficients = self.entries()
        for entry, known, state in zip(coefficients.values(), self.identifiable, self.states):
            entry |= {"identifiable": known, "state": state.value}
        result = {
            "estimator": self.estimator,
            "coefficients": coefficients,
            "samples": self.samples,
            "duration_s": self.duration,
            "open_loop": {"horizon_s": HORIZON, "rmse": numbers(self.rmse)},
            "consistency": self.consistency.to_dict(),
            "notes": list(self.notes),
            **self.more,
            "provenance": self.provenance,
        }
        return as_json(result)


def rmse_change(before: Mapping[str, float | None], after: Mapping[str, float | None]) -> str:
    """How the RMSE of open-loop prediction changes, by velocity, in half a sentence."""
    if np.inf in after.values():
        return f"the {HORIZON:g} s prediction diverges"
    ratios = [a / b for b, a in zip(before.values(), after.values()) if a is not None and b]
    share = 100.0 * (1.0 - float(np.median(ratios))) if ratios else 0.0
    change = f"falls by {share:.0f} %" if share >= 1.0 else "does not fall"
    return f"the error of a {HORIZON:g} s prediction {change} (median of the velocities)"


def fit_online(records: Sequence[Record], config: Config, kind: Kind) -> Fit:
    """Fold a recursive estimator over records, one after the other, as the node would.

    Raises UserError if the data are too few to say anything.
    """
    ensure_compiled(config, kind)
    estimator = OnlineEstimator(config, kind)
    for record in records:
        estimator.next_record()
        if estimator.config.estimate_effects:  # samples depend on what is known by then
            bag = Bag(record.path)
            estimator.follow(inputs.messages(bag, inputs.select(bag, config), config))
        else:
            estimator.take(record.samples)
            estimator.flush()
    config, read = estimator.config, archive.of_records(records, config)
    found = config.with_values(estimator.report().by_name)
    judged = read.reread(found, True)
    report = estimator.report(worst_of(bag.contradictions for bag in judged.bags))
    assert report.consistency is not None and report.beyond_driving is not None
    own = np.sqrt(np.maximum(report.std**2 - report.beyond_driving, 0.0))
    states = [
        of_fit(value, std, prior, 1.0 - (std / prior) ** 2 > IDENTIFIABLE, now is State.AT_BOUND)
        if now is not State.DIVERGED
        else now
        for value, std, prior, now in zip(
            report.values, own, estimator.prior.std, report.states, strict=True
        )
    ]
    before, after = open_loop(read, config), open_loop(judged, found)
    chance = by_chance(judged, found, report.names, report.covariance, states)
    tests = Consistency(()).with_open_loop(before.rmse, after.rmse, chance).tests
    if report.consistency.consistent:
        tests += missing_terms.tests_at(judged, config, found, report.values)
    return Fit(
        estimator=kind,
        names=report.names,
        units=report.units,
        values=report.values,
        covariance=report.covariance,
        states=report.consistency.of_states(states, 1.0 - (own / estimator.prior.std) ** 2),
        given=config,
        fitted=found,
        samples=read.samples,
        duration=read.duration,
        rmse=after.rmse,
        consistency=report.consistency,
        provenance=provenance(((r.path.name, r.sha256) for r in records), vehicle=config.name),
        notes=tuple(note for record in records for note in record.notes),
        curves=curves(read.bags, before, after),
        has_thrust=any(thrust_axes(record.samples).any() for record in records),
        beyond_driving=report.beyond_driving,
    ).with_tests(tests)
