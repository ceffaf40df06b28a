"""What every room may use: errors, messages, axes, quaternions, files, compiled kernels. Knows
nothing of vehicles, configurations or ROS, and imports from no room."""
