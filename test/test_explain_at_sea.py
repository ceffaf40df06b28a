"""What explain makes of sensors and thrusters as vehicles have them: samples of the study."""

import copy
import dataclasses
from functools import cache, lru_cache

import numpy as np
import pytest
from tiers import more

from bench.simulators import sea
from bench.studies import at_sea
from bench.studies.at_sea import dive_of
from bench.studies.explain_at_sea import CASES
from rov_ident import config as configuration
from rov_ident.core.errors import UserError
from rov_ident.core.frames import (
    acceleration_of_arm,
    quaternion_from_euler,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_to_matrix,
    velocity_of_arm,
)
from rov_ident.core.linalg import integral, interpolated
from rov_ident.core.messages import ODOMETRY
from rov_ident.discrepancy import (
    clock_errors,
    patterns,
    rates_and_attitude,
    search,
    sensor_choice,
    sensor_consistency,
    velocity_sensor,
)
from rov_ident.discrepancy.explain import explain
from rov_ident.discrepancy.findings import kinematic_gain, of_attitude_errors
from rov_ident.discrepancy.held_out import Judge, is_practical, split
from rov_ident.discrepancy.hypothesis import Hypothesis
from rov_ident.discrepancy.linearisation import linearise
from rov_ident.discrepancy.output_error import Fitted
from rov_ident.discrepancy.results import Finding, Gain
from rov_ident.discrepancy.screening import Candidate
from rov_ident.discrepancy.search import INTERPLAY_NAME, Search
from rov_ident.discrepancy.sensor_choice import noise_of_wrench
from rov_ident.discrepancy.windowed_problem import WindowedProblem
from rov_ident.model.coefficients import AXES
from rov_ident.offline import delays
from rov_ident.sampling.raw_streams import Streams, gather, inspected, orientation_at


@lru_cache(maxsize=2)  # what several tests ask of one dive
def streams_of(case, driving, seed, seconds=60.0, draw=None):
    dive = dive_of(case, driving, seed, seconds, draw)
    config = configuration.from_parameters(dive.parameters)
    return dive, gather(at_sea.messages_of(dive, config), config), config


# ------------------------------------------------------------------ a vehicle that is not stable

NOT_STABLE = sea.Vehicle(
    mass=10.2,
    inertia=np.array([0.115, 0.15, 0.19]),
    cog=np.array([0.0, 0.0, 0.012]),
    cob=np.array([0.0, 0.0, -0.022]),
    buoyancy=100.4,
    theta={
        "X_udot": -4.6, "Y_vdot": -7.9, "Z_wdot": -11.5,
        "K_pdot": -0.085, "M_qdot": -0.11, "N_rdot": -0.13,
        "X_u": -3.2, "Y_v": -5.1, "Z_w": -7.6, "K_p": -0.06, "M_q": -0.09, "N_r": -0.07,
        "X_uu": -38.0, "Y_vv": -64.0, "Z_ww": -97.0, "K_pp": -0.42, "M_qq": -0.55, "N_rr": -0.48,
    },
)  # fmt: skip
"""Ahead, its Munk moment turns it further than the damping of yaw holds it back."""


def lean(draw=lambda *_: {}, **sea):
    """What a dive is drawn by: as ``draw`` does, with odometry at 10 Hz, which is enough."""
    return lambda *of: {"odometry_rate": 10.0, **draw(*of), **sea}


def dive_at_sea(folder, vehicle, seed, unknown, seconds=80.0):
    """A dive, and the file, which is exact but for what is ``unknown`` of the vehicle."""
    rng = np.random.default_rng(seed)
    truth = sea.dive(vehicle, unknown, "pilot", seconds, rng)
    path = folder / "dive.mcap"
    at_sea.write_messages(path, sea.measured(truth, unknown, rng))
    parameters = sea.told(vehicle, unknown, rng, off=0.0)
    dive = at_sea.Dive(vehicle, unknown, path.read_bytes(), parameters)
    config = configuration.from_parameters(parameters)
    return gather(at_sea.messages_of(dive, config), config), config


@pytest.mark.parametrize("seed", [4, *more(0, 1, 2, 3)])
def test_noise_that_grows_in_a_window_is_not_left(tmp_path, seed):
    """That of the measured state from which a window begins; of seed 4 it was 85 % of the roll.

    Windows that run away, whatever is fitted, led to other minima, and to names of what is not
    there: of the first nine seeds one had `coriolis`, another was left open."""
    streams, config = dive_at_sea(tmp_path, NOT_STABLE, seed, sea.Sea())
    findings = explain([streams], config).findings
    assert findings.verdict in ("agrees", "retuned") and not findings.effects
    assert not any("left" in note and "of the motion" in note for note in findings.notes)


def test_a_window_is_followed_until_it_runs_away(tmp_path):
    """And no further, whatever is fitted; the windows of a stable vehicle to their ends."""
    streams, config = dive_at_sea(tmp_path, NOT_STABLE, 4, sea.Sea())
    problem = Search(streams, config, split(streams.duration)[0]).problem
    first = linearise(problem, Hypothesis(config, {}), problem.measured_starts(), np.full(6, 0.02))
    shares = np.array([(first.of_windows > 0.0).mean(), first.told.mean()])
    assert shares[0] == 1.0 and 0.5 < shares[1] < 0.9
    for w in range(len(problem.first)):
        told = first.told[problem.window == w]
        assert told[0] and np.all(np.diff(told.astype(int)) <= 0)
    drag = {key: 0.5 * value for key, value in first.hypothesis.values.items()}
    other = linearise(problem, first.hypothesis.at(drag), first.starts, first.noise)
    assert other is None or (other.told == first.told).all()
    _, streams, config = streams_of("clean", "six-axis", 1, 60.0)
    problem = Search(streams, config, split(streams.duration)[0]).problem
    stable = linearise(problem, Hypothesis(config, {}), problem.measured_starts(), np.full(6, 0.02))
    assert stable.told.all()


@pytest.mark.parametrize("seed", [2, *more(0, 1)])
def test_what_a_vehicle_that_is_not_stable_lacks_is_found(tmp_path, seed):
    unknown = sea.Sea(cog=(0.0, 0.01, 0.0), odometry_rate=10.0)
    streams, config = dive_at_sea(tmp_path, NOT_STABLE, seed, unknown)
    (found,) = explain([streams], config).findings.effects
    assert found.effect == "cog_offset"
    assert abs(found.parameters["dy"].value - 0.01) < 3.0 * found.parameters["dy"].std


@pytest.mark.parametrize("seed", [1, *more(2, 3)])
def test_errors_are_no_more_than_noise_is_said_to_make_of_them(tmp_path, seed):
    """Of the vehicle that is not stable as of one that is, with the exact model. A block has a
    single start, so that the square of one in twenty is four times what is expected; of the mean of
    three blocks it is 2.6 times."""
    for vehicle in (NOT_STABLE, sea.draw_vehicle(np.random.default_rng(seed))):
        streams, config = dive_at_sea(tmp_path, vehicle, seed, sea.Sea(), 120.0)
        problem, h = WindowedProblem(streams, split(streams.duration)[1]), Hypothesis(config, {})
        judge = Judge(problem, likeliest=h)
        rmse = np.array(list(judge.rmse(h).values()))
        assert np.all(rmse < np.sqrt(2.6) * judge.rmse_of_noise())


