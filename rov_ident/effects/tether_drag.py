"""The umbilical drags at the point where it is attached: ``f = -k |va| va``, and ``r x f``.

``va = v + omega x r`` is the velocity of that point through the water.
"""

import math

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, EffectParameter, vector


@kernel
def wrench(p, t, position, nu, rotation, thrust, out):
    k, x, y, z = p[0], p[1], p[2], p[3]
    u = nu[0] + nu[4] * z - nu[5] * y
    v = nu[1] + nu[5] * x - nu[3] * z
    w = nu[2] + nu[3] * y - nu[4] * x
    drag = -k * math.sqrt(u**2 + v**2 + w**2)
    fx, fy, fz = drag * u, drag * v, drag * w
    out[0] += fx
    out[1] += fy
    out[2] += fz
    out[3] += y * fz - z * fy
    out[4] += z * fx - x * fz
    out[5] += x * fy - y * fx


EFFECT = Effect(
    place="wrench",
    summary="The tether drags at its point of attachment.",
    beyond="quadratic_damping",
    manoeuvre="turns on the spot, and runs at two speeds along each axis",
    source="Feng, Allen (2004), Evaluation of the effects of the communication cable on the "
    "dynamics of an underwater flight vehicle, Ocean Engineering 31",
    parameters=(
        EffectParameter("k", "N s2/m2", "drag of the tether", 0.0, 0.0, 1e4, 10.0),
        *vector("x y z", "m", "attachment", 5.0, 0.2, role="place"),
    ),
    wrench=wrench,
)
