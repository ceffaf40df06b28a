"""Whether the sensors agree with each other: pose against velocity, velocity against IMU.

No model of the vehicle is needed for this, so what a sensor does wrong is found before the
dynamics are looked at. Two kinds of dead reckoning in the world frame are compared with what is
measured directly (Titterton and Weston 2004, ch. 3)::

    position:  x(t) - integral of R v dt            velocity:  R v(t) - integral of (R f + g) dt

and the odometry's angular rate with the gyro. A dead-reckoned difference is a random walk plus
white noise; the one-step innovations of that local-level model (Durbin and Koopman 2012, ch. 2) are
white, and every regressor goes through the same filter: generalised least squares. All sensor
effects are linear to first order, and the fit is repeated about its own result.

A controller answers the noise of velocities, so what the vehicle does next depends on noise that is
in y. Noise is independent of regressors that are determined before it, as in the identification of
any closed loop (Ljung 1999, ch. 13): beside the IMU, accelerations and thrust are those before. And
innovations contain earlier noise as far as the gain of their filter goes, so what an answer may
pass for must show with a lesser gain, too. Of a vehicle that hardly accelerates, most of an
acceleration before a measurement is noise of the IMU, which the velocity that is dead-reckoned to
that measurement has, too: it seems late. Accelerations around a measurement have no more of it than
the velocity has on either side, and the pose by itself has none. So a delay is as uncertain as it
differs from what the nearer of these two says (the specification test of Hausman 1978).
"""

import dataclasses
import itertools
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.frames import (
    acceleration_of_arm,
    quaternion_to_matrix,
    rotated,
    velocity_of_arm,
)
from rov_ident.core.jit import kernel, released
from rov_ident.core.linalg import integral, interpolated, scaled_inverse, scaled_solve
from rov_ident.core.noise import robust_std
from rov_ident.core.quaternions import turned
from rov_ident.discrepancy.hypothesis import Key, bounds
from rov_ident.discrepancy.linearisation import LinearProblem
from rov_ident.discrepancy.selection import PENALTY, VERY_STRONG, Scores, variance_inflation
from rov_ident.discrepancy.windowed_problem import within
from rov_ident.effects import EFFECTS, Values, correct, velocity_delay
from rov_ident.effects.base import Reading
from rov_ident.model.equations import Array, Indices
from rov_ident.sampling.raw_streams import Streams, in_place, measured_at, orientation_at

# Gains of the local-level filter that are tried, from a random walk that hardly moves to one beside
# which the white noise is nothing, about a factor of three apart.
_GAINS = (0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 0.95)
_LESSER = 1.3  # times the least innovations: a gain of a third, "Controllers" in docs/explain.md
_ANSWERS = ("velocity_latency", "velocity_scale")  # what a controller's answer may pass for
_OUTLIER = 24.0  # robust standard deviations; wide, as what a sensor does wrong is still in them
_SMOOTHING = 0.2  # s; of angular rates: shorter than a vehicle turns, longer than noise
_DRIFT = 1.0  # s; from which the pose tells velocity better than the IMU
_STEADY = 0.5  # s; in which the pose tells velocity where there is no IMU
_ATTITUDE_TIME = 1.0  # s; in which the integrated gyro is drawn to the measured attitude
_MAX_GAP = 0.5  # s without a message: no step of dead reckoning reaches across
_REACH = 4.0  # standard deviations of a Gaussian filter, beyond which its weights are below 1e-4
_CLOCK = 0.05  # s by which the IMU's clock is set on: less than an ROV's response
_FEWEST_IMU = 8  # messages of the IMU; fewer are none
FEWEST = 20  # instants that are compared: about as many as there are parameters (16)
CLUSTER = 5.0  # s; of which residuals are correlated, as long as the windows of the dynamics
ROUNDS = 6  # of linearisation; each adds an effect or ends where changes are below ...
_SETTLED = 0.05  # ... this share of their standard deviations


@dataclass(frozen=True)
class Comparison:
    """White innovations r (N,) in units of their noise at times t (N,); ``columns`` (N, P): how
    much of r each parameter makes."""

    name: str
    t: Array
    r: Array
    columns: Array
    scale: float  # standard deviation of the noise, in the unit of the comparison
    white: float  # the same of what is white of it: what drifts makes innovations, too


