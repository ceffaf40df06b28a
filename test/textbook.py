"""Textbook forms of what the library does faster, and truth to compare with: for tests only.

Nothing here uses the library's kernels: dynamics from matrices, filters from scipy, batch least
squares, quadratic programs by trying every active set.
"""

import dataclasses
import itertools

import numpy as np

from rov_ident import config as configuration
from rov_ident.core.frames import quaternion_to_matrix
from rov_ident.model.coefficients import INPUTS
from rov_ident.model.equations import skew
from rov_ident.sampling import records
from rov_ident.sampling.sample import SAMPLE
from rov_ident.sampling.sample import joined as one_array
from rov_ident.simulation import virtual_sensors as sensors
from rov_ident.simulation.manoeuvres import manoeuvre
from rov_ident.simulation.open_loop import simulate

# ------------------------------------------------------------------ configurations


def off(config, factors):
    """The configuration with its coefficients (the prior) multiplied: the truth is elsewhere."""
    return config.with_model(config.model.with_theta(config.model.theta * factors))


def with_section(config, section, **values):
    return dataclasses.replace(
        config, **{section: dataclasses.replace(getattr(config, section), **values)}
    )


def finned(config):
    """The vehicle with stern planes, rudder and ailerons, whose joints are heard."""
    plain = configuration.to_parameters(config)
    plain.pop("estimate", None)
    plain["coefficients"] |= {"Y_uudr": 40.0, "N_uudr": -15.0, "Z_uuds": -40.0, "M_uuds": -15.0}
    plain["coefficients"] |= {"K_uuda": 8.0}
    plain["inputs"] = {name: {"joint": name} for name in INPUTS[:3]}
    return configuration.from_parameters(plain)


