"""What `rls_node` and `ukf_node` share: declare parameters, decode, step, publish.

Nothing here computes a coefficient.
"""

import os
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray, UInt64
from std_srvs.srv import SetBool, Trigger

from rov_ident import config as configuration
from rov_ident.config import ESTIMATOR_PARAMETERS, Config
from rov_ident.core.errors import UserError
from rov_ident.core.frames import from_core
from rov_ident.core.messages import ODOMETRY, WRENCH, Message, Wrench
from rov_ident.core.states import State
from rov_ident.estimation import checkpoint
from rov_ident.estimation.online import ESTIMATORS, Kind, OnlineEstimator, Report
from rov_ident.io.cdr import encode
from rov_ident.io.topics import Reader
from rov_ident.nodes import parameters
from rov_ident.nodes.common import (
    DIAGNOSTICS_PERIOD,
    LATCHED,
    STREAM,
    GuardedNode,
    live,
    subscribed,
)
from rov_ident.nodes.compile_state import CompileState, settle
from rov_ident.nodes.conversions import to_diagnostics, to_matrix
from rov_ident.nodes.diagnostics import Diagnostics, Inputs
from rov_ident.nodes.model_monitor import ModelMonitor
from rov_ident.nodes.nomoto_input import NomotoInput

_SILENCE_PERIOD = 0.1  # s; between looks at the inputs: a tenth of the default timeout
_CHECKPOINT_PERIOD = 0.3  # s; with the time to write it a crash costs less than a second
_INPUT_SHARE = 4.0  # s left to the inputs for each of publishing, whatever publish_rate says
_TURN = 0.02  # s; of using messages that wait before anything else is done: one input at 50 Hz
_MOST_WAITING = 200_000
"""messages, of half a kilobyte: what 100 MB hold, a quarter of an hour at 200 Hz. More than enough
for compiling, unless that fails for ever."""
_TAKEN_TOGETHER = 16  # messages, in lockstep; a player may have more on their way
_SWITCHING = 0.0005
"""s; that a sample waits for another thread's turn. Python's own 5 ms would be the time of some
hundred samples (docs/speed.md)."""


