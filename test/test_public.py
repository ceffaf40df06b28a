"""The public face: `import rov_ident as ri`, what it offers, and what it leaves alone."""

import ast
import dataclasses
import errno
import inspect
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import nbclient
import nbformat
import numpy as np
import pytest
from conftest import HEAVY
from matplotlib.figure import Figure
from program import lay_out_shipped
from threadpoolctl import threadpool_info
from tiers import more

import rov_ident as ri
from bench import ROOT
from rov_ident.cli.program import main
from rov_ident.config import dump, from_parameters, to_parameters
from rov_ident.io.write_messages import write_messages

CONTRACT = (
    "load read fit explain check simulate plan compare OnlineEstimator HydrodynamicModel Model "
    "Config Record EFFECTS coefficients UserError __version__"
).split()
FUNCTIONS = sorted(name for name in ri.__all__ if inspect.isfunction(getattr(ri, name)))
HEAVY_MODULES = {"numpy", "scipy", "numba", "matplotlib", "rclpy", "yaml", "rich", "threading"}


# ------------------------------------------------------------------ the list of names


def test_the_face_is_complete():
    assert set(CONTRACT) <= set(ri.__all__)
    assert set(ri.__all__) <= set(dir(ri))
    assert all(getattr(ri, name) is not None for name in ri.__all__)
    assert ri.__version__ == re.search(r'version="(.+)"', (ROOT / "setup.py").read_text())[1]
    assert ri.config.load is not None and ri.consumer.HydrodynamicModel is ri.HydrodynamicModel
    with pytest.raises(AttributeError, match="no attribute 'rubbish'"):
        _ = ri.rubbish


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(ri.__file__).read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {a.asname for node in block.body if isinstance(node, ast.ImportFrom) for a in node.names}
    assert seen == set(ri.__all__) - {"__version__"}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_argument_is_documented(name):
    function = getattr(ri, name)
    doc = inspect.getdoc(function)
    parameters = inspect.signature(function).parameters
    if parameters:
        described, raised = doc.partition("Parameters\n---")[2].partition("Raises\n---")[::2]
        assert "UserError" in raised
    for parameter in parameters:
        assert re.search(rf"^(\w+, )*{parameter}(, \w+)*$", described, re.M), parameter


@pytest.mark.parametrize("name", [n for n in ri.__all__ if inspect.isclass(getattr(ri, n))])
def test_every_class_is_documented(name):
    kind = getattr(ri, name)
    assert len(kind.__doc__) > 20
    assert not kind.__doc__.startswith(f"{name}("), "written by dataclass"
    if kind in (ri.OnlineEstimator, ri.HydrodynamicModel):
        for parameter in list(inspect.signature(kind).parameters):
            assert f"``{parameter}``" in kind.__doc__
        assert "UserError" in kind.__doc__
    for method, value in vars(kind).items():
        if inspect.isfunction(value) and not method.startswith("_") and len(
            inspect.signature(value).parameters
        ) > 1 and kind in (ri.OnlineEstimator, ri.HydrodynamicModel):  # fmt: skip
            assert value.__doc__, method


# ------------------------------------------------------------------ what importing leaves alone

STATE = """
import gc, json, os, signal, sys, time, warnings
def state():
    return [dict(os.environ), [str(signal.getsignal(s)) for s in sorted(signal.valid_signals())],
            list(warnings.filters), sys.path[:], list(sys.meta_path), sys.excepthook,
            sys.getrecursionlimit(), os.listdir("/proc/self/task"), gc.isenabled()]
before, modules, begin = state(), set(sys.modules), time.process_time()
import rov_ident
spent = time.process_time() - begin
after = state()
print(json.dumps([repr(before) == repr(after), sorted(set(sys.modules) - modules), spent]))
"""


def test_importing_changes_nothing_and_takes_no_time():
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    spent = []
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", STATE], env=environment, capture_output=True, text=True,
            check=True, cwd=ROOT,
        )  # fmt: skip
        same, loaded, seconds = json.loads(done.stdout)
        assert same
        assert not {name.partition(".")[0] for name in loaded} & HEAVY_MODULES
        spent.append(seconds)
    assert min(spent) < 0.05  # s of CPU; a shell prompt is felt as late from 0.1 s


