"""A Gazebo model (SDFormat 1.10, Gazebo Harmonic and later), body axes forward-left-up.

Added mass goes into ``<fluid_added_mass>`` of the link, which DART, the default engine, adds to the
rigid body, Coriolis terms included. The hydrodynamics plugin would take it from the last step's
acceleration, which diverges once it reaches the rigid body's mass (gz-sim issue 1923), and in
gz-sim 7 and 8 its Coriolis terms ``Z_wdot w q`` have the wrong sign. The plugin gets the damping,
whose terms ``c v_j |v_k|`` and ``c v_j v_k`` hold nearly all of our grammar.

Buoyancy is that of the collision shapes (plugin Buoyancy of the world): a box of the right volume
about the centre of buoyancy.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from typing import Any

import numpy as np

from rov_ident.config import Config
from rov_ident.config.writing import vehicle_section
from rov_ident.consumer.formats.base import (
    INERTIA,
    Read,
    Written,
    finite,
    lost_besides,
    plain,
    xml_root,
)
from rov_ident.core.errors import UserError
from rov_ident.core.frames import FLIP_BODY, FLIP_WORLD, quaternion_from_euler, quaternion_to_matrix
from rov_ident.core.messages import Array
from rov_ident.model.coefficients import AXES, EVEN, ONE, PLAIN, VELOCITIES, Coefficient, parse
from rov_ident.model.equations import GRAVITY, RigidBody

DENSITY = 1000.0  # kg/m3, what the Buoyancy plugin assumes unless told otherwise

_FLIP = np.tile(FLIP_BODY, 2)
_ADDED = {
    f"{a}{b}": (i, j) for i, a in enumerate("xyzpqr") for j, b in enumerate("xyzpqr") if i <= j
}
"""The place in the added mass of each element of ``<fluid_added_mass>``."""
_TAG = re.compile(r"([xyzkmn])(?:(Dot)([UVWPQR])|([UVWPQR])(?:(abs)?([UVWPQR]))?)")
_PLUGIN = "gz::sim::systems::Hydrodynamics"


def write(config: Config) -> Written:
    """A model with one link `base_link`; the world needs Gazebo's Buoyancy plugin."""
    body = config.dynamics.body
    # The net force is what floats or sinks the vehicle: it is kept where the weight cannot be.
    beyond_weight = config.gravity * body.mass - body.weight
    lost = _lost(config, beyond_weight)
    sdf = ET.Element("sdf", version="1.10")
    root = ET.SubElement(sdf, "model", name=config.name)
    _add_link(root, config, body.buoyancy + beyond_weight)
    one_sided = _add_plugin(root, config)
    if one_sided:
        lost.append(f"the coefficients {', '.join(one_sided)}: its damping knows no direction")
    ET.indent(sdf)
    head = (
        f"gravity of the world: 0 0 -{config.gravity:g}; its Buoyancy plugin: "
        f"uniform_fluid_density {DENSITY:g}; physics engine: dartsim"
    )
    text = ET.tostring(sdf, encoding="unicode")
    return Written(f'<?xml version="1.0"?>\n<!-- {head} -->\n{text}\n', tuple(lost))


def _lost(config: Config, beyond_weight: float) -> list[str]:
    """What the format has no place for, but for coefficients; ``beyond_weight`` [N] is what mass
    times gravity has beyond the weight."""
    model, body, gravity = config.model, config.dynamics.body, config.gravity
    lost = lost_besides(config, held=("ocean_current",))
    if abs(beyond_weight) > 1e-9 * body.weight:
        lost.append(
            f"a weight of {body.weight:g} N (Gazebo takes mass times gravity, "
            f"{gravity * body.mass:g} N): the buoyancy is changed by the same amount"
        )
    if gravity != GRAVITY:
        lost.append(f"a gravity of {gravity:g} m/s2: it belongs to the world, not to the model")
    if "ocean_current" in config.effects and np.any(model.added_mass):
        lost.append(
            "what ocean_current does to the added mass: in Gazebo it changes the damping alone"
        )
    return lost


