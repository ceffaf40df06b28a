"""What has to be compiled for a recursive estimator; how, is known to :mod:`rov_ident.core.jit`."""

import numpy as np

from rov_ident.config import Config, from_parameters
from rov_ident.core.jit import Compiler
from rov_ident.core.messages import IMU, ODOMETRY, WRENCH, Imu, Odometry, Wrench
from rov_ident.estimation.online import Kind, OnlineEstimator


def compiler(kind: Kind) -> Compiler:
    """What compiles all that an estimator runs."""
    return Compiler(exercise, kind)


def ensure_compiled(config: Config, kind: Kind) -> None:
    """Have an estimator compiled if need be, wait for it, and load it."""
    job = compiler(kind)
    job.ensure()  # where that fails, loading compiles
    job.load(config)


def exercise(kind: Kind, config: Config | None = None) -> None:
    """Two seconds of a vehicle at rest go through everything."""
    config = config or any_vehicle()
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
