"""Batch least squares over the 6-DOF regressor, and instrumental variables.

The rows ``y = Phi theta + noise`` are those of `filtered_regression`. Least squares solves ``sum w
Phi' (y - Phi theta) = 0``. Its regressors hold the noise of the velocities, and it is biased
however long the record: noise in Phi meets itself in Phi', and the square of a noisy velocity is
too large by the noise's variance. *Instrumental variables* replace the left factor by what is not
noisy::

    sum w Z' (y - Phi theta) = 0,   Z: the same rows along the *simulated* motion

simulated from the wrench with the present coefficients, and again with the new ones (refined
instrumental variables; Young 2011; Ljung 1999, sec. 7.6). That cures the first bias, the added
masses', not the second, that of quadratic damping. Maximum likelihood has neither.

On an axis without a known force, as fins or a propeller drive whose coefficients are estimated, all
may be multiplied by any number. With no inertia (an added mass that cancels the vehicle's own) and
no other coefficient, only the known forces are left over: least squares would take that for the
best fit. So where the configured inertia leaves more than these, and residuals are not far below
them, the inertia is *held*: thrust and drag are relative to it, and have its uncertainty besides
their own (consider parameters).

Sums over the samples of several bags are sums over bags: an archive is one fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from rov_ident.config import Config
from rov_ident.core.linalg import sandwich, scaled_inverse, widened
from rov_ident.core.progress import Progress, silent
from rov_ident.effects import Acting, compiled
from rov_ident.estimation.shared import LAG
from rov_ident.model.equations import Array, Model
from rov_ident.model.scales import authority
from rov_ident.offline.archive import Mapper, Samples, total
from rov_ident.offline.filtered_regression import Regression, filtered_rows, regression, spacing_of
from rov_ident.sampling.records import HORIZON, beside_odometry, predicted
from rov_ident.sampling.sample import free_axes, parts

PERIOD = 0.1  # s between rows, where samples are as close: a third of the filter's time constant,
# so that none is missed
_BLOCK = 2.0 * LAG  # s; of rows left out together: the area of the lag window of rls and ukf
_FEWEST = 5  # blocks: of a shorter bag they are shorter
_LASTING = 1.0  # s, as of a force that the other estimators call unexplained; three time constants
# of the filter, so that noise is hardly alike so far apart
_ROUNDS = 4  # a guard: of instruments, each simulated with the coefficients of the one before
_TOLD = 0.1  # of the known forces: by residuals of this size all coefficients become too small by
# its square, 1 %
_KNOWN = 3.0  # information over that of the prior at which a direction counts as identified: three
# quarters of the prior variance are gone


class Moments(NamedTuple):
    """Sums of ``[Z y]' [Phi y]`` axis by axis, (6, n + 1, n + 1), over so many ``rows`` (6,), which
    stand for so many ``seconds`` (6,).

    In prior standard deviations about the prior's mean.
    """

    sums: Array
    rows: Array
    seconds: Array


class Residuals(NamedTuple):
    """Of the residuals at a solution of n coefficients, in prior standard deviations.

    ``scatter`` (n, n): covariance of the accumulated ``sum w Z' e``, correlation in time included,
    such that the covariance of the values is that of the jackknife (:func:`_scatter`);
    ``of_thrust`` (n, 6): ``sum w Z' F[thrust]`` by axis; ``products`` (6,): of residuals a second
    apart, summed over so many ``pairs`` (6,). Their mean is the power of what lasts, to which noise
    adds nothing.
    """

    scatter: Array
    of_thrust: Array
    products: Array
    pairs: Array


class Batch(NamedTuple):
    """What the passes over the bags need to know."""

    task: Regression
    effects: Acting  # of the simulation
    instruments: Model | None = None  # the model along whose motion the instruments are taken


@dataclass(frozen=True)
class Solution:
    """values and covariance of the estimated coefficients, in their units.

    ``information`` (n, n) is the weighted Phi' Phi in prior standard deviations, neighbours in time
    counting once; ``noise`` (6,) the residual's standard deviation by axis [N, N m], and
    ``lasting`` (6,) that of the part which lasts a second. ``by_thrust`` (n, 6): by how much the
    values change with the thrust of each axis, per 1.
    """

    values: Array
    covariance: Array
    information: Array
    noise: Array
    lasting: Array
    by_thrust: Array
    rows: int


def solve(
    each: Mapper,
    config: Config,
    free: NDArray[np.bool_] | None = None,
    *,
    instrumental: bool = False,
    weighted: bool = True,
    precision: float = 1.0,
    say: Progress = silent,
) -> Solution:
    """Least squares over every bag, the estimated coefficients those of the configuration.

    ``weighted``: by the residual of each axis, found in a first, ordinary round (in units of the
    axis's own forces). ``precision`` multiplies the prior's: 1 takes the configuration as it is.
    """
    free = np.ones(6, dtype=bool) if free is None else free
    task = regression(config)
    batch = Batch(task, compiled(config.effects))
    prior: Array = np.eye(len(task.scale)) * precision
    forces = authority(config.dynamics)
    on_axis = _inertia_of(task)

    def solved(moments: Moments, weight: Array, held: NDArray[np.bool_]) -> tuple[Array, Array]:
        sums = np.einsum("k,kij->ij", weight / repeats, moments.sums)
        information, x = sums[:-1, :-1], np.zeros(len(held))
        told = np.ix_(~held, ~held)
        x[~held] = np.linalg.solve((information + prior)[told], sums[:-1, -1][~held])
        return information, x

    def residual(x: Array) -> Array:
        tail = np.append(-x, 1.0)
        squares = np.einsum("i,kij,j->k", tail, moments.sums, tail)
        return np.sqrt(np.maximum(squares, 0.0) / np.maximum(moments.rows, 1.0))

    def reweighted(held: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        weight = ordinary
        information, x = solved(moments, weight, held)
        for _ in range(3 if weighted else 0):
            weight = np.where(free, 1.0 / np.maximum(residual(x), 1e-6 * forces) ** 2, 0.0)
            information, x = solved(moments, weight, held)
        return weight, information, x

    say("least squares")
    moments = total(each(moments_of, batch))
    spacing = moments.seconds[0] / moments.rows[0] if moments.rows[0] else PERIOD
    repeats = 2.0 / (task.corner * spacing)  # neighbours within the filter's memory are alike
    # ordinary: forces and moments in units of their own size, else a metre would decide
    ordinary = np.where(free, 1.0 / (0.03 * forces) ** 2, 0.0)
    known = np.sqrt(sum(each(known_squares, batch)) / np.maximum(moments.rows, 1.0))
    _, configured = solved(moments, ordinary, np.asarray(on_axis.any(axis=1), dtype=bool))
    weight, information, x = reweighted(np.zeros(len(on_axis), dtype=bool))
    untold = free & (known < residual(configured)) & (residual(x) > _TOLD * known)
    held = np.asarray((on_axis & untold).any(axis=1), dtype=bool)
    if held.any():
        weight, information, x = reweighted(held)
    noise, normal = residual(x), information
    for round_ in range(_ROUNDS if instrumental else 0):
        say(f"instruments, round {round_ + 1}")
        theta = config.dynamics.theta.copy()
        theta[task.estimated] += task.scale * x
        model = config.dynamics.with_theta(theta)
        if np.linalg.eigvalsh(model.mass_matrix)[0] <= 0.0:
            break
        batch, old = batch._replace(instruments=model), x
        moments = total(each(moments_of, batch))
        normal, x = solved(moments, weight, held)
        if np.abs(x - old).max() < 1e-4:
            break
    say("residuals")
    told = np.ix_(~held, ~held)
    inverse, least = np.zeros_like(prior), np.zeros(len(held))
    inverse[told] = np.linalg.inv((normal + prior)[told])
    least[~held] = np.diag(scaled_inverse((information + prior)[told]))
    left = total(each(residuals_of, batch, x, weight / repeats, inverse))
    covariance = widened(sandwich(inverse, left.scatter + prior), least)
    moved = np.eye(len(held))[:, held]  # all, by what is held
    moved[~held] = -(inverse @ normal)[np.ix_(~held, held)]
    covariance += moved @ moved.T / precision
    by_thrust = inverse @ left.of_thrust
    information = np.where(np.outer(~held, ~held), information, 0.0)
    return Solution(
        task.theta[task.estimated] + task.scale * x,
        covariance * np.outer(task.scale, task.scale),
        information,
        noise,
        np.sqrt(np.maximum(left.products, 0.0) / np.maximum(left.pairs, 1.0)),
        task.scale[:, None] * by_thrust,
        int(moments.rows[free].sum()),
    )


# ------------------------------------------------------------------ of one bag


def moments_of(samples: Samples, batch: Batch) -> Moments:
    """The sums of one bag's samples (k,) of SAMPLE."""
    phi, z, good, spacing = _rows_and_instruments(samples, batch)
    rows = np.full(6, float(good.sum()))
    return Moments(np.einsum("kai,kaj->aij", z, phi), rows, spacing * rows)


def known_squares(samples: Samples, batch: Batch) -> Array:
    """(6,) over one bag's rows: of the forces that are known, thrusters', weight's and those of
    coefficients that are not estimated."""
    theta = batch.task.theta.copy()
    theta[batch.task.estimated] = 0.0
    task = batch.task._replace(theta=theta, rigid_body=np.zeros((6, 6)))
    known = filtered_rows(task, beside_odometry(parts(samples)[0]), PERIOD)[0][:, :, -1]
    squares: Array = np.sum(known[np.isfinite(known).all(axis=1)] ** 2, axis=0)
    return squares


def _inertia_of(task: Regression) -> NDArray[np.bool_]:
    """(n, 6): which coefficients are added masses of which axes."""
    row, column = task.structure.mass_row, task.structure.mass_column
    on_axis = np.zeros((len(task.theta), 6), dtype=bool)
    on_axis[np.arange(len(row)), row] = on_axis[np.arange(len(row)), column] = True
    return on_axis[task.estimated]


def residuals_of(
    samples: Samples, batch: Batch, x: Array, weight: Array, inverse: Array
) -> Residuals:
    """What one bag's residuals ``e = y - Phi x`` tell; ``inverse`` (n, n) is that of the normal
    matrix of all bags."""
    phi, z, good, spacing = _rows_and_instruments(samples, batch)
    error, lag = phi[:, :, -1] - phi[:, :, :-1] @ x, max(round(_LASTING / spacing), 1)
    left = z[:, :, :-1] * weight[:, None]
    doubled = samples.copy()
    for part, other in (("wrench", "surroundings"), ("wrench_slope", "surroundings_slope")):
        doubled[part] += samples[part] - samples[other]
    twice = _rows_and_instruments(doubled, batch._replace(instruments=None))[0]
    return Residuals(
        _scatter(error, left, phi[:, :, :-1], inverse, spacing),
        np.einsum("ka,kai->ia", twice[:, :, -1] - phi[:, :, -1], left),
        np.sum(error[:-lag] * error[lag:], axis=0),
        np.full(6, float(np.sum(good[:-lag] & good[lag:]))),
    )


def _rows_and_instruments(
    samples: Samples, batch: Batch
) -> tuple[Array, Array, NDArray[np.bool_], float]:
    """[Phi y] and [Z y] (K, 6, n + 1), which rows (K,) are known; of all others they are 0; and how
    far rows are apart [s]."""
    samples = beside_odometry(parts(samples)[0])
    phi, t = filtered_rows(batch.task, samples, PERIOD)
    z, spacing = phi, spacing_of(t) if len(t) > 1 else PERIOD
    if batch.instruments is not None:  # along the motion that the model says, through the water
        nu = predicted(batch.instruments, samples, np.inf, effects=batch.effects)
        if not np.isfinite(nu).all():
            nu = predicted(batch.instruments, samples, HORIZON, effects=batch.effects)
        simulated = samples.copy()
        simulated["nu"] = nu
        simulated["nu"][:, :3] -= samples["water"]
        z = filtered_rows(batch.task, simulated, PERIOD)[0]
        z[:, :, -1] = phi[:, :, -1]
    unknown = ~free_axes(samples)
    z[:, unknown] = phi[:, unknown] = 0.0
    good = np.asarray(np.isfinite(z).all(axis=(1, 2)), dtype=bool)
    z[~good] = phi[~good] = 0.0
    return phi, z, good, spacing


def _scatter(error: Array, left: Array, phi: Array, inverse: Array, spacing: float) -> Array:
    """Covariance (n, n) of ``sum left' error`` over rows (K, 6), for that of the values to be the
    jackknife's: the squares of what they change by where a block of rows is left out.

    Without the block g, with its score s and its part N of the normal matrix A, they change by
    ``-(A - N)^-1 s = -A^-1 (1 - N A^-1)^-1 s``. A block that alone tells a coefficient fits it, and
    leaves no residual: by residuals as they are, the interval would be too narrow (Bell and
    McCaffrey 2002; MacKinnon, Nielsen and Webb 2023).
    """
    count, one = max(_FEWEST, round(len(error) * spacing / _BLOCK)), np.eye(len(inverse))
    edges = np.linspace(0, len(error), count + 1).astype(int)
    scores = []
    for a, b in pairwise(edges):
        score = np.einsum("ka,kai->i", error[a:b], left[a:b])
        normal = np.einsum("kai,kaj->ij", left[a:b], phi[a:b])
        scores.append(np.linalg.solve(one - normal @ inverse, score))
    out: Array = np.array(scores).T @ np.array(scores)
    return out


# ------------------------------------------------------------------ what a bag can tell


@dataclass(frozen=True)
class Combination:
    """A combination that the data determine: ``name + sum of factor * other``."""

    name: str
    others: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        parts = [f"{'+' if f > 0 else '-'} {abs(f):.3g} {name}" for name, f in self.others]
        return " ".join([self.name, *parts])


@dataclass(frozen=True)
class BaseParameters:
    """Which coefficients, or combinations of them, the data identify.

    ``combinations``: identifiable. ``unidentified``: coefficients of which only a combination with
    others, or nothing at all (``unexcited``), is known. ``condition``: of the regressor, its
    columns of unit length; ``collinear``: pairs of columns with the cosine between them.
    """

    combinations: tuple[Combination, ...]
    unidentified: tuple[str, ...]
    unexcited: tuple[str, ...]
    condition: float
    collinear: tuple[tuple[str, str, float], ...]


def base_parameters(names: Sequence[str], information: Array, scale: Array) -> BaseParameters:
    """From the information (n, n) in units of ``scale`` (n,), the prior's standard deviations.

    A QR decomposition with pivoting puts the columns that add most first; those after the numerical
    rank are combinations of these (Gautier 1991). The rank counts directions of which the data
    remove three quarters of the prior variance.
    """
    eigenvalues, vectors = np.linalg.eigh(information)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * vectors.T
    length = np.sqrt(np.maximum(np.diag(information), 0.0))
    seen = length**2 >= _KNOWN
    unexcited = tuple(name for name, s in zip(names, seen, strict=True) if not s)
    at = np.flatnonzero(seen)
    if len(at) == 0:
        return BaseParameters((), unexcited, unexcited, np.inf, ())
    r, pivot = qr(root[:, at], mode="r", pivoting=True)
    r = r[: len(at)]
    rank = int(np.count_nonzero(np.diag(r) ** 2 >= _KNOWN))
    base, rest = at[pivot[:rank]], at[pivot[rank:]]
    mixed = np.linalg.solve(r[:rank, :rank], r[:rank, rank:])
    unknown = {*unexcited, *(names[k] for k in rest)}
    combinations = []
    for i in np.argsort(base):
        others = [
            (names[k], float(mixed[i, j] * scale[base[i]] / scale[k]))
            for j, k in enumerate(rest)
            if abs(mixed[i, j]) > 0.02
        ]
        combinations.append(Combination(names[base[i]], tuple(others)))
        unknown |= {names[base[i]]} if others else set()
    unit = root[:, at] / length[at]
    cosine = unit.T @ unit
    singular = np.linalg.svd(unit, compute_uv=False)
    pairs = [
        (names[at[i]], names[at[j]], float(cosine[i, j]))
        for i in range(len(at))
        for j in range(i)
        if abs(cosine[i, j]) > 0.95
    ]
    pairs.sort(key=lambda p: -abs(p[2]))
    return BaseParameters(
        tuple(combinations),
        tuple(name for name in names if name in unknown),
        unexcited,
        float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf,
        tuple(pairs),
    )
