"""Where the coefficients are among the parameters of a controller, and when to change them.

No ROS here: a controller's parameters are a mapping of names to numbers or tuples of numbers.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from rov_ident.config import Config
from rov_ident.errors import UserError
from rov_ident.formats.base import DIAGONAL

Value = float | tuple[float, ...]
Values = Mapping[str, Value]

LAYOUTS: dict[str, dict[str, str]] = {
    "none": {},
    # Its model has SNAME signs, each kind in the order X Y Z K M N: formats/auv_controllers.py.
    "auv_controllers": {
        name: f"hydrodynamics.{parameter}[{i}]"
        for kind, parameter in (
            ("added_mass", "added_mass"),
            ("linear", "linear_damping"),
            ("quadratic", "quadratic_damping"),
        )
        for i, name in enumerate(DIAGONAL[kind])
    },
}
"""Controllers whose parameters are known, by name: the place of each coefficient."""

_PLACE = re.compile(r"(?P<sign>-?)(?P<parameter>[A-Za-z_][\w./]*)(\[(?P<index>\d{1,3})\])?")


@dataclass(frozen=True)
class Target:
    """A coefficient, times ``sign``, is the ``parameter``, or element ``index`` of it."""

    coefficient: str
    parameter: str
    index: int | None = None
    sign: float = 1.0


@dataclass(frozen=True)
class Change:
    """What a controller has of a coefficient, and what it should have."""

    coefficient: str
    held: float
    wanted: float
    std: float

    @property
    def words(self) -> str:
        return f"{self.coefficient} {self.held:.5g} -> {self.wanted:.5g} +- {self.std:.2g}"


def targets(
    config: Config, template: str, mapping: Iterable[str] = (), layout: str = "none"
) -> tuple[Target, ...]:
    """Where the estimated coefficients go.

    ``mapping`` are entries `NAME=PARAMETER`, `NAME=-PARAMETER` (of the other sign) or
    `NAME=PARAMETER[INDEX]`; where there are any, or a ``layout`` of :data:`LAYOUTS`, what they do
    not name is not sent. Otherwise ``template`` makes the parameter of every coefficient, such as
    `hydrodynamics.{name}`.

    Raises
    ------
    UserError
        One sentence naming the entry and what to change.
    """
    estimated = [name for name in config.estimate if "." not in name]
    if layout not in LAYOUTS:
        raise UserError(f"layout is {layout!r}, but must be one of {', '.join(LAYOUTS)}")
    places = {name: place for name, place in LAYOUTS[layout].items() if name in estimated}
    for entry in mapping:
        name, equals, place = (part.strip() for part in entry.partition("="))
        if not equals:
            raise UserError(f"mapping: {entry!r} must be NAME=PARAMETER, such as X_u=damping.x")
        if name not in estimated:
            raise UserError(f"mapping: {name} is not estimated: use {', '.join(estimated)}")
        places[name] = place
    if not places and not LAYOUTS[layout]:
        if template.count("{name}") != 1:
            raise UserError(f"parameter is {template!r}, but must have {{name}} in it once")
        places = {name: template.replace("{name}", name) for name in estimated}
    found = tuple(_target(name, place) for name, place in places.items())
    taken = [(target.parameter, target.index) for target in found]
    whole = {parameter for parameter, index in taken if index is None}
    for target in found:
        twice = taken.count((target.parameter, target.index)) > 1
        if twice or (target.index is not None and target.parameter in whole):
            raise UserError(f"{target.parameter} would be given more than one coefficient")
    if not found:
        raise UserError("none of the estimated coefficients has a place in the controller")
    return found


def _target(name: str, place: str) -> Target:
    match = _PLACE.fullmatch(place)
    if match is None:
        raise UserError(
            f"{place!r}, for {name}, is no place of a parameter: use hydrodynamics.x, "
            "-hydrodynamics.x or hydrodynamics.x[0]"
        )
    index = match["index"]
    return Target(
        name,
        match["parameter"],
        None if index is None else int(index),
        -1.0 if match["sign"] else 1.0,
    )


def read(targets: Iterable[Target], parameters: Values) -> dict[str, float]:
    """The coefficients that a controller has.

    Raises
    ------
    UserError
        If a parameter is a list where a number is expected, or the other way round, or too short,
        or not finite.
    """
    held = {}
    for target in targets:
        value = parameters[target.parameter]
        if isinstance(value, tuple) != (target.index is not None):
            kind = "a list: say which element, as in" if isinstance(value, tuple) else "no list:"
            shown = f"{target.parameter}[0]" if isinstance(value, tuple) else target.parameter
            raise UserError(f"{target.parameter} of the controller is {kind} {shown}")
        if isinstance(value, tuple):
            assert target.index is not None
            if target.index >= len(value):
                raise UserError(
                    f"{target.parameter} of the controller has {len(value)} elements, "
                    f"{target.coefficient} would be number {target.index}, counted from 0"
                )
            value = value[target.index]
        if not math.isfinite(value):
            raise UserError(f"{target.parameter} of the controller is not finite")
        held[target.coefficient] = target.sign * value
    return held


def write(
    targets: Iterable[Target], parameters: Values, coefficients: Mapping[str, float]
) -> dict[str, Value]:
    """The parameters with these coefficients in them; what they do not touch is left out."""
    changed: dict[str, Value] = {}
    for target in targets:
        if target.coefficient not in coefficients:
            continue
        value = target.sign * coefficients[target.coefficient]
        if target.index is None:
            changed[target.parameter] = value
            continue
        whole = changed.get(target.parameter, parameters[target.parameter])
        assert isinstance(whole, tuple)
        changed[target.parameter] = (*whole[: target.index], value, *whole[target.index + 1 :])
    return changed


def changes(
    held: Mapping[str, float],
    wanted: Mapping[str, float],
    std: Mapping[str, float],
    band_std: float,
    band_percent: float,
) -> Sequence[Change]:
    """All that differs, if any of it by more than the dead band; otherwise nothing.

    The dead band is the larger of ``band_std`` standard deviations and ``band_percent`` of what
    the controller has. All or nothing, for a set is physical as a whole.
    """
    differing = [
        Change(name, held[name], wanted[name], std[name])
        for name in wanted
        if wanted[name] != held[name]
    ]
    for change in differing:
        band = max(band_std * change.std, 0.01 * band_percent * abs(change.held))
        if abs(change.wanted - change.held) > band:
            return differing
    return []
