"""The ``<hydrodynamics>`` of a robot description, as auv_controllers 0.1.0 and later read it.

The reader is `parse_model_from_xml` of the library `hydrodynamics`. Body axes are
forward-starboard-down. Its model is diagonal, with SNAME signs, and its inertia is about the body
origin. Of products of inertia it fills only one side of the tensor, so none are written. It makes
the weight of the mass, with 9.81 m/s2.

Before 0.1.0 the same numbers were the ROS 2 parameters `hydrodynamics.*`, which are still read.
"""

import xml.etree.ElementTree as ET

import numpy as np

from rov_ident.config import Config
from rov_ident.config.writing import vehicle_section
from rov_ident.consumer.formats.base import (
    Read,
    Written,
    diagonal,
    finite,
    lost_besides,
    lost_terms,
    plain,
    xml_root,
)
from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array
from rov_ident.core.yaml_file import parse
from rov_ident.model.coefficients import DIAGONAL
from rov_ident.model.equations import GRAVITY, RigidBody

PARAMETERS = {
    "added_mass": DIAGONAL["added_mass"],
    "linear_damping": DIAGONAL["linear"],
    "quadratic_damping": DIAGONAL["quadratic"],
}
"""Which coefficients the six numbers of a parameter are."""

_TAGS = {
    "inertial/added_mass": ("added_mass", ("Xdu", "Ydv", "Zdw", "Kdp", "Mdq", "Ndr")),
    "damping/linear": ("linear", ("Xu", "Yv", "Zw", "Kp", "Mq", "Nr")),
    "damping/quadratic": ("quadratic", ("Xuu", "Yvv", "Zww", "Kpp", "Mqq", "Nrr")),
}
"""The kind of each element's coefficients, and its attributes in their order."""

_LENGTHS = {
    **dict.fromkeys(("mass", "weight", "buoyancy"), 1),
    **dict.fromkeys(("moments_of_inertia", "center_of_buoyancy", "center_of_gravity"), 3),
    **dict.fromkeys(PARAMETERS, 6),
}


def write(config: Config) -> Written:
    """A robot with nothing but its ``<hydrodynamics>``, to be included in a description."""
    model, body = config.model, config.dynamics.body
    weight = GRAVITY * body.mass  # the library's own 9.81 m/s2
    lost = lost_terms(model.coefficients, sum(DIAGONAL.values(), ()))
    lost += lost_besides(config)
    # The net force is what floats or sinks the vehicle: it is kept where the weight cannot be.
    buoyancy = body.buoyancy + (weight - body.weight)
    if abs(weight - body.weight) > 1e-9 * body.weight:
        lost.append(
            f"a weight of {body.weight:g} N (it takes mass times {GRAVITY} m/s2, {weight:g} N): "
            "the buoyancy is changed by the same amount"
        )
    about_origin = body.mass_matrix[3:, 3:]
    if np.any(about_origin - np.diag(np.diag(about_origin))):
        lost.append("the products of inertia about the origin have no place in it")

    robot = ET.Element("robot", name=config.name)
    root = ET.SubElement(robot, "hydrodynamics")
    _put(root, "inertial/mass", value=body.mass)
    _put(root, "inertial/inertia", **dict(zip(("ixx", "iyy", "izz"), np.diag(about_origin))))
    _put(root, "inertial/center_of_gravity", **dict(zip("xyz", body.cog)))
    for path, (kind, keys) in _TAGS.items():
        _put(root, path, **dict(zip(keys, diagonal(model.values, kind))))
    _put(root, "hydrostatics/buoyancy", value=buoyancy)
    _put(root, "hydrostatics/center_of_buoyancy", **dict(zip("xyz", body.cob)))
    ET.indent(robot)
    text = ET.tostring(robot, encoding="unicode")
    return Written(f'<?xml version="1.0"?>\n{text}\n', tuple(lost))


def _put(root: ET.Element, path: str, **numbers: float) -> None:
    group, tag = path.split("/")
    parent = root.find(group)
    if parent is None:
        parent = ET.SubElement(root, group)
    values = plain(list(numbers.values()))
    ET.SubElement(parent, tag, {k: repr(x) for k, x in zip(numbers, values, strict=True)})


