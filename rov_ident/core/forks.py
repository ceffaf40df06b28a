"""Work divided between this process and a fork of it, which has all that this one has.

For Python between kernels, of which threads can run only one at a time.
"""

import contextlib
import io
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")

_MOST = 255  # tasks that are handed out by numbers of one byte
_CUT = EOFError, pickle.UnpicklingError  # an answer that is not there, or not to its end
_divided = False  # whether this process already shares the processors with another


def divided(function: Callable[[T], R], of: Iterable[T], known: Sequence[object] = ()) -> list[R]:
    """The function of each of several things, in their order: by two processes, whichever is free
    takes the next; by this one alone inside of such a call, where there is one processor, or none
    can be forked. Results from the other process are copies but for the objects ``known``; what
    the function changes there stays there. An exception ends both.
    """
    global _divided
    things = list(of)
    if _divided or not 1 < len(things) <= _MOST or not _can_fork():
        return [function(x) for x in things]
    tasks, put = os.pipe()
    os.write(put, bytes(range(len(things))))
    os.close(put)
    answer, out = os.pipe()
    results: dict[int, R] = {}
    _divided, child = True, -1
    try:
        with contextlib.suppress(OSError):  # too many processes: then there is no other
            child = os.fork()
        if child == 0:
            os.close(answer)  # or nothing would break the pipe when the parent is gone
            _answer(function, things, tasks, out, known)  # never returns
        os.close(out)
        results |= _of_tasks(function, things, tasks)
        with os.fdopen(answer, "rb", closefd=False) as file, contextlib.suppress(*_CUT):
            found = _Unpickler(file, known).load()
            if isinstance(found, Exception):
                raise found
            results |= found
        # what is missing the other process had taken when it was killed
        return [results[i] if i in results else function(x) for i, x in enumerate(things)]
    finally:
        with contextlib.suppress(ProcessLookupError, ChildProcessError):  # SIGCHLD is ignored
            if child > 0:
                os.kill(child, signal.SIGKILL)  # nothing, where it has ended
                os.waitpid(child, 0)
        os.close(tasks)
        os.close(answer)
        _divided = False


def _can_fork() -> bool:
    return sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1


def _of_tasks(
    function: Callable[[T], R], things: Sequence[T], tasks: int
) -> Iterable[tuple[int, R]]:
    parent = os.getppid()
    while os.getppid() == parent and (number := os.read(tasks, 1)):
        yield number[0], function(things[number[0]])


def _answer(
    function: Callable[[T], R], things: Sequence[T], tasks: int, out: int, known: Sequence[object]
) -> None:
    """What the other process does; it ends without what Python does at the end."""
    try:
        found: object
        try:
            found = dict(_of_tasks(function, things, tasks))
        except Exception as error:  # raised where it was asked for
            found = error
        buffer = io.BytesIO()
        _Pickler(buffer, known).dump(found)
        with os.fdopen(out, "wb", closefd=False) as file:
            file.write(buffer.getbuffer())
    finally:
        os._exit(0)


class _Pickler(pickle.Pickler):
    def __init__(self, file: Any, known: Sequence[object]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._places = {id(x): i for i, x in enumerate(known)}

    def persistent_id(self, obj: Any) -> int | None:
        return self._places.get(id(obj))


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: Any, known: Sequence[object]) -> None:
        super().__init__(file)
        self._known = known

    def persistent_load(self, pid: Any) -> Any:
        return self._known[pid]
