"""A second hand: an underwater vehicle in the matrix form of Fossen (2021, ch. 8), compiled.

Written without a look at the package, for data to test it on; only hidden.py uses it. SI,
body axes forward-starboard-down, world north-east-down, t = 0 at the first message.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AXES, VELOCITIES = "XYZKMN", "uvwpqr"
GRAVITY = 9.81

# Effects that the library lacks, by how their force is computed (_unknown_force).
POWER, FRICTION, FOAM, HALOCLINE, SPRING, SHAKE, DRIFT, REACTION, HEADING = range(1, 10)
BUMP, SLOPE = 10, 11


# ------------------------------------------------------------------ matrices


def skew(a: Array) -> Array:
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def rigid_mass(mass: float, cog: Array, inertia: Array) -> Array:
    """M_RB (6, 6) about the body origin: H' diag(m, I) H, H shifting velocities to the CG."""
    shift = np.eye(6)
    shift[:3, 3:] = skew(np.asarray(cog)).T
    about_cog = np.zeros((6, 6))
    about_cog[:3, :3] = mass * np.eye(3)
    about_cog[3:, 3:] = inertia
    return shift.T @ about_cog @ shift


def added_mass(theta: Mapping[str, float]) -> Array:
    """M_A (6, 6) = -(symmetric) added-mass derivatives."""
    matrix = np.zeros((6, 6))
    for name, value in theta.items():
        if name.endswith("dot"):
            i, j = AXES.index(name[0]), VELOCITIES.index(name[2])
            matrix[i, j] = matrix[j, i] = -value
    return matrix


class Plant(NamedTuple):
    """The vehicle as the kernels take it; forces are +coefficient * velocities."""

    mass: float
    cog: Array
    inertia: Array  # (3, 3) about the body origin
    added: Array
    inverse: Array  # of M_RB + M_A
    cross: Array  # (6, 6) linear coefficients off the diagonal
    linear: Array  # (2, 6) on the diagonal: for positive and for negative velocity
    square: Array  # (2, 6) likewise, times |v| v
    place: NDArray[np.int64]  # (k, 3) row and two velocities of each product
    product: Array  # (k,)
    weight: float
    buoyancy: float
    cob: Array


def plant(
    mass: float,
    buoyancy: float,
    cog: Array,
    cob: Array,
    inertia: Array,
    theta: Mapping[str, float],
    backward: Mapping[str, float],
) -> Plant:
    """``inertia`` about the CG; ``backward``: the diagonal damping that differs for negative
    velocity."""
    rigid, added = rigid_mass(mass, cog, inertia), added_mass(theta)
    cross, linear, square = np.zeros((6, 6)), np.zeros((2, 6)), np.zeros((2, 6))
    place, product = [], []
    for name, value in theta.items():
        row, letters = AXES.index(name[0]), name[2:]
        if letters.endswith("dot"):
            continue
        a = VELOCITIES.index(letters[0])
        if letters == VELOCITIES[row]:
            linear[:, row] = value, backward.get(name, value)
        elif letters == VELOCITIES[row] * 2:
            square[:, row] = value, backward.get(name, value)
        elif len(letters) == 1:
            cross[row, a] = value
        else:
            place.append((row, a, VELOCITIES.index(letters[1])))
            product.append(value)
    return Plant(
        mass,
        cog,
        rigid[3:, 3:].copy(),
        added,
        np.linalg.inv(rigid + added),
        cross,
        linear,
        square,
        np.array(place, dtype=np.int64).reshape(-1, 3),
        np.array(product, dtype=float),
        mass * GRAVITY,
        buoyancy,
        cob,
    )


class World(NamedTuple):
    """What else acts on the body, the library's effects and the unknown one."""

    delta: float  # N downward at the centre of buoyancy
    payload: float  # N
    payload_at: Array
    payload_from: float
    current: Array  # (3,) NED
    wave: Array  # (3,) NED
    frequency: float
    phase: float
    tether: float
    tether_at: Array
    steady: Array  # (3,) NED


class Drive(NamedTuple):
    """From the demanded to the acting wrench, in this order."""

    delay: float
    width: Array  # (6,)
    backward: Array  # (6,) gain on negative demand
    gain: Array  # (6,)
    failed: Array  # (6,) gain from `failure` on
    failure: float  # s
    sag: float  # loss of gain per s
    lag: float  # s


