"""Starts both estimators for each of several vehicles, and one live page for all of them.

ros2 launch rov_ident fleet.launch.py vehicles:="rov1=rov1.yaml rov2=rov2.yaml"

The topics and nodes of each vehicle are in the namespace with its name.
"""

import os

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare
from rclpy.validate_namespace import validate_namespace

# Anything else is refused before a node starts. Refused later, nodes would be left behind.
SWITCH = ["true", "false", "True", "False"]


def fleet(text: str) -> dict[str, str]:
    """Return the parameter file of every namespace; raise before any node starts."""
    found: dict[str, str] = {}
    for entry in text.split():
        name, equals, config = entry.partition("=")
        if not (name.strip("/") and equals and config):
            raise RuntimeError(f"vehicles: {entry!r} must be NAMESPACE=PARAMETER_FILE")
        validate_namespace("/" + name.strip("/"))
        if name.strip("/") in (known.strip("/") for known in found):
            raise RuntimeError(f"vehicles: {name} is there twice")
        if not os.path.isfile(config):
            raise RuntimeError(f"vehicles: there is no file {config!r}")
        found[name] = config
    if not found:
        raise RuntimeError("vehicles: there is none; give NAMESPACE=PARAMETER_FILE of each")
    return found


def estimators(context: LaunchContext) -> list[GroupAction]:
    """Return the actions that start both estimators for each vehicle in `vehicles`."""
    path = PathJoinSubstitution([FindPackageShare("rov_ident"), "launch", "identify.launch.py"])
    groups = []
    for namespace, config in fleet(LaunchConfiguration("vehicles").perform(context)).items():
        included = IncludeLaunchDescription(
            PythonLaunchDescriptionSource(path),
            launch_arguments={
                "namespace": namespace,
                "config": config,
                "use_sim_time": LaunchConfiguration("use_sim_time"),
                "dashboard": "false",
            }.items(),
        )
        # In a scope of its own: what is given to one is neither the next one's nor ours.
        groups.append(GroupAction([included]))
    return groups


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(
            "vehicles", description="NAMESPACE=PARAMETER_FILE, separated by blanks"
        ),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value="false",
            choices=SWITCH,
            description="take time from /clock",
        ),
        DeclareLaunchArgument(
            "dashboard",
            default_value="true",
            choices=SWITCH,
            description="serve the live page, at http://127.0.0.1:8050/",
        ),
    ]
    page = Node(
        package="rov_ident",
        executable="dashboard_node",
        name="dashboard",
        output="screen",
        condition=IfCondition(LaunchConfiguration("dashboard")),
    )
    return LaunchDescription([*arguments, OpaqueFunction(function=estimators), page])
