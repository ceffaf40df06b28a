"""Axis conventions, quaternions and angles: the only module that knows another frame than FRD/NED.

Inside the core the body axes are forward-starboard-down (FRD) and the world north-east-down (NED).
ROS messages are forward-left-up (FLU) and east-north-up (ENU) unless a frame id says otherwise:
half a turn about x, and half a turn about the north-east diagonal, both their own inverse. A
quaternion is an array [w, x, y, z] that rotates body axes into world axes; the quaternion functions
broadcast over leading dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array, Imu, Joints, Odometry, Wrench

# `base_link_ned` is the widespread name (uuv_simulator) of a body frame with FRD axes.
_FRD_SUFFIXES = ("_frd", "_fsd", "_ned")
_NED_SUFFIX = "_ned"

FLIP_BODY = np.array([1.0, -1.0, -1.0])  # multiplies a vector in FLU to give FRD, and back
FLIP_WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Takes a vector in ENU to NED, and back."""
for _constant in (FLIP_BODY, FLIP_WORLD):
    _constant.setflags(write=False)

AnyMessage = TypeVar("AnyMessage", bound=Odometry | Imu | Wrench | Joints)


@dataclass(frozen=True)
class FrameDefaults:
    """The axes of a message whose frame ids do not tell (parameters `frames.body`, `.world`).

    Raises UserError: a name that is not one of `flu`, `frd` (body) or `enu`, `ned` (world).
    """

    body: str = "flu"
    world: str = "enu"

    def __post_init__(self) -> None:
        if self.body not in ("flu", "frd"):
            raise UserError(f"frames.body must be `flu` or `frd`, not `{self.body}`.")
        if self.world not in ("enu", "ned"):
            raise UserError(f"frames.world must be `enu` or `ned`, not `{self.world}`.")


ROS_DEFAULTS = FrameDefaults()


def product(pw: Any, px: Any, py: Any, pz: Any, qw: Any, qx: Any, qy: Any, qz: Any) -> Any:
    """The four components of the Hamilton product p q, of numbers or of arrays."""
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


def rotation_rows(w: Any, x: Any, y: Any, z: Any) -> Any:
    """The rows of R, body -> world, of a unit quaternion, as tuples; the last is "down"."""
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def _components(q: ArrayLike) -> Array:
    return np.moveaxis(np.asarray(q, dtype=float), -1, 0)


def quaternion_multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Hamilton product p q of (..., 4) quaternions: first q is applied, then p."""
    return np.stack(product(*_components(p), *_components(q)), axis=-1)


def quaternion_normalise(q: ArrayLike) -> Array:
    """Quaternions (..., 4) scaled to unit length; NaN where the length is zero."""
    q = np.asarray(q, dtype=float)
    with np.errstate(invalid="ignore"):
        return q / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))


def quaternion_to_matrix(q: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3), body -> world, of unit quaternions (..., 4)."""
    rows = rotation_rows(*_components(q))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotated(r: Array, x: Array) -> Array:
    """Vectors x (N, 3), each turned by the matrix of its row, r (N, 3, 3): from body to world by
    attitudes."""
    return np.einsum("kij,kj->ki", r, x)


def gravity_direction(q: ArrayLike) -> Array:
    """World down (NED z) in body axes, (..., 3), unit, of unit quaternions (..., 4)."""
    return quaternion_to_matrix(q)[..., 2, :].copy()


