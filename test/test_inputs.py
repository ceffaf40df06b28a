"""The same dive in every form that vehicles publish it in: the same estimate."""

import numpy as np
import pytest
from geometry_msgs.msg import (
    PoseStamped,
    PoseWithCovarianceStamped,
    TwistStamped,
    TwistWithCovarianceStamped,
)
from geometry_msgs.msg import Wrench as RosWrench
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import (
    Float32MultiArray,
    Float64MultiArray,
    Int16MultiArray,
    MultiArrayDimension,
    UInt16MultiArray,
)
from test_bags import write_mcap

from bench import DATA, HEAVY
from bench.simulators.live import Vehicle, end_node, same_to_rounding, start_node
from rov_ident import config
from rov_ident.core.errors import UserError
from rov_ident.core.frames import from_core, quaternion_from_euler, to_core
from rov_ident.core.messages import IMU, ODOMETRY, WRENCH, Imu, Odometry, Wrench
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.io import cdr
from rov_ident.io import topics as inputs
from rov_ident.io.bag_reader import Bag
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.write_messages import write_messages
from rov_ident.model import t200_curve as t200
from rov_ident.model import thruster_allocation as thrusters
from rov_ident.nodes.conversions import to_time
from rov_ident.nodes.replay import replay
from rov_ident.sampling.records import read_record
from rov_ident.sampling.sample import joined
from rov_ident.sampling.sampler import Sampler

C = 0.7071067811865476
POSITION = [
    [0.156, 0.111, 0.085], [0.156, -0.111, 0.085], [-0.156, 0.111, 0.085],
    [-0.156, -0.111, 0.085], [0.12, 0.218, 0.0], [0.12, -0.218, 0.0], [-0.12, 0.218, 0.0],
    [-0.12, -0.218, 0.0],
]  # fmt: skip
DIRECTION = [
    [C, -C, 0.0], [C, C, 0.0], [-C, -C, 0.0], [-C, C, 0.0],
    [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0],
]  # fmt: skip
"""The BlueROV2 Heavy (von Benzon et al. 2022, table A1), forward-starboard-down."""

GEOMETRY = {
    "thrusters.position": np.ravel(POSITION).tolist(),
    "thrusters.direction": np.ravel(DIRECTION).tolist(),
}


def configured(**changes):
    parameters = config.to_parameters(config.load(HEAVY))
    return config.from_parameters({**parameters, **changes})


def with_wrench(type_name, **more):
    return configured(**{"inputs.wrench": type_name}, **GEOMETRY, **more)


def full(type_name):
    return type_name.replace("/", "/msg/")


def write(path, rows):
    """A bag of (arrival, topic, type, message or bytes)."""
    with BagWriter(path) as writer:
        for arrival, topic, type_name, message in rows:
            data = message if isinstance(message, bytes) else serialize_message(message)
            writer.write(topic, full(type_name), arrival, data)
    return path


def standard(role):
    return f"/{inputs.ROLE_NAMES[role]}", cdr.ROLE_TYPES[role].replace("/msg/", "/")


def replaced(messages, role, convert):
    """(arrival, topic, type, message) of a dive, those of a role converted to a list of rows."""
    for arrival, own, message in messages:
        if own == role:
            yield from ((arrival, *row) for row in convert(message))
        else:
            yield arrival, *standard(own), cdr.encode(message)


def estimate(path, settings, kind="rls"):
    online = OnlineEstimator(settings, kind)
    bag = Bag(path)
    for role, message in inputs.messages(bag, inputs.select(bag, settings), settings):
        online.push(role, message)
    online.flush()
    return online.report()


def assert_same(report, expected, rtol=0.0):
    assert report.stamp == expected.stamp
    np.testing.assert_allclose(report.values, expected.values, rtol=rtol, atol=0.0)
    np.testing.assert_allclose(report.std, expected.std, rtol=rtol, atol=0.0)


@pytest.fixture(scope="module")
def matrix():
    return thrusters.allocation(np.array(POSITION), np.array(DIRECTION))


