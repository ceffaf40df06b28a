"""Attitude inside the kernels: what ``frames`` does for arrays, for one quaternion at a time."""

import math

import numpy as np

from rov_ident.core import frames
from rov_ident.core.jit import inlined, kernel

product = inlined(frames.product)
rotation_of = inlined(frames.rotation_rows)


@inlined
def rotate(q, r):
    """r (3, 3) = R, body -> world, of the unit quaternion q (4,)."""
    a, b, c = rotation_of(q[0], q[1], q[2], q[3])
    for j in range(3):
        r[0, j], r[1, j], r[2, j] = a[j], b[j], c[j]


@kernel
def rotation(q):
    """R (3, 3), body -> world, of the unit quaternion q (4,)."""
    r = np.empty((3, 3))
    rotate(q, r)
    return r


@kernel
def turned(q, angle):
    """q after turning by the rotation vector ``angle`` (3,) [rad] in body axes; unit length."""
    half = 0.5 * math.sqrt(angle[0] ** 2 + angle[1] ** 2 + angle[2] ** 2)
    s = 0.5 * (math.sin(half) / half if half > 1e-9 else 1.0 - half * half / 6.0)
    c, x, y, z = math.cos(half), s * angle[0], s * angle[1], s * angle[2]
    p = np.array(product(q[0], q[1], q[2], q[3], c, x, y, z))
    length = math.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2 + p[3] ** 2)
    for i in range(4):
        p[i] /= length
    return p
