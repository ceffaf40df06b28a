"""The velocity sensor is mounted at an angle: it measures ``R' v``.

R, from roll, pitch and yaw as those of an attitude, turns sensor axes into body axes.
"""

from rov_ident.core.frames import quaternion_from_euler, quaternion_to_matrix
from rov_ident.effects.base import Effect, EffectParameter, Reading


def sense(reading: Reading, roll: float, pitch: float, yaw: float) -> Reading:
    to_body = quaternion_to_matrix(quaternion_from_euler(roll, pitch, yaw))
    return reading._replace(linear=reading.linear @ to_body)


def correct(reading: Reading, roll: float, pitch: float, yaw: float) -> Reading:
    to_body = quaternion_to_matrix(quaternion_from_euler(roll, pitch, yaw))
    return reading._replace(linear=reading.linear @ to_body.T)


EFFECT = Effect(
    place="motion",
    summary="The velocity sensor is mounted at an angle to the body.",
    manoeuvre="straight runs ahead, to the side and down, with a position fix",
    source="Kinsey, Whitcomb (2007), In situ alignment calibration of attitude and Doppler sensors "
    "for precision underwater vehicle navigation, IEEE J. Oceanic Eng. 32(2)",
    parameters=(
        EffectParameter("roll", "rad", "of sensor axes from body axes", 0.0, -3.2, 3.2, 0.05),
        EffectParameter("pitch", "rad", "of sensor axes from body axes", 0.0, -1.6, 1.6, 0.05),
        EffectParameter("yaw", "rad", "of sensor axes from body axes", 0.0, -3.2, 3.2, 0.05),
    ),
    sense=sense,
    correct=correct,
    order=20,
)
