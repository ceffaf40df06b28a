"""Models into the files of controllers and simulators, and back."""

from pathlib import Path

from rov_ident.config import Config, from_parameters
from rov_ident.errors import UserError
from rov_ident.formats import auv_controllers, gazebo, mss
from rov_ident.formats.base import Written

WRITERS = {"auv_controllers": auv_controllers, "gazebo": gazebo, "mss": mss}
READERS = {"auv_controllers": auv_controllers, "gazebo": gazebo}

__all__ = ["READERS", "WRITERS", "export", "import_model"]


def export(config: Config, name: str) -> Written:
    """The configuration in the format called ``name`` (:data:`WRITERS`)."""
    return WRITERS[name].write(config)


def import_model(path: str | Path) -> tuple[Config, tuple[str, ...]]:
    """A configuration from a file of another program, and what had to be assumed.

    SDFormat is told from YAML by its first character.

    Raises
    ------
    UserError
        If the file cannot be read, or what it says is not a vehicle.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    reader = READERS["gazebo" if text.lstrip().startswith("<") else "auv_controllers"]
    try:
        parameters, notes = reader.read(text)
        return from_parameters(parameters), notes
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
