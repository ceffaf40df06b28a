"""Fixtures, and the tiers of the tests.

`make test` runs everything but `study`, which the tests themselves say of some parameters
(tiers.py). `make quick` also leaves out what is marked here: `dds` and `process` by what a test
uses, `slow` by slow.txt, which `make tiers` measures anew.
"""

import contextlib
import fcntl
import gc
import itertools
import os
import signal
import tempfile
from collections import Counter, defaultdict, deque
from pathlib import Path

import hypothesis
import pytest

from bench import HEAVY
from bench.simulators.live import children, compile_all, end_node, start_connected
from rov_ident import config
from rov_ident.core import forks
from rov_ident.simulation import virtual_sensors as sensors

# A computer that is busy with something else makes no test fail.
hypothesis.settings.register_profile(
    "patient", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.register_profile(
    "quick", hypothesis.settings.get_profile("patient"), max_examples=20
)
hypothesis.settings.load_profile("patient")


# Workers share the processors already, and what a fork does to a test's own lists is not seen:
# programs that tests start do fork, and the tests of forks.
forks._divided = True


# ------------------------------------------------------------------ tiers


SLOW = Path(__file__).with_name("slow.txt")
QUICK = 90.0  # s of processor for `make quick`: 45 s on two cores; to start and collect takes 15 s


def _function(nodeid):
    """What a line of slow.txt names: a test with all its parameters."""
    return Path(nodeid.partition("[")[0]).name


def pytest_addoption(parser):
    parser.addoption("--find-slow", action="store_true", help="write slow.txt anew (all tests)")


def pytest_collection_modifyitems(items):
    slow = set(SLOW.read_text().split())
    for item in items:
        if {_function(item.nodeid), item.path.name} & slow:
            item.add_marker("slow")
        names = getattr(item.function, "__code__", None) and item.function.__code__.co_names
        if "domain" in item.fixturenames:
            item.add_marker("dds")
        elif "compiled" in item.fixturenames or {"subprocess", "run_alone"} & set(names or ()):
            item.add_marker("process")


def _processor():
    """Seconds of processor that this process and its children that have ended have taken."""
    return sum(os.times()[:4])


_seen = [_processor()]
_made: dict[str, float] = {}  # seconds of processor for what is shared, made since the last report


def _is_shared(fixture):
    return fixture.scope != "function"


def _name(fixture):
    return f"{fixture.baseid}::{fixture.argname}"


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef):
    begun = _processor()
    result = yield
    if _is_shared(fixturedef):
        _made[_name(fixturedef)] = _processor() - begun
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    """Each report says what its phase took of the processor, however busy the computer is; apart
    from that, what took the fixtures that its test shares with others, where they were made."""
    report = yield
    now = _processor()
    report.processor = now - _seen[0] - sum(_made.values())
    report.made = dict(_made)
    used = [found[-1] for found in item._fixtureinfo.name2fixturedefs.values()]
    report.uses = [_name(fixture) for fixture in used if _is_shared(fixture)]
    _seen[0] = now
    _made.clear()
    return report


def pytest_terminal_summary(config):
    """Of the tests that start nothing, the quickest stay in the quick tier, up to its budget."""
    if not config.option.find_slow:
        return
    spent, made, uses = Counter(), Counter(), defaultdict(set)
    stats = config.pluginmanager.get_plugin("terminalreporter").stats
    for report in itertools.chain(*stats.values()):
        if isinstance(report, pytest.TestReport):
            made |= report.made
            if not {"dds", "process"} & set(report.keywords):
                spent[_function(report.nodeid)] += report.processor
                uses[_function(report.nodeid)] |= set(report.uses)
    slow, total, there = [], 0.0, set()
    for name in sorted(spent, key=lambda n: spent[n] + sum(made[f] for f in uses[n])):
        total += spent[name] + sum(made[f] for f in uses[name] - there)
        there |= uses[name]
        slow += [name] * (total > QUICK)
    SLOW.write_text("\n".join(sorted(slow)) + "\n")


# ------------------------------------------------------------------ vehicles


@pytest.fixture(scope="session")
def heavy():
    return config.load(HEAVY)


@pytest.fixture
def heavy_path():
    return HEAVY


@pytest.fixture(scope="session")
def short_dive(heavy):
    """Ten seconds of messages: (arrival, role, message)."""
    return sensors.dive(heavy, duration=10.0, seed=1).messages


# ------------------------------------------------------------------ processes and nodes


@pytest.fixture(scope="session")
def compiled():
    """All that a node runs is compiled, once for all workers, before the first test.

    How long that takes depends on what else the computer does: no test of a node waits for it.
    """


def pytest_collection_finish(session):
    """Compile what nodes run before the workers start; core/jit.py says why."""
    wanted = any("compiled" in getattr(item, "fixturenames", ()) for item in session.items)
    if wanted and not session.config.option.collectonly:
        compile_all(offline=True)


def pytest_runtestloop():
    """What is loaded by now stays: to search it for garbage again and again takes 6 % of a run."""
    gc.collect()
    gc.freeze()
    _seen[0] = _processor()  # to start, collect and compile is no test's


# Workers begin far from each other: what one has just left, another should not take up.
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
_DOMAINS = itertools.cycle(range(10, 100))
for _ in range((os.getppid() + 30 * _WORKER) % 90):
    next(_DOMAINS)
_LEFT = deque(maxlen=12)  # the locks of domains in which a participant may still seem to live


@pytest.fixture
def domain(monkeypatch, compiled):
    """A DDS domain that no other test of this computer uses, seen by nobody on the network."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for number in _DOMAINS:  # a new one each time: the last test's may not have gone yet
        lock = open(Path(tempfile.gettempdir()) / f"rov_ident_domain_{number}", "a")  # noqa: SIM115
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        before = set(children(os.getpid()))
        yield number
        for pid in set(children(os.getpid())) - before:
            with contextlib.suppress(OSError):  # it may have ended by now
                if b"rov_ident" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    os.kill(pid, signal.SIGKILL)  # else it would be heard by the next one there
        _LEFT.append(lock)  # the oldest is closed
        return


@pytest.fixture
def live(domain):
    """Starts a node; gives the vehicle that is connected to it. In the end both must end well."""
    started = []

    def start(*options, estimator="rls", parameters=HEAVY, **kwargs):
        started.append(start_connected(estimator, *options, parameters=parameters, **kwargs))
        vehicle = started[-1][1]
        vehicle.diagnostics.clear()
        return vehicle

    yield start
    for process, vehicle in started:
        vehicle.close()
        status, said = end_node(process)
        assert status == 0, said
        assert "Traceback" not in said