@pytest.fixture(scope="module")
def by_pulses(short_dive, matrix):
    """The dive with the wrench that whole pulse widths give, and these: {stamp: (8,)}."""
    inverse = np.linalg.pinv(matrix)
    curve = thrusters.t200(16.0)
    messages, pulses = [], {}
    for arrival, role, message in short_dive:
        if role == WRENCH:
            core = to_core(message)
            force = inverse @ np.concatenate([core.force, core.torque])
            assert curve[0] < force.min()
            assert force.max() < curve[-1]
            pulses[message.stamp] = 1100 + np.searchsorted(curve, force)
            tau = matrix @ curve[pulses[message.stamp] - 1100]
            message = from_core(Wrench(message.stamp, "base_link", tau[:3], tau[3:]))
        messages.append((arrival, role, message))
    return messages, pulses


@pytest.fixture(scope="module")
def reference(tmp_path_factory, by_pulses):
    path = tmp_path_factory.mktemp("reference") / "dive.mcap"
    write_messages(path, by_pulses[0])
    return estimate(path, config.load(HEAVY))


# ------------------------------------------------------------------ thrust


def test_a_wrench_without_a_stamp_is_stamped_on_arrival(tmp_path, by_pulses, reference):
    def bare(message):
        ros = RosWrench()
        ros.force.x, ros.force.y, ros.force.z = message.force.tolist()
        ros.torque.x, ros.torque.y, ros.torque.z = message.torque.tolist()
        yield "/thruster_wrench", "geometry_msgs/Wrench", ros

    on_time = [(m.stamp, role, m) for _, role, m in by_pulses[0]]
    path = write(tmp_path / "bare.mcap", replaced(on_time, WRENCH, bare))
    assert_same(estimate(path, configured(**{"inputs.wrench": "geometry_msgs/Wrench"})), reference)


ARRAYS = {
    "std_msgs/UInt16MultiArray": (UInt16MultiArray, 0.0),
    "std_msgs/Int16MultiArray": (Int16MultiArray, 0.0),
    "std_msgs/Float64MultiArray": (Float64MultiArray, 1e-9),
    "std_msgs/Float32MultiArray": (Float32MultiArray, 1e-4),
}


@pytest.mark.parametrize("type_name", ARRAYS)
def test_arrays_of_thruster_commands(tmp_path, by_pulses, reference, type_name):
    """Pulse widths exactly, forces to the digits of their floats; with dimensions in the layout."""
    messages, pulses = by_pulses
    kind, rtol = ARRAYS[type_name]
    curve = thrusters.t200(16.0)

    def commands(message):
        ros = kind()
        ros.layout.dim = [MultiArrayDimension(label="thrusters", size=8, stride=8)]
        pulse = pulses[message.stamp]
        ros.data = pulse.tolist() if rtol == 0.0 else curve[pulse - 1100].tolist()
        name = "thruster_pwm" if rtol == 0.0 else "thruster_forces"
        yield f"/rov/{name}", type_name, ros

    on_time = [(m.stamp, role, m) for _, role, m in messages]
    path = write(tmp_path / "arrays.mcap", replaced(on_time, WRENCH, commands))
    assert_same(estimate(path, with_wrench(type_name)), reference, rtol)


def joint_state(stamp, forces):
    ros = JointState()
    ros.header.stamp = to_time(stamp)
    ros.header.frame_id = "base"
    ros.name = [f"thruster_{i}" for i in range(len(forces))]
    ros.effort = forces.tolist()
    return ros


def test_stamped_forces_and_channels(tmp_path, by_pulses, reference):
    """JointState.effort, and RCOut (of mavros, which is not installed here) with 16 channels of
    which the vehicle uses eight in an order of its own; late on arrival, but stamped."""
    messages, pulses = by_pulses
    curve = thrusters.t200(16.0)
    order = [3, 1, 2, 8, 7, 6, 5, 9]

    def forces(message):
        state = joint_state(message.stamp, curve[pulses[message.stamp] - 1100])
        yield "/thruster_forces", "sensor_msgs/JointState", state

    def channels(message):
        header = serialize_message(joint_state(message.stamp, np.zeros(0)))[: 4 + 8 + 4 + 5]
        values = np.zeros(16, dtype="<u2")
        values[np.array(order) - 1] = pulses[message.stamp]
        data = header + bytes(-(len(header) - 4) % 4) + b"\x10\0\0\0" + values.tobytes()
        yield "/mavros/rc/out", "mavros_msgs/RCOut", data

    path = write(tmp_path / "forces.mcap", replaced(messages, WRENCH, forces))
    assert_same(estimate(path, with_wrench("sensor_msgs/JointState")), reference, 1e-9)

    # By another writer: ours knows only the types of ROS itself.
    rows = [
        (topic, full(type_name), arrival, data if isinstance(data, bytes) else b"")
        for arrival, topic, type_name, data in replaced(messages, WRENCH, channels)
    ]
    path = write_mcap(tmp_path / "channels.mcap", rows)
    settings = with_wrench("mavros_msgs/RCOut", **{"thrusters.channels": order})
    assert_same(estimate(path, settings), reference)


