"""``python -m rov_ident``: the program ``rov-ident``."""

import sys

from rov_ident.cli import main

if __name__ == "__main__":
    sys.exit(main())
