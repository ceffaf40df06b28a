"""The Cramer-Rao bound of a simulated dive: how well any estimator could know its coefficients.

    python -m bench.studies.bound [--seeds N]

checks the bound against maximum likelihood and others.

The experiment is the one of `measure`: velocities and gyro with white
noise, and a wrench that is itself *measured* with noise. The wrench that acts is the measured one
less its error, so that the error is process noise, constant from one wrench message to the next::

    M nu_dot = tau + delta - h(nu, theta) - g,    delta ~ N(0, (s tau)^2) anew with each message
    z = nu + noise

A Kalman filter over [nu, delta] along the trajectory whitens the measurements: its innovations e
are independent with variances s, and for Gaussian noise the information about theta is

    J = sum over innovations of  (de/dtheta)' (de/dtheta) / s

(Astrom 1980; Ljung 1999, sec. 7.4). ``de/dtheta`` follows from the tangent of the filter, one
recursion beside the covariance's. The same pass over noisy data gives the score, and with it the
maximum-likelihood estimate by Gauss-Newton: the bound's check, as its scatter has to reach it.

What is left out: theta also changes the variances s, through the mass that the process noise moves.
That information is some thousand times smaller and ignored. Attitude is taken as known, and so are
the noise's variances; position and attitude as measurements would add information on slow motion
that no estimator here uses. The initial velocity is known from the first odometry message only.
"""

import argparse
import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.core.files import shipped
from rov_ident.core.frames import quaternion_to_matrix
from rov_ident.core.jit import kernel, record
from rov_ident.core.messages import Imu, Odometry, Wrench
from rov_ident.estimation.observer import LANES, OBSERVER, correct, drive_of, linearised_step
from rov_ident.model.equations import Array, momentum_columns
from rov_ident.simulation.open_loop import simulate
from rov_ident.simulation.virtual_sensors import START, Dive, Suite, dive

_SCRATCH = record(OBSERVER)
_MOMENT = 1e-9  # s; a step so short is a derivative, in units of it


class _Work(NamedTuple):
    """Of :func:`drive_of`, for m coefficients."""

    of_rate: Array  # (6, m)
    momentum: Array  # (6, m)
    of_motion: Array  # (6, m)
    scratch: NDArray[np.void]  # (1,)


class Experiment(NamedTuple):
    """A dive as events in the order of time, N of them, the first an odometry message.

    ``z`` holds velocity (6), gyro (3) and specific force (3); ``variance`` is infinite where the
    event did not measure that. The wrench acts from its event to the next one.
    """

    t: Array  # (N,)
    wrench: Array  # (N, 6) N, N m
    fresh: NDArray[np.bool_]  # (N,): a wrench message, with a new error
    down: Array  # (N, 3) unit, body axes
    z: Array  # (N, 12)
    variance: Array  # (N, 12)
    wrench_variance: Array  # (N, 6)


def experiment(
    config: Config, run: Dive, suite: Suite, noisy: bool = True, accelerometer: bool = False
) -> Experiment:
    """A simulated dive as it was measured or, not ``noisy``, as it would be without noise."""
    # A wrench acts on what is measured at its own instant.
    messages = sorted((m for *_, m in run.messages), key=lambda m: (m.stamp, type(m) is not Wrench))
    t = np.array([m.stamp - START for m in messages]) * 1e-9
    at = np.searchsorted(run.truth.t, t - 1e-7)
    nu, nu_dot = run.truth.nu[at], run.truth.nu_dot[at]
    down = quaternion_to_matrix(run.truth.orientation[at])[:, 2, :]
    specific = nu_dot[:, :3] + np.cross(nu[:, 3:], nu[:, :3]) - config.gravity * down
    std = [suite.linear_std, suite.angular_std, suite.gyro_std, suite.accelerometer_std]
    noise = np.repeat(np.square(std), 3)
    z, variance = np.hstack([nu, nu[:, 3:], specific]), np.full((len(t), 12), np.inf)
    wrench, fresh, held = run.demand[at], np.zeros(len(t), dtype=bool), np.zeros(6)
    for i, m in enumerate(messages):
        if isinstance(m, Wrench):
            held, fresh[i] = np.concatenate([m.force, m.torque]), True
        elif isinstance(m, Odometry):
            variance[i, :6] = noise[:6]
            if noisy:
                z[i, :6] = np.concatenate([m.linear, m.angular])
        elif isinstance(m, Imu):
            end = 12 if accelerometer else 9
            variance[i, 6:end] = noise[6:end]
            if noisy:
                z[i, 6:] = np.concatenate([m.angular_velocity, m.linear_acceleration])
        if noisy:
            wrench[i] = held
    first = next(i for i, m in enumerate(messages) if isinstance(m, Odometry))
    fresh[first] = True
    return Experiment(
        *(np.ascontiguousarray(part[first:])
          for part in (t, wrench, fresh, down, z, variance)),
        (suite.wrench_std * wrench[first:]) ** 2,
    )  # fmt: skip


