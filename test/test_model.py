"""The equations of motion against matrices built here, from the textbook, from nothing of ours.

The textbook: Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, ch. 2 to 6.

Tolerances: both sides are sums of products of doubles, added up in another order. They may differ
by some units in the last place of the *largest* of the terms, not of the sum, which may cancel.
"Equal" therefore means to 1e-12 of the sum of the terms' magnitudes (:func:`same`).
"""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from bench import CONFIGS
from rov_ident import config
from rov_ident.core.errors import UserError
from rov_ident.model.coefficients import EXTENDED_SIZE, catalogue
from rov_ident.model.equations import (
    CURRENT,
    Model,
    RigidBody,
    add_current,
    build,
    columns,
    coriolis,
)
from rov_ident.simulation.open_loop import simulate

Array = NDArray[np.float64]

AXES = "XYZKMN"
VELOCITIES = "uvwpqr"
DOWN = np.array([0.0, 0.0, 1.0])

# A kernel compiles on its first call; no example is slow after that.
given_states = settings(deadline=None, max_examples=60)


# ------------------------------------------------------------------ the textbook


def S(a: Array) -> Array:
    """The cross product as a matrix: ``S(a) b = a x b``."""
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]], dtype=float)


def rigid_body_mass(m: float, r_g: Array, I_g: Array) -> Array:
    """M_RB (6, 6), with the parallel-axis theorem written out."""
    I_b = I_g + m * (r_g @ r_g * np.eye(3) - np.outer(r_g, r_g))
    return np.block([[m * np.eye(3), -m * S(r_g)], [m * S(r_g), I_b]])


def coriolis_of(M: Array, nu: Array) -> Array:
    """C(nu) (6, 6) of any symmetric mass matrix, rigid body or added mass."""
    v, w = nu[:3], nu[3:]
    upper = -S(M[:3, :3] @ v + M[:3, 3:] @ w)
    return np.block([[np.zeros((3, 3)), upper], [upper, -S(M[3:, :3] @ v + M[3:, 3:] @ w)]])


def newton_euler(m: float, r_g: Array, I_g: Array, nu: Array, nu_dot: Array) -> Array:
    """Force and moment about the origin (6,) by Newton's and Euler's laws at the CG."""
    v, w, a, alpha = nu[:3], nu[3:], nu_dot[:3], nu_dot[3:]
    force = m * (a + np.cross(w, v) + np.cross(alpha, r_g) + np.cross(w, np.cross(w, r_g)))
    moment = I_g @ alpha + np.cross(w, I_g @ w) + np.cross(r_g, force)
    return np.concatenate([force, moment])


def restoring(W: float, B: float, r_g: Array, r_b: Array, phi: float, theta: float) -> Array:
    """g(eta) (6,) in Euler angles, row by row."""
    (x_g, y_g, z_g), (x_b, y_b, z_b) = r_g, r_b
    s, c, sin, cos = np.sin(theta), np.cos(theta), np.sin(phi), np.cos(phi)
    return np.array(
        [
            (W - B) * s,
            -(W - B) * c * sin,
            -(W - B) * c * cos,
            -(y_g * W - y_b * B) * c * cos + (z_g * W - z_b * B) * c * sin,
            (z_g * W - z_b * B) * s + (x_g * W - x_b * B) * c * cos,
            -(x_g * W - x_b * B) * c * sin - (y_g * W - y_b * B) * s,
        ]
    )


def down_of(phi: float, theta: float) -> Array:
    """The vertical in body axes."""
    return np.array([-np.sin(theta), np.cos(theta) * np.sin(phi), np.cos(theta) * np.cos(phi)])


def damping_formulas() -> dict[str, Callable[[dict[str, float]], float]]:
    """What each velocity coefficient multiplies, by name."""
    even = "X_vv X_ww X_pp X_qq X_rr Z_uu Z_pp Z_rr M_uu M_pp M_rr".split()
    formulas: dict[str, Callable[[dict[str, float]], float]] = {}
    for axis, b in itertools.product(AXES, VELOCITIES):
        formulas[f"{axis}_{b}"] = lambda n, b=b: n[b]
        formulas[f"{axis}_{b}{b}"] = lambda n, b=b: n[b] * abs(n[b])
        for c in VELOCITIES.replace(b, ""):
            formulas[f"{axis}_{b}{c}"] = lambda n, b=b, c=c: n[b] * n[c]
            formulas[f"{axis}_{b}_abs_{c}"] = lambda n, b=b, c=c: n[b] * abs(n[c])
    for axis, b in zip(AXES, VELOCITIES):
        formulas[f"{axis}_{b}_neg"] = lambda n, b=b: n[b] if n[b] < 0 else 0.0
        formulas[f"{axis}_{b}{b}_neg"] = lambda n, b=b: -(n[b] ** 2) if n[b] < 0 else 0.0
    for name in even:
        formulas[name] = lambda n, b=name[2]: n[b] ** 2
    return formulas


