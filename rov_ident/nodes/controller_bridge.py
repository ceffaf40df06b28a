"""`controller_bridge`: converged coefficients into the parameters of a running controller.

A set is sent when something in it has left the dead band, not more often than `period`, and in
approval mode once it is approved; and it is read back: one taken in part is undone.
"""

import contextlib
import threading
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from rov_ident.config import Names
from rov_ident.config import Parameter as Own
from rov_ident.consumer import parameter_bridge as bridge
from rov_ident.consumer.hydrodynamic_model import HydrodynamicModel
from rov_ident.consumer.parameter_bridge import Change, Values
from rov_ident.core.errors import UserError
from rov_ident.core.states import Level
from rov_ident.nodes import parameters
from rov_ident.nodes.common import DIAGNOSTICS_PERIOD, LATCHED, GuardedNode, live
from rov_ident.nodes.conversions import from_diagnostics, to_status

_LOOK_PERIOD = 0.5  # s; between two comparisons of controller and estimator: a second at most late
_THREADS = 3  # the one that waits for the controller, the one that hears its answer, and services

_OWN = (
    Own("controller", str, "", "full name of the controller's node, such as /rov/velocity"),
    Own("parameter", str, "hydrodynamics.{name}", "the controller's parameter of a coefficient"),
    Own(
        "mapping", Names, (),
        "NAME=PARAMETER, NAME=-PARAMETER or NAME=PARAMETER[INDEX]; given any, only these are sent",
    ),
    Own(
        "layout", str, "none", "a controller whose parameters are known; instead of parameter",
        choices=tuple(bridge.LAYOUTS),
    ),
    Own("approval", bool, True, "send only what ~/approve was called for", live=True),
    Own(
        "period", float, 5.0, "least time between two sets", "s",
        lower=0.1, upper=86400.0, live=True,
    ),
    Own(
        "dead_band.std", float, 1.0, "a coefficient is new beyond so many standard deviations",
        lower=0.0, upper=1000.0, live=True,
    ),
    Own(
        "dead_band.percent", float, 1.0, "and beyond so much of what the controller has", "%",
        lower=0.0, upper=1000.0, live=True,
    ),
    Own(
        "hold_after", float, 2.0, "coefficients that were not heard for longer are not sent", "s",
        lower=0.01, upper=3600.0,
    ),
    Own("patience", float, 2.0, "for an answer of the controller", "s", lower=0.01, upper=60.0),
)  # fmt: skip


