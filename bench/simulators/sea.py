"""A vehicle at sea: motion, thrusters and sensors with what no configuration file knows.

Written from Fossen (Handbook of Marine Craft Hydrodynamics and Motion Control, 2nd ed. 2021)
without a look at the estimators, so that its data share none of their assumptions and no code.
A BlueROV2 Heavy with random coefficients is driven by its eight thrusters; each field of
:class:`Sea` is one thing that differs from what its file says. SI; body axes forward, starboard,
down; world north, east, down; t = 0 at the first command. Messages are in ROS axes.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from rov_ident.core.messages import Imu, Message, Odometry, Wrench

Array = NDArray[np.float64]
Messages = list[tuple[int, str, Message]]

GRAVITY = 9.81
EPOCH = 1_700_000_000 * 10**9  # ns, stamp of t = 0
AXES, VELOCITIES = "XYZKMN", "uvwpqr"

STEP = 0.005  # s, of the integration
COMMAND_RATE, IMU_RATE = 50.0, 100.0  # Hz
LATENCY = 5_000_000  # ns from the stamp to the arrival of a message

# Noise of one measurement: that of the other studies.
LINEAR_STD, ANGULAR_STD, POSITION_STD, ATTITUDE_STD = 0.008, 0.004, 0.01, 0.002
GYRO_STD, ACCELEROMETER_STD = 0.003, 0.03
WRENCH_STD = 0.01  # relative

NOMINAL = {
    "X_udot": -6.36, "Y_vdot": -7.12, "Z_wdot": -18.68,
    "K_pdot": -0.189, "M_qdot": -0.135, "N_rdot": -0.222,
    "X_u": -13.7, "Y_v": -8.0, "Z_w": -33.0, "K_p": -0.1, "M_q": -0.8, "N_r": -0.1,
    "X_uu": -141.0, "Y_vv": -217.0, "Z_ww": -190.0, "K_pp": -1.19, "M_qq": -0.47, "N_rr": -1.5,
}  # fmt: skip
"""von Benzon et al. (2022); Y_v, K_p and N_r, which they give as zero, as in accuracy.py."""

# Eight T200 thrusters: four at 45 degrees in the horizontal plane, four vertical.
_PLACES = np.array([
    [0.156, 0.111, 0.0], [0.156, -0.111, 0.0], [-0.156, 0.111, 0.0], [-0.156, -0.111, 0.0],
    [0.12, 0.218, 0.0], [0.12, -0.218, 0.0], [-0.12, 0.218, 0.0], [-0.12, -0.218, 0.0],
])  # fmt: skip
_H = math.sqrt(0.5)
_DIRECTIONS = np.array([
    [_H, -_H, 0.0], [_H, _H, 0.0], [_H, _H, 0.0], [_H, -_H, 0.0],
    [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0],
])  # fmt: skip
ALLOCATION = np.vstack([_DIRECTIONS.T, np.cross(_PLACES, _DIRECTIONS).T])
"""(6, 8) wrench per newton of each thruster."""
_INVERSE = np.linalg.pinv(ALLOCATION)

MAX_THRUST = 40.0  # N of one T200 at 16 V, the smaller of its two directions
MAX_AMPERES = 17.0  # of one T200 there
VOLTS = 16.0  # at which the commanded thrust is right

LEVELS = np.array([55.0, 60.0, 65.0, 2.5, 2.5, 3.0])
"""Largest wrench of the excitation: some 0.55 m/s and 1.1 rad/s."""


# ------------------------------------------------------------------ vehicle, and what is unknown


@dataclass(frozen=True)
class Vehicle:
    """What a configuration file says of a vehicle; ``inertia`` (3,) about the CG, principal."""

    mass: float
    inertia: Array
    cog: Array
    cob: Array
    buoyancy: float
    theta: dict[str, float]


def draw_vehicle(rng: np.random.Generator) -> Vehicle:
    """A BlueROV2 Heavy with every coefficient within 25 % of the published one."""
    mass = 13.5 * rng.uniform(0.9, 1.1)
    return Vehicle(
        mass=mass,
        inertia=np.array([0.26, 0.23, 0.37]) * rng.uniform(0.8, 1.2, 3),
        cog=np.zeros(3),
        cob=np.array([0.0, 0.0, rng.uniform(-0.03, -0.01)]),
        buoyancy=GRAVITY * mass + rng.uniform(0.5, 3.0),
        theta={name: value * rng.uniform(0.75, 1.25) for name, value in NOMINAL.items()},
    )


@dataclass(frozen=True)
class Sea:
    """What the file does not say; each field by default as the file implies.

    Three groups: on the vehicle, in its sensors, and (``frozen_from`` on) faults that lie. Vectors
    are tuples, so that JSON holds them.
    """

    thrust_scale: float = 1.0
    lag: float = 0.0  # s, of the thrusters, first order
    current: tuple[float, ...] = (0.0, 0.0)  # m/s north, east
    current_swing: tuple[float, ...] = (0.0, 0.0)  # amplitude of its slow change, m/s
    current_period: float = 600.0  # s
    lift: float = 0.0  # N more buoyancy than the file says
    cog: tuple[float, ...] = (0.0, 0.0, 0.0)  # m from where the file puts it
    resistance: float = 0.0  # ohm of battery and cables
    discharge: float = 0.0  # V that the battery falls during the dive
    advance: float = 0.0  # s/m, share of the thrust lost per m/s along it
    mass_factor: float = 1.0  # of the file over that of the vehicle
    inertia_factor: tuple[float, ...] = (1.0, 1.0, 1.0)
    cob_off: float = 0.0  # m, height of the centre of buoyancy in the file less the vehicle's

    odometry_rate: float = 20.0  # Hz
    velocity_delay: float = 0.0  # s, age of the linear velocity at its stamp
    velocity_scale: float = 1.0  # of the reading over the linear velocity
    velocity_turned: tuple[float, ...] = (0.0,) * 3  # rad, of its sensor
    smoothing: float = 0.0  # s, time constant of the filter whose output the odometry is
    of_reading: tuple[float, ...] = (1.0,) * 6  # of each axis's wrench over what is read
    wrench_floor: tuple[float, ...] = (0.0,) * 6  # N, N m, std of the reading at any wrench
    floor_lasts: int = 1  # readings for which that noise is the same
    wander: float = 0.0  # rad, std of an error of the odometry's attitude that lasts
    gyro_bias: tuple[float, ...] = (0.0, 0.0, 0.0)  # rad/s
    accelerometer_bias: tuple[float, ...] = (0.0, 0.0, 0.0)  # m/s2
    gyro_is_shared: bool = False  # odometry copies its angular velocity from the IMU
    imu_clock: float = 0.0  # s, of the IMU's stamps ahead of the others
    heading: float = 0.0  # rad, of the pose ahead of the world's
    heading_drift: float = 0.0  # rad/s, by which that grows
    dead_reckoned: bool = False  # the position is the integral of the velocity along that heading
    tilt: tuple[float, ...] = (0.0, 0.0)  # rad, roll and pitch of the pose against the body
    on_the_way: tuple[float, ...] = (0.0, 0.0, 0.0)  # s to the recorder: odometry, IMU, wrench

    frozen_from: float = math.inf  # s; then the velocity sensor reads zero, with little noise
    imu_turned: bool = False  # half a turn about the body's z axis
    reversed_axis: int = -1  # of the wrench reading
    odometry_clock: float = 0.0  # s, of the odometry's stamps ahead of the others


def told(vehicle: Vehicle, sea: Sea, rng: np.random.Generator, off: float = 0.25) -> dict[str, Any]:
    """The parameter file: coefficients off by up to ``off`` each, and nothing of the sea.

    A wrong mass comes with the buoyancy that trims it: what floats is seen, and not weighed.
    """
    mass = float(vehicle.mass * sea.mass_factor)
    inertia = (vehicle.inertia * sea.inertia_factor).tolist()
    return {
        "vehicle": {
            "name": "at_sea",
            "frame": "frd",
            "mass": mass,
            "buoyancy": vehicle.buoyancy + GRAVITY * (mass - vehicle.mass),
            "cog": vehicle.cog.tolist(),
            "cob": (vehicle.cob + [0.0, 0.0, sea.cob_off]).tolist(),
            "inertia": [*inertia, 0.0, 0.0, 0.0],
        },
        "coefficients": {
            name: value * (1.0 + off * rng.uniform(-1.0, 1.0))
            for name, value in vehicle.theta.items()
        },
    }


# ------------------------------------------------------------------ quaternions w x y z


def product(p: Array, q: Array) -> Array:
    """Hamilton product of quaternions (..., 4)."""
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    scalar = pw * qw - np.sum(pv * qv, axis=-1, keepdims=True)
    return np.concatenate([scalar, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)


def rotations(q: Array) -> Array:
    """(N, 3, 3) body to world of unit quaternions (N, 4): I + 2 w S(e) + 2 S(e)^2 (Fossen 2.74)."""
    s = np.zeros((len(q), 3, 3))
    s[:, 2, 1], s[:, 0, 2], s[:, 1, 0] = q[:, 1], q[:, 2], q[:, 3]
    s -= s.transpose(0, 2, 1)
    return np.eye(3) + 2.0 * q[:, 0, None, None] * s + 2.0 * s @ s


def _tilted(q: Array, angles: Array) -> Array:
    """Attitudes (N, 4) turned by small rotation vectors (N, 3) in the body."""
    small = np.hstack([np.ones((len(q), 1)), 0.5 * angles])
    turned = product(q, small)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


# ------------------------------------------------------------------ equations of motion


def skew(a: Array) -> Array:
    """S(a), so that S(a) b = a x b."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


