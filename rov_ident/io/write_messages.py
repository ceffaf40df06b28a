"""Messages in memory into a bag, under the names the nodes listen on."""

from collections.abc import Iterable
from pathlib import Path

from rov_ident.config import Config
from rov_ident.core.messages import ODOMETRY, WRENCH, Message
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.cdr import ROLE_TYPES, encode
from rov_ident.io.topics import ROLE_NAMES


def unlike_inputs(config: Config) -> tuple[str, ...]:
    """A note where the configuration says that a bag has other types or topics than the one that is
    written."""
    given, standard = vars(config.inputs), vars(config.inputs.standard)
    keys = [f"inputs.{name}" for name in given if given[name] != standard[name]]
    topics = {"", *(f"/{name}" for name in ROLE_NAMES.values())}
    keys += [f"topics.{k}" for k, topic in vars(config.topics).items() if topic not in topics]
    if not keys:
        return ()
    types = ", ".join(f"{ROLE_NAMES[role]} ({ROLE_TYPES[role]})" for role in (ODOMETRY, WRENCH))
    return (f"the bag has {types}: to read it, leave {', '.join(keys)} out of the configuration",)


def write_messages(path: str | Path, messages: Iterable[tuple[int, str, Message]]) -> None:
    """Write (arrival [ns], role, message in ROS axes) in order of arrival.

    Raises UserError if the bag cannot be written.
    """
    with BagWriter(path) as writer:
        for arrival, role, message in messages:
            writer.write(f"/{ROLE_NAMES[role]}", ROLE_TYPES[role], arrival, encode(message))