def _add_link(root: ET.Element, config: Config, buoyancy: float) -> None:
    """Inertia, added mass, and a box that displaces the water of this buoyancy [N]."""
    model, body = config.model, config.dynamics.body
    link = ET.SubElement(root, "link", name="base_link")
    inertial = ET.SubElement(link, "inertial")
    _text(inertial, "pose", *(FLIP_BODY * body.cog), 0.0, 0.0, 0.0)
    _text(inertial, "mass", body.mass)
    tensor = body.inertia * np.outer(FLIP_BODY, FLIP_BODY)
    inertia = ET.SubElement(inertial, "inertia")
    for tag, place in INERTIA.items():
        _text(inertia, tag, tensor[place])
    water = model.added_mass * np.outer(_FLIP, _FLIP)
    added = ET.SubElement(inertial, "fluid_added_mass")
    for tag, place in _ADDED.items():
        _text(added, tag, water[place])
    collision = ET.SubElement(link, "collision", name="displaced_water")
    _text(collision, "pose", *(FLIP_BODY * body.cob), 0.0, 0.0, 0.0)
    box = ET.SubElement(ET.SubElement(collision, "geometry"), "box")
    edge = float(np.cbrt(buoyancy / (DENSITY * config.gravity)))
    _text(box, "size", edge, edge, edge)


def _add_plugin(root: ET.Element, config: Config) -> list[str]:
    """The damping and the current. Returns the coefficients for which there is no place."""
    plugin = ET.SubElement(root, "plugin", filename="gz-sim-hydrodynamics-system", name=_PLUGIN)
    ET.SubElement(plugin, "link_name").text = "base_link"
    ET.SubElement(plugin, "disable_added_mass").text = "true"
    ET.SubElement(plugin, "disable_coriolis").text = "true"
    if current := config.effects.get("ocean_current"):
        ned = np.array([current[axis] for axis in ("north", "east", "down")])
        _text(plugin, "default_current", *(FLIP_WORLD @ ned))
    values, one_sided = config.model.values, []
    for c in config.model.coefficients:
        if c.is_one_sided:
            one_sided.append(c.name)
        elif not (c.is_added_mass or c.inputs):
            tag, sign = _damping_tag(c)
            _text(plugin, tag, sign * values[c.name])
    return one_sided


def _damping_tag(c: Coefficient) -> tuple[str, float]:
    """The plugin's tag of a damping term, and the sign that turns FRD into FLU."""
    axis = "xyzkmn"[c.row]
    b = VELOCITIES[c.velocity].upper()
    sign = _FLIP[c.row] * _FLIP[c.velocity]
    if c.left == ONE:
        return axis + b, sign
    other = (c.left - PLAIN) % 6
    if c.left < PLAIN + 6:
        return axis + VELOCITIES[other].upper() + b, sign * _FLIP[other]
    return f"{axis}{b}abs{VELOCITIES[other].upper()}", sign


def _text(parent: ET.Element, tag: str, *numbers: float) -> None:
    ET.SubElement(parent, tag).text = " ".join(map(repr, plain(numbers)))


def read(text: str) -> Read:
    """The model that has the hydrodynamics plugin, in a model or world file.

    Raises UserError if the file is not SDFormat, has no such plugin, or its link lacks mass or
    inertia.
    """
    root = xml_root(text, "SDFormat file")
    for model in root.iter("model"):
        for plugin in model.findall("plugin"):
            if is_hydrodynamics(plugin):
                return _read(root, model, plugin)
    raise UserError(
        "has no model with the plugin gz::sim::systems::Hydrodynamics: give the file that has it"
    )


