"""`rov-ident watch`: what the running estimators publish, as a table or as lines of JSON."""

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import chain
from typing import Any, Literal

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rov_ident.core.errors import UserError
from rov_ident.core.interrupts import Interrupted, noted_interrupts
from rov_ident.core.states import Level
from rov_ident.dashboard.store import GONE, Estimator, Store, plain
from rov_ident.estimation.online import Report
from rov_ident.nodes.conversions import entries, for_json
from rov_ident.nodes.watch_node import watching
from rov_ident.reports.table import fitting

Heard = Mapping[str, tuple[Estimator, float]]
"""By the full name of a node: what it published, and how long ago [s]."""

_REFRESH = 4.0  # Hz; nodes publish at 5 Hz
_SETTLING = 3.5  # s; without a new one: DDS repeats announcements every 3 s
_LAYOUTS = ((True, True), (False, True), (False, False))
"""Whether there are columns of excitation and of units: what is dropped where there is no room."""
_COLOURS = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "bold red", Level.STALE: "dim"}


def watch(as_json: bool, out: Console, err: Console) -> None:
    """Until interrupted: a live table on ``err``, which stays there, or JSON lines on ``out``."""
    with _listening() as (store, spin, interrupts), ExitStack() as stack:
        live = None
        if not as_json:
            live = Live(console=err, auto_refresh=False, vertical_overflow="crop")
            stack.enter_context(live)
            live.update(_picture({}, out), refresh=True)
        new: list[Estimator] = []  # not printed as it comes: a node outlives a closed pipe
        store.follow = new.append if as_json else store.follow
        while not interrupts:
            spin(1.0 / _REFRESH)
            if live is not None:
                live.update(_picture(store.reports, err), refresh=True)
            for known in new:
                _print_json({known.name: (known, 0.0)}, out)
            new.clear()


def watch_once(patience: float, as_json: bool, out: Console) -> None:
    """Print what all estimators publish now: one table, or one line of JSON.

    Raises UserError if none is heard within ``patience`` [s].
    """
    with _listening() as (store, spin, interrupts):
        end, known, since = time.monotonic() + patience, store.known, time.monotonic()
        while time.monotonic() < end and not interrupts:
            spin(0.1)
            before, known = known, store.known
            if known != before:
                since = time.monotonic()
            elif known and all(known.values()) and time.monotonic() - since > _SETTLING:
                break
        heard = store.reports
        if not heard and interrupts:  # a script must not take it for an answer
            raise Interrupted(interrupts[0])
        if not heard:
            raise UserError(
                f"no estimator was heard within {patience:g} s: start rls_node or ukf_node, and "
                "use its ROS_DOMAIN_ID here"
            )
    if as_json:
        _print_json(heard, out)
    else:
        out.print(_picture(heard, out))


@contextmanager
def _listening() -> Iterator[tuple[Store, Callable[[float], None], list[int]]]:
    """The store, a function that listens for some seconds, and the interrupts there were."""
    store = Store(time.monotonic)
    with noted_interrupts() as interrupts, watching(store, "rov_ident_watch") as (_, executor):

        def spin(seconds: float) -> None:
            end = time.monotonic() + seconds
            while (left := end - time.monotonic()) > 0.0 and not interrupts:
                executor.spin_once(timeout_sec=min(left, 0.1))

        yield store, spin, interrupts


def _print_json(heard: Heard, out: Console) -> None:
    for_scripts = {name: _as_json(*entry) for name, entry in heard.items()}
    line = json.dumps({"estimators": for_scripts}, allow_nan=False)
    out.out(line, highlight=False)


def _as_json(known: Estimator, silent: float) -> dict[str, Any]:
    report = known.report
    assert report is not None
    return {
        "vehicle": known.vehicle,
        "stamp_ns": report.stamp,
        "silent_s": plain(silent),
        "coefficients": for_json(report),
        "health": {kind: vars(status) for kind, status in known.statuses.items()},
    }


def _picture(heard: Heard, console: Console) -> Group | Text:
    """One table for each vehicle, its estimators side by side, their diagnostics above it."""
    if not heard:
        return Text("waiting for rls_node or ukf_node (Ctrl-C ends)", style="dim")
    vehicles: dict[str, list[str]] = {}
    for name in heard:
        vehicles.setdefault(name.rpartition("/")[0] or "/", []).append(name)
    parts: list[Text | Table] = []
    for namespace, names in vehicles.items():
        parts += [_health(name, *heard[name]) for name in names]
        estimators = {name: heard[name][0] for name in names}
        layouts = (_table(namespace, estimators, *more) for more in _LAYOUTS)
        parts.append(fitting(layouts, console, console.width))
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


def _table(namespace: str, estimators: Mapping[str, Estimator], excited: bool, unit: bool) -> Table:
    title = namespace.rstrip("/") or None
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("", overflow="fold")
    units: dict[str, str] = {}
    columns = []
    for node, known in estimators.items():
        assert known.report is not None
        units.update(zip(known.report.names, known.report.units))
        columns.append(_cells(known.report))
        short = node.rpartition("/")[2].removesuffix("_node")
        for head in (short, "std", "state", "excited")[: 3 + excited]:
            justify: Literal["left", "right"] = "left" if head == "state" else "right"
            table.add_column(head, justify=justify, overflow="fold")
    if unit:
        table.add_column("unit", overflow="fold")
    for name, of in units.items():
        rows = (cells.get(name, [Text()] * 4)[: 3 + excited] for cells in columns)
        table.add_row(name, *chain.from_iterable(rows), *([of] if unit else []))
    return table


def _cells(report: Report) -> dict[str, list[Text]]:
    """Value, standard deviation, state and excitation of every coefficient."""
    cells = {}
    for name, entry, state in zip(report.names, entries(report).values(), report.states):
        colour, excitation = _COLOURS[state.level], entry["excitation"]
        texts = (f"{entry['value']:.5g}", f"{entry['std']:.2g}", state.value)
        cells[name] = [Text(text, style=colour) for text in texts]
        cells[name].append(Text(f"{100 * excitation:.0f} %" if math.isfinite(excitation) else ""))
    return cells