def read(text: str) -> Read:
    """The ``<hydrodynamics>`` of a robot, or the first such section of an old parameter file.

    Raises UserError if there is none, or a number of it is missing or is none.
    """
    if text.lstrip().startswith("<"):
        robot = xml_root(text, "URDF")
        block = robot.find("hydrodynamics")
        if block is None:
            raise UserError("has no <hydrodynamics>: give the robot description that has it")
        body, coefficients = model_of(block)
        name = robot.get("name") or "vehicle"
    else:
        body, coefficients = _from_parameters(text)
        name = "vehicle"
    return Read({"vehicle": vehicle_section(name, body), "coefficients": coefficients})


def model_of(block: ET.Element) -> tuple[RigidBody, dict[str, float]]:
    """Rigid body and coefficients of a ``<hydrodynamics>``.

    Raises UserError if an element or attribute that its library requires is missing.
    """
    coefficients: dict[str, float] = {}
    for path, (kind, keys) in _TAGS.items():
        numbers = _attributes(block, path, keys)
        coefficients |= dict(zip(DIAGONAL[kind], numbers.tolist(), strict=True))
    (mass,) = _attributes(block, "inertial/mass", ("value",))
    (buoyancy,) = _attributes(block, "hydrostatics/buoyancy", ("value",))
    cog = _attributes(block, "inertial/center_of_gravity", "xyz", required=False)
    cob = _attributes(block, "hydrostatics/center_of_buoyancy", "xyz", required=False)
    tensor = np.diag(_attributes(block, "inertial/inertia", ("ixx", "iyy", "izz")))
    products = _attributes(block, "inertial/inertia", ("ixy", "ixz", "iyz"), required=False)
    for (i, j), product in zip(((0, 1), (0, 2), (1, 2)), products, strict=True):
        tensor[i, j] = tensor[j, i] = product
    tensor -= float(mass) * (cog @ cog * np.eye(3) - np.outer(cog, cog))
    body = RigidBody(float(mass), GRAVITY * float(mass), float(buoyancy), cog, cob, tensor)
    return body, {name: x for name, x in coefficients.items() if x != 0.0}


def _attributes(
    block: ET.Element, path: str, keys: str | tuple[str, ...], *, required: bool = True
) -> Array:
    """The numbers (n,) of an element's attributes; zero for one that may be left out."""
    element = block.find(path)
    tags = f"<hydrodynamics><{path.replace('/', '><')}>"
    if element is None:
        raise UserError(f"{tags} is missing")
    numbers = []
    for key in keys:
        text = element.get(key)
        if text is None and required:
            raise UserError(f"{tags} has no attribute {key}")
        numbers.append(finite(text or 0.0, f"{tags}: {key}={text!r}")[0])
    return np.array(numbers)


def _from_parameters(text: str) -> tuple[RigidBody, dict[str, float]]:
    """Rigid body and coefficients of the parameters of versions before 0.1.0."""
    section = _find(parse(text))
    if section is None:
        raise UserError("has no section `hydrodynamics`: give a parameter file of auv_controllers")
    if missing := [key for key in _LENGTHS if key not in section]:
        raise UserError(f"hydrodynamics.{missing[0]} is missing")
    numbers = {k: finite(section[k], f"hydrodynamics.{k}", n) for k, n in _LENGTHS.items()}
    (mass,), (weight,), (buoyancy,) = (numbers[k] for k in ("mass", "weight", "buoyancy"))
    cog = numbers["center_of_gravity"]
    moments = numbers["moments_of_inertia"] - mass * (np.dot(cog, cog) - cog**2)
    # a name left out is not in the model
    coefficients = {
        name: float(x)
        for key, names in PARAMETERS.items()
        for name, x in zip(names, numbers[key], strict=True)
        if x != 0.0
    }
    body = RigidBody(
        float(mass), float(weight), float(buoyancy), cog,
        numbers["center_of_buoyancy"], np.diag(moments),
    )  # fmt: skip
    return body, coefficients


def _find(node: object) -> dict[str, object] | None:
    """The first mapping called ``hydrodynamics``, at any depth."""
    if not isinstance(node, dict):
        return None
    inner = node.get("hydrodynamics")
    if isinstance(inner, dict):
        return inner
    return next((found for v in node.values() if (found := _find(v)) is not None), None)
