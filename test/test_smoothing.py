"""The attitude between an AHRS that is off for seconds and a gyro that drifts."""

import numpy as np
import pytest

from rov_ident.config.prior import ATTITUDE_LASTS
from rov_ident.core.frames import (
    gravity_direction,
    quaternion_from_rotation_vector,
    quaternion_multiply,
)
from rov_ident.core.quaternions import rotation
from rov_ident.sampling import smoothing
from rov_ident.sampling.records import samples_of
from rov_ident.sampling.sample import joined
from rov_ident.simulation import virtual_sensors as sensors


def test_the_level_is_the_conditional_mean():
    """Of all that is normal together, by its covariance."""
    rng, n = np.random.default_rng(3), 40
    z, dt = rng.standard_normal((n, 3)), rng.uniform(0.5, 2.0, n - 1)
    walk, keep, noise, lasting = 0.1 * rng.uniform(0.5, 2.0, n - 1), np.exp(-dt / 5.0), 0.4, 0.7
    bias = np.array([0.02, 0.003])
    found, cost = smoothing._local_level(z, noise, walk, lasting, keep, dt, bias)
    # the level is the sum of steps, from a first one of which nothing is known
    drift = bias[0] + np.minimum.outer(*2 * (np.append(0.0, np.cumsum(bias[1] * dt)),))
    until = np.tril(np.ones((n, n - 1)), -1)
    level = until @ (np.diag(walk) + dt[:, None] * drift[:-1, :-1] * dt) @ until.T
    t = np.append(0.0, np.cumsum(dt))
    seen = level + lasting * np.exp(-np.abs(np.subtract.outer(t, t)) / 5.0) + noise * np.eye(n)
    weight = np.linalg.inv(seen)
    ones = np.ones(n)
    mean = ones @ weight @ z / (ones @ weight @ ones)
    np.testing.assert_allclose(found, mean + level @ weight @ (z - mean), atol=1e-9)
    left = np.einsum("ki,kl,li->", z - mean, weight, z - mean)
    # of a first level of any value nothing is likely or not
    whole = left + 3.0 * (np.linalg.slogdet(seen)[1] + np.log(ones @ weight @ ones))
    assert cost == pytest.approx(whole)


@pytest.mark.parametrize(("stated", "most"), [(1.0, 0.8), (5.0, 0.95)])
def test_an_attitude_that_wanders_is_not_followed(heavy, monkeypatch, stated, most):
    """The gyro tells that the vehicle does not turn so; a level beside white noise follows it.
    Of a gyro whose noise is stated far larger than it is, what is left is not taken for nothing."""
    exact = sensors.Suite(odometry_rate=10.0, imu_rate=50.0, attitude_std=0.0)
    left = []
    for seed in range(4):
        run = sensors.dive(heavy, "steps", 120.0, exact, seed)
        samples = joined(list(samples_of(heavy, run, True)))
        samples["gyro_variance"] *= stated**2
        seen = np.flatnonzero(np.isfinite(samples["attitude"][:, 0]))
        true = np.array([rotation(q)[2] for q in samples["attitude"][seen]])
        rng, wander = np.random.default_rng([seed, 4]), np.zeros(3)
        for k, step in zip(seen, np.diff(samples["t"][seen], prepend=-np.inf), strict=True):
            keep = np.exp(-step / ATTITUDE_LASTS)
            wander = keep * wander + 0.003 * np.sqrt(1.0 - keep**2) * rng.standard_normal(3)
            off = quaternion_from_rotation_vector(wander + 0.001 * rng.standard_normal(3))
            samples["attitude"][k] = quaternion_multiply(off, samples["attitude"][k])
        errors = [np.array([rotation(q)[2] for q in samples["attitude"][seen]]) - true]
        after = smoothing.smoothed(samples, heavy)
        errors.append(after["down"][seen] - true)
        with monkeypatch.context() as patch:
            patch.setattr(smoothing, "_LASTING", np.zeros(1))
            errors.append(smoothing.smoothed(samples, heavy)["down"][seen] - true)
        # but for the mean, which nothing tells from a mounting
        said = np.sqrt(after["tilt_variance"].mean())
        left.append([*(np.std(error[:, :2], axis=0).mean() for error in errors), said])
    measured, lasting, followed, said = np.mean(left, axis=0)
    assert 0.9 * measured < followed < measured
    assert lasting < most * measured
    assert said > 0.3 * lasting


def test_smoothing_knows_bias_and_attitude_better(heavy):
    suite = sensors.Suite(gyro_bias_std=0.005)
    run = sensors.dive(heavy, duration=60.0, suite=suite, seed=1)
    live = joined(list(samples_of(heavy, run)))
    after = smoothing.smoothed(live, heavy)
    origin = min(m.stamp for *_, m in run.messages)
    t = live["t"] + (origin - sensors.START) * 1e-9
    down = gravity_direction(run.truth.orientation)
    true_down = np.stack([np.interp(t, run.truth.t, c) for c in down.T], axis=1)
    true_rate = np.stack([np.interp(t, run.truth.t, c) for c in run.truth.nu[:, 3:].T], axis=1)

    def off(samples):
        tilt = np.std(samples["down"] - true_down)
        early = samples["t"] < 5.0
        return tilt, np.abs(np.nanmean((samples["gyro"] - true_rate)[early], axis=0)).max()

    (tilt, bias), (tilt_after, bias_after) = off(live), off(after)
    assert tilt_after < 0.7 * tilt
    assert bias_after < 0.5 * bias
    # the mean over the turn, as the samples had it
    turn = np.cross(after["down"], after["nu"][:, 3:])
    slope = np.diff(after["down"], axis=0) / after["dt"][1:, None] - (turn[:-1] - turn[1:]) / 6.0
    np.testing.assert_allclose(after["down_slope"][1:], slope, atol=1e-9)
