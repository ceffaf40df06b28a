"""Findings: effects with their parameters, gains and rivals, in numbers and in sentences."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import chdtri

from rov_ident.config import Config
from rov_ident.core.linalg import scaled_solve
from rov_ident.discrepancy import sensor_consistency
from rov_ident.discrepancy.held_out import (
    CHUNK,
    Judge,
    gain_of,
    improved,
    is_practical,
    is_sure,
    is_surely_practical,
)
from rov_ident.discrepancy.hypothesis import (
    COEFFICIENTS,
    UNKNOWN,
    Hypothesis,
    Key,
    at_bound,
    bounds,
    effect_of,
    is_shared,
    onsets,
    record_of,
    role_of,
    shared,
    unit_of,
)
from rov_ident.discrepancy.output_error import Fitted, onset_std, refit
from rov_ident.discrepancy.results import Alternative, Change, Finding, Gain, Residual, Value
from rov_ident.discrepancy.screening import HULL_DAMPING
from rov_ident.discrepancy.search import HULL_DAMPING_ASKED, Search, Trial, Trials
from rov_ident.discrepancy.selection import VERY_STRONG
from rov_ident.discrepancy.sensor_choice import (
    BIAS,
    HEADING,
    NOISE,
    Choice,
    Data,
    may_be_noise,
    moves_velocity,
    with_noise,
)
from rov_ident.discrepancy.windowed_problem import Spans
from rov_ident.effects import EFFECTS, with_trait
from rov_ident.model.coefficients import AXES, VELOCITIES, parse
from rov_ident.model.equations import Array
from rov_ident.model.scales import authority, semi_axes
from rov_ident.reports.result import NORMAL
from rov_ident.reports.table import with_unit
from rov_ident.sampling.raw_streams import Streams

_ALL = 0.98  # share of what a finding explains that counts as all of it: 2 % is no practical weight
_ACTS = 0.2  # of the wrench on the axis it acts on most, over the authority: acts on this one, too
_MOST = 0.5  # of the same: a rival that explains less is none, whatever the righting arm
_PARTIAL = "fitted in its stead, it explains only {:.0f} % of this"
_COSTLY = "fitted in its stead, it needs more parameters to explain as much"
_EQUAL = "fits this bag as well"
_TAKEN = "thrust that is lost takes its moment along, which is the same"
_EARLIER = "the same if it was there before the bag began, which this bag cannot tell"
_UNTRIED = "the search was cut short before everything was tried in its place"
_NAMELESS = "something without a name explains as much"
_AT_END = "a parameter is at the end of what is possible"
_OTHER_FACTORS = "the thrust of others than these, of axes or of records, explains as much"
_OTHER_THRUSTER = "another thruster explains as much"
_BEHIND_IT = "an error without a name may be behind it (see the notes)"
_ELSEWHERE = "what gains most is on an axis on which it does not act"
_UNSUPPORTED = "all of the data do not surely support it"
_OF_THE_FILE = (
    "errors of mass, inertia, thrust or trim that the file allows may have made all of it"
)


def finding(
    search: Search, judge: Judge, retuned: Fitted, final: Fitted, name: str, trial: Trial
) -> Finding:
    """An effect of the final model, judged against the best model without it, be it the retuned
    one, and against its rivals."""
    keys = search.keys_of(final, name)
    parameters = parameters_of(final, keys)
    gain, without, axes = gain_over(search, judge, retuned, final, name, trial.rest)
    alternatives, separable, doubts = _alternatives(search, judge, final, name, trial)
    if name in with_trait("neglecting") and may_be_noise(trial.rest, axes):
        alternatives, separable = (*alternatives, Alternative(NOISE, _EQUAL)), False
    std = np.sqrt(np.maximum(np.diag(final.covariance), 0.0))[final.linear.index(keys)]
    at_end = (at_bound(k, final.hypothesis.values[k], s) for k, s in zip(keys, std, strict=True))
    doubts += [_AT_END] * any(at_end)
    doubts += [_ELSEWHERE] * judge.gains_elsewhere(gain, without, final.hypothesis, axes)
    if separable and not doubts and "factor" in EFFECTS[name].traits:
        sure = all(_is_sure_factor(search, final, trial.rest, k) for k in keys)
        doubts += [] if sure else [_OTHER_FACTORS]
    if separable and not doubts and final.hypothesis.thruster(name) is not None:
        other = search.with_other_thruster(final, trial.rest, name)
        doubts += [] if _is_surely_likelier(search, final, other) else [_OTHER_THRUSTER]
    if name == "thrust_line" and _may_be_lost_thrust(search.config, final.hypothesis, keys):
        alternatives, separable = (*alternatives, Alternative("thruster_gain", _TAKEN)), False
    found = in_words(name, axes, parameters, gain, alternatives)
    return found if separable and not doubts else unsure(found, *doubts)


def gain_over(
    search: Search, judge: Judge, retuned: Fitted, final: Fitted, name: str, rest: Fitted
) -> tuple[Gain, Hypothesis, tuple[str, ...]]:
    """What an effect of the final model gains over the best model without it, the ``rest`` or the
    retuned one; which of these that is; and the axes on which the effect acts."""
    axes, without = _axes(search, final, search.keys_of(final, name)), rest.hypothesis
    if judge.better(retuned.hypothesis, without):
        without = retuned.hypothesis
    return judge.gain(without, final.hypothesis, axes), without, axes


def beginnings(final: Fitted) -> Spans:
    """From and to [s] of when something in a model may begin, within two standard deviations."""
    values = [(final.hypothesis.values[k], onset_std(final, k)) for k in onsets(final.hypothesis)]
    return [(onset - 2.0 * std, onset + 2.0 * std) for onset, std in values]


def in_words(
    name: str,
    axes: tuple[str, ...],
    parameters: dict[str, Value],
    gain: Gain,
    alternatives: tuple[Alternative, ...] = (),
) -> Finding:
    """A finding that is sure, and its sentence."""
    onset = parameters.get("onset")
    begin = None if onset is None else onset.value
    words = sentence(name, parameters, gain)
    return Finding(name, axes, parameters, begin, gain, alternatives=alternatives, sentence=words)


def _may_be_lost_thrust(config: Config, h: Hypothesis, keys: Sequence[Key]) -> bool:
    """Whether none of the arms is longer than a loss of thrust makes, as large as the file allows,
    of thrusters as far from the origin as the hull reaches: the moment that was read with the force
    is lost with it, and as drag and inertia suit any thrust of an axis, no force shows the loss."""
    reach = NORMAL * config.wrench.scale_std * semi_axes(config.model.body)
    for key in keys:
        force, moment = (AXES.index(axis) % 3 for axis in key[1].split("_")[1:])
        if abs(h.values[key]) > reach[3 - force - moment]:
            return False
    return True


def _is_sure_factor(search: Search, final: Fitted, rest: Fitted, key: Key) -> bool:
    """Whether no factors of the thrust of other axes explain as much as that of one, by as few.

    The inertia and the drag of an axis go with its thrust, so that it is compared with that of the
    others: with surge and sway too weak, heave looks too strong. That of one record is compared
    with that of the others: of two, either may be off.
    """
    if not is_shared([key]):
        return _is_surely_likelier(search, final, search.with_others_off(final, key))
    return _is_surely_likelier(search, final, search.with_other_factors(final, rest, key))


def _is_surely_likelier(search: Search, final: Fitted, other: Fitted | None) -> bool:
    """Whether a fit is surely better than another one, if there is any."""
    return other is None or search.cost(other, final) - search.cost(final, final) > VERY_STRONG


def _alternatives(
    search: Search, judge: Judge, final: Fitted, name: str, trial: Trial
) -> tuple[tuple[Alternative, ...], bool, list[str]]:
    """The rivals, the closest first, and whether the effect can be told from all of them; where it
    cannot, only those that it cannot be told from. And what else speaks against it."""
    best = search.cost(final, final)
    explained = trial.rest.squares - final.squares
    found, separable, doubts = [], True, [] if trial.whole else [_UNTRIED]

    def with_arm(fitted: Fitted) -> float:
        own, square = search.with_own_arm(fitted, final.inflation)
        return search.cost(own, final) + square

    for rival, fitted in trial.rivals.items():
        if rival.startswith(UNKNOWN):
            if search.cost(fitted, final) <= best - VERY_STRONG:
                doubts.append(_NAMELESS)
            continue
        share = (trial.rest.squares - fitted.squares) / max(explained, 1e-9)
        close = search.cost(fitted, final) - best < VERY_STRONG
        if not close and share > _MOST and {name, rival} & {*with_trait("weight")}:
            close = with_arm(fitted) - with_arm(final) < VERY_STRONG
        # a rival with parameters beyond this effect's own predicts better by chance alone
        larger = EFFECTS[name].within == rival if name in EFFECTS else False
        if close or (not larger and judge.better(fitted.hypothesis, final.hypothesis)):
            separable = False
            why = _EQUAL
        else:
            why = _COSTLY if share > _ALL else _PARTIAL.format(100 * share)
        found.append((share, Alternative(rival, why)))
    ahead = search.cost(trial.rest, final) - best - VERY_STRONG
    if 0.0 < ahead < trial.rest.squares_of_biases / final.inflation:
        separable = False
        found.append((1.0, Alternative(BIAS, _EQUAL)))
    all_told = separable and not doubts
    told = [a for _, a in sorted(found, key=lambda x: -x[0]) if all_told or a.why_not == _EQUAL]
    return tuple(told), separable, doubts


def is_certain(search: Search, last: Fitted, name: str) -> bool:
    """Whether all of the data support an effect as surely as it takes to join a model."""
    rest = search.rest(last, name)
    asked = HULL_DAMPING_ASKED if name in HULL_DAMPING else VERY_STRONG
    return rest is None or search.improvement(rest, last, last) >= asked


def with_parameters(search: Search, last: Fitted, found: Finding) -> Finding:
    """The finding with the values that all of the data give; not sure where these do not support
    it, or errors of the file may have made all of it."""
    keys, wide = search.keys_of(last, found.effect), last.covariance + last.covariance_of_the_file
    parameters = parameters_of(last, keys, wide)
    doubts = [] if is_certain(search, last, found.effect) else [_UNSUPPORTED]
    doubts += [] if _differs_from_null(last, keys, wide) else [_OF_THE_FILE]
    told = in_words(found.effect, found.axes, parameters, found.gain, found.alternatives)
    if doubts or not found.separable:
        told = unsure(told, *found.doubts, *doubts)
    return possibly_earlier(told, last.linearisation.problem.seen)


def is_left(search: Search, last: Fitted, name: str) -> bool:
    """Whether anything is left of an effect in the fit to all data: it may end at its null."""
    keys = [k for k in search.keys_of(last, name) if role_of(k) == "amplitude"]
    return not keys or any(last.hypothesis.values[k] != bounds(k)[0] for k in keys)


def _differs_from_null(fitted: Fitted, keys: Sequence[Key], covariance: Array) -> bool:
    """Whether the amplitudes among parameters surely differ from their nulls together (Wald)."""
    keys = [k for k in keys if role_of(k) == "amplitude"]
    return not keys or bool(_wald(fitted, keys, covariance) > chdtri(len(keys), 0.05))


def _wald(fitted: Fitted, keys: Sequence[Key], covariance: Array) -> float:
    """The square of how far the amplitudes among parameters are from their nulls together, in
    standard deviations."""
    keys = [k for k in keys if role_of(k) == "amplitude"]
    at = fitted.linear.index(keys)
    off = np.array([fitted.hypothesis.values[k] - bounds(k)[0] for k in keys])
    return float(off @ scaled_solve(covariance[np.ix_(at, at)], off, 1e-9))


def undecided(minor: Sequence[Finding]) -> list[Finding]:
    """Of the effects that are not worth a change those on the dynamics that the fit supports, and
    the held-out data neither confirm nor refute: the model may lack them."""
    return [f for f in minor if not EFFECTS[f.effect].of_sensors and not is_sure(f.gain)]


def possibly_earlier(found: Finding, seen: float = 0.0) -> Finding:
    """Not separable from what lasts, where the effect may have begun before the bag did, or before
    ``seen`` [s], up to where a single window would have to tell it."""
    onset, lasting = found.parameters.get("onset"), EFFECTS[found.effect].lasting
    if onset is None or not lasting or onset.value - 2.0 * onset.std > seen:
        return found
    found = unsure(found)
    equal = {a.effect for a in found.alternatives}
    earlier = tuple(Alternative(name, _EARLIER) for name in lasting if name not in equal)
    return dataclasses.replace(found, alternatives=found.alternatives + earlier)


def unsure(found: Finding, *doubts: str) -> Finding:
    """The finding as one that something else may be behind, but no rival that was refuted."""
    run = EFFECTS[found.effect].manoeuvre
    kept = tuple(a for a in found.alternatives if a.why_not in (_EQUAL, _EARLIER, _TAKEN))
    every = tuple(dict.fromkeys((*found.doubts, *doubts)))
    return dataclasses.replace(
        found, separable=False, manoeuvre=run, alternatives=kept, doubts=every
    )


def parameters_of(
    final: Fitted, keys: Sequence[Key], covariance: Array | None = None
) -> dict[str, Value]:
    """Parameters with their standard deviations, by the ``covariance`` (P, P) (None: what the data
    leave); damping for negative velocity is told as the coefficient that holds there, not as its
    difference from the other. Of what single records have of their own those of the record that
    has it most surely."""
    h, linear = final.hypothesis, final.linear
    wide = final.covariance if covariance is None else covariance
    owners = {record_of(key) for key in keys}
    if len(owners) > 1:
        each = {r: [key for key in keys if record_of(key) == r] for r in owners}
        keys = max(each.values(), key=lambda own: _wald(final, own, wide))
    out = {}
    for key in keys:
        at = linear.index([key])[0]
        value, variance = h.values[key], wide[at, at]
        name = shared(key)[1]
        if role_of(key) == "onset":
            variance = onset_std(final, key) ** 2
        positive = name.removesuffix("_neg")
        if positive != name:
            name, other = positive, (COEFFICIENTS, positive)
            value += h.coefficients.get(positive, 0.0)
            if other in h.values:
                o = linear.index([other])[0]
                variance += wide[o, o] + 2.0 * wide[at, o]
        out[name] = Value(float(value), float(np.sqrt(max(variance, 0.0))), unit_of(key))
    for section in {section for section, _ in keys}:
        if (number := h.thruster(section)) is not None:
            out["thruster"] = Value(number, 0.0, "1")
    return out


def _axes(search: Search, final: Fitted, keys: Sequence[Key]) -> tuple[str, ...]:
    """The axes on which an effect acts, by what it does to the wrench."""
    h = final.hypothesis
    force = search.problem.columns(h, final.linearisation.motion, keys)
    change = force @ np.array([h.values[k] - bounds(k)[0] for k in keys])
    power = np.sqrt(np.mean(change**2, axis=0)) / authority(search.config.model)
    return tuple(a for a, p in zip(AXES, power, strict=True) if p > _ACTS * power.max() > 0.0)


def sentence(name: str, parameters: Mapping[str, Value], gain: Gain) -> str:
    values = ", ".join(
        f"{n} = {with_unit(f'{v.value:.3g}', v.unit)}"
        + (f" (± {NORMAL * v.std:.2g}, 95 %)" if v.std else "")  # what is exact is a count
        for n, v in parameters.items()
    )
    return f"{EFFECTS[name].summary} {values}. The {improved(gain)}."


def residuals(final: Fitted, trials: Trials) -> list[Residual]:
    """What the patterns in a model say: on which axis something is left that has no name. Windows
    are predicted by fits to the others; as a pattern was chosen by all windows, from many, it must
    surely gain what an effect must gain at all. It is not sure where errors of the attitude make as
    much of the righting moment, in 5 % of the time. The share is one of squares."""
    found, h, problem = [], final.hypothesis, final.linearisation.problem
    of_attitude = of_attitude_errors(h)
    for name, trial in trials.items():
        if not name.startswith(UNKNOWN):
            continue
        axis, depends_on, frequency = name.removeprefix(f"{UNKNOWN} ").split("|")
        i = AXES.index(axis)
        before, after = without_most_favourable(
            *(f.leave_one_out()[:, [i]] for f in (trial.rest, final))
        )
        gain = gain_of([VELOCITIES[i]], before, after, 1.0) if len(before) > 1 else None
        keys = [k for k in h.keys if effect_of(k) == name]
        columns = problem.columns(h, final.linearisation.motion, keys)
        force = columns[:, i] @ np.array([h.values[k] for k in keys])
        if gain is not None and is_surely_practical(gain):
            share = float(1.0 - after.sum() / before.sum())
            hertz = float(frequency) if frequency else None
            sure = bool(np.sqrt(np.mean(force**2)) > of_attitude[i])
            found.append(Residual(axis, depends_on, hertz, share, sure))
    return sorted(found, key=lambda r: -r.share)


def of_attitude_errors(h: Hypothesis) -> Array:
    """What 95 % of the attitude's errors make at most of the wrench (6,) of weight and buoyancy."""
    size = np.linalg.norm(h.model.body.restoring, axis=1)
    out: Array = NORMAL * h.config.odometry.attitude_std * size
    return out


