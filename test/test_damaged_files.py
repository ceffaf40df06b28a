"""Damaged files are read, or refused in one sentence: for twenty seconds (fuzz.py has hours)."""

import pytest

from bench.studies import fuzz

SECONDS = 20.0 / (len(fuzz.READERS) + len(fuzz.COMMANDS))


@pytest.mark.parametrize("name", fuzz.READERS)
def test_readers(name, capfd):
    count, faults = fuzz.search(name, fuzz.read, SECONDS, 2_000)
    assert not faults and count >= len([*(fuzz.CORPUS / name).iterdir()])
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", fuzz.COMMANDS)
def test_commands(name):
    count, faults = fuzz.search(name, fuzz.run, SECONDS, 500)
    assert not faults and count


def test_a_fault_is_found(monkeypatch):
    """One that only damage leads to."""
    monkeypatch.setitem(fuzz.READERS, "zigzag", lambda path: path.read_text("ascii"))
    count, faults = fuzz.search("zigzag", fuzz.read, 600.0, 500)
    assert count == 500 and any("UnicodeDecodeError" in what for what in faults)
