"""Smoothing of samples for offline fits, which know what came later; a live estimator cannot.

The gyro's bias, known worst in the first seconds, is the one known two minutes later. The attitude
is smoothed: gravity's direction times buoyancy is a moment, and an error of it that lasts for
seconds cannot be told from one of the coefficients. The integrated rates give Q, off by a random
walk d that the measured attitudes see with white noise v and with an error a that lasts (a local
level; Durbin and Koopman 2012, ch. 2 to 4)::

    q = exp(d) Q,   d[k] = d[k - 1] + w,   log(q_measured Q^-1) = d + a + v
    a[k] = r a[k - 1] + white noise,       r = exp(-dt / T)

v's variance is half that of the differences of successive measurements. A dive tells little of a's,
and of the factor by which w's is that of the rates' noise, as integration has errors of its own:
the level is the mean over a grid of both, by their likelihood (Bayesian model averaging). The drift
of the rates, a slow random walk too, is one more state.

The error of the level that is left, of a and w, has at the angular frequency f the density that
two sources of the densities q / f^2 (of d, by the rates) and A (of a) leave together::

    1 / (f^2 / q + 1 / A) = S / (1 + (f t)^2),   S = 2 T var(a),   t^2 = T^2 + S / q

as A is S / (1 + (f T)^2). So it lasts for t, and its variance is S / 2 t.
"""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.config.prior import ATTITUDE_LASTS
from rov_ident.core.frames import quaternion_multiply, rotation_vector
from rov_ident.core.jit import kernel
from rov_ident.core.linalg import interpolated
from rov_ident.core.messages import Array
from rov_ident.core.noise import robust_std
from rov_ident.core.quaternions import rotation, turned
from rov_ident.sampling.kinematic_filter import BIAS_TIME, slope_of_mean
from rov_ident.sampling.sample import stretches

_LOOK_AHEAD = 120.0  # s; a bias has wandered by 5 % of its prior's deviation in this time, and the
# odometry's rates have told it to a tenth of their own noise
_FACTORS = np.array([0.01, 0.03, 0.1, 0.3, 1.0, 1.7, 3.0, 5.5, 10.0, 30.0, 100.0, 1000.0])
_STATED = 3.0  # a factor as far from one as a standard deviation, before any data: in two minutes
# of an attitude that wanders, a gyro five times as noisy as stated may be as likely
_LASTING = np.append(0.0, np.geomspace(0.1, 1.6, 9))  # of the stated deviation of an attitude
_FEWEST = 10  # measured attitudes; fewer do not tell their noise


def smoothed(samples: NDArray[np.void], config: Config) -> NDArray[np.void]:
    """Samples (k,) of SAMPLE with bias and attitude smoothed over each stretch without a gap."""
    out = samples.copy()
    for first, end in stretches(samples):
        part = out[first:end]
        later = np.searchsorted(part["t"], part["t"] + _LOOK_AHEAD, side="right") - 1
        change = part["gyro_bias"] - part["gyro_bias"][later]
        inertial = np.isfinite(part["gyro"][:, 0])
        part["gyro"][inertial] += change[inertial]
        part["nu"][inertial, 3:] += change[inertial]
        _smooth(part, config)
    return out


def _smooth(part: NDArray[np.void], config: Config) -> None:
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
    grown = rate_variance * part["dt"] ** 2  # each over the step that ends there
    walk = np.add.reduceat(grown[1 : seen[-1] + 1], seen[:-1]) + 1e-12
    t = part["t"]
    # a compass has errors of another size
    (tilt, variance, lasts), (heading, *_) = (
        _mean_level(off[:, axes], walk, np.diff(t[seen]), config) for axes in ([0, 1], [2])
    )
    part["tilt_variance"], part["tilt_lasts"] = variance, lasts
    error = np.column_stack([tilt, heading])
    error = interpolated(t[seen], error, t)
    down = np.empty((len(part), 3))
    _correct_attitude(ahead, error, part["orientation"], down)
    part["down"] = down
    _take_slopes(down, part["nu"][:, 3:], np.maximum(part["dt"], 1e-6), part["down_slope"])


