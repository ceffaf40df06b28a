"""Bags with a hidden effect, drawn from a seed, by a hand independent of the package.

    case = draw(seed, ("thruster_lag",), strength=0.5)

gives the messages of a dive and a configuration that knows nothing of the thruster lag. Nothing
here uses the package's equations: :mod:`fossen` moves the vehicle and the sensors are written anew,
so that two hands must agree before a test of :mod:`rov_ident` passes. Only messages and
configuration are the package's.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from bench.simulators import fossen
from bench.simulators.fossen import AXES, GRAVITY, VELOCITIES, Array
from rov_ident.config import Config, from_parameters
from rov_ident.core.messages import Imu, Message, Odometry, Wrench

START = 1_000_000_000  # ns; stamp of t = 0

# Standard deviations of one reading at noise 1.
POSITION_STD, ATTITUDE_STD = 0.01, 0.002  # m, rad
LINEAR_STD, ANGULAR_STD = 0.008, 0.004  # m/s, rad/s
ACCELEROMETER_STD, GYRO_STD = 0.03, 0.003  # m/s2, rad/s
WRENCH_STD = 0.01  # relative


# ------------------------------------------------------------------ conditions


@dataclass(frozen=True)
class Conditions:
    """How a dive is driven and measured. Rates in Hz (``imu_rate`` 0: no IMU); ``noise`` multiplies
    every standard deviation; ``off`` is the largest relative error of a configured coefficient.

    ``excitation`` is one of :data:`EXCITATIONS`, or ``any`` well-excited kind; ``family`` one of
    :data:`FAMILIES`, or ``other`` for any but the first. ``reading`` is constant noise of the
    wrench's reading, of forces [N] and moments [N m], beside that in proportion to the wrench.
    """

    duration: float = 180.0
    odometry_rate: float = 20.0
    imu_rate: float = 100.0
    wrench_rate: float = 50.0
    noise: float = 1.0
    off: float = 0.08
    excitation: str = "any"
    family: str = "heavy"
    reading: tuple[float, float] = (0.0, 0.0)


TIERS: dict[str, Conditions] = {
    "standard": Conditions(),
    "off 50 %": Conditions(off=0.5),
    "no IMU": Conditions(imu_rate=0.0),
    "odometry 5 Hz": Conditions(odometry_rate=5.0),
    "noise x 3": Conditions(noise=3.0),
    "60 s": Conditions(duration=60.0),
    "pilot": Conditions(excitation="pilot"),
    "tank": Conditions(excitation="tank"),
    "no heave": Conditions(excitation="no-heave"),
    "other vehicles": Conditions(family="other"),
    "other rates": Conditions(odometry_rate=31.0, imu_rate=200.0, wrench_rate=10.0),
}

UNOBSERVABLE: dict[str, frozenset[str]] = {
    "no IMU": frozenset({"imu_bias"}),
    # sway and heave hardly move, so their products with surge and their couplings are noise
    "pilot": frozenset({"lift", "coupled_damping", "added_mass_coupling"}),
}
"""Effects that no method can see, by tier."""

USED: dict[str, str] = {"pilot": "XN", "no-heave": "XYKMN"}
"""Axes that are driven, where not all are: the effects of single axes are drawn on these."""


# ------------------------------------------------------------------ vehicles


@dataclass(frozen=True)
class Vehicle:
    """A rigid body and its coefficients; ``speed`` (6,) is what it does along each axis at work.

    cog, cob, imu (3,) from the body origin; inertia (3, 3) about the centre of gravity.
    """

    family: str
    mass: float
    buoyancy: float
    cog: Array
    cob: Array
    inertia: Array
    theta: dict[str, float]
    speed: Array
    imu: Array

    @property
    def limits(self) -> Array:
        """The wrench (6,) that keeps, or within 3 s reaches, the working speed along each axis."""
        inertia = np.diag(
            fossen.rigid_mass(self.mass, self.cog, self.inertia) + fossen.added_mass(self.theta)
        )
        drag = np.array(
            [
                -self.theta.get(f"{A}_{a}", 0.0) * v - self.theta.get(f"{A}_{a}{a}", 0.0) * v * v
                for A, a, v in zip(AXES, VELOCITIES, self.speed)
            ]
        )
        return np.maximum(drag, inertia * self.speed / 3.0)


def _diagonal(dot: Sequence[float], linear: Sequence[float], square: Sequence[float]) -> dict:
    """The eighteen diagonal coefficients."""
    theta = {f"{A}_{a}dot": value for A, a, value in zip(AXES, VELOCITIES, dot)}
    theta |= {f"{A}_{a}": value for A, a, value in zip(AXES, VELOCITIES, linear)}
    return theta | {f"{A}_{a}{a}": value for A, a, value in zip(AXES, VELOCITIES, square)}


# von Benzon et al. (2022); linear sway, roll and yaw damping, zero there, as in similar vehicles.
_HEAVY = _diagonal(
    [-6.36, -7.12, -18.68, -0.189, -0.135, -0.222],
    [-13.7, -20.0, -33.0, -0.3, -0.8, -0.3],
    [-141.0, -217.0, -190.0, -1.19, -0.47, -1.5],
)


def _heavy(rng: np.random.Generator) -> Vehicle:
    """A BlueROV2 Heavy, everything within 25 %; a few couplings now and then."""
    theta = _around(rng, _HEAVY)
    mass = 13.5 * rng.uniform(0.85, 1.15)
    inertia = np.diag([0.26, 0.23, 0.37]) * rng.uniform(0.75, 1.25, 3)
    cog = rng.uniform(-1.0, 1.0, 3) * [0.005, 0.003, 0.005]
    total = np.diag(fossen.rigid_mass(mass, cog, inertia) + fossen.added_mass(theta))
    few = rng.permutation(["Y_rdot", "Z_qdot", "N_v", "M_w", "Y_uv", "N_uv", "M_uw"])[
        : rng.integers(1, 4)
    ]
    sizes = rng.uniform(-1.0, 1.0, len(few))
    if rng.random() < 0.3:
        theta |= {n: _coupling(n, 0.15 * s, theta, total) for n, s in zip(few.tolist(), sizes)}
    return _trimmed(rng, "heavy", mass, cog, inertia, theta, [0.5, 0.5, 0.4, 0.8, 0.8, 0.8])


def _work(rng: np.random.Generator) -> Vehicle:
    """A work-class ROV of 2 to 4 t: the same shape about six times as long, at its own speeds."""
    s = (rng.uniform(2000.0, 4000.0) / 13.5) ** (1.0 / 3.0)
    mass = 13.5 * s**3
    # added mass and areas grow with the length; friction, the linear part, is a smaller share
    dot = np.array([s**3] * 3 + [s**5] * 3)
    linear = np.array([s**2] * 3 + [s**4] * 3) * 0.5
    square = np.array([s**2] * 3 + [s**5] * 3)
    theta = _around(rng, dict(zip(_HEAVY, np.array([*_HEAVY.values()]) * [*dot, *linear, *square])))
    inertia = np.diag([0.26, 0.23, 0.37]) * s**5 * rng.uniform(0.75, 1.25, 3)
    cog = rng.uniform(-0.02, 0.02, 3)
    return _trimmed(rng, "work", mass, cog, inertia, theta, [0.7, 0.5, 0.4, 0.15, 0.15, 0.3])


def _auv(rng: np.random.Generator) -> Vehicle:
    """A REMUS-like torpedo with thrusters all round, speeds of such a hovering one."""
    theta = _diagonal(
        [-0.93, -35.5, -35.5, -0.0704, -4.88, -4.88],
        [-1.5, -30.0, -30.0, -0.1, -5.0, -5.0],
        [-2.9, -300.0, -300.0, -0.13, -94.0, -94.0],
    )
    theta |= {"Y_rdot": 1.93, "Z_qdot": -1.93, "Y_uv": -28.6, "Z_uw": -28.6, "M_uw": -10.6}
    theta |= {"N_uv": 10.6, "Y_ur": 6.15, "Z_uq": -6.15, "M_uq": -3.9, "N_ur": -3.9}
    theta = _around(rng, theta)
    mass = 30.5 * rng.uniform(0.85, 1.15)
    inertia = np.diag([0.165, 3.44, 3.45]) * rng.uniform(0.75, 1.25, 3)
    cog = np.array([0.0, 0.0, 0.0196]) * rng.uniform(0.75, 1.25)
    return _trimmed(rng, "auv", mass, cog, inertia, theta, [1.0, 0.2, 0.2, 0.4, 0.25, 0.25])


FAMILIES: dict[str, Callable[[np.random.Generator], Vehicle]] = {
    "heavy": _heavy,
    "auv": _auv,
    "work": _work,
}


def _around(rng: np.random.Generator, theta: Mapping[str, float]) -> dict[str, float]:
    return {name: value * rng.uniform(0.75, 1.25) for name, value in theta.items()}


def _trimmed(
    rng: np.random.Generator,
    family: str,
    mass: float,
    cog: Array,
    inertia: Array,
    theta: dict[str, float],
    speed: Sequence[float],
) -> Vehicle:
    """Level and slightly buoyant, the centre of gravity below that of buoyancy."""
    length = (mass / 13.5) ** (1.0 / 3.0)
    cob = cog - [0.0, 0.0, length * rng.uniform(0.01, 0.03)]
    cob[:2] += length * rng.uniform(-0.001, 0.001, 2)
    buoyancy = mass * (GRAVITY + rng.uniform(0.04, 0.2))
    imu = length * rng.uniform(-1.0, 1.0, 3) * [0.15, 0.05, 0.08]
    return Vehicle(family, mass, buoyancy, cog, cob, inertia, theta, np.array(speed), imu)


def _coupling(name: str, share: float, theta: Mapping[str, float], total: Array) -> float:
    """A coupling coefficient as a share of what the two diagonal terms of its place allow.

    At a share of 1 mass or linear damping would lose a direction (2 for a damping term alone, of
    which half is symmetric); products are compared with the quadratic damping of their axis.
    """
    i, j = AXES.index(name[0]), VELOCITIES.index(name[2])
    if name.endswith("dot"):
        return float(share * math.sqrt(total[i] * total[j]))
    if len(name) == 3:
        own, other = (theta[f"{AXES[k]}_{VELOCITIES[k]}"] for k in (i, j))
        return share * 2.0 * math.sqrt(own * other)
    # a moment by two linear velocities: an arm of 0.1 of the vehicle's length and the force's size
    force = {"Y": "Y_vv", "Z": "Z_ww", "M": "Z_ww", "N": "Y_vv"}[name[0]]
    arm = 1.0 if i < 3 else math.sqrt(total[i] / total[0])
    return -share * theta[force] * arm


# ------------------------------------------------------------------ effects: what is drawn


class Knob(NamedTuple):
    """A drawn parameter: ``null + strength * (value - null)`` within the bounds; NaN: as it is."""

    name: str
    value: float
    null: float = math.nan
    lower: float = -math.inf
    upper: float = math.inf


class Setting(NamedTuple):
    """What the draw of an effect may look at."""

    vehicle: Vehicle
    used: str  # axes that are driven
    duration: float
    total: Array  # (6,) diagonal of the mass matrix


Draw = Callable[[np.random.Generator, Setting], list[Knob]]


def _some(rng: np.random.Generator, of: str, most: int) -> str:
    """One to ``most`` of the axes; their order is drawn for all six, whichever are asked for."""
    number = int(rng.integers(1, most + 1))
    return "".join([a for a in rng.permutation(list(AXES)) if a in of][:number])


def _sign(rng: np.random.Generator) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


def _horizontal(rng: np.random.Generator, slope: float = 0.3) -> Array:
    """A unit vector of any heading, within a slope of the horizontal."""
    heading, dip = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(-slope, slope)
    c = math.cos(dip)
    return np.array([c * math.cos(heading), c * math.sin(heading), math.sin(dip)])


def _force(rng: np.random.Generator, s: Setting, low: float, high: float) -> Array:
    return rng.uniform(low, high) * s.vehicle.limits[0] * _horizontal(rng)


def _vector(names: str, values: Array, prefix: str = "") -> list[Knob]:
    return [Knob(prefix + n, float(v), 0.0) for n, v in zip(names.split(), values)]


def _point(rng: np.random.Generator, s: Setting) -> list[Knob]:
    length = (s.vehicle.mass / 13.5) ** (1.0 / 3.0)
    return [
        Knob(n, float(length * rng.uniform(-1.0, 1.0) * r)) for n, r in zip("xyz", (0.2, 0.15, 0.1))
    ]


def _onset(rng: np.random.Generator, s: Setting) -> Knob:
    return Knob("onset", round(float(s.duration * rng.uniform(0.2, 0.8)), 6))


def _absent(doubled: bool) -> Draw:
    def draw(rng: np.random.Generator, s: Setting) -> list[Knob]:
        names = [f"{A}_{VELOCITIES[AXES.index(A)] * (1 + doubled)}" for A in _some(rng, s.used, 3)]
        return [Knob(n, s.vehicle.theta[n], 0.0) for n in names]

    return draw


def _asymmetric(rng: np.random.Generator, s: Setting) -> list[Knob]:
    doubled = 2 if rng.random() < 0.8 else 1
    # starboard and port alike: sway, roll and yaw have it from equipment on one side only
    usual = "XZM" if rng.random() < 0.8 else AXES
    knobs = []
    for A in _some(rng, "".join(set(usual) & set(s.used)), 2):
        name = f"{A}_{VELOCITIES[AXES.index(A)] * doubled}"
        value = s.vehicle.theta[name]
        change = 1.0 + _sign(rng) * rng.uniform(0.3, 0.6)
        knobs.append(Knob(name, value * change, value, upper=0.0))
    return knobs


def _couplings(candidates: Sequence[str], low: float, high: float, most: float) -> Draw:
    """One or two of the candidates, none in the place or in the mirrored place of another."""

    def draw(rng: np.random.Generator, s: Setting) -> list[Knob]:
        order = [str(n) for n in rng.permutation(candidates)]
        number = int(rng.integers(1, 3))
        shares = [_sign(rng) * rng.uniform(low, high) for _ in order]
        driven = [n for n in order if n[0] in s.used and AXES[VELOCITIES.index(n[2])] in s.used]
        new = [n for n in driven if n not in s.vehicle.theta]
        knobs: list[Knob] = []
        places: set[frozenset[int]] = set()
        for name, share in zip(new or driven or order, shares):
            place = frozenset((AXES.index(name[0]), VELOCITIES.index(name[2])))
            if place in places or len(knobs) == number:
                continue
            places.add(place)
            value = s.vehicle.theta.get(name) or _coupling(name, share, s.vehicle.theta, s.total)
            limit = abs(_coupling(name, most, s.vehicle.theta, s.total))
            knobs.append(Knob(name, value, 0.0, -limit, limit))
        return knobs

    return draw


def _lift(rng: np.random.Generator, s: Setting) -> list[Knob]:
    knobs = []
    for name in rng.permutation(["Y_uv", "Z_uw", "M_uw", "N_uv"])[: rng.integers(1, 3)].tolist():
        share = rng.uniform(0.1, 0.25)
        if name[0] in "MN":
            share *= _sign(rng)
        if "w" in name and "Z" not in s.used:
            name = {"Z_uw": "Y_uv", "M_uw": "N_uv"}[name]
        value = s.vehicle.theta.get(name) or _coupling(name, -share, s.vehicle.theta, s.total)
        knobs.append(Knob(name, value, 0.0))
    return knobs[: len({k.name for k in knobs})]


def _cog(rng: np.random.Generator, s: Setting) -> list[Knob]:
    """A moment of about half the working roll moment; upward by no more than leaves it upright."""
    size = rng.uniform(0.4, 0.9) * s.vehicle.limits[4] / (s.vehicle.mass * GRAVITY)
    heading, rise = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(-0.8, 0.3)
    height = s.vehicle.cog[2] - s.vehicle.cob[2]
    dx, dy, dz = size * math.cos(heading), size * math.sin(heading), -size * rise
    return [Knob("dx", dx, 0.0), Knob("dy", dy, 0.0), Knob("dz", dz, 0.0, -0.4 * height)]


def _payload(rng: np.random.Generator, s: Setting) -> list[Knob]:
    wet = rng.uniform(0.05, 0.12) * s.vehicle.limits[2] / GRAVITY
    return [Knob("mass_wet", wet, 0.0), *_point(rng, s), _onset(rng, s)]


def _wave(rng: np.random.Generator, s: Setting) -> list[Knob]:
    force = rng.uniform(0.08, 0.25) * s.vehicle.limits[0] * _horizontal(rng, 1.0)
    frequency, phase = rng.uniform(0.05, 0.4), rng.uniform(-math.pi, math.pi)
    return [*_vector("fx fy fz", force), Knob("frequency", frequency), Knob("phase", phase)]


def _tether(rng: np.random.Generator, s: Setting) -> list[Knob]:
    k = rng.uniform(0.08, 0.2) * s.vehicle.limits[0] / s.vehicle.speed[0] ** 2
    return [Knob("k", k, 0.0), *_point(rng, s)]


def _gains(most: int, low: float, high: float, *, either: bool = False, least: float) -> Draw:
    """A factor on up to ``most`` axes: a loss of low to high, or a gain as often if ``either``."""

    def draw(rng: np.random.Generator, s: Setting) -> list[Knob]:
        return [
            Knob(
                f"gain_{A}",
                1.0 - (_sign(rng) if either else 1.0) * rng.uniform(low, high),
                1.0,
                least,
                2.5,
            )
            for A in _some(rng, s.used, most)
        ]

    return draw


def _failure(rng: np.random.Generator, s: Setting) -> list[Knob]:
    return [*_gains(2, 0.3, 0.7, least=0.0)(rng, s), _onset(rng, s)]


def _deadband(rng: np.random.Generator, s: Setting) -> list[Knob]:
    return [
        Knob(f"width_{A}", rng.uniform(0.08, 0.25) * s.vehicle.limits[AXES.index(A)], 0.0)
        for A in _some(rng, s.used, 3)
    ]


def _one(name: str, low: float, high: float, upper: float = math.inf) -> Draw:
    return lambda rng, s: [Knob(name, rng.uniform(low, high), 0.0, upper=upper)]


def _lever(rng: np.random.Generator, s: Setting) -> list[Knob]:
    length = (s.vehicle.mass / 13.5) ** (1.0 / 3.0)
    return _vector("x y z", length * rng.uniform(0.1, 0.3) * _horizontal(rng, 1.0))


def _tilt(rng: np.random.Generator, s: Setting) -> list[Knob]:
    return _vector("roll pitch yaw", rng.uniform(0.03, 0.12) * _horizontal(rng, 1.5))


def _scale(rng: np.random.Generator, s: Setting) -> list[Knob]:
    return [Knob("scale", 1.0 + _sign(rng) * rng.uniform(0.03, 0.1), 1.0, 0.5, 2.0)]


def _bias(rng: np.random.Generator, s: Setting) -> list[Knob]:
    a, g = rng.uniform(0.05, 0.2, 3), rng.uniform(0.005, 0.02, 3)
    signs = np.where(rng.random(6) < 0.5, -1.0, 1.0)
    return _vector("ax ay az gx gy gz", signs * [*a, *g])


EFFECTS: dict[str, Draw] = {
    "quadratic_damping": _absent(doubled=True),
    "linear_damping": _absent(doubled=False),
    "asymmetric_damping": _asymmetric,
    "coupled_damping": _couplings(
        "Y_r N_v Y_p K_v K_r N_p Z_q M_w X_q M_u X_w Z_u".split(), 0.25, 0.5, 0.6
    ),
    "lift": _lift,
    "added_mass_coupling": _couplings(
        "Y_rdot Z_qdot Y_pdot X_qdot X_wdot K_rdot".split(), 0.1, 0.25, 0.6
    ),
    "buoyancy": lambda rng, s: [
        Knob("delta", _sign(rng) * rng.uniform(0.05, 0.12) * s.vehicle.limits[2], 0.0)
    ],
    "cog_offset": _cog,
    "payload": _payload,
    "ocean_current": lambda rng, s: _vector(
        "north east down", rng.uniform(0.15, 0.4) * s.vehicle.speed[0] * _horizontal(rng, 0.1)
    ),
    "wave": _wave,
    "tether_drag": _tether,
    "constant_force": lambda rng, s: _vector("fx fy fz", _force(rng, s, 0.05, 0.15)),
    "thruster_gain": _gains(3, 0.15, 0.35, either=True, least=0.1),
    "thruster_asymmetry": _gains(3, 0.15, 0.4, least=0.1),
    "thruster_deadband": _deadband,
    "thruster_lag": _one("time_constant", 0.1, 0.3),
    "actuation_delay": _one("delay", 0.06, 0.2),
    "thruster_failure": _failure,
    "battery_sag": _one("end_loss", 0.15, 0.35, 0.95),
    "sensor_lever_arm": _lever,
    "sensor_misalignment": _tilt,
    "velocity_scale": _scale,
    "imu_bias": _bias,
}
"""Every effect by the name that explain gives it, with what draws its size."""

SENSOR_EFFECTS = frozenset(
    {"sensor_lever_arm", "sensor_misalignment", "velocity_scale", "imu_bias"}
)
"""Effects on what is measured, judged by kinematics; they leave the motion as it is."""

_WEIGHTS = ("buoyancy", "constant_force", "payload", "cog_offset")
_GAINS = ("thruster_gain", "thruster_asymmetry", "thruster_failure", "battery_sag")
NESTED: frozenset[frozenset[str]] = frozenset(
    frozenset(pair)
    for pair in [
        *combinations(_WEIGHTS, 2),  # steady forces and the moments of their arms
        *combinations(_GAINS, 2),  # common factors and factors of an axis
        ("thruster_lag", "actuation_delay"),
        ("ocean_current", "tether_drag"),  # the tether is dragged through the same water
        ("ocean_current", "constant_force"),
        ("quadratic_damping", "tether_drag"),
        ("quadratic_damping", "linear_damping"),  # over a narrow range of speeds
        ("velocity_scale", "sensor_misalignment"),  # cos of the angle
        ("linear_damping", "coupled_damping"),  # a weak diagonal would not keep the hull passive
    ]
)
"""Pairs nested in one another or nearly equal: either may be named, with the other beside it."""


# ------------------------------------------------------------------ effects outside the library


class Unknown(NamedTuple):
    """An effect that the library lacks: ``kind`` is how the kernel computes it.

    ``size`` is the wrench, as a share of the limit of its axis, at the working speed or at its
    crest; ``depends_on`` are the variables any of which is a right answer, the best first.
    """

    kind: int
    axes: str
    depends_on: tuple[str, ...]  # {0}: the velocity of its own axis
    size: float
    says: str


UNKNOWN: dict[str, Unknown] = {
    "cubic_damping": Unknown(fossen.POWER, "XYZN", ("{0}",), 3.0, "-c v^3"),
    "root_damping": Unknown(fossen.POWER, "XYZN", ("{0}",), 1.5, "-c sqrt|v| sign v"),
    "friction": Unknown(
        fossen.FRICTION, "XYZN", ("{0}",), 0.3, "a constant force against the motion"
    ),
    "foam": Unknown(
        fossen.FOAM, "Z", ("depth",), 0.15, "foam compresses: a weight growing with depth"
    ),
    "halocline": Unknown(fossen.HALOCLINE, "Z", ("depth",), 0.12, "denser water below a depth"),
    "mooring": Unknown(fossen.SPRING, "XY", ("position",), 0.3, "a spring to a line in the world"),
    "shaking": Unknown(fossen.SHAKE, "XYKMN", ("time",), 0.3, "a periodic force in body axes"),
    "drift": Unknown(fossen.DRIFT, "XYZN", ("time",), 0.2, "a force that wanders over minutes"),
    "reaction": Unknown(fossen.REACTION, "KN", ("u",), 0.6, "a moment by |u|u"),
    "heading_moment": Unknown(
        fossen.HEADING, "N", ("heading",), 0.25, "a yaw moment by sin of heading"
    ),
    "bump": Unknown(fossen.BUMP, "X", ("{0}",), 0.5, "drag that is largest at one speed"),
    "slope": Unknown(fossen.SLOPE, "XZ", ("pitch", "depth"), 0.4, "by depth and pitch at once"),
}


@dataclass(frozen=True)
class Truth:
    """The true motion at ``t`` (N,): position (N, 3), orientation (N, 4) w x y z, nu (N, 6),
    nu_dot (N, 6), the wrench (N, 6) that acts from the instant on, that of an effect outside the
    library (N, 6), and, at ``command_t`` (K,), the wrench (K, 6) demanded from there to the next.
    """

    t: Array
    position: Array
    orientation: Array
    nu: Array
    nu_dot: Array
    acting: Array
    foreign: Array
    command_t: Array
    command: Array


@dataclass(frozen=True)
class Case:
    """A bag and what is hidden in it.

    ``config`` is what the simulation believes; ``messages`` are (arrival [ns], role, message);
    ``effects`` the hidden {effect: {parameter: value}}. For an effect outside the library
    ``unknown`` is its name in :data:`UNKNOWN`, ``axis`` where it acts and ``depends_on`` any right
    answer, the best first. ``theta`` are the true coefficients, for positive velocities.
    """

    seed: int
    config: Config
    messages: list[tuple[int, str, Message]]
    effects: dict[str, dict[str, float]]
    theta: dict[str, float]
    tier: str
    family: str
    excitation: str
    truth: Truth = field(repr=False)
    unknown: str | None = None
    axis: str = ""
    depends_on: tuple[str, ...] = ()


# ------------------------------------------------------------------ the draw


def draw(
    seed: int,
    effects: Sequence[str] = (),
    strength: float | Sequence[float] = 1.0,
    *,
    conditions: Conditions = Conditions(),
    unknown: str | None = None,
) -> Case:
    """The case of a seed with these effects, each at ``strength`` times its drawn size.

    Vehicle, manoeuvre, noise and each effect have random numbers of their own: nothing drawn for
    one changes with another, nor with the strength. ``unknown`` is a name of :data:`UNKNOWN`; its
    strength is the last, after those of ``effects``.

    Raises
    ------
    KeyError
        For an effect or unknown that does not exist.
    """
    hidden = [*effects, *([unknown] if unknown else [])]
    strengths = np.broadcast_to(np.asarray(strength, dtype=float), len(hidden))
    excitation, family = _kind(seed, conditions)
    vehicle = FAMILIES[family](_stream(seed, "vehicle"))
    rigid = fossen.rigid_mass(vehicle.mass, vehicle.cog, vehicle.inertia)
    setting = Setting(
        vehicle,
        USED.get(excitation, AXES),
        conditions.duration,
        np.diag(rigid + fossen.added_mass(vehicle.theta)),
    )
    values: dict[str, dict[str, float]] = {}
    for name, size in zip(effects, strengths):
        knobs = EFFECTS[name](_stream(seed, name), setting)
        values[name] = {k.name: _turned(k, float(size)) for k in knobs}

    theta = dict(vehicle.theta)
    lacking: set[str] = set()
    for name in values:
        if name in _COEFFICIENTS:
            theta |= values[name]
            lacking |= set(values[name])
    config = _configuration(seed, vehicle, lacking, conditions.off)
    foreign = _foreign(seed, unknown, float(strengths[-1]) if unknown else 0.0, setting)
    truth = _dive(seed, vehicle, theta, values, foreign, conditions, excitation)
    tier = next((n for n, c in TIERS.items() if c == conditions), "other")
    return Case(
        seed=seed,
        config=config,
        messages=_messages(seed, vehicle, truth, values, conditions),
        effects=values,
        theta=theta,
        tier=tier,
        family=family,
        excitation=excitation,
        truth=truth,
        unknown=unknown,
        axis=AXES[foreign.axis] if unknown else "",
        depends_on=foreign.depends_on,
    )


_COEFFICIENTS = (
    "quadratic_damping",
    "linear_damping",
    "coupled_damping",
    "lift",
    "added_mass_coupling",
)


def _stream(seed: int, name: str) -> np.random.Generator:
    """Random numbers that belong to one purpose only."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(crc32(name.encode()),)))


