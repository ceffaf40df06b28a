"""A URDF: mass, centre of gravity and inertia of the whole tree, and where its sensors sit.

Axes are forward-left-up (REP-103); the body origin is that of `base_link`, or else of the root.
Links are one rigid body, joints that move at their zero. Buoyancy, and without the hydrodynamics
plugin the coefficients, come from another configuration. A ``<hydrodynamics>`` of auv_controllers
has all of these, and is taken instead.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rov_ident.config import Config, to_parameters
from rov_ident.config.writing import vehicle_section
from rov_ident.consumer.formats import auv_controllers
from rov_ident.consumer.formats.base import INERTIA, Read, finite, plain, xml_root
from rov_ident.consumer.formats.gazebo import is_hydrodynamics, of_plugin
from rov_ident.core.errors import UserError
from rov_ident.core.frames import FLIP_BODY, quaternion_from_euler, quaternion_to_matrix
from rov_ident.core.messages import Array
from rov_ident.model.equations import GRAVITY, RigidBody

_IMU = re.compile(r"(?<![a-z])imu|imu(?![a-z])", re.IGNORECASE)  # not as in "simulated"
_VELOCITY = re.compile(r"dvl|velocity", re.IGNORECASE)
_THRUSTER = re.compile(r"thruster|propeller", re.IGNORECASE)


class _Place(NamedTuple):
    """Of a frame in the root: origin (3,) and axes (3, 3)."""

    origin: Array
    axes: Array

    def in_parent_of(self, other: "_Place") -> "_Place":
        """The same pose, relative to ``other``, in the frame that ``other`` is relative to."""
        return _Place(other.origin + other.axes @ self.origin, other.axes @ self.axes)


class _Joint(NamedTuple):
    name: str
    kind: str
    parent: str
    child: str
    place: _Place  # in the parent
    axis: Array  # (3,), in the child


def read(text: str, base: Config | None = None) -> Read:
    """Parameters of the robot; what it does not hold is that of ``base``.

    Raises UserError if it is no URDF, has no mass, or nothing says the coefficients.
    """
    robot = _robot(text)
    joints = [_joint(element) for element in robot.findall("joint")]
    links = {link.get("name", ""): link for link in robot.findall("link")}
    block = robot.find("hydrodynamics")
    # What `export` writes to be included in a robot has no links, so nothing sits anywhere.
    places = _link_poses(list(links), joints) if links or block is None else {}
    notes: list[str] = []
    parameters: dict[str, Any] = to_parameters(base) if base else {}
    if block is not None:
        body, coefficients = auv_controllers.model_of(block)
        if links:
            notes.append(
                "mass, inertia, centres, buoyancy and coefficients are those of its "
                "<hydrodynamics>, whatever its links, plugins and --config say"
            )
        parameters["coefficients"] = coefficients
    else:
        body, told = _of_the_tree(robot, links, joints, places, base, notes)
        if told["coefficients"]:
            parameters["coefficients"] = told["coefficients"]
        if "effects" in told:
            parameters["effects"] = parameters.get("effects", {}) | told["effects"]
    name = base.name if base else robot.get("name") or "vehicle"
    parameters["vehicle"] = parameters.get("vehicle", {}) | vehicle_section(name, body)
    if links:
        _mount(parameters, places, notes)
        _thrusters(parameters, joints, places, notes)
    return Read(parameters, tuple(notes))


def holds_hydrodynamics(text: str) -> bool:
    """Whether the robot has coefficients, in whichever way. Raises UserError as :func:`read`."""
    robot = _robot(text)
    return robot.find("hydrodynamics") is not None or bool(_of_plugin(robot, [])["coefficients"])


def _robot(text: str) -> ET.Element:
    if "${" in text or "<xacro:" in text:
        raise UserError("is a xacro file: expand it first, with `xacro FILE > robot.urdf`")
    return xml_root(text, "URDF")


def _of_plugin(robot: ET.Element, notes: list[str]) -> dict[str, dict[str, Any]]:
    """What Gazebo's hydrodynamics plugin says, the first if there are several."""
    plugins = [plugin for plugin in robot.iter("plugin") if is_hydrodynamics(plugin)]
    return of_plugin(plugins[0], notes) if plugins else {"coefficients": {}}


def _of_the_tree(
    robot: ET.Element,
    links: Mapping[str, ET.Element],
    joints: list[_Joint],
    places: Mapping[str, _Place],
    base: Config | None,
    notes: list[str],
) -> tuple[RigidBody, dict[str, dict[str, Any]]]:
    """The links as one body, and what the hydrodynamics plugin says, if there is one."""
    mass, cog, inertia = _rigid_body(links, places)
    if moving := [j.name for j in joints if j.kind != "fixed" and not _THRUSTER.search(j.name)]:
        notes.append(f"joints that move are taken at their zero: {', '.join(moving)}")

    told = _of_plugin(robot, notes)
    if not told["coefficients"] and base is None:
        raise UserError("holds no hydrodynamics: give --config with the coefficients to start from")
    gravity = base.gravity if base else GRAVITY
    lift, cob = 0.0, FLIP_BODY * cog
    if base:
        body = base.model.body
        lift, cob = body.buoyancy - body.weight, body.cob
        notes.append("net buoyancy and centre of buoyancy are those of the configuration")
    else:
        notes.append("it says nothing of buoyancy: taken as neutral, about the centre of gravity")
    weight, tensor = mass * gravity, np.outer(FLIP_BODY, FLIP_BODY) * inertia
    return RigidBody(mass, weight, weight + lift, FLIP_BODY * cog, cob, tensor), told


