"""A bag played into live nodes over DDS."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rov_ident.commands.common import (
    ERR,
    LIVE,
    OUT,
    Commands,
    bag_and_config,
    check_outputs,
    json_option,
    new_table,
    progress,
    rate,
    write_json,
)
from rov_ident.errors import UserError

if TYPE_CHECKING:
    from rov_ident.online import Report


def add(commands: Commands) -> None:
    replay = commands.add_parser(
        "replay", help="play a bag into live nodes over DDS and record what they publish"
    )
    bag_and_config(replay)
    replay.add_argument("--estimator", choices=LIVE, action="append", help="default: both")
    replay.add_argument(
        "--rate", type=rate, default=1.0, help="speed; 0: as fast as the nodes follow (default 1)"
    )
    replay.add_argument("--out", type=Path, help="bag to write")
    json_option(replay)
    replay.set_defaults(run=_replay)


def _replay(options: argparse.Namespace) -> None:
    from rov_ident.nodes.replay import replay

    check_outputs([options.json], [options.bag, options.config])
    estimators = options.estimator or LIVE
    with progress(options) as tell:
        tell("starting the nodes")

        def show(name: str, report: "Report") -> None:
            known, count = sum(level == 0 for level in report.levels), len(report.levels)
            tell(f"{name}: {known} of {count} coefficients converged", known / count)

        result = replay(options.bag, options.config, estimators, options.rate, options.out, show)
    write_json(
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
        table = new_table(f"{name}, at the end of {options.bag}", "value", "std", "unit", "state")
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
