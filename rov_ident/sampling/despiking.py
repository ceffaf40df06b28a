"""Despiking of IMU and commands: lone outliers, found by what comes before and after them.

One rule for every number of a message, in the spirit of Hampel's filter (Hampel 1974; Pearson
2002), but for signals that step. A number is *supported* if a neighbour is near: the one before,
the one after, or both those two messages away (a command that alternates). Near is within
``GATE`` times the usual distance, recently, to the nearest neighbour. A number without support is

* an outlier where what was before comes again: that takes its place;
* else something at a step, which may be one message late. It is clipped to the range of its
  neighbours, and its variance is their mean squared distance.

A step or a ramp has support on one side, or lies between both, and passes as it came.
"""

from collections import Counter, deque

import numpy as np

from rov_ident.config import Config
from rov_ident.core.jit import kernel
from rov_ident.core.messages import IMU, WRENCH, Array, Imu, Message, Wrench
from rov_ident.model.scales import authority
from rov_ident.sampling.queues import Waiting

GATE = 5.0  # times the usual distance; as the gates of the estimators: 1 of 1e6 of a Gaussian
_MEMORY = 0.02  # weight of one message in the usual distance: that of the last fifty
# Less than these distances is always usual. With lower ones turns of small righting moments were
# taken for outliers, up to twenty of a thousand messages (docs/trust.md, "Outliers").
_COMMAND_FLOOR = 0.004  # of the working wrench
_COMMAND_SHARE = 0.03  # of the command itself: noise of 5 % is to pass
_ACCELERATION_FLOOR = 0.2  # m/s2; thrust steps by 3 m/s2 and vibration are to pass
_EXACT = 0.0004  # of the working wrench; the same beside a level that is held exactly, which has no
# noise for an outlier to hide in (docs/trust.md: force Z was off by 2 sigma in one dive)
_CALM = 3.0  # times as far as its neighbours move is what stands between two calm levels, not on
# a way from one to the other
_BRIEF, _LASTING = 0.02, 0.1  # s; a message this far from the next is brief: nobody means it; or it
# lasts: a pilot's tap, or a turn of the vehicle; in between, in proportion
_MEANT = 0.2  # of working wrench and command; with GATE all of it, for a command that lasts
_FULL_SCALE = 0.5  # of the working wrench: in a whole bag no smaller command is an outlier


def measured_values(message: Message) -> Array:
    """(6,) of what an IMU or a wrench message measures."""
    if isinstance(message, Imu):
        return np.concatenate([message.angular_velocity, message.linear_acceleration])
    assert isinstance(message, Wrench)
    return np.concatenate([message.force, message.torque])


def largest_usual(role: str, config: Config) -> Array:
    """(6,): deviations from the median below which no message of a whole bag is an outlier."""
    if role == WRENCH:
        return _FULL_SCALE * authority(config.dynamics)
    return GATE * _imu_floor(config)


def _imu_floor(config: Config) -> Array:
    return np.repeat([config.imu.gyro_std, _ACCELERATION_FLOOR], 3)


