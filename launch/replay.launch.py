"""Starts both estimators on a recorded dive.

ros2 launch rov_ident replay.launch.py bag:=dive.mcap config:=my_vehicle.yaml dashboard:=true

The nodes keep running after the end of the bag, so that their results can be read and saved.
"""

import os

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def check(context: LaunchContext) -> None:
    """Raise if the bag does not exist; else the nodes would wait for a player that has ended."""
    path = LaunchConfiguration("bag").perform(context)
    if not os.path.exists(path):
        raise RuntimeError(f"bag: there is no {path!r}")


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("rov_ident")
    shipped = PathJoinSubstitution([share, "config", "bluerov2_heavy.yaml"])
    arguments = [
        DeclareLaunchArgument("bag", description="an .mcap file or a rosbag2 directory"),
        DeclareLaunchArgument(
            "namespace", default_value="", description="namespace of the topics in the bag"
        ),
        DeclareLaunchArgument("config", default_value=shipped, description="parameter file"),
        DeclareLaunchArgument(
            "dashboard",
            default_value="false",
            choices=["true", "false", "True", "False"],
            description="serve the live page, at http://127.0.0.1:8050/",
        ),
        DeclareLaunchArgument("rate", default_value="1.0", description="speed of the replay"),
        DeclareLaunchArgument(
            "delay", default_value="10.0", description="seconds for the nodes to come up"
        ),
    ]
    nodes = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution([share, "launch", "identify.launch.py"])
        ),
        launch_arguments={
            "namespace": LaunchConfiguration("namespace"),
            "config": LaunchConfiguration("config"),
            "use_sim_time": "true",
            "dashboard": LaunchConfiguration("dashboard"),
        }.items(),
    )
    play = ExecuteProcess(
        cmd=[
            *("ros2", "bag", "play", LaunchConfiguration("bag"), "--clock"),
            *("--rate", LaunchConfiguration("rate")),
            *("--delay", LaunchConfiguration("delay")),
        ],
        output="screen",
    )
    return LaunchDescription([*arguments, OpaqueFunction(function=check), nodes, play])
