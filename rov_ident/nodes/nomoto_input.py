"""Nomoto's K and T beside the coefficients of a node, from the heading and a rudder's topic."""

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from rov_ident.config import Config
from rov_ident.core.frames import quaternion_to_euler, to_core
from rov_ident.core.messages import ODOMETRY, Message, Odometry
from rov_ident.core.states import State, is_known
from rov_ident.estimation.online import Report
from rov_ident.io.topics import RUDDER, rudder_name, sources
from rov_ident.nodes.common import GuardedNode
from rov_ident.nodes.conversions import from_time
from rov_ident.nodes.diagnostics import clock_fault
from rov_ident.reports.result import NORMAL
from rov_ident.steering.nomoto_recursive import RecursiveNomoto
from rov_ident.steering.zigzag import GAP

NAMES, UNITS = ("nomoto.K", "nomoto.T"), ("1/s", "s")
_UNKNOWN = np.array([10.0, 1000.0])  # std of K [1/s] and T [s] before any data: a choice, very wide
_MOST = 20_000  # messages that wait for the rudder: some minutes


class NomotoInput:
    """Brings heading and rudder together by their stamps.

    A measured angle is linear in between, and a heading waits for one that is as late. A command is
    held until the next one, which is stamped on arrival: no heading that has come waits for it.
    With ``lockstep`` it comes as the joint `rudder`, stamped by a player at any speed.
    """

    def __init__(
        self, node: GuardedNode, config: Config, kind: str, qos: QoSProfile, lockstep: bool = False
    ) -> None:
        self._node, self._config, self._kind = node, config, kind
        self.reset()
        self._lockstep = lockstep
        self._topic = rudder_name(config)
        self._is_command = not config.rudder_joint  # as `rov-ident nomoto` takes a Float64
        joint, angle = (JointState, self._joints), (Float64, self._angle)
        type_, take = angle if self._is_command and not lockstep else joint
        self.subscription = node.create_subscription(type_, self._topic, take, qos)

    def reset(self) -> None:
        self._estimator = RecursiveNomoto(self._kind)
        self._headings: deque[tuple[int, float]] = deque(maxlen=_MOST)  # stamp [ns], angle [rad]
        self._rudder: deque[tuple[int, float]] = deque(maxlen=_MOST)
        self._origin = self._stamp = self._heard = 0  # ns
        self._age = {"heading": 0, "rudder": 0}  # ns; of the last message, when it arrived

    def heading(self, message: Message, arrival: int) -> None:
        """A message of the odometry, in the axes of its topic, and when it arrived [ns]."""
        if isinstance(message, Odometry):
            core: Any = to_core(message, self._config.frames)
            self._age["heading"] = arrival - core.stamp
            if self._is_set_back(core.stamp, self._heard):
                self._headings.clear()
                self._rudder.clear()
                self._heard = self._stamp = 0
            self._headings.append((core.stamp, float(quaternion_to_euler(core.orientation)[2])))
            self._heard = max(self._heard, core.stamp)
            self._advance()

    @staticmethod
    def _is_set_back(stamp: int, before: int) -> bool:
        """Whether a clock was set back between two stamps [ns]: a bag that begins again, say."""
        return stamp < before - GAP * 1e9

    def _joints(self, message: JointState) -> None:
        names, own = list(message.name), self._config.rudder_joint or RUDDER
        if own in names:  # other joints may have messages of their own
            angle = float(message.position[names.index(own)])
            stamp = from_time(message.header.stamp)
            self._take_rudder(stamp, angle)

    def _angle(self, message: Float64) -> None:
        self._take_rudder(0, float(message.data))

    def _take_rudder(self, stamp: int, angle: float) -> None:
        """``stamp`` 0: there is none."""
        arrival = self._node.get_clock().now().nanoseconds
        stamp = stamp or arrival
        self._age["rudder"] = arrival - stamp
        if self._rudder and self._is_set_back(stamp, self._rudder[-1][0]):
            self._rudder.clear()
        if not self._rudder or stamp > self._rudder[-1][0]:
            self._rudder.append((stamp, angle))
            self._advance()

    def _advance(self) -> None:
        """The headings up to which the rudder is known."""
        while self._headings and self._rudder:
            if not self._is_command and self._headings[0][0] > self._rudder[-1][0]:
                return
            at, heading = self._headings.popleft()
            while len(self._rudder) > 1 and self._rudder[1][0] < at:
                self._rudder.popleft()
                if self._is_command:
                    since, angle = self._rudder[0]
                    self._estimator.command(1e-9 * (since - self._origin), angle)
            begin, angle = self._rudder[0]
            if at < begin:
                continue  # nothing is known of the rudder then
            if not self._is_command:
                end, after = self._rudder[min(len(self._rudder), 2) - 1]
                if end - begin > GAP * 1e9:
                    continue  # nor here
                share = (at - begin) / (end - begin) if end > begin else 0.0
                angle += share * (after - angle)
            self._origin = self._origin or at
            self._estimator.push(1e-9 * (at - self._origin), heading, angle)
            self._stamp = at

    def beside(self, report: Report, silent: bool) -> Report:
        """The report with K and T behind the coefficients. ``silent``: headings have stopped."""
        found = self._estimator.result
        values = np.zeros(2) if found is None else found.values
        covariance = np.diag(_UNKNOWN**2) if found is None else found.covariance
        std = np.sqrt(np.diag(covariance))
        text, state = "converging", State.CONVERGING
        rudder = self._node.resolve_topic_name(self._topic)
        odometry = self._node.resolve_topic_name(sources(self._config.inputs)[ODOMETRY].topic)
        apart = 1e-9 * (self._age["heading"] - self._age["rudder"])
        if not self._rudder:
            text, state = f"held: no rudder on {rudder}", State.HELD
        elif self._heard and not self._lockstep and (fault := clock_fault(rudder, odometry, apart)):
            advice = " (beside a simulator: use_sim_time)" if self._is_command else ""
            text, state = f"held: {fault}{advice}", State.HELD
        elif found is None:
            text, state = "held: the rudder has not yet turned the vehicle enough", State.HELD
        elif silent or self._heard - self._stamp > GAP * 1e9:
            why = "no heading comes" if silent else "no rudder to the latest headings"
            text, state = f"stale: {why}", State.STALE
        elif all(map(is_known, values, std, (0.0, 0.0))):
            text, state = "converged", State.CONVERGED
        n = len(report.names)
        whole = np.zeros((n + 2, n + 2))
        whole[:n, :n], whole[n:, n:] = report.covariance, covariance
        return replace(
            report,
            stamp=max(report.stamp, self._stamp),
            names=(*report.names, *NAMES),
            units=(*report.units, *UNITS),
            values=np.append(report.values, values),
            std=np.append(report.std, std),
            lower=np.append(report.lower, values - NORMAL * std),
            upper=np.append(report.upper, values + NORMAL * std),
            covariance=whole,
            excitation=np.append(report.excitation, [np.nan, np.nan]),
            states=(*report.states, state, state),
            messages=(*report.messages, text, text),
        )
