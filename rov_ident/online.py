"""An online estimator as node, replay and offline fit use it: messages in, reports out."""

import enum
import math
from collections import Counter
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident import rls, ukf
from rov_ident.config import Config
from rov_ident.effects import EFFECTS
from rov_ident.errors import UserError
from rov_ident.estimate import Estimate, physical, prior_of
from rov_ident.messages import Array, Message
from rov_ident.samples import Sampler, believed

if TYPE_CHECKING:
    from rov_ident.watch import Watcher

Kind = Literal["rls", "ukf"]
ESTIMATORS: dict[Kind, ModuleType] = {"rls": rls, "ukf": ukf}

CENTRING_TIME = 1.0  # s; the sampler takes over the estimated parameters of effects this often
EXCITATION_TIME = 20.0  # s; the present excitation is that of this window and of the one before
_EXCITED = 0.05  # share of the prior variance that this motion alone would remove
_CONVERGED = 0.1  # standard deviation over the value (or the prior's) at which it counts as known
_QUANTILE = 1.959963984540054  # of the normal distribution, 97.5 %


class Level(enum.IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class Report:
    """The coefficients as they may be published: finite, and physical as a whole.

    Arrays are (n,) in the order of ``names``; covariance (n, n). ``stamp`` [ns] is the time of the
    last sample used, 0 before the first. ``excitation`` is the share of the prior variance that the
    motion of the last 20 to 40 seconds would remove by itself. ``condition`` is that of the
    information's root in prior units: 1 before any data, and an estimate has some
    ``16 - log10(condition)`` digits; NaN where it is not known.
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
    levels: tuple[Level, ...]
    messages: tuple[str, ...]
    condition: float = math.nan

    @property
    def effects(self) -> dict[str, float]:
        """The parameters of effects, by names such as thruster_lag.time_constant."""
        values = zip(self.names, self.values.tolist(), strict=True)
        return {name: value for name, value in values if "." in name}


class Memory(NamedTuple):
    """All that an estimator has learnt; arrays, but for ``stamp`` [ns] of the last sample used.

    ``state`` is a State of the estimator's module; the others are what :class:`OnlineEstimator`
    keeps beside it, and the sampler's kinematics with the biases of the IMU.
    """

    state: Any
    gained: Array
    window: Array
    variance: Array
    safe: Array
    kinematics: NDArray[np.void]
    stamp: int


class OnlineEstimator:
    """Sampler and estimator in one: :meth:`push` messages, ask for a :meth:`report` at any time.

    ``counts`` tells how many messages and samples were used and, by reason, refused.
    """

    def __init__(self, config: Config, kind: Kind) -> None:
        self.config = config
        self.kind = kind
        self.prior = prior_of(config, effects=True)
        self._module = ESTIMATORS[kind]
        self._task = self._module.problem(config)
        self.sampler = Sampler(config)
        self.watcher: Watcher | None = None
        self._enabled = True
        self._paused = False
        self.reset()

    def reset(self) -> None:
        """Back to the prior; the input buffers and counts go on."""
        self._state = self._module.init(self._task)
        self._last_t = math.nan
        self._recalled = 0  # ns: the stamp before the first sample
        self._centred = -math.inf
        # information over the prior's: in the window that is filling, and in the one before
        self._gained = np.zeros((2, len(self.prior.names)))
        self._window = np.zeros(1)  # s of the window that is filling
        self._variance = self._estimate().std ** 2
        self._sample_counts: Counter[str] = Counter()
        self._safe = self.prior.mean.copy()
        if self.config.estimate_effects:
            self.sampler.recentre(self.config)
        if self.watcher is not None:
            self.watcher.reset()
        self._origin = self.memory()

    def configure(self, config: Config) -> None:
        """Take other settings of the same model and coefficients; what is learnt stays."""
        self.config = config
        self._task = self._module.problem(config)
        self.sampler.configure(config)
        self._centred = -math.inf

    def show(self, watcher: "Watcher") -> None:
        """Let a watcher see from now on what the estimator sees."""
        self.sampler.demands = []
        self.watcher = watcher

    @property
    def enabled(self) -> bool:
        """Whether samples are used; the inputs are followed all the same."""
        return self._enabled

    @enabled.setter
    def enabled(self, value: bool) -> None:
        self._paused = self._paused or not value
        self._enabled = value

    @property
    def counts(self) -> Counter[str]:
        return self.sampler.counts + self._sample_counts

    @property
    def state(self) -> object:
        """The estimator's state, for a comparison."""
        return self._state

    def push(self, role: str, message: Message) -> NDArray[np.void]:
        """Take one message as it is on the wire; INFO (k,) of the samples this completed."""
        return self.take(self.sampler.push(role, message))

    def flush(self) -> NDArray[np.void]:
        """The input has ended or stopped: use what still waits for a late topic."""
        return self.take(self.sampler.flush())

    def take(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        """Fold samples (k,) into the estimate unless disabled; INFO (k,)."""
        if len(samples) == 0 or not self._enabled:
            return np.zeros(0, dtype=self._module.INFO)
        if samples["anew"].any():
            samples = believed(samples)
            self._begin_with(self._origin)
            if self.watcher is not None:
                self.watcher.reset()
        if self._paused:
            samples = samples.copy()
            samples["restart"][0] = True
            self._paused = False
        self._state, info = self._module.fold(self._task, self._state, samples)
        self._last_t = float(samples["t"][-1])
        for reason in self._module.REFUSALS:
            if count := int(np.count_nonzero(info["reason"] == reason)):
                self._sample_counts[f"sample: {self._module.REASONS[reason]}"] += count
        self._watch(float(samples["dt"].sum()))
        if self.config.estimate_effects and abs(self._last_t - self._centred) >= CENTRING_TIME:
            self._centred = self._last_t
            self._recentre()
        if self.watcher is not None and self.sampler.demands is not None:
            window = self.watcher.take(samples, self.sampler.demands)
            if window is not None:
                report = self.report()
                values = zip(report.names, report.values.tolist(), strict=True)
                self.watcher.look(window, dict(values))
        return info

    def _recentre(self) -> None:
        """Have the sampler take over the parameters of effects as they are estimated now."""
        # The rigid body is the estimator's own, and what acts on it all but linear.
        found = {
            name: value
            for name, value in self.report().effects.items()
            if EFFECTS[name.partition(".")[0]].body is None
        }
        self.sampler.recentre(self.config.with_values(found))

    def memory(self) -> Memory:
        """What is learnt so far, for :mod:`rov_ident.checkpoint`. The arrays are not to be changed.

        The velocity is not worth keeping: who recalls it begins with a measured one.
        """
        return Memory(
            self._state,
            self._gained.copy(),
            self._window.copy(),
            self._variance,
            self._safe,
            self.sampler.kinematics,
            self.stamp,
        )

    def recall(self, memory: Memory) -> None:
        """Go on from what another run of the same configuration has learnt.

        Raises
        ------
        UserError
            If the numbers make no estimate; then nothing has changed.
        """
        estimate = self._module.estimate(self._task, memory.state, self.prior)
        if not (np.isfinite(estimate.values).all() and np.isfinite(estimate.covariance).all()):
            raise UserError("its numbers are not finite")
        self.reset()
        self._origin, self._recalled = memory, memory.stamp
        self._begin_with(memory)
        self.sampler.begin_with(memory.kinematics)
        self._paused = True  # whatever has happened in between
        if self.config.estimate_effects:
            self._recentre()

    def _begin_with(self, memory: Memory) -> None:
        """Know what is in the memory and nothing else."""
        self._state, self._centred = memory.state, -math.inf
        self._gained, self._window = memory.gained.copy(), memory.window.copy()
        self._variance, self._safe = memory.variance, memory.safe

    def _watch(self, elapsed: float) -> None:
        """Information gained per coefficient, in windows of EXCITATION_TIME."""
        variance = self._module.variance(self._task, self._state)
        gained = self.prior.std**2 * (1.0 / variance - 1.0 / self._variance)
        self._gained[0] += np.maximum(gained, 0.0)
        self._variance = variance
        self._window += elapsed
        if self._window >= EXCITATION_TIME:
            self._gained[1], self._gained[0] = self._gained[0], 0.0
            self._window[0] = 0.0

    def _estimate(self) -> Estimate:
        estimate: Estimate = self._module.estimate(self._task, self._state, self.prior)
        return estimate

    def report(self) -> Report:
        """The present coefficients, made physical, with their state in words."""
        raw = self._estimate()
        values = physical(self.config.dynamics, self.prior, raw)
        diverged = not (np.isfinite(values).all() and np.isfinite(raw.covariance).all())
        if diverged:
            values, std = self._safe, self.prior.std
            covariance = np.diag(std**2)
        else:
            self._safe, std, covariance = values, raw.std, raw.covariance
        gained = self._gained.sum(axis=0)
        excitation = gained / (1.0 + gained)
        words = [
            self._judge(i, values, std, raw.values, excitation, diverged)
            for i in range(len(values))
        ]
        # A bound cuts the interval too: no part of it is physically possible.
        upper = np.minimum(values + _QUANTILE * std, self.prior.upper)
        upper = np.where(self.prior.negative, np.minimum(upper, 0.0), upper)
        return Report(
            self.stamp,
            self.prior.names,
            self.prior.units,
            values,
            std,
            np.maximum(values - _QUANTILE * std, self.prior.lower),
            upper,
            covariance,
            excitation,
            tuple(level for level, _ in words),
            tuple(text for _, text in words),
            self._module.condition(self._task, self._state),
        )

    @property
    def stamp(self) -> int:
        """Of the last sample used [ns], also before a checkpoint; 0: of none."""
        if math.isnan(self._last_t) or self.sampler.origin is None:
            return self._recalled
        return self.sampler.origin + round(self._last_t * 1e9)

    def _judge(
        self,
        i: int,
        values: Array,
        std: Array,
        raw: Array,
        excitation: Array,
        diverged: bool,
    ) -> tuple[Level, str]:
        if diverged:
            return Level.ERROR, "diverged: the last good value is held, call reset"
        if abs(raw[i] - values[i]) > 2.0 * std[i]:
            return Level.ERROR, "held at its physical bound: the data contradict it"
        excited = excitation[i] >= _EXCITED
        known = std[i] <= _CONVERGED * max(abs(values[i]), self.prior.std[i])
        if known:
            return Level.OK, "converged" if excited else "converged, held: not excited now"
        if excited:
            return Level.WARN, "converging"
        return Level.WARN, "not excited: held, the motion does not show it"
