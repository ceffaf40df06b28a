"""Parameters of effects, estimated live: what a sample says of them, and where they come to."""

import dataclasses

import numpy as np
import pytest
from textbook import finned, steered_dive
from tiers import more

from rov_ident.config import dump, from_parameters, load, to_parameters
from rov_ident.core.errors import UserError
from rov_ident.effects import EFFECTS, estimable
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.sampling.records import samples_of
from rov_ident.sampling.sample import SAMPLE, joined, parts, sample_type
from rov_ident.simulation.virtual_sensors import Suite, dive

EXACT = Suite().scaled(0.0)

GIVEN = {
    "thruster_gain": {"gain_X": 0.9, "gain_N": 1.2},
    "thrust_scale": {"scale": 0.9},
    "thrust_curve": {"curvature_X": 0.3, "curvature_K": -0.2},
    "thrust_advance": {"k": 0.2},
    "thrust_line": {
        "arm_Y_K": 0.01,
        "arm_Z_K": 0.01,
        "arm_X_M": 0.02,
        "arm_Z_M": -0.01,
        "arm_X_N": 0.01,
        "arm_Y_N": -0.02,
    },
    "thruster_saturation": {"limit_X": 20.0, "limit_Z": 40.0},
    "thruster_asymmetry": {"gain_X": 0.8},
    "thruster_deadband": {"width_Y": 2.0},
    "thruster_lag": {"time_constant": 0.1},
    "actuation_delay": {"delay": 0.1},
    "thruster_failure": {"gain_X": 0.8, "onset": 10.0},
    "fin_offset": {"delta_s": 0.02, "delta_r": -0.03},
    "fin_lag": {"time_constant": 0.1},
    "fin_saturation": {"delta_r": 0.2, "rate": 0.6},
    "battery_resistance": {"loss": 0.2},
    "battery_sag": {"end_loss": 0.2},
    "ocean_current": {"north": 0.1, "east": -0.1, "down": 0.02},
    "constant_force": {"fx": 3.0, "fy": -2.0, "fz": 1.0},
    "tether_drag": {"k": 10.0, "x": -0.2, "y": 0.0, "z": -0.1},
    "payload": {"mass_wet": 0.3, "x": 0.1, "y": 0.0, "z": 0.1, "onset": 5.0},
    "wave": {"fx": 3.0, "fy": 2.0, "fz": 1.0, "frequency": 0.2, "phase": 0.5},
    "buoyancy": {"delta": 3.0},
    "cog_offset": {"dx": 0.01, "dy": -0.01, "dz": 0.01},
    "sensor_lever_arm": {"x": 0.1, "y": 0.05, "z": -0.1},
    "sensor_misalignment": {"roll": 0.05, "pitch": -0.05, "yaw": 0.05},
    "velocity_scale": {"scale": 1.05},
}
"""Every effect that has parameters which can be estimated, with values."""


def having(config, effects, **settings):
    """The configuration with effects, read as from a file."""
    return from_parameters({**to_parameters(config), "effects": effects, **settings})


def moved(config, effect, name, by):
    values = dict(config.effects[effect])
    values[name] += by
    return dataclasses.replace(config, effects={**config.effects, effect: values})


def test_every_effect_that_can_be_estimated_is_tried():
    # a delay moves the samples in time, so that they cannot be compared: see test_nuisance.py; what
    # has no name is in test_empirical.py
    assert {*GIVEN, "velocity_latency", "empirical"} == {
        name for name in EFFECTS if estimable(name)
    }


def acting(config, samples):
    """The wrench (N, 6) of thrusters and fins."""
    fins = config.dynamics.input_wrench(samples["nu"], samples["inputs"][:, 0])
    return samples["wrench"] + fins


