"""The Runge-Kutta step and the observer against the textbook."""

from collections import namedtuple

import numba
import numpy as np
import pytest
import textbook

from rov_ident.core.jit import record
from rov_ident.core.runge_kutta import NODES, linear_step, runge_kutta
from rov_ident.estimation import observer
from rov_ident.model.equations import momentum_columns


@numba.njit(cache=True)
def pendulum(x, dt):
    reached, end, slope = x.copy(), x.copy(), np.empty(2)
    for stage in range(4):
        slope[0] = reached[1]
        slope[1] = -np.sin(reached[0]) + NODES[stage] * dt
        runge_kutta(stage, dt, x, slope, reached, end)
    return end


def test_the_runge_kutta_step_is_the_textbooks():
    x = np.array([0.7, -0.3])
    wanted = textbook.runge_kutta(lambda t, y: np.array([y[1], t - np.sin(y[0])]), 0.0, x, 0.1)
    np.testing.assert_allclose(pendulum(x, 0.1), wanted, rtol=1e-14)


@numba.njit(cache=True)
def small_change(jacobian):
    work, transition, held = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    linear_step(jacobian, work, transition, held)
    return transition, held


def test_a_small_change_moves_as_the_step_moves_a_linear_motion():
    draw = np.random.default_rng(4)
    jacobian, x, push = draw.normal(size=(6, 6)), draw.normal(size=6), draw.normal(size=6)
    wanted = textbook.runge_kutta(lambda t, y: jacobian @ y / 0.1 + push, 0.0, x, 0.1)
    transition, held = small_change(jacobian)
    np.testing.assert_allclose(transition @ x + 0.1 * held @ push, wanted, rtol=1e-12)


@numba.njit(cache=True)
def stepped(structure, theta, one_theta, nu, dt, estimated, scale, work, drive):
    s = work.scratch[0]
    observer.linearised_step(structure, theta, one_theta, nu, -0.5 * dt, dt, s)
    momentum_columns(structure, s.middle_nu_dot, work.of_rate)
    observer.drive_of(structure, s.middle, estimated, scale, len(scale), work, drive)


@pytest.fixture
def parts(heavy):
    """A step of the BlueROV2 Heavy as a function of nu and theta, and what it leaves behind."""
    m, dt = len(heavy.model.theta), 0.005
    work = namedtuple("Work", "of_rate momentum of_motion scratch")(
        np.empty((6, m)), np.empty((6, m)), np.empty((6, m)),
        np.zeros(1, dtype=record(observer.OBSERVER)),
    )  # fmt: skip
    force = np.array([40.0, -30.0, 25.0, 2.0, -3.0, 4.0])
    s, drive = work.scratch, np.empty((6, m))

    def step(nu, theta):
        model = heavy.model.with_theta(theta)
        mass = model.mass_matrix
        s["inverse"], s["one_mass"] = np.linalg.inv(mass), mass[:, :, None]
        s["mass"], s["force"], s["slope"] = s["one_mass"], force, 3.0
        wide = np.repeat(theta[:, None], observer.LANES, axis=1)
        one = np.ascontiguousarray(theta[:, None])
        stepped(model.structure, wide, one, nu, dt, np.arange(m), np.ones(m), work, drive)
        return s["end"][0].copy()

    return heavy.model, s, drive, force, dt, step


NU = np.array([0.8, -0.5, 0.4, 0.3, -0.2, 0.6])


def test_the_mean_moves_as_the_equations_of_motion_say(parts):
    model, _, _, force, dt, step = parts

    def rate(t, nu):
        tau = force + 3.0 * (t - 0.5 * dt)
        names, none = model.coefficients, np.zeros(3)
        return textbook.acceleration(model.body, names, model.theta, nu, tau, none)

    wanted = textbook.runge_kutta(rate, 0.0, NU, dt)
    np.testing.assert_allclose(step(NU, model.theta), wanted, rtol=1e-12)


def test_the_linearisation_is_the_derivative_of_the_step(parts):
    model, s, drive, _, _, step = parts
    step(NU, model.theta)
    transition, into = s["transition"][0].copy(), s["into"][0].copy()
    columns = into @ drive
    for i in range(6):
        shift = 1e-5 * np.eye(6)[i]
        slope = (step(NU + shift, model.theta) - step(NU - shift, model.theta)) / 2e-5
        np.testing.assert_allclose(transition[:, i], slope, atol=2e-4)
    for i in range(len(model.theta)):
        shift = 1e-4 * abs(model.theta[i]) * np.eye(len(model.theta))[i]
        slope = (step(NU, model.theta + shift) - step(NU, model.theta - shift)) / 2.0
        size = np.abs(slope).max()
        np.testing.assert_allclose(columns[:, i] * shift[i], slope, atol=0.01 * size)


@numba.njit(cache=True)
def corrected(x, p, sensitivity, row, cross, total, innovation):
    observer.correct(x, p, sensitivity, row, cross, total, innovation)


def test_a_measurement_corrects_as_a_kalman_filter():
    rng = np.random.default_rng(1)
    p, x = textbook.random_covariance(6, rng), rng.standard_normal(6)
    s = rng.standard_normal((6, 3))
    h, r, z = np.eye(6)[2], 0.3, 0.7
    gain = p @ h / (h @ p @ h + r)
    wanted_x, wanted_p = x + gain * (z - x[2]), p - np.outer(gain, h @ p)
    wanted_s = s - np.outer(gain, s[2])
    corrected(x, p, s, s[2].copy(), p[:, 2].copy(), p[2, 2] + r, z - x[2])
    np.testing.assert_allclose(x, wanted_x)
    np.testing.assert_allclose(p, wanted_p, atol=1e-14)
    np.testing.assert_allclose(s, wanted_s)
