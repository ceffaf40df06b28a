"""What an estimator knows after data, and what physics allows of it."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rov_ident.config.prior import Prior
from rov_ident.core.linalg import widened
from rov_ident.model.coefficients import ABSOLUTE, ONE
from rov_ident.model.equations import Array, Model
from rov_ident.model.scales import WORKING_SPEED


@dataclass(frozen=True)
class Estimate:
    """Coefficients with their covariance (n, n), at ``t`` seconds.

    ``by_axis`` (n, 6) is what they are wrong by if the thrust of one axis is off by its standard
    deviation (`config.prior.axis_std_of`); (n, 0) where none is supposed, None: not known.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    t: float
    by_axis: Array | None = None

    @property
    def std(self) -> Array:
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def calibrated(covariance: Array, score: Array) -> Array:
    """The covariance (n, n), in prior standard deviations, widened to that of the sandwich.

    ``score`` (n, n) is the covariance of the accumulated score, the prior's included, with its
    correlation in time: for white innovations the inverse of ``covariance``, and nothing changes.
    The sandwich is ``covariance @ score @ covariance``; from a short record it is itself uncertain,
    and mostly too thin, so that nothing is narrowed. Nor is anything widened beyond the prior: what
    no motion has shown is as well known as before.
    """
    variance = np.sum((covariance @ score) * covariance, axis=1)  # of the sandwich
    return widened(covariance, np.minimum(variance, 1.0))


def physical(model: Model, prior: Prior, estimate: Estimate) -> Array:
    """The values (n,) nearest the estimate, in its own metric, that a passive hull can have.

    Signs first: the nearest set without positive diagonal derivatives, in either direction of the
    motion (non-negative least squares in the multipliers); what is held at its limit moves the
    others as their correlation says. Should couplings still make the mass matrix indefinite or the
    damping feed energy, the set is drawn back towards the prior as far as needed.
    """
    if not (np.isfinite(estimate.values).all() and np.isfinite(estimate.covariance).all()):
        return estimate.values
    values = estimate.values.copy()
    rows, limit = _signs(model, prior)
    if (rows @ values > limit).any():
        # minimise |theta - estimate| in the metric of P: theta = estimate - P rows' lambda
        p = rows @ estimate.covariance @ rows.T
        size = np.sqrt(np.where(np.diag(p) > 0.0, np.diag(p), 1.0))
        multipliers = _multipliers(p / np.outer(size, size), (rows @ values - limit) / size)
        values -= estimate.covariance @ rows.T @ (multipliers / size)
        signed = np.flatnonzero(prior.negative)  # the first rows: what they hold is exactly zero
        held = multipliers[: len(signed)] > 0.0
        values[signed] = np.where(held, 0.0, np.minimum(values[signed], 0.0))
        for row, bound in zip(rows[len(signed) :], limit[len(signed) :], strict=True):
            last = np.flatnonzero(row)[-1]
            values[last] -= row[last] * max(row @ values - bound, 0.0)  # rounding
    if is_passive(model, prior, values):
        return values
    low, high = 0.0, 1.0  # share of the way from the prior to the estimate
    for _ in range(30):
        middle = 0.5 * (low + high)
        if is_passive(model, prior, prior.mean + middle * (values - prior.mean)):
            low = middle
        else:
            high = middle
    return prior.mean + low * (values - prior.mean)


def _multipliers(p: Array, excess: Array) -> Array:
    """The x (k,) >= 0 that minimises ``x' p x / 2 - x' excess``, p (k, k) positive semi-definite.

    By active sets (Lawson and Hanson 1974, ch. 23). scipy's takes a node 35 MB and a third of a
    second to import, in the middle of a dive.
    """
    p = p + 1e-12 * np.eye(len(p))
    x, free = np.zeros(len(p)), np.zeros(len(p), dtype=bool)
    for _ in range(3 * len(p)):
        gradient = np.where(free, -np.inf, excess - p @ x)
        best = int(np.argmax(gradient))
        if gradient[best] <= 1e-12 * np.abs(excess).max():
            break
        free[best] = True
        while free.any():
            goal = np.zeros(len(p))
            goal[free] = np.linalg.solve(p[np.ix_(free, free)], excess[free])
            blocked = free & (goal <= 0.0)
            if not blocked.any():
                x = goal
                break
            step = (x[blocked] / np.maximum(x[blocked] - goal[blocked], 1e-300)).min()
            x = x + step * (goal - x)
            free &= x > 1e-14 * x.max()
            x[~free] = 0.0
    return x


