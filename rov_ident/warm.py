"""Compile an estimator in another process than the one that uses it.

What a process has just compiled is not what it would read from the cache: of a function that
several kernels call, each kernel keeps a copy, optimised once more, but who compiles them all in a
row uses the first. Sums in another order differ in their last bits, and the same bag is to give the
same numbers. So one process compiles and ends, and all others read the cache. (A live node does not
wait for it: see :func:`rov_ident.jit.interpret`.)
"""

import contextlib
import os
import subprocess
import sys
import threading
from pathlib import Path

import numba
import numpy as np

from rov_ident.config import Config, from_parameters
from rov_ident.jit import stop_interpreting
from rov_ident.messages import Imu, Odometry, Wrench
from rov_ident.online import Kind, OnlineEstimator
from rov_ident.samples import IMU, ODOMETRY, WRENCH


def is_compiled(kind: Kind) -> bool:
    """Whether all that an estimator runs is in the cache."""
    return _mark(kind).exists()


def compiling(kind: Kind) -> subprocess.Popen[bytes]:
    """The process that compiles an estimator; see :func:`compiler`."""
    return compiler(__name__, kind)


def warm_up(config: Config, kind: Kind) -> None:
    """Have an estimator compiled if need be, wait for it, and load it."""
    if not is_compiled(kind):
        with compiling(kind) as process:
            process.wait()
    load(config, kind)


def load(config: Config, kind: Kind) -> None:
    """Read all that an estimator runs from the cache; what is not there is compiled now."""
    stop_interpreting()
    _rest(config, kind)


def _mark(kind: Kind) -> Path:
    return Path(numba.config.CACHE_DIR) / kind


def compiler(module: str, *arguments: str) -> subprocess.Popen[bytes]:
    """A process that runs a module of ours, which calls :func:`end_with_parent`; the same cache.

    An interrupt is not for it, but for its parent, whose end it follows once it has loaded its
    modules: however that comes about, the pipe to it is closed.
    """
    command = [sys.executable, "-m", module, *arguments]
    cache = {"NUMBA_CACHE_DIR": str(numba.config.CACHE_DIR)}  # it may be a folder for this process
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, start_new_session=True, env=os.environ | cache
    )


def end_with_parent() -> None:
    """End this process, whatever it is doing, as soon as its standard input is closed."""

    def listen() -> None:
        os.read(0, 1)  # not sys.stdin, which an ordinary end would wait for
        os._exit(1)

    threading.Thread(target=listen, daemon=True).start()


def _rest(config: Config, kind: Kind) -> None:
    """Two seconds of a vehicle at rest go through everything."""
    online = OnlineEstimator(config, kind)
    level, zero, none = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(6)
    for stamp in range(50_000_000, 2_000_000_000, 50_000_000):
        online.push(WRENCH, Wrench(stamp, "", zero, zero))
        gravity = np.array([0.0, 0.0, config.gravity])
        online.push(IMU, Imu(stamp, "", level, zero, gravity, zero, zero))
        online.push(ODOMETRY, Odometry(stamp, "", "", zero, level, zero, zero, none))
    online.flush()
    online.report()


def any_vehicle() -> Config:
    """Compiled code is the same for all vehicles."""
    vehicle = {"name": "any", "frame": "frd", "mass": 10.0, "buoyancy": 98.1, "cog": [0.0] * 3}
    vehicle |= {"cob": [0.0] * 3, "inertia": [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]}
    return from_parameters({"vehicle": vehicle, "coefficients": {"X_u": -1.0}})


if __name__ == "__main__":
    end_with_parent()
    kind: Kind = "ukf" if sys.argv[1:] == ["ukf"] else "rls"
    _rest(any_vehicle(), kind)
    with contextlib.suppress(OSError):
        _mark(kind).touch()
