"""Maximum likelihood: sensitivities, whiteness, calibration, and what it needs to find."""

import dataclasses

import numpy as np
import pytest
from tiers import more

from rov_ident.core.errors import UserError
from rov_ident.io.write_messages import write_messages
from rov_ident.model.scales import authority
from rov_ident.offline import maximum_likelihood as ml
from rov_ident.offline.archive import of_records
from rov_ident.offline.batch_fit import Settings, fit_batch
from rov_ident.offline.prediction_error import open_loop
from rov_ident.sampling import records
from rov_ident.sampling.records import predicted, read_record
from rov_ident.sampling.sample import joined
from rov_ident.sampling.smoothing import smoothed
from rov_ident.simulation import virtual_sensors as sensors

LEAN = sensors.Suite(odometry_rate=10.0, imu_rate=50.0)


def in_one(samples):
    return lambda function, *arguments: [function(samples, *arguments)]


def samples_of(config, duration=60.0, suite=None, manoeuvre="steps", seed=1, velocity=True):
    run = sensors.dive(config, manoeuvre, duration, suite or sensors.Suite(), seed)
    return smoothed(joined(list(records.samples_of(config, run, velocity))), config)


@pytest.fixture(scope="module")
def samples(heavy):
    return samples_of(heavy)


@pytest.fixture(scope="module")
def depths(heavy):
    """Of the same dive, without linear velocities."""
    return samples_of(heavy, velocity=False)


@pytest.fixture(scope="module")
def off(heavy):
    factor = np.random.default_rng(3).uniform(0.6, 1.4, len(heavy.model.theta))
    return heavy.with_model(heavy.model.with_theta(heavy.model.theta * factor))


EVERY = np.arange(15)


def exact(heavy):
    """Wrench and attitude without error, and the start too: pure output error of one long
    simulation."""
    noise = ml.assumed(heavy)
    return dataclasses.replace(
        noise, measurement=np.full(6, 1e-12), floor=np.zeros(6), relative=0.0,
        restoring=np.zeros((6, 3)),
    )  # fmt: skip


def test_without_process_noise_the_innovation_is_the_output_error(heavy, samples):
    part = samples[:2000]
    found = ml.innovations(part, heavy.model, exact(heavy))
    # a vanishing measurement variance would draw the filter to the data: start variance is zero too
    simulated = predicted(heavy.model, part, np.inf)
    seen = np.isfinite(found.e[:, 0])
    assert seen.sum() > 300
    free = dataclasses.replace(exact(heavy), measurement=np.ones(6))
    run = ml.innovations(part, heavy.model, free)
    # with start variance that of one measurement, the run stays within that of the simulation
    off = run.nu[seen, :3] - simulated[seen, :3]
    assert np.abs(off).max() < 0.03


@pytest.mark.parametrize(
    ("relative", "seen"), [(0.0, "samples"), (0.01, "samples"), (0.01, "depths")]
)
def test_sensitivities_are_the_derivatives_of_the_innovations(heavy, relative, seen, request):
    """The score is minus half the cost's slope where the gain does not move, and the information
    is that of the differences of the innovations."""
    part, model = request.getfixturevalue(seen)[:1500], heavy.model
    noise = dataclasses.replace(ml.assumed(heavy), relative=relative)
    at = ml.one_pass(part, model, EVERY, noise)
    base = ml.innovations(part, model, noise)
    keep = np.isfinite(base.e)
    slopes = []
    for i in EVERY:
        theta = model.theta.copy()
        step = 1e-4 * abs(theta[i])
        theta[i] += step
        high = ml.innovations(part, model.with_theta(theta), noise)
        theta[i] -= 2.0 * step
        low = ml.innovations(part, model.with_theta(theta), noise)
        slopes.append((high.e[keep] - low.e[keep]) / (2.0 * step))
    j = np.array(slopes) / np.sqrt(base.s[keep])
    information = j @ j.T
    size = np.sqrt(np.diag(at.information))
    np.testing.assert_allclose(
        information / np.outer(size, size), at.information / np.outer(size, size), atol=0.02
    )
    score = -j @ (base.e[keep] / np.sqrt(base.s[keep]))
    # exact in the first order of the gain's own dependence
    np.testing.assert_allclose(score / size, at.score / size, atol=0.3)


