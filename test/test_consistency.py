"""Whether model and data agree: said of every estimate, and right on clean and on false data.

The dives come from a simulator that shares no code with the estimators (bench/simulators/sea.py).
"""

import itertools
import json
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from tiers import more

import rov_ident as ri
from bench.simulators import sea
from rov_ident import config as configuration
from rov_ident.config.prior import prior_of
from rov_ident.core.states import State
from rov_ident.estimation.consistency import Consistency, Test, consistency_of
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.io.write_messages import write_messages
from rov_ident.model.scales import authority
from rov_ident.offline.archive import of_records
from rov_ident.offline.prediction_error import by_chance
from rov_ident.sampling.records import Record, samples_of
from rov_ident.sampling.sample import joined
from rov_ident.simulation import virtual_sensors as sensors

RATE = {"odometry_rate": 10.0}  # Hz, which is enough
FALSE = {
    "velocity frozen": lambda rng: {"frozen_from": rng.uniform(20.0, 30.0)},
    "IMU turned": lambda rng: {"imu_turned": True},
    "wrench axis reversed": lambda rng: {"reversed_axis": int(rng.integers(3))},
    "smoothed odometry": lambda rng: {"smoothing": rng.uniform(0.08, 0.15)},
    "sag": lambda rng: {"resistance": rng.uniform(0.02, 0.03), "advance": rng.uniform(0.2, 0.3)},
}


@cache
def dive(case, driving, seed):
    """Vehicle, parameters of its file, and the messages of a minute."""
    rng = np.random.default_rng([seed, 5])
    vehicle = sea.draw_vehicle(rng)
    unknown = sea.Sea(**RATE, **(FALSE[case](rng) if case else {}))
    truth = sea.dive(vehicle, unknown, driving, 60.0, rng)
    return vehicle, sea.told(vehicle, unknown, rng), sea.measured(truth, unknown, rng)


def report_of(case, driving, seed, kind):
    vehicle, parameters, messages = dive(case, driving, seed)
    return vehicle, reported(parameters, messages, kind)


def reported(parameters, messages, kind):
    online = OnlineEstimator(configuration.from_parameters(parameters), kind)
    for _, role, message in messages:
        online.push(role, message)
    online.flush()
    return online.report()


@pytest.mark.parametrize(
    ("seed", "driving", "kind"),
    [
        (1, "six-axis", "ukf"),
        (1, "pilot", "rls"),
        *more((1, "six-axis", "rls"), (1, "pilot", "ukf")),
        *more(*itertools.product((2,), ("six-axis", "pilot"), ("rls", "ukf"))),
    ],
)
def test_clean_dives_agree(seed, driving, kind):
    _, report = report_of("", driving, seed, kind)
    assert report.consistency.consistent, report.consistency.sentence
    assert State.CONVERGED in report.states


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_intervals_are_widened_by_the_worst_test_whenever_it_comes(seed):
    """Not by one after the other."""
    rng = np.random.default_rng(seed)
    tests = [Test(f"test {i}", value, 1.0, "") for i, value in enumerate(rng.uniform(1.0, 9.0, 3))]
    root = rng.standard_normal((4, 4))
    covariance, prior, moved = root @ root.T, np.full(4, 1e3), np.zeros(4)
    at_once = Consistency(tuple(tests)).widened(covariance, prior, moved)
    for i in range(3):
        known, now = Consistency(tuple(tests[:i])), Consistency(tuple(tests[: i + 1]))
        covariance = now.widened(covariance, prior, moved, known.inflation)
    np.testing.assert_allclose(covariance, at_once, rtol=1e-9)


@pytest.mark.parametrize(
    ("case", "kind"), [(c, "ukf" if i % 2 else "rls") for i, c in enumerate(FALSE)]
)
def test_what_a_model_cannot_explain_is_said_and_nothing_has_converged(case, kind):
    _, report = report_of(case, "six-axis", 3, kind)
    assert not report.consistency.consistent
    assert State.CONVERGED not in report.states
    failed = [test for test in report.consistency.tests if not test.passed]
    assert report.consistency.sentence in [test.failure for test in failed]


