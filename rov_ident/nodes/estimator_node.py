"""What `rls_node` and `ukf_node` share: declare parameters, decode, step, publish.

Nothing here computes a coefficient. Timers run on the steady clock, so that a node under
`use_sim_time` works where nothing publishes `/clock`; a sample's time is its stamp in any case.
"""

import gc
import os
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray, UInt64
from std_srvs.srv import SetBool, Trigger

from rov_ident import checkpoint
from rov_ident import config as configuration
from rov_ident.cdr import encode
from rov_ident.config import Config
from rov_ident.errors import UserError
from rov_ident.frames import from_core
from rov_ident.inputs import BATTERY, Reader
from rov_ident.jit import interpret, interpreting, only_run
from rov_ident.messages import Wrench
from rov_ident.nodes import parameters
from rov_ident.nodes.common import LATCHED, STREAM, live, subscribed
from rov_ident.nodes.conversions import to_diagnostics, to_matrix, to_status
from rov_ident.online import ESTIMATORS, Kind, Level, OnlineEstimator, Report
from rov_ident.samples import IMU, ODOMETRY, WRENCH, describe
from rov_ident.warm import compiler, compiling, is_compiled, load, warm_up

_OWN_PARAMETERS = ("save_path", "checkpoint_path", "lockstep")
_WATCH_PERIOD = 0.1  # s; between looks at whether the inputs have stopped
_DIAGNOSTICS_PERIOD = 1.0  # s
_CHECKPOINT_PERIOD = 0.3  # s; with the time to write it a crash costs less than a second
_LATE = 2.0  # s; a checkpoint that is older is worth a warning
_TURN = 0.02  # s; of using messages that wait before anything else is done
_MOST_WAITING = 200_000  # messages; while compiling, which may take for ever
_COMPILE_AGAIN = 60.0  # s; at least, between two failures
_ACKNOWLEDGED_TOGETHER = 16  # messages; a player may have more on their way
_LOADING_TIME = 5.0  # s; that a player waits for the watch, if it is compiled
_SWITCHING = 0.0005  # s; that a sample waits for the thread that watches
_LOG_PERIOD = 10.0  # s; between two equal complaints
_SLOW = {BATTERY: 10.0}  # s; what may be silent for longer than timeout
# Not worth a warning: the consequence of something that is named itself.
_NO_COMPLAINT = {
    "sample: no odometry yet",
    "sample: no wrench",
}
# Of good messages one now and then looks like an outlier.
_CHANCE = {"imu: outlier between its neighbours": 2, "wrench: outlier between its neighbours": 2}


