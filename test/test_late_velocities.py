"""Velocities that are older than the stamp of their odometry."""

import dataclasses

import numpy as np
import pytest

from rov_ident.core.frames import quaternion_from_euler
from rov_ident.core.messages import Odometry
from rov_ident.sampling.late_velocities import LateVelocities
from rov_ident.sampling.records import samples_of
from rov_ident.sampling.sample import joined
from rov_ident.simulation.virtual_sensors import Suite, dive


def odometry(t, yaw_rate=0.4):
    """A circle: the velocity tells the time at which it was measured."""
    attitude = quaternion_from_euler(0.0, 0.0, yaw_rate * t)
    linear, angular = np.array([t, -t, 2.0 * t]), np.array([0.0, 0.0, yaw_rate])
    return Odometry(
        0, "odom", "base", np.array([t, 0.0, 0.0]), attitude, linear, angular, np.zeros(6)
    )


@pytest.mark.parametrize("delay", [0.03, 0.05, 0.12, 0.7])
def test_pose_and_rates_are_of_the_time_of_the_velocities(delay):
    late, rng = LateVelocities(delay), np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.03, 0.07, 200))
    found = []
    for t in times:
        message = odometry(t)
        message = message._replace(linear=odometry(t - delay).linear)
        found.append(late.push(t, message))
    early = times - delay < times[0]
    assert [f is None for f in found] == early.tolist()
    for t, message in [f for f in found if f is not None]:
        expected = odometry(t)
        for field in ("position", "orientation", "linear", "angular"):
            np.testing.assert_allclose(
                getattr(message, field), getattr(expected, field), atol=1e-9, err_msg=field
            )


def test_a_delay_below_the_rounding_of_times_loses_no_message():
    """As a fit ends at a bound of zero; it had left no message at all, and an error of its own."""
    late = LateVelocities(1e-18)
    assert all(late.push(t, odometry(t)) is not None for t in np.arange(1.0, 3.0, 0.05))


def test_nothing_is_interpolated_across_a_gap():
    late = LateVelocities(0.1)
    times = np.append(np.arange(0.0, 1.0, 0.05), 2.0 + np.arange(0.0, 1.0, 0.05))
    known = [late.push(t, odometry(t)) is not None for t in times]
    lost = [t for t, k in zip(times, known) if not k]
    assert lost == pytest.approx([0.0, 0.05, 2.0, 2.05])


@pytest.mark.parametrize("imu_rate", [0.0, 100.0])
@pytest.mark.parametrize("delay", [0.06, 0.2])
def test_samples_have_the_velocity_of_their_own_time(heavy, delay, imu_rate):
    suite = dataclasses.replace(Suite().scaled(0.0), imu_rate=imu_rate)
    config = dataclasses.replace(heavy, effects={"velocity_latency": {"delay": delay}})
    run = dive(config, "steps", 20.0, suite, 2)
    errors = []
    for told in (config, heavy):
        samples = joined(list(samples_of(told, run)))
        samples = samples[samples["measured"] & (samples["t"] > 1.0)]
        first = min(m.stamp for _, _, m in run.messages) - 1_000_000_000
        truth = [np.interp(samples["t"] + 1e-9 * first, run.truth.t, v) for v in run.truth.nu.T]
        errors.append(np.sqrt(np.mean((samples["nu"] - np.stack(truth, axis=1))[:, :3] ** 2)))
    assert errors[0] < 0.002 and errors[1] > 10.0 * errors[0]


def test_rates_of_slow_odometry_are_those_of_quick_turns():
    """A straight line between messages at 4 Hz was off by up to 6 % of a turn at 0.45 Hz, which
    seemed to contradict the IMU."""
    late, found = LateVelocities(0.125), []
    for t in np.arange(0.0, 20.0, 0.25):
        found.append(late.push(t, odometry(t, np.sin(2.0 * np.pi * 0.45 * t))))
    off = [
        message.angular[2] - np.sin(2.0 * np.pi * 0.45 * t)
        for t, message in [each for each in found if each is not None][1:]
    ]
    assert np.max(np.abs(off)) < 0.025
