"""Something taken up at a time: its wet weight pulls down at a point of the body.

``f = mass_wet g`` along world down and ``r x f``, from ``onset`` on. Its inertia is left out: what
a small ROV carries has little beside the vehicle and its added mass.
"""

from rov_ident.core.jit import kernel
from rov_ident.effects.base import ONSET, Effect, EffectParameter, vector
from rov_ident.model.equations import GRAVITY


@kernel
def wrench(p, t, position, nu, rotation, thrust, out):
    if t < p[4]:
        return
    weight = GRAVITY * p[0]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] += weight * rotation[2, i]
        out[3 + i] += weight * (p[1 + j] * rotation[2, k] - p[1 + k] * rotation[2, j])


EFFECT = Effect(
    place="wrench",
    summary="Something heavy (or buoyant) is taken up at a time, or was there from the start.",
    lasting=("buoyancy", "cog_offset", "constant_force"),
    blurs=("added_mass_coupling", "coriolis", "battery_sag"),  # its mass is inertia, too
    manoeuvre="drifting without thrust, level and tilted, before and after it was taken up",
    traits=("weight",),
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 4.1",
    parameters=(
        EffectParameter("mass_wet", "kg", "mass less that of the water", 0.0, -1e4, 1e4, 0.3),
        *vector("x y z", "m", "where it hangs", 5.0, 0.1, role="place"),
        ONSET,
    ),
    wrench=wrench,
)