@pytest.mark.parametrize("effect", GIVEN)
def test_jacobian_is_that_of_samples_made_with_other_values(heavy, effect):
    """Wrench and velocity of samples from a bag, by the configuration a little to either side."""
    fins = EFFECTS[effect].steer is not None
    config = having(finned(heavy) if fins else heavy, {effect: GIVEN[effect]})
    # What is sensed is differentiated sample by sample, seven times here.
    seconds = 6.0 if EFFECTS[effect].sense is None else 4.0
    run = steered_dive(config, seconds, EXACT, 1)
    samples = joined(list(samples_of(config, run)))
    _, sides = parts(samples)
    measured = np.isfinite(samples["odometry"][:, 0])
    measured[:20] = False  # the motion before is not known
    for i, (name, parameter) in enumerate(config.estimate_effects):
        h = 1e-3 * next(p for p in EFFECTS[name].parameters if p.name == parameter).typical
        low, high = (
            joined(list(samples_of(moved(config, name, parameter, step), run))) for step in (-h, h)
        )
        wrench = (acting(config, high) - acting(config, low)) / (2.0 * h)
        velocity = (low["odometry"] - high["odometry"]) / (2.0 * h)
        if EFFECTS[effect].body is None:
            tell = np.abs(wrench).max() + 1.0
            close = np.abs(sides[:, :6, i] - wrench) < 0.02 * tell
            assert close.mean() > 0.98  # steps of a deadband or delay are where they are
        shown = sides[measured, 6:9, i] - velocity[measured, :3]
        allowed = 0.02 * (np.abs(velocity[measured, :3]).max() + 0.1)
        if EFFECTS[effect].sense is not None:  # of the motion at the sample before, free of noise
            allowed += 2.0 * np.abs(np.diff(samples["nu"], axis=0)).max()
        assert np.abs(shown).max() < allowed


@pytest.mark.parametrize("effect", ["buoyancy", "cog_offset"])
def test_jacobian_of_the_rigid_body_is_that_of_the_inverse_dynamics(heavy, effect):
    config = having(heavy, {effect: GIVEN[effect]})
    run = dive(config, "steps", 15.0, EXACT, 1)
    samples = joined(list(samples_of(config, run)))
    _, sides = parts(samples)
    at = np.searchsorted(run.truth.t, samples["t"])
    for k in range(50, len(samples), 97):
        nu, nu_dot = run.truth.nu[at[k]], run.truth.nu_dot[at[k]]
        for i, (name, parameter) in enumerate(config.estimate_effects):
            low, high = (
                moved(config, name, parameter, step).dynamics.wrench(nu, nu_dot, samples["down"][k])
                for step in (-1e-4, 1e-4)
            )
            wanted = (low - high) / 2e-4  # on the side of the thrusters
            assert np.abs(sides[k, :6, i] - wanted).max() < 0.1 * np.abs(wanted).max() + 0.2


def test_without_estimated_effects_samples_are_what_they_were(heavy):
    config = having(heavy, {"thruster_lag": {"time_constant": 0.1}}, estimate=["X_u"])
    assert config.estimate_effects == ()
    sample = next(s for s in samples_of(config, dive(config, "steps", 2.0)) if len(s))
    assert sample.dtype == SAMPLE == sample_type(0)
    plain, sides = parts(sample)
    assert plain is sample and sides.shape[2] == 0


TRUTH = {
    "thruster_gain": {"gain_X": 1.15, "gain_N": 0.9},
    "thrust_scale": {"scale": 0.8},
    "thrust_curve": {"curvature_X": 0.4, "curvature_K": -0.3},
    "thrust_advance": {"k": 0.3},
    "thruster_saturation": {"limit_X": 25.0, "limit_Z": 50.0},
    "battery_resistance": {"loss": 0.25},
    "thruster_lag": {"time_constant": 0.13},
    "actuation_delay": {"delay": 0.13},
    "fin_offset": {"delta_s": 0.03, "delta_r": -0.045},
    "fin_lag": {"time_constant": 0.14},
    "ocean_current": {"north": 0.14, "east": -0.07, "down": 0.02},
    "buoyancy": {"delta": 4.0},
    "constant_force": {"fx": 4.0, "fy": -1.4, "fz": 1.3},
    "tether_drag": {"k": 13.0, "x": -0.2, "y": 0.0, "z": -0.1},
    "cog_offset": {"dx": 0.013, "dy": -0.007, "dz": 0.013},
}


