"""CDR bytes against the middleware's own serialization."""

import contextlib
import struct

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from nav_msgs.msg import Odometry as RosOdometry
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu as RosImu

from rov_ident.core.messages import Imu, Odometry, Wrench
from rov_ident.io import cdr

# Lengths that leave every alignment behind the strings, and one beyond ASCII.
FRAME_IDS = ["", "a", "ab", "abc", "abcd", "odom", "world_ned", "rov/base_link_frd", "pôle"]

stamps = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)


def vector(size):
    return hnp.arrays(np.float64, size, elements=st.floats(width=64))


odometries = st.builds(
    Odometry, stamps, texts, texts, vector(3), vector(4), vector(3), vector(3), vector(6)
)
imus = st.builds(Imu, stamps, texts, vector(4), vector(3), vector(3), vector(3), vector(3))
wrenches = st.builds(Wrench, stamps, texts, vector(3), vector(3))


def assign(target, values, names="xyz"):
    for name, value in zip(names, values, strict=True):
        setattr(target, name, float(value))


def ros_header(ros, message):
    ros.header.stamp.sec, ros.header.stamp.nanosec = divmod(message.stamp, 10**9)
    ros.header.frame_id = message.frame_id
    return ros


def ros_odometry(message):
    ros = ros_header(RosOdometry(), message)
    ros.child_frame_id = message.child_frame_id
    assign(ros.pose.pose.position, message.position)
    assign(ros.pose.pose.orientation, message.orientation, "wxyz")
    assign(ros.twist.twist.linear, message.linear)
    assign(ros.twist.twist.angular, message.angular)
    ros.twist.covariance = np.diag(message.twist_variance).ravel()
    return ros


def ros_imu(message):
    ros = ros_header(RosImu(), message)
    assign(ros.orientation, message.orientation, "wxyz")
    assign(ros.angular_velocity, message.angular_velocity)
    assign(ros.linear_acceleration, message.linear_acceleration)
    ros.angular_velocity_covariance = np.diag(message.angular_variance).ravel()
    ros.linear_acceleration_covariance = np.diag(message.acceleration_variance).ravel()
    return ros


def ros_wrench(message):
    ros = ros_header(WrenchStamped(), message)
    assign(ros.wrench.force, message.force)
    assign(ros.wrench.torque, message.torque)
    return ros


def examples(frame_id, child_frame_id):
    numbers = iter(np.linspace(-3.0, 4.0, 60))

    def take(n):
        return np.array([next(numbers) for _ in range(n)])

    stamp = 1_700_000_000_123_456_789
    return [
        (Odometry(stamp, frame_id, child_frame_id, *map(take, (3, 4, 3, 3, 6))), ros_odometry),
        (Imu(stamp, frame_id, *map(take, (4, 3, 3, 3, 3))), ros_imu),
        (Wrench(stamp, frame_id, *map(take, (3, 3))), ros_wrench),
    ]


def type_name(message):
    return {
        Odometry: "nav_msgs/msg/Odometry",
        Imu: "sensor_msgs/msg/Imu",
        Wrench: "geometry_msgs/msg/WrenchStamped",
    }[type(message)]


def assert_equal(a, b):
    assert type(a) is type(b)
    for left, right in zip(a, b, strict=True):
        np.testing.assert_array_equal(left, right)


def with_zero_padding(data, message):
    """The middleware leaves the bytes skipped for alignment uninitialised; here they are zero."""
    data = bytearray(data)
    end = 12
    sizes = [4 if isinstance(field, str) else 8 for field in message[1:]]
    texts = [field for field in message[1:] if isinstance(field, str)]
    for size, text in zip(sizes, [*texts, None], strict=False):
        start = end + -(end - 4) % size
        data[end:start] = bytes(start - end)
        end = start if text is None else start + 4 + len(text.encode()) + 1
    return bytes(data)


@pytest.mark.parametrize("frame_id", FRAME_IDS)
@pytest.mark.parametrize("child_frame_id", FRAME_IDS)
def test_bytes_are_those_of_the_middleware(frame_id, child_frame_id):
    for message, to_ros in examples(frame_id, child_frame_id):
        ros = to_ros(message)
        data = serialize_message(ros)
        assert cdr.encode(message) == with_zero_padding(data, message)
        assert deserialize_message(cdr.encode(message), type(ros)) == ros
        assert_equal(cdr.DECODERS[type_name(message)](data), message)


