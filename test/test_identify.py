"""`rov-ident identify`: from dives to a judged model, or a reason why not and what to fly."""

import dataclasses
import json
import math
import re
from functools import partial
from types import SimpleNamespace

import pytest
from program import few_manoeuvres, run

import rov_ident as ri
from bench import ROOT
from rov_ident.api import identification
from rov_ident.cli.program import main
from rov_ident.discrepancy.explain import Explanation
from rov_ident.discrepancy.extension import Kept
from rov_ident.discrepancy.hypothesis import Hypothesis
from rov_ident.estimation import consistency
from rov_ident.offline import archive
from rov_ident.offline.batch_fit import validation
from rov_ident.offline.prediction_error import open_loop
from rov_ident.reports.table import number

VEHICLE, WRONG = (ROOT / "config" / f"bluerov2_heavy{name}.yaml" for name in ("", "_demo"))


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    """The next manoeuvre that is planned lasts 10 s, not a minute: a sixth of the search."""
    monkeypatch.setattr(identification, "plan", partial(ri.plan, duration=10.0))
    few_manoeuvres(monkeypatch)


@pytest.fixture(scope="module")
def dives(tmp_path_factory):
    """Two dives, the second the shorter one, and one at rest."""
    folder = tmp_path_factory.mktemp("dives")
    for name, manoeuvre, duration in (
        ("long", "steps", 30.0),
        ("short", "steps", 20.0),
        ("rest", "rest", 12.0),
    ):
        made = ri.simulate(VEHICLE, manoeuvre=manoeuvre, duration=duration, seed=len(name))
        made.save(folder / f"{name}.mcap")
    return folder


def test_dives_to_a_model_that_is_judged(tmp_path, dives):
    paths = [dives / f"{name}.mcap" for name in ("long", "short", "rest")]
    done = run("identify", *paths, "--config", WRONG, "--out", tmp_path / "found")
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "found" / "result.json").read_text())
    assert result["judge"] == "short.mcap"
    assert result["left_out"].keys() == {"rest.mcap"}
    assert [bag["file"] for bag in result["fit"]["provenance"]["bags"]] == ["long.mcap"]
    assert all(row["after"] < 0.5 * row["before"] for row in result["rmse"].values())
    # what is judged is what is saved
    given, saved = ri.load(WRONG), ri.load(tmp_path / "found" / "extended.yaml")
    with archive.opened([dives / "short.mcap"], given) as judge:
        after = open_loop(judge.as_read_by(saved, given), saved)
        told = validation(judge.bags, open_loop(judge, given), after)
    for name, row in result["rmse"].items():
        assert row["before"] == pytest.approx(told["rmse_before"][name])
        assert row["after"] == pytest.approx(told["rmse"][name], rel=1e-3)
    truth, found = ri.load(VEHICLE), ri.load(tmp_path / "found" / "extended.yaml")
    for name in ("X_udot", "Y_vv", "N_rr"):
        assert found.value(name) == pytest.approx(truth.value(name), rel=0.02)
    page = (tmp_path / "found" / "report.html").read_text()
    # the answer, the coefficients and what to do come before the evidence
    places = [page.index(text) for text in ("falls by", "X_udot", "Fly next", "Measured and sim")]
    assert places == sorted(places)
    assert "Fly next" in done.stdout
    # what is to be changed is what was written, and what it gains is told once
    (box,) = re.findall("<pre>(.*?)</pre>", page, re.DOTALL)
    lines = {line.split("#")[0].strip() for line in box.splitlines()}
    changed = [name for name in found.model.names if found.value(name) != given.value(name)]
    assert len(changed) > 5
    assert {f"{name}: {number(found.value(name), 4)}" for name in changed} <= lines
    assert all(line.find("#") < 60 for line in box.splitlines() if "[" not in line)
    assert page.count("Is it good now?") == 1 and "What it gains" not in page


def test_a_dive_at_rest_is_refused_with_a_manoeuvre(tmp_path, dives):
    out = tmp_path / "found"
    done = run("identify", dives / "rest.mcap", "--config", WRONG, "--out", out)
    assert done.returncode == 2
    assert "no dive is fit" in done.stderr and "fly instead: " in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not out.exists()


def test_the_folder_may_have_any_name(tmp_path, monkeypatch):
    """Also one with a dot, or with what is the ending of a file elsewhere."""

    class Found(identification.Identification):
        fit = SimpleNamespace(save_config=lambda path: path.write_text(""))
        page = to_json = table = lambda self: ""
        sentence, advice = "", ()

        def __init__(self):
            pass

    monkeypatch.setattr(identification, "identify", lambda *_, **__: Found())
    for name in ("tank_2026.11", "run.json"):
        out = tmp_path / name
        assert main(["identify", "dive.mcap", "--config", str(VEHICLE), "--out", str(out)]) == 0
        assert {path.name for path in out.iterdir()} == {
            "report.html", "result.json", "extended.yaml",
        }  # fmt: skip


