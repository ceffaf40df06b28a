"""Writes converged coefficients into the parameters of a running controller.

ros2 launch rov_ident bridge.launch.py controller:=/rov/velocity_controller namespace:=rov \
    config:=my_vehicle.yaml layout:=auv_controllers

Nothing is sent until /rov/controller_bridge/approve is called, unless approval:=false.
"""

import os

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def check(context: LaunchContext) -> None:
    """Raise if the parameter file does not exist; a node would only report a missing vehicle."""
    path = LaunchConfiguration("config").perform(context)
    if not os.path.isfile(path):
        raise RuntimeError(f"config: there is no file {path!r}")


def generate_launch_description() -> LaunchDescription:
    shipped = PathJoinSubstitution([FindPackageShare("rov_ident"), "config", "bluerov2_heavy.yaml"])
    arguments = [
        DeclareLaunchArgument("controller", description="full name of the controller's node"),
        DeclareLaunchArgument(
            "namespace", default_value="", description="namespace of the estimators"
        ),
        DeclareLaunchArgument("config", default_value=shipped, description="parameter file"),
        DeclareLaunchArgument(
            "estimator", default_value="ukf_node", description="node whose coefficients are sent"
        ),
        DeclareLaunchArgument(
            "parameter",
            default_value="hydrodynamics.{name}",
            description="name of the controller's parameter for a coefficient",
        ),
        DeclareLaunchArgument(
            "layout",
            default_value="none",
            description="none, or a known set of parameters: auv_controllers (before 0.1.0)",
        ),
        DeclareLaunchArgument(
            "approval",
            default_value="true",
            choices=["true", "false", "True", "False"],
            description="send only after a call of ~/approve",
        ),
    ]
    bridge = Node(
        package="rov_ident",
        executable="controller_bridge",
        name="controller_bridge",
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            LaunchConfiguration("config"),
            {
                "controller": ParameterValue(LaunchConfiguration("controller"), value_type=str),
                "parameter": ParameterValue(LaunchConfiguration("parameter"), value_type=str),
                "layout": ParameterValue(LaunchConfiguration("layout"), value_type=str),
                "approval": ParameterValue(LaunchConfiguration("approval"), value_type=bool),
            },
        ],
        remappings=[("coefficients", [LaunchConfiguration("estimator"), "/coefficients"])],
        output="screen",
    )
    return LaunchDescription([*arguments, OpaqueFunction(function=check), bridge])
