"""A prior from captive tests: what `forces --json` wrote, in the place of the configuration's."""

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rov_ident.config import Config
from rov_ident.config.prior import prior_of
from rov_ident.core.errors import UserError
from rov_ident.core.files import read_input
from rov_ident.core.messages import Array
from rov_ident.model.coefficients import AXES, Coefficient, parse, parse_input
from rov_ident.model.equations import build, coriolis
from rov_ident.reports.result import NORMAL

_LARGEST_FILE = 1 << 26  # bytes; results have some kilobytes
_LEAST = 1e-3  # of a value; a choice: no tank or CFD knows a force better
_APART = 3.0  # standard deviations: of 400 coefficients that agree, one is further off


@dataclasses.dataclass(frozen=True)
class _Axis:
    """Of one axis: names, values and covariance; slopes as :attr:`AxisFit.left_out`."""

    names: tuple[str, ...]
    values: Array
    covariance: Array
    left_out: Mapping[str, Array]


def with_prior(config: Config, path: Path) -> tuple[Config, dict[str, Any]]:
    """The configuration with the values of a force table, known as well as it says; and for the
    JSON of a fit, the file and the names of these coefficients.

    Coefficients that the configuration lacks are added; a constant (`X_0`) is left out. Where the
    configuration has a term that the table left out of its structure, the table's values hold for
    that term being zero: they are moved by what the configuration says of it, and are as much less
    certain. The prior is diagonal: the variances of an axis are taken times the largest eigenvalue
    of their correlations, so that in no direction it is surer than table and configuration.

    Raises UserError: no result of `forces`, numbers that are none, a coefficient that is none, or
    one that still holds the Coriolis forces of this vehicle's added mass.
    """
    try:
        data = read_input(path, _LARGEST_FILE)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    try:
        axes, coriolis_taken_off = _axes(json.loads(data, parse_int=float))
        told = _usable_names(config, axes, coriolis_taken_off)
        values, std = dict(config.model.values), dict(config.prior.std)
        for axis in axes.values():
            means, widths = _conditioned(config, axis)
            values |= means
            std |= widths
        new = config.with_model(build(config.model.body, values))
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except (ValueError, RecursionError, LookupError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} is no result of a force table: give what `rov-ident forces --json` wrote"
        ) from error
    std = {name: x for name, x in std.items() if name in new.model.names}
    new = dataclasses.replace(new, prior=dataclasses.replace(new.prior, std=std))
    digest = hashlib.sha256(data).hexdigest()
    return new, {"file": path.name, "sha256": digest, "coefficients": told}


def disagreements(
    prior: Mapping[str, tuple[float, float]], names: tuple[str, ...], values: Array, std: Array
) -> tuple[str, ...]:
    """Notes on coefficients whose dive and table exclude each other.

    ``prior`` has mean and standard deviation by name. From prior to posterior a value moves with
    the variance that the data remove.
    """
    notes = []
    for name, value, now in zip(names, values.tolist(), std.tolist(), strict=True):
        mean, before = prior.get(name, (value, math.inf))
        removed = math.sqrt(max(before**2 - now**2, 1e-4 * before**2))
        if abs(value - mean) > _APART * removed:
            notes.append(
                f"{name}: the table has {mean:.4g} ± {NORMAL * before:.2g}, with the dives it is "
                f"{value:.4g} ± {NORMAL * now:.2g}: they exclude each other, one of the two lacks "
                "an effect"
            )
    return tuple(notes)


def _axes(document: Any) -> tuple[dict[str, _Axis], bool]:
    """What the JSON says, and whether Coriolis forces were taken off.

    Raises UserError for numbers that are no result; LookupError, TypeError, ValueError or
    AttributeError where it has another form.
    """
    axes = {}
    for axis, part in document["axes"].items():
        names = tuple(part["terms"])
        pairs = [_numbers(name, entry) for name, entry in part["terms"].items()]
        values, std = np.array(pairs).reshape(-1, 2).T
        n, given = len(names), part.get("covariance")
        own = np.diag(std**2) if given is None else np.array(given, dtype=np.float64)
        slopes = {
            name: np.array(slope, dtype=np.float64)
            for name, slope in part.get("left_out", {}).items()
        }
        shapes = {slope.shape for slope in slopes.values()}
        if own.shape != (n, n) or not np.isfinite(own).all() or not shapes <= {(n,)}:
            raise UserError(f"covariance and left_out of {axis} do not fit its {n} terms")
        size = np.sqrt(np.maximum(np.diag(own), 1e-300))
        axes[axis] = _Axis(names, values, own * np.outer(std / size, std / size), slopes)
    return axes, document.get("coriolis_taken_off") is True


