"""The live nodes, in their own processes, over DDS."""

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger
from tiers import more

from bench.simulators.live import (
    ROUNDING,
    Vehicle,
    children,
    end_node,
    same_to_rounding,
    slowness,
    start_connected,
    start_node,
    until_said,
)
from rov_ident import config
from rov_ident.core.frames import FLIP_BODY, from_core
from rov_ident.core.messages import Odometry, Wrench
from rov_ident.core.states import Level
from rov_ident.estimation import rls
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.io import cdr
from rov_ident.nodes.common import STREAM
from rov_ident.nodes.conversions import from_diagnostics, from_time
from rov_ident.nodes.estimator_node import EstimatorNode
from rov_ident.simulation.virtual_sensors import dive

STALE = bytes([Level.STALE])


def offline(configuration, messages, kind="rls"):
    """The estimator that has folded the messages, and its residuals {stamp: (6,)}."""
    online = OnlineEstimator(configuration, kind)
    residuals = {}
    infos = [online.push(role, message) for _, role, message in messages]
    for row in np.concatenate([*infos, online.flush()]):
        if np.isfinite(row["residual"]).all():
            residuals[online.sampler.origin + round(float(row["t"]) * 1e9)] = row["residual"]
    return online, residuals


def in_ros_axes(messages):
    """The same dive with frame ids that say nothing: FLU and ENU."""
    for arrival, role, message in messages:
        if isinstance(message, Odometry):
            message = message._replace(frame_id="odom", child_frame_id="base_link")
        else:
            message = message._replace(frame_id="base_link")
        yield arrival, role, from_core(message)


def all_finite(vehicle):
    assert all(np.isfinite(m.data).all() for m in vehicle.values + vehicle.covariance)
    for message in vehicle.coefficients:
        from_diagnostics(message)  # raises where a number is not finite
    for message in vehicle.residuals:
        force, torque = message.wrench.force, message.wrench.torque
        assert np.isfinite([force.x, force.y, force.z, torque.x, torque.y, torque.z]).all()


def is_stale(vehicle, why="stale: "):
    last = vehicle.coefficients[-1:]
    return bool(last) and all(
        status.level == STALE and status.message.startswith(why) for status in last[0].status
    )


def has_ended(vehicle):
    """Whether the node has used all it got: until its inputs stop, some samples may still wait."""
    return is_stale(vehicle, "stale: inputs stopped")


def test_publishing_leaves_time_for_the_inputs(domain, heavy_path):
    """However often it is asked for; a fifth of the time, and as much to wake up for it."""
    process = start_node("ukf", heavy_path, "publish_rate:=1000.0")
    until_said(process, "]: active")
    threading.Thread(target=process.stderr.read, daemon=True).start()

    def share_of_a_core():
        began, before = time.monotonic(), processor_time(process.pid)
        time.sleep(2.0)
        return (processor_time(process.pid) - before) / (time.monotonic() - began)

    # A start ends as late as the computer is busy.
    assert any(share_of_a_core() < 0.4 for _ in range(30))
    process.kill()
    process.wait()


def test_what_never_reaches_the_node_is_counted(domain, heavy_path, short_dive):
    """A node that is not scheduled for a while: DDS keeps a thousand messages of a topic for it."""
    process, vehicle = start_connected("rls", parameters=heavy_path)
    imu = next(cdr.encode(message) for _, role, message in short_dive if role == "imu")
    threading.Thread(target=process.stderr.read, daemon=True).start()
    try:
        vehicle.diagnostics.clear()
        process.send_signal(signal.SIGSTOP)
        for _ in range(3000):
            vehicle.publish("imu", imu)
        process.send_signal(signal.SIGCONT)
        vehicle.until(lambda: "imu: lost before it reached the node=" in vehicle.words())
        warned = [s for m in vehicle.diagnostics for s in m.status if "lost before" in s.message]
        assert warned and all(int.from_bytes(s.level, "little") >= 1 for s in warned)
    finally:
        process.kill()
        process.wait()
        vehicle.close()


