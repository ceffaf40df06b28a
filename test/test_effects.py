"""What every effect must keep, over all that there are; then each against its own equation.

The equations of :data:`FORMS` are written here, in NumPy and scipy alone.
"""

import dataclasses
import math

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation
from textbook import finned, steered_dive
from tiers import more

from rov_ident import config as configuration
from rov_ident import effects
from rov_ident.config.prior import prior_of
from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_to_matrix
from rov_ident.effects import EFFECTS, compiled
from rov_ident.effects.base import SIZE, Array, Effect, Reading
from rov_ident.estimation import rls, ukf
from rov_ident.model.coefficients import INPUTS, parse
from rov_ident.model.equations import RigidBody, build
from rov_ident.sampling import records
from rov_ident.sampling.records import predicted, score
from rov_ident.sampling.sample import joined
from rov_ident.simulation import virtual_sensors as sensors
from rov_ident.simulation.open_loop import simulate

AXES = "XYZKMN"
HOOKS = ("coefficients", "body", "wrench", "water", "act", "steer", "sense", "late", "heading")
CONTRACT = {
    "quadratic_damping": "", "linear_damping": "", "asymmetric_damping": "", "coupled_damping": "",
    "lift": "", "added_mass_coupling": "", "buoyancy": "delta", "cog_offset": "dx dy dz",
    "payload": "mass_wet x y z onset", "ocean_current": "north east down",
    "wave": "fx fy fz frequency phase", "tether_drag": "k x y z", "constant_force": "fx fy fz",
    "thruster_gain": "gain_X gain_Y gain_Z gain_K gain_M gain_N",
    "thrust_scale": "scale",
    "thruster_asymmetry": "gain_X gain_Y gain_Z gain_K gain_M gain_N",
    "thruster_deadband": "width_X width_Y width_Z width_K width_M width_N",
    "thruster_lag": "time_constant", "actuation_delay": "delay",
    "thruster_failure": "gain_X gain_Y gain_Z gain_K gain_M gain_N onset",
    "battery_resistance": "loss", "battery_sag": "end_loss", "sensor_lever_arm": "x y z",
    "sensor_misalignment": "roll pitch yaw", "velocity_scale": "scale",
    "imu_bias": "ax ay az gx gy gz", "velocity_latency": "delay", "heading_offset": "yaw",
    "wrench_noise": "std_X std_Y std_Z std_K std_M std_N",
    "thrust_line": "arm_Y_K arm_Z_K arm_X_M arm_Z_M arm_X_N arm_Y_N",
    "thrust_advance": "k", "coriolis": "", "crossflow": "", "fin_lift": "",
    "fin_offset": "delta_s delta_r delta_a", "fin_lag": "time_constant",
    "fin_saturation": "delta_s delta_r delta_a rate",
    "empirical": "scale axis first second first_low first_high second_low second_high",
    "thruster_saturation": "limit_X limit_Y limit_Z limit_K limit_M limit_N",
    "thrust_curve": " ".join(f"curvature_{axis}" for axis in AXES),
}  # fmt: skip

CURRENT_ALONG = {"ocean_current": {"north": 0.3, "east": 0.0, "down": 0.0}}
WITH_PARAMETERS = [e for e in EFFECTS.values() if not e.coefficients]
INPUT = [e for e in EFFECTS.values() if e.act]
STEER = [e for e in EFFECTS.values() if e.steer]
WRENCH = [e for e in EFFECTS.values() if e.wrench]
SENSOR = [e for e in EFFECTS.values() if e.sense]

every_effect = pytest.mark.parametrize("effect", EFFECTS.values(), ids=EFFECTS)
every_parametric = pytest.mark.parametrize("effect", WITH_PARAMETERS, ids=lambda e: e.name)
EXACT = [e for e in WITH_PARAMETERS if not e.noise]  # noise is lost
every_input = pytest.mark.parametrize("effect", INPUT, ids=lambda e: e.name)
every_steer = pytest.mark.parametrize("effect", STEER, ids=lambda e: e.name)
every_wrench = pytest.mark.parametrize("effect", WRENCH, ids=lambda e: e.name)
every_sensor = pytest.mark.parametrize("effect", SENSOR, ids=lambda e: e.name)


# Of the empirical effect: heave by pitch rate and depth.
SHAPE = {
    "axis": 2.0, "first": 5.0, "second": 12.0, "first_low": -0.4, "first_high": 0.5,
    "second_low": -1.0, "second_high": 2.0,
}  # fmt: skip


def at_null(effect: Effect) -> dict[str, float]:
    return {p.name: p.null for p in effect.parameters}


def typical(effect: Effect, rng: np.random.Generator | None = None) -> dict[str, float]:
    """Parameters at which the effect matters, in the first seconds; all different with ``rng``."""
    values = {}
    for p in effect.parameters:
        share = 1.0 if rng is None else rng.uniform(0.5, 2.0)
        values[p.name] = {
            "onset": 4.0 * share,
            "frequency": p.typical * share,
            "fixed": 15.0 * share,
            "limit": p.typical * share,
            "shape": SHAPE.get(p.name, 0.3 * share if p.axis else 8.0 * share - 6.0),
        }.get(p.role, p.null + share * p.typical)
    return values


