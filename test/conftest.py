"""Live nodes in processes of their own, and a vehicle at the other end of their topics."""

import contextlib
import fcntl
import itertools
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from pathlib import Path

import pytest

from rov_ident import config, sensors

HEAVY = Path(__file__).parent.parent / "config" / "bluerov2_heavy.yaml"


@pytest.fixture(scope="session")
def heavy():
    return config.load(HEAVY)


@pytest.fixture(scope="session")
def short_dive(heavy):
    """Ten seconds of messages: (arrival, role, message)."""
    return sensors.dive(heavy, duration=10.0, seed=1).messages


# Workers begin far from each other: what one has just left, another should not take up.
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
_DOMAINS = itertools.cycle(range(10, 100))
for _ in range((os.getppid() + 45 * _WORKER) % 90):
    next(_DOMAINS)
_LEFT = deque(maxlen=12)  # the locks of domains in which a participant may still seem to live


_COMPILE = f"""
from rov_ident import config, watch
from rov_ident.warm import warm_up
for estimator in ("rls", "ukf"):
    warm_up(config.load({str(HEAVY)!r}), estimator)
watch.compile_all()
"""


@pytest.fixture(scope="session")
def compiled():
    """All that a node runs is compiled, once for all workers, before the first test.

    How long that takes depends on what else the computer does: no test of a node waits for it.
    """


def pytest_collection_finish(session):
    """Compile what nodes run before the workers start; rov_ident/warm.py says why not in them."""
    wanted = any("compiled" in getattr(item, "fixturenames", ()) for item in session.items)
    if wanted and not session.config.option.collectonly:
        compile_all()


def compile_all():
    """All that a node runs, once for all who ask for it."""
    import numba

    from rov_ident import jit  # noqa: F401 - says where the cache is

    with open(Path(numba.config.CACHE_DIR) / "lock", "a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        subprocess.run([sys.executable, "-c", _COMPILE], check=True)


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


_CHUNK = 50  # messages
_AHEAD = 1.0  # s; that the messages published may be ahead of the samples used
_PATIENCE = 0.2  # s a chunk; not all messages make samples


def in_pace(messages, used, listen, ahead=_AHEAD, patience=_PATIENCE):
    """The (arrival, role, message), never many more than the nodes have used.

    Fast DDS has 512 messages in shared memory for a process that has no processor for a while. What
    is lost beyond them is sent again, but seconds after what was sent behind it, which is too late.
    ``used()`` gives the stamp [ns] of the last sample that all nodes have used; ``listen(seconds)``
    waits for news of it.
    """
    for k, (arrival, role, message) in enumerate(messages, 1):
        yield arrival, role, message
        if k % _CHUNK == 0:
            end = time.monotonic() + patience
            while message.stamp - used() > ahead * 1e9 and time.monotonic() < end:
                listen(0.01)


class Vehicle:
    """Publishes the inputs of a node and keeps everything that the node publishes."""

    def __init__(self, estimator="rls", roles=("odom", "imu", "wrench")):
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import WrenchStamped
        from rclpy.signals import SignalHandlerOptions
        from std_msgs.msg import Float64MultiArray

        from rov_ident.nodes.common import INPUTS, LATCHED, STREAM, Executor

        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("vehicle", context=self.context)
        self.executor = Executor(context=self.context)
        self.executor.add_node(self.node)
        self.estimator = estimator
        self.publishers = {
            role: self.node.create_publisher(type_, name, STREAM)
            for role, (name, type_) in INPUTS.items()
            if role in roles
        }
        self.coefficients, self.values, self.covariance = [], [], []
        self.residuals, self.diagnostics = [], []
        name = f"/{estimator}_node"
        for topic, type_, qos, heard in (
            (f"{name}/coefficients", DiagnosticArray, LATCHED, self.coefficients),
            (f"{name}/coefficients/values", Float64MultiArray, LATCHED, self.values),
            (f"{name}/coefficients/covariance", Float64MultiArray, LATCHED, self.covariance),
            (f"{name}/wrench_residual", WrenchStamped, STREAM, self.residuals),
            ("/diagnostics", DiagnosticArray, STREAM, self.diagnostics),
        ):
            self.node.create_subscription(type_, topic, heard.append, qos)

    def until(self, ready, seconds=30.0):
        """Listen until ``ready()``; fails after some seconds."""
        end = time.monotonic() + seconds
        while not ready():
            assert time.monotonic() < end, "nothing of the kind was heard in time"
            self.executor.spin_once(timeout_sec=0.1)

    def listen(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=min(seconds, 0.1))

    def connected(self):
        """Whether both ends know each other: until then topics would overtake one another."""
        if not all(p.get_subscription_count() for p in self.publishers.values()):
            return False
        return all(f"{role} publishers=1" in self.words() for role in self.publishers)

    def publish(self, role, data):
        self.publishers[role].publish(data)

    def drive(self, messages):
        """Publish (arrival, role, message) as fast as the node can use them."""
        from rov_ident import cdr

        for _, role, message in in_pace(messages, self.used, self.listen):
            self.publish(role, cdr.encode(message))

    def used(self):
        """The stamp [ns] of the last sample whose residual was published."""
        from rov_ident.nodes.conversions import from_time

        return from_time(self.residuals[-1].header.stamp) if self.residuals else -math.inf

    def call(self, type_, name, request):
        client = self.node.create_client(type_, f"/{self.estimator}_node/{name}")
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def words(self):
        """Everything that /diagnostics has said."""
        return "\n".join(
            f"{status.message} " + " ".join(f"{v.key}={v.value}" for v in status.values)
            for message in self.diagnostics
            for status in message.status
        )

    def close(self):
        import rclpy

        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def start_node(estimator, parameters, *options):
    """The process of a node with a parameter file."""
    command = [sys.executable, "-m", f"rov_ident.nodes.{estimator}_node", "--ros-args"]
    command += ["--params-file", str(parameters)]
    for option in options:
        command += ["-p", option]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def until_said(process, words):
    """Wait for a line with these words on a process's stderr."""
    while words not in (line := process.stderr.readline()):
        assert line, "the node ended by itself"


def end_node(process, number=signal.SIGINT):
    """Its exit status and all that it said."""
    process.send_signal(number)
    try:
        _, said = process.communicate(timeout=20)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return process.returncode, said


def start_connected(estimator, *options, parameters=HEAVY, **kwargs):
    """The process of a node that loses nothing, and a vehicle; both have found each other."""
    process = start_node(estimator, parameters, "qos.reliability:=reliable", *options)
    try:
        vehicle = Vehicle(estimator, **kwargs)
        vehicle.until(vehicle.connected, 120.0)
    except BaseException:
        process.kill()
        raise
    return process, vehicle


class Dive:
    """A dive played to a node at the pace of the clock, which stands still while nobody listens."""

    def __init__(self, messages):
        self.messages = messages
        self.done = 0

    def play(self, vehicle, seconds):
        """Publish this many seconds of it."""
        from rov_ident import cdr

        start, begun = self.messages[self.done][0], time.monotonic()
        while self.done < len(self.messages):
            arrival, role, message = self.messages[self.done]
            due = (arrival - start) * 1e-9
            if due > seconds:
                return
            vehicle.executor.spin_once(timeout_sec=max(due - (time.monotonic() - begun), 0.0))
            if time.monotonic() - begun >= due:
                vehicle.publish(role, cdr.encode(message))
                self.done += 1


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


@pytest.fixture
def heavy_path():
    return HEAVY


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children(pid):
    """The running processes started by a process."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            if parent == pid:
                found.append(int(entry.name))
    return [child for child in found if is_alive(child) and os.getpid() != child]
