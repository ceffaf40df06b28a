"""What physics allows of an estimate: against a quadratic program, and case by case."""

import dataclasses

import numpy as np
import pytest
import textbook
from scipy.optimize import minimize

from rov_ident import config as configuration
from rov_ident.config.prior import prior_of, typical
from rov_ident.estimation.physical import Estimate, calibrated, is_passive, physical


def variant(heavy, values, remove=()):
    """The heavy vehicle with further (or without some) coefficients."""
    parameters = configuration.to_parameters(heavy)
    parameters["coefficients"].update(values)
    for name in remove:
        del parameters["coefficients"][name]
    return configuration.from_parameters(parameters)


def set_to(config, values):
    """All values of the prior, some replaced."""
    prior = prior_of(config)
    out = prior.mean.copy()
    for name, value in values.items():
        out[prior.names.index(name)] = value
    return out


def test_prior_of_a_coefficient_published_as_zero_is_not_certain(heavy):
    config = variant(heavy, {"Y_v": 0.0, "N_r": 0.0, "Y_r": 0.0})
    prior = prior_of(config)
    scale = dict(zip(config.model.names, typical(config.model), strict=True))
    for name in ("Y_v", "N_r", "Y_r"):
        i = prior.names.index(name)
        assert prior.mean[i] == 0.0
        assert 0.01 * scale[name] < prior.std[i] < scale[name]
    assert (prior.std > 0).all()


def test_prior_knows_which_signs_physics_fixes(heavy):
    config = variant(heavy, {"Y_rdot": 0.3, "Y_r": 0.0, "X_vv": 0.0, "N_rr": -1.0})
    prior = prior_of(config)
    free = {n for n, negative in zip(prior.names, prior.negative, strict=True) if not negative}
    assert free == {"Y_rdot", "Y_r", "X_vv"}


def test_prior_takes_stated_deviations_and_the_subset(heavy):
    parameters = configuration.to_parameters(heavy)
    parameters["estimate"] = ["X_uu", "X_u"]
    parameters["prior"] = {"relative_std": 0.1, "std": {"X_uu": 7.0}}
    prior = prior_of(configuration.from_parameters(parameters))
    assert prior.names == ("X_u", "X_uu")
    assert 1.37 <= prior.std[0] < 13.7 and prior.std[1] == 7.0


def test_physical_leaves_a_passive_set_alone(heavy):
    prior = prior_of(heavy)
    values = 0.7 * prior.mean
    estimate = Estimate(prior.names, values, np.diag(prior.std**2), 0.0)
    assert np.array_equal(physical(heavy.model, prior, estimate), values)


@pytest.mark.parametrize("seed", range(40))
def test_physical_is_the_nearest_set_with_the_right_signs(heavy, seed):
    """The projection in the metric of the covariance, against every possible active set."""
    rng = np.random.default_rng(seed)
    config = variant(heavy, {}, remove=[n for n in heavy.model.names if n[0] in "KMN"])
    prior = prior_of(config)
    n = len(prior.names)
    assert n == 8 and prior.negative.all()
    covariance = textbook.random_covariance(n, rng)
    values = rng.standard_normal(n) * np.sqrt(np.diag(covariance)) - 0.3
    found = physical(config.model, prior, Estimate(prior.names, values, covariance, 0.0))
    wanted = textbook.nearest_not_positive(values, covariance, prior.negative)
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-8 * np.abs(values).max())


def test_physical_keeps_what_is_not_correlated(heavy):
    prior = prior_of(heavy)
    i = prior.names.index("K_pp")
    values = prior.mean.copy()
    values[i] = 0.2
    estimate = Estimate(prior.names, values, np.diag(prior.std**2), 0.0)
    found = physical(heavy.model, prior, estimate)
    assert found[i] == 0.0
    assert np.array_equal(np.delete(found, i), np.delete(values, i))


