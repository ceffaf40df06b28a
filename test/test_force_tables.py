"""Force tables: structures found again, values within intervals, tables as people write them."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from tiers import more

from bench import DATA, ROOT
from rov_ident import config
from rov_ident.api.comparison import compare
from rov_ident.cli.program import main
from rov_ident.core.errors import UserError
from rov_ident.model.added_mass import cylinder, parse_hull, spheroid
from rov_ident.model.coefficients import AXES
from rov_ident.model.equations import build
from rov_ident.model.fins import X
from rov_ident.offline import captive_report
from rov_ident.offline import captive_tests as force_tables
from rov_ident.steering import autopilot

REMUS = str(ROOT / "config" / "remus100.yaml")
CAPTIVE = DATA / "kvlcc2-model" / "captive.csv"


def design():
    """States nu (n, 6) and fins: speeds x (alpha, beta, turning circles, fin angles)."""
    rows = []
    for speed in (0.5, 1.0, 1.5, 2.0):
        for angle in np.radians([-12, -8, -4, 0, 4, 8, 12]):
            rows.append((speed, angle, 0, 0, 0, 0, 0))
            rows.append((speed, 0, angle, 0, 0, 0, 0))
        for radius in (5, 10, 20, -5, -10, -20):
            rate = speed / radius
            rows += [(speed, 0, b, 0, rate, 0, 0) for b in np.radians([-6, 0, 6])]
            rows += [(speed, a, 0, rate, 0, 0, 0) for a in np.radians([-6, 0, 6])]
        for fin in np.radians([-20, -10, 10, 20]):
            rows += [(speed, 0, 0, 0, 0, fin, 0), (speed, 0, 0, 0, 0, 0, fin)]
    speed, alpha, beta, q, r, rudder, stern = np.array(rows).T
    nu = np.zeros((len(speed), 6))
    nu[:, 0] = speed * np.cos(alpha) * np.cos(beta)
    nu[:, 1] = speed * np.sin(beta)
    nu[:, 2] = speed * np.sin(alpha) * np.cos(beta)
    nu[:, 4], nu[:, 5] = q, r
    return nu, {"r": rudder, "s": stern}


TERMS = {
    "X": "X_uu X_vv X_ww X_qq X_rr X_vr X_wq X_uudrdr X_uudsds",
    "Y": "Y_uv Y_vv Y_ur Y_rr Y_uudr Y_v Y_r",
    "Z": "Z_uw Z_ww Z_uq Z_qq Z_uuds Z_w Z_q Z_uu",
    "M": "M_uw M_ww M_uq M_qq M_uuds M_w M_q M_uu",
    "N": "N_uv N_vv N_ur N_rr N_uudr N_v N_r",
}


def drawn(rng, axis, nu, fins, noise):
    """A structure with values, each of its terms between 30 and 100 % of the largest; its force."""
    names = TERMS[axis].split()
    chosen = [names[0], *rng.choice(names[1:], rng.integers(2, len(names)), replace=False)]
    values, force = {}, np.zeros(len(nu))
    for name in map(str, chosen):
        column = force_tables.column(name, nu, fins)
        values[name] = -rng.uniform(3.0, 10.0) / np.abs(column).max()
        force += values[name] * column
    force = force + noise * np.abs(force) * rng.standard_normal(len(nu))
    return values, force + 0.2 * noise * np.std(force) * rng.standard_normal(len(nu))


@pytest.mark.parametrize("noise", [*more(0.01), 0.03])
def test_drawn_structures_are_found_again(noise):
    rng = np.random.default_rng(5)
    nu, fins = design()
    right, inside = [], []
    for _ in range(12):
        for axis in TERMS:
            truth, force = drawn(rng, axis, nu, fins, noise)
            fit = force_tables.fit_axis(axis, nu, fins, force)
            right.append(set(fit.names) == set(truth))
            if right[-1]:
                error = fit.values - [truth[name] for name in fit.names]
                inside += (np.abs(error) <= fit.quantile * fit.std).tolist()
    assert np.mean(right) >= 0.9
    assert 0.9 <= np.mean(inside) <= 0.98


def test_cross_validation_is_leaving_rows_out():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(15, 3)), rng.normal(size=15)
    direct = []
    for i in range(15):
        rest = np.arange(15) != i
        direct.append(y[i] - x[i] @ np.linalg.lstsq(x[rest], y[rest], rcond=None)[0])
    np.testing.assert_allclose(force_tables._left_out(x, y), direct, atol=1e-12)


# ------------------------------------------------------------------ tables as files


def write(path, columns):
    names = list(columns)
    rows = zip(*columns.values())
    lines = [",".join(names), *(",".join(f"{x:.10g}" for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def steady_forces(model, nu, fins):
    """What a tank measures: damping and fins less the Coriolis force of the added mass."""
    forces = []
    for state, r, s in zip(nu, fins["r"], fins["s"]):
        moving = model.wrench(state, np.zeros(6), np.array([0.0, 0.0, 1.0]))
        rigid = model.body.mass_matrix @ state
        of_body = np.concatenate(
            [
                np.cross(state[3:], rigid[:3]),
                np.cross(state[3:], rigid[3:]) + np.cross(state[:3], rigid[:3]),
            ]
        )
        force = of_body + model.restoring_force(np.array([0.0, 0.0, 1.0])) - moving
        forces.append(force + model.input_wrench(state, np.array([s, r, 0.0, 0.0])))
    return np.array(forces)


@pytest.fixture(scope="module")
def remus_table(tmp_path_factory):
    """The REMUS 100 as a table of forces, with 1 % noise, angles in degrees."""
    model = config.load(REMUS).model
    nu, fins = design()
    rng = np.random.default_rng(2)
    forces = steady_forces(model, nu, fins)
    forces += 0.01 * np.abs(forces) * rng.standard_normal(forces.shape)
    forces += 0.002 * np.std(forces, axis=0) * rng.standard_normal(forces.shape)
    columns = dict(zip("uvwqr", nu[:, [0, 1, 2, 4, 5]].T))
    columns |= {"rudder_deg": np.degrees(fins["r"]), "stern_deg": np.degrees(fins["s"])}
    columns |= {axis: forces[:, AXES.index(axis)] for axis in "XYZMN"}
    return write(tmp_path_factory.mktemp("table") / "remus.csv", columns)


def test_remus_from_its_table_into_a_configuration(remus_table, tmp_path):
    out, result = tmp_path / "new.yaml", tmp_path / "f.json"
    arguments = ["forces", str(remus_table), "--config", REMUS]
    assert main([*arguments, "--json", str(result), "--out", str(out)]) == 0
    axes = json.loads(result.read_text())["axes"]
    truth = config.load(REMUS).model
    known = truth.values
    for axis, name in (("X", "X_uu"), ("Y", "Y_uudr"), ("N", "N_uudr"), ("M", "M_uuds"),
                       ("N", "N_uv"), ("N", "N_ur"), ("Y", "Y_uv"), ("M", "M_uw")):  # fmt: skip
        term = axes[axis]["terms"][name]
        assert abs(term["value"] - known[name]) < 4.0 * term["std"], name
        assert {"value", "std", "unit", "lower", "upper"} <= set(term)
    for axis in axes.values():
        assert axis["cv_rmse"] > 0.0 and axis["candidates"][0].keys() == {"terms", "cv_rmse"}
        assert axis["cv_rmse"] >= axis["candidates"][0]["cv_rmse"]
    # the vehicle made from the table turns and dives as the one the table was made from
    made = config.load(out).model
    np.testing.assert_allclose(made.added_mass, truth.added_mass)
    law = autopilot.both(autopilot.turn(0.1), autopilot.to_depth(3.0, -1.0))
    runs = [autopilot.steer(model, law, 40.0, 1.5) for model in (truth, made)]
    assert abs(runs[0].angles[-1, 2]) > 2.0 and abs(runs[0].position[-1, 2] - 3.0) < 0.5
    np.testing.assert_allclose(runs[1].angles[:, 2], runs[0].angles[:, 2], atol=0.1)
    np.testing.assert_allclose(runs[1].position, runs[0].position, atol=1.0)


def test_coriolis_of_the_added_mass_is_not_counted_twice(remus_table):
    table = force_tables.read_table(remus_table)
    truth = config.load(REMUS).model
    known = dict(zip(truth.names, truth.theta))
    munk = known["Y_vdot"] - known["X_udot"]
    whole = dict(zip(*_terms(force_tables.fit(table)["N"])))
    own = dict(zip(*_terms(force_tables.fit(table, truth)["N"])))
    assert whole["N_uv"] - own["N_uv"] == pytest.approx(munk, rel=0.02)


def _terms(fit):
    return fit.names, fit.values


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_flow_angles_of_either_sign(tmp_path, side):
    """A hull resists sway: the table says by itself whether beta is a drift to starboard."""
    speed, beta = (
        a.ravel() for a in np.meshgrid([0.5, 1.0, 1.5], np.radians(np.arange(-12, 13, 3)))
    )
    u, v = speed * np.cos(beta), side * speed * np.sin(beta)
    y = -30.0 * u * v - 100.0 * v * np.abs(v)
    y += 0.01 * np.random.default_rng(0).normal(size=len(y))
    path = write(tmp_path / "t.csv", {"U_mps": speed, "beta_deg": np.degrees(beta), "Y": y})
    fit = force_tables.fit(force_tables.read_table(path))["Y"]
    found = dict(zip(fit.names, fit.values))
    assert found["Y_uv"] == pytest.approx(-30.0, rel=0.02)
    assert found["Y_vv"] == pytest.approx(-100.0, rel=0.05)
    other = force_tables.read_table(path, drift="port")
    np.testing.assert_allclose(other.nu[:, 1], -speed * np.sin(beta), atol=1e-9)


def test_drift_on_a_rotating_arm(tmp_path):
    """Bow in, drift and turning go together, and the force of turning outweighs that of drift."""
    beta, rate = np.array([[0, 2, 4, 6, 8, 10, 4, 8], [0, 2, 4, 6, 8, 10, 2, 4]])
    speed, beta, r = 1.5 + 0.0 * beta, np.radians(beta), 0.1 * rate
    u, v = speed * np.cos(beta), speed * np.sin(beta)
    y = -28.6 * u * v + 12.0 * u * r
    columns = {"U_mps": speed, "beta_rad": beta, "r": r, "Y": y, "N": -10.0 * u * v - 4.0 * u * r}
    table = force_tables.read_table(write(tmp_path / "t.csv", columns))
    np.testing.assert_allclose(table.nu[:, 1], v, atol=1e-9)
    assert not table.notes


def test_rates_over_speed_and_length(tmp_path):
    """As r' = r L / U, under its own heading or another; not as rad/s, and not passed over."""
    speed, r = (a.ravel() for a in np.meshgrid([0.5, 1.0, 1.5], [-0.4, -0.2, 0.0, 0.2, 0.4]))
    columns = {"U_mps": speed, "r'": 2.0 * r / speed, "N'": -r / (500.0 * speed * 8.0)}
    path = write(tmp_path / "t.csv", columns)
    scale = force_tables.parse_nondimensional("rho=1000,L=2")
    table = force_tables.read_table(path, nondimensional=scale)
    np.testing.assert_allclose(table.nu[:, 5], r, atol=1e-9)
    with pytest.raises(UserError, match="r' looks non-dimensional: give --nondimensional"):
        force_tables.read_table(path, {"N": "N'"})
    with pytest.raises(UserError, match="but r is read in rad/s: map it to r'"):
        force_tables.read_table(path, {"r": "r'"}, scale)


