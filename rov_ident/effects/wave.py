"""A sinusoidal force at the body origin, in a fixed direction of the world, without a moment.

``f sin(2 pi frequency t + phase)``: first-order waves at a depth where the vehicle is small beside
the wavelength.
"""

import math

from rov_ident.effects.base import Effect, EffectParameter
from rov_ident.jit import kernel


@kernel
def wrench(p, t, nu, rotation, out):
    swing = math.sin(2.0 * math.pi * p[3] * t + p[4])
    for i in range(3):
        for j in range(3):
            out[i] += rotation[j, i] * (p[j] * swing)


EFFECT = Effect(
    name="wave",
    place="wrench",
    summary="Waves push back and forth with one frequency.",
    manoeuvre="keeping station without thrust for ten periods, at two headings",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 10.2",
    parameters=(
        EffectParameter("fx", "N", "amplitude north", 0.0, -1e5, 1e5, 3.0),
        EffectParameter("fy", "N", "amplitude east", 0.0, -1e5, 1e5, 3.0),
        EffectParameter("fz", "N", "amplitude down", 0.0, -1e5, 1e5, 3.0),
        EffectParameter("frequency", "Hz", "frequency", 0.2, 0.01, 5.0, 0.2, role="frequency"),
        EffectParameter(
            "phase", "rad", "phase at the first message", 0.0, -6.3, 6.3, 1.0, role="phase"
        ),
    ),
    wrench=wrench,
)
