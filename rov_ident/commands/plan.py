"""The manoeuvre to run next."""

import argparse
import contextlib
from pathlib import Path

from rov_ident import config as configuration
from rov_ident.commands.common import (
    CONFIG,
    OUT,
    Commands,
    box,
    check_outputs,
    new_table,
    positive,
    progress,
    write_json,
)


def add(commands: Commands) -> None:
    plan = commands.add_parser(
        "plan", help="the manoeuvre to run next: safe, and best for the worst known coefficient"
    )
    plan.add_argument("--config", required=True, type=Path, help=CONFIG)
    plan.add_argument(
        "--bag", type=Path, nargs="+", default=[], help="what has been recorded already"
    )
    plan.add_argument("--duration", type=positive, default=60.0, help="s (60)")
    plan.add_argument(
        "--tank",
        type=box,
        default=(6.0, 6.0, 2.0),
        metavar="L,W,D",
        help="m; of free water about the start: length, width, depth (6,6,2)",
    )
    plan.add_argument(
        "--thrust",
        type=positive,
        default=1.0,
        help="the largest wrench on each axis, relative to what holds working speed (1)",
    )
    plan.add_argument("--json", type=Path, help="write the plan here")
    plan.add_argument("--report", type=Path, metavar="FILE", help="write a page with pictures")
    plan.add_argument("--out", type=Path, metavar="BAG", help="write the simulated manoeuvre here")
    plan.set_defaults(run=_plan)


def _plan(options: argparse.Namespace) -> None:
    from rov_ident import archive
    from rov_ident.plan import Limits, propose

    outputs = [options.json, options.out, options.report]
    check_outputs(outputs, [*options.bag, options.config])
    config = configuration.load(options.config)
    limits = Limits(options.tank, options.thrust)
    with progress(options) as tell, contextlib.ExitStack() as stack:
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
    write_json(options.json, found.to_dict())
    if options.out:
        from rov_ident.recording import write_messages

        write_messages(options.out, found.best.dive(config, seed=0).messages)
    OUT.print(found.sentence, markup=False, soft_wrap=True)
    table = new_table("predicted standard deviations", "configured", "now", "after it", "unit")
    for before, after in zip(found.before, found.after):
        table.add_row(
            before.name, f"{before.value:.4g}", f"{before.std:.2g}", f"{after.std:.2g}", before.unit
        )
    OUT.print(table)