def test_a_term_of_the_table_by_its_other_name_in_the_file(tmp_path):
    """Y_vu of the file is Y_uv of the table."""
    vehicle = config.load(REMUS)
    other = {"Y_vu" if n == "Y_uv" else n: x for n, x in vehicle.model.values.items()}
    vehicle = vehicle.with_model(build(vehicle.model.body, other))
    u, v = (a.ravel() for a in np.meshgrid([1.0, 1.5, 2.0], [-0.3, -0.15, 0.0, 0.15, 0.3]))
    noise = 0.01 * np.random.default_rng(0).standard_normal(len(u))
    path = write(tmp_path / "t.csv", {"u": u, "v": v, "Y": -30.0 * u * v + noise})
    new = force_tables.configured(vehicle, force_tables.fit(force_tables.read_table(path)))
    assert new.value("Y_uv") == pytest.approx(-30.0, rel=0.01) and "Y_vu" not in new.model.names


def test_radius_x_tail_and_comments(tmp_path):
    speed = np.tile([0.5, 1.0, 1.5, 2.0], 6)
    radius = np.repeat([np.inf, 5.0, 10.0, -5.0, -10.0, 20.0], 4)
    stern = 0.1 * np.sin(np.arange(24.0))
    fins = np.transpose([[y, z, -1.0] for y, z in X.spans.values()])
    single = np.column_stack([stern, np.zeros(24), np.zeros(24)]) @ fins
    lines = ["# rotating arm", "U_mps,R_m,ul_rad,ur_rad,ll_rad,lr_rad,M,N"]
    for i in range(24):
        m = -6.0 * speed[i] ** 2 * stern[i] + 1e-3 * np.cos(7.0 * i)
        n = -4.0 * speed[i] ** 2 / radius[i] + 1e-3 * np.sin(5.0 * i)
        where = "" if np.isinf(radius[i]) else f"{radius[i]}"
        cells = [f"{speed[i]}", where, *(f"{a:.12f}" for a in single[i]), f"{m}", f"{n}"]
        lines.append(",".join(cells))
    path = tmp_path / "t.csv"
    path.write_text("\n".join(lines))
    table = force_tables.read_table(path)
    np.testing.assert_allclose(table.nu[:, 5], speed / radius)
    np.testing.assert_allclose(table.fins["s"], stern, atol=1e-9)
    fits = force_tables.fit(table)
    assert fits["M"].names == ("M_uuds",) and fits["N"].names == ("N_ur",)
    assert fits["N"].values[0] == pytest.approx(-4.0, rel=1e-2)


