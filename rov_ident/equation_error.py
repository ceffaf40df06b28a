"""Batch least squares on logs with accelerations: a million samples in one pass, in bounded memory.

The equations of motion are sums of products of two factors, such as a velocity and an acceleration
or a velocity and its absolute value. Each product is made once, for 128 samples side by side and
for all axes that have it, and so is each column; columns of an axis that differ in their factor
only are summed up once. What is summed up then is put together to the coefficients' columns.

Sums are taken by normal equations, or by blockwise Householder (TSQR; Demmel et al. 2012), which
keeps all digits where the normal equations lose half.
"""

import functools
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from rov_ident.coefficients import EXTENDED_SIZE, ONE, PLAIN
from rov_ident.errors import UserError
from rov_ident.jit import inlined, lean, prefetch, reordered
from rov_ident.model import Array, Model, coriolis, extend

_LANES = 128  # samples side by side: their rows stay in the cache
_BLOCK = 64 * _LANES  # samples of TSQR

# the factors, as rows of the work space; rows of products and of sums of these follow
_RATE = EXTENDED_SIZE
_DOWN = _RATE + 6
_WRENCH = _DOWN + 3
_NU = _WRENCH + 6
_FACTORS = _NU + 6

_NOT_TOLD = (
    "the log does not tell all coefficients apart: leave some out of the model, or drive the "
    "vehicle at more than one speed on every axis"
)


@dataclass(frozen=True)
class Log:
    """A motion with its accelerations: nu, nu_dot, wrench (N, 6), down (N, 3), in core axes.

    Raises
    ------
    UserError
        For arrays of other shapes.
    """

    nu: Array
    nu_dot: Array
    wrench: Array
    down: Array

    def __post_init__(self) -> None:
        n = len(self.nu)
        for name, width in (("nu", 6), ("nu_dot", 6), ("wrench", 6), ("down", 3)):
            shape = np.shape(getattr(self, name))
            if shape != (n, width):
                raise UserError(f"a log's {name} needs shape {(n, width)}, not {shape}")


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
    plan, n = _plan(model), len(model.theta)
    if tsqr:
        root = _householder(plan, log, weight)
        length = np.sqrt(np.sum(root[:, :n] ** 2, axis=0))
        _check_told(model.names, length)
        scaled = root[:, :n] / length
        if np.abs(np.diag(scaled)).min() < 1e-13:
            raise UserError(_NOT_TOLD)
        return np.array(np.linalg.solve(scaled[:n], root[:n, n]) / length)
    by_axis = plan.share.swapaxes(1, 2) @ _squares(plan, log) @ plan.share
    sums = np.tensordot(weight, by_axis, 1)
    a, b = sums[:-1, :-1], sums[-1, :-1]
    length = np.sqrt(np.diag(a))
    _check_told(model.names, length)
    try:
        factor = cho_factor(a / np.outer(length, length), lower=True)
    except np.linalg.LinAlgError as error:
        raise UserError(_NOT_TOLD) from error
    solution: Array = cho_solve(factor, b / length) / length
    return solution


def rows(model: Model, log: Log) -> Array:
    """Regressor and, as the last column, ``tau - known`` of every sample: (6, n + 1, N)."""
    plan = _plan(model)
    parts = [plan.share.swapaxes(1, 2) @ _filled(plan, part) for part in _blocks(log, _BLOCK)]
    none = np.zeros((6, len(model.theta) + 1, 0))
    return np.concatenate([none, *parts], axis=2)[:, :, : len(log.nu)]


def _check_told(names: Sequence[str], length: Array) -> None:
    if not np.isfinite(length).all():
        raise UserError("the log holds values that are not finite: leave those rows out")
    if (length == 0.0).any():
        missing = ", ".join(n for n, size in zip(names, length, strict=True) if size == 0.0)
        raise UserError(f"the log says nothing of {missing}: leave these out of the model")