class ControllerBridge(GuardedNode):
    """`coefficients` in; the parameters of one controller out.

    Publishes `~/pending` (what would be sent) and `/diagnostics`; services `~/approve`, `~/revert`
    (what the controller had at first, and no more sets until `~/enable`) and `~/enable`.

    Raises UserError if the parameters make no configuration.
    """

    def __init__(self) -> None:
        super().__init__("controller_bridge", automatically_declare_parameters_from_overrides=True)
        self._settings = parameters.declare_own(self, _OWN)
        self._config = parameters.declare(self, [p.key for p in _OWN])
        controller = self._settings["controller"].rstrip("/")
        if not controller.startswith("/"):
            raise UserError(
                f"controller is {self._settings['controller']!r}, but must be the full name of its "
                "node, such as /velocity_controller (`ros2 node list` shows it)"
            )
        self._controller = controller
        given = (self._settings[name] for name in ("parameter", "mapping", "layout"))
        self._targets = bridge.targets(self._config, *given)
        self._names = list(dict.fromkeys(target.parameter for target in self._targets))
        if note := bridge.LAYOUT_NOTES.get(self._settings["layout"]):
            self.get_logger().warning(note)

        self._lock = threading.Lock()  # around what several callbacks share
        self._model = HydrodynamicModel(self._config, self._settings["hold_after"])
        self._wanted: dict[str, float] = {}
        self._std: dict[str, float] = {}
        self._refusal = "no coefficients were heard yet"

        self._original: Values | None = None
        self._open: tuple[Values, Values] | None = None  # the values before, and the set sent
        self._unanswered: tuple[Any, Any] | None = None  # its client and future
        self._pending: Sequence[Change] = ()
        self._enabled = True
        self._sent = 0
        self._tried = -float("inf")  # s, when a set was last sent, accepted or not
        self._level, self._words = Level.WARN, "waiting for the controller"
        self._logged = ""

        self._leaving = threading.Event()
        # A callback that waits for the controller must not block the one that receives the answer.
        answers, looks = ReentrantCallbackGroup(), MutuallyExclusiveCallbackGroup()
        self._list = self._client(ListParameters, "list_parameters", answers)
        self._get = self._client(GetParameters, "get_parameters", answers)
        self._set = self._client(SetParameters, "set_parameters", answers)
        self._set_all = self._client(SetParametersAtomically, "set_parameters_atomically", answers)
        self._pending_out = self.create_publisher(DiagnosticArray, "~/pending", LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_subscription(
            DiagnosticArray, "coefficients", self._take, LATCHED, callback_group=answers
        )
        self.create_service(Trigger, "~/approve", self._approve, callback_group=looks)
        self.create_service(Trigger, "~/revert", self._revert, callback_group=looks)
        self.create_service(SetBool, "~/enable", self._enable, callback_group=looks)
        self.create_timer(_LOOK_PERIOD, self._compare_and_send, looks)
        self.create_timer(DIAGNOSTICS_PERIOD, self._diagnose, answers)
        parameters.follow(self, partial(parameters.own, self, _OWN), self._settings.update)

    def _client(self, type_: type, service: str, group: ReentrantCallbackGroup) -> Any:
        return self.create_client(type_, f"{self._controller}/{service}", callback_group=group)

    def _take(self, message: DiagnosticArray) -> None:
        """A message that is no good is ignored; what is wanted stays until it is stale."""
        with self._lock:
            try:
                report = from_diagnostics(message)
            except ValueError as error:
                self._refusal = str(error)
                return
            taken = self._model.take(message, time.monotonic())
            self._refusal = taken.reason
            if taken.reason:
                return
            std = dict(zip(report.names, report.std.tolist()))
            places = {target.coefficient for target in self._targets}
            self._wanted = {name: v for name, v in taken.values.items() if name in places}
            self._std = {name: std[name] for name in self._wanted}

    def _usable(self) -> tuple[dict[str, float], dict[str, float], str]:
        """Converged values, their standard deviations, and why there are none."""
        with self._lock:
            if not self._model.fresh(time.monotonic()):
                return {}, {}, self._refusal or "the coefficients are stale"
            none = "" if self._wanted else "no coefficient has converged"
            return dict(self._wanted), dict(self._std), none

    def _compare_and_send(self) -> None:
        self._pending = ()
        with self._reporting():
            self._confirm()
            self._pending = self._compare()
            due = time.monotonic() - self._tried >= self._settings["period"]
            if not self._pending:
                self._report(Level.OK, "the controller has what is converged")
            elif self._settings["approval"]:
                self._report(Level.OK, "waiting for ~/approve")
            elif due:
                self._send(self._pending)
            else:
                self._report(Level.OK, "waiting for the period to pass")

    def _compare(self) -> Sequence[Change]:
        """What should be sent; raises UserError where nothing can be."""
        # Read in any case, to know its original values from the start.
        held = bridge.read(self._targets, self._read())
        if not self._enabled:
            raise UserError("disabled: nothing is sent until ~/enable")
        wanted, std, refusal = self._usable()
        if refusal:
            raise UserError(refusal)
        # Values that only the controller has make another set than the estimator's.
        model = self._config.dynamics.with_values(held | wanted)
        if reason := self._model.why_unphysical(model):
            raise UserError(f"together with what the controller has: {reason}")
        band = self._settings["dead_band.std"], self._settings["dead_band.percent"]
        return bridge.changes(held, wanted, std, *band)

    def _send(self, pending: Sequence[Change]) -> None:
        self._tried = time.monotonic()
        before = self._read()
        new = {change.coefficient: change.wanted for change in pending}
        self._exchange(before, bridge.write(self._targets, before, new))
        self._sent += 1
        self._pending = ()
        self._report(Level.OK, f"sent {'; '.join(change.words for change in pending)}")

    def _exchange(self, before: Values, new: Values) -> None:
        """All of ``new`` is in the controller afterwards; or, with a UserError, nothing of it."""
        self._open = (before, new)
        try:
            reason = self._write(new)
        except UserError as error:  # it may or may not have accepted it
            reason = str(error)
        self._confirm(reason)

    def _confirm(self, reason: str = "") -> None:
        """Check whether the last set was accepted, and undo it if it was accepted only in part.

        Raises UserError unless it was accepted; if the controller does not answer, call it again.
        """
        if self._open is None:
            return
        self._wait_for_answer(reason)
        before, new = self._open
        after = self._read()
        if any(after[name] != value for name, value in new.items()):
            if any(after[name] != before[name] for name in new):
                self._write({name: before[name] for name in new})
                after = self._read()
                if any(after[name] != before[name] for name in new):
                    raise _HalfChangedError(
                        f"{self._controller} took a part of a set and does not take back what it "
                        "had: call ~/revert, or start it again"
                    )
                reason = reason or "it took other values than it was given"
            self._open = None
            raise UserError(f"{self._controller} refused: {reason or 'it gave no reason'}")
        self._open = None

    def _wait_for_answer(self, reason: str = "") -> None:
        """Raises UserError while a set is unanswered: it may still be accepted, even in part."""
        if self._unanswered is None:
            return
        client, future = self._unanswered
        if client.service_is_ready() and not future.done():
            raise UserError(reason or f"{self._controller} has not answered to a set yet")
        self._unanswered = None  # or it has ended, and will start without it

    def _read(self) -> dict[str, bridge.Value]:
        """The parameters that hold coefficients; raises UserError if they cannot be read."""
        answer = self._call(self._get, GetParameters.Request(names=self._names))
        if len(answer.values) != len(self._names):
            raise UserError(self._missing())
        values: dict[str, bridge.Value] = {}
        for name, value in zip(self._names, answer.values):
            if value.type == ParameterType.PARAMETER_NOT_SET:
                raise UserError(self._missing())
            if value.type == ParameterType.PARAMETER_DOUBLE:
                values[name] = value.double_value
            elif value.type == ParameterType.PARAMETER_DOUBLE_ARRAY:
                values[name] = tuple(value.double_array_value)
            else:
                raise UserError(f"{name} of {self._controller} is no floating-point number")
        if self._original is None:
            bridge.read(self._targets, values)  # raises where they do not fit the mapping
            self._original = values
        return values

    def _missing(self) -> str:
        answer = self._call(self._list, ListParameters.Request())
        missing = sorted(set(self._names) - set(answer.result.names))
        return (
            f"{self._controller} has no value of {', '.join(missing or self._names)}: give its "
            "names under parameter, mapping or layout"
        )

    def _write(self, values: Values) -> str:
        """Set parameters; why the controller refused, if it did."""
        messages = [Parameter(name, value=v).to_parameter_msg() for name, v in values.items()]
        if self._set_all.service_is_ready():
            request = SetParametersAtomically.Request(parameters=messages)
            results = [self._call(self._set_all, request).result]
        else:
            request = SetParameters.Request(parameters=messages)
            results = self._call(self._set, request).results
        failed = [result.reason or "no reason given" for result in results if not result.successful]
        return "; ".join(dict.fromkeys(failed))

    def _call(self, client: Any, request: Any) -> Any:
        if not client.service_is_ready():
            raise UserError(f"{self._controller} is not there")
        future = client.call_async(request)
        answered = threading.Event()
        future.add_done_callback(lambda _: answered.set())
        patience = self._settings["patience"]
        until, step = time.monotonic() + patience, min(0.1, patience)
        while not answered.wait(step) and time.monotonic() < until and not self._leaving.is_set():
            pass
        if not answered.is_set():
            if client in (self._set, self._set_all):
                self._unanswered = (client, future)
            else:
                client.remove_pending_request(future)
            if self._leaving.is_set():
                raise UserError(f"{self._controller} had not answered yet when this node ended")
            raise UserError(f"{self._controller} gave no answer within {patience:g} s")
        return future.result()

    def leave(self) -> None:
        """Wait for no more answers: nothing receives them any more."""
        self._leaving.set()

    def _approve(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Send what `~/pending` shows."""
        with self._reporting(response):
            if not self._pending:
                raise UserError(f"nothing is pending: {self._words}")
            if refusal := self._usable()[2]:
                raise UserError(refusal)
            self._send(self._pending)
        return response

    def _revert(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._enabled, self._pending = False, ()
        with self._reporting(response):
            if self._original is None:
                raise UserError("the controller was never changed")
            self._wait_for_answer()
            self._exchange(self._read(), self._original)
            self._report(
                Level.OK, "the controller has what it had at first; disabled until ~/enable"
            )
        return response

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._enabled = request.data
        if not request.data:  # or it could be approved still
            self._pending = ()
            self._publish_pending()
        response.success = True
        response.message = "enabled" if request.data else "disabled: nothing is sent"
        self.get_logger().info(response.message)
        return response

    def _report(self, level: Level, words: str) -> None:
        self._level, self._words = level, words
        if words == self._logged:
            return
        self._logged = words
        # In two lines: rclpy ties a severity to the line that logs.
        if level == Level.OK:
            self.get_logger().info(words)
        else:
            self.get_logger().warning(words)
        self._diagnose()

    @contextlib.contextmanager
    def _reporting(self, response: Trigger.Response | None = None) -> Iterator[None]:
        """Say what goes wrong within the block; then publish what is pending, and answer."""
        try:
            yield
        except UserError as error:
            half_changed = isinstance(error, _HalfChangedError)
            self._report(Level.ERROR if half_changed else Level.WARN, str(error))
        self._publish_pending()
        if response is not None:
            response.success, response.message = self._level == Level.OK, self._words

    def _publish_pending(self) -> None:
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        for change in self._pending:
            name, words = change.coefficient, change.words
            values = {key: repr(getattr(change, key)) for key in ("held", "wanted", "std")}
            message.status.append(to_status(name, self._controller, Level.OK, words, values))
        self._pending_out.publish(message)

    def _diagnose(self) -> None:
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        values = {
            "controller": self._controller,
            "enabled": str(self._enabled).lower(),
            "approval": str(self._settings["approval"]).lower(),
            "pending": " ".join(change.coefficient for change in self._pending),
            "sets sent": str(self._sent),
        }
        name = str(self.get_fully_qualified_name()).lstrip("/")
        status = to_status(f"{name}: bridge", self._config.name, self._level, self._words, values)
        message.status = [status]
        self._diagnostics.publish(message)


class _HalfChangedError(UserError):
    """The controller has a part of a set, which is an ERROR and not only a WARN."""


class _Executor(MultiThreadedExecutor):  # type: ignore[misc]
    def shutdown(self, timeout_sec: float | None = None) -> bool:
        # rclpy's own does not wait for callbacks, each of which would then log a failure.
        self._executor.shutdown()
        return bool(super().shutdown(timeout_sec))


def main() -> int:
    return live(
        "controller_bridge",
        ControllerBridge,
        own=[p.key for p in _OWN],
        executor=lambda: _Executor(_THREADS),
        leave=ControllerBridge.leave,
    )
