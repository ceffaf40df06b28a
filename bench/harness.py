"""What all studies share: bars, rows and tables, and runs that can be interrupted and resumed."""

import dataclasses
import hashlib
import json
import math
import multiprocessing
import platform
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, TypeVar

Line = dict[str, Any]
"""What was measured in one trial, as JSON keeps it."""

Trial = TypeVar("Trial")  # a frozen dataclass whose fields JSON can hold


# ------------------------------------------------------------------ bars, rows and tables


class Bars:
    """The bars of a study, and which of them were missed."""

    def __init__(self) -> None:
        self.missed: list[str] = []

    def check(self, met: bool, text: str, what: str) -> str:
        """The cell of a table with this text, bold where the bar is missed."""
        if not met:
            self.missed.append(f"{what}: {text}")
        return text if met else f"**{text}**"

    def status(self) -> int:
        """Print what was missed; the exit status of the study."""
        print(f"\n{len(self.missed)} bars missed" + "".join(f"\n- {m}" for m in self.missed))
        return 1 if self.missed else 0


@dataclass(frozen=True)
class Row:
    """One measured value and its bar: the largest it may be or, ``above``, the smallest.

    ``ours`` and ``peer`` say in words what was compared, where the value is a ratio.
    """

    what: str
    estimator: str
    value: float
    unit: str
    bar: float
    above: bool = False
    ours: str = ""
    peer: str = ""

    @property
    def met(self) -> bool:
        return self.value >= self.bar if self.above else self.value <= self.bar


def show(rows: Iterable[Row], bars: Bars) -> list[Row]:
    """Name each row on standard error as it is measured; then print the table of all."""
    cells, measured = [], []
    for row in rows:
        value = f"{row.value:.3g} {row.unit}".strip()
        print(f"{row.what}: {row.estimator} {value}", file=sys.stderr)
        text = bars.check(row.met, value, f"{row.what} {row.estimator}".strip())
        sign = ">=" if row.above else "<="
        cells.append([row.what, row.estimator, row.ours, row.peer, text, f"{sign} {row.bar:g}"])
        measured.append(row)
    head = ["what", "estimator", "ours", "against", "value", "bar"]
    used = [k for k in range(len(head)) if any(row[k] for row in cells)]
    table([head[k] for k in used], [[row[k] for k in used] for row in cells])
    return measured


def table(head: str | Sequence[str], rows: Iterable[Sequence[object]], title: str = "") -> None:
    """Print a table in Markdown. ``head``: the names of the columns, or one text with " | "."""
    names = head.split(" | ") if isinstance(head, str) else head
    if title:
        print(f"\n### {title}")
    print(f"\n| {' | '.join(names)} |\n|{' --- |' * len(names)}")
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |", flush=True)


def announce() -> None:
    """Print what makes the tables below: the command, the date and the processor."""
    spec = sys.modules["__main__"].__spec__
    program = f"python -m {spec.name}" if spec else Path(sys.argv[0]).name
    print(f"`{' '.join([program, *sys.argv[1:]])}`, {date.today()}, {_processor()}", flush=True)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


# ------------------------------------------------------------------ runs that can be resumed


def digest(*sources: bytes) -> str:
    """Of these sources and all loaded modules of the package: what the lines of a run depend on."""
    here = hashlib.sha256()
    for source in sources:
        here.update(source)
    for name in sorted(sys.modules):
        if name.split(".")[0] == "rov_ident" and sys.modules[name].__file__:
            here.update(Path(sys.modules[name].__file__ or "").read_bytes())
    return here.hexdigest()[:12]


def key(trial: Any) -> str:
    """By which the line of a trial is known."""
    return json.dumps(dataclasses.asdict(trial), sort_keys=True)


def recorded(path: Path) -> dict[str, Line]:
    """The last line of each trial in a file, by :func:`key`."""
    found: dict[str, Line] = {}
    if path.exists():
        for text in path.read_text().splitlines():
            try:
                line = json.loads(text)
            except json.JSONDecodeError:  # interrupted while it was written
                continue
            found[json.dumps(line["trial"], sort_keys=True)] = line
    return found


def lines_of(
    trials: Sequence[Trial],
    measure: Callable[[Trial], Line],
    file_of: Callable[[Trial], Path],
    source: str,
    *,
    jobs: int = 1,
    minutes: float = math.inf,
    keep: bool = False,
) -> list[Line]:
    """The lines of the trials: from their files where they are there, else measured and added.

    A line of another ``source`` is measured anew unless ``keep``. No trial is begun after so many
    ``minutes``; those that were not measured have no line. Each line is written as soon as it is
    measured, so that a run that is interrupted goes on where it was.
    """
    done: dict[str, Line] = {}
    for path in dict.fromkeys(map(file_of, trials)):
        path.parent.mkdir(parents=True, exist_ok=True)
        done |= recorded(path)
    if not keep:
        done = {k: line for k, line in done.items() if line["source"] == source}
    missing = [trial for trial in trials if key(trial) not in done]
    waiting, begin, count = iter(missing), time.monotonic(), 0

    def following() -> Trial | None:
        in_time = time.monotonic() - begin < 60.0 * minutes
        return next(waiting, None) if in_time else None

    def take(trial: Trial, measured: Line) -> None:
        nonlocal count
        line = {"trial": dataclasses.asdict(trial), "source": source, **measured}  # type: ignore[call-overload]
        text = json.dumps(line)
        with file_of(trial).open("a") as file:
            file.write(text + "\n")
        done[key(trial)] = json.loads(text)
        count += 1
        left = (time.monotonic() - begin) / count * (len(missing) - count) / 60.0
        progress = f"\r{count} of {len(missing)} trials, {left:.0f} min left\033[K"
        print(progress, end="", file=sys.stderr, flush=True)

    first = following()
    if first is not None:  # alone, so that kernels are compiled once and not by each process
        take(first, measure(first))
    running: dict[Future[Line], Trial] = {}
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("fork")) as pool:
        while True:
            while len(running) < jobs and (trial := following()) is not None:
                running[pool.submit(measure, trial)] = trial
            if not running:
                break
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                take(running.pop(future), future.result())
    if missing:
        print(file=sys.stderr)
    return [done[key(trial)] for trial in trials if key(trial) in done]
