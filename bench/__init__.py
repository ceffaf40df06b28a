"""What is measured about the package: simulators that tests share, studies, tools.

Run from the root of the repository as modules: ``python -m bench.studies.accuracy``.
"""

import os
from pathlib import Path

from rov_ident.core.threads import limit_process

limit_process()  # as our programs do: what is measured is what they run

ROOT = Path(__file__).parents[1]
HEAVY = ROOT / "bench" / "bluerov2_heavy_known.yaml"
DEMO = ROOT / "bags" / "demo.mcap"
REMUS = ROOT / "config" / "remus100.yaml"
CONFIGS = sorted((ROOT / "config").glob("*.yaml"))
"""The shipped file of a BlueROV2 Heavy, said to be known in all that our simulators keep to."""
DATA = Path(os.environ.get("ROV_IDENT_DATA", ROOT.parent / "shared" / "data"))
"""Measured records that belong to others and are not part of the repository."""
