"""Recursive least squares: against textbook forms, through windup, gaps and changes."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import textbook
from textbook import with_section

from rov_ident import config as configuration
from rov_ident.config.prior import prior_of
from rov_ident.estimation import rls
from rov_ident.sampling.sample import SAMPLE
from rov_ident.simulation import virtual_sensors as sensors
from rov_ident.simulation.manoeuvres import manoeuvre

DT = 0.02


def driven(config, duration, seed, name="steps", dt=DT, model=None, start=None):
    """Motion and wrench of a manoeuvre."""
    t = np.arange(0.0, duration, dt)
    model = model or config.model
    wrench = manoeuvre(name, config.model, t, np.random.default_rng(seed))
    return textbook.drive(model, t, wrench, *(start or ())), wrench


def result(config, rows, state=None):
    task, prior = rls.problem(config), prior_of(config)
    state, info = rls.fold(task, state or rls.init(task), rows)
    return rls.estimate(task, state, prior), state, info


@pytest.fixture(scope="module")
def exact(heavy):
    """A minute without noise: samples (N,)."""
    return textbook.rows_of(*driven(heavy, 60.0, 11))


@pytest.fixture(scope="module")
def noisy(heavy):
    motion, wrench = driven(heavy, 60.0, 12)
    return textbook.rows_of(motion, wrench, np.random.default_rng(0), wrench_std=0.01)


def wrong_prior(config, seed=5, spread=0.2):
    factors = 1.0 + spread * np.random.default_rng(seed).uniform(-1, 1, len(config.model.theta))
    return textbook.off(config, factors)


# ------------------------------------------------------------------ init, step, fold


@pytest.mark.parametrize("forgetting", ["variable", "constant"])
def test_fold_is_step_after_step(heavy, noisy, forgetting):
    config = with_section(heavy, "rls", forgetting=forgetting, forgetting_factor=0.99)
    task = rls.problem(config)
    rows = noisy[:700]
    folded, info = rls.fold(task, rls.init(task), rows)
    state, infos = rls.init(task), []
    for k in range(len(rows)):
        textbook.read_only(state)
        before = [part.copy() for part in state]
        following, one = rls.step(task, state, rows[k : k + 1])
        assert all(np.array_equal(a, b) for a, b in zip(before, state, strict=True))
        assert not any(np.shares_memory(a, b) for a, b in zip(state, following, strict=True))
        state = following
        infos.append(one)
    stepped = np.concatenate(infos)
    for a, b in zip(folded, state, strict=True):
        assert all(x.tobytes() == y.tobytes() for x, y in zip(*map(textbook.arrays, ([a], [b]))))
    for name in info.dtype.names:
        assert np.array_equal(info[name], stepped[name], equal_nan=name not in ("reason",))
    halves, _ = rls.fold(task, rls.init(task), rows[:333])
    halves, _ = rls.fold(task, halves, rows[333:])
    for a, b in zip(textbook.arrays(folded), textbook.arrays(halves), strict=True):
        assert a.tobytes() == b.tobytes()


def test_samples_and_problem_are_not_modified(heavy, noisy):
    task, rows = rls.problem(heavy), noisy[:200].copy()
    before = textbook.arrays((*task, rows))
    _, info = rls.fold(task, textbook.read_only(rls.init(task)), rows)
    assert len(info) == 200
    after = textbook.arrays((*task, rows))
    assert all(a.tobytes() == b.tobytes() for a, b in zip(before, after, strict=True))


def test_nothing_learnt_is_the_prior(heavy):
    task, prior = rls.problem(heavy), prior_of(heavy)
    estimate = rls.estimate(task, rls.init(task), prior)
    np.testing.assert_allclose(estimate.values, prior.mean, rtol=1e-14)
    np.testing.assert_allclose(estimate.covariance, np.diag(prior.std**2), atol=1e-14)
    np.testing.assert_allclose(rls.variance(task, rls.init(task)), prior.std**2, rtol=1e-12)


def test_the_prior_is_that_of_the_coefficients_whatever_the_coordinates():
    shipped = Path(__file__).parent.parent / "config" / "bluerov2_heavy.yaml"
    config = configuration.load(shipped).with_nuisance
    config = dataclasses.replace(config, effects={**config.effects, "buoyancy": {"delta": 2.0}})
    task, prior = rls.problem(config), prior_of(config, effects=True)
    assert task.thrust >= 0 and task.per_thrust.sum() > 12
    state = rls.init(task)
    n = len(prior.std)
    assert not np.tril(state.root[:, :n], -1).any()
    estimate = rls.estimate(task, state, prior)
    np.testing.assert_allclose(estimate.values, prior.mean, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(estimate.std, prior.std, rtol=1e-9)
    correlation = estimate.covariance / np.outer(prior.std, prior.std)
    np.testing.assert_allclose(correlation, np.eye(n), atol=1e-9)
    np.testing.assert_allclose(rls.variance(task, state), prior.std**2, rtol=1e-9)


def test_no_samples(heavy):
    task = rls.problem(heavy)
    state, info = rls.fold(task, rls.init(task), np.zeros(0, dtype=SAMPLE))
    assert len(info) == 0
    assert all(np.array_equal(a, b) for a, b in zip(state, rls.init(task), strict=True))


# ------------------------------------------------------------------ textbook


@pytest.fixture(scope="module")
def fine(heavy):
    """Samples without noise so close together that the observer's integration is exact."""
    return textbook.rows_of(*driven(heavy, 20.0, 11, dt=0.005))[-100:]


