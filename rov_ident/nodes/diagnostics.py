"""What an estimator node says of itself in `/diagnostics`, and which of it goes to the log."""

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from numpy.typing import NDArray

from rov_ident.core.messages import DRIVE, IMU, ODOMETRY, WRENCH
from rov_ident.core.states import Level, State
from rov_ident.estimation.checkpoint import Keeper
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.io.topics import BATTERY, ONE_CLOCK, Reader
from rov_ident.nodes.common import GuardedNode
from rov_ident.nodes.conversions import to_status
from rov_ident.sampling.validation import NO_ODOMETRY, NO_WRENCH, describe

_LOG_PERIOD = 10.0  # s; between two equal warnings in the log, so that others can be seen
_LATE = 2.0  # s; a checkpoint that is older than two periods of /diagnostics is worth a warning
_SLOW = {BATTERY: 10.0}  # s; battery monitors publish at 0.1 Hz and faster
# The consequence of something that has a warning of its own.
_NO_WARNING = {NO_ODOMETRY, NO_WRENCH}
# Counts in a second up to which there is no warning: a good message now and then looks like an
# outlier, and takes its neighbour with it.
_CHANCE = {"imu: outlier between its neighbours": 2, "wrench: outlier between its neighbours": 2}


@dataclass
class Inputs:
    """The topics of a node by role, and what has come in on them."""

    sources: Mapping[str, tuple[str, type]]
    received: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)  # that DDS says it has dropped, by reason
    silence: dict[str, float] = field(default_factory=dict)  # s since the last message
    subscriptions: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.silence = dict.fromkeys(self.sources, 0.0)

    def is_missing(self, role: str, timeout: float) -> bool:
        return self.silence[role] > max(timeout, _SLOW.get(role, 0.0))

    def have_stopped(self, timeout: float) -> bool:
        """Whether one is silent without which there are no samples."""
        needed = self.sources.keys() & {ODOMETRY, WRENCH, DRIVE}
        return any(self.is_missing(role, timeout) for role in needed)

    def count_lost(self, role: str, event: Any) -> None:
        """Take DDS's own count of what was published and never reached the subscription."""
        self.lost[f"{role}: lost before it reached the node"] = event.total_count


def clock_fault(topic: str, odometry: str, apart: float) -> str:
    """What is wrong where messages that come together are stamped ``apart`` [s]; or nothing."""
    if abs(apart) <= ONE_CLOCK:
        return ""
    order = "before" if apart < 0.0 else "after"
    words = f"{topic} is stamped {order} {odometry} ({abs(apart):.3g} s)"
    return f"{words}: have one clock stamp both"


