"""The manoeuvre to run next."""

import argparse
from pathlib import Path

from rov_ident.cli import common


def add(commands: common.Commands) -> None:
    text = "the manoeuvre to run next: safe, and best for the worst known coefficient"
    plan = common.command(commands, "plan", text, _plan, "--config --json --report", "bag")
    plan.add_argument(
        "--bag", type=Path, nargs="+", default=[], help="what has been recorded already"
    )
    plan.add_argument("--duration", type=common.positive, default=60.0, help="s (60)")
    plan.add_argument(
        "--tank", type=common.box, default=(6.0, 6.0, 2.0), metavar="L,W,D",
        help="m; of free water about the start: length, width, depth (6,6,2)",
    )  # fmt: skip
    plan.add_argument(
        "--thrust", type=common.positive, default=1.0,
        help="the largest wrench on each axis, relative to what holds working speed (1)",
    )  # fmt: skip
    plan.add_argument("--out", type=Path, metavar="BAG", help="write the simulated manoeuvre here")


def _plan(options: argparse.Namespace) -> None:
    from rov_ident.api.functions import plan
    from rov_ident.io.write_messages import unlike_inputs, write_messages

    limits = {name: getattr(options, name) for name in ("duration", "tank", "thrust")}
    with common.progress(options) as tell:
        found = plan(options.config, options.bag or None, **limits, progress=tell)
        common.write_result(found, options, tell)
    if options.out:
        write_messages(options.out, found.best.dive(found.config, seed=0).messages)
    common.OUT.print(found.sentence)
    common.show(found, (*found.notes, *(unlike_inputs(found.config) if options.out else ())))
