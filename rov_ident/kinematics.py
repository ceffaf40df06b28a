"""Whether the sensors agree with each other: pose against velocity, velocity against IMU.

No model of the vehicle is needed for this, so what a sensor does wrong is found before the
dynamics are looked at. Two kinds of dead reckoning in the world frame are compared with what is
measured directly (Titterton and Weston 2004, ch. 3)::

    position:  x(t) - integral of R v dt            velocity:  R v(t) - integral of (R f + g) dt

and the odometry's angular rate with the gyro. A dead-reckoned difference is a random walk plus
white noise; the one-step innovations of that local-level model (Durbin and Koopman 2012, ch. 2) are
white, and every regressor goes through the same filter: generalised least squares. All sensor
effects are linear to first order, and the fit is repeated about its own result.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from rov_ident.attitude import turned
from rov_ident.config import Config
from rov_ident.effects import EFFECTS
from rov_ident.effects.base import Reading
from rov_ident.evidence import Linear
from rov_ident.frames import acceleration_of_arm, quaternion_from_euler, quaternion_to_matrix
from rov_ident.jit import kernel
from rov_ident.model import Array
from rov_ident.scores import SURE, Scores, inflation
from rov_ident.streams import Streams, orientation_at

_GAINS = (0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 0.95)
_OUTLIER = 6.0
_SMOOTHING = 0.2  # s; of angular rates
_DRIFT = 1.0  # s; from which the pose tells velocity better than the IMU
_STEADY = 0.5  # s; in which the pose tells velocity where there is no IMU
_ATTITUDE_TIME = 1.0  # s; in which the integrated gyro is drawn to the measured attitude
_MAX_GAP = 0.5  # s


@dataclass(frozen=True)
class Block:
    """One comparison: white innovations r (N,) in units of their noise at times t (N,).

    ``columns`` (N, P): how much of r each parameter makes.
    """

    name: str
    t: Array
    r: Array
    columns: Array
    scale: float  # standard deviation of the noise, in the unit of the comparison


HOLD = tuple(("thrust held", axis) for axis in "XYZ")
"""Nuisances: thrust that steps between two IMU samples is integrated as if it stepped elsewhere.