def test_nondimensional_forces_and_mapped_headings(tmp_path):
    speed, beta = (a.ravel() for a in np.meshgrid([0.6, 1.0, 1.4], np.arange(-20.0, 21.0, 5.0)))
    v = -speed * np.sin(np.radians(beta))  # drift to port
    u = speed * np.cos(np.radians(beta))
    y, n = -50.0 * u * v, -80.0 * u * v
    area = 0.5 * 1000.0 * speed**2 * 7.0 * 0.4
    columns = {"Speed(m/s)": speed, "beta(deg)": beta, "Y'": y / area, "N'": n / (7.0 * area)}
    path = write(tmp_path / "t.csv", columns)
    result = tmp_path / "f.json"
    arguments = ["forces", str(path), "--map", "U_mps=Speed(m/s)", "beta_deg=beta(deg)"]
    arguments += ["--nondimensional", "rho=1000,L=7,T=0.4", "--json", str(result)]
    assert main(arguments) == 0
    axes = json.loads(result.read_text())["axes"]
    assert axes["Y"]["terms"]["Y_uv"]["value"] == pytest.approx(-50.0, rel=1e-6)
    assert axes["N"]["terms"]["N_uv"]["value"] == pytest.approx(-80.0, rel=1e-6)
    assert axes["N"]["terms"]["N_uv"]["unit"] == "N m s2/m2"


