"""What the messages of a bag alone say: rates, pauses, axes, signs, delays.

Axes, and signs of the wrench against the motion, can be so wrong that no fit makes sense of them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_to_matrix, rotated, turns
from rov_ident.core.linalg import integral
from rov_ident.core.messages import Array
from rov_ident.discrepancy.sensor_consistency import has_imu
from rov_ident.model.coefficients import MOTIONS
from rov_ident.offline import delays
from rov_ident.offline.delays import Delay
from rov_ident.reports.result import NORMAL
from rov_ident.sampling.queues import LONGEST_INTERVAL
from rov_ident.sampling.raw_streams import Streams
from rov_ident.sampling.without_velocity import is_without_velocity

GOOD, WARNING, BAD = "good", "warning", "bad"
_SLOW = 5.0  # Hz; two messages in the time constant of a small vehicle (0.4 s) are the least
_UPWARD = 0.9  # g; mean specific force upward; a sign or an axis that is wrong gives 0.7 or less
_SIDEWAYS = 0.2  # g; mean specific force along the horizon: 11 deg of mounting
_POSE = "pose against velocity"
_REVERSED = -0.3  # correlation of two measurements of one thing; below it the sign is wrong
_ANGULAR_LEAST, _LINEAR_LEAST, _MOTION_LEAST = 0.7, 0.5, 0.5  # correlation that good sensors reach:
# half of the variance is common; of position and motion, which are noisier, a quarter
_SAME = 0.9  # correlation of two measurements of one thing, less noise
_UNITS = 2.0  # times too large or small; noise and lateness do not make a rate twice the turn
_OTHER_FORCES = 3.0  # times the wrench; where so much else moves it (a Munk moment), no sign shows
_UNMOVED = 0.1  # of the wrench; neither a guess nor a thrust scale is ten times off
_SILENT = 0.5  # of a pause of the odometry: a pause of the wrench that may be its reason
_STILL = 1e-4  # m or rad/s; nothing moves
_MOVES = 0.05  # m or rad/s RMS, from which a poor correlation is worth a word


@dataclass(frozen=True)
class Remark:
    """One thing looked at: ``level`` GOOD, WARNING or BAD, ``text`` a sentence."""

    subject: str
    level: str
    text: str
    hopeless: bool = False  # no model explains such data: a fit is refused


def of_messages(streams: Streams, config: Config) -> list[Remark]:
    """On the rates, pauses, axes, signs and delays of the sensors."""
    return [*_rate_remarks(streams), *_axes_remarks(streams, config)]


def refuse_reversed(bag: str, remarks: Iterable[Remark]) -> None:
    """UserError where remarks of :func:`of_dynamics` say that no fit can make sense of a bag."""
    for remark in remarks:
        if remark.hopeless:
            raise UserError(f"{bag}: {remark.text} (rov-ident check says more)")


def _rate_remarks(streams: Streams) -> list[Remark]:
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
        if gap > LONGEST_INTERVAL and name != "wrench":
            lost = float(steps[steps > LONGEST_INTERVAL].sum())
            level, text = WARNING, f"{text}; {lost:.1f} s in all are lost to pauses"
            if name == "odometry" and np.diff(streams.demand_t).max() > _SILENT * gap:
                text += " (the wrench pauses, too, and without it odometry is not used)"
        if rate < _SLOW:
            level = WARNING
            text += f"; {_SLOW:g} Hz is the least that shows how the vehicle accelerates"
        remarks.append(Remark(name, level, text))
    return remarks


def _axes_remarks(streams: Streams, config: Config) -> list[Remark]:
    remarks = []
    body = config.model.body
    if body.righting_arm < 0.0:
        moment = body.righting_arm * body.weight
        text = f"by its cob and cog the configured hull would capsize ({moment:.2g} N m/rad): "
        text += "check vehicle.frame (frd: z down, flu: z up), vehicle.cob and vehicle.cog"
        remarks.append(Remark("vehicle.frame", BAD, text))
    r = quaternion_to_matrix(streams.orientation)
    if has_imu(streams):
        attitude = r[np.clip(np.searchsorted(streams.t, streams.imu_t), 0, len(r) - 1)]
        force = np.einsum("kij,jl,kl->ki", attitude, config.imu.to_body, streams.specific_force)
        mean = np.median(force, axis=0)
        upward = -float(mean[2]) / config.gravity
        level, text = GOOD, f"gravity is where it should be ({upward:.2f} g upward at rest)"
        if upward <= _UPWARD or np.hypot(*mean[:2]) >= _SIDEWAYS * config.gravity:
            level, text = BAD, "specific force in the world is "
            text += f"{mean[0]:.1f} {mean[1]:.1f} {mean[2]:.1f} m/s2 north east down, not 0 0 "
            text += f"{-config.gravity:.1f}: check the frame id of the IMU, frames.body and "
            text += "imu.rotation"
        remarks.append(Remark("imu axes", level, text))
        gyro, rate = delays.gyro_at(streams, config), streams.nu[:, 3:]
        remarks.append(_agreement("gyro against odometry", gyro, rate, MOTIONS[3:], _ANGULAR_LEAST))
    first, last = _seconds(streams.t)
    remarks += _rates_and_turns(streams, first, last)
    if len(first) and streams.has_pose and streams.nu[:, :3].any():
        moved = streams.position[last] - streams.position[first]
        way = integral(streams.t, rotated(r, streams.nu[:, :3]))
        told, axes = way[last] - way[first], ("north", "east", "down")
        way = integral(streams.t, streams.nu[:, :3])
        remarks.append(
            _along_world_axes(way[last] - way[first], told, moved)
            or _agreement(_POSE, told, moved, axes, _LINEAR_LEAST)
        )
    late = delays.odometry_behind_imu(streams, config)
    if late is not None:
        behind = delays.surely_behind_imu(streams, config)
        wrong = delays.behind_imu(behind) if behind else ""
        remarks.append(_delay_remark("odometry behind the IMU", late, wrong))
    return remarks


def _seconds(t: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last message, (k,) each, of all that are a second apart, so that noise is small;
    none across a pause, of whose motion nothing is known."""
    usual = float(np.median(np.diff(t)))
    step = max(1, round(1.0 / usual))
    pauses = np.cumsum(np.diff(t, prepend=t[0]) > max(LONGEST_INTERVAL, 2.0 * usual))
    first = np.flatnonzero(pauses[step:] == pauses[:-step])
    return first, first + step