class Body(NamedTuple):
    """The vehicle and the sea as the kernels take them; forces are +coefficient * velocities."""

    rigid: Array  # M_RB (6, 6)
    added: Array  # M_A (6, 6)
    inverse: Array  # of their sum
    linear: Array  # (6,) damping on the diagonal
    square: Array  # (6,) likewise, times |v| v
    weight: float
    buoyancy: float
    cog: Array
    cob: Array
    current: Array  # (2, 2) mean and amplitude of the current's north and east, m/s
    pace: float  # rad/s of its slow change
    advance: float  # s/m


_fast = numba.njit(cache=True, error_model="numpy")


@_fast
def _cross(a, b):
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


@_fast
def _times(matrix, a):
    """A matrix times a vector, without the BLAS that numba would load."""
    out = np.zeros(matrix.shape[0])
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            out[i] += matrix[i, j] * a[j]
    return out


@_fast
def _put(a, out):
    for i in range(len(a)):
        out[i] = a[i]


@_fast
def _further(a, share, b):
    """a + share * b."""
    out = a.copy()
    for i in range(len(a)):
        out[i] += share * b[i]
    return out


@_fast
def _rotation(q):
    """Body to world."""
    a, b, c, d = q[0], q[1], q[2], q[3]
    return np.array([
        [1.0 - 2.0 * (c * c + d * d), 2.0 * (b * c - a * d), 2.0 * (b * d + a * c)],
        [2.0 * (b * c + a * d), 1.0 - 2.0 * (b * b + d * d), 2.0 * (c * d - a * b)],
        [2.0 * (b * d - a * c), 2.0 * (c * d + a * b), 1.0 - 2.0 * (b * b + c * c)],
    ])  # fmt: skip


