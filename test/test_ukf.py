"""The unscented filter: equal to filterpy's, alive after an hour of nothing, honest over seeds."""

import dataclasses

import numba
import numpy as np
import pytest
import textbook
from textbook import with_section
from tiers import more

from rov_ident import config as configuration
from rov_ident.config.prior import prior_of
from rov_ident.estimation import reference_ukf, ukf
from rov_ident.estimation.innovation_monitor import NIS_TIME
from rov_ident.estimation.mass_inverse import invert_mass, invert_translation
from rov_ident.estimation.physical import is_passive, physical
from rov_ident.estimation.reference_ukf import ReferenceUkf
from rov_ident.sampling.sample import SAMPLE
from rov_ident.simulation.manoeuvres import manoeuvre

DT = 0.05
COUPLINGS = {
    "Y_v": -25.0, "K_p": -0.3, "N_r": -0.8, "Y_rdot": 0.4, "Z_qdot": -0.2, "Y_r": 0.6, "N_v": 0.3,
    "Z_q": 0.2, "M_w": -0.3, "X_vv": -20.0, "X_ww": -15.0, "Y_uv": -9.0, "N_uv": 2.0, "Z_uw": -8.0,
    "Y_v_abs_r": -1.0,
}  # fmt: skip


def driven(config, duration, seed, name="steps", dt=DT, model=None, start=None):
    t = np.arange(0.0, duration, dt)
    wrench = manoeuvre(name, config.model, t, np.random.default_rng(seed))
    return textbook.drive(model or config.model, t, wrench, *(start or ())), wrench


def result(config, rows, state=None):
    task, prior = ukf.problem(config), prior_of(config)
    state, info = ukf.fold(task, state or ukf.init(task), rows)
    return ukf.estimate(task, state, prior), state, info


def coupled(heavy):
    parameters = configuration.to_parameters(heavy)
    parameters["coefficients"].update(COUPLINGS)
    return configuration.from_parameters(parameters)


@pytest.fixture(scope="module")
def noisy(heavy):
    return textbook.rows_of(*driven(heavy, 60.0, 12), np.random.default_rng(0), wrench_std=0.01)


@pytest.fixture(scope="module")
def dives(heavy):
    return textbook.prior_and_samples(heavy, range(6), 90.0)


def wrong_prior(config, seed=5, spread=0.2):
    factors = 1.0 + spread * np.random.default_rng(seed).uniform(-1, 1, len(config.model.theta))
    return textbook.off(config, factors)


# ------------------------------------------------------------------ filterpy


class ByTheBook(ReferenceUkf):
    """filterpy's filter on equations that are written a second time."""

    def acceleration(self, theta, nu, tau, down):
        model = self.model
        ballast = textbook.ballast(model.with_theta(theta).mass_matrix, model.body.mass_matrix)
        return textbook.acceleration(model.body, model.coefficients, theta, nu, tau, down, ballast)


def mixed(rows, every):
    """Odometry with only every so many samples, gyro with each."""
    rows = rows.copy()
    without = np.arange(len(rows)) % every > 0
    rows["odometry"][without] = np.nan
    rows["measured"] = ~without
    return rows