FORMULAS = damping_formulas()


def damping_force(values: dict[str, float], nu: Array) -> tuple[Array, Array]:
    """-D(nu) nu (6,), and the sum of the magnitudes of its terms (6,)."""
    named = dict(zip(VELOCITIES, nu))
    force, size = np.zeros(6), np.zeros(6)
    for name, value in values.items():
        if not name.endswith("dot"):
            term = value * FORMULAS[name](named)
            force[AXES.index(name[0])] += term
            size[AXES.index(name[0])] += abs(term)
    return force, size


def added_mass(values: dict[str, float]) -> Array:
    """M_A (6, 6) = -(dF / d nu_dot), each given entry and its mirror image."""
    A = np.zeros((6, 6))
    for name, value in values.items():
        if name.endswith("dot"):
            i, j = AXES.index(name[0]), VELOCITIES.index(name[2])
            A[i, j] = A[j, i] = -value
    return A


def places(p: Array) -> Array:
    """Where the momentum p (6,) stands in C(nu)."""
    return np.block([[np.zeros((3, 3)), -S(p[:3])], [-S(p[:3]), -S(p[3:])]])


def same(ours: Array, theirs: Array, size: Array) -> None:
    """To 1e-12 of ``size``, the magnitude of what was added up."""
    assert np.all(np.abs(ours - theirs) <= 1e-12 * size), np.max(np.abs(ours - theirs) / size)


# ------------------------------------------------------------------ vehicles and states


def random_symmetric(rng: np.random.Generator, scales: list[float]) -> Array:
    """Positive definite, full, with entries of the size of the scales."""
    a = rng.normal(size=(2 * len(scales), len(scales))) * np.sqrt(scales)
    return a.T @ a / len(a) + 0.1 * np.diag(scales)


def random_body(rng: np.random.Generator) -> RigidBody:
    """Centres anywhere within a hand's breadth, products of inertia, heavy or light."""
    return RigidBody(
        mass=13.5,
        weight=132.4,
        buoyancy=132.4 * rng.uniform(0.9, 1.1),
        cog=rng.uniform(-0.1, 0.1, 3),
        cob=rng.uniform(-0.1, 0.1, 3),
        inertia=random_symmetric(rng, [0.3, 0.3, 0.4]),
    )


def random_values(rng: np.random.Generator) -> dict[str, float]:
    """Every coefficient of the grammar at once: full added mass, all couplings."""
    A = random_symmetric(rng, [10.0, 15.0, 20.0, 0.2, 0.2, 0.3])
    values = {}
    for c in catalogue():
        if c.is_added_mass:
            values[c.name] = -A[c.row, c.column]
        else:
            own = c.is_diagonal or c.is_one_sided
            values[c.name] = -abs(rng.normal()) if own else rng.normal()
    return values


BODY = random_body(np.random.default_rng(1))
VALUES = random_values(np.random.default_rng(2))
FULL = build(BODY, VALUES)

# 1e-100: no underflow of products; the sign of zero is left to hypothesis.
number = st.floats(-20.0, 20.0, allow_subnormal=False).filter(lambda x: x == 0 or abs(x) > 1e-100)
vectors = arrays(float, 6, elements=number)
angles = st.floats(-np.pi, np.pi, allow_subnormal=False)


def textbook_wrench(
    body: RigidBody, values: dict[str, float], nu: Array, nu_dot: Array, phi: float, theta: float
) -> tuple[Array, Array]:
    """tau (6,) and the sum of the magnitudes of all its terms (6,)."""
    M = rigid_body_mass(body.mass, body.cog, body.inertia) + added_mass(values)
    C = coriolis_of(M, nu)
    force, size = damping_force(values, nu)
    g = restoring(body.weight, body.buoyancy, body.cog, body.cob, phi, theta)
    size = size + np.abs(M) @ np.abs(nu_dot) + np.abs(places(np.abs(M) @ np.abs(nu))) @ np.abs(nu)
    return M @ nu_dot + C @ nu - force + g, size + body.weight + body.buoyancy


