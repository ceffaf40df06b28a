"""Axis conventions, quaternions and angles: the only module that knows another frame than FRD/NED.

Inside the core the body axes are forward-starboard-down (FRD) and the world north-east-down (NED).
ROS messages are forward-left-up (FLU) and east-north-up (ENU) unless a frame id says otherwise.
A quaternion is an array [w, x, y, z] that rotates body axes into world axes. The quaternion
functions broadcast over leading dimensions.

Turning FLU into FRD is half a turn about x, ENU into NED half a turn about the north-east
diagonal. Both are their own inverse.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from rov_ident.errors import UserError
from rov_ident.messages import Array, Imu, Odometry, Wrench

# `base_link_ned` is the widespread name (uuv_simulator) of a body frame with FRD axes.
_FRD_SUFFIXES = ("_frd", "_fsd", "_ned")
_NED_SUFFIX = "_ned"

# Multiplies a vector in FLU to give FRD, and back.
FLIP_BODY = np.array([1.0, -1.0, -1.0])
FLIP_BODY.setflags(write=False)
# (3, 3) matrix that takes a vector in ENU to NED, and back.
FLIP_WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLIP_WORLD.setflags(write=False)

AnyMessage = TypeVar("AnyMessage", bound=Odometry | Imu | Wrench)


@dataclass(frozen=True)
class FrameDefaults:
    """The axes of a message whose frame ids do not tell (parameters `frames.body`, `.world`).

    Raises:
        UserError: a name that is not one of `flu`, `frd` (body) or `enu`, `ned` (world).
    """

    body: str = "flu"
    world: str = "enu"

    def __post_init__(self) -> None:
        if self.body not in ("flu", "frd"):
            raise UserError(f"frames.body must be `flu` or `frd`, not `{self.body}`.")
        if self.world not in ("enu", "ned"):
            raise UserError(f"frames.world must be `enu` or `ned`, not `{self.world}`.")


ROS_DEFAULTS = FrameDefaults()


# --- quaternions and angles -----------------------------------------------------------------


def quaternion_multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Hamilton product p q of (..., 4) quaternions: first q is applied, then p."""
    pw, px, py, pz = np.moveaxis(np.asarray(p, dtype=float), -1, 0)
    qw, qx, qy, qz = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def quaternion_conjugate(q: ArrayLike) -> Array:
    """The inverse rotation of (..., 4) unit quaternions."""
    return np.asarray(q, dtype=float) * np.array([1.0, -1.0, -1.0, -1.0])


def quaternion_normalise(q: ArrayLike) -> Array:
    """Quaternions (..., 4) scaled to unit length; NaN where the length is zero."""
    q = np.asarray(q, dtype=float)
    with np.errstate(invalid="ignore"):
        return q / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))


def quaternion_to_matrix(q: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3), body -> world, of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    matrix = np.stack(
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
        axis=-1,
    )
    return matrix.reshape(*matrix.shape[:-1], 3, 3)


