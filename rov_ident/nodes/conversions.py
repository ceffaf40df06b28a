"""Reports to and from ROS messages."""

import array
import contextlib
import math
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from rov_ident.core.messages import SECOND, Array
from rov_ident.core.states import Level, State
from rov_ident.estimation.online import Report


def to_time(stamp: int) -> Time:
    """A stamp in ns, not negative."""
    sec, nanosec = divmod(stamp, SECOND)
    return Time(sec=sec, nanosec=nanosec)


def from_time(time: Time) -> int:
    return int(time.sec) * SECOND + int(time.nanosec)


def to_status(
    name: str, hardware_id: str, level: Level, message: str, values: dict[str, str]
) -> DiagnosticStatus:
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticStatus(
        level=bytes([level]), name=name, hardware_id=hardware_id, message=message, values=pairs
    )


def to_diagnostics(report: Report, hardware_id: str) -> DiagnosticArray:
    """`~/coefficients`; numbers as text that reads back to the last bit."""
    message = DiagnosticArray()
    message.header.stamp = to_time(report.stamp)
    for (name, entry), level in zip(entries(report).items(), report.levels):
        words = entry.pop("message")
        texts = {k: v if isinstance(v, str) else repr(v) for k, v in entry.items()}
        message.status.append(to_status(name, hardware_id, level, words, texts))
    return message


def entries(report: Report) -> dict[str, dict[str, Any]]:
    """Every coefficient with its numbers, unit, state and message."""
    states = [state.value for state in report.states]
    values, std, lower, upper, excitation = np.stack(
        [report.values, report.std, report.lower, report.upper, report.excitation]
    ).tolist()
    rows = zip(values, std, report.units, lower, upper, excitation, states, report.messages)
    keys = ("value", "std", "unit", "lower", "upper", "excitation", "state", "message")
    return {name: dict(zip(keys, row)) for name, row in zip(report.names, rows)}


def for_json(report: Report) -> dict[str, dict[str, Any]]:
    """As :func:`entries`, with the levels, and None for an excitation that is not known."""
    found = entries(report)
    for entry, level in zip(found.values(), report.levels):
        entry["level"] = level.name
        if not math.isfinite(entry["excitation"]):
            entry["excitation"] = None
    return found


def from_diagnostics(message: DiagnosticArray) -> Report:
    """The report in a message of `~/coefficients`.

    Its covariance has the variances alone: the correlations are on `~/coefficients/covariance`.

    Raises ValueError if a key is missing, or a number is not one or not finite.
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
        states=tuple(map(_state, statuses, fields)),
        messages=tuple(status.message for status in statuses),
    )


def _state(status: DiagnosticStatus, fields: dict[str, str]) -> State:
    """As it is given, unless it is missing or contradicts the level."""
    likely = State.at(Level(status.level[0]))
    with contextlib.suppress(ValueError):
        given = State(fields.get("state"))
        return given if given.level == likely.level else likely
    return likely


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
