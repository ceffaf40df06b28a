"""The manners of a ROS 2 package: launch files, parameters, quality of service, dependencies.

`launch` itself is in no package registry that a test can install from; so its files are read: each
name in them must be one that exists.
"""

import ast
import importlib
import json
import re
import sys
from functools import partial
from itertools import product
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import pytest
from rcl_interfaces.msg import ParameterType

from bench import HEAVY, ROOT
from bench.simulators.live import Vehicle, end_node, start_node
from rov_ident import config
from rov_ident.config import Inputs, schema
from rov_ident.io.topics import sources
from rov_ident.nodes import controller_bridge, dashboard_node, parameters

LAUNCH = sorted((ROOT / "launch").glob("*.py"))
OF_ESTIMATORS = {p.key for p in config.VEHICLE_PARAMETERS + config.PARAMETERS} | {"use_sim_time"}
DECLARED = {
    "rls_node": OF_ESTIMATORS | {p.key for p in config.ESTIMATOR_PARAMETERS},
    "ukf_node": OF_ESTIMATORS | {p.key for p in config.ESTIMATOR_PARAMETERS},
    "controller_bridge": OF_ESTIMATORS | {p.key for p in controller_bridge._OWN},
    "dashboard_node": {p.key for p in dashboard_node._OWN},
}


class LaunchFile:
    """What a launch file declares and uses, read from its text."""

    def __init__(self, path):
        tree = ast.parse(path.read_text(), path.name)
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        self.doc = ast.get_docstring(tree)
        self.functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        self.calls = {
            name: [call for call in calls if getattr(call.func, "id", "") == name]
            for name in ("DeclareLaunchArgument", "LaunchConfiguration", "Node",
                         "IncludeLaunchDescription", "PathJoinSubstitution")
        }  # fmt: skip
        self.arguments = {c.args[0].value: keywords(c) for c in self.calls["DeclareLaunchArgument"]}
        self.used = {call.args[0].value for call in self.calls["LaunchConfiguration"]}
        # Paths below the package's share, as tuples.
        self.paths = [
            tuple(part.value for part in call.args[0].elts[1:])
            for call in self.calls["PathJoinSubstitution"]
        ]


def keywords(call):
    return {keyword.arg: keyword.value for keyword in call.keywords}


@pytest.mark.parametrize("path", LAUNCH, ids=lambda path: path.name)
def test_launch_file(path):
    file = LaunchFile(path)
    assert "generate_launch_description" in file.functions
    assert file.used <= set(file.arguments), "an argument is used that is not declared"
    for name, given in file.arguments.items():
        assert given["description"].value, name
        assert name in file.used, f"{name} is declared for nothing"
    # The example in its first lines gives arguments that it has.
    example = next(line for line in file.doc.splitlines() if line.startswith("ros2 launch"))
    assert example.split()[2:4] == ["rov_ident", path.name]
    text = file.doc.split(example)[1].split("\n\n")[0].replace("\\", " ")
    named = [word.partition(":=")[0] for word in (example + text).split() if ":=" in word]
    assert named and set(named) <= set(file.arguments)
    for parts in file.paths:
        assert ROOT.joinpath(*parts).exists(), parts


@pytest.mark.parametrize("path", LAUNCH, ids=lambda path: path.name)
def test_switches_are_refused_in_time(path):
    """An error after the first node has started would leave it behind."""
    given = LaunchFile(path).arguments.values()
    switches = [
        keys
        for keys in given
        if getattr(keys.get("default_value"), "value", None) in ("true", "false")
    ]
    assert all("choices" in keys for keys in switches)


