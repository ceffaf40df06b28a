"""Smooths the wrench in a window of the live monitor, to remove the noise of its reading.

Noise n of the reading moves the simulated vehicle only, so it is in what the simulation leaves
unexplained as well as in the sensitivities, and their product, the score, has a bias: a thruster
gain, a dead band or a payload seems to be missing. To first order the residual is::

    r = e - S n,   e the noise of the velocities, n that of the reading, of variances R and Q

The commands, initial velocity and attitude that agree best with reading and motion, in the sense of
least squares, are not correlated with what contradicts them, the residual whitened by R + S Q S'
(Gauss and Markov). So sensitivities along them make scores without bias (the conditional score of
Stefanski and Carroll 1987). What that takes off the reading is - Q S' (R + S Q S')^-1 r.

What looks like noise can be a command that trembles: then the vehicle follows it. The whitened
residuals tell, axis by axis.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.linalg import scaled_solve
from rov_ident.core.messages import Array
from rov_ident.discrepancy.linearisation import Linearisation, MoreNoise, linearise
from rov_ident.discrepancy.reading_noise import jitter
from rov_ident.sampling.wrench_scatter import resting, scatter

_BLOCKS = 180  # of readings, in which their noise is measured: three minutes at 50 Hz
_KEPT = 35.0 / 36.0  # of what is known about trembling, from one window to the next: three minutes
_LEAST_SHARE = 0.1  # of the mean power of one component that noise must make to be looked at: a
# fifth of what a cause must explain to be named (`monitor.SHARE`)


class Reading(NamedTuple):
    """What is known of the noise of the wrench's reading: the ``scatter`` (B, 6) of blocks of
    readings, and normal equations for the share of what looks like noise, on each axis, that the
    vehicle does not follow."""

    scatter: Array = np.zeros((0, 6))
    normal: Array = np.zeros((6, 6))
    moment: Array = np.zeros(6)

    def after(self, demand: Array, relative: float) -> "Reading":
        """With more readings (D, 6), whose noise ``relative`` to the wrench is known of."""
        blocks = np.concatenate([self.scatter, scatter(demand, relative)])
        return self._replace(scatter=blocks[-_BLOCKS:])

    @property
    def std(self) -> Array:
        """Standard deviation (6,) of what looks like noise."""
        return resting(self.scatter)

    @property
    def is_noise(self) -> NDArray[np.bool_]:
        """On which axes (6,) that is noise; taken for commands until the motion tells."""
        share = np.linalg.solve(self.normal + np.eye(6), self.moment)
        return np.asarray(share > 0.5)


class Known(NamedTuple):
    """What earlier windows say of the B estimated parameters: normal equations with a prior."""

    normal: Array  # (B, B)
    moment: Array  # (B,)

    def change(self, linearisation: Linearisation) -> Array:
        """How far (B,) the best values with one more window are from those it is simulated with."""
        linear, values = linearisation.linear, linearisation.hypothesis.values
        gradient, theta = linear.gradient.sum(axis=0), np.array(list(values.values()))
        rest = self.moment - self.normal @ theta
        return scaled_solve(self.normal + linear.normal, gradient + rest, 1e-9)


def matters(plain: Linearisation) -> bool:
    """Whether noise of the reading makes anything near what a cause must explain to be named."""
    problem = plain.problem
    if not problem.reading_std.any():
        return False
    made = plain.sensitivity_to(problem.noisy_thrust(plain.hypothesis.effects))
    return bool(np.sum(made**2, axis=0).mean() > _LEAST_SHARE * len(made) / 6.0)


class Smoothed(NamedTuple):
    """A single window, whitened: along the motion as read, along that with the wrench smoothed, and
    along one as likely, of a draw of what smoothing leaves open."""

    as_read: Linearisation
    smooth: Linearisation
    drawn: Linearisation


def smoothed(
    plain: Linearisation, reading: Reading, known: Known
) -> tuple[Smoothed | None, Reading]:
    """The window ``plain`` smoothed, None where nothing is noise or where it diverges, and what is
    known of the reading then."""
    problem, h = plain.problem, plain.hypothesis
    response = problem.response(h.effects)
    looks = _thrust(response, jitter(problem.streams.demand, problem.reading_std, problem.lasts))
    as_read, white = _whitened(plain, response, problem.reading_std)
    trembling = np.concatenate([_along(i, looks[:, [i]]) for i in range(6)], axis=2)
    columns = white.sensitivity_to(trembling)
    weight = 1.0 / max(white.rss / len(white.error), 1.0)  # where more than noise is left, less
    reading = reading._replace(
        normal=_KEPT * reading.normal + weight * columns.T @ columns,
        moment=_KEPT * reading.moment - weight * columns.T @ white.error,
    )
    std = np.where(reading.is_noise, problem.reading_std, 0.0)
    if not std.any():
        return None, reading
    if (std != problem.reading_std).any():
        as_read, white = _whitened(plain, response, std)

    def noise_in(error: Array) -> Array:
        """The noise (D, 6) of the reading that whitened residuals tell."""
        pushed = white.pushed_by(white.over_variance(error)[0])
        told: Array = -np.einsum("kid,ki->di", response, pushed) * std**2
        return told

    change, rng = known.change(white), np.random.default_rng(0)
    noise = noise_in(white.error - white.columns @ change)
    draw = rng.standard_normal(noise.shape) * std
    seen = as_read.whitening @ rng.standard_normal(len(white.error))
    seen -= white.unprojected(_thrust(response, draw)[:, :, None])[:, 0]
    starts, found = white.starts_after(change), []
    for taken in (noise, noise + draw - noise_in(seen)):
        more = as_read._replace(taken=_thrust(response, taken))
        found.append(linearise(problem.with_less(taken), h, starts, plain.noise, more))
    smooth, drawn = found
    if smooth is None or drawn is None:
        return None, reading
    return Smoothed(white, smooth, drawn), reading


def _whitened(plain: Linearisation, response: Array, std: Array) -> tuple[MoreNoise, Linearisation]:
    """The window ``plain`` whitened, where the readings have noise of standard deviations (6,)."""
    problem, h, motion = plain.problem, plain.hypothesis, plain.motion
    roots = [_along(i, std[i] * _root(response[:, i])) for i in range(6) if std[i] > 0.0]
    force = np.concatenate([np.zeros((*motion.middle.shape, 0)), *roots], axis=2)
    more = MoreNoise(_whitening(plain.unprojected(force)), np.zeros_like(motion.middle))
    return more, Linearisation(problem, h, plain.starts, plain.noise, motion, more)


def _thrust(response: Array, readings: Array) -> Array:
    """Mean thrust (K, 6) of readings (D, 6)."""
    return np.einsum("kid,di->ki", response, readings)


def _whitening(root: Array) -> Array:
    """What whitens noise of the covariance I + root root' (R, R)."""
    from scipy.linalg.lapack import dtrtri  # here: it takes its time to import

    factor = np.linalg.cholesky(np.eye(len(root)) + root @ root.T)
    out: Array = np.tril(dtrtri(factor, lower=1)[0])
    return out


def _root(response: Array) -> Array:
    """A root (K, C) of the covariance of the means over steps, where each reading has noise of unit
    variance and the ``response`` (K, D); C is the less of K and D."""
    root: Array = np.asarray(np.linalg.qr(response.T, mode="r")).T
    return root


def _along(axis: int, force: Array) -> Array:
    """Wrenches (K, 6, C) along an axis."""
    out = np.zeros((len(force), 6, force.shape[1]))
    out[:, axis] = force
    return out
