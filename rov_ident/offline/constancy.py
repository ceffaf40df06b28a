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

import numpy as np

from rov_ident.core.linalg import scaled_solve
from rov_ident.model.equations import Array

STRETCHES = 12  # of each record
SHORTEST = 5.0  # s; of a stretch: an error of the attitude or of a command lasts less
UNLIKELY = 3.3  # normal deviates: beyond it is one of a thousand
_FEWEST = 3.0  # stretches that tell as much as each other: with fewer nothing is judged


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


def lacking(scores: Array, informations: Array, whole: Array) -> Array:
    """How unlikely by chance it is, as normal deviates (q,), that each of q parameters is zero that
    the model does not have; zeros where too few stretches tell.

    ``scores`` (C, n + q) and ``informations`` (C, n + q, n + q) of stretches, at the estimate of
    the n parameters of the model, whose information (n, n) is ``whole``, prior included.
    """
    count, n = len(scores), len(whole)
    found = np.zeros(scores.shape[1] - n)
    for i in range(len(found) if count >= STRETCHES else 0):
        along = np.zeros(scores.shape[1])
        along[:n] = -scaled_solve(whole, informations[:, :n, n + i].sum(axis=0), ridge=1e-12)
        along[n + i] = 1.0
        own, weight = scores @ along, informations @ along @ along
        # all others' scores are zero with the prior's
        change = float(scores[:, n + i].sum()) / max(float(weight.sum()), 1e-300)
        found[i] = _unlikely(change, own, weight, 1)
    return found


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
