"""Nothing that is read is run, nothing is written elsewhere, nodes do what their policy says."""

import ast
import math
import os
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from importlib.metadata import distributions, requires
from pathlib import Path

import numpy as np
import pytest
import rclpy
import rclpy.node
from diagnostic_msgs.msg import DiagnosticArray
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from tiers import more

from bench import HEAVY, ROOT
from bench.studies import fuzz
from rov_ident import config
from rov_ident.config import PARAMETERS
from rov_ident.core.errors import UserError
from rov_ident.io.write_messages import write_messages
from rov_ident.nodes.common import LATCHED

SOURCES = sorted((ROOT / "rov_ident").rglob("*.py")) + sorted((ROOT / "launch").glob("*.py"))

# Modules that turn bytes into objects of their choice, or run what they are told.
FORBIDDEN_MODULES = {
    "pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "code", "runpy",
    "ctypes", "pty", "telnetlib", "xmlrpc",
}  # fmt: skip
# What is read there comes from a fork of the same process, by a pipe that nobody else has.
FROM_ITSELF = {("forks.py", "pickle")}
FORBIDDEN_CALLS = {
    "eval", "exec", "compile", "__import__", "execfile", "system", "popen",
    "mktemp", "loadtxt", "genfromtxt",
    "fromfile", "memmap", "numexpr",
}  # fmt: skip


def problems(path, text):
    """What a source file must not hold, with its lines."""
    found = []
    for node in ast.walk(ast.parse(text)):
        where = f"{path}:{getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.Import):
            names = [alias.name.partition(".")[0] for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [(node.module or "").partition(".")[0]]
        else:
            names = []
        names = [name for name in names if (Path(path).name, name) not in FROM_ITSELF]
        found += [f"{where}: import {name}" for name in names if name in FORBIDDEN_MODULES]
        if not isinstance(node, ast.Call):
            continue
        function = node.func
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        owner = getattr(getattr(function, "value", None), "id", "")
        words = {word.arg: word.value for word in node.keywords}
        if name in FORBIDDEN_CALLS and owner != "re":
            found.append(f"{where}: {name}")
        if owner in ("np", "numpy") and name == "load":
            allow = words.get("allow_pickle")
            if not (isinstance(allow, ast.Constant) and allow.value is False):
                found.append(f"{where}: np.load without allow_pickle=False")
        if owner == "yaml" and "load" in name and Path(path).name != "yaml_file.py":
            found.append(f"{where}: YAML is read by core/yaml_file.py alone")
        if isinstance(words.get("shell"), ast.Constant) and words["shell"].value:
            found.append(f"{where}: shell")
    return found


def test_nothing_that_is_read_is_run():
    assert len(SOURCES) > 50
    found = [problem for path in SOURCES for problem in problems(path, path.read_text())]
    assert found == []


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from marshal import loads",
        "eval('1')",
        "np.load(f)",
        "np.load(f, allow_pickle=True)",
        "yaml.load(f)",
        "yaml.load(f, yaml.UnsafeLoader)",
        "yaml.safe_load(f)",
        "yaml.full_load(f)",
        "os.system('ls')",
        "subprocess.run('ls', shell=True)",
    ],
)
def test_the_search_finds_what_it_is_for(text):
    assert len(problems("x", text)) == 1


@pytest.mark.parametrize(
    "tag",
    [
        "!!python/object/apply:os.system ['touch {}']",
        "!!python/name:os.system",
        "!!python/module:os",
        "!!python/object/new:os.system ['touch {}']",
    ],
)
def test_yaml_makes_no_objects(tmp_path, heavy_path, tag):
    made = tmp_path / "made"
    path = tmp_path / "bad.yaml"
    text = heavy_path.read_text()
    path.write_text(text.replace("name: bluerov2_heavy", f"name: {tag.format(made)}", 1))
    with pytest.raises(UserError, match="not valid YAML"):
        config.load(path)
    assert not made.exists()


@pytest.mark.parametrize(
    "name", ["../../escaped", "/tmp/escaped", "a/b", "..", "a\n../b", "~root", ".hidden", "a\0b"]
)
def test_a_vehicle_s_name_leads_nowhere(name):
    safe = config.as_file_name(name)
    assert Path(safe).name == safe
    assert safe not in ("", ".", "..") and safe[0] not in ".~"
    assert "\0" not in safe and "\n" not in safe


