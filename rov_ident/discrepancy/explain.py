"""`explain`: from bags and a configuration to findings, an extended configuration and the series
that the report draws."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np

from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.discrepancy import certainty, empirical_term, extension, repetition, sensor_choice
from rov_ident.discrepancy.findings import (
    beginnings,
    changes,
    finding,
    gain_over,
    is_left,
    noise_finding,
    residuals,
    unsure,
    with_parameters,
)
from rov_ident.discrepancy.held_out import (
    PRACTICAL,
    Judge,
    blocks,
    improved,
    is_practical,
    is_sure,
    thinned,
    windows,
)
from rov_ident.discrepancy.hypothesis import UNKNOWN, Hypothesis, record_of
from rov_ident.discrepancy.output_error import Fitted, fit, refit, with_best_onsets
from rov_ident.discrepancy.prepared import OWN_VALUES, Prepared, prepare
from rov_ident.discrepancy.results import Alternative, Finding, Findings, Residual, Verdict
from rov_ident.discrepancy.search import Search, Trial, Trials, likeliest, with_own
from rov_ident.discrepancy.sensor_choice import HEADING, NOISE
from rov_ident.discrepancy.windowed_problem import ONSET_STEP, Spans, WindowedProblem
from rov_ident.effects import EFFECTS, with_trait
from rov_ident.model.coefficients import VELOCITIES
from rov_ident.model.equations import Array
from rov_ident.reports.result import Figure, Shown
from rov_ident.reports.table import Tables
from rov_ident.sampling.raw_streams import Streams

_AS_GOOD = 0.95  # of what a term without a name explains: a named effect that does is preferred
_NEAR_ONSET = 2.0  # s; as far apart as the onsets that the search tries
_SHORTEST = 20.0  # s of data: two blocks, one to fit and one to judge

CUT_SHORT = (
    "the search was cut short after as much simulation as it may take: not all further effects, "
    "and in place of those found only other effects, were tried; a configuration that fits better "
    "helps (rov-ident fit, where it says that model and data agree)"
)
_OF_THIS_DIVE = (
    "{} may belong to this dive alone: take it out of the extended configuration to simulate "
    "another, or explain several dives together"
)
_BESIDE_GIVEN = "what is told of {} is beside what the configuration has of it"
_DEPARTS = (
    "the records differ in what no effect describes: with coefficients of its own, the {}; what "
    "differs most is {} (± 95 %)"
)
_MOST_DIFFERING = 3  # coefficients that are told
_ONE_VALUE = "the records differ in {}: the extended configuration has one value for all"
_RECORDS_DIFFER = "the records differ in what has no name"
_OF_CONTRADICTION = "the sensors still contradict each other"
_AFTERWARDS = "only what was left after the search asked for it"
_ALL_IN_NOISE = (
    "the wrench cannot be told from noise of its reading on any axis: record the commands without "
    "noise, or drive the vehicle well above it"
)
_ONLY_FITTED = (
    "the extended model cannot be simulated through all of the data: its values are those of the "
    "part that the search fitted"
)

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Explanation(Shown):
    """Everything that `explain` made of the bags: the configuration that was judged and the same
    with what was found; measured velocities (N, 6) at ``t`` (N,) and, by label ("as configured",
    "retuned", "extended"), open-loop simulations (N, 6) in windows of held_out.BLOCK seconds (NaN:
    diverged); the spans [s] that no fit saw."""

    findings: Findings
    given: Config
    extended: Config
    t: Array
    measured: Array
    simulated: Mapping[str, Array]
    held: Sequence[tuple[float, float]]

    @property
    def sentence(self) -> str:
        """What the simulation lacks, and what that gains."""
        return report().verdict(self.findings)

    def table(self) -> Tables:
        """The error of the three models, and every effect found with its gain."""
        return report().tables(self.findings)

    def plot(self) -> Figure:
        """Motion, gain and departure of the velocity that gains most."""
        return report().picture(self)

    def to_json(self) -> str:
        """The findings."""
        return self.findings.to_json()

    def page(self) -> str:
        """The report as one HTML document."""
        return report().page(self)

    def _writers(self) -> dict[str, Callable[[Path], None]]:
        more: dict[str, Callable[[Path], None]] = {
            ".yaml": lambda path: report().write_extended(self, path),
            "": lambda path: report().write(self, path),
        }
        return super()._writers() | more


def report() -> ModuleType:
    """The module of the report, which knows this one and loads matplotlib."""
    return import_module("rov_ident.discrepancy.report")


@dataclass
class _Model:
    """The extended model as it takes shape: fitted to the part of the data that fits may see."""

    final: Fitted
    trials: Trials
    found: list[Finding] = dataclasses.field(default_factory=list)
    minor: list[Finding] = dataclasses.field(default_factory=list)


def explain(
    bags: Sequence[Streams],
    config: Config,
    validate: Streams | None = None,
    progress: Progress | None = None,
) -> Explanation:
    """Find what the configured simulation lacks; ``progress(what, share)`` is called now and then
    with the share that is done. UserError if the bags are too short, or the model cannot be
    simulated at all."""
    say = progress or (lambda what, share: None)
    total = sum(bag.duration for bag in bags)
    if total < _SHORTEST:
        raise UserError(
            f"the bags hold {total:.0f} s of data: at least {_SHORTEST:.0f} s are needed to find "
            "anything"
        )
    say("comparing the sensors", 0.05)
    data = prepare(bags, config, validate)
    say("refitting the coefficients", 0.1)
    search, start, data = _started(data, config)
    retuned, model, residual = _searched(search, start, say)
    # in a model that lacks much, noise of the wrench's reading may not have shown
    again = search
    if model.final.noise_counts:
        again, data = _with_reading(search, model.final, data)
    if again is not search:
        search = again
        retuned, model, residual = _searched(search, search.start(), say)
    say("judging on held-out data", 0.9)
    searched, begun = model.final.hypothesis, beginnings(model.final)
    judge = Judge(WindowedProblem(data.judged, data.to_judge), data.sensors, searched, begun)
    _judge_effects(search, judge, retuned, model)
    if begun and begun != beginnings(model.final):
        begun = beginnings(model.final)
        judge = Judge(judge.problem, data.sensors, searched, begun)
    _add_term(search, judge, retuned, model)
    of_sensors = list(data.findings)
    if search.config is not config:
        std = sensor_choice.noise_std(data.streams, search.config.effects[NOISE])
        of_sensors.append(noise_finding(judge, model.final, config, std))
    minor = model.minor + [f for f in of_sensors if not is_practical(f.gain)]
    of_sensors = [f for f in of_sensors if is_practical(f.gain)]
    last, notes = _with_all_data(data.streams, model.final)
    there = [f for f in model.found if is_left(search, last, f.effect)]
    of_dynamics = [with_parameters(search, last, f) for f in there]
    departs, differing = "", list[Hypothesis]()
    if len(bags) > 1:
        say("leaving records out", 0.95)
        of_dynamics, last, of_records = _in_each_record(
            search, judge, data, retuned, model, last, of_dynamics
        )
        notes += of_records
        if not data.validated:
            each = repetition.alone(data.records, model.final, data.to_fit)
            model.final = _begun_from_each_record(search, model.final, each)
            departs = _departing(data, model.final, each, begun)
        if departs:
            differing = [f.hypothesis for f in each if f is not None]
            of_dynamics = [unsure(f, _RECORDS_DIFFER) for f in of_dynamics]
        minor += [f for f in of_dynamics if not is_practical(f.gain)]
        of_dynamics = [f for f in of_dynamics if is_practical(f.gain)]
    given = Hypothesis(config, {})
    problem = WindowedProblem(data.recorded.judged, data.to_judge)
    as_recorded = Judge(problem, likeliest=searched, left_out=begun)
    final = _without_minor_noise(model.final.hypothesis, data, of_sensors)
    written = extension.kept(
        extension.AsGiven(judge, as_recorded.summed(given)),
        extension.AsGiven(
            Judge(judge.problem, data.sensors, left_out=begun),
            Judge(problem, left_out=begun).summed(given),
        ),
        final,
    )
    best = written.model or given
    compared = {"as configured": given, "retuned": retuned.hypothesis, "extended": best}
    judges = {"as configured": as_recorded} | ({"extended": as_recorded} if best is given else {})
    rmse = [judges.get(label, judge).rmse(h) for label, h in compared.items()]
    left = certainty.left(data.judged, rmse[2], judge.rmse_of_noise())
    found = certainty.doubted(data, of_sensors + of_dynamics, left)
    for i, f in enumerate(found):
        if f.effect == empirical_term.NAME:
            found[i] = empirical_term.described(f, last.hypothesis)
            residual = residual or [empirical_term.residual(f, last.hypothesis)]
    improves = is_practical(judge.gain(search.given, retuned.hypothesis))
    minor = [f for f in minor if is_sure(f.gain) or f.gain.percent >= 100.0 * PRACTICAL]
    minor = [f if is_sure(f.gain) else unsure(f) for f in minor]
    verdict: Verdict = "unexplained"
    if not departs:
        verdict = certainty.verdict(found, minor, residual, left, improves)
    if verdict == "unexplained" and left and not residual:
        axes = [VELOCITIES.index(c) for c in sorted(left, key=lambda c: -left[c])]
        residual = empirical_term.best_dependences(search.problem, model.final, axes)
    everything = WindowedProblem(data.streams, blocks(data.streams))
    notes = [*data.choice.notes, *notes, *filter(None, [written.note, certainty.told(left)])]
    passing = [name for name in with_trait("dive") if name in best.effects]
    known = [name for name in data.sensors if name in config.effects]
    notes += [_BESIDE_GIVEN.format(" and ".join(known))] if known else []
    notes += [_OF_THIS_DIVE.format(" and ".join(passing))] if passing and len(bags) == 1 else []
    notes += data.notes
    notes += [CUT_SHORT] if search.cut_short else []
    say("done", 1.0)
    findings = Findings(
        rmse[0],
        rmse[1],
        rmse[2],
        changes(config, retuned, [model.final.hypothesis, *differing]),
        tuple(sorted(found, key=lambda f: -f.gain.percent)),
        tuple(minor),
        tuple(residual),
        verdict,
        (*data.streams.notes, *notes),
        contradictions=(departs,) if departs else (),
    )
    return Explanation(
        findings,
        config,
        config if written.model is None else _extended(last.hypothesis, written.axes, data, found),
        everything.times,
        everything.measured,
        {label: everything.measured - everything.errors(h) for label, h in compared.items()},
        [] if data.validated else data.to_judge,
    )


def contradicted(explained: Explanation, why: Sequence[str]) -> Explanation:
    """The explanation where sensors contradict each other with the extended configuration, too, as
    the sentences ``why`` say: something is left, and may have made what was found."""
    if not why:
        return explained
    of = explained.findings
    effects, minor = (
        tuple(unsure(f, _OF_CONTRADICTION) for f in found) for found in (of.effects, of.minor)
    )
    of = dataclasses.replace(
        of,
        effects=effects,
        minor=minor,
        contradictions=(*of.contradictions, *why),
        verdict="unexplained",
    )
    return dataclasses.replace(explained, findings=of)


def _in_each_record(
    search: Search,
    judge: Judge,
    data: Prepared,
    retuned: Fitted,
    model: _Model,
    last: Fitted,
    found: Sequence[Finding],
) -> tuple[list[Finding], Fitted, list[str]]:
    """The findings with what each record says of them, the model fitted to all of the data, which
    was ``last``, and notes. What does not repeat becomes each record's own, there and in the
    ``model``, unless that surely predicts worse."""
    records = data.records
    alone = repetition.alone(records, last)
    found, own = repetition.in_each(search, records, last, found, alone)
    if own:
        keys = [k for name in own for k in search.keys_of(last, name)]
        of_fits = repetition.alone(records, model.final, data.to_fit)
        parted, all_parted = (
            with_own(fitted, keys, [f.hypothesis.values if f else {} for f in each])
            for fitted, each in ((model.final, of_fits), (last, alone))
        )
        if parted is not None and all_parted is not None:
            after = parted.hypothesis.shared if data.validated else parted.hypothesis
            if not judge.surely_better(model.final.hypothesis, after):
                rest = {name: search.rest(model.final, name) for name in own}
                found = [
                    _gaining(f, judge, [retuned, rest[f.effect]], after) if f.effect in own else f
                    for f in found
                ]
                model.final, last = dataclasses.replace(parted, hypothesis=after), all_parted
    apart = list(dict.fromkeys(k[0] for k in last.hypothesis.keys if record_of(k) is not None))
    notes = [OWN_VALUES.format(", ".join(apart))] if apart else []
    repeated = {f.effect: f.repetition for f in found if f.repetition is not None}
    differ = [name for name, of in repeated.items() if not of.same and name not in apart]
    return found, last, notes + ([_ONE_VALUE.format(", ".join(differ))] if differ else [])


def _begun_from_each_record(search: Search, final: Fitted, each: Sequence[Fitted | None]) -> Fitted:
    """The model fitted once more, from what fits to ``each`` record say, where that is likelier: of
    several currents, a search that began without any may end in another minimum."""
    begin = repetition.of_each(final.hypothesis, each)
    as_it_is = refit(final.hypothesis, final.linearisation, update_noise=True)
    return likeliest([as_it_is, fit(search.problem, begin)]) or final


def _departing(data: Prepared, final: Fitted, each: Sequence[Fitted | None], begun: Spans) -> str:
    """Which records a fit of their own, of ``each``, predicts better, and in what they differ, in
    words; nothing where none does."""
    records, held = data.records, data.to_judge
    judges = {}
    for r in range(len(records)):
        with contextlib.suppress(UserError):  # too little odometry
            problem = WindowedProblem(data.judged, [s for s in held if records.at(s[0]) == r])
            judges[r] = Judge(problem, data.sensors, final.hypothesis, begun)
    found = repetition.departing(final, each, judges)
    if not found:
        return ""
    better = ", the ".join(f"{improved(gain)} in record {r + 1}" for r, gain in found.items())
    differ = list(repetition.coefficients_by_distance(each).items())[:_MOST_DIFFERING]
    told = (f"{n} {', '.join(map(repetition.in_figures, of))}" for n, of in differ)
    return _DEPARTS.format(better, "; ".join(told))


def _gaining(
    found: Finding, judge: Judge, without: Sequence[Fitted | None], after: Hypothesis
) -> Finding:
    """The finding with what it gains where each record has values of its own, over the best of the
    models ``without`` it."""
    rests = [f.hypothesis for f in without if f is not None]
    best = rests[0]
    for rest in rests[1:]:
        best = rest if judge.better(rest, best) else best
    gain = judge.gain(best, after, found.axes)
    words = found.sentence.replace(improved(found.gain), improved(gain))
    return dataclasses.replace(found, gain=gain, sentence=words)


def _started(data: Prepared, config: Config) -> tuple[Search, Fitted | None, Prepared]:
    """The search, the fit from which it starts, and the data, with what these two tell of noise of
    the wrench's reading."""
    search = data.search(config)
    start = search.start()
    if start is None:
        return search, None, data
    again, data = _with_reading(search, start, data)
    return again, start if again is search else again.start(), data