@lru_cache(maxsize=4)  # as `model.scales.authority`
def _signs(model: Model, prior: Prior) -> tuple[Array, Array]:
    """Rows (k, n) and limits (k,) with ``rows @ values <= limit`` for a passive hull.

    First each derivative that is never positive, then the sum of each one-sided derivative with
    that of both directions, and the bounds of the parameters of effects.
    """
    n = len(prior.names)
    rows, limits = list(np.eye(n)[prior.negative]), [0.0] * int(prior.negative.sum())
    for sign, bounds in ((1.0, prior.upper), (-1.0, -prior.lower)):
        bounded = np.flatnonzero(np.isfinite(bounds))
        rows.extend(sign * np.eye(n)[bounded])
        limits.extend(bounds[bounded].tolist())
    index = {model.names[i]: k for k, i in enumerate(prior.estimated) if i < len(model.names)}
    known = dict(zip(model.names, model.theta.tolist(), strict=True))
    for c in model.coefficients:
        pair = [name for name in (c.symmetric, c.name) if name in index]
        if c.is_one_sided and pair:
            row = np.zeros(n)
            row[[index[name] for name in pair]] = 1.0
            rows.append(row)
            held = {c.symmetric, c.name} - set(pair)
            limits.append(-sum(known.get(name, 0.0) for name in held))
    return np.array(rows).reshape(-1, n), np.array(limits)


def is_passive(model: Model, prior: Prior, values: Array) -> bool:
    """Whether M is positive definite and the damping takes energy out in every direction.

    Diagonal derivatives must not be positive, nor their sums with the one-sided ones. With
    couplings, the symmetric part of the linear damping matrix is positive semidefinite, and the
    power of the quadratic damping is checked along fixed directions of motion; products of two
    velocities (lift) may do work of either sign and are left out.
    """
    theta, own = model.theta.copy(), prior.estimated < len(model.theta)
    theta[prior.estimated[own]] = values[own]
    if not np.isfinite(theta).all():
        return False
    if np.linalg.eigvalsh(model.with_theta(theta).mass_matrix)[0] <= 0.0:
        return False
    known = dict(zip(model.names, theta.tolist(), strict=True))
    terms = []
    for c, value in zip(model.coefficients, theta, strict=True):
        both = value + known.get(c.symmetric, 0.0) if c.is_one_sided else value
        if (c.is_diagonal or c.is_one_sided) and both > 0.0:
            return False
        if not (c.is_added_mass or c.inputs) and (c.left == ONE or c.left >= ABSOLUTE):
            terms.append((c, value))
    if all(c.is_diagonal or c.is_one_sided for c, _ in terms):
        return True
    linear, power = np.zeros((6, 6)), np.zeros(len(_DIRECTIONS))
    for c, value in terms:
        if c.left == ONE:  # of the two directions of an axis the one that is damped less
            linear[c.row, c.velocity] += max(value, 0.0) if c.is_one_sided else value
        else:
            power += value * _DIRECTIONS[:, c.row] * _EXTENDED[:, c.left] * _EXTENDED[:, c.right]
    largest = np.linalg.eigvalsh(linear + linear.T)[-1]
    return bool(largest <= 1e-9 * np.abs(linear).max() and power.max() <= 1e-9 * -power.min())


_DIRECTIONS = np.random.default_rng(0).standard_normal((2000, 6)) * WORKING_SPEED
_EXTENDED = np.hstack(
    [np.ones((len(_DIRECTIONS), 1)), _DIRECTIONS, np.abs(_DIRECTIONS), np.minimum(_DIRECTIONS, 0.0)]
)
