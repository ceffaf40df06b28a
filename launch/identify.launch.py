"""Both estimators on a live vehicle.

ros2 launch rov_ident identify.launch.py namespace:=rov config:=my_vehicle.yaml

The input topics are relative to the namespace: odom, imu/data, thruster_wrench.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    shipped = PathJoinSubstitution([FindPackageShare("rov_ident"), "config", "bluerov2_heavy.yaml"])
    arguments = [
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the topics"),
        DeclareLaunchArgument("config", default_value=shipped, description="parameter file"),
        DeclareLaunchArgument(
            "use_sim_time", default_value="false", description="take time from /clock"
        ),
    ]
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    nodes = [
        Node(
            package="rov_ident",
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("config"), {"use_sim_time": use_sim_time}],
            output="screen",
        )
        for name in ("rls_node", "ukf_node")
    ]
    return LaunchDescription([*arguments, *nodes])
