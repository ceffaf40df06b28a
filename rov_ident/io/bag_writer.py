"""Writing bags: MCAP files, and rosbag2 directories around them."""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import Writer

from rov_ident.core.errors import UserError
from rov_ident.core.files import check_output, part_of

_FLUSH_PERIOD = 1.0  # s; what a killed recorder loses at most
_INFINITE = {"sec": 9223372036, "nsec": 854775807}
_LATCHED_QOS = {
    "history": "keep_last",
    "depth": 1,
    "reliability": "reliable",
    "durability": "transient_local",
    "deadline": _INFINITE,
    "lifespan": _INFINITE,
    "liveliness": "automatic",
    "liveliness_lease_duration": _INFINITE,
    "avoid_ros_namespace_conventions": False,
}


@dataclass
class _WrittenTopic:
    channel: int
    type_name: str
    type_hash: str
    qos: list[dict[str, Any]]
    count: int = 0


class BagWriter:
    """Writes a `.mcap` file, or a rosbag2 directory where the path has no such ending.

    The bag appears under its name when it is complete; an exception in the `with` block leaves
    nothing behind, but what was there before. The same messages give the same bytes.

    Raises UserError: the place cannot be written, or a directory of that name exists.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        check_output(path, bag=True)
        self.path = Path(os.path.realpath(path))
        self._live = False
        self._is_directory = self.path.suffix != ".mcap"
        self._part = part_of(self.path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self._is_directory:
                self._part.mkdir()
            self._stream = self._mcap_path.open("wb")
        except OSError as error:
            raise UserError(
                f"{self.path} cannot be written ({error.strerror}): choose another place."
            ) from error
        self._writer = Writer(self._stream)
        self._writer.start(profile="ros2", library="rov_ident")
        self._topics: dict[str, _WrittenTopic] = {}
        self._schemas: dict[str, int] = {}
        self._times: tuple[int, int] | None = None  # ns, first and last
        self._flushed = time.monotonic()
        self._broken = False  # the disk is full, or gone

    def go_live(self) -> None:
        """Gives the bag its name at once, and keeps what is in it from now on, whatever happens.

        It is flushed every second, so that even a killed process leaves a readable, truncated bag.

        Raises UserError: the disk refuses.
        """
        with self._writing():
            self._part.replace(self.path)
            self._part, self._live = self.path, True

    def add_topic(self, topic: str, type_name: str, latched: bool = False) -> None:
        """Announces a topic; only needed where it is latched (transient local) or may stay empty.

        Raises UserError: the type is not one of ROS 2 Jazzy's.
        """
        text, type_hash = definition(type_name)
        qos = [_LATCHED_QOS] if latched else []
        with self._writing():
            if type_name not in self._schemas:
                schema = self._writer.register_schema(type_name, "ros2msg", text.encode())
                self._schemas[type_name] = schema
            profiles = _to_yaml(qos) if qos else ""
            metadata = {"offered_qos_profiles": profiles, "topic_type_hash": type_hash}
            channel = self._writer.register_channel(
                topic, "cdr", self._schemas[type_name], metadata
            )
        self._topics[topic] = _WrittenTopic(channel, type_name, type_hash, qos)

    def write(self, topic: str, type_name: str, stamp: int, data: bytes) -> None:
        """Appends a CDR message with this log time (ns, not negative).

        Raises UserError: the disk is full, or gone; what a live recording has so far can be read.
        """
        if topic not in self._topics:
            self.add_topic(topic, type_name)
        entry = self._topics[topic]
        with self._writing():
            self._writer.add_message(entry.channel, stamp, data, stamp, entry.count)
            entry.count += 1
            first, last = self._times or (stamp, stamp)
            self._times = min(first, stamp), max(last, stamp)
            if self._live and time.monotonic() - self._flushed > _FLUSH_PERIOD:
                self._writer.flush()
                self._flushed = time.monotonic()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """What the disk refuses is the user's to mend; from then on nothing more is written."""
        try:
            yield
        except OSError as error:
            self._broken = True
            rest = ": what is complete in it can be read" if self._live else ""
            raise UserError(f"{self.path} cannot be written ({error.strerror}){rest}.") from error

    def close(self) -> None:
        """Completes the bag and gives it its name. Raises UserError where the disk refuses."""
        try:
            with self._writing():
                self._writer.finish()
                self._stream.close()
                if self._is_directory:
                    (self._part / "metadata.yaml").write_text(_to_yaml(self._metadata()), "utf-8")
                if not self._live:
                    self._part.replace(self.path)
        except UserError:
            self.abort()
            raise

    def abort(self) -> None:
        """Drops the unfinished bag; a live recording is kept as it is."""
        with suppress(OSError):  # it may be a full disk that has led here
            self._stream.close()
        if not self._live and self._part.is_dir():
            shutil.rmtree(self._part)
        elif not self._live:
            self._part.unlink(missing_ok=True)

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(self, exception_type: type[BaseException] | None, *_: object) -> None:
        # A live recording is worth keeping whatever ended it.
        if not self._broken and (exception_type is None or self._live):
            self.close()
        else:
            self.abort()

    @property
    def _mcap_path(self) -> Path:
        return self._part / f"{self.path.name}_0.mcap" if self._is_directory else self._part

    def _metadata(self) -> dict[str, Any]:
        """The contents of metadata.yaml as rosbag2 of ROS 2 Jazzy writes them (version 9)."""
        first, last = self._times or (0, 0)
        extent = {
            "duration": {"nanoseconds": last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": sum(entry.count for entry in self._topics.values()),
        }
        name = self._mcap_path.name
        return {
            "rosbag2_bagfile_information": {
                "version": 9,
                "storage_identifier": "mcap",
                **extent,
                "topics_with_message_count": [
                    {
                        "topic_metadata": {
                            "name": topic,
                            "type": entry.type_name,
                            "serialization_format": "cdr",
                            "offered_qos_profiles": entry.qos,
                            "type_description_hash": entry.type_hash,
                        },
                        "message_count": entry.count,
                    }
                    for topic, entry in self._topics.items()
                ],
                "compression_format": "",
                "compression_mode": "",
                "relative_file_paths": [name],
                "files": [{"path": name, **extent}],
                "custom_data": None,
                "ros_distro": "jazzy",
            }
        }


def _to_yaml(value: Any) -> str:
    return yaml.dump(value, sort_keys=False, Dumper=_PlainDumper)


class _PlainDumper(yaml.SafeDumper):
    """Writes out what occurs twice: rosbag2 does not look for YAML aliases in a QoS profile."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


@cache
def definition(type_name: str) -> tuple[str, str]:
    """The message definition and RIHS01 hash of a type. Raises UserError on an unknown one."""
    # Imported late: only writing needs it, and it takes 0.2 s.
    from rosbags.typesys import Stores, TypesysError, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    try:
        text, _ = store.generate_msgdef(type_name, ros_version=2)
        return text, store.hash_rihs01(type_name)
    except (TypesysError, KeyError) as error:
        raise UserError(f"{type_name} is not a message type of ROS 2 Jazzy.") from error
