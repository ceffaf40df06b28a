"""Axis conventions against hand-worked attitudes, rotation matrices and round trips."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rov_ident.core import frames
from rov_ident.core.errors import UserError
from rov_ident.core.frames import FrameDefaults
from rov_ident.core.messages import Imu, Odometry, Wrench

FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
CORE = FrameDefaults(body="frd", world="ned")

unit = st.floats(-1.0, 1.0)
vectors = st.tuples(unit, unit, unit).map(np.array)
quaternions = (
    st.tuples(unit, unit, unit, unit)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(frames.quaternion_normalise)
)


def odometry(frame_id="odom", child_frame_id="base_link", orientation=(1.0, 0.0, 0.0, 0.0)):
    return Odometry(
        stamp=1,
        frame_id=frame_id,
        child_frame_id=child_frame_id,
        position=np.array([1.0, 2.0, 3.0]),
        orientation=np.array(orientation),
        linear=np.array([4.0, 5.0, 6.0]),
        angular=np.array([7.0, 8.0, 9.0]),
        twist_variance=np.arange(6.0),
    )


def imu(frame_id="imu_link", orientation=(1.0, 0.0, 0.0, 0.0)):
    return Imu(
        stamp=1,
        frame_id=frame_id,
        orientation=np.array(orientation),
        angular_velocity=np.array([1.0, 2.0, 3.0]),
        linear_acceleration=np.array([0.1, 0.2, 9.81]),
        angular_variance=np.arange(3.0),
        acceleration_variance=np.arange(3.0),
    )


def assert_same(a, b, **tolerance):
    assert type(a) is type(b)
    for left, right in zip(a, b, strict=True):
        if isinstance(left, np.ndarray):
            np.testing.assert_allclose(left, right, **({"rtol": 0, "atol": 1e-15} | tolerance))
        else:
            assert left == right


# --- messages -------------------------------------------------------------------------------


def test_a_level_vehicle_facing_east_in_ros_heads_ninety_degrees():
    core = frames.to_core(odometry())
    np.testing.assert_allclose(frames.quaternion_to_euler(core.orientation), [0, 0, np.pi / 2])
    assert core.orientation[0] > 0
    np.testing.assert_array_equal(core.position, [2, 1, -3])
    np.testing.assert_array_equal(core.linear, [4, -5, -6])
    np.testing.assert_array_equal(core.angular, [7, -8, -9])
    np.testing.assert_array_equal(core.twist_variance, np.arange(6.0))


@given(quaternions, st.booleans(), st.booleans())
def test_the_attitude_equals_the_product_of_rotation_matrices(q, frd, ned):
    message = odometry(
        "world_ned" if ned else "odom", "base_link_frd" if frd else "base_link", orientation=q
    )
    expected = frames.quaternion_to_matrix(q)
    if not ned:
        expected = NED_FROM_ENU @ expected
    if not frd:
        expected = expected @ FRD_FROM_FLU
    got = frames.quaternion_to_matrix(frames.to_core(message).orientation)
    np.testing.assert_allclose(got, expected, atol=1e-14)


@pytest.mark.parametrize("body", ["base_link", "base_link_frd", "base_link_fsd", "base_link_ned"])
@pytest.mark.parametrize("world", ["odom", "world_ned"])
@pytest.mark.parametrize("defaults", [FrameDefaults(), FrameDefaults("frd", "enu"), CORE])
def test_from_core_is_the_inverse(body, world, defaults):
    q = frames.quaternion_from_euler(0.1, -0.2, 2.5)
    wrench = Wrench(1, body, np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))
    for message in (odometry(world, body, q), imu(body, q), wrench):
        core = frames.to_core(message, defaults)
        assert_same(frames.from_core(core, defaults), message)


def test_messages_already_in_core_axes_pass_untouched():
    message = odometry("world_ned", "base_link_frd")
    assert frames.to_core(message) is message
    assert_same(frames.to_core(odometry(), CORE), odometry())


def test_specific_force_at_rest_points_up():
    core = frames.to_core(imu())
    np.testing.assert_array_equal(core.linear_acceleration, [0.1, -0.2, -9.81])
    np.testing.assert_array_equal(core.angular_velocity, [1, -2, -3])
    np.testing.assert_array_equal(
        frames.to_core(imu("imu_link_frd")).linear_acceleration, [0.1, 0.2, 9.81]
    )


def test_wrench_follows_its_frame_id():
    wrench = Wrench(1, "base_link", np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))
    np.testing.assert_array_equal(frames.to_core(wrench).force, [1, -2, -3])
    np.testing.assert_array_equal(frames.to_core(wrench).torque, [4, -5, -6])
    for suffix in ("_frd", "_fsd", "_ned"):
        named = wrench._replace(frame_id="base_link" + suffix)
        assert frames.to_core(named) is named


def test_messages_are_not_edited_in_place():
    message = odometry()
    for field in message:
        if isinstance(field, np.ndarray):
            field.setflags(write=False)
    frames.to_core(message)
    assert_same(message, odometry(), atol=0)


@pytest.mark.parametrize(
    ("wrong", "key"), [({"body": "ned"}, "frames.body"), ({"world": "frd"}, "frames.world")]
)
def test_unknown_frame_names_are_refused(wrong, key):
    with pytest.raises(UserError, match=key):
        FrameDefaults(**wrong)


# --- quaternions and angles -----------------------------------------------------------------


@given(quaternions, quaternions)
def test_the_product_of_quaternions_is_the_product_of_matrices(p, q):
    np.testing.assert_allclose(
        frames.quaternion_to_matrix(frames.quaternion_multiply(p, q)),
        frames.quaternion_to_matrix(p) @ frames.quaternion_to_matrix(q),
        atol=1e-14,
    )


@given(quaternions)
def test_matrices_are_rotations_and_the_conjugate_is_their_inverse(q):
    matrix = frames.quaternion_to_matrix(q)
    np.testing.assert_allclose(matrix.T @ matrix, np.eye(3), atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    np.testing.assert_allclose(
        frames.quaternion_to_matrix(q * [1.0, -1.0, -1.0, -1.0]), matrix.T, atol=1e-15
    )
    np.testing.assert_allclose(frames.gravity_direction(q), matrix[2], atol=1e-15)


def test_euler_angles_turn_about_z_then_y_then_x():
    roll, pitch, yaw = 0.3, -0.4, 2.0
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    got = frames.quaternion_to_matrix(frames.quaternion_from_euler(roll, pitch, yaw))
    np.testing.assert_allclose(got, about_z @ about_y @ about_x, atol=1e-15)


@given(st.floats(-3.14, 3.14), st.floats(-1.57, 1.57), st.floats(-3.14, 3.14))
def test_euler_round_trip(roll, pitch, yaw):
    q = frames.quaternion_from_euler(roll, pitch, yaw)
    # Near pitch +-90 degrees roll and yaw are known to 1e-16 over the distance from it.
    np.testing.assert_allclose(frames.quaternion_to_euler(1.7 * q), [roll, pitch, yaw], atol=1e-12)


@pytest.mark.parametrize("pitch", [-np.pi / 2, np.pi / 2])
def test_euler_at_gimbal_lock_still_gives_the_same_attitude(pitch):
    q = frames.quaternion_from_euler(0.4, pitch, 1.1)
    again = frames.quaternion_from_euler(*frames.quaternion_to_euler(q))
    np.testing.assert_allclose(
        frames.quaternion_to_matrix(again), frames.quaternion_to_matrix(q), atol=1e-7
    )


@given(vectors)
def test_rotation_vector_turns_about_its_own_axis(vector):
    q = frames.quaternion_from_rotation_vector(vector)
    matrix = frames.quaternion_to_matrix(q)
    np.testing.assert_allclose(matrix @ vector, vector, atol=1e-14)
    assert 1 + 2 * np.cos(np.linalg.norm(vector)) == pytest.approx(np.trace(matrix))


@given(vectors, st.sampled_from([1.0, -1.0]))
def test_a_rotation_vector_is_the_shortest_of_its_attitude(vector, sign):
    """Of either quaternion of it: a driver that changes the sign does not turn the vehicle."""
    q = sign * frames.quaternion_from_rotation_vector(vector)
    found = frames.rotation_vector(q)
    assert np.linalg.norm(found) <= np.pi + 1e-12
    again = frames.quaternion_from_rotation_vector(found)
    assert abs(again @ q) == pytest.approx(1.0, abs=1e-12)


def test_small_rotation_vector_is_exact():
    q = frames.quaternion_from_rotation_vector([1e-200, 0, 0])
    np.testing.assert_array_equal(q, [1, 0.5e-200, 0, 0])


def test_functions_broadcast():
    q = frames.quaternion_from_euler(0.0, np.zeros((5, 1)), np.linspace(0, 1, 3))
    assert q.shape == (5, 3, 4)
    assert frames.quaternion_to_matrix(q).shape == (5, 3, 3, 3)
    assert frames.quaternion_to_euler(q).shape == (5, 3, 3)
    assert frames.gravity_direction(q).shape == (5, 3, 3)
    assert frames.quaternion_multiply(q[0, 0], q).shape == (5, 3, 4)
    assert frames.quaternion_from_rotation_vector(np.zeros((5, 3))).shape == (5, 4)


def test_a_zero_quaternion_is_no_attitude():
    assert np.isnan(frames.quaternion_normalise(np.zeros(4))).all()


@given(st.floats(-1e3, 1e3))
def test_wrapped_angles(angle):
    wrapped = frames.wrap_angle(angle)
    assert -np.pi <= wrapped <= np.pi
    assert np.cos(wrapped - angle) == pytest.approx(1.0)


def test_wrap_keeps_plus_pi():
    np.testing.assert_array_equal(frames.wrap_angle([np.pi, -np.pi, 0.0]), [np.pi, np.pi, 0.0])
