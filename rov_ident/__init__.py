"""Identify the hydrodynamic coefficients of a marine vehicle while it moves, and from its records.

Everything in this package outside ``nodes`` is free of ROS; ARCHITECTURE.md shows the rooms.
"""
