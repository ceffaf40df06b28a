"""An effect of a package that is installed beside this one: searched, estimated and simulated like
ours; nothing comes from the current folder."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from bench import ROOT
from rov_ident.discrepancy.held_out import windows
from rov_ident.discrepancy.hypothesis import Hypothesis
from rov_ident.discrepancy.windowed_problem import WindowedProblem
from rov_ident.effects import EFFECTS
from rov_ident.effects.base import Effect, EffectParameter
from rov_ident.effects.checks import faults
from rov_ident.sampling.raw_streams import gather
from rov_ident.simulation.virtual_sensors import Suite, dive

PAGE = (ROOT / "docs" / "own-effects.md").read_text()

USE = """
import json
import numpy as np
from bench import HEAVY
from rov_ident import config as configuration
from rov_ident.core import jit
from rov_ident.discrepancy.hypothesis import Hypothesis, units
from rov_ident.effects import EFFECTS, compiled
from rov_ident.simulation.open_loop import simulate

jit.interpret()  # another set of effects would compile all kernels once more
today = configuration.to_parameters(configuration.load(HEAVY))
t, ahead = np.arange(0.0, 1.0, 0.05), np.zeros((20, 6))
ahead[:, 0] = 40.0
rolled = {}
for ratio in (0.0, 0.05):
    effects = {"propeller_reaction": {"ratio": ratio}}
    config = configuration.from_parameters(today | {"effects": effects})
    truth = simulate(config.dynamics, t, ahead, effects=compiled(config.effects))
    rolled[ratio] = float(np.abs(truth.nu[:, 3]).max())
h = Hypothesis(configuration.from_parameters(today), {})
print(json.dumps({
    "rolled": list(rolled.values()),
    "estimated": config.effect_names,
    "searched": units(EFFECTS["propeller_reaction"], h, ("amplitude",)),
}))
"""


def block(language):
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.M | re.S)[0]


def python(code, *arguments, cwd, path):
    """What Python printed, run in a folder with what is installed in another."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    environment.pop("NUMBA_CACHE_DIR", None)  # kernels depend on what is installed
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=cwd, env=environment, capture_output=True, text=True,
    )  # fmt: skip


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder into which pip put the package of the documentation, built from its two files."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("installed")
    (source / "pyproject.toml").write_text(block("toml"))
    (source / "propeller_reaction.py").write_text(block("python"))
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps")
    more = ("--no-build-isolation", "--disable-pip-version-check", "--target", target, source)
    subprocess.run([*pip, *more], check=True, cwd=source)
    return target


def test_it_is_simulated_estimated_and_searched(installed):
    """Like an effect of ours: its equation acts, a configuration with it is estimated, and the
    search has it among what a model may lack."""
    done = python(USE, cwd="/", path=(installed, ROOT))
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    still, rolled = said["rolled"]
    assert still < 1e-3 < 0.05 < rolled
    assert said["estimated"] == ["propeller_reaction.ratio"]
    assert said["searched"] == [[["propeller_reaction", "ratio"]]]


LIST = "from rov_ident.effects import EFFECTS; print('propeller_reaction' in EFFECTS)"


@pytest.mark.parametrize("null", [0.0, 1.0])
def test_what_changes_the_rigid_body_need_not_add_to_it(null, monkeypatch, heavy):
    """A factor of the mass, which does nothing at one, was fitted as if at zero."""

    def body(base, factor):
        return dataclasses.replace(base, mass=base.mass * (factor + 1.0 - null))

    parameter = EffectParameter("factor", "1", "of the mass", null, null - 0.5, null + 1.0, 0.1)
    flooded = Effect(
        place="wrench", summary="It took in water.", source="none", manoeuvre="none",
        name="flooded", parameters=(parameter,), body=body,
    )  # fmt: skip
    monkeypatch.setitem(EFFECTS, "flooded", flooded)
    lean = Suite(odometry_rate=10.0, imu_rate=0.0)
    messages = dive(heavy, "steps", 20.0, lean, 1).messages
    streams = gather(((role, message) for _, role, message in messages), heavy)
    problem = WindowedProblem(streams, windows(0.0, 20.0))
    key = ("flooded", "factor")
    h = Hypothesis(heavy, {key: null})
    motion = problem.motion(h, problem.measured_starts())
    column = problem.columns(h, motion, [key])[:, :, 0]
    mass = problem.of_rigid_body(heavy.model.body, motion)[:, :, 0]
    np.testing.assert_allclose(column, heavy.model.body.mass * mass, atol=1e-6 * abs(mass).max())


def test_nothing_is_taken_from_the_current_folder(installed):
    """Not even where Python itself would look for modules there."""
    assert python(LIST, cwd=installed, path=(ROOT,)).stdout == "False\n"
    assert python(LIST, cwd="/", path=(installed, ROOT)).stdout == "True\n"


def test_ours_pass_as_well():
    """What is asked of an effect that was written elsewhere is asked of none without reason."""
    assert {name: fault for name, e in EFFECTS.items() if (fault := faults(e))} == {}


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("1 / 0", "cannot be loaded (ZeroDivisionError"),
        ("EFFECT = 3", "is no rov_ident.effects.base.Effect"),
        (
            "from rov_ident.effects.base import Effect\n"
            "EFFECT = Effect(place='wrench', summary='', manoeuvre='', source='')",
            "must have exactly one of",
        ),
        ("raise SystemExit(3)", "cannot be loaded (SystemExit: 3)"),
        (block("python").replace("out[3]", "out[6]"), "fails in its wrench (IndexError"),
        (block("python").replace("position, nu", "nu"), "fails in its wrench (TypeError"),
        (block("python").replace("@kernel", ""), "must have a kernel as its wrench"),
        (block("python").replace('"wrench"', '"thrust"'), "must have one of input, motion, wrench"),
        (
            block("python").replace("out[3] +=", "out[3] ="),
            "must do nothing at its nulls, but its wrench does",
        ),
        (block("python").replace("p[0] *", "p[0] / 0.0 *"), "gives numbers that are not finite"),
        (block("python").replace("out[3] +=", "thrust[0] ="), "fails in its wrench (ValueError"),
        (
            block("python").replace("=wrench,", "=None, late=lambda ratio: 0.1,"),
            "must do nothing at its nulls, but its late does",
        ),
        (block("python").replace('"ratio"', '"my ratio"'), "name of its parameter 'my ratio'"),
        (block("python").replace("0.02),)", "0.02))"), "must have a tuple of EffectParameter"),
        (block("python").replace("0.02),)", "0.02),) * 2"), "a name of its own for each"),
        (
            block("python").replace("=wrench,", "=None, water=lambda ratio: (ratio, 0.0),"),
            "must return numbers of the shape (3,) from its water",
        ),
        (
            block("python").replace(
                "=wrench,", '=wrench, of_thrusters=lambda of: [{"gain": 0.5}],'
            ),
            "must return only parameters of its own from its of_thrusters",
        ),
    ],
)
def test_one_that_cannot_be_used_is_said(installed, tmp_path, code, words):
    broken = shutil.copytree(installed, tmp_path / "broken")
    (broken / "propeller_reaction.py").write_text(code)
    shutil.rmtree(broken / "__pycache__", ignore_errors=True)
    run = "from rov_ident.cli import main; raise SystemExit(main(['plan', '--config', 'none']))"
    done = python(run, cwd="/", path=(broken, ROOT))
    assert done.returncode == 2 and words in done.stderr
    assert "propeller-reaction" in done.stderr and "uninstall" in done.stderr