@_fast
def _water(body, t):
    """Velocity and acceleration of the water in the world."""
    mean, swing = body.current[0], body.current[1]
    c, s = math.cos(body.pace * t), math.sin(body.pace * t)
    flow = np.array([mean[0] + swing[0] * s, mean[1] + swing[1] * c, 0.0])
    return flow, np.array([body.pace * swing[0] * c, -body.pace * swing[1] * s, 0.0])


@_fast
def _through(body, t, state):
    """Velocity (6,) through the water."""
    through, water = state[7:].copy(), _times(_rotation(state[3:7]).T, _water(body, t)[0])
    for i in range(3):
        through[i] -= water[i]
    return through


@_fast
def _wrench(body, thrust, through):
    """(6,) of the thrusters (8,), each of which loses thrust with the speed along it."""
    acting, along = thrust.copy(), _times(ALLOCATION.T, through)
    for i in range(len(thrust)):
        acting[i] -= body.advance * abs(thrust[i]) * along[i]
    return _times(ALLOCATION, acting)


@_fast
def _rates(body, t, state, thrust):
    """d/dt (13,) of position, attitude and nu."""
    a, b, c, d = state[3], state[4], state[5], state[6]
    v, omega = state[7:10], state[10:]
    R = _rotation(state[3:7])
    down = R[2]
    flow, gust = _water(body, t)
    through = _through(body, t, state)
    # Of the water in body axes: its derivative there is R' gust - omega x water.
    turn, change = _cross(omega, _times(R.T, flow)), _times(R.T, gust)

    # C(nu) nu = [omega x p; omega x h + v x p] with momenta p and h (Kirchhoff; Fossen 3.62)
    rigid, fluid = _times(body.rigid, state[7:]), _times(body.added, through)
    both = rigid.copy()
    for i in range(6):
        both[i] += fluid[i]
    one, two = _cross(omega, both[:3]), _cross(omega, both[3:])
    three, four = _cross(v, rigid[:3]), _cross(through[:3], fluid[:3])
    heavy, light = _cross(body.cog, down), _cross(body.cob, down)
    force = _wrench(body, thrust, through)
    for i in range(6):
        force[i] += (body.linear[i] + body.square[i] * abs(through[i])) * through[i]
        for j in range(3):
            force[i] += body.added[i, j] * (change[j] - turn[j])
    for i in range(3):
        force[i] += (body.weight - body.buoyancy) * down[i] - one[i]
        force[3 + i] += body.weight * heavy[i] - body.buoyancy * light[i]
        force[3 + i] -= two[i] + three[i] + four[i]

    out = np.empty(13)
    _put(_times(R, v), out[:3])
    x, y, z = omega[0], omega[1], omega[2]
    out[3] = -0.5 * (b * x + c * y + d * z)
    out[4] = 0.5 * (a * x + c * z - d * y)
    out[5] = 0.5 * (a * y + d * x - b * z)
    out[6] = 0.5 * (a * z + b * y - c * x)
    _put(_times(body.inverse, force), out[7:])
    return out


