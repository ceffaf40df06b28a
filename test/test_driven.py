"""Fin angles and shaft speeds as inputs: equations, joints, samples, and coefficients from them."""

import dataclasses
import math
import re

import numpy as np
import pytest
from tiers import more

import rov_ident as ri
from bench import REMUS, ROOT
from rov_ident import config as configuration
from rov_ident.api.simulation import simulate
from rov_ident.config.prior import prior_of
from rov_ident.core.errors import UserError
from rov_ident.core.messages import DRIVE, WRENCH, Joints
from rov_ident.core.states import State
from rov_ident.io import cdr
from rov_ident.io.csv_log import import_csv
from rov_ident.io.write_messages import write_messages
from rov_ident.model.coefficients import AXES, INPUT_LETTERS, INPUTS, input_catalogue
from rov_ident.model.equations import build
from rov_ident.sampling.records import predicted, read_record
from rov_ident.simulation.open_loop import simulate as integrate
from rov_ident.simulation.virtual_sensors import Suite

HEAVY = ROOT / "config" / "bluerov2_heavy.yaml"
DOWN = np.array([0.0, 0.0, 1.0])
PROPELLED = {"X_nn": 0.02, "K_nn": -0.0008, "X_un": -0.01}
LEAN = {"odometry_rate": 10.0, "imu_rate": 50.0}  # Hz, where that is enough


@pytest.fixture(scope="module")
def remus():
    return configuration.load(REMUS)


def with_inputs(config, **joints):
    """The configuration with these joints for its inputs, and all coefficients estimated."""
    plain = configuration.to_parameters(config)
    plain.pop("estimate", None)
    plain["inputs"] = {name: {"joint": joint} for name, joint in joints.items()}
    return configuration.from_parameters(plain)


# ------------------------------------------------------------------ equations


def by_its_name(name, u, inputs):
    """What a coefficient of an input multiplies, read off its name letter by letter."""
    x = dict(zip(INPUT_LETTERS, inputs, strict=True))
    term = name.split("_")[1]
    if "d" not in term:
        n = x["n"]
        return {"n": n, "nn": abs(n) * n, "un": u * n}[term]
    speed, _, fin = term.partition("d")
    angle = x[fin[0]]
    if len(fin) > 1:  # mirror symmetry: port-starboard for r and a, up-down for s
        even = name[0] == "X" or (name[0] in "ZM" and fin[0] in "ra")
        angle = angle**2 if even else abs(angle) * angle
    n = x["n"]
    return {"": 1.0, "u": u, "uu": u * u, "nn": abs(n) * n}[speed] * angle


def test_each_coefficient_of_an_input_is_its_formula(remus):
    rng = np.random.default_rng(3)
    for c in input_catalogue():
        nu, inputs = rng.normal(size=6), rng.normal(size=4)
        model = build(remus.model.body, {**remus.model.values, "X_udot": -1.0, c.name: 0.7})
        if c.name in remus.model.values:
            model = model.with_values({c.name: 0.7})
        other = {name: 0.0 for name in model.fins if name != c.name}
        wrench = model.with_values(other).input_wrench(nu, inputs)
        expected = np.zeros(6)
        expected[AXES.index(c.name[0])] = 0.7 * by_its_name(c.name, nu[0], inputs)
        np.testing.assert_allclose(wrench, expected, atol=1e-11)


def test_regressor_and_both_dynamics_agree_with_inputs(remus):
    model = build(remus.model.body, {**remus.model.values, **PROPELLED})
    rng = np.random.default_rng(4)
    nu, nu_dot, inputs = rng.normal(size=6), rng.normal(size=6), rng.normal(size=4)
    tau = model.wrench(nu, nu_dot, DOWN, inputs)
    np.testing.assert_allclose(model.acceleration(nu, tau, DOWN, inputs), nu_dot, atol=1e-9)
    none = model.with_theta(np.zeros_like(model.theta)).wrench(nu, nu_dot, DOWN, inputs)
    rows = model.regressor(nu, nu_dot, inputs)
    np.testing.assert_allclose(none + rows @ model.theta, tau, atol=1e-9)
    still = model.wrench(nu, nu_dot, DOWN)
    np.testing.assert_allclose(still - tau, model.input_wrench(nu, inputs), atol=1e-9)


