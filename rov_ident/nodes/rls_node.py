"""`rls_node`: recursive least squares on a live vehicle."""

import sys

from rov_ident.nodes.estimator_node import run


def main() -> int:
    return run("rls")


if __name__ == "__main__":
    sys.exit(main())