def _with_reading(search: Search, fitted: Fitted, data: Prepared) -> tuple[Search, Prepared]:
    """The search with the noise of the wrench's reading in its configuration, where the fit tells
    of any, and the data without the axes that are lost in it; the same ones where there is none.
    UserError if no axis is left."""
    lasts, none = sensor_choice.noise_that_lasts(fitted), np.zeros(6, dtype=bool)
    if (lasts != data.streams.noise_lasts).any():
        data = data.with_noise(none, lasts)
        search = data.search(search.config)
        fitted = search.start() or fitted
    reading = sensor_choice.noise_of_wrench(search, fitted)
    if not (reading.values or reading.lost.any()):
        return search, data
    values, data = reading.values, data.with_noise(reading.lost, lasts)
    if data.streams.guided.all():
        raise UserError(_ALL_IN_NOISE)
    config = sensor_choice.with_noise(search.given, values).config if values else search.config
    return data.search(config), data


def _searched(
    search: Search, start: Fitted | None, say: Progress
) -> tuple[Fitted, _Model, list[Residual]]:
    """The retuned model, the extended one, and what is left that has no name. UserError if the
    configured model cannot be simulated."""
    path = search.run(lambda what: say("searching: " + what, 0.3), start)
    if not path:
        raise UserError(
            "the configured model diverges within seconds of simulation: check the signs and sizes "
            "of its coefficients and the axes of the bag"
        )
    say("trying rivals", 0.6)
    final, trials = search.try_rivals(path[-1], lambda what: say("trying rivals: " + what, 0.7))
    # effects that led to another minimum may end there as nothing, and one before was the better
    cheapest = min((final, *path), key=lambda f: search.cost(f, final))
    if cheapest is not final:
        final, trials = search.try_rivals(cheapest)
    say("looking at what is left", 0.8)
    left = search.unexplained(final)
    if left:
        final, trials = search.try_rivals(left[-1])
    return path[0], _Model(final, trials), residuals(final, trials)


