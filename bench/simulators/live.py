"""Live nodes in processes of their own, and a vehicle at the other end of their topics."""

import fcntl
import math
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from bench import HEAVY, ROOT

_OFFLINE = """
import sys, numpy as np, rov_ident as ri
from rov_ident.core import jit  # sets the folder in which numba keeps what follows
from bench.simulators import hidden, sea
hidden.draw(1, ("thruster_lag",), conditions=hidden.Conditions(duration=30.0))
rng = np.random.default_rng(1)
sea.dive(sea.draw_vehicle(rng), sea.Sea(), "six-axis", 2.0, rng)
for kind in ("ls", "iv", "ml"):
    ri.fit(sys.argv[1], sys.argv[2], kind)
ri.explain(sys.argv[1], sys.argv[2])
"""


def compile_all(offline=False):
    """All that a node runs, once for all who ask for it; ``offline``: what fits, explain and the
    simulators run.

    Two processes at a time, in an order in which neither compiles what the other is at: offline
    jobs need the kernels of the sampler, which RLS compiles first, and those of the monitor.
    """
    from rov_ident.core.jit import CACHE
    from rov_ident.discrepancy import monitor
    from rov_ident.estimation.compilation import compiler

    def ensure(*jobs):
        assert all(job.ensure() for job in jobs)

    with open(CACHE / "lock", "a") as lock, ThreadPoolExecutor() as threads:
        fcntl.flock(lock, fcntl.LOCK_EX)
        estimators = threads.submit(ensure, compiler("rls"), compiler("ukf"))
        ensure(monitor.compiler())
        mark = CACHE / "offline"
        if offline and not mark.exists():
            command = [sys.executable, "-c", _OFFLINE, ROOT / "bags" / "demo.mcap", HEAVY]
            subprocess.run(command, check=True)
            mark.touch()
        estimators.result()


ROUNDING = 1e-7
"""Standard deviations, for same_to_rounding. Measured: 1e-8 for the lag of remus100, about whose
estimate samples are made again and again."""


def same_to_rounding(values, std, expected):
    """What one process has estimated, values and std (n,), is another's Report ``expected``.

    To rounding: sums are added in the order that suits the machine code of a process, which is not
    the same after compiling as after reading the cache (core/jit.py). A message
    that is used by one of them alone makes a difference ten thousand times as large.
    """
    np.testing.assert_array_less(np.abs(values - expected.values), ROUNDING * expected.std)
    np.testing.assert_array_less(np.abs(std - expected.std), ROUNDING * expected.std)


_CHUNK = 50  # messages
_AHEAD = 1.0  # s; that the messages published may be ahead of the samples used
_PATIENCE = 10.0  # s without any progress: a busy computer runs none of the nodes for so long
_GIVEN_UP = 0.2  # s a chunk after that; not all messages make samples, and some nodes are disabled


def in_pace(messages, used, listen, ahead=_AHEAD, patience=_PATIENCE):
    """The (arrival, role, message), never many more than the nodes have used.

    Fast DDS has 512 messages in shared memory for a process that has no processor for a while. What
    is lost beyond them is sent again, but seconds after what was sent behind it, which is too late.
    ``used()`` gives the stamp [ns] of the last sample that all nodes have used; ``listen(seconds)``
    waits for news of it. Where none comes for ``patience`` [s], the rest is not waited for as long.
    """
    reached, wait = None, patience
    for k, (arrival, role, message) in enumerate(messages, 1):
        yield arrival, role, message
        reached = message.stamp if reached is None else reached
        end = time.monotonic() + wait
        while k % _CHUNK == 0 and message.stamp - reached > ahead * 1e9:
            if (now := used()) > reached:
                reached, wait = now, patience
                end = time.monotonic() + wait
            elif time.monotonic() > end:
                wait = min(patience, _GIVEN_UP)
                break
            else:
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

    def until(self, ready, seconds=300.0):
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
        from rov_ident.io import cdr

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
    command = [sys.executable, "-m", "rov_ident.nodes", f"{estimator}_node", "--ros-args"]
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
        _, said = process.communicate(timeout=600)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return process.returncode, said


def start_connected(estimator, *options, parameters=HEAVY, **kwargs):
    """The process of a node that loses nothing, and a vehicle; both have found each other."""
    process = start_node(estimator, parameters, "qos.reliability:=reliable", *options)
    try:
        vehicle = Vehicle(estimator, **kwargs)
        vehicle.until(vehicle.connected)
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
        from rov_ident.io import cdr

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


def slowness():
    """How many times longer than alone a computation takes on this computer just now; at least 1.

    Limits on time are multiplied by it, as others may use the computer as well.
    """
    wall, processor = time.monotonic(), time.process_time()
    while time.process_time() - processor < 0.1:
        pass
    now = (time.monotonic() - wall) / (time.process_time() - processor)
    return max(1.0, now, os.getloadavg()[0] / (os.cpu_count() or 1))


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