def test_what_is_missing_is_said_before_any_dive_is_read(dives):
    def progress(*_):
        raise AssertionError("a dive is read")

    with pytest.raises(ri.UserError, match="no bag was given"):
        ri.identify([], WRONG, progress=progress)
    with pytest.raises(ri.UserError, match="gone.mcap cannot be read"):
        ri.identify(dives / "long.mcap", WRONG, validate="gone.mcap", progress=progress)


def test_a_dive_given_twice_counts_once(dives, tmp_path):
    """It would be judged by itself, or nothing be left to fit."""
    copy = tmp_path / "copy.mcap"
    copy.write_bytes((dives / "rest.mcap").read_bytes())
    with pytest.raises(ri.UserError, match="no dive is fit.* rest.mcap: ") as refused:
        ri.identify([dives / "rest.mcap", copy], WRONG)
    assert "copy.mcap" not in str(refused.value)


def test_a_dive_to_validate_on_is_held_back_by_whatever_name(dives, tmp_path, monkeypatch):
    """Of a single dive it had left "no bag", a copy had been fitted as well."""
    long, short, copy = dives / "long.mcap", dives / "short.mcap", tmp_path / "copy.mcap"
    copy.write_bytes(long.read_bytes())
    usable = SimpleNamespace(usable=True, record=SimpleNamespace(samples=None))
    monkeypatch.setattr(identification, "check", lambda *_, **__: usable)
    monkeypatch.setattr(identification, "is_without_velocity", lambda _: True)
    asked = []

    def fit(bags, *_, validate, progress):
        asked.append((bags, validate))
        raise InterruptedError

    monkeypatch.setattr(identification, "fit_bags", fit)
    for judge in (long, copy):
        with pytest.raises(ri.UserError, match=r"long.mcap is the only dive to fit.*--validate"):
            ri.identify(long, WRONG, validate=judge)
        with pytest.raises(InterruptedError):
            ri.identify([long, short], WRONG, validate=judge)
    assert asked == [([short], long)] * 2


@pytest.mark.parametrize("agree", [True, False])
def test_a_fit_that_the_data_contradict_is_doubted_in_the_headline(dives, agree):
    fit = ri.fit(dives / "short.mcap", WRONG, "ls")
    failed = consistency.Test("open loop: w", 1.0 if agree else 2.0, 1.05, "w is predicted worse")
    fit = dataclasses.replace(
        fit, consistency=consistency.Consistency((failed,)), notes=("has not settled",)
    )
    errors = {
        "rmse_before": {"v": 0.2, "w": 0.2, "q": 0.2, "r": 0.2},
        "rmse": {"v": 0.1, "w": 0.1, "q": 0.3, "r": 0.2},
    }
    flown = SimpleNamespace(sentence="swing: X_u to 1 N s/m; in 1 m", manoeuvre="swing", extent="")
    found = identification.Identification(fit, None, (), {}, "", flown, errors, fit.notes)
    head = found.page().partition("<h2>")[0]
    assert ("Data and model disagree" in head and "w is predicted worse" in head) != agree
    assert ("not to be relied on" in found.advice[-1]) != agree
    assert "(but q worse)" in found.advice[-1]
    # what a manoeuvre would tell supposes that the model is right
    assert ("X_u to 1 N s/m" in " ".join(found.advice)) == agree
    assert "Fly next: swing" in " ".join(found.advice)
    assert "has not settled" in found.page()


def test_a_model_that_diverges_on_the_dive_held_back_is_not_recommended(dives):
    fit = ri.fit(dives / "long.mcap", WRONG, "ls")
    judged = {
        "rmse_before": {"u": 0.2, "v": 0.2, "p": None},
        "rmse": {"u": math.inf, "v": math.inf, "p": None},
        "bags": [{"file": "short.mcap"}],
    }
    fit = dataclasses.replace(fit, more=fit.more | {"validation": judged})
    assert "On short.mcap, the 10 s prediction diverges." in fit.sentence
    assert [row[2] for row in fit.table().parts[1].rows] == ["inf", "inf", ""]
    assert json.loads(fit.to_json())["validation"]["rmse"] == dict.fromkeys("uvp")
    found = identification.Identification(fit, None, (), {}, "short.mcap", None, judged)
    assert "the 10 s prediction diverges" in found.sentence
    assert found.advice[-1].startswith("Keep the configuration")
    assert json.loads(found.to_json())["rmse"]["u"] == {"before": 0.2, "after": None}


@dataclasses.dataclass(frozen=True)
class Findings:
    notes: tuple


@pytest.mark.parametrize("used", [True, False])
def test_one_configuration_is_called_extended(used):
    """That of the fit, which is written; explain's own is at most where the fit starts."""
    notes = ("another", Kept((), None).note, Kept(("Y",), Hypothesis(None, {})).note)
    found = Explanation(Findings(notes), None, None, None, None, {}, ())
    said = identification._with_start_notes(found, used).findings.notes
    assert said[0] == "another" and "extended" not in " ".join(said)
    assert len(said) == (3 if used else 1)
    assert all("the configuration that the fit starts from" in note for note in said[1:])
