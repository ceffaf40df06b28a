"""The configuration as ROS 2 parameters: declared, described, changed while running."""

import contextlib
import sys
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterAlreadyDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from rov_ident import config
from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.effects import EFFECTS
from rov_ident.model import coefficients

Settings = TypeVar("Settings")

_LARGEST_INTEGER = 2**31 - 1
_DECLARED = {p.key: p for p in config.VEHICLE_PARAMETERS + config.PARAMETERS}


def declare(node: Node, own: Iterable[str] = ()) -> Config:
    """Check what the node was started with, and declare every parameter with its description.

    The node declares its overrides by itself, so that names that nobody knows are seen and
    refused. Those called in ``own`` are the node's and are left alone.

    Raises UserError, one sentence naming the key and what to change.
    """
    given = {
        name: parameter.value
        for name, parameter in node.get_parameters_by_prefix("").items()
        if name not in own
    }
    if not any(name.startswith(("vehicle", "coefficients")) for name in given):
        for option, path in pairwise(sys.argv):
            if option == "--params-file":
                raise UserError(
                    f"{path} has no section for {node.get_fully_qualified_name()}: call its "
                    "section /**:, which is for every node"
                )
        raise UserError(
            "no configuration was given: add --ros-args --params-file FILE "
            "(`rov-ident init --out FILE` writes one)"
        )
    checked = config.from_parameters(given)
    for key, declared in _DECLARED.items():
        value = given.pop(key, declared.default)
        _redeclare(node, key, _as_declared(declared.type, value), _descriptor(declared))
    for key, value in given.items():
        description = _open_description(key)
        if description:
            _redeclare(node, key, float(value), _descriptor_of(description, read_only=True))
    return checked


def changed(node: Node, changes: Iterable[RosParameter] = ()) -> Config:
    """The configuration of the node's parameters with these changes; raises as above."""
    values = {name: p.value for name, p in node.get_parameters_by_prefix("").items()}
    values.update({change.name: change.value for change in changes})
    return config.from_parameters({name: v for name, v in values.items() if v not in (None, [])})


def declare_own(node: Node, declared: Iterable[config.Parameter]) -> dict[str, Any]:
    """Declare parameters that are a node's own; their values, checked.

    Raises UserError, one sentence naming the parameter and what to change.
    """
    values = {}
    for parameter in declared:
        # Nodes that declare their overrides automatically have it already.
        with contextlib.suppress(ParameterAlreadyDeclaredException):
            node.declare_parameter(parameter.key, None, ParameterDescriptor(dynamic_typing=True))
        given = node.get_parameter(parameter.key).value
        value = config.checked(parameter, parameter.default if given is None else given)
        shown = _as_declared(parameter.type, value)
        _redeclare(node, parameter.key, shown, _descriptor(parameter))
        values[parameter.key] = value
    return values


def own(
    node: Node, declared: Iterable[config.Parameter], changes: Iterable[RosParameter] = ()
) -> dict[str, Any]:
    """The values of a node's own parameters with these changes; raises as above."""
    new = {change.name: change.value for change in changes}
    return {
        p.key: config.checked(p, new.get(p.key, node.get_parameter(p.key).value)) for p in declared
    }


def follow(
    node: Node, read: Callable[[Iterable[RosParameter]], Settings], take: Callable[[Settings], None]
) -> None:
    """Have parameters changed while running: ``read`` gives the settings with these changes, or
    raises UserError, which refuses them; ``take`` is given what was accepted."""

    def check(changes: list[RosParameter]) -> SetParametersResult:
        try:
            read(changes)
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(lambda _: take(read(())))


def _redeclare(node: Node, key: str, value: Any, descriptor: ParameterDescriptor) -> None:
    if node.has_parameter(key):
        node.undeclare_parameter(key)
    node.declare_parameter(key, value, descriptor, ignore_override=True)


def _as_declared(kind: Any, value: Any) -> Any:
    """A value in its declared type: the file may have 5 for 5.0."""
    if value is None:
        return None
    if kind is config.Vector:
        return [float(item) for item in value]
    return list(value) if kind is config.Names else kind(value)


def _descriptor(parameter: config.Parameter) -> ParameterDescriptor:
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    descriptor = _descriptor_of(parameter.description + unit, not parameter.live)
    descriptor.additional_constraints = ", ".join(parameter.choices)
    low, high = parameter.lower, parameter.upper
    if parameter.type is float:
        low, high = max(low, -config.LARGEST), min(high, config.LARGEST)
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif parameter.type is int:
        low, high = max(low, -_LARGEST_INTEGER), min(high, _LARGEST_INTEGER)
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor


def _descriptor_of(description: str, read_only: bool) -> ParameterDescriptor:
    # Typed dynamically: `ros2 param set ... rls.gate 5` sends a whole number.
    return ParameterDescriptor(description=description, read_only=read_only, dynamic_typing=True)


def _open_description(key: str) -> str:
    """What a key of an open section means; empty where it is one of ROS's own."""
    section, _, name = key.partition(".")
    if section == "coefficients":
        coefficient = coefficients.parse(name)
        return f"{coefficient.meaning} [{coefficient.unit}]"
    if section == "prior":
        return f"prior standard deviation of {key.rpartition('.')[2]}"
    if section == "effects":
        effect, _, parameter = name.partition(".")
        return next(p.meaning for p in EFFECTS[effect].parameters if p.name == parameter)
    return ""
