"""The estimator that nodes, replay and offline fits share: words, bounds, garbage, reset."""

import dataclasses
from copy import deepcopy
from itertools import islice

import numpy as np
import pytest
import textbook
from tiers import more

from rov_ident import config
from rov_ident.core.errors import UserError
from rov_ident.core.jit import interpret, stop_interpreting
from rov_ident.core.messages import IMU, ODOMETRY, WRENCH
from rov_ident.core.states import Level, State
from rov_ident.discrepancy.monitor import Monitor
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.estimation.physical import is_passive
from rov_ident.sampling.sample import joined
from rov_ident.sampling.sampler import Sampler
from rov_ident.simulation import virtual_sensors as sensors
from rov_ident.simulation.manoeuvres import manoeuvre

KINDS = ["rls", "ukf"]
SECOND = 1_000_000_000


def seconds(message):
    return (message.stamp - sensors.START) / SECOND


LEAN = sensors.Suite(odometry_rate=10.0, imu_rate=50.0)


@pytest.fixture(scope="module")
def messages(heavy):
    return [(role, m) for _, role, m in sensors.dive(heavy, "steps", 60.0, seed=2).messages]


@pytest.fixture(scope="module")
def wrong(heavy):
    factors = 1.0 + 0.2 * np.random.default_rng(3).uniform(-1, 1, len(heavy.model.theta))
    return textbook.off(heavy, factors)


@pytest.fixture(scope="module", params=KINDS)
def trained(request, wrong, messages):
    return fed(OnlineEstimator(wrong, request.param), messages)


def fed(estimator, messages):
    for role, message in messages:
        estimator.push(role, message)
    estimator.flush()
    return estimator


def publishable(estimator):
    """A report that a controller may use blindly, and it is returned."""
    report = estimator.report()
    n = len(report.names)
    for name in ("values", "std", "lower", "upper", "covariance", "excitation"):
        assert np.isfinite(getattr(report, name)).all(), name
    assert report.values.shape == report.std.shape == (n,)
    assert report.covariance.shape == (n, n)
    assert (report.std >= 0).all()
    assert (report.lower <= report.values).all() and (report.values <= report.upper).all()
    np.testing.assert_allclose(report.covariance, report.covariance.T, rtol=1e-6, atol=1e-12)
    assert is_passive(estimator.config.model, estimator.prior, report.values)
    assert len(report.states) == len(report.messages) == n
    for state, text in zip(report.states, report.messages):
        assert text.startswith(state.value)
    return report


# ------------------------------------------------------------------ words


def test_a_message_put_together_wrongly_is_refused(heavy, messages):
    """From Python: lists, other shapes and seconds are no bad data; nothing is kept of them."""
    estimator = OnlineEstimator(heavy, "rls")
    odometry = next(m for role, m in messages if role == ODOMETRY)
    for role, message, words in (
        ("odometry", odometry, "there is no input 'odometry': use one of odom, imu"),
        (IMU, odometry, "'imu' takes a message Imu, not Odometry"),
        (ODOMETRY, {"stamp": 1}, "takes a message Odometry, not dict"),
        (ODOMETRY, odometry._replace(linear=[0.0, 0.0, 0.0]), "linear of an 'odom' must be"),
        (ODOMETRY, odometry._replace(linear=np.zeros(2)), r"of shape \(3,\)"),
        (ODOMETRY, odometry._replace(stamp=1.5), "the stamp is 1.5, but must be whole nanosec"),
    ):
        with pytest.raises(UserError, match=words):
            estimator.push(role, message)
    assert not estimator.counts


@pytest.mark.parametrize("kind", KINDS)
def test_before_any_message(heavy, kind):
    report = publishable(OnlineEstimator(heavy, kind))
    assert report.stamp == 0
    np.testing.assert_allclose(report.values, heavy.model.theta, rtol=1e-9)
    assert not report.excitation.any()
    assert set(report.levels) == {Level.WARN}
    assert set(report.states) == {State.HELD}


def test_converged(trained, heavy):
    report = publishable(trained)
    strong = [report.names.index(n) for n in ("X_udot", "Y_vdot", "Z_wdot", "X_uu", "Y_vv", "N_rr")]
    for i in strong:
        assert report.levels[i] == Level.OK, report.names[i]
        assert report.messages[i] == "converged"
        assert report.excitation[i] > 0.5
        assert report.values[i] == pytest.approx(heavy.model.theta[i], rel=0.1)
    assert (report.excitation <= 1.0).all() and (report.excitation >= 0.0).all()
    assert report.units[report.names.index("X_u")] == "N s/m"


