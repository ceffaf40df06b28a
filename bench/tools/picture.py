"""The picture of `explain` in the README: a report on a bag with hidden effects.

python -m bench.tools.picture [--seed N] [--out FILE]
"""

import argparse
from pathlib import Path

from bench.simulators.hidden import draw
from rov_ident.discrepancy.explain import explain
from rov_ident.discrepancy.report import picture
from rov_ident.reports import plots
from rov_ident.sampling.raw_streams import gather

HIDDEN = ("thruster_lag", "quadratic_damping")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/images/explain.png"))
    options = parser.parse_args()
    case = draw(options.seed, HIDDEN)
    streams = gather(((role, message) for _, role, message in case.messages), case.config)
    explanation = explain([streams], case.config)
    options.out.write_bytes(plots.to_png(picture(explanation)))
    for name, values in case.effects.items():
        print(name, {k: round(v, 4) for k, v in values.items()})
    for finding in explanation.findings.effects:
        print(finding.sentence)


if __name__ == "__main__":
    main()
