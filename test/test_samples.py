"""From messages to samples: against the true motion, in any order, with any rubbish among them."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from textbook import with_section
from tiers import more

from rov_ident.core.frames import (
    FrameDefaults,
    from_core,
    quaternion_multiply,
    quaternion_to_matrix,
)
from rov_ident.core.messages import IMU, ODOMETRY, WRENCH, Imu, Odometry, Wrench
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.sampling.despiking import despike
from rov_ident.sampling.raw_streams import gather
from rov_ident.sampling.sample import SAMPLE, after_reset, joined
from rov_ident.sampling.sampler import Sampler
from rov_ident.sampling.validation import AHEAD, NEW_CLOCK, NEW_FRAME, describe
from rov_ident.simulation import virtual_sensors as sensors

SECOND = 1_000_000_000
NOISELESS = sensors.Suite().scaled(0.0)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def taken(config, messages):
    """All samples of (role, message) in this order, and the sampler."""
    sampler = Sampler(config)
    parts = [sampler.push(role, message) for role, message in messages]
    return joined([*parts, sampler.flush()]), sampler


def without_arrival(dive):
    return [(role, message) for _, role, message in dive.messages]


def clean(config, duration=6.0, seed=3, **suite):
    return sensors.dive(config, "steps", duration, dataclasses.replace(NOISELESS, **suite), seed)


def instants(dive, sampler, samples):
    """Places (k,) of the samples' instants among those of the truth."""
    t = samples["t"] + (sampler.origin - sensors.START) * 1e-9
    places = np.searchsorted(dive.truth.t, t - 1e-7)
    np.testing.assert_allclose(dive.truth.t[places], t, atol=2e-9)
    return places


def moments(t, demand, begin, end):
    """Mean and slope (6,) of a demand held from each of t to the next, over [begin, end]."""
    first = np.searchsorted(t, begin, side="right") - 1
    last = np.searchsorted(t, end, side="left")
    edges = np.concatenate([[begin], t[first + 1 : last], [end]])
    piece, length = demand[first:last], end - begin
    mean = np.diff(edges) @ piece / length
    # regression line: slope = integral of (s - middle) w ds / (length^3 / 12)
    away = edges - 0.5 * (begin + end)
    slope = 0.5 * np.diff(away**2) @ piece / (length**3 / 12.0)
    return mean, slope


# ------------------------------------------------------------------ truth


@pytest.mark.parametrize("rate", [10.0, 50.0])
def test_how_long_a_command_holds(heavy, rate):
    """As the messages come, of which a gap is no part."""
    dive = clean(heavy, wrench_rate=rate)
    begin = sensors.START + 3 * SECOND
    kept = [
        (role, m)
        for role, m in without_arrival(dive)
        if role != WRENCH or not begin < m.stamp < begin + 2 * SECOND
    ]
    for messages in (without_arrival(dive), kept):
        samples, _ = taken(heavy, messages)
        np.testing.assert_allclose(
            samples["hold"][samples["t"] > 2.0 / rate], 1.0 / rate, rtol=0.11
        )


@pytest.mark.parametrize(
    "odometry_rate, imu_rate, wrench_rate",
    [
        (5, 0, 50), (20, 0, 50), (50, 0, 5), (200, 0, 200), (500, 0, 50), (20, 50, 20),
        (5, 100, 50),
        (20, 100, 5), (20, 100, 200), (50, 100, 50), (100, 100, 50), (200, 50, 50), (20, 200, 50),
        (20, 500, 50), (500, 500, 200), (500, 50, 5),
    ],
)  # fmt: skip
def test_samples_are_the_truth(heavy, odometry_rate, imu_rate, wrench_rate):
    dive = clean(heavy, odometry_rate=odometry_rate, imu_rate=imu_rate, wrench_rate=wrench_rate)
    samples, sampler = taken(heavy, without_arrival(dive))
    # one instant for each message of the faster topic; before the first odometry there is no sample
    refused = {name: count for name, count in sampler.counts.items() if ":" in name}
    waiting = refused.pop("sample: no odometry yet", 0)
    assert refused == {}
    assert waiting <= imu_rate / odometry_rate
    fastest = 6 * max(imu_rate, odometry_rate)
    assert fastest <= len(samples) + waiting <= fastest + 1
    assert samples["restart"].sum() == 1 and samples["restart"][0]
    at = instants(dive, sampler, samples)

    # odometry alone passes as it came (single precision); with an IMU a step of the thrust between
    # two samples is integrated as a ramp: the thrust steps by 3 m/s2, 6 rad/s2 at most
    error = samples["nu"] - dive.truth.nu[at]
    step = 0.0 if imu_rate == 0 else 3.0 / imu_rate
    assert np.abs(error[:, :3]).max() < 1e-6 + 1.0 * step
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 1e-6 + 0.15 * step
    # a gyro measures what it measures; only the bias found from odometry may be off
    assert np.abs(error[:, 3:]).max() < (1e-6 if imu_rate == 0 else 6e-3)
    assert np.sqrt(np.mean(error[:, 3:] ** 2)) < (1e-6 if imu_rate == 0 else 1e-3)

    down = quaternion_to_matrix(dive.truth.orientation)[:, 2]
    assert np.abs(samples["down"] - down[at]).max() < 1e-6 + 0.1 * step
    np.testing.assert_allclose(np.linalg.norm(samples["down"], axis=1), 1.0, rtol=1e-9)
    slope = np.diff(samples["down"], axis=0) / samples["dt"][1:, None]
    turn = np.cross(samples["down"], samples["nu"][:, 3:])
    bend = (turn[:-1] - turn[1:]) / 6.0
    np.testing.assert_allclose(samples["down_slope"][1:], slope - bend, atol=1e-9)

    scale = np.abs(dive.demand).max(axis=0)
    for k in range(1, len(samples), 7):
        end = dive.truth.t[at[k]]
        mean, slope = moments(dive.truth.t, dive.demand, end - samples["dt"][k], end)
        np.testing.assert_allclose(samples["wrench"][k] / scale, mean / scale, atol=1e-6)
        allowed = 1e-5 / samples["dt"][k]
        np.testing.assert_allclose(samples["wrench_slope"][k] / scale, slope / scale, atol=allowed)


def test_the_same_measurements_one_by_one(heavy):
    """``odometry`` and ``gyro`` hold each measurement once; NaN where there is none."""
    dive = clean(heavy)
    samples, sampler = taken(heavy, without_arrival(dive))
    assert samples["measured"].sum() == pytest.approx(120, abs=2)
    has = np.isfinite(samples["odometry"][:, :3]).all(axis=1)
    assert np.array_equal(has, samples["measured"])
    assert np.isnan(samples["odometry"][:, 3:]).all(), "with a gyro the odometry's rate is not used"
    assert np.isfinite(samples["gyro"]).all()
    at = instants(dive, sampler, samples)
    assert np.abs(samples["odometry"][has, :3] - dive.truth.nu[at[has], :3]).max() < 0.03
    assert (samples["odometry_variance"] > 0).all() and (samples["gyro_variance"] > 0).all()
    alone, _ = taken(heavy, without_arrival(clean(heavy, imu_rate=0)))
    assert np.isfinite(alone["odometry"]).all() and np.isnan(alone["gyro"]).all()


def test_noise_is_not_enlarged_and_not_biased(heavy):
    dive = sensors.dive(heavy, "steps", 20.0, seed=4)
    samples, sampler = taken(heavy, without_arrival(dive))
    error = samples["nu"] - dive.truth.nu[instants(dive, sampler, samples)]
    error = error[100:]
    assert (error[:, :3].std(axis=0) < 0.009).all(), "no noisier than the odometry itself (0.008)"
    assert (error[:, 3:].std(axis=0) < 0.0035).all()
    assert (np.abs(error.mean(axis=0)) < [2e-3] * 3 + [1.5e-3] * 3).all()


def test_no_lag(heavy):
    """What is taken from one source is left of the other: the error is not the acceleration's."""
    dive = sensors.dive(heavy, "multisine", 20.0, seed=4)
    samples, sampler = taken(heavy, without_arrival(dive))
    at = instants(dive, sampler, samples)[100:]
    error = samples["nu"][100:] - dive.truth.nu[at]
    for axis in range(6):
        a = dive.truth.nu_dot[at, axis]
        lag = a @ error[:, axis] / (a @ a)
        assert abs(lag) < 4e-3, f"axis {axis} is {lag:.4f} s ahead"


