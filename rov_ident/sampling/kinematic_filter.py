"""Odometry and IMU blended into one velocity, attitude and rate, by kinematics alone.

A Kalman filter without a model of the vehicle is complementary: what it takes from one source it
leaves of the other, so it adds noise but no lag. Velocity and accelerometer bias share one 2 x 2
covariance for the three axes, as their noise is isotropic::

    v_dot = f - b + g k - omega x v,   z = v + lever arm,   b a slow random walk

and so do attitude and gyro bias. Without an IMU the result is the odometry as it came.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.frames import quaternion_from_euler, quaternion_multiply
from rov_ident.core.jit import floats, inlined, kernel, record
from rov_ident.core.messages import Array, Imu, Odometry
from rov_ident.core.quaternions import product, rotation, turned
from rov_ident.core.whiteness import BY_CHANCE, JUDGED_TIME, LARGEST, SUM_TIME, averaged
from rov_ident.effects import affects_sensors, compiled, correct, heading_error
from rov_ident.effects.base import Reading
from rov_ident.sampling.queues import MERGE

_VELOCITY, _RATE, _ATTITUDE, _RATE_AS_READ = range(4)
_PARTS = ("velocity", "angular rate", "attitude")  # of the odometry, each behind a gate of its own;
# the last of the four is its angular rate against the gyro as it was read

STATE = record(
    [
        ("known", "?"),  # an odometry message has been seen since the last restart
        ("inertial", "?"),  # an IMU message has
        ("chances", "i8"),  # how often the first odometry of all may still be discarded
        ("q", "f8", (4,)),
        ("down", "f8", (3,)),
        ("attitude_variance", "f8"),  # rad2
        ("refused", "i8"),  # attitudes in a row
        ("since_attitude", "f8"),  # s since one was measured
        ("turned", "f8"),  # rad2: variance of what the noise of the rates has turned it by since
        ("tilt", "f8"),  # rad2 s: variance density of its error, where that lasts a second
        ("v", "f8", (3,)),  # m/s over ground, at the origin
        ("power", "f8", (6,)),  # recent mean square of nu
        ("rate", "f8", (3,)),  # rad/s, bias removed
        ("rate_change", "f8", (3,)),  # rad/s; of that over the last interval
        ("interval", "f8"),  # s; its length
        ("slow_rate", "f8", (3,)),  # for the angular acceleration of the lever arm
        ("acceleration", "f8", (3,)),  # m/s2 at the origin, body axes
        ("gyro_bias", "f8", (3,)),
        ("gyro_bias_variance", "f8"),
        ("attitude_gyro_bias", "f8"),  # rad2/s: covariance of attitude and gyro bias
        ("accelerometer_bias", "f8", (3,)),
        ("p_vv", "f8"),
        ("p_vb", "f8"),
        ("p_bb", "f8"),
        ("test_ratio", "f8", (4,)),  # NIS over its expectation, averaged, of _PARTS
        # of the same, by axis: normalised innovations added up with fading memory, their variance,
        # power of these sums, averaged; s since the last one, and since the first
        *floats((4, 3), "summed lasting"),
        *floats((4,), "expected since judged"),
    ]
)

_SETTINGS = record(
    [
        ("water", "f8", (3,)),  # m/s, in the world
        ("imu_rotation", "f8", (3, 3)),  # sensor axes -> body axes
        ("odometry_variance", "f8", (6,)),
        *floats((3,), "odometry_lever imu_lever"),
        *floats((), "gravity gate attitude_variance gyro_variance accelerometer_variance"),
        *floats((), "gyro_bias_variance accelerometer_bias_variance"),
    ]
)

_MEASURED = record(
    [
        ("has_odometry", "?"),
        ("age", "f8"),  # s from the odometry to the sample
        ("orientation", "f8", (4,)),  # of the odometry; the fields without a message are not read
        ("linear", "f8", (3,)),  # m/s
        ("angular", "f8", (3,)),  # rad/s
        ("variance", "f8", (6,)),  # of linear and angular; zeros: not given
        ("has_imu", "?"),
        ("gyro", "f8", (3,)),  # rad/s, sensor axes
        ("gyro_error", "f8", (3,)),  # rad/s, body axes: what the effects on sensors took off it
        ("gyro_variance", "f8"),  # as the message has it; zero or negative: not given
        ("specific_force", "f8", (3,)),  # m/s2, sensor axes
    ]
)

_ZERO = np.zeros(3)

CHANCES = 4  # odometry that is never confirmed within so many messages is all there is
BIAS_TIME = 60000.0  # s; a bias wanders by its prior deviation in this time, a tenth in 600 s
UNKNOWN = 1e3  # a variance from which drivers mean "not measured"
SUREST = 1e-4  # of the stated variance of a measurement: no sensor is surer (docs/trust.md)
_DRIFT = 1e-8  # rad2/s; of an attitude by all that is no noise of the rate: 6 mrad in an hour
_POWER_TIME = 5.0  # s; over which it is judged whether a component of nu moves
_MOVING = 4.0  # mean square over noise variance from which it does; at rest it is 1. Higher values
# hold coefficients that still act, and their error goes into the others.
_LEVER_TIME = 0.05  # s; of the filter that differentiates the gyro for the IMU's lever arm
_BRIEF = 0.1  # s; a rate that comes and goes within it may have lasted shorter than its samples
_GROWTH = 0.2  # of the variance with each refusal: a filter that refuses for seconds is wrong
_LARGEST_BIAS = 3.0  # prior standard deviations of it; one gyro in 370 has more about an axis
_AVERAGE = 0.05  # weight of one NIS in the test ratio, that of the last twenty
_LARGEST_NIS = 1e3  # the most that one outlier counts for in it


def _settings(config: Config) -> NDArray[np.void]:
    """(1,) of _SETTINGS but for the water, which is an effect."""
    settings = np.zeros(1, dtype=_SETTINGS)
    row, odometry, imu = settings[0], config.odometry, config.imu
    row["gravity"], row["gate"] = config.gravity, odometry.gate
    row["odometry_lever"], row["imu_lever"] = odometry.position, imu.position
    row["imu_rotation"] = rotation(quaternion_from_euler(*imu.rotation))
    row["odometry_variance"] = np.repeat([odometry.linear_std**2, odometry.angular_std**2], 3)
    row["attitude_variance"] = odometry.attitude_std**2
    for name in ("gyro", "accelerometer", "gyro_bias", "accelerometer_bias"):
        row[f"{name}_variance"] = getattr(imu, f"{name}_std") ** 2
    return settings


class KinematicFilter:
    """Feeds :func:`fuse` with messages; holds its settings and its state."""

    def __init__(self, config: Config) -> None:
        self.configure(config)
        self.clear()
        self.state["chances"] = CHANCES

    def configure(self, config: Config) -> None:
        """Take other settings; the motion stays."""
        self._settings = _settings(config)
        self.take_effects(config)

    def take_effects(self, config: Config) -> None:
        """Take other values of the effects' parameters."""
        self._effects = config.effects
        self._corrects = affects_sensors(config.effects)
        yaw = -heading_error(config.effects)
        self._to_north = quaternion_from_euler(0.0, 0.0, yaw) if yaw else None
        self._settings["water"] = compiled(config.effects).water

    def clear(self) -> None:
        """Forget the motion and the biases of the IMU."""
        self.state = np.zeros(1, dtype=STATE)
        self.state["lasting"] = 1.0
        self.state["gyro_bias_variance"] = self._settings["gyro_bias_variance"]
        self._last_imu = -math.inf  # s
        self._measured = np.zeros(1, dtype=_MEASURED)
        # Views of its fields, as reading a field by its name takes numpy longer than the filter.
        self._into = {name: self._measured[name] for name in _MEASURED.names or ()}

    def begin_with(self, state: NDArray[np.void]) -> None:
        """Keep the biases of the IMU in another filter's state (1,); motion is measured anew."""
        self.state = state.copy()
        self.restart()
        self.state["chances"] = CHANCES

    def restart(self) -> None:
        """The motion since the last sample is not known."""
        self.state["known"] = False
        self.state["inertial"] = False

    @property
    def acceleration(self) -> Array:
        """Of the origin over ground (3,) [m/s2], in body axes, when the IMU last measured."""
        return self.state["acceleration"][0]

    @property
    def test_ratios(self) -> dict[str, float]:
        """Test ratios of the parts of the odometry against the IMU, of late; 1 is expected."""
        return dict(zip(_PARTS, self.state["test_ratio"][0].tolist()))

    @property
    def contradictions(self) -> dict[str, float]:
        """The same, or the power of what differs for a second in the last minute if it is more; of
        parts that have been compared. Angular rates that have the gyro's bias do not contradict
        it, as long as it is one that a gyro may have."""
        state, settings = self.state[0], self._settings[0]
        powers = np.where(state["judged"] > JUDGED_TIME, state["lasting"].max(axis=1), 0.0)
        # an attitude's error may last: then what is stated of each is so of the mean of many
        kept = math.sqrt(1.0 - 1.0 / max(state["expected"][_ATTITUDE], 1.0))
        powers[_ATTITUDE] *= (1.0 - kept) / (1.0 + kept)
        ratios = np.maximum(state["test_ratio"], powers).tolist()
        bias_std = math.sqrt(settings["gyro_bias_variance"])
        if np.abs(state["gyro_bias"]).max() <= _LARGEST_BIAS * bias_std:
            ratios[_RATE] = min(ratios[_RATE], ratios[_RATE_AS_READ])
        return {part: x for part, x in zip(_PARTS, ratios) if x > 0.0}

    @property
    def lasting_attitude_error(self) -> float:
        """How much more the attitude differs from the integrated gyro for a second, in the last
        minute, than chance makes of white noise, over the variance that is stated of it; zero until
        it is known."""
        state, part = self.state[0], _PARTS.index("attitude")
        if not state["judged"][part] > JUDGED_TIME:
            return 0.0
        by_chance = BY_CHANCE**2 * state["test_ratio"][part]
        return max(float(state["lasting"][part].max() - by_chance), 0.0)

    def step(
        self,
        sample: NDArray[np.void],
        t: float,
        dt: float,
        restart: bool,
        hold: float,
        wrench: tuple[Array, Array, Array],
        odometry: Odometry | None,
        age: float,
        imu: Imu | None,
    ) -> tuple[bool, bool, bool, bool]:
        """Fuse what was measured at one instant, and fill the sample (1,) with it.

        ``wrench`` are mean, slope and doubt, each (6,); ``odometry`` was measured ``age`` seconds
        before the sample. Returns whether the odometry was taken, whether the motion is known,
        whether everything restarts, and whether the IMU has stopped.
        """
        into = self._into
        into["has_odometry"][0] = odometry is not None
        into["age"][0] = age
        if odometry is not None:
            self._take_odometry(odometry, imu)
        into["has_imu"][0] = imu is not None
        if imu is not None:
            self._take_imu(imu)
            self._last_imu = t
        stopped = t - self._last_imu > MERGE and bool(self.state["inertial"][0])
        if stopped:
            self.state["inertial"] = False
        taken = fuse(
            self.state, self._settings, self._measured, sample, t, dt, restart, hold, *wrench
        )
        return *taken, stopped

    def _take_odometry(self, message: Odometry, imu: Imu | None) -> None:
        """The message without what the effects on the sensors have added."""
        into = self._into
        linear, angular, variance = message.linear, message.angular, message.twist_variance
        if imu is not None and linear.any() and not angular.any():  # no vehicle moves so straight
            variance = np.append(variance[:3], np.full(3, UNKNOWN))
        if imu is not None and UNKNOWN <= max(variance[3:].tolist()) < math.inf:
            # not measured: the arm of a velocity sensor turns as the gyro says
            gyro = self._settings["imu_rotation"][0] @ imu.angular_velocity
            angular = gyro - self.state["gyro_bias"][0]
        if self._corrects:
            linear, angular, *_ = correct(Reading(linear, angular, _ZERO, _ZERO), self._effects)
        orientation = message.orientation
        if self._to_north is not None:
            orientation = quaternion_multiply(self._to_north, orientation)
        into["orientation"][0] = orientation
        into["linear"][0] = linear
        into["angular"][0] = angular
        into["variance"][0] = variance

    def _take_imu(self, message: Imu) -> None:
        into = self._into
        gyro, force, error = message.angular_velocity, message.linear_acceleration, _ZERO
        if self._corrects:
            to_body = self._settings["imu_rotation"][0]
            given = Reading(_ZERO, _ZERO, to_body @ gyro, to_body @ force)
            reading = correct(given, self._effects)
            error = given.gyro - reading.gyro
            gyro = gyro - to_body.T @ error
            force = force + to_body.T @ (reading.specific_force - given.specific_force)
        into["gyro"][0] = gyro
        into["gyro_error"][0] = error
        into["specific_force"][0] = force
        into["gyro_variance"][0] = sum(message.angular_variance.tolist()) / 3.0


