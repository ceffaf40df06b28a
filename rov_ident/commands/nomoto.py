"""K and T of Nomoto's steering model from zigzags."""

import argparse
import math
from pathlib import Path

from rov_ident.commands.common import (
    ERR,
    OUT,
    Commands,
    check_outputs,
    positive,
    progress,
    result_table,
)


def add(commands: Commands) -> None:
    nomoto = commands.add_parser("nomoto", help="K and T of Nomoto's steering model from zigzags")
    nomoto.add_argument(
        "files", nargs="+", type=Path, metavar="FILE",
        help="CSV (t_s, heading_rad or heading_deg, rudder_rad or rudder_deg) or bag",
    )  # fmt: skip
    nomoto.add_argument(
        "--config", type=Path, help="says the types, topics and axes of a bag (inputs, frames)"
    )
    nomoto.add_argument("--order", type=int, choices=(1, 2), default=1, help="of the model (1)")
    nomoto.add_argument("--nonlinear", action="store_true", help="with Norrbin's cubic term")
    nomoto.add_argument(
        "--interpolate", choices=("none", "spline", "spiral"), default="none",
        help="densify sparse headings before the fit (default none)",
    )  # fmt: skip
    nomoto.add_argument(
        "--step", type=positive, metavar="S",
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


def _nomoto(options: argparse.Namespace) -> None:
    from rov_ident import config as configuration
    from rov_ident import nomoto, zigzag
    from rov_ident.fit import write_text

    check_outputs(
        [options.json, options.report], [*options.files, options.validate, options.config]
    )
    config = configuration.load(options.config) if options.config else None
    runs = [zigzag.read(path, config) for path in options.files]
    judge = zigzag.read(options.validate, config) if options.validate else None
    with progress(options) as tell:
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
    OUT.print(result_table(f"Nomoto's model of order {model.order}, by {model.estimator}", model))
    OUT.print(f"heading RMSE {model.rmse:.4g} rad ({math.degrees(model.rmse):.3g} deg)")
    if judge and validation is not None:
        OUT.print(
            f"on {judge.name} {validation:.4g} rad ({math.degrees(validation):.3g} deg)",
            markup=False,
        )
    for note in model.notes:
        ERR.print(note, markup=False, soft_wrap=True)
