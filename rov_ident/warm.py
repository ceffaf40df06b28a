"""Compile an estimator before it is used, in another process.

What a process has just compiled is not what it would read from the cache: of a function that
several kernels call, each kernel keeps a copy, optimised once more, but who compiles them all in a
row uses the first. Sums in another order differ in their last bits, and the same bag is to give the
same numbers. So one process compiles and ends, and all others read the cache.
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
from rov_ident.messages import Imu, Odometry, Wrench
from rov_ident.online import Kind, OnlineEstimator
from rov_ident.samples import IMU, ODOMETRY, WRENCH


def warm_up(config: Config, kind: Kind) -> None:
    """Load all that an estimator runs, compiled by another process if need be."""
    compiled = Path(numba.config.CACHE_DIR) / kind
    # Where that fails, what is used compiles itself.
    if not compiled.exists():
        with compiler(__name__, kind) as process:
            failed = process.wait()
        if not failed:
            with contextlib.suppress(OSError):
                compiled.touch()
    _rest(config, kind)


def compiler(module: str, *arguments: str) -> subprocess.Popen[bytes]:
    """A process that runs a module of ours, which calls :func:`end_with_parent`.

    An interrupt is not for it, but for its parent, whose end it follows once it has loaded its
    modules: however that comes about, the pipe to it is closed.
    """
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)


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
    _rest(any_vehicle(), "ukf" if sys.argv[1:] == ["ukf"] else "rls")