@pytest.mark.parametrize(("seen", "axes"), [("samples", range(6)), ("depths", range(2, 6))])
def test_innovations_of_the_truth_are_white_and_of_unit_size(heavy, seen, axes, request):
    found = ml.innovations(request.getfixturevalue(seen), heavy.model, ml.assumed(heavy))
    assert np.flatnonzero(np.isfinite(found.e).any(axis=0)).tolist() == list(axes)
    for axis in axes:
        e = (found.e / np.sqrt(found.s))[:, axis]
        e = e[np.isfinite(e)]
        assert np.mean(e**2) == pytest.approx(1.0, abs=0.15)
        for lag in (1, 2, 5):
            assert abs(np.mean(e[lag:] * e[:-lag])) < 4.0 / np.sqrt(len(e)) + 0.02


def test_what_is_considered_keeps_its_prior_and_widens_the_rest(heavy):
    """As if all were estimated from data that tell of it no more than the others leave unknown."""
    rng, n, held = np.random.default_rng(2), 5, np.arange(5) >= 3
    root = rng.standard_normal((n, n))
    information, precision = root @ root.T, rng.uniform(0.1, 1.0, n)
    bound, covariance = ml._with_consider_parameters(information, [information], precision, held)
    ours = np.linalg.inv((information + np.diag(precision))[:3, :3])
    alike = information.copy()
    alike[3:, 3:] = information[3:, :3] @ ours @ information[:3, 3:]
    expected = np.linalg.inv(alike + np.diag(precision))
    np.testing.assert_allclose(bound, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.diag(bound)[3:], 1.0 / precision[3:], rtol=1e-9)
    np.testing.assert_allclose(covariance, bound, rtol=1e-9, atol=1e-12)
    nothing = np.zeros(n, dtype=bool)
    freely, _ = ml._with_consider_parameters(information, [information], precision, nothing)
    np.testing.assert_allclose(freely, np.linalg.inv(information + np.diag(precision)), rtol=1e-9)
    assert (np.diag(bound)[:3] > np.diag(freely)[:3]).all()
    # no variance is less than by another scatter of the score
    scatters = [information, np.diag([0.0, 9.0, 0.0, 0.0, 0.0]) * information]
    _, wider = ml._with_consider_parameters(information, scatters, precision, nothing)
    assert (np.diag(wider) >= np.diag(freely) * (1.0 - 1e-9)).all()
    assert np.diag(wider)[1] > 2.0 * np.diag(freely)[1]


@pytest.mark.parametrize(("name", "axis"), [("X_uu", 0), ("N_rr", 5)])
def test_innovations_of_a_wrong_model_last(heavy, samples, name, axis):
    """With half of its drag they add up over a second; those of the right model do not."""
    noise, theta = ml.assumed(heavy), heavy.model.theta.copy()
    rest = noise, np.ones(6, dtype=bool), np.inf, np.zeros(0)
    seconds, power = ml.whiteness(samples, heavy.model, *rest)
    assert (seconds > 40.0).all()
    # sixty seconds of sums over one: a scatter of a fifth
    np.testing.assert_allclose(power / seconds, 1.0, atol=0.6)
    theta[heavy.model.names.index(name)] *= 0.5
    seconds, power = ml.whiteness(samples, heavy.model.with_theta(theta), *rest)
    assert power[axis] > 4.0 * seconds[axis]


