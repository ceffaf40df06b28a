"""Many bags as one fit: each is read once, and every pass maps a function over all of them.

What a pass gives are sums over samples, so that the passes of single bags add up to that of the
archive. They are added in the order of the bags, wherever they were computed: in this process, in
several, or on a Dask cluster, and the result is the same.
"""

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.errors import UserError
from rov_ident.hindsight import hindsight
from rov_ident.records import Record, read_record

Progress = Callable[[str, int, int], None]
"""Called with the name of the bag just read, how many are done, and how many there are."""


@dataclass(frozen=True)
class Bag:
    """What is kept of a bag beside its samples."""

    path: Path
    sha256: str
    notes: tuple[str, ...]
    samples: int
    duration: float  # s


class Archive:
    """Bags whose samples stay where they were read; :meth:`each` maps a function over them.

    ``bags`` in the order given; ``notes`` say what was refused, and which bags were left out.
    """

    def __init__(
        self,
        bags: Sequence[Bag],
        notes: Sequence[str],
        each: Callable[..., list[Any]],
    ) -> None:
        self.bags, self.notes = tuple(bags), tuple(notes)
        self.each = each
        """each(function, *arguments): [function(samples of the bag, *arguments)] in order."""

    @property
    def samples(self) -> int:
        return sum(bag.samples for bag in self.bags)

    @property
    def duration(self) -> float:
        return sum(bag.duration for bag in self.bags)


def of_records(records: Sequence[Record]) -> Archive:
    """Records that have been read already, in this process."""
    samples = [hindsight(r.samples) for r in records]
    return Archive(
        [_bag(r) for r in records],
        [note for r in records for note in r.notes],
        lambda f, *a: [f(s, *a) for s in samples],
    )


@contextlib.contextmanager
def opened(
    paths: Sequence[Path],
    config: Config,
    jobs: int = 1,
    dask: str = "",
    progress: Progress | None = None,
) -> Iterator[Archive]:
    """Read bags, in ``jobs`` processes or on a Dask cluster at the address ``dask`` ("local").

    Raises
    ------
    UserError
        If no bag can be read, or the cluster cannot be reached.
    """
    say = progress or (lambda name, done, total: None)
    if dask:
        with _cluster(dask, jobs) as client:
            futures = client.map(_tried, list(paths), [config] * len(paths), pure=False)
            yield _on_dask(client, futures, paths, say)
    elif jobs > 1 and len(paths) > 1:
        # Not forked: a process that has started threads (BLAS, a progress bar) may not be.
        with (
            tempfile.TemporaryDirectory(prefix="rov_ident-") as folder,
            ProcessPoolExecutor(min(jobs, len(paths)), get_context("spawn")) as pool,
        ):
            yield _in_processes(pool, Path(folder), paths, config, say)
    else:
        records, failures = [], []
        for i, path in enumerate(paths):
            outcome = _tried(path, config)
            if isinstance(outcome, str):
                failures.append(outcome)
            else:
                records.append(outcome)
            say(path.name, i + 1, len(paths))
        _check(records, failures)
        archive = of_records(records)
        archive.notes = (*failures, *archive.notes)
        yield archive


def default_jobs() -> int:
    """As many processes as this one may use processors."""
    return len(os.sched_getaffinity(0))


# ------------------------------------------------------------------ one bag


def _bag(record: Record) -> Bag:
    return Bag(record.path, record.sha256, record.notes, len(record.samples), record.duration)


def _tried(path: Path, config: Config) -> Record | str:
    """The record, or in words why there is none."""
    try:
        return read_record(path, config)
    except UserError as error:
        text = str(error)
        return f"left out: {text if path.name in text else f'{path.name}: {text}'}"


def _check(found: Sequence[object], failures: Sequence[str]) -> None:
    if not found:
        raise UserError("; ".join(failures) if failures else "no bag was given")


# ------------------------------------------------------------------ processes


def _stored(path: Path, config: Config, file: Path) -> Bag | str:
    outcome = _tried(path, config)
    if isinstance(outcome, str):
        return outcome
    np.save(file, hindsight(outcome.samples))
    return _bag(outcome)


def _of_file(file: Path, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    return function(np.load(file, allow_pickle=False), *arguments)


def _in_processes(
    pool: ProcessPoolExecutor, folder: Path, paths: Sequence[Path], config: Config, say: Progress
) -> Archive:
    files = [folder / f"{i}.npy" for i in range(len(paths))]
    tasks = [pool.submit(_stored, p, config, f) for p, f in zip(paths, files, strict=True)]
    bags, kept, failures = [], [], []
    for i, (task, path, file) in enumerate(zip(tasks, paths, files, strict=True)):
        outcome = task.result()
        if isinstance(outcome, str):
            failures.append(outcome)
        else:
            bags.append(outcome)
            kept.append(file)
        say(path.name, i + 1, len(paths))
    _check(bags, failures)

    def each(function: Callable[..., Any], *arguments: Any) -> list[Any]:
        tasks = [pool.submit(_of_file, file, function, arguments) for file in kept]
        return [task.result() for task in tasks]

    notes = [note for bag in bags for note in bag.notes]
    return Archive(bags, [*failures, *notes], each)


# ------------------------------------------------------------------ Dask


@contextlib.contextmanager
def _cluster(address: str, jobs: int) -> Iterator[Any]:
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise UserError("--dask needs Dask: pip install 'rov_ident[dask]'") from error
    if address == "local":
        with (
            LocalCluster(
                n_workers=max(jobs, 1), threads_per_worker=1, dashboard_address=None
            ) as cluster,
            Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError) as error:
        raise UserError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        yield client


def _described(outcome: Record | str) -> Bag | str:
    return outcome if isinstance(outcome, str) else _bag(outcome)


def _samples(outcome: Record) -> NDArray[np.void]:
    return hindsight(outcome.samples)


def _on_dask(client: Any, futures: Sequence[Any], paths: Sequence[Path], say: Progress) -> Archive:
    bags, kept, failures = [], [], []
    described = client.map(_described, futures, pure=False)
    for i, (future, path) in enumerate(zip(described, paths, strict=True)):
        outcome = future.result()
        if isinstance(outcome, str):
            failures.append(outcome)
        else:
            bags.append(outcome)
            kept.append(futures[i])
        say(path.name, i + 1, len(paths))
    _check(bags, failures)
    data = client.map(_samples, kept, pure=False)

    def each(function: Callable[..., Any], *arguments: Any) -> list[Any]:
        tasks = [client.submit(function, part, *arguments, pure=False) for part in data]
        return list(client.gather(tasks))

    notes = [note for bag in bags for note in bag.notes]
    return Archive(bags, [*failures, *notes], each)