# ------------------------------------------------------------------ the whole equation


@given_states
@given(nu=vectors, nu_dot=vectors, phi=angles, theta=angles)
def test_wrench_with_every_coefficient_is_the_textbooks(nu, nu_dot, phi, theta):
    expected, size = textbook_wrench(BODY, VALUES, nu, nu_dot, phi, theta)
    same(FULL.wrench(nu, nu_dot, down_of(phi, theta)), expected, size)


@pytest.mark.parametrize("seed", range(20))
def test_wrench_of_random_vehicles_is_the_textbooks(seed):
    rng = np.random.default_rng([3, seed])
    body, values = random_body(rng), random_values(rng)
    # Any subset of the names, in any order.
    values = {name: values[name] for name in rng.permutation(list(values))[: rng.integers(1, 300)]}
    A = added_mass(values)
    body = RigidBody(  # heavy enough for whatever half of an added mass was drawn
        200.0, 1962.0, 1950.0, body.cog, body.cob, body.inertia + 50.0 * np.eye(3)
    )
    model = build(body, values)
    assert set(model.names) == set(values)
    same(model.mass_matrix, rigid_body_mass(200.0, body.cog, body.inertia) + A, 250.0 + abs(A))
    for _ in range(10):
        nu, nu_dot = rng.normal(size=(2, 6))
        phi, theta = rng.uniform(-np.pi, np.pi, 2)
        expected, size = textbook_wrench(body, values, nu, nu_dot, phi, theta)
        same(model.wrench(nu, nu_dot, down_of(phi, theta)), expected, size)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_wrench_of_the_shipped_vehicles_is_the_textbooks(path):
    model = config.load(path).model
    fins = set(model.fins)  # at zero: test_driven.py has their formulas
    values = {name: value for name, value in model.values.items() if name not in fins}
    rng = np.random.default_rng(4)
    for _ in range(20):
        nu, nu_dot = rng.normal(size=(2, 6))
        phi, theta = rng.uniform(-np.pi, np.pi, 2)
        expected, size = textbook_wrench(model.body, values, nu, nu_dot, phi, theta)
        same(model.wrench(nu, nu_dot, down_of(phi, theta)), expected, size)


@given_states
@given(nu=vectors, nu_dot=vectors)
def test_rigid_body_alone_obeys_newton_and_euler(nu, nu_dot):
    """With no matrix on the other side: both laws at the centre of gravity, moved to the origin."""
    body = RigidBody(13.5, 0.0, 0.0, BODY.cog, BODY.cob, BODY.inertia)
    expected = newton_euler(body.mass, body.cog, body.inertia, nu, nu_dot)
    size = np.abs(body.mass_matrix) @ np.abs(nu_dot) + 40.0 * (1.0 + nu @ nu)
    same(build(body, {}).wrench(nu, nu_dot, DOWN), expected, size)


def test_each_coefficient_alone_is_its_formula():
    """All names, one at a time: nothing acts on another axis, nothing hides behind a sum."""
    rng = np.random.default_rng(5)
    nu, nu_dot = rng.normal(size=(2, 6))
    empty = build(BODY, {})
    tested = 0
    for c in catalogue():
        values = {c.name: -0.01}
        if c.is_one_sided:
            np.testing.assert_array_equal(
                build(BODY, values).wrench(abs(nu), nu_dot, DOWN),
                empty.wrench(abs(nu), nu_dot, DOWN),
            )
            nu = -abs(nu)
        ours = build(BODY, values).wrench(nu, nu_dot, DOWN) - empty.wrench(nu, nu_dot, DOWN)
        A = added_mass(values)
        theirs = A @ nu_dot + coriolis_of(A, nu) @ nu - damping_force(values, nu)[0]
        # The difference of two wrenches of some 100 N.
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12, err_msg=c.name)
        assert np.any(theirs != 0.0)
        tested += 1
    assert tested == len(VALUES)


# ------------------------------------------------------------------ its parts


@given_states
@given(nu=vectors)
def test_coriolis_matrix_is_fossens_and_skew(nu):
    M = rigid_body_mass(BODY.mass, BODY.cog, BODY.inertia) + added_mass(VALUES)
    p = np.abs(M) @ np.abs(nu)
    C = FULL.coriolis_matrix(nu)
    same(C, coriolis_of(M, nu), np.max(p) * np.ones((6, 6)))
    np.testing.assert_array_equal(C, -C.T)
    same(C @ nu, FULL.coriolis_force(nu), np.abs(places(p)) @ np.abs(nu))


