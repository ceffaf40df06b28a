"""Typical sizes of motion and wrench, by which priors, noise floors and manoeuvres are scaled."""

import numpy as np

from rov_ident.model.equations import Array, Model

WORKING_SPEED = np.array([0.5, 0.5, 0.5, 0.8, 0.8, 0.8])  # m/s, rad/s
_RISE_TIME = 2.0  # s; in which a vehicle without damping reaches its working speed


def authority(model: Model) -> Array:
    """The wrench (6,) that keeps the vehicle at its working speed along each axis alone."""
    inertia = np.diag(model.mass_matrix) * WORKING_SPEED / _RISE_TIME
    damping = np.array(
        [model.damping_matrix(WORKING_SPEED * axis)[i, i] for i, axis in enumerate(np.eye(6))]
    )
    return np.maximum(damping * WORKING_SPEED, inertia)
