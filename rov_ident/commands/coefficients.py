"""Every coefficient by name."""

import argparse

from rov_ident.coefficients import catalogue, fin_catalogue
from rov_ident.commands.common import OUT, Commands, json_option, write_json


def add(commands: Commands) -> None:
    names = commands.add_parser("coefficients", help="every coefficient, its unit and meaning")
    json_option(names)
    names.set_defaults(run=_coefficients)


def _coefficients(options: argparse.Namespace) -> None:
    entries = [(c.name, c.unit, c.meaning) for c in catalogue()]
    entries += [(c.name, c.unit, c.meaning) for c in fin_catalogue()]
    for name, unit, meaning in entries:
        OUT.print(f"{name:<10} {unit:<18} {meaning}", markup=False)
    table = {name: {"unit": unit, "meaning": meaning} for name, unit, meaning in entries}
    write_json(options.json, table)
