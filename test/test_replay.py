"""Bags through live nodes: the same numbers as offline, and no process left behind."""

import json
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from program import messages_in
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64

from bench import HEAVY
from bench.simulators.live import Vehicle, children, is_alive, slowness
from rov_ident import config
from rov_ident.core.errors import UserError
from rov_ident.core.states import Level
from rov_ident.estimation.online import ESTIMATORS, OnlineEstimator
from rov_ident.io.bag_reader import Bag
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.write_messages import write_messages
from rov_ident.nodes.common import Executor
from rov_ident.nodes.conversions import from_diagnostics, to_time
from rov_ident.nodes.replay import _Process, replay
from rov_ident.simulation import virtual_sensors as sensors
from rov_ident.steering.nomoto_recursive import RecursiveNomoto
from rov_ident.steering.zigzag import read


@pytest.fixture(scope="module")
def bag(tmp_path_factory, heavy):
    """Twenty seconds with all that a real recording has: noise, jitter, drops, a pause."""
    suite = sensors.Suite(delay=0.03, jitter=0.02, drop=0.02)
    messages = sensors.dive(heavy, duration=20.0, suite=suite, seed=2).messages
    kept = [m for m in messages if not 9_000_000_000 < m[0] < 11_500_000_000]
    path = tmp_path_factory.mktemp("bags") / "dive.mcap"
    write_messages(path, kept)
    return path


@pytest.fixture(scope="module")
def brief(tmp_path_factory, heavy):
    """Three seconds without an IMU."""
    messages = sensors.dive(heavy, duration=3.0, suite=sensors.Suite(imu_rate=0.0)).messages
    path = tmp_path_factory.mktemp("bags") / "brief.mcap"
    write_messages(path, messages)
    return path


def offline(path, kind):
    online = OnlineEstimator(config.load(HEAVY), kind)
    for role, message in messages_in(path):
        online.push(role, message)
    online.flush()
    return online.report()


def assert_same(live, expected):
    assert live.stamp == expected.stamp
    assert live.names == expected.names
    assert live.states == expected.states
    np.testing.assert_allclose(live.values, expected.values, rtol=1e-9, atol=0.0)
    np.testing.assert_allclose(live.std, expected.std, rtol=1e-9, atol=0.0)


LISTENER = """
    import json, sys
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.qos import DurabilityPolicy, QoSProfile

    rclpy.init()
    node = rclpy.create_node("listener")
    heard = []
    qos = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(DiagnosticArray, "/rls_node/coefficients", heard.append, qos)
    while len(heard) < int(sys.argv[1]):
        rclpy.spin_once(node, timeout_sec=1.0)
    print(json.dumps([
        [float(pair.value) for pair in status.values if pair.key in ("value", "std")]
        for message in heard for status in message.status
    ]))
"""


def test_live_equals_offline(domain, bag, tmp_path):
    """Both estimators at once; and every value that was recorded comes back to a subscriber."""
    out = tmp_path / "out.mcap"
    shown = []
    result = replay(bag, HEAVY, tuple(ESTIMATORS), 0.0, out, lambda *report: shown.append(report))
    assert result.messages == sum(topic.message_count for topic in Bag(bag).topics.values())
    for kind in ESTIMATORS:
        assert_same(result.reports[kind], offline(bag, kind))
        reports = [report for name, report in shown if name == kind]
        stamps = [report.stamp for report in reports]
        assert stamps == sorted(stamps)
        # At publish_rate by the stamps of the samples, whatever the speed.
        assert 70 < len(reports) < 110

    recorded = Bag(out)
    for kind in ESTIMATORS:
        for name in ("coefficients", "coefficients/values", "coefficients/covariance"):
            assert recorded.topics[f"/{kind}_node/{name}"].message_count == sum(
                name == kind for name, _ in shown
            )
        assert recorded.topics[f"/{kind}_node/wrench_residual"].message_count > 200
    assert recorded.topics["/diagnostics"].message_count >= 2

    raw = [message.data for message in recorded.iter_raw(["/rls_node/coefficients"])]
    command = [sys.executable, "-c", textwrap.dedent(LISTENER), str(len(raw))]
    listener = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    with closing(Vehicle(roles=())) as vehicle:
        qos = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publisher = vehicle.node.create_publisher(DiagnosticArray, "/rls_node/coefficients", qos)
        for data in raw:
            publisher.publish(data)
        heard, _ = listener.communicate(timeout=600)
    expected = [from_diagnostics(deserialize_message(data, DiagnosticArray)) for data in raw]
    pairs = [pair for r in expected for pair in zip(r.values, r.std, strict=True)]
    np.testing.assert_array_equal(json.loads(heard), pairs)


