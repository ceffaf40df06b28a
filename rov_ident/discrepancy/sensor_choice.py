"""Which effects on the sensors are believed: how the sensors agree proposes, the dynamics decide.

A correction that makes the sensors agree, but the motion disagree with the thrust, is none: the
pose may be wrong. So it is dropped where held-out data, as recorded, are surely predicted better
without. Whether the heading is off or the velocity sensor turned, which a level vehicle's odometry
does not tell, is decided by the thrust. The noise of the wrench's reading, which shows where
commands rest, is believed if the dynamics fit better without it.
"""

import dataclasses
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core import forks
from rov_ident.core.frames import quaternion_to_matrix
from rov_ident.core.linalg import scaled_solve
from rov_ident.discrepancy import sensor_consistency
from rov_ident.discrepancy.held_out import Judge, gain_of, surely_less, thinned
from rov_ident.discrepancy.hypothesis import Hypothesis, Key, bounds
from rov_ident.discrepancy.linearisation import Linearisation
from rov_ident.discrepancy.output_error import Fitted, fit, refit
from rov_ident.discrepancy.reading_noise import jitter
from rov_ident.discrepancy.results import Gain
from rov_ident.discrepancy.search import Search
from rov_ident.discrepancy.selection import VERY_STRONG, mean_inflation
from rov_ident.discrepancy.windowed_problem import Spans, WindowedProblem
from rov_ident.effects import EFFECTS, Values
from rov_ident.effects.base import a_reading
from rov_ident.model.coefficients import AXES, VELOCITIES
from rov_ident.model.equations import Array
from rov_ident.reports.result import NORMAL
from rov_ident.sampling import wrench_scatter
from rov_ident.sampling.raw_streams import Streams, corrected
from rov_ident.sampling.wrench_scatter import RESTING

HEADING, MOUNTING, NOISE = "heading_offset", "sensor_misalignment", "wrench_noise"
LATENCY, SCALE = "velocity_latency", "velocity_scale"
BIAS, ARM = "imu_bias", "sensor_lever_arm"
_YAW, _LEVEL = (MOUNTING, "yaw"), ("roll", "pitch")
_WATER = (("ocean_current", "north"), ("ocean_current", "east"))
_SURE = 3.0  # standard deviations; a normal error is larger in 0.3 %, one known from twelve in 1 %
_LOUD = 0.1
"""Of what the readings do, the share of the noise. Thrust seems weaker by as much (attenuation),
which the default uncertainty of its scale, 15 %, still covers."""
_TILTED = 2.45  # prior standard deviations, beyond which two normal biases together are in 5 %