@given(st.one_of(odometries, imus, wrenches))
def test_round_trip(message):
    assert_equal(cdr.DECODERS[type_name(message)](cdr.encode(message)), message)


@given(hnp.arrays(float, (6, 6), elements=st.floats(-1.0, 1.0)), st.integers(0, 2**32 - 1))
def test_variances_of_a_covariance_claim_no_more_than_it_does(root, seed):
    scale = 10.0 ** np.random.default_rng(seed).uniform(-3.0, 1.0, 6)  # m/s and rad/s
    covariance = np.outer(scale, scale) * (root @ root.T)
    variance = cdr.independent(covariance)
    more = (np.diag(variance) - covariance) / np.outer(scale, scale)
    assert np.linalg.eigvalsh(more)[0] > -1e-9
    np.testing.assert_array_equal(cdr.independent(np.diag(variance)), variance)


def test_covariances_are_read_beside_their_diagonal():
    """Of pairs that share all of their error each variance is doubled: they count once."""
    correlated = np.diag([1.0, 4.0, 9.0, 16.0, 25.0, 0.0])
    correlated[0, 1] = correlated[1, 0] = 2.0
    correlated[2, 5] = correlated[5, 2] = 1.0  # with what is not measured
    correlated[3, 4] = correlated[4, 3] = -10.0
    ros = RosOdometry()
    ros.pose.covariance = np.arange(100.0, 136.0)
    ros.twist.covariance = correlated.ravel()
    message = cdr.decode_odometry(serialize_message(ros))
    np.testing.assert_allclose(message.twist_variance, [2.0, 8.0, 9.0, 24.0, 37.5, 0.0])
    ros = RosImu()
    ros.orientation_covariance = np.arange(100.0, 109.0)
    ros.angular_velocity_covariance = correlated[:3, :3].ravel()
    # the first says that there is none
    ros.linear_acceleration_covariance = np.array([-1.0, 2.0, 2.0, 2.0, 1.0, 2.0, 2.0, 2.0, 4.0])
    imu = cdr.decode_imu(serialize_message(ros))
    np.testing.assert_allclose(imu.angular_variance, [2.0, 8.0, 9.0])
    np.testing.assert_allclose(imu.acceleration_variance, [-1.0, 2.0, 8.0])


def test_an_imu_without_attitude_says_so_on_the_wire():
    message = examples("imu", "")[1][0]._replace(orientation=np.zeros(4))
    data = cdr.encode(message)
    assert deserialize_message(data, RosImu).orientation_covariance[0] == -1.0
    assert_equal(cdr.decode_imu(data), message)


@pytest.mark.parametrize("index", range(3))
def test_truncated_bytes_raise_value_error_at_every_length(index):
    message, _ = examples("odom", "base_link")[index]
    data = cdr.encode(message)
    decode = cdr.DECODERS[type_name(message)]
    for length in range(len(data)):
        with pytest.raises(ValueError, match=r"bytes end|encapsulation"):
            decode(data[:length])


@given(st.binary(max_size=900), st.sampled_from(sorted(cdr.DECODERS)))
def test_random_bytes_decode_or_raise_value_error(tail, name):
    with contextlib.suppress(ValueError):
        cdr.DECODERS[name](b"\x00\x01\x00\x00" + tail)


def test_a_length_beyond_the_message_and_bad_text_raise_value_error():
    data = bytearray(cdr.encode(examples("odom", "")[2][0]))
    data[12:16] = struct.pack("<I", 2**32 - 1)
    with pytest.raises(ValueError, match="string of 4294967295"):
        cdr.decode_wrench(bytes(data))
    data[12:16] = struct.pack("<I", 5)
    data[16] = 0xFF
    with pytest.raises(ValueError, match="utf-8"):
        cdr.decode_wrench(bytes(data))


def test_big_endian_is_refused_by_name():
    data = cdr.encode(examples("odom", "")[2][0])
    with pytest.raises(ValueError, match="little-endian"):
        cdr.decode_wrench(b"\x00\x00" + data[2:])


def test_a_stamp_beyond_ros_time_is_refused():
    with pytest.raises(ValueError, match="does not fit"):
        cdr.encode(examples("odom", "")[2][0]._replace(stamp=2**31 * 10**9))


def test_bytes_after_the_message_are_ignored():
    message, _ = examples("odom", "")[2]
    assert_equal(cdr.decode_wrench(cdr.encode(message) + b"\0\0\0"), message)
