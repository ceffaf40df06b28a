"""The procedure of a sea trial from end to end (docs/offline.md), and its pieces.

Closed-loop waypoints in the simulator, one channel at a time; cut, cleaned, levers taken off; each
channel fitted alone; judged on a joint run with a speed change and a turn.
"""

import json
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from program import messages_in
from scipy.signal import lfilter
from textbook import finned
from tiers import more

from rov_ident import config
from rov_ident.cli import main
from rov_ident.config.prior import prior_of
from rov_ident.core.errors import UserError
from rov_ident.core.messages import DRIVE
from rov_ident.io import topics
from rov_ident.io.bag_reader import Bag
from rov_ident.model.equations import build
from rov_ident.offline.coast_down import Run, _simulated, fit_coast_downs
from rov_ident.sampling import preprocess

EXAMPLE = Path(__file__).parent.parent / "examples" / "sea_trial.py"


@pytest.mark.parametrize("joint", [False, *more(True)])
def test_the_whole_procedure(tmp_path, capsys, joint):
    """From raw logs, by commands, to a model that predicts a run it has not seen as the true
    vehicle would: thrust, drag and every channel of a vehicle under rudder, planes and propeller.
    """
    main_ = runpy.run_path(str(EXAMPLE))["main"]
    main_(["--out", str(tmp_path), *["--channels-only"] * (not joint)])
    told = capsys.readouterr()
    found = {}
    for line in told.out.splitlines():
        if numbers := re.findall(r" [uvwpqr] ([\d.]+)", line):
            found[line.strip().split("  ")[0]] = np.array(numbers, dtype=float)
    before, channels, true = (
        found[name]
        for name in ("as configured", "channel by channel, output error", "the true vehicle")
    )
    assert np.median(channels / before) < 0.9 and np.median(channels / true) < 1.15
    if joint:
        together = found["all runs together, ml"]
        assert np.all(together < 1.15 * true) and np.median(together / before) < 0.8
        assert "<svg" in (tmp_path / "joint.html").read_text()
    assert "outliers replaced" in told.err and "z from 3 sources" in told.err
    assert "speeds tell thrust and drag only relative to the inertia" in told.out + told.err
    surge = json.loads((tmp_path / "zhao_surge.json").read_text())["coefficients"]
    model = config.load(tmp_path / "true.yaml").model.values
    assert surge["X_udot"]["lower"] <= model["X_udot"] <= surge["X_udot"]["upper"]
    mass = config.load(tmp_path / "true.yaml").model.body.mass
    inertia = (mass - surge["X_udot"]["value"]) / (mass - model["X_udot"])  # all that speeds tell
    values = {name: surge[name]["value"] / inertia for name in ("X_n", "X_nn", "X_uu")}
    assert values["X_uu"] == pytest.approx(model["X_uu"], rel=0.03)
    for n in (10.0, 20.0):  # 1/s, in the trial; k1 and k2 apart are told less well
        thrust, truth = (v["X_n"] * n + v["X_nn"] * n**2 for v in (values, model))
        assert thrust == pytest.approx(truth, rel=0.03)


# ------------------------------------------------------------------ pieces


def test_outliers_are_replaced_and_nothing_else():
    t = np.arange(0.0, 20.0, 0.05)
    x = np.sin(t) + 0.01 * np.random.default_rng(0).standard_normal(len(t))
    spoilt = x.copy()
    spoilt[[30, 200, 201, 350]] += [3.0, -2.0, -2.0, 1.0]
    clean, bad = preprocess.despiked(spoilt)
    assert set(np.flatnonzero(bad)) >= {30, 200, 201, 350}
    assert bad.sum() < 12
    assert np.abs(clean - np.sin(t)).max() < 0.2
    assert not preprocess.despiked(0.0 * t)[1].any()


@pytest.mark.parametrize("corner", [0.5, 2.0])
def test_smoothing_has_its_corner_and_no_lag(corner):
    t = np.arange(0.0, 40.0, 0.02)
    inside = slice(400, -400)
    for frequency, gain in ((0.2 * corner, 1.0), (corner, np.sqrt(0.5))):
        x = np.sin(2.0 * np.pi * frequency * t)
        quarter = np.cos(2.0 * np.pi * frequency * t)[inside]
        y = preprocess.smoothed(x, 0.02, corner)[inside]
        assert y @ x[inside] / (x[inside] @ x[inside]) == pytest.approx(gain, abs=0.05)
        assert y @ quarter / (quarter @ quarter) == pytest.approx(0.0, abs=0.01)
    with pytest.raises(UserError, match="too few"):
        preprocess.smoothed(x[:4], 0.02, corner)
    with pytest.raises(UserError, match="is too high a corner"):
        preprocess.smoothed(x, 0.02, 25.0)