def _read(root: ET.Element, model: ET.Element, plugin: ET.Element) -> Read:
    notes: list[str] = []
    name = (plugin.findtext("link_name") or "").strip()
    links = {link.get("name"): link for link in model.findall("link")}
    if name not in links:
        raise UserError(f"its hydrodynamics plugin acts on the link {name!r}, which is not there")
    if len(links) > 1:
        rest = sum(_numbers(x, "inertial/mass", [0.0])[0] for n, x in links.items() if n != name)
        notes.append(
            f"the other {len(links) - 1} links ({rest:g} kg) are not part of the body: add their "
            "mass and inertia if they move with it"
        )
    link = links[name]
    gravity = float(np.linalg.norm(_numbers(root, "world/gravity", [0.0, 0.0, -GRAVITY])))
    mass = _numbers(link, "inertial/mass")[0]
    cog, turn = _pose(link.find("inertial"), name)
    tensor = np.zeros((3, 3))
    for tag, (i, j) in INERTIA.items():
        default = None if i == j else [0.0]
        tensor[i, j] = tensor[j, i] = _numbers(link, f"inertial/inertia/{tag}", default)[0]
    tensor = (turn @ tensor @ turn.T) * np.outer(FLIP_BODY, FLIP_BODY)

    volume, centre, others = _displaced(link, name)
    if not volume:
        notes.append(
            "no collision box, sphere or cylinder tells the buoyancy: the vehicle is taken as "
            "neutral, with the centre of buoyancy at the body origin"
        )
    elif others:
        notes.append(
            f"the volume of {', '.join(others)} is left out of the buoyancy: it is no box, sphere "
            "or cylinder; set vehicle.buoyancy and vehicle.cob"
        )
    graded = _numbers(root, ".//graded_buoyancy/default_density", [DENSITY])
    density = _numbers(root, ".//uniform_fluid_density", graded)[0]
    told = of_plugin(plugin, notes)
    told["coefficients"] |= _fluid_added_mass(link)
    buoyancy = density * gravity * volume if volume else mass * gravity
    body = RigidBody(mass, mass * gravity, buoyancy, FLIP_BODY * cog, FLIP_BODY * centre, tensor)
    vehicle = vehicle_section(model.get("name") or "vehicle", body)
    return Read({"vehicle": vehicle, **told}, tuple(notes))


def is_hydrodynamics(plugin: ET.Element) -> bool:
    """Whether it gives a hull its forces."""
    return "hydrodynamics" in f"{plugin.get('name')} {plugin.get('filename')}".lower()


def of_plugin(plugin: ET.Element, notes: list[str]) -> dict[str, dict[str, Any]]:
    """What the hydrodynamics plugin says of `coefficients` and, where there is a current, of
    `effects`."""
    coefficients = _damping(plugin, notes)
    if (plugin.findtext("disable_added_mass") or "").strip() in ("true", "1"):
        coefficients = {n: x for n, x in coefficients.items() if not parse(n).is_added_mass}
    current = FLIP_WORLD @ _numbers(plugin, "default_current", [0.0, 0.0, 0.0])
    if not np.any(current):
        return {"coefficients": coefficients}
    ned = dict(zip(("north", "east", "down"), plain(current)))
    return {"coefficients": coefficients, "effects": {"ocean_current": ned}}


def _damping(plugin: ET.Element, notes: list[str]) -> dict[str, float]:
    """Damping and, in old files, added mass of the plugin, forward-starboard-down."""
    found: dict[tuple[int, ...], tuple[str, float]] = {}
    for element in plugin:
        match = _TAG.fullmatch(element.tag)
        if not match:
            continue
        value = _numbers(plugin, element.tag)[0]
        axis, b, c = match[1].upper(), (match[3] or match[4]).lower(), (match[6] or "").lower()
        name, turned = f"{axis}_{b}{c}", b
        if match[2]:
            name += "dot"
        elif match[5] and b != c:
            name = f"{axis}_{b}_abs_{c}"
        elif match[5] and name in EVEN:
            notes.append(f"<{element.tag}> is left out: symmetry makes it even ({name})")
            continue
        elif b == c and not match[5] and name not in EVEN:
            notes.append(f"<{element.tag}> is taken as <{match[1]}{match[4]}abs{match[6]}>")
        elif not match[5]:
            turned = b + c
        sign = _FLIP[AXES.index(axis)] * np.prod([_FLIP[VELOCITIES.index(x)] for x in turned])
        if value:
            known, sum_ = found.get(parse(name).place, (name, 0.0))
            found[parse(name).place] = (known, float(sum_ + sign * value))
    coefficients = dict(found.values())
    added = {n: x for n, x in coefficients.items() if parse(n).is_added_mass}
    if any(x > 0 for n, x in added.items() if parse(n).is_diagonal):
        notes.append("positive added mass (before Gazebo Garden) is taken with the SNAME sign")
        coefficients |= {n: -x for n, x in added.items()}
    return coefficients