@dataclass(frozen=True)
class Choice:
    """The sensor effects that are believed, the standard deviations of their parameters, those that
    the data cannot tell from the choice, by effect, and what was not believed, in words; ``fixed``
    are parameters that were held at their null, ``unsure`` effects that something without a name
    may be behind."""

    sensors: Values
    std: Mapping[Key, float]
    alternatives: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    fixed: frozenset[Key] = frozenset()
    notes: tuple[str, ...] = ()
    unsure: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Data:
    """What is fitted, and what is judged on, as recorded."""

    streams: Streams
    spans: Spans
    judged: Streams
    held: Spans
    config: Config

    def fitted(self, names: Sequence[str], fixed: frozenset[Key]) -> Choice:
        found, std = sensor_consistency.search(self.streams, self.config, self.spans, names, fixed)
        return Choice(found, std, fixed=fixed)

    def dynamics(self, sensors: Values, axes: str = AXES) -> Array | None:
        """Squared errors (C, free axes) of held-out data as recorded, summed over chunks, of the
        model fitted to corrected data, on those of the ``axes`` that are simulated; None where it
        cannot be."""
        found, use = self._judged(sensors), self._simulated(axes)
        return found[0].summed(found[1])[:, use] if found and use else None

    def gain_in_dynamics(self, before: Values, after: Values) -> Gain | None:
        """By how much better the same are predicted with one correction than with another."""
        use = self._simulated(AXES)
        first, second = (self._judged(sensors) for sensors in (before, after))
        if not use or first is None or second is None:
            return None
        (judge, h), (other, g) = first, second
        a, b = judge.summed(h)[:, use], other.summed(g)[:, use]
        return gain_of([VELOCITIES[i] for i in use], a, b, other.count[use])

    def _simulated(self, axes: str) -> list[int]:
        return [i for i in np.flatnonzero(~self.streams.guided).tolist() if AXES[i] in axes]

    def _judged(self, sensors: Values) -> tuple[Judge, Hypothesis] | None:
        """The model fitted to corrected data, and what judges it. A current is allowed for: what
        turns the velocities turns it, too, and a model without it would choose what makes least of
        it."""
        streams, judged = (corrected(s, sensors) for s in (self.streams, self.judged))
        fitted = Search(streams, self.config, thinned(self.spans)).start()
        if fitted is None:
            return None
        if self.config.current_std > 0.0 and _WATER[0][0] not in self.config.effects:
            h = fitted.hypothesis.having(dict.fromkeys(_WATER, 0.0))
            fitted = refit(h, fitted.linearisation, update_noise=True) or fitted
        return Judge(WindowedProblem(judged, self.held), sensors), fitted.hypothesis

    def agreement(self, of: Sequence[Values]) -> list[Array]:
        """Squared innovations (C, comparisons) of corrections, in the units of the first."""
        all_found = [sensor_consistency.comparisons(self.judged, self.config, s) for s in of]
        sums = sensor_consistency.common_squares(all_found, self.held)
        return [sums[:, i] for i in range(len(of))]


def chosen(data: Data, turned: bool = False) -> Choice:
    """The effects that the streams support in the spans that are fitted, by what they do in those
    that are judged. ``turned``: the heading is off, by what several records say."""
    found, std = sensor_consistency.search(data.streams, data.config, data.spans)
    choice = Choice(found, std)
    if turned or {HEADING, MOUNTING} & found.keys():
        choice = _heading_or_mounting(data, choice, turned)
    choice = _with_delay_of_the_pose(data, choice)
    return _beside_tilt(data, _without_refuted(data, choice), turned)


def _with_delay_of_the_pose(data: Data, choice: Choice) -> Choice:
    """Without late velocities that only the IMU shows, where the pose alone says otherwise; not
    sure where it says that they are late by another time. What an attitude that wanders makes of
    gravity looks like velocities of another time, where a vehicle hardly accelerates."""
    streams = data.streams
    if not (LATENCY in choice.sensors and streams.has_pose and len(streams.imu_t)):
        return choice
    alone = dataclasses.replace(data, streams=streams.without_imu())
    posed = alone.fitted([n for n in choice.sensors if n != BIAS], choice.fixed)
    key = (LATENCY, "delay")
    delay, std = posed.sensors[LATENCY]["delay"], posed.std.get(key, np.inf)
    apart = abs(choice.sensors[LATENCY]["delay"] - delay)
    if apart <= _SURE * np.hypot(std, choice.std.get(key, 0.0)):
        return choice
    words = f"{LATENCY}: the pose by itself says {delay:.2g} ± {NORMAL * std:.1g} s"
    if abs(delay) > _SURE * std:
        return _unsure(choice, LATENCY, words)
    rest = data.fitted([n for n in choice.sensors if n != LATENCY], choice.fixed)
    rest = dataclasses.replace(rest, alternatives=choice.alternatives, unsure=choice.unsure)
    return dataclasses.replace(rest, notes=(*choice.notes, f"{words}: it is not applied"))


