"""The slips of the research notes and papers that the project started from.

Each printed form is written out and shown to break a law; ours, from the package, keeps it. The
laws are in formulations of their own: point masses for the rigid body, Lagrange's equations in
position and Euler angles for the water, least squares and straight arithmetic for Nomoto.
docs/model.md and docs/nomoto.md have the table.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rov_ident.model.equations import RigidBody, build, skew
from rov_ident.steering import nomoto
from rov_ident.steering.heading_interpolation import spiral
from rov_ident.steering.nomoto_model import simulate_heading
from rov_ident.steering.zigzag import Zigzag

INERTIA = np.array([0.26, 0.23, 0.37])  # kg m2
MASS = 13.5  # kg
BODY = RigidBody(MASS, 0.0, 0.0, np.zeros(3), np.zeros(3), np.diag(INERTIA))
NAMES = ("X_udot", "Y_vdot", "Z_wdot", "K_pdot", "M_qdot", "N_rdot")
ADDED = np.array([-6.36, -7.12, -18.68, -0.189, -0.135, -0.222])  # kg, kg m2
DOWN = np.array([0.0, 0.0, 1.0])
STATES = [
    np.random.default_rng(seed).uniform(0.3, 1.0, (2, 6)) * [[1, -1, 1, -1, 1, 1]]
    for seed in range(5)
]


def ours(added=ADDED):
    return build(BODY, dict(zip(NAMES, added.tolist())))


# ------------------------------------------------------------------ the laws


def point_masses(nu, nu_dot):
    """Newton: the wrench (6,) that moves six point masses with BODY's mass and inertia.

    The body moves by R(t) = I + S(w) t + (S(w)^2 + S(w')) t^2 / 2 from the attitude I, so that a
    point at r has the acceleration x'' + R'' r, with x' = R v.
    """
    each = MASS / 6.0
    squares = (INERTIA.sum() - 2.0 * INERTIA) / (4.0 * each)  # of the distances on x, y and z
    points = np.vstack([np.diag(np.sqrt(squares)), -np.diag(np.sqrt(squares))])
    s = skew(nu[3:])
    accelerations = s @ nu[:3] + nu_dot[:3] + points @ (s @ s + skew(nu_dot[3:])).T
    force = each * accelerations
    return np.concatenate([force.sum(axis=0), np.cross(points, force).sum(axis=0)])


def lagrange(mass, nu, nu_dot, angles=(0.3, -0.4, 0.5), h=1e-5):
    """The wrench (6,) on what has the kinetic energy nu' M nu / 2, mass (6, 6) in body axes.

    d/dt dT/dq' - dT/dq = B' tau with q = (position, roll, pitch, yaw) and nu = B(q) q', by central
    differences: nothing is known here of rotating axes.
    """
    here = np.concatenate([np.zeros(3), angles])

    def to_body(q):
        (sr, sp, sy), (cr, cp, cy) = np.sin(q[3:]), np.cos(q[3:])
        yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        rates = np.array([[1, 0, -sp], [0, cr, sr * cp], [0, -sr, cr * cp]])
        zero = np.zeros((3, 3))
        return np.block([[(yaw @ pitch @ roll).T, zero], [zero, rates]])

    def inertia(q):
        return to_body(q).T @ mass @ to_body(q)

    b = to_body(here)
    rate = np.linalg.solve(b, nu)

    def along(f):
        return (f(here + h * rate) - f(here - h * rate)) / (2.0 * h)

    second = np.linalg.solve(b, nu_dot - along(to_body) @ rate)
    slopes = [
        rate @ (inertia(here + e) - inertia(here - e)) @ rate / (4.0 * h) for e in h * np.eye(6)
    ]
    generalised = inertia(here) @ second + along(inertia) @ rate - slopes
    return np.linalg.solve(b.T, generalised)


def sphere_passing(columns):
    """The force (6,) on a sphere's added mass of 1 kg that turns while it goes straight on.

    Its water moves as if it did not turn: there is none.
    """
    nu = STATES[0][0]
    nu_dot = np.concatenate([-np.cross(nu[3:], nu[:3]), np.zeros(3)])
    return columns(nu, nu_dot) @ np.array([-1.0, -1.0, -1.0, 0.0, 0.0, 0.0])


# ------------------------------------------------------------------ the notes: added mass


def right_columns(nu, nu_dot):
    """(6, 6): what the added mass does, a row an axis, a column each of NAMES."""
    (u, v, w, p, q, r), (du, dv, dw, dp, dq, dr) = nu, nu_dot
    return np.array(
        [
            [-du, v * r, -w * q, 0, 0, 0],
            [-u * r, -dv, w * p, 0, 0, 0],
            [u * q, -v * p, -dw, 0, 0, 0],
            [0, v * w, -v * w, -dp, q * r, -q * r],
            [-u * w, 0, u * w, -r * p, -dq, r * p],
            [u * v, -u * v, 0, p * q, -p * q, -dr],
        ]
    )


def accelerations_reversed(nu, nu_dot):
    return right_columns(nu, -nu_dot)


def both_products(nu, nu_dot, axes=(0, 1, 2)):
    """A force row gives either neighbouring added mass the products of both."""
    out = right_columns(nu, nu_dot)
    for axis in axes:
        neighbours = [i for i in range(3) if i != axis]
        out[axis, neighbours] = out[axis, neighbours].sum()
    return out


def munk_of_roll_reversed(nu, nu_dot):
    out = right_columns(nu, nu_dot)
    out[3, :3] *= -1.0
    return out


def angular_momentum_in_sway(nu, nu_dot, column=4):
    """r (J_z - N_rdot) as an entry of C's sway row; the rigid body's share is left out here."""
    out = right_columns(nu, nu_dot)
    out[1, 5] -= nu[5] * nu[column]
    return out


def all_of_them(nu, nu_dot):
    out = both_products(nu, nu_dot)
    out[3] = munk_of_roll_reversed(nu, nu_dot)[3]
    out[range(6), range(6)] *= -1.0
    out[1, 5] = angular_momentum_in_sway(nu, nu_dot)[1, 5]
    return out


WRONG = (accelerations_reversed, both_products, munk_of_roll_reversed, angular_momentum_in_sway)


@pytest.mark.parametrize("nu, nu_dot", STATES)
def test_our_columns_are_lagranges(nu, nu_dot):
    """The regressor, and the columns printed in docs/model.md."""
    model = ours()
    np.testing.assert_allclose(model.regressor(nu, nu_dot), right_columns(nu, nu_dot), atol=1e-13)
    of_water = lagrange(-np.diag(ADDED), nu, nu_dot)
    # 1e-7: rounding of the central differences, 1e-16 / 1e-5 of some 50 N
    np.testing.assert_allclose(right_columns(nu, nu_dot) @ ADDED, of_water, atol=1e-7)
    np.testing.assert_allclose(
        model.wrench(nu, nu_dot, DOWN), lagrange(model.mass_matrix, nu, nu_dot), atol=1e-7
    )


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("nu, nu_dot", STATES)
def test_printed_added_mass_is_not_lagranges(wrong, nu, nu_dot):
    off = wrong(nu, nu_dot) @ ADDED - lagrange(-np.diag(ADDED), nu, nu_dot)
    assert np.abs(off).max() > 1e-2  # a hundred thousand times the error of the differences


@pytest.mark.parametrize("nu, nu_dot", STATES)
def test_fifteen_of_36_entries(nu, nu_dot):
    off = np.abs(all_of_them(nu, nu_dot) - right_columns(nu, nu_dot)) > 1e-12
    assert off.sum() == 15
    assert off.sum(axis=1).tolist() == [3, 4, 3, 3, 1, 1]


def test_reversed_acceleration_takes_energy_out_of_water_that_is_set_in_motion():
    """From rest, along any axis: the water's kinetic energy can only grow."""
    for axis in range(6):
        nu = np.eye(6)[axis]
        gained = nu @ right_columns(nu, nu) @ ADDED
        assert gained == pytest.approx(-ADDED[axis])  # m_A u du, positive
        assert nu @ accelerations_reversed(nu, nu) @ ADDED == pytest.approx(ADDED[axis])
    assert np.linalg.eigvalsh(ours().mass_matrix).min() > 0.0
    assert np.linalg.eigvalsh(BODY.mass_matrix + np.diag(ADDED)).min() < 0.0  # of heave


@pytest.mark.parametrize("nu, _", STATES)
def test_coriolis_forces_of_the_added_mass_do_no_work(nu, _):
    still = np.zeros(6)
    assert abs(nu @ right_columns(nu, still) @ ADDED) < 1e-13
    assert abs(nu @ munk_of_roll_reversed(nu, still) @ ADDED) > 1e-2
    for axis in range(3):
        assert abs(nu @ both_products(nu, still, (axis,)) @ ADDED) > 1e-2
    for column in range(6):
        assert abs(nu @ angular_momentum_in_sway(nu, still, column) @ ADDED) > 1e-2


def test_both_products_in_all_rows_do_no_work_but_push_a_sphere():
    """Energy alone does not find this one: what the three rows do wrongly cancels in nu' C nu."""
    for nu, _ in STATES:
        assert abs(nu @ both_products(nu, np.zeros(6)) @ ADDED) < 1e-13
    np.testing.assert_allclose(sphere_passing(right_columns), 0.0, atol=1e-15)
    nu = STATES[0][0]
    np.testing.assert_allclose(sphere_passing(both_products)[:3], np.cross(nu[3:], nu[:3]))


def test_angular_momentum_in_sway_is_no_force():
    """In feet instead of metres all forces in the sway row grow by the same factor; this does
    not."""
    foot = 1.0 / 0.3048
    nu, nu_dot = STATES[1]
    length = np.array([foot] * 3 + [1.0] * 3)  # of velocities; moments of inertia take its square
    units = np.array([1.0] * 3 + [foot**2] * 3)

    def sway(columns):
        here = columns(nu, nu_dot)[1] @ ADDED
        return columns(nu * length, nu_dot * length)[1] @ (ADDED * units) / here

    assert sway(right_columns) == pytest.approx(foot)
    for column in range(6):
        wrong = sway(lambda a, b, c=column: angular_momentum_in_sway(a, b, c))
        assert abs(wrong / foot - 1.0) > 1e-2


# ------------------------------------------------------------------ the notes: rigid body, C


def rigid_body(nu, nu_dot, surge=1.0, sway=1.0, spurious=()):
    """The rows of a rigid body; the signs of the Coriolis forces of surge and sway, and the moment
    rows in which the notes have a product of linear velocities."""
    (u, v, w, p, q, r), m = nu, MASS
    products = {3: m * v * w, 4: m * u * w, 5: m * u * v}
    Jx, Jy, Jz = INERTIA
    out = np.concatenate([np.full(3, m), INERTIA]) * nu_dot + np.array(
        [surge * m * (q * w - r * v), sway * m * (r * u - p * w), m * (p * v - q * u),
         (Jz - Jy) * q * r, (Jx - Jz) * r * p, (Jy - Jx) * p * q]
    )  # fmt: skip
    for axis in spurious:
        out[axis] += products[axis]
    return out


@pytest.mark.parametrize("nu, nu_dot", STATES)
def test_rigid_body_is_that_of_point_masses(nu, nu_dot):
    newton = point_masses(nu, nu_dot)
    np.testing.assert_allclose(build(BODY, {}).wrench(nu, nu_dot, DOWN), newton, atol=1e-12)
    np.testing.assert_allclose(rigid_body(nu, nu_dot), newton, atol=1e-12)
    for slip in ({"surge": -1.0}, {"sway": -1.0}, *({"spurious": (i,)} for i in (3, 4, 5))):
        wrong = rigid_body(nu, nu_dot, **slip)
        assert np.abs(wrong - newton).max() > 0.1  # N, N m; of some 20
        work = nu @ (rigid_body(nu, np.zeros(6), **slip))
        assert abs(work) > 1e-2 and abs(nu @ rigid_body(nu, np.zeros(6))) < 1e-12


def test_a_thrown_body_keeps_its_energy_and_momentum():
    """Ten seconds without any force: integrated with each slip, the body gains or loses both."""
    start = np.array([1.0, 0.3, -0.2, 0.3, 0.5, 0.8])
    masses = np.concatenate([np.full(3, MASS), INERTIA])

    def energy_after(**slip):
        def rate(_, nu):
            return -rigid_body(nu, np.zeros(6), **slip) / masses

        def runs_away(_, nu):
            return 1e3 - np.abs(nu).max()

        runs_away.terminal = True
        end = solve_ivp(rate, (0.0, 10.0), start, rtol=1e-9, atol=1e-9, events=runs_away).y[:, -1]
        return (masses @ end**2) / (masses @ start**2)

    assert energy_after() == pytest.approx(1.0, abs=1e-6)
    for slip in ({"surge": -1.0}, {"sway": -1.0}, *({"spurious": (i,)} for i in (3, 4, 5))):
        assert abs(energy_after(**slip) - 1.0) > 0.05, slip


@pytest.mark.parametrize("nu, _", STATES)
def test_c_with_equal_entries_15_and_51_is_not_skew(nu, _):
    """C15 = -S(p1)_12 = p1_z = (m - Z_wdot) w, and C51 is the opposite."""
    c = ours().coriolis_matrix(nu)
    assert c[0, 4] == pytest.approx((MASS - ADDED[2]) * nu[2])
    np.testing.assert_allclose(c, -c.T, atol=1e-13)
    printed = c.copy()
    printed[4, 0] = printed[0, 4]
    work = nu @ printed @ nu
    assert work == pytest.approx(2.0 * (MASS - ADDED[2]) * nu[0] * nu[2] * nu[4])
    assert abs(nu @ c @ nu) < 1e-13 and abs(work) > 1.0  # W


@pytest.mark.parametrize("axis", [3, 4, 5])
def test_linear_momentum_twice_in_a_moment_row_does_work(axis):
    nu, _ = STATES[0]
    printed = ours().coriolis_matrix(nu)
    printed[axis, :3] *= 2.0  # v x p1
    assert abs(nu @ printed @ nu) > 1e-2


# ------------------------------------------------------------------ Nomoto's model

K, T, STEP = 0.3, 4.0, 0.1  # 1/s, s, s


def zigzag():
    """(t, heading, rudder) of the difference equation itself, from rest."""
    heading, rudder, side = np.zeros(600), np.zeros(600), 1.0
    for i in range(598):
        side = -np.sign(heading[i]) if abs(heading[i]) > 0.26 else side
        rudder[i] = 0.26 * side if i >= 5 else 0.0
        rate = (heading[i + 1] - heading[i]) / STEP
        heading[i + 2] = heading[i + 1] + STEP * (rate + STEP / T * (K * rudder[i] - rate))
    return STEP * np.arange(600), heading, rudder


def by_equation_13(heading, rudder, sign):
    """K and T by least squares on [K h^2/T, -h/T], the bracket psi(t+h) + sign psi(t)."""
    second = heading[2:] - 2.0 * heading[1:-1] + heading[:-2]
    bracket = heading[1:-1] + sign * heading[:-2]
    a, b = np.linalg.lstsq(np.column_stack([rudder[:-2], bracket]), second, rcond=None)[0]
    return -a / (b * STEP), -STEP / b


def test_equation_13_with_a_plus_depends_on_where_north_is():
    t, heading, rudder = zigzag()
    assert by_equation_13(heading, rudder, -1.0) == pytest.approx((K, T), rel=1e-9)
    turned = by_equation_13(heading + 1.0, rudder, -1.0)
    assert turned == pytest.approx((K, T), rel=1e-9)
    printed = [by_equation_13(heading + north, rudder, 1.0) for north in (0.0, 1.0)]
    assert all(abs(k / K - 1.0) > 1.0 and abs(x / T - 1.0) > 1.0 for k, x in printed)
    assert abs(printed[1][1] / printed[0][1] - 1.0) > 1.0
    fits = [
        nomoto.fit([Zigzag("z", t, heading + north, rudder)], 1, method="fd") for north in (0, 1)
    ]
    for fit in fits:
        assert (fit.value("K"), fit.value("T")) == pytest.approx((K, T), rel=1e-6)


def by_equation_16(rudder, sign, late):
    """psi(t) = psi(t-h) + (1 - h/T)[psi(t-h) - psi(t-2h)] + sign (K h^2/T) delta(t - late h)."""
    heading = np.zeros(len(rudder))
    for i in range(2, len(heading)):
        step = (1.0 - STEP / T) * (heading[i - 1] - heading[i - 2])
        heading[i] = heading[i - 1] + step + sign * K * STEP**2 / T * rudder[i - late]
    return heading


def test_equation_16_as_printed_turns_to_the_other_side_and_too_early():
    _, heading, rudder = zigzag()
    np.testing.assert_allclose(by_equation_16(rudder, 1.0, 2), heading, atol=1e-12)
    np.testing.assert_allclose(by_equation_16(rudder, -1.0, 2), -heading, atol=1e-12)
    early = by_equation_16(rudder, 1.0, 1)  # rudder of t - h: all comes one step before its time
    np.testing.assert_allclose(early[1:-1], heading[2:], atol=1e-12)


def test_equation_10_is_the_delay_of_the_heading():
    """A rudder that is put over makes the heading K delta (t - T): T is T1 + T2 - T3."""
    T1, T2, T3, delta = 5.0, 1.0, 2.0, 0.1
    t = np.arange(0.0, 100.0, 0.1)
    heading = np.empty(len(t))
    a0, a1, b0, b1 = 1.0 / (T1 * T2), 1.0 / T1 + 1.0 / T2, K / (T1 * T2), K * T3 / (T1 * T2)
    simulate_heading(
        2, a0, a1, b0, b1, 0.0, 0.0, t, np.full(len(t), delta), True, np.zeros(3), 0.05, heading
    )
    delay = t[-1] - heading[-1] / (K * delta)
    assert delay == pytest.approx(T1 + T2 - T3, abs=1e-6)
    assert abs(delay - (T1 + T2)) > 1.0
    # and what the transfer functions differ by vanishes with the square of the frequency
    s = 1j * np.array([1e-3, 1e-4])
    second = (1.0 + T3 * s) / ((1.0 + T1 * s) * (1.0 + T2 * s))
    right, printed = (abs(second - 1.0 / (1.0 + x * s)) for x in (T1 + T2 - T3, T1 + T2))
    assert right[0] / right[1] == pytest.approx(100.0, rel=0.01)
    assert printed[0] / printed[1] == pytest.approx(10.0, rel=0.01)


def equation_19(t, heading, literally=True):
    """Along the curve of each segment (its times and headings), and whether its sign was right.

    ``rho = -sign(t_{i+1} psi_i - t_i psi_{i+1})``; it ends at theta_end > 0 where its direction
    sigma + rho theta_end is the chord's, alpha, as it must to reach the next point. Otherwise the
    directions are those of the right curve, and only the printed sign is looked at.
    """
    sigma = np.arctan2(heading[1] - heading[0], t[1] - t[0])
    curves, right = [], []
    for i in range(1, len(t) - 1):
        dt, dy = t[i + 1] - t[i], heading[i + 1] - heading[i]
        alpha = np.arctan2(dy, dt)
        rho = -np.sign(t[i + 1] * heading[i] - t[i] * heading[i + 1])
        right.append(rho == np.sign(alpha - sigma))
        if not literally:
            rho = np.sign(alpha - sigma)
        end = (rho * (alpha - sigma)) % (2.0 * np.pi)
        theta = np.linspace(0.0, end, 200)
        reach = np.hypot(dt, dy) * theta / end
        angle = sigma + rho * theta
        curves.append((t[i] + reach * np.cos(angle), heading[i] + reach * np.sin(angle)))
        sigma = alpha + rho * np.arctan(end)
    return curves, np.array(right)


def test_equation_19_run_literally_goes_back_in_time():
    t, heading, _ = zigzag()
    t, heading = t[5:-2:5], heading[5:-2:5]
    curves, right = equation_19(t, heading)
    back = np.array([(np.diff(times) < 0.0).any() for times, _ in curves])
    assert back.mean() > 0.5 and (back | right).all()  # every wrong sign winds round the point
    # Along the right curve the printed sign is right by chance, and not at the same places when
    # the clock is set differently.
    smooth, first = equation_19(t, heading, literally=False)
    _, later = equation_19(t - 100.0, heading, literally=False)
    assert 0.3 < first.mean() < 0.7
    assert (first != later).mean() > 0.3
    # Ours has no such sign, and is a function of time.
    for times, headings in smooth:
        assert (np.diff(times) > 0.0).all()
        inside = spiral(t, heading, times)
        np.testing.assert_allclose(inside, headings, atol=1e-5)
    moved = spiral(t + 1e4, heading, t + 1e4)
    np.testing.assert_allclose(moved, spiral(t, heading, t), atol=1e-7)
