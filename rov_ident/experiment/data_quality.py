"""Is this bag fit for identification: messages, excitation, and a quick fit that is judged.

The messages are looked at first (`messages_alone`), and whether pose and IMU contradict the
velocity sensor. Unless the vehicle moves against the wrench, which a fit may take for other
coefficients, a recursive least squares fit with all that is estimated by default says whether a
model can explain the motion, what the configuration lacks, and how well each coefficient is known.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

import numpy as np

from rov_ident.config import Config
from rov_ident.config.prior import THRUST_SCALE, prior_of
from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_angle, quaternion_from_euler
from rov_ident.core.linalg import interpolated
from rov_ident.core.progress import Progress, silent
from rov_ident.core.states import CONVERGED, IDENTIFIABLE, State, of_fit
from rov_ident.discrepancy.sensor_consistency import comparisons, search
from rov_ident.discrepancy.velocity_sensor import MOUNTED, tests_of
from rov_ident.estimation.consistency import SUPPOSED
from rov_ident.experiment.messages_alone import BAD, GOOD, WARNING, Remark, of_dynamics, of_messages
from rov_ident.io import topics as inputs
from rov_ident.io.bag_reader import Bag
from rov_ident.io.mounting import TURNED, sensor_placement, with_mounting
from rov_ident.model.coefficients import MOTIONS, WRENCH_UNITS
from rov_ident.model.equations import Array
from rov_ident.model.scales import authority
from rov_ident.offline import archive
from rov_ident.offline.batch_fit import AT_REST, fit_batch
from rov_ident.offline.fit import Fit, fit_online, thrust_or_mass
from rov_ident.reports.result import NORMAL, Figure, Shown, as_json
from rov_ident.reports.table import Table, Tables, with_unit
from rov_ident.sampling.raw_streams import Streams, gather
from rov_ident.sampling.records import UNITS, Record, read_record
from rov_ident.sampling.without_velocity import blanked, is_without_velocity

_VERDICTS = {State.CONVERGED: "well", State.CONVERGING: "roughly"}
_ONE_WAY = 0.25  # of the larger of the velocities either way: driven in one direction only
_THIN = 1.02  # a flat plate has 1; the rest is for rounded numbers
_HALF = 2.0  # times the variance that is said of a velocity: half of its noise is not
_MATTERS = 0.1  # prior standard deviations: 1.5 % of thrust, 0.02 s, 0.03 m/s


@dataclass(frozen=True)
class Prospect:
    """A coefficient: configured value, standard deviation and state after a fit, prior."""

    name: str
    value: float
    unit: str
    std: float
    state: State
    prior_std: float

    @property
    def identifiable(self) -> bool:
        return self.std**2 < (1.0 - IDENTIFIABLE) * self.prior_std**2


@dataclass(frozen=True)
class Check(Shown):
    """All that was found out about a bag: its name, ``duration`` [s], ``remarks`` on rates, gaps,
    axes, signs, delays, excitation and model; ``quick``: a fit by recursive least squares, None
    where it would mean nothing.
    """

    bag: str
    duration: float
    config: Config = field(repr=False)
    remarks: tuple[Remark, ...]
    quick: Fit | None
    record: Record = field(repr=False)
    streams: Streams = field(repr=False)

    @property
    def usable(self) -> bool:
        """Whether the messages are good enough for a fit, or for `explain`, to make sense."""
        quick = self.quick
        known = quick and (any(quick.identifiable) or not quick.consistency.consistent)
        return bool(known) and all(r.level != BAD or r.subject == _MODEL for r in self.remarks)

    @property
    def fit(self) -> bool:
        """Whether a fit can be trusted: the bag is usable, and a model explains it."""
        return self.usable and all(r.level != BAD for r in self.remarks)

    @property
    def prospects(self) -> tuple[Prospect, ...]:
        """What the quick fit makes of each coefficient; the prior where there is none."""
        prior, quick = prior_of(self.config), self.quick
        if quick is None:
            return prospects(self.config, prior.std)
        rows = zip(prior.names, prior.mean.tolist(), prior.units, prior.std.tolist(), strict=True)
        found = dict(zip(quick.names, zip(quick.std.tolist(), quick.states), strict=True))
        return tuple(Prospect(n, x, unit, *found[n], wide) for n, x, unit, wide in rows)

    @property
    def sentence(self) -> str:
        """Whether the bag is fit for identification."""
        told = f"{self.bag}, {self.duration:.1f} s:"
        if not self.fit:
            return f"{told} not fit for identification: {self.why}."
        states = [p.state for p in self.prospects]
        well = states.count(State.CONVERGED)
        if not well:
            return (
                f"{told} fit for identification, but too short or too calm: a quick fit tells none "
                f"of {len(states)} coefficients well (rov-ident plan says how to drive)."
            )
        return (
            f"{told} fit for identification; a quick fit tells {well} of {len(states)} "
            "coefficients well."
        )

    @property
    def why(self) -> str:
        """What makes it unfit."""
        bad = [f"{r.subject}: {r.text}" for r in self.remarks if r.level == BAD]
        return "; ".join(bad) or "its motion tells no coefficient"

    def table(self) -> Tables:
        """Every remark, and the quick fit."""
        remarks = [[r.level, r.subject, r.text] for r in self.remarks]
        parts = [Table("what was looked at", ["", "subject", ""], remarks, text=(1, 2))]
        if self.quick is not None:
            configured = [f"{self.quick.given.value(name):.5g}" for name in self.quick.names]
            states = [state.value for state in self.quick.states]
            columns = {"configured": configured, "state": states}
            parts.append(self.quick.numbers("a quick fit", columns))
        return Tables(tuple(parts))

    def plot(self) -> Figure:
        """How well each coefficient is known, now and after a fit."""
        from rov_ident.experiment.report import check_picture

        return check_picture(self)

    def page(self) -> str:
        """A self-contained HTML document."""
        from rov_ident.experiment.report import of_check

        return of_check(self)

    def to_json(self) -> str:
        """The remarks, and what the quick fit makes of each coefficient."""
        coefficients = {
            p.name: {
                "configured": p.value,
                "predicted_std": p.std,
                "prior_std": p.prior_std,
                "unit": p.unit,
                "identifiable": p.identifiable,
                "verdict": _VERDICTS.get(p.state, "not"),
                "state": p.state.value,
            }
            for p in self.prospects
        }
        document = {
            "bag": self.bag,
            "duration_s": self.duration,
            "fit_for_identification": self.fit,
            "remarks": [
                {"subject": r.subject, "level": r.level, "text": r.text} for r in self.remarks
            ],
            "coefficients": coefficients,
            "consistency": None if self.quick is None else self.quick.consistency.to_dict(),
        }
        return as_json(document)


def check(path: Path, config: Config, say: Progress = silent) -> Check:
    """Look at a bag; UserError if it cannot be read, or lacks the messages that are needed."""
    config, placed = with_mounting(config, [path])
    record = read_record(path, config, say)
    say("looking at its messages")
    bag, unmeasured = Bag(path), is_without_velocity(record.samples)
    topics = inputs.select(bag, config)
    messages = inputs.messages(bag, topics, config)
    streams = gather(blanked(messages) if unmeasured else messages, config)
    if streams.duration < 1.0:
        raise UserError(f"{path.name} lasts {streams.duration:.1f} s: nothing can be said of it")
    notes = [Remark("messages", WARNING, note) for note in record.notes]
    frames = inputs.first_frames(bag, topics, config)
    told = ", ".join(f"{role} is {topic}" for role, topic in topics.items())
    remarks = [Remark("topics", GOOD, told), *of_messages(streams, config), *notes]
    remarks += _excitation_remarks(streams, config)
    remarks += [Remark("mounting", GOOD, note) for note in placed]
    remarks += _mounting_remarks(sensor_placement(bag, frames), config)
    remarks += _inertia_remarks(config)
    remarks += _noise_remarks(streams, record, config)
    failed = (test for test in tests_of(streams, config) if not test.passed)
    remarks += [Remark("velocity sensor", BAD, test.failure) for test in failed]
    motion, quick = of_dynamics(record.samples, config), None
    if not any(remark.level == BAD for remark in motion):
        say("a quick fit")
        alone = archive.of_records([record], config)
        quick = (
            fit_batch(alone, config, "ml") if unmeasured else fit_online([record], config, "rls")
        )
        motion = of_dynamics(record.samples, config.with_model(quick.fitted.model))
        remarks += [*_model_remarks(quick), *_coefficient_remarks(quick)]
    remarks += motion
    return Check(path.name, streams.duration, config, tuple(remarks), quick, record, streams)


def prospects(config: Config, std: Array) -> tuple[Prospect, ...]:
    """Each coefficient, known to a standard deviation (n,)."""
    prior = prior_of(config)
    columns = (prior.mean.tolist(), prior.units, std.tolist(), prior.std.tolist())
    rows = zip(prior.names, *columns, strict=True)
    return tuple(
        Prospect(name, x, unit, s, of_fit(x, s, wide, s**2 < (1.0 - IDENTIFIABLE) * wide**2), wide)
        for name, x, unit, s, wide in rows
    )


def _mounting_remarks(told: Mapping[str, Array], config: Config) -> Iterator[Remark]:
    """Whether `/tf_static` says of the sensors what the configuration says."""
    for key, vector in told.items():
        if key == TURNED:
            continue  # with_mounting says it
        section, name = key.split(".")
        configured = np.array(getattr(getattr(config, section), name))
        turned = name == "rotation"
        if turned:  # the angles themselves may differ where nothing turns: pi and -pi
            vectors = vector, configured
            apart = quaternion_angle(*(quaternion_from_euler(*angles) for angles in vectors))
        else:
            apart = np.abs(vector - configured).max()
        if apart > MOUNTED:
            bag, file = ([round(float(x), 3) + 0.0 for x in v] for v in (vector, configured))
            yield Remark(
                key, WARNING,
                f"{bag} by /tf_static of the bag, {file} in the configuration (forward, starboard, "
                "down): correct the wrong one",
            )  # fmt: skip


def _inertia_remarks(config: Config) -> Iterator[Remark]:
    """Whether a body can have the moments of inertia: none is more than the sum of the others."""
    moments = np.linalg.eigvalsh(config.model.body.inertia)
    if moments[2] > _THIN * (moments[0] + moments[1]):
        told = ", ".join(f"{x:.3g}" for x in moments.tolist())
        yield Remark(
            "vehicle.inertia", WARNING,
            f"no body has the principal moments {told} kg m2, of which one is more than the sum of "
            "the others: check the values and their order xx yy zz xy xz yz",
        )  # fmt: skip


def _noise_remarks(streams: Streams, record: Record, config: Config) -> Iterator[Remark]:
    """Whether the velocities are noisier than is said of them: the difference is taken for forces.
    The IMU tells, whose integral between two messages has hardly any noise, once what sensors are
    late or off by has been taken away."""
    if not streams.nu[:, :3].any():
        return
    sensors, _ = search(streams, config, [(0.0, streams.duration)])
    against_imu = [c.white for c in comparisons(streams, config, sensors) if c.name == "imu"]
    variance = record.samples["odometry_variance"][record.samples["measured"], :3]
    said = float(np.sqrt(np.median(variance.mean(axis=1)))) if len(variance) else np.inf
    for noise in against_imu:
        if noise**2 > _HALF * said**2:
            yield Remark(
                "noise of the velocities", WARNING,
                f"{noise:.2g} m/s, {noise / said:.1f} times what the messages, or else "
                "odometry.linear_std, say: correct that, or a fit takes the difference for forces "
                "that the model does not have",
            )  # fmt: skip


_MODEL = "model and data"


def _model_remarks(quick: Fit) -> Iterator[Remark]:
    """Whether a model explains the data, and what it has that the configuration has not."""
    agree = quick.consistency.consistent
    yield Remark(_MODEL, GOOD if agree else BAD, quick.consistency.sentence)
    prior = prior_of(quick.given, effects=True)
    # a righting arm that is off is one of the reasons that are told
    own = np.sqrt(np.maximum(quick.std**2 - quick.beyond_driving, 0.0))
    columns = quick.values, own, quick.std, prior.mean, prior.std
    values = dict(zip(quick.names, quick.values.tolist(), strict=True))
    seen = [
        (*name.split("."), with_unit(f"{x:.3g} ± {NORMAL * whole:.2g}", unit), mean)
        for name, unit, x, std, whole, mean, wide in zip(
            quick.names, quick.units, *columns, strict=True
        )
        if "." in name and abs(x - mean) > max(SUPPOSED * std, _MATTERS * wide)
    ]
    for effect, parts in groupby(seen, key=lambda part: part[0]):
        text = ", ".join(f"{own} {told} (configured: {mean:g})" for _, own, told, mean in parts)
        text += "; a fit estimates it along, but the simulation as configured lacks it"
        if effect == "thrust_scale":
            text += f". Weigh the vehicle: {thrust_or_mass(values[THRUST_SCALE])}"
        yield Remark(effect.replace("_", " "), WARNING, text)


def _excitation_remarks(streams: Streams, config: Config) -> Iterator[Remark]:
    limits, steered = authority(config.dynamics), np.zeros((1, 6))
    if len(streams.inputs_t):  # fins and propeller drive, too
        now = interpolated(streams.inputs_t, streams.inputs, streams.t)
        steered = config.dynamics.input_wrench(streams.nu, now)
    for i, axis in enumerate(MOTIONS):
        unit, force = UNITS[i], WRENCH_UNITS[i]
        low, high = np.quantile(streams.nu[:, i], [0.02, 0.98])
        measured = i >= 3 or streams.nu[:, :3].any()
        driven = float(np.sqrt(np.mean(streams.demand[:, i] ** 2) + np.mean(steered[:, i] ** 2)))
        varied = float(np.hypot(streams.demand[:, i].std(), steered[:, i].std()))
        text = f"from {low:.2f} to {high:.2f} {unit}" if measured else "velocity not measured"
        text += f", wrench {driven:.2g} {force} rms"
        level = GOOD
        if driven < AT_REST * limits[i]:
            level, text = WARNING, text + ": not driven"
        elif varied < AT_REST * limits[i]:
            level, text = WARNING, text + ": it hardly changes, so inertia does not show"
        elif measured and min(-low, high) < _ONE_WAY * max(-low, high):
            level, text = WARNING, text + ": one direction only, what is asymmetric does not show"
        yield Remark(f"excitation of {axis}", level, text)


def _coefficient_remarks(quick: Fit) -> Iterator[Remark]:
    if not quick.consistency.consistent:
        return
    states = [pair for pair in zip(quick.names, quick.states, strict=True) if "." not in pair[0]]
    unknown = [name for name, state in states if state not in _VERDICTS]
    rough = [name for name, state in states if state is State.CONVERGING]
    if unknown:
        text = f"this motion does not show {', '.join(unknown)}"
        yield Remark("coefficients", WARNING, text)
    if rough:
        text = f"only roughly (worse than {100 * CONVERGED:g} %): {', '.join(rough)}"
        yield Remark("coefficients", WARNING, text)
    if not unknown and not rough:
        yield Remark("coefficients", GOOD, f"all {len(states)} are known well")
