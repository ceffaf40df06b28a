"""The velocity sensor reads too much or too little, in proportion: a wrong speed of sound."""

from rov_ident.effects.base import Effect, EffectParameter, Reading


def sense(reading: Reading, scale: float) -> Reading:
    return reading._replace(linear=scale * reading.linear)


def correct(reading: Reading, scale: float) -> Reading:
    return reading._replace(linear=reading.linear / scale)


EFFECT = Effect(
    place="motion",
    summary="The velocity sensor reads a constant factor too much or too little.",
    manoeuvre="straight runs ahead, to the side and down, with a position fix",
    source="Kinsey, Whitcomb (2007), In situ alignment calibration of attitude and Doppler sensors "
    "for precision underwater vehicle navigation, IEEE J. Oceanic Eng. 32(2)",
    parameters=(EffectParameter("scale", "1", "measured over true", 1.0, 0.1, 10.0, 0.03),),
    sense=sense,
    correct=correct,
    order=30,
)