@pytest.mark.parametrize(
    "names, alpha, dt, kind",
    [
        (12, 0.1, 0.05, "odometry"),
        *more((30, 0.1, 0.05, "mixed")),
        *more((15, 0.5, 0.02, "mixed"), (15, 1.0, 0.05, "odometry"), (12, 0.1, 0.2, "mixed")),
    ],
)
def test_equals_filterpy(heavy, names, alpha, dt, kind):
    """State and covariance to 1e-9 after every one of 60 samples, a restart among them."""
    config = coupled(heavy) if names > 15 else heavy
    assert names <= len(config.model.names)
    rng = np.random.default_rng(names)
    rows = textbook.rows_of(
        *driven(config, 65 * dt, 31, dt=dt), rng, wrench_std=0.01, gyro=kind == "mixed"
    )
    rows["wrench_slope"] = rng.standard_normal((len(rows), 6)) * [9.0, 9.0, 9.0, 0.5, 0.5, 0.5]
    if kind == "mixed":
        rows = mixed(rows, 4)
    k = 31
    rows["restart"][k], rows["dt"][k], rows["odometry"][k] = True, 0.0, rows["nu"][k]
    config = wrong_prior(config, spread=0.1)
    config = dataclasses.replace(config, estimate=config.model.names[:names])
    config = with_section(config, "ukf", alpha=alpha, gate=1e6, random_walk=0.1)
    task = ukf.problem(config)
    state = ukf.init(task)
    peer = ByTheBook(config, task, state)
    assert len(state.x) == 6 + names
    for i in range(len(rows)):
        before = state
        state, info = ukf.step(task, before, rows[i : i + 1])
        peer.step(rows[i], before, state, info[0])
        assert info["reason"][0] in (ukf.USED, ukf.RESTARTED)
        error = np.abs(state.x - peer.filter.x) / np.sqrt(np.diag(peer.filter.P))
        assert error.max() < 1e-6, f"state at sample {i}"
        scale = np.sqrt(np.diag(peer.filter.P))
        off = np.abs(state.p - peer.filter.P) / np.outer(scale, scale)
        assert off.max() < 1e-6, f"covariance at sample {i}"
    np.testing.assert_allclose(state.x, peer.filter.x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.diag(state.p), np.diag(peer.filter.P), rtol=1e-7)


def test_the_reference_follows_outliers_and_what_does_not_move(heavy):
    """Also a velocity that is lost after two outliers, and coefficients that walk."""
    config = with_section(wrong_prior(heavy), "ukf", random_walk=0.1)
    rows = textbook.rows_of(*driven(config, 6.0, 3), np.random.default_rng(3), wrench_std=0.01)
    rows["moving"][30:60, 1], rows["moving"][50:80, 3:] = False, False
    rows["odometry"][40, 0] += 1.0
    rows["odometry"][[70, 71], 1] -= 1.0
    told = []
    found = reference_ukf.compare(config, rows, lambda what, share: told.append(share))
    assert tuple(found["coefficients"]) == config.model.names and found["samples"] == len(rows)
    of_both = found["coefficients"].values()
    assert max(abs(row["apart_in_std"]) for row in of_both) < 1e-6
    assert all(row["std"] == pytest.approx(row["reference_std"], rel=1e-6) for row in of_both)
    values = np.array([row["value"] for row in of_both])
    learnt = np.abs(values / config.model.theta - 1.0)
    assert np.median(learnt) > 1e-3
    assert told == sorted(told) and len(told) == len(rows) // 20


# ------------------------------------------------------------------ mass


@numba.njit(cache=True)
def inverted(mass, lightest, turns, inverse):
    if turns:
        invert_mass(ukf.LANES, mass, lightest, inverse)
    else:
        invert_translation(ukf.LANES, mass, lightest, inverse)


def test_mass_matrices_are_made_positive_definite(heavy):
    """Any symmetric matrix: exactly the textbook's ballast, its inverse; a hull's is left alone."""
    rng, body = np.random.default_rng(3), heavy.model.body.mass_matrix
    mass = rng.normal(0.0, 0.3, (ukf.LANES, 6, 6)) * np.sqrt(np.outer(np.diag(body), np.diag(body)))
    mass = body + 0.5 * (mass + mass.transpose(0, 2, 1))
    added = rng.normal(0.0, 1.0, (6, 6))
    mass[0] = body + added @ added.T  # added mass as of any passive hull
    indefinite = [np.linalg.eigvalsh(m)[0] < 0.0 for m in mass]
    assert np.sum(indefinite) >= 3 and not indefinite[0]
    lanes = np.ascontiguousarray(mass.transpose(1, 2, 0))
    inverse = np.zeros_like(lanes)
    inverted(lanes, ukf.problem(heavy).lightest, True, inverse)
    for k, before in enumerate(mass):
        expected = before + textbook.ballast(before, body)
        np.testing.assert_allclose(lanes[:, :, k], expected, rtol=1e-9, atol=1e-9)
        assert np.linalg.eigvalsh(expected)[0] > 0.0
        wanted = np.tril(np.linalg.inv(expected))
        np.testing.assert_allclose(np.tril(inverse[:, :, k]), wanted, rtol=1e-7, atol=1e-9)
    assert np.array_equal(lanes[:, :, 0], mass[0])
    again = np.zeros_like(lanes)
    inverted(lanes, ukf.problem(heavy).lightest, False, again)
    for k in range(ukf.LANES):
        linear = np.tril(np.linalg.inv(lanes[:3, :3, k]))
        np.testing.assert_allclose(np.tril(again[:3, :3, k]), linear, rtol=1e-7, atol=1e-9)
    assert not again[3:].any(), "forces turn a vehicle that turns as measured"


