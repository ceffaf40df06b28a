"""Long and wide: a day of a dive, ten nodes of five vehicles, clock steps, a disk that fills.

    python -m bench.studies.endurance [day] [fleet] [clock] [disk] [--help]

A part of `make torture`. Exit status 1 where a bar is missed. docs/trust.md has the figures.
"""

import argparse
import itertools
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.signals import SignalHandlerOptions

from bench import HEAVY
from bench.harness import Row
from bench.simulators.live import end_node, start_connected
from bench.studies.torture import SECOND, accounted
from bench.studies.torture_live import _cpu, _memory, _repeated, run
from rov_ident import config as configuration
from rov_ident.estimation import checkpoint
from rov_ident.estimation.online import ESTIMATORS, OnlineEstimator
from rov_ident.io import cdr
from rov_ident.nodes.common import INPUTS, STREAM, Executor
from rov_ident.simulation.virtual_sensors import Suite, dive

_PARTS = 10  # of a day, of which the first warms up


def day(options: argparse.Namespace) -> Iterator[Row]:
    """All topics at 200 Hz, as fast as the estimator goes: memory and time per message are flat."""
    config = configuration.load(HEAVY)
    suite = Suite(odometry_rate=200.0, imu_rate=200.0, wrench_rate=200.0)
    once = dive(config, "steps", 60.0, suite=suite, seed=6).messages
    for kind in options.estimators:
        online = OnlineEstimator(config, kind)
        messages = _repeated(once, options.hours * 3600.0)
        each = int(options.hours * 3600.0 * 600.0) // _PARTS
        sizes, times = [], []
        for _ in range(_PARTS):
            begun = time.process_time()
            for _, role, message in itertools.islice(messages, each):
                online.push(role, message)
            times.append((time.process_time() - begun) / each)
            sizes.append(_memory(os.getpid()))
            told = f"{kind}: {len(times)} of {_PARTS} parts, {1e6 * times[-1]:.0f} us each"
            print(f"  {told}, {sizes[-1]:.0f} MiB", file=sys.stderr, flush=True)
        what = f"{_PARTS * each} messages, {options.hours:g} h of a dive: time per message"
        yield Row(what, kind, 1e6 * times[-1], "us", 400.0)
        # Two busy cores share caches: a single part may take a third longer.
        yield Row(
            "  last half over first half", kind, np.mean(times[5:]) / np.mean(times[:5]), "", 1.3
        )
        yield Row("  memory grown since the first tenth", kind, sizes[-1] - sizes[0], "MiB", 2.0)


def fleet(options: argparse.Namespace) -> Iterator[Row]:
    """Five vehicles, both estimators each, 170 messages/s in the time of the clock."""
    config = configuration.load(HEAVY)
    messages = dive(config, "steps", options.seconds, seed=3).messages
    context = rclpy.Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    executor, heard, waiting = Executor(context=context), {}, {}
    nodes, processes = [], {}

    def hear(message: DiagnosticArray) -> None:
        for status in message.status:
            name, _, kind = status.name.partition(": ")
            if kind == "inputs":
                heard[name] = {v.key: v.value for v in status.values}
            elif kind == "estimation":
                waiting[name] = int(
                    "0" + "".join(re.findall(r"(\d+) messages wait", status.message))
                )

    try:
        publishers = []
        for k in range(5):
            node = rclpy.create_node("vehicle", namespace=f"/rov{k}", context=context)
            publishers.append(
                {r: node.create_publisher(t, name, STREAM) for r, (name, t) in INPUTS.items()}
            )
            nodes.append(node)
            executor.add_node(node)
            for kind in ESTIMATORS:
                command = [sys.executable, "-m", "rov_ident.nodes", f"{kind}_node", "--ros-args"]
                command += ["--params-file", str(HEAVY), "-r", f"__ns:=/rov{k}"]
                command += ["-p", "qos.reliability:=reliable"]
                processes[f"rov{k}/{kind}_node"] = subprocess.Popen(
                    command, stderr=subprocess.DEVNULL
                )
        nodes[0].create_subscription(DiagnosticArray, "/diagnostics", hear, STREAM)
        both = [f"{role} publishers" for role in INPUTS]
        _until(executor, lambda: len(heard) == 10 and all(
            values[key] == "1" for values in heard.values() for key in both
        ), 400.0)  # fmt: skip
        cpu = sum(_cpu(p.pid) for p in processes.values())
        begun = time.monotonic()
        for arrival, role, message in messages:
            data = cdr.encode(message)
            for each in publishers:
                each[role].publish(data)
            while time.monotonic() - begun < (arrival - messages[0][0]) / SECOND:
                executor.spin_once(timeout_sec=0.001)
        lasted = time.monotonic() - begun
        sent = len(messages)

        def told() -> list[int]:
            """How many messages each node has used or refused, or says were lost or wait."""
            return [
                waiting.get(name, 0) + sum(accounted(role, values) for role in INPUTS)
                for name, values in heard.items()
            ]

        _until(executor, lambda: min(told()) >= sent and not any(waiting.values()), 60.0, False)
        lost = sum(int(n) for v in heard.values() for key, n in v.items() if "lost before" in key)
        used = sum(_cpu(p.pid) for p in processes.values()) - cpu
        memory = [_memory(p.pid) for p in processes.values()]
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown(context=context)
        for process in processes.values():
            process.send_signal(signal.SIGINT)
        statuses = [process.wait(60) for process in processes.values()]
    yield Row(f"ten nodes, {sent} messages each in {lasted:.0f} s: nobody has counted",
              "", 10 * sent - sum(told()), "", 0)  # fmt: skip
    yield Row("  counted as lost before they reached the node", "", lost, "", 10 * sent)
    yield Row("  still wait after a minute", "", sum(waiting.values()), "", 10 * sent)
    yield Row("  processor, of one core", "", 100.0 * used / lasted, "%", 100.0)
    yield Row("  memory of the largest", "", max(memory), "MiB", 200.0)
    yield Row("  ended with another status than 0", "", sum(map(bool, statuses)), "", 0)


