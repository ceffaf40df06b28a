"""PX4's logs (`.ulg`): what they say of motion and thrust, as of any autopilot.

Velocity and position are EKF2's (`vehicle_local_position`, NED), the attitude its quaternion, rates
and specific force those of `sensor_combined`. The allocator's demand on each motor
(`actuator_motors`, -1 to 1) becomes a pulse width as PX4's mixer makes it; the battery is
`battery_status`, the geometry `CA_ROTORn_*`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array
from rov_ident.io.ardupilot_log import LEAST_VOLTAGE, Log
from rov_ident.model.thruster_allocation import NORMALIZED, PWM

_TOPICS = (
    "vehicle_local_position", "vehicle_attitude", "sensor_combined", "actuator_motors",
    "battery_status", "vehicle_status",
)  # fmt: skip
_ARMED = 2  # of vehicle_status.arming_state
_MOTOR_1 = 101  # of PWM_MAIN_FUNCn
_OUTPUTS = ("PWM_MAIN", "PWM_AUX", "PCA9685")  # what gives pulses, 16 each
_WORDS = {
    "motion": "valid velocity of EKF2 (vehicle_local_position)",
    "outputs": "thruster output (actuator_motors)",
    "attitude": "attitude (vehicle_attitude)",
    "rates": "angular rates (sensor_combined)",
    "advice": "log it (SDLOG_PROFILE), and give EKF2 a source of velocity",
}


def read_ulog(path: Path) -> Log:
    """What a ULog says.

    Raises UserError: it cannot be read, is no ULog, or pyulog is not installed.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise UserError(f"{path} needs pyulog: pip install 'rov_ident[px4]'") from error
    log = Log()
    log.words = _WORDS
    try:
        ulog = ULog(str(path), list(_TOPICS))
        topics: dict[str, Any] = {}
        for each in sorted(ulog.data_list, key=lambda each: each.multi_id):
            if each.name != "battery_status" or each.data["voltage_v"].max() >= LEAST_VOLTAGE:
                topics.setdefault(each.name, each.data)
        log.parameters = {name: float(value) for name, value in ulog.initial_parameters.items()}
        _fill(log, topics)
        if ulog.dropouts:
            lost = 1e-3 * sum(each.duration for each in ulog.dropouts)
            log.notes.append(f"the logger lost {lost:.1f} s in {len(ulog.dropouts)} dropouts")
        if ulog.file_corruption:
            log.notes.append("the log is damaged or cut: what can be read of it is taken")
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): check the path") from error
    except Exception as error:  # pyulog raises whatever the bytes make it
        raise UserError(f"{path} is no log of PX4, or a damaged one: {error}") from error
    return log


def _fill(log: Log, topics: dict[str, Any]) -> None:
    def rows(topic: str, names: list[str]) -> Array:
        """(k, 1 + n): the time [us] and these fields, where they are finite.

        What EKF2 publishes holds for the time of the IMU's sample, milliseconds before.
        """
        data = topics.get(topic)
        if data is None:
            return np.empty((0, 1 + len(names)))
        time = data["timestamp"]
        if topic in ("vehicle_local_position", "vehicle_attitude"):
            sample = data.get("timestamp_sample", time)
            time = np.where(sample > 0, sample, time)
        table = np.column_stack([time, *(data[name] for name in names)]).astype(float)
        return table[np.isfinite(table).all(axis=1)]

    if place := topics.get("vehicle_local_position"):
        _without_resets(place, log.notes)
    names = ["vx", "vy", "vz", "x", "y", "z", "v_xy_valid", "v_z_valid"]
    for t, *row, over_ground, vertical in rows("vehicle_local_position", names).tolist():
        if over_ground and vertical:
            log.motion.add(int(t), *row)
    for t, *row in rows("vehicle_attitude", [f"q[{i}]" for i in range(4)]).tolist():
        log.attitude.add(int(t), *row)
    names = [f"{name}[{i}]" for name in ("gyro_rad", "accelerometer_m_s2") for i in range(3)]
    for t, *row in rows("sensor_combined", names).tolist():
        log.imu.add(int(t), *row)
    for t, volt in rows("battery_status", ["voltage_v"]).tolist():
        log.voltage.add(int(t), volt)
    for t, state in rows("vehicle_status", ["arming_state"]).tolist():
        log.armed.add(int(t) if log.armed else 0, float(state == _ARMED))
    if motors := topics.get("actuator_motors"):
        n = int(log.parameters.get("CA_ROTOR_COUNT", 0)) or 12  # 0: the geometry is not told
        controls = np.column_stack([motors[f"control[{i}]"] for i in range(n)]).astype(float)
        always = np.full(len(controls), (1 << n) - 1)
        controls = _commands(log, controls, motors.get("reversible_flags", always))
        for t, row in zip(motors["timestamp"].tolist(), controls.tolist()):
            log.outputs.add(int(t), *row)