def choices(effect: Effect) -> list[dict[str, float]]:
    """All parameters through their ranges together, then each alone with the others at null."""
    shares = (0.0, 0.01, 0.1, 0.5, 1.0)
    null = at_null(effect)
    ranges = {
        p.name: [p.lower + f * (p.upper - p.lower) for f in shares] for p in effect.parameters
    }
    together = [dict(zip(ranges, values)) for values in zip(*ranges.values())]
    alone = [null | {name: value} for name, values in ranges.items() for value in values]
    return [null, *together, *alone]


# ------------------------------------------------------------------ what an effect says of itself


def test_the_library_has_every_effect_of_the_contract():
    for name, parameters in CONTRACT.items():
        names = [p.name for p in EFFECTS[name].parameters]
        assert names[: len(parameters.split())] == parameters.split()
    assert "base" not in EFFECTS


@every_effect
def test_the_name_is_that_of_the_file_and_everything_is_said(effect):
    assert EFFECTS[effect.name] is effect
    assert effect.place in ("input", "motion", "wrench")
    assert effect.summary.endswith(".")
    assert effect.source
    assert bool(effect.parameters) != bool(effect.coefficients)
    assert all(p.name and p.unit and p.meaning for p in effect.parameters)
    assert len({p.name for p in effect.parameters}) == len(effect.parameters)
    assert len(effect.parameters) <= SIZE


@every_effect
def test_it_enters_by_exactly_one_hook_of_its_place(effect):
    used = [hook for hook in HOOKS if getattr(effect, hook)]
    assert len(used) == 1
    places = dict.fromkeys(("sense", "water", "late", "heading"), "motion")
    places |= dict.fromkeys(("act", "steer"), "input")
    assert effect.place == places.get(used[0], "wrench")
    assert (effect.sense is None) == (effect.correct is None)


@every_effect
def test_coefficients_are_names_of_the_grammar(effect):
    assert len({parse(name).place for name in effect.coefficients}) == len(effect.coefficients)


@every_parametric
def test_bounds_are_finite_and_contain_null_and_typical(effect):
    """The null may lie on a bound: where an effect ends, the search begins."""
    for p in effect.parameters:
        assert math.isfinite(p.lower) and math.isfinite(p.upper)
        assert p.lower < p.upper
        assert p.lower <= p.null <= p.upper
        assert p.typical > 0.0
        assert p.null + p.typical <= p.upper or p.null - p.typical >= p.lower
        assert p.axis == (p.name[-1] if p.name[-2:-1] == "_" and p.name[-1] in AXES else "")
        assert p.input == (p.name if p.name in INPUTS else "")
    assert any(p.role in ("amplitude", "limit") for p in effect.parameters)


# ------------------------------------------------------------------ in simulation and samples


@pytest.fixture(scope="module")
def mounted(heavy):
    """Sensors away from the origin and turned, so that nothing hides in a zero."""
    return dataclasses.replace(
        heavy,
        odometry=dataclasses.replace(heavy.odometry, position=(0.1, -0.05, 0.15)),
        imu=dataclasses.replace(heavy.imu, position=(-0.1, 0.02, 0.05), rotation=(0.3, -0.2, 1.0)),
    )


def with_fins(effect, config):
    """The vehicle, with fins where the effect is on them."""
    return finned(config) if effect.steer else config


def simulated(config, values, duration=12.0, noise=0.0):
    config = dataclasses.replace(config, effects=values)
    return steered_dive(config, duration, sensors.Suite().scaled(noise), 5)


def samples_of(config, dive):
    return joined(list(records.samples_of(config, dive)))


@pytest.fixture(scope="module")
def without(mounted):
    """The dive without any effect, with fins or not."""
    return {fins: simulated(finned(mounted) if fins else mounted, {}) for fins in (False, True)}


@pytest.fixture(scope="module")
def samples_without(mounted, without):
    """The samples of these dives."""
    return {
        fins: samples_of(finned(mounted) if fins else mounted, dive)
        for fins, dive in without.items()
    }


def content(dive):
    """All numbers of the messages."""
    return np.concatenate(
        [
            np.ravel(value)
            for _, _, message in dive.messages
            for value in message
            if not isinstance(value, str | tuple)
        ]
    )


@every_parametric
def test_at_null_nothing_changes_to_the_last_bit(effect, mounted, without, samples_without):
    null, vehicle = {effect.name: at_null(effect)}, with_fins(effect, mounted)
    dive, plain = simulated(vehicle, null), without[bool(effect.steer)]
    np.testing.assert_array_equal(content(dive), content(plain))
    samples = samples_of(dataclasses.replace(vehicle, effects=null), dive)
    expected = samples_without[bool(effect.steer)]
    for name in samples.dtype.names:
        np.testing.assert_array_equal(samples[name], expected[name], err_msg=name)


def largest(p, dive):
    """Of what is demanded where a parameter limits it; of a rate, for fins of 0.3 rad at 0.6 Hz."""
    if p.axis:
        return np.abs(dive.demand[:, AXES.index(p.axis)]).max()
    return 0.3 if p.input else 0.3 * 2.0 * np.pi * 0.6


@every_parametric
def test_close_to_null_little_changes(effect, mounted, without):
    """No jump at the null: a search may pass through it."""
    near, plain = at_null(effect), without[bool(effect.steer)]
    little = 1e-3 if effect.steer else 1e-6  # of what fins do, 1e-6 is lost in single precision
    for p in effect.parameters:
        if p.role == "amplitude":
            near[p.name] += little * p.typical * (1 if p.null < p.upper else -1)
        elif p.role == "shape":
            near[p.name] = typical(effect)[p.name]
        elif p.role == "limit":  # it has its null wherever no command reaches it
            near[p.name] = (1.0 - little) * largest(p, plain)
    difference = content(simulated(with_fins(effect, mounted), {effect.name: near}))
    difference = np.abs(difference - content(plain))
    assert 0.0 < difference.max() < 1e-2


