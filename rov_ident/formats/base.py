"""What the files of other programs can hold of a model, and what they cannot.

A format is a module with ``write(config) -> Written`` and, where it can be read, ``read(text) ->
Read``. Nothing is dropped silently: what a format has no place for is named in ``lost``, and what
had to be assumed on reading in ``notes``.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rov_ident.coefficients import AXES, VELOCITIES, Coefficient
from rov_ident.config import Config, Thrusters
from rov_ident.effects import EFFECTS

DIAGONAL = {
    "added_mass": tuple(f"{a}_{b}dot" for a, b in zip(AXES, VELOCITIES, strict=True)),
    "linear": tuple(f"{a}_{b}" for a, b in zip(AXES, VELOCITIES, strict=True)),
    "quadratic": tuple(f"{a}_{b}{b}" for a, b in zip(AXES, VELOCITIES, strict=True)),
}
"""The eighteen coefficients of a diagonal model, each kind in the order X Y Z K M N."""


@dataclass(frozen=True)
class Written:
    """A file's content, and in words what the configuration says that it cannot."""

    content: str
    lost: tuple[str, ...] = ()


class Read(NamedTuple):
    """Parameters as :func:`rov_ident.config.from_parameters` takes them, and what was assumed."""

    parameters: Mapping[str, Any]
    notes: tuple[str, ...] = ()


def values_of(config: Config) -> dict[str, float]:
    """Coefficient values by name."""
    return dict(zip(config.model.names, config.model.theta.tolist(), strict=True))


def diagonal(values: Mapping[str, float], kind: str) -> list[float]:
    """Six numbers of one kind of :data:`DIAGONAL`, zero where the model has no such term."""
    return [values.get(name, 0.0) for name in DIAGONAL[kind]]


def lost_terms(coefficients: Iterable[Coefficient], held: Iterable[str]) -> list[str]:
    """One sentence naming the coefficients outside ``held``, if any."""
    held = set(held)
    names = [c.name for c in coefficients if c.name not in held]
    return [f"the coefficients {', '.join(names)} have no place in it"] if names else []


def lost_besides(config: Config, held: Iterable[str] = ()) -> list[str]:
    """What else no format has a place for: the coefficients of fins; the effects that act outside
    the rigid body and are not in ``held``; where sensors and thrusters sit."""
    held = set(held)
    mounted = {
        "odometry.position": np.any(config.odometry.position),
        "imu.position": np.any(config.imu.position),
        "imu.rotation": np.any(config.imu.rotation),
        "thrusters": config.thrusters != Thrusters(),
    }
    kinds = {
        "coefficients of fins": list(config.model.fins),
        "effects": [
            name for name in config.effects if EFFECTS[name].body is None and name not in held
        ],
        "settings": [name for name, there in mounted.items() if there],
    }
    return [
        f"the {kind} {', '.join(names)} have no place in it"
        for kind, names in kinds.items()
        if names
    ]


def not_zero(names: Iterable[str], numbers: Iterable[float]) -> dict[str, float]:
    """The named numbers that are not zero: a name left out is not in the model."""
    return {name: float(x) for name, x in zip(names, numbers, strict=True) if x != 0.0}


def plain(vector: Any) -> list[float]:
    """A list of floats, without negative zeros."""
    return [float(x) for x in np.asarray(vector, dtype=float) + 0.0]
