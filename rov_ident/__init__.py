"""Identify the hydrodynamic coefficients of a marine vehicle while it moves, and from its records.

Everything in this package outside ``nodes`` is free of ROS; ARCHITECTURE.md shows the rooms.
"""

import os

# One thread for BLAS, said before numpy is loaded: the matrices are 30 x 30, over which a second
# one only waits, at full load; and a node shares its computer with a pilot's.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
