"""Bags on disk: the only module that knows MCAP.

A bag is one file or a rosbag2 directory of them; what is no MCAP file is read by `other_bags.py`.
Reading goes block by block: a block is a chunk, or a run of messages outside chunks (rosbag2's
`fastwrite`). Where a file ends well its summary lists the blocks; a file whose writer was killed is
walked through instead, and every complete block of it is kept.
"""

import io
import mmap
import os
import re
import struct
import zlib
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from heapq import merge
from operator import attrgetter
from pathlib import Path
from typing import IO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Schema
from mcap.writer import MCAP0_MAGIC

from rov_ident.core.errors import UserError
from rov_ident.core.files import open_input, sha256_of
from rov_ident.core.yaml_file import parse_file
from rov_ident.io.other_bags import OtherFile, Ros1File, SqliteFile

SUFFIXES = (".mcap", ".db3", ".bag")
"""Of the files of a bag."""

_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_RUN_LENGTH = 4096  # messages outside chunks that make one block
LARGEST_CHUNK = 1 << 28
"""Bytes: recorders make chunks of about a megabyte; a larger claim is damage, or meant to harm."""

LARGEST_OVERLAP = 1 << 29
"""Bytes of messages that wait for their turn; two chunks of the largest kind."""

# What zstd, lz4, mcap and struct raise on bytes that are not what they should be.
_DAMAGE = (
    zstandard.ZstdError, RuntimeError, McapError, ValueError, OverflowError, struct.error
)  # fmt: skip


class Topic(NamedTuple):
    type_name: str
    message_count: int


class RawMessage(NamedTuple):
    topic: str
    type_name: str
    log_time: int  # ns
    data: bytes  # CDR


class _Block(NamedTuple):
    """A piece of a file that is read at once."""

    start_time: int  # ns, of the earliest message in it
    offset: int  # of its first record in the file
    length: int


@dataclass
class _File:
    """What one .mcap file holds and where."""

    path: Path
    topics: dict[int, tuple[str, str]] = field(default_factory=dict)  # channel: (topic, type)
    counts: Counter[int] = field(default_factory=Counter)  # channel: messages
    blocks: list[_Block] = field(default_factory=list)
    lost_bytes: int = 0
    damaged: set[int] = field(default_factory=set)  # offsets of unreadable chunks


_KINDS = {MCAP0_MAGIC: _File, b"SQLite format 3": SqliteFile, b"#ROSBAG": Ros1File}


