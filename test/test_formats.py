"""Models in other programs' files: what they do there, and that nothing is lost in silence."""

import dataclasses
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lxml import etree
from test_cli import refused, run

from rov_ident import config as configuration
from rov_ident.consumer.formats import READERS, WRITERS, export, import_model
from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_from_euler, quaternion_to_matrix
from rov_ident.effects import EFFECTS
from rov_ident.model.coefficients import catalogue, input_catalogue, parse
from rov_ident.model.equations import GRAVITY
from rov_ident.simulation.open_loop import simulate

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
    return simulate(config.dynamics, t, wrench_over(t)).nu


def wrench_over(t):
    phase = np.arange(6.0)
    wrench = np.sin(0.7 * t[:, None] * (1.0 + 0.3 * phase) + phase)
    return wrench * [20.0, 20.0, 20.0, 1.0, 1.0, 2.0]


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


def gazebo(sdf):
    """What Gazebo makes of the file: forward-left-up, from its documents, in textbook matrices.

    Gives ``acceleration(nu, down, tau)``.
    """
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
    linear, absolute, product = np.zeros((6, 6)), np.zeros((6, 6, 6)), np.zeros((6, 6, 6))
    for i, a in enumerate("xyzkmn"):
        for j, b in enumerate("UVWPQR"):
            linear[i, j] = float(plugin.findtext(a + b, "0"))
            for k, d in enumerate("UVWPQR"):
                absolute[i, j, k] = float(plugin.findtext(f"{a}{b}abs{d}", "0"))
                product[i, j, k] = float(plugin.findtext(a + b + d, "0"))
    volume = np.prod(number(link, "collision/geometry/box/size"))
    centre = np.array(number(link, "collision/pose")[:3])

    def acceleration(nu, down, tau):
        force = tau + linear @ nu + absolute @ abs(nu) @ nu + product @ nu @ nu
        p = m @ nu
        v, omega = nu[:3], nu[3:]
        force[:3] -= np.cross(omega, p[:3])
        force[3:] -= np.cross(omega, p[3:]) + np.cross(v, p[:3])
        weight, lift = mass * 9.81 * down, -volume * 1000.0 * 9.81 * down
        force[:3] += weight + lift
        force[3:] += np.cross(c, weight) + np.cross(centre, lift)
        return np.linalg.solve(m, force)

    return acceleration


@pytest.fixture(scope="session")
def schema():
    return etree.XMLSchema(etree.parse(Path(__file__).with_name("sdf.xsd")))


# The tags of the plugin's documentation: linear, quadratic and absolute stability derivatives.
_DERIVATIVE = re.compile("[xyzkmn][UVWPQR]((abs)?[UVWPQR])?")


def test_the_schema_of_sdformat_takes_the_file(coupled, heavy, schema):
    for config in (coupled, heavy):
        content = export(config, "gazebo").content
        document = etree.fromstring(content.encode())
        schema.assertValid(document)
        for child in document.find("model/plugin"):
            known = ("link_name", "disable_added_mass", "disable_coriolis")
            assert child.tag in known or _DERIVATIVE.fullmatch(child.tag), child.tag
        for wrong in (
            content.replace("<mass>", "<maas>").replace("</mass>", "</maas>"),
            re.sub("<size>(\\S+) ", "<size>", content),
            re.sub("<rr>.*</rr>", "", content),
            content.replace("<ixx>", "<ixx>-"),
        ):
            assert wrong != content
            assert not schema.validate(etree.fromstring(wrong.encode()))


def test_gazebo_computes_the_same_acceleration(coupled):
    there = gazebo(export(coupled, "gazebo").content)
    flip = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
    rng = np.random.default_rng(5)
    for _ in range(20):
        nu, down = rng.normal(size=6), rng.normal(size=3)
        down /= np.linalg.norm(down)
        expected = coupled.dynamics.acceleration(nu, np.zeros(6), down)
        found = there(flip * nu, flip[:3] * down, np.zeros(6))
        np.testing.assert_allclose(flip * found, expected, rtol=1e-9, atol=1e-9)