_LIBRARY = [e for e in EFFECTS.values() if e.of_sensors and e.noise is None]

TIMING = (
    *(("thrust held", axis) for axis in "XYZ"),
    *(("arm of the imu", axis) for axis in "xyz"),
    ("clock", "imu"),
)
"""Nuisances: thrust that steps between two IMU samples is integrated as if it stepped elsewhere.

To the accelerations of thrust that is a time offset of milliseconds, the drag that answers to them
is not offset: together they would pass for a velocity scale of up to two percent. Further off than
half an interval of the IMU no step is. And the IMU's stamps may be early or late by milliseconds:
only a pose of their own clock tells that velocities are old. And the IMU may sit elsewhere than
configured: only a pose tells that of the velocities.
"""


def sensor_parameters() -> list[Key]:
    """Keys of all parameters of the effects of the velocity sensor and the IMU."""
    return [(e.name, p.name) for e in _LIBRARY for p in e.parameters]


def _keys() -> tuple[Key, ...]:
    """Of the columns of a comparison."""
    return (*sensor_parameters(), *TIMING)


def comparisons(
    streams: Streams, config: Config, effects: Values, tolerance: float = 1.0, around: bool = False
) -> list[Comparison]:
    """The comparisons that a bag allows, after correcting what ``effects`` say of the sensors;
    ``tolerance``, of velocities against the IMU, as :func:`whitened` has it. ``around``: with
    accelerations around a measurement, not before it."""
    keys = sensor_parameters()
    as_read = streams.nu[:, :3]
    streams = in_place(streams, effects)
    posed = streams.posed
    here, there, rate = _corrected_readings(streams, config, effects)
    r = quaternion_to_matrix(streams.orientation)
    inertial = _DeadReckoning(streams, config, there, rate) if has_imu(streams) else None

    # A regressor made of the very readings that it explains shares their noise: what the velocity
    # sensor's errors are made of is taken from the other sensors where there are any.
    width = _SMOOTHING / float(np.median(np.diff(streams.t)))
    turning, gyrating = (
        np.concatenate([_smoothed(x[piece], width) for piece in _pieces(streams.t, _SMOOTHING)])
        for x in (here.angular, here.gyro)
    )
    velocity = None if inertial is None else inertial.velocity_at(streams.t)
    moving = np.einsum("kji,kj->ki", r, _velocity(streams, r, here.linear, velocity))
    reading = Reading(moving, turning, gyrating, here.specific_force)
    moved = [_unit_change(reading, key, streams.t, r[:, 2]) for key in keys]
    made: list[tuple[str, Array, Array, list[Array]]] = []
    none = [np.zeros_like(here.linear)] * len(TIMING)
    if streams.has_pose:
        way, *ways = (integral(streams.t, rotated(r, m.linear)) for m in (here, *moved))
        y, *columns = (x[posed] for x in (streams.position - way, *(-w for w in ways), *none))
        made.append(("pose", streams.t[posed], y, columns))
    if inertial is not None:
        down = inertial.rotation[:, 2]
        moved_before = [
            _unit_change(reading, key, streams.t, r[:, 2], _slope_before)
            if EFFECTS[key[0]].late and not around
            else as_before
            for key, as_before in zip(keys, moved, strict=True)
        ]
        shift = [_unit_change(there, key, streams.imu_t, down) for key in keys]
        # As it is read, at the time of which it is: put back to its stamp between two readings, a
        # velocity has less noise than either, and any delay would seem to agree better.
        at = streams.t - velocity_delay(effects)
        inside = measured_at(streams.imu_t, at)
        r_then = quaternion_to_matrix(orientation_at(streams, at))
        read = Reading(as_read, *(interpolated(streams.t, x, at) for x in here[1:]))
        t = streams.t[inside]
        y = (rotated(r_then, correct(read, effects).linear) - inertial.velocity_at(at))[inside]
        columns = [
            rotated(r_then, interpolated(streams.t, m.linear, at))[inside]
            - inertial.integrated(s.specific_force, at)[inside]
            for m, s in zip(moved_before, shift, strict=True)
        ]
        # no stamp of a command that answers this very measurement is so far before it
        unaware = at[inside] - 0.5 * float(np.median(np.diff(streams.t)))
        held = np.clip(np.searchsorted(streams.demand_t, unaware, side="right") - 1, 0, None)
        thrust = streams.demand[held, :3] / config.model.body.mass
        columns += [r_then[inside][:, :, i] * thrust[:, i : i + 1] for i in range(3)]
        clock = none[-1]
        if streams.has_pose:
            late = dataclasses.replace(streams, imu_t=streams.imu_t + _CLOCK)
            before = _DeadReckoning(late, config, there, rate).velocity_at(at)
            clock = posed[:, None] * (inertial.velocity_at(at) - before) / _CLOCK
        arms = none[:3]
        if streams.has_pose:
            turned_then = interpolated(streams.t, gyrating, at)
            turned_then[~posed] = 0.0  # it takes a pose to tell
            arms = [-rotated(r_then, velocity_of_arm(turned_then, axis)) for axis in np.eye(3)]
        columns += [c[inside] for c in (*arms, clock)]
        made.append(("imu", t, y, columns))
        inside = measured_at(streams.imu_t, streams.t)
        t = streams.t[inside]
        y = here.angular[inside] - here.gyro[inside]
        columns = [m.angular[inside] - m.gyro[inside] for m in moved]
        made.append(("gyro", t, y, [*columns, *(n[inside] for n in none)]))
    return [
        Comparison(
            name,
            *whitened(t, y, columns, name != "gyro", tolerance if name == "imu" else 1.0),
            _white(t, y),
        )
        for name, t, y, columns in made
        if len(t) > FEWEST
    ]