def processor_time(pid):
    """Of a process so far, in s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_outputs(live, heavy, short_dive):
    """Names, keys, order, axes and stamps are the contract's; silence makes everything stale."""
    messages = list(in_ros_axes(short_dive))
    reference, residuals = offline(heavy, messages)
    expected = reference.report()
    vehicle = live()
    vehicle.drive(messages)
    vehicle.until(
        lambda: any(from_time(m.header.stamp) == expected.stamp for m in vehicle.coefficients[-1:])
    )
    vehicle.until(lambda: has_ended(vehicle))
    vehicle.listen(0.3)

    assert len(vehicle.coefficients) > 5  # publish_rate
    last = vehicle.coefficients[-1]
    assert all(status.message.startswith("stale: inputs stopped") for status in last.status)
    assert {status.hardware_id for status in last.status} == {heavy.name}
    for status in last.status:
        assert [v.key for v in status.values][:5] == ["value", "std", "unit", "lower", "upper"]
        assert (status.values[-1].key, status.values[-1].value) == ("state", "stale")
    report = from_diagnostics(last)
    assert report.names == heavy.estimate
    assert report.units == expected.units
    same_to_rounding(report.values, report.std, expected)
    for name in ("lower", "upper"):
        off = np.abs(getattr(report, name) - getattr(expected, name))
        assert (off < 10.0 * ROUNDING * expected.std).all(), name
    assert report.stamp == max(message.stamp for _, role, message in messages if role != "wrench")

    n = len(report.names)
    values, covariance = vehicle.values[-1], vehicle.covariance[-1]
    assert [d.size for d in values.layout.dim] == [n, 2]
    assert [d.label for d in values.layout.dim] == [" ".join(report.names), "value std"]
    np.testing.assert_array_equal(
        np.reshape(values.data, (n, 2)), np.stack([report.values, report.std], axis=1)
    )
    off = np.reshape(covariance.data, (n, n)) - expected.covariance
    assert (np.abs(off) < 10.0 * ROUNDING * np.outer(expected.std, expected.std)).all()

    # Measured minus model, each sample's once, in the axes of the wrench: forward-left-up.
    assert len(vehicle.residuals) == len(residuals)
    for message in vehicle.residuals:
        assert message.header.frame_id == "base_link"
        force, torque = message.wrench.force, message.wrench.torque
        frd = residuals[from_time(message.header.stamp)]
        given = [force.x, force.y, force.z], [torque.x, torque.y, torque.z]
        np.testing.assert_allclose(given, FLIP_BODY * frd.reshape(2, 3), rtol=1e-9, atol=1e-9)
    all_finite(vehicle)
    vehicle.until(lambda: "no more messages on /odom" in vehicle.words())
    assert "odom rate=" in vehicle.words()
    assert "test ratio X=" in vehicle.words()


def test_bad_input(live, heavy, short_dive):
    """Each kind is named in /diagnostics; nothing changes, and nothing published is not finite."""
    reference, _ = offline(heavy, short_dive)
    expected = reference.report()
    vehicle = live()
    vehicle.drive(short_dive)
    latest = {role: message for _, role, message in short_dive}
    odometry, wrench = latest["odom"], latest["wrench"]
    nan = np.full(3, math.nan)
    soon = odometry.stamp + 10_000_000
    for role, message in (
        ("odom", odometry._replace(stamp=soon, linear=nan)),
        ("odom", odometry._replace(stamp=soon, orientation=np.zeros(4))),
        ("odom", odometry._replace(stamp=0)),
        ("odom", odometry._replace(stamp=odometry.stamp - 500_000_000)),
        ("odom", odometry),
        ("imu", latest["imu"]._replace(stamp=soon, linear_acceleration=nan)),
        ("wrench", wrench._replace(stamp=soon, force=np.array([math.inf, 0.0, 0.0]))),
        ("wrench", wrench._replace(stamp=soon, frame_id="map")),
        ("wrench", wrench._replace(stamp=soon, frame_id="base_link")),
    ):
        vehicle.publish(role, cdr.encode(message))
    vehicle.publish("wrench", cdr.encode(wrench)[:40])
    for words in (
        "odom: not finite",
        "imu: not finite",
        "wrench: not finite",
        "odom: orientation is not a unit quaternion",
        "odom: zero stamp",
        "odom: backward stamp",
        "odom: duplicate stamp",
        "'map' is a world frame",
        "frame changed from",
        "bytes that are no geometry_msgs/msg/WrenchStamped",
    ):
        vehicle.until(lambda words=words: words in vehicle.words())
    vehicle.until(lambda: has_ended(vehicle))
    report = from_diagnostics(vehicle.coefficients[-1])
    assert report.stamp == expected.stamp
    same_to_rounding(report.values, report.std, expected)
    all_finite(vehicle)


