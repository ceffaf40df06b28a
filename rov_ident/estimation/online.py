"""An online estimator as node, replay and offline fit use it: messages in, reports out."""

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config, load
from rov_ident.config.prior import (
    attitude_covariance,
    covariance_beyond_driving,
    first_centre,
    gain_of,
    prior_of,
    rigid_body_covariance,
    turning_covariance,
)
from rov_ident.core.errors import UserError, require
from rov_ident.core.jit import interpreting
from rov_ident.core.messages import Array, Message, check_form
from rov_ident.core.states import CONTRADICTED, Level, State, is_known
from rov_ident.core.threads import one_blas_thread
from rov_ident.core.whiteness import JUDGED_TIME
from rov_ident.effects import parameter
from rov_ident.estimation import innovation_monitor, rls, ukf
from rov_ident.estimation.angular_acceleration import AngularAcceleration
from rov_ident.estimation.consistency import Consistency, consistency_of
from rov_ident.estimation.iterated_update import IteratedUpdate
from rov_ident.estimation.physical import Estimate, physical
from rov_ident.estimation.process_noise import FIRST_FORCE
from rov_ident.estimation.recent_messages import RecentMessages
from rov_ident.estimation.shared import INFO, informative_axes, noisy_axes, too_noisy
from rov_ident.reports.result import NORMAL
from rov_ident.sampling.sample import after_reset, joined
from rov_ident.sampling.sampler import Sampler

Kind = Literal["rls", "ukf"]

CENTRING_TIME = 1.0
"""s; the sampler takes over the estimated parameters of effects, and the excitation is summed up,
this often. A choice: both take many seconds, and cost more than a step."""
_RECENTRE = 0.2
"""Standard deviations by which a parameter of an effect must have moved for samples to follow: what
a sample is then wrong by is of second order in this."""
# A time (a lag, a delay) does not act linearly: "Times" in docs/live.md has the study.
_SETTLING_TIME = 5.0  # s; that samples are made with the same value of a time at least
_LEARNT = 0.5  # prior standard deviations, below which an estimate of a time is followed
_COMMANDS_KEPT = 10.0  # s; a choice: of commands, while there are no samples
_OUTDATED = 0.05  # prior standard deviations; by less a time never counts as having moved
EXCITATION_TIME = 20.0
"""s; the present excitation is that of this window and of the one before. A definition, published:
long enough for some manoeuvres of a few seconds, short enough to notice a vehicle at rest."""
_EXCITED = 0.05  # of the prior variance that this motion alone would remove; page.js has the same


ESTIMATORS: dict[Kind, ModuleType] = {"rls": rls, "ukf": ukf}
"""Each has problem, init, fold, step, estimate, variance and condition; and REASONS, USED and
REFUSALS for the ``reason`` of INFO."""


@dataclass(frozen=True)
class Report:
    """The coefficients as they may be published: finite, and physical as a whole.

    Arrays are (n,) in the order of ``names``; covariance (n, n). ``stamp`` [ns] is the time of the
    last sample used, 0 before the first. ``excitation`` is the share of the prior variance that the
    motion of the last 20 to 40 seconds would remove by itself. ``condition`` is that of the
    information's root in prior units: 1 before any data, and an estimate has some
    ``16 - log10(condition)`` digits; NaN where it is not known. ``consistency`` says whether model
    and data agree, None where it is not known; where they do not, intervals are wider, and nothing
    has converged. ``beyond_driving`` (n,) is the part of the variances that no driving reduces
    (:func:`~rov_ident.config.prior.covariance_beyond_driving`), without which convergence is
    judged; None where it is not known.
    """

    stamp: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    std: Array
    lower: Array
    upper: Array
    covariance: Array
    excitation: Array
    states: tuple[State, ...]
    messages: tuple[str, ...]
    condition: float = math.nan
    consistency: Consistency | None = None
    beyond_driving: Array | None = None

    @property
    def levels(self) -> tuple[Level, ...]:
        return tuple(state.level for state in self.states)

    @property
    def by_name(self) -> dict[str, float]:
        return dict(zip(self.names, self.values.tolist(), strict=True))

    @property
    def effects(self) -> dict[str, float]:
        """The parameters of effects, by names such as thruster_lag.time_constant."""
        return {name: value for name, value in self.by_name.items() if "." in name}


