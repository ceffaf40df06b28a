"""K and T of Nomoto's steering model from zigzags."""

import argparse
import dataclasses
import math
from pathlib import Path

from rov_ident.cli.common import OUT, Commands, command, positive, progress, say
from rov_ident.core.errors import UserError
from rov_ident.core.files import write_file


def add(commands: Commands) -> None:
    text = "K and T of Nomoto's steering model from zigzags"
    nomoto = command(commands, "nomoto", text, _nomoto, "--json --report")
    nomoto.add_argument(
        "files", nargs="+", type=Path, metavar="FILE",
        help="CSV (t_s, heading_rad or heading_deg, rudder_rad or rudder_deg) or bag",
    )  # fmt: skip
    nomoto.add_argument(
        "--config", type=Path, help="says the types, topics and axes of a bag (inputs, frames)"
    )
    nomoto.add_argument(
        "--measured", action="store_true",
        help="the rudder of a bag is a measured angle, linear between its messages (default: a "
        "command, held until the next one)",
    )  # fmt: skip
    nomoto.add_argument(
        "--order", choices=("auto", "1", "2"), default="auto",
        help="of the model (auto: what predicts parts of the runs left out)",
    )  # fmt: skip
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
        "--method", choices=("oe", "fd", "iv", "rls", "ukf"), default="oe",
        help="output error (default), forward differences, instruments, recursive, Kalman filter",
    )  # fmt: skip
    nomoto.add_argument("--validate", type=Path, metavar="FILE", help="predict this run as well")


def _nomoto(options: argparse.Namespace) -> None:
    from rov_ident import config as configuration
    from rov_ident.api.reading import once, several
    from rov_ident.steering import nomoto, nomoto_model, zigzag

    config = configuration.load(options.config) if options.config else None
    measured = options.measured
    paths, repeated = once(several(options.files))
    runs = [zigzag.read(path, config, measured) for path in paths]
    judge = zigzag.read(options.validate, config, measured) if options.validate else None
    with progress(options) as tell:
        tell("fitting")
        model = nomoto.fit(
            runs, options.order if options.order == "auto" else int(options.order),
            options.nonlinear, options.method, options.interpolate, options.step,
        )  # fmt: skip
    model = dataclasses.replace(model, notes=(*repeated, *model.notes))
    validation = nomoto_model.predict(model, judge)[1] if judge else None
    diverges = judge is not None and nomoto.diverges(model, judge)
    if options.json:
        write_file(options.json, nomoto_model.to_json(model, validation, diverges))
    if options.report:
        from rov_ident.steering.report import page

        others = nomoto.others(model, runs, options.interpolate, options.step)
        write_file(options.report, page(model, runs, judge, others))
    OUT.print(model.numbers(f"Nomoto's model of order {model.order}, by {model.estimator}"))
    OUT.print(f"heading RMSE {model.rmse:.4g} rad ({math.degrees(model.rmse):.3g} deg)")
    if judge and validation is not None:
        OUT.print(f"on {judge.name} {validation:.4g} rad ({math.degrees(validation):.3g} deg)")
    for order, error in model.cross_validation.items():
        OUT.print(f"parts left out, predicted with order {order}: {math.degrees(error):.3g} deg")
    say(*model.notes, *(judge.notes if judge else ()))
    if judge and diverges:
        raise UserError(
            f"the prediction of {judge.name} diverges: its RMSE is larger than all that the "
            "heading moves in the run; fit more runs like it, or another order, and do not use "
            "this model there"
        )
