"""Both estimators on each of several vehicles, and one live page of them all.

ros2 launch rov_ident fleet.launch.py vehicles:="rov1=rov1.yaml rov2=rov2.yaml"

Each vehicle has its topics, and its nodes, in the namespace of its name.
"""

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


def estimators(context: LaunchContext) -> list[GroupAction]:
    """Both estimators of each vehicle named in `vehicles`."""
    path = PathJoinSubstitution([FindPackageShare("rov_ident"), "launch", "identify.launch.py"])
    groups = []
    for entry in LaunchConfiguration("vehicles").perform(context).split():
        namespace, equals, config = entry.partition("=")
        if not (namespace and equals and config):
            raise RuntimeError(f"vehicles: {entry!r} must be NAMESPACE=PARAMETER_FILE")
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
        DeclareLaunchArgument("vehicles", description="NAMESPACE=PARAMETER_FILE, with blanks"),
        DeclareLaunchArgument(
            "use_sim_time", default_value="false", description="take time from /clock"
        ),
        DeclareLaunchArgument(
            "dashboard",
            default_value="true",
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
