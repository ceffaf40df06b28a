"""Input messages from CDR bytes, and the three of the core to them, without middleware.

Layout (XCDR1, little-endian): four bytes of encapsulation header, then the fields, each aligned to
its size counted from behind that header. The three messages of the core are a `std_msgs/Header`
(and a second string for Odometry) followed by nothing but float64: one `frombuffer` reads the rest.
"""

import struct
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.messages import (
    SECOND,
    Array,
    Commands,
    Imu,
    Joints,
    Message,
    Odometry,
    Pose,
    Twist,
    Wrench,
)

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
IMU_TYPE = "sensor_msgs/msg/Imu"
WRENCH_TYPE = "geometry_msgs/msg/WrenchStamped"
JOINTS_TYPE = "sensor_msgs/msg/JointState"
ROLE_TYPES = {"odom": ODOMETRY_TYPE, "imu": IMU_TYPE, "wrench": WRENCH_TYPE, "inputs": JOINTS_TYPE}

_ENCAPSULATION = b"\x00\x01\x00\x00"  # CDR, little-endian, no options
_STAMP = struct.Struct("<iI")
_HEADER = struct.Struct("<iII")  # a stamp, and the length of the frame id
_LENGTH = struct.Struct("<I")
_FLOAT = np.dtype("<f8")


class _Layout(NamedTuple):
    """Where the kept numbers are among the float64 of a message."""

    size: int  # float64 in the message
    kept: NDArray[np.intp]  # (n,) their indices, in the order of the fields of the core type
    # where covariances are: index of the first number, rows, and index of the first variance kept
    covariances: tuple[tuple[int, int, int], ...] = ()


# Quaternions are x y z w on the wire; of a covariance variances are kept.
# pose 7, its covariance 36, twist 6, its covariance 36
_ODOMETRY = _Layout(85, np.r_[0:3, 6, 3:6, 43:46, 46:49, 49:85:7], ((49, 6, 13),))
# orientation 4 + 9, angular velocity 3 + 9, acceleration 3 + 9
_IMU = _Layout(37, np.r_[3, 0:3, 13:16, 25:28, 16:25:4, 28:37:4], ((16, 3, 10), (28, 3, 13)))
_WRENCH = _Layout(6, np.r_[0:6])
_IMU_ORIENTATION_COVARIANCE = 4
_TWIST = _Layout(6, np.r_[0:6])
_TWIST_WITH_COVARIANCE = _Layout(42, np.r_[0:6, 6:42:7], ((6, 6, 6),))
_POSE = _Layout(7, np.r_[0:3, 6, 3:6])
_POSE_WITH_COVARIANCE = _Layout(43, _POSE.kept)


class _Fields:
    """The fields of a message, one after the other. Raises ValueError where the bytes end."""

    __slots__ = ("_at", "_data")

    def __init__(self, data: bytes) -> None:
        if data[:2] != _ENCAPSULATION[:2]:
            header = bytes(data[:4]).hex()
            raise ValueError(f"not little-endian CDR: encapsulation header {header!r}")
        self._data, self._at = data, len(_ENCAPSULATION)

    def _pass(self, size: int, count: int, what: str) -> int:
        """Where the next ``count`` values of ``size`` bytes begin; goes on behind them."""
        start = self._at + -(self._at - len(_ENCAPSULATION)) % size
        self._at = start + size * count
        if len(self._data) < self._at:
            raise ValueError(f"{len(self._data)} bytes end within {what}")
        return start

    def header(self) -> tuple[int, str]:
        """Stamp [ns] and frame id of the std_msgs/Header with which a message begins."""
        start = self._pass(4, 3, "the header")
        seconds, nanoseconds, length = _HEADER.unpack_from(self._data, start)
        if nanoseconds >= SECOND:
            raise ValueError(f"{nanoseconds} nanoseconds are no part of a second")
        return seconds * SECOND + nanoseconds, self._text(length)

    def length(self) -> int:
        return _LENGTH.unpack_from(self._data, self._pass(4, 1, "a length"))[0]

    def string(self) -> str:
        return self._text(self.length())

    def _text(self, length: int) -> str:
        start = self._pass(1, length, f"a string of {length}")
        return str(self._data[start : self._at], "utf-8").rstrip("\0")

    def numbers(self, kind: str, count: int) -> Array:
        """The next numbers of NumPy's ``kind`` as float64 (count,)."""
        start = self._pass(int(kind[-1]), count, "numbers")
        return np.frombuffer(self._data, kind, count, start).astype(float, copy=False)

    def kept(self, layout: _Layout) -> Array:
        numbers = np.frombuffer(
            self._data, _FLOAT, layout.size, self._pass(8, layout.size, "numbers")
        )
        kept = numbers.take(layout.kept)
        for first, size, to in layout.covariances:
            covariance = numbers[first : first + size * size]
            if np.count_nonzero(covariance) > size:
                kept[to : to + size] = independent(covariance.reshape(size, size))
        return kept

    def sequence(self, kind: str) -> Array:
        length = self.length()
        return self.numbers(kind, length) if length else np.zeros(0)  # without padding then


