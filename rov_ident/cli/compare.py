"""Two results: what changed, by how much against its uncertainty."""

import argparse
from pathlib import Path

from rov_ident.cli.common import OUT, Commands, command, show, write_result


def add(commands: Commands) -> None:
    text = "two results: what changed, by how much against its uncertainty"
    kinds = (
        "JSON of fit, explain, nomoto or forces, the folder of identify, or a parameter file, "
        "whose values are exact"
    )
    compare = command(commands, "compare", text, _compare, "--json --report")
    compare.add_argument("a", type=Path, metavar="A", help=kinds)
    compare.add_argument("b", type=Path, metavar="B", help="the same")


def _compare(options: argparse.Namespace) -> None:
    from rov_ident.api.comparison import compare

    found = compare(options.a, options.b)
    write_result(found, options)
    show(found, found.notes)
    OUT.print(found.sentence)
