"""The centre of gravity is not where it is configured: ``cog + [dx, dy, dz]``."""

import dataclasses

import numpy as np

from rov_ident.effects.base import Effect, EffectParameter
from rov_ident.model import RigidBody


def body(rigid_body: RigidBody, dx: float, dy: float, dz: float) -> RigidBody:
    return dataclasses.replace(rigid_body, cog=rigid_body.cog + np.array([dx, dy, dz]))


EFFECT = Effect(
    name="cog_offset",
    place="wrench",
    summary="The centre of gravity is not where it is configured.",
    manoeuvre="drifting without thrust at different roll and pitch angles",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, ch. 3, 4",
    parameters=(
        EffectParameter("dx", "m", "added to vehicle.cog, forward", 0.0, -1.0, 1.0, 0.01),
        EffectParameter("dy", "m", "added to vehicle.cog, starboard", 0.0, -1.0, 1.0, 0.01),
        EffectParameter("dz", "m", "added to vehicle.cog, down", 0.0, -1.0, 1.0, 0.01),
    ),
    body=body,
)