@np.errstate(invalid="ignore", over="ignore", divide="ignore")
def independent(covariance: Array) -> Array:
    """Variances (n,) of independent errors that are nowhere surer than ``covariance`` (n, n).

    Estimators here take the errors of one message as independent, and would count twice what two
    of them share. With s_i^2 sum_j |rho_ij| instead of s_i^2 nothing is: what this adds to the
    covariance is diagonally dominant once scaled by each 1/s_i, so it is no less in any direction
    (Gershgorin). What is not given (zero, negative, not finite) stays as it is.
    """
    variance = np.diag(covariance)
    given = (variance > 0.0) & (variance < np.inf)
    std = np.sqrt(np.where(given, variance, np.inf))
    share = np.minimum(np.abs(covariance) / np.outer(std, std), 1.0)
    share[~np.isfinite(share)] = 0.0
    np.fill_diagonal(share, 1.0)
    return np.where(given, variance * share.sum(axis=1), variance)


# Each raises ValueError on malformed bytes; axes are those on the wire.


def decode_odometry(data: bytes) -> Odometry:
    """A nav_msgs/msg/Odometry."""
    fields = _Fields(data)
    header, child_frame_id, n = fields.header(), fields.string(), fields.kept(_ODOMETRY)
    return Odometry(*header, child_frame_id, n[:3], n[3:7], n[7:10], n[10:13], n[13:])


def decode_imu(data: bytes) -> Imu:
    """A sensor_msgs/msg/Imu.

    A first variance of -1 says that the driver does not measure that quantity; it is passed on.
    """
    fields = _Fields(data)
    header, n = fields.header(), fields.kept(_IMU)
    return Imu(*header, n[:4], n[4:7], n[7:10], n[10:13], n[13:])


def decode_wrench(data: bytes) -> Wrench:
    """A geometry_msgs/msg/WrenchStamped."""
    fields = _Fields(data)
    header, n = fields.header(), fields.kept(_WRENCH)
    return Wrench(*header, n[:3], n[3:])


def decode_bare_wrench(data: bytes) -> Wrench:
    """A geometry_msgs/msg/Wrench: no stamp (0), no frame."""
    n = _Fields(data).kept(_WRENCH)
    return Wrench(0, "", n[:3], n[3:])


def decode_twist(data: bytes, layout: _Layout = _TWIST) -> Twist:
    """A geometry_msgs/msg/TwistStamped, or TwistWithCovarianceStamped with that layout."""
    fields = _Fields(data)
    header, n = fields.header(), fields.kept(layout)
    return Twist(*header, n[:3], n[3:6], n[6:] if len(n) > 6 else np.zeros(6))


def decode_pose(data: bytes, layout: _Layout = _POSE) -> Pose:
    """A geometry_msgs/msg/PoseStamped, or PoseWithCovarianceStamped with that layout."""
    fields = _Fields(data)
    header, n = fields.header(), fields.kept(layout)
    return Pose(*header, n[:3], n[3:7])


def decode_joint_state(data: bytes) -> Commands:
    """The efforts of a sensor_msgs/msg/JointState."""
    joints, fields = _joints(data)
    return Commands(joints.stamp, fields.sequence("<f8"))


def decode_joints(data: bytes) -> Joints:
    """Positions and velocities of a sensor_msgs/msg/JointState."""
    return _joints(data)[0]


def _joints(data: bytes) -> tuple[Joints, _Fields]:
    """A sensor_msgs/msg/JointState, and its fields from the efforts on."""
    fields = _Fields(data)
    header = fields.header()
    names = tuple(fields.string() for _ in range(fields.length()))
    position, velocity = fields.sequence("<f8"), fields.sequence("<f8")
    return Joints(*header, names, position, velocity), fields