def test_noise_levels_are_found(heavy):
    suite = dataclasses.replace(LEAN, wrench_std=0.03)
    samples = samples_of(heavy, 90.0, suite)
    samples["odometry_variance"] /= 4.0  # the messages claim half the noise
    found = ml.maximise(in_one(samples), heavy, heavy.model)
    np.testing.assert_allclose(np.sqrt(found.noise.measurement[:3]), 2.0, rtol=0.1)
    np.testing.assert_allclose(np.sqrt(found.noise.measurement[3:]), 1.0, rtol=0.1)
    assert found.noise.relative == pytest.approx(0.03, rel=0.15)


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_noise_of_a_model_that_was_wrong_is_left_again(heavy, samples, seed):
    """Read again about another lag, a bag begins with the noise that was found about the last one:
    a gyro without noise and a wrench that nothing is known of is a valley of its own."""
    rng = np.random.default_rng(seed)
    likely, floor = ml.assumed(heavy), rng.uniform(0.03, 0.1, 6) * authority(heavy.dynamics)
    measurement = np.where(np.arange(6) == rng.integers(3, 6), 1e-4, 0.1)
    wrong = dataclasses.replace(likely, measurement=measurement, floor=floor**2)
    found = ml.maximise(in_one(samples), heavy, heavy.model, first_noise=wrong)
    assert np.max(np.sqrt(found.noise.floor) / authority(heavy.dynamics)) < 0.003
    np.testing.assert_allclose(np.sqrt(found.noise.measurement), 1.0, rtol=0.15)


@pytest.mark.parametrize("dives", [2, *more(6)])
def test_the_truth_is_found_from_afar_within_the_stated_errors(heavy, off, dives):
    near = heavy.with_model(heavy.model.with_theta(1.05 * heavy.model.theta))
    ratios = []
    for seed in range(dives):
        start = off if seed == 0 else near  # what is stated does not depend on it
        samples = samples_of(heavy, 40.0, LEAN, seed=seed)
        found = ml.maximise(in_one(samples), start, start.model)
        assert found.converged
        std = np.sqrt(np.diag(found.covariance))
        ratios.append((found.values - heavy.model.theta) / std)
        assert np.all(np.diag(found.bound) <= np.diag(found.covariance) * (1.0 + 1e-9))
        error = np.abs(found.values / heavy.model.theta - 1.0)
        assert np.median(error) < 0.005
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.35)


def test_coloured_residuals_widen_the_intervals(heavy, samples):
    """Repeat every measurement's error over half a second: as many samples say much less."""
    slow = samples.copy()
    truth = ml.innovations(samples, heavy.model, ml.assumed(heavy)).nu
    rng = np.random.default_rng(0)
    steps = (slow["t"] / 0.5).astype(int)
    error = rng.standard_normal((steps.max() + 1, 6))[steps]
    slow["odometry"][:, :3] = np.where(
        np.isfinite(slow["odometry"][:, :3]), truth[:, :3] + 0.008 * error[:, :3], np.nan
    )
    slow["gyro"] = np.where(np.isfinite(slow["gyro"]), truth[:, 3:] + 0.003 * error[:, 3:], np.nan)
    found = ml.maximise(in_one(slow), heavy, heavy.model, process=False)
    widened = np.sqrt(np.diag(found.covariance) / np.diag(found.bound))
    assert np.median(widened) > 2.0