# ------------------------------------------------------------------ an attitude whose error lasts


@pytest.mark.parametrize("seed", [1, *more(0, 2, 3)])
def test_an_attitude_that_wanders_is_no_fault_of_the_model(seed):
    """The moment of the error, integrated over a window, passed for damping and waves, and for a
    term without a name, and the error itself for a bias of the IMU; retuned, roll and pitch were
    predicted worse than by the file."""
    _, streams, config = streams_of("wander", "pilot", seed, 80.0, lean(wander=0.002))
    findings = explain([streams], config).findings
    assert findings.effects == ()
    assert all(findings.retuned[c] < 1.2 * findings.baseline[c] for c in "pq")


@pytest.mark.parametrize("seed", [1, *more(0, 2, 3)])
def test_a_bias_is_known_as_well_as_the_attitude(seed):
    """Of a gyro that the odometry copies, and an accelerometer, beside an attitude that wanders."""

    def draw(rng, vehicle):
        return {
            "odometry_rate": 10.0,
            "wander": 0.002,
            "gyro_bias": tuple((0.003 * rng.standard_normal(3)).tolist()),
            "accelerometer_bias": tuple((0.05 * rng.standard_normal(3)).tolist()),
            "gyro_is_shared": True,
        }

    dive, streams, config = streams_of("wander and biases", "pilot", seed, 100.0, draw)
    findings = explain([streams], config).findings
    (bias,) = (f for f in findings.effects if f.effect == "imu_bias")
    true = [*dive.sea.accelerometer_bias, *dive.sea.gyro_bias]
    for value, real in zip(bias.parameters.values(), true, strict=True):
        assert abs(value.value - real) < 3.0 * value.std


def test_what_errors_of_the_attitude_make_of_the_righting_moment_is_not_left():
    """In nineteen of twenty cases, that is: of one standard deviation a third is more."""
    _, _, config = streams_of("clean", "six-axis", 0, 40.0)
    tilts = np.random.default_rng(1).normal(0.0, config.odometry.attitude_std, (20_000, 3))
    down = np.cross([0.0, 0.0, 1.0], tilts)
    wrench = np.abs(down @ config.model.body.restoring.T)
    within = (wrench <= of_attitude_errors(Hypothesis(config, {}))).mean(axis=0)
    np.testing.assert_allclose(within[[3, 4]], 0.95, atol=0.01)
    assert within.min() > 0.94


def test_the_covariance_of_an_attitude_error_whitens_what_it_makes():
    """An attitude that is off, by ends that are independent in each window, makes residuals of the
    covariance that they are whitened with."""
    _, streams, config = streams_of("clean", "six-axis", 0, 40.0)
    search = Search(streams, config, split(streams.duration)[0])
    problem, h = search.problem, search.given
    line = linearise(problem, h, problem.measured_starts(), np.full(6, 0.005))
    force = config.odometry.attitude_std * problem.tilting(config.model.body)
    whole, white = line._moved(force), line.unprojected(force)
    for a, b in line._spans():
        j, w = whole[6 * a : 6 * b], white[6 * a : 6 * b]
        # J' (I + J J')^-1 J = J'J (I + J'J)^-1
        normal = j.T @ j
        np.testing.assert_allclose(w.T @ w, normal @ np.linalg.inv(np.eye(6) + normal), atol=1e-6)
    assert np.abs(whole[3::6]).max() > 1.0  # it matters in roll


# ------------------------------------------------------------------ rates and attitude


FINE = 0.005  # s, between the instants of a motion


@cache
def motion(seconds):
    """A vehicle that turns about all axes: instants, rates and attitudes."""
    t = np.arange(0.0, seconds, FINE)
    begin = np.random.default_rng(5).uniform(0.0, 6.0, (3, 1))
    phase = begin + np.outer([0.9, 1.3, 0.4], t)
    rate = (np.array([[0.3], [0.2], [0.5]]) * np.sin(phase)).T
    q = [np.array([1.0, 0.0, 0.0, 0.0])]
    for step in 0.5 * FINE * (rate[1:] + rate[:-1]):
        q.append(quaternion_multiply(q[-1], quaternion_from_rotation_vector(step)))
    return t, rate, np.array(q)


def turning(bias=(0.0, 0.0, 0.0), late=0.0, noise=1.0, seconds=60.0):
    """Such a motion as odometry at 20 Hz whose rates are those of a gyro."""
    (t, rate, attitude), rng = motion(seconds), np.random.default_rng(6)
    attitude, k = attitude[::10], np.arange(0, len(t), 10)
    small = noise * 0.002 * rng.standard_normal((len(k), 3))
    attitude = quaternion_multiply(attitude, quaternion_from_rotation_vector(small))
    measured = rate[np.clip(k - round(late / FINE), 0, len(t) - 1)] + bias
    measured = measured + noise * 0.004 * rng.standard_normal(measured.shape)
    none, nu = np.zeros((len(k), 3)), np.hstack([np.zeros((len(k), 3)), measured])
    empty, three, four = np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4))
    streams = Streams(
        t[k], none, attitude, nu, empty, three, three, t[k], np.ones((len(k), 6)), empty, four
    )
    return inspected(streams), rate[k]


@pytest.mark.parametrize("bias", [(0.02, -0.01, 0.015), (0.0, 0.0, 0.005)])
@pytest.mark.parametrize("late", [0.0, 0.1])
def test_rates_are_those_of_the_attitude(bias, late):
    streams, true = turning(bias, late)
    found = rates_and_attitude.agreed(streams, a_configuration())
    assert found.late == (late > 0.0) and not found.may_drift
    error = (found.streams.nu[:, 3:] - true)[2:-3]
    assert np.abs(error.mean(axis=0)).max() < 5e-4
    assert error.std() < 1.2 * 0.004
    (note,) = found.streams.notes
    assert "attitude" in note and (f"{late:.2g} s late" in note) == (late > 0.0)


