"""Triangular roots against numpy's dense algebra."""

from types import SimpleNamespace

import numba
import numpy as np
import pytest

from rov_ident.estimation import square_root as kernels

N, SIDES, COLUMNS = 7, 3, 32  # as square_root.columns_of(N, SIDES)


def callable_from_python(kernel):
    """Kernels for kernels have no wrapper: called from Python they end the process."""
    return numba.njit(lambda *arguments: kernel(*arguments))


INNER = ("cholesky", "cholesky_solve", "whiten", "solve", "one_norm", "stack", "reorder")
INNER += ("forget", "add_variance")
square_root = SimpleNamespace(
    **{name: callable_from_python(getattr(kernels, name)) for name in INNER},
    inverse_of=kernels.inverse_of,
    columns_of=kernels.columns_of,
)


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def padded(matrix):
    """As the kernels take it: zeros in two more rows and in further columns."""
    out = np.zeros((len(matrix) + 2, COLUMNS))
    out[: len(matrix), : matrix.shape[1]] = matrix
    return out


def rows_of(rng, count, size=12):
    out = np.zeros((size, COLUMNS))
    out[:count, : N + SIDES] = rng.standard_normal((count, N + SIDES))
    return out


@pytest.fixture
def root(rng):
    """[R | z | Z] (N, N + SIDES) of a well-conditioned problem."""
    upper = np.triu(rng.standard_normal((N, N + SIDES)))
    upper[np.arange(N), np.arange(N)] = rng.uniform(1.0, 3.0, N)
    return upper


def square(r):
    return r[:N, : N + SIDES].T @ r[:N, : N + SIDES]


def solutions(r):
    return np.linalg.solve(r[:N, :N], r[:N, N : N + SIDES])


def score_of(rng):
    a = rng.standard_normal((N, N + 2))
    return a @ a.T


def test_inverse_solution_and_norm(root):
    inverse = square_root.inverse_of(root)
    np.testing.assert_allclose(inverse, np.linalg.inv(root[:, :N]), atol=1e-12)
    x = np.empty(N)
    square_root.solve(padded(root), x)
    np.testing.assert_allclose(x, np.linalg.solve(root[:, :N], root[:, N]), rtol=1e-12)
    line = np.empty(COLUMNS)
    norm = square_root.one_norm(padded(root[:, :N]), N, line)
    assert norm == pytest.approx(np.linalg.norm(root[:, :N], 1))


def test_rows_come_in_as_by_normal_equations(root, rng):
    work, rows = padded(root), rows_of(rng, 6)
    wanted = square(root) + rows[:6, : N + SIDES].T @ rows[:6, : N + SIDES]
    square_root.stack(work, rows, N, 6, 0, np.empty(work.shape[1]))
    np.testing.assert_allclose(np.tril(work[:N, :N], -1), 0.0, atol=1e-12)
    np.testing.assert_allclose(square(work)[:N], wanted[:N], rtol=1e-10)


def test_rows_that_leave_undo_rows_that_came(root, rng):
    work, rows = padded(root), rows_of(rng, 6)
    again = np.vstack([np.zeros_like(rows[:6]), rows[:6]])
    line = np.empty(work.shape[1])
    square_root.stack(work, rows, N, 6, 0, line)
    square_root.stack(work, again, N, 0, 6, line)
    np.testing.assert_allclose(square(work)[:N], square(root)[:N], atol=1e-9)


def test_whitened_rows_have_the_predicted_variance(root, rng):
    rows, squares = rows_of(rng, 6), np.zeros((2, 6))
    phi, free = rows[:6, :N].copy(), 4
    square_root.whiten(padded(root), rows, N, 6, free, squares)
    covariance = np.linalg.inv(root[:, :N].T @ root[:, :N])
    np.testing.assert_allclose(squares[0], np.einsum("ia,ab,ib->i", phi, covariance, phi))
    x = np.linalg.solve(root[:, :N], root[:, N])
    np.testing.assert_allclose(rows[:6, N], -phi @ x, rtol=1e-9)
    # the held columns alone: their covariance is that of the last block of R
    last = np.linalg.solve(root[:, :N].T, phi.T)[free:]
    np.testing.assert_allclose(squares[1], (last**2).sum(axis=0))