def test_a_configuration_does_not_say_where_to_write(tmp_path, heavy_path):
    """A stranger's configuration and bag, explained: all that is new is in the folder asked for."""
    text = heavy_path.read_text().replace("name: bluerov2_heavy", 'name: "../../escaped"', 1)
    stranger, work = tmp_path / "stranger.yaml", tmp_path / "a" / "b"
    work.mkdir(parents=True)
    stranger.write_text(text)
    command = [sys.executable, "-m", "rov_ident", "simulate", "--config", str(stranger)]
    command += ["--manoeuvre", "steps", "--duration", "5", "--out", "dive"]
    done = subprocess.run(command, cwd=work, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert {p for p in tmp_path.rglob("*") if p.is_file()} == {
        stranger, work / "dive" / "dive_0.mcap", work / "dive" / "metadata.yaml",
    }  # fmt: skip


@pytest.fixture
def hostile(tmp_path):
    """A folder with a module of every name that Python or a library may ask for; it says if run."""
    folder, marker = tmp_path / "hostile", tmp_path / "run"
    folder.mkdir()
    installed = {d.metadata["Name"].replace("-", "_").lower() for d in distributions()}
    for name in {*sys.stdlib_module_names, *installed, "yaml", "usercustomize", "rov_ident"}:
        (folder / f"{name}.py").write_text(f"open({str(marker)!r}, 'a').write(__name__ + ' ')")
    (folder / ".numba_config.yaml").write_text(f"cache_dir: {tmp_path / 'kernels'}\n")
    yield folder
    assert not marker.exists(), marker.read_text()
    assert not (tmp_path / "kernels").exists()


def program(name, *arguments, cwd, stdout=None, **variables):
    """As a shell starts it, in a folder."""
    script = Path(sys.executable).with_name(name)
    return subprocess.Popen(
        [script, *map(str, arguments)], cwd=cwd, env={**os.environ, **variables}, text=True,
        stdout=stdout, stderr=subprocess.PIPE,
    )  # fmt: skip


def test_workers_take_no_code_from_the_current_folder(tmp_path, hostile, heavy_path, short_dive):
    bags = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for bag in bags:
        write_messages(bag, short_dive)
    command = ["fit", *bags, "--config", heavy_path, "--estimator", "ls", "--jobs", "2"]
    process = program("rov-ident", *command, cwd=hostile)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 0, said


@pytest.mark.parametrize(
    "words",
    [
        ("import", "--out", "dive.mcap", "--config", fuzz.CORPUS / "configuration/thrusters.yaml",
         fuzz.CORPUS / "log/dive.bin"),
        ("nomoto", fuzz.CORPUS / "zigzag/run.csv", "--order", "1", "--report", "zigzag.html"),
        ("forces", fuzz.CORPUS / "forces/drift.csv", "--report", "forces.html"),
        ("import-model", fuzz.CORPUS / "model/robot.urdf", "--config", HEAVY,
         "--out", "robot.yaml"),
        *more((("plan", "--config", HEAVY, "--duration", "10", "--out", "plan.mcap"),)),
    ],
    ids=lambda words: words[0],
)  # fmt: skip
def test_commands_take_no_code_from_the_current_folder(hostile, words):
    """Those with libraries of their own: for logs, tables, models and pictures."""
    process = program("rov-ident", *words, cwd=hostile, stdout=subprocess.DEVNULL)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 0, said


@pytest.mark.parametrize("name", ["rls_node", "ukf_node", "replay"])
def test_compilers_and_nodes_take_no_code_from_the_current_folder(
    tmp_path, hostile, heavy_path, short_dive, domain, name
):
    """With a cold cache, until the first kernel is there."""
    bag, cache = tmp_path / "dive.mcap", tmp_path / "cache"
    write_messages(bag, short_dive)
    if name == "replay":
        command = ["rov-ident", "replay", bag, "--config", heavy_path, "--rate", "0"]
    else:
        command = [name, "--ros-args", "--params-file", heavy_path]
    process = program(*command, cwd=hostile, ROV_IDENT_CACHE="../cache")
    end = time.monotonic() + 300.0
    while not any(cache.rglob("*.nbi")):
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < end
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=600)


# ------------------------------------------------------------------ parameters


def outside(parameter):
    """Values that a number's declaration forbids."""
    yield math.nan
    yield math.inf
    yield 1e300
    yield "much"
    yield True
    if parameter.lower > -1e20:
        yield parameter.lower - 1.0
    if parameter.upper < 1e20:
        yield parameter.upper + 1.0


@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda p: p.key)
def test_every_number_has_its_range(heavy, parameter):
    if parameter.type is not float:
        with pytest.raises(UserError):
            config.from_parameters(_with(heavy, parameter.key, 1.5j))
        return
    for value in outside(parameter):
        with pytest.raises(UserError, match=parameter.key.replace(".", r"\.")):
            config.from_parameters(_with(heavy, parameter.key, value))


def _with(heavy, key, value):
    document = config.to_parameters(heavy)
    section, _, name = key.rpartition(".")
    place = document
    for part in filter(None, section.split(".")):
        place = place.setdefault(part, {})
    place[name] = value
    return document


# ------------------------------------------------------------------ live


def policy(node):
    """What the policy file allows a node: {kind: full names}."""
    tree = ET.parse(ROOT / "config" / "security_policy.xml")
    profile = tree.find(f".//profile[@node='{node}']")
    allowed = {}
    for section in profile:
        (way,) = section.attrib
        assert section.attrib[way] == "ALLOW"
        names = {(item.text or "").replace("~", f"/{node}") for item in section}
        allowed[way] = {name if name.startswith("/") else f"/{name}" for name in names}
    return allowed