def _kind(seed: int, conditions: Conditions) -> tuple[str, str]:
    """Excitation and family where the conditions leave them open."""
    rng = _stream(seed, "kind")
    excitation = rng.choice(["steps", "multisine", "mixed"])
    family = rng.choice(["auv", "work"])
    return (
        str(excitation) if conditions.excitation == "any" else conditions.excitation,
        str(family) if conditions.family == "other" else conditions.family,
    )


def _turned(knob: Knob, strength: float) -> float:
    if math.isnan(knob.null):
        return float(knob.value)
    return float(np.clip(knob.null + strength * (knob.value - knob.null), knob.lower, knob.upper))


def _configuration(seed: int, vehicle: Vehicle, lacking: set[str], off: float) -> Config:
    """What the simulation believes: coefficients off, those of the effects absent."""
    rng = _stream(seed, "configuration")
    believed = {n: v * (1.0 + off * rng.uniform(-1.0, 1.0)) for n, v in vehicle.theta.items()}
    i = vehicle.inertia
    parameters: dict[str, Any] = {
        "vehicle": {
            "name": vehicle.family,
            "frame": "frd",
            "mass": vehicle.mass,
            "buoyancy": vehicle.buoyancy,
            "cog": vehicle.cog.tolist(),
            "cob": vehicle.cob.tolist(),
            "inertia": [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]],
            # What is estimated by default is known here: a case has its effects and no others.
            "mass_std": 0.0,
            "inertia_std": 0.0,
            "buoyancy_std": 0.0,
            "cog_std": 0.0,
        },
        "wrench": {"scale_std": 0.0, "lag_std": 0.0},
        "odometry": {"latency_std": 0.0, "scale_std": 0.0},
        "current_std": 0.0,
        "coefficients": {n: v for n, v in believed.items() if n not in lacking},
        "imu": {"position": vehicle.imu.tolist()},
    }
    return from_parameters(parameters)