@inlined
def _assign(a, b):
    """``a[:] = b``, which takes three seconds to compile."""
    for i in range(len(a)):
        a[i] = b[i]


@inlined
def _compare(k, part, difference, variance):
    """Take in the difference (3,) of odometry and IMU; its square over the expected one."""
    nis, since = 0.0, k.since[part]
    keep = np.exp(-since / SUM_TIME)
    k.since[part] = 0.0
    k.judged[part] += since
    k.expected[part] = keep * keep * k.expected[part] + 1.0
    for i in range(3):
        innovation = difference[i] / np.sqrt(variance)
        nis += innovation * innovation / 3.0
        counted = min(max(innovation, -LARGEST), LARGEST)
        k.summed[part, i] = keep * k.summed[part, i] + counted
        k.lasting[part, i] = averaged(
            k.lasting[part, i], k.judged[part], since, k.summed[part, i], k.expected[part]
        )
    k.test_ratio[part] += _AVERAGE * (min(nis, _LARGEST_NIS) - k.test_ratio[part])
    return nis


@inlined
def _cross(a, b, i):
    """Component i of a x b."""
    j, m = (i + 1) % 3, (i + 2) % 3
    return a[j] * b[m] - a[m] * b[j]


@inlined
def slope_of_mean(down, later, rate, later_rate, dt, i):
    """Component i of the slope of the line that ends at ``later`` and has the mean of the cubic
    between both, whose slope at each end is ``down x rate``.

    The mean of both ends alone lacks the curvature of a turn: by ``dt^2 / 12`` of the second
    derivative, which for the righting moment looks like so much less inertia.
    """
    bend = _cross(down, rate, i) - _cross(later, later_rate, i)
    return (later[i] - down[i]) / dt - bend / 6.0


