"""From messages to samples: one clock, one set of axes, one filter for every channel.

Topics come at their own rates and phases. A :class:`Sampler` waits until every topic has reached an
instant (or is ``grace`` seconds behind), then emits one sample for it. The instants are those of
the IMU messages while there is an IMU, else those of the odometry. Everything is decided by the
stamps, never by arrival, so that a bag gives the same samples live, replayed and offline.

What a sample holds, and why (docs/samples.md has the measurements):

* ``wrench`` is the *mean* over the interval that ends at the sample, ``wrench_slope`` its trend in
  there. A demand holds from its stamp to the next one; a value picked at the sample's instant would
  look like a delay of half a period, and without the trend a step early in the interval would be
  taken for one in its middle. It is all that acts besides the model: what the thrusters make of the
  demand, and ``surroundings``, that of the configured wrench effects.
* ``nu`` is the best estimate of the body velocity *through the water*. A steady current is a moving
  frame, in which the equations of motion are those for still water, whatever the coefficients; so
  it is taken off all velocities here (``water``), and no estimator needs to know of it. Odometry
  and the integrated IMU are weighed by a Kalman filter on the kinematics alone (no model of the
  vehicle). Such a filter is complementary, what it takes from one source it leaves of the other, so
  it adds noise but no lag. Without an IMU ``nu`` is the odometry as it came.
* ``odometry`` and ``gyro`` are the same measurements one by one, their noise independent, for a
  filter that does its own weighing. With a gyro the odometry's own angular rate only serves to find
  the gyro's bias.
"""

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rov_ident.attitude import rotation, turned
from rov_ident.beat import LOST, Beat, between
from rov_ident.config import Config
from rov_ident.effects import (
    act,
    add_wrenches,
    affects_sensors,
    compiled,
    correct,
    memory,
)
from rov_ident.effects.base import Reading
from rov_ident.excitation import authority
from rov_ident.frames import FrameDefaults, quaternion_from_euler, to_core
from rov_ident.jit import inlined, kernel, record
from rov_ident.messages import Array, Imu, Message, Odometry, Wrench

SAMPLE = record(
    [
        ("t", "f8"),  # s since the first message
        ("dt", "f8"),  # s since the previous sample
        ("restart", "?"),  # the interval before this sample is not known: filters begin anew
        ("anew", "?"),  # nor is what came before to be believed: what it taught is given up
        ("measured", "?"),  # an odometry message belongs to this sample
        ("moving", "u1", (6,)),  # 1: this component of nu is well above its noise
        ("nu", "f8", (6,)),  # m/s, rad/s: through the water
        ("water", "f8", (3,)),  # m/s: velocity of the water in body axes; nu + water: over ground
        ("orientation", "f8", (4,)),  # w x y z, body -> world
        ("down", "f8", (3,)),  # unit, body axes
        ("down_slope", "f8", (3,)),  # per s, over the interval
        ("wrench", "f8", (6,)),  # N, N m: mean over dt, of thrusters and surroundings
        ("wrench_slope", "f8", (6,)),  # per s: of the line with the same mean and first moment
        ("wrench_doubt", "f8", (6,)),  # N2, (N m)2: what of it may be an outlier, mean over dt
        ("hold", "f8"),  # s: how long a demand acts, of late; 0: not known yet
        ("surroundings", "f8", (6,)),  # part of the wrench: of wrench effects at this motion
        ("surroundings_slope", "f8", (6,)),
        ("odometry", "f8", (6,)),  # as nu; NaN: not measured
        ("odometry_variance", "f8", (6,)),
        ("gyro", "f8", (3,)),  # rad/s, bias removed; NaN: not measured
        ("gyro_variance", "f8"),
        ("gyro_bias", "f8", (3,)),  # rad/s: what was taken off the gyro here
        ("attitude", "f8", (4,)),  # as the odometry has it; NaN: not measured
    ],
)

ODOMETRY, IMU, WRENCH = "odom", "imu", "wrench"
_MERGE = 0.05  # s; an odometry message is carried to the IMU message that follows this closely
_MAX_GAP = 0.5  # s without a measurement: restart rather than bridge
_MAX_JUMP = 10.0  # s; a stamp this far ahead, or 1 s back, is another clock (a bag starting over)
_LATEST = 1.0  # s; a topic that is later than this is not waited for
_LATER = 1.25  # times as late as a topic was is how long it is waited for from then on
_QUEUED = 10.0  # s; of demands that are kept while nothing else comes
_LAST_STAMP = (2**31 - 1) * 10**9  # ns; of ROS time
_REASONS = 100  # names of refusals; what else is wrong is counted together
LONE = 5.0  # sigma; of a message that jumps there and back between its neighbours
_SHAKE = 0.2  # m/s2; of which an accelerometer may always jump
_PUSH = 0.03  # of the working wrench; of which a brief demand may
_STILL = 0.004  # the same where the demand is constant, as it is while nobody demands anything
GROSS = 0.5  # of the working wrench: no turn of what is demanded, there and back at once
_EXACT = 0.0004  # the same of what stands beside a level that is held exactly
_COARSE = 0.03  # of the demand itself; of which it may: less would thin the noise of coarse ones
_MEANT = 0.2  # of both, for a demand that lasts: nobody pushes more than he can
_BRIEF, _LASTING = 0.02, 0.1  # s; what is brief, and what lasts
_GRID = 1e-4  # m/s; finer numbers than that are not repeated by chance
_CHANCES = 4  # odometry that is never confirmed within so many is all there is
_BACK = 0.1  # of a dip's square; what is no further off when it is over was there before it
_CALM = 3.0  # times as far as its neighbours move is what stands between two calm levels
_NOTHING = np.zeros(6)
_WORLD_FRAMES = ("map", "odom", "world", "earth", "world_ned", "map_ned", "odom_ned")

_VELOCITY, _RATE, _ATTITUDE = range(3)
RATIOS = ("velocity", "angular rate", "attitude")
"""Of the odometry, each behind a gate of its own against the IMU."""