def rotations(q: Array) -> Array:
    """(N, 3, 3), body -> world, of unit quaternions (N, 4)."""
    s = np.zeros((len(q), 3, 3))
    s[:, 0, 1], s[:, 0, 2], s[:, 1, 2] = -q[:, 3], q[:, 2], -q[:, 1]
    s -= s.transpose(0, 2, 1)
    return np.eye(3) + 2.0 * q[:, 0, None, None] * s + 2.0 * s @ s


class Control(NamedTuple):
    """What keeps the vehicle upright and in its box, besides the excitation."""

    driven: Array  # (6,) 1, or 0 for an axis without thrust
    limits: Array  # (6,)
    level: float  # roll and pitch moment, share of the limit per rad
    low: Array  # (3,) corners of the box in the world
    high: Array
    noise: Array  # (K, 9) position, roll pitch yaw, rates as the controller reads them


# ------------------------------------------------------------------ kernels

_fast = numba.njit(cache=True, error_model="numpy")


# Vectors (3,) that come and go are tuples: an array would be allocated for each.


@_fast
def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@_fast
def _plus(a, b):
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@_fast
def _times(s, a):
    return (s * a[0], s * a[1], s * a[2])


@_fast
def _add(a, out):
    """Add a vector to the first three of out."""
    for i in range(3):
        out[i] += a[i]


@_fast
def _push(force, at, out):
    """Add a force in body axes that acts at a point."""
    _add(force, out)
    _add(_cross(at, force), out[3:])


@_fast
def _to_body(r, a):
    return (
        r[0, 0] * a[0] + r[1, 0] * a[1] + r[2, 0] * a[2],
        r[0, 1] * a[0] + r[1, 1] * a[1] + r[2, 1] * a[2],
        r[0, 2] * a[0] + r[1, 2] * a[1] + r[2, 2] * a[2],
    )


@_fast
def _down(r, force):
    """A force along world z, in body axes."""
    return (r[2, 0] * force, r[2, 1] * force, r[2, 2] * force)


