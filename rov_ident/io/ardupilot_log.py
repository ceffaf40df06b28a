"""Logs of autopilots into a bag of the three topics: ArduSub's dataflash (`.BIN`) and telemetry
(`.tlog`) here, PX4's (`.ulg`) in `px4_log`.

Velocity and position are the EKF's (`XKF1`, `LOCAL_POSITION_NED`), the attitude is its quaternion
or what the autopilot reports, rates and specific force are the first IMU's; but the rates are those
of `ATTITUDE` where these come more often. The pulses to the
thrusters (`RCOU`, `SERVO_OUTPUT_RAW`) become a wrench by the configuration's `thrusters`, at the
battery's measured voltage. Axes are forward-starboard-down and north-east-down, stamps count from
the autopilot's start, plus a second. Attitude and rates are interpolated to the velocity's times.

Which way a thruster pushes, and on which output it is, the autopilot knows better than a file: its
parameters (`FRAME_CONFIG`, `MOT_n_DIRECTION`, `SERVOn_FUNCTION`) overrule the configuration, and a
contradiction is said. Where the log tells when the vehicle was armed, the rest is left out.
"""

import contextlib
import dataclasses
import io
import itertools
import os
import sys
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rov_ident.config import Config
from rov_ident.config.schema import Thrusters
from rov_ident.core.errors import UserError
from rov_ident.core.files import open_input
from rov_ident.core.frames import quaternion_between, quaternion_from_euler, quaternion_to_matrix
from rov_ident.core.messages import (
    IMU,
    LAST_STAMP,
    ODOMETRY,
    WRENCH,
    Array,
    Imu,
    Message,
    Odometry,
    Wrench,
    fault,
)
from rov_ident.io.write_messages import unlike_inputs, write_messages
from rov_ident.model.thruster_allocation import PWM, Allocator, check, knows, matrix

SUFFIXES = (".bin", ".log", ".tlog", ".ulg")

_WORLD, _BODY = "world_ned", "base_link_frd"
_MAGIC = b"\xa3\x95"  # of every record of a dataflash log
_START = 1_000_000  # us
_END = LAST_STAMP // 1000 - _START  # us; a stamp holds no more
_WRAP = 1 << 32  # us; of the clock in SERVO_OUTPUT_RAW
_LONGEST_GAP = 500_000  # us; attitudes and rates further apart are not interpolated
LEAST_VOLTAGE = 5.0  # V; below it the battery is not measured, or the vehicle is on USB
_OUTPUTS = 16  # of SERVO_OUTPUT_RAW and RCOU
_STANDARD_GRAVITY = 9.80665  # m/s2; what ArduPilot divides by
_MOTOR_1 = 33  # of SERVOn_FUNCTION
_SAFETY_ARMED = 128  # of base_mode in HEARTBEAT
_GROUND_STATION = 255  # its system in MAVLink, by convention
_AUTOPILOT = 1  # its component
_DISORDER = 1_000_000  # us; what comes later than that by radio has been sent after a new start
_EVENTS = {10: True, 11: False}  # of EV: armed, disarmed
_ALIGNED = 0.7  # cosine; thrusters of one frame differ by 45 degrees and more from each other

# Where ArduSub's motors push at a positive output, forward-starboard-down, by FRAME_CONFIG: the
# factors forward, lateral and (its throttle is upward) minus throttle of AP_Motors6DOF.cpp.
_VECTORED = ((-1, 1, 0), (-1, -1, 0), (1, 1, 0), (1, -1, 0))
FRAMES = {
    1: ("BlueROV2, VECTORED", (*_VECTORED, *((0, 0, 1),) * 2)),
    2: ("BlueROV2 Heavy, VECTORED_6DOF", (*_VECTORED, *((0, 0, 1),) * 4)),
}


@dataclass(frozen=True)
class LogReport:
    """What became of a log: messages written, and in words what was assumed or left out."""

    odometry: int
    imu: int
    wrench: int
    duration: float  # s
    notes: tuple[str, ...]