def without_most_favourable(before: Array, after: Array) -> tuple[Array, Array]:
    """Squared residuals (W, 1) of all windows but the one that gains most: one alone can be
    predicted badly by chance, where hardly another one determines some parameter."""
    most = int(np.argmax(before - after))
    return np.delete(before, most, axis=0), np.delete(after, most, axis=0)


def changes(config: Config, retuned: Fitted, others: Sequence[Hypothesis]) -> dict[str, Change]:
    """The coefficients that refitting moves by more than two standard deviations of this fit. They
    are told as uncertain as the structure: by as much as they differ from those of the ``others``,
    the model that has what is missing, and those of single records that differ."""
    changed, values = {}, retuned.hypothesis.values.items()
    covariance = retuned.covariance + retuned.covariance_of_the_file
    for ((section, name), value), own in zip(values, np.sqrt(np.diag(covariance)), strict=True):
        if section != COEFFICIENTS:
            continue
        before = float(config.model.theta[config.model.names.index(name)])
        apart = max(abs(value - h.value((section, name))) for h in others)
        if abs(value - before) > 2.0 * own:
            std = float(np.hypot(own, apart))
            changed[name] = Change(before, float(value), std, parse(name).unit)
    return changed


def noise_finding(judge: Judge, final: Fitted, given: Config, std: Mapping[str, float]) -> Finding:
    """The noise of the wrench's reading, which the configuration of the model ``final`` has: judged
    against the same model with the readings as they are in the configuration ``given``."""
    name, h = NOISE, final.hypothesis
    parameters = {
        p.name: Value(h.config.effects[name][p.name], std[p.name], p.unit)
        for p in EFFECTS[name].parameters
        if h.config.effects[name][p.name] > 0.0
    }
    axes = tuple(p.axis for p in EFFECTS[name].parameters if p.name in parameters)
    without = with_noise(h, given.effects.get(name, {}))
    rest = refit(without, final.linearisation)
    gain = judge.gain(without if rest is None else rest.hypothesis, h, axes)
    return in_words(name, axes, parameters, gain)


