"""What `explain` found, told: the page, and the sentences that page and terminal share."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.core.files import write_file
from rov_ident.discrepancy.explain import Explanation
from rov_ident.discrepancy.findings import undecided
from rov_ident.discrepancy.held_out import BLOCK, MOTIONS, improved, judged, predicted
from rov_ident.discrepancy.results import Finding, Findings, Gain, Repetition, Residual, Value
from rov_ident.effects import EFFECTS
from rov_ident.model.coefficients import AXES, VELOCITIES, parse
from rov_ident.model.equations import Array
from rov_ident.reports import html as report
from rov_ident.reports import plots
from rov_ident.reports.result import NORMAL, Figure
from rov_ident.reports.table import PLUS_MINUS, Table, Tables, estimate, number, with_unit
from rov_ident.sampling import records

UNITS = dict(zip(VELOCITIES, records.UNITS))
_SIDES = ("to port", "to starboard")
_SENSES = (("astern", "forward"), _SIDES, ("up", "down"), _SIDES, ("bow down", "bow up"), _SIDES)
SENSES = dict(zip(VELOCITIES, _SENSES))  # what a negative and a positive velocity mean

_BEFORE_THE_FIT = (
    "All from here on is from the search that came before the last fit, whose values are those "
    'above and in extended.yaml; "retuned" and "extended" are models of the search.'
)
_SAME_THING = (
    "No effect of the library has this form: look for a cause that depends on the same thing, on "
    "the vehicle or in the recording."
)
_MAY_EXPLAIN = (
    "{} may explain it, not beyond chance on the held-out data: a second dive (--validate) would "
    "decide. "
)
_MAY_LACK = (
    "The simulation may lack {}: the data that were fitted support it, the held-out data neither "
    "confirm nor refute it. A second dive (--validate) would decide: {}."
)
_TOGETHER = "; all velocities on which it acts together {:.1f} % (95 %: {:.1f} to {:.1f} %)"
_TOLD = 3  # parameters of an effect in the verdict
_SMALL = 0.1  # of the largest of its parameters: smaller ones are left to the card
_STRETCH = 30.0  # s of motion that is shown
_BIN = 5.0  # s; of the error over time
_MOST_BINS = 60  # of the error over time, and 11 over velocity, which show: choices of drawing
_SPEED_BINS = 11  # odd: one is about rest
_LEAST = 20  # samples in a bin, below which its error means nothing
_STILL = 0.05  # of the largest motion: below it an axis counts as not moved
_GAP = 1.0  # s without a measurement: curves break


def valued(name: str, v: Value) -> str:
    value, half = estimate(v.value, NORMAL * v.std)
    return with_unit(f"{name} {value} ± {half}", v.unit)


def called(effect: str) -> str:
    return effect.replace("_", " ").replace("imu", "IMU").replace("cog", "CG")


def run_to_tell(finding: Finding) -> str:
    """The run that would tell an effect from all else."""
    return finding.manoeuvre or EFFECTS[finding.effect].manoeuvre


def listed(items: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(items[:-1]), *items[-1:]]))


def verdict(findings: Findings) -> str:
    """The whole result in two or three sentences."""
    if findings.verdict == "agrees":
        return (
            "The simulation agrees with the measurement: nothing in these data asks for a change."
        )
    if findings.verdict == "retuned":
        before = findings.baseline.items()
        gains = {c: 1.0 - findings.retuned[c] / max(x, 1e-12) for c, x in before if np.isfinite(x)}
        best = max(gains, key=lambda c: gains[c])
        return (
            "The coefficients of the simulation are off, and these data show nothing that its "
            f"structure lacks. Retuned, the {predicted(best)} improves by "
            f"{100.0 * gains[best]:.0f} %."
        )
    named = _named(findings.effects)
    left = "; ".join([*map(dependence, findings.residual), *findings.contradictions])
    if findings.verdict == "explained":
        return named
    is_known = any(r.sure for r in findings.residual)  # what no effect is like
    doubtful = [] if is_known else undecided(findings.minor)
    may = listed([called(f.effect) for f in doubtful])
    if may and not (left or findings.effects):
        return _MAY_LACK.format(may, "; ".join(dict.fromkeys(map(run_to_tell, doubtful))))
    left = f": {left}" if left else ""
    explains = _MAY_EXPLAIN.format(may[0].upper() + may[1:]) if may else ""
    surely = "surely " if may else ""
    words = f"Something is left that no effect of the library {surely}explains{left}. {explains}"
    return f"{words}{named}".strip()


def _named(effects: Sequence[Finding]) -> str:
    if not effects:
        return ""
    sensors = [brief(f) for f in effects if EFFECTS[f.effect].of_sensors]
    others = [brief(f) for f in effects if not EFFECTS[f.effect].of_sensors]
    parts = [f"The simulation lacks {listed(others)}"] if others else []
    parts += [f"{'the' if others else 'The'} sensors show {listed(sensors)}"] if sensors else []
    if len(effects) == 1:
        return f"{'; '.join(parts)}. With it, the {improved(effects[0].gain)}."
    gains = listed([f"the {improved(f.gain)} with {called(f.effect)}" for f in effects])
    return f"{'; '.join(parts)}. {gains[0].upper() + gains[1:]}."


def _rounded(v: Value) -> str:
    return number(v.value, 2) if v.std else f"{v.value:g}"  # what is exact is a count


def brief(finding: Finding) -> str:
    """An effect with the parameters that matter most, in the middle of a sentence."""
    declared = {p.name: p for p in EFFECTS[finding.effect].parameters}
    size = {}  # how far from nothing, in typical sizes; coefficients are not told apart
    for name, v in finding.parameters.items():
        p = declared.get(name)
        if p is None or p.role in ("amplitude", "place"):
            size[name] = 1.0 if p is None else abs(v.value - p.null) / p.typical
    told = [name for name, s in size.items() if s > _SMALL * max(size.values())][:_TOLD]
    told += [p.name for p in declared.values() if p.role in ("onset", "frequency", "shape")]
    values = [
        with_unit(f"{n.replace('_', ' ') if n in declared else n} {_rounded(v)}", v.unit)
        for n, v in finding.parameters.items()
        if n in told
    ]
    others = listed([called(a.effect) for a in finding.alternatives])
    doubt = f"this run cannot tell it from {others}" if others else "not surely told from all else"
    if not others and finding.doubts:
        doubt = f"not sure, as {finding.doubts[0]}"
    doubt = "" if finding.separable else f"; {doubt}"
    of = finding.repetition
    differs = of is not None and not of.same and of.repeats is None and finding.onset_s is None
    doubt = f"; the records differ{doubt}" if differs else doubt
    return f"{called(finding.effect)} ({', '.join(values)}{doubt})"


def dependence(r: Residual) -> str:
    """What is left on an axis, in words."""
    kind = "force" if r.axis in AXES[:3] else "moment"
    at = "" if r.frequency_hz is None else f" at {number(r.frequency_hz, 2)} Hz"
    if not r.share:
        return f"a {kind} {r.axis} that depends on nothing that was tried"
    depends, of = ("depends", f" on {r.axis}") if r.sure else ("depends, if on anything,", "")
    return (
        f"a {kind} {r.axis} that {depends} on {r.depends_on}{at} "
        f"({100.0 * r.share:.0f} % of what is left{of})"
    )


def interval(gain: Gain) -> str:
    """A gain with its interval, on what it was measured, from what to what."""
    all_of = gain.together
    if gain.component == "kinematic":
        what, unit = "disagreement of the sensors", "times their noise"
    else:
        what, unit = predicted(gain.component), UNITS[gain.component]
    return (
        f"{gain.percent:.1f} % (95 %: {gain.low:.1f} to {gain.high:.1f} %) on the {what}: RMSE "
        f"{number(gain.rmse_before)} without it, {number(gain.rmse_after)} {unit} with it"
        + ("" if all_of is None else _TOGETHER.format(all_of.percent, all_of.low, all_of.high))
    )


def tables(findings: Findings) -> Tables:
    """The error of the three models, and every effect found with its parameters and its gain."""
    models = (findings.baseline, findings.retuned, findings.extended)
    rmse = [[name, *(number(by[name]) for by in models), unit] for name, unit in UNITS.items()]
    head = ["", "as configured", "retuned", "extended", "unit"]
    errors = Table(f"RMSE of the {BLOCK:g} s open-loop prediction", head, rmse, text=(4,))
    if not findings.effects:
        return Tables((errors,))
    rows = []
    for f in findings.effects:
        effect = called(f.effect)
        gain = f"{f.gain.percent:.0f} % ({f.gain.low:.0f} to {f.gain.high:.0f})"
        for name, v in f.parameters.items():
            unit = "" if v.unit == "1" else v.unit
            rows.append([effect, name, *estimate(v.value, NORMAL * v.std), unit, gain])
            effect = gain = ""
    head = ["", "parameter", "value", PLUS_MINUS, "unit", "gain (95 %)"]
    return Tables((errors, Table("what the simulation lacks", head, rows, text=(1, 4))))


def write(explanation: Explanation, folder: Path) -> None:
    """findings.json, report.html and extended.yaml. UserError if they cannot be written."""
    html = page(explanation)
    write_file(folder / "findings.json", explanation.to_json())
    write_file(folder / "report.html", html)
    write_extended(explanation, folder / "extended.yaml")


def write_extended(explanation: Explanation, path: Path) -> None:
    """The configuration with what was found; its head says what that is, and from which bags."""
    bags = _plain(explanation.findings.provenance.get("bags", []))
    comment = f"{explanation.sentence}\nFound by rov-ident explain in {bags}."
    configuration.dump(explanation.extended, path, comment)


def page(explanation: Explanation) -> str:
    f = explanation.findings
    origin = " · ".join(f"{key}: {_plain(value)}" for key, value in f.provenance.items())
    title = f"{explanation.given.name}: what the simulation lacks"
    return report.page(title, verdict(f), sections(explanation), origin)


def sections(explanation: Explanation, fitted: Config | None = None) -> list[str]:
    """The parts of the page below its headline.

    ``fitted``: the configuration that is written in place of the extended one, where a fit followed
    the search. What that gains is then told elsewhere.
    """
    f = explanation.findings
    rmse, shown = _shown(explanation)
    key = _legend(shown)
    change = [report.heading("What to change"), *_change(explanation, fitted)]
    if fitted is None:
        gains = [report.heading("What it gains"), key, *_gains(rmse, bool(explanation.held))]
        begin = [report.beside(change, gains)]
    else:
        begin = [*change, report.heading("The search for what is missing")]
        begin.append(report.paragraph(_BEFORE_THE_FIT))
    parts = [
        *begin,
        report.heading("Measured and simulated"),
        _legend([plots.MEASURED, *shown]),
        *_motion(explanation, shown),
        report.heading("Where and when it departs"),
        report.paragraph(_worst(explanation, f.baseline)),
        key,
        *_departures(explanation, shown),
    ]
    if f.effects:
        parts.append(report.heading("What is missing, and how sure that is"))
        parts += [_card(finding) for finding in f.effects]
    parts += minor(f.minor)
    parts.append(report.heading("What is left"))
    if f.residual:
        parts.append(report.bullets([f"{dependence(r)[2:]}." for r in f.residual]))
        parts += [report.paragraph(_SAME_THING)] if all(r.sure for r in f.residual) else []
    else:
        parts.append(report.paragraph("Nothing that depends on motion, place or time."))
    parts += _retuned(f, fitted or explanation.extended)
    if f.notes:
        parts += [report.heading("Notes"), report.bullets(f.notes)]
    return parts


def _shown(explanation: Explanation) -> tuple[dict[str, dict[str, float]], dict[str, Array]]:
    """Errors and simulations by label; without effects nothing extends the retuned model."""
    f = explanation.findings
    rmse = {"as configured": f.baseline, "retuned": f.retuned}
    if f.effects:
        rmse["extended"] = f.extended
    return rmse, {label: explanation.simulated[label] for label in rmse}


def _legend(labels: Iterable[str]) -> str:
    entries = {plots.MEASURED: ("currentColor", "none", 0.35)}
    for label, (colour, dashes) in plots.MODELS.items():
        pattern = " ".join(f"{3.0 * d:g}" for d in dashes) or "none"
        entries[label] = plots.css(colour), pattern, 1.0
    return report.legend({label: entries[label] for label in labels})


def _change(explanation: Explanation, fitted: Config | None) -> list[str]:
    old = configuration.to_parameters(explanation.given)
    new = configuration.to_parameters(fitted or explanation.extended)
    news = {k: new[k] for k in sorted(new, key=lambda k: k != "effects")}  # what is new first
    for name in news.get("effects", {}).keys() - old.get("effects", {}).keys():
        nulls = {p.name: p.null for p in EFFECTS[name].parameters}
        own = {n: v for n, v in news["effects"][name].items() if v != nulls[n]}
        news["effects"] = {**news["effects"], name: own}
    lines = _lines(old, news)
    if not lines:
        return [report.paragraph("Nothing. extended.yaml is the configuration that was given.")]
    if fitted is None and explanation.findings.verdict == "agrees":
        nothing = "Nothing. extended.yaml holds the refitted coefficients, which predict no better."
        return [report.paragraph(nothing)]
    width = max((len(line) for line, _ in lines if not line.endswith("]")), default=0)
    text = "\n".join(f"{line:<{width}}  {was}".rstrip() for line, was in lines)
    return [
        report.code(text),
        report.paragraph("extended.yaml has these lines in full and is ready for every command."),
    ]


def _lines(old: Any, new: Mapping[str, Any], depth: int = 0) -> list[tuple[str, str]]:
    """What differs, as lines of YAML, each with a comment that tells what was there."""
    lines = []
    for key, value in new.items():
        was = old.get(key) if isinstance(old, Mapping) else None
        start = "  " * depth + f"{key}:"
        if isinstance(value, Mapping):
            inside = _lines(was, value, depth + 1)
            lines += [(start, ""), *inside] if inside else []
        elif value != was:
            comment = "# new" if was is None else f"# was {_yaml(was)}"
            lines.append((f"{start} {_yaml(value)}", comment))
    return lines


def _yaml(value: Any) -> str:
    if isinstance(value, float):
        return number(value, 4)
    if isinstance(value, list):
        return "[" + ", ".join(map(_yaml, value)) + "]"
    return str(value)


def _gains(rmse: Mapping[str, Mapping[str, float]], held: bool) -> list[str]:
    pictures = []
    for name, of_kind in (("linear", VELOCITIES[:3]), ("angular", VELOCITIES[3:])):
        group = [c for c in of_kind if np.isfinite(rmse["as configured"][c])]
        if not group:
            continue
        values = {label: np.array([by[c] for c in group]) for label, by in rmse.items()}
        figure = plots.bars([MOTIONS[c] for c in group], values, "", f"RMSE [{UNITS[group[0]]}]")
        pictures.append(plots.zoomable(figure, f"bars-{name}-"))
    where = "data that no fit has seen" if held else "the bag given by --validate"
    caption = f"Error of the {BLOCK:.0f} s open-loop prediction on {where}; lower is better."
    return [report.panels(pictures, caption)]


def _motion(explanation: Explanation, shown: Mapping[str, Array]) -> list[str]:
    t, measured, runs = _stretch(explanation, shown)
    pictures = []
    for i, c in _simulated(explanation):
        figure = plots.curves(
            t, {label: run[:, i] for label, run in runs.items()}, MOTIONS[c], "time [s]",
            f"{c} [{UNITS[c]}]", measured=measured[:, i], shaded=explanation.held,
        )  # fmt: skip
        pictures.append(plots.zoomable(figure, f"motion-{c}-"))
    block = "held-out block (shaded: seen by no fit)" if explanation.held else "block"
    length = min(_STRETCH, explanation.t[-1] - explanation.t[0])
    caption = (
        f"{length:.0f} s around the {block} in which the simulation as "
        f"configured is furthest off. Every {BLOCK:.0f} s each simulation starts anew from the "
        "measured state; from there the recorded wrench alone drives it."
    )
    return [report.panels(pictures, caption, wide=True)]


def _stretch(
    explanation: Explanation, shown: Mapping[str, Array]
) -> tuple[Array, Array, dict[str, Array]]:
    """Times (k,), measured motion (k, 6) and simulations of it around the held-out block in which
    today's simulation is worst; NaN where a curve breaks."""
    t = explanation.t
    error = explanation.measured - explanation.simulated["as configured"]
    size = explanation.measured.std(axis=0) + 1e-9
    relative = np.nan_to_num(np.minimum(np.abs(error / size), 3.0), nan=3.0) ** 2
    spans = explanation.held or [(b, b + BLOCK) for b in np.arange(t[0], t[-1], BLOCK)]
    parts = [(t >= begin) & (t < end) for begin, end in spans]
    begin, end = spans[int(np.argmax([relative[p].mean() if p.any() else 0.0 for p in parts]))]
    first = BLOCK * round((0.5 * (begin + end) - 0.5 * _STRETCH) / BLOCK)
    first = max(float(t[0]), min(first, float(t[-1]) - _STRETCH))
    part = (t >= first) & (t < first + _STRETCH)
    t = t[part]
    pauses = (np.diff(t, prepend=t[0]) > _GAP)[:, None]
    # a simulation starts anew from the measurement in every window: no line joins two of them
    starts = pauses | (np.diff(t // BLOCK, prepend=-1.0) != 0.0)[:, None]
    runs = {label: np.where(starts, np.nan, run[part]) for label, run in shown.items()}
    return t, np.where(pauses, np.nan, explanation.measured[part]), runs


def _worst(explanation: Explanation, baseline: Mapping[str, float]) -> str:
    size = explanation.measured.std(axis=0)
    largest = np.repeat([size[:3].max(), size[3:].max()], 3)
    moving = {VELOCITIES[i]: float(size[i]) for i, _ in _simulated(explanation)
              if size[i] > _STILL * largest[i]}  # fmt: skip
    if not moving:
        return "The vehicle does not move."
    worst = max(moving, key=lambda c: baseline[c] / moving[c])
    error, size = (f"{number(of[worst], 2)} {UNITS[worst]}" for of in (baseline, moving))
    return (
        f"As configured it is furthest off in {MOTIONS[worst]}, measured by how much the vehicle "
        f"moves: an error of {error} on a motion of {size} (RMS)."
    )


def _simulated(explanation: Explanation) -> list[tuple[int, str]]:
    """The velocities that are simulated, and not taken as measured: number and name."""
    rmse = explanation.findings.baseline
    return [(i, c) for i, c in enumerate(VELOCITIES) if np.isfinite(rmse[c])]


def _departures(explanation: Explanation, shown: Mapping[str, Array]) -> list[str]:
    t, measured = explanation.t, explanation.measured
    errors = {label: run - measured for label, run in shown.items()}
    step = max(_BIN, float(t[-1]) / _MOST_BINS)
    edges = np.arange(0.0, float(t[-1]) + step, step)
    over_time, over_speed = [], []
    for i, c in _simulated(explanation):
        unit, slots = UNITS[c], 0.5 * (edges[1:] + edges[:-1])
        by_time = {label: binned(t, e[:, i], edges) for label, e in errors.items()}
        figure = plots.curves(
            slots, by_time, MOTIONS[c], "time [s]", f"RMS error [{unit}]",
            shaded=explanation.held, marker="o",
        )  # fmt: skip
        over_time.append(plots.zoomable(figure, f"time-{c}-"))
        slots, by_speed = _by_speed(explanation, shown, i)
        figure = plots.curves(
            slots, by_speed, MOTIONS[c], _directions(c), f"RMS error [{unit}]", marker="o"
        )
        over_speed.append(plots.zoomable(figure, f"speed-{c}-"))
    return [
        report.panels(over_time, f"Over the time of the bag, in steps of {step:.0f} s."),
        report.panels(
            over_speed,
            "Over the vehicle's own velocity: an error that grows with speed points to damping or "
            "thrust, one that differs left and right of zero to an asymmetry, one at rest to "
            "weight, current or deadband. All data, fitted and held out.",
        ),
    ]


def _by_speed(
    explanation: Explanation, shown: Mapping[str, Array], i: int
) -> tuple[Array, dict[str, Array]]:
    """RMS errors of component i over its own velocity: the middles of the bins, and by label."""
    own = explanation.measured[:, i]
    low, high = np.quantile(own, [0.01, 0.99])
    edges = np.linspace(low, high, _SPEED_BINS + 1)
    errors = {label: binned(own, run[:, i] - own, edges) for label, run in shown.items()}
    return 0.5 * (edges[1:] + edges[:-1]), errors


def _directions(component: str) -> str:
    backward, forward = SENSES[component]
    space = "\u2003\u2003"
    return f"\u2190 {backward}{space}{component} [{UNITS[component]}]{space}{forward} \u2192"


def binned(x: Array, error: Array, edges: Array) -> Array:
    """Root mean square error (n,) between the edges (n + 1,) of x; NaN where there is little."""
    place = np.digitize(x, edges) - 1
    n = len(edges) - 1
    inside = (place >= 0) & (place < n) & np.isfinite(error)
    count = np.bincount(place[inside], minlength=n)
    total = np.bincount(place[inside], error[inside] ** 2, n)
    out: Array = np.sqrt(np.where(count >= _LEAST, total, np.nan) / np.maximum(count, 1))
    return out


def _card(finding: Finding) -> str:
    effect, name = EFFECTS[finding.effect], called(finding.effect)
    meanings = {p.name: p.meaning for p in effect.parameters}
    rows = []
    for symbol, v in finding.parameters.items():
        meaning = meanings.get(symbol) or parse(symbol).meaning
        rows.append([symbol, *estimate(v.value, v.std), "" if v.unit == "1" else v.unit, meaning])
    parts = [
        report.paragraph(effect.summary),
        report.table(["", "value", "std", "unit", "meaning"], rows, text=(3, 4)),
        report.paragraph(f"Gain on data that no fit has seen: {interval(finding.gain)}."),
    ]
    if finding.repetition is not None:
        parts += _in_each_record(finding.repetition)
    if finding.axes:
        parts.append(report.paragraph(f"It acts on {listed(finding.axes)}."))
    why = [f"Not sure: {'; '.join(finding.doubts)}."] if finding.doubts else []
    if finding.alternatives:
        why.append("This bag cannot tell them apart.")
        tried = [f"{called(a.effect)}: {a.why_not}" for a in finding.alternatives]
        heard = "Why nothing else" if finding.separable else "What else it may be"
        parts += [report.paragraph(f"{heard}:"), report.bullets(tried)]
    if not finding.separable:
        why.append(f"The run that would tell: {run_to_tell(finding)}.")
        parts.append(report.paragraph(" ".join(why)))
    return report.card(name[0].upper() + name[1:], parts)


def minor(effects: Sequence[Finding]) -> list[str]:
    """Effects that are not worth a change, each with the interval of its gain."""
    if not effects:
        return []
    rows = []
    for f in effects:
        gain = judged(f.gain)
        values = ", ".join(valued(n, v) for n, v in f.parameters.items())
        told = f"{gain.percent:.1f} % ({gain.low:.1f} to {gain.high:.1f})"
        rows.append([called(f.effect), values, told])
    return [
        report.heading("Minor effects"),
        report.paragraph(
            "Seen in the data, but of less than 2 % gain, not surely of any (the interval holds "
            "0: a second dive would decide), or not supported by all of the data."
        ),
        report.table(["effect", "parameters", "gain (95 %)"], rows, text=(1,)),
    ]


def _in_each_record(r: Repetition) -> list[str]:
    """Whether an effect is the same in each of several records, and what it is in each."""
    words = "It is the same in each record." if r.same else "The records differ in it."
    if r.repeats is not None:
        does = "does" if r.repeats else "does not"
        words += f" Fitted to the others, it {does} predict a record that was left out better."
    names = list(r.records[0])
    rows = [
        [f"record {i}", *(x for n in names for x in estimate(of[n].value, of[n].std))]
        for i, of in enumerate(r.records, 1)
    ]
    heads = ["", *(x for n in names for x in (n, "std"))]
    return [report.paragraph(words), report.table(heads, rows)]


def _retuned(f: Findings, written: Config) -> list[str]:
    if not f.changed:
        return []
    rows = []
    for name, c in f.changed.items():
        after, std = estimate(c.after, c.std)
        sigma = number(abs(c.after - c.before) / c.std, 2) if c.std > 0.0 else "-"
        to_use, _ = estimate(written.value(name), c.std)
        row = [name, number(c.before, 4), after, std, to_use, c.unit, sigma, parse(name).meaning]
        rows.append(row)
    bent = "Where an effect is missing they bend to make up for it; std counts how far. "
    head = ["", "from", "to", "std", "extended.yaml", "unit", "off by [std]", "meaning"]
    return [
        report.heading("Retuned coefficients"),
        report.paragraph(
            "What refitting the coefficients that the simulation already has makes of them, "
            "before any effect is added, from the data that the search may fit. "
            f"{bent if f.effects else ''}The values to use are those of extended.yaml, fitted last."
        ),
        report.table(head, rows, (5, 7)),
    ]


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return " ".join(map(_plain, value.values()))
    if isinstance(value, list | tuple):
        return ", ".join(map(_plain, value))
    return str(value)


@plots.styled
def picture(explanation: Explanation) -> Figure:
    """The report in one picture: motion, gain and departure of the velocity that gains most."""
    gains = [f.gain.component for f in explanation.findings.effects]
    c = next((c for c in gains if c in VELOCITIES), "u")
    i = VELOCITIES.index(c)
    rmse, shown = _shown(explanation)
    figure, (motion, linear, angular, speed) = plots.overview(verdict(explanation.findings))
    t, measured, runs = _stretch(explanation, shown)
    motion.set(xlabel="time [s]", ylabel=f"{MOTIONS[c]} [{UNITS[c]}]")
    curves = {label: run[:, i] for label, run in runs.items()}
    plots.draw_curves(motion, t, curves, measured=measured[:, i], shaded=explanation.held)
    for ax, group in ((linear, VELOCITIES[:3]), (angular, VELOCITIES[3:])):
        values = {label: np.array([by[c] for c in group]) for label, by in rmse.items()}
        plots.draw_bars(ax, [MOTIONS[c] for c in group], values)
        ax.set_ylabel(f"RMSE, {BLOCK:.0f} s ahead [{UNITS[group[0]]}]")
    slots, errors = _by_speed(explanation, shown, i)
    plots.draw_curves(speed, slots, errors, marker="o")
    speed.set(xlabel=_directions(c), ylabel=f"RMS error [{UNITS[c]}]")
    plots.outside_legend(figure, motion)
    return figure
