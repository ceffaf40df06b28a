"""Wrenches of no known cause: how a residual depends on the motion, the place and the time.

A pattern is a force or moment on one axis as a smooth function of one variable. Patterns compete
with the effects of the library: where one of them explains more than any effect, what is
missing has no name here, but an axis and a dependence.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rov_ident.coefficients import AXES, VELOCITIES
from rov_ident.hypothesis import UNKNOWN, Key
from rov_ident.model import Array
from rov_ident.shooting import Steps

_KNOTS = 12.0  # s between the knots of a function of time
_MOST_KNOTS = 40


@dataclass(frozen=True)
class Pattern:
    """Columns (K, C), functions of one variable, on one axis (0 .. 5) of the body or the world.

    ``direction`` (K, 3): the world axis as seen from the body; None for body axes. ``frequency``
    [Hz] of a sinusoid in time, else None.
    """

    axis: int
    depends_on: str
    columns: Array
    direction: Array | None = None
    frequency: float | None = None

    @property
    def keys(self) -> list[Key]:
        """One for each column."""
        own = f"{self.name}|{self.frequency or ''}"
        return [(UNKNOWN, f"{own}|{i}") for i in range(self.columns.shape[1])]

    @property
    def name(self) -> str:
        return f"{AXES[self.axis]}|{self.depends_on}"

    def force(self) -> Array:
        """Wrenches (K, 6, C)."""
        out = np.zeros((len(self.columns), 6, self.columns.shape[1]))
        if self.direction is None:
            out[:, self.axis] = self.columns
        else:
            out[:, :3] = self.direction[:, :, None] * self.columns[:, None, :]
        return out


def patterns(steps: Steps, position: Array | None, nu: Array) -> Iterator[Pattern]:
    """Every pattern along a motion: nu (K, 6) and, if known, position (K, 3), mid-step."""
    functions = dict(_functions(steps, nu))
    for axis in range(6):
        for variable, columns in functions.items():
            yield Pattern(axis, variable, columns)
    if position is None:
        return
    depth, x, y = (z[:, None] for z in _standard(position[:, [2, 0, 1]]).T)
    there = np.hstack([np.ones_like(x), x, y, x**2, x * y, y**2])
    for axis in (0, 1):
        yield Pattern(axis, "position", there, steps.middle[:, axis])
    yield Pattern(2, "depth", depth ** np.arange(5), steps.middle[:, 2])
    for axis in (3, 4, 5):
        yield Pattern(axis, "position", there)
        yield Pattern(axis, "depth", depth ** np.arange(4))


def _functions(steps: Steps, nu: Array) -> Iterator[tuple[str, Array]]:
    z = nu / np.maximum(np.sqrt(np.mean(nu**2, axis=0)), 1e-6)
    for i, name in enumerate(VELOCITIES):
        others = np.delete(z, i, axis=1)
        own, size = z[:, i : i + 1], np.abs(z[:, i : i + 1])
        products = [own * others, own * np.abs(others), size * others]
        yield name, np.hstack([_of_velocity(z[:, i]), *products])
    r = steps.middle
    heading = np.arctan2(r[:, 1, 0], r[:, 0, 0])
    yield "heading", _waves(heading, 2)
    tilt = np.stack(
        [np.arctan2(r[:, 2, 1], r[:, 2, 2]), -np.arcsin(np.clip(r[:, 2, 0], -1.0, 1.0))], axis=1
    )
    for name, angle in zip(("roll", "pitch"), _standard(tilt).T, strict=True):
        yield name, angle[:, None] ** np.arange(4)
    t = 0.5 * (steps.t[1:] + steps.t[:-1])
    yield "time", _hats(t)


def _of_velocity(z: Array) -> Array:
    a = np.abs(z)
    sign = z / np.sqrt(z**2 + 0.01)
    return np.stack([z, a * z, z**2, z**3, a, sign * np.sqrt(a), sign], axis=1)


def _standard(x: Array) -> Array:
    """Columns with mean zero and standard deviation one."""
    out: Array = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-6)
    return out


def _waves(x: Array, most: int) -> Array:
    return np.stack([f(n * x) for n in range(1, most + 1) for f in (np.sin, np.cos)], axis=1)


def _hats(t: Array) -> Array:
    """Piecewise linear functions of time."""
    count = int(np.clip((t[-1] - t[0]) / _KNOTS, 3, _MOST_KNOTS))
    knots = np.linspace(t[0], t[-1], count)
    return np.stack([np.interp(t, knots, row) for row in np.eye(count)], axis=1)
