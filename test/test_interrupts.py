"""SIGINT and SIGTERM while a program loads its modules, while it works, and as it ends."""

import contextlib
import signal
import subprocess
import sys
import time

import pytest
from rich.console import Console

from bench import HEAVY, ROOT
from rov_ident.core.interrupts import Interrupted
from rov_ident.dashboard.store import Store
from rov_ident.nodes import watch_terminal

NUMBERS = (signal.SIGINT, signal.SIGTERM)
# Runs a program, and has it interrupted in the middle of loading a module.
PROGRAM = """if True:
    import os, sys
    number, module, place, function = sys.argv[1:5]
    sys.argv[1:5] = []

    class Finder:
        def find_spec(self, name, *_):
            if name == module:
                sys.meta_path.remove(self)
                os.kill(os.getpid(), int(number))

    def program():
        sys.meta_path.insert(0, Finder())
        return getattr(__import__(place, fromlist=[function]), function)()
"""


def interrupted_at(module, number, place, function, *arguments):
    program = f"{PROGRAM}\n    sys.exit(program())"
    command = [sys.executable, "-c", program, str(int(number)), module, place, function]
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=600)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    "module, number",
    list(zip(("rich", "rov_ident.cli.fit", "numpy", "mcap", "scipy.linalg", "numba"), NUMBERS * 3)),
)
def test_a_command_that_is_loading(module, number):
    check = "check", str(ROOT / "bags" / "demo.mcap"), "--config", str(HEAVY)
    assert interrupted_at(module, number, "rov_ident.cli", "main", *check) == (
        128 + number, "interrupted\n",
    )  # fmt: skip


@pytest.mark.parametrize(
    "name, module, number",
    list(
        zip(
            ("rls_node", "ukf_node", "rls_node", "dashboard_node"),
            ("numpy", "rclpy", "numba", "rov_ident.nodes.parameters"),
            NUMBERS * 2,
        )
    ),
)
def test_a_node_that_is_loading(name, module, number):
    assert interrupted_at(module, number, "rov_ident.nodes.programs", name) == (0, "")


@pytest.mark.parametrize("number", NUMBERS)
def test_what_would_be_lost_waits(number):
    """An exception in a finaliser is shown and forgotten; one in an import may be caught there."""
    program = f"""if True:
        import os, sys, time
        from rov_ident.core.interrupts import Interrupted, raise_interrupts
        class Finalised:
            def __del__(self):
                os.kill(os.getpid(), {number:d})
                time.sleep(0.1)
        class Finder:
            def find_spec(self, name, *_):
                os.kill(os.getpid(), {number:d})
                time.sleep(0.1)
        raise_interrupts()
        for lost in Finalised, lambda: __import__("no_such_module"):
            try:
                sys.meta_path.insert(0, Finder())
                try:
                    lost()
                except ImportError:
                    pass
                sys.meta_path.pop(0)
                time.sleep(60.0)
            except Interrupted as error:
                print(error.status)
    """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=600)
    assert done.stdout.split() == [str(128 + number).encode()] * 2
    assert done.stderr == b""


@pytest.mark.parametrize("number", NUMBERS)
def test_an_object_in_the_making_goes_silently(number):
    """The compiler's (llvmlite) close in their finalisers what they open as they are made."""
    program = f"""if True:
        import os
        from rov_ident.core.interrupts import Interrupted, raise_interrupts
        class HalfMade:
            def __init__(self):
                os.kill(os.getpid(), {number:d})
                self.opened = True
            def __del__(self):
                del self.opened
        raise_interrupts()
        try:
            HalfMade()
        except Interrupted as error:
            print(error.status)
    """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=600)
    assert (done.stdout.split(), done.stderr) == ([str(128 + number).encode()], b"")


@pytest.mark.parametrize("number", NUMBERS)
def test_a_file_in_the_making_goes(tmp_path, number):
    program = f"""if True:
        import os
        from pathlib import Path
        from rov_ident.core.files import write_file
        from rov_ident.core.interrupts import raise_interrupts
        raise_interrupts()
        os.fsync = lambda _: os.kill(os.getpid(), {number:d})
        write_file({str(tmp_path / "result")!r}, "content")
    """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=600)
    assert b"Interrupted" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_look_at_the_nodes_is_no_answer(monkeypatch):
    """`watch --once` had status 0 and printed nothing, before any node was heard."""

    @contextlib.contextmanager
    def interrupted():
        yield Store(time.monotonic), time.sleep, [signal.SIGINT]

    monkeypatch.setattr(watch_terminal, "_listening", interrupted)
    with pytest.raises(Interrupted) as raised:
        watch_terminal.watch_once(10.0, True, Console())
    assert raised.value.status == 130
