"""The `hydrodynamics` parameters of auv_controllers (ROS 2), body axes forward-starboard-down.

Its model (package `hydrodynamics`) is diagonal, with SNAME signs, and its inertia is about the body
origin without the coupling of a centre of gravity off the origin.
"""

import numpy as np
import yaml

from rov_ident.config import Config
from rov_ident.config.writing import vehicle_section
from rov_ident.consumer.formats.base import Read, Written, diagonal, lost_besides, lost_terms, plain
from rov_ident.core.errors import UserError
from rov_ident.core.yaml_file import parse
from rov_ident.model.coefficients import DIAGONAL
from rov_ident.model.equations import RigidBody

PARAMETERS = {
    "added_mass": DIAGONAL["added_mass"],
    "linear_damping": DIAGONAL["linear"],
    "quadratic_damping": DIAGONAL["quadratic"],
}
"""Which coefficients the six numbers of a parameter are."""

_LENGTHS = {
    **dict.fromkeys(("mass", "weight", "buoyancy"), 0),
    **dict.fromkeys(("moments_of_inertia", "center_of_buoyancy", "center_of_gravity"), 3),
    **dict.fromkeys(PARAMETERS, 6),
}


def write(config: Config) -> Written:
    """The parameters, under ``/**`` so that any controller's name takes them."""
    model, body = config.model, config.dynamics.body
    values = model.values
    about_origin = body.mass_matrix[3:, 3:]
    hydrodynamics = {
        "mass": float(body.mass),
        "weight": float(body.weight),
        "buoyancy": float(body.buoyancy),
        "moments_of_inertia": plain(np.diag(about_origin)),
        "added_mass": plain(diagonal(values, "added_mass")),
        "center_of_buoyancy": plain(body.cob),
        "center_of_gravity": plain(body.cog),
        "linear_damping": plain(diagonal(values, "linear")),
        "quadratic_damping": plain(diagonal(values, "quadratic")),
    }
    lost = lost_terms(model.coefficients, sum(DIAGONAL.values(), ()))
    lost += lost_besides(config)
    if np.any(body.cog):
        lost.append(
            f"the centre of gravity {plain(body.cog)} m turns the vehicle by its weight, but its "
            "coupling of linear and angular acceleration has no place in it"
        )
    if np.any(about_origin - np.diag(np.diag(about_origin))):
        lost.append("the products of inertia have no place in it")
    document = {"/**": {"ros__parameters": {"hydrodynamics": hydrodynamics}}}
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)
    return Written(text, tuple(lost))


def read(text: str) -> Read:
    """The first ``hydrodynamics`` section of a parameter file.

    Raises UserError if there is none, or one of its keys is missing or of the wrong length.
    """
    section = _find(parse(text))
    if section is None:
        raise UserError("has no section `hydrodynamics`: give a parameter file of auv_controllers")
    numbers = {key: _numbers(section, key, length) for key, length in _LENGTHS.items()}
    mass, cog = float(numbers["mass"]), numbers["center_of_gravity"]
    moments = numbers["moments_of_inertia"] - mass * (np.dot(cog, cog) - cog**2)
    # a name left out is not in the model
    coefficients = {
        name: float(x)
        for key, names in PARAMETERS.items()
        for name, x in zip(names, numbers[key], strict=True)
        if x != 0.0
    }
    body = RigidBody(
        mass, float(numbers["weight"]), float(numbers["buoyancy"]), cog,
        numbers["center_of_buoyancy"], np.diag(moments),
    )  # fmt: skip
    vehicle = vehicle_section("vehicle", body)
    return Read({"vehicle": vehicle, "coefficients": coefficients})


def _find(node: object) -> dict[str, object] | None:
    """The first mapping called ``hydrodynamics``, at any depth."""
    if not isinstance(node, dict):
        return None
    inner = node.get("hydrodynamics")
    if isinstance(inner, dict):
        return inner
    return next((found for v in node.values() if (found := _find(v)) is not None), None)


def _numbers(section: dict[str, object], key: str, length: int) -> np.ndarray:
    if key not in section:
        raise UserError(f"hydrodynamics.{key} is missing")
    try:
        value = np.array(section[key], dtype=float)
    except (TypeError, ValueError):
        value = np.full(length or (), np.nan)
    if value.shape != ((length,) if length else ()) or not np.isfinite(value).all():
        what = f"{length} numbers" if length else "a number"
        raise UserError(f"hydrodynamics.{key} must be {what}")
    return value
