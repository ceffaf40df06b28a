"""Serves the live page of all running estimators.

ros2 launch rov_ident dashboard.launch.py port:=8050
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    port = DeclareLaunchArgument(
        "port", default_value="8050", description="port of the page on 127.0.0.1"
    )
    page = Node(
        package="rov_ident",
        executable="dashboard_node",
        name="dashboard",
        # Of no type: of text the node says what it is.
        parameters=[{"port": LaunchConfiguration("port")}],
        output="screen",
    )
    return LaunchDescription([port, page])
