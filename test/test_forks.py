"""Work divided between two processes."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from rov_ident.core import forks
from rov_ident.core.forks import divided


def _children():
    """Of this process, those that were not waited for, too."""
    with open(f"/proc/self/task/{os.getpid()}/children") as file:
        return file.read().split()


@pytest.fixture(autouse=True)
def two_processors(monkeypatch):
    """Also where there is one; and nothing is left running, or open, afterwards."""
    monkeypatch.setattr(forks, "_divided", False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    before = _children(), len(os.listdir("/proc/self/fd"))
    yield
    assert (_children(), len(os.listdir("/proc/self/fd"))) == before


def _slowly(x):
    time.sleep(0.05)
    return x, os.getpid()


def test_both_work_and_results_are_in_order():
    found = divided(_slowly, range(8))
    assert [x for x, _ in found] == list(range(8))
    assert len({process for _, process in found}) == 2


@pytest.mark.parametrize("things", [[], [1]])
def test_what_cannot_be_divided_is_not(things):
    assert divided(_slowly, things) == [(x, os.getpid()) for x in things]


def test_more_than_can_be_handed_out():
    assert divided(lambda x: x, range(1000)) == list(range(1000))


def test_inside_of_itself_it_is_one_process():
    def inside(x):
        return {process for _, process in divided(_slowly, range(3))} == {_slowly(x)[1]}

    assert divided(inside, range(4)) == [True] * 4


def test_what_is_known_is_no_copy():
    known, other = np.arange(3), np.arange(3)
    for mine, theirs, process in divided(
        lambda x: (known, other, _slowly(x)[1]), range(4), [known]
    ):
        assert mine is known
        assert (theirs is other) == (process == os.getpid())
        np.testing.assert_array_equal(theirs, other)


@pytest.mark.parametrize("here", [False, True])
def test_an_exception_is_raised_whoever_meets_it(here):
    us = os.getpid()

    def failing(x):
        if (_slowly(x)[1] == us) == here:
            raise ValueError("as in one process")
        return x

    with pytest.raises(ValueError, match="as in one process"):
        divided(failing, range(4))


def test_what_a_killed_process_had_taken_is_done_here():
    us = os.getpid()

    def killed(x):
        if _slowly(x)[1] != us:
            os.kill(os.getpid(), signal.SIGKILL)
        return x

    assert divided(killed, range(6)) == list(range(6))


def test_where_there_can_be_no_other_process(monkeypatch):
    def refused():
        raise BlockingIOError

    monkeypatch.setattr(os, "fork", refused)
    assert divided(_slowly, range(3)) == [(x, os.getpid()) for x in range(3)]


def test_an_interrupt_does_not_wait_for_the_other():
    us = os.getpid()

    def interrupted(_):
        if os.getpid() == us:
            time.sleep(0.2)
            raise KeyboardInterrupt
        time.sleep(60.0)

    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        divided(interrupted, range(4))
    assert time.monotonic() - begun < 10.0


def test_where_nobody_waits_for_children():
    """As some programs ask for: then they are gone at once."""
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        assert [x for x, _ in divided(_slowly, range(4))] == list(range(4))
    finally:
        signal.signal(signal.SIGCHLD, before)


def test_it_ends_with_its_parent(tmp_path):
    """Killed, a process leaves none that goes on with what was to be done, or waits to be heard."""
    code = (
        "import os, sys, time\n"
        "from rov_ident.core.forks import divided\n"
        "os.sched_getaffinity = lambda _: {0, 1}\n"
        "def work(x):\n"
        "    open(f'{sys.argv[1]}/{x} {os.getpid()}', 'w').close()\n"
        "    time.sleep(0.3)\n"
        "    return bytes(1_000_000)\n"  # more than a pipe holds
        "divided(work, range(200))\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, tmp_path]) as process:
        while len(list(tmp_path.iterdir())) < 4:
            assert process.poll() is None
            time.sleep(0.05)
        process.kill()
    (other,) = {int(p.name.split()[1]) for p in tmp_path.iterdir()} - {process.pid}
    end = time.monotonic() + 20.0
    while os.path.exists(f"/proc/{other}"):
        assert time.monotonic() < end
        time.sleep(0.05)
    assert len(list(tmp_path.iterdir())) < 200