_KINEMATICS = record(
    [
        ("known", "?"),  # an odometry message has been seen since the last restart
        ("inertial", "?"),  # an IMU message has
        ("chances", "i8"),  # so often may the first odometry of all still be given up
        ("q", "f8", (4,)),
        ("down", "f8", (3,)),
        ("attitude_variance", "f8"),  # rad2
        ("refused", "i8"),  # attitudes in a row
        ("v", "f8", (3,)),
        ("power", "f8", (6,)),  # of nu, of late
        ("rate", "f8", (3,)),  # rad/s, bias removed
        ("change", "f8", (3,)),  # rad/s; of that over the last interval
        ("interval", "f8"),  # s; its length
        ("slow_rate", "f8", (3,)),  # for the angular acceleration of the lever arm
        ("acceleration", "f8", (3,)),  # m/s2 at the origin, body axes
        ("gyro_bias", "f8", (3,)),
        ("gyro_bias_variance", "f8"),
        ("attitude_bias", "f8"),  # rad2/s: covariance of attitude and gyro bias
        ("accelerometer_bias", "f8", (3,)),
        ("p_vv", "f8"),
        ("p_vb", "f8"),
        ("p_bb", "f8"),
        # squared innovations over their variances, averaged: 1 is expected, see RATIOS
        ("ratio", "f8", (3,)),
    ],
)

_SETTINGS = record(
    [
        ("gravity", "f8"),
        ("water", "f8", (3,)),  # m/s, in the world
        ("odometry_lever", "f8", (3,)),
        ("imu_lever", "f8", (3,)),
        ("imu_rotation", "f8", (3, 3)),  # sensor axes -> body axes
        ("odometry_variance", "f8", (6,)),
        ("attitude_variance", "f8"),
        ("gyro_variance", "f8"),
        ("accelerometer_variance", "f8"),
        ("gyro_bias_variance", "f8"),
        ("accelerometer_bias_variance", "f8"),
        ("gate", "f8"),
    ],
)


Waiting = tuple[float, Message, Array]
"""Time, message, and the :func:`numbers` of an IMU or wrench."""


