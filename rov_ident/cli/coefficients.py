"""Every coefficient by name."""

import argparse

from rov_ident.cli.common import OUT, Commands, command, write_json


def add(commands: Commands) -> None:
    text = "every coefficient, its unit and meaning"
    command(commands, "coefficients", text, _coefficients, "--json")


def _coefficients(options: argparse.Namespace) -> None:
    from rov_ident.model.coefficients import catalogue, input_catalogue

    entries = [*catalogue(), *input_catalogue()]
    for c in entries:
        OUT.print(f"{c.name:<10} {c.unit:<18} {c.meaning}")
    write_json(options.json, {c.name: {"unit": c.unit, "meaning": c.meaning} for c in entries})
