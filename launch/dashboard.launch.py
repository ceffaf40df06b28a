"""The live page of all estimators that are heard, and their topics for Foxglove.

ros2 launch rov_ident dashboard.launch.py port:=8050 foxglove_port:=8765
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


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
                "port": ParameterValue(LaunchConfiguration("port"), value_type=int),
                "foxglove_port": ParameterValue(
                    LaunchConfiguration("foxglove_port"), value_type=int
                ),
            }
        ],
        output="screen",
    )
    return LaunchDescription([*arguments, page])
