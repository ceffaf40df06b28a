"""The command ``rov-ident``: standard output carries results, standard error everything else.

Exit status: 0 done, 2 the user can mend it, 1 a fault of ours.
"""

import argparse
import contextlib
import dataclasses
import json
import math
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from rov_ident import config as configuration
from rov_ident.coefficients import MOTIONS, catalogue, fin_catalogue
from rov_ident.errors import UserError

if TYPE_CHECKING:
    from rov_ident.explain_report import Source
    from rov_ident.online import Report
    from rov_ident.records import Record
    from rov_ident.result import Result
    from rov_ident.streams import Streams

T = TypeVar("T")

ERR = Console(stderr=True, highlight=False)
OUT = Console(highlight=False, soft_wrap=True)

LIVE = ("rls", "ukf")
BATCH = ("ls", "iv", "ml")
LARGEST = 1e5  # of any number on the command line: a day of simulation, 100 kHz
PAIRS = {"lateral": ("sway", "yaw"), "longitudinal": ("heave", "pitch")}


_CONFIG = "the vehicle's parameter file"
_BAG = "an .mcap file or a rosbag2 directory"

# The commands whose result fits one plain file, besides those that declare it themselves.
_JSON = ("replay", "simulate", "import", "export", "import-model", "steer", "coefficients")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; the exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        options.run(options)
    except UserError as error:
        ERR.print(f"rov-ident {options.command}: {error}", markup=False, soft_wrap=True)
        return 2
    except BrokenPipeError:
        # Whoever read our output has seen enough (`rov-ident coefficients | head`).
        sys.stderr.close()
        return 0
    except KeyboardInterrupt:
        ERR.print("interrupted")
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rov-ident",
        description="Identify the hydrodynamic coefficients of underwater vehicles.",
    )
    parser.add_argument("--version", action="version", version=version("rov_ident"))
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    demo = commands.add_parser("demo", help="the main job on the shipped bag, live over DDS")
    demo.add_argument("--rate", type=_rate, default=4.0, help="speed of the replay (default 4)")
    demo.add_argument(
        "--out", type=Path, default=Path("out/demo"), help="folder of the report (out/demo)"
    )
    demo.set_defaults(run=_demo)

    replay = commands.add_parser(
        "replay", help="play a bag into live nodes over DDS and record what they publish"
    )
    _bag_and_config(replay)
    replay.add_argument("--estimator", choices=LIVE, action="append", help="default: both")
    replay.add_argument(
        "--rate", type=_rate, default=1.0, help="speed; 0: as fast as the nodes follow (default 1)"
    )
    replay.add_argument("--out", type=Path, help="bag to write")
    replay.set_defaults(run=_replay)

    fit = commands.add_parser(
        "fit", help="identify offline, by the code of the nodes or from all the data at once"
    )
    fit.add_argument("bags", nargs="+", type=Path, metavar="BAG", help=_BAG)
    fit.add_argument("--config", required=True, type=Path, help=_CONFIG)
    fit.add_argument(
        "--estimator",
        choices=(*LIVE, *BATCH),
        required=True,
        help="rls, ukf: as the nodes; ls: least squares; iv: instrumental variables; "
        "ml: maximum likelihood",
    )
    fit.add_argument("--json", type=Path, help="write the result here")
    fit.add_argument(
        "--save", type=Path, metavar="FILE", help="write a configuration with the fitted values"
    )
    fit.add_argument("--report", type=Path, metavar="FILE", help="write a page with pictures")
    fit.add_argument(
        "--validate", type=Path, metavar="BAG", help="judge on this bag, which is not fitted"
    )
    batch = fit.add_argument_group("ls, iv and ml")
    batch.add_argument(
        "--channels",
        type=_channels,
        action="append",
        metavar="surge,sway,...",
        help="fit these alone, the others as measured (also lateral, longitudinal); "
        "given again: one group after the other",
    )
    batch.add_argument(
        "--no-prior", action="store_true", help="the configured values count for nothing"
    )
    batch.add_argument(
        "--ordinary", action="store_true", help="ls, iv: do not weigh the axes by their residuals"
    )
    batch.add_argument("--output-error", action="store_true", help="ml: take the wrench as exact")
    batch.add_argument("--jobs", type=_count, help="processes that read bags (all processors)")
    batch.add_argument("--dask", default="", metavar="ADDRESS", help="a Dask scheduler, or `local`")
    fit.set_defaults(run=_fit)

    check = commands.add_parser(
        "check", help="is this bag fit for identification, and what would it tell"
    )
    _bag_and_config(check)
    check.add_argument("--json", type=Path, help="write what was found here")
    check.add_argument("--report", type=Path, metavar="FILE", help="write a page with pictures")
    check.set_defaults(run=_check)

    plan = commands.add_parser(
        "plan", help="the manoeuvre to run next: safe, and best for the worst known coefficient"
    )
    plan.add_argument("--config", required=True, type=Path, help=_CONFIG)
    plan.add_argument(
        "--bag", type=Path, nargs="+", default=[], help="what has been recorded already"
    )
    plan.add_argument("--duration", type=_positive, default=60.0, help="s (60)")
    plan.add_argument(
        "--tank",
        type=_box,
        default=(6.0, 6.0, 2.0),
        metavar="L,W,D",
        help="m; of free water about the start: length, width, depth (6,6,2)",
    )
    plan.add_argument(
        "--thrust",
        type=_positive,
        default=1.0,
        help="the largest wrench on each axis, relative to what holds working speed (1)",
    )
    plan.add_argument("--json", type=Path, help="write the plan here")
    plan.add_argument("--report", type=Path, metavar="FILE", help="write a page with pictures")
    plan.add_argument("--out", type=Path, metavar="BAG", help="write the simulated manoeuvre here")
    plan.set_defaults(run=_plan)

    explain = commands.add_parser(
        "explain", help="what the simulation gets wrong, why, and what mending it gains"
    )
    explain.add_argument("bags", nargs="+", type=Path, metavar="BAG", help=_BAG)
    explain.add_argument("--config", required=True, type=Path, help=_CONFIG)
    explain.add_argument(
        "--out", required=True, type=Path, metavar="DIR",
        help="folder for findings.json, report.html and extended.yaml",
    )  # fmt: skip
    explain.add_argument(
        "--validate", type=Path, metavar="BAG", help="judge on this bag, not on held-out parts"
    )
    explain.set_defaults(run=_explain)

    simulate = commands.add_parser(
        "simulate",
        help="simulate open loop: a manoeuvre measured by simulated sensors, or a bag's wrench",
    )
    simulate.add_argument("--config", required=True, type=Path, help=_CONFIG)
    source = simulate.add_mutually_exclusive_group(required=True)
    source.add_argument("--bag", type=Path, help="drive by the wrench of this bag and compare")
    source.add_argument("--manoeuvre", help="steps, multisine, single-axis, pilot or rest")
    simulate.add_argument(
        "--channels",
        type=_channels,
        metavar="surge,sway,...",
        help="with --bag: simulate these alone, the other velocities and the attitude as measured",
    )
    simulate.add_argument("--out", required=True, type=Path, metavar="BAG", help="bag to write")
    simulate.add_argument("--duration", type=_positive, default=180.0, help="s (180)")
    simulate.add_argument("--seed", type=_seed, default=0, help="of manoeuvre and noise (0)")
    simulate.add_argument("--odometry-rate", type=_positive, default=20.0, help="Hz (20)")
    simulate.add_argument("--imu-rate", type=_rate, default=100.0, help="Hz; 0: no IMU (100)")
    simulate.add_argument("--wrench-rate", type=_positive, default=50.0, help="Hz (50)")
    simulate.add_argument("--noise", type=_rate, default=1.0, help="factor on all noise (1)")
    simulate.add_argument("--delay", type=_rate, default=0.0, help="s until a message arrives (0)")
    simulate.add_argument("--jitter", type=_rate, default=0.0, help="s, of the delay (0)")
    simulate.add_argument("--drop", type=_share, default=0.0, help="share of messages lost (0)")
    simulate.set_defaults(run=_simulate)

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
        "--mask-rates-above", type=_positive, metavar="RAD_S", help="leave out faster rotations"
    )
    import_.set_defaults(run=_import)

    export = commands.add_parser("export", help="write the model for a controller or simulator")
    export.add_argument("--config", required=True, type=Path, help=_CONFIG)
    export.add_argument(
        "--format",
        required=True,
        choices=("auv_controllers", "gazebo", "mss"),
        help="of the other program",
    )
    export.add_argument("--out", required=True, type=Path, metavar="FILE", help="file to write")
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
    model.set_defaults(run=_import_model)

    _add_nomoto(commands)
    _add_forces(commands)
    _add_steer(commands)
    _add_live(commands)

    names = commands.add_parser("coefficients", help="every coefficient, its unit and meaning")
    names.set_defaults(run=_coefficients)

    completion = commands.add_parser("completion", help="print a shell's completion script")
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="which shell")
    completion.set_defaults(run=_completion)
    for name, command in commands.choices.items():
        command.add_argument("--quiet", action="store_true", help="no progress on standard error")
        if name in _JSON:
            command.add_argument("--json", type=Path, help="write the result here")
    return parser