def _judge_effects(search: Search, judge: Judge, retuned: Fitted, model: _Model) -> None:
    """Turn the effects of a model into findings, and take those of no practical weight out of it.
    Two effects that do the same on the held-out data gain nothing beside each other, and all
    together: the slightest leaves, and the rest is judged anew."""
    trials = {n: t for n, t in model.trials.items() if not n.startswith(UNKNOWN)}
    rests = {n: t.rest for n, t in trials.items()}
    while True:
        gains = {
            n: gain_over(search, judge, retuned, model.final, n, rest)[0]
            for n, rest in rests.items()
        }
        small = [n for n, gain in gains.items() if not is_practical(gain)]
        if len(small) < 2:
            break
        least = min(small, key=lambda n: gains[n].percent)
        model.final = rests.pop(least)
        rests = search.rests(model.final, list(rests))
        trials = {}
    trials = trials or search.trials(rests)
    found = search.problem.map(
        lambda of: finding(search, judge, retuned, model.final, *of), trials.items()
    )
    slight = [f for f in found if not is_practical(f.gain)]
    model.minor = slight
    model.found = [f for f in found if f not in slight]
    gone = [k for f in slight for k in search.keys_of(model.final, f.effect)]
    gone += [k for k in model.final.hypothesis.keys if k[0] == UNKNOWN]
    if gone:
        kept = model.final.hypothesis.without(gone)
        if kept.keys == retuned.hypothesis.keys:  # and not another optimum of the same
            model.final = retuned
        else:
            model.final = refit(kept, model.final.linearisation) or retuned