# ------------------------------------------------------------------ mounting, bias


def test_lever_arms_and_mounting(heavy):
    mounted = with_section(heavy, "odometry", position=(0.3, -0.2, 0.1))
    mounted = with_section(mounted, "imu", position=(-0.15, 0.1, 0.2), rotation=(0.4, -0.3, 2.0))
    dive = clean(mounted)
    samples, sampler = taken(mounted, without_arrival(dive))
    error = samples["nu"] - dive.truth.nu[instants(dive, sampler, samples)]
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 0.01
    assert np.abs(error[:, 3:]).max() < 2e-3
    assert sampler.counts["odom: outlier, or marked as not measured"] == 0
    # and it matters: unaware of them the velocities are off
    ignorant, sampler = taken(heavy, without_arrival(dive))
    error = ignorant["nu"] - dive.truth.nu[instants(dive, sampler, ignorant)]
    assert np.sqrt(np.mean(error[:, :3] ** 2)) > 0.05


def test_lever_arm_without_an_imu(heavy):
    mounted = with_section(heavy, "odometry", position=(0.3, -0.2, 0.1))
    dive = clean(mounted, imu_rate=0)
    samples, sampler = taken(mounted, without_arrival(dive))
    error = samples["nu"] - dive.truth.nu[instants(dive, sampler, samples)]
    assert np.abs(error).max() < 1e-6


def test_rates_that_are_not_measured_do_not_turn_the_arm(heavy):
    """A velocity sensor knows its velocity alone: the gyro tells how its arm turns."""
    mounted = with_section(heavy, "odometry", position=(0.3, -0.2, 0.1))
    dive = clean(mounted)
    unknown = np.repeat([1e-6, 1e6], 3)
    messages = [
        (role, m._replace(angular=np.full(3, 7.0), twist_variance=unknown))
        if role == ODOMETRY
        else (role, m)
        for role, m in without_arrival(dive)
    ]
    samples, sampler = taken(mounted, messages)
    error = samples["nu"] - dive.truth.nu[instants(dive, sampler, samples)]
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 0.01
    constant = [
        (role, m._replace(angular=np.zeros(3)) if role == ODOMETRY else m) for role, m in messages
    ]
    streams = gather(constant, mounted)
    truth = dive.truth.nu[np.searchsorted(dive.truth.t - dive.truth.t[0], streams.t - 1e-7)]
    assert np.sqrt(np.mean((streams.nu - truth) ** 2, axis=0)).max() < 0.01
    assert not streams.guided.any()
    assert any("no angular rates" in note for note in streams.notes)
    still = gather([m for m in constant if m[0] != IMU], mounted)  # nobody knows how it turns
    assert list(still.guided) == [False] * 3 + [True] * 3


@pytest.mark.parametrize("rate", [5.0, 10.0])
def test_the_mean_of_gravity_over_an_interval_is_that_of_the_turn(heavy, rate):
    """Between two messages of a slow odometry the vehicle turns on. The mean of the two ends is off
    by their distance squared, and the righting moment with it."""
    dive = clean(heavy, 20.0, imu_rate=0.0, odometry_rate=rate)
    samples, sampler = taken(heavy, without_arrival(dive))
    at = instants(dive, sampler, samples)
    truth, t = quaternion_to_matrix(dive.truth.orientation)[:, 2], dive.truth.t
    parts = [slice(a, b + 1) for a, b in itertools.pairwise(at)]
    whole = np.array([np.trapezoid(truth[part], t[part], axis=0) for part in parts])
    exact = whole / samples["dt"][1:, None]
    ends = 0.5 * (truth[at[1:]] + truth[at[:-1]])
    mean = samples["down"] - 0.5 * samples["dt"][:, None] * samples["down_slope"]
    error = np.sqrt(np.mean((mean[1:] - exact) ** 2))
    assert error < 0.1 * np.sqrt(np.mean((ends - exact) ** 2))


def test_biases_are_found(heavy):
    dive = clean(heavy, 40.0, gyro_bias_std=0.01, accelerometer_bias_std=0.1)
    samples, sampler = taken(heavy, without_arrival(dive))
    error = samples["nu"] - dive.truth.nu[instants(dive, sampler, samples)]
    raw = [m.angular_velocity for _, role, m in dive.messages if role == IMU]
    late = samples["t"] > 20.0
    assert np.abs(error[late, 3:]).max() < 2e-3
    assert np.abs(error[late, :3].mean(axis=0)).max() < 5e-3
    assert len(raw) == len(samples) + sampler.counts["sample: no odometry yet"]


@pytest.mark.parametrize("rate", [20.0, *more(50.0)])
@pytest.mark.parametrize(("wander", "contradicts"), [(0.003, False), (0.04, True)])
def test_an_attitude_that_wanders_as_stated_contradicts_nothing(heavy, rate, wander, contradicts):
    """For a quarter of a minute at a time, of which a sum over a second knows a single value."""
    rng, last, turn = np.random.default_rng(5), 0.0, np.zeros(3)
    messages = []
    for _, role, m in clean(heavy, 90.0, odometry_rate=rate).messages:
        if role == ODOMETRY:
            kept = math.exp(-(m.stamp * 1e-9 - last) / 15.0)
            last = m.stamp * 1e-9
            turn = kept * turn + math.sqrt(1.0 - kept**2) * wander * rng.standard_normal(3)
            small = 0.5 * (turn + 0.001 * rng.standard_normal(3))
            m = m._replace(orientation=quaternion_multiply(m.orientation, np.array([1.0, *small])))
        messages.append((role, m))
    _, sampler = taken(heavy, messages)
    assert (sampler.kinematic_filter.contradictions["attitude"] > 9.0) == contradicts


def test_imu_drops_out_and_returns(heavy):
    dive = clean(heavy, 12.0)
    start = sensors.START
    messages = [
        (role, m)
        for role, m in without_arrival(dive)
        if role != IMU or not 4 * SECOND < m.stamp - start < 8 * SECOND
    ]
    samples, sampler = taken(heavy, messages)
    error = samples["nu"] - dive.truth.nu[instants(dive, sampler, samples)]
    assert np.abs(error).max() < 0.03
    assert samples["restart"].sum() == 1, "odometry bridges the gap"
    out = (samples["t"] > 4.2) & (samples["t"] < 7.8)
    assert np.diff(samples["t"][out]) == pytest.approx(0.05)
    assert np.isnan(samples["gyro"][out]).all() and np.isfinite(samples["odometry"][out]).all()
    assert np.isfinite(samples["gyro"][samples["t"] > 8.2]).all()
    assert sampler.counts["imu: gap, odometry alone"] == 1


def test_odometry_drops_out_and_returns(heavy):
    """Between, the IMU is integrated; nothing is invented as measured."""
    dive = clean(heavy, 12.0)
    messages = [
        (role, m)
        for role, m in without_arrival(dive)
        if role != ODOMETRY or not 4 * SECOND < m.stamp - sensors.START < 6 * SECOND
    ]
    samples, sampler = taken(heavy, messages)
    error = samples["nu"] - dive.truth.nu[instants(dive, sampler, samples)]
    assert np.abs(error).max() < 0.1
    out = (samples["t"] > 4.1) & (samples["t"] < 5.9)
    assert not samples["measured"][out].any()


@pytest.mark.parametrize("begins", [False, True])
def test_what_was_commanded_in_a_gap_of_the_odometry_acts_after_it(heavy, begins):
    """Thrusters have followed it meanwhile, whether the odometry pauses or has yet to begin: they
    had begun anew from the command before the gap."""
    effects = heavy.effects | {"thruster_lag": {"time_constant": 0.3}}
    sampler, late = Sampler(dataclasses.replace(heavy, effects=effects)), []
    (first, *_) = (m for role, m in without_arrival(clean(heavy, 1.0)) if role == ODOMETRY)
    for k in range(400):  # at 50 Hz; 40 N from 4 s on
        t = SECOND + k * 20_000_000
        push = np.array([40.0 if k >= 200 else 5.0, 0.0, 0.0])
        made = [sampler.push(WRENCH, Wrench(t, "base_link_frd", push, np.zeros(3)))]
        if k > 300 or (k < 150 and not begins):
            noise = np.random.default_rng(k).normal(0.0, 1e-3, 3)  # what repeats is not measured
            made.append(sampler.push(ODOMETRY, first._replace(stamp=t, linear=noise)))
        late += [wrench for part in made for wrench in part["wrench"].tolist()]
    after = [wrench[0] for wrench in late if wrench[0] > 5.1]
    assert len(after) > 90
    np.testing.assert_allclose(after, 40.0, rtol=0.01)