# ------------------------------------------------------------------ manoeuvres


def _telegraph(
    rng: np.random.Generator, t: Array, low: float = 0.8, high: float = 4.0, busy: float = 0.8
) -> Array:
    """(N, 6) of -1 to 1: levels held for a random time, each axis on its own."""
    out = np.zeros((len(t), 6))
    for axis in range(6):
        edges = np.cumsum(rng.uniform(low, high, int(t[-1] / low) + 2))
        levels = _random_signs(rng, len(edges) + 1) * rng.uniform(0.4, 1.0, len(edges) + 1)
        levels *= rng.random(len(edges) + 1) < busy
        out[:, axis] = levels[np.searchsorted(edges, t, side="right")]
    return out


def _random_signs(rng: np.random.Generator, n: int) -> Array:
    return np.where(rng.random(n) < 0.5, -1.0, 1.0)


def _sines(rng: np.random.Generator, t: Array) -> Array:
    """(N, 6): five to eight sines an axis, 0.02 to 0.5 Hz, no two axes alike."""
    out = np.zeros((len(t), 6))
    for axis in range(6):
        n = int(rng.integers(5, 9))
        frequency = np.exp(rng.uniform(math.log(0.02), math.log(0.5), n))
        phase = rng.uniform(0.0, 2.0 * math.pi, n)
        waves = np.sin(2.0 * math.pi * frequency * t[:, None] + phase).sum(axis=1)
        out[:, axis] = waves / math.sqrt(n)
    return out


