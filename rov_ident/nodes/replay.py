"""Plays a bag into live nodes: starts and ends their processes, records what they publish."""

import heapq
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from rov_ident import config as configuration
from rov_ident.config import Config, Qos
from rov_ident.core import children
from rov_ident.core.errors import UserError
from rov_ident.core.files import check_output
from rov_ident.core.interrupts import Interrupted, noted_interrupts
from rov_ident.estimation.online import ESTIMATORS, Report
from rov_ident.io import topics as inputs
from rov_ident.io.bag_reader import Bag, RawMessage
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.mounting import with_mounting
from rov_ident.nodes.common import subscribed
from rov_ident.nodes.conversions import to_time
from rov_ident.nodes.player import OnReport, Player, apart

_LOOPBACK = Path(__file__).with_name("loopback.xml")
_EXIT_TIME = 10.0  # s; for a node to end after an interrupt, which takes under a second


@dataclass(frozen=True)
class ReplayResult:
    """The last ``reports`` by estimator, the number of ``messages`` that every node took, and what
    was taken from the bag's `/tf_static`."""

    reports: Mapping[str, Report]
    messages: int
    seconds: float
    out: Path | None
    notes: tuple[str, ...]


def replay(
    bag: str | os.PathLike[str],
    config_path: str | os.PathLike[str],
    estimators: Sequence[str] = ("rls",),
    rate: float = 1.0,
    out: str | os.PathLike[str] | None = None,
    on_report: OnReport | None = None,
    report_period: float = 0.0,
) -> ReplayResult:
    """Play a bag over DDS into live nodes and record what they publish into the bag ``out``.

    ``rate`` is the speed relative to the recording; 0: as fast as the nodes can follow. No message
    is lost at any rate. ``on_report`` is called with the name of an estimator and each report of
    it, or, as reading all of them takes a third of the player's time, with one in
    ``report_period`` [s] of a clock on the wall.

    A replayed thruster wrench must not reach a vehicle: player and nodes have a namespace of their
    own, hidden from whatever runs beside them; and unless ROS_AUTOMATIC_DISCOVERY_RANGE says
    otherwise, nothing leaves this computer or comes in.

    Raises UserError if the bag or configuration cannot be used.
    """
    if not 0.0 <= rate < float("inf"):
        raise UserError(f"rate is {rate}, but must be positive, or 0 for as fast as possible")
    if unknown := set(estimators) - set(ESTIMATORS):
        raise UserError(f"{min(unknown)} is no live estimator: use {' or '.join(ESTIMATORS)}")
    if out is not None:
        check_output(out, [bag, config_path], bag=True)
    estimators = tuple(dict.fromkeys(estimators))  # two nodes of one name would share their topics
    recorded = Bag(Path(bag))
    config, notes = with_mounting(configuration.load(config_path), [recorded.path])
    topics = inputs.select(recorded, config)
    started = time.monotonic()
    # ROS lists and records no name that begins with an underscore unless it is asked to.
    namespace = f"/_replay_{secrets.token_hex(8)}"
    with ExitStack() as stack:
        stack.enter_context(_on_this_computer())
        writer = None if out is None else stack.enter_context(BagWriter(out))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rov_ident-")))
        nodes, steered = [], []
        for estimator in estimators:
            name = f"{estimator}_node"
            # A new file: the given one may hold what our reader accepts and that of ROS 2 does not.
            parameters = folder / f"{name}.yaml"
            own, _ = with_mounting(configuration.load(config_path, name), [recorded.path])
            settings = replace(
                own,
                qos=Qos(reliability="reliable"),
                inputs=config.inputs.standard,  # the player converts: see inputs.as_played
            )
            configuration.dump(settings, parameters)
            steered += [own] if own.nomoto else []
            nodes.append(stack.enter_context(_Process(name, parameters, namespace)))

        interrupts = stack.enter_context(noted_interrupts())

        def check() -> None:
            if interrupts:  # raised within a callback of rclpy's it would be lost
                raise Interrupted(interrupts[0])
            for node in nodes:
                node.check()

        listened = subscribed(config.inputs.standard)
        played = inputs.as_played(recorded, topics, config)
        if steered:
            name = inputs.rudder_name(steered[0])
            if name not in dict(listened.values()):  # else the joints are played already
                listened[inputs.RUDDER] = name, JointState
                rudder = _rudder(recorded, steered[0])
                played = heapq.merge(played, rudder, key=lambda message: message[1].log_time)

        context = Context()
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        stack.callback(rclpy.try_shutdown, context=context)
        player = Player(
            context, namespace, estimators, writer, on_report, report_period, check, listened,
            len(steered),
        )  # fmt: skip
        stack.callback(player.destroy_node)
        player.wait_for_nodes(next(recorded.iter_raw(topics.values())).log_time)
        if writer is not None:
            writer.go_live()
        count = player.play(played, rate)
        player.finish()
        seconds, written = time.monotonic() - started, None if out is None else Path(out)
        return ReplayResult(player.reports, count, seconds, written, notes)


def _rudder(bag: Bag, config: Config) -> Iterator[tuple[str, RawMessage]]:
    """The joints of a bag, or else each command of its rudder as one, stamped as recorded."""
    topic = inputs.rudder_topic(bag, measured=bool(config.rudder_joint))
    if topic and config.rudder_joint:
        for raw in bag.iter_raw([topic]):
            yield inputs.RUDDER, raw
    elif topic:
        for angle, raw in inputs.rudder_commands(bag, topic):
            joint = JointState(name=[inputs.RUDDER], position=[angle])
            joint.header.stamp = to_time(raw.log_time)
            yield inputs.RUDDER, raw._replace(data=serialize_message(joint))


def _on_this_computer() -> AbstractContextManager[None]:
    """Keep DDS on this computer, discovery and ports, unless the environment says otherwise."""
    ours = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    if os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST") == "LOCALHOST":
        # Fast DDS would still accept whatever arrives at its ports from elsewhere.
        ours["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(_LOOPBACK)
    return children.environment(ours)


class _Process:
    """A node in a process of its own, ended with the `with` block."""

    def __init__(self, name: str, parameters: Path, namespace: str) -> None:
        self.name = name
        command = ["-m", "rov_ident.nodes", name, *apart(namespace)]
        command += ["--params-file", str(parameters), "--log-level", "warn"]
        command += ["-p", "use_sim_time:=true", "-p", "lockstep:=true"]
        # Ctrl-C interrupts this process only, which then interrupts the node.
        self._process = children.start(
            *command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, errors="replace"
        )
        self._last_line = ""
        self._reader = threading.Thread(target=self._forward, daemon=True)
        self._reader.start()

    def _forward(self) -> None:
        """Pass on what the node says on standard error."""
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self._last_line = line.strip() or self._last_line
            if not line.startswith(f"{self.name}: "):  # raised as our own exception
                sys.stderr.write(line)

    def check(self) -> None:
        """Raise if the node has ended by itself."""
        status = self._process.poll()
        if status is None:
            return
        self._reader.join(timeout=1.0)
        if status == 2:
            raise UserError(self._last_line.removeprefix(f"{self.name}: "))
        raise RuntimeError(f"{self.name} ended with status {status}: {self._last_line}")

    def __enter__(self) -> "_Process":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_EXIT_TIME)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(timeout=1.0)
