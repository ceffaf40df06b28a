"""Bags that are not MCAP: rosbag2's sqlite3 files, and those of ROS 1, as the same CDR messages."""

import sqlite3
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from rov_ident.core.errors import UserError

Topics = dict[int, tuple[str, str]]


class OtherFile(ABC):
    """One file: ``topics`` by channel as (name, type), and how many messages each has.

    Raises UserError if it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: Topics = {}
        self.counts: Counter[int] = Counter()
        try:
            self._open()
        except UserError:
            raise
        except Exception as error:  # whatever the bytes make of the libraries
            raise self._refusal(error) from error

    @abstractmethod
    def _open(self) -> None: ...

    @abstractmethod
    def _rows(self, channels: Collection[int]) -> Iterator[tuple[int, int, bytes]]: ...

    def messages(self, channels: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """(channel, log time [ns], CDR) of these channels in the order of their log times."""
        try:
            yield from self._rows(channels)
        except Exception as error:
            raise self._refusal(error) from error

    def _refusal(self, error: Exception) -> UserError:
        mend = "rosbag reindex" if self.path.suffix == ".bag" else "ros2 bag convert"
        return UserError(f"{self.path} is damaged ({error}): mend it with `{mend}`")


class SqliteFile(OtherFile):
    """A `.db3` of rosbag2."""

    @cached_property
    def _data(self) -> sqlite3.Connection:
        return sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro", uri=True)

    def _open(self) -> None:
        for number, name, kind, form in self._data.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            if form == "cdr":
                self.topics[number] = name, kind
        self.counts.update(
            dict(self._data.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"))
        )

    def _rows(self, channels: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        marks = ",".join("?" * len(channels))
        yield from self._data.execute(
            "SELECT topic_id, timestamp, data FROM messages "
            f"WHERE topic_id IN ({marks}) ORDER BY timestamp, id",
            tuple(channels),
        )


class Ros1File(OtherFile):
    """A `.bag` of ROS 1, whose messages rosbags writes anew as ROS 2 would.

    A type has the fields that the bag states: those of BatteryState differ between releases.
    """

    def _open(self) -> None:
        from rosbags.rosbag1 import Reader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        header = "std_msgs/msg/Header"  # only in ROS 1 it has a sequence number
        self._store: Any = get_typestore(Stores.EMPTY)
        self._store.register({header: get_typestore(Stores.ROS2_JAZZY).fielddefs[header]})
        self._reader = Reader(self.path)
        self._reader.open()
        for each in self._reader.connections:
            self.topics[each.id] = each.topic, each.msgtype
            self.counts[each.id] = each.msgcount
            said = get_types_from_msg(each.msgdef.data, each.msgtype)
            new = {n: fields for n, fields in said.items() if n not in self._store.fielddefs}
            self._store.register(new)

    def _rows(self, channels: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        chosen = [c for c in self._reader.connections if c.id in channels]
        if not chosen:  # rosbags would take it for all
            return
        for each, time, raw in self._reader.messages(chosen):
            yield each.id, time, bytes(self._store.ros1_to_cdr(raw, each.msgtype))
