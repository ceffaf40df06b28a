"""The velocity sensor sits elsewhere than configured: it measures ``v + omega x r``."""

from rov_ident.effects.base import Effect, EffectParameter, Reading
from rov_ident.frames import velocity_of_arm


def sense(reading: Reading, x: float, y: float, z: float) -> Reading:
    return reading._replace(linear=reading.linear + velocity_of_arm(reading.angular, (x, y, z)))


def correct(reading: Reading, x: float, y: float, z: float) -> Reading:
    return reading._replace(linear=reading.linear - velocity_of_arm(reading.angular, (x, y, z)))


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
