"""The model for other programs, and theirs for us."""

import argparse
from pathlib import Path

from rov_ident import config as configuration
from rov_ident.commands.common import CONFIG, ERR, Commands, check_outputs, json_option, write_json


def add(commands: Commands) -> None:
    export = commands.add_parser("export", help="write the model for a controller or simulator")
    export.add_argument("--config", required=True, type=Path, help=CONFIG)
    export.add_argument(
        "--format",
        required=True,
        choices=("auv_controllers", "gazebo", "mss"),
        help="of the other program",
    )
    export.add_argument("--out", required=True, type=Path, metavar="FILE", help="file to write")
    json_option(export)
    export.set_defaults(run=_export)

    model = commands.add_parser(
        "import-model",
        help="a configuration from a Gazebo model, auv_controllers' parameters or a URDF",
    )
    model.add_argument("file", type=Path, metavar="FILE", help="SDFormat, YAML or URDF")
    model.add_argument(
        "--config", type=Path, help="what the file does not hold, as a URDF the coefficients"
    )
    model.add_argument(
        "--out", required=True, type=Path, metavar="CONFIG", help="parameter file to write"
    )
    json_option(model)
    model.set_defaults(run=_import_model)


def _export(options: argparse.Namespace) -> None:
    from rov_ident.fit import write_text
    from rov_ident.formats import export

    check_outputs([options.out, options.json], [options.config])
    written = export(configuration.load(options.config), options.format)
    write_text(options.out, written.content)
    for what in written.lost:
        ERR.print(f"lost in {options.format}: {what}", markup=False, soft_wrap=True)
    ERR.print(f"written: {options.out}", markup=False, soft_wrap=True)
    write_json(options.json, {"format": options.format, "lost": list(written.lost)})


def _import_model(options: argparse.Namespace) -> None:
    from rov_ident.formats import import_model

    check_outputs([options.out, options.json], [options.file, options.config])
    base = configuration.load(options.config) if options.config else None
    config, notes = import_model(options.file, base)
    configuration.dump(config, options.out, comment=f"From {options.file.name}.")
    for note in notes:
        ERR.print(f"note: {note}", markup=False, soft_wrap=True)
    ERR.print(f"written: {options.out}", markup=False, soft_wrap=True)
    write_json(options.json, {"name": config.name, "notes": list(notes)})