class EstimatorNode(GuardedNode):
    """One online estimator on three topics.

    With the parameter `lockstep` a player sets the pace: messages are acknowledged by their count
    on `~/received`, coefficients are published by the time of the samples, silence is not taken for
    the end of the input, but `~/flush` ends it. The node goes when its player does.

    Raises UserError if the parameters make no configuration.
    """

    def __init__(self, kind: Kind, compiling: CompileState) -> None:
        super().__init__(f"{kind}_node", automatically_declare_parameters_from_overrides=True)
        config = parameters.declare(self)
        settings = parameters.declare_own(self, ESTIMATOR_PARAMETERS)
        named = f"{self._own_name(config)}.yaml"
        self._save_path = os.path.abspath(os.path.expanduser(settings["save_path"] or named))
        self._lockstep: bool = settings["lockstep"]
        self.outlives = not self._lockstep  # a replay tells its caller instead
        self._started = time.monotonic()
        self._compiling = compiling
        compiling.begin(config, self.get_logger(), wait=self._lockstep)
        self._online = OnlineEstimator(config, kind)
        self._keeper = None if self._lockstep else self._restored(settings["checkpoint_path"])

        self._reader = Reader(config)
        self._inputs = Inputs(subscribed(config.inputs))
        self._waiting: deque[tuple[str, bytes, int]] = deque()  # messages received, not yet used
        self._resting_until = 0.0
        self._idle = 0.0  # s since the last sample
        self._stopped = ""  # why there are no samples
        self._used = 0  # samples
        self._published_stamp = 0  # ns
        self._publish_again = 0.0  # s, of time.monotonic
        self._kept = self._online.stamp  # ns; of the last checkpoint asked for
        self._checked = time.monotonic()
        self._parent = os.getppid()
        self._monitor = ModelMonitor(self._online, self.get_logger())
        self._diagnostics = Diagnostics(
            self, self._online, self._reader, self._inputs, self._lockstep
        )

        self._coefficients = self.create_publisher(DiagnosticArray, "~/coefficients", LATCHED)
        self._values = self.create_publisher(Float64MultiArray, "~/coefficients/values", LATCHED)
        self._covariance = self.create_publisher(
            Float64MultiArray, "~/coefficients/covariance", LATCHED
        )
        self._residual = self.create_publisher(WrenchStamped, "~/wrench_residual", STREAM)
        self.create_service(Trigger, "~/reset", self._reset)
        self.create_service(Trigger, "~/save", self._save)
        self.create_service(SetBool, "~/enable", self._enable)
        if self._lockstep:
            self._acknowledge = self.create_publisher(UInt64, "~/received", STREAM)
            self.create_service(Trigger, "~/flush", self._flush)

        self._publish_timer = self.create_timer(1.0 / config.publish_rate, self._publish_in_time)
        self.create_timer(_SILENCE_PERIOD, self._check_inputs)
        self.create_timer(DIAGNOSTICS_PERIOD, self._diagnose)
        if self._keeper is not None:
            self.create_timer(_CHECKPOINT_PERIOD, self._write_checkpoint)
        parameters.follow(self, partial(parameters.changed, self), self._take_parameters)

        # Last of all: from here on messages come in.
        qos = QoSProfile(
            depth=config.qos.depth, reliability=ReliabilityPolicy[config.qos.reliability.upper()]
        )
        self._nomoto = (
            NomotoInput(self, config, kind, qos, self._lockstep) if config.nomoto else None
        )
        # Raw: our decoder is fifty times as fast, and the one that reads bags.
        for role, (name, type_) in self._inputs.sources.items():
            self._inputs.subscriptions[role] = self.create_subscription(
                type_, name, partial(self._receive, role), qos, raw=True,
                event_callbacks=SubscriptionEventCallbacks(
                    message_lost=partial(self._inputs.count_lost, role)
                ),
            )  # fmt: skip
        self._publish()
        self.get_logger().info(
            f"active after {time.monotonic() - self._started:.1f} s: estimating "
            f"{len(self._online.prior.names)} coefficients of {config.name}"
        )

    @property
    def _config(self) -> Config:
        return self._online.config

    @property
    def _played(self) -> list[Any]:
        """The subscriptions to all that a player plays."""
        rudder = [self._nomoto.subscription] if self._nomoto else []
        return [*self._inputs.subscriptions.values(), *rudder]

    def _receive(self, source: str, data: bytes) -> None:
        self._inputs.received[source] += 1
        self._inputs.silence[source] = 0.0
        timed = self._reader.on_arrival or self._nomoto
        arrival = self.get_clock().now().nanoseconds if timed else 0
        if len(self._waiting) == _MOST_WAITING:
            self._waiting.popleft()
            self._reader.counts["queue: too many messages wait, the oldest is left out"] += 1
        self._waiting.append((source, data, arrival))
        count = self._inputs.received.total()
        if not self._lockstep:
            self._work()
        elif count % _TAKEN_TOGETHER == 0:  # the rest by _check_inputs
            self._work()
            self._acknowledge.publish(UInt64(data=count))

    def _work(self) -> None:
        """Use messages that wait; for half of the time while kernels are interpreted."""
        began = time.monotonic()
        if began < self._resting_until:
            return
        for info in self._online.push_all(self._messages(began + _TURN), self._is_due):
            if len(info):
                self._idle = 0.0
                self._show(info)
                # A queue of waiting messages is learnt from faster than they came in.
                if self._keeper and self._online.stamp - self._kept > _CHECKPOINT_PERIOD * 1e9:
                    self._write_checkpoint()
        if self._compiling.interpreting:  # leave as much time for callbacks, and the compiler
            self._resting_until = 2.0 * time.monotonic() - began

    def _messages(self, end: float) -> Iterator[tuple[str, Message]]:
        """Role and message of those that wait, until the time ``end`` [s] of time.monotonic."""
        while self._waiting:
            source, data, arrival = self._waiting.popleft()
            for role, message in self._reader.read(source, data, arrival):
                if self._nomoto and role == ODOMETRY and self._online.enabled:
                    self._nomoto.heading(message, arrival)
                yield role, message
            if time.monotonic() >= end:
                return

    def _is_due(self, stamp: int) -> bool:
        """Whether coefficients are to be published after the sample of a stamp [ns]."""
        since = stamp - self._published_stamp
        return self._lockstep and not 0 <= since < 1e9 / self._config.publish_rate

    def _show(self, info: NDArray[np.void]) -> None:
        """Publish the residuals of samples, and the coefficients when due by their time."""
        if len(info) == 0:
            return
        self._used += int(np.count_nonzero(info["reason"] == ESTIMATORS[self._online.kind].USED))
        self._diagnostics.ratios.append(info["nis"])
        stamps = [self._online.stamp_of(t) for t in info["t"].tolist()]
        residuals = info["residual"]
        frames, frame_id = self._config.frames, self._online.sampler.validation.frame_id(WRENCH)
        for i in np.flatnonzero(np.isfinite(residuals).all(axis=1)).tolist():
            wrench = Wrench(stamps[i], frame_id, residuals[i, :3], residuals[i, 3:])
            self._residual.publish(encode(from_core(wrench, frames)))
        if self._is_due(stamps[-1]):
            self._published_stamp = stamps[-1]
            self._publish()

    def _publish_in_time(self) -> None:
        began = time.monotonic()
        if self._lockstep or began < self._publish_again:
            return
        self._publish()
        ended = time.monotonic()
        self._publish_again = ended + _INPUT_SHARE * (ended - began)

    def _publish(self) -> Report:
        report = self._online.report()
        if self._stopped:
            words = tuple(f"stale: {self._stopped} (before: {text})" for text in report.messages)
            report = replace(report, messages=words, states=(State.STALE,) * len(words))
        if self._nomoto:
            silent = self._inputs.is_missing(ODOMETRY, self._config.timeout)
            report = self._nomoto.beside(report, silent and not self._waiting)
        if not self._online.enabled:
            words = tuple(f"disabled: {text}" for text in report.messages)
            report = replace(report, messages=words)
        pairs = np.stack([report.values, report.std], axis=1)
        columns = " ".join(report.names)
        self._covariance.publish(to_matrix(report.names, columns, report.covariance))
        self._values.publish(to_matrix(report.names, "value std", pairs))
        self._coefficients.publish(to_diagnostics(report, self._config.name))
        return report

    def begin_monitoring(self, interrupted: threading.Event) -> None:
        """Look for what the model lacks, once kernels are compiled; a player waits for that."""
        if not self._compiling.interpreting:
            begun = self._monitor.begin()
            if self._lockstep:
                self._monitor.wait_for_loading(begun, interrupted)

    def _own_name(self, config: Config) -> str:
        """Of the vehicle and the node with its namespace: no two nodes write the same file."""
        node = self.get_fully_qualified_name().replace("/", "_")
        return configuration.as_file_name(config.name) + node

    def _restored(self, given: str) -> checkpoint.Keeper | None:
        """The keeper of checkpoints, if a path is given; the last checkpoint is restored."""
        if not given:
            return None
        path = Path(given).expanduser()
        if given.endswith("/") or path.is_dir():
            path /= f"{self._own_name(self._config)}.checkpoint"
        keeper = checkpoint.Keeper(path, self._online)
        if keeper.refused:
            self.get_logger().error(f"{keeper.failure}; beginning with the prior")
            return keeper
        try:
            if checkpoint.read(self._online, path):
                self.get_logger().info(f"continuing from {path}, of {self._online.stamp} ns")
        except UserError as error:
            self.get_logger().error(f"{error}; beginning with the prior")
        return keeper

    def _write_checkpoint(self) -> None:
        assert self._keeper is not None
        if self._online.stamp != self._kept or self._keeper.failure:
            self._kept = self._online.stamp
            self._keeper.keep()

    def _check_inputs(self) -> None:
        """Notice that the inputs have stopped, or in lockstep that the player has."""
        now = time.monotonic()
        # A node that did not run for a while must not conclude that its inputs were silent.
        elapsed = min(now - self._checked, 2.0 * _SILENCE_PERIOD)
        self._checked = now
        if self._lockstep:
            if os.getppid() != self._parent:
                self.context.try_shutdown()
            elif all(s.get_publisher_count() for s in self._played):
                self._work()
                self._acknowledge.publish(UInt64(data=self._inputs.received.total()))
            return
        if self._compiling.switched(self._config, self.get_logger()):
            self._monitor.begin()
        self._work()
        for role in self._inputs.silence:
            self._inputs.silence[role] += elapsed
        self._idle += elapsed
        before, self._stopped = self._stopped, ""
        ended = not self._waiting and self._inputs.have_stopped(self._config.timeout)
        if self._waiting:
            self._idle = 0.0  # there are messages to use, whether or not more come
        elif ended:
            self._stopped = "inputs stopped"
            self._idle = 0.0  # counted from their return: the first messages have to wait
        elif self._online.enabled and self._idle > self._config.timeout:
            self._stopped = "no message of the inputs can be used"
        if self._stopped != before:
            if ended:  # else what is waited for is still to come, and this node may just be slow
                self._show(self._online.flush())
            self._publish()

    def _diagnose(self) -> None:
        self._diagnostics.publish(
            self._stopped, len(self._waiting), self._compiling.interpreting, self._keeper
        )

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._waiting.clear()  # those from before the reset
        self._online.reset()
        if self._nomoto:
            self._nomoto.reset()
        self._publish()
        self.get_logger().info("reset to the prior")
        response.success, response.message = True, "back to the prior"
        return response

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data != self._online.enabled:
            self._work()
            self._waiting.clear()  # otherwise those received while disabled would be used
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
        try:
            new = self._config.with_values(values)
            configuration.dump(new, self._save_path, "\n".join(lines))
            later = f", {len(self._waiting)} messages still wait" if self._waiting else ""
            later += "" if report.stamp else ": no sample was used yet, these are the values given"
            response.success, response.message = True, f"saved to {self._save_path}{later}"
        except UserError as error:
            response.success, response.message = False, str(error)
        self.get_logger().info(response.message)
        return response

    def _flush(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Use what still waits for a late topic; answers with the stamp [ns] of the last sample."""
        while self._waiting:
            self._work()
        self._show(self._online.flush())
        self._monitor.finish()
        self._diagnose()
        response.success, response.message = True, str(self._publish().stamp)
        return response

    def take_leave(self) -> None:
        self._monitor.stop()
        if self._keeper is not None:
            self._write_checkpoint()
            self._keeper.close()
        self._compiling.stop()
        unused = f", {len(self._waiting)} messages left unused" if self._waiting else ""
        self.get_logger().info(f"ended: {self._used} samples used{unused}")

    def _take_parameters(self, config: Config) -> None:
        # Only settings can change while running: the state remains valid.
        self._online.configure(config)
        self.destroy_timer(self._publish_timer)
        self._publish_timer = self.create_timer(1.0 / config.publish_rate, self._publish_in_time)


def main(kind: Kind) -> int:
    """Run a node; its exit status is 0 after an interrupt, 2 for a bad configuration."""
    compiling = CompileState(kind)
    return live(
        f"{kind}_node",
        lambda: _kernels_loaded(kind, compiling),
        begin=EstimatorNode.begin_monitoring,
        leave=EstimatorNode.take_leave,
    )


def _kernels_loaded(kind: Kind, compiling: CompileState) -> EstimatorNode:
    node = EstimatorNode(kind, compiling)
    settle()
    sys.setswitchinterval(_SWITCHING)
    return node
