"""Hears every estimator of this DDS domain, in any namespace, and takes part in nothing."""

import math
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_msgs.msg import Float64MultiArray

from rov_ident.cdr import decode_wrench
from rov_ident.dashboard.store import Status, Store
from rov_ident.nodes.common import LATCHED
from rov_ident.nodes.conversions import from_diagnostics

Forward = Callable[[str, str, bytes, int], None]
"""(topic, type, bytes, time of arrival in ns)."""

_SEARCH_PERIOD = 0.5  # s; between looks for new estimators
_COEFFICIENTS = "/coefficients"
_DIAGNOSTIC_TYPE = "diagnostic_msgs/msg/DiagnosticArray"
# What is missed is missed: nobody shall wait for us.
_HEARSAY = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


class WatchNode(Node):  # type: ignore[misc]
    """Subscribes to all that estimators publish and puts it into a store.

    An estimator is known by its topic: ``NAME/coefficients``, a DiagnosticArray that someone
    publishes. ``forward`` is set before the node is spun, and given the bytes of every message.
    """

    def __init__(
        self,
        store: Store,
        name: str = "rov_ident_watch",
        context: Context | None = None,
    ) -> None:
        super().__init__(name, context=context)
        self.forward: Forward | None = None
        self._store = store
        self._known: set[str] = set()
        self._listen("/diagnostics", DiagnosticArray, _HEARSAY, self._take_diagnostics)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_SEARCH_PERIOD, self._search, clock=steady)

    def _search(self) -> None:
        """Take up the estimators that are new."""
        for topic, types in self.get_topic_names_and_types():
            name = topic.removesuffix(_COEFFICIENTS)
            if name in self._known or name in ("", topic) or _DIAGNOSTIC_TYPE not in types:
                continue
            if not self.count_publishers(topic):
                continue
            self._known.add(name)
            self._store.add(name)
            self._listen(topic, DiagnosticArray, LATCHED, partial(self._take_report, name))
            self._listen(
                f"{topic}/covariance",
                Float64MultiArray,
                LATCHED,
                partial(self._take_covariance, name),
            )
            self._listen(
                f"{name}/wrench_residual",
                WrenchStamped,
                _HEARSAY,
                partial(self._take_residual, name),
            )
            if self.forward is not None:  # the same numbers again, for who plots arrays
                self._listen(f"{topic}/values", Float64MultiArray, LATCHED, lambda _: None)

    def _listen(
        self, topic: str, type_: type, qos: QoSProfile, take: Callable[[bytes], None]
    ) -> None:
        package = type_.__module__.partition(".")[0]
        type_name = f"{package}/msg/{type_.__name__}"

        def receive(data: bytes) -> None:
            try:
                take(data)
            except ValueError as error:
                self.get_logger().warning(f"{topic}: {error}", throttle_duration_sec=10.0)
            if self.forward is not None:
                self.forward(topic, type_name, data, time.time_ns())

        self.create_subscription(type_, topic, receive, qos, raw=True)

    def _take_report(self, name: str, data: bytes) -> None:
        message = deserialize_message(data, DiagnosticArray)
        vehicle = message.status[0].hardware_id if message.status else ""
        self._store.take_report(name, vehicle, from_diagnostics(message))

    def _take_covariance(self, name: str, data: bytes) -> None:
        message = deserialize_message(data, Float64MultiArray)
        n = math.isqrt(len(message.data))
        if n * n != len(message.data):
            raise ValueError(f"{len(message.data)} numbers are no square matrix")
        matrix = np.array(message.data).reshape(n, n)
        if np.isfinite(matrix).all():
            self._store.take_covariance(name, matrix)

    def _take_residual(self, name: str, data: bytes) -> None:
        wrench = decode_wrench(data)
        self._store.take_residual(name, wrench.stamp, np.concatenate([wrench.force, wrench.torque]))

    def _take_diagnostics(self, data: bytes) -> None:
        for status in deserialize_message(data, DiagnosticArray).status:
            node, separator, kind = status.name.partition(": ")
            if separator:
                values = {pair.key: pair.value for pair in status.values}
                self._store.take_status(
                    f"/{node}", kind, Status(status.level[0], status.message, values)
                )
