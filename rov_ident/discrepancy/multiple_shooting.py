"""Output error over short windows (multiple shooting), with its sensitivities.

Each window starts from a velocity of its own, which is estimated with the parameters and eliminated
(it is a nuisance). Inside, the velocity is integrated from the equations of motion; the attitude
is taken as measured. Sensitivities solve the linearised equations along that motion::

    d(nu)[k+1] = Phi[k] d(nu)[k] + Gamma[k] dF[k]

for any change dF of the wrench, so that a hundred candidate causes cost little more than one.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.jit import copy, floats, inner, record, released
from rov_ident.core.runge_kutta import NODES, linear_step, multiply, runge_kutta
from rov_ident.effects import Acting, act, add_surroundings, memory, on_clock, surrounds
from rov_ident.model.coefficients import EXTENDED_SIZE
from rov_ident.model.equations import (
    CURRENT,
    Array,
    Model,
    Structure,
    columns,
    extend_inputs,
    generalized_force,
    momentum_columns,
    six,
    symmetric_product,
)

Indices = NDArray[np.int64]

_NEARBY = 1e-4  # m/s, rad/s; of the difference quotients


class Steps(NamedTuple):
    """The time axis: steps k = 0 .. K - 1 from node k to node k + 1. The demand is held over
    pieces; the pieces of step k begin at ``piece[k]``."""

    t: Array  # (K + 1,) s
    rotation: Array  # (K + 1, 3, 3), body -> world
    middle: Array  # (K, 3, 3), half-way through the step
    position: Array  # (K, 3) m, in the world, as measured there
    piece_t: Array  # (J + 1,) s
    demand: Array  # (J, 6)
    anew: NDArray[np.bool_]  # (J,): the first of a recording; what acted before is not known
    piece: Indices  # (K,)
    inputs: Array  # (K, 4): mean of INPUTS over each step
    given: Array  # (K, 6) accelerations that guided axes are measured to have, else 0; or (0, 6)
    begin: Array  # (K,) s, of the record, from which effects count the time
    piece_begin: Array  # (J,) s, the same of pieces


class Equations(NamedTuple):
    """The equations of motion, their numbers as the kernels take them."""

    structure: Structure
    mass: Array  # (6, 6, 1)
    added: Array  # (6, 6, 1)
    inverse: Array  # (6, 6); zeros in the rows and columns of axes that are guided
    theta: Array  # (n, 1)
    restoring: Array  # (6, 3)
    acting: Acting


class Motion(NamedTuple):
    """A shot through all windows; rows outside every window hold nothing of meaning."""

    nu: Array  # (K + 1, 6) at the nodes
    middle: Array  # (K, 6) half-way through each step
    nu_dot: Array  # (K, 6) its derivative there
    phi: Array  # (K, 6, 6)
    gamma: Array  # (K, 6, 6)


def equations(model: Model, acting: Acting) -> Equations:
    mass = model.mass_matrix
    lanes = (mass, mass - model.body.mass_matrix, model.theta)
    mass, added, theta = (np.ascontiguousarray(x[..., None]) for x in lanes)
    inverse: Array = np.asarray(np.linalg.inv(model.mass_matrix), dtype=np.float64)
    return Equations(model.structure, mass, added, inverse, theta, model.body.restoring, acting)


def guided_by(eq: Equations, guided: NDArray[np.bool_]) -> Equations:
    """The same where some axes (6,) follow the measurement."""
    if not guided.any():
        return eq
    free = np.ix_(~guided, ~guided)
    inverse = np.zeros((6, 6))
    inverse[free] = np.linalg.inv(eq.mass[:, :, 0][free])
    return eq._replace(inverse=inverse)


def thrust(steps: Steps, acting: Acting) -> Array:
    """Mean and slope (2, K, 6) of the thrusters' wrench in each step, after the input effects."""
    return thrusts(steps, acting, steps.demand[None])[0]


def thrusts(steps: Steps, acting: Acting, demands: Array) -> Array:
    """The same (N, 2, K, 6) of several demands (N, J, 6)."""
    out = np.zeros((len(demands), 2, len(steps.piece), 6))
    for wrench, means in zip(acted(steps, acting, demands), out, strict=True):
        _means(steps.piece_t, wrench, steps.t, steps.piece, means)
    return out


def acted(steps: Steps, acting: Acting, demands: Array) -> Array:
    """The thrusters' wrench (N, J, 6) in each piece, of demands shaped alike, after the input
    effects."""
    if not acting.inputs.any():
        return demands
    wrenches = demands.copy()
    for begin, rows in _records(steps.piece_begin):
        effects, t = on_clock(acting, begin), steps.piece_t[rows.start : rows.stop + 1] - begin
        for wrench in wrenches:
            _thrust(effects, memory(), t, steps.anew[rows], wrench[rows])
    return wrenches


