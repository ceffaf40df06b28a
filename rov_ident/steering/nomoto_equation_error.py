"""Nomoto's model by its equation in forward differences."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array
from rov_ident.steering.nomoto_model import Nomoto, Structure, first_state, model_of, respond
from rov_ident.steering.nomoto_output_error import robust_covariance
from rov_ident.steering.zigzag import Zigzag


def equation_error(runs: Sequence[Zigzag], model: Nomoto, method: str) -> Nomoto:
    """The equation in forward differences: least squares, instruments, or recursive.

    First order, h the step, D the forward difference over h::

        D^2 psi / h^2 = b0 (delta - delta_0) - a0 D psi / h - c (D psi / h)^3

    all at t; second order one difference more. ``b0 delta_0`` is the constant column.
    """
    structure = model.structure
    even = [_evenly(run) for run in runs]
    parts = [_rows(run.t, run.heading, run.rudder, structure) for run in even]
    y = np.concatenate([p[0] for p in parts])
    x = np.vstack([p[1] for p in parts])
    if len(y) < 4 * x.shape[1]:
        raise UserError(f"{len(y)} equations for {x.shape[1]} unknowns: give a longer run")
    solution = np.linalg.lstsq(x, y, rcond=None)[0]
    z = x
    if method == "iv":
        # The instruments are the regressors of a simulated heading, which noise has not touched.
        theta = model.theta
        for _ in range(30):
            blocks: list[Array] = []
            for run in even:
                heading = respond(structure, theta, run, *first_state(structure, theta, run))
                blocks.append(_rows(run.t, heading, run.rudder, structure)[1])
            z = np.vstack(blocks)
            if not np.abs(z).max() < 1e5:
                raise UserError(
                    "the instruments diverge: the noise is too strong for `iv`; use `oe`"
                )
            new = np.linalg.solve(z.T @ x, z.T @ y)
            moved = np.abs(new - solution).max() / np.abs(new).max()
            solution = new
            theta = _from_solution(solution, structure)
            if moved < 1e-8:
                break
    elif method == "rls":
        solution = recursive(y, x)[-1]
    error = y - x @ solution
    # The sandwich of instruments: (Z'X)^-1 S (X'Z)^-1.
    inverse = np.linalg.pinv(z.T @ x)
    core = robust_covariance(z, error, [len(p[0]) for p in parts])
    square = z.T @ z
    covariance = inverse @ square @ core @ square @ inverse.T
    theta = _from_solution(solution, structure)
    jacobian = np.eye(len(theta))  # of the last alone, delta_0 = (b0 delta_0) / b0
    b0 = structure.names.index("b0")
    jacobian[-1, -1], jacobian[-1, b0] = 1.0 / theta[b0], -theta[-1] / theta[b0]
    covariance = jacobian @ covariance @ jacobian.T
    found = model_of(structure, method, theta, covariance, model.unit, model.rmse)
    return dataclasses.replace(found, cross_validation=model.cross_validation)


def _evenly(run: Zigzag) -> Zigzag:
    """The headings on an even grid of their median step: differences need one."""
    t, heading, step = run.t[run.known], run.heading[run.known], run.step
    if np.abs(np.diff(t) - step).max() >= 0.01 * step:
        even = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-6) + 1)
        t, heading = even, CubicSpline(t, heading)(even)
    return Zigzag(run.name, t, heading, np.interp(t, run.t, run.rudder), run.unit)


def _rows(t: Array, heading: Array, rudder: Array, structure: Structure) -> tuple[Array, Array]:
    """Left side (k,) and regressors (k, n) of the equation in forward differences."""
    order = structure.order
    h = float(np.median(np.diff(t)))
    rate = np.diff(heading) / h
    k = len(rate) - order
    left = np.diff(rate, order) / h**order
    columns = [-rate[:k], rudder[:k]]
    if order == 2:
        columns = [-rate[:k], -np.diff(rate)[:k] / h, rudder[:k], np.diff(rudder)[:k] / h]
    if structure.nonlinear:
        columns.append(-(rate[:k] ** 3))
    return left, np.column_stack([*columns, -np.ones(k)])


def _from_solution(solution: Array, structure: Structure) -> Array:
    """theta from the solution, whose last entry is b0 delta_0."""
    b0 = solution[structure.names.index("b0")]
    return np.append(solution[:-1], solution[-1] / b0)


_MEMORY = 0.995  # a choice: of the average of squared prediction errors, 200 rows


def recursive(y: Array, x: Array, lowest: float = 0.9) -> Array:
    """Recursive least squares with a dynamic forgetting factor: solutions (k, n) after each row.

    The factor falls from 1 towards ``lowest`` as the prediction error grows beyond its usual size
    (Park and Jun 1992: ``lowest + (1 - lowest) 2^-(e/sigma)^2``, here from one and a half sigma
    on), sigma by exponential averaging of errors clipped at three sigma, its start the median of
    the first (0.455: that of a squared normal). What is forgotten is taken from the direction just
    excited only, so that the covariance stays bounded where nothing moves.
    """
    n = x.shape[1]
    size = np.maximum(np.sqrt(np.mean(x**2, axis=0)), 1e-300)
    p = np.eye(n) * 1e6 * max(float(np.mean(y**2)), 1e-12)
    theta = np.zeros(n)
    out = np.empty((len(y), n))
    variance, first = float(np.mean(y**2)) + 1e-300, 10 * n
    errors = np.zeros(first)
    for i in range(len(y)):
        row = x[i] / size
        error = y[i] - row @ theta
        excess = max(abs(error) / np.sqrt(variance) - 1.5, 0.0) if i > first else 0.0
        factor = lowest + (1.0 - lowest) * 2.0 ** -(excess**2)
        pr = p @ row
        power = float(row @ pr)
        if power > 1e-12:
            # Directional forgetting (Kulhavy 1987).
            beta = factor - (1.0 - factor) / power
            gain = pr / (1.0 + power)
            theta = theta + gain * error
            if abs(beta) > 1e-12:
                p = p - np.outer(pr, pr) / (1.0 / beta + power)
        if i < first:
            errors[i] = error
        elif i == first:  # by then the first guesses are past
            variance = float(np.median(errors[2 * n :] ** 2)) / 0.455 + 1e-300
        else:
            variance += (1.0 - _MEMORY) * (min(error**2, 9.0 * variance) - variance)
        out[i] = theta / size
    return out