def test_a_prior_wide_enough_for_negative_mass(heavy, noisy):
    """Sigma points of four times the added mass, either sign: it is learnt all the same."""
    config = with_section(wrong_prior(heavy, spread=0.3), "prior", relative_std=1.5)
    config = with_section(config, "ukf", alpha=1.0)
    prior, task = prior_of(config), ukf.problem(config)
    masses = [i for i, name in enumerate(prior.names) if name.endswith("dot")]
    reach = prior.mean + task.settings["spread"][0] * prior.std
    assert (reach[masses] > np.diag(heavy.model.body.mass_matrix)).any(), "no point is too light"
    estimate, state, info = result(config, noisy)
    assert definite(state.p) and np.isin(info["reason"], [ukf.USED, ukf.RESTARTED]).all()
    error = np.abs(estimate.values / heavy.model.theta - 1.0)
    assert (error[masses] < 0.02).all(), error.round(3)


# ------------------------------------------------------------------ init, step, fold


def test_fold_is_step_after_step(heavy, noisy):
    task, rows = ukf.problem(heavy), mixed(noisy[:300], 3)
    before = textbook.arrays((*task, rows))
    folded, info = ukf.fold(task, textbook.read_only(ukf.init(task)), rows)
    state, infos = ukf.init(task), []
    for k in range(len(rows)):
        following, one = ukf.step(task, textbook.read_only(state), rows[k : k + 1])
        assert not any(np.shares_memory(a, b) for a, b in zip(state, following, strict=True))
        state = following
        infos.append(one)
    for a, b in zip(textbook.arrays(folded), textbook.arrays(state), strict=True):
        assert a.tobytes() == b.tobytes()
    stepped = np.concatenate(infos)
    for name in info.dtype.names:
        assert np.array_equal(info[name], stepped[name], equal_nan=name != "reason")
    after = textbook.arrays((*task, rows))
    assert all(a.tobytes() == b.tobytes() for a, b in zip(before, after, strict=True))


def test_nothing_learnt_is_the_prior(heavy):
    for config in (heavy, coupled(heavy)):
        task, prior = ukf.problem(config), prior_of(config)
        estimate = ukf.estimate(task, ukf.init(task), prior)
        np.testing.assert_allclose(estimate.values, prior.mean, rtol=1e-9)
        np.testing.assert_allclose(estimate.std, prior.std, rtol=1e-9)
        np.testing.assert_allclose(ukf.variance(task, ukf.init(task)), prior.std**2, rtol=1e-9)


def test_no_samples(heavy):
    task = ukf.problem(heavy)
    state, info = ukf.fold(task, ukf.init(task), np.zeros(0, dtype=SAMPLE))
    assert len(info) == 0
    assert all(np.array_equal(a, b) for a, b in zip(state, ukf.init(task), strict=True))


# ------------------------------------------------------------------ truth


def test_truth_without_noise(heavy):
    rows = textbook.rows_of(*driven(heavy, 90.0, 11), None, gyro=False)
    rows["odometry_variance"] = 1e-8
    config = dataclasses.replace(wrong_prior(heavy, spread=0.3), process_std=(1e-5,) * 6)
    config = with_section(config, "wrench", relative_std=1e-5)
    estimate, _, _ = result(with_section(config, "ukf", gate=1e6), rows)
    error = np.abs(estimate.values / heavy.model.theta - 1.0)
    assert error.max() < 0.003, dict(zip(estimate.names, error.round(5), strict=True))


def test_subset_and_held_coefficients(heavy, noisy):
    names = ("Y_vdot", "X_uu", "N_rr")
    factors = np.where([n in names for n in heavy.model.names], 0.8, 1.0)
    config = dataclasses.replace(textbook.off(heavy, factors), estimate=names)
    estimate, state, _ = result(config, noisy)
    assert estimate.names == names and len(state.x) == 9
    truth = [heavy.model.theta[heavy.model.names.index(n)] for n in names]
    np.testing.assert_allclose(estimate.values, truth, rtol=0.03)


