"""Which files are read; where one may be written, and writing it whole or not at all."""

import contextlib
import errno
import fcntl
import hashlib
import os
import secrets
import stat
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import IO

from rov_ident.core.errors import UserError, require

Place = str | os.PathLike[str]

_FOLDERS = (Path(__file__).resolve().parents[2], Path(sys.prefix) / "share" / "rov_ident")

_LONGEST = 255  # bytes of a name, in all file systems of Linux
_BAG = b"\x89MCAP"  # how a bag begins, whatever its name and version
_ROSBAG2 = b"rosbag2_bagfile_information"  # and how the metadata.yaml of a rosbag2 directory does


VEHICLES = ("bluerov2", "bluerov2_heavy", "remus100")  # those with a file in the folder `config`


def shipped(name: str) -> Path:
    """A file that comes with the project: beside the package, or where it was installed.

    Raises UserError if it is in neither place.
    """
    for folder in _FOLDERS:
        if (folder / name).exists():
            return folder / name
    raise UserError(f"{name} is not here: run this from a checkout of the project")


def check_output(path: Place, inputs: Iterable[Place | None] = (), bag: bool = False) -> None:
    """Refuse a place where a result must not or cannot be written; nothing is touched.

    A result replaces nothing but a regular file, none of the ``inputs`` (files, or rosbag2
    directories with all that is in them), and no bag unless it is a ``bag`` itself.

    Raises UserError: one sentence naming the path and what to change.
    """
    try:
        refusal = _refusal(Path(path), [Path(given) for given in inputs if given is not None], bag)
    except ValueError:  # a NUL character, or half of one in UTF-16
        refusal = "no file can have that name"
    if refusal:
        raise UserError(f"{_shortened(path)} cannot be written: {refusal}")


def open_input(path: Place) -> IO[bytes]:
    """A regular file for reading. A pipe, for whose writer one would wait, and a device are none.

    Raises OSError, whose ``strerror`` says in words why it cannot be read.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:
        raise OSError(errno.EINVAL, "no file can have that name", str(path)) from error
    kind = os.fstat(descriptor).st_mode
    if stat.S_ISREG(kind):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    what = "it is a folder" if stat.S_ISDIR(kind) else "it is a pipe or a device, not a file"
    raise OSError(errno.EINVAL, what, str(path))


def read_input(path: Place, largest: int) -> bytes:
    """What is in a regular file of at most ``largest`` bytes. Raises OSError as above."""
    with open_input(path) as stream:
        data = stream.read(largest + 1)
    if len(data) > largest:
        raise OSError(errno.EFBIG, f"it is larger than {largest >> 20} MiB", str(path))
    return data


def sha256_of(paths: Iterable[Place]) -> str:
    """Hexadecimal digest of the contents of files, in order. Raises OSError as above."""
    digest = hashlib.sha256()
    for path in paths:
        with open_input(path) as stream:
            while piece := stream.read(1 << 20):
                digest.update(piece)
    return digest.hexdigest()


def write_file(path: Place, content: str | bytes) -> None:
    """Write a file whole or not at all, text in UTF-8; its folder is made where there is none.

    Raises UserError if it cannot be written there.
    """
    require(str | os.PathLike, "a path", path=path)
    check_output(path)
    try:
        replace_file(path, content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}") from error


def replace_file(path: Place, content: bytes) -> None:
    """Put a file in its place, in one piece, so that it outlives a loss of power.

    Raises OSError; what was there before then still is.
    """
    place = Path(os.path.realpath(path))  # a link stays one
    place.parent.mkdir(parents=True, exist_ok=True)
    part = part_of(place)
    try:
        with part.open("xb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(place)
    except BaseException:  # an interrupt, too
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    folder = os.open(place.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the name, too
    finally:
        os.close(folder)


def lock(path: Place) -> IO[bytes]:
    """A file beside ``path`` that is locked until it is closed, or its process ends.

    Raises BlockingIOError if another process or thread has it, OSError if there can be none.
    """
    place = Path(os.path.realpath(path))
    place.parent.mkdir(parents=True, exist_ok=True)
    stream = place.with_name(f".{_digest(place)}.lock").open("ab")
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        stream.close()
        raise
    return stream


def part_of(path: Path) -> Path:
    """A hidden name in the same folder, which nobody else uses, for a file in the making.

    What a process that was killed has left of this file goes.
    """
    name = _digest(path)
    for old in path.parent.glob(f".{name}.*.part"):
        with contextlib.suppress(OSError, ValueError):
            if not Path(f"/proc/{int(old.name.split('.')[2])}").exists():
                old.unlink()
    return path.with_name(f".{name}.{os.getpid()}.{secrets.token_hex(4)}.part")


def _digest(path: Path) -> str:
    """Short, whatever the length of the name."""
    return hashlib.sha256(os.fsencode(path.name)).hexdigest()[:12]


def _refusal(path: Path, inputs: list[Path], bag: bool) -> str:
    """Why a file must not or cannot be written there; empty where it may."""
    place = Path(os.path.realpath(path))
    home = path.parts[0] if len(path.parts) > 1 else ""
    if home.startswith("~") and not os.path.lexists(home):
        return f"the shell knows no folder {home}, so write it in full"
    if any(len(os.fsencode(part)) > _LONGEST for part in place.parts):
        return f"a name in it is longer than {_LONGEST} bytes"
    try:
        kind = place.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        kind = 0
    except OSError as error:
        return error.strerror or str(error)
    for given in inputs:
        source = Path(os.path.realpath(given))
        if place == source or (kind and source.exists() and place.samefile(source)):
            return "the result would replace what it is made from, so choose another name"
        is_bag = (source / "metadata.yaml").exists()
        if is_bag and place.is_relative_to(source):
            return f"it lies within the bag {_shortened(given)}, so choose another folder"
    if kind and bag and place.suffix != ".mcap":
        return "it exists already, so remove it or choose another name"
    if stat.S_ISDIR(kind):
        return "it is a folder, so give the name of a file"
    if kind and not stat.S_ISREG(kind):
        return "there is a device, a pipe or a socket, so give the name of a file"
    try:
        if kind and not bag and _begins_with(place, _BAG):
            return "there is a bag, so choose another name"
        if _begins_with(place.parent / "metadata.yaml", _ROSBAG2):
            return "it lies within a bag, so choose another folder"
    except OSError as error:
        return error.strerror or str(error)
    folder = place.parent
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        return f"{folder} is not a folder"
    if not os.access(place if kind else folder, os.W_OK):
        return f"{place if kind else folder} is not yours to write in"
    try:  # a file system may refuse what permissions allow; the file has no name, where it can
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return f"{folder} takes no files ({error.strerror})"


def _begins_with(path: Path, how: bytes) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(len(how)) == how


def _shortened(path: Place) -> str:
    """A path within a sentence."""
    text = str(path).replace("\0", "\\0")
    return text if len(text) <= 200 else f"{text[:197]}..."
