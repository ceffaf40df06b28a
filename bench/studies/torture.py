"""What goes wrong at sea, done to both estimators.

    python -m bench.studies.torture [STUDY ...] [--seeds N] [--only TEXT]

A fault is done to the messages of a simulated dive of three minutes; the same dive without it is
the yardstick. Exit status 1 where a bar is missed.
"""

import argparse
import math
import struct
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from types import ModuleType

import numpy as np

from bench import HEAVY
from bench.harness import Bars, Row, announce, show
from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.config.prior import prior_of
from rov_ident.core.messages import IMU, ODOMETRY, WRENCH, Imu, Message, Odometry, Wrench
from rov_ident.estimation.online import ESTIMATORS, Kind, OnlineEstimator, Report
from rov_ident.io.cdr import DECODERS, ROLE_TYPES, encode
from rov_ident.sampling.sample import joined
from rov_ident.sampling.sampler import Sampler
from rov_ident.simulation.manoeuvres import manoeuvre
from rov_ident.simulation.virtual_sensors import START, Suite, dive, measure

SECOND = 1_000_000_000
FAULT = (90.0, 100.0)  # s
Messages = list[tuple[int, str, Message]]


@cache
def dived(seed: int) -> Messages:
    """Three minutes of a vehicle that the configuration knows, two hours after time began."""
    made = dive(configuration.load(HEAVY), "steps", 180.0, seed=seed).messages
    late = 7200 * SECOND
    return [(arrival + late, role, m._replace(stamp=m.stamp + late)) for arrival, role, m in made]


@cache
def started(seed: int) -> Config:
    """The configuration with every coefficient off by up to 30 %."""
    config = configuration.load(HEAVY)
    rng = np.random.default_rng(seed + 1000)
    off = config.model.theta * (1.0 + rng.uniform(-0.3, 0.3, len(config.model.theta)))
    return config.with_model(config.model.with_theta(off))


def at(message: Message) -> float:
    """Seconds since the first instant of the dive."""
    return (message.stamp - START) / SECOND - 7200.0


def during(message: Message, begin: float = FAULT[0], end: float = FAULT[1]) -> bool:
    return begin <= at(message) < end


@dataclass
class Run:
    """The reports of one second each, by the time of the input."""

    kind: Kind
    final: Report | None = None
    times: list[float] = field(default_factory=list)
    used: list[int] = field(default_factory=list)  # samples so far

    def look(self, online: OnlineEstimator, t: float, samples: list[np.ndarray]) -> None:
        """Take these samples, the last ones before t; the report must be fit to be published."""
        reasons = online.take(joined(samples))["reason"] if samples else np.zeros(0)
        count = int(np.count_nonzero(~np.isin(reasons, ESTIMATORS[self.kind].REFUSALS)))
        self.used.append((self.used[-1] if self.used else 0) + count)
        self.times.append(t)
        self.final = report = online.report()
        assert all(np.isfinite(x).all() for x in (report.values, report.std))
        scaled = report.covariance / np.outer(report.std, report.std)
        assert np.linalg.eigvalsh(scaled)[0] > 0.0, f"covariance at {t} s"

    def recovery(self, since: float, rate: float) -> float:
        """Seconds from ``since`` until samples are used at half their usual rate again."""
        for t, before, after in zip(self.times, self.used, self.used[1:], strict=False):
            if t >= since and after - before > 0.5 * rate:
                return t - since
        return math.inf


def run(config: Config, messages: Messages) -> dict[Kind, Run]:
    """All messages in the order of their arrival; both estimators see the samples of one sampler.

    The state does not depend on how many samples are folded at a time: a second's at once.
    """
    sampler, begin, second = Sampler(config), messages[0][0], 0
    runs = [(OnlineEstimator(config, kind), Run(kind)) for kind in ESTIMATORS]
    waiting = []
    for arrival, role, message in messages:
        samples = sampler.push(role, message)
        if len(samples):
            waiting.append(samples)
        if arrival - begin >= SECOND * second:
            for online, done in runs:
                done.look(online, (arrival - begin) / SECOND, waiting)
            waiting, second = [], second + 1
    waiting.append(sampler.flush())
    for online, done in runs:
        done.look(online, math.inf, waiting)
    return {done.kind: done for _, done in runs}