@inlined
def _to_body(s, a, i):
    """Component i in body axes of a (3,) in the axes of the IMU."""
    r = s.imu_rotation
    return r[i, 0] * a[0] + r[i, 1] * a[1] + r[i, 2] * a[2]


@inlined
def _begin_attitude(k, s, q):
    """Take the measured attitude q (4,) for the filter's."""
    _assign(k.q, q)
    k.attitude_variance = s.attitude_variance
    k.attitude_gyro_bias = 0.0


@inlined
def _predict_attitude(k, s, rate, dt, has_imu, gyro_variance):
    """Turn the attitude by the mean of the last and the present rate (3,) over dt."""
    mean_rate = rate.copy()
    if dt > 0.0:
        for i in range(3):
            mean_rate[i] = 0.5 * (rate[i] + k.rate[i])
    _assign(k.q, turned(k.q, mean_rate * dt))
    k.attitude_variance += gyro_variance * dt * dt + _DRIFT * dt
    k.turned += gyro_variance * dt * dt
    if has_imu:
        k.attitude_variance += dt * (dt * k.gyro_bias_variance - 2.0 * k.attitude_gyro_bias)
        k.attitude_gyro_bias -= dt * k.gyro_bias_variance
        # A rate that came and went between two messages lasted for an unknown time.
        span = dt + k.interval
        for i in range(3):
            change = rate[i] - k.rate[i]
            pulse = min(abs(change), abs(k.rate_change[i]))
            beyond = pulse**2 > 4.0 * s.gate**2 * gyro_variance
            if beyond and change * k.rate_change[i] < 0.0 and span < _BRIEF:
                k.attitude_variance += (0.5 * span * pulse) ** 2
            k.rate_change[i] = change if k.inertial else 0.0
        k.interval = dt