def decode_channels(data: bytes) -> Commands:
    """A mavros_msgs/msg/RCOut: header and uint16[]."""
    fields = _Fields(data)
    stamp, _ = fields.header()
    return Commands(stamp, fields.sequence("<u2"))


def decode_multi_array(data: bytes, kind: str) -> Commands:
    """A std_msgs/msg/...MultiArray of NumPy's ``kind``: no stamp."""
    fields = _Fields(data)
    for _ in range(fields.length()):  # dimensions: label, size, stride
        fields.string(), fields.length(), fields.length()
    fields.length()  # data_offset
    return Commands(0, fields.sequence(kind))


def decode_voltage(data: bytes) -> float:
    """The voltage [V] of a sensor_msgs/msg/BatteryState."""
    fields = _Fields(data)
    fields.header()
    return float(fields.numbers("<f4", 1)[0])


DECODERS: dict[str, Callable[[bytes], Any]] = {
    ODOMETRY_TYPE: decode_odometry,
    IMU_TYPE: decode_imu,
    WRENCH_TYPE: decode_wrench,
    "geometry_msgs/msg/Wrench": decode_bare_wrench,
    "geometry_msgs/msg/TwistStamped": decode_twist,
    "geometry_msgs/msg/TwistWithCovarianceStamped": partial(
        decode_twist, layout=_TWIST_WITH_COVARIANCE
    ),
    "geometry_msgs/msg/PoseStamped": decode_pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": partial(
        decode_pose, layout=_POSE_WITH_COVARIANCE
    ),
    JOINTS_TYPE: decode_joint_state,
    "std_msgs/msg/Float64MultiArray": partial(decode_multi_array, kind="<f8"),
    "std_msgs/msg/Float32MultiArray": partial(decode_multi_array, kind="<f4"),
    "std_msgs/msg/UInt16MultiArray": partial(decode_multi_array, kind="<u2"),
    "std_msgs/msg/Int16MultiArray": partial(decode_multi_array, kind="<i2"),
    "mavros_msgs/msg/RCOut": decode_channels,
    "sensor_msgs/msg/BatteryState": decode_voltage,
}
"""By the name of the type; of joints their efforts."""


def encode(message: Message) -> bytes:
    """The bytes `rclpy.serialization.serialize_message` gives, with zeros as padding.

    Covariances are zero beside the diagonal, and altogether for pose and orientation, which the
    core types do not carry. An Imu with a zero quaternion has no attitude: its orientation
    covariance begins with -1, as sensor_msgs asks.

    Raises ValueError: a stamp outside the range of builtin_interfaces/Time.
    """
    if isinstance(message, Joints):
        return _encode_joints(message)
    strings, layout = [message.frame_id], _IMU if isinstance(message, Imu) else _WRENCH
    if isinstance(message, Odometry):
        strings, layout = [message.frame_id, message.child_frame_id], _ODOMETRY
    numbers = np.zeros(layout.size, dtype="<f8")
    numbers[layout.kept] = np.concatenate(message[1 + len(strings) :])
    if isinstance(message, Imu) and not message.orientation.any():
        numbers[_IMU_ORIENTATION_COVARIANCE] = -1.0

    body = _stamped(message.stamp)
    for text in strings:
        _append(body, text)
    body += bytes(-len(body) % 8) + numbers.tobytes()
    return _ENCAPSULATION + bytes(body)


def _encode_joints(message: Joints) -> bytes:
    body = _stamped(message.stamp)
    _append(body, message.frame_id)
    body += bytes(-len(body) % 4) + _LENGTH.pack(len(message.names))
    for name in message.names:
        _append(body, name)
    for numbers in (message.position, message.velocity, np.zeros(0)):
        body += bytes(-len(body) % 4) + _LENGTH.pack(len(numbers))
        if len(numbers):
            body += bytes(-len(body) % 8) + np.asarray(numbers, dtype="<f8").tobytes()
    return _ENCAPSULATION + bytes(body)


def _stamped(stamp: int) -> bytearray:
    try:
        return bytearray(_STAMP.pack(*divmod(stamp, SECOND)))
    except struct.error as error:
        raise ValueError(f"the stamp {stamp} ns does not fit a ROS time") from error


def _append(body: bytearray, text: str) -> None:
    raw = text.encode() + b"\0"
    body += bytes(-len(body) % 4) + _LENGTH.pack(len(raw)) + raw
