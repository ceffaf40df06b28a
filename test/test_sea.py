"""The simulator of the study at sea, against physics, textbook matrices and the package; and what
the study makes of its lines."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from tiers import more

import rov_ident as ri
from bench.simulators import sea
from bench.simulators.sea import Sea, skew
from bench.studies import at_sea, explain_at_sea
from rov_ident import config as configuration
from rov_ident.effects import EFFECTS
from rov_ident.io.write_messages import write_messages

STILL = np.zeros(8)


def vehicle_of(seed, **changes):
    return replace(sea.draw_vehicle(np.random.default_rng(seed)), **changes)


def without_damping(vehicle):
    theta = {n: v if n.endswith("dot") else 0.0 for n, v in vehicle.theta.items()}
    return replace(vehicle, theta=theta)


def state_of(rng, nu=None):
    state = np.zeros(13)
    state[3:7] = rng.standard_normal(4)
    state[3:7] /= np.linalg.norm(state[3:7])
    state[7:] = rng.standard_normal(6) if nu is None else nu
    return state


def run(plant, state, seconds, thrust=STILL):
    for k in range(round(seconds / sea.STEP)):
        t = k * sea.STEP
        state = plant.step(t, state, plant.rates(t, state, thrust), thrust, thrust)
    return state


# ------------------------------------------------------------------ motion


@pytest.mark.parametrize("seed", range(4))
def test_without_damping_energy_is_kept(seed):
    vehicle = without_damping(vehicle_of(seed, cog=np.array([0.02, -0.01, 0.015])))
    plant = sea.Plant(vehicle, Sea())
    state = state_of(np.random.default_rng(seed + 100), [0.5, -0.4, 0.3, 0.8, -0.6, 1.0])
    before = plant.energy(state)
    kinetic = 0.5 * state[7:] @ (plant.rigid + plant.added) @ state[7:]
    # The method's error is of the order (h omega)^4: 1e-9 of what moves.
    assert plant.energy(run(plant, state, 5.0)) == pytest.approx(before, abs=1e-6 * kinetic)


@pytest.mark.parametrize("seed", range(4))
def test_damping_takes_energy_out_and_thrust_puts_its_power_in(seed):
    rng = np.random.default_rng(seed)
    plant = sea.Plant(vehicle_of(seed), Sea())
    state, thrust = state_of(rng), rng.uniform(-20.0, 20.0, 8)
    k1 = plant.rates(0.0, state, thrust)
    later = plant.step(0.0, state, k1, thrust, thrust)
    gained = (plant.energy(later) - plant.energy(state)) / sea.STEP
    nu = 0.5 * (state[7:] + later[7:])
    power = nu @ (sea.ALLOCATION @ thrust + (plant.linear + plant.square * np.abs(nu)) * nu)
    assert gained == pytest.approx(power, rel=1e-3, abs=1e-2)


def test_steady_speed_is_where_drag_is_the_thrust():
    """58 N of four thrusters against 13.7 u + 141 u |u|: 0.594626 m/s."""
    vehicle = vehicle_of(0, theta=sea.NOMINAL, buoyancy=13.5 * sea.GRAVITY, mass=13.5)
    thrust = np.array([58.0 / math.sqrt(8.0)] * 4 + [0.0] * 4)
    np.testing.assert_allclose(sea.ALLOCATION @ thrust, [58, 0, 0, 0, 0, 0], atol=1e-12)
    start = np.zeros(13)
    start[3] = 1.0
    end = run(sea.Plant(vehicle, Sea()), start, 8.0, thrust)
    by_hand = (-13.7 + math.sqrt(13.7**2 + 4 * 141 * 58)) / (2 * 141)
    assert end[7] == pytest.approx(by_hand, rel=1e-4)
    # falling by speed: 58 (1 - 0.2 u / sqrt 2): thrusters are at 45 degrees
    slower = run(sea.Plant(vehicle, Sea(advance=0.2)), start, 8.0, thrust)
    linear = 13.7 + 58 * 0.2 / math.sqrt(2.0)
    by_hand = (-linear + math.sqrt(linear**2 + 4 * 141 * 58)) / (2 * 141)
    assert slower[7] == pytest.approx(by_hand, rel=1e-4)


@pytest.mark.parametrize("angle", [0.1, -0.4])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_tilted_vehicle_is_righted(angle, axis):
    """About a horizontal axis -W z_B sin(angle): the centre of buoyancy is above."""
    vehicle = vehicle_of(3)
    state = np.zeros(13)
    state[3], state[4 + axis] = math.cos(0.5 * angle), math.sin(0.5 * angle)
    plant = sea.Plant(vehicle, Sea())
    moment = ((plant.rigid + plant.added) @ plant.rates(0.0, state, STILL)[7:])[3 + axis]
    expected = vehicle.buoyancy * vehicle.cob[2] * math.sin(angle)
    assert moment == pytest.approx(expected, rel=1e-12)
    assert moment * angle < 0.0


def test_a_lighter_vehicle_rises_and_weight_ahead_pitches_it_down():
    state = np.zeros(13)
    state[3] = 1.0
    rates = sea.Plant(vehicle_of(1), Sea(lift=5.0, cog=(0.005, 0.0, 0.0))).rates(0.0, state, STILL)
    assert rates[9] < 0.0 and rates[11] < 0.0


@pytest.mark.parametrize("seed", range(3))
def test_coriolis_forces_are_those_of_fossens_matrices(seed):
    """C_RB (3.60) and C_A (6.43) in a current that changes."""
    rng = np.random.default_rng(seed)
    vehicle = vehicle_of(seed, cog=rng.uniform(-0.03, 0.03, 3))
    unknown = Sea(current=(0.2, -0.1), current_swing=(0.05, 0.1), current_period=20.0)
    plant, state, t = sea.Plant(vehicle, unknown), state_of(rng), 3.0
    R = sea.rotations(state[None, 3:7])[0]
    nu, w = state[7:], state[10:]
    flow, gust = (np.array(x) for x in plant.water(t))
    relative = nu - np.concatenate([R.T @ flow, np.zeros(3)])
    change = np.concatenate([R.T @ gust - skew(w) @ R.T @ flow, np.zeros(3)])

    def coriolis(M, nu):
        one, two = (M @ nu)[:3], (M @ nu)[3:]
        zero = np.zeros((3, 3))
        return np.block([[zero, -skew(one)], [-skew(one), -skew(two)]])

    thrust = rng.uniform(-20.0, 20.0, 8)
    down, cog = R[2], vehicle.cog
    restoring = np.concatenate([
        (plant.weight - plant.buoyancy) * down,
        np.cross(cog, plant.weight * down) - np.cross(vehicle.cob, plant.buoyancy * down),
    ])  # fmt: skip
    nu_dot = plant.rates(t, state, thrust)[7:]
    left = plant.rigid @ nu_dot + coriolis(plant.rigid, nu) @ nu
    left += plant.added @ (nu_dot - change) + coriolis(plant.added, relative) @ relative
    drag = (plant.linear + plant.square * np.abs(relative)) * relative
    np.testing.assert_allclose(left, sea.ALLOCATION @ thrust + drag + restoring, atol=1e-10)


def test_what_is_carried_by_the_current_meets_no_drag():
    vehicle = vehicle_of(2)
    vehicle = replace(vehicle, buoyancy=vehicle.mass * sea.GRAVITY)
    state = np.zeros(13)
    state[3], state[7:9] = 1.0, (0.2, -0.1)
    rates = sea.Plant(vehicle, Sea(current=(0.2, -0.1))).rates(0.0, state, STILL)
    np.testing.assert_allclose(rates[7:], 0.0, atol=1e-14)


@pytest.mark.parametrize("lag", [0.1, 0.4])
def test_thrust_follows_the_command_with_its_lag(lag):
    vehicle = vehicle_of(5)
    # the driving is the same, what acts is not: the autopilot reacts to another motion
    truth = sea.dive(vehicle, Sea(lag=lag), "six-axis", 4.0, np.random.default_rng(5))
    held = np.repeat(truth.command, round(1.0 / sea.COMMAND_RATE / sea.STEP), axis=0)
    expected, keep = np.zeros((len(held), 6)), math.exp(-sea.STEP / lag)
    for k in range(1, len(held)):
        expected[k] = held[k - 1] + keep * (expected[k - 1] - held[k - 1])
    np.testing.assert_allclose(truth.wrench, expected, atol=1e-10)


# ------------------------------------------------------------------ against the package


def told_the_truth(vehicle):
    return configuration.from_parameters(
        sea.told(vehicle, Sea(), np.random.default_rng(0), off=0.0)
    )


@pytest.mark.parametrize("driving", [*sea.DRIVING, *sea.SPARSE])
def test_the_packages_equations_give_the_wrench_that_acted(driving):
    vehicle = vehicle_of(11)
    truth = sea.dive(vehicle, Sea(), driving, 20.0, np.random.default_rng(11))
    model = told_the_truth(vehicle).model
    down = sea.rotations(truth.state[:, 3:7])[:, 2]
    for k in range(0, len(truth.begin), 37):
        wrench = model.wrench(truth.state[k, 7:], truth.begin[k, 7:], down[k])
        np.testing.assert_allclose(wrench, truth.wrench[k], atol=1e-9)


@pytest.mark.parametrize("seed", [12, *more(20, 21)])
def test_a_clean_dive_is_predicted_to_its_noise(tmp_path, seed):
    """By the package's simulation with the true coefficients, a minute in one run, from the
    messages in their bag; what is measured there is odometry and gyro together."""
    vehicle, path = vehicle_of(seed), tmp_path / "clean.mcap"
    truth = sea.dive(vehicle, Sea(), "six-axis", 60.0, np.random.default_rng(seed))
    write_messages(path, sea.measured(truth, Sea(), np.random.default_rng(seed)))
    found = ri.simulate(told_the_truth(vehicle), bag=path)
    noise = np.repeat([sea.LINEAR_STD, sea.ANGULAR_STD], 3)
    assert found.whole is not None
    assert (found.whole.rmse < 1.1 * noise).all() and (found.whole.rmse > 0.7 * noise).all()


# ------------------------------------------------------------------ sensors


@pytest.fixture(scope="module")
def clean():
    return sea.dive(vehicle_of(4), Sea(), "six-axis", 20.0, np.random.default_rng(4))


def read(truth, role, field, **changes):
    """Stamps (s since t = 0) and numbers of a role, in forward-port-up."""
    messages = sea.measured(truth, Sea(**changes), np.random.default_rng(1))
    mine = [m for _, r, m in messages if r == role]
    t = np.array([(m.stamp - sea.EPOCH) * 1e-9 for m in mine])
    return t, np.array([getattr(m, field) for m in mine])


def test_sensors_see_the_true_motion_in_the_axes_of_ros(clean):
    t, v = read(clean, "odom", "linear")
    x, _ = clean.at(t)
    assert np.std(v - x[:, 7:10] * [1, -1, -1]) == pytest.approx(sea.LINEAR_STD, rel=0.1)
    t, q = read(clean, "odom", "orientation")
    x, _ = clean.at(t)
    up = sea.rotations(q)[:, 2]  # world up in forward-port-up
    np.testing.assert_allclose(up, -sea.rotations(x[:, 3:7])[:, 2] * [1, -1, -1], atol=0.02)
    ahead = sea.rotations(q)[:, :2, 0]  # east, north of the bow
    np.testing.assert_allclose(ahead, sea.rotations(x[:, 3:7])[:, [1, 0], 0], atol=0.02)
    t, a = read(clean, "imu", "linear_acceleration")
    assert np.mean(a[t < 0.5, 2]) == pytest.approx(sea.GRAVITY, abs=0.2)  # upward at rest


@pytest.mark.parametrize("delay", [0.05, 0.15])
def test_late_velocities_are_those_of_before(clean, delay):
    t, v = read(clean, "odom", "linear", velocity_delay=delay)
    x, _ = clean.at(np.maximum(t - delay, 0.0))
    assert np.std(v - x[:, 7:10] * [1, -1, -1]) == pytest.approx(sea.LINEAR_STD, rel=0.1)
    _, w = read(clean, "odom", "angular", velocity_delay=delay)
    now, _ = clean.at(t)
    assert np.std(w - now[:, 10:] * [1, -1, -1]) == pytest.approx(sea.ANGULAR_STD, rel=0.1)


def test_smoothed_odometry_is_late_and_its_noise_is_coloured(clean):
    still = replace(clean, state=np.tile(clean.state[0], (len(clean.state), 1)))
    zero = np.zeros_like(clean.begin)
    still = replace(still, begin=zero, end=zero)
    t, v = read(still, "odom", "linear", smoothing=0.1)
    e = v[t > 1.0]
    assert np.std(e) == pytest.approx(sea.LINEAR_STD, rel=0.2)
    assert np.mean(e[1:] * e[:-1]) / np.var(e) == pytest.approx(math.exp(-0.5), abs=0.15)
    _, w = read(still, "odom", "angular", smoothing=0.1)
    ti, gyro = read(still, "imu", "angular_velocity")
    last = np.searchsorted(ti, t, side="right") - 1
    recent = np.array([gyro[max(k - 20, 0) : k + 1].mean(axis=0) for k in last])
    assert np.corrcoef(recent[20:].ravel(), w[20:].ravel())[0, 1] > 0.8  # it has eaten the gyro


def test_each_fault_is_in_the_messages(clean):
    t, v = read(clean, "odom", "linear", frozen_from=10.0)
    assert np.abs(v[t >= 10.0]).max() < 0.02 < np.abs(v[t < 10.0]).max()
    t, w = read(clean, "imu", "angular_velocity", imu_turned=True)
    x, _ = clean.at(t)
    assert np.std(w - x[:, 10:] * [-1, 1, -1]) == pytest.approx(sea.GYRO_STD, rel=0.1)
    _, a = read(clean, "imu", "linear_acceleration", imu_turned=True)
    assert np.mean(a[:20, 2]) == pytest.approx(sea.GRAVITY, abs=0.2)
    for axis in range(6):
        name = "force" if axis < 3 else "torque"
        _, one = read(clean, "wrench", name, reversed_axis=axis)
        _, other = read(clean, "wrench", name)
        signs = np.ones(3)
        signs[axis % 3] = -1.0
        np.testing.assert_array_equal(one, signs * other)
    for changes, role in (({"imu_clock": 0.02}, "imu"), ({"odometry_clock": 0.2}, "odom")):
        field = "angular_velocity" if role == "imu" else "angular"
        late, _ = read(clean, role, field, **changes)
        right, _ = read(clean, role, field)
        np.testing.assert_allclose(late - right, next(iter(changes.values())), atol=1e-9)


def test_a_pose_with_axes_of_its_own(clean):
    _, right = read(clean, "odom", "orientation")
    _, wrong = read(clean, "odom", "orientation", heading=0.2, tilt=(0.03, -0.02))
    R, W = sea.rotations(right), sea.rotations(wrong)
    turn, c, s = np.array([0.03, 0.02, 0.0]), math.cos(0.2), math.sin(0.2)
    world = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # east, north, up
    for a, b in zip(R, W, strict=True):  # to second order in the tilt
        np.testing.assert_allclose(b, world @ a @ (np.eye(3) + skew(turn)), atol=1e-3)


def test_messages_that_are_long_on_the_way_keep_their_stamps(clean):
    sent = sea.measured(clean, Sea(on_the_way=(0.1, 0.05, 0.2)), np.random.default_rng(1))
    for role, delay in (("odom", 0.1), ("imu", 0.05), ("wrench", 0.2)):
        age = {arrival - m.stamp for arrival, r, m in sent if r == role}
        assert age == {sea.LATENCY + round(1e9 * delay)}
    assert [arrival for arrival, _, _ in sent] == sorted(arrival for arrival, _, _ in sent)


def test_one_axis_at_a_time():
    t = np.arange(5000) / sea.COMMAND_RATE
    driven = sea.axis_by_axis(np.random.default_rng(2), t) != 0.0
    assert (driven.sum(axis=1) <= 1).all() and driven.any(axis=0).all()


# ------------------------------------------------------------------ the study


@pytest.mark.parametrize("case", [*at_sea.CASES, *at_sea.LIES])
def test_a_case_changes_what_it_is_named_after_and_nothing_else(case):
    rng, vehicle = np.random.default_rng(8), vehicle_of(8)
    draw = at_sea.CASES.get(case) or at_sea.LIES[case]
    drawn = draw(rng, vehicle)
    assert bool(drawn) == (case not in ("known", "clean"))
    unknown = replace(Sea(), **drawn)
    changed = {f.name for f in dataclasses.fields(Sea) if getattr(unknown, f.name) != f.default}
    assert changed <= set(drawn)
    if case == "all together":
        parts = [draw(rng, vehicle) for draw in at_sea.ALONE.values()]
        assert set(drawn) == {name for part in parts for name in part}


def line(case="clean", estimator="rls", **changes):
    trial = {"case": case, "driving": "six-axis", "estimator": estimator}
    true, value, std = [-1.0, -2.0], [-1.1, -2.0], [0.02, 0.1]
    return {
        "trial": trial, "true": true, "value": value, "std": std,
        "lower": [-1.14, -2.2], "upper": [-1.06, -1.8], "state": ["converged", "converged"],
        "consistent": True, **changes,
    }  # fmt: skip


def test_figures_of_a_row():
    group = at_sea.Group(
        [line(), line(value=[-1.0, -2.0], lower=[-1.04, -2.2], upper=[-0.96, -1.8])]
    )
    assert group.median == pytest.approx(0.0) and group.covered == 0.75
    assert group.disagrees == 0.0 and group.honest == 0.5  # five sigma, and none


@pytest.mark.parametrize(
    "changes, honest",
    [
        ({}, False),
        ({"consistent": False}, True),
        ({"state": ["converging", "converged"]}, True),
        ({"state": ["converged", "held"]}, False),
    ],
)
def test_a_dive_is_honest_if_it_is_right_or_said_to_be_wrong(changes, honest):
    assert at_sea.Group([line(**changes)]).honest == honest


def test_a_refusal_is_said_and_a_crash_is_not():
    trial = line()["trial"]
    refused, crashed = ({"trial": trial, key: "why"} for key in ("refused", "crashed"))
    assert at_sea.Group([refused]).honest == 1.0 == at_sea.Group([refused]).disagrees
    assert at_sea.Group([crashed]).honest == 0.0 == at_sea.Group([crashed]).disagrees


def test_bars_of_the_tables(capsys):
    good = line(value=[-1.0, -2.0], lower=[-1.04, -2.2], upper=[-0.96, -1.8])
    many = [good] * 9 + [line(value=[-1.0, -2.0])]
    bars = at_sea.Bars()
    at_sea.accuracy(at_sea.grouped([*many, *(line(**m, estimator="ml") for m in [{}])]), bars)
    assert not [m for m in bars.missed if m.startswith("clean, six-axis, rls")]
    at_sea.accuracy(at_sea.grouped([line(value=[-1.2, -2.5])]), bars)
    missed = [m for m in bars.missed if m.startswith("clean, six-axis, rls")]
    assert len(missed) == 2  # error and coverage
    at_sea.lies(at_sea.grouped([line(case="IMU turned")]), bars)
    assert any(m.startswith("IMU turned, six-axis, rls: honest") for m in bars.missed)
    assert "**0 %**" in capsys.readouterr().out


def explained(case, *found):
    told = [{"effect": n, "sure": sure, "alternatives": others} for n, sure, others in found]
    return {
        "trial": {"case": case, "driving": "pilot"}, "found": told, "minor": [],
        "verdict": "explained" if found else "agrees", "cpu": 1.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    "found, right, wrong",
    [
        (("thruster_lag", True, []), True, []),
        (("actuation_delay", False, ["thruster_lag"]), True, []),
        (("actuation_delay", False, []), False, ["actuation_delay"]),
        (("actuation_delay", True, ["thruster_lag"]), False, ["actuation_delay!"]),
    ],
)
def test_a_name_is_right_wrong_or_wrong_and_sure(capsys, found, right, wrong):
    line = explained("thruster lag", found)
    assert explain_at_sea.right(line) == right and explain_at_sea.wrong(line) == wrong
    bars = explain_at_sea.Bars()
    explain_at_sea.report([line], bars)
    missed = [m.split(": ")[1] for m in bars.missed]
    assert missed == ["right where named"] * (not right) + ["wrong and sure"] * ("!" in str(wrong))
    explain_at_sea.report([explained("clean", found), explained("clean")], bars)
    assert any(m.startswith("clean, pilot: a wrong name") for m in bars.missed)
    assert "1 of 2" in capsys.readouterr().out


def test_names_that_are_right_are_in_the_library():
    assert {n for _, names in explain_at_sea.CASES.values() for n in names} <= set(EFFECTS)
    for case, (draw, _) in explain_at_sea.CASES.items():
        replace(Sea(), **draw(np.random.default_rng(8), vehicle_of(8)))
        assert case not in at_sea.CASES or draw is at_sea.CASES[case]