@pytest.mark.parametrize("slope", [False, True])
def test_rows_are_the_tangent_of_a_textbook_observer(heavy, fine, slope):
    """The information and its right-hand side are sums over an independent Kalman filter's rows.

    That filter is written in matrices and knows no sensitivities: each coefficient is moved a
    little, and it runs again with the same gains. The prior is so narrow that the coefficients
    hardly move meanwhile.
    """
    size = np.abs(heavy.model.theta) + 1.0
    narrow = dict(zip(heavy.model.names, 1e-4 * size, strict=True))
    config = with_section(wrong_prior(heavy, spread=0.02), "prior", std=narrow)
    model, n = config.model, len(size)
    rows = fine.copy()
    rows["dt"][0], rows["restart"][0] = 0.0, True
    rows["odometry_variance"][:], rows["gyro_variance"] = 1e-8, 1e-8
    rows["odometry"][::2, :3] = np.nan  # the gyro twice as often
    rows["tilt"] = 1e-6
    if slope:  # any wrench within the interval, as long as both sides use it alike
        rows["wrench_slope"] = np.random.default_rng(1).standard_normal((len(rows), 6))
        rows["wrench_slope"] *= [20.0, 20.0, 20.0, 2.0, 2.0, 2.0]
    task = rls.problem(with_section(config, "rls", gate=1e6))
    state, densities = rls.init(task), []
    for k in range(len(rows)):
        densities.append(state.monitor["density"].copy())
        state, info = rls.step(task, state, rows[k : k + 1])
        assert info["reason"][0] == (rls.USED if k else rls.RESTARTED)
    assert state.scalars["free"][0] == n
    place = np.argsort(state.order)
    r = state.root[:, :n][:, place]
    information, goal = r.T @ r - np.eye(n), r.T @ state.root[:, n]

    e, s, gains = textbook.innovations(config, model.theta, rows, densities)
    scale = narrow.values()
    phi = np.empty((len(e), n))
    for j, step in enumerate(scale):
        moved = model.theta.copy()
        moved[j] += step
        phi[:, j] = e - textbook.innovations(config, moved, rows, densities, gains)[0]
    wanted = (phi / s[:, None]).T @ phi
    root = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(
        information / np.outer(root, root), wanted / np.outer(root, root), atol=2e-3
    )
    # in standard deviations
    np.testing.assert_allclose(goal / root, phi.T @ (e / s) / root, atol=0.02)


def in_order(state):
    """Information, score (n, n), right-hand side and sensitivities in the order of theta."""
    n, place = len(state.order), np.argsort(state.order)
    r = state.root[:, :n][:, place]
    score = state.score[np.ix_(place, place)]
    free = np.arange(n) < state.scalars["free"][0]
    return r, score, r.T @ state.root[:, n], (state.sensitivity[:, :n] * free)[:, place]


