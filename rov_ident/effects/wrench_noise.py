"""Noise of the wrench's reading that no thruster gives: a constant standard deviation on each axis.

What is read is ``command + noise``. While a command is zero, as between two movements of a stick,
all that is read is noise, which would push a simulated vehicle about; readings within
:data:`IDLE` standard deviations of zero are taken for such. Larger ones are left as they are: what
they have of noise cannot be told from the command.

Beside a command that is either zero or anything, this is the most likely one (hard thresholding;
Donoho, Johnstone 1994).
"""

import numpy as np

from rov_ident.core.jit import kernel
from rov_ident.effects.base import Array, Effect, per_axis

IDLE = 3.0  # of normal noise 0.3 % is beyond, which has 3 % of its power


@kernel
def act(p, state, t, dt, wrench):
    for i in range(6):
        if abs(wrench[i]) <= IDLE * p[i]:
            wrench[i] = 0.0


def noise(**std: float) -> Array:
    return np.array(list(std.values()))


EFFECT = Effect(
    place="input",
    summary="The wrench is read with a constant noise that no thruster gives.",
    manoeuvre="half a minute without any thrust, and the same steps of thrust several times",
    source="Donoho, Johnstone (1994), Ideal spatial adaptation by wavelet shrinkage, Biometrika 81",
    parameters=per_axis("std", "standard deviation", 0.0, 0.0, 1e4, 0.5, ("N", "N m"), moment=0.1),
    act=act,
    noise=noise,
)