class Memory(NamedTuple):
    """All that is learnt: the estimator's State, what :class:`OnlineEstimator` keeps beside it,
    the kinematic filter's state; and the ``stamp`` [ns] of the last sample used."""

    state: Any
    gained: Array
    window: Array
    variance: Array
    safe: Array
    kinematics: NDArray[np.void]
    stamp: int


class Monitor(Protocol):
    """What looks for effects that the model lacks: see :mod:`rov_ident.discrepancy.monitor`."""

    @property
    def suspicions(self) -> Sequence[Any]: ...
    def reset(self) -> None: ...
    def take(
        self, samples: NDArray[np.void], commands: list[tuple[float, Array]]
    ) -> tuple[NDArray[np.void], Array] | None: ...
    def look(
        self, window: tuple[NDArray[np.void], Array], values: Mapping[str, float], credible: bool
    ) -> None: ...


class OnlineEstimator:
    """Sampler and estimator in one: :meth:`push` messages, ask for a :meth:`report` at any time.

    ``config`` is the path of a parameter file, or a Config; ``kind`` is "rls" or "ukf". ``counts``
    tells how many messages and samples were used and, by reason, refused.

    Raises
    ------
    UserError
        If the parameter file is wrong, or there is no such estimator.
    """

    def __init__(self, config: str | os.PathLike[str] | Config, kind: Kind) -> None:
        require(str, "a name", kind=kind)
        config = load(config).with_nuisance
        if kind not in ESTIMATORS:
            raise UserError(f"there is no estimator '{kind}': use {' or '.join(ESTIMATORS)}")
        self.config = config
        self.kind = kind
        self.prior = prior_of(config, effects=True)
        times = [parameter(*key).unit == "s" for key in config.estimate_effects]
        self._is_time = np.array(times, dtype=bool)
        self._module = ESTIMATORS[kind]
        self._task = self._module.problem(config)
        self._informative = informative_axes(config)
        self.sampler = Sampler(config)
        self._recent = RecentMessages()
        self.monitor: Monitor | None = None
        self._about: Array  # (k,): values of the parameters of effects that samples are made with
        self._centred: float  # s: since when
        self._enabled = True
        self._paused = False
        self.reset()

    def reset(self) -> None:
        """Back to the prior; the input buffers and counts go on, in whatever frames come next."""
        self.sampler.validation.forget_frames()
        self._state = self._module.init(self._task)
        self._update = IteratedUpdate(self._module, self._state)
        self._last_t = math.nan
        self._turning = AngularAcceleration()
        self._reading_noise = np.zeros(6)  # of the last sample
        self._recalled = 0  # ns: the stamp before the first sample
        # information over the prior's: in the window that is filling, and in the one before
        self._gained = np.zeros((2, len(self.prior.names)))
        self._window = np.zeros(1)  # s of the window that is filling
        estimate: Estimate = self._module.estimate(self._task, self._state, self.prior)
        self._variance = estimate.std**2
        self._sample_counts: Counter[str] = Counter()
        self._safe = self.prior.mean.copy()
        self._centre(first_centre(self.config))
        self._learnt_about, self._settled = self._about, math.nan
        if self.monitor is not None:
            self.monitor.reset()
        self._begin_at(self.memory())

    def configure(self, config: Config) -> None:
        """Take other settings of the same model and coefficients; what is learnt stays."""
        self.config = config = config.with_nuisance
        self._task = self._module.problem(config)
        self._update.begin(self._state)
        self.sampler.configure(config)
        self._centre(self._effect_values)

    def attach(self, monitor: Monitor) -> None:
        """Let a monitor see from now on what the estimator sees."""
        self.sampler.commands = []
        self.monitor = monitor

    @property
    def enabled(self) -> bool:
        """Whether samples are used; the inputs are followed all the same."""
        return self._enabled

    @enabled.setter
    def enabled(self, value: bool) -> None:
        self._paused = self._paused or not value
        if value != self._enabled:
            self._begin_at(self.memory())
        self._enabled = value

    @property
    def counts(self) -> Counter[str]:
        return self.sampler.counts + self._sample_counts

    @property
    def state(self) -> object:
        """The estimator's state, for a comparison."""
        return self._state

    def push(self, role: str, message: Message) -> NDArray[np.void]:
        """Take one message as it is on the wire; INFO (k,) of the samples this completed.

        ``role`` is "odom" with an Odometry, "imu" with an Imu, "wrench" with a Wrench; their axes
        follow from their frame ids and the configuration, as under ROS. What is wrong with a
        message is counted, not raised.

        Raises
        ------
        UserError
            If the message is of another type or shape than its role has.
        """
        check_form(role, message)
        return self.take(self._sampled(role, message))

    def push_all(
        self, messages: Iterable[tuple[str, Message]], due: Callable[[int], bool] = lambda _: False
    ) -> Iterator[NDArray[np.void]]:
        """:meth:`push` messages as they are asked for, with the same result, but in less time.

        Samples wait to be folded together: until there are no more messages, until the parameters
        of effects are to be looked at, or until the stamp [ns] of one is ``due``. Their INFO (k,).
        """
        waiting: list[NDArray[np.void]] = []
        for role, message in messages:
            samples = self._sampled(role, message)
            if not len(samples):
                continue
            waiting.append(samples)
            if self._is_due(samples) or due(self.stamp_of(samples["t"][-1])):
                yield self.take(joined(waiting))
                waiting = []
        if waiting:
            yield self.take(joined(waiting))

    def follow(self, messages: Iterable[tuple[str, Message]]) -> None:
        """:meth:`push` all messages of a recording and :meth:`flush`."""
        for _ in self.push_all(messages):
            pass
        self.flush()

    def _sampled(self, role: str, message: Message) -> NDArray[np.void]:
        if self._is_time.any():
            self._recent.add(role, message)
        return self.sampler.push(role, message)

    def _is_due(self, samples: NDArray[np.void]) -> bool:
        """Whether parameters of effects are to be looked at after samples (k,)."""
        return not abs(float(samples["t"][-1]) - self._centred) < CENTRING_TIME

    def flush(self) -> NDArray[np.void]:
        """The input has ended or stopped: use what still waits for a late topic."""
        info = self.take(self.sampler.flush())
        if self._enabled:
            self._state = self._update.iterate(self._task, self._state)
        return info

    def take(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        """Fold samples (k,) into the estimate unless disabled; INFO (k,)."""
        if len(samples) == 0 or not self._enabled:
            self._forget_commands()
            return np.zeros(0, dtype=INFO)
        if samples["anew"].any():
            samples = after_reset(samples)
            self._begin_with(self._origin)
            self._recent.clear()
            if self.monitor is not None:
                self.monitor.reset()
        if self._paused:
            samples = samples.copy()
            samples["restart"][0] = True
            self._paused = False
        info = self._fold(samples)
        self._reading_noise = samples["reading_noise"][-1]
        self._last_t = float(samples["t"][-1])
        for reason in info["reason"].tolist():
            if reason in self._module.REFUSALS:
                self._sample_counts[f"sample: {self._module.REASONS[reason]}"] += 1
        self._window += sum(samples["dt"].tolist())
        self._turning.add(samples)
        if self._is_due(samples):
            self._turning.follow()
            self._centred = self._last_t
            with one_blas_thread():
                self._follow_excitation()
                if len(self._about):
                    self._recentre()
            self._recent.forget(self._last_t, self.memory())
        if self.monitor is not None and self.sampler.commands is None:
            self.sampler.commands = []  # it was attached while the sampler was replaced
        elif self.monitor is not None and self.sampler.commands is not None:
            window = self.monitor.take(samples, self.sampler.commands)
            if window is not None:
                report = self.report()
                asked = report.consistency
                credible = asked is None or (asked.possible and asked.judged)
                self.monitor.look(window, report.by_name, credible)
        return info

    def _forget_commands(self) -> None:
        """Of those that the monitor has not taken, as there are no samples: all but the latest."""
        commands = self.sampler.commands
        if commands and commands[-1][0] - commands[0][0] > _COMMANDS_KEPT:
            del commands[:-1]

    def _fold(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        """Fold samples (k,) into the state, and iterate the update at the times it has set."""
        fold, task, update = self._module.fold, self._task, self._update
        if samples["t"][0] < self._last_t:  # the clock was set back
            update.begin(self._state)
        infos = []
        while len(samples):
            count = update.until_due(samples)
            self._state, info = fold(task, self._state, samples[:count])
            self._state = update.after(task, self._state, samples[:count])
            samples = samples[count:]
            infos.append(info)
        return np.concatenate(infos) if len(infos) > 1 else infos[0]

    def next_record(self) -> None:
        """Another record follows: inputs begin anew, what is learnt stays."""
        before, self.sampler, self._settled = self.sampler, Sampler(self.config), math.nan
        self.sampler.commands = before.commands
        self.sampler.counts.update(before.counts)
        self._update.begin(self._state)
        self._centre(self._effect_values)
        self._begin_at(self.memory())

    @property
    def _effect_values(self) -> dict[str, float]:
        """The parameters of effects as samples have them."""
        return dict(zip(self.config.effect_names, self._about.tolist(), strict=True))

    def _recentre(self, at_once: bool = False) -> None:
        """Have the sampler take over the parameters of effects as they are estimated now.

        But not for changes far below their uncertainty, as samples are right to first order. A time
        is followed once the data know it. Once it has moved by more than its uncertainty, all is
        learnt anew: information gained about another value claims to know what it does not.
        ``at_once``: a memory was recalled.
        """
        raw: Estimate = self._module.estimate(self._task, self._state, self.prior)
        # a lag that asks for a negative mass beside it is no lag
        whole = physical(self.config.dynamics, self.prior, raw)
        own = slice(len(self.config.estimate), None)
        now, unit = whole[own], self.prior.std[own]
        std = np.sqrt(self._module.variance(self._task, self._state)[own])
        if math.isnan(self._settled):
            self._settled = self._last_t
        early = abs(self._last_t - self._settled) < _SETTLING_TIME
        if not at_once:
            waits = early | (std >= _LEARNT * unit)
            now = np.where(self._is_time & waits, self._about, now)
        if not (np.abs(now - self._about) > _RECENTRE * std).any():
            return
        whole[own] = now
        self._centre(dict(zip(self.prior.names, whole.tolist(), strict=True)))
        outdated = np.maximum(_OUTDATED * unit, raw.std[own])
        moved = self._is_time & (np.abs(now - self._learnt_about) > outdated)
        if moved.any() and not at_once:
            self._learn_again()

    def _learn_again(self) -> None:
        """From the recent messages, with the parameters of effects as samples have them now.

        Not while kernels are interpreted, when it would take minutes.
        """
        if interpreting():
            self._begin_with(self._origin)
            return
        memory, sampler, samples = self._recent.again(
            self.config, self._centre_config, self._origin, self.sampler
        )
        self._begin_with(memory)
        if len(samples) == 0:  # the messages before were forgotten
            return
        self.sampler, samples = sampler, after_reset(samples)
        while len(samples):
            count = int(np.sum(samples["t"] < samples["t"][0] + CENTRING_TIME))
            self._fold(samples[:count])
            self._window += sum(samples["dt"][:count].tolist())
            self._last_t = float(samples["t"][count - 1])
            self._follow_excitation()
            self._recent.forget(self._last_t, self.memory())
            samples = samples[count:]
        self._centred = self._last_t

    def _centre(self, values: Mapping[str, float]) -> None:
        """Have samples made with these values of the parameters of effects, all of them, and of
        coefficients: with these a rigid body is heavier or lighter."""
        self._centred = self._last_t
        self._about = np.array([values[name] for name in self.config.effect_names])
        self._centre_config = self.config.with_values(values)
        if self.config.effect_names:
            self.sampler.recentre(self._centre_config)

    def memory(self) -> Memory:
        """What is learnt so far, for `checkpoint`. The arrays are not to be changed.

        The velocity is not worth keeping: who recalls it begins with a measured one.
        """
        return Memory(
            self._state,
            self._gained.copy(),
            self._window.copy(),
            self._variance,
            self._safe,
            self.sampler.kinematic_filter.state.copy(),
            self.stamp,
        )

    def recall(self, memory: Memory) -> None:
        """Go on from what another run of the same configuration has learnt.

        Raises
        ------
        UserError
            If the numbers make no estimate; then nothing has changed.
        """
        estimate: Estimate = self._module.estimate(self._task, memory.state, self.prior)
        if not (np.isfinite(estimate.values).all() and np.isfinite(estimate.covariance).all()):
            raise UserError("its numbers are not finite")
        self.reset()
        self._recalled = memory.stamp
        self._begin_at(memory)
        self._begin_with(memory)
        self.sampler.kinematic_filter.begin_with(memory.kinematics)
        self._paused = True  # whatever has happened in between
        if self.config.estimate_effects:
            self._recentre(at_once=True)
            self._learnt_about = self._about

    def _begin_at(self, memory: Memory) -> None:
        """What is learnt anew begins with this memory."""
        self._origin = memory
        self._recent.clear()

    def _begin_with(self, memory: Memory) -> None:
        """Know what is in the memory and nothing else."""
        self._state, self._centred = memory.state, math.nan
        self._update.begin(self._state)
        self._learnt_about, self._settled = self._about, math.nan
        self._gained, self._window = memory.gained.copy(), memory.window.copy()
        self._variance, self._safe = memory.variance, memory.safe

    def _follow_excitation(self) -> None:
        """Information gained per coefficient, in windows of EXCITATION_TIME."""
        variance: Array = self._module.variance(self._task, self._state)
        gained = self.prior.std**2 * (1.0 / variance - 1.0 / self._variance)
        self._gained[0] += np.maximum(gained, 0.0)
        self._variance = variance
        if self._window >= EXCITATION_TIME:
            self._gained[1], self._gained[0] = self._gained[0], 0.0
            self._window[0] = 0.0

    @one_blas_thread()
    def report(self, sensors: Mapping[str, float] | None = None) -> Report:
        """The present coefficients, made physical, with their state in words.

        ``sensors`` are test ratios of the odometry's parts against the IMU; None: those of the
        messages pushed since the last record began, which are all that the sampler knows of.
        """
        if sensors is None:
            sensors = self.sampler.kinematic_filter.contradictions
        raw: Estimate = self._module.estimate(self._task, self._state, self.prior)
        consistency = consistency_of(
            self.config, self.prior, raw.values, self._unexplained(), self._whiteness(),
            sensors, raw.std, self._not_followed(raw.values),
        )  # fmt: skip
        # before any disagreement widens the covariance, which ends at the prior's: with a thrust
        # that is held at its limit, drag and inertia go as the data have it
        values = physical(self.config.dynamics, self.prior, raw)
        gain = gain_of(raw.covariance, self.prior.std)
        turning = self._turning.mean_square
        lasting = self.sampler.kinematic_filter.lasting_attitude_error
        covariance = (
            raw.covariance
            + rigid_body_covariance(self.config, raw.names, raw.values, gain)
            + turning_covariance(self.config, raw.names, raw.values, turning, lasting)
        )
        moved = raw.values - self.prior.mean
        raw = replace(raw, covariance=consistency.widened(covariance, self.prior.std, moved))
        diverged = not (np.isfinite(values).all() and np.isfinite(raw.covariance).all())
        if diverged:
            values, std = self._safe, self.prior.std
            covariance = np.diag(std**2)
        else:
            self._safe, std, covariance = values, raw.std, raw.covariance
        gained = self._gained.sum(axis=0)
        excitation = gained / (1.0 + gained)
        waiting = self._waiting(values)
        judged = [
            (State.DIVERGED, "diverged: the last good value is held, call reset")
            if diverged
            else self._judge(i, values, std, raw.values, excitation, consistency, waiting.get(i))
            for i in range(len(values))
        ]
        beyond_driving = np.zeros(len(values))
        if not diverged:
            seconds = float(self._state.monitor["judged"].max())
            trim = attitude_covariance(self.config, raw.names, seconds, gain)
            beyond = covariance_beyond_driving(
                self.config, raw.names, raw.values, gain, raw.by_axis
            )
            covariance, beyond_driving = covariance + trim + beyond, np.diag(beyond)
            std = np.sqrt(np.diag(covariance))
        # A bound cuts the interval too: no part of it is physically possible.
        upper = np.minimum(values + NORMAL * std, self.prior.upper)
        upper = np.where(self.prior.negative, np.minimum(upper, 0.0), upper)
        return Report(
            self.stamp,
            self.prior.names,
            self.prior.units,
            values,
            std,
            np.maximum(values - NORMAL * std, self.prior.lower),
            upper,
            covariance,
            excitation,
            tuple(state for state, _ in judged),
            tuple(text for _, text in judged),
            self._module.condition(self._task, self._state),
            consistency,
            beyond_driving,
        )

    def _waiting(self, values: Array) -> dict[int, str]:
        """Why some coefficients, by their index, are not updated at present; ``values`` (n,)."""
        if not self._reading_noise.any():
            return {}
        noisy = self._noisy_axes(values, self._reading_noise)
        held = enumerate(self._informative & noisy)
        return {i: too_noisy(axes) for i, axes in held if axes.any()}

    def _noisy_axes(self, values: Array, reading_noise: Array) -> NDArray[np.bool_]:
        coefficients = dict(zip(self.config.estimate, values.tolist(), strict=False))
        mass = self.config.dynamics.with_values(coefficients).mass_matrix
        return noisy_axes(mass, reading_noise, self._state.monitor)

    def _not_followed(self, values: Array) -> Array:
        """(6,): variance density of what is read of the wrench and does not move the vehicle."""
        found = self.sampler.noise_found
        if not found.any():
            return found
        return np.where(self._noisy_axes(values, found), found, 0.0)

    def _unexplained(self) -> Array:
        """(6,): force that the model lacks over the working wrench, NaN where that is not known."""
        monitor, first = self._state.monitor, self._task.process["first"][0]
        share = FIRST_FORCE * np.sqrt(monitor["density"] / first)
        return np.where(monitor["seen"] > innovation_monitor.TIME, share, np.nan)

    def _whiteness(self) -> Array:
        """(6,): power of innovations added up over a second, NaN where that is not known."""
        monitor = self._state.monitor
        return np.where(monitor["judged"] > JUDGED_TIME, monitor["power"], np.nan)

    @property
    def stamp(self) -> int:
        """Of the last sample used [ns], also before a checkpoint; 0: of none."""
        if math.isnan(self._last_t) or self.sampler.origin is None:
            return self._recalled
        return self.stamp_of(self._last_t)

    def stamp_of(self, t: float) -> int:
        """The time t [s] of a sample in ns."""
        return (self.sampler.origin or 0) + round(float(t) * 1e9)

    def _judge(
        self,
        i: int,
        values: Array,
        std: Array,
        raw: Array,
        excitation: Array,
        consistency: Consistency,
        waiting: str | None,
    ) -> tuple[State, str]:
        """The state of a coefficient, and a message that begins with the word for it."""
        if abs(raw[i] - values[i]) > CONTRADICTED * std[i]:
            return State.AT_BOUND, "at bound: held at its physical bound, the data contradict it"
        excited = excitation[i] >= _EXCITED
        known = is_known(values[i], std[i], self.prior.std[i])
        if waiting and not (known and consistency.consistent):
            return State.HELD, f"held: {waiting}"
        if consistency.doubt and (known or (excited and not consistency.consistent)):
            return State.CONVERGING, f"converging: {consistency.doubt}"
        if known:
            return State.CONVERGED, "converged" if excited else "converged: not excited now"
        if excited:
            return State.CONVERGING, "converging"
        return State.HELD, "held: not excited, the motion does not show it"
