"""The input messages, and what else they are made from, free of middleware: in the axes of ROS, or
after ``frames.to_core`` (body forward-starboard-down, world north-east-down)."""

from math import hypot
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.errors import UserError

Array = NDArray[np.float64]

ODOMETRY, IMU, WRENCH = "odom", "imu", "wrench"  # the roles of the three inputs
DRIVE = "inputs"  # the role of fin angles and shaft speeds, where a vehicle has such


class Odometry(NamedTuple):
    """nav_msgs/Odometry: pose of the body in the world, velocity in body axes."""

    stamp: int  # ns
    frame_id: str  # world
    child_frame_id: str  # body
    position: Array  # (3,) m
    orientation: Array  # (4,) w x y z, body -> world
    linear: Array  # (3,) m/s, body axes
    angular: Array  # (3,) rad/s, body axes
    twist_variance: Array  # (6,) diagonal of the twist covariance; zeros: not given


class Imu(NamedTuple):
    """sensor_msgs/Imu: angular velocity and specific force in sensor axes."""

    stamp: int  # ns
    frame_id: str
    orientation: Array  # (4,) w x y z, sensor -> world
    angular_velocity: Array  # (3,) rad/s
    linear_acceleration: Array  # (3,) m/s2, specific force: +9.81 upward at rest
    angular_variance: Array  # (3,); zeros: not given
    acceleration_variance: Array  # (3,); zeros: not given


class Wrench(NamedTuple):
    """geometry_msgs/WrenchStamped: thruster wrench about the body origin, body axes."""

    stamp: int  # ns
    frame_id: str
    force: Array  # (3,) N
    torque: Array  # (3,) N m


class Joints(NamedTuple):
    """sensor_msgs/JointState: of fins and shafts, by name. What is not measured is left empty."""

    stamp: int  # ns
    frame_id: str
    names: tuple[str, ...]  # (k,)
    position: Array  # (k,) rad
    velocity: Array  # (k,) rad/s


class Twist(NamedTuple):
    """geometry_msgs/Twist(WithCovariance)Stamped: velocity in body axes."""

    stamp: int  # ns
    frame_id: str  # body
    linear: Array  # (3,) m/s
    angular: Array  # (3,) rad/s
    variance: Array  # (6,) diagonal of the covariance; zeros: not given


class Pose(NamedTuple):
    """geometry_msgs/Pose(WithCovariance)Stamped: the body in the world."""

    stamp: int  # ns
    frame_id: str  # world
    position: Array  # (3,) m
    orientation: Array  # (4,) w x y z, body -> world


class Commands(NamedTuple):
    """One number for each thruster, or each output of an autopilot."""

    stamp: int  # ns; 0: the message has none
    values: Array  # (k,)


Message = Odometry | Imu | Wrench | Joints

_TAKEN: dict[str, tuple[type[Message], dict[str, int]]] = {
    ODOMETRY: (
        Odometry,
        {"position": 3, "orientation": 4, "linear": 3, "angular": 3, "twist_variance": 6},
    ),
    IMU: (
        Imu,
        {"orientation": 4, "angular_velocity": 3, "linear_acceleration": 3, "angular_variance": 3,
         "acceleration_variance": 3},
    ),
    WRENCH: (Wrench, {"force": 3, "torque": 3}),
    DRIVE: (Joints, {}),
}  # fmt: skip


def check_form(role: str, message: Message) -> None:
    """Refuse what a program has put together wrongly; no message on the wire is so.

    Raises UserError: another role, type or shape, or a stamp that is no whole number.
    """
    if role not in _TAKEN:
        raise UserError(f"there is no input {role!r}: use one of {', '.join(_TAKEN)}")
    kind, lengths = _TAKEN[role]
    if not isinstance(message, kind):
        raise UserError(f"{role!r} takes a message {kind.__name__}, not {type(message).__name__}")
    if not isinstance(message.stamp, int | np.integer):
        raise UserError(f"the stamp is {message.stamp!r}, but must be whole nanoseconds")
    for name, length in lengths.items():
        if getattr(getattr(message, name), "shape", None) != (length,):
            raise UserError(f"{name} of an {role!r} must be a numpy array of shape ({length},)")


SECOND = 1_000_000_000  # ns
LAST_STAMP = (2**31 - 1) * SECOND  # ns; the end of ROS time, 32 bits of seconds


def fault(message: Message) -> str:
    """Why no vehicle can have sent this, or an empty string."""
    if message.stamp <= 0:
        return "zero stamp"
    if message.stamp >= LAST_STAMP:
        return "stamp at the end of time"
    if isinstance(message, Joints):
        return ""  # a joint that nobody uses may be not finite
    if isinstance(message, Odometry):
        p, q, v, w = message.position, message.orientation, message.linear, message.angular
        if not 0.5**0.5 < hypot(*q.tolist()) < 2.0**0.5:  # NaN too
            return "orientation is not a unit quaternion"
        size = hypot(*v.tolist(), *w.tolist(), 1e-6 * hypot(*p.tolist()))
    elif isinstance(message, Imu):
        w, f = message.angular_velocity, message.linear_acceleration
        size = hypot(*w.tolist(), 0.05 * hypot(*f.tolist()))
    else:
        f, w = message.force, message.torque
        size = 5e-5 * hypot(*f.tolist(), *w.tolist())
    # One comparison refuses NaN, infinities and what no vehicle reaches: 50 m/s, 50 rad/s,
    # 50,000 km, 100 g, 1 MN, 1 MN m.
    return "" if size < 50.0 else "not finite or absurdly large"