def information(config: Config, data: Experiment) -> tuple[Array, Array, float]:
    """Information (m, m), score (m,) and squared normalised innovations per innovation.

    About all coefficients of the model in the order of theta, at the model's values.
    """
    model = config.model
    m = len(model.theta)
    total, score, squares = np.zeros((m, m)), np.zeros(m), np.zeros(2)
    _filter(
        model.structure, model.mass_matrix, np.linalg.inv(model.mass_matrix), model.theta,
        model.body.restoring, config.gravity, *data, total, score, squares,
    )  # fmt: skip
    return total, score, squares[0] / squares[1]


def bound(config: Config, run: Dive, suite: Suite, accelerometer: bool = False) -> Array:
    """The smallest covariance (m, m) that an unbiased estimate from this dive can have."""
    data = experiment(config, run, suite, noisy=False, accelerometer=accelerometer)
    return inverse_of(information(config, data)[0])


def maximum_likelihood(config: Config, data: Experiment, iterations: int = 6) -> Array:
    """theta (m,) of the largest likelihood, by Gauss-Newton from the configuration's values."""
    for _ in range(iterations):
        total, score, _ = information(config, data)
        theta = config.model.theta + inverse_of(total) @ score
        config = config.with_model(config.model.with_theta(theta))
    return config.model.theta


def inverse_of(total: Array) -> Array:
    """Inverse of an information matrix, scaled to a unit diagonal meanwhile."""
    size = 1.0 / np.sqrt(np.diag(total))
    inverse: Array = np.linalg.inv(total * np.outer(size, size)) * np.outer(size, size)
    return inverse


# ------------------------------------------------------------------ kernels


@kernel
def _filter(
    structure, mass_matrix, inverse, theta, restoring, gravity, t, wrench, fresh, down, z, variance,
    wrench_variance, total, score, squares,
):  # fmt: skip
    """One pass; adds to total (m, m), score (m,), squares (2,): sum and number of innovations."""
    m = len(theta)
    theta, one_theta = np.repeat(theta, LANES).reshape(m, LANES), theta.reshape(m, 1)
    work = _Work(np.empty((6, m)), np.empty((6, m)), np.empty((6, m)), np.empty(1, dtype=_SCRATCH))
    o = work.scratch[0]
    for i in range(6):
        o.slope[i] = o.guide[i] = 0.0
        for j in range(6):
            o.inverse[i, j], o.one_mass[i, j, 0] = inverse[i, j], mass_matrix[i, j]
            for k in range(LANES):
                o.mass[i, j, k] = mass_matrix[i, j]
    x, p = np.zeros(12), np.zeros((12, 12))  # [nu, delta]
    s = np.zeros((12, m))  # d x / d theta
    transition, into = np.eye(12), np.zeros((12, 6))
    drive, all_of_them, scale = np.empty((6, m)), np.arange(m), np.ones(m)
    h, g = np.empty(12), np.empty(m)
    for i in range(6):
        x[i], p[i, i] = z[0, i], variance[0, i]
        p[6 + i, 6 + i] = wrench_variance[0, i]
    for n in range(1, len(t)):
        dt = t[n] - t[n - 1]
        if dt > 0.0:
            for i in range(6):
                o.force[i] = wrench[n - 1, i] + x[6 + i]
                for j in range(3):
                    o.force[i] += restoring[i, j] * 0.5 * (down[n - 1, j] + down[n, j])
            linearised_step(structure, theta, one_theta, x, -0.5 * dt, dt, o)
            momentum_columns(structure, o.middle_nu_dot, work.of_rate)
            drive_of(structure, o.middle, all_of_them, scale, m, work, drive)
            for i in range(6):
                x[i] = o.end[i]
                for j in range(6):
                    transition[i, j], transition[i, 6 + j] = o.transition[i, j], o.into[i, j]
                    into[i, j] = o.into[i, j]
            s[:] = transition @ s + into @ drive
            p[:] = transition @ p @ transition.T
        if fresh[n]:
            for i in range(6):
                x[6 + i] = 0.0
                s[6 + i] = 0.0
                for j in range(12):
                    p[6 + i, j] = 0.0
                    p[j, 6 + i] = 0.0
                p[6 + i, 6 + i] = wrench_variance[n, i]
        for c in range(12):
            if not np.isfinite(variance[n, c]):
                continue
            h[:] = 0.0
            g[:] = 0.0
            if c < 9:
                axis = c if c < 6 else c - 3
                h[axis] = 1.0
                expected = x[axis]
            else:
                axis = c - 9
                for i in range(6):
                    o.force[i] = wrench[n, i] + x[6 + i]
                    for j in range(3):
                        o.force[i] += restoring[i, j] * down[n, j]
                linearised_step(structure, theta, one_theta, x, 0.0, _MOMENT, o)
                momentum_columns(structure, o.nu_dot, work.of_rate)
                drive_of(structure, o.middle, all_of_them, scale, m, work, drive)
                a, b = (axis + 1) % 3, (axis + 2) % 3
                expected = o.nu_dot[axis] + x[3 + a] * x[b] - x[3 + b] * x[a]
                expected -= gravity * down[n, axis]
                for i in range(6):
                    h[i] = o.jacobian[axis, i] / _MOMENT
                h[6:] = inverse[axis]
                h[3 + a] += x[b]
                h[b] += x[3 + a]
                h[3 + b] -= x[a]
                h[a] -= x[3 + b]
                for j in range(m):
                    for i in range(6):
                        g[j] += inverse[axis, i] * drive[i, j]
            ph = p @ h
            size = variance[n, c]
            for i in range(12):
                size += h[i] * ph[i]
                if h[i] != 0.0:
                    for j in range(m):
                        g[j] += h[i] * s[i, j]
            e = z[n, c] - expected
            squares[0] += e * e / size
            squares[1] += 1.0
            for i in range(m):
                score[i] += g[i] * e / size
                for j in range(m):
                    total[i, j] += g[i] * g[j] / size
            correct(x, p, s, g, ph, size, e)


