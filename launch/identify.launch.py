"""Starts both estimators on a live vehicle.

ros2 launch rov_ident identify.launch.py namespace:=rov config:=my_vehicle.yaml dashboard:=true

The input topics are relative to the namespace: odom, imu/data, thruster_wrench. `record:=dive` also
records them and what the nodes publish, into the bag `dive`.
"""

import os

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

# Anything else is refused before a node starts. Refused later, nodes would be left behind.
SWITCH = ["true", "false", "True", "False"]


def check(context: LaunchContext) -> None:
    """Raise if the parameter file does not exist; a node would only report a missing vehicle."""
    path = LaunchConfiguration("config").perform(context)
    if not os.path.isfile(path):
        raise RuntimeError(f"config: there is no file {path!r}")


# Inputs by every name that the nodes know, and what they publish; what nobody has does not count.
RECORDED = (
    *("odom", "velocity", "pose", "imu/data", "battery"),
    *("thruster_wrench", "thruster_forces", "thruster_pwm"),
    *(
        f"{node}/{topic}"
        for node in ("rls_node", "ukf_node")
        for topic in ("coefficients", "coefficients/covariance", "wrench_residual")
    ),
)


def recorder(context: LaunchContext) -> list[ExecuteProcess]:
    """Return what records the dive, if `record` names a bag; raise if that exists."""
    path = LaunchConfiguration("record").perform(context)
    if not path:
        return []
    if os.path.exists(path):
        raise RuntimeError(f"record: {path!r} exists already, and a bag replaces nothing")
    namespace = LaunchConfiguration("namespace").perform(context).strip("/")
    topics = [f"/{namespace}/{topic}".replace("//", "/") for topic in RECORDED]
    command = ["ros2", "bag", "record", "--storage", "mcap", "--output", path, "--topics"]
    return [ExecuteProcess(cmd=[*command, *topics, "/diagnostics", "/tf_static"], output="screen")]


def generate_launch_description() -> LaunchDescription:
    shipped = PathJoinSubstitution([FindPackageShare("rov_ident"), "config", "bluerov2_heavy.yaml"])
    arguments = [
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the topics"),
        DeclareLaunchArgument("config", default_value=shipped, description="parameter file"),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value="false",
            choices=SWITCH,
            description="take time from /clock",
        ),
        DeclareLaunchArgument(
            "dashboard",
            default_value="false",
            choices=SWITCH,
            description="serve the live page, at http://127.0.0.1:8050/",
        ),
        DeclareLaunchArgument(
            "record", default_value="", description="bag to record the dive into (none)"
        ),
    ]
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    parameters = [LaunchConfiguration("config"), {"use_sim_time": use_sim_time}]
    nodes = [
        Node(
            package="rov_ident",
            executable="rls_node",
            name="rls_node",
            namespace=LaunchConfiguration("namespace"),
            parameters=parameters,
            output="screen",
        ),
        Node(
            package="rov_ident",
            executable="ukf_node",
            name="ukf_node",
            namespace=LaunchConfiguration("namespace"),
            parameters=parameters,
            output="screen",
        ),
        # It hears the estimators of every namespace: one is enough for all.
        Node(
            package="rov_ident",
            executable="dashboard_node",
            name="dashboard",
            output="screen",
            condition=IfCondition(LaunchConfiguration("dashboard")),
        ),
    ]
    return LaunchDescription(
        [*arguments, OpaqueFunction(function=check), OpaqueFunction(function=recorder), *nodes]
    )