def _rates_and_turns(
    streams: Streams, first: NDArray[np.intp], last: NDArray[np.intp]
) -> list[Remark]:
    """Whether the odometry's angular velocities are as large as the turns of its attitude, each
    from a ``first`` message to a ``last`` one."""
    way = integral(streams.t, streams.nu[:, 3:])
    turned = np.vstack([np.zeros(3), np.cumsum(turns(streams.orientation), axis=0)])
    rates, real = (x[last] - x[first] for x in (way, turned))
    power = np.sum(real**2, axis=0)
    turns_much = power > _MOVES**2 * len(real)
    share = np.sum(rates * real, axis=0) / np.maximum(power, 1e-300)
    wrong = turns_much & ((share < 1.0 / _UNITS) | (share > _UNITS))
    subject = "angular velocity against attitude"
    if not wrong.any():
        return [Remark(subject, GOOD, "signs and sizes agree")] if turns_much.any() else []
    told = ", ".join(f"{share[i]:.2g} times in {MOTIONS[3 + i]}" for i in np.flatnonzero(wrong))
    text = f"the odometry's angular velocities are the turns of its attitude {told}"
    return [Remark(subject, BAD, f"{text}: check units (rad/s), signs and frame ids")]


def _along_world_axes(as_read: Array, turned: Array, moved: Array) -> Remark | None:
    """That velocities go along with the position's (k, 3) as they are, but for a constant turn, and
    not once they are turned by the attitude."""
    way = moved[:, 0] + 1j * moved[:, 1]

    def coherence(other: Array) -> float:
        x = other[:, 0] + 1j * other[:, 1]
        return float(abs(np.vdot(x, way))) / max(
            float(np.linalg.norm(x) * np.linalg.norm(way)), _STILL
        )

    if coherence(turned) >= _LINEAR_LEAST or coherence(as_read) <= _SAME:
        return None
    text = (
        "the velocities are along the axes of the world, not of the vehicle: turn them by the "
        "attitude, or record those of the odometry's child frame"
    )
    return Remark(_POSE, BAD, text)


def _agreement(subject: str, a: Array, b: Array, names: Sequence[str], least: float) -> Remark:
    """Whether two measurements of the same agree in sign."""
    power, common = np.mean(a**2, axis=0), np.mean(a * b, axis=0)
    size = np.sqrt(power * np.mean(b**2, axis=0))
    c = np.where(size < _STILL, 1.0, common / np.maximum(size, 1e-300))
    moves = np.sqrt(power) > _MOVES
    return _correlation_remark(
        subject, dict(zip(names, c.tolist(), strict=True)), np.where(moves, least, _REVERSED),
        "the sign of {} is reversed: check frame ids and mounting",
        "hardly correlated in {}: check frames, or the sensor's noise", "signs and axes agree",
    )  # fmt: skip


def _correlation_remark(
    subject: str, by_name: dict[str, float], least: Array, bad: str, weak: str, good: str,
    reversed_below: float = _REVERSED,
) -> Remark:  # fmt: skip
    """The sentence for correlations of which some are reversed, or less than the least (n,)."""
    reverse = [name for name, c in by_name.items() if c < reversed_below]
    low = [f"{n} ({c:.2f})" for (n, c), x in zip(by_name.items(), least, strict=True) if c < x]
    if reverse:
        text = bad.format(", ".join(reverse))
        return Remark(subject, BAD, text, hopeless=2 * len(reverse) >= len(by_name))
    if low:
        return Remark(subject, WARNING, weak.format(", ".join(low)))
    return Remark(subject, GOOD, good)


