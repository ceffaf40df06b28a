"""``python -m rov_ident.nodes NAME``: a node as a program."""

import sys

from rov_ident.nodes import programs

if __name__ == "__main__":
    sys.exit(getattr(programs, sys.argv[1])())
