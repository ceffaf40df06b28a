"""The live page of all estimators that are heard, and their topics for Foxglove.

ros2 launch rov_ident dashboard.launch.py port:=8050 foxglove_port:=8765
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(
            "port", default_value="8050", description="port of the page on 127.0.0.1"
        ),
        DeclareLaunchArgument(
            "foxglove_port",
            default_value="-1",
            description="port for Foxglove on 127.0.0.1 (it asks for 8765); -1: none",
        ),
    ]
    page = Node(
        package="rov_ident",
        executable="dashboard_node",
        name="dashboard",
        parameters=[
            {
                # Of no type: of text the node says which of the two it is.
                "port": LaunchConfiguration("port"),
                "foxglove_port": LaunchConfiguration("foxglove_port"),
            }
        ],
        output="screen",
    )
    return LaunchDescription([*arguments, page])