def shoot(
    each: Sequence[Equations],
    steps: Steps,
    wrench: Array,
    first: Indices,
    last: Indices,
    start: Array,
) -> Motion:
    """Integrate each window from node ``first`` to ``last`` (W,), beginning at start (W, 6), by the
    equations that hold in its record."""
    k = wrench.shape[1]
    zeros = [np.zeros(shape) for shape in 2 * [(k, 6)] + 2 * [(k, 6, 6)]]
    motion = Motion(np.full((k + 1, 6), np.nan), *zeros)
    for eq, (begin, rows) in zip(each, _records(steps.begin), strict=True):
        mine = slice(*np.searchsorted(first, [rows.start, rows.stop]))
        _shoot(
            on_clock(eq.acting, begin), eq.structure, eq.mass, eq.added, eq.inverse,
            eq.theta, np.repeat(eq.theta, _LANES, axis=1), eq.restoring,
            steps._replace(t=steps.t - begin), wrench, first[mine], last[mine], start[mine],
            np.zeros(1, _SCRATCH), motion,
        )  # fmt: skip
    return motion


def _records(begin: Array) -> Iterator[tuple[float, slice]]:
    """When each record begins [s], and which rows are its own, of which each says when that was."""
    edges = np.flatnonzero(np.diff(begin, prepend=np.nan, append=np.nan) != 0.0).tolist()
    for first, last in pairwise(edges):
        yield float(begin[first]), slice(first, last)


def tangent(
    motion: Motion, first: Indices, last: Indices, nodes: Indices, force: Array | None = None
) -> Array:
    """Sensitivities (N, 6, P) at ``nodes`` (N,) to each column of wrenches (K, 6, P); without, to
    the start of the window (N, 6, 6)."""
    begin = np.eye(6) if force is None else np.zeros((6, force.shape[2]))
    force = None if force is None else np.ascontiguousarray(force)
    out, work = np.zeros((len(nodes), *begin.shape)), np.empty((2, *begin.shape))
    _tangent(motion.phi, motion.gamma, first, last, force, begin, nodes, work, out)
    return out


def adjoint(motion: Motion, first: Indices, last: Indices, error: Array, nodes: Indices) -> Array:
    """The transpose of :func:`tangent`: errors (N, 6) at the nodes to wrenches (K, 6)."""
    out = np.zeros((len(motion.middle), 6))
    _adjoint(motion.phi, motion.gamma, first, last, error, nodes, np.empty((2, 6)), out)
    return out


def regressors(eq: Equations, steps: Steps, motion: Motion) -> Array:
    """What a unit of each coefficient adds to the wrench side of the equations, (K, 6, n)."""
    n, extended = len(eq.theta), np.empty((EXTENDED_SIZE, 1))
    out, work = np.empty((len(motion.middle), 6, n)), np.empty((3, 6, n))
    _regressors(eq.structure, motion.middle, motion.nu_dot, steps.inputs, work, extended, out)
    return out


def wrenches(eq: Equations, steps: Steps, thrust: Array, motion: Motion) -> Array:
    """Wrench effects and current (K, 6) along a motion; ``thrust`` (K, 6) is of the thrusters."""
    out = np.zeros((len(motion.middle), 6))
    for begin, rows in _records(steps.begin):
        _wrenches(
            on_clock(eq.acting, begin), eq.structure, eq.added, eq.theta,
            steps.t[rows.start : rows.stop + 1] - begin, steps.position[rows], steps.middle[rows],
            steps.inputs[rows], thrust[rows], motion.middle[rows], np.zeros(1, CURRENT), out[rows],
        )  # fmt: skip
    return out


@released
def _thrust(acting, state, t, anew, wrench):
    for k in range(len(wrench)):
        if anew[k]:
            state[:] = 0.0
        act(acting, state, t[k], t[k + 1] - t[k], wrench[k])


@released
def _means(piece_t, wrench, t, piece, out):
    for k in range(len(piece)):
        end = piece[k + 1] if k + 1 < len(piece) else len(wrench)
        middle, length = 0.5 * (t[k] + t[k + 1]), t[k + 1] - t[k]
        for j in range(piece[k], end):
            share = (piece_t[j + 1] - piece_t[j]) / length
            late = 0.5 * (piece_t[j] + piece_t[j + 1]) - middle
            for i in range(6):
                out[0, k, i] += share * wrench[j, i]
                out[1, k, i] += 12.0 / length**2 * share * late * wrench[j, i]


