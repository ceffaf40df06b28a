"""Is this bag fit for identification: rates, gaps, frames and signs, delays, excitation.

Nothing is identified here. What is said of the coefficients is a prediction: the information that
the measured motion holds about each of them (`maximum_likelihood`), at the values and noise of the
configuration.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rov_ident.config import Config
from rov_ident.config.prior import prior_of
from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_from_euler, quaternion_to_matrix
from rov_ident.core.linalg import interpolated, scaled_inverse, scaled_solve
from rov_ident.core.states import CONVERGED, State, of_fit
from rov_ident.io import topics as inputs
from rov_ident.io.bag_reader import Bag
from rov_ident.model.coefficients import MOTIONS
from rov_ident.model.equations import Array
from rov_ident.model.scales import authority
from rov_ident.offline import archive
from rov_ident.offline.batch_fit import predicted_information
from rov_ident.offline.filtered_regression import filtered_rows, regression
from rov_ident.offline.fit import IDENTIFIABLE
from rov_ident.offline.least_squares import PERIOD
from rov_ident.offline.maximum_likelihood import inverse_of
from rov_ident.reports.result import NORMAL, Shown
from rov_ident.reports.table import PLUS_MINUS, Table, Tables
from rov_ident.sampling.raw_streams import Streams, gather, integral
from rov_ident.sampling.records import Record, read_record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Tell = Callable[..., None]

GOOD, WARNING, BAD = "good", "warning", "bad"
UNITS = (("m/s", "N"),) * 3 + (("rad/s", "N m"),) * 3  # of velocity and wrench on each axis
_VERDICTS = {State.CONVERGED: "well", State.CONVERGING: "roughly", State.HELD: "not"}
_GAP = 0.5  # s without a message, from which the sampler gives up the time between
_SLOW = 5.0  # Hz; two messages in the time constant of a small vehicle (0.4 s) are the least
_DRIVEN = 0.05  # of the axis's authority: an RMS wrench below it is that of keeping station
_DELAY = 0.02  # s; 5 % of the time constant of a small vehicle, so about 5 % of its added mass
_CORNER = 6.0  # rad/s; of the filter on wrench and motion: above the motion, below the noise
_FEWEST_IMU = 8  # messages of the IMU; fewer say nothing of axes, ...
_FEWEST_TIMED = 100  # ... and fewer than these nothing of delays
_FEWEST_ROWS = 20  # of filtered wrench and motion; about as many as there are coefficients
_UPWARD = 0.9  # g; mean specific force upward; a sign or an axis that is wrong gives 0.7 or less
_SIDEWAYS = 0.2  # g; mean specific force along the horizon: 11 deg of mounting
_REVERSED = -0.3  # correlation of two measurements of one thing; below it the sign is wrong
_ANGULAR_LEAST, _LINEAR_LEAST, _MOTION_LEAST = 0.7, 0.5, 0.5  # correlation that good sensors reach:
# half of the variance is common; of position and motion, which are noisier, a quarter
_STILL = 1e-4  # m or rad/s; nothing moves
_MOVES = 0.05  # m or rad/s RMS, from which a poor correlation is worth a word
_ONE_WAY = 0.25  # of the larger of the velocities either way: driven in one direction only


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
    def state(self) -> State:
        """The state in which a fit would leave it."""
        return of_fit(self.value, self.std, self.prior_std, self.identifiable)


@dataclass(frozen=True)
class Check(Shown):
    """All that was found out about a bag: its name, ``duration`` [s], ``remarks`` on rates, gaps,
    axes, signs, delays and excitation; ``prospects``: what a fit would tell of each coefficient.
    """

    bag: str
    duration: float
    config: Config = field(repr=False)
    remarks: tuple[Remark, ...]
    prospects: tuple[Prospect, ...]
    information: Array = field(repr=False)
    record: Record = field(repr=False)
    streams: Streams = field(repr=False)

    @property
    def fit(self) -> bool:
        """Whether a fit makes sense: no remark is BAD, and some coefficient would be known."""
        known = any(p.identifiable for p in self.prospects)
        return known and all(r.level != BAD for r in self.remarks)

    @property
    def sentence(self) -> str:
        """Whether the bag is fit for identification."""
        known = sum(p.state is State.CONVERGED for p in self.prospects)
        return (
            f"{self.bag}, {self.duration:.1f} s: {'' if self.fit else 'not '}fit for "
            f"identification; it would tell {known} of {len(self.prospects)} coefficients well."
        )

    def table(self) -> Tables:
        """Every remark, and what a fit would tell of each coefficient."""
        rows = [
            [p.name, f"{p.value:.4g}", f"{NORMAL * p.std:.2g}", p.unit, p.state.value]
            for p in self.prospects
        ]
        head = ["", "configured", PLUS_MINUS, "unit", "state"]
        remarks = [[r.level, r.subject, r.text] for r in self.remarks]
        looked_at = Table("what was looked at", ["", "subject", ""], remarks, text=(1, 2))
        return Tables((looked_at, Table("what a fit of it would give", head, rows, text=(3, 4))))

    def plot(self) -> "Figure":
        """How well each coefficient is known, now and after a fit."""
        from rov_ident.experiment.report import check_picture

        return check_picture(self)

    def page(self) -> str:
        """A self-contained HTML document."""
        from rov_ident.experiment.report import of_check

        return of_check(self)

    def to_json(self) -> str:
        """The remarks, and what is predicted of each coefficient."""
        coefficients = {
            p.name: {
                "configured": p.value,
                "predicted_std": p.std,
                "prior_std": p.prior_std,
                "unit": p.unit,
                "identifiable": p.identifiable,
                "verdict": _VERDICTS[p.state],
                "state": p.state.value,
            }
            for p in self.prospects
        }
        document = {
            "bag": self.bag,
            "duration_s": self.duration,
            "fit_for_identification": self.fit,
            "remarks": [vars(r) for r in self.remarks],
            "coefficients": coefficients,
        }
        return json.dumps(document, indent=2, allow_nan=False) + "\n"


def check(path: Path, config: Config, tell: Tell | None = None) -> Check:
    """Look at a bag; ``tell`` is called with what is being done, and what share of it is. UserError
    if it cannot be read, or has not the messages that it takes to look at anything."""
    say = tell or (lambda what, share=None: None)
    record = read_record(path, config, lambda k, n: say(f"reading {path.name}", k / max(n, 1)))
    say("looking at its messages")
    bag = Bag(path)
    streams = gather(inputs.messages(bag, inputs.select(bag, config), config), config)
    if streams.duration < 1.0:
        raise UserError(f"{path.name} lasts {streams.duration:.1f} s: nothing can be said of it")
    remarks = [*_rates(streams), *(Remark("messages", WARNING, n) for n in record.notes)]
    remarks += [*_frames(streams, config), *_dynamics(record, config)]
    say("predicting what a fit would tell")
    information = predicted_information(archive.of_records([record]), config)
    found = prospects(config, information)
    remarks += _excitation(streams, config, found)
    return Check(
        path.name, streams.duration, config, tuple(remarks), found, information, record, streams
    )


def prospects(config: Config, information: Array) -> tuple[Prospect, ...]:
    """What information (n, n) about the coefficients to estimate makes of the prior."""
    prior = prior_of(config)
    covariance = inverse_of(information + np.diag(prior.std**-2.0))
    std = np.sqrt(np.diag(covariance))
    values, stds, wide = prior.mean.tolist(), std.tolist(), prior.std.tolist()
    return tuple(map(Prospect, prior.names, values, prior.units, stds, wide))


def _rates(streams: Streams) -> list[Remark]:
    remarks = []
    topics = {"odometry": streams.t, "imu": streams.imu_t, "wrench": streams.demand_t}
    if len(streams.inputs_t):
        topics["inputs"] = streams.inputs_t
    for name, t in topics.items():
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


def _frames(streams: Streams, config: Config) -> list[Remark]:
    remarks = []
    body = config.model.body
    # What rights the hull for each radian of roll or pitch, the axis z down.
    righting = body.weight * body.cog[2] - body.buoyancy * body.cob[2]
    if righting < 0.0:
        text = f"by its cob and cog the configured hull would capsize ({righting:.2g} N m/rad): "
        text += "check vehicle.frame (frd: z down, flu: z up), vehicle.cob and vehicle.cog"
        remarks.append(Remark("vehicle.frame", BAD, text))
    r = quaternion_to_matrix(streams.orientation)
    mounting = quaternion_to_matrix(quaternion_from_euler(*config.imu.rotation))
    if len(streams.imu_t) > _FEWEST_IMU:
        attitude = r[np.clip(np.searchsorted(streams.t, streams.imu_t), 0, len(r) - 1)]
        force = np.einsum("kij,jl,kl->ki", attitude, mounting, streams.specific_force)
        mean = np.median(force, axis=0)
        upward = -float(mean[2]) / config.gravity
        level, text = GOOD, f"gravity is where it should be ({upward:.2f} g upward at rest)"
        if upward <= _UPWARD or np.hypot(*mean[:2]) >= _SIDEWAYS * config.gravity:
            level, text = BAD, "specific force in the world is "
            text += f"{mean[0]:.1f} {mean[1]:.1f} {mean[2]:.1f} m/s2 north east down, not 0 0 "
            text += f"{-config.gravity:.1f}: check the frame id of the IMU, frames.body and "
            text += "imu.rotation"
        remarks.append(Remark("imu axes", level, text))
        gyro = interpolated(streams.imu_t, streams.gyro @ mounting.T, streams.t)
        rate = streams.nu[:, 3:]
        remarks.append(_signs("gyro against odometry", gyro, rate, MOTIONS[3:], _ANGULAR_LEAST))
    if streams.has_pose:
        step = max(1, round(1.0 / float(np.median(np.diff(streams.t)))))  # a second: noise is small
        moved = streams.position[step:] - streams.position[:-step]
        way = integral(streams.t, np.einsum("kij,kj->ki", r, streams.nu[:, :3]))
        told, axes = way[step:] - way[:-step], ("north", "east", "down")
        remarks.append(_signs("pose against velocity", told, moved, axes, _LINEAR_LEAST))
    if len(streams.imu_t) > _FEWEST_TIMED:
        known = (streams.t > streams.imu_t[0]) & (streams.t < streams.imu_t[-1])
        lag = _lag(streams.t[known], gyro[known], rate[known])
        remarks.append(_late("odometry behind the IMU", *lag))
    return remarks


def _signs(subject: str, a: Array, b: Array, names: Sequence[str], least: float) -> Remark:
    """Whether two measurements of the same agree in sign."""
    power, common = np.mean(a**2, axis=0), np.mean(a * b, axis=0)
    size = np.sqrt(power * np.mean(b**2, axis=0))
    c = np.where(size < _STILL, 1.0, common / np.maximum(size, 1e-300))
    moves = np.sqrt(power) > _MOVES
    return _correlated(
        subject, dict(zip(names, c.tolist(), strict=True)), np.where(moves, least, _REVERSED),
        "the sign of {} is reversed: check frame ids and mounting",
        "hardly correlated in {}: check frames, or the sensor's noise", "signs and axes agree",
    )  # fmt: skip


def _correlated(
    subject: str, by_name: dict[str, float], least: Array, bad: str, weak: str, good: str
) -> Remark:
    """The sentence for correlations of which some are reversed, or less than the least (n,)."""
    reverse = [name for name, c in by_name.items() if c < _REVERSED]
    low = [f"{n} ({c:.2f})" for (n, c), x in zip(by_name.items(), least, strict=True) if c < x]
    if reverse:
        return Remark(subject, BAD, bad.format(", ".join(reverse)))
    return (
        Remark(subject, WARNING, weak.format(", ".join(low)))
        if low
        else Remark(subject, GOOD, good)
    )


def _push(driven: Array, wrench: Array, left: Array) -> Remark:
    """Whether the vehicle moves as the wrench says: filtered wrench (K, 6), and what of it the
    configured model leaves."""
    subject, by_name = "wrench against motion", {}
    for i in np.flatnonzero(driven):
        by_name[MOTIONS[i]] = float(np.corrcoef(wrench[:, i], wrench[:, i] - left[:, i])[0, 1])
    if not by_name:
        return Remark(subject, BAD, "no axis is driven: nothing can be identified")
    return _correlated(
        subject, by_name, np.full(len(by_name), _MOTION_LEAST),
        "the vehicle moves against the wrench in {}: check its sign and axes",
        "motion and wrench hardly go together in {}: check axes and units",
        "the vehicle goes where it is pushed",
    )  # fmt: skip


def _dynamics(record: Record, config: Config) -> list[Remark]:
    """What wrench and motion, filtered alike, say of each other."""
    task = regression(config, _CORNER)
    still = record.samples.copy()
    for name in ("nu", "down", "down_slope"):
        still[name] = 0.0
    phi = filtered_rows(task, record.samples, PERIOD)
    wrench = filtered_rows(task, still, PERIOD)[:, :, -1]
    if len(phi) < _FEWEST_ROWS or len(phi) != len(wrench):
        return []
    driven = np.sqrt(np.mean(wrench**2, axis=0)) > _DRIVEN * authority(config.dynamics)
    late = _late("motion behind the wrench", *_wrench_lag(driven, phi, wrench))
    return [_push(driven, wrench, phi[:, :, -1]), late]


def _late(subject: str, lag: float, std: float) -> Remark:
    text = f"{1e3 * lag:.1f} ± {1e3 * NORMAL * std:.1f} ms (95 %)"
    if not np.isfinite(lag):
        return Remark(subject, WARNING, "cannot be told: nothing moves")
    if abs(lag) > max(_DELAY, 3.0 * std):
        more = ", or let explain look for thruster lag and delay" if "wrench" in subject else ""
        return Remark(subject, WARNING, f"{text}: check the time stamps{more}")
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
    """Delay between wrench and motion, the coefficients refitted along with it; rows phi (K, 6, n +
    1) = [Phi y], filtered wrench (K, 6). tau(t - d) is tau - d tau': the wrench's derivative is one
    more column, and the delay its factor."""
    slope = np.gradient(wrench, PERIOD, axis=0)
    table = np.concatenate([phi[:, :, :-1], slope[:, :, None], phi[:, :, -1:]], axis=2)[1:-1]
    n = table.shape[2] - 1
    if not driven.any() or len(table) < 5 * n:
        return np.nan, np.nan
    weight = np.where(driven, 1.0 / np.maximum(np.mean(wrench**2, axis=0), 1e-12), 0.0)
    prior = np.append(np.ones(n - 1), 0.0)
    for _ in range(3):
        a = np.einsum("kai,a,kaj->ij", table, weight, table)
        normal = a[:n, :n] + np.diag(prior)
        x = scaled_solve(normal, a[:n, n])
        left = table[:, :, n] - table[:, :, :n] @ x
        weight = np.where(driven, 1.0 / np.maximum(np.mean(left**2, axis=0), 1e-12), 0.0)
    # rows closer than the filter's memory repeat each other
    variance = scaled_inverse(normal)[-1, -1] * 2.0 / (_CORNER * PERIOD)
    return float(x[-1]), float(np.sqrt(variance))


def _excitation(streams: Streams, config: Config, found: Sequence[Prospect]) -> list[Remark]:
    remarks, limits, steered = [], authority(config.dynamics), np.zeros((1, 6))
    if len(streams.inputs_t):  # fins and propeller drive, too
        now = interpolated(streams.inputs_t, streams.inputs, streams.t)
        steered = config.dynamics.input_wrench(streams.nu, now)
    for i, axis in enumerate(MOTIONS):
        unit, force = UNITS[i]
        low, high = np.quantile(streams.nu[:, i], [0.02, 0.98])
        driven = float(np.sqrt(np.mean(streams.demand[:, i] ** 2) + np.mean(steered[:, i] ** 2)))
        text = f"from {low:.2f} to {high:.2f} {unit}, wrench {driven:.2g} {force} rms"
        level = GOOD
        if driven < _DRIVEN * limits[i]:
            level, text = WARNING, text + ": not driven"
        elif min(-low, high) < _ONE_WAY * max(-low, high):
            level, text = WARNING, text + ": one direction only, what is asymmetric does not show"
        remarks.append(Remark(f"excitation of {axis}", level, text))
    unknown = [p.name for p in found if p.state is State.HELD]
    rough = [p.name for p in found if p.state is State.CONVERGING]
    told = [f"this motion does not show {', '.join(unknown)}"] if unknown else []
    if rough:
        told.append(f"only roughly (worse than {100 * CONVERGED:g} %): {', '.join(rough)}")
    if not told:
        return [*remarks, Remark("coefficients", GOOD, f"all {len(found)} would be known well")]
    return remarks + [Remark("coefficients", WARNING, text) for text in told]
