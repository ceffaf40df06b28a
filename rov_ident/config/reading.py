"""From parameter files and ROS parameters to a checked :class:`Config`."""

import contextlib
import dataclasses
import difflib
import math
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rov_ident.config.schema import (
    ANY,
    BY_KEY,
    ESTIMATOR_PARAMETERS,
    LARGEST,
    POSITIVE,
    PULSE_TYPES,
    Config,
    Inputs,
    Names,
    Parameter,
    Thrusters,
    Vector,
    Vehicle,
    VehicleUncertainty,
    missing_inputs,
)
from rov_ident.core.errors import UserError
from rov_ident.core.frames import FLIP_BODY
from rov_ident.core.yaml_file import parse_file
from rov_ident.effects import EFFECTS, Values, estimable
from rov_ident.effects.base import EffectParameter
from rov_ident.model import thruster_allocation as thrusters
from rov_ident.model.coefficients import catalogue, parse
from rov_ident.model.equations import Array, Model, RigidBody, build

# Parameters that ROS itself adds to any node.
_ROS_OWN = {"use_sim_time", "qos_overrides", "start_type_description_service"}

# By section, what is in the axes of `vehicle.frame`.
_VECTORS = {
    "odometry": ("position",),
    "imu": ("position", "rotation"),
    "thrusters": ("position", "direction", "allocation"),
}


def load(
    path: str | os.PathLike[str] | Config, node: str = "", own: Collection[str] = ()
) -> Config:
    """Read a parameter file; a Config is returned as it is.

    The section ``/**`` is taken, overridden by that of ``node`` where there is one; a file without
    either must have a single section. ``own`` are parameters of the node that are not ours.

    Raises UserError: one sentence naming the file, the key and what to change.
    """
    if isinstance(path, Config):
        return path
    if not isinstance(path, str | os.PathLike):
        raise UserError(f"{path!r} is no configuration: give a Config or the path of a file")
    path = Path(path)
    try:
        section = _section(parse_file(path), node)
        for name in own:
            section.pop(name.partition(".")[0], None)
        return from_parameters(section)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def from_parameters(parameters: Mapping[str, Any]) -> Config:
    """The configuration of nested mappings, dotted names, or a mixture of both.

    Raises UserError: one sentence naming the key and what to change.
    """
    values = unflatten(parameters)
    for own in (*_ROS_OWN, *(p.key for p in ESTIMATOR_PARAMETERS)):
        values.pop(own, None)
    for key in ("vehicle", "coefficients"):
        if key not in values:
            raise UserError(f"{key} is missing: a configuration needs vehicle and coefficients")
    vehicle = Vehicle(**_read_section(Vehicle, values.pop("vehicle"), "vehicle."))
    coefficients = _numbers(values.pop("coefficients"), "coefficients")
    settings = _read_section(Config, values, "")
    model = _model(vehicle, coefficients, settings.get("gravity", Config.gravity))
    settings["estimate"], settings["estimate_effects"] = estimated(
        model,
        settings.get("effects", {}),
        settings.get("estimate", ()),
        settings.get("inputs", Inputs()),
    )
    signs = _signs(vehicle.frame)
    for section in _VECTORS.keys() & settings.keys():
        settings[section] = _in_core_axes(settings[section], _VECTORS[section], signs)
    inputs, chosen = settings.get("inputs", Inputs()), settings.get("thrusters", Thrusters())
    signal = thruster_signal(inputs, chosen) if inputs.is_allocated else thrusters.FORCE
    if inputs.is_allocated:
        thrusters.check(chosen, signal)
    if inputs.battery != "none" and (signal == thrusters.FORCE or chosen.curve_pwm):
        raise UserError(
            f"inputs.battery is {inputs.battery}, but only the curve of the T200 depends on it, "
            "from pulses to forces: leave it out"
        )
    if "prior" in settings:
        prior = settings["prior"]
        keys: dict[str, str] = {}
        for key in prior.std:
            name = _name_in_model(model, key, f"prior.std.{key}")
            if other := keys.get(name):
                raise UserError(f"prior.std.{other} and prior.std.{key} are the same: keep one")
            keys[name] = key
        std = {name: prior.std[key] for name, key in keys.items()}
        settings["prior"] = dataclasses.replace(prior, std=std)
    known = {f.name: getattr(vehicle, f.name) for f in dataclasses.fields(VehicleUncertainty)}
    settings["vehicle_uncertainty"] = VehicleUncertainty(**known)
    config = Config(name=vehicle.name, model=model, **settings)
    if np.linalg.eigvalsh(config.dynamics.mass_matrix)[0] <= 0:
        raise UserError("effects.cog_offset makes the mass matrix indefinite: give a smaller one")
    return config


