"""Noise of the wrench's reading: found, and not learnt from."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, sosfilt
from tiers import more

from bench.simulators import hidden
from bench.studies.at_sea import dive_of, messages_of
from bench.studies.watch import by_default
from rov_ident import config as configuration
from rov_ident.config.prior import prior_of
from rov_ident.estimation.online import Kind, OnlineEstimator
from rov_ident.io.write_messages import write_messages
from rov_ident.offline import batch_fit
from rov_ident.offline.archive import of_records
from rov_ident.offline.maximum_likelihood import assumed, one_pass
from rov_ident.sampling.records import read_record
from rov_ident.sampling.wrench_scatter import ReadingNoise, driven, noise_that_lasts, resting_noise

_RATE = 50.0  # Hz


def _after(readings: np.ndarray, relative: float = 0.01) -> ReadingNoise:
    noise = ReadingNoise(relative)
    for k, reading in enumerate(readings):
        noise.take(k / _RATE, reading)
    return noise


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_found_where_the_wrench_is_not_far_above_it(seed: int) -> None:
    """Half of the axes rest, the others are driven by steps of twenty times the noise or more."""
    rng = np.random.default_rng(seed)
    std = rng.uniform(0.05, 0.5, 6)
    driven = rng.permutation(6) < 3
    steps = np.repeat(rng.uniform(20.0, 60.0, (20, 6)) * rng.choice([-1.0, 1.0], (20, 6)), 50, 0)
    readings = std * (steps * driven + rng.standard_normal(steps.shape))
    noise = _after(readings)
    assert (noise.variance[driven] == 0.0).all()
    # fifty readings tell it to a fifth
    assert np.sqrt(noise.variance[~driven]) == pytest.approx(std[~driven], rel=0.6)
    known = 0.01 * np.abs(steps).mean(axis=0) * driven < 0.4  # of its size, and driven: known of
    assert np.sqrt(noise.found[known]) == pytest.approx(std[known], rel=0.4)


def test_commands_without_noise_of_their_own_have_none() -> None:
    """Steps and rests, slow sines, and noise in proportion to the wrench that is known of."""
    rng, t = np.random.default_rng(0), np.arange(1000) / _RATE
    steps = np.repeat(rng.uniform(-30.0, 30.0, (20, 6)) * (rng.random((20, 6)) < 0.5), 50, 0)
    sines = 20.0 * np.sin(2.0 * np.pi * t[:, None] * rng.uniform(0.05, 0.5, 6))
    for readings in (steps, sines, steps * (1.0 + 0.01 * rng.standard_normal(steps.shape))):
        assert (_after(readings).variance == 0.0).all()


@pytest.mark.parametrize("rate", [20.0, 50.0, 100.0])
def test_commands_that_never_rest_add_no_more_than_is_said(rate: float) -> None:
    """Of an autopilot, up to 1.5 Hz. Second differences had it twice as large at 20 Hz."""
    rng = np.random.default_rng(int(rate))
    low_pass = butter(2, 1.5 / (0.5 * rate), output="sos")
    commands = sosfilt(low_pass, rng.standard_normal((int(150.0 * rate), 6)), axis=0)
    commands *= 15.0 / commands.std(axis=0)
    readings = commands + 0.8 * rng.standard_normal(commands.shape)
    found, added = resting_noise(readings), driven(readings)
    assert (np.abs(found - 0.8) < 0.05 + added).all()
    assert (found < 0.8 * 1.5).all()
    still = 0.8 * rng.standard_normal(commands.shape)
    assert (driven(still) < 0.05).all()


@pytest.mark.parametrize("seed", range(3))
def test_what_is_left_of_thrusters_that_cancel_is_no_noise(seed: int) -> None:
    """A moment of 1e-16 N m, which two forces leave on arms whose products are rounded."""
    rng = np.random.default_rng(seed)
    readings = np.zeros((1000, 6))
    readings[:, 0] = np.repeat(rng.uniform(-30.0, 30.0, 20), 50) + rng.standard_normal(1000)
    arms = rng.uniform(0.1, 0.5, 3)
    readings[:, 4] = (readings[:, [0]] * arms).sum(axis=1) - readings[:, 0] * arms.sum()
    assert 0.0 < np.abs(readings[:, 4]).max() < 1e-12
    assert _after(readings).variance[4] == 0.0 and resting_noise(readings)[4] == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_noise_that_lasts_is_found_with_how_long_it_does(seed: int) -> None:
    """On axes that rest between steps of a stick; white noise is none, nor is nothing."""
    rng, count = np.random.default_rng(seed), 7500
    steps = np.repeat(rng.uniform(-60.0, 60.0, (count // 50, 6)), 50, axis=0)
    steps *= np.repeat(rng.random((count // 50, 6)) < 0.4, 50, axis=0)
    lasts, std = rng.integers(2, 13, 6), rng.uniform(0.05, 0.5, 6)
    each = np.array([rng.standard_normal(count)[np.arange(count) // n] for n in lasts]).T
    found, length = noise_that_lasts(steps + std * each)
    assert found == pytest.approx(std, rel=0.25)
    assert length == pytest.approx(lasts, rel=0.25, abs=1.0)
    for others in (steps, steps + std * rng.standard_normal(steps.shape)):
        found, length = noise_that_lasts(others)
        assert not found.any() and (length == 1).all()


def _case(seed: int, noise: float, seconds: float) -> hidden.Case:
    """A pilot's dive in which the thrust is as configured."""
    moments = float(np.random.default_rng(seed).uniform(0.04, 0.08))
    conditions = hidden.Conditions(
        seconds, excitation="pilot", reading=(noise * 0.5, noise * moments)
    )
    return hidden.draw(seed, conditions=conditions)


