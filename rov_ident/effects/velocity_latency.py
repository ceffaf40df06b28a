"""Linear velocities (a filter, a slow link) are older than their stamp: ``linear(stamp) = v(stamp -
delay)``, in the body axes of then. Pose and angular velocities are those of the stamp."""

from rov_ident.effects.base import Effect, EffectParameter


def late(delay: float) -> float:
    return delay


EFFECT = Effect(
    place="motion",
    summary="The linear velocities are late against pose, angular velocities and thrust.",
    manoeuvre="quick reversals of thrust along each axis, with a position fix or an IMU",
    source="Kelly, Sukhatme (2014), A general framework for temporal calibration of multiple "
    "proprioceptive and exteroceptive sensors, Experimental Robotics (Springer)",
    parameters=(EffectParameter("delay", "s", "age at the stamp", 0.0, 0.0, 1.0, 0.05),),
    late=late,
)
