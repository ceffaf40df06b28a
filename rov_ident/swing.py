"""Closed-loop manoeuvres: a controller chases alternating targets, so that the thrusters swing
between their limits by themselves (Zhao et al. 2018), and the vehicle stays where it is safe.

Open-loop square waves identify best, but nobody knows where they end. A position and heading
controller with targets that jump back and forth gives nearly the same wrench, bounded in space.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rov_ident.config import Config
from rov_ident.effects import compiled
from rov_ident.errors import UserError
from rov_ident.excitation import WORKING_SPEED, authority
from rov_ident.frames import quaternion_to_matrix, wrap_angle
from rov_ident.model import Array
from rov_ident.sensors import Dive, Suite, measure
from rov_ident.simulate import simulate

CONTROL = 0.1  # s; period of the controller
_MARGIN = 0.2  # m; kept from the walls
_STIFFNESS = 1.5  # rad/s; of the controller, were it not for the limits
_TORQUE_BAND = (0.15, 0.6)  # Hz; of the multisine on roll and pitch


@dataclass(frozen=True)
class Limits:
    """Where and how hard the vehicle may move.

    ``tank``: length, width and depth [m] of free water about the start; ``thrust``: the largest
    wrench on each axis relative to :func:`rov_ident.excitation.authority`.
    """

    tank: tuple[float, ...] = (6.0, 6.0, 2.0)
    thrust: float = 1.0

    @property
    def half(self) -> Array:
        """Half the sides (3,) less a margin."""
        half: Array = 0.5 * np.array(self.tank) - _MARGIN
        return half


@dataclass(frozen=True)
class Swing:
    """Targets that alternate.

    ``amplitude`` (4,): half the distance between the targets, north, east, down [m] and heading
    [rad]; ``period`` (4,) s from one target to the next; ``torque`` (2,): multisine on roll and
    pitch, relative to the authority. The vehicle starts in the middle, heading north.
    """

    name: str
    amplitude: tuple[float, ...]
    period: tuple[float, ...]
    torque: tuple[float, ...] = (0.0, 0.0)

    def target(self, t: float) -> Array:
        """Position [m] and heading [rad] (4,) aimed at."""
        sides = np.floor(t / np.array(self.period)) % 2 == 0
        target: Array = np.where(sides, 1.0, -1.0) * np.array(self.amplitude)
        return target

    def scaled(self, factor: float) -> "Swing":
        amplitude, torque = (tuple(factor * x for x in of) for of in (self.amplitude, self.torque))
        return Swing(self.name, amplitude, self.period, torque)

    def waypoints(self, duration: float) -> list[dict[str, float]]:
        """Each new target with its time."""
        found: list[dict[str, float]] = []
        last = None
        for t in np.arange(0.0, duration, CONTROL):
            now = self.target(float(t))
            if last is None or (now != last).any():
                north, east, down, heading = now.tolist()
                found.append(
                    {"t_s": round(float(t), 3), "north_m": north, "east_m": east,
                     "down_m": down, "heading_rad": heading}
                )  # fmt: skip
            last = now
        return found


@dataclass(frozen=True)
class Course:
    """Legs of constant speed and heading, each (duration [s], speed [m/s], heading [rad])."""

    name: str
    legs: tuple[tuple[float, float, float], ...]
    torque: tuple[float, ...] = (0.0, 0.0)

    def target(self, t: float) -> Array:
        """Position [m] and heading [rad] (4,) aimed at; at the end of the last leg it stays."""
        target = np.zeros(4)
        for duration, speed, heading in self.legs:
            gone = speed * min(t, duration)
            target[:2] += gone * np.cos(heading), gone * np.sin(heading)
            target[3] = heading
            t -= duration
            if t <= 0.0:
                break
        return target


@dataclass(frozen=True)
class Flown:
    """A swing in simulation: demand (K, 6) from each of ``t`` (K,) on, and how far it went."""

    t: Array
    demand: Array
    reach: Array  # (3,) m; the largest distance from the start, north east down
    tilt: float  # rad; the largest


def fly(config: Config, swing: Swing | Course, duration: float, limits: Limits) -> Flown:
    """Simulate the configured vehicle under the controller.

    Raises
    ------
    UserError
        If the simulation diverges.
    """
    model, effects = config.dynamics, compiled(config.effects)
    bound = limits.thrust * authority(model)
    gain = np.diag(model.mass_matrix) * _STIFFNESS**2
    damping = 2.0 * np.diag(model.mass_matrix) * _STIFFNESS
    waves = _multisine(duration)
    nu, position, orientation = np.zeros(6), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    times = np.arange(0.0, duration, CONTROL)
    demand, reach, tilt = np.zeros((len(times), 6)), np.zeros(3), 0.0
    grid = np.linspace(0.0, CONTROL, 6)
    for k, t in enumerate(times):
        r = quaternion_to_matrix(orientation)
        heading = np.arctan2(r[1, 0], r[0, 0])
        target = swing.target(float(t))
        off = np.zeros(6)
        off[:3] = r.T @ (target[:3] - position)
        off[5] = wrap_angle(target[3] - heading)
        wrench = gain * off - damping * nu - model.body.restoring @ r[2]
        wrench[3:5] = bound[3:5] * np.array(swing.torque) * waves[:, k]
        demand[k] = np.clip(wrench, -bound, bound)
        run = simulate(
            model, grid, np.tile(demand[k], (len(grid), 1)), nu, position, orientation,
            effects=effects,
        )  # fmt: skip
        nu, position, orientation = run.nu[-1], run.position[-1], run.orientation[-1]
        reach = np.maximum(reach, np.abs(position))
        tilt = max(tilt, float(np.arccos(np.clip(r[2, 2], -1.0, 1.0))))
    return Flown(times, demand, reach, tilt)


def _multisine(duration: float) -> Array:
    """Two signals (2, K) of unit root mean square, with no frequency in common."""
    t = np.arange(0.0, duration, CONTROL)
    lines = np.linspace(*_TORQUE_BAND, 12)
    phases = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, len(lines))
    waves = np.sin(2.0 * np.pi * lines[:, None] * t + phases[:, None])
    return np.stack([waves[i::2].sum(axis=0) / np.sqrt(3.0) for i in range(2)])


def dive(
    config: Config,
    swing: Swing | Course,
    duration: float,
    limits: Limits,
    suite: Suite,
    seed: int = 0,
) -> Dive:
    """Fly the configured vehicle and measure it."""
    flown = fly(config, swing, duration, limits)
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, 1.0 / suite.wrench_rate)
    held = np.clip(np.searchsorted(flown.t, t + 1e-9, side="right") - 1, 0, None)
    return measure(config, t, flown.demand[held], duration, suite, rng)


def library(limits: Limits) -> list[Swing]:
    """Swings that fit the tank: single axes, pairs, all at once."""
    half = limits.half
    if (half <= 0.05).any():
        raise UserError(
            f"a tank of {' x '.join(f'{s:g}' for s in limits.tank)} m leaves no room: "
            f"{_MARGIN:g} m are kept from every wall"
        )
    # far enough that the vehicle gets up to speed, no further than the water
    a, b, c = (float(min(h, 1.2)) for h in half)
    turn = 0.9
    p = [max(2.0, 2.2 * x / WORKING_SPEED[0] ** 0.5) for x in (a, b, c)]
    still = (9.0, 9.0, 9.0, 9.0)

    def of(name: str, amplitude: tuple[float, ...], torque: tuple[float, ...]) -> Swing:
        period = (p[0], 1.13 * p[1], 1.31 * p[2], 2.7)
        used = tuple(x if y else z for x, y, z in zip(period, amplitude, still, strict=True))
        return Swing(name, amplitude, used, torque)

    none, both = (0.0, 0.0), (0.7, 0.7)
    return [
        of("surge swing", (a, 0.0, 0.0, 0.0), none),
        of("sway swing", (0.0, b, 0.0, 0.0), none),
        of("heave swing", (0.0, 0.0, c, 0.0), none),
        of("yaw zigzag", (0.0, 0.0, 0.0, turn), none),
        of("roll and pitch multisine", (0.0, 0.0, 0.0, 0.0), both),
        of("lateral swing (sway and yaw)", (0.0, b, 0.0, turn), none),
        of("surge swing with yaw zigzag", (a, 0.0, 0.0, turn), none),
        of("longitudinal swing (heave, with pitch multisine)", (0.0, 0.0, c, 0.0), (0.0, 0.7)),
        of("swing of all axes", (a, b, c, turn), both),
        of("swing of all axes, small", (0.5 * a, 0.5 * b, 0.5 * c, 0.5 * turn), (0.35, 0.35)),
    ]


def described(swing: Swing, duration: float, limits: Limits, flown: Flown) -> dict[str, Any]:
    """For a file that a mission planner reads."""
    return {
        "name": swing.name,
        "duration_s": duration,
        "waypoints": swing.waypoints(duration),
        "torque_multisine": {
            "roll": swing.torque[0], "pitch": swing.torque[1], "band_hz": list(_TORQUE_BAND),
        },
        "largest_wrench": np.abs(flown.demand).max(axis=0).tolist(),
        "reach_m": flown.reach.tolist(),
        "tilt_rad": flown.tilt,
        "limits": {"tank_m": list(limits.tank), "thrust": limits.thrust},
    }  # fmt: skip