def test_wrench_alone(live, heavy):
    """Nothing is learned, the missing topic is named; who joins late gets the last coefficients.

    All that without anyone publishing /clock.
    """
    vehicle = live("publish_rate:=0.01", "use_sim_time:=true", roles=["wrench"])
    for k in range(100):
        wrench = Wrench(10**9 + k * 20_000_000, "base_link", np.ones(3), np.zeros(3))
        vehicle.publish("wrench", cdr.encode(wrench))
    vehicle.until(lambda: "no message received on /odom: remap it or start" in vehicle.words())
    vehicle.until(lambda: is_stale(vehicle))
    assert "no message received on /imu/data" not in vehicle.words()
    all_finite(vehicle)

    late = Vehicle()
    late.until(lambda: late.coefficients and late.covariance)
    report = from_diagnostics(late.coefficients[0])
    late.close()
    assert report.stamp == 0
    assert set(report.levels) == {Level.STALE}
    np.testing.assert_array_equal(report.values, heavy.model.theta)


@pytest.mark.parametrize("before", [True, False])
def test_what_waits_is_kept_by_a_node_that_is_told_what_it_does_already(before):
    """And not used by one that was disabled: it was received meanwhile."""
    node = SimpleNamespace(
        _waiting=deque(["message"]), _online=SimpleNamespace(enabled=before),
        _work=lambda: None, _publish=lambda: None,
        get_logger=lambda: SimpleNamespace(info=lambda words: None),
    )  # fmt: skip
    answer = EstimatorNode._enable(node, SetBool.Request(data=True), SetBool.Response())
    assert answer.success and node._online.enabled and len(node._waiting) == before


def test_clocks_that_differ_are_named(live, short_dive):
    """Without that all messages are good, and none can be used; a second publisher is named."""
    vehicle = live()
    other = vehicle.node.create_publisher(WrenchStamped, "thruster_wrench", 10)

    def drive():
        for _, role, message in short_dive[:200]:
            hour = 3_600 * 10**9 if role == "wrench" else 0
            vehicle.publish(role, cdr.encode(message._replace(stamp=message.stamp + hour)))
        return "/thruster_wrench is stamped after /odom" in vehicle.words()

    vehicle.until(drive)
    vehicle.until(lambda: "/thruster_wrench has 2 publishers" in vehicle.words())
    assert other.get_subscription_count() == 1


def test_services_and_parameters(live, heavy, short_dive, tmp_path):
    saved = tmp_path / "saved.yaml"
    below_home = os.path.relpath(saved, Path.home())
    vehicle = live(f"save_path:=~/{below_home}", "timeout:=300")
    middle = len(short_dive) // 2
    vehicle.drive(short_dive[:middle])
    vehicle.until(lambda: any(m.header.stamp.sec >= 4 for m in vehicle.coefficients[-1:]))

    assert vehicle.call(SetBool, "enable", SetBool.Request(data=False)).success
    vehicle.coefficients.clear()
    vehicle.drive(short_dive[middle:])
    vehicle.until(lambda: len(vehicle.coefficients) > 3)
    held = from_diagnostics(vehicle.coefficients[-1])
    assert held.stamp < 7 * 10**9
    assert all(text.startswith("disabled: ") for text in held.messages)

    answer = vehicle.call(Trigger, "save", Trigger.Request())
    assert answer.success and str(saved) in answer.message
    loaded = config.load(saved)
    np.testing.assert_array_equal(loaded.model.theta, held.values)
    assert loaded.name == heavy.name

    assert vehicle.call(Trigger, "reset", Trigger.Request()).success
    vehicle.coefficients.clear()
    vehicle.until(lambda: vehicle.coefficients)
    np.testing.assert_array_equal(
        from_diagnostics(vehicle.coefficients[-1]).values, heavy.model.theta
    )
    assert vehicle.call(SetBool, "enable", SetBool.Request(data=True)).success

    changes = [
        ("rls.gate", 6, ""),
        ("publish_rate", 20.0, ""),
        ("rls.gate", -1, "rls.gate is -1 sigma, but must be positive"),
        ("rls.forgetting_factor", 2.0, "rls.forgetting_factor"),
        ("vehicle.mass", 20.0, "read-only"),
    ]
    for name, value, refusal in changes:
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        result = vehicle.call(SetParameters, "set_parameters", request).results[0]
        assert result.successful == (refusal == ""), result.reason
        assert refusal in result.reason

    def of_a_second():
        vehicle.coefficients.clear()
        vehicle.listen(1.0)
        return len(vehicle.coefficients)

    # By default they come five times a second; twenty times at once only to an idle computer.
    vehicle.until(lambda: of_a_second() > 8)


