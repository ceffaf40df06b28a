"""filterpy's unscented Kalman filter on the same model and samples, to check ours against.

filterpy (R. Labbe) is the textbook's filter in plain Python. It is given the equations of
`rov_ident.model`, the noise of our filter, and what that decides sample by sample: which
measurements are outliers, which coefficients the motion does not show, how much process noise there
is. Both must then give the same numbers; ours is some three hundred times as fast.
"""

from typing import Any

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.messages import Array
from rov_ident.core.progress import Progress, silent
from rov_ident.core.runge_kutta import NODES, WEIGHTS
from rov_ident.estimation import ukf
from rov_ident.estimation.shared import RELEARNING_TIME, Problem, excited, steps_of
from rov_ident.model.equations import force_of_one


class ReferenceUkf:
    """filterpy's filter, begun at a state of ours."""

    def __init__(self, config: Config, task: Problem, state: ukf.State) -> None:
        self.config, self.task = config, task
        self.model, n, u = config.dynamics, len(task.scale), config.ukf
        points = MerweScaledSigmaPoints(6 + n, u.alpha, u.beta, u.kappa)
        self.filter = UnscentedKalmanFilter(6 + n, 6, 1.0, None, self._propagated, points)
        self.filter.x, self.filter.P = state.x.copy(), state.p.copy()
        self._since = self._since_walk = 0.0  # s

    def step(self, row: np.void, before: ukf.State, after: ukf.State, info: np.void) -> None:
        """One sample of SAMPLE, as ours took it from ``before`` to ``after``; ``info`` of INFO."""
        self._row = row
        if info["reason"] == ukf.RESTARTED:
            self._restart()
            return
        x, p = self.filter.x, self.filter.P
        free = self._free = np.isfinite(row["wrench_doubt"])
        self._guide = np.where(free, 0.0, (row["nu"] - x[:6]) / row["dt"])
        guided = np.flatnonzero(~free)
        p[guided] = p[:, guided] = 0.0
        p[guided, guided] = ukf.KNOWN
        self.filter.Q = self._noise(before.monitor["density"])
        self.filter.predict(dt=row["dt"])
        z, r = row["odometry"].copy(), row["odometry_variance"].copy()
        if np.isfinite(row["gyro"]).all():
            z[3:], r[3:] = row["gyro"], row["gyro_variance"]
        z[guided] = np.nan
        gate = self.config.ukf.gate**2
        for part in (slice(0, 3), slice(3, 6)):
            if not np.isfinite(z[part] + r[part]).all() or info["nis"][part].max() > gate:
                z[part] = np.nan
        self._update(z, r, before.monitor)
        if not after.p[:6, 6:].any():  # after outliers in a row
            self._restart()
        self._walk(after)

    def acceleration(self, theta: Array, nu: Array, tau: Array, down: Array) -> Array:
        """nu_dot (6,) with the coefficients theta (m,), under the wrench tau."""
        mass = self.model.with_theta(theta).mass_matrix
        mass = mass + raised(mass, self.task.lightest)
        force = force_of_one(self.model.structure, mass, theta, nu, self._row["inputs"][0])
        left = tau - force - self.model.restoring_force(down) - mass @ self._guide
        nu_dot, free = self._guide.copy(), self._free
        nu_dot[free] = np.linalg.solve(mass[np.ix_(free, free)], left[free])
        return nu_dot

    def _restart(self) -> None:
        """Begin from the measured velocity; the coefficients stay."""
        row, x, p = self._row, self.filter.x, self.filter.P
        x[:6], p[:6], p[:, :6] = row["nu"], 0.0, 0.0
        p[:6, :6] = np.diag(np.minimum(row["odometry_variance"], 1.0))

    def _theta(self, xi: Array) -> Array:
        theta = self.task.theta.copy()
        theta[self.task.estimated] = self.task.scale * xi
        return theta

    def _propagated(self, x: Array, dt: float) -> Array:
        """One sigma point by classical Runge-Kutta steps; wrench and "down" are lines in time."""
        row, theta, nu = self._row, self._theta(x[6:]), x[:6]
        middle = row["down"] - 0.5 * row["dt"] * row["down_slope"]
        steps = steps_of(dt)
        h = dt / steps
        for k in range(steps):
            slope, total = np.zeros(6), np.zeros(6)
            for node, weight in zip(NODES, WEIGHTS, strict=True):
                late = (k + node) * h - 0.5 * dt
                tau = row["wrench"] + late * row["wrench_slope"]
                down = middle + late * row["down_slope"]
                slope = self.acceleration(theta, nu + node * h * slope, tau, down)
                total += weight * slope
            nu = nu + h * total
        return np.concatenate([nu, x[6:]])

    def _inverse_mass(self) -> Array:
        """(6, 6), at the estimate; zeros where forces move nothing."""
        mass = self.model.with_theta(self._theta(self.filter.x[6:])).mass_matrix
        mass, inverse = mass + raised(mass, self.task.lightest), np.zeros((6, 6))
        free = np.ix_(self._free, self._free)
        inverse[free] = np.linalg.inv(mass[free])
        return inverse

    def _noise(self, density: Array) -> Array:
        """Q (6 + n, 6 + n) of the unknown forces, and ``density`` (6,) of unknown acceleration."""
        wrench, row = self.config.wrench, self._row
        inverse = self._inverse_mass()
        strength = (wrench.relative_std * row["wrench"]) ** 2 + np.square(wrench.floor_std)
        lasting = max(wrench.correlation_time, row["hold"])
        strength = lasting * (strength + np.where(self._free, row["wrench_doubt"], 0.0))
        turned = np.cross(self.model.body.restoring, row["down"])
        strength += row["tilt"] * np.square(turned).sum(axis=1)
        forces = (inverse * strength) @ inverse.T
        q = np.zeros_like(self.filter.P)
        q[:6, :6] = (forces + np.diag(density * self._free)) * row["dt"]
        return q

    def _update(self, z: Array, r: Array, monitor: NDArray[np.void]) -> None:
        """Take in what is measured (not NaN) of z (6,), with variances r (6,).

        ``monitor`` (6,) of MONITOR is that of ours.
        """
        row = self._row
        measured = np.flatnonzero(np.isfinite(z))
        if not len(measured):
            return
        x, p = self.filter.x.copy(), self.filter.P.copy()
        self.filter._dim_z = len(measured)
        self.filter.update(z[measured], R=np.diag(r[measured]), hx=lambda x: x[measured])
        # What does not show in the motion is only considered (Schmidt 1966).
        moves, noisy = np.ones(len(self.task.theta), dtype=bool), np.zeros(6, dtype=bool)
        excited(self.task, row["moving"], row, monitor, self._inverse_mass(), noisy, moves)
        held = 6 + np.flatnonzero(~moves[self.task.estimated])
        self.filter.x[held] = x[held]
        self.filter.P[np.ix_(held, held)] = p[np.ix_(held, held)]

    def _walk(self, after: ukf.State) -> None:
        """The random walk of the coefficients, at the instants of ours."""
        self._since += self._row["dt"]
        self._since_walk += self._row["dt"]
        if after.scalars["since"][0] > 0.0:
            return
        usual = np.maximum(after.monitor["usual"], 1.0)
        changed = (after.monitor["nis"] > self.task.settings["changed"][0] * usual).any()
        relearnt = min(self._since / RELEARNING_TIME, 1.0) if changed else 0.0
        self._since = 0.0
        if after.scalars["since_walk"][0] == 0.0:
            share = np.maximum(self.task.drift * self._since_walk, relearnt)
            room = np.maximum(1.0 - np.diag(self.filter.P)[6:], 0.0)
            self.filter.P[6:, 6:][np.diag_indices(len(share))] += share * room
            self._since_walk = 0.0


