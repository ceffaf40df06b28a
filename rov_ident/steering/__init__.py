"""Vehicles that steer: zigzags, Nomoto's models, autopilots.

Heading and rudder only, or simulated vehicles with fins.
"""