def _add_term(search: Search, judge: Judge, retuned: Fitted, model: _Model) -> None:
    """What is left becomes a term without a name, if that gains on held-out data; or a named effect
    that explains as much, which is not sure, as it was not found by itself."""
    rest = model.final
    term = empirical_term.found(search.problem, rest)
    if term is None or not empirical_term.exceeds_errors_of_attitude(search.problem, term):
        return
    best, name = term, empirical_term.NAME
    rivals = search.by_effect(rest, search.fit_best(rest, search.candidates(rest)))
    for f in model.found:  # more coefficients of what is there
        rivals.pop(f.effect, None)
    for rival, fitted in rivals.items():
        as_good = rest.squares - fitted.squares >= _AS_GOOD * (rest.squares - term.squares)
        as_good = as_good and not judge.surely_better(term.hypothesis, fitted.hypothesis)
        as_good = as_good or judge.better(fitted.hypothesis, term.hypothesis)
        if as_good and search.is_determined(rest, fitted) and fitted.squares < best.squares:
            best, name = fitted, rival
    rivals.pop(name, None)
    gain = finding(search, judge, retuned, best, name, Trial(rest, rivals))
    if not is_practical(gain.gain):
        return
    gain = unsure(gain, _AFTERWARDS)
    if name != empirical_term.NAME:
        term_too = Alternative(empirical_term.NAME, "fits this bag as well")
        gain = dataclasses.replace(gain, alternatives=(*gain.alternatives, term_too))
    model.final = best
    model.found.append(gain)