def _numbers(name: str, entry: Mapping[str, Any]) -> tuple[float, float]:
    """Value, and the standard deviation with which a normal distribution has its 95 % interval."""
    numbers = [entry.get(key, 0.0) for key in ("value", "std", "lower", "upper")]
    if "value" not in entry or "std" not in entry or any(isinstance(x, str) for x in numbers):
        raise UserError(f"{name} lacks the numbers value and std")
    value, std, lower, upper = map(float, numbers)
    if not (math.isfinite(value + lower + upper) and 0.0 <= std < math.inf):
        raise UserError(f"{name} is {value:g} with a std of {std:g}, which is no result")
    return value, max(std, 0.5 * (upper - lower) / NORMAL, _LEAST * abs(value), 1e-12)


def _usable_names(config: Config, axes: Mapping[str, _Axis], coriolis_taken_off: bool) -> list[str]:
    """The coefficients of the file. Raises UserError if one is not to be used."""
    told = []
    for axis, part in axes.items():
        for name in part.names:
            if axis not in AXES or not name.startswith(axis):
                raise UserError(f"{name} stands on the axis {axis}, where it cannot be")
            if name.endswith("_0"):
                continue
            if (
                parse_input(name) is None
                and not coriolis_taken_off
                and _holds_coriolis(config, name)
            ):
                raise UserError(
                    f"{name} holds a Coriolis force of the added mass, which the model has "
                    "already: write the file with rov-ident forces --config"
                )
            told.append(name)
    if not told:
        raise UserError("it has no coefficient: a constant is none")
    return told


def _conditioned(config: Config, axis: _Axis) -> tuple[dict[str, float], dict[str, float]]:
    """Means and standard deviations by name, of the axis beside what the configuration has."""
    prior = prior_of(config)
    known = dict(zip(prior.names, zip(prior.mean.tolist(), prior.std.tolist(), strict=True)))
    held = {name: (value, 0.0) for name, value in config.model.values.items() if name not in known}
    places = {c.place: c.name for c in config.model.coefficients}

    def own_name(name: str) -> str:
        """Of the configuration, which may have Y_vu for Y_uv; empty where it has none."""
        fin = name.endswith("_0") or parse_input(name) is not None
        return "" if fin else places.get(parse(name).place, "")

    beside = {own: s for name, s in axis.left_out.items() if (own := own_name(name))}
    mean, std = np.array([(known | held)[own] for own in beside]).reshape(-1, 2).T
    slopes = np.array(list(beside.values())).reshape(-1, len(axis.names)).T
    values = axis.values - slopes @ mean
    # joint covariance: first the axis's terms, then those left out, whose values stay
    joint = np.vstack([slopes * -std, np.diag(std)])
    joint = joint @ joint.T
    n = len(axis.names)
    joint[:n, :n] += axis.covariance
    size = np.sqrt(np.diag(joint))
    moving = size > 0.0
    correlation = (joint / np.outer(np.maximum(size, 1e-300), np.maximum(size, 1e-300)))[moving]
    factor = math.sqrt(max(float(np.linalg.eigvalsh(correlation[:, moving])[-1]), 1.0))
    names = [own_name(name) or name for name in axis.names]
    found = {name: i for i, name in enumerate(names) if not name.endswith("_0")}
    return (
        {name: float(values[i]) for name, i in found.items()},
        {name: factor * float(size[i]) for name, i in found.items()},
    )


def _holds_coriolis(config: Config, name: str) -> bool:
    """Whether the added mass makes a force on this axis with the term's product of velocities."""
    c: Coefficient = parse(name)
    if c.is_added_mass or not (1 <= c.left <= 6 and 1 <= c.right <= 6):
        return False
    mass, unit = config.model.added_mass, np.eye(6)

    def force(nu: Array) -> float:
        return float(coriolis(mass @ nu, nu)[c.row])

    a, b = unit[c.left - 1], unit[c.right - 1]
    both = force(a) if c.left == c.right else force(a + b) - force(a) - force(b)
    return abs(both) > 1e-12
