"""The `hydrodynamics` parameters of auv_controllers (ROS 2), body axes forward-starboard-down.

Its model (package `hydrodynamics`) is diagonal, with SNAME signs, and its inertia is about the body
origin without the coupling of a centre of gravity off the origin.
"""

import numpy as np
import yaml

from rov_ident.config import Config
from rov_ident.errors import UserError
from rov_ident.formats.base import (
    DIAGONAL,
    Read,
    Written,
    diagonal,
    lost_besides,
    lost_terms,
    not_zero,
    plain,
    values_of,
)

SUFFIX = ".yaml"

_LENGTHS = {
    "mass": 0,
    "weight": 0,
    "buoyancy": 0,
    "moments_of_inertia": 3,
    "added_mass": 6,
    "center_of_buoyancy": 3,
    "center_of_gravity": 3,
    "linear_damping": 6,
    "quadratic_damping": 6,
}


def write(config: Config) -> Written:
    """The parameters, under ``/**`` so that any controller's name takes them."""
    model, body = config.model, config.dynamics.body
    values = values_of(config)
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

    Raises
    ------
    UserError
        If there is none, or one of its keys is missing or of the wrong length.
    """
    try:
        section = _find(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise UserError(f"is not valid YAML: {str(error).splitlines()[0]}") from error
    if section is None:
        raise UserError("has no section `hydrodynamics`: give a parameter file of auv_controllers")
    numbers = {key: _numbers(section, key, length) for key, length in _LENGTHS.items()}
    mass, cog = float(numbers["mass"]), numbers["center_of_gravity"]
    moments = numbers["moments_of_inertia"] - mass * (np.dot(cog, cog) - cog**2)
    vehicle = {
        "name": "vehicle",
        "frame": "frd",
        "mass": mass,
        "weight": float(numbers["weight"]),
        "buoyancy": float(numbers["buoyancy"]),
        "cog": plain(cog),
        "cob": plain(numbers["center_of_buoyancy"]),
        "inertia": [*plain(moments), 0.0, 0.0, 0.0],
    }
    coefficients = {
        **not_zero(DIAGONAL["added_mass"], numbers["added_mass"]),
        **not_zero(DIAGONAL["linear"], numbers["linear_damping"]),
        **not_zero(DIAGONAL["quadratic"], numbers["quadratic_damping"]),
    }
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
    what = f"{length} numbers" if length else "a number"
    try:
        value = np.array(section[key], dtype=float)
    except (TypeError, ValueError):
        raise UserError(f"hydrodynamics.{key} must be {what}") from None
    if value.shape != ((length,) if length else ()) or not np.isfinite(value).all():
        raise UserError(f"hydrodynamics.{key} must be {what}")
    return value