@_fast
def _step(body, t, state, k1, middle, last):
    """(13,) a STEP later by the classical Runge-Kutta method; ``k1`` are the rates now, the
    others the thrusts (8,) in the middle and at the end."""
    half = 0.5 * STEP
    k2 = _rates(body, t + half, _further(state, half, k1), middle)
    k3 = _rates(body, t + half, _further(state, half, k2), middle)
    k4 = _rates(body, t + STEP, _further(state, STEP, k3), last)
    after, square = state.copy(), 0.0
    for i in range(13):
        after[i] += STEP / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
    for i in range(3, 7):
        square += after[i] * after[i]
    for i in range(3, 7):
        after[i] /= math.sqrt(square)
    return after


@_fast
def _follow(body, steps, held, keep, reached, state, begin, end, acting):
    """The steps of one command into the rows of :class:`Truth`; the thrust (8,) after them.

    Thrust goes from ``reached`` to ``held``; half a step leaves the share ``keep`` of the way.
    """
    for k in range(steps[0], steps[1]):
        t, x = k * STEP, state[k]
        middle = _further(held, keep, _further(reached, -1.0, held))
        last = _further(held, keep, _further(middle, -1.0, held))
        # The command may have jumped: then the last end is no begin.
        k1 = _rates(body, t, x, reached) if k == steps[0] else end[k - 1]
        _put(k1, begin[k])
        _put(_wrench(body, reached, _through(body, t, x)), acting[k])
        _put(_step(body, t, x, k1, middle, last), state[k + 1])
        reached = last
        _put(_rates(body, t + STEP, state[k + 1], reached), end[k])
    return reached


class Plant:
    """M_RB nu_dot + C_RB(nu) nu + M_A nu_r_dot + C_A(nu_r) nu_r + D(nu_r) nu_r + g = tau."""

    def __init__(self, vehicle: Vehicle, sea: Sea) -> None:
        cog = vehicle.cog + sea.cog
        S = skew(cog)
        self.rigid = np.zeros((6, 6))  # Fossen 3.57
        self.rigid[:3, :3] = vehicle.mass * np.eye(3)
        self.rigid[:3, 3:] = -vehicle.mass * S
        self.rigid[3:, :3] = vehicle.mass * S
        self.rigid[3:, 3:] = np.diag(vehicle.inertia) - vehicle.mass * S @ S

        def diagonal(form: str) -> Array:
            names = (form.format(A, v) for A, v in zip(AXES, VELOCITIES))
            return np.array([vehicle.theta[name] for name in names])

        self.added = -np.diag(diagonal("{0}_{1}dot"))
        self.linear, self.square = diagonal("{0}_{1}"), diagonal("{0}_{1}{1}")
        self.weight, self.cog = GRAVITY * vehicle.mass, cog
        self.buoyancy, self.cob = vehicle.buoyancy + sea.lift, vehicle.cob
        self.body = Body(
            self.rigid, self.added, np.linalg.inv(self.rigid + self.added),
            self.linear, self.square, self.weight, self.buoyancy, self.cog, self.cob,
            np.array([sea.current, sea.current_swing], float),
            2.0 * math.pi / sea.current_period, float(sea.advance),
        )  # fmt: skip

    def water(self, t: float) -> tuple[Array, Array]:
        """Velocity and acceleration of the water in the world."""
        return _water(self.body, t)

    def rates(self, t: float, state: Array, thrust: Array) -> Array:
        """d/dt (13,) of position, attitude and nu under the thrusts (8,)."""
        return _rates(self.body, t, state, thrust)

    def step(self, t: float, state: Array, k1: Array, middle: Array, last: Array) -> Array:
        """(13,) a STEP later: :func:`_step`."""
        return _step(self.body, t, state, k1, middle, last)

    def energy(self, state: Array) -> float:
        """Kinetic, of vehicle and water at rest, and potential, in J."""
        mass, nu, down = self.rigid + self.added, state[7:], rotations(state[None, 3:7])[0, 2]
        height_of_cog = -(state[2] + down @ self.cog)
        height_of_cob = -(state[2] + down @ self.cob)
        potential = self.weight * height_of_cog - self.buoyancy * height_of_cob
        return float(0.5 * nu @ mass @ nu + potential)