def test_axes_of_the_file_turn_the_thrusters(matrix):
    """A vehicle described forward-left-up has the same allocation, forward-starboard-down."""
    flip = np.array([1.0, -1.0, -1.0])
    parameters = config.to_parameters(config.load(HEAVY))
    for key in ("cog", "cob"):
        parameters["vehicle"][key] = (flip * parameters["vehicle"][key]).tolist()
    parameters["vehicle"]["frame"] = "flu"
    geometry = {
        "thrusters.position": (flip * np.array(POSITION)).ravel().tolist(),
        "thrusters.direction": (2.0 * flip * np.array(DIRECTION)).ravel().tolist(),
        "inputs.wrench": "std_msgs/UInt16MultiArray",
    }
    settings = config.from_parameters({**parameters, **geometry})
    np.testing.assert_allclose(thrusters.matrix(settings.thrusters), matrix, atol=1e-15)
    columns = (np.tile(flip, 2)[:, None] * matrix).T.ravel().tolist()
    del geometry["thrusters.position"], geometry["thrusters.direction"]
    settings = config.from_parameters({**parameters, **geometry, "thrusters.allocation": columns})
    np.testing.assert_allclose(thrusters.matrix(settings.thrusters), matrix, atol=1e-15)


def test_a_configuration_of_inputs_is_written_and_read(tmp_path):
    settings = with_wrench(
        "std_msgs/UInt16MultiArray",
        **{"inputs.odom": "geometry_msgs/TwistStamped", "topics.pose": "/pose"},
        **{"thrusters.voltage": 14.8, "thrusters.channels": [1, 2, 3, 4, 5, 6, 7, 9]},
    )
    config.dump(settings, tmp_path / "c.yaml")
    again = config.load(tmp_path / "c.yaml")
    for name in ("inputs", "thrusters", "topics"):
        assert getattr(again, name) == getattr(settings, name)


# ------------------------------------------------------------------ the curve of the T200


def test_the_curve_has_the_published_values():
    """Thrust of the performance data in kgf; 14 V is not in the table, and is met to 1.5 %."""
    published = {
        10.0: {1100: -2.31, 1900: 2.93, 1460: 0.0, 1540: 0.0},
        12.0: {1100: -2.92, 1900: 3.71},
        16.0: {1100: -4.07, 1308: -1.35, 1500: 0.0, 1700: 1.82, 1840: 4.25, 1900: 5.25},
        18.0: {1100: -4.59, 1900: 6.02},
    }
    for voltage, rows in published.items():
        curve = thrusters.t200(voltage) / t200.KILOGRAM_FORCE
        for pulse, force in rows.items():
            assert curve[pulse - 1100] == pytest.approx(force, abs=1e-9), (voltage, pulse)
        assert (np.diff(curve) >= -1e-12).all()
    at_14 = thrusters.t200(14.0) / t200.KILOGRAM_FORCE
    assert at_14[0] == pytest.approx(-3.52, rel=0.015)
    assert at_14[-1] == pytest.approx(4.52, rel=0.015)


def test_the_curve_against_the_whole_sheets():
    """The maker's measurement, every 4 us; the table in the code has a tenth of it."""
    path = DATA / "t200" / "t200_bollard.csv"
    if not path.exists():
        pytest.skip("the measured curves of the T200 are not here")
    rows = np.loadtxt(path, delimiter=",", skiprows=2)
    for voltage, rms, largest in ((10, 0.35, 1.4), (12, 0.35, 1.4), (14, 0.35, 1.4),
                                  (16, 0.35, 1.4), (18, 1.2, 3.1)):  # fmt: skip
        sheet = rows[rows[:, 0] == voltage]
        off = thrusters.t200(voltage)[sheet[:, 1].astype(int) - 1100] - sheet[:, 3]
        assert np.sqrt(np.mean(off**2)) < rms
        assert np.abs(off).max() < largest