@inlined
def _correct_attitude(k, s, q):
    """Correct by the measured attitude q (4,); whether it is believed, and whether all begins anew.

    A heading that is set anew is believed when it stays, but it is no bias of the gyro.
    """
    total = k.attitude_variance + s.attitude_variance
    gain = k.attitude_variance / total
    # vector part of conj(k.q) * q: half the rotation from one to the other
    a, e = k.q, np.empty(3)
    cosine, e[0], e[1], e[2] = product(a[0], -a[1], -a[2], -a[3], q[0], q[1], q[2], q[3])
    e *= 2.0 if cosine >= 0.0 else -2.0
    nis = _compare(k, _ATTITUDE, e, total)
    credible, anew = nis < s.gate**2, False
    if not credible and k.chances > 0:
        anew = credible = True
        _begin_attitude(k, s, q)
    elif credible:
        _assign(k.q, turned(k.q, gain * e))
        bias_gain = k.attitude_gyro_bias / total
        for i in range(3):
            k.gyro_bias[i] += bias_gain * e[i]
        k.gyro_bias_variance -= bias_gain * k.attitude_gyro_bias
        k.attitude_gyro_bias *= 1.0 - gain
        k.attitude_variance *= 1.0 - gain
        k.refused = 0
    else:
        k.refused += 1
        if k.refused > 1:  # a lone one must not open the gate, nor give the next weight
            k.attitude_variance += _GROWTH * k.attitude_variance + s.attitude_variance
    return credible, anew


