"""Open-loop simulation of the equations of motion."""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.errors import UserError
from rov_ident.core.jit import floats, inner, lean, record
from rov_ident.core.quaternions import rotate, rotation_of
from rov_ident.core.runge_kutta import NODES, runge_kutta
from rov_ident.effects import Acting, add_surroundings, compiled, surrounds
from rov_ident.model.coefficients import EXTENDED_SIZE, INPUTS
from rov_ident.model.equations import (
    CURRENT,
    Array,
    Model,
    extend_inputs,
    generalized_force,
    six,
    symmetric_product,
)

MAX_STEP = 0.02  # s; within 1e-5 m/s of an adaptive integration for a BlueROV2 driven hard


@dataclass(frozen=True)
class Trajectory:
    """A motion sampled at ``t`` (N,) [s]: position (N, 3) [m] in the world, orientation (N, 4)
    w x y z, nu (N, 6) and its derivative nu_dot (N, 6) in body axes."""

    t: NDArray[np.float64]
    position: Array
    orientation: Array
    nu: Array
    nu_dot: Array


class Guide(NamedTuple):
    """A measured motion that part of a simulation follows (identification channel by channel).

    ``free`` (6,) marks the velocity components to be simulated; the others are those of ``nu``
    (N, 6), and with any angular one among them the attitude is that of ``orientation`` (N, 4).
    """

    free: NDArray[np.bool_]
    nu: Array
    orientation: Array


def simulate(
    model: Model, t: Array, wrench: Array, nu: Array | None = None, position: Array | None = None,
    orientation: Array | None = None, wrench_slope: Array | None = None,
    guide: Guide | None = None, effects: Acting | None = None, inputs: Array | None = None,
) -> Trajectory:  # fmt: skip
    """Integrate from the first instant of ``t`` (N,), the wrench (N, 6) held from each to the next.

    nu (6,), position (3,) and orientation (4,) are the state at ``t[0]``: at rest, at the origin
    and level by default. ``wrench_slope`` (N, 6) lets the wrench change linearly in each interval
    about its mean. ``inputs`` (N, 4), of INPUTS, are held like the wrench. With a
    ``guide`` only some components are simulated, the others follow it.

    Of ``effects`` wrenches and current act along the simulated motion, at the instants ``t`` since
    the first message; effects on the input are the caller's (:func:`rov_ident.effects.acted`).

    Raises UserError if shapes do not fit, or if the motion does not stay finite: no vehicle moves
    as this model says.
    """
    position = np.zeros(3) if position is None else position
    orientation = np.array([1.0, 0.0, 0.0, 0.0]) if orientation is None else orientation
    start = np.concatenate([position, orientation, np.zeros(6) if nu is None else nu])
    n = len(t)
    if n == 0 or np.shape(wrench) != (n, 6):
        raise UserError(f"{n} instants need a wrench ({n}, 6), not {np.shape(wrench)}")
    out = np.empty((n, 19))
    if guide is None:
        guide = Guide(np.ones(6, dtype=bool), np.empty((0, 6)), np.empty((0, 4)))
    free = np.flatnonzero(guide.free)
    inverse = np.zeros((6, 6))
    inverse[np.ix_(free, free)] = np.linalg.inv(model.mass_matrix[np.ix_(free, free)])
    done = _simulate(
        _NOTHING if effects is None else effects,
        model.structure,
        np.ascontiguousarray(model.added_mass[:, :, None]),
        model.mass_matrix,
        inverse,
        model.theta.reshape(-1, 1),
        model.body.restoring,
        np.ascontiguousarray(t, dtype=float),
        np.ascontiguousarray(wrench, dtype=float),
        np.empty((0, 6)) if wrench_slope is None else np.ascontiguousarray(wrench_slope),
        np.zeros((n, len(INPUTS))) if inputs is None else np.ascontiguousarray(inputs),
        guide.free,
        np.ascontiguousarray(guide.nu),
        np.ascontiguousarray(guide.orientation),
        start,
        MAX_STEP,
        np.zeros(1, dtype=_SCRATCH),
        out,
    )
    if done < n:
        raise UserError(
            f"the simulation diverges {t[done] - t[0]:.1f} s after its start: "
            "check the signs and sizes of the coefficients and of the wrench"
        )
    return Trajectory(np.asarray(t), out[:, :3], out[:, 3:7], out[:, 7:13], out[:, 13:])


def open_loop(
    model: Model, t: Array, wrench: Array, nu: Array, orientation: Array, horizon: float,
    wrench_slope: Array | None = None, free: NDArray[np.bool_] | None = None,
    effects: Acting | None = None, inputs: Array | None = None, position: Array | None = None,
) -> Array:  # fmt: skip
    """Velocities (N, 6) predicted open loop over windows of ``horizon`` seconds.

    Each window starts from the measured ``nu`` (N, 6) and ``orientation`` (N, 4) at its first
    sample; rows whose prediction has left all reason (a diverging model) hold infinity. Components
    not marked in ``free`` (6,) follow the measurement. ``effects`` and ``inputs`` as for
    :func:`simulate`, ``position`` (N, 3) as measured.
    """
    free = np.ones(6, dtype=bool) if free is None else free
    slope = np.zeros_like(wrench) if wrench_slope is None else wrench_slope
    predicted = np.empty((len(t), 6))
    edges = np.append(np.flatnonzero(np.diff(np.floor((t - t[0]) / horizon), prepend=-1.0)), len(t))
    for first, end in pairwise(edges):
        window = slice(first, end)
        try:
            guide = Guide(free, nu[window], orientation[window])
            predicted[window] = simulate(
                model, t[window], wrench[window], nu[first],
                None if position is None else position[first], orientation[first],
                slope[window], guide, effects, None if inputs is None else inputs[window],
            ).nu  # fmt: skip
        except UserError:
            predicted[window] = np.inf
    return predicted


