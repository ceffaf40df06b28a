"""What every estimator has published, and which part of it a page has not seen yet.

A store is filled by one thread and read by others.
"""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np

from rov_ident.core.messages import Array
from rov_ident.core.states import State
from rov_ident.estimation.online import Report

POINTS = 600  # of a coefficient's history: more than a picture has pixels
BIN = 0.5  # s of residuals drawn as one: a pixel or two
BINS = 240  # two minutes
DIGITS = 6  # significant; a picture shows three
MOST = 64  # nodes shown: six times those of five vehicles; anybody on the network may invent more
LONGEST = 1000  # characters of a text, and entries of a status: ours have a tenth
KINDS = ("inputs", "estimation", "model", "checkpoint")  # of an estimator's statuses
GONE = 3.0  # s without a report, after which what it said is stale: three of its /diagnostics

Mark = tuple[int, int]  # what a reader has of a series: (epoch, rows)


class Series:
    """Rows in the order of time, at most ``size``: older ones thin out, or go if ``sliding``.

    Where rows that a reader has are no longer those of the series, its epoch is another.
    """

    def __init__(self, size: int, sliding: bool = False) -> None:
        self._size, self._sliding = size, sliding
        self._rows: list[Any] = []
        self._gone = 0
        self._epoch = 0
        self._spacing = 0.0  # s; of what is kept

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def last(self) -> Any:
        return self._rows[-1] if self._rows else None

    def append(self, t: float, *values: Any) -> None:
        """One more row ``(t, *values)``; not taken if it is closer to the last one than is kept."""
        if self._rows and t < self._rows[-1][0]:
            self.clear()  # a bag that loops, a simulation that was reset
        if self._rows and t - self._rows[-1][0] < self._spacing:
            return
        self._rows.append((t, *values))
        if len(self._rows) <= self._size:
            return
        if self._sliding:
            del self._rows[0]
            self._gone += 1
        else:
            self._spacing = (self._rows[-1][0] - self._rows[0][0]) / (self._size / 2)
            del self._rows[1::2]
            self._epoch += 1

    def clear(self) -> None:
        self._rows.clear()
        self._gone, self._spacing = 0, 0.0
        self._epoch += 1

    def since(self, mark: Mark | None) -> tuple[bool, list[Any], Mark]:
        """Whether to start again, the new rows, and the mark for the next call."""
        now = (self._epoch, self._gone + len(self._rows))
        if mark is None or mark[0] != self._epoch:
            return True, list(self._rows), now
        return False, self._rows[max(0, mark[1] - self._gone) :], now


@dataclass(frozen=True)
class Status:
    """One status of `/diagnostics`. ``level`` as in diagnostic_msgs/DiagnosticStatus."""

    level: int
    message: str
    values: Mapping[str, str]


@dataclass
class Estimator:
    """What one estimator node has published. ``heard`` is a time on the store's clock, in s."""

    name: str
    vehicle: str = ""
    report: Report | None = None
    names: tuple[str, ...] = ()
    correlation: Array | None = None
    statuses: dict[str, Status] = field(default_factory=dict)
    heard: float = -math.inf
    history: Series = field(default_factory=lambda: Series(POINTS))
    residuals: Series = field(default_factory=lambda: Series(BINS, sliding=True))
    bin: list[Array] = field(default_factory=list)
    bin_start: float = math.nan  # s

    def at(self, now: float) -> "Estimator":
        """What is to be shown of it at a time in s: an estimator that has gone is stale."""
        if self.report is None or now - self.heard <= GONE:
            return self
        words = tuple(f"stale: the node is silent (before: {m})" for m in self.report.messages)
        states = (State.STALE,) * len(words)
        return replace(self, report=replace(self.report, states=states, messages=words))


