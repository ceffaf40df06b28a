"""Plain CSV and logs of ArduSub or PX4 into bags."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rov_ident.cli import common
from rov_ident.core.errors import UserError

if TYPE_CHECKING:
    from rov_ident.core.progress import Progress


_OF_CSV = (
    "map", "body_frame", "wrench_timing", "mask_rates_above", "degrees", "polarity", "despike",
    "depth", "smooth", "cut", "cut_idle",
)  # fmt: skip


def add(commands: common.Commands) -> None:
    text = "turn plain CSV or logs of ArduSub or PX4 into a bag"
    import_ = common.command(commands, "import", text, _import, "--json", "bag")
    import_.add_argument(
        "log",
        nargs="+",
        type=Path,
        metavar="LOG",
        help="CSV files, or one .BIN or .tlog of ArduSub, one .ulg of PX4",
    )
    import_.add_argument(
        "--config", type=Path, help="for a log of an autopilot: its `thrusters` give the wrench"
    )
    import_.add_argument("--out", required=True, type=Path, metavar="BAG", help="bag to write")
    common.columns_option(import_, "u=surge_speed; w=0 is a constant")
    import_.add_argument("--body-frame", choices=("frd", "flu"), help="axes of a CSV (default frd)")
    import_.add_argument(
        "--wrench-timing", choices=("held", "mean", "bin"),
        help="a row's wrench holds from its time on, is the mean around it, or of the bin from its "
        "time to the next row's (default held)",
    )  # fmt: skip
    import_.add_argument(
        "--mask-rates-above",
        type=common.positive,
        metavar="RAD_S",
        help="leave out faster rotations",
    )
    log = import_.add_argument_group("preparing a CSV, in this order")
    log.add_argument(
        "--degrees", nargs="+", default=[], metavar="NAME",
        help="angles and rates that were recorded in degrees (r yaw delta_r)",
    )  # fmt: skip
    log.add_argument(
        "--polarity", nargs="+", default=[], metavar="NAME",
        help="columns that were recorded with the opposite sign (w M)",
    )  # fmt: skip
    log.add_argument(
        "--despike", action="store_true", help="replace outliers of the velocities (Hampel)"
    )
    log.add_argument(
        "--depth", nargs="+", type=_source, default=[], metavar="HEADING=STD[,BIAS]",
        help="columns to fuse into z, with the std [m] of their noise and of their common error",
    )  # fmt: skip
    log.add_argument(
        "--smooth", type=common.positive, metavar="HZ",
        help="corner of a filter without lag on the velocities; not for fit --estimator ml, which "
        "has the noise in its model",
    )  # fmt: skip
    log.add_argument(
        "--cut", nargs=2, type=common.number, metavar=("T0", "T1"), help="keep what lies between, s"
    )
    log.add_argument(
        "--cut-idle", type=common.rate, nargs="?", const=5.0, metavar="S",
        help="keep what is driven, and S seconds (5) before and after",
    )  # fmt: skip


def _import(options: argparse.Namespace) -> None:
    from rov_ident.io import ardupilot_log as ardupilot

    of_ardupilot = any(path.suffix.lower() in ardupilot.SUFFIXES for path in options.log)
    with common.progress(options) as tell:
        report, messages = (_import_ardupilot if of_ardupilot else _import_csv)(options, tell)
    common.say(*report.notes, f"{options.out}: {messages}, {report.duration:.1f} s")
    common.write_json(options.json, vars(report))


def _import_ardupilot(options: argparse.Namespace, tell: "Progress") -> tuple[Any, str]:
    """What was imported, and its messages in words."""
    from rov_ident import config as configuration
    from rov_ident.io.ardupilot_log import import_log

    if len(options.log) > 1:
        raise UserError("import logs of an autopilot one by one: each has a clock of its own")
    log = options.log[0]
    if not options.config:
        raise UserError(
            f"{log.name} holds commands of thrusters: --config names the parameter file whose "
            "thrusters turn them into a wrench"
        )
    config = configuration.load(options.config)
    for option in _OF_CSV:
        if getattr(options, option):
            raise UserError(f"--{option.replace('_', '-')} is for a CSV alone")
    report = import_log(log, options.out, config, lambda share: tell(f"reading {log.name}", share))
    counts = f"{report.odometry} odometry, {report.imu} IMU and {report.wrench} wrench messages"
    return report, counts


def _import_csv(options: argparse.Namespace, tell: "Progress") -> tuple[Any, str]:
    """As :func:`_import_ardupilot`."""
    from rov_ident.io.csv_log import import_csv, parse_columns
    from rov_ident.sampling.preprocess import Preparation

    if options.config:
        raise UserError("--config is for logs of an autopilot: a CSV holds the wrench itself")
    tell("reading")
    report = import_csv(
        options.log,
        options.out,
        columns=parse_columns(options.map),
        degrees=options.degrees,
        body_frame=options.body_frame or "frd",
        mask_rates_above=options.mask_rates_above,
        wrench_timing=options.wrench_timing or "held",
        prepare=Preparation(
            tuple(options.polarity), options.despike, dict(options.depth), options.smooth,
            options.cut, options.cut_idle,
        ),
        depths=[heading for heading, _ in options.depth],
    )  # fmt: skip
    return report, f"{report.odometry} odometry messages from {report.rows} rows"


def _source(text: str) -> tuple[str, tuple[float, float]]:
    """A column of depths and how well it is known."""
    heading, _, numbers = text.rpartition("=")
    noise, _, bias = numbers.partition(",")
    if not heading:
        raise argparse.ArgumentTypeError(f"{text!r} must be HEADING=STD or HEADING=STD,BIAS")
    return heading, (common.positive(noise), common.rate(bias) if bias else 0.0)