def test_constant_forgetting_is_the_textbook_formula(heavy, noisy):
    """The same sample with and without forgetting, from states met on the way; to 1e-9."""
    factor, checked = 0.9, 0
    tasks = []
    for f in (1.0, factor):
        config = with_section(heavy, "rls", forgetting="constant", forgetting_factor=f)
        tasks.append(rls.problem(config))
    n = len(tasks[0].scale)
    state = rls.init(tasks[1])
    for k in range(1500):
        (kept, _), (forgot, told) = (rls.step(t, state, noisy[k : k + 1]) for t in tasks)
        state = forgot
        if told["forgetting"][0] == 1.0 or k < 200:
            assert all(np.array_equal(a, b) for a, b in zip(kept, forgot, strict=True)) or k < 200
            continue
        r, score, right, phi = in_order(kept)
        q = np.linalg.qr(r @ phi.T)[0]
        less = r.T @ (np.eye(n) - (1.0 - factor) * q @ q.T) @ r
        scale = np.sqrt(np.outer(np.diag(r.T @ r), np.diag(r.T @ r)))
        new, new_score, new_right, _ = in_order(forgot)
        np.testing.assert_allclose(new.T @ new / scale, less / scale, atol=1e-9)
        # the score's covariance goes with it
        t = less @ np.linalg.inv(r.T @ r)
        np.testing.assert_allclose(new_score / scale, t @ score @ t.T / scale, atol=1e-9)
        # and what is forgotten does not move the estimate
        x = np.linalg.solve(r.T @ r, right)
        np.testing.assert_allclose(new_right, less @ x, rtol=1e-7, atol=1e-7)
        checked += 1
    assert checked > 100


