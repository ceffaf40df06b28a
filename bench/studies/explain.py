"""How often `explain` finds what is hidden in a bag: the tables in docs/explain-bench.md.

    python -m bench.studies.explain [--tier TIER ...] [--limit N] [--jobs N] [--folder DIR]
                                    [--suite N]
    python -m bench.studies.explain --report      the tables of the bags that are there
    python -m bench.studies.explain --failures    what went wrong, and the command that shows it
    python -m bench.studies.explain --one TIER:NAME:INDEX
    python -m bench.studies.explain --seconds     how long the command takes on an idle computer

Every bag leaves one line in FOLDER/TIER.jsonl, at once, so that a run can be broken off and taken
up again. Lines of other sources are measured anew (``--keep``: used as they are). Exit status 1
where a bar is missed.

Bags are drawn by :mod:`hidden` from seeds that are a hash of suite, tier, name and index. The
strength of an effect is what knowing it would gain on held-out data; it is scaled until the gain
lies in the bracket of the tier. Where no strength does that the next seed is taken, and counted.
"""

import argparse
import dataclasses
import hashlib
import itertools
import json
import math
import shlex
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from bench.harness import Bars, Line, announce, digest, key, lines_of, recorded, table
from bench.simulators import fossen, hidden
from bench.simulators.hidden import NESTED, SENSOR_EFFECTS, UNKNOWN, UNOBSERVABLE, Case, Conditions
from rov_ident import config as configuration
from rov_ident.discrepancy import explain as engine
from rov_ident.discrepancy.findings import sensor_findings
from rov_ident.discrepancy.held_out import Judge, gain_of, split
from rov_ident.discrepancy.hypothesis import COEFFICIENTS, Key
from rov_ident.discrepancy.output_error import fit, refit
from rov_ident.discrepancy.results import Finding, Gain
from rov_ident.discrepancy.search import Search
from rov_ident.discrepancy.sensor_choice import Data
from rov_ident.discrepancy.windowed_problem import WindowedProblem
from rov_ident.effects import EFFECTS
from rov_ident.io import cdr
from rov_ident.io.bag_writer import BagWriter
from rov_ident.model.coefficients import VELOCITIES
from rov_ident.sampling.raw_streams import Streams, corrected, gather

MEDIUM, WEAK, ANY = (0.4, 0.8), (0.1, 0.4), (0.0005, 0.4)
SEEDS = 6  # tried for a bag until one can be brought to its strength
EVALUATIONS = 7  # of the gain, for each
_CLOCKED = 14  # of the slowest bags
STRONGEST = 3.0  # times what is drawn; beyond that no vehicle is like it


# ------------------------------------------------------------------ tiers


@dataclass(frozen=True)
class Tier:
    """Bags of one kind: ``number`` of each name, each effect's true gain within ``bracket``.

    ``rule`` says what is right (:data:`RULES`), ``bar`` the least share of it; ``wrong`` and
    ``sure`` are the largest shares of bags with a wrong name, or one said to be sure.
    """

    rule: str
    conditions: Conditions
    names: Sequence[str]
    number: int
    bracket: tuple[float, float] = MEDIUM
    bar: float | None = None
    wrong: float | None = None
    sure: float | None = None


def _singles(rule: str, place: str, number: int, bar: float | None, **more: Any) -> Tier:
    seen = [n for n in hidden.EFFECTS if n not in UNOBSERVABLE.get(place, ())]
    return Tier(rule, hidden.TIERS[place], seen, number, bar=bar, **more)


_STANDARD = hidden.TIERS["standard"]
_OTHERS = [place for place in hidden.TIERS if place not in ("standard", "off 50 %")]