def _chirp(rng: np.random.Generator, t: Array) -> Array:
    """(N, 6): sweeps 0.05 to 0.6 Hz, again and again, each axis at its own pace."""
    out = np.zeros((len(t), 6))
    for axis in range(6):
        period = rng.uniform(15.0, 30.0)
        s = (t + rng.uniform(0.0, period)) % period
        rate = math.log(0.6 / 0.05) / period
        out[:, axis] = np.sin(2.0 * math.pi * 0.05 * np.expm1(rate * s) / rate)
    return out


def _single(rng: np.random.Generator, t: Array) -> Array:
    """(N, 6): telegraph on one axis at a time, 4 s each in random order."""
    out = _telegraph(rng, t, 0.8, 3.0, 0.9)
    turn = np.concatenate([rng.permutation(6) for _ in range(int(t[-1] / 24.0) + 1)])
    out[turn[(t / 4.0).astype(int)][:, None] != np.arange(6)] = 0.0
    return out


def _mixed(rng: np.random.Generator, t: Array) -> Array:
    """Blocks of 8 to 20 s of all the kinds."""
    kinds = [f(rng, t) for f in (_telegraph, _sines, _chirp, _single)]
    edges = np.cumsum(rng.uniform(8.0, 20.0, int(t[-1] / 8.0) + 2))
    weights = [0.35, 0.3, 0.2, 0.15]
    chosen = rng.choice(4, len(edges) + 1, p=weights)[np.searchsorted(edges, t, side="right")]
    return np.stack(kinds)[chosen, np.arange(len(t))]


