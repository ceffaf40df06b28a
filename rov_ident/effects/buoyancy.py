"""The vehicle is heavier in water than configured: ``delta`` along world z, at the CB.

World z points down (NED), so that a positive delta is buoyancy lost: ``B - delta``.
"""

import dataclasses

from rov_ident.effects.base import Effect, EffectParameter
from rov_ident.model.equations import RigidBody


def body(rigid_body: RigidBody, delta: float) -> RigidBody:
    return dataclasses.replace(rigid_body, buoyancy=rigid_body.buoyancy - delta)


EFFECT = Effect(
    place="wrench",
    summary="The buoyancy is not the configured one: fresh water, ballast, trapped air.",
    manoeuvre="drifting without thrust, level, then pitched and rolled by thrust moments",
    traits=("weight",),
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 4.1",
    parameters=(EffectParameter("delta", "N", "buoyancy lost", 0.0, -1e5, 1e5, 2.0),),
    body=body,
)