def test_what_is_published_is_physical(heavy):
    """Data that want coefficients positive, drag that pushes: learnt as they are, not published."""
    pushing = heavy.model.with_values({"X_u": 3.0, "N_rr": -0.1, "X_udot": 4.0})
    t = np.arange(0.0, 60.0, DT)
    wrench = manoeuvre("steps", heavy.model, t, np.random.default_rng(3))
    rows = textbook.rows_of(textbook.drive(pushing, t, wrench), wrench, np.random.default_rng(1))
    task, prior = ukf.problem(heavy), prior_of(heavy)
    state = ukf.init(task)
    for begin in range(0, len(rows), 100):
        state, _ = ukf.fold(task, state, rows[begin : begin + 100])
        estimate = ukf.estimate(task, state, prior)
        assert np.isfinite(estimate.values).all() and definite(estimate.covariance)
        published = physical(heavy.model, prior, estimate)
        assert (published <= 0.0).all() and is_passive(heavy.model, prior, published)
    assert estimate.values[heavy.model.names.index("X_udot")] == pytest.approx(4.0, rel=0.1)
    # and they come back when the truth does
    rows = textbook.rows_of(*driven(heavy, 120.0, 41), np.random.default_rng(2), wrench_std=0.01)
    rows["t"] += 60.0
    state, _ = ukf.fold(task, state, rows)
    values = ukf.estimate(task, state, prior).values
    i = heavy.model.names.index("X_udot")
    assert values[i] == pytest.approx(heavy.model.theta[i], rel=0.2)


@pytest.mark.parametrize("seed", [21, *more(31, 41)])
@pytest.mark.parametrize("name", ["X_uu", "N_rdot"])
def test_follows_a_change(heavy, name, seed):
    """+30 % in one coefficient, default settings; it shows on one axis of six only."""
    i = heavy.model.names.index(name)
    old = heavy.model.theta[i]
    changed = heavy.model.with_values({name: 1.3 * old})
    before, wrench = driven(heavy, 60.0, seed)
    first = textbook.rows_of(before, wrench, np.random.default_rng(1), wrench_std=0.01)
    start = (before.nu[-1], before.orientation[-1])
    after, wrench = driven(heavy, 60.0, seed + 1, model=changed, start=start)
    second = textbook.rows_of(after, wrench, np.random.default_rng(2), wrench_std=0.01)
    rows = textbook.joined(first, second)
    soon, _, _ = result(heavy, rows[rows["t"] < rows["t"][len(first)] + 15.0])
    assert abs(soon.values[i] - old) > 1.96 * np.sqrt(soon.covariance[i, i])
    late, _, _ = result(heavy, rows)
    assert late.values[i] == pytest.approx(1.3 * old, rel=0.02)


@pytest.mark.parametrize("axis", range(6))
def test_one_axis_of_large_nis_is_enough_to_learn_anew(heavy, noisy, axis):
    task = ukf.problem(heavy)
    state, _ = ukf.fold(task, ukf.init(task), noisy[:400])
    calm, _ = ukf.fold(task, state, noisy[400:410])
    state.monitor["nis"][axis] = 20.0
    loosened, _ = ukf.fold(task, state, noisy[400:410])
    assert (np.diag(loosened.p)[6:] > 1.5 * np.diag(calm.p)[6:]).all()


@pytest.mark.parametrize("every", [1, 5])
def test_a_large_nis_fades_with_time_however_often_the_gyro_speaks(heavy, noisy, every):
    """Velocities that come with each fifth sample: as long, not five times as long."""
    task = ukf.problem(heavy)
    rows = mixed(noisy, every)
    state, _ = ukf.fold(task, ukf.init(task), rows[:400])
    state.monitor["nis"] = 20.0
    begin = rows["t"][399]
    later = rows[(rows["t"] > begin) & (rows["t"] <= begin + NIS_TIME)][:]
    state, _ = ukf.fold(task, state, later)
    linear, angular = np.split(state.monitor["nis"], 2)
    expected = 1.0 + 19.0 * np.exp(-1.0)
    np.testing.assert_allclose(linear, expected, rtol=0.25)
    np.testing.assert_allclose(angular, expected, rtol=0.25)