class Sampler:
    """Merges the three topics into samples; the only part of the estimation that waits.

    ``counts`` holds how many messages of each kind were taken or, by reason, refused; bad data
    never raises. ``origin`` is the stamp [ns] of t = 0. Who wants the single demands (t [s], wrench
    (6,)) that the samples are made of sets ``demands`` to a list, and empties it.
    """

    def __init__(self, config: Config) -> None:
        self._defaults: FrameDefaults = config.frames
        self.configure(config)
        self.counts: Counter[str] = Counter()
        self.origin: int | None = None
        self._frame_ids: dict[str, tuple[str, ...]] = {}
        self._last_stamp: dict[str, int] = {}
        self._suspect: dict[str, int] = {}  # a stamp out of line, by topic
        self.demands: list[tuple[float, Array]] | None = None
        self._late = 0.0  # s; how long a topic is waited for because it was that late before
        self._clear()
        self._kinematics["chances"] = _CHANCES

    def configure(self, config: Config) -> None:
        """Take other settings; the buffered messages and the motion stay."""
        self._sensitivity = None
        if config.estimate_effects:
            from rov_ident.sensitivity import Sensitivity  # here: few need it

            self._sensitivity = Sensitivity(config)
        self._none = np.zeros(0, dtype=sample_type(len(config.estimate_effects)))
        self._take_effects(config)
        self._settings = _settings(config)
        self._floors = {
            IMU: np.repeat([config.imu.gyro_std, _SHAKE], 3),
            WRENCH: authority(config.dynamics),
        }
        working = authority(config.dynamics) / np.diag(config.dynamics.mass_matrix)
        self._agility = np.concatenate([working[3:], working[:3]]) / LONE  # rad/s2, m/s2

    def recentre(self, config: Config) -> None:
        """Go on with other values of the effects' parameters; their memory stays."""
        assert self._sensitivity is not None
        self._sensitivity = self._sensitivity.about(config)
        self._take_effects(config)
        self._settings["water"] = self._acting.water

    def _take_effects(self, config: Config) -> None:
        self._grace = config.grace
        self._hold = config.timeout
        self._effects = config.effects
        self._acting = compiled(config.effects)
        self._corrects = affects_sensors(config.effects)
        self._acts = bool(self._acting.inputs.any())
        self._surrounded = bool(self._acting.wrenches.any())

    def _clear(self) -> None:
        """Forget the buffered messages and the motion, not the clock's origin."""
        self._queues: dict[str, deque[Waiting]] = {
            ODOMETRY: deque(),
            IMU: deque(),
            WRENCH: deque(),
        }
        self._latest = -math.inf  # s; of all topics
        # s; no topic will bring anything before this. Of demands one more is waited for: it tells,
        # with the others, whether one is an outlier.
        self._reach = dict.fromkeys((ODOMETRY, IMU, WRENCH), -math.inf)
        self._newest_demand = -math.inf  # s
        self._first = math.nan
        self._previous = math.nan  # time of the last sample
        self._seen_imu = -math.inf
        self._kinematics = np.zeros(1, dtype=_KINEMATICS)
        self._kinematics["gyro_bias_variance"] = self._settings["gyro_bias_variance"]
        self._demand: Array | None = None
        self._demand_time = -math.inf
        self._doubt = np.zeros(6)  # N2, (N m)2: of the present demand
        self._beat = Beat()
        self._heard = -math.inf  # time of the last demand that came
        self._missing: deque[tuple[float, Array, Array]] = deque()  # guesses at what got lost
        self._velocity, self._fine = b"", 0  # the last velocity; whether they are off the grid
        # the numbers of the last two messages as they came, and of the last two as believed
        self._past: dict[str, Array] = {}
        self._scatter = {role: np.zeros(6) for role in self._floors}
        self._memory = memory()
        if self._sensitivity is not None:
            self._sensitivity.forget()
        self._around = np.zeros(6)  # the surroundings' wrench at the last sample

    @property
    def ratios(self) -> dict[str, float]:
        """Test ratios of the parts of the odometry against the IMU, of late; 1 is expected."""
        return dict(zip(RATIOS, self._kinematics["ratio"][0].tolist(), strict=True))

    @property
    def kinematics(self) -> NDArray[np.void]:
        """(1,): a copy of the kinematic filter's state, for a checkpoint."""
        return self._kinematics.copy()

    def begin_with(self, kinematics: NDArray[np.void]) -> None:
        """Keep the biases of the IMU in another filter's state; motion is measured anew."""
        self._kinematics = kinematics.copy()
        self._kinematics["known"] = False
        self._kinematics["inertial"] = False
        self._kinematics["chances"] = _CHANCES

    # -------------------------------------------------------------- messages in

    def push(self, role: str, message: Message) -> NDArray[np.void]:
        """Take a message as it is on the wire; the samples (k,) of SAMPLE that are now complete."""
        reason = self._refusal(role, message)
        if reason:
            name = f"{role}: {reason}"
            if name not in self.counts and len(self.counts) >= _REASONS:
                name = f"{role}: refused for yet another reason"
            self.counts[name] += 1
            return self._none
        if self.origin is None:
            self.origin = message.stamp
        t = (message.stamp - self.origin) * 1e-9
        last = self._last_stamp.get(role)
        if last is not None:
            step = (message.stamp - last) * 1e-9
            if step < -1.0 or step > _MAX_JUMP:
                if not self._is_new_clock(role, message.stamp):
                    self.counts[f"{role}: stamp jumps"] += 1
                    return self._none
                done = self.flush()
                self.counts["clock: jumps, buffers restarted"] += 1
                self._clear()
                self._last_stamp.clear()
                self._last_stamp[role] = message.stamp
                self._enqueue(role, t, message)
                return done
            if step <= 0.0:
                self.counts[f"{role}: {'duplicate' if step == 0.0 else 'backward'} stamp"] += 1
                return self._none
        self._last_stamp[role] = message.stamp
        self._suspect.pop(role, None)
        if t < self._previous:
            self.counts[f"{role}: too late"] += 1
            lateness = _LATER * (self._latest - t)
            if lateness <= _LATEST:
                self._late = max(self._late, lateness)
            if role != WRENCH:
                return self._none
        self._enqueue(role, t, message)
        return self._complete(final=False)

    def flush(self) -> NDArray[np.void]:
        """The samples (k,) still waiting for a topic that will not come: the input has ended."""
        return self._complete(final=True)

    def _enqueue(self, role: str, t: float, message: Message) -> None:
        if math.isnan(self._first):
            self._first = t
        self.counts[role] += 1
        self._latest = max(self._latest, t)
        self._reach[role] = t
        queue = self._queues[role]
        if isinstance(message, Odometry):
            queue.append((t, to_core(self._marked(message), self._defaults), _NOTHING))
            return
        message = to_core(message, self._defaults)
        queue.append((t, message, numbers(message)))
        if role == WRENCH:
            self._reach[role] = self._newest_demand if self._newest_demand > -math.inf else t
            self._newest_demand = t
            while t - queue[0][0] > _QUEUED:
                queue.popleft()

    def _marked(self, message: Odometry) -> Odometry:
        """A velocity that is repeated to the last digit has not been measured again.

        Its sensor has lost the ground, or is slower than its messages. Only where velocities are
        rounded to a grid may it have been.
        """
        velocity, before = message.linear.tobytes(), self._velocity
        self._velocity = velocity
        if velocity == before:
            if self._fine:
                variance = message.twist_variance.copy()
                variance[:3] = REPEATED
                return message._replace(twist_variance=variance)
        else:
            steps = [v / _GRID for v in message.linear.tolist()]
            off = any(abs(step - round(step)) > 0.01 for step in steps)
            self._fine = 20 if off else max(self._fine - 1, 0)
        return message

    def _corrected(self, message: Message) -> Message:
        """The message (FRD) without what the effects on the sensors have added."""
        if not self._corrects:
            return message
        if isinstance(message, Odometry):
            reading = Reading(message.linear, message.angular, _ZERO, _ZERO)
            reading = correct(reading, self._effects)
            return message._replace(linear=reading.linear, angular=reading.angular)
        if isinstance(message, Imu):
            to_body = self._settings["imu_rotation"][0]
            gyro, force = message.angular_velocity, message.linear_acceleration
            given = Reading(_ZERO, _ZERO, to_body @ gyro, to_body @ force)
            reading = correct(given, self._effects)
            return message._replace(
                angular_velocity=gyro + to_body.T @ (reading.gyro - given.gyro),
                linear_acceleration=force
                + to_body.T @ (reading.specific_force - given.specific_force),
            )
        return message

    def _is_new_clock(self, role: str, stamp: int) -> bool:
        """A single wild stamp is an error; two in a row that agree are another clock."""
        suspect = self._suspect.get(role)
        self._suspect[role] = stamp
        return suspect is not None and abs(stamp - suspect) * 1e-9 < 1.0

    def _refusal(self, role: str, message: Message) -> str:
        """Why the message cannot be used, or an empty string."""
        if message.stamp <= 0:
            return "zero stamp"
        if message.stamp >= _LAST_STAMP:
            return "stamp at the end of time"
        frames: tuple[str, ...]
        if isinstance(message, Odometry):
            frames = (message.frame_id, message.child_frame_id)
            p, q, v, w = message.position, message.orientation, message.linear, message.angular
            if not 0.5 < q.dot(q) < 2.0:  # NaN too
                return "orientation is not a unit quaternion"
            size = v.dot(v) + w.dot(w) + 1e-12 * p.dot(p)
        elif isinstance(message, Imu):
            frames = (message.frame_id,)
            w, f = message.angular_velocity, message.linear_acceleration
            size = w.dot(w) + f.dot(f) / 400.0
        else:
            frames = (message.frame_id,)
            f, w = message.force, message.torque
            size = 2.5e-9 * (f.dot(f) + w.dot(w))
        # One comparison refuses NaN, infinities and what no vehicle reaches: 50 m/s, 50 rad/s,
        # 100 g, 1 MN.
        if not size < 2500.0:
            return "not finite or absurdly large"
        if self._frame_ids.get(role) == frames:
            return ""
        if frames[-1].rsplit("/", 1)[-1] in _WORLD_FRAMES:
            return f"frame {_shown(frames[-1:])} is a world frame, body axes are needed"
        if self._frame_ids.setdefault(role, frames) != frames:
            return f"frame changed from {_shown(self._frame_ids[role])} to {_shown(frames)}"
        return ""

    # -------------------------------------------------------------- samples out

    def _complete(self, final: bool) -> NDArray[np.void]:
        samples = []
        odometry, imu = self._queues[ODOMETRY], self._queues[IMU]
        while odometry or imu:
            pose_t = odometry[0][0] if odometry else math.inf
            imu_t = imu[0][0] if imu else math.inf
            merged = 0.0 <= imu_t - pose_t <= _MERGE and not (
                len(odometry) > 1 and odometry[1][0] <= imu_t
            )
            take_imu = merged or imu_t < pose_t
            t = imu_t if take_imu else pose_t
            if not (final or self._reached(t)):
                break
            if take_imu and len(imu) < 3 and not (final or self._waited(t)):
                break  # its successors tell whether it is an outlier
            if take_imu and self._mended(IMU)[1]:
                imu.popleft()  # of an IMU the others tell enough, and a guess would not do
                continue
            message = imu.popleft()[1] if take_imu else None
            pose = odometry.popleft() if merged or not take_imu else None
            sample = self._sample(t, pose, message)
            if sample is not None:
                samples.append(sample)
        if not samples:
            return self._none
        return samples[0] if len(samples) == 1 else joined(samples)

    def _waited(self, t: float) -> bool:
        """Whether the newest stamp is so far ahead of t that nothing more is waited for."""
        return self._latest - t > max(self._grace, self._late)

    def _mended(self, role: str) -> tuple[Array, bool, Array]:
        """Numbers (6,) of the next message without its outliers, and what :func:`mend` says.

        They are mended, each by itself: a step of another axis is not to come late for them.
        """
        queue, past = self._queues[role], self._past.get(role)
        (begin, _, here), found, doubt = queue[0], False, np.zeros(6)
        if past is None:
            if len(queue) > 1:  # the first of all may be an outlier like any other
                doubt = (queue[1][2] - here) ** 2
            self._past[role] = np.array([here] * 4)
        elif len(queue) == 1:
            past[:] = past[1], here, past[3], here
        else:
            end, _, after = queue[1]
            last = queue[2][2] if len(queue) > 2 else after  # outliers come in pairs, too
            floor, rates = self._floors[role], 0
            lasts = min(max((end - begin - _BRIEF) / (_LASTING - _BRIEF), 0.0), 1.0)
            if role == WRENCH:
                push = _PUSH + lasts * (_MEANT - _PUSH)
                still = _STILL + lasts * (_MEANT - _STILL)
                coarse = _COARSE + lasts * (_MEANT - _COARSE)
                gross = GROSS
            else:
                push, still, coarse, gross = 1.0, 1.0, 0.0, 0.0
                if lasts > 0.0:  # a vehicle, too, is back again if it is given the time
                    times = [end - begin] * 3 + [1.0] * 3
                    floor = floor + lasts * self._agility * times
                if len(queue) > 2 and queue[2][0] - begin < _LASTING:
                    rates = 3
            found = mend(
                past, here, after, last, doubt, self._scatter[role], floor, push, still, coarse,
                gross, rates, LONE, role == WRENCH,
            )  # fmt: skip
        if found:
            self.counts[f"{role}: outlier between its neighbours"] += 1
        return here, found, doubt

    def _reached(self, t: float) -> bool:
        """Whether no topic can still bring a message up to t, or it is not worth waiting."""
        if self._waited(t):
            return True
        grace = max(self._grace, self._late)
        for reach in self._reach.values():
            if reach < t and t - max(reach, self._first) <= grace:
                return False
        return True

    def _sample(
        self, t: float, pose: Waiting | None, imu: Message | None
    ) -> NDArray[np.void] | None:
        dt = t - self._previous
        restart = not 0.0 < dt <= _MAX_GAP
        wrench = self._mean_wrench(self._previous if not restart else t, t)
        self._previous = t
        mean, slope, doubt = wrench or (_ZERO_WRENCH, _ZERO_WRENCH, _ZERO_WRENCH)
        sample = np.zeros(1, dtype=SAMPLE)
        odometry, shift = _ABSENT, 0.0
        if self._sensitivity is not None:
            known = self._kinematics[0]
            self._sensitivity.measure(known["v"], known["rate"], has_imu=imu is not None)
        if pose is not None:
            given = self._corrected(pose[1])
            assert isinstance(given, Odometry)
            shift = t - pose[0]
            odometry = np.concatenate(
                [given.orientation, given.linear, given.angular, given.twist_variance]
            )
        inertial, gyro, specific, gyro_variance = imu is not None, _ZERO, _ZERO, 0.0
        if imu is not None:
            imu = self._corrected(imu)
            assert isinstance(imu, Imu)
            gyro, specific = imu.angular_velocity, imu.linear_acceleration
            gyro_variance = sum(imu.angular_variance.tolist()) / 3.0
            self._seen_imu = t
        if restart:
            self._kinematics["known"] = False
            self._kinematics["inertial"] = False
        if t - self._seen_imu > _MERGE and self._kinematics["inertial"][0]:
            self._kinematics["inertial"] = False
            self.counts["imu: gap, odometry alone"] += 1
        taken, known, anew = fuse(
            self._kinematics, self._settings, sample, t, 0.0 if restart else dt, restart,
            mean, slope, doubt, self._beat.usual, pose is not None, shift, odometry,
            inertial, gyro, gyro_variance, specific,
        )  # fmt: skip
        if pose is not None and not taken:
            repeated = odometry[10] == REPEATED
            why = "velocity repeated" if repeated else "outlier, or marked as not measured"
            self.counts[f"odom: {why}"] += 1
        if anew:
            self.counts["odom: contradicts the first, begun anew"] += 1
        if wrench is None or not known:
            self.counts[f"sample: no {'wrench' if wrench is None else 'odometry yet'}"] += 1
            self._previous = math.nan
            return None
        if self._surrounded:
            _surround(self._acting, sample, self._around)
        if self._sensitivity is not None:
            sides = self._sensitivity.take(sample[0], rotation(sample["orientation"][0]))
            return np.frombuffer(bytearray(sample.tobytes() + sides.tobytes()), self._none.dtype)
        return sample

    def _mean_wrench(self, start: float, end: float) -> tuple[Array, Array, Array] | None:
        """Mean and slope (6,) of the acting wrench, and what of it is in doubt, squared.

        None where no demand is known.
        """
        pieces: list[tuple[float, float, Array, Array]] = []
        now = start
        while (following := self._next_demand(end)) is not None:
            at, demand, doubt = following
            if self._demand is not None and at > now:
                pieces.append((now, at, self._act(now, at - now), self._doubt))
                now = at
            elif self._demand is None:
                start = now = max(at, start)
            self._demand, self._demand_time, self._doubt = demand, at, doubt
            if self.demands is not None:
                self.demands.append((at, self._demand))
        hold = min(self._hold, LOST * self._beat.longest)
        if self._demand is None or end - self._demand_time > hold:
            self._demand = None
            self._memory = memory()
            if self._sensitivity is not None:
                self._sensitivity.forget()
            return None
        acting = self._act(now, end - now)
        if not pieces:
            return acting, _ZERO_WRENCH, self._doubt
        pieces.append((now, end, acting, self._doubt))
        length, middle = end - start, 0.5 * (start + end)
        mean, slope, doubtful = np.zeros(6), np.zeros(6), np.zeros(6)
        for begin, stop, wrench, doubt in pieces:
            share = (stop - begin) / length
            turn = 12.0 * share * (0.5 * (begin + stop) - middle) / length**2
            _add_piece(share, turn, wrench, doubt, mean, slope, doubtful)
        return mean, slope, doubtful

    def _next_demand(self, end: float) -> tuple[float, Array, Array] | None:
        """Time, wrench (6,) and doubt of the next demand before ``end``; it may be a guess."""
        queue = self._queues[WRENCH]
        if not queue:
            return None
        at = queue[0][0]
        silent = at - self._heard > self._beat.patience and not self._missing
        if silent and self._demand is not None and self._demand_time == self._heard:
            lost = self._beat.lost(at - self._heard)
            self._missing.extend(between(self._heard, self._demand, at, queue[0][2], lost))
        if self._missing and self._missing[0][0] < min(at, end):
            return self._missing.popleft()
        # One that comes at the end does not act yet; its successors tell whether it is an outlier.
        if at > end or (at == end and self._demand is not None):
            return None
        demand, _, doubt = self._mended(WRENCH)
        queue.popleft()
        self._missing.clear()
        if self._heard > -math.inf:
            self._beat.hear(at - self._heard)
        self._heard = at
        return at, demand, doubt

    def _act(self, t: float, dt: float) -> Array:
        """The wrench (6,) that acts, in the mean from t to t + dt, when the demand is held."""
        assert self._demand is not None
        wrench = self._demand.copy()
        if self._acts:
            act(self._acting, self._memory, t, dt, wrench)
        if self._sensitivity is not None:
            self._sensitivity.act(t, dt, self._demand)
        return wrench