def _beside_tilt(data: Data, choice: Choice, turned: bool) -> Choice:
    """What the attitude is needed for is known as well as the attitude: tilted by delta, it makes
    delta x f of a bias of the accelerometer and delta x omega of a gyro's, of the mean f and omega,
    and turns a velocity sensor that is compared with positions. And late velocities are timed by
    what an IMU reads in an interval, in which its stamp may be anywhere. So an effect is none if it
    is no more than that, and not sure if the pose may be tilted instead."""
    config, streams, std = data.config, data.streams, dict(choice.std)
    tilt = config.odometry.attitude_std
    turning = tilt * _across(streams.nu[:, 3:].mean(axis=0))
    interval = float(np.median(np.diff(streams.imu_t))) if len(streams.imu_t) > 1 else 0.0
    wider = {
        BIAS: [*(tilt * _across(_weight(data))), *np.hypot(streams.rates_std, turning)],
        MOUNTING: [tilt * streams.has_pose] * 2 + [0.0],
        LATENCY: [interval / np.sqrt(12.0)],
    }
    for name, values in choice.sensors.items():
        keys = [(name, parameter) for parameter in values]
        for key, more in zip(keys, wider.get(name, ())):
            std[key] = float(np.hypot(std.get(key, 0.0), more))
        if turned and name == HEADING:
            continue  # it is what the records differ by, beside which the first one's is nothing
        if all(abs(values[k[1]] - bounds(k)[0]) <= _SURE * std.get(k, 0.0) for k in keys):
            others = "the stamps of the IMU" if name == LATENCY else "odometry.attitude_std"
            words = f"{name}: no more than chance, or {others}, explains"
            rest = {n: of for n, of in choice.sensors.items() if n != name}
            choice = dataclasses.replace(choice, sensors=rest, notes=(*choice.notes, words))
    choice = dataclasses.replace(choice, std=std)
    if _is_tilt(data, choice):
        choice = _unsure(choice, MOUNTING, f"{MOUNTING}: the pose may be tilted instead")
    bias = choice.sensors.get(BIAS, {})
    level = float(np.hypot(bias.get("ax", 0.0), bias.get("ay", 0.0)))
    if level <= _TILTED * config.imu.accelerometer_bias_std:
        return choice
    words = (
        f"{BIAS}: {level:.2g} m/s2 along x and y are more than imu.accelerometer_bias_std "
        f"supposes; attitude or IMU may be tilted by {1e3 * level / config.gravity:.0f} mrad "
        "instead"
    )
    return _unsure(choice, BIAS, words)


def _weight(data: Data) -> Array:
    """The mean specific force (3,) [m/s2] of a vehicle at rest, by the attitude, in body axes."""
    down = quaternion_to_matrix(data.streams.orientation)[:, 2]
    out: Array = -data.config.gravity * down.mean(axis=0)
    return out


def _is_tilt(data: Data, choice: Choice) -> bool:
    """Whether the pose may be tilted against the body instead of the velocity sensor: the
    accelerometer, which would be tilted against the pose as the velocities are, had only such a
    bias then as the configuration supposes. (Where there is none, thrust alone can tell.)"""
    angles, bias = choice.sensors.get(MOUNTING, {}), choice.sensors.get(BIAS, {})
    surely = [abs(angles.get(n, 0.0)) > _SURE * choice.std.get((MOUNTING, n), 0.0) for n in _LEVEL]
    sense, weight = EFFECTS[MOUNTING].sense, _weight(data)
    if not (any(surely) and len(data.streams.imu_t) and sense is not None):
        return False
    reading = a_reading()._replace(linear=weight[None])
    tilted = sense(reading, **{**angles, "yaw": 0.0}).linear[0]
    own = np.array([bias.get("ax", 0.0), bias.get("ay", 0.0)]) - (tilted - weight)[:2]
    return bool(np.hypot(*own) <= _TILTED * data.config.imu.accelerometer_bias_std)


def _unsure(choice: Choice, name: str, words: str) -> Choice:
    notes, unsure = (*choice.notes, words), choice.unsure | {name}
    return dataclasses.replace(choice, notes=notes, unsure=unsure)


def _across(x: Array) -> Array:
    """The size of what is across each axis of a vector (3,)."""
    out: Array = np.sqrt(x @ x - x**2)
    return out