@inlined
def _judge_tilt(k, s):
    """How uncertain the attitude is, where its error lasts a second.

    With white noise of density q of the gyro and r of the attitude, the error of their steady
    filter has the density ``2 q r / (q + w^2 r)`` at the frequency w: nearly ``2 q / w^2``,
    whatever r is. Without a gyro nothing is known of how long an error lasts.
    """
    k.tilt = 0.0
    if k.inertial and k.since_attitude > 0.0:
        r = s.attitude_variance * k.since_attitude
        q = k.turned / k.since_attitude * SUM_TIME**2
        k.tilt = 2.0 * q * r / (q + r)
    k.since_attitude = k.turned = 0.0


@inlined
def _accelerate(k, s, specific_force, rate, down, dt, acceleration):
    """acceleration (3,) of the origin in body axes, from the IMU's specific force (3,)."""
    turn = np.zeros(3)  # angular acceleration
    if k.inertial and dt > 0.0:
        blend = dt / (_LEVER_TIME + dt)
        for i in range(3):
            turn[i] = (rate[i] - k.slow_rate[i]) / (_LEVER_TIME + dt)
            k.slow_rate[i] += blend * (rate[i] - k.slow_rate[i])
    else:
        _assign(k.slow_rate, rate)
    tangential = np.empty(3)
    for i in range(3):
        tangential[i] = _cross(rate, s.imu_lever, i)
    for i in range(3):
        acceleration[i] = (
            _to_body(s, specific_force, i)
            - k.accelerometer_bias[i]
            + s.gravity * down[i]
            - _cross(turn, s.imu_lever, i)
            - _cross(rate, tangential, i)
            - _cross(rate, k.v, i)
        )


@inlined
def _predict_velocity(k, s, acceleration, dt):
    """Integrate the acceleration (3,), straight from that at the last sample."""
    for i in range(3):
        k.v[i] += 0.5 * dt * (acceleration[i] + k.acceleration[i])
    noise = s.accelerometer_variance * dt * dt
    k.p_vv += -2.0 * dt * k.p_vb + dt * dt * k.p_bb + noise
    k.p_vb -= dt * k.p_bb
    k.p_bb += s.accelerometer_bias_variance * dt / BIAS_TIME
    k.gyro_bias_variance += s.gyro_bias_variance * dt / BIAS_TIME