def has_imu(streams: Streams) -> bool:
    """Whether there are enough messages of the IMU to say anything."""
    return len(streams.imu_t) > _FEWEST_IMU


def _corrected_readings(
    streams: Streams, config: Config, effects: Values
) -> tuple[Reading, Reading, Array]:
    """Odometry at its times and IMU at its own, corrected; angular rates (M, 3) as odometry reads
    them, at the times of the IMU."""
    mounting = config.imu.to_body
    gyro, nothing = streams.gyro @ mounting.T, np.zeros_like(streams.nu[:, 3:])
    rate = interpolated(streams.t, streams.nu[:, 3:], streams.imu_t)
    gyro_at = interpolated(streams.imu_t, gyro, streams.t) if has_imu(streams) else nothing
    here = Reading(streams.nu[:, :3], streams.nu[:, 3:], gyro_at, nothing)
    there = Reading(np.zeros_like(gyro), rate, gyro, streams.specific_force @ mounting.T)
    return correct(here, effects), correct(there, effects), rate


def _slope(t: Array, v: Array) -> Array:
    """Derivative of velocities (N, 3) at t (N,), from both sides: noise of a position, of which
    they are made, is not correlated with it."""
    out: Array = np.gradient(v, t, axis=0)
    return out


def _slope_before(t: Array, v: Array) -> Array:
    """The same since the last one: noise of the velocity sensor acts on what comes after it."""
    slope = np.diff(v, axis=0) / np.diff(t)[:, None]
    return np.concatenate([slope[:1], slope])


def _unit_change(
    reading: Reading,
    key: Key,
    t: Array,
    down: Array,
    slope: Callable[[Array, Array], Array] = _slope,
) -> Reading:
    """What one unit of a parameter adds to a reading at the times t (N,), where ``down`` (N, 3) is
    world down in body axes; of a heading, what turns a velocity in the world as much. ``slope``
    makes accelerations of velocities."""
    effect, none = EFFECTS[key[0]], np.zeros_like(down)
    if effect.late is not None:
        return Reading(-slope(t, reading.linear), none, none, none)
    if effect.heading is not None:
        turned_force = np.cross(down, reading.specific_force)
        return Reading(np.cross(down, reading.linear), none, none, turned_force)
    nulls = {p.name: p.null for p in effect.parameters}
    step = next(1e-4 * p.typical for p in effect.parameters if p.name == key[1])
    assert effect.sense is not None
    moved = effect.sense(reading, **{**nulls, key[1]: nulls[key[1]] + step})
    return Reading(*((b - a) / step for a, b in zip(reading, moved, strict=True)))


