"""The umbilical drags at the point where it is attached: ``f = -k |va| va``, and ``r x f``.

``va = v + omega x r`` is the velocity of that point through the water.
"""

import math

import numpy as np

from rov_ident.effects.base import Effect, EffectParameter
from rov_ident.jit import kernel


@kernel
def wrench(p, t, nu, rotation, out):
    va, f = np.empty(3), np.empty(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        va[i] = nu[i] + nu[3 + j] * p[1 + k] - nu[3 + k] * p[1 + j]
    speed = math.sqrt(va[0] ** 2 + va[1] ** 2 + va[2] ** 2)
    for i in range(3):
        f[i] = -p[0] * speed * va[i]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] += f[i]
        out[3 + i] += p[1 + j] * f[k] - p[1 + k] * f[j]


EFFECT = Effect(
    name="tether_drag",
    place="wrench",
    summary="The tether drags at its point of attachment.",
    beyond="quadratic_damping",
    manoeuvre="turns on the spot, and runs at two speeds along each axis",
    source="Feng, Allen (2004), Evaluation of the effects of the communication cable on the "
    "dynamics of an underwater flight vehicle, Ocean Engineering 31",
    parameters=(
        EffectParameter("k", "N s2/m2", "drag of the tether", 0.0, 0.0, 1e4, 10.0),
        EffectParameter(
            "x", "m", "attachment, forward of the body origin", 0.0, -5.0, 5.0, 0.2, role="place"
        ),
        EffectParameter("y", "m", "to starboard", 0.0, -5.0, 5.0, 0.2, role="place"),
        EffectParameter("z", "m", "below", 0.0, -5.0, 5.0, 0.2, role="place"),
    ),
    wrench=wrench,
)
