"""From the commands of single thrusters to the wrench on the body.

``tau = B f``: column i of the allocation ``B`` (6, n) is thruster i's unit force ``d``, the
direction in which it pushes at a positive command, and its moment ``r x d`` about the body origin
(Fossen 2021, sec. 9.4). Forces come as they are, or from pulse widths by a curve of thrust at rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array
from rov_ident.model.t200_curve import CURVES, KILOGRAM_FORCE

FORCE, PWM, NORMALIZED = "force", "pwm", "normalized"
SIGNALS = (FORCE, PWM, NORMALIZED)

_PULSES = np.arange(1100.0, 1901.0)  # us; what an ESC takes, and beyond it does no more
_NEUTRAL, _SPAN = 1500.0, 400.0  # us
_PLAUSIBLE = (500.0, 2500.0)  # us; a pulse outside is not one
_LARGEST_FORCE = 1e5  # N, of one thruster


_Vector = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """What of the section `thrusters` of a configuration is needed here; see there."""

    signal: str
    position: _Vector
    direction: _Vector
    allocation: _Vector
    channels: _Vector
    voltage: float
    curve_pwm: _Vector
    curve_force: _Vector


def knows(voltage: float) -> bool:
    """Whether :func:`t200` has a curve for it [V]."""
    return min(CURVES) <= voltage <= max(CURVES)


@cache
def t200(voltage: float) -> Array:
    """Thrust [N] of a T200 (801,) at the pulses 1100, 1101 ... 1900 us; linear in the voltage.

    Raises UserError if the voltage is outside the table.
    """
    known = sorted(CURVES)
    if not knows(voltage):
        raise UserError(
            f"thrusters.voltage, or the battery of a log, is {voltage:g} V, but the curve of the "
            f"T200 is known from {known[0]:g} to {known[-1]:g} V: give thrusters.curve_pwm and "
            "thrusters.curve_force"
        )
    after = max(1, int(np.searchsorted(known, voltage)))
    low, high = known[after - 1], known[after]
    share = (voltage - low) / (high - low)
    return KILOGRAM_FORCE * ((1.0 - share) * _curve(low) + share * _curve(high))


def _curve(voltage: float) -> Array:
    from scipy.interpolate import PchipInterpolator  # here: it takes its time to import

    rows = CURVES[voltage]
    return PchipInterpolator(list(rows), list(rows.values()))(_PULSES)


def allocation(position: Array, direction: Array) -> Array:
    """B (6, n) of thrusters at (n, 3) [m], pushing along (n, 3) of any length but zero."""
    d = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return np.vstack([d.T, np.cross(position, d).T])


class Allocator:
    """Commands of thrusters into wrenches, forward-starboard-down about the body origin.

    ``signal`` is FORCE, PWM or NORMALIZED.
    """

    def __init__(self, config: Geometry, signal: str) -> None:
        self.matrix = matrix(config)
        self._signal, self._config = signal, config
        channels = config.channels or range(1, self.matrix.shape[1] + 1)
        self._channels = np.array(channels, dtype=int) - 1

    def wrench(self, commands: Sequence[float] | Array, voltage: float | None = None) -> Array:
        """The wrench (6,) [N, N m] of an array of commands (k,).

        ``voltage`` [V] in place of the configured one.

        Raises ValueError: in words, if there are too few commands, or one that cannot be.
        """
        commands, needed = np.asarray(commands, dtype=float), self._channels.max() + 1
        if len(commands) < needed:
            raise ValueError(f"an array of {len(commands)} values, but thrusters needs {needed}")
        return self.matrix @ self._forces(commands[self._channels], voltage)

    def _forces(self, commands: Array, voltage: float | None) -> Array:
        if not np.isfinite(commands).all():
            raise ValueError("a command that is not finite")
        if self._signal == FORCE:
            if np.abs(commands).max() > _LARGEST_FORCE:
                raise ValueError("a force no thruster has: check thrusters.signal")
            return commands
        if self._signal == NORMALIZED:
            if np.abs(commands).max() > 1.0 + 1e-6:
                raise ValueError("a command outside -1 to 1: check thrusters.signal")
            commands = _NEUTRAL + _SPAN * commands
        # An output that is switched off says 0, one that is not known 65535.
        off = (commands == 0.0) | (commands == 65535.0)
        commands = np.where(off, _NEUTRAL, commands)
        if commands.min() < _PLAUSIBLE[0] or commands.max() > _PLAUSIBLE[1]:
            raise ValueError("a pulse that is none (in us): check thrusters.signal and .channels")
        c = self._config
        if c.curve_pwm:
            return np.interp(commands, c.curve_pwm, c.curve_force)
        # To 0.01 V: finer than any sensor, and few curves in a dive.
        return np.interp(commands, _PULSES, t200(round(voltage or c.voltage, 2)))


def matrix(config: Geometry) -> Array:
    """The allocation B (6, n) that the configuration gives.

    Raises UserError if it gives none, two, or one of the wrong size.
    """
    position, direction, given = config.position, config.direction, config.allocation
    if given and (position or direction):
        raise UserError(
            "thrusters has both an allocation and positions or directions: keep one of them"
        )
    if given:
        if len(given) % 6:
            raise UserError(
                f"thrusters.allocation has {len(given)} values, but must have six for each "
                "thruster: X Y Z K M N of the first per newton, then of the second, and so on"
            )
        return np.reshape(given, (-1, 6)).T
    if not direction or len(direction) != len(position) or len(direction) % 3:
        raise UserError(
            f"thrusters.position has {len(position)} values and thrusters.direction "
            f"{len(direction)}, but both must have three, x y z, for each thruster"
        )
    d = np.reshape(direction, (-1, 3))
    if not np.linalg.norm(d, axis=1).all():
        raise UserError("thrusters.direction has a direction of length zero: give it a length")
    return allocation(np.reshape(position, (-1, 3)), d)


def is_known(config: Geometry) -> bool:
    """Whether the configuration gives an allocation, be it a wrong one."""
    return bool(config.allocation or config.position or config.direction)


def check(config: Geometry, signal: str) -> None:
    """Refuse what could not be used later.

    Raises UserError: one sentence naming the key.
    """
    if not is_known(config):
        raise UserError(
            "thrusters has no allocation: give thrusters.position and thrusters.direction, or "
            "thrusters.allocation"
        )
    n = matrix(config).shape[1]
    if config.channels and len(config.channels) != n:
        raise UserError(
            f"thrusters.channels has {len(config.channels)} values, but there are {n} thrusters"
        )
    if any(c < 1 or not float(c).is_integer() for c in config.channels):
        raise UserError("thrusters.channels must be whole numbers from 1: the first output is 1")
    pwm, force = config.curve_pwm, config.curve_force
    if len(pwm) != len(force) or len(pwm) == 1:
        raise UserError(
            f"thrusters.curve_pwm has {len(pwm)} values and thrusters.curve_force {len(force)}, "
            "but a curve needs as many of the one as of the other, and two at least"
        )
    if np.any(np.diff(pwm) <= 0.0):
        raise UserError("thrusters.curve_pwm must increase: sort the curve by pulse width")
    if signal != FORCE and not pwm:
        t200(config.voltage)
