"""200 Hz on three topics: nothing is lost and memory stays; `make torture` has the whole hour."""

import pytest

from bench.studies import torture_live


@pytest.mark.study
@pytest.mark.parametrize("kind", ["rls", "ukf"])
def test_five_minutes(kind, domain):
    rows = list(torture_live.loaded(kind, 365.0, warm=4))  # buffers fill for four minutes
    lost, grown, _ = rows
    assert lost.met and grown.met, rows