def functions_of(path, monkeypatch):
    """A launch file as a module; what it takes from `launch` and `launch_ros` does nothing."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("launch"):
            stand_in = ModuleType(node.module)
            for alias in node.names:
                setattr(stand_in, alias.name, lambda *args, **kwargs: (args, kwargs))
            monkeypatch.setitem(sys.modules, node.module, stand_in)
    module = ModuleType("launch_file")
    exec(compile(path.read_text(), path.name, "exec"), module.__dict__)
    return module


def test_fleet_is_checked_as_a_whole(monkeypatch, tmp_path):
    fleet = functions_of(ROOT / "launch" / "fleet.launch.py", monkeypatch).fleet
    assert fleet(f"rov1={HEAVY}  /sea/rov2={HEAVY}") == {
        "rov1": str(HEAVY),
        "/sea/rov2": str(HEAVY),
    }
    for text, sentence in (
        ("  ", "there is none"),
        ("rov1", "'rov1' must be NAMESPACE=PARAMETER_FILE"),
        (f"={HEAVY}", "must be NAMESPACE=PARAMETER_FILE"),
        (f"/={HEAVY}", "must be NAMESPACE=PARAMETER_FILE"),
        (f"rov1={HEAVY} rov2={tmp_path}", "there is no file"),
        (f"rov1={HEAVY} /rov1/={HEAVY}", "/rov1/ is there twice"),
        (f"rov1={HEAVY} 2rov={HEAVY}", "must not have a token that starts with a number"),
    ):
        with pytest.raises(Exception, match=re.escape(sentence)):
            fleet(text)


@pytest.mark.parametrize(
    "name, argument", [("identify", "config"), ("bridge", "config"), ("replay", "bag")]
)
def test_files_are_looked_for_in_time(name, argument, monkeypatch):
    launched = functions_of(ROOT / "launch" / f"{name}.launch.py", monkeypatch)
    for path in (HEAVY, HEAVY / "not_there"):
        given = {argument: SimpleNamespace(perform=lambda _, path=path: str(path))}
        monkeypatch.setattr(launched, "LaunchConfiguration", given.__getitem__)
        if path.exists():
            launched.check(None)
        else:
            with pytest.raises(RuntimeError, match=f"{argument}: there is no .*not_there"):
                launched.check(None)


def test_recorder_of_a_namespace(monkeypatch, tmp_path):
    """It records what the nodes hear and publish, and replaces nothing."""
    launched = functions_of(ROOT / "launch" / "identify.launch.py", monkeypatch)

    def recorded(path, namespace):
        given = {
            name: SimpleNamespace(perform=lambda _, value=value: value)
            for name, value in (("record", path), ("namespace", namespace))
        }
        monkeypatch.setattr(launched, "LaunchConfiguration", given.__getitem__)
        return [keywords["cmd"] for _, keywords in launched.recorder(None)]

    assert recorded("", "rov") == []
    (command,) = recorded(str(tmp_path / "dive"), "/sea/rov/")
    assert command[command.index("--output") + 1] == str(tmp_path / "dive")
    kinds = ("nav_msgs/Odometry", "geometry_msgs/TwistStamped")
    wrenches = ("geometry_msgs/WrenchStamped", schema.FORCE_TYPES[0], schema.PULSE_TYPES[0])
    known = {
        source.topic
        for odom, wrench in product(kinds, wrenches)
        for source in sources(
            Inputs(odom=odom, wrench=wrench, battery=schema.BATTERY_TYPE)
        ).values()
    }
    published = {"rls_node/wrench_residual", "ukf_node/coefficients"}
    assert {f"/sea/rov/{topic}" for topic in known | published} <= set(command)
    assert "/odom" in recorded(str(tmp_path / "dive"), "")[0]
    with pytest.raises(RuntimeError, match="exists already"):
        recorded(str(tmp_path), "")


def test_container_is_made_of_what_is_here():
    """Docker is not at hand: what the file copies and runs is."""
    text = (ROOT / "Dockerfile").read_text()
    for source in re.findall(r"^COPY (\S+)", text, re.M):
        assert (ROOT / source).exists()
    assert re.search(r'^CMD \["rov-ident", "demo"', text, re.M)
    folder = ROOT / ".devcontainer"
    build = json.loads((folder / "devcontainer.json").read_text())["build"]
    assert (folder / build["dockerfile"]).resolve() == ROOT / "Dockerfile"


@pytest.mark.parametrize("path", LAUNCH, ids=lambda path: path.name)
def test_nodes_of_launch_file(path):
    programs = setup_programs()
    for call in LaunchFile(path).calls["Node"]:
        given = keywords(call)
        program = given["executable"].value
        assert given["package"].value == "rov_ident"
        module, _, function = programs[program].partition(":")
        assert callable(getattr(importlib.import_module(module), function))
        for item in getattr(given.get("parameters"), "elts", []):
            if isinstance(item, ast.Dict):
                assert {key.value for key in item.keys} <= DECLARED[program]


def setup_programs():
    """The console scripts of setup.py: {program: module:function}."""
    tree = ast.parse((ROOT / "setup.py").read_text())
    texts = [n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)]
    scripts = [t for t in texts if isinstance(t, str) and " = rov_ident." in t]
    return {text.partition(" = ")[0]: text.partition(" = ")[2] for text in scripts}


def test_included_launch_files_take_what_they_are_given():
    files = {path.name: LaunchFile(path) for path in LAUNCH}
    for file in files.values():
        for call in file.calls["IncludeLaunchDescription"]:
            items = keywords(call)["launch_arguments"]
            given = {key.value for key in items.func.value.keys}
            included = [parts[-1] for parts in file.paths if parts[0] == "launch"]
            assert len(included) == 1
            needed = {
                name
                for name, arguments in files[included[0]].arguments.items()
                if "default_value" not in arguments
            }
            assert needed <= given <= set(files[included[0]].arguments)


def test_package_says_what_it_needs():
    """Every package imported is in package.xml, or in setup.py and named there as from PyPI."""
    xml = ElementTree.parse(ROOT / "package.xml")
    of_ros = {node.text for node in xml.getroot() if node.tag.endswith("depend")}
    imported = set()
    for path in sorted((ROOT / "rov_ident").rglob("*.py")) + LAUNCH:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add((node.module or "").partition(".")[0])
    imported -= set(sys.stdlib_module_names) | {"rov_ident"}
    by_rosdep = {name for name in imported if {name, f"python3-{name}"} & of_ros}
    # The rest has no key, or is for an option: package.xml says so in words.
    (words,) = re.findall(r"<!-- By pip.*?-->", (ROOT / "package.xml").read_text(), re.DOTALL)
    assert imported - by_rosdep <= set(re.findall(r"\w+", words))
    assert not by_rosdep & set(re.findall(r"\w+", words))


# ------------------------------------------------------------------ parameters


class Ros:
    """A context of its own, closed at the end."""

    def __enter__(self):
        import rclpy

        self.context = rclpy.Context()
        rclpy.init(args=["--ros-args", "--params-file", str(HEAVY)], context=self.context)
        return self.context

    def __exit__(self, *_):
        import rclpy

        rclpy.try_shutdown(context=self.context)


def test_every_parameter_is_described(domain):
    """With a unit, its bounds as ROS's own ranges, and read-only unless it may change live."""
    from rclpy.node import Node

    own = (*controller_bridge._OWN, *dashboard_node._OWN)
    with Ros() as context:
        node = Node(
            "described", context=context, automatically_declare_parameters_from_overrides=True
        )
        parameters.declare_own(node, own)
        parameters.declare(node, [p.key for p in own])
        declared = {p.key: p for p in (*config.VEHICLE_PARAMETERS, *config.PARAMETERS, *own)}
        seen = set()
        for name, parameter in node.get_parameters_by_prefix("").items():
            descriptor = node.describe_parameter(name)
            if name in ("use_sim_time", "start_type_description_service"):
                continue  # ROS's own
            assert len(descriptor.description) > 5, name
            seen.add(name)
            if name not in declared:  # of an open section
                assert name.startswith("coefficients.") and "[" in descriptor.description
                continue
            given = declared[name]
            assert descriptor.read_only == (not given.live), name
            assert not given.unit or f"[{given.unit}]" in descriptor.description
            kind = parameter.get_parameter_value().type
            if kind == ParameterType.PARAMETER_DOUBLE:
                (within,) = descriptor.floating_point_range
                assert within.from_value == max(given.lower, -config.LARGEST)
                assert within.to_value == min(given.upper, config.LARGEST)
            elif kind == ParameterType.PARAMETER_INTEGER:
                (within,) = descriptor.integer_range
                assert within.from_value == max(given.lower, -(2**31) + 1)
            assert descriptor.additional_constraints == ", ".join(given.choices)
        assert seen >= set(declared)
        node.destroy_node()


