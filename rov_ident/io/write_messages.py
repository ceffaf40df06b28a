"""Messages in memory into a bag, under the names the nodes listen on."""

from collections.abc import Iterable
from pathlib import Path

from rov_ident.core.messages import Message
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.cdr import ROLE_TYPES, encode
from rov_ident.io.topics import ROLE_NAMES


def write_messages(path: str | Path, messages: Iterable[tuple[int, str, Message]]) -> None:
    """Write (arrival [ns], role, message in ROS axes) in order of arrival.

    Raises UserError if the bag cannot be written.
    """
    with BagWriter(path) as writer:
        for arrival, role, message in messages:
            writer.write(f"/{ROLE_NAMES[role]}", ROLE_TYPES[role], arrival, encode(message))