def _shown(frames: tuple[str, ...]) -> str:
    """Frame ids as they may stand in a log, whatever is in them."""
    return ", ".join(repr(frame if len(frame) <= 40 else f"{frame[:37]}...") for frame in frames)


def numbers(message: Message) -> Array:
    """(6,) of what an IMU or a wrench message measures."""
    if isinstance(message, Imu):
        return np.concatenate([message.angular_velocity, message.linear_acceleration])
    assert isinstance(message, Wrench)
    return np.concatenate([message.force, message.torque])


def joined(parts: Sequence[NDArray[np.void]]) -> NDArray[np.void]:
    """One array of the samples in all parts, as np.concatenate, which is slow with records."""
    return np.frombuffer(bytearray().join(part.tobytes() for part in parts), dtype=parts[0].dtype)


def believed(samples: NDArray[np.void]) -> NDArray[np.void]:
    """Samples (k,) of SAMPLE without those from before the last one with which all begins anew."""
    anew = np.flatnonzero(samples["anew"])
    return samples[anew[-1] :] if len(anew) else samples


def sample_type(size: int) -> np.dtype[np.void]:
    """The dtype of samples that know how they change with ``size`` parameters of effects.

    A SAMPLE, then ``by_wrench`` and ``by_velocity`` (6, size) and ``about`` (size,): the values of
    the parameters by which the sample was made. See :mod:`rov_ident.sensitivity`.
    """
    if size == 0:
        return SAMPLE
    first, step = SAMPLE.itemsize, 48 * size
    names = list(SAMPLE.names or ())
    kinds = [SAMPLE.fields[name] for name in names] if SAMPLE.fields else []
    return record(
        {
            "names": [*names, "by_wrench", "by_velocity", "about"],
            "formats": [*(k[0] for k in kinds), *([("f8", (6, size))] * 2), ("f8", (size,))],
            "offsets": [*(k[1] for k in kinds), first, first + step, first + 2 * step],
        }
    )


