"""The velocity sensor sits elsewhere than configured: it measures ``v + omega x r``."""

import numpy as np

from rov_ident.effects.base import Effect, EffectParameter, Reading


def sense(reading: Reading, x: float, y: float, z: float) -> Reading:
    arm = np.array([x, y, z])
    return reading._replace(linear=reading.linear + np.cross(reading.angular, arm))


def correct(reading: Reading, x: float, y: float, z: float) -> Reading:
    arm = np.array([x, y, z])
    return reading._replace(linear=reading.linear - np.cross(reading.angular, arm))


EFFECT = Effect(
    name="sensor_lever_arm",
    place="motion",
    summary="The velocity sensor is further from the body origin than configured.",
    manoeuvre="turns on the spot about each axis",
    source="Titterton, Weston (2004), Strapdown Inertial Navigation Technology, ch. 13",
    parameters=(
        EffectParameter("x", "m", "beyond odometry.position, forward", 0.0, -5.0, 5.0, 0.1),
        EffectParameter("y", "m", "starboard", 0.0, -5.0, 5.0, 0.1),
        EffectParameter("z", "m", "down", 0.0, -5.0, 5.0, 0.1),
    ),
    sense=sense,
    correct=correct,
    order=10,
)
