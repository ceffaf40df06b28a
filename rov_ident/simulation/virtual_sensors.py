"""What the sensors of a simulated vehicle publish: rates, noise, delays, from one seed."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config, Shaft
from rov_ident.core.frames import (
    acceleration_of_arm,
    quaternion_from_euler,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_to_matrix,
    velocity_of_arm,
)
from rov_ident.core.linalg import interpolated
from rov_ident.core.messages import (
    DRIVE,
    IMU,
    ODOMETRY,
    WRENCH,
    Array,
    Imu,
    Joints,
    Message,
    Odometry,
    Wrench,
)
from rov_ident.effects import (
    acted,
    compiled,
    configured_noise,
    heading_error,
    of_the_vehicle,
    sense,
    steered,
    velocity_delay,
)
from rov_ident.effects.base import Reading
from rov_ident.model.coefficients import INPUTS
from rov_ident.simulation.manoeuvres import manoeuvre
from rov_ident.simulation.open_loop import Trajectory, simulate

_FRAMES = ("odom_ned", "base_link_frd")
_LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
START = 1_000_000_000  # ns; stamp of the first instant: zero would read as "no stamp"


@dataclass(frozen=True)
class Suite:
    """Rates in Hz (an ``imu_rate`` of zero: no IMU), noise as standard deviations of one sample.

    ``wrench_std`` is relative to the wrench. ``delay`` (s) and ``jitter`` (s, standard deviation of
    it) put off the arrival of a message, never its stamp; ``drop`` is the share of messages lost.
    """

    odometry_rate: float = 20.0
    imu_rate: float = 100.0
    wrench_rate: float = 50.0
    linear_std: float = 0.008
    angular_std: float = 0.004
    position_std: float = 0.01
    attitude_std: float = 0.002
    accelerometer_std: float = 0.03
    gyro_std: float = 0.003
    accelerometer_bias_std: float = 0.0
    gyro_bias_std: float = 0.0
    wrench_std: float = 0.01
    joint_rate: float = 20.0
    joint_std: float = 0.001  # rad; of a fin, and relative of a shaft's speed
    delay: float = 0.0
    jitter: float = 0.0
    drop: float = 0.0

    def scaled(self, factor: float) -> "Suite":
        """The same sensors with all noise multiplied."""
        noise = {name: factor * v for name, v in vars(self).items() if name.endswith("_std")}
        return dataclasses.replace(self, **noise)


@dataclass(frozen=True)
class Dive:
    """A simulated dive: the true motion at all instants, and the messages in order of arrival.

    ``messages`` holds (arrival [ns], role, message), in ROS axes.
    """

    truth: Trajectory
    demand: Array  # (N, 6), held from each instant of the truth to the next
    messages: list[tuple[int, str, Message]]


def dive(
    config: Config, name: str = "steps", duration: float = 180.0, suite: Suite | None = None,
    seed: int = 0,
) -> Dive:  # fmt: skip
    """Drive the configured vehicle through a manoeuvre and measure it.

    Raises UserError if there is no such manoeuvre, or the simulation diverges.
    """
    suite = suite or Suite()
    rng = np.random.default_rng(seed)
    demand_t = np.arange(0.0, duration, 1.0 / suite.wrench_rate)
    demand = manoeuvre(name, config.dynamics, demand_t, rng)
    return measure(config, demand_t, demand, duration, suite, rng)


def measure(
    config: Config, demand_t: Array, demand: Array, duration: float, suite: Suite,
    rng: np.random.Generator, inputs: Array | None = None, start: Array | None = None,
) -> Dive:  # fmt: skip
    """Simulate under a wrench demanded from each of ``demand_t`` (K,) to the next, and measure.

    ``inputs`` (K, 4) at these instants change in straight lines; left out, fins and propeller are
    at zero. ``start`` (6,) is the velocity at first, at rest by default.
    """
    inputs = np.zeros((len(demand_t), len(INPUTS))) if inputs is None else inputs
    # Every topic starts at a phase of its own, as real drivers do.
    odometry_t = _clock(suite.odometry_rate, duration, rng)
    imu_t = _clock(suite.imu_rate, duration, rng)
    t = np.unique(np.concatenate([demand_t, odometry_t, imu_t, np.arange(0.0, duration, 0.005)]))
    held = demand[np.clip(np.searchsorted(demand_t, t, side="right") - 1, 0, None)]
    effects = compiled(of_the_vehicle(config.effects))
    driven = interpolated(demand_t, inputs, t)
    ends = np.vstack([driven[1:], driven[-1:]])
    acting = steered(effects, np.diff(t, append=t[-1]), 0.5 * (driven + ends), ends)
    truth = simulate(
        config.dynamics, t, acted(effects, t, held), start, effects=effects, inputs=acting
    )
    sensed = sense(_reading(truth, config), config.effects)
    messages = [
        *_odometry(config, truth, sensed, np.searchsorted(t, odometry_t), suite, rng),
        *_imu(config, t, sensed, np.searchsorted(t, imu_t), suite, rng),
    ]
    # of a generator of its own: without it everything else is as it would be anyway
    read = demand + configured_noise(config.effects) * rng.spawn(1)[0].standard_normal(demand.shape)
    for at, wrench in zip(demand_t, read, strict=True):
        noisy = _coarse(wrench * (1.0 + suite.wrench_std * rng.standard_normal(6)))
        messages.append(_stamped(at, WRENCH, Wrench(0, "base_link_frd", noisy[:3], noisy[3:])))
    if config.inputs.joints:
        own = rng.spawn(1)[0]
        joint_t = _clock(suite.joint_rate, duration, own)
        driven = interpolated(demand_t, inputs, joint_t)
        for at, x in zip(joint_t, driven, strict=True):
            messages.append(_stamped(at, DRIVE, _joints(config, x, suite.joint_std, own)))
    return Dive(truth, held, _delivered(messages, suite, rng))


_Stamped = tuple[int, str, Message]


def _odometry(
    config: Config, truth: Trajectory, sensed: Reading, rows: NDArray[np.intp], suite: Suite,
    rng: np.random.Generator,
) -> Iterator[_Stamped]:  # fmt: skip
    """Noisy odometry at these rows of the truth."""
    delayed = interpolated(truth.t, sensed.linear, truth.t - velocity_delay(config.effects))
    offset = quaternion_from_euler(0.0, 0.0, heading_error(config.effects))
    variance = np.repeat([suite.linear_std**2, suite.angular_std**2], 3)
    for i in rows:
        noise = rng.standard_normal(12)
        tilt = quaternion_from_rotation_vector(suite.attitude_std * noise[:3])
        position = _coarse(truth.position[i] + suite.position_std * noise[3:6])
        attitude = _coarse(
            quaternion_multiply(quaternion_multiply(offset, truth.orientation[i]), tilt)
        )
        linear = _coarse(delayed[i] + suite.linear_std * noise[6:9])
        angular = _coarse(sensed.angular[i] + suite.angular_std * noise[9:])
        odometry = Odometry(0, *_FRAMES, position, attitude, linear, angular, variance)
        yield _stamped(truth.t[i], ODOMETRY, odometry)


def _imu(
    config: Config, t: Array, sensed: Reading, rows: NDArray[np.intp], suite: Suite,
    rng: np.random.Generator,
) -> Iterator[_Stamped]:  # fmt: skip
    """Noisy messages of the IMU at these rows of t (N,), with biases that stay."""
    mounting = config.imu.to_body
    gyro_variance, variance = np.full(3, suite.gyro_std**2), np.full(3, suite.accelerometer_std**2)
    accelerometer_bias = suite.accelerometer_bias_std * rng.standard_normal(3)
    gyro_bias = suite.gyro_bias_std * rng.standard_normal(3)
    for i in rows:
        noise = rng.standard_normal(6)
        gyro = _coarse(mounting.T @ sensed.gyro[i] + gyro_bias + suite.gyro_std * noise[:3])
        force = mounting.T @ sensed.specific_force[i] + accelerometer_bias
        force = _coarse(force + suite.accelerometer_std * noise[3:])
        imu = Imu(0, "imu_link_frd", _LEVEL, gyro, force, gyro_variance, variance)
        yield _stamped(t[i], IMU, imu)


def _delivered(
    messages: Sequence[_Stamped], suite: Suite, rng: np.random.Generator
) -> list[_Stamped]:
    """(arrival [ns], role, message) in order of arrival: some are lost, and all come late."""
    keep = rng.random(len(messages)) >= suite.drop
    late = suite.delay + suite.jitter * np.abs(rng.standard_normal(len(messages)))
    arrived = [
        (stamp + round(1e9 * lag), role, message)
        for (stamp, role, message), kept, lag in zip(messages, keep, late, strict=True)
        if kept
    ]
    # A topic keeps its order, however late its messages are.
    newest: dict[str, int] = {}
    ordered = []
    for arrival, role, message in sorted(arrived, key=lambda m: m[2].stamp):
        newest[role] = max(arrival, newest.get(role, 0))
        ordered.append((newest[role], role, message))
    ordered.sort(key=lambda m: m[0])
    return ordered


def _joints(config: Config, inputs: Array, std: float, rng: np.random.Generator) -> Joints:
    """The state of the configured joints for inputs (4,), with noise."""
    given = config.inputs.joints
    position, velocity = np.zeros(len(given)), np.zeros(len(given))
    for k, (name, joint) in enumerate(given.items()):
        x, noise = inputs[INPUTS.index(name)] / joint.scale, std * rng.standard_normal()
        if isinstance(joint, Shaft):
            velocity[k] = x * (1.0 + noise)
        else:
            position[k] = x + noise
    names = tuple(joint.joint for joint in given.values())
    return Joints(0, "", names, _coarse(position), _coarse(velocity))


def _reading(truth: Trajectory, config: Config) -> Reading:
    """What perfect sensors measure where the configuration says that they are, in body axes."""
    v, omega = truth.nu[:, :3], truth.nu[:, 3:]
    v_dot, omega_dot = truth.nu_dot[:, :3], truth.nu_dot[:, 3:]
    down = quaternion_to_matrix(truth.orientation)[:, 2, :]
    acceleration = v_dot + np.cross(omega, v) - config.gravity * down
    acceleration += acceleration_of_arm(omega, omega_dot, config.imu.position)
    linear = v + velocity_of_arm(omega, config.odometry.position)
    return Reading(linear, omega, omega, acceleration)


def _clock(rate: float, duration: float, rng: np.random.Generator) -> Array:
    """Instants of a topic, on whole microseconds."""
    if rate <= 0.0:
        return np.zeros(0)
    return np.round(np.arange(rng.random() / rate, duration, 1.0 / rate), 6)


def _coarse(values: Array) -> Array:
    """As a sensor gives them, in single precision: another computer's last bit does not show."""
    return values.astype(np.float32).astype(np.float64)


def _stamped(t: float, role: str, message: Message, start: int = START) -> tuple[int, str, Message]:
    stamp = start + round(1e9 * t)
    return stamp, role, message._replace(stamp=stamp)


def odometry_of(t: Array, nu: Array, start: int) -> list[tuple[int, str, Message]]:
    """Velocities (N, 6) at t (N,) [s] from the stamp ``start`` [ns] on as odometry messages without
    a pose; (arrival, role, message)."""
    none = np.zeros(6)
    messages = (Odometry(0, *_FRAMES, none[:3], _LEVEL, v[:3], v[3:], none) for v in nu)
    return [_stamped(at, ODOMETRY, one, start) for at, one in zip(t, messages, strict=True)]
