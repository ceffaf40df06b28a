"""Is this bag fit for identification?"""

import argparse
from pathlib import Path

from rov_ident import config as configuration
from rov_ident.commands.common import (
    OUT,
    Commands,
    bag_and_config,
    check_outputs,
    new_table,
    progress,
    write_json,
)


def add(commands: Commands) -> None:
    check = commands.add_parser(
        "check", help="is this bag fit for identification, and what would it tell"
    )
    bag_and_config(check)
    check.add_argument("--json", type=Path, help="write what was found here")
    check.add_argument("--report", type=Path, metavar="FILE", help="write a page with pictures")
    check.set_defaults(run=_check)


def _check(options: argparse.Namespace) -> None:
    from rov_ident.check import check

    check_outputs([options.json, options.report], [options.bag, options.config])
    config = configuration.load(options.config)
    with progress(options) as tell:
        found = check(options.bag, config, tell)
        if options.report:
            from rov_ident.check_report import of_check
            from rov_ident.fit import write_text

            tell("drawing")
            write_text(options.report, of_check(found, config))
    write_json(options.json, found.to_dict())
    verdict = "fit for identification" if found.fit else "not fit for identification"
    OUT.print(f"{found.bag}, {found.duration:.1f} s: {verdict}", markup=False)
    for remark in found.remarks:
        OUT.print(f"  {remark.level:<8} {remark.subject}: {remark.text}", markup=False)
    table = new_table("what a fit of it would give", "configured", "std", "unit", "known")
    for p in found.prospects:
        known = {"well": "well", "roughly": "roughly", "not": "no: the prior decides"}[p.verdict]
        table.add_row(p.name, f"{p.value:.4g}", f"{p.std:.2g}", p.unit, known)
    OUT.print(table)
