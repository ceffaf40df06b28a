"""What the simulation gets wrong, why, and what mending it gains."""

import argparse
import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from rov_ident import config as configuration
from rov_ident.commands.common import (
    BAG,
    CONFIG,
    ERR,
    OUT,
    Commands,
    Tell,
    check_outputs,
    counted,
    new_table,
    progress,
)

if TYPE_CHECKING:
    from rov_ident.explain_report import Source
    from rov_ident.streams import Streams


def add(commands: Commands) -> None:
    explain = commands.add_parser(
        "explain", help="what the simulation gets wrong, why, and what mending it gains"
    )
    explain.add_argument("bags", nargs="+", type=Path, metavar="BAG", help=BAG)
    explain.add_argument("--config", required=True, type=Path, help=CONFIG)
    explain.add_argument(
        "--out", required=True, type=Path, metavar="DIR",
        help="folder for findings.json, report.html and extended.yaml",
    )  # fmt: skip
    explain.add_argument(
        "--validate", type=Path, metavar="BAG", help="judge on this bag, not on held-out parts"
    )
    explain.set_defaults(run=_explain)


def _explain(options: argparse.Namespace) -> None:
    config = configuration.load(options.config)
    outputs = [options.out / name for name in ("findings.json", "report.html", "extended.yaml")]
    new = not options.out.exists()
    check_outputs(outputs, [*options.bags, options.config, options.validate])
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

    with progress(options) as tell:
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
    table = new_table(
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
    streams = gather(counted(inputs.messages(bag, topics, config), total, path, tell), config)
    if bag.damage:
        ERR.print(bag.damage, markup=False, soft_wrap=True)
    return streams, Source(bag.path.name, bag.sha256)
