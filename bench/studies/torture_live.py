"""Crashes and load, done to live nodes over DDS: the slow part of `make torture`.

    python -m bench.studies.torture_live [kills] [writers] [load] [rate] [--kills N] [--hours H]

Exit status 1 where a bar is missed. docs/trust.md has the figures.
"""

import argparse
import math
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from bench import HEAVY
from bench.harness import Bars, Row, announce, show
from bench.simulators.live import Dive, Vehicle, compile_all, end_node, in_pace, start_connected
from bench.studies.torture import SECOND, Messages
from rov_ident import config as configuration
from rov_ident.core.files import replace_file
from rov_ident.core.messages import Message
from rov_ident.estimation import checkpoint
from rov_ident.estimation.online import ESTIMATORS, Kind, OnlineEstimator, Report
from rov_ident.io import cdr
from rov_ident.nodes.conversions import from_diagnostics
from rov_ident.simulation.virtual_sensors import Suite, dive

# ------------------------------------------------------------------ kills


@dataclass(frozen=True)
class Life:
    """Of a node that was killed: what it began with, the last that it published, what it said."""

    first: Report
    last: Report
    said: str


def lives(
    kind: Kind, path: Path, dive: Dive, count: int, shortest: float = 0.3, longest: float = 3.5
) -> Iterator[Life]:
    """A node with a checkpoint at ``path``, killed at random times; the dive waits for the next.

    Each life hears so many seconds of the dive. The first ends no sooner than there is a
    checkpoint, however busy the computer is.
    """
    numbers = random.Random(kind)
    for life in range(count):
        # A killed process may leave the memory that it shares with others broken, and Fast DDS then
        # ends them by SIGSEGV when they close their end (SharedMemChannelResource::release): each
        # vehicle has a process of its own, which is left without closing anything.
        ours, theirs = multiprocessing.Pipe()
        seconds = numbers.uniform(shortest, longest)
        child = _ANEW.Process(target=_live, args=(theirs, kind, path, dive, seconds, life == 0))
        child.start()
        theirs.close()
        try:
            if not ours.poll(_PATIENCE):
                raise TimeoutError(f"the vehicle of life {life} has not come back")
            first, last, said, dive.done = ours.recv()
        finally:
            child.kill()  # it may be stuck; else it has left
            child.join()
        yield Life(first, last, said)


_ANEW = multiprocessing.get_context("spawn")  # a fork would inherit locks, not who holds them
_PATIENCE = 200.0  # s


def _live(
    answer: Connection, kind: Kind, path: Path, dive: Dive, seconds: float, first: bool
) -> None:
    """One life, in a process of its own."""
    process, vehicle = start_connected(kind, f"checkpoint_path:={path}", "publish_rate:=50.0")
    try:
        vehicle.until(lambda: vehicle.coefficients, 60.0)
        begun_with = from_diagnostics(vehicle.coefficients[0])
        dive.play(vehicle, seconds)
        if first:
            vehicle.until(lambda: vehicle.coefficients[-1].header.stamp.sec > 0)
            vehicle.until(path.exists)
    finally:
        process.kill()
        process.wait()
    said = os.read(process.stderr.fileno(), 1 << 16).decode()  # a child may hold it open
    answer.send((begun_with, from_diagnostics(vehicle.coefficients[-1]), said, dive.done))
    os._exit(0)