@released
def _wrenches(
    acting, structure, added, theta, t, position, middle, inputs, thrust, nu, scratch, out
):  # fmt: skip
    s = scratch[0]
    for k in range(len(nu) if surrounds(acting) else 0):
        now = 0.5 * (t[k] + t[k + 1])
        extend_inputs(1, structure, inputs[k], s.extended)
        add_surroundings(
            acting, structure, added, theta, now, position[k], nu[k], middle[k],
            thrust[k], s, out[k],
        )  # fmt: skip


_LANES = 8  # six axes, none, and one more to fill the vectors

_SCRATCH = record(
    [
        # wrench of the thrusters, and of weight and effects; nu at both ends of the step
        *floats((6,), "thrust push velocity begin end"),
        ("slope", "f8", (4, 6)),  # of Runge and Kutta's stages
        *floats((6, 1), "nu h"),
        *floats((6, 6, 1), "mass inverse"),
        ("extended", "f8", (EXTENDED_SIZE, 1)),
        *floats((6, _LANES), "nearby nearby_h"),
        ("nearby_mass", "f8", (6, 6, _LANES)),
        ("nearby_extended", "f8", (EXTENDED_SIZE, _LANES)),
        *floats((6, 6), "by_velocity jacobian work held"),
        ("current", CURRENT),
    ]
)


@inner
def _acceleration(
    acting, surrounded, structure, added, theta, restoring, t, position, rotation, given, s, out
):
    """nu_dot (6,) at s.nu into out, ``given`` on guided axes; s.push (6,) is the thrusters'."""
    for i in range(6):
        s.velocity[i], s.thrust[i] = s.nu[i, 0], s.push[i]
        for j in range(3):
            s.push[i] += restoring[i, j] * rotation[2, j]
    if surrounded:
        add_surroundings(
            acting, structure, added, theta, t, position, s.velocity, rotation, s.thrust,
            s.current, s.push,
        )  # fmt: skip
    h = s.h
    generalized_force(1, structure, s.mass, theta, s.nu, h, s.extended)
    for i in range(6):
        h[i, 0] = s.push[i] - h[i, 0]
    for j in range(len(given)):
        for i in range(6):
            h[i, 0] -= s.mass[i, j, 0] * given[j]
    nu_dot = symmetric_product(s.inverse, six(h, 0), 0)
    for i in range(6):
        out[i] = nu_dot[i]
    for i in range(len(given)):
        out[i] += given[i]


@inner
def _differentiate(
    acting, surrounded, structure, added, theta, wide, t, position, rotation, s
):  # fmt: skip
    """s.by_velocity (6, 6): the derivative of the wrench on the vehicle by its velocity s.nu. Lane
    j is a little faster along axis j, the last along none; ``wide`` (n, _LANES) is theta in each,
    s.thrust (6,) what the thrusters give.
    """
    nearby, h, last = s.nearby, s.nearby_h, _LANES - 1
    for i in range(6):
        for k in range(_LANES):
            nearby[i, k] = s.nu[i, 0]
        nearby[i, i] += _NEARBY
    generalized_force(_LANES, structure, s.nearby_mass, wide, nearby, h, s.nearby_extended)
    if surrounded:
        for k in (0, 1, 2, 3, 4, 5, last):
            for i in range(6):
                s.velocity[i], s.push[i] = nearby[i, k], 0.0
            add_surroundings(
                acting, structure, added, theta, t, position, s.velocity, rotation, s.thrust,
                s.current, s.push,
            )  # fmt: skip
            for i in range(6):
                h[i, k] -= s.push[i]
    for i in range(6):
        for j in range(6):
            s.by_velocity[i, j] = (h[i, last] - h[i, j]) / _NEARBY


@inner
def _advance(inverse, dt, s, phi, gamma):
    """How a change of nu and of the wrench reaches the end of a step, phi and gamma (6, 6)."""
    multiply(inverse, s.by_velocity, dt, s.jacobian)
    linear_step(s.jacobian, s.work, phi, s.held)
    multiply(s.held, inverse, dt, gamma)


