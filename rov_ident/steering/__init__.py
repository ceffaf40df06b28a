"""Vehicles that steer: zigzags of heading and rudder, Nomoto's models, autopilots of simulated
vehicles with fins."""