# ------------------------------------------------------------------ what is to be multiplied

Indices = NDArray[np.int64]


class Plan(NamedTuple):
    """Which products are made, which sums of them, and what each axis's columns are made of.

    Rows of the work space: the factors, then the products of rows ``left`` and ``right`` (p,), then
    sums, in steps (s,): row ``base`` plus ``times`` (s, 4) rows ``part`` (s, 4) into row ``out``.
    Axis by axis, ``distinct`` (6, c) are the rows that its columns are multiples of, ``width`` (6,)
    of them, and ``share`` (6, c, n + 1) the multiples: the coefficients' columns, then the goal's.
    """

    left: Indices
    right: Indices
    out: Indices
    base: Indices
    part: Indices
    times: Array
    distinct: Indices
    width: Indices
    share: Array


Column = dict[tuple[int, int], float]
"""A sum of products: what each pair of factors, the later one first, is multiplied by."""


def _columns(model: Model) -> list[list[Column]]:
    """The columns of each axis (6, n + 1), ``tau - known`` last."""
    n, s = len(model.theta), model.structure
    columns: list[list[Column]] = [[{} for _ in range(n + 1)] for _ in range(6)]
    unit = np.eye(6)
    # C(nu) nu is linear in the momentum and in nu: (component of nu, axis, force) of each momentum
    forces: list[list[tuple[int, int, float]]] = [[] for _ in range(6)]
    for i, k in np.ndindex(6, 6):
        force = coriolis(unit[i], unit[k])
        forces[i] += [(k, axis, float(force[axis])) for axis in range(6) if force[axis] != 0.0]

    def add(axis: int, column: int, a: int, b: int, factor: float) -> None:
        pair, mine = (max(a, b), min(a, b)), columns[axis][column]
        mine[pair] = mine.get(pair, 0.0) + factor

    def add_mass(column: int, i: int, j: int, mass: float) -> None:
        add(i, column, _RATE + j, ONE, mass)
        for k, axis, force in forces[i]:
            add(axis, column, PLAIN + j, PLAIN + k, mass * force)

    for c, (i, j) in enumerate(zip(s.mass_row.tolist(), s.mass_column.tolist(), strict=True)):
        for entry in {(i, j), (j, i)}:
            add_mass(c, *entry, -1.0)
    terms = zip(s.row.tolist(), s.left.tolist(), s.right.tolist(), strict=True)
    for c, (axis, left, right) in enumerate(terms, len(s.mass_row)):
        add(axis, c, left, right, -1.0)
    mass, restoring = model.body.mass_matrix, model.body.restoring
    for i, j in np.ndindex(6, 6):
        add_mass(n, i, j, -float(mass[i, j]))
    for axis in range(6):
        add(axis, n, _WRENCH + axis, ONE, 1.0)
        for k in range(3):
            add(axis, n, _DOWN + k, ONE, float(restoring[axis, k]))
    return [[{p: f for p, f in c.items() if f != 0.0} for c in axis] for axis in columns]


