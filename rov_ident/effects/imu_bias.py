"""The IMU reads a constant too much, in body axes."""

import numpy as np

from rov_ident.effects.base import Effect, Reading, vector


def sense(
    reading: Reading, ax: float, ay: float, az: float, gx: float, gy: float, gz: float
) -> Reading:
    force = reading.specific_force + np.array([ax, ay, az])
    return reading._replace(specific_force=force, gyro=reading.gyro + np.array([gx, gy, gz]))


def correct(reading: Reading, **bias: float) -> Reading:
    return sense(reading, **{name: -value for name, value in bias.items()})


EFFECT = Effect(
    place="motion",
    summary="Accelerometer and gyroscope read a constant too much.",
    manoeuvre="lying still for half a minute, level and tilted",
    source="Titterton, Weston (2004), Strapdown Inertial Navigation Technology, ch. 4",
    parameters=(
        *vector("ax ay az", "m/s2", "accelerometer", 10.0, 0.1),
        *vector("gx gy gz", "rad/s", "gyroscope, about", 1.0, 0.01),
    ),
    sense=sense,
    correct=correct,
    order=40,
)