def test_a_recording_is_followed_as_if_pushed(trained, wrong, messages):
    """Samples that are folded together give the same to the last bit, and so what is known."""
    estimator = OnlineEstimator(wrong, trained.kind)
    estimator.follow(messages)
    ours, theirs = estimator.report(), trained.report()
    assert ours.values.tolist() == theirs.values.tolist()
    assert ours.covariance.tolist() == theirs.covariance.tolist()
    assert ours.excitation.tolist() == theirs.excitation.tolist()
    assert estimator.counts == trained.counts


@pytest.fixture(scope="module")
def lagging(heavy, wrong):
    """A file that takes the thrust for undelayed, and messages of a vehicle with a lag of 0.3 s."""
    lag = {"thruster_lag": {"time_constant": 0.3}}
    dive = sensors.dive(dataclasses.replace(heavy, effects=lag), "steps", 60.0, LEAN, seed=5)
    config = textbook.with_section(wrong, "wrench", lag_std=0.2)
    return config, [(role, m) for _, role, m in dive.messages]


@pytest.mark.parametrize("kind", [*more("rls"), "ukf"])
def test_what_is_learnt_anew_about_another_lag_is_not_forgotten(lagging, kind):
    """Once a lag is known better, the same messages teach again: nothing is as unknown as at
    first."""
    config, messages = lagging
    estimator = OnlineEstimator(config, kind)
    strong = [estimator.prior.names.index(name) for name in ("X_uu", "Y_vv", "Z_ww", "N_rr")]
    begun, shares, next_look = seconds(messages[0][1]), [], 0.0
    for role, message in messages:
        estimator.push(role, message)
        if seconds(message) - begun > next_look:
            next_look += 1.0
            shares.append((estimator.report().std / estimator.prior.std)[strong].max())
    known = np.minimum.accumulate(shares)
    assert known[20] < 0.3  # a third of a dive tells them
    assert (shares[20:] < 2.0 * known[20]).all(), np.round(shares, 2)
    report = estimator.report()
    i = report.names.index("thruster_lag.time_constant")
    assert abs(report.values[i] - 0.3) < 3.0 * report.std[i] + 0.01


@pytest.mark.parametrize(
    ("kind", "seed"), [("rls", 1), *more(("ukf", 1), ("rls", 2), ("ukf", 2), ("rls", 3))]
)
def test_a_recording_that_begins_with_the_first_thrust(heavy, wrong, kind, seed):
    """The vehicle is at rest, and its thrusters stand still: with a lag, known or not, what acts
    at first is not what is commanded. Coefficients of yaw were at their bounds within seconds, and
    the process noise that explained it hid all that came after."""
    rng = np.random.default_rng(seed)
    lag = {"thruster_lag": {"time_constant": rng.uniform(0.1, 0.15)}}
    t = np.arange(0.0, 41.0, 0.02)
    demand = manoeuvre("steps", heavy.dynamics, t, rng)
    demand[t < 4.0] = 0.0, 0.0, rng.uniform(30.0, 50.0), 0.0, 0.0, rng.choice([-5.0, 5.0])
    demand[t < 1.0] = 0.0
    vehicle = dataclasses.replace(heavy, effects=lag)
    dive = sensors.measure(vehicle, t, demand, 41.0, sensors.Suite(), rng)
    begin = sensors.START + 1_000_000_000
    messages = [(role, m) for _, role, m in dive.messages if m.stamp >= begin]
    report = fed(
        OnlineEstimator(textbook.with_section(wrong, "wrench", lag_std=0.2), kind), messages
    ).report()
    assert report.consistency.consistent, report.consistency.sentence
    for name in ("N_rdot", "N_rr"):
        i = report.names.index(name)
        assert report.values[i] == pytest.approx(heavy.model.values[name], rel=0.05), name


@pytest.mark.parametrize("kind", ["rls", *more("ukf")])
def test_learning_anew_does_not_depend_on_how_messages_come(lagging, kind):
    """One by one, as a recording or some at a time: the same to the last bit."""
    config, messages = lagging
    expected = fed(OnlineEstimator(config, kind), messages).report()
    followed, grouped = OnlineEstimator(config, kind), OnlineEstimator(config, kind)
    followed.follow(messages)
    rest, rng, told = iter(messages), np.random.default_rng(0), [sensors.START]
    while group := list(islice(rest, int(rng.integers(1, 40)))):
        for _ in grouped.push_all(group, lambda stamp: stamp - told[-1] >= 0.3 * SECOND):
            if grouped.stamp - told[-1] >= 0.3 * SECOND:
                told.append(grouped.stamp)
    grouped.flush()
    assert len(told) > 100 and np.diff(told).max() < 0.4 * SECOND
    for report in (followed.report(), grouped.report()):
        assert report.values.tolist() == expected.values.tolist()
        assert report.covariance.tolist() == expected.covariance.tolist()


