"""Whether a cause is the same in each of several records, and whether it repeats.

What belongs to a dive may have values of its own in each record already in the search. Of the other
effects the model found is fitted to each record alone: where an effect's parameters differ by more
than chance, the records differ in it. Then each record is left out as a whole and predicted by fits
to the others, with the effect and without (Stone 1974). An effect that differs, and does not
predict other records, belongs to each record, too.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.discrepancy import sensor_choice, sensor_consistency
from rov_ident.discrepancy.findings import in_words, kinematic_gain, parameters_of, sentence, unsure
from rov_ident.discrepancy.held_out import (
    BLOCK,
    Judge,
    is_surely_practical,
    split,
    surely_less,
    thinned,
    windows,
)
from rov_ident.discrepancy.hypothesis import (
    COEFFICIENTS,
    Hypothesis,
    Key,
    bounds,
    is_shared,
    of_record,
    record_of,
    role_of,
    shared,
    unit_of,
)
from rov_ident.discrepancy.output_error import Fitted, fit, refit
from rov_ident.discrepancy.results import Finding, Gain, Repetition, Value
from rov_ident.discrepancy.search import Search
from rov_ident.discrepancy.selection import PENALTY
from rov_ident.discrepancy.sensor_choice import HEADING, LATENCY
from rov_ident.discrepancy.windowed_problem import Spans, WindowedProblem
from rov_ident.effects import EFFECTS, Values
from rov_ident.model.equations import Array
from rov_ident.reports.result import NORMAL
from rov_ident.sampling.raw_streams import Streams, corrected

_NO_REPETITION = "it does not predict a record that was left out"
_VELOCITY_SENSOR = ("velocity_scale", "sensor_misalignment", "sensor_lever_arm")
_LINEAR = ("amplitude", "limit", "place")  # roles of parameters that a record can have of its own


class Records:
    """Several bags joined (`raw_streams.joined`): which part of the time is which."""

    def __init__(self, streams: Streams, bags: Sequence[Streams], begins: Sequence[float]) -> None:
        self.streams = streams
        self.spans = [(b, b + bag.duration) for bag, b in zip(bags, begins, strict=True)]

    def __len__(self) -> int:
        return len(self.spans)

    def at(self, t: float) -> int:
        """In which record something begins at a time; in the next one if between two."""
        return min(sum(end <= t for _, end in self.spans), len(self.spans) - 1)

    def blocks(self, which: Sequence[int]) -> Spans:
        """Some of the records, in blocks."""
        out: Spans = []
        for begin, end in (self.spans[i] for i in which):
            edges = np.linspace(begin, end, max(1, int((end - begin) // BLOCK)) + 1)
            out += itertools.pairwise(edges.tolist())
        return out


def in_each(
    search: Search,
    records: Records,
    last: Fitted,
    found: Sequence[Finding],
    alone: Sequence[Fitted | None],
) -> tuple[list[Finding], list[str]]:
    """Findings of the dynamics with what each record says of them, and the names of those that
    belong to each record; ``last`` is the model fitted to all, ``alone`` that fitted to each. One
    that does not repeat cannot be told for sure."""
    keys_of = {f.effect: search.keys_of(last, f.effect) for f in found}
    asked = [name for name, keys in keys_of.items() if is_shared(keys)]
    repeats = _left_out(search, records, last, asked, alone)
    out, own = [], []
    for f in found:
        keys = keys_of[f.effect]
        if not is_shared(keys):
            each = _of_their_own(last, keys, len(records))
            out.append(_with(f, Repetition(False, None, each)))
            continue
        names = [k for k in keys if role_of(k) in _LINEAR]
        onset = f.onset_s
        first = 0 if onset is None else records.at(onset)
        f = f if onset is None else _on_its_clock(f, records.spans[first][0])
        unknown = {shared(k)[1]: Value(np.nan, np.inf, unit_of(k)) for k in names}
        each = tuple(
            unknown if r < first else parameters_of(there or last, names)
            for r, there in enumerate(alone)
        )
        laden = _laden(last) if "weight" in EFFECTS[f.effect].traits else frozenset()
        same = _is_same([of for r, of in enumerate(each) if r >= first and r not in laden])
        told = _with(f, Repetition(same and not first, repeats.get(f.effect), each), first)
        if not (same and not first) and not repeats.get(f.effect):
            own.append(f.effect)
        out.append(told if onset is None else _begun(told, records, first, same))
    return out, own


def _laden(last: Fitted) -> frozenset[int]:
    """The records with something of their own that weighs or floats, each of which tells nothing by
    itself of what else does."""
    own = {k: r for k in last.hypothesis.keys if (r := record_of(k)) is not None}
    return frozenset(r for (effect, _), r in own.items() if "weight" in EFFECTS[effect].traits)


def _of_their_own(last: Fitted, keys: Sequence[Key], count: int) -> tuple[dict[str, Value], ...]:
    """What each of the ``count`` records says of an effect that single ones have: of any other how
    large it may be there, wherever it would act."""
    names = dict.fromkeys(shared(k) for k in keys)
    unknown = {name: Value(np.nan, np.inf, unit_of((effect, name))) for effect, name in names}
    told = []
    for r in range(count):
        own, there = [k for k in keys if record_of(k) == r], last
        if not own and not any(role_of(k) == "frequency" for k in names):
            # one at a time: beside the same effect of all, nothing could be told
            own = [of_record(k, r) for k in names if role_of(k) == "amplitude"]
            nulls = {k: bounds(k)[0] for k in own}
            there = refit(last.hypothesis.having(nulls), last.linearisation) or last
        own = [k for k in own if k in there.hypothesis.values]
        told.append(unknown | parameters_of(there, own))
    return tuple(told)


def alone(records: Records, last: Fitted, spans: Spans | None = None) -> list[Fitted | None]:
    """The model ``last`` fitted to each record, in ``spans`` [s] (None: to all of it); None where
    there is too little odometry."""
    if spans is None:
        every = range(len(records))
        spans = [s for a, b in records.blocks(every) for s in windows(a, b)]
    return [
        _fitted(records.streams, [s for s in spans if records.at(s[0]) == b], last)
        for b in range(len(records))
    ]


def of_each(h: Hypothesis, each: Sequence[Fitted | None]) -> Hypothesis:
    """A hypothesis with the values of fits to ``each`` record: of what records share the median."""
    values = {}
    for key in h.keys:
        own = record_of(key)
        fits = each if own is None else [each[own]]
        found = [f.hypothesis.values[key] for f in fits if f is not None]
        values[key] = float(np.median(found)) if found else h.values[key]
    return h.having(values)


def departing(
    final: Fitted, each: Sequence[Fitted | None], judges: Mapping[int, Judge]
) -> dict[int, Gain]:
    """The records that a fit to them alone, of ``each``, surely predicts better, by practical
    weight, than the ``final`` model fitted to all, and what that gains: something differs there
    that the model has one value of. ``judges`` hold data of each record that no fit has seen."""
    found = {}
    for r, judge in judges.items():
        own = each[r]
        if own is None:
            continue
        before, after = (f.hypothesis.in_record(r) for f in (final, own))
        gain = judge.gain(before, after)
        if judge.surely_better(after, before) and is_surely_practical(gain):
            found[r] = gain
    return found


def coefficients_by_distance(each: Sequence[Fitted | None]) -> dict[str, list[Value]]:
    """The coefficients of fits to ``each`` record, with the value in each; that which differs most
    comes first."""
    there = [f for f in each if f is not None]
    keys = [k for k in there[0].hypothesis.keys if k[0] == COEFFICIENTS] if there else []
    found = {k[1]: [v for f in there for v in parameters_of(f, [k]).values()] for k in keys}
    return dict(sorted(found.items(), key=lambda item: -_distance(item[1])))


def _on_its_clock(f: Finding, begin: float) -> Finding:
    """With the onset by the clock of the record, from ``begin`` [s] on, in which the effect begins:
    no clock of the user's shows the time of all records joined."""
    at = f.parameters["onset"]
    at = dataclasses.replace(at, value=max(at.value - begin, 0.0))
    parameters = {**f.parameters, "onset": at}
    words = sentence(f.effect, parameters, f.gain)
    return dataclasses.replace(f, parameters=parameters, onset_s=at.value, sentence=words)