def _mean_level(
    off: Array, walk: Array, between: Array, config: Config
) -> tuple[Array, float, float]:
    """The level (n, m) of what is off (n, m), n - 1 times ``between`` [s] one and the next; and
    variance [rad2] and time [s] of its error. ``walk`` (n - 1,): variance of w as the rates' noise
    makes it."""
    noise = 0.5 * float(robust_std(np.diff(off, axis=0), axis=None)) ** 2 + 1e-12
    keep = np.exp(-between / ATTITUDE_LASTS)
    bias = config.imu.gyro_bias_std**2 * np.array([1.0, 1.0 / BIAS_TIME])
    best, weights = np.inf, 0.0
    level, errors = np.zeros_like(off), np.zeros(2)
    for factor, share in itertools.product(_FACTORS, _LASTING):
        lasting = (share * config.odometry.attitude_std) ** 2
        by_these, cost = _local_level(off, noise, factor * walk, lasting, keep, between, bias)
        cost += (math.log(factor) / math.log(_STATED)) ** 2
        density = 2.0 * ATTITUDE_LASTS * lasting
        walked = density * between.sum() / (factor * walk.sum())
        variance = 0.5 * density / math.hypot(ATTITUDE_LASTS, math.sqrt(walked))
        if cost < best:  # weights are relative to the likeliest
            before = math.exp(0.5 * (cost - best))
            best, weights, level, errors = cost, before * weights, before * level, before * errors
        weight = math.exp(0.5 * (best - cost))
        weights += weight
        level += weight * by_these
        errors += weight * np.array([variance, density])
    variance, density = errors / weights
    return level / weights, variance, 0.5 * density / max(variance, 1e-300)


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
def _local_level(z, noise, walk, lasting, keep, dt, bias):
    """Levels (n, m) of z (n, m) smoothed from both sides; minus twice the log-likelihood.

    m times a Kalman filter of level, lasting error and drift, with one covariance, and from
    behind the smoother of Durbin and Koopman (2012, sec. 4.4). ``bias``: variance of the drift and
    what is added to it in a second.
    """
    n, m = z.shape
    x, p = np.zeros((n, 3, m)), np.zeros((n, 3, 3))  # as predicted
    e, total, gain, seen = np.zeros((n, m)), np.full(n, np.inf), np.zeros((n, 3)), np.zeros(3)
    cost = 0.0
    x[0, 0] = z[0]  # the first one is all that is known of the level
    p[0, 0, 0], p[0, 1, 1], p[0, 2, 2] = noise + lasting, lasting, bias[0]
    p[0, 0, 1] = p[0, 1, 0] = -lasting
    for k in range(1, n):
        span, kept, now = dt[k - 1], keep[k - 1], p[k]
        for i in range(3):
            for j in range(m):
                x[k, i, j] = x[k - 1, i, j] + gain[k - 1, i] * e[k - 1, j]
            for j in range(3):
                now[i, j] = p[k - 1, i, j] - gain[k - 1, i] * seen[j]
        for j in range(m):
            x[k, 0, j] += span * x[k, 2, j]
            x[k, 1, j] *= kept
        for j in range(3):
            now[0, j] += span * now[2, j]
            now[1, j] *= kept
        for i in range(3):
            now[i, 0] += span * now[i, 2]
            now[i, 1] *= kept
        now[0, 0] += walk[k - 1]
        now[1, 1] += (1.0 - kept**2) * lasting
        now[2, 2] += span * bias[1]
        for i in range(3):
            seen[i] = now[i, 0] + now[i, 1]
        total[k] = seen[0] + seen[1] + noise
        for i in range(3):
            gain[k, i] = seen[i] / total[k]
        for j in range(m):
            e[k, j] = z[k, j] - x[k, 0, j] - x[k, 1, j]
            cost += e[k, j] ** 2 / total[k] + np.log(total[k])
    level, back = np.zeros((n, m)), np.zeros((3, m))
    for k in range(n - 1, -1, -1):
        for j in range(m):
            told = e[k, j] / total[k]
            for i in range(3):
                told -= gain[k, i] * back[i, j]
            back[0, j] += told
            back[1, j] += told
            level[k, j] = x[k, 0, j]
            for i in range(3):
                level[k, j] += p[k, 0, i] * back[i, j]
            if k > 0:
                back[1, j] *= keep[k - 1]
                back[2, j] += dt[k - 1] * back[0, j]
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
