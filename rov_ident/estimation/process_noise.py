"""What moves the vehicle besides the model, as process noise: one definition for both estimators.

Three parts. The noise of the thruster wrench is configured (``wrench``). The righting moment is
that of a measured attitude. What the model lacks is not known beforehand: it starts high and
follows the innovations (``innovation_monitor``).
"""

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.jit import inlined, record
from rov_ident.model.scales import authority

# docs/choices.md: "The floor of the process noise and its first value"
FIRST_FORCE = 0.01  # of the working wrench, lasting a second: before any innovation
LARGEST_FORCE = 0.3  # at most: with more, 30 % of a coefficient would not show in a second

PROCESS = record(
    [
        ("first", "f8", (6,)),  # variance density of the unexplained acceleration to begin with
        ("floor", "f8", (6,)),  # its least
        ("largest", "f8", (6,)),  # and its most
        ("relative", "f8"),  # variance of the wrench relative to its square
        ("least", "f8", (6,)),  # its variance at zero wrench
        ("restoring", "f8", (6, 3)),  # N, N m: times the unit vector down, the wrench of weight
        ("lasting", "f8"),  # s; how long an error of it lasts, at least
    ]
)
"""What does not change: see :func:`process`."""


def process(config: Config) -> NDArray[np.void]:
    """The constants (1,) of PROCESS that a configuration asks for."""
    model, wrench = config.dynamics, config.wrench
    out = np.zeros(1, dtype=PROCESS)
    # the acceleration of a force that lasts a second has this density
    working = authority(model) / np.diag(model.mass_matrix)
    out["first"] = np.square(FIRST_FORCE * working)
    out["floor"] = np.square(config.process_std)
    out["largest"] = np.maximum(out["floor"], np.square(LARGEST_FORCE * working))
    out["relative"] = wrench.relative_std**2
    out["least"] = np.square(wrench.floor_std)
    out["restoring"] = model.body.restoring
    out["lasting"] = wrench.correlation_time
    return out


@inlined
def is_guided(sample):
    """Whether nothing is known of the moments: the vehicle then turns as measured."""
    return sample.wrench_doubt[3] == np.inf


@inlined
def wrench_noise(constants, sample, out):
    """out (6,): variance density [N2 s, (N m)2 s] of the wrench; an error lasts as long as it.

    A tilt by the small angles a turns down d by ``d x a``, and changes the wrench ``R d`` of weight
    by ``(R_i x d) a``. Without this term a vehicle at rest would contradict its righting moment,
    and thrust and coefficients would come out too large and too certain.

    Returns whether some of the wrench is in doubt: then the noise levels are not updated.
    """
    lasting, doubtful, guided = max(constants.lasting, sample.hold), False, is_guided(sample)
    for i in range(6):
        doubt = 0.0 if guided and i >= 3 else sample.wrench_doubt[i]
        known = constants.relative * sample.wrench[i] ** 2 + constants.least[i]
        x, y, z = constants.restoring[i]
        a = y * sample.down[2] - z * sample.down[1]
        b = z * sample.down[0] - x * sample.down[2]
        c = x * sample.down[1] - y * sample.down[0]
        tilted = sample.tilt * (a * a + b * b + c * c)
        out[i] = lasting * (known + doubt) + tilted
        doubtful |= doubt > 0.0
    return doubtful
