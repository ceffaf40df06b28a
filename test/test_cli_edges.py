"""The command line, further: streams, seeds, damage and wrong use."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from program import few_manoeuvres, messages_in, run, run_alone

from bench import DEMO, HEAVY
from rov_ident.cli.common import EXAMPLES
from rov_ident.core.errors import UserError
from rov_ident.core.files import shipped
from rov_ident.io.bag_reader import Bag
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.write_messages import write_messages
from rov_ident.simulation import virtual_sensors as sensors

COMMANDS = (
    "demo", "init", "identify", "compare", "replay", "fit", "check", "plan", "explain",
    "simulate", "import", "export", "import-model", "nomoto", "forces", "coast-down", "steer",
    "coefficients",
)  # fmt: skip


def simulate(out, *options, source=("--manoeuvre", "steps", "--duration", 5)):
    return run("simulate", "--config", HEAVY, *source, *options, "--out", out)


def fit(bag, *options, path=HEAVY):
    return run("fit", bag, "--config", path, "--estimator", "rls", *options)


def refused(done, *parts):
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    (line,) = [line for line in done.stderr.splitlines() if line]
    for part in parts:
        assert part in line


def misused(done, *parts):
    """As argparse says it: the usage, then one sentence."""
    assert done.returncode == 2 and done.stdout == ""
    assert "Traceback" not in done.stderr
    for part in parts:
        assert part in done.stderr.splitlines()[-1]


@pytest.fixture(scope="module")
def dive(heavy):
    return sensors.dive(heavy, duration=12.0, seed=1).messages


@pytest.fixture(scope="module")
def bag(tmp_path_factory, dive):
    path = tmp_path_factory.mktemp("cli") / "dive.mcap"
    write_messages(path, dive)
    return path


# ------------------------------------------------------------------ results


def test_same_seed_same_bytes(tmp_path):
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        assert simulate(tmp_path / f"{name}.mcap", "--seed", seed).returncode == 0
    a, b, c = ((tmp_path / f"{name}.mcap").read_bytes() for name in "abc")
    assert a == b != c


def test_without_noise_the_wrench_is_the_demand(tmp_path):
    path = tmp_path / "rest.mcap"
    done = simulate(path, "--noise", 0, source=("--manoeuvre", "rest", "--duration", 5))
    assert done.returncode == 0
    for role, message in messages_in(path):
        if role == "wrench":
            assert not message.force.any() and not message.torque.any()
        elif role == "odom":
            assert not message.twist_variance.any()


def test_results_on_one_stream_messages_on_the_other(tmp_path, bag):
    done = fit(bag, "--json", tmp_path / "a.json")
    assert done.returncode == 0
    assert "X_udot" in done.stdout and "written" not in done.stdout
    assert "written" in done.stderr and "X_udot" not in done.stderr


def test_fitted_configuration_is_taken_by_the_commands(tmp_path, bag):
    fitted = tmp_path / "fitted.yaml"
    assert fit(bag, "--save", fitted).returncode == 0
    assert fit(bag, path=fitted).returncode == 0
    for source in (("--bag", bag), ("--manoeuvre", "rest", "--duration", 2)):
        out = tmp_path / f"{source[0][2:]}.mcap"
        done = run("simulate", "--config", fitted, *source, "--out", out)
        assert done.returncode == 0, done.stderr


def test_the_filter_of_filterpy_beside_ours(tmp_path, bag):
    out = tmp_path / "fit.json"
    done = run(
        "fit", bag, "--config", HEAVY, "--estimator", "ukf", "--reference", 1, "--json", out
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "our filter and filterpy's" in done.stdout
    told = json.loads(out.read_text())
    assert 0.8 < told["reference"]["duration_s"] <= 1.0
    rows = told["reference"]["coefficients"]
    assert rows.keys() == told["coefficients"].keys()
    assert max(abs(row["apart_in_std"]) for row in rows.values()) < 1e-6
    assert any(row["value"] != told["coefficients"][name]["value"] for name, row in rows.items())
    refused(
        fit(bag, "--reference"), "reference (--reference) has no meaning with the estimator rls"
    )


def test_what_is_written_is_said(tmp_path, bag):
    paths = [tmp_path / name for name in ("fitted.yaml", "fit.html", "fit.json")]
    done = fit(bag, "--save", paths[0], "--report", paths[1], "--json", paths[2])
    (said,) = [line for line in done.stderr.splitlines() if line.startswith("written: ")]
    assert all(str(path) in said for path in paths)
    out = tmp_path / "simulated.mcap"
    assert f"written: {out}" in simulate(out, source=("--bag", bag)).stderr


def test_three_samples_are_no_fit(tmp_path, dive):
    last = [stamp for _, role, m in dive if role == "odom" for stamp in (m.stamp,)][2]
    short = [(t, role, m) for t, role, m in dive if role != "imu" and m.stamp <= last]
    write_messages(tmp_path / "short.mcap", short)
    for estimator in ("rls", "ls"):
        done = run("fit", tmp_path / "short.mcap", "--config", HEAVY, "--estimator", estimator)
        assert done.returncode == 2 and done.stdout == ""
        assert "samples are too few" in done.stderr


def test_a_bag_that_is_not_there_among_others(tmp_path, bag):
    for command in ("fit", "explain", "identify"):
        out = ("--out", tmp_path / "out") if command != "fit" else ("--estimator", "ls")
        done = run(command, bag, tmp_path / "none.mcap", "--config", HEAVY, *out)
        refused(done, "none.mcap cannot be read")


def test_a_bag_in_the_folder_one_is_in(tmp_path, bag):
    folder = tmp_path / "first dive"
    folder.mkdir()
    (folder / "first.mcap").write_bytes(bag.read_bytes())
    done = run("check", ".", "--config", HEAVY, cwd=folder)
    assert done.stdout.startswith("first dive, 12.0 s")


@pytest.mark.parametrize("arguments", ["coefficients", "completion bash", "completion fish"])
def test_who_reads_the_head_has_seen_enough(arguments):
    command = f"{sys.executable} -u -m rov_ident {arguments} | head -1; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=600)
    assert done.stdout.splitlines()[-1] == "0" and done.stderr == ""


def test_completion_of_fish():
    lines = run("completion", "fish").stdout.splitlines()
    (estimator,) = [s for s in lines if "_using fit'" in s and " -l estimator " in s]
    assert '"rls ukf ls iv ml"' in estimator
    assert {f" -a {name} " in "\n".join(lines) for name in COMMANDS} == {True}


@pytest.mark.parametrize("command", COMMANDS)
def test_help(command):
    done = run(command, "--help")
    assert done.returncode == 0 and done.stderr == ""
    assert done.stdout.startswith(f"usage: rov-ident {command}")
    example = done.stdout.splitlines()[-1]  # in one line, to be copied
    assert example == f"example: rov-ident {command} {EXAMPLES[command]}".rstrip()


def test_what_is_shipped():
    assert shipped("bags/demo.mcap") == DEMO
    with pytest.raises(UserError, match="bags/other.mcap is not here"):
        shipped("bags/other.mcap")


# ------------------------------------------------------------------ bad input


def test_truncated_bag_says_how_much_is_lost(tmp_path):
    path = tmp_path / "cut.mcap"
    path.write_bytes(DEMO.read_bytes()[:900_000])
    lost = Bag(path).lost_bytes
    done = fit(path)
    assert done.returncode == 0 and lost > 0
    assert f"the last {lost} bytes cannot be read" in done.stderr


def test_bag_of_other_types(tmp_path):
    path = tmp_path / "other.mcap"
    with BagWriter(path) as writer:
        writer.write("/chatter", "std_msgs/msg/String", 10**9, b"\0\1\0\0\2\0\0\0a\0")
    refused(fit(path), "other.mcap", "/chatter (std_msgs/msg/String)")


@pytest.mark.parametrize(
    "change, part",
    [
        (lambda role, m: m._replace(stamp=0), "zero stamp"),
        (
            lambda role, m: m._replace(frame_id="world_ned") if role == "wrench" else m,
            "frame 'world_ned' is a world frame",
        ),
        (
            lambda role, m: m._replace(force=m.force * np.nan) if role == "wrench" else m,
            "wrench: not finite",
        ),
    ],
)
def test_too_little_that_can_be_used(tmp_path, dive, change, part):
    path = tmp_path / "bad.mcap"
    write_messages(path, [(at, role, change(role, m)) for at, role, m in dive])
    refused(fit(path, "--json", tmp_path / "a.json", "--save", tmp_path / "a.yaml"), "bad", part)
    assert [p.name for p in tmp_path.iterdir()] == ["bad.mcap"]


@pytest.mark.parametrize(
    "change, part",
    [
        (("mass: 13.5", "mass: heavy"), "vehicle.mass is 'heavy'"),
        (("mass: 13.5", "mas: 13.5"), "did you mean mass?"),
        (("0.26, 0.23", "-0.26, 0.23"), "vehicle.inertia"),
        (("X_u: -13.7", "X_u: .nan"), "coefficients.X_u"),
        (("coefficients:", "koefficients:"), "coefficients is missing"),
    ],
)
def test_bad_configuration_writes_nothing(tmp_path, change, part):
    path, out = tmp_path / "bad.yaml", tmp_path / "out.mcap"
    path.write_text(HEAVY.read_text().replace(*change))
    refused(
        run("simulate", "--config", path, "--manoeuvre", "rest", "--out", out), "bad.yaml", part
    )
    assert not out.exists()


def test_missing_files_are_named(tmp_path, bag):
    none = tmp_path / "none.yaml"
    refused(fit(bag, path=none), "none.yaml", "No such file")
    refused(run("replay", tmp_path / "none.mcap", "--config", HEAVY), "none.mcap")
    refused(run("import", tmp_path / "none.csv", "--out", tmp_path / "o.mcap"), "none.csv")
    assert not list(tmp_path.iterdir())


def test_wrong_use(tmp_path, bag):
    out = tmp_path / "out.mcap"
    misused(simulate(out, "--imu-rate", -1), "--imu-rate", "from 0")
    misused(simulate(out, "--odometry-rate", 0), "--odometry-rate", "above 0")
    misused(simulate(out, "--duration", "nan"), "--duration", "above 0")
    misused(run("replay", bag, "--config", HEAVY, "--rate", -1), "--rate", "from 0")
    pull = ("coast-down", bag, "--config", HEAVY, "--bollard")
    for numbers in ((10, "nan"), ("inf", 3)):
        misused(run(*pull, *numbers), "--bollard", "must be a finite number")
    misused(
        run("simulate", "--config", HEAVY, "--bag", bag, "--channels", "surge,foo", "--out", out),
        "no channel 'foo'",
    )
    assert not out.exists()


@pytest.mark.parametrize(
    "option",
    [("--duration", 5), ("--seed", 3), ("--noise", 0), ("--imu-rate", 50), ("--drop", 0.1)],
)
def test_what_a_bag_decides_is_not_asked_of_a_simulation(tmp_path, bag, option):
    """Such options had been passed over without a word."""
    out = tmp_path / "out.mcap"
    refused(
        simulate(out, *option, source=("--bag", bag)), option[0] if option[0] != "--imu-rate" else
        "rates", "has no meaning with a bag: leave it out"
    )  # fmt: skip
    assert not out.exists()


def test_all_axes_of_a_manoeuvre_move(tmp_path):
    refused(simulate(tmp_path / "a.mcap", "--channels", "surge"), "--channels", "a manoeuvre")


@pytest.mark.parametrize(
    ("command", "more"), [("simulate", ("--manoeuvre", "steps")), ("plan", ("--tank", "9,9,4"))]
)
def test_what_a_simulated_bag_is_read_with_is_said(tmp_path, monkeypatch, command, more):
    """It has the usual topics, whatever those of the vehicle are."""
    few_manoeuvres(monkeypatch)
    path, out = tmp_path / "c.yaml", tmp_path / "out.mcap"
    own = (
        "    inputs: {odom: geometry_msgs/TwistStamped}\n    topics: {imu: /rov/imu, odom: /odom}\n"
    )
    path.write_text(HEAVY.read_text() + own)
    advice = "leave inputs.odom, topics.imu out of the configuration"
    for config in (path, HEAVY) if command == "simulate" else (path,):
        done = run(command, *more, "--config", config, "--duration", 10, "--out", out)
        assert done.returncode == 0, done.stderr
        assert (advice in " ".join(done.stderr.split())) == (config == path)


def test_a_bag_is_not_replayed_onto_itself(bag):
    before = bag.read_bytes()
    refused(
        run("replay", bag, "--config", HEAVY, "--rate", 0, "--out", bag),
        "would replace what it is made from",
    )
    assert bag.read_bytes() == before


# ------------------------------------------------------------------ known defects


def test_a_bag_is_not_simulated_onto_itself(tmp_path, bag):
    path = tmp_path / "dive.mcap"
    path.write_bytes(bag.read_bytes())
    done = simulate(path, source=("--bag", path))
    assert path.read_bytes() == bag.read_bytes()
    refused(done, "dive.mcap")


def test_a_result_does_not_replace_its_bag(tmp_path, bag):
    path = tmp_path / "dive.mcap"
    path.write_bytes(bag.read_bytes())
    fit(path, "--json", path)
    assert path.read_bytes() == bag.read_bytes()


def test_fit_writes_all_or_nothing(tmp_path, bag):
    (tmp_path / "file").write_text("in the way")
    done = fit(bag, "--json", tmp_path / "a.json", "--save", tmp_path / "file" / "a.yaml")
    assert done.returncode == 2
    assert not (tmp_path / "a.json").exists() and done.stdout == ""


@pytest.mark.parametrize(
    "option", [("--seed", -1), ("--drop", 3), ("--delay", 1e300), ("--noise", 1e300)]
)
def test_senseless_numbers(tmp_path, option):
    done = simulate(tmp_path / "out.mcap", *option)
    assert done.returncode == 2 and "Traceback" not in done.stderr


def test_out_is_a_file_that_is_no_bag(tmp_path):
    path = tmp_path / "notes"
    path.write_text("keep me")
    done = simulate(path)
    assert path.read_text() == "keep me"
    refused(done, "notes")


def test_a_name_between_colons_is_no_emoji(tmp_path):
    """rich draws `:x:` as a cross."""
    config = ["--config", str(HEAVY)]
    ended = run("check", str(tmp_path / "a:x:1.mcap"), *config)
    assert "a:x:1.mcap cannot be read" in ended.stderr


def test_no_empty_line_where_there_is_no_terminal(tmp_path):
    done = run_alone("fit", Path("none.mcap"), "--config", HEAVY, "--estimator", "rls")
    assert done.stderr.count("\n") == 1