def test_a_small_bias_shows_in_brisk_turns_where_the_gyro_reads_oftener(heavy):
    """Trapezoids of rates at 10 Hz miss more of such turns than the bias makes, which then passed
    for asymmetric damping, sure."""
    rng, t = np.random.default_rng(7), np.arange(0.0, 60.0, 0.01)
    rate, q = np.zeros((len(t), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    level = np.repeat(rng.uniform(-3.0, 3.0, (60, 3)), 100, axis=0)  # each is reached with a lag
    for i in range(1, len(t)):
        rate[i] = rate[i - 1] + 0.07 * (level[i] - rate[i - 1])
        step = quaternion_from_rotation_vector(0.005 * (rate[i - 1] + rate[i]))
        q[i] = quaternion_multiply(q[i - 1], step)
    bias = np.array([0.0008, -0.0005, 0.0005])
    gyro, k = rate + bias + 0.001 * rng.standard_normal(rate.shape), np.arange(0, len(t), 10)
    small = quaternion_from_rotation_vector(0.0003 * rng.standard_normal((len(k), 3)))
    none, empty, four = np.zeros((len(k), 3)), np.zeros(0), np.zeros((0, 4))
    streams = Streams(
        t[k], none, quaternion_multiply(q[k], small), np.hstack([none, gyro[k]]), t, gyro,
        np.zeros_like(gyro), t[k], np.ones((len(k), 6)), empty, four,
    )  # fmt: skip
    found = rates_and_attitude.agreed(streams, heavy)
    taken = (streams.nu - found.streams.nu)[:, 3:].mean(axis=0)
    np.testing.assert_allclose(taken, bias, atol=1e-4)
    assert found.streams.rates_std.max() < 1e-4 and "late" not in found.streams.notes[-1]


BIAS = 0.004  # rad/s


def biased(driving, seed):
    """A dive without an IMU whose angular velocities have a bias, and a configuration."""
    _, streams, config = streams_of("", driving, seed, 100.0, lean())
    bias = BIAS * np.sign(np.random.default_rng(seed).standard_normal(3))
    empty, three = np.zeros(0), np.zeros((0, 3))
    streams = dataclasses.replace(streams, imu_t=empty, gyro=three, specific_force=three)
    return streams, dataclasses.replace(streams, nu=streams.nu + [0.0, 0.0, 0.0, *bias]), config


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_what_a_bias_of_the_rates_explains_as_well_is_not_sure(seed, monkeypatch):
    """Where the attitude cannot exclude such a bias; where it can, no bias explains anything."""
    _, streams, config = biased("six-axis", seed)

    def found(std):
        known = rates_and_attitude.Agreed(dataclasses.replace(streams, rates_std=np.full(3, std)))
        monkeypatch.setattr(rates_and_attitude, "agreed", lambda *_: known)
        (finding,) = explain([streams], config).findings.effects
        return finding

    sure, unsure = found(0.0), found(BIAS)
    assert sure.effect == "asymmetric_damping" and sure.separable
    assert not unsure.separable and "imu_bias" in [a.effect for a in unsure.alternatives]


def test_a_bias_of_the_rates_is_in_the_residuals_as_the_covariance_has_it():
    straight, streams, config = biased("pilot", 3)
    streams = dataclasses.replace(streams, rates_std=np.full(3, BIAS))
    spans, bias = split(straight.duration)[0], (streams.nu - straight.nu)[0, 3:]
    here = Search(straight, config, spans).start()
    h, starts, noise = here.hypothesis, here.linearisation.starts, here.noise
    problems = [WindowedProblem(s, spans) for s in (straight, streams)]
    for problem in problems:  # in both the same part of windows that run away
        problem.told(lambda: here.linearisation.told)
    without, having = (linearise(p, h, starts, noise) for p in problems)
    expected = having.of_biases() @ (bias / BIAS)
    # between two messages the attitude is turned by the rates, which makes 2e-4 of it
    np.testing.assert_allclose(having.error - without.error, expected, atol=1e-3)
    fitted = [Fitted(h, line, True) for line in (without, having)]
    wider = np.diag(fitted[1].covariance) / np.diag(here.covariance)
    yaw = [i for i, (_, name) in enumerate(h.keys) if name == "N_r"]
    assert fitted[0].squares_of_biases == 0.0 < fitted[1].squares_of_biases
    assert (wider[yaw] > 1.01).all()


def a_configuration():
    return configuration.from_parameters(dive_of("clean", "pilot", 1, 60.0).parameters)


@pytest.mark.parametrize(("driving", "rate"), [("pilot", 0.02), *more(("six-axis", -0.003))])
def test_a_heading_that_drifts_is_no_bias_of_the_gyro(driving, rate):
    _, streams, config = streams_of("", driving, 0, 100.0, lean(heading_drift=rate))
    found = rates_and_attitude.agreed(streams, config)
    np.testing.assert_array_equal(found.streams.nu, streams.nu)
    back = quaternion_from_euler(0.0, 0.0, -rate * streams.t)
    true = quaternion_multiply(back, streams.orientation)
    between = quaternion_multiply(true * [1.0, -1.0, -1.0, -1.0], found.streams.orientation)
    assert np.abs(between[:, 1:]).max() < 0.5 * 3e-4 * 100.0
    assert not found.may_drift and "drifts" in found.streams.notes[-1]


@pytest.mark.parametrize("bias", [0.01, *more(-0.003)])
def test_a_bias_of_the_gyro_is_no_drift_of_the_heading(bias):
    drawn = lean(gyro_bias=(0.0, 0.0, bias), gyro_is_shared=True)
    _, streams, config = streams_of("", "pilot", 3, 100.0, drawn)
    found = rates_and_attitude.agreed(streams, config)
    np.testing.assert_array_equal(found.streams.orientation, streams.orientation)
    taken = np.mean(streams.nu[:, 5] - found.streams.nu[:, 5])
    assert taken == pytest.approx(bias, abs=3e-4) and not found.may_drift


def test_a_position_is_reckoned_along_the_right_heading():
    """One that drifts is found without it, and then it is that of the heading set right."""
    sea = {"heading_drift": 0.01, "dead_reckoned": True}
    _, streams, config = streams_of("", "pilot", 0, 90.0, lambda *_: sea)
    found = rates_and_attitude.agreed(streams, config)
    assert "drifts" in found.streams.notes[-1] and not found.may_drift
    assert not streams.has_pose and not found.streams.has_pose
    assert "heading_offset" not in sensors_of(found.streams, config)[0]
    late = {"velocity_latency": {"delay": 0.1}}  # it stays the sum of what was recorded
    assert "pose" not in [c.name for c in sensor_consistency.comparisons(streams, config, late)]


@pytest.mark.study
def test_nothing_is_sure_where_position_and_thrust_contradict_each_other():
    """The position is reckoned along the heading that drifts, and shows it to be right."""
    sea = {"heading_drift": 0.01, "dead_reckoned": True}
    _, streams, config = streams_of("", "pilot", 0, 150.0, lambda *_: sea)
    streams = dataclasses.replace(streams, posed=~streams.posed, is_reckoned=False)
    findings = explain([streams], config).findings
    assert "or the heading drifts" in " ".join(findings.notes)
    assert not any(f.separable for f in findings.effects)


def test_rates_that_agree_with_the_attitude_are_left_alone():
    config = a_configuration()

    def agreed(streams):
        return rates_and_attitude.agreed(streams, config).streams

    streams, _ = turning()
    assert agreed(streams).nu is streams.nu
    early, _ = turning(late=-0.1)  # it is the attitude that is late
    np.testing.assert_array_equal(agreed(early).nu, early.nu)
    none = dataclasses.replace(
        turning((0.02, 0.0, 0.0))[0], orientation=np.tile([1.0, 0.0, 0.0, 0.0], (1200, 1))
    )
    assert agreed(none) is none
    short = turning((0.02, 0.0, 0.0), seconds=20.0)[0]
    assert agreed(short) is short
    seldom = turning((0.02, 0.0, 0.0))[0]
    seldom = dataclasses.replace(
        seldom, t=seldom.t[::20], orientation=seldom.orientation[::20], nu=seldom.nu[::20]
    )
    assert agreed(seldom) is seldom


@pytest.mark.parametrize("late", [0.0, 0.2])
def test_rates_in_the_plane_are_those_of_the_heading(late):
    """A record of a ship holds zeros for roll and pitch, whose noise is none of the heading's: of a
    measured one the yaw rate was said to be 0.43 s late, and set right."""
    streams, true = turning()
    rng, t, rate = np.random.default_rng(4), streams.t, true[:, 2]
    heading = integral(t, rate[:, None])[:, 0] + rng.normal(0.0, 0.003, len(t))
    nu = np.zeros_like(streams.nu)
    nu[:, 5] = np.interp(t - late, t, rate) + rng.normal(0.0, 0.004, len(t))
    level = quaternion_from_euler(0.0, 0.0, heading)
    streams = inspected(dataclasses.replace(streams, orientation=level, nu=nu))
    notes = rates_and_attitude.agreed(streams, a_configuration()).streams.notes
    assert len(notes) == (late > 0.0)
    assert all("0.2 s late" in note for note in notes)


def test_a_position_that_is_reckoned_from_the_velocities_says_nothing_of_them():
    """It would show them to be late by half an interval of the odometry, whatever is right."""
    _, streams, config = streams_of("clean", "pilot", 0, 90.0)
    assert streams.has_pose
    sea = {"dead_reckoned": True}
    _, streams, config = streams_of("", "pilot", 0, 90.0, lambda *_: sea)
    assert not streams.has_pose
    assert "velocity_latency" not in sensors_of(streams, config)[0]
    # without any noise a position is not that sum but for what the rule of integration leaves out
    t = np.arange(0.0, 60.0, 0.05)
    v = np.stack([np.sin(0.7 * t), 0.4 * np.cos(1.1 * t), 0.0 * t], axis=1)
    way = np.stack([-np.cos(0.7 * t) / 0.7, 0.4 * np.sin(1.1 * t) / 1.1, 0.0 * t], axis=1)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    nu = np.hstack([v, np.zeros_like(v)])
    streams = dataclasses.replace(streams, t=t, position=way, orientation=level, nu=nu)
    assert inspected(streams).has_pose
    reckoned = dataclasses.replace(streams, position=np.cumsum(0.05 * v, axis=0))
    assert not inspected(reckoned).has_pose
    # nor has a sum over the usual period, whatever the stamps: late or early by milliseconds
    late = np.random.default_rng(0).uniform(0.0, 0.003, len(t))
    assert not inspected(dataclasses.replace(reckoned, t=t + late)).has_pose


def test_velocities_that_are_stated_to_be_useless_are_left_out():
    """A DVL that has lost the ground: whatever it says, beside a variance of 1 (m/s)2."""
    dive, streams, config = streams_of("clean", "pilot", 0, 60.0)

    def told(lost_variance):
        rng, messages = np.random.default_rng(0), []
        for role, m in at_sea.messages_of(dive, config):
            if role == ODOMETRY:
                lost = (m.stamp * 1e-9) % 10.0 < 1.0
                variance = lost_variance if lost else 64e-6
                off = rng.normal(0.0, np.sqrt(variance), 3) if lost else np.zeros(3)
                m = m._replace(linear=m.linear + off, twist_variance=np.full(6, variance))
            messages.append((role, m))
        return gather(messages, config)

    lost = told(1.0)
    (note,) = (note for note in lost.notes if "far worse than usual" in note)
    assert 100 < len(streams.t) - len(lost.t) < 130 and "(120)" in note
    assert np.isin(lost.nu, streams.nu).all()
    assert not any("far worse" in note for note in told(4 * 64e-6).notes)


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_a_position_that_is_held_between_fixes_is_no_pose(seed):
    """It would say that the vehicle rests, and jumps. Rounded, it is repeated at rest alone."""
    _, streams, _ = streams_of("clean", "pilot", seed, 90.0)
    fix = np.floor(streams.t * 1.0).astype(int)
    first = np.searchsorted(fix, np.unique(fix))
    held = streams.position[first][fix - fix[0]]
    held[:, 2] = streams.position[:, 2]  # depth has a sensor of its own
    assert not inspected(dataclasses.replace(streams, position=held)).has_pose
    for grid in (0.01, 0.1):
        rounded = np.round(streams.position / grid) * grid
        assert inspected(dataclasses.replace(streams, position=rounded)).has_pose


@pytest.mark.parametrize(
    ("delay", "told", "kept", "is_sure"),
    [(0.0, 0.05, False, True), (0.1, 0.1, True, True), (0.1, 0.16, True, False)],
)
def test_late_velocities_are_as_late_as_the_pose_says(delay, told, kept, is_sure):
    """An attitude that wanders made 0.05 s of none for the IMU, where the vehicle hardly turns."""
    _, streams, config = streams_of("late", "pilot", 0, 80.0, lambda *_: {"velocity_delay": delay})
    spans = split(streams.duration)
    data = sensor_choice.Data(streams, spans[0], streams, spans[1], config)
    of_imu = sensor_choice.Choice(
        {"velocity_latency": {"delay": told}}, {("velocity_latency", "delay"): 0.002}
    )
    choice = sensor_choice._with_delay_of_the_pose(data, of_imu)
    assert ("velocity_latency" in choice.sensors) == kept
    assert ("velocity_latency" not in choice.unsure) == is_sure


def test_what_is_found_beside_a_refuted_correction_is_not_sure():
    """What made the sensors disagree is there all the same, and may have made the other."""
    _, streams, config = streams_of("late", "pilot", 0, 80.0, lambda *_: {"velocity_delay": 0.1})
    spans = split(streams.duration)
    data = sensor_choice.Data(streams, spans[0], streams, spans[1], config)
    choice = data.fitted(["velocity_latency", "sensor_lever_arm"], frozenset())
    lever = choice.sensors["sensor_lever_arm"]
    wrong = {**choice.sensors, "sensor_lever_arm": {**lever, "z": lever["z"] + 0.5}}
    left = sensor_choice._without_refuted(data, dataclasses.replace(choice, sensors=wrong))
    assert left.sensors.keys() == {"velocity_latency"} == left.unsure


@pytest.mark.parametrize("seed", [0, *more(*range(1, 8))])
def test_a_pause_of_one_sensor_is_no_bias_of_the_other(seed):
    """The attitude in a pause was interpolated, and what gravity is off by it passed for one."""
    _, streams, config = streams_of("clean", "six-axis", seed, 90.0)
    draw = np.random.default_rng(seed)
    begins, lasts = draw.uniform(10.0, 80.0, 4), draw.uniform(1.0, 7.0, 4)
    for clock, *others in (
        ("t", "position", "orientation", "nu", "posed"),
        ("imu_t", "gyro", "specific_force"),
    ):
        t = getattr(streams, clock)
        since = t[:, None] - begins
        there = ~((since > 0.0) & (since < lasts)).any(axis=1)
        paused = {name: getattr(streams, name)[there] for name in (clock, *others)}
        with_pauses = dataclasses.replace(streams, **paused)
        assert "imu_bias" not in sensors_of(with_pauses, config)[0], clock
        assert clock_errors.of([with_pauses], config) == clock_errors.ClockErrors(0.0, 0.0), clock


def test_without_pose_and_imu_no_sensor_is_judged():
    streams, _ = turning()
    assert sensors_of(streams, a_configuration())[0] == {}


# ------------------------------------------------------------------ clocks


def sensors_of(streams, config):
    return sensor_consistency.search(streams, config, split(streams.duration)[0])


@pytest.mark.parametrize("driving", ["pilot", *more("six-axis")])
@pytest.mark.parametrize("seed", [0, *more(1, 2, 3)])
def test_clocks_that_are_off_make_nothing_sure(driving, seed):
    _, streams, config = streams_of("clean", driving, seed, 80.0)
    assert clock_errors.of([streams], config) == clock_errors.ClockErrors(0.0, 0.0)
    gain = Gain("u", 1.0, 0.5, 50.0, 40.0, 60.0)
    drag, lag, turned = (
        Finding(name, ("X",), {}, None, gain, True, None, (), "")
        for name in ("quadratic_damping", "thruster_lag", "sensor_misalignment")
    )
    by = np.random.default_rng(seed).uniform(0.025, 0.06)
    wrench = dataclasses.replace(streams, demand_t=streams.demand_t + by)
    clocks = clock_errors.of([streams, wrench], config)
    assert clocks.ahead == pytest.approx(by, abs=0.01) and not clocks.behind
    assert [clocks.beside(f).separable for f in (drag, lag, turned)] == [False, False, True]
    assert "ahead of the wrench" in clocks.notes[0]
    since = streams.t - by
    attitude = orientation_at(streams, since)
    rates = interpolated(streams.t, streams.nu[:, 3:], since)
    nu = np.hstack([streams.nu[:, :3], rates])
    late = dataclasses.replace(streams, orientation=attitude, nu=nu)
    clocks = clock_errors.of([late], config)
    assert clocks.behind == pytest.approx(by, rel=0.1) and not clocks.ahead
    assert [clocks.beside(f).separable for f in (drag, lag, turned)] == [True, False, True]
    assert "behind the IMU" in clocks.notes[0]
    assert velocity_sensor.tests_of(late, config) == []  # no factor of the velocities
    assert [t.passed for t in velocity_sensor.tests_of(streams, config)] == [True, True]
    # by a position that is the sum of those velocities, only one above one is
    for factor, passes in ((1.0, True), (0.9, True), (1.1, False)):
        scaled = streams.nu * np.repeat([factor, 1.0], 3)
        to_world = quaternion_to_matrix(streams.orientation)
        way = integral(streams.t, np.einsum("kij,kj->ki", to_world, scaled[:, :3]))
        reckoned = inspected(dataclasses.replace(streams, nu=scaled, position=way))
        tests = {test.name: test.passed for test in velocity_sensor.tests_of(reckoned, config)}
        assert tests["velocity sensor: velocity_scale"] is passes, factor
    quiet = streams.nu * np.repeat([0.03, 1.0], 3)  # near the noise, which makes a factor too small
    still = dataclasses.replace(streams, nu=quiet, position=0.03 * streams.position)
    lively, limit = (velocity_sensor.tests_of(s, config)[0].limit for s in (streams, still))
    assert lively < 0.06 and limit > 0.2


@pytest.mark.parametrize("driving", ["pilot", *more("six-axis")])
@pytest.mark.parametrize("seed", [0, *more(1, 2, 3)])
def test_commands_that_were_not_recorded(driving, seed):
    """A controller at 50 Hz, of whose commands one in five is published: what is held is late."""
    _, streams, config = streams_of("clean", driving, seed, 80.0)
    (test,) = delays.tests_of(streams, config, late=True)
    assert test.passed
    tenth = slice(int(np.random.default_rng(seed).integers(5)), None, 5)
    thinned = dataclasses.replace(
        streams, demand_t=streams.demand_t[tenth], demand=streams.demand[tenth]
    )
    (test,) = delays.tests_of(thinned, config, late=True)
    assert not test.passed and test.value == pytest.approx(0.04, abs=0.01)


@pytest.mark.parametrize("seed", [0, *more(1, 2, 3)])
def test_lone_velocities_that_jump_are_left_out(seed):
    dive = dive_of("clean", "pilot", seed, 60.0)
    config = configuration.from_parameters(dive.parameters)
    messages = at_sea.messages_of(dive, config)
    before = gather(messages, config)
    assert not any("jumps there" in note for note in before.notes)
    draw = np.random.default_rng(seed)
    odometry = [i for i, (role, _) in enumerate(messages) if role == ODOMETRY]
    false = sorted(draw.choice(odometry[5:-5:4], 8, replace=False).tolist())
    for i in false:
        role, message = messages[i]
        wrong = message.linear + draw.choice([-1.0, 1.0], 3) * draw.uniform(0.7, 1.5, 3)
        messages[i] = role, message._replace(linear=wrong)
    after = gather(messages, config)
    assert "left out: odom: velocity jumps there and back (8)" in after.notes
    assert len(after.t) == len(before.t) - 8


def test_a_clock_of_the_imu_is_no_latency_of_the_velocities(monkeypatch):
    _, streams, config = streams_of("clocks", "pilot", 0, 150.0)
    assert "velocity_latency" not in sensors_of(streams, config)[0]
    compared = sensor_consistency.comparisons

    def on_one_clock(*of):
        found = compared(*of)
        for comparison in found:
            comparison.columns[:, -1] = 0.0
        return found

    monkeypatch.setattr(sensor_consistency, "comparisons", on_one_clock)
    assert "velocity_latency" in sensors_of(streams, config)[0]


def test_no_delay_gains_by_averaging_the_noise_of_two_velocities():
    """Half way between two readings a velocity has half of the variance: a delay of half an
    interval seemed to make the sensors agree better by 31 %, whatever was right."""
    sea = {"dead_reckoned": True}
    _, streams, config = streams_of("", "pilot", 0, 90.0, lambda *_: sea)
    half = 0.5 * float(np.median(np.diff(streams.t)))
    late = {"velocity_latency": {"delay": half}}
    pair = [sensor_consistency.comparisons(streams, config, of) for of in ({}, late)]
    assert not is_practical(kinematic_gain(pair, split(streams.duration)[1]))


def test_thrust_steps_within_an_interval_of_the_imu():
    """Further off it stood for thrust that follows the noise of the velocities, and these seemed
    late by 31 ms and too small by 5 %."""
    _, streams, _ = streams_of("clean", "pilot", 0, 60.0)
    rows = sensor_consistency._rows([], [], streams)
    linear = sensor_consistency._linear(rows)
    held = linear.index(sensor_consistency.TIMING[:3])
    std = np.diag(linear.normal)[held] ** -0.5
    np.testing.assert_allclose(std, np.median(np.diff(streams.imu_t)) / np.sqrt(12.0))
    assert np.count_nonzero(linear.normal) == len(held)


@pytest.mark.parametrize("driving", ["axis by axis", *more("slow pilot")])
def test_late_velocities_show_in_a_few_reversals(driving):
    """What the latency itself leaves of the sensors' agreement is not held against it."""
    dive, streams, config = streams_of("late velocities", driving, 0, 150.0)
    found, std = sensors_of(streams, config)
    delay = found["velocity_latency"]["delay"]
    assert abs(delay - dive.sea.velocity_delay) < 4.0 * std["velocity_latency", "delay"]


# ------------------------------------------------------------------ noise of the reading


@pytest.mark.parametrize(
    ("case", "driving", "noisy"),
    [
        ("trim and biases", "axis by axis", False),
        *more(("trim", "axis by axis", False), ("trim", "slow pilot", False)),
        *more(("wrench noise", "pilot", True), ("wrench noise", "axis by axis", True)),
    ],
)
def test_commands_that_tremble_are_no_noise_of_the_reading(case, driving, noisy):
    """An autopilot passes on the noise of its gyro. Neglecting it would hide a trim."""
    _, streams, config = streams_of(case, driving, 0, 100.0, lean(CASES[case][0]))
    streams = rates_and_attitude.agreed(streams, config).streams
    there = Search(streams, config, split(streams.duration)[0])
    assert there.problem.reading_std[3:5].all()
    start = there.start()
    noise = noise_of_wrench(there, start)
    assert bool(noise.values) == noisy
    if driving != "axis by axis":  # roll and pitch have no stick, and an autopilot that is drowned
        assert noise.lost.tolist() == [noisy and axis in "KM" for axis in AXES]
    assert sensor_choice.may_be_noise(start, "XYZKMN") == noisy
    assert not sensor_choice.may_be_noise(start, "")


@pytest.mark.parametrize(
    ("case", "seed"),
    [
        ("wrench noise", 1), ("wrench noise that lasts", 0),
        *more(*(("wrench noise", seed) for seed in (0, 2, 3))),
        *more(*(("wrench noise that lasts", seed) for seed in (1, 2, 3))),
    ],
)  # fmt: skip
def test_nothing_is_said_about_axes_whose_wrench_is_lost_in_noise(case, seed):
    """What an autopilot asks for in roll and pitch was taken for noise, and what it did for a
    payload, drag across axes or a dead band. Noise that lasts for several readings was taken for
    commands, and the vehicle seemed to have dead bands and no thrust."""
    _, streams, config = streams_of(case, "pilot", seed, 150.0, CASES[case][0])
    findings = explain([streams], config).findings
    (found,) = findings.effects
    assert found.effect == "wrench_noise" and found.separable
    assert {"X", "Y", "N"} <= set(found.axes) <= set("XYZN")
    assert any("cannot be told from noise of its reading on K" in note for note in findings.notes)
    told = any("is the same for several readings: " in note for note in findings.notes)
    assert told == (case == "wrench noise that lasts")


def test_a_dead_band_is_not_sure_beside_noise_that_lasts():
    """How alike neighbouring readings are is known as one number only, and what is left of noise
    made a dead band of 1 N, surely, where they are alike for half a second."""
    _, streams, config = streams_of("clean", "pilot", 1, 30.0)
    lasting = dataclasses.replace(streams, noise_lasts=np.array([5, 1, 1, 1, 1, 1]))
    start = Search(lasting, config, split(streams.duration)[0]).start()
    assert sensor_choice.may_be_noise(start, "XZ")
    assert not sensor_choice.may_be_noise(start, "YZ")


def test_a_dive_whose_every_command_is_lost_in_noise_is_refused(monkeypatch):
    lost = sensor_choice.NoiseFound({}, np.ones(6, dtype=bool))
    monkeypatch.setattr(sensor_choice, "noise_of_wrench", lambda *_: lost)
    _, streams, config = streams_of("clean", "pilot", 1, 30.0)
    with pytest.raises(UserError, match="on any axis: record the commands without noise"):
        explain([streams], config)


def test_a_little_more_noise_moves_no_reading_across_the_threshold():
    """A finite difference across the jump made a hundred times the noise that there is."""
    _, streams, config = streams_of("wrench noise", "pilot", 1)
    problem = WindowedProblem(streams, split(streams.duration)[0])
    noise = Hypothesis(config, {}).effects | {
        "wrench_noise": {f"std_{a}": s for a, s in zip(AXES, problem.reading_std, strict=True)}
    }
    for effects in ({}, noise):
        added = problem.noisy_thrust(effects)
        assert (np.abs(added).max(axis=(0, 2)) < 6.0 * problem.reading_std).all()
        resting = problem.thrust(effects)[0] == 0.0
        assert resting[:, 3].any() == bool(effects)
        assert not added[resting].any()


# ------------------------------------------------------------------ accelerometer and attitude


def choice_of(sea, seed):
    """What is believed of the sensors of a pilot's dive."""
    _, streams, config = streams_of(str(sea), "pilot", seed, 80.0, lambda *_: sea)
    spans = split(streams.duration)
    return sensor_choice.chosen(sensor_choice.Data(streams, spans[0], streams, spans[1], config))


@pytest.mark.parametrize(
    ("sea", "sure"),
    [({"tilt": (0.03, -0.03)}, False), ({"accelerometer_bias": (0.06, -0.08, 0.05)}, True)],
    ids=["a tilted attitude", "a bias"],
)
def test_a_level_accelerometer_reads_a_bias_as_an_attitude_reads_a_tilt(sea, sure):
    """A bias far beyond what the configuration supposes of the IMU is not sure."""
    choice = choice_of(sea, 1)
    assert "imu_bias" in choice.sensors
    assert ("imu_bias" not in choice.unsure) == sure
    assert any("tilted" in note for note in choice.notes) != sure


@pytest.mark.parametrize("seed", [1, *more(2, 3, 4)])
@pytest.mark.parametrize("size", [*more(0.008), 0.02])
def test_a_pose_that_is_tilted_is_no_velocity_sensor_that_is_turned(size, seed):
    rng = np.random.default_rng(seed)
    tilt = size * rng.choice([-1.0, 1.0], 2) * rng.uniform(0.7, 1.0, 2)
    choice = choice_of({"tilt": tuple(tilt), "wander": 0.002}, seed)
    assert "sensor_misalignment" not in choice.sensors.keys() - choice.unsure
    assert choice.sensors.keys() <= {"imu_bias", *choice.unsure}


@pytest.mark.parametrize("seed", [1, *more(2, 3, 4)])
def test_a_velocity_sensor_that_is_turned_is_no_pose_that_is_tilted(seed):
    rng = np.random.default_rng(seed)
    angles = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.05, 0.1, 3)
    choice = choice_of({"velocity_turned": tuple(angles)}, seed)
    assert choice.sensors.keys() == {"sensor_misalignment"} and not choice.unsure
    for name, true in zip(("roll", "pitch", "yaw"), angles, strict=True):
        key = "sensor_misalignment", name
        assert abs(choice.sensors[key[0]][name] - true) < 3.5 * choice.std[key] + 0.5 * 0.1**2


# ------------------------------------------------------------------ thrust


@pytest.fixture(scope="module")
def begun():
    _, streams, config = streams_of("clean", "pilot", 1)
    there = Search(streams, config, split(streams.duration)[0])
    return there, there.start()


def test_noise_has_not_made_more_than_there_is(begun):
    """A model that nearly tumbles makes any amount of noise, and would win by what is taken off."""
    there, start = begun
    for std, some in ((0.01, True), (1e3, False)):
        problem = copy.copy(there.problem)
        problem.reading_std = np.full(6, std)
        problem._forget()
        starts = start.linearisation.starts
        fitted = Fitted(
            start.hypothesis, linearise(problem, start.hypothesis, starts, start.noise), True
        )
        assert bool(fitted.noise_squares.any()) == some
        assert 0.0 < fitted.squares <= fitted.rss


def test_a_rival_begins_where_its_last_fit_has_ended(begun):
    there, start = begun
    current = dict.fromkeys([("ocean_current", n) for n in ("north", "east", "down")], 0.2)
    lag = {("thruster_lag", "time_constant"): 0.3}
    candidates = [Candidate(k[0], v, 9.0, 9.0) for v in (current, lag) for k in list(v)[:1]]
    steps, squares = [], []
    for _ in range(2):
        before = there.problem.work
        squares.append(
            {tuple(f.hypothesis.keys): f.squares for f in there.fit_best(start, candidates)}
        )
        steps.append(there.problem.work - before)
    assert squares[0].keys() == squares[1].keys()
    for keys, value in squares[0].items():
        assert squares[1][keys] < value + 1e-4 * start.linear.count
    assert steps[1] < 0.7 * steps[0]


def test_a_thrust_scale_is_tried_whatever_its_score(begun, monkeypatch):
    there, start = begun
    likelier = [Candidate(f"effect {i}", {}, 100.0 - i, 100.0 - i) for i in range(9)]
    candidates = [*likelier, Candidate("thrust_scale", {}, -5.0, 1.0)]
    tried = []

    def fit_candidate(now, candidate, from_file=False):
        tried.append(candidate.name)

    monkeypatch.setattr(there, "_fit_candidate", fit_candidate)
    there.fit_best(start, candidates)
    assert "thrust_scale" in tried and "effect 8" not in tried


def test_thrust_of_other_axes_is_a_rival_of_drag_and_of_thrust(begun, monkeypatch):
    there, start = begun
    monkeypatch.setattr(there.patterns, "interplay", lambda rest: rest)
    for name in ("oblique_damping", "crossflow", "tether_drag", "thruster_deadband"):
        assert INTERPLAY_NAME in there._patterns_for(start, name)
    for name in ("quadratic_damping", "velocity_scale", "thrust_advance"):
        assert INTERPLAY_NAME not in there._patterns_for(start, name)
    assert search.INTERPLAY is patterns.INTERPLAY


@pytest.mark.parametrize(
    "driving, seed",
    [("six-axis", 4), *more(("six-axis", 3), ("six-axis", 6), ("pilot", 3), ("pilot", 4))],
)
def test_thrust_that_falls_short_of_large_commands_does_not_fall_with_speed(driving, seed):
    """Another bend than that of the library's effect: fast is where thrust is large."""
    _, streams, config = streams_of("clean", driving, seed, 100.0, lean())
    given = np.linspace(0.0, 6.0, 60_001)  # of 60 N and 12 N m
    gets = given * (1.0 - 0.3 * np.minimum(given, 1.2))
    largest = np.repeat([60.0, 12.0], 3)
    acts = streams.demand / largest
    read = np.sign(acts) * np.interp(np.abs(acts), gets, given) * largest
    findings = explain([dataclasses.replace(streams, demand=read)], config).findings
    sure = {f.effect: f.parameters for f in findings.effects if f.separable}
    assert set(sure) <= {"thrust_curve"}
    assert driving == "pilot" or all(
        0.2 < value.value < 0.5 for value in sure["thrust_curve"].values()
    )


@pytest.mark.study
def test_drag_that_thrusters_make_is_not_sure():
    """One at an angle loses thrust with the speed along it, for whichever axis it works."""
    _, streams, config = streams_of("advance", "six-axis", 0, 150.0, lambda *_: {"advance": 0.27})
    found = {f.effect: f.separable for f in explain([streams], config).findings.effects}
    assert found.keys() & {"oblique_damping", "crossflow", "tether_drag", "coriolis"}
    assert not any(sure for name, sure in found.items() if name not in ("thrust_scale",))


@pytest.mark.study
def test_nothing_is_sure_beside_a_filter():
    """It takes more than a delay from quick motion."""
    _, streams, config = streams_of("smoothed odometry", "slow pilot", 0, 150.0)
    findings = explain([streams], config).findings
    assert {f.effect for f in findings.effects if f.separable} == {"velocity_latency"}
    assert any("filtered" in note for note in findings.notes)


@pytest.mark.study
def test_a_bias_of_the_gyro_is_named_and_nothing_else():
    dive, streams, config = streams_of("biases", "pilot", 0, 150.0)
    assert dive.sea.gyro_is_shared
    (found,) = explain([streams], config).findings.effects
    assert found.effect == "imu_bias" and found.separable
    for name, true in zip(("gx", "gy", "gz"), dive.sea.gyro_bias, strict=True):
        assert found.parameters[name].value == pytest.approx(true, abs=4e-4)
    assert at_sea.CASES["biases"]


@pytest.mark.parametrize("seed", [0, *more(1, 2, 3)])
def test_an_imu_elsewhere_is_no_velocity_sensor_elsewhere(seed):
    """Only the pose tells which of the two is not where the file has it: an IMU 0.25 m off passed
    for a velocity sensor 0.2 m off."""
    _, streams, config = streams_of("clean", "six-axis", seed)
    rng, spans = np.random.default_rng(seed), [(0.0, streams.duration)]
    arm = 0.25 * rng.choice([-1.0, 1.0], 3)
    turn = np.gradient(streams.gyro, streams.imu_t, axis=0)
    moved = streams.specific_force + acceleration_of_arm(streams.gyro, turn, arm)
    imu = dataclasses.replace(streams, specific_force=moved)
    found, std = sensor_consistency.search(imu, config, spans, ["sensor_lever_arm"])
    for name, value in found["sensor_lever_arm"].items():
        assert abs(value) < 3.5 * std["sensor_lever_arm", name] < 0.05
    nu = streams.nu.copy()
    nu[:, :3] += velocity_of_arm(nu[:, 3:], arm)
    log = dataclasses.replace(streams, nu=nu)
    found, std = sensor_consistency.search(log, config, spans)
    for name, value in zip("xyz", arm.tolist()):
        apart = abs(found["sensor_lever_arm"][name] - value)
        assert apart < 3.5 * std["sensor_lever_arm", name] < 0.05


def test_where_nothing_thrusts_no_thrust_depends_on_another():
    _, streams, config = streams_of("clean", "pilot", 0, 40.0)
    still = inspected(dataclasses.replace(streams, demand=np.zeros_like(streams.demand)))
    search = Search(still, config, split(still.duration)[0])
    assert search.patterns.interplay(search.start()) is None


@pytest.mark.parametrize("seed", [5, *more(0, 1, 2, 3, 4)])
def test_a_turned_velocity_sensor_in_a_current_is_no_heading_for_sure(seed):
    """Dynamics that know no current preferred a heading, which a current that is missing turns."""
    _, streams, config = streams_of("current", "pilot", seed, 90.0)
    rng, (fitted, held) = np.random.default_rng(seed), split(streams.duration)
    angles = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.03, 0.08, 3)
    r = quaternion_to_matrix(quaternion_from_euler(*angles))
    nu = np.hstack([streams.nu[:, :3] @ r, streams.nu[:, 3:]])
    turned = dataclasses.replace(streams, nu=nu, rates_std=np.full(3, 1e-4))
    choice = sensor_choice.chosen(sensor_choice.Data(turned, fitted, turned, held, config))
    named = [n for n in ("heading_offset",) if n in choice.sensors]
    assert all(choice.alternatives.get(n) or n in choice.unsure for n in named)
    assert {"heading_offset", "sensor_misalignment"} & choice.sensors.keys()


