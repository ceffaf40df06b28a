"""`rov-ident explain` as a command: its three files, its words, and wrong use."""

import dataclasses
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from test_cli_edges import refused, run

import rov_ident as ri
from bench import HEAVY
from bench.simulators.hidden import Conditions, draw
from rov_ident import config as configuration
from rov_ident.core.frames import quaternion_from_euler, quaternion_multiply
from rov_ident.core.messages import ODOMETRY
from rov_ident.discrepancy import report as told
from rov_ident.discrepancy.results import Finding, Findings, Gain, Residual, Together, Value
from rov_ident.effects import EFFECTS
from rov_ident.io.write_messages import write_messages
from rov_ident.simulation.virtual_sensors import dive

FILES = ["extended.yaml", "findings.json", "report.html"]
LEAN = Conditions(duration=60.0, odometry_rate=10.0, imu_rate=50.0)
VOID = {"meta", "br", "img", "link", "hr", "input"}


class Page(HTMLParser):
    """Tags that do not match, ids, references and text of a page."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.references, self.words, self.tags = [], [], [], [], set()
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.handle_startendtag(tag, attributes)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.add(tag)
        for name, value in attributes:
            if name == "id":
                self.ids.append(value)
            elif name in ("src", "href", "xlink:href", "action", "data"):
                self.references.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def case():
    """A minute of well-excited motion; the configuration knows nothing of the thruster lag."""
    return draw(3, ("thruster_lag",), conditions=LEAN)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, case):
    path = tmp_path_factory.mktemp("explain")
    write_messages(path / "dive.mcap", case.messages)
    configuration.dump(case.config, path / "today.yaml")
    return path


def explain(folder, *options, bag="dive.mcap", config="today.yaml", out="new/out"):
    return run(
        "explain", folder / bag, "--config", folder / config, "--out", folder / out, *options
    )


@pytest.fixture(scope="module")
def done(folder):
    return explain(folder)


@pytest.fixture(scope="module")
def page(done, folder):
    return (folder / "new/out/report.html").read_text()


def test_what_sensors_still_contradict_is_left_unexplained(done, folder, case):
    """A compass that is off with the heading: fit and check said that attitude and IMU contradict
    each other, explain named a bias of the IMU, surely, or nothing at all."""
    right = json.loads((folder / "new/out/findings.json").read_text())
    assert right["contradictions"] == []
    compass = []
    for t, role, message in case.messages:
        if role == ODOMETRY:
            w, x, y, z = message.orientation
            heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            error = quaternion_from_euler(0.0, 0.0, 0.3 * np.sin(heading))
            message = message._replace(orientation=quaternion_multiply(error, message.orientation))
        compass.append((t, role, message))
    write_messages(folder / "compass.mcap", compass)
    assert explain(folder, bag="compass.mcap", out="compass").returncode == 0
    findings = json.loads((folder / "compass/findings.json").read_text())
    assert any("attitude" in why for why in findings["contradictions"])
    assert findings["verdict"] == "unexplained"
    assert not any(f["separable"] for f in findings["effects"] + findings["minor"])
    assert all(
        w in (folder / "compass/report.html").read_text() for w in findings["contradictions"]
    )
    fit = ri.fit(folder / "compass.mcap", folder / "compass/extended.yaml", "rls")
    assert {*findings["contradictions"]} <= {t.failure for t in fit.consistency.tests}


def test_files_are_written_whole_into_a_new_folder(done, folder):
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in (folder / "new/out").iterdir()) == FILES


def test_findings_are_those_of_the_contract(done, folder, case):
    found = json.loads((folder / "new/out/findings.json").read_text())
    assert found["verdict"] == "explained"
    assert [e["effect"] for e in found["effects"]] == ["thruster_lag"]
    (effect,) = found["effects"]
    lag = effect["parameters"]["time_constant"]
    truth = case.effects["thruster_lag"]["time_constant"]
    assert abs(lag["value"] - truth) < 4.0 * lag["std"] + 0.02 * truth
    assert set(effect["gain"]) >= {
        "component",
        "rmse_before",
        "rmse_after",
        "percent",
        "low",
        "high",
    }
    for model in ("baseline", "retuned", "extended"):
        assert list(found[model]["rmse"]) == list("uvwpqr")
    assert found["residual"] == []
    (bag,) = found["provenance"]["bags"]
    assert bag["name"] == "dive.mcap" and len(bag["sha256"]) == 64


def test_terminal_tells_the_verdict_the_errors_and_the_effect(done):
    first, *rest = done.stdout.splitlines()
    assert first.startswith("The simulation lacks thruster lag (time constant ")
    assert any("as configured" in line and "extended" in line for line in rest)
    assert any(line.startswith("thruster_lag: ") for line in rest)
    assert "report.html" in done.stderr and "report.html" not in done.stdout


def test_extended_configuration_simulates_better(done, folder, case):
    path = folder / "new/out/extended.yaml"
    extended = configuration.load(path)
    assert set(extended.effects) == {"thruster_lag"}
    comment = [line for line in path.read_text().splitlines() if line.startswith("#")]
    assert "thruster lag" in comment[0] and "dive.mcap" in comment[1]
    score = {}
    for name in ("today.yaml", "new/out/extended.yaml"):
        made = run(
            "simulate", "--bag", folder / "dive.mcap", "--config", folder / name,
            "--out", folder / "simulated.mcap",
        )  # fmt: skip
        assert made.returncode == 0, made.stderr
        numbers = [
            re.findall(r"[\d.]+", line) for line in made.stdout.splitlines() if "m/s" in line
        ]
        score[name] = np.array([float(n[2]) for n in numbers[:3]])
    assert (score["new/out/extended.yaml"] < 0.7 * score["today.yaml"]).all()


def test_page_stands_alone(page):
    parsed = Page(page)
    assert all(r.startswith("#") for r in parsed.references), parsed.references
    assert not parsed.tags & {"link", "img", "iframe", "object"}
    assert not re.search(r"<script[^>]*\ssrc", page)  # scripts are within the page
    assert "@import" not in page and not re.search(r"url\((?!#)", page)
    outside = set(re.findall(r"https?://[^\s\"'<]+", page))
    own = ("http://www.w3.org/", "https://www.w3.org/", "https://github.com/leeoniya/uPlot")
    assert all(u.startswith(own) for u in outside)  # the last is in the library's own comment


def test_page_has_every_id_once_and_every_reference_is_there(page):
    parsed = Page(page)
    assert len(parsed.ids) == len(set(parsed.ids))
    wanted = {r[1:] for r in parsed.references} | set(re.findall(r"url\(#([^)]+)\)", page))
    assert wanted <= set(parsed.ids)


def test_page_tells_what_to_change_and_why(page):
    text = "".join(Page(page).words)
    for part in (
        "The simulation lacks thruster lag", "What to change", "time_constant: ", "# was ",
        "Measured and simulated", "Where and when it departs", "What is left",
        "Retuned coefficients", "dive.mcap",
    ):  # fmt: skip
        assert part in text, part
    assert "nan" not in text.lower().split()


def test_retuned_coefficients_stand_beside_those_that_are_written(page, folder):
    extended = configuration.load(folder / "new/out/extended.yaml")
    found = json.loads((folder / "new/out/findings.json").read_text())["retuned"]["changed"]
    assert "<th>extended.yaml</th>" in page
    for name, entry in found.items():
        (row,) = re.findall(f"<tr><td>{name}</td>(.*?)</tr>", page)
        written, _ = told.estimate(extended.value(name), entry["std"])
        assert re.findall("<td>(.*?)</td>", row)[3] == written


def test_a_minor_effect_shows_the_interval_of_its_gain():
    lag = finding("thruster_lag", time_constant=(0.24, "s"))
    unsure = dataclasses.replace(lag, gain=Gain("q", 0.02, 0.019, 4.0, -1.8, 9.5))
    together = Together(3.0, 1.0, 5.0)
    jointly = dataclasses.replace(lag, gain=dataclasses.replace(unsure.gain, together=together))
    for f, shown in ((unsure, "4.0 % (-1.8 to 9.5)"), (jointly, "3.0 % (1.0 to 5.0)")):
        assert shown in "".join(told.minor([f]))


def test_page_follows_the_colours_of_the_reader(page):
    assert "prefers-color-scheme: dark" in page and "@media print" in page
    assert "currentColor" in page and "var(--colour-2" in page
    assert "#000000" not in page


def test_validation_on_another_bag(folder):
    for name, noise in (("half", 1.0), ("other", 1.01)):
        conditions = dataclasses.replace(LEAN, duration=30.0, noise=noise)
        made = draw(3, ("thruster_lag",), conditions=conditions)
        write_messages(folder / f"{name}.mcap", made.messages)
    other = folder / "other.mcap"
    made = explain(folder, "--validate", other, bag="half.mcap", out="validated")
    assert made.returncode == 0, made.stderr
    found = json.loads((folder / "validated/findings.json").read_text())
    assert found["provenance"]["validate"]["name"] == "other.mcap"
    assert "--validate" in (folder / "validated/report.html").read_text()


def test_every_effect_is_in_the_documentation():
    text = (HEAVY.parents[1] / "docs" / "explain.md").read_text()
    assert not [name for name in EFFECTS if f"`{name}`" not in text]


# ------------------------------------------------------------------ wrong use


@pytest.fixture(scope="module")
def short(folder):
    messages = dive(configuration.load(HEAVY), duration=8.0, seed=1).messages
    write_messages(folder / "short.mcap", messages)
    return "short.mcap"


def test_missing_bag_is_one_sentence(folder):
    refused(explain(folder, bag="none.mcap", out="none"), "none.mcap")
    assert not list((folder / "none").glob("*"))


def test_missing_configuration_is_one_sentence(folder):
    refused(explain(folder, config="none.yaml"), "none.yaml")


def test_missing_validation_bag_is_one_sentence(folder):
    refused(explain(folder, "--validate", folder / "none.mcap"), "none.mcap")


def test_too_short_a_bag_is_one_sentence_and_leaves_nothing(folder, short):
    refused(explain(folder, bag=short, out="short"), "8 s", "at least")
    assert not (folder / "short").exists()


def test_folder_that_cannot_be_is_one_sentence(folder):
    refused(explain(folder, out="today.yaml/out"), "today.yaml")
    refused(explain(folder, out="dive.mcap"), "dive.mcap")


def test_result_never_replaces_what_is_read(done, folder):
    path = folder / "new/out/extended.yaml"
    before = path.read_bytes()
    refused(explain(folder, config="new/out/extended.yaml"), "extended.yaml", "would replace")
    assert path.read_bytes() == before


# ------------------------------------------------------------------ words


@pytest.mark.parametrize(
    "x, digits, text",
    [
        (0.0, 3, "0"), (-141.04, 4, "-141.0"), (1234.5, 3, "1230"), (0.00598, 2, "0.0060"),
        (9.996, 3, "10.00"), (float("nan"), 3, "-"), (1.2e-9, 3, "1.20e-09"),
    ],
)  # fmt: skip
def test_numbers_have_sensible_digits(x, digits, text):
    assert told.number(x, digits) == text


def test_values_have_the_digits_that_their_deviation_leaves():
    assert told.estimate(-141.234, 3.14) == ("-141.2", "3.1")
    assert told.estimate(0.123456, 0.0021) == ("0.1235", "0.0021")
    assert told.estimate(12.0, 0.0) == ("12.00", "-")


def finding(effect, component="u", separable=True, **parameters):
    values = {name: Value(value, 0.01, unit) for name, (value, unit) in parameters.items()}
    gain = Gain(component, 0.08, 0.04, 50.0, 45.0, 55.0)
    return Finding(effect, (), values, None, gain, separable, None, (), "")


def findings(verdict, effects=(), residual=()):
    rmse = dict.fromkeys("uvwpqr", 0.1)
    return Findings(
        rmse, rmse | {"v": 0.05}, rmse, {}, tuple(effects), (), tuple(residual), verdict
    )


def test_a_velocity_that_was_not_measured_is_no_gain():
    found = findings("retuned")
    unmeasured = dataclasses.replace(
        found,
        baseline={"u": np.nan, **{n: x for n, x in found.baseline.items() if n != "u"}},
        retuned={"u": np.nan, **{n: x for n, x in found.retuned.items() if n != "u"}},
    )
    assert "prediction of sway improves by 50 %" in told.verdict(unmeasured)


def test_verdicts_in_words():
    lag = finding("thruster_lag", time_constant=(0.24, "s"))
    bias = finding("imu_bias", "kinematic", ax=(0.1, "m/s2"))
    drag = finding("quadratic_damping", "v", separable=False, Y_vv=(-210.0, "N s2/m2"))
    noise = Residual("N", "time", 0.314, 0.4)
    best = Residual("N", "pitch", None, 0.1, sure=False)
    assert told.verdict(findings("agrees")) == (
        "The simulation agrees with the measurement: nothing in these data asks for a change."
    )
    assert told.verdict(findings("retuned")) == (
        "The coefficients of the simulation are off, and these data show nothing that its "
        "structure lacks. Retuned, the 10 s prediction of sway improves by 50 %."
    )
    assert told.verdict(findings("explained", [lag])) == (
        "The simulation lacks thruster lag (time constant 0.24 s). "
        "With it, the 10 s prediction of surge improves by 50 %."
    )
    assert told.verdict(findings("explained", [lag, drag, bias])) == (
        "The simulation lacks thruster lag (time constant 0.24 s) and quadratic damping "
        "(Y_vv -210 N s2/m2; not surely told from all else); the sensors show IMU bias "
        "(ax 0.10 m/s2). The 10 s prediction of surge improves by 50 % with thruster lag, the 10 s "
        "prediction of sway improves by 50 % with quadratic damping and the agreement of the "
        "sensors improves by 50 % with IMU bias."
    )
    assert told.verdict(findings("unexplained", [], [noise])) == (
        "Something is left that no effect of the library explains: a moment N that depends on "
        "time at 0.31 Hz (40 % of what is left on N)."
    )
    assert told.verdict(findings("unexplained", [])) == (
        "Something is left that no effect of the library explains."
    )
    slight = dataclasses.replace(drag, gain=dataclasses.replace(drag.gain, low=-69.0))
    doubtful = dataclasses.replace(findings("unexplained", [], [best]), minor=(slight,))
    assert told.verdict(doubtful) == (
        "Something is left that no effect of the library surely explains: a moment N that depends, "
        "if on anything, on pitch (10 % of what is left). Quadratic damping may explain it, "
        "not beyond chance on the held-out data: a second dive (--validate) would decide."
    )
    undecided = dataclasses.replace(findings("unexplained"), minor=(slight,))
    assert told.verdict(undecided) == (
        "The simulation may lack quadratic damping: the data that were fitted support it, the "
        "held-out data neither confirm nor refute it. A second dive (--validate) would decide: "
        f"{EFFECTS['quadratic_damping'].manoeuvre}."
    )
    nothing = Residual("N", "time", None, 0.0, sure=False)
    assert told.dependence(nothing) == "a moment N that depends on nothing that was tried"


def test_error_is_averaged_in_bins_that_hold_enough():
    x = np.repeat([0.5, 1.5, 2.5], [30, 30, 3])
    error = np.where(x < 1.0, 3.0, -4.0)
    error[0] = np.nan
    rms = told.binned(x, error, np.arange(4.0))
    np.testing.assert_allclose(rms[:2], [3.0, 4.0])
    assert np.isnan(rms[2])