def test_constant_propeller_reaches_its_terminal_speed(remus):
    """X_nn n^2 + X_uu u^2 = 0: u = n sqrt(X_nn / -X_uu)."""
    # with the CG at the origin: thrust beside it would start a pitching that nothing damps
    neutral = dataclasses.replace(
        remus.model.body, weight=300.0, buoyancy=300.0, cog=np.zeros(3), cob=np.zeros(3)
    )
    model = build(neutral, {"X_udot": -0.93, "X_uu": -1.62, "X_nn": 0.02})
    t = np.linspace(0.0, 300.0, 301)
    inputs = np.tile([0.0, 0.0, 0.0, 12.0], (len(t), 1))
    run = integrate(model, t, np.zeros((len(t), 6)), inputs=inputs)
    assert run.nu[-1, 0] == pytest.approx(12.0 * math.sqrt(0.02 / 1.62), rel=1e-6)


def test_vehicle_without_such_coefficients_has_no_inputs():
    config = configuration.load(HEAVY)
    assert config.model.inputs == () and len(config.model.structure.inputs) == 0
    assert config.inputs.joints == {}


# ------------------------------------------------------------------ configuration


def test_coefficients_wait_for_their_input(remus):
    deaf = with_inputs(remus, delta_r="rudder")
    assert deaf.unheard == {"delta_s": ("Z_uuds", "M_uuds")}
    assert not {"Z_uuds", "M_uuds"} & set(deaf.estimate)
    assert {"Y_uudr", "N_uudr"} < set(deaf.estimate) == set(prior_of(deaf).names)
    plain = configuration.to_parameters(deaf)
    plain["estimate"] = ["X_uu", "M_uuds"]
    with pytest.raises(UserError, match=r"M_uuds depends on delta_s.*inputs\.delta_s\.joint"):
        configuration.from_parameters(plain)


def test_joints_survive_the_file(remus, tmp_path):
    given = with_inputs(remus, delta_r="rudder", delta_s="planes", n="shaft")
    configuration.dump(given, tmp_path / "again.yaml")
    again = configuration.load(tmp_path / "again.yaml")
    assert again.inputs == given.inputs and again.estimate == given.estimate


# ------------------------------------------------------------------ joints


def test_joint_states_are_those_of_another_implementation():
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    message = Joints(
        1_500_000_007, "base", ("a", "rudder"), np.array([0.1, -0.2]), np.array([3.0, 4.0])
    )
    other = store.deserialize_cdr(cdr.encode(message), cdr.JOINTS_TYPE)
    assert other.name == ["a", "rudder"] and other.header.frame_id == "base"
    np.testing.assert_array_equal(other.position, message.position)
    np.testing.assert_array_equal(other.velocity, message.velocity)
    assert len(other.effort) == 0
    again = cdr.decode_joints(bytes(store.serialize_cdr(other, cdr.JOINTS_TYPE)))
    assert again[:3] == message[:3]
    np.testing.assert_array_equal(again.velocity, message.velocity)


def run_of(config, seed, duration=20.0, **sensors):
    return simulate(
        config, manoeuvre="waypoints", duration=duration, seed=seed, sensors=Suite(**sensors)
    )


def record_of(config, messages, path):
    write_messages(path, messages)
    return read_record(path, config)


def test_samples_hold_the_inputs_mean_and_end(remus, tmp_path):
    """Between the joints' messages in straight lines: as those of the messages, integrated."""
    run = run_of(remus, 3, joint_std=0.0)
    record = record_of(remus, run.messages, tmp_path / "run.mcap")
    joints = [m for _, role, m in run.messages if role == DRIVE]
    origin = record.counts and min(m.stamp for _, _, m in run.messages)
    t = np.array([(m.stamp - origin) * 1e-9 for m in joints])
    rudder = np.array([m.position[m.names.index("rudder")] for m in joints])
    samples = record.samples[5:]
    at = INPUTS.index("delta_r")
    np.testing.assert_allclose(
        samples["inputs"][:, 1, at], np.interp(samples["t"], t, rudder), atol=1e-9
    )
    fine = np.linspace(0.0, 1.0, 2001)
    for sample in samples[::97]:
        along = np.interp(sample["t"] - sample["dt"] * fine, t, rudder)
        assert sample["inputs"][0, at] == pytest.approx(np.trapezoid(along, fine), abs=1e-7)
    assert not samples["inputs"][:, :, [INPUTS.index("delta_a"), INPUTS.index("n")]].any()