To the accelerations of thrust that is a time offset of milliseconds, the drag that answers to them
is not offset: together they would pass for a velocity scale of up to two percent.
"""


def sensor_parameters() -> list[tuple[str, str]]:
    """Keys of all parameters of the effects of the velocity sensor and the IMU."""
    return [(e.name, p.name) for e in EFFECTS.values() if e.sense for p in e.parameters]


def blocks(
    streams: Streams, config: Config, effects: Mapping[str, Mapping[str, float]]
) -> list[Block]:
    """The comparisons that a bag allows, after correcting what ``effects`` say of the sensors."""
    keys = sensor_parameters()
    mounting = quaternion_to_matrix(quaternion_from_euler(*config.imu.rotation))
    gyro = streams.gyro @ mounting.T
    force = streams.specific_force @ mounting.T
    rate_at = _interpolated(streams.t, streams.nu[:, 3:], streams.imu_t)
    if len(streams.imu_t) > 8:
        gyro_at = _interpolated(streams.imu_t, gyro, streams.t)
    else:
        gyro_at = np.zeros_like(streams.nu[:, 3:])
    here = Reading(streams.nu[:, :3], streams.nu[:, 3:], gyro_at, np.zeros_like(gyro_at))
    there = Reading(np.zeros_like(gyro), rate_at, gyro, force)
    for name, values in reversed(list(effects.items())):
        correct = EFFECTS[name].correct
        if correct is not None:
            here, there = correct(here, **values), correct(there, **values)

    def change(reading: Reading, key: tuple[str, str]) -> Reading:
        """What one unit of a parameter adds to a reading."""
        effect = EFFECTS[key[0]]
        nulls = {p.name: p.null for p in effect.parameters}
        step = next(1e-4 * p.typical for p in effect.parameters if p.name == key[1])
        assert effect.sense is not None
        moved = effect.sense(reading, **{**nulls, key[1]: nulls[key[1]] + step})
        return Reading(*((b - a) / step for a, b in zip(reading, moved, strict=True)))

    r = quaternion_to_matrix(streams.orientation)
    fallen = None
    if len(streams.imu_t) > 8:
        q = orientation_at(streams, streams.imu_t)
        r_imu = quaternion_to_matrix(_followed(q, streams.imu_t, there.gyro, rate_at))

        def gained(f: Array) -> Array:
            total = _integral(streams.imu_t, np.einsum("kij,kj->ki", r_imu, f))
            return _interpolated(streams.imu_t, total, streams.t)

        origin = _at_origin(streams.imu_t, there, np.array(config.imu.position))
        fallen = gained(origin) + np.outer(streams.t, [0.0, 0.0, config.gravity])

    # A regressor made of the very readings that it explains shares their noise: what the velocity
    # sensor's errors are made of is taken from the other sensors where there are any.
    width = _SMOOTHING / float(np.median(np.diff(streams.t)))
    turning, gyrating = (gaussian_filter1d(x, width, axis=0) for x in (here.angular, here.gyro))
    moving = np.einsum("kji,kj->ki", r, _travelling(streams, r, here.linear, fallen))
    moved = [change(Reading(moving, turning, gyrating, here.specific_force), key) for key in keys]
    made: list[tuple[str, Array, Array, list[Array]]] = []
    if streams.has_pose:

        def travelled(v: Array) -> Array:
            return _integral(streams.t, np.einsum("kij,kj->ki", r, v))

        y = streams.position - travelled(here.linear)
        columns = [-travelled(m.linear) for m in moved]
        made.append(("pose", streams.t, y, [*columns, *[np.zeros_like(y)] * 3]))
    if fallen is not None:
        shift = [change(there, key) for key in keys]
        inside = (streams.t >= streams.imu_t[0]) & (streams.t <= streams.imu_t[-1])
        t = streams.t[inside]
        y = (np.einsum("kij,kj->ki", r, here.linear) - fallen)[inside]
        columns = [
            (np.einsum("kij,kj->ki", r, m.linear) - gained(s.specific_force))[inside]
            for m, s in zip(moved, shift, strict=True)
        ]
        held = np.clip(np.searchsorted(streams.demand_t, t, side="right") - 1, 0, None)
        thrust = streams.demand[held, :3] / config.model.body.mass
        columns += [r[inside][:, :, i] * thrust[:, i : i + 1] for i in range(3)]
        made.append(("imu", t, y, columns))
        rate = here.angular[inside] - here.gyro[inside]
        columns = [m.angular[inside] - m.gyro[inside] for m in moved]
        made.append(("gyro", t, rate, [*columns, *[np.zeros_like(rate)] * 3]))
    return [
        Block(name, *_whitened(t, y, columns, walk=name != "gyro"))
        for name, t, y, columns in made
        if len(t) > 20
    ]


def _travelling(streams: Streams, r: Array, measured: Array, fallen: Array | None) -> Array:
    """Velocity (N, 3) in the world: long term from the pose, short term from the IMU, ``fallen``
    (N, 3), whose integral drifts. What is missing of them the velocity sensor stands in for."""
    t = streams.t
    inertial = np.zeros_like(measured) if fallen is None else fallen
    even = np.arange(t[0], t[-1], float(np.median(np.diff(t))))
    width = (_STEADY if fallen is None else _DRIFT) / (even[1] - even[0])
    if streams.has_pose:
        drifted = _interpolated(t, streams.position - _integral(t, inertial), even)
        correction = gaussian_filter1d(drifted, width, axis=0, order=1) / (even[1] - even[0])
    else:
        drifted = np.einsum("kij,kj->ki", r, measured) - inertial
        correction = gaussian_filter1d(_interpolated(t, drifted, even), width, axis=0)
    return inertial + _interpolated(even, correction, t)


def _followed(measured: Array, t: Array, gyro: Array, rate: Array) -> Array:
    """Attitudes (M, 4): short term of the gyro (M, 3), long term as measured.

    What the gyro reads too much tilts them all by that rate times a second, and gravity with them:
    first taken from the odometry's ``rate`` (M, 3), then from the tilt itself, which is finer.
    """
    true = gyro - np.median(gyro - rate, axis=0)
    for _ in range(2):
        q = measured.copy()
        _follow(q, t, true)
        a, b = q[:, 1:], measured[:, 1:]
        tilt = 2.0 * (q[:, :1] * b - measured[:, :1] * a - np.cross(a, b))
        true = true + tilt.mean(axis=0) / _ATTITUDE_TIME
    return q


@kernel
def _follow(q, t, rate):
    """Attitudes q (M, 4) become those of the gyro's rate (M, 3), drawn to the given ones slowly."""
    for i in range(1, len(t)):
        dt = t[i] - t[i - 1]
        if dt > _MAX_GAP:
            continue
        ahead = turned(q[i - 1], 0.5 * (rate[i - 1] + rate[i]) * dt)
        gain = dt / (_ATTITUDE_TIME + dt)
        size = 0.0
        for j in range(4):
            q[i, j] = ahead[j] + gain * (q[i, j] - ahead[j])
            size += q[i, j] ** 2
        q[i] /= np.sqrt(size)


def _at_origin(t: Array, reading: Reading, lever: Array) -> Array:
    """Specific force (M, 3) at the body origin, from that at the IMU's place."""
    if not lever.any():
        return reading.specific_force
    omega = reading.gyro
    turn = np.gradient(omega, t, axis=0)
    force: Array = reading.specific_force - acceleration_of_arm(omega, turn, lever)
    return force


def _integral(t: Array, y: Array) -> Array:
    steps = 0.5 * np.diff(t)[:, None] * (y[1:] + y[:-1])
    return np.vstack([np.zeros((1, y.shape[1])), np.cumsum(steps, axis=0)])


def _interpolated(t: Array, y: Array, at: Array) -> Array:
    return np.stack([np.interp(at, t, column) for column in y.T], axis=1)