@released
def _shoot(
    acting, structure, mass, added, inverse, theta, wide, restoring, steps, wrench, first, last,
    start, scratch, motion,
):  # fmt: skip
    s, surrounded = scratch[0], surrounds(acting)
    for i in range(6):
        for j in range(6):
            s.mass[i, j, 0], s.inverse[i, j, 0] = mass[i, j, 0], inverse[i, j]
            for k in range(_LANES):
                s.nearby_mass[i, j, k] = mass[i, j, 0]
    slope, nu, given = s.slope, s.end, s.end[:0]
    node, rotations, middles, guided = steps.t, steps.rotation, steps.middle, steps.given
    inputs, position = steps.inputs, steps.position
    reached, halfway, nu_dots = motion.nu, motion.middle, motion.nu_dot
    phi, gamma = motion.phi, motion.gamma
    for w in range(len(first)):
        for i in range(6):
            nu[i] = reached[first[w], i] = start[w, i]
        for k in range(first[w], last[w]):
            t, dt = node[k], node[k + 1] - node[k]
            extend_inputs(1, structure, inputs[k], s.extended)
            extend_inputs(1, structure, inputs[k], s.current.extended)
            extend_inputs(_LANES, structure, inputs[k], s.nearby_extended)
            if len(guided) > 0:
                given = guided[k]
            for i in range(6):
                s.nu[i, 0] = s.begin[i] = nu[i]
            for stage in range(4):
                ahead = NODES[stage] * dt
                for i in range(6):
                    s.push[i] = wrench[0, k, i] + (ahead - 0.5 * dt) * wrench[1, k, i]
                rotation = middles[k]
                if stage == 0:
                    rotation = rotations[k]
                elif stage == 3:
                    rotation = rotations[k + 1]
                _acceleration(
                    acting, surrounded, structure, added, theta, restoring, t + ahead, position[k],
                    rotation, given, s, slope[stage],
                )  # fmt: skip
                runge_kutta(stage, dt, s.begin, slope[stage], s.nu[:, 0], nu)
            worst = 0.0
            for i in range(6):
                worst = max(worst, abs(nu[i]))
                half = 0.5 * (s.begin[i] + nu[i])  # of a cubic
                half += 0.125 * dt * (slope[0, i] - slope[3, i])
                reached[k + 1, i], halfway[k, i], s.nu[i, 0] = nu[i], half, half
                s.push[i] = wrench[0, k, i]
            t += 0.5 * dt
            _acceleration(
                acting, surrounded, structure, added, theta, restoring, t, position[k], middles[k],
                given, s, nu_dots[k],
            )  # fmt: skip
            _differentiate(
                acting, surrounded, structure, added, theta, wide, t, position[k], middles[k], s
            )
            _advance(inverse, dt, s, phi[k], gamma[k])
            if not worst < 50.0:  # no vehicle moves so; NaN too
                for n in range(k + 1, last[w] + 1):
                    for i in range(6):
                        reached[n, i] = np.nan
                break


@released
def _tangent(phi, gamma, first, last, force, begin, nodes, work, out):
    """work (2, 6, P)."""
    now, new = work[0], work[1]
    n = 0
    for w in range(len(first)):
        copy(begin, now)
        while n < len(nodes) and nodes[n] < first[w]:
            n += 1
        for k in range(first[w], last[w] + 1):
            if n < len(nodes) and nodes[n] == k:
                copy(now, out[n])
                n += 1
            if k == last[w]:
                break
            for i in range(6):
                for c in range(begin.shape[1]):
                    new[i, c] = 0.0
                for j in range(6):
                    f, g = phi[k, i, j], gamma[k, i, j]
                    for c in range(begin.shape[1]):
                        if force is None:  # numba leaves out what is not so
                            new[i, c] += f * now[j, c]
                        else:
                            new[i, c] += f * now[j, c] + g * force[k, j, c]
            copy(new, now)


@released
def _adjoint(phi, gamma, first, last, error, nodes, work, out):
    """work (2, 6)."""
    mu, before = work[0], work[1]
    n = len(nodes) - 1
    for w in range(len(first) - 1, -1, -1):
        for i in range(6):
            mu[i] = 0.0
        for k in range(last[w], first[w] - 1, -1):
            while n >= 0 and nodes[n] > k:
                n -= 1
            if n >= 0 and nodes[n] == k:
                for i in range(6):
                    mu[i] += error[n, i]
            if k > first[w]:
                for i in range(6):
                    before[i], out[k - 1, i] = 0.0, 0.0
                for j in range(6):
                    for i in range(6):
                        before[i] += phi[k - 1, j, i] * mu[j]
                        out[k - 1, i] += gamma[k - 1, j, i] * mu[j]
                for i in range(6):
                    mu[i] = before[i]


@released
def _regressors(structure, nu, nu_dot, inputs, work, extended, out):
    """work (3, 6, n)."""
    of_nu_dot, momentum, force = work[0], work[1], work[2]
    for k in range(len(nu)):
        momentum_columns(structure, nu_dot[k], of_nu_dot)
        extend_inputs(1, structure, inputs[k], extended)
        columns(structure, nu[k], momentum, force, extended)
        for i in range(6):
            for j in range(out.shape[2]):
                out[k, i, j] = -of_nu_dot[i, j] - force[i, j]
