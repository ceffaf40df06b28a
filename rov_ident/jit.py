"""Compilation of the numerical kernels, and where the compiled code is kept.

numba renews a cached function when its own file changes, not when a function it calls does.
The cache therefore lies in a folder named after the contents of all modules with kernels: a stale
kernel cannot be run, and a new version does not disturb a running one.
"""

import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.registry import CPUDispatcher, cpu_target
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

F = TypeVar("F", bound=Callable[..., Any])


def _cache_folder() -> Path:
    """A writable folder for these exact kernels; ``ROV_IDENT_CACHE`` overrides its root."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        source = path.read_bytes()
        if b"rov_ident.jit import" in source:
            digest.update(source)
    root = Path(
        os.environ.get("ROV_IDENT_CACHE")
        or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rov_ident"
    )
    folder = root / digest.hexdigest()[:16]
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(folder, os.W_OK) and folder.stat().st_uid == os.getuid():
            return folder
    except OSError:
        pass
    # Compiled code is run as it is found: never from a folder that others could have made.
    return Path(tempfile.mkdtemp(prefix="rov_ident-"))


# Not by NUMBA_CACHE_DIR, which a child process with other sources would inherit.
if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = str(_cache_folder())


# numba counts who holds an array: whenever one is taken out of a tuple or a record, and given back,
# with locked instructions of 6 ns. What makes no arrays need not count. That is said everywhere, or
# it would be inherited from whichever caller is compiled first.
_COUNTING: dict[str, bool] = {"cache": True, "_nrt": True}
_LEAN: dict[str, bool] = {"cache": True, "_nrt": False}
_INNER: dict[str, bool] = {**_LEAN, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def kernel(function: F) -> F:
    """Compile for this machine on first call and keep the result on disk."""
    compiled: F = numba.njit(error_model="numpy", **_COUNTING)(function)
    return compiled


def lean(function: F) -> F:
    """Like :func:`kernel`, for what makes no arrays, copies of slices included: see _COUNTING."""
    compiled: F = numba.njit(error_model="numpy", **_LEAN)(function)
    return compiled


def released(function: F) -> F:
    """Like :func:`lean`, without Python's lock, so that other threads go on meanwhile.

    For what runs for a millisecond: to give the lock away and take it again takes microseconds.
    """
    compiled: F = numba.njit(error_model="numpy", nogil=True, **_LEAN)(function)
    return compiled


def inner(function: F) -> F:
    """Like :func:`lean`, for calls from kernels only: compiled in two thirds of the time."""
    compiled: F = numba.njit(error_model="numpy", **_INNER)(function)
    return compiled


def reordered(function: F) -> F:
    """Like :func:`inner`, with sums in any order and products fused with them.

    Long sums then become vector instructions; results change by rounding. Not for functions that
    ask whether a number is finite: ``x - x`` may be taken for zero.
    """
    flags = {"contract", "reassoc", "nsz"}
    compiled: F = numba.njit(error_model="numpy", fastmath=flags, **_INNER)(function)
    return compiled


def inlined(function: F) -> F:
    """Compile into its caller, so that constants passed by the caller unroll its loops.

    Right for a function with a single caller, too: numba optimises what a kernel calls once more
    with each kernel above it, and that is what the first start of a node waits for.
    """
    compiled: F = numba.njit(inline="always", error_model="numpy")(function)
    return compiled


def only_run() -> None:
    """Set numba up for a process that runs what others have compiled: 30 MB less, and faster.

    To be called before the first kernel is. Otherwise scipy's linear algebra is loaded in case that
    a kernel with products of matrices comes to be compiled, and what numba compiles for itself at
    each start is optimised, though only kernels that come to be compiled would use it. These can
    be, even so, but for such products.
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
    """Run kernels as the Python that they are, a thousandth as fast but at once.

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


def record(fields: Any) -> np.dtype[np.void]:
    """The dtype of a record whose fields can be read as attributes: compiled, and interpreted."""
    return np.dtype((np.record, np.dtype(fields, align=True)))


@intrinsic
def prefetch(typing: Any, array: Any, at: Any) -> Any:
    """Ask for number ``at`` of a contiguous array, with its line of the cache, without waiting.

    Beyond the end it does nothing. Worth it where several arrays are read by turns, each number
    once: the processor's own guesses lag behind there.
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.bitcast(builder.gep(data, [arguments[1]]), cgutils.voidptr_t)
        number = ir.IntType(32)
        takes = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
        ask = builder.module.declare_intrinsic("llvm.prefetch", [address.type], takes)
        to_read, nearest_level, data_not_code = number(0), number(3), number(1)
        builder.call(ask, [address, to_read, nearest_level, data_not_code])
        return context.get_dummy_value()

    return types.void(array, types.intp), code


@inner
def copy(a: Any, b: Any) -> None:
    """Into matrix b from a, as far as both go: ``b[:] = a`` allocates and is slow to compile."""
    for i in range(min(len(a), len(b))):
        for j in range(min(a.shape[1], b.shape[1])):
            b[i, j] = a[i, j]