# ------------------------------------------------------------------ driving


def six_axes(rng: np.random.Generator, t: Array) -> Array:
    """(K, 6) demands: every axis steps on its own to another level each 0.5 to 3 s."""
    out = np.zeros((len(t), 6))
    for axis in range(6):
        edges = np.cumsum(rng.uniform(0.5, 3.0, int(t[-1] / 0.5) + 2))
        levels = LEVELS[axis] * rng.uniform(-1.0, 1.0, len(edges) + 1)
        out[:, axis] = levels[np.searchsorted(edges, t, side="right")]
    return out


STICK_DEADBAND = 0.1  # share of its travel
STICK_RATE = 5.0  # full travels in a second


def pilot(
    rng: np.random.Generator,
    t: Array,
    pauses: tuple[float, float] = (0.3, 3.0),
    deadband: float = STICK_DEADBAND,
) -> Array:
    """(K, 6) demands of a pilot: one or two sticks at a time, and long pauses between."""
    stick, begin = np.zeros((len(t), 6)), rng.uniform(1.0, 4.0)
    while begin < t[-1]:
        # surge and yaw most, as on an inspection; roll and pitch have no stick
        count = 1 if rng.random() < 0.6 else 2
        used = rng.choice([0, 1, 2, 5], count, replace=False, p=[0.4, 0.15, 0.15, 0.3])
        end = begin + rng.uniform(1.0, 6.0)
        size = rng.uniform(0.2, 1.0, count) * rng.choice([-1.0, 1.0], count)
        stick[(t >= begin) & (t < end)] += size @ np.eye(6)[used]
        pause = rng.uniform(6.0, 20.0) if rng.random() < 0.25 else rng.uniform(*pauses)
        begin = end + pause
    hand = 0.03 * lfilter([0.1], [1.0, -0.9], rng.standard_normal((len(t), 6)), axis=0)
    stick += hand
    most = STICK_RATE * (t[1] - t[0])
    for k in range(1, len(t)):
        stick[k] = stick[k - 1] + np.clip(stick[k] - stick[k - 1], -most, most)
    beyond = np.maximum(np.abs(stick) - deadband, 0.0) / (1.0 - deadband)
    return LEVELS * np.minimum(beyond, 1.0) * np.sign(stick) * [1.0, 1.0, 1.0, 0.0, 0.0, 1.0]


def only(*axes: int) -> Callable[[np.random.Generator, Array], Array]:
    """:func:`six_axes` of which only these are driven."""
    return lambda rng, t: six_axes(rng, t) * np.isin(np.arange(6), axes)


def axis_by_axis(rng: np.random.Generator, t: Array) -> Array:
    """:func:`six_axes` of which one is driven at a time, 4 to 10 s each, none twice in a row."""
    edges = np.cumsum(rng.uniform(4.0, 10.0, int(t[-1] / 4.0) + 2))
    driven = np.cumsum(rng.integers(1, 6, len(edges) + 1)) % 6
    driven = driven[np.searchsorted(edges, t, side="right")]
    return six_axes(rng, t) * (driven[:, None] == np.arange(6))


def heeling_pilot(rng: np.random.Generator, t: Array) -> Array:
    """:func:`pilot` who now and then heels the vehicle for some seconds, to look up or below."""
    demand, begin = pilot(rng, t), rng.uniform(5.0, 20.0)
    while begin < t[-1]:
        end = begin + rng.uniform(3.0, 8.0)
        axis, size = rng.integers(3, 5), rng.uniform(0.5, 1.5) * rng.choice([-1.0, 1.0])
        demand[(t >= begin) & (t < end), axis] += size  # N m
        begin = end + rng.uniform(5.0, 30.0)
    return demand