@given_states
@given(nu=vectors)
def test_coriolis_force_does_no_work(nu):
    p = np.abs(FULL.mass_matrix) @ np.abs(nu)
    size = np.abs(nu) @ np.abs(places(p)) @ np.abs(nu)
    same(nu @ FULL.coriolis_force(nu), np.float64(0.0), size)


@given_states
@given(nu=vectors)
def test_coriolis_of_the_rigid_body_is_fossens_closed_form(nu):
    """The form that has v and r_g written out, instead of the momentum."""
    m, r_g, v, w = BODY.mass, BODY.cog, nu[:3], nu[3:]
    I_b = rigid_body_mass(m, r_g, BODY.inertia)[3:, 3:]
    upper = -m * S(v) - m * S(np.cross(w, r_g))
    C = np.block([[np.zeros((3, 3)), upper], [upper, m * S(np.cross(v, r_g)) - S(I_b @ w)]])
    size = 100.0 * np.max(np.abs(nu)) ** 2
    same(coriolis(build(BODY, {}).mass_matrix @ nu, nu), C @ nu, size * np.ones(6))


@given_states
@given(nu=vectors)
def test_damping_matrix_times_velocity_is_the_sum_of_the_named_terms(nu):
    force, size = damping_force(VALUES, nu)
    same(FULL.damping_matrix(nu) @ nu, -force, size)
    same(FULL.damping_force(nu), force, size)


@given_states
@given(nu=vectors, nu_dot=vectors)
def test_a_term_that_is_zero_changes_nothing(nu, nu_dot):
    """Even beside damping that drives, as noise makes it."""
    model = build(BODY, {"X_u": -3.0, "Z_wdot": -9.0}).with_values({"X_u": 0.2})
    wider = model.with_terms(["Y_uv", "X_wdot"])
    assert wider.values == {"X_u": 0.2, "Z_wdot": -9.0, "Y_uv": 0.0, "X_wdot": 0.0}
    down = np.array([0.0, 0.0, 1.0])
    np.testing.assert_array_equal(
        wider.wrench(nu, nu_dot, down), model.wrench(nu, nu_dot, down), strict=True
    )


@given_states
@given(phi=angles, theta=angles)
def test_restoring_force_is_fossens_in_euler_angles(phi, theta):
    g = restoring(BODY.weight, BODY.buoyancy, BODY.cog, BODY.cob, phi, theta)
    same(FULL.restoring_force(down_of(phi, theta)), g, np.full(6, BODY.weight + BODY.buoyancy))


def test_restoring_force_has_the_signs_one_can_feel():
    """On the left-hand side: the thrusters must hold -B up, and a roll to starboard is righted."""
    light = RigidBody(10.0, 98.0, 100.0, np.zeros(3), np.array([0.0, 0.0, -0.02]), np.eye(3))
    model = build(light, {})
    np.testing.assert_allclose(model.restoring_force(DOWN), [0, 0, 2.0, 0, 0, 0], atol=1e-15)
    heeled = model.acceleration(np.zeros(6), np.zeros(6), down_of(0.1, 0.0))
    assert heeled[3] < 0.0
    nose_up = model.acceleration(np.zeros(6), np.zeros(6), down_of(0.0, 0.1))
    assert nose_up[4] < 0.0


# ------------------------------------------------------------------ moving water


@given_states
@given(nu=vectors, water=arrays(float, 3, elements=number))
def test_current_is_the_difference_of_fossens_two_equations(nu, water):
    """Sec. 10.3: M_A, C_A and d have the velocity through the water, M_RB and C_RB over ground."""
    A, still = added_mass(VALUES), np.concatenate([water, np.zeros(3)])
    nu_c_dot = np.concatenate([-np.cross(nu[3:], water), np.zeros(3)])
    over_ground = coriolis_of(A, nu) @ nu - damping_force(VALUES, nu)[0]
    relative = nu - still
    work = np.zeros(1, CURRENT)
    through = coriolis_of(A, relative) @ relative - damping_force(VALUES, relative)[0]
    through = through - A @ nu_c_dot
    size = 400.0 * (1.0 + np.abs(nu).max() + np.abs(water).max()) ** 2
    found = np.zeros(6)
    mass, theta = FULL.added_mass[:, :, None], FULL.theta[:, None]
    add_current(FULL.structure, mass, theta, nu, tuple(water.tolist()), work[0], found)
    np.testing.assert_array_equal(work[0]["relative"], relative)
    same(found, over_ground - through, np.full(6, size))


