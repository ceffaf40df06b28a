"""By how much the motion is behind the wrench, and the odometry behind the IMU.

Both are told without a simulation: the gyro reads what the odometry's attitude and rates follow,
and filtered wrench and motion are one regression, with the delay as one more coefficient.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.frames import quaternion_to_matrix
from rov_ident.core.linalg import interpolated, scaled_inverse, scaled_solve
from rov_ident.core.messages import Array
from rov_ident.effects import EFFECTS
from rov_ident.estimation.consistency import Test
from rov_ident.model.scales import authority
from rov_ident.offline.batch_fit import AT_REST
from rov_ident.offline.filtered_regression import filtered_rows, regression, spacing_of
from rov_ident.offline.least_squares import PERIOD
from rov_ident.sampling.queues import LONGEST_INTERVAL
from rov_ident.sampling.raw_streams import MAX_STEP, Streams, measured_at
from rov_ident.sampling.records import beside_odometry
from rov_ident.sampling.sample import SAMPLE
from rov_ident.sampling.without_velocity import is_without_velocity

_CORNER = 6.0  # rad/s; of the filter on wrench and motion: above the motion, below the noise
_FEWEST_TIMED = 100  # messages of the IMU; fewer say nothing of delays
FIRST_ORDER = 1.0  # s; what is further is beyond the manoeuvres about which a delay is linear
MATTERS = 0.02  # s; 5 % of the time constant of a small vehicle, so about 5 % of its added mass
SURELY = 5.0  # standard deviations: these are of the noise alone, and clean dives reach 4.5
_EXACT = 0.01  # s; more than outliers and what a model lacks have made of it: 7 ms in the worst of
# 45 simulated dives with exact stamps, while 15 ms of a wrong clock made 17
_GAP = 1.5  # times the usual distance of rows; across more no slope is taken
_FEWEST_ROWS = 20  # of filtered wrench and motion; about as many as there are coefficients


@dataclass(frozen=True)
class Delay:
    """A delay [s] and its standard deviation; NaN where nothing moves."""

    value: float
    std: float

    @property
    def ahead(self) -> tuple[float, float]:
        """By how much [s] what should follow is ahead, 0 where it is not; and what only stamps that
        are wrong, or commands that were not recorded, exceed."""
        ahead = -self.value if abs(self.value) < FIRST_ORDER else 0.0
        return max(ahead, 0.0), max(_EXACT, SURELY * self.std)

    @property
    def behind(self) -> tuple[float, float]:
        """By how much [s] what follows is behind, 0 where it is not; and what only lag and stamps
        exceed."""
        return Delay(-self.value, self.std).ahead


NO_DELAY = Delay(np.nan, np.nan)


@dataclass(frozen=True)
class Filtered:
    """Filtered wrench (K, 6), motion ``phi`` (K, 6, n + 1) = [Phi y] of the same regression, at t
    (K,) s, and which axes are ``driven`` (6,). ``steered`` (K, 6, n + 1) is what of ``phi`` fins
    and shafts make, None where there are none."""

    t: Array
    phi: Array
    wrench: Array
    driven: NDArray[np.bool_]
    steered: Array | None = None

    def part(self, which: slice) -> "Filtered":
        """The same of some rows."""
        steered = None if self.steered is None else self.steered[which]
        return Filtered(self.t[which], self.phi[which], self.wrench[which], self.driven, steered)

    def drive(self, x: Array) -> Array:
        """What drives the vehicle (K, 6), with estimates x (n,) in prior standard deviations from
        the configured coefficients."""
        if self.steered is None:
            return self.wrench
        return self.wrench + self.steered[:, :, -1] - self.steered[:, :, :-1] @ x


def ahead_of_wrench(ahead: float) -> str:
    """What it means that the motion is so long [s] ahead."""
    return (
        f"the motion is {1e3 * ahead:.0f} ms ahead of the wrench, as nothing that thrusts can be: "
        "correct the time stamps, or record each command that the controller sends"
    )


def behind_wrench(behind: float, drive: str) -> str:
    """What it means that the motion is so long [s] behind, in a model in which nothing is late."""
    return (
        f"the motion is {1e3 * behind:.0f} ms behind {drive}, and nothing in this fit makes it "
        "late, so that added mass and damping do: correct the time stamps, or let the file have a "
        "lag (wrench.lag_std or effects.thruster_lag, of fins inputs.fin_lag_std or "
        "effects.fin_lag; rls, ukf and ml estimate it)"
    )


def gyro_at(streams: Streams, config: Config) -> Array:
    """Rates (N, 3) of the gyro in body axes at the times of the odometry."""
    return interpolated(streams.imu_t, streams.gyro @ config.imu.to_body.T, streams.t)


def odometry_behind_imu(streams: Streams, config: Config) -> Delay | None:
    """Of the odometry's angular velocities; None without an IMU."""
    if len(streams.imu_t) <= _FEWEST_TIMED:
        return None
    known = measured_at(streams.imu_t, streams.t)
    return _lag(streams.t, gyro_at(streams, config), streams.nu[:, 3:], known)


