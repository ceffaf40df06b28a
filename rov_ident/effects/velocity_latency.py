"""Linear velocities are older than their stamp: a filter or a link between sensor and odometry.

``linear(stamp) = v(stamp - delay)``, in the body axes of that time. Pose and angular velocities are
those of the stamp.
"""

from rov_ident.effects.base import Effect, EffectParameter

EFFECT = Effect(
    place="motion",
    summary="The linear velocities are late against pose, angular velocities and thrust.",
    blurs=("velocity_scale",),  # a filter makes quick motion smaller, too
    manoeuvre="quick reversals of thrust along each axis, with a position fix or an IMU",
    source="Kelly, Sukhatme (2014), A general framework for temporal calibration of multiple "
    "proprioceptive and exteroceptive sensors, Experimental Robotics (Springer)",
    parameters=(EffectParameter("delay", "s", "age at the stamp", 0.0, 0.0, 1.0, 0.05),),
    late=lambda delay: delay,
)