def held_by_an_autopilot(mass, seed, delay=0.0, seconds=150.0):
    """A level vehicle whose autopilot answers every measured velocity, noise and all; the error of
    its position is a random walk, which leaves the time of the velocities to the IMU."""
    rng, step, every, ago = np.random.default_rng(seed), 0.01, 10, round(delay / 0.01)
    gain, drag = rng.uniform(1.0, 2.0), rng.uniform(0.3, 1.5, 3)
    swing, w, phase = rng.uniform(0.2, 0.4, 3), rng.uniform(0.25, 0.8, 3), rng.uniform(0, 6, 3)
    v, v_dot, x, error = np.zeros((4, 3))
    motion, forces, commands, velocities = [], [], [], [v]
    for k in range(round(seconds / step)):
        if k % every == 0:
            error = error + 0.002 * rng.standard_normal(3)
            read = velocities[max(k - ago, 0)] + 0.003 * rng.standard_normal(3)
            motion.append([*(x + error), *read])
            angle = w * k * step + phase
            wanted, slope = swing * np.sin(angle), swing * w * np.cos(angle)
            commands.append(mass * (gain * (wanted - read) + slope + drag * wanted))
        before, v_dot = v_dot, commands[-1] / mass - drag * v
        force = 0.5 * (before + v_dot) - [0.0, 0.0, 9.81]  # it steps there
        forces.append(force + 0.03 * rng.standard_normal(3))
        x, v = x + step * v, v + step * v_dot
        velocities.append(v)
    motion, level = np.array(motion), np.tile([1.0, 0.0, 0.0, 0.0], (len(motion), 1))
    t, imu_t = every * step * np.arange(len(motion)), step * np.arange(len(forces))
    rates, gyro = (0.001 * rng.standard_normal((n, 3)) for n in (len(t), len(imu_t)))
    nu, demand = np.hstack([motion[:, 3:], rates]), np.pad(commands, ((0, 0), (0, 3)))
    none = np.zeros(0), np.zeros((0, 4))
    return Streams(t, motion[:, :3], level, nu, imu_t, gyro, np.array(forces), t, demand, *none)