@pytest.mark.parametrize("voltage", [9.9, 24.0, float("nan")])
def test_a_voltage_outside_the_table_is_refused(voltage):
    with pytest.raises(UserError, match="from 10 to 18 V"):
        thrusters.t200(voltage)


def battery(voltage):
    return serialize_message(BatteryState(voltage=voltage))


def by_battery(**more):
    return with_wrench(
        "mavros_msgs/RCOut", **{"inputs.battery": config.schema.BATTERY_TYPE}, **more
    )


def test_pulses_at_the_voltage_of_the_battery():
    """From the message that says it on; what cannot be is counted, and changes nothing."""
    settings = by_battery(**{"thrusters.voltage": 12.0})
    allocator = thrusters.Allocator(settings.thrusters, thrusters.PWM)
    reader = inputs.Reader(settings)
    pulses = np.array([1900, 1800, 1700, 1600, 1400, 1300, 1200, 1100], dtype="<u2")
    header = serialize_message(JointState())[: 4 + 8 + 4 + 4]
    data = header + b"\x08\0\0\0" + pulses.tobytes()

    def force_at(voltage):
        ((_, wrench),) = reader.read(WRENCH, data, 0)
        expected = allocator.wrench(pulses, voltage)
        core = to_core(wrench, settings.frames)
        np.testing.assert_allclose(np.concatenate([core.force, core.torque]), expected)

    force_at(12.0)
    for voltage in (15.25, 10.5):
        assert reader.read("battery", battery(voltage), 0) == []
        force_at(voltage)
    for voltage in (float("nan"), 5.0, 24.0):
        assert reader.read("battery", battery(voltage), 0) == []
        force_at(10.5)
    assert reader.counts == {"battery: a voltage for which the T200 has no curve": 3}


def test_a_bag_with_a_battery(tmp_path, by_pulses, reference):
    """Full until the end, with thrusters.voltage of another: the dive at 16 V."""
    messages, pulses = by_pulses

    def rows():
        yield messages[0][0], "/battery", config.schema.BATTERY_TYPE, battery(16.0)
        for arrival, role, message in messages:
            if role == WRENCH:
                array = UInt16MultiArray(data=pulses[message.stamp].tolist())
                yield message.stamp, "/thruster_pwm", "std_msgs/UInt16MultiArray", array
            else:
                yield arrival, *standard(role), cdr.encode(message)

    settings = with_wrench(
        "std_msgs/UInt16MultiArray",
        **{"inputs.battery": config.schema.BATTERY_TYPE, "thrusters.voltage": 12.0},
    )
    assert_same(estimate(write(tmp_path / "dive.mcap", rows()), settings), reference)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"inputs.wrench": "sensor_msgs/JointState"},
        {
            "inputs.wrench": "mavros_msgs/RCOut",
            "thrusters.curve_pwm": [1100.0, 1900.0],
            "thrusters.curve_force": [-40.0, 50.0],
        },
    ],
)
def test_a_battery_that_nothing_depends_on_is_refused(changes):
    with pytest.raises(UserError, match=r"inputs\.battery .* leave it out"):
        configured(**{"inputs.battery": config.schema.BATTERY_TYPE}, **GEOMETRY, **changes)


def test_an_output_that_is_off_pushes_nothing():
    settings = with_wrench("std_msgs/UInt16MultiArray")
    allocator = thrusters.Allocator(settings.thrusters, thrusters.PWM)
    np.testing.assert_array_equal(allocator.wrench([0, 65535, 1500, 1490, 0, 0, 0, 0]), np.zeros(6))
    top, more = ([p] + [1500] * 7 for p in (1900, 2000))
    np.testing.assert_array_equal(allocator.wrench(top), allocator.wrench(more))
    normalized = thrusters.Allocator(settings.thrusters, thrusters.NORMALIZED)
    np.testing.assert_array_equal(normalized.wrench([1.0] + [0.0] * 7), allocator.wrench(top))


