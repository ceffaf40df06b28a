"""The centre of gravity is not where it is configured: ``cog + [dx, dy, dz]``."""

import dataclasses

import numpy as np

from rov_ident.effects.base import Effect, vector
from rov_ident.model.equations import RigidBody


def body(rigid_body: RigidBody, dx: float, dy: float, dz: float) -> RigidBody:
    return dataclasses.replace(rigid_body, cog=rigid_body.cog + np.array([dx, dy, dz]))


EFFECT = Effect(
    place="wrench",
    summary="The centre of gravity is not where it is configured.",
    manoeuvre="drifting without thrust at different roll and pitch angles",
    traits=("weight",),
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, ch. 3, 4",
    parameters=vector("dx dy dz", "m", "added to vehicle.cog", 1.0, 0.01),
    body=body,
)