_BOTH = [(effect, kind) for effect in TRUTH for kind in ("rls", "ukf")]


@pytest.mark.parametrize(
    ("effect", "kind"),
    # of thrust, of fins, of the body; a current and a lag come back in test_nuisance.py, too
    [*(_BOTH[i] if i in (5, 14, 26) else more(_BOTH[i])[0] for i in range(len(_BOTH)))],
)
def test_effects_come_back_to_the_truth_live(heavy, effect, kind):
    """Configured 20 to 40 % off, the coefficients 8 %; three standard deviations at most.

    A tether's drag and the arm of it multiply each other: what is learnt in the first seconds,
    about wrong values of both, is kept. Where that leaves an error the fit is said to disagree with
    the data, and its intervals are wide (docs/live.md).
    """
    vehicle = finned(heavy) if EFFECTS[effect].steer else heavy
    world, config = (having(vehicle, {effect: of[effect]}) for of in (TRUTH, GIVEN))
    theta = vehicle.model.theta
    off = 1.0 + 0.08 * np.random.default_rng(5).uniform(-1.0, 1.0, len(theta))
    config = dataclasses.replace(config, model=config.model.with_theta(theta * off))
    online = OnlineEstimator(config, kind)
    for _, role, message in steered_dive(world, 90.0, Suite(), 4).messages:
        online.push(role, message)
    online.flush()
    report = online.report()
    consistent = report.consistency.consistent
    assert consistent or effect == "tether_drag"
    for name, value, std in zip(report.names, report.values, report.std, strict=True):
        if "." in name:
            effect_, parameter = name.split(".")
            given = GIVEN[effect_][parameter]
            off = abs(value - TRUTH[effect_][parameter])
            assert off < 3.0 * std, name
            if given != TRUTH[effect_][parameter]:
                assert off < 0.9 * abs(TRUTH[effect_][parameter] - given), name
                assert not consistent or std < 0.2 * abs(TRUTH[effect_][parameter] - given), name


def test_which_parameters_are_estimated_unless_told(heavy):
    effects = {"thruster_gain": {"gain_X": 0.9}, "payload": GIVEN["payload"]}
    config = having(heavy, effects)
    assert config.estimate == heavy.model.names
    assert config.estimate_effects == (
        ("thruster_gain", "gain_X"),
        *(("payload", name) for name in ("mass_wet", "x", "y", "z")),
    )
    config = having(heavy, effects, estimate=["X_u", "thruster_gain.gain_Z"])
    assert config.estimate == ("X_u",)
    assert config.estimate_effects == (("thruster_gain", "gain_Z"),)


@pytest.mark.parametrize("name", ["payload.onset", "payload.mass", "wave.fx", "nothing.at_all"])
def test_what_cannot_be_estimated_is_refused_by_name(heavy, name):
    with pytest.raises(UserError, match=f"estimate: {name}"):
        having(heavy, {"payload": GIVEN["payload"]}, estimate=["X_u", name])


def test_a_file_keeps_what_is_estimated(heavy, tmp_path):
    for settings in ({}, {"estimate": ["X_u", "payload.mass_wet"]}):
        config = having(heavy, {"payload": GIVEN["payload"]}, **settings)
        dump(config, tmp_path / "c.yaml")
        again = load(tmp_path / "c.yaml")
        assert (again.estimate, again.estimate_effects) == (
            config.estimate,
            config.estimate_effects,
        )


def test_values_by_name(heavy):
    config = having(heavy, {"buoyancy": {"delta": 3.0}})
    changed = config.with_values({"X_u": -20.0, "buoyancy.delta": 4.0})
    assert changed.effects == {"buoyancy": {"delta": 4.0}}
    assert changed.model.theta[changed.model.names.index("X_u")] == -20.0
    with pytest.raises(UserError, match="payload.x"):
        config.with_values({"payload.x": 1.0})