def test_still_water_does_nothing():
    nu = np.random.default_rng(6).normal(size=6)
    found = np.zeros(6)
    mass, theta = FULL.added_mass[:, :, None], FULL.theta[:, None]
    work = np.zeros(1, CURRENT)
    add_current(FULL.structure, mass, theta, nu, (0.0, 0.0, 0.0), work[0], found)
    np.testing.assert_array_equal(found, 0.0)


# ------------------------------------------------------------------ inverse and forward


@given_states
@given(nu=vectors, nu_dot=vectors, phi=angles, theta=angles)
def test_forward_undoes_inverse(nu, nu_dot, phi, theta):
    down = down_of(phi, theta)
    tau = FULL.wrench(nu, nu_dot, down)
    back = FULL.acceleration(nu, tau, down)
    _, size = textbook_wrench(BODY, VALUES, nu, nu_dot, phi, theta)
    # What is lost in the wrench comes back through the inverse of M.
    same(back, nu_dot, np.abs(np.linalg.inv(FULL.mass_matrix)) @ size + np.abs(nu_dot))


@given_states
@given(nu=vectors, tau=vectors, phi=angles, theta=angles)
def test_inverse_undoes_forward(nu, tau, phi, theta):
    down = down_of(phi, theta)
    nu_dot = FULL.acceleration(nu, tau, down)
    _, size = textbook_wrench(BODY, VALUES, nu, nu_dot, phi, theta)
    condition = np.linalg.cond(FULL.mass_matrix)
    same(FULL.wrench(nu, nu_dot, down), tau, np.full(6, size.max()) * condition)


def test_at_rest_nothing_but_inertia_and_weight():
    tau = FULL.wrench(np.zeros(6), np.arange(6.0), DOWN)
    expected = FULL.mass_matrix @ np.arange(6.0) + FULL.restoring_force(DOWN)
    np.testing.assert_array_equal(tau, expected)
    np.testing.assert_array_equal(
        FULL.damping_matrix(np.zeros(6)), FULL.damping_matrix(np.full(6, -0.0))
    )
    assert np.isfinite(FULL.regressor(np.zeros(6), np.zeros(6))).all()


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_motion_along_one_axis_of_a_symmetric_vehicle_stays_there(heavy, axis, sign):
    """No product of velocities is left: mass, linear and quadratic drag of that axis only."""
    body = heavy.model.body
    trimmed = RigidBody(body.mass, 100.0, 100.0, np.zeros(3), np.zeros(3), body.inertia)
    values = dict(zip(heavy.model.names, heavy.model.theta))
    model = build(trimmed, values)
    nu = np.zeros(6)
    nu[axis] = 0.7 * sign
    a, b = AXES[axis], VELOCITIES[axis]
    drag = (
        -values.get(f"{a}_{b}", 0.0) * nu[axis] - values[f"{a}_{b}{b}"] * abs(nu[axis]) * nu[axis]
    )
    tau = model.wrench(nu, np.zeros(6), DOWN)
    assert tau[axis] == pytest.approx(drag, rel=1e-14)
    assert np.all(np.delete(tau, axis) == 0.0)
    assert tau @ nu > 0.0  # it takes power to move


@pytest.mark.parametrize("size", [1e6, -1e6])
def test_a_million_newtons_are_nothing_special(size):
    tau = np.full(6, size)
    nu_dot = FULL.acceleration(np.ones(6), tau, DOWN)
    assert np.isfinite(nu_dot).all()
    np.testing.assert_allclose(FULL.wrench(np.ones(6), nu_dot, DOWN), tau, rtol=1e-10)


# ------------------------------------------------------------------ the regressor


@given_states
@given(nu=vectors, nu_dot=vectors, phi=angles, theta=angles)
def test_regressor_times_coefficients_and_the_known_part_is_the_wrench(nu, nu_dot, phi, theta):
    M_RB = rigid_body_mass(BODY.mass, BODY.cog, BODY.inertia)
    g = restoring(BODY.weight, BODY.buoyancy, BODY.cog, BODY.cob, phi, theta)
    known = M_RB @ nu_dot + coriolis_of(M_RB, nu) @ nu + g
    expected, size = textbook_wrench(BODY, VALUES, nu, nu_dot, phi, theta)
    same(FULL.regressor(nu, nu_dot) @ FULL.theta + known, expected, size)


