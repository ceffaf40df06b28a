"""Closed-loop manoeuvres: a controller follows alternating set points.

The thrusters then go from limit to limit (Zhao et al. 2018); the vehicle stays where it is safe.

Open-loop square waves identify best, but nobody knows where they end. A position and heading
controller whose set points jump back and forth gives nearly the same wrench, bounded in space.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_to_matrix, wrap_angle
from rov_ident.effects import act, compiled, memory
from rov_ident.model.equations import Array
from rov_ident.model.scales import WORKING_SPEED, authority
from rov_ident.model.thruster_allocation import is_known, matrix
from rov_ident.simulation.open_loop import simulate
from rov_ident.simulation.virtual_sensors import Dive, Suite, measure

CONTROL = 0.1  # s; period of the controller, a seventh of the time constant that it has
_MARGIN = 0.2  # m; kept from the walls: half a small vehicle
_STIFFNESS = 1.5  # rad/s; bandwidth, faster than drag brings a vehicle to rest (about 1 rad/s)
_TORQUE_BAND = (0.15, 0.6)  # Hz; of the multisine: about the 0.3 Hz of a BlueROV2 in roll and pitch
_LINES = 12  # of the multisine, every other one on roll
_FARTHEST = 1.2  # m from the middle to a target: enough to get up to speed
_TURN = 0.9  # rad from north to a target heading
_STILL = 9.0  # s; the period of an axis that stays where it is, which has no meaning
_LAP = 2.2  # times a target's distance over the square root of the working speed: s to the next


@dataclass(frozen=True)
class Limits:
    """Where and how hard the vehicle may move: length, width and depth [m] of free water about the
    start, and the largest wrench on each axis relative to :func:`rov_ident.model.scales.authority`.
    """

    tank: tuple[float, ...] = (6.0, 6.0, 2.0)
    thrust: float = 1.0

    @property
    def half(self) -> Array:
        """Half the sides (3,) less a margin."""
        return 0.5 * np.array(self.tank) - _MARGIN


@dataclass(frozen=True)
class AlternatingTargets:
    """A manoeuvre between targets that alternate: ``amplitude`` (4,), half the distance between
    them, north, east, down [m] and heading [rad]; ``period`` (4,) s from one to the next;
    ``torque`` (2,): multisine on roll and pitch, relative to the working wrench. It starts in the
    middle, heading north."""

    name: str
    amplitude: tuple[float, ...]
    period: tuple[float, ...]
    torque: tuple[float, ...] = (0.0, 0.0)

    def target(self, t: float) -> Array:
        """Position [m] and heading [rad] (4,) aimed at."""
        sides = np.floor(t / np.array(self.period)) % 2 == 0
        return np.where(sides, 1.0, -1.0) * np.array(self.amplitude)

    def scaled(self, factor: float) -> "AlternatingTargets":
        amplitude, torque = (tuple(factor * x for x in of) for of in (self.amplitude, self.torque))
        return AlternatingTargets(self.name, amplitude, self.period, torque)

    def waypoints(self, duration: float) -> list[dict[str, float]]:
        """Each new target with its time."""
        times = np.arange(0.0, duration, CONTROL)
        targets = np.array([self.target(float(t)) for t in times])
        new = np.diff(targets, axis=0, prepend=np.nan).any(axis=1)
        rows = np.column_stack([np.round(times[new], 3), targets[new]]).tolist()
        names = ("t_s", "north_m", "east_m", "down_m", "heading_rad")
        return [dict(zip(names, row, strict=True)) for row in rows]


@dataclass(frozen=True)
class Flight:
    """A manoeuvre in simulation: commands (K, 6), each held from ``t`` (K,) on, and its extent."""

    t: Array
    demand: Array
    reach: Array  # (3,) m; the largest distance from the start, north east down
    tilt: float  # rad; the largest


def fly(config: Config, manoeuvre: AlternatingTargets, duration: float, limits: Limits) -> Flight:
    """Simulate the configured vehicle under the controller. UserError if that diverges."""
    model, effects = config.dynamics, compiled(config.effects)
    bound = limits.thrust * authority(model)
    reachable = _reachable(config)
    gain = np.diag(model.mass_matrix) * _STIFFNESS**2
    damping = 2.0 * np.diag(model.mass_matrix) * _STIFFNESS
    waves = _multisine(duration)
    nu, position, orientation = np.zeros(6), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    of_thrusters = memory()
    times = np.arange(0.0, duration, CONTROL)
    demand, reach, tilt = np.zeros((len(times), 6)), np.zeros(3), 0.0
    grid = np.linspace(0.0, CONTROL, 6)
    for k, t in enumerate(times):
        r = quaternion_to_matrix(orientation)
        heading = np.arctan2(r[1, 0], r[0, 0])
        target = manoeuvre.target(float(t))
        off = np.zeros(6)
        off[:3] = r.T @ (target[:3] - position)
        off[5] = wrap_angle(target[3] - heading)
        wrench = gain * off - damping * nu - model.body.restoring @ r[2]
        wrench[3:5] = bound[3:5] * np.array(manoeuvre.torque) * waves[:, k]
        possible = reachable @ np.clip(wrench, -bound, bound)
        demand[k] = possible / max(1.0, float((np.abs(possible) / bound).max()))
        acting = demand[k].copy()
        act(effects, of_thrusters, float(t), CONTROL, acting)
        run = simulate(
            model, t + grid, np.tile(acting, (len(grid), 1)), nu, position, orientation,
            effects=effects,
        )  # fmt: skip
        nu, position, orientation = run.nu[-1], run.position[-1], run.orientation[-1]
        reach = np.maximum(reach, np.abs(position))
        tilt = max(tilt, float(np.arccos(np.clip(r[2, 2], -1.0, 1.0))))
    return Flight(times, demand, reach, tilt)


def _reachable(config: Config) -> Array:
    """What turns a wrench into the nearest one (6, 6) that the thrusters can make, relative to the
    working wrench of each axis; the same one where they make any, or are not known."""
    known = config.thrusters
    if not is_known(known):
        return np.eye(6)
    weight = 1.0 / authority(config.dynamics)
    scaled = weight[:, None] * matrix(known)
    if np.linalg.matrix_rank(scaled) == 6:
        return np.eye(6)
    out: Array = scaled @ np.linalg.pinv(scaled) * weight / weight[:, None]
    return out


def _multisine(duration: float) -> Array:
    """Two signals (2, K) of unit root mean square, with no frequency in common."""
    t = np.arange(0.0, duration, CONTROL)
    lines = np.linspace(*_TORQUE_BAND, _LINES)
    phases = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, len(lines))
    waves = np.sin(2.0 * np.pi * lines[:, None] * t + phases[:, None])
    return np.stack([waves[i::2].sum(axis=0) / np.sqrt(3.0) for i in range(2)])


def dive(
    config: Config,
    manoeuvre: AlternatingTargets,
    duration: float,
    limits: Limits,
    suite: Suite,
    seed: int = 0,
) -> Dive:
    """Fly the configured vehicle and measure it."""
    flight = fly(config, manoeuvre, duration, limits)
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, 1.0 / suite.wrench_rate)
    held = np.clip(np.searchsorted(flight.t, t + 1e-9, side="right") - 1, 0, None)
    return measure(config, t, flight.demand[held], duration, suite, rng)


def library(limits: Limits) -> list[AlternatingTargets]:
    """Manoeuvres that fit the tank: single axes, pairs, all at once. Their names are published
    (``plan --json``, docs/driving.md) and stay. UserError if the tank is too small for any."""
    half = limits.half
    if (half <= 0.05).any():
        raise UserError(
            f"a tank of {' x '.join(f'{s:g}' for s in limits.tank)} m leaves no room: "
            f"{_MARGIN:g} m are kept from every wall"
        )
    a, b, c = (float(min(h, _FARTHEST)) for h in half)
    p = [max(2.0, _LAP * x / WORKING_SPEED[0] ** 0.5) for x in (a, b, c)]
    none, both = (0.0, 0.0), (0.7, 0.7)
    manoeuvres: list[tuple[str, tuple[float, ...], tuple[float, ...]]] = [
        ("surge swing", (a, 0.0, 0.0, 0.0), none),
        ("sway swing", (0.0, b, 0.0, 0.0), none),
        ("heave swing", (0.0, 0.0, c, 0.0), none),
        ("yaw zigzag", (0.0, 0.0, 0.0, _TURN), none),
        ("roll and pitch multisine", (0.0, 0.0, 0.0, 0.0), both),
        ("lateral swing (sway and yaw)", (0.0, b, 0.0, _TURN), none),
        ("surge swing with yaw zigzag", (a, 0.0, 0.0, _TURN), none),
        ("longitudinal swing (heave, with pitch multisine)", (0.0, 0.0, c, 0.0), (0.0, 0.7)),
        ("heave swing and yaw zigzag, with roll and pitch multisine", (0.0, 0.0, c, _TURN), both),
        ("swing of all axes", (a, b, c, _TURN), both),
        ("swing of all axes, small", (0.5 * a, 0.5 * b, 0.5 * c, 0.5 * _TURN), (0.35, 0.35)),
    ]
    period = (p[0], 1.13 * p[1], 1.31 * p[2], 2.7)
    periods = [tuple(x if y else _STILL for x, y in zip(period, m[1])) for m in manoeuvres]
    return [AlternatingTargets(n, a, t, r) for (n, a, r), t in zip(manoeuvres, periods)]


def described(
    manoeuvre: AlternatingTargets, duration: float, limits: Limits, flight: Flight
) -> dict[str, Any]:
    """For a file that a mission planner reads."""
    return {
        "name": manoeuvre.name,
        "duration_s": duration,
        "waypoints": manoeuvre.waypoints(duration),
        "torque_multisine": {
            "roll": manoeuvre.torque[0],
            "pitch": manoeuvre.torque[1],
            "band_hz": list(_TORQUE_BAND),
        },
        "largest_wrench": np.abs(flight.demand).max(axis=0).tolist(),
        "reach_m": flight.reach.tolist(),
        "tilt_rad": flight.tilt,
        "limits": {"tank_m": list(limits.tank), "thrust": limits.thrust},
    }  # fmt: skip
