"""The program `rov-ident`, as tests run it: in this process, or as one of its own.

In this process its modules and kernels are loaded once for all tests. What it does is the same: it
gets its arguments, and what it says and its exit status come back. A process of its own shows what
only that has: signals, closed pipes, a terminal, the environment, memory.
"""

import contextlib
import io
import os
import subprocess
import sys
import warnings

from bench import ROOT
from rov_ident.cli import main
from rov_ident.experiment import closed_loop_manoeuvres
from rov_ident.io.bag_reader import Bag
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.topics import USUAL, messages, select


def few_manoeuvres(monkeypatch):
    """A plan chooses among three of eleven manoeuvres, the swing of all axes among them: where a
    test is not about the choice, in a third of the time."""
    library = closed_loop_manoeuvres.library
    monkeypatch.setattr(closed_loop_manoeuvres, "library", lambda limits: library(limits)[1::4])


_QUIET = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)


def _show(message, category, filename, lineno, file=None, line=None):
    sys.stderr.write(warnings.formatwarning(message, category, filename, lineno, line))


@contextlib.contextmanager
def _inside(folder):  # contextlib.chdir, which is of Python 3.11
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def run(*arguments, cwd="."):
    """The finished program, by a call of its main function."""
    words, out, err = list(map(str, arguments)), io.StringIO(), io.StringIO()
    with (
        _inside(cwd),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        warnings.catch_warnings(),
    ):
        # What Python would have said of them, on standard error.
        warnings.resetwarnings()
        for quiet in _QUIET:
            warnings.simplefilter("ignore", quiet)
        warnings.showwarning = _show
        try:
            status = main(words)
        except SystemExit as end:  # argparse
            status = end.code or 0
    return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())


def run_alone(*arguments, cwd=None):
    """The finished program, in a process of its own."""
    command = [sys.executable, "-m", "rov_ident", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=cwd)


def messages_in(path):
    """(role, message) of the usual topics of a bag, axes as on the wire."""
    bag = Bag(path)
    return messages(bag, select(bag, USUAL), USUAL)


def lay_out_shipped(folder, seconds):
    """The shipped bags and configurations, of the bag no more than so much of its beginning."""
    (folder / "config").symlink_to(ROOT / "config")
    (folder / "bags").mkdir()
    first = None
    with BagWriter(folder / "bags" / "demo.mcap") as writer:
        for raw in Bag(ROOT / "bags" / "demo.mcap").iter_raw():
            first = raw.log_time if first is None else first
            if raw.log_time - first < 1e9 * seconds:
                writer.write(raw.topic, raw.type_name, raw.log_time, raw.data)
