"""The IMU reads a constant too much, in body axes."""

import numpy as np

from rov_ident.effects.base import Effect, EffectParameter, Reading


def sense(
    reading: Reading, ax: float, ay: float, az: float, gx: float, gy: float, gz: float
) -> Reading:
    return reading._replace(
        specific_force=reading.specific_force + np.array([ax, ay, az]),
        gyro=reading.gyro + np.array([gx, gy, gz]),
    )


def correct(
    reading: Reading, ax: float, ay: float, az: float, gx: float, gy: float, gz: float
) -> Reading:
    return reading._replace(
        specific_force=reading.specific_force - np.array([ax, ay, az]),
        gyro=reading.gyro - np.array([gx, gy, gz]),
    )


EFFECT = Effect(
    name="imu_bias",
    place="motion",
    summary="Accelerometer and gyroscope read a constant too much.",
    manoeuvre="lying still for half a minute, level and tilted",
    source="Titterton, Weston (2004), Strapdown Inertial Navigation Technology, ch. 4",
    parameters=(
        EffectParameter("ax", "m/s2", "accelerometer, forward", 0.0, -10.0, 10.0, 0.1),
        EffectParameter("ay", "m/s2", "accelerometer, starboard", 0.0, -10.0, 10.0, 0.1),
        EffectParameter("az", "m/s2", "accelerometer, down", 0.0, -10.0, 10.0, 0.1),
        EffectParameter("gx", "rad/s", "gyroscope, about forward", 0.0, -1.0, 1.0, 0.01),
        EffectParameter("gy", "rad/s", "gyroscope, about starboard", 0.0, -1.0, 1.0, 0.01),
        EffectParameter("gz", "rad/s", "gyroscope, about down", 0.0, -1.0, 1.0, 0.01),
    ),
    sense=sense,
    correct=correct,
    order=40,
)
