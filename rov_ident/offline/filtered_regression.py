"""Rows of the filtered regression, without measuring an acceleration.

With every channel through one low-pass filter F and s F[P] for the filtered derivative of a
momentum P, the equations of motion are linear in the coefficients and hold no acceleration::

    y = F[tau - known],   Phi = s F[P] + F[H],   y = Phi theta + noise

P and H: momentum and force per unit of each coefficient (`columns`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.config.prior import prior_of
from rov_ident.core.jit import inlined, kernel
from rov_ident.estimation.wrench_residual import first_order, of_wrench, two_stages
from rov_ident.model.coefficients import EXTENDED_SIZE
from rov_ident.model.equations import Array, Structure, columns, coriolis_of, extend_inputs


class Regression(NamedTuple):
    """What the rows are made with: about the prior's mean, in prior standard deviations.

    corner [rad/s] of the filter; theta (m,) of all coefficients, ``estimated`` (n,) indices into
    it, scale (n,) the prior standard deviations.
    """

    corner: float
    structure: Structure
    estimated: NDArray[np.int64]
    theta: Array
    scale: Array
    rigid_body: Array
    restoring: Array


def regression(config: Config, corner: float = 3.0) -> Regression:
    """The regression that a configuration asks for."""
    model, prior = config.dynamics, prior_of(config)
    return Regression(
        corner,
        model.structure,
        prior.estimated,
        model.theta,
        prior.std,
        model.body.mass_matrix,
        model.body.restoring,
    )


def filtered_rows(
    task: Regression, samples: NDArray[np.void], period: float
) -> tuple[Array, Array]:
    """[Phi y] (K, 6, n + 1) of samples (k,) of SAMPLE, and their times (K,) [s]: each at the first
    sample ``period`` s after the one before, so further apart where samples are. Gaps begin anew.
    """
    out = np.empty((int(samples["dt"].sum() / period) + 2, 6, len(task.scale) + 1))
    t = np.empty(len(out))
    used = _rows(task, samples, period, out, t)
    return out[:used], t[:used]


def spacing_of(t: Array) -> float:
    """Seconds between rows at t (K,), without gaps; of less than two NaN."""
    return float(np.median(np.diff(t))) if len(t) > 1 else np.nan


@kernel
def _rows(task, samples, period, out, times):
    n, m = len(task.scale), len(task.theta)
    momentum, force, p = np.empty((6, m)), np.empty((6, m)), np.empty(6)
    extended = np.empty((EXTENDED_SIZE, 1))
    now, rate = np.empty((6, n + 1)), np.empty((6, n + 1))  # P, and w P - H
    filters, w, used, started, since = np.zeros((6, 4, n + 1)), task.corner, 0, False, 0.0
    for k in range(len(samples)):
        sample = samples[k]
        _regress(task, sample, momentum, force, extended, p, now, rate)
        restarted = sample.restart or not started or not sample.dt > 0.0
        response = first_order(w, sample.dt)
        for i in range(6):
            wrench = of_wrench(response, sample.dt, sample.wrench[i], sample.wrench_slope[i])
            for j in range(n + 1):
                known = wrench if j == n else 0.0
                two_stages(filters[i], j, w, response, restarted, rate[i, j], now[i, j], known)
        started, since = True, 0.0 if restarted else since + sample.dt
        if since >= period - 1e-6:
            for i in range(6):
                for j in range(n):
                    out[used, i, j] = -filters[i, 1, j]
                out[used, i, n] = filters[i, 1, n]
            times[used] = sample.t
            used += 1
            since = 0.0
    return used


@inlined
def _regress(task, sample, momentum, force, extended, p, now, rate):
    """now: momenta, rate: corner * momentum - force; the last column is what is known."""
    n, w, nu = len(task.scale), task.corner, sample.nu
    extend_inputs(1, task.structure, sample.inputs[1], extended)
    columns(task.structure, nu, momentum, force, extended)
    for i in range(6):
        p[i] = 0.0
        for j in range(6):
            p[i] += task.rigid_body[i, j] * nu[j]
    h = coriolis_of(
        (p[0], p[1], p[2], p[3], p[4], p[5]), (nu[0], nu[1], nu[2], nu[3], nu[4], nu[5])
    )
    for i in range(6):
        known_momentum, known_force = p[i], h[i]
        for j in range(3):
            known_force -= task.restoring[i, j] * sample.down[j]
        for j in range(len(task.theta)):
            known_momentum += momentum[i, j] * task.theta[j]
            known_force += force[i, j] * task.theta[j]
        for j in range(n):
            e = task.estimated[j]
            now[i, j] = momentum[i, e] * task.scale[j]
            rate[i, j] = w * now[i, j] - force[i, e] * task.scale[j]
        now[i, n] = known_momentum
        rate[i, n] = w * known_momentum - known_force