def test_physical_with_a_covariance_without_rank(heavy):
    """Perfectly correlated, and known exactly: still an answer, still passive."""
    prior = prior_of(heavy)
    for covariance in (np.outer(prior.std, prior.std), np.zeros((len(prior.std),) * 2)):
        estimate = Estimate(prior.names, prior.mean + 3.0 * prior.std, covariance, 0.0)
        found = physical(heavy.model, prior, estimate)
        assert np.isfinite(found).all()
        assert is_passive(heavy.model, prior, found)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_physical_leaves_an_estimate_that_is_lost_as_it_is(heavy, bad):
    prior = prior_of(heavy)
    n = len(prior.names)
    values = prior.mean.copy()
    values[0] = bad
    for covariance in (np.diag(prior.std**2), np.full((n, n), bad)):
        lost = Estimate(prior.names, values.copy(), covariance, 0.0)
        np.testing.assert_array_equal(physical(heavy.model, prior, lost), values)
        values[0] = 1.0


@pytest.mark.parametrize(
    "couplings, changed",
    [
        ({"Y_rdot": 0.3}, {"Y_rdot": 8.0}),
        ({"Y_r": 0.1, "N_v": 0.1, "Y_v": -5.0, "N_r": -1.0}, {"Y_r": 40.0}),
        ({"Y_v_abs_r": 0.0}, {"Y_v_abs_r": 500.0}),
    ],
)
def test_couplings_are_drawn_back_just_as_far_as_needed(heavy, couplings, changed):
    config = variant(heavy, couplings)
    prior = prior_of(config)
    values = set_to(config, changed)
    assert not is_passive(config.model, prior, values)
    estimate = Estimate(prior.names, values, np.diag(prior.std**2), 0.0)
    found = physical(config.model, prior, estimate)
    assert is_passive(config.model, prior, found)
    # on the way from the prior to the estimate, and nearly at the border
    share = (found - prior.mean)[values != prior.mean] / (values - prior.mean)[values != prior.mean]
    assert 0.0 < share[0] < 1.0
    further = prior.mean + 1.001 * (found - prior.mean)
    assert not is_passive(config.model, prior, further)


@pytest.mark.parametrize(
    "couplings, changed, passive",
    [
        ({}, {}, True),
        ({}, {"X_u": 0.0}, True),
        ({}, {"X_u": 1e-9}, False),
        ({}, {"X_udot": 1e-9}, False),
        ({}, {"N_rr": 0.5}, False),
        # a coupling may have either sign: it is M as a whole that counts
        ({"Y_rdot": 0.3}, {}, True),
        ({"Y_rdot": -0.3}, {}, True),
        ({"Y_rdot": 0.3}, {"Y_rdot": 8.0}, False),
        ({"Y_rdot": 0.3}, {"Y_rdot": -8.0}, False),
        ({"X_qdot": 0.2, "Y_pdot": 0.2}, {}, True),
        ({"Y_v": -5.0, "N_r": -1.0, "Y_r": 1.0, "N_v": 1.0}, {}, True),
        ({"Y_v": -5.0, "N_r": -1.0, "Y_r": 30.0, "N_v": -30.0}, {}, True),
        ({"Y_v": -5.0, "N_r": -1.0, "Y_r": 1.0, "N_v": 1.0}, {"N_v": 9.0}, False),
        ({"Y_r": 0.0}, {"Y_r": 0.1}, False),  # nothing on the diagonal to pay for it
        ({"Y_uv": -30.0}, {}, True),  # lift does no work, or both signs of it
        # added mass must be right beside couplings in damping too
        ({"Y_v": -5.0, "N_r": -1.0, "Y_r": 0.1}, {"X_udot": 25.0}, False),
        ({"Y_rdot": 0.3}, {"X_u": np.nan}, False),
        ({"Y_rdot": 0.3}, {"X_udot": np.inf}, False),
    ],
)
def test_is_passive(heavy, couplings, changed, passive):
    config = variant(heavy, couplings)
    prior = prior_of(config)
    assert is_passive(config.model, prior, set_to(config, changed)) is passive


def test_shipped_configurations_are_passive():
    from pathlib import Path

    for path in sorted((Path(__file__).parent.parent / "config").glob("*.yaml")):
        config = configuration.load(path)
        prior = prior_of(config)
        assert is_passive(config.model, prior, prior.mean), path.name