@pytest.mark.parametrize("joint", ["", "helm"])
def test_the_rudder_is_played(domain, brief, tmp_path, joint):
    """For a node with K and T; a command is stamped as recorded, at whatever speed it is played."""
    path, steered = tmp_path / "nomoto.yaml", tmp_path / "steered.mcap"
    chosen = f"    nomoto: true\n    rudder_joint: '{joint}'\n"
    path.write_text(f"{HEAVY.read_text().rstrip()}\n{chosen}")
    with BagWriter(steered) as writer:
        for k, raw in enumerate(Bag(brief).iter_raw()):
            writer.write(raw.topic, raw.type_name, raw.log_time, raw.data)
            if k % 7 == 0 and joint:
                message = JointState(name=["helm"], position=[0.1 * np.sin(k)])
                message.header.stamp = to_time(raw.log_time)
                data = serialize_message(message)
                writer.write("/joint_states", "sensor_msgs/msg/JointState", raw.log_time, data)
            elif k % 7 == 0:
                data = serialize_message(Float64(data=0.1 * np.sin(k)))
                writer.write("/helm/rudder", "std_msgs/msg/Float64", raw.log_time, data)
    live = replay(steered, path, rate=0.0).reports["rls"]
    assert live.names[-2:] == ("nomoto.K", "nomoto.T")
    assert "no rudder" not in live.messages[-1]
    if joint:
        return
    run = read(steered, config.load(path))
    recursive, rudder = RecursiveNomoto("rls"), run.rudder[0]
    for t, heading, angle in zip(run.t, run.heading, run.rudder, strict=True):
        if np.isfinite(heading):
            recursive.push(t, heading, rudder)
        if angle != rudder:
            recursive.command(t, angle)
            rudder = angle
    expected = recursive.result
    np.testing.assert_allclose(live.values[-2:], expected.values, rtol=1e-6)
    np.testing.assert_allclose(live.std[-2:], expected.std, rtol=1e-6)


def test_pace_without_imu(domain, brief):
    """At twice the speed; a bag without IMU needs no publisher for it from elsewhere."""
    began = []
    result = replay(brief, HEAVY, rate=2.0, on_report=lambda *_: began.append(time.monotonic()))
    # Five reports a second of the bag, of three seconds: 1.4 s, less what the first was late.
    assert 0.7 < began[-1] - began[0] < 2.8 * slowness()
    assert_same(result.reports["rls"], offline(brief, "rls"))
    assert Level.STALE not in result.reports["rls"].levels


TOPICS = {
    "/odom": Odometry, "/imu/data": Imu, "/thruster_wrench": WrenchStamped, "/clock": Clock,
    "/diagnostics": DiagnosticArray, "/rosout": Log, "/parameter_events": ParameterEvent,
    "/rls_node/coefficients": DiagnosticArray,
}  # fmt: skip


class Bystander:
    """A vehicle's own nodes in the same domain: hear all that they should not, and publish, too."""

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context)
        self.node = rclpy.create_node("bystander", context=self.context, enable_rosout=False)
        self.executor = Executor(context=self.context)
        self.executor.add_node(self.node)
        self.heard, self.seen, self.ended = Counter(), set(), threading.Event()
        self.odometry = self.node.create_publisher(Odometry, "/odom", 10)
        self.clock = self.node.create_publisher(Clock, "/clock", 10)
        for topic, type_ in TOPICS.items():
            hear = partial(self.hear, topic)
            self.node.create_subscription(type_, topic, hear, QoSProfile(depth=1000), raw=True)
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def hear(self, topic, data):
        self.heard[topic] += 1

    def run(self):
        while not self.ended.is_set():
            self.odometry.publish(Odometry())
            self.clock.publish(Clock(clock=Time(sec=5)))
            self.seen |= {topic for topic, _ in self.node.get_topic_names_and_types()}
            self.executor.spin_once(timeout_sec=0.01)

    def close(self):
        self.ended.set()
        self.thread.join()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def test_a_replay_is_heard_by_nobody_and_hears_nobody(domain, brief):
    """Two at once beside a vehicle whose odometry and clock say something else."""
    with closing(Bystander()) as bystander, ThreadPoolExecutor(2) as threads:
        jobs = [threads.submit(replay, brief, HEAVY, rate=0.0) for _ in range(2)]
        for job in jobs:
            assert_same(job.result().reports["rls"], offline(brief, "rls"))
    assert len({topic.split("/")[1] for topic in bystander.seen if "coeff" in topic}) == 3
    own = {"/odom", "/clock"}  # what it publishes itself
    assert {topic for topic in bystander.heard if topic not in own} <= {"/parameter_events"}
    others = {topic for topic in bystander.seen if not topic.startswith("/_replay_")}
    assert others == set(TOPICS)