@pytest.mark.parametrize("seed", [0, 1, 2, *more(3, 4, 5)])
def test_an_autopilot_that_answers_noise_does_not_make_velocities_late(heavy, seed):
    """Accelerations and thrust afterwards know of the noise: it had made 30 ms into 37 +- 5."""
    for delay in (0.0, 0.03, 0.1):
        streams = held_by_an_autopilot(heavy.model.body.mass, seed, delay)
        found, std = sensors_of(streams, heavy)
        assert found.keys() == ({"velocity_latency"} if delay else set())
        if delay:
            off = found["velocity_latency"]["delay"] - delay
            assert abs(off) < min(4.0 * std["velocity_latency", "delay"], 0.01), (delay, off, std)


def cruising(seed, delay=0.0, seconds=120.0):
    """A level vehicle that hardly accelerates, an accelerometer that is noisy beside that, and an
    attitude that wanders."""
    rng, step = np.random.default_rng(seed), 0.01
    imu_t = step * np.arange(round(seconds / step))
    t = imu_t[10::3]
    swing, w = rng.uniform(0.1, 0.3, (4, 3)), rng.uniform(0.05, 0.25, (4, 3))
    phase = rng.uniform(0.0, 6.0, (4, 3))

    def velocity(at, order=0):
        angle = w * at[:, None, None] + phase + 0.5 * np.pi * order
        return np.sum(swing * w**order * np.sin(angle), axis=1)

    kept = np.exp(-3.0 * step / 15.0)
    tilt = 0.002 * np.sqrt(1.0 - kept**2) * rng.standard_normal((len(t), 3))
    for k in range(1, len(t)):
        tilt[k] += kept * tilt[k - 1]
    attitude = np.column_stack([np.ones(len(t)), 0.5 * tilt])
    force = velocity(imu_t, 1) - [0.0, 0.0, 9.81] + 0.05 * rng.standard_normal((len(imu_t), 3))
    rates, gyro = (0.001 * rng.standard_normal((n, 3)) for n in (len(t), len(imu_t)))
    nu = np.hstack([velocity(t - delay) + 0.008 * rng.standard_normal((len(t), 3)), rates])
    place = velocity(t, -1) + 0.03 * rng.standard_normal((len(t), 3))
    demand, none = np.zeros((len(t), 6)), (np.zeros(0), np.zeros((0, 4)))
    return Streams(t, place, attitude, nu, imu_t, gyro, force, t, demand, *none)