# ------------------------------------------------------------------ an hour of nothing


def definite(p):
    scale = np.sqrt(np.diag(p))
    return np.linalg.eigvalsh(p / np.outer(scale, scale))[0] > 0.0


@pytest.mark.parametrize(
    ("learnt", "alpha"),
    [(False, 1e-3), (True, 1.0), *more((False, 0.1), (False, 1.0), (True, 1e-3), (True, 0.1))],
)
def test_an_hour_without_excitation(heavy, noisy, alpha, learnt):
    config = with_section(wrong_prior(heavy), "ukf", alpha=alpha)
    task, prior = ukf.problem(config), prior_of(config)
    state = ukf.init(task)
    if learnt:
        state, _ = ukf.fold(task, state, noisy)
    known = ukf.estimate(task, state, prior)
    rows = textbook.resting(72_000, DT, np.random.default_rng(6))
    rows = textbook.held_at_rest(heavy.model, rows)
    for part in np.array_split(rows, 12):
        state, info = ukf.fold(task, state, part)
        assert np.isfinite(state.x).all() and np.isfinite(state.p).all()
        assert np.array_equal(state.p, state.p.T) or np.abs(state.p - state.p.T).max() < 1e-12
        assert definite(state.p)
        assert (np.diag(state.p)[6:] <= 1.0 + 1e-6).all()
        assert (info["reason"] != ukf.REPAIRED).all()
    then = ukf.estimate(task, state, prior)
    moved = np.abs(then.values - known.values) / then.std
    assert (moved < 3.0).all(), dict(zip(prior.names, moved.round(1), strict=True))
    assert (then.values < 0.0).all()
    again = textbook.rows_of(*driven(heavy, 60.0, 43), np.random.default_rng(7), wrench_std=0.01)
    state, _ = ukf.fold(task, state, again)
    then = ukf.estimate(task, state, prior)
    error = np.abs(then.values - heavy.model.theta) / np.abs(heavy.model.theta)
    assert error.max() < 0.3 and np.median(error) < 0.05, error.round(3)


# ------------------------------------------------------------------ bad samples