def test_a_curve_of_ones_own(matrix):
    settings = with_wrench(
        "std_msgs/UInt16MultiArray",
        **{"thrusters.curve_pwm": [1100, 1500, 1900], "thrusters.curve_force": [-20.0, 0.0, 40.0]},
    )
    allocator = thrusters.Allocator(settings.thrusters, thrusters.PWM)
    force = np.array([-10.0, 0, 0, 0, 20.0, 0, 0, 0])
    pulses = [1300, 1500, 1500, 1500, 1700, 1500, 1500, 1500]
    np.testing.assert_allclose(allocator.wrench(pulses), matrix @ force, atol=1e-12)


# ------------------------------------------------------------------ motion


def twist_and_pose(kind, message, poses=True):
    """The two ROS messages of an odometry message."""
    if kind == "covariance":
        twist, pose = TwistWithCovarianceStamped(), PoseWithCovarianceStamped()
        moving, at = twist.twist.twist, pose.pose.pose
        twist.twist.covariance[::7] = message.twist_variance
    else:
        twist, pose = TwistStamped(), PoseStamped()
        moving, at = twist.twist, pose.pose
    twist.header.stamp = pose.header.stamp = to_time(message.stamp)
    twist.header.frame_id, pose.header.frame_id = message.child_frame_id, message.frame_id
    moving.linear.x, moving.linear.y, moving.linear.z = message.linear.tolist()
    moving.angular.x, moving.angular.y, moving.angular.z = message.angular.tolist()
    at.position.x, at.position.y, at.position.z = message.position.tolist()
    q = at.orientation
    q.w, q.x, q.y, q.z = message.orientation.tolist()
    yield "/velocity", f"geometry_msgs/{type(twist).__name__}", twist
    if poses:
        yield "/pose", f"geometry_msgs/{type(pose).__name__}", pose


def with_twist(kind, **more):
    names = {"covariance": "WithCovariance"}
    word = names.get(kind, "")
    return configured(
        **{
            "inputs.odom": f"geometry_msgs/Twist{word}Stamped",
            "inputs.pose": f"geometry_msgs/Pose{word}Stamped",
        },
        **more,
    )


@pytest.mark.parametrize("kind", ["plain", "covariance"])
def test_a_twist_and_its_pose_are_odometry(tmp_path, short_dive, kind):
    """Exactly, where their stamps are equal; a plain twist has no variances."""
    if kind == "plain":
        short_dive = [
            (a, r, m._replace(twist_variance=np.zeros(6)) if r == ODOMETRY else m)
            for a, r, m in short_dive
        ]
    write_messages(tmp_path / "odometry.mcap", short_dive)
    rows = replaced(short_dive, ODOMETRY, lambda m: twist_and_pose(kind, m))
    path = write(tmp_path / "twist.mcap", rows)
    expected = estimate(tmp_path / "odometry.mcap", config.load(HEAVY))
    assert_same(estimate(path, with_twist(kind)), expected)


def test_a_pose_at_other_times_is_interpolated(tmp_path, heavy):
    """Poses at half the rate and other stamps: attitude and position of the truth in between."""
    from rov_ident.simulation import virtual_sensors as sensors

    still = sensors.Suite().scaled(0.0)
    messages = sensors.dive(heavy, duration=10.0, suite=still, seed=1).messages
    known = [m for _, role, m in messages if role == ODOMETRY]
    settings = with_twist("plain")
    reader = inputs.Reader(settings)
    found = []
    for k, message in enumerate(known):
        twist, pose = twist_and_pose("plain", message)
        for role, row in (("odom", twist), ("pose", pose)):
            if role == "odom" or k % 2 == 0:
                found += reader.read(role, serialize_message(row[2]), 0)
    reader.flush()
    missing = len(known) - len(found)
    assert missing <= 1
    assert sum(reader.counts.values()) == missing
    for (_, odometry), message in zip(found, known, strict=False):
        assert odometry.stamp == message.stamp
        # h^2/8 of the acceleration: 0.1 s between poses, up to 4 m/s2 and 10 rad/s2.
        np.testing.assert_allclose(odometry.position, message.position, atol=5e-3)
        off = 2.0 * np.arccos(min(1.0, abs(odometry.orientation @ message.orientation)))
        assert off < 0.0125


