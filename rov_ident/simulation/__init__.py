"""Open-loop simulation, manoeuvres, and sensors that measure a simulated motion: the model of a
configuration moves, without samples and estimators."""
