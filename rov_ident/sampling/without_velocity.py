"""A bag without linear velocities is refused in one sentence, before anything is made of it."""

from collections.abc import Mapping

import numpy as np

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.messages import ODOMETRY, Odometry
from rov_ident.io import topics as inputs
from rov_ident.io.bag_reader import Bag

_UNKNOWN = 1e3  # a variance from which drivers mean "not measured", as in the kinematic filter


def refuse_without_velocity(bag: Bag, topics: Mapping[str, str], config: Config) -> None:
    """UserError where no odometry of a bag has a measured linear velocity.

    ``topics`` by role as `io.topics.select` gives them. Not measured: not finite, a variance of
    1e3 or more, a negative variance beside zeros; or zeros throughout while the depth changes.
    Nothing beyond the first velocity that is not zero is read.
    """
    only = {role: topic for role, topic in topics.items() if role in (ODOMETRY, inputs.POSE)}
    zeros, depths = False, set()
    for _, message in inputs.messages(bag, only, config):
        assert isinstance(message, Odometry)
        depths.add(float(message.position[2]))
        if _is_measured(message):
            if message.linear.any():
                return
            zeros = True
    if not depths or (zeros and len(depths) == 1):
        return  # no messages, or a vehicle at rest: others say so
    raise UserError(
        f"{bag.path} has no linear velocity: {topics[ODOMETRY]} marks every one as not measured, "
        "or all are not finite, or zero while the depth changes. Surge and sway, and all that "
        "multiplies u or v, are impossible to identify so, and heave, roll, pitch and yaw are not "
        "identified from attitude, rates and depth alone: record a velocity sensor (DVL), or an "
        "EKF aided by one"
    )


def _is_measured(message: Odometry) -> bool:
    variance = message.twist_variance[:3]
    if not np.isfinite(message.linear).all() or not (variance < _UNKNOWN).all():
        return False
    return bool((variance >= 0.0).all() or message.linear.any())