def of_dynamics(samples: NDArray[np.void], config: Config) -> list[Remark]:
    """Whether wrench and motion of samples (k,) of SAMPLE, filtered alike, agree in sign and time.

    A controller that holds a position in waves pushes against the motion as well, but hardly on
    most of the driven axes: there it is a wrong sign, and no fit makes sense.
    """
    if samples["inputs"].any():
        return []  # fins and propellers drive it, too: the wrench alone does not say where it goes
    rows = delays.filtered(samples, config)
    if rows is None or (is_without_velocity(samples) and not rows.driven.any()):
        return []
    wrench, driven, size = rows.wrench, rows.driven, np.sqrt(np.mean(rows.wrench**2, axis=0))
    subject, moved = "wrench against motion", wrench - rows.phi[:, :, -1]
    if not driven.any():
        return [Remark(subject, BAD, "no axis is driven: nothing can be identified")]
    trim = config.dynamics.restoring_force(samples["down"].mean(axis=0))  # which rest needs, too
    motion = np.hypot(np.std(moved, axis=0), np.mean(moved, axis=0) - trim)
    if np.all(motion[driven] < _UNMOVED * size[driven]):
        text = (
            "the vehicle does not move, whatever the wrench: was it armed, and in the water? Or "
            "does it hold its place (against a current, on the ground), which tells nothing?"
        )
        return [Remark(subject, BAD, text, hopeless=True)]
    judged = driven & (np.sqrt(np.mean(moved**2, axis=0)) < _OTHER_FORCES * size)
    by_name = {MOTIONS[i]: _correlation(wrench[:, i], moved[:, i]) for i in np.flatnonzero(judged)}
    small = "what moves the vehicle is far more than the wrench on every axis: check its units"
    push = Remark(subject, WARNING, small) if not by_name else _correlation_remark(
        subject, by_name, np.full(len(by_name), _MOTION_LEAST),
        "the vehicle moves against the wrench in {}: check its sign and axes (its frame id, "
        "frames.body); or a controller works there against what the model lacks",
        "motion and wrench hardly go together in {}: check signs, axes and units",
        "the vehicle goes where it is pushed",
        -_MOTION_LEAST,  # a wrench that is reversed gives minus what a right one gives
    )  # fmt: skip
    late = delays.motion_behind_wrench(rows)
    ahead, most = late.ahead
    wrong = delays.ahead_of_wrench(ahead) if ahead > most else ""
    half = len(wrench) // 2
    halves = [delays.motion_behind_wrench(rows.part(part)) for part in np.s_[:half, half:]]
    told = _delay_remark("motion behind the wrench", late, wrong)
    return [push, told, *_drift_remark(*halves)]


def _correlation(a: Array, b: Array) -> float:
    """The correlation of two signals (k,) about their means or about zero, whichever is larger. A
    wrong sign turns both; a controller that pushes harder as a vehicle slows turns only the first.
    """
    about_zero = float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-300)
    a, b = a - a.mean(), b - b.mean()
    return max(about_zero, float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-300))


def _delay_remark(subject: str, late: Delay, wrong: str) -> Remark:
    """A delay; ``wrong`` says what it means where it surely is one of the stamps, else is empty."""
    text = f"{1e3 * late.value:.1f} ± {1e3 * NORMAL * late.std:.1f} ms (95 %)"
    if not np.isfinite(late.value):
        return Remark(subject, WARNING, "cannot be told: nothing moves")
    if abs(late.value) > delays.FIRST_ORDER:
        return Remark(subject, WARNING, "cannot be told: the one does not follow the other")
    if wrong:
        return Remark(subject, WARNING, f"{text}: {wrong}")
    if abs(late.value) > max(delays.MATTERS, 3.0 * late.std):
        more = ", or let explain look for thruster lag and delay" if "wrench" in subject else ""
        return Remark(subject, WARNING, f"{text}: check the time stamps{more}")
    return Remark(subject, GOOD, text)


def _drift_remark(first: Delay, last: Delay) -> list[Remark]:
    """That a delay differs between the halves of the record; else nothing."""
    moved, std = last.value - first.value, float(np.hypot(first.std, last.std))
    if not max(delays.MATTERS, delays.SURELY * std) < abs(moved) < delays.FIRST_ORDER:
        return []
    text = (
        f"{1e3 * first.value:.0f} ms in the first half, {1e3 * last.value:.0f} ms in the second: "
        "do the clocks that stamp them run apart, or did something change?"
    )
    return [Remark("motion behind the wrench, by halves", WARNING, text)]
