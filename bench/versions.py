"""The same bag under other Pythons and other numpys: how far apart are the coefficients?

    python bench/versions.py PYTHON ...

Each PYTHON is an interpreter whose environment has the dependencies of setup.py; the present one is
the yardstick. Exit status 1 where a coefficient differs by more than 1e-9 of itself.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
SECONDS = 30.0
BAR = 1e-9


def here() -> dict[str, object]:
    """Versions, and the values by estimator."""
    import numba

    from rov_ident import config as configuration
    from rov_ident.bags import Bag, read_messages, select_topics
    from rov_ident.online import ESTIMATORS, OnlineEstimator

    config = configuration.load(ROOT / "config" / "bluerov2_heavy_demo.yaml")
    bag = Bag(ROOT / "bags" / "demo.mcap")
    messages = [pair for pair in read_messages(bag, select_topics(bag)) if pair[1] is not None]
    end = messages[0][1].stamp + SECONDS * 1e9
    found = {}
    for kind in ESTIMATORS:
        online = OnlineEstimator(config, kind)
        for role, message in messages:
            if message.stamp < end:
                online.push(role, message)
        found[kind] = online.report().values.tolist()
    versions = f"Python {sys.version.split()[0]}, numpy {np.__version__}, numba {numba.__version__}"
    return {"versions": versions, "values": found}


def main() -> int:
    if sys.argv[1:] == ["--here"]:
        print(json.dumps(here()))
        return 0
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    mine, missed = here(), 0
    print(mine["versions"])
    for python in sys.argv[1:]:
        command = [python, __file__, "--here"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        other = json.loads(done.stdout)
        for kind, values in mine["values"].items():
            apart = np.max(np.abs(np.divide(other["values"][kind], values) - 1.0))
            missed += not apart <= BAR
            print(f"{other['versions']}, {kind}: {apart:.2g}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