@pytest.mark.skipif(not CAPTIVE.exists(), reason="the measured captive runs are not here")
def test_measured_captive_runs(tmp_path):
    """KVLCC2: a hull resists sway, its rudder pushes to starboard and turns to port."""
    result = tmp_path / "f.json"
    arguments = ["forces", str(CAPTIVE), "--map", "U_mps=Speed(m/s)", "beta_deg=beta(deg)"]
    arguments += ["rudder_deg=delta(deg)", "--nondimensional", "rho=1000,L=7"]
    assert main([*arguments, "--json", str(result)]) == 0
    axes = json.loads(result.read_text())["axes"]
    assert axes["X"]["r2"] > 0.9 and axes["Y"]["r2"] > 0.99 and axes["N"]["r2"] > 0.99
    assert axes["Y"]["terms"]["Y_uv"]["value"] < 0.0 and axes["N"]["terms"]["N_uv"]["value"] < 0.0
    fin = {a: next(v["value"] for k, v in axes[a]["terms"].items() if "dr" in k) for a in "YN"}
    assert fin["Y"] > 0.0 and fin["N"] < 0.0


# ------------------------------------------------------------------ what is refused


def table(**changes):
    u = np.array([0.5, 0.8, 1.0, 1.3, 1.6, 2.0, 2.3, 2.6])
    columns = {"u": u, "X": -3.0 * u**2 + 0.01 * np.cos(9.0 * u)}
    columns |= changes
    return {name: values for name, values in columns.items() if values is not None}