def _with_all_data(streams: Streams, final: Fitted) -> tuple[Fitted, list[str]]:
    """The extended model fitted to all of the data, and notes."""
    halves = [s for a, b in blocks(streams) for s in windows(a, b)]
    last = fit(WindowedProblem(streams, thinned(halves)), final.hypothesis)
    notes = [] if last is not None else [_ONLY_FITTED]
    last = with_best_onsets(last or final)
    return with_best_onsets(last, around=_NEAR_ONSET, every=ONSET_STEP), notes


def _without_minor_noise(h: Hypothesis, data: Prepared, found: Sequence[Finding]) -> Hypothesis:
    """A hypothesis with the noise of the wrench's reading only if it is among what was found."""
    if any(f.effect == NOISE for f in found):
        return h
    return sensor_choice.with_noise(h, data.recorded.config.effects.get(NOISE, {}))


def _beside_given(config: Config, effect: str, found: Mapping[str, float]) -> dict[str, float]:
    """The parameters of an effect on a sensor with what was ``found`` beside those that the file
    has, which were taken off the data before: what is added adds up, factors multiply."""
    given = config.effects.get(effect, {})
    nulls = {p.name: p.null for p in EFFECTS[effect].parameters}
    return {
        n: given.get(n, null) * found[n] / null if null else given.get(n, null) + found[n]
        for n, null in nulls.items()
    }


