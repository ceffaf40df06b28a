"""What explain names, and what it does not: thrust, late velocities, headings, noisy readings."""

import dataclasses

import numpy as np
import pytest
import yaml
from scipy.signal import butter, lfilter, sosfilt
from tiers import more

from bench import HEAVY
from bench.simulators.hidden import LINEAR_STD, Conditions, draw
from bench.studies.explain import streams_of
from rov_ident.config import from_parameters, load, to_parameters
from rov_ident.core.files import shipped
from rov_ident.core.frames import quaternion_from_rotation_vector, quaternion_multiply
from rov_ident.core.messages import WRENCH
from rov_ident.discrepancy import extension
from rov_ident.discrepancy.explain import explain
from rov_ident.discrepancy.findings import _is_sure_factor, _may_be_lost_thrust, parameters_of
from rov_ident.discrepancy.held_out import Judge, split, thinned, windows
from rov_ident.discrepancy.hypothesis import COEFFICIENTS, Hypothesis
from rov_ident.discrepancy.output_error import fit, refit
from rov_ident.discrepancy.search import Search
from rov_ident.discrepancy.windowed_problem import WindowedProblem
from rov_ident.effects import EFFECTS
from rov_ident.model.coefficients import AXES
from rov_ident.model.scales import semi_axes
from rov_ident.model.thruster_allocation import matrix
from rov_ident.sampling.raw_streams import gather
from rov_ident.sampling.wrench_scatter import resting_noise
from rov_ident.simulation.virtual_sensors import Suite, dive

MINUTE = Conditions(duration=60.0, odometry_rate=10.0, imu_rate=50.0)
NOISY = Conditions(duration=120.0, excitation="pilot", reading=(0.5, 0.06))
SHIPPED = shipped("config/bluerov2_heavy.yaml")
LEAN = Suite(odometry_rate=10.0, imu_rate=50.0)


def hidden(name, rng):
    """Values of an effect, and of coefficients, at random."""
    u = rng.uniform
    return {
        "thrust_scale": ({"scale": 1.0 - u(0.1, 0.3)}, {}),
        "thrust_curve": ({"curvature_X": u(0.2, 0.4), "curvature_Z": u(0.2, 0.4)}, {}),
        "thrust_advance": ({"k": u(0.2, 0.5)}, {}),
        "thruster_saturation": ({"limit_X": u(18.0, 28.0), "limit_Z": u(35.0, 50.0)}, {}),
        "battery_resistance": ({"loss": u(0.15, 0.35)}, {}),
        "velocity_latency": ({"delay": u(0.06, 0.2)}, {}),
        "heading_offset": ({"yaw": u(0.1, 0.6)}, {}),
        "coriolis": ({}, {"X_vr": u(15.0, 25.0), "Y_ur": -u(10.0, 20.0), "X_wq": -u(10.0, 20.0)}),
        "thrust_line": ({"arm_X_N": u(0.006, 0.015), "arm_Z_M": -u(0.008, 0.02)}, {}),
        "crossflow": ({}, {"Y_v_abs_r": -u(50.0, 90.0), "N_v_abs_r": -u(10.0, 15.0)}),
        "oblique_damping": ({}, {"X_u_abs_v": -u(60.0, 120.0), "Z_w_abs_u": -u(80.0, 160.0)}),
    }[name]


def world_and_belief(heavy, name, values, coefficients, rng):
    """A configuration with what is hidden, and one that knows nothing of it, off by up to 8 %."""
    given = to_parameters(heavy)
    theta = given["coefficients"]
    believed = {n: v * (1.0 + rng.uniform(-0.08, 0.08)) for n, v in theta.items()}
    effects = {name: values} if values else {}
    world = {**given, "coefficients": {**theta, **coefficients}, "effects": effects}
    return from_parameters(world), from_parameters({**given, "coefficients": believed})


def findings_of(world, config, suite=None, seed=0, name="steps"):
    run = dive(world, name, 60.0, suite or LEAN, seed)
    return explain([gather(((r, m) for _, r, m in run.messages), config)], config).findings