class _DeadReckoning:
    """Velocity in the world from the IMU alone: the integral of what it read, gravity included; it
    drifts. ``rotation`` (M, 3, 3) is the attitude along it."""

    def __init__(self, streams: Streams, config: Config, imu: Reading, rate: Array) -> None:
        self._t, self._gravity = streams.imu_t, config.gravity
        q = orientation_at(streams, streams.imu_t)
        known = measured_at(streams.t, streams.imu_t)
        self.rotation = quaternion_to_matrix(_attitude(q, known, streams.imu_t, imu.gyro, rate))
        lever, self._force = np.array(config.imu.position), imu.specific_force
        if lever.any():
            turn = np.gradient(imu.gyro, streams.imu_t, axis=0)
            self._force = self._force - acceleration_of_arm(imu.gyro, turn, lever)

    def velocity_at(self, at: Array) -> Array:
        """The velocity (N, 3) at times (N,), but for a constant."""
        return self.integrated(self._force, at) + np.outer(at, [0.0, 0.0, self._gravity])

    def integrated(self, force: Array, at: Array) -> Array:
        """The integral (N, 3) of specific forces (M, 3) turned into the world, at times (N,)."""
        return interpolated(self._t, integral(self._t, rotated(self.rotation, force)), at)


def _velocity(streams: Streams, r: Array, measured: Array, inertial: Array | None) -> Array:
    """Velocity (N, 3) in the world: long term from the pose, short term from the IMU, ``inertial``
    (N, 3), whose integral drifts. The velocity sensor stands in for either where it is missing."""
    t, width = streams.t, _STEADY if inertial is None else _DRIFT
    inertial = np.zeros_like(measured) if inertial is None else inertial
    in_world = rotated(r, measured)
    step = float(np.median(np.diff(t)))
    out = np.empty_like(measured)
    for piece in _pieces(t, width):
        own = inertial[piece] - inertial[piece][0]  # what it drifted by before is nothing here
        order = int(streams.posed[piece].all())
        way = streams.position[piece] - integral(t[piece], own)
        drifted = way if order else in_world[piece] - own
        even = t[piece][0] + step * np.arange(1 + round((t[piece][-1] - t[piece][0]) / step))
        rows = _smoothed(interpolated(t[piece], drifted, even), width / step, order)
        out[piece] = own + interpolated(even, rows / step**order, t[piece])
    return out


def _pieces(t: Array, width: float) -> list[slice]:
    """The times t (N,) between gaps across which a filter of this width [s] does not reach: after
    one the position of another record may begin."""
    edges = np.flatnonzero(np.diff(t) > _REACH * width) + 1
    return [slice(a, b) for a, b in itertools.pairwise([0, *edges.tolist(), len(t)])]


def _smoothed(x: Array, width: float, order: int = 0) -> Array:
    """Columns x (N, k) through a Gaussian filter of a width in steps, or their derivative."""
    from scipy.ndimage import gaussian_filter1d  # here, as all of it: fits do not need 30 MB

    out: Array = gaussian_filter1d(x, width, axis=0, order=order, truncate=_REACH)
    return out


def _attitude(
    measured: Array, known: NDArray[np.bool_], t: Array, gyro: Array, rate: Array
) -> Array:
    """Attitudes (M, 4): short term from the gyro (M, 3), long term as measured (complementary
    filter) where they are ``known`` (M,): not while the odometry pauses. A bias of the gyro would
    tilt them all: it is estimated first, from the odometry's ``rate`` (M, 3), then, finer, from the
    tilt itself."""
    out = measured.copy()
    for piece in _pieces(t, _DRIFT):
        there = known[piece] if known[piece].any() else ~known[piece]
        true = gyro[piece] - np.median((gyro[piece] - rate[piece])[there], axis=0)
        for _ in range(2):
            q = measured[piece].copy()
            _filter_attitude(q, there, t[piece], true)
            a, b = q[:, 1:], measured[piece, 1:]
            tilt = 2.0 * (q[:, :1] * b - measured[piece, :1] * a - np.cross(a, b))
            true = true + tilt[there].mean(axis=0) / _ATTITUDE_TIME
        out[piece] = q
    return out