ANGLES = np.array([-10.0, -5.0, 0.0, 5.0, 10.0, -5.0, 5.0, 10.0])
REFUSED = {
    "no velocity": (table(u=None, rps=ANGLES), "has no velocities: name u v w p q r, or U_mps"),
    "no force": (table(X=None), "has no forces: name X Y Z K M N"),
    "primes": (table(X=None, **{"X'": ANGLES}), "give --nondimensional rho=...,L=..."),
    "constant force": (table(Y=0.0 * ANGLES + 1.0), "the column Y is constant, 1: remove it"),
    "one condition": (table(u=0.0 * ANGLES + 1.0), "every row is the same condition"),
    "angle without unit": (table(rudder=ANGLES), "is the column `rudder` in degrees or radians"),
    "degrees as radians": (table(rudder_rad=ANGLES), "reaches 10, which looks like degrees"),
    "radians as degrees": (table(rudder_deg=ANGLES / 57.3), "which looks like radians"),
    "both units": (table(rudder_deg=ANGLES, rudder_rad=ANGLES / 57.3), "remove one of them"),
    "unknown angle": (table(flap_deg=ANGLES), "the angle `flap_deg` is not known here"),
    "drift without speed": (table(u=None, beta_deg=ANGLES), "no speed: add U_mps"),
    "two speeds": (table(U_mps=np.abs(ANGLES)), "has U_mps and u: keep one way"),
    "half a tail": (table(ul_deg=ANGLES), "lacks the fin ll_deg of the x tail"),
    "not a number": (table(X=np.where(ANGLES == 0.0, np.nan, ANGLES)), "`nan` is not a number"),
    "degrees a second": (table(r=3.0 * ANGLES), "looks like degrees a second"),
    "too few": ({k: v[:4] for k, v in table().items()}, "4 different conditions are too few"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_tables_are_refused_in_a_sentence(case, tmp_path, capsys):
    columns, sentence = REFUSED[case]
    path = write(tmp_path / "t.csv", columns)
    result = tmp_path / "f.json"
    assert main(["forces", str(path), "--json", str(result)]) == 2
    captured = capsys.readouterr()
    assert sentence in captured.err.replace("\n", " ") and captured.err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["--map", "beta_deg=drift"], "has no column `drift` for beta_deg"),
        (["--map", "X=X [kN]"], "`X [kN]` seems to be in kN, but X is read in SI units"),
        (["--map", "u=v (km/h)"], "seems to be in km/h, but u is read in SI units"),
        (["--nondimensional", "rho=1000"], "lacks L"),
        (["--nondimensional", "rho=1000,L=-1"], "all positive"),
        (["--out", "c.yaml"], "need --config"),
        (["--config", REMUS, "--hull", "cube:L=1,R=1"], "give cylinder:L=LENGTH"),
    ],
)
def test_bad_arguments_are_refused(arguments, sentence, tmp_path, capsys):
    path = write(tmp_path / "t.csv", table(**{"X [kN]": ANGLES, "v (km/h)": ANGLES}))
    assert main(["forces", str(path), *arguments]) == 2
    assert sentence in capsys.readouterr().err


