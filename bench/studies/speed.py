"""Speed of the estimators, of the offline fit and of a live node: the table in docs/speed.md.

    python -m bench.studies.speed [ROW ...] [--json FILE]

Every row that has a peer measures both sides in turn, in one process, in many rounds: ratios are of
medians. The exit status is 1 where a bar is missed. Peers come with the extra `bench`.
"""

import argparse
import json
import multiprocessing
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from padasip.filters import FilterRLS

from bench import HEAVY, ROOT
from bench.harness import Bars, Row, announce, show
from bench.simulators.fossen import skew
from bench.simulators.live import children, is_alive
from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.estimation import rls, ukf
from rov_ident.estimation.shared import Problem
from rov_ident.io.cdr import encode
from rov_ident.io.topics import Reader
from rov_ident.io.write_messages import write_messages
from rov_ident.model.coefficients import ABSOLUTE, EXTENDED_SIZE, NEGATIVE, ONE, PLAIN, SQUARE
from rov_ident.model.equations import Model
from rov_ident.sampling import records
from rov_ident.sampling.sampler import Sampler
from rov_ident.simulation import virtual_sensors as sensors
from rov_ident.simulation.open_loop import simulate

DT = 0.02  # s; of a sample
COUPLINGS = {
    "Y_v": -25.0, "K_p": -0.3, "N_r": -0.8, "Y_rdot": 0.4, "Y_r": 0.6, "N_v": 0.3, "Z_q": 0.2,
    "M_w": -0.3, "X_vv": -20.0,
}  # fmt: skip
HOUR = 3600.0  # s


def compared(
    what: str, ours: str, peer: str, value: float, bar: float, above: bool, unit: str
) -> Row:
    return Row(what, "", value, unit, bar, above, ours, peer)


def heavy() -> Config:
    """The BlueROV2 Heavy with 24 coefficients, all of them estimated."""
    parameters = configuration.to_parameters(configuration.load(HEAVY))
    parameters["coefficients"].update(COUPLINGS)
    config = configuration.from_parameters(parameters)
    return replace(config, estimate=config.model.names)


def samples_of(config: Config, dt: float, duration: float) -> np.ndarray:
    """Samples of a noisy dive, one each ``dt``."""
    suite = sensors.Suite(odometry_rate=1.0 / dt, imu_rate=0.0, wrench_rate=1.0 / dt)
    dive = sensors.dive(config, "steps", duration, suite, seed=1)
    return np.concatenate(list(records.samples_of(config, dive)))


def in_turn(rounds: int, *calls: tuple[Callable[[], object], int]) -> list[float]:
    """The median time [s] per unit of each call, which does so many units; the calls take turns."""
    times: list[list[float]] = [[] for _ in calls]
    for call, _ in calls:
        call()
    for _ in range(rounds):
        for (call, units), into in zip(calls, times, strict=True):
            begin = time.perf_counter()
            call()
            into.append((time.perf_counter() - begin) / units)
    return [statistics.median(t) for t in times]


def faster(what: str, ours: float, peer: float, bar: float, than: str) -> Row:
    """A row that compares two times [s]."""
    return compared(what, _text(ours), f"{than} {_text(peer)}", peer / ours, bar, True, "x")


