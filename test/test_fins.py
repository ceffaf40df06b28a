"""Fins: names, the wrench by the fins' normals, tails, and the vehicle under its fins."""

import numpy as np
import pytest

from bench import REMUS, ROOT
from rov_ident import config
from rov_ident.cli.program import main
from rov_ident.core.errors import UserError
from rov_ident.io.csv_table import read_csv
from rov_ident.model.coefficients import catalogue, input_catalogue, parse, parse_input
from rov_ident.model.equations import extended_states
from rov_ident.model.fins import CROSS, X
from rov_ident.steering import autopilot


@pytest.fixture(scope="module")
def remus():
    return config.load(REMUS).model


def test_names_say_what_they_multiply():
    """At u = 2 m/s, 5 revolutions a second backwards, every angle 0.1 rad to its negative side."""
    nu, inputs = np.array([[2.0, 0, 0, 0, 0, 0]]), np.array([[-0.1, -0.1, -0.1, -5.0]])
    row = extended_states(nu, inputs)[0]
    for name, factor, unit in (
        ("N_uudr", -0.4, "N m s2/(m2 rad)"),
        ("X_uudsds", 0.04, "N s2/(m2 rad2)"),
        ("N_uudrdr", -0.04, "N m s2/(m2 rad2)"),
        ("Y_udr", -0.2, "N s/(m rad)"),
        ("Y_dr", -0.1, "N/rad"),
        ("Y_nndr", 2.5, "N s2/rad"),
        ("X_n", -5.0, "N s"),
        ("X_nn", -25.0, "N s2"),
        ("X_un", -10.0, "N s2/m"),
        ("K_nn", -25.0, "N m s2"),
    ):
        c = parse(name)
        assert row[c.left] * row[c.right] == pytest.approx(factor), name
        assert c.unit == unit
    with pytest.raises(UserError, match="is written X_nn"):
        parse("T_nn")
    assert parse("X_nu").place == parse("X_un").place


def test_fin_names_and_others_are_told_apart():
    assert all(parse_input(c.name) is None for c in catalogue())
    every = input_catalogue()
    assert len({c.place for c in every}) == len(every) == 4 * 6 * 3 * 2 + 3 * 6
    for name in ("N_uudx", "N_uuudr", "N_uudrds", "N_vdr", "uudr", "X_nnn", "X_vn"):
        assert parse_input(name) is None


def to_fins(tail, angles):
    """Fin angles (..., fins) that make delta_s, delta_r, delta_a (..., 3)."""
    return np.asarray(angles) @ np.transpose([[y, z, -1.0] for y, z in tail.spans.values()])


def wrench_of(tail, angles, x=-0.7, radius=0.1):
    """(6,) of the fins by their normals, for a lift of 1 N per rad each, x and radius [m]."""
    total = np.zeros(6)
    for angle, (y, z) in zip(angles, tail.spans.values(), strict=True):
        span = np.array([0.0, y, z])
        force = angle * np.cross(span, [1.0, 0.0, 0.0])
        total += [*force, *np.cross([x, 0.0, 0.0] + radius * span, force)]
    return total


@pytest.mark.parametrize("this", [CROSS, X])
def test_pure_equivalents_act_on_their_axes_alone(this):
    """By the normals of the fins: a pure stern-plane angle gives no yaw, roll or side force."""
    for i, (own, signs) in enumerate(
        [((2, 4), (-1, -1)), ((1, 5), (1, -1)), ((3,), (1,))]  # Prestero's signs; roll to starboard
    ):
        wrench = wrench_of(this, to_fins(this, np.eye(3)[i]))
        others = [k for k in range(6) if k not in own]
        np.testing.assert_allclose(wrench[others], 0.0, atol=1e-15)
        assert (np.sign(wrench[list(own)]) == signs).all()


@pytest.mark.parametrize("this", [CROSS, X])
def test_there_and_back(this):
    angles = np.random.default_rng(1).normal(size=(5, 3))
    np.testing.assert_allclose(this.to_equivalent(to_fins(this, angles)), angles, atol=1e-14)


def test_x_tail_mixes_over_the_root_of_two():
    root = np.sqrt(0.5)
    np.testing.assert_allclose(to_fins(X, [1.0, 0.0, 0.0]), root * np.array([-1, 1, -1, 1]))
    np.testing.assert_allclose(to_fins(X, [0.0, 1.0, 0.0]), root * np.array([-1, -1, 1, 1]))


def test_both_tails_push_alike_for_the_same_equivalents():
    for angles in np.eye(3):
        wrenches = [wrench_of(t, to_fins(t, angles)) for t in (CROSS, X)]
        np.testing.assert_allclose(wrenches[0], wrenches[1], atol=1e-15)


def test_fin_wrench(remus):
    nu = np.array([2.0, 0.3, -0.2, 0.1, 0.2, -0.3])
    wrench = remus.input_wrench(nu, np.array([0.0, 0.1, 0.0, 0.0]))
    np.testing.assert_allclose(wrench, [0, 9.64 * 0.4, 0, 0, 0, -6.15 * 0.4], atol=1e-12)
    np.testing.assert_array_equal(remus.input_wrench(nu, np.zeros(4)), np.zeros(6))


def test_fins_are_parameters_like_any_other(remus):
    assert set(remus.fins) == {"Y_uudr", "N_uudr", "Z_uuds", "M_uuds"} < set(remus.names)
    assert remus.inputs == ("delta_s", "delta_r")
    doubled = remus.with_theta(2.0 * remus.theta).fins
    assert doubled == {name: 2.0 * value for name, value in remus.fins.items()}


def test_configuration_keeps_its_fins(tmp_path):
    loaded = config.load(REMUS)
    config.dump(loaded, tmp_path / "again.yaml")
    assert config.load(tmp_path / "again.yaml").model.fins == loaded.model.fins


