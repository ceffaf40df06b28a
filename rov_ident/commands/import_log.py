"""Plain CSV and ArduSub logs into bags."""

import argparse
from pathlib import Path

from rov_ident import config as configuration
from rov_ident.commands.common import (
    ERR,
    Commands,
    check_outputs,
    json_option,
    positive,
    progress,
    write_json,
)
from rov_ident.errors import UserError


def add(commands: Commands) -> None:
    import_ = commands.add_parser("import", help="turn plain CSV or ArduSub logs into a bag")
    import_.add_argument(
        "log",
        nargs="+",
        type=Path,
        metavar="LOG",
        help="CSV files, or one .BIN or .tlog of ArduSub",
    )
    import_.add_argument(
        "--config", type=Path, help="of a .BIN or .tlog: its `thrusters` turn pulses into a wrench"
    )
    import_.add_argument("--out", required=True, type=Path, metavar="BAG", help="bag to write")
    import_.add_argument(
        "--map",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=HEADING",
        help="headings that are called otherwise (u=surge_speed), constants (w=0), or a YAML file",
    )
    import_.add_argument(
        "--body-frame", choices=("frd", "flu"), default="frd", help="axes of a CSV (frd)"
    )
    import_.add_argument(
        "--wrench-timing",
        choices=("held", "mean", "bin"),
        default="held",
        help="a row's wrench holds from its time on, is the mean around it, or of the bin from its "
        "time to the next row's (default held)",
    )
    import_.add_argument(
        "--mask-rates-above", type=positive, metavar="RAD_S", help="leave out faster rotations"
    )
    json_option(import_)
    import_.set_defaults(run=_import)


def _import(options: argparse.Namespace) -> None:
    from rov_ident import ardupilot

    check_outputs([options.out, options.json], [*options.log, options.config])
    if any(path.suffix.lower() in ardupilot.SUFFIXES for path in options.log):
        _import_ardupilot(options)
    else:
        _import_csv(options)


def _import_ardupilot(options: argparse.Namespace) -> None:
    from rov_ident.ardupilot import import_log

    if len(options.log) > 1:
        raise UserError("import ArduSub's logs one by one: each has a clock of its own")
    if not options.config:
        raise UserError(
            f"{options.log[0].name} holds pulse widths: --config names the parameter file whose "
            "thrusters turn them into a wrench"
        )
    config = configuration.load(options.config)
    name = options.log[0].name
    with progress(options) as tell:
        report = import_log(
            options.log[0], options.out, config, lambda share: tell(f"reading {name}", share)
        )
    for note in report.notes:
        ERR.print(note, markup=False, soft_wrap=True)
    ERR.print(
        f"{options.out}: {report.odometry} odometry, {report.imu} IMU and {report.wrench} wrench "
        f"messages, {report.duration:.1f} s"
    )
    write_json(options.json, vars(report))


def _import_csv(options: argparse.Namespace) -> None:
    from rov_ident.importer import import_csv, parse_columns

    if options.config:
        raise UserError("--config is for ArduSub's logs: a CSV holds the wrench itself")
    with progress(options) as tell:
        tell("reading")
        report = import_csv(
            options.log,
            options.out,
            columns=parse_columns(options.map),
            body_frame=options.body_frame,
            mask_rates_above=options.mask_rates_above,
            wrench_timing=options.wrench_timing,
        )
    for note in report.notes:
        ERR.print(note, markup=False, soft_wrap=True)
    ERR.print(
        f"{options.out}: {report.odometry} odometry messages from {report.rows} rows, "
        f"{report.duration:.1f} s"
    )
    write_json(options.json, vars(report))