def _extended(
    h: Hypothesis, kept: Sequence[str], data: Prepared, found: Sequence[Finding]
) -> Config:
    """The configuration of a hypothesis with what was found; the rows of the axes ``kept`` are as
    in the file. A heading that each bag has of its own is in none."""
    h = _without_minor_noise(extension.without_rows(h, kept), data, found)
    sensors = {n: _beside_given(h.config, n, v) for n, v in data.sensors.items()}
    if any(data.headings):
        sensors.pop(HEADING, None)
    config = h.config
    document = configuration.to_parameters(config)
    document["coefficients"] = {**document["coefficients"], **h.coefficients}
    if effects := h.effects | sensors:
        if len(data.bags) > 1:  # what is there after the last is there from the start of another
            begun = {name: {**of, "onset": 0.0} for name, of in effects.items() if "onset" in of}
            effects |= begun
        document["effects"] = effects
    chosen = document.pop("estimate", None)
    extended = configuration.from_parameters(document)
    if chosen is not None:  # what was found is to be estimated live, too
        own = set(config.model.names) - set(config.estimate)
        names = tuple(n for n in extended.model.names if n not in own)
        of_effects = tuple(
            (effect, parameter)
            for effect, parameter in extended.estimate_effects
            if effect not in config.effects or (effect, parameter) in config.estimate_effects
        )
        extended = dataclasses.replace(extended, estimate=names, estimate_effects=of_effects)
    return extended
