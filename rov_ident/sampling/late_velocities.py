"""Odometry whose linear velocities are older than its stamp, put right before it is queued.

The velocities keep their values: the message is one of the earlier time at which they were true,
with the pose and the angular velocities that the messages around that time had.
"""

from collections import deque

import numpy as np

from rov_ident.core.messages import Array, Odometry
from rov_ident.core.quaternions import turned
from rov_ident.sampling.queues import LONGEST_INTERVAL


class LateVelocities:
    """Turns messages into those of the time of their linear velocities."""

    def __init__(self, delay: float) -> None:
        """``delay`` [s]: how much older the linear velocities are than their stamp."""
        self.delay = delay
        self.clear()

    def clear(self) -> None:
        """Forget the messages so far."""
        self._known: deque[tuple[float, Odometry]] = deque()

    def push(self, t: float, message: Odometry) -> tuple[float, Odometry] | None:
        """The message of ``t`` [s], in core axes, as one of the time of its velocities; None if no
        pose of that time is known."""
        known, at = self._known, t - self.delay
        known.append((t, message))
        while len(known) > 3 and known[2][0] <= at:
            known.popleft()
        if not at < t:  # also where a delay is less than the rounding of t
            return t, message
        i = 1 if len(known) > 2 and known[1][0] <= at else 0
        begin, before = known[i]
        end, after = known[i + 1] if len(known) > 1 else known[0]
        if not begin <= at < end or end - begin > LONGEST_INTERVAL:
            return None
        share = (at - begin) / (end - begin)
        angular = _between(before.angular, after.angular, share)
        if i and begin - known[0][0] <= LONGEST_INTERVAL:
            # At 4 Hz a straight line is off by 6 % of a rate that oscillates at 0.45 Hz.
            earlier, previous = known[0]
            change = (after.angular - before.angular) / (end - begin)
            change -= (before.angular - previous.angular) / (begin - earlier)
            angular = angular + change / (end - earlier) * (at - begin) * (at - end)
        return at, message._replace(
            position=_between(before.position, after.position, share),
            orientation=_attitude(before, after, at - begin, end - at),
            angular=angular,
        )


def _between(before: Array, after: Array, share: float) -> Array:
    return before + share * (after - before)


def _attitude(before: Odometry, after: Odometry, since: float, until: float) -> Array:
    """(4,): from each side at the mean of its own and the present rate (3,), weighted by how near
    it is."""
    share = since / (since + until)
    now = _between(before.angular, after.angular, share)
    forward = turned(before.orientation, 0.5 * since * (before.angular + now))
    backward = turned(after.orientation, -0.5 * until * (after.angular + now))
    if forward @ backward < 0.0:
        backward = -backward
    q = _between(forward, backward, share)
    return q / np.linalg.norm(q)