PILOTED = {
    "sag": lambda rng: {
        "resistance": rng.uniform(0.02, 0.03), "advance": rng.uniform(0.2, 0.3),
        "discharge": rng.uniform(0.3, 1.0),
    },
    "clocks": lambda rng: {"imu_clock": rng.uniform(0.02, 0.03) * rng.choice([-1.0, 1.0])},
}  # fmt: skip


@pytest.mark.parametrize(
    ("case", "kind", "seed"),
    [
        ("clocks", "rls", 1),
        # sag is also among the dives above
        *more(("sag", "rls", 1)),
        *more(*((case, "rls" if i % 2 else "ukf", 1) for i, case in enumerate(PILOTED))),
        *more(*itertools.product(PILOTED, ("rls", "ukf"), (2, 3))),
    ],
)
def test_so_it_is_where_a_pilot_rests_between(case, kind, seed):
    """Noise has come down again by the end of the dive, and the last messages agree."""
    rng = np.random.default_rng([seed, 19])
    vehicle, unknown = sea.draw_vehicle(rng), sea.Sea(**PILOTED[case](rng))
    truth = sea.dive(vehicle, unknown, "pilot", 100.0, rng)
    report = reported(sea.told(vehicle, unknown, rng), sea.measured(truth, unknown, rng), kind)
    failed = [test.name for test in report.consistency.tests if not test.passed]
    asked = "whiteness" if case == "sag" else "odometry and IMU"
    assert any(name.startswith(asked) for name in failed), failed
    assert State.CONVERGED not in report.states


@pytest.mark.parametrize(
    ("is_copied", "is_known", "kind", "seed"),
    [
        (True, False, "rls", 1),
        (True, True, "rls", 1),
        *more(*itertools.product((True,), (False, True), ("rls", "ukf"), (2, 3, 4))),
        *more((True, False, "ukf", 1), (False, False, "rls", 1), (False, False, "ukf", 2)),
        *more((False, True, "rls", 1)),
    ],
)
def test_a_bias_of_the_gyro_is_found_whether_or_not_the_odometry_copies_it(
    is_copied, is_known, kind, seed
):
    """Two that read the same do not contradict each other; the attitude tells what both have, or
    the configuration does."""
    rng = np.random.default_rng([seed, 19])
    size = rng.uniform(0.002, 0.006, 3) if is_copied else np.full(3, 0.05)
    bias = size * rng.choice([-1.0, 1.0], 3)
    vehicle, unknown = (
        sea.draw_vehicle(rng),
        sea.Sea(**RATE, gyro_bias=tuple(bias.tolist()), gyro_is_shared=is_copied),
    )
    truth = sea.dive(vehicle, unknown, "pilot", 100.0, rng)
    parameters = sea.told(vehicle, unknown, rng)
    if is_known:
        gyro = dict(zip(("gx", "gy", "gz"), bias.tolist()))
        parameters["effects"] = {"imu_bias": {"ax": 0.0, "ay": 0.0, "az": 0.0, **gyro}}
    online = OnlineEstimator(configuration.from_parameters(parameters), kind)
    for _, role, message in sea.measured(truth, unknown, rng):
        online.push(role, message)
    online.flush()
    report, found = online.report(), online.sampler.kinematic_filter.state["gyro_bias"][0]
    # the gyro is good to 1e-4 in a minute
    np.testing.assert_allclose(found, 0.0 if is_known else bias, atol=3e-4)
    assert report.consistency.consistent, report.consistency.sentence
    assert State.CONVERGED in report.states
    for name, true in vehicle.theta.items():
        i = online.prior.names.index(name)
        assert abs(report.values[i] - true) < 3.0 * report.std[i]


@pytest.mark.parametrize("kind", more("rls", "ukf"))
def test_a_righting_moment_of_a_measured_attitude_is_no_news(kind):
    """Roll and pitch of a vehicle that a pilot steers: innovations as large as noise explains."""
    judged = []
    for seed in range(1, 5):  # an axis is judged once it has moved for long enough
        _, report = report_of("", "pilot", seed, kind)
        tests = report.consistency.tests
        judged += [t.value for t in tests if t.name in ("whiteness: K", "whiteness: M")]
    assert len(judged) >= 4 and np.mean(judged) < 1.3