def test_own_simulation_is_followed_without_error(remus, tmp_path):
    """With the fins in the samples the truth predicts itself; with fins at zero it does not."""
    run = run_of(remus, 5, linear_std=1e-6, angular_std=1e-6, wrench_std=0.0, joint_std=0.0,
                 gyro_std=1e-6, accelerometer_std=1e-5, attitude_std=1e-7)  # fmt: skip
    record = record_of(remus, run.messages, tmp_path / "run.mcap")
    error = predicted(remus.dynamics, record.samples, 5.0) - record.samples["nu"]
    deaf = record.samples.copy()
    deaf["inputs"] = 0.0
    worse = predicted(remus.dynamics, deaf, 5.0) - record.samples["nu"]
    rms, without = (np.sqrt(np.mean(e**2, axis=0)) for e in (error, worse))
    assert (rms[[1, 2, 4, 5]] < 0.02 * without[[1, 2, 4, 5]]).all()


def test_missing_input_is_counted_and_said(remus, tmp_path):
    messages = run_of(remus, 3).messages
    begin = messages[0][0]
    silent = [m for m in messages if m[1] != DRIVE or m[0] < begin + 8e9]
    record = record_of(remus, silent, tmp_path / "silent.mcap")
    assert 6.0 < record.samples["t"][-1] < 10.0
    assert any(re.search(r"sample: no delta_s \(\d+\)", note) for note in record.notes)
    without = [m for m in messages if m[1] != DRIVE]
    with pytest.raises(UserError, match="no joint_states topic"):
        record_of(remus, without, tmp_path / "without.mcap")
    other = with_inputs(remus, delta_r="rudder_joint", delta_s="stern_planes")
    with pytest.raises(UserError, match="no delta_r"):
        record_of(other, messages, tmp_path / "other.mcap")


def test_stuck_input_is_said(remus, tmp_path):
    def stuck(message):
        return message._replace(position=np.where([False, True], 0.1, message.position))

    messages = [
        (at, role, stuck(m) if role == DRIVE else m) for at, role, m in run_of(remus, 3).messages
    ]
    notes = record_of(remus, messages, tmp_path / "stuck.mcap").notes
    assert any("delta_r (joint rudder) stays at 0.1 throughout" in note for note in notes)
    assert not any("delta_s (joint" in note for note in notes)


def test_unnamed_joints_are_said(remus, tmp_path):
    deaf = with_inputs(remus, delta_s="stern_planes")
    notes = record_of(deaf, run_of(remus, 3).messages, tmp_path / "deaf.mcap").notes
    assert any("Y_uudr, N_uudr: held" in n and "inputs.delta_r.joint" in n for n in notes)


# ------------------------------------------------------------------ from a plain log


def test_import_of_angles_and_revolutions(remus, tmp_path):
    t = np.arange(0.0, 10.0, 0.05)
    columns = {"t_s": t, **{name: np.zeros_like(t) for name in "vwpqr"}, "u": 1.5 + 0.0 * t}
    columns |= {"delta_r": 0.2 * np.sin(t), "delta_s": 0.1 * np.cos(t), "rpm": 600.0 + 60.0 * t}
    rows = np.column_stack(list(columns.values()))
    log = tmp_path / "log.csv"
    np.savetxt(log, rows, delimiter=",", header=",".join(columns), comments="")
    report = import_csv([log], tmp_path / "log.mcap")
    assert any("no X Y Z K M N given" in note for note in report.notes)
    config = with_inputs(remus, delta_s="delta_s", delta_r="delta_r", n="n")
    samples = read_record(tmp_path / "log.mcap", config).samples
    at = samples["t"]
    expected = np.column_stack([0.1 * np.cos(at), 0.2 * np.sin(at), 0.0 * at, 10.0 + at])
    np.testing.assert_allclose(samples["inputs"][:, 1], expected, atol=1e-6)