def kills(options: argparse.Namespace) -> Iterator[Row]:
    """One dive, the node killed again and again; the dive stands still until the next is there."""
    for kind in ESTIMATORS:
        count = options.kills // 2
        config = configuration.load(HEAVY)
        played = Dive(dive(config, "steps", 4.0 * count + 60.0, seed=5).messages)
        last, lost, refused, recalled = 0, [], 0, 0
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "x.checkpoint"
            for life in lives(kind, path, played, count):
                if last:
                    lost.append((last - life.first.stamp) / SECOND)
                    recalled += life.first.stamp > 0
                refused += "not used" in life.said
                last = max(last, life.last.stamp)
                print(f"  {kind} killed {len(lost) + 1} times, {max(lost, default=0.0):.2f} s lost "
                      "at most", end="\r", file=sys.stderr)  # fmt: skip
            broken = OnlineEstimator(config, kind)
            assert checkpoint.read(broken, path)
        unbroken = OnlineEstimator(config, kind)
        for _, role, m in played.messages[: played.done]:
            unbroken.push(role, m)
        a, b = broken.report(), unbroken.report()
        moved = float(np.max(np.abs(a.values - b.values) / b.std))
        yield Row(f"{count} kills: learning lost by one, at most", kind, max(lost), "s", 1.0)
        yield Row("  by half of them, at most", kind, float(np.median(lost)), "s", 1.0)
        yield Row("  checkpoints refused", kind, refused, "", 0)
        yield Row("  lives that began with the prior", kind, count - 1 - recalled, "", 0)
        yield Row("  in the end apart from an unbroken run", kind, moved, "sigma", 1.0)


def kill_writers(path: Path, versions: Sequence[bytes], count: int) -> tuple[int, int, int]:
    """Processes that do nothing but write checkpoints to ``path``, each killed within milliseconds.

    How often the file was broken, how often there was none, and how many other files are left.
    """
    numbers, broken, missed = random.Random(2), 0, 0
    replace_file(path, versions[0])
    for _ in range(count):
        pid = os.fork()
        if pid == 0:
            try:
                while True:
                    for data in versions:
                        replace_file(path, data)
            finally:
                os._exit(1)
        time.sleep(0.01 * numbers.random())
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        missed += not path.exists()
        broken += path.exists() and path.read_bytes() not in versions
    return broken, missed, len(list(path.parent.iterdir())) - 1


