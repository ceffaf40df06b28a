"""Least squares on logs with accelerations: its rows, lstsq's solution, what it refuses."""

import dataclasses

import numpy as np
import pytest
from test_model import random_body, random_values

from rov_ident.equation_error import Log, equation_error, rows
from rov_ident.errors import UserError
from rov_ident.model import build

CLASSICAL = {
    "X_udot": -6.4, "Y_vdot": -7.1, "Z_wdot": -18.7, "K_pdot": -0.19, "M_qdot": -0.13,
    "N_rdot": -0.22, "X_u": -13.7, "Y_v": -8.0, "Z_w": -33.0, "K_p": -0.1, "M_q": -0.8, "N_r": -0.2,
}  # fmt: skip
FULL = CLASSICAL | {
    "X_uu": -141.0, "Y_vv": -217.0, "Z_ww": -190.0, "K_pp": -1.2, "M_qq": -0.5, "N_rr": -1.5,
    "Y_rdot": 0.3, "Z_qdot": -0.3, "Y_r": 0.5, "N_uv": -4.0, "X_vv": -10.0, "M_w": 0.4,
}  # fmt: skip


def log_of(model, n=400, seed=0):
    """Any motion, and the wrench that it takes by the inverse dynamics."""
    rng = np.random.default_rng(seed)
    nu, nu_dot = rng.standard_normal((2, n, 6))
    down = rng.standard_normal((n, 3))
    down /= np.linalg.norm(down, axis=1)[:, None]
    wrench = np.array([model.wrench(*row) for row in zip(nu, nu_dot, down)])
    return Log(nu, nu_dot, wrench, down)


@pytest.fixture(scope="module", params=[CLASSICAL, FULL], ids=["classical", "full"])
def model(request, heavy):
    return build(heavy.model.body, request.param)


@pytest.mark.parametrize("seed", range(10))
def test_rows_of_random_vehicles_are_the_regressors(seed):
    """Any of all coefficients, products of inertia and all: several steps to a sum, shared rows."""
    rng = np.random.default_rng(seed)
    body, values = random_body(rng), random_values(rng)
    values = {name: values[name] for name in rng.permutation(list(values))[: rng.integers(1, 200)]}
    heavy_enough = dataclasses.replace(body, mass=200.0, inertia=body.inertia + 50.0 * np.eye(3))
    model = build(heavy_enough, values)
    nu, nu_dot, wrench = rng.standard_normal((3, 140, 6))
    down = rng.standard_normal((140, 3))
    found = rows(model, Log(nu, nu_dot, wrench, down))
    known = model.with_theta(np.zeros(len(values)))
    for k in range(140):
        goal = wrench[k] - known.wrench(nu[k], nu_dot[k], down[k])
        np.testing.assert_allclose(found[:, -1, k], goal, rtol=1e-9, atol=1e-9)
        expected = model.regressor(nu[k], nu_dot[k])
        np.testing.assert_allclose(found[:, :-1, k], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("tsqr", [False, True])
@pytest.mark.parametrize("n", [100, 128, 300])  # within, at and beyond a block
def test_a_log_gives_the_coefficients_that_made_it(model, tsqr, n):
    found = equation_error(model, log_of(model, n), tsqr=tsqr)
    np.testing.assert_allclose(found, model.theta, rtol=1e-9)


@pytest.mark.parametrize("tsqr", [False, True])
def test_a_noisy_log_gives_what_lstsq_does(model, tsqr):
    log = log_of(model)
    noisy = dataclasses.replace(
        log, wrench=log.wrench + np.random.default_rng(1).standard_normal(log.wrench.shape)
    )
    weight = np.array([1.0, 2.0, 0.5, 30.0, 40.0, 50.0])
    known = model.with_theta(np.zeros(len(model.theta)))
    rows = zip(noisy.nu, noisy.nu_dot, noisy.wrench, noisy.down)
    parts = [(model.regressor(v, a), w - known.wrench(v, a, d)) for v, a, w, d in rows]
    scale = np.tile(np.sqrt(weight), len(parts))
    matrix = np.concatenate([p[0] for p in parts]) * scale[:, None]
    goal = np.concatenate([p[1] for p in parts]) * scale
    expected = np.linalg.lstsq(matrix, goal, rcond=None)[0]
    found = equation_error(model, noisy, weight, tsqr=tsqr)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_householder_keeps_what_normal_equations_lose(heavy):
    model = build(heavy.model.body, {"X_u": -10.0, "X_uu": -100.0})
    rng = np.random.default_rng(0)
    nu, nu_dot = np.zeros((2000, 6)), np.zeros((2000, 6))
    nu[:, 0] = 1.0 + 1e-6 * rng.standard_normal(2000)  # nearly one speed: |u| u = 2 u - 1
    down = np.tile([0.0, 0.0, 1.0], (2000, 1))
    wrench = np.array([model.wrench(*row) for row in zip(nu, nu_dot, down)])
    log = Log(nu, nu_dot, wrench, down)
    good = equation_error(model, log, tsqr=True)
    np.testing.assert_allclose(good, model.theta, rtol=1e-7)
    try:
        poor = equation_error(model, log)
    except UserError:
        return
    assert np.abs(poor / model.theta - 1.0).max() > 1e-6


def test_what_a_log_does_not_tell_is_said(heavy):
    model = build(heavy.model.body, CLASSICAL)
    log = log_of(model)
    still = dataclasses.replace(log, nu=log.nu * 0.0, nu_dot=log.nu_dot * 0.0)
    with pytest.raises(UserError, match="says nothing of X_udot"):
        equation_error(model, still)
    spoilt = log.nu.copy()
    spoilt[5, 0] = np.nan
    with pytest.raises(UserError, match="not finite"):
        equation_error(model, dataclasses.replace(log, nu=spoilt))


def test_logs_of_other_shapes_are_refused(heavy):
    model = build(heavy.model.body, CLASSICAL)
    log = log_of(model)
    with pytest.raises(UserError, match=r"nu_dot needs shape \(400, 6\), not \(399, 6\)"):
        dataclasses.replace(log, nu_dot=log.nu_dot[1:])
    none = Log(*np.zeros((3, 0, 6)), np.zeros((0, 3)))
    assert rows(model, none).shape == (6, len(model.theta) + 1, 0)
    for tsqr in (False, True):
        with pytest.raises(UserError, match="says nothing of X_udot"):
            equation_error(model, none, tsqr=tsqr)
