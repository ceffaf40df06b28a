"""The wrench that acts during a sample: held commands through the thrusters, and surroundings.

A command holds from its stamp to the next one. A value taken at the sample's instant would look
like a delay of half a period, so the sample carries the mean over its interval and the slope of the
line with the same mean and first moment (docs/samples.md).
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.jit import kernel
from rov_ident.core.messages import WRENCH, Array
from rov_ident.core.quaternions import rotation
from rov_ident.effects import Acting, act, add_wrenches, compiled, memory
from rov_ident.sampling.despiking import Despiker
from rov_ident.sampling.dropped_commands import SILENCE, CommandPeriod, estimated
from rov_ident.sampling.effect_jacobians import EffectJacobians
from rov_ident.sampling.queues import Waiting
from rov_ident.sampling.wrench_scatter import ReadingNoise

_ZERO = np.zeros(6)
# m; a moment of forces at a shorter arm is the rounding of an allocation, in 32 bits, too: no
# thruster is placed that well
_ROUNDING_ARM = 1e-6
# of the first command or the present: by so much a wrench is wrong anyway, by default
# (wrench.relative_std)
_SETTLED = 0.01


def holds_moment(largest: Array) -> bool:
    """Whether a wrench whose components (6,) [N, N m] are never larger than these holds a moment.

    Thrusters hardly push without one. A wrench that never holds any was recorded without, and what
    turns the vehicle is unknown.
    """
    return bool(largest[3:].max() > _ROUNDING_ARM * largest[:3].max())


class MeanWrench(NamedTuple):
    """Of an interval, each (6,)."""

    mean: Array  # N, N m
    slope: Array  # per s
    doubt: Array  # N2, (N m)2: mean square of what may be wrong with the commands


class _Command(NamedTuple):
    t: float  # s
    wrench: Array  # (6,)
    doubt: Array  # (6,) N2, (N m)2: mean square of what may be wrong with it


class _FromRest:
    """How far what acts is from what it would be, had nothing been commanded before ``first``.

    Effects with a memory (a lag, a delay) take the first command to have acted for long, as where a
    recording begins amid a dive. Where it begins with the first thrust of all, from rest, nothing
    acts yet, and nobody can know which it is. The error lasts until it is forgotten: its impulse
    adds up, and the noise that has its square J^2 as variance has the density dJ^2/dt.
    """

    def __init__(self, effects: Acting, first: _Command) -> None:
        self._memory = memory()
        act(effects, self._memory, first.t, 0.0, np.zeros(6))
        self._impulse = np.zeros(6)  # N s, N m s
        self._first = np.abs(first.wrench)

    def density(
        self, effects: Acting, begin: float, dt: float, command: Array, acting: Array
    ) -> Array | None:
        """(6,) [N2 s, (N m)2 s] from begin to begin + dt [s]; None where none is left."""
        other = command.copy()
        act(effects, self._memory, begin, dt, other)
        off = np.abs(acting - other)
        if np.all(off <= _SETTLED * np.maximum(self._first, np.abs(command))):
            return None
        density: Array = (2.0 * self._impulse + dt * off) * off
        self._impulse += dt * off
        return density


class ActingWrench:
    """Takes commands from their queue and says what acts in each interval."""

    def __init__(self, config: Config) -> None:
        self._noise = ReadingNoise()
        self._largest = np.zeros(6)  # N, N m
        self.has_moment = False  # whether any command held one so far
        self.configure(config)
        self.clear()

    def configure(self, config: Config, jacobians: EffectJacobians | None = None) -> None:
        """Take other settings and other values of effects; their memory stays."""
        self._timeout = config.timeout
        self._noise.relative = config.wrench.relative_std
        self._lasting = config.wrench.correlation_time
        self._jacobians = jacobians
        self._effects = compiled(config.effects)
        self._has_inputs = bool(self._effects.inputs.any())
        self._has_surroundings = bool(self._effects.wrenches.any())

    def clear(self) -> None:
        self._command: _Command | None = None  # the one that is held
        self._until = np.nan  # s; so far it has gone through the effects
        self.memory = memory()  # of the input effects
        self._from_rest: _FromRest | None = None
        self._around = np.zeros(6)  # the surroundings' wrench at the last sample
        self._period = CommandPeriod()
        self._last_received = -np.inf  # s
        self._estimated: deque[_Command] = deque()  # of those that were dropped

    @property
    def hold(self) -> float:
        """How long [s] a command acts, of late; 0 if that is not known yet."""
        return self._period.mean

    @property
    def reading_noise(self) -> Array:
        """Variance density (6,) [N2 s, (N m)2 s] of noise, where the wrench is not far above it;
        infinite until that is known."""
        variance = self._noise.variance
        return variance * self.hold if self.hold else variance

    @property
    def noise_found(self) -> Array:
        """The same (6,) however large the wrench is; zero until it is known."""
        return self._noise.found * self.hold

    def over(
        self,
        start: float,
        end: float,
        queue: deque[Waiting],
        despiker: Despiker,
        commands: list[tuple[float, Array]] | None,
    ) -> MeanWrench | None:
        """What acts from ``start`` to ``end`` [s] by the commands in the queue; None if none does.

        Commands up to ``end`` are taken from the queue and appended to ``commands``.
        """
        pieces: list[tuple[float, float, Array, Array]] = []
        now = start
        while (command := self._next(end, queue, despiker)) is not None:
            if self._command is None:
                start = now = max(command.t, start)
                self._from_rest = _FromRest(self._effects, command) if self._has_inputs else None
                self._until = command.t
            else:
                self._catch_up(min(start, command.t))
                if command.t > now:
                    pieces.append((now, command.t, *self._act(self._command, now, command.t)))
                    now = command.t
            self._command = command
            if commands is not None:
                commands.append((command.t, command.wrench))
        held = self._command
        if held is None or end - held.t > min(self._timeout, SILENCE * self._period.longest):
            self._command = None
            self.memory = memory()
            if self._jacobians is not None:
                self._jacobians.forget()
            return None
        self._catch_up(start)
        acting, doubt = self._act(held, now, end)
        if not pieces:
            return MeanWrench(acting, _ZERO, doubt)
        pieces.append((now, end, acting, doubt))
        length, middle = end - start, 0.5 * (start + end)
        total = MeanWrench(np.zeros(6), np.zeros(6), np.zeros(6))
        for begin, stop, wrench, doubt in pieces:
            share = (stop - begin) / length
            moment = 12.0 * share * (0.5 * (begin + stop) - middle) / length**2
            _add_piece(share, moment, wrench, doubt, *total)
        return total

    def _catch_up(self, t: float) -> None:
        """Have the held command act to t [s], in a gap that no sample covers."""
        if self._command is not None and self._until < t:
            self._act(self._command, self._until, t)
            if self._jacobians is not None:
                self._jacobians.begin_interval()

    def _next(self, end: float, queue: deque[Waiting], despiker: Despiker) -> _Command | None:
        """The next command before ``end`` [s]; if it was dropped, an estimate of it."""
        if not queue:
            return None
        at, held, last = queue[0].t, self._command, self._last_received
        silent = at - last > self._period.threshold and not self._estimated
        if silent and held is not None and held.t == last:
            dropped = self._period.dropped(at - last)
            commands = estimated(last, held.wrench, at, queue[0].values, dropped)
            self._estimated.extend(map(_Command._make, commands))
        if self._estimated and self._estimated[0].t < min(at, end):
            return self._estimated.popleft()
        # One that comes at the end does not act yet; its successors tell whether it is an outlier.
        if at > end or (at == end and held is not None):
            return None
        wrench, _, doubt = despiker.judge(WRENCH, queue)
        np.maximum(self._largest, np.abs(wrench), out=self._largest)
        self.has_moment = holds_moment(self._largest)
        self._noise.take(at, queue.popleft().values)
        self._estimated.clear()
        if last > -np.inf:
            self._period.update(at - last)
        self._last_received = at
        return _Command(at, wrench, doubt)

    def _act(self, command: _Command, begin: float, end: float) -> tuple[Array, Array]:
        """The wrench (6,) that acts in the mean from ``begin`` to ``end`` by a held command, and
        its doubt (6,)."""
        wrench, doubt, dt = command.wrench.copy(), command.doubt, end - begin
        self._until = end
        if self._has_inputs:
            act(self._effects, self.memory, begin, dt, wrench)
        if self._from_rest is not None:
            more = self._from_rest.density(self._effects, begin, dt, command.wrench, wrench)
            if more is None:
                self._from_rest = None
            else:  # the estimators take a doubt to last as long as a command does
                doubt = doubt + more / max(self._lasting, self.hold)
        if self._jacobians is not None:
            self._jacobians.act(begin, dt, command.wrench)
        return wrench, doubt

    def surround(self, sample: NDArray[np.void]) -> None:
        """Add the wrench effects along the measured motion to the sample (1,) of SAMPLE."""
        if self._has_surroundings:
            _surround(self._effects, sample, self._around)


@kernel
def _add_piece(share, moment, wrench, doubt, mean, slope, mean_doubt):
    for i in range(6):
        mean[i] += share * wrench[i]
        slope[i] += moment * wrench[i]
        mean_doubt[i] += share * doubt[i]


@kernel
def _surround(effects, sample, around):
    """Add the wrench effects to the sample; around (6,): theirs at the last sample, then at this.

    In a straight line in between, as the motion is.
    """
    out, now = sample[0], np.zeros(6)
    to_world = rotation(out.orientation)
    add_wrenches(effects, out.t, out.position, out.nu, to_world, out.wrench, now)
    for i in range(6):
        before = now[i] if out.restart else around[i]
        out.surroundings[i] = 0.5 * (before + now[i])
        out.surroundings_slope[i] = (now[i] - before) / out.dt if out.dt > 0.0 else 0.0
        out.wrench[i] += out.surroundings[i]
        out.wrench_slope[i] += out.surroundings_slope[i]
        around[i] = now[i]
