r"""What an online estimator has learnt, on disk, so that a crash costs a second of it.

A checkpoint is one file::

    rov_ident checkpoint\n
    sha256 of all that follows, 64 hexadecimal digits\n
    {"format": 1, "estimator": ..., "configuration": ..., "structure": ..., "stamp": ...}\n
    the arrays of OnlineEstimator.memory(), one after the other, as they are in memory

Nothing in the file is run or decides how much is read. Only the same estimator of the same
configuration (but for what may change while a node runs) takes it. There is always a whole one.
"""

import contextlib
import hashlib
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import PARAMETERS, Config, to_parameters
from rov_ident.core.errors import UserError
from rov_ident.core.files import lock, open_input, write_file
from rov_ident.estimation.online import Memory, OnlineEstimator

FORMAT = 1  # to be raised when the same numbers get another meaning
LARGEST = 1 << 24  # bytes; a state of a hundred coefficients has a fiftieth of that

_MAGIC = b"rov_ident checkpoint\n"
_WORDS = {"estimator": "estimator", "configuration": "configuration"}


def identity(online: OnlineEstimator) -> dict[str, Any]:
    """What must be the same for a checkpoint to be of use; it stays the same while a node runs."""
    memory = online.memory()
    shapes = [(part.dtype.descr, part.shape) for part in _arrays(memory)]
    return {
        "format": FORMAT,
        "estimator": online.kind,
        "configuration": _digest(_fixed_settings(online.config)),
        "structure": _digest([type(memory.state)._fields, shapes]),
    }


def packed(memory: Memory, identity: dict[str, Any]) -> bytes:
    """The contents of a checkpoint."""
    header = json.dumps({**identity, "stamp": memory.stamp}).encode() + b"\n"
    body = header + b"".join(map(_bytes, _arrays(memory)))
    return _MAGIC + hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def restore(online: OnlineEstimator, data: bytes) -> None:
    """Have an estimator go on from a checkpoint's contents; it stays as it is where that fails.

    Raises UserError if the bytes are damaged, or of another estimator, configuration or version.
    """
    if not data.startswith(_MAGIC) or len(data) > LARGEST:
        raise UserError("it is no checkpoint, or its beginning is lost")
    checksum, _, body = data[len(_MAGIC) :].partition(b"\n")
    if hashlib.sha256(body).hexdigest().encode() != checksum:
        raise UserError("it is damaged: its checksum is wrong")
    head, _, rest = body.partition(b"\n")
    try:
        header = json.loads(head)
        stamp = int(header["stamp"])
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise UserError("it is damaged: its header cannot be read") from error
    for key, mine in identity(online).items():
        if header.get(key) != mine:
            raise UserError(f"it is of another {_WORDS.get(key, 'version of this program')}")
    memory = online.memory()
    parts, offset = [], 0
    for part in _arrays(memory):
        piece = rest[offset : offset + part.nbytes]
        if len(piece) != part.nbytes:
            raise UserError("it is damaged: it ends too early")
        parts.append(np.frombuffer(bytearray(piece), part.dtype).reshape(part.shape))
        offset += part.nbytes
    count = len(memory.state)
    state = type(memory.state)(*parts[:count])
    online.recall(Memory._make([state, *parts[count:], stamp]))


def read(online: OnlineEstimator, path: Path) -> bool:
    """Have an estimator go on from a file; False where there is none.

    A file that is refused is put aside, under its name with ``.refused`` behind it.

    Raises UserError, one sentence that names the file and why it cannot be used.
    """
    try:
        with open_input(path) as stream:
            data = stream.read(LARGEST + 1)
    except FileNotFoundError:
        return False
    except OSError as error:
        raise UserError(f"the checkpoint {path} cannot be read ({error.strerror})") from error
    try:
        restore(online, data)
    except UserError as error:
        aside = path.with_name(f"{path.name}.refused")
        with contextlib.suppress(OSError):
            path.replace(aside)
        raise UserError(f"the checkpoint {path} is not used, {error}: see {aside.name}") from error
    return True


class Keeper:
    """Writes checkpoints in a thread of its own: a slow disk must not hold up samples.

    Only one has a path: it is locked until the keeper is closed. Another one, of whichever process,
    is ``refused`` and writes nothing. ``saved`` [ns] is the stamp of the last checkpoint written,
    ``took`` [s] how long that took; ``failure`` why the last attempt failed, or empty.
    """

    def __init__(self, path: Path, online: OnlineEstimator) -> None:
        self.path = path
        self.saved, self.took, self.failure = 0, 0.0, ""
        self._lock: IO[bytes] | None = None
        self.refused = False
        try:
            self._lock = lock(path)
        except BlockingIOError:
            self.refused = True
            self.failure = f"another node writes {path}: give each a checkpoint_path of its own"
        except (OSError, ValueError):
            pass  # writing will say why, and there may be a folder by then
        self._online = online
        self._identity = identity(online)
        self._waiting: Memory | None = None
        self._asked = 0.0  # s, time.monotonic() since when something waits
        self._unwritten = 0.0  # s, the same of the oldest that is not on disk; 0: none
        self._changed = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="checkpoint", daemon=True)
        self._thread.start()

    def keep(self) -> None:
        """Write what is learnt by now, as soon as the disk allows; only the newest is kept."""
        if self.refused:
            return
        memory = self._online.memory()  # it does not change any more
        with self._changed:
            if self._waiting is None:
                self._asked = time.monotonic()
            self._unwritten = self._unwritten or self._asked
            self._waiting = memory
            self._changed.notify()

    @property
    def late(self) -> float:
        """For how long [s] something has not been written that should be."""
        return time.monotonic() - self._unwritten if self._unwritten else 0.0

    def close(self, patience: float = 5.0) -> None:
        """Write what still waits, for no longer than some seconds."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(patience)
        if self._lock is not None:
            self._lock.close()

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._waiting is None and not self._ended:
                    self._changed.wait()
                memory, self._waiting = self._waiting, None
            if memory is None:
                return
            begun = time.monotonic()
            try:
                write_file(self.path, packed(memory, self._identity))
            except UserError as error:
                self.failure = str(error)
            else:
                self.saved, self.took, self.failure = memory.stamp, time.monotonic() - begun, ""
                with self._changed:
                    self._unwritten = self._asked if self._waiting is not None else 0.0


def _arrays(memory: Memory) -> Iterator[NDArray[Any]]:
    """The arrays in the order of the file."""
    yield from memory.state
    yield from (part for part in memory[1:] if isinstance(part, np.ndarray))


def _bytes(part: NDArray[Any]) -> bytes:
    """Those of its numbers: what lies between the fields of a record may be anything."""
    if part.dtype.names is None:
        return part.tobytes()
    clean = np.zeros(part.shape, part.dtype)  # zeros_like leaves what lies between as it is
    for name in part.dtype.names:
        clean[name] = part[name]
    return clean.tobytes()


def _fixed_settings(config: Config) -> dict[str, Any]:
    """The configuration without what may change while a node runs, and how messages come in."""
    values = to_parameters(config)
    values.pop("topics", None)
    values.pop("qos", None)
    for key in (p.key for p in PARAMETERS if p.live):
        section, _, name = key.rpartition(".")
        (values.get(section, {}) if section else values).pop(name, None)
    return {key: value for key, value in values.items() if value != {}}


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