class EstimatorNode(Node):  # type: ignore[misc]
    """One online estimator on three topics.

    With the parameter `lockstep` a player sets the pace: messages are acknowledged by their count
    on `~/received`, coefficients are published by the time of the samples, silence is not taken for
    the end of the input, but `~/flush` ends it. The node goes when its player does.

    Raises
    ------
    UserError
        If the parameters make no configuration.
    """

    def __init__(self, kind: Kind) -> None:
        super().__init__(f"{kind}_node", automatically_declare_parameters_from_overrides=True)
        config = parameters.declare(self, _OWN_PARAMETERS)
        self._save_path = self._own_parameter(
            "save_path",
            f"{configuration.as_file_name(config.name)}_{self.get_name()}.yaml",
            "file that ~/save writes",
        )
        self._lockstep = self._own_parameter("lockstep", False, "a player sets the pace")
        checkpoint_path = self._own_parameter(
            "checkpoint_path",
            "",
            "file in which what is learnt outlives a crash, or a folder for it; empty: none",
        )
        self._started = time.monotonic()
        self._compiler: subprocess.Popen[bytes] | None = None
        self._compile_again = 0.0
        if interpreting() and not self._lockstep:
            self.get_logger().info(
                "compiling, half a minute when first started on a computer: until then "
                "interpreted, so that estimates lag behind"
            )
            self._compiler = compiling(kind)
        else:
            if interpreting():
                self.get_logger().info("compiling: half a minute when first started on a computer")
            warm_up(config, kind)
        self._online = OnlineEstimator(config, kind)
        self._keeper = None if self._lockstep else self._recalled(str(checkpoint_path))

        self._reader = Reader(config)
        self._sources = subscribed(config.inputs)
        self._received: Counter[str] = Counter()
        self._waiting: deque[tuple[str, bytes, int]] = deque()  # messages received, not yet used
        self._resting_until = 0.0
        self._silence = dict.fromkeys(self._sources, 0.0)  # s since the last message
        self._idle = 0.0  # s since the last sample
        self._stopped = ""  # why there are no samples
        self._wrench_frame: str | None = None
        self._used = 0  # samples
        self._ratios: list[NDArray[np.float64]] = []  # (k, 6) since the last diagnostics
        self._published_stamp = 0  # ns
        self._kept = self._online.stamp  # ns; of the last checkpoint asked for
        self._watched = time.monotonic()
        self._parent = os.getppid()
        self._seen_counts: Counter[str] = Counter()
        self._seen_received: Counter[str] = Counter()
        self._diagnosed = time.monotonic()
        self._complaint, self._complained = "", 0.0

        self._coefficients = self.create_publisher(DiagnosticArray, "~/coefficients", LATCHED)
        self._values = self.create_publisher(Float64MultiArray, "~/coefficients/values", LATCHED)
        self._covariance = self.create_publisher(
            Float64MultiArray, "~/coefficients/covariance", LATCHED
        )
        self._residual = self.create_publisher(WrenchStamped, "~/wrench_residual", STREAM)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_service(Trigger, "~/reset", self._reset)
        self.create_service(Trigger, "~/save", self._save)
        self.create_service(SetBool, "~/enable", self._enable)
        if self._lockstep:
            self._acknowledge = self.create_publisher(UInt64, "~/received", STREAM)
            self.create_service(Trigger, "~/flush", self._flush)

        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._publish_timer = self.create_timer(
            1.0 / config.publish_rate, self._publish_in_time, clock=self._steady
        )
        self.create_timer(_WATCH_PERIOD, self._watch, clock=self._steady)
        self.create_timer(_DIAGNOSTICS_PERIOD, self._diagnose, clock=self._steady)
        if self._keeper is not None:
            self.create_timer(_CHECKPOINT_PERIOD, self._keep, clock=self._steady)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._take_parameters)

        # Last of all: from here on messages come in.
        qos = QoSProfile(
            depth=config.qos.depth,
            reliability=ReliabilityPolicy[config.qos.reliability.upper()],
        )
        # Raw: our decoder is fifty times as fast, and the one that reads bags.
        self._inputs = {
            role: self.create_subscription(type_, name, partial(self._receive, role), qos, raw=True)
            for role, (name, type_) in self._sources.items()
        }
        self._publish()
        self._judge = ThreadPoolExecutor(1, "watch")
        self._leaving = threading.Event()
        self._watch_compiler: subprocess.Popen[bytes] | None = None
        self.get_logger().info(
            f"active after {time.monotonic() - self._started:.1f} s: estimating "
            f"{len(self._online.prior.names)} coefficients of {config.name}"
        )

    def _own_parameter(self, name: str, default: object, description: str) -> object:
        if not self.has_parameter(name):
            descriptor = ParameterDescriptor(description=description, read_only=True)
            self.declare_parameter(name, default, descriptor)
        value = self.get_parameter(name).value
        if type(value) is not type(default):
            kind = "true or false" if isinstance(default, bool) else "text"
            raise UserError(f"{name} is {value!r}, but must be {kind}")
        return value

    @property
    def _config(self) -> Config:
        return self._online.config

    @property
    def _label(self) -> str:
        """In /diagnostics, which all vehicles share."""
        return str(self.get_fully_qualified_name()).lstrip("/")

    # ---------------------------------------------------------------- messages in

    def _receive(self, source: str, data: bytes) -> None:
        self._received[source] += 1
        self._silence[source] = 0.0
        arrival = self.get_clock().now().nanoseconds if self._reader.on_arrival else 0
        if len(self._waiting) == _MOST_WAITING:
            self._waiting.popleft()
            self._reader.counts["queue: too many messages wait, the oldest is left out"] += 1
        self._waiting.append((source, data, arrival))
        self._work()
        count = self._received.total()
        if self._lockstep and count % _ACKNOWLEDGED_TOGETHER == 0:  # the rest by _watch
            self._acknowledge.publish(UInt64(data=count))

    def _work(self) -> None:
        """Use messages that wait; while these are interpreted, for half of the time."""
        began = time.monotonic()
        if began < self._resting_until:
            return
        elapsed = 0.0
        while self._waiting and elapsed < _TURN:
            self._take(*self._waiting.popleft())
            elapsed = time.monotonic() - began
        if self._compiler is not None:
            self._resting_until = began + 2.0 * elapsed  # for callbacks, and the compiler

    def _take(self, source: str, data: bytes, arrival: int) -> None:
        for role, message in self._reader.read(source, data, arrival):
            info = self._online.push(role, message)
            # The sampler keeps to the frame of the first message that it takes.
            if role == WRENCH and self._wrench_frame is None and self._online.counts[WRENCH]:
                self._wrench_frame = message.frame_id
            if len(info):
                self._idle = 0.0
                self._show(info)
                # A queue that is worked off is learnt from faster than time goes.
                if self._keeper and self._online.stamp - self._kept > _CHECKPOINT_PERIOD * 1e9:
                    self._keep()

    def _look_after_compiler(self, now: float) -> None:
        """Go over to compiled kernels once there are any; the process may fail, for want of memory.

        What is learnt and all that is under way stay as they are: both use the same arrays.
        """
        if self._compiler is None or (status := self._compiler.poll()) is None:
            return
        if status and now > self._compile_again:
            self.get_logger().warning(f"compiling failed with status {status}: trying again")
            self._compile_again = now + _COMPILE_AGAIN
            self._compiler = compiling(self._online.kind)
        elif not status:
            self._compiler = None
            load(self._config, self._online.kind)
            _settle()
            self.get_logger().info(
                f"compiled after {time.monotonic() - self._started:.1f} s, "
                f"{len(self._waiting)} messages wait"
            )
            self._judge.submit(self._load_watcher).add_done_callback(self._complain)

    def _show(self, info: NDArray[np.void]) -> None:
        """Publish the residuals of samples, and what is due by their time."""
        if len(info) == 0:
            return
        self._used += int(np.count_nonzero(info["reason"] == ESTIMATORS[self._online.kind].USED))
        self._ratios.append(info["ratio"])
        origin = self._online.sampler.origin or 0
        residuals = info["residual"]
        for i in np.flatnonzero(np.isfinite(residuals).all(axis=1)):
            wrench = Wrench(
                origin + round(float(info["t"][i]) * 1e9),
                self._wrench_frame or "",
                residuals[i, :3],
                residuals[i, 3:],
            )
            frames = self._config.frames
            self._residual.publish(encode(from_core(wrench, frames.body, frames.world)))
        if self._lockstep:
            stamp = origin + round(float(info["t"][-1]) * 1e9)
            if not 0 <= stamp - self._published_stamp < 1e9 / self._config.publish_rate:
                self._published_stamp = stamp
                self._publish()

    # ---------------------------------------------------------------- coefficients out

    def _publish_in_time(self) -> None:
        if not self._lockstep:
            self._publish()

    def _publish(self) -> Report:
        report = self._online.report()
        if self._stopped:
            words = tuple(f"{self._stopped}: {text}" for text in report.messages)
            levels = (Level.STALE,) * len(report.names)
        elif not self._online.enabled:
            words = tuple(f"disabled: {text}" for text in report.messages)
            levels = report.levels
        else:
            words, levels = report.messages, report.levels
        shown = replace(report, messages=words, levels=levels)
        pairs = np.stack([report.values, report.std], axis=1)
        names = report.names
        self._covariance.publish(to_matrix(names, " ".join(names), report.covariance))
        self._values.publish(to_matrix(names, "value std", pairs))
        self._coefficients.publish(to_diagnostics(shown, self._config.name))
        return shown

    # ---------------------------------------------------------------- what the model lacks

    def begin_watching(self, interrupted: threading.Event) -> None:
        """Look for what the model lacks in a thread of its own, which may take its time.

        What is not compiled yet is compiled by another process: a thread of ours would stop us.
        """
        if self._compiler is not None:
            return  # later: it would be interpreted, too
        begun = self._judge.submit(self._load_watcher)
        begun.add_done_callback(self._complain)
        until = time.monotonic() + _LOADING_TIME
        while self._lockstep and not begun.done() and time.monotonic() < until:
            if interrupted.wait(0.01):
                return

    def _load_watcher(self) -> None:
        from rov_ident import watch  # here: not needed to begin with

        if not watch.is_compiled() and not self._leaving.is_set():
            self._watch_compiler = compiler(watch.__name__)
            if self._leaving.is_set():
                self._watch_compiler.terminate()
            if self._watch_compiler.wait():
                return  # we are leaving, or have no memory for it: estimating goes on without
        if self._leaving.is_set():  # a process does not end before its threads do
            return
        watch.compile_all()
        self._online.show(watch.Watcher(self._config, self._when_idle))

    def _when_idle(self, function: Callable[..., object], *arguments: object) -> None:
        self._judge.submit(function, *arguments).add_done_callback(self._complain)

    def _complain(self, job: "Future[Any]") -> None:
        if not job.cancelled() and (error := job.exception()):
            self.get_logger().error(f"watching what the model lacks failed: {error!r}")

    def _model_status(self) -> DiagnosticStatus:
        """What the model seems to lack, in words and numbers."""
        watcher = self._online.watcher
        found = [] if watcher is None else watcher.suspicions
        values = {}
        for i, suspicion in enumerate(found):
            number = f" {i + 1}" if i else ""
            values[f"effect{number}"] = suspicion.effect
            values[f"axis{number}"] = suspicion.axes
            values[f"score{number}"] = f"{suspicion.score:.3g}"
            values[f"price{number}"] = f"{suspicion.price:.3g}"
            values[f"share{number}"] = f"{suspicion.share:.3g}"
            values[f"alternatives{number}"] = " ".join(suspicion.rivals)
            for name, value in suspicion.parameters.items():
                values[f"{suspicion.effect}.{name}"] = f"{value:.4g} {suspicion.units[name]}"
        level = Level.WARN if found else Level.OK
        words = "; ".join(s.sentence for s in found) or (
            "the watch is being compiled" if watcher is None else "nothing is seen to be missing"
        )
        return to_status(f"{self._label}: model", self._config.name, level, words, values)

    # ---------------------------------------------------------------- checkpoints

    def _recalled(self, given: str) -> checkpoint.Keeper | None:
        """What keeps checkpoints, where that is asked for; what the last one holds is taken up."""
        if not given:
            return None
        path = Path(given).expanduser()
        if given.endswith("/") or path.is_dir():
            node = self.get_fully_qualified_name().replace("/", "_")
            path /= f"{configuration.as_file_name(self._config.name)}{node}.checkpoint"
        try:
            if checkpoint.read(self._online, path):
                self.get_logger().info(f"going on from {path}, of {self._online.stamp} ns")
        except UserError as error:
            self.get_logger().error(f"{error}; beginning with the prior")
        return checkpoint.Keeper(path, self._online)

    def _keep(self) -> None:
        assert self._keeper is not None
        if self._online.stamp != self._kept or self._keeper.failure:
            self._kept = self._online.stamp
            self._keeper.keep()

    def _checkpoint_status(self, keeper: checkpoint.Keeper) -> DiagnosticStatus:
        late = (self._online.stamp - keeper.saved) * 1e-9
        values = {"path": str(keeper.path), "write time": f"{keeper.took:.3g} s"}
        level, words = Level.OK, "what is learnt is on disk"
        if keeper.failure:
            level = Level.ERROR
            words = f"{keeper.path} cannot be written ({keeper.failure}): a crash loses what is new"
        elif self._kept == 0:
            words = "nothing learnt yet"
        elif late > _LATE:
            level, words = Level.WARN, f"the disk is slow: what is on it is {late:.1f} s old"
        return to_status(f"{self.get_name()}: checkpoint", self._config.name, level, words, values)

    # ---------------------------------------------------------------- watching

    def _watch(self) -> None:
        """Notice that the inputs have stopped, or in lockstep that the player has."""
        now = time.monotonic()
        # A node that had no processor for a while must not take its own silence for the inputs'.
        elapsed = min(now - self._watched, 2.0 * _WATCH_PERIOD)
        self._watched = now
        if self._lockstep:
            if os.getppid() != self._parent:
                self.context.try_shutdown()
            elif all(subscription.get_publisher_count() for subscription in self._inputs.values()):
                self._acknowledge.publish(UInt64(data=self._received.total()))
            return
        self._look_after_compiler(now)
        self._work()
        for role in self._silence:
            self._silence[role] += elapsed
        self._idle += elapsed
        before, self._stopped = self._stopped, ""
        if self._waiting:
            self._idle = 0.0  # whatever comes or not: there is enough to do
        elif self._missing(ODOMETRY) or self._missing(WRENCH):
            self._stopped = "inputs stopped"
            self._idle = 0.0  # counted from when they are there: their first messages have to wait
        elif self._online.enabled and self._idle > self._config.timeout:
            self._stopped = "no message of the inputs can be used"
        if self._stopped != before:
            if self._stopped:
                self._show(self._online.flush())
            self._publish()

    def _missing(self, role: str) -> bool:
        return self._silence[role] > max(self._config.timeout, _SLOW.get(role, 0.0))

    def _complaints(self) -> list[str]:
        """What keeps the inputs from being used, in words."""
        complaints = []
        for role, (name, _) in self._sources.items():
            if not self._missing(role) or self._lockstep:
                continue
            topic = self.resolve_topic_name(name)
            if self._received[role]:
                complaints.append(f"no more messages on {topic}: its driver has stopped")
            elif role == IMU:
                continue  # it may well have none
            elif self.count_publishers(topic):
                complaints.append(
                    f"no message received on {topic}, though it has a publisher: it is silent, "
                    "or of another type, or its quality of service does not match qos.reliability"
                )
            else:
                complaints.append(f"no message received on {topic}: remap it or start the driver")
        counts = self._online.counts + self._reader.counts
        refused = counts - self._seen_counts
        complaints += describe(
            {k: n for k, n in refused.items() if k not in _NO_COMPLAINT and n > _CHANCE.get(k, 0)}
        )
        self._seen_counts = counts
        return complaints

    def _diagnose(self) -> None:
        """Publish /diagnostics and log what is wrong."""
        now = time.monotonic()
        period, self._diagnosed = now - self._diagnosed, now
        complaints = self._complaints()
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [
            self._input_status(complaints, period),
            self._estimation_status(),
            self._model_status(),
        ]
        if self._keeper is not None:
            message.status.append(self._checkpoint_status(self._keeper))
        self._diagnostics.publish(message)
        # Without the numbers, which differ each time.
        complaint = "; ".join(text.partition(" (")[0] for text in complaints)
        if complaint and (complaint != self._complaint or now - self._complained > _LOG_PERIOD):
            self.get_logger().warning(complaint)
            self._complaint, self._complained = complaint, now

    def _input_status(self, complaints: list[str], period: float) -> DiagnosticStatus:
        values = {}
        for role, subscription in self._inputs.items():
            count = self._received[role] - self._seen_received[role]
            values[f"{role} rate"] = f"{count / period:.1f} Hz"
            values[f"{role} publishers"] = str(subscription.get_publisher_count())
        self._seen_received = self._received.copy()
        values.update({name: str(count) for name, count in sorted(self._seen_counts.items())})
        stopped = self._missing(ODOMETRY) or self._missing(WRENCH)
        level = Level.STALE if stopped else Level.WARN if complaints else Level.OK
        words = "; ".join(complaints) or "all messages are used"
        return to_status(f"{self._label}: inputs", self._config.name, level, words, values)

    def _estimation_status(self) -> DiagnosticStatus:
        report = self._online.report()
        values = {
            level.name: " ".join(
                name for name, at in zip(report.names, report.levels, strict=True) if at == level
            )
            for level in (Level.OK, Level.WARN, Level.ERROR)
        }
        values["condition number"] = f"{report.condition:.3g}"
        ratios = np.concatenate([np.zeros((0, 6)), *self._ratios])
        self._ratios.clear()
        for i, axis in enumerate("XYZKMN"):
            finite = ratios[np.isfinite(ratios[:, i]), i]
            if len(finite):
                values[f"test ratio {axis}"] = f"{finite.mean():.3g}"
        for part, ratio in self._online.sampler.ratios.items():
            values[f"test ratio odom {part}"] = f"{ratio:.3g}"
        converged = sum(level == Level.OK for level in report.levels)
        words = f"{converged} of {len(report.names)} coefficients have converged"
        if not self._online.enabled:
            level, words = Level.WARN, f"disabled, {words}"
        elif Level.ERROR in report.levels:
            level, words = Level.ERROR, f"{words}, diverged or at a bound: {values['ERROR']}"
        elif self._stopped:
            level, words = Level.STALE, f"no samples, coefficients held, {words}"
        else:
            level = Level.OK
        if self._waiting:
            words = f"{words}; {len(self._waiting)} messages wait"
        if self._compiler is not None:
            words = f"{words}; interpreted until compiled"
        return to_status(f"{self._label}: estimation", self._config.name, level, words, values)

    # ---------------------------------------------------------------- services

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._waiting.clear()  # of before the reset
        self._online.reset()
        self._publish()
        self.get_logger().info("reset to the prior")
        response.success, response.message = True, "back to the prior"
        return response

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._waiting.clear()  # else what came while disabled would be learnt
        self._online.enabled = request.data
        self._publish()
        response.success = True
        response.message = "estimating" if request.data else "disabled: coefficients are held"
        self.get_logger().info(response.message)
        return response

    def _save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Write the configuration with the coefficients as they are now."""
        report = self._online.report()
        values = dict(zip(report.names, report.values.tolist(), strict=True))
        lines = [f"Written by {self.get_name()}; standard deviations at {report.stamp} ns:"]
        lines += [
            f"{name}: {std:.3g} {unit}"
            for name, std, unit in zip(report.names, report.std, report.units, strict=True)
        ]
        path = os.path.abspath(str(self._save_path))
        try:
            configuration.dump(self._config.with_values(values), path, "\n".join(lines))
            later = f", {len(self._waiting)} messages still wait" if self._waiting else ""
            response.success, response.message = True, f"saved to {path}{later}"
        except UserError as error:
            response.success, response.message = False, str(error)
        self.get_logger().info(response.message)
        return response

    def _flush(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Use what still waits for a late topic; answers with the stamp [ns] of the last sample."""
        self._show(self._online.flush())
        if self._online.watcher is not None:
            self._judge.submit(int).result()  # whatever waits in front of it
        self._diagnose()
        response.success, response.message = True, str(self._publish().stamp)
        return response

    def take_leave(self) -> None:
        self._leaving.set()
        self._judge.shutdown(wait=False, cancel_futures=True)
        if self._keeper is not None:
            self._keep()
            self._keeper.close()
        for process in (self._compiler, self._watch_compiler):
            if process is not None:
                process.terminate()
        unused = f", {len(self._waiting)} messages not" if self._waiting else ""
        self.get_logger().info(f"ended: {self._used} samples used{unused}")

    # ---------------------------------------------------------------- parameters

    def _check_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            parameters.changed(self, _OWN_PARAMETERS, changes)
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take_parameters(self, _: list[Parameter]) -> None:
        # Only settings can change while running: the state stays good.
        self._online.configure(parameters.changed(self, _OWN_PARAMETERS))
        self.destroy_timer(self._publish_timer)
        self._publish_timer = self.create_timer(
            1.0 / self._config.publish_rate, self._publish_in_time, clock=self._steady
        )


def run(kind: Kind) -> int:
    """A node's whole life; its exit status: 0 after an interrupt, 2 for a bad configuration."""
    only_run()
    if not is_compiled(kind):
        interpret()
    return live(
        f"{kind}_node",
        lambda: _ready(kind),
        _OWN_PARAMETERS,
        begin=EstimatorNode.begin_watching,
        leave=EstimatorNode.take_leave,
    )


def _ready(kind: Kind) -> EstimatorNode:
    node = EstimatorNode(kind)
    _settle()
    sys.setswitchinterval(_SWITCHING)
    return node


def _settle() -> None:
    """What is there now stays: looking through it again and again would hold up samples."""
    gc.collect()
    gc.freeze()
