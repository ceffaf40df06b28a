"""Queues that align the messages of several topics, and determine the instants of the samples.

Topics come at their own rates and phases. Only stamps decide, never the time of arrival.
"""

import math
from collections import deque
from collections.abc import Collection
from typing import NamedTuple

from rov_ident.core.messages import DRIVE, IMU, ODOMETRY, WRENCH, Array, Message

MERGE = 0.05  # s; an odometry message is carried to the IMU message that follows this closely: one
# interval of the slowest odometry beside which an IMU is of use, 20 Hz
LONGEST_INTERVAL = 0.5  # s without a measurement: nothing is interpolated across, all restarts
_LONGEST_WAIT = 1.0  # s; a choice: a topic that is later than this is not waited for
_MARGIN = 1.25  # a choice: a topic is waited for as long as it was late, times this
_LONGEST_QUEUE = 10.0  # s; a guard: of commands that are kept while nothing else comes
_SUCCESSORS = 2  # further messages of the IMU tell whether one is an outlier


class Waiting(NamedTuple):
    """A message in core axes with its time; ``values`` (6,) of an IMU or wrench for despiking."""

    t: float  # s
    message: Message
    values: Array


class Instant(NamedTuple):
    """The time [s] of the next sample, and which topics have a message for it."""

    t: float
    has_imu: bool
    has_odometry: bool


class Queues:
    """The messages of each topic that no sample has used yet, and who waits for whom."""

    def __init__(self) -> None:
        self.grace = 0.0  # s; how long a silent topic is waited for
        self._lateness = 0.0  # s; the same, after a topic was that late
        self._drives: tuple[str, ...] = ()
        self.clear()

    def clear(self) -> None:
        """Forget all messages; how late topics have been is kept."""
        self.odometry: deque[Waiting] = deque()
        self.imu: deque[Waiting] = deque()
        self.wrench: deque[Waiting] = deque()
        self._by_role = {ODOMETRY: self.odometry, IMU: self.imu, WRENCH: self.wrench}
        self._first = math.nan  # s
        self._latest = -math.inf  # s; of all topics
        # s; no topic will bring anything before this. A sample waits for one command more than it
        # uses: that one tells whether the last used is an outlier.
        self._reach = dict.fromkeys((*self._by_role, *self._drives), -math.inf)
        self._newest_command = -math.inf  # s

    def __getitem__(self, role: str) -> deque[Waiting]:
        return self._by_role[role]

    def await_drive(self, used: Collection[str]) -> None:
        """Whether there is a topic of fins and shafts, whose messages are kept elsewhere."""
        self._drives = (DRIVE,) if used else ()
        self._reach = {
            role: self._reach.get(role, -math.inf) for role in (*self._by_role, *self._drives)
        }

    def reached(self, role: str, t: float) -> None:
        """A topic has come to t [s]."""
        if math.isnan(self._first):
            self._first = t
        self._latest = max(self._latest, t)
        self._reach[role] = t

    def add(self, role: str, waiting: Waiting) -> None:
        """Append a message to those of its topic."""
        t, queue = waiting.t, self._by_role[role]
        self.reached(role, t)
        queue.append(waiting)
        if role == WRENCH:
            self._reach[role] = self._newest_command if self._newest_command > -math.inf else t
            self._newest_command = t
            while t - queue[0].t > _LONGEST_QUEUE:
                queue.popleft()

    def wait_longer(self, t: float) -> None:
        """A message at t [s] came after its sample: wait as long as that from now on."""
        lateness = _MARGIN * (self._latest - t)
        if lateness <= _LONGEST_WAIT:
            self._lateness = max(self._lateness, lateness)

    def next_instant(self, final: bool) -> Instant | None:
        """The instant of the next sample; None if a message may still come for it.

        ``final``: none will.
        """
        odometry_t = self.odometry[0].t if self.odometry else math.inf
        imu_t = self.imu[0].t if self.imu else math.inf
        if odometry_t == imu_t == math.inf:
            return None
        merged = 0.0 <= imu_t - odometry_t <= MERGE and not (
            len(self.odometry) > 1 and self.odometry[1].t <= imu_t
        )
        has_imu = merged or imu_t < odometry_t
        t = imu_t if has_imu else odometry_t
        if not (final or self._complete(t)):
            return None
        if has_imu and len(self.imu) <= _SUCCESSORS and not (final or self._is_too_far_ahead(t)):
            return None
        return Instant(t, has_imu, merged or not has_imu)

    def _is_too_far_ahead(self, t: float) -> bool:
        """Whether the newest stamp is so far ahead of t [s] that nothing more is waited for."""
        return self._latest - t > max(self.grace, self._lateness)

    def _complete(self, t: float) -> bool:
        """Whether no topic can still bring a message up to t [s], or it is not worth waiting."""
        if self._is_too_far_ahead(t):
            return True
        grace = max(self.grace, self._lateness)
        for reach in self._reach.values():
            if reach < t and t - max(reach, self._first) <= grace:
                return False
        return True
