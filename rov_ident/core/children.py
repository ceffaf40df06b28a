"""Child processes, which import the code of this process, never that of the current folder.

Python looks there first when it is told what to run by `-m` or `-c`, and so does numba for its
settings; but a folder of somebody's records may hold a `yaml.py`.
"""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_ROOT = str(Path(__file__).parents[2])
_NEUTRAL = "/"  # nobody but root writes there
_SAFE = {"PYTHONSAFEPATH": "1"}  # from Python 3.11 on, also where others start the process
_PATHS = (
    "PYTHONPATH", "ROV_IDENT_CACHE", "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
)  # fmt: skip
_CACHES = "_CACHE_DIR"  # how the names of compilers' own folders end


def start(
    *arguments: str, environment: Mapping[str, str] | None = None, **options: Any
) -> "subprocess.Popen[Any]":
    """Python with these arguments, in a neutral folder; ``options`` are those of Popen.

    An interrupt from the terminal does not reach it.
    """
    variables = os.environ | _SAFE | dict(environment or {})
    for name, value in variables.items():
        if name in _PATHS or name.endswith(_CACHES):  # relative: those of another folder
            parts = filter(None, value.split(os.pathsep))
            variables[name] = os.pathsep.join(map(os.path.abspath, parts))
    # behind all others: where this package is not installed
    path = filter(None, (variables.get("PYTHONPATH"), _ROOT))
    variables["PYTHONPATH"] = os.pathsep.join(path)
    return subprocess.Popen(
        [sys.executable, *arguments], env=variables, cwd=_NEUTRAL, start_new_session=True, **options
    )


@contextmanager
def environment(ours: Mapping[str, str] = _SAFE) -> Iterator[None]:
    """Set what of ``ours`` is not set, within this context; by default what makes the processes
    safe that a pool of workers starts."""
    added = {name: value for name, value in ours.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)