def _pilot(rng: np.random.Generator, t: Array) -> Array:
    """Surge and yaw by stick, a touch of heave, long pauses; a stick moves at a finite rate."""
    out = np.zeros((len(t), 6))
    for axis, share, busy in ((0, 0.9, 0.55), (5, 0.7, 0.45), (2, 0.4, 0.12)):
        edges = np.cumsum(rng.uniform(1.0, 6.0, int(t[-1]) + 2))
        levels = _random_signs(rng, len(edges) + 1) * rng.uniform(0.3, 1.0, len(edges) + 1)
        levels *= rng.random(len(edges) + 1) < busy
        if axis == 0:
            levels = np.where(rng.random(len(levels)) < 0.75, np.abs(levels), levels)
        out[:, axis] = share * levels[np.searchsorted(edges, t, side="right")]
    idle = np.cumsum(rng.uniform(8.0, 25.0, int(t[-1] / 8.0) + 2))
    out[np.searchsorted(idle, t, side="right") % 3 == 2] = 0.0
    stick = max(1, round(0.15 / (t[1] - t[0])))
    kernel = np.ones(stick) / stick
    return np.stack([np.convolve(a, kernel)[: len(t)] for a in out.T], axis=1)


def _tank(rng: np.random.Generator, t: Array) -> Array:
    """Short steps at part of the thrust: the walls are near."""
    return _telegraph(rng, t, 0.6, 2.5) * [0.5, 0.5, 0.4, 0.7, 0.7, 0.8]