def test_regressor_is_the_derivative_of_the_wrench_by_each_coefficient():
    """Exact for any step, as the wrench is linear in the coefficients."""
    rng = np.random.default_rng(6)
    nu, nu_dot = rng.normal(size=(2, 6))
    Y = FULL.regressor(nu, nu_dot)
    before = FULL.wrench(nu, nu_dot, DOWN)
    for column, name in enumerate(FULL.names):
        after = FULL.with_values({name: VALUES[name] + 1.0}).wrench(nu, nu_dot, DOWN)
        np.testing.assert_allclose(after - before, Y[:, column], atol=2e-13 * 200.0, err_msg=name)


# The problem of the research notes: diagonal added mass, linear damping, CG in the origin.
NOTES = "X_udot Y_vdot Z_wdot K_pdot M_qdot N_rdot X_u Y_v Z_w K_p M_q N_r".split()
NOTES_BODY = RigidBody(13.5, 0.0, 0.0, np.zeros(3), np.zeros(3), np.diag([0.26, 0.23, 0.37]))
NOTES_VALUES = dict(
    zip(NOTES, [-6.36, -7.12, -18.68, -0.189, -0.135, -0.222, -13.7, -2.0, -33.0, -0.3, -0.8, -0.4])
)


def right_rows(nu: Array, nu_dot: Array, t: dict[str, float]) -> Array:
    """What the coefficients t do, axis by axis, as docs/model.md derives it."""
    (u, v, w, p, q, r), (udot, vdot, wdot, pdot, qdot, rdot) = nu, nu_dot
    X_udot, Y_vdot, Z_wdot = t["X_udot"], t["Y_vdot"], t["Z_wdot"]
    K_pdot, M_qdot, N_rdot = t["K_pdot"], t["M_qdot"], t["N_rdot"]
    return np.array(
        [
            -X_udot * udot - Z_wdot * w * q + Y_vdot * v * r - t["X_u"] * u,
            -Y_vdot * vdot - X_udot * u * r + Z_wdot * w * p - t["Y_v"] * v,
            -Z_wdot * wdot - Y_vdot * v * p + X_udot * u * q - t["Z_w"] * w,
            -K_pdot * pdot - (Z_wdot - Y_vdot) * v * w - (N_rdot - M_qdot) * q * r - t["K_p"] * p,
            -M_qdot * qdot - (X_udot - Z_wdot) * w * u - (K_pdot - N_rdot) * r * p - t["M_q"] * q,
            -N_rdot * rdot - (Y_vdot - X_udot) * u * v - (M_qdot - K_pdot) * p * q - t["N_r"] * r,
        ]
    )


def left_sides(tau: Array, nu: Array, nu_dot: Array, body: RigidBody) -> Array:
    """The wrench less what is known of the rigid body, axis by axis."""
    (u, v, w, p, q, r), (udot, vdot, wdot, pdot, qdot, rdot) = nu, nu_dot
    m, (J_x, J_y, J_z) = body.mass, np.diag(body.inertia)
    X, Y, Z, K, M, N = tau
    return np.array(
        [
            X - m * (udot + q * w - r * v),
            Y - m * (vdot + r * u - p * w),
            Z - m * (wdot + p * v - q * u),
            K - J_x * pdot - (J_z - J_y) * q * r,
            M - J_y * qdot - (J_x - J_z) * r * p,
            N - J_z * rdot - (J_y - J_x) * p * q,
        ]
    )


@given_states
@given(nu=vectors, nu_dot=vectors)
def test_rows_of_the_regressor_are_those_derived(nu, nu_dot):
    model = build(NOTES_BODY, NOTES_VALUES)
    assert model.names == tuple(NOTES)
    rows = right_rows(nu, nu_dot, NOTES_VALUES)
    tau, size = textbook_wrench(NOTES_BODY, NOTES_VALUES, nu, nu_dot, 0.0, 0.0)
    same(model.regressor(nu, nu_dot) @ model.theta, rows, size)
    same(left_sides(tau, nu, nu_dot, NOTES_BODY), rows, size)
    for column, name in enumerate(NOTES):
        alone = right_rows(nu, nu_dot, dict.fromkeys(NOTES, 0.0) | {name: 1.0})
        scale = np.abs(nu_dot).max() + (1.0 + np.abs(nu).max()) ** 2
        same(model.regressor(nu, nu_dot)[:, column], alone, np.full(6, scale))


# ------------------------------------------------------------------ momentum and force


def split(model: Model, nu: Array) -> tuple[Array, Array]:
    """The two parts of the regressor, (6, n) each."""
    n = len(model.theta)
    momentum, force = np.full((6, n), np.nan), np.full((6, n), np.nan)  # must be overwritten
    columns(model.structure, nu, momentum, force, np.empty((EXTENDED_SIZE, 1)))
    return momentum, force