@pytest.mark.parametrize("seed", [0, 1, 2, *more(3, 4, 5, 6, 7)])
def test_noise_of_an_accelerometer_does_not_make_velocities_late(heavy, seed):
    """A velocity that is dead-reckoned has the noise of the acceleration before it: another
    simulator's vehicle seemed 51 ms late, surely."""
    assert "velocity_latency" not in sensors_of(cruising(seed), heavy)[0]
    key = "velocity_latency", "delay"
    for delay in (0.0, 0.1):
        streams = cruising(seed, delay)
        spans = [(0.0, streams.duration)]
        found, std = sensor_consistency.search(streams, heavy, spans, [key[0], "imu_bias"])
        assert abs(found[key[0]][key[1]] - delay) < 3.0 * std[key]


def without_pose(case, *dive):
    """What is unsure of a choice of effects, of a dive of which no position was recorded."""
    _, streams, config = streams_of(case, *dive)
    streams = dataclasses.replace(streams, posed=np.zeros_like(streams.posed))
    spans, held = split(streams.duration)
    data = sensor_choice.Data(streams, spans, streams, held, config)
    return lambda found: (
        sensor_choice._without_refuted(data, sensor_choice.Choice(found, {})).unsure
    )


def test_what_only_the_imu_tells_is_not_sure():
    """Without a pose, velocities of three in 16 such dives seemed 8 to 12 % small, surely; in two
    of 24 they seemed turned."""
    unsure = without_pose("clean", "pilot", 0, 80.0)
    assert unsure({"velocity_scale": {"scale": 0.999}}) == {"velocity_scale"}
    turned = {"sensor_misalignment": {"roll": 0.0, "pitch": 0.0, "yaw": 5e-4}}
    assert unsure(turned) == {"sensor_misalignment"}
