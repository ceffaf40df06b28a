"""Samples as they look afterwards: what a live estimator cannot know yet, and an offline fit can.

The gyro's bias is found from odometry and gyro as they come, so the first seconds know it worst;
each sample here takes the bias known later. The attitude, too, is smoothed from both sides. Its
error matters: gravity's direction times buoyancy is a moment, and an error that lasts for seconds
is not told from one of the coefficients.

Attitude: the integrated rates give Q, off by a random walk d that the measured attitudes see with
white noise (a local-level model; Durbin and Koopman 2012, ch. 2)::

    q = exp(d) Q,   d[k] = d[k - 1] + w,   log(q_measured Q^-1) = d + v

v's variance is half that of the differences of successive measurements; w's is the rates' noise,
times the factor that is likeliest, as integration has errors of its own.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rov_ident.attitude import rotation, turned
from rov_ident.jit import kernel
from rov_ident.model import Array

_LOOK_AHEAD = 120.0  # s; the gyro's bias is known that much later
_FACTORS = np.array([1.0, 3.0, 10.0, 30.0, 100.0, 1000.0])


def hindsight(samples: NDArray[np.void]) -> NDArray[np.void]:
    """Samples (k,) of SAMPLE with bias and attitude smoothed over each stretch without a gap."""
    out = samples.copy()
    edges = np.flatnonzero(samples["restart"])
    edges = np.unique(np.concatenate([[0], edges, [len(samples)]]))
    for first, end in pairwise(edges):
        part = out[first:end]
        later = np.searchsorted(part["t"], part["t"] + _LOOK_AHEAD, side="right") - 1
        change = part["gyro_bias"] - part["gyro_bias"][later]
        inertial = np.isfinite(part["gyro"][:, 0])
        part["gyro"][inertial] += change[inertial]
        part["nu"][inertial, 3:] += change[inertial]
        _smooth(part)
    return out


def _smooth(part: NDArray[np.void]) -> None:
    """Smooth orientation, down and its slope in place."""
    seen = np.flatnonzero(np.isfinite(part["attitude"][:, 0]))
    if len(seen) < 10:
        return
    inertial = np.isfinite(part["gyro"][:, 0])
    rate_variance = np.where(inertial, part["gyro_variance"], part["odometry_variance"][:, 3])
    ahead = np.empty((len(part), 4))
    _integrate(part["attitude"][seen[0]], seen[0], part["nu"], part["dt"], ahead)
    off = _rotation_vector(part["attitude"][seen], ahead[seen])
    steps = np.diff(off, axis=0)
    noise = 0.5 * float(np.median(np.abs(steps)) / 0.6745) ** 2 + 1e-12
    walk = np.add.reduceat(rate_variance * part["dt"] ** 2, seen)[:-1] + 1e-12
    smoothed, best = off, np.inf
    for factor in _FACTORS:
        level, cost = _local_level(off, noise, factor * walk)
        if cost < best:
            smoothed, best = level, cost
    t = part["t"]
    error = np.stack([np.interp(t, t[seen], column) for column in smoothed.T], axis=1)
    down = np.empty((len(part), 3))
    _turn(ahead, error, part["orientation"], down)
    part["down"] = down
    dt = np.maximum(part["dt"][1:], 1e-6)
    part["down_slope"][1:] = (down[1:] - down[:-1]) / dt[:, None]


def _rotation_vector(q: Array, reference: Array) -> Array:
    """log(q reference^-1) (k, 3): the turn in world axes from the reference to q."""
    w, x, y, z = q.T
    a, b, c, d = (reference * [1.0, -1.0, -1.0, -1.0]).T
    real = w * a - x * b - y * c - z * d
    vector = np.stack(
        [
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=1,
    )
    vector = np.where(real[:, None] < 0.0, -vector, vector)
    size = np.linalg.norm(vector, axis=1)
    angle = 2.0 * np.arctan2(size, np.abs(real))
    turn: Array = vector * (angle / np.maximum(size, 1e-12))[:, None]
    return turn


@kernel
def _integrate(q, first, nu, dt, out):
    """Attitudes (k, 4) by the rates nu (k, 6) from q at ``first``, in both directions."""
    out[first] = q / np.sqrt(np.sum(q**2))
    for k in range(first + 1, len(out)):
        out[k] = turned(out[k - 1], 0.5 * (nu[k - 1, 3:] + nu[k, 3:]) * dt[k])
    for k in range(first - 1, -1, -1):
        out[k] = turned(out[k + 1], -0.5 * (nu[k + 1, 3:] + nu[k, 3:]) * dt[k + 1])


@kernel
def _local_level(z, noise, walk):
    """Levels (n, 3) of z (n, 3) smoothed from both sides; minus twice the log-likelihood."""
    n = len(z)
    level, variance, ahead = z.copy(), np.empty(n), np.empty(n)
    variance[0], cost = noise, 0.0
    for k in range(1, n):
        ahead[k] = variance[k - 1] + walk[k - 1]
        total = ahead[k] + noise
        gain = ahead[k] / total
        variance[k] = (1.0 - gain) * ahead[k]
        for i in range(3):
            e = z[k, i] - level[k - 1, i]
            level[k, i] = level[k - 1, i] + gain * e
            cost += e * e / total + np.log(total)
    for k in range(n - 2, -1, -1):
        gain = variance[k] / ahead[k + 1]
        for i in range(3):
            level[k, i] += gain * (level[k + 1, i] - level[k, i])
    return level, cost


@kernel
def _turn(q, error, orientation, down):
    """orientation = exp(error) q, down the third row of its matrix."""
    for k in range(len(q)):
        r = rotation(q[k])
        body = np.zeros(3)
        for i in range(3):
            for j in range(3):
                body[i] += r[j, i] * error[k, j]
        better = turned(q[k], body)
        for i in range(4):
            orientation[k, i] = better[i]
        down[k] = rotation(better)[2]
