"""Do two checkouts give the same numbers? Twenty bags through every command that estimates.

    python bench/tools/same_numbers.py run --program A/.venv/bin/rov-ident --bags DIR --out DIR/a
    python bench/tools/same_numbers.py run --program B/.venv/bin/rov-ident --bags DIR --out DIR/b
    python bench/tools/same_numbers.py compare DIR/a DIR/b

`run` fits each bag by every estimator, explains it, and plays every fourth over DDS into both live
nodes. Results that are there already are kept, so an interrupted run goes on where it was.
`compare` prints, for each kind of result, the largest difference: of estimates in standard
deviations, of other numbers relative to their size, and the names that only one side has.
It ends with status 1 if an estimate differs by more than 1e-10 standard deviations.

`bags` (as `python -m bench.tools.same_numbers bags DIR`) writes the bags and their
configurations: one hidden effect each, drawn by seed, from several tiers of the explain study.
"""

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

BAGS = 20
LIVE_EVERY = 4  # every so many bags are also played into live nodes
ESTIMATORS = ("rls", "ukf", "ls", "iv", "ml")
TOLERANCE = 1e-10  # standard deviations
NOT_COMPARED = {"version", "seconds", "sha256", "file", "bags", "provenance"}


def make_bags(folder: Path) -> None:
    """Write BAGS dives with a hidden effect and what their configurations know of it."""
    from dataclasses import replace

    from bench.simulators import hidden
    from rov_ident.config import dump
    from rov_ident.io.write_messages import write_messages

    folder.mkdir(parents=True, exist_ok=True)
    tiers = ("standard", "no IMU", "pilot", "noise x 3", "other vehicles")
    names = sorted(hidden.EFFECTS)
    for seed in range(BAGS):
        tier = tiers[seed % len(tiers)]
        effect = names[(7 * seed) % len(names)]
        if effect in hidden.UNOBSERVABLE.get(tier, ()):
            effect = "thruster_lag"
        conditions = replace(hidden.TIERS[tier], duration=60.0)
        case = hidden.draw(9_000 + seed, (effect,), strength=0.5, conditions=conditions)
        path = folder / f"{seed:02d}.mcap"
        write_messages(path, case.messages)
        dump(case.config, path.with_suffix(".yaml"))


def run(program: Path, bags: Path, out: Path, jobs: int) -> None:
    out.mkdir(parents=True, exist_ok=True)
    tasks = list(_tasks(program, bags, out))
    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(_do, tasks))


def _tasks(program: Path, bags: Path, out: Path) -> Iterator[tuple[Path, list[str]]]:
    for number, bag in enumerate(sorted(bags.glob("*.mcap"))):
        settings = ["--config", str(bag.with_suffix(".yaml"))]
        for estimator in ESTIMATORS:
            result = out / f"{bag.stem}-fit-{estimator}.json"
            command = ["fit", str(bag), *settings, "--estimator", estimator, "--json", str(result)]
            yield result, [str(program), *command]
        folder = out / f"{bag.stem}-explain"
        yield (
            folder / "findings.json",
            [str(program), "explain", str(bag), *settings, "--out", str(folder)],
        )
        if number % LIVE_EVERY == 0:
            result = out / f"{bag.stem}-live.json"
            command = ["replay", str(bag), *settings, "--rate", "0", "--json", str(result)]
            yield result, [str(program), *command]


def _do(task: tuple[Path, list[str]]) -> None:
    result, command = task
    if result.exists():
        return
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(command, capture_output=True, text=True, env=clean)
    if not result.exists():  # a refusal is a result, too
        result.parent.mkdir(parents=True, exist_ok=True)
        result.write_text(json.dumps({"status": done.returncode, "said": done.stderr[-500:]}))
    print(result.name if result.name != "findings.json" else result.parent.name, flush=True)


def compare(a: Path, b: Path) -> bool:
    """Print the differences of two runs; whether every estimate is the same."""
    same, worst = True, {}
    for path in sorted(a.rglob("*.json")):
        other = b / path.relative_to(a)
        if not other.exists():
            print(f"{other} is missing")
            same = False
            continue
        kind = path.parent.name.split("-")[-1] if path.name == "findings.json" else path.stem[3:]
        first, second = json.loads(path.read_text()), json.loads(other.read_text())
        for where, difference in _differences(first, second, ""):
            if difference > worst.get(kind, (0.0, ""))[0]:
                worst[kind] = (difference, f"{path.relative_to(a)} {where}")
        worst.setdefault(kind, (0.0, ""))
    for kind, (difference, where) in sorted(worst.items()):
        print(f"{kind:10s} largest difference {difference:.2g} {where}")
        same = same and difference <= TOLERANCE
    return same


def _differences(a: Any, b: Any, where: str) -> Iterator[tuple[str, float]]:
    if isinstance(a, dict) and isinstance(b, dict):
        if set(a) - set(b):
            yield f"{where}: only the first has {sorted(set(a) - set(b))}", math.inf
        for key in a.keys() & b.keys() - NOT_COMPARED:
            if key in ("value", "lower", "upper") and "std" in a and a["std"]:
                yield f"{where}/{key}", abs(a[key] - b[key]) / a["std"]
            else:
                yield from _differences(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, list) and isinstance(b, list):
        if len(a) != len(b):
            yield f"{where}: {len(a)} and {len(b)} entries", math.inf
        for i, (x, y) in enumerate(zip(a, b)):
            yield from _differences(x, y, f"{where}[{i}]")
    elif isinstance(a, (int, float)) and isinstance(b, (int, float)):
        if a != b and not (a != a and b != b):
            yield where, abs(a - b) / max(abs(a), abs(b))
    elif isinstance(a, str) and isinstance(b, str):
        return  # words may change
    elif a != b:
        yield f"{where}: {a} and {b}", math.inf


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True, dest="command")
    commands.add_parser("bags").add_argument("folder", type=Path)
    runs = commands.add_parser("run")
    runs.add_argument("--program", type=Path, required=True)
    runs.add_argument("--bags", type=Path, required=True)
    runs.add_argument("--out", type=Path, required=True)
    runs.add_argument("--jobs", type=int, default=2)
    both = commands.add_parser("compare")
    both.add_argument("a", type=Path)
    both.add_argument("b", type=Path)
    options = parser.parse_args()
    if options.command == "bags":
        make_bags(options.folder)
    elif options.command == "run":
        run(options.program.absolute(), options.bags, options.out, options.jobs)
    elif not compare(options.a, options.b):
        sys.exit(1)


if __name__ == "__main__":
    main()