@pytest.mark.parametrize("silent", [0.8, 3.0])
def test_silent_wrench(heavy, silent):
    """Three demands later than the next one should have come there are no samples."""
    dive = clean(heavy, 8.0)
    begin, end = 3.0, 3.0 + silent
    messages = [
        (role, m)
        for role, m in without_arrival(dive)
        if role != WRENCH or not begin < (m.stamp - sensors.START) * 1e-9 < end
    ]
    samples, sampler = taken(heavy, messages)
    t = samples["t"] + (sampler.origin - sensors.START) * 1e-9
    period = 0.02
    assert ((t > begin) & (t < begin + 2.0 * period)).any()
    assert not ((t > begin + 3.0 * period) & (t < end)).any()
    assert sampler.counts["sample: no wrench"] > 20
    after = np.flatnonzero(t > end)
    assert samples["restart"][after[0]] and not samples["restart"][after[1:]].any()


def test_a_demand_that_seldom_comes(heavy):
    """It holds as long as such demands usually do, but not beyond the timeout."""
    dive = clean(heavy, 12.0)
    kept, last = [], -1.0
    for role, m in without_arrival(dive):
        at = (m.stamp - sensors.START) * 1e-9
        if role == WRENCH:
            if at - last < 0.4 or at > 8.0:
                continue
            last = at
        kept.append((role, m))
    samples, sampler = taken(heavy, kept)
    t = samples["t"] + (sampler.origin - sensors.START) * 1e-9
    assert ((t > 1.0) & (t < 8.0)).sum() > 0.99 * 7.0 * 100.0
    assert last + 0.9 < t.max() < last + 1.1


def test_demands_alone_are_not_hoarded(heavy):
    sampler = Sampler(heavy)
    for k in range(5000):
        sampler.push(WRENCH, Wrench(SECOND + k * 20_000_000, "", np.ones(3), np.ones(3)))
    assert len(sampler._queues[WRENCH]) <= 501


def test_no_wrench_at_all(heavy):
    dive = clean(heavy)
    samples, sampler = taken(heavy, [m for m in without_arrival(dive) if m[0] != WRENCH])
    assert len(samples) == 0
    assert "no wrench" in describe(sampler.counts)[0], describe(sampler.counts)


def test_no_odometry_at_all(heavy):
    dive = clean(heavy)
    samples, sampler = taken(heavy, [m for m in without_arrival(dive) if m[0] != ODOMETRY])
    assert len(samples) == 0
    assert any("no odometry" in line for line in describe(sampler.counts))


# ------------------------------------------------------------------ order


def interleaved(dive, lag, rng):
    """Another order of arrival: every topic in order, no message later than ``lag`` seconds."""
    messages = sorted((m.stamp, role, m) for _, role, m in dive.messages)
    newest: dict[str, float] = {}
    arrived = []
    for stamp, role, message in messages:
        arrival = max(stamp + 1e9 * lag * rng.random(), newest.get(role, 0.0))
        newest[role] = arrival
        arrived.append((arrival, role, message))
    arrived.sort(key=lambda m: m[0])
    return [(role, message) for _, role, message in arrived]


def same(a, b):
    """Bit for bit, NaN included, but not the padding between the fields."""
    return a.shape == b.shape and all(a[n].tobytes() == b[n].tobytes() for n in SAMPLE.names)


@pytest.mark.parametrize("rates", [(20, 100, 50), (50, 0, 20), (100, 50, 10), (20, 100, 5)])
def test_order_of_arrival_does_not_matter(heavy, rates):
    odometry_rate, imu_rate, wrench_rate = rates
    dive = clean(
        heavy, 4.0, odometry_rate=odometry_rate, imu_rate=imu_rate, wrench_rate=wrench_rate
    )
    reference, _ = taken(
        heavy, [m[1:] for m in sorted((m.stamp, r, m) for _, r, m in dive.messages)]
    )
    first = min(m.stamp for _, _, m in dive.messages)
    for seed in range(6):
        order = interleaved(dive, 0.9 * heavy.grace, np.random.default_rng(seed))
        # the clock's origin is the first message to arrive: here always the same one
        order.sort(key=lambda m: m[1].stamp != first)
        samples, sampler = taken(heavy, order)
        assert same(samples, reference), f"seed {seed}: {sampler.counts}"


def test_order_does_not_matter_with_drops(heavy):
    """Lost messages make the topics uneven, the samples are still the stamps' alone."""
    dive = sensors.dive(heavy, "steps", 6.0, sensors.Suite(drop=0.3, wrench_rate=5.0), 5)
    messages = sorted((m.stamp, r, m) for _, r, m in dive.messages)
    reference, _ = taken(heavy, [m[1:] for m in messages])
    for seed in range(4):
        order = interleaved(dive, 0.2 * heavy.grace, np.random.default_rng(seed))
        order.sort(key=lambda m: m[1].stamp != messages[0][0])
        samples, _ = taken(heavy, order)
        assert same(samples, reference)