def steered_dive(config, duration, suite, seed):
    """A dive in steps, the fins that there are swinging by 0.3 rad at 0.4 to 0.6 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, 1.0 / suite.wrench_rate)
    demand = manoeuvre("steps", config.dynamics, t, rng)
    there = [name in config.inputs.joints for name in INPUTS]
    swings = 0.3 * np.sin(2.0 * np.pi * np.outer(t, [0.5, 0.4, 0.6, 0.0]))
    return sensors.measure(config, t, demand, duration, suite, rng, swings * there)


def read_only(parts):
    """The same arrays; whoever writes into them raises."""
    for part in parts:
        if isinstance(part, np.ndarray):
            part.setflags(write=False)
    return parts


def arrays(parts):
    """Copies of all arrays and numbers in a tuple, also in inner ones, records field by field."""
    out = []
    for part in parts:
        if isinstance(part, tuple):
            out += arrays(part)
        elif (array := np.array(part)).dtype.names:
            out += [array[name].copy() for name in array.dtype.names]
        else:
            out.append(array)
    return out


# ------------------------------------------------------------------ samples without the sampler


def drive(model, t, wrench, nu=None, orientation=None):
    """The motion (see ``simulate``) under a wrench (N, 6) held from each instant to the next."""
    return simulate(model, t, wrench, nu, None, orientation)


def rows_of(
    motion, wrench, rng=None, linear_std=0.008, angular_std=0.003, wrench_std=0.0, gyro=True
):
    """Samples (N,) of a motion at its own instants; without ``rng`` free of noise."""
    rows = np.zeros(len(motion.t), dtype=SAMPLE)
    rows["t"], rows["dt"][1:] = motion.t - motion.t[0], np.diff(motion.t)
    rows["restart"][0] = True
    rows["measured"] = True
    std = np.repeat([linear_std, angular_std], 3)
    noise = np.zeros((2, len(rows), 6)) if rng is None else rng.standard_normal((2, len(rows), 6))
    rows["nu"] = motion.nu + std * noise[0]
    rows["odometry"] = rows["nu"]
    rows["odometry_variance"] = std**2
    rows["moving"] = np.sqrt(np.mean(motion.nu**2, axis=0)) > 4.0 * std
    rows["gyro"] = np.nan
    if gyro:
        rows["odometry"][:, 3:] = np.nan
        rows["gyro"] = rows["nu"][:, 3:]
        rows["gyro_variance"] = angular_std**2
    rows["orientation"] = motion.orientation
    rows["down"] = quaternion_to_matrix(motion.orientation)[:, 2]
    rows["down_slope"][1:] = np.diff(rows["down"], axis=0) / rows["dt"][1:, None]
    rows["wrench"][1:] = wrench[:-1] * (1.0 + wrench_std * noise[1, 1:])
    rows["wrench"][0] = wrench[0]
    return rows


def joined(first, second):
    """Two runs of samples, the second going on one interval after the first without a gap."""
    second = second.copy()
    dt = first["dt"][-1]
    second["t"] += first["t"][-1] + dt
    second["dt"][0], second["restart"][0] = dt, False
    return np.concatenate([first, second])


def resting(count, dt, rng=None, linear_std=0.008, angular_std=0.003):
    """Samples (count,) of a vehicle that lies still and level on the bottom, trimmed neutral."""
    rows = np.zeros(count, dtype=SAMPLE)
    rows["t"], rows["dt"] = dt * np.arange(count), dt
    rows["dt"][0], rows["restart"][0] = 0.0, True
    rows["measured"] = True
    std = np.repeat([linear_std, angular_std], 3)
    rows["nu"] = 0.0 if rng is None else std * rng.standard_normal((count, 6))
    rows["odometry"] = rows["nu"]
    rows["odometry"][:, 3:] = np.nan
    rows["odometry_variance"] = std**2
    rows["gyro"], rows["gyro_variance"] = rows["nu"][:, 3:], angular_std**2
    rows["orientation"], rows["down"] = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0]
    return rows


def held_at_rest(model, rows):
    """The same rows under the wrench that keeps the vehicle where it is."""
    rows = rows.copy()
    rows["wrench"] = model.restoring_force(np.array([0.0, 0.0, 1.0]))
    return rows


# ------------------------------------------------------------------ the equations of motion


def ballast(mass, rigid_body, least=0.2):
    """Diagonal (6, 6) that raises the pivots of a mass matrix to a share of the rigid body's.

    As in a modified Cholesky factorisation: pivot by pivot, each after the ones before it.
    """
    mass, body, added = mass.copy(), rigid_body.copy(), np.zeros((6, 6))
    for i in range(6):
        added[i, i] = max(least * body[i, i] - mass[i, i], 0.0)
        mass[i, i] += added[i, i]
        for m in (mass, body):
            m[i + 1 :, i + 1 :] -= np.outer(m[i + 1 :, i], m[i, i + 1 :]) / m[i, i]
    return added


def acceleration(body, coefficients, theta, nu, tau, down, ballast=0.0):
    """nu_dot (6,) by the book: M, C(nu) from M (Fossen 2021, eq. 3.46), d term by term, g."""
    mass = body.mass_matrix + ballast
    d = np.zeros(6)
    for c, value in zip(coefficients, theta, strict=True):
        if c.is_added_mass:
            mass[c.row, c.column] -= value
            if c.row != c.column:
                mass[c.column, c.row] -= value
        else:
            factors = [1.0, *nu, *np.abs(nu)]
            d[c.row] += value * factors[c.left] * factors[c.right]
    p = mass @ nu
    c_nu = np.concatenate(
        [np.cross(nu[3:], p[:3]), np.cross(nu[3:], p[3:]) + np.cross(nu[:3], p[:3])]
    )
    up = skew(body.weight * body.cog - body.buoyancy * body.cob) @ down
    g = -np.concatenate([(body.weight - body.buoyancy) * down, up])
    return np.linalg.solve(mass, tau - c_nu + d - g)


def runge_kutta(f, t, x, dt):
    """One classical step of x' = f(t, x)."""
    a = f(t, x)
    b = f(t + 0.5 * dt, x + 0.5 * dt * a)
    c = f(t + 0.5 * dt, x + 0.5 * dt * b)
    d = f(t + dt, x + dt * c)
    return x + dt / 6.0 * (a + 2.0 * b + 2.0 * c + d)


# ------------------------------------------------------------------ observer