def test_a_node_outlives_its_callbacks(live, short_dive, tmp_path):
    """A clock before 1970, bytes that are no clock, a folder to save in that has gone."""
    folder = tmp_path / "gone"
    folder.mkdir()
    vehicle = live("use_sim_time:=true", f"save_path:={folder / 'saved.yaml'}")
    clock = vehicle.node.create_publisher(Clock, "/clock", STREAM)
    bad = Clock(clock=Time(sec=-1)), b"\0\1\0\0", b"", Clock(clock=Time(sec=-(2**31)))

    def heard():
        for message in bad:  # again and again: the node may not have found the publisher yet
            clock.publish(message)
        return "/clock: ValueError" in vehicle.words()

    vehicle.until(heard)
    folder.rmdir()
    folder.write_text("in the way")
    answer = vehicle.call(Trigger, "save", Trigger.Request())
    assert not answer.success and "cannot be written" in answer.message
    clock.publish(Clock(clock=Time(sec=5)))
    vehicle.drive(short_dive)
    vehicle.until(lambda: vehicle.coefficients[-1].header.stamp.sec > 0)


@pytest.mark.parametrize(
    "old, new, sentence",
    [
        ("mass: ", "mass: -", "vehicle.mass is -"),
        ("cog: [0.0, 0.0, 0.0]", "cog: [0, 0.0, 0.0]", "written alike"),
        ("coefficients:", "coefficients", "not valid YAML"),
        ("/**:", "/my_node:", "has no section for /rls_node"),
        *more(("mass: ", "mass: []  # ", "vehicle.mass is []")),
        *more(("X_uu: ", "X_ux: ", "coefficients.X_ux")),
    ],
)
def test_bad_configuration(domain, heavy_path, tmp_path, old, new, sentence):
    """One sentence that names the key, and exit status 2."""
    text = heavy_path.read_text()
    assert old in text
    path = tmp_path / "bad.yaml"
    path.write_text(text.replace(old, new, 1))
    process = start_node("rls", path)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 2, said
    last = said.strip().splitlines()[-1]
    assert last.startswith("rls_node: ") and sentence in last
    assert "Traceback" not in said


def test_started_without_a_configuration(domain):
    command = [sys.executable, "-m", "rov_ident.nodes", "rls_node"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 2
    assert "--ros-args --params-file" in done.stderr and "Traceback" not in done.stderr


def test_vehicles_of_a_fleet_save_to_files_of_their_own(domain, heavy_path, tmp_path):
    """And whoever saves what has learnt nothing is told so."""
    caller = Vehicle()
    for name in ("one", "two"):
        command = [sys.executable, "-m", "rov_ident.nodes", "rls_node", "--ros-args"]
        command += ["-r", f"__ns:=/{name}", "--params-file", heavy_path]
        process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        try:
            client = caller.node.create_client(Trigger, f"/{name}/rls_node/save")
            caller.until(client.service_is_ready)
            future = client.call_async(Trigger.Request())
            caller.until(future.done)
            assert future.result().success
            assert "no sample was used yet" in future.result().message
        finally:
            status, said = end_node(process)
        assert status == 0, said
    caller.close()
    names = sorted(path.name for path in tmp_path.glob("*.yaml"))
    assert names == [f"bluerov2_heavy_{name}_rls_node.yaml" for name in ("one", "two")]


def test_terminate(domain, heavy, heavy_path, short_dive):
    """SIGTERM, too, is a way to end well; with parting words, which are true."""
    online = OnlineEstimator(heavy, "rls")
    infos = [online.push(role, message) for _, role, message in short_dive]
    used = np.count_nonzero(np.concatenate([*infos, online.flush()])["reason"] == rls.USED)
    process, vehicle = start_connected("rls", parameters=heavy_path)
    try:
        vehicle.drive(short_dive)
        vehicle.until(lambda: has_ended(vehicle))
    finally:
        vehicle.close()
        status, said = end_node(process, signal.SIGTERM)
    assert status == 0, said
    assert used > 100 and f"ended: {used} samples used" in said


def test_the_other_nodes_live_the_same_life(domain, heavy_path, tmp_path):
    """They end well by either signal, and say in one sentence what is wrong with their file."""
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(heavy_path.read_text().replace("cog: [0.0, 0.0", "cog: [0, 0.0", 1))
    for name, number in (
        ("controller_bridge", signal.SIGTERM), ("example_controller", signal.SIGINT),
    ):  # fmt: skip
        command = [sys.executable, "-m", "rov_ident.nodes", name, "--ros-args"]
        command += ["-p", "controller:=/nobody"] * (name == "controller_bridge")
        command.append("--params-file")
        done = subprocess.run([*command, wrong], capture_output=True, text=True, timeout=600)
        assert done.returncode == 2, done.stderr
        last = done.stderr.strip().splitlines()[-1]
        assert last.startswith(f"{name}: ") and "written alike" in last
        process = subprocess.Popen([*command, heavy_path], stderr=subprocess.PIPE, text=True)
        assert process.stderr.readline()  # its first words: it is up
        status, said = end_node(process, number)
        assert status == 0, said
        assert "Traceback" not in said


@pytest.fixture
def nothing_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("ROV_IDENT_CACHE", str(tmp_path))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)