def _joint(element: ET.Element) -> _Joint:
    name = element.get("name", "")
    ends = [element.find(tag) for tag in ("parent", "child")]
    if any(end is None or not end.get("link") for end in ends):
        raise UserError(f"the joint {name} lacks a parent or a child link")
    axis = _numbers(element.find("axis"), "xyz", [1.0, 0.0, 0.0])
    parent, child = (str(end.get("link")) for end in ends if end is not None)
    return _Joint(name, element.get("type", ""), parent, child, _pose_of(element), axis)


def _pose_of(element: ET.Element) -> _Place:
    origin = element.find("origin")
    roll, pitch, yaw = _numbers(origin, "rpy", [0.0] * 3)
    axes = quaternion_to_matrix(quaternion_from_euler(roll, pitch, yaw))
    return _Place(_numbers(origin, "xyz", [0.0] * 3), axes)


def _numbers(element: ET.Element | None, name: str, default: list[float]) -> Array:
    """Those of an attribute, or where it or the whole element is not there, the default."""
    text = None if element is None else element.get(name)
    if element is None or text is None:
        return np.array(default)
    return finite(text, f"<{element.tag} {name}={text!r}>", len(default))


def _link_poses(links: list[str], joints: list[_Joint]) -> dict[str, _Place]:
    """Every link in the body frame."""
    above = {joint.child: joint for joint in joints}
    roots = [name for name in links if name not in above]
    if len(roots) != 1:
        raise UserError(f"has {len(roots)} links without a parent, but a robot has one root")
    places = {roots[0]: _Place(np.zeros(3), np.eye(3))}
    waiting = [joint for joint in joints if joint.child in links]
    while waiting:
        ready = [joint for joint in waiting if joint.parent in places]
        if not ready:
            raise UserError(f"the joint {waiting[0].name} hangs on no link of the tree")
        for joint in ready:
            places[joint.child] = joint.place.in_parent_of(places[joint.parent])
        waiting = [joint for joint in waiting if joint not in ready]
    body = places.get("base_link", places[roots[0]])
    back = _Place(-body.axes.T @ body.origin, body.axes.T)
    return {name: place.in_parent_of(back) for name, place in places.items()}


def _rigid_body(
    links: Mapping[str, ET.Element], places: Mapping[str, _Place]
) -> tuple[float, Array, Array]:
    """Mass, centre of gravity (3,) and inertia (3, 3) about it of all links, body axes."""
    parts = []
    for name, link in links.items():
        inertial = link.find("inertial")
        if inertial is None or inertial.find("mass") is None:
            continue
        (mass,) = _numbers(inertial.find("mass"), "value", [0.0])
        own = _pose_of(inertial).in_parent_of(places[name])
        tensor = np.zeros((3, 3))
        for key, (i, j) in INERTIA.items():
            tensor[i, j] = tensor[j, i] = _numbers(inertial.find("inertia"), key, [0.0])[0]
        parts.append((mass, own.origin, own.axes @ tensor @ own.axes.T))
    total = float(sum(mass for mass, _, _ in parts))
    if not total > 0.0:
        raise UserError("no link has a mass: give its <inertial>")
    cog: Array = sum(mass * at for mass, at, _ in parts) / total
    inertia = np.zeros((3, 3))
    for mass, at, tensor in parts:
        d = at - cog
        inertia += tensor + mass * (d @ d * np.eye(3) - np.outer(d, d))
    return total, cog, inertia


def _mount(parameters: dict[str, Any], places: Mapping[str, _Place], notes: list[str]) -> None:
    for section, pattern, turned in (("imu", _IMU, True), ("odometry", _VELOCITY, False)):
        found = [name for name in places if pattern.search(name)]
        if not found:
            continue
        at = places[found[0]]
        parameters[section] = parameters.get(section, {}) | {
            "position": plain(FLIP_BODY * at.origin),
            **({"rotation": plain(FLIP_BODY * _angles(at.axes))} if turned else {}),
        }
        notes.append(f"{section} sits at the link {found[0]}")
        if len(found) > 1:
            notes.append(f"not used: {', '.join(found[1:])}")
    if _VELOCITY.search(" ".join(places)) is None:
        notes.append("no link is called dvl or velocity: odometry.position is left as it was")


def _angles(axes: Array) -> Array:
    """Roll, pitch, yaw (3,) of axes (3, 3)."""
    pitch = np.arctan2(-axes[2, 0], np.hypot(axes[0, 0], axes[1, 0]))
    return np.array([np.arctan2(axes[2, 1], axes[2, 2]), pitch, np.arctan2(axes[1, 0], axes[0, 0])])


def _thrusters(
    parameters: dict[str, Any], joints: list[_Joint], places: Mapping[str, _Place], notes: list[str]
) -> None:
    found = [
        j
        for j in joints
        if j.kind in ("continuous", "revolute") and _THRUSTER.search(f"{j.name} {j.child}")
    ]
    if not found:
        return
    position = [FLIP_BODY * places[j.child].origin for j in found]
    direction = [FLIP_BODY * (places[j.child].axes @ j.axis) for j in found]
    others = {k: v for k, v in parameters.get("thrusters", {}).items() if k != "allocation"}
    mounted = {"position": plain(np.ravel(position)), "direction": plain(np.ravel(direction))}
    parameters["thrusters"] = others | mounted
    notes.append(
        f"thrusters {', '.join(j.name for j in found)} push along the axes of their joints: turn "
        "the sign of those that push the other way"
    )
