"""What moves the vehicle besides the model, as process noise: one definition for both estimators.

Two parts. The noise of the thruster wrench is configured (``wrench``). What the model lacks is not
known beforehand: per axis, the density of an unexplained acceleration is found from the innovations
(Mehra 1972; Myers and Tapley 1976). A wrong structure then widens the intervals instead of being
learnt as a coefficient.

It *starts high* and comes down: what an estimator learns with too little process noise weighs too
much for ever, and later data cannot make up for it. And it looks at innovations *added up over a
second*: what they have in common is process noise, while each alone is nearly all the sensor's.
"""

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.excitation import authority
from rov_ident.jit import inlined, record

FIRST_FORCE = 0.01  # of the working wrench, lasting a second: before any innovation
LARGEST_FORCE = 0.3  # the same, at most: more would leave nothing to learn coefficients from
SUM_TIME = 1.0  # s; over which innovations are added up
FIRST_TIME, TIME = 1.0, 20.0  # s; in which twice the power doubles the density: at first, later
STEADY = 4.0  # a squared sum counts for at most this often its variance
LARGEST = 3.0  # standard deviations that a single innovation counts for: outliers are no motion

PROCESS = record(
    [
        ("first", "f8", (6,)),  # variance density of the unexplained acceleration to begin with
        ("floor", "f8", (6,)),  # its least
        ("largest", "f8", (6,)),  # and its most
        ("relative", "f8"),  # variance of the wrench relative to its square
        ("least", "f8", (6,)),  # its variance at zero wrench
        ("lasting", "f8"),  # s; how long an error of it lasts, at least
    ],
)
"""What does not change: see :func:`process`."""

ADAPTATION = record(
    [
        ("density", "f8"),  # of the unexplained acceleration, (m/s2)^2/Hz or (rad/s2)^2/Hz
        ("acting", "f8"),  # the same with the noise of the wrench: set by the estimator; 0: unknown
        ("summed", "f8"),  # normalised innovations added up with fading memory
        ("expected", "f8"),  # variance of that
        ("since", "f8"),  # s since this velocity was measured: counted by the estimator
        ("seen", "f8"),  # s of innovations so far
    ],
)
"""What is known of one axis."""


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
    out["lasting"] = wrench.correlation_time
    return out


@inlined
def wrench_noise(constants, sample, out):
    """out (6,): variance density [N2 s, (N m)2 s] of the wrench; an error lasts as long as it.

    Whether some of the wrench is in doubt, so that nothing about noise can be learnt.
    """
    lasting, doubtful = max(constants.lasting, sample.hold), False
    for i in range(6):
        known = constants.relative * sample.wrench[i] ** 2 + constants.least[i]
        out[i] = lasting * (known + sample.wrench_doubt[i])
        doubtful |= sample.wrench_doubt[i] > 0.0
    return doubtful


def first_adaptation(constants: NDArray[np.void]) -> NDArray[np.void]:
    """(6,) of ADAPTATION, before any innovation."""
    out = np.zeros(6, dtype=ADAPTATION)
    out["density"] = np.maximum(constants["first"][0], constants["floor"][0])
    return out


@inlined
def interrupt(adaptation):
    """After a gap: the sum of innovations begins anew, the density stays."""
    adaptation.summed = 0.0
    adaptation.expected = 0.0
    adaptation.since = 0.0


@inlined
def adapt(adaptation, constants, i, room, innovation):
    """Take in one innovation of axis i, given in its standard deviations.

    ``room`` is the power of summed innovations from which noise is added; 1 is expected. Noise that
    is added by chance does not go below the floor by chance: the less room, the more information is
    lost to that, and the better the intervals where the model is wrong.
    """
    a = adaptation
    keep = np.exp(-a.since / SUM_TIME)
    a.seen += a.since
    a.summed = keep * a.summed + min(max(innovation, -LARGEST), LARGEST)
    a.expected = keep * keep * a.expected + 1.0
    excess = min(a.summed * a.summed / a.expected, STEADY) - room
    blend = min(a.since / min(FIRST_TIME + 0.25 * a.seen, TIME), 0.1)
    density = max(a.density + blend * excess * a.acting, constants.floor[i])
    a.density = min(density, constants.largest[i])
    a.since = 0.0