def _heading_or_mounting(data: Data, found: Choice, turned: bool) -> Choice:
    """The heading of the pose, the mounting of the velocity sensor, or its tilt and the heading:
    those that the sensors refute are dropped, then those that the dynamics refute, and of the rest
    that is taken which changes the velocities least."""
    others = [n for n in found.sensors if n not in (HEADING, MOUNTING)]
    none: frozenset[Key] = frozenset()
    variants = forks.divided(
        lambda of: data.fitted([*others, *of[0]], of[1]),
        [((HEADING,), none), ((MOUNTING,), none), ((HEADING, MOUNTING), frozenset({_YAW}))],
    )
    sums = data.agreement([v.sensors for v in variants])
    possible = (0, 2) if turned else (0, 1, 2)
    # in units of their noise: below one is nothing, as of rates that are the very gyro's
    spread = [float(np.log(np.maximum(s.sum(axis=0), 1.0)).sum()) for s in sums]
    order = sorted(possible, key=spread.__getitem__)
    best = order[0]
    left = [i for i in order if not surely_less(sums[best], sums[i])]
    if len(left) > 1:
        tried = forks.divided(lambda i: data.dynamics(variants[i].sensors), left)
        squares = {i: s for i, s in zip(left, tried, strict=True) if s is not None}
        if squares:
            least = min(squares, key=lambda i: float(np.log(squares[i].sum(axis=0)).sum()))
            left = [i for i in left if i in squares and not surely_less(squares[least], squares[i])]
    mine = min(left, key=(0, 2, 1).index)
    rivals = {
        name: tuple(
            dict.fromkeys(
                n
                for i in left
                for n in variants[i].sensors
                # a tilt of the sensor is in both, and its yaw in one
                if n not in variants[mine].sensors
                or (name not in variants[i].sensors and n in (HEADING, MOUNTING))
            )
        )
        for name in variants[mine].sensors
        if name in (HEADING, MOUNTING)
    }
    return dataclasses.replace(variants[mine], alternatives=rivals)


def _without_refuted(data: Data, choice: Choice) -> Choice:
    """Without the corrections of velocities that make the prediction of the data surely worse."""
    late = [n for n in choice.sensors if EFFECTS[n].late]
    if not data.streams.has_pose:
        # Clock or place of the IMU may be off instead; and noise of the IMU, which is in what it
        # tells of the motion as well, makes velocities seem small where they hardly change.
        unsure = choice.unsure | ({*late, ARM, SCALE} & choice.sensors.keys())
        choice = dataclasses.replace(choice, unsure=unsure)
    corrects = [n for n in choice.sensors if EFFECTS[n].sense or n in late]
    corrects = [n for n in corrects if moves_velocity(n, choice.sensors[n])]
    squares = data.dynamics(choice.sensors) if corrects else None

    def left_out(name: str) -> tuple[Choice, Array | None]:
        rest = data.fitted([n for n in choice.sensors if n != name], choice.fixed)
        return rest, data.dynamics(rest.sensors)

    while corrects:
        refuted = None
        for name, (rest, without) in zip(corrects, forks.divided(left_out, corrects), strict=True):
            if squares is None or (without is not None and surely_less(without, squares)):
                refuted = name, rest, without
                break
            told = data.streams.has_pose and len(data.streams.imu_t) > 0
            told = told or (without is not None and surely_less(squares, without))
            if name == MOUNTING and not told:
                # nothing ties the pose to gravity, or all that is known of the motion is the IMU's
                other = "IMU may be noisy" if len(data.streams.imu_t) else "pose may be tilted"
                words = f"{name}: the {other} instead; the thrust cannot tell"
                choice = _unsure(choice, name, words)
        if refuted is None:
            break
        name, rest, squares = refuted
        words = f"{name}: the sensors would agree better with it, but the motion would not follow "
        notes = (*choice.notes, words + "the thrust: it is not applied")
        # what made the sensors disagree is there all the same, and may have made the others
        unsure = choice.unsure | rest.sensors.keys()
        choice = dataclasses.replace(
            rest, alternatives=choice.alternatives, notes=notes, unsure=unsure
        )
        corrects = corrects[corrects.index(name) + 1 :]
    return choice


