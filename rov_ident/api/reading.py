"""Reads and checks the arguments of the API functions: files, configurations, channels."""

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.core.errors import UserError, require
from rov_ident.core.files import sha256_of
from rov_ident.core.progress import Progress, silent
from rov_ident.core.threads import one_blas_thread
from rov_ident.io.bag_reader import Bag
from rov_ident.io.mounting import with_mounting
from rov_ident.model.coefficients import MOTIONS, Coefficient, catalogue, input_catalogue
from rov_ident.sampling.records import Record, read_record

CHANNELS: dict[str, tuple[str, ...]] = {
    **{name: (name,) for name in MOTIONS},
    "lateral": ("sway", "yaw"),
    "longitudinal": ("heave", "pitch"),
}
"""What can be fitted by itself: single axes, and those that one pair of actuators moves."""

File = str | os.PathLike[str]
Files = File | Sequence[File]


def several(files: Files) -> list[Path]:
    """The paths of one file or of several, each as :func:`existing` gives it."""
    if isinstance(files, str | os.PathLike):
        return [existing(files)]
    if not isinstance(files, Iterable):
        raise UserError(f"{files!r} is no path, nor several: give the files to read")
    paths = [existing(file) for file in files]
    if not paths:
        raise UserError("no bag was given")
    return paths


def once(paths: Sequence[Path]) -> tuple[list[Path], tuple[str, ...]]:
    """The files of different data, as none may count twice, and a note on each that is left out."""
    kept: list[Path] = []
    notes = []
    for path in paths:
        same = same_data(path, kept)
        if same is None:
            kept.append(path)
        else:
            notes.append(f"{path} holds the same data as {same}: it counts once")
    return kept, tuple(notes)


def same_data(path: Path, others: Sequence[Path]) -> Path | None:
    """Which of other files holds the same data, if any does; None where it cannot be read."""
    size = _size(path)
    of_size = [other for other in others if _size(other) == size]
    with suppress(OSError, UserError):  # who reads it says what is wrong with it
        digest = _sha256(path) if of_size else ""
        return next((other for other in of_size if _sha256(other) == digest), None)
    return None


def _sha256(path: Path) -> str:
    """Of a file, as a CSV table and a bag of one file have it, or of a rosbag2 directory."""
    return Bag(path).sha256 if path.is_dir() else sha256_of([path])


def _size(path: Path) -> int:
    """Of all files of a bag together [bytes]."""
    files = path.iterdir() if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files)


def existing(file: File) -> Path:
    """The path, with the name of its folder for `.`; UserError where there is nothing."""
    if not isinstance(file, str | os.PathLike):
        raise UserError(f"{file!r} is no path: give the file to read")
    path = Path(file)
    if not path.exists():
        raise UserError(f"{path} cannot be read (No such file or directory): check the path")
    return path if path.name not in ("", "..") else path.resolve()


def load(config: File | Config, node: str = "") -> Config:
    """Read a parameter file of a vehicle, the one that nodes and commands use.

    Parameters
    ----------
    config
        Path of the YAML file. Vectors in it are in the axes of its key ``vehicle.frame``; those of
        the Config are always forward-starboard-down, in SI units. A Config is returned as it is.
    node
        Name of a node (``rls_node``, ``ukf_node``) whose own section overrides ``/**``.

    Raises
    ------
    UserError
        If a key is missing, of a wrong type or unphysical: one sentence that names it.
    """
    return configuration.load(config, node)


@one_blas_thread()
def read(bag: File, config: File | Config, progress: Progress | None = None) -> Record:
    """Read a bag into samples: all that was measured, on one clock, as the estimators see it.

    Parameters
    ----------
    bag
        Path of an ``.mcap`` file or a rosbag2 directory. Axes of its messages follow their frame
        ids, or the configuration.
    config
        Path of a parameter file, or a Config.
    progress
        Called with a sentence and the share (0 to 1) that is done.

    Returns
    -------
    Record
        ``samples`` (k,), a structured array: ``t`` [s] since the first message, ``nu`` (k, 6) [m/s,
        rad/s] through the water and ``wrench`` (k, 6) [N, N m] in body axes forward-starboard-down,
        ``orientation`` (k, 4) w x y z, body to north-east-down, and what else `SAMPLE` lists;
        ``duration`` [s]; ``notes`` on what was refused.

    Raises
    ------
    UserError
        If the bag cannot be read, lacks a topic or yields no sample.
    """
    path = existing(bag)
    given, notes = with_mounting(load(config), [path])
    record = read_record(path, given, progress or silent)
    return replace(record, notes=(*notes, *record.notes))


def axes(channels: str) -> NDArray[np.bool_]:
    """Which axes (6,) the names of channels, divided by commas, mean.

    Raises UserError if there is no such channel.
    """
    require(str, "text, such as 'surge,yaw'", channels=channels)
    wanted = channels.split(",")
    if unknown := sorted(set(wanted) - set(CHANNELS)):
        raise UserError(f"no channel {unknown[0]!r}: use {','.join(CHANNELS)}")
    names = {axis for name in wanted for axis in CHANNELS[name]}
    return np.array([name in names for name in MOTIONS])


def coefficients() -> tuple[Coefficient, ...]:
    """Every coefficient a configuration may name, each with ``name``, ``unit``, ``meaning``."""
    return (*catalogue(), *input_catalogue())