USED = """
import json, logging, os, signal, sys
import numpy as np
np.seterr(over="raise")
import matplotlib
matplotlib.rcParams["font.size"] = 13
def state():
    return [dict(os.environ), np.geterr(), dict(matplotlib.rcParams), logging.root.level,
            [str(signal.getsignal(s)) for s in sorted(signal.valid_signals())]]
before = state()
import rov_ident as ri
for name in ri.__all__:
    getattr(ri, name)
assert ri.coefficients()[0].unit
from rov_ident.reports import plots
plots.intervals(["a"], {"b": (np.ones(1), np.ones(1))}, "x").savefig(os.devnull, format="png")
print(json.dumps([repr(a) == repr(b) for a, b in zip(before, state())]))
print("rclpy" in sys.modules)
"""


@pytest.mark.parametrize(
    ("work", "slow"),
    [
        (
            "import rov_ident.api.functions",
            "scipy.signal scipy.stats scipy.ndimage scipy.special matplotlib rclpy",
        ),
        ("import rov_ident.api.simulation, rov_ident.api.start", "rov_ident.discrepancy"),
        ("from rov_ident.cli import program; program._parser()", "numpy numba yaml"),
    ],
)
def test_nothing_is_loaded_that_takes_long_and_is_not_used(work, slow):
    """Every command and every worker would wait for it; the last is all that --help needs."""
    code = f"import sys; {work}; print([m for m in sys.modules if m in sys.argv])"
    done = subprocess.run(
        [sys.executable, "-c", code, *slow.split()], capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


def test_nor_does_loading_every_name():
    done = subprocess.run(
        [sys.executable, "-c", USED], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.split() == ["[true,", *["true,"] * 3, "true]", "False"]


def blas_threads():
    return [
        library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"
    ]


def test_blas_is_limited_within_a_call_and_given_back():
    from rov_ident.core.threads import one_blas_thread

    before = blas_threads()
    assert before
    with one_blas_thread():
        with one_blas_thread():
            assert set(blas_threads()) == {1}
        assert set(blas_threads()) == {1}
    assert blas_threads() == before


def test_the_program_has_one_blas_thread_before_numpy_is_loaded():
    """Said later, threads are there already, and wait at full load."""
    program = (
        "import os, sys; from rov_ident.core.threads import limit_process; limit_process(); "
        "print('numpy' in sys.modules, os.environ['OPENBLAS_NUM_THREADS'])"
    )
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "1"]
    command = [sys.executable, "-c", "import sys, rov_ident.cli; print('numpy' in sys.modules)"]
    assert subprocess.run(command, capture_output=True, text=True).stdout == "False\n"


def test_python_m():
    command = [sys.executable, "-m", "rov_ident", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ri.__version__


# ------------------------------------------------------------------ results


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("public") / "dive.mcap"
    ri.simulate(HEAVY, manoeuvre="steps", duration=40.0, seed=3).save(path)
    return path


@pytest.fixture(scope="module")
def fit(bag):
    return ri.fit(bag, HEAVY, "ls")


@pytest.fixture(scope="module")
def results(bag, fit):
    return {
        "fit": fit,
        "check": ri.check(str(bag), HEAVY),
        "beside": ri.simulate(HEAVY, bag=bag),
        "manoeuvre": ri.simulate(HEAVY, manoeuvre="steps", duration=5.0),
        "plan": ri.plan(HEAVY, duration=10.0),
        "comparison": ri.compare(HEAVY, fit),
    }


def test_a_simulation_beside_a_bag_keeps_its_clock(tmp_path):
    later, path = 10**18, tmp_path / "dive.mcap"
    run = ri.simulate(HEAVY, manoeuvre="steps", duration=10.0, seed=1)
    moved = [(t + later, role, m._replace(stamp=m.stamp + later)) for t, role, m in run.messages]
    write_messages(path, moved)
    stamps = [message.stamp for _, _, message in ri.simulate(HEAVY, bag=path).messages]
    first, last = moved[0][2].stamp, moved[-1][2].stamp
    assert abs(stamps[0] - first) < 500_000_000 and abs(stamps[-1] - last) < 500_000_000


# All are drawn and saved by the same functions (reports/result.py): each ending once, then all.
PICTURES = {".png": b"\x89PNG", ".pdf": b"%PDF", ".html": b"<!doctype"}
KINDS = ["fit", "check", "beside", "manoeuvre", "plan", "comparison"]


@pytest.mark.parametrize(
    ("name", "endings"),
    [
        *((name, [[*PICTURES][i % 3]]) for i, name in enumerate(KINDS)),
        *more(*((name, [*PICTURES]) for name in KINDS)),
    ],
)
def test_a_result_shows_itself(results, name, endings, tmp_path):
    result = results[name]
    assert isinstance(result.plot(), Figure)
    assert str(result) == str(result.table())
    assert "─" in str(result)
    document = json.loads(result.to_json())
    shown = result._repr_html_()
    assert shown.count("<table>") >= 1 and "<svg" in shown and "<script" not in shown
    result.save(tmp_path / "new" / "result.json")
    assert json.loads((tmp_path / "new" / "result.json").read_text()) == document
    for ending in endings:
        result.save(tmp_path / f"result{ending}")
        assert (tmp_path / f"result{ending}").read_bytes().startswith(PICTURES[ending])
    with pytest.raises(ri.UserError, match="is saved as"):
        result.save(tmp_path / "result.docx")
    with pytest.raises(ri.UserError, match="cannot be written"):
        result.save(Path("/proc/none/result.png"))


def test_a_figure_is_not_registered_and_a_notebook_shows_it(results):
    figure = results["comparison"].plot()
    assert figure._repr_png_().startswith(b"\x89PNG")
    if "matplotlib.pyplot" in sys.modules:
        assert not sys.modules["matplotlib.pyplot"].get_fignums()
    assert matplotlib.rcParams["axes.spines.top"] is True


def test_the_command_gives_the_same_fit(bag, fit, tmp_path, capsys):
    path = tmp_path / "fit.json"
    arguments = ["fit", str(bag), "--config", str(HEAVY), "--estimator", "ls", "--json", str(path)]
    assert main([*arguments, "--jobs", "1"]) == 0
    assert path.read_text() == fit.to_json()
    assert str(fit).splitlines()[1:] == capsys.readouterr().out.splitlines()[1:]
    assert "± 95 %" in str(fit)


def test_bags_and_configurations_as_they_come(bag, fit, tmp_path):
    given = ri.load(HEAVY)
    assert ri.load(given) is given
    several = ri.fit([str(bag)], given, "ls", "surge")
    assert np.isclose(several.value("X_uu"), fit.value("X_uu"), rtol=0.05)
    assert several.value("Y_vv") == given.value("Y_vv")
    fit.save(tmp_path / "fitted.yaml")
    again = ri.load(tmp_path / "fitted.yaml")
    assert [again.value(name) for name in fit.names] == fit.values.tolist()
    assert ri.HydrodynamicModel(tmp_path / "fitted.yaml").M.shape == (6, 6)
    record = ri.read(bag, given)
    assert record.duration == pytest.approx(40.0, abs=0.2)
    estimator = ri.OnlineEstimator(HEAVY, "rls")
    estimator.take(record.samples)
    assert estimator.report().names == fit.names


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda bag: ri.fit(bag, HEAVY, "ols"), "there is no estimator 'ols'"),
        (lambda bag: ri.fit(bag, HEAVY, "ls", "warp"), "no channel 'warp'"),
        (lambda bag: ri.fit(bag, HEAVY, "rls", "surge"), "channels .* no meaning"),
        (lambda bag: ri.fit(bag, HEAVY, "ml", weighted=False), "weighted .* no meaning"),
        (lambda bag: ri.fit("nowhere.mcap", HEAVY, "ls"), "nowhere.mcap"),
        (lambda bag: ri.load("nowhere.yaml"), "nowhere.yaml"),
        (lambda bag: ri.simulate(HEAVY), "either a bag or a manoeuvre"),
        (lambda bag: ri.simulate(HEAVY, manoeuvre="steps", duration=-1.0), "must be positive"),
        (lambda bag: ri.plan(HEAVY, tank=(6.0, 6.0)), "must be three lengths"),
        (lambda bag: ri.plan(HEAVY, duration=float("nan")), "10 s are the least"),
        (lambda bag: ri.plan(HEAVY, tank="666"), "must be three lengths"),
        (lambda bag: ri.plan(HEAVY, tank=3.0), "must be three lengths"),
        (lambda bag: ri.plan(HEAVY, tank=(6.0, -6.0, 2.0)), "must be three lengths"),
        (lambda bag: ri.fit(None, HEAVY), "None is no path, nor several"),
        (lambda bag: ri.fit([None], HEAVY), "None is no path"),
        (lambda bag: ri.fit(bag, None), "None is no configuration"),
        (lambda bag: ri.fit(bag, HEAVY, "ls", jobs=0), "jobs is 0"),
        (lambda bag: ri.fit(bag, HEAVY, "ls", jobs=-1), "jobs is -1"),
        (lambda bag: ri.fit(bag, HEAVY, "ls", jobs=1.5), "jobs is 1.5"),
        (lambda bag: ri.fit(bag, HEAVY, "ukf", reference=-5), "reference is -5 s"),
        (lambda bag: ri.simulate(HEAVY, manoeuvre="steps", seed=-1), "seed is -1"),
        (lambda bag: ri.OnlineEstimator(HEAVY, "ols"), "there is no estimator 'ols'"),
        (lambda bag: ri.compare(HEAVY, bag), "no JSON of a result"),
        (lambda bag: ri.compare(HEAVY, "nowhere.json"), "nowhere.json cannot be read"),
        (lambda bag: ri.fit(bag, HEAVY, ["ml"]), r"estimator is \['ml'\], but must be a name"),
        (lambda bag: ri.fit(bag, HEAVY, "ls", 3), "channels is 3, but must be text, such as"),
        (lambda bag: ri.fit(bag, HEAVY, "ls", ["surge", 3]), "channels is 3, but must be text"),
        (lambda bag: ri.fit(bag, HEAVY, "ls", reference="5"), "reference is '5', but must be a n"),
        (lambda bag: ri.fit(bag, HEAVY, prior_from=3), "3 is no path"),
        (lambda bag: ri.simulate(HEAVY, manoeuvre="steps", duration="10"), "duration is '10', but"),
        (lambda bag: ri.simulate(HEAVY, bag=bag, channels=3), "channels is 3, but must be text"),
        (lambda bag: ri.simulate(HEAVY, manoeuvre=["steps"]), "manoeuvre is .*, but must be text"),
        (lambda bag: ri.simulate(HEAVY, manoeuvre="rest", sensors={}), "must be a rov_ident.Suite"),
        (lambda bag: ri.plan(HEAVY, duration="60"), "duration is '60', but must be a number"),
        (lambda bag: ri.plan(HEAVY, thrust=None), "thrust is None, but must be a number"),
        (lambda bag: ri.init(3), "3 is no path"),
        (lambda bag: ri.init(vehicle=["bluerov2"]), "there is no vehicle"),
        (lambda bag: ri.init().save(None), "path is None, but must be a path"),
        (lambda bag: ri.OnlineEstimator(HEAVY, ["rls"]), "kind is .*, but must be a name"),
        (lambda bag: ri.HydrodynamicModel(HEAVY, "2"), "hold_after is '2', but must be a number"),
    ],
)
def test_what_the_caller_can_mend_is_a_user_error(bag, call, message):
    with pytest.raises(ri.UserError, match=message):
        call(bag)


