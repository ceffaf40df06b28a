"""A URDF into a configuration: one rigid body, in forward-starboard-down."""

from dataclasses import replace

import numpy as np
import pytest

from bench import HEAVY
from rov_ident import config
from rov_ident.cli.program import main
from rov_ident.consumer.formats import import_model
from rov_ident.core.errors import UserError
from rov_ident.model import thruster_allocation as thrusters

INERTIA = '<inertia ixx="{0}" iyy="{1}" izz="{2}" ixy="0" ixz="0" iyz="0"/>'
ROBOT = f"""<?xml version="1.0"?>
<robot name="two_balls">
  <link name="world_frame"/>
  <link name="base_link">
    <inertial>
      <origin xyz="0.1 0.2 -0.3"/><mass value="10"/>{INERTIA.format(0.2, 0.3, 0.4)}
    </inertial>
  </link>
  <link name="battery">
    <inertial><mass value="5"/>{INERTIA.format(0.01, 0.02, 0.03)}</inertial>
  </link>
  <link name="imu_link"/>
  <link name="dvl_link"/>
  <link name="thruster_1"/>
  <link name="thruster_2"><inertial><mass value="0.5"/></inertial></link>
  <joint name="floor" type="fixed">
    <parent link="world_frame"/><child link="base_link"/><origin xyz="9 9 9" rpy="0 0 1"/>
  </joint>
  <joint name="battery_joint" type="fixed">
    <parent link="base_link"/><child link="battery"/>
    <origin xyz="-0.2 0 -0.1" rpy="0 0 1.5707963267948966"/>
  </joint>
  <joint name="imu_joint" type="fixed">
    <parent link="battery"/><child link="imu_link"/>
    <origin xyz="0.05 0 0" rpy="0.1 0.2 0.3"/>
  </joint>
  <joint name="dvl_joint" type="fixed">
    <parent link="base_link"/><child link="dvl_link"/><origin xyz="0 -0.1 -0.2"/>
  </joint>
  <joint name="thruster_1_joint" type="continuous">
    <parent link="base_link"/><child link="thruster_1"/>
    <origin xyz="0.1 0.2 0" rpy="0 0 0.7853981633974483"/><axis xyz="1 0 0"/>
  </joint>
  <joint name="thruster_2_joint" type="continuous">
    <parent link="base_link"/><child link="thruster_2"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
  </joint>
</robot>
"""
PLUGIN = """
  <gazebo><plugin filename="gz-sim-hydrodynamics-system" name="gz::sim::systems::Hydrodynamics">
    <link_name>base_link</link_name><xU>-5.0</xU><yVabsV>-70.0</yVabsV>
  </plugin></gazebo>
</robot>"""


def save(path, text=ROBOT):
    path.write_text(text)
    return path


@pytest.fixture
def imported(tmp_path):
    return import_model(save(tmp_path / "r.urdf"), config.load(HEAVY))


def test_the_whole_tree_is_one_body(imported):
    """Mass, centre and inertia by the parallel axes, worked out here link by link."""
    found, _ = imported
    flip = np.array([1.0, -1.0, -1.0])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    points = np.array([[0.1, 0.2, -0.3], [-0.2, 0.0, -0.1], [0.0, 0.0, 0.1]])
    masses = np.array([10.0, 5.0, 0.5])
    own = [np.diag([0.2, 0.3, 0.4]), turn @ np.diag([0.01, 0.02, 0.03]) @ turn.T, np.zeros((3, 3))]
    cog = masses @ points / masses.sum()
    inertia = sum(own)
    for mass, r in zip(masses, points - cog, strict=True):
        skew = np.cross(np.eye(3), r)
        inertia = inertia + mass * skew @ skew.T
    body = found.model.body
    assert body.mass == pytest.approx(15.5)
    np.testing.assert_allclose(body.cog, flip * cog, atol=1e-12)
    np.testing.assert_allclose(body.inertia, np.outer(flip, flip) * inertia, atol=1e-12)