def innovations(config, theta, rows, densities, gains=None):
    """Innovations (k,), their variances (k,) and gains of an extended Kalman filter of nu.

    Linear velocities and gyro are taken one after the other where they are measured; ``densities``
    holds, for each row, that (6,) of the process noise. Given ``gains``, the covariance is not
    needed, and these are used.
    """
    model, wrench = config.model, config.wrench
    nu, p = rows[0]["nu"].copy(), np.diag(rows[0]["odometry_variance"])
    inverse = np.linalg.inv(model.with_theta(theta).mass_matrix)
    e, s, used = [], [], []
    for row, density in zip(rows[1:], densities[1:], strict=True):
        dt = row["dt"]

        def rate(t, nu, row=row, dt=dt):
            tau = row["wrench"] + (t - 0.5 * dt) * row["wrench_slope"]
            down = row["down"] + (t - dt) * row["down_slope"]
            return acceleration(model.body, model.coefficients, theta, nu, tau, down)

        start = nu
        nu = runge_kutta(rate, 0.0, start, dt)
        if gains is None:
            transition = np.empty((6, 6))
            for i in range(6):
                shift = 1e-6 * np.eye(6)[i]
                there, back = (runge_kutta(rate, 0.0, start + f * shift, dt) for f in (1, -1))
                transition[:, i] = (there - back) / 2e-6
            strength = (wrench.relative_std * row["wrench"]) ** 2 + np.square(wrench.floor_std)
            strength *= wrench.correlation_time
            for axis in np.eye(3):  # the vehicle a little turned, and weight in its axes with it
                turned = model.body.restoring @ np.cross(row["down"], axis)
                strength += row["tilt"] * np.square(turned)
            noise = inverse @ np.diag(strength) @ inverse.T + np.diag(density)
            p = transition @ p @ transition.T + dt * noise
        for i in range(6):
            z = row["odometry"][i] if i < 3 else row["gyro"][i - 3]
            if np.isnan(z):
                continue
            if gains is None:
                r = row["odometry_variance"][i] if i < 3 else row["gyro_variance"]
                total = p[i, i] + r
                gain = p[:, i] / total
                p = p - np.outer(gain, p[i])
            else:
                total, gain = 1.0, gains[len(e)]
            e.append(z - nu[i])
            s.append(total)
            used.append(gain)
            nu = nu + gain * e[-1]
    return np.array(e), np.array(s), used


# ------------------------------------------------------------------ projection


def nearest_not_positive(values, covariance, negative):
    """The minimum (n,) of (x - values)' P^-1 (x - values) with x <= 0 where ``negative``.

    By trying every set of variables held at zero: a strictly convex problem has just one that
    fulfils Karush, Kuhn and Tucker.
    """
    information = np.linalg.inv(covariance)
    places = np.flatnonzero(negative)
    best, least = values, np.inf
    for count in range(len(places) + 1):
        for held in itertools.combinations(places, count):
            held = list(held)
            x = values.copy()
            if held:
                gain = np.linalg.solve(covariance[np.ix_(held, held)], values[held])
                x = values - covariance[:, held] @ gain
                x[held] = 0.0
            cost = (x - values) @ information @ (x - values)
            if (x[places] <= 1e-12).all() and cost < least:
                best, least = x, cost
    return best


def random_covariance(n, rng):
    a = rng.standard_normal((n, n + 1))
    scale = np.exp(rng.uniform(-2.0, 2.0, n))
    return (a @ a.T) * np.outer(scale, scale)


# ------------------------------------------------------------------ many dives


_dives = {}


def prior_and_samples(config, seeds, duration):
    """[(configuration with the prior off by some 20 %, samples of a noisy dive)], one a seed.

    Made once for all tests: the simulation of the messages takes most of the time.
    """
    key = (config.name, tuple(seeds), duration)
    out = _dives.setdefault(key, [])
    if out:
        return out
    for seed in seeds:
        run = sensors.dive(config, "steps", duration, seed=seed)
        parts = list(records.samples_of(config, run))
        rng = np.random.default_rng(1000 + seed)
        factors = np.clip(1.0 + 0.2 * rng.standard_normal(len(config.model.theta)), 0.4, 1.6)
        out.append((off(config, factors), one_array(parts)))
    return out


def attenuation(model, relative_std):
    """The most by which errors in variables can move each coefficient (n,).

    The noise of a wrench is in the acceleration that a mass is learnt from, and in its error. Where
    each message counts for itself, that takes the square of the relative noise off what one newton
    is seen to move: the whole inertia comes out larger by as much (Fuller 1987, sec. 1.1). Where
    many messages of one sign add up, as in the slow axes, it takes less.
    """
    inertia = np.diag(model.mass_matrix)
    sizes = [
        inertia[c.row] if c.is_added_mass else abs(value)
        for c, value in zip(model.coefficients, model.theta, strict=True)
    ]
    return relative_std**2 * np.array(sizes)
