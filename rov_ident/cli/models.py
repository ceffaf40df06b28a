"""The model for other programs, and theirs for us."""

import argparse
from pathlib import Path

from rov_ident.cli.common import Commands, command, say, write_json
from rov_ident.core.files import write_file


def add(commands: Commands) -> None:
    text = "write the model for a controller or simulator"
    export = command(commands, "export", text, _export, "--config --json")
    export.add_argument(
        # WRITERS of consumer.formats, which takes a second to import: --help is there at once
        "--format", required=True, choices=("auv_controllers", "gazebo", "mss"),
        help="of the other program",
    )  # fmt: skip
    export.add_argument("--out", required=True, type=Path, metavar="FILE", help="file to write")

    text = "a configuration from a Gazebo model, auv_controllers' <hydrodynamics> or a URDF"
    model = command(commands, "import-model", text, _import_model, "--json")
    model.add_argument("file", type=Path, metavar="FILE", help="SDFormat, YAML or URDF")
    model.add_argument(
        "--config", type=Path, help="what the file does not hold, as a URDF the coefficients"
    )
    model.add_argument(
        "--out", required=True, type=Path, metavar="CONFIG", help="parameter file to write"
    )


def _export(options: argparse.Namespace) -> None:
    from rov_ident import config as configuration
    from rov_ident.consumer.formats import export

    written = export(configuration.load(options.config), options.format)
    write_file(options.out, written.content)
    lost = (f"lost in {options.format}: {what}" for what in written.lost)
    say(*lost)
    write_json(options.json, {"format": options.format, "lost": list(written.lost)})


def _import_model(options: argparse.Namespace) -> None:
    from rov_ident import config as configuration
    from rov_ident.consumer.formats import import_model

    base = configuration.load(options.config) if options.config else None
    config, notes = import_model(options.file, base)
    configuration.dump(config, options.out, comment=f"From {options.file.name}.")
    say(*(f"note: {note}" for note in notes))
    write_json(options.json, {"name": config.name, "notes": list(notes)})
