"""Compiled kernels: how each is compiled, where the machine code is kept, who compiles it and when.

The only module that knows numba's insides. A kernel is a function with one of these decorators:

=========  ============  ==================  =====================================================
decorator  makes arrays  called from         for
=========  ============  ==================  =====================================================
kernel     yes           Python and kernels  the general case
lean       no            Python and kernels  short calls: nobody counts references to arrays
released   no            Python and kernels  calls of milliseconds: other threads run meanwhile
inner      no            kernels             compiles in two thirds of the time of ``lean``
reordered  no            kernels             long sums: vector instructions, other rounding
inlined    as caller     kernels             loops whose length is a constant of the caller
=========  ============  ==================  =====================================================

A slice that is copied counts as an array that is made. ``released`` costs microseconds to give up
Python's lock and take it again. ``reordered`` must not ask whether a number is finite: ``x - x``
may be taken for zero. ``inlined`` also suits a function with one caller.

numba does not notice that a function or constant of another module has changed. So the folder of
the cache is named after the source of the package and of installed effects, the versions of all
that makes the machine code, and the place of the package: numba keeps kernels by the path of their
source, so a copy elsewhere would find the mark of a :class:`Compiler`, but no kernels of its own.
"""

import atexit
import contextlib
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import binding
from numba.core.registry import CPUDispatcher, cpu_target

from rov_ident.core import children, plugins

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parents[1]


def _cache_folder() -> Path:
    """A writable folder for these exact kernels; ``ROV_IDENT_CACHE`` overrides its root.

    Where there can be none, one for this process alone, and a sentence on standard error.
    """
    digest = hashlib.sha256(str(_PACKAGE.absolute()).encode())
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.read_bytes())
    for source in plugins.sources():
        digest.update(source)
    for version in (sys.version, np.__version__, numba.__version__, binding.get_host_cpu_name()):
        digest.update(version.encode())
    caches = Path(os.environ.get("XDG_CACHE_HOME") or "")
    if not caches.is_absolute():  # to be ignored, says the XDG standard
        caches = Path.home() / ".cache"
    root = Path(os.environ.get("ROV_IDENT_CACHE") or caches / "rov_ident")
    folder = root / digest.hexdigest()[:16]
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(folder, os.W_OK) and folder.stat().st_uid == os.getuid():
            return folder
    except OSError:
        pass
    # Compiled code is run as it is found: never from a folder that others could have made.
    own = Path(tempfile.mkdtemp(prefix="rov_ident-"))
    atexit.register(_remove, own, os.getpid())
    if sys.stderr is not None:
        print(
            f"{folder} is not yours to write in, so compiled code is not kept and every start "
            "compiles anew: set ROV_IDENT_CACHE to a folder of your own",
            file=sys.stderr,
        )
    return own


def _remove(folder: Path, owner: int) -> None:
    """At exit; a forked process leaves it to the one that made it."""
    if os.getpid() == owner:
        shutil.rmtree(folder, ignore_errors=True)


# A folder given by NUMBA_CACHE_DIR is used as it is. We do not set that variable for ourselves:
# a child process that runs another version of the package would inherit it. What numba has read of
# a settings file in the current folder is overruled: what is in the cache is run.
CACHE = Path(os.environ.get("NUMBA_CACHE_DIR") or _cache_folder()).absolute()
numba.config.CACHE_DIR = str(CACHE)
"""The folder of the compiled kernels, for this version of everything."""


def _decorator(**options: Any) -> Callable[[F], F]:
    def compiled(function: F) -> F:
        return numba.njit(error_model="numpy", **options)(function)

    return compiled


# `_nrt` is numba's reference counting: whenever an array is taken out of a tuple or a record, and
# given back, it counts with locked instructions of 6 ns (docs/speed.md). `fastmath` is the licence
# to round otherwise. Both are set in every case: otherwise a function inherits them from whichever
# caller is compiled first, and the last bits of a fit would depend on which command ran before it.
_LEAN: dict[str, bool] = {"cache": True, "_nrt": False}
_INNER: dict[str, bool] = {**_LEAN, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}

kernel = _decorator(cache=True, _nrt=True, fastmath=False)
lean = _decorator(fastmath=False, **_LEAN)
released = _decorator(nogil=True, fastmath=False, **_LEAN)
inner = _decorator(fastmath=False, **_INNER)
reordered = _decorator(fastmath={"contract", "reassoc", "nsz"}, **_INNER)
inlined = _decorator(inline="always", cache=True)  # cached for those who call it from Python


