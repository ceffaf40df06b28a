"""Fins stand at another angle than the one that is read: ``delta = read + offset``."""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Effect, per_fin


@kernel
def steer(p, state, dt, inputs):
    for k in range(2):
        for i in range(3):
            inputs[k, i] += p[i]


EFFECT = Effect(
    place="input",
    summary="Fins stand at another angle than is read: their zero is not where it should be.",
    manoeuvre="steady runs with fins at zero, at two speeds, and the same turn to either side",
    source="Prestero (2001), Verification of a six-degree of freedom simulation model for the "
    "REMUS autonomous underwater vehicle, MIT, ch. 6: zero offsets of the fins, found from dives",
    parameters=per_fin("zero of", 0.0, -0.5, 0.5, 0.02),
    steer=steer,
    order=30,
)