def _dive(
    kind: Kind, seed: int, noise: float, seconds: float = 40.0
) -> list[tuple[float, float, str]]:
    """Thrust scale, its standard deviation with the righting arm as configured, which is exact, and
    what is said of it, every five seconds."""
    case = _case(seed, noise, seconds)
    online = OnlineEstimator(by_default(case.config), kind)
    found, due = [], 5.0
    for _, role, message in case.messages:
        online.push(role, message)
        origin = online.sampler.origin
        if online.stamp and origin is not None and online.stamp - origin >= due * 1e9:
            due += 5.0
            report = online.report()
            i = report.names.index("thrust_scale.scale")
            assert report.beyond_driving is not None
            std = float(np.sqrt(report.std[i] ** 2 - report.beyond_driving[i]))
            found.append((float(report.values[i]), std, report.messages[i]))
    return found


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("ukf", 1),
        *more(("rls", 0), ("ukf", 0), ("rls", 1)),
        *more(*itertools.product(("rls", "ukf"), range(2, 12))),
    ],
)
def test_it_is_not_taken_for_a_weaker_thrust(kind: Kind, seed: int) -> None:
    """Without the rule RLS and UKF are five standard deviations off in most of these dives."""
    found = _dive(kind, seed, 1.0)
    for value, std, _ in found:
        assert abs(value - 1.0) <= 3.0 * std
    # nobody drives roll and pitch
    assert all("noise of the wrench's reading" in text and " K M" in text for *_, text in found)


@pytest.mark.study
@pytest.mark.parametrize("seed", range(3))
def test_nor_by_maximum_likelihood(seed: int, tmp_path: Path) -> None:
    """Without the rule it said in one such dive that thrust was 0.71 of what it was, std 0.17, and
    then, with a thrust of 1, that it lags by 0.033 s, std 0.005: that smooths the noise away."""
    case = _case(seed, 1.0, 60.0)
    write_messages(tmp_path / "dive.mcap", case.messages)
    fit = batch_fit.fit_batch(
        of_records([read_record(tmp_path / "dive.mcap", case.config)], case.config),
        by_default(case.config),
        "ml",
    )
    i = fit.names.index("thrust_scale.scale")
    assert abs(fit.values[i] - 1.0) <= 3.0 * fit.std[i]
    assert any("thrust_scale.scale" in note and "K M" in note for note in fit.notes)
    assert fit.values[fit.names.index("thruster_lag.time_constant")] < 0.5 / _RATE


def test_a_lag_is_not_learnt_from_the_axes_it_is_not_taught_by(tmp_path: Path) -> None:
    case = _case(0, 1.0, 20.0)
    write_messages(tmp_path / "dive.mcap", case.messages)
    config = by_default(case.config).with_nuisance
    record = read_record(tmp_path / "dive.mcap", config, columns=True)
    prior = prior_of(config, effects=True)
    first = len(config.model.theta)
    lag = prior.names.index("thruster_lag.time_constant")
    effects = prior.mean[prior.estimated >= first]
    information = []
    for axes in ([], [3, 4], range(6)):
        noise = assumed(config)
        noise.untaught[prior.estimated[lag] - first, axes] = True
        found = one_pass(record.samples, config.model, prior.estimated, noise, effects=effects)
        information.append(found.information[lag, lag])
    assert information[0] > information[1] > information[2] == 0.0


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.study)])
def test_the_thrust_is_learnt_from_clean_readings(seed: int) -> None:
    """The autopilot's command trembles with its sensors' noise, which the vehicle follows: that
    shows after twenty seconds of motion."""
    value, std, _ = _dive("rls", seed, 0.0, 60.0)[-1]
    assert std < 0.1
    assert abs(value - 1.0) <= 3.0 * std


@pytest.mark.parametrize(
    ("kind", "seed"), [("rls", 0), *more(("ukf", 0), *itertools.product(("rls", "ukf"), (1, 2)))]
)
def test_what_is_driven_is_learnt_beside_the_noise(kind: Kind, seed: int) -> None:
    """Taught by the noise, most were off by 20 to 50 %. What is off by more than chance (roll and
    pitch) is said to be in doubt."""
    dive = dive_of("wrench noise", "pilot", seed, 80.0)
    config = configuration.from_parameters(dive.parameters)
    online = OnlineEstimator(config, kind)
    online.follow(messages_of(dive, config))
    report = online.report()
    error, before, off = [], [], []
    for name, true in dive.vehicle.theta.items():
        i = report.names.index(name)
        error.append(abs(report.values[i] / true - 1.0))
        before.append(abs(config.model.values[name] / true - 1.0))
        off.append(abs(report.values[i] - true) / report.std[i])
    # what the file is off by stays in roll and pitch, and at worst in the other axes, too
    assert np.median(error) < 1.3 * np.median(before)
    assert max(off) < 4.0 or not report.consistency.consistent
    if kind == "rls":  # noise of the reading is no force that the model lacks
        tests = [t for t in report.consistency.tests if t.name.startswith("unexplained")]
        assert len(tests) == 6 and all(t.passed for t in tests)
