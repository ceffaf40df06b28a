"""From the log of a sea trial to what a fit can use: polarity, outliers, smoothing, cutting, and
several sources of depth fused into one (Zhao et al. 2018, sec. 3).

In the axes and units of the log. Lever arms are corrected later, by
``odometry.position`` and ``imu.position`` of the configuration.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.errors import UserError
from rov_ident.core.noise import robust_std
from rov_ident.model.equations import Array

_MEASURED = ("u", "v", "w", "p", "q", "r")
_DRIVES = ("X", "Y", "Z", "K", "M", "N", "delta_s", "delta_r", "delta_a", "rpm")
_UNEVEN = 0.1  # of a step: by so much steps may differ where a filter takes them as even
_NEIGHBOURS = 11  # rows that have a median, a choice
_OUTLIER = 5.0  # robust standard deviations
_AGILITY = 0.2  # m/s^1.5; of the random walk of a rate of depth
_GATE = 5.0  # standard deviations beyond which a depth is refused
_DRIVEN = 0.1  # of the most on an axis or of a fin; what holds a vehicle in place is below


@dataclass(frozen=True)
class Preparation:
    """What is done to a log, in this order; nothing by default.

    ``polarity``: columns that were recorded with the opposite sign. ``depth``: columns that measure
    `z`, with the standard deviations [m] of their noise and of their common error. ``smooth``: the
    corner [Hz] of a filter without lag on the velocities. ``cut``: from when to when [s] in the
    log's time. ``cut_idle``: what is kept [s] before and after the vehicle is driven.
    """

    polarity: tuple[str, ...] = ()
    despike: bool = False
    depth: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    smooth: float | None = None
    cut: tuple[float, float] | None = None
    cut_idle: float | None = None

    def __call__(
        self, data: Mapping[str, Array], depths: Mapping[str, Array]
    ) -> tuple[dict[str, Array], NDArray[np.bool_], list[str]]:
        """The columns (n,) of a log prepared, the rows (n,) to keep, and in words what was done.

        ``depths`` are the columns named in ``depth``, NaN where they are empty.

        Raises UserError if the log has no such column, or nothing of it would be left.
        """
        data, notes, t = dict(data), [], data["t_s"]
        for name in self.polarity:
            if name not in data or name == "t_s":
                raise UserError(f"the log has no `{name}` to turn the sign of")
            data[name] = -data[name]
        if self.despike:
            counts = {}
            for name in _MEASURED:
                data[name], bad = despiked(data[name])
                counts[name] = np.count_nonzero(bad)
            found = ", ".join(f"{count} of {name}" for name, count in counts.items() if count)
            notes.append(f"outliers replaced: {found or 'none'}")
        if self.depth:
            sources = [
                Source(name, t[known], z[known], *self.depth[name])
                for name, z in depths.items()
                if (known := np.isfinite(z)).any()
            ]
            together = fused(sources, t)
            data["z"] = together.value
            off = ", ".join(f"{name} {bias:+.2f} m" for name, bias in together.bias.items())
            std = float(np.median(together.std))
            notes.append(f"z from {len(sources)} sources, to {std:.3f} m; they are off by {off}")
        if self.smooth is not None:
            steps = np.diff(t)
            period = float(np.median(steps))
            if np.abs(steps - period).max() > _UNEVEN * period:
                raise UserError("rows at an uneven rate cannot be smoothed: leave --smooth out")
            for name in _MEASURED:
                data[name] = smoothed(data[name], period, self.smooth)
        begin, end = self.cut or (-np.inf, np.inf)
        if self.cut_idle is not None:
            driven = np.column_stack([data[name] for name in _DRIVES if name in data])
            first, last = dynamic_stretch(t, driven, self.cut_idle)
            begin, end = max(begin, first), min(end, last)
        kept = (t >= begin) & (t <= end)
        if np.count_nonzero(kept) < 3:
            raise UserError(f"no rows are left between {begin:g} and {end:g} s: cut less")
        if not kept.all():
            notes.append(f"cut to {t[kept][0]:.1f} ... {t[kept][-1]:.1f} s of {t[-1]:.1f}")
        return data, kept, notes


def despiked(x: Array) -> tuple[Array, NDArray[np.bool_]]:
    """A signal (N,) with outliers replaced by the local median, and where they were.

    An outlier is further from the median of its neighbours than the robust standard deviation of
    that distance over the whole signal allows (Hampel 1974; Pearson 2002).
    """
    from scipy.ndimage import median_filter  # here: a fit of dives does not need it

    middle = median_filter(x, _NEIGHBOURS, mode="nearest")
    off = np.abs(x - middle)
    # many a value is the median itself, whatever the noise: those say nothing of the spread
    spread = float(robust_std(off[off > 0.0])) if off.any() else 0.0
    bad = off > _OUTLIER * max(spread, 1e-12)
    return np.where(bad, middle, x), bad


def smoothed(x: Array, period: float, corner: float) -> Array:
    """A signal (N,) sampled every ``period`` [s], 3 dB down at ``corner`` [Hz], without lag.

    By local cubics (Savitzky and Golay 1964). For pictures and starting values, not for a
    maximum-likelihood fit, which has the noise in its model.
    """
    from scipy.signal import savgol_coeffs, savgol_filter  # here: it takes its time to import

    if not corner < 0.5 / period:
        raise UserError(f"{corner:g} Hz is too high a corner at {1.0 / period:.3g} rows a second")
    half, gain = 1, 1.0
    while gain > np.sqrt(0.5):
        half += 1
        phase = 2.0 * np.pi * corner * period * np.arange(-half, half + 1)
        gain = float(savgol_coeffs(2 * half + 1, 3) @ np.cos(phase))
    width = 2 * half + 1
    if len(x) < width:
        raise UserError(f"{len(x)} rows are too few to smooth at {corner:g} Hz: {width} are needed")
    return savgol_filter(x, width, 3)


def dynamic_stretch(t: Array, drives: Array, margin: float) -> tuple[float, float]:
    """From when to when [s] the vehicle is driven: by wrench, fins or shaft (N, k), any of which
    differs from its first row by more than a share of the most it ever does.

    With ``margin`` s on either side: coasting down tells of drag.

    Raises UserError if nothing is ever driven.
    """
    effort = np.abs(drives - drives[0])
    most = effort.max(axis=0)
    driven = t[(effort > _DRIVEN * most).any(axis=1)]
    if not len(driven):
        raise UserError("what drives is the same throughout: there is no dynamic stretch to keep")
    return float(driven[0]) - margin, float(driven[-1]) + margin


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
    """Values (N,) with their standard deviations, and rates; biases by source."""

    value: Array
    rate: Array
    std: Array
    bias: dict[str, float]


def fused(sources: list[Source], t: Array) -> Fused:
    """Depth from several sources at the increasing instants t (N,), smoothed from both sides.

    A Kalman filter over value, rate and each source's bias, a Rauch-Tung-Striebel smoother back;
    the rate is a random walk. Measurements that are far off are refused, so a source that jumps
    does not spoil the others.

    Raises UserError if there is no source, or one is not in order of time.
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
    steps, last = [], events[0][0]
    for at, k, z in events:
        dt, last = at - last, at
        f = np.eye(n)
        f[0, 1] = dt
        q = np.zeros((n, n))
        q[:2, :2] = _AGILITY**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        x, p = f @ x, f @ p @ f.T + q
        steps.append(f)
        before.append((x, p))
        if k >= 0:
            h = np.zeros(n)
            h[0], h[2 + k] = 1.0, 1.0
            size = h @ p @ h + sources[k].std ** 2
            e = z - h @ x
            if e**2 <= _GATE**2 * size:
                gain = p @ h / size
                x, p = x + gain * e, p - np.outer(gain, h @ p)
        after.append((x, p))
    for i in range(len(events) - 2, -1, -1):
        (x, p), (later, narrow), (ahead, variance) = after[i], after[i + 1], before[i + 1]
        gain = p @ steps[i + 1].T @ np.linalg.pinv(variance, hermitian=True)
        after[i] = x + gain @ (later - ahead), p + gain @ (narrow - variance) @ gain.T
    wanted = [after[i] for i, e in enumerate(events) if e[1] < 0]
    values = np.array([x for x, _ in wanted])
    return Fused(
        values[:, 0],
        values[:, 1],
        np.sqrt(np.array([max(p[0, 0], 0.0) for _, p in wanted])),
        {s.name: float(values[-1, 2 + k]) for k, s in enumerate(sources)},
    )
