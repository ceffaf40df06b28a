"""What the innovations of an estimator tell about noise, outliers and changes of the vehicle.

One monitor an axis, the same for both estimators. It takes in each normalised innovation, in its
standard deviations; its square (NIS, Bar-Shalom 2001, sec. 5.4) is 1 in the mean if all is well.

* *Process noise.* The density of an unexplained acceleration is found from the innovations (Mehra
  1972; Myers and Tapley 1976): a wrong structure then widens the intervals instead of being learnt
  as a coefficient. It starts high and comes down: what an estimator learns with too little process
  noise weighs too much for ever. Innovations are added up over a second: what they have in common
  is process noise, while each alone is nearly all the sensor's.
* *Whiteness.* Noise that comes down where the vehicle rests is not what it does in motion: the
  power of the sums, averaged over a minute of motion, says whether the model explains that, too.
* *A change of the vehicle* is a NIS that stays large in the average over two seconds, against the
  average of the last minute: that of a rough model is large at all times.
* *An outlier* is a NIS beyond the gate. One alone is the sensor's, and refused. After a second one
  it was the wrench: the velocity is lost, and restarts from the measurement.
"""

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.jit import inlined, record
from rov_ident.core.whiteness import BY_CHANCE, LARGEST, averaged, summed_up

# "Constants of the process noise" and "Forgetting" are tables of docs/choices.md.
FIRST_TIME, TIME = 1.0, 20.0  # s; twice the power doubles the density: at first, later (same table)
_FASTEST = 0.1  # the most by which one innovation moves an average: ten are needed for anything
STEADY = 4.0  # a squared sum counts for at most this: 2 sigma, beyond which 5 % of normal ones are
NIS_TIME = 2.0  # s; over which the NIS is averaged ("Forgetting")
LEVEL_TIME = 60.0  # s; over which the usual NIS is averaged: several manoeuvres of ten seconds
# s of an axis's own motion, in which innovations teach and do not test: what they owe to
# coefficients far off is expected of them to first order only ("Does the model explain the data?")
_LESSON = 5.0
_LOST = 2  # outliers in a row: by chance as rare as the square of the share of outliers

MONITOR = record(
    [
        ("density", "f8"),  # of the unexplained acceleration, (m/s2)^2/Hz or (rad/s2)^2/Hz
        ("acting", "f8"),  # the same with the noise of the wrench: set by the estimator; 0: unknown
        ("summed", "f8"),  # normalised innovations added up with fading memory
        ("expected", "f8"),  # variance of that, of white ones
        ("lasting", "f8"),  # standard deviation of that for what is considered, not estimated
        ("since", "f8"),  # s since this velocity was measured: counted by the estimator
        ("seen", "f8"),  # s of innovations so far
        ("driven", "f8"),  # s in which this velocity moved, of these
        ("judged", "f8"),  # s since which the power is averaged
        ("power", "f8"),  # of normalised sums, averaged: 1 is expected
        ("nis", "f8"),  # averaged: 1 is expected
        ("usual", "f8"),  # averaged for longer
        ("outliers", "i8"),  # in a row: of linear and of angular velocity, with their first axes
    ]
)
"""What is known of one axis."""


def first_monitor(process: NDArray[np.void]) -> NDArray[np.void]:
    """(6,) of MONITOR, before any innovation; ``process`` (1,) of PROCESS."""
    out = np.zeros(6, dtype=MONITOR)
    out["density"] = np.maximum(process["first"][0], process["floor"][0])
    out["power"] = out["nis"] = out["usual"] = 1.0
    return out


@inlined
def interrupt(m):
    """After a gap the sum of innovations begins anew; density and NIS stay."""
    m.summed = 0.0
    m.expected = 0.0
    m.lasting = 0.0
    m.since = 0.0


@inlined
def watch(m, process, i, room, moving, own, gate, innovation, considered):
    """Take in a normalised innovation of axis i; whether it is an outlier.

    ``moving``: whether any velocity is; where none is (on the ground, on deck), what holds the
    vehicle says nothing of a dive. ``own``: whether that of this axis is. ``room``: the power of
    summed innovations, 1 being expected, from which process noise is added; noise added by chance
    does not go away by chance, and the less room, the more information it costs. There is none
    while the power of the last minute is no chance: a model that fails in some manoeuvres only
    would, with the noise of all others, be learnt from as if it were right.

    ``considered``: the correlation of the innovation with the error of what is considered and not
    estimated. That stays the same, so its share of successive innovations adds up, not its square.
    """
    nis = innovation * innovation
    # a single kick counts for no more than LARGEST: what has changed shows again and again
    counted = min(nis if moving else 1.0, LARGEST**2)
    m.nis += min(m.since / NIS_TIME, 1.0) * (counted - m.nis)
    blend = min(m.since / min(m.seen + NIS_TIME, LEVEL_TIME), 1.0)
    m.usual += blend * (counted - m.usual)
    if moving:
        m.seen += m.since
        m.driven += m.since if own else 0.0
        m.summed, m.expected, keep = summed_up(m.summed, m.expected, m.since, innovation)
        m.lasting = keep * m.lasting + considered
        expected = m.expected + m.lasting * m.lasting
        if m.seen > TIME and m.driven > _LESSON:
            m.judged += m.since
            m.power = averaged(m.power, m.judged, m.since, m.summed, expected)
        allowed = room if m.power < BY_CHANCE**2 else 1.0
        excess = min(m.summed * m.summed / expected, STEADY) - allowed
        blend = min(m.since / min(FIRST_TIME + 0.25 * m.seen, TIME), _FASTEST)
        density = max(m.density + blend * excess * m.acting, process.floor[i])
        m.density = min(density, process.largest[i])
        m.since = 0.0
    else:
        interrupt(m)
    return nis > gate * gate


@inlined
def has_changed(m, threshold):
    """Whether the NIS of an axis is ``threshold`` times what is usual."""
    return m.nis > threshold * max(m.usual, 1.0)


@inlined
def lost(monitor, first, outlier):
    """Whether the linear (first = 0) or angular velocity (3) is lost, after one more measurement.

    ``outlier``: whether that is refused, as one of its components is an outlier.
    """
    m = monitor[first]
    m.outliers = m.outliers + 1 if outlier else 0
    return m.outliers >= _LOST
