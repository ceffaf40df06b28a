"""When a publisher's demands come, and what those that got lost on the way may have been.

A demand holds until the next. Where one is lost, the one before would hold for too long: the
wrench comes late, and that is learnt as added mass (docs/samples.md). Of a publisher that keeps
time it shows what is missing, and the neighbours tell what it may have been.
"""

import math
from collections import deque

import numpy as np

from rov_ident.messages import Array

LOST = 3.0  # times the longest interval between demands of late: another one is missing
_BLEND = 0.05  # of one interval in what is usual
_SHORTEN = 0.3  # of one that is shorter than a beat in the beat
_EVEN = 0.15  # of a beat; by which an interval of one may be off, and of several twice
_OF_LATE = 50  # intervals; before there are so many nothing is guessed
_REGULAR = 0.65  # share of one beat: before it is reached silence is meant, as nothing changes
_IRREGULAR = 0.5  # below it time is kept no longer; lower, as the share varies by a few hundredths
_MOST = 9  # demands in a row that may get lost; a longer silence is one that was meant


class Beat:
    """The time between the demands of a publisher.

    ``usual`` [s] is the mean between those that come, of which a gap is no part, ``longest`` the
    longest of late. Within ``patience`` [s] none has got lost; of who keeps no time none ever has.
    """

    def __init__(self) -> None:
        self.usual = 0.0
        self.longest = self.patience = math.inf
        self._intervals: deque[float] = deque(maxlen=_OF_LATE)  # s
        self._period = 0.0  # s; between those that are sent
        self._regular = 0.0  # share of the intervals, of late, that were one beat
        self._keeps_time = False

    def hear(self, interval: float) -> None:
        """Take in the time [s] between two demands that came."""
        self._intervals.append(interval)
        self.longest = max(self._intervals)
        usual = self.usual or interval
        self.usual = usual + _BLEND * (min(interval, LOST * usual) - usual)
        if interval < 0.9 * self._period or self._period == 0.0:
            self._period += (_SHORTEN if self._period else 1.0) * (interval - self._period)
        if interval < 1.5 * self._period or not self._keeps_time:
            self._period += _BLEND * (interval - self._period)
        even = abs(interval / self._period - 1.0) < _EVEN
        heard = len(self._intervals)
        self._regular += (even - self._regular) / heard
        needed = _IRREGULAR if self._keeps_time else _REGULAR
        self._keeps_time = self._regular >= needed and heard == _OF_LATE
        self.patience = 1.5 * self._period if self._keeps_time else math.inf

    def lost(self, interval: float) -> int:
        """How many demands got lost within an interval [s]."""
        if interval < self.patience:
            return 0
        beats = interval / self._period
        whole = round(beats)
        return whole - 1 if abs(beats - whole) < 2.0 * _EVEN and whole - 1 <= _MOST else 0


def between(
    begin: float, before: Array, end: float, after: Array, count: int
) -> list[tuple[float, Array, Array]]:
    """Time, value and variance (6,) of each of ``count`` demands between two that came.

    As if it had gone from the one to the other in one step, nobody knows when.
    """
    change, guesses = after - before, []
    for j in range(1, count + 1):
        share = j / (count + 1)
        value, variance = before + share * change, share * (1.0 - share) * np.square(change)
        guesses.append((begin + share * (end - begin), value, variance))
    return guesses


def completed(t: Array, demands: Array) -> tuple[Array, Array]:
    """Instants (N,) and demands (N, 6) of a record, with guesses at those that got lost."""
    beat, instants, values = Beat(), [*t[:1]], [*demands[:1]]
    for k in range(1, len(t)):
        lost = beat.lost(t[k] - t[k - 1])
        for at, value, _ in between(t[k - 1], demands[k - 1], t[k], demands[k], lost):
            instants.append(at)
            values.append(value)
        beat.hear(t[k] - t[k - 1])
        instants.append(t[k])
        values.append(demands[k])
    return np.array(instants), np.array(values)
