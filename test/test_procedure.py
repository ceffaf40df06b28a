"""The procedure of a sea trial from end to end (docs/offline.md), and its pieces.

Closed-loop waypoints in the simulator, one channel at a time; cut, cleaned, levers taken off; each
channel fitted alone; judged on a joint run with a speed change and a turn.
"""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from rov_ident import config, preprocess
from rov_ident import swing as swings
from rov_ident.errors import UserError
from rov_ident.frames import quaternion_to_matrix
from rov_ident.simulate import simulate
from rov_ident.surge import Run, _simulated, fit_surge
from rov_ident.swing import Course, Limits

EXAMPLE = Path(__file__).parent.parent / "examples" / "sea_trial.py"


def test_the_whole_procedure(heavy, tmp_path, capsys):
    """From raw logs to a model that predicts a run it has not seen as the true vehicle would."""
    runpy.run_path(str(EXAMPLE))["main"](["--out", str(tmp_path)])
    told = capsys.readouterr().out
    rows = re.findall(r"^  ([uvwpqr]) ([\d.]+)  ([\d.]+)  ([\d.]+)$", told, re.MULTILINE)
    assert [row[0] for row in rows] == list("uvwpqr")
    before, after, true = np.array([row[1:] for row in rows], dtype=float).T
    assert np.all(after < before)
    assert np.all(after < 1.25 * true)
    assert np.median(after / before) < 0.7
    assert "surge: left alone" in told
    fitted = config.load(tmp_path / "fitted.yaml").model
    assert np.median(np.abs(fitted.theta / heavy.model.theta - 1.0)) < 0.03
    assert "<svg" in (tmp_path / "report.html").read_text()


