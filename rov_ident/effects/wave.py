"""A sinusoidal force at the body origin, in a fixed direction of the world, without a moment.

``f sin(2 pi frequency t + phase)``: first-order waves at a depth where the vehicle is small beside
the wavelength.
"""

import math

from rov_ident.core.jit import kernel
from rov_ident.effects.base import NED, Effect, EffectParameter, vector


@kernel
def wrench(p, t, position, nu, rotation, thrust, out):
    swing = math.sin(2.0 * math.pi * p[3] * t + p[4])
    for i in range(3):
        for j in range(3):
            out[i] += rotation[j, i] * (p[j] * swing)


EFFECT = Effect(
    place="wrench",
    summary="Waves push back and forth with one frequency.",
    traits=("dive",),
    manoeuvre="keeping station without thrust for ten periods, at two headings",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 10.2",
    parameters=(
        *vector("fx fy fz", "N", "amplitude", 1e5, 3.0, NED),
        EffectParameter("frequency", "Hz", "frequency", 0.2, 0.01, 5.0, 0.2, role="frequency"),
        EffectParameter("phase", "rad", "at the first message", 0.0, -6.3, 6.3, 1.0, role="phase"),
    ),
    wrench=wrench,
)
