"""What the commands share: consoles, arguments, progress, tables, files."""

import argparse
import contextlib
import math
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from rich.console import Console
from rich.text import Text

from rov_ident.core.errors import UserError
from rov_ident.core.files import check_output, write_file

if TYPE_CHECKING:
    from rov_ident.core.progress import Progress
    from rov_ident.reports.result import Shown


class _Console(Console):
    """Shows text of whatever origin: what would steer a terminal, or cannot be written, escaped."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)

    def on_broken_pipe(self) -> None:
        """Whoever read our output has seen enough: rich would end with the status of a fault."""
        with contextlib.suppress(SystemExit):
            super().on_broken_pipe()
        raise BrokenPipeError


# Without emoji: rich would draw `a:x:1` with a cross.
ERR = _Console(stderr=True, highlight=False, markup=False, emoji=False)
OUT = _Console(highlight=False, markup=False, emoji=False, soft_wrap=True)

LIVE = ("rls", "ukf")
LARGEST = 1e5  # of any number on the command line: a day of simulation, 100 kHz

EXAMPLES = {
    "demo": "--rate 8",
    "init": "--vehicle bluerov2_heavy dive.mcap --out my_rov.yaml",
    "identify": "dive_1.mcap dive_2.mcap --config my_rov.yaml --out identified",
    "replay": "dive.mcap --config my_rov.yaml --rate 4 --out live.mcap",
    "fit": "dive.mcap --config my_rov.yaml --save fitted.yaml --report fit.html",
    "check": "dive.mcap --config my_rov.yaml --report check.html",
    "plan": "--config fitted.yaml --bag dive.mcap --tank 6,4,2",
    "explain": "dive.mcap --config fitted.yaml --out explained",
    "compare": "my_rov.yaml fit.json",
    "simulate": "--config my_rov.yaml --bag dive.mcap --out simulated.mcap",
    "import": "00000012.BIN --config my_rov.yaml --out dive.mcap",
    "export": "--config fitted.yaml --format gazebo --out model.sdf",
    "import-model": "robot.urdf --config my_rov.yaml --out new.yaml",
    "nomoto": "zigzag_10.csv --validate zigzag_20.csv --json nomoto.json",
    "forces": 'table.csv --map beta_deg="beta(deg)" --json forces.json',
    "coast-down": "run_1.csv run_2.csv --json surge.json",
    "steer": "--out zigzag.csv",
    "dashboard": "",
    "watch": "",
    "layouts": "--config my_rov.yaml --out layouts",
    "coefficients": "",
    "completion": "bash",
}
"""Of each command, for its --help: what follows its name."""

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

_BAG = "a bag: .mcap, .db3, ROS 1's .bag, or a rosbag2 directory"
_PATHS: Mapping[str, Mapping[str, Any]] = {
    "bag": {"metavar": "BAG", "help": _BAG},
    "bags": {"metavar": "BAG", "nargs": "+", "help": _BAG},
    "--config": {"required": True, "help": "the vehicle's parameter file"},
    "--json": {"help": "write the result here"},
    "--report": {"metavar": "FILE", "help": "write a page with pictures"},
    "--save": {"metavar": "FILE", "help": "write a configuration with the fitted values"},
}
"""Paths that several commands take, each with one meaning."""

OUTPUTS = ("json", "save", "report", "out")
"""The options that name what a command writes; all other paths are read."""


def command(
    commands: Commands,
    name: str,
    text: str,
    run: Callable[[argparse.Namespace], None],
    paths: str = "",
    out: str = "file",
) -> argparse.ArgumentParser:
    """A new command and what runs it, with the common ``paths`` of these names. ``out`` is what
    --out names: a "file", a "bag", or a folder for files of these names."""
    example = f"example: rov-ident {name} {EXAMPLES[name]}".rstrip()
    # Raw: an example that is broken into lines cannot be copied.
    raw = argparse.RawDescriptionHelpFormatter
    parser = commands.add_parser(
        name, help=text, description=text, epilog=example, formatter_class=raw,
        allow_abbrev=False,  # or `fit --out FILE` would be --output-error, and FILE a bag
    )  # fmt: skip
    parser.set_defaults(run=run, out_kind=out)
    for path in paths.split():
        parser.add_argument(path, type=Path, **_PATHS[path])
    return parser


def columns_option(parser: argparse.ArgumentParser, example: str) -> None:
    parser.add_argument(
        "--map", nargs="+", action="extend", default=[], metavar="NAME=HEADING",
        help=f"headings that are called otherwise ({example}), or a YAML file",
    )  # fmt: skip


def _real(meaning: str, good: Callable[[float], bool]) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
        if not good(value):
            raise argparse.ArgumentTypeError(f"{text} must be {meaning}")
        return value

    return parse


def _whole(meaning: str, low: int, high: float) -> Callable[[str], int]:
    def parse(text: str) -> int:
        if not text.isdecimal() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not {meaning}")
        return int(text)

    return parse


number = _real("a finite number", math.isfinite)
rate = _real(f"from 0 to {LARGEST:g}", lambda value: 0.0 <= value <= LARGEST)
share = _real("from 0 to below 1", lambda value: 0.0 <= value < 1.0)
positive = _real(f"above 0, up to {LARGEST:g}", lambda value: 0.0 < value <= LARGEST)
seed = _whole("a whole number from 0", 0, math.inf)
port = _whole("a port, from 0 to 65535", 0, 65535)
count = _whole("a whole number from 1 to 1024", 1, 1024)


def box(text: str) -> tuple[float, ...]:
    sides = tuple(positive(part) for part in text.split(","))
    if len(sides) != 3:
        raise argparse.ArgumentTypeError(f"{text!r} must be three lengths: 6,6,2")
    return sides


def folder(text: str) -> Path:
    """A folder to write in; an empty name, of a variable that is not set, is not this one."""
    if not text:
        raise argparse.ArgumentTypeError("an empty name is no folder: use . for this one")
    return Path(text)


@contextlib.contextmanager
def progress(options: argparse.Namespace) -> "Iterator[Progress]":
    """A line and a bar on standard error; nothing with --quiet, or where nobody looks."""
    from rich import progress as bars

    shown = ERR.is_terminal and not options.quiet
    with bars.Progress(console=ERR, transient=True, disable=not shown) as shown_bars:
        bar = shown_bars.add_task("", total=None)

        def tell(what: str, share: float | None = None) -> None:
            total = None if share is None else 1.0
            # At once: what is done quickly should be seen, too.
            shown_bars.update(
                bar, description=what, completed=share or 0.0, total=total, refresh=True
            )

        yield tell


def check_paths(options: argparse.Namespace) -> None:
    """Refuse, before any work, what could not be written, or would replace what is read or another
    result."""
    lists = {k: v if isinstance(v, list) else [v] for k, v in vars(options).items()}
    paths = {k: [path for path in v if isinstance(path, Path)] for k, v in lists.items()}
    outputs = [(name, path) for name in OUTPUTS for path in paths.pop(name, ())]
    taken = [path for read in paths.values() for path in read]
    for path in taken:
        if "\0" in str(path):
            raise UserError(f"{path!r} cannot be read: no file can have that name")
    for name, path in outputs:
        kind = options.out_kind if name == "out" else "file"
        files = [] if kind in ("file", "bag") else [path / file for file in kind.split()]
        for place in files or [path]:
            check_output(place, taken, kind == "bag" or (bool(files) and place.suffix == ".mcap"))
            taken.append(place)


def write_json(path: Path | None, result: Mapping[str, object]) -> None:
    """The machine-readable result of a command, where it is wanted."""
    if path:
        from rov_ident.reports.result import as_json

        write_file(path, as_json(result))


def write_result(
    result: "Shown", options: argparse.Namespace, tell: "Progress | None" = None
) -> None:
    """The page and the JSON of a result, where they are wanted."""
    if options.report:
        if tell:
            tell("drawing")
        write_file(options.report, result.page())
    if options.json:
        write_file(options.json, result.to_json())


def printable(text: str, kept: str = "\n\t") -> str:
    """Text whose control characters, but for those ``kept``, are written as escapes."""
    return "".join(
        char if char in kept or unicodedata.category(char) not in ("Cc", "Cf", "Cs", "Zl", "Zp")
        else ascii(char)[1:-1]
        for char in text
    )  # fmt: skip


def say(*sentences: str) -> None:
    """Sentences on standard error, each on its own line however long it is."""
    for sentence in sentences:
        ERR.print(printable(sentence, ""), soft_wrap=True)


def show(result: "Shown", notes: Sequence[str] = ()) -> None:
    """The table of a result on standard output, its notes on standard error."""
    OUT.print(result.table())
    say(*notes)
