"""What the files of other programs can hold of a model, and what they cannot.

A format is a module with ``write(config) -> Written`` and, where it can be read, ``read(text) ->
Read``. Nothing is dropped silently: what a format has no place for is named in ``lost``, and what
had to be assumed on reading in ``notes``.
"""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rov_ident.config import Config, Thrusters
from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array
from rov_ident.effects import EFFECTS
from rov_ident.model import equations
from rov_ident.model.coefficients import DIAGONAL, Coefficient

INERTIA = {f"i{name}": place for name, place in equations.INERTIA.items()}
"""The place of each element in the tensor."""


@dataclass(frozen=True)
class Written:
    """A file's content, and in words what the configuration says that it cannot."""

    content: str
    lost: tuple[str, ...] = ()


class Read(NamedTuple):
    """Parameters as `from_parameters` takes them, and what was assumed."""

    parameters: Mapping[str, Any]
    notes: tuple[str, ...] = ()


def finite(given: object, what: str, count: int = 1) -> Array:
    """The numbers (count,) of a text or a list; raises UserError that says so of ``what``."""
    try:
        numbers = np.array(given.split() if isinstance(given, str) else given, dtype=float, ndmin=1)
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise UserError(f"{what} must be {'a number' if count == 1 else f'{count} numbers'}")
    return numbers


def diagonal(values: Mapping[str, float], kind: str) -> list[float]:
    """Six numbers of one kind of DIAGONAL, zero where the model has no such term."""
    return [values.get(name, 0.0) for name in DIAGONAL[kind]]


def lost_terms(coefficients: Iterable[Coefficient], held: Collection[str]) -> list[str]:
    """One sentence naming the coefficients outside ``held``, if any."""
    names = [c.name for c in coefficients if c.name not in held and not c.inputs]
    return [f"the coefficients {', '.join(names)} have no place in it"] if names else []


def lost_besides(config: Config, held: Collection[str] = ()) -> list[str]:
    """What else no format has a place for: the coefficients of fins and propeller; the effects
    that act outside the rigid body and are not in ``held``; where sensors and thrusters sit."""
    mounted = {
        "odometry.position": np.any(config.odometry.position),
        "imu.position": np.any(config.imu.position),
        "imu.rotation": np.any(config.imu.rotation),
        "thrusters": config.thrusters != Thrusters(),
    }
    outside = [name for name in config.effects if EFFECTS[name].body is None and name not in held]
    kinds = {
        "coefficients of fins and propeller": config.model.fins,
        "effects": outside,
        "settings": [name for name, there in mounted.items() if there],
    }
    return [
        f"the {k} {', '.join(names)} have no place in it" for k, names in kinds.items() if names
    ]


def plain(vector: Any) -> list[float]:
    """A list of floats, without negative zeros."""
    return [float(x) for x in np.asarray(vector, dtype=float) + 0.0]


def xml_root(text: str, kind: str) -> ET.Element:
    """The root of an XML file; raises UserError if it is none, or declares entities."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise UserError(f"declares XML entities, which no {kind} needs: remove them")
    try:
        return ET.fromstring(text)  # nosec B314
    except ET.ParseError as error:
        raise UserError(f"is not valid XML: {error}") from error
