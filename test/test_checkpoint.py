"""Checkpoints: what is learnt outlives the process, and nothing else is taken for it."""

import json
import random
import resource

import numpy as np
import pytest
from std_srvs.srv import Trigger
from tiers import more

from bench import HEAVY
from bench.simulators.live import Dive, end_node, start_connected, start_node, until_said
from bench.studies.torture_live import kill_writers, lives
from rov_ident import config
from rov_ident.core.errors import UserError
from rov_ident.estimation import checkpoint
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.nodes.conversions import from_diagnostics
from rov_ident.simulation import virtual_sensors as sensors

KINDS = ["rls", "ukf"]
SECOND = 1_000_000_000


def contents(online):
    return checkpoint.packed(online.memory(), checkpoint.identity(online))


def fed(online, messages):
    for _, role, message in messages:
        online.push(role, message)
    return online


@pytest.fixture(scope="module", params=KINDS)
def learnt(request, heavy, short_dive):
    return fed(OnlineEstimator(heavy, request.param), short_dive[: len(short_dive) // 2])


@pytest.fixture
def data(learnt):
    return contents(learnt)


def test_what_is_learnt_comes_back(heavy, learnt, data, tmp_path):
    """To the last bit; and the next run goes on as this one would after a gap."""
    path = tmp_path / "x.checkpoint"
    path.write_bytes(data)
    again = OnlineEstimator(heavy, learnt.kind)
    assert checkpoint.read(again, path)
    one, other = learnt.report(), again.report()
    assert one.stamp == other.stamp > 0
    assert (one.states, one.messages) == (other.states, other.messages)
    for name in ("values", "std", "covariance", "excitation"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    for mine, theirs in zip(again.state, learnt.state, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    bias = learnt.sampler.kinematic_filter.state["gyro_bias"]
    assert bias.any()
    np.testing.assert_array_equal(again.sampler.kinematic_filter.state["gyro_bias"], bias)


def test_the_next_run_learns_on(heavy, learnt, data, short_dive):
    rest = short_dive[len(short_dive) // 2 :]
    again = OnlineEstimator(heavy, learnt.kind)
    checkpoint.restore(again, data)
    fed(again, rest)
    unbroken = fed(OnlineEstimator(heavy, learnt.kind), short_dive).report()
    moved = np.abs(again.report().values - unbroken.values) / unbroken.std
    assert moved.max() < 0.5
    assert again.report().std.sum() < learnt.report().std.sum()


def test_effects_that_are_estimated_come_back(heavy, short_dive):
    document = config.to_parameters(heavy)
    document["effects"] = {"thruster_lag": {"time_constant": 0.1}}
    lagging = config.from_parameters(document)
    online = fed(OnlineEstimator(lagging, "rls"), short_dive)
    again = OnlineEstimator(lagging, "rls")
    checkpoint.restore(again, contents(online))
    assert again.report().effects == online.report().effects
    assert again.report().effects["thruster_lag.time_constant"] != 0.1


def test_no_file_is_no_error(heavy, tmp_path):
    assert not checkpoint.read(OnlineEstimator(heavy, "rls"), tmp_path / "none")


def refused(online, path, words):
    """The prior stays, the file is put aside."""
    before = contents(online)
    there = path.read_bytes()
    with pytest.raises(UserError, match=words) as caught:
        checkpoint.read(online, path)
    assert str(path) in str(caught.value)
    assert contents(online) == before
    assert not path.exists()
    assert path.with_name(f"{path.name}.refused").read_bytes() == there


def test_any_damage_is_noticed(heavy, learnt, data, tmp_path):
    """A bit anywhere, a cut anywhere, zeros, somebody else's file."""
    path = tmp_path / "x.checkpoint"
    numbers = random.Random(1)
    damaged = [b"", b"\0" * 4096, b"rov_ident checkpoint\n", b"t_s,u\n0,1\n", data + b"\0"]
    damaged += [data[: numbers.randrange(len(data))] for _ in range(20)]
    for place in [*range(90), *(numbers.randrange(len(data)) for _ in range(60))]:
        flipped = bytearray(data)
        flipped[place] ^= 1 << numbers.randrange(8)
        damaged.append(bytes(flipped))
    online = OnlineEstimator(heavy, learnt.kind)
    for content in damaged:
        path.write_bytes(content)
        refused(online, path, "no checkpoint|is damaged")


def forged(data, change):
    """A checkpoint with another header or body, and the checksum that belongs to it."""
    import hashlib

    start = len(b"rov_ident checkpoint\n") + 65
    head, _, rest = data[start:].partition(b"\n")
    header, rest = change(json.loads(head), rest)
    body = (header if isinstance(header, bytes) else json.dumps(header).encode()) + b"\n" + rest
    return b"rov_ident checkpoint\n" + hashlib.sha256(body).hexdigest().encode() + b"\n" + body


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda h, r: ({**h, "format": 0}, r), "another version"),
        (lambda h, r: ({**h, "structure": ""}, r), "another version"),
        (lambda h, r: ({**h, "configuration": "x"}, r), "another configuration"),
        (lambda h, r: ({**h, "estimator": "ekf"}, r), "another estimator"),
        (lambda h, r: ({**h, "stamp": None}, r), "header"),
        (lambda h, r: ([], r), "header"),
        (lambda h, r: (b"{" * 10000, r), "header"),
        (lambda h, r: (h, r[:-8]), "too early"),
        (lambda h, r: (h, np.full(len(r) // 8, np.nan).tobytes()), "not finite"),
    ],
)
def test_a_checkpoint_that_does_not_fit(heavy, learnt, data, tmp_path, change, words):
    path = tmp_path / "x.checkpoint"
    path.write_bytes(forged(data, change))
    refused(OnlineEstimator(heavy, learnt.kind), path, words)


def test_only_the_same_configuration_and_estimator(heavy, learnt, data, tmp_path):
    """What may change while a node runs makes no difference; all else does."""
    path = tmp_path / "x.checkpoint"
    document = config.to_parameters(heavy)
    live = {"rls": {"gate": 7.0}, "ukf": {"gate": 7.0}, "publish_rate": 2.0, "timeout": 3.0}
    live |= {"qos": {"reliability": "reliable"}, "topics": {"odom": "/o"}}
    path.write_bytes(data)
    assert checkpoint.read(
        OnlineEstimator(config.from_parameters({**document, **live}), learnt.kind), path
    )
    others = [
        {**document, "odometry": {"linear_std": 0.02}},
        {**document, "coefficients": {**document["coefficients"], "X_u": -1.0}},
        {**document, "vehicle": {**document["vehicle"], "mass": 14.0}},
        {**document, "estimate": ["X_u"]},
    ]
    for other in others:
        path.write_bytes(data)
        online = OnlineEstimator(config.from_parameters(other), learnt.kind)
        refused(online, path, "another configuration")
    path.write_bytes(data)
    kind = next(kind for kind in KINDS if kind != learnt.kind)
    refused(OnlineEstimator(heavy, kind), path, "another estimator")


def test_a_writer_killed_at_any_time_leaves_a_whole_file(heavy, short_dive, tmp_path):
    """Forty processes that do nothing but write, killed after some milliseconds."""
    online = OnlineEstimator(heavy, "rls")
    versions = [contents(online), contents(fed(online, short_dive[:500]))]
    broken, missed, spare = kill_writers(tmp_path / "x.checkpoint", versions, 40)
    assert broken == missed == 0
    assert spare <= 1  # a single part, at most


def test_a_place_that_cannot_be_written(heavy, learnt, tmp_path):
    (tmp_path / "file").write_text("")
    keeper = checkpoint.Keeper(tmp_path / "file" / "folder" / "x.checkpoint", learnt)
    keeper.keep()
    keeper.close()
    assert keeper.failure.endswith(f"cannot be written: {tmp_path / 'file'} is not a folder")
    assert keeper.saved == 0


def test_a_path_has_one_writer(heavy, learnt, tmp_path):
    """Of several keepers only the first writes; the next one has it after that is closed."""
    path = tmp_path / "x.checkpoint"
    first = checkpoint.Keeper(path, learnt)
    other = checkpoint.Keeper(tmp_path / "." / "x.checkpoint", OnlineEstimator(heavy, learnt.kind))
    other.keep()
    other.close()
    assert other.refused and "another node writes" in other.failure
    assert not path.exists()
    first.keep()
    first.close()
    assert first.failure == "" and path.read_bytes() == contents(learnt)
    third = checkpoint.Keeper(path, learnt)
    third.close()
    assert not third.refused


# ------------------------------------------------------------------ nodes


@pytest.mark.parametrize("kind", ["rls", *more("ukf")])
def test_a_node_killed_goes_on_within_a_second(domain, heavy, tmp_path, kind):
    """kill -9 at random times; what comes back is what an unbroken estimator had at that stamp."""
    dive = Dive(sensors.dive(heavy, duration=20.0, seed=4).messages)
    reference = OnlineEstimator(heavy, kind)
    known = {}  # values by stamp, of the first life
    for _, role, message in dive.messages:
        if len(reference.push(role, message)):
            known[reference.stamp] = reference.report().values
    one, other = lives(kind, tmp_path / "folder" / "x.checkpoint", dive, 2, 2.0, 4.0)
    assert one.first.stamp == 0
    assert one.last.stamp - SECOND < other.first.stamp < other.last.stamp
    assert other.first.stamp > 0
    np.testing.assert_array_equal(other.first.values, known[other.first.stamp])
    assert "continuing from" not in one.said and "continuing from" in other.said
    assert "not used" not in one.said + other.said


@pytest.fixture
def begun(domain):
    """Starts a node with a checkpoint; gives it and the vehicle that it has found."""
    processes = []

    def begin(path, kind):
        options = [f"checkpoint_path:={path}", "publish_rate:=50.0"]
        process, vehicle = start_connected(kind, *options)
        processes.append(process)
        vehicle.until(lambda: vehicle.coefficients)
        return process, vehicle

    yield begin
    for process in processes:
        process.kill()  # where the test has failed
        process.wait()


def test_a_damaged_checkpoint_and_a_full_disk(begun, heavy, tmp_path):
    """Refused in one sentence; then the node goes on though nothing can be written, and says so."""
    path = tmp_path / "x.checkpoint"
    online = fed(OnlineEstimator(heavy, "rls"), sensors.dive(heavy, duration=3.0).messages)
    path.write_bytes(contents(online)[:-1])
    process, vehicle = begun(path, "rls")
    first = from_diagnostics(vehicle.coefficients[0])
    assert first.stamp == 0
    np.testing.assert_array_equal(first.values, heavy.model.theta)
    dive = Dive(sensors.dive(heavy, duration=20.0, seed=4).messages)
    dive.play(vehicle, 1.5)
    vehicle.until(lambda: "what is learnt is on disk" in vehicle.words())
    second = start_node("rls", HEAVY, f"checkpoint_path:={path}")
    until_said(second, "another node writes")
    assert end_node(second)[0] == 0
    there = path.read_bytes()
    online = OnlineEstimator(heavy, "rls")
    checkpoint.restore(online, there)
    assert online.stamp > 0

    # No file of this process may grow from here on: what a full disk is like, but without mounts.
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
    dive.play(vehicle, 1.5)
    vehicle.until(lambda: "cannot be written: File too large" in vehicle.words())
    stamp = from_diagnostics(vehicle.coefficients[-1]).stamp
    assert checkpoint.read(online, path) and online.stamp < stamp
    assert list(tmp_path.glob(".*.part")) == []
    answer = vehicle.call(Trigger, "save", Trigger.Request())
    assert not answer.success and "cannot be written" in answer.message

    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
    vehicle.diagnostics.clear()
    dive.play(vehicle, 1.0)
    vehicle.until(lambda: "what is learnt is on disk" in vehicle.words())
    vehicle.close()
    status, said = end_node(process)
    assert status == 0, said
    assert said.count("is not used, it is damaged") == 1
    assert "beginning with the prior" in said
    # An end that is no crash loses nothing at all.
    checkpoint.restore(online, path.read_bytes())
    assert online.stamp > stamp