@pytest.mark.parametrize("seed", [1, *more(4)])
@pytest.mark.parametrize(
    "name",
    [
        "battery_resistance",
        "coriolis",
        # the first five are found in a test of their own, too
        *more(
            "thrust_line",
            "thrust_curve",
            "thrust_scale",
            "velocity_latency",
            "heading_offset",
            "oblique_damping",  # in test_tank.py, too
            "thrust_advance",
            "thruster_saturation",
            "crossflow",
        ),
    ],
)
def test_each_cause_is_named_alone_and_with_its_size(heavy, name, seed):
    rng = np.random.default_rng([seed, 3])
    values, coefficients = hidden(name, rng)
    world, config = world_and_belief(heavy, name, values, coefficients, rng)
    findings = findings_of(world, config, seed=seed)
    (found,) = findings.effects
    assert found.effect == name and findings.verdict == "explained"
    for parameter, true in (values | coefficients).items():
        value = found.parameters[parameter]
        assert abs(value.value - true) < max(4.0 * value.std, 0.04 * abs(true)), parameter


@pytest.mark.parametrize("seed", [1, *more(2, 3, 4, 5, 6)])
def test_a_thruster_that_fails_is_told_by_its_number(heavy, seed):
    """Any of the eight, dead or weak or too strong, from the start or from a time on. Axes that
    each lose a share explain little of it."""
    rng = np.random.default_rng([seed, 17])
    given = to_parameters(heavy) | {"thrusters": to_parameters(load(SHIPPED))["thrusters"]}
    shapes = EFFECTS["thruster_failure"].of_thrusters(matrix(from_parameters(given).thrusters))
    shape, gain = shapes[rng.integers(8)], rng.choice([0.0, rng.uniform(0.2, 0.7), 1.4])
    onset = rng.choice([0.0, rng.uniform(20.0, 40.0)])
    values = {**shape, "gain": float(gain), "onset": float(onset)}
    believed = {n: v * (1.0 + rng.uniform(-0.1, 0.1)) for n, v in given["coefficients"].items()}
    world = from_parameters({**given, "effects": {"thruster_failure": values}})
    findings = findings_of(world, from_parameters({**given, "coefficients": believed}), seed=seed)
    found = findings.effects[0]
    assert found.effect == "thruster_failure" and found.separable
    assert found.parameters["thruster"].value == shape["thruster"]
    told = found.parameters["gain"]
    assert abs(told.value - gain) < max(4.0 * told.std, 0.02)
    assert abs((found.onset_s or 0.0) - onset) < 3.0
    assert {f.effect for f in findings.effects if f.separable} == {"thruster_failure"}


@pytest.mark.parametrize(
    ("arm", "std", "may_be"), [(0.02, 0.15, True), (0.08, 0.15, False), (0.02, 0.0, False)]
)
def test_thrust_that_is_lost_takes_its_moment_along(heavy, arm, std, may_be):
    """Of a quarter of a metre of hull, 30 % of the thrust are an arm of 70 mm; none where the file
    says that the thrust is known."""
    config = dataclasses.replace(heavy, wrench=dataclasses.replace(heavy.wrench, scale_std=std))
    key = ("thrust_line", "arm_Y_N")
    assert semi_axes(config.model.body)[0] == pytest.approx(0.25, abs=0.03)
    assert _may_be_lost_thrust(config, Hypothesis(config, {key: arm}), [key]) == may_be


def test_a_line_of_thrust_is_not_sure_where_thrust_is_not_known(heavy):
    rng = np.random.default_rng([1, 3])
    values, coefficients = hidden("thrust_line", rng)
    world, config = world_and_belief(heavy, "thrust_line", values, coefficients, rng)
    config = dataclasses.replace(config, wrench=dataclasses.replace(config.wrench, scale_std=0.15))
    (found,) = findings_of(world, config, seed=1).effects
    assert found.effect == "thrust_line" and not found.separable
    assert "thruster_gain" in [a.effect for a in found.alternatives]


@pytest.mark.parametrize("seed", [1, *more(2, 3, 4)])
def test_trim_is_no_payload_taken_up_at_the_first_moment(heavy, seed):
    """Which, being one effect and not two, explains more at once."""
    rng = np.random.default_rng([seed, 5])
    trim = {
        "buoyancy": {"delta": rng.choice([-1.0, 1.0]) * rng.uniform(1.0, 4.0)},
        "cog_offset": dict(zip(("dx", "dy"), rng.uniform(0.002, 0.006, 2).tolist())),
    }
    given = to_parameters(heavy)
    world = from_parameters({**given, "effects": trim})
    found = {f.effect: f for f in findings_of(world, heavy, seed=seed).effects}
    assert set(found) == set(trim)
    for effect, values in trim.items():
        for name, true in values.items():
            told = found[effect].parameters[name]
            assert abs(told.value - true) < max(4.0 * told.std, 0.05 * abs(true))


