"""Input messages from CDR bytes, and the three of the core to them, without middleware.

Layout (XCDR1, little-endian): four bytes of encapsulation header, then the fields, each aligned to
its size counted from behind that header. The three messages of the core are a `std_msgs/Header`
(and a second string for Odometry) followed by nothing but float64: one `frombuffer` reads the rest.
"""

import struct
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.messages import Array, Commands, Imu, Message, Odometry, Pose, Twist, Wrench

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
IMU_TYPE = "sensor_msgs/msg/Imu"
WRENCH_TYPE = "geometry_msgs/msg/WrenchStamped"
ROLE_TYPES = {"odom": ODOMETRY_TYPE, "imu": IMU_TYPE, "wrench": WRENCH_TYPE}

_ENCAPSULATION = b"\x00\x01\x00\x00"  # CDR, little-endian, no options
_STAMP = struct.Struct("<iI")
_LENGTH = struct.Struct("<I")
_SECOND = 1_000_000_000  # ns


class _Layout(NamedTuple):
    """Where the kept numbers are among the float64 of a message."""

    size: int  # float64 in the message
    kept: NDArray[np.intp]  # (n,) their indices, in the order of the fields of the core type


# Quaternions are x y z w on the wire; of a covariance only the diagonal is kept.
_ODOMETRY = _Layout(
    85, np.r_[0:3, 6, 3:6, 43:46, 46:49, 49:85:7]
)  # pose 7, its covariance 36, twist 6, its covariance 36
_IMU = _Layout(
    37, np.r_[3, 0:3, 13:16, 25:28, 16:25:4, 28:37:4]
)  # orientation 4 + 9, angular velocity 3 + 9, acceleration 3 + 9
_WRENCH = _Layout(6, np.r_[0:6])
_IMU_ORIENTATION_COVARIANCE = 4
_TWIST = _Layout(6, np.r_[0:6])
_TWIST_WITH_COVARIANCE = _Layout(42, np.r_[0:6, 6:42:7])
_POSE = _Layout(7, np.r_[0:3, 6, 3:6])
_POSE_WITH_COVARIANCE = _Layout(43, _POSE.kept)


def decode_odometry(data: bytes) -> Odometry:
    """A nav_msgs/msg/Odometry, axes as on the wire. Raises ValueError on malformed bytes."""
    stamp, offset = _read_stamp(data)
    frame_id, offset = _read_string(data, offset)
    child_frame_id, offset = _read_string(data, offset)
    n = _read_numbers(data, offset, _ODOMETRY)
    return Odometry(stamp, frame_id, child_frame_id, n[:3], n[3:7], n[7:10], n[10:13], n[13:])


def decode_imu(data: bytes) -> Imu:
    """A sensor_msgs/msg/Imu, axes as on the wire. Raises ValueError on malformed bytes.

    A first variance of -1 says that the driver does not measure that quantity; it is passed on.
    """
    stamp, offset = _read_stamp(data)
    frame_id, offset = _read_string(data, offset)
    n = _read_numbers(data, offset, _IMU)
    return Imu(stamp, frame_id, n[:4], n[4:7], n[7:10], n[10:13], n[13:])


def decode_wrench(data: bytes) -> Wrench:
    """A geometry_msgs/msg/WrenchStamped, axes as on the wire. ValueError on malformed bytes."""
    stamp, offset = _read_stamp(data)
    frame_id, offset = _read_string(data, offset)
    n = _read_numbers(data, offset, _WRENCH)
    return Wrench(stamp, frame_id, n[:3], n[3:])


def decode_bare_wrench(data: bytes) -> Wrench:
    """A geometry_msgs/msg/Wrench: no stamp (0), no frame. ValueError on malformed bytes."""
    _check_header(data, 4)
    n = _read_numbers(data, 4, _WRENCH)
    return Wrench(0, "", n[:3], n[3:])


def decode_twist(data: bytes, layout: _Layout = _TWIST) -> Twist:
    """A geometry_msgs/msg/TwistStamped, axes as on the wire. ValueError on malformed bytes."""
    stamp, offset = _read_stamp(data)
    frame_id, offset = _read_string(data, offset)
    n = _read_numbers(data, offset, layout)
    variance = n[6:] if len(n) > 6 else np.zeros(6)
    return Twist(stamp, frame_id, n[:3], n[3:6], variance)


def decode_twist_with_covariance(data: bytes) -> Twist:
    """The same of a geometry_msgs/msg/TwistWithCovarianceStamped."""
    return decode_twist(data, _TWIST_WITH_COVARIANCE)


def decode_pose(data: bytes, layout: _Layout = _POSE) -> Pose:
    """A geometry_msgs/msg/PoseStamped, axes as on the wire. ValueError on malformed bytes."""
    stamp, offset = _read_stamp(data)
    frame_id, offset = _read_string(data, offset)
    n = _read_numbers(data, offset, layout)
    return Pose(stamp, frame_id, n[:3], n[3:7])


def decode_pose_with_covariance(data: bytes) -> Pose:
    """The same of a geometry_msgs/msg/PoseWithCovarianceStamped."""
    return decode_pose(data, _POSE_WITH_COVARIANCE)


def decode_joint_state(data: bytes) -> Commands:
    """The efforts of a sensor_msgs/msg/JointState. ValueError on malformed bytes."""
    stamp, offset = _read_stamp(data)
    _, offset = _read_string(data, offset)
    names, offset = _read_length(data, offset)
    for _ in range(names):
        _, offset = _read_string(data, offset)
    for _ in range(3):  # position, velocity, effort
        values, offset = _read_sequence(data, offset, "<f8")
    return Commands(stamp, values)