TIERS: dict[str, Tier] = {
    "medium": _singles("first", "standard", 10, 0.98),
    "weak": _singles("first", "standard", 10, 0.95, bracket=WEAK),
    "curve": _singles("curve", "standard", 20, None, bracket=ANY, wrong=0.02),
    "clean": Tier("clean", _STANDARD, ["clean"], 150, bar=0.99),
    "clean off 50 %": Tier("clean", hidden.TIERS["off 50 %"], ["clean"], 150, bar=0.99),
    "pairs": Tier("all", _STANDARD, ["pair"], 150, bar=0.9),
    "triples": Tier("all", _STANDARD, ["triple"], 50, bar=0.75),
    "nested pairs": Tier(
        "nested", _STANDARD, sorted("+".join(sorted(p)) for p in NESTED), 3, bar=0.9
    ),
    **{
        place: _singles("first", place, 10, 0.9)
        for place in ("no IMU", "odometry 5 Hz", "noise x 3", "60 s")
    },
    **{
        place: _singles("group", place, 10, 0.9, sure=0.02)
        for place in ("pilot", "tank", "no heave")
    },
    "unknown": Tier("unknown", _STANDARD, list(UNKNOWN), 10, bar=0.9),
    # beyond what is asked
    **{
        place: _singles("first", place, 4, None)
        for place in ("other vehicles", "other rates", "off 50 %")
    },
    "clean elsewhere": Tier("clean", _STANDARD, _OTHERS, 10),
}


@dataclass(frozen=True)
class Trial:
    """One bag: the ``index``-th of a name in a tier of a suite."""

    tier: str
    name: str
    index: int
    suite: str = "1"

    @property
    def seed(self) -> int:
        text = f"{self.suite}:{self.tier}:{self.name}:{self.index}"
        return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "big")

    @property
    def effects(self) -> tuple[str, ...]:
        """What is hidden, of the library."""
        if self.name in ("pair", "triple"):
            return _drawn(self)
        return tuple(n for n in self.name.split("+") if n in hidden.EFFECTS)

    @property
    def unknown(self) -> str | None:
        return self.name if self.name in UNKNOWN else None

    @property
    def conditions(self) -> Conditions:
        elsewhere = self.tier == "clean elsewhere"
        return hidden.TIERS[self.name] if elsewhere else TIERS[self.tier].conditions


def _drawn(trial: Trial) -> tuple[str, ...]:
    """Pairs go through all there are in random order, triples are drawn; none that is nested."""
    names = list(hidden.EFFECTS)
    if trial.name == "pair":
        pairs = [p for p in itertools.combinations(names, 2) if frozenset(p) not in NESTED]
        shuffled = np.random.default_rng(Trial("pairs", "pair", -1, trial.suite).seed)
        first, second = pairs[shuffled.permutation(len(pairs))[trial.index % len(pairs)]]
        return first, second
    rng = np.random.default_rng(trial.seed)
    while True:
        found = tuple(names[i] for i in rng.choice(len(names), 3, replace=False))
        if not any(frozenset(p) in NESTED for p in itertools.combinations(found, 2)):
            return found


def trials(tier: str, limit: int, suite: str) -> list[Trial]:
    """A tier's bags, or as many tenths of them, names in turn."""
    t = TIERS[tier]
    number = math.ceil(t.number * min(1.0, limit / 10))
    return [Trial(tier, name, i, suite) for i in range(number) for name in t.names]


# ------------------------------------------------------------------ what knowing the truth gains


@dataclass(frozen=True)
class Bag:
    """A case as `explain` gets it, and the true gains [1] of what is hidden, in its order."""

    case: Case
    streams: Streams
    strengths: tuple[float, ...]
    gains: tuple[float, ...]


def streams_of(case: Case) -> Streams:
    return gather(((role, message) for _, role, message in case.messages), case.config)


def truth(case: Case, names: Iterable[str]) -> dict[Key, float]:
    """The true values of effects on the dynamics, by the keys of the engine."""
    values: dict[Key, float] = {}
    for name in names:
        for parameter, value in case.effects[name].items():
            if name == "asymmetric_damping":  # told as what holds for negative velocity
                values[COEFFICIENTS, f"{parameter}_neg"] = value - case.theta[parameter]
            elif EFFECTS[name].coefficients:
                values[COEFFICIENTS, parameter] = value
            else:
                values[name, parameter] = value
    return values


def true_gains(case: Case, streams: Streams) -> list[float]:
    """What each hidden effect gains where the structure is known, the others in place.

    As `explain` defines it, but nothing (0) where its 95 % interval holds nothing: a window in
    which the vehicle is unstable can pretend any gain. NaN where the true model cannot be fitted.
    """
    to_fit, held = split(streams.duration)
    sensors = [n for n in case.effects if n in SENSOR_EFFECTS]
    gains = dict.fromkeys(case.effects, math.nan)
    if sensors:
        data = Data(streams, to_fit, streams, held, case.config)
        choice = data.fitted(sensors, frozenset())
        gains |= {f.effect: _certain(f.gain) for f in sensor_findings(data, choice)}
        streams = corrected(streams, choice.sensors)
    others = [n for n in case.effects if n not in SENSOR_EFFECTS]
    if others:
        search, judge = Search(streams, case.config, to_fit), Judge(WindowedProblem(streams, held))
        full = fit(search.problem, search.given.having(truth(case, others)))
        for name in others if full else ():
            assert full is not None
            rest = search.given.having(truth(case, [n for n in others if n != name]))
            without = refit(rest, full.linearisation)
            if without is not None:
                gains[name] = _certain(judge.gain(without.hypothesis, full.hypothesis))
    return list(gains.values())


