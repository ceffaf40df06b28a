"""Offline fits and what they are judged by: records, open-loop scores, the written result."""

import dataclasses
import json
import math

import numpy as np
import pytest
from tiers import more

from rov_ident.api import functions
from rov_ident.api.functions import fit
from rov_ident.config import from_parameters, to_parameters
from rov_ident.core.errors import UserError
from rov_ident.core.frames import gravity_direction
from rov_ident.core.states import State
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.io.bag_reader import Bag
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.cdr import ODOMETRY_TYPE
from rov_ident.io.write_messages import write_messages
from rov_ident.model.coefficients import VELOCITIES
from rov_ident.offline.fit import fit_online
from rov_ident.sampling.records import predicted, read_record, score
from rov_ident.simulation import virtual_sensors as sensors

DURATION = 20.0  # s
GAP = (9_000_000_000, 12_000_000_000)  # ns, of the record with a gap


@pytest.fixture(scope="module")
def quiet(heavy):
    """A dive without noise: (arrival, role, message)."""
    suite = sensors.Suite().scaled(0.0)
    return sensors.dive(heavy, duration=DURATION, suite=suite, seed=1).messages


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("records")


@pytest.fixture(scope="module")
def record(folder, heavy, quiet):
    write_messages(folder / "quiet.mcap", quiet)
    return read_record(folder / "quiet.mcap", heavy)


@pytest.fixture(scope="module")
def broken(folder, heavy, quiet):
    """The same with a pause of three seconds."""
    write_messages(folder / "gap.mcap", [m for m in quiet if not GAP[0] < m[2].stamp < GAP[1]])
    return read_record(folder / "gap.mcap", heavy)


@pytest.fixture(scope="module")
def resting(folder, heavy):
    messages = sensors.dive(heavy, "rest", duration=10.0, seed=1).messages
    write_messages(folder / "rest.mcap", messages)
    return read_record(folder / "rest.mcap", heavy)


@pytest.fixture(scope="module")
def fits(heavy, record):
    return {kind: fit_online([record], heavy, kind) for kind in ("rls", "ukf")}


# ------------------------------------------------------------------ records


def test_a_gap_counts_for_nothing(record, broken):
    assert record.duration == pytest.approx(DURATION, abs=0.2)
    pause = (GAP[1] - GAP[0]) * 1e-9
    assert record.duration - broken.duration == pytest.approx(pause, abs=0.2)
    assert np.count_nonzero(broken.samples["restart"]) == 2


def test_progress_ends_at_the_whole(folder, heavy, record, quiet):
    seen = []
    again = read_record(folder / "quiet.mcap", heavy, lambda what, share: seen.append(share))
    assert seen == sorted(seen)
    assert (seen[0], seen[-1]) == (0.0, 1.0)
    assert again.sha256 == record.sha256
    for name in record.samples.dtype.names:  # NaN where nothing was measured
        np.testing.assert_array_equal(again.samples[name], record.samples[name])


def test_messages_that_cannot_be_decoded_are_counted(folder, heavy, quiet):
    path = folder / "spoilt.mcap"
    write_messages(path, quiet)
    rows = list(Bag(path).iter_raw())
    spoilt = folder / "spoilt_again.mcap"
    with BagWriter(spoilt) as writer:
        for k, raw in enumerate(rows):
            cut = raw.type_name == ODOMETRY_TYPE and k % 3 == 0
            data = raw.data[:40] if cut else raw.data
            writer.write(raw.topic, raw.type_name, raw.log_time, data)
    count = sum(raw.type_name == ODOMETRY_TYPE and k % 3 == 0 for k, raw in enumerate(rows))
    record = read_record(spoilt, heavy)
    assert record.counts["odom: bytes that are no nav_msgs/msg/Odometry"] == count > 0
    assert (
        f"spoilt_again.mcap: odom: bytes that are no nav_msgs/msg/Odometry ({count})"
        in record.notes
    )


def test_what_makes_no_sample_is_refused(folder, heavy, quiet):
    path = folder / "unstamped.mcap"
    write_messages(path, [(at, role, m._replace(stamp=0)) for at, role, m in quiet])
    with pytest.raises(UserError, match=r"unstamped\.mcap: .* no samples: .*zero stamp"):
        read_record(path, heavy)


def test_attitude_of_the_samples_has_their_down(record):
    orientation = record.samples["orientation"]
    np.testing.assert_allclose(gravity_direction(orientation), record.samples["down"], atol=1e-12)