class Store:
    """All estimators by the full names of their nodes; ``now`` is a steady clock in s."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._estimators: dict[str, Estimator] = {}
        self._bridges: dict[str, Status] = {}  # what is sent to controllers
        self.follow: Callable[[Estimator], None] = lambda known: None  # called for each report

    def add(self, name: str) -> None:
        """An estimator exists, even if it has not published yet."""
        with self._lock:
            self._estimator(name)

    def _estimator(self, name: str) -> Estimator:
        """The one of that name; beyond :data:`MOST`, one that is not shown."""
        new = Estimator(name)
        known = self._estimators.get(name, new)
        if len(self._estimators) < MOST:
            self._estimators[name] = known
        return known

    def take_report(self, name: str, vehicle: str, report: Report) -> None:
        with self._lock:
            known = self._estimator(name)
            if report.names != known.names:
                known.names, known.correlation = report.names, None
                known.history.clear()
            known.vehicle, known.report, known.heard = vehicle, report, self._now()
            # A node without messages repeats its report with the same stamp.
            t = report.stamp * 1e-9
            last = known.history.last
            if report.stamp and (last is None or last[0] != t):
                known.history.append(t, report.values, report.std)
            now = replace(known)
        self.follow(now)

    def take_covariance(self, name: str, matrix: Array) -> None:
        """(n, n), in the order of the coefficients."""
        with np.errstate(all="ignore"):  # anybody may publish 1e-320 beside 1e300
            std = np.sqrt(np.diag(matrix))
            correlation = matrix / std / std[:, None]
        with self._lock:
            known = self._estimator(name)
            # None is larger than one, but for rounding; NaN is refused, too.
            if len(std) == len(known.names) and (np.abs(correlation) < 1.0 + 1e-6).all():
                known.correlation = correlation

    def take_residual(self, name: str, stamp: int, residual: Array) -> None:
        """(6,), at a time in ns; drawn in bins, each with its extremes and its mean square."""
        t = stamp * 1e-9
        if not np.isfinite(residual).all():
            return
        with self._lock:
            known = self._estimator(name)
            if not 0.0 <= t - known.bin_start < BIN:
                if known.bin:
                    rows = np.stack(known.bin)
                    with np.errstate(over="ignore"):
                        rms = np.sqrt(np.mean(rows**2, axis=0))
                    known.residuals.append(known.bin_start, rows.min(0), rows.max(0), rms)
                known.bin, known.bin_start = [], t
            known.bin.append(residual)

    def take_status(self, name: str, kind: str, status: Status) -> None:
        """One of :data:`KINDS` of a node that is known already; `bridge` of any."""
        values = {k[:LONGEST]: v[:LONGEST] for k, v in islice(status.values.items(), LONGEST)}
        status = Status(status.level, status.message[:LONGEST], values)
        with self._lock:
            if kind == "bridge":
                self._bridges.pop(name, None)
                self._bridges[name] = status
                if len(self._bridges) > MOST:
                    del self._bridges[next(iter(self._bridges))]  # the one silent for longest
            elif kind in KINDS and name in self._estimators:
                self._estimators[name].statuses[kind] = status

    @property
    def known(self) -> dict[str, int]:
        """For every estimator, how many kinds of messages were received."""
        with self._lock:
            return {
                name: len(known.statuses) + (known.report is not None)
                for name, known in self._estimators.items()
            }

    @property
    def reports(self) -> dict[str, tuple[Estimator, float]]:
        """Every estimator that has published, and the seconds since its last report."""
        with self._lock:
            now = self._now()
            return {
                name: (known.at(now), now - known.heard)
                for name, known in sorted(self._estimators.items())
                if known.report is not None
            }

    def changes(self, marks: Mapping[str, Sequence[Mark]] | None = None) -> tuple[Any, Any]:
        """The present state, with what is new since ``marks``; and the marks for the next call.

        The state is plain data for JSON: no number that is not finite.
        """
        marks = marks or {}
        with self._lock:
            now = self._now()
            shown, after = {}, {}
            for name, known in sorted(self._estimators.items()):
                seen = marks.get(name, (None, None))
                anew, history, first = known.history.since(seen[0])
                anew_residuals, residuals, second = known.residuals.since(seen[1])
                after[name] = (first, second)
                shown[name] = {
                    "vehicle": known.vehicle,
                    "silent": plain(now - known.heard),
                    "gone": now - known.heard > GONE,
                    "history": {"anew": anew, "rows": plain(history)},
                    "residuals": {"anew": anew_residuals, "rows": plain(residuals)},
                    "correlation": None
                    if known.correlation is None
                    else np.round(known.correlation, 2).tolist(),
                    "statuses": {kind: vars(s) for kind, s in known.statuses.items()},
                    **_described(known.at(now).report),
                }
            bridges = {name: vars(status) for name, status in sorted(self._bridges.items())}
        return {"estimators": shown, "bridges": bridges}, after


def _described(report: Report | None) -> dict[str, Any]:
    if report is None:
        return {"names": []}
    return {
        "stamp": report.stamp * 1e-9,
        "names": list(report.names),
        "units": list(report.units),
        "states": [state.value for state in report.states],
        "levels": [int(level) for level in report.levels],
        "messages": list(report.messages),
        **{
            key: plain(getattr(report, key))
            for key in ("values", "std", "lower", "upper", "excitation")
        },
    }


def plain(data: Any) -> Any:
    """Arrays and tuples as lists, numbers in some digits, None for those that are not finite."""
    if isinstance(data, np.ndarray):
        return plain(data.tolist())
    if isinstance(data, list | tuple):
        return [plain(item) for item in data]
    if isinstance(data, float):
        if not math.isfinite(data):
            return None
        # Times are large: milliseconds of them count.
        return round(data, 3) if abs(data) >= 1e6 else float(f"{data:.{DIGITS}g}")
    return data
