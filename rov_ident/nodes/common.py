"""What all nodes share: start and end of their processes, topics, quality of service."""

import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from functools import wraps
from importlib import import_module
from itertools import pairwise
from typing import Any, TypeVar

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from rov_ident import config as configuration
from rov_ident.config import Inputs
from rov_ident.core.errors import UserError
from rov_ident.core.interrupts import INTERRUPTS, end_at_once
from rov_ident.io.topics import sources

try:  # costs half as much, and keeps the order of arrival across topics
    from rclpy.experimental import EventsExecutor as Executor
except ImportError:
    from rclpy.executors import SingleThreadedExecutor as Executor

__all__ = ["INPUTS", "LATCHED", "STREAM", "Executor", "GuardedNode", "live", "subscribed"]

DIAGNOSTICS_PERIOD = 1.0  # s; as diagnostic_updater has it

AnyNode = TypeVar("AnyNode", bound=Node)
_STEADY = Clock(clock_type=ClockType.STEADY_TIME)


class GuardedNode(Node):  # type: ignore[misc]
    """A node that outlives what its callbacks raise, those of rclpy's own services included.

    ``faults`` counts them by name; the log has them, too. Where ``outlives`` is False they end the
    process.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.faults: Counter[str] = Counter()
        self.outlives = True
        super().__init__(*arguments, **options)  # which listens to /clock

    def declare_parameters(
        self, namespace: str, parameters: Iterable[Any], ignore_override: bool = False
    ) -> Any:
        """As rclpy; raises UserError for what a user has set to nothing."""
        given = list(parameters)
        for name, value, *described in given:
            if value is None and not any(d.dynamic_typing for d in described):
                raise UserError(f"{name} is [], which says nothing: give a value, or leave it out")
        return super().declare_parameters(namespace, given, ignore_override)

    def create_subscription(
        self, type_: Any, topic: str, callback: Callable[..., Any], *arguments: Any, **options: Any
    ) -> Any:
        guarded = self._guarded(topic, callback)
        return super().create_subscription(type_, topic, guarded, *arguments, **options)

    def create_timer(self, period: float, callback: Callable[..., Any], group: Any = None) -> Any:
        """On the steady clock, so that a node under `use_sim_time` works without `/clock`."""
        return super().create_timer(period, self._guarded("timer", callback), group, _STEADY)

    def create_service(
        self, type_: Any, service: str, callback: Callable[..., Any], **options: Any
    ) -> Any:
        return super().create_service(type_, service, self._guarded(service, callback), **options)

    def _guarded(self, name: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(callback)  # rclpy looks at its arguments
        def guarded(*arguments: Any) -> Any:
            try:
                return callback(*arguments)
            except Exception as error:
                if not self.outlives:
                    raise
                self.faults[f"{name}: {type(error).__name__}"] += 1
                words = f"{name}: {error!r}"
                self.get_logger().error(words, throttle_duration_sec=10.0)
                response: Any = arguments[-1] if arguments else None  # of a service
                if hasattr(response, "success"):
                    response.success, response.message = False, words
                return response

        return guarded


LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
STREAM = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


def subscribed(inputs: Inputs) -> dict[str, tuple[str, type]]:
    """The relative topic and the message class of every role of the configured inputs.

    Raises UserError if a package of messages is not installed.
    """
    found = {}
    for role, (topic, type_name) in sources(inputs).items():
        package, _, name = type_name.partition("/")
        try:
            found[role] = topic, getattr(import_module(f"{package}.msg"), name)
        except ImportError as error:
            raise UserError(
                f"inputs.{role} is {type_name}, but {package} is not installed: source a workspace "
                "that has it, or republish its numbers as std_msgs/UInt16MultiArray"
            ) from error
    return found


INPUTS = subscribed(Inputs())  # by default


def live(
    name: str,
    make: Callable[[], AnyNode],
    own: Collection[str] = (),
    executor: Callable[[], Any] = Executor,
    begin: Callable[[AnyNode, threading.Event], None] = lambda node, interrupted: None,
    leave: Callable[[AnyNode], None] = lambda node: None,
) -> int:
    """A node's whole life, until interrupted or shut down by itself, as the program's exit status.

    It is 0 then, and 2 with one sentence where the user can correct what is wrong. ``own`` are the
    node's parameters that are no part of a configuration. ``begin`` is called once the node is up
    and starts its threads (one that is being started when an interrupt is raised would keep the
    process for ever); it is given an event that is set by an interrupt, which does not end it.
    ``leave`` is called once the node no longer hears anything, but may still publish.
    """
    # Python's handlers rather than rclpy's: they interrupt compiling, too, and leave the context
    # open, so that the last messages can be published.
    end_at_once(0)
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy gives its RCLError no public name
        return _refused(name, _why_unreadable(name, own, error))
    try:
        _spin(make(), executor(), begin, leave)
    except UserError as error:
        return _refused(name, str(error))
    except ExternalShutdownException:
        pass
    finally:
        rclpy.try_shutdown()
    return 0


def _spin(
    node: AnyNode,
    executor: Any,
    begin: Callable[[AnyNode, threading.Event], None],
    leave: Callable[[AnyNode], None],
) -> None:
    executor.add_node(node)
    interrupted = threading.Event()
    # From here on an interrupt waits for the end of a callback.
    for number in INTERRUPTS:
        signal.signal(number, lambda *_: interrupted.set())
    try:
        begin(node, interrupted)
        # EventsExecutor.spin() does not return after an interrupt.
        while rclpy.ok() and not interrupted.is_set():
            executor.spin_once(timeout_sec=0.5)
    finally:
        leave(node)
        executor.shutdown()
        node.destroy_node()


def _refused(name: str, sentence: str) -> int:
    print(f"{name}: {sentence}", file=sys.stderr)
    return 2


def _why_unreadable(name: str, own: Collection[str], error: Exception) -> str:
    """What is wrong with the parameter file that rclpy could not read."""
    for option, path in pairwise(sys.argv):
        if option == "--params-file":
            try:
                configuration.load(path, name, own)
            except UserError as reason:
                return str(reason)
    if "same type" in str(error):
        return "the numbers of a list must be written alike: [0.0, 0.02, 1.0], not [0, 0.02, 1]"
    return str(error).partition(", at ")[0]