def parts(samples: NDArray[np.void]) -> tuple[NDArray[np.void], Array]:
    """Samples (k,) of SAMPLE, and how they change with parameters of effects: (k, 13, size).

    Six rows of the wrench, six of the measured velocity, and the values that they are about.
    """
    if samples.dtype == SAMPLE:
        return samples, _NO_SIDES
    size = (samples.dtype.itemsize - SAMPLE.itemsize) // 104
    rows = np.ascontiguousarray(samples).view(np.uint8).reshape(len(samples), -1)
    plain = np.ascontiguousarray(rows[:, : SAMPLE.itemsize]).view(SAMPLE)[:, 0]
    sides = np.ascontiguousarray(rows[:, SAMPLE.itemsize :]).view(np.float64)
    return plain, sides.reshape(len(samples), 13, size)


def _settings(config: Config) -> NDArray[np.void]:
    settings = np.zeros(1, dtype=_SETTINGS)
    row = settings[0]
    row["gravity"] = config.gravity
    row["water"] = compiled(config.effects).water
    row["odometry_lever"] = config.odometry.position
    row["imu_lever"] = config.imu.position
    roll, pitch, yaw = config.imu.rotation
    row["imu_rotation"] = rotation(quaternion_from_euler(roll, pitch, yaw))
    row["odometry_variance"] = np.repeat(
        [config.odometry.linear_std**2, config.odometry.angular_std**2], 3
    )
    row["attitude_variance"] = config.odometry.attitude_std**2
    row["gyro_variance"] = config.imu.gyro_std**2
    row["accelerometer_variance"] = config.imu.accelerometer_std**2
    row["gyro_bias_variance"] = config.imu.gyro_bias_std**2
    row["accelerometer_bias_variance"] = config.imu.accelerometer_bias_std**2
    row["gate"] = config.odometry.gate
    return settings


