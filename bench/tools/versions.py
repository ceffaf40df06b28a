"""The same bag under other Pythons, numpys and numbas: how far apart are the coefficients?

    python bench/tools/versions.py PYTHON ...

Each PYTHON is an interpreter whose environment has the dependencies of setup.py; the present one is
the yardstick. Exit status 1 where a coefficient differs by more than 1e-9 of itself. As in a node,
the first messages are interpreted: `core/jit.py` uses numba's insides for that, which a new version
may change. setup.py allows the minors of numba with which this was run (docs/trust.md).
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
SECONDS = 30.0
INTERPRETED = 500  # messages
BAR = 1e-9


def here() -> dict[str, object]:
    """Versions, and the values by estimator."""
    import numba

    from rov_ident import config as configuration
    from rov_ident.core import jit
    from rov_ident.estimation.online import ESTIMATORS, OnlineEstimator
    from rov_ident.io.bag_reader import Bag
    from rov_ident.io.topics import messages, select

    jit.only_run()
    config = configuration.load(ROOT / "config" / "bluerov2_heavy_demo.yaml")
    bag = Bag(ROOT / "bags" / "demo.mcap")
    dive = list(messages(bag, select(bag, config), config))
    end = dive[0][1].stamp + SECONDS * 1e9
    found = {}
    for kind in ESTIMATORS:
        jit.interpret()
        online = OnlineEstimator(config, kind)
        for k, (role, message) in enumerate(dive):
            if k == INTERPRETED:
                jit.stop_interpreting()
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
