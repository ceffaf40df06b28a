"""Whether a parameter that is taken for constant stays so throughout each record.

A buoyancy that leaks away, a battery that runs down or a current that turns leaves nothing that
lasts a second, which is what whiteness is judged by, and moves what else is estimated. Each record
is cut into stretches, whose scores say how well the parameters suit each of them. A slope of one
parameter in time, beside which all others are refitted, is tested by Student's t (a score test):
what is left scatters between stretches, and counts if it is more than their information lets
expect, so that noise which lasts less than a stretch makes no slope. The degrees of freedom are
those of the stretches that tell, one less (Bell and McCaffrey 2002, roughly).
"""

from collections.abc import Iterable
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.linalg import scaled_solve
from rov_ident.model.equations import Array

STRETCHES = 12  # of each record
SHORTEST = 5.0  # s; of a stretch: an error of the attitude or of a command lasts less
UNLIKELY = 3.3  # normal deviates: beyond it is one of a thousand
_FEWEST = 3.0  # stretches that tell as much as each other: with fewer nothing is judged
_TOLD_APART = 1e-6  # of the information, beside all others: with less, rounding decides
_CHANCE = 0.01  # of any of several tests, in a fit of which all they ask for is not there


def stretches_of(seconds: float) -> int:
    """Into how many stretches a record is cut."""
    return max(min(STRETCHES, int(seconds / SHORTEST)), 1)


def scatter(scores: Array) -> Array:
    """The covariance (n, n) of the sum of scores (C, n) of stretches, by how these differ: of
    whatever makes errors that last no longer than a stretch (batch means: Law 2015, Simulation
    Modeling and Analysis, sec. 9.5.3); zeros where they are too few."""
    count, n = scores.shape
    if count < STRETCHES:
        return np.zeros((n, n))
    apart = scores - scores.mean(axis=0)
    covariance: Array = apart.T @ apart * (count / (count - 1.0))
    return covariance


def slopes(scores: Array, informations: Array, whole: Array) -> Array:
    """The slope in time of each parameter of a record, as the normal deviate that is as unlikely by
    chance, and the change that it makes throughout the record, (2, n); zeros where too few
    stretches tell.

    ``scores`` (C, n) and ``informations`` (C, n, n) of the stretches at the estimate, whose
    information (n, n) from all records is ``whole``, prior included.
    """
    count, n = scores.shape
    if count < STRETCHES:
        return np.zeros((2, n))
    time = (np.arange(count) + 0.5) / count - 0.5
    found = np.zeros((2, n))
    for i in range(n):
        # the slope is one more parameter, beside which all others are refitted (linearly)
        columns = informations[:, :, i] * time[:, None]
        beside = -scaled_solve(whole, columns.sum(axis=0), ridge=1e-12)
        along = beside + time[:, None] * np.eye(n)[i]  # (C, n): what a unit of slope changes
        weight = np.einsum("ca,cab,cb->c", along, informations, along)
        slope = float(time @ scores[:, i]) / max(float(weight.sum()), 1e-300)
        own = np.sum(along * scores, axis=1)
        unlikely = _unlikely(slope, own, weight, 2)
        found[:, i] = unlikely, slope * (unlikely != 0.0)
    return found


def lacking(
    scores: Array, informations: Array, precision: Array, off: Array, held: NDArray[np.bool_]
) -> Array:
    """How unlikely the data are, as normal deviates (q,), if each of q parameters is zero that the
    model does not have; zeros where too few stretches tell.

    ``scores`` (C, n + q) and ``informations`` (C, n + q, n + q) of stretches, at any estimate near
    the likeliest one of the n parameters of the model; ``off`` (n,) are the means of their prior,
    of the ``precision`` (n,), less that. All but the ``held`` ones (n,) are refitted beside each.
    """
    count, n = len(scores), len(precision)
    found = np.zeros(scores.shape[1] - n)
    if count < STRETCHES:
        return found
    # the prior is one more stretch
    known = np.zeros((1, *informations.shape[1:]))
    known[0, :n, :n] = np.diag(precision)
    scores = np.vstack([scores, np.append(precision * off, found)])
    informations = np.concatenate([informations, known])
    free = np.flatnonzero(~held)
    whole = informations.sum(axis=0)
    asked = np.column_stack([scores[:, free].sum(axis=0), whole[free, n:]])
    step, *beside = scaled_solve(whole[np.ix_(free, free)], asked, ridge=1e-12).T
    scores -= informations[:, :, free] @ step  # as they are at the likeliest one
    for i in range(len(found)):
        along = np.zeros(scores.shape[1])
        along[free], along[n + i] = -beside[i], 1.0
        own, weight = scores @ along, informations @ along @ along
        if weight.sum() > _TOLD_APART * whole[n + i, n + i]:
            found[i] = _unlikely(float(own.sum() / weight.sum()), own, weight, 1)
    return found


def unlikely_of(count: int) -> float:
    """The normal deviate that the largest of ``count`` tests seldom exceeds (Bonferroni)."""
    return NormalDist().inv_cdf(1.0 - 0.5 * _CHANCE / max(count, 1))


def _unlikely(change: float, scores: Array, weight: Array, spent: int) -> float:
    """The normal deviate that is as unlikely by chance as a ``change`` of one parameter, of whose
    ``scores`` (C,) in stretches it explains its ``weight`` (C,) each and leaves the rest; ``spent``
    of C are the degrees of freedom that it has taken. Zero where too few stretches tell."""
    count, known = len(scores), float(weight.sum())
    telling = known**2 / max(float(np.sum(weight**2)), 1e-300)
    if telling < _FEWEST:
        return 0.0
    left = scores - change * weight
    scatter = max(1.0, float(np.sum(left**2)) * count / (count - spent) / known)
    return _normal(change * np.sqrt(known / scatter), telling - 1.0)


def _normal(t: float, freedom: float) -> float:
    """The normal deviate that is as unlikely as Student's t (Wallace 1959)."""
    factor = (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0)
    return float(np.copysign(factor * np.sqrt(freedom * np.log1p(t**2 / freedom)), t))


def worst(records: Iterable[Array], size: int) -> Array:
    """Of the :func:`slopes` (2, n) of each record the least likely ones; ``size`` is n."""
    found = np.zeros((2, size))
    for of in records:
        found = np.where(np.abs(of[0]) > np.abs(found[0]), of, found)
    return found