def surely_behind_imu(streams: Streams, config: Config) -> float:
    """By how much [s] attitude and rates of the odometry are behind the gyro, 0 where they surely
    are not: the gyro's stamp may be anywhere in the interval that it reads."""
    late = odometry_behind_imu(streams, config)
    if late is None:
        return 0.0
    half = 0.5 * float(np.median(np.diff(streams.imu_t)))
    return late.value if max(half, SURELY * late.std) < late.value < FIRST_ORDER else 0.0


def behind_imu(behind: float) -> str:
    """What it means that the odometry is so long [s] behind."""
    return (
        f"attitude and angular velocities of the odometry are {1e3 * behind:.0f} ms behind the "
        "IMU: correct the time stamps"
    )


def filtered(samples: NDArray[np.void], config: Config) -> Filtered | None:
    """Wrench and motion of samples (k,) of SAMPLE, filtered alike; None where there are too few."""
    task, samples = regression(config, _CORNER), beside_odometry(samples)
    still = samples.copy()
    for name in ("nu", "down", "down_slope"):
        still[name] = 0.0
    phi, t = filtered_rows(task, samples, PERIOD)
    wrench = filtered_rows(task, still, PERIOD)[0][:, :, -1]
    if len(phi) < _FEWEST_ROWS or len(phi) != len(wrench):
        return None
    rows = Filtered(t, phi, wrench, np.ones(6, dtype=bool))
    if samples["inputs"].any():
        still = samples.copy()
        still["inputs"] = 0.0
        rows = replace(rows, steered=phi - filtered_rows(task, still, PERIOD)[0])
    size = np.sqrt(np.mean(rows.drive(np.zeros(phi.shape[2] - 1)) ** 2, axis=0))
    driven = size > AT_REST * authority(config.dynamics)
    if rows.steered is not None:
        driven |= rows.steered.any(axis=(0, 2))
    if is_without_velocity(samples):  # forces drive what is simulated itself
        driven[:3] = False
    return replace(rows, driven=driven)


def samples_of(streams: Streams) -> NDArray[np.void]:
    """Samples (k,) of SAMPLE at the odometry messages and, at most MAX_STEP apart, between them, as
    far as :func:`filtered` needs them.

    A wrench of which the mean over an interval h alone is known has lost its first moment there:
    filtered with a corner w, it seems late by w h^2 / 12, 80 ms at 2.5 Hz. So intervals are short.
    Motion goes between messages as a cubic: along straight lines it seemed up to 20 ms ahead.
    """
    from scipy.interpolate import CubicHermiteSpline  # here: it takes its time to import

    apart = np.diff(streams.t)
    joined = (apart > 0.0) & (apart <= LONGEST_INTERVAL)
    steps = np.where(joined, np.ceil(apart / MAX_STEP), 1.0)
    place = np.cumsum(np.append(0.0, steps))  # of the messages among the samples
    at = np.arange(place[-1] + 1.0)
    # as the clock goes, but never back
    running = np.cumsum(np.append(0.0, np.where(joined, apart, LONGEST_INTERVAL)))
    between = np.interp(at, place, running)

    def curved(values: Array) -> Array:
        slope = np.gradient(values, running, axis=0)
        out: Array = CubicHermiteSpline(running, values, slope)(between)
        return out

    t = np.interp(at, place, streams.t)
    samples = np.zeros(len(t), dtype=SAMPLE)
    dt = np.diff(t, prepend=t[0])
    impulse = np.concatenate(
        [np.zeros((1, 6)), np.cumsum(np.diff(streams.demand_t)[:, None] * streams.demand[:-1], 0)]
    )
    given = interpolated(streams.demand_t, impulse, t)
    samples["t"], samples["dt"], samples["nu"] = t, dt, curved(streams.nu)
    samples["restart"] = (dt <= 0.0) | (dt > LONGEST_INTERVAL)
    samples["wrench"][1:] = np.diff(given, axis=0) / np.maximum(dt[1:, None], 1e-9)
    if len(streams.inputs_t):
        samples["inputs"][:, 1] = interpolated(streams.inputs_t, streams.inputs, t)
    samples["down"] = curved(quaternion_to_matrix(streams.orientation)[:, 2])
    samples["down_slope"][1:] = np.diff(samples["down"], axis=0) / np.maximum(dt[1:, None], 1e-9)
    return samples


