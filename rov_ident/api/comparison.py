"""Two results side by side: what changed, and by how much against its uncertainty."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.files import read_input
from rov_ident.core.messages import Array
from rov_ident.effects import parameter
from rov_ident.model.equations import INERTIA
from rov_ident.reports.result import NORMAL, Figure, Result, Shown, as_json
from rov_ident.reports.table import PLUS_MINUS, Table, estimate

if TYPE_CHECKING:
    from rov_ident.api.identification import Identification
    from rov_ident.discrepancy.explain import Explanation

_WITH_INTERVALS = (
    "Results have intervals, parameter files have none: compare result.json of identify, or the "
    "JSON that fit --json writes."
)
_BODY = "vehicle."  # how the numbers of the rigid body begin
_RELATIVE = ("cog_offset.", "buoyancy.")
_LARGEST_FILE = 100 << 20  # bytes; more than any result has


@dataclass(frozen=True)
class Estimates:
    """Named numbers (n,) with their standard deviations and half of their 95 % intervals, read
    from a result; of a configuration also what its rigid body is."""

    label: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    std: Array
    half: Array
    bags: frozenset[str] = frozenset()  # their sha256
    is_config: bool = False

    def __getitem__(self, names: Sequence[str]) -> tuple[Array, Array, Array]:
        """Values, standard deviations and halves of intervals (n,) of these names."""
        at = [self.names.index(name) for name in names]
        return self.values[at], self.std[at], self.half[at]


@dataclass(frozen=True)
class Comparison(Shown):
    """What two results say of the same coefficients: all arrays (n,) in the order of ``names``.

    ``deviations`` is the difference over its standard deviation, from the standard deviations of
    both as if their errors were independent; NaN where neither result has one. ``a_half`` and
    ``b_half`` are half of their 95 % intervals, as they state them. ``only_a`` and ``only_b`` are
    names that one of them lacks.
    """

    labels: tuple[str, str]
    names: tuple[str, ...]
    units: tuple[str, ...]
    a: Array
    a_std: Array
    a_half: Array
    b: Array
    b_std: Array
    b_half: Array
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def difference(self) -> Array:
        """b - a (n,), each in its unit."""
        return self.b - self.a

    @property
    def difference_std(self) -> Array:
        """Standard deviation of the difference (n,)."""
        return np.hypot(self.a_std, self.b_std)

    @property
    def difference_half(self) -> Array:
        """Half of the 95 % interval of the difference (n,)."""
        return np.hypot(self.a_half, self.b_half)

    @property
    def deviations(self) -> Array:
        """The difference in standard deviations of it (n,)."""
        std = self.difference_std
        return self.difference / np.where(std > 0.0, std, np.nan)

    @property
    def percent(self) -> Array:
        """The difference in percent of the first value (n,); NaN where that is zero."""
        return 100.0 * self.difference / np.where(self.a == 0.0, np.nan, np.abs(self.a))

    @property
    def changed(self) -> tuple[str, ...]:
        """The names whose difference is outside its 95 % interval, the surest first."""
        sure = np.nan_to_num(np.abs(self.deviations))
        beyond = np.abs(self.difference) > self.difference_half
        return tuple(self.names[i] for i in np.argsort(-sure) if sure[i] > 0.0 and beyond[i])

    @property
    def sentence(self) -> str:
        """How many coefficients changed, which one most surely, and which only one of them has."""
        lacking = "".join(
            f" Only {label} has {', '.join(names)}."
            for label, names in zip(self.labels, (self.only_a, self.only_b))
            if names
        )
        return self._of_common() + lacking

    def _of_common(self) -> str:
        n, chance = len(self.names), 0.05 * len(self.names)
        if not self.difference_std.any():
            differ = [name for name, by in zip(self.names, self.difference) if by]
            of_body = [name for name in differ if name.startswith(_BODY)]
            n -= sum(name.startswith(_BODY) for name in self.names)
            also = f", and so do {', '.join(of_body)}" if of_body else ""
            return (
                f"From {self.labels[0]} to {self.labels[1]}, {len(differ) - len(of_body)} of {n} "
                f"coefficients differ{also}; neither has intervals, so nothing can be said of "
                f"whether that is more than chance. {_WITH_INTERVALS}"
            )
        text = (
            f"From {self.labels[0]} to {self.labels[1]}, {len(self.changed)} of {n} coefficients "
            f"differ by more than the 95 % interval of the difference (by chance: {chance:.1f})"
        )
        if not self.changed:
            return f"{text}."
        first = self.names.index(self.changed[0])
        return f"{text}; most surely {self.changed[0]}, by {self.deviations[first]:+.1f} std."

    def table(self) -> Table:
        """Both values with half of their 95 % intervals, and the difference in percent of the
        first and in its std; of values without intervals, the difference in percent alone."""
        a, b = self.labels
        percents, offs = (
            [f"{x:+.1f}" if math.isfinite(x) else "-" for x in xs]
            for xs in (self.percent, self.deviations)
        )
        rows = [
            [name, *first, *second, unit, percent, off, "changed" if name in self.changed else ""]
            for name, first, second, unit, percent, off in zip(
                self.names,
                map(_value_and_interval, self.a, self.a_half),
                map(_value_and_interval, self.b, self.b_half),
                self.units,
                percents,
                offs,
            )
        ]
        head = ["", a, PLUS_MINUS, b, PLUS_MINUS, "unit", "difference [%]", "[std]", ""]
        if not self.difference_std.any():
            keep = (0, 1, 3, 5, 6)
            head, rows = [head[i] for i in keep], [[row[i] for i in keep] for row in rows]
            return Table(f"{a} against {b}", head, rows, text=(3,))
        return Table(f"{a} against {b}", head, rows, text=(5, 8))

    def plot(self) -> Figure:
        """Both values with their 95 % intervals, relative to the first."""
        from rov_ident.reports import plots

        percent = 100.0 / np.maximum(np.abs(np.where(self.a == 0.0, self.b, self.a)), 1e-12)
        columns = zip(self.labels, (self.a, self.b), (self.a_half, self.b_half))
        rows = {
            label: (percent * (value - self.a), percent * np.nan_to_num(half))
            for label, value, half in columns
        }
        label = f"difference from {self.labels[0]} [%], with 95 % intervals"
        return plots.intervals(self.names, rows, label)

    def to_json(self) -> str:
        """Both values, their difference, and which changed."""
        keys = (
            "a", "a_std", "a_half", "b", "b_std", "b_half",
            "difference", "difference_std", "difference_half", "deviations",
        )  # fmt: skip
        columns = zip(*(getattr(self, key).tolist() for key in keys))
        entries: dict[str, dict[str, Any]] = {}
        for name, unit, values in zip(self.names, self.units, columns):
            finite = {k: v if math.isfinite(v) else None for k, v in zip(keys, values)}
            entries[name] = {"unit": unit, **finite, "changed": name in self.changed}
        document = {"a": self.labels[0], "b": self.labels[1], "coefficients": entries}
        others = ("changed", "only_a", "only_b", "sentence", "notes")
        document |= {key: getattr(self, key) for key in others}
        return as_json(document)


def _value_and_interval(value: float, half: float) -> tuple[str, str]:
    return (f"{value:.5g}", "") if half == 0.0 else estimate(value, half)


def compare(
    a: "Result | Explanation | Identification | Config | str | os.PathLike[str]",
    b: "Result | Explanation | Identification | Config | str | os.PathLike[str]",
) -> Comparison:
    """Compare two results: which coefficients changed, and by how many standard deviations.

    Parameters
    ----------
    a, b
        A Fit, an Explanation, an Identification, a Config, or the path of the JSON of ``fit``,
        ``explain``, ``nomoto`` or ``forces``, of the folder that ``identify`` wrote, or of a
        parameter file (YAML). Values of a configuration have no uncertainty: they are compared as
        they are. Of two configurations, mass, weight, buoyancy, centres and inertia are, too.

    Returns
    -------
    Comparison
        Values, standard deviations and differences (n,), each in the coefficient's unit.

    Raises
    ------
    UserError
        If a file cannot be read, holds no estimates, or the two have no coefficient in common.
    """
    one, two = _estimates(a), _estimates(b)
    # No result has the rigid body, which a fit takes as it is.
    whole = one.is_config and two.is_config
    mine, other = ([n for n in e.names if whole or not n.startswith(_BODY)] for e in (one, two))
    names = tuple(name for name in mine if name in other)
    if not names:
        raise UserError(f"{one.label} and {two.label} have no coefficient in common")
    units, of_two = (tuple(e.units[e.names.index(n)] for n in names) for e in (one, two))
    for name, unit, there in zip(names, units, of_two, strict=True):
        if unit != there:
            raise UserError(f"{name} is in {unit} in {one.label}, in {there} in {two.label}")
    same_data = (
        "both are made from the same data: their errors go together, and the standard deviation of "
        "the difference is an upper bound of it"
    )
    notes = [same_data] if one.bags & two.bags else []
    if any(name.startswith(_RELATIVE) for name in names):
        notes.append(
            "cog_offset and buoyancy.delta count from vehicle.cog and vehicle.buoyancy of the file "
            "that each began with: where these differ, so do they, with nothing changed"
        )
    labels = (one.label, two.label) if one.label != two.label else ("a", "b")
    return Comparison(
        labels, names, units, *one[names], *two[names],
        tuple(n for n in mine if n not in names), tuple(n for n in other if n not in names),
        tuple(notes),
    )  # fmt: skip


def _estimates(source: Any) -> Estimates:
    if isinstance(source, Config):
        return _numbers_of_config(source, source.name)
    if isinstance(source, Shown):
        label = source.estimator if isinstance(source, Result) else type(source).__name__.lower()
        return _numbers_of_json(json.loads(source.to_json()), label)
    if not isinstance(source, str | os.PathLike):
        kind = type(source).__name__
        raise UserError(f"{kind} is no result: give a Fit, a Config or the path of a file of one")
    path, label = Path(source), Path(source).name
    if path.is_dir():  # of identify
        path /= "result.json"
    if path.suffix in (".yaml", ".yml"):
        return _numbers_of_config(configuration.load(path), path.name)
    try:
        return _numbers_of_json(json.loads(read_input(path, _LARGEST_FILE), parse_int=float), label)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is no JSON of a result: {error}") from error


def _numbers_of_config(config: Config, label: str) -> Estimates:
    model, body = config.model, config.model.body
    entries = [
        (c.name, c.unit, value) for c, value in zip(model.coefficients, model.theta.tolist())
    ]
    entries += [
        (f"{name}.{own}", parameter(name, own).unit, value)
        for name, values in config.effects.items()
        for own, value in values.items()
    ]
    for key, unit in (("mass", "kg"), ("weight", "N"), ("buoyancy", "N")):
        entries.append((f"{_BODY}{key}", unit, getattr(body, key)))
    for key in ("cog", "cob"):
        entries += [(f"{_BODY}{key}.{axis}", "m", x) for axis, x in zip("xyz", getattr(body, key))]
    entries += [(f"{_BODY}inertia.{n}", "kg m2", body.inertia[at]) for n, at in INERTIA.items()]
    names, units, values = zip(*entries)
    none = np.zeros(len(names))
    return Estimates(label, names, units, np.array(values), none, none, is_config=True)


def _numbers_of_json(document: Any, label: str) -> Estimates:
    """The numbers in the JSON of a result.

    Raises UserError if there are none.
    """
    if isinstance(document, Mapping) and isinstance(document.get("fit"), Mapping):
        document = document["fit"]  # of identify
    found: dict[str, tuple[str, float, float, float]] = {}
    entry: Any
    for name, entry in _entries(document):
        value, std, unit = entry.get("value", entry.get("to")), entry.get("std"), entry.get("unit")
        numeric = all(isinstance(x, int | float) and math.isfinite(x) for x in (value, std))
        if not (numeric and isinstance(unit, str) and float(std) >= 0.0):
            raise UserError(f"{label}: {name} has no value, std and unit as results have them")
        found[name] = (unit, float(value), float(std), _half_of(entry, float(std)))
    if not found:
        raise UserError(
            f"{label} holds no estimates: give the JSON of fit, explain, identify, nomoto or forces"
        )
    units, values, std, half = zip(*found.values(), strict=True)
    bags = _mappings(_mapping(document.get("provenance")).get("bags"))
    hashes = frozenset(str(bag["sha256"]) for bag in bags if "sha256" in bag)
    return Estimates(
        label, tuple(found), units, np.array(values), np.array(std), np.array(half), hashes
    )


def _half_of(entry: Mapping[str, Any], std: float) -> float:
    """Half of the 95 % interval that a result states: of few data more than NORMAL of ``std``."""
    low, high = (entry.get(key) for key in ("lower", "upper"))
    if not (isinstance(low, int | float) and isinstance(high, int | float)):
        return NORMAL * std
    half = 0.5 * (float(high) - float(low))
    return half if math.isfinite(half) and half >= 0.0 else NORMAL * std


def _mapping(x: Any) -> Mapping[str, Any]:
    return x if isinstance(x, Mapping) else {}


def _mappings(x: Any) -> list[Mapping[str, Any]]:
    return [_mapping(one) for one in x] if isinstance(x, list) else []


def _entries(document: Any) -> list[tuple[str, Mapping[str, Any]]]:
    """Every named number of a result: of `fit`, of `explain`, of `forces`, of `nomoto`."""
    top = _mapping(document)
    groups = [("", top.get("coefficients", top))]
    if "retuned" in top:
        groups = [("", _mapping(top["retuned"]).get("changed"))]
        effects = _mappings(top.get("effects"))
        groups += [(f"{effect.get('effect')}.", effect.get("parameters")) for effect in effects]
    elif "axes" in top:
        groups = [("", _mapping(axis).get("terms")) for axis in _mapping(top["axes"]).values()]
    return [
        # named as in a fit
        (name if name[:1].isupper() else f"{prefix}{name}", entry)
        for prefix, group in groups
        for name, entry in _mapping(group).items()
        if isinstance(entry, Mapping) and "std" in entry
    ]
