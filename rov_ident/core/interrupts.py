"""SIGINT and SIGTERM of our own programs, from before anything else is loaded until the end.

An exception that is raised while a module is loaded or an object finalised may be caught there, and
one that crosses a library of C++ aborts the process.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTS = (signal.SIGINT, signal.SIGTERM)

_SOON = 0.02  # s; nobody notices it


class Interrupted(KeyboardInterrupt):
    """An interrupt; ``status`` is what shells call it: 130 for SIGINT, 143 for SIGTERM."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.status = 128 + number


def end_at_once(status: int | None = None) -> None:
    """Have an interrupt end the process with this status; None: its own, saying so.

    For a program that has nothing to tidy up yet, or no longer: files are written whole or not at
    all, and compilers end with their parent.
    """

    def end(number: int, _: FrameType | None) -> None:
        if status is not None:
            os._exit(status)
        _end(number)

    for number in INTERRUPTS:
        signal.signal(number, end)


def raise_interrupts() -> None:
    """Have an interrupt raise Interrupted where it cannot be lost; a second one does not wait."""
    waiting = 0

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal waiting
        if number == signal.SIGALRM:
            number = waiting
        elif waiting:
            _end(number)
        if _may_be_lost(frame):
            waiting = number
            signal.signal(signal.SIGALRM, interrupt)
            signal.setitimer(signal.ITIMER_REAL, _SOON)
        else:
            waiting = 0
            # An object that is half made now may fail in its finaliser, and nobody asked to know.
            sys.unraisablehook = lambda _: None
            raise Interrupted(number)

    for number in INTERRUPTS:
        signal.signal(number, interrupt)


@contextmanager
def noted_interrupts() -> Iterator[list[int]]:
    """The numbers of the interrupts that have come within the block, which do nothing else."""
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # only that one is interrupted
        yield noted
        return
    before = {n: signal.signal(n, lambda number, _: noted.append(number)) for n in INTERRUPTS}
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(number: int) -> None:
    os.write(2, b"interrupted\n")  # what Python has of standard error may be in use
    os._exit(128 + number)


def _may_be_lost(frame: FrameType | None) -> bool:
    """Whether a module is being loaded, or an object finalised, in this frame or around it."""
    while frame is not None:
        code = frame.f_code
        if code.co_name == "__del__" or code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