class Diagnostics:
    """Publishes `/diagnostics` of a node, a status each for inputs, estimation, model, checkpoint.

    With ``lockstep`` silence is not taken for the end of the inputs.
    """

    def __init__(
        self,
        node: GuardedNode,
        online: OnlineEstimator,
        reader: Reader,
        inputs: Inputs,
        lockstep: bool,
    ) -> None:
        self._node, self._online, self._reader = node, online, reader
        self._inputs, self._lockstep = inputs, lockstep
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.ratios: list[NDArray[np.float64]] = []  # (k, 6) since the last time
        self._counts: Counter[str] = Counter()
        self._received: Counter[str] = Counter()
        self._published = time.monotonic()
        self._logged, self._logged_at = "", 0.0

    def publish(
        self, stopped: str, waiting: int, interpreting: bool, keeper: Keeper | None
    ) -> None:
        """``stopped``: why there are no samples; ``waiting`` messages are not used yet."""
        now = time.monotonic()
        period, self._published = now - self._published, now
        complaints = self._input_faults()
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            self._input_status(complaints, period),
            self._estimation_status(stopped, waiting, interpreting),
            self._model_status(),
        ]
        if keeper is not None:
            message.status.append(self._checkpoint_status(keeper))
        self._publisher.publish(message)
        # Without the numbers, which differ each time.
        complaint = "; ".join(text.partition(" (")[0] for text in complaints)
        if complaint and (complaint != self._logged or now - self._logged_at > _LOG_PERIOD):
            self._node.get_logger().warning(complaint)
            self._logged, self._logged_at = complaint, now

    def _status(
        self, kind: str, level: Level, words: str, values: dict[str, str]
    ) -> DiagnosticStatus:
        # By the full name: all vehicles share /diagnostics. That of a replay says nothing.
        full = self._node.get_name() if self._lockstep else self._node.get_fully_qualified_name()
        name = f"{full.lstrip('/')}: {kind}"
        return to_status(name, self._online.config.name, level, words, values)

    def _input_faults(self) -> list[str]:
        """What keeps the inputs from being used, in words."""
        complaints = []
        for role in self._inputs.sources:
            if self._lockstep or not self._inputs.is_missing(role, self._online.config.timeout):
                continue
            topic = self._topic(role)
            if self._inputs.received[role]:
                complaints.append(f"no more messages on {topic}: its driver has stopped")
            elif self._node.count_publishers(topic):
                complaints.append(
                    f"no message received on {topic}, though it has a publisher: it is silent, "
                    "or of another type, or its quality of service does not match qos.reliability"
                )
            elif role != IMU:  # it may well have none
                complaints.append(f"no message received on {topic}: remap it or start the driver")
        complaints += self._clock_faults()
        counts = self._online.counts + self._reader.counts + self._node.faults + self._inputs.lost
        refused = counts - self._counts
        complaints += describe(
            {k: n for k, n in refused.items() if k not in _NO_WARNING and n > _CHANCE.get(k, 0)}
        )
        self._counts = counts
        for role, subscription in self._inputs.subscriptions.items() if complaints else ():
            if (number := subscription.get_publisher_count()) > 1:
                complaints.append(f"{self._topic(role)} has {number} publishers: let one publish")
        return complaints

    def _clock_faults(self) -> list[str]:
        """Topics that come in together, but are stamped by different clocks."""
        stamps = {
            role: stamp
            for role, stamp in self._online.sampler.validation.stamps.items()
            if self._inputs.silence[role] < ONE_CLOCK and not self._lockstep
        }
        complaints = []
        for role, stamp in stamps.items():
            apart = (stamp - stamps.get(ODOMETRY, stamp)) * 1e-9
            complaints.append(clock_fault(self._topic(role), self._topic(ODOMETRY), apart))
        return [complaint for complaint in complaints if complaint]

    def _topic(self, role: str) -> str:
        return str(self._node.resolve_topic_name(self._inputs.sources[role][0]))

    def _input_status(self, complaints: list[str], period: float) -> DiagnosticStatus:
        values = {}
        received = self._inputs.received
        for role, subscription in self._inputs.subscriptions.items():
            values[f"{role} rate"] = f"{(received[role] - self._received[role]) / period:.1f} Hz"
            values[f"{role} publishers"] = str(subscription.get_publisher_count())
        self._received = received.copy()
        values.update({name: str(count) for name, count in sorted(self._counts.items())})
        stopped = self._inputs.have_stopped(self._online.config.timeout)
        level = Level.STALE if stopped else Level.WARN if complaints else Level.OK
        words = "; ".join(complaints) or "all messages are used"
        return self._status("inputs", level, words, values)

    def _estimation_status(
        self, stopped: str, waiting: int, interpreting: bool
    ) -> DiagnosticStatus:
        report = self._online.report()
        states = list(zip(report.names, report.states, strict=True))
        values = {
            level.name: " ".join(name for name, state in states if state.level == level)
            for level in (Level.OK, Level.WARN, Level.ERROR)
        }
        values["condition number"] = f"{report.condition:.3g}"
        values |= {
            state.value: " ".join(name for name, at in states if at is state)
            for state in State
            if state is not State.STALE
        }
        ratios = np.concatenate([np.zeros((0, 6)), *self.ratios])
        self.ratios.clear()
        for i, axis in enumerate("XYZKMN"):
            finite = ratios[np.isfinite(ratios[:, i]), i]
            if len(finite):
                values[f"test ratio {axis}"] = f"{finite.mean():.3g}"
        for part, ratio in self._online.sampler.kinematic_filter.test_ratios.items():
            values[f"test ratio odom {part}"] = f"{ratio:.3g}"
        agreement = report.consistency
        for test in agreement.tests if agreement is not None else ():
            values[test.name] = f"{test.value:.3g} (limit {test.limit:g})"
        converged = sum(state is State.CONVERGED for state in report.states)
        words = f"{converged} of {len(states)} coefficients have converged"
        wrong = [s for s in State if s.level == Level.ERROR and s in report.states]
        if not self._online.enabled:
            level, words = Level.WARN, f"disabled, {words}"
        elif wrong:
            level = Level.ERROR
            words = ", ".join([words, *(f"{s.value}: {values[s.value]}" for s in wrong)])
        elif stopped:
            level, words = Level.STALE, f"stale: {stopped}, {words}"
        elif agreement is not None and not agreement.consistent:
            level, words = Level.WARN, f"data and model disagree: {agreement.sentence}"
        else:
            level = Level.OK
        if waiting:
            words = f"{words}; {waiting} messages wait"
        if interpreting:
            words = f"{words}; interpreted until compiled"
        return self._status("estimation", level, words, values)

    def _model_status(self) -> DiagnosticStatus:
        """What the model seems to lack, in words and numbers."""
        monitor = self._online.monitor
        found = [] if monitor is None else monitor.suspicions
        values = {}
        for i, suspicion in enumerate(found):
            number = f" {i + 1}" if i else ""
            values[f"effect{number}"] = suspicion.effect
            values[f"axis{number}"] = suspicion.axes
            values[f"score{number}"] = f"{suspicion.score:.3g}"
            values[f"penalty{number}"] = f"{suspicion.penalty:.3g}"
            values[f"share{number}"] = f"{suspicion.share:.3g}"
            values[f"alternatives{number}"] = " ".join(suspicion.rivals)
            for name, value in suspicion.parameters.items():
                values[f"{suspicion.effect}.{name}"] = f"{value:.4g} {suspicion.units[name]}"
        level = Level.WARN if found else Level.OK
        words = "; ".join(s.sentence for s in found) or (
            "the monitor is being compiled" if monitor is None else "nothing is seen to be missing"
        )
        return self._status("model", level, words, values)

    def _checkpoint_status(self, keeper: Keeper) -> DiagnosticStatus:
        values = {"path": str(keeper.path), "write time": f"{keeper.took:.3g} s"}
        level, words = Level.OK, "what is learnt is on disk"
        if keeper.failure:
            level = Level.ERROR
            words = f"{keeper.failure}: what is learnt from now on would be lost in a crash"
        elif keeper.late > _LATE:
            level = Level.WARN
            words = f"the disk is slow: the last checkpoint is {keeper.late:.1f} s old"
        elif self._online.stamp == 0:
            words = "nothing learnt yet"
        return self._status("checkpoint", level, words, values)
