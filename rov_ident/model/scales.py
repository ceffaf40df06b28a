"""Typical sizes of motion and wrench, by which priors, noise floors and manoeuvres are scaled."""

from functools import lru_cache

import numpy as np

from rov_ident.model.equations import Array, Model, RigidBody

WORKING_SPEED = np.array([0.5, 0.5, 0.5, 0.8, 0.8, 0.8])  # m/s, rad/s
_RISE_TIME = 2.0  # s; in which a vehicle without damping reaches its working speed


@lru_cache(maxsize=16)  # nodes ask with each report
def authority(model: Model) -> Array:
    """The wrench (6,) that keeps the vehicle at its working speed along each axis alone."""
    inertia = np.diag(model.mass_matrix) * WORKING_SPEED / _RISE_TIME
    damping = np.array(
        [model.damping_matrix(WORKING_SPEED * axis)[i, i] for i, axis in enumerate(np.eye(6))]
    )
    out: Array = np.maximum(damping * WORKING_SPEED, inertia)
    out.flags.writeable = False
    return out


def semi_axes(body: RigidBody) -> Array:
    """Semi-axes (3,) [m] of the homogeneous ellipsoid of the body's mass and inertia, of which I_x
    = m (b^2 + c^2) / 5: half of the length, width and height of a hull, within some 20 %."""
    moments = np.diag(body.inertia)
    squares = 2.5 * (moments.sum() - 2.0 * moments) / body.mass
    out: Array = np.sqrt(np.maximum(squares, 0.0))
    return out
