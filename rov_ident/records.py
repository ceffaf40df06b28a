"""A bag as the estimators see it: its samples, and what had to be refused."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rov_ident.bags import Bag, read_messages, select_topics
from rov_ident.config import Config
from rov_ident.errors import UserError
from rov_ident.frames import quaternion_from_euler
from rov_ident.messages import Array
from rov_ident.model import Model
from rov_ident.samples import Sampler, describe
from rov_ident.simulate import open_loop

HORIZON = 10.0  # s; of the open-loop windows by which models are judged
VELOCITIES = tuple("uvwpqr")

Progress = Callable[[int, int], None]
"""Called now and then with the messages read so far and in all."""


@dataclass(frozen=True)
class Record:
    """The samples (k,) of SAMPLE of one bag, in its own time.

    ``notes`` say in words what was refused or lost; ``sha256`` is of the bag's bytes.
    """

    path: Path
    samples: NDArray[np.void]
    counts: Counter[str]
    notes: tuple[str, ...]
    sha256: str

    @property
    def duration(self) -> float:
        """Seconds that the samples cover, gaps left out."""
        return float(self.samples["dt"].sum())


def read_record(path: str | Path, config: Config, progress: Progress | None = None) -> Record:
    """Read a bag into samples.

    Raises
    ------
    UserError
        If the bag cannot be read, lacks a topic, or yields no sample, naming what is missing.
    """
    bag = Bag(Path(path))
    topics = select_topics(bag, vars(config.topics))
    total = sum(bag.topics[name].message_count for name in topics.values() if name)
    sampler = Sampler(config)
    parts: list[NDArray[np.void]] = []
    undecodable: Counter[str] = Counter()
    for done, (role, message) in enumerate(read_messages(bag, topics)):
        if message is None:
            undecodable[f"{role}: cannot be decoded"] += 1
        else:
            part = sampler.push(role, message)
            if len(part):
                parts.append(part)
        if progress is not None and done % 2000 == 0:
            progress(done, total)
    parts.append(sampler.flush())
    if progress is not None:
        progress(total, total)
    samples = np.concatenate(parts)
    counts = sampler.counts + undecodable
    notes = [f"{bag.path.name}: {refusal}" for refusal in describe(counts)]
    notes += [bag.damage] if bag.damage else []
    if len(samples) < 2:
        raise UserError(
            f"{path}: its messages make no samples"
            + (f": {'; '.join(notes)}" if notes else ", it is too short")
        )
    return Record(Path(path), samples, counts, tuple(notes), bag.sha256)


def attitude_of(samples: NDArray[np.void]) -> Array:
    """Attitudes (k, 4) of the samples with heading zero: the model does not depend on heading."""
    down = samples["down"]
    roll, pitch = np.arctan2(down[:, 1], down[:, 2]), -np.arcsin(np.clip(down[:, 0], -1.0, 1.0))
    return quaternion_from_euler(roll, pitch, 0.0)


def predicted(
    model: Model,
    samples: NDArray[np.void],
    horizon: float,
    free: NDArray[np.bool_] | None = None,
) -> Array:
    """Velocities (k, 6) simulated open loop in windows of ``horizon`` seconds (inf: one run).

    Every window starts from the measured state at its first sample; so does every stretch after a
    gap. Components not marked in ``free`` (6,) follow the measurement. Infinite where the
    simulation diverges.
    """
    out = np.empty((len(samples), 6))
    edges = np.append(np.flatnonzero(samples["restart"]), len(samples))
    if edges[0] != 0:
        edges = np.insert(edges, 0, 0)
    attitude = attitude_of(samples)
    for first, end in pairwise(edges):
        part = samples[first:end]
        # a sample's wrench belongs to the interval that ends there
        wrench, slope = (
            np.vstack([part[name][1:], part[name][-1:]]) for name in ("wrench", "wrench_slope")
        )
        out[first:end] = open_loop(
            model, part["t"], wrench, part["nu"], attitude[first:end], horizon, slope, free
        )
    return out


@dataclass(frozen=True)
class Score:
    """Open-loop simulation against measurement: rmse and R2 (6,) per velocity component."""

    rmse: Array
    r2: Array


def score(
    model: Model,
    samples: NDArray[np.void],
    horizon: float = HORIZON,
    free: NDArray[np.bool_] | None = None,
) -> Score:
    """Score the simulation of :func:`predicted` where the velocity was measured."""
    measured = samples["measured"]
    nu = samples["nu"][measured]
    error = predicted(model, samples, horizon, free)[measured] - nu
    with np.errstate(invalid="ignore", divide="ignore"):
        rmse = np.sqrt(np.mean(error**2, axis=0))
        r2 = 1.0 - np.sum(error**2, axis=0) / np.sum((nu - nu.mean(axis=0)) ** 2, axis=0)
    return Score(rmse, r2)