def test_a_driving_hull_is_not_written(tmp_path, capsys):
    """Damping of the wrong sign makes no vehicle, and no file."""
    path = write(tmp_path / "t.csv", table(X=3.0 * table()["u"] ** 2 + 0.01 * np.cos(ANGLES)))
    out = tmp_path / "c.yaml"
    assert main(["forces", str(path), "--config", REMUS, "--out", str(out)]) == 2
    assert "X_uu" in capsys.readouterr().err and not out.exists()


# ------------------------------------------------------------------ added mass


def test_cylinder_is_strip_theory():
    mass = np.pi * 1000.0 * 0.1**2 * 2.0
    found = cylinder(2.0, 0.1, 1000.0)
    assert found["X_udot"] == pytest.approx(-0.1 * mass)
    assert found["Y_vdot"] == found["Z_wdot"] == pytest.approx(-mass)
    # strips of the same mass: the integral of x^2 over the length
    x = np.linspace(-1.0, 1.0, 20001)
    strips = np.trapezoid(np.pi * 1000.0 * 0.01 * x**2, x)
    assert found["N_rdot"] == found["M_qdot"] == pytest.approx(-strips, rel=1e-6)


def test_spheroid_tends_to_sphere_and_needle():
    sphere = 4.0 / 3.0 * np.pi * 1000.0 * 0.1**3
    nearly = spheroid(0.2001, 0.1, 1000.0)
    assert nearly["X_udot"] == pytest.approx(-0.5 * sphere, rel=2e-3)  # half the displaced mass
    assert nearly["Y_vdot"] == pytest.approx(-0.5 * sphere, rel=2e-3)
    assert abs(nearly["N_rdot"]) < 1e-3 * sphere * 0.1**2  # a sphere turns freely
    long = spheroid(20.0, 0.1, 1000.0)
    mass = 4.0 / 3.0 * np.pi * 1000.0 * 10.0 * 0.1**2
    assert long["Y_vdot"] == pytest.approx(-mass, rel=0.01) and abs(long["X_udot"]) < 0.01 * mass
    assert long["N_rdot"] == pytest.approx(-mass * 10.0**2 / 5.0, rel=0.01)


@pytest.mark.parametrize(
    "ratio, k1, k2, k", [(2.0, 0.209, 0.702, 0.240), (2.99, 0.122, 0.803, 0.465),
                         (4.99, 0.059, 0.895, 0.701), (9.97, 0.021, 0.960, 0.883)]
)  # fmt: skip
def test_spheroid_agrees_with_lambs_integrals_and_table(ratio, k1, k2, k):
    """Lamb (1932), art. 114: alpha and beta as integrals; p. 155: the table, to its last digit."""
    a, b = 0.1 * ratio, 0.1
    alpha, beta = (
        a * b**2 * quad(lambda x, p=p: (a**2 + x) ** (p - 2.5) * (b**2 + x) ** -p, 0, np.inf)[0]
        for p in (1, 2)
    )
    mass = 4.0 / 3.0 * np.pi * 1000.0 * a * b**2
    found = spheroid(2.0 * a, b, 1000.0)
    assert -found["X_udot"] / mass == pytest.approx(alpha / (2.0 - alpha), rel=1e-6)
    assert -found["Y_vdot"] / mass == pytest.approx(beta / (2.0 - beta), rel=1e-6)
    turn = mass * (a**2 + b**2) / 5.0
    table = (-found["X_udot"] / mass, -found["Y_vdot"] / mass, -found["N_rdot"] / turn)
    assert table == pytest.approx((k1, k2, k), abs=2.5e-3)


def test_what_is_left_unused_is_named(tmp_path):
    path = tmp_path / "table.csv"
    rows = [f"{u},{-3.0 * u**2},{8.0 + u},x" for u in np.linspace(0.2, 2.0, 12)]
    path.write_text("\n".join(["u,X,lift force,remark", *rows]))
    found = force_tables.read_table(path)
    (note,) = found.notes
    assert note.startswith("headings not understood") and note.endswith(": lift force, remark")
    assert found.not_understood == ("lift force", "remark")
    result = tmp_path / "f.json"
    assert main(["forces", str(path), "--json", str(result)]) == 0
    assert json.loads(result.read_text())["not_understood"] == ["lift force", "remark"]
    assert "same data" in compare(result, result).notes[0]  # by the sha256 of the table