def done_by(graph, name):
    """What a node does, as ``graph``, another node, sees it: {kind: full names}.

    Nothing while its name is unknown: that comes by a topic of its own, after the first others.
    """
    try:
        found = {
            "subscribe": graph.get_subscriber_names_and_types_by_node(name, "/"),
            "publish": graph.get_publisher_names_and_types_by_node(name, "/"),
            "reply": graph.get_service_names_and_types_by_node(name, "/"),
            "request": graph.get_client_names_and_types_by_node(name, "/"),
        }
    except rclpy.node.NodeNameNonExistentError:
        return {}
    return {way: {topic for topic, _ in names} for way, names in found.items()}


OTHERS = {
    "controller_bridge": ["controller_bridge", "--ros-args", "--params-file",
                          str(ROOT / "config" / "bluerov2_heavy.yaml"), "-p",
                          "controller:=/controller", "-r", "coefficients:=/ukf_node/coefficients"],
    "example_controller": ["example_controller", "--ros-args", "--params-file",
                           str(ROOT / "config" / "bluerov2_heavy.yaml"),
                           "-r", "coefficients:=/ukf_node/coefficients"],
    "dashboard": ["dashboard_node", "--ros-args", "-p", "port:=0"],
    "rov_ident_watch": ["rov-ident", "watch"],
}  # fmt: skip


def test_every_node_has_a_policy():
    tree = ET.parse(ROOT / "config" / "security_policy.xml")
    names = {profile.get("node") for profile in tree.iter("profile")}
    assert names == {"rls_node", "ukf_node", *OTHERS}
    assert {enclave.get("path") for enclave in tree.iter("enclave")} == {f"/{n}" for n in names}


@pytest.mark.parametrize("name", OTHERS)
def test_another_node_does_what_its_policy_says(domain, hostile, name):
    """The bridge, the controller, the page and the terminal, beside two estimators.

    They take no code from the current folder either.
    """
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    graph = rclpy.create_node("graph", context=context)
    for estimator in ("rls", "ukf"):
        graph.create_publisher(DiagnosticArray, f"/{estimator}_node/coefficients", LATCHED)
    process = program(*OTHERS[name], cwd=hostile, stdout=subprocess.DEVNULL)
    allowed = {"request": set(), **policy(name)}
    end, done = time.monotonic() + 300.0, {}
    try:
        while done != allowed and time.monotonic() < end:
            time.sleep(0.2)
            assert process.poll() is None, process.stderr.read()
            done = done_by(graph, name)
        assert done == allowed
        time.sleep(1.0)  # nor does it begin anything else
        assert done_by(graph, name) == allowed
    finally:
        process.terminate()
        process.communicate(timeout=600)
        graph.destroy_node()
        rclpy.try_shutdown(context=context)


@pytest.mark.parametrize("estimator", ["rls", "ukf"])
def test_a_node_does_what_its_policy_says(live, estimator):
    """Exactly these topics and services; and no parameter takes a value out of its range."""
    vehicle = live(estimator=estimator)
    name = f"{estimator}_node"
    allowed = {"request": set(), **policy(name)}
    vehicle.until(lambda: done_by(vehicle.node, name) == allowed)
    vehicle.listen(1.0)  # nor does it begin anything else
    assert done_by(vehicle.node, name) == allowed

    changes = [(p.key, value) for p in PARAMETERS if p.live for value in outside(p)]
    assert len(changes) > 15
    changes += [("vehicle.mass", 1.0), ("checkpoint_path", "/etc/passwd"), ("save_path", "/x")]
    request = SetParameters.Request(
        parameters=[Parameter(key, value=value).to_parameter_msg() for key, value in changes]
    )
    results = vehicle.call(SetParameters, "set_parameters", request).results
    accepted = [change for change, r in zip(changes, results, strict=True) if r.successful]
    assert accepted == []
    vehicle.coefficients.clear()
    vehicle.until(lambda: len(vehicle.coefficients) > 2)
    assert np.isfinite(vehicle.values[-1].data).all()


# ------------------------------------------------------------------ locks


@pytest.mark.parametrize("lock", ["demo", "test", "bench", "docs", "audit"])
@pytest.mark.parametrize("version", ["3.10", "3.11", "3.12", "3.13"])
def test_a_lock_has_one_version_with_hashes_for_each_python(lock, version):
    environment = {"python_version": version, "python_full_version": f"{version}.1"}
    text = (ROOT / "requirements" / f"{lock}.txt").read_text()
    locked = {}
    for entry in text.replace("\\\n", " ").splitlines():
        line, *hashes = entry.partition("    # ")[0].split(" --hash=sha256:")
        requirement = Requirement(line)
        if requirement.marker is None or requirement.marker.evaluate(environment):
            assert hashes and requirement.name not in locked
            locked[requirement.name] = str(requirement.specifier).removeprefix("==")
    if lock == "audit":
        assert {"bandit", "pip-audit", "uv"} <= locked.keys()
        return
    for line in requires("rov_ident"):
        requirement = Requirement(line)
        extras = {"demo": ["wheels"]}.get(lock, ["wheels", lock])
        if not requirement.marker or any(
            requirement.marker.evaluate({**environment, "extra": extra}) for extra in extras
        ):
            name = canonicalize_name(requirement.name)
            assert requirement.specifier.contains(locked[name]), requirement