# ------------------------------------------------------------------ open loop


def test_the_truth_simulates_its_own_record(heavy, record):
    for horizon in (10.0, math.inf):
        result = score(record.samples, predicted(heavy.model, record.samples, horizon))
        assert np.all(result.r2 > 0.995)
        assert np.all(result.rmse < 0.02)


def test_a_wrong_model_scores_worse(heavy, record):
    wrong = heavy.model.with_theta(1.5 * heavy.model.theta)
    samples = record.samples
    rmse, true = (score(samples, predicted(m, samples, 10.0)).rmse for m in (wrong, heavy.model))
    assert np.all(rmse > 2.0 * true)


def test_components_not_simulated_follow_the_measurement(heavy, record):
    free = np.array([True, False, False, False, False, True])
    run = predicted(heavy.model, record.samples, math.inf, free)
    np.testing.assert_array_equal(run[:, ~free], record.samples["nu"][:, ~free])
    assert np.all(np.any(run[:, free] != record.samples["nu"][:, free], axis=0))


def test_one_run_begins_anew_after_a_gap(heavy, broken):
    run = predicted(heavy.model, broken.samples, math.inf)
    starts = np.flatnonzero(broken.samples["restart"])
    np.testing.assert_allclose(run[starts], broken.samples["nu"][starts], atol=1e-12)
    assert np.isfinite(run).all()


# ------------------------------------------------------------------ fits


@pytest.mark.parametrize("kind", ["rls", "ukf"])
def test_result_is_the_agreed_json(heavy, record, fits, kind):
    fit = fits[kind]
    result = json.loads(fit.to_json(), parse_constant=lambda name: pytest.fail(name))
    assert {*result} >= {"estimator", "coefficients", "samples", "duration_s", "open_loop"}
    assert result["estimator"] == kind
    assert result["samples"] == len(record.samples)
    assert result["duration_s"] == record.duration
    assert result["open_loop"]["horizon_s"] == 10.0
    assert tuple(result["open_loop"]["rmse"]) == tuple(VELOCITIES)
    assert tuple(result["coefficients"]) == heavy.model.names
    for i, found in enumerate(result["coefficients"].values()):
        std = math.sqrt(fit.covariance[i, i])
        half = 1.959963984540054 * std
        assert found == {
            "value": fit.values[i],
            "std": std,
            "unit": heavy.model.coefficients[i].unit,
            "lower": fit.values[i] - half,
            "upper": fit.values[i] + half,
            "identifiable": fit.identifiable[i],
            "state": fit.states[i].value,
        }
        assert fit.identifiable[i] == (fit.states[i].value in ("converged", "converging"))
    assert result["provenance"]["bags"] == [{"file": "quiet.mcap", "sha256": record.sha256}]


@pytest.mark.parametrize("kind", ["rls", "ukf"])
def test_fit_finds_the_truth(heavy, fits, kind):
    fit = fits[kind]
    assert np.median(np.abs(fit.values / heavy.model.theta - 1.0)) < 0.03
    assert all(fit.identifiable)
    np.testing.assert_array_equal(fit.model.theta, fit.values)
    assert np.all(fit.rmse < 0.03)


@pytest.mark.parametrize("kind", ["rls", "ukf"])
def test_rest_identifies_nothing(heavy, resting, kind):
    """What the motion does not show is said to be not identifiable, and stays at the prior."""
    fit = fit_online([resting], heavy, kind)
    damping = [i for i, name in enumerate(fit.names) if name in ("X_uu", "Y_vv", "N_rr")]
    for i in damping:
        assert not fit.identifiable[i] and fit.states[i] is State.HELD
        assert abs(fit.values[i] - heavy.model.theta[i]) < fit.std[i]


def test_two_records_are_one_fit(heavy, record, broken, fits):
    both = fit_online([record, broken], heavy, "rls")
    assert both.samples == len(record.samples) + len(broken.samples)
    assert both.duration == pytest.approx(record.duration + broken.duration, abs=1e-9)
    assert np.all(both.std <= 1.001 * fits["rls"].std)
    files = [bag["file"] for bag in both.provenance["bags"]]
    assert files == ["quiet.mcap", "gap.mcap"]