@pytest.mark.study
def test_the_first_start_on_a_computer(domain, heavy, heavy_path, nothing_compiled):
    """Estimates come long before anything is compiled, and in the end each message was used."""
    messages = dive(heavy, "steps", 40.0, seed=1).messages
    expected, residuals = offline(heavy, messages)
    vehicle = Vehicle()
    began = time.monotonic()
    process = start_node("rls", heavy_path)
    said = []
    listening = threading.Thread(target=lambda: said.extend(process.stderr))
    listening.start()
    vehicle.until(vehicle.connected)
    vehicle.until(lambda: is_stale(vehicle))  # drivers come later than nodes
    for compiler in children(process.pid):
        os.kill(compiler, signal.SIGKILL)  # as for want of memory
    driving, first, stale = time.monotonic(), None, None
    for arrival, role, message in messages:
        while (wait := messages[0][0] + (time.monotonic() - driving) * 1e9 - arrival) < 0.0:
            vehicle.listen(min(-wait * 1e-9, 0.01))
        vehicle.publish(role, cdr.encode(message))
        if first is None and vehicle.used() > 0.0:
            first = time.monotonic() - began
            assert from_diagnostics(vehicle.coefficients[-1]).names == heavy.estimate
            assert not any("compiled after" in line for line in said)
        if stale is None and time.monotonic() - driving > 5.0:
            stale = is_stale(vehicle)
    assert first is not None and first < 10.0 * slowness()
    assert stale is False
    assert sum("compiling failed with status -9: trying again" in line for line in said) == 1
    assert "interpreted until compiled" in vehicle.words()
    vehicle.until(lambda: any("compiled after" in line for line in said), 600.0)
    vehicle.until(lambda: has_ended(vehicle))
    vehicle.close()
    process.send_signal(signal.SIGINT)
    assert process.wait(300.0) == 0
    listening.join()
    assert len(vehicle.residuals) == len(residuals)
    report, end = from_diagnostics(vehicle.coefficients[-1]), expected.report()
    assert report.stamp == end.stamp
    np.testing.assert_array_less(np.abs(report.values - end.values), 1e-6 * end.std)
    assert "Traceback" not in "".join(said)


def test_interrupt_while_compiling(domain, heavy_path, nothing_compiled):
    process = start_node("rls", heavy_path)
    until_said(process, "]: active")
    began = time.monotonic()
    status, said = end_node(process)
    assert status == 0, said
    assert time.monotonic() - began < 5.0 * slowness()
    assert "compiled after" not in said and "Traceback" not in said