def _begun(f: Finding, records: Records, b: int, lasts: bool) -> Finding:
    """In which record an effect begins, and when. A record that ends before says nothing of it but
    that it is not there."""
    count = len(records)
    words = f" It begins in record {b + 1}, {f.onset_s:.0f} s after its first message"
    words += ", and not before." if b else "."
    if b + 1 < count:
        words += " It is the same in those after it." if lasts else " Those after it differ."
    return dataclasses.replace(f, sentence=f.sentence + words)


def _fitted(streams: Streams, spans: Spans, last: Fitted) -> Fitted | None:
    """The model ``last`` fitted in some spans."""
    try:
        return fit(WindowedProblem(streams, thinned(spans)), last.hypothesis)
    except UserError:  # too little odometry
        return None


def of_sensors(
    bags: Sequence[Streams], config: Config, found: Sequence[Finding], headings: Sequence[float]
) -> list[Finding]:
    """The same of findings of the sensors; ``headings`` have been taken off the records before."""
    each, out = _in_each(bags, config, [f.effect for f in found]), []
    for f in found:
        values = [{name: of[name] for name in f.parameters} for of in each[f.effect]]
        if f.effect == HEADING and any(headings):
            values = [
                {n: dataclasses.replace(v, value=v.value + yaw) for n, v in of.items()}
                for of, yaw in zip(values, headings, strict=True)
            ]
        out.append(_with(f, Repetition(_is_same(values), None, tuple(values))))
    return out