@dataclass
class _Track:
    """Numbers over the autopilot's time; other times than later ones are dropped and counted."""

    t: list[int] = field(default_factory=list)  # us
    rows: list[tuple[float, ...]] = field(default_factory=list)
    dropped: int = 0

    def add(self, t: int, *row: float) -> None:
        if not (self.t[-1] if self.t else -1) < t < _END:
            self.dropped += 1
        else:
            self.t.append(t)
            self.rows.append(row)

    def __len__(self) -> int:
        return len(self.t)


class Log:
    """What a log says, by what it is."""

    def __init__(self) -> None:
        self.motion = _Track()  # velocity 3 [m/s], position 3 [m], NED
        self.attitude = _Track()  # w x y z
        self.angles = _Track()  # roll, pitch, yaw [rad]: where there is no quaternion
        self.rates = _Track()  # body [rad/s], beside the attitude
        self.imu = _Track()  # gyro 3 [rad/s], specific force 3 [m/s2], body
        self.outputs = _Track()  # pulses [us]
        self.voltage = _Track()  # V
        self.armed = _Track()  # 1 or 0, until the next; empty where the log does not say
        self.parameters: dict[str, float] = {}  # of the autopilot
        self.signal = PWM  # what the outputs are
        self.reversed: set[int] = set()  # motors whose pulses PX4 reverses, from 0
        self.notes: list[str] = []
        self.words = {  # what a log must hold, and what to do where it does not
            "motion": "velocity of an EKF (XKF1 or LOCAL_POSITION_NED)",
            "outputs": "thruster output (RCOU or SERVO_OUTPUT_RAW)",
            "attitude": "attitude (XKQ, ATT or ATTITUDE)",
            "rates": "angular rates (IMU, RAW_IMU or ATTITUDE)",
            "advice": "log it (LOG_BITMASK, or the stream rates of telemetry), and give the EKF a "
            "source of velocity",
        }

    def is_armed(self, t: int) -> bool:
        """Whether the vehicle is, at t [us]; so it is taken to be where the log does not say."""
        i = bisect_right(self.armed.t, t) - 1
        return i < 0 or bool(self.armed.rows[i][0])

    @property
    def denser_rates(self) -> _Track:
        """Rates (the first three numbers): the IMU's or those beside the attitude, if more."""
        return max(self.imu, self.rates, key=len)

    @property
    def battery(self) -> list[float]:
        """The voltages that are a battery's."""
        return [row[0] for row in self.voltage.rows if row[0] >= LEAST_VOLTAGE]

    @property
    def motors(self) -> dict[str, list[float]]:
        """What the autopilot says of its thrusters, as keys of the section `thrusters`; empty where
        it does not say. PX4 tells positions, too."""
        rotors = int(self.parameters.get("CA_ROTOR_COUNT", 0))
        if rotors:
            get = self.parameters.get
            sides = [-1.0 if i in self.reversed else 1.0 for i in range(rotors)]
            return {
                "position": [get(f"CA_ROTOR{i}_P{x}", 0.0) for i in range(rotors) for x in "XYZ"],
                "direction": [
                    sides[i] * get(f"CA_ROTOR{i}_A{x}", 0.0) + 0.0
                    for i in range(rotors)
                    for x in "XYZ"
                ],
            }
        frame = FRAMES.get(int(self.parameters.get("FRAME_CONFIG", -1)))
        if frame is None:
            return {}
        found: dict[str, list[float]] = {"direction": [], "channels": []}
        outputs = {
            int(value): float(name.removeprefix("SERVO").removesuffix("_FUNCTION"))
            for name, value in self.parameters.items()
            if name.startswith("SERVO") and name.endswith("_FUNCTION")
        }
        for i, pushes in enumerate(frame[1]):
            sign = -1.0 if self.parameters.get(f"MOT_{i + 1}_DIRECTION", 1.0) < 0.0 else 1.0
            found["direction"] += [sign * x + 0.0 for x in pushes]
            found["channels"].append(outputs.get(_MOTOR_1 + i, i + 1.0))
        return found


