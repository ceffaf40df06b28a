"""Water that moves steadily and without rotation; the equations of motion say what that does.

See :func:`rov_ident.model.equations.add_current`.
"""

import numpy as np

from rov_ident.effects.base import NED, Array, Effect, vector


def water(north: float, east: float, down: float) -> Array:
    return np.array([north, east, down])


EFFECT = Effect(
    place="motion",
    summary="The water moves: the vehicle is faster or slower through it than over ground.",
    traits=("likely", "dive"),
    manoeuvre="runs at headings 90 degrees apart, and drifting without thrust",
    source="Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, sec. 10.3",
    parameters=vector("north east down", "m/s", "velocity of the water", 3.0, 0.1, NED),
    water=water,
)