@pytest.mark.parametrize(
    "delay, number",
    [
        (0.002, signal.SIGKILL),
        (0.5, signal.SIGINT),
        *more((0.0, signal.SIGKILL), (0.002, signal.SIGINT), (0.004, signal.SIGKILL)),
    ],
)
def test_nothing_compiles_for_a_node_that_is_gone(
    domain, heavy_path, nothing_compiled, delay, number
):
    """Also where it ends while it starts the compiler; who compiles has the same stderr."""
    process = start_node("rls", heavy_path)
    until_said(process, "compiling")
    time.sleep(delay)
    began = time.monotonic()
    _, said = end_node(process, number)
    assert time.monotonic() - began < 10.0 * slowness()  # of some thirty
    assert "Traceback" not in said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_while_an_object_of_a_start_is_finalised(number):
    """What is raised there is lost, and within a library of C++ it aborts the process."""
    program = f"""if True:
        import os, time
        from rov_ident.nodes.common import live
        class Finalised:
            def __del__(self):
                os.kill(os.getpid(), {number:d})
                time.sleep(0.1)
        def make():
            Finalised()
            time.sleep(60.0)
        live("node", make, own=())
    """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=600)
    assert (done.returncode, done.stderr) == (0, b"")


def test_interrupt_in_the_instant_in_which_it_is_up(domain, heavy_path):
    """It starts a thread then; one that was half started kept the process for ever."""
    for delay, number in zip((0.0, 0.0003, 0.001, 0.003), (signal.SIGINT, signal.SIGTERM) * 2):
        process = start_node("rls", heavy_path)
        until_said(process, "]: active")
        time.sleep(delay)
        began = time.monotonic()
        status, said = end_node(process, number)
        assert status == 0, said
        assert time.monotonic() - began < 5.0 * slowness()
        assert "Traceback" not in said


@pytest.mark.parametrize("estimator", ["rls", *more("ukf")])
def test_a_simulation_that_lacks_something(live, heavy, tmp_path, estimator):
    """An effect that is configured is estimated; one that is missing is named in /diagnostics."""
    document = config.to_parameters(heavy)
    document["effects"] = {"thruster_lag": {"time_constant": 0.12}}
    messages = dive(config.from_parameters(document), "steps", 75.0).messages
    document["effects"] = {"thruster_lag": {"time_constant": 0.1}}
    del document["coefficients"]["X_uu"]
    lacking = config.from_parameters(document)
    config.dump(lacking, tmp_path / "lacking.yaml")
    reference, _ = offline(lacking, messages, estimator)
    expected = reference.report()
    assert expected.names[-1] == "thruster_lag.time_constant"

    vehicle = live(estimator=estimator, parameters=tmp_path / "lacking.yaml")
    vehicle.until(lambda: "nothing is seen to be missing" in vehicle.words())
    vehicle.drive(messages)
    vehicle.until(
        lambda: any(from_time(m.header.stamp) == expected.stamp for m in vehicle.coefficients[-1:])
    )
    report = from_diagnostics(vehicle.coefficients[-1])
    assert (report.names, report.units) == (expected.names, expected.units)
    same_to_rounding(report.values, report.std, expected)
    assert abs(report.values[-1] - 0.12) < 0.01

    assert not expected.consistency.consistent
    # by how much is in the values, below: it changes until the last sample, and then it is stale
    what = expected.consistency.sentence.partition(": ")[0]
    told = f"data and model disagree: {what}"
    vehicle.until(lambda: told in vehicle.words())
    status = next(
        status
        for message in vehicle.diagnostics
        for status in message.status
        if status.message.startswith(told)
    )
    assert status.name == f"{estimator}_node: estimation"
    assert status.level == bytes([Level.WARN])
    tests = [f"{t.name}={t.value:.3g} (limit {t.limit:g})" for t in expected.consistency.tests]
    vehicle.until(lambda: all(test in vehicle.words() for test in tests))

    missing = "residual in surge follows |u| u: quadratic damping"  # and, so soon, what is like it
    vehicle.until(lambda: missing in vehicle.words())
    status = next(
        status
        for message in vehicle.diagnostics
        for status in message.status
        if status.message.startswith(missing)
    )
    assert status.name == f"{estimator}_node: model"
    assert status.level == bytes([Level.WARN])
    values = {v.key: v.value for v in status.values}
    assert values["effect"] == "quadratic_damping"
    assert values["axis"] == "X"
    assert float(values["score"]) > float(values["penalty"])
    found, unit = values["quadratic_damping.X_uu"].split(" ", 1)
    assert unit == "N s2/m2"
    assert float(found) < 0.0
