"""A bag as its raw messages in arrays: what the search for a discrepancy works on.

The estimators see samples, in which odometry and IMU are already blended. Whether one sensor
contradicts another shows only before that.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.frames import (
    quaternion_from_euler,
    quaternion_multiply,
    quaternion_to_matrix,
    rotated,
    to_core,
    velocity_of_arm,
)
from rov_ident.core.linalg import interpolated
from rov_ident.core.messages import DRIVE, IMU, ODOMETRY, WRENCH, Array, Message, Odometry
from rov_ident.core.noise import differences, robust_std
from rov_ident.effects import Values, correct, heading_error, velocity_delay
from rov_ident.effects.base import Reading
from rov_ident.model.coefficients import AXES, INPUTS, VELOCITIES
from rov_ident.model.scales import authority
from rov_ident.sampling.acting_wrench import holds_moment
from rov_ident.sampling.despiking import largest_usual, measured_values
from rov_ident.sampling.driven import value_of
from rov_ident.sampling.dropped_commands import SILENCE, completed
from rov_ident.sampling.queues import LONGEST_INTERVAL
from rov_ident.sampling.validation import NEW_CLOCK, REPEATED, RESTARTS, Validation, describe

_USUAL = 2.0  # a choice: times what 99 % of the messages keep to
_DOUBTFUL = 3.0  # usual standard deviations; a message then weighs as nine in sums of squares
_SPIKE = 10.0  # standard deviations of what velocities change by: no noise reaches that
# of what the noise of the velocities makes of a step: half of what the trapezoidal rule leaves of
# velocities without noise, a twelfth of their second differences; no fix agrees by chance that well
_RECKONED = 0.04
_RATES_OF_IMU = "odom: no angular rates; those of the IMU are taken"
MAX_STEP = 0.05  # s; of a simulation's or a filter's steps, where odometry is slower
PAUSE = 60.0  # s between two bags that are searched as one, and where a bag's clock is set back


@dataclass(frozen=True)
class Streams:
    """The three topics in core axes (FRD, NED); times in seconds since the first message.

    odometry: ``t`` (N,), position (N, 3), orientation (N, 4) w x y z, nu (N, 6) as measured.
    IMU: ``imu_t`` (M,), gyro (M, 3), specific_force (M, 3) in sensor axes.
    wrench: ``demand_t`` (K,), demand (K, 6), each held to the next; dropped ones are estimated.
    ``begins`` (R,) [s]: of the records that were joined, each of which has a clock of its own.
    fins and shafts: ``inputs_t`` (I,), inputs (I, 4) of INPUTS, straight from each to the next.
    ``notes`` say what was left out. ``rates_std`` (3,) [rad/s]: a bias of the angular velocities is
    none beyond that. ``max_step`` [s]: no longer may a simulation's be, for drag to stop no motion
    within it.

    What only a record as it was read tells (:func:`inspected`): ``posed`` (N,), where positions say
    anything beside the velocities; ``is_reckoned``, whether they are the sum of these;
    ``unmeasured`` (6,), velocities that never change, as a record in the plane holds zeros for the
    rest; ``is_turned``, whether it is known what turns the vehicle: the wrench holds a moment, or
    fins move. ``in_noise`` (6,): axes whose commands cannot be told from noise of the wrench's
    reading, if that was asked; ``noise_lasts`` (6,): for how many readings that noise is the same.
    """

    t: Array
    position: Array
    orientation: Array
    nu: Array
    imu_t: Array
    gyro: Array
    specific_force: Array
    demand_t: Array
    demand: Array
    inputs_t: Array
    inputs: Array
    notes: tuple[str, ...] = ()
    rates_std: Array = field(default_factory=lambda: np.zeros(3))
    max_step: float = MAX_STEP
    begins: Array = field(default_factory=lambda: np.zeros(1))
    posed: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    is_reckoned: bool = False
    unmeasured: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(6, dtype=bool))
    is_turned: bool = True
    in_noise: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(6, dtype=bool))
    noise_lasts: NDArray[np.int64] = field(default_factory=lambda: np.ones(6, dtype=np.int64))

    def without_imu(self) -> "Streams":
        """The same with no message of the IMU."""
        gyro, force = self.gyro[:0], self.specific_force[:0]
        return replace(self, imu_t=self.imu_t[:0], gyro=gyro, specific_force=force)

    @property
    def has_pose(self) -> bool:
        """Whether any position is ``posed``."""
        return bool(self.posed.any())

    @property
    def has_forces(self) -> bool:
        """Whether a wrench other than zero is recorded; what fins and propellers do is none."""
        return bool(self.demand.any())

    @property
    def guided(self) -> NDArray[np.bool_]:
        """Axes (6,) whose velocity a simulation can only take as measured.

        Rates, if nothing is known that turns the vehicle, velocities that were not measured, and
        those along which nobody knows what drives it.
        """
        unknown: NDArray[np.bool_] = np.repeat([False, not self.is_turned], 3)
        return unknown | self.unmeasured | self.in_noise

    @property
    def duration(self) -> float:
        return float(self.t[-1])

    @property
    def longest(self) -> float:
        """Seconds that the longest record lasts."""
        ends = np.append(self.begins[1:] - PAUSE, self.duration)
        return float(np.max(ends - self.begins))

    def begin_of(self, t: Array) -> Array:
        """When the records began to which instants t (n,) belong [s]."""
        which = np.searchsorted(self.begins, t + 0.5 * PAUSE, side="right") - 1
        begins: Array = self.begins[np.maximum(which, 0)]
        return begins

    @property
    def recordings(self) -> tuple[Array, Array]:
        """Times [s] of each recording: its last odometry (R,) and its first command (R,), infinite
        where it has none."""
        ends = np.append(self.t[:-1][np.diff(self.t) >= PAUSE], self.t[-1])
        # a microsecond for rounding
        first = np.searchsorted(self.demand_t, np.append(-np.inf, ends[:-1] + PAUSE - 1e-6))
        return ends, np.append(self.demand_t, np.inf)[first]


def gather(messages: Iterable[tuple[str, Message]], config: Config) -> Streams:
    """Arrays from messages as they are on the wire; what cannot be used is left out, and what the
    configuration says of the sensors is taken off.

    Raises UserError if odometry or wrench are missing.
    """
    taken, counts = _accepted(messages, config)
    imu, wrench = (_despiked(role, taken[role], config, counts) for role in (IMU, WRENCH))
    odometry = _without_spikes(_without_doubtful(taken[ODOMETRY], counts), config, counts)
    odometry = _while_commanded(odometry, [t for t, _ in wrench], config.timeout, counts)
    for name, found in (("odometry", odometry), ("wrench", wrench)):
        if len(found) < 2:
            raise UserError(f"the bag holds no usable {name} messages")
    measured = np.array([measured_values(m) for _, m in imu]).reshape(-1, 6)
    nu = np.array([np.concatenate([m.linear, m.angular]) for _, m in odometry])
    read = Streams(
        np.array([t for t, _ in odometry]),
        np.array([m.position for _, m in odometry]),
        _continuous(np.array([m.orientation for _, m in odometry])),
        nu,
        np.array([t for t, _ in imu]),
        measured[:, :3].copy(),
        measured[:, 3:].copy(),
        *completed(
            np.array([t for t, _ in wrench]), np.array([measured_values(m) for _, m in wrench])
        ),
        *_driven_by(taken[DRIVE], config),
        tuple(f"left out: {reason}" for reason in describe(counts)),
    )
    return _as_configured(inspected(read), config)


def inspected(read: Streams) -> Streams:
    """The streams of one record with what they tell as they were read."""
    moved = bool(np.ptp(read.position, axis=0).max() > 0.0)
    reckoned = moved and _is_reckoned(read)
    moments = np.abs(read.demand).max(axis=0)
    return replace(
        read,
        posed=np.full(len(read.t), moved and not reckoned and not _is_held(read)),
        is_reckoned=reckoned,
        unmeasured=np.nanmax(read.nu, axis=0) == np.nanmin(read.nu, axis=0),
        is_turned=bool(holds_moment(moments) or read.inputs[:, :3].any()),
    )


def _is_held(read: Streams) -> bool:
    """Whether the horizontal position is that of a slower sensor, such as an acoustic fix, and
    held in between: most messages repeat it, while the vehicle moves on by more than a grid to
    which positions are rounded. Held, it says that the vehicle rests."""
    step = np.abs(np.diff(read.position[:, :2], axis=0))
    fixed = np.flatnonzero(step.any(axis=1))
    if not 1 < len(fixed) < 0.5 * len(step):
        return False
    way = np.append(0.0, np.cumsum(np.hypot(*read.nu[1:, :2].T) * np.diff(read.t)))
    return bool(np.median(np.diff(way[fixed])) > 3.0 * step[step > 0.0].min())


def _is_reckoned(read: Streams) -> bool:
    """Whether the position is dead reckoning, the sum of the velocities along the attitude with
    their noise: it agrees with them whatever is wrong. Depth may still be measured."""
    if len(read.t) < 3:
        return False
    v = rotated(quaternion_to_matrix(read.orientation), read.nu[:, :3])[:, :2]
    step = np.diff(read.position[:, :2], axis=0)
    noise = np.median(np.abs(differences(v, 2)), axis=0) * np.median(np.diff(read.t))
    rules = (v[:-1], v[1:], 0.5 * (v[:-1] + v[1:]))
    moved = step.any(axis=1)  # one that is rounded is repeated
    if not moved.any():
        return False
    # across the velocity, as a stamp that is off moves a step along it
    across = [step[:, 0] * rule[:, 1] - step[:, 1] * rule[:, 0] for rule in rules]
    size = [np.maximum(np.hypot(*rule.T), 1e-12) for rule in rules]
    left = min(np.median(np.abs(x / n)[moved]) for x, n in zip(across, size, strict=True))
    return bool(left < _RECKONED * noise.min())


def _as_configured(read: Streams, config: Config) -> Streams:
    """The streams with what the configuration says of the sensors taken off, as the estimators take
    it off samples: what is found of sensors is beside that."""
    body, none = config.imu.to_body, np.zeros_like(read.gyro)
    imu = Reading(none, none, read.gyro @ body.T, read.specific_force @ body.T)
    imu = correct(imu, config.effects)
    out = corrected(read, config.effects)
    nu, unmeasured, notes = out.nu.copy(), read.unmeasured.copy(), read.notes
    rates = nu[:, 3:]
    if len(read.imu_t) > 1:  # where the odometry has none, the vehicle turns as the gyro says
        gyro = interpolated(read.imu_t, imu.gyro, read.t)
        rates = np.where(unmeasured[3:], gyro, rates)
        if unmeasured[3:].all():
            nu[:, 3:], unmeasured[3:] = gyro, False
            notes = (*notes, _RATES_OF_IMU)
    nu[:, :3] -= np.where(unmeasured[:3], 0.0, velocity_of_arm(rates, config.odometry.position))
    return replace(
        out,
        nu=nu,
        unmeasured=unmeasured,
        gyro=imu.gyro @ body,
        specific_force=imu.specific_force @ body,
        notes=notes,
        max_step=_max_step(config, nu),
    )


def corrected(streams: Streams, effects: Values) -> Streams:
    """The streams as good sensors would have given them; velocities that were not measured stay."""
    there = in_place(streams, effects)
    nothing = np.zeros_like(there.nu[:, :3])
    here = correct(Reading(there.nu[:, :3], there.nu[:, 3:], nothing, nothing), effects)
    nu = np.where(streams.unmeasured, streams.nu, np.hstack([here.linear, here.angular]))
    return replace(there, nu=nu)


def in_place(streams: Streams, effects: Values) -> Streams:
    """The odometry with velocities of the time of its stamp (the last ones are held) and an
    attitude against the world."""
    delay, yaw = velocity_delay(effects), heading_error(effects)
    nu, orientation = streams.nu.copy(), streams.orientation
    if delay:
        nu[:, :3] = interpolated(streams.t, streams.nu[:, :3], streams.t + delay)
    if yaw:
        orientation = quaternion_multiply(quaternion_from_euler(0.0, 0.0, -yaw), orientation)
    return replace(streams, nu=nu, orientation=orientation)


def _max_step(config: Config, nu: Array) -> float:
    """A step [s] no longer than the time in which the drag of the configuration stops a motion as
    quick as the quickest hundredth of nu (N, 6): a Runge-Kutta step is good to a percent of it, and
    one that is 2.8 times as long diverges."""
    values, mass = config.model.values, np.diag(config.model.mass_matrix)
    rates = [
        (abs(values.get(f"{a}_{v}", 0.0)) + 2.0 * abs(values.get(f"{a}_{v}{v}", 0.0)) * speed) / m
        for a, v, m, speed in zip(AXES, VELOCITIES, mass, np.nanquantile(np.abs(nu), 0.99, axis=0))
    ]
    return float(np.clip(1.0 / max(*rates, 1e-9), 0.1 * MAX_STEP, MAX_STEP))


def joined(bags: Sequence[Streams]) -> tuple[Streams, list[float]]:
    """Several bags as one, with gaps between them, and the time [s] at which each begins."""
    begins, begin = [], 0.0
    for bag in bags:
        begins.append(begin)
        begin += bag.duration + PAUSE
    if len(bags) == 1:
        return bags[0], begins

    both: dict[str, Any] = {
        "notes": tuple(note for bag in bags for note in bag.notes),
        "rates_std": np.max([bag.rates_std for bag in bags], axis=0),
        "max_step": min(bag.max_step for bag in bags),
        "is_reckoned": any(bag.is_reckoned for bag in bags),
        "unmeasured": np.any([bag.unmeasured for bag in bags], axis=0),
        "is_turned": all(bag.is_turned for bag in bags),
        "in_noise": np.any([bag.in_noise for bag in bags], axis=0),
        "noise_lasts": np.max([bag.noise_lasts for bag in bags], axis=0),
    }
    for name in (f.name for f in fields(Streams) if f.name not in both):
        each = [getattr(bag, name) for bag in bags]
        if name in ("t", "begins") or name.endswith("_t"):
            each = [t + begin for t, begin in zip(each, begins, strict=True)]
        both[name] = np.concatenate(each)
    return Streams(**both), begins


def _while_commanded(
    odometry: list[tuple[float, Any]], commanded: list[float], hold: float, counts: Counter[str]
) -> list[tuple[float, Any]]:
    """The messages at times when a command acts: one that has been held for longer than ``hold``
    [s], or several times as long as is usual, says nothing of what the thrusters do."""
    if len(commanded) > 1:
        hold = min(hold, SILENCE * float(np.quantile(np.diff(commanded), 0.99)))
    times = np.array([t for t, _ in odometry])
    given = np.array([-np.inf, *commanded])
    age = times - given[np.searchsorted(given, times, side="right") - 1]
    silent = np.isfinite(age) & (age > hold)
    counts["odom: no wrench at that time"] += int(silent.sum())
    return [message for message, drop in zip(odometry, silent, strict=True) if not drop]


def _driven_by(taken: list[tuple[float, Any]], config: Config) -> tuple[Array, Array]:
    """Times (I,) and inputs (I, 4); one that a message lacks goes on as before.

    Raises UserError if one never comes.
    """
    t, x = np.array([t for t, _ in taken]), np.zeros((len(taken), len(INPUTS)))
    for name, given in config.inputs.joints.items():
        values = [value_of(given, message) for _, message in taken]
        known = np.array([np.nan if v is None else v for v in values])
        have = np.isfinite(known)
        if not have.any():
            raise UserError(
                f"the bag has no joint {given.joint}, which inputs.{name}.joint names: it has "
                + (", ".join(sorted({n for _, m in taken for n in m.names})) or "none")
            )
        x[:, INPUTS.index(name)] = np.interp(t, t[have], known[have])
    return t, x


def _accepted(
    messages: Iterable[tuple[str, Message]], config: Config
) -> tuple[dict[str, list[tuple[float, Any]]], Counter[str]]:
    """Time [s] and message in core axes of all that the estimators would take, and what is refused.

    Velocities that have not been measured again are refused here.
    """
    validation, origin, latest = Validation(), None, 0
    taken: dict[str, list[tuple[float, Any]]] = {ODOMETRY: [], IMU: [], WRENCH: [], DRIVE: []}
    for role, message in messages:
        reason = validation.judge(role, message)
        if reason in RESTARTS:
            validation.forget_motion()
        elif reason:
            continue
        origin = message.stamp if origin is None else origin
        if reason == NEW_CLOCK and message.stamp < latest:
            origin -= latest - message.stamp + round(PAUSE * 1e9)
            latest = 0
        latest = max(latest, message.stamp)
        validation.counts[role] += 1
        if isinstance(message, Odometry):
            message = validation.marked(message)
            if message.twist_variance[0] == REPEATED:
                validation.counts["odom: velocity repeated, not measured anew"] += 1
                continue
        t = (message.stamp - origin) * 1e-9
        taken[role].append((t, to_core(message, config.frames)))
    return taken, validation.counts


def _despiked(
    role: str, taken: list[tuple[float, Any]], config: Config, counts: Counter[str]
) -> list[tuple[float, Any]]:
    """The messages without one or two in a row that hold what no others do.

    Live, an outlier is what jumps there and back; here the whole bag tells what is usual, and a
    controller that chatters keeps its commands. What is nearer to its neighbours than they are to
    each other is a step that overshoots, as of a heading that is set anew, and the most that is
    ever commanded.
    """
    if len(taken) < 2:
        return taken
    x = np.array([measured_values(m) for _, m in taken])
    off = np.abs(x - np.median(x, axis=0))
    usual = np.maximum(_USUAL * np.quantile(off, 0.99, axis=0), largest_usual(role, config))
    edges = np.flatnonzero(np.diff((off > usual).any(axis=1), prepend=False, append=False))
    outliers: set[int] = set()
    for first, end in edges.reshape(-1, 2).tolist():
        lone, ends = slice(first, end), x[[max(first - 1, 0), min(end, len(x) - 1)]]
        apart = np.abs(x[lone, None] - ends).min(axis=1)  # from the nearer of its neighbours
        beyond = (off[lone] > usual) & (apart > np.abs(ends[1] - ends[0]))
        if end - first <= 2 and (beyond.any() or first == 0 or end == len(x)):
            outliers.update(range(first, end))
    counts[f"{role}: outlier"] += len(outliers)
    return [taken[i] for i in range(len(taken)) if i not in outliers]


def _without_doubtful(
    odometry: list[tuple[float, Any]], counts: Counter[str]
) -> list[tuple[float, Any]]:
    """The messages without those whose linear velocity is stated to be far worse than usual, as
    where a DVL has lost the ground and the velocity is held: here all velocities weigh the same."""
    stated = np.array([np.max(m.twist_variance[:3]) for _, m in odometry])
    usual = np.median(stated) if len(stated) else 0.0
    doubtful = (stated > _DOUBTFUL**2 * usual) & (usual > 0.0)
    counts["odom: velocity is stated to be far worse than usual"] += int(doubtful.sum())
    return [m for m, drop in zip(odometry, doubtful, strict=True) if not drop]


def _without_spikes(
    odometry: list[tuple[float, Any]], config: Config, counts: Counter[str]
) -> list[tuple[float, Any]]:
    """The messages without those whose linear velocity jumps there and back: by more than noise,
    and by more than the working wrench moves the vehicle from one message to the next."""
    if len(odometry) < 3:
        return odometry
    t = np.array([t for t, _ in odometry])
    v = np.array([m.linear for _, m in odometry])
    there, back = v[1:-1] - v[:-2], v[1:-1] - v[2:]
    off = np.where(there * back > 0.0, np.minimum(np.abs(there), np.abs(back)), 0.0)
    agility = authority(config.dynamics)[:3] / np.diag(config.dynamics.mass_matrix)[:3]
    moved = np.maximum(np.diff(t)[:-1], np.diff(t)[1:])[:, None] * agility
    usual = np.maximum(_SPIKE * robust_std(there), moved)
    spike = np.max(off / np.maximum(usual, 1e-9), axis=1) > 1.0
    counts["odom: velocity jumps there and back"] += int(spike.sum())
    return [
        odometry[0],
        *(m for m, drop in zip(odometry[1:-1], spike, strict=True) if not drop),
        odometry[-1],
    ]


def _continuous(q: Array) -> Array:
    """Unit quaternions (N, 4), signs chosen so that neighbours are close."""
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    flips = np.sum(q[1:] * q[:-1], axis=1) < 0.0
    sign = np.where(np.cumsum(np.concatenate([[0], flips])) % 2, -1.0, 1.0)
    return q * sign[:, None]


def measured_at(t: Array, at: Array) -> NDArray[np.bool_]:
    """Which instants ``at`` (M,) lie between messages, of times t (N,), of a sensor that goes on:
    what is interpolated across a pause was not measured."""
    gap = np.diff(t, prepend=-np.inf, append=np.inf)
    return (gap[np.searchsorted(t, at)] <= LONGEST_INTERVAL) | np.isin(at, t)


def orientation_at(streams: Streams, t: Array) -> Array:
    """Attitude (k, 4) at the instants t (k,): a cubic through the measured attitudes and rates."""
    i = np.clip(np.searchsorted(streams.t, t, side="right") - 1, 0, len(streams.t) - 2)
    h = (streams.t[i + 1] - streams.t[i])[:, None]
    s = (t - streams.t[i])[:, None] / h
    q0, q1 = streams.orientation[i], streams.orientation[i + 1]
    d0, d1 = _rate(q0, streams.nu[i, 3:]), _rate(q1, streams.nu[i + 1, 3:])
    s = np.clip(s, 0.0, 1.0)
    q = (
        (1.0 + 2.0 * s) * (1.0 - s) ** 2 * q0
        + s * (1.0 - s) ** 2 * h * d0
        + s**2 * (3.0 - 2.0 * s) * q1
        + s**2 * (s - 1.0) * h * d1
    )
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def _rate(q: Array, omega: Array) -> Array:
    """q_dot (k, 4) = q (0, omega) / 2."""
    rates = np.insert(omega, 0, 0.0, axis=1)
    return 0.5 * quaternion_multiply(q, rates)