@pytest.mark.parametrize(
    "heading, likely",
    [("beta(deg)", "beta_deg"), ("Drift angle [deg]", "beta_deg"), ("delta (rad)", "rudder_rad"),
     ("yaw rate (rad/s)", "r"), ("v [m/s]", "v"), ("elevator_deg", None), ("r", None)],
)  # fmt: skip
def test_a_heading_that_is_likely_a_state_is_not_passed_over(tmp_path, heading, likely):
    """Left out, its forces would be laid to the other states."""
    path = tmp_path / "table.csv"
    rows = [f"{u},{-3.0 * u**2},{2.0 + u}" for u in np.linspace(0.2, 2.0, 12)]
    path.write_text("\n".join([f"U_mps,X,{heading}", *rows]))
    if likely is None:
        assert force_tables.read_table(path).not_understood == ()
        return
    with pytest.raises(UserError, match=f"looks like {likely}: say so with --map"):
        force_tables.read_table(path)


def test_headline_of_the_report(tmp_path, capsys):
    """What was found comes first, with interval and unit, on the page and in the terminal."""
    u = np.linspace(0.2, 2.0, 12)
    noise = 0.01 * np.cos(9.0 * u)
    path = write(tmp_path / "t.csv", {"u": u, "X": -3.0 * u**2 + noise})
    page = tmp_path / "f.html"
    assert main(["forces", str(path), "--report", str(page)]) == 0
    fit = force_tables.fit(force_tables.read_table(path))["X"]
    low, high = f"{fit.lower[0]:.5g}", f"{fit.upper[0]:.5g}"
    out, text = capsys.readouterr().out, page.read_text()
    assert all(word in out for word in ("X_uu", low, high, "N s2/m2"))
    first = text[text.index("<h1") : text.index("<h2")]
    assert "X_uu = -3.00" in first and low in first and high in first and "N s2/m2" in first


def test_the_chosen_structure_is_in_the_table_of_its_page(tmp_path):
    """Where ten others have less error than the simplest that is as good, too."""
    u = np.linspace(0.2, 2.0, 12)
    path = write(tmp_path / "t.csv", {"u": u, "X": -3.0 * u**2 + 0.01 * np.cos(9.0 * u)})
    fit = force_tables.fit(force_tables.read_table(path))["X"]
    others = tuple(
        force_tables.Candidate((*fit.names, f"X_{i}"), 0.1 * i * fit.cv_rmse) for i in range(10)
    )
    own = force_tables.Candidate(fit.names, fit.cv_rmse)
    page = captive_report.page("t", {"X": replace(fit, candidates=(*others, own))})
    assert re.search(rf"<td[^>]*>{' '.join(fit.names)}</td>", page[page.index("structure</th>") :])


def test_hull_in_words():
    assert parse_hull("cylinder:L=2,R=0.1,rho=1000") == cylinder(2.0, 0.1, 1000.0)
    for wrong in ("cylinder", "spheroid:L=0.1,R=0.1", "cylinder:L=2", "cylinder:L=-1,R=1"):
        with pytest.raises(UserError):
            parse_hull(wrong)


def test_intervals_hold_the_choice_of_the_structure():
    """A term too small to be seen adds its share to its neighbours, which were up to 19 standard
    deviations off."""
    off = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        nu = np.zeros((120, 6))
        speed, drift = rng.uniform(0.5, 2.0, 120), np.radians(rng.uniform(-20.0, 20.0, 120))
        nu[:, 0], nu[:, 1] = speed * np.cos(drift), speed * np.sin(drift)
        nu[:, 5] = rng.uniform(-0.3, 0.3, 120)
        u, v, r = nu[:, 0], nu[:, 1], nu[:, 5]
        true = {"Y_vv": -80.0, "Y_uv": -30.0, "Y_ur": 9.0}
        force = -80.0 * np.abs(v) * v - 30.0 * u * v + 9.0 * u * r
        force += 0.1 * np.abs(force).max() * rng.standard_normal(120)
        found = force_tables.fit_axis("Y", nu, {}, force)
        off += [(found.value(n) - true[n]) / found.std[found.names.index(n)]
                for n in found.names if n in true]  # fmt: skip
    assert np.mean(np.abs(off) < 1.96) > 0.85
    assert np.max(np.abs(off)) < 5.0