def test_what_follows_is_sampled_with_the_lag_that_is_known_now(lagging):
    """After learning anew, the thrust that acts has always had it."""
    config, messages = lagging
    estimator, compared = OnlineEstimator(config, "rls"), 0
    for n, (role, message) in enumerate(messages):
        before = estimator.sampler
        estimator.push(role, message)
        if estimator.sampler is before:
            continue
        compared += 1
        expected = Sampler(estimator.config)
        expected.recentre(estimator._centre_config)
        for other in messages[: n + 1]:
            expected.push(*other)
        copy = deepcopy(estimator.sampler)
        ours, theirs = (
            joined([sampler.push(*other) for other in messages[n + 1 : n + 40]])
            for sampler in (copy, expected)
        )
        assert len(ours) and ours["wrench"].tolist() == theirs["wrench"].tolist()
        assert estimator.counts["wrench"] == sum(role == WRENCH for role, _ in messages[: n + 1])
    assert compared


@pytest.mark.parametrize("kind", ["rls", *more("ukf")])
def test_what_goes_with_a_limited_thrust_does_not_depend_on_how_wide_intervals_are(heavy, kind):
    """With 0.3 of the thrust configured, which nobody supposes, drag and inertia are those of the
    least thrust that is possible: what the motion shows is their ratio to it."""
    config = textbook.with_section(heavy, "wrench", scale_std=0.15)
    weak = dataclasses.replace(heavy, effects={"thrust_scale": {"scale": 0.3}})
    messages = [
        (role, m) for _, role, m in sensors.dive(weak, "steps", 60.0, LEAN, seed=5).messages
    ]
    report = fed(OnlineEstimator(config, kind), messages).report()
    assert report.consistency is not None and not report.consistency.consistent
    found = dict(zip(report.names, report.values, strict=True))
    assert found["thrust_scale.scale"] == pytest.approx(1.0 - 3.0 * 0.15)
    for name in ("X_uu", "Y_vv", "Z_ww"):
        ratio = found[name] / found["thrust_scale.scale"] / (heavy.value(name) / 0.3)
        assert ratio == pytest.approx(1.0, abs=0.2), name


def test_stamp_is_the_last_sample_s(trained, messages):
    last = max(m.stamp for role, m in messages if role in (ODOMETRY, IMU))
    assert abs(trained.report().stamp - last) <= 2
    assert trained.report().stamp == trained.report().stamp


@pytest.mark.study
@pytest.mark.parametrize("kind", KINDS)
def test_errors_of_a_slow_wrench_are_not_taken_for_many(heavy, kind):
    """At 10 Hz one lasts five times as long as configured: the intervals know."""
    noisy = textbook.with_section(heavy, "wrench", relative_std=0.03)
    suite = sensors.Suite(wrench_rate=10.0, wrench_std=0.03)
    scores = []
    for seed in range(6):
        dive = sensors.dive(heavy, "steps", 60.0, suite, seed)
        report = fed(OnlineEstimator(noisy, kind), [(r, m) for _, r, m in dive.messages]).report()
        truth = dict(zip(heavy.model.names, heavy.model.theta.tolist(), strict=True))
        scores.append(
            [
                (v - truth[n]) / s
                for n, v, s in zip(report.names, report.values, report.std, strict=True)
            ]
        )
    # Taken for errors of 20 ms it is 1.35, with 90 errors that are not quite independent.
    assert 0.75 < np.sqrt(np.mean(np.square(scores))) < 1.2


@pytest.mark.parametrize("kind", ["ukf", *more("rls")])  # both have the same words
def test_words_change_from_converging_to_converged(wrong, messages, kind):
    estimator = OnlineEstimator(wrong, kind)
    i = estimator.prior.names.index("X_u")
    words = []
    for k, (role, message) in enumerate(messages):
        estimator.push(role, message)
        if k % 100 == 99:
            words.append(publishable(estimator).messages[i])
    assert words[0].startswith(("held: not excited", "converging"))
    assert "converging" in words
    assert words[-1] == "converged"