def test_an_estimator_given_twice_is_one_node(brief, monkeypatch):
    """Two nodes of one name had published on the same topics."""
    started = []

    def process(name, *_):
        started.append(name)
        return nullcontext()

    def player(*_):
        raise InterruptedError

    monkeypatch.setattr("rov_ident.nodes.replay._Process", process)
    monkeypatch.setattr("rov_ident.nodes.replay.Player", player)
    with pytest.raises(InterruptedError):
        replay(brief, HEAVY, ("rls", "ukf", "rls"))
    assert started == ["rls_node", "ukf_node"]


def test_wrong_use(brief, tmp_path):
    with pytest.raises(UserError, match="rate"):
        replay(brief, HEAVY, rate=-1.0)
    with pytest.raises(UserError, match="no live estimator: use rls or ukf"):
        replay(brief, HEAVY, ("ls",))
    with pytest.raises(UserError, match="would replace"):
        replay(brief, HEAVY, out=brief)
    bad = tmp_path / "bad.yaml"
    bad.write_text(HEAVY.read_text().replace("mass:", "mas:", 1))
    with pytest.raises(UserError, match=r"bad\.yaml: vehicle\.mas is an unknown key"):
        replay(brief, bad)


def test_node_refuses(domain, tmp_path):
    """What a node says before it ends is what the caller hears."""
    bad = tmp_path / "bad.yaml"
    bad.write_text(HEAVY.read_text().replace("mass:", "mas:", 1))
    with _Process("rls_node", bad, "/_replay") as process:
        process._process.wait(240)
        with pytest.raises(UserError, match=r"^vehicle\.mas is an unknown key"):
            process.check()


def started(bag, out):
    """A replay in a process of its own that has reported ten times, and its node's process."""
    code = f"from rov_ident.nodes.replay import replay; replay({str(bag)!r}, {str(HEAVY)!r}, "
    code += f"rate=1.0, out={str(out)!r}, on_report=lambda *_: print('report', flush=True))"
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdout is not None
    for _ in range(10):
        assert process.stdout.readline() == "report\n"
    (node,) = children(process.pid)
    return process, node


def listening(domain):
    """The addresses at which anything listens for a DDS domain, as /proc writes them."""
    first = 7400 + 250 * domain
    found = []
    for table in ("udp", "udp6", "tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            address, port = line.split()[1].split(":")
            if first <= int(port, 16) < first + 250:
                found.append(address)
    return found


def test_no_port_is_open_to_the_network(domain, bag, tmp_path):
    process, _ = started(bag, tmp_path / "out.mcap")
    addresses = listening(domain)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=600)
    assert len(addresses) >= 4  # discovery and data, of the player and of the node
    assert set(addresses) == {"0100007F"}  # 127.0.0.1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_orphans(domain, bag, tmp_path, number):
    """However a replay is ended, its nodes end too; what was recorded can be read."""
    out = tmp_path / "out.mcap"
    process, node = started(bag, out)
    process.send_signal(number)
    process.communicate(timeout=600)
    assert process.returncode != 0
    end = time.monotonic() + 10.0 * slowness()
    while is_alive(node):
        assert time.monotonic() < end, "the node is still there"
        time.sleep(0.1)
    assert Bag(out).topics["/rls_node/coefficients"].message_count >= 1
