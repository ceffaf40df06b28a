"""From the logs of a sea trial to what a fit can use: lever arms, outliers, smoothing, cutting,
and several sources of one quantity fused (Zhao et al. 2018, sec. 3).

All in core axes: body forward starboard down, world north east down; SI units.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.signal import savgol_filter

from rov_ident.errors import UserError
from rov_ident.frames import acceleration_of_arm, velocity_of_arm
from rov_ident.model import Array

_ROBUST = 1.4826  # standard deviation of a Gaussian over its median absolute deviation


# ------------------------------------------------------------------ lever arms


def velocity_at_origin(velocity: Array, omega: Array, lever: Array) -> Array:
    """v = v_s - omega x r (N, 3), of a sensor at r (3,) from the body origin."""
    out: Array = velocity - velocity_of_arm(omega, lever)
    return out


def acceleration_at_origin(
    acceleration: Array, omega: Array, omega_dot: Array, lever: Array
) -> Array:
    """a = a_s - omega_dot x r - omega x (omega x r) (N, 3); specific force likewise."""
    out: Array = acceleration - acceleration_of_arm(omega, omega_dot, lever)
    return out


def position_at_origin(position: Array, rotation: Array, lever: Array) -> Array:
    """pos = pos_s - R r (N, 3), rotation (N, 3, 3) body -> world."""
    out: Array = position - rotation @ lever
    return out


# ------------------------------------------------------------------ one signal


def without_outliers(
    x: Array, width: int = 11, limit: float = 5.0
) -> tuple[Array, NDArray[np.bool_]]:
    """A signal (N, ...) with outliers replaced by the local median, and where they were.

    An outlier is further from the median of ``width`` neighbours than ``limit`` robust standard
    deviations of that distance over the whole signal (Hampel).
    """
    x = np.asarray(x, dtype=float)
    if width < 3 or width % 2 == 0:
        raise UserError(
            f"an outlier is judged by an odd number of neighbours from 3 on, not {width}"
        )
    middle = median_filter(x, (width,) + (1,) * (x.ndim - 1), mode="nearest")
    off = np.abs(x - middle)
    # many a value is the median itself, whatever the noise: those say nothing of the spread
    spread = _ROBUST * np.nanmedian(np.where(off > 0.0, off, np.nan), axis=0)
    spread = np.nan_to_num(spread)
    bad = off > limit * np.maximum(spread, 1e-12)
    return np.where(bad, middle, x), bad


def smoothed(x: Array, dt: float, time: float = 0.3) -> tuple[Array, Array]:
    """A signal (N, ...) sampled every dt [s] and its derivative, by local cubics over ``time`` s.

    No lag, but what is faster than ``time`` is lost: for pictures and starting values, not for a
    maximum-likelihood fit, which has the noise in its model.
    """
    width = max(5, 2 * round(0.5 * time / dt) + 1)
    if len(x) < width:
        raise UserError(
            f"{len(x)} points are too few to smooth over {time:g} s: {width} are needed"
        )
    return (
        savgol_filter(x, width, 3, axis=0),
        savgol_filter(x, width, 3, deriv=1, delta=dt, axis=0),
    )


def dynamic_stretch(
    t: Array, wrench: Array, margin: float = 5.0, share: float = 0.1
) -> tuple[float, float]:
    """From when to when [s] the vehicle is driven: |wrench| (N,) above ``share`` of its largest.

    With ``margin`` s on either side: coasting down tells of drag.

    Raises
    ------
    UserError
        If nothing is ever driven.
    """
    size = np.abs(wrench)
    if not size.max() > 0.0:
        raise UserError("the wrench is zero throughout: there is no dynamic stretch to cut out")
    driven = t[size > share * size.max()]
    return max(float(driven[0]) - margin, float(t[0])), min(
        float(driven[-1]) + margin, float(t[-1])
    )


# ------------------------------------------------------------------ several sources


@dataclass(frozen=True)
class Source:
    """Measurements of one quantity: ``z`` (N,) at ``t`` (N,) s with noise ``std``.

    ``bias_std``: how far all of them may be off together; the one with the smallest decides where
    zero is.
    """

    name: str
    t: Array
    z: Array
    std: float
    bias_std: float = 0.0


@dataclass(frozen=True)
class Fused:
    """Values and rates at the instants ``t``, with their standard deviations; biases by source."""

    t: Array
    value: Array
    rate: Array
    std: Array
    bias: dict[str, float]


def fused(sources: list[Source], t: Array, agility: float = 0.2, gate: float = 5.0) -> Fused:
    """One quantity (depth) from several sources, smoothed from both sides.

    A Kalman filter over value, rate and each source's bias, a Rauch-Tung-Striebel smoother back;
    the rate is a random walk of ``agility`` [unit / s^1.5]. Measurements beyond ``gate`` standard
    deviations are refused, so a source that jumps does not spoil the others.

    Raises
    ------
    UserError
        If there is no source, or one is not in order of time.
    """
    if not sources:
        raise UserError("nothing to fuse: give at least one source")
    for s in sources:
        if len(s.t) != len(s.z) or np.any(np.diff(s.t) <= 0.0):
            raise UserError(f"source {s.name}: times must increase, one to each value")
    n = 2 + len(sources)
    events = sorted(
        [(at, k, z) for k, s in enumerate(sources) for at, z in zip(s.t, s.z) if np.isfinite(z)]
        + [(at, -1, 0.0) for at in t]
    )
    first = next(e for e in events if e[1] >= 0)
    x, p = np.zeros(n), np.diag([1e4, 1.0, *(s.bias_std**2 for s in sources)])
    x[0] = first[2]
    before: list[tuple[Array, Array]] = []  # predicted
    after: list[tuple[Array, Array]] = []
    steps: list[Array] = []
    last = events[0][0]
    for at, k, z in events:
        dt, last = at - last, at
        f = np.eye(n)
        f[0, 1] = dt
        q = np.zeros((n, n))
        q[:2, :2] = agility**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        x, p = f @ x, f @ p @ f.T + q
        steps.append(f)
        before.append((x, p))
        if k >= 0:
            h = np.zeros(n)
            h[0], h[2 + k] = 1.0, 1.0
            size = h @ p @ h + sources[k].std ** 2
            e = z - h @ x
            if e**2 <= gate**2 * size:
                gain = p @ h / size
                x, p = x + gain * e, p - np.outer(gain, h @ p)
        after.append((x, p))
    x, p = after[-1]
    found = {len(events) - 1: (x, p)}
    for i in range(len(events) - 2, -1, -1):
        ahead, variance = before[i + 1]
        gain = after[i][1] @ steps[i + 1].T @ np.linalg.pinv(variance, hermitian=True)
        x, p = after[i][0] + gain @ (x - ahead), after[i][1] + gain @ (p - variance) @ gain.T
        found[i] = (x, p)
    wanted = [i for i, e in enumerate(events) if e[1] < 0]
    values = np.array([found[i][0] for i in wanted])
    return Fused(
        np.sort(np.asarray(t)),
        values[:, 0],
        values[:, 1],
        np.sqrt(np.array([max(found[i][1][0, 0], 0.0) for i in wanted])),
        {s.name: float(values[-1, 2 + k]) for k, s in enumerate(sources)},
    )