def _certain(gain: Gain) -> float:
    return gain.percent / 100.0 if gain.low > 0.0 else 0.0


def gain_of_unknown(case: Case, streams: Streams) -> float:
    """What knowing the wrench of an effect outside the library gains, over its mean in the world.

    A constant force is in the library, and what of the effect is no more than that has a name. The
    wrench that is known is added to what is demanded, and the given structure refitted.
    """
    truth = case.truth
    rotation = fossen.rotations(truth.orientation)
    steady = np.zeros_like(truth.foreign)
    steady[:, :3] = np.mean(np.einsum("kij,kj->ki", rotation, truth.foreign[:, :3]), 0) @ rotation
    begin = 1e-9 * (min(m.stamp for _, _, m in case.messages) - hidden.START)
    middle = streams.demand_t + begin + 0.5 * float(np.median(np.diff(streams.demand_t)))
    to_fit, held = split(streams.duration)
    squares = []
    for wrench in (steady, truth.foreign):
        known = np.stack([np.interp(middle, truth.t, column) for column in wrench.T], axis=1)
        there = dataclasses.replace(streams, demand=streams.demand + known)
        search, judge = Search(there, case.config, to_fit), Judge(WindowedProblem(there, held))
        fitted = fit(search.problem, search.given)
        if fitted is None:
            return math.nan
        squares.append(judge.summed(fitted.hypothesis))
    return _certain(gain_of(VELOCITIES, *squares, 1.0))


def bag(trial: Trial, seed: int, strengths: Sequence[float]) -> Bag:
    """The bag of a seed at these strengths, and what is to be gained there."""
    case = hidden.draw(
        seed, trial.effects, strengths or 1.0, conditions=trial.conditions, unknown=trial.unknown
    )
    streams = streams_of(case)
    gains = true_gains(case, streams)
    if trial.unknown:
        gains.append(gain_of_unknown(case, streams))
    return Bag(case, streams, tuple(strengths), tuple(gains))


def _power(gain: float) -> float:
    """Of the effect over the rest: what grows with the square of the strength."""
    return 1.0 / (1.0 - min(gain, 0.999)) ** 2 - 1.0


def brought(trial: Trial, seed: int) -> Bag | None:
    """The bag of a seed whose gains lie in the tier's bracket; None where no strength does that."""
    n = len(trial.effects) + bool(trial.unknown)
    if n == 0:
        return bag(trial, seed, ())
    bracket = TIERS[trial.tier].bracket
    falling = bracket == ANY
    low, high = (0.05, 0.4) if falling else bracket  # where the square law can be trusted
    rng = np.random.default_rng(seed)
    target = [
        _power(g) for g in rng.uniform(low + 0.1 * (high - low), high - 0.1 * (high - low), n)
    ]
    strength = [0.5 * math.sqrt(_power(low))] * n
    below, above = [0.0] * n, [math.inf] * n
    for _ in range(EVALUATIONS):
        there = bag(trial, seed, strength)
        if all(low <= g < high for g in there.gains):
            break
        for i, gain in enumerate(there.gains):
            if low <= gain < high:
                continue
            if gain < low:
                below[i] = strength[i]
                if below[i] >= STRONGEST:
                    return None
            else:  # a model that cannot be fitted is one too far off
                above[i] = strength[i]
            factor = math.sqrt(target[i] / max(_power(gain), 1e-4)) if gain == gain else 0.3
            new = strength[i] * float(np.clip(factor, 0.1, 10.0))
            if not below[i] < new < above[i]:
                new = math.sqrt(max(below[i], 0.1 * above[i]) * above[i])
            strength[i] = min(new, STRONGEST)
    else:
        return None
    if falling:
        wanted = _power(math.exp(rng.uniform(*np.log(bracket))))
        return bag(trial, seed, [there.strengths[0] * math.sqrt(wanted / _power(there.gains[0]))])
    return there