def _without_resets(place: Any, notes: list[str]) -> None:
    """Take the jumps of the position off: EKF2 sets it anew when an aid comes or goes."""
    for axes, counter, delta in (
        (("x", "y"), "xy_reset_counter", "delta_xy[{}]"),
        (("z",), "z_reset_counter", "delta_z"),
    ):
        if counter not in place:
            continue
        again = np.diff(place[counter].astype(int), prepend=int(place[counter][0])) != 0
        for i, axis in enumerate(axes):
            place[axis] = place[axis] - np.cumsum(np.where(again, place[delta.format(i)], 0.0))
    velocity = [place[name] for name in ("vxy_reset_counter", "vz_reset_counter") if name in place]
    if count := sum(int(np.count_nonzero(np.diff(counter.astype(int)))) for counter in velocity):
        notes.append(f"EKF2 set its velocity anew {count} times: it jumps there without a force")


def _commands(log: Log, controls: Array, reversible: Any) -> Array:
    """Demands (k, n) as the pulses [us] of PX4's mixer, 0 for a motor that is off.

    Where the parameters do not tell the ends of all pulses, they stay between -1 and 1. By
    FunctionMotors.hpp and mixer_module.cpp of PX4 1.14.
    """
    get = log.parameters.get
    if 0.0 < (a := get("THR_MDL_FAC", 0.0)) <= 1.0:  # |demand| = a x^2 + (1 - a) x
        b = 0.5 * (1.0 - a) / a
        controls = np.sign(controls) * (np.sqrt(b * b + np.abs(controls) / a) - b)
    n = controls.shape[1]
    outputs = {
        int(get(f"{kind}_FUNC{k}", 0.0)) - _MOTOR_1: (kind, k)
        for kind in _OUTPUTS
        for k in range(1, 17)
    }
    ends = {
        i: [get(f"{kind}_{end}{k}", np.nan) for end in ("MIN", "MAX")]
        for i, (kind, k) in outputs.items()
    }
    if not all(i in ends and np.isfinite(ends[i]).all() for i in range(n)):
        log.signal = NORMALIZED
        log.notes.append("no PWM outputs of the motors: demands of -1 to 1 are 1100 to 1900 us")
        return np.nan_to_num(controls)
    log.signal = PWM
    one_way = (reversible[:, None] >> np.arange(n)) & 1 == 0
    off = ~np.isfinite(controls) | (one_way & (controls < 0.0))
    x = np.where(one_way, 2.0 * controls - 1.0, controls)
    for i in range(n):
        kind, k = outputs[i]
        if int(get(f"{kind}_REV", 0.0)) >> (k - 1) & 1:
            log.reversed.add(i)
            x[:, i] *= -1.0
    low, high = np.array([sorted(ends[i]) for i in range(n)]).T
    return np.where(off, 0.0, low + 0.5 * (x + 1.0) * (high - low))