@_fast
def _matrix(q):
    """R (3, 3), body -> world: I + 2 w S + 2 S S of the unit quaternion w x y z."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    out = np.empty((3, 3))
    # S S = a a' - |a|^2 I of the vector part a
    square = x * x + y * y + z * z
    for i in range(3):
        for j in range(3):
            out[i, j] = 2.0 * q[1 + i] * q[1 + j]
        out[i, i] += 1.0 - 2.0 * square
    out[0, 1] -= 2.0 * w * z
    out[1, 0] += 2.0 * w * z
    out[0, 2] += 2.0 * w * y
    out[2, 0] -= 2.0 * w * y
    out[1, 2] -= 2.0 * w * x
    out[2, 1] += 2.0 * w * x
    return out


@_fast
def _damping(plant, nu, out):
    """Add the damping force at a velocity through the water (6,)."""
    for i in range(6):
        side = 0 if nu[i] >= 0.0 else 1
        out[i] += (plant.linear[side, i] + plant.square[side, i] * abs(nu[i])) * nu[i]
        for j in range(6):
            out[i] += plant.cross[i, j] * nu[j]
    for k in range(len(plant.product)):
        row, a, b = plant.place[k, 0], plant.place[k, 1], plant.place[k, 2]
        out[row] += plant.product[k] * nu[a] * nu[b]


@_fast
def _unknown_force(kind, axis, p, t, position, r, nu, out):
    """Add an effect that is not in the library."""
    v = nu[axis]
    if kind == POWER:
        out[axis] -= p[0] * (abs(v) + 1e-4) ** (p[1] - 1.0) * v
    elif kind == FRICTION:
        out[axis] -= p[0] * math.tanh(v / p[1])
    elif kind == FOAM:
        _add(_down(r, p[0] * (position[2] - p[1])), out)
    elif kind == HALOCLINE:
        _add(_down(r, -p[0] * math.tanh((position[2] - p[1]) / p[2])), out)
    elif kind == SPRING:
        force = np.zeros(3)
        force[axis] = -p[0] * (position[axis] - p[1])
        _add(_to_body(r, force), out)
    elif kind == SHAKE:
        out[axis] += p[0] * math.sin(2.0 * math.pi * p[1] * t + p[2])
    elif kind == DRIFT:
        w = 2.0 * math.pi * p[1] * t
        out[axis] += p[0] * (math.sin(w + p[2]) + 0.6 * math.sin(0.37 * w + p[3]))
    elif kind == REACTION:
        out[axis] += p[0] * abs(nu[0]) * nu[0]
    elif kind == HEADING:
        out[axis] += p[0] * math.sin(math.atan2(r[1, 0], r[0, 0]) - p[1])
    elif kind == BUMP:
        out[axis] -= p[0] * math.tanh(20.0 * v) * math.exp(-(((abs(v) - p[1]) / p[2]) ** 2))
    elif kind == SLOPE:
        pitch = -math.asin(min(max(r[2, 0], -1.0), 1.0))
        out[axis] += p[0] * math.tanh((position[2] - p[1]) / p[2]) * math.sin(4.0 * pitch)


@_fast
def unknown_forces(kind, axis, p, t, motion, out):
    """Add the wrenches (N, 6) of an effect that is not in the library along a motion (N, 25) as
    :func:`run` gives it; its water is at rest."""
    for i in range(len(t)):
        r = _matrix(motion[i, 3:7])
        _unknown_force(kind, axis, p, t[i], motion[i, :3], r, motion[i, 7:13], out[i])


@_fast
def _acceleration(plant, world, kind, axis, p, t, position, r, nu, wrench):
    """nu_dot (6,) from M_RB nu_dot + C_RB nu + M_A nu_r_dot + C_A nu_r = all forces."""
    v, w = nu[:3], nu[3:]
    water = _to_body(r, world.current)
    through = nu.copy()
    _add(_times(-1.0, water), through)
    vr = through[:3]
    f = wrench.copy()
    _damping(plant, through, f)
    _push(_down(r, plant.weight), plant.cog, f)
    _push(_down(r, -plant.buoyancy + world.delta), plant.cob, f)
    if world.payload != 0.0 and t >= world.payload_from:
        _push(_down(r, world.payload), world.payload_at, f)
    wave = math.sin(2.0 * math.pi * world.frequency * t + world.phase)
    _add(_to_body(r, _plus(world.steady, _times(wave, world.wave))), f)
    if world.tether != 0.0:
        there = _plus(vr, _cross(w, world.tether_at))
        speed = math.sqrt(there[0] ** 2 + there[1] ** 2 + there[2] ** 2)
        _push(_times(-world.tether * speed, there), world.tether_at, f)
    _unknown_force(kind, axis, p, t, position, r, through, f)

    # C_RB(nu) nu, linear-velocity-independent form (Fossen 2021, eq. 3.63)
    turning = _cross(w, v)
    _add(_times(-plant.mass, _plus(turning, _cross(w, _cross(w, plant.cog)))), f)
    _add(_times(-plant.mass, _cross(plant.cog, turning)), f[3:])
    _add(_cross(plant.inertia @ w, w), f[3:])
    # C_A(nu_r) nu_r (eq. 6.43)
    a = plant.added @ through
    _add(_cross(a[:3], w), f)
    _add(_plus(_cross(a[:3], vr), _cross(a[3:], w)), f[3:])
    # water that is steady in the world turns in body axes: d(water)/dt = -w x water
    gust = _cross(water, w)
    for i in range(6):
        for j in range(3):
            f[i] += plant.added[i, j] * gust[j]
    return plant.inverse @ f


@_fast
def _rate(plant, world, kind, axis, p, t, state, wrench):
    """d/dt (13,) of position, quaternion, nu."""
    q, nu = state[3:7], state[7:13]
    r = _matrix(q)
    out = np.empty(13)
    out[:3] = r @ nu[:3]
    half = 0.5 * nu[3:]
    out[3] = -(q[1] * half[0] + q[2] * half[1] + q[3] * half[2])
    out[4:7] = q[0] * half
    _add(_cross(q[1:4], half), out[4:])
    out[7:] = _acceleration(plant, world, kind, axis, p, t, state[:3], r, nu, wrench)
    return out


@_fast
def _command(control, shares, k, state):
    """The wrench demanded (6,): excitation, a weak righting moment, and the walls of the box."""
    r, noise = _matrix(state[3:7]), control.noise[k]
    out = shares * control.limits
    angles = np.array([math.atan2(r[2, 1], r[2, 2]), -math.asin(max(-1.0, min(1.0, r[2, 0])))])
    for i in range(2):
        angle = angles[i] + noise[3 + i]
        rate = state[10 + i] + noise[6 + i]
        beyond = angle - max(-0.3, min(0.3, angle))
        stop = 8.0 * beyond + (1.5 * rate if beyond != 0.0 else 0.0)
        out[3 + i] -= control.limits[3 + i] * (control.level * (angle + 0.3 * rate) + stop)
    velocity = r @ state[7:10]
    force = np.zeros(3)
    for i in range(3):
        place = state[i] + noise[i]
        beyond = place - max(control.low[i], min(control.high[i], place))
        if beyond != 0.0:
            force[i] = -control.limits[i] * (1.5 * beyond + 1.5 * velocity[i])
    _add(_to_body(r, force), out)
    for i in range(6):
        most = (2.0 if i < 3 else 6.0) * control.limits[i]
        out[i] = control.driven[i] * max(-most, min(most, out[i]))
    return out


@_fast
def _static(drive, demand, t):
    """Deadband, asymmetry, gain and failure of a demand (6,) that has arrived at the thrusters."""
    out = np.empty(6)
    for i in range(6):
        d = demand[i]
        d = math.copysign(max(abs(d) - drive.width[i], 0.0), d)
        if d < 0.0:
            d *= drive.backward[i]
        d *= drive.gain[i]
        if t >= drive.failure:
            d *= drive.failed[i]
        out[i] = d
    return out


@_fast
def _thrust(drive, reached, held, start, s):
    """What acts (6,) s seconds into an interval from ``start``, ``reached`` (6,) acting there.

    The sagging gain turns the held demand into a ramp, to which the lag answers in closed form.
    """
    level, slope = held * (1.0 - drive.sag * start), -drive.sag * held
    if drive.lag <= 0.0:
        return level + slope * s
    behind = level - slope * drive.lag  # the ramp that the lag follows in the end, at s = 0
    return behind + slope * s + (reached - behind) * math.exp(-s / drive.lag)


@_fast
def run(plant, world, kind, axis, p, drive, control, t, asked, shares, command_t, start, demand,
         out):  # fmt: skip
    """Runge-Kutta from each instant to the next; asked (N,) is the command given there, or -1.

    out (N, 25): position, quaternion, nu, nu_dot, acting wrench; demand (K, 6).
    """
    state, arrived = start.copy(), 0
    reached = np.zeros(6)
    for i in range(len(t)):
        if asked[i] >= 0:
            demand[asked[i]] = _command(control, shares[asked[i]], asked[i], state)
        while arrived + 1 < len(command_t) and command_t[arrived + 1] + drive.delay <= t[i] + 1e-9:
            arrived += 1
        h = t[i + 1] - t[i] if i + 1 < len(t) else 0.0
        held = _static(drive, demand[arrived], t[i] + 0.5 * h)
        if i == 0:
            reached = held.copy()
        # forces that begin at an instant act throughout the interval that begins there
        eps = 1e-9
        acting = _thrust(drive, reached, held, t[i], 0.0)
        middle = _thrust(drive, reached, held, t[i], 0.5 * h)
        end = _thrust(drive, reached, held, t[i], h)
        k1 = _rate(plant, world, kind, axis, p, t[i] + eps, state, acting)
        out[i, :13] = state
        out[i, 13:19] = k1[7:]
        out[i, 19:] = acting
        k2 = _rate(plant, world, kind, axis, p, t[i] + 0.5 * h, state + 0.5 * h * k1, middle)
        k3 = _rate(plant, world, kind, axis, p, t[i] + 0.5 * h, state + 0.5 * h * k2, middle)
        k4 = _rate(plant, world, kind, axis, p, t[i] + h - eps, state + h * k3, end)
        state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        state[3:7] /= math.sqrt(np.sum(state[3:7] ** 2))
        reached = end
