"""`rov-ident init`: from what a bag, a log or a model tells, a configuration with every option."""

import dataclasses
import re
from contextlib import nullcontext

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from test_bags import write_mcap
from tiers import more

import rov_ident as ri
from bench import DATA, DEMO, ROOT
from rov_ident.api import functions, identification
from rov_ident.cli.program import main
from rov_ident.config import PARAMETERS, VEHICLE_PARAMETERS, from_parameters, to_parameters
from rov_ident.config.writing import annotated
from rov_ident.core.frames import from_core, to_core
from rov_ident.core.messages import IMU, ODOMETRY, WRENCH, Imu, Odometry, Wrench
from rov_ident.core.yaml_file import parse
from rov_ident.experiment.design import Proposal
from rov_ident.io import topics
from rov_ident.io.bag_reader import Bag
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.cdr import ROLE_TYPES, encode
from rov_ident.io.mounting import sensor_placement, with_mounting
from rov_ident.io.topics import ROLE_NAMES
from rov_ident.simulation import virtual_sensors as sensors

LOGS = DATA / "ardusub"
SHIPPED = ROOT / "config" / "bluerov2_heavy.yaml"


def uncommented(text):
    """The file with every option that it comments out."""
    return "\n".join(
        line.replace("# ", "", 1) if line.lstrip().startswith("# ") and i > 2 else line
        for i, line in enumerate(text.splitlines())
    )


@pytest.mark.parametrize("vehicle", ["bluerov2", "bluerov2_heavy", "remus100"])
def test_a_shipped_vehicle_is_that_vehicle(tmp_path, vehicle):
    assert main(["init", "--vehicle", vehicle, "--out", str(tmp_path / "c.yaml")]) == 0
    drafted, shipped = ri.load(tmp_path / "c.yaml"), ri.load(ROOT / f"config/{vehicle}.yaml")
    assert np.array_equal(drafted.model.theta, shipped.model.theta)
    assert drafted.model.names == shipped.model.names
    assert drafted.thrusters == shipped.thrusters


def test_every_option_stands_there_at_its_default():
    document = parse(uncommented(annotated({}, {}, "three\nlines\nof head")))
    parameters = document["/**"]["ros__parameters"]
    for p in VEHICLE_PARAMETERS + PARAMETERS:
        value = parameters
        for name in p.key.split("."):
            value = value[name]
        assert value == (list(p.default) if isinstance(p.default, tuple) else p.default), p.key


def test_what_is_given_stands_in_one_section():
    """`prior` had been written twice, as `std` below it is open to names: no YAML."""
    heavy = ri.load(ROOT / "config/bluerov2_heavy.yaml")
    given = to_parameters(heavy) | {"prior": {"relative_std": 0.3, "std": {"X_u": 2.0}}}
    given["effects"] = {"thruster_lag": {"time_constant": 0.1}, "ocean_current": {"north": 0.1}}
    read = from_parameters(parse(annotated(given, {}))["/**"]["ros__parameters"])
    assert to_parameters(read) == to_parameters(from_parameters(given))


def test_what_is_unknown_is_refused_until_it_is_given(tmp_path, capsys):
    assert main(["init", str(DEMO), "--out", str(tmp_path / "c.yaml")]) == 0
    assert "mass, buoyancy" in capsys.readouterr().err
    with pytest.raises(ri.UserError, match=r"vehicle.name is empty"):
        ri.load(tmp_path / "c.yaml")
    assert "20 Hz in demo.mcap, frame odom_ned" in (tmp_path / "c.yaml").read_text()


