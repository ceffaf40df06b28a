"""Nomoto's model by an unscented Kalman filter whose state holds the parameters, too."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array
from rov_ident.steering.nomoto_model import STEP, Nomoto, Structure, model_of, simulate_heading
from rov_ident.steering.zigzag import Zigzag


def heading_noise(headings: Sequence[Array]) -> float:
    """Standard deviation [rad] of white noise on even headings, from their third differences."""
    third = np.concatenate([np.diff(heading, 3) for heading in headings])
    return max(float(np.sqrt(np.mean(third**2) / 20.0)), 1e-6)  # 1 + 9 + 9 + 1


class Filter:
    """State ``[psi, x1 (, x2), theta / sizes]`` of a model, from sample to sample.

    ``sizes`` (n,) are about as large as theta; ``rate`` [rad/s] is the size of a yaw rate,
    ``heading_noise`` [rad] of white noise on the heading and ``drive`` [rad/s^1.5] of white noise
    on the yaw acceleration: what the model's structure lacks.
    """

    def __init__(
        self, structure: Structure, theta: Array, sizes: Array, rate: float, heading_noise: float,
        drive: float,
    ) -> None:  # fmt: skip
        self.structure, self.states, self.sizes = structure, structure.order + 1, sizes
        self.rate, self.r, self.q = rate, heading_noise**2, drive**2
        self.x = np.concatenate([np.zeros(self.states), theta / sizes])
        self.p = np.eye(len(self.x))
        self.cost = 0.0  # minus twice the log likelihood

    def begin(self, heading: float) -> None:
        """A new run: the motion is unknown again, the parameters are kept."""
        n = self.states
        self.x[:n] = 0.0
        self.x[0] = heading
        self.p[:n, :] = self.p[:, :n] = 0.0
        self.p[range(n), range(n)] = [self.r, *[self.rate**2] * self.structure.order]

    def predict(self, t: Array, rudder: Array, held: bool) -> None:
        """From the first to the last t (k,) [s], rudder (k,) [rad] as in :class:`Zigzag`."""
        n = len(self.x)
        spread = np.sqrt(n) * np.linalg.cholesky(self.p + 1e-14 * np.eye(n)).T
        points = self.x + np.vstack([spread, -spread])
        out, state = np.empty(len(t)), np.zeros(3)
        for point in points:
            numbers = self.structure.numbers(point[self.states :] * self.sizes)
            state[:] = 0.0
            state[: self.states] = point[: self.states]
            simulate_heading(self.structure.order, *numbers, t, rudder, held, state, STEP, out)
            point[: self.states] = state[: self.states]
        self.x = points.mean(axis=0)
        off = points - self.x
        self.p = off.T @ off / len(points)
        self.p[1, 1] += self.q * (t[-1] - t[0])

    def correct(self, heading: float) -> None:
        """A measured heading [rad]."""
        total = self.p[0, 0] + self.r
        error, gain = heading - self.x[0], self.p[:, 0] / total
        self.x = self.x + gain * error
        self.p -= np.outer(gain, self.p[0])
        self.p = 0.5 * (self.p + self.p.T)
        self.cost += error**2 / total + np.log(total)


def unscented(runs: Sequence[Zigzag], model: Nomoto) -> Nomoto:
    """The parameters after all runs, one after the other, each as wide before them as it is large.

    The prior mean is half of the fitted model, so that the filter has to find its way. The noise of
    the heading is that of its third differences; the noise that drives the yaw rate, which stands
    for what the structure lacks, is found by maximum likelihood.

    Raises UserError if the filter diverges.
    """
    from scipy.optimize import minimize_scalar  # here: a node does not need it

    sizes = np.maximum(np.abs(model.theta), 1e-9)
    sizes[-1] = 0.1 * max(float(np.std(run.rudder)) for run in runs)
    rate = max(float(np.std(np.diff(r.heading[r.known]) / np.diff(r.t[r.known]))) for r in runs)
    noise = heading_noise([run.heading[run.known] for run in runs])

    def filtered(log_drive: float) -> Filter:
        drive = rate * np.exp(log_drive)
        f = Filter(model.structure, 0.5 * model.theta, sizes, rate, noise, drive)
        for run in runs:
            first = int(np.flatnonzero(run.known)[0])
            f.begin(run.heading[first])
            for i in range(first, len(run.t) - 1):
                f.predict(run.t[i : i + 2], run.rudder[i : i + 2], run.held)
                if run.known[i + 1]:
                    f.correct(run.heading[i + 1])
        return f

    def cost(log_drive: float) -> float:
        try:
            found = filtered(log_drive).cost
        except np.linalg.LinAlgError:
            return 1e300
        return found if np.isfinite(found) else 1e300

    best = minimize_scalar(cost, bounds=(-10.0, 1.0), method="bounded", options={"maxiter": 12})
    if not best.fun < 1e300:
        raise UserError("the Kalman filter diverges: use `--method oe`")
    f = filtered(best.x)
    n = f.states
    covariance = f.p[n:, n:] * np.outer(sizes, sizes)
    theta = f.x[n:] * sizes
    found = model_of(model.structure, "ukf", theta, covariance, model.unit, model.rmse)
    return dataclasses.replace(found, cross_validation=model.cross_validation)
