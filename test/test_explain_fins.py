"""Dives under fins: what lies between the angles that are read and those that act is named."""

import dataclasses

import numpy as np
import pytest
from tiers import more

import rov_ident as ri
from bench import REMUS
from rov_ident import config as configuration
from rov_ident.effects import EFFECTS
from rov_ident.simulation.virtual_sensors import Suite

LEAN = Suite(odometry_rate=10.0, imu_rate=50.0)


def hidden(effect, seed):
    """Values of an effect on fins, drawn by a seed."""
    rng = np.random.default_rng(seed)
    values = {p.name: p.null for p in EFFECTS[effect].parameters}
    drawn = {
        "fin_lag": {"time_constant": rng.uniform(0.2, 0.4)},
        "fin_offset": {"delta_r": rng.choice([-1.0, 1.0]) * rng.uniform(0.03, 0.06)},
        "fin_saturation": {"delta_r": rng.uniform(0.2, 0.24)},
    }[effect]
    return values | drawn, drawn


def explained(config, effects, path, seed, seconds=120.0):
    world = dataclasses.replace(config, effects=effects)
    dive = ri.simulate(world, manoeuvre="waypoints", duration=seconds, seed=seed, sensors=LEAN)
    dive.save(path)
    return ri.explain(path, config).findings


def test_nothing_is_named_where_the_file_is_right(tmp_path):
    """All six axes are judged: fins turn the vehicle, though the wrench holds no moment."""
    found = explained(configuration.load(REMUS), {}, tmp_path / "dive.mcap", 1, 80.0)
    assert not found.effects and found.verdict in ("agrees", "retuned")
    assert np.isfinite(list(found.baseline.values())).all() and len(found.baseline) == 6


@pytest.mark.parametrize("effect", more("fin_lag", "fin_offset", "fin_saturation"))
def test_a_hidden_effect_on_fins_is_named(effect, tmp_path):
    values, drawn = hidden(effect, 2)
    found = explained(configuration.load(REMUS), {effect: values}, tmp_path / "dive.mcap", 3)
    assert found.effects[0].effect == effect and found.effects[0].gain.percent > 10.0
    for name, true in drawn.items():
        told = found.effects[0].parameters[name]
        assert abs(told.value - true) < max(4.0 * told.std, 0.05 * abs(true)), name


def test_a_fin_without_its_coefficient_is_named(tmp_path):
    """`fin_lift`: the joints are heard, and the rudder's moment is missing in the file."""
    true = configuration.load(REMUS)
    plain = configuration.to_parameters(true)
    plain.pop("estimate", None)
    for name in ("Y_uudr", "N_uudr"):
        del plain["coefficients"][name]
    path = tmp_path / "dive.mcap"
    ri.simulate(true, manoeuvre="waypoints", duration=70.0, seed=1, sensors=LEAN).save(path)
    found = ri.explain(path, configuration.from_parameters(plain)).findings
    names = {name for f in found.effects if f.effect == "fin_lift" for name in f.parameters}
    assert "N_uudr" in names
