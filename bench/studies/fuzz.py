"""Damaged files for every reader and command: each is read, or refused in one sentence.

The seeds are the files of `test/corpus`, a folder for each reader; what once led to a fault stays
there. A damaged file differs from a seed by some bytes, numbers or pieces.
"""

import argparse
import contextlib
import io
import math
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

from bench import HEAVY, ROOT
from rov_ident import config as configuration
from rov_ident.api.comparison import compare
from rov_ident.cli.program import main as run_command
from rov_ident.consumer.formats import import_model
from rov_ident.core.errors import UserError
from rov_ident.estimation.checkpoint import restore
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.io.ardupilot_log import import_log
from rov_ident.io.bag_reader import Bag
from rov_ident.io.cdr import DECODERS
from rov_ident.io.csv_log import import_csv
from rov_ident.offline import captive_tests, coast_down
from rov_ident.steering import zigzag

CORPUS = ROOT / "test" / "corpus"
LONGEST = 20.0  # s of processor, for a file of some kilobytes, which takes milliseconds
MOST_MEMORY = 1 << 30  # bytes, of this process
_LARGEST = 1 << 16  # bytes of a damaged file
_LONGEST_SENTENCE = 2000  # characters; a screen

Reader = Callable[[Path], object]


def _bag(path: Path) -> None:
    for raw in Bag(path).iter_raw():
        with contextlib.suppress(ValueError):  # which is how a decoder refuses
            DECODERS.get(raw.type_name, bytes)(raw.data)


def _message(path: Path) -> None:
    for decode in DECODERS.values():
        with contextlib.suppress(ValueError):
            decode(path.read_bytes())


def _checkpoint(path: Path) -> None:
    restore(OnlineEstimator(configuration.load(HEAVY), "rls"), path.read_bytes())


def _log(path: Path) -> None:
    thrusters = configuration.load(CORPUS / "configuration" / "thrusters.yaml")
    import_log(path, path.with_name("out.mcap"), thrusters)


READERS: dict[str, Reader] = {
    "configuration": configuration.load,
    "bag": _bag,
    "message": _message,
    "csv": lambda path: import_csv([path], path.with_name("out.mcap")),
    "zigzag": zigzag.read,
    "forces": lambda path: captive_tests.fit(captive_tests.read_table(path)),
    "coasting": lambda path: coast_down.read_run(path, {}),
    "log": _log,
    "model": import_model,
    "result": lambda path: compare(path, path),
    "checkpoint": _checkpoint,
}

COMMANDS: dict[str, tuple[str, ...]] = {
    "configuration": ("export", "--format", "gazebo", "--out", "{out}.sdf", "--config"),
    "bag": ("check", "--config", str(HEAVY)),
    "csv": ("import", "--out", "{out}.mcap"),
    "zigzag": ("nomoto",),
    "forces": ("forces",),
    "model": ("import-model", "--out", "{out}.yaml"),
    "result": ("compare", str(HEAVY)),
}
"""By reader, the command that a damaged file is given to, as its last argument."""

_PIECES = (
    b"\0", b"\xff\xff\xff\xff", b"\xff" * 8, b"\x7f", b"nan", b"inf", b"-1", b"0", b"1e308",
    b"1e-320", b"9" * 400, b"\n", b",", b"[" * 200, b"{", b"&a *a", b"!!python/object:x",
    b"2024-99-99", b"\x1b[2J", b"null", b"<a>", b'"', b"---\n", b"\xed\xa0\x80",
)  # fmt: skip


def damaged(seed: bytes, other: bytes, chance: random.Random) -> bytes:
    """A copy with one to eight damages; some take a piece of the ``other`` file."""
    data = bytearray(seed)
    for _ in range(chance.choice((1, 1, 2, 4, 8))):
        at = chance.randrange(len(data) + 1)
        end = min(len(data), at + chance.choice((1, 1, 2, 4, 8, 100, 1000)))
        how = chance.randrange(6)
        if how == 0:
            data[at:end] = chance.randbytes(end - at)
        elif how == 1 and at < len(data):
            data[at] ^= 1 << chance.randrange(8)
        elif how == 2:
            del data[at:end]
        elif how == 3:
            data[at:at] = data[at:end] * chance.choice((1, 2, 50))
        elif how == 4:
            piece = chance.choice(_PIECES)
            data[at : at + chance.choice((0, len(piece)))] = piece
        else:
            begin = chance.randrange(len(other) + 1)
            data[at:end] = other[begin : begin + end - at]
    return bytes(data[:_LARGEST])