@pytest.mark.parametrize("seed", [1, *more(2)])
def test_weight_too_much_may_be_buoyancy_that_is_lost(heavy, seed):
    """The two differ by the righting moment of what floats, which the file does not know so well:
    constant force was named alone, as no buoyancy explained all of it with the file's arm."""
    weight = {"fx": 0.0, "fy": 0.0, "fz": 8.0}
    rng = np.random.default_rng([seed, 3])
    world, config = world_and_belief(heavy, "constant_force", weight, {}, rng)
    (found,) = findings_of(world, config, seed=seed).effects
    named = {found.effect, *(a.effect for a in found.alternatives)}
    assert {"constant_force", "buoyancy"} <= named and not found.separable


# ------------------------------------------------------------------ by the other hand


@pytest.mark.parametrize("seed", [2, *more(5)])
def test_weaker_thrust_is_one_factor(seed):
    """15 % less on every axis than read: no payload, no six gains."""
    case = draw(seed, conditions=MINUTE)
    streams = streams_of(case)
    read = dataclasses.replace(streams, demand=streams.demand / 0.85)
    (found,) = explain([read], case.config).findings.effects
    assert found.effect == "thrust_scale"
    value = found.parameters["scale"]
    assert abs(value.value - 0.85) < max(4.0 * value.std, 0.01)
    assert "thruster_gain" not in [a.effect for a in found.alternatives if "as well" in a.why_not]


@pytest.mark.parametrize("seed", [5, *more(2, 3)])
@pytest.mark.parametrize("weak, named, told", [("XYN", "ZN", "N"), ("N", "N", "N")])
def test_the_thrust_of_an_axis_is_compared_with_that_of_the_others(seed, weak, named, told):
    """With surge, sway and yaw too weak, heave may look too strong instead: that is not sure. But
    of one axis alone it is, as all others together would have to be off alike."""
    gains = dict(zip(weak, np.random.default_rng([seed, 21]).uniform(0.8, 0.92, len(weak))))
    case = draw(seed, conditions=MINUTE)
    streams = streams_of(case)
    read = streams.demand / [gains.get(axis, 1.0) for axis in AXES]
    streams = dataclasses.replace(streams, demand=read)
    search = Search(streams, case.config, split(streams.duration)[0])
    rest = search.start()
    keys = [("thruster_gain", f"gain_{axis}") for axis in named]
    final = refit(rest.hypothesis.having(dict.fromkeys(keys, 1.0)), rest.linearisation)
    sure = [key[1][-1] for key in keys if _is_sure_factor(search, final, rest, key)]
    assert sure == list(told)


@pytest.mark.parametrize("seed", [3, *more(2)])
def test_velocities_behind_a_filter_have_no_sure_scale(seed):
    """A filter of 0.5 Hz makes them late, and quick ones smaller."""
    case = draw(seed, conditions=MINUTE)
    streams = streams_of(case)
    nu = streams.nu.copy()
    rate = 1.0 / float(np.median(np.diff(streams.t)))
    nu[:, :3] = sosfilt(butter(2, 0.5, fs=rate, output="sos"), nu[:, :3], axis=0)
    findings = explain([dataclasses.replace(streams, nu=nu)], case.config).findings
    assert "velocity_latency" in [f.effect for f in findings.effects]
    sure = [f.effect for f in (*findings.effects, *findings.minor) if f.separable]
    assert "velocity_scale" not in sure


@pytest.mark.parametrize("seed", [2, *more(5)])
def test_late_velocities_are_said_to_be_late(seed):
    case = draw(seed, conditions=MINUTE)
    streams, t = streams_of(case), case.truth.t
    first = 1e-9 * (min(m.stamp for _, _, m in case.messages)) - 1.0  # of t = 0 in the truth
    nu = streams.nu.copy()
    late = streams.t + first - 0.12
    nu[:, :3] = np.stack([np.interp(late, t, v) for v in case.truth.nu[:, :3].T], axis=1)
    nu[:, :3] += LINEAR_STD * np.random.default_rng(seed).standard_normal(nu[:, :3].shape)
    findings = explain([dataclasses.replace(streams, nu=nu)], case.config).findings
    (found,) = findings.effects
    assert found.effect == "velocity_latency"
    assert found.parameters["delay"].value == pytest.approx(0.12, abs=0.006)