@kernel
def _filter_attitude(q, known, t, rate):
    """Attitudes q (M, 4) become those of the gyro's rate (M, 3), drawn slowly to the given ones
    where these are ``known`` (M,), from the first of which they begin anew."""
    for i in range(1, len(t)):
        dt = t[i] - t[i - 1]
        if dt > _MAX_GAP or (known[i] and not known[i - 1]):
            continue
        ahead = turned(q[i - 1], 0.5 * (rate[i - 1] + rate[i]) * dt)
        gain = dt / (_ATTITUDE_TIME + dt) if known[i] else 0.0
        size = 0.0
        for j in range(4):
            q[i, j] = ahead[j] + gain * (q[i, j] - ahead[j])
            size += q[i, j] ** 2
        q[i] /= np.sqrt(size)


def whitened(
    t: Array, y: Array, columns: Sequence[Array], walk: bool, tolerance: float = 1.0
) -> tuple[Array, Array, Array, float]:
    """Innovations of the local-level model with the smallest gain that leaves no more than
    ``tolerance`` times the least of them: times, innovations and columns, in units of the noise, of
    what is no outlier, and the noise. Without a ``walk`` y is white as it is."""
    gap = np.diff(t, prepend=t[0]) > _MAX_GAP
    gap[0] = True
    every = np.stack([y, *columns], axis=-1)
    if walk:
        every = np.diff(every, axis=0, prepend=every[:1])
        every[gap] = 0.0
    use = np.append(True, every[..., 1:].any(axis=(0, 1)))
    shown = np.ascontiguousarray(every[..., use])
    spreads = {}
    for gain in _GAINS if walk else (None,):
        rows = _innovations(shown, gain, gap).reshape(y.size, -1)
        e, a = rows[:, 0], rows[:, 1:]
        spreads[gain] = float(robust_std(e - a @ scaled_solve(a.T @ a, a.T @ e, 1e-12)))
    smallest = min(spreads.values())
    best, least = next(item for item in spreads.items() if item[1] <= tolerance * smallest)
    found = _innovations(every, best, gap)
    e, full = found[..., 0], found[..., 1:]
    least = max(least, 1e-9)
    keep = np.abs(e - np.median(e, axis=0)) < _OUTLIER * least
    keep[gap & walk] = False
    return np.broadcast_to(t[:, None], e.shape)[keep], e[keep] / least, full[keep] / least, least


def _white(t: Array, y: Array) -> float:
    """Standard deviation of the white noise of y (N, 3): by how far each is from the line between
    its neighbours, on which a velocity stays whose accelerometer has a bias, one that drifts too.
    """
    share = ((t[1:-1] - t[:-2]) / (t[2:] - t[:-2]))[:, None]
    off = y[1:-1] - (1.0 - share) * y[:-2] - share * y[2:]
    even = np.max([np.diff(t)[:-1], np.diff(t)[1:]], axis=0) <= _MAX_GAP
    return float(robust_std((off / np.sqrt(1.0 + (1.0 - share) ** 2 + share**2))[even].ravel()))


def _innovations(steps: Array, gain: float | None, gap: NDArray[np.bool_]) -> Array:
    """Of the local-level filter with a gain, of how far each row (N, ...) is from the one before,
    begun anew after each gap; the rows themselves without."""
    if gain is None:
        return steps
    out = steps.copy()
    _fade(out.reshape(len(out), -1), gap, 1.0 - gain)
    return out


@released
def _fade(rows, gap, share):
    """Adds to each row a share of what the one before has become, unless there is a gap."""
    for i in range(1, len(rows)):
        for j in range(0 if gap[i] else rows.shape[1]):
            rows[i, j] += share * rows[i - 1, j]


class _Rows(NamedTuple):
    """Innovations ``error`` (R,), their ``columns`` (R, P), and where clusters of them begin."""

    columns: Array
    error: Array
    first: Indices


