"""Output error over short windows (multiple shooting), with its sensitivities.

Each window starts from a velocity of its own, which is estimated with the parameters and eliminated
(it is a nuisance). Inside, the velocity is integrated from the equations of motion; the attitude
is taken as measured. Sensitivities solve the linearised equations along that motion::

    d(nu)[k+1] = Phi[k] d(nu)[k] + Gamma[k] dF[k]

for any change dF of the wrench, so that a hundred candidate causes cost little more than one.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.coefficients import EXTENDED_SIZE
from rov_ident.effects import Acting, act, add_wrenches, memory
from rov_ident.jit import kernel
from rov_ident.model import Array, Model, Structure, columns, current_wrench, generalized_force

Indices = NDArray[np.int64]


class Steps(NamedTuple):
    """The time axis: steps k = 0 .. K - 1 from node k to node k + 1.

    The demand is held over pieces; the pieces of step k begin at ``piece[k]``.
    """

    t: Array  # (K + 1,) s
    rotation: Array  # (K + 1, 3, 3), body -> world
    middle: Array  # (K, 3, 3), half-way through the step
    piece_t: Array  # (J + 1,) s
    demand: Array  # (J, 6)
    piece: Indices  # (K,)
    given: Array  # (K, 6) accelerations that guided axes are measured to have, else 0; or (0, 6)


class Equations(NamedTuple):
    """The equations of motion as the kernels take them."""

    structure: Structure
    mass: Array  # (6, 6, 1)
    added: Array  # (6, 6)
    inverse: Array  # (6, 6); zeros in the rows and columns of axes that are guided
    theta: Array  # (n,)
    restoring: Array  # (6, 3)
    acting: Acting


class Motion(NamedTuple):
    """A shot through all windows; rows outside every window hold nothing of meaning."""

    nu: Array  # (K + 1, 6) at the nodes
    middle: Array  # (K, 6) half-way through each step
    pace: Array  # (K, 6) its derivative there
    phi: Array  # (K, 6, 6)
    gamma: Array  # (K, 6, 6)


def equations(model: Model, acting: Acting) -> Equations:
    mass = model.mass_matrix
    return Equations(
        model.structure,
        np.ascontiguousarray(mass[:, :, None]),
        np.ascontiguousarray(mass - model.body.mass_matrix),
        np.asarray(np.linalg.inv(mass), dtype=np.float64),
        np.ascontiguousarray(model.theta),
        model.body.restoring,
        acting,
    )


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
    wrench = steps.demand.copy()
    if acting.inputs.any():
        _thrust(acting, memory(), steps.piece_t, wrench)
    share = np.diff(steps.piece_t)[:, None] * wrench
    length = np.diff(steps.t)[:, None]
    mean = np.add.reduceat(share, steps.piece) / length
    middle = 0.5 * (steps.piece_t[1:] + steps.piece_t[:-1])
    late = middle - np.repeat(
        0.5 * (steps.t[1:] + steps.t[:-1]), np.diff(np.append(steps.piece, len(wrench)))
    )
    slope = 12.0 / length**3 * np.add.reduceat(share * late[:, None], steps.piece)
    return np.stack([mean, slope])


def shoot(
    eq: Equations, steps: Steps, wrench: Array, first: Indices, last: Indices, start: Array
) -> Motion:
    """Integrate each window from node ``first`` to ``last`` (W,), beginning at start (W, 6)."""
    k = wrench.shape[1]
    motion = Motion(
        np.full((k + 1, 6), np.nan),
        np.zeros((k, 6)),
        np.zeros((k, 6)),
        np.zeros((k, 6, 6)),
        np.zeros((k, 6, 6)),
    )
    _shoot(eq, steps, wrench, first, last, start, motion)
    return motion


def tangent(
    motion: Motion, first: Indices, last: Indices, force: Array, nodes: Indices
) -> tuple[Array, Array]:
    """Sensitivities at ``nodes`` (N,): (N, 6, P) to each column of wrenches (K, 6, P), and
    (N, 6, 6) to the start of the window."""
    p = force.shape[2]
    out, start = np.zeros((len(nodes), 6, p)), np.zeros((len(nodes), 6, 6))
    _tangent(motion.phi, motion.gamma, first, last, np.ascontiguousarray(force), nodes, out, start)
    return out, start


def adjoint(motion: Motion, first: Indices, last: Indices, error: Array, nodes: Indices) -> Array:
    """The transpose of :func:`tangent`: errors (N, 6) at the nodes to wrenches (K, 6)."""
    out = np.zeros((len(motion.middle), 6))
    _adjoint(motion.phi, motion.gamma, first, last, error, nodes, out)
    return out


def regressors(eq: Equations, motion: Motion) -> Array:
    """What a unit of each coefficient adds to the wrench side of the equations, (K, 6, n)."""
    out = np.empty((len(motion.middle), 6, len(eq.theta)))
    _regressors(eq.structure, motion.middle, motion.pace, out)
    return out


def wrenches(eq: Equations, steps: Steps, motion: Motion) -> Array:
    """Wrench effects and current (K, 6) along a motion."""
    out = np.zeros((len(motion.middle), 6))
    _wrenches(eq, steps, motion.middle, out)
    return out


# ------------------------------------------------------------------ kernels


@kernel
def _thrust(acting, state, t, wrench):
    for k in range(len(wrench)):
        act(acting, state, t[k], t[k + 1] - t[k], wrench[k])


@kernel
def _beyond(eq, t, nu, rotation, out):
    """Add to out (6,) the wrench of effects and current."""
    water = np.zeros(3)
    moving = eq.acting.water[0] != 0.0 or eq.acting.water[1] != 0.0 or eq.acting.water[2] != 0.0
    relative = nu.copy()
    if moving:
        for i in range(3):
            for j in range(3):
                water[i] += rotation[j, i] * eq.acting.water[j]
            relative[i] -= water[i]
        extra = current_wrench(eq.structure, eq.added, eq.theta, nu, water)
        for i in range(6):
            out[i] += extra[i]
    add_wrenches(eq.acting, t, relative, rotation, out)


@kernel
def _wrenches(eq, steps, nu, out):
    for k in range(len(nu)):
        _beyond(eq, 0.5 * (steps.t[k] + steps.t[k + 1]), nu[k], steps.middle[k], out[k])


@kernel
def _pace(eq, t, nu, rotation, wrench, given, out, work):
    """nu_dot (6,) into out, ``given`` on guided axes; work (6 + EXTENDED_SIZE, 1) is scratch."""
    h, extended = work[:6], work[6:]
    theta = eq.theta.reshape(-1, 1)
    generalized_force(1, eq.structure, eq.mass, theta, nu.reshape(6, 1), h, extended)
    total = np.empty(6)
    for i in range(6):
        total[i] = wrench[i] - h[i, 0]
        for j in range(3):
            total[i] += eq.restoring[i, j] * rotation[2, j]
    _beyond(eq, t, nu, rotation, total)
    if given.any():
        for i in range(6):
            for j in range(6):
                total[i] -= eq.mass[i, j, 0] * given[j]
    for i in range(6):
        out[i] = given[i]
        for j in range(6):
            out[i] += eq.inverse[i, j] * total[j]


@kernel
def _shoot(eq, steps, wrench, first, last, start, motion):
    work = np.empty((6 + EXTENDED_SIZE, 1))
    a, b, c, d, nearby = np.empty(6), np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    jacobian, square, given = np.empty((6, 6)), np.empty((6, 6)), np.zeros(6)
    for w in range(len(first)):
        nu = start[w].copy()
        for i in range(6):
            motion.nu[first[w], i] = nu[i]
        for k in range(first[w], last[w]):
            t, dt = steps.t[k], steps.t[k + 1] - steps.t[k]
            if len(steps.given) > 0:
                given = steps.given[k]
            tau, trend, middle = wrench[0, k], 0.5 * dt * wrench[1, k], steps.middle[k]
            _pace(eq, t, nu, steps.rotation[k], tau - trend, given, a, work)
            _pace(eq, t + 0.5 * dt, nu + 0.5 * dt * a, middle, tau, given, b, work)
            _pace(eq, t + 0.5 * dt, nu + 0.5 * dt * b, middle, tau, given, c, work)
            _pace(eq, t + dt, nu + dt * c, steps.rotation[k + 1], tau + trend, given, d, work)
            half = motion.middle[k]
            for i in range(6):
                begin = nu[i]
                nu[i] += dt / 6.0 * (a[i] + 2.0 * (b[i] + c[i]) + d[i])
                half[i] = 0.5 * (begin + nu[i]) + 0.125 * dt * (a[i] - d[i])  # cubic
            _pace(eq, t + 0.5 * dt, half, middle, tau, given, b, work)
            motion.pace[k] = b
            for j in range(6):
                nearby[:] = half
                nearby[j] += 1e-4
                _pace(eq, t + 0.5 * dt, nearby, middle, tau, given, c, work)
                for i in range(6):
                    jacobian[i, j] = (c[i] - b[i]) / 1e-4 * dt
            square[:] = jacobian @ jacobian
            for i in range(6):
                for j in range(6):
                    unit = 1.0 if i == j else 0.0
                    motion.phi[k, i, j] = unit + jacobian[i, j] + 0.5 * square[i, j]
                    square[i, j] = unit + 0.5 * jacobian[i, j] + square[i, j] / 6.0
            motion.gamma[k] = square @ eq.inverse * dt
            worst = 0.0
            for i in range(6):
                worst = max(worst, abs(nu[i]))
                motion.nu[k + 1, i] = nu[i]
            if not worst < 50.0:  # no vehicle moves so; NaN too
                motion.nu[k + 1 : last[w] + 1] = np.nan
                break


@kernel
def _tangent(phi, gamma, first, last, force, nodes, out, start):
    p = force.shape[2]
    now, new = np.zeros((6, p)), np.zeros((6, p))
    begin, moved = np.zeros((6, 6)), np.zeros((6, 6))
    n = 0
    for w in range(len(first)):
        now[:] = 0.0
        for i in range(6):
            for j in range(6):
                begin[i, j] = 1.0 if i == j else 0.0
        while n < len(nodes) and nodes[n] < first[w]:
            n += 1
        for k in range(first[w], last[w] + 1):
            if n < len(nodes) and nodes[n] == k:
                out[n] = now
                start[n] = begin
                n += 1
            if k == last[w]:
                break
            new[:] = 0.0
            for i in range(6):
                for j in range(6):
                    f, g = phi[k, i, j], gamma[k, i, j]
                    for c in range(p):
                        new[i, c] += f * now[j, c] + g * force[k, j, c]
            now[:] = new
            moved[:] = phi[k] @ begin
            begin[:] = moved


@kernel
def _adjoint(phi, gamma, first, last, error, nodes, out):
    n = len(nodes) - 1
    for w in range(len(first) - 1, -1, -1):
        mu = np.zeros(6)
        for k in range(last[w], first[w] - 1, -1):
            while n >= 0 and nodes[n] > k:
                n -= 1
            if n >= 0 and nodes[n] == k:
                mu += error[n]
            if k > first[w]:
                out[k - 1] = gamma[k - 1].T @ mu
                mu = phi[k - 1].T @ mu


@kernel
def _regressors(structure, nu, pace, out):
    n = out.shape[2]
    momentum, force, other = np.empty((6, n)), np.empty((6, n)), np.empty((6, n))
    for k in range(len(nu)):
        columns(structure, pace[k], momentum, force)
        columns(structure, nu[k], other, force)
        for i in range(6):
            for j in range(n):
                out[k, i, j] = -momentum[i, j] - force[i, j]