@pytest.mark.parametrize("effect", EXACT, ids=lambda e: e.name)
def test_with_the_effect_samples_show_the_truth_and_without_they_do_not(effect, mounted):
    """Out of the simulator, into the sampler: open-loop simulation of the samples agrees."""
    values = {effect.name: typical(effect, np.random.default_rng(1))}
    known = CURRENT_ALONG if effect.heading else {}  # else no motion depends on the heading
    vehicle = with_fins(effect, mounted)
    dive = simulated(vehicle, values | known)
    errors = []
    for told in (values | known, known):
        config = dataclasses.replace(vehicle, effects=told)
        rows = samples_of(config, dive)
        result = score(rows, predicted(config.dynamics, rows, 5.0, effects=compiled(told)))
        errors.append(result.rmse)
    informed, ignorant = np.array(errors)
    # What is left with the effect known: sensors in single precision, wrench between two samples.
    assert np.all(informed < [2e-3, 2e-3, 2e-3, 8e-3, 8e-3, 3e-3])
    assert np.any(ignorant > 4.0 * informed)


@every_parametric
def test_a_configuration_with_the_effect_is_written_and_read_again(effect, heavy, tmp_path):
    values = {effect.name: typical(effect, np.random.default_rng(2))}
    config = dataclasses.replace(heavy, effects=values)
    configuration.dump(config, tmp_path / "extended.yaml")
    again = configuration.load(tmp_path / "extended.yaml")
    assert again.effects == values
    body, expected = again.model.body, heavy.model.body
    assert (body.buoyancy, *body.cog) == (expected.buoyancy, *expected.cog)
    np.testing.assert_array_equal(again.dynamics.body.restoring, config.dynamics.body.restoring)


FIFTH = [(e, (rls, ukf)[i % 2]) for i, e in enumerate(WITH_PARAMETERS) if i % 5 == 0 or e.noise]


@pytest.mark.parametrize(
    ("effect", "estimator"),
    [
        *FIFTH,  # samples of all are the truth (above), and are folded alike whatever acts
        *more(
            *((e, kind) for e in WITH_PARAMETERS for kind in (rls, ukf) if (e, kind) not in FIFTH)
        ),
    ],
    ids=lambda value: value.name if isinstance(value, Effect) else value.__name__.split(".")[-1],
)
def test_coefficients_are_found_whatever_acts_besides(effect, estimator, mounted):
    """From a configuration off by up to 50 %, the effect known: as well as without it."""
    values = {effect.name: typical(effect, np.random.default_rng(1))}
    vehicle = with_fins(effect, mounted)
    dive = simulated(vehicle, values, duration=40.0, noise=1.0)
    config, true = dataclasses.replace(vehicle, effects=values), vehicle.model
    factors = np.random.default_rng(3).uniform(0.5, 1.5, len(true.theta))
    config = config.with_model(true.with_theta(true.theta * factors))
    task = estimator.problem(config)
    state, _ = estimator.fold(task, estimator.init(task), samples_of(config, dive))
    found = estimator.estimate(task, state, prior_of(config))
    error = (found.values - true.theta) / found.std
    assert np.sqrt(np.mean(error**2)) < 2.5
    assert np.median(found.std / prior_of(config).std) < 0.2


def test_all_effects_at_once(mounted):
    """They do not get into one another's way."""
    values = {e.name: typical(e, np.random.default_rng(3)) for e in EXACT}
    config = dataclasses.replace(finned(mounted), effects=values)
    dive = simulated(config, values)
    rows = samples_of(config, dive)
    result = score(rows, predicted(config.dynamics, rows, 5.0, effects=compiled(values)))
    assert np.all(result.rmse < [3e-3, 3e-3, 3e-3, 2e-2, 2e-2, 5e-3])


# ------------------------------------------------------------------ effects on the input

