"""`ukf_node`: the unscented Kalman filter on a live vehicle."""

import sys

from rov_ident.nodes.estimator_node import run


def main() -> int:
    return run("ukf")


if __name__ == "__main__":
    sys.exit(main())
