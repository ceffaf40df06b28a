"""What the simulation gets wrong, why, and what mending it gains."""

import argparse
import contextlib
from pathlib import Path

from rov_ident.cli.common import OUT, Commands, command, folder, progress, say, show


def add(commands: Commands) -> None:
    text = "what the simulation gets wrong, why, and what mending it gains"
    files = "findings.json report.html extended.yaml"
    explain = command(commands, "explain", text, _explain, "bags --config", files)
    explain.add_argument(
        "--out", required=True, type=folder, metavar="DIR",
        help="folder for findings.json, report.html and extended.yaml",
    )  # fmt: skip
    explain.add_argument(
        "--validate", type=Path, metavar="BAG", help="judge on this bag, not on held-out parts"
    )


def _explain(options: argparse.Namespace) -> None:
    new = not options.out.exists()
    try:
        _explained(options)
    except BaseException:
        with contextlib.suppress(OSError):
            if new:
                options.out.rmdir()  # which leaves what is not empty
        raise


def _explained(options: argparse.Namespace) -> None:
    from rov_ident.api.functions import explain
    from rov_ident.discrepancy import report

    with progress(options) as tell:
        explanation = explain(options.bags, options.config, options.validate, progress=tell)
    report.write(explanation, options.out)
    findings = explanation.findings
    OUT.print(explanation.sentence)
    show(explanation, findings.notes)
    for f in findings.effects:
        OUT.print(f"{f.effect}: {f.sentence}")
        OUT.print(f"  gain {report.interval(f.gain)}")
        if f.alternatives:
            OUT.print("  tried instead:")
        for a in f.alternatives:
            OUT.print(f"    {a.effect}: {a.why_not}")
    say(f"report: {options.out / 'report.html'}")
