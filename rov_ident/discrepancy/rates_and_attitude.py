"""Compares the odometry's angular velocities with its attitude, and decides which to trust.

Rates that are copied from a gyro have its bias and its scale, which would pass for forces that turn
the vehicle; filtered ones are late, which would pass for late thrust; and an attitude whose heading
drifts turns more than the vehicle. Bias and drift look the same in a level vehicle's attitude and
rates. The other sensors tell them apart: the position, as the heading turns velocities into the
world, and the IMU, as a vehicle that moves and turns accelerates to the side. So do the dynamics,
as thrust turns the vehicle.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rov_ident.config import Config
from rov_ident.core.frames import (
    quaternion_from_euler,
    quaternion_multiply,
    quaternion_to_matrix,
    rotated,
    turns,
)
from rov_ident.core.linalg import integral, interpolated, scaled_solve
from rov_ident.discrepancy import sensor_choice, sensor_consistency
from rov_ident.discrepancy.held_out import split, surely_less
from rov_ident.discrepancy.sensor_consistency import CLUSTER, FEWEST, ROUNDS, whitened
from rov_ident.estimation.consistency import Test
from rov_ident.model.coefficients import ONE, parse
from rov_ident.model.equations import Array
from rov_ident.offline.fit import Fit
from rov_ident.sampling.raw_streams import Streams

_BIASED = 5.0  # standard deviations by which angular velocities must differ from the attitude's
_FEWEST_CLUSTERS = 6  # that a record must last: of fewer the scatter is not known
_LARGEST_SCALE = 0.1  # some times what gyros are sold with; beyond it axes or units are wrong
_LATEST = 1.0  # s; as late as velocities may be


@dataclass(frozen=True)
class Agreed:
    """Streams whose angular velocities are those of the attitude, but for a bias of ``rates_std``;
    whether they were later than the odometry's rate can hide; and whether a bias was taken off that
    may be a heading's drift."""

    streams: Streams
    late: bool = False
    may_drift: bool = False


def agreed(streams: Streams, config: Config) -> Agreed:
    """The streams with what surely differs set right: the rates, or the heading."""
    body = [np.broadcast_to(axis, (len(streams.t), 3)) for axis in np.eye(3)]
    between = _between(streams, config)
    errors = body
    if len(streams.imu_t) > 1:  # else trapezoids leave out of quick turns what a scale would, too
        errors = [*body, *_scaled(streams.nu[:, 3:])]
        streams = _with_gyro_set_right(streams, between, config)
    value, std = _apart(streams, between, errors)
    value[3:-1] *= np.abs(value[3:-1]) < _LARGEST_SCALE
    if std.any():
        streams = dataclasses.replace(streams, rates_std=std[:3])
    if not value.any():
        return Agreed(streams)
    late = bool(value[-1] > 0.5 * np.median(np.diff(streams.t)))
    biases = [f"{c} {bias:.2g}" for c, bias in zip("pqr", value) if bias]
    scales = [f"{c} {100.0 * part:.2g} %" for c, part in zip("pqr", value[3:-1]) if part]
    told = [f"{', '.join(biases)} rad/s too much"] if biases else []
    told += [f"{', '.join(scales)} too much"] if scales else []
    told += [f"{value[-1]:.2g} s late"] if value[-1] else []
    note = (
        f"the odometry's angular velocities are not those of its attitude: {', '.join(told)}; "
        "set right"
    )
    biased = _noted(streams, _rates(streams, errors, value), note)
    drift = _drift(streams, between, body) if value[:3].any() else 0.0
    if not drift:
        return Agreed(biased, late)
    turned = _turned(streams, -drift)
    note = (
        f"the heading of the odometry's attitude drifts by {drift:.2g} rad/s beside its angular "
        "velocities and the other sensors; set right"
    )
    value[:3] = 0.0
    drifts = _noted(turned, _rates(turned, errors, value), note)
    streams, may_drift = _chosen(biased, drifts, config)
    return Agreed(streams, late, may_drift)


def scale_of(streams: Streams, config: Config, between: Array | None = None) -> Array:
    """By how much (3,) of themselves the angular velocities of the IMU, or of an odometry without
    one, turn further than the attitude; zero where that is not sure."""
    between = _between(streams, config) if between is None else between
    if len(streams.imu_t) > 1:
        gyro = streams.gyro @ config.imu.to_body.T
        rates = interpolated(streams.imu_t, gyro, streams.t)
        streams = dataclasses.replace(streams, nu=np.hstack([streams.nu[:, :3], rates]))
    body = [np.broadcast_to(axis, (len(streams.t), 3)) for axis in np.eye(3)]
    return _apart(streams, between, [*body, *_scaled(streams.nu[:, 3:])])[0][3:6]