def test_a_velocity_log_has_no_rates(tmp_path, short_dive):
    """Zeros in the angular part of a twist are no measurement: the IMU's rates serve, unbiased."""
    silent = [
        (a, r, m._replace(angular=np.zeros(3), twist_variance=np.zeros(6)) if r == ODOMETRY else m)
        for a, r, m in short_dive
    ]
    marked = [
        (a, r, m._replace(twist_variance=np.repeat([0.0, 1e6], 3)) if r == ODOMETRY else m)
        for a, r, m in silent
    ]
    write_messages(tmp_path / "marked.mcap", marked)
    rows = replaced(silent, ODOMETRY, lambda m: twist_and_pose("plain", m))
    found = estimate(write(tmp_path / "dvl.mcap", rows), with_twist("plain"))
    assert_same(found, estimate(tmp_path / "marked.mcap", config.load(HEAVY)))
    write_messages(tmp_path / "silent.mcap", silent)
    assert_same(found, estimate(tmp_path / "silent.mcap", config.load(HEAVY)))  # as odometry, too
    whole = [
        (a, r, m._replace(twist_variance=np.zeros(6)) if r == ODOMETRY else m)
        for a, r, m in short_dive
    ]
    write_messages(tmp_path / "whole.mcap", whole)
    usual = estimate(tmp_path / "whole.mcap", config.load(HEAVY))
    assert np.all(np.abs(found.values - usual.values) < 3.0 * usual.std)


def test_rates_that_are_not_measured_say_nothing_of_the_gyro(heavy):
    """A slow turn, which zeros of a velocity log would have for a bias of the gyro."""
    sampler = Sampler(heavy)
    zero, rate = np.zeros(3), 0.02
    parts = []
    for k in range(1, 1001):
        stamp = k * 10_000_000
        sampler.push(WRENCH, Wrench(stamp, "base_link_frd", zero, zero))
        force = np.array([0.0, 0.0, -heavy.gravity])
        gyro = np.array([0.0, 0.0, rate])
        imu = Imu(stamp, "imu_frd", np.zeros(4), gyro, force, zero, zero)
        parts.append(sampler.push(IMU, imu))
        if k % 5 == 0:
            q = quaternion_from_euler(0.0, 0.0, rate * 1e-9 * stamp)
            variance = np.repeat([0.0, 1e6], 3)
            odometry = Odometry(stamp, "w_ned", "base_link_frd", zero, q, zero, zero, variance)
            parts.append(sampler.push(ODOMETRY, odometry))
    samples = joined([part for part in parts if len(part)])
    # To a tenth of the noise of the gyro.
    np.testing.assert_allclose(samples["nu"][-100:, 5], rate, atol=3e-4)


def test_twists_without_poses_are_told(tmp_path, short_dive):
    rows = list(replaced(short_dive, ODOMETRY, lambda m: twist_and_pose("plain", m)))
    rows = [r for r in rows if r[1] != "/pose" or r[0] < 3_000_000_000]
    record = read_record(write(tmp_path / "cut.mcap", rows), with_twist("plain"))
    assert any("a twist without a pose around it" in note for note in record.notes)
    assert 30 < np.count_nonzero(record.samples["measured"]) < 50


# ------------------------------------------------------------------ refusals


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"inputs.wrench": "std_msgs/UInt16MultiArray"}, "thrusters has no allocation"),
        ({"inputs.wrench": "std_msgs/UInt8MultiArray"}, "must be one of"),
        ({**GEOMETRY, "thrusters.direction": [1.0, 0.0, 0.0]}, "both must have three"),
        ({**GEOMETRY, "thrusters.direction": [0.0] * 24}, "of length zero"),
        ({**GEOMETRY, "thrusters.allocation": [1.0] * 6}, "keep one of them"),
        ({"thrusters.allocation": [1.0] * 7}, "six for each thruster"),
        ({**GEOMETRY, "thrusters.channels": [1, 2]}, "but there are 8 thrusters"),
        ({**GEOMETRY, "thrusters.channels": [0.5] * 8}, "whole numbers from 1"),
        ({**GEOMETRY, "thrusters.voltage": 24.0}, "from 10 to 18 V"),
        ({**GEOMETRY, "thrusters.curve_pwm": [1100, 1900]}, "as many of the one as of the other"),
        (
            {**GEOMETRY, "thrusters.curve_pwm": [1900, 1100], "thrusters.curve_force": [0, 1]},
            "must increase",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_in_words(changes, words):
    with pytest.raises(UserError, match=words):
        configured(**{"inputs.wrench": "std_msgs/UInt16MultiArray", **changes})


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([1500] * 6, "an array of 6 values, but thrusters needs 8"),
        ([1500] * 7 + [3], "a pulse that is none"),
        ([], "an array of 0 values"),
    ],
)
def test_a_wrong_array_is_counted_under_its_reason(tmp_path, short_dive, data, words):
    def commands(_):
        yield "/thruster_pwm", "std_msgs/UInt16MultiArray", UInt16MultiArray(data=data)

    path = write(tmp_path / "wrong.mcap", replaced(short_dive, WRENCH, commands))
    with pytest.raises(UserError, match=words):
        read_record(path, with_wrench("std_msgs/UInt16MultiArray"))


