"""From a :class:`Config` back to a parameter file."""

import dataclasses
import os
import re
from collections.abc import Mapping
from typing import Any

import yaml

from rov_ident.config.reading import estimated
from rov_ident.config.schema import Config
from rov_ident.core.files import write_file
from rov_ident.core.yaml_file import Dumper


def to_parameters(config: Config) -> dict[str, Any]:
    """Nested plain values from which :func:`from_parameters` makes the same configuration.

    Settings at their defaults are left out.
    """
    body = config.model.body
    inertia = body.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    vehicle = {
        "name": config.name,
        "frame": "frd",
        "mass": float(body.mass),
        "weight": float(body.weight),
        "buoyancy": float(body.buoyancy),
        "cog": body.cog.tolist(),
        "cob": body.cob.tolist(),
        "inertia": inertia.tolist(),
        **_changed(config.vehicle_uncertainty),
    }
    coefficients = dict(zip(config.model.names, config.model.theta.tolist(), strict=True))
    coefficients |= config.model.fins
    settings = _changed(config)
    settings.pop("estimate", None)
    if (config.estimate, config.estimate_effects) != estimated(config.model, config.effects, ()):
        parameters = (f"{effect}.{name}" for effect, name in config.estimate_effects)
        settings["estimate"] = [*config.estimate, *parameters]
    return {"vehicle": vehicle, "coefficients": coefficients, **settings}


def dump(config: Config, path: str | os.PathLike[str], comment: str = "") -> None:
    """Write a parameter file that :func:`load` reads as the same configuration, to the last bit.

    ``comment`` goes above the parameters. The file appears whole or not at all.

    Raises UserError if the file cannot be written.
    """
    document = {"/**": {"ros__parameters": to_parameters(config)}}
    text = "".join(f"# {line}\n" for line in comment.splitlines())
    text += yaml.dump(document, Dumper=Dumper, sort_keys=False, width=1000)
    write_file(path, text)


def _changed(section: Any) -> dict[str, Any]:
    """What differs from the defaults, as plain values."""
    changed: dict[str, Any] = {}
    for item in dataclasses.fields(section):
        value = getattr(section, item.name)
        if dataclasses.is_dataclass(value):
            if item.default is not dataclasses.MISSING and (inner := _changed(value)):
                changed[item.name] = inner
        elif isinstance(value, Mapping):
            if value:
                changed[item.name] = _plain(value)
        elif item.metadata and value != item.default:
            changed[item.name] = list(value) if isinstance(value, tuple) else value
    return changed


def _plain(value: Any) -> Any:
    """Mappings as dict, numbers as float."""
    if isinstance(value, Mapping):
        return {name: _plain(inner) for name, inner in value.items()}
    return float(value)


def as_file_name(name: str) -> str:
    """A vehicle's name as part of a file's name: nothing that would lead to another folder."""
    return re.sub(r"[^\w.-]", "_", name).lstrip(".") or "vehicle"
