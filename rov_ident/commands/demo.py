"""The main job on the shipped bag, live over DDS."""

import argparse
from pathlib import Path

from rich.console import Console

from rov_ident.commands.common import ERR, OUT, Commands, rate


def add(commands: Commands) -> None:
    demo = commands.add_parser("demo", help="the main job on the shipped bag, live over DDS")
    demo.add_argument("--rate", type=rate, default=4.0, help="speed of the replay (default 4)")
    demo.add_argument(
        "--out", type=Path, default=Path("out/demo"), help="folder of the report (out/demo)"
    )
    demo.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> None:
    from rov_ident.demo import demo

    # Its own pictures are the progress: with --quiet there are none.
    err = Console(stderr=True, quiet=True) if options.quiet else ERR
    demo(options.out, options.rate, err, OUT)