def slow_pilot(rng: np.random.Generator, t: Array) -> Array:
    """:func:`pilot` who rests the sticks longer, whose middle fifth does nothing."""
    return pilot(rng, t, pauses=(5.0, 15.0), deadband=0.2)


DRIVING: dict[str, Callable[[np.random.Generator, Array], Array]] = {
    "six-axis": six_axes,
    "pilot": pilot,
    "heeling pilot": heeling_pilot,
}
PARTIAL = {
    "four-axis": only(2, 3, 4, 5),
    **{name: only(2 + i) for i, name in enumerate(("heave", "roll", "pitch", "yaw"))},
}
"""Surge and sway rest."""
SPARSE = {"axis by axis": axis_by_axis, "slow pilot": slow_pilot}
"""Of which `explain` must not make more than they show."""
# N m per sine of the tilt and per rad/s: of the autopilot that keeps the vehicle upright. It works
# against the excitation of roll and pitch, so its gain is low there.
LEVELLING = {
    **dict.fromkeys(("six-axis", "axis by axis", *PARTIAL), (2.0, 0.3)),
    **dict.fromkeys(("pilot", "slow pilot", "heeling pilot"), (4.0, 1.0)),
}


# ------------------------------------------------------------------ the dive


@dataclass(frozen=True)
class Truth:
    """The motion at the ends of K steps; ``begin`` and ``end`` are its rates (K, 13) there."""

    t: Array  # (K + 1,)
    state: Array  # (K + 1, 13) position, attitude w x y z, nu
    begin: Array
    end: Array
    command_t: Array
    command: Array  # (L, 6) wrench that the vehicle believes to have from each command_t
    wrench: Array  # (K, 6) that acts at the begin of each step

    def at(self, t: Array) -> tuple[Array, Array]:
        """State and rates (N, 13) at any instants: cubic Hermite interpolation within a step."""
        k = np.clip(((t - self.t[0]) / STEP).astype(int), 0, len(self.begin) - 1)
        s = np.clip((t - self.t[k]) / STEP, 0.0, 1.0)[:, None]
        x0, x1, r0, r1 = self.state[k], self.state[k + 1], self.begin[k], self.end[k]
        linear, bend = x1 - x0, STEP * (r0 + r1) - 2.0 * (x1 - x0)
        slope = STEP * r0
        turn = linear - slope - bend  # x = x0 + slope s + turn s^2 + bend s^3
        x = x0 + s * (slope + s * (turn + s * bend))
        x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
        return x, (slope + s * (2.0 * turn + s * 3.0 * bend)) / STEP


def dive(
    vehicle: Vehicle, sea: Sea, driving: str, duration: float, rng: np.random.Generator
) -> Truth:
    """The motion under a driver and an autopilot; commands change only between two steps."""
    plant, per_command = Plant(vehicle, sea), round(1.0 / COMMAND_RATE / STEP)
    command_t = np.arange(round(duration * COMMAND_RATE)) / COMMAND_RATE
    demand = (DRIVING | PARTIAL | SPARSE)[driving](rng, command_t)
    demand[command_t < 1.0] = 0.0  # recording begins before the driving
    readings = rng.standard_normal((len(command_t), 6))
    level, damp = LEVELLING[driving]
    count = len(command_t) * per_command
    state, begin, end = np.empty((count + 1, 13)), np.empty((count, 13)), np.empty((count, 13))
    command, acting = np.empty((len(command_t), 6)), np.empty((count, 6))
    heading = rng.uniform(-math.pi, math.pi)
    x = np.zeros(13)
    x[2], x[3], x[6] = 30.0, math.cos(0.5 * heading), math.sin(0.5 * heading)
    state[0], reached = x, np.zeros(8)
    keep = math.exp(-0.5 * STEP / sea.lag) if sea.lag else 0.0
    for i, asked in enumerate(demand):
        down = rotations(x[None, 3:7])[0, 2] + ATTITUDE_STD * readings[i, :3]
        rate = x[10:13] + GYRO_STD * readings[i, 3:]
        asked[3] -= level * down[1] + damp * rate[0]
        asked[4] += level * down[0] - damp * rate[1]
        single = np.clip(_INVERSE @ asked, -MAX_THRUST, MAX_THRUST)
        command[i] = ALLOCATION @ single
        # Current grows with thrust^1.5 and thrust with the square of the voltage (the curves of
        # the T200 at 10 to 20 V).
        amperes = MAX_AMPERES * float(np.sum((np.abs(single) / MAX_THRUST) ** 1.5))
        volts = VOLTS - sea.discharge * i / len(demand) - sea.resistance * amperes
        held = sea.thrust_scale * (volts / VOLTS) ** 2 * single
        if not sea.lag:
            reached = held
        steps = i * per_command, (i + 1) * per_command
        reached = _follow(plant.body, steps, held, keep, reached, state, begin, end, acting)
        x = state[steps[1]]
    t = STEP * np.arange(count + 1)
    return Truth(t, state, begin, end, command_t, command, acting)