@pytest.mark.parametrize("field", ["nu", "wrench", "dt", "down", "down_slope", "wrench_slope", "t"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_not_finite_changes_nothing(heavy, noisy, field, bad):
    task = ukf.problem(heavy)
    state, _ = ukf.fold(task, ukf.init(task), noisy[:100])
    sample = noisy[100:101].copy()
    sample[field] = bad
    after, info = ukf.step(task, state, sample)
    assert ukf.REASONS[info["reason"][0]] == "not finite"
    assert all(np.array_equal(a, b) for a, b in zip(state, after, strict=True))


@pytest.mark.parametrize("field", ["odometry", "odometry_variance", "gyro", "gyro_variance"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300, 0.0])
def test_a_bad_measurement_does_not_poison_the_state(heavy, noisy, field, bad):
    task = ukf.problem(heavy)
    state, _ = ukf.fold(task, ukf.init(task), noisy[:100])
    sample = noisy[100:101].copy()
    sample[field] = bad
    state, _ = ukf.step(task, state, sample)
    state, _ = ukf.fold(task, state, noisy[101:150])
    assert np.isfinite(state.x).all() and np.isfinite(state.p).all()


@pytest.mark.parametrize("variance", [1e4, 1e6, 1e12])
def test_a_start_from_a_velocity_that_is_not_known(heavy, noisy, variance):
    """Drivers without angular rates give them a huge variance: start wide, not in pieces."""
    rows = noisy.copy()
    rows["odometry_variance"][:, 3:] = variance
    estimate, _, info = result(heavy, rows)
    assert np.isfinite(estimate.values).all() and np.isfinite(estimate.covariance).all()
    assert (info["reason"] == ukf.REPAIRED).sum() == 0
    error = np.abs(estimate.values / heavy.model.theta - 1.0)
    assert np.median(error) < 0.05


@pytest.mark.parametrize("force", [500.0, 5e3, 5e4, 5e5])
def test_one_wild_wrench(heavy, noisy, force):
    """A finite but absurd thrust in one sample: refused, or forgotten soon; never fatal."""
    rows = noisy.copy()
    rows["wrench"][700, 0] += force
    estimate, state, _ = result(heavy, rows)
    assert np.isfinite(state.x).all() and np.isfinite(state.p).all()
    clean, _, _ = result(heavy, noisy)
    assert (np.abs(estimate.values - clean.values) < 0.1 * prior_of(heavy).std).all()


def test_minutes_of_garbage(heavy, noisy):
    """All velocities nonsense for five minutes: finite, variances bounded, then good again."""
    rng = np.random.default_rng(5)
    garbage = textbook.resting(6000, DT, rng)
    for name in ("nu", "wrench"):
        garbage[name] = rng.normal(0.0, 3.0, (6000, 6))
    garbage["odometry"][:, :3], garbage["gyro"] = garbage["nu"][:, :3], garbage["nu"][:, 3:]
    garbage["restart"][0], garbage["dt"][0] = False, DT
    task, prior = ukf.problem(heavy), prior_of(heavy)
    state, _ = ukf.fold(task, ukf.init(task), noisy)
    for part in np.array_split(garbage, 10):
        state, _ = ukf.fold(task, state, part)
        assert np.isfinite(state.x).all() and np.isfinite(state.p).all()
        assert (np.diag(state.p)[6:] < 10.0).all()
    again = textbook.rows_of(*driven(heavy, 120.0, 44), np.random.default_rng(7), wrench_std=0.01)
    state, _ = ukf.fold(task, state, again)
    assert np.isfinite(ukf.estimate(task, state, prior).values).all()


def test_outliers_on_one_sensor_are_refused_and_counted(heavy, noisy):
    rows = noisy.copy()
    hit = np.arange(400, 1100, 97)
    rows["odometry"][hit, 0] += 2.0
    estimate, _, info = result(heavy, rows)
    assert (info["reason"][hit] == ukf.GATED).all()
    clean, _, _ = result(heavy, noisy)
    assert (np.abs(estimate.values - clean.values) < clean.std).all()


def test_a_gap_is_a_restart_of_the_velocity_alone(heavy, noisy):
    task, prior = ukf.problem(heavy), prior_of(heavy)
    state, _ = ukf.fold(task, ukf.init(task), noisy[:800])
    known = ukf.estimate(task, state, prior)
    sample = noisy[900:901].copy()
    sample["restart"], sample["dt"] = True, 0.0
    after, info = ukf.step(task, state, sample)
    assert info["reason"][0] == ukf.RESTARTED
    assert np.array_equal(after.x[:6], sample["nu"][0])
    then = ukf.estimate(task, after, prior)
    assert np.array_equal(then.values, known.values)
    assert np.array_equal(then.covariance, known.covariance)
    assert not after.p[:6, 6:].any()


# ------------------------------------------------------------------ consistency


def test_intervals_and_bias_over_seeds(heavy, dives):
    z, leaning, prior = [], [], prior_of(heavy)
    for config, samples in dives:
        estimate, state, info = result(config, samples)
        assert definite(state.p)
        assert (info["reason"] == ukf.GATED).mean() < 0.01
        z.append((estimate.values - heavy.model.theta) / estimate.std)
        leaning.append(textbook.attenuation(heavy.model, heavy.wrench.relative_std) / estimate.std)
    z = np.array(z)
    told = dict(zip(prior.names, zip(z.mean(0).round(2), z.std(0).round(2), strict=True)))
    covered = np.mean(np.abs(z) < 1.96)
    assert covered >= 0.80, f"{covered:.2f} {told}"
    assert 0.5 < z.std() < 1.6, told
    chance = 3.0 / np.sqrt(len(z)) * max(1.0, z.std())
    assert (np.abs(z.mean(axis=0)) < chance + np.mean(leaning, axis=0)).all(), told
    assert np.mean(leaning) < 0.3  # of a standard deviation: bias is not what limits the estimate


def test_errors_are_small_after_ninety_seconds(heavy, dives):
    errors = np.array(
        [np.abs(result(c, samples)[0].values / heavy.model.theta - 1.0) for c, samples in dives]
    )
    median = np.median(errors, axis=0)
    strong = [
        heavy.model.names.index(n) for n in ("X_udot", "Y_vdot", "Z_wdot", "X_uu", "Y_vv", "Z_ww")
    ]
    assert (median[strong] < 0.03).all(), median.round(3)
    assert (median < 0.15).all(), median.round(3)