def _add_nomoto(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    nomoto = commands.add_parser("nomoto", help="K and T of Nomoto's steering model from zigzags")
    nomoto.add_argument(
        "files", nargs="+", type=Path, metavar="FILE",
        help="CSV (t_s, heading_rad or heading_deg, rudder_rad or rudder_deg) or bag",
    )  # fmt: skip
    nomoto.add_argument("--order", type=int, choices=(1, 2), default=1, help="of the model (1)")
    nomoto.add_argument("--nonlinear", action="store_true", help="with Norrbin's cubic term")
    nomoto.add_argument(
        "--interpolate", choices=("none", "spline", "spiral"), default="none",
        help="densify sparse headings before the fit (default none)",
    )  # fmt: skip
    nomoto.add_argument(
        "--step", type=_positive, metavar="S",
        help="of the densified heading (default: that of the rows, or a fifth of the heading's)",
    )  # fmt: skip
    nomoto.add_argument(
        "--method", choices=("oe", "fd", "iv", "rls"), default="oe",
        help="output error (default), forward differences, instruments, recursive",
    )  # fmt: skip
    nomoto.add_argument("--validate", type=Path, metavar="FILE", help="predict this run as well")
    nomoto.add_argument("--json", type=Path, help="write the result here")
    nomoto.add_argument("--report", type=Path, metavar="FILE", help="write a page with pictures")
    nomoto.set_defaults(run=_nomoto)


def _add_forces(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    forces = commands.add_parser(
        "forces", help="coefficients from CFD, towing-tank, rotating-arm or PMM tables"
    )
    forces.add_argument("table", type=Path, metavar="TABLE.csv", help="velocities and forces")
    forces.add_argument(
        "--map", nargs="+", action="extend", default=[], metavar="NAME=HEADING",
        help='headings that are called otherwise (beta_deg="beta(deg)"), or a YAML file',
    )  # fmt: skip
    forces.add_argument(
        "--nondimensional", metavar="rho=,L=[,T=]",
        help="forces are over rho/2 U^2 L^2 (with T: L T), moments over L times that",
    )  # fmt: skip
    forces.add_argument(
        "--drift", choices=("auto", "starboard", "port"), default="auto",
        help="positive beta is a drift to starboard, v = U sin(beta), or to port (default: as a "
        "hull resists its motion)",
    )  # fmt: skip
    forces.add_argument(
        "--config", type=Path,
        help="the vehicle: the Coriolis forces of its added mass are not counted twice",
    )  # fmt: skip
    forces.add_argument(
        "--hull", metavar="cylinder:L=,R=",
        help="with --config: added mass of a cylinder or spheroid of length L, radius R [m], rho",
    )  # fmt: skip
    forces.add_argument("--json", type=Path, help="write the result here")
    forces.add_argument(
        "--out", type=Path, metavar="CONFIG", help="write the vehicle with the fitted values"
    )
    forces.add_argument("--report", type=Path, metavar="FILE", help="write a page with pictures")
    forces.set_defaults(run=_forces)


def _add_steer(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    steer = commands.add_parser(
        "steer", help="simulate a vehicle under its fins: zigzag, turn, heading change, dive"
    )
    steer.add_argument("--config", required=True, type=Path, help=_CONFIG)
    steer.add_argument(
        "--manoeuvre",
        required=True,
        choices=("zigzag", "turn", "heading", "dive"),
        help="what to steer",
    )
    steer.add_argument(
        "--angle", type=_number, default=15.0,
        help="deg: of the rudder, or the course of heading (15)",
    )  # fmt: skip
    steer.add_argument("--switch", type=_positive, help="deg, of a zigzag (as the rudder)")
    steer.add_argument("--depth", type=_positive, default=5.0, help="m, of a dive (5)")
    steer.add_argument("--duration", type=_positive, default=100.0, help="s (100)")
    steer.add_argument("--speed", type=_positive, default=1.5, help="m/s (1.5)")
    steer.add_argument("--servo-rate", type=_positive, default=20.0, help="deg/s (20)")
    steer.add_argument("--sample", type=_positive, default=0.1, help="s between rows (0.1)")
    steer.add_argument("--noise", type=_rate, default=0.0, help="deg, of the heading (0)")
    steer.add_argument("--seed", type=_seed, default=0, help="of the noise (0)")
    steer.add_argument("--out", required=True, type=Path, metavar="CSV", help="log to write")
    steer.set_defaults(run=_steer)


def _add_live(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    dashboard = commands.add_parser(
        "dashboard", help="a live page of the running nodes, for a browser on this computer"
    )
    dashboard.add_argument("--port", type=_port, default=8050, help="0: any that is free (8050)")
    dashboard.add_argument(
        "--foxglove", type=_port, nargs="?", const=8765, default=-1, metavar="PORT",
        help="serve Foxglove, too (8765)",
    )  # fmt: skip
    dashboard.add_argument(
        "--json", action="store_true", help="print the addresses as a line of JSON"
    )
    dashboard.set_defaults(run=_dashboard)

    watch = commands.add_parser("watch", help="a live table of the running nodes")
    watch.add_argument("--once", action="store_true", help="print what there is, and end")
    watch.add_argument(
        "--json", action="store_true", help="a line of JSON for each report, not a table"
    )
    watch.add_argument(
        "--wait", type=_positive, default=10.0, metavar="S",
        help="with --once: for an estimator to be heard (10)",
    )  # fmt: skip
    watch.set_defaults(run=_watch)

    layouts = commands.add_parser(
        "layouts", help="layouts of this vehicle's topics for Foxglove and PlotJuggler"
    )
    layouts.add_argument("--config", required=True, type=Path, help=_CONFIG)
    layouts.add_argument("--namespace", default="", help="of the nodes (none)")
    layouts.add_argument(
        "--out", required=True, type=Path, metavar="DIR",
        help="folder for foxglove.json and plotjuggler.xml",
    )  # fmt: skip
    layouts.set_defaults(run=_layouts)


def _bag_and_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bag", type=Path, metavar="BAG", help=_BAG)
    parser.add_argument("--config", required=True, type=Path, help=_CONFIG)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def _rate(text: str) -> float:
    value = _number(text)
    if not 0.0 <= value <= LARGEST:
        raise argparse.ArgumentTypeError(f"{text} must be from 0 to {LARGEST:g}")
    return value


def _share(text: str) -> float:
    value = _number(text)
    if not 0.0 <= value < 1.0:
        raise argparse.ArgumentTypeError(f"{text} must be from 0 to below 1")
    return value


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0")
    return int(text)


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, from 0 to 65535")
    return int(text)


def _box(text: str) -> tuple[float, ...]:
    sides = tuple(_positive(part) for part in text.split(","))
    if len(sides) != 3:
        raise argparse.ArgumentTypeError(f"{text!r} must be three lengths: 6,6,2")
    return sides


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 1024:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to 1024")
    return int(text)


def _channels(text: str) -> "np.ndarray":
    names = [axis for name in text.split(",") for axis in PAIRS.get(name, (name,))]
    if unknown := set(names) - set(MOTIONS):
        known = ",".join((*MOTIONS, *PAIRS))
        raise argparse.ArgumentTypeError(f"no channel {min(unknown)!r}: use {known}")
    return np.array([name in names for name in MOTIONS])


def _positive(text: str) -> float:
    value = _number(text)
    if not 0.0 < value <= LARGEST:
        raise argparse.ArgumentTypeError(f"{text} must be above 0, up to {LARGEST:g}")
    return value


# ------------------------------------------------------------------ commands
# What a command needs beyond numpy is imported by it: `rov-ident --help` is there at once.


def _demo(options: argparse.Namespace) -> None:
    from rov_ident.demo import demo

    # Its own pictures are the progress: with --quiet there are none.
    err = Console(stderr=True, quiet=True) if options.quiet else ERR
    demo(options.out, options.rate, err, OUT)


def _replay(options: argparse.Namespace) -> None:
    from rov_ident.nodes.replay import replay

    _check_outputs([options.json], [options.bag, options.config])
    estimators = options.estimator or LIVE
    with _progress(options) as tell:
        tell("starting the nodes")

        def show(name: str, report: "Report") -> None:
            known, count = sum(level == 0 for level in report.levels), len(report.levels)
            tell(f"{name}: {known} of {count} coefficients converged", known / count)

        result = replay(options.bag, options.config, estimators, options.rate, options.out, show)
    _write_json(
        options.json,
        {
            "messages": result.messages,
            "seconds": result.seconds,
            "estimators": {name: _published(report) for name, report in result.reports.items()},
        },
    )
    for name, report in result.reports.items():
        if not report.stamp:
            raise UserError(f"{options.bag}: {name} could not use any of its messages")
        table = _table(f"{name}, at the end of {options.bag}", "value", "std", "unit", "state")
        for row in zip(report.names, report.values, report.std, report.units, report.messages):
            table.add_row(row[0], f"{row[1]:.5g}", f"{row[2]:.2g}", row[3], row[4])
        OUT.print(table)
    ERR.print(f"{result.messages} messages in {result.seconds:.1f} s")
    if result.out:
        ERR.print(f"recorded: {result.out}")


def _published(report: "Report") -> dict[str, object]:
    """The last report of a node."""
    rows = zip(report.names, report.values, report.std, report.units, report.messages, strict=True)
    return {
        name: {"value": float(value), "std": float(std), "unit": unit, "state": state}
        for name, value, std, unit, state in rows
    }


def _fit(options: argparse.Namespace) -> None:
    from rov_ident import archive
    from rov_ident.batch import Settings, curves, fit_batch, validation
    from rov_ident.fit import fit_online, write_text

    outputs = [options.json, options.save, options.report]
    _check_outputs(outputs, [*options.bags, options.config, options.validate])
    live = options.estimator in LIVE
    _check_batch_options(options, live)
    config = configuration.load(options.config, f"{options.estimator}_node" if live else "")
    with _progress(options) as tell, contextlib.ExitStack() as stack:
        if live:
            records = [_read(path, config, tell) for path in options.bags]
            bags = archive.of_records(records)
            tell("estimating")
            fit = fit_online(records, config, options.estimator)
        else:
            jobs = options.jobs or archive.default_jobs()
            bags = stack.enter_context(
                archive.opened(
                    options.bags, config, jobs, options.dask,
                    lambda name, done, total: tell(f"read {name}", done / total),
                )
            )  # fmt: skip
            stages = tuple(
                tuple(name for name, use in zip(MOTIONS, marks) if use)
                for marks in options.channels or ()
            )
            settings = Settings(
                stages, not options.no_prior, not options.ordinary, not options.output_error
            )
            fit = fit_batch(bags, config, options.estimator, settings, tell)
        fitted = config.with_model(fit.model)
        tell("drawing")
        drawn = curves(bags, config, fitted) if options.report else []
        seen = []
        if options.validate:
            judge = stack.enter_context(archive.opened([options.validate], config))
            fit.more["validation"] = validation(judge, config, fitted)
            seen = curves(judge, config, fitted) if options.report else []
    if options.json:
        write_text(options.json, fit.to_json())
    if options.report:
        from rov_ident.fit_report import page

        write_text(options.report, page(fit, config, drawn, seen))
    if options.save:
        bags_read = ", ".join(path.name for path in options.bags)
        configuration.dump(
            fitted,
            options.save,
            comment=f"Fitted by rov-ident fit --estimator {options.estimator} to {bags_read}.",
        )

    title = f"{options.estimator}: {fit.samples} samples, {fit.duration:.1f} s"
    configured = [f"{config.value(name):.5g}" for name in fit.names]
    known = ["yes" if i else "no: the prior decides" for i in fit.identifiable]
    OUT.print(_numbers(title, fit, configured=configured, identifiable=known))
    if judged := fit.more.get("validation"):
        table = _table(f"{options.validate.name}, simulated in open loop: RMSE", "before", "after")
        for name, before in judged["rmse_before"].items():
            after = judged["rmse"][name]
            table.add_row(name, *("" if x is None else f"{x:.4f}" for x in (before, after)))
        OUT.print(table)
    for note in () if live else fit.notes:
        ERR.print(note, markup=False, soft_wrap=True)


def _check_batch_options(options: argparse.Namespace, live: bool) -> None:
    """Refuse options that the estimator would not heed."""
    given = {
        "--channels": options.channels, "--no-prior": options.no_prior,
        "--ordinary": options.ordinary, "--output-error": options.output_error,
        "--jobs": options.jobs, "--dask": options.dask,
    }  # fmt: skip
    heeded = set() if live else {"--channels", "--no-prior", "--jobs", "--dask"}
    heeded |= {"--output-error"} if options.estimator == "ml" else set()
    heeded |= {"--ordinary"} if options.estimator in ("ls", "iv") else set()
    for name, value in given.items():
        if value and name not in heeded:
            raise UserError(f"{name} has no meaning with --estimator {options.estimator}")


class Tell(Protocol):
    """Says what is being done, and the share of it that is."""

    def __call__(self, what: str, share: float | None = None) -> None: ...


@contextlib.contextmanager
def _progress(options: argparse.Namespace) -> Iterator[Tell]:
    """A line and a bar on standard error; nothing with --quiet, or where nobody looks."""
    shown = ERR.is_terminal and not options.quiet
    with Progress(console=ERR, transient=True, disable=not shown) as progress:
        bar = progress.add_task("", total=None)

        def tell(what: str, share: float | None = None) -> None:
            total = None if share is None else 1.0
            progress.update(bar, description=what, completed=share or 0.0, total=total)

        yield tell


def _finite(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


def _write_json(path: Path | None, result: Mapping[str, object]) -> None:
    """The machine-readable result of a command, where it is wanted."""
    from rov_ident.fit import write_text

    if path:
        write_text(path, json.dumps(result, indent=2, allow_nan=False) + "\n")


def _check(options: argparse.Namespace) -> None:
    from rov_ident.check import check

    _check_outputs([options.json, options.report], [options.bag, options.config])
    config = configuration.load(options.config)
    with _progress(options) as tell:
        found = check(options.bag, config, tell)
        if options.report:
            from rov_ident.check_report import of_check
            from rov_ident.fit import write_text

            tell("drawing")
            write_text(options.report, of_check(found, config))
    _write_json(options.json, found.to_dict())
    verdict = "fit for identification" if found.fit else "not fit for identification"
    OUT.print(f"{found.bag}, {found.duration:.1f} s: {verdict}", markup=False)
    for remark in found.remarks:
        OUT.print(f"  {remark.level:<8} {remark.subject}: {remark.text}", markup=False)
    table = _table("what a fit of it would give", "configured", "std", "unit", "known")
    for p in found.prospects:
        known = {"well": "well", "roughly": "roughly", "not": "no: the prior decides"}[p.verdict]
        table.add_row(p.name, f"{p.value:.4g}", f"{p.std:.2g}", p.unit, known)
    OUT.print(table)


def _plan(options: argparse.Namespace) -> None:
    from rov_ident import archive
    from rov_ident.plan import Limits, propose

    outputs = [options.json, options.out, options.report]
    _check_outputs(outputs, [*options.bag, options.config])
    config = configuration.load(options.config)
    limits = Limits(options.tank, options.thrust)
    with _progress(options) as tell, contextlib.ExitStack() as stack:
        bags = None
        if options.bag:
            bags = stack.enter_context(
                archive.opened(
                    options.bag, config,
                    progress=lambda name, done, total: tell(f"read {name}", done / total),
                )
            )  # fmt: skip
        found = propose(config, bags, options.duration, limits, tell)
        if options.report:
            from rov_ident.check_report import of_plan
            from rov_ident.fit import write_text

            tell("drawing")
            write_text(options.report, of_plan(found, config))
    _write_json(options.json, found.to_dict())
    if options.out:
        from rov_ident.recording import write_messages

        write_messages(options.out, found.best.dive(config, seed=0).messages)
    OUT.print(found.sentence, markup=False, soft_wrap=True)
    table = _table("predicted standard deviations", "configured", "now", "after it", "unit")
    for before, after in zip(found.before, found.after):
        table.add_row(
            before.name, f"{before.value:.4g}", f"{before.std:.2g}", f"{after.std:.2g}", before.unit
        )
    OUT.print(table)


def _explain(options: argparse.Namespace) -> None:
    config = configuration.load(options.config)
    outputs = [options.out / name for name in ("findings.json", "report.html", "extended.yaml")]
    new = not options.out.exists()
    _check_outputs(outputs, [*options.bags, options.config, options.validate])
    try:
        _explained(options, config)
    except BaseException:
        with contextlib.suppress(OSError):
            if new:
                options.out.rmdir()  # which leaves what is not empty
        raise


def _explained(options: argparse.Namespace, config: configuration.Config) -> None:
    from rov_ident import explain_report
    from rov_ident.explain import BLOCK, explain

    with _progress(options) as tell:
        read = [_gather(path, config, tell) for path in options.bags]
        judge = _gather(options.validate, config, tell) if options.validate else None
        explanation = explain(
            [streams for streams, _ in read], config, judge[0] if judge else None, tell
        )
    made = explain_report.origin(
        [source for _, source in read], options.config, judge[1] if judge else None
    )
    findings = dataclasses.replace(explanation.findings, provenance=made)
    explanation = dataclasses.replace(explanation, findings=findings)
    explain_report.write(explanation, config, options.out)
    for note in findings.notes:
        ERR.print(note, markup=False, soft_wrap=True)

    OUT.print(explain_report.verdict(findings), markup=False)
    table = _table(
        f"RMSE of the {BLOCK:g} s open-loop prediction",
        "as configured", "retuned", "extended", "unit",
    )  # fmt: skip
    for name, unit in explain_report.UNITS.items():
        models = (findings.baseline, findings.retuned, findings.extended)
        table.add_row(name, *(explain_report.number(by[name]) for by in models), unit)
    OUT.print(table)
    for f in findings.effects:
        OUT.print(f"{f.effect}: {f.sentence}", markup=False)
        for name, value in f.parameters.items():
            OUT.print(f"  {explain_report.valued(name, value)}", markup=False)
        OUT.print(f"  gain {explain_report.interval(f.gain)}", markup=False)
        if f.alternatives:
            OUT.print("  tried instead:")
        for a in f.alternatives:
            OUT.print(f"    {a.effect}: {a.why_not}", markup=False)
    ERR.print(f"report: {options.out / 'report.html'}", markup=False, soft_wrap=True)


def _gather(path: Path, config: configuration.Config, tell: Tell) -> "tuple[Streams, Source]":
    """A bag's messages in arrays; damage is told on standard error."""
    from rov_ident import inputs
    from rov_ident.bags import Bag
    from rov_ident.explain_report import Source
    from rov_ident.streams import gather

    bag = Bag(path)
    topics = inputs.select(bag, config)
    total = inputs.total(bag, topics)
    tell(f"reading {path.name}")
    streams = gather(_shown(inputs.messages(bag, topics, config), total, path, tell), config)
    if bag.damage:
        ERR.print(bag.damage, markup=False, soft_wrap=True)
    return streams, Source(bag.path.name, bag.sha256)


def _shown(messages: Iterator[T], total: int, path: Path, tell: Tell) -> Iterator[T]:
    """The same, telling now and then how many there have been."""
    for done, message in enumerate(messages):
        if done % 2000 == 0:
            tell(f"reading {path.name}", done / total)
        yield message


def _check_outputs(outputs: Sequence[Path | None], inputs: Sequence[Path | None]) -> None:
    """Refuse, before any work, what could not be written or would replace what is read."""
    for out in filter(None, outputs):
        for source in filter(None, inputs):
            if out.exists() and source.exists() and out.samefile(source):
                raise UserError(f"{out} would be replaced by the result: choose another name")
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{out} cannot be written: {error.strerror}") from error
        if not os.access(out.parent, os.W_OK):
            raise UserError(f"{out} cannot be written: its folder is not yours to write in")


def _read(path: Path, config: configuration.Config, tell: Tell) -> "Record":
    """A bag's samples, and what had to be refused on standard error."""
    from rov_ident.records import read_record

    record = read_record(path, config, lambda k, n: tell(f"reading {path.name}", k / max(n, 1)))
    for note in record.notes:
        ERR.print(note, markup=False, soft_wrap=True)
    return record


def _simulate(options: argparse.Namespace) -> None:
    _check_outputs([options.out, options.json], [options.bag, options.config])
    config = configuration.load(options.config)
    if options.bag:
        _compare(config, options)
        return
    from rov_ident.recording import write_messages
    from rov_ident.sensors import Suite, dive

    suite = dataclasses.replace(
        Suite().scaled(options.noise),
        odometry_rate=options.odometry_rate,
        imu_rate=options.imu_rate,
        wrench_rate=options.wrench_rate,
        delay=options.delay,
        jitter=options.jitter,
        drop=options.drop,
    )
    with _progress(options) as tell:
        tell("simulating")
        run = dive(config, options.manoeuvre, options.duration, suite, options.seed)
        tell("writing")
        write_messages(options.out, run.messages)
    ERR.print(f"{options.out}: {len(run.messages)} messages, {options.duration:g} s")
    _write_json(options.json, {"messages": len(run.messages), "duration_s": options.duration})


def _compare(config: configuration.Config, options: argparse.Namespace) -> None:
    """Open-loop simulation of a whole bag beside what it measured."""
    from rov_ident.effects import compiled
    from rov_ident.recording import write_messages
    from rov_ident.records import HORIZON, VELOCITIES, predicted, score
    from rov_ident.sensors import odometry_of

    free = options.channels
    model, effects = config.dynamics, compiled(config.effects)
    with _progress(options) as tell:
        record = _read(options.bag, config, tell)
        tell("simulating")
        run = predicted(model, record.samples, math.inf, free, effects)
    if not np.isfinite(run).all():
        raise UserError(
            f"the simulation diverges on {options.bag}: check the signs and sizes of the "
            "coefficients and of the wrench"
        )
    write_messages(options.out, odometry_of(record.samples["t"], run))
    whole = score(model, record.samples, math.inf, free, effects)
    windows = score(model, record.samples, HORIZON, free, effects)
    chosen = [i for i in range(6) if free is None or free[i]]
    _write_json(
        options.json,
        {
            "bag": options.bag.name,
            "horizon_s": HORIZON,
            "velocities": {
                VELOCITIES[i]: {
                    "r2": _finite(whole.r2[i]),
                    "rmse": _finite(whole.rmse[i]),
                    "rmse_windows": _finite(windows.rmse[i]),
                    "unit": "m/s" if i < 3 else "rad/s",
                }
                for i in chosen
            },
        },
    )
    table = _table(
        f"open-loop simulation against {options.bag.name}",
        "R2, one run", "RMSE, one run", f"RMSE, {HORIZON:g} s windows", "unit",
    )  # fmt: skip
    for i in chosen:
        table.add_row(
            VELOCITIES[i], f"{whole.r2[i]:.3f}", f"{whole.rmse[i]:.4f}", f"{windows.rmse[i]:.4f}",
            "m/s" if i < 3 else "rad/s",
        )  # fmt: skip
    OUT.print(table)


def _import(options: argparse.Namespace) -> None:
    from rov_ident import ardupilot

    _check_outputs([options.out, options.json], [*options.log, options.config])
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
    with _progress(options) as tell:
        report = import_log(
            options.log[0], options.out, config, lambda share: tell(f"reading {name}", share)
        )
    for note in report.notes:
        ERR.print(note, markup=False, soft_wrap=True)
    ERR.print(
        f"{options.out}: {report.odometry} odometry, {report.imu} IMU and {report.wrench} wrench "
        f"messages, {report.duration:.1f} s"
    )
    _write_json(options.json, vars(report))


def _import_csv(options: argparse.Namespace) -> None:
    from rov_ident.importer import import_csv, parse_columns

    if options.config:
        raise UserError("--config is for ArduSub's logs: a CSV holds the wrench itself")
    with _progress(options) as tell:
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
    _write_json(options.json, vars(report))


def _export(options: argparse.Namespace) -> None:
    from rov_ident.fit import write_text
    from rov_ident.formats import export

    _check_outputs([options.out, options.json], [options.config])
    written = export(configuration.load(options.config), options.format)
    write_text(options.out, written.content)
    for what in written.lost:
        ERR.print(f"lost in {options.format}: {what}", markup=False, soft_wrap=True)
    ERR.print(f"written: {options.out}", markup=False, soft_wrap=True)
    _write_json(options.json, {"format": options.format, "lost": list(written.lost)})


def _import_model(options: argparse.Namespace) -> None:
    from rov_ident.formats import import_model

    _check_outputs([options.out, options.json], [options.file, options.config])
    base = configuration.load(options.config) if options.config else None
    config, notes = import_model(options.file, base)
    configuration.dump(config, options.out, comment=f"From {options.file.name}.")
    for note in notes:
        ERR.print(f"note: {note}", markup=False, soft_wrap=True)
    ERR.print(f"written: {options.out}", markup=False, soft_wrap=True)
    _write_json(options.json, {"name": config.name, "notes": list(notes)})


def _nomoto(options: argparse.Namespace) -> None:
    from rov_ident import nomoto, zigzag
    from rov_ident.fit import write_text

    _check_outputs([options.json, options.report], [*options.files, options.validate])
    runs = [zigzag.read(path) for path in options.files]
    judge = zigzag.read(options.validate) if options.validate else None
    with _progress(options) as tell:
        tell("fitting")
        model = nomoto.fit(
            runs, options.order, options.nonlinear, options.method, options.interpolate,
            options.step,
        )  # fmt: skip
    validation = nomoto.predict(model, judge)[1] if judge else None
    if options.json:
        write_text(options.json, nomoto.to_json(model, validation))
    if options.report:
        from rov_ident import table_reports

        others = nomoto.others(model, runs, options.interpolate, options.step)
        write_text(options.report, table_reports.steering(model, runs, judge, others))
    OUT.print(_numbers(f"Nomoto's model of order {model.order}, by {model.estimator}", model))
    OUT.print(f"heading RMSE {model.rmse:.4g} rad ({math.degrees(model.rmse):.3g} deg)")
    if judge and validation is not None:
        OUT.print(
            f"on {judge.name} {validation:.4g} rad ({math.degrees(validation):.3g} deg)",
            markup=False,
        )
    for note in model.notes:
        ERR.print(note, markup=False, soft_wrap=True)


def _forces(options: argparse.Namespace) -> None:
    from rov_ident import force_tables
    from rov_ident.added_mass import parse_hull
    from rov_ident.fit import write_text
    from rov_ident.importer import parse_columns

    _check_outputs([options.json, options.out, options.report], [options.table, options.config])
    if not options.config and (options.out or options.hull):
        raise UserError("--out and --hull need --config: the vehicle's mass, inertia and buoyancy")
    config = configuration.load(options.config) if options.config else None
    hull = parse_hull(options.hull) if options.hull else {}
    scale = options.nondimensional
    table = force_tables.read_table(
        options.table,
        parse_columns(options.map),
        force_tables.parse_nondimensional(scale) if scale else None,
        options.drift,
    )
    if config:
        config = force_tables.with_hull(config, hull)
    with _progress(options) as tell:
        tell("fitting")
        fits = force_tables.fit(table, config.model if config else None)
    notes = (*table.notes, *force_tables.remarks(fits, config is not None))
    new = force_tables.configured(config, fits) if config and options.out else None
    if options.json:
        write_text(options.json, force_tables.to_json(fits, notes))
    if options.report:
        from rov_ident import table_reports

        write_text(options.report, table_reports.forces(table.name, fits, notes))
    if new:
        configuration.dump(
            new, options.out, f"Coefficients from {options.table.name} by rov-ident forces."
        )
    for axis, f in fits.items():
        OUT.print(_numbers(f"{axis}: R2 {f.r2:.4f}", f))
        OUT.print(f"{axis}: {f.why}\n", markup=False)
    for note in notes:
        ERR.print(note, markup=False, soft_wrap=True)


def _steer(options: argparse.Namespace) -> None:
    from rov_ident import autopilot
    from rov_ident.fit import write_text

    _check_outputs([options.out, options.json], [options.config])
    if not abs(options.angle) <= 180.0:
        raise UserError(f"--angle {options.angle:g}: give degrees from -180 to 180")
    run = autopilot.manoeuvre(
        configuration.load(options.config).dynamics,
        options.manoeuvre,
        math.radians(options.angle),
        math.radians(options.switch) if options.switch else None,
        options.depth,
        options.duration,
        options.speed,
        autopilot.Servo(rate=math.radians(options.servo_rate)),
    )
    noise = math.radians(options.noise)
    write_text(options.out, autopilot.to_csv(run, options.sample, noise, options.seed))
    heading = np.degrees(run.angles[:, 2])
    OUT.print(
        f"{options.manoeuvre}: heading from {heading.min():.1f} to {heading.max():.1f} deg, depth "
        f"at the end {run.position[-1, 2]:.2f} m, speed {run.nu[-1, 0]:.2f} m/s"
    )
    result = {
        "manoeuvre": options.manoeuvre,
        "heading_deg": [float(heading.min()), float(heading.max())],
        "depth_m": float(run.position[-1, 2]),
        "speed_mps": float(run.nu[-1, 0]),
    }
    _write_json(options.json, result)


def _dashboard(options: argparse.Namespace) -> None:
    from rov_ident.nodes.dashboard_node import dashboard

    def announce(addresses: Mapping[str, str]) -> None:
        if options.json:
            print(json.dumps(dict(addresses)), flush=True)
            return
        for what, address in addresses.items():
            OUT.print(f"{what}: {address}")

    dashboard(options.port, options.foxglove, announce)


def _watch(options: argparse.Namespace) -> None:
    from rov_ident.nodes.watch_terminal import watch, watch_once

    if options.once:
        watch_once(options.wait, options.json, OUT)
    else:
        watch(options.json, OUT, ERR)


def _layouts(options: argparse.Namespace) -> None:
    from rov_ident import layouts
    from rov_ident.fit import write_text

    if not re.fullmatch(r"(/?[A-Za-z_]\w*)*/?", options.namespace):
        raise UserError(f"{options.namespace!r} is no namespace of ROS 2, such as rov1")
    config = configuration.load(options.config)
    for name, write in (
        ("foxglove.json", layouts.foxglove),
        ("plotjuggler.xml", layouts.plotjuggler),
    ):
        write_text(options.out / name, write(config, options.namespace))
        ERR.print(f"written: {options.out / name}")


def _coefficients(options: argparse.Namespace) -> None:
    entries = [(c.name, c.unit, c.meaning) for c in catalogue()]
    entries += [(c.name, c.unit, c.meaning) for c in fin_catalogue()]
    for name, unit, meaning in entries:
        OUT.print(f"{name:<10} {unit:<18} {meaning}", markup=False)
    table = {name: {"unit": unit, "meaning": meaning} for name, unit, meaning in entries}
    _write_json(options.json, table)


def _numbers(title: str, result: "Result", **more: Sequence[str]) -> Table:
    """The numbers of a result, with further columns of text (n,)."""
    table = _table(title, "value", "std", "unit", *more)
    for i, name in enumerate(result.names):
        value, std = f"{result.values[i]:.5g}", f"{result.std[i]:.2g}"
        table.add_row(name, value, std, result.units[i], *(column[i] for column in more.values()))
    return table


def _completion(options: argparse.Namespace) -> None:
    try:
        import shtab
    except ImportError as error:
        raise UserError("completion needs shtab: pip install shtab") from error
    parser = _parser()
    for command in (parser, *_commands(parser).values()):
        for action in command._actions:  # shtab, too, goes through them
            if action.type is Path:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, options.shell))


def _commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parser of every command, by name."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for column in columns:
        left = column in ("unit", "state", "identifiable")
        table.add_column(column, justify="left" if left else "right")
    return table


if __name__ == "__main__":
    sys.exit(main())
