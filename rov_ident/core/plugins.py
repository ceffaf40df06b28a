"""What installed packages bring to this one, through entry points of :data:`GROUP`.

Only what is installed counts: a package that lies in the current folder is not looked at, wherever
Python itself would look, as that may be a folder of somebody's records.
"""

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rov_ident.core.errors import UserError

GROUP = "rov_ident.effects"


@cache
def installed() -> tuple[tuple[str, EntryPoint], ...]:
    """The entry points and the packages (of the folder that comes first) that bring them."""
    found: dict[str, list[tuple[str, EntryPoint]]] = {}
    for package in distributions(path=_safe_search_path()):
        if GROUP not in (package.read_text("entry_points.txt") or ""):
            continue
        name = package.metadata["Name"]
        points = [(name, point) for point in package.entry_points if point.group == GROUP]
        found.setdefault(re.sub(r"[-_.]+", "-", name).lower(), points)
    return tuple(sorted(pair for of in found.values() for pair in of))


def loaded(package: str, point: EntryPoint) -> Any:
    """What an entry point names. UserError if it cannot be imported."""
    try:
        with _without_current_folder():
            return point.load()
    except (Exception, SystemExit) as error:  # it is code of others
        raise UserError(
            f"the effect {point.name} of the installed package {package} cannot be loaded "
            f"({type(error).__name__}: {error}): mend or uninstall that package"
        ) from error


def sources() -> Iterator[bytes]:
    """All Python files of the packages that bring something: compiled kernels depend on them."""
    for module in sorted({point.module.partition(".")[0] for _, point in installed()}):
        with _without_current_folder():
            spec = find_spec(module)
        if spec is None:
            continue
        folders = [Path(f) for f in spec.submodule_search_locations or ()]
        files = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
        for path in files or ([Path(spec.origin)] if spec.origin else []):
            yield path.read_bytes()


def _safe_search_path() -> list[str]:
    """Where Python looks for modules, but for the current folder."""
    try:
        here = os.getcwd()
    except OSError:  # it is gone
        return [part for part in sys.path if part]
    return [part for part in sys.path if part and os.path.realpath(part) != os.path.realpath(here)]


@contextmanager
def _without_current_folder() -> Iterator[None]:
    before = sys.path[:]
    sys.path[:] = _safe_search_path()
    try:
        yield
    finally:
        sys.path[:] = before
