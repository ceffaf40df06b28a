"""A bag played into live nodes over DDS."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rov_ident.cli import common
from rov_ident.core.errors import UserError

if TYPE_CHECKING:
    from rov_ident.estimation.online import Report

_SHOWN_EVERY = 0.1  # s; nobody reads faster


def add(commands: common.Commands) -> None:
    text = "play a bag into live nodes over DDS and record what they publish"
    replay = common.command(commands, "replay", text, _replay, "bag --config --json", "bag")
    replay.add_argument("--estimator", choices=common.LIVE, action="append", help="default: both")
    replay.add_argument(
        "--rate",
        type=common.rate,
        default=1.0,
        help="speed; 0: as fast as the nodes follow (default 1)",
    )
    replay.add_argument("--out", type=Path, help="bag to write")


def _replay(options: argparse.Namespace) -> None:
    from rov_ident.core.states import State
    from rov_ident.nodes.conversions import for_json
    from rov_ident.nodes.replay import replay
    from rov_ident.reports.result import NORMAL
    from rov_ident.reports.table import PLUS_MINUS, Table, estimate

    estimators = options.estimator or common.LIVE
    with common.progress(options) as tell:
        tell("starting the nodes")

        def show(name: str, report: "Report") -> None:
            known, count = sum(s is State.CONVERGED for s in report.states), len(report.levels)
            tell(f"{name}: {known} of {count} coefficients have converged", known / count)

        result = replay(
            options.bag, options.config, estimators, options.rate, options.out, show, _SHOWN_EVERY
        )
    common.write_json(
        options.json,
        {
            "messages": result.messages,
            "seconds": result.seconds,
            "estimators": {name: for_json(report) for name, report in result.reports.items()},
        },
    )
    for name, report in result.reports.items():
        if not report.stamp:
            raise UserError(f"{options.bag}: {name} could not use any of its messages")
        columns = (report.names, report.values, report.std, report.units, report.messages)
        rows = [
            [coefficient, *estimate(value, NORMAL * std), unit, state]
            for coefficient, value, std, unit, state in zip(*columns, strict=True)
        ]
        head = ["", "value", PLUS_MINUS, "unit", "state"]
        common.OUT.print(Table(f"{name}, at the end of {options.bag}", head, rows, text=(3, 4)))
    common.say(*result.notes)
    common.say(f"{result.messages} messages in {result.seconds:.1f} s")
    if result.out:
        common.say(f"recorded: {result.out}")