def unflatten(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Nested mappings from dotted names: ``{"rls.gate": 5.0}`` gives ``{"rls": {"gate": 5.0}}``.

    Raises UserError if a name is given twice, or both as a value and as a section.
    """
    nested: dict[str, Any] = {}
    for path, value in leaves(parameters):
        section = nested
        for place, name in enumerate(path[:-1], start=1):
            section = section.setdefault(name, {})
            if not isinstance(section, dict):
                value_name = ".".join(path[:place])
                raise UserError(f"{'.'.join(path)} is given, but {value_name} is a value: keep one")
        if path[-1] in section:
            raise UserError(f"{'.'.join(path)} is given twice: keep one of them")
        section[path[-1]] = value
    return nested


def leaves(parameters: Mapping[str, Any], above: Names = ()) -> Iterator[tuple[Names, Any]]:
    """Every value, and every empty section, with the path of names that leads to it."""
    for name, value in parameters.items():
        path = (*above, *str(name).split("."))
        if isinstance(value, Mapping) and value:
            yield from leaves(value, path)
        else:
            yield path, {} if isinstance(value, Mapping) else value


def _read_section(section: type, values: Any, prefix: str) -> dict[str, Any]:
    """The checked fields of a dataclass from what the file gives for it; defaults are left out."""
    if not isinstance(values, Mapping):
        raise UserError(f"{prefix[:-1]} is {shown(values)}, but must be a section of keys")
    fields = {item.name: item for item in dataclasses.fields(section)}
    if section is Config:  # these are made from `vehicle`, `coefficients` and `estimate`
        for own in ("name", "model", "vehicle_uncertainty", "estimate_effects"):
            del fields[own]
    for name in values:
        if name not in fields:
            others = ["vehicle", "coefficients"] if section is Config else []
            raise UserError(
                f"{prefix}{name} is an unknown key: {suggestion(name, [*fields, *others])}"
            )
    read: dict[str, Any] = {}
    for name, item in fields.items():
        key = prefix + name
        if name not in values:
            if key in BY_KEY and BY_KEY[key].required:
                parameter = BY_KEY[key]
                raise UserError(f"{key} is missing: {parameter.description}, {expected(parameter)}")
        elif key in BY_KEY:
            read[name] = checked(BY_KEY[key], values[name])
        elif key == "prior.std":
            read[name] = _numbers(values[name], key, lower=POSITIVE)
        elif key == "effects":
            read[name] = _effects(values[name])
        else:
            inner: Any = item.type
            read[name] = inner(**_read_section(inner, values[name], f"{key}."))
    return read


def checked(parameter: Parameter, value: Any) -> Any:
    """The value as its declared type, within its bounds."""
    key, kind = parameter.key, parameter.type
    wanted = expected(parameter)
    refusal = UserError(f"{key} is {shown(value)}, but must be {wanted}")
    if kind in (str, bool):
        if not isinstance(value, kind) or (parameter.choices and value not in parameter.choices):
            raise refusal
        return value
    if kind in (Vector, Names):
        # ROS hands arrays over as array.array or ndarray.
        if not isinstance(value, Iterable) or isinstance(value, str | Mapping):
            raise refusal
        items = tuple(value)
        if kind is Names:
            if not all(isinstance(item, str) for item in items):
                raise refusal
            return items
        if parameter.size not in (ANY, len(items)):
            raise UserError(f"{key} has {len(items)} values, but must be {wanted}")
        return tuple(_bounded(_number(item, key, wanted), key, parameter) for item in items)
    number = _number(value, key, wanted)
    if kind is int and not number.is_integer():
        raise refusal
    return kind(_bounded(number, key, parameter))


def _number(value: Any, key: str, wanted: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{key} is {shown(value)}, but must be {wanted}")
    if not abs(value) <= LARGEST:
        raise UserError(f"{key} is {shown(value)}, but must be finite and of a sensible size")
    return float(value)


def _numbers(values: Any, key: str, lower: float = -math.inf) -> dict[str, float]:
    """An open mapping of names to numbers."""
    if not isinstance(values, Mapping):
        raise UserError(f"{key} is {shown(values)}, but must be a section of names and numbers")
    numbers = {str(n): _number(v, f"{key}.{n}", "a number") for n, v in values.items()}
    for name, number in numbers.items():
        if number < lower:
            raise UserError(f"{key}.{name} is {number}, but must be positive")
    return numbers


def _bounded(number: float, key: str, parameter: Parameter | EffectParameter) -> float:
    lower, upper = parameter.lower, parameter.upper
    if lower <= number <= upper:
        return number
    if math.isfinite(lower) and math.isfinite(upper):
        wanted = f"between {0 if lower == POSITIVE else lower:g} and {upper:g}"
    elif lower == POSITIVE:
        wanted = "positive"
    else:
        wanted = f"at least {lower:g}" if number < lower else f"at most {upper:g}"
    unit = f" {parameter.unit}" if parameter.unit else ""
    raise UserError(f"{key} is {number:g}{unit}, but must be {wanted}")


def _effects(values: Any) -> dict[str, dict[str, float]]:
    """Checked effects, parameters left out at the value where they vanish."""
    if not isinstance(values, Mapping):
        raise UserError(f"effects is {shown(values)}, but must be a section of effects")
    effects = {}
    for name, given in values.items():
        if name not in EFFECTS:
            raise UserError(f"effects.{name} is an unknown effect: {suggestion(name, EFFECTS)}")
        if names := EFFECTS[name].coefficients:
            raise UserError(
                f"effects.{name} is a family of coefficients: put {', '.join(names)}, or some of "
                "them, under coefficients"
            )
        declared = {p.name: p for p in EFFECTS[name].parameters}
        numbers = _numbers(given, f"effects.{name}")
        for parameter, number in numbers.items():
            key = f"effects.{name}.{parameter}"
            if parameter not in declared:
                raise UserError(f"{key} is an unknown key: {suggestion(parameter, declared)}")
            _bounded(number, key, declared[parameter])
        effects[name] = {p.name: numbers.get(p.name, p.null) for p in declared.values()}
    return effects


def _model(vehicle: Vehicle, coefficients: Mapping[str, float], gravity: float) -> Model:
    if not coefficients:
        raise UserError("coefficients is empty: give at least one, such as X_udot or X_u")
    for name in coefficients:
        try:
            parse(name)
        except UserError as error:
            close = difflib.get_close_matches(name, [c.name for c in catalogue()], 1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise UserError(f"coefficients.{name}: {error}{hint}") from error
    signs = _signs(vehicle.frame)
    xx, yy, zz, xy, xz, yz = vehicle.inertia
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) * np.outer(signs, signs)
    if np.linalg.eigvalsh(inertia)[0] <= 0:
        raise UserError(
            f"vehicle.inertia {list(vehicle.inertia)} is not positive definite: "
            "check its values and their order xx yy zz xy xz yz"
        )
    body = RigidBody(
        mass=vehicle.mass,
        weight=gravity * vehicle.mass if vehicle.weight is None else vehicle.weight,
        buoyancy=vehicle.buoyancy,
        cog=signs * vehicle.cog + 0.0,  # + 0.0 turns -0.0 into 0.0
        cob=signs * vehicle.cob + 0.0,
        inertia=inertia + 0.0,
    )
    return build(body, coefficients)


def estimated(
    model: Model, effects: Values, names: Names, inputs: Inputs
) -> tuple[Names, tuple[tuple[str, str], ...]]:
    """What to estimate, in the order of the model and of the effects; no names given: all, but for
    coefficients whose input no joint gives."""
    possible = {f"{e}.{p}": (e, p) for e, values in effects.items() for p in values}
    for name in names:
        effect, _, parameter = name.partition(".")
        if not parameter:
            continue
        if name not in possible:
            raise UserError(f"estimate: {name} is not in effects: {suggestion(name, possible)}")
        if parameter not in estimable(effect):
            raise UserError(f"estimate: {name} cannot be estimated live: leave it out")
    chosen = {_name_in_model(model, n, f"estimate: {n}") for n in names if "." not in n}
    waiting = {c.name: m for c in model.coefficients if (m := missing_inputs(c, inputs))}
    for name in sorted(chosen & waiting.keys()):
        missing = waiting[name][0]
        raise UserError(
            f"estimate: {name} depends on {missing}, which no joint gives: name it in "
            f"inputs.{missing}.joint"
        )
    usual = [
        f"{name}.{p}"
        for name, values in effects.items()
        for p, null in estimable(name).items()
        if null is None or values[p] != null
    ]
    return (
        tuple(n for n in model.names if n in chosen or not (names or n in waiting)),
        tuple(key for name, key in possible.items() if name in (names or usual)),
    )


def thruster_signal(inputs: Inputs, chosen: Thrusters) -> str:
    """What a command is: one of thrusters.SIGNALS."""
    if chosen.signal != "auto":
        return chosen.signal
    return thrusters.PWM if inputs.wrench in PULSE_TYPES else thrusters.FORCE


def _in_core_axes(given: Any, names: Names, signs: Array) -> Any:
    """A section with these vectors, in threes, brought into forward-starboard-down."""
    turned: dict[str, Any] = {}
    for name in names:
        values = np.array(getattr(given, name))
        if len(values) % 3 == 0:  # else refused where it is used
            turned[name] = tuple((np.tile(signs, len(values) // 3) * values + 0.0).tolist())
    return dataclasses.replace(given, **turned)


def _name_in_model(model: Model, name: str, key: str) -> str:
    """The model's own name of a coefficient (N_vdot may be its Y_rdot)."""
    with contextlib.suppress(UserError, KeyError):
        return {c.place: c.name for c in model.coefficients}[parse(name).place]
    raise UserError(f"{key} is not in coefficients: {suggestion(name, model.names)}")


def _signs(frame: str) -> Array:
    """(3,) factors that turn a vector of ``vehicle.frame`` into forward-starboard-down."""
    return FLIP_BODY if frame == "flu" else np.ones(3)


def _section(document: Any, node: str) -> dict[str, Any]:
    """The parameters that the file gives for ``node``."""
    if document is None:
        raise UserError("is empty: give a section /**: with ros__parameters: below it")
    if not isinstance(document, Mapping):
        raise UserError(f"is {shown(document)} at the top, but must begin with /**:")
    sections, names = {}, dict[str, str]()
    for name, content in document.items():
        if isinstance(content, Mapping) and "ros__parameters" in content:
            own = str(name).rpartition("/")[2]
            if own in sections:
                raise UserError(
                    f"has {names[own]} and {name}, of which a node or command takes only one: keep "
                    "a file for each vehicle"
                )
            sections[own], names[own] = content["ros__parameters"], str(name)
    if not sections:
        raise UserError("has no ros__parameters: put /**: and ros__parameters: above the keys")
    chosen = [sections[name] for name in ("**", node) if name in sections]
    if not chosen and len(sections) == 1:
        chosen = list(sections.values())
    if not chosen:
        raise UserError(f"has no section /**: only for {', '.join(sections)}; rename one of them")
    merged: dict[str, Any] = {}
    for parameters in chosen:
        if not isinstance(parameters, Mapping):
            wanted = "must be a section of keys"
            raise UserError(f"ros__parameters is {shown(parameters)}, but {wanted}")
        _merge(merged, unflatten(parameters))
    return merged


def _merge(base: dict[str, Any], over: Mapping[str, Any]) -> None:
    """Put the values of ``over`` into ``base``, section by section."""
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            _merge(base[key], value)
        else:
            base[key] = value


# ------------------------------------------------------------------ words of refusals


def shown(value: Any) -> str:
    """A value as the user wrote it, and what it was read as."""
    if value is None:
        return "empty"
    if isinstance(value, Mapping):
        return "a section of keys"
    kinds = {bool: "true or false", str: "text", int: "a number", float: "a number"}
    text = repr(value)
    text = text if len(text) <= 60 else f"{text[:57]}..."
    return f"{text} ({kinds.get(type(value), 'a list')})"


def expected(parameter: Parameter) -> str:
    if parameter.choices:
        return "one of " + ", ".join(parameter.choices)
    count = "" if parameter.size == ANY else f"{parameter.size} "
    words = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
    words |= {Names: "a list of names", Vector: f"a list of {count}numbers"}
    return words[parameter.type] + (f" ({parameter.unit})" if parameter.unit else "")


def suggestion(name: Any, known: Iterable[str]) -> str:
    known = list(known)
    close = difflib.get_close_matches(str(name), known, 1)
    return f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}"