def moves_velocity(name: str, values: Mapping[str, float]) -> bool:
    """Whether an effect changes the velocities of the odometry, and not only the IMU's readings."""
    effect = EFFECTS[name]
    if effect.sense is None:
        return True
    reading = a_reading()
    return not np.array_equal(effect.sense(reading, **values).linear, reading.linear)


# ------------------------------------------------------------------ the wrench


class NoiseFound(NamedTuple):
    """The parameters of the noise of the wrench's reading, none where it is on no axis, and the
    axes (6,) that are lost in it."""

    values: Mapping[str, float]
    lost: NDArray[np.bool_]


def noise_of_wrench(search: Search, start: Fitted) -> NoiseFound:
    """The noise of the reading on the axes where the fit ``start`` is likelier without it; on none
    where the vehicle may follow what looks like noise. It has no parameter that is fitted, so no
    more is asked.

    What is read while a command is taken to rest is set to zero only where it is nothing but noise.
    Where an autopilot is among it, which keeps the vehicle upright, it is left as it is; and where
    noise then makes much of what the readings do there, the axis is lost.
    """
    config, problem = search.config, search.problem
    none = NoiseFound({}, np.zeros(6, dtype=bool))
    if NOISE in config.effects or not problem.reading_std.any():
        return none
    evidence = _evidence_of_noise(start, problem.reading_std, problem.lasts)
    possible = _does_not_follow(evidence)
    if not possible.any():
        return none
    std = np.where(possible, problem.reading_std, 0.0)
    follows = _follows_motion(start, with_noise(start.hypothesis, _on_axes(std)))
    lost = follows & (std > 0.0) & (_share_of_noise(start) > _LOUD)
    std = np.where(follows, 0.0, std)
    there = fit(problem, with_noise(start.hypothesis, _on_axes(std))) if std.any() else None
    use = ~problem.guided & ~lost
    likelier = bool(there and np.log(there.noise[use]).sum() < np.log(start.noise[use]).sum())
    return NoiseFound(_on_axes(std) if likelier else {}, lost)


def _on_axes(std: Array) -> dict[str, float]:
    names = {p.axis: p.name for p in EFFECTS[NOISE].parameters}
    return {names[a]: s for a, s in zip(AXES, std.tolist(), strict=True)}


def may_be_noise(rest: Fitted, axes: Container[str]) -> bool:
    """Whether the vehicle surely does not follow what looks like noise on one of the axes, although
    no noise is in the configuration: what follows it less then explains more than there is. So it
    may where noise lasts, even beside it: how alike neighbours are is known as one number only."""
    problem = rest.linearisation.problem
    surely = problem.lasts > 1
    if NOISE not in rest.hypothesis.config.effects and problem.reading_std.any():
        evidence = _evidence_of_noise(rest, problem.reading_std, problem.lasts)
        surely = surely | (evidence >= VERY_STRONG)
    return any(yes and axis in axes for axis, yes in zip(AXES, surely.tolist(), strict=True))


def noise_that_lasts(start: Fitted) -> NDArray[np.int64]:
    """For how many readings (6,) the noise of the wrench is the same: more than one where what
    rests differs so, and the vehicle does not follow it."""
    streams = start.linearisation.problem.streams
    std, lasts = wrench_scatter.noise_that_lasts(streams.demand)
    lasts[streams.guided] = 1
    possible = lasts > 1
    if possible.any():
        possible &= _does_not_follow(_evidence_of_noise(start, std * possible, lasts))
    return np.where(possible, lasts, streams.noise_lasts)


def _does_not_follow(evidence: Array) -> NDArray[np.bool_]:
    """The axes (6,) whose noise the vehicle may not follow, where it surely does not on these
    together, by twice the logarithm of the likelihood (6,) of each; otherwise none."""
    possible: NDArray[np.bool_] = evidence > -VERY_STRONG
    return possible & bool(evidence[possible].sum() >= VERY_STRONG)