@pytest.mark.parametrize("effects", [{}, {"thruster_lag": {"time_constant": 0.01}}])
def test_sensors_that_contradict_each_other_in_any_record_are_told(folder, heavy, quiet, effects):
    """Without effects to estimate, samples are those of the records; with, messages are read."""
    given = from_parameters({**to_parameters(heavy), "effects": effects})
    assert bool(given.estimate_effects) == bool(effects)
    wrong = [
        (at, role, m._replace(angular_velocity=1.5 * m.angular_velocity) if role == "imu" else m)
        for at, role, m in quiet
    ]
    for name, messages in (("right", quiet), ("wrong", wrong)):
        write_messages(folder / f"{name}.mcap", messages)
    right, wrong = (read_record(folder / f"{name}.mcap", given) for name in ("right", "wrong"))
    for records, passes in (([right], True), ([wrong], False), ([wrong, right], False)):
        tests = fit_online(records, given, "rls").consistency.tests
        told = [test.passed for test in tests if test.name == "odometry and IMU: angular rate"]
        assert told == [passes]


def test_no_such_estimator(heavy, record):
    with pytest.raises(UserError, match="no estimator 'ols': use rls or ukf"):
        fit_online([record], heavy, "ols")


def test_numbers_that_do_not_exist_are_null(fits):
    rmse = np.array([0.1, np.nan, np.inf, 0.0, 0.0, 0.0])
    result = json.loads(dataclasses.replace(fits["rls"], rmse=rmse).to_json())
    assert [result["open_loop"]["rmse"][name] for name in "uvw"] == [0.1, None, None]


def test_parameters_of_effects_are_fitted_too(heavy, tmp_path):
    """As a node would: the sampler follows what is known by then."""
    true = from_parameters(
        {**to_parameters(heavy), "effects": {"thruster_lag": {"time_constant": 0.13}}}
    )
    config = from_parameters(
        {**to_parameters(heavy), "effects": {"thruster_lag": {"time_constant": 0.1}}}
    )
    run = sensors.dive(true, "steps", 60.0)
    write_messages(tmp_path / "dive.mcap", run.messages)
    record = read_record(tmp_path / "dive.mcap", config)
    result = fit_online([record], config, "rls")
    online = OnlineEstimator(config, "rls")
    for _, role, message in run.messages:
        online.push(role, message)
    online.flush()
    listed = json.loads(result.to_json())["coefficients"]["thruster_lag.time_constant"]
    assert listed["unit"] == "s"
    assert listed["value"] == online.report().values[-1] == pytest.approx(0.13, abs=0.005)


def test_a_value_that_a_bound_made_is_not_what_the_data_tell(fits):
    found = fits["rls"]
    known = found.identifiable.index(True)
    states = list(found.states)
    states[known] = State.AT_BOUND
    told = json.loads(dataclasses.replace(found, states=tuple(states)).to_json())
    assert told["coefficients"][found.names[known]]["identifiable"] is False


@pytest.mark.parametrize("estimator", ["rls", *more("ml")])
def test_a_velocity_sensor_that_pose_and_imu_contradict_is_told(folder, heavy, estimator):
    """To the dynamics it is as if the coefficients were others."""
    found, lean = [], sensors.Suite(odometry_rate=10.0, imu_rate=50.0)
    for name, factor in (("right", 1.0), ("scaled", 1.05)):
        messages = [
            (arrival, role, m._replace(linear=factor * m.linear) if role == "odom" else m)
            for arrival, role, m in sensors.dive(heavy, duration=60.0, suite=lean, seed=1).messages
        ]
        write_messages(folder / f"{name}_{estimator}.mcap", messages)
        found.append(fit(folder / f"{name}_{estimator}.mcap", heavy, estimator))
    right, scaled = found
    assert right.consistency.consistent and not scaled.consistency.consistent
    assert State.CONVERGED in right.states and State.CONVERGED not in scaled.states
    assert "velocity sensor reads wrong by a factor" in scaled.doubt
    failed = {test.name for test in scaled.consistency.tests if not test.passed}
    assert "velocity sensor: velocity_scale" in failed
    assert "velocity sensor: sensor_misalignment" not in failed


def test_sensors_are_compared_from_the_first_command_on(folder, heavy, monkeypatch):
    """A recording may begin long before it."""
    monkeypatch.setattr(functions, "_COMPARED", 2000)
    messages = sensors.dive(heavy, duration=40.0, seed=1).messages
    begin = messages[0][0] + 20 * 10**9
    late = [m for m in messages if m[1] != "wrench" or m[0] > begin]
    write_messages(folder / "late.mcap", late)
    tests = fit(folder / "late.mcap", heavy, "rls").consistency.tests
    assert any(test.name.startswith("velocity sensor") for test in tests)
