"""Open-loop simulation of the equations of motion."""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.attitude import rotation
from rov_ident.errors import UserError
from rov_ident.jit import kernel
from rov_ident.model import Array, Model, generalized_force

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
    model: Model,
    t: Array,
    wrench: Array,
    nu: Array | None = None,
    position: Array | None = None,
    orientation: Array | None = None,
    wrench_slope: Array | None = None,
    guide: Guide | None = None,
) -> Trajectory:
    """Integrate from the first instant of ``t`` (N,), the wrench (N, 6) held from each to the next.

    nu (6,), position (3,) and orientation (4,) are the state at ``t[0]``: at rest, at the origin
    and level by default. ``wrench_slope`` (N, 6) lets the wrench change linearly in each interval
    about its mean. With a ``guide`` only some components are simulated, the others follow it.

    Raises
    ------
    UserError
        If shapes do not fit, or if the motion does not stay finite: no vehicle moves as this model
        says.
    """
    n = len(t)
    if n == 0 or np.shape(wrench) != (n, 6):
        raise UserError(f"{n} instants need a wrench ({n}, 6), not {np.shape(wrench)}")
    out = np.empty((n, 19))
    if guide is None:
        guide = Guide(np.ones(6, dtype=bool), np.zeros((n, 6)), np.zeros((n, 4)))
    free = np.flatnonzero(guide.free)
    inverse = np.zeros((6, 6))
    inverse[np.ix_(free, free)] = np.linalg.inv(model.mass_matrix[np.ix_(free, free)])
    _simulate(
        model.structure,
        model.mass_matrix.reshape(6, 6, 1),
        inverse,
        model.theta.reshape(-1, 1),
        model.body.restoring,
        np.ascontiguousarray(t, dtype=float),
        np.ascontiguousarray(wrench, dtype=float),
        np.zeros((n, 6)) if wrench_slope is None else np.ascontiguousarray(wrench_slope),
        guide.free,
        np.ascontiguousarray(guide.nu),
        np.ascontiguousarray(guide.orientation),
        np.concatenate(
            [
                np.zeros(3) if position is None else position,
                [1.0, 0.0, 0.0, 0.0] if orientation is None else orientation,
                np.zeros(6) if nu is None else nu,
            ]
        ),
        MAX_STEP,
        out,
    )
    finite = np.isfinite(out).all(axis=1)
    if not finite.all():
        raise UserError(
            f"the simulation diverges {t[np.argmin(finite)] - t[0]:.1f} s after its start: "
            "check the signs and sizes of the coefficients and of the wrench"
        )
    return Trajectory(np.asarray(t), out[:, :3], out[:, 3:7], out[:, 7:13], out[:, 13:])


def open_loop(
    model: Model,
    t: Array,
    wrench: Array,
    nu: Array,
    orientation: Array,
    horizon: float,
    wrench_slope: Array | None = None,
    free: NDArray[np.bool_] | None = None,
) -> Array:
    """Velocities (N, 6) predicted open loop over windows of ``horizon`` seconds.

    Each window starts from the measured ``nu`` (N, 6) and ``orientation`` (N, 4) at its first
    sample; rows whose prediction has left all reason (a diverging model) hold infinity. Components
    not marked in ``free`` (6,) follow the measurement.
    """
    free = np.ones(6, dtype=bool) if free is None else free
    slope = np.zeros_like(wrench) if wrench_slope is None else wrench_slope
    predicted = np.empty((len(t), 6))
    edges = np.append(np.flatnonzero(np.diff(np.floor((t - t[0]) / horizon), prepend=-1.0)), len(t))
    for first, end in pairwise(edges):
        window = slice(first, end)
        try:
            run = simulate(
                model,
                t[window],
                wrench[window],
                nu[first],
                None,
                orientation[first],
                slope[window],
                Guide(free, nu[window], orientation[window]),
            )
            predicted[window] = run.nu
        except UserError:
            predicted[window] = np.inf
    return predicted


# ------------------------------------------------------------------ kernels


@kernel
def _derivative(
    structure, mass, inverse, theta, restoring, wrench, slope, late, free, pace, state, rate, work
):
    """rate (13,) of state (13,) = position, quaternion, nu; work (31, 1) is scratch.

    The wrench is its mean plus ``late`` seconds of its slope; components that are not free change
    at ``pace`` (6,), whatever it takes.
    """
    h, p, extended = work[:6], work[6:12], work[12:25]
    nu = work[25:31]
    for i in range(6):
        nu[i, 0] = state[7 + i]
    generalized_force(1, structure, mass, theta, nu, h, p, extended)
    r = rotation(state[3:7])
    for i in range(6):
        h[i, 0] = wrench[i] + late * slope[i] - h[i, 0]
        for j in range(3):
            h[i, 0] += restoring[i, j] * r[2, j]
        for j in range(6):
            if not free[j]:
                h[i, 0] -= mass[i, j, 0] * pace[j]
    for i in range(6):
        rate[7 + i] = 0.0 if free[i] else pace[i]
        for j in range(6):
            rate[7 + i] += inverse[i, j] * h[j, 0]
    for i in range(3):
        rate[i] = r[i, 0] * state[7] + r[i, 1] * state[8] + r[i, 2] * state[9]
    # q_dot = q (0, omega) / 2
    w, x, y, z = state[3], state[4], state[5], state[6]
    a, b, c = 0.5 * state[10], 0.5 * state[11], 0.5 * state[12]
    rate[3] = -x * a - y * b - z * c
    rate[4] = w * a + y * c - z * b
    rate[5] = w * b + z * a - x * c
    rate[6] = w * c + x * b - y * a


@kernel
def _simulate(
    structure, mass, inverse, theta, restoring, t, wrench, wrench_slope, free, guide, attitude,
    start, max_step, out,
):  # fmt: skip
    """Classical Runge-Kutta; out (N, 19): position, quaternion, nu, nu_dot.

    nu_dot is that under the wrench which begins to act at the instant.
    """
    state, stage, slope = start.copy(), np.empty(13), np.empty((4, 13))
    work, pace = np.empty((31, 1)), np.zeros(6)
    span = 0.0
    for i in range(len(t)):
        last = i + 1 == len(t)
        if not last:
            span = t[i + 1] - t[i]
        for j in range(6):
            if not free[j]:
                state[7 + j] = guide[i, j]
                if not last:  # at the last instant the pace of the last interval goes on
                    pace[j] = (guide[i + 1, j] - guide[i, j]) / span
                if j >= 3:
                    state[3:7] = attitude[i]
        steps = max(1, int(np.ceil(span / max_step - 1e-9)))
        dt = span / steps
        for n in range(steps):
            for s in range(4):
                share = 0.0 if s == 0 else (1.0 if s == 3 else 0.5)
                for j in range(13):
                    stage[j] = state[j] + share * dt * slope[s - 1, j] if s > 0 else state[j]
                late = (n + share) * dt - 0.5 * span
                _derivative(
                    structure, mass, inverse, theta, restoring, wrench[i], wrench_slope[i], late,
                    free, pace, stage, slope[s], work,
                )  # fmt: skip
                if n == 0 and s == 0:
                    for j in range(13):
                        out[i, j] = state[j]
                    for j in range(6):
                        out[i, 13 + j] = slope[0, 7 + j]
                    if last:
                        return
            for j in range(13):
                state[j] += (
                    dt / 6.0 * (slope[0, j] + 2.0 * (slope[1, j] + slope[2, j]) + slope[3, j])
                )
            length = np.sqrt(state[3] ** 2 + state[4] ** 2 + state[5] ** 2 + state[6] ** 2)
            for j in range(3, 7):
                state[j] /= length
