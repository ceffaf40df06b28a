"""BLAS is limited to one thread.

The matrices here are 30 x 30, over which a second thread only waits, at full load. Our own programs
limit their process; as a library we limit only our own calls.
"""

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def limit_process() -> None:
    """Give this process and its children one thread for BLAS: for programs, never at an import.

    Best called before numpy is loaded: its BLAS then starts no other thread at all.
    """
    for name in _VARIABLES:
        os.environ.setdefault(name, "1")
    if "numpy" in sys.modules:
        _controller(True).limit(limits=1, user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread within this context (or decorated function), then restore it.

    The limit holds for the process, so that calls in several threads share one: the first sets it
    and the last restores it.
    """
    global _inside, _before
    with _lock:
        if _inside == 0:
            # scipy brings a BLAS of its own
            libraries = _libraries("scipy.linalg" in sys.modules)
            _before = [
                (library, n) for library in libraries if (n := library.get_num_threads()) != 1
            ]
            for library, _ in _before:
                library.set_num_threads(1)
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                for library, n in _before:
                    library.set_num_threads(n)


_lock = threading.Lock()
_inside = 0
_before: list[tuple[Any, int]] = []  # libraries that had more threads, and how many


@cache
def _controller(with_scipy: bool) -> Any:
    """The BLAS libraries that are loaded, looked for once."""
    from threadpoolctl import ThreadpoolController

    if with_scipy:
        import scipy.linalg  # noqa: F401
    return ThreadpoolController()


@cache
def _libraries(with_scipy: bool) -> list[Any]:
    """They, one by one: a limit by the controller itself costs as much as a sample's arithmetic."""
    return _controller(with_scipy).select(user_api="blas").lib_controllers