EXCITATIONS: dict[str, Callable[[np.random.Generator, Array], Array]] = {
    "steps": _telegraph,
    "multisine": _sines,
    "mixed": _mixed,
    "pilot": _pilot,
    "tank": _tank,
    "no-heave": _mixed,
}
"""name -> function of (random generator, instants (N,)) giving shares (N, 6) of the limits."""


def _control(
    seed: int, vehicle: Vehicle, excitation: str, commands: int, noise: float
) -> fossen.Control:
    high = np.array([1e3, 1e3, 3.0])
    if excitation == "tank":
        high = np.array([0.7, 0.4, 0.25])
    driven = np.ones(6)
    if excitation == "no-heave":
        driven[2] = 0.0
    std = np.repeat([POSITION_STD, ATTITUDE_STD, GYRO_STD], 3)
    readings = noise * std * _stream(seed, "control").standard_normal((commands, 9))
    level = 1.0 if excitation in ("pilot", "tank") else 0.4
    return fossen.Control(driven, vehicle.limits, level, -high, high, readings)


# ------------------------------------------------------------------ what is hidden, for the kernels


class _Foreign(NamedTuple):
    """An unknown effect, drawn: parameters (6,), the first of which is its size."""

    kind: int
    axis: int
    parameters: Array
    depends_on: tuple[str, ...]