def test_gazebo_moves_as_the_vehicle_does(coupled):
    """The exported file in open loop, integrated here: ten seconds, forward-left-up."""
    there = gazebo(export(coupled, "gazebo").content)
    flip = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
    dt, wrenches = 0.02, wrench_over(np.arange(0.0, 10.0, 0.02))

    def slope(x, tau):
        nu, down = x[:6], x[6:]
        return np.concatenate([there(nu, down, tau), -np.cross(nu[3:], down)])

    x = np.array([0.0] * 8 + [-1.0])  # at rest and level: down is -z
    moved = [x[:6]]
    for tau in flip * wrenches[:-1]:
        a = slope(x, tau)
        b = slope(x + 0.5 * dt * a, tau)
        c = slope(x + 0.5 * dt * b, tau)
        x = x + dt / 6.0 * (a + 2.0 * b + 2.0 * c + slope(x + dt * c, tau))
        moved.append(x[:6])
    expected = trajectory(coupled)[: len(moved)]
    assert np.abs(expected).max() > 0.3
    np.testing.assert_allclose(flip * moved, expected, rtol=0, atol=1e-6)


def test_gazebo_names_what_it_cannot_hold(heavy):
    plain = parameters(heavy, {"Z_ww_neg": -30.0}, weight=130.0)
    plain["effects"] = {
        "thruster_lag": {"time_constant": 0.2},
        "ocean_current": {"north": 0.1, "east": 0.2, "down": -0.05},
        "cog_offset": {"dx": 0.01},
    }
    config = configuration.from_parameters(plain)
    content, lost = export(config, "gazebo").content, export(config, "gazebo").lost
    assert len(lost) == 4
    assert any("thruster_lag" in what and "current" not in what for what in lost)
    assert any("ocean_current does to the added mass" in what for what in lost)
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


def test_water_in_layers(tmp_path):
    """Buoyancy is that of the density below the surface."""
    water = (
        '<plugin name="gz::sim::systems::Buoyancy"><graded_buoyancy>'
        "<default_density>1025</default_density><density_change><above_depth>0</above_depth>"
        "<density>1</density></density_change></graded_buoyancy></plugin>"
    )
    box = '<collision name="c"><geometry><box><size>1 0.1 0.1</size></box></geometry></collision>'
    text = STOCK.format("<xU>-1</xU>").replace("</inertial></link>", f"</inertial>{box}</link>", 1)
    world = text.replace("<model", f'<world name="w">{water}<model').replace(
        "</sdf>", "</world></sdf>"
    )
    (tmp_path / "world.sdf").write_text(world)
    config, _ = import_model(tmp_path / "world.sdf")
    assert config.model.body.buoyancy == pytest.approx(1025.0 * 0.01 * GRAVITY)


@pytest.mark.parametrize("name", ["gazebo", "auv_controllers"])
def test_a_file_is_known_by_its_root_and_may_begin_with_a_mark(name, diagonal, tmp_path):
    """<robotNamespace> of a plugin makes no URDF, nor does a comment."""
    content = export(diagonal, name).content
    if name == "gazebo":
        plugin = '<plugin name="ros"><robotNamespace>/rov</robotNamespace></plugin></model>'
        content = content.replace("<sdf", "<!-- of a <robot> -->\n<sdf", 1)
        content = content.replace("</model>", plugin)
    (tmp_path / "model").write_text(content, encoding="utf-8-sig")
    config, _ = import_model(tmp_path / "model")
    assert set(config.model.names) == set(diagonal.model.names)


def test_added_mass_of_either_sign(tmp_path):
    for text in ("<xDotU>5</xDotU><yDotR>-1</yDotR>", "<xDotU>-5</xDotU><yDotR>1</yDotR>"):
        path = tmp_path / "model.sdf"
        path.write_text(STOCK.format(text + "<xU>-1</xU>"))
        config, _ = import_model(path)
        # m nu_dot: 5 kg more in surge; left-up coupling keeps its sign forward-starboard-down.
        added = config.model.added_mass
        assert added[0, 0] == 5.0
        assert added[1, 5] == -1.0


