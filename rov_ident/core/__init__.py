"""What every room may use: errors, messages, axes, quaternions, files, compiled kernels.

Knows nothing of vehicles, configurations or ROS. No room is imported from here.
"""