def _until(executor, ready, seconds=120.0, fails=True):
    end = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > end:
            assert not fails, "the nodes were not heard in time"
            return
        executor.spin_once(timeout_sec=0.1)


_STEPS = {  # s
    "of hours": (3600.0, -3600.0, 86400.0), "of 0.3 s": (0.3, -0.3), "of 0.15 s": (0.15, -0.15),
    "back by 0.8 s": (-0.8,), "ahead by 5 s": (5.0,),
}  # fmt: skip


def clock(_: argparse.Namespace) -> Iterator[Row]:
    """Twelve times in a dive, every ten seconds, the clock of all stamps steps."""
    config = configuration.load(HEAVY)
    messages = dive(config, "steps", 140.0, seed=4).messages
    for kind in ESTIMATORS:
        undisturbed = OnlineEstimator(config, kind)
        for _, role, message in messages:
            undisturbed.push(role, message)
        two = undisturbed.report()
        for name, sizes in _STEPS.items():
            disturbed, steps, offset, waited = OnlineEstimator(config, kind), 0, 0, 0.0
            last, first = messages[0][0], messages[0][0]
            for arrival, role, message in messages:
                if arrival >= first + (20 + 10 * steps) * SECOND:
                    offset += int(sizes[steps % len(sizes)] * SECOND)
                    steps += 1
                if len(disturbed.push(role, message._replace(stamp=message.stamp + offset))):
                    waited, last = max(waited, (arrival - last) / SECOND), arrival
            off = np.abs(disturbed.report().values - two.values) / two.std
            yield Row(f"{steps} clock steps {name}: longest without samples", kind, waited, "s", 10)
            yield Row("  largest change of a coefficient", kind, off.max(), "std", 3.0)


def disk(_: argparse.Namespace) -> Iterator[Row]:
    """A node's files may be smaller and smaller, as on a disk that fills, and then grow again."""
    config = configuration.load(HEAVY)
    messages = dive(config, "steps", 60.0, seed=5).messages
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x"
        process, vehicle = start_connected("rls", f"checkpoint_path:={path}")
        damaged, refusals = 0, 0
        limits = [*range(40_000, -1, -4_000), resource.RLIM_INFINITY]
        each = len(messages) // len(limits)
        for k, limit in enumerate(limits):
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            vehicle.diagnostics.clear()
            vehicle.drive(messages[k * each : (k + 1) * each])
            vehicle.listen(1.5)
            refusals += "cannot be written" in vehicle.words()
            try:
                checkpoint.restore(OnlineEstimator(config, "rls"), path.read_bytes())
            except Exception:
                damaged += 1
        again = "what is learnt is on disk" in vehicle.words()
        vehicle.close()
        status, _ = end_node(process)
    yield Row(f"{len(limits)} sizes of a disk: damaged checkpoints", "rls", damaged, "", 0)
    yield Row("  sizes at which the node says so", "rls", refusals, "", 1, above=True)
    yield Row("  not written again with room", "rls", not again, "", 0)
    yield Row("  exit status", "rls", status, "", 0)


STUDIES = {"day": day, "fleet": fleet, "clock": clock, "disk": disk}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, []], metavar="STUDY")
    parser.add_argument("--hours", type=float, default=24.0, help="of the day")
    parser.add_argument(
        "--estimators", nargs="+", choices=ESTIMATORS, default=[*ESTIMATORS], help="of the day"
    )
    parser.add_argument("--seconds", type=float, default=600.0, help="of the fleet")
    return run(STUDIES, parser.parse_args(), "98")


if __name__ == "__main__":
    sys.exit(main())