@contextlib.contextmanager
def _in_time() -> Iterator[None]:
    def late(*_: object) -> None:
        raise TimeoutError(f"not done after {LONGEST:g} s of processor")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def read(name: str, path: Path) -> None:
    """Give a file to a reader. Raises AssertionError, or what it raises, where that is a fault."""
    with _in_time(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            READERS[name](path)
        except UserError as error:
            if len(str(error)) > _LONGEST_SENTENCE:
                raise AssertionError(f"a sentence of {len(str(error))} characters") from error


def run(name: str, path: Path) -> None:
    """Give a file to a command. Raises AssertionError, or what it raises, where that is a fault."""
    words = [word.format(out=path.with_name("out")) for word in COMMANDS[name]]
    said = io.StringIO()
    with _in_time(), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
        status = run_command([*words, str(path)])
    lines = said.getvalue().splitlines()
    assert status == 0 or (status == 2 and len(lines) == 1), f"{status}: {lines}"


def search(
    name: str, give: Callable[[str, Path], None], seconds: float, most: int, seed: int = 0
) -> tuple[int, dict[str, bytes]]:
    """Damage the seeds of a reader until the time is over or ``most`` files were given.

    How many were, and a file for every fault, by what it was.
    """
    chance = random.Random(f"{name} {seed}")
    seeds = sorted((CORPUS / name).iterdir())
    end, count = time.monotonic() + seconds, 0
    faults: dict[str, bytes] = {}
    with tempfile.TemporaryDirectory() as folder:
        while count < len(seeds) or (count < most and time.monotonic() < end):
            source = seeds[count] if count < len(seeds) else chance.choice(seeds)
            data = source.read_bytes()
            if count >= len(seeds):  # the first time each as it is
                data = damaged(data, chance.choice(seeds).read_bytes(), chance)
            path = Path(folder) / f"input{source.suffix}"
            path.write_bytes(data)
            count += 1
            try:
                give(name, path)
            except Exception as error:
                trace = error.__traceback__
                while trace and trace.tb_next:
                    trace = trace.tb_next
                where = f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}" if trace else ""
                faults.setdefault(f"{type(error).__name__} {where} {str(error)[:200]}", data)
    return count, faults


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument(
        "--files",
        type=int,
        nargs=2,
        metavar=("READERS", "COMMANDS"),
        help="so many in place of a time",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=READERS, default=list(READERS), help="kinds")
    parser.add_argument("--keep", type=Path, help="folder for the files that led to faults")
    options = parser.parse_args()
    share = options.seconds / len([n for n in (*READERS, *COMMANDS) if n in options.only])
    bad = 0
    most = options.files or (sys.maxsize, sys.maxsize)
    share = math.inf if options.files else share
    kinds = ("reader", READERS, read, most[0]), ("command", COMMANDS, run, most[1])
    for of, names, give, files in kinds:
        names = [name for name in names if name in options.only]
        for name in names:
            count, faults = search(name, give, share, -(-files // len(names)), options.seed)
            print(f"{of} {name}: {count} files, {len(faults)} faults", flush=True)
            for k, (what, data) in enumerate(faults.items()):
                print(f"  {what}")
                if options.keep:
                    suffix = sorted((CORPUS / name).iterdir())[0].suffix
                    options.keep.mkdir(parents=True, exist_ok=True)
                    (options.keep / f"{of}-{name}-{k}{suffix}").write_bytes(data)
            bad += len(faults)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    print(f"{memory >> 20} MiB at most")
    return 1 if bad or memory > MOST_MEMORY else 0


if __name__ == "__main__":
    sys.exit(main())
