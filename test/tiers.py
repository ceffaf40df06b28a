"""The third tier: what `make studies` runs and `make test` leaves out."""

import pytest


def more(*values):
    """Further parameters of a test that the first ones show as well: more seeds, other vehicles."""
    return [
        pytest.param(*(v if isinstance(v, tuple) else (v,)), marks=pytest.mark.study)
        for v in values
    ]