def test_net_buoyancy_and_coefficients_are_kept(imported):
    found, notes = imported
    base = config.load(HEAVY)
    before, after = base.model.body, found.model.body
    assert after.buoyancy - after.weight == pytest.approx(before.buoyancy - before.weight)
    assert found.model.names == base.model.names
    np.testing.assert_array_equal(found.model.theta, base.model.theta)
    assert any("buoyancy" in note for note in notes)


def test_sensors_and_thrusters_are_where_the_joints_put_them(imported):
    found, notes = imported
    # A quarter turn of the battery: the IMU's 0.05 ahead of it is to port of the body.
    np.testing.assert_allclose(found.imu.position, [-0.2, -0.05, 0.1], atol=1e-12)
    np.testing.assert_allclose(found.imu.rotation, [0.1, -0.2, -0.3 - np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(found.odometry.position, [0.0, 0.1, 0.2], atol=1e-12)
    c = np.sqrt(0.5)
    columns = [[c, -c, 0.0, 0.0, 0.0, -0.1 * c + 0.2 * c], [0.0, 0.0, -1.0, 0.0, 0.0, 0.0]]
    np.testing.assert_allclose(thrusters.matrix(found.thrusters).T, columns, atol=1e-12)
    assert any("thruster_1_joint, thruster_2_joint push along" in note for note in notes)


def test_a_hydrodynamics_plugin_gives_the_coefficients(tmp_path):
    found, notes = import_model(save(tmp_path / "r.urdf", ROBOT.replace("</robot>", PLUGIN)))
    values = dict(zip(found.model.names, found.model.theta.tolist(), strict=True))
    assert values == {"X_u": -5.0, "Y_vv": -70.0}
    assert any("taken as neutral" in note for note in notes)


def test_a_hydrodynamics_plugin_says_the_same_in_a_urdf_as_in_sdformat(tmp_path):
    """Added mass that it disables had been taken, the current it sets had been left out."""
    more = """<xDotU>-9</xDotU><disable_added_mass>true</disable_added_mass>
        <default_current>0.3 0.2 0</default_current></plugin>"""
    plugin = PLUGIN.replace("</plugin>", more)
    link = """<link name="base_link"><inertial><mass>10</mass><inertia><ixx>1</ixx><iyy>1</iyy>
        <izz>1</izz></inertia></inertial></link>"""
    element = plugin.partition("<gazebo>")[2].partition("</gazebo>")[0]
    sdf = f'<sdf version="1.10"><model name="m">{link}{element}</model></sdf>'
    of_sdf, _ = import_model(save(tmp_path / "m.sdf", sdf))
    robot = save(tmp_path / "r.urdf", ROBOT.replace("</robot>", plugin))
    for base in (None, config.load(HEAVY)):
        of_urdf, _ = import_model(robot, base)
        assert of_urdf.model.values == of_sdf.model.values == {"X_u": -5.0, "Y_vv": -70.0}
        current = {"north": 0.2, "east": 0.3, "down": 0.0}
        assert of_urdf.effects == of_sdf.effects == {"ocean_current": current}


@pytest.mark.parametrize(
    ("name", "found"),
    [("simulated", False), ("imu_link", True), ("ImuLink", True), ("rovimu", True)],
)
def test_an_imu_is_known_by_a_word_of_its_own(tmp_path, name, found):
    _, notes = import_model(
        save(tmp_path / "r.urdf", ROBOT.replace("imu_link", name)), config.load(HEAVY)
    )
    assert (f"imu sits at the link {name}" in notes) == found


BLOCK = """
  <hydrodynamics>
    <inertial>
      <mass value="16.61"/><inertia ixx="0.3" iyy="0.2" izz="0.4"/>
      <center_of_gravity z="0.02"/>
      <added_mass Xdu="-12.7" Ydv="-10.5" Zdw="-14.57" Kdp="-0.12" Mdq="-0.12" Ndr="0"/>
    </inertial>
    <damping>
      <linear Xu="-28.23" Yv="-18.29" Zw="-23.51" Kp="-0.31" Mq="-0.31" Nr="-0.31"/>
      <quadratic Xuu="-93.47" Yvv="-74.28" Zww="-168.17" Kpp="-1.55" Mqq="-1.55" Nrr="-1.55"/>
    </damping>
    <hydrostatics><buoyancy value="159.91"/><center_of_buoyancy z="-0.01"/></hydrostatics>
  </hydrodynamics>
</robot>"""


def test_what_a_robot_does_not_say_stays_as_in_the_file(tmp_path):
    """How well the vehicle is known, say."""
    heavy = config.load(HEAVY)
    stated = replace(heavy.vehicle_uncertainty, mass_std=0.05, cob_std=0.001)
    base = replace(heavy, vehicle_uncertainty=stated)
    found, _ = import_model(save(tmp_path / "r.urdf", ROBOT), base)
    assert found.vehicle_uncertainty == stated


@pytest.mark.parametrize("base", [None, HEAVY])
def test_its_own_hydrodynamics_are_the_model(tmp_path, base):
    """Forward-starboard-down, about the origin; sensors and thrusters are still the links'."""
    path = save(tmp_path / "r.urdf", ROBOT.replace("</robot>", BLOCK))
    found, notes = import_model(path, config.load(base) if base else None)
    values = dict(zip(found.model.names, found.model.theta.tolist(), strict=True))
    assert (values["X_udot"], values["M_qq"], len(values)) == (-12.7, -1.55, 17)
    body = found.model.body
    assert (body.mass, body.buoyancy) == (16.61, 159.91)
    assert body.weight == pytest.approx(16.61 * 9.81)
    assert (body.cog.tolist(), body.cob.tolist()) == ([0.0, 0.0, 0.02], [0.0, 0.0, -0.01])
    moved = 16.61 * 0.02**2
    np.testing.assert_allclose(np.diag(body.inertia), [0.3 - moved, 0.2 - moved, 0.4])
    np.testing.assert_allclose(found.odometry.position, [0.0, 0.1, 0.2], atol=1e-12)
    assert any("those of its <hydrodynamics>" in note for note in notes)


def test_the_command(tmp_path, capsys):
    path, out = str(save(tmp_path / "r.urdf")), str(tmp_path / "c.yaml")
    assert main(["import-model", path, "--config", str(HEAVY), "--out", out]) == 0
    assert "note: imu sits at the link imu_link" in capsys.readouterr().err
    assert config.load(out).model.body.mass == pytest.approx(15.5)
    assert main(["import-model", path, "--out", out]) == 2
    assert "holds no hydrodynamics: give --config" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("</robot>", ""), "not valid XML"),
        (('"10"', '"${mass}"'), "is a xacro file"),
        (('"10"', '"ten"'), "must be a number"),
        (('xyz="9 9 9"', 'xyz="9 9"'), "must be 3 numbers"),
        (('<link name="world_frame"/>', '<link name="w"/><link name="world_frame"/>'), "2 links"),
        (('<child link="dvl_link"/>', ""), "lacks a parent or a child"),
        (('<robot name="two_balls">', '<!DOCTYPE x><robot name="b">'), "XML entities"),
        (('mass value="', 'mass value="-'), "no link has a mass"),
    ],
)
def test_what_is_no_robot_is_refused(tmp_path, change, words):
    text = ROBOT.replace(*change)
    with pytest.raises(UserError, match=words):
        import_model(save(tmp_path / "r.urdf", text), config.load(HEAVY))


def test_a_loop_of_joints_is_refused(tmp_path):
    loop = '<parent link="battery"/><child link="imu_link"/>'
    text = ROBOT.replace(loop, '<parent link="imu_link"/><child link="imu_link"/>')
    with pytest.raises(UserError, match="hangs on no link"):
        import_model(save(tmp_path / "r.urdf", text), config.load(HEAVY))


def test_only_a_urdf_takes_a_configuration(tmp_path):
    with pytest.raises(UserError, match="adds to a URDF alone"):
        import_model(save(tmp_path / "m.sdf", "<sdf/>"), config.load(HEAVY))
