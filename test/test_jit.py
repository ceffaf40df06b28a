"""How kernels are run: read from the cache, compiled, or interpreted."""

import subprocess
import sys

import numpy as np

from rov_ident.jit import interpret, interpreting, kernel, record, stop_interpreting

_ONLY_RUN = """
import sys
import rov_ident, numba
from rov_ident.jit import only_run
level = numba.config.OPT
only_run()
from rov_ident import config
config.load(sys.argv[1]).model.regressor([1.0] * 6, [1.0] * 6)
assert not [name for name in sys.modules if name.startswith("scipy.linalg")]
assert numba.config.OPT == level == 3
import scipy.linalg.cython_blas
"""


def test_who_only_runs_kernels_loads_no_linear_algebra(heavy_path):
    """It can all the same, later."""
    subprocess.run([sys.executable, "-c", _ONLY_RUN, heavy_path], check=True)


POINT = record([("x", "f8"), ("v", "f8", (2,))])


@kernel
def moved(points):
    for k in range(len(points)):
        point = points[k]
        point.x += point.v[0] / (point.v[1] - 1.0)


def test_interpreted_and_compiled_read_the_same_records():
    """Without an error for what is not finite."""
    ways = []
    for begin in (interpret, stop_interpreting):
        begin()
        try:
            points = np.zeros(2, dtype=POINT)
            points["v"] = [[1.0, 3.0], [1.0, 1.0]]
            moved(points)
            ways.append(points["x"].tolist())
        finally:
            stop_interpreting()
    assert ways == [[0.5, np.inf]] * 2
    assert not interpreting()
