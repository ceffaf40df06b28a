"""The linear velocities are older than their stamps say, against attitude, rates and thrust.

No function of one instant: the sampler and the simulated sensors move the velocities in time.
"""

from rov_ident.effects.base import Effect, EffectParameter

EFFECT = Effect(
    place="motion",
    summary="The linear velocities come late against the other sensors.",
    manoeuvre="steps of thrust and quick turns, with an IMU",
    source="Kinsey, Whitcomb (2007), In situ alignment calibration of attitude and Doppler sensors "
    "for precision underwater vehicle navigation, IEEE J. Oceanic Eng. 32(2)",
    parameters=(EffectParameter("delay", "s", "of linear velocities", 0.0, 0.0, 1.0, 0.05),),
)
