"""A bag as the estimators see it: its samples, and what had to be refused."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array, Message
from rov_ident.core.progress import Progress, silent
from rov_ident.effects import Acting
from rov_ident.io import topics as inputs
from rov_ident.io.bag_reader import Bag
from rov_ident.model.coefficients import INPUTS, VELOCITIES
from rov_ident.model.equations import Model
from rov_ident.sampling.queues import LONGEST_INTERVAL
from rov_ident.sampling.sample import NO_MOMENT, after_reset, free_axes, joined, stretches
from rov_ident.sampling.sampler import Sampler
from rov_ident.sampling.validation import NO_ODOMETRY, describe
from rov_ident.sampling.without_velocity import IMPOSSIBLE, has_velocity, is_without_velocity
from rov_ident.simulation.open_loop import open_loop
from rov_ident.simulation.virtual_sensors import Dive

HORIZON = 10.0  # s; of the open-loop windows by which models are judged
UNITS = ("m/s",) * 3 + ("rad/s",) * 3


@dataclass(frozen=True)
class Record:
    """The samples (k,) of SAMPLE of one bag, in its own time.

    ``notes`` say in words what was refused or lost; ``sha256`` is of the bag's bytes.
    ``contradictions`` are test ratios of the odometry's parts against the IMU: 1 is expected.
    ``origin`` is the stamp [ns] of t = 0.
    """

    path: Path
    samples: NDArray[np.void]
    counts: Counter[str]
    notes: tuple[str, ...]
    sha256: str
    contradictions: Mapping[str, float] = field(default_factory=dict)
    origin: int = 0

    @property
    def duration(self) -> float:
        """Seconds that the samples cover, gaps left out."""
        return float(self.samples["dt"].sum())


def read_record(
    path: str | Path, config: Config, say: Progress = silent, columns: bool = False
) -> Record:
    """Read a bag into samples; with ``columns`` they say how they change with the estimated
    parameters of effects (:func:`~rov_ident.sampling.sample.sample_type`).

    Raises UserError if the bag cannot be read, lacks a topic, or yields no sample, naming what is
    missing.
    """
    bag = Bag(Path(path))
    topics = inputs.select(bag, config)
    measured = has_velocity(bag, topics, config)
    sampler = Sampler(config if columns else config.with_effects_held, measured)
    unusable: Counter[str] = Counter()
    messages = inputs.messages(bag, topics, config, unusable, say)
    samples = after_reset(joined([*sampled(sampler, messages)]))
    counts = sampler.counts + unusable
    notes = inputs.doubts(bag, topics, config)
    refused = counts.copy()
    if len(samples) and refused[NO_ODOMETRY] * np.median(samples["dt"]) <= LONGEST_INTERVAL:
        del refused[NO_ODOMETRY]  # topics never begin together
    notes += [f"{bag.path.name}: {refusal}" for refusal in describe(refused)]
    notes += [bag.damage] if bag.damage else []
    notes += [] if measured else [f"{bag.path.name}: {IMPOSSIBLE}"]
    notes += [] if free_axes(samples).all() else [f"{bag.path.name}: {NO_MOMENT}"]
    notes += _input_notes(config, samples)
    if len(samples) < 2:
        raise UserError(
            f"{path}: its messages make no samples"
            + (f": {'; '.join(notes)}" if notes else ", it is too short")
        )
    contradictions = sampler.kinematic_filter.contradictions
    origin = sampler.origin or 0
    return Record(Path(path), samples, counts, tuple(notes), bag.sha256, contradictions, origin)


def _input_notes(config: Config, samples: NDArray[np.void]) -> list[str]:
    """Notes on inputs that are missing or never change: their coefficients cannot be estimated."""
    said = [
        f"{', '.join(names)}: held, as {name} counts as zero: name its joint in inputs.{name}.joint"
        for name, names in config.unheard.items()
    ]
    for name, given in config.inputs.joints.items():
        x = samples["inputs"][:, 1, INPUTS.index(name)] if len(samples) else np.zeros(0)
        if len(x) and np.ptp(x) == 0.0:
            said.append(
                f"{name} (joint {given.joint}) stays at {x[0]:.3g} throughout: it is stuck, or "
                "never moved, and nothing tells its coefficients"
            )
    return said


def simulated_axes(
    samples: NDArray[np.void], free: NDArray[np.bool_] | None
) -> NDArray[np.bool_] | None:
    """Of the axes ``free`` (6,), None being all, those along which a wrench is known."""
    known = free_axes(samples)
    return free if known.all() else known if free is None else free & known


def predicted(
    model: Model,
    samples: NDArray[np.void],
    horizon: float,
    free: NDArray[np.bool_] | None = None,
    effects: Acting | None = None,
) -> Array:
    """Velocities (k, 6) over ground, simulated open loop in windows of ``horizon`` seconds.

    An infinite horizon is one run. Every window starts from the measured state at its first sample;
    so does every stretch after a gap. Components not marked in ``free`` (6,) follow the
    measurement, and those of which no wrench is known. Infinite where the simulation diverges.
    ``effects`` on the wrench and the current act along the simulated motion, in place of what the
    samples say they did along the measured one.
    """
    out, free = np.empty((len(samples), 6)), simulated_axes(samples, free)
    for first, end in stretches(samples):
        part = samples[first:end]
        thrust = part["wrench"] - part["surroundings"]
        slope = part["wrench_slope"] - part["surroundings_slope"]
        # a sample's wrench belongs to the interval that ends there
        thrust, slope = (np.vstack([values[1:], values[-1:]]) for values in (thrust, slope))
        inputs = np.vstack([part["inputs"][1:, 0], part["inputs"][-1:, 0]])
        out[first:end] = open_loop(
            model, part["t"], thrust, over_ground(part), part["orientation"], horizon, slope, free,
            effects, inputs, part["position"],
        )  # fmt: skip
    return out


def beside_odometry(samples: NDArray[np.void]) -> NDArray[np.void]:
    """The samples (k,) without those in a pause of the odometry, in which velocities drift."""
    if is_without_velocity(samples):
        return samples
    heard = np.where(np.isfinite(samples["odometry"]).any(axis=1), samples["t"], -np.inf)
    beside = samples["t"] - np.maximum.accumulate(heard) <= LONGEST_INTERVAL
    samples = samples.copy()
    samples["restart"][1:] |= beside[1:] & ~beside[:-1]
    return samples[beside]


def over_ground(samples: NDArray[np.void]) -> Array:
    """The measured velocities (k, 6) over ground, as the odometry has them."""
    nu = samples["nu"].copy()
    nu[:, :3] += samples["water"]
    return nu


def measured_motion(samples: NDArray[np.void]) -> Array:
    """:func:`over_ground`, NaN where linear velocities were simulated, as none was measured."""
    nu = over_ground(samples)
    if is_without_velocity(samples):
        nu[:, :3] = np.nan
    return nu


@dataclass(frozen=True)
class Score:
    """Open-loop simulation against measurement: rmse and R2 (6,) per velocity component."""

    rmse: Array
    r2: Array


def score(samples: NDArray[np.void], simulated: Array) -> Score:
    """Score velocities (k, 6) of :func:`predicted` where the velocity was measured: NaN where none
    was."""
    measured = samples["measured"]
    nu = measured_motion(samples)[measured]
    error = simulated[measured] - nu
    with np.errstate(invalid="ignore", divide="ignore"):
        rmse = np.sqrt(np.mean(error**2, axis=0))
        r2 = 1.0 - np.sum(error**2, axis=0) / np.sum((nu - nu.mean(axis=0)) ** 2, axis=0)
    return Score(rmse, r2)


def numbers(values: Array) -> dict[str, float | None]:
    """By velocity component; None where there is none, infinite where a simulation diverges."""
    return {n: None if np.isnan(v) else v for n, v in zip(VELOCITIES, values.tolist(), strict=True)}


def samples_of(config: Config, run: Dive, velocity: bool = True) -> Iterator[NDArray[np.void]]:
    """The samples (k,) of a dive as an estimator configured so would see them, with or without its
    linear velocities."""
    messages = ((role, message) for _, role, message in run.messages)
    return sampled(Sampler(config, velocity), messages)


def sampled(
    sampler: Sampler, messages: Iterable[tuple[str, Message]]
) -> Iterator[NDArray[np.void]]:
    """What a sampler makes of all messages, in parts (k,); the last may be empty."""
    for role, message in messages:
        part = sampler.push(role, message)
        if len(part):
            yield part
    yield sampler.flush()
