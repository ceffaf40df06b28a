"""The heading of the pose is off against the world: a yaw that was set to zero at the start.

``attitude = yaw about world down, after the true attitude``; position and velocities are as they
are. A level vehicle with a velocity sensor that is mounted at that angle shows the same pose and
velocities: only an IMU or the thrust tell one from the other.
"""

from rov_ident.effects.base import Effect, EffectParameter

EFFECT = Effect(
    place="motion",
    summary="The heading of the pose is off by a constant angle, the velocities are right.",
    traits=("dive",),
    manoeuvre="thrust ahead and to the side from rest, with a position fix",
    source="Kinsey, Whitcomb (2007), In situ alignment calibration of attitude and Doppler sensors "
    "for precision underwater vehicle navigation, IEEE J. Oceanic Eng. 32(2)",
    parameters=(EffectParameter("yaw", "rad", "measured less true", 0.0, -3.2, 3.2, 0.05),),
    heading=lambda yaw: yaw,
)
