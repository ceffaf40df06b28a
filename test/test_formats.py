"""Models in other programs' files: what they do there, and that nothing is lost in silence."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from test_cli import refused, run

from rov_ident import config as configuration
from rov_ident.errors import UserError
from rov_ident.formats import READERS, export, import_model
from rov_ident.simulate import simulate

COUPLED = {
    "Y_rdot": 0.4, "M_udot": -0.3, "N_v": -2.0, "Y_r": 1.5, "Y_uv": -12.0, "X_vv": 7.0,
    "K_v_abs_r": -1.0, "M_uu": 0.8, "Z_uq": -3.0, "N_uv": 4.0,
}  # fmt: skip


def parameters(heavy, coefficients=(), **vehicle):
    """The parameters of the Heavy with another body and more coefficients."""
    plain = configuration.to_parameters(heavy)
    plain["vehicle"] |= vehicle
    plain["coefficients"] |= dict(coefficients)
    return plain


@pytest.fixture
def coupled(heavy):
    """A vehicle with couplings, products of inertia and the centre of gravity off the origin."""
    return configuration.from_parameters(
        parameters(
            heavy,
            COUPLED,
            cog=[0.03, -0.01, 0.05],
            cob=[0.01, 0.02, -0.04],
            inertia=[0.3, 0.28, 0.4, 0.02, -0.03, 0.01],
            weight=13.5 * 9.81,
        )
    )


@pytest.fixture
def diagonal(heavy):
    return configuration.from_parameters(
        parameters(heavy, {"Y_v": -6.0, "K_p": -0.3}, cog=[0.0, 0.0, 0.03])
    )


def trajectory(config):
    """Twenty seconds under wrenches that turn every axis."""
    t = np.arange(0.0, 20.0, 0.02)
    phase = np.arange(6.0)
    wrench = np.sin(0.7 * t[:, None] * (1.0 + 0.3 * phase) + phase)
    return simulate(config.dynamics, t, wrench * [20.0, 20.0, 20.0, 1.0, 1.0, 2.0]).nu


def written(config, name, tmp_path):
    path = tmp_path / "file"
    path.write_text(export(config, name).content)
    return path


@pytest.mark.parametrize("name", READERS)
def test_read_again_it_moves_as_before(name, coupled, diagonal, tmp_path):
    config = coupled if name == "gazebo" else diagonal
    again, notes = import_model(written(config, name, tmp_path))
    assert notes == ()
    before = trajectory(config)
    assert np.abs(before).max() > 0.3
    np.testing.assert_allclose(trajectory(again), before, rtol=0, atol=1e-6)


# ------------------------------------------------------------------ Gazebo


def number(parent, path):
    return [float(x) for x in parent.find(path).text.split()]


def gazebo_acceleration(sdf, nu, down):
    """What Gazebo makes of the file: forward-left-up, from its documents, in textbook matrices."""
    model = ET.fromstring(sdf).find("model")
    link, plugin = model.find("link"), model.find("plugin")
    inertial = link.find("inertial")
    mass = number(inertial, "mass")[0]
    c = np.array(number(inertial, "pose")[:3])
    xx, yy, zz, xy, xz, yz = (
        number(inertial, f"inertia/i{k}")[0] for k in ("xx", "yy", "zz", "xy", "xz", "yz")
    )
    s = np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    m = np.block([[mass * np.eye(3), -mass * s], [mass * s, tensor - mass * s @ s]])
    for i, a in enumerate("xyzpqr"):
        for j, b in enumerate("xyzpqr"):
            if j >= i:
                value = number(inertial, f"fluid_added_mass/{a}{b}")[0]
                m[i, j] += value
                if i != j:
                    m[j, i] += value
    force = np.zeros(6)
    for i, a in enumerate("xyzkmn"):
        for j, b in enumerate("UVWPQR"):
            if (e := plugin.find(a + b)) is not None:
                force[i] += float(e.text) * nu[j]
            for k, d in enumerate("UVWPQR"):
                if (e := plugin.find(f"{a}{b}abs{d}")) is not None:
                    force[i] += float(e.text) * nu[j] * abs(nu[k])
                if (e := plugin.find(a + b + d)) is not None:
                    force[i] += float(e.text) * nu[j] * nu[k]
    p = m @ nu
    v, omega = nu[:3], nu[3:]
    force[:3] -= np.cross(omega, p[:3])
    force[3:] -= np.cross(omega, p[3:]) + np.cross(v, p[:3])
    volume = np.prod(number(link, "collision/geometry/box/size"))
    centre = np.array(number(link, "collision/pose")[:3])
    weight, lift = mass * 9.81 * down, -volume * 1000.0 * 9.81 * down
    force[:3] += weight + lift
    force[3:] += np.cross(c, weight) + np.cross(centre, lift)
    return np.linalg.solve(m, force)


def test_gazebo_computes_the_same_acceleration(coupled):
    content = export(coupled, "gazebo").content
    flip = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
    rng = np.random.default_rng(5)
    for _ in range(20):
        nu, down = rng.normal(size=6), rng.normal(size=3)
        down /= np.linalg.norm(down)
        expected = coupled.dynamics.acceleration(nu, np.zeros(6), down)
        there = gazebo_acceleration(content, flip * nu, flip[:3] * down)
        np.testing.assert_allclose(flip * there, expected, rtol=1e-9, atol=1e-9)


def test_gazebo_names_what_it_cannot_hold(heavy):
    plain = parameters(heavy, {"Z_ww_neg": -30.0}, weight=130.0)
    plain["effects"] = {
        "thruster_lag": {"time_constant": 0.2},
        "ocean_current": {"north": 0.1, "east": 0.2, "down": -0.05},
        "cog_offset": {"dx": 0.01},
    }
    config = configuration.from_parameters(plain)
    content, lost = export(config, "gazebo").content, export(config, "gazebo").lost
    assert len(lost) == 3
    assert any("thruster_lag" in what and "current" not in what for what in lost)
    assert any("Z_ww_neg" in what for what in lost)
    assert any("130 N" in what for what in lost)
    model = ET.fromstring(content).find("model")
    assert number(model, "plugin/default_current") == [0.2, 0.1, 0.05]  # east, north, up
    assert number(model, "link/inertial/pose")[0] == 0.01
    # The force that floats the vehicle is kept.
    volume = np.prod(number(model, "link/collision/geometry/box/size"))
    net = volume * 9810.0 - 13.5 * 9.81
    assert net == pytest.approx(heavy.model.body.buoyancy - 130.0)


STOCK = """<sdf version="1.6"><model name="bluerov2">
<link name="base_link"><inertial><mass>10</mass><inertia><ixx>0.1</ixx><iyy>0.2</iyy><izz>0.3</izz>
</inertia></inertial></link>
<link name="thruster1"><inertial><mass>0.3</mass></inertial></link>
<plugin name="gz::sim::systems::Hydrodynamics" filename="gz-sim-hydrodynamics-system">
<link_name>base_link</link_name>{}
</plugin></model></sdf>"""


def test_a_stock_gazebo_model(tmp_path):
    path = tmp_path / "model.sdf"
    tags = "<xDotU>0</xDotU><xUabsU>-33.8</xUabsU><yVabsV>-54.3</yVabsV><nR>-2</nR><nV>3</nV>"
    path.write_text(STOCK.format(tags + "<mUW>5</mUW>"))
    config, notes = import_model(path)
    values = dict(zip(config.model.names, config.model.theta, strict=True))
    # Up is down and left is right: the yaw moment per sway velocity keeps its sign, M per u w too.
    assert values == {"X_uu": -33.8, "Y_vv": -54.3, "N_r": -2.0, "N_v": 3.0, "M_uw": 5.0}
    assert config.model.body.buoyancy == config.model.body.weight == pytest.approx(98.1)
    assert len(notes) == 2
    assert "0.3 kg" in notes[0]
    assert "neutral" in notes[1]


def test_added_mass_of_either_sign(tmp_path):
    for text in ("<xDotU>5</xDotU><yDotR>-1</yDotR>", "<xDotU>-5</xDotU><yDotR>1</yDotR>"):
        path = tmp_path / "model.sdf"
        path.write_text(STOCK.format(text + "<xU>-1</xU>"))
        config, _ = import_model(path)
        # m nu_dot: 5 kg more in surge; left-up coupling keeps its sign forward-starboard-down.
        added = config.model.added_mass
        assert added[0, 0] == 5.0
        assert added[1, 5] == -1.0


# ------------------------------------------------------------------ auv_controllers


def test_ros_reads_the_parameters_of_auv_controllers(diagonal, tmp_path):
    from rclpy.parameter import parameter_dict_from_yaml_file

    path = written(diagonal, "auv_controllers", tmp_path)
    read = parameter_dict_from_yaml_file(str(path), use_wildcard=True)
    values = {name: p.value for name, p in read.items()}
    body = diagonal.model.body
    assert values["hydrodynamics.mass"].double_value == body.mass
    assert list(values["hydrodynamics.added_mass"].double_array_value) == [
        -6.36, -7.12, -18.68, -0.189, -0.135, -0.222,
    ]  # fmt: skip
    assert list(values["hydrodynamics.linear_damping"].double_array_value) == [
        -13.7, -6.0, -33.0, -0.3, -0.8, 0.0,
    ]  # fmt: skip
    about_origin = list(values["hydrodynamics.moments_of_inertia"].double_array_value)
    assert about_origin[0] == pytest.approx(0.26 + 13.5 * 0.03**2)
    assert about_origin[2] == 0.37


def test_auv_controllers_names_what_it_cannot_hold(coupled):
    lost = " ".join(export(coupled, "auv_controllers").lost)
    for name in (*COUPLED, "centre of gravity", "products of inertia"):
        assert name in lost


# ------------------------------------------------------------------ MSS


def test_the_matrices_of_mss_make_the_same_wrench(coupled):
    """The file's own formula, evaluated with its matrices; the terms it names as lost taken out."""
    out = export(coupled, "mss")
    held = {
        name: value
        for name, value in zip(coupled.model.names, coupled.model.theta, strict=True)
        if not any(name in what for what in out.lost)
    }
    assert "Y_uv" not in held
    assert "Y_r" in held
    plain = configuration.to_parameters(coupled) | {"coefficients": held}
    model = configuration.from_parameters(plain).model
    fields = {}
    for line in out.content.splitlines():
        if line.startswith("vehicle."):
            key, text = line.removeprefix("vehicle.").rstrip(";").split(" = ")
            rows = text.strip("[]").split("; ")
            fields[key] = np.array([[float(x) for x in row.split()] for row in rows])
    rng = np.random.default_rng(6)
    nu, nu_dot, down = rng.normal(size=6), rng.normal(size=6), np.array([0.6, 0.0, 0.8])
    m = fields["MRB"] + fields["MA"]
    p = m @ nu
    tau = m @ nu_dot + (fields["D"] + fields["Dn"] @ np.diag(np.abs(nu))) @ nu
    tau[:3] += np.cross(nu[3:], p[:3])
    tau[3:] += np.cross(nu[3:], p[3:]) + np.cross(nu[:3], p[:3])
    weight, buoyancy = fields["W"].item(), fields["B"].item()
    lever = weight * fields["rg"].ravel() - buoyancy * fields["rb"].ravel()
    tau -= np.concatenate([(weight - buoyancy) * down, np.cross(lever, down)])
    np.testing.assert_allclose(tau, model.wrench(nu, nu_dot, down), rtol=1e-12, atol=1e-12)