def tests_of(streams: Streams, config: Config, fit: Fit) -> list[Test]:
    """Whether a scale of the angular velocities moves what was fitted to them by more than its
    standard deviation: inertia and linear damping by as much, quadratic damping by twice that."""
    if not streams.has_pose:
        return []
    scale, moved = scale_of(streams, config), 0.0
    inertia = np.diag(fit.fitted.dynamics.body.mass_matrix)
    for name, value, std in zip(fit.names, fit.values.tolist(), fit.std.tolist(), strict=True):
        c = parse(name) if name in fit.given.estimate else None
        if c is not None and c.is_diagonal and c.row >= 3:
            size = abs(value) + float(inertia[c.row]) * c.is_added_mass
            times = 1.0 if c.is_added_mass or c.left == ONE else 2.0
            moved = max(moved, times * size * abs(float(scale[c.row - 3])) / std)
    sizes = ", ".join(f"{c} by {100.0 * x:.1f} %" for c, x in zip("pqr", scale.tolist()) if x)
    failure = (
        f"the angular velocities turn too far beside the attitude, {sizes}, which moves a "
        f"coefficient by up to {moved:.1f} standard deviations: calibrate the gyro"
    )
    return [Test("angular velocities: scale", moved, 1.0, failure)]


def _scaled(rates: Array) -> list[Array]:
    """What a scale of each of the angular velocities (N, 3) adds to them: three of (N, 3)."""
    return [rates * axis for axis in np.eye(3)]


def _with_gyro_set_right(streams: Streams, between: Array, config: Config) -> Streams:
    """The streams with a gyro whose scale is that of the attitude, as velocities are carried from
    one message to the next by it. Its bias is looked for elsewhere (`sensor_consistency`)."""
    scale = scale_of(streams, config, between)
    if not 0.0 < np.abs(scale).max() < _LARGEST_SCALE:
        return streams
    mounting = config.imu.to_body
    gyro = streams.gyro @ mounting.T
    return dataclasses.replace(streams, gyro=gyro * (1.0 - scale) @ mounting)


def _chosen(biased: Streams, drifts: Streams, config: Config) -> tuple[Streams, bool]:
    """Of rates with a bias and a heading that drifts what the sensors or the dynamics surely
    prefer; where none does, or one contradicts another, the bias, which is the commoner: a position
    may be reckoned along the very heading, and a tether may turn the vehicle as a bias would."""
    both, (to_fit, held) = (biased, drifts), split(biased.duration)
    found = [sensor_consistency.search(s, config, to_fit)[0] for s in both]
    compared = [sensor_consistency.comparisons(*of) for of in zip(both, [config] * 2, found)]
    squares: list[tuple[Array, Array]] = []
    if compared[0]:
        sums = sensor_consistency.common_squares(compared, held)
        squares += [(sums[:, 0, [i]], sums[:, 1, [i]]) for i in range(len(compared[0]))]
    turning = [sensor_choice.Data(s, to_fit, s, held, config).dynamics({}, "KMN") for s in both]
    if turning[0] is not None and turning[1] is not None:
        squares.append((turning[0], turning[1]))
    for_bias, for_drift = (any(surely_less(*x[::step]) for x in squares) for step in (1, -1))
    if for_bias != for_drift:
        return drifts if for_drift else biased, False
    note = "; or the heading drifts: sensors and thrust do not agree on which"
    biased = dataclasses.replace(biased, notes=(*biased.notes[:-1], biased.notes[-1] + note))
    return biased, True


def _drift(streams: Streams, between: Array, body: Sequence[Array]) -> float:
    """The drift [rad/s] of the heading that explains all that the rates (beside being late) have
    beside the turns of the attitude; 0 if none does."""
    down = quaternion_to_matrix(streams.orientation)[:, 2]
    drift = -float(_apart(streams, between, [down])[0][0])
    turned = _turned(streams, -drift)
    return drift if drift and not _apart(turned, between, body)[0][:3].any() else 0.0


