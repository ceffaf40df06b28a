"""What a live monitor remembers of the last minutes: windows of motion as normal equations.

Each window of a few seconds is simulated with the coefficients as they are estimated then; the
sensitivities to every watched parameter, at its null, are taken against what is left unexplained.
Windows of different coefficients theta_w add up as normal equations about a common origin::

    J'J,  J'(r + J theta_w),  r'r + 2 r'J theta_w + (J theta_w)'(J theta_w)

Not watched are effects on sensors, which do not act on the wrench; a wave, whose frequency takes a
search; and the slow fade of a battery, which in some minutes looks like a thruster gain. Effects
with an onset are watched as if they had always been there: the memory is short enough.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.config.prior import typical
from rov_ident.core.messages import Array
from rov_ident.discrepancy.held_out import WINDOW
from rov_ident.discrepancy.hypothesis import (
    COEFFICIENTS,
    Hypothesis,
    Key,
    coefficient_sizes,
    parameter,
    role_of,
    units,
)
from rov_ident.discrepancy.linearisation import Linearisation, LinearProblem, linearise
from rov_ident.discrepancy.multiple_shooting import Motion
from rov_ident.discrepancy.windowed_problem import FEWEST, WindowedProblem
from rov_ident.discrepancy.wrench_smoothing import Known, Reading, Smoothed, matters, smoothed
from rov_ident.effects import EFFECTS
from rov_ident.effects.base import Effect
from rov_ident.model.coefficients import parse
from rov_ident.model.equations import Model
from rov_ident.model.scales import authority
from rov_ident.sampling.raw_streams import Streams, inspected

MEMORY = 36  # windows: three minutes, the length of a bag of the study (docs/explain-bench.md)

_SPACING = 0.045  # s; closer measurements (above 20 Hz) add cost, hardly information
_NOISE_TIME = 60.0  # s; over which the size of the residual is followed: twelve windows


class Sums(NamedTuple):
    """Normal equations; P parameters: the estimated ones, then those watched."""

    normal: Array  # (P, P)
    moment: Array  # (P,): J'(r + J theta), theta zero for those watched
    power: float  # of r + J theta


class Window(NamedTuple):
    """What is remembered of a window, C of its parameters being watched."""

    t: float  # s, of its end
    sums: Sums
    residuals: int  # so many of them
    strength: Array  # (6, C) squared wrenches of a unit of each watched one, over the authority
    doubt: "Doubt | None"  # where the wrench was smoothed


class Doubt(NamedTuple):
    """What noise of the wrench's reading leaves open in a window: the equations with sensitivities
    along the motion that the wrench as read makes, and what of ``normal`` is only errors of the
    smoothed wrench, which act on sensitivities."""

    as_read: Sums
    errors: Array  # (P, P)


class Scored(NamedTuple):
    """A window with all that is watched: its problem, sensitivities (R, P), the size (6,) of what
    it leaves unexplained, and the wrenches (K, 6, C) of what is watched."""

    linear: LinearProblem
    columns: Array
    left: Array
    force: Array


class Task(NamedTuple):
    config: Config
    base: tuple[Key, ...]
    units: tuple[tuple[Key, ...], ...]
    prior: Array  # (B,) precision of the base about its values in the configuration
    centre: Array  # (B,)
    sizes: Mapping[Key, float]  # at which a watched parameter matters

    @property
    def watched(self) -> tuple[Key, ...]:
        return tuple(key for unit in self.units for key in unit)


class State(NamedTuple):
    """All that the next window needs."""

    windows: tuple[Window, ...]
    noise: Array  # (6,): standard deviation of what a window leaves unexplained
    reading: Reading


def is_watched(effect: Effect) -> bool:
    """Whether an effect can be scored as it stands: it acts on the wrench, and at once."""
    searched = {"frequency", "fixed", "limit", *(() if effect.of_thrusters else ("shape",))}
    return not effect.of_sensors and not any(p.role in searched for p in effect.parameters)


def task_of(config: Config) -> Task:
    """What is to be watched in the model of a configuration."""
    base = (*((COEFFICIENTS, name) for name in config.estimate), *config.estimate_effects)
    size, given = coefficient_sizes(config.model), Hypothesis(config, {})
    prior = [size[k] if k in size else parameter(k).typical for k in base]
    lacking = [e for e in EFFECTS.values() if is_watched(e) and e.name not in config.effects]
    groups = [u for e in lacking for u in units(e, given, ("amplitude", "place"))]
    values = [given.value(key) for key in base]
    sizes = _sizes(config, [key for unit in groups for key in unit])
    return Task(config, base, tuple(groups), np.array(prior) ** -2.0, np.array(values), sizes)


def _sizes(config: Config, keys: Sequence[Key]) -> dict[Key, float]:
    """The size at which each parameter matters; of a place times its amplitude."""
    found = tuple(parse(name) for section, name in keys if section == COEFFICIENTS)
    absent = typical(Model(config.model.body, found, np.zeros(len(found)))).tolist()
    sizes = {(COEFFICIENTS, c.name): size for c, size in zip(found, absent, strict=True)}
    for key in keys:
        if key[0] != COEFFICIENTS:
            amplitude = next(p for p in EFFECTS[key[0]].parameters if p.role == "amplitude")
            unit = amplitude.typical if role_of(key) == "place" else 1.0
            sizes[key] = unit * parameter(key).typical
    return sizes


def init(task: Task) -> State:
    odometry, imu = task.config.odometry, task.config.imu
    angular = min(odometry.angular_std, imu.gyro_std)
    return State((), np.repeat([odometry.linear_std, angular], 3), Reading())


def step(
    task: Task, state: State, samples: NDArray[np.void], demands: Array, values: Mapping[str, float]
) -> State:
    """Take in a window: samples (k,) of SAMPLE, the commands (d, 7) [t, wrench] that led to them,
    and the estimated coefficients; the same state where it says nothing."""
    streams = _streams(samples, demands)
    if streams is None:
        return state
    problem = WindowedProblem(streams, [(float(streams.t[0]), float(streams.t[-1]) + 1e-6)])
    if len(problem.first) != 1:
        return state
    names = [n if section == COEFFICIENTS else f"{section}.{n}" for section, n in task.base]
    h = Hypothesis(task.config, {k: values[n] for k, n in zip(task.base, names, strict=True)})
    new = np.searchsorted(streams.demand_t, streams.t[0], side="right") - 1
    reading = state.reading.after(streams.demand[max(new, 0) :], task.config.wrench.relative_std)
    problem.reading_std = reading.std
    plain = linearise(problem, h, problem.measured_starts(), state.noise)
    if plain is None:
        return state
    theta, smooth = np.array(list(h.values.values())), None
    if matters(plain):
        known = _known(task, state.windows, theta)
        smooth, reading = smoothed(plain, reading, known)
    best = _scored(task, plain if smooth is None else smooth.smooth)
    window = Window(
        float(streams.t[-1]),
        _sums(best.linear, theta),
        best.linear.count,
        np.sum((best.force / authority(h.model)[:, None]) ** 2, axis=0),
        None if smooth is None else _doubt(task, smooth, best, theta),
    )
    blend = min(WINDOW / _NOISE_TIME, 1.0) if state.windows else 1.0
    noise = np.sqrt((1.0 - blend) * state.noise**2 + blend * np.maximum(best.left, 1e-6) ** 2)
    return State((*state.windows[-(MEMORY - 1) :], window), noise, reading)


def _known(task: Task, windows: Sequence[Window], theta: Array) -> Known:
    """What the windows say of the estimated parameters, the estimates theta (B,) as a prior."""
    b = len(theta)
    normal = np.diag(task.prior) + sum(w.sums.normal[:b, :b] for w in windows)
    return Known(normal, task.prior * theta + sum(w.sums.moment[:b] for w in windows))


def _scored(task: Task, linearisation: Linearisation) -> Scored:
    force = _columns(task, linearisation.problem, linearisation.hypothesis, linearisation.motion)
    columns = linearisation.sensitivity_to(force)
    linear = linearisation.having(task.watched, columns)
    over, expected = linearisation.over_variance(linearisation.error)
    left = linearisation.noise * np.sqrt(np.mean(over**2, axis=0) / np.mean(expected, axis=0))
    return Scored(linear, np.hstack([linearisation.columns, columns]), left, force)


def _doubt(task: Task, smooth: Smoothed, best: Scored, theta: Array) -> Doubt:
    as_read, drawn = (_scored(task, s) for s in (smooth.as_read, smooth.drawn))
    errors = drawn.columns - best.columns
    return Doubt(_sums(as_read.linear, theta), errors.T @ errors)


def _sums(linear: LinearProblem, theta: Array) -> Sums:
    """The normal equations about the common origin, of a window at the coefficients theta (B,)."""
    b, gradient = len(theta), linear.gradient[0]
    through = linear.normal[:, :b] @ theta
    power = float(linear.rss[0] + 2.0 * gradient[:b] @ theta + theta @ through[:b])
    return Sums(linear.normal, gradient + through, power)


def _columns(task: Task, problem: WindowedProblem, h: Hypothesis, motion: Motion) -> Array:
    """The wrench (K, 6, C) of a unit of each watched parameter; of a place of attachment that of
    the effect's amplitude times each coordinate."""
    plain = [key for key in task.watched if role_of(key) != "place"]
    found = dict(zip(plain, problem.columns(h, motion, plain).transpose(2, 0, 1), strict=True))
    for key in task.watched:
        if role_of(key) == "place":
            amplitude = next(k for k in plain if k[0] == key[0])
            arm = parameter(key).typical
            there = Hypothesis(h.config, h.values, {key: arm})
            vars(there).update(model=h.model, equations=h.equations)  # the same, and slow to make
            column = problem.columns(there, motion, [amplitude])[:, :, 0]
            found[key] = (column - found[amplitude]) / arm
    return np.stack([found[key] for key in task.watched], axis=2)


def _streams(samples: NDArray[np.void], demands: Array) -> Streams | None:
    """The measured part of the samples as the offline search has it, over ground."""
    kept, last = [], -np.inf
    for i in np.flatnonzero(samples["measured"]).tolist():
        if samples["t"][i] - last >= _SPACING:
            kept.append(i)
            last = samples["t"][i]
    if len(kept) < FEWEST or len(demands) == 0:
        return None
    t, orientation, nu, water = (samples[n][kept] for n in ("t", "orientation", "nu", "water"))
    nu[:, :3] += water
    unknown, none = np.zeros((len(t), 3)), np.zeros((0, 3))
    held = demands[:, 0].copy(), demands[:, 1:].copy()
    driven = samples["inputs"][:, 1]
    times = samples["t"].copy() if driven.any() else np.zeros(0)
    read = Streams(
        t, unknown, orientation, nu, np.zeros(0), none, none, *held, times, driven[: len(times)]
    )
    return inspected(read)