# ------------------------------------------------------------------ one bag


def measure(trial: Trial) -> Line:
    """Everything about a trial, as one line."""
    for skipped in range(SEEDS):
        there = brought(trial, trial.seed + skipped)
        if there is not None:
            return {**explained(trial, there), "skipped": skipped}
    return {**asdict(trial), "skipped": SEEDS, "unreached": True, "effects": list(trial.effects)}


def explained(trial: Trial, there: Bag) -> Line:
    """What is hidden in a bag and what `explain` finds, as one line."""
    case = there.case
    line = {
        **asdict(trial),
        "seed": case.seed,
        "family": case.family,
        "excitation": case.excitation,
        "effects": case.effects,
        "unknown": case.unknown,
        "axis": case.axis,
        "depends_on": list(case.depends_on),
        "strength": list(there.strengths),
        "gain": list(there.gains),
    }
    begin, worked = time.perf_counter(), time.process_time()
    try:
        findings = engine.explain([there.streams], case.config).findings
    except Exception as e:  # what is raised is a result, too
        at = traceback.extract_tb(e.__traceback__)[-1]
        where = f"{Path(at.filename).name}:{at.lineno}"
        nothing: Line = {"verdict": "", "found": [], "minor": [], "residual": []}
        return line | nothing | {"error": f"{type(e).__name__} in {where}: {e}"}
    return line | {
        "seconds": round(time.perf_counter() - begin, 2),
        "cpu": round(time.process_time() - worked, 2),
        "cut_short": engine.CUT_SHORT in findings.notes,
        "verdict": findings.verdict,
        "found": [_told(f, case) for f in findings.effects],
        "minor": [_told(f, case) for f in findings.minor],
        "residual": [asdict(r) for r in findings.residual],
    }


def _told(f: Finding, case: Case) -> Line:
    """A finding with, for each parameter, value, standard deviation and truth."""
    values = {n: (v.value, v.std) for n, v in f.parameters.items()}
    if f.effect == "wave" and "wave" in case.effects:
        values = _same_phase(values, case.effects["wave"])
    return {
        "effect": f.effect,
        "axes": "".join(f.axes),
        "separable": f.separable,
        "manoeuvre": bool(f.manoeuvre),
        "alternatives": [a.effect for a in f.alternatives],
        "gain": f.gain.percent / 100.0,
        "component": f.gain.component,
        "parameters": {
            n: [value, std, _true(case, f.effect, n)] for n, (value, std) in values.items()
        },
    }


def _true(case: Case, effect: str, name: str) -> float | None:
    """What a parameter of a finding should be; None where its effect is not there."""
    if effect not in case.effects:
        return None
    if name in case.effects[effect]:
        return case.effects[effect][name]
    if EFFECTS[effect].coefficients:
        return case.theta.get(name, 0.0)
    return next(p.null for p in EFFECTS[effect].parameters if p.name == name)


