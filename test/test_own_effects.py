"""An effect of a package that is installed beside this one: searched, estimated and simulated like
ours; nothing comes from the current folder."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "own-effects.md").read_text()

USE = """
import json, sys
import rov_ident as ri
from bench import HEAVY

folder = sys.argv[1]
today = ri.config.to_parameters(ri.load(HEAVY))
true = ri.config.from_parameters(today | {"effects": {"propeller_reaction": {"ratio": 0.05}}})
bag = folder + "/dive.mcap"
ri.simulate(true, manoeuvre="steps", duration=60.0, seed=1).save(bag)
explanation = ri.explain(bag, HEAVY)
explanation.save(folder + "/extended.yaml")
extended = ri.load(folder + "/extended.yaml")
fit = ri.fit(bag, folder + "/extended.yaml", estimator="rls")
print(json.dumps({
    "effects": json.loads(explanation.to_json())["effects"],
    "extended": extended.effects,
    "fit": json.loads(fit.to_json())["coefficients"],
}))
"""


def block(language):
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.M | re.S)[0]


def python(code, *arguments, cwd, path):
    """What Python printed, run in a folder with what is installed in another."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
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


@pytest.mark.timeout(900)  # another set of effects compiles all kernels once
def test_it_is_searched_estimated_and_simulated(installed, tmp_path):
    """Hidden in a simulated dive, it is named first, for sure, with its true value, and followed by
    a filter from what was saved."""
    done = python(USE, tmp_path, cwd=tmp_path, path=(installed, ROOT))
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    found = said["effects"][0]
    assert found["effect"] == "propeller_reaction" and found["separable"]
    estimates = (found["parameters"]["ratio"], said["fit"]["propeller_reaction.ratio"])
    for of in estimates:
        assert abs(of["value"] - 0.05) < 4.0 * of["std"] < 0.02, of
    assert said["extended"]["propeller_reaction"]["ratio"] == found["parameters"]["ratio"]["value"]


LIST = "from rov_ident.effects import EFFECTS; print('propeller_reaction' in EFFECTS)"


def test_nothing_is_taken_from_the_current_folder(installed):
    """Not even where Python itself would look for modules there."""
    assert python(LIST, cwd=installed, path=(ROOT,)).stdout == "False\n"
    assert python(LIST, cwd="/", path=(installed, ROOT)).stdout == "True\n"


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
    ],
)
def test_one_that_cannot_be_used_is_said(installed, tmp_path, code, words):
    broken = shutil.copytree(installed, tmp_path / "broken")
    (broken / "propeller_reaction.py").write_text(code)
    shutil.rmtree(broken / "__pycache__", ignore_errors=True)
    run = "from rov_ident.cli import main; raise SystemExit(main(['coefficients']))"
    done = python(run, cwd="/", path=(broken, ROOT))
    assert done.returncode == 2 and words in done.stderr
    assert "propeller-reaction" in done.stderr and "uninstall" in done.stderr
