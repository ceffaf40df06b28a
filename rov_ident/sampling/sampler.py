"""From messages to samples: one clock, one set of axes, one filter for every channel.

Topics come at their own rates and phases. A :class:`Sampler` waits until every topic has reached an
instant (or is ``grace`` seconds behind), then emits one sample for it, by the stamps alone: at
those of the IMU while there is one, else of the odometry. What a sample holds is in `sample`, and
why in docs/samples.md: the wrench is a mean over the interval, so that held commands do not look
late, and the velocity that through the water, in which a steady current is a moving frame. With a
gyro the odometry's own rate only serves to find the gyro's bias.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.frames import to_core
from rov_ident.core.messages import (
    DRIVE,
    IMU,
    ODOMETRY,
    WRENCH,
    Array,
    Imu,
    Joints,
    Message,
    Odometry,
)
from rov_ident.effects import velocity_delay
from rov_ident.sampling.acting_wrench import ActingWrench
from rov_ident.sampling.despiking import Despiker, measured_values
from rov_ident.sampling.driven import Driven
from rov_ident.sampling.effect_jacobians import EffectJacobians
from rov_ident.sampling.kinematic_filter import KinematicFilter
from rov_ident.sampling.late_velocities import LateVelocities
from rov_ident.sampling.queues import LONGEST_INTERVAL, Instant, Queues, Waiting
from rov_ident.sampling.sample import joined, one_sample, sample_type
from rov_ident.sampling.validation import (
    CLOCK_STEP,
    NO_ODOMETRY,
    NO_WRENCH,
    REPEATED,
    RESTARTS,
    Validation,
)
from rov_ident.sampling.without_velocity import SimulatedVelocity, blank

_SILENCE = 2.0  # usual intervals, and CLOCK_STEP, without any message: the clock may have stepped
_SHORTEN, _LENGTHEN = 0.3, 0.05  # weights of an interval in the usual one: gaps only make it longer
_NO_VALUES = np.zeros(6)
_NO_WRENCH = (_NO_VALUES, _NO_VALUES, _NO_VALUES)


class Sampler:
    """Merges the topics into samples; the only part of the estimation that waits.

    ``counts`` holds how many messages of each kind were taken or, by reason, refused; bad data
    never raises. ``origin`` is the stamp [ns] of t = 0. Who wants the single commands (t [s],
    wrench (6,)) of the samples sets ``commands`` to a list, and empties it now and then.

    Without ``velocity`` the odometry's linear velocities are not looked at; samples have its depth.
    """

    def __init__(self, config: Config, velocity: bool = True) -> None:
        self.validation = Validation()
        self.counts = self.validation.counts
        self.origin: int | None = None
        self._frames = config.frames
        self._queues = Queues()
        self._late = LateVelocities(0.0)
        self._despiker = Despiker(config, self.counts)
        self.kinematic_filter = KinematicFilter(config)
        self._acting = ActingWrench(config)
        self._driven = Driven(config, self.counts)
        self._has_fins = False  # whether any was turned so far
        self._simulated = None if velocity else SimulatedVelocity(config)
        self.commands: list[tuple[float, Array]] | None = None
        self._previous = math.nan  # s; time of the last sample
        self._usual = 0.0  # s between samples
        self._position = np.zeros(3)  # m: the last that was measured
        self.configure(config)

    def configure(self, config: Config) -> None:
        """Take other settings; the buffered messages and the motion stay."""
        effects = config.estimate_effects
        self._jacobians = EffectJacobians(config) if effects else None
        self._size = len(effects)
        self._none = np.zeros(0, dtype=sample_type(self._size))
        self._take_delay(config)
        self._despiker.configure(config)
        self.kinematic_filter.configure(config)
        self._acting.configure(config, self._jacobians)
        self._driven.configure(config)
        if self._simulated is not None:
            self._simulated.configure(config)

    @property
    def noise_found(self) -> Array:
        """(6,): `ActingWrench.noise_found`."""
        return self._acting.noise_found

    def _take_delay(self, config: Config) -> None:
        self._late.delay = velocity_delay(config.effects)
        self._queues.grace = config.grace + self._late.delay
        self._queues.await_drive(config.inputs.joints)

    def recentre(self, config: Config) -> None:
        """Go on with other values of the effects' parameters."""
        assert self._jacobians is not None
        remembered = self._acting.memory, self._driven.memory
        self._jacobians = self._jacobians.about(config, *remembered)
        self._take_delay(config)
        self.kinematic_filter.take_effects(config)
        self._acting.configure(config, self._jacobians)
        self._driven.configure(config)

    def _clear(self) -> None:
        """Forget the buffered messages and the motion, not the clock's origin."""
        self.validation.forget_motion()
        self._queues.clear()
        self._late.clear()
        self._despiker.clear()
        self.kinematic_filter.clear()
        self._acting.clear()
        self._driven.clear()
        self._previous = math.nan
        if self._jacobians is not None:
            self._jacobians.forget()

    def push(self, role: str, message: Message) -> NDArray[np.void]:
        """Take a message as it is on the wire; the samples (k,) of SAMPLE that are now complete."""
        if self._simulated is not None and isinstance(message, Odometry):
            message = blank(message)
        reason = self.validation.judge(role, message)
        if reason in RESTARTS:
            done = self.flush()
            self._clear()
            self._enqueue(role, message)
            return done
        if reason:
            return self._none
        if self.origin is None:
            self.origin = message.stamp
        t = (message.stamp - self.origin) * 1e-9
        if t < self._previous:
            self.counts[f"{role}: too late"] += 1
            self._queues.wait_longer(t)
            if role not in (WRENCH, DRIVE):
                return self._none
        self._enqueue(role, message)
        return self._emit(final=False)

    def flush(self) -> NDArray[np.void]:
        """The samples (k,) still waiting for a topic that will not come: the input has ended."""
        return self._emit(final=True)

    def _enqueue(self, role: str, message: Message) -> None:
        """Queue a message in core axes."""
        assert self.origin is not None
        self.counts[role] += 1
        t = (message.stamp - self.origin) * 1e-9
        if isinstance(message, Odometry):
            message = self.validation.marked(message)
        message = to_core(message, self._frames)
        if isinstance(message, Joints):
            self._driven.push(t, message)
            self._queues.reached(DRIVE, t)
            return
        if isinstance(message, Odometry):
            timed, waiting = self._late.push(t, message), self._queues.odometry
            if timed is None:
                self.counts["odom: velocities of a time without a pose"] += 1
                return
            # a delay that is found to be longer turns back the clock of the velocities for a moment
            last = max(self._previous, waiting[-1].t) if waiting else self._previous
            if not (self._late.delay and timed[0] <= last):
                self._queues.add(role, Waiting(*timed, _NO_VALUES))
        else:
            self._queues.add(role, Waiting(t, message, measured_values(message)))

    def _emit(self, final: bool) -> NDArray[np.void]:
        """The samples (k,) that wait for nothing more; ``final``: nothing more will come."""
        samples, queues = [], self._queues
        while (instant := queues.next_instant(final)) is not None:
            if instant.has_imu and self._despiker.judge(IMU, queues[IMU])[1]:
                # dropped: of an IMU the others tell enough, and a guess would not do
                queues[IMU].popleft()
                continue
            sample = self._sample(instant)
            if sample is not None:
                samples.append(sample)
        if not samples:
            return self._none
        return samples[0] if len(samples) == 1 else joined(samples)

    def _is_unknown(self, t: float, dt: float) -> bool:
        """Whether nobody knows how much time the interval dt [s] before t [s] took.

        If no topic has said anything for long, either all messages were lost, or the clock of their
        stamps was stepped. To bridge it would take the motion of one for that of the other.
        """
        usual = self._usual or dt
        change = min(dt, _SILENCE * usual) - usual
        self._usual = usual + (_SHORTEN if change < 0.0 else _LENGTHEN) * change
        longest = CLOCK_STEP + _SILENCE * usual
        if dt <= longest:
            return False
        heard = [w.t for w in self._queues[WRENCH] if self._previous < w.t < t]
        if max(np.diff([self._previous, *heard, t])) <= longest:
            return False
        self.counts["clock: stepped ahead, or all topics silent, not bridged"] += 1
        return True

    def _sample(self, instant: Instant) -> NDArray[np.void] | None:
        """The sample (1,) of an instant, of which the messages are taken; None if it has none."""
        t, dt = instant.t, instant.t - self._previous
        restart = not 0.0 < dt <= LONGEST_INTERVAL or self._is_unknown(t, dt)
        begin = t if restart else self._previous
        self._previous = t
        wrench = self._acting.over(begin, t, self._queues[WRENCH], self._despiker, self.commands)
        whole, sample, sides = one_sample(self._size)
        missing = ""
        if self._driven.used:
            read, missing = self._driven.over(begin, t)
            sample["inputs"][0] = acting = self._driven.acting(t - begin, read)
            self._has_fins |= not missing and bool(acting[:, :3].any())
            if self._jacobians is not None and not missing:
                self._jacobians.steer(t - begin, read)
        imu = self._queues[IMU].popleft().message if instant.has_imu else None
        odometry, age = None, 0.0
        if instant.has_odometry:
            measured_at, odometry, _ = self._queues[ODOMETRY].popleft()
            age = t - measured_at
        assert imu is None or isinstance(imu, Imu)
        assert odometry is None or isinstance(odometry, Odometry)
        if odometry is not None and self._simulated is not None:
            odometry = odometry._replace(linear=self._simulated.v)
        if odometry is not None and math.isfinite(sum(odometry.position.tolist())):
            self._position = odometry.position
        sample["position"][0] = self._position
        sample["reading_noise"][0] = self._acting.reading_noise
        if self._jacobians is not None:
            self._jacobians.measure(self.kinematic_filter.state, has_imu=imu is not None)
        if restart:
            self.kinematic_filter.restart()
        taken, known, anew, stopped = self.kinematic_filter.step(
            sample, t, 0.0 if restart else dt, restart, self._acting.hold, wrench or _NO_WRENCH,
            odometry, age, imu,
        )  # fmt: skip
        if self._simulated is not None:
            self._simulated.fill(sample, odometry, age)
            self.kinematic_filter.state["v"] = self._simulated.v + sample["water"]
        if stopped:
            self.counts["imu: gap, odometry alone"] += 1
        if odometry is not None and not taken:
            repeated = odometry.twist_variance[0] == REPEATED
            why = "velocity repeated" if repeated else "outlier, or marked as not measured"
            self.counts[f"odom: {why}"] += 1
        if anew:
            self.counts["odom: contradicts the first, begun anew"] += 1
        if wrench is None or not known or missing:
            other = f"sample: no {missing}"
            why = NO_WRENCH if wrench is None else NO_ODOMETRY if not known else other
            self.counts[why] += 1
            self._previous = math.nan
            return None
        if not (self._has_fins or self._acting.has_moment):
            sample["wrench_doubt"][0, 3:] = np.inf
        self._acting.surround(sample)
        if self._jacobians is not None:
            self._jacobians.extend(sample, sides, self.kinematic_filter.acceleration)
        return whole
