"""Where the coefficients are among the parameters of a controller, and when to change them.

No ROS here: a controller's parameters are a mapping of names to numbers or tuples of numbers.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from rov_ident.config import Config
from rov_ident.consumer.formats import auv_controllers
from rov_ident.core.errors import UserError
from rov_ident.reports.result import NORMAL
from rov_ident.reports.table import estimate

Value = float | tuple[float, ...]
Values = Mapping[str, Value]

LAYOUTS: dict[str, dict[str, str]] = {
    "none": {},
    # Of versions before 0.1.0. SNAME signs, each kind in the order X Y Z K M N.
    "auv_controllers": {
        name: f"hydrodynamics.{parameter}[{i}]"
        for parameter, names in auv_controllers.PARAMETERS.items()
        for i, name in enumerate(names)
    },
}
"""Controllers whose parameters are known, by name: the place of each coefficient."""

LAYOUT_NOTES = {
    "auv_controllers": "layout auv_controllers reaches versions of auv_controllers before 0.1.0 "
    "only: later ones have no hydrodynamics parameters, but read <hydrodynamics> of the robot "
    "description when they start (rov-ident export --format auv_controllers writes it)"
}
"""What to say of a layout when it is used."""

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
        wanted = " ± ".join(estimate(self.wanted, NORMAL * self.std))
        return f"{self.coefficient} {self.held:.5g} -> {wanted}"


def targets(
    config: Config, template: str, mapping: Iterable[str] = (), layout: str = "none"
) -> tuple[Target, ...]:
    """Where the estimated coefficients go.

    ``mapping``: entries `NAME=PARAMETER`, `NAME=-PARAMETER` (of the other sign) or
    `NAME=PARAMETER[INDEX]`. What neither these nor the ``layout`` (of :data:`LAYOUTS`) name is not
    sent; without either, ``template`` makes the parameter of each, such as `hydrodynamics.{name}`.

    Raises UserError: one sentence naming the entry and what to change.
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
    index = int(match["index"]) if match["index"] else None
    return Target(name, match["parameter"], index, -1.0 if match["sign"] else 1.0)


def read(targets: Iterable[Target], parameters: Values) -> dict[str, float]:
    """The coefficients that a controller has.

    Raises UserError if a parameter is a list where a number is expected, or the other way round, or
    too short, or not finite.
    """
    held = {}
    for target in targets:
        value, place = parameters[target.parameter], f"{target.parameter} of the controller"
        if isinstance(value, tuple):
            if target.index is None:
                raise UserError(
                    f"{place} is a list: say which element, as in {target.parameter}[0]"
                )
            if target.index >= len(value):
                raise UserError(
                    f"{place} has {len(value)} elements, {target.coefficient} would be number "
                    f"{target.index}, counted from 0"
                )
            value = value[target.index]
        elif target.index is not None:
            raise UserError(f"{place} is no list: {target.parameter}")
        if not math.isfinite(value):
            raise UserError(f"{place} is not finite")
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
    differing = [Change(n, held[n], x, std[n]) for n, x in wanted.items() if x != held[n]]
    beyond = any(
        abs(c.wanted - c.held) > max(band_std * c.std, 0.01 * band_percent * abs(c.held))
        for c in differing
    )
    return differing if beyond else []
