"""Reports to and from ROS messages."""

import array
import math

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from rov_ident.messages import Array
from rov_ident.online import Level, Report

_SECOND = 1_000_000_000  # ns


def to_time(stamp: int) -> Time:
    """A stamp in ns, not negative."""
    sec, nanosec = divmod(stamp, _SECOND)
    return Time(sec=sec, nanosec=nanosec)


def from_time(time: Time) -> int:
    return int(time.sec) * _SECOND + int(time.nanosec)


def to_status(
    name: str, hardware_id: str, level: Level, message: str, values: dict[str, str]
) -> DiagnosticStatus:
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticStatus(
        level=bytes([level]), name=name, hardware_id=hardware_id, message=message, values=pairs
    )


def to_diagnostics(report: Report, hardware_id: str) -> DiagnosticArray:
    """`~/coefficients`; numbers as text that reads back to the last bit."""
    array_ = DiagnosticArray()
    array_.header.stamp = to_time(report.stamp)
    columns = (report.values, report.std, report.lower, report.upper, report.excitation)
    rows = np.stack(columns, axis=1).tolist()
    for i, (value, std, lower, upper, excitation) in enumerate(rows):
        values = {
            "value": repr(value),
            "std": repr(std),
            "unit": report.units[i],
            "lower": repr(lower),
            "upper": repr(upper),
            "excitation": repr(excitation),
        }
        status = to_status(
            report.names[i], hardware_id, report.levels[i], report.messages[i], values
        )
        array_.status.append(status)
    return array_


def from_diagnostics(message: DiagnosticArray) -> Report:
    """The report in a message of `~/coefficients`.

    Its covariance has the variances alone: the correlations are on `~/coefficients/covariance`.

    Raises
    ------
    ValueError
        If a key is missing, or a number is not one or not finite.
    """
    statuses = message.status
    fields = [{pair.key: pair.value for pair in status.values} for status in statuses]
    try:
        units = tuple(field["unit"] for field in fields)
        value, std, lower, upper = (
            np.array([float(field[key]) for field in fields])
            for key in ("value", "std", "lower", "upper")
        )
    except KeyError as error:
        raise ValueError(f"a coefficient comes without {error}") from error
    if not np.isfinite([value, std, lower, upper]).all():
        raise ValueError("a coefficient is not finite")
    return Report(
        stamp=from_time(message.header.stamp),
        names=tuple(status.name for status in statuses),
        units=units,
        values=value,
        std=std,
        lower=lower,
        upper=upper,
        covariance=np.diag(std**2),
        excitation=np.array([float(field.get("excitation", math.nan)) for field in fields]),
        levels=tuple(Level(status.level[0]) for status in statuses),
        messages=tuple(status.message for status in statuses),
    )


def to_matrix(names: tuple[str, ...], columns: str, matrix: Array) -> Float64MultiArray:
    """A matrix (n, k) with the names of its rows and columns as labels, separated by blanks."""
    rows, width = matrix.shape
    message = Float64MultiArray()
    message.layout.dim = [
        MultiArrayDimension(label=" ".join(names), size=rows, stride=matrix.size),
        MultiArrayDimension(label=columns, size=width, stride=width),
    ]
    message.data = array.array("d", matrix.tobytes())
    return message