@pytest.mark.parametrize("excitation", ["steps", *more("pilot")])
def test_a_force_is_known_no_better_than_thrust_and_righting_arm(excitation):
    """Thrust of another size, or a centre of buoyancy of another height, makes forces, heights and
    coefficients seem larger: by 20 of their standard deviations (rms), and up to 130, for one who
    takes both for known."""
    off, off_if_known = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        conditions = dataclasses.replace(MINUTE, excitation=excitation)
        case = draw(seed, conditions=conditions)
        streams, raw = streams_of(case), to_parameters(case.config)
        scale = 1.0 + 0.15 * np.clip(rng.standard_normal(), -2.0, 2.0)
        raw["vehicle"]["cob"][2] -= 0.001 * rng.standard_normal()
        raw["vehicle"]["cob_std"], raw["wrench"] = 0.001, {**raw["wrench"], "scale_std": 0.15}
        config = from_parameters(raw)
        read = dataclasses.replace(streams, demand=streams.demand / scale)
        keys = {(COEFFICIENTS, name): v for name, v in config.model.values.items()}
        keys |= {("buoyancy", "delta"): 0.0, ("cog_offset", "dz"): 0.0}
        problem = WindowedProblem(read, thinned(windows(0.0, read.duration)))
        fitted = fit(problem, Hypothesis(config, keys))
        for covariance, into in (
            (fitted.covariance + fitted.covariance_of_the_file, off),
            (fitted.covariance, off_if_known),
        ):
            for name, value in parameters_of(fitted, list(keys), covariance).items():
                into.append((value.value - case.theta.get(name, 0.0)) / value.std)
    assert np.sqrt(np.mean(np.square(off))) < 1.2
    assert np.mean(np.abs(off) < 1.96) > 0.9
    assert np.max(np.abs(off)) < 4.0
    assert np.sqrt(np.mean(np.square(off_if_known))) > 5.0


@pytest.mark.parametrize("seed", [2, *more(3, 5)])
def test_rates_of_a_gyro_with_another_scale_are_set_right(seed):
    """The odometry copies its angular velocities from a gyro that reads 1 to 3 % too much; it was a
    velocity sensor some ms late, surely."""
    rng = np.random.default_rng(seed)
    case = draw(seed, conditions=MINUTE)
    streams, scale = streams_of(case), 1.0 + rng.uniform(0.01, 0.03)
    nu = streams.nu * np.where(np.arange(6) < 3, 1.0, scale)
    read = dataclasses.replace(streams, nu=nu, gyro=scale * streams.gyro)
    findings = explain([read], case.config).findings
    assert findings.effects == ()
    (note,) = [n for n in findings.notes if "angular velocities are not" in n]
    told = [float(part.split()[1]) for part in note.split(": ")[1].split("too much")[0].split(", ")]
    assert told == pytest.approx([100.0 * (scale - 1.0)] * 3, abs=0.3)


@pytest.mark.parametrize("seed", [3, *more(2, 5, 7)])
def test_what_is_written_is_what_was_judged(seed):
    """The wrench's clock runs 0.2 % slow: no delay suits the whole dive. It was left out of a file
    that was judged with it: the error told was half of that with the file."""
    case = draw(seed, conditions=Conditions(duration=120.0, excitation="pilot"))
    streams = streams_of(case)
    drifting = dataclasses.replace(streams, demand_t=0.998 * streams.demand_t)
    found = explain([drifting], case.config)
    named = {f.effect for f in found.findings.effects if not EFFECTS[f.effect].of_sensors}
    assert not any(f.separable for f in found.findings.effects)
    assert named - set(found.extended.effects) <= {"asymmetric_damping"}  # that is coefficients
    again = explain([drifting], found.extended).findings
    for velocity, error in found.findings.extended.items():
        assert again.baseline[velocity] == pytest.approx(error, rel=0.5)