def import_log(
    path: str | Path, out: str | Path, config: Config,
    progress: Callable[[float], None] | None = None,
) -> LogReport:  # fmt: skip
    """Write a log of ArduSub or PX4 as a bag of `odom`, `imu/data` and `thruster_wrench`.

    Args:
        path: a dataflash log (`.BIN`, also as text, `.log`), a telemetry log (`.tlog`) or a ULog.
        out: the bag, see `BagWriter`.
        config: its `thrusters` make the wrench.
        progress: called with the share that has been read.

    Raises UserError: the log cannot be read, or lacks what a bag needs, or there is no allocation.
    """
    path = Path(path)
    check(config.thrusters, PWM)
    log = read_log(path, progress or (lambda share: None))
    notes = log.notes
    thrusters = _as_autopilot_has_them(config.thrusters, log, notes)
    allocator = Allocator(thrusters, log.signal)
    for name, track in (
        ("motion", log.motion),
        ("outputs", log.outputs),
        ("attitude", log.attitude or log.angles),
        ("rates", log.denser_rates),
    ):
        if len(track) < 2:
            raise UserError(f"{path} holds no {log.words[name]}: {log.words['advice']}")
    messages = [*_wrenches(log, allocator, config.thrusters, notes), *_inertial(log)]
    with np.errstate(all="ignore"):  # a quaternion of zeros: left out below
        odometry = list(_odometry(log, notes))
    if not odometry:
        raise UserError(f"{path} has no attitude and rates around its velocity: log all three")
    messages += odometry
    if len(log.armed):
        driven = [row for row in messages if log.is_armed(row[0] // 1000 - _START)]
        share = len(driven) / len(messages)
        if not any(role == ODOMETRY for _, role, _ in driven):
            raise UserError(
                f"{path}: the vehicle was never armed while its velocity was known, so no thruster "
                "turned: log a dive"
            )
        notes.append(f"{100 * share:.0f} % of the log is armed; the rest is left out")
        messages = driven
    faults = [(row[1], fault(row[2])) for row in messages]
    messages = [row for row, (_, wrong) in zip(messages, faults, strict=True) if not wrong]
    for (role, wrong), count in Counter(faults).items():
        if wrong:
            notes.append(f"{count} of {role} are left out: {wrong}")
    counts = Counter(role for _, role, _ in messages)
    if not counts[ODOMETRY] or not counts[WRENCH]:
        raise UserError(f"{path} holds no odometry or wrench that a vehicle can have: log both")
    # The wrench first: at equal stamps it already acts on the velocity that follows.
    messages.sort(key=lambda row: (row[0], row[1] != WRENCH))
    write_messages(out, messages)
    notes += unlike_inputs(config)
    dropped = sum(track.dropped for track in vars(log).values() if isinstance(track, _Track))
    if dropped:
        notes.append(f"{dropped} messages with backward, repeated or impossible times are left out")
    times = [t for t, role, _ in messages if role == ODOMETRY]
    duration = (times[-1] - times[0]) * 1e-9
    return LogReport(counts[ODOMETRY], counts[IMU], counts[WRENCH], duration, tuple(notes))


def _as_autopilot_has_them(given: Thrusters, log: Log, notes: list[str]) -> Thrusters:
    """The thrusters with the outputs and the signs that the autopilot has for them."""
    said = log.motors
    if not said:
        return given
    B = matrix(given)
    along = np.reshape(said["direction"], (-1, 3))
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    if B.shape[1] != len(along):
        raise UserError(
            f"the autopilot drives {len(along)} thrusters, but the configuration has {B.shape[1]}: "
            "correct thrusters, or have `rov-ident init` take them from the log"
        )
    force = B[:3].T / np.maximum(np.linalg.norm(B[:3], axis=0)[:, None], 1e-9)
    cosine = np.sum(force * along, axis=1)
    if (np.abs(cosine) < _ALIGNED).any():
        i = int(np.argmin(np.abs(cosine))) + 1
        raise UserError(
            f"thruster {i} of the configuration does not push along the line that motor {i} has in "
            "the log: give the thrusters in the order of the autopilot's motors"
        )
    if turned := [str(i + 1) for i in np.flatnonzero(cosine < 0.0)]:
        notes.append(
            f"by the autopilot's parameters, thruster {', '.join(turned)} pushes the other way "
            "than the configuration says: the log's way is taken"
        )
    n = len(along)
    channels = tuple(said.get("channels", range(1, n + 1)))
    if given.channels and given.channels != channels:
        shown = ", ".join(f"{c:g}" for c in channels)
        notes.append(f"thrusters.channels contradict the log, whose are taken: {shown}")
    flown = B * np.where(cosine < 0.0, -1.0, 1.0)
    return dataclasses.replace(
        given, position=(), direction=(), allocation=tuple(flown.T.ravel().tolist()),
        channels=channels,
    )  # fmt: skip


_Row = tuple[int, str, Message]


def _ns(t: int) -> int:
    return 1000 * (t + _START)


def _wrenches(log: Log, allocator: Allocator, given: Thrusters, notes: list[str]) -> list[_Row]:
    """The wrench of every change of the outputs, at the voltage last measured before it for which
    the T200 has a curve."""
    measured = [(t, v) for t, (v,) in zip(log.voltage.t, log.voltage.rows) if v >= LEAST_VOLTAGE]
    known = [row for row in measured if knows(row[1])]
    if 2 * len(known) < len(measured):  # another battery: the allocator refuses it
        known = measured
    if known:
        volts = [v for _, v in known]
        notes.append(f"battery from {min(volts):.1f} to {max(volts):.1f} V, as measured")
    else:
        notes.append(f"no voltage of the battery: taken as {given.voltage:g} V (thrusters.voltage)")
    if (odd := len(measured) - len(known)) and not given.curve_pwm:
        notes.append(f"the T200 has no curve for {odd} of the voltages: the one before is taken")
    times = [t for t, _ in known]
    rows: list[_Row] = []
    for t, pulses in zip(log.outputs.t, log.outputs.rows, strict=True):
        voltage = known[max(bisect_right(times, t) - 1, 0)][1] if known else given.voltage
        try:
            tau = allocator.wrench(pulses, voltage)
        except ValueError as error:
            raise UserError(f"the thruster outputs hold {error}") from error
        rows.append((_ns(t), WRENCH, Wrench(_ns(t), _BODY, tau[:3], tau[3:])))
    return rows


def _inertial(log: Log) -> Iterator[_Row]:
    none, zero = np.zeros(4), np.zeros(3)
    for t, row in zip(log.imu.t, log.imu.rows, strict=True):
        gyro, force = np.array(row[:3]), np.array(row[3:])
        yield _ns(t), IMU, Imu(_ns(t), "imu_frd", none, gyro, force, zero, zero)


def _odometry(log: Log, notes: list[str]) -> Iterator[_Row]:
    if len(log.attitude) >= 2:
        times, quaternions = log.attitude.t, np.array(log.attitude.rows)
    else:
        times, quaternions = log.angles.t, quaternion_from_euler(*np.array(log.angles.rows).T)
        notes.append("no quaternion of the EKF: the attitude is the autopilot's angles")
    rates = log.denser_rates
    rate_t, rate = np.array(rates.t, dtype=float), np.array(rates.rows)[:, :3]
    lost = 0
    for t, row in zip(log.motion.t, log.motion.rows, strict=True):
        attitude = _attitude_at(t, times, quaternions)
        if attitude is None or _in_gap(t, rates.t):
            lost += 1
            continue
        linear = quaternion_to_matrix(attitude).T @ np.array(row[:3])
        angular = np.array([np.interp(t, rate_t, column) for column in rate.T])
        odometry = Odometry(
            _ns(t), _WORLD, _BODY, np.array(row[3:]), attitude, linear, angular, np.zeros(6)
        )
        yield _ns(t), ODOMETRY, odometry
    if lost:
        notes.append(f"{lost} velocities without attitude or rates around them are left out")


def _in_gap(t: int, times: list[int]) -> bool:
    """Whether nothing is known at t [us], as the times around it are too far apart."""
    i = bisect_right(times, t)
    if i and times[i - 1] == t:
        return False
    return i == 0 or i == len(times) or times[i] - times[i - 1] > _LONGEST_GAP


def _attitude_at(t: int, times: list[int], quaternions: Array) -> Array | None:
    if _in_gap(t, times):
        return None
    i = bisect_right(times, t)
    if times[i - 1] == t:
        return quaternions[i - 1] / np.linalg.norm(quaternions[i - 1])
    share = (t - times[i - 1]) / (times[i] - times[i - 1])
    between = quaternion_between(quaternions[i - 1], quaternions[i], share)
    return between / np.linalg.norm(between)


def read_log(path: Path, progress: Callable[[float], None] = lambda share: None) -> Log:
    """What a log says.

    Raises UserError: it cannot be read, is no log, or what reads it is not installed.
    """
    if path.suffix.lower() == ".ulg":
        from rov_ident.io.px4_log import read_ulog

        return read_ulog(path)
    try:
        from pymavlink import DFReader, mavutil
    except ImportError as error:
        raise UserError(f"{path} needs pymavlink: pip install 'rov_ident[ardupilot]'") from error
    log, kind = Log(), path.suffix.lower()
    # What pymavlink thinks of a damaged log it prints, wherever that may go.
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            with open_input(path) as stream:
                if kind == ".bin" and stream.read(2) != _MAGIC:
                    raise ValueError("it does not begin like one")
            if kind == ".tlog":
                with contextlib.closing(mavutil.mavlink_connection(str(path))) as reader:
                    log = _telemetry(reader, progress)
            else:
                read = DFReader.DFReader_text if kind == ".log" else DFReader.DFReader_binary
                with _silenced_stderr():
                    reader = read(str(path))
                _dataflash(reader, log, progress)
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): check the path") from error
    except Exception as error:  # pymavlink raises whatever the bytes make it
        raise UserError(f"{path} is no log of ArduPilot, or a damaged one: {error}") from error
    return log


@contextlib.contextmanager
def _silenced_stderr() -> Iterator[None]:
    """Nothing reaches standard error, not even from C: the indexer names each damaged byte."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _messages_of(reader: Any, kinds: list[str], progress: Callable[[float], None]) -> Iterator[Any]:
    """The messages of these kinds."""
    for count in itertools.count(1):
        message = reader.recv_match(type=kinds)
        if message is None:
            return
        if count % 2000 == 0:
            progress(float(getattr(reader, "percent", 0.0)) / 100.0)
        yield message


def _dataflash(reader: Any, log: Log, progress: Callable[[float], None]) -> None:
    kinds = ["XKF1", "NKF1", "XKQ", "XKQ1", "NKQ", "NKQ1", "ATT", "IMU", "RCOU", "BAT", "CURR"]
    kinds += ["PARM", "ARM", "EV"]
    batteries: defaultdict[tuple[str, int], _Track] = defaultdict(_Track)
    motion, attitude = {"X": _Track(), "N": _Track()}, {"X": _Track(), "N": _Track()}
    for m in _messages_of(reader, kinds, progress):
        kind, t = m.get_type(), int(m.TimeUS)
        if kind == "PARM":
            log.parameters[m.Name] = float(m.Value)
            continue
        if kind in ("ARM", "EV"):
            state = bool(m.ArmState) if kind == "ARM" else _EVENTS.get(int(m.Id))
            if state is not None:
                if not log.armed:
                    log.armed.add(0, float(not state))  # it is the change that is logged
                log.armed.add(t, float(state))
            continue
        # Several EKF cores, IMUs and batteries log under one name: the first counts, of batteries
        # the first that is measured.
        number = max(int(getattr(m, name, 0)) for name in ("C", "I", "Inst", "Instance"))
        if kind in ("BAT", "CURR"):
            batteries[kind, number].add(t, float(m.Volt))
            continue
        if number:
            continue
        if kind in ("XKF1", "NKF1"):
            motion[kind[0]].add(t, m.VN, m.VE, m.VD, m.PN, m.PE, m.PD)
        elif kind in ("XKQ", "XKQ1", "NKQ", "NKQ1"):
            attitude[kind[0]].add(t, m.Q1, m.Q2, m.Q3, m.Q4)
        elif kind == "ATT":
            log.angles.add(t, *np.radians([m.Roll, m.Pitch, m.Yaw]).tolist())
        elif kind == "IMU":
            log.imu.add(t, m.GyrX, m.GyrY, m.GyrZ, m.AccX, m.AccY, m.AccZ)
        elif kind == "RCOU":
            names = [n for n in m.get_fieldnames() if n.lower().startswith("c") and n[-1].isdigit()]
            log.outputs.add(t, *(float(getattr(m, name)) for name in names))
    # EKF3 and EKF2 may run side by side; the vehicle flies by one of them, by default EKF3.
    used, other = "NX" if log.parameters.get("AHRS_EKF_TYPE") == 2.0 else "XN"
    log.motion = motion[used] or motion[other]
    log.attitude = attitude[used] or attitude[other]
    for _, battery in sorted(batteries.items()):
        if not log.battery:
            log.voltage = battery


def _telemetry(reader: Any, progress: Callable[[float], None]) -> Log:
    """The log of the longest time from one start of the autopilot to the next."""
    log = Log()
    starts = [log]
    kinds = ["ATTITUDE", "LOCAL_POSITION_NED", "RAW_IMU", "SERVO_OUTPUT_RAW", "SYS_STATUS"]
    kinds += ["PARAM_VALUE", "HEARTBEAT"]
    vehicle: int | None = None
    now: int | None = None  # us, of the autopilot; until it is known nothing is taken
    for m in _messages_of(reader, kinds, progress):
        if m.get_srcSystem() == _GROUND_STATION:
            continue
        vehicle = m.get_srcSystem() if vehicle is None else vehicle
        if m.get_srcSystem() != vehicle or m.get_srcComponent() != _AUTOPILOT:
            continue  # another vehicle, or a camera on the same
        kind = m.get_type()
        if kind == "PARAM_VALUE":
            log.parameters[m.param_id] = float(m.param_value)
            continue
        if kind in ("ATTITUDE", "LOCAL_POSITION_NED"):
            before, now = now, 1000 * int(m.time_boot_ms)
            if before is not None and now < before - _DISORDER:
                log = Log()
                log.parameters = starts[0].parameters
                starts.append(log)
        if now is None:
            continue
        if kind == "HEARTBEAT":
            state = bool(m.base_mode & _SAFETY_ARMED)
            if not log.armed or bool(log.armed.rows[-1][0]) != state:
                log.armed.add(now if log.armed else 0, float(state))
        elif kind == "ATTITUDE":
            log.angles.add(now, m.roll, m.pitch, m.yaw)
            log.rates.add(now, m.rollspeed, m.pitchspeed, m.yawspeed)
        elif kind == "LOCAL_POSITION_NED":
            log.motion.add(now, m.vx, m.vy, m.vz, m.x, m.y, m.z)
        elif kind == "RAW_IMU":  # ArduPilot's are not raw: mrad/s and thousandths of g
            gyro = (1e-3 * v for v in (m.xgyro, m.ygyro, m.zgyro))
            force = (1e-3 * _STANDARD_GRAVITY * v for v in (m.xacc, m.yacc, m.zacc))
            log.imu.add(int(m.time_usec), *gyro, *force)
        elif kind == "SERVO_OUTPUT_RAW" and m.port == 0:
            # 32 bits of microseconds: the turn of the clock is the one nearest to the others'.
            t = int(m.time_usec) + _WRAP * round((now - int(m.time_usec)) / _WRAP)
            names = [f"servo{i}_raw" for i in range(1, _OUTPUTS + 1)]
            log.outputs.add(t, *(float(getattr(m, name, 0)) for name in names))
        elif kind == "SYS_STATUS" and m.voltage_battery not in (0, 65535):
            log.voltage.add(now, 1e-3 * m.voltage_battery)
    longest = max(starts, key=lambda each: len(each.motion))
    if len(starts) > 1:
        longest.notes.append(
            f"the autopilot started {len(starts)} times: what is longest is taken; split the log "
            "to import the rest"
        )
    return longest
