"""`rov-ident watch`: what the running estimators say, as a table or as lines of JSON."""

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rov_ident.dashboard.store import GONE, Estimator, Store, plain
from rov_ident.errors import UserError
from rov_ident.nodes.common import Executor
from rov_ident.nodes.watch_node import WatchNode
from rov_ident.online import Level

Heard = Mapping[str, tuple[Estimator, float]]
"""By the full name of a node: what it said, and how long ago it did [s]."""

_REFRESH = 4.0  # Hz
_SETTLING = 3.5  # s; without news: who was missed at first announces itself every 3 s
_COLOURS = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "bold red", Level.STALE: "dim"}
_WORDS = {Level.OK: "ok", Level.WARN: "warn", Level.ERROR: "error", Level.STALE: "stale"}


def watch(as_json: bool, out: Console, err: Console) -> None:
    """Until interrupted: a live table on ``err``, which stays there, or JSON lines on ``out``."""
    with _hearing() as (store, spin, ended), ExitStack() as stack:
        live = None
        if not as_json:
            live = Live(console=err, auto_refresh=False, vertical_overflow="crop")
            stack.enter_context(live)
            live.update(_picture({}, out), refresh=True)
        shown: dict[str, int] = {}  # by estimator, the identity of the last report
        while not ended.is_set():
            spin(1.0 / _REFRESH)
            heard = store.reports
            if live is not None:
                live.update(_picture(heard, err), refresh=True)
                continue
            for name, (known, silent) in heard.items():
                if shown.get(name) != id(known.report):
                    shown[name] = id(known.report)
                    _print_json({name: (known, silent)}, out)


def watch_once(patience: float, as_json: bool, out: Console) -> None:
    """What all estimators say now: one table, or one line of JSON.

    Raises
    ------
    UserError
        If none is heard within ``patience`` [s].
    """
    with _hearing() as (store, spin, ended):
        end, known, since = time.monotonic() + patience, store.known, time.monotonic()
        while time.monotonic() < end and not ended.is_set():
            spin(0.1)
            before, known = known, store.known
            if known != before:
                since = time.monotonic()
            elif known and all(known.values()) and time.monotonic() - since > _SETTLING:
                break
        heard = store.reports
        if not heard and not ended.is_set():
            raise UserError(
                f"no estimator was heard within {patience:g} s: start rls_node or ukf_node, and "
                "use its ROS_DOMAIN_ID here"
            )
    if heard and as_json:
        _print_json(heard, out)
    elif heard:
        out.print(_picture(heard, out))


@contextmanager
def _hearing() -> Iterator[tuple[Store, Callable[[float], None], threading.Event]]:
    """The store, how to hear for some seconds, and whether we were interrupted."""
    ended = threading.Event()
    before = {
        number: signal.signal(number, lambda *_: ended.set())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    store = Store(time.monotonic)
    node = WatchNode(store, context=context)
    executor = Executor(context=context)
    executor.add_node(node)

    def spin(seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0 and not ended.is_set():
            executor.spin_once(timeout_sec=min(left, 0.1))

    try:
        yield store, spin, ended
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)
        for number, handler in before.items():
            signal.signal(number, handler)


# ------------------------------------------------------------------ as JSON


def _print_json(heard: Heard, out: Console) -> None:
    for_scripts = {name: _as_json(*entry) for name, entry in heard.items()}
    line = json.dumps({"estimators": for_scripts}, allow_nan=False)
    out.out(line, highlight=False)


def _as_json(known: Estimator, silent: float) -> dict[str, Any]:
    report = known.report
    assert report is not None
    columns = (report.values, report.std, report.lower, report.upper, report.excitation)
    coefficients = {}
    for i, name in enumerate(report.names):
        numbers = [float(column[i]) for column in columns]
        coefficients[name] = {
            **dict(zip(("value", "std", "lower", "upper"), numbers)),
            "excitation": numbers[4] if math.isfinite(numbers[4]) else None,
            "unit": report.units[i],
            "level": report.levels[i].name,
            "message": report.messages[i],
        }
    return {
        "vehicle": known.vehicle,
        "stamp_ns": report.stamp,
        "silent_s": plain(silent),
        "coefficients": coefficients,
        "health": {kind: vars(status) for kind, status in known.statuses.items()},
    }


# ------------------------------------------------------------------ as a table


def _picture(heard: Heard, console: Console) -> Group | Text:
    """One table a vehicle, its estimators side by side; above each what they say of themselves."""
    if not heard:
        return Text("waiting for rls_node or ukf_node (Ctrl-C ends)", style="dim")
    vehicles: dict[str, list[str]] = {}
    for name in heard:
        vehicles.setdefault(name.rpartition("/")[0] or "/", []).append(name)
    parts: list[Text | Table] = []
    for namespace, names in vehicles.items():
        parts += [_health(name, *heard[name]) for name in names]
        parts.append(_table(namespace, {name: heard[name][0] for name in names}, console.width))
    return Group(*parts)


def _health(name: str, known: Estimator, silent: float) -> Text:
    text = Text(f"{name} ({known.vehicle}): ")
    if silent > GONE:
        return text.append(f"silent for {silent:.0f} s", style="bold red")
    for kind, status in known.statuses.items():
        if kind != "model" or status.level:
            level = Level(min(status.level, Level.STALE))
            text.append(f"{kind}: {status.message}. ", style=_COLOURS[level])
    return text


def _table(namespace: str, estimators: Mapping[str, Estimator], width: int) -> Table:
    wide = width >= 60 + 30 * len(estimators)
    table = Table(
        title=namespace.rstrip("/") or None,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    table.add_column("")
    names: dict[str, str] = {}  # name and unit of coefficients
    for node, known in estimators.items():
        short = node.rpartition("/")[2].removesuffix("_node")
        table.add_column(short, justify="right")
        table.add_column("std", justify="right")
        table.add_column("level")
        if wide:
            table.add_column("excited", justify="right")
        assert known.report is not None
        names.update(zip(known.report.names, known.report.units))
    table.add_column("unit")
    for name, unit in names.items():
        cells: list[Text | str] = []
        for known in estimators.values():
            cells += _cells(known, name, wide)
        table.add_row(name, *cells, unit)
    return table


def _cells(known: Estimator, name: str, wide: bool) -> list[Text | str]:
    report = known.report
    if report is None or name not in report.names:
        return [""] * (3 + wide)
    i = report.names.index(name)
    level = report.levels[i]
    colour = _COLOURS[level]
    cells: list[Text | str] = [
        Text(f"{report.values[i]:.5g}", style=colour),
        Text(f"{report.std[i]:.2g}", style=colour),
        Text(_WORDS[level], style=colour),
    ]
    if wide:
        excitation = float(report.excitation[i])
        cells.append(f"{100 * excitation:.0f} %" if math.isfinite(excitation) else "")
    return cells