def gravity_direction(q: ArrayLike) -> Array:
    """World down (NED z) in body axes, (..., 3), unit, of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    down = [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)]
    return np.stack(down, axis=-1)


def quaternion_from_euler(roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> Array:
    """Unit quaternions (..., 4) of roll, pitch, yaw (rad): yaw about z, then pitch, then roll."""
    half = 0.5 * np.stack(np.broadcast_arrays(roll, pitch, yaw), axis=-1).astype(float)
    cr, cp, cy = np.moveaxis(np.cos(half), -1, 0)
    sr, sp, sy = np.moveaxis(np.sin(half), -1, 0)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )


def quaternion_to_euler(q: ArrayLike) -> Array:
    """Roll, pitch, yaw (rad), (..., 3), of quaternions (..., 4) of any length but zero.

    Half the sum and half the difference of roll and yaw are polar angles of quaternion
    components, so that precision holds up to pitch +-90 degrees, where only one of them exists
    and the other is taken as zero.
    """
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    half_sum = np.arctan2(x + z, w - y)
    half_difference = np.arctan2(x - z, w + y)
    pitch = 2.0 * np.arctan2(np.hypot(x - z, w + y), np.hypot(x + z, w - y)) - 0.5 * np.pi
    roll = wrap_angle(half_sum + half_difference)
    yaw = wrap_angle(half_sum - half_difference)
    return np.stack([roll, pitch, yaw], axis=-1)


def quaternion_from_rotation_vector(vector: ArrayLike) -> Array:
    """Unit quaternions (..., 4) of rotation vectors (..., 3): axis times angle in rad."""
    vector = np.asarray(vector, dtype=float)
    half = 0.5 * np.sqrt(np.sum(vector * vector, axis=-1, keepdims=True))
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)


def quaternion_between(p: Array, q: Array, share: float) -> Array:
    """The unit quaternion (4,) a share of the way from p to q, along the shortest rotation."""
    cosine = float(p @ q)
    q, cosine = (q, cosine) if cosine >= 0.0 else (-q, -cosine)
    angle = float(np.arccos(min(cosine, 1.0)))
    if angle < 1e-6:
        return (1.0 - share) * p + share * q
    mixed: Array = np.sin((1.0 - share) * angle) * p + np.sin(share * angle) * q
    return mixed / np.sin(angle)


def wrap_angle(angle: ArrayLike) -> Array:
    """Angles (rad) brought into (-pi, pi]."""
    return np.pi - np.remainder(np.pi - np.asarray(angle, dtype=float), 2.0 * np.pi)


# --- lever arms -----------------------------------------------------------------------------


def velocity_of_arm(omega: Array, arm: Array | Sequence[float]) -> Array:
    """``omega x r`` (..., 3): by how much a point at ``arm`` [m] of a body turning with ``omega``
    [rad/s] is faster than the origin, all in body axes."""
    return np.cross(omega, arm)


def acceleration_of_arm(omega: Array, omega_dot: Array, arm: Array | Sequence[float]) -> Array:
    """``omega_dot x r + omega x (omega x r)`` (..., 3): the same of its acceleration."""
    return np.cross(omega_dot, arm) + np.cross(omega, np.cross(omega, arm))


# --- messages -------------------------------------------------------------------------------


def to_core(message: AnyMessage, defaults: FrameDefaults = ROS_DEFAULTS) -> AnyMessage:
    """A message on the wire as the core wants it: body FRD, world NED.

    A frame id ending in `_frd`, `_fsd` or `_ned` decides, else `defaults`. Of an Odometry
    the world is `frame_id` and the body `child_frame_id`; of an Imu or Wrench the body is
    `frame_id` and the world the default one. Frame ids are kept: they name the axes on the wire.
    Variances belong to axes without direction, so no sign touches them.
    """
    turn_body, turn_world = _turns(message, defaults)
    return _turned(message, turn_body, turn_world, _TURNS)


def from_core(message: AnyMessage, body: str = "flu", world: str = "enu") -> AnyMessage:
    """The inverse of `to_core(message, FrameDefaults(body, world))`: FRD/NED onto the wire.

    The frame ids of the message decide in the same way, so that a message is never written with
    axes that its frame ids deny.
    """
    turn_body, turn_world = _turns(message, FrameDefaults(body, world))
    return _turned(message, turn_body, turn_world, _TURNS_BACK)


def body_is_frd(frame_id: str, defaults: FrameDefaults = ROS_DEFAULTS) -> bool:
    """Whether the axes of this body or sensor frame are forward-starboard-down on the wire."""
    return frame_id.endswith(_FRD_SUFFIXES) or defaults.body == "frd"


def world_is_ned(frame_id: str, defaults: FrameDefaults = ROS_DEFAULTS) -> bool:
    """Whether the axes of this world frame are north-east-down on the wire."""
    return frame_id.endswith(_NED_SUFFIX) or defaults.world == "ned"


def _turns(message: Odometry | Imu | Wrench, defaults: FrameDefaults) -> tuple[bool, bool]:
    """Whether the (body, world) axes of the message on the wire differ from FRD, NED."""
    if isinstance(message, Odometry):
        return (
            not body_is_frd(message.child_frame_id, defaults),
            not world_is_ned(message.frame_id, defaults),
        )
    return not body_is_frd(message.frame_id, defaults), defaults.world != "ned"


def _turned(
    message: AnyMessage,
    turn_body: bool,
    turn_world: bool,
    quaternion_turns: dict[tuple[bool, bool], Array],
) -> AnyMessage:
    if not (turn_body or turn_world):
        return message
    quaternion_turn = quaternion_turns[turn_body, turn_world]
    if isinstance(message, Odometry):
        return message._replace(
            position=FLIP_WORLD.dot(message.position) if turn_world else message.position,
            orientation=quaternion_turn.dot(message.orientation),
            linear=message.linear * FLIP_BODY if turn_body else message.linear,
            angular=message.angular * FLIP_BODY if turn_body else message.angular,
        )
    if isinstance(message, Imu):
        orientation = quaternion_turn.dot(message.orientation)
        if not turn_body:
            return message._replace(orientation=orientation)
        return message._replace(
            orientation=orientation,
            angular_velocity=message.angular_velocity * FLIP_BODY,
            linear_acceleration=message.linear_acceleration * FLIP_BODY,
        )
    if not turn_body:
        return message
    return message._replace(force=message.force * FLIP_BODY, torque=message.torque * FLIP_BODY)


def _quaternion_turn(turn_body: bool, turn_world: bool) -> Array:
    """The orthogonal (4, 4) matrix that takes an attitude on the wire to body FRD, world NED."""
    about_x = np.array([0.0, 1.0, 0.0, 0.0])
    about_diagonal = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
    columns = np.eye(4)
    if turn_body:
        columns = quaternion_multiply(columns, about_x)
    if turn_world:
        columns = quaternion_multiply(about_diagonal, columns)
    # Of the two quaternions of one attitude the one with the positive sum: a level vehicle
    # heading east then reads [1, 0, 0, 1] / sqrt(2).
    return -columns.T if turn_body and turn_world else columns.T


_TURNS = {(b, w): _quaternion_turn(b, w) for b in (False, True) for w in (False, True)}
_TURNS_BACK = {key: turn.T for key, turn in _TURNS.items()}