def _evidence_of_noise(fitted: Fitted, std: Array, lasts: NDArray[np.int64]) -> Array:
    """Twice the logarithm (6,) of the likelihood that the vehicle does not follow what looks like
    noise of standard deviations (6,) on an axis, over that it does. What trembles can be a command
    (an autopilot passes on the noise of its gyro); and noise that is too small to show cannot be
    what a model gains by neglecting small commands: a trim can."""
    linearisation, effects = fitted.linearisation, fitted.hypothesis.effects
    problem = linearisation.problem
    still = problem.with_less(jitter(problem.streams.demand, std, lasts))
    trembling = problem.thrust(effects)[0] - still.thrust(effects)[0]
    columns = _own(linearisation, trembling[:, :, None] * np.eye(6))
    left = linearisation.error[:, None] + columns  # where the simulation does not follow it, either
    gain = np.sum(linearisation.error**2) - np.sum(left**2, axis=0)
    inflation = [mean_inflation(columns[:, [i]], left[:, i], linearisation.first) for i in range(6)]
    return gain / np.maximum(inflation, 1e-9)


def _follows_motion(start: Fitted, noisy: Hypothesis) -> NDArray[np.bool_]:
    """Axes (6,) on which what is read while a command is taken to rest, by the hypothesis
    ``noisy``, depends on attitude and velocity more than noise alone seems to: an autopilot's
    small commands are among it."""
    problem = start.linearisation.problem
    down = problem.steps.middle[:, 2]
    motion = np.hstack([down, problem.measured_means(), np.ones((len(down), 1))])
    basis = np.linalg.qr(motion)[0]

    def explained(readings: Array) -> Array:
        squares: Array = np.sum((basis.T @ readings) ** 2, axis=0)
        return squares / np.maximum(np.sum(readings**2, axis=0), np.finfo(float).tiny)

    read, noise = problem.thrust_at_rest(noisy.effects)
    chance = np.stack([explained(n) for n in noise])
    follows: NDArray[np.bool_] = explained(read) > (
        chance.mean(axis=0) + _SURE * chance.std(axis=0, ddof=1)
    )
    return follows


def _share_of_noise(start: Fitted) -> Array:
    """Of what the readings of each axis (6,) do to the simulated motion, beside what the parameters
    of the model could do instead, the share that noise of these readings does."""
    linearisation, effects = start.linearisation, start.hypothesis.effects
    problem = linearisation.problem
    read = problem.thrust(effects)[0][:, :, None] * np.eye(6)
    noise = problem.noisy_thrust(effects)
    each = (noise[:, :, None, :] * np.eye(6)[:, :, None]).reshape(len(noise), 6, -1)
    moved, by_noise = (np.sum(_own(linearisation, x) ** 2, axis=0) for x in (read, each))
    share: Array = by_noise.reshape(6, -1).mean(axis=1) / np.maximum(moved, np.finfo(float).tiny)
    return share


def _own(linearisation: Linearisation, force: Array) -> Array:
    """The sensitivities (R, C) to wrenches (K, 6, C), less what the parameters of the model
    explain of them."""
    columns, base = linearisation.sensitivity_to(force), linearisation.columns
    out: Array = columns - base @ scaled_solve(linearisation.linear.normal, base.T @ columns, 1e-9)
    return out


def with_noise(h: Hypothesis, values: Mapping[str, float]) -> Hypothesis:
    """The hypothesis with noise of the reading in its configuration; without, where empty."""
    effects = {n: v for n, v in h.config.effects.items() if n != NOISE}
    if values:
        effects = {**effects, NOISE: dict(values)}
    return dataclasses.replace(h, config=dataclasses.replace(h.config, effects=effects))


def noise_std(streams: Streams, values: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations of the parameters, of as many readings as they are from, and of what
    commands that never rest may have made of them."""
    lasts = streams.noise_lasts
    count = np.maximum(RESTING * len(streams.demand) / lasts, 1.0)
    relative = _on_axes(1.0 / np.sqrt(count))
    driven = _on_axes(np.where(lasts > 1, 0.0, wrench_scatter.driven(streams.demand)))
    return {n: float(np.hypot(value * relative[n], driven[n])) for n, value in values.items()}