def _in_each(
    bags: Sequence[Streams], config: Config, names: Sequence[str]
) -> dict[str, list[dict[str, Value]]]:
    """What each record's sensors say of some effects."""
    each = [
        sensor_consistency.search(bag, config, windows(0.0, bag.duration), names) for bag in bags
    ]
    return {
        name: [
            {
                # zero: this record's sensors tell nothing of it
                p.name: Value(at[name][p.name], std.get((name, p.name)) or np.inf, p.unit)
                for p in EFFECTS[name].parameters
            }
            for at, std in each
        ]
        for name in names
    }


def turned(bags: Sequence[Streams], config: Config) -> tuple[list[Streams], list[float]]:
    """Records with the heading of the first, and the headings that were taken off [rad], where the
    odometry of each shows that they differ: no sensor is mounted anew between two dives of a
    morning, but a heading is set to zero at each start."""
    none = [0.0] * len(bags)
    if len(bags) < 2 or not all(bag.has_pose for bag in bags):
        return list(bags), none
    yaw = []
    for bag in bags:
        found, std = sensor_consistency.search(bag, config, windows(0.0, bag.duration), [HEADING])
        own = float(np.hypot(std[HEADING, "yaw"], config.odometry.attitude_std))
        yaw.append(Value(found[HEADING]["yaw"], own, "rad"))
    apart = [float(np.angle(np.exp(1j * (v.value - yaw[0].value)))) for v in yaw]
    if _agree([dataclasses.replace(v, value=a) for v, a in zip(yaw, apart, strict=True)]):
        return list(bags), none
    return [corrected(bag, {HEADING: {"yaw": y}}) for bag, y in zip(bags, apart)], apart


OfEach = Sequence[dict[str, Value]]
"""The parameters of an effect in each of several records."""


def as_mounted(bags: Sequence[Streams], config: Config) -> tuple[list[Streams], dict[str, OfEach]]:
    """Records without what the velocity sensors of single ones show and others' do not, such as a
    mounting that was knocked or a sound speed that was set anew, and the parameters of these
    effects in each. In a search of all together, the others would hide it."""
    shown = [_of_velocity_sensor(bag, config) for bag in bags] if len(bags) > 1 else []
    names = list(dict.fromkeys(name for of in shown for name in of))
    own: dict[str, OfEach] = {}
    for name, values in (_in_each(bags, config, names) if names else {}).items():
        if not _is_same(values):
            own[name] = values
    off = [{name: of[name] for name in own if name in of} for of in shown]
    return [corrected(b, o) for b, o in zip(bags, off, strict=True)] if own else list(bags), own


def _of_velocity_sensor(bag: Streams, config: Config) -> Values:
    """The effects on the velocities of the odometry, but for delays, that a record surely shows."""
    (spans, held), names = split(bag.duration), set(_VELOCITY_SENSOR)
    if names.isdisjoint(sensor_consistency.search(bag, config, spans)[0]):
        return {}
    choice = sensor_choice.chosen(sensor_choice.Data(bag, spans, bag, held, config))
    return {n: of for n, of in choice.sensors.items() if n in names - choice.unsure}


def in_time(bags: Sequence[Streams], config: Config) -> tuple[list[Streams], list[Value]]:
    """Records whose velocities are of the time of their stamps, and how late they were [s], where
    the sensors of each show that this differs: a delay of some records, fitted to all, is an
    average that none of them has. Nothing where it is the same in each."""
    if len(bags) < 2 or not all(bag.has_pose for bag in bags):
        return list(bags), []
    late = []
    for bag in bags:
        spans = windows(0.0, bag.duration)
        found, _ = sensor_consistency.search(bag, config, spans)
        names = [*(n for n in found if n != LATENCY), LATENCY]
        found, std = sensor_consistency.search(bag, config, spans, names)
        # of two readings nobody knows when between them a velocity was what it is
        interval = float(np.median(np.diff(bag.imu_t if len(bag.imu_t) > 1 else bag.t)))
        own = float(np.hypot(std[LATENCY, "delay"], interval / np.sqrt(12.0)))
        late.append(Value(found[LATENCY]["delay"], own, "s"))
    if _agree(late):
        return list(bags), []
    off = [{LATENCY: {"delay": v.value}} for v in late]
    return [corrected(b, of) for b, of in zip(bags, off, strict=True)], late


