"""How kernels are run: read from the cache, compiled, or interpreted."""

import os
import re
import shutil
import subprocess
import sys
import threading
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement

import rov_ident
from rov_ident.config import load
from rov_ident.core import jit
from rov_ident.core.jit import Compiler, interpret, interpreting, kernel, record, stop_interpreting
from rov_ident.estimation.compilation import ensure_compiled

PACKAGE = Path(rov_ident.__file__).parent
ROOT = PACKAGE.parent

_ONLY_RUN = """
import sys
import rov_ident, numba
from rov_ident.core.jit import only_run
level = numba.config.OPT
only_run()
from rov_ident import config
config.load(sys.argv[1]).model.regressor([1.0] * 6, [1.0] * 6)
import rov_ident.nodes.estimator_node, rov_ident.nodes.replay, rov_ident.nodes.watch_terminal
large = "scipy.linalg", "scipy.optimize", "scipy.special"
assert not [name for name in sys.modules if name.startswith(large)]
assert numba.config.OPT == level == 3
import scipy.linalg.cython_blas
"""


def test_who_only_runs_kernels_loads_no_linear_algebra(heavy_path):
    """A node does no more. Whoever needs it can load it later."""
    subprocess.run([sys.executable, "-c", _ONLY_RUN, heavy_path], check=True)


@pytest.mark.parametrize("name", ["kernel", "lean", "released", "inner", "reordered"])
def test_a_function_inherits_neither_rounding_nor_counting_from_its_first_caller(name):
    """numba would hand these two down, and the last bits of a fit depend on what ran before it."""
    function = getattr(jit, name)(lambda x: x)
    assert {"fastmath", "_nrt"} <= function.targetoptions.keys()


_WARM = """
import sys
from numba.core import event

class Listener(event.Listener):
    on_end = lambda self, event: None
    on_start = lambda self, event: compiled.append(event.data["dispatcher"].py_func)

compiled = []
event.register("numba:compile", Listener())
from rov_ident import config
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.simulation import virtual_sensors
given = config.load(sys.argv[1], "rls_node")
assert given.with_nuisance.estimate_effects
estimator = OnlineEstimator(given, sys.argv[2])
estimator.follow(m[1:] for m in virtual_sensors.dive(given, "steps", 3.0, seed=1).messages)
estimator.report()
assert estimator.stamp > 0 and not compiled, compiled
"""


@pytest.mark.parametrize("kind", ["rls", "ukf"])
def test_nothing_is_compiled_by_the_second_to_run_it(kind):
    """Each start would take a second more, and memory for good."""
    path = str(ROOT / "config" / "bluerov2_heavy.yaml")
    ensure_compiled(load(path, "rls_node"), kind)
    command = [sys.executable, "-c", _WARM, path, kind]
    subprocess.run(command, capture_output=True)  # whoever is first
    subprocess.run(command, check=True)


POINT = record([("x", "f8"), ("v", "f8", (2,))])


@kernel
def moved(points):
    for k in range(len(points)):
        point = points[k]
        point.x += point.v[0] / (point.v[1] - 1.0)


def test_interpreted_and_compiled_read_the_same_records():
    """Without an error for what is not finite."""
    ways = []
    for begin in (interpret, stop_interpreting):
        begin()
        try:
            points = np.zeros(2, dtype=POINT)
            points["v"] = [[1.0, 3.0], [1.0, 1.0]]
            moved(points)
            ways.append(points["x"].tolist())
        finally:
            stop_interpreting()
    assert ways == [[0.5, np.inf]] * 2
    assert not interpreting()


# ------------------------------------------------------------------ the cache

_WHERE = "from rov_ident.core import jit; print(jit.__file__); print(jit.CACHE)"