class Bag:
    """A recorded dive: the CDR messages of a file (MCAP, sqlite3, ROS 1) or a rosbag2 directory.

    Attributes:
        path: as given.
        topics: what is in it; only CDR topics count, each with the messages that can be read.
        truncated: the writer of a file was killed; what it completed is read.
        lost_bytes: how much of the files behind the last complete record is unread.

    Raises UserError: nothing there, another format, or no message in it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        files = [_index(file) for file in _files_of_bag(self.path)]
        self._files = [file for file in files if isinstance(file, _File)]
        self._others = [file for file in files if isinstance(file, OtherFile)]
        self.lost_bytes = sum(file.lost_bytes for file in self._files)
        self.truncated = self.lost_bytes > 0
        types: dict[str, str] = {}
        counts: Counter[str] = Counter()
        for file in files:
            for channel, (topic, type_name) in file.topics.items():
                if types.setdefault(topic, type_name) == type_name:
                    counts[topic] += file.counts[channel]
        self.topics = {topic: Topic(types[topic], counts[topic]) for topic in sorted(types)}
        if not any(counts.values()):
            cause = "its writer was killed too early" if self.truncated else "record it anew"
            raise UserError(f"{self.path} holds no ROS 2 message: {cause}.")

    @property
    def damaged_chunks(self) -> int:
        """Chunks found unreadable (wrong checksum) and passed over so far."""
        return sum(len(file.damaged) for file in self._files)

    @property
    def damage(self) -> str | None:
        """What is missing from the bag, in words; None for a whole one."""
        parts = []
        if self.truncated:
            parts.append(f"its writer was killed, the last {self.lost_bytes} bytes cannot be read")
        if self.damaged_chunks:
            parts.append(f"{self.damaged_chunks} damaged chunks are passed over")
        return f"{self.path}: {' and '.join(parts)}" if parts else None

    @cached_property
    def sha256(self) -> str:
        """Hexadecimal digest of the contents of the files, in order."""
        return sha256_of([f.path for f in self._files] + [f.path for f in self._others])

    def iter_raw(self, topics: Iterable[str] | None = None) -> Iterator[RawMessage]:
        """The messages of these topics (None: of all) in the order of their log times.

        Messages of equal time come in the order of the file. Only blocks that overlap in time are
        in memory together.
        """
        names = set(self.topics if topics is None else topics)

        def chosen(file: _File | OtherFile) -> dict[int, tuple[str, str]]:
            return {
                channel: (topic, type_name)
                for channel, (topic, type_name) in file.topics.items()
                if topic in names and self.topics[topic].type_name == type_name
            }

        log_time = attrgetter("log_time")
        if self._others:
            yield from merge(*(_raw(file, chosen(file)) for file in self._others), key=log_time)
            return
        wanted = [chosen(file) for file in self._files]
        order = sorted(
            (block.start_time, number, block)
            for number, file in enumerate(self._files)
            for block in file.blocks
        )
        pending: list[RawMessage] = []
        for start_time, number, block in order:
            # No later block can hold anything earlier than this one begins.
            ready = bisect_left(pending, start_time, key=log_time)
            yield from pending[:ready]
            del pending[:ready]
            file = self._files[number]
            try:
                with open_input(file.path) as stream:  # a bag may have more than can be open
                    pending += _messages(_read_block(stream, block), wanted[number])
            except _DAMAGE:
                file.damaged.add(block.offset)
            except OSError as error:
                raise UserError(f"{file.path} cannot be read: {error.strerror}") from error
            if sum(len(message.data) for message in pending) > LARGEST_OVERLAP:
                raise UserError(
                    f"{file.path} holds more than {LARGEST_OVERLAP >> 20} MiB out of order: "
                    "bring it in order with `mcap sort`"
                )
            pending.sort(key=log_time)
        yield from pending


def _raw(file: OtherFile, topics: dict[int, tuple[str, str]]) -> Iterator[RawMessage]:
    for channel, time, data in file.messages(topics):
        yield RawMessage(*topics[channel], time, data)


def _files_of_bag(path: Path) -> list[Path]:
    """The files of a bag in the order of recording, each known to begin like one."""
    try:
        files = _files_of_directory(path) if path.is_dir() else [path]
        kinds = {_kind(file) for file in files}
        if len(kinds) > 1:
            raise UserError(f"{path} has files of several formats: give one of them")
    except OSError as error:
        raise UserError(
            f"{error.filename or path} cannot be read ({error.strerror}): check the path."
        ) from error
    return files


def _files_of_directory(path: Path) -> list[Path]:
    metadata_path = path / "metadata.yaml"
    if metadata_path.exists():
        try:
            information = parse_file(metadata_path)["rosbag2_bagfile_information"]
            names = [str(name) for name in information["relative_file_paths"]]
            compression = str(information.get("compression_mode", "")).lower()
        except (UserError, KeyError, TypeError, AttributeError) as error:
            raise UserError(
                f"{metadata_path} is not the metadata of a rosbag2 bag: restore it with "
                "`ros2 bag reindex`, or remove it to have all .mcap files read."
            ) from error
        files = [_file_of_bag(path, name) for name in names]
        if compression in ("file", "message"):
            raise UserError(
                f"{path} is compressed by rosbag2 ({compression} mode): unpack it with "
                f"`rosbags-convert --src {path} --dst NEW`, and give NEW"
            )
    else:  # its writer was killed
        found = (sorted(path.glob(f"*{suffix}"), key=_natural_order) for suffix in SUFFIXES)
        files = next(filter(None, found), [])
    if not files:
        raise UserError(f"{path} holds no .mcap file, .db3 or .bag: give a bag or its directory.")
    return files


def _file_of_bag(folder: Path, name: str) -> Path:
    """A file of the bag; what points out of its folder is another's file."""
    file, metadata = folder / name, folder / "metadata.yaml"
    if not file.resolve().is_relative_to(folder.resolve()):
        raise UserError(f"{metadata} names {name}, which is outside the bag.")
    if not file.exists():
        raise UserError(
            f"{file} cannot be read: it is not there, though {metadata} names it. Copy it, too, or "
            "remove metadata.yaml to have the other files read."
        )
    return file


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """Sorts dive_2 before dive_10."""
    return [
        (int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", path.stem)
    ]


def _kind(path: Path) -> type[_File] | type[OtherFile]:
    with open_input(path) as stream:
        head = stream.read(16)
    if not head:  # what a power cut leaves of a file that was just begun
        return _File
    for magic, kind in _KINDS.items():
        if head.startswith(magic):
            return kind
    raise UserError(f"{path} is not an MCAP file: give a .mcap, .db3 or .bag, or a directory.")


def _index(path: Path) -> _File | OtherFile:
    kind = _kind(path)
    if issubclass(kind, OtherFile):
        return kind(path)
    if path.stat().st_size == 0:
        return _File(path, lost_bytes=1)
    with open_input(path) as stream:
        return _index_by_summary(path, stream) or _index_by_walking(path, stream)


def _index_by_summary(path: Path, stream: IO[bytes]) -> _File | None:
    """The index from the summary at the end of the file; None where that does not tell all."""
    stream.seek(-len(MCAP0_MAGIC), os.SEEK_END)
    if stream.read() != MCAP0_MAGIC:
        return None
    stream.seek(0)  # where the reader expects the magic
    try:
        summary = SeekingReader(stream).get_summary()
    except (*_DAMAGE, OSError):  # OSError: shorter than what a complete file ends with
        return None
    if summary is None or summary.statistics is None:
        return None
    counts = summary.statistics.channel_message_counts
    complete = (
        summary.statistics.message_count == sum(counts.values())
        and summary.statistics.chunk_count == len(summary.chunk_indexes) > 0
        and summary.channels.keys() >= counts.keys()
    )
    if not complete:
        return None
    file = _File(path, counts=Counter(counts))
    for channel in summary.channels.values():
        _register(file, channel, summary.schemas)
    file.blocks = [
        _Block(c.message_start_time, c.chunk_start_offset, c.chunk_length)
        for c in summary.chunk_indexes
    ]
    return file


def _index_by_walking(path: Path, stream: IO[bytes]) -> _File:
    """The index from the records themselves, as far as they are complete."""
    file = _File(path)
    schemas: dict[int, Schema] = {}
    run: list[tuple[int, int, int]] = []  # (log time, start, end) of messages outside chunks
    reached = len(MCAP0_MAGIC)
    finished = False
    with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as buffer:
        for opcode, start, body, end in _records(buffer, reached):
            reached = end
            if opcode == Opcode.DATA_END:
                finished = True
                break
            try:
                if opcode == Opcode.CHUNK:
                    chunk = Chunk.read(_stream(buffer[body:end]))
                    data = _unpack(chunk)
                    for inner, _, inner_body, inner_end in _records(data, 0):
                        _note(file, schemas, inner, data[inner_body:inner_end])
                    file.blocks.append(_Block(chunk.message_start_time, start, end - start))
                elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                    _note(file, schemas, opcode, buffer[body:end])
                    if opcode == Opcode.MESSAGE:
                        run.append((_MESSAGE.unpack_from(buffer, body)[2], start, end))
            except _DAMAGE:
                file.damaged.add(start)
                opcode = 0
            if run and (opcode in (0, Opcode.CHUNK) or len(run) == _RUN_LENGTH):
                file.blocks.append(_block_of_run(run))
                run = []
        if not finished:
            # At least one, even where the file was cut exactly between two records.
            file.lost_bytes = max(1, len(buffer) - reached)
    if run:
        file.blocks.append(_block_of_run(run))
    return file


def _block_of_run(run: list[tuple[int, int, int]]) -> _Block:
    times = [log_time for log_time, _, _ in run]
    return _Block(min(times), run[0][1], run[-1][2] - run[0][1])


def _records(buffer: bytes | mmap.mmap, position: int) -> Iterator[tuple[int, int, int, int]]:
    """(opcode, start, start of the body, end) of each complete record."""
    size = len(buffer)
    while position + _RECORD.size <= size:
        opcode, length = _RECORD.unpack_from(buffer, position)
        body = position + _RECORD.size
        # Opcode 0 does not exist: zeros are what a power cut leaves behind.
        if opcode == 0 or body + length > size:
            return
        yield opcode, position, body, body + length
        position = body + length


def _note(file: _File, schemas: dict[int, Schema], opcode: int, body: bytes) -> None:
    """Enters a schema, channel or message that was met on the walk into the index."""
    if opcode == Opcode.MESSAGE:
        file.counts[_MESSAGE.unpack_from(body)[0]] += 1
    elif opcode == Opcode.SCHEMA:
        schema = Schema.read(_stream(body))
        schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        _register(file, Channel.read(_stream(body)), schemas)


def _register(file: _File, channel: Channel, schemas: Mapping[int, Schema]) -> None:
    if channel.message_encoding == "cdr" and channel.schema_id in schemas:
        file.topics[channel.id] = (channel.topic, schemas[channel.schema_id].name)


def _read_block(stream: IO[bytes], block: _Block) -> bytes:
    """The records of a block, unpacked."""
    stream.seek(block.offset)
    data = stream.read(block.length)
    opcode, _ = _RECORD.unpack_from(data)
    return _unpack(Chunk.read(_stream(data[_RECORD.size :]))) if opcode == Opcode.CHUNK else data


def _messages(buffer: bytes, topics: Mapping[int, tuple[str, str]]) -> list[RawMessage]:
    """The messages of these channels: the inner loop of all reading."""
    found = []
    for opcode, _, body, end in _records(buffer, 0):
        if opcode == Opcode.MESSAGE:
            channel, _, log_time, _ = _MESSAGE.unpack_from(buffer, body)
            if channel in topics:
                topic, type_name = topics[channel]
                data = buffer[body + _MESSAGE.size : end]
                found.append(RawMessage(topic, type_name, log_time, data))
    return found


def _unpack(chunk: Chunk) -> bytes:
    """The records of a chunk; never more bytes than it says, whatever its compressed data say."""
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK:
        raise McapError(f"a chunk of {size} bytes")
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise McapError(f"compression {chunk.compression!r} is unknown")
    if len(data) != size:
        raise McapError(f"a chunk of {size} bytes holds another number")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise McapError("wrong checksum")
    return data


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))