TURNED = """<sdf version="1.9"><model name="m"><link name="base_link"><inertial>
{}
<mass>10</mass><inertia><ixx>0.1</ixx><iyy>0.2</iyy><izz>0.3</izz></inertia></inertial>
<collision name="hull"><pose>0 0 0.1 0 0 0</pose><geometry><box><size>1 0.1 0.1</size></box>
</geometry></collision>{}</link>
<plugin name="gz::sim::systems::Hydrodynamics" filename="gz-sim-hydrodynamics-system">
<link_name>base_link</link_name><xU>-1</xU></plugin></model></sdf>"""


@pytest.mark.parametrize(
    "pose",
    [
        '<pose degrees="true">0.1 0 0 0 0 90</pose>',
        '<pose degrees="true" rotation_format="euler_rpy">0.1 0 0 0 0 90</pose>',
        '<pose relative_to="base_link">0.1 0 0 0 0 1.5707963267948966</pose>',
        '<pose rotation_format="quat_xyzw">0.1 0 0 0 0 0.70710678 0.70710678</pose>',
    ],
)
def test_a_pose_in_each_notation_of_sdformat(tmp_path, pose):
    path = tmp_path / "m.sdf"
    path.write_text(TURNED.format(pose, ""))
    config, notes = import_model(path)
    body = config.model.body
    assert body.cog.tolist() == [0.1, 0.0, 0.0]
    np.testing.assert_allclose(body.inertia, np.diag([0.2, 0.1, 0.3]), atol=1e-9)
    assert notes == ()


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        ('<pose relative_to="__model__">0 0 0 0 0 0</pose>', "relative to '__model__'"),
        ('<pose rotation_format="matrix">0 0 0 0 0 0</pose>', "must be euler_rpy or quat_xyzw"),
        ('<pose rotation_format="quat_xyzw">0 0 0 0 0 0 0</pose>', "of length 0"),
        ('<pose rotation_format="quat_xyzw">0 0 0 0 0 0</pose>', "must be 7 numbers"),
    ],
)
def test_a_pose_that_cannot_be_read_is_refused(tmp_path, pose, words):
    path = tmp_path / "m.sdf"
    path.write_text(TURNED.format(pose, ""))
    with pytest.raises(UserError, match=words):
        import_model(path)


def test_a_volume_that_is_left_out_is_named(tmp_path):
    path = tmp_path / "m.sdf"
    mesh = (
        '<collision name="frame"><geometry><mesh><uri>a.dae</uri></mesh></geometry></collision>'
        "<collision><geometry><plane/></geometry></collision>"
    )
    path.write_text(TURNED.format("", mesh))
    config, notes = import_model(path)
    assert config.model.body.buoyancy == pytest.approx(98.1)
    assert len(notes) == 1
    assert "the collision frame (mesh) is left out" in notes[0]


# ------------------------------------------------------------------ auv_controllers


def hydrodynamics(urdf):
    """What the library of auv_controllers makes of a robot description, in its own formulas.

    `parse_model_from_xml` and `inverse_dynamics` of hydrodynamics 0.0.1: every attribute but the
    centres' and the products of inertia's is required. Gives ``wrench(acc, vel, R)``, R from body
    to north-east-down.
    """
    block = ET.fromstring(urdf).find("hydrodynamics")

    def six(path, keys):
        return np.diag([float(block.find(path).attrib[key]) for key in keys.split()])

    def three(path):
        return np.array([float(block.find(path).get(key, 0.0)) for key in "xyz"])

    def skew(v):
        return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])

    mass = float(block.find("inertial/mass").attrib["value"])
    cog, cob = three("inertial/center_of_gravity"), three("hydrostatics/center_of_buoyancy")
    s = mass * skew(cog)
    rigid = np.block([[mass * np.eye(3), -s], [s, six("inertial/inertia", "ixx iyy izz")]])
    m = rigid - six("inertial/added_mass", "Xdu Ydv Zdw Kdp Mdq Ndr")
    linear = -six("damping/linear", "Xu Yv Zw Kp Mq Nr")
    quadratic = -six("damping/quadratic", "Xuu Yvv Zww Kpp Mqq Nrr")
    buoyancy = float(block.find("hydrostatics/buoyancy").attrib["value"])

    def wrench(acc, vel, rotation):
        p = m @ vel
        zero = np.zeros((3, 3))
        coriolis = np.block([[zero, -skew(p[:3])], [-skew(p[:3]), -skew(p[3:])]])
        drag = linear + quadratic @ np.diag(np.abs(vel))
        fg = rotation.T @ [0.0, 0.0, mass * 9.81]
        fb = rotation.T @ [0.0, 0.0, -buoyancy]
        restoring = -np.concatenate([fg + fb, np.cross(cog, fg) + np.cross(cob, fb)])
        return m @ acc + coriolis @ vel + drag @ vel + restoring

    return wrench