@given_states
@given(nu=vectors)
def test_momentum_columns_hold_the_momentum_of_the_added_mass(nu):
    momentum, force = split(FULL, nu)
    A = added_mass(VALUES)
    same(momentum @ FULL.theta, A @ nu, np.abs(A) @ np.abs(nu))
    damping, size = damping_force(VALUES, nu)
    size = size + np.abs(places(np.abs(A) @ np.abs(nu))) @ np.abs(nu)
    same(force @ FULL.theta, coriolis_of(A, nu) @ nu - damping, size)


def test_momentum_differentiated_in_time_and_force_are_the_wrench():
    """Along a smooth motion: central differences of the momentum, no acceleration used."""
    size, omega, phase = np.random.default_rng(7).uniform(0.5, 1.5, (3, 6))

    def nu_at(t: float) -> Array:
        return size * np.sin(omega * t + phase)

    h = 1e-3
    M_RB = rigid_body_mass(BODY.mass, BODY.cog, BODY.inertia)
    for t in np.linspace(0.0, 5.0, 21):
        nu, nu_dot = nu_at(t), size * omega * np.cos(omega * t + phase)
        (after, _), (before, _) = split(FULL, nu_at(t + h)), split(FULL, nu_at(t - h))
        rate = (after - before) / (2.0 * h) @ FULL.theta
        known_rate = M_RB @ (nu_at(t + h) - nu_at(t - h)) / (2.0 * h)
        known = known_rate + coriolis_of(M_RB, nu) @ nu + FULL.restoring_force(DOWN)
        # Central differences err by h^2/6 of the third derivative: 1e-6 of momenta up to 100.
        np.testing.assert_allclose(
            rate + split(FULL, nu)[1] @ FULL.theta + known, FULL.wrench(nu, nu_dot, DOWN), atol=1e-4
        )


# ------------------------------------------------------------------ energy


def energy(model: Model, position: Array, orientation: Array, nu: Array) -> Array:
    """Kinetic and potential energy (N,) [J] along a trajectory; down is positive z."""
    body = model.body
    w, x, y, z = orientation.T
    third = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    depth_g = position[:, 2] + body.cog @ third
    depth_b = position[:, 2] + body.cob @ third
    kinetic = 0.5 * np.einsum("ni,ij,nj->n", nu, model.mass_matrix, nu)
    return kinetic - body.weight * depth_g + body.buoyancy * depth_b


def still_water(values: dict[str, float], buoyancy: float, duration: float, dt: float) -> Array:
    """Energy (N,) of a vehicle with the centres apart, let go while it moves and tumbles."""
    body = RigidBody(
        13.5,
        132.4,
        buoyancy,
        np.array([0.02, -0.01, 0.03]),
        np.array([0.0, 0.01, -0.05]),
        BODY.inertia,
    )
    model = build(body, values)
    t = np.arange(0.0, duration, dt)
    start = np.array([0.6, -0.4, 0.3, 0.8, -0.5, 0.7])
    run = simulate(model, t, np.zeros((len(t), 6)), nu=start)
    return energy(model, run.position, run.orientation, run.nu)


ADDED_MASS = {name: value for name, value in VALUES.items() if name.endswith("dot")}
# Linear coupling in a positive definite matrix, and a drag that is quadratic along each axis.
_LINEAR = random_symmetric(np.random.default_rng(8), [5.0, 5.0, 5.0, 0.2, 0.2, 0.2])
DAMPING = {f"{a}_{b}": -_LINEAR[i, j] for i, a in enumerate(AXES) for j, b in enumerate(VELOCITIES)}
DAMPING |= {
    f"{a}_{b}{b}": -d for a, b, d in zip(AXES, VELOCITIES, [30.0, 50.0, 60.0, 0.5, 0.5, 0.5])
}


@pytest.mark.parametrize("buoyancy", [132.4, 140.0, 125.0], ids=["neutral", "light", "heavy"])
def test_energy_only_falls_in_still_water_without_thrust(buoyancy):
    total = still_water(ADDED_MASS | DAMPING, buoyancy, 20.0, 0.02)
    assert np.all(np.diff(total) < 0.0)
    assert total[0] - total[-1] > 1.0  # J


