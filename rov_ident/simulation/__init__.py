"""Open-loop simulation, manoeuvres, and sensors that measure a simulated motion.

Moves the model of a configuration; knows no samples and no estimator.
"""