def raised(mass: Array, least: Array) -> Array:
    """Diagonal (6, 6) by which the pivots of a mass matrix become at least ``least`` (6,).

    As in a modified Cholesky factorisation: pivot by pivot, each after the ones before it.
    """
    left, added = mass.copy(), np.zeros((6, 6))
    for i in range(6):
        added[i, i] = max(least[i] - left[i, i], 0.0)
        left[i, i] += added[i, i]
        left[i + 1 :, i + 1 :] -= np.outer(left[i + 1 :, i], left[i, i + 1 :]) / left[i, i]
    return added


def compare(config: Config, samples: NDArray[np.void], say: Progress = silent) -> dict[str, Any]:
    """Both filters over samples (k,) of SAMPLE, as JSON has it; effects' parameters are held.

    Standard deviations are those of the filters, without what coloured residuals add. A
    sample takes filterpy some milliseconds.
    """
    config = config.with_effects_held
    task = ukf.problem(config)
    state = ukf.init(task)
    reference = ReferenceUkf(config, task, state)
    for k in range(len(samples)):
        before = state
        state, info = ukf.step(task, before, samples[k : k + 1])
        reference.step(samples[k], before, state, info[0])
        if k % 20 == 0:
            say("filterpy's filter", k / len(samples))
    columns = {
        "value": task.scale * state.x[6:],
        "std": task.scale * np.sqrt(np.diag(state.p)[6:]),
        "reference_value": task.scale * reference.filter.x[6:],
        "reference_std": task.scale * np.sqrt(np.diag(reference.filter.P)[6:]),
    }
    apart = columns["value"] - columns["reference_value"]
    columns["apart_in_std"] = apart / columns["reference_std"]
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return {
        "filter": "filterpy.kalman.UnscentedKalmanFilter",
        "samples": len(samples),
        "duration_s": float(samples["t"][-1] - samples["t"][0]) if len(samples) else 0.0,
        "coefficients": {
            config.dynamics.names[i]: dict(zip(columns, row, strict=True))
            for i, row in zip(task.estimated, rows, strict=True)
        },
    }
