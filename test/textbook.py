"""Textbook forms of what the library does faster, and truth to compare with: for tests only.

Nothing here uses the library's kernels: dynamics from matrices, filters from scipy, batch least
squares, quadratic programs by trying every active set.
"""

import dataclasses
import itertools

import numpy as np
from scipy.signal import cont2discrete

from rov_ident import sensors
from rov_ident.frames import quaternion_to_matrix
from rov_ident.model import skew
from rov_ident.samples import SAMPLE
from rov_ident.simulate import simulate

# ------------------------------------------------------------------ configurations


def off(config, factors):
    """The configuration with its coefficients (the prior) multiplied: the truth is elsewhere."""
    return config.with_model(config.model.with_theta(config.model.theta * factors))


def with_section(config, section, **values):
    return dataclasses.replace(
        config, **{section: dataclasses.replace(getattr(config, section), **values)}
    )


def read_only(parts):
    """The same arrays; whoever writes into them raises."""
    for part in parts:
        if isinstance(part, np.ndarray):
            part.setflags(write=False)
    return parts


def arrays(parts):
    """Copies of all arrays in a tuple, inner tuples included, records field by field."""
    out = []
    for part in parts:
        if isinstance(part, tuple):
            out += arrays(part)
        elif part.dtype.names:
            out += [part[name].copy() for name in part.dtype.names]
        else:
            out.append(part.copy())
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


# ------------------------------------------------------------------ filtered regression


def filtered(inputs, jumps, corner, dt):
    """Two sections w/(s + w) in series, of ``d/dt(jumps) + inputs``; all (N, ...), dt uniform.

    As one state-space system for each section, discretised by scipy for an input that is linear
    between samples; the derivative is integrated by parts: s w/(s + w) = w - w^2/(s + w).
    """
    w = corner
    system = (np.array([[-w]]), np.array([[w]]), np.array([[1.0]]), np.array([[0.0]]))
    a, b, c, d = (m[0, 0] for m in cont2discrete(system, dt, method="foh")[:4])

    def section(u, state):
        # scipy's form has its state at the sample without direct term: y = c x + d u
        out, x = np.empty_like(u), (state - d * u[0]) / c
        for k in range(len(u)):
            out[k] = c * x + d * u[k]
            x = a * x + b * u[k]
        return out

    # the first section begins with its memory of the momentum full: no transient
    first = section(inputs - w * jumps, -w * jumps[0]) + w * jumps
    return section(first, np.zeros_like(first[0]))


def regression(model, rows, corner):
    """Rows Phi (N, 6, m) and y (N, 6) of ``y = Phi theta`` for samples with uniform dt."""
    m, dt = len(model.theta), rows["dt"][1]
    phi = np.empty((len(rows), 6, m))
    none = model.with_theta(np.zeros(m))
    known_force, known_momentum = np.empty((2, len(rows), 6))
    zero = np.zeros(6)
    for k, row in enumerate(rows):
        nu = row["nu"]
        known_momentum[k] = model.body.mass_matrix @ nu
        known_force[k] = none.wrench(nu, zero, row["down"])
    for j in range(m):
        unit = model.with_theta(np.eye(m)[j])
        added = unit.mass_matrix - model.body.mass_matrix
        force = np.array([unit.wrench(r["nu"], zero, r["down"]) for r in rows]) - known_force
        phi[:, :, j] = filtered(force, rows["nu"] @ added.T, corner, dt)
    y = -filtered(known_force, known_momentum, corner, dt)
    # the wrench: a line of its own in every interval, so begin and end differ
    begin = rows["wrench"] - 0.5 * dt * rows["wrench_slope"]
    end = rows["wrench"] + 0.5 * dt * rows["wrench_slope"]
    system = (np.array([[-corner]]), np.array([[corner]]), np.array([[1.0]]), np.array([[0.0]]))
    stage = np.zeros((len(rows), 6))
    for k in range(1, len(rows)):
        stage[k] = _line(system, stage[k - 1], begin[k], end[k], dt)
    total = np.zeros((len(rows), 6))
    for k in range(1, len(rows)):
        total[k] = _line(system, total[k - 1], stage[k - 1], stage[k], dt)
    return phi, y + total


def _line(system, x, begin, end, dt):
    """The section's state after an input that goes in a line from begin to end."""
    w = system[1][0, 0]
    slope = (end - begin) / dt
    # particular solution begin + slope (t - 1/w), and the rest decays
    return begin + slope * (dt - 1.0 / w) + (x - begin + slope / w) * np.exp(-w * dt)


def least_squares(phi, y, weights, mean, std):
    """Coefficients (n,) and R'R (n, n) in prior units; phi (k, 6, n), y (k, 6), weights (k, 6)."""
    root = np.sqrt(weights)
    a = np.vstack([np.eye(len(mean)), (phi * root[:, :, None]).reshape(-1, len(mean)) * std])
    b = np.concatenate([np.zeros(len(mean)), ((y - phi @ mean) * root).ravel()])
    return mean + std * np.linalg.lstsq(a, b, rcond=None)[0], a.T @ a


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
        parts = list(sensors.samples_of(config, run))
        rng = np.random.default_rng(1000 + seed)
        factors = np.clip(1.0 + 0.2 * rng.standard_normal(len(config.model.theta)), 0.4, 1.6)
        out.append((off(config, factors), np.concatenate(parts)))
    return out
