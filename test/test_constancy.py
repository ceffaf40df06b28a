"""What is taken for constant, and changes during a record, is told."""

import itertools

import numpy as np
import pytest
import yaml
from tiers import more

import rov_ident as ri
from bench.simulators import sea
from rov_ident.core.frames import quaternion_to_matrix
from rov_ident.io.write_messages import write_messages
from rov_ident.offline import constancy

COUNT = constancy.STRETCHES
FLU = np.array([1.0, -1.0, -1.0])  # the axes of messages, of vectors along those of the simulator


def regression(rng, slope=0.0, noise=None, rows=100):
    """Scores and informations of stretches of y = x theta + noise, theta estimated from all, the
    first of them sloping."""
    x = rng.standard_normal((COUNT, rows, 3)) * rng.uniform(0.5, 2.0, (COUNT, 1, 3))
    x[:, :, 1] += x[:, :, 0]  # what imitates another
    noise = rng.standard_normal((COUNT, rows)) if noise is None else noise
    time = (np.arange(COUNT * rows) / (COUNT * rows) - 0.5).reshape(COUNT, rows)
    y = slope * time * x[:, :, 0] + noise
    informations = np.einsum("cra,crb->cab", x, x)
    whole = informations.sum(axis=0)
    theta = np.linalg.solve(whole, np.einsum("cra,cr->a", x, y))
    return np.einsum("cra,cr->ca", x, y - x @ theta), informations, whole


def test_a_slope_is_found_of_the_parameter_that_has_one():
    for seed in range(20):
        z, change = constancy.slopes(*regression(np.random.default_rng(seed), slope=2.0))
        assert change[0] == pytest.approx(2.0, abs=0.6)
        assert abs(z[0]) > constancy.UNLIKELY > abs(z[2])
        assert abs(z[1]) < abs(z[0])  # what imitates it has a slope as well


@pytest.mark.parametrize("lasting", [False, True])
def test_chance_makes_none(lasting):
    """Nor does noise that lasts for a part of a stretch."""
    rng, found = np.random.default_rng(1), []
    for _ in range(1000):
        noise = None
        if lasting:
            noise = np.convolve(rng.standard_normal(COUNT * 100 + 19), np.ones(20), "valid")
            noise = noise.reshape(COUNT, 100)
        found.append(constancy.slopes(*regression(rng, noise=noise))[0])
    beyond = np.mean(np.abs(found) > constancy.UNLIKELY)
    assert beyond <= 0.003
    assert 0.8 < np.std(found) < 1.1


def test_the_scatter_of_stretches_tells_of_errors_that_last():
    """Of white noise it is the information, and of an error that lasts for ten rows of columns
    that do not change their sign more."""
    rng, white, lasting = np.random.default_rng(4), [], []
    for _ in range(200):
        scores, informations, _ = regression(rng)
        white.append(np.diag(constancy.scatter(scores) / informations.sum(axis=0)))
        x = 1.0 + 0.1 * rng.standard_normal((COUNT, 100, 1))
        e = np.repeat(rng.standard_normal((COUNT, 10)), 10, axis=1)
        e -= np.sum(x[:, :, 0] * e) / np.sum(x**2) * x[:, :, 0]
        lasting.append(constancy.scatter(np.sum(x[:, :, 0] * e, axis=1)[:, None]) / np.sum(x**2))
    np.testing.assert_allclose(np.mean(white, axis=0), 1.0, atol=0.1)
    assert np.mean(lasting) == pytest.approx(10.0, rel=0.1)
    assert not constancy.scatter(np.ones((COUNT - 1, 2))).any()


def test_where_a_few_stretches_tell_all_nothing_is_judged():
    scores, informations, _ = regression(np.random.default_rng(2), slope=5.0)
    share = np.where(np.arange(COUNT) < 2, 1.0, 1e-6)
    scores, informations = scores * share[:, None], informations * share[:, None, None]
    assert not constancy.slopes(scores, informations, informations.sum(axis=0)).any()


def test_of_several_records_the_worst_is_told():
    found = constancy.worst(
        [np.array([[1.0, -5.0], [0.1, -0.5]]), np.array([[-2.0, 4.0], [7.0, 8.0]])], 2
    )
    np.testing.assert_array_equal(found, [[-2.0, -5.0], [7.0, -0.5]])
    np.testing.assert_array_equal(constancy.worst([], 2), np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("seed", "leak"), [(0, True), *more((0, False), *itertools.product(range(1, 6), (True, False)))]
)
def test_a_buoyancy_that_leaks_away_is_told(tmp_path, seed, leak):
    """In innovations over a second nothing shows, while drag was up to 4 standard deviations
    wrong in a fit that was said to agree."""
    rng = np.random.default_rng([seed, 77])
    vehicle, unknown = sea.draw_vehicle(rng), sea.Sea()
    truth = sea.dive(vehicle, unknown, "six-axis", 70.0, rng)
    messages = sea.measured(truth, unknown, rng)
    file, bag = tmp_path / "vehicle.yaml", tmp_path / "dive.mcap"
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": sea.told(vehicle, unknown, rng)}}))
    lost = leak * rng.uniform(0.5, 1.0)  # N
    begin, end = messages[0][2].stamp, messages[-1][2].stamp

    def without(message):
        """A wrench as read, less what has leaked: the vehicle moved as if it had acted, too."""
        share = (message.stamp - begin) / (end - begin)
        k = np.searchsorted(truth.t - truth.t[0], share * (truth.t[-1] - truth.t[0]))
        force = share * lost * quaternion_to_matrix(truth.state[k, 3:7])[2]
        torque = np.cross(vehicle.cob, force)
        return message._replace(
            force=message.force - FLU * force, torque=message.torque - FLU * torque
        )

    write_messages(bag, [(a, r, without(m) if r == "wrench" else m) for a, r, m in messages])
    found = ri.fit(bag, file, "ml").consistency
    tests = {test.name: test for test in found.tests}
    assert "constancy of ocean_current.north" in tests
    assert "constancy of cog_offset.dx" not in tests
    assert tests["constancy of buoyancy.delta"].passed == (not leak)
    assert found.consistent == (not leak), found.sentence
    if leak:
        changed = tests["constancy of buoyancy.delta"].failure.split(" by ")[1].split()[0]
        assert float(changed) == pytest.approx(lost, rel=0.3)