def _world(values: Mapping[str, Mapping[str, float]]) -> fossen.World:
    def get(effect: str, names: str) -> Array:
        return np.array([values.get(effect, {}).get(n, 0.0) for n in names.split()])

    return fossen.World(
        float(get("buoyancy", "delta")[0]),
        GRAVITY * float(get("payload", "mass_wet")[0]),
        get("payload", "x y z"),
        float(get("payload", "onset")[0]),
        get("ocean_current", "north east down"),
        get("wave", "fx fy fz"),
        float(get("wave", "frequency")[0]),
        float(get("wave", "phase")[0]),
        float(get("tether_drag", "k")[0]),
        get("tether_drag", "x y z"),
        get("constant_force", "fx fy fz"),
    )


def _drive(values: Mapping[str, Mapping[str, float]], duration: float) -> fossen.Drive:
    def get(effect: str, prefix: str, null: float) -> Array:
        return np.array([values.get(effect, {}).get(prefix + A, null) for A in AXES])

    def one(effect: str, name: str, null: float = 0.0) -> float:
        return values.get(effect, {}).get(name, null)

    return fossen.Drive(
        one("actuation_delay", "delay"),
        get("thruster_deadband", "width_", 0.0),
        get("thruster_asymmetry", "gain_", 1.0),
        get("thruster_gain", "gain_", 1.0),
        get("thruster_failure", "gain_", 1.0),
        one("thruster_failure", "onset", math.inf),
        one("battery_sag", "end_loss") / duration,
        one("thruster_lag", "time_constant"),
    )


def _foreign(seed: int, name: str | None, strength: float, s: Setting) -> _Foreign:
    """The unknown effect of a seed; random numbers do not depend on its strength."""
    p = np.zeros(6)
    if name is None:
        return _Foreign(0, 0, p, ())
    kind, rng = UNKNOWN[name], _stream(seed, name)
    possible = [A for A in kind.axes if A in s.used] or list(kind.axes)
    axis = AXES.index(possible[int(rng.integers(len(possible)))])
    limit, speed = s.vehicle.limits, s.vehicle.speed
    p[0] = strength * kind.size * rng.uniform(0.8, 1.25) * limit[axis]
    if kind.kind == fossen.POWER:
        p[1] = 3.0 if name == "cubic_damping" else 0.5
        p[0] /= speed[axis] ** p[1]
    elif kind.kind == fossen.FRICTION:
        p[1] = 0.02 * speed[axis]
    elif kind.kind == fossen.FOAM:
        p[1], p[0] = rng.uniform(-1.0, 1.0), p[0] / 2.0  # per m from a neutral depth
    elif kind.kind == fossen.HALOCLINE:
        p[1], p[2] = rng.uniform(-1.5, 0.5), rng.uniform(0.3, 0.8)  # its depth and thickness
    elif kind.kind == fossen.SPRING:
        p[1], p[0] = rng.uniform(-2.0, 2.0), p[0] / 5.0
    elif kind.kind == fossen.SHAKE:
        p[1], p[2] = rng.uniform(0.3, 1.5), rng.uniform(-math.pi, math.pi)
    elif kind.kind == fossen.DRIFT:
        p[1], p[2], p[3] = rng.uniform(0.005, 0.02), *rng.uniform(-math.pi, math.pi, 2)
    elif kind.kind == fossen.REACTION:
        p[0] *= _sign(rng) / speed[0] ** 2
    elif kind.kind == fossen.HEADING:
        p[1] = rng.uniform(-math.pi, math.pi)
    elif kind.kind == fossen.BUMP:
        p[1], p[2] = rng.uniform(0.4, 0.6) * speed[axis], 0.15 * speed[axis]
    elif kind.kind == fossen.SLOPE:
        p[1], p[2] = rng.uniform(-0.5, 0.5), rng.uniform(0.4, 0.8)
    own = VELOCITIES[axis]
    return _Foreign(kind.kind, axis, p, tuple(d.format(own) for d in kind.depends_on))


# ------------------------------------------------------------------ the dive and its messages


def _instants(known: Array, t: Array) -> NDArray[np.int64]:
    """Indices of the times t among those ``known``, which end a step before the bag does."""
    out: NDArray[np.int64] = np.minimum(np.searchsorted(known, t - 1e-9), len(known) - 1)
    return out


def _clock(seed: int, topic: str, rate: float, duration: float) -> Array:
    """Instants of a topic, on whole microseconds, at a phase of its own."""
    if rate <= 0.0:
        return np.zeros(0)
    phase = _stream(seed, f"phase of {topic}").random() / rate
    return np.round(np.arange(phase, duration, 1.0 / rate), 6)