@pytest.fixture
def package(tmp_path):
    """A copy of the package, and the function that tells the folder of its compiled kernels."""
    copy = tmp_path / "one" / "rov_ident"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    kept = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    ours = kept | {"ROV_IDENT_CACHE": str(tmp_path / "cache")}

    def folder(before="", copy=copy):
        command = [sys.executable, "-c", before + _WHERE]
        done = subprocess.run(
            command, cwd=tmp_path, env=ours | {"PYTHONPATH": str(copy.parent)},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        where, cache = done.stdout.split()
        assert Path(where).is_relative_to(copy)
        return cache

    return copy, folder


def test_no_stale_kernel_can_run(package):
    """Kernels freeze constants of any module: with another one there is another cache."""
    copy, folder = package
    seen = [folder()]
    assert folder() == seen[0]
    for name in ("model/coefficients.py", "effects/base.py"):
        with (copy / name).open("a") as module:
            module.write("ANOTHER = 1.0\n")
        seen.append(folder())
    for library in ("numba", "numpy"):
        seen.append(folder(f"import {library}; {library}.__version__ += '.1'; "))
    assert len(set(seen)) == len(seen)


def test_a_second_copy_of_the_same_version_has_kernels_of_its_own(package):
    """numba keeps them by path: the mark of the first copy would promise what is not there."""
    copy, folder = package
    another = copy.parents[1] / "two" / "rov_ident"
    shutil.copytree(copy, another)
    assert folder(copy=another) != folder()


# ------------------------------------------------------------------ numba


def test_one_module_knows_numba():
    """Its insides change; `bench/tools/versions.py` is run before setup.py allows another minor."""
    for path in PACKAGE.rglob("*.py"):
        if path != Path(jit.__file__):
            code = path.read_text()
            assert not re.search(r"^\s*(import|from) (numba|llvmlite)|NUMBA_", code, re.M), path


def test_the_minors_of_numba_that_may_be_installed_were_tested():
    given = re.search(r'"(numba[^"]*)"', (ROOT / "setup.py").read_text()).group(1)
    allowed = Requirement(given).specifier
    assert allowed.contains(version("numba"))
    table = (ROOT / "docs" / "trust.md").read_text()
    tested = sorted({int(minor) for minor in re.findall(r"numba 0\.(\d+)\.\d", table)})
    least, most = tested[0], tested[-1]
    assert [m for m in range(40, 100) if allowed.contains(f"0.{m}.0")] == [*range(least, most + 1)]
    for locked in {*(ROOT / "requirements").glob("*.txt")} - {ROOT / "requirements" / "audit.txt"}:
        (pin,) = re.findall(r"^numba==(\S+)", locked.read_text(), re.M)
        assert allowed.contains(pin), locked


# ------------------------------------------------------------------ compiling in another process


def exercise(how):
    if how == "fail":
        sys.exit(3)
    if how == "long":
        time.sleep(60.0)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(jit, "CACHE", tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))


def test_what_one_process_has_compiled_is_compiled_for_all(cache):
    job = Compiler(exercise, "well")
    assert not job.compiled
    assert job.ensure()
    assert job.compiled and Compiler(exercise, "well").compiled
    assert not Compiler(exercise, "fail").compiled


def test_a_compiler_that_fails_leaves_no_mark(cache):
    job = Compiler(exercise, "fail")
    assert not job.ensure()
    assert job.poll() == 3 and not job.compiled


def test_a_compiler_that_is_stopped_ends_and_starts_no_more(cache):
    job, results = Compiler(exercise, "long"), []
    waiting = threading.Thread(target=lambda: results.append(job.ensure()))
    waiting.start()
    while job.poll() is None and job._process is None:
        time.sleep(0.01)
    job.stop()
    waiting.join(120.0)
    assert results == [False]
    job.start()
    assert job.poll() is not None


def test_a_relative_cache_home_is_ignored(tmp_path, monkeypatch):
    """As the XDG standard wants it: else each folder in which one works would get a cache."""
    for name in ("ROV_IDENT_CACHE", "NUMBA_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "cache")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert jit._cache_folder().parent == tmp_path / ".cache" / "rov_ident"


def test_a_cache_that_cannot_be_written_is_told_once_and_leaves_nothing(tmp_path):
    """A file stands where the folder should be: nobody can write there, root neither."""
    blocked, temporary = tmp_path / "blocked", tmp_path / "tmp"
    blocked.write_text("")
    temporary.mkdir()
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    environment |= {"ROV_IDENT_CACHE": str(blocked), "TMPDIR": str(temporary)}
    done = subprocess.run(
        [sys.executable, "-c", "from rov_ident.core import frames, jit; print(jit.CACHE)"],
        env=environment | {"PYTHONPATH": str(PACKAGE.parent)}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(temporary))
    assert done.stderr.count("compiles anew: set ROV_IDENT_CACHE") == 1
    assert len(done.stderr.splitlines()) == 1
    assert list(temporary.iterdir()) == []