@pytest.mark.parametrize("kind", ["rls", *more("ukf")])  # both have the same words
def test_what_is_not_excited_is_held_and_said_to_be(wrong, kind):
    """Surge alone for a minute; then rest."""
    run = sensors.dive(wrong, "rest", 10.0, LEAN, seed=1)
    t = np.arange(0.0, 60.0, 0.02)
    wrench = manoeuvre("steps", wrong.model, t, np.random.default_rng(2))
    wrench[:, 1:] = 0.0
    surge = sensors.measure(wrong, t, wrench, 60.0, LEAN, np.random.default_rng(0))
    estimator = OnlineEstimator(wrong, kind)
    fed(estimator, [(role, m) for _, role, m in surge.messages])
    report = publishable(estimator)
    by_name = dict(zip(report.names, zip(report.states, report.messages, strict=True)))
    assert by_name["X_uu"][0] == State.CONVERGED
    for name in ("Y_vv", "K_pp", "N_rr"):
        assert by_name[name][0] == State.HELD and "not excited" in by_name[name][1], name
        i = report.names.index(name)
        assert report.values[i] == pytest.approx(estimator.prior.mean[i], rel=0.3)
    later = [(role, m._replace(stamp=m.stamp + 60 * SECOND)) for _, role, m in run.messages]
    for k in range(20):  # more than six times EXCITATION_TIME
        shift = 10 * k * SECOND
        for role, m in later:
            estimator.push(role, m._replace(stamp=m.stamp + shift))
    report = publishable(estimator)
    text = dict(zip(report.names, report.messages, strict=True))["X_uu"]
    assert text == "converged: not excited now"


# ------------------------------------------------------------------ switching


@pytest.mark.parametrize("kind", ["rls", *more("ukf")])
def test_reset_is_a_fresh_start(wrong, messages, kind):
    """Amid the motion: back to the prior, then as good as an estimator that began there."""
    estimator, fresh = OnlineEstimator(wrong, kind), OnlineEstimator(wrong, kind)
    done = False
    for role, message in messages:
        if seconds(message) > 25.0 and not done:
            estimator.reset()
            report, done = publishable(estimator), True
            np.testing.assert_allclose(report.values, estimator.prior.mean, rtol=1e-9)
            np.testing.assert_allclose(report.std, estimator.prior.std, rtol=1e-9)
            assert not report.excitation.any()
        estimator.push(role, message)
        if done:
            fresh.push(role, message)
    a, b = publishable(estimator), publishable(fresh)
    assert (np.abs(a.values - b.values) < 0.5 * b.std + 0.01 * np.abs(b.values)).all()
    np.testing.assert_allclose(a.std, b.std, rtol=0.3)


@pytest.mark.parametrize("kind", [*more("rls"), "ukf"])
def test_disabled_learns_nothing_and_goes_on_without_a_jolt(wrong, messages, kind):
    """What happened meanwhile is not seen: neither as motion nor as an outlier."""
    estimator, gap = OnlineEstimator(wrong, kind), OnlineEstimator(wrong, kind)
    held = None
    for role, message in messages:
        estimator.enabled = not 20.0 < seconds(message) < 35.0
        if not estimator.enabled and seconds(message) > 21.0:
            held = held or estimator.report()
            assert len(estimator.push(role, message)) == 0
        else:
            estimator.push(role, message)
        if estimator.enabled:
            gap.push(role, message)
    assert held is not None
    a, b = publishable(estimator), publishable(gap)
    assert estimator.counts["sample: outlier"] <= gap.counts["sample: outlier"] + 3
    assert (np.abs(a.values - b.values) < 0.5 * b.std + 0.005 * np.abs(b.values)).all()


@pytest.mark.parametrize("why", ["disabled", "no odometry"])
def test_commands_are_not_hoarded_for_a_monitor_that_sees_no_samples(heavy, messages, why):
    """A node may rest on deck for days."""
    estimator = OnlineEstimator(heavy, "rls")
    estimator.attach(Monitor(heavy))
    estimator.enabled = why != "disabled"
    for role, message in messages:
        if why == "disabled" or role != ODOMETRY:
            estimator.push(role, message)
    assert estimator.counts[WRENCH] > 0 and len(estimator.sampler.commands) < 600
    stamps = [m.stamp for role, m in messages if role == WRENCH]
    assert len(stamps) > 1000