# ------------------------------------------------------------------ bad input, the commands


@pytest.mark.parametrize(
    ("content", "part"),
    [
        ("a: 1", "hydrodynamics"),
        ("hydrodynamics: {mass: 3}", "hydrodynamics.weight is missing"),
        ("<a", "not valid XML"),
        ("<robot name='x'/>", "a robot has one root"),
        ("<!DOCTYPE x><sdf/>", "entities"),
        (STOCK.format("<xU>two</xU>"), "must be numbers"),
        (STOCK.replace("<mass>10</mass>", "").format(""), "mass"),
        (STOCK.replace(">base_link<", ">other<").format(""), "other"),
        (STOCK.format("<xU>3</xU>"), "positive"),
    ],
)
def test_bad_files_are_refused_in_one_sentence(content, part, tmp_path):
    path = tmp_path / "model"
    path.write_text(content)
    with pytest.raises(UserError, match="model: .*" + part):
        import_model(path)


def test_the_commands(heavy_path, tmp_path):
    sdf, again = tmp_path / "heavy.sdf", tmp_path / "again.yaml"
    done = run("export", "--config", heavy_path, "--format", "gazebo", "--out", sdf)
    assert done.returncode == 0, done.stderr
    assert "lost" not in done.stderr
    done = run("import-model", sdf, "--out", again)
    assert done.returncode == 0, done.stderr
    before, after = configuration.load(heavy_path), configuration.load(again)
    np.testing.assert_allclose(trajectory(after), trajectory(before), rtol=0, atol=1e-6)
    refused(run("import-model", tmp_path / "none.sdf", "--out", again), "none.sdf")
    refused(run("import-model", sdf, "--out", sdf), "replaced")
