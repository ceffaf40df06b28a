"""Models into the files of controllers and simulators, and back."""

import io
import xml.etree.ElementTree as ET
from contextlib import suppress
from pathlib import Path

from rov_ident.config import Config, from_parameters
from rov_ident.consumer.formats import auv_controllers, gazebo, mss, urdf
from rov_ident.consumer.formats.base import Written
from rov_ident.core.errors import UserError
from rov_ident.core.files import read_input

WRITERS = {"auv_controllers": auv_controllers, "gazebo": gazebo, "mss": mss}
READERS = {"auv_controllers": auv_controllers, "gazebo": gazebo}
"""Those with a ``read`` of their own; a URDF needs what else is known as well."""

_LARGEST = 1 << 24  # bytes; a model without meshes has a thousandth

__all__ = ["READERS", "WRITERS", "export", "holds_hydrodynamics", "import_model", "is_urdf"]


def export(config: Config, name: str) -> Written:
    """The configuration in the format called ``name`` (:data:`WRITERS`)."""
    return WRITERS[name].write(config)


def import_model(path: str | Path, base: Config | None = None) -> tuple[Config, tuple[str, ...]]:
    """A configuration from a file of another program, and what had to be assumed.

    SDFormat and URDF are told from YAML by their first character, and from each other by the name
    of their root. ``base`` is what a URDF does not hold.

    Raises UserError if the file cannot be read, or what it says is not a vehicle.
    """
    path = Path(path)
    text = _text(path)
    if base is not None and not _is_urdf(text):
        raise UserError(f"{path} is no URDF: --config adds to a URDF alone")
    try:
        if _is_urdf(text):
            parameters, notes = urdf.read(text, base)
        else:
            is_xml = text.lstrip().startswith("<")
            parameters, notes = READERS["gazebo" if is_xml else "auv_controllers"].read(text)
        return from_parameters(parameters), notes
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def is_urdf(path: Path) -> bool:
    """Whether the file is a URDF, which need not be a whole vehicle. Raises UserError as above."""
    return _is_urdf(_text(path))


def holds_hydrodynamics(path: Path) -> bool:
    """Whether a URDF says the coefficients. Raises UserError as above."""
    try:
        return urdf.holds_hydrodynamics(_text(path))
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _text(path: Path) -> str:
    try:
        return read_input(path, _LARGEST).decode("utf-8-sig")  # some editors begin with its mark
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not a text file: {error}") from error


def _is_urdf(text: str) -> bool:
    """By the name of its root, up to which it is read: <robot may stand anywhere in an SDF file."""
    with suppress(ET.ParseError):
        for _, root in ET.iterparse(io.StringIO(text), ["start"]):  # nosec B314
            return root.tag == "robot"
    return False