def shift(a: Run, b: Run) -> float:
    """The largest change of a coefficient, in standard deviations of the undisturbed run."""
    assert a.final and b.final
    return float(np.max(np.abs(a.final.values - b.final.values) / b.final.std))


# ------------------------------------------------------------------ faults in time


def imu_gone(messages: Messages) -> Messages:
    return [m for m in messages if not (m[1] == IMU and during(m[2]))]


def odometry_at_1_hz(messages: Messages) -> Messages:
    kept, last = [], -math.inf
    for entry in messages:
        if entry[1] == ODOMETRY and during(entry[2]):
            if at(entry[2]) - last < 1.0:
                continue
            last = at(entry[2])
        kept.append(entry)
    return kept


def wrench_late(messages: Messages) -> Messages:
    late = [
        (arrival + 3 * SECOND // 10 if role == WRENCH and during(m) else arrival, role, m)
        for arrival, role, m in messages
    ]
    return sorted(late, key=lambda entry: entry[0])


def frozen(messages: Messages) -> Messages:
    """A velocity sensor that has lost the ground and repeats its last value."""
    out, last = [], None
    for arrival, role, m in messages:
        if isinstance(m, Odometry):
            if during(m) and last is not None:
                m = m._replace(linear=last)
            else:
                last = m.linear
        out.append((arrival, role, m))
    return out


def zeroed(messages: Messages) -> Messages:
    return [
        (a, role, m._replace(linear=np.zeros(3)) if isinstance(m, Odometry) and during(m) else m)
        for a, role, m in messages
    ]


def wrench_gone(messages: Messages) -> Messages:
    return [m for m in messages if not (m[1] == WRENCH and during(m[2], 90.0, 95.0))]


def clock(jump: int) -> Callable[[Messages], Messages]:
    def jumped(messages: Messages) -> Messages:
        return [
            (a, role, m._replace(stamp=m.stamp + jump * SECOND) if at(m) >= FAULT[0] else m)
            for a, role, m in messages
        ]

    return jumped


def stepped(messages: Messages) -> Messages:
    """A clock that is set by tenths of a second, and set back."""
    offset = round(0.3 * SECOND)
    return [
        (a, role, m._replace(stamp=m.stamp + offset * (FAULT[0] <= at(m) < FAULT[1])))
        for a, role, m in messages
    ]


def loop(messages: Messages) -> Messages:
    """A bag that starts over after its first half."""
    half = [m for m in messages if at(m[2]) < FAULT[0]]
    lag = half[-1][0] - messages[0][0] + SECOND // 100
    return half + [(a + lag, role, m) for a, role, m in messages]


def lossy(role: str) -> Callable[[Messages], Messages]:
    """A link that loses a fifth of what is sent, all the time."""

    def lost(messages: Messages) -> Messages:
        rng = np.random.default_rng(len(messages))
        return [m for m in messages if m[1] != role or rng.random() > 0.2]

    return lost


FAULTS: dict[str, Callable[[Messages], Messages]] = {
    "IMU gone for 10 s": imu_gone,
    "odometry at 1 Hz for 10 s": odometry_at_1_hz,
    "wrench 300 ms late for 10 s": wrench_late,
    "velocity frozen for 10 s": frozen,
    "velocity zero for 10 s": zeroed,
    "wrench gone for 5 s": wrench_gone,
    "clock an hour ahead": clock(3600),
    "clock an hour back": clock(-3600),
    "clock 0.3 s ahead, and back 10 s later": stepped,
    "bag starts over": loop,
    "a fifth of the demands lost": lossy(WRENCH),
    "a fifth of the IMU lost": lossy(IMU),
    "a fifth of the odometry lost": lossy(ODOMETRY),
}


def faults(seeds: int, only: str) -> Iterator[Row]:
    for what, fault in FAULTS.items():
        if only not in what:
            continue
        pairs = [(run(started(k), fault(dived(k))), undisturbed(k)) for k in range(seeds)]
        for kind in ESTIMATORS:
            moved = max(shift(done[kind], without[kind]) for done, without in pairs)
            slowest = max(done[kind].recovery(FAULT[1], 50.0) for done, _ in pairs)
            # What is lost is information: four fifths of it move a coefficient by half a standard
            # deviation, and the largest of sixty (fifteen in four dives) by 1.2.
            bar = 1.5 if what == "a fifth of the demands lost" else 1.0
            yield Row(f"{what}: moved", kind, moved, "sigma", bar)
            yield Row(f"{what}: used again after", kind, slowest, "s", 10.0)


@cache
def undisturbed(seed: int) -> dict[Kind, Run]:
    return run(started(seed), dived(seed))


# ------------------------------------------------------------------ outliers

CHANNELS = {
    ODOMETRY: (("linear", "uvw", 2.0), ("angular", "pqr", 2.0), ("orientation", "wxyz", 1.0)),
    IMU: (("angular_velocity", "xyz", 2.0), ("linear_acceleration", "xyz", 20.0)),
    WRENCH: (("force", "XYZ", 200.0), ("torque", "KMN", 40.0)),
}


def outliers(seeds: int, only: str) -> Iterator[Row]:
    """Five per cent of one channel's numbers replaced by something up to ``size``."""
    for role, fields in CHANNELS.items():
        for name, letters, size in fields:
            for index, letter in enumerate(letters):
                what = f"{role} {name} {letter}"
                if only not in what:
                    continue
                pairs = [
                    (run(started(k), spoilt(k, role, name, index, size)), undisturbed(k))
                    for k in range(seeds)
                ]
                for kind in ESTIMATORS:
                    moved = [shift(done[kind], without[kind]) for done, without in pairs]
                    if seeds > 1:
                        yield Row(f"  {what}: median", kind, float(np.median(moved)), "sigma", 1.0)
                        beyond = sum(m > 1.0 for m in moved)
                        yield Row(f"  {what}: beyond one", kind, beyond, "dives", 0.0)
                    yield Row(f"5 % outliers, {what}", kind, max(moved), "sigma", 1.0)


def spoilt(seed: int, role: str, name: str, index: int, size: float) -> Messages:
    rng = np.random.default_rng([seed, index, len(name)])
    out = []
    for arrival, topic, m in dived(seed):
        if topic == role and rng.random() < 0.05:
            values = getattr(m, name).copy()
            values[index] = rng.uniform(-size, size)
            m = _with(m, name, values)
        out.append((arrival, topic, m))
    return out


def firsts(seeds: int, only: str) -> Iterator[Row]:
    """Of the first three odometry messages some are gross outliers: all that is known of motion."""
    for name, size in (("linear", 2.0), ("orientation", 1.0)):
        for wrong in ((0,), (1,), (0, 1), (0, 2)):
            what = f"{name} of odometry {' and '.join(str(k + 1) for k in wrong)} wrong"
            if only not in what:
                continue
            moved: dict[Kind, list[float]] = {kind: [] for kind in ESTIMATORS}
            for seed in range(seeds):
                done = run(started(seed), begun_wrong(seed, name, wrong, size))
                for kind, values in moved.items():
                    values.append(shift(done[kind], undisturbed(seed)[kind]))
            for kind, values in moved.items():
                yield Row(what, kind, max(values), "sigma", 1.0)


def begun_wrong(seed: int, name: str, wrong: tuple[int, ...], size: float) -> Messages:
    rng, out, count = np.random.default_rng([seed, *wrong]), [], 0
    for arrival, role, m in dived(seed):
        if role == ODOMETRY:
            if count in wrong:
                m = _with(m, name, rng.uniform(-size, size, len(getattr(m, name))))
            count += 1
        out.append((arrival, role, m))
    return out


def _with(m: Message, name: str, values: np.ndarray) -> Message:
    """The message with other numbers; an attitude stays one."""
    scale = np.linalg.norm(values) if name == "orientation" else 1.0
    return m._replace(**{name: values / scale})


# ------------------------------------------------------------------ garbage

WILD = (
    math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324, 1e-320, 0.0, -0.0, 1e30, 9e5, -1.0,
)  # fmt: skip
LAST = 2**31 * SECOND - 1
STAMPS = (0, -1, 1, -(2**31) * SECOND, LAST, LAST - 2 * SECOND, 10**18)
TEXTS = ("", "map", "rov/map", "base_link_ned", "x" * 300, "\0", "\n\x1b[31m", "\u202e")

# Counted besides the message that brought it about.
NOT_OF_A_MESSAGE = (
    " gap, odometry alone",
    " outlier between its neighbours", " velocity repeated", " outlier, or marked as not measured",
    " contradicts the first, begun anew",
)  # fmt: skip


@dataclass
class Abuse:
    """What a fuzzed estimator has been through."""

    online: OnlineEstimator
    bad_reports: int = 0  # not finite, or no covariance
    uncounted: int = 0  # messages that are neither taken nor refused by name
    undecodable: int = 0

    @property
    def taken(self) -> int:
        return sum(self.online.sampler.counts[role] for role in (ODOMETRY, IMU, WRENCH))

    @property
    def refusals(self) -> dict[str, int]:
        return {name: n for name, n in self.online.counts.items() if ":" in name}


def garbage(_: int, only: str, count: int = 1_000_000) -> Iterator[Row]:
    """A million wild messages: nothing raises, nothing bad is published, all are counted."""
    for kind in ESTIMATORS:
        if only not in kind:
            continue
        done = abused(started(0), kind, dived(0), count // 2, seed=1)
        before = done.online.report()
        for _, role, m in dived(1):
            done.online.push(role, m._replace(stamp=m.stamp + 10**18))
        after = done.online.report()
        done.bad_reports += not is_fit(after)
        what = f"{count // 2} wild messages"
        yield Row(f"{what}: reports not finite", kind, done.bad_reports, "", 0)
        yield Row(f"{what}: not counted by name", kind, done.uncounted, "", 0)
        shrunk = float(np.median(after.std / before.std))
        yield Row("  then three good minutes leave of the std", kind, shrunk, "x", 0.5)
        for name, n in sorted(done.refusals.items(), key=lambda item: -item[1]):
            print(f"    {n:8d}  {name}", file=sys.stderr)


def abused(config: Config, kind: Kind, good: Messages, count: int, seed: int) -> Abuse:
    """An estimator that was given wild messages, as bytes."""
    done = Abuse(OnlineEstimator(config, kind))  # type: ignore[arg-type]
    rng = np.random.default_rng(seed)
    for k, (_, role, data) in enumerate(wild_bytes(good, count, rng)):
        try:
            message = DECODERS[ROLE_TYPES[role]](data)
        except ValueError:
            done.undecodable += 1
            continue
        before = done.online.sampler.counts.copy()
        info = done.online.push(role, message)
        done.uncounted += not is_counted(role, before, done.online.sampler.counts)
        residual = info["residual"]
        done.bad_reports += bool(np.isinf(residual).any())  # NaN: there is none
        if k % 1000 == 0:
            done.bad_reports += not is_fit(done.online.report())
    return done


def is_counted(role: str, before: Mapping[str, int], after: Mapping[str, int]) -> bool:
    """Whether exactly one message of the role has been taken, or refused by a name."""
    return accounted(role, after) - accounted(role, before) == 1


def accounted(role: str, counts: Mapping[str, int | str]) -> int:
    """How many messages of a role were used, refused by a name, or are said to be lost."""
    return sum(
        int(counts[name]) for name in counts
        if name.partition(":")[0] == role
        and name.partition(":")[2] not in NOT_OF_A_MESSAGE
        and name != f"{WRENCH}: too late"  # taken all the same
    )  # fmt: skip


def is_fit(report: Report) -> bool:
    """Whether a report may be published."""
    parts = (report.values, report.std, report.lower, report.upper, report.covariance)
    return all(np.isfinite(part).all() for part in parts) and bool((report.std >= 0.0).all())


def wild_bytes(
    good: Messages, count: int, rng: np.random.Generator
) -> Iterator[tuple[int, str, bytes]]:
    """Good messages, over and over, most with wild fields, or bytes changed, cut or added."""
    begin, end = good[0][2].stamp, good[-1][2].stamp
    for k in range(count):
        arrival, role, m = good[k % len(good)]
        later = (k // len(good)) * (end - begin + SECOND // 50)
        m = m._replace(stamp=m.stamp + later)
        how = rng.random()
        if how < 0.6:
            m = wild(m, rng)
        try:
            data = bytearray(encode(m))
        except ValueError:  # no such stamp
            data = bytearray(encode(m._replace(stamp=LAST)))
        if how > 0.8:
            _spoil(data, rng)
        yield arrival, role, bytes(data)


def _spoil(data: bytearray, rng: np.random.Generator) -> None:
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(len(data))) if data else 0
        kind = rng.integers(6)
        if kind == 0 and data:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            data[at : at + 8] = rng.bytes(8)
        elif kind == 2:
            del data[at:]
        elif kind == 3:
            data += rng.bytes(int(rng.integers(1, 40)))
        elif kind == 4 and len(data) > 20:
            data[12:16] = struct.pack("<I", int(rng.integers(2**32)))  # length of a string
        elif len(data) > 8:
            at = 4 * int(rng.integers(len(data) // 4))
            data[at : at + 8] = struct.pack("<d", WILD[rng.integers(len(WILD))])


def wild(message: Message, rng: np.random.Generator) -> Message:
    """A message with one to three of its parts made wild."""
    for _ in range(rng.integers(1, 4)):
        name = message._fields[rng.integers(len(message._fields))]
        value = getattr(message, name)
        if isinstance(value, np.ndarray):
            value = value.copy()
            value[rng.integers(len(value))] = WILD[rng.integers(len(WILD))]
            if rng.random() < 0.1:
                value[:] = 0.0
        elif isinstance(value, int):
            value = _wild_stamp(value, rng)
        elif rng.random() < 0.2:
            value = TEXTS[rng.integers(len(TEXTS))]
        message = message._replace(**{name: value})
    return message


def _wild_stamp(stamp: int, rng: np.random.Generator) -> int:
    """At zero, at the ends of time, backward, the same again, out of order, years ahead."""
    kind = rng.integers(5)
    if kind == 0:
        return STAMPS[rng.integers(len(STAMPS))]
    if kind == 1:
        return stamp + int(rng.integers(-20, 20)) * SECOND // 100
    if kind == 2:
        return stamp - int(rng.integers(1, 100)) * SECOND
    if kind == 3:
        return stamp + int(rng.integers(1, 10**9)) * SECOND
    return stamp - SECOND // 50


# ------------------------------------------------------------------ no excitation


def rest(_: int, only: str, count: int = 10_000_000) -> Iterator[Row]:
    """Ten million samples at rest, or in surge alone; then a minute of all axes."""
    for kind, module in ESTIMATORS.items():
        for what, make in (("at rest", _resting), ("in surge alone", _surging)):
            if only not in f"{what} {kind}":
                continue
            # Not quite trimmed it would be held by something at rest, and heave in surge.
            config = started(0) if what == "at rest" else _neutral(started(0))
            online = OnlineEstimator(config, kind)
            task, prior = module.problem(config), online.prior
            blocks = [make(config, seed) for seed in range(3)]
            rng = np.random.default_rng(5)
            state, done, bounded, definite, uneven = online.state, 0, 0.0, True, 0.0
            before = module.estimate(task, state, prior)
            while done < count:
                samples = _noisy(*blocks[(done // 1000) % len(blocks)], rng)
                state, _ = module.fold(task, state, samples)
                done += len(samples)
                if done % 100_000 < len(samples) or done >= count:
                    now = module.estimate(task, state, prior)
                    bounded = max(bounded, float(np.max(now.std / before.std)))
                    scaled = now.covariance / np.outer(now.std, now.std)
                    uneven = max(uneven, float(np.abs(scaled - scaled.T).max()))
                    definite &= bool(np.linalg.eigvalsh(scaled)[0] > 0.0)
            still = np.array([what == "at rest" or name[0] != "X" for name in prior.names])
            moved = np.max((np.abs(now.values - before.values) / before.std)[still])
            yield Row(f"{count} samples {what}: moved", kind, float(moved), "sigma", 0.1)
            yield Row("  largest std over the prior's", kind, bounded, "", 1.001)
            yield Row("  covariance uneven by", kind, uneven, "", 1e-9)
            yield Row("  covariance not positive definite", kind, float(not definite), "", 0.0)
            minute = _driving(config, what)
            (after, std), (fresh, fresh_std) = (
                _a_minute(config, module, begun, minute) for begun in (state, online.state)
            )
            slower = np.max((std / fresh_std)[still])
            apart = np.max((np.abs(after - fresh) / fresh_std)[still])
            yield Row("  std a minute later over a fresh start's", kind, float(slower), "", 1.05)
            yield Row("  apart from a fresh start by", kind, float(apart), "sigma", 1.0)


def _neutral(config: Config) -> Config:
    """The same vehicle with as much buoyancy as weight, and nothing that pitches or rolls it."""
    body = config.model.body
    body = replace(body, buoyancy=body.weight)
    return replace(config, model=replace(config.model, body=body))


def _a_minute(
    config: Config, module: ModuleType, state: object, samples: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate and its standard deviation, filter's own, after a minute begun with ``state``."""
    task = module.problem(config)
    state, _ = module.fold(task, state, samples)
    estimate = module.estimate(task, state, prior_of(config))
    return estimate.values, np.sqrt(module.variance(task, state))


def _resting(config: Config, seed: int) -> tuple[np.ndarray, Suite]:
    """Forty seconds of samples of a vehicle that lies on the ground, its thrusters off."""
    rng, sampler = np.random.default_rng([2, seed]), Sampler(config)
    messages = [(role, m) for _, role, m in dived(0) if at(m) < 40.0]
    parts = [sampler.push(role, still(m, rng)) for role, m in messages]
    return joined([*parts, sampler.flush()]), Suite().scaled(0.0)


def _surging(config: Config, seed: int) -> tuple[np.ndarray, Suite]:
    """A minute of samples of a vehicle that is driven forward and back, and no other way.

    Without the noise of velocities and wrench, which is the suite's and to be added anew each time:
    a minute that comes again with the same noise would be learnt as if there were none.
    """
    true, suite = _neutral(configuration.load(HEAVY)), Suite()
    t = np.arange(0.0, 60.0, 0.02)
    wrench = manoeuvre("steps", true.model, t, np.random.default_rng([3, seed]))
    wrench[:, 1:] = 0.0
    noisy, quiet = (
        _sampled(
            config, measure(true, t, wrench, 60.0, s, np.random.default_rng([4, seed])).messages
        )
        for s in (suite, suite.scaled(0.0))
    )
    quiet["moving"] = noisy["moving"]  # noise now and then passes for motion, as in a dive
    return quiet, suite


def _noisy(samples: np.ndarray, suite: Suite, rng: np.random.Generator) -> np.ndarray:
    """Samples with fresh noise of velocities, and of a wrench that is a mean of some messages."""
    samples, n = samples.copy(), len(samples)
    linear, angular, gyro = rng.standard_normal((3, n, 3))
    samples["odometry"] += np.hstack([suite.linear_std * linear, suite.angular_std * angular])
    samples["gyro"] += suite.gyro_std * gyro
    samples["nu"] += np.hstack([suite.linear_std * linear, suite.gyro_std * gyro])
    several = np.maximum(samples["dt"] * suite.wrench_rate, 1.0)
    relative = suite.wrench_std / np.sqrt(several)
    samples["wrench"] *= 1.0 + relative[:, None] * rng.standard_normal((n, 6))
    return samples


def _driving(config: Config, before: str) -> np.ndarray:
    """A minute of samples of a vehicle that moves in all axes, trimmed as it was ``before``."""
    true = configuration.load(HEAVY)
    true = true if before == "at rest" else _neutral(true)
    return _sampled(config, dive(true, "steps", 60.0, seed=9).messages)


def _sampled(config: Config, messages: Messages) -> np.ndarray:
    sampler = Sampler(config)
    return joined([*(sampler.push(role, m) for _, role, m in messages), sampler.flush()])


def still(m: Message, rng: np.random.Generator) -> Message:
    level = np.array([1.0, 0.0, 0.0, 0.0])
    if isinstance(m, Odometry):
        linear, angular = 0.008 * rng.standard_normal(3), 0.004 * rng.standard_normal(3)
        return m._replace(position=np.zeros(3), orientation=level, linear=linear, angular=angular)
    if isinstance(m, Imu):
        gravity = np.array([0.0, 0.0, -9.81])
        return m._replace(
            angular_velocity=0.003 * rng.standard_normal(3),
            linear_acceleration=gravity + 0.03 * rng.standard_normal(3),
        )
    assert isinstance(m, Wrench)
    return m._replace(force=np.zeros(3), torque=np.zeros(3))


STUDIES = {
    "faults": faults, "outliers": outliers, "firsts": firsts, "garbage": garbage, "rest": rest,
}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, []], metavar="STUDY")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", default="", help="what a row must have in its name")
    options = parser.parse_args()
    announce()
    bars = Bars()
    for name in options.studies or STUDIES:
        show(STUDIES[name](options.seeds, options.only), bars)
    return bars.status()


if __name__ == "__main__":
    sys.exit(main())