def writers(_: argparse.Namespace) -> Iterator[Row]:
    """A thousand writers killed; and what a checkpoint costs."""
    config = configuration.load(HEAVY)
    online = OnlineEstimator(config, "ukf")
    versions = []
    for _, role, m in dive(config, "steps", 4.0, seed=5).messages:
        if len(online.push(role, m)) and len(versions) < 4:
            versions.append(checkpoint.packed(online.memory(), checkpoint.identity(online)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.checkpoint"
        broken, missed, spare = kill_writers(path, versions, 1000)
        took = []
        for _ in range(200):
            begun = time.perf_counter()
            replace_file(path, versions[0])
            took.append(time.perf_counter() - begun)
        begun = time.perf_counter()
        for _ in range(200):
            online.memory()
        held = (time.perf_counter() - begun) / 200
    yield Row("1000 writers killed: files broken", "-", broken, "", 0)
    yield Row("  files gone", "-", missed, "", 0)
    yield Row("  parts left behind", "-", spare, "", 1)
    yield Row("  size of a checkpoint", "-", len(versions[0]), "B", checkpoint.LARGEST)
    yield Row("  written and synced in, 99 %", "-", float(np.percentile(took, 99)), "s", 0.5)
    yield Row("  samples held up by one for", "-", 1e3 * held, "ms", 1.0)


# ------------------------------------------------------------------ load


def load(options: argparse.Namespace) -> Iterator[Row]:
    """An hour of 200 Hz on three topics, as fast as the node takes it; its memory all the while."""
    for kind in ESTIMATORS:
        yield from loaded(kind, options.hours * 3600.0)


def rate(_: argparse.Namespace) -> Iterator[Row]:
    """5,000 messages a second for half a minute."""
    for kind in ESTIMATORS:
        yield from loaded(kind, 30.0 * 5000.0 / 600.0, 5000.0)


def loaded(kind: str, seconds: float, pace: float = 0.0, warm: int = 10) -> Iterator[Row]:
    """600 messages a second of the vehicle's time; at ``pace`` messages/s, or as fast as can be.

    A node has warmed up after so many minutes, which its buffers take to fill.
    """
    config = configuration.load(HEAVY)
    suite = Suite(odometry_rate=200.0, imu_rate=200.0, wrench_rate=200.0)
    once = dive(config, "steps", 60.0, suite=suite, seed=6).messages
    with tempfile.TemporaryDirectory() as folder:
        process, vehicle = start_connected(
            kind, f"checkpoint_path:={folder}/x", "timeout:=30.0", "publish_rate:=5.0"
        )
        sizes, sent, begun, cpu = [], 0, time.monotonic(), _cpu(process.pid)
        messages = _repeated(once, seconds)
        # So many in advance are 300 messages: Fast DDS has room for 512.
        for _, role, m in in_pace(messages, vehicle.used, vehicle.listen, 0.5, 30.0):
            vehicle.publish(role, cdr.encode(m))
            sent += 1
            if sent % 50 == 0:
                vehicle.executor.spin_once(timeout_sec=0.0)
                while pace and time.monotonic() - begun < sent / pace:
                    vehicle.executor.spin_once(timeout_sec=0.0005)
            if sent % _MINUTE == 0:
                _taken(vehicle)
                sizes.append(_memory(process.pid))
                print(f"  {kind} {sent} messages, {sizes[-1]:.1f} MiB", end="\r", file=sys.stderr)
        vehicle.until(lambda: _taken(vehicle) >= sent, 60.0)
        lasted, used = time.monotonic() - begun, _cpu(process.pid) - cpu
        lost = sent - _taken(vehicle)
        vehicle.close()
        status, said = end_node(process)
    assert status == 0, said
    what = f"{sent} messages at {sent / lasted:.0f}/s"
    yield Row(f"{what}: not taken", kind, lost, "", 0)
    if len(sizes) > warm + 1:
        grown = max(sizes[warm:]) - sizes[warm]
        yield Row("  memory grown after warm-up", kind, grown, "MiB", 1.0)
    yield Row("  processor per message", kind, 1e6 * used / sent, "us", 400.0)


def _taken(vehicle: Vehicle) -> int:
    """Messages that /diagnostics counts as taken; the sampler needs all three."""
    if not vehicle.diagnostics:
        return 0
    values = {v.key: v.value for v in vehicle.diagnostics[-1].status[0].values}
    del vehicle.diagnostics[:-1]
    for heard in (vehicle.coefficients, vehicle.values, vehicle.covariance, vehicle.residuals):
        del heard[:-1]
    return sum(int(values.get(role, 0)) for role in ("odom", "imu", "wrench"))


_MINUTE = 36000  # messages of the vehicle's


def _repeated(once: Messages, seconds: float) -> Iterator[tuple[int, str, Message]]:
    """So many seconds of a minute's messages, over and over."""
    for k in range(math.ceil(seconds / 60.0)):
        later = k * 60 * SECOND
        for arrival, role, m in once:
            if arrival - once[0][0] + later > seconds * SECOND:
                return
            yield arrival + later, role, m._replace(stamp=m.stamp + later)


def _memory(pid: int) -> float:
    """MiB that are the process's own."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) / 1024.0
    raise ValueError(pid)


def _cpu(pid: int) -> float:
    """Seconds of processor."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(
    studies: Mapping[str, Callable[[argparse.Namespace], Iterator[Row]]],
    options: argparse.Namespace,
    domain: str,
) -> int:
    """The studies asked for, all by default, with live nodes in a DDS domain of their own."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", domain)
    compile_all()
    announce()
    bars = Bars()
    for name in options.studies or studies:
        show(studies[name](options), bars)
    return bars.status()


STUDIES = {"kills": kills, "writers": writers, "load": load, "rate": rate}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, []], metavar="STUDY")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--hours", type=float, default=1.0)
    return run(STUDIES, parser.parse_args(), "97")


if __name__ == "__main__":
    sys.exit(main())