def test_a_course_is_followed(heavy):
    course = Course("there and back", ((2.0, 0.5, 0.0), (4.0, 0.25, np.pi / 2)))
    np.testing.assert_allclose(course.target(1.0), [0.5, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(course.target(4.0), [1.0, 0.5, 0.0, np.pi / 2], atol=1e-12)
    np.testing.assert_array_equal(course.target(6.0), course.target(60.0))
    flown = swings.fly(heavy, course, 12.0, Limits())
    np.testing.assert_allclose(flown.reach[:2], [1.0, 1.0], atol=0.2)


# ------------------------------------------------------------------ pieces


def test_lever_arms_are_those_of_a_rigid_body(heavy):
    """A point of a simulated body, differentiated numerically, gives the origin back."""
    t = np.arange(0.0, 4.0, 0.002)
    wrench = np.tile([20.0, 10.0, -15.0, 0.4, -0.5, 0.6], (len(t), 1))
    run = simulate(heavy.model, t, wrench)
    lever = np.array([0.3, -0.2, 0.1])
    r = quaternion_to_matrix(run.orientation)
    place = run.position + r @ lever
    omega, omega_dot = run.nu[:, 3:], run.nu_dot[:, 3:]
    velocity = np.einsum("kji,kj->ki", r, np.gradient(place, t, axis=0))
    acceleration = np.einsum("kji,kj->ki", r, np.gradient(np.gradient(place, t, axis=0), t, axis=0))
    inside = slice(5, -5)
    np.testing.assert_allclose(
        preprocess.position_at_origin(place, r, lever), run.position, atol=1e-12
    )
    np.testing.assert_allclose(
        preprocess.velocity_at_origin(velocity, omega, lever)[inside],
        run.nu[inside, :3], atol=1e-3,
    )  # fmt: skip
    own = run.nu_dot[:, :3] + np.cross(omega, run.nu[:, :3])
    np.testing.assert_allclose(
        preprocess.acceleration_at_origin(acceleration, omega, omega_dot, lever)[inside],
        own[inside], atol=2e-2,
    )  # fmt: skip


def test_outliers_are_replaced_and_nothing_else(heavy):
    t = np.arange(0.0, 20.0, 0.05)
    x = np.sin(t) + 0.01 * np.random.default_rng(0).standard_normal(len(t))
    spoilt = x.copy()
    spoilt[[30, 200, 201, 350]] += [3.0, -2.0, -2.0, 1.0]
    clean, bad = preprocess.without_outliers(spoilt)
    assert set(np.flatnonzero(bad)) >= {30, 200, 201, 350}
    assert bad.sum() < 12
    assert np.abs(clean - np.sin(t)).max() < 0.2
    with pytest.raises(UserError, match="odd number"):
        preprocess.without_outliers(x, 4)


def test_smoothing_has_no_lag_and_a_derivative():
    t = np.arange(0.0, 10.0, 0.02)
    noisy = np.sin(t) + 0.02 * np.random.default_rng(0).standard_normal(len(t))
    value, slope = preprocess.smoothed(noisy, 0.02, 0.6)
    assert np.std(value - np.sin(t)) < 0.01
    assert np.std(slope - np.cos(t)) < 0.12
    assert abs(np.mean((value - np.sin(t)) * np.cos(t))) < 2e-3
    with pytest.raises(UserError, match="too few"):
        preprocess.smoothed(noisy[:4], 0.02)


def test_the_dynamic_stretch_is_cut_out():
    t = np.arange(0.0, 100.0, 0.1)
    wrench = np.where((t > 40.0) & (t < 60.0), 10.0 * np.sign(np.sin(t)), 0.01)
    begin, end = preprocess.dynamic_stretch(t, wrench)
    assert begin == pytest.approx(35.0, abs=0.3)
    assert end == pytest.approx(65.0, abs=0.3)
    with pytest.raises(UserError, match="zero throughout"):
        preprocess.dynamic_stretch(t, 0.0 * t)


def test_depth_from_three_sources_is_better_than_the_best():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 60.0, 0.2)

    def true(at):
        return 5.0 + 1.5 * np.sin(0.3 * at)

    def source(name, rate, std, bias):
        at = np.arange(0.0, 60.0, 1.0 / rate)
        z = true(at) + std * rng.standard_normal(len(at)) + bias
        return preprocess.Source(name, at, z, std, abs(bias))

    pressure = source("pressure", 5.0, 0.05, 0.0)
    inertial, tracking = source("ins", 10.0, 0.05, 0.3), source("usbl", 1.0, 0.4, 0.0)
    pressure.z[100] += 4.0  # one jump
    found = preprocess.fused([pressure, inertial, tracking], t)
    error = found.value - true(t)
    assert np.std(error) < 0.03
    assert found.bias["ins"] == pytest.approx(0.3, abs=0.06)
    assert np.mean(np.abs(error) < 2.0 * found.std) > 0.8
    assert np.std(found.rate - 0.45 * np.cos(0.3 * t)) < 0.06
    with pytest.raises(UserError, match="at least one source"):
        preprocess.fused([], t)


# ------------------------------------------------------------------ thrust from speed


TRUE = {"k1": 0.4, "k2": 0.05, "X_u": -6.0, "X_uu": -30.0, "X_udot": -7.0}
MASS = 15.0


def surge_runs(noise=0.005, seed=0):
    """Up in steps to full speed, then coasting."""
    t = np.arange(0.0, 40.0, 0.1)
    n = np.select([t < 8.0, t < 16.0, t < 25.0], [10.0, 18.0, 25.0], 0.0)
    inertia = MASS - TRUE["X_udot"]
    ratio = np.array([TRUE[k] for k in ("k1", "k2", "X_u", "X_uu")]) / inertia
    u = _simulated(ratio, 0.0, t, n)
    rng = np.random.default_rng(seed)
    return [Run(t, n, u + noise * rng.standard_normal(len(t))) for _ in range(2)]


@pytest.mark.parametrize(
    "anchor",
    [{"added_mass": TRUE["X_udot"]}, {"bollard": (20.0, 0.4 * 20.0 + 0.05 * 400.0)}],
    ids=["added mass known", "bollard pull known"],
)
def test_thrust_and_drag_from_step_up_and_coast_down(anchor):
    off = []
    for seed in range(6):
        found = fit_surge(surge_runs(seed=seed), MASS, **anchor)
        assert found.rmse == pytest.approx(0.005, rel=0.15)
        for name, value, std in zip(found.names, found.values, found.std, strict=True):
            if std > 0.0:
                off.append((value - TRUE[name]) / std)
            else:
                assert value == pytest.approx(TRUE[name])
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.parametrize(
    ("runs", "options", "said"),
    [
        (surge_runs(), {}, "speeds do not tell forces"),
        ([], {"added_mass": -7.0}, "no run"),
        (surge_runs(), {"added_mass": 7.0}, "is negative"),
        ([Run(r.t[:240], r.n[:240], r.u[:240]) for r in surge_runs()], {"added_mass": -7.0},
         "no run coasts"),
        ([Run(r.t, r.n * 0.0, r.u) for r in surge_runs()], {"added_mass": -7.0}, "never turns"),
        (surge_runs(), {"bollard": (20.0, -5.0)}, "disagree about the sign"),
        (surge_runs(), {"bollard": (20.0, 5.0)}, "less than the mass"),
    ],
)  # fmt: skip
def test_what_runs_cannot_tell_is_said(runs, options, said):
    with pytest.raises(UserError, match=said):
        fit_surge(runs, MASS, **options)