def _plan(model: Model) -> Plan:
    columns = _columns(model)
    pairs = {pair for axis in columns for column in axis for pair in column}
    row_of = {pair: pair[0] for pair in pairs if pair[1] == ONE}
    products = sorted(pairs - row_of.keys())
    row_of |= {pair: _FACTORS + i for i, pair in enumerate(products)}
    unused = itertools.count(_FACTORS + len(products))
    steps: list[tuple[Any, ...]] = []

    @functools.cache
    def row_with(base: int, terms: tuple[tuple[int, float], ...]) -> int:
        """The row that holds row ``base`` plus ``(row, times)`` of others."""
        out = next(unused) if terms else base
        for i in range(0, len(terms), 4):
            four = (*terms[i : i + 4], *[(ONE, 0.0)] * 3)[:4]
            steps.append((out, out if i else base, *zip(*four, strict=True)))
        return out

    distinct: list[dict[int, int]] = [{} for _ in range(6)]  # place by row
    share = np.zeros((6, len(model.theta) + 4, len(model.theta) + 1))
    for axis, c in np.ndindex(6, len(model.theta) + 1):
        if not columns[axis][c]:
            continue
        *others, (last, scale) = sorted(columns[axis][c].items())
        row = row_with(row_of[last], tuple((row_of[pair], f / scale) for pair, f in others))
        share[axis, distinct[axis].setdefault(row, len(distinct[axis])), c] = scale
    width = np.array([len(places) for places in distinct])
    most = -(-width.max() // 4) * 4
    padded = np.array([[*places, *[ONE] * (most - len(places))] for places in distinct])
    left, right = np.array(products).reshape(-1, 2).T.copy()
    out, base, part, times = (np.array(each) for each in zip(*steps, strict=True))
    return Plan(left, right, out, base, part, times, padded, width, share[:, :most].copy())


def _blocks(log: Log, size: int) -> Iterator[tuple[Array, ...]]:
    """Parts of so many samples, a multiple of _LANES; zeros are added to the last one."""
    arrays = (log.nu, log.nu_dot, log.wrench, log.down)
    whole = [np.ascontiguousarray(a, dtype=float) for a in arrays]
    for first in range(0, len(log.nu), size):
        part = [a[first : first + size] for a in whole]
        missing = -len(part[0]) % _LANES
        if missing:
            part = [np.vstack([a, np.zeros((missing, a.shape[1]))]) for a in part]
        yield tuple(part)


# ------------------------------------------------------------------ sums


def _squares(plan: Plan, log: Log) -> Array:
    """For each axis the products of its distinct rows (6, c, c), added up over the log."""
    gram = np.zeros((*plan.distinct.shape, plan.distinct.shape[1]))
    for part in _blocks(log, max(len(log.nu) // _LANES, 1) * _LANES):
        _accumulate(plan, part, _work(plan), gram)
    lower: Array = np.tril(gram)
    return lower + np.tril(gram, -1).swapaxes(1, 2)


def _householder(plan: Plan, log: Log, weight: Array) -> Array:
    """The triangular root (n + 1, n + 1) of all rows, block by block and axis by axis."""
    roots = [np.zeros((0, width)) for width in plan.width]
    for part in _blocks(log, _BLOCK):
        filled = _filled(plan, part)
        for axis, width in enumerate(plan.width):
            stacked = np.vstack([roots[axis], filled[axis, :width].T])
            roots[axis] = np.array(np.linalg.qr(stacked, mode="r"))
    columns = plan.share.shape[2]
    whole = [
        np.sqrt(weight[axis]) * root @ plan.share[axis, : root.shape[1]]
        for axis, root in enumerate(roots)
    ]
    return np.array(np.linalg.qr(np.vstack([*whole, np.zeros((columns, columns))]), mode="r"))


def _filled(plan: Plan, part: tuple[Array, ...]) -> Array:
    """Each axis's distinct rows (6, c, N) of a block of samples."""
    out = np.zeros((*plan.distinct.shape, len(part[0])))
    _fill(plan, part, _work(plan), out)
    return out


def _work(plan: Plan) -> Array:
    """The work space, its rows at the beginning of lines of the cache: a sixth of the time."""
    size = (plan.out.max() + 1) * _LANES
    space = np.zeros(size + 8)
    first = -space.ctypes.data % 64 // 8
    return space[first : first + size].reshape(-1, _LANES)


@lean
def _accumulate(plan, log, x, gram):
    """Add to gram (6, c, c), lower halves, the products of each axis's distinct rows."""
    for first in range(0, len(log[0]), _LANES):
        _make_rows(plan, log, first, x)
        for axis in range(6):
            _add_squares(x, plan.distinct[axis], plan.width[axis], gram[axis])


@lean
def _fill(plan, log, x, out):
    for first in range(0, len(log[0]), _LANES):
        _make_rows(plan, log, first, x)
        for axis in range(6):
            for c in range(plan.width[axis]):
                row = plan.distinct[axis, c]
                for k in range(_LANES):
                    out[axis, c, first + k] = x[row, k]


@inlined  # a call with so many arrays takes a tenth of the time
def _make_rows(plan, log, first, x):
    """All rows of x of the samples from ``first`` on."""
    nu, nu_dot, wrench, down = log
    _read(nu[first:], nu_dot[first:], wrench[first:], down[first:], x)
    _combine(plan, x)


@reordered
def _read(nu, nu_dot, wrench, down, x):
    """The factors of the first _LANES samples into their rows of x."""
    _load(6, nu, x[_NU : _NU + 6])
    _load(6, nu_dot, x[_RATE : _RATE + 6])
    _load(6, wrench, x[_WRENCH : _WRENCH + 6])
    _load(3, down, x[_DOWN : _DOWN + 3])
    extend(_LANES, x[_NU : _NU + 6], x[:EXTENDED_SIZE])


@inlined
def _load(width, a, out):
    """The first _LANES samples of a (N, width) into lanes (width, _LANES)."""
    for first in range(0, _LANES, 8):
        for i in range(width):  # as many lines of the cache: those of the next block
            prefetch(a, width * (first + _LANES) + 8 * i)
        for k in range(first, first + 8):
            for i in range(width):
                out[i, k] = a[k, i]


@reordered
def _combine(plan, x):
    """Products and sums of the factors into their rows of x."""
    for p in range(len(plan.left)):
        a, b, out = x[plan.left[p]], x[plan.right[p]], x[_FACTORS + p]
        for k in range(_LANES):
            out[k] = a[k] * b[k]
    for s in range(len(plan.out)):
        i, out, base = plan.part[s], x[plan.out[s]], x[plan.base[s]]
        a, b, c, d = x[i[0]], x[i[1]], x[i[2]], x[i[3]]
        f, g, h, m = plan.times[s, 0], plan.times[s, 1], plan.times[s, 2], plan.times[s, 3]
        for k in range(_LANES):
            out[k] = base[k] + f * a[k] + g * b[k] + h * c[k] + m * d[k]


@reordered
def _add_squares(x, pattern, width, gram):
    """Add to the lower half of gram the products of the columns in ``pattern``, in its order.

    Four rows and four columns at a time, so that each number is read for four products.
    """
    for a in range(0, width, 4):
        i0, i1, i2, i3 = pattern[a], pattern[a + 1], pattern[a + 2], pattern[a + 3]
        for b in range(0, a, 4):
            j0, j1, j2, j3 = pattern[b], pattern[b + 1], pattern[b + 2], pattern[b + 3]
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
        s00 = s10 = s11 = s20 = s21 = s22 = s30 = s31 = s32 = s33 = 0.0
        for k in range(_LANES):
            p, q, r, s = x[i0, k], x[i1, k], x[i2, k], x[i3, k]
            s00 += p * p
            s10 += q * p
            s11 += q * q
            s20 += r * p
            s21 += r * q
            s22 += r * r
            s30 += s * p
            s31 += s * q
            s32 += s * r
            s33 += s * s
        gram[a, a] += s00
        gram[a + 1, a] += s10
        gram[a + 1, a + 1] += s11
        gram[a + 2, a] += s20
        gram[a + 2, a + 1] += s21
        gram[a + 2, a + 2] += s22
        gram[a + 3, a] += s30
        gram[a + 3, a + 1] += s31
        gram[a + 3, a + 2] += s32
        gram[a + 3, a + 3] += s33


@inlined
def _more(total, f, y):
    """total + f y, tuples of four."""
    return total[0] + f * y[0], total[1] + f * y[1], total[2] + f * y[2], total[3] + f * y[3]
