"""Batch least squares: what is identifiable, bias and its cure."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from tiers import more

from bench.studies.at_sea import Trial, measure
from rov_ident.config.prior import prior_of
from rov_ident.core.linalg import sandwich
from rov_ident.core.messages import Odometry
from rov_ident.effects import compiled
from rov_ident.model.scales import authority
from rov_ident.offline import least_squares as ls
from rov_ident.offline.filtered_regression import filtered_rows, regression
from rov_ident.sampling import records
from rov_ident.sampling.sample import joined
from rov_ident.sampling.sampler import Sampler
from rov_ident.simulation import virtual_sensors as sensors


def in_one(samples):
    return lambda function, *arguments: [function(samples, *arguments)]


def samples_of(config, duration=60.0, suite=None, manoeuvre="steps", seed=1):
    run = sensors.dive(config, manoeuvre, duration, suite or sensors.Suite(), seed)
    return joined(list(records.samples_of(config, run)))


@pytest.fixture(scope="module")
def off(heavy):
    """A configuration that is wrong by a quarter."""
    factor = np.random.default_rng(3).uniform(0.75, 1.25, len(heavy.model.theta))
    return heavy.with_model(heavy.model.with_theta(heavy.model.theta * factor))


def test_rows_of_the_filtered_regression(heavy, off):
    """Without noise the deviation from the prior leaves nothing of the rows, nor does none."""
    samples = samples_of(heavy, 20.0, sensors.Suite().scaled(0.0))
    size = samples["wrench"].std(axis=0)
    for config in (heavy, off):
        task = regression(config)
        rows, t = filtered_rows(task, samples, ls.PERIOD)
        assert np.allclose(np.diff(t), ls.PERIOD, atol=1e-6)
        assert rows.shape == (len(rows), 6, len(task.scale) + 1)
        assert len(rows) == pytest.approx(200, abs=3)
        deviation = (heavy.model.theta - config.model.theta) / task.scale
        left = rows[:, :, -1] - rows[:, :, :-1] @ deviation
        assert np.all(left.std(axis=0) < 5e-3 * size)
    assert np.all(rows[:, :, -1].std(axis=0) > 2e-2 * size)


@pytest.fixture(scope="module")
def two_minutes(heavy):
    return samples_of(heavy, 120.0)


@pytest.mark.parametrize("options", [{}, {"weighted": False}, {"instrumental": True}])
def test_coefficients_are_found(heavy, off, two_minutes, options):
    found = ls.solve(in_one(two_minutes), off, **options)
    error = np.abs(found.values / heavy.model.theta - 1.0)
    assert np.median(error) < 0.01
    assert error.max() < 0.1
    off_by = (found.values - heavy.model.theta) / np.sqrt(np.diag(found.covariance))
    assert np.sqrt(np.mean(off_by**2)) < 2.5


@pytest.mark.parametrize("instrumental", [False, True])
def test_intervals_are_those_of_leaving_blocks_out(heavy, off, two_minutes, instrumental):
    """Against fits without each of the blocks, in prior standard deviations."""
    task = regression(off)
    batch = ls.Batch(task, compiled(off.effects), heavy.model if instrumental else None)
    phi, z, *_ = ls._rows_and_instruments(two_minutes, batch)
    weight = 1.0 / authority(off.dynamics) ** 2

    def fitted(rows):
        sums = np.einsum("kai,a,kaj->ij", z[rows, :, :-1], weight, phi[rows])
        normal = sums[:, :-1] + np.eye(len(sums))
        return normal, np.linalg.solve(normal, sums[:, -1])

    normal, x = fitted(np.arange(len(phi)))
    inverse = np.linalg.inv(normal)
    scatter = ls.residuals_of(two_minutes, batch, x, weight, inverse).scatter
    edges = np.linspace(0, len(phi), 16).astype(int)  # of eight seconds
    rows = np.arange(len(phi))
    without = [fitted((rows < a) | (rows >= b))[1] - x for a, b in pairwise(edges)]
    jackknife = sum(np.outer(change, change) for change in without)
    np.testing.assert_allclose(sandwich(inverse, scatter), jackknife, rtol=1e-6)


def test_wrong_inertia_of_the_file_is_not_held_where_the_wrench_tells_it(heavy, two_minutes):
    """Even where it leaves moments (Munk's) unexplained that are larger than those that act."""
    factors = {"X_udot": 0.2, "Y_vdot": 3.0, "Z_wdot": 0.3, "K_pdot": 1.5, "N_rdot": 1.5}
    wrong = {name: factor * heavy.model.values[name] for name, factor in factors.items()}
    found = ls.solve(in_one(two_minutes), heavy.with_values(wrong))
    at = [heavy.model.names.index(name) for name in wrong]
    np.testing.assert_allclose(found.values[at], heavy.model.theta[at], rtol=0.05)


def test_several_bags_are_one(heavy, off):
    a, b = samples_of(heavy, 40.0, seed=1), samples_of(heavy, 40.0, seed=2)

    def both(function, *arguments):
        return [function(part, *arguments) for part in (a, b)]

    joint, alone = ls.solve(both, off), ls.solve(in_one(a), off)
    assert np.all(np.diag(joint.covariance) < 1.1 * np.diag(alone.covariance))
    assert joint.rows == pytest.approx(2 * alone.rows, rel=0.02)


def test_a_strong_prior_holds(heavy, off):
    samples = samples_of(heavy, 20.0)
    held = ls.solve(in_one(samples), off, precision=1e12)
    np.testing.assert_allclose(held.values, off.model.theta, rtol=1e-4)


def test_noise_biases_least_squares_and_instruments_cure_the_added_masses(heavy, off):
    """Velocities of 8 cm/s noise: the mean error over dives, in standard errors of that mean."""
    suite = dataclasses.replace(
        sensors.Suite(imu_rate=0.0), linear_std=0.08, angular_std=0.04, wrench_std=0.001
    )
    errors = {False: [], True: []}
    for seed in range(8):
        samples = samples_of(heavy, 90.0, suite, seed=seed)
        for instrumental, into in errors.items():
            found = ls.solve(in_one(samples), off, instrumental=instrumental, precision=1e-6)
            into.append((found.values / heavy.model.theta - 1.0)[:3])  # X_udot, Y_vdot, Z_wdot
    mean = {k: np.abs(np.mean(v, axis=0)) for k, v in errors.items()}
    chance = {k: np.std(v, axis=0, ddof=1) / np.sqrt(8) for k, v in errors.items()}
    assert np.mean((mean[False] / chance[False]) ** 2) > 6.0  # 1.4 is chance, with eight dives
    assert np.mean((mean[True] / chance[True]) ** 2) < 4.0
    assert np.all(mean[True] < 0.4 * mean[False])


# ------------------------------------------------------------------ what a bag can tell


def test_one_speed_tells_a_combination_only(heavy):
    names, scale = ("X_u", "X_uu", "Y_v"), np.array([5.0, 50.0, 3.0])
    speed = 0.5
    row = np.array([speed, speed * speed, 0.0]) * scale
    found = ls.base_parameters(names, 100.0 * np.outer(row, row), scale)
    assert found.unexcited == ("Y_v",)
    assert set(found.unidentified) == {"X_u", "X_uu", "Y_v"}
    (only,) = found.combinations
    # X_u u + X_uu u^2 is known: X_u + 0.5 X_uu, or X_uu + 2 X_u
    ((other, factor),) = only.others
    assert {only.name, other} == {"X_u", "X_uu"}
    assert factor == pytest.approx(speed if only.name == "X_u" else 1.0 / speed)
    assert found.collinear[0][:2] == ("X_uu", "X_u")


def test_a_rich_dive_tells_everything(heavy, two_minutes):
    found = ls.solve(in_one(two_minutes[: len(two_minutes) // 2]), heavy)
    base = ls.base_parameters(heavy.model.names, found.information, prior_of(heavy).std)
    assert base.unidentified == ()
    assert 1.0 < base.condition < 1e4
    assert {str(c) for c in base.combinations} == set(heavy.model.names)


CASES = ["known", "clean", "thrust scale", "thruster lag", "current", "trim", "sag and advance"]


@pytest.mark.parametrize("case", [*CASES[:4], *more(*CASES[4:])])
@pytest.mark.parametrize(("driving", "seed"), [("six-axis", 3), *more(("pilot", 4), ("pilot", 5))])
def test_what_it_cannot_know_is_in_the_intervals_or_said(case, driving, seed):
    """Data by a simulator that shares no code with the package."""
    fit = measure(Trial(case, driving, seed, 60.0, "ls"))
    lower, true, upper = (np.array(fit[key]) for key in ("lower", "true", "upper"))
    right = np.mean((lower <= true) & (true <= upper))
    assert right >= 0.9 or not fit["consistent"]
    assert "converged" not in fit["state"] or fit["consistent"]
    if case in ("known", "clean"):
        assert fit["consistent"], fit["sentence"]
    elif case != "thrust scale":
        assert not fit["consistent"]


@pytest.mark.parametrize("instrumental", [False, True])
@pytest.mark.parametrize("axes", [[0], [4], [0, 1, 2, 3, 4, 5]])
def test_how_values_follow_the_thrust(heavy, off, instrumental, axes):
    """As when the wrench of some axes is 1 % more; simulated instruments move a little, too."""
    samples = samples_of(heavy, 30.0)
    more_thrust = samples.copy()
    for part in ("wrench", "wrench_slope"):
        more_thrust[part][:, axes] *= 1.01
    found, moved = (
        ls.solve(in_one(s), off, instrumental=instrumental, weighted=False)
        for s in (samples, more_thrust)
    )
    difference = (moved.values - found.values) / 0.01
    size = np.maximum(np.abs(difference), np.abs(found.values))
    by_thrust = found.by_thrust[:, axes].sum(axis=1)
    assert np.all(np.abs(by_thrust - difference) < (0.05 if instrumental else 1e-6) * size)


def test_noise_is_nothing_that_lasts(heavy, off):
    """A force that wanders is told to a tenth; the noise of the sensors alone is far below."""
    samples = samples_of(heavy, 120.0)
    quiet = ls.solve(in_one(samples), off)
    assert np.all(quiet.lasting < 0.01 * authority(heavy.dynamics))
    rng, blown = np.random.default_rng(8), samples.copy()
    force, keep = 0.0, np.exp(-samples["dt"] / 20.0)
    for k, draw in enumerate(rng.standard_normal(len(samples))):
        force = keep[k] * force + np.sqrt(1.0 - keep[k] ** 2) * 5.0 * draw
        blown["wrench"][k, 1] -= force
    left = ls.solve(in_one(blown), off).lasting
    assert 1.0 < left[1] < 6.0


@pytest.mark.parametrize("kind", ["ls", "iv"])
def test_a_pause_of_the_odometry_is_left_out(heavy, off, kind):
    """In it velocities are those of the IMU, and drift: half a minute made errors of 48 %."""
    run = sensors.dive(heavy, "steps", 60.0, sensors.Suite(), 4)
    begin = run.messages[0][2].stamp
    silent = [
        (role, m)
        for _, role, m in run.messages
        if not (isinstance(m, Odometry) and 20e9 < m.stamp - begin < 40e9)
    ]
    sampler = Sampler(off)
    samples = joined([*(sampler.push(role, m) for role, m in silent), sampler.flush()])
    found = ls.solve(in_one(samples), off, instrumental=kind == "iv")
    error = np.abs(found.values - heavy.model.theta)
    assert np.all(error < 4.0 * np.sqrt(np.diag(found.covariance)))
    assert np.median(error / np.abs(heavy.model.theta)) < 0.02