_ABSENT = np.full(16, math.nan)
_NO_SIDES = np.zeros((1, 13, 0))
_ZERO = np.zeros(3)
_ZERO_WRENCH = np.zeros(6)

_BIAS_TIME = 60000.0  # s; a bias wanders by its prior deviation in this time, a tenth in 600 s
_UNKNOWN = 1e3  # a variance from which drivers mean "not measured"
_SUREST = 1e-4  # of the configured variance; no message is believed to be surer than that
REPEATED = 2e3  # ours, of a velocity that is not measured again
_POWER_TIME = 5.0  # s; over which it is judged whether a component of nu moves
_MOVING = 4.0  # mean square over noise variance from which it does; at rest it is 1. Higher values
# hold coefficients that still act, and their error goes into the others.
_LEVER_TIME = 0.05  # s; of the filter that differentiates the gyro for the IMU's lever arm


@inlined
def _set(a, b):
    """``a[:] = b``, which takes three seconds to compile."""
    for i in range(len(a)):
        a[i] = b[i]


@inlined
def _average(ratio, i, surprise):
    """Of the last twenty or so; an outlier counts for no more than makes it stand out."""
    ratio[i] += 0.05 * (min(surprise, 1e3) - ratio[i])


@kernel
def mend(
    past, here, after, last, doubt, scatter, floor, push, still, coarse, gross, rates, gate, keeps
):  # fmt: skip
    """Mend the numbers (n,) that jump there and back between messages by more than is usual.

    ``past`` (4, n) are the last two messages as they came, and the last two as believed, and are
    brought up to date; what is an outlier belongs to the latter only if it ``keeps`` its place.

    Back a number may be only with the ``last`` message. A step, or a ramp, goes there and does not
    come back; and what had come two messages before and comes again two on is not lone, whatever
    stands between. The first ``rates`` numbers have inertia: there, two in a row are outliers, too,
    if what was before comes again. What is one, becomes what was before. Where that does not come
    again either, what is demanded has turned; but if the jump is ``gross`` a step was at the
    outlier or right behind it, nobody knows which.

    Whether there was one; ``doubt`` (n,) is left with the square of what a number may be off by.
    Not only those are in doubt: what stands between two calm levels and belongs to neither is a
    step on its way, or an outlier at its place; and what comes again two messages on may be the
    first of a demand that alternates.

    ``scatter`` (n,) are the mean squares of such jumps and are brought up to date; less than
    ``push``, and less than ``coarse`` of the number itself, is always usual; ``still`` stands for
    the push on a number that is exactly the same before and after. ``push``, ``still`` and
    ``gross`` are shares of ``floor`` (n,).
    """
    found = False
    for i in range(len(here)):
        former, earlier, before, came = past[0, i], past[2, i], past[3, i], here[i]
        there, back, later = came - before, after[i] - came, last[i] - came
        turn = before - earlier
        step = min(there * there, back * back)
        comes_again, came_before = later * later, (came - former) ** 2
        jump = 0.0
        if there * back < 0.0 or there * later < 0.0:
            jump = min(step, max(comes_again, came_before))
        constant = turn == 0.0 and (before == after[i] or before == last[i])
        least = (still if constant else push) * floor[i]
        usual = max(least, coarse * min(abs(before), abs(after[i])))
        most = gate * gate * max(scatter[i], usual * usual)
        again = min((after[i] - before) ** 2, (last[i] - before) ** 2) <= most
        returns = last[i] - after[i]
        dip = min(there * there, returns * returns)
        comes_back = there * returns < 0.0 and (last[i] - before) ** 2 < _BACK * dip
        two = i < rates and comes_back and dip > 4.0 * most  # twice as far off as a lone one
        past[0, i], past[1, i] = past[1, i], came
        doubt[i] = 0.0
        if (jump > most and (again or jump > (gross * floor[i]) ** 2)) or two:
            scatter[i] *= 1.05  # the usual may have changed
            found = True
            if not again:
                doubt[i] = 0.25 * (last[i] - before) ** 2
            elif comes_again <= most:
                doubt[i] = there * there
            here[i] = before if again else 0.5 * (before + last[i])
            continue
        scatter[i] += 0.02 * (min(jump, most) - scatter[i])
        around = turn * turn  # of what does not come back at once, on both sides
        if there * back > 0.0:
            around = max(around, (last[i] - after[i]) ** 2)
        calm = max(gate * gate * max(scatter[i], (still * floor[i]) ** 2), _CALM * _CALM * around)
        if back * back < calm < there * there and after[i] == last[i]:
            calm = (gate * _EXACT * floor[i]) ** 2  # a level like that has no noise to hide in
        if min(step, came_before) > calm:
            doubt[i] = 0.5 * (there * there + back * back)
    if keeps or not found:
        for i in range(len(here)):
            past[2, i], past[3, i] = past[3, i], here[i]
    return found