def quaternion_from_euler(roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> Array:
    """Unit quaternions (..., 4) of roll, pitch, yaw (rad): yaw about z, then pitch, then roll."""
    half = 0.5 * np.stack(np.broadcast_arrays(roll, pitch, yaw), axis=-1).astype(float)
    cr, cp, cy = np.moveaxis(np.cos(half), -1, 0)
    sr, sp, sy = np.moveaxis(np.sin(half), -1, 0)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return np.stack([w, x, y, z], axis=-1)


def quaternion_to_euler(q: ArrayLike) -> Array:
    """Roll, pitch, yaw (rad), (..., 3), of quaternions (..., 4) of any length but zero.

    From half the sum and half the difference of roll and yaw, so that precision holds up to pitch
    +-90 degrees, where only one of these exists and the other is taken as zero.
    """
    w, x, y, z = _components(q)
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


def rotation_vector(q: Array) -> Array:
    """Rotation vectors (..., 3) [rad], of at most half a turn, of quaternions (..., 4)."""
    real, vector = q[..., :1], q[..., 1:]
    size = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(size, np.abs(real))
    return np.copysign(angle, real) * vector / np.maximum(size, 1e-12)


def turns(q: Array) -> Array:
    """Rotation vectors (N - 1, 3) [rad] from each attitude (N, 4) to the next, in the body."""
    return rotation_vector(quaternion_multiply(q[:-1] * [1.0, -1.0, -1.0, -1.0], q[1:]))


def quaternion_angle(p: Array, q: Array) -> Array:
    """The angle (...) [rad], from 0 to pi, between attitudes p and q (..., 4)."""
    return 2.0 * np.arccos(np.minimum(np.abs(np.sum(p * q, axis=-1)), 1.0))


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


def velocity_of_arm(omega: Array, arm: Array | Sequence[float]) -> Array:
    """``omega x r`` (..., 3): by how much a point at ``arm`` [m] of a body turning with ``omega``
    [rad/s] is faster than the origin, all in body axes."""
    return np.cross(omega, arm)


def acceleration_of_arm(omega: Array, omega_dot: Array, arm: Array | Sequence[float]) -> Array:
    """``omega_dot x r + omega x (omega x r)`` (..., 3): the same of its acceleration."""
    return np.cross(omega_dot, arm) + np.cross(omega, np.cross(omega, arm))


def to_core(message: AnyMessage, defaults: FrameDefaults = ROS_DEFAULTS) -> AnyMessage:
    """A message on the wire as the core wants it: body FRD, world NED.

    A frame id ending in `_frd`, `_fsd` or `_ned` decides, else `defaults`. Of an Odometry
    the world is `frame_id` and the body `child_frame_id`; of an Imu or Wrench the body is
    `frame_id` and the world the default one. Frame ids are kept: they name the axes on the wire.
    Variances belong to axes without direction, so no sign touches them.
    """
    return _change_axes(message, defaults, _TURNS)


def from_core(message: AnyMessage, defaults: FrameDefaults = ROS_DEFAULTS) -> AnyMessage:
    """The inverse of :func:`to_core`: a message in FRD and NED onto the wire.

    The frame ids of the message decide in the same way, so that a message is never written with
    axes that its frame ids deny.
    """
    return _change_axes(message, defaults, _TURNS_BACK)


def body_is_frd(frame_id: str, defaults: FrameDefaults = ROS_DEFAULTS) -> bool:
    """Whether the axes of this body or sensor frame are forward-starboard-down on the wire."""
    return frame_id.endswith(_FRD_SUFFIXES) or defaults.body == "frd"


def world_is_ned(frame_id: str, defaults: FrameDefaults = ROS_DEFAULTS) -> bool:
    """Whether the axes of this world frame are north-east-down on the wire."""
    return frame_id.endswith(_NED_SUFFIX) or defaults.world == "ned"


def _change_axes(
    message: AnyMessage, defaults: FrameDefaults, turns: dict[tuple[bool, bool], Array]
) -> AnyMessage:
    """The message with axes other than FRD, NED turned, or back, by the ``turns`` of attitudes."""
    if isinstance(message, Joints):
        return message
    if isinstance(message, Odometry):
        turn_body = not body_is_frd(message.child_frame_id, defaults)
        turn_world = not world_is_ned(message.frame_id, defaults)
    else:
        turn_body = not body_is_frd(message.frame_id, defaults)
        turn_world = defaults.world != "ned" and isinstance(message, Imu)
    if not (turn_body or turn_world):
        return message
    flip, turn = _FLIPS[turn_body], turns[turn_body, turn_world]
    # Not _replace, which takes longer than all of the arithmetic.
    turned: Odometry | Imu | Wrench
    if isinstance(message, Odometry):
        stamp, frame_id, child, p, q, v, w, variance = message
        p = FLIP_WORLD.dot(p) if turn_world else p
        turned = Odometry(stamp, frame_id, child, p, turn.dot(q), v * flip, w * flip, variance)
    elif isinstance(message, Imu):
        stamp, frame_id, q, w, f, *variances = message
        turned = Imu(stamp, frame_id, turn.dot(q), w * flip, f * flip, *variances)
    else:
        turned = Wrench(
            message.stamp, message.frame_id, message.force * flip, message.torque * flip
        )
    return cast(AnyMessage, turned)


_FLIPS = np.ones(3), FLIP_BODY


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
