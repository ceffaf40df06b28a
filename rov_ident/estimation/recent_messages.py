"""Keeps recent messages, which are sampled again once a lag or a delay is known better.

A sample has the wrench that acts with the lag that was supposed when it was made, and is right for
another lag to first order only. So what was learnt from samples of a wrong lag is given up, and the
same messages are learnt from again ("Times" in docs/live.md).
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.messages import Message
from rov_ident.sampling.sample import joined
from rov_ident.sampling.sampler import Sampler

LOOK_BACK = 120.0
"""s; a choice: in two minutes a lag becomes known, and to learn from them again takes a second or
two, in which messages wait."""
_MOST = 50_000  # messages, some 60 MB: of two minutes, if all topics together have 400 Hz


class RecentMessages:
    """Roles and messages of the last LOOK_BACK seconds, as they came."""

    def __init__(self) -> None:
        # with the time when they came: their stamps may be anything
        self._kept: deque[tuple[float, str, Message]] = deque(maxlen=_MOST)
        self._now = 0.0

    def add(self, role: str, message: Message) -> None:
        self._kept.append((self._now, role, message))

    def forget(self, now: float) -> None:
        """It is the time ``now`` [s] of samples; drop what came long before."""
        self._now = now
        while self._kept and self._kept[0][0] < now - LOOK_BACK:
            self._kept.popleft()

    def clear(self) -> None:
        self._kept.clear()

    def again(
        self, config: Config, about: Config, kinematics: NDArray[np.void], live: Sampler
    ) -> tuple[Sampler, NDArray[np.void]]:
        """A sampler that has taken them all, for the estimation that ``config`` asks for, with the
        parameters of effects of ``about``, and its samples (k,) of SAMPLE. It goes on in the place
        of ``live``, in which the thrust that acts still has the lag that was supposed before.
        ``kinematics`` is the state of a kinematic filter before the first message."""
        sampler = Sampler(config)
        sampler.recentre(about)
        sampler.origin = live.origin
        sampler.kinematic_filter.begin_with(kinematics)
        made = [sampler.push(role, message) for _, role, message in self._kept]
        samples = joined([part for part in made if len(part)] or [sampler.flush()])
        sampler.commands = live.commands
        sampler.counts.clear()
        sampler.counts.update(live.counts)
        return sampler, samples