def test_no_path_is_no_place_for_a_result(fit):
    for save in (fit.save, fit.save_config):
        with pytest.raises(ri.UserError, match="path is None, but must be a path"):
            save(None)


def test_a_name_that_a_result_does_not_have_is_refused(fit):
    with pytest.raises(ri.UserError, match="there is no 'foo' in this result: use X_udot"):
        fit.value("foo")


def test_a_picture_is_written_whole_or_not_at_all(tmp_path, fit, monkeypatch):
    """Of a disk that is full, what was there stays; and a bag is no picture to replace."""
    path, dive = tmp_path / "p.png", tmp_path / "dive.png"
    fit.save(path)
    before = path.read_bytes()

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(ri.UserError, match="No space left"):
            fit.save(path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
    dive.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(ri.UserError, match="there is a bag"):
        fit.save(dive)


# ------------------------------------------------------------------ comparison


def document(**entries):
    return json.dumps(
        {"coefficients": {n: {"value": v, "std": s, "unit": u} for n, (v, s, u) in entries.items()}}
    )


def test_a_comparison_is_in_standard_deviations_of_the_difference(tmp_path, capsys):
    a, b, out = tmp_path / "a.json", tmp_path / "b.json", tmp_path / "c.json"
    a.write_text(document(X_u=(-10.0, 0.3, "N s/m"), Y_v=(-5.0, 1.0, "N s/m"), Z_w=(1, 1, "N s/m")))
    b.write_text(document(X_u=(-12.0, 0.4, "N s/m"), Y_v=(-5.5, 1.0, "N s/m"), K_p=(1, 1, "N m s")))
    found = ri.compare(a, b)
    assert found.names == ("X_u", "Y_v")
    assert found.deviations == pytest.approx([-2.0 / 0.5, -0.5 / np.sqrt(2.0)])
    assert found.changed == ("X_u",)
    assert (found.only_a, found.only_b) == (("Z_w",), ("K_p",))
    assert main(["compare", str(a), str(b), "--json", str(out)]) == 0
    assert json.loads(out.read_text()) == json.loads(found.to_json())
    assert "1 of 2 coefficients" in capsys.readouterr().out


def test_values_without_intervals_are_not_judged(tmp_path, capsys):
    given = ri.load(HEAVY)
    name = given.model.names[3]
    dump(given.with_values({name: 1.25 * given.value(name)}), tmp_path / "b.yaml")
    assert main(["compare", str(HEAVY), str(tmp_path / "b.yaml")]) == 0
    shown = capsys.readouterr().out
    assert f"1 of {len(given.model.names)} coefficients differ; neither has intervals" in shown
    assert "fit --json" in shown and "95 % interval of the difference" not in shown
    (row,) = [line for line in shown.splitlines() if name in line]
    assert ("-25.0" if given.value(name) < 0.0 else "+25.0") in row


def test_what_only_one_configuration_has_and_its_body_are_told(tmp_path, fit, capsys):
    given = ri.load(HEAVY)
    changed = to_parameters(given)
    changed["coefficients"].pop("X_udot")
    changed["vehicle"] |= {"mass": 14.0, "cob": [0.0, 0.0, -0.02]}
    dump(from_parameters(changed), tmp_path / "b.yaml")
    assert main(["compare", str(HEAVY), str(tmp_path / "b.yaml")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    n = len(given.model.names) - 1
    assert f"0 of {n} coefficients differ, and so do vehicle.mass, vehicle.cob.z;" in shown
    assert f"Only {HEAVY.name} has X_udot." in shown
    found = ri.compare(HEAVY, tmp_path / "b.yaml")
    assert dict(zip(found.names, found.difference))["vehicle.mass"] == 0.5
    # A fit takes the body as it is: nothing of it is missing there.
    assert not any(name.startswith("vehicle") for name in ri.compare(HEAVY, fit).only_a)


def test_effects_of_configurations_are_compared(tmp_path):
    """With each other, and with what a fit found of them."""
    given = ri.load(HEAVY)
    a, b = (
        dataclasses.replace(given, effects={"thrust_scale": {"scale": scale}})
        for scale in (0.8, 1.2)
    )
    found = ri.compare(a, b)
    assert f"1 of {len(given.model.names) + 1} coefficients differ" in found.sentence
    assert dict(zip(found.names, found.difference))["thrust_scale.scale"] == pytest.approx(0.4)
    path = tmp_path / "fit.json"
    path.write_text(document(X_u=(-13.0, 0.1, "N s/m"), **{"thrust_scale.scale": (1.0, 0.05, "1")}))
    found = ri.compare(a, path)
    assert found.names == ("X_u", "thrust_scale.scale") and found.only_b == ()
    assert found.deviations[1] == pytest.approx(4.0)


def test_intervals_are_those_that_the_results_state(tmp_path):
    """Few data leave wider intervals than the normal distribution's."""
    entries = [{"value": x, "std": 1.0, "unit": "N s/m"} for x in (-10.0, -14.0)]
    for entry in entries:
        entry |= {"lower": entry["value"] - 3.2, "upper": entry["value"] + 3.2}
    paths = [tmp_path / "a.json", tmp_path / "b.json"]
    for path, entry in zip(paths, entries):
        path.write_text(json.dumps({"axes": {"X": {"terms": {"X_u": entry}}}}))
    found = ri.compare(*paths)
    assert found.a_half == pytest.approx([3.2]) and "3.2" in str(found)
    assert found.difference_half == pytest.approx([3.2 * np.sqrt(2.0)])
    assert abs(found.deviations[0]) > 1.96 and found.changed == ()


def test_every_kind_of_result_can_be_compared(tmp_path, fit, results):
    same = ri.compare(fit, fit)
    assert any("count from vehicle.cog" in n for n in same.notes) == ("buoyancy.delta" in fit.names)
    assert same.changed == () and "same data" in same.notes[0]
    assert ri.compare(HEAVY, fit).deviations == pytest.approx(
        (fit.values - [fit.given.value(n) for n in fit.names]) / fit.std
    )
    findings = {
        "retuned": {"changed": {"X_u": {"from": -1.0, "to": -2.0, "std": 0.1, "unit": "N s/m"}}},
        "effects": [
            {
                "effect": "thruster_lag",
                "parameters": {"time_constant": {"value": 0.2, "std": 0.01, "unit": "s"}},
            }
        ],
    }
    path = tmp_path / "findings.json"
    path.write_text(json.dumps(findings))
    assert ri.compare(path, path).names == ("X_u", "thruster_lag.time_constant")
    (tmp_path / "identified").mkdir()  # as `identify` leaves it
    result = json.dumps({"fit": json.loads(fit.to_json()), "explain": findings})
    (tmp_path / "identified" / "result.json").write_text(result)
    found = ri.compare(fit, tmp_path / "identified")
    assert found.names == fit.names and found.changed == () and "same data" in found.notes[0]
    assert found.labels[1] == "identified"
    path.write_text(json.dumps({"order": 1, "K": {"value": 1.0, "std": 0.1, "unit": "1/s"}}))
    assert ri.compare(path, path).names == ("K",)
    path.write_text(json.dumps({"axes": {"X": {"terms": {"X_uu": findings["effects"][0]["parameters"]["time_constant"]}}}}))  # fmt: skip  # noqa: E501
    assert ri.compare(path, path).names == ("X_uu",)


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "3", "{}", "{", '{"coefficients": 3}', '{"coefficients": {}}', "[" * 10_000,
        '{"coefficients": {"X_u": {"value": "a", "std": 1, "unit": "s"}}}',
        '{"coefficients": {"X_u": {"value": 1, "std": -1, "unit": "s"}}}',
        '{"coefficients": {"X_u": {"value": NaN, "std": 1, "unit": "s"}}}',
        '{"effects": 3, "retuned": {"changed": 3}}', '{"retuned": {"changed": {}}, "effects": [3]}',
        '{"axes": {"X": 3}}', '{"provenance": {"bags": [3]}, "axes": 3}',
        document(X_u=(1.0, 1.0, "kg")),
    ],
)  # fmt: skip
def test_bad_files_are_refused_in_a_sentence(tmp_path, capsys, text):
    good, bad = tmp_path / "good.json", tmp_path / "bad.json"
    good.write_text(document(X_u=(-10.0, 0.3, "N s/m")))
    bad.write_text(text)
    assert main(["compare", str(good), str(bad)]) == 2
    assert "bad.json" in capsys.readouterr().err.replace("\n", "")


@pytest.mark.parametrize("thing", [{"X_u": -10.0}, [1.0, 2.0], None])
def test_what_is_no_result_is_not_compared(thing):
    with pytest.raises(ri.UserError, match=f"{type(thing).__name__} is no result: give a Fit"):
        ri.compare(thing, thing)


# ------------------------------------------------------------------ what is written of it


@pytest.mark.slow
def test_the_lines_in_the_readme_run(tmp_path, monkeypatch, capsys):
    lay_out_shipped(tmp_path, 25.0)
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "README.md").read_text()
    code = re.findall(r"^```python\n(.*?)^```", text, re.M | re.S)
    assert len(code) == 1
    exec(compile(code[0], "README.md", "exec"), {})
    assert "± 95 %" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.timeout(900)  # the first use of anything compiles it
@pytest.mark.parametrize("seconds", [25.0, *more(math.inf)])
def test_the_notebook_runs(tmp_path, seconds):
    """In a kernel of its own, from top to bottom, as the reader runs it; with so much of the bag"""
    (tmp_path / "examples").mkdir()
    lay_out_shipped(tmp_path, seconds)
    notebook = nbformat.read(ROOT / "examples" / "first_fit.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "shipped without output"
    where = {"metadata": {"path": str(tmp_path / "examples")}}
    client = nbclient.NotebookClient(notebook, timeout=800, resources=where)
    client.execute()
    outputs = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    assert not [o for o in outputs if o.output_type == "stream" and o.name == "stderr"]
    kinds = [kind for o in outputs for kind in o.get("data", {})]
    assert kinds.count("text/html") >= 2 and kinds.count("image/png") >= 2
    text = "".join(o.text for o in outputs if o.output_type == "stream")
    assert "show nothing that its structure lacks" in text
    assert (tmp_path / "examples" / "out" / "fitted.yaml").exists()