def test_a_moment_that_an_attitude_off_by_a_milliradian_makes_is_not_left():
    case = draw(2, conditions=dataclasses.replace(MINUTE, duration=100.0, excitation="pilot"))
    streams, rng = streams_of(case), np.random.default_rng(2)
    keep = np.exp(-np.diff(streams.t).mean() / 20.0)
    kicks = np.sqrt(1.0 - keep**2) * rng.standard_normal((len(streams.t), 3))
    wander = 1e-3 * lfilter([1.0], [1.0, -keep], kicks, axis=0)
    turned = quaternion_multiply(streams.orientation, quaternion_from_rotation_vector(wander))
    findings = explain([dataclasses.replace(streams, orientation=turned)], case.config).findings
    assert findings.residual == ()
    assert findings.verdict != "unexplained"


def test_what_is_left_is_told():
    """Tugs at the bow that nothing measures: no fit predicts the yaw, so nothing is right."""
    case = draw(2, conditions=MINUTE)
    streams = streams_of(case)
    before = explain([streams], case.config).findings
    assert not any("is left" in note for note in before.notes)
    tugs = lfilter([1.0], [1.0, -0.98], np.random.default_rng(2).normal(size=len(streams.demand)))
    demand = streams.demand.copy()
    demand[:, 5] += demand[:, 5].std() * tugs / tugs.std()
    findings = explain([dataclasses.replace(streams, demand=demand)], case.config).findings
    assert findings.verdict == "unexplained"
    assert any("is left" in note and "yaw rate" in note for note in findings.notes)
    assert findings.residual  # the contract: it is the finding


# ------------------------------------------------------------------ sensors


NO_IMU = dataclasses.replace(LEAN, imu_rate=0.0)


@pytest.mark.parametrize("yaw", [0.3, *more(-0.6)])
def test_a_heading_set_to_zero_is_no_mounting(heavy, yaw):
    """Without an IMU only the thrust can tell, on a vehicle that is level."""
    rng = np.random.default_rng(7)
    world, config = world_and_belief(heavy, "heading_offset", {"yaw": yaw}, {}, rng)
    findings = findings_of(world, config, NO_IMU, 3)
    assert [f.effect for f in findings.effects] == ["heading_offset"]
    assert findings.effects[0].parameters["yaw"].value == pytest.approx(yaw, abs=0.02)


@pytest.mark.parametrize("yaw", [0.3, *more(-0.15)])
def test_a_mounting_is_no_heading(heavy, yaw):
    rng = np.random.default_rng(8)
    mounting = {"roll": 0.03, "pitch": -0.04, "yaw": yaw}
    world, config = world_and_belief(heavy, "sensor_misalignment", mounting, {}, rng)
    findings = findings_of(world, config, NO_IMU, 3)
    assert [f.effect for f in findings.effects] == ["sensor_misalignment"]
    assert findings.effects[0].separable
    assert findings.effects[0].parameters["yaw"].value == pytest.approx(yaw, abs=0.02)


def test_a_correction_that_the_thrust_refutes_is_not_applied(heavy):
    """Positions too large by a tenth: the sensors would agree with a scale of the velocities."""
    run = dive(heavy, "steps", 60.0, NO_IMU, 4)
    messages = [
        (r, m._replace(position=1.1 * m.position) if r == "odom" else m) for _, r, m in run.messages
    ]
    given = to_parameters(heavy)
    known = from_parameters({**given, "estimate": ["X_uu"]})  # the rest of the model is known
    findings = explain([gather(messages, known)], known).findings
    assert findings.effects == ()
    assert any("velocity_scale" in note and "not applied" in note for note in findings.notes)


# ------------------------------------------------------------------ noise of the reading


@pytest.mark.study
@pytest.mark.parametrize("seed", [4, 8, 9, 11])
def test_noise_of_the_reading_is_not_taken_for_a_fault(seed):
    """Bags of which a dead band, a gain or a centre of gravity was named before."""
    case = draw(seed, conditions=NOISY)
    findings = explain([streams_of(case)], case.config).findings
    assert [f.effect for f in findings.effects if f.effect != "wrench_noise"] == []


def test_noise_of_the_reading_is_named_with_its_size():
    case = draw(2, conditions=dataclasses.replace(NOISY, duration=75.0))
    explanation = explain([streams_of(case)], case.config)
    found, *others = explanation.findings.effects
    assert found.effect == "wrench_noise" and found.separable
    assert not any(f.separable for f in others)  # nothing else is taken for a cause of it
    for name, value in found.parameters.items():
        assert value.value == pytest.approx(0.06 if name[-1] in "KMN" else 0.5, rel=0.2)
    assert "wrench_noise" in explanation.extended.effects