# ------------------------------------------------------------------ quality of service


def test_drivers_of_any_quality(domain):
    """Sensor data (best effort), reliable and latched publishers are all heard as configured."""
    from geometry_msgs.msg import WrenchStamped
    from nav_msgs.msg import Odometry
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
    from sensor_msgs.msg import Imu

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    process = start_node("rls", HEAVY)
    vehicle = Vehicle(roles=())
    drivers = [
        vehicle.node.create_publisher(Odometry, "odom", qos_profile_sensor_data),
        vehicle.node.create_publisher(Imu, "imu/data", 10),
        vehicle.node.create_publisher(WrenchStamped, "thruster_wrench", latched),
    ]

    def refused(role):
        """An empty message is refused for its stamp: it was received."""
        for driver in drivers:
            driver.publish(driver.msg_type())
        return f"{role}: zero stamp" in vehicle.words()

    try:
        for role in ("odom", "imu", "wrench"):
            vehicle.until(partial(refused, role))
    finally:
        vehicle.close()
        status, said = end_node(process)
    assert status == 0, said


def test_an_imu_that_cannot_be_received_is_named(domain):
    """Its driver is best effort, as most are, and reliable messages were requested."""
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Imu

    process = start_node("rls", HEAVY, "qos.reliability:=reliable")
    vehicle = Vehicle(roles=("odom", "wrench"))
    vehicle.node.create_publisher(Imu, "imu/data", qos_profile_sensor_data)
    try:
        vehicle.until(lambda: "on /imu/data, though it has a publisher" in vehicle.words())
    finally:
        vehicle.close()
        status, said = end_node(process)
    assert status == 0, said