# ------------------------------------------------------------------ sensors and messages

_FLIP = np.array([1.0, -1.0, -1.0])  # forward-starboard-down to forward-port-up
_TO_ENU = np.array([0.0, _H, _H, 0.0])  # north-east-down to east-north-up
_FROM_FLU = np.array([0.0, 1.0, 0.0, 0.0])


def _ros_attitude(q: Array) -> Array:
    """Attitudes (N, 4) of a port-up body in an east-north-up world."""
    return product(product(np.broadcast_to(_TO_ENU, q.shape), q), _FROM_FLU * np.ones_like(q))


def _smoothed(x: Array, constant: float) -> Array:
    """(N, k) at the IMU's rate through a first-order low-pass, at rest before."""
    share = 1.0 - math.exp(-1.0 / IMU_RATE / constant)
    first = (1.0 - share) * x[:1]
    return lfilter([share], [1.0, share - 1.0], x, axis=0, zi=first)[0]


WANDER_TIME = 15.0  # s; that the error of an AHRS lasts, until gravity corrects it


def _coloured(rng: np.random.Generator, shape: tuple[int, int], std: float, time: float) -> Array:
    """Noise (N, k) at the IMU's rate, correlated over ``time`` s."""
    keep = math.exp(-1.0 / IMU_RATE / time)
    white = std * math.sqrt(1.0 - keep**2) * rng.standard_normal(shape)
    return lfilter([1.0], [1.0, -keep], white, axis=0)