def _text(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


# ------------------------------------------------------------------ the peers' equations of motion


class TextbookModel:
    """The model in careful NumPy, for one state: no loop over terms, nothing computed twice."""

    def __init__(self, model: Model) -> None:
        s, n = model.structure, len(model.structure.row)
        self.model = model
        self.first = len(s.mass_row)
        self.left, self.right = s.left, s.right
        self.axis = np.zeros((6, n))
        self.axis[s.row, np.arange(n)] = 1.0
        self.unit = np.zeros((6, 6, self.first))
        for c, (i, j) in enumerate(zip(s.mass_row, s.mass_column, strict=True)):
            self.unit[i, j, c] = self.unit[j, i, c] = 1.0
        self.unit = self.unit.reshape(36, self.first)
        self.rigid, self.restoring = model.body.mass_matrix, model.body.restoring
        self.extended = np.zeros(EXTENDED_SIZE)  # without inputs
        self.set(model.theta)

    def set(self, theta: np.ndarray) -> None:
        self.mass = self.rigid - (self.unit @ theta[: self.first]).reshape(6, 6)
        self.inverse = np.linalg.inv(self.mass)
        self.terms = self.axis * theta[self.first :]

    def acceleration(self, nu: np.ndarray, force: np.ndarray) -> np.ndarray:
        """nu_dot (6,) under force (6,), wrench minus restoring."""
        e = self.extended
        e[ONE], e[PLAIN:ABSOLUTE] = 1.0, nu
        np.abs(nu, out=e[ABSOLUTE:NEGATIVE])
        np.minimum(nu, 0.0, out=e[NEGATIVE:SQUARE])
        e[SQUARE] = nu[0] * nu[0]
        a, b, c, d, m, n = (self.mass @ nu).tolist()
        u, v, w, p, q, r = nu.tolist()
        coriolis = np.array(
            [
                q * c - r * b, r * a - p * c, p * b - q * a,
                q * n - r * m + v * c - w * b, r * d - p * n + w * a - u * c,
                p * m - q * d + u * b - v * a,
            ]
        )  # fmt: skip
        damping = self.terms @ (e[self.left] * e[self.right])
        return np.asarray(self.inverse @ (force - coriolis + damping))


class MatrixModel:
    """The model as books write it: M nu_dot + C(nu) nu + D(nu) nu + g = tau (Fossen 2021, 8.1)."""

    def __init__(self, model: Model) -> None:
        s, theta = model.structure, model.theta
        textbook = TextbookModel(model)
        self.mass, self.restoring = textbook.mass, textbook.restoring
        self.linear, self.quadratic = np.zeros((6, 6)), np.zeros((6, 6))
        self.products = np.zeros((6, 6, 6))
        terms = zip(s.row, s.left, s.right, theta[len(s.mass_row) :], strict=True)
        for i, left, right, value in terms:
            a, b = min(left, right), max(left, right)
            if a == ONE:
                self.linear[i, b - PLAIN] = value
            elif b >= ABSOLUTE:
                self.quadratic[i, a - PLAIN] = value
            else:
                self.products[i, b - PLAIN, a - PLAIN] = value

    def acceleration(self, nu: np.ndarray, force: np.ndarray) -> np.ndarray:
        """nu_dot (6,) under force (6,), wrench minus restoring."""
        momentum = self.mass @ nu
        coriolis = np.zeros((6, 6))
        coriolis[:3, 3:] = coriolis[3:, :3] = -skew(momentum[:3])
        coriolis[3:, 3:] = -skew(momentum[3:])
        damping = -(self.linear + self.quadratic * np.abs(nu) + self.products @ nu)
        return np.linalg.solve(self.mass, force - coriolis @ nu - damping @ nu)


def runge_kutta(rate: Callable[[np.ndarray], np.ndarray], x: np.ndarray, dt: float) -> np.ndarray:
    a = rate(x)
    b = rate(x + 0.5 * dt * a)
    c = rate(x + 0.5 * dt * b)
    d = rate(x + dt * c)
    return x + dt / 6.0 * (a + 2.0 * b + 2.0 * c + d)


# ------------------------------------------------------------------ rows


class FilterpyUkf:
    """filterpy's filter on the textbook model, with the same noise as ours."""

    def __init__(self, config: Config, task: Problem, state: ukf.State) -> None:
        self.config, self.task, self.model = config, task, TextbookModel(config.model)
        size, u = len(state.x), config.ukf
        points = MerweScaledSigmaPoints(size, u.alpha, u.beta, u.kappa)
        self.filter = UnscentedKalmanFilter(size, 6, DT, lambda x: x[:6], self.moved, points)
        self.filter.x, self.filter.P = state.x.copy(), state.p.copy()

    def theta(self, xi: np.ndarray) -> np.ndarray:
        return np.asarray(self.task.scale * xi)

    def moved(self, x: np.ndarray, dt: float, force: np.ndarray) -> np.ndarray:
        model = self.model
        model.set(self.theta(x[6:]))
        out = x.copy()
        out[:6] = runge_kutta(lambda nu: model.acceleration(nu, force), x[:6], dt)
        return out

    def step(self, row: np.void, process: np.ndarray) -> None:
        """``process`` (6,): the density of the process noise, which our filter adapts."""
        c, f, t, dt = self.config, self.filter, self.task, float(row["dt"])
        self.model.set(self.theta(f.x[6:]))
        strength = (c.wrench.relative_std * row["wrench"]) ** 2 + np.square(c.wrench.floor_std)
        noise = (self.model.inverse * strength) @ self.model.inverse.T
        f.Q = np.zeros_like(f.P)
        f.Q[:6, :6] = (c.wrench.correlation_time * noise + np.diag(process)) * dt
        f.predict(dt=dt, force=row["wrench"] + t.restoring @ row["down"])
        f.update(row["odometry"], R=np.diag(row["odometry_variance"]))


def ukf_step() -> Iterator[Row]:
    config = heavy()
    wide = replace(config.ukf, alpha=0.1, gate=1e6, change_threshold=1e9)
    config = replace(config, ukf=wide)
    task = ukf.problem(config)
    rows = samples_of(config, DT, 20.0)
    rows["down_slope"] = 0.0
    rows["wrench_slope"] = 0.0
    rows["moving"] = 1
    begun, _ = ukf.fold(task, ukf.init(task), rows[:50])
    state, peer = begun, FilterpyUkf(config, task, begun)
    for row in rows[50:100]:
        peer.step(row, state.monitor["density"])
        state, _ = ukf.step(task, state, np.array([row]))
    scale = np.sqrt(np.diag(peer.filter.P))
    apart = float(np.abs((state.x - peer.filter.x) / np.maximum(scale, np.abs(state.x))).max())
    yield compared("UKF equal to filterpy's", "50 steps", "", apart, 1e-9, False, "of the state")
    ours, live, theirs = in_turn(
        60,
        (lambda: ukf.fold(task, begun, rows[50:250]), 200),
        (lambda: [ukf.step(task, begun, rows[50:51]) for _ in range(50)], 50),
        (lambda: [peer.step(rows[100], begun.monitor["density"]) for _ in range(3)], 3),
    )
    yield faster("UKF step, 6 + 24 states, RK4", ours, theirs, 250.0, "filterpy")
    yield faster("same, one call from Python a sample", live, theirs, 100.0, "filterpy")


def rls_step() -> Iterator[Row]:
    config = heavy()
    rows = samples_of(config, 0.1, 60.0)  # an update with each sample
    n, rng = len(config.estimate), np.random.default_rng(0)
    task = rls.problem(config)
    always = replace(config.rls, forgetting="constant", forgetting_factor=0.99)
    forgetful = rls.problem(replace(config, rls=always))
    begun, _ = rls.fold(task, rls.init(task), rows[:300])
    _, info = rls.fold(forgetful, begun, rows[300:500])
    assert (info["reason"] == rls.USED).mean() > 0.9, "too few of the samples are updates"
    peer, x, y = FilterRLS(n, mu=0.99), rng.standard_normal((6, n)), rng.standard_normal(6)
    ours, forgetting, live, theirs = in_turn(
        300,
        (lambda: rls.fold(task, begun, rows[300:400]), 100),
        (lambda: rls.fold(forgetful, begun, rows[300:400]), 100),
        (lambda: [rls.step(task, begun, rows[300:301]) for _ in range(20)], 20),
        (lambda: [peer.adapt(a, b) for a, b in zip(y, x, strict=True)], 1),
    )
    yield faster("RLS step, 24 coefficients, six rows", ours, theirs, 6.5, "padasip")
    yield faster("same, forgetting with every step", forgetting, theirs, 6.5, "padasip")
    yield faster("same, one call from Python a sample", live, theirs, 3.0, "padasip")


def simulation() -> Iterator[Row]:
    model = heavy().model
    t = np.arange(0.0, HOUR, 0.005)
    rng = np.random.default_rng(0)
    wrench = np.repeat(rng.uniform(-1.0, 1.0, (len(t) // 400 + 1, 6)), 400, axis=0)[: len(t)]
    wrench *= [20.0, 20.0, 20.0, 1.0, 1.0, 2.0]

    def loop(peer: TextbookModel | MatrixModel, count: int) -> np.ndarray:
        """Position, quaternion, nu."""
        x, out = np.zeros(13), np.empty((count, 13))
        x[3] = 1.0
        for k in range(count):
            out[k] = x
            x = runge_kutta(lambda state, f=wrench[k]: moved(peer, state, f), x, 0.005)  # type: ignore[misc]
            x[3:7] /= np.linalg.norm(x[3:7])
        return out

    careful, books = TextbookModel(model), MatrixModel(model)
    ours = simulate(model, t[:200], wrench[:200])
    apart = max(float(np.abs(loop(m, 200)[:, 7:] - ours.nu).max()) for m in (careful, books))
    yield compared("simulation equal to both loops", "1 s", "", apart, 1e-12, False, "m/s")
    fast, slow, slower = in_turn(
        7,
        (lambda: simulate(model, t, wrench), len(t)),
        (lambda: loop(careful, 2000), 2000),
        (lambda: loop(books, 2000), 2000),
    )
    yield faster("simulation, a step", fast, slower, 250.0, "NumPy RK4 loop in matrices")
    yield faster("same, against fewer calls of NumPy", fast, slow, 150.0, "NumPy RK4 loop")
    yield compared("an hour at 200 Hz", _text(fast * len(t)), "", fast * len(t), 1.0, False, "s")


def moved(model: TextbookModel | MatrixModel, x: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The rate of position, quaternion, nu."""
    a, b, c, d = x[3:7].tolist()
    r = np.array(
        [
            [1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)],
        ]
    )
    p, q, s = x[10:].tolist()
    turn = [-b * p - c * q - d * s, a * p + c * s - d * q, a * q + d * p - b * s]
    out = np.empty(13)
    out[:3] = r @ x[7:10]
    out[3:6], out[6] = turn, a * s + b * q - c * p
    out[3:7] *= 0.5
    out[7:] = model.acceleration(x[7:], force + model.restoring @ r[2])
    return out


@contextmanager
def hour_long_bag() -> Iterator[tuple[Path, Path]]:
    """A bag and its configuration, in a folder that goes away."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "hour.mcap"
        suite = sensors.Suite(odometry_rate=50.0, imu_rate=100.0, wrench_rate=50.0)
        dive = sensors.dive(configuration.load(HEAVY), "steps", HOUR, suite, seed=1)
        write_messages(bag, dive.messages)
        yield bag, HEAVY


def offline_fit() -> Iterator[Row]:
    program = Path(sys.executable).with_name("rov-ident")
    with hour_long_bag() as (bag, config):
        for estimator, bar in (("rls", 200.0), ("ukf", 100.0)):
            command = [program, "fit", bag, "--config", config, "--estimator", estimator]
            subprocess.run([program, "fit", ROOT / "bags" / "demo.mcap", *command[3:]], check=True,
                           capture_output=True)  # fmt: skip
            times = []
            for _ in range(3):
                begin = time.perf_counter()
                subprocess.run(command, check=True, capture_output=True)
                times.append(time.perf_counter() - begin)
            spent = statistics.median(times)
            ratio = HOUR / spent
            yield compared(f"fit {estimator}, an hour's bag", _text(spent), "", ratio, bar, True,
                      "x real time")  # fmt: skip


# ------------------------------------------------------------------ a live node, over DDS

Traffic = list[tuple[float, str, bytes]]  # s after the first, role, CDR bytes

EMPTY_NODE = """
import rclpy
from rov_ident.nodes.common import INPUTS, STREAM
rclpy.init()
node = rclpy.create_node("empty")
for name, type_ in INPUTS.values():
    node.create_subscription(type_, name, lambda message: None, STREAM)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
"""
RELIABLE = ["--ros-args", "-p", "qos.reliability:=reliable", "-p", "qos.depth:=10000"]


def traffic(rate: float, duration: float, faster_by: float = 1.0) -> Traffic:
    """A dive with ``rate`` messages a second on each topic, published so many times faster."""
    config = configuration.load(HEAVY)
    suite = sensors.Suite(odometry_rate=rate, imu_rate=rate, wrench_rate=rate)
    messages = sensors.dive(config, "steps", duration, suite, seed=1).messages
    first = messages[0][0]
    return [((at - first) * 1e-9 / faster_by, role, encode(m)) for at, role, m in messages]


def publish(
    messages: Traffic, times: "multiprocessing.Queue[list[float]]", heard: bool = True
) -> None:
    """In a process of its own: publish on time; the times [s] at which each went out.

    ``heard``: not before somebody listens.
    """
    import rclpy

    from rov_ident.nodes.common import INPUTS, STREAM

    rclpy.init()
    node = rclpy.create_node("driver")
    publishers = {
        role: node.create_publisher(type_, name, STREAM) for role, (name, type_) in INPUTS.items()
    }
    while heard and not all(p.get_subscription_count() for p in publishers.values()):
        time.sleep(0.05)
    time.sleep(1.0)
    begin, sent = time.monotonic(), []
    for at, role, data in messages:
        while (wait := begin + at - time.monotonic()) > 0.0:
            time.sleep(wait)
        sent.append(time.monotonic())
        publishers[role].publish(data)
    times.put(sent)
    time.sleep(2.0)  # reliable publishers may still have to repeat something
    rclpy.shutdown()


class Listener:
    """Hears what the node under test publishes: (time [s], CDR bytes) by topic."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import WrenchStamped

        from rov_ident.nodes.common import LATCHED, STREAM, Executor

        rclpy.init()
        self.node = rclpy.create_node("listener")
        self.executor = Executor()
        self.executor.add_node(self.node)
        self.heard: dict[str, list[tuple[float, bytes]]] = {}
        for topic, type_, qos in (
            ("/rls_node/coefficients", DiagnosticArray, LATCHED),
            ("/rls_node/wrench_residual", WrenchStamped, STREAM),
            ("/diagnostics", DiagnosticArray, STREAM),
        ):
            into = self.heard[topic] = []
            self.node.create_subscription(
                type_, topic, lambda data, to=into: to.append((time.monotonic(), data)), qos,
                raw=True,
            )  # fmt: skip

    def listen(self, until: Callable[[], bool], seconds: float) -> None:
        end = time.monotonic() + seconds
        while not until() and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)

    def received(self) -> dict[str, int]:
        """Messages that the node has counted so far, by topic, as its diagnostics say."""
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.serialization import deserialize_message

        counts = {"odom": 0, "imu": 0, "wrench": 0}
        for _, data in self.heard["/diagnostics"][-2:]:
            for status in deserialize_message(data, DiagnosticArray).status:
                for value in status.values:
                    if value.key in counts:
                        counts[value.key] = max(counts[value.key], int(value.value))
        return counts


@contextmanager
def process(command: list[str], **variables: str) -> Iterator["subprocess.Popen[bytes]"]:
    """A node, ended like by Ctrl-C, and whoever compiles for it: both write into their cache."""
    started = subprocess.Popen(
        command, env={**os.environ, **variables}, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        yield started
    finally:
        compilers = children(started.pid)
        started.send_signal(signal.SIGINT)
        started.wait(30)
        while any(map(is_alive, compilers)):
            time.sleep(0.05)


def rls_node(*arguments: str) -> list[str]:
    path = str(HEAVY)
    command = [sys.executable, "-m", "rov_ident.nodes", "rls_node"]
    return [*command, *(arguments or ["--ros-args"]), "--params-file", path]


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def peak_memory(pid: int) -> float:
    """MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024.0


def drive(pid: int, messages: Traffic, listener: Listener | None) -> tuple[list[float], float]:
    """Publish to a node; the times at which messages went out, and the node's share of one CPU."""
    context = multiprocessing.get_context("spawn")
    times: multiprocessing.Queue[list[float]] = context.Queue()
    driver = context.Process(target=publish, args=(messages, times))
    driver.start()
    spent, sent = [], []

    def done() -> bool:
        spent.append((time.monotonic(), cpu_seconds(pid)))
        return not times.empty()

    if listener is None:
        while not done():
            time.sleep(0.1)
    else:
        listener.listen(done, 600.0)
    sent = times.get()
    driver.join()
    inside = [(at, cpu) for at, cpu in spent if sent[0] + 1.0 < at < sent[-1]]
    (begin, before), (end, after) = inside[0], inside[-1]
    return sent, (after - before) / (end - begin)


def latencies(
    messages: Traffic, sent: list[float], residuals: list[tuple[float, bytes]]
) -> list[float]:
    """Seconds from the message that completes a sample to its residual, both ways over DDS.

    Which one that is the sampler tells: it waits for the neighbours by which it knows outliers.
    """
    config = configuration.load(HEAVY)
    reader, sampler, complete = Reader(config), Sampler(config), {}
    for (_, role, data), at in zip(messages, sent, strict=True):
        for own, message in reader.read(role, data, 0):
            for t in sampler.push(own, message)["t"].tolist():
                complete[(sampler.origin or 0) + round(t * 1e9)] = at
    heard = ((at, complete.get(_stamp(data))) for at, data in residuals)
    return [at - begun for at, begun in heard if begun is not None]


def _stamp(data: bytes) -> int:
    return int.from_bytes(data[4:8], "little") * 1_000_000_000 + int.from_bytes(
        data[8:12], "little"
    )


def live_node() -> Iterator[Row]:
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(10 + os.getpid() % 90)
    listener = Listener()
    coefficients, residuals = (
        listener.heard["/rls_node/coefficients"], listener.heard["/rls_node/wrench_residual"],
    )  # fmt: skip

    def start(limit: float, of_messages: bool = False, **variables: str) -> float:
        """Seconds from the start of a node to its first estimate, or the first of messages."""
        coefficients.clear()

        def estimates() -> list[float]:
            return [at for at, data in coefficients if _stamp(data) > 0 or not of_messages]

        begin = time.monotonic()
        with process(rls_node(), **variables):
            listener.listen(lambda: bool(estimates()), limit)
            return min(estimates(), default=float("inf")) - begin

    # A compiler may still write into it: it ends soon after its node, not with it.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as empty:
        cold = start(60.0, ROV_IDENT_CACHE=empty)
    start(60.0)
    warm = statistics.median(start(60.0) for _ in range(5))
    yield compared(
        "rls_node: first estimate, nothing compiled", _text(cold), "", cold, 10.0, False, "s"
    )
    context = multiprocessing.get_context("spawn")
    times: multiprocessing.Queue[list[float]] = context.Queue()
    driver = context.Process(target=publish, args=(traffic(50.0, 60.0), times, False))
    driver.start()
    time.sleep(5.0)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as empty:
        learnt = start(60.0, True, ROV_IDENT_CACHE=empty)
    driver.kill()
    yield compared("same, made of messages", _text(learnt), "", learnt, 10.0, False, "s")
    yield compared(
        "rls_node: first estimate, compiled before", _text(warm), "", warm, 2.0, False, "s"
    )

    messages = traffic(200.0, 20.0)
    with process([sys.executable, "-c", EMPTY_NODE]) as node:
        _, empty_cpu = drive(node.pid, messages, None)
    with process(rls_node()) as node:
        residuals.clear()
        sent, cpu = drive(node.pid, messages, listener)
        late = sorted(latencies(messages, sent, residuals))
        memory = peak_memory(node.pid)
    yield compared("rls_node: CPU, 3 x 200 Hz", f"{100 * cpu:.1f} %",
              f"three empty callbacks {100 * empty_cpu:.1f} %", cpu / empty_cpu, 1.3, False,
              "x")  # fmt: skip
    p99 = late[int(0.99 * len(late))]
    median = late[len(late) // 2]
    yield compared("rls_node: 99th percentile of the latency", _text(p99),
                   f"median {_text(median)}", 1e3 * p99, 3.0, False, "ms")  # fmt: skip
    yield compared("rls_node: memory", f"{memory:.0f} MB", "", memory, 200.0, False, "MB")

    messages = traffic(200.0, 100.0, faster_by=25.0 / 3.0)
    with process(rls_node(*RELIABLE)) as node:
        sent, _ = drive(node.pid, messages, listener)
        counted = -1
        while counted < (counted := sum(listener.received().values())):
            listener.listen(lambda: False, 2.0)
        lost = len(messages) - counted
    rate = len(sent) / (sent[-1] - sent[0])
    yield compared("rls_node: lost of 60,000 messages, 5,000 a second", f"{lost}",
              f"sent {rate:.0f} a second", float(lost), 0.0, False, "messages")  # fmt: skip


ROWS: dict[str, Callable[[], Iterator[Row]]] = {
    "ukf": ukf_step,
    "rls": rls_step,
    "simulation": simulation,
    "fit": offline_fit,
    "node": live_node,
}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("rows", nargs="*", choices=[*ROWS, []], metavar="ROW", help=" ".join(ROWS))
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here, one a line")
    options = parser.parse_args()
    announce()
    bars = Bars()
    rows = show((row for name in options.rows or ROWS for row in ROWS[name]()), bars)
    if options.json:
        lines = [json.dumps({**asdict(row), "met": row.met}) + "\n" for row in rows]
        options.json.write_text("".join(lines))
    return bars.status()


if __name__ == "__main__":
    sys.exit(main())