@inlined
def _correct_velocity(k, s, v, variance, begins, anew):
    """Correct by the velocity v (3,); whether it was taken, and whether all begins anew."""
    total, nis, difference, taken = k.p_vv + variance, 0.0, np.empty(3), True
    for i in range(3):
        difference[i] = v[i] - k.v[i]
        nis += difference[i] ** 2 / (3.0 * total)
    if not begins and k.chances > 0:
        # Nobody knows yet which of two that contradict each other is wrong.
        anew = anew or nis > s.gate**2
        if not anew:
            k.chances = 0
    if begins or anew:
        _assign(k.v, v)
        k.p_vv = variance
        k.p_vb = 0.0
        k.p_bb = s.accelerometer_bias_variance
    else:
        _compare(k, _VELOCITY, difference, total)
        taken = nis <= s.gate**2
        if taken:
            gain, bias_gain = k.p_vv / total, k.p_vb / total
            for i in range(3):
                k.v[i] += gain * difference[i]
                k.accelerometer_bias[i] += bias_gain * difference[i]
            k.p_bb -= bias_gain * k.p_vb
            k.p_vb *= 1.0 - gain
            k.p_vv *= 1.0 - gain
        else:  # grows faster than a velocity that has run away can
            k.p_vv += _GROWTH * k.p_vv + variance
    return taken, anew


@inlined
def _correct_gyro_bias(k, s, rate, m, share, r_angular, gyro_variance):
    """Compare the gyro at the odometry's instant, ``share`` of dt ago, with the odometry's rate.

    A rate that is copied from the gyro has its bias, too, and says nothing of it: it differs from
    the gyro less before the bias is taken off, as only the attitude can have told it, or the
    configuration has it.
    """
    total = k.gyro_bias_variance + r_angular + gyro_variance
    gain, angle_gain = k.gyro_bias_variance / total, k.attitude_gyro_bias / total
    change, as_read = np.empty(3), np.empty(3)
    for i in range(3):
        then = rate[i] + share * (k.rate[i] - rate[i])
        change[i] = then - m.angular[i]
        as_read[i] = change[i] + k.gyro_bias[i] + m.gyro_error[i]
    _compare(k, _RATE_AS_READ, as_read, r_angular + gyro_variance)
    near, apart = _compare(k, _RATE, change, total) < s.gate**2, k.lasting[_RATE].max()
    copied = apart > BY_CHANCE**2 and apart > k.lasting[_RATE_AS_READ].max()
    if near and not copied:
        k.gyro_bias_variance *= 1.0 - gain
        k.attitude_variance -= angle_gain * k.attitude_gyro_bias
        k.attitude_gyro_bias *= 1.0 - gain
        for i in range(3):
            k.gyro_bias[i] += gain * change[i]
        _assign(k.q, turned(k.q, angle_gain * change))