def decode_channels(data: bytes) -> Commands:
    """A mavros_msgs/msg/RCOut: header and uint16[]. ValueError on malformed bytes."""
    stamp, offset = _read_stamp(data)
    _, offset = _read_string(data, offset)
    values, _ = _read_sequence(data, offset, "<u2")
    return Commands(stamp, values)


def decode_multi_array(data: bytes, kind: str) -> Commands:
    """A std_msgs/msg/...MultiArray of NumPy's ``kind``: no stamp. ValueError on malformed bytes."""
    _check_header(data, 4)
    dimensions, offset = _read_length(data, 4)
    for _ in range(dimensions):
        _, offset = _read_string(data, offset)
        for _ in range(2):  # size, stride
            _, offset = _read_length(data, offset)
    _, offset = _read_length(data, offset)  # data_offset
    values, _ = _read_sequence(data, offset, kind)
    return Commands(0, values)


def decode_voltage(data: bytes) -> float:
    """The voltage [V] of a sensor_msgs/msg/BatteryState. ValueError on malformed bytes."""
    _, offset = _read_stamp(data)
    _, offset = _read_string(data, offset)
    offset += -(offset - 4) % 4
    if len(data) < offset + 4:
        raise ValueError("a message cut short")
    return float(np.frombuffer(data, "<f4", 1, offset)[0])


DECODERS: dict[str, Callable[[bytes], Message]] = {
    ODOMETRY_TYPE: decode_odometry,
    IMU_TYPE: decode_imu,
    WRENCH_TYPE: decode_wrench,
}


def encode(message: Message) -> bytes:
    """The bytes `rclpy.serialization.serialize_message` gives, with zeros as padding.

    Covariances are zero beside the diagonal, and altogether for pose and orientation, which the
    core types do not carry. An Imu with a zero quaternion has no attitude: its orientation
    covariance begins with -1, as sensor_msgs asks.

    Raises:
        ValueError: a stamp outside the range of builtin_interfaces/Time.
    """
    strings: tuple[str, ...]
    if isinstance(message, Odometry):
        layout, strings = _ODOMETRY, (message.frame_id, message.child_frame_id)
    elif isinstance(message, Imu):
        layout, strings = _IMU, (message.frame_id,)
    else:
        layout, strings = _WRENCH, (message.frame_id,)
    numbers = np.zeros(layout.size, dtype="<f8")
    numbers[layout.kept] = np.concatenate(message[1 + len(strings) :])
    if isinstance(message, Imu) and not message.orientation.any():
        numbers[_IMU_ORIENTATION_COVARIANCE] = -1.0

    try:
        body = bytearray(_STAMP.pack(*divmod(message.stamp, _SECOND)))
    except struct.error as error:
        raise ValueError(f"the stamp {message.stamp} ns does not fit a ROS time") from error
    for text in strings:
        raw = text.encode() + b"\0"
        body += bytes(-len(body) % 4) + _LENGTH.pack(len(raw)) + raw
    body += bytes(-len(body) % 8) + numbers.tobytes()
    return _ENCAPSULATION + bytes(body)


def _check_header(data: bytes, least: int) -> None:
    if data[:2] != _ENCAPSULATION[:2]:
        raise ValueError(f"not little-endian CDR: encapsulation header {bytes(data[:4]).hex()!r}")
    if len(data) < least:
        raise ValueError(f"{len(data)} bytes end within the header")


def _read_length(data: bytes, offset: int) -> tuple[int, int]:
    """The uint32 at the next multiple of four and the offset behind it."""
    start = offset + (-offset % 4)
    if len(data) < start + 4:
        raise ValueError(f"{len(data)} bytes end within a length")
    (length,) = _LENGTH.unpack_from(data, start)
    return length, start + 4


def _read_sequence(data: bytes, offset: int, kind: str) -> tuple[Array, int]:
    """The numbers of a sequence as float64 (k,), and the offset behind them."""
    length, offset = _read_length(data, offset)
    if length == 0:  # then there is no padding either
        return np.zeros(0), offset
    size = np.dtype(kind).itemsize
    offset += -(offset - 4) % size
    if len(data) < offset + size * length:
        raise ValueError(f"{len(data)} bytes end within {length} numbers")
    return np.frombuffer(data, kind, length, offset).astype(float), offset + size * length


def _read_stamp(data: bytes) -> tuple[int, int]:
    """The stamp in ns and the offset behind it."""
    _check_header(data, 12)
    seconds, nanoseconds = _STAMP.unpack_from(data, 4)
    if nanoseconds >= _SECOND:
        raise ValueError(f"{nanoseconds} nanoseconds are no part of a second")
    return seconds * _SECOND + nanoseconds, 12


def _read_string(data: bytes, offset: int) -> tuple[str, int]:
    """The string at the next multiple of four and the offset behind it."""
    start = offset + (-offset % 4) + 4  # the encapsulation header is four bytes as well
    if len(data) < start:
        raise ValueError(f"{len(data)} bytes end within a string")
    (length,) = _LENGTH.unpack_from(data, start - 4)
    end = start + length
    if len(data) < end:
        raise ValueError(f"{len(data)} bytes end within a string of {length}")
    return str(data[start:end], "utf-8").rstrip("\0"), end


def _read_numbers(data: bytes, offset: int, layout: _Layout) -> Array:
    """The kept float64 of the block at the next multiple of eight (behind the header)."""
    offset += -(offset - 4) % 8
    if len(data) < offset + 8 * layout.size:
        raise ValueError(f"{len(data)} bytes end within {layout.size} numbers")
    return np.frombuffer(data, "<f8", layout.size, offset).take(layout.kept)