@pytest.mark.parametrize("late", [0.0, 0.2])
def test_a_batch_fit_asks_odometry_and_imu(tmp_path, late):
    """Odometry that is stamped late looks like a vehicle with a delay; the IMU knows better."""
    rng = np.random.default_rng(7)
    vehicle, unknown = sea.draw_vehicle(rng), sea.Sea(**RATE, odometry_clock=late)
    truth = sea.dive(vehicle, unknown, "pilot", 40.0, rng)
    write_messages(tmp_path / "dive.mcap", sea.measured(truth, unknown, rng))
    document = {"/**": {"ros__parameters": sea.told(vehicle, unknown, rng)}}
    (tmp_path / "vehicle.yaml").write_text(yaml.safe_dump(document))
    fit = ri.fit(tmp_path / "dive.mcap", tmp_path / "vehicle.yaml", "ls")
    of_sensors = [t for t in fit.consistency.tests if t.name.startswith("odometry and IMU")]
    assert len(of_sensors) == 3
    assert all(t.passed for t in of_sensors) == (late == 0.0)


def test_a_fit_says_so_and_widens_its_intervals(tmp_path):
    vehicle, parameters, messages = dive("sag", "six-axis", 3)
    write_messages(tmp_path / "dive.mcap", messages)
    document = {"/**": {"ros__parameters": parameters}}
    (tmp_path / "vehicle.yaml").write_text(yaml.safe_dump(document))
    fit = ri.fit(tmp_path / "dive.mcap", tmp_path / "vehicle.yaml", "rls")
    told = json.loads(fit.to_json())["consistency"]
    assert told["consistent"] is False
    assert not all(test["passed"] for test in told["tests"])
    for test in told["tests"]:
        assert set(test) == {"name", "value", "limit", "passed"}
        assert test["passed"] == (test["value"] <= test["limit"])
    assert told["sentence"] in fit.sentence
    assert State.CONVERGED not in fit.states
    off = [abs(fit.values[fit.names.index(n)] - true) for n, true in vehicle.theta.items()]
    std = [fit.std[fit.names.index(n)] for n in vehicle.theta]
    assert np.mean(np.array(off) < 2.0 * np.array(std)) > 0.75


def test_each_question_has_its_limit(heavy):
    parameters = configuration.to_parameters(heavy)
    for known in ("scale_std", "lag_std"):
        parameters["wrench"].pop(known, None)
    config = configuration.from_parameters(parameters).with_nuisance
    prior, quiet = prior_of(config, effects=True), np.full(6, 0.001)
    names = prior.names

    def failed(values=prior.mean, unexplained=quiet, lasting=None, sensors=None, std=None):
        found = consistency_of(config, prior, values, unexplained, lasting, sensors, std)
        return [test.name for test in found.tests if not test.passed]

    assert failed() == []
    assert failed(unexplained=np.array([0.0, 0.0, 0.02, 0.0, np.nan, 0.0])) == ["unexplained: Z"]
    lasting = np.array([3.9, np.nan, 0.1, 1.0, 4.1, 2.0])
    assert failed(lasting=lasting) == ["whiteness: M"]
    assert failed(sensors={"velocity": 1.2, "attitude": 16.0}) == ["odometry and IMU: attitude"]
    far = prior.mean.copy()
    far[names.index("thrust_scale.scale")] -= 3.0 * 0.15
    far[names.index("X_uu")] *= 3.0  # nobody has said that a coefficient is well known
    far_off = ["prior of all together", "prior of thrust_scale.scale"]  # two: as one alone
    assert failed(values=far) == far_off
    far[names.index("thrust_scale.scale")] = 1.0 - 2.5 * 0.15
    assert failed(values=far) == []
    early, std = prior.mean.copy(), 0.01 * prior.std
    early[names.index("thruster_lag.time_constant")] = -0.02  # s
    assert failed(values=early, std=4.0 * std) == []
    assert failed(values=early, std=std) == ["bound of thruster_lag.time_constant"]


