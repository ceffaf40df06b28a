"""Smoothing of samples for offline fits, which know what came later; a live estimator cannot.

The gyro's bias, known worst in the first seconds, is the one known two minutes later. The attitude
is smoothed: gravity's direction times buoyancy is a moment, and an error of it that lasts for
seconds cannot be told from one of the coefficients. The integrated rates give Q, off by a random
walk d that the measured attitudes see with white noise (a local-level model; Durbin and Koopman
2012, ch. 2)::

    q = exp(d) Q,   d[k] = d[k - 1] + w,   log(q_measured Q^-1) = d + v

v's variance is half that of the differences of successive measurements; w's that of the rates'
noise times the factor of highest likelihood, as integration has errors of its own.
"""

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.frames import quaternion_multiply, rotation_vector
from rov_ident.core.jit import kernel
from rov_ident.core.linalg import interpolated
from rov_ident.core.noise import robust_std
from rov_ident.core.quaternions import rotation, turned
from rov_ident.sampling.kinematic_filter import slope_of_mean
from rov_ident.sampling.sample import stretches

_LOOK_AHEAD = 120.0  # s; a bias has wandered by 5 % of its prior's deviation in this time, and the
# odometry's rates have told it to a tenth of their own noise
_FACTORS = np.array([1.0, 3.0, 10.0, 30.0, 100.0, 1000.0])
_FEWEST = 10  # measured attitudes; fewer do not tell their noise


def smoothed(samples: NDArray[np.void]) -> NDArray[np.void]:
    """Samples (k,) of SAMPLE with bias and attitude smoothed over each stretch without a gap."""
    out = samples.copy()
    for first, end in stretches(samples):
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
    if len(seen) < _FEWEST:
        return
    inertial = np.isfinite(part["gyro"][:, 0])
    rate_variance = np.where(inertial, part["gyro_variance"], part["odometry_variance"][:, 3])
    ahead = np.empty((len(part), 4))
    _integrate(part["attitude"][seen[0]], seen[0], part["nu"], part["dt"], ahead)
    # the turn in world axes from what the rates make of the first attitude to each measured one
    conjugate = ahead[seen] * [1.0, -1.0, -1.0, -1.0]
    off = rotation_vector(quaternion_multiply(part["attitude"][seen], conjugate))
    steps = np.diff(off, axis=0)
    noise = 0.5 * float(robust_std(steps, axis=None)) ** 2 + 1e-12
    grown = rate_variance * part["dt"] ** 2  # each over the step that ends there
    walk = np.add.reduceat(grown[1 : seen[-1] + 1], seen[:-1]) + 1e-12
    error, best = off, np.inf
    for factor in _FACTORS:
        level, cost = _local_level(off, noise, factor * walk)
        if cost < best:
            error, best = level, cost
    t = part["t"]
    error = interpolated(t[seen], error, t)
    down = np.empty((len(part), 3))
    _correct_attitude(ahead, error, part["orientation"], down)
    part["down"] = down
    _take_slopes(down, part["nu"][:, 3:], np.maximum(part["dt"], 1e-6), part["down_slope"])


@kernel
def _integrate(q, first, nu, dt, out):
    """Attitudes (k, 4) by the rates nu (k, 6) from q at ``first``, in both directions."""
    out[first] = q / np.sqrt(np.sum(q**2))
    for k in range(first + 1, len(out)):
        out[k] = turned(out[k - 1], 0.5 * (nu[k - 1, 3:] + nu[k, 3:]) * dt[k])
    for k in range(first - 1, -1, -1):
        out[k] = turned(out[k + 1], -0.5 * (nu[k + 1, 3:] + nu[k, 3:]) * dt[k + 1])


@kernel
def _take_slopes(down, rate, dt, out):
    """As a sample has them (k, 3), of down (k, 3) and rates (k, 3); the first stays."""
    for k in range(1, len(out)):
        for i in range(3):
            out[k, i] = slope_of_mean(down[k - 1], down[k], rate[k - 1], rate[k], dt[k], i)


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
def _correct_attitude(q, error, orientation, down):
    """orientation = exp(error) q, down the third row of its matrix."""
    for k in range(len(q)):
        r = rotation(q[k])
        body = np.zeros(3)
        for i in range(3):
            for j in range(3):
                body[i] += r[j, i] * error[k, j]
        orientation[k] = turned(q[k], body)
        down[k] = rotation(orientation[k])[2]