def test_repeated_runs_do_not_vouch_for_one_another():
    """Six runs of each condition share its error: 95 % intervals hold the truth as they say."""
    inside = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        nu = np.zeros((25, 6))
        nu[:, 0], nu[:, 1] = rng.uniform(0.5, 2.0, 25), rng.uniform(-0.5, 0.5, 25)
        force = -30.0 * nu[:, 0] * nu[:, 1] - 80.0 * np.abs(nu[:, 1]) * nu[:, 1]
        common = force + 0.5 * rng.standard_normal(25)
        runs = np.repeat(common, 6) + 0.1 * rng.standard_normal(150)
        found = force_tables.fit_axis("Y", np.repeat(nu, 6, axis=0), {}, runs)
        if set(found.names) == {"Y_uv", "Y_vv"}:
            truth = np.array([{"Y_uv": -30.0, "Y_vv": -80.0}[name] for name in found.names])
            inside += list((found.lower <= truth) & (truth <= found.upper))
    assert len(inside) >= 30  # the structure is found; as separate rows in 12 of 20
    assert np.mean(inside) > 0.8


@pytest.mark.parametrize("separator", ";\t ")
def test_another_separator_is_named(separator, tmp_path, capsys):
    path = tmp_path / "t.csv"
    path.write_text("u,X\n1,-1\n2,-4\n".replace(",", separator))
    assert main(["forces", str(path)]) == 2
    assert f"separates its columns by {separator!r}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "change, sentence", [("resistance", "X_uu is positive"), ("slip", "far off the fit")]
)
def test_what_spoils_a_table_is_said(change, sentence):
    rng = np.random.default_rng(1)
    nu = np.zeros((60, 6))
    nu[:, 0] = rng.uniform(0.3, 2.0, 60)
    force = -20.0 * nu[:, 0] ** 2 + 0.2 * rng.standard_normal(60)
    proportional = force * (1.0 + 0.05 * rng.standard_normal(60))
    clean = force_tables.ForceTable("clean", nu, {}, {"X": proportional})
    assert not force_tables.remarks(force_tables.fit(clean), True)
    wrong = -force if change == "resistance" else np.where(np.arange(60) == 7, -3.0 * force, force)
    fits = force_tables.fit(force_tables.ForceTable("wrong", nu, {}, {"X": wrong}))
    assert any(sentence in remark for remark in force_tables.remarks(fits, True))


def test_a_force_that_drives_beside_the_way_ahead_is_said():
    """Lift of the wrong sign: of a table with u and v no drift angle is turned round."""
    rng = np.random.default_rng(1)
    nu = np.zeros((60, 6))
    nu[:, 0], nu[:, 1] = rng.uniform(0.5, 2.0, 60), rng.uniform(-0.5, 0.5, 60)
    force = 30.0 * nu[:, 0] * nu[:, 1] + 0.1 * rng.standard_normal(60)
    (remark,) = force_tables.remarks(
        force_tables.fit(force_tables.ForceTable("resistance", nu, {}, {"Y": force})), True
    )
    assert "Y_uv is positive, so Y would drive the vehicle along its own motion" in remark


def test_a_table_that_lacks_what_varied_is_said():
    """Runs at several angles of drift, without the column of the drift."""
    rng = np.random.default_rng(1)
    nu = np.zeros((90, 6))
    nu[:, 0] = np.repeat(np.linspace(0.5, 2.0, 10), 9)
    drift = np.tile(np.radians(np.linspace(-10.0, 20.0, 9)), 10)
    force = -30.0 * nu[:, 0] ** 2 * drift * (1.0 + 0.03 * rng.standard_normal(90))
    fits = force_tables.fit(force_tables.ForceTable("no beta", nu, {}, {"Y": force}))
    assert any("rows of the same condition differ" in r for r in force_tables.remarks(fits, True))
