"""Where the sensors sit on the body, as `/tf_static` of a bag says."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.frames import (
    body_is_frd,
    quaternion_multiply,
    quaternion_normalise,
    quaternion_to_euler,
    quaternion_to_matrix,
)
from rov_ident.core.messages import IMU, ODOMETRY, Array
from rov_ident.io.bag_reader import Bag
from rov_ident.io.topics import FrameIds, first_frames, select

STATIC = "/tf_static"
_NOWHERE = 1e-6  # m, rad: what is left of zero by rounding
TURNED = "odometry.rotation"  # which no configuration has: velocities are along the body axes


def with_mounting(config: Config, paths: Iterable[Path]) -> tuple[Config, tuple[str, ...]]:
    """The configuration with sensors that it leaves at the body's origin, unturned, where the first
    bag with a `/tf_static` says that they are; and a note on each that was moved, or on a turned
    velocity sensor."""
    notes = []
    for key, vector, name in _told_of_mounting(config, paths):
        if key == TURNED:
            if "sensor_misalignment" not in config.effects:
                notes += turned(vector, name)
            continue
        section, own = key.split(".")
        settings = getattr(config, section)
        if not np.any(getattr(settings, own)) and np.abs(vector).max() > _NOWHERE:
            moved = replace(settings, **{own: tuple(vector.tolist())})
            config = replace(config, **{section: moved})
            told = [round(float(x), 3) + 0.0 for x in vector]
            notes.append(
                f"{key} is {told} (forward, starboard, down) by {STATIC} of {name}, as the "
                "configuration has none"
            )
    return config, tuple(notes)


def turned(rotation: Array, name: str) -> list[str]:
    """What to do about a velocity sensor at roll, pitch, yaw (3,) [rad] by the bag of that name,
    if it is turned."""
    told = [round(float(x), 3) + 0.0 for x in rotation]
    if not any(told):
        return []
    return [
        f"the velocity sensor is turned by roll, pitch, yaw {told} rad by {STATIC} of {name}, but "
        "its velocities are taken as along the body axes: if they are along its own, set "
        "effects.sensor_misalignment"
    ]


def _told_of_mounting(config: Config, paths: Iterable[Path]) -> list[tuple[str, Array, str]]:
    """The :func:`sensor_placement` of the first bag with a `/tf_static`, and the bag's name."""
    for path in paths:
        with suppress(UserError):  # who reads it says what is wrong with it
            bag = Bag(path)
            if STATIC in bag.topics:
                frames = first_frames(bag, select(bag, config), config)
                return [(key, x, path.name) for key, x in sensor_placement(bag, frames).items()]
    return []


def sensor_placement(bag: Bag, frames: Mapping[str, FrameIds]) -> dict[str, Array]:
    """Where `/tf_static` says that the sensors are, (3,) each, forward-starboard-down in the body
    frame: `imu.position` [m], `imu.rotation` [rad], `odometry.position` [m], `odometry.rotation`
    [rad] (:data:`TURNED`); what it does not say is left out.

    ``frames`` as `first_frames` gives them. The body frame is that of the odometry (its child), or
    `base_link`. Frames of the tree have their axes forward, left, up, or as their name says
    (`base_link_frd`): messages in them do, too.
    """
    parents = _tree(bag)

    def below_root(frame: str) -> tuple[str, Array, Array]:
        """The frame from which the tree hangs; origin and attitude of a frame in it."""
        origin, attitude = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        for _ in parents:  # more steps than these lead round a loop
            if frame not in parents:
                break
            frame, p, q = parents[frame]
            origin = p + quaternion_to_matrix(q) @ origin
            attitude = quaternion_multiply(q, attitude)
        return frame, origin, attitude

    def placed(frame: str, body: str) -> tuple[Array, Array] | None:
        """Origin and attitude of a frame in the body's; None where the tree does not join them."""
        (root, origin, attitude), (other, p, q) = below_root(frame), below_root(body)
        if root != other or root in parents:
            return None
        to_core, from_sensor = _to_frd(body), _to_frd(frame)  # half turns: each its own inverse
        back = quaternion_multiply(to_core, q * [1.0, -1.0, -1.0, -1.0])
        turned = quaternion_multiply(quaternion_multiply(back, attitude), from_sensor)
        return quaternion_to_matrix(back) @ (origin - p), turned

    motion, child = frames.get(ODOMETRY, ("", ""))
    found: dict[str, Array] = {}
    if not parents:
        return found
    if IMU in frames and (at := placed(frames[IMU][0], child or "base_link")):
        found["imu.position"] = at[0]
        found["imu.rotation"] = quaternion_to_euler(at[1])
    if motion and not child and (at := placed(motion, "base_link")):
        found["odometry.position"] = at[0]
        found[TURNED] = quaternion_to_euler(at[1])
    return found


def _to_frd(frame: str) -> Array:
    """The turn (4,) from the axes of a frame to forward-starboard-down."""
    return np.array([1.0, 0.0, 0.0, 0.0] if body_is_frd(frame) else [0.0, 1.0, 0.0, 0.0])


def _tree(bag: Bag) -> dict[str, tuple[str, Array, Array]]:
    """By frame of `/tf_static`: the parent, and origin and attitude (w x y z) in it; without what
    cannot be read, or is no transform."""
    parents = {}
    if bag.topics.get(STATIC, ("",))[0] == "tf2_msgs/msg/TFMessage":
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_JAZZY)
        for raw in bag.iter_raw([STATIC]):
            with suppress(Exception):  # whatever the bytes make of the library
                for each in store.deserialize_cdr(raw.data, raw.type_name).transforms:
                    p, q = each.transform.translation, each.transform.rotation
                    origin = np.array([p.x, p.y, p.z])
                    attitude = quaternion_normalise([q.w, q.x, q.y, q.z])
                    if np.isfinite([*origin, *attitude]).all():
                        parents[each.child_frame_id] = each.header.frame_id, origin, attitude
    return parents
