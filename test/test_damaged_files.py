"""Damaged files are read, or refused in one sentence: for some seconds (fuzz.py has hours)."""

import pytest
from tiers import more

from bench.studies import fuzz

ALL = len(fuzz.READERS) + len(fuzz.COMMANDS)
for_some_seconds = pytest.mark.parametrize("seconds", [6.0 / ALL, *more(20.0 / ALL)])


@for_some_seconds
@pytest.mark.parametrize("name", fuzz.READERS)
def test_readers(name, seconds, capfd):
    count, faults = fuzz.search(name, fuzz.read, seconds, 2_000)
    assert not faults and count >= len([*(fuzz.CORPUS / name).iterdir()])
    assert capfd.readouterr() == ("", "")


@for_some_seconds
@pytest.mark.parametrize("name", fuzz.COMMANDS)
def test_commands(name, seconds):
    count, faults = fuzz.search(name, fuzz.run, seconds, 500)
    assert not faults and count


def test_a_fault_is_found(monkeypatch):
    """One that only damage leads to."""
    monkeypatch.setitem(fuzz.READERS, "zigzag", lambda path: path.read_text("ascii"))
    count, faults = fuzz.search("zigzag", fuzz.read, 600.0, 500)
    assert count == 500 and any("UnicodeDecodeError" in what for what in faults)