def test_auv_controllers_computes_the_same_wrench(diagonal):
    """Today's reader, of a vehicle whose centre of gravity is off the origin."""
    there = hydrodynamics(export(diagonal, "auv_controllers").content)
    assert export(diagonal, "auv_controllers").lost == ()
    rng = np.random.default_rng(8)
    for _ in range(20):
        acc, vel, angles = rng.normal(size=6), rng.normal(size=6), rng.normal(size=3)
        rotation = quaternion_to_matrix(quaternion_from_euler(*angles))
        expected = diagonal.dynamics.wrench(vel, acc, rotation.T @ [0.0, 0.0, 1.0])
        np.testing.assert_allclose(there(acc, vel, rotation), expected, rtol=1e-9, atol=1e-9)


def test_auv_controllers_names_what_it_cannot_hold(coupled, heavy):
    lost = " ".join(export(coupled, "auv_controllers").lost)
    for name in (*COUPLED, "products of inertia"):
        assert name in lost
    # It makes the weight of the mass: the force that floats the vehicle is kept.
    out = export(configuration.from_parameters(parameters(heavy, weight=130.0)), "auv_controllers")
    assert any("130 N" in what for what in out.lost)
    buoyancy = ET.fromstring(out.content).find("hydrodynamics/hydrostatics/buoyancy")
    net = float(buoyancy.get("value")) - 13.5 * 9.81
    assert net == pytest.approx(heavy.model.body.buoyancy - 130.0)


OLD = """/**:
  ros__parameters:
    hydrodynamics:
      mass: 13.5
      weight: 132.435
      buoyancy: 134.0
      moments_of_inertia: [0.27215, 0.24215, 0.37]
      added_mass: [-6.36, -7.12, -18.68, -0.189, -0.135, -0.222]
      center_of_buoyancy: [0.0, 0.0, -0.01]
      center_of_gravity: [0.0, 0.0, 0.03]
      linear_damping: [-13.7, -6.0, -33.0, -0.3, -0.8, 0.0]
      quadratic_damping: [-141.0, -217.0, -190.0, -1.19, -0.47, -1.5]
"""


def test_parameters_of_auv_controllers_before_0_1_0_are_read(tmp_path):
    path = tmp_path / "old.yaml"
    path.write_text(OLD)
    config, notes = import_model(path)
    assert notes == ()
    values = dict(zip(config.model.names, config.model.theta.tolist(), strict=True))
    assert (values["X_udot"], values["Y_v"], values["N_rr"]) == (-6.36, -6.0, -1.5)
    assert "N_r" not in values
    np.testing.assert_allclose(config.model.body.inertia, np.diag([0.26, 0.23, 0.37]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("damping>", "dragging>"), "<damping><linear> is missing"),
        (("Xdu", "Xudot"), "has no attribute Xdu"),
        (('Ydv="-', 'Ydv="minus '), "must be a number"),
    ],
)
def test_a_description_that_auv_controllers_refuses_is_refused(diagonal, tmp_path, change, words):
    path = tmp_path / "r.urdf"
    path.write_text(export(diagonal, "auv_controllers").content.replace(*change))
    with pytest.raises(UserError, match=re.escape(words)):
        import_model(path)


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
    rng = np.random.default_rng(6)
    motion = rng.normal(size=6), rng.normal(size=6), np.array([0.6, 0.0, 0.8])
    np.testing.assert_allclose(
        mss_wrench(out.content, *motion), model.wrench(*motion), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "function"),
    [("rov-2", "rov_2"), ("1rov", "vehicle_1rov"), ("end", "vehicle_end"), ("köln", "k_ln")],
)
def test_a_function_of_mss_has_a_name_that_matlab_takes(heavy, name, function):
    out = export(dataclasses.replace(heavy, name=name), "mss")
    assert out.content.startswith(f"function vehicle = {function}()\n")