def _whitened(
    t: Array, y: Array, columns: Sequence[Array], walk: bool
) -> tuple[Array, Array, Array, float]:
    """Innovations of the local-level model with the gain that leaves the least of them."""
    gap = np.diff(t, prepend=t[0]) > _MAX_GAP
    gap[0] = True

    def filtered(x: Array, gain: float) -> Array:
        steps = np.diff(x, axis=0, prepend=x[:1])
        steps[gap] = 0.0
        out: Array = lfilter([1.0], [1.0, gain - 1.0], steps, axis=0)
        return out

    use = [c for c in columns if c.any()]
    best, least = None, np.inf
    for gain in _GAINS if walk else (0.0,):
        if walk:
            e = filtered(y, gain)
            a = np.stack([filtered(c, gain) for c in use], axis=-1).reshape(-1, len(use))
        else:
            e, a = y, np.stack(use, axis=-1).reshape(-1, len(use)) if use else np.zeros((y.size, 0))
        left = e.ravel() - a @ np.linalg.lstsq(a, e.ravel(), rcond=None)[0]
        spread = 1.4826 * float(np.median(np.abs(left)))
        if spread < least:
            least, best = spread, gain
    assert best is not None
    e = filtered(y, best) if walk else y
    full = np.stack([filtered(c, best) if walk else c for c in columns], axis=-1)
    keep = (~gap if walk else np.ones(len(t), dtype=bool))[:, None] & (
        np.abs(e - np.median(e, axis=0)) < _OUTLIER * max(least, 1e-9) * 4.0
    )
    least = max(least, 1e-9)
    return np.broadcast_to(t[:, None], e.shape)[keep], e[keep] / least, full[keep] / least, least


def linear(
    found: Sequence[Block], inside: Callable[[Array], NDArray[np.bool_]], cluster: float = 5.0
) -> Linear:
    """Normal equations of the rows whose time is ``inside``, in clusters of so many seconds."""
    keys = (*sensor_parameters(), *HOLD)
    last = max((int(b.t[-1] / cluster) for b in found if len(b.t)), default=0) + 1
    normal, gradient = np.zeros((len(keys), len(keys))), np.zeros((last, len(keys)))
    rss, count = np.zeros(last), 0
    for block in found:
        keep = inside(block.t)
        at = (block.t[keep] / cluster).astype(int)
        columns, r = block.columns[keep], block.r[keep]
        normal += columns.T @ columns
        np.add.at(gradient, at, columns * r[:, None])
        np.add.at(rss, at, r**2)
        count += len(r)
    filled = rss > 0.0
    return Linear(keys, normal, gradient[filled], rss[filled], count)


def corrected(streams: Streams, effects: Mapping[str, Mapping[str, float]]) -> Streams:
    """The streams as good sensors would have given them."""
    nothing = np.zeros_like(streams.nu[:, :3])
    here = Reading(streams.nu[:, :3], streams.nu[:, 3:], nothing, nothing)
    for name, values in reversed(list(effects.items())):
        correct = EFFECTS[name].correct
        if correct is not None:
            here = correct(here, **values)
    return dataclasses.replace(streams, nu=np.hstack([here.linear, here.angular]))


def search(
    streams: Streams,
    config: Config,
    inside: Callable[[Array], NDArray[np.bool_]],
    allowed: Iterable[str] | None = None,
) -> tuple[dict[str, dict[str, float]], dict[tuple[str, str], float]]:
    """The sensor effects that the data ask for, and the standard deviations of their parameters."""
    library = [e.name for e in EFFECTS.values() if e.sense]
    library = library if allowed is None else [n for n in library if n in set(allowed)]
    found: dict[str, dict[str, float]] = {}
    std: dict[tuple[str, str], float] = {}
    for _ in range(6):
        at = linear(blocks(streams, config, found), inside)
        chosen = [key for key in at.keys if key[0] in found]
        scores = Scores(at, [*chosen, *HOLD])
        units = [[k for k in at.keys if k[0] == n] for n in library if n not in found]
        if allowed is None:
            added, _, promise = scores.best(units, free)
            added = added if promise > SURE else []
        else:
            added = [k for unit in units for k in unit]
        both = [*chosen, *added]
        if not both:
            break
        change, _ = Scores(at, HOLD).solve(both)
        for (name, parameter), delta in zip(both, change.tolist(), strict=True):
            nulls = {p.name: p.null for p in EFFECTS[name].parameters}
            found.setdefault(name, nulls)[parameter] += delta
        pick = at.index([*both, *HOLD])
        covariance = np.linalg.pinv(at.normal[np.ix_(pick, pick)], hermitian=True)
        width = np.sqrt(np.maximum(np.diag(covariance), 0.0) * inflation(at, pick))[: len(both)]
        std = dict(zip(both, width.tolist(), strict=True))
        if not added and (np.abs(change) < 0.05 * width).all():
            break
    return found, std


def free(key: tuple[str, str]) -> tuple[float, float, float]:
    """No bounds: null, lowest, highest."""
    return 0.0, -np.inf, np.inf
