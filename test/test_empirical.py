"""What has no name becomes a smooth term, found where no effect of the library is like it."""

import dataclasses

import numpy as np
import pytest
from tiers import more

from bench.simulators import hidden
from bench.studies.explain import gain_of_unknown, streams_of
from rov_ident import config as configuration
from rov_ident.discrepancy.explain import explain
from rov_ident.effects.empirical import ALONE, EFFECT, OF, ON, wrench
from rov_ident.model.coefficients import AXES

DIVE = hidden.Conditions(duration=60.0, odometry_rate=10.0, imu_rate=50.0)


@pytest.mark.parametrize(
    "name, seed, strength, seconds",
    [
        ("heading_moment", 2, 0.3, 60.0),
        *more(
            ("bump", 1, 0.15, 60.0), ("shaking", 1, 0.2, 60.0), ("slope", 2, 0.1, 120.0),
            ("friction", 1, 0.2, 120.0), ("root_damping", 1, 0.3, 120.0),
        ),
    ],
)  # fmt: skip
def test_an_unknown_effect_is_mended_without_a_name(name, seed, strength, seconds, tmp_path):
    """80 % of the gain of the true wrench; what is written simulates it, and is read again."""
    dive = dataclasses.replace(DIVE, duration=seconds)
    case = hidden.draw(seed, (), strength, unknown=name, conditions=dive)
    streams = streams_of(case)
    found = explain([streams], case.config)
    (term,) = [f for f in found.findings.effects if f.effect == "empirical"]
    assert found.findings.verdict == "unexplained" and not term.separable
    assert not [f for f in found.findings.effects if f.separable]
    assert term.gain.percent / 100.0 > 0.8 * gain_of_unknown(case, streams)
    shape = found.extended.effects["empirical"]
    on, (left,) = ON[int(shape["axis"])], found.findings.residual
    assert case.axis in (on, term.axes[0])
    assert left.axis == on or on not in AXES
    variables = {OF[int(shape[n])] for n in ("first", "second")}
    assert variables & {d.format(case.axis) for d in case.depends_on}
    assert term.sentence.startswith(f"On {ON[int(shape['axis'])]} something without a name depends")
    configuration.dump(found.extended, tmp_path / "extended.yaml")
    again = configuration.load(tmp_path / "extended.yaml")
    assert again.effects["empirical"] == shape
    assert ("empirical", "scale") in again.estimate_effects


@pytest.mark.study  # where test_explain*.py find one effect alone, there is no term beside it
def test_a_cause_that_has_a_name_is_not_hidden():
    case = hidden.draw(3, ("lift",), 0.5, conditions=dataclasses.replace(DIVE, duration=90.0))
    assert "empirical" not in [
        f.effect for f in explain([streams_of(case)], case.config).findings.effects
    ]


@pytest.mark.parametrize("first", ["v", "roll", "thrust"])
def test_only_functions_of_a_velocity_jump(first):
    """By their last weight, where the velocity changes its sign."""
    names = [p.name for p in EFFECT.parameters]
    of = {"scale": 2.0, "axis": 1.0, "first": OF.index(first), "first_low": -0.5, "first_high": 0.6}
    p = np.array([{**of, f"w{ALONE}": -3.0}.get(name, 0.0) for name in names])
    for v in np.linspace(-1.0, 1.0, 21):
        out, nu = np.zeros(6), np.array([0.0, v, 0.0, 0.0, 0.0, 0.0])
        wrench(p, 0.0, np.zeros(3), nu, np.eye(3), np.full(6, v), out)
        jump = -6.0 * np.tanh(v / (0.03 * 0.6)) if first == "v" else 0.0
        np.testing.assert_allclose(out, [0.0, jump, 0.0, 0.0, 0.0, 0.0], atol=1e-12)
