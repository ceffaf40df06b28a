"""A vehicle without a velocity sensor: what can be told is, the rest is said to be impossible."""

import json
from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np
import pytest
import yaml

import rov_ident as ri
from bench import HEAVY, ROOT
from bench.simulators import sea
from bench.studies.without_velocity import stripped
from rov_ident.api import identification
from rov_ident.cli.program import main
from rov_ident.config.prior import prior_of
from rov_ident.core.messages import Odometry
from rov_ident.core.states import State
from rov_ident.io import topics
from rov_ident.io.bag_reader import Bag
from rov_ident.io.write_messages import write_messages
from rov_ident.reports.result import NORMAL
from rov_ident.sampling.records import read_record
from rov_ident.sampling.without_velocity import refuse_without_velocity

NOT_MEASURED = {
    "large variance": (0.0, 1e6),
    "variance of minus one": (0.0, -1.0),
    "NaN": (np.nan, 0.0),
    "zeros": (0.0, 0.0),
}


@pytest.fixture(scope="module")
def messages():
    """The first messages of the shipped dive."""
    bag, config = Bag(ROOT / "bags" / "demo.mcap"), ri.load(HEAVY)
    return list(islice(topics.messages(bag, topics.select(bag, config), config), 300))


def written(path, messages, linear, variance, every=1):
    """The messages, of whose velocities one of ``every`` is replaced; None leaves a field."""
    rows = []
    for k, (role, message) in enumerate(messages):
        if isinstance(message, Odometry) and k % every == 0:
            given = message.twist_variance.copy()
            given[:3] = given[:3] if variance is None else variance
            velocity = message.linear if linear is None else np.full(3, linear)
            message = message._replace(linear=velocity, twist_variance=given)
        rows.append((message.stamp, role, message))
    write_messages(path, rows)
    return path


def refuse(path):
    bag, config = Bag(path), ri.load(HEAVY)
    refuse_without_velocity(bag, topics.select(bag, config), config)


@pytest.mark.parametrize("how", NOT_MEASURED)
def test_velocities_that_were_not_measured(messages, tmp_path, how):
    path = written(tmp_path / "dive.mcap", messages, *NOT_MEASURED[how])
    with pytest.raises(ri.UserError, match=r"Surge and sway, .* are impossible to identify so"):
        refuse(path)


@pytest.mark.parametrize(
    ("linear", "variance", "every"),
    [
        (None, None, 1),
        (None, -1.0, 1),  # a driver that knows no variance
        (np.nan, 0.0, 2),  # a DVL that loses the ground now and then
    ],
)
def test_velocities_that_were(messages, tmp_path, linear, variance, every):
    refuse(written(tmp_path / "dive.mcap", messages, linear, variance, every))


def test_a_vehicle_at_rest_is_another_matter(messages, tmp_path):
    still = [
        (role, m._replace(position=np.zeros(3)) if isinstance(m, Odometry) else m)
        for role, m in messages
    ]
    refuse(written(tmp_path / "rest.mcap", still, *NOT_MEASURED["zeros"]))


def test_without_depth_too_nothing_is_left(messages, tmp_path):
    flat = [
        (role, m._replace(position=np.zeros(3)) if isinstance(m, Odometry) else m)
        for role, m in messages
    ]
    path = written(tmp_path / "flat.mcap", flat, *NOT_MEASURED["large variance"])
    with pytest.raises(ri.UserError, match="neither linear velocity nor depth"):
        ri.read(path, HEAVY)


def test_who_cannot_do_without_names_the_way(messages, tmp_path, capsys):
    path = str(written(tmp_path / "dive.mcap", messages, *NOT_MEASURED["NaN"]))
    given, out = ["--config", str(HEAVY)], str(tmp_path / "out")
    for command in (
        *(["fit", path, *given, "--estimator", kind] for kind in ("rls", "ukf", "ls", "iv")),
        ["fit", path, *given, "--channels", "heave"],
        ["explain", path, *given, "--out", out],
    ):
        assert main(command) == 2, command
        shown = capsys.readouterr()
        assert "dive.mcap has no linear velocity: " in shown.err, command
        assert "--estimator ml" in shown.err and "(DVL)" in shown.err and not shown.out


def test_nothing_scores_what_was_not_measured(messages, tmp_path, capsys):
    path = str(written(tmp_path / "dive.mcap", messages, *NOT_MEASURED["large variance"]))
    found = tmp_path / "found.json"
    command = ["simulate", "--config", str(HEAVY), "--bag", path, "--json", str(found)]
    assert main([*command, "--out", str(tmp_path / "out.mcap")]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "/s" in line]
    assert ["not measured" in row for row in rows] == [True] * 3 + [False] * 3
    velocities = json.loads(found.read_text())["velocities"]
    assert velocities["u"]["r2"] is None and velocities["u"]["rmse"] is None
    assert velocities["r"]["rmse"] > 0.0
    assert ri.simulate(HEAVY, bag=path).plot()


def test_the_depth_is_that_of_the_origin(messages, tmp_path, heavy):
    """A pose is that of the body; `odometry.position` is the place of the velocity sensor."""
    path = written(tmp_path / "without.mcap", messages, *NOT_MEASURED["large variance"])
    placed = replace(heavy, odometry=replace(heavy.odometry, position=(0.4, 0.1, 0.2)))
    depths = [read_record(path, config).samples["depth"] for config in (heavy, placed)]
    assert np.ptp(depths[0]) > 0.0
    np.testing.assert_array_equal(*depths)