def test_angles_in_degrees_are_refused(tmp_path):
    t = np.arange(0.0, 1.0, 0.05)
    columns = {"t_s": t, **{name: np.zeros_like(t) for name in "uvwpqr"}, "delta_r": 20.0 + 0 * t}
    log = tmp_path / "log.csv"
    rows = np.column_stack(list(columns.values()))
    np.savetxt(log, rows, delimiter=",", header=",".join(columns), comments="")
    with pytest.raises(UserError, match="delta_r is 20, which looks like degrees"):
        import_csv([log], tmp_path / "log.mcap")
    columns["delta_r"], columns["r"] = 0.2 + 0.0 * t, 30.0 * np.sin(7.0 * t)
    np.savetxt(log, np.column_stack(list(columns.values())), delimiter=",",
               header=",".join(columns), comments="")  # fmt: skip
    with pytest.raises(UserError, match="r exceeds .* more than a turn a second"):
        import_csv([log], tmp_path / "log.mcap")


# ------------------------------------------------------------------ coefficients from dives

SPREAD = 0.3  # of the coefficients, relative: uniform within
SEEDS = (1, 2)


@pytest.fixture(scope="module")
def dives(remus, tmp_path_factory):
    """(configuration that only knows the spread, true values, bag), by seed: all coefficients are
    drawn, not those of the fins alone."""
    published = remus.model.values
    plain = configuration.to_parameters(remus)
    std = {name: SPREAD / math.sqrt(3.0) * abs(value) for name, value in published.items()}
    given = configuration.from_parameters({**plain, "prior": {"std": std}})
    found = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        drawn = {n: x * rng.uniform(1.0 - SPREAD, 1.0 + SPREAD) for n, x in published.items()}
        path = tmp_path_factory.mktemp("dive") / f"{seed}.mcap"
        truth = given.with_values(drawn)
        write_messages(path, run_of(truth, seed, duration=40.0, **LEAN).messages)
        found.append((given, drawn, path))
    return found


@pytest.mark.parametrize("estimator", [*more("rls"), "ukf", "ls"])
def test_fin_coefficients_are_found_again(estimator, dives):
    """Of 8 intervals of 95 % at most 2 miss (three or more: 0.6 % of such tests), and the error
    that the prior had, 17 %, falls to less than half in the median."""
    missed, errors = 0, []
    for given, truth, path in dives:
        fit = ri.fit(path, given, estimator=estimator)
        for name, value, low, high in zip(fit.names, fit.values, fit.lower, fit.upper, strict=True):
            if name in given.model.fins:
                missed += not low <= truth[name] <= high
                errors.append(abs(value / truth[name] - 1.0))
    assert len(errors) == 4 * len(dives)
    assert missed <= 2
    assert np.median(errors) < 0.5 * SPREAD / math.sqrt(3.0)


@pytest.mark.parametrize("seed", [5, *more(6, 7, 8)])
def test_fins_that_follow_late_are_found_or_said(remus, tmp_path, seed):
    """Joints are mostly commands. Of 0.1 s, taken for none, a quarter of what had converged was up
    to 12 standard deviations off, and model and data agreed."""
    rng = np.random.default_rng(seed)
    lag = float(rng.uniform(0.05, 0.3))
    factors = rng.uniform(0.8, 1.2, len(remus.model.theta))
    truth = dataclasses.replace(
        remus.with_values(dict(zip(remus.model.names, factors * remus.model.theta, strict=True))),
        effects={"fin_lag": {"time_constant": lag}},
    )
    path = tmp_path / "dive.mcap"
    write_messages(path, run_of(truth, seed, duration=70.0, **LEAN).messages)
    fit = ri.fit(path, remus, estimator="rls")
    i = fit.names.index("fin_lag.time_constant")
    assert abs(fit.values[i] - lag) < max(4.0 * fit.std[i], 0.1 * lag), (lag, fit.values[i])
    values = truth.model.values
    off = {n: (v - values[n]) / s for n, v, s in zip(fit.names, fit.values, fit.std) if n in values}
    converged = {n for n, state in zip(fit.names, fit.states) if state is State.CONVERGED}
    assert not {n: z for n, z in off.items() if n in converged and abs(z) > 3.5}
    plain = configuration.to_parameters(remus)
    plain["inputs"]["fin_lag_std"] = 0.0
    for estimator in ("rls", "ls"):
        known = configuration.from_parameters(plain)
        if estimator == "rls":  # a lag of thrust or velocities would take the fins' for its own
            for section, key in (("wrench", "lag_std"), ("odometry", "latency_std")):
                plain.setdefault(section, {})[key] = 0.0
            known = configuration.from_parameters(plain)
        blind = ri.fit(path, known, estimator=estimator)
        failed = [test.name for test in blind.consistency.tests if not test.passed]
        assert "motion behind the wrench" in failed and State.CONVERGED not in blind.states
    assert "behind the wrench, fins and shafts" in blind.consistency.sentence


