"""A vehicle without a velocity sensor: attitude, rates and depth are all there is.

The linear velocity is then simulated from the wrench with the configured model, where a sample
needs one (`Sampler`), and maximum likelihood has it as a state that only the depth z sees::

    z_dot = k . (v + water),   k: the world's down axis in body axes

A steady horizontal current does not show in this, nor in the motion through the water.
"""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.jit import kernel
from rov_ident.core.messages import ODOMETRY, Message, Odometry
from rov_ident.io import topics as inputs
from rov_ident.io.bag_reader import Bag
from rov_ident.model.coefficients import Coefficient
from rov_ident.model.equations import force_of_one
from rov_ident.model.scales import WORKING_SPEED
from rov_ident.sampling.kinematic_filter import UNKNOWN

DEPTH_STD = 0.01  # m; only where a fit of its noise begins
_MAX_STEP = 0.05  # s; a tenth of the time in which drag stops a small vehicle
_FASTEST = 10.0  # m/s; a model that goes faster is wrong

IMPOSSIBLE = (
    "no linear velocity: heave, roll, pitch and yaw are told from attitude, rates and depth; surge "
    "and sway, and all that multiplies u or v, cannot be told and keep the prior's intervals"
)


def has_velocity(bag: Bag, topics: Mapping[str, str], config: Config) -> bool:
    """Whether some odometry of a bag has a measured linear velocity, or nothing moves at all.

    ``topics`` by role as `io.topics.select` gives them. Not measured: not finite, a variance of
    1e3 or more, a negative variance beside zeros; or zeros throughout while the depth changes.
    Nothing beyond the first velocity that is not zero is read. UserError where there is no depth,
    either.
    """
    only = {role: topic for role, topic in topics.items() if role in (ODOMETRY, inputs.POSE)}
    zeros, depths = False, set()
    for _, message in inputs.messages(bag, only, config):
        assert isinstance(message, Odometry)
        depths.add(float(message.position[2]))
        if _is_measured(message):
            if message.linear.any():
                return True
            zeros = True
    if not depths or (zeros and len(depths) == 1):
        return True  # no messages, or a vehicle at rest: others say so
    if len(depths) == 1 or not np.isfinite(list(depths)).all():
        raise UserError(
            f"{bag.path} has neither linear velocity nor depth: the z of {topics[ODOMETRY]} never "
            "changes, or is not finite. Record a pressure sensor, and better a velocity sensor "
            "(DVL), or an EKF aided by one"
        )
    return False


def refuse_without_velocity(bag: Bag, topics: Mapping[str, str], config: Config) -> None:
    """UserError where no odometry of a bag has a measured linear velocity (`has_velocity`)."""
    if not has_velocity(bag, topics, config):
        raise refusal(str(bag.path))


def refusal(name: str) -> UserError:
    """Of what needs the linear velocity that the bags of this ``name`` have not."""
    return UserError(
        f"{name} has no linear velocity: its odometry marks every one as not measured, or all are "
        "not finite, or zero while the depth changes. Surge and sway, and all that multiplies u or "
        "v, are impossible to identify so; heave, roll, pitch and yaw are told by `rov-ident fit "
        "--estimator ml`, from attitude, rates and depth. Use that, or record a velocity sensor "
        "(DVL), or an EKF aided by one"
    )


def _is_measured(message: Odometry) -> bool:
    variance = message.twist_variance[:3]
    if not np.isfinite(message.linear).all() or not (variance < UNKNOWN).all():
        return False
    return bool((variance >= 0.0).all() or message.linear.any())


def blanked(messages: Iterable[tuple[str, Message]]) -> Iterator[tuple[str, Message]]:
    """The same messages, each odometry as by :func:`blank`."""
    for role, message in messages:
        yield role, blank(message) if isinstance(message, Odometry) else message


def blank(message: Odometry) -> Odometry:
    """The message with a linear velocity of zero, uncertain by the working speed."""
    variance = message.twist_variance.copy()
    variance[:3] = WORKING_SPEED[0] ** 2
    return message._replace(linear=np.zeros(3), twist_variance=variance)


def is_without_velocity(samples: NDArray[np.void]) -> bool:
    """Whether samples (k,) of SAMPLE have depths in place of linear velocities."""
    return bool((samples["depth_variance"] > 0.0).any())


def is_impossible(coefficient: Coefficient) -> bool:
    """Whether a coefficient cannot be told without linear velocity: it multiplies u or v, or acts
    along them. Only turning moments and a tilt show these, and no measurement says whether such
    terms of the model are right."""
    return bool(coefficient.motions & {0, 1})


class SimulatedVelocity:
    """Linear velocity through the water by the configured model, between what is measured."""

    def __init__(self, config: Config) -> None:
        self.v = np.zeros(3)  # m/s, body axes
        self.configure(config)

    def configure(self, config: Config) -> None:
        """Take other settings; the motion stays."""
        model = config.dynamics
        mass = model.mass_matrix
        self._task = model.structure, mass, np.linalg.inv(mass), model.theta, model.body.restoring

    def fill(self, sample: NDArray[np.void], odometry: Odometry | None, age: float) -> None:
        """Complete a sample (1,) of SAMPLE whose rates, attitude and wrench are known.

        ``odometry``, in core axes, was measured ``age`` [s] before.
        """
        if sample["restart"][0]:
            self.v[:] = 0.0
        else:
            self.v = _moved(*self._task, self.v, sample)
        sample["nu"][0, :3] = self.v
        sample["odometry"][0, :3] = np.nan
        if odometry is not None:
            sample["depth"] = odometry.position[2]
            sample["depth_age"], sample["depth_variance"] = age, DEPTH_STD**2


@kernel
def _moved(structure, mass, inverse, theta, restoring, v, samples):  # type: ignore[no-untyped-def]
    """Velocity (3,) at the sample from that before, v (3,)."""
    sample, nu = samples[0], samples[0].nu.copy()
    nu[:3] = v
    steps = max(1, int(np.ceil(sample.dt / _MAX_STEP)))
    for _ in range(steps):
        h = force_of_one(structure, mass, theta, nu, sample.inputs[0])
        nu_dot = inverse @ (sample.wrench + restoring @ sample.down - h)
        for i in range(3):
            faster = nu[i] + sample.dt / steps * nu_dot[i]
            nu[i] = min(max(faster, -_FASTEST), _FASTEST) if np.isfinite(faster) else 0.0
    return nu[:3].copy()