def test_a_large_nis_adds_variance_to_what_would_show(heavy, noisy):
    """A diagonal share of the prior, as there is room to it; the estimate and the rest stay."""
    task, checked = rls.problem(heavy), 0
    state, _ = rls.fold(task, rls.init(task), noisy[:1500])
    surge = [heavy.model.names.index(name) for name in ("X_udot", "X_u", "X_uu")]
    for k in range(1500, 1600):
        state.monitor["nis"] = [10.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        loosened, told = rls.step(task, state, noisy[k : k + 1])
        state.monitor["nis"] = 0.0
        state, _ = rls.step(task, state, noisy[k : k + 1])
        if told["forgetting"][0] == 1.0:
            continue
        assert told["forgetting"][0] == pytest.approx(1.0 - 0.1 / 20.0)
        (r, score, right, phi), (new, new_score, new_right, _) = map(in_order, (state, loosened))
        p, grown = np.linalg.inv(r.T @ r), np.linalg.inv(new.T @ new)
        added = np.diag(grown - p)
        np.testing.assert_allclose(grown - p, np.diag(added), atol=1e-10)
        suspect = added > 1e-8
        np.testing.assert_allclose(added[suspect], 0.005 * (1.0 - np.diag(p)[suspect]), rtol=1e-5)
        assert suspect[surge].any() and not suspect.all()
        assert np.abs(phi[0, suspect]).min() > np.abs(phi[0, ~suspect]).max()
        # so does the covariance that does not assume white innovations
        np.testing.assert_allclose(
            grown @ new_score @ grown, p @ score @ p + np.diag(added), atol=1e-10
        )
        np.testing.assert_allclose(grown @ new_right, p @ right, rtol=1e-6, atol=1e-9)
        checked += 1
    assert checked > 10


def test_condition_number(heavy, noisy):
    """That of numpy; 1 at first; told ten times a second."""
    task = rls.problem(heavy)
    assert rls.condition(task, rls.init(task)) == pytest.approx(1.0)
    state, info = rls.fold(task, rls.init(task), noisy[:1500])
    n = len(task.scale)
    assert rls.condition(task, state) == pytest.approx(np.linalg.cond(state.root[:, :n], 1))
    told = np.flatnonzero(np.isfinite(info["condition"]))
    assert (np.diff(told) == round(0.1 / DT)).mean() > 0.95
    assert info["condition"][told[0]] < 10.0 < info["condition"][told[-1]]
    after, _ = rls.fold(task, rls.init(task), noisy[: told[-1] + 1])
    assert info["condition"][told[-1]] == pytest.approx(rls.condition(task, after), rel=1e-9)


def test_truth_without_noise(heavy, exact):
    config = wrong_prior(heavy, spread=0.3)
    estimate, _, info = result(config, exact)
    error = np.abs(estimate.values / heavy.model.theta - 1.0)
    assert error.max() < 0.005, dict(zip(estimate.names, error.round(5), strict=True))
    assert (info["reason"] != rls.GATED).mean() > 0.9


def test_truth_without_noise_of_a_coupled_model(heavy):
    parameters = configuration.to_parameters(heavy)
    parameters["coefficients"].update(
        {
            "Y_v": -5.0,
            "N_r": -0.8,
            "K_p": -0.3,
            "Y_rdot": 0.4,
            "Y_r": 0.6,
            "N_v": 0.3,
            "X_vv": -20.0,
        }
    )
    truth = configuration.from_parameters(parameters)
    rows = textbook.rows_of(*driven(truth, 90.0, 4))
    config = wrong_prior(truth, spread=0.2)
    estimate, _, _ = result(config, rows)
    prior = prior_of(truth)
    error = np.abs(estimate.values - truth.model.theta) / np.maximum(
        np.abs(truth.model.theta), 0.2 * prior.std
    )
    assert error.max() < 0.01, dict(zip(estimate.names, error.round(4), strict=True))


# ------------------------------------------------------------------ what is estimated


def test_only_the_chosen_coefficients_are_estimated(heavy, exact):
    names = ("Y_vdot", "X_u", "X_uu", "N_rr")
    config = dataclasses.replace(heavy, estimate=names)
    factors = np.where([n in names for n in heavy.model.names], 0.8, 1.0)
    config = dataclasses.replace(textbook.off(config, factors), estimate=names)
    estimate, _, _ = result(config, exact)
    assert estimate.names == names
    truth = [heavy.model.theta[heavy.model.names.index(n)] for n in names]
    np.testing.assert_allclose(estimate.values, truth, rtol=0.005)


def test_coefficients_that_are_not_excited_stay_and_say_so(heavy):
    """Surge alone says nothing of sway, roll, yaw."""
    t = np.arange(0.0, 60.0, DT)
    wrench = manoeuvre("steps", heavy.model, t, np.random.default_rng(2))
    wrench[:, 1:] = 0.0
    rows = textbook.rows_of(
        textbook.drive(heavy.model, t, wrench), wrench, np.random.default_rng(0), wrench_std=0.01
    )
    config = wrong_prior(heavy)
    prior = prior_of(config)
    estimate, _, _ = result(config, rows)
    for name in ("Y_vv", "K_pp", "N_rr"):  # pitch moves: it is driven by surge times heave
        i = prior.names.index(name)
        assert abs(estimate.values[i] - prior.mean[i]) < 0.5 * prior.std[i], name
        assert estimate.std[i] > 0.5 * prior.std[i], name
    i = prior.names.index("X_uu")
    assert estimate.values[i] == pytest.approx(heavy.model.theta[i], rel=0.05)


# ------------------------------------------------------------------ gaps and outliers


def test_a_gap_has_no_transient(heavy, exact):
    """Restart in the middle of a fast motion: the residual is as small as ever."""
    rows = exact.copy()
    for k in (700, 1500, 2311):
        assert np.abs(rows["nu"][k, :3]).max() > 0.05
        rows["dt"][k], rows["restart"][k] = 0.0, True
    whole, _, quiet = result(heavy, exact)
    estimate, _, info = result(heavy, rows)
    assert (info["reason"] == rls.RESTARTED).sum() == 4
    assert (info["reason"] == rls.GATED).sum() == (quiet["reason"] == rls.GATED).sum()
    usual, worst = np.nanmax(np.abs(quiet["residual"]), 0), np.nanmax(np.abs(info["residual"]), 0)
    assert (worst < 3.0 * usual + 1e-6).all()
    np.testing.assert_allclose(estimate.values, whole.values, rtol=0.005)


def test_a_start_in_motion_without_a_restart_mark(heavy, exact):
    """A fresh state (after a reset) amid a stream of samples: no transient either."""
    rows = exact[900:1600]
    assert not rows["restart"].any()
    marked = rows.copy()
    marked["dt"][0], marked["restart"][0] = 0.0, True
    wanted, _, _ = result(heavy, marked)
    estimate, _, _ = result(heavy, rows)
    np.testing.assert_allclose(estimate.values, wanted.values, rtol=0.005)
    np.testing.assert_allclose(estimate.std, wanted.std, rtol=0.05)


@pytest.mark.parametrize("field", ["nu", "wrench", "dt", "down", "wrench_slope"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_not_finite_changes_nothing(heavy, noisy, field, bad):
    task = rls.problem(heavy)
    rows = noisy[:300].copy()
    state, _ = rls.fold(task, rls.init(task), rows)
    sample = noisy[300:301].copy()
    sample[field] = bad
    after, info = rls.step(task, state, sample)
    assert rls.REASONS[info["reason"][0]] == "not finite"
    assert all(np.array_equal(a, b) for a, b in zip(state, after, strict=True))


def test_outliers_are_refused(heavy, noisy):
    """Now and then a wrench that never acted."""
    clean, _, _ = result(heavy, noisy)
    rows = noisy.copy()
    rng = np.random.default_rng(8)
    hit = rng.choice(np.arange(600, len(rows)), 5, replace=False)
    rows["wrench"][hit] += rng.choice([-1, 1], (5, 6)) * [2000, 2000, 2000, 200, 200, 200]
    estimate, _, info = result(heavy, rows)
    gated = np.flatnonzero(info["reason"] == rls.GATED)
    assert len(gated) >= 5
    for k in hit:
        assert ((gated >= k) & (gated < k + 10)).any(), "refused soon after"
    prior = prior_of(heavy)
    assert (np.abs(estimate.values - clean.values) < 0.1 * prior.std).all()


def test_residual_is_measured_minus_model(heavy):
    """A force that the model does not know shows with its own sign, and the others stay small."""
    config = dataclasses.replace(heavy, estimate=("N_rr",))
    t = np.arange(0.0, 20.0, DT)
    wrench = manoeuvre("steps", heavy.model, t, np.random.default_rng(2))
    extra = np.array([5.0, 0.0, -3.0, 0.0, 0.0, 0.0])
    motion = textbook.drive(heavy.model, t, wrench)
    rows = textbook.rows_of(motion, wrench + extra)
    _, _, info = result(config, rows)
    np.testing.assert_allclose(info["residual"][500:, :3], extra[:3] * np.ones((500, 1)), atol=0.3)


# ------------------------------------------------------------------ windup


@pytest.fixture(scope="module")
def learnt(heavy, noisy):
    """State, estimate and task after a good minute under constant forgetting 0.98."""
    config = with_section(heavy, "rls", forgetting="constant", forgetting_factor=0.98)
    estimate, state, _ = result(config, noisy)
    return config, rls.problem(config), state, estimate


def test_rest_teaches_nothing_by_default(heavy, noisy):
    """Twenty minutes on the bottom with noisy sensors, default settings: nothing is unlearnt."""
    known, state, _ = result(heavy, noisy)
    rng = np.random.default_rng(3)
    rows = textbook.held_at_rest(heavy.model, textbook.resting(60_000, DT, rng))
    then, _, _ = result(heavy, rows, state)
    prior = prior_of(heavy)
    assert (np.abs(then.values - known.values) < 0.05 * prior.std + 2.0 * known.std).all()
    assert (then.std > 0.3 * known.std).all(), "noise has no information"


@pytest.mark.parametrize("motion", ["rest", "one axis"])
def test_no_windup(heavy, learnt, motion):
    """1e5 samples without information (or on one axis): what is not excited stays as it is."""
    config, task, state, known = learnt
    prior = prior_of(config)
    count, rng = 100_000, np.random.default_rng(3)
    if motion == "rest":
        rows = textbook.held_at_rest(heavy.model, textbook.resting(count, DT, rng))
        unexcited = np.ones(len(prior.names), dtype=bool)
    else:
        t = np.arange(0.0, 200.0, DT)
        wrench = manoeuvre("steps", heavy.model, t, rng)
        wrench[:, 1:] = 0.0
        one = textbook.rows_of(textbook.drive(heavy.model, t, wrench), wrench, rng)
        rows = np.tile(one, count // len(one))
        rows["restart"][:: len(one)] = True
        unexcited = np.array([n[0] in "YKN" for n in prior.names])
    after, _ = rls.fold(task, state, rows)
    then = rls.estimate(task, after, prior)
    assert np.isfinite(then.values).all() and np.isfinite(then.covariance).all()
    assert np.linalg.eigvalsh(then.covariance / np.outer(prior.std, prior.std))[0] > -1e-9
    assert (then.std < 2.0 * prior.std).all(), "not less sure than before any data"
    assert (rls.variance(task, after) < 4.0 * prior.std**2).all()
    moved = np.abs(then.values - known.values)[unexcited] / known.std[unexcited]
    assert (moved < 2.0).all(), dict(zip(np.array(prior.names)[unexcited], moved.round(1)))
    grown = np.sqrt(rls.variance(task, after) / rls.variance(task, state))[unexcited]
    # noise alone excites a little
    assert (grown < 1.5).all() and (grown > 0.5).all(), grown.round(2)

    # and it still learns
    rows = textbook.rows_of(*driven(heavy, 30.0, 77), np.random.default_rng(4), wrench_std=0.01)
    again = rls.estimate(task, rls.fold(task, after, rows)[0], prior)
    fresh = rls.estimate(task, rls.fold(task, rls.init(task), rows)[0], prior)
    worse = np.abs(again.values - heavy.model.theta) - np.abs(fresh.values - heavy.model.theta)
    assert (worse < 0.25 * prior.std).all()


def test_follows_a_change(heavy):
    """+30 % in one drag coefficient after a minute: an instrument frame swung out."""
    for name in ("X_uu", "N_rr"):
        changed = heavy.model.with_values(
            {name: 1.3 * heavy.model.theta[heavy.model.names.index(name)]}
        )
        before, wrench = driven(heavy, 60.0, 21)
        first = textbook.rows_of(before, wrench, np.random.default_rng(1), wrench_std=0.01)
        start = (before.nu[-1], before.orientation[-1])
        after, wrench = driven(heavy, 180.0, 22, model=changed, start=start)
        second = textbook.rows_of(after, wrench, np.random.default_rng(2), wrench_std=0.01)
        i = heavy.model.names.index(name)
        estimate, _, _ = result(heavy, first)
        assert estimate.values[i] == pytest.approx(heavy.model.theta[i], rel=0.1)
        estimate, _, _ = result(heavy, textbook.joined(first, second))
        assert estimate.values[i] == pytest.approx(changed.theta[i], rel=0.1), name
        others = np.arange(len(heavy.model.theta)) != i
        error = np.abs(estimate.values - changed.theta) / prior_of(heavy).std
        assert (error[others] < 0.3).all()


# ------------------------------------------------------------------ consistency


def test_intervals_and_bias_over_seeds(heavy, dives):
    """95 % intervals hold the truth about as often as they say, and nothing leans to one side."""
    z, leaning, prior = [], [], None
    for config, samples in dives:
        prior = prior_of(config)
        estimate, _, _ = result(config, samples)
        assert np.linalg.eigvalsh(estimate.covariance / np.outer(prior.std, prior.std))[0] > 0
        z.append((estimate.values - heavy.model.theta) / estimate.std)
        leaning.append(textbook.attenuation(heavy.model, heavy.wrench.relative_std) / estimate.std)
    z = np.array(z)
    told = dict(zip(prior.names, zip(z.mean(0).round(2), z.std(0).round(2), strict=True)))
    covered = np.mean(np.abs(z) < 1.96)
    assert covered >= 0.80, f"{covered:.2f} {told}"
    chance = 3.0 / np.sqrt(len(z)) * max(1.0, z.std())
    assert (np.abs(z.mean(axis=0)) < chance + np.mean(leaning, axis=0)).all(), told
    assert np.mean(leaning) < 0.3  # of a standard deviation: bias is not what limits the estimate


def test_errors_are_small_after_ninety_seconds(heavy, dives):
    errors = []
    for config, samples in dives:
        errors.append(np.abs(result(config, samples)[0].values / heavy.model.theta - 1.0))
    median = np.median(errors, axis=0)
    strong = [
        heavy.model.names.index(n) for n in ("X_udot", "Y_vdot", "Z_wdot", "X_uu", "Y_vv", "Z_ww")
    ]
    assert (median[strong] < 0.03).all(), median.round(3)
    assert (median < 0.15).all(), median.round(3)


@pytest.fixture(scope="module")
def dives(heavy):
    return textbook.prior_and_samples(heavy, range(6), 90.0)


def test_simulated_sensors_suite_is_what_the_configuration_assumes(heavy):
    """The consistency tests above mean something only while both agree on the noise."""
    suite = sensors.Suite()
    assert heavy.imu.gyro_std == suite.gyro_std
    assert heavy.wrench.relative_std == suite.wrench_std