def test_a_row_of_next_to_nothing_leaves_the_root_as_it_is(root, rng):
    """The square of its length is no normal number, and the inverse of that would be infinite."""
    work, rows = padded(root), rows_of(rng, 0)
    rows[0, :3] = 1e-155
    square_root.stack(work, rows, N, 6, 0, np.empty(work.shape[1]))
    np.testing.assert_allclose(work[:N, : N + SIDES], root, rtol=1e-12)


def test_columns_in_another_order_hold_the_same_information(root, rng):
    work, place = padded(root), rng.permutation(N)
    rows, line = rows_of(rng, 0), np.empty(work.shape[1])
    square_root.reorder(work, place, np.zeros_like(work), rows, line)
    order = [*place, *range(N, N + SIDES)]
    np.testing.assert_allclose(square(work)[:N], square(root)[np.ix_(order, order)][:N], rtol=1e-9)


def test_variance_is_added_to_what_is_marked(rng):
    """P gains a share of the room to the prior, solutions stay, and so does the sandwich."""
    root = np.triu(rng.uniform(1.0, 2.0, (N, N + SIDES)))
    root[np.arange(N), np.arange(N)] += 8.0
    work, inverse, score = padded(root), padded(np.linalg.inv(root[:, :N])), score_of(rng)
    marked = np.arange(N) % 2 == 0
    p, before = np.linalg.inv(root[:, :N].T @ root[:, :N]), solutions(root)
    wide, share = padded(score), np.where(marked, rng.uniform(0.0, 0.2, N), 0.0)
    spare, line = np.zeros_like(work), np.empty((N, SIDES))
    square_root.add_variance(work, inverse, wide, spare, line, share)
    added = np.diag(share * (1.0 - np.diag(p)))
    new = work[:N, :N]
    grown = np.linalg.inv(new.T @ new)
    np.testing.assert_allclose(grown, p + added, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(solutions(work), before, rtol=1e-9)
    np.testing.assert_allclose(grown @ wide[:N, :N] @ grown, p @ score @ p + added, atol=1e-9)


def test_forgetting_takes_information_only_where_the_rows_see_it(root, rng):
    work, rows, factor, count = padded(root), rows_of(rng, 0), 0.9, 3
    w = rows_of(rng, count, 6)
    w[:count, N:] = 0.0
    phi, score = w[:count, :N].copy(), score_of(rng)
    wide, none = padded(score), np.zeros_like(w)
    product, line = np.empty((6, 6)), np.empty(work.shape[1])
    square_root.forget(work, wide, w, count, factor, rows, none, none.copy(), product, line)
    r = root[:, :N]
    q = np.linalg.qr(r @ phi.T)[0]
    less = r.T @ (np.eye(N) - (1.0 - factor) * q @ q.T) @ r
    new = work[:N, :N]
    np.testing.assert_allclose(new.T @ new, less, atol=1e-9)
    t = less @ np.linalg.inv(r.T @ r)
    np.testing.assert_allclose(wide[:N, :N], t @ score @ t.T, atol=1e-9)
    np.testing.assert_allclose(solutions(work), solutions(root), rtol=1e-7)


def test_cholesky_root_of_a_covariance(rng):
    p = score_of(rng)
    wide = padded(p)[:N]
    root = np.zeros_like(wide)
    assert square_root.cholesky(wide, np.zeros_like(wide), root)
    np.testing.assert_allclose(root[:, :N], np.linalg.cholesky(p), atol=1e-12)
    x = rng.standard_normal(N)
    solved = x.copy()
    square_root.cholesky_solve(root, N, solved)
    np.testing.assert_allclose(p @ solved, x, atol=1e-9)
    p[2, 2] = -1.0
    assert not square_root.cholesky(padded(p)[:N], np.zeros_like(wide), root)
