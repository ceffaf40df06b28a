"""Fin angles and shaft speeds of an interval, from the joints of a vehicle.

A joint's state is measured, not commanded: between two messages it is taken to change in a straight
line. The mean over the interval of a sample then acts throughout it, as the velocity at its end
depends on little else: an angle that slews at 1 rad/s in an interval of 0.1 s, with a response of
1/s to it, leaves an error of dt^3 / 12, 1e-4 rad s of angle, at the end of a slew.
"""

import math
from bisect import bisect_left
from collections import Counter

import numpy as np

from rov_ident.config import Config, Fin, Shaft
from rov_ident.core.messages import DRIVE, Array, Joints
from rov_ident.effects import compiled, steer, steering_memory
from rov_ident.model.coefficients import INPUTS

_KEPT = 10.0  # s; of messages while no sample asks for them


class Driven:
    """The inputs that a configuration names, as they come; those that it does not name are zero.

    ``counts`` holds, by reason, what could not be used.
    """

    def __init__(self, config: Config, counts: Counter[str]) -> None:
        self.counts = counts
        self.configure(config)
        self.clear()

    def configure(self, config: Config) -> None:
        """Take other settings; what has come stays, where the same joints are named."""
        self._timeout = config.timeout
        self._joints = config.inputs.joints
        self.used = bool(self._joints)
        self._effects = compiled(config.effects)
        self._steers = bool(self._effects.steers.any())

    def clear(self) -> None:
        """Forget what has come."""
        self._t: dict[str, list[float]] = {name: [] for name in INPUTS}
        self._x: dict[str, list[float]] = {name: [] for name in INPUTS}
        self.memory = steering_memory()  # of the effects on fins

    def push(self, t: float, message: Joints) -> None:
        """Take the joints' state at t [s]; joints that nobody named are passed over."""
        found = False
        for name, given in self._joints.items():
            x = value_of(given, message)
            if x is None:
                continue
            found = True
            if not math.isfinite(x):
                self.counts[f"{DRIVE}: {name} is not finite"] += 1
                continue
            times, values = self._t[name], self._x[name]
            times.append(t)
            values.append(x)
            if t - times[0] > _KEPT:
                _forget(times, values, t - _KEPT)
        if not found:
            self.counts[f"{DRIVE}: a message without any of the joints of inputs"] += 1

    def over(self, begin: float, end: float) -> tuple[Array, str]:
        """Mean over an interval [s] and value at its end (2, 4), as read; and which is missing, if
        any."""
        out = np.zeros((2, len(INPUTS)))
        for name in self._joints:
            times, values = self._t[name], self._x[name]
            if not times or times[0] > end or end - times[-1] > self._timeout:
                self.memory = steering_memory()
                return out, name
            _forget(times, values, begin)
            first, last = bisect_left(times, begin), bisect_left(times, end)
            knots = np.array([begin, *times[first:last], end])
            x = np.interp(knots, times, values)
            i = INPUTS.index(name)
            out[1, i] = x[-1]
            out[0, i] = np.trapezoid(x, knots) / (end - begin) if end > begin else x[-1]
        return out, ""

    def acting(self, dt: float, inputs: Array) -> Array:
        """What acts (2, 4) of the ``inputs`` that :meth:`over` has read of an interval."""
        if not self._steers:
            return inputs
        acting = inputs.copy()
        steer(self._effects, self.memory, dt, acting)
        return acting


def value_of(given: Fin | Shaft, message: Joints) -> float | None:
    """The input that a joint of a message gives; None where the message has no such joint."""
    if given.joint not in message.names:
        return None
    i = message.names.index(given.joint)
    numbers = message.velocity if isinstance(given, Shaft) else message.position
    return given.scale * float(numbers[i]) if i < len(numbers) else None


def _forget(times: list[float], values: list[float], before: float) -> None:
    """All but the last message before that time."""
    first = max(bisect_left(times, before) - 1, 0)
    del times[:first], values[:first]