def _lag(t: Array, early: Array, late: Array, known: NDArray[np.bool_]) -> Delay:
    """By how much ``late`` (k, n) follows ``early`` [s] where both are ``known`` (k,), to first
    order."""
    slope = np.gradient(early, t, axis=0)[known]
    power = float(np.sum(slope**2))
    if power < 1e-6 * len(t):
        return NO_DELAY
    off = (late - early)[known]
    off = off - off.mean(axis=0)
    lag = -float(np.sum(off * slope)) / power
    left = off + lag * slope
    return Delay(lag, float(np.sqrt(np.mean(left**2) / power)))


def motion_behind_wrench(rows: Filtered) -> Delay:
    """The coefficients are refitted along with it: tau(t - d) is tau - d tau', so the derivative of
    what drives the vehicle is one more column, and the delay its factor."""
    phi, driven, spacing = rows.phi, rows.driven, spacing_of(rows.t)
    n = phi.shape[2]
    steps = np.abs(np.diff(rows.t))  # a clock may have been set back
    inside = np.maximum(steps[1:], steps[:-1]) < _GAP * spacing
    if inside.sum() < 5 * n:
        return NO_DELAY
    x = np.zeros(n)
    prior, weight = np.append(np.ones(n - 1), 0.0), None
    for _ in range(3):
        drive = rows.drive(x[:-1])
        slope = np.gradient(drive, rows.t, axis=0)
        if not slope[:, driven].any():  # a wrench that holds shows no time
            return NO_DELAY
        table = np.concatenate([phi[:, :, :-1], slope[:, :, None], phi[:, :, -1:]], axis=2)
        table = table[1:-1][inside]
        if weight is None:
            weight = np.where(driven, 1.0 / np.maximum(np.mean(drive**2, axis=0), 1e-12), 0.0)
        a = np.einsum("kai,a,kaj->ij", table, weight, table)
        normal = a[:n, :n] + np.diag(prior)
        x = scaled_solve(normal, a[:n, n])
        left = table[:, :, n] - table[:, :, :n] @ x
        weight = np.where(driven, 1.0 / np.maximum(np.mean(left**2, axis=0), 1e-12), 0.0)
    # rows closer than the filter's memory repeat each other
    variance = scaled_inverse(normal)[-1, -1] * 2.0 / (_CORNER * spacing)
    return Delay(float(x[-1]), float(np.sqrt(variance)))


def is_late(effects: Collection[str]) -> bool:
    """Whether any of the effects makes thrust, fins or velocities late."""
    late = ("late" in EFFECTS[name].traits or EFFECTS[name].late for name in effects)
    return any(late) or "fin_lag" in effects


def tests_of(streams: Streams, config: Config, late: bool) -> list[Test]:
    """Whether the motion is ahead of the wrench: what a fit asks that learns from both; and where
    nothing in its model makes thrust or velocities ``late``, whether it is behind. Nothing where
    nothing moves.

    Where fins or shafts drive the vehicle, too, it is not asked whether the motion is ahead: what
    their model lacks makes as much as a wrong clock (18 ms without ``N_uv``).
    """
    rows = filtered(samples_of(streams), config)
    found = NO_DELAY if rows is None else motion_behind_wrench(rows)
    if rows is None or not np.isfinite(found.value):
        return []
    tests, drive = [], "the wrench, fins and shafts"
    if rows.steered is None:
        drive = "the wrench"
        ahead, limit = found.ahead
        tests = [Test("motion ahead of the wrench", ahead, limit, ahead_of_wrench(ahead))]
    if not late:
        behind, limit = found.behind
        words = behind_wrench(behind, drive)
        tests.append(Test("motion behind the wrench", behind, limit, words))
    return tests
