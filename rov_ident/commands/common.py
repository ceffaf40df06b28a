"""What the commands share: consoles, kinds of arguments, progress, tables, files."""

import argparse
import contextlib
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias, TypeVar

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from rov_ident import config as configuration
from rov_ident.coefficients import MOTIONS
from rov_ident.errors import UserError

if TYPE_CHECKING:
    from rov_ident.records import Record
    from rov_ident.result import Result

ERR = Console(stderr=True, highlight=False)
OUT = Console(highlight=False, soft_wrap=True)

LIVE = ("rls", "ukf")
LARGEST = 1e5  # of any number on the command line: a day of simulation, 100 kHz
PAIRS = {"lateral": ("sway", "yaw"), "longitudinal": ("heave", "pitch")}
CONFIG = "the vehicle's parameter file"
BAG = "an .mcap file or a rosbag2 directory"

T = TypeVar("T")
Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def json_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", type=Path, help="write the result here")


def bag_and_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bag", type=Path, metavar="BAG", help=BAG)
    parser.add_argument("--config", required=True, type=Path, help=CONFIG)


def number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def rate(text: str) -> float:
    value = number(text)
    if not 0.0 <= value <= LARGEST:
        raise argparse.ArgumentTypeError(f"{text} must be from 0 to {LARGEST:g}")
    return value


def share(text: str) -> float:
    value = number(text)
    if not 0.0 <= value < 1.0:
        raise argparse.ArgumentTypeError(f"{text} must be from 0 to below 1")
    return value


def seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0")
    return int(text)


def port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, from 0 to 65535")
    return int(text)


def box(text: str) -> tuple[float, ...]:
    sides = tuple(positive(part) for part in text.split(","))
    if len(sides) != 3:
        raise argparse.ArgumentTypeError(f"{text!r} must be three lengths: 6,6,2")
    return sides


def count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 1024:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to 1024")
    return int(text)


def channels(text: str) -> "np.ndarray":
    names = [axis for name in text.split(",") for axis in PAIRS.get(name, (name,))]
    if unknown := set(names) - set(MOTIONS):
        known = ",".join((*MOTIONS, *PAIRS))
        raise argparse.ArgumentTypeError(f"no channel {min(unknown)!r}: use {known}")
    return np.array([name in names for name in MOTIONS])


def positive(text: str) -> float:
    value = number(text)
    if not 0.0 < value <= LARGEST:
        raise argparse.ArgumentTypeError(f"{text} must be above 0, up to {LARGEST:g}")
    return value


class Tell(Protocol):
    """Says what is being done, and the share of it that is."""

    def __call__(self, what: str, share: float | None = None) -> None: ...


@contextlib.contextmanager
def progress(options: argparse.Namespace) -> Iterator[Tell]:
    """A line and a bar on standard error; nothing with --quiet, or where nobody looks."""
    shown = ERR.is_terminal and not options.quiet
    with Progress(console=ERR, transient=True, disable=not shown) as progress:
        bar = progress.add_task("", total=None)

        def tell(what: str, share: float | None = None) -> None:
            total = None if share is None else 1.0
            # At once: what is done quickly should be seen, too.
            progress.update(
                bar, description=what, completed=share or 0.0, total=total, refresh=True
            )

        yield tell


def write_json(path: Path | None, result: Mapping[str, object]) -> None:
    """The machine-readable result of a command, where it is wanted."""
    from rov_ident.fit import write_text

    if path:
        write_text(path, json.dumps(result, indent=2, allow_nan=False) + "\n")


def check_outputs(outputs: Sequence[Path | None], inputs: Sequence[Path | None]) -> None:
    """Refuse, before any work, what could not be written or would replace what is read."""
    for out in filter(None, outputs):
        for source in filter(None, inputs):
            if out.exists() and source.exists() and out.samefile(source):
                raise UserError(f"{out} would be replaced by the result: choose another name")
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{out} cannot be written: {error.strerror}") from error
        if not os.access(out.parent, os.W_OK):
            raise UserError(f"{out} cannot be written: its folder is not yours to write in")


def read_bag(path: Path, config: configuration.Config, tell: Tell) -> "Record":
    """A bag's samples, and what had to be refused on standard error."""
    from rov_ident.records import read_record

    record = read_record(path, config, lambda k, n: tell(f"reading {path.name}", k / max(n, 1)))
    for note in record.notes:
        ERR.print(note, markup=False, soft_wrap=True)
    return record


def counted(messages: Iterator[T], total: int, path: Path, tell: Tell) -> Iterator[T]:
    """The same, telling now and then how many there have been."""
    for done, message in enumerate(messages):
        if done % 2000 == 0:
            tell(f"reading {path.name}", done / total)
        yield message


def result_table(title: str, result: "Result", **more: Sequence[str]) -> Table:
    """The numbers of a result, with further columns of text (n,)."""
    table = new_table(title, "value", "std", "unit", *more)
    for i, name in enumerate(result.names):
        value, std = f"{result.values[i]:.5g}", f"{result.std[i]:.2g}"
        table.add_row(name, value, std, result.units[i], *(column[i] for column in more.values()))
    return table


def new_table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for column in columns:
        left = column in ("unit", "state", "identifiable")
        table.add_column(column, justify="left" if left else "right")
    return table


def finite(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None
