"""PX4's logs (`.ulg`): what they say of motion and thrust, as of any autopilot.

Velocity and position are EKF2's (`vehicle_local_position`, NED), the attitude its quaternion, rates
and specific force those of `sensor_combined`. The thrust is the allocator's demand on each motor
(`actuator_motors`, -1 to 1), the battery `battery_status`, the geometry `CA_ROTORn_*`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array
from rov_ident.io.ardupilot_log import Log
from rov_ident.model.thruster_allocation import NORMALIZED

_TOPICS = (
    "vehicle_local_position", "vehicle_attitude", "sensor_combined", "actuator_motors",
    "battery_status", "vehicle_status",
)  # fmt: skip
_ARMED = 2  # of vehicle_status.arming_state


def read_ulog(path: Path) -> Log:
    """What a ULog says.

    Raises UserError: it cannot be read, is no ULog, or pyulog is not installed.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise UserError(f"{path} needs pyulog: pip install 'rov_ident[px4]'") from error
    log = Log()
    try:
        ulog = ULog(str(path), list(_TOPICS))
        topics = {d.name: d.data for d in ulog.data_list if d.multi_id == 0}
        log.parameters = {name: float(value) for name, value in ulog.initial_parameters.items()}
        _fill(log, topics)
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): check the path") from error
    except Exception as error:  # pyulog raises whatever the bytes make it
        raise UserError(f"{path} is no log of PX4, or a damaged one: {error}") from error
    return log


def _fill(log: Log, topics: dict[str, Any]) -> None:
    def rows(topic: str, names: list[str], usable: str = "") -> Array:
        """(k, 1 + n): the time [us] and these fields, where they are finite and ``usable``."""
        data = topics.get(topic)
        if data is None:
            return np.empty((0, 1 + len(names)))
        table = np.column_stack([data["timestamp"], *(data[name] for name in names)]).astype(float)
        good = np.isfinite(table).all(axis=1)
        return table[good & (data[usable] > 0) if usable else good]

    log.signal = NORMALIZED
    place = "vehicle_local_position"
    names = ["vx", "vy", "vz", "x", "y", "z"]
    for t, *row in rows(place, names, usable="v_xy_valid").tolist():
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
        n = int(log.parameters.get("CA_ROTOR_COUNT", 12))
        controls = np.column_stack([motors[f"control[{i}]"] for i in range(n)])
        # PX4 says NaN of a motor that is off.
        for t, row in zip(motors["timestamp"].tolist(), np.nan_to_num(controls).tolist()):
            log.outputs.add(int(t), *row)