def test_report_does_not_change_the_state(trained):
    before = textbook.arrays(tuple(trained.state))
    first, second = trained.report(), trained.report()
    assert np.array_equal(first.values, second.values)
    after = textbook.arrays(tuple(trained.state))
    assert all(a.tobytes() == b.tobytes() for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("kind", ["rls", *more("ukf")])  # both are asked by the same function
def test_reports_do_not_matter(wrong, messages, kind):
    """How often anybody looks has no influence on the numbers."""
    part = messages[:2500]
    quiet, watched = OnlineEstimator(wrong, kind), OnlineEstimator(wrong, kind)
    fed(quiet, part)
    for k, (role, message) in enumerate(part):
        watched.push(role, message)
        if k % 50 == 0:
            watched.report()
    watched.flush()
    a, b = quiet.report(), watched.report()
    assert np.array_equal(a.values, b.values) and np.array_equal(a.covariance, b.covariance)


# ------------------------------------------------------------------ garbage


def spoiled(messages, spoil, begin=20.0, end=35.0):
    rng = np.random.default_rng(9)
    for role, m in messages:
        yield role, (spoil(rng, role, m) if begin < seconds(m) < end else m)


def no_covariance(variance):
    def spoil(rng, role, m):
        return m._replace(twist_variance=np.full(6, variance)) if role == ODOMETRY else m

    return spoil


def angular_unknown(rng, role, m):
    if role != ODOMETRY:
        return m
    return m._replace(twist_variance=np.r_[m.twist_variance[:3], [1e6] * 3], angular=np.zeros(3))


def noise_for_velocities(rng, role, m):
    if role == ODOMETRY:
        return m._replace(linear=rng.normal(0, 3, 3), angular=rng.normal(0, 3, 3))
    return m._replace(angular_velocity=rng.normal(0, 3, 3)) if role == IMU else m


def wrench_of(size):
    def spoil(rng, role, m):
        return m._replace(force=rng.normal(0, size, 3)) if role == WRENCH else m

    return spoil


def wrench_backward(rng, role, m):
    return m._replace(force=-m.force, torque=-m.torque) if role == WRENCH else m


def upside_down(rng, role, m):
    return m._replace(orientation=np.array([0.0, 1.0, 0.0, 0.0])) if role == ODOMETRY else m


def stuck(rng, role, m):
    return m._replace(linear=np.full(3, 0.7), angular=np.zeros(3)) if role == ODOMETRY else m


GARBAGE = {
    "infinite variance": no_covariance(np.inf),
    "NaN variance": no_covariance(np.nan),
    "variance 1e6": no_covariance(1e6),
    "variance 1e300": no_covariance(1e300),
    "angular velocity not measured": angular_unknown,
    "noise for velocities": noise_for_velocities,
    "wrench 1e3": wrench_of(1e3),
    "wrench 4e5": wrench_of(4e5),
    "wrench with the wrong sign": wrench_backward,
    "attitude upside down": upside_down,
    "stuck odometry": stuck,
}


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid")
@pytest.mark.parametrize("kind", ["rls", *more("ukf")])  # both have the same sampler
@pytest.mark.parametrize(
    ("what", "begin"),
    [
        *((what, (-1.0, 10.0)[i % 2]) for i, what in enumerate(GARBAGE)),
        *more(*((what, (10.0, -1.0)[i % 2]) for i, what in enumerate(GARBAGE))),
    ],
)
def test_garbage(wrong, messages, kind, what, begin):
    """Twelve seconds of it, from the start or amid: no exception, every report fit for use, and
    the estimator is not lost for good."""
    estimator = OnlineEstimator(wrong, kind)
    part = [(role, m) for role, m in messages if seconds(m) < 32.0]
    used = 0
    for k, (role, m) in enumerate(spoiled(part, GARBAGE[what], begin, begin + 12.0)):
        used += np.count_nonzero(estimator.push(role, m)["reason"] == 0)
        if k % 200 == 0:
            publishable(estimator)
    report = publishable(estimator)
    assert not any("diverged" in text for text in report.messages), "needs a reset by hand"
    assert used > 50


@pytest.mark.parametrize("kind", KINDS)
def test_interpreted_it_is_the_same(heavy, messages, kind):
    """Until a node is compiled it runs the kernels as Python, and then goes on from there."""
    effects = {"thruster_lag": {"time_constant": 0.1}, "ocean_current": {"north": 0.2, "east": 0.1}}
    document = config.to_parameters(heavy) | {"effects": effects}
    sunk = config.from_parameters(document)
    some = messages[:350]
    expected = fed(OnlineEstimator(sunk, kind), some).report()
    interpret()
    try:
        interpreted = OnlineEstimator(sunk, kind)
        for role, message in some[:150]:
            interpreted.push(role, message)
    finally:
        stop_interpreting()
    report = fed(interpreted, some[150:]).report()
    assert report.stamp == expected.stamp
    assert np.abs(report.values - expected.values).max() > 0.0  # sums in another order
    np.testing.assert_allclose(report.std, expected.std, rtol=1e-7)
    np.testing.assert_array_less(np.abs(report.values - expected.values), 1e-7 * expected.std)