def test_misspelt_fin_is_refused(tmp_path):
    text = REMUS.read_text().replace("N_uudr", "N_uudx")
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(UserError, match=r"coefficients\.N_uudx"):
        config.load(tmp_path / "c.yaml")


# ------------------------------------------------------------------ under its fins


def test_fixed_rudder_turns_to_the_side_of_its_sign(remus):
    for angle in (0.1, -0.1):
        run = autopilot.steer(remus, autopilot.turn(angle), 40.0, 1.5)
        assert np.sign(run.nu[-1, 5]) == np.sign(angle) * np.sign(remus.fins["N_uudr"])
        # steady: the speed still falls, but the circle no longer changes
        curvature = run.nu[:, 5] / run.nu[:, 0]
        assert abs(curvature[-1] - curvature[-500]) < 0.01 * abs(curvature[-1])


def test_dive_reaches_its_depth(remus):
    run = autopilot.steer(remus, autopilot.to_depth(5.0, np.sign(remus.fins["M_uuds"])), 80.0, 1.5)
    assert abs(run.position[-1, 2] - 5.0) < 0.3
    assert np.abs(run.angles[:, 1]).max() < np.radians(40.0)
    np.testing.assert_allclose(run.position[:, 1], 0.0, atol=1e-6)


def test_heading_change_arrives(remus):
    run = autopilot.steer(
        remus, autopilot.to_heading(1.0, np.sign(remus.fins["N_uudr"])), 40.0, 1.5
    )
    assert abs(run.angles[-1, 2] - 1.0) < 0.02


def test_servo_is_no_faster_than_its_rate(remus):
    servo = autopilot.Servo(rate=0.2, limit=0.15)
    run = autopilot.manoeuvre(remus, "zigzag", 0.3, duration=20.0, servo=servo)
    assert np.abs(np.diff(run.fins["r"])).max() <= 0.2 * 0.02 + 1e-12
    assert np.abs(run.fins["r"]).max() == pytest.approx(0.15)


@pytest.mark.parametrize("rudder, switch", [(10.0, 10.0), (20.0, 20.0), (15.0, 5.0)])
def test_zigzag_turns_back_at_the_switching_heading(remus, rudder, switch):
    run = autopilot.manoeuvre(
        remus, "zigzag", np.radians(rudder), np.radians(switch), duration=60.0
    )
    heading, side = run.angles[:, 2], np.sign(np.diff(run.fins["r"]))
    turning = np.flatnonzero(np.diff(side[side != 0.0]) != 0.0)
    assert len(turning) >= 3
    peaks = np.abs(heading[1:-1][np.diff(np.sign(np.diff(heading))) != 0.0])
    assert (peaks[1:] > np.radians(switch)).all()  # overshoot, never short of it


def test_a_zigzag_begins_to_either_side(remus):
    """A negative angle is the mirror image, with the same switching heading."""
    right, left = (
        autopilot.manoeuvre(remus, "zigzag", angle, duration=30.0).angles[:, 2]
        for angle in (0.2, -0.2)
    )
    assert np.abs(left).max() > 0.2
    assert left.min() == pytest.approx(-right.max(), rel=0.05)


@pytest.mark.parametrize(
    ("effects", "column", "least", "most"),
    [
        ({"ocean_current": {"east": 0.5}}, "y_m", 9.0, 11.0),  # half a metre a second
        ({"thruster_gain": {"gain_X": 0.5}}, "u", 1.0, 1.2),  # of 1.5, towards its root of a half
        ({"fin_offset": {"delta_r": 0.05}}, "rudder_deg", -3.0, -2.7),  # the rudder makes up for it
    ],
)
def test_steer_with_the_effects_of_the_file(effects, column, least, most, tmp_path):
    parameters = config.to_parameters(config.load(REMUS)) | {"effects": effects}
    config.dump(config.from_parameters(parameters), tmp_path / "c.yaml")
    arguments = ["--manoeuvre", "heading", "--angle", "0", "--duration", "20"]
    arguments += ["--config", str(tmp_path / "c.yaml"), "--out", str(tmp_path / "run.csv")]
    assert main(["steer", *arguments]) == 0
    assert least < read_csv(tmp_path / "run.csv").numbers(column)[-1] < most


@pytest.mark.parametrize("name", autopilot.MANOEUVRES)
def test_manoeuvres_as_a_command(name, tmp_path):
    out = tmp_path / "run.csv"
    arguments = ["steer", "--config", str(REMUS), "--manoeuvre", name, "--duration", "20"]
    assert main([*arguments, "--sample", "0.5", "--out", str(out)]) == 0
    table = read_csv(out)
    assert len(table.lines) == 41 and np.ptp(table.numbers("t_s")) == pytest.approx(20.0)
    moving = {"dive": "stern_deg"}.get(name, "rudder_deg")
    assert np.ptp(table.numbers(moving)) > 1.0


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["--manoeuvre", "dive", "--config", "bluerov2_heavy.yaml"], "has no M_uuds"),
        (["--manoeuvre", "turn", "--config", "bluerov2_heavy.yaml"], "has no N_uudr"),
    ],
)
def test_steer_without_fins_is_refused(arguments, sentence, tmp_path, capsys):
    arguments[-1] = str(ROOT / "config" / arguments[-1])
    assert main(["steer", *arguments, "--out", str(tmp_path / "run.csv")]) == 2
    assert sentence in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_vehicle_without_fins_is_refused():
    model = config.load(ROOT / "config" / "bluerov2_heavy.yaml").model
    with pytest.raises(UserError, match="no fin coefficients: add N_uudr"):
        autopilot.steer(model, autopilot.turn(0.1), 1.0, 1.0)
