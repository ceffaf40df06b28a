"""The whole path in one command."""

import argparse
from pathlib import Path

from rov_ident.cli.common import OUT, Commands, command, folder, progress, show


def add(commands: Commands) -> None:
    text = "from dives to a judged model: check, explain, fit, one report, what to fly next"
    files = "report.html extended.yaml result.json"
    identify = command(commands, "identify", text, _identify, "bags --config", files)
    identify.add_argument(
        "--out", required=True, type=folder, metavar="DIR",
        help="folder for report.html, extended.yaml and result.json",
    )  # fmt: skip
    identify.add_argument(
        "--validate", type=Path, metavar="BAG",
        help="judge on this one (default: the shortest of several, 30 %% of a single one)",
    )  # fmt: skip


def _identify(options: argparse.Namespace) -> None:
    from rov_ident.api.identification import identify

    with progress(options) as tell:
        found = identify(options.bags, options.config, validate=options.validate, progress=tell)
        tell("drawing")
        found.write_folder(options.out)  # its name may have a dot, as of a date
    OUT.print(found.sentence)
    show(found, found.notes)
    for advice in found.advice:
        OUT.print(advice)
