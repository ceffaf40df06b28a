"""Manoeuvres that move a vehicle so that its coefficients can be identified."""

from collections.abc import Callable

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.model.equations import Array, Model
from rov_ident.model.scales import authority

LEVEL = np.array([0.0, 0.0, 1.0])


def steps(model: Model, t: Array, rng: np.random.Generator) -> Array:
    """Random telegraph on all axes at once: levels held for 1 to 4 s, now and then nothing."""
    wrench = np.zeros((len(t), 6))
    limits = authority(model)
    for axis in range(6):
        change = t[0]
        while change < t[-1]:
            level = rng.choice([-1.0, -0.6, 0.0, 0.6, 1.0])
            wrench[t >= change, axis] = level * limits[axis]
            change += rng.uniform(1.0, 4.0)
    return wrench


def multisine(model: Model, t: Array, rng: np.random.Generator) -> Array:
    """Sum of sines between 0.03 and 0.4 Hz on every axis, each axis with frequencies of its own."""
    frequencies = np.geomspace(0.03, 0.4, 36)
    wrench = np.zeros((len(t), 6))
    limits = authority(model)
    for axis in range(6):
        own = frequencies[axis::6]
        phases = rng.uniform(0.0, 2.0 * np.pi, len(own))
        waves = np.sin(2.0 * np.pi * own * (t - t[0])[:, None] + phases).sum(axis=1)
        wrench[:, axis] = 1.3 * limits[axis] * waves / np.sqrt(len(own))
    return wrench


def single_axis(model: Model, t: Array, rng: np.random.Generator) -> Array:
    """Steps on one axis after the other, a sixth of the time each."""
    wrench = steps(model, t, rng)
    turn = np.minimum((6.0 * (t - t[0]) / (t[-1] - t[0] + 1e-9)).astype(int), 5)
    wrench[turn[:, None] != np.arange(6)] = 0.0
    return wrench


def pilot(model: Model, t: Array, rng: np.random.Generator) -> Array:
    """A pilot inspecting something: surge and yaw, a little heave, long idle stretches."""
    wrench = np.zeros((len(t), 6))
    limits = authority(model)
    for axis, share, busy in ((0, 0.8, 0.4), (5, 0.5, 0.3), (2, 0.4, 0.1)):
        change = t[0]
        while change < t[-1]:
            if rng.random() < busy:
                level, length = share * rng.choice([-1, 1]) * rng.uniform(0.3, 1.0), (1.0, 5.0)
            else:
                level, length = 0.0, (2.0, 10.0)
            wrench[t >= change, axis] = level * limits[axis]
            change += rng.uniform(*length)
    return wrench


def rest(model: Model, t: Array, rng: np.random.Generator) -> Array:
    """No thrust at all: nothing can be identified from this."""
    return np.zeros((len(t), 6))


MANOEUVRES: dict[str, Callable[[Model, Array, np.random.Generator], Array]] = {
    "steps": steps,
    "multisine": multisine,
    "single-axis": single_axis,
    "pilot": pilot,
    "rest": rest,
}
"""name -> function of (model, instants (N,) [s], random generator) giving the wrench (N, 6)."""


def manoeuvre(name: str, model: Model, t: Array, rng: np.random.Generator) -> Array:
    """The wrench (N, 6) of a named manoeuvre.

    Raises UserError for a name that is not in :data:`MANOEUVRES`.
    """
    if name not in MANOEUVRES:
        raise UserError(f"there is no manoeuvre '{name}': choose one of {', '.join(MANOEUVRES)}")
    return MANOEUVRES[name](model, t, rng)