def _fluid_added_mass(link: ET.Element) -> dict[str, float]:
    """Added-mass coefficients of ``<fluid_added_mass>``, forward-starboard-down."""
    found = {}
    for tag, (i, j) in _ADDED.items():
        value = _numbers(link, f"inertial/fluid_added_mass/{tag}", [0.0])[0]
        if value:
            found[f"{AXES[i]}_{VELOCITIES[j]}dot"] = -float(value * _FLIP[i] * _FLIP[j])
    return found


def _displaced(link: ET.Element, name: str) -> tuple[float, np.ndarray, list[str]]:
    """Volume [m3] and its centre (3,) [m] of the collision shapes, forward-left-up; and the names
    of those whose volume is not known here."""
    volume, moment, others = 0.0, np.zeros(3), []
    for collision in link.findall("collision"):
        shapes = collision.findall("geometry/*")
        kinds = [kind for kind in shapes if kind.tag in _VOLUMES]
        if not kinds and any(shape.tag not in _FLAT for shape in shapes):
            others.append(f"the collision {collision.get('name', '')} ({shapes[0].tag})")
        shape = sum(_VOLUMES[kind.tag](kind) for kind in kinds[:1])
        volume += shape
        moment += shape * _pose(collision, name)[0]
    return volume, moment / volume if volume else moment, others


def _pose(parent: ET.Element | None, link: str) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and axes (3, 3) of the ``<pose>`` of something in a link, in the link's frame.

    Raises UserError where it is in another frame, or in a notation that SDFormat does not have.
    """
    element = None if parent is None else parent.find("pose")
    if parent is None or element is None:
        return np.zeros(3), np.eye(3)
    frame = element.get("relative_to", "")
    if frame not in ("", "__default__", link):
        raise UserError(
            f"a <pose> of {link!r} is relative to {frame!r}, but is read in the frame of its link "
            "alone: write it so"
        )
    notation = element.get("rotation_format", "euler_rpy")
    if notation == "quat_xyzw":
        x, y, z, *turned = _numbers(parent, "pose", [0.0] * 7)
        length = float(np.linalg.norm(turned))
        if not length:
            raise UserError(f"a <pose> of {link!r} has a quaternion of length 0")
        axes = quaternion_to_matrix(np.array([turned[3], *turned[:3]]) / length)
        return np.array([x, y, z]), axes
    if notation != "euler_rpy":
        raise UserError(f"<pose rotation_format={notation!r}> must be euler_rpy or quat_xyzw")
    x, y, z, *angles = _numbers(parent, "pose", [0.0] * 6)
    if element.get("degrees", "").strip() in ("true", "1"):
        angles = np.radians(angles).tolist()
    return np.array([x, y, z]), quaternion_to_matrix(quaternion_from_euler(*angles))


_FLAT = ("empty", "plane")  # shapes without a volume


_VOLUMES: dict[str, Callable[[ET.Element], float]] = {
    "box": lambda x: float(np.prod(_numbers(x, "size", count=3))),
    "sphere": lambda x: 4.0 / 3.0 * np.pi * _numbers(x, "radius")[0] ** 3,
    "cylinder": lambda x: np.pi * _numbers(x, "radius")[0] ** 2 * _numbers(x, "length")[0],
}


def _numbers(
    parent: ET.Element, path: str, default: Array | list[float] | None = None, count: int = 1
) -> Array:
    """Those in an element: as many as the default, or where there is none, ``count``."""
    text = parent.findtext(path)
    if text is not None:
        tag, count = path.split("/")[-1], count if default is None else len(default)
        return finite(text, f"<{tag}>{text.strip()}</{tag}>", count)
    if default is None:
        raise UserError(f"<{path.replace('/', '><')}> is missing")
    return np.array(default)
