"""Inverses of the mass matrices of many hypotheses side by side, kept positive definite."""

from rov_ident.core.jit import inlined


@inlined
def _block(m, i, j, k):
    """The 3 x 3 block at i, j of m (6, 6, lanes) in lane k, as a tuple of rows."""
    return (
        (m[i, j, k], m[i, j + 1, k], m[i, j + 2, k]),
        (m[i + 1, j, k], m[i + 1, j + 1, k], m[i + 1, j + 2, k]),
        (m[i + 2, j, k], m[i + 2, j + 1, k], m[i + 2, j + 2, k]),
    )


@inlined
def _put(m, i, j, k, f, a):
    """Write f a to where :func:`_block` would find it."""
    m[i, j, k], m[i, j + 1, k], m[i, j + 2, k] = f * a[0][0], f * a[0][1], f * a[0][2]
    m[i + 1, j, k], m[i + 1, j + 1, k], m[i + 1, j + 2, k] = f * a[1][0], f * a[1][1], f * a[1][2]
    m[i + 2, j, k], m[i + 2, j + 1, k], m[i + 2, j + 2, k] = f * a[2][0], f * a[2][1], f * a[2][2]


@inlined
def _raise_diagonal(m, i, k, more):
    """Add ``more`` (3,) to the diagonal of the block at i, i."""
    m[i, i, k], m[i + 1, i + 1, k], m[i + 2, i + 2, k] = (
        m[i, i, k] + more[0], m[i + 1, i + 1, k] + more[1], m[i + 2, i + 2, k] + more[2],
    )  # fmt: skip


@inlined
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _plus(a, f, b, c):
    """A + f B C' (3 x 3)."""
    x, y, z = c
    return (
        (a[0][0] + f * _dot(b[0], x), a[0][1] + f * _dot(b[0], y), a[0][2] + f * _dot(b[0], z)),
        (a[1][0] + f * _dot(b[1], x), a[1][1] + f * _dot(b[1], y), a[1][2] + f * _dot(b[1], z)),
        (a[2][0] + f * _dot(b[2], x), a[2][1] + f * _dot(b[2], y), a[2][2] + f * _dot(b[2], z)),
    )


@inlined
def _transposed(a):
    x, y, z = a
    return (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])


@inlined
def _inverse(a, least):
    """Of a symmetric 3 x 3 matrix, its pivots raised to ``least``; what that adds to its diagonal.

    ``A + E = L D L'`` with L's entries l, m (first column) and n.
    """
    d = a[0][0] if a[0][0] > least[0] else least[0]
    l, m, x = a[0][1] / d, a[0][2] / d, 1.0 / d
    pivot = a[1][1] - l * a[0][1]
    e = pivot if pivot > least[1] else least[1]
    rest = a[1][2] - l * a[0][2]
    n, y = rest / e, 1.0 / e
    last = a[2][2] - m * a[0][2] - n * rest
    f = last if last > least[2] else least[2]
    z, k = 1.0 / f, l * n - m
    ny, nz = -l * y - k * n * z, -n * z
    return (
        ((x + l * l * y + k * k * z, ny, k * z), (ny, y + n * n * z, nz), (k * z, nz, z)),
        (d - a[0][0], e - pivot, f - last),
    )


@inlined
def invert_mass(lanes, m, lightest, inverse):
    """Lower half of the inverses (6, 6, lanes) of symmetric m (6, 6, lanes) = [[A, B'], [B, D]].

    In 3 x 3 blocks, with V = A^-1 B', the Schur complement S = D - B V and U = V S^-1::

        m^-1 = [[A^-1 + U V', -U], [-U', S^-1]]

    The pivots of A and S are those of m. Where one is less than ``lightest`` (6,), m has no inertia
    left in some direction, as the outer points of a wide prior may have: m gets so much more on its
    diagonal that it has (as in Gill, Murray and Wright 1981, sec. 4.4.2.2).
    """
    none = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    first = lightest[0], lightest[1], lightest[2]
    last = lightest[3], lightest[4], lightest[5]
    for k in range(lanes):
        b = _block(m, 3, 0, k)
        a, more = _inverse(_block(m, 0, 0, k), first)
        v = _plus(none, 1.0, a, b)
        s, yet_more = _inverse(_plus(_block(m, 3, 3, k), -1.0, b, _transposed(v)), last)
        u = _plus(none, 1.0, v, s)
        _put(inverse, 0, 0, k, 1.0, _plus(a, 1.0, u, v))
        _put(inverse, 3, 0, k, -1.0, _transposed(u))
        _put(inverse, 3, 3, k, 1.0, s)
        _raise_diagonal(m, 0, k, more)
        _raise_diagonal(m, 3, k, yet_more)


@inlined
def invert_translation(lanes, m, lightest, inverse):
    """The same for a vehicle that turns as measured: A^-1, and zeros, as forces turn nothing."""
    none = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    least = lightest[0], lightest[1], lightest[2]
    for k in range(lanes):
        a, more = _inverse(_block(m, 0, 0, k), least)
        _put(inverse, 0, 0, k, 1.0, a)
        _put(inverse, 3, 0, k, 1.0, none)
        _put(inverse, 3, 3, k, 1.0, none)
        _raise_diagonal(m, 0, k, more)