def test_bags_with_and_without_are_fitted_apart(messages, tmp_path):
    without = written(tmp_path / "without.mcap", messages, *NOT_MEASURED["large variance"])
    measured = written(tmp_path / "with.mcap", messages, None, None)
    with pytest.raises(ri.UserError, match=r"without\.mcap has no linear velocity, and other bags"):
        ri.fit([measured, without], HEAVY)


# ------------------------------------------------------------------ what is told, and what is not


def dive(folder, driving, seed, seconds):
    """Bag, file and true coefficients of a dive by a simulator that shares no code with ours."""
    vehicle = sea.draw_vehicle(np.random.default_rng([seed, 0]))
    truth = sea.dive(vehicle, sea.Sea(), driving, seconds, np.random.default_rng([seed, 1]))
    messages = stripped(sea.measured(truth, sea.Sea(), np.random.default_rng([seed, 2])))
    parameters = sea.told(vehicle, sea.Sea(), np.random.default_rng([seed, 3]))
    bag, file = folder / f"{driving}{seed}.mcap", folder / f"{driving}{seed}.yaml"
    write_messages(bag, messages)
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))
    return bag, file, vehicle.theta


@pytest.fixture(scope="module")
def turning(tmp_path_factory):
    """Heave and all rotations driven, surge and sway at rest; long enough to be judged."""
    return dive(tmp_path_factory.mktemp("turning"), "four-axis", 1, 24.0)


@pytest.fixture(scope="module")
def identified(turning):
    """The next manoeuvre that is planned lasts 10 s, not a minute: a sixth of the search."""
    bag, file, _ = turning
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(identification, "plan", partial(ri.plan, duration=10.0))
        return ri.identify(bag, file)


def sigmas(fit, theta):
    """Errors in standard deviations, by name."""
    at = [fit.names.index(name) for name in theta]
    off = (fit.values[at] - np.array(list(theta.values()))) / fit.std[at]
    return dict(zip(theta, off.tolist(), strict=True))


def test_heave_and_turns_are_told_surge_and_sway_are_not(turning, identified):
    *_, theta = turning
    fit = identified.fit
    prior = prior_of(fit.given, effects=True)
    for name, off in sigmas(fit, theta).items():
        i = fit.names.index(name)
        assert abs(off) < 4.0, name
        if name[0] in "XY":
            assert fit.states[i] is State.HELD and not fit.identifiable[i]
            assert fit.std[i] == pytest.approx(prior.std[i])
        else:
            assert fit.identifiable[i], name
    document = json.loads(fit.to_json())
    assert document["impossible"] == [name for name in fit.given.estimate if name[0] in "XY"]
    assert document["open_loop"]["rmse"]["u"] is None and document["open_loop"]["rmse"]["p"] > 0.0
    assert any("no linear velocity" in note for note in fit.notes)
    told = "Impossible to tell without linear velocity: X_udot"
    assert any(told in advice for advice in fit.advice)
    assert "Impossible to tell" in fit.page()
    assert not {"ocean_current.north", "velocity_latency.delay"} & {*fit.names}


@pytest.mark.study
def test_intervals_hold_over_seeds(tmp_path):
    off = []
    for seed in range(2, 8):
        bag, file, theta = dive(tmp_path, "four-axis", seed, 40.0)
        found = sigmas(ri.fit(bag, file), theta)
        off += [abs(x) for name, x in found.items() if name[0] not in "XY"]
    assert np.mean(np.array(off) < NORMAL) > 0.88  # of 72, by two standard deviations
    assert max(off) < 4.0


@pytest.mark.study
def test_where_surge_and_sway_are_driven_nothing_is_sure(tmp_path):
    """How fast they go is not measured; it is said what to fly instead."""
    bag, file, theta = dive(tmp_path, "pilot", 0, 30.0)
    fit = ri.fit(bag, file)
    assert not fit.consistency.consistent and State.CONVERGED not in fit.states
    assert "while surge and sway rest" in fit.sentence
    assert max(abs(x) for x in sigmas(fit, theta).values()) < 4.0


def test_check_and_identify_go_the_same_way(identified, tmp_path):
    (checked,) = identified.checks
    assert checked.fit and "velocity not measured" in str(checked)
    out = tmp_path / "out"
    identified.save(out)
    shown = [identified.sentence, str(identified), *identified.notes, *identified.advice]
    shown = " ".join(" ".join(shown).split())
    assert "Without linear velocity it cannot be told what the model lacks" in shown
    assert "cannot be told and keep the prior's intervals" in shown
    assert "while surge and sway rest" in shown
    assert "Is it good now?" in (out / "report.html").read_text()
    assert ri.load(out / "extended.yaml").name == "at_sea"
    found = json.loads((out / "result.json").read_text())
    assert found["explain"] is None and set(found["rmse"]) == {"p", "q", "r"}


def test_plan_lets_surge_and_sway_rest(turning):
    """And what no manoeuvre can show is not what it aims at."""
    bag, file, _ = turning
    found = ri.plan(file, [bag], duration=10.0)
    assert found.candidates
    assert not any(any(c.manoeuvre.amplitude[:2]) for c in found.candidates)
    assert any("surge and sway have to rest" in reason for reason in found.left_out)
    now, then = (
        next(p for p in side if p.name == found.worst) for side in (found.before, found.after)
    )
    assert found.worst[0] not in "XY" and then.std < 0.9 * now.std
