"""Batch least squares over the 6-DOF regressor, and instrumental variables.

*From a record*: the rows ``y = Phi theta + noise`` are those of :mod:`rov_ident.regression`, every
channel through one low-pass filter, so that nothing is differentiated. Least squares is the
solution of ``sum w Phi' (y - Phi theta) = 0``. Its regressors hold the noise of the velocities, and
the estimate is biased however long the record: noise in Phi meets itself in Phi', and the square of
a noisy velocity is too large on average, by the noise's variance. *Instrumental variables* replace
the left factor by what is not noisy::

    sum w Z' (y - Phi theta) = 0,   Z: the same rows along the *simulated* motion

simulated from the wrench with the present coefficients, and again with the new ones (refined
instrumental variables; Young 2011; Ljung 1999, sec. 7.6). That cures the first bias, which is the
added masses'. It does not cure the second, that of the quadratic damping: an expected square is no
matter of correlation. Maximum likelihood has neither.

*From a log with accelerations* (:func:`equation_error`), a million samples take one pass in bounded
memory: normal equations, or blockwise Householder (TSQR; Demmel et al. 2012), which keeps all
digits where the normal equations lose half.

Sums over the samples of several bags are sums over bags: an archive is one fit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, qr

from rov_ident.coefficients import EXTENDED_SIZE
from rov_ident.config import Config
from rov_ident.effects import compiled
from rov_ident.errors import UserError
from rov_ident.excitation import authority
from rov_ident.jit import inlined, kernel, reordered
from rov_ident.model import Array, Model, coriolis_of, extend, six, symmetric_product
from rov_ident.records import HORIZON, predicted
from rov_ident.regression import Regression, filtered_rows, regression

PERIOD = 0.1  # s between rows
_LAG = 2.0  # s; window over the correlation of the residuals
_ROUNDS = 4  # of instruments, each simulated with the coefficients of the one before
_KNOWN = 3.0  # information over that of the prior at which a direction counts as identified: three
# quarters of the prior variance are gone

Samples = NDArray[np.void]
Mapper = Callable[..., list]  # type: ignore[type-arg]
"""``mapper(function, *arguments)``: function(samples, *arguments) of every bag, in order."""


class Moments(NamedTuple):
    """Sums of ``[Z y]' [Phi y]`` axis by axis, (6, n + 1, n + 1), over so many ``rows`` (6,).

    In prior standard deviations about the prior's mean.
    """

    sums: Array
    rows: Array


class Batch(NamedTuple):
    """What the passes over the bags need to know."""

    task: Regression
    free: NDArray[np.bool_]  # (6,) axes whose rows count
    instruments: Model | None  # the model along whose motion the instruments are taken
    effects: object  # effects.Acting, of the simulation


@dataclass(frozen=True)
class Solution:
    """values and covariance of the estimated coefficients, in their units.

    ``information`` (n, n) is the weighted Phi' Phi in prior standard deviations, neighbours in time
    counting once; ``noise`` (6,) the residual's standard deviation by axis [N, N m].
    """

    values: Array
    covariance: Array
    information: Array
    noise: Array
    rows: int


def solve(
    each: Mapper,
    config: Config,
    free: NDArray[np.bool_] | None = None,
    *,
    instrumental: bool = False,
    weighted: bool = True,
    precision: float = 1.0,
    progress: Callable[[str], None] | None = None,
) -> Solution:
    """Least squares over every bag, the estimated coefficients those of the configuration.

    ``weighted``: by the residual of each axis, found in a first, ordinary round (in units of the
    axis's own forces). ``precision`` multiplies the prior's: 1 takes the configuration as it is.
    """
    free = np.ones(6, dtype=bool) if free is None else free
    say = progress or (lambda what: None)
    batch = Batch(regression(config), free, None, compiled(config.effects))
    n = len(batch.task.scale)
    prior: Array = np.eye(n) * precision
    repeats = 2.0 / (batch.task.corner * PERIOD)
    # ordinary: forces and moments in units of their own size, else a metre would decide
    weight = np.where(free, 1.0 / (0.03 * authority(config.dynamics)) ** 2, 0.0)

    def estimate(batch: Batch, weight: Array) -> tuple[Array, Moments]:
        moments = _total(each(moments_of, batch))
        a, b = _weighted(moments.sums, weight / repeats)
        return np.array(np.linalg.solve(a + prior, b)), moments

    def residual(moments: Moments, x: Array) -> Array:
        tail = np.append(-x, 1.0)
        squares = np.einsum("i,kij,j->k", tail, moments.sums, tail)
        std: Array = np.sqrt(np.maximum(squares, 0.0) / np.maximum(moments.rows, 1.0))
        return std

    say("least squares")
    x, moments = estimate(batch, weight)
    least = 1e-6 * authority(config.dynamics)
    if weighted:
        for _ in range(3):
            weight[:] = np.where(free, 1.0 / np.maximum(residual(moments, x), least) ** 2, 0.0)
            left, b = _weighted(moments.sums, weight / repeats)
            x[:] = np.linalg.solve(left + prior, b)
    noise = residual(moments, x)
    information = _weighted(moments.sums, weight / repeats)[0]
    a: Array = information + prior
    if instrumental:
        for round_ in range(_ROUNDS):
            say(f"instruments, round {round_ + 1}")
            model = _model_at(config, batch.task, x)
            if np.linalg.eigvalsh(model.mass_matrix)[0] <= 0.0:
                break
            batch = batch._replace(instruments=model)
            old = x.copy()
            moments = _total(each(moments_of, batch))
            a, b = _weighted(moments.sums, weight / repeats)
            a = a + prior
            x[:] = np.linalg.solve(a, b)
            if np.abs(x - old).max() < 1e-4:
                break
    say("residuals")
    scatter = sum(each(scatter_of, batch, x, weight / repeats)) + prior
    inverse = np.linalg.inv(a)
    covariance = inverse @ scatter @ inverse.T
    spread = np.diag(np.linalg.inv(information + prior))
    widen = np.sqrt(np.maximum(spread / np.diag(covariance), 1.0)) * batch.task.scale
    task = batch.task
    return Solution(
        task.theta[task.estimated] + task.scale * x,
        covariance * np.outer(widen, widen),
        information,
        noise,
        int(moments.rows[free].sum()),
    )


def _total(parts: Sequence[Moments]) -> Moments:
    return Moments(*(sum(values) for values in zip(*parts, strict=True)))


def _weighted(sums: Array, weight: Array) -> tuple[Array, Array]:
    """A (n, n) and b (n,) of A x = b."""
    total = np.einsum("k,kij->ij", weight, sums)
    return total[:-1, :-1], total[:-1, -1]


def _model_at(config: Config, task: Regression, x: Array) -> Model:
    theta = config.dynamics.theta.copy()
    theta[task.estimated] += task.scale * x
    return config.dynamics.with_theta(theta)


# ------------------------------------------------------------------ of one bag


def moments_of(samples: Samples, batch: Batch) -> Moments:
    """The sums of one bag's samples (k,) of SAMPLE."""
    phi, z = _both(samples, batch)
    return Moments(np.einsum("kai,kaj->aij", z, phi), np.full(6, float(len(phi))))


def scatter_of(samples: Samples, batch: Batch, x: Array, weight: Array) -> Array:
    """Covariance (n, n) of one bag's accumulated ``sum w Z' e``, correlation in time included."""
    phi, z = _both(samples, batch)
    error = phi[:, :, -1] - phi[:, :, :-1] @ x
    score = np.einsum("ka,kai->ki", error * weight, z[:, :, :-1])
    total, lagged = np.zeros((len(x), len(x))), np.zeros(len(x))
    _scatter(np.ascontiguousarray(score), np.exp(-PERIOD / _LAG), total, lagged)
    return total


def _both(samples: Samples, batch: Batch) -> tuple[Array, Array]:
    phi = filtered_rows(batch.task, samples, PERIOD)
    if batch.instruments is None:
        z = phi
    else:
        z = filtered_rows(batch.task, _simulated(samples, batch), PERIOD)
        z[:, :, -1] = phi[:, :, -1]
    good = np.isfinite(z).all(axis=(1, 2))
    return phi[good], z[good]


def _simulated(samples: Samples, batch: Batch) -> Samples:
    """The samples with the motion that the model says, through the water."""
    assert batch.instruments is not None
    model, effects = batch.instruments, batch.effects
    nu = predicted(model, samples, np.inf, effects=effects)  # type: ignore[arg-type]
    if not np.isfinite(nu).all():
        nu = predicted(model, samples, HORIZON, effects=effects)  # type: ignore[arg-type]
    out = samples.copy()
    out["nu"] = nu
    out["nu"][:, :3] -= samples["water"]
    return out


@kernel
def _scatter(score, fade, total, lagged):
    n = len(lagged)
    for k in range(len(score)):
        for i in range(n):
            lagged[i] *= fade
        for i in range(n):
            f, h = score[k, i], lagged[i]
            for j in range(n):
                total[i, j] += f * (score[k, j] + lagged[j]) + h * score[k, j]
        for i in range(n):
            lagged[i] += score[k, i]


# ------------------------------------------------------------------ logs with accelerations


@dataclass(frozen=True)
class Log:
    """A motion with its accelerations: nu, nu_dot, wrench (N, 6), down (N, 3), in core axes."""

    nu: Array
    nu_dot: Array
    wrench: Array
    down: Array


def equation_error(
    model: Model, log: Log, weight: Array | None = None, tsqr: bool = False
) -> Array:
    """All coefficients (n,) of the model by least squares on ``tau = Y theta + known``.

    One pass over the log in blocks: besides the log, memory does not grow with it. ``weight`` (6,)
    of each axis's squared residual. ``tsqr``: blockwise Householder instead of normal equations,
    right for condition numbers of the regressor up to 1e15 instead of 1e7, and slower.

    Raises
    ------
    UserError
        If the log does not tell all coefficients.
    """
    weight = np.ones(6) if weight is None else weight
    n = len(model.theta)
    pattern, count = _pattern(model)
    arguments = _arguments(model, log)
    if tsqr:
        root = _householder(arguments, pattern, count, weight, n)
        length = np.sqrt(np.sum(root[:, :n] ** 2, axis=0))
        _check_told(model.names, length)
        scaled = root[:, :n] / length
        if np.abs(np.diag(scaled)).min() < 1e-13:
            raise UserError(_NOT_TOLD)
        return np.array(np.linalg.solve(scaled[:n], root[:n, n]) / length)
    sums = np.zeros((6, n + 1, n + 1))
    _accumulate(*(*arguments, pattern, count, sums))
    whole = np.einsum("k,kij->ij", weight, sums)
    a, b = whole[:-1, :-1] + np.tril(whole[:-1, :-1], -1).T, whole[-1, :-1]
    length = np.sqrt(np.diag(a))
    _check_told(model.names, length)
    try:
        factor = cho_factor(a / np.outer(length, length), lower=True)
    except np.linalg.LinAlgError as error:
        raise UserError(_NOT_TOLD) from error
    solution: Array = cho_solve(factor, b / length) / length
    return solution


def fill(model: Model, log: Log, out: Array) -> None:
    """Regressor and goal of all samples into out (6, n + 1, N)."""
    _fill(*(*_arguments(model, log), 0, out))


def _arguments(model: Model, log: Log) -> tuple[Any, ...]:
    return (
        model.structure,
        model.body.mass_matrix[:, :, None],
        model.body.restoring,
        *[np.ascontiguousarray(a, dtype=float) for a in (log.nu, log.nu_dot, log.wrench, log.down)],
    )


_NOT_TOLD = (
    "the log does not tell all coefficients apart: leave some out of the model, or drive the "
    "vehicle at more than one speed on every axis"
)


def _check_told(names: Sequence[str], length: Array) -> None:
    if not np.isfinite(length).all():
        raise UserError("the log holds values that are not finite: leave those rows out")
    if (length == 0.0).any():
        missing = ", ".join(n for n, size in zip(names, length, strict=True) if size == 0.0)
        raise UserError(f"the log says nothing of {missing}: leave these out of the model")


def _pattern(model: Model) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns (6, n + 1) of the regressor that are not always zero, axis by axis, the goal last;
    their number (6,)."""
    n, rng = len(model.theta), np.random.default_rng(0)
    found = np.zeros((6, n), dtype=bool)
    for _ in range(8):
        nu, nu_dot = rng.standard_normal((2, 6))
        found |= model.regressor(nu, nu_dot) != 0.0
    pattern, count = np.full((6, n + 1), n, dtype=np.int64), np.zeros(6, dtype=np.int64)
    for axis, row in enumerate(found):
        columns = np.append(np.flatnonzero(row), n)
        pattern[axis, : len(columns)], count[axis] = columns, len(columns)
    return pattern, count


def _householder(
    arguments: tuple[Any, ...],
    pattern: NDArray[np.int64],
    count: NDArray[np.int64],
    weight: Array,
    n: int,
) -> Array:
    """The triangular root (n + 1, n + 1) of all rows, block by block and axis by axis."""
    block = np.zeros((6, n + 1, _BLOCK))
    roots: list[Array] = [np.zeros((0, c)) for c in count]
    total = len(arguments[3])
    for first in range(0, total, _BLOCK):
        size = min(_BLOCK, total - first)
        _fill(*(*arguments, first, block))
        for axis in range(6):
            mine = block[axis, pattern[axis, : count[axis]], :size].T
            stacked = np.vstack([roots[axis], mine])
            roots[axis] = np.array(np.linalg.qr(stacked, mode="r"))
    whole = np.zeros((sum(len(r) for r in roots) + n + 1, n + 1))
    row = n + 1
    for axis, root in enumerate(roots):
        columns = pattern[axis, : count[axis]]
        whole[row : row + len(root), columns] = np.sqrt(weight[axis]) * root
        row += len(root)
    return np.array(np.linalg.qr(whole, mode="r"))


_BLOCK = 8192  # samples of TSQR
_LANES = 128  # samples of the normal equations side by side: the block stays in the cache


# One record, so that the compiler knows that its parts do not overlap; a loop along the lanes then
# becomes vector instructions.
_SCRATCH = np.dtype(
    [
        ("nu", "f8", (6, _LANES)),
        ("nu_dot", "f8", (6, _LANES)),
        ("h", "f8", (6, _LANES)),
        ("extended", "f8", (EXTENDED_SIZE, _LANES)),
    ],
    align=True,
)


@reordered
def _load(restoring, nu, nu_dot, wrench, down, first, scratch):
    """Samples from ``first`` on into the lanes, their goal without inertia into ``h``."""
    s = scratch[0]
    size = min(_LANES, len(nu) - first)
    for k in range(size):
        x, y, z = down[first + k, 0], down[first + k, 1], down[first + k, 2]
        for i in range(6):
            s.nu[i, k] = nu[first + k, i]
            s.nu_dot[i, k] = nu_dot[first + k, i]
            weight = restoring[i, 0] * x + restoring[i, 1] * y + restoring[i, 2] * z
            s.h[i, k] = wrench[first + k, i] + weight
    for i in range(6):
        for k in range(size, _LANES):
            s.nu[i, k] = 0.0
            s.nu_dot[i, k] = 0.0
            s.h[i, k] = 0.0


@reordered
def _features(structure, mass, restoring, nu, nu_dot, wrench, down, first, scratch, block):
    """Into block (6, n + 1, _LANES) regressor and goal from ``first`` on; zeros beyond the end."""
    _load(restoring, nu, nu_dot, wrench, down, first, scratch)
    s = scratch[0]
    masses, terms = len(structure.mass_row), len(structure.row)
    for k in range(_LANES):
        v = six(s.nu, k)
        a = symmetric_product(mass, six(s.nu_dot, k), 0)
        h = coriolis_of(symmetric_product(mass, v, 0), v)
        s.h[0, k] -= a[0] + h[0]
        s.h[1, k] -= a[1] + h[1]
        s.h[2, k] -= a[2] + h[2]
        s.h[3, k] -= a[3] + h[3]
        s.h[4, k] -= a[4] + h[4]
        s.h[5, k] -= a[5] + h[5]
    for i in range(6):
        _copied(s.h, i, block[i, masses + terms])
    for c in range(masses):
        i, j = structure.mass_row[c], structure.mass_column[c]
        e0, e1, e2, e3, e4, e5 = _unit(i)
        f0, f1, f2, f3, f4, f5 = _unit(j) if i != j else _unit(-1)
        for k in range(_LANES):
            g, m = -s.nu[j, k], -s.nu[i, k]
            momentum = (
                e0 * g + f0 * m, e1 * g + f1 * m, e2 * g + f2 * m,
                e3 * g + f3 * m, e4 * g + f4 * m, e5 * g + f5 * m,
            )  # fmt: skip
            h = coriolis_of(momentum, six(s.nu, k))
            s.h[0, k] = h[0]
            s.h[1, k] = h[1]
            s.h[2, k] = h[2]
            s.h[3, k] = h[3]
            s.h[4, k] = h[4]
            s.h[5, k] = h[5]
        for k in range(_LANES):
            s.h[i, k] -= s.nu_dot[j, k]
        if i != j:
            for k in range(_LANES):
                s.h[j, k] -= s.nu_dot[i, k]
        for q in range(6):
            _copied(s.h, q, block[q, c])
    extend(_LANES, s.nu, s.extended)
    for t in range(terms):
        out, left, right = (
            block[structure.row[t], masses + t],
            structure.left[t],
            structure.right[t],
        )
        for k in range(_LANES):
            out[k] = -s.extended[left, k] * s.extended[right, k]


@inlined
def _copied(a, i, out):
    for k in range(_LANES):
        out[k] = a[i, k]


@inlined
def _unit(i):
    return (
        1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0,
        1.0 if i == 3 else 0.0, 1.0 if i == 4 else 0.0, 1.0 if i == 5 else 0.0,
    )  # fmt: skip


@kernel
def _fill(structure, mass, restoring, nu, nu_dot, wrench, down, first, out):
    """Into out (6, n + 1, size) the samples from ``first`` on."""
    scratch = np.zeros(1, dtype=_SCRATCH)  # the array: a record does not keep it alive
    block = np.zeros((6, out.shape[1], _LANES))
    for begin in range(0, out.shape[2], _LANES):
        if first + begin >= len(nu):
            break
        _features(
            structure, mass, restoring, nu, nu_dot, wrench, down, first + begin, scratch, block
        )
        for i in range(6):
            for j in range(out.shape[1]):
                for k in range(min(_LANES, out.shape[2] - begin)):
                    out[i, j, begin + k] = block[i, j, k]


@kernel
def _accumulate(structure, mass, restoring, nu, nu_dot, wrench, down, pattern, count, sums):
    """Add to sums (6, n + 1, n + 1), lower halves, the squares of all rows, axis by axis."""
    scratch = np.zeros(1, dtype=_SCRATCH)  # the array: a record does not keep it alive
    block = np.zeros((6, sums.shape[1], _LANES))
    gram = np.zeros((6, count.max() + 3, count.max() + 3))
    for first in range(0, len(nu), _LANES):
        _features(structure, mass, restoring, nu, nu_dot, wrench, down, first, scratch, block)
        for axis in range(6):
            _squares(block[axis], pattern[axis], count[axis], gram[axis])
    for axis in range(6):
        for a in range(count[axis]):
            for b in range(a + 1):
                sums[axis, pattern[axis, a], pattern[axis, b]] += gram[axis, a, b]


@reordered
def _squares(x, pattern, count, gram):
    """Add to the lower half of gram the products of the columns in ``pattern``, in its order.

    Four rows and four columns at a time, so that each number is read for four products; what that
    adds beyond the last column has no meaning.
    """
    last = count - 1
    for a in range(0, count, 4):
        i0, i1 = pattern[a], pattern[min(a + 1, last)]
        i2, i3 = pattern[min(a + 2, last)], pattern[min(a + 3, last)]
        for b in range(0, a + 1, 4):
            j0, j1 = pattern[b], pattern[min(b + 1, last)]
            j2, j3 = pattern[min(b + 2, last)], pattern[min(b + 3, last)]
            s0 = s1 = s2 = s3 = (0.0, 0.0, 0.0, 0.0)
            for k in range(_LANES):
                y = (x[j0, k], x[j1, k], x[j2, k], x[j3, k])
                s0 = _more(s0, x[i0, k], y)
                s1 = _more(s1, x[i1, k], y)
                s2 = _more(s2, x[i2, k], y)
                s3 = _more(s3, x[i3, k], y)
            for c in range(4):
                gram[a, b + c] += s0[c]
                gram[a + 1, b + c] += s1[c]
                gram[a + 2, b + c] += s2[c]
                gram[a + 3, b + c] += s3[c]


@inlined
def _more(total, f, y):
    """total + f y, tuples of four."""
    return total[0] + f * y[0], total[1] + f * y[1], total[2] + f * y[2], total[3] + f * y[3]


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
    n = len(names)
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
    combinations, order = [], np.argsort(base)
    for i in order:
        others = [
            (names[k], float(mixed[i, j] * scale[base[i]] / scale[k]))
            for j, k in enumerate(rest)
            if abs(mixed[i, j]) > 0.02
        ]
        combinations.append(Combination(names[base[i]], tuple(others)))
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
    mixed_in = {name for c in combinations for name, _ in c.others}
    mixed_in |= {c.name for c in combinations if c.others}
    unidentified = tuple(
        name for name in names if name in unexcited or name in mixed_in
        or name in {names[k] for k in rest}
    )  # fmt: skip
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf
    assert n == len(scale)
    return BaseParameters(tuple(combinations), unidentified, unexcited, condition, tuple(pairs))