def own_finding(
    before: Streams, after: Streams, config: Config, held: Spans,
    sensors: Values, name: str, each: OfEach,
) -> Finding:  # fmt: skip
    """An effect on a sensor that differs between the records: what taking it off each gains."""
    pair = [sensor_consistency.comparisons(s, config, sensors) for s in (before, after)]
    gain = kinematic_gain(pair, held)

    def distance(of: dict[str, Value]) -> float:
        return sum(((v.value - bounds((name, p))[0]) / v.std) ** 2 for p, v in of.items())

    found = in_words(name, (), max(each, key=distance), gain)
    return _with(found, Repetition(False, None, tuple(each)))


def _is_same(each: Sequence[Mapping[str, Value]]) -> bool:
    """Whether the parameters of ``each`` of several records differ by no more than chance."""
    return all(_agree([of[name] for of in each]) for name in (each[0] if each else ()))


def _agree(of: Sequence[Value]) -> bool:
    """Whether estimates differ by no more than chance."""
    return _distance(of) <= PENALTY * (len(of) - 1)


def _distance(of: Sequence[Value]) -> float:
    """Squared distances of estimates from their mean, in standard deviations, summed."""
    x, weight = np.array([v.value for v in of]), np.array([max(v.std, 1e-12) for v in of]) ** -2.0
    return float(weight @ (x - weight @ x / weight.sum()) ** 2)


def _with(f: Finding, repetition: Repetition, first: int = 0) -> Finding:
    """A finding that says what each record says; those before the ``first`` have nothing of it."""
    if first:
        return dataclasses.replace(f, repetition=repetition)
    names = repetition.records[0]  # an onset belongs to one record
    if repetition.same:
        words = " It is the same in each record."
    else:
        several = (", ".join(in_figures(of[n]) for of in repetition.records) for n in names)
        told = "; ".join(f"{n} {values}" for n, values in zip(names, several))
        words = f" The records differ: {told} (± 95 %)."
    if repetition.repeats is False:
        words += " Fitted to the others, it does not predict a record that was left out."
    f = unsure(f, _NO_REPETITION) if repetition.repeats is False else f
    return dataclasses.replace(f, repetition=repetition, sentence=f.sentence + words)


def in_figures(v: Value) -> str:
    return f"{v.value:.3g} ± {NORMAL * v.std:.2g}" if np.isfinite(v.std) else "not told"


def _left_out(
    search: Search,
    records: Records,
    last: Fitted,
    names: Sequence[str],
    alone: Sequence[Fitted | None],
) -> dict[str, bool]:
    """Of each effect that has no onset, which no other record can tell, whether a record is
    predicted better with it by fits to the others: surely all together, and none surely worse."""
    names = [n for n in names if not any(role_of(k) == "onset" for k in search.keys_of(last, n))]
    before: dict[str, list[Array]] = {n: [] for n in names}
    after: list[Array] = []
    for b in range(len(records)):
        others = [i for i in range(len(records)) if i != b]
        if len(others) == 1:
            there = alone[others[0]]
        else:
            spans = [s for begin, end in records.blocks(others) for s in windows(begin, end)]
            there = _fitted(records.streams, spans, last)
        if there is None:
            return {}
        try:
            problem = WindowedProblem(records.streams, records.blocks([b]))
        except UserError:  # too little odometry
            return {}
        judge = Judge(problem, likeliest=there.hypothesis)
        after.append(judge.summed(there.hypothesis)[:, judge.free])
        for name in names:
            without = there.hypothesis.without(search.keys_of(last, name))
            rest = refit(without, there.linearisation)
            h = without if rest is None else rest.hypothesis
            before[name].append(judge.summed(h)[:, judge.free])
    out = {}
    for name in names:
        pairs = list(zip(before[name], after, strict=True))
        x, y = (np.concatenate(of) for of in zip(*pairs, strict=True))
        out[name] = surely_less(y, x) and not any(surely_less(*pair) for pair in pairs)
    return out