_NOTHING = compiled({})

_SCRATCH = record(
    [
        *floats((13,), "state stage slope end"),  # position, quaternion, nu; end: of a step
        # wrench of the thrusters, and of effects; nu_dot of the components that are not free
        *floats((6,), "thrust push guide_nu_dot velocity"),
        *floats((6, 1), "nu h"),
        *floats((6, 6, 1), "mass inverse"),  # the inverse among the free components
        ("extended", "f8", (EXTENDED_SIZE, 1)),
        ("rotation", "f8", (3, 3)),
        ("current", CURRENT),
    ]
)


@inner
def _derivative(structure, theta, restoring, guided, s, rate):
    """rate (13,) of s.stage under s.push."""
    x, h = s.stage, s.h
    for i in range(6):
        s.nu[i, 0] = x[7 + i]
    generalized_force(1, structure, s.mass, theta, s.nu, h, s.extended)
    q0, q1, q2, q3 = x[3], x[4], x[5], x[6]
    u, v, w, p, q, r = six(s.nu, 0)
    a, b, c = rotation_of(q0, q1, q2, q3)
    for i in range(6):
        force = restoring[i, 0] * c[0] + restoring[i, 1] * c[1] + restoring[i, 2] * c[2]
        h[i, 0] = s.push[i] + force - h[i, 0]
    if guided:
        for i in range(6):
            for j in range(6):
                h[i, 0] -= s.mass[i, j, 0] * s.guide_nu_dot[j]
    rate[0] = a[0] * u + a[1] * v + a[2] * w
    rate[1] = b[0] * u + b[1] * v + b[2] * w
    rate[2] = c[0] * u + c[1] * v + c[2] * w
    # q_dot = q (0, omega) / 2
    rate[3] = 0.5 * (-q1 * p - q2 * q - q3 * r)
    rate[4] = 0.5 * (q0 * p + q2 * r - q3 * q)
    rate[5] = 0.5 * (q0 * q + q3 * p - q1 * r)
    rate[6] = 0.5 * (q0 * r + q1 * q - q2 * p)
    nu_dot = symmetric_product(s.inverse, six(h, 0), 0)
    for i in range(6):
        rate[7 + i] = nu_dot[i] + s.guide_nu_dot[i]


@lean
def _simulate(
    acting, structure, added_mass, mass, inverse, theta, restoring, t, wrench, wrench_slope,
    inputs, free, guide, attitude, start, max_step, scratch, out,
):  # fmt: skip
    """Classical Runge-Kutta; out (N, 19): position, quaternion, nu, nu_dot.

    nu_dot is that under the wrench which begins to act at the instant. Returns the number of rows
    that are finite. ``wrench_slope`` may be empty, and ``guide`` where all is free.
    """
    s = scratch[0]  # the caller's: a record does not keep its array alive
    state, stage, slope = s.state, s.stage, s.slope
    for i in range(6):
        for j in range(6):
            s.mass[i, j, 0], s.inverse[i, j, 0] = mass[i, j], inverse[i, j]
    for j in range(13):
        state[j] = start[j]
    guided, surrounded = not free.all(), surrounds(acting)
    span = 0.0
    for i in range(len(t)):
        last = i + 1 == len(t)
        if not last:
            span = t[i + 1] - t[i]
        for j in range(6):
            if not free[j]:
                state[7 + j] = guide[i, j]
                if not last:  # at the last instant the last interval's nu_dot continues
                    s.guide_nu_dot[j] = (guide[i + 1, j] - guide[i, j]) / span
                if j >= 3:
                    for k in range(4):
                        state[3 + k] = attitude[i, k]
        extend_inputs(1, structure, inputs[i], s.extended)
        extend_inputs(1, structure, inputs[i], s.current.extended)
        steps = max(1, int(np.ceil(span / max_step - 1e-9)))
        dt = span / steps
        for n in range(steps):
            for j in range(13):
                stage[j] = s.end[j] = state[j]
            for k in range(4):
                ahead = NODES[k] * dt
                now = n * dt + ahead
                for j in range(6):
                    s.push[j] = wrench[i, j]
                if len(wrench_slope) > 0:
                    for j in range(6):
                        s.push[j] += (now - 0.5 * span) * wrench_slope[i, j]
                if surrounded:
                    for j in range(6):
                        s.velocity[j], s.thrust[j] = stage[7 + j], s.push[j]
                    rotate(stage[3:7], s.rotation)
                    add_surroundings(
                        acting, structure, added_mass, theta, t[i] + now, stage[:3],
                        s.velocity, s.rotation, s.thrust, s.current, s.push,
                    )  # fmt: skip
                _derivative(structure, theta, restoring, guided, s, slope)
                if n == 0 and k == 0:
                    total = 0.0
                    for j in range(13):
                        out[i, j] = state[j]
                        total += state[j]
                    for j in range(6):
                        out[i, 13 + j] = slope[7 + j]
                        total += slope[7 + j]
                    if not np.isfinite(total):
                        return i
                    if last:
                        return len(t)
                runge_kutta(k, dt, state, slope, stage, s.end)
            for j in range(13):
                state[j] = s.end[j]
            length = np.sqrt(state[3] ** 2 + state[4] ** 2 + state[5] ** 2 + state[6] ** 2)
            for j in range(3, 7):
                state[j] /= length
    return len(t)