@kernel
def fuse(
    state, settings, measured, sample, t, dt, restart, hold, wrench, wrench_slope, wrench_doubt
):  # fmt: skip
    """One instant of the filter; fills the sample (1,).

    Returns whether the odometry was taken, whether the motion is known, and whether it begins anew.
    Arguments are records (1,) of STATE, _SETTINGS and _MEASURED.
    """
    k, s, m, out = state[0], settings[0], measured[0], sample[0]
    out.t, out.dt, out.restart, out.hold = t, dt, restart, hold
    _assign(out.wrench, wrench)
    _assign(out.wrench_slope, wrench_slope)
    _assign(out.wrench_doubt, wrench_doubt)
    has_odometry, has_imu = m.has_odometry, m.has_imu
    for i in range(4):
        out.attitude[i] = np.nan
    for i in range(3):
        out.gyro[i] = out.odometry[i] = out.odometry[3 + i] = np.nan
    gyro_variance = s.gyro_variance
    if 0.0 < m.gyro_variance < 1.0 and has_imu:
        gyro_variance = max(m.gyro_variance, SUREST * s.gyro_variance)
    started = k.inertial
    _assign(out.gyro_bias, k.gyro_bias)
    variance = np.empty(6)
    for i in range(6):
        given = has_odometry and 0.0 < m.variance[i] < UNKNOWN
        least = SUREST * s.odometry_variance[i]
        variance[i] = max(m.variance[i], least) if given else s.odometry_variance[i]
        out.odometry_variance[i] = variance[i]
    r_linear = (variance[0] + variance[1] + variance[2]) / 3.0
    r_angular = (variance[3] + variance[4] + variance[5]) / 3.0

    # What is marked as unknown is not used, unless the gyro knows it.
    has_velocity, has_rates = has_odometry, has_odometry
    if has_odometry:
        for i in range(3):
            if UNKNOWN <= m.variance[i] < np.inf:
                has_velocity = False
            if UNKNOWN <= m.variance[3 + i] < np.inf:
                has_rates = False
                if not has_imu:
                    has_velocity = has_odometry = False

    # attitude, by the rate known so far; the odometry's own rate if there is no IMU
    rate = np.empty(3)
    for i in range(3):
        if has_imu:
            rate[i] = _to_body(s, m.gyro, i) - k.gyro_bias[i]
        else:
            rate[i] = m.angular[i] if has_odometry else k.rate[i]
    if k.known:
        for part in range(len(k.since)):
            k.since[part] += dt
        k.since_attitude += dt
        _predict_attitude(k, s, rate, dt, has_imu, gyro_variance)
    anew = False
    if has_odometry:
        length = np.sqrt(np.sum(m.orientation**2))
        q, credible = turned(m.orientation / length, rate * m.age), True
        if not k.known or not k.inertial:
            _begin_attitude(k, s, q)
        else:
            credible, anew = _correct_attitude(k, s, q)
        _judge_tilt(k, s)
        if credible:
            _assign(out.attitude, q)
    _assign(out.orientation, k.q)
    to_world = rotation(k.q)
    down = to_world[2]
    for i in range(3):
        out.water[i] = 0.0
        for j in range(3):
            out.water[i] += to_world[j, i] * s.water[j]

    acceleration = np.zeros(3)
    if has_imu:
        _accelerate(k, s, m.specific_force, rate, down, dt, acceleration)
        if k.known and k.inertial and dt > 0.0:
            _predict_velocity(k, s, acceleration, dt)

    # odometry: velocity at the origin, carried to the sample's instant
    taken = has_velocity
    if has_velocity:
        # the acceleration between the odometry and now: in a line from that of the IMU before
        v, share = np.empty(3), 0.5 * m.age / dt if has_imu and started and m.age < dt else 0.0
        for i in range(3):
            v[i] = (
                m.linear[i]
                - _cross(m.angular, s.odometry_lever, i)
                + m.age * (acceleration[i] + share * (k.acceleration[i] - acceleration[i]))
            )
        begins = not k.known or not (has_imu and started)
        taken, anew = _correct_velocity(k, s, v, r_linear, begins, anew)
        if taken:
            for i in range(3):
                out.odometry[i] = v[i] - out.water[i]
        k.known = True
    if has_odometry:
        if not has_imu and taken == has_velocity:  # what is an outlier is so as a whole
            for i in range(3):
                out.odometry[3 + i] = m.angular[i]
        # the gyro at the instant of the odometry; without a past it cannot be known
        if has_imu and k.inertial and dt > 0.0 and has_rates:
            share = min(m.age / dt, 1.0)
            _correct_gyro_bias(k, s, rate, m, share, r_angular, gyro_variance)
    if has_imu:
        k.inertial = True
        out.gyro_variance = gyro_variance
        _assign(out.gyro, rate)
        _assign(k.acceleration, acceleration)
    if anew:
        k.chances -= 1
        out.restart = out.anew = True
        for i in range(6):
            k.power[i] = 0.0
    out.measured, out.tilt = taken, k.tilt
    before = k.rate.copy()
    _assign(k.rate, rate)
    r_rate = gyro_variance if has_imu else r_angular
    blend = min(dt / _POWER_TIME, 1.0)  # a single value may well be noise
    for i in range(6):
        out.nu[i] = k.v[i] - out.water[i] if i < 3 else rate[i - 3]
        k.power[i] += blend * (out.nu[i] ** 2 - k.power[i])
        out.moving[i] = k.power[i] > _MOVING * (r_linear if i < 3 else r_rate)
    for i in range(3):
        out.down[i] = down[i]
        out.down_slope[i] = slope_of_mean(k.down, down, before, rate, dt, i) if dt > 0.0 else 0.0
    _assign(k.down, down)
    return taken, k.known, anew