def test_a_bag_of_another_type_says_which_key_to_set(tmp_path, short_dive):
    def commands(_):
        yield "/rov/pwm", "std_msgs/UInt16MultiArray", UInt16MultiArray(data=[1500] * 8)

    path = write(tmp_path / "pwm.mcap", replaced(short_dive, WRENCH, commands))
    words = r"Or is it /rov/pwm\? Then set inputs.wrench to std_msgs/UInt16MultiArray"
    with pytest.raises(UserError, match=words):
        read_record(path, config.load(HEAVY))


DAMAGED = [
    b"",
    b"\0\1\0\0",
    b"\0\0\0\0" + bytes(40),  # big-endian
    b"\0\1\0\0" + b"\xff" * 40,
    bytes(400),
]


@pytest.mark.parametrize("data", DAMAGED)
@pytest.mark.parametrize("type_name", sorted(set(cdr.DECODERS) - {cdr.IMU_TYPE}))
def test_bytes_that_are_no_message(type_name, data):
    type_name = type_name.replace("/msg/", "/")
    role = (
        "pose"
        if "Pose" in type_name
        else "odom"
        if type_name in config.schema.ODOMETRY_TYPES
        else "battery"
        if type_name == config.schema.BATTERY_TYPE
        else "wrench"
    )
    changes = {f"inputs.{role}": type_name}
    if role == "battery":
        changes["inputs.wrench"] = "std_msgs/UInt16MultiArray"
    if role == "pose":
        changes["inputs.odom"] = "geometry_msgs/TwistStamped"
    reader = inputs.Reader(configured(**changes, **GEOMETRY))
    assert reader.read(role, data, 1) == []
    assert reader.counts == {f"{role}: bytes that are no {full(type_name)}": 1}


# ------------------------------------------------------------------ live


def live_config(tmp_path, **changes):
    config.dump(configured(**GEOMETRY, **changes), tmp_path / "live.yaml")
    return tmp_path / "live.yaml"


class Publisher(Vehicle):
    """A vehicle that publishes other types than the usual."""

    def __init__(self, settings):
        super().__init__(roles=())
        from rov_ident.nodes.common import STREAM, subscribed

        self.publishers = {
            role: self.node.create_publisher(type_, name, STREAM)
            for role, (name, type_) in subscribed(settings.inputs).items()
        }


@pytest.fixture
def node(domain, tmp_path):
    started = []

    def start(**changes):
        path = live_config(tmp_path, **changes)
        process = start_node("rls", path, "qos.reliability:=reliable")
        vehicle = Publisher(config.load(path))
        started.append((process, vehicle))
        vehicle.until(vehicle.connected)
        vehicle.diagnostics.clear()
        return vehicle, config.load(path)

    yield start
    for process, vehicle in started:
        vehicle.close()
        status, said = end_node(process)
        assert status == 0, said