def only_run() -> None:
    """Set numba up for a process that runs what others have compiled: 30 MB less, and faster.

    To be called before the first kernel is. scipy's linear algebra, of use only to compile products
    of matrices, is not loaded then, and numba's own helpers are not optimised. Kernels without such
    products can still be compiled afterwards.
    """
    blas, level = "scipy.linalg.cython_blas", numba.config.OPT
    try:
        sys.modules.setdefault(blas, None)  # type: ignore[arg-type]  # None: its import fails
        context = cpu_target.target_context
        numba.config.OPT = type(level)(0)
        context.refresh()
    finally:
        numba.config.OPT = level
        if sys.modules[blas] is None:
            del sys.modules[blas]


def interpret() -> None:
    """Run kernels as the Python functions they are: a thousandth of the speed, but at once.

    Until :func:`stop_interpreting`, and everywhere in this process. numpy's numbers raise nothing
    when divided by zero, as in compiled code; Python's own would.
    """
    CPUDispatcher.__call__ = lambda self, *arguments: self.py_func(*arguments)
    np.seterr(all="ignore")


def stop_interpreting() -> None:
    """Compile kernels again on their first call, or read them from the cache."""
    if interpreting():
        del CPUDispatcher.__call__
        np.seterr(all="warn", under="ignore")


def interpreting() -> bool:
    return "__call__" in vars(CPUDispatcher)


class Compiler:
    """The kernels that one job needs, compiled by a process of its own for all who run them.

    A process does not run the same machine code after compiling it as after reading it from the
    cache, where each kernel holds its own copy of the functions it calls, optimised once more. Sums
    differ in their last bits then, and the same bag has to give the same numbers.

    ``exercise`` is a function at the top level of a module; called with ``arguments`` it runs every
    kernel of the job. The other process finds it by its name.
    """

    def __init__(self, exercise: Callable[..., object], *arguments: str) -> None:
        self._exercise, self._arguments = exercise, arguments
        self._mark = CACHE / "-".join((exercise.__module__, *arguments))
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = False
        self._lock = threading.Lock()

    @property
    def compiled(self) -> bool:
        """Whether a process has compiled everything and left its mark in the cache."""
        return self._mark.exists()

    def start(self) -> None:
        """Compile in another process, without waiting; not after :meth:`stop`.

        The process ends with this one, however this one ends: the pipe between them is closed then.
        """
        command = ["-c", _AS_CHILD, self._exercise.__module__, self._exercise.__name__]
        cache = {"NUMBA_CACHE_DIR": str(CACHE)}  # it may be a temporary folder of this process
        with self._lock:
            if not self._stopped:
                self._process = children.start(
                    *command, *self._arguments, environment=cache, stdin=subprocess.PIPE
                )

    def poll(self) -> int | None:
        """The exit status of the process that was started; None while it runs."""
        return None if self._process is None else self._process.poll()

    def ensure(self) -> bool:
        """Wait until all is compiled; False if that failed, or :meth:`stop` was called."""
        if not self.compiled:
            self.start()
            if self._process is None or self._process.wait():
                return False
        return not self._stopped

    def load(self, *more: object) -> None:
        """Read all kernels from the cache by the exercise; what is missing is compiled here."""
        stop_interpreting()
        self._exercise(*self._arguments, *more)

    def stop(self) -> None:
        """End the process, and start no other: for any thread."""
        with self._lock:
            self._stopped = True
            if self._process is not None:
                self._process.terminate()


_AS_CHILD = "import sys; from rov_ident.core import jit; jit.compile_as_child(*sys.argv[1:])"


def compile_as_child(module: str, exercise: str, *arguments: str) -> None:
    """What the process of a :class:`Compiler` does; it ends at once if standard input is closed."""

    def end_with_parent() -> None:
        os.read(0, 1)  # not sys.stdin, for which an ordinary end would wait
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    compiler = Compiler(getattr(import_module(module), exercise), *arguments)
    compiler.load()
    with contextlib.suppress(OSError):  # a full disk: the next start compiles again
        compiler._mark.touch()


def record(fields: Any) -> np.dtype[np.void]:
    """The dtype of a record whose fields can be read as attributes: compiled, and interpreted."""
    return np.dtype((np.record, np.dtype(fields, align=True)))


def floats(shape: tuple[int, ...], names: str) -> list[tuple[str, str, tuple[int, ...]]]:
    """Fields of a :func:`record` that have one shape."""
    return [(name, "f8", shape) for name in names.split()]


@inner
def copy(a: Any, b: Any) -> None:
    """Into matrix b from a, as far as both go: ``b[:] = a`` allocates and is slow to compile."""
    for i in range(min(len(a), len(b))):
        for j in range(min(a.shape[1], b.shape[1])):
            b[i, j] = a[i, j]