class Despiker:
    """Judges the messages of IMU and wrench by those before and after them, and counts outliers."""

    def __init__(self, config: Config, counts: Counter[str]) -> None:
        self._counts = counts
        self.configure(config)
        self.clear()

    def configure(self, config: Config) -> None:
        self._imu_floor = _imu_floor(config)
        self._working = authority(config.dynamics)
        agility = self._working / np.diag(config.dynamics.mass_matrix) / GATE
        self._turning = np.concatenate([agility[3:], np.zeros(3)])  # rad/s2
        self._thrust = np.concatenate([np.zeros(3), agility[:3]])  # m/s2

    def clear(self) -> None:
        # values of the last two messages as they came, and of the last two without outliers
        self._past: dict[str, Array] = {}
        self._usual = {IMU: np.zeros(6), WRENCH: np.zeros(6)}  # mean square distances

    def judge(self, role: str, queue: deque[Waiting]) -> tuple[Array, bool, Array]:
        """Judge the first message of a queue by the two behind it.

        Its values (6,) without outliers, each corrected by itself, as a step of another axis is not
        to come late for it; whether there was one; and the variances (6,) of what may be wrong.
        """
        past, values = self._past.get(role), queue[0].values
        found, variance = False, np.zeros(6)
        if past is None:
            if len(queue) > 1:  # the first of all may be an outlier like any other
                variance = (queue[1].values - values) ** 2
            self._past[role] = np.array([values] * 4)
        elif len(queue) == 1:
            past[:] = past[1], values, past[3], values
        else:
            interval, after = queue[1].t - queue[0].t, queue[1].values
            last = queue[2].values if len(queue) > 2 else after
            lasts = min(max((interval - _BRIEF) / (_LASTING - _BRIEF), 0.0), 1.0)
            rates = 0
            if role == WRENCH:
                floor = (_COMMAND_FLOOR + lasts * (_MEANT - _COMMAND_FLOOR)) * self._working
                share = _COMMAND_SHARE + lasts * (_MEANT - _COMMAND_SHARE)
            else:
                floor, share = self._imu_floor, 0.0
                if lasts > 0.0:  # what the working wrench can do in this time
                    floor = floor + lasts * (interval * self._turning + self._thrust)
                if len(queue) > 2 and queue[2].t - queue[0].t < _LASTING:
                    rates = 3
            found = despike(
                past, values, after, last, variance, self._usual[role], floor, share,
                _EXACT * self._working, rates, role == WRENCH,
            )  # fmt: skip
        if found:
            self._counts[f"{role}: outlier between its neighbours"] += 1
        return values, found, variance


@kernel
def despike(past, here, after, last, variance, usual, floor, share, exact, rates, is_command):
    """Correct the outliers among the values ``here`` (n,); whether there was one.

    ``after`` and ``last`` (n,) are the next two messages; ``past`` (4, n) the last two as they came
    and the last two without outliers, which is brought up to date (of an IMU, whose outliers are
    dropped as a whole, without these). ``usual`` (n,) are the mean squares of distances to the
    nearest neighbour and are brought up to date; ``floor`` (n,), and ``share`` of the number
    itself, is always usual. ``variance`` (n,) is left with the mean square of what may be wrong.

    The first ``rates`` numbers have inertia: two in a row are outliers, too, if what was before
    comes again.
    """
    found = False
    for i in range(len(here)):
        before, earlier, came = past[3, i], past[2, i], here[i]
        there, back, later = abs(came - before), abs(after[i] - came), abs(last[i] - came)
        former = abs(came - past[0, i])
        distance = min(there, back, max(later, former))
        spread = max(np.sqrt(usual[i]), floor[i])
        near = GATE * max(spread, share * min(abs(before), abs(after[i])))
        returns = min(abs(after[i] - before), abs(last[i] - before)) <= near
        again = 3.0 * near  # what has inertia turns on meanwhile: three intervals
        two = i < rates and abs(last[i] - before) <= again
        two = two and min(there, abs(last[i] - after[i])) > 2.0 * again
        returns = returns or two
        past[0, i], past[1, i] = past[1, i], came
        # between two levels, or beyond the new one by less than the step: controllers overshoot
        passes = back <= abs(after[i] - before)
        if two or (distance > near and (returns or not passes)):
            found = True
            if returns:
                here[i] = before
                variance[i] = there * there if later <= near else 0.0  # the first that alternates?
            else:
                low, high = min(after[i], last[i]), max(after[i], last[i])
                here[i] = min(max(before, low), high)  # the median of the neighbours
                variance[i] = 0.5 * (there * there + back * back)
            continue
        usual[i] += _MEMORY * (min(distance, GATE * spread) ** 2 - usual[i])
        moves, move_on = abs(before - earlier), abs(last[i] - after[i])
        on_a_way = (came - before) * (after[i] - came) > 0.0
        moves = max(moves, move_on) if on_a_way else min(moves, move_on)
        near = max(GATE * spread, _CALM * moves)
        if is_command and back < near < there and after[i] == last[i]:
            near = GATE * exact[i]
        if min(distance, former) > near:
            variance[i] = 0.5 * (there * there + back * back)
    if is_command or not found:
        for i in range(len(here)):
            past[2, i], past[3, i] = past[3, i], here[i]
    return found
