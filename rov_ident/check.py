"""Is this bag fit for identification: rates, gaps, frames and signs, delays, excitation.

Nothing is identified here. What is said of the coefficients is a prediction: the information that
the measured motion holds about each of them (:mod:`rov_ident.maximum_likelihood`), at the values
and noise of the configuration.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rov_ident import archive, inputs
from rov_ident.bags import Bag
from rov_ident.batch import predicted_information
from rov_ident.coefficients import MOTIONS
from rov_ident.config import Config
from rov_ident.errors import UserError
from rov_ident.estimate import prior_of
from rov_ident.excitation import authority
from rov_ident.fit import IDENTIFIABLE
from rov_ident.frames import quaternion_from_euler, quaternion_to_matrix
from rov_ident.least_squares import PERIOD
from rov_ident.maximum_likelihood import inverse_of
from rov_ident.model import Array
from rov_ident.records import Record, read_record
from rov_ident.regression import filtered_rows, regression
from rov_ident.streams import Streams, gather

Tell = Callable[..., None]

GOOD, WARNING, BAD = "good", "warning", "bad"
WELL = (
    0.1  # predicted standard deviation relative to the value at which a coefficient counts as known
)

_GAP = 0.5  # s without a message
_SLOW = 5.0  # Hz; below it the fast modes are not seen
_DRIVEN = 0.05  # of the axis's authority
_DELAY = 0.02  # s; from which one is worth a word
_CORNER = 6.0  # rad/s; of the filter on wrench and motion


@dataclass(frozen=True)
class Remark:
    """One thing looked at: ``level`` GOOD, WARNING or BAD, ``text`` a sentence."""

    subject: str
    level: str
    text: str


@dataclass(frozen=True)
class Prospect:
    """What the bag would tell of a coefficient: the predicted standard deviation of a fit."""

    name: str
    value: float
    unit: str
    std: float
    prior_std: float

    @property
    def identifiable(self) -> bool:
        return self.std**2 < (1.0 - IDENTIFIABLE) * self.prior_std**2

    @property
    def verdict(self) -> str:
        """well, roughly or not."""
        if not self.identifiable:
            return "not"
        return "well" if self.std <= WELL * abs(self.value) else "roughly"


@dataclass(frozen=True)
class Check:
    """All that was found out about a bag."""

    bag: str
    duration: float
    remarks: tuple[Remark, ...]
    prospects: tuple[Prospect, ...]
    information: Array = field(repr=False)
    record: Record = field(repr=False)
    streams: Streams = field(repr=False)

    @property
    def fit(self) -> bool:
        """Whether a fit makes sense: no remark is BAD, and some coefficient would be known."""
        return all(r.level != BAD for r in self.remarks) and any(
            p.identifiable for p in self.prospects
        )

    def to_dict(self) -> dict[str, Any]:
        return {
            "bag": self.bag,
            "duration_s": self.duration,
            "fit_for_identification": self.fit,
            "remarks": [vars(r) for r in self.remarks],
            "coefficients": {
                p.name: {
                    "configured": p.value,
                    "predicted_std": p.std,
                    "prior_std": p.prior_std,
                    "unit": p.unit,
                    "identifiable": p.identifiable,
                    "verdict": p.verdict,
                }
                for p in self.prospects
            },
        }


def check(path: Path, config: Config, tell: Tell | None = None) -> Check:
    """Look at a bag; ``tell`` is called with what is being done, and what share of it is.

    Raises
    ------
    UserError
        If it cannot be read, or has not the messages that it takes to look at anything.
    """
    say = tell or (lambda what, share=None: None)
    record = read_record(path, config, lambda k, n: say(f"reading {path.name}", k / max(n, 1)))
    say("looking at its messages")
    bag = Bag(path)
    streams = gather(inputs.messages(bag, inputs.select(bag, config), config), config)
    if streams.duration < 1.0:
        raise UserError(f"{path.name} lasts {streams.duration:.1f} s: nothing can be said of it")
    remarks = [*_rates(streams), *(Remark("messages", WARNING, n) for n in record.notes)]
    remarks += _frames(streams, config)
    remarks += _delays(streams, config)
    remarks += _dynamics(record, config)
    say("predicting what a fit would tell")
    one = archive.of_records([record])
    information = predicted_information(one, config)
    found = prospects(config, information)
    remarks += _excitation(streams, config, found)
    return Check(path.name, streams.duration, tuple(remarks), found, information, record, streams)


def prospects(config: Config, information: Array) -> tuple[Prospect, ...]:
    """What information (n, n) about the coefficients to estimate makes of the prior."""
    prior = prior_of(config)
    covariance = inverse_of(information + np.diag(prior.std**-2.0))
    std = np.sqrt(np.diag(covariance))
    return tuple(
        Prospect(*row)
        for row in zip(
            prior.names,
            prior.mean.tolist(),
            prior.units,
            std.tolist(),
            prior.std.tolist(),
            strict=True,
        )
    )


# ------------------------------------------------------------------ rates and gaps


def _rates(streams: Streams) -> list[Remark]:
    remarks = []
    for name, t in (
        ("odometry", streams.t),
        ("imu", streams.imu_t),
        ("wrench", streams.demand_t),
    ):
        if len(t) < 2:
            text = "there is none: attitude and velocity between two odometry messages are guessed"
            remarks.append(Remark(name, WARNING, text))
            continue
        steps = np.diff(t)
        rate, gap = 1.0 / float(np.median(steps)), float(steps.max())
        text = f"{rate:.1f} Hz, longest pause {gap:.2f} s"
        level = GOOD
        if gap > _GAP and name != "wrench":
            lost = float(steps[steps > _GAP].sum())
            level, text = WARNING, f"{text}; {lost:.1f} s in all are lost to pauses"
        if rate < _SLOW:
            level = WARNING
            text += f"; {_SLOW:g} Hz is the least that shows how the vehicle accelerates"
        remarks.append(Remark(name, level, text))
    return remarks


# ------------------------------------------------------------------ frames and signs


def _at(t: Array, known: Array, values: Array) -> Array:
    return np.stack([np.interp(t, known, column) for column in values.T], axis=1)


def _frames(streams: Streams, config: Config) -> list[Remark]:
    remarks = []
    r = quaternion_to_matrix(streams.orientation)
    mounting = quaternion_to_matrix(quaternion_from_euler(*config.imu.rotation))
    if len(streams.imu_t) > 8:
        attitude = r[np.clip(np.searchsorted(streams.t, streams.imu_t), 0, len(r) - 1)]
        force = np.einsum("kij,jl,kl->ki", attitude, mounting, streams.specific_force)
        mean = np.median(force, axis=0)
        upward = -float(mean[2]) / config.gravity
        if upward > 0.9 and np.hypot(*mean[:2]) < 0.2 * config.gravity:
            text = f"gravity is where it should be ({upward:.2f} g upward at rest)"
            remarks.append(Remark("imu axes", GOOD, text))
        else:
            text = (
                f"specific force in the world is {mean[0]:.1f} {mean[1]:.1f} {mean[2]:.1f} m/s2 "
                f"north east down, not 0 0 {-config.gravity:.1f}: check the frame id of the IMU, "
                "frames.body and imu.rotation"
            )
            remarks.append(Remark("imu axes", BAD, text))
        gyro = _at(streams.t, streams.imu_t, streams.gyro @ mounting.T)
        remarks += _signs("gyro against odometry", gyro, streams.nu[:, 3:], MOTIONS[3:], 0.7)
    if streams.has_pose:
        step = max(1, round(1.0 / float(np.median(np.diff(streams.t)))))  # a second: noise is small
        moved = streams.position[step:] - streams.position[:-step]
        velocity = np.einsum("kij,kj->ki", r, streams.nu[:, :3])
        steps = np.diff(streams.t)[:, None] * 0.5 * (velocity[1:] + velocity[:-1])
        way = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        expected = way[step:] - way[:-step]
        remarks += _signs("pose against velocity", expected, moved, ("north", "east", "down"), 0.5)
    return remarks


def _signs(subject: str, a: Array, b: Array, names: Sequence[str], least: float) -> list[Remark]:
    """Whether two measurements of the same agree in sign."""
    bad, weak = [], []
    for i, name in enumerate(names):
        size = np.sqrt(np.mean(a[:, i] ** 2) * np.mean(b[:, i] ** 2))
        if size < 1e-4:
            continue
        c = float(np.mean(a[:, i] * b[:, i]) / size)
        if c < -0.3:
            bad.append(name)
        elif c < least and np.sqrt(np.mean(a[:, i] ** 2)) > 0.05:
            weak.append(f"{name} ({c:.2f})")
    if bad:
        text = f"the sign of {', '.join(bad)} is reversed: check frame ids and mounting"
        return [Remark(subject, BAD, text)]
    if weak:
        text = f"hardly correlated in {', '.join(weak)}: check frames, or the sensor's noise"
        return [Remark(subject, WARNING, text)]
    return [Remark(subject, GOOD, "signs and axes agree")]


def _push(driven: Array, wrench: Array, left: Array) -> Remark:
    """Whether the vehicle moves as the wrench says: filtered wrench (K, 6), and what of it the
    configured model leaves."""
    bad, weak = [], []
    for i in np.flatnonzero(driven):
        c = float(np.corrcoef(wrench[:, i], wrench[:, i] - left[:, i])[0, 1])
        if c < -0.3:
            bad.append(MOTIONS[i])
        elif c < 0.5:
            weak.append(f"{MOTIONS[i]} ({c:.2f})")
    subject = "wrench against motion"
    if bad:
        text = f"the vehicle moves against the wrench in {', '.join(bad)}: check its sign and axes"
        return Remark(subject, BAD, text)
    if weak:
        text = f"motion and wrench hardly go together in {', '.join(weak)}: check axes and units"
        return Remark(subject, WARNING, text)
    if not driven.any():
        return Remark(subject, BAD, "no axis is driven: nothing can be identified")
    return Remark(subject, GOOD, "the vehicle goes where it is pushed")


def _dynamics(record: Record, config: Config) -> list[Remark]:
    """What wrench and motion, filtered alike, say of each other."""
    task = regression(config, _CORNER)
    still = record.samples.copy()
    for name in ("nu", "down", "down_slope"):
        still[name] = 0.0
    phi = filtered_rows(task, record.samples, PERIOD)
    wrench = filtered_rows(task, still, PERIOD)[:, :, -1]
    if len(phi) < 20 or len(phi) != len(wrench):
        return []
    driven = np.sqrt(np.mean(wrench**2, axis=0)) > _DRIVEN * authority(config.dynamics)
    lag, std = _wrench_lag(driven, phi, wrench)
    return [_push(driven, wrench, phi[:, :, -1]), _late("motion behind the wrench", lag, std)]


# ------------------------------------------------------------------ delays


def _delays(streams: Streams, config: Config) -> list[Remark]:
    remarks = []
    if len(streams.imu_t) > 100:
        mounting = quaternion_to_matrix(quaternion_from_euler(*config.imu.rotation))
        t = streams.t[(streams.t > streams.imu_t[0]) & (streams.t < streams.imu_t[-1])]
        gyro = _at(t, streams.imu_t, streams.gyro @ mounting.T)
        rate = _at(t, streams.t, streams.nu[:, 3:])
        lag, std = _lag(t, gyro, rate)
        remarks.append(_late("odometry behind the IMU", lag, std))
    return remarks


def _late(subject: str, lag: float, std: float) -> Remark:
    text = f"{1e3 * lag:.0f} +- {1e3 * std:.0f} ms"
    if not np.isfinite(lag):
        return Remark(subject, WARNING, "cannot be told: nothing moves")
    if abs(lag) > max(_DELAY, 3.0 * std):
        text += ": check the time stamps" + (
            ", or let explain look for thruster lag and delay" if "wrench" in subject else ""
        )
        return Remark(subject, WARNING, text)
    return Remark(subject, GOOD, text)


def _lag(t: Array, early: Array, late: Array) -> tuple[float, float]:
    """By how much ``late`` (k, n) follows ``early`` [s], to first order, and its error."""
    slope = np.gradient(early, t, axis=0)
    power = float(np.sum(slope**2))
    if power < 1e-6 * len(t):
        return np.nan, np.nan
    off = late - early
    off = off - off.mean(axis=0)
    lag = -float(np.sum(off * slope)) / power
    left = off + lag * slope
    return lag, float(np.sqrt(np.mean(left**2) / power))


def _wrench_lag(driven: Array, phi: Array, wrench: Array) -> tuple[float, float]:
    """Delay between wrench and motion, the coefficients refitted along with it.

    rows phi (K, 6, n + 1) = [Phi y], filtered wrench (K, 6): tau(t - d) is tau - d tau', so the
    wrench's derivative is one more column, and the delay its factor.
    """
    slope = np.gradient(wrench, PERIOD, axis=0)
    table = np.concatenate([phi[:, :, :-1], slope[:, :, None], phi[:, :, -1:]], axis=2)[1:-1]
    n = table.shape[2] - 1
    if not driven.any() or len(table) < 5 * n:
        return np.nan, np.nan
    weight = np.where(driven, 1.0 / np.maximum(np.mean(wrench**2, axis=0), 1e-12), 0.0)
    prior = np.append(np.ones(n - 1), 0.0)
    for _ in range(3):
        a = np.einsum("kai,a,kaj->ij", table, weight, table)
        size = np.sqrt(np.diag(a)[:n]) + 1e-12
        scaled = a[:n, :n] / np.outer(size, size) + np.diag(prior / size**2)
        x = np.linalg.solve(scaled, a[:n, n] / size) / size
        left = table[:, :, n] - table[:, :, :n] @ x
        weight = np.where(driven, 1.0 / np.maximum(np.mean(left**2, axis=0), 1e-12), 0.0)
    # rows closer than the filter's memory repeat each other
    variance = np.linalg.inv(scaled)[-1, -1] / size[-1] ** 2 * 2.0 / (_CORNER * PERIOD)
    return float(x[-1]), float(np.sqrt(variance))


# ------------------------------------------------------------------ excitation


def _excitation(streams: Streams, config: Config, found: Sequence[Prospect]) -> list[Remark]:
    remarks = []
    nu = streams.nu
    wrench = streams.demand
    limits = authority(config.dynamics)
    for i, axis in enumerate(MOTIONS):
        unit, force = ("m/s", "N") if i < 3 else ("rad/s", "N m")
        low, high = np.quantile(nu[:, i], [0.02, 0.98])
        driven = float(np.sqrt(np.mean(wrench[:, i] ** 2)))
        text = f"from {low:.2f} to {high:.2f} {unit}, wrench {driven:.2g} {force} rms"
        level = GOOD
        if driven < _DRIVEN * limits[i]:
            level, text = WARNING, text + ": not driven"
        elif min(-low, high) < 0.25 * max(-low, high):
            level, text = WARNING, text + ": one direction only, what is asymmetric does not show"
        remarks.append(Remark(f"excitation of {axis}", level, text))
    unknown = [p.name for p in found if p.verdict == "not"]
    rough = [p.name for p in found if p.verdict == "roughly"]
    if unknown:
        text = f"this motion does not show {', '.join(unknown)}"
        remarks.append(Remark("coefficients", WARNING, text))
    if rough:
        text = f"only roughly (worse than {100 * WELL:g} %): {', '.join(rough)}"
        remarks.append(Remark("coefficients", WARNING, text))
    if not unknown and not rough:
        remarks.append(Remark("coefficients", GOOD, f"all {len(found)} would be known well"))
    return remarks
