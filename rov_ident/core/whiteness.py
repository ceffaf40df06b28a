"""Whether innovations are white: the power of their sums, which is then 1 in the mean.

An error of the model, or a disagreement of two sensors, lasts longer than noise: it shows in sums
over a second, and is lost in a single innovation.
"""

import numpy as np

from rov_ident.core.jit import inlined

SUM_TIME = 1.0  # s; over which innovations are added up ("Constants of the process noise")
LARGEST = 3.0  # sigma that one innovation counts for at most: 0.3 % of normal ones are larger
AVERAGE_TIME = 60.0  # s; over which the power is averaged: several manoeuvres of ten seconds
JUDGED_TIME = 20.0  # s; after which it is known: chance then takes its root beyond 1.5 in 0.1 %
BY_CHANCE = 1.25
"""Root of the power that chance reaches in one dive of a thousand (table in docs/live.md)."""
_MOST = 100.0  # 10 sigma: a sum counts for no more, or one error would weigh for minutes


@inlined
def summed_up(summed, expected, since, innovation):
    """The fading sum of normalised innovations and its variance, if they are white, after one more,
    ``since`` seconds after the one before; and the share of older ones that is left."""
    keep = np.exp(-since / SUM_TIME)
    counted = min(max(innovation, -LARGEST), LARGEST)
    return keep * summed + counted, keep * keep * expected + 1.0, keep


@inlined
def averaged(power, judged, since, summed, expected):
    """The mean ``power`` after one more sum, of variance ``expected``; ``since`` seconds after the
    one before, ``judged`` seconds after the first."""
    blend = min(since / min(judged + SUM_TIME, AVERAGE_TIME), 1.0)
    return power + blend * (min(summed * summed / expected, _MOST) - power)
