"""Listens to every estimator in this DDS domain, in any namespace, and publishes nothing."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.context import Context
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64MultiArray

from rov_ident.core.errors import UserError
from rov_ident.dashboard.store import Status, Store
from rov_ident.io.cdr import decode_wrench
from rov_ident.nodes.common import LATCHED, Executor, GuardedNode
from rov_ident.nodes.conversions import from_diagnostics

_SEARCH_PERIOD = 0.5  # s; between searches for new estimators, which nobody notices
_COEFFICIENTS = "/coefficients"
_DIAGNOSTIC_TYPE = "diagnostic_msgs/msg/DiagnosticArray"
# Best effort: no publisher has to wait for a listener.
_BEST_EFFORT = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


class WatchNode(GuardedNode):
    """Subscribes to all that estimators publish and puts it into a store.

    An estimator is known by its topic: ``NAME/coefficients``, a DiagnosticArray that someone
    publishes.
    """

    def __init__(self, store: Store, name: str, context: Context) -> None:
        super().__init__(name, context=context)
        self._store = store
        self._known: set[str] = set()
        take = self._take_diagnostics
        self.create_subscription(DiagnosticArray, "/diagnostics", take, _BEST_EFFORT, raw=True)
        self.create_timer(_SEARCH_PERIOD, self._search)

    def _search(self) -> None:
        """Subscribe to the estimators that are new."""
        for topic, types in self.get_topic_names_and_types():
            name = topic.removesuffix(_COEFFICIENTS)
            if name in self._known or name in ("", topic) or _DIAGNOSTIC_TYPE not in types:
                continue
            if "/_" in topic:  # hidden, as ROS calls it: a replay beside the vehicle
                continue
            if not self.count_publishers(topic):
                continue
            self._known.add(name)
            self._store.add(name)
            for heard, type_, qos, take in (
                (topic, DiagnosticArray, LATCHED, self._take_report),
                (f"{topic}/covariance", Float64MultiArray, LATCHED, self._take_covariance),
                (f"{name}/wrench_residual", WrenchStamped, _BEST_EFFORT, self._take_residual),
            ):
                self.create_subscription(type_, heard, partial(take, name), qos, raw=True)

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


@contextmanager
def watching(
    store: Store, name: str, arguments: Sequence[str] | None = ()
) -> Iterator[tuple[WatchNode, Any]]:
    """A node that fills the store, and the executor to spin it with, within the block.

    ``arguments`` are ROS's own; None: those of the program. Interrupts are left to the caller.
    """
    context = Context()
    try:
        given = None if arguments is None else list(arguments)  # rclpy takes no other sequence
        rclpy.init(args=given, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy gives its RCLError no public name
        raise UserError(str(error).partition(", at ")[0]) from error
    try:
        node, executor = WatchNode(store, name, context), Executor(context=context)
        executor.add_node(node)
        try:
            yield node, executor
        finally:
            executor.shutdown()
            node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)
