"""The documentation: every command in it runs, every link of the site leads somewhere."""

import dataclasses
import math
import os
import re
import subprocess
import sys

import program
import pytest
import yaml
from program import lay_out_shipped
from test_inputs import configured
from tiers import more

from bench import ROOT
from rov_ident import config
from rov_ident.cli.program import _commands, _parser
from rov_ident.effects import EFFECTS
from rov_ident.io.topics import _CHOICES

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
FRONT = sorted(ROOT.glob("*.md"))  # README and its like, which are not pages of the site
SOURCES = {
    f"/{path.relative_to(ROOT).as_posix()}"
    for folder in ("rov_ident", "test", "bench", "examples", "launch", "docs")
    for path in (ROOT / folder).rglob("*")
} | {"/setup.py"}


def blocks(path, language):
    """The fenced blocks of a page in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(), re.M | re.S)


@pytest.mark.timeout(1800)  # the first use of anything compiles it
@pytest.mark.parametrize(
    ("name", "seconds"),
    [("tutorial.md", 25.0), *more(("tutorial.md", math.inf), ("tutorial-own-bag.md", math.inf))],
)
def test_every_command_of_a_tutorial_runs(tmp_path, name, seconds):
    """One after the other, as a reader does, with the shipped files, or so much of the bag.

    What is no more than our program is called in this process, where kernels are loaded once.
    """
    lay_out_shipped(tmp_path, seconds)
    script = tmp_path / "bin" / "rov-ident"
    script.parent.mkdir()
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m rov_ident "$@"\n')
    script.chmod(0o755)
    environment = {
        **os.environ,
        "PATH": f"{script.parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
    }
    commands = blocks(DOCS / name, "sh")
    assert len(commands) >= 6
    for command in commands:
        line = command.replace("\\\n", " ")
        if re.fullmatch(r"rov-ident [\w ./=-]+\n", line):
            _, *words = line.split()
            done = program.run(*words, cwd=tmp_path)
        else:
            done = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", command],
                cwd=tmp_path, env=environment, capture_output=True, text=True,
            )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        if "R2" in done.stdout and "fitted" in command:
            scores = [float(x) for x in re.findall(r"│ [uvwpqr] │\s+([\d.-]+) │", done.stdout)]
            assert min(scores[-6:]) > 0.97


def test_every_option_that_is_written_of_exists():
    """In the fenced blocks and tables of all pages and the README, tested or not."""
    known = {name: command.format_help() for name, command in _commands(_parser()).items()}
    for path in [*PAGES, ROOT / "README.md"]:
        for line in re.findall(r"rov-ident ([^`\n]+)", path.read_text()):
            name = line.split()[0]
            if name not in known:
                assert name in ("COMMAND", "--help") or not line.startswith("-"), f"{path}: {line}"
                continue
            for option in re.findall(r"(?<!\S)(--[a-z][a-z-]*)", line):
                assert option in known[name], f"{path.name}: rov-ident {name} has no {option}"


@pytest.mark.parametrize("path", [*PAGES, *FRONT], ids=lambda p: p.name)
def test_every_file_that_is_named_exists(path):
    """Whatever begins with `rov_ident/`, every Python file, and every link (also in a checkout).

    A Python file may be named by the end of its path: `sampler.py` or `sampling/sampler.py`.
    """
    text = path.read_text()
    named = set(re.findall(r"(?<![\w/])rov_ident/[\w./]*\w", text))
    named |= set(re.findall(r"(?<![\w.])[\w/.-]*\w\.py\b", text))
    named |= {f"{m.replace('.', '/')}.py" for m in re.findall(r"python -m (bench\.[\w.]+\w)", text)}
    for name in {name.removeprefix("../") for name in named if "NAME" not in name}:
        assert any(source.endswith(f"/{name}") for source in SOURCES), f"{path.name}: {name}"
    for link in re.findall(r"\]\(([^)#:]+)[#)]", text):
        assert (path.parent / link).exists(), f"{path.name}: {link}"


@pytest.mark.parametrize("path", [*PAGES, ROOT / "README.md"], ids=lambda p: p.name)
def test_the_configurations_in_the_pages_are_read(path):
    """A block of YAML is a whole parameter file, or settings that go into one."""
    for text in blocks(path, "yaml"):
        settings = yaml.safe_load(text) or {}
        if "/**" in settings:
            config.from_parameters(settings["/**"]["ros__parameters"])
        elif set(settings) <= {p.key.split(".")[0] for p in config.PARAMETERS}:
            configured(**settings)


def test_the_guide_to_inputs_names_every_type():
    """In full, or after another of its package: `std_msgs/A`, `B`."""
    text = (DOCS / "inputs.md").read_text()
    for type_name in (*config.schema.ODOMETRY_TYPES, *_CHOICES["wrench"]):
        assert type_name in text or f"`{type_name.partition('/')[2]}`" in text
    for key in (f"`{p.name}`" for p in dataclasses.fields(config.Thrusters)):
        assert key in text or key.strip("`") + ":" in text


def test_the_site_is_built(tmp_path):
    """Strictly: a link to nowhere is an error. Every effect and command has its place."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for name, effect in EFFECTS.items():
        page = (tmp_path / "effects" / f"{name}.html").read_text()
        for parameter in effect.parameters:
            assert f"<code>{parameter.name}</code>" in page
    commands = (tmp_path / "reference" / "commands.html").read_text()
    for name in _commands(_parser()):
        assert f'id="{name}"' in commands
    keys = (tmp_path / "reference" / "parameters.html").read_text()
    for p in config.VEHICLE_PARAMETERS + config.PARAMETERS:
        assert f"<code>{p.key}</code>" in keys
