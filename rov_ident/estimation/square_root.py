"""Triangular roots of information and covariance matrices, for the recursive estimators.

RLS keeps the root ``R`` of its information ``A = R'R`` beside the right-hand side, ``[R | z]``, so
that the estimate is the x of ``R x = z`` and the covariance is ``R^-1 R^-T`` (the square-root
information filter: Bierman 1977, ch. V). Further right-hand sides may stand behind z: all that is
done here leaves the solution of each as it is. The UKF keeps the covariance and needs its Cholesky
root.

Matrices that are worked on have ``columns_of(n, sides)`` columns and two rows more than n, filled
with zeros: loops along a row then leave no remainder, and may take three rows at a time.
"""

import numpy as np

from rov_ident.core.jit import copy, inlined, inner, kernel, reordered

_WIDTH = 32  # numbers in a row are a multiple of it: four vectors of eight
_NOTHING = 1e-300  # a squared length whose inverse is hardly a number any more


@inlined
def columns_of(n, sides):
    """The columns of a matrix that holds R of n coefficients and so many right-hand sides."""
    return _WIDTH * ((n + max(sides, 2) - 1) // _WIDTH + 1)


# ---------------------------------------------------------------- the information's root


@reordered
def whiten(root, rows, n, count, free, squares):
    """rows (count, columns) -> [w | -w z], w = phi R^-1; squares[0] (count,) of w: phi P phi'.

    squares[1] (count,) is the part of it that the columns after the free ones add.
    """
    columns = root.shape[1]
    for i in range(count):
        rows[i, n], squares[0, i], squares[1, i] = 0.0, 0.0, 0.0
    for a in range(n):
        for i in range(count):  # inside, as no row waits for another
            f = rows[i, a] / root[a, a]
            squares[0, i] += f * f
            squares[1, i] += f * f if a >= free else 0.0
            for k in range(columns):
                rows[i, k] -= f * root[a, k]


@reordered
def solve(root, x):
    """x (n,) of R x = z by back substitution, root = [R | z]."""
    n = len(x)
    for a in range(n - 1, -1, -1):
        total = root[a, n]
        for b in range(a + 1, n):
            total -= root[a, b] * x[b]
        x[a] = total / root[a, a]


@kernel
def inverse_of(root):
    """R^-1 (n, n) of the root (n, n + sides)."""
    n = len(root)
    columns = columns_of(n, root.shape[1] - n)
    padded, inverse = np.zeros((n + 2, columns)), np.zeros((n + 2, columns))
    copy(root, padded)
    invert(padded, inverse)
    return inverse[:n, :n].copy()


@reordered
def invert(root, inverse):
    """inverse (n + 2, columns) = R^-1 by back substitution, of the root (n + 2, columns)."""
    n, columns = root.shape[0] - 2, root.shape[1]
    for a in range(n - 1, -1, -1):
        for k in range(columns):
            inverse[a, k] = 0.0
        inverse[a, a] = 1.0
        for b in range(a + 1, n, 3):  # what root has beyond R meets rows of zeros
            f, g, h = root[a, b], root[a, b + 1], root[a, b + 2]
            for k in range(columns):
                inverse[a, k] -= f * inverse[b, k] + g * inverse[b + 1, k] + h * inverse[b + 2, k]
        f = 1.0 / root[a, a]
        for k in range(columns):
            inverse[a, k] *= f


@reordered
def one_norm(matrix, n, line):
    """The 1-norm of the first n columns: the largest sum of magnitudes in one of them."""
    columns = matrix.shape[1]
    for k in range(columns):
        line[k] = 0.0
    for i in range(0, n, 2):
        for k in range(columns):
            line[k] += abs(matrix[i, k]) + abs(matrix[i + 1, k])
    largest = 0.0
    for k in range(n):
        largest = max(largest, line[k])
    return largest


@inlined
def _reflection(pivot, below):
    """Of a column with a squared length below its pivot: what that becomes, and ``I - beta v v'``.

    The first component of v is the second result, the others are the column's.
    """
    alpha = -np.sqrt(pivot * pivot + below) if pivot > 0.0 else np.sqrt(pivot * pivot + below)
    head = pivot - alpha
    return alpha, head, 2.0 / (head * head + below)


@reordered
def stack(root, rows, free, count, leaving, dot):
    """Householder: make [root; rows] upper triangular again in its first ``free`` columns.

    The first ``count`` rows come in, the ``leaving`` ones from the seventh on leave: with J their
    signs, Q' J Q = J (hyperbolic Householder). Both numbers are multiples of three. What the rows
    say about the other columns is left over.
    """
    columns = root.shape[1]
    for j in range(free):
        below = 0.0
        for i in range(count):
            below += rows[i, j] ** 2
        for i in range(6, 6 + leaving):
            below -= rows[i, j] ** 2
        if abs(below) < _NOTHING:
            for i in range(count):
                rows[i, j] = 0.0
            for i in range(6, 6 + leaving):
                rows[i, j] = 0.0
            continue
        alpha, head, beta = _reflection(root[j, j], below)
        for k in range(columns):
            dot[k] = head * root[j, k]
        for i in range(0, count, 3):
            f, g, h = rows[i, j], rows[i + 1, j], rows[i + 2, j]
            for k in range(columns):
                dot[k] += f * rows[i, k] + g * rows[i + 1, k] + h * rows[i + 2, k]
        for i in range(6, 6 + leaving, 3):
            f, g, h = rows[i, j], rows[i + 1, j], rows[i + 2, j]
            for k in range(columns):
                dot[k] -= f * rows[i, k] + g * rows[i + 1, k] + h * rows[i + 2, k]
        head *= beta
        for k in range(columns):
            root[j, k] -= head * dot[k]
        root[j, j] = alpha
        for i in range(count):
            f = beta * rows[i, j]
            for k in range(columns):
                rows[i, k] -= f * dot[k]
            rows[i, j] = 0.0
        for i in range(6, 6 + leaving):
            f = beta * rows[i, j]
            for k in range(columns):
                rows[i, k] -= f * dot[k]
            rows[i, j] = 0.0


@reordered
def add_variance(root, inverse, score, spare, solutions, share):
    """P <- P + W for the covariance ``P = R^-1 R^-T``; the solutions of all sides stay.

    W is diagonal: of each coefficient a ``share`` (n,) of what its variance is short of 1, the
    prior's. ``inverse`` is R^-1 on entry, ``score`` the covariance S of the accumulated score, with
    which the sandwich P S P grows by W, too. Work space: ``spare``, ``solutions`` (n, sides).

    ``[R^-1 W^1/2]`` is made triangular from the right by Householder reflections, row by row from
    the last (Golub and Van Loan 2013, sec. 5.2): the inverse of the new root.
    """
    n, x, extra = len(share), inverse, spare
    columns, sides = root.shape[1], solutions.shape[1]
    for a in range(n):
        for q in range(sides):
            total = 0.0
            for b in range(a, n):
                total += x[a, b] * root[b, n + q]
            solutions[a, q] = total
    # score: P S P
    _transpose(x, n, extra)
    multiply(x, extra, n, root)
    multiply(root, score, n, extra)
    multiply(extra, root, n, score)
    for a in range(n):
        present = 0.0
        for k in range(columns):
            extra[a, k] = 0.0
            present += x[a, k] ** 2
        extra[a, a] = np.sqrt(share[a] * max(1.0 - present, 0.0))
        score[a, a] += extra[a, a] ** 2
    for a in range(n - 1, -1, -1):
        beside = 0.0
        for k in range(columns):
            beside += extra[a, k] ** 2
        if beside == 0.0:
            continue
        alpha, head, beta = _reflection(x[a, a], beside)
        for i in range(a):
            dot = head * x[i, a]
            for k in range(columns):
                dot += extra[a, k] * extra[i, k]
            dot *= beta
            x[i, a] -= dot * head
            for k in range(columns):
                extra[i, k] -= dot * extra[a, k]
        x[a, a] = alpha
    invert(x, root)
    # score: R'R (P S P + W) R'R
    _transpose(root, n, x)
    multiply(x, root, n, extra)
    multiply(extra, score, n, x)
    multiply(x, extra, n, score)
    for a in range(n):
        for q in range(sides):
            total = 0.0
            for b in range(a, n):
                total += root[a, b] * solutions[b, q]
            root[a, n + q] = total


@reordered
def forget(root, score, w, count, factor, rows, basis, d, product, line):
    """Leave ``factor`` of the information in what some rows see, and only there.

    The rows phi are the first ``count`` of w (6, columns). With A = R'R, u = R phi' and Q an
    orthonormal basis of the u of all rows (Lai and Bernstein 2024)::

        A_new = R' (I - (1 - factor) Q Q') R = A - V V',     V = sqrt(1 - factor) R' Q

    V' leaves the root. The estimate stays; the score's covariance S goes with the information: with
    ``T = A_new A^-1 = I - V W'``, ``W = sqrt(1 - factor) R^-1 Q``::

        T S T' = S - V D' - D V',     D = S W - V (W' S W) / 2

    Work space: rows (12, columns), basis and d (6, columns), product (6, 6), line (columns,).
    """
    n, columns = root.shape[0] - 2, root.shape[1]
    given, count, share = count, 0, np.sqrt(1.0 - factor)
    for i in range(given):
        left = 0.0
        for k in range(columns):
            w[count, k] = w[i, k]
        for a in range(n):
            total = 0.0
            for k in range(columns):
                total += root[a, k] * w[count, k]
            basis[count, a] = total
            left += total * total
        whole = left
        for _ in range(2):  # Gram and Schmidt; what makes u to q makes phi to R^-1 q
            before, left = left, 0.0
            for b in range(count):
                f = 0.0
                for k in range(columns):
                    f += basis[count, k] * basis[b, k]
                for k in range(columns):
                    basis[count, k] -= f * basis[b, k]
                    w[count, k] -= f * w[b, k]
            for k in range(columns):
                left += basis[count, k] ** 2
            if left > 0.5 * before:
                break  # else rounding may have left something of the others: once more
        if left > 1e-12 * whole:
            f = 1.0 / np.sqrt(left)
            for k in range(columns):
                basis[count, k] *= f
                w[count, k] *= f
            count += 1
    for b in range(6):
        f = share if b < count else 0.0
        for k in range(columns):
            basis[b, k] *= f
            w[b, k] *= f
        _combine(basis[b], root, n, rows[6 + b])  # with its part of z, so that solutions stay
        _combine(w[b], score, n, d[b])
        for k in range(columns):
            basis[b, k] = rows[6 + b, k] if k < n else 0.0
    v = basis
    for b in range(6):
        for e in range(6):
            total = 0.0
            for k in range(columns):
                total += w[e, k] * d[b, k]
            product[b, e] = 0.5 * total
    for b in range(6):
        for e in range(6):
            f = product[b, e]
            for k in range(columns):
                d[b, k] -= f * v[e, k]
    for b in range(0, 6, 3):
        for a in range(n):
            f, g, h = v[b, a], v[b + 1, a], v[b + 2, a]
            x, y, z = d[b, a], d[b + 1, a], d[b + 2, a]
            for k in range(columns):
                forth = f * d[b, k] + g * d[b + 1, k] + h * d[b + 2, k]
                back = x * v[b, k] + y * v[b + 1, k] + z * v[b + 2, k]
                score[a, k] -= forth + back
    stack(root, rows, n, 0, 6, line)


@reordered
def multiply(a, b, n, out):
    """out = a b, (n, n) each."""
    for i in range(n):
        for k in range(n):
            out[i, k] = 0.0
        for j in range(n):
            f = a[i, j]
            for k in range(n):
                out[i, k] += f * b[j, k]


@inner
def _transpose(a, n, out):
    """out = a'."""
    for i in range(n):
        for k in range(n):
            out[i, k] = a[k, i]


@reordered
def _combine(weights, matrix, n, out):
    """out (columns,) = n weights, then zeros, times the rows of matrix (n + 2, columns)."""
    columns = matrix.shape[1]
    for k in range(columns):
        out[k] = 0.0
    for a in range(0, n, 3):
        f, g, h = weights[a], weights[a + 1], weights[a + 2]
        for k in range(columns):
            out[k] += f * matrix[a, k] + g * matrix[a + 1, k] + h * matrix[a + 2, k]


@inner
def reorder(root, place, spare, rows, line):
    """root (n + 2, columns) of the same information with column a where place[a] was.

    The old rows, their columns permuted, are stacked below nothing, three at a time. Work space:
    spare (n + 2, columns), rows (12, columns), line (columns,).
    """
    n, columns = len(place), root.shape[1]
    copy(root, spare)
    for a in range(n):
        for b in range(columns):
            root[a, b] = 0.0
    for first in range(0, n, 3):
        for i in range(3):
            a = first + i
            for b in range(columns):
                at = place[b] if b < n else b
                rows[i, b] = spare[a, at] if a < n else 0.0
        stack(root, rows, n, 3, 0, line)


@inner
def permute(place, x, before):
    """x[a] (n,) becomes x[place[a]]; before (n,) is work space."""
    for a in range(len(x)):
        before[a] = x[a]
    for a in range(len(x)):
        x[a] = before[place[a]]


# ---------------------------------------------------------------- a covariance's root


@reordered
def cholesky(p, upper, root):
    """Lower root (size, columns) of p (size, columns); False where p is not positive definite.

    Three rows of the upper root at a time, so that a row below is loaded a third as often.
    """
    size, columns = p.shape
    copy(p, upper)
    for first in range(0, size, 3):
        end = min(first + 3, size)
        for j in range(first, end):
            if not upper[j, j] > 0.0:
                return False
            f = 1.0 / np.sqrt(upper[j, j])
            for k in range(columns):
                upper[j, k] *= f
            for i in range(j + 1, end):
                f = upper[j, i]
                for k in range(columns):
                    upper[i, k] -= f * upper[j, k]
        for i in range(end, size):
            f, g, h = upper[first, i], upper[first + 1, i], upper[first + 2, i]
            for k in range(columns):
                upper[i, k] -= (
                    f * upper[first, k] + g * upper[first + 1, k] + h * upper[first + 2, k]
                )
    for i in range(size):
        for j in range(i + 1):
            root[i, j] = upper[j, i]
    return True


@inner
def cholesky_solve(root, n, x):
    """x (n,) of L L' x = x, in place; L the lower root."""
    for j in range(n):
        for k in range(j):
            x[j] -= root[j, k] * x[k]
        x[j] /= root[j, j]
    for j in range(n - 1, -1, -1):
        for k in range(j + 1, n):
            x[j] -= root[k, j] * x[k]
        x[j] /= root[j, j]