def test_outliers_are_refused(heavy, samples):
    samples = samples[: len(samples) // 2]
    spoilt = samples.copy()
    measured = np.flatnonzero(np.isfinite(spoilt["odometry"][:, 0]))
    bad = np.random.default_rng(0).choice(measured[20:], 15, replace=False)
    spoilt["odometry"][bad, 0] += 0.5
    found = ml.maximise(in_one(spoilt), heavy, heavy.model)
    assert 15 <= found.total.outliers <= 20
    clean = ml.maximise(in_one(samples), heavy, heavy.model)
    off = (found.values - clean.values) / np.sqrt(np.diag(clean.covariance))
    assert np.abs(off).max() < 0.7


# ------------------------------------------------------------------ channel by channel


@pytest.fixture(scope="module")
def archive_of(tmp_path_factory):
    folder = tmp_path_factory.mktemp("channels")

    def make(config, file, manoeuvre="steps", **options):
        path = folder / f"{file}.mcap"
        write_messages(path, sensors.dive(config, manoeuvre, **options).messages)
        return of_records([read_record(path, config)], config)

    return make


@pytest.mark.study
def test_a_channel_fitted_alone_holds_in_the_joint_run(heavy, off, archive_of):
    """One axis moves at a time; then all move at once.

    Roll comes last: its Munk moment (Z_wdot - Y_vdot) v w is that of the others' added masses.
    """
    alone = archive_of(heavy, "alone", manoeuvre="single-axis", duration=150.0, seed=2)
    joint = archive_of(heavy, "joint", duration=40.0, seed=5)
    stages = (("surge",), ("sway", "yaw"), ("heave", "pitch"), ("roll",))
    fit = fit_batch(alone, off, "ml", Settings(stages))
    assert [s["channels"] for s in fit.more["stages"]] == [list(s) for s in stages]
    assert all(fit.identifiable)
    error = np.abs(fit.values / heavy.model.theta - 1.0)
    assert np.median(error) < 0.02 and error.max() < 0.2
    before, after = (open_loop(joint, c).rmse for c in (off, heavy.with_model(fit.model)))
    assert np.all(after < 0.6 * before)


def test_a_good_channel_is_left_alone(heavy, archive_of):
    bags = archive_of(heavy, "good", duration=30.0, seed=4)
    fit = fit_batch(bags, heavy, "ml", Settings((("surge",),)))
    assert any("surge: left alone" in n for n in fit.notes)
    np.testing.assert_array_equal(fit.values, heavy.model.theta)
    assert not any(fit.identifiable)


def test_a_channel_that_is_not_excited_is_refused_with_the_reason(heavy, off, archive_of):
    """As the longitudinal run of the sea trial: nothing but a hand's breadth of heave."""
    resting = dataclasses.replace(
        heavy, model=dataclasses.replace(
            heavy.model, body=dataclasses.replace(
                heavy.model.body, buoyancy=heavy.model.body.weight + 0.02
            )
        )
    )  # fmt: skip
    bags = archive_of(resting, "still", "rest", duration=20.0, seed=4)
    body = resting.model.body
    wrong = off.with_model(dataclasses.replace(off.model, body=body))
    # a wrong trim, so that the open loop is not good already
    wrong = wrong.with_model(
        dataclasses.replace(wrong.model, body=dataclasses.replace(body, buoyancy=body.weight + 5.0))
    )
    fit = fit_batch(bags, wrong, "ml", Settings((("heave", "pitch"),)))
    assert any("heave, pitch: not fitted, the motion does not show it" in n for n in fit.notes)
    np.testing.assert_array_equal(fit.values, off.model.theta)


def test_empty_channels_are_refused(heavy, archive_of):
    bags = archive_of(heavy, "short", duration=10.0, seed=4)
    few = dataclasses.replace(heavy, estimate=("X_u",))
    with pytest.raises(UserError, match="no coefficient of yaw"):
        fit_batch(bags, few, "ml", Settings((("yaw",),)))


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_a_moment_of_an_attitude_that_wanders_is_expected_to_last(heavy, samples, seed):
    """Not white, it made of roll and pitch what the model lacks."""
    tilt, rng, wandering = 0.03, np.random.default_rng(seed), samples.copy()
    keep = np.exp(-samples["dt"] / 15.0)
    off = np.zeros((len(samples), 3))
    for k in range(1, len(samples)):
        off[k, :2] = keep[k] * off[k - 1, :2]
        off[k, :2] += tilt * np.sqrt(1.0 - keep[k] ** 2) * rng.standard_normal(2)
    wandering["down"] += np.cross(samples["down"], off)
    rest = heavy.model, ml.assumed(heavy), np.ones(6, dtype=bool), np.inf, np.zeros(0)
    seconds, power = ml.whiteness(wandering, *rest)
    _, expected = ml.whiteness(wandering, *rest, tilt)
    assert (power[3:5] > 2.0 * seconds[3:5]).any()
    assert (expected[3:5] < 1.5 * seconds[3:5]).all()
    usual = heavy.odometry.attitude_std  # elsewhere the test stays as sharp
    clean, less = (ml.whiteness(samples, *rest, t)[1, [0, 1, 2, 5]] for t in (0.0, usual))
    np.testing.assert_allclose(less, clean, rtol=0.1)