def test_a_node_on_stamped_forces_twist_and_pose(node, tmp_path, short_dive, matrix):
    """Live over DDS the same numbers as offline from a bag of the same messages."""
    vehicle, settings = node(
        **{"inputs.odom": "geometry_msgs/TwistStamped", "inputs.wrench": "sensor_msgs/JointState"}
    )
    inverse = np.linalg.pinv(matrix)
    rows = []
    for arrival, role, message in short_dive[:600]:
        if role == ODOMETRY:
            both = zip(("odom", "pose"), twist_and_pose("plain", message), strict=True)
            rows += [(arrival, own, *row) for own, row in both]
        elif role == WRENCH:
            core = to_core(message)
            forces = inverse @ np.concatenate([core.force, core.torque])
            state = joint_state(message.stamp, forces)
            rows.append((arrival, role, "/thruster_forces", "sensor_msgs/JointState", state))
        else:
            rows.append((arrival, role, *standard(role), cdr.encode(message)))
    path = write(tmp_path / "stamped.mcap", [(a, *row) for a, _, *row in rows])
    expected = estimate(path, settings)
    for k, (arrival, role, _, _, message) in enumerate(rows, 1):
        vehicle.publish(role, message)
        if k % 50 == 0 and arrival - rows[0][0] > 1_500_000_000:
            # Fast DDS has room for 512 that a busy node has not taken yet.
            vehicle.until(lambda arrival=arrival: vehicle.used() > arrival - 1_500_000_000)
    # The node flushes what still waits once the inputs have stopped.
    vehicle.until(lambda: vehicle.coefficients and stamp_of(vehicle) == expected.stamp)
    same_to_rounding(*np.array(vehicle.values[-1].data).reshape(-1, 2).T, expected)


def stamp_of(vehicle):
    stamp = vehicle.coefficients[-1].header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def test_a_node_on_pulse_widths_without_stamps(node, short_dive):
    """Stamped when they arrive: the other sensors' stamps must be of the same clock."""
    import time

    vehicle, _ = node(**{"inputs.wrench": "std_msgs/UInt16MultiArray"})
    begin, first = time.time_ns(), short_dive[0][0]
    for arrival, role, message in short_dive[:400]:
        while time.time_ns() - begin < arrival - first:
            time.sleep(0.001)
        if role == WRENCH:
            data = UInt16MultiArray(data=[1600, 1600, 1400, 1400, 1500, 1500, 1500, 1500])
        else:
            data = cdr.encode(message._replace(stamp=message.stamp + begin - first))
        vehicle.publish(role, data)
    vehicle.publish(WRENCH, UInt16MultiArray(data=[1500, 1500]))
    vehicle.until(lambda: vehicle.coefficients and stamp_of(vehicle) > begin + 1_000_000_000)
    vehicle.until(lambda: "an array of 2 values, but thrusters needs 8" in vehicle.words())


def test_replay_converts_what_has_no_stamp(domain, tmp_path, by_pulses, reference):
    """Nodes are played the same numbers that are read offline."""
    messages, pulses = by_pulses

    def commands(message):
        ros = UInt16MultiArray(data=pulses[message.stamp].tolist())
        yield "/thruster_pwm", "std_msgs/UInt16MultiArray", ros

    on_time = [(m.stamp, role, m) for _, role, m in messages]
    path = write(tmp_path / "pwm.mcap", replaced(on_time, WRENCH, commands))
    settings = live_config(tmp_path, **{"inputs.wrench": "std_msgs/UInt16MultiArray"})
    result = replay(path, settings, ("rls",), 0.0)
    live = result.reports["rls"]
    assert live.stamp == reference.stamp
    same_to_rounding(live.values, live.std, reference)


def test_a_message_package_that_is_not_installed(domain, tmp_path):
    path = live_config(tmp_path, **{"inputs.wrench": "mavros_msgs/RCOut"})
    process = start_node("rls", path)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 2
    assert "inputs.wrench is mavros_msgs/RCOut, but mavros_msgs is not installed" in said


def test_ros_reads_what_we_encode_of_a_joined_odometry(short_dive):
    """What replay plays is an ordinary message."""
    from nav_msgs.msg import Odometry as RosOdometry

    settings = with_twist("plain")
    reader = inputs.Reader(settings)
    message = next(m for _, role, m in short_dive if role == ODOMETRY)
    twist, pose = twist_and_pose("plain", message)
    assert reader.read("odom", serialize_message(twist[2]), 0) == []
    ((role, joined),) = reader.read("pose", serialize_message(pose[2]), 0)
    assert role == ODOMETRY
    ros = deserialize_message(cdr.encode(joined), RosOdometry)
    assert ros.pose.pose.position.x == message.position[0]
    assert ros.child_frame_id == message.child_frame_id