LEVEL, LEFT = (1.0, 0.0, 0.0, 0.0), (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # w x y z


def tree_of(*transforms):
    """The bytes of a message of these (parent, child, xyz, wxyz)."""
    store = get_typestore(Stores.ROS2_JAZZY)
    T = store.types
    stamp = T["builtin_interfaces/msg/Time"](0, 0)

    def transform(parent, child, xyz, wxyz):
        V, Q = T["geometry_msgs/msg/Vector3"], T["geometry_msgs/msg/Quaternion"]
        inner = T["geometry_msgs/msg/Transform"](V(*xyz), Q(*wxyz[1:], wxyz[0]))
        header = T["std_msgs/msg/Header"](stamp, parent)
        return T["geometry_msgs/msg/TransformStamped"](header, child, inner)

    message = T["tf2_msgs/msg/TFMessage"]([transform(*each) for each in transforms])
    return bytes(store.serialize_cdr(message, "tf2_msgs/msg/TFMessage"))


@pytest.fixture
def mavros(tmp_path):
    """A bag as mavros publishes it, with a tilted IMU 0.1 m ahead and 0.2 m up."""
    data = tree_of(
        ("base_link", "mount", (0.1, 0.0, 0.0), LEVEL), ("mount", "imu_link", (0.0, 0.0, 0.2), LEFT)
    )
    path, zero = tmp_path / "mavros.mcap", np.zeros(3)
    unit = np.array([1.0, 0.0, 0.0, 0.0])
    with BagWriter(path) as bag:
        bag.write("/tf_static", "tf2_msgs/msg/TFMessage", 1, data)
        for k in range(20):
            t = 1_000_000_000 + 50_000_000 * k
            odometry = Odometry(t, "map", "base_link", zero, unit, zero, zero, np.zeros(6))
            imu = Imu(t, "imu_link", unit, zero, zero, zero, zero)
            for topic in ("/mavros/local_position/odom", "/mavros/global_position/local"):
                bag.write(topic, "nav_msgs/msg/Odometry", t, encode(odometry))
            for topic in ("/mavros/imu/data", "/mavros/imu/data_raw"):
                bag.write(topic, "sensor_msgs/msg/Imu", t, encode(imu))
    return path


def test_a_bag_of_mavros_by_its_usual_names(tmp_path, mavros, capsys):
    out = tmp_path / "c.yaml"
    assert main(["init", str(mavros), "--vehicle", "bluerov2_heavy", "--out", str(out)]) == 0
    made = ri.load(out)
    assert made.topics.odom == "/mavros/local_position/odom"
    assert made.topics.imu == "/mavros/imu/data"
    # forward-left-up in the tree, forward-starboard-down in the file
    np.testing.assert_allclose(made.imu.position, [0.1, 0.0, -0.2], atol=1e-9)
    np.testing.assert_allclose(made.imu.rotation, [0.0, 0.0, -np.pi / 2], atol=1e-6)
    said = capsys.readouterr().err
    assert "nothing that can be wrench" in said and "as it is" not in said
    assert f"It can be used, with other records than {mavros.name};" in said


LOOP = [("mount", "imu_link", (0.1, 0, 0), LEVEL), ("imu_link", "mount", (0.1, 0, 0), LEVEL)]


@pytest.mark.parametrize(
    "transforms, position, yaw",
    [
        ([("imu_link", "base_link", (0.0, 0.2, 0.0), LEFT)], [-0.2, 0.0, 0.0], np.pi / 2),
        (
            [("hull", "base_link", (0.1, 0, 0), LEFT), ("hull", "imu_link", (0.3, 0, 0), LEVEL)],
            [0.0, 0.2, 0.0], np.pi / 2,
        ),
        (LOOP, None, 0.0),
        ([("base_link", "imu_link", (np.nan, 0.0, 0.0), LEVEL)], None, 0.0),
        ([("base_link", "imu_link", (0.1, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))], None, 0.0),
        (b"\0\1\0\0\xff\xff\xff\xff", None, 0.0),
    ],
    ids=["upward", "by a common parent", "a loop", "not finite", "no rotation", "garbage"],
)  # fmt: skip
def test_mounting_by_any_tree(tmp_path, transforms, position, yaw):
    """As tf2 finds it, up the tree and down; what is no transform is passed over."""
    data = transforms if isinstance(transforms, bytes) else tree_of(*transforms)
    with BagWriter(tmp_path / "tree.mcap") as bag:
        bag.write("/tf_static", "tf2_msgs/msg/TFMessage", 1, data)
    frames = {ODOMETRY: ("map", "base_link"), IMU: ("imu_link", "")}
    found = sensor_placement(Bag(tmp_path / "tree.mcap"), frames)
    assert bool(found) == (position is not None)
    if found:
        np.testing.assert_allclose(found["imu.position"], position, atol=1e-9)
        np.testing.assert_allclose(found["imu.rotation"], [0.0, 0.0, yaw], atol=1e-9)


def test_a_turned_velocity_sensor_is_said(tmp_path, heavy):
    """Its velocities are taken as along the body axes, unless the file has its angles."""
    path, zero, unit = tmp_path / "dvl.mcap", np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    with BagWriter(path) as bag:
        tree = tree_of(("base_link", "dvl_link", (0.2, 0.0, -0.1), LEFT))
        bag.write("/tf_static", "tf2_msgs/msg/TFMessage", 1, tree)
        odometry = Odometry(1, "dvl_link", "", zero, unit, zero, zero, np.zeros(6))
        bag.write("/odom", "nav_msgs/msg/Odometry", 1, encode(odometry))
        wrench = Wrench(1, "base_link", zero, zero)
        bag.write("/wrench", "geometry_msgs/msg/WrenchStamped", 1, encode(wrench))
    placed, notes = with_mounting(heavy, [path])
    np.testing.assert_allclose(placed.odometry.position, [0.2, 0.0, 0.1], atol=1e-9)
    (said,) = [note for note in notes if "set effects.sensor_misalignment" in note]
    assert "[0.0, 0.0, -1.571] rad by /tf_static of dvl.mcap" in said
    angles = {"roll": 0.0, "pitch": 0.0, "yaw": -np.pi / 2}
    known = dataclasses.replace(heavy, effects={"sensor_misalignment": angles})
    assert not [note for note in with_mounting(known, [path])[1] if "turned" in note]


def test_replay_and_plan_have_the_mounting_of_a_bag(monkeypatch, heavy, tmp_path):
    """As `fit` has it: nodes by the file that they are given, and a plan says so."""
    pytest.importorskip("rclpy")
    from rov_ident.nodes import replay

    told = []

    def started(name, parameters, namespace):
        told.append(ri.load(parameters))
        raise ri.UserError("no node is needed")

    path, zero, unit = tmp_path / "dive.mcap", np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    with BagWriter(path) as bag:
        tree = tree_of(("base_link_frd", "imu_link_frd", (0.3, 0.1, -0.2), LEVEL))
        bag.write("/tf_static", "tf2_msgs/msg/TFMessage", 1, tree)
        for role, message in (
            (
                ODOMETRY,
                Odometry(1, "odom_ned", "base_link_frd", zero, unit, zero, zero, np.zeros(6)),
            ),
            (IMU, Imu(1, "imu_link_frd", unit, zero, zero, zero, zero)),
            (WRENCH, Wrench(1, "base_link_frd", zero, zero)),
        ):
            bag.write(f"/{ROLE_NAMES[role]}", ROLE_TYPES[role], 1, encode(message))
    monkeypatch.setattr(replay, "_Process", started)
    with pytest.raises(ri.UserError, match="no node is needed"):
        replay.replay(path, SHIPPED)
    np.testing.assert_allclose(told[0].imu.position, [0.3, 0.1, -0.2], atol=1e-9)

    proposal = Proposal(heavy, None, "", (), (), (), (), ())
    monkeypatch.setattr(functions.archive, "opened", lambda *_, **__: nullcontext())
    monkeypatch.setattr(functions.design, "propose", lambda *_: proposal)
    (note,) = ri.plan(SHIPPED, path).notes
    assert note.startswith("imu.position is [0.3, 0.1, -0.2]")


@pytest.mark.parametrize(
    ("imu", "body", "position", "roll"),
    [
        ("base_link_frd", "base_link", [0.0, 0.0, 0.0], 0.0),
        ("imu_link", "base_link_frd", [0.1, -0.2, -0.3], 0.0),
        ("imu_link", "base_link", [0.1, -0.2, -0.3], 0.0),
        ("imu_upside_down", "base_link", [0.1, -0.2, -0.3], np.pi),
    ],
)
def test_frames_whose_name_says_their_axes(tmp_path, imu, body, position, roll):
    """As mavros publishes base_link_frd: messages in it are forward-starboard-down already, and
    turned once by its name and once more by the tree they would be upside down."""
    over = (0.0, 1.0, 0.0, 0.0)
    data = tree_of(
        ("base_link", "base_link_frd", (0.0, 0.0, 0.0), over),
        ("base_link", "imu_link", (0.1, 0.2, 0.3), LEVEL),
        ("base_link", "imu_upside_down", (0.1, 0.2, 0.3), over),
    )
    with BagWriter(tmp_path / "tree.mcap") as bag:
        bag.write("/tf_static", "tf2_msgs/msg/TFMessage", 1, data)
    found = sensor_placement(Bag(tmp_path / "tree.mcap"), {ODOMETRY: ("map", body), IMU: (imu, "")})
    np.testing.assert_allclose(found["imu.position"], position, atol=1e-9)
    np.testing.assert_allclose(np.cos(found["imu.rotation"]), np.cos([roll, 0.0, 0.0]), atol=1e-9)


def test_a_first_message_that_is_damaged_is_passed_over(tmp_path, mavros):
    with BagWriter(tmp_path / "cut.mcap") as bag:
        for k, raw in enumerate(Bag(mavros).iter_raw(["/mavros/imu/data"])):
            bag.write("/imu", raw.type_name, raw.log_time, raw.data[: 20 if k == 0 else None])
    seen, _ = topics.survey(Bag(tmp_path / "cut.mcap"))
    assert seen[IMU].frames[0] == "imu_link"


@pytest.fixture
def mounted(tmp_path, mavros, heavy):
    """A dive with that IMU, the tree in its bag; and the vehicle with the IMU in its place."""
    (tree,) = Bag(mavros).iter_raw(["/tf_static"])
    imu = dataclasses.replace(heavy.imu, position=(0.1, 0.0, -0.2), rotation=(0.0, 0.0, -np.pi / 2))
    known = dataclasses.replace(heavy, imu=imu)
    with BagWriter(tmp_path / "dive.mcap") as writer:
        writer.write("/tf_static", tree.type_name, 1, tree.data)
        for arrival, role, message in sensors.dive(known, duration=10.0, seed=1).messages:
            message = to_core(message)
            if role == ODOMETRY:
                message = message._replace(frame_id="map", child_frame_id="base_link")
            else:
                message = message._replace(frame_id="imu_link" if role == IMU else "base_link")
            message = from_core(message)
            name = f"/{ROLE_NAMES[role]}"
            writer.write(name, ROLE_TYPES[role], arrival, encode(message))
    return tmp_path / "dive.mcap", known


def test_check_compares_the_mounting_with_the_tree(mounted, heavy):
    """Of files with the IMU in its place, by other angles, too, elsewhere, and nowhere."""
    bag, known = mounted
    same = dataclasses.replace(known.imu, rotation=(np.pi, np.pi, np.pi / 2))
    elsewhere = dataclasses.replace(known.imu, position=(0.1, 0.0, 0.2), rotation=(0.0, 0.0, 0.1))
    wrong = {"imu.position", "imu.rotation"}
    for imu, expected in ((known.imu, set()), (same, set()), (elsewhere, wrong)):
        found = ri.check(bag, dataclasses.replace(heavy, imu=imu))
        said = {r.subject: r.text for r in found.remarks if "/tf_static" in r.text}
        assert said.keys() == expected
        if expected:
            assert said["imu.position"].startswith("[0.1, 0.0, -0.2] by /tf_static")
    found = ri.check(bag, heavy)
    said = [r.text for r in found.remarks if "/tf_static" in r.text]
    assert len(said) == 2 and all("as the configuration has none" in text for text in said)
    assert not [r.text for r in found.remarks if r.level != "good" and "imu" in r.text.lower()]


@pytest.mark.parametrize("estimator", ["rls", *more("ml")])
def test_a_fit_takes_the_mounting_from_the_tree(mounted, heavy, tmp_path, estimator):
    """As if the configuration had it; what it saves has it."""
    bag, known = mounted
    told, silent = ri.fit(bag, known, estimator), ri.fit(bag, heavy, estimator)
    np.testing.assert_allclose(silent.values, told.values, rtol=1e-5, atol=1e-8)
    assert [n for n in silent.notes if n.startswith("imu.position is [0.1, 0.0, -0.2]")]
    assert not [n for n in told.notes if "/tf_static" in n]
    silent.save(tmp_path / "fitted.yaml")
    saved = ri.load(tmp_path / "fitted.yaml")
    np.testing.assert_allclose(saved.imu.position, [0.1, 0.0, -0.2], atol=1e-9)
    nowhere = dataclasses.replace(heavy.imu, position=(1e-9, 0.0, 0.0))
    unturned = ri.read(bag, dataclasses.replace(heavy, imu=nowhere)).samples["nu"]
    assert np.abs(unturned - ri.read(bag, heavy).samples["nu"]).max() > 0.01


def test_a_borrowed_mass_is_not_trusted(tmp_path, capsys):
    """The vehicle is heavier than the shipped one, in water as heavy: all coefficients look smaller
    by as much, which nothing in the motion shows."""
    rng, out = np.random.default_rng(5), tmp_path / "c.yaml"
    assert main(["init", "--vehicle", "bluerov2_heavy", "--out", str(out)]) == 0
    assert "Weigh yours" in capsys.readouterr().err
    assert main(["init", "--vehicle", "bluerov2_heavy", "--out", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert "from bluerov2_heavy.yaml: ASSUMED" in out.read_text()
    parameters = to_parameters(ri.load(SHIPPED))
    heavier = rng.uniform(1.08, 1.15)
    for name in ("mass", "weight", "buoyancy"):
        parameters["vehicle"][name] *= heavier
    parameters["vehicle"]["inertia"] = [heavier * x for x in parameters["vehicle"]["inertia"]]
    world = from_parameters(parameters)
    lean = sensors.Suite(odometry_rate=10.0, imu_rate=50.0)
    run = ri.simulate(world, manoeuvre="steps", duration=60.0, seed=3, sensors=lean)
    run.save(tmp_path / "dive.mcap")
    fit = ri.fit(tmp_path / "dive.mcap", out, "rls")
    for name, true in world.model.values.items():
        i = fit.names.index(name)
        assert abs(fit.values[i] - true) < 3.0 * fit.std[i], name
    assert "Weigh the vehicle: thrust is 0." in fit.advice[0]
    vague = dataclasses.replace(fit, covariance=100.0 * fit.covariance)
    assert not any("Weigh" in text for text in vague.advice)  # a scale that nothing has shown
    found = identification.Identification(
        fit, None, (), {}, "", None, {"rmse_before": {"w": 0.2}, "rmse": {"w": 0.1}}, ()
    )
    assert fit.advice[0] in found.advice


def test_two_twists_of_mavros_are_told_apart_by_their_usual_names(tmp_path):
    twist, pose = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/PoseStamped"
    kinds = {
        "local_position/velocity_body": twist,
        "local_position/velocity_local": twist,
        "local_position/pose": pose,
        "vision_pose/pose": pose,
        "imu/data": "sensor_msgs/msg/Imu",
        "imu/data_raw": "sensor_msgs/msg/Imu",
        "rc/out": "mavros_msgs/msg/RCOut",
    }
    rows = [(f"/mavros/{name}", kind, 1, bytes(8)) for name, kind in kinds.items()]
    path = write_mcap(tmp_path / "mavros.mcap", rows)
    config = ri.load(SHIPPED)
    types = {"odom": "geometry_msgs/TwistStamped", "wrench": "mavros_msgs/RCOut"}
    config = dataclasses.replace(config, inputs=dataclasses.replace(config.inputs, **types))
    assert topics.select(Bag(path), config) == {
        "odom": "/mavros/local_position/velocity_body",
        "pose": "/mavros/local_position/pose",
        "imu": "/mavros/imu/data",
        "wrench": "/mavros/rc/out",
    }


def test_types_that_only_a_laboratory_has_are_named(tmp_path):
    """The topics of SOLAQUA's vehicle: none is of a type that is known."""
    kinds = {
        "/sensor/dvl_velocity": "sensors/msg/DVLVelocity",
        "/sensor/attitude": "messages/msg/Attitude",
        "/commanded_thrust": "rospy_tutorials/msg/Floats",
    }
    rows = [(topic, kind, 1, bytes(8)) for topic, kind in kinds.items()]
    bag = Bag(write_mcap(tmp_path / "data.mcap", rows))
    with pytest.raises(ri.UserError) as refusal:
        topics.select(bag, ri.load(SHIPPED))
    said = str(refusal.value)
    assert "/sensor/dvl_velocity may be meant, but only the package sensors knows" in said
    assert "republish it as geometry_msgs/TwistStamped" in said
    with pytest.raises(ri.UserError, match="/commanded_thrust may be meant.*JointState"):
        topics.select(bag, ri.load(SHIPPED), ["wrench"])


SDF = """<sdf version="1.9"><model name="m"><link name="base_link"><inertial>
<mass>10</mass><inertia><ixx>0.1</ixx><iyy>0.2</iyy><izz>0.3</izz></inertia></inertial></link>
<plugin name="gz::sim::systems::Hydrodynamics" filename="gz-sim-hydrodynamics-system">
<link_name>base_link</link_name><xDotU>{}</xDotU><xU>-1</xU></plugin></model></sdf>"""


def test_a_whole_model_takes_no_other_vehicle(tmp_path, capsys):
    path, out = tmp_path / "x.sdf", str(tmp_path / "c.yaml")
    path.write_text(SDF.format("-5"))
    assert main(["init", str(path), "--vehicle", "bluerov2", "--out", out]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "is a whole vehicle, to which vehicle (--vehicle) adds nothing" in said
    assert main(["init", str(path), "--out", out]) == 0
    assert "no added mass" not in capsys.readouterr().err
    path.write_text(SDF.format("0"))
    assert main(["init", str(path), "--out", out, "--force"]) == 0
    assert "so none will be estimated" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["robot.urdf", "robot.urdf.xml"])
@pytest.mark.parametrize("drag", [True, False])
def test_a_urdf_is_known_by_what_is_in_it(tmp_path, capsys, name, drag):
    path, out = tmp_path / name, tmp_path / "c.yaml"
    plugin = '<gazebo><plugin name="gz::sim::systems::Hydrodynamics"><xU>-5</xU></plugin></gazebo>'
    path.write_text(
        '<robot name="r"><link name="base_link"><inertial><mass value="9"/>'
        '<inertia ixx="0.1" iyy="0.2" izz="0.3"/></inertial></link>'
        f"{plugin if drag else ''}</robot>"
    )
    assert main(["init", str(path), "--out", str(out)]) == 0
    text, said = out.read_text(), capsys.readouterr().err
    assert "mass: 9.0" in text and ("X_u: -5.0" in text) == drag
    assert bool(re.search("buoyancy: *# UNKNOWN", text)) != drag
    assert ("taken as neutral" in said) == drag


def test_a_urdf_gives_the_body_and_leaves_the_rest_open(tmp_path, capsys):
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(
        '<robot name="r"><link name="base_link"><inertial><mass value="9"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    assert main(["init", str(urdf), "--out", str(tmp_path / "c.yaml")]) == 0
    text = (tmp_path / "c.yaml").read_text()
    assert "mass: 9.0" in text and "from robot.urdf" in text
    assert "buoyancy" in capsys.readouterr().err


@pytest.mark.skipif(not LOGS.exists(), reason="the logs of measured vehicles are not here")
def test_the_thrusters_of_a_real_heavy(tmp_path, capsys):
    out = tmp_path / "c.yaml"
    assert main(["init", str(LOGS / "small.tlog"), "--out", str(out)]) == 0
    assert "armed in 6 %" in capsys.readouterr().err
    flown = ri.load(out).thrusters
    # FRAME_CONFIG 2 with MOT_n_DIRECTION -1 -1 1 1 -1 1 1 -1
    assert flown.direction[:3] == (1.0, -1.0, 0.0) and flown.direction[-3:] == (0.0, 0.0, -1.0)
    assert flown.position == ri.load(SHIPPED).thrusters.position
    assert flown.voltage == pytest.approx(16.2, abs=0.1)
    bag = tmp_path / "dive.mcap"
    log = str(LOGS / "small.tlog")
    assert main(["import", log, "--config", str(SHIPPED), "--out", str(bag)]) == 0
    said = capsys.readouterr().err
    assert "thruster 1, 2, 5, 8 pushes the other way than the configuration says" in said
    assert "6 % of the log is armed" in said
    assert main(["init", str(LOGS / "a.tlog"), "--out", str(out), "--force"]) == 0
    said = capsys.readouterr().err
    assert "no velocity (a DVL" in said and "next: " not in said