def test_jitter_and_delay_of_the_simulated_sensors(heavy):
    """The simulator's own: arrival is put off, the stamps stay."""
    prompt = sensors.dive(heavy, "steps", 5.0, sensors.Suite(), 7)
    late = sensors.dive(heavy, "steps", 5.0, sensors.Suite(delay=0.05, jitter=0.03), 7)
    a, _ = taken(heavy, without_arrival(prompt))
    b, sampler = taken(heavy, without_arrival(late))
    # not the same first message, hence not the same origin
    assert len(a) == len(b) and not sampler.counts["odom: too late"]
    np.testing.assert_allclose(a["nu"], b["nu"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(a["wrench"], b["wrench"], rtol=1e-9, atol=1e-9)


def test_later_than_the_grace_is_counted(heavy):
    dive = clean(heavy, 6.0, delay=0.0)
    late = []
    for arrival, role, message in dive.messages:
        lag = 0.8 if role == ODOMETRY and message.stamp > sensors.START + 3 * SECOND else 0.0
        late.append((arrival + lag * 1e9, role, message))
    late.sort(key=lambda m: m[0])
    samples, sampler = taken(heavy, [m[1:] for m in late])
    first = sampler.counts["odom: too late"]
    assert 10 < first < 25  # then the sampler waits for as long as that
    assert np.isfinite(samples["nu"]).all()
    assert (np.diff(samples["t"]) > 0).all()


def test_messages_are_not_modified(heavy):
    dive = clean(heavy, 2.0)
    for _, _, message in dive.messages:
        for value in message:
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
    taken(heavy, without_arrival(dive))


def test_samples_stay_what_they_were(heavy):
    """A sample already given away does not change with later ones."""
    sampler = Sampler(heavy)
    given_away, copies = [], []
    for role, message in without_arrival(clean(heavy, 2.0)):
        samples = sampler.push(role, message)
        given_away.append(samples)
        copies.append(samples.copy())
    assert all(same(a, b) for a, b in zip(given_away, copies, strict=True))


# ------------------------------------------------------------------ effects


def test_attitude_with_its_heading(heavy):
    dive = clean(heavy)
    samples, sampler = taken(heavy, without_arrival(dive))
    true = dive.truth.orientation[instants(dive, sampler, samples)]
    same_turn = np.abs(np.sum(samples["orientation"] * true, axis=1))
    np.testing.assert_allclose(same_turn, 1.0, atol=1e-7)
    down = quaternion_to_matrix(samples["orientation"])[:, 2]
    np.testing.assert_allclose(samples["down"], down, atol=1e-12)


def test_surroundings_are_part_of_the_wrench_and_known_apart(heavy):
    """A force fixed in the world, in body axes at both ends of the interval."""
    force = np.array([3.0, -2.0, 1.0])
    effects = {"constant_force": dict(zip(("fx", "fy", "fz"), force.tolist()))}
    messages = without_arrival(clean(heavy))
    plain, _ = taken(heavy, messages)
    samples, _ = taken(dataclasses.replace(heavy, effects=effects), messages)
    pull = np.einsum("kij,i->kj", quaternion_to_matrix(samples["orientation"]), force)
    before = np.vstack([pull[:1], pull[:-1]])
    np.testing.assert_allclose(samples["surroundings"][:, :3], 0.5 * (pull + before), atol=1e-12)
    slope = (pull - before)[1:] / samples["dt"][1:, None]
    np.testing.assert_allclose(samples["surroundings_slope"][1:, :3], slope, atol=1e-9)
    for name in ("wrench", "wrench_slope"):
        part = samples[name.replace("wrench", "surroundings")]
        np.testing.assert_allclose(samples[name], plain[name] + part, atol=1e-12)
        assert np.abs(part).max() > 0.1
    assert not plain["surroundings"].any()


@pytest.mark.parametrize("imu_rate", [0.0, 100.0])
def test_velocities_are_through_the_water(heavy, imu_rate):
    water = np.array([0.3, -0.2, 0.1])
    effects = {"ocean_current": dict(zip(("north", "east", "down"), water.tolist()))}
    dive = clean(heavy, imu_rate=imu_rate, odometry_rate=50.0)
    messages = without_arrival(dive)
    plain, _ = taken(heavy, messages)
    samples, _ = taken(dataclasses.replace(heavy, effects=effects), messages)
    in_body = np.einsum("kij,i->kj", quaternion_to_matrix(samples["orientation"]), water)
    np.testing.assert_allclose(samples["water"], in_body, atol=1e-12)
    np.testing.assert_allclose(samples["nu"][:, :3] + in_body, plain["nu"][:, :3], atol=1e-12)
    measured = samples["measured"]
    for rows in (samples, plain):
        found = rows["odometry"][measured, :3] - rows["nu"][measured, :3]
        assert np.abs(found).max() < 0.02
    for name in ("wrench", "gyro", "down"):
        np.testing.assert_array_equal(samples[name], plain[name])
    assert samples["moving"][-1, :3].all()


def test_after_a_gap_surroundings_begin_anew(heavy):
    effects = {"payload": {"mass_wet": 1.0, "x": 0.0, "y": 0.0, "z": 0.0, "onset": 2.5}}
    config = dataclasses.replace(heavy, effects=effects)
    dive = clean(heavy)
    gap = [m for m in without_arrival(dive) if not 2.0 < m[1].stamp / SECOND - 1.0 < 3.5]
    samples, _ = taken(config, gap)
    after = samples["t"] > 3.0
    assert samples["restart"][after][0]
    weight = np.linalg.norm(samples["surroundings"][after, :3], axis=1)
    np.testing.assert_allclose(weight, 9.81, rtol=1e-2)
    assert not samples["surroundings"][~after].any()


# ------------------------------------------------------------------ axes


@pytest.mark.parametrize("body, world", [("flu", "enu"), ("frd", "enu"), ("flu", "ned")])
def test_axes_of_the_input_do_not_matter(heavy, body, world):
    """The same motion in ROS axes, by default or as the parameters say, gives the same samples."""
    dive = sensors.dive(heavy, "steps", 4.0, seed=9)
    reference, _ = taken(heavy, without_arrival(dive))
    told = dataclasses.replace(
        heavy, frames=dataclasses.replace(heavy.frames, body=body, world=world)
    )
    turned = []
    for role, message in without_arrival(dive):
        if isinstance(message, Odometry):
            message = message._replace(frame_id="odom", child_frame_id="base_link")
        else:
            message = message._replace(frame_id="base_link" if role == WRENCH else "imu_link")
        turned.append((role, from_core(message, FrameDefaults(body, world))))
    samples, _ = taken(told, turned)
    assert len(samples) == len(reference)
    for name in SAMPLE.names:
        np.testing.assert_allclose(samples[name], reference[name], rtol=0, atol=1e-9, err_msg=name)


def test_uneven_axes_of_the_topics(heavy):
    """FRD odometry beside a FLU wrench: each by its own frame id."""
    dive = sensors.dive(heavy, "steps", 3.0, seed=9)
    reference, _ = taken(heavy, without_arrival(dive))
    mixed = [
        (role, from_core(m._replace(frame_id="base_link")) if role == WRENCH else m)
        for role, m in without_arrival(dive)
    ]
    samples, _ = taken(heavy, mixed)
    np.testing.assert_allclose(samples["wrench"], reference["wrench"], atol=1e-12)


# ------------------------------------------------------------------ refusals


@pytest.mark.parametrize("role", [ODOMETRY, IMU, WRENCH])
@pytest.mark.parametrize("strays", [1, 5])
def test_the_first_message_does_not_decide_the_frame(heavy, role, strays):
    """Most do: some of another frame, first or in between, cost as many and no more."""
    dive = list(without_arrival(sensors.dive(heavy, "steps", 4.0, seed=9)))
    mine = [i for i, (of, _) in enumerate(dive) if of == role]

    def stray(message):
        name = "child_frame_id" if role == ODOMETRY else "frame_id"
        return message._replace(**{name: "another_flu"})

    for first in (0, 20):  # among the first of the topic, or once it is known
        chosen = set(mine[first : first + strays])
        mixed = [(of, stray(m) if i in chosen else m) for i, (of, m) in enumerate(dive)]
        _, sampler = taken(heavy, mixed)
        assert sampler.counts[NEW_FRAME] == (first == 0)
        assert sampler.counts[role] >= len(mine) - 2 * strays - 1


def test_another_frame_takes_over_however_long_the_first_was_heard(heavy):
    """A driver that comes back with another frame id after days is not refused for days."""
    sampler, refused = Sampler(heavy), 0
    for k in range(8000):
        frame = "base_link" if k < 5000 else "base_link_frd"
        sampler.push(WRENCH, Wrench(SECOND + k * 1_000_000, frame, np.ones(3), np.ones(3)))
        refused = sum(n for name, n in sampler.counts.items() if "frame changed" in name)
    assert 0 < refused < 2000
    assert sampler.validation.frame_id(WRENCH) == "base_link_frd"


def test_a_reset_takes_whatever_frame_comes(heavy):
    dive = list(without_arrival(sensors.dive(heavy, "steps", 4.0, seed=9)))
    online = OnlineEstimator(heavy, "rls")
    for i, (role, message) in enumerate(dive):
        if i == len(dive) // 2:
            online.reset()
        if role == IMU and i > len(dive) // 2:
            message = message._replace(frame_id="another_frd")
        online.push(role, message)
    assert online.counts[IMU] > 0.95 * sum(role == IMU for role, _ in dive)


def odometry(t=1.0, **changed):
    message = Odometry(
        round(t * SECOND), "odom", "base_link", np.zeros(3), LEVEL, np.zeros(3), np.zeros(3),
        np.zeros(6),
    )  # fmt: skip
    return message._replace(**changed)


def imu(t=1.0, **changed):
    message = Imu(
        round(t * SECOND), "imu_link", LEVEL, np.zeros(3), np.array([0.0, 0.0, 9.81]), np.zeros(3),
        np.zeros(3),
    )  # fmt: skip
    return message._replace(**changed)


def wrench(t=1.0, **changed):
    return Wrench(round(t * SECOND), "base_link", np.zeros(3), np.zeros(3))._replace(**changed)


def steady(begin, end, rate=20.0):
    """Still water, nothing moves: (role, message) of all topics."""
    for t in np.arange(begin, end, 1.0 / rate):
        yield WRENCH, wrench(t)
        yield ODOMETRY, odometry(t)
        yield IMU, imu(t)


BAD = [math.nan, math.inf, -math.inf, 1e300]
REFUSED = [
    *((ODOMETRY, odometry, {"linear": np.array([0.0, v, 0.0])}) for v in BAD),
    *((ODOMETRY, odometry, {"angular": np.array([v, 0.0, 0.0])}) for v in BAD),
    *((IMU, imu, {"angular_velocity": np.array([0.0, 0.0, v])}) for v in BAD),
    *((IMU, imu, {"linear_acceleration": np.array([0.0, 0.0, v])}) for v in BAD),
    *((WRENCH, wrench, {"force": np.array([v, 0.0, 0.0])}) for v in BAD),
    *((WRENCH, wrench, {"torque": np.array([0.0, v, 0.0])}) for v in BAD),
    (ODOMETRY, odometry, {"orientation": np.zeros(4)}),
    (ODOMETRY, odometry, {"orientation": np.full(4, math.nan)}),
    (ODOMETRY, odometry, {"orientation": np.array([1e300, 0.0, 0.0, 0.0])}),
    (ODOMETRY, odometry, {"orientation": np.array([0.1, 0.0, 0.0, 0.0])}),
    *((role, make, {"stamp": s}) for role, make in
      ((ODOMETRY, odometry), (IMU, imu), (WRENCH, wrench)) for s in (0, -1, 7 * 10**18)),
    (WRENCH, wrench, {"frame_id": "odom"}),
    (WRENCH, wrench, {"frame_id": "map_ned"}),
    (ODOMETRY, odometry, {"child_frame_id": "world"}),
    (IMU, imu, {"frame_id": "map"}),
    (WRENCH, wrench, {"frame_id": "base_link_frd"}),
    (ODOMETRY, odometry, {"frame_id": "map"}),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid")
@pytest.mark.parametrize("role, make, changed", REFUSED)
def test_a_bad_message_is_counted_and_changes_nothing(heavy, role, make, changed):
    before, after = list(steady(1.0, 2.0)), list(steady(2.0, 3.0))
    reference, _ = taken(heavy, before + after)
    samples, sampler = taken(heavy, [*before, (role, make(1.985)._replace(**changed)), *after])
    assert same(samples, reference)
    refused = {k: n for k, n in sampler.counts.items() if k.startswith(f"{role}: ")}
    assert list(refused.values()) == [1], sampler.counts
    (line,) = (line for line in describe(sampler.counts) if line.startswith(f"{role}: "))
    assert line.endswith("(1)")


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid")
@pytest.mark.parametrize("bad", [math.inf, math.nan, -1.0, 1e-320, 0.0])
def test_a_useless_variance_is_as_good_as_none(heavy, bad):
    """Drivers fill covariances with anything; the velocity beside it is still a velocity."""
    config = with_section(heavy, "odometry", linear_std=0.008, angular_std=0.004)
    dive = clean(heavy, 4.0)
    messages = [
        (role, m._replace(twist_variance=np.full(6, bad)) if role == ODOMETRY else m)
        for role, m in without_arrival(dive)
    ]
    samples, sampler = taken(config, messages)
    assert np.isfinite(samples["nu"]).all()
    assert np.isfinite(samples["odometry_variance"]).all()
    assert len(samples) > 350
    error = samples["nu"] - dive.truth.nu[instants(dive, sampler, samples)]
    assert np.abs(error).max() < 0.5


@pytest.mark.parametrize("role, make", [(ODOMETRY, odometry), (IMU, imu), (WRENCH, wrench)])
@pytest.mark.parametrize(
    "back, reason", [(0.0, "duplicate"), (0.02, "backward"), (0.9, "backward")]
)
def test_duplicate_and_backward_stamps(heavy, role, make, back, reason):
    before, after = list(steady(1.0, 2.0)), list(steady(2.0, 3.0))
    reference, _ = taken(heavy, before + after)
    again = make(before[-1][1].stamp / SECOND - back)
    samples, sampler = taken(heavy, [*before, (role, again), *after])
    assert same(samples, reference)
    assert sampler.counts[f"{role}: {reason} stamp"] == 1


@pytest.mark.parametrize("wild", [1, 3600 * SECOND, 2 * 10**18])
def test_single_wild_stamps_now_and_then(heavy, wild):
    """A driver that now and then says 1970: every time one message is lost, never the motion."""
    parts, messages = list(steady(100.0, 110.0)), []
    for k, pair in enumerate(parts):
        messages.append(pair)
        if k % 90 == 80:
            messages.append((ODOMETRY, odometry(stamp=wild)))
    samples, sampler = taken(heavy, messages)
    reference, _ = taken(heavy, parts)
    assert sampler.counts["odom: stamp jumps"] == sum(k % 90 == 80 for k in range(len(parts)))
    assert same(samples, reference)


@pytest.mark.parametrize("jump", [-8.0, 1000.0, -0.0])
def test_a_bag_that_starts_over(heavy, jump):
    """Another clock: buffers begin anew, and samples go on after at most two lost messages."""
    first = list(steady(100.0, 110.0))
    begin = 100.0 if jump == 0.0 else 110.0 + jump
    samples, sampler = taken(heavy, first + list(steady(begin, begin + 10.0)))
    assert sampler.counts[AHEAD if jump > 0.0 else NEW_CLOCK] >= 1
    assert samples["restart"].sum() == 2
    assert len(samples) == pytest.approx(400, abs=6)
    assert np.isfinite(samples["nu"]).all()
    k = np.flatnonzero(samples["restart"])[1]
    assert (np.diff(samples["t"][:k]) > 0).all() and (np.diff(samples["t"][k:]) > 0).all()


@pytest.mark.parametrize("role", [ODOMETRY, IMU, WRENCH])
def test_a_topic_that_was_silent_goes_on(heavy, role):
    """For far longer than a clock may jump ahead: the other topics' stamps tell that none did."""
    messages = [
        (r, m) for r, m in steady(100.0, 150.0) if r != role or not 105.0 < m.stamp / SECOND < 140.0
    ]
    samples, sampler = taken(heavy, messages)
    assert not any("clock" in name or "stamp" in name for name in sampler.counts)
    assert sampler.counts[role] == sum(r == role for r, _ in messages)
    assert samples["t"][-1] > 49.9
    assert not any("clock" in note or "stamp" in note for note in gather(messages, heavy).notes)


@pytest.mark.parametrize("role", [ODOMETRY, IMU, WRENCH])
def test_a_topic_whose_clock_is_set_ahead_restarts(heavy, role):
    """Alone: no pause of this topic makes its stamps run ahead of the others'."""
    ahead = [
        (r, m._replace(stamp=m.stamp + 60 * SECOND) if r == role else m)
        for r, m in steady(110.0, 120.0)
    ]
    _, sampler = taken(heavy, [*steady(100.0, 110.0), *ahead])
    assert sampler.counts[AHEAD] == 1


@pytest.mark.parametrize("step", [0.3, 0.2, -0.15, -0.3, -0.8])
def test_a_clock_that_is_stepped(heavy, step):
    """The interval is not bridged, nor are messages refused until the old stamps are reached."""
    later = [
        (role, m._replace(stamp=m.stamp + round(step * SECOND)))
        for role, m in steady(110.0, 120.0, 50.0)
    ]
    samples, sampler = taken(heavy, [*steady(100.0, 110.0, 50.0), *later])
    what = "stepped ahead, or all topics silent, not bridged" if step > 0.0 else "jumps, buffers"
    assert sum(n for name, n in sampler.counts.items() if what in name) == 1
    k = np.flatnonzero(samples["restart"])
    assert len(k) == 2 and samples["dt"][k[1]] == 0.0
    assert samples["dt"].max() < 0.021
    assert len(samples) == pytest.approx(1000, abs=6)


@pytest.mark.parametrize("step", [-0.3, -3600.0])
def test_a_clock_that_is_set_back_gives_no_time_twice(heavy, step):
    """In the raw messages that `explain` searches: there is a pause instead."""
    later = [
        (role, m._replace(stamp=m.stamp + round(step * SECOND)))
        for role, m in steady(100_010.0, 100_020.0, 50.0)
    ]
    streams = gather([*steady(100_000.0, 100_010.0, 50.0), *later], heavy)
    for t in (streams.t, streams.imu_t, streams.demand_t):
        assert (np.diff(t) > 0.0).all()
    assert streams.duration == pytest.approx(80.0, abs=0.1)


def test_what_is_no_step_of_the_clock(heavy):
    """Odometry and IMU that are silent for 0.4 s beside commands; messages out of order."""
    messages = list(steady(100.0, 110.0, 50.0))
    silent = [(r, m) for r, m in messages if r == WRENCH or not 105.0 < m.stamp / SECOND < 105.4]
    samples, sampler = taken(heavy, silent)
    assert samples["restart"].sum() == 1 and samples["dt"].max() == pytest.approx(0.4, abs=0.021)
    reordered = list(messages)
    for k in range(300, 1200, 97):  # one comes a quarter of a second after its time
        reordered.insert(k + 39, reordered.pop(k))
    samples, sampler = taken(heavy, reordered)
    assert samples["restart"].sum() == 1
    assert not [name for name in sampler.counts if name.startswith("clock: ")]


def test_a_first_stamp_that_is_wild(heavy):
    """The very first message carries another clock: nothing after it suffers."""
    good = list(steady(100.0, 110.0))
    for wild in (1, 3600 * SECOND):
        samples, _ = taken(heavy, [(ODOMETRY, odometry(stamp=wild)), *good])
        assert len(samples) > 190
        assert samples["restart"].sum() <= 2
        np.testing.assert_allclose(samples["dt"][-100:], 0.05, rtol=1e-6)


def test_topics_on_different_clocks_are_told(heavy):
    """Wrench on boot time beside odometry on Unix time can never meet: said, nothing invented."""
    messages = []
    for role, m in steady(100.0, 104.0):
        messages.append((role, m if role == WRENCH else m._replace(stamp=m.stamp + 10**18)))
    samples, sampler = taken(heavy, messages)
    assert len(samples) == 0
    assert describe(sampler.counts)


def test_velocity_outliers_against_the_imu(heavy):
    """A Doppler log's wild ping between good ones."""
    dive = clean(heavy, 6.0)
    messages, wild = [], 0
    for k, (role, m) in enumerate(without_arrival(dive)):
        if role == ODOMETRY and k % 29 == 0 and m.stamp > sensors.START + 2 * SECOND:
            m = m._replace(linear=m.linear + 3.0)
            wild += 1
        messages.append((role, m))
    samples, sampler = taken(heavy, messages)
    assert wild > 2 and sampler.counts["odom: outlier, or marked as not measured"] == wild
    error = samples["nu"] - dive.truth.nu[instants(dive, sampler, samples)]
    assert np.abs(error).max() < 0.05


BEGUN_ANEW = "odom: contradicts the first, begun anew"


@pytest.mark.parametrize("wrong", [(0,), (1,), (0, 1), (0, 2)])
@pytest.mark.parametrize("field", ["linear", "orientation"])
def test_odometry_that_begins_with_outliers(heavy, field, wrong):
    """All begins anew until two messages agree, and what came before is told from the rest."""
    dive = clean(heavy, 3.0)
    rng, messages, count = np.random.default_rng([len(field), *wrong]), [], 0
    for role, m in without_arrival(dive):
        if role == ODOMETRY:
            if count in wrong:
                values = rng.choice([-1.0, 1.0], len(getattr(m, field)))
                values /= np.linalg.norm(values)
                m = m._replace(**{field: values})
            count += 1
        messages.append((role, m))
    samples, sampler = taken(heavy, messages)
    assert sampler.counts[BEGUN_ANEW] == samples["anew"].sum() > 0
    rest = after_reset(samples)
    assert not rest["anew"][1:].any() and rest["restart"][0] and rest["measured"][0]
    assert rest["t"][0] < samples["t"][0] + 0.2
    error = rest["nu"] - dive.truth.nu[instants(dive, sampler, rest)]
    assert np.abs(error).max() < 0.05


def test_odometry_that_never_agrees_is_used_all_the_same(heavy):
    """Far noisier than it is configured to be: nothing else is there to begin with."""
    dive = clean(heavy, 20.0)
    rng = np.random.default_rng(6)
    noisy = [
        (role, m._replace(linear=m.linear + rng.normal(0.0, 2.0, 3)) if role == ODOMETRY else m)
        for role, m in without_arrival(dive)
    ]
    samples, sampler = taken(heavy, noisy)
    assert 2 < sampler.counts[BEGUN_ANEW] <= 4
    assert not samples["anew"][samples["t"] > 0.5].any()
    assert samples["measured"][samples["t"] > 0.5].sum() > 10


def test_a_gap_does_not_undo_what_was_learnt(heavy):
    """Later on a wrong first message costs a moment of motion, no coefficients."""
    dive = clean(heavy, 6.0)
    begin = sensors.START + 3 * SECOND
    messages = [
        (role, m) for role, m in without_arrival(dive) if not begin < m.stamp < begin + SECOND
    ]
    after = next(i for i, (r, m) in enumerate(messages) if r == ODOMETRY and m.stamp > begin)
    messages[after] = (ODOMETRY, messages[after][1]._replace(linear=np.ones(3)))
    samples, sampler = taken(heavy, messages)
    assert samples["restart"].sum() == 2 and not samples["anew"].any()
    assert sampler.counts[BEGUN_ANEW] == 0


@pytest.mark.parametrize("rate", [5.0, 20.0, *more(10.0, 30.0, 50.0, 100.0)])
def test_a_slow_imu_is_believed(heavy, rate):
    """From one of its messages to the next a vehicle turns, and is back with the one after."""
    dive = sensors.dive(heavy, "steps", 60.0, sensors.Suite(imu_rate=rate), seed=7)
    _, sampler = taken(heavy, without_arrival(dive))
    assert sampler.counts["imu: outlier between its neighbours"] <= 0.003 * sampler.counts[IMU]


@pytest.mark.parametrize("rate, kept", [(100.0, False), (10.0, True)])
def test_two_rates_in_a_row_that_no_vehicle_has(heavy, rate, kept):
    """There and back within 30 ms; at a tenth of a second from one to the next it may be so."""
    dive = clean(heavy, 6.0, imu_rate=rate)
    messages, odd = without_arrival(dive), []
    places = [i for i, (role, _) in enumerate(messages) if role == IMU]
    for first in (len(places) // 2, len(places) // 3):
        for place in places[first : first + 2]:
            m = messages[place][1]
            rates = m.angular_velocity + [0.9, 0.0, 0.0]
            messages[place] = (IMU, m._replace(angular_velocity=rates))
            odd.append(m.stamp)
    samples, sampler = taken(heavy, messages)
    there = np.isin(np.rint(samples["t"] * 1e9).astype(int) + sampler.origin, odd)
    assert there.sum() == (4 if kept else 0)
    assert sampler.counts["imu: outlier between its neighbours"] == (0 if kept else 4)


def pushed(heavy, demands, rate=50.0):
    """Samples and sampler of a vehicle at rest under demands (N, 6) at this rate."""
    other = [(role, m) for role, m in steady(1.0, 1.0 + len(demands) / rate) if role != WRENCH]
    wrenches = [
        (WRENCH, Wrench(SECOND + round(k / rate * SECOND), "base_link_frd", d[:3], d[3:]))
        for k, d in enumerate(demands)
    ]
    return taken(heavy, sorted(other + wrenches, key=lambda m: m[1].stamp))


def steps(count):
    """Demands (count, 6) on all axes that step at times of their own; most are full."""
    k = np.arange(count)
    return np.stack([20.0 * (1 + i % 3) * (-1.0) ** (k // (37 + 5 * i)) for i in range(6)], axis=1)


LONE = "wrench: outlier between its neighbours"


@pytest.mark.parametrize("noise", [0.0, 0.03, 0.05])
def test_ordinary_demands_pass_as_they_came(heavy, noise):
    """Steps on all axes, and noise of some percent: next to nothing looks like an outlier."""
    rng = np.random.default_rng(1)
    demands = steps(2000)
    demands *= 1.0 + noise * rng.standard_normal(demands.shape)
    _, sampler = pushed(heavy, demands)
    assert sampler.counts[LONE] <= (0 if noise < 0.05 else 20)


def test_slow_pulses_are_meant(heavy):
    """A pilot's tap on the stick, a tenth of a second long, is no outlier."""
    demands = np.zeros((200, 6))
    demands[20::20, 0] = 20.0
    samples, sampler = pushed(heavy, demands, rate=10.0)
    assert sampler.counts[LONE] == 0
    assert samples["wrench"][:, 0].max() == pytest.approx(20.0)


@pytest.mark.parametrize(("push", "taken_for"), [(1.0, "meant"), (4.5, "an outlier")])
def test_a_lone_demand_while_nothing_is_demanded(heavy, push, taken_for):
    """While the vehicle coasts, a wrench that never acted has nothing to hide behind."""
    demands = np.zeros((200, 6))
    demands[100, 2] = push
    samples, sampler = pushed(heavy, demands)
    assert sampler.counts[LONE] == (taken_for == "an outlier")
    assert (samples["wrench"] != 0.0).any() == (taken_for == "meant")


def test_an_outlier_of_one_axis_keeps_no_step_of_another(heavy):
    """At the very message where all others step, one number is wild: only that one is mended."""
    demands = steps(400)
    demands[:, 5] = 1.0
    clean, _ = pushed(heavy, demands)
    k = 37 * 3  # here the first axis steps
    demands[[k, k + 100, k + 101], 5] = [40.0, -30.0, 25.0]  # and two in a row
    samples, sampler = pushed(heavy, demands)
    assert sampler.counts[LONE] == 3
    np.testing.assert_array_equal(samples["wrench"], clean["wrench"])
    assert samples["restart"].sum() == 1


@pytest.mark.parametrize("where", [-1, 0])
@pytest.mark.parametrize("value", [-60.0, 12.0])
def test_what_stands_at_a_step_is_in_doubt(heavy, where, value):
    """Whether the step was there or one message on cannot be told, nor whether it was on its way.

    The doubt covers the error, on that axis, for as long as the demand acts; nothing begins anew.
    """
    demands = np.zeros((400, 6))
    demands[200:, 0] = 20.0
    demands[:, 5] = 1.0
    clean, _ = pushed(heavy, demands)
    demands[200 + where, 0] = value
    samples, sampler = pushed(heavy, demands)
    assert sampler.counts[LONE] == (value == -60.0)
    assert samples["restart"].sum() == 1
    doubt, error = samples["wrench_doubt"], samples["wrench"] - clean["wrench"]
    begin = (200 + where) / 50.0
    acting = (samples["t"] > begin) & (samples["t"] - samples["dt"] < begin + 0.02)
    assert (doubt[:, 0] > 0.0).tolist() == acting.tolist()
    assert (error**2 <= 2.0 * doubt).all()
    assert not doubt[:, 1:].any()


def test_an_outlier_beside_a_level_that_is_held_exactly(heavy):
    """It says that the step to nothing came a message early, and the noise before hides it not."""
    rng = np.random.default_rng(8)
    demands = np.zeros((400, 6))
    demands[:200, 2] = 60.0 * (1.0 + 0.01 * rng.normal(size=200))
    clean, _ = pushed(heavy, demands)
    assert not clean["wrench_doubt"][clean["t"] > 0.1, 2].any()
    demands[199, 2] = 1.5
    samples, _ = pushed(heavy, demands)
    acting = (samples["t"] > 199 / 50.0) & (samples["t"] - samples["dt"] < 200 / 50.0)
    assert (samples["wrench_doubt"][:, 2] > 0.0)[samples["t"] > 0.1].sum() == acting.sum()
    assert ((samples["wrench"] - clean["wrench"]) ** 2 <= 2.0 * samples["wrench_doubt"]).all()


def test_the_first_of_a_demand_that_alternates_is_in_doubt(heavy):
    """It may as well be one of two outliers: it is left out, but nothing hangs on it."""
    demands = np.zeros((400, 6))
    demands[200::2, 2] = 37.0
    samples, sampler = pushed(heavy, demands)
    samples = samples[samples["t"] < 7.9]
    assert sampler.counts[LONE] == 1
    (k,) = np.flatnonzero(samples["wrench_doubt"][:, 2])
    assert samples["t"][k] - samples["dt"][k] <= 4.0 < samples["t"][k]
    assert samples["wrench_doubt"][k, 2] * samples["dt"][k] == pytest.approx(37.0**2 * 0.02)
    assert samples["wrench"][k + 1 :, 2].mean() == pytest.approx(37.0 / 2, rel=0.02)


def test_a_first_demand_is_in_doubt_unless_it_lasts(heavy):
    """Nothing tells whether it is an outlier; what it taught would stay."""
    demands = np.full((100, 6), 5.0)
    samples, _ = pushed(heavy, demands)
    assert not samples["wrench_doubt"].any()
    demands[0, 5] = 30.0
    samples, _ = pushed(heavy, demands)
    assert samples["wrench_doubt"][:2, 5].any()
    assert not samples["wrench_doubt"][2:].any()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("late", "time"), [("thruster_lag", "time_constant"), ("actuation_delay", "delay")]
)
def test_a_first_demand_may_come_at_rest(heavy, late, time, seed):
    """It counts as one that has acted for long. Of a vehicle whose thrusters stood still the noise
    covers what is wrong with that: its variance is the square of the impulse that was not there."""
    rng = np.random.default_rng(seed)
    config = dataclasses.replace(heavy, effects={late: {time: rng.uniform(0.05, 0.3)}})
    demands = np.zeros((250, 6))
    demands[100:, [0, 5]] = rng.uniform(5.0, 30.0, 2) * rng.choice([-1.0, 1.0], 2)
    from_rest, _ = pushed(config, demands)
    samples, _ = pushed(config, demands[100:])
    from_rest = from_rest[from_rest["t"] > 2.0 + 1e-9][: len(samples) - 1]
    samples = samples[1 : len(from_rest) + 1]
    dt, lasting = samples["dt"][:, None], np.maximum(0.02, samples["hold"])[:, None]
    impulse = np.sum(dt * (samples["wrench"] - from_rest["wrench"]), axis=0)
    variance = np.sum(dt * lasting * samples["wrench_doubt"], axis=0)
    assert np.abs(impulse[[0, 5]]).min() > 0.1
    np.testing.assert_allclose(np.sqrt(variance), np.abs(impulse), rtol=0.05)
    assert not samples["wrench_doubt"][samples["t"] > 2.0].any()  # it is forgotten


@pytest.mark.parametrize(
    "demand",
    [
        lambda t: 30.0 * np.sin(2.0 * t),
        lambda t: 30.0 * np.clip(np.abs((t % 8.0) - 4.0) - 2.0, -1.0, 1.0),
        lambda t: 30.0 * np.sign(np.sin(t)) * (1.0 - np.exp(-(t % np.pi) / 0.05)),
        lambda t: 30.0 * np.sign(np.sin(3.0 * t)),
    ],
    ids=["sine", "ramps", "approached", "steps"],
)
@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_what_controllers_demand_is_not_in_doubt(heavy, demand, noise):
    """Demands on their way have neighbours that are, too; of noise next to nothing stands out."""
    rng = np.random.default_rng(1)
    demands = np.zeros((3000, 6))
    demands[:, 1] = demand(np.arange(3000) / 50.0) * (1.0 + noise * rng.standard_normal(3000))
    samples, _ = pushed(heavy, demands)
    in_doubt = np.mean(samples["wrench_doubt"][2:, 1] > 0.0) / 2.5  # of the demands in a sample
    assert in_doubt <= (0.01 if noise else 0.0)


def test_a_gate_that_was_wrong_opens_again(heavy):
    """The velocity has jumped for good (a lost lock): refused, then believed."""
    messages = [
        (role, m._replace(linear=np.array([0.5, 0.0, 0.0])))
        if role == ODOMETRY and m.stamp > 5 * SECOND
        else (role, m)
        for role, m in steady(1.0, 30.0)
    ]
    samples, _ = taken(heavy, messages)
    assert samples["nu"][-1, 0] == pytest.approx(0.5, abs=0.05)


def textbook_despiking(x, floor, share, exact):
    """The rule of despiking.py for one number of all commands: values and variances."""
    x, raw, variance = list(x), list(x), [0.0] * len(x)
    usual = 0.0
    for k in range(2, len(x) - 2):
        before, came, after, last = x[k - 1], x[k], x[k + 1], x[k + 2]
        there, back = abs(came - before), abs(after - came)
        two_away = max(abs(last - came), abs(raw[k - 2] - came))
        spread = max(math.sqrt(usual), floor)
        near = 5.0 * max(spread, share * min(abs(before), abs(after)))
        nearest, both = min(there, back, two_away), 0.5 * (there**2 + back**2)
        returns = min(abs(after - before), abs(last - before)) <= near
        is_step = back <= abs(after - before)  # on its way to the new level, or overshooting it
        if nearest > near and (returns or not is_step):
            x[k] = before if returns else float(np.median([before, after, last]))
            alternates = abs(last - came) <= near
            variance[k] = both if not returns else there**2 if alternates else 0.0
            continue
        usual += 0.02 * (min(nearest, 5.0 * spread) ** 2 - usual)
        rises = (came - before) * (after - came) > 0.0
        moves = (max if rises else min)(abs(before - x[k - 2]), abs(last - after))
        near = max(5.0 * spread, 3.0 * moves)
        near = 5.0 * exact if back < near < there and after == last else near
        if min(nearest, abs(raw[k - 2] - came)) > near:
            variance[k] = both
    return np.array(x), np.array(variance)


@pytest.mark.parametrize("seed", range(5))
def test_despiking_is_the_rule_of_the_textbook(seed):
    """Steps with noise, and a tenth of all numbers wild, a few of them twice."""
    rng = np.random.default_rng(seed)
    x = steps(600) * (1.0 + 0.02 * rng.standard_normal((600, 6)))
    wild = rng.random(x.shape) < 0.1
    x[wild] = rng.uniform(-100.0, 100.0, wild.sum())
    x[300:310:2] = 7.0
    floor, exact, usual = np.linspace(0.05, 0.5, 6), np.full(6, 0.01), np.zeros(6)
    found, variance = x.copy(), np.zeros_like(x)
    past = np.array([x[0], x[1], x[0], x[1]])
    for k in range(2, len(x) - 2):
        despike(past, found[k], x[k + 1], x[k + 2], variance[k], usual, floor, 0.03, exact, 0, True)
    for i in range(6):
        values, doubt = textbook_despiking(x[:, i], floor[i], 0.03, exact[i])
        np.testing.assert_allclose(found[:, i], values, rtol=1e-12)
        np.testing.assert_allclose(variance[:, i], doubt, rtol=1e-12)
    right = np.abs(found - steps(600)) < 20.0
    assert np.mean(right[wild]) > 0.85, "most outliers are gone"
    assert np.mean(found[~wild] == x[~wild]) > 0.97, "and little else is changed"


def despiked(x, floor, rates, is_command):
    """Values and variances of one number x (n,) of all messages, and which were outliers."""
    found, variance = x.copy(), np.zeros(len(x))
    out = np.zeros(len(x), bool)
    past, usual = np.array([[x[0]], [x[1]], [x[0]], [x[1]]]), np.zeros(1)
    for k in range(2, len(x) - 2):
        out[k] = despike(
            past, found[k : k + 1], x[k + 1 : k + 2], x[k + 2 : k + 3], variance[k : k + 1], usual,
            np.array([floor]), 0.03 * is_command, np.array([0.01]), rates, is_command,
        )  # fmt: skip
    return found, variance, out


@pytest.mark.parametrize("seed", range(5))
def test_two_wrong_rates_in_a_turn(seed):
    """The vehicle turns on by more than the noise until the right rate comes again."""
    rng = np.random.default_rng(seed)
    right = np.sin(4.0 * np.arange(0.0, 20.0, 0.01)) + 0.003 * rng.standard_normal(2000)
    first = rng.choice(np.arange(60, 1990, 10), 40, replace=False)
    wrong = np.concatenate([first, first + 1])
    x = right.copy()
    x[wrong] += np.tile(rng.choice([-1.0, 1.0], 40) * rng.uniform(1.0, 2.0, 40), 2)
    x[first] += rng.uniform(-0.1, 0.1, 40)
    assert not despiked(right, 0.003, 1, False)[2].any()
    assert set(np.flatnonzero(despiked(x, 0.003, 1, False)[2])) == set(wrong)


def test_two_outliers_at_a_step_are_not_believed():
    """The one looks like its beginning, the other like the overshoot of a controller."""
    rng = np.random.default_rng(0)
    x = np.repeat([-38.5, 38.0], 100) + 0.4 * rng.standard_normal(200)
    assert not despiked(x, 0.25, 0, True)[1].any()
    x[99:101] = -18.7, 87.1
    found, variance, _ = despiked(x, 0.25, 0, True)
    assert found[100] != 87.1 or variance[100] > 50.0**2


FLOATS = st.floats(allow_nan=True, allow_infinity=True, width=64)
MILD = st.floats(-3.0, 3.0)
VECTOR = st.lists(st.one_of(MILD, MILD, FLOATS), min_size=3, max_size=3).map(np.array)
SIX = st.lists(st.one_of(MILD, FLOATS), min_size=6, max_size=6).map(np.array)
FOUR = st.one_of(
    st.just(LEVEL), st.lists(st.one_of(MILD, FLOATS), min_size=4, max_size=4).map(np.array)
)
STAMPS = st.one_of(
    st.integers(SECOND, 3 * SECOND), st.integers(SECOND, 3 * SECOND), st.integers(-(2**63), 2**63)
)
MESSAGES = st.lists(
    st.one_of(
        st.builds(
            lambda *a: (ODOMETRY, Odometry(*a)),
            STAMPS, st.just("odom"), st.just("base_link"), VECTOR, FOUR, VECTOR, VECTOR, SIX,
        ),
        st.builds(
            lambda *a: (IMU, Imu(*a)), STAMPS, st.just("imu"), FOUR, VECTOR, VECTOR, VECTOR, VECTOR
        ),
        st.builds(lambda *a: (WRENCH, Wrench(*a)), STAMPS, st.just("base_link"), VECTOR, VECTOR),
    ),
    max_size=25,
)  # fmt: skip


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid")
@settings(deadline=None, max_examples=200, derandomize=True)
@given(messages=MESSAGES, sort=st.booleans())
def test_nothing_raises_and_samples_are_finite(heavy, messages, sort):
    if sort:
        messages = sorted(messages, key=lambda m: m[1].stamp)
    rounds = [(role, m) for role, m in steady(1.0, 1.3)]
    samples, _ = taken(heavy, [*rounds, *messages])
    for name in ("t", "dt", "nu", "down", "down_slope", "wrench", "wrench_slope"):
        assert np.isfinite(samples[name]).all(), name
    assert np.isfinite(samples["odometry_variance"]).all()
    assert (samples["odometry_variance"] > 0).all()
    assert (samples["dt"][~samples["restart"]] > 0).all()
    # refused or not, a well-behaved stream goes on
    sampler_samples, _ = taken(heavy, [*messages, *steady(1000.0, 1002.0)])
    assert len(sampler_samples) > 20


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("moved", ["thrust_scale.scale", "thruster_lag.time_constant"])
def test_what_a_lag_holds_back_moves_with_the_parameters(heavy, moved, seed):
    """Thrust that still acts would be that of the parameters before: wrong for as long as the lag
    lasts, which taught that they have to move on. A scale is followed exactly, a lag to first
    order."""
    config = with_section(heavy, "wrench", scale_std=0.15, lag_std=0.2).with_nuisance
    rng = np.random.default_rng(seed)
    before = {"thrust_scale.scale": rng.uniform(0.7, 1.3), "thruster_lag.time_constant": 0.25}
    after = before | {moved: 1.1 * before[moved]}
    messages = without_arrival(clean(heavy, seed=seed))
    instant = sensors.START + rng.uniform(2.5, 4.5) * SECOND
    samplers = [Sampler(config) for _ in range(3)]
    moving = samplers[0]
    for sampler, values in zip(samplers, (before, after, before), strict=True):
        sampler.recentre(config.with_values(values))
    made = []
    for role, message in messages:
        if message.stamp >= instant and not made:
            moving.recentre(config.with_values(after))
        parts = [sampler.push(role, message) for sampler in samplers]
        if message.stamp >= instant and len(parts[0]):
            made.append([part[["wrench", "by_wrench", "about"]] for part in parts])
        if len(made) == 10:  # a tenth of a second
            break
    ours, wanted, stayed = (joined([parts[k] for parts in made]) for k in range(3))

    def off(samples):
        return np.linalg.norm(samples["wrench"] - wanted["wrench"])

    assert off(stayed) > 0.1
    assert off(ours) < (1e-9 if moved == "thrust_scale.scale" else 0.2) * off(stayed)
    np.testing.assert_array_equal(ours["about"], wanted["about"])


@pytest.mark.parametrize("seed", range(3))
def test_commands_that_wait_are_remembered_without_a_delay(heavy, seed):
    """An estimated delay that begins at none, or comes back from there, acts on past commands."""
    rng = np.random.default_rng(seed)
    config = dataclasses.replace(
        heavy,
        effects={"actuation_delay": {"delay": 0.0}},
        estimate_effects=(("actuation_delay", "delay"),),
    )
    delayed = config.with_values({"actuation_delay.delay": rng.uniform(0.02, 0.2)})
    messages = without_arrival(clean(heavy, seed=seed))
    instant = sensors.START + rng.uniform(2.5, 4.5) * SECOND
    moving, always, made = Sampler(config), Sampler(config), []
    always.recentre(delayed)
    for role, message in messages:
        if message.stamp >= instant and not made:
            moving.recentre(delayed)
        parts = [sampler.push(role, message) for sampler in (moving, always)]
        if message.stamp >= instant and len(parts[0]):
            made.append([part[["wrench", "by_wrench"]] for part in parts])
    ours, wanted = (joined([parts[k] for parts in made]) for k in range(2))
    np.testing.assert_allclose(ours["wrench"], wanted["wrench"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours["by_wrench"], wanted["by_wrench"], rtol=1e-9, atol=1e-6)
