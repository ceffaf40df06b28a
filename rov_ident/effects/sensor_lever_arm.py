"""The velocity sensor sits elsewhere than configured: it measures ``v + omega x r``."""

from rov_ident.core.frames import velocity_of_arm
from rov_ident.effects.base import Effect, Reading, vector


def sense(reading: Reading, x: float, y: float, z: float) -> Reading:
    return reading._replace(linear=reading.linear + velocity_of_arm(reading.angular, (x, y, z)))


def correct(reading: Reading, x: float, y: float, z: float) -> Reading:
    return sense(reading, -x, -y, -z)


EFFECT = Effect(
    place="motion",
    summary="The velocity sensor is further from the body origin than configured.",
    manoeuvre="turns on the spot about each axis",
    source="Titterton, Weston (2004), Strapdown Inertial Navigation Technology, ch. 13",
    parameters=vector("x y z", "m", "beyond odometry.position", 5.0, 0.1),
    sense=sense,
    correct=correct,
    order=10,
)