def _dive(
    seed: int,
    vehicle: Vehicle,
    theta: Mapping[str, float],
    values: Mapping[str, Mapping[str, float]],
    foreign: _Foreign,
    conditions: Conditions,
    excitation: str,
) -> Truth:
    """The true motion, at the instants of all topics and whenever something changes."""
    duration = conditions.duration
    command_t = np.round(np.arange(0.0, duration, 1.0 / conditions.wrench_rate), 6)
    shares = EXCITATIONS[excitation](_stream(seed, "manoeuvre"), command_t)
    if excitation != "tank":
        shares[:, 3:5] *= 0.7
    if vehicle.family == "auv":  # under way most of the time
        shares[:, 0] = 0.6 + 0.4 * shares[:, 0]
    shares[command_t < 0.5] = 0.0  # recording begins before the driving
    drive, world = _drive(values, duration), _world(values)
    step = 0.01 if drive.lag <= 0.0 else min(0.01, max(drive.lag / 4.0, 0.003))
    t = np.concatenate(
        [
            command_t,
            command_t + drive.delay,
            _clock(seed, "odom", conditions.odometry_rate, duration),
            _clock(seed, "imu", conditions.imu_rate, duration),
            [world.payload_from, drive.failure],
        ]
    )
    t = np.unique(np.round(t[t < duration], 9))
    gaps = np.diff(t)
    pieces = np.ceil(gaps / step - 1e-6).astype(int)
    t = np.append(np.repeat(t[:-1], pieces), t[-1])
    number = np.arange(len(t) - 1) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    t[:-1] += number * np.repeat(gaps / pieces, pieces)
    asked = np.full(len(t), -1)
    asked[np.searchsorted(t, command_t)] = np.arange(len(command_t))
    rng = _stream(seed, "start")
    heading, depth = rng.uniform(-math.pi, math.pi), rng.uniform(-1.0, 1.0)
    start = np.zeros(13)
    start[2] = 0.2 * depth if excitation == "tank" else depth
    start[3], start[6] = math.cos(0.5 * heading), math.sin(0.5 * heading)
    demand, out = np.zeros((len(command_t), 6)), np.empty((len(t), 25))
    offset = values.get("cog_offset", {})
    plant = fossen.plant(
        vehicle.mass,
        vehicle.buoyancy,
        vehicle.cog + [offset.get(n, 0.0) for n in ("dx", "dy", "dz")],
        vehicle.cob,
        vehicle.inertia,
        theta,
        values.get("asymmetric_damping", {}),
    )
    control = _control(seed, vehicle, excitation, len(command_t), conditions.noise)
    fossen.run(
        plant, world, foreign.kind, foreign.axis, foreign.parameters, drive, control, t, asked,
        shares, command_t, start, demand, out,
    )  # fmt: skip
    other = np.zeros((len(t), 6))
    fossen.unknown_forces(foreign.kind, foreign.axis, foreign.parameters, t, out, other)
    return Truth(
        t, out[:, :3], out[:, 3:7], out[:, 7:13], out[:, 13:19], out[:, 19:], other, command_t,
        demand,
    )  # fmt: skip


def _roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> Array:
    """(3, 3) Rz(yaw) Ry(pitch) Rx(roll): axes of the sensor -> axes of the body."""
    (c1, c2, c3), (s1, s2, s3) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    x = np.array([[1, 0, 0], [0, c1, -s1], [0, s1, c1]])
    y = np.array([[c2, 0, s2], [0, 1, 0], [-s2, 0, c2]])
    z = np.array([[c3, -s3, 0], [s3, c3, 0], [0, 0, 1]])
    return z @ y @ x


def _messages(
    seed: int,
    vehicle: Vehicle,
    truth: Truth,
    values: Mapping[str, Mapping[str, float]],
    conditions: Conditions,
) -> list[tuple[int, str, Message]]:
    """What the sensors publish, in order of time; each topic has random numbers of its own."""
    noise = conditions.noise
    messages: list[tuple[int, str, Message]] = []

    def get(effect: str, names: str, null: float = 0.0) -> list[float]:
        return [values.get(effect, {}).get(n, null) for n in names.split()]

    def stamps(t: Array) -> list[int]:
        return [START + round(x) for x in (1e9 * t).tolist()]

    t = _clock(seed, "odom", conditions.odometry_rate, conditions.duration)
    at, rng = _instants(truth.t, t), _stream(seed, "odom")
    v, w, q = truth.nu[at, :3], truth.nu[at, 3:], truth.orientation[at]
    mounting = _roll_pitch_yaw(*get("sensor_misalignment", "roll pitch yaw"))
    v = v + np.cross(w, get("sensor_lever_arm", "x y z"))
    v = get("velocity_scale", "scale", 1.0)[0] * (v @ mounting)  # rows: R' v
    v = v + noise * LINEAR_STD * rng.standard_normal(v.shape)
    w = w + noise * ANGULAR_STD * rng.standard_normal(w.shape)
    x = truth.position[at] + noise * POSITION_STD * rng.standard_normal(v.shape)
    half = 0.5 * noise * ATTITUDE_STD * rng.standard_normal(v.shape)  # a small turn of the body
    q = np.hstack(
        [
            q[:, :1] - np.sum(q[:, 1:] * half, axis=1, keepdims=True),
            q[:, 1:] + q[:, :1] * half + np.cross(q[:, 1:], half),
        ]
    )
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    variance = np.repeat([(noise * LINEAR_STD) ** 2, (noise * ANGULAR_STD) ** 2], 3)
    messages += [
        (n, "odom", Odometry(n, "odom_ned", "base_link_frd", a, b, c, d, variance))
        for n, a, b, c, d in zip(stamps(t), x, q, v, w)
    ]

    t = _clock(seed, "imu", conditions.imu_rate, conditions.duration)
    at, rng = _instants(truth.t, t), _stream(seed, "imu")
    v, w = truth.nu[at, :3], truth.nu[at, 3:]
    v_dot, w_dot = truth.nu_dot[at, :3], truth.nu_dot[at, 3:]
    down = fossen.rotations(truth.orientation[at])[:, 2]
    force = v_dot + np.cross(w, v) - GRAVITY * down
    force += np.cross(w_dot, vehicle.imu) + np.cross(w, np.cross(w, vehicle.imu))
    force += get("imu_bias", "ax ay az")
    force += noise * ACCELEROMETER_STD * rng.standard_normal(force.shape)
    gyro = w + get("imu_bias", "gx gy gz") + noise * GYRO_STD * rng.standard_normal(w.shape)
    unknown = np.array([1.0, 0.0, 0.0, 0.0])
    gyro_variance = np.full(3, (noise * GYRO_STD) ** 2)
    variance = np.full(3, (noise * ACCELEROMETER_STD) ** 2)
    messages += [
        (n, "imu", Imu(n, "imu_link_frd", unknown, a, b, gyro_variance, variance))
        for n, a, b in zip(stamps(t), gyro, force)
    ]

    rng = _stream(seed, "wrench")
    wrench = truth.command * (1.0 + noise * WRENCH_STD * rng.standard_normal(truth.command.shape))
    std = np.repeat(conditions.reading, 3)
    wrench = wrench + std * _stream(seed, "reading").standard_normal(wrench.shape)
    messages += [
        (n, "wrench", Wrench(n, "base_link_frd", a, b))
        for n, a, b in zip(stamps(truth.command_t), wrench[:, :3], wrench[:, 3:])
    ]
    messages.sort(key=lambda m: m[0])  # stable: at one stamp odometry, IMU, wrench
    return messages