def sensor_findings(data: Data, choice: Choice, as_headed: Streams | None = None) -> list[Finding]:
    """Findings of the sensor effects of a choice, by how much better the sensors agree where they
    are judged; or, as noise hides that from one message to the next, by how much better the motion
    is predicted. ``as_headed``: the streams judged with the headings of their records as they were.
    """
    config, findings = data.config, []
    after = sensor_consistency.comparisons(data.judged, config, choice.sensors)
    for name, values in choice.sensors.items():
        rest = data.fitted([n for n in choice.sensors if n != name], choice.fixed)
        given = as_headed if name == HEADING and as_headed is not None else data.judged
        before = sensor_consistency.comparisons(given, config, rest.sensors)
        gain = kinematic_gain((before, after), data.held)
        if not is_practical(gain) and moves_velocity(name, values):
            of_motion = data.gain_in_dynamics(rest.sensors, choice.sensors)
            gain = of_motion if of_motion is not None and is_practical(of_motion) else gain
        parameters = {
            p.name: Value(values[p.name], choice.std[name, p.name], p.unit)
            for p in EFFECTS[name].parameters
            if (name, p.name) in choice.std
        }
        rivals = tuple(Alternative(n, _EQUAL) for n in choice.alternatives.get(name, ()))
        found = in_words(name, (), parameters, gain, rivals)
        doubts = [_BEHIND_IT] if name in choice.unsure else []
        findings.append(unsure(found, *doubts) if rivals or doubts else found)
    return findings


def kinematic_gain(pair: Sequence[Sequence[sensor_consistency.Comparison]], held: Spans) -> Gain:
    """By how much better sensors agree in the spans ``held`` after a correction than before it."""
    of = sensor_consistency.common_squares(pair, held, unit=1, length=CHUNK)
    of = of[:, :, of[:, 2].any(axis=0)]
    return gain_of(["kinematic"] * of.shape[2], of[:, 0], of[:, 1], of[:, 2].sum(axis=0))
