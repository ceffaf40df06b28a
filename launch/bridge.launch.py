"""Converged coefficients into the parameters of a running controller.

ros2 launch rov_ident bridge.launch.py controller:=/rov/velocity_controller namespace:=rov \
    config:=my_vehicle.yaml layout:=auv_controllers

Nothing is sent before somebody calls /rov/controller_bridge/approve, unless approval:=false.
"""

import os

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def check(context: LaunchContext) -> None:
    """Without its file the node would say that it is given no vehicle, and not why."""
    path = LaunchConfiguration("config").perform(context)
    if not os.path.isfile(path):
        raise RuntimeError(f"config: there is no file {path!r}")


def generate_launch_description() -> LaunchDescription:
    shipped = PathJoinSubstitution([FindPackageShare("rov_ident"), "config", "bluerov2_heavy.yaml"])
    arguments = [
        DeclareLaunchArgument("controller", description="full name of the controller's node"),
        DeclareLaunchArgument("namespace", default_value="", description="of the estimators"),
        DeclareLaunchArgument("config", default_value=shipped, description="parameter file"),
        DeclareLaunchArgument(
            "estimator", default_value="ukf_node", description="whose coefficients to send"
        ),
        DeclareLaunchArgument(
            "parameter",
            default_value="hydrodynamics.{name}",
            description="the controller's parameter of a coefficient",
        ),
        DeclareLaunchArgument(
            "layout",
            default_value="none",
            description="none, or a controller whose parameters are known: auv_controllers",
        ),
        DeclareLaunchArgument(
            "approval",
            default_value="true",
            choices=["true", "false", "True", "False"],
            description="send only what ~/approve was called for",
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
