"""What estimator nodes and the player must agree on: topics and their quality of service."""

from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from rov_ident.samples import IMU, ODOMETRY, WRENCH

try:  # half the cost of the other, and it keeps the order of arrival across topics
    from rclpy.experimental import EventsExecutor as Executor
except ImportError:
    from rclpy.executors import SingleThreadedExecutor as Executor

__all__ = ["INPUTS", "LATCHED", "STREAM", "Executor"]

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
