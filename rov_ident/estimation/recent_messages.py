"""Keeps recent messages, which are sampled again once a lag or a delay is known better.

A sample has the wrench that acts with the lag that was supposed when it was made, and is right for
another lag to first order only. So what was learnt from samples of a wrong lag is given up, and the
same messages are learnt from again ("Times" in docs/live.md). What was learnt from older messages,
which are no longer kept, stays.
"""

import math
from collections import deque
from typing import Any

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
_APART = 10.0  # s; a choice: so much of the messages may be used by nothing
_BEFORE = 1.0  # s; of messages before a sample is right: thrusters have settled by then


class RecentMessages:
    """Roles and messages of the last LOOK_BACK seconds, as they came, and what was known meanwhile:
    memories of an estimator."""

    def __init__(self) -> None:
        # with the time when they came: their stamps may be anything
        self._kept: deque[tuple[float, str, Message]] = deque(maxlen=_MOST)
        self._known: deque[tuple[float, Any]] = deque()
        self._now = 0.0
        self._whole = True  # nothing was dropped

    def add(self, role: str, message: Message) -> None:
        self._whole &= len(self._kept) < _MOST
        self._kept.append((self._now, role, message))

    def forget(self, now: float, memory: Any) -> None:
        """It is the time ``now`` [s] of samples, and ``memory`` is known; drop what came long
        before, or by another clock, which was set back since."""
        self._now = now
        if self._known and now < self._known[-1][0]:
            self.clear()
            self._whole = False
        if not self._known or now - self._known[-1][0] >= _APART:
            self._known.append((now, memory))
        while self._kept and self._kept[0][0] < now - LOOK_BACK:
            self._kept.popleft()
            self._whole = False
        begin = self._kept[0][0] + _BEFORE if self._kept else now
        while len(self._known) > 1 and self._known[0][0] < begin:
            self._known.popleft()

    def clear(self) -> None:
        self._kept.clear()
        self._known.clear()
        self._whole = True

    def again(
        self, config: Config, about: Config, origin: Any, live: Sampler
    ) -> tuple[Any, Sampler, NDArray[np.void]]:
        """A memory to begin with: ``origin`` while all messages since are kept. A sampler that has
        taken them all, for the estimation that ``config`` asks for, with the parameters of effects
        of ``about``, and its samples (k,) of SAMPLE that the memory does not contain. It goes on in
        the place of ``live``, in which the thrust that acts still has the lag that was supposed
        before.
        """
        since, memory = (-math.inf, origin) if self._whole else self._known[0]
        self._known.clear()
        sampler = Sampler(config)
        sampler.recentre(about)
        sampler.origin = live.origin
        sampler.kinematic_filter.begin_with(memory.kinematics)
        made = [sampler.push(role, message) for _, role, message in self._kept]
        samples = joined([part for part in made if len(part)] or [sampler.flush()])
        sampler.commands = live.commands
        sampler.counts.clear()
        sampler.counts.update(live.counts)
        return memory, sampler, samples[samples["t"] > since]