# ------------------------------------------------------------------ one-sided damping


@pytest.fixture
def one_sided(heavy):
    return variant(heavy, {"Z_ww_neg": -20.0, "Z_w_neg": 5.0})


def test_one_sided_damping_may_have_either_sign_but_its_sum_not(one_sided):
    prior = prior_of(one_sided)
    assert not prior.negative[prior.names.index("Z_ww_neg")]
    for values, passive in (
        ({}, True),
        ({"Z_ww_neg": 190.0}, True),
        ({"Z_ww_neg": 190.1}, False),
        ({"Z_w_neg": 33.1}, False),
        ({"Z_ww": 0.1, "Z_ww_neg": -20.0}, False),
    ):
        assert is_passive(one_sided.model, prior, set_to(one_sided, values)) == passive


def test_one_sided_damping_counts_where_couplings_are_judged(heavy):
    """Y_v and N_r carry the coupling in one direction of sway only."""
    couplings = {"Y_r": 4.0, "N_v": 4.0, "Y_v": -20.0, "N_r": -1.0}
    for name, value, passive in (("Y_v_neg", 0.0, True), ("Y_v_neg", 15.0, False)):
        config = variant(heavy, couplings | {name: value})
        prior = prior_of(config)
        assert is_passive(config.model, prior, prior.mean) == passive


@pytest.mark.parametrize("seed", range(10))
def test_physical_is_the_nearest_set_of_both_directions(one_sided, seed):
    """Against scipy's constrained minimum of the same distance."""
    rng = np.random.default_rng(seed)
    names = ("Z_w", "Z_ww", "Z_w_neg", "Z_ww_neg")
    config = dataclasses.replace(one_sided, estimate=names)
    prior = prior_of(config)
    assert set(prior.names) == set(names)
    at = {name: prior.names.index(name) for name in names}
    rows = np.zeros((4, 4))
    rows[0, at["Z_w"]] = rows[1, at["Z_ww"]] = 1.0
    rows[2, [at["Z_w"], at["Z_w_neg"]]] = rows[3, [at["Z_ww"], at["Z_ww_neg"]]] = 1.0
    covariance = textbook.random_covariance(4, rng)
    scale = np.sqrt(np.diag(covariance))
    values = rng.standard_normal(4) * scale
    found = physical(config.model, prior, Estimate(prior.names, values, covariance, 0.0))
    assert is_passive(config.model, prior, found)
    inverse = np.linalg.inv(covariance)

    def distance(x):
        return (x - values) @ inverse @ (x - values)

    best = minimize(
        distance,
        -2.0 * scale,
        constraints={"type": "ineq", "fun": lambda x: -rows @ x},
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 1000},
    )
    np.testing.assert_allclose(found, best.x, atol=1e-4 * scale.max())


def test_one_sided_damping_beside_one_that_is_held(one_sided):
    """Z_ww is not estimated: its sum with the estimate stays where a hull can be."""
    config = dataclasses.replace(one_sided, estimate=("Z_w", "Z_ww_neg"))
    prior = prior_of(config)
    values = np.array([-30.0, 250.0])
    found = physical(config.model, prior, Estimate(prior.names, values, np.diag([1.0, 400.0]), 0.0))
    np.testing.assert_allclose(found, [-30.0, 190.0], rtol=1e-12)
    assert is_passive(config.model, prior, found)


def test_coloured_residuals_widen_up_to_the_prior():
    """Four times the score makes standard deviations twice as wide, none wider than at first."""
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    covariance = turn @ np.diag([1e-3, 2e-3, 4e-3]) @ turn.T
    np.testing.assert_allclose(calibrated(covariance, np.linalg.inv(covariance)), covariance)
    np.testing.assert_allclose(
        calibrated(covariance, 4.0 * np.linalg.inv(covariance)), 4.0 * covariance
    )
    wide = calibrated(np.diag([1.0, 0.5, 1e-4]), np.diag([4.0, 8.0, 4e4]))
    np.testing.assert_allclose(wide, np.diag([1.0, 1.0, 4e-4]))
