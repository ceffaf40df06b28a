"""What estimator nodes and the player must agree on: topics and their quality of service."""

from importlib import import_module

from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from rov_ident.config import Inputs
from rov_ident.errors import UserError
from rov_ident.inputs import sources
from rov_ident.samples import IMU, ODOMETRY, WRENCH

try:  # half the cost of the other, and it keeps the order of arrival across topics
    from rclpy.experimental import EventsExecutor as Executor
except ImportError:
    from rclpy.executors import SingleThreadedExecutor as Executor

__all__ = ["INPUTS", "LATCHED", "STREAM", "Executor", "subscribed"]

INPUTS = {
    ODOMETRY: ("odom", Odometry),
    IMU: ("imu/data", Imu),
    WRENCH: ("thruster_wrench", WrenchStamped),
}

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
STREAM = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


def subscribed(inputs: Inputs) -> dict[str, tuple[str, type]]:
    """The relative topic and the message class of every role of the configured inputs.

    Raises
    ------
    UserError
        If a package of messages is not installed.
    """
    found = {}
    for role, (topic, type_name) in sources(inputs).items():
        package, _, name = type_name.partition("/")
        try:
            found[role] = topic, getattr(import_module(f"{package}.msg"), name)
        except ImportError as error:
            raise UserError(
                f"inputs.{role} is {type_name}, but {package} is not installed: source a workspace "
                "that has it, or republish its numbers as std_msgs/UInt16MultiArray"
            ) from error
    return found