@pytest.mark.parametrize("buoyancy", [132.4, 140.0, 125.0], ids=["neutral", "light", "heavy"])
def test_energy_is_conserved_without_damping(buoyancy):
    """But for the error of the integration: at least of fourth order in the step."""
    drift = [np.ptp(still_water(ADDED_MASS, buoyancy, 2.0, dt)) for dt in (0.005, 0.0025)]
    assert drift[1] < 2e-8  # J, of some 10 J
    assert drift[1] < drift[0] / 14.0


# ------------------------------------------------------------------ building


def test_theta_has_added_mass_first_and_keeps_the_order_given():
    model = build(BODY, {"Y_v": -1.0, "Y_vdot": -2.0, "X_uu": -3.0, "X_udot": -4.0})
    assert model.names == ("Y_vdot", "X_udot", "Y_v", "X_uu")
    assert model.theta.tolist() == [-2.0, -4.0, -1.0, -3.0]
    assert model.structure.mass_row.tolist() == [1, 0]
    assert model.structure.row.tolist() == [1, 0]


@pytest.mark.parametrize(("name", "other"), [("Y_rdot", "N_vdot"), ("N_vdot", "Y_rdot")])
def test_either_name_of_an_added_mass_fills_both_entries(name, other):
    model = build(BODY, {name: -0.3})
    assert model.names == (name,)
    both = build(BODY, {name: -0.3, other: -0.3})
    assert both.names == (name,)
    A = model.mass_matrix - BODY.mass_matrix
    assert A[1, 5] == A[5, 1] == pytest.approx(0.3)
    np.testing.assert_array_equal(both.mass_matrix, model.mass_matrix)


@pytest.mark.parametrize(
    "values",
    [
        {"Y_rdot": 1.93, "N_vdot": 1.94},
        {"Y_uv": -28.6, "Y_vu": -28.6},
        {"Y_uv": -28.6, "Y_vu": 0.0},
    ],
)
def test_the_same_term_twice_is_refused(values):
    first, second = values
    message = f"coefficients.{second} and coefficients.{first} are the same term: keep one"
    with pytest.raises(UserError, match=message):
        build(BODY, values)


@pytest.mark.parametrize("name", "X_udot N_rdot X_u M_q X_uu K_pp".split())
def test_a_positive_value_of_the_own_axis_is_refused(name):
    with pytest.raises(UserError, match=rf"coefficients\.{name} is 0\.1, but must not be positive"):
        build(BODY, {name: 0.1})
    assert build(BODY, {name: 0.0}).theta.tolist() == [0.0]


def test_couplings_may_have_either_sign():
    assert build(BODY, {"Y_r": 1.0, "M_ww": 3.18, "Z_qdot": 0.1, "X_vv": 1.0}).names[0] == "Z_qdot"


def test_an_unknown_name_is_named():
    with pytest.raises(UserError, match="'X_speed' is not a hydrodynamic coefficient"):
        build(BODY, {"X_speed": -1.0})


def test_a_mass_matrix_that_is_not_positive_definite_is_refused():
    with pytest.raises(
        UserError, match=r"mass matrix .* not positive definite: check vehicle\.mass"
    ):
        build(BODY, {"X_wdot": 20.0})


def test_new_values_leave_the_old_model_as_it_was():
    model = build(BODY, {"X_udot": -4.0, "X_u": -1.0})
    other = model.with_values({"X_u": -2.0})
    assert other.theta.tolist() == [-4.0, -2.0]
    assert model.with_theta([-5.0, -6.0]).theta.tolist() == [-5.0, -6.0]
    assert model.theta.tolist() == [-4.0, -1.0]
    assert other.body is model.body and other.coefficients is model.coefficients


def test_nothing_writes_into_its_arguments():
    """Every array read-only: an edit in place would raise."""
    rng = np.random.default_rng(9)
    body = random_body(rng)
    nu, nu_dot, tau = rng.normal(size=(3, 6))
    down = DOWN.copy()
    for array in (body.cog, body.cob, body.inertia, nu, nu_dot, tau, down):
        array.setflags(write=False)
    model = build(body, VALUES)
    model.theta.setflags(write=False)
    once, twice = [
        (
            model.wrench(nu, nu_dot, down),
            model.acceleration(nu, tau, down),
            model.regressor(nu, nu_dot),
            model.coriolis_force(nu),
            model.coriolis_matrix(nu),
            model.damping_matrix(nu),
            model.mass_matrix,
            model.with_values({"X_u": -1.0}).theta,
        )
        for _ in range(2)
    ]
    for a, b in zip(once, twice):
        np.testing.assert_array_equal(a, b)
