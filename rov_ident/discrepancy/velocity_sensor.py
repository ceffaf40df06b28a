"""Tests whether pose and IMU contradict the velocity sensor. To the dynamics, a wrong factor or
mounting looks like other coefficients, so no test of a fit can detect it."""

import dataclasses

import numpy as np

from rov_ident.config import Config
from rov_ident.discrepancy.sensor_consistency import search
from rov_ident.effects import parameter
from rov_ident.estimation.consistency import SUPPOSED, Test
from rov_ident.offline.delays import MATTERS, surely_behind_imu
from rov_ident.reports.result import NORMAL
from rov_ident.sampling.raw_streams import Streams

MOUNTED = 0.02  # m, rad: about as well as a mounting is measured by hand
_SCALED = 0.02  # half of what fresh water in place of the sea makes of the speed of sound


def tests_of(streams: Streams, config: Config) -> list[Test]:
    """What is asked of a bag's messages; nothing without velocities, of what the configuration
    corrects, or where the attitude is late: 50 ms in a quick turn look like a factor of 0.92. The
    value of a test is that of the parameter that is furthest off.

    Where positions are not measured, only a factor above one is judged: the IMU's noise, in both
    what is compared and what it is compared with, makes it too small on a quiet dive. A mounting is
    judged by the IMU alone, as the heading of a pose is often wrong, or its attitude tilted.

    Noise in what a factor is found with makes it too small, by its share of the power at most
    (Fuller 1987, sec. 1.1): with hardly any motion that is no factor of the sensor.
    """
    if streams.duration < 1.0 or not streams.nu[:, :3].any():
        return []
    if surely_behind_imu(streams, config) > MATTERS:
        return []
    power = max(float(np.sum(np.var(streams.nu[:, :3], axis=0))), 1e-12)
    scaled = _SCALED + 3.0 * config.odometry.linear_std**2 / power
    alone = dataclasses.replace(streams, posed=np.zeros_like(streams.posed))
    tests = []
    for name, sensors, harmless, told in (
        ("velocity_scale", streams, scaled, "reads wrong by a factor, unless a filter does"),
        ("sensor_misalignment", alone, MOUNTED, "is turned against the IMU"),
    ):
        if name in config.effects:
            continue
        found, std = search(sensors, config, [(0.0, streams.duration)])
        of = [(parameter(name, own), x, std[name, own]) for own, x in found.get(name, {}).items()]
        if name == "velocity_scale" and not streams.has_pose:
            of = [each for each in of if each[1] > each[0].null]
        apart = [(abs(x - p.null), harmless + SUPPOSED * s) for p, x, s in of] or [(0.0, harmless)]
        sizes = ", ".join(f"{p.name} {x:.3f} ± {NORMAL * s:.2g}" for p, x, s in of)
        failure = (
            f"pose and IMU say that the velocity sensor {told}, {sizes} (95 %): calibrate it, or "
            f"enter this under effects.{name}"
        )
        value, limit = max(apart, key=lambda pair: pair[0] / pair[1])
        tests.append(Test(f"velocity sensor: {name}", value, limit, failure))
    return tests
