"""Damaged files for every reader, guided by coverage: what reaches a new line is damaged further.

With Atheris (`pip install .[fuzz]`), which finds its way through checks that `fuzz.py`, by chance
alone, seldom passes. Readers, seeds and what counts as a fault are those of `fuzz.py`.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from bench import ROOT

CORPUS = ROOT / "test" / "corpus"
_MARKED = ["rov_ident", "mcap", "yaml", "rosbags"]


def _with_kernels() -> list[str]:
    """The modules that numba compiles parts of, which it could not once Atheris has marked them."""
    sources = sorted((ROOT / "rov_ident").rglob("*.py"))
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in sources
        if "core.jit import" in path.read_text() or path.name == "jit.py"
    ]


def _fuzz(name: str, suffix: str, options: list[str]) -> None:
    """Give files with this suffix to a reader until libFuzzer ends the process."""
    import atheris

    with atheris.instrument_imports(include=_MARKED, exclude=_with_kernels()):
        from bench.studies import fuzz
    path = Path(tempfile.mkdtemp()) / f"input{suffix}"

    def one(data: bytes) -> None:
        path.write_bytes(data)
        fuzz.read(name, path)

    atheris.Setup([sys.argv[0], *options], one)
    atheris.Fuzz()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--keep", type=Path, default=ROOT / "out" / "faults", help="a folder")
    options = parser.parse_args()
    try:
        import atheris  # noqa: F401
    except ImportError:
        print("left out: Atheris is not installed (pip install .[fuzz])")
        return 0
    options.keep.mkdir(parents=True, exist_ok=True)
    kinds = sorted({(p.parent.name, p.suffix) for p in CORPUS.rglob("*") if p.is_file()})
    bad = 0
    for name, suffix in kinds:
        with tempfile.TemporaryDirectory(prefix="rov_ident-") as folder:
            found = Path(folder) / "found"
            found.mkdir()
            command = [sys.executable, "-m", __spec__.name, name, suffix, str(found)]
            command += [str(CORPUS / name), "-max_len=65536", "-rss_limit_mb=1024", "-timeout=30"]
            command += [f"-max_total_time={max(1, round(options.seconds / len(kinds)))}"]
            command += [f"-artifact_prefix={options.keep / name}-", "-print_final_stats=1"]
            done = subprocess.run(
                command, stderr=subprocess.STDOUT, stdout=subprocess.PIPE, text=True,
                errors="replace", env={**os.environ, "TMPDIR": folder},
            )  # fmt: skip
            kept = len(list(found.iterdir()))
        said = done.stdout.splitlines()
        given = [line.rpartition(" ")[2] for line in said if "number_of_executed_units" in line]
        print(f"{name} {suffix}: {given} files, {kept} reached something new", flush=True)
        if done.returncode:
            bad += 1
            print("\n".join(said[-30:]))
    return 1 if bad else 0


if __name__ == "__main__":
    if len(sys.argv) > 2 and not sys.argv[1].startswith("-"):
        _fuzz(sys.argv[1], sys.argv[2], sys.argv[3:])
    sys.exit(main())
