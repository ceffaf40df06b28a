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
from rov_ident.offline.archive import Archive, Samples
from rov_ident.sampling.records import HORIZON, measured_motion, predicted

_POINTS = 1500  # of a curve in a picture
_DRAWS = 8  # the RMS over them is known to 25 %
_STEP = 0.1  # standard deviations: small enough to be linear, and to stay physical


class Curves(NamedTuple):
    """Measured and simulated velocities (k, 6) of a bag, thinned for a picture."""

    name: str
    t: Array
    measured: Array
    before: Array
    after: Array


def curves(read: Archive, before: Config, reread: Archive, after: Config) -> list[Curves]:
    """One for each bag: the open-loop simulation in windows of HORIZON with one configuration and
    another, and the archive as each of them reads it."""
    known = read.each(_curves, before.dynamics, compiled(before.effects))
    found = reread.each(_curves, after.dynamics, compiled(after.effects))
    return [
        Curves(bag.path.name, t, measured, simulated, interpolated(later, fitted, t))
        for bag, (t, measured, simulated), (later, _, fitted) in zip(
            read.bags, known, found, strict=True
        )
    ]


def _curves(samples: Samples, model: Model, effects: Acting) -> tuple[Array, Array, Array]:
    keep = slice(None, None, max(1, len(samples) // _POINTS))
    simulated = predicted(model, samples, HORIZON, None, effects)[keep]
    return samples["t"][keep], measured_motion(samples)[keep], simulated


def open_loop_rmse(
    archive: Archive, config: Config, free: NDArray[np.bool_] | None = None
) -> Array:
    """RMSE (6,) of the open-loop simulation in windows of HORIZON seconds over all bags."""
    parts = archive.each(_squares, config.dynamics, compiled(config.effects), free)
    with np.errstate(invalid="ignore", divide="ignore"):
        rmse: Array = np.sqrt(sum(p[0] for p in parts) / sum(p[1] for p in parts))
    return rmse


def by_chance(
    archive: Archive,
    fitted: Config,
    names: Sequence[str],
    covariance: Array,
    states: Sequence[State],
) -> Array:
    """RMS (6,) of what the errors of a fit do to the open-loop simulation, if they are as stated.

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
        rms = np.sqrt(sum(p[0] for p in parts) / sum(p[1] for p in parts)) / _STEP
    return np.where(np.isfinite(rms), rms, 0.0)


def _is_read(name: str) -> bool:
    effect = EFFECTS.get(name.partition(".")[0])
    return effect is not None and (effect.place == "input" or effect.of_sensors)


def _squares(
    samples: Samples, model: Model, effects: Acting, free: NDArray[np.bool_] | None
) -> tuple[Array, int]:
    measured = samples["measured"]
    with np.errstate(invalid="ignore"):
        error = predicted(model, samples, HORIZON, free, effects) - measured_motion(samples)
    return np.sum(error[measured] ** 2, axis=0), int(measured.sum())


def _departures(
    samples: Samples, fitted: tuple[Model, Acting], drawn: Sequence[tuple[Model, Acting]]
) -> tuple[Array, int]:
    """Sums (6,) over samples and draws of the squared differences to the fitted simulation."""
    around = predicted(fitted[0], samples, HORIZON, effects=fitted[1])
    total = np.zeros(6)
    with np.errstate(invalid="ignore"):
        for model, effects in drawn:
            total += np.sum((predicted(model, samples, HORIZON, effects=effects) - around) ** 2, 0)
    return total, len(samples) * len(drawn)