def _rows(
    found: Sequence[Comparison], spans: Sequence[tuple[float, float]], streams: Streams
) -> _Rows:
    """The rows whose time is in the spans, in clusters of CLUSTER seconds, and one for each thing
    that is known of a nuisance beforehand, in a cluster of their own."""
    use = [within(spans, c.t) for c in found]
    at = np.concatenate([np.zeros(0), *(c.t[k] // CLUSTER for c, k in zip(found, use))])
    order = np.argsort(at, kind="stable")
    none = np.zeros((0, len(_keys())))
    columns = np.concatenate([none, *(c.columns[k] for c, k in zip(found, use))])[order]
    r = np.concatenate([np.zeros(0), *(c.r[k] for c, k in zip(found, use))])[order]
    first = np.flatnonzero(np.diff(at[order], prepend=-1.0))
    if len(streams.imu_t) > 1:
        known = np.array([k[0] == "thrust held" for k in _keys()])
        # as far as a step is from the middle of the interval in which it falls, evenly spread
        width = float(np.median(np.diff(streams.imu_t))) / np.sqrt(12.0)
        first = np.append(first, len(r))
        columns = np.concatenate([columns, np.eye(len(known))[known] / width])
        r = np.append(r, np.zeros(known.sum()))
    return _Rows(columns, r, first)


def _linear(rows: _Rows) -> LinearProblem:
    edges = itertools.pairwise([*rows.first.tolist(), len(rows.error)])
    own = [rows.columns[a:b] for a, b in edges]
    size = rows.columns.shape[1]
    normals = np.array([x.T @ x for x in own]).reshape(-1, size, size)  # or of no cluster
    gradient = np.add.reduceat(rows.columns * rows.error[:, None], rows.first)
    rss = np.add.reduceat(rows.error**2, rows.first)
    return LinearProblem(_keys(), normals.sum(axis=0), gradient, rss, len(rows.error), normals)


def _fitted(rows: _Rows, at: Indices) -> _Rows:
    """The rows with what the columns ``at`` explain taken off the residuals."""
    base = rows.columns[:, at]
    change = scaled_solve(base.T @ base, base.T @ rows.error, 1e-9)
    return rows._replace(error=rows.error - base @ change)


def _scores(rows: _Rows, base: Sequence[Key]) -> Scores:
    """Each effect is judged by the scatter that it leaves, as what is missing makes residuals
    large; what nuisances explain is no scatter."""
    return Scores(_linear(_fitted(rows, _linear(rows).index(base))), base)


def common_squares(
    found: Sequence[Sequence[Comparison]],
    spans: Sequence[tuple[float, float]],
    unit: int = 0,
    length: float = CLUSTER,
) -> Array:
    """Squared innovations of ``found`` corrections of the sensors, at the instants in the spans
    where all count, in units of the noise of correction number ``unit``; and how many instants
    these are. Summed over chunks of ``length`` seconds: (C, corrections + 1, comparisons)."""
    sums: list[Array] = []
    for same in zip(*found, strict=True):
        times = [np.round(c.t, 6) for c in same]
        common = reduce(np.intersect1d, times)
        common = common[within(spans, common)]
        last = int(common[-1] / length) + 1 if len(common) else 0
        parts: list[Any] = []
        for c, t in zip(same, times, strict=True):
            use = np.isin(t, common)
            squares = (c.r[use] * (c.scale / same[unit].scale)) ** 2
            parts.append(np.bincount((t[use] / length).astype(int), squares, last))
        counts = np.bincount((common / length).astype(int), minlength=last)
        sums.append(np.stack([*parts, counts], axis=1))
    last = max(map(len, sums))
    out = np.stack([np.pad(s, ((0, last - len(s)), (0, 0))) for s in sums], axis=2)
    return out[out[:, -1].any(axis=1)]


def _shown(values: Values, std: Mapping[Key, float], keys: Sequence[Key]) -> list[Key]:
    """Those of the parameters ``keys`` whose effects a fit shows that ended at these values (Wald),
    where the linear view from far off did not: a delay of a fifth of a period is no longer its
    derivative, and what the first step leaves is as coloured as what it takes. At the end of the
    fit it is small, and so is what is left."""
    shown = []
    for name in dict.fromkeys(name for name, _ in keys):
        own = [k for k in keys if k[0] == name and std.get(k, 0.0) > 0.0]
        square = sum(((values[name][k[1]] - bounds(k)[0]) / std[k]) ** 2 for k in own)
        if square > VERY_STRONG + PENALTY * len(own):
            shown += [k for k in keys if k[0] == name]
    return shown


def search(
    streams: Streams,
    config: Config,
    spans: Sequence[tuple[float, float]],
    allowed: Iterable[str] | None = None,
    fixed: Container[Key] = (),
) -> tuple[dict[str, dict[str, float]], dict[Key, float]]:
    """The sensor effects that the data in the spans (from and to [s]) support, and the standard
    deviations of their parameters; with ``allowed`` just these are fitted, whatever they score;
    the parameters ``fixed`` stay at their null."""
    library = [e.name for e in _LIBRARY]
    if allowed is not None:
        names = [n for n in library if n in set(allowed)]
        may_answer = has_imu(streams) and not set(names).isdisjoint(_ANSWERS)
        tolerance = _LESSER if may_answer else 1.0
        given = streams, config, spans, names, fixed, False, tolerance
        found, std = _searched(*given)
        for name, parameter in [k for k in std if EFFECTS[k[0]].late and may_answer]:
            value, own = found[name][parameter], std[name, parameter]
            around = _searched(*given, around=True)[0]
            others = [(around[name][parameter], 0.0)]  # of the same noise
            if streams.has_pose:
                alone = streams.without_imu()
                posed, of_pose = _searched(alone, config, spans, names, fixed, False)
                others.append((posed[name][parameter], of_pose[name, parameter]))
            std[name, parameter] = min(
                float(np.linalg.norm([own, s, value - x])) for x, s in others
            )
        return found, std
    while True:
        found, std = _searched(streams, config, spans, library, fixed, chooses=True)
        keys = [(n, parameter) for n in found if n in _ANSWERS for parameter in found[n]]
        if not (keys and has_imu(streams)):
            return found, std
        again = search(streams, config, spans, found, fixed)
        answers = {n for n, _ in keys} - {n for n, _ in _shown(*again, keys)}
        if not answers:
            return again
        library = [n for n in library if n not in answers]


def _searched(
    streams: Streams,
    config: Config,
    spans: Sequence[tuple[float, float]],
    library: Sequence[str],
    fixed: Container[Key],
    chooses: bool,
    tolerance: float = 1.0,
    around: bool = False,
) -> tuple[dict[str, dict[str, float]], dict[Key, float]]:
    """The same of effects of the ``library`` that score, if the search ``chooses``, or of all."""
    found: dict[str, dict[str, float]] = {}
    std: dict[Key, float] = {}
    settled = False
    for left in reversed(range(ROUNDS)):
        rows = _rows(comparisons(streams, config, found, tolerance, around), spans, streams)
        linear = _linear(rows)
        free = [key for key in linear.keys if key not in fixed]
        chosen = [key for key in free if key[0] in found]
        units = [[k for k in free if k[0] == n] for n in library if n not in found]
        added = [k for unit in units for k in unit]
        if chooses:
            best, score, _ = _scores(rows, [*chosen, *TIMING]).select(units, bounds)
            added = best.keys if score > VERY_STRONG else []
            if best.keys and not added and (settled or not left or not found):
                names = [*found, *dict.fromkeys(name for name, _ in best.keys)]
                fitted = _searched(streams, config, spans, names, fixed, False)
                added = _shown(*fitted, best.keys)
        both = [*chosen, *added]
        if not both or (settled and not added):
            break
        change, _ = Scores(linear, TIMING).solve(both)
        for i, (name, parameter) in enumerate(both):
            nulls = {p.name: p.null for p in EFFECTS[name].parameters}
            before = found.setdefault(name, nulls)[parameter]
            after = np.clip(before + change[i], *bounds((name, parameter))[1:])
            found[name][parameter], change[i] = float(after), after - before
        at = linear.index([*both, *TIMING])
        covariance = scaled_inverse(linear.normal[np.ix_(at, at)])
        variance = np.maximum(np.diag(covariance), 0.0) * variance_inflation(
            _linear(_fitted(rows, at)), at
        )
        width = np.sqrt(variance)[: len(both)]
        std = dict(zip(both, width.tolist(), strict=True))
        settled = not added and bool((np.abs(change) < _SETTLED * width).all())
        if settled and not chooses:
            break
    return found, std