@kernel
def fuse(
    kinematics, settings, sample, t, dt, restart, wrench, wrench_slope, wrench_doubt, hold,
    has_odometry, shift, odometry, has_imu, gyro, gyro_given, specific,
):  # fmt: skip
    """One instant of the kinematic filter; fills the sample.

    Returns whether the odometry was taken, whether the motion is known, and whether it begins anew.

    Velocity and accelerometer bias share one 2 x 2 covariance for the three axes, as their noise is
    isotropic::

        v_dot = f - b + g k - omega x v,   z = v + lever arm,   b a slow random walk

    ``odometry`` is [orientation 4, linear 3, angular 3, variance 6], measured ``shift`` seconds
    before the sample; ``gyro`` and ``specific`` (force) are in sensor axes. ``gyro_given`` is the
    variance in the message, zero or negative where there is none.
    """
    k, s, out = kinematics[0], settings[0], sample[0]
    nan = np.nan
    out.t, out.dt, out.restart = t, dt, restart
    _set(out.wrench, wrench)
    _set(out.wrench_slope, wrench_slope)
    _set(out.wrench_doubt, wrench_doubt)
    out.hold = hold
    for i in range(4):
        out.attitude[i] = nan
    gyro_variance = s.gyro_variance
    if 0.0 < gyro_given < 1.0:
        gyro_variance = max(gyro_given, _SUREST * s.gyro_variance)
    started = k.inertial
    for i in range(3):
        out.gyro[i] = nan
        out.gyro_bias[i] = k.gyro_bias[i]
        out.odometry[i] = nan
        out.odometry[3 + i] = nan
    variance = np.empty(6)
    for i in range(6):
        given = has_odometry and 0.0 < odometry[10 + i] < _UNKNOWN
        least = _SUREST * s.odometry_variance[i]
        variance[i] = max(odometry[10 + i], least) if given else s.odometry_variance[i]
        out.odometry_variance[i] = variance[i]
    r_linear = (variance[0] + variance[1] + variance[2]) / 3.0
    r_angular = (variance[3] + variance[4] + variance[5]) / 3.0

    # What is marked as unknown is not used, unless the gyro knows it.
    has_velocity, has_rates = has_odometry, has_odometry
    for i in range(3):
        if _UNKNOWN <= odometry[13 + i] < np.inf:
            has_rates = False
        if _UNKNOWN <= odometry[10 + i] < np.inf:
            has_velocity = False
        if _UNKNOWN <= odometry[13 + i] < np.inf and not has_imu:
            has_velocity = has_odometry = False

    # attitude, by the rate known so far; the odometry's own rate if there is no IMU
    rate = np.empty(3)
    if has_imu:
        for i in range(3):
            rate[i] = (
                s.imu_rotation[i, 0] * gyro[0]
                + s.imu_rotation[i, 1] * gyro[1]
                + s.imu_rotation[i, 2] * gyro[2]
                - k.gyro_bias[i]
            )
    else:
        for i in range(3):
            rate[i] = odometry[7 + i] if has_odometry else k.rate[i]
    mean_rate = rate.copy()
    if k.known and dt > 0.0:
        for i in range(3):
            mean_rate[i] = 0.5 * (rate[i] + k.rate[i])
    if k.known:
        _set(k.q, turned(k.q, mean_rate * dt))
        k.attitude_variance += gyro_variance * dt * dt + 1e-8 * dt
        if has_imu:
            k.attitude_variance += dt * (dt * k.gyro_bias_variance - 2.0 * k.attitude_bias)
            k.attitude_bias -= dt * k.gyro_bias_variance
            # A rate that came and went between two messages lasted nobody knows how long.
            span = dt + k.interval
            for i in range(3):
                change = rate[i] - k.rate[i]
                swing = min(abs(change), abs(k.change[i]))
                beyond = swing**2 > 4.0 * s.gate**2 * gyro_variance
                if beyond and change * k.change[i] < 0.0 and span < _LASTING:
                    k.attitude_variance += (0.5 * span * swing) ** 2
                k.change[i] = change if k.inertial else 0.0
            k.interval = dt
    credible, anew = True, False
    if has_odometry:
        q = turned(odometry[:4] / np.sqrt(np.sum(odometry[:4] ** 2)), rate * shift)
        if not k.known or not k.inertial:
            _set(k.q, q)
            k.attitude_variance = s.attitude_variance
            k.attitude_bias = 0.0
        else:
            total = k.attitude_variance + s.attitude_variance
            gain = k.attitude_variance / total
            # vector part of conj(k.q) * q: half the rotation from one to the other
            a, b = k.q, q
            e = np.empty(3)
            e[0] = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2]
            e[1] = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1]
            e[2] = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0]
            sign = 1.0 if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] >= 0.0 else -1.0
            e *= 2.0 * sign
            surprise = (e[0] ** 2 + e[1] ** 2 + e[2] ** 2) / (3.0 * total)
            _average(k.ratio, _ATTITUDE, surprise)
            # A heading that is set anew is believed when it stays, but it is no bias of the gyro.
            credible = surprise < s.gate**2
            if not credible and k.chances > 0:
                anew = credible = True
                _set(k.q, q)
                k.attitude_variance = s.attitude_variance
                k.attitude_bias = 0.0
            elif credible:
                _set(k.q, turned(k.q, gain * e))
                bias_gain = k.attitude_bias / total
                for i in range(3):
                    k.gyro_bias[i] += bias_gain * e[i]
                k.gyro_bias_variance -= bias_gain * k.attitude_bias
                k.attitude_bias *= 1.0 - gain
                k.attitude_variance *= 1.0 - gain
                k.refused = 0
            else:
                k.refused += 1
                if k.refused > 1:  # a lone one must not open the gate, nor give the next weight
                    k.attitude_variance += 0.2 * k.attitude_variance + s.attitude_variance
        if credible:
            _set(out.attitude, q)
    _set(out.orientation, k.q)
    to_world = rotation(k.q)
    down = to_world[2]
    for i in range(3):
        out.water[i] = 0.0
        for j in range(3):
            out.water[i] += to_world[j, i] * s.water[j]

    # acceleration of the origin from the IMU, and the velocity it predicts
    acceleration = np.zeros(3)
    if has_imu:
        w, lever = rate, s.imu_lever
        turn = np.zeros(3)
        if k.inertial and dt > 0.0:
            blend = dt / (_LEVER_TIME + dt)
            for i in range(3):
                turn[i] = (rate[i] - k.slow_rate[i]) / (_LEVER_TIME + dt)
                k.slow_rate[i] += blend * (rate[i] - k.slow_rate[i])
        else:
            _set(k.slow_rate, rate)
        cross = np.empty(3)
        cross[0] = w[1] * lever[2] - w[2] * lever[1]
        cross[1] = w[2] * lever[0] - w[0] * lever[2]
        cross[2] = w[0] * lever[1] - w[1] * lever[0]
        for i in range(3):
            j, m = (i + 1) % 3, (i + 2) % 3
            force = (
                s.imu_rotation[i, 0] * specific[0]
                + s.imu_rotation[i, 1] * specific[1]
                + s.imu_rotation[i, 2] * specific[2]
            )
            acceleration[i] = (
                force
                - k.accelerometer_bias[i]
                + s.gravity * down[i]
                - (turn[j] * lever[m] - turn[m] * lever[j])
                - (w[j] * cross[m] - w[m] * cross[j])
                - (w[j] * k.v[m] - w[m] * k.v[j])
            )
    if k.known and has_imu and k.inertial and dt > 0.0:
        for i in range(3):
            k.v[i] += 0.5 * dt * (acceleration[i] + k.acceleration[i])
        noise = s.accelerometer_variance * dt * dt
        k.p_vv += -2.0 * dt * k.p_vb + dt * dt * k.p_bb + noise
        k.p_vb -= dt * k.p_bb
        k.p_bb += s.accelerometer_bias_variance * dt / _BIAS_TIME
        k.gyro_bias_variance += s.gyro_bias_variance * dt / _BIAS_TIME

    # odometry: velocity at the origin, carried to the sample's instant
    taken = has_velocity
    if has_velocity:
        v, angular, lever = np.empty(3), odometry[7:10], s.odometry_lever
        # the acceleration between the odometry and now: in a line from that of the IMU before
        share = 0.5 * shift / dt if has_imu and started and shift < dt else 0.0
        for i in range(3):
            j, m = (i + 1) % 3, (i + 2) % 3
            v[i] = (
                odometry[4 + i]
                - (angular[j] * lever[m] - angular[m] * lever[j])
                + shift * (acceleration[i] + share * (k.acceleration[i] - acceleration[i]))
            )
        begins = not k.known or not (has_imu and started)
        total, surprise = k.p_vv + r_linear, 0.0
        for i in range(3):
            surprise += (v[i] - k.v[i]) ** 2
        surprise /= 3.0 * total
        if not begins and k.chances > 0:
            # Nobody knows yet which of two that contradict each other is wrong.
            anew = anew or surprise > s.gate**2
            if not anew:
                k.chances = 0
        if begins or anew:
            _set(k.v, v)
            k.p_vv = r_linear
            k.p_vb = 0.0
            k.p_bb = s.accelerometer_bias_variance
        else:
            # A filter that refuses for seconds is wrong itself: its variance grows until it agrees,
            # faster than a velocity that has run away can.
            _average(k.ratio, _VELOCITY, surprise)
            taken = surprise <= s.gate**2
            if taken:
                gain, bias_gain = k.p_vv / total, k.p_vb / total
                for i in range(3):
                    innovation = v[i] - k.v[i]
                    k.v[i] += gain * innovation
                    k.accelerometer_bias[i] += bias_gain * innovation
                k.p_bb -= bias_gain * k.p_vb
                k.p_vb *= 1.0 - gain
                k.p_vv *= 1.0 - gain
            else:
                k.p_vv += 0.2 * k.p_vv + r_linear
        if taken:
            for i in range(3):
                out.odometry[i] = v[i] - out.water[i]
        k.known = True
    if has_odometry:
        if not has_imu and taken == has_velocity:  # what is an outlier is so as a whole
            for i in range(3):
                out.odometry[3 + i] = odometry[7 + i]
        if has_imu:
            total = k.gyro_bias_variance + r_angular + gyro_variance
            gain, angle_gain = k.gyro_bias_variance / total, k.attitude_bias / total
            # the gyro at the instant of the odometry; without a past it cannot be known
            if k.inertial and dt > 0.0 and has_rates:
                change, surprise = np.empty(3), 0.0
                for i in range(3):
                    then = rate[i] + min(shift / dt, 1.0) * (k.rate[i] - rate[i])
                    change[i] = then - odometry[7 + i]
                    surprise += change[i] ** 2 / (3.0 * total)
                _average(k.ratio, _RATE, surprise)
                if surprise < s.gate**2:
                    k.gyro_bias_variance *= 1.0 - gain
                    k.attitude_variance -= angle_gain * k.attitude_bias
                    k.attitude_bias *= 1.0 - gain
                    for i in range(3):
                        k.gyro_bias[i] += gain * change[i]
                    _set(k.q, turned(k.q, angle_gain * change))
    if has_imu:
        k.inertial = True
        out.gyro_variance = gyro_variance
        for i in range(3):
            out.gyro[i] = rate[i]
            k.acceleration[i] = acceleration[i]
    if anew:
        k.chances -= 1
        out.restart = out.anew = True
        for i in range(6):
            k.power[i] = 0.0
    out.measured = taken
    for i in range(3):
        k.rate[i] = rate[i]
        out.nu[i] = k.v[i] - out.water[i]
        out.nu[3 + i] = rate[i]
        r = gyro_variance if has_imu else r_angular
        blend = min(dt / _POWER_TIME, 1.0)  # a single value may well be noise
        k.power[i] += blend * (out.nu[i] ** 2 - k.power[i])
        k.power[3 + i] += blend * (out.nu[3 + i] ** 2 - k.power[3 + i])
        out.moving[i] = k.power[i] > _MOVING * r_linear
        out.moving[3 + i] = k.power[3 + i] > _MOVING * r
        out.down[i] = down[i]
        out.down_slope[i] = (down[i] - k.down[i]) / dt if dt > 0.0 else 0.0
        k.down[i] = down[i]
    return taken, k.known, anew


@kernel
def _add_piece(share, turn, wrench, doubt, mean, slope, doubtful):
    for i in range(6):
        mean[i] += share * wrench[i]
        slope[i] += turn * wrench[i]
        doubtful[i] += share * doubt[i]


@kernel
def _surround(acting, sample, around):
    """Add the wrench effects to the sample; around (6,): theirs at the last sample, then at this.

    Straight in between, as the motion is.
    """
    out, now = sample[0], np.zeros(6)
    add_wrenches(acting, out.t, out.nu, rotation(out.orientation), now)
    for i in range(6):
        before = now[i] if out.restart else around[i]
        out.surroundings[i] = 0.5 * (before + now[i])
        out.surroundings_slope[i] = (now[i] - before) / out.dt if out.dt > 0.0 else 0.0
        out.wrench[i] += out.surroundings[i]
        out.wrench_slope[i] += out.surroundings_slope[i]
        around[i] = now[i]


def describe(counts: Mapping[str, int]) -> list[str]:
    """The refusals among a sampler's counts, in words, most frequent first."""
    refused = {name: n for name, n in counts.items() if ":" in name and n}
    return [f"{name} ({n})" for name, n in sorted(refused.items(), key=lambda item: -item[1])]
