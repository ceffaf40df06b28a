"""`example_controller`: velocity control with the coefficients that an estimator has found.

Computed torque, ``tau = M (nu_ref_dot + gain (nu_ref - nu)) + C nu + D nu + g``, with a reference
that follows `cmd_vel` as a first-order lag: a start for a controller of your own.
"""

import math
import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, WrenchStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.qos import QoSProfile, ReliabilityPolicy

from rov_ident.consumer.hydrodynamic_model import HydrodynamicModel
from rov_ident.core.errors import UserError
from rov_ident.core.frames import (
    from_core,
    gravity_direction,
    quaternion_normalise,
    to_core,
    velocity_of_arm,
)
from rov_ident.core.messages import Array, Wrench
from rov_ident.io.cdr import decode_odometry, encode
from rov_ident.model.scales import authority
from rov_ident.nodes import parameters
from rov_ident.nodes.common import LATCHED, GuardedNode, live
from rov_ident.simulation.manoeuvres import LEVEL

_LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_RATE = 50.0  # Hz; usual for the velocity loop of an ROV
_FASTEST = 100.0  # m/s, rad/s; a larger value is no velocity
_LAG = 0.3  # s, of the reference behind the command
_OWN_PARAMETERS = {
    "gain": "of surge sway heave, roll pitch yaw [1/s]; an axis of gain 0 is left free",
    "limit": "of the wrench, X Y Z [N], K M N [N m]; left out: 1.5 times that of working speed",
}


class ExampleController(GuardedNode):
    """`odom`, `cmd_vel` (Twist, body axes) and `coefficients` in, `thruster_wrench` out.

    Without odometry or commands for `timeout` the wrench is zero; without fresh coefficients it
    goes on with the last good ones.

    Raises UserError if the parameters make no configuration.
    """

    def __init__(self) -> None:
        super().__init__("example_controller", automatically_declare_parameters_from_overrides=True)
        self._config = parameters.declare(self, _OWN_PARAMETERS)
        # By default roll and pitch are not controlled: the vehicle rights itself.
        self._gain = self._own_parameter("gain", np.array([2.0, 2.0, 2.0, 0.0, 0.0, 2.0]))
        self._limit = self._own_parameter("limit", 1.5 * authority(self._config.model))
        self._hydrodynamics = HydrodynamicModel(self._config)
        self._hydrodynamics.wrench(np.zeros(6), np.zeros(6), LEVEL)  # compiles

        self._nu, self._down = np.zeros(6), LEVEL
        self._stamp, self._measured = 0, -math.inf  # ns, s
        self._command, self._commanded = np.zeros(6), -math.inf  # s
        self._reference: Array | None = None  # (6,); None: stopped
        self._state, self._refused = "", ""
        self._output = self.create_publisher(WrenchStamped, "thruster_wrench", 10)
        self.create_subscription(DiagnosticArray, "coefficients", self._take, LATCHED)
        self.create_subscription(Twist, "cmd_vel", self._set_reference, _LATEST)
        self.create_subscription(Odometry, "odom", self._measure, _LATEST, raw=True)
        self.create_timer(1.0 / _RATE, self._control)

    def _own_parameter(self, name: str, value: Array) -> Array:
        if self.has_parameter(name):
            try:
                value = np.array(self.get_parameter(name).value, dtype=float)
            except (TypeError, ValueError):
                value = np.zeros(0)
            self.undeclare_parameter(name)
        if value.shape != (6,) or not (np.isfinite(value) & (value >= 0.0)).all():
            raise UserError(f"{name} must be six numbers, none negative: {_OWN_PARAMETERS[name]}")
        descriptor = ParameterDescriptor(description=_OWN_PARAMETERS[name], read_only=True)
        self.declare_parameter(name, value.tolist(), descriptor, ignore_override=True)
        return value

    def _take(self, message: DiagnosticArray) -> None:
        taken = self._hydrodynamics.take(message, time.monotonic())
        if taken.reason and taken.reason != self._refused:
            self.get_logger().warning(f"coefficients refused: {taken.reason}")
        self._refused = taken.reason

    def _set_reference(self, message: Twist) -> None:
        linear, angular = (np.array([v.x, v.y, v.z]) for v in (message.linear, message.angular))
        # A twist has the axes of a wrench.
        turned = to_core(Wrench(0, "", linear, angular), self._config.frames)
        command = np.concatenate([turned.force, turned.torque])
        if (abs(command) <= _FASTEST).all():  # false for NaN
            self._command, self._commanded = command, time.monotonic()

    def _measure(self, data: bytes) -> None:
        try:
            odometry = to_core(decode_odometry(data), self._config.frames)
        except ValueError:
            return
        at_origin = odometry.linear - velocity_of_arm(
            odometry.angular, self._config.odometry.position
        )
        nu = np.concatenate([at_origin, odometry.angular])
        down = gravity_direction(quaternion_normalise(odometry.orientation))
        good = (abs(nu) <= _FASTEST).all() and np.isfinite(down).all()
        # A driver that repeats a stamp has stopped measuring.
        if good and odometry.stamp != self._stamp:
            self._nu, self._down = nu, down
            self._stamp, self._measured = odometry.stamp, time.monotonic()

    def _control(self) -> None:
        now, tau = time.monotonic(), np.zeros(6)
        heard = {"odom": self._measured, "cmd_vel": self._commanded}
        silent = [topic for topic, at in heard.items() if now - at > self._config.timeout]
        if silent:
            self._reference, state = None, f"stopped: nothing usable on {' and '.join(silent)}"
        else:
            before = self._nu if self._reference is None else self._reference
            self._reference = before - math.expm1(-1.0 / (_RATE * _LAG)) * (self._command - before)
            nu_dot = (self._command - self._reference) / _LAG
            nu_dot += self._gain * (self._reference - self._nu)
            command = self._hydrodynamics.wrench(self._nu, nu_dot, self._down)
            command /= self._hydrodynamics.thrust_scale
            tau[self._gain > 0.0] = np.clip(command, -self._limit, self._limit)[self._gain > 0.0]
            fresh = "fresh" if self._hydrodynamics.fresh(now) else "the last good"
            state = f"controlling with {fresh} coefficients"
        frames, stamp = self._config.frames, self.get_clock().now().nanoseconds
        wrench = Wrench(stamp, "base_link", tau[:3], tau[3:])
        self._output.publish(encode(from_core(wrench, frames)))
        if state != self._state:
            self.get_logger().info(state)
            self._state = state


def main() -> int:
    return live("example_controller", ExampleController, own=_OWN_PARAMETERS)
