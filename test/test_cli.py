"""The command line as a user meets it: real files, real messages, some processes of their own."""

import json

import numpy as np
import pytest
from program import run, run_alone
from tiers import more

from bench import HEAVY, ROOT
from rov_ident import config as configuration
from rov_ident.core.messages import Odometry
from rov_ident.io.bag_reader import Bag
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.cdr import decode_odometry, encode
from rov_ident.io.write_messages import write_messages


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Twenty seconds of a simulated dive, made by the command."""
    path = tmp_path_factory.mktemp("bags") / "dive.mcap"
    done = run(
        "simulate", "--config", HEAVY, "--manoeuvre", "steps", "--duration", 20, "--out", path
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    return path


def test_the_same_data_count_once(tmp_path, bag):
    """Twice they would make intervals narrower by a third, and a copy to judge on is no other
    dive."""
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(bag.read_bytes())
    told = []
    for bags in ((bag,), (bag, copy)):
        to = ("--json", tmp_path / "fit.json")
        done = run("fit", *bags, "--config", HEAVY, "--estimator", "ls", *to, "--validate", copy)
        assert done.returncode == 0, done.stderr
        told.append(json.loads((tmp_path / "fit.json").read_text()))
    assert told[0]["coefficients"] == told[1]["coefficients"]
    assert f"{copy} holds the same data as {bag}: it counts once" in told[1]["notes"]
    assert all(any("tells nothing of other dives" in n for n in of["notes"]) for of in told)
    out = ("--out", tmp_path / "explained")
    refused(run("explain", bag, "--config", HEAVY, "--validate", copy, *out), "another dive")


def refused(done, *parts):
    """Exit status 2, one sentence on standard error with the given parts, nothing else."""
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    for part in parts:
        assert part in lines[0], lines[0]


# ------------------------------------------------------------------ simulate


def test_the_shipped_bag_is_reproduced_bit_for_bit(tmp_path, compiled):
    again = tmp_path / "demo.mcap"
    text = (ROOT / "Makefile").read_text()
    line = next(line for line in text.splitlines() if "simulate" in line)
    arguments = line.split("rov-ident", 1)[1].split()
    arguments[arguments.index("--out") + 1] = str(again)
    done = run_alone(*arguments, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert again.read_bytes() == (ROOT / "bags" / "demo.mcap").read_bytes()


def test_simulated_sensors_as_asked_for(tmp_path, bag):
    out = tmp_path / "other.mcap"
    options = ["--odometry-rate", 5, "--imu-rate", 0, "--wrench-rate", 10, "--drop", 0.1]
    done = run(
        "simulate", "--config", HEAVY, "--manoeuvre", "pilot", "--duration", 20, "--seed", 3,
        *options, "--delay", 0.05, "--jitter", 0.02, "--out", out,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    counts = {name: topic.message_count for name, topic in Bag(out).topics.items()}
    assert "/imu/data" not in counts
    assert 75 <= counts["/odom"] <= 100
    assert 150 <= counts["/thruster_wrench"] <= 200
    late = [m.log_time - decode_odometry(m.data).stamp for m in Bag(out).iter_raw(["/odom"])]
    assert min(late) >= 50_000_000


def test_simulation_of_a_bag_is_compared_with_it(tmp_path, bag):
    out = tmp_path / "simulated.mcap"
    done = run("simulate", "--config", HEAVY, "--bag", bag, "--channels", "surge,yaw", "--out", out)
    assert done.returncode == 0, done.stderr
    assert "0.99" in done.stdout or "1.000" in done.stdout
    assert " u " in done.stdout and " r " in done.stdout and " w " not in done.stdout
    assert Bag(out).topics["/odom"].message_count > 300


# ------------------------------------------------------------------ fit


@pytest.mark.parametrize("estimator", ["rls", *more("ukf")])
def test_fit_writes_the_agreed_json_and_a_configuration(tmp_path, bag, estimator):
    given = configuration.load(HEAVY)
    off = given.with_model(given.model.with_theta(1.3 * given.model.theta))
    configuration.dump(off, tmp_path / "off.yaml")
    second, third = tmp_path / "second.mcap", tmp_path / "third.mcap"
    for seed, path in ((2, second), (3, third)):
        how = "--manoeuvre", "steps", "--duration", 20, "--seed", seed
        assert run("simulate", "--config", HEAVY, *how, "--out", path).returncode == 0
    done = run(
        "fit", bag, second, "--config", tmp_path / "off.yaml", "--estimator", estimator,
        "--json", tmp_path / "fit.json", "--save", tmp_path / "fitted.yaml",
        "--validate", third, "--report", tmp_path / "fit.html",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "fit.json").read_text())
    judged = result["validation"]
    assert judged["horizon_s"] == 10.0 and judged["bags"][0]["file"] == third.name
    assert judged["rmse"]["u"] < 0.5 * judged["rmse_before"]["u"]
    assert "On the bag to validate" in (tmp_path / "fit.html").read_text()
    assert result["estimator"] == estimator
    assert result["samples"] > 3000 and result["duration_s"] == pytest.approx(40.0, abs=0.5)
    assert result["open_loop"]["horizon_s"] == 10.0
    assert set(result["open_loop"]["rmse"]) == set("uvwpqr")
    assert set(result["coefficients"]) == set(given.model.names)
    fitted = configuration.load(tmp_path / "fitted.yaml").model
    errors = []
    for name, truth in zip(given.model.names, given.model.theta, strict=True):
        found = result["coefficients"][name]
        assert set(found) >= {"value", "std", "unit", "identifiable"}
        assert found["value"] == fitted.theta[fitted.names.index(name)]
        errors.append(abs(found["value"] / truth - 1.0))
    assert np.median(errors) < 0.03
    assert "X_udot" in done.stdout


def test_live_estimators_replay_a_bag(tmp_path, compiled):
    bag, out = tmp_path / "dive.mcap", tmp_path / "replayed.mcap"
    made = run("simulate", "--config", HEAVY, "--manoeuvre", "steps", "--duration", 6, "--out", bag)
    assert made.returncode == 0, made.stderr
    done = run_alone("replay", bag, "--config", HEAVY, "--rate", 0, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "rls" in done.stdout and "ukf" in done.stdout
    topics = Bag(out).topics
    for node in ("rls_node", "ukf_node"):
        assert topics[f"/{node}/coefficients"].message_count > 0
        assert topics[f"/{node}/wrench_residual"].message_count > 0


# ------------------------------------------------------------------ import, coefficients


def test_import_makes_a_bag_that_can_be_fitted(tmp_path):
    t = np.arange(0.0, 20.0, 0.1)
    columns = {"t_s": t, "speed": 0.3 * np.sin(t)}
    columns |= {
        name: np.zeros_like(t) for name in ("v", "w", "p", "q", "r", "Y", "Z", "K", "M", "N")
    }
    columns["X"] = 40.0 * np.sin(t)
    text = ",".join(columns) + "\n"
    text += "".join(",".join(f"{c[i]:.6f}" for c in columns.values()) + "\n" for i in range(len(t)))
    log = tmp_path / "log.csv"
    log.write_text("# a comment\n" + text)
    done = run("import", log, "--map", "u=speed", "--out", tmp_path / "log.mcap")
    assert done.returncode == 0, done.stderr
    done = run("fit", tmp_path / "log.mcap", "--config", HEAVY, "--estimator", "rls")
    assert done.returncode == 0, done.stderr
    refused(run("import", log, "--out", tmp_path / "other.mcap"), "log.csv", "u")
    assert not (tmp_path / "other.mcap").exists()


def test_every_coefficient_is_listed():
    done = run("coefficients")
    assert done.returncode == 0
    names = {line.split()[0]: line for line in done.stdout.splitlines()}
    assert "N s2/m2" in names["X_uu"] and "kg" in names["X_udot"]
    assert {"Y_uv", "Y_v_abs_r", "N_rr", "Y_r"} <= set(names)


def test_help_of_every_command():
    done = run_alone("--help")
    assert done.returncode == 0
    for command in ("demo", "replay", "fit", "simulate", "import", "coefficients"):
        assert command in done.stdout


# ------------------------------------------------------------------ what the user can mend


def fit(bag, config=HEAVY):
    return run("fit", bag, "--config", config, "--estimator", "rls")


def test_bags_that_cannot_be_used(tmp_path, bag):
    refused(fit(tmp_path / "none.mcap"), "none.mcap")
    alone = run_alone("fit", tmp_path / "none.mcap", "--config", HEAVY, "--estimator", "rls")
    refused(alone, "none.mcap")  # in a process of its own, too
    (tmp_path / "empty.mcap").write_bytes(b"")
    refused(fit(tmp_path / "empty.mcap"), "empty.mcap")
    (tmp_path / "text.mcap").write_text("not a bag " * 100)
    refused(fit(tmp_path / "text.mcap"), "text.mcap")


def test_an_option_is_named_in_full(tmp_path, bag):
    """--out was taken for --output-error, and the file behind it for a second bag."""
    done = run("fit", bag, "--config", HEAVY, "--out", tmp_path / "fitted.yaml")
    assert done.returncode == 2
    assert "--out" in done.stderr.splitlines()[-1]


def test_bags_without_a_topic(tmp_path, bag):
    for missing, kept in (("odom", "wrench"), ("wrench", "odom")):
        path = tmp_path / f"no_{missing}.mcap"
        with BagWriter(path) as writer:
            for raw in Bag(bag).iter_raw():
                if kept in raw.topic:
                    writer.write(raw.topic, raw.type_name, raw.log_time, raw.data)
        refused(fit(path), path.name, missing)


def test_a_bag_of_nothing_but_bad_messages(tmp_path):
    zero = np.zeros(3)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    path = tmp_path / "nan.mcap"
    with BagWriter(path) as writer:
        for k in range(100):
            bad = Odometry(
                k * 10**8, "odom", "base_link", zero, level, zero * np.nan, zero, np.zeros(6)
            )
            writer.write("/odom", "nav_msgs/msg/Odometry", k * 10**8, encode(bad))
        for raw in Bag(ROOT / "bags" / "demo.mcap").iter_raw(["/thruster_wrench"]):
            writer.write(raw.topic, raw.type_name, raw.log_time, raw.data)
    refused(fit(path), "nan.mcap", "not finite")


def test_a_truncated_bag_is_used_as_far_as_it_goes(tmp_path, bag):
    path = tmp_path / "cut.mcap"
    path.write_bytes((ROOT / "bags" / "demo.mcap").read_bytes()[:900_000])
    done = fit(path)
    assert done.returncode == 0
    assert "cut.mcap" in done.stderr
    assert "X_udot" in done.stdout


@pytest.mark.parametrize(
    "change, part",
    [
        (("mass: 13.5", "mass: -1.0"), "vehicle.mass"),
        (("X_u: -13.7", "X_u: 13.7"), "X_u"),
        (("X_u: -13.7", "X_q9: 13.7"), "X_q9"),
        (("buoyancy: 134.0", "buoyancy: heavy"), "vehicle.buoyancy"),
    ],
)
def test_configurations_that_cannot_be_used(tmp_path, change, part):
    path = tmp_path / "bad.yaml"
    path.write_text(HEAVY.read_text().replace(*change))
    refused(run("fit", "any.mcap", "--config", path, "--estimator", "rls"), "bad.yaml", part)


def test_nothing_is_half_written(tmp_path):
    done = run("simulate", "--config", HEAVY, "--manoeuvre", "loop", "--out", tmp_path / "a.mcap")
    refused(done, "loop", "steps")
    (tmp_path / "file").write_text("in the way")
    done = run(
        "simulate", "--config", HEAVY, "--manoeuvre", "rest", "--duration", 2,
        "--out", tmp_path / "file" / "a.mcap",
    )  # fmt: skip
    refused(done, "a.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_messages_in_a_world_frame_are_named(tmp_path, bag):
    messages = []
    for raw in Bag(bag).iter_raw(["/odom"]):
        message = decode_odometry(raw.data)
        messages.append((raw.log_time, "odom", message._replace(child_frame_id="map")))
    path = tmp_path / "frame.mcap"
    write_messages(path, messages)
    with BagWriter(tmp_path / "both.mcap") as writer:
        for source, topic in ((path, "/odom"), (bag, "/thruster_wrench")):
            for raw in Bag(source).iter_raw([topic]):
                writer.write(raw.topic, raw.type_name, raw.log_time, raw.data)
    refused(fit(tmp_path / "both.mcap"), "map", "world frame")