@pytest.mark.parametrize(
    ("name", "off", "told", "untold"),
    [
        # far beyond what is supposed, so beyond the bound of what is only supposed, too
        ("buoyancy.delta", 12.0, "the vehicle's file", "stamp"),
        ("cog_offset.dx", 12.0, "the vehicle's file", "stamp"),
        ("thrust_scale.scale", -4.0, "the wrench", "stamp"),
        ("thruster_lag.time_constant", 4.0, "the stamps", "file"),
        # a bound that nothing may be beyond
        ("thruster_lag.time_constant", -0.5, "is impossible", "takes for"),
        ("X_u", 1.5, "drives the vehicle", "impossible"),
    ],
)
def test_no_cause_is_named_that_cannot_be(name, off, told, untold):
    """10 N of weight too much were said to be stamps of different clocks; no stamp weighs
    anything."""
    config = configuration.load("config/bluerov2_heavy.yaml").with_nuisance
    prior, values = prior_of(config, effects=True), prior_of(config, effects=True).mean.copy()
    i = prior.names.index(name)
    values[i] += off * prior.std[i] * (1.0 if "." in name else abs(values[i]) / prior.std[i])
    found = consistency_of(config, prior, values, np.full(6, np.nan), std=0.01 * prior.std)
    sentences = [t.failure for t in found.tests if not t.passed and t.name.endswith(name)]
    assert sentences and all(name in s and told in s and untold not in s for s in sentences)
    assert found.sentence in sentences


def test_nuisance_parameters_may_not_all_be_far_off():
    """A weight that hangs below a vehicle from some minute on: thrust, trim and centre of gravity
    were 2.2 to 2.6 standard deviations off each, and all coefficients 4 to 6."""
    config = configuration.load("config/bluerov2_heavy.yaml").with_nuisance
    prior = prior_of(config, effects=True)
    assert len(config.nuisance_std) == 9

    def failed(off):
        values = np.where([n in prior.names[-9:] for n in prior.names], off, 0.0) * prior.std
        found = consistency_of(config, prior, prior.mean + values, np.full(6, np.nan))
        return [test.name for test in found.tests if not test.passed]

    assert failed(1.3) == []
    assert failed(1.45) == ["prior of all together"]