def test_the_dynamic_stretch_is_cut_out():
    t = np.arange(0.0, 100.0, 0.1)
    wrench = np.tile([5.0, 0.0, -2.0, 0.0, 0.0, 0.0], (len(t), 1))
    wrench[:, 5] = np.where((t > 40.0) & (t < 60.0), 10.0 * np.sign(np.sin(t)), 0.01)
    begin, end = preprocess.dynamic_stretch(t, wrench, 5.0)
    assert begin == pytest.approx(35.0, abs=0.3)
    assert end == pytest.approx(65.0, abs=0.3)
    with pytest.raises(UserError, match="the same throughout"):
        preprocess.dynamic_stretch(t, 0.0 * wrench, 5.0)


def test_depth_from_three_sources_is_better_than_the_best():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 60.0, 0.2)

    def true(at):
        return 5.0 + 1.5 * np.sin(0.3 * at)

    def source(name, rate, std, bias):
        at = np.arange(0.0, 60.0, 1.0 / rate)
        z = true(at) + std * rng.standard_normal(len(at)) + bias
        return preprocess.Source(name, at, z, std, abs(bias))

    pressure = source("pressure", 5.0, 0.05, 0.0)
    inertial, tracking = source("ins", 10.0, 0.05, 0.3), source("usbl", 1.0, 0.4, 0.0)
    pressure.z[100] += 4.0  # one jump
    found = preprocess.fused([pressure, inertial, tracking], t)
    error = found.value - true(t)
    assert np.std(error) < 0.03
    assert found.bias["ins"] == pytest.approx(0.3, abs=0.06)
    assert np.mean(np.abs(error) < 2.0 * found.std) > 0.8
    assert np.std(found.rate - 0.45 * np.cos(0.3 * t)) < 0.06
    with pytest.raises(UserError, match="at least one source"):
        preprocess.fused([], t)


# ------------------------------------------------------------------ thrust from speed


TRUE = {"k1": 0.4, "k2": 0.05, "X_u": -6.0, "X_uu": -30.0, "X_udot": -7.0}
MASS = 15.0


def surge_runs(noise=0.005, seed=0):
    """Up in steps to full speed, then coasting."""
    t = np.arange(0.0, 40.0, 0.1)
    n = np.select([t < 8.0, t < 16.0, t < 25.0], [10.0, 18.0, 25.0], 0.0)
    inertia = MASS - TRUE["X_udot"]
    ratio = np.array([TRUE[k] for k in ("k1", "k2", "X_u", "X_uu")]) / inertia
    u = _simulated(ratio, 0.0, 0.0, t, n)
    rng = np.random.default_rng(seed)
    return [Run(t, n, u + noise * rng.standard_normal(len(t))) for _ in range(2)]


@pytest.mark.parametrize(
    "anchor",
    [{"added_mass": TRUE["X_udot"]}, {"bollard": (20.0, 0.4 * 20.0 + 0.05 * 400.0)}],
    ids=["added mass known", "bollard pull known"],
)
def test_thrust_and_drag_from_step_up_and_coast_down(anchor):
    off = []
    for seed in range(6):
        found = fit_coast_downs(surge_runs(seed=seed), MASS, **anchor)
        assert found.rmse == pytest.approx(0.005, rel=0.15)
        for name, value, std in zip(found.names, found.values, found.std, strict=True):
            if std > 0.0:
                off.append((value - TRUE[name]) / std)
            else:
                assert value == pytest.approx(TRUE[name])
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_intervals_hold_a_slow_error_beneath_white_noise():
    """Of 95 % intervals more than 80 % hold the truth, where the correlation of neighbours alone,
    by which white noise hides how long the error lasts, made three in five do so."""
    inside = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        runs = surge_runs(noise=0.01, seed=seed)
        slow = lfilter([0.01 * np.sqrt(1.0 - 0.95**2)], [1.0, -0.95], rng.standard_normal((2, 400)))
        runs = [Run(r.t, r.n, r.u + error) for r, error in zip(runs, slow, strict=True)]
        found = fit_coast_downs(runs, MASS, added_mass=TRUE["X_udot"])
        off = np.abs(found.values - [TRUE[name] for name in found.names])[:4]
        inside.append(off < found.quantile * found.std[:4])
    assert np.mean(inside) > 0.8


