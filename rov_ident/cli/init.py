"""The first configuration of a vehicle."""

import argparse
from pathlib import Path

from rov_ident.cli.common import OUT, Commands, command, progress, say
from rov_ident.core.errors import UserError
from rov_ident.core.files import VEHICLES


def add(commands: Commands) -> None:
    text = "write a commented configuration from what a bag, a log or a model tells"
    init = command(commands, "init", text, _init)
    init.add_argument(
        "record", nargs="?", type=Path, metavar="RECORD",
        help="a bag, a log of ArduSub (.BIN, .tlog) or PX4 (.ulg), a URDF or SDFormat model",
    )  # fmt: skip
    init.add_argument("--vehicle", choices=VEHICLES, default="", help="shipped one to start from")
    init.add_argument(
        "--out", type=Path, metavar="FILE", help="where to write it (standard output)"
    )
    init.add_argument("--force", action="store_true", help="also over a file that is there already")


def _init(options: argparse.Namespace) -> None:
    from rov_ident.api.start import init

    if options.out and options.out.exists() and not options.force:
        raise UserError(
            f"{options.out} is there already, perhaps edited by hand: choose another name, or give "
            "--force"
        )
    with progress(options) as tell:
        draft = init(options.record, options.vehicle, progress=tell)
    if options.out:
        draft.save(options.out)
    else:
        OUT.print(draft.text, end="")
    say(*draft.notes, draft.sentence)
