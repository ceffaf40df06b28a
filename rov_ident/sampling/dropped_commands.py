"""How often a publisher sends commands, and estimates of those that were dropped on the way.

A command holds until the next. Where one is dropped, the one before holds for too long: the wrench
comes late, and that is learnt as added mass (docs/samples.md). A publisher with a constant period
shows how many are missing, and their neighbours bound what they may have been.
"""

import math
from collections import deque

import numpy as np

from rov_ident.core.messages import Array

SILENCE = 3.0  # longest recent intervals without a command: it acts no longer (docs/samples.md)
_AVERAGE = 0.05  # weight of one interval in the averages: those of the last twenty
_SHORTEN = 0.3  # weight of an interval that is shorter than the period: gaps only make it longer
# The thresholds below: of 10 to 25 % dropped at random all intervals are read rightly, and none is
# misread of a publisher without a constant period; tables in docs/samples.md.
_TOLERANCE = 0.15  # of a period; by which an interval of one may be off, and of several twice
_WINDOW = 50  # intervals; before there are so many nothing is estimated
_REGULAR = 0.65  # share of intervals of one period from which on a publisher counts as regular
_IRREGULAR = 0.5  # below it no longer; lower, as the share varies by a few hundredths
_MOST_DROPPED = 9  # commands in a row; a longer silence is one that was meant


class CommandPeriod:
    """The time between the commands of a publisher.

    ``mean`` [s] is that between commands as they come, without gaps; ``longest`` [s] the longest of
    the last 50. Only within an interval above ``threshold`` [s] may a command have been dropped; it
    is infinite while the publisher is not regular.
    """

    def __init__(self) -> None:
        self.mean = 0.0
        self.longest = self.threshold = math.inf
        self._intervals: deque[float] = deque(maxlen=_WINDOW)  # s
        self._period = 0.0  # s; between those that are sent
        self._regularity = 0.0  # share of the recent intervals that were one period
        self._regular = False

    def update(self, interval: float) -> None:
        """Take in the time [s] between two commands that came."""
        self._intervals.append(interval)
        self.longest = max(self._intervals)
        mean = self.mean or interval
        self.mean = mean + _AVERAGE * (min(interval, SILENCE * mean) - mean)
        if interval < 0.9 * self._period or self._period == 0.0:
            self._period += (_SHORTEN if self._period else 1.0) * (interval - self._period)
        if interval < 1.5 * self._period or not self._regular:
            self._period += _AVERAGE * (interval - self._period)
        single = abs(interval / self._period - 1.0) < _TOLERANCE
        count = len(self._intervals)
        self._regularity += (single - self._regularity) / count
        needed = _IRREGULAR if self._regular else _REGULAR
        self._regular = self._regularity >= needed and count == _WINDOW
        self.threshold = 1.5 * self._period if self._regular else math.inf

    def dropped(self, interval: float) -> int:
        """How many commands were dropped within an interval [s] between two that came."""
        if interval < self.threshold:
            return 0
        periods = interval / self._period
        whole = round(periods)
        near = abs(periods - whole) < 2.0 * _TOLERANCE
        return whole - 1 if near and whole - 1 <= _MOST_DROPPED else 0


def estimated(
    begin: float, before: Array, end: float, after: Array, count: int
) -> list[tuple[float, Array, Array]]:
    """Time [s], mean and variance (6,) of each of ``count`` commands between two that came.

    As if the command had gone from ``before`` (6,) to ``after`` (6,) in one step, at any of them
    with the same probability.
    """
    change, commands = after - before, []
    for j in range(1, count + 1):
        share = j / (count + 1)
        mean, variance = before + share * change, share * (1.0 - share) * np.square(change)
        commands.append((begin + share * (end - begin), mean, variance))
    return commands


def completed(t: Array, commands: Array) -> tuple[Array, Array]:
    """Instants (N,) [s] and commands (N, 6) of a record, with estimates of the dropped ones."""
    period, instants, values = CommandPeriod(), [*t[:1]], [*commands[:1]]
    for k in range(1, len(t)):
        dropped = period.dropped(t[k] - t[k - 1])
        for at, value, _ in estimated(t[k - 1], commands[k - 1], t[k], commands[k], dropped):
            instants.append(at)
            values.append(value)
        period.update(t[k] - t[k - 1])
        instants.append(t[k])
        values.append(commands[k])
    return np.array(instants), np.array(values)