def measured(truth: Truth, sea: Sea, rng: np.random.Generator) -> Messages:
    """(arrival [ns], role, message in ROS axes), in order of arrival."""
    duration, messages = truth.t[-1] - STEP, []
    on_the_way = dict(zip(("odom", "imu", "wrench"), sea.on_the_way, strict=True))

    def clock(rate: float) -> Array:
        return np.arange(rng.uniform(0.3, 1.0) / rate, duration, 1.0 / rate)

    def send(t: Array, role: str, ahead: float, make: Callable[[int, int], Message]) -> None:
        for i, ns in enumerate(np.round(1e9 * t).astype(np.int64).tolist()):
            stamp = EPOCH + ns + round(1e9 * ahead)
            arrival = EPOCH + ns + LATENCY + round(1e9 * on_the_way[role])
            messages.append((arrival, role, make(i, stamp)))

    # IMU
    t = clock(IMU_RATE)
    x, rates = truth.at(t)
    down = rotations(x[:, 3:7])[:, 2]
    force = rates[:, 7:10] + np.cross(x[:, 10:], x[:, 7:10]) - GRAVITY * down
    force += sea.accelerometer_bias + ACCELEROMETER_STD * rng.standard_normal(force.shape)
    gyro = x[:, 10:] + sea.gyro_bias + GYRO_STD * rng.standard_normal(force.shape)
    attitude = _tilted(x[:, 3:7], ATTITUDE_STD * rng.standard_normal(force.shape))
    mounting = np.array([-1.0, -1.0, 1.0]) if sea.imu_turned else np.ones(3)
    half_turn = np.array([0.0, 0.0, 0.0, 1.0]) * np.ones_like(attitude)
    seen = _ros_attitude(product(attitude, half_turn) if sea.imu_turned else attitude)
    a, w = _FLIP * mounting * force, _FLIP * mounting * gyro
    variances = np.full(3, GYRO_STD**2), np.full(3, ACCELEROMETER_STD**2)
    send(t, "imu", sea.imu_clock, lambda i, n: Imu(n, "imu_link", seen[i], w[i], a[i], *variances))

    # odometry
    variance = np.repeat([LINEAR_STD**2, ANGULAR_STD**2], 3)
    imu_t, odometry_t = t, clock(sea.odometry_rate)
    if sea.smoothing:
        # Its inputs come with the IMU: white velocities, so noisy that what is left of their noise
        # is the usual one, the same gyro, and an attitude whose error wanders.
        share = 1.0 - math.exp(-1.0 / IMU_RATE / sea.smoothing)
        left = share / (2.0 - share)  # of the variance of white noise
        late, _ = truth.at(np.maximum(imu_t - sea.velocity_delay, 0.0))
        noise = LINEAR_STD / math.sqrt(left) * rng.standard_normal(gyro.shape)
        linear, angular = (_smoothed(y, sea.smoothing) for y in (late[:, 7:10] + noise, gyro))
        wander = _coloured(rng, gyro.shape, ATTITUDE_STD, 5.0)
        drift = _coloured(rng, gyro.shape, POSITION_STD, 5.0)
        k = np.unique(np.clip(np.searchsorted(imu_t, odometry_t, side="right") - 1, 0, None))
        t, position = imu_t[k], x[k, :3] + drift[k]
        linear, angular, attitude = linear[k], angular[k], _tilted(x[k, 3:7], wander[k])
        variance = np.repeat([LINEAR_STD**2, left * GYRO_STD**2], 3)
    else:
        t = odometry_t
        x, _ = truth.at(t)
        late, _ = truth.at(np.maximum(t - sea.velocity_delay, 0.0))
        linear = late[:, 7:10] + LINEAR_STD * rng.standard_normal((len(t), 3))
        if sea.gyro_is_shared:
            angular = gyro[np.clip(np.searchsorted(imu_t, t, side="right") - 1, 0, None)]
        else:
            angular = x[:, 10:] + ANGULAR_STD * rng.standard_normal((len(t), 3))
        attitude = _tilted(x[:, 3:7], ATTITUDE_STD * rng.standard_normal((len(t), 3)))
        position = x[:, :3] + POSITION_STD * rng.standard_normal((len(t), 3))
    if (frozen := t >= sea.frozen_from).any():  # a position that is dead reckoning stands, too
        linear[frozen] = 0.003 * rng.standard_normal((frozen.sum(), 3))
        position[frozen] = position[frozen][0]
    level = np.array([[1.0, 0.0, 0.0, 0.0]])
    linear = linear @ rotations(_tilted(level, np.array([sea.velocity_turned])))[0]
    linear *= sea.velocity_scale
    if sea.wander:
        error = _coloured(rng, gyro.shape, sea.wander, WANDER_TIME)
        attitude = _tilted(attitude, error[np.clip(np.searchsorted(imu_t, t), 0, len(imu_t) - 1)])
    if any(sea.tilt):
        attitude = _tilted(attitude, np.broadcast_to([*sea.tilt, 0.0], (len(t), 3)))
    if sea.heading or sea.heading_drift:
        half, none = 0.5 * (sea.heading + sea.heading_drift * t), np.zeros_like(t)
        attitude = product(np.stack([np.cos(half), none, none, np.sin(half)], axis=1), attitude)
    if sea.dead_reckoned:
        way = np.einsum("kij,kj->ki", rotations(attitude), linear) * np.gradient(t)[:, None]
        position = position[0] + np.cumsum(way, axis=0)
    seen_q, flat = _ros_attitude(attitude), position[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    v, r = _FLIP * linear, _FLIP * angular
    send(
        t, "odom", sea.odometry_clock,
        lambda i, n: Odometry(n, "odom", "base_link", flat[i], seen_q[i], v[i], r[i], variance),
    )  # fmt: skip

    # wrench
    shape = truth.command.shape
    reading = truth.command / sea.of_reading * (1.0 + WRENCH_STD * rng.standard_normal(shape))
    count, axes = shape
    each = rng.standard_normal((-(-count // sea.floor_lasts), axes))
    reading += sea.wrench_floor * np.repeat(each, sea.floor_lasts, axis=0)[:count]
    if sea.reversed_axis >= 0:
        reading[:, sea.reversed_axis] *= -1.0
    F, T = _FLIP * reading[:, :3], _FLIP * reading[:, 3:]
    send(truth.command_t, "wrench", 0.0, lambda i, n: Wrench(n, "base_link", F[i], T[i]))
    messages.sort(key=lambda m: m[0])
    return messages