@pytest.mark.parametrize("estimator", ["rls", *more("ls", "ml")])
def test_a_joint_that_counts_the_other_way_round_is_said(remus, tmp_path, estimator):
    """What follows from it is right in its own sense, and surely not what the file says."""
    path, plain = tmp_path / "dive.mcap", configuration.to_parameters(remus)
    write_messages(path, run_of(remus, 4, duration=60.0, **LEAN).messages)
    for joint in ("delta_r", "delta_s"):
        plain["inputs"][joint]["scale"] = -plain["inputs"][joint].get("scale", 1.0)
    reversed_ = configuration.from_parameters(plain)
    notes = [" ".join(ri.fit(path, c, estimator=estimator).notes) for c in (reversed_, remus)]
    words = "works the other way round than the configuration has it"
    assert f"delta_r {words} (the sign of Y_uudr, N_uudr has changed)" in notes[0]
    assert f"delta_s {words} (the sign of Z_uuds, M_uuds has changed)" in notes[0]
    assert words not in notes[1]


@pytest.mark.parametrize("seed", [4, *more(5, 6)])
def test_explain_says_so_too(remus, tmp_path, seed):
    plain = configuration.to_parameters(remus)
    joint = str(np.random.default_rng(seed).choice(["delta_r", "delta_s"]))
    plain["inputs"][joint]["scale"] = -plain["inputs"][joint].get("scale", 1.0)
    given, path = configuration.from_parameters(plain), tmp_path / "dive.mcap"
    write_messages(path, run_of(remus, seed, duration=80.0, **LEAN).messages)
    (note,) = [n for n in ri.explain(path, given).findings.notes if "other way round" in n]
    assert note.startswith(f"{joint} works the other way round than the configuration has it")


def test_inertia_that_no_known_force_tells_is_held(dives):
    """Least squares would cancel the vehicle's own inertia in sway and yaw, and find nothing left
    to explain. What it holds instead is as uncertain as before, and the others relative to it."""
    given, truth, path = dives[0]
    fit = ri.fit(path, given, estimator="ls")
    prior = prior_of(given)
    found = dict(zip(fit.names, zip(fit.values, fit.std, prior.std, fit.states), strict=True))
    for name in ("Y_vdot", "Y_rdot", "N_rdot"):
        value, std, before, state = found[name]
        assert value == given.model.values[name] and std >= before and state is State.HELD, name
    rudder, std, before, _ = found["N_uudr"]
    assert std < before and abs(rudder - truth["N_uudr"]) < 2.0 * std
    # the righting moment tells the inertia in pitch
    assert found["M_qdot"][0] != given.model.values["M_qdot"]


def test_where_no_thruster_pushes_nobody_is_sent_to_weigh_the_vehicle(remus, tmp_path):
    """Without any thrust nothing is said of its scale, which the estimators carry all the same."""
    messages = [
        (t, role, m._replace(force=0.0 * m.force, torque=0.0 * m.torque))
        if role == WRENCH
        else (t, role, m)
        for t, role, m in run_of(remus, 3).messages
    ]
    path = tmp_path / "driven_by_fins.mcap"
    write_messages(path, messages)
    fit = ri.fit(path, remus, estimator="rls")
    assert "thrust_scale.scale" in fit.names and not fit.has_thrust
    assert fit.to_measure == ()
