"""Many bags as one fit: each is read once, and every pass maps a function over all of them.

What a pass gives are sums over samples, so that the passes of single bags add up to that of the
archive. They are added in the order of the bags, wherever they were computed: in this process, in
several, or on a Dask cluster, and the result is the same.
"""

import contextlib
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from itertools import count, repeat
from multiprocessing import get_context
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core import children
from rov_ident.core.errors import UserError
from rov_ident.core.progress import Progress, silent
from rov_ident.core.threads import limit_process
from rov_ident.sampling.records import Record, read_record
from rov_ident.sampling.smoothing import smoothed

Samples = NDArray[np.void]
Mapper = Callable[..., list[Any]]
"""``mapper(function, *arguments)``: [function(samples, *arguments)] of every bag, in order."""
Sums = TypeVar("Sums", bound=tuple[Any, ...])
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class ReadBag:
    """What is kept of a bag beside its samples."""

    path: Path
    sha256: str
    notes: tuple[str, ...]
    samples: int
    duration: float  # s
    contradictions: Mapping[str, float]  # as those of the record


Outcome = tuple[ReadBag, Any] | str
"""A bag and where its samples are (the array, a file, or a future), or why it was left out."""


class Archive:
    """Bags whose samples stay where they were read: in this process, in files, or on a cluster.

    ``bags`` in the order given; ``notes`` say what was refused, and which bags were left out.

    Raises UserError if no bag could be read.
    """

    def __init__(
        self,
        outcomes: Iterable[Outcome],
        map_over: Callable[..., list[Any]],
        read: Callable[[Config, bool], Iterable[Outcome]],
    ) -> None:
        """``map_over(where the samples are, function, *arguments)`` gives the function's results in
        order; ``read`` reads all bags, as :meth:`reread`."""
        every = list(outcomes)
        found = [outcome for outcome in every if not isinstance(outcome, str)]
        failures = [outcome for outcome in every if isinstance(outcome, str)]
        if not found:
            raise UserError("; ".join(failures))
        self.bags = tuple(bag for bag, _ in found)
        self.notes = (*failures, *(note for bag in self.bags for note in bag.notes))
        self._places = [place for _, place in found]
        self._map_over, self._read = map_over, read

    def each(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """[function(samples, *arguments)] of every bag, in order."""
        return self._map_over(self._places, function, *arguments)

    def reread(self, config: Config, columns: bool) -> "Archive":
        """The archive of the same bags, read with another configuration, with or without the
        columns of parameters of effects (`sampling.records.read_record`)."""
        return Archive(self._read(config, columns), self._map_over, self._read)

    def as_read_by(self, after: Config, before: Config) -> "Archive":
        """The archive, read by ``before``, as ``after`` reads it: with its effects on the input."""
        return self if after.effects == before.effects else self.reread(after, False)

    @property
    def samples(self) -> int:
        return sum(bag.samples for bag in self.bags)

    @property
    def duration(self) -> float:
        return sum(bag.duration for bag in self.bags)


def total(parts: Sequence[Sums]) -> Sums:
    """The sums of all bags, field by field, from those of each."""
    return type(parts[0])(*(sum(values) for values in zip(*parts, strict=True)))


def of_records(records: Sequence[Record], config: Config) -> Archive:
    """Records that ``config`` has read already, in this process."""

    def again(config: Config, columns: bool) -> Iterator[Outcome]:
        return (_outcome(record.path, config, columns) for record in records)

    return Archive([_bag_and_samples(record, config) for record in records], _locally, again)


@contextlib.contextmanager
def opened(
    paths: Sequence[Path], config: Config, jobs: int = 1, dask: str = "", say: Progress = silent
) -> Iterator[Archive]:
    """Read bags, in ``jobs`` processes or on a Dask cluster at the address ``dask`` ("local").

    Raises UserError if no bag can be read, or the cluster cannot be reached.
    """

    def reported(outcomes: Iterable[Outcome]) -> Iterator[Outcome]:
        for i, (path, outcome) in enumerate(zip(paths, outcomes, strict=True)):
            yield outcome
            say(f"read {path.name}", (i + 1) / len(paths))

    if dask:
        with children.environment(), _cluster(dask, jobs) as client:

            def read(config: Config, columns: bool) -> Iterator[Outcome]:
                return reported(_on_dask(client, paths, config, columns))

            yield Archive(read(config, False), partial(_by_dask, client), read)
    elif jobs > 1 and len(paths) > 1:
        # Not forked: a process that has started threads (BLAS, a progress bar) may not be.
        with (
            children.environment(),
            tempfile.TemporaryDirectory(prefix="rov_ident-") as folder,
            ProcessPoolExecutor(min(jobs, len(paths)), get_context("spawn"), limit_process) as pool,
        ):
            readings = count()

            def read(config: Config, columns: bool) -> Iterator[Outcome]:
                k = next(readings)
                files = [Path(folder) / f"{k}-{i}.npy" for i in range(len(paths))]
                stored = pool.map(_stored, paths, repeat(config), repeat(columns), files)
                return reported(_finished(stored))

            yield Archive(read(config, False), partial(_by_processes, pool), read)
    else:

        def read(config: Config, columns: bool) -> Iterator[Outcome]:
            return reported(_outcome(path, config, columns) for path in paths)

        yield Archive(read(config, False), _locally, read)


def _bag_and_samples(record: Record, config: Config) -> tuple[ReadBag, Samples]:
    samples = smoothed(record.samples, config)
    bag = ReadBag(
        record.path,
        record.sha256,
        record.notes,
        len(samples),
        record.duration,
        record.contradictions,
    )
    return bag, samples


def _outcome(path: Path, config: Config, columns: bool) -> Outcome:
    try:
        return _bag_and_samples(read_record(path, config, columns=columns), config)
    except UserError as error:
        text = str(error)
        return f"left out: {text if path.name in text else f'{path.name}: {text}'}"


def _locally(
    samples: Sequence[Samples], function: Callable[..., Any], *arguments: Any
) -> list[Any]:
    return [function(part, *arguments) for part in samples]


# ------------------------------------------------------------------ processes


def _stored(path: Path, config: Config, columns: bool, file: Path) -> Outcome:
    outcome = _outcome(path, config, columns)
    if isinstance(outcome, str):
        return outcome
    np.save(file, outcome[1])
    return outcome[0], _File(file, outcome[1].dtype)


class _File(NamedTuple):
    """Samples on disk. A file forgets that they are aligned records, and every kernel would be
    compiled once more for those that are not."""

    path: Path
    dtype: np.dtype[np.void]

    def read(self) -> Samples:
        return np.load(self.path, allow_pickle=False).view(self.dtype)


def _of_stored(file: _File, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    return function(file.read(), *arguments)


def _by_processes(
    pool: ProcessPoolExecutor, files: Sequence[_File], function: Callable[..., Any], *arguments: Any
) -> list[Any]:
    return list(_finished(pool.map(_of_stored, files, repeat(function), repeat(arguments))))


def _finished(results: Iterable[_Result]) -> Iterator[_Result]:
    """The results of processes. UserError if one of these was killed."""
    try:
        yield from results
    except BrokenProcessPool as error:
        raise UserError(_KILLED) from error


_KILLED = (
    "a process that worked on the bags was killed, perhaps as memory was short: use fewer at a "
    "time (--jobs)"
)


# ------------------------------------------------------------------ Dask


@contextlib.contextmanager
def _cluster(address: str, jobs: int) -> Iterator[Any]:
    try:
        import dask.config
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise UserError("--dask needs Dask: pip install 'rov_ident[dask]'") from error
    with contextlib.ExitStack() as stack:
        if address == "local":
            # By default Dask gives up a process that is not back 15 s after it was killed, and then
            # waits for it for ever.
            stack.enter_context(dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"}))
            local = LocalCluster(
                n_workers=max(jobs, 1), threads_per_worker=1, dashboard_address=None
            )
            yield stack.enter_context(Client(stack.enter_context(local)))
            return
        try:
            client = Client(address, timeout=10)
        except (OSError, ValueError) as error:
            raise UserError(f"no Dask scheduler answers at {address}: {error}") from error
        yield stack.enter_context(client)


def _bag_alone(outcome: Outcome) -> ReadBag | str:
    return outcome if isinstance(outcome, str) else outcome[0]


def _on_dask(
    client: Any, paths: Sequence[Path], config: Config, columns: bool
) -> Iterator[Outcome]:
    """Every bag with the future of its samples, which stay on the cluster."""
    n = len(paths)
    read = client.map(_outcome, list(paths), [config] * n, [columns] * n, pure=False)
    for whole, alone in zip(read, client.map(_bag_alone, read, pure=False), strict=True):
        (bag,) = _gathered(client, [alone])
        yield (
            bag if isinstance(bag, str) else (bag, client.submit(itemgetter(1), whole, pure=False))
        )


def _by_dask(
    client: Any, samples: Sequence[Any], function: Callable[..., Any], *arguments: Any
) -> list[Any]:
    futures = [client.submit(function, s, *arguments, pure=False) for s in samples]
    return _gathered(client, futures)


def _gathered(client: Any, futures: Sequence[Any]) -> list[Any]:
    """The results on a cluster. UserError if a process of it was killed time and again."""
    from distributed import KilledWorker

    try:
        return client.gather(futures)
    except KilledWorker as error:
        raise UserError(_KILLED) from error