def _same_phase(
    values: dict[str, tuple[float, float]], true: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """A force the other way half a turn later is the same wave."""
    phase, std = values["phase"]
    turns = round((phase - true["phase"]) / math.pi)
    sign = -1.0 if turns % 2 else 1.0
    force = {n: (sign * values[n][0], values[n][1]) for n in ("fx", "fy", "fz") if n in values}
    return {**values, **force, "phase": (phase - math.pi * turns, std)}


# ------------------------------------------------------------------ what is right


def hidden_in(line: Line) -> list[str]:
    return list(line["effects"])


def names(line: Line) -> list[str]:
    return [f["effect"] for f in line["found"]]


def _declared(line: Line, f: Line) -> bool:
    """A group said to be inseparable, with the truth in it and the manoeuvre that separates it."""
    others = set(f["alternatives"])
    return not f["separable"] and f["manoeuvre"] and bool(others & set(hidden_in(line)))


def first(line: Line) -> bool:
    return names(line)[:1] == hidden_in(line)


def group(line: Line) -> bool:
    return first(line) or (bool(line["found"]) and _declared(line, line["found"][0]))


def all_named(line: Line) -> bool:
    return set(hidden_in(line)) <= set(names(line))


def nested(line: Line) -> bool:
    """All named, or one with all others beside it."""
    return all_named(line) or any(
        f["effect"] in hidden_in(line) and set(hidden_in(line)) <= {f["effect"], *f["alternatives"]}
        for f in line["found"]
    )


def clean(line: Line) -> bool:
    return line["verdict"] in ("agrees", "retuned") and not line["found"]


def unknown(line: Line) -> bool:
    """Said to be unexplained, by the right axis and dependence, and no name given for sure."""
    return (
        line["verdict"] == "unexplained"
        and any(
            r["sure"] and r["axis"] == line["axis"] and r["depends_on"] in line["depends_on"]
            for r in line["residual"]
        )
        and not sure(line)
    )


def wrong(line: Line) -> bool:
    """Something is named that is not there, other than in a group declared inseparable."""
    return any(f["effect"] not in hidden_in(line) and not _declared(line, f) for f in line["found"])


def sure(line: Line) -> bool:
    """Something is named that is not there, and said to be separable."""
    return any(f["effect"] not in hidden_in(line) and f["separable"] for f in line["found"])


RULES: dict[str, tuple[str, Callable[[Line], bool]]] = {
    "first": ("named first", first),
    "curve": ("named first", first),
    "group": ("named first or in a declared group", group),
    "all": ("all named", all_named),
    "nested": ("both named, or one beside the other", nested),
    "clean": ("nothing claimed", clean),
    "unknown": ("unexplained, right axis and dependence", unknown),
}


def cause(line: Line) -> str:
    """Why a bag failed, in a few words by which failures are counted."""
    if "error" in line:
        return "error: " + line["error"]
    others = [n for n in names(line) if n not in hidden_in(line)]
    missing = [n for n in hidden_in(line) if n not in names(line)]
    minor = [n for n in missing if n in {f["effect"] for f in line["minor"]}]
    told = [f"{r['axis']}|{r['depends_on']}" for r in line["residual"]]
    parts = []
    if missing:
        parts.append("missed " + ", ".join(n + " (minor)" * (n in minor) for n in missing))
    if others:
        parts.append("named " + ", ".join(others))
    elif not missing and hidden_in(line):
        parts.append("order " + ", ".join(names(line)))
    if line["verdict"] == "unexplained":
        parts.append("residual " + ", ".join(told))
    elif line["unknown"]:
        parts.append(f"verdict {line['verdict']}")
    return "; ".join(parts)


# ------------------------------------------------------------------ tables


def rate(count: int, total: int) -> str:
    """With its 95 % Wilson interval."""
    if total == 0:
        return ""
    interval = binomtest(count, total).proportion_ci(method="wilson")
    return f"{100 * count / total:.1f} % ({100 * interval.low:.0f} to {100 * interval.high:.0f})"


def report(lines: Mapping[str, list[Line]], bars: Bars) -> None:
    print("## Tiers")
    rows = []
    for tier, all_lines in lines.items():
        t = TIERS[tier]
        what, right = RULES[t.rule]
        there = [line for line in all_lines if "unreached" not in line]
        if not there:
            continue
        n, good = len(there), sum(map(right, there))
        share = "" if t.rule == "curve" else rate(good, n)
        if t.bar is not None:
            share = bars.check(good >= t.bar * n, share, f"{tier}: {what}")
        bad, certain = sum(map(wrong, there)), sum(map(sure, there))
        bad_text, sure_text = f"{100 * bad / n:.1f} %", f"{100 * certain / n:.1f} %"
        if t.wrong is not None:
            bad_text = bars.check(bad <= t.wrong * n, bad_text, f"{tier}: a wrong name")
        if t.sure is not None:
            sure_text = bars.check(certain <= t.sure * n, sure_text, f"{tier}: wrong and sure")
        skipped = sum(line["skipped"] for line in all_lines)
        bar = "" if t.bar is None else f"{100 * t.bar:.0f} %"
        rows.append([tier, n, what, share, bar, bad_text, sure_text, skipped])
    table(
        [
            "tier",
            "bags",
            "right is",
            "right",
            "bar",
            "a wrong name",
            "wrong, sure",
            "seeds skipped",
        ],
        rows,
    )
    _curve(lines.get("curve", []))
    _confusion([line for t in ("medium", "weak") for line in lines.get(t, [])])
    _parameters(lines, bars)
    _without_a_name(lines.get("unknown", []), bars)
    _seconds(lines)


def _curve(lines: Sequence[Line]) -> None:
    print("\n## Strength falling to nothing")
    edges = [-math.inf, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, math.inf]
    there = [line for line in lines if "unreached" not in line]
    rows = []
    for a, b in itertools.pairwise(edges):
        inside = [line for line in there if a <= line["gain"][0] < b]
        if inside:
            said = f"{100 * max(a, 0):g} to {100 * b:g} %" if b < 1 else f"above {100 * a:g} %"
            n = len(inside)
            nothing = sum(not line["found"] for line in inside)
            minor = sum(
                any(f["effect"] in hidden_in(line) for f in line.get("minor", []))
                for line in inside
            )
            rows.append([said, n, rate(sum(map(first, inside)), n), minor, nothing,
                         rate(sum(map(wrong, inside)), n)])  # fmt: skip
    table(["true gain", "bags", "named first", "as minor", "nothing named", "a wrong name"], rows)


def _confusion(lines: Sequence[Line]) -> None:
    print("\n## Confusion: one effect, medium and weak; rows are hidden, columns named first")
    order = list(hidden.EFFECTS)
    count: Counter[tuple[str, str]] = Counter()
    for line in lines:
        if "unreached" not in line:
            count[line["name"], (names(line) or ["none"])[0]] += 1
    columns = [*order, "none"]
    rows = [
        [f"{i} {name}", *(count[name, c] or "" for c in columns)] for i, name in enumerate(order, 1)
    ]
    table(["", *map(str, range(1, len(order) + 1)), "none"], rows)


def _parameters(lines: Mapping[str, list[Line]], bars: Bars) -> None:
    """How often intervals hold the truth, and how much of the true model's gain is reached."""
    print("\n## Parameters and gain of what is named rightly")
    rows, place = [], []
    for tier, there in lines.items():
        covered, gained = _coverage(there)
        if covered:
            place.append([f"*{tier}*", covered, gained])
    for name in hidden.EFFECTS:
        every = [line for t in ("medium", "weak") for line in lines.get(t, [])]
        covered, gained = _coverage([line for line in every if name in hidden_in(line)])
        if covered:
            place.append([name, covered, gained])
    for name, covered, gained in place:
        k, n = sum(covered), len(covered)
        cover, reach = rate(k, n), f"{100 * np.mean(np.minimum(gained, 1.0)):.1f} %"
        if name in ("*medium*", "*weak*"):
            cover = bars.check(0.9 <= k / n <= 0.99, cover, f"{name}: coverage")
            reach = bars.check(np.mean(np.minimum(gained, 1.0)) >= 0.95, reach, f"{name}: gain")
        rows.append([name, n, cover, reach, f"{100 * np.mean(np.array(gained) >= 0.95):.0f} %"])
    table(
        ["tier or effect", "parameters", "truth in its 95 % interval",
         "gain, of the true model's", "bags that reach 95 % of it"],
        rows,
    )  # fmt: skip


def _without_a_name(lines: Iterable[Line], bars: Bars) -> None:
    """How much of the gain of the true wrench is reached where no effect of the library is like it,
    by whatever is named."""
    shares: dict[str, list[float]] = {}
    for line in lines:
        if "found" in line:
            most = max((f["gain"] for f in line["found"]), default=0.0)
            shares.setdefault(line["name"], []).append(min(most / line["gain"][0], 1.0))
    if not shares:
        return
    print("\n## Gain of what has no name, of the true wrench's (bar 80 %)")
    rows = []
    for name, of in {**shares, "all": [x for part in shares.values() for x in part]}.items():
        mean = bars.check(np.mean(of) >= 0.8, f"{100 * np.mean(of):.0f} %", f"{name}: gain")
        rows.append([name, len(of), mean, f"{100 * min(of):.0f} %"])
    table(["hidden", "bags", "mean", "least"], rows)


def _coverage(lines: Iterable[Line]) -> tuple[list[bool], list[float]]:
    covered, gained = [], []
    for line in lines:
        for f in line.get("found", []):
            if f["effect"] not in hidden_in(line):
                continue
            for value, std, true in f["parameters"].values():
                covered.append(abs(value - true) <= 1.96 * std)
            true_gain = line["gain"][hidden_in(line).index(f["effect"])]
            if true_gain > 0.01:
                gained.append(f["gain"] / true_gain)
    return covered, gained


def _seconds(lines: Mapping[str, list[Line]]) -> None:
    """Of one core: bags share the computer here. The bar is for the command alone (--seconds)."""
    every = [x["cpu"] for there in lines.values() for x in there if "cpu" in x]
    if every:
        quick = f"median {np.median(every):.1f} s, 95 % {np.quantile(every, 0.95):.1f} s"
        print(f"\nA bag takes {quick}, the slowest {max(every):.1f} s of one core.")


def command(line: Line) -> str:
    one = shlex.quote(f"{line['tier']}:{line['name']}:{line['index']}")
    suite = "" if line["suite"] == "1" else f" --suite {line['suite']}"
    return f"python -m bench.studies.explain --one {one}{suite}"


def failures(lines: Mapping[str, list[Line]]) -> None:
    """Failed bags by cause, each with the command that repeats it alone."""
    for tier, there in lines.items():
        rule = TIERS[tier].rule
        right = RULES[rule][1]
        failed = []
        for line in there:
            if "unreached" in line:
                continue
            if (wrong(line) or "error" in line) if rule == "curve" else not right(line):
                failed.append(line)
        if not failed:
            continue
        print(f"\n{tier}: {len(failed)} of {len(there)}")
        for line in sorted(failed, key=lambda line: (cause(line), line["name"])):
            gains = " ".join(f"{100 * g:.0f}%" for g in line["gain"])
            what = "+".join(hidden_in(line)) or line["unknown"] or "clean"
            if line["unknown"]:
                what += f" ({line['axis']}|{'/'.join(line['depends_on'])})"
            print(f"  {what} [{gains}] {cause(line)}\n    {command(line)}")
    print("\nNever brought to their strength:")
    for there in lines.values():
        for line in there:
            if "unreached" in line:
                print(f"  {line['tier']}: {'+'.join(line['effects'])}")


# ------------------------------------------------------------------ one bag, told in full


def one(trial: Trial, known: Line | None) -> None:
    """A bag alone, with progress; at the seed and strength of its line where there is one."""
    if known is not None and "unreached" not in known:
        there: Bag | None = bag(trial, known["seed"], known["strength"])
    else:
        found = (brought(trial, trial.seed + attempt) for attempt in range(SEEDS))
        there = next((b for b in found if b is not None), None)
    if there is None:
        print("no seed can be brought to this strength")
        return
    case = there.case
    print(f"seed {case.seed}, {case.family}, {case.excitation}, {trial.conditions}")
    print(f"strength {there.strengths}, true gain {there.gains}")
    for name, values in case.effects.items():
        print(f"truth: {name} " + ", ".join(f"{n} {v:.4g}" for n, v in values.items()))
    if case.unknown:
        print(f"truth: {case.unknown} on {case.axis}, depends on {case.depends_on}")
    begin = time.perf_counter()

    def say(what: str, share: float) -> None:
        print(f"  {time.perf_counter() - begin:5.1f} s  {100 * share:3.0f} %  {what}", flush=True)

    findings = engine.explain([there.streams], case.config, progress=say).findings
    print(f"verdict: {findings.verdict}")
    for kind, found_here in (("found", findings.effects), ("minor", findings.minor)):
        for f in found_here:
            print(f"{kind}: {f.effect} on {''.join(f.axes)}, gain {f.gain.percent:.1f} % of "
                  f"{f.gain.component} ({f.gain.low:.1f} to {f.gain.high:.1f}), "
                  f"{'separable' if f.separable else 'not separable'}")  # fmt: skip
            for n, (value, std, true) in _told(f, case)["parameters"].items():
                off = "" if true is None else f", true {true:.4g}, {(value - true) / std:+.1f} std"
                print(f"    {n} {value:.4g} ± {1.96 * std:.2g}{off}")
            for a in f.alternatives:
                print(f"    not {a.effect}: {a.why_not}")
    for r in findings.residual:
        print(f"residual: {r}")


# ------------------------------------------------------------------ how long it takes


def clock(lines: Mapping[str, list[Line]], suite: str, bars: Bars) -> None:
    """Seconds that `rov-ident explain` takes, from the bag to the report: of the slowest bags that
    there are, at a higher rate, of an hour."""
    every = [x for there in lines.values() for x in there if "cpu" in x]
    slowest = sorted(every, key=lambda x: -x["cpu"])[:_CLOCKED]
    fast, long = Conditions(odometry_rate=50.0), Conditions(duration=3600.0)
    two = ("quadratic_damping", "thruster_lag")
    kinds: dict[str, tuple[float, Iterable[Case]]] = {
        f"3 minutes, the slowest of {len(every)}": (
            30.0,
            (bag(_trial_of(x), x["seed"], x["strength"]).case for x in slowest),
        ),
        "3 minutes, odometry at 50 Hz": (
            30.0,
            (hidden.draw(_seed(suite, n), (n,), conditions=fast) for n in hidden.EFFECTS),
        ),
        "an hour": (180.0, [hidden.draw(_seed(suite, "hour"), two, conditions=long)]),
    }
    rows = []
    for kind, (bar, cases) in kinds.items():
        measured = [_command(case) for case in cases]
        if measured:
            took, cut = zip(*measured, strict=True)
            text = bars.check(max(took) < bar, f"{max(took):.1f}", f"seconds, {kind}")
            middle = f"{np.median(took):.1f}"
            rows.append((kind, len(took), middle, text, f"{bar:.0f}", sum(cut)))
    table(("bags", "number", "median [s]", "longest [s]", "bar [s]", "cut short"), rows)


def _seed(suite: str, name: str) -> int:
    return Trial("seconds", name, 0, suite).seed


def _command(case: Case) -> tuple[float, bool]:
    """Seconds of the command on a case, and whether its search was cut short."""
    with tempfile.TemporaryDirectory() as folder:
        path, config = Path(folder, "bag.mcap"), Path(folder, "vehicle.yaml")
        with BagWriter(path) as writer:
            for stamp, role, message in case.messages:
                writer.write(f"/{role}", cdr.ROLE_TYPES[role], stamp, cdr.encode(message))
        configuration.dump(case.config, config)
        command = [sys.executable, "-m", "rov_ident", "explain", str(path)]
        command += ["--config", str(config), "--out", str(Path(folder, "out"))]
        begin = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        took = time.perf_counter() - begin
        notes = json.loads(Path(folder, "out", "findings.json").read_text())["notes"]
        return took, engine.CUT_SHORT in notes


# ------------------------------------------------------------------ all bags


def path_of(folder: Path, tier: str) -> Path:
    return folder / (tier.replace(" ", "_").replace("%", "percent") + ".jsonl")


def _trial_of(line: Line) -> Trial:
    return Trial(**line["trial"])


def _wanted(options: argparse.Namespace) -> Iterator[Trial]:
    for tier in options.tier or TIERS:
        yield from trials(tier, options.limit, options.suite)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tier", action="append", choices=TIERS, help="one or more; default: all")
    parser.add_argument("--limit", type=int, default=10, help="tenths of each tier (default 10)")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--folder", type=Path, default=Path("build/explain-bench"))
    parser.add_argument("--suite", default="1", help="another one has other seeds")
    parser.add_argument("--keep", action="store_true", help="use lines of other sources, too")
    parser.add_argument("--report", action="store_true", help="measure nothing")
    parser.add_argument("--failures", action="store_true", help="list them, measure nothing")
    parser.add_argument("--seconds", action="store_true", help="of the slowest, and of others")
    parser.add_argument("--one", metavar="TIER:NAME:INDEX", help="a bag alone, told in full")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if options.one:
        tier, name, index = options.one.split(":")
        trial = Trial(tier, name, int(index), options.suite)
        one(trial, recorded(path_of(options.folder, tier)).get(key(trial)))
        return 0
    announce()
    sources = [Path(module.__file__ or "").read_bytes() for module in (hidden, fossen)]
    wanted, source = list(_wanted(options)), digest(*sources)
    if not (options.report or options.failures or options.seconds):
        files = {tier: path_of(options.folder, tier) for tier in TIERS}
        lines_of(
            wanted, measure, lambda trial: files[trial.tier], source,
            jobs=options.jobs, keep=options.keep,
        )  # fmt: skip
    lines: dict[str, list[Line]] = {}
    for tier in options.tier or TIERS:
        there = recorded(path_of(options.folder, tier))
        lines[tier] = [there[key(t)] for t in wanted if t.tier == tier and key(t) in there]
    others = sum(line["source"] != source for there in lines.values() for line in there)
    if others:
        print(f"{others} bags were measured with other sources", file=sys.stderr)
    if options.failures:
        failures(lines)
        return 0
    bars = Bars()
    if options.seconds:
        clock(lines, options.suite, bars)
    else:
        report(lines, bars)
    return bars.status()


if __name__ == "__main__":
    sys.exit(main())