def mss_wrench(content, nu, nu_dot, down):
    """The formula in the file's comment, with the file's matrices."""
    fields = {}
    for line in content.splitlines():
        if line.startswith("vehicle."):
            key, text = line.removeprefix("vehicle.").rstrip(";").split(" = ")
            rows = text.strip("[]").split("; ")
            fields[key] = np.array([[float(x) for x in row.split()] for row in rows])
    m = fields["MRB"] + fields["MA"]
    p = m @ nu
    tau = m @ nu_dot + (fields["D"] + fields["Dn"] @ np.diag(np.abs(nu))) @ nu
    tau[:3] += np.cross(nu[3:], p[:3])
    tau[3:] += np.cross(nu[3:], p[3:]) + np.cross(nu[:3], p[:3])
    weight, buoyancy = fields["W"].item(), fields["B"].item()
    lever = weight * fields["rg"].ravel() - buoyancy * fields["rb"].ravel()
    return tau - np.concatenate([(weight - buoyancy) * down, np.cross(lever, down)])


# ------------------------------------------------------------------ nothing is lost in silence


@st.composite
def vehicles(draw, heavy):
    """Any body with any coefficients and any effects."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    names = [c.name for c in catalogue()]
    values = {}
    for c in map(parse, draw(st.lists(st.sampled_from(names), max_size=12, unique=True))):
        size = rng.uniform(0.001, 0.02) if c.is_added_mass else rng.uniform(0.5, 5.0)
        hull = c.is_diagonal or c.is_one_sided
        values[c.name] = float(size * (-1.0 if hull else rng.choice([-1.0, 1.0])))
    fins = [c.name for c in input_catalogue()]
    for name in draw(st.lists(st.sampled_from(fins), max_size=2, unique=True)):
        values[name] = float(rng.normal())
    plain = parameters(heavy, values)
    if draw(st.booleans()):
        plain["vehicle"]["cog"] = rng.uniform(-0.05, 0.05, 3).tolist()
    if draw(st.booleans()):
        plain["vehicle"]["inertia"] = [0.3, 0.28, 0.4, *rng.uniform(-0.03, 0.03, 3).tolist()]
    plain["gravity"] = draw(st.sampled_from([GRAVITY, 9.8]))
    plain["vehicle"]["weight"] = plain["gravity"] * 13.5 + draw(st.sampled_from([0.0, 1.5]))
    those = sorted(name for name, effect in EFFECTS.items() if effect.parameters)
    chosen = draw(st.lists(st.sampled_from(those), max_size=4, unique=True))
    plain["effects"] = {
        name: {
            p.name: p.null + (0.1 if p.null < p.upper else -0.1) * p.typical
            for p in EFFECTS[name].parameters
        }
        for name in chosen
    }
    if draw(st.booleans()):
        plain["imu"] = {"position": [0.1, 0.0, 0.0], "rotation": [0.0, 0.0, 0.1]}
        plain["thrusters"] = {"allocation": [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]}
    return configuration.from_parameters(plain)


def without(config, lost):
    """The model and the effects outside the body, less all that ``lost`` names."""
    words = " ".join(lost)
    kind = r"the (?:coefficients of fins and propeller|coefficients|effects|settings) ([\w., ]+)"
    lists = [match[1] for what in lost if (match := re.match(kind, what))]
    named = set(re.split(", | ", " ".join(lists)))
    for name, there in (
        ("imu.position", any(config.imu.position)),
        ("imu.rotation", any(config.imu.rotation)),
        ("thrusters", config.thrusters.allocation),
    ):
        assert (name in named) == bool(there)
    plain = configuration.to_parameters(config)
    plain["coefficients"] = {n: x for n, x in plain["coefficients"].items() if n not in named}
    plain["effects"] = {n: x for n, x in plain.get("effects", {}).items() if n not in named}
    plain["estimate"] = []
    left = configuration.from_parameters(plain)
    assert not left.model.fins
    model = left.dynamics
    body = model.body
    if "products of inertia about the origin" in words:
        about_origin = body.mass_matrix[3:, 3:]
        inertia = body.inertia - about_origin + np.diag(np.diag(about_origin))
        body = dataclasses.replace(body, inertia=inertia)
    if "a weight of" in words:
        # What the other program takes instead of it: its own gravity, or that of the vehicle.
        gravity = GRAVITY if "mass times 9.81" in words else config.gravity
        heavier = gravity * body.mass - body.weight
        body = dataclasses.replace(
            body, weight=body.weight + heavier, buoyancy=body.buoyancy + heavier
        )
    if "a gravity of" in words:
        share = GRAVITY / config.gravity
        body = dataclasses.replace(body, weight=share * body.weight, buoyancy=share * body.buoyancy)
    outside = {n: x for n, x in left.effects.items() if EFFECTS[n].body is None}
    return dataclasses.replace(model, body=body), outside


@pytest.mark.parametrize("name", WRITERS)
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_what_a_file_does_not_say_is_named(name, heavy, tmp_path, data):
    """Whatever the vehicle: the file and the list of what is lost make it up."""
    config = data.draw(vehicles(heavy))
    out = export(config, name)
    model, effects = without(config, out.lost)
    rng = np.random.default_rng(7)
    motion = rng.normal(size=6), rng.normal(size=6), np.array([0.6, 0.0, 0.8])
    if name in READERS:
        (tmp_path / "file").write_text(out.content)
        again, notes = import_model(tmp_path / "file")
        assert notes == ()
        assert again.effects == effects
        wrench = again.dynamics.wrench(*motion)
    else:
        assert not effects
        wrench = mss_wrench(out.content, *motion)
    np.testing.assert_allclose(wrench, model.wrench(*motion), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", WRITERS)
def test_every_coefficient_and_effect_is_held_or_named(name, heavy, tmp_path):
    """One by one: what the file has not is among the words."""
    base = export(heavy, name)
    assert base.lost == ()
    for coefficient in (*catalogue(), *input_catalogue()):
        value = (
            -0.01
            if coefficient.name not in heavy.model.names
            else heavy.value(coefficient.name) - 1.0
        )
        out = export(
            configuration.from_parameters(parameters(heavy, {coefficient.name: value})), name
        )
        assert (out.content != base.content) != any(coefficient.name in what for what in out.lost)
    for effect in EFFECTS.values():
        if effect.parameters:
            plain = parameters(heavy)
            plain["effects"] = {
                effect.name: {
                    p.name: p.null + (0.1 if p.null < p.upper else -0.1) * p.typical
                    for p in effect.parameters
                }
            }
            out = export(configuration.from_parameters(plain), name)
            assert out.content != base.content or any(effect.name in what for what in out.lost)


# ------------------------------------------------------------------ bad input, the commands


@pytest.mark.parametrize(
    ("content", "part"),
    [
        ("a: 1", "hydrodynamics"),
        ("hydrodynamics: {mass: 3}", "hydrodynamics.weight is missing"),
        ("<a", "not valid XML"),
        ("<robot name='x'/>", "a robot has one root"),
        ("<!DOCTYPE x><sdf/>", "entities"),
        (STOCK.format("<xU>two</xU>"), "<xU>two</xU> must be a number"),
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


def test_the_command_offers_every_format(heavy_path, tmp_path):
    done = run("export", "--config", heavy_path, "--format", "none", "--out", tmp_path / "m")
    assert re.findall(r"\w+", done.stderr.partition("choose from")[2]) == [*WRITERS]


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
    refused(run("import-model", sdf, "--out", sdf), "would replace")