def _turned(streams: Streams, rate: float) -> Streams:
    """The streams with an attitude that is turned about world down at a rate [rad/s], and with a
    position that is reckoned along it, if it was before."""
    yaw = quaternion_from_euler(0.0, 0.0, rate * streams.t)
    orientation, position = quaternion_multiply(yaw, streams.orientation), streams.position
    if streams.is_reckoned:
        world = rotated(quaternion_to_matrix(orientation), streams.nu[:, :3])
        position = position[0] + integral(streams.t, world)
    return dataclasses.replace(streams, orientation=orientation, position=position)


def _noted(streams: Streams, rates: Array, note: str) -> Streams:
    nu = np.hstack([streams.nu[:, :3], rates])
    return dataclasses.replace(streams, nu=nu, notes=(*streams.notes, note))


def _between(streams: Streams, config: Config) -> Array:
    """What the trapezoids of rates at the times of the odometry leave out of each turn (N - 1, 3)
    [rad], as the gyro sees it, which reads oftener. A bias of it is in both and hence in neither.

    The turn is the integral of the rate and of half the angle so far x rate (Bortz 1971).
    """
    if len(streams.imu_t) < 2:
        return np.zeros((len(streams.t) - 1, 3))
    t = np.union1d(streams.t, streams.imu_t)
    first, *_, last = at = np.searchsorted(t, streams.t)
    mounting = config.imu.to_body
    gyro = interpolated(streams.imu_t, streams.gyro, t) @ mounting.T
    angle = integral(t, gyro)
    steps, so_far = np.diff(angle, axis=0), angle[first:last]
    so_far = so_far - np.repeat(angle[at[:-1]], np.diff(at), axis=0)
    steps = steps[first:last] + 0.5 * np.cross(so_far, steps[first:last])
    turn = np.add.reduceat(steps, at[:-1] - first)
    out: Array = turn - np.diff(integral(streams.t, gyro[at]), axis=0)
    return out


def _apart(streams: Streams, between: Array, errors: Sequence[Array]) -> tuple[Array, Array]:
    """How much of each of P rate ``errors`` (N, 3) [rad/s] the angular velocities have beside the
    turns of the attitude, and how late they are [s]: (P + 1,), zero where that is not sure; and the
    standard deviations of that, with what was set to zero. What rates do ``between`` the times of
    the odometry (N - 1, 3) is added to them. Rates that never change were not measured: that they
    differ by nothing tells no noise of the others."""
    t, turn, measured = streams.t, turns(streams.orientation), ~streams.unmeasured[3:]
    value, std, nothing = (np.zeros(len(errors) + 1) for _ in range(3))
    if t[-1] - t[0] < _FEWEST_CLUSTERS * CLUSTER or not turn[:, measured].any():
        return nothing, nothing
    turned = np.vstack([np.zeros(3), np.cumsum(turn - between, axis=0)])
    grows = [integral(t, error) for error in errors]
    for _ in range(ROUNDS):
        rate = _rates(streams, errors, value)
        apart = integral(t, rate) - turned
        causes = [x[:, measured] for x in (*grows, rate[0] - rate)]
        at, r, columns, _ = whitened(t, apart[:, measured], causes, walk=True)
        if len(at) < FEWEST:
            return nothing, nothing
        cluster = (at // CLUSTER).astype(int)
        normal, gradient = columns.T @ columns, np.zeros((cluster.max() + 1, len(value)))
        np.add.at(gradient, cluster, columns * r[:, None])
        change = scaled_solve(normal, gradient.sum(axis=0), 1e-9)
        np.add.at(gradient, cluster, -columns * (columns @ change)[:, None])
        # scores of whole clusters, as what differs otherwise lasts for seconds (White 1980)
        std = np.sqrt((scaled_solve(normal, gradient.T, 1e-9) ** 2).sum(axis=1))
        value = value + change
    sure = np.where(np.abs(value) > _BIASED * std, value, 0.0)
    std = np.hypot(std, value - sure)
    sure[-1] = np.clip(sure[-1], 0.0, _LATEST)  # a late attitude is no fault of the rates
    if len(streams.imu_t) > 1:  # nor is what trapezoids leave out between two readings of the gyro
        sure[-1] *= sure[-1] > 0.5 * np.median(np.diff(streams.imu_t))
    return sure, std


def _rates(streams: Streams, errors: Sequence[Array], value: Array) -> Array:
    """Angular velocities (N, 3) without errors of sizes (P + 1,), of which the last is lateness."""
    measured, ahead = streams.nu[:, 3:], streams.t + value[-1]
    out: Array = interpolated(streams.t, measured, ahead) - np.tensordot(value[:-1], errors, 1)
    return out
