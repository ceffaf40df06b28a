"""What is taken for constant, and changes during a record, is told."""

import itertools

import numpy as np
import pytest
import yaml
from tiers import more

import rov_ident as ri
from bench.simulators import sea
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


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_a_parameter_that_the_model_lacks_is_told(share):
    """By what it would change beside all others, of which one is much like it."""
    found = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        x = rng.standard_normal((COUNT, 100, 4)) * rng.uniform(0.5, 2.0, (COUNT, 1, 4))
        x[:, :, 3] += x[:, :, 0]
        y = share * x[:, :, 3] + rng.standard_normal((COUNT, 100))
        informations = np.einsum("cra,crb->cab", x, x)
        # at the prior's mean, which is not the likeliest value of the others
        precision, mean = np.array([0.0, 4.0, 0.0]), np.array([0.3, 0.5, -0.2])
        y += x[:, :, :3] @ (mean + np.array([1.0, 0.5 * rng.standard_normal(), -2.0]))
        scores = np.einsum("cra,cr->ca", x, y - x[:, :, :3] @ mean)
        nothing = np.zeros(3)
        found.append(constancy.lacking(scores, informations, precision, nothing, nothing > 0.0)[0])
    beyond = np.mean(np.abs(found) > constancy.UNLIKELY)
    assert beyond > 0.7 if share else beyond <= 0.01
    assert 0.7 < np.std(found) < 1.2 if not share else np.min(found) > 0.0


def leaking(vehicle, truth, rng):
    """(N, 6): a buoyancy that leaks away throughout the dive, and how much of it, N."""
    lost = rng.uniform(0.5, 1.0)
    force = np.linspace(0.0, lost, len(truth.t))[:, None] * sea.rotations(truth.state[:, 3:7])[:, 2]
    return np.hstack([force, np.cross(vehicle.cob, force)]), lost


def remembering(vehicle, truth, rng):
    """(N, 6): a tenth of the drag more, until the water follows the motion in a second or two."""
    nu = truth.state[:, 7:]
    drag = np.zeros_like(nu)
    for name, value in vehicle.theta.items():
        axis = "XYZKMN".index(name[0])
        if not name.endswith("dot"):
            drag[:, axis] += value * np.abs(nu[:, axis]) ** (len(name) - 3) * nu[:, axis]
    late, time = drag.copy(), rng.uniform(1.0, 2.0)
    for k, step in enumerate(np.diff(truth.t), 1):
        late[k] = late[k - 1] - np.expm1(-step / time) * (drag[k] - late[k - 1])
    return 0.1 * (drag - late), None


def written(folder, messages, truth, acting, told):
    """Bag and configuration of a dive on which a wrench (N, 6) has acted, too, that is not read."""
    begin = messages[0][2].stamp

    def without(message):
        """A wrench as read, less what is hidden: the vehicle moved as if it had acted, too."""
        k = np.searchsorted(truth.t - truth.t[0], 1e-9 * (message.stamp - begin))
        force, torque = acting[min(k, len(acting) - 1)].reshape(2, 3)
        return message._replace(
            force=message.force - FLU * force, torque=message.torque - FLU * torque
        )

    bag, file = folder / "dive.mcap", folder / "vehicle.yaml"
    write_messages(bag, [(a, r, without(m) if r == "wrench" else m) for a, r, m in messages])
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": told}}))
    return bag, file


HIDDEN = {"leak": leaking, "memory": remembering}


@pytest.mark.parametrize(
    ("seed", "hidden"),
    [(0, "leak"), (0, "memory"),
     *more((0, ""), *itertools.product(range(1, 6), ("leak", "memory", "")))],
)  # fmt: skip
def test_what_hides_in_other_parameters_is_told(tmp_path, seed, hidden):
    """In innovations over a second nothing shows, while drag was up to 4 standard deviations
    wrong beside a buoyancy that leaks away, and added masses up to 12 beside a drag with memory, in
    fits that were said to agree."""
    rng = np.random.default_rng([seed, 77])
    vehicle, unknown = sea.draw_vehicle(rng), sea.Sea(odometry_rate=10.0)
    truth = sea.dive(vehicle, unknown, "six-axis", 70.0, rng)
    messages = sea.measured(truth, unknown, rng)
    acting, size = HIDDEN[hidden](vehicle, truth, rng) if hidden else (np.zeros((1, 6)), None)
    bag, file = written(tmp_path, messages, truth, acting, sea.told(vehicle, unknown, rng))
    found = ri.fit(bag, file, "ml").consistency
    tests = {test.name: test for test in found.tests}
    assert "constancy of ocean_current.north" in tests and "memory of the drag: X" in tests
    assert "missing term: Y_pdot" in tests
    assert "constancy of cog_offset.dx" not in tests
    late = [test.name for test in found.tests if "memory" in test.name and not test.passed]
    assert tests["constancy of buoyancy.delta"].passed == (hidden != "leak")
    assert bool(late) == (hidden == "memory")
    assert found.consistent == (not hidden), found.sentence
    if hidden == "leak":
        changed = tests["constancy of buoyancy.delta"].failure.split(" by ")[1].split()[0]
        assert float(changed) == pytest.approx(size, rel=0.3)


@pytest.mark.parametrize(
    ("seed", "coupling"), [(0, 0.0), (0, 0.03), *more((1, 0.0), (1, 0.02), (2, 0.0), (2, 0.02))]
)
def test_a_recursive_fit_says_what_the_model_lacks(tmp_path, seed, coupling):
    """Y_r and N_v of some hundredths of a newton second, in the wrench less than a hundredth."""
    rng = np.random.default_rng([seed, 77])
    vehicle, unknown = sea.draw_vehicle(rng), sea.Sea(odometry_rate=10.0)
    truth = sea.dive(vehicle, unknown, "six-axis", 70.0, rng)
    messages = sea.measured(truth, unknown, rng)
    acting = np.zeros((len(truth.t), 6))
    acting[:, 1], acting[:, 5] = coupling * truth.state[:, 12], coupling * truth.state[:, 8]
    bag, file = written(tmp_path, messages, truth, acting, sea.told(vehicle, unknown, rng))
    found = ri.fit(bag, file, "rls").consistency
    missing = {t.name[14:]: t.value for t in found.tests if t.name.startswith("missing term: ")}
    assert found.consistent == (not coupling), found.sentence
    if missing and coupling:
        assert max(missing, key=lambda name: missing[name])[:3] in ("Y_r", "N_v")
    else:
        assert len(missing) > 30
