"""Thrust falls with the speed of advance: ``X (1 - k u sign(X))``, and so along Y with v, Z with w.

A propeller that moves through the water towards its thrust meets it faster, and gives less. The
moments are left as they are: thrusters on either side move opposite ways, which cancels to first
order.
"""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, EffectParameter


@kernel
def wrench(p, t, position, nu, rotation, thrust, out):
    for i in range(3):
        out[i] -= p[0] * nu[i] * abs(thrust[i])


EFFECT = Effect(
    place="wrench",
    summary="Thrust falls with the speed through the water along it.",
    manoeuvre="equal steps of thrust from rest and at speed, along each axis",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 9.5",
    parameters=(EffectParameter("k", "s/m", "share lost for each m/s", 0.0, 0.0, 5.0, 0.1),),
    wrench=wrench,
)