@pytest.mark.parametrize("seed", [0, *more(1)])
def test_a_dead_band_is_found_beside_noise_of_the_reading(seed):
    conditions = dataclasses.replace(NOISY, duration=90.0, excitation="steps")
    case = draw(seed, ("thruster_deadband",), 1.0, conditions=conditions)
    findings = explain([streams_of(case)], case.config).findings
    assert findings.effects[0].effect == "thruster_deadband"
    for name, width in case.effects["thruster_deadband"].items():
        assert findings.effects[0].parameters[name].value == pytest.approx(width, rel=0.2)


def test_noise_is_measured_where_commands_rest():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 120.0, 0.02)
    steps = np.where((t / 3.0).astype(int)[:, None] % 2 == 0, 0.0, np.full((len(t), 6), 20.0))
    assert not resting_noise(steps).any()
    std = np.array([0.5, 1.0, 0.2, 0.05, 0.1, 0.02])
    noise = std * rng.standard_normal(steps.shape)
    np.testing.assert_allclose(resting_noise(steps + noise), std, rtol=0.2)
    assert not resting_noise(steps[:20]).any()


# ------------------------------------------------------------------ what is written


def test_an_axis_on_which_what_was_found_loses_stays_as_it_was(heavy):
    """Surge found rightly, sway wrongly: sway keeps the coefficients of the file."""
    run = dive(heavy, "steps", 60.0, Suite(), 6)
    theta = dict(zip(heavy.model.names, heavy.model.theta.tolist()))
    off = theta | {"X_uu": 0.6 * theta["X_uu"], "Y_vv": 0.9 * theta["Y_vv"]}
    config = from_parameters({**to_parameters(heavy), "coefficients": off})
    streams = gather(((r, m) for _, r, m in run.messages), config)
    judge = Judge(WindowedProblem(streams, split(streams.duration)[1]))
    right, wrong = (COEFFICIENTS, "X_uu"), (COEFFICIENTS, "Y_vv")
    given = Hypothesis(config, {})
    before = extension.AsGiven(judge, judge.summed(given))
    found = Hypothesis(config, {right: theta["X_uu"], wrong: 0.5 * theta["Y_vv"]})
    kept = extension.kept(before, before, found)
    assert kept.axes == ("Y",) and kept.model.values == {right: theta["X_uu"]}
    assert "Y" in kept.note
    assert extension.kept(before, before, found.having({wrong: theta["Y_vv"]})).axes == ()
    both = found.having({right: 0.3 * theta["X_uu"]})
    assert extension.kept(before, before, both).model.values == {}
    lagging = {("thruster_lag", "time_constant"): 0.5}
    assert extension.kept(before, before, both.having(lagging)).model is None
    excused = extension.AsGiven(judge, 100.0 * before.errors)  # by weights that suit what was found
    assert extension.kept(excused, excused, found).axes == ()
    assert extension.kept(excused, before, found).axes == ("Y",)


@pytest.mark.parametrize("seed", [5, *more(1, 2, 3, 4, 6)])
def test_thrusters_that_push_less_astern_are_no_property_of_the_hull(seed):
    """Each propeller by itself, of which the wrench shows only the sum along each axis: drag that
    differs ahead and astern, lift and dead bands were named for it, surely."""
    file = SHIPPED
    raw = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]["thrusters"]
    position, direction = (np.reshape(raw[key], (-1, 3)) for key in ("position", "direction"))
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    allocation = np.vstack([direction.T, np.cross(position, direction).T])
    astern, config = np.random.default_rng(seed).uniform(0.7, 0.85), load(HEAVY)
    suite, messages = Suite(odometry_rate=10.0, imu_rate=50.0), []
    for _, role, message in dive(config, "steps", 120.0, suite, seed).messages:
        if role == WRENCH:
            acting = np.linalg.pinv(allocation) @ [*message.force, *message.torque]
            read = allocation @ np.where(acting < 0.0, acting / astern, acting)
            message = message._replace(force=read[:3], torque=read[3:])
        messages.append((role, message))
    findings = explain([gather(messages, config)], config).findings
    assert {f.effect for f in findings.effects if f.separable} <= {"thruster_asymmetry"}
