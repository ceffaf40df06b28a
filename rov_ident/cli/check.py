"""Is this bag fit for identification?"""

import argparse

from rov_ident.cli.common import OUT, Commands, command, progress, show, write_result


def add(commands: Commands) -> None:
    text = "is this bag fit for identification, and what would it tell"
    command(commands, "check", text, _check, "bag --config --json --report")


def _check(options: argparse.Namespace) -> None:
    from rov_ident.api.functions import check

    with progress(options) as tell:
        found = check(options.bag, options.config, progress=tell)
        write_result(found, options, tell)
    OUT.print(found.sentence)
    show(found, found.record.notes)