def test_intervals_grow_with_the_disagreement_up_to_what_the_file_says(heavy):
    prior = prior_of(heavy)
    n = len(prior.names)
    small, still = np.diag((0.01 * prior.std) ** 2), np.zeros(n)
    heavy = replace(heavy, odometry=replace(heavy.odometry, attitude_std=0.0))
    four = consistency_of(heavy, prior, prior.mean, np.array([0.04, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(
        np.sqrt(np.diag(four.widened(small, prior.std, still))), 0.04 * prior.std
    )
    thousand = consistency_of(heavy, prior, prior.mean, np.array([10.0, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(
        np.sqrt(np.diag(thousand.widened(small, prior.std, still))), prior.std
    )
    far = thousand.widened(small, prior.std, 4.0 * prior.std)  # what was believed is within reach
    np.testing.assert_allclose(np.sqrt(np.diag(far)), 4.0 * prior.std)
    assert Consistency(()).widened(small, prior.std, still) == pytest.approx(small)
    lasting = np.array([1.5**2, 1.0, np.nan, 0.5, 1.0, 1.0])  # power: within its limit of 2 x 2
    half = consistency_of(heavy, prior, prior.mean, np.full(6, np.nan), lasting)
    assert half.consistent
    np.testing.assert_allclose(half.widened(small, prior.std, still), 1.5**2 * small)
    by_chance = consistency_of(heavy, prior, prior.mean, np.full(6, np.nan), np.full(6, 1.2**2))
    np.testing.assert_array_equal(by_chance.widened(small, prior.std, still), small)
    assert len(small) == n


@pytest.mark.parametrize("arm", [0.01, 0.1])
def test_what_an_error_of_the_attitude_rights_is_no_force_that_the_model_lacks(heavy, arm):
    """Weight turns a vehicle at rest back to where it is said to be level: the longer the arm, the
    larger the moment that an attitude off by attitude_std makes, in roll and pitch alone."""
    body = replace(heavy.model.body, cob=np.array([0.0, 0.0, -arm]))
    heavy = heavy.with_model(replace(heavy.model, body=body))
    made = heavy.odometry.attitude_std * body.buoyancy * arm / authority(heavy.model)
    expected = np.hypot(0.01, np.where([0, 0, 0, 1, 1, 0], made, 0.0))
    found = consistency_of(heavy, prior_of(heavy), prior_of(heavy).mean, np.full(6, 0.01))
    limits = [test.limit for test in found.tests if test.name.startswith("unexplained")]
    np.testing.assert_allclose(limits, expected, rtol=1e-3)


def test_noise_of_the_reading_is_no_force_that_the_model_lacks(heavy):
    """White noise of this density moves the prediction in a second as such a force does; what is
    far beyond it still counts."""
    heavy = replace(heavy, odometry=replace(heavy.odometry, attitude_std=0.0))
    noise = np.square(np.array([0.0, 0.005, 0.02, 0.0, 0.02, 0.0]) * authority(heavy.model))
    prior, share = prior_of(heavy), np.array([0.005, 0.011, 0.028, 0.011, 0.04, 0.005])
    found = consistency_of(heavy, prior, prior.mean, share, reading_noise=noise)
    failed = [test.name[-1] for test in found.tests if not test.passed]
    assert failed == ["K", "M"]


def test_a_fit_that_predicts_worse_than_its_file_is_said_to(heavy):
    before = np.array([0.1, 0.1, np.nan, 0.1, 0.1, 0.1])
    after = np.array([0.05, 0.2, 0.3, 0.1, 0.1, 0.1])
    found = Consistency(()).with_open_loop(before, after, np.zeros(6))
    assert [test.name for test in found.tests if not test.passed] == ["open loop: v"]
    assert not found.consistent and "predicts v worse" in found.sentence
    uncertain = Consistency(()).with_open_loop(before, after, np.full(6, 0.05))
    assert uncertain.consistent  # 0.2 is within 0.1 and twice 0.05
    ruined = Consistency(()).with_open_loop(before, 4.0 * before, np.full(6, 10.0))
    assert not any(test.passed for test in ruined.tests)  # no uncertainty excuses that


def test_a_fit_whose_prediction_diverges_is_said_to_predict_worse(heavy):
    before, after = np.full(6, 0.1), np.array([0.05, np.inf, 0.1, 0.1, 0.1, np.nan])
    found = Consistency(()).with_open_loop(before, after, np.zeros(6))
    assert [test.name for test in found.tests if not test.passed] == ["open loop: v"]
    wide = found.widened(np.diag([0.0, 1e-6]), np.ones(2), np.zeros(2))
    assert wide[0, 0] == 0.0 and 0.5 < wide[1, 1] <= 1.0  # as the prior, and no more
    both = Consistency(()).with_open_loop(np.full(6, np.inf), np.full(6, np.inf), np.zeros(6))
    assert both.consistent


def test_noise_of_the_start_grows_where_a_vehicle_does_not_keep_its_course(heavy):
    """Of a fit without errors only that is left; a tenth of the drag in yaw, and twice the added
    mass of sway, make the Munk moment of a vehicle that goes ahead turn it."""
    run = sensors.dive(heavy, "pilot", 60.0, sensors.Suite(odometry_rate=10.0, imu_rate=50.0))
    record = Record(Path("simulated"), joined(list(samples_of(heavy, run))), Counter(), (), "")
    read, values = of_records([record], heavy), heavy.model.values
    changed = {"N_rr": 0.1, "Y_vdot": 2.0}
    unsteady = heavy.with_values({name: by * values[name] for name, by in changed.items()})
    steady, unsteady = (by_chance(read, c, [], np.zeros((0, 0)), []) for c in (heavy, unsteady))
    noise = np.sqrt(np.mean(record.samples["odometry_variance"], axis=0))
    assert np.all(steady > 0.0) and np.all(steady[:3] < noise[:3])
    assert unsteady[5] > 5.0 * steady[5]


def test_it_is_said_where_no_motion_was_judged(heavy):
    prior, nothing = prior_of(heavy), np.full(6, np.nan)
    silent = consistency_of(heavy, prior, prior.mean, nothing, nothing)
    assert silent.consistent and not silent.judged and "too little motion" in silent.sentence
    assert "too little motion" in silent.doubt
    asked = consistency_of(heavy, prior, prior.mean, np.zeros(6), np.ones(6))
    assert asked.judged and asked.sentence == "model and data agree"


@pytest.mark.parametrize("kind", ["rls", "ukf", "ml"])
def test_nothing_has_converged_where_nothing_was_judged(heavy, short_dive, tmp_path, kind):
    write_messages(tmp_path / "short.mcap", short_dive)
    fit = ri.fit(tmp_path / "short.mcap", heavy, kind)
    assert not fit.consistency.judged and "too little motion" in fit.doubt
    assert State.CONVERGED not in fit.states


def test_a_fit_to_part_of_the_commands_says_so(tmp_path):
    """Nothing that the innovations show says that the wrench is late: inertia would be too large,
    and sure."""
    _, parameters, messages = dive("", "six-axis", 3)
    commands = itertools.count()
    rare = [m for m in messages if m[1] != "wrench" or next(commands) % 5 == 0]
    file = tmp_path / "vehicle.yaml"
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))
    for name, part in (("all", messages), ("rare", rare)):
        write_messages(tmp_path / f"{name}.mcap", part)
        found = ri.fit(tmp_path / f"{name}.mcap", file, "rls").consistency
        assert "motion ahead of the wrench" in [test.name for test in found.tests]
        assert found.consistent == (name == "all"), found.sentence
    assert "record each command" in found.sentence


@pytest.mark.parametrize("kind", ["ls", "rls"])
def test_late_thrust_is_told_where_nothing_in_the_model_is_late(tmp_path, kind):
    """Least squares estimates no lag, nor does RLS where it is said to be none: added mass takes it
    up, beside what little of it is left to other tests."""
    _, parameters, messages = dive("", "six-axis", 3)
    known = {"wrench": {"lag_std": 0.0}, "odometry": {"latency_std": 0.0}}
    exact = {**parameters, **{key: {**parameters.get(key, {}), **known[key]} for key in known}}
    early = [(t, r, m._replace(stamp=m.stamp - 25_000_000) if r == "wrench" else m)
             for t, r, m in messages]  # fmt: skip
    for name, sent in (("exact", messages), ("late", early)):
        write_messages(tmp_path / f"{name}.mcap", sent)
        found = ri.fit(tmp_path / f"{name}.mcap", configuration.from_parameters(exact), kind)
        failed = [test.name for test in found.consistency.tests if not test.passed]
        assert ("motion behind the wrench" in failed) == (name == "late")
        assert found.consistency.consistent == (name == "exact"), found.consistency.sentence
        assert (State.CONVERGED in found.states) == (name == "exact")
    if kind == "rls":  # where the model has a lag, of any estimator the same is asked
        late = ri.fit(tmp_path / "late.mcap", configuration.from_parameters(parameters), kind)
        assert "motion behind the wrench" not in [test.name for test in late.consistency.tests]


@pytest.mark.parametrize("scale", [0.0, 0.02])
def test_a_gyro_that_turns_too_far_is_told(tmp_path, scale):
    """Damping in yaw was ten standard deviations off, in a fit that was said to agree."""
    rng = np.random.default_rng(5)
    vehicle, unknown = sea.draw_vehicle(rng), sea.Sea(odometry_rate=10.0)
    truth = sea.dive(vehicle, unknown, "pilot", 80.0, rng)
    messages = sea.measured(truth, unknown, rng)

    def scaled(message):
        of = [f for f in ("angular", "angular_velocity") if hasattr(message, f)]
        return message._replace(**{f: (1.0 + scale) * getattr(message, f) for f in of})

    told = sea.told(vehicle, unknown, rng)
    told["vehicle"] |= {"mass_std": 0.0, "inertia_std": 0.0, "cob_std": 0.0}
    told.setdefault("wrench", {})["scale_std"] = 0.0
    bag, file = tmp_path / "dive.mcap", tmp_path / "vehicle.yaml"
    write_messages(bag, [(arrival, role, scaled(m)) for arrival, role, m in messages])
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": told}}))
    tests = {test.name: test for test in ri.fit(bag, file, "rls").consistency.tests}
    test = tests["angular velocities: scale"]
    assert test.passed == (not scale)
    if scale:
        told_of = float(test.failure.split("r by ")[1].split(" %")[0])
        assert told_of == pytest.approx(100.0 * scale / (1.0 + scale), abs=0.15)