@pytest.mark.parametrize("hidden", ["lag", "water", "zero"])
def test_a_lag_a_current_and_a_zero_of_the_speeds_are_allowed_for(hidden):
    """By another integrator. Unallowed for, they put thrust and drag 10 to 110 standard deviations
    off without a word."""
    inside, off = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        lag = rng.uniform(0.3, 0.6) if hidden == "lag" else 0.0
        moves = rng.choice([-1.0, 1.0], 2) * rng.uniform(0.05, 0.15, 2) * (hidden == "water")
        zero = np.repeat(rng.choice([-1.0, 1.0]) * rng.uniform(0.03, 0.06), 2) * (hidden == "zero")
        inertia, runs = MASS - TRUE["X_udot"], []
        for shift in moves + zero:
            t = np.arange(0.0, 50.0, 0.1)
            n = np.select([t < 8.0, t < 16.0, t < 25.0], [10.0, 18.0, 25.0], 0.0)
            u, push, step, through = 0.0, 10.0 * TRUE["k1"] + 100.0 * TRUE["k2"], 0.002, []
            for k in range(len(t)):
                through.append(u)
                asked = n[k] * TRUE["k1"] + n[k] ** 2 * TRUE["k2"]
                for _ in range(50):
                    push += (asked - push) * (step / lag if lag else 1.0)
                    u += step * (push + TRUE["X_u"] * u + TRUE["X_uu"] * abs(u) * u) / inertia
            runs.append(Run(t, n, np.array(through) + shift + 0.01 * rng.standard_normal(len(t))))
        given = {"added_mass": TRUE["X_udot"]}
        found = fit_coast_downs(runs, MASS, **given, current_std=0.3, lag_std=0.2)
        blind = fit_coast_downs(runs, MASS, **given)
        true = np.array([TRUE[name] for name in found.names])[:4]
        inside.append(np.abs(found.values[:4] - true) < found.quantile * found.std[:4])
        off.append(np.abs((blind.values[:4] - true) / blind.std[:4]).max())
        told = " ".join(found.notes)
        assert ("time constant of" if hidden == "lag" else "run by run") in told, told
    assert np.mean(inside) > 0.8 and max(off) > 5.0


def test_intervals_count_what_the_scale_is_off_by():
    """A wrong added mass or mass scales all forces, which no residual tells; with a bollard pull
    a wrong mass makes X_udot wrong by as much."""
    known = fit_coast_downs(surge_runs(), MASS, added_mass=-7.0)
    off = fit_coast_downs(surge_runs(), MASS, added_mass=-4.0)
    assert np.all(np.abs(off.values - known.values)[:4] > 10.0 * known.std[:4])
    stated = fit_coast_downs(surge_runs(), MASS, added_mass=-7.0, added_mass_std=3.0)
    expected = np.hypot(known.std, off.values - known.values)
    np.testing.assert_allclose(stated.std, expected, rtol=1e-6)
    lighter = fit_coast_downs(surge_runs(), MASS - 1.0, added_mass=-7.0)
    stated = fit_coast_downs(surge_runs(), MASS, added_mass=-7.0, mass_std=1.0)
    expected = np.hypot(known.std, lighter.values - known.values)
    np.testing.assert_allclose(stated.std, expected, rtol=1e-6)
    pulled, doubtful = (
        fit_coast_downs(surge_runs(), MASS, bollard=(20.0, 28.0), mass_std=std)
        for std in (0.0, 1.0)
    )
    np.testing.assert_allclose(doubtful.std[:4], pulled.std[:4])
    assert doubtful.std[4] == pytest.approx(np.hypot(pulled.std[4], 1.0))


