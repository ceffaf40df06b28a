"""The records that `explain` searches, with what their sensors contradict set right before."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.discrepancy import clock_errors, rates_and_attitude, repetition, sensor_choice
from rov_ident.discrepancy.findings import sensor_findings
from rov_ident.discrepancy.held_out import blocks, is_practical, split, thinned, windows
from rov_ident.discrepancy.results import Finding
from rov_ident.discrepancy.search import Search
from rov_ident.discrepancy.sensor_choice import LATENCY
from rov_ident.discrepancy.windowed_problem import Spans
from rov_ident.effects import Values
from rov_ident.model.coefficients import AXES, VELOCITIES, WRENCH_UNITS
from rov_ident.sampling.raw_streams import Streams, corrected, joined
from rov_ident.sampling.sample import NO_MOMENT
from rov_ident.sampling.wrench_scatter import reading_noise

_OWN_HEADINGS = (
    "each record has a heading of its own against the world: the extended configuration has none"
)
OWN_VALUES = (
    "each record has {} of its own: the extended configuration has none, and is judged here with "
    "what each record has"
)
_FILTERED = (
    "the odometry's velocities are filtered, which changes quick motion by more than a delay: no "
    "cause beside it is sure; record what the filter is fed with"
)
_UNMEASURED = "not measured, as they never change, and left as they are: {}"
_IN_NOISE = (
    "the wrench cannot be told from noise of its reading on {}: how the vehicle moves along these "
    "axes is taken from the measurement, not simulated, and nothing is said about it; record the "
    "commands without noise, or drive these axes well above it"
)
_NOISE_LASTS = (
    "noise of the wrench's reading is the same for several readings: {}; what publishes them holds "
    "or filters what it measures"
)
_NO_FORCE = (
    "no force in newtons is recorded: what fins and propeller do tells forces and inertia in "
    "proportion to each other, and only the righting moment their common scale; beside it the "
    "extended configuration has what the one given says of it (prior.relative_std), and trim as "
    "far as vehicle.buoyancy_std and cog_std allow"
)


@dataclass(frozen=True)
class Prepared:
    """The bags with what their sensors contradict set right: ``streams``, all of them joined, to
    fit in the spans ``to_fit``, and those ``judged`` in the spans ``to_judge``; the latter as
    ``recorded``. ``headings`` that were taken off each bag, and what else its velocity sensor has
    of its own, ``own_sensors``; the ``choice`` of sensor effects, their ``findings``, and those of
    practical weight, ``sensors``, which were taken off. Whether a filter makes velocities ``late``,
    whether the heading ``may_drift`` where a gyro was taken for biased, and the errors of the
    ``clocks``."""

    bags: Sequence[Streams]
    streams: Streams
    to_fit: Spans
    judged: Streams
    to_judge: Spans
    recorded: sensor_choice.Data
    headings: Sequence[float]
    own_sensors: Mapping[str, repetition.OfEach]
    choice: sensor_choice.Choice
    findings: Sequence[Finding]
    sensors: Values
    late: bool
    may_drift: bool
    clocks: clock_errors.ClockErrors

    @property
    def records(self) -> repetition.Records:
        """Which part of the time is which bag."""
        return repetition.Records(self.streams, self.bags, joined(self.bags)[1])

    @property
    def notes(self) -> list[str]:
        """What was set right in each record by itself, and what the records do not tell."""
        notes = [_OWN_HEADINGS] if any(self.headings) else []
        notes += [OWN_VALUES.format(", ".join(self.own_sensors))] if self.own_sensors else []
        notes += [_FILTERED] if self.late else []
        return (
            notes + self.clocks.notes + of_guided(self.streams) + _of_noise_that_lasts(self.streams)
        )

    @property
    def validated(self) -> bool:
        """Whether another bag is judged."""
        return self.recorded.judged is not self.recorded.streams

    def search(self, config: Config) -> Search:
        """For what a configuration lacks; of another bag that is judged nobody knows what these
        records have of their own."""
        return Search(self.streams, config, thinned(self.to_fit), apart=not self.validated)

    def with_noise(self, lost: NDArray[np.bool_], lasts: NDArray[np.int64]) -> "Prepared":
        """The same without further axes (6,) that are lost in noise of the wrench's reading, which
        ``lasts`` (6,) so many of them."""

        def marked(streams: Streams) -> Streams:
            return dataclasses.replace(streams, in_noise=streams.in_noise | lost, noise_lasts=lasts)

        streams = marked(self.recorded.streams)
        judged = marked(self.recorded.judged) if self.validated else streams
        recorded = dataclasses.replace(self.recorded, streams=streams, judged=judged)
        return dataclasses.replace(
            self, bags=[marked(bag) for bag in self.bags], streams=marked(self.streams),
            judged=marked(self.judged), recorded=recorded,
        )  # fmt: skip


def prepare(bags: Sequence[Streams], config: Config, validate: Streams | None) -> Prepared:
    rates = [rates_and_attitude.agreed(bag, config) for bag in bags]
    bags = [r.streams for r in rates]
    clocks = clock_errors.of(bags, config)
    if validate is not None:
        validate = rates_and_attitude.agreed(validate, config).streams
    with_others = [*bags, *([] if validate is None else [validate])]
    as_headed = joined(bags)[0] if validate is None else validate
    turned, headings = repetition.turned(with_others, config)
    bags = turned[: len(bags)]
    validate = None if validate is None else turned[-1]
    as_read = bags
    bags, delays = repetition.in_time(bags, config)
    bags, own = repetition.as_mounted(bags, config)
    if delays:
        own[LATENCY] = [{"delay": v} for v in delays]
    streams, to_fit, held = _divided(bags, validate)
    judged, to_judge = (streams, held) if validate is None else (validate, blocks(validate))
    recorded = sensor_choice.Data(streams, to_fit, judged, to_judge, config)
    choice = sensor_choice.chosen(recorded, any(headings))
    findings = sensor_findings(recorded, choice, as_headed)
    if len(bags) > 1:
        findings = repetition.of_sensors(bags, config, findings, headings[: len(bags)])
    spans, before = held if validate is None else to_fit, joined(as_read)[0]
    of_each = [
        repetition.own_finding(before, streams, config, spans, choice.sensors, name, each)
        for name, each in own.items()
    ]
    sensors = {f.effect: choice.sensors[f.effect] for f in findings if is_practical(f.gain)}
    return Prepared(
        bags,
        corrected(streams, sensors),
        to_fit,
        corrected(judged, sensors),
        to_judge,
        recorded,
        headings,
        own,
        choice,
        [*findings, *of_each],
        sensors,
        any(r.late for r in rates),
        any(r.may_drift for r in rates),
        clocks,
    )


def _divided(bags: Sequence[Streams], validate: Streams | None) -> tuple[Streams, Spans, Spans]:
    """The bags joined, the spans to fit, and those to judge on."""
    streams, begins = joined(bags)
    of_all: tuple[Spans, Spans] = [], []  # to fit, and held out
    for bag, begin in zip(bags, begins, strict=True):
        own = split(bag.duration) if validate is None else (windows(0.0, bag.duration), [])
        for spans, mine in zip(of_all, own, strict=True):
            spans += [(begin + a, begin + b) for a, b in mine]
    return streams, *of_all


def of_guided(streams: Streams) -> list[str]:
    """Notes on what a record does not tell, such as velocities that are taken as measured."""
    never = ", ".join(c for c, so in zip(VELOCITIES, streams.unmeasured, strict=True) if so)
    notes = [] if streams.is_turned else [NO_MOMENT]
    notes += [_UNMEASURED.format(never)] if never else []
    notes += [] if streams.has_forces else [_NO_FORCE]
    std = reading_noise(streams.demand, streams.noise_lasts)
    lost = [f"{AXES[i]} ({std[i]:.2g} {WRENCH_UNITS[i]})" for i in np.flatnonzero(streams.in_noise)]
    return notes + ([_IN_NOISE.format(", ".join(lost))] if lost else [])


def _of_noise_that_lasts(streams: Streams) -> list[str]:
    period = float(np.median(np.diff(streams.demand_t)))
    lasting = [
        f"{axis} {n} ({n * period:.2g} s)" for axis, n in zip(AXES, streams.noise_lasts) if n > 1
    ]
    return [_NOISE_LASTS.format(", ".join(lasting))] if lasting else []
