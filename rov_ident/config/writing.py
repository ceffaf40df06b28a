"""From a :class:`Config` back to a parameter file."""

import dataclasses
import os
import re
from collections.abc import Mapping
from typing import Any

import yaml

from rov_ident.config.reading import estimated, leaves
from rov_ident.config.schema import PARAMETERS, VEHICLE_PARAMETERS, Config
from rov_ident.core.files import write_file
from rov_ident.core.yaml_file import Dumper
from rov_ident.model.coefficients import DIAGONAL, catalogue, input_catalogue
from rov_ident.model.equations import INERTIA, RigidBody


def to_parameters(config: Config) -> dict[str, Any]:
    """Nested plain values from which :func:`from_parameters` makes the same configuration.

    Settings at their defaults are left out.
    """
    vehicle = vehicle_section(config.name, config.model.body)
    vehicle |= _changed(config.vehicle_uncertainty)
    coefficients = dict(zip(config.model.names, config.model.theta.tolist(), strict=True))
    settings = _changed(config)
    settings.pop("estimate", None)
    if (config.estimate, config.estimate_effects) != estimated(
        config.model, config.effects, (), config.inputs
    ):
        parameters = (f"{effect}.{name}" for effect, name in config.estimate_effects)
        settings["estimate"] = [*config.estimate, *parameters]
    return {"vehicle": vehicle, "coefficients": coefficients, **settings}


def vehicle_section(name: str, body: RigidBody) -> dict[str, Any]:
    """The section `vehicle`, without negative zeros."""
    return {
        "name": name,
        "frame": "frd",
        "mass": float(body.mass),
        "weight": float(body.weight),
        "buoyancy": float(body.buoyancy),
        "cog": (body.cog + 0.0).tolist(),
        "cob": (body.cob + 0.0).tolist(),
        "inertia": [float(body.inertia[at]) + 0.0 for at in INERTIA.values()],
    }


def dump(config: Config, path: str | os.PathLike[str], comment: str = "") -> None:
    """Write a parameter file that :func:`load` reads as the same configuration, to the last bit.

    ``comment`` goes above the parameters. The file appears whole or not at all.

    Raises UserError if the file cannot be written.
    """
    document = {"/**": {"ros__parameters": to_parameters(config)}}
    text = "".join(f"# {line}\n" for line in comment.splitlines())
    text += yaml.dump(document, Dumper=Dumper, sort_keys=False, width=1000)
    write_file(path, text)


def annotated(parameters: Mapping[str, Any], remarks: Mapping[str, str], comment: str = "") -> str:
    """A parameter file in which every option stands with its meaning.

    ``parameters`` are nested plain values; what they lack is commented out at its default, or
    marked UNKNOWN where there is none. ``remarks``, by dotted name, say where a value comes from.
    """
    known = (*catalogue(), *input_catalogue())
    meanings = {c.name: f"{c.unit}: {c.meaning}" for c in known}
    sections: dict[str, dict[str, str]] = {"vehicle": {}, "coefficients": {}}
    given = {".".join(path): value for path, value in leaves(parameters) if value != {}}
    for p in VEHICLE_PARAMETERS + PARAMETERS:
        section, _, name = p.key.rpartition(".")
        value = given.pop(p.key, p.default)
        active = p.required or p.key in remarks or value != p.default
        meaning = (f"{p.unit}: " if p.unit else "") + p.description
        if p.choices and name != "wrench":  # its many types are listed in docs/inputs.md
            meaning += f" ({', '.join(p.choices)})"
        line = _line(name, value, meaning, remarks.get(p.key, ""))
        if p.required and value is None:
            line = _line(name, None, f"UNKNOWN. {meaning}", "")
        sections.setdefault(section, {})[p.key] = line if active else f"# {line}"
    coefficients = [key for key in given if key.startswith("coefficients.")]
    for name in () if coefficients else sum(DIAGONAL.values(), ()):  # where one begins
        sections["coefficients"][name] = _line(name, None, f"UNKNOWN. {meanings[name]}", "")
    for key in coefficients:
        name = key.removeprefix("coefficients.")
        text = _line(name, given.pop(key), meanings.get(name, ""), remarks.get(key, ""))
        sections["coefficients"][key] = text
    for key, value in given.items():  # prior.std, effects: open to names
        section, _, name = key.rpartition(".")
        sections.setdefault(section, {})[key] = _line(name, value, "", remarks.get(key, ""))
    lines = [*(f"# {line}".rstrip() for line in comment.splitlines()), "/**:", "  ros__parameters:"]
    opened: tuple[str, ...] = ()
    active = {
        tuple(section.split("."))[:depth]
        for section, rows in sections.items()
        if any(not row.startswith("#") for row in rows.values())
        for depth in range(1, section.count(".") + 2)
    }
    heads = list(dict.fromkeys(section.partition(".")[0] for section in ("", *sections)))
    for section in sorted(sections, key=lambda name: heads.index(name.partition(".")[0])):
        rows = sorted(sections[section].values(), key=lambda row: row.startswith("#"))
        path = tuple(section.split(".")) if section else ()
        for depth, name in enumerate(path):
            above = path[: depth + 1]
            if above != opened[: depth + 1]:
                lines.append(f"    {'  ' * depth}{'' if above in active else '# '}{name}:")
        lines += [f"    {'  ' * len(path)}{row}" for row in rows]
        opened = path
    return "\n".join(lines) + "\n"


def _line(name: str, value: Any, meaning: str, remark: str) -> str:
    if isinstance(value, tuple):
        value = list(value)
    text = yaml.dump({name: value}, Dumper=Dumper, width=100000).strip()
    text = text.removesuffix(" null")
    words = "; ".join(filter(None, (meaning, f"from {remark}" if remark else "")))
    return f"{text:<40}  # {words}" if words else text


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
