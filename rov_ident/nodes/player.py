"""Plays a bag into estimator nodes, in lockstep with them, and records what they publish."""

import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray, UInt64
from std_srvs.srv import Trigger

from rov_ident.estimation.online import Report
from rov_ident.io.bag_reader import RawMessage
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.topics import RUDDER
from rov_ident.nodes.common import INPUTS, LATCHED, STREAM, Executor
from rov_ident.nodes.conversions import from_diagnostics, to_time

OnReport = Callable[[str, Report], None]

WINDOW = 64  # messages on their way; less than every queue is deep
_CLOCK_PERIOD = 25_000_000  # ns, of the bag; as `ros2 bag play --clock`
_PATIENCE = 60.0  # s; far longer than a busy computer holds a node up: it will not come back
_START_TIME = 300.0  # s; for a node to compile, ten times what docs/speed.md has measured

_GLOBAL = ("/clock", "/diagnostics", "/parameter_events", "/rosout")  # topics in no namespace
_OUTPUTS: dict[str, tuple[type, QoSProfile]] = {
    "coefficients": (DiagnosticArray, LATCHED),
    "coefficients/values": (Float64MultiArray, LATCHED),
    "coefficients/covariance": (Float64MultiArray, LATCHED),
    "wrench_residual": (WrenchStamped, STREAM),
}


def apart(namespace: str) -> list[str]:
    """The arguments of a node that talks to nobody outside a namespace, not even by global names.

    A namespace rather than a DDS partition or domain: every middleware has it, and as many as
    anybody needs.
    """
    rules = [f"__ns:={namespace}", *(f"{topic}:={namespace}{topic}" for topic in _GLOBAL)]
    return ["--ros-args", *(word for rule in rules for word in ("-r", rule))]


def _report(data: bytes) -> Report:
    return from_diagnostics(deserialize_message(data, DiagnosticArray))