# ------------------------------------------------------------------ checks


def check_likelihood(seeds: int, duration: float = 60.0) -> None:
    """The scatter of the maximum-likelihood estimate over dives, in units of the bound."""
    suite, errors = Suite(), []
    for seed in range(seeds):
        config, run = draw(seed, duration, suite)
        estimate = maximum_likelihood(config, experiment(config, run, suite))
        root = np.linalg.cholesky(bound(config, run, suite))
        errors.append(np.linalg.solve(root, estimate - config.model.theta))
    size = np.sqrt(np.mean(np.square(errors), axis=0))
    mean = np.sqrt(np.mean(np.square(errors)))
    print(
        f"maximum likelihood, {seeds} dives of {duration:g} s: scatter {mean:.3f} of the bound "
        f"(by direction {size.min():.2f} to {size.max():.2f}; chance: 1 ± "
        f"{1.96 / np.sqrt(2 * np.size(errors)):.3f}, by direction ± "
        f"{1.96 / np.sqrt(2 * seeds):.2f})"
    )


def check_output_error(duration: float = 60.0) -> None:
    """Without wrench noise: against the sensitivities of the simulator, by finite differences."""
    suite = dataclasses.replace(Suite(), wrench_std=0.0)
    config, run = draw(0, duration, suite, restoring=False)
    data = experiment(config, run, suite, noisy=False)
    ours = inverse_of(information(config, data)[0])
    model, n = config.model, len(config.model.theta)
    weight = 1.0 / np.sqrt(data.variance[1:, :9])

    def outputs(theta: Array, nu: Array) -> Array:
        motion = simulate(model.with_theta(theta), data.t, data.wrench, nu).nu[1:]
        return (weight * np.hstack([motion, motion[:, 3:]])).ravel()

    start = data.z[0, :6]
    sensitivity = np.empty((weight.size, n + 6))
    for i in range(n + 6):
        step = np.zeros(n + 6)
        step[i] = 1e-4 * abs(model.theta[i]) if i < n else 1e-5
        high = outputs(model.theta + step[:n], start + step[n:])
        low = outputs(model.theta - step[:n], start - step[n:])
        sensitivity[:, i] = (high - low) / (2.0 * step[i])
    total = sensitivity.T @ sensitivity
    total[n:, n:] += np.diag(1.0 / data.variance[0, :6])
    theirs = inverse_of(total)[:n, :n]
    ratio = np.sqrt(np.diag(ours) / np.diag(theirs))
    print(
        "without wrench noise, bound over that of output error: "
        f"{ratio.min():.4f} to {ratio.max():.4f}"
    )


def check_accelerometer(duration: float = 180.0) -> None:
    """What the accelerometer would add."""
    config, run = draw(0, duration, Suite())
    without, with_it = (
        np.sqrt(np.diag(bound(config, run, Suite(), accelerometer))) for accelerometer in (0, 1)
    )
    ratio = dict(zip(config.model.names, (without / with_it).round(2).tolist()))
    print(f"standard deviations without accelerometer over those with it: {ratio}")


def draw(seed: int, duration: float, suite: Suite, restoring: bool = True) -> tuple[Config, Dive]:
    """A vehicle within 25 % of the BlueROV2 Heavy, and a dive of it."""
    config = configuration.load(shipped("config/bluerov2_heavy.yaml"))
    model = config.model
    if not restoring:
        body = dataclasses.replace(model.body, buoyancy=model.body.weight, cob=model.body.cog)
        model = dataclasses.replace(model, body=body)
    factor = np.random.default_rng(seed).uniform(0.75, 1.25, len(model.theta))
    config = config.with_model(model.with_theta(model.theta * factor))
    return config, dive(config, "steps", duration, suite, seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=40)
    options = parser.parse_args()
    check_likelihood(options.seeds)
    check_output_error()
    check_accelerometer()


if __name__ == "__main__":
    main()
