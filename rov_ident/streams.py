"""A bag as its raw messages in arrays: what the search for a discrepancy works on.

The estimators see samples (``samples.py``), in which odometry and IMU are already blended. Whether
one sensor contradicts another shows only before that.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rov_ident.beat import LOST, completed
from rov_ident.config import Config
from rov_ident.errors import UserError
from rov_ident.messages import Array, Message, Odometry
from rov_ident.samples import (
    GROSS,
    IMU,
    LONE,
    ODOMETRY,
    REPEATED,
    WRENCH,
    Sampler,
    describe,
    numbers,
)

_USUAL = 2.0  # times what 99 % of the messages keep to
_PAUSE = 60.0  # s between two bags that are searched as one


@dataclass(frozen=True)
class Streams:
    """The three topics in core axes (FRD, NED); times in seconds since the first message.

    odometry: ``t`` (N,), position (N, 3), orientation (N, 4) w x y z, nu (N, 6) as measured.
    IMU: ``imu_t`` (M,), gyro (M, 3), specific_force (M, 3) in sensor axes.
    wrench: ``demand_t`` (K,), demand (K, 6), each held to the next; lost ones are guessed.
    ``has_pose`` tells whether the positions mean anything; ``notes`` say what was left out.
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
    notes: tuple[str, ...] = ()

    @property
    def has_pose(self) -> bool:
        return bool(np.ptp(self.position, axis=0).max() > 0.0)

    @property
    def guided(self) -> NDArray[np.bool_]:
        """Axes (6,) whose velocity a simulation can only take as measured.

        Thrusters hardly push without some moment: a wrench that never holds any was recorded, or
        computed, without. What turns the vehicle is then unknown. A velocity that never changes was
        not measured: a record in the plane holds zeros for the rest.
        """
        unknown: NDArray[np.bool_] = np.repeat([False, not self.demand[:, 3:].any()], 3)
        return unknown | (np.nanmax(self.nu, axis=0) == np.nanmin(self.nu, axis=0))

    @property
    def duration(self) -> float:
        return float(self.t[-1])


def gather(messages: Iterable[tuple[str, Message]], config: Config) -> Streams:
    """Arrays from messages as they are on the wire; what cannot be used is left out.

    Raises
    ------
    UserError
        If odometry or wrench are missing.
    """
    recorder = _Recorder(config)
    for role, message in messages:
        recorder.push(role, message)
    odometry, imu, wrench = recorder.taken[ODOMETRY], recorder.tamed(IMU), recorder.tamed(WRENCH)
    odometry = _driven(odometry, [t for t, _ in wrench], config.timeout, recorder.counts)
    for name, found in (("odometry", odometry), ("wrench", wrench)):
        if len(found) < 2:
            raise UserError(f"the bag holds no usable {name} messages")
    demand_t, demand = completed(
        np.array([t for t, _ in wrench]),
        np.array([np.concatenate([m.force, m.torque]) for _, m in wrench]),
    )
    return Streams(
        np.array([t for t, _ in odometry]),
        np.array([m.position for _, m in odometry]),
        _continuous(np.array([m.orientation for _, m in odometry])),
        np.array([np.concatenate([m.linear, m.angular]) for _, m in odometry]),
        np.array([t for t, _ in imu]),
        np.array([m.angular_velocity for _, m in imu]).reshape(-1, 3),
        np.array([m.linear_acceleration for _, m in imu]).reshape(-1, 3),
        demand_t,
        demand,
        tuple(f"left out: {reason}" for reason in describe(recorder.counts)),
    )


def joined(bags: Sequence[Streams]) -> tuple[Streams, list[float]]:
    """Several bags as one, with gaps between them, and the time [s] at which each begins."""
    begins, begin = [], 0.0
    for bag in bags:
        begins.append(begin)
        begin += bag.duration + _PAUSE
    if len(bags) == 1:
        return bags[0], begins

    def times(name: str) -> Array:
        return np.concatenate([getattr(b, name) + s for b, s in zip(bags, begins, strict=True)])

    def rows(name: str) -> Array:
        return np.concatenate([getattr(b, name) for b in bags])

    notes = tuple(note for bag in bags for note in bag.notes)
    shifted = {name: times(name) for name in ("t", "imu_t", "demand_t")}
    others = {f.name: rows(f.name) for f in fields(Streams) if f.name not in (*shifted, "notes")}
    return Streams(**shifted, **others, notes=notes), begins


def _driven(
    odometry: list[tuple[float, Any]], demanded: list[float], hold: float, counts: Counter[str]
) -> list[tuple[float, Any]]:
    """The messages at times when a demand is there: one that has been held for longer than ``hold``
    [s], or several times as long as is usual, says nothing of what the thrusters do."""
    if len(demanded) > 1:
        hold = min(hold, LOST * float(np.quantile(np.diff(demanded), 0.99)))
    times = np.array([t for t, _ in odometry])
    given = np.array([-np.inf, *demanded])
    age = times - given[np.searchsorted(given, times, side="right") - 1]
    silent = np.isfinite(age) & (age > hold)
    counts["odom: no wrench at that time"] += int(silent.sum())
    return [message for message, drop in zip(odometry, silent, strict=True) if not drop]


class _Recorder(Sampler):
    """Refuses and converts as the estimators do, but keeps the messages instead of merging them."""

    def __init__(self, config: Config) -> None:
        super().__init__(config.with_effects_held)
        self.taken: dict[str, list[tuple[float, Any]]] = {ODOMETRY: [], IMU: [], WRENCH: []}

    def _complete(self, final: bool) -> NDArray[np.void]:
        for role, queue in self._queues.items():
            for t, message, _ in queue:
                if isinstance(message, Odometry) and message.twist_variance[0] == REPEATED:
                    self.counts["odom: velocity repeated, not measured anew"] += 1
                else:
                    self.taken[role].append((t, message))
            queue.clear()
        return self._none

    def tamed(self, role: str) -> list[tuple[float, Any]]:
        """The messages without one or two in a row that hold what no others do.

        Live, an outlier is what jumps there and back; here the whole bag tells what is usual, and
        a controller that chatters keeps its demands.
        """
        taken = self.taken[role]
        if len(taken) < 2:
            return taken
        x = np.array([numbers(m) for _, m in taken])
        x = np.abs(x - np.median(x, axis=0))
        least = (GROSS if role == WRENCH else LONE) * self._floors[role]
        usual = np.maximum(_USUAL * np.quantile(x, 0.99, axis=0), least)
        edges = np.flatnonzero(np.diff((x > usual).any(axis=1), prepend=False, append=False))
        wild = {
            i
            for begin, end in edges.reshape(-1, 2).tolist()
            if end - begin <= 2
            for i in range(begin, end)
        }
        self.counts[f"{role}: outlier"] += len(wild)
        return [taken[i] for i in range(len(taken)) if i not in wild]


def _continuous(q: Array) -> Array:
    """Unit quaternions (N, 4), signs chosen so that neighbours are close."""
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    flips = np.sum(q[1:] * q[:-1], axis=1) < 0.0
    sign = np.where(np.cumsum(np.concatenate([[0], flips])) % 2, -1.0, 1.0)
    return q * sign[:, None]


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
    w, x, y, z = q.T
    a, b, c = 0.5 * omega.T
    return np.stack(
        [
            -x * a - y * b - z * c,
            w * a + y * c - z * b,
            w * b + z * a - x * c,
            w * c + x * b - y * a,
        ],
        axis=1,
    )