@pytest.mark.parametrize(
    ("runs", "options", "said"),
    [
        (surge_runs(), {}, "speeds do not tell forces"),
        ([], {"added_mass": -7.0}, "no run"),
        (surge_runs(), {"added_mass": 7.0}, "is negative"),
        ([Run(r.t[:240], r.n[:240], r.u[:240]) for r in surge_runs()], {"added_mass": -7.0},
         "no run coasts"),
        ([Run(r.t, r.n * 0.0, r.u) for r in surge_runs()], {"added_mass": -7.0}, "never turns"),
        (surge_runs(), {"bollard": (20.0, -5.0)}, "disagree about the sign"),
        (surge_runs(), {"bollard": (20.0, 5.0)}, "less than the mass"),
    ],
)  # fmt: skip
def test_what_runs_cannot_tell_is_said(runs, options, said):
    with pytest.raises(UserError, match=said):
        fit_coast_downs(runs, MASS, **options)


def test_coast_down_on_the_command_line(heavy_path, tmp_path, capsys):
    """As the library has it; by X_udot of the configuration, and by a bollard pull."""
    logs, runs = [], []
    for k, run in enumerate(surge_runs()):
        logs.append(tmp_path / f"run{k}.csv")
        table = np.column_stack([run.t, run.n, run.u])
        np.savetxt(logs[-1], table, "%.12g", ",", header="t_s,shaft,u", comments="")
        runs.append(Run(*np.loadtxt(logs[-1], delimiter=",", skiprows=1).T))
    heavy = config.load(heavy_path)
    mass = heavy.model.body.mass
    common = [*map(str, logs), "--map", "n=shaft", "--config", str(heavy_path)]
    result, saved = tmp_path / "result.json", tmp_path / "fitted.yaml"
    assert main(["coast-down", *common, "--json", str(result), "--save", str(saved)]) == 0
    assert "k1 n + k2 |n| n" in capsys.readouterr().out
    told = json.loads(result.read_text())
    found = fit_coast_downs(
        runs,
        mass,
        added_mass=heavy.value("X_udot"),
        mass_std=heavy.vehicle_uncertainty.mass_std * mass,
        added_mass_std=prior_of(heavy).std[heavy.estimate.index("X_udot")],
        current_std=heavy.current_std,
        lag_std=heavy.wrench.lag_std,
    )
    assert told["coefficients"] == found.entries()
    assert told["speed_rmse_mps"] == found.rmse
    assert told["coefficients"]["k2"]["unit"] == "N/n2"  # of whatever the column counts
    assert [bag["file"] for bag in told["provenance"]["bags"]] == ["run0.csv", "run1.csv"]
    assert config.load(saved).value("X_uu") == found.value("X_uu")
    values = {name: x for name, x in heavy.model.values.items() if name != "X_u"}
    config.dump(heavy.with_model(build(heavy.model.body, values)), tmp_path / "lacking.yaml")
    lacking = ["--config", str(tmp_path / "lacking.yaml")]
    assert main(["coast-down", *common[:-2], *lacking, "--save", str(saved)]) == 0
    for name in ("X_u", "X_uu"):  # together they are the drag of the runs
        assert config.load(saved).value(name) == found.value(name)
    thrust = 28.0 * (mass - heavy.value("X_udot")) / (MASS - TRUE["X_udot"])
    arguments = [*common, "--json", str(result), "--bollard", "20", str(thrust)]
    assert main(["coast-down", *arguments]) == 0
    told = json.loads(result.read_text())["coefficients"]["X_udot"]
    assert abs(told["value"] - heavy.value("X_udot")) < 4.0 * told["std"]
    once, copy = result.read_text(), tmp_path / "copy.csv"
    copy.write_bytes(logs[0].read_bytes())
    capsys.readouterr()
    assert main(["coast-down", str(copy), *arguments]) == 0
    twice = json.loads(result.read_text())
    assert twice["coefficients"] == json.loads(once)["coefficients"]
    (note,) = twice["notes"]
    assert note == f"{logs[0]} holds the same data as {copy}: it counts once"
    assert note in capsys.readouterr().err
    assert main(["coast-down", *common[:2], "--config", str(heavy_path)]) == 2
    assert "--map n=HEADING" in capsys.readouterr().err


def sea_log(path, **changed):
    """Ten seconds at rest, ten driven, ten at rest; (N,) columns by their headings."""
    t = np.arange(0.0, 30.0, 0.1)
    driven = (t >= 10.0) & (t < 20.0)
    columns = {"t_s": t} | {name: 0.01 * np.sin(3.0 * t + k) for k, name in enumerate("uvwpqr")}
    columns |= dict.fromkeys("XYZKMN", 0.0 * t) | {"roll": 0.0 * t, "pitch": 0.0 * t}
    columns["X"] = 20.0 * driven
    columns |= changed
    rows = [",".join(columns)]
    for row in zip(*columns.values(), strict=True):
        rows.append(",".join("" if np.isnan(x) else f"{x:.9g}" for x in row))
    path.write_text("\n".join(rows))
    return t, columns


