"""The error of open-loop simulation over an archive, and what a fit's uncertainty makes of it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.linalg import interpolated
from rov_ident.core.messages import Array
from rov_ident.core.states import State
from rov_ident.effects import EFFECTS, Acting, compiled
from rov_ident.model.equations import Model
from rov_ident.offline.archive import Archive, ReadBag, Samples
from rov_ident.sampling.records import HORIZON, measured_motion, predicted
from rov_ident.sampling.sample import free_axes

_POINTS = 1500  # of a curve in a picture
_DRAWS = 8  # the RMS over them is known to 25 %
_STEP = 0.1  # standard deviations: small enough to be linear, and to stay physical


class OpenLoop(NamedTuple):
    """The open-loop simulation of an archive in windows of HORIZON seconds: its RMSE (6,), and of
    each bag t (k,), the measured and the simulated velocities (k, 6), thinned for a picture."""

    rmse: Array
    drawn: tuple[tuple[Array, Array, Array], ...]


class Curves(NamedTuple):
    """Measured and simulated velocities (k, 6) of a bag, thinned for a picture."""

    name: str
    t: Array
    measured: Array
    before: Array
    after: Array


def open_loop(archive: Archive, config: Config, free: NDArray[np.bool_] | None = None) -> OpenLoop:
    """All bags of an archive, which ``config`` has read; components not ``free`` (6,) follow the
    measurement."""
    parts = archive.each(_simulated, config.dynamics, compiled(config.effects), free)
    squares, counts, drawn = zip(*parts)
    with np.errstate(invalid="ignore", divide="ignore"):
        return OpenLoop(np.sqrt(sum(squares) / sum(counts)), drawn)


def _simulated(
    samples: Samples, model: Model, effects: Acting, free: NDArray[np.bool_] | None
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Of a bag the sums (6,) of squared errors, over so many samples (6,), and what is drawn."""
    motion, simulated = measured_motion(samples), predicted(model, samples, HORIZON, free, effects)
    told, keep = samples["measured"], slice(None, None, max(1, len(samples) // _POINTS))
    with np.errstate(invalid="ignore"):
        squares = np.sum((simulated - motion)[told] ** 2, axis=0)
    known = free_axes(samples).astype(np.float64)
    drawn = samples["t"][keep], motion[keep], simulated[keep]
    return known * squares, known * told.sum(), drawn


def curves(bags: Sequence[ReadBag], before: OpenLoop, after: OpenLoop) -> tuple[Curves, ...]:
    """One for each of the ``bags``, simulated with one configuration and another."""
    return tuple(
        Curves(bag.path.name, t, measured, simulated, interpolated(later, fitted, t))
        for bag, (t, measured, simulated), (later, _, fitted) in zip(
            bags, before.drawn, after.drawn, strict=True
        )
    )


def by_chance(
    archive: Archive,
    fitted: Config,
    names: Sequence[str],
    covariance: Array,
    states: Sequence[State],
) -> Array:
    """RMS (6,) of what the errors of a fit do to the open-loop simulation, if they are as stated,
    and the noise of the velocities from which its windows start: in a vehicle that does not keep
    its course, it grows.

    ``names`` (n,), covariance (n, n) and ``states`` (n,) of what was fitted; what is held has no
    errors of the fit. Parameters of effects on the input and on sensors change what was read, not
    how it is simulated: the others are taken given these.
    """
    learnt = [i for i, state in enumerate(states) if state is not State.HELD]
    names, covariance = [names[i] for i in learnt], covariance[np.ix_(learnt, learnt)]
    simulated = np.array([not _is_read(name) for name in names], dtype=bool)
    mixed = covariance[np.ix_(simulated, ~simulated)]
    known = np.linalg.pinv(covariance[np.ix_(~simulated, ~simulated)], hermitian=True)
    given = covariance[np.ix_(simulated, simulated)] - mixed @ known @ mixed.T
    variances, directions = np.linalg.eigh(given)
    root = directions * np.sqrt(np.maximum(variances, 0.0))
    chosen = [name for name, use in zip(names, simulated, strict=True) if use]
    values = np.array([fitted.value(name) for name in chosen])
    drawn = []
    for z in np.random.default_rng(0).standard_normal((_DRAWS, len(chosen))):
        moved = values + _STEP * (root @ z)
        one = fitted.with_values(dict(zip(chosen, moved.tolist(), strict=True)))
        drawn.append((one.dynamics, compiled(one.effects)))
    parts = archive.each(_departures, (fitted.dynamics, compiled(fitted.effects)), drawn)
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = [sum(of[i] for of in parts) / sum(of[-1] for of in parts) for i in (0, 1)]
        rms = np.sqrt(squares[0] / _STEP**2 + squares[1])
    return np.where(np.isfinite(rms), rms, 0.0)


def _is_read(name: str) -> bool:
    effect = EFFECTS.get(name.partition(".")[0])
    return effect is not None and (effect.place == "input" or effect.of_sensors)


def _departures(
    samples: Samples, fitted: tuple[Model, Acting], drawn: Sequence[tuple[Model, Acting]]
) -> tuple[Array, Array, Array]:
    """Sums (6,) over samples and draws of the squared differences to the fitted simulation, of
    models ``drawn`` and of starts, and how many (6,) of either these are.

    The starts have all of their noise, as what grows for ten seconds does not stay linear.
    """
    model, effects = fitted
    around = predicted(model, samples, HORIZON, effects=effects)
    std = np.sqrt(samples["odometry_variance"])
    if np.isfinite(samples["gyro"]).any():
        std[:, 3:] = np.sqrt(samples["gyro_variance"])[:, None]
    noise, moved = np.random.default_rng(0), samples.copy()
    of_models, of_starts = np.zeros((2, 6))
    with np.errstate(invalid="ignore"):
        for one, acting in drawn:
            there = predicted(one, samples, HORIZON, effects=acting)
            of_models += np.sum((there - around) ** 2, axis=0)
            moved["nu"] = samples["nu"] + std * noise.standard_normal(std.shape)
            there = predicted(model, moved, HORIZON, effects=effects)
            of_starts += np.sum((there - around) ** 2, axis=0)
    known = free_axes(samples).astype(np.float64)
    return known * of_models, known * of_starts, known * len(samples) * len(drawn)