class Player(Node):  # type: ignore[misc]
    """Plays one bag into the nodes ``{estimator}_node`` of a namespace, which is theirs alone.

    ``check`` is called while waiting; it raises if there is nothing left to wait for. ``steered``
    of the nodes listen to the rudder, too.
    """

    def __init__(
        self,
        context: Context,
        namespace: str,
        estimators: Iterable[str],
        writer: BagWriter | None,
        on_report: OnReport | None,
        report_period: float,
        check: Callable[[], None],
        listened: Mapping[str, tuple[str, type]] = INPUTS,
        steered: int = 0,
    ) -> None:
        super().__init__("rov_ident_player", context=context, cli_args=apart(namespace))
        self._reports: dict[str, bytes] = {}  # the last of each estimator, as it came
        self._told = dict.fromkeys(estimators, 0.0)  # s, of time.monotonic; when on_report was
        self._estimators = tuple(estimators)
        self._listeners = dict.fromkeys(listened, len(self._estimators)) | {RUDDER: steered}
        self._writer = writer
        self._on_report, self._report_period = on_report, report_period
        self._check = check
        self._now = 0  # ns, of the bag
        self._clock_time: int | None = None
        self._sent = 0
        self._acknowledged = dict.fromkeys(self._estimators, -1)
        self._executor = Executor(context=context)
        self._executor.add_node(self)

        self._clock = self.create_publisher(Clock, "/clock", STREAM)
        # All of them, even where the bag has no IMU: the nodes wait for a publisher on each.
        self._inputs = {
            role: self.create_publisher(type_, name, STREAM)
            for role, (name, type_) in listened.items()
        }
        self._outputs = [self._record("/diagnostics", DiagnosticArray, STREAM)]
        self._flushes = {}
        for estimator in self._estimators:
            node = f"{estimator}_node"
            for name, (type_, qos) in _OUTPUTS.items():
                self._outputs.append(self._record(f"{node}/{name}", type_, qos, estimator))
            self._flushes[estimator] = self.create_client(Trigger, f"{node}/flush")
            received = partial(self._take_acknowledgement, estimator)
            self.create_subscription(UInt64, f"{node}/received", received, STREAM)

    def _record(self, topic: str, type_: type, qos: QoSProfile, estimator: str = "") -> Any:
        package, _, rest = type_.__module__.partition(".")
        type_name = f"{package}/{rest.partition('.')[0]}/{type_.__name__}"
        recorded = "/" + topic.lstrip("/")
        if self._writer:
            self._writer.add_topic(recorded, type_name, latched=qos is LATCHED)
        take = partial(self._take_output, recorded, type_name, estimator)
        depth = QoSProfile(
            depth=STREAM.depth, reliability=qos.reliability, durability=qos.durability
        )
        return self.create_subscription(type_, topic, take, depth, raw=True)

    def _take_output(self, topic: str, type_name: str, estimator: str, data: bytes) -> None:
        if self._writer:
            self._writer.write(topic, type_name, self._now, data)
        if topic.endswith("/coefficients"):
            self._reports[estimator] = data
            now = time.monotonic()
            if self._on_report and now - self._told[estimator] >= self._report_period:
                self._told[estimator] = now
                self._on_report(estimator, _report(data))

    @property
    def reports(self) -> dict[str, Report]:
        """The last report of each estimator that has made one."""
        return {estimator: _report(data) for estimator, data in self._reports.items()}

    def _take_acknowledgement(self, estimator: str, count: UInt64) -> None:
        self._acknowledged[estimator] = count.data

    def destroy_node(self) -> None:
        # First the executor, which holds references to the publishers.
        self._executor.shutdown()
        super().destroy_node()

    def wait_for_nodes(self, start: int) -> None:
        """Until everything is connected both ways. ``start`` [ns] is the time the bag begins."""
        self._now = start
        self._wait(self._connected, "to start", _START_TIME)

    def _connected(self) -> bool:
        return (
            all(p.get_subscription_count() >= self._listeners[r] for r, p in self._inputs.items())
            and all(s.get_publisher_count() > 0 for s in self._outputs)
            and all(client.service_is_ready() for client in self._flushes.values())
            and all(count >= 0 for count in self._acknowledged.values())
        )

    def play(self, messages: Iterable[tuple[str, RawMessage]], rate: float) -> int:
        """Play (role, message) at the recorded speed times ``rate``; 0: as fast as the nodes can.

        Returns how many messages every node has taken: all of them, but for those of the rudder.
        These are not counted, as not every node listens; they come before what is played later.
        """
        began: tuple[float, int] | None = None
        for role, raw in messages:
            if rate > 0.0:
                began = began or (time.monotonic(), raw.log_time)
                end = began[0] + (raw.log_time - began[1]) * 1e-9 / rate
                while (left := end - time.monotonic()) > 0.0:
                    self._executor.spin_once(timeout_sec=min(left, 0.5))
                    self._check()
            self._wait(partial(self._all_took, self._sent - WINDOW + 1), "to take messages")
            self._tick(raw.log_time)
            self._inputs[role].publish(raw.data)
            self._sent += role != RUDDER
        self._wait(partial(self._all_took, self._sent), "to take the last messages")
        return self._sent

    def finish(self) -> None:
        """Have the nodes use all messages they still hold, and wait for their last reports."""
        for estimator, client in self._flushes.items():
            future = client.call_async(Trigger.Request())
            self._wait(future.done, "to finish")
            stamp = int(future.result().message)
            self._wait(partial(self._has_report, estimator, stamp), "to report")

    def _tick(self, now: int) -> None:
        self._now = max(now, self._now)
        if self._clock_time is None or self._now - self._clock_time >= _CLOCK_PERIOD:
            self._clock_time = self._now
            self._clock.publish(Clock(clock=to_time(self._now)))

    def _all_took(self, count: int) -> bool:
        return min(self._acknowledged.values()) >= count

    def _has_report(self, estimator: str, stamp: int) -> bool:
        data = self._reports.get(estimator)
        return data is not None and _report(data).stamp == stamp

    def _wait(self, ready: Callable[[], bool], what: str, patience: float = _PATIENCE) -> None:
        end = time.monotonic() + patience
        while not ready():
            self._executor.spin_once(timeout_sec=0.1)
            self._check()
            if time.monotonic() > end:
                raise RuntimeError(f"the nodes took more than {patience:.0f} s {what}")