def imported(path, *options):
    """The odometry of a log imported with options, (N,) messages."""
    out = path.with_suffix(".mcap")
    assert main(["import", str(path), "--out", str(out), *options]) == 0
    return [m for role, m in messages_in(out) if role == "odom"]


def test_a_log_is_prepared_on_the_command_line(tmp_path, capsys):
    path = tmp_path / "log.csv"
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 30.0, 0.1)
    spoilt = 0.01 * np.sin(3.0 * t)
    spoilt[100:300:50] += 2.0
    true = 5.0 + 0.1 * t
    sparse = np.where(np.arange(len(t)) % 5 == 0, true + 0.3 * rng.standard_normal(len(t)), np.nan)
    exact = true + 0.5 + 0.01 * rng.standard_normal(len(t))
    _, columns = sea_log(path, u=spoilt, usbl=sparse, ins=exact)
    plain = imported(path)
    assert len(plain) == len(t)
    assert plain[100].linear[0] > 1.0

    messages = imported(
        path, "--polarity", "w", "--despike", "--cut-idle", "2",
        "--depth", "usbl=0.3", "ins=0.01,1.0",
    )  # fmt: skip
    said = capsys.readouterr().err
    assert "outliers replaced: 4 of u" in said
    assert "from 2 sources" in said and "cut to" in said
    stamps = np.array([m.stamp for m in messages]) * 1e-9 - 1.0
    assert stamps[0] == pytest.approx(8.0) and stamps[-1] == pytest.approx(21.9, abs=0.11)
    at = np.searchsorted(t, stamps + 1e-6) - 1
    # the default axes of a CSV are forward-starboard-down
    linear = np.array([m.linear for m in messages])
    assert np.abs(linear[:, 0]).max() < 0.05
    np.testing.assert_allclose(linear[:, 2], -columns["w"][at], atol=1e-8)
    depth = np.array([m.position[2] for m in messages])
    assert np.abs(depth - true[at]).max() < 0.2

    messages = imported(path, "--cut", "5", "9", "--smooth", "0.1")
    assert [messages[0].stamp, messages[-1].stamp] == [6_000_000_000, 10_000_000_000]
    assert max(abs(m.angular[0]) for m in messages) < 0.004


def test_fins_in_degrees_drive_a_log(heavy, tmp_path, capsys):
    """The stretch in which a rudder moves is kept; angles recorded in degrees become radians."""
    path = tmp_path / "log.csv"
    t = np.arange(0.0, 30.0, 0.1)
    rudder = np.where((t >= 10.0) & (t < 20.0), 12.0 * np.sign(np.sin(t)), 0.1)
    sea_log(path, X=0.0 * t, rudder=rudder, yaw=np.degrees(0.01 * t))
    options = ["--map", "delta_r=rudder", "--degrees", "delta_r", "yaw", "--cut-idle", "2"]
    assert main(["import", str(path), "--out", str(tmp_path / "log.mcap"), *options]) == 0
    assert "cut to 8.0 ... 21.9 s" in capsys.readouterr().err
    bag, config_ = Bag(tmp_path / "log.mcap"), finned(heavy)
    read = topics.messages(bag, topics.select(bag, config_), config_)
    joints = [m for role, m in read if role == DRIVE]
    assert max(abs(m.position[0]) for m in joints) == pytest.approx(np.radians(12.0))
    command = ["import", str(path), "--out", str(tmp_path / "other.mcap"), "--map"]
    assert main([*command, "delta_r=rudder", "--degrees", "u"]) == 2
    assert "--degrees u" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--cut", "5", "5.1"], "no rows are left"),
        (["--polarity", "yaw"], "the log has no `yaw`"),
        (["--depth", "sonar=0.1"], "has no column `sonar`"),
        (["--smooth", "6"], "is too high a corner"),
        (["--smooth", "0.01"], "too few"),
    ],
)
def test_what_cannot_be_prepared_is_said(tmp_path, capsys, options, said):
    path = tmp_path / "log.csv"
    sea_log(path)
    assert main(["import", str(path), "--out", str(tmp_path / "log.mcap"), *options]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "log.mcap").exists()
