"""`explain`: from bags and a configuration to findings, an extended configuration and the series
that the report draws."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rov_ident import config as configuration
from rov_ident import kinematics
from rov_ident.coefficients import AXES, VELOCITIES, parse
from rov_ident.config import Config
from rov_ident.discrepancy import (
    PLAIN,
    PLAINLY,
    Search,
    Trial,
    Trials,
    covariance,
    foretold,
    pinned,
)
from rov_ident.effects import EFFECTS
from rov_ident.errors import UserError
from rov_ident.evidence import Evidence, Fitted, within
from rov_ident.excitation import authority
from rov_ident.findings import (
    Alternative,
    Change,
    Finding,
    Findings,
    Gain,
    Residual,
    Value,
    Verdict,
)
from rov_ident.hypothesis import COEFFICIENTS, UNKNOWN, Hypothesis, Key, bounds, parameter
from rov_ident.model import Array
from rov_ident.scores import SURE, inflation
from rov_ident.streams import Streams, joined

BLOCK = 10.0  # s; held-out data are whole blocks, and windows for judging are as long
_WINDOW = 5.0  # s; of the windows of the fit
_MARGIN = 0.25  # s; cut off beside held-out blocks
_CHUNK = 2.5  # s; of the bootstrap
_DRAWS = 2000  # of it
_WORTH = 0.02  # gain from which an effect has practical weight
_ALL = 0.98  # share of what a finding explains that counts as all of it
_EARLY = "the same if it was there before the bag began, which this bag cannot tell"
_AS_WELL = "fits this bag as well"
_ENOUGH = 600.0  # s; of data to fit
_LIMIT = 3.0  # a simulation further off than so many standard deviations of the motion has failed

CUT_SHORT = (
    "the search was cut short after as much simulation as it may take: not all further effects, or "
    "rivals of those found, were tried; a configuration that fits better (rov-ident fit) helps"
)
_NO_TORQUE = (
    "the wrench of these bags never holds a moment: how the vehicle turns is taken from the "
    "measurement, not simulated, and nothing is said about it"
)

Spans = list[tuple[float, float]]


def split(duration: float) -> tuple[Spans, Spans]:
    """Spans to fit and spans to judge on: of ten blocks the second, sixth and ninth are held out.

    A bag of less than four blocks holds out its last third.
    """
    fit: Spans = []
    held: Spans = []
    count = round(duration / BLOCK)
    if count < 4:
        edge = 0.7 * duration
        return _halved(0.0, edge - _MARGIN), [(edge + _MARGIN, duration)]
    for i in range(count):
        begin, end = i * BLOCK, (i + 1) * BLOCK if i + 1 < count else duration
        if (3 * i + 7) // 10 > (3 * i + 4) // 10:
            held.append((begin, end))
        else:
            fit += _halved(begin + _MARGIN, end - _MARGIN)
    return fit, held


def _halved(begin: float, end: float) -> Spans:
    edges = np.linspace(begin, end, max(1, round((end - begin) / _WINDOW)) + 1)
    return list(itertools.pairwise(edges.tolist()))


@dataclass(frozen=True)
class Explanation:
    """Everything that `explain` made of the bags.

    ``extended`` is the configuration with what was found. For pictures: measured velocities (N, 6)
    at ``t`` (N,) and, by label ("as configured", "retuned", "extended"), open-loop simulations
    (N, 6) in windows of BLOCK seconds (NaN: diverged); ``held`` are the spans [s] that no fit saw.
    """

    findings: Findings
    extended: Config
    t: Array
    measured: Array
    simulated: Mapping[str, Array]
    held: Sequence[tuple[float, float]]


def explain(
    bags: Sequence[Streams],
    config: Config,
    validate: Streams | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Explanation:
    """Find what the configured simulation lacks.

    ``progress(what, share)`` is called now and then with the share that is done.

    Raises
    ------
    UserError
        If the bags are too short, or the model cannot be simulated at all.
    """
    streams, begins = joined(bags)
    _check(streams, bags)
    say = progress or (lambda what, share: None)
    fit: Spans = []
    held: Spans = []
    for bag, begin in zip(bags, begins, strict=True):
        mine, others = split(bag.duration) if validate is None else (whole(bag.duration), [])
        fit += [(begin + a, begin + b) for a, b in mine]
        held += [(begin + a, begin + b) for a, b in others]

    say("comparing the sensors", 0.05)
    judge_streams, judge_spans = (
        (streams, held) if validate is None else (validate, blocks(validate))
    )
    sensors, sensor_std = kinematics.search(streams, config, _inside(fit))
    sensor_findings = _sensor_findings(
        streams, judge_streams, config, sensors, sensor_std, fit, judge_spans
    )
    sensors = {f.effect: sensors[f.effect] for f in sensor_findings if weighty(f)}
    streams = kinematics.corrected(streams, sensors)
    judge_streams = kinematics.corrected(judge_streams, sensors)

    say("refitting the coefficients", 0.1)
    search = Search(streams, config, thinned(fit))
    path = search.run(lambda what: say("searching: " + what, 0.3))
    if not path:
        raise UserError(
            "the configured model diverges within seconds of simulation: check the signs and sizes "
            "of its coefficients and the axes of the bag"
        )
    say("trying rivals", 0.6)
    final, trials = search.settle(path[-1], lambda what: say("trying rivals: " + what, 0.7))
    say("looking at what is left", 0.8)
    left = search.unexplained(final)
    if left:
        final, trials = search.settle(left[-1])
    residual = _residual(final, trials)

    say("judging on held-out data", 0.9)
    judge = Judge(Evidence(judge_streams, judge_spans))
    retuned = path[0].hypothesis
    final, found, borne = _judged(search, judge, final, trials)
    minor = [f for f in found if not weighty(f) and f.effect not in borne]
    slight = [k for f in minor for k in search.keys_of(final, f.effect)]
    patterns = [k for k in final.hypothesis.keys if k[0] == UNKNOWN]
    if slight or patterns:
        kept = final.hypothesis.without([*slight, *patterns])
        if kept.keys == retuned.keys:  # and not another optimum of the same
            final = path[0]
        else:
            final = search.evidence.fit(kept, final.look) or path[0]
    halves = [s for a, b in blocks(streams) for s in _halved(a, b)]
    everything = Evidence(streams, thinned(halves))
    last = everything.fit(final.hypothesis, None) or final
    last = everything.dated(last)
    for f in [f for f in found if f not in minor and not _certain(search, last, f.effect)]:
        minor.append(f)
        gone = search.keys_of(final, f.effect)
        final = search.evidence.fit(final.hypothesis.without(gone), final.look) or final
        last = everything.fit(last.hypothesis.without(gone), last.look, update_noise=True) or last
    found = [f for f in found if f not in minor]
    findings = sorted(
        [
            *(f for f in sensor_findings if weighty(f)),
            *(_with_parameters(search, last, f) for f in found),
        ],
        key=lambda f: -f.gain.percent,
    )
    minor += [f for f in sensor_findings if not weighty(f)]
    minor = [f for f in minor if f.gain.low > 0.0 or f.gain.percent >= 100.0 * _WORTH]
    extended = _extended(config, last.hypothesis, sensors)
    tuning = judge.gain(search.given, retuned)
    verdict: Verdict = "agrees"
    if residual:
        verdict = "unexplained"
    elif findings:
        verdict = "explained"
    elif _has_weight(tuning):
        verdict = "retuned"
    evidence = Evidence(streams, blocks(streams))
    simulated = {
        label: evidence.measured - evidence.errors(h)
        for label, h in (
            ("as configured", search.given),
            ("retuned", retuned),
            ("extended", final.hypothesis),
        )
    }
    notes = [*streams.notes]
    notes += [_NO_TORQUE] if streams.guided.any() else []
    notes += [CUT_SHORT] if search.cut_short else []
    say("done", 1.0)
    return Explanation(
        Findings(
            judge.rmse(search.given),
            judge.rmse(retuned),
            _changed(config, path[0]),
            tuple(findings),
            tuple(minor),
            tuple(residual),
            judge.rmse(final.hypothesis),
            verdict,
            tuple(notes),
        ),
        extended,
        evidence.times,
        evidence.measured,
        simulated,
        judge_spans if validate is None else [],
    )


def _judged(
    search: Search, judge: "Judge", final: Fitted, trials: Trials
) -> tuple[Fitted, list[Finding], set[str]]:
    """The findings of a model, without those that others can stand in for, and the names of those
    that others need.

    Two effects that do the same on the held-out data gain nothing beside each other, and all
    together: the slightest leaves, and the rest is judged anew.
    """
    while True:
        known = {n: t for n, t in trials.items() if not n.startswith(UNKNOWN)}
        found = [_finding(search, judge, final, name, trial) for name, trial in known.items()]
        slight = [f for f in found if not weighty(f)]
        borne = {f.effect for f in slight if _bears(search, judge, final, known, f.effect)}
        slight = [f for f in slight if f.effect not in borne]
        if len(slight) < 2:
            return final, found, borne
        least = min(slight, key=lambda f: f.gain.percent)
        rest = known[least.effect].rest
        final, trials = rest, search.trials(rest)


def _bears(search: Search, judge: "Judge", final: Fitted, trials: Trials, name: str) -> bool:
    """Whether a term that every hull has is what makes another effect show.

    By itself such a term may surely gain nothing where what it bears is worth nothing without it:
    then it counts what both gain.
    """
    rest = trials[name].rest
    for other in trials if name in PLAIN else ():
        if other == name:
            continue
        keys = [k for n in (name, other) for k in search.keys_of(final, n)]
        neither = search.evidence.fit(final.hypothesis.without(keys), final.look)
        if neither is None or search.worth(neither, rest, final) >= SURE:
            continue
        gain = judge.gain(neither.hypothesis, final.hypothesis)
        if _has_weight(gain):
            return True
    return False


def weighty(finding: Finding) -> bool:
    """Whether an effect is of practical weight."""
    return _has_weight(finding.gain)


def _has_weight(gain: Gain) -> bool:
    return gain.percent >= 100.0 * _WORTH and gain.low > 0.0


def whole(duration: float) -> Spans:
    """Spans to fit where everything may be used."""
    return _halved(0.0, duration)


def blocks(streams: Streams) -> Spans:
    """The whole bag in blocks."""
    count = max(1, int(streams.t[-1] // BLOCK))
    edges = [*(BLOCK * i for i in range(count)), float(streams.t[-1]) + 1e-6]
    return list(itertools.pairwise(edges))


def _inside(spans: Spans) -> Callable[[Array], NDArray[np.bool_]]:
    return lambda t: within(spans, t)


def thinned(spans: Spans) -> Spans:
    """As many of the spans, evenly spread, as it takes: more would cost time and tell little."""
    every = sum(end - begin for begin, end in spans) / _ENOUGH
    if every <= 1.0:
        return spans
    return [spans[int(i)] for i in np.arange(0.0, len(spans), every)]


def _check(streams: Streams, bags: Sequence[Streams]) -> None:
    total = sum(bag.duration for bag in bags)
    if total < 20.0:
        raise UserError(
            f"the bags hold {total:.0f} s of data: at least 20 s are needed to find anything"
        )


class Judge:
    """Open-loop simulation on data that no fit has seen."""

    def __init__(self, evidence: Evidence) -> None:
        self._evidence = evidence
        self._guided = evidence.guided
        self._limit = _LIMIT * evidence.measured.std(axis=0) + 1e-9
        self._number, self._chunk = np.unique(
            (evidence.times / _CHUNK).astype(int), return_inverse=True
        )

    def squares(self, h: Hypothesis) -> Array:
        """Squared errors (N, 6); a simulation that fails is as far off as the motion is large."""
        error = np.abs(self._evidence.errors(h))
        capped: Array = np.where(error < self._limit, error, self._limit) ** 2
        return capped

    def rmse(self, h: Hypothesis) -> dict[str, float]:
        error = np.where(self._guided, np.nan, np.sqrt(self.squares(h).mean(axis=0)))
        return dict(zip(VELOCITIES, error.tolist(), strict=True))

    def gain(
        self,
        before: Hypothesis,
        after: Hypothesis,
        beside: tuple[float, float] | None = None,
        axes: Sequence[str] = (),
    ) -> Gain:
        """Of the component that gains most, of those that surely gain if any do.

        The windows that reach into the time ``beside`` (from and to [s]) do not count. Where none
        of all surely gains, those of the ``axes`` on which an effect acts are looked at alone: an
        interval that holds for six is wide where the vehicle was driven in one.
        """
        free, use = np.flatnonzero(~self._guided), self._used(beside)
        a, b = (self.summed(h)[use] for h in (before, after))
        count = int(use[self._chunk].sum())
        own = np.array([i for i in free if AXES[i] in axes], dtype=int)
        gains = [
            gain_of([VELOCITIES[i] for i in of], a[:, of], b[:, of], count)
            for of in (free, own)
            if len(of)
        ]
        return next((g for g in gains if g.low > 0.0), gains[0])

    def _used(self, beside: tuple[float, float] | None) -> NDArray[np.bool_]:
        """Which chunks count."""
        e, use = self._evidence, np.ones(len(self._number), dtype=bool)
        if beside is not None:
            begin, end = e.steps.t[e.first], e.steps.t[e.last]
            out = (end > beside[0]) & (begin < beside[1])
            use[self._chunk[out[e.window]]] = False
        return use if use.any() else ~use

    def better(
        self, rival: Hypothesis, h: Hypothesis, beside: tuple[float, float] | None = None
    ) -> bool:
        """Whether a rival predicts better, all velocities taken together."""
        free, use = ~self._guided, self._used(beside)
        a, b = (self.summed(x)[np.ix_(use, free)].sum(axis=0) for x in (rival, h))
        return bool(_log_ratio(a, b).sum() < 0.0)

    def summed(self, h: Hypothesis) -> Array:
        """Squared errors (C, 6) summed over chunks of time."""
        return np.stack([np.bincount(self._chunk, x) for x in self.squares(h).T], axis=1)


def gain_of(components: Sequence[str], before: Array, after: Array, count: float | Array) -> Gain:
    """Gain of one of K components, from squared errors summed over chunks of time, (C, K).

    The intervals come from resampled chunks and hold for all components at once: no deviation from
    its component's gain, in units of its spread, is larger in 95 % of the draws (Romano and Wolf
    2005). So the component that gains most of those that surely gain may be picked. ``count`` are
    the errors of each.
    """
    chunks = len(before)
    draws = np.random.default_rng(0).multinomial(chunks, np.full(chunks, 1.0 / chunks), _DRAWS)
    change = _log_ratio(after.sum(axis=0), before.sum(axis=0))
    drawn = _log_ratio(draws @ after, draws @ before)
    std = drawn.std(axis=0) + 1e-12
    widest = np.quantile(np.abs((drawn - change) / std).max(axis=1), 0.95) * std
    percent, low, high = (
        100.0 * (1.0 - np.exp(0.5 * x)) for x in (change, change + widest, change - widest)
    )
    best = int(np.argmax(np.where(low > 0.0, percent, -np.inf if (low > 0.0).any() else percent)))
    rmse_before, rmse_after = (np.sqrt(x.sum(axis=0) / count)[best] for x in (before, after))
    return Gain(
        components[best],
        float(rmse_before),
        float(rmse_after),
        float(percent[best]),
        float(low[best]),
        float(high[best]),
    )


def _log_ratio(a: Array, b: Array) -> Array:
    ratio: Array = np.log(np.maximum(a, 1e-300)) - np.log(np.maximum(b, 1e-300))
    return ratio


# ------------------------------------------------------------------ findings


def _sensor_findings(
    streams: Streams,
    judge_streams: Streams,
    config: Config,
    found: Mapping[str, Mapping[str, float]],
    std: Mapping[Key, float],
    fit: Spans,
    held: Spans,
) -> list[Finding]:
    findings = []
    inside, outside = _inside(fit), _inside(held)
    for name in found:
        others = [n for n in found if n != name]
        rest, _ = kinematics.search(streams, config, inside, others)
        a = kinematics.blocks(judge_streams, config, rest)
        b = kinematics.blocks(judge_streams, config, found)
        sums = [_common(*pair, outside) for pair in zip(a, b, strict=True)]
        last = max(map(len, sums))
        of = np.stack([np.pad(s, ((0, last - len(s)), (0, 0))) for s in sums], axis=2)
        of = of[of[:, 2].any(axis=1)][:, :, of[:, 2].any(axis=0)]
        gain = gain_of(["kinematic"] * of.shape[2], of[:, 0], of[:, 1], of[:, 2].sum(axis=0))
        parameters = {
            p.name: Value(found[name][p.name], std[name, p.name], p.unit)
            for p in EFFECTS[name].parameters
        }
        findings.append(
            Finding(
                name,
                (),
                parameters,
                None,
                gain,
                True,
                None,
                (),
                sentence(name, parameters, gain),
            )
        )
    return findings


def _common(
    before: kinematics.Block, after: kinematics.Block, inside: Callable[[Array], NDArray[np.bool_]]
) -> Array:
    """Squared innovations of two corrections of the sensors, in units of the later one's noise, and
    how many instants they are of where both count, all summed over chunks of time: (C, 3)."""
    scale = after.scale / before.scale
    x, y = inside(before.t), inside(after.t)
    t = np.intersect1d(np.round(before.t[x], 6), np.round(after.t[y], 6))
    chunk = (t / _CHUNK).astype(int)
    p = _by_time(before.t[x], (before.r[x] / scale) ** 2, t)
    q = _by_time(after.t[y], after.r[y] ** 2, t)
    return np.stack([np.bincount(chunk, p), np.bincount(chunk, q), np.bincount(chunk)], axis=1)


def _by_time(t: Array, squares: Array, at: Array) -> Array:
    index = np.searchsorted(at, np.round(t, 6))
    good = (index < len(at)) & (at[np.minimum(index, len(at) - 1)] == np.round(t, 6))
    return np.asarray(np.bincount(index[good], squares[good], len(at)), dtype=np.float64)


def _finding(search: Search, judge: Judge, final: Fitted, name: str, trial: Trial) -> Finding:
    keys = search.keys_of(final, name)
    parameters = parameters_of(final, keys)
    onset = parameters.get("onset")
    # When it began, between two windows of the fit, what is held out there cannot be predicted.
    beside = None
    if onset is not None:
        beside = onset.value - 2.0 * onset.std, onset.value + 2.0 * onset.std
    axes = _axes(search, final, keys)
    gain = judge.gain(trial.rest.hypothesis, final.hypothesis, beside, axes)
    best = search.cost(final, final)
    explained = trial.rest.rss - final.rss
    alternatives, separable = [], trial.rivals is not None
    for rival, fitted in (trial.rivals or {}).items():
        if rival.startswith(UNKNOWN):
            separable = separable and search.cost(fitted, final) > best - SURE
            continue
        share = (trial.rest.rss - fitted.rss) / max(explained, 1e-9)
        close = search.cost(fitted, final) - best < SURE
        if close or judge.better(fitted.hypothesis, final.hypothesis, beside):
            separable = False
            why = _AS_WELL
        else:
            why = f"fitted in its stead, it explains only {100 * share:.0f} % of this"
            if share > _ALL:
                why = "fitted in its stead, it needs more parameters to explain as much"
        alternatives.append((share, Alternative(rival, why)))
    if not separable:
        alternatives = [a for a in alternatives if a[1].why_not == _AS_WELL]
    stds = {k: parameters[k[1].removesuffix("_neg")].std for k in keys}
    separable = separable and not any(pinned(k, final.hypothesis.values[k], stds[k]) for k in keys)
    return Finding(
        name,
        axes,
        parameters,
        None if onset is None else onset.value,
        gain,
        separable,
        None if separable else manoeuvre(name),
        tuple(a for _, a in sorted(alternatives, key=lambda x: -x[0])),
        sentence(name, parameters, gain),
    )


def _certain(search: Search, last: Fitted, name: str) -> bool:
    """Whether all of the data tell an effect from nothing as surely as it takes to join a model."""
    rest = last.look.evidence.fit(last.hypothesis.without(search.keys_of(last, name)), last.look)
    return rest is None or search.worth(rest, last, last) >= (PLAINLY if name in PLAIN else SURE)


def _with_parameters(search: Search, last: Fitted, finding: Finding) -> Finding:
    """The finding with the values that all of the data give."""
    keys = search.keys_of(last, finding.effect)
    parameters = parameters_of(last, keys)
    onset = parameters.get("onset")
    return from_the_start(
        dataclasses.replace(
            finding,
            parameters=parameters,
            onset_s=None if onset is None else onset.value,
            sentence=sentence(finding.effect, parameters, finding.gain),
        )
    )


def from_the_start(finding: Finding) -> Finding:
    """Not separable from what lasts, where the effect may have begun before the bag did."""
    onset, lasting = finding.parameters.get("onset"), EFFECTS[finding.effect].lasting
    if onset is None or not lasting or onset.value - 2.0 * onset.std > 0.0:
        return finding
    known = {a.effect for a in finding.alternatives if a.why_not == _AS_WELL}
    kept = tuple(a for a in finding.alternatives if a.effect in known)
    early = tuple(Alternative(name, _EARLY) for name in lasting if name not in known)
    return dataclasses.replace(
        finding,
        separable=False,
        manoeuvre=manoeuvre(finding.effect),
        alternatives=kept + early,
    )


def parameters_of(final: Fitted, keys: Sequence[Key]) -> dict[str, Value]:
    h, linear = final.hypothesis, final.linear
    wide = covariance(final)
    evidence, kappa = final.look.evidence, inflation(linear, np.arange(len(linear.keys)))
    out = {}
    for key in keys:
        at = linear.index([key])[0]
        value, variance = h.values[key], wide[at, at]
        section, name = key
        unit = parse(name).unit if section == COEFFICIENTS else parameter(key).unit
        if section in EFFECTS and parameter(key).role == "onset":
            variance = evidence.onset_std(final, key, kappa) ** 2
        positive = name.removesuffix("_neg")
        if positive != name:  # told as the coefficient that holds for negative velocity
            name, other = positive, (COEFFICIENTS, positive)
            value += h.coefficients.get(positive, 0.0)
            if other in h.values:
                o = linear.index([other])[0]
                variance += wide[o, o] + 2.0 * wide[at, o]
        out[name] = Value(float(value), float(np.sqrt(max(variance, 0.0))), unit)
    return out


def _axes(search: Search, final: Fitted, keys: Sequence[Key]) -> tuple[str, ...]:
    """The axes on which an effect acts, by what it does to the wrench."""
    h, look = final.hypothesis, final.look
    force = search.evidence.columns(h, look.motion, keys)
    change = force @ np.array([h.values[k] - bounds(k)[0] for k in keys])
    power = np.sqrt(np.mean(change**2, axis=0)) / authority(search.config.model)
    return tuple(a for a, p in zip(AXES, power, strict=True) if p > 0.2 * power.max() > 0.0)


def manoeuvre(name: str) -> str:
    """The run that tells an effect from its neighbours."""
    return EFFECTS[name].manoeuvre


def sentence(name: str, parameters: Mapping[str, Value], gain: Gain) -> str:
    """A finding in one sentence."""
    values = ", ".join(
        f"{n} = {v.value:.3g}{'' if v.unit == '1' else ' ' + v.unit} (± {1.96 * v.std:.2g})"
        for n, v in parameters.items()
    )
    if gain.component == "kinematic":
        what = "agreement of the sensors"
    else:
        what = f"{BLOCK:.0f} s prediction of {_MOTIONS[gain.component]}"
    return f"{EFFECTS[name].summary} {values}. The {what} improves by {gain.percent:.0f} %."


_MOTIONS = dict(
    zip(VELOCITIES, ("surge", "sway", "heave", "roll rate", "pitch rate", "yaw rate"), strict=True)
)


def _residual(final: Fitted, trials: Trials) -> list[Residual]:
    """What the patterns in a model say: where something is left that has no name.

    Each window is foretold with the parameters that the others give, but not with another pattern:
    which one it is was chosen by all of them, from many. So it has to gain surely what an effect
    has to gain at all. The share is one of squares.
    """
    found = []
    for name, trial in trials.items():
        if not name.startswith(UNKNOWN):
            continue
        axis, depends_on, frequency = name.removeprefix(f"{UNKNOWN} ").split("|")
        i = AXES.index(axis)
        before, after = but_best(*(foretold(f)[:, [i]] for f in (trial.rest, final)))
        if len(before) > 1 and gain_of([VELOCITIES[i]], before, after, 1.0).low >= 100.0 * _WORTH:
            share = float(1.0 - after.sum() / before.sum())
            found.append(Residual(axis, depends_on, float(frequency) if frequency else None, share))
    return sorted(found, key=lambda r: -r.share)


def but_best(before: Array, after: Array) -> tuple[Array, Array]:
    """Squared residuals (W, 1) of all windows but the one that speaks most for what came after.

    One alone can be foretold badly by chance, where hardly another one tells of some parameter.
    """
    most = int(np.argmax(before - after))
    return np.delete(before, most, axis=0), np.delete(after, most, axis=0)


def _changed(config: Config, retuned: Fitted) -> dict[str, Change]:
    wide = covariance(retuned)
    changed = {}
    for i, ((_, name), value) in enumerate(retuned.hypothesis.values.items()):
        before = float(config.model.theta[config.model.names.index(name)])
        std = float(np.sqrt(wide[i, i]))
        if abs(value - before) > 2.0 * std:
            changed[name] = Change(before, float(value), std, parse(name).unit)
    return changed


def _extended(config: Config, h: Hypothesis, sensors: Mapping[str, Mapping[str, float]]) -> Config:
    """The configuration with what was found."""
    document = configuration.to_parameters(config)
    document["coefficients"] = {**document["coefficients"], **h.coefficients}
    effects = {**h.effects}
    for name, values in sensors.items():
        effects[name] = dict(values)
    if effects:
        document["effects"] = effects
    chosen = document.pop("estimate", None)
    extended = configuration.from_parameters(document)
    if chosen is not None:  # what was found is to be followed live, too
        own = set(config.model.names) - set(config.estimate)
        names = tuple(n for n in extended.model.names if n not in own)
        extended = dataclasses.replace(extended, estimate=names)
    return extended
