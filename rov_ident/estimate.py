"""What an estimator knows before and after: prior, estimate, and what physics allows of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rov_ident.coefficients import ABSOLUTE, ONE
from rov_ident.config import Config
from rov_ident.excitation import WORKING_SPEED, authority
from rov_ident.model import Array, Model


@dataclass(frozen=True)
class Prior:
    """The coefficients to estimate, before any data.

    ``estimated`` (n,) are their indices into theta; mean and std (n,) in their own units.
    ``negative`` (n,) marks those that no passive hull has positive.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    estimated: NDArray[np.int64]
    mean: Array
    std: Array
    negative: NDArray[np.bool_]


@dataclass(frozen=True)
class Estimate:
    """Coefficients with their covariance (n, n), at ``t`` seconds."""

    names: tuple[str, ...]
    values: Array
    covariance: Array
    t: float

    @property
    def std(self) -> Array:
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def prior_of(config: Config) -> Prior:
    """The prior that a configuration states.

    The standard deviation of a coefficient is relative to its value, but not less than a share of
    what such a term would weigh at working speed: a published zero means "not known", not "exactly
    zero".
    """
    model = config.dynamics
    index = [model.names.index(name) for name in config.estimate]
    scale = typical(model)
    std = np.array(
        [
            config.prior.std.get(
                name, config.prior.relative_std * max(abs(model.theta[i]), 0.2 * scale[i])
            )
            for name, i in zip(config.estimate, index, strict=True)
        ]
    )
    chosen = [model.coefficients[i] for i in index]
    return Prior(
        tuple(config.estimate),
        tuple(c.unit for c in chosen),
        np.array(index, dtype=np.int64),
        model.theta[index],
        std,
        np.array([c.is_diagonal for c in chosen], dtype=bool),
    )


def calibrated(covariance: Array, score: Array) -> Array:
    """The covariance (n, n) with its standard deviations widened to those of the sandwich.

    ``score`` (n, n) is the covariance of the accumulated score, the prior's included, with its
    correlation in time: for white innovations the inverse of ``covariance``, and nothing changes.
    The sandwich is ``covariance @ score @ covariance``; from a short record it is itself uncertain,
    and mostly too thin, so that nothing is narrowed.
    """
    sandwich = np.sum((covariance @ score) * covariance, axis=1)
    widen = np.sqrt(np.maximum(sandwich / np.diag(covariance), 1.0))
    wide: Array = covariance * np.outer(widen, widen)
    return wide


def typical(model: Model) -> Array:
    """(m,) the size at which each term alone would take its axis's whole working wrench."""
    wrench, inertia = authority(model), np.diag(model.body.mass_matrix)
    speed = np.concatenate([[1.0], WORKING_SPEED, WORKING_SPEED, WORKING_SPEED])
    sizes = [
        np.sqrt(inertia[c.row] * inertia[c.column])
        if c.is_added_mass
        else wrench[c.row] / (speed[c.left] * speed[c.right])
        for c in model.coefficients
    ]
    return np.array(sizes)


def physical(model: Model, prior: Prior, estimate: Estimate) -> Array:
    """The values (n,) nearest the estimate, in its own metric, that a passive hull can have.

    Signs first: the nearest set without positive diagonal derivatives, in either direction of the
    motion (a non-negative least-squares problem in the multipliers); what is held at its limit
    moves the others as their correlation says. Then, should couplings still make the mass matrix
    indefinite or the damping feed energy, the set is drawn back towards the prior just as far as
    needed.
    """
    if not (np.isfinite(estimate.values).all() and np.isfinite(estimate.covariance).all()):
        return estimate.values
    values = estimate.values.copy()
    rows, limit = _signs(model, prior)
    if (rows @ values > limit).any():
        # Here, for it takes a node 35 MB and a third of a second, and most never need it.
        from scipy.optimize import nnls

        # minimise |theta - estimate| in the metric of P: theta = estimate - P rows' lambda
        p = rows @ estimate.covariance @ rows.T
        size = np.sqrt(np.where(np.diag(p) > 0.0, np.diag(p), 1.0))
        eigenvalues, vectors = np.linalg.eigh(p / np.outer(size, size))
        root = vectors * np.sqrt(np.maximum(eigenvalues, 1e-12))
        excess = (rows @ values - limit) / size
        goal = (vectors.T @ excess) / np.sqrt(np.maximum(eigenvalues, 1e-12))
        multipliers = nnls(root.T, goal)[0]
        values -= estimate.covariance @ rows.T @ (multipliers / size)
        signed = np.flatnonzero(prior.negative)  # the first rows: what they hold is exactly zero
        held = multipliers[: len(signed)] > 0.0
        values[signed] = np.where(held, 0.0, np.minimum(values[signed], 0.0))
        for row, bound in zip(rows[len(signed) :], limit[len(signed) :], strict=True):
            values[np.flatnonzero(row)[-1]] -= max(row @ values - bound, 0.0)  # rounding
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


def _signs(model: Model, prior: Prior) -> tuple[Array, Array]:
    """Rows (k, n) and limits (k,) with ``rows @ values <= limit`` for a passive hull.

    First each derivative that is never positive, then the sum of each one-sided derivative with
    that of both directions.
    """
    n = len(prior.names)
    rows, limits = list(np.eye(n)[prior.negative]), [0.0] * int(prior.negative.sum())
    index = {model.names[i]: k for k, i in enumerate(prior.estimated)}
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
    theta = model.theta.copy()
    theta[prior.estimated] = values
    if not np.isfinite(theta).all():
        return False
    if np.linalg.eigvalsh(model.with_theta(theta).mass_matrix)[0] <= 0.0:
        return False
    linear, power, coupled = np.zeros((6, 6)), np.zeros(len(_DIRECTIONS)), False
    known = dict(zip(model.names, theta.tolist(), strict=True))
    for c, value in zip(model.coefficients, theta, strict=True):
        both = value + known.get(c.symmetric, 0.0) if c.is_one_sided else value
        if (c.is_diagonal or c.is_one_sided) and both > 0.0:
            return False
        if c.is_added_mass or (c.left != ONE and c.left < ABSOLUTE):
            continue
        coupled = coupled or not (c.is_diagonal or c.is_one_sided)
        if c.left == ONE:  # of the two directions of an axis the one that is damped less
            linear[c.row, c.velocity] += max(value, 0.0) if c.is_one_sided else value
        else:
            power += value * _DIRECTIONS[:, c.row] * _EXTENDED[:, c.left] * _EXTENDED[:, c.right]
    if not coupled:
        return True
    largest = np.linalg.eigvalsh(linear + linear.T)[-1]
    return bool(largest <= 1e-9 * np.abs(linear).max() and power.max() <= 1e-9 * -power.min())


_DIRECTIONS = np.random.default_rng(0).standard_normal((2000, 6)) * WORKING_SPEED
_EXTENDED = np.hstack(
    [
        np.ones((len(_DIRECTIONS), 1)),
        _DIRECTIONS,
        np.abs(_DIRECTIONS),
        np.minimum(_DIRECTIONS, 0.0),
    ]
)