DEMANDS = np.array(
    [
        [-10.0, 20.0, 15.0, 0.0, 3.0, 5.0],
        [40.0, -30.0, 0.0, 1.0, -2.0, 5.0],
        [-10.0, 20.0, 15.0, 0.0, 3.0, 5.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [80.0, -3.0, -90.0, 4.0, 7.0, -1.0],
    ]
)


def run(effect: Effect, t: Array, demands: Array, **parameters: float) -> Array:
    """What acts (n, 6) from each t (n + 1,) to the next."""
    acting, state, out = compiled({effect.name: parameters}), effects.memory(), []
    for begin, end, demand in zip(t[:-1], t[1:], demands, strict=True):
        wrench = demand.copy()
        effects.act(acting, state, begin, end - begin, wrench)
        out.append(wrench)
    return np.array(out)


@every_input
@pytest.mark.parametrize("dt", [0.002, 0.1, 10.0])
def test_at_null_what_is_demanded_acts(effect, dt):
    t = dt * np.arange(len(DEMANDS) + 1)
    np.testing.assert_array_equal(run(effect, t, DEMANDS, **at_null(effect)), DEMANDS)


@every_input
def test_what_acts_is_finite(effect):
    for parameters in choices(effect):
        t = np.array([0.0, 0.0, 1e-6, 0.02, 3600.0, 1e6])
        assert np.isfinite(run(effect, t, DEMANDS, **parameters)).all()


@every_input
@pytest.mark.parametrize("parts", [2, 7])
def test_the_mean_does_not_depend_on_how_often_it_is_asked_for(effect, parts):
    t = 0.3 * np.arange(len(DEMANDS) + 1)
    fine = np.linspace(t[:-1], t[1:], parts, endpoint=False).T.ravel()
    fine = np.append(fine, t[-1])
    for parameters in [typical(effect, np.random.default_rng(4)), *choices(effect)]:
        whole = run(effect, t, DEMANDS, **parameters)
        split = run(effect, fine, np.repeat(DEMANDS, parts, axis=0), **parameters)
        means = split.reshape(-1, parts, 6).mean(axis=1)
        np.testing.assert_allclose(means, whole, rtol=1e-9, atol=1e-9 * np.abs(whole).max())


@every_input
def test_an_instant_without_length_changes_nothing_later(effect):
    t = np.array([0.0, 0.3, 0.3, 0.6, 0.9])
    parameters = typical(effect, np.random.default_rng(5))
    through = run(effect, t, DEMANDS[[0, 1, 1, 2]], **parameters)
    directly = run(effect, np.delete(t, 2), DEMANDS[[0, 1, 2]], **parameters)
    np.testing.assert_allclose(np.delete(through, 1, axis=0), directly, rtol=1e-12, atol=1e-12)


def test_input_effects_act_one_after_the_other(heavy):
    """Delayed, dead below the width, weaker astern, amplified, in part lost, sagging, lagged."""
    order = (
        "wrench_noise actuation_delay thruster_deadband thruster_asymmetry thrust_scale "
        "thruster_gain thruster_failure battery_sag thrust_curve battery_resistance "
        "thruster_saturation thruster_lag"
    )
    assert [e.name for e in sorted(INPUT, key=lambda e: e.order)] == order.split()
    t = np.linspace(0.0, 1.5, 301)
    demands = np.repeat(DEMANDS, 60, axis=0)
    chosen = {name: typical(EFFECTS[name], np.random.default_rng(6)) for name in order.split()}
    expected = demands
    for name in order.split():
        expected = run(EFFECTS[name], t, expected, **chosen[name])
    acting = effects.acted(compiled(chosen), t, np.vstack([demands, demands[-1:]]))
    # A delay gives means of two demands within a step, and the others treat them as one.
    np.testing.assert_allclose(acting[:-1], expected, rtol=1e-12, atol=1e-12)


# ------------------------------------------------------------------ effects on fins


def read_of_fins(rng, n=300):
    """Steps dt (n,) [s], and means and ends (n, 4) of angles that change in straight lines."""
    dt = rng.uniform(0.005, 0.02, n)
    t = np.append(0.0, np.cumsum(dt))[:, None]
    knots = 0.35 * np.sin(2.0 * np.pi * rng.uniform(0.5, 0.8, 4) * t)
    knots += 0.002 * np.cumsum(rng.standard_normal((n + 1, 4)), axis=0)
    knots[1] = knots[0]  # they begin at rest
    return dt, 0.5 * (knots[1:] + knots[:-1]), knots


def acting_fins(dt, knots, follow):
    """Means (n, 4) of fins that ``follow(read, fin, h)`` moves in 400 small steps to each."""
    fin, out, small = knots[0].copy(), [], 400
    for length, a, b in zip(dt, knots[:-1], knots[1:], strict=True):
        total = np.zeros(4)
        for k in range(small):
            before = fin
            fin = follow(a + (b - a) * (k + 0.5) / small, fin, length / small)
            total += 0.5 * (before + fin) / small
        out.append(total)
    return np.array(out)


def late_fins(dt, knots, time_constant):
    def follow(read, fin, h):
        return fin + (read - fin) * (1.0 - math.exp(-h / time_constant))

    return acting_fins(dt, knots, follow)


def limited_fins(dt, knots, rate, **limits):
    most = np.array([*limits.values(), np.inf])

    def follow(read, fin, h):
        return fin + np.clip(np.clip(read, -most, most) - fin, -rate * h, rate * h)

    return acting_fins(dt, knots, follow)


STEER_FORMS = {
    "fin_offset": lambda dt, knots, **by: 0.5 * (knots[1:] + knots[:-1]) + [*by.values(), 0.0],
    "fin_lag": late_fins,
    "fin_saturation": limited_fins,
}


@every_steer
def test_equations_of_fins(effect):
    rng = np.random.default_rng(9)
    dt, means, knots = read_of_fins(rng)
    parameters = typical(effect, rng)
    found = effects.steered(compiled({effect.name: parameters}), dt, means, knots[1:])
    expected = STEER_FORMS[effect.name](dt, knots, **parameters)
    np.testing.assert_array_equal(found[:, 3], means[:, 3])  # the propeller is no fin
    # a limit reached within a step counts as reached evenly over it
    np.testing.assert_allclose(found[:, :3], expected[:, :3], atol=1e-3)
    assert np.abs(found - means)[:, :3].max() > 0.01


@every_steer
def test_fins_at_null_are_where_they_are_read_and_finite_whatever_the_parameters(effect):
    dt, means, knots = read_of_fins(np.random.default_rng(10))
    dt[5] = 0.0
    found = effects.steered(compiled({effect.name: at_null(effect)}), dt, means, knots[1:])
    np.testing.assert_array_equal(found, means)
    for parameters in choices(effect):
        acting = compiled({effect.name: parameters})
        assert np.isfinite(effects.steered(acting, dt, means, knots[1:])).all()


# ------------------------------------------------------------------ their equations


def delayed(t: Array, demands: Array, delay: float) -> Array:
    """By the impulse that was demanded until an instant: piecewise straight lines."""
    edges = np.append(-100.0, t)
    impulse = np.vstack(
        [
            np.zeros(6),
            np.cumsum(np.diff(edges)[:, None] * np.vstack([demands[:1], demands]), axis=0),
        ]
    )
    given = [np.interp(t - delay, edges, column) for column in impulse.T]
    return np.diff(given, axis=1).T / np.diff(t)[:, None]


def lagged(t: Array, demands: Array, time_constant: float) -> Array:
    """``demand + (before - demand) exp(-t/T)``, its integral over each step."""
    state, out = demands[0], []
    for dt, demand in zip(np.diff(t), demands, strict=True):
        left = math.exp(-dt / time_constant)
        out.append(demand + (state - demand) * time_constant * (1.0 - left) / dt)
        state = demand + (state - demand) * left
    return np.array(out)


def failed(t: Array, demands: Array, onset: float, **gains: float) -> Array:
    """By the matrix of one thruster that fails, and those of the axes."""
    after = np.clip((t[1:] - onset) / np.diff(t), 0.0, 1.0)[:, None]
    push, share = (np.array([gains[f"{of}_{axis}"] for axis in AXES]) for of in ("push", "share"))
    lost = (1.0 - gains["gain"]) * np.outer(push, share)
    axes = np.diag([gains[f"gain_{axis}"] for axis in AXES])
    return (1.0 - after) * demands + after * (demands @ (axes - lost).T)


def sagging(t: Array, demands: Array, end_loss: float, duration: float) -> Array:
    """By the integral of min(t, duration)."""
    passed = np.where(t < duration, 0.5 * t**2, duration * t - 0.5 * duration**2)
    mean = np.diff(passed) / np.diff(t)
    return demands * (1.0 - end_loss * mean / duration)[:, None]


def loaded(t: Array, demands: Array, loss: float) -> Array:
    """By the current of a battery, which grows with thrust^1.5."""
    shares = np.abs(demands) / np.repeat([50.0, 10.0], 3)
    current = np.sum(shares**1.5, axis=1, keepdims=True)
    return demands * np.clip(1.0 - loss * current, 0.0, 1.0)


def bent(t: Array, demands: Array, **curvatures: float) -> Array:
    """Either branch by itself, and which of them acts by the sign."""
    x = np.abs(demands) / np.repeat([50.0, 10.0], 3) * of_axes(curvatures)
    return demands * np.where(x > 0.0, 1.0 / (1.0 + np.abs(x)), 1.0 + np.abs(x))


def of_axes(values: dict[str, float]) -> Array:
    return np.array(list(values.values()))


INPUT_FORMS = {
    "actuation_delay": delayed,
    "thruster_lag": lagged,
    "thruster_failure": failed,
    "battery_sag": sagging,
    "battery_resistance": loaded,
    "thruster_gain": lambda t, d, **gains: d * of_axes(gains),
    "wrench_noise": lambda t, d, **std: np.where(np.abs(d) <= 3.0 * of_axes(std), 0.0, d),
    "thruster_saturation": lambda t, d, **limits: (
        np.sign(d) * np.minimum(np.abs(d), of_axes(limits))
    ),
    "thrust_scale": lambda t, d, scale: d * scale,
    "thrust_curve": bent,
    "thruster_asymmetry": lambda t, d, **gains: np.where(d < 0.0, d * of_axes(gains), d),
    "thruster_deadband": lambda t, d, **widths: (
        np.sign(d) * np.maximum(np.abs(d) - of_axes(widths), 0.0)
    ),
}


@every_input
@pytest.mark.parametrize("seed", range(5))
def test_input_equations(effect, seed):
    rng = np.random.default_rng([7, seed])
    n = 400
    t = np.append(0.0, np.cumsum(rng.uniform(0.002, 0.05, n)))
    demands = np.repeat(rng.normal(size=(n // 4, 6)) * 20.0, 4, axis=0)
    parameters = typical(effect, rng)
    expected = INPUT_FORMS[effect.name](t, demands, **parameters)
    found = run(effect, t, demands, **parameters)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert np.abs(found - demands).max() > 0.1


def test_the_longest_delay_at_the_highest_rate_is_still_exact():
    """Demands that change at 200 Hz, asked for twice in between: all fit into the memory."""
    delay = EFFECTS["actuation_delay"].parameters[0].upper
    rng = np.random.default_rng(8)
    demands = np.repeat(rng.normal(size=(600, 6)), 3, axis=0)
    t = np.arange(len(demands) + 1) / 600.0
    found = run(EFFECTS["actuation_delay"], t, demands, delay=delay)
    np.testing.assert_allclose(found, delayed(t, demands, delay), atol=1e-9)


def test_with_more_changes_than_fit_the_delay_gets_shorter_and_nothing_else():
    demands = np.random.default_rng(9).normal(size=(3000, 6))
    t = np.arange(len(demands) + 1) / 1000.0
    found = run(EFFECTS["actuation_delay"], t, demands, delay=0.5)
    room = (effects.base.MEMORY - 1) // 7
    np.testing.assert_allclose(found[1000:], demands[1001 - room : -room + 1], atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_a_reading_moves_nothing_and_is_taken_back_at_rest(mounted, seed):
    std = typical(EFFECTS["wrench_noise"], np.random.default_rng(seed))
    config = dataclasses.replace(mounted, effects={"wrench_noise": std})
    t = np.arange(0.0, 20.0, 0.02)
    demand = np.where((t < 10.0)[:, None], 0.0, 20.0 * of_axes(std))
    args = (t, demand, 20.0, sensors.Suite().scaled(0.0))
    read, quiet = (
        sensors.measure(c, *args, np.random.default_rng(seed)) for c in (config, mounted)
    )
    np.testing.assert_array_equal(read.truth.nu, quiet.truth.nu)
    wrench = np.array([np.hstack(m[2:]) for _, role, m in read.messages if role == "wrench"])
    np.testing.assert_allclose((wrench - demand).std(axis=0), of_axes(std), rtol=0.1)
    acting = samples_of(config, read)
    resting = np.abs(acting["wrench"][acting["t"] < 9.9])
    assert np.mean(resting == 0.0) > 0.98
    np.testing.assert_allclose(
        acting["wrench"][acting["t"] > 10.1].mean(axis=0), 20.0 * of_axes(std), rtol=0.02
    )


def test_lag_reaches_63_percent_after_its_time_constant():
    t = np.array([0.0, 1.0, 1.24, 1.2400001])
    demands = np.array([np.zeros(6), np.full(6, 100.0), np.full(6, 100.0)])
    found = run(EFFECTS["thruster_lag"], t, demands, time_constant=0.24)
    np.testing.assert_allclose(found[2], 100.0 * (1.0 - math.exp(-1.0)), rtol=1e-6)


def at_a_point(force: Array, place: Array) -> Array:
    return np.concatenate([force, np.cross(place, force)])


def advancing(t, nu, rotation, k):
    """By the form of the contract, axis by axis."""
    factor = 1.0 - k * nu[:3] * np.sign(THRUST[:3])
    return np.concatenate([(factor - 1.0) * THRUST[:3], np.zeros(3)])


def payload(t, nu, rotation, mass_wet, x, y, z, onset):
    weight = rotation.T @ [0.0, 0.0, 9.81 * mass_wet * (t >= onset)]
    return at_a_point(weight, np.array([x, y, z]))


def wave(t, nu, rotation, fx, fy, fz, frequency, phase):
    angle = 2.0 * np.pi * frequency * t + phase
    return at_a_point(rotation.T @ [fx, fy, fz] * np.sin(angle), np.zeros(3))


def tether(t, nu, rotation, k, x, y, z):
    place = np.array([x, y, z])
    va = nu[:3] + np.cross(nu[3:], place)
    return at_a_point(-k * np.linalg.norm(va) * va, place)


def smooth(t, nu, rotation, scale, axis, first, second, first_low, first_high, second_low,
           second_high, **weights):  # fmt: skip
    """Heave by pitch rate and depth: a product of splines with evenly spaced knots."""
    assert (axis, first, second) == (2, 5, 12)

    def values(x, low, high):
        y = 3.0 * np.clip((x - low) / (high - low), 0.0, 1.0)
        knots = np.arange(-3.0, 7.0)
        return np.array([BSpline(knots, row, 3)(y) for row in np.eye(6)])

    table = np.reshape([weights[f"w{i}"] for i in range(36)], (6, 6))
    force = values(nu[4], first_low, first_high) @ table
    return scale * force @ values(POSITION[2], second_low, second_high) * np.eye(6)[2]


POSITION = np.array([3.0, -2.0, 1.2])


def aside(t, nu, rotation, **arms):
    """The moment of each force that misses the origin by an arm."""
    out = np.zeros(6)
    for name, arm in arms.items():
        _, force, moment = name.split("_")
        out[AXES.index(moment)] += arm * THRUST[AXES.index(force)]
    return out


WRENCH_FORMS = {
    "thrust_line": aside,
    "empirical": smooth,
    "thrust_advance": advancing,
    "payload": payload,
    "wave": wave,
    "tether_drag": tether,
    "constant_force": lambda t, nu, rotation, fx, fy, fz: at_a_point(
        rotation.T @ [fx, fy, fz], np.zeros(3)
    ),
}


THRUST = np.array([40.0, -25.0, 30.0, 2.0, -1.0, 3.0])


def wrench_of(effect, t, nu, rotation, parameters):
    out = np.zeros(6)
    acting = compiled({effect.name: parameters})
    effects.add_wrenches(acting, t, POSITION, nu, rotation, THRUST, out)
    return out


@every_wrench
@pytest.mark.parametrize("seed", range(10))
def test_wrench_equations(effect, seed):
    rng = np.random.default_rng([10, seed])
    nu, t = rng.normal(size=6), rng.uniform(8.1, 20.0)
    rotation = np.ascontiguousarray(Rotation.random(random_state=seed).as_matrix())
    parameters = typical(effect, rng)
    expected = WRENCH_FORMS[effect.name](t, nu, rotation, **parameters)
    found = wrench_of(effect, t, nu, rotation, parameters)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    assert np.abs(found).max() > 0.01


@every_wrench
def test_wrenches_are_finite(effect):
    for parameters in choices(effect):
        for nu in (np.zeros(6), np.full(6, 1e3)):
            assert np.isfinite(wrench_of(effect, 1e6, nu, np.eye(3), parameters)).all()


def test_payload_before_its_onset_is_not_there():
    parameters = {"mass_wet": 1.0, "x": 0.1, "y": 0.2, "z": 0.3, "onset": 5.0}
    for t, force in ((4.999, 0.0), (5.0, 9.81)):
        found = wrench_of(EFFECTS["payload"], t, np.zeros(6), np.eye(3), parameters)
        np.testing.assert_allclose(found[2], force)


def test_tether_takes_energy_out_of_any_motion():
    parameters = {"k": 8.0, "x": -0.3, "y": 0.1, "z": -0.2}
    for nu in np.random.default_rng(11).normal(size=(50, 6)):
        found = wrench_of(EFFECTS["tether_drag"], 0.0, nu, np.eye(3), parameters)
        assert found @ nu < 0.0


def test_heavier_or_lighter(heavy):
    body = heavy.model.body
    changed = effects.rigid_body(body, {"buoyancy": {"delta": 3.0}})
    down = np.array([0.0, 0.0, 1.0])
    pull = at_a_point(3.0 * down, body.cob)
    np.testing.assert_allclose(changed.restoring @ down, body.restoring @ down + pull, atol=1e-12)
    moved = effects.rigid_body(body, {"cog_offset": {"dx": 0.1, "dy": -0.2, "dz": 0.05}})
    shift = np.array([0.1, -0.2, 0.05])
    np.testing.assert_allclose(moved.cog, body.cog + shift)
    turn = at_a_point(body.weight * down, shift) - at_a_point(body.weight * down, np.zeros(3))
    np.testing.assert_allclose(moved.restoring @ down, body.restoring @ down + turn, atol=1e-12)


# ------------------------------------------------------------------ moving water


def test_a_vehicle_that_drifts_with_the_water_feels_nothing(heavy):
    """Trimmed neutral and upright it goes on drifting, whatever way it turns about the vertical."""
    body = dataclasses.replace(
        heavy.model.body, buoyancy=heavy.model.body.weight, cob=heavy.model.body.cog
    )
    model = dataclasses.replace(heavy.model, body=body)
    water = {"north": 0.4, "east": -0.3, "down": 0.1}
    heading = Rotation.from_euler("z", 1.0)
    orientation = heading.as_quat()[[3, 0, 1, 2]]
    t = np.arange(0.0, 20.0, 0.1)
    nu = np.concatenate([heading.as_matrix().T @ list(water.values()), np.zeros(3)])
    run = simulate(
        model, t, np.zeros((len(t), 6)), nu, None, orientation,
        effects=compiled({"ocean_current": water}),
    )  # fmt: skip
    np.testing.assert_allclose(run.position, t[:, None] * list(water.values()), atol=1e-9)
    still = simulate(model, t, np.zeros((len(t), 6)), nu, None, orientation)
    assert np.linalg.norm(still.position[-1]) < 0.5 * np.linalg.norm(run.position[-1])


@pytest.mark.parametrize("seed", range(3))
def test_a_current_is_a_moving_frame(seed):
    """Galilei: seen from the water, the vehicle moves as it would in still water."""
    rng = np.random.default_rng([12, seed])
    body = RigidBody(
        13.5, 132.4, 134.0, rng.uniform(-0.03, 0.03, 3), rng.uniform(-0.03, 0.03, 3),
        np.array([[0.3, 0.02, -0.03], [0.02, 0.35, 0.01], [-0.03, 0.01, 0.4]]),
    )  # fmt: skip
    model = build(
        body,
        {
            "X_udot": -6.0, "Y_vdot": -8.0, "Z_wdot": -18.0, "K_pdot": -0.2, "M_qdot": -0.15,
            "N_rdot": -0.2, "Y_rdot": 0.4, "Z_qdot": -0.5, "X_u": -14.0, "Y_v": -8.0, "Z_w": -30.0,
            "K_p": -0.3, "M_q": -0.8, "N_r": -0.4, "X_uu": -140.0, "Z_ww": -190.0,
            "Z_ww_neg": -60.0, "Y_uv": -12.0, "N_uv": 3.0,
        },
    )  # fmt: skip
    water = rng.uniform(-0.5, 0.5, 3)
    t = np.arange(0.0, 10.0, 0.05)
    wrench = np.repeat(rng.normal(size=(10, 6)), 20, axis=0) * [40.0, 40.0, 40.0, 2.0, 2.0, 3.0]
    orientation = Rotation.random(random_state=seed).as_quat()[[3, 0, 1, 2]]
    start = rng.normal(size=6) * 0.3
    in_water = simulate(model, t, wrench, start, None, orientation)
    over_ground = start.copy()
    over_ground[:3] += quaternion_to_matrix(orientation).T @ water
    north, east, down = water
    run = simulate(
        model, t, wrench, over_ground, None, orientation,
        effects=compiled({"ocean_current": {"north": north, "east": east, "down": down}}),
    )  # fmt: skip
    np.testing.assert_allclose(run.position, in_water.position + t[:, None] * water, atol=2e-5)
    np.testing.assert_allclose(run.nu[:, 3:], in_water.nu[:, 3:], atol=1e-4)
    np.testing.assert_allclose(run.orientation, in_water.orientation, atol=1e-4)


def test_the_current_does_the_work_that_the_water_loses(heavy):
    """No damping, weight or thrust: in the water's frame the energy of body and water stays."""
    body = dataclasses.replace(heavy.model.body, buoyancy=heavy.model.body.weight)
    body = dataclasses.replace(body, cob=body.cog)
    masses = {n: v for n, v in zip(heavy.model.names, heavy.model.theta) if n.endswith("dot")}
    model = build(body, masses)
    t = np.arange(0.0, 5.0, 0.01)
    water = np.array([0.5, -0.2, 0.3])
    start = np.array([0.2, 0.5, -0.3, 1.0, -0.5, 0.8])
    run = simulate(
        model, t, np.zeros((len(t), 6)), start,
        effects=compiled({"ocean_current": dict(zip(("north", "east", "down"), water))}),
    )  # fmt: skip
    relative = run.nu.copy()
    relative[:, :3] -= np.einsum("kij,i->kj", quaternion_to_matrix(run.orientation), water)
    energy = 0.5 * np.einsum("ki,ij,kj->k", relative, model.mass_matrix, relative)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)
    over_ground = 0.5 * np.einsum("ki,ij,kj->k", run.nu, model.mass_matrix, run.nu)
    assert np.ptp(over_ground) > 0.05 * over_ground[0]


def test_the_tether_feels_the_water_not_the_ground(heavy):
    """At rest over ground in a current the tether pulls downstream."""
    model = heavy.model
    acting = compiled(
        {
            "ocean_current": {"north": 0.5, "east": 0.0, "down": 0.0},
            "tether_drag": {"k": 10.0, "x": 0.0, "y": 0.0, "z": 0.0},
        }
    )
    t, rest = np.array([0.0, 0.02]), np.zeros((2, 6))
    pulled, free = (simulate(model, t, rest, effects=e).nu_dot[0] for e in (acting, None))
    hull = 13.7 * 0.5 + 141.0 * 0.25
    wrench = model.mass_matrix @ (pulled - free)
    np.testing.assert_allclose(wrench, [hull + 10.0 * 0.25, 0, 0, 0, 0, 0], atol=1e-12)


def test_simulated_wrench_effects_go_by_the_time_since_the_first_message(heavy):
    """A window that starts later meets the wave, and the payload, where they then are."""
    values = {
        "wave": {"fx": 5.0, "fy": 0.0, "fz": 3.0, "frequency": 0.3, "phase": 0.5},
        "payload": {"mass_wet": 0.5, "x": 0.1, "y": 0.0, "z": 0.0, "onset": 7.0},
    }
    t = np.arange(0.0, 12.0, 0.02)
    rest = np.zeros((len(t), 6))
    whole = simulate(heavy.model, t, rest, effects=compiled(values))
    later = simulate(
        heavy.model, t[200:], rest[200:], whole.nu[200], whole.position[200],
        whole.orientation[200], effects=compiled(values),
    )  # fmt: skip
    np.testing.assert_allclose(later.nu, whole.nu[200:], atol=1e-12)
    assert np.abs(whole.nu).max() > 0.05


# ------------------------------------------------------------------ effects on the sensors


def lever(reading, x, y, z):
    return reading._replace(linear=reading.linear + np.cross(reading.angular, [x, y, z]))


def misaligned(reading, roll, pitch, yaw):
    to_body = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    return reading._replace(linear=to_body.inv().apply(reading.linear))


def biased(reading, ax, ay, az, gx, gy, gz):
    return reading._replace(
        gyro=reading.gyro + [gx, gy, gz], specific_force=reading.specific_force + [ax, ay, az]
    )


SENSOR_FORMS = {
    "sensor_lever_arm": lever,
    "sensor_misalignment": misaligned,
    "velocity_scale": lambda reading, scale: reading._replace(linear=reading.linear * scale),
    "imu_bias": biased,
}


def reading(rng, *shape):
    return Reading(*rng.normal(size=(4, *shape, 3)))


@every_sensor
@pytest.mark.parametrize("shape", [(), (7,)])
def test_sensor_equations(effect, shape):
    rng = np.random.default_rng(13)
    true, parameters = reading(rng, *shape), typical(effect, rng)
    sensed = effects.sense(true, {effect.name: parameters})
    for found, expected in zip(sensed, SENSOR_FORMS[effect.name](true, **parameters), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    assert any(not np.array_equal(a, b) for a, b in zip(sensed, true, strict=True))


@every_sensor
def test_sensors_are_finite_and_corrected_whatever_the_parameters(effect):
    true = reading(np.random.default_rng(14))
    for parameters in choices(effect):
        sensed = effects.sense(true, {effect.name: parameters})
        back = effects.correct(sensed, {effect.name: parameters})
        for part, found, expected in zip(sensed, back, true, strict=True):
            assert np.isfinite(part).all()
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_sensor_effects_are_taken_back_in_the_opposite_order():
    rng = np.random.default_rng(15)
    true = reading(rng, 5)
    values = {e.name: typical(e, rng) for e in SENSOR}
    sensed = effects.sense(true, values)
    for found, expected in zip(effects.correct(sensed, values), true, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    expected = true
    for name in ("sensor_lever_arm", "sensor_misalignment", "velocity_scale", "imu_bias"):
        expected = SENSOR_FORMS[name](expected, **values[name])
    for found, wanted in zip(sensed, expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)


# ------------------------------------------------------------------ coefficients


def test_a_family_does_not_go_under_effects(heavy):
    for effect in EFFECTS.values():
        if effect.coefficients:
            parameters = configuration.to_parameters(heavy) | {"effects": {effect.name: {}}}
            with pytest.raises(UserError, match=f"{effect.name} is a family of coefficients: put "):
                configuration.from_parameters(parameters)


def test_every_equation_above_is_of_an_effect_and_every_effect_has_one():
    forms = {**INPUT_FORMS, **STEER_FORMS, **WRENCH_FORMS, **SENSOR_FORMS}
    assert forms.keys() == {e.name for e in (*INPUT, *STEER, *WRENCH, *SENSOR)}
