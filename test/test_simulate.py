"""The simulator against another integrator of other equations, and against closed solutions."""

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from bench import CONFIGS
from rov_ident import config
from rov_ident.core.errors import UserError
from rov_ident.model.equations import Model, RigidBody, build
from rov_ident.model.scales import authority
from rov_ident.simulation import open_loop as simulate
from rov_ident.simulation.manoeuvres import MANOEUVRES, manoeuvre
from rov_ident.simulation.open_loop import Guide, open_loop

Array = NDArray[np.float64]

HEAVY = config.load(Path(__file__).parent.parent / "config" / "bluerov2_heavy.yaml").model

# CG off the origin, products of inertia, off-diagonal added mass, terms of all kinds.
LOPSIDED = build(
    RigidBody(
        mass=13.5,
        weight=132.4,
        buoyancy=134.0,
        cog=np.array([0.02, -0.03, 0.04]),
        cob=np.array([-0.01, 0.02, -0.05]),
        inertia=np.array([[0.3, 0.02, -0.03], [0.02, 0.35, 0.01], [-0.03, 0.01, 0.4]]),
    ),
    {
        "X_udot": -6.0, "Y_vdot": -8.0, "Z_wdot": -18.0, "K_pdot": -0.2, "M_qdot": -0.15,
        "N_rdot": -0.2, "Y_rdot": 0.4, "Z_qdot": -0.5, "X_vdot": 1.0, "K_rdot": 0.03,
        "X_u": -14.0, "Y_v": -8.0, "Z_w": -30.0, "K_p": -0.3, "M_q": -0.8, "N_r": -0.4,
        "Y_r": 0.5, "N_v": -0.7, "X_uu": -140.0, "Y_vv": -210.0, "Z_ww": -190.0, "K_pp": -1.2,
        "M_qq": -0.5, "N_rr": -1.5, "X_rr": -0.6, "Y_uv": -12.0, "Y_v_abs_r": -9.0, "M_uw": 3.0,
    },
)  # fmt: skip


def S(a: Array) -> Array:
    """The cross product as a matrix: ``S(a) b = a x b``."""
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def rotation(angles: Array) -> Array:
    """Body -> world (3, 3) of roll, pitch and yaw, as the product of the three turns."""
    (c1, c2, c3), (s1, s2, s3) = np.cos(angles), np.sin(angles)
    roll = np.array([[1, 0, 0], [0, c1, -s1], [0, s1, c1]])
    pitch = np.array([[c2, 0, s2], [0, 1, 0], [-s2, 0, c2]])
    yaw = np.array([[c3, -s3, 0], [s3, c3, 0], [0, 0, 1]])
    return yaw @ pitch @ roll


def quaternion(angles: Array) -> Array:
    """w x y z (4,) of roll, pitch and yaw: half a turn about the axis z, then y, then x."""
    (c1, c2, c3), (s1, s2, s3) = np.cos(angles / 2), np.sin(angles / 2)
    return np.array(
        [
            c1 * c2 * c3 + s1 * s2 * s3,
            s1 * c2 * c3 - c1 * s2 * s3,
            c1 * s2 * c3 + s1 * c2 * s3,
            c1 * c2 * s3 - s1 * s2 * c3,
        ]
    )


def matrix_of(q: Array) -> Array:
    """Body -> world (3, 3) of a unit quaternion: ``I + 2 w S + 2 S S``."""
    return np.eye(3) + 2.0 * q[0] * S(q[1:]) + 2.0 * S(q[1:]) @ S(q[1:])


def textbook_rate(model: Model) -> Callable[[float, Array, Array, Array], Array]:
    """d/dt of (position, roll, pitch, yaw, nu) (12,), in Euler angles and written out by name."""
    body, k = model.body, dict(zip(model.names, model.theta))
    r_g, r_b = body.cog, body.cob
    M = np.block(
        [
            [body.mass * np.eye(3), -body.mass * S(r_g)],
            [body.mass * S(r_g), body.inertia - body.mass * S(r_g) @ S(r_g)],
        ]
    )
    for name in [n for n in k if n.endswith("dot")]:
        i, j = "XYZKMN".index(name[0]), "uvwpqr".index(name[2])
        M[i, j] -= k[name]
        if i != j:
            M[j, i] -= k[name]
    inverse = np.linalg.inv(M)

    def get(name: str) -> float:
        return k.get(name, 0.0)

    def rate(t: float, state: Array, constant: Array, slope: Array) -> Array:
        tau = constant + t * slope
        angles, v, w = state[3:6], state[6:9], state[9:12]
        (phi, theta, _), (p, q, r) = angles, w
        turn = np.array(
            [
                p + (q * np.sin(phi) + r * np.cos(phi)) * np.tan(theta),
                q * np.cos(phi) - r * np.sin(phi),
                (q * np.sin(phi) + r * np.cos(phi)) / np.cos(theta),
            ]
        )
        R = rotation(angles)
        down = R.T @ [0.0, 0.0, 1.0]
        momentum = M @ state[6:]
        force = -np.cross(w, momentum[:3]) + (body.weight - body.buoyancy) * down
        moment = -np.cross(w, momentum[3:]) - np.cross(v, momentum[:3])
        moment = moment + np.cross(r_g, body.weight * down) - np.cross(r_b, body.buoyancy * down)
        nu, drag = state[6:], np.zeros(6)
        for i, (a, b) in enumerate(zip("XYZKMN", "uvwpqr")):
            drag[i] = get(f"{a}_{b}") * nu[i] + get(f"{a}_{b}{b}") * abs(nu[i]) * nu[i]
        drag[0] += get("X_rr") * r**2
        drag[1] += get("Y_r") * r + get("Y_uv") * v[0] * v[1] + get("Y_v_abs_r") * v[1] * abs(r)
        drag[4] += get("M_uw") * v[0] * v[2]
        drag[5] += get("N_v") * v[1]
        nu_dot = inverse @ (tau + np.concatenate([force, moment]) + drag)
        return np.concatenate([R @ v, turn, nu_dot])

    return rate


def reference(
    model: Model, t: Array, wrench: Array, start: Array, slope: Array | None = None
) -> Array:
    """(N, 12) by an adaptive integrator of order 8, begun anew wherever the wrench may jump."""
    states = [start]
    rate = textbook_rate(model)
    slopes = np.zeros_like(wrench) if slope is None else slope
    for (now, then), tau, rise in zip(itertools.pairwise(t), wrench, slopes):
        solution = solve_ivp(
            rate,
            (now, then),
            states[-1],
            "DOP853",
            args=(tau - 0.5 * (now + then) * rise, rise),
            rtol=1e-11,
            atol=1e-12,
        )
        states.append(solution.y[:, -1])
    return np.array(states)


START = np.array([3.0, -2.0, 5.0, 0.3, -0.2, 2.5, 0.4, -0.3, 0.2, 0.5, -0.4, 0.6])


def deviation(model: Model, start: Array, t: Array, wrench: Array) -> tuple[float, float, float]:
    """Largest difference of position [m], rotation matrix and velocities to the reference."""
    run = simulate.simulate(model, t, wrench, start[6:], start[:3], quaternion(start[3:6]))
    expected = reference(model, t, wrench, start)
    turn = [matrix_of(q) - rotation(angles) for q, angles in zip(run.orientation, expected[:, 3:6])]
    return (
        np.max(np.abs(run.position - expected[:, :3])),
        np.max(np.abs(turn)),
        np.max(np.abs(run.nu - expected[:, 6:])),
    )


def pushes(model: Model, n: int, seed: int) -> Array:
    """Wrenches (n, 6) that change at every instant."""
    return authority(model) * np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 6))


# ------------------------------------------------------------------ against another integrator


@pytest.mark.parametrize("model", [HEAVY, LOPSIDED], ids=["heavy", "lopsided"])
def test_fine_steps_agree_with_an_adaptive_integrator(model, monkeypatch):
    monkeypatch.setattr(simulate, "MAX_STEP", 0.001)
    t = np.arange(0.0, 3.01, 0.25)
    assert max(deviation(model, START, t, pushes(model, len(t), 1))) < 2e-9


@pytest.mark.parametrize("seed", [0, 1])
def test_the_usual_step_is_far_below_the_noise_of_any_sensor(seed):
    """The errors come from the corners of ``|u| u``, where the velocity changes its sign."""
    t = np.arange(0.0, 8.01, 0.1)
    wrench = manoeuvre("steps", HEAVY, t, np.random.default_rng(seed))
    run = simulate.simulate(HEAVY, t, wrench)
    error = np.abs(run.nu - reference(HEAVY, t, wrench, np.zeros(12))[:, 6:])
    assert np.max(error[:, :3]) < 1e-5  # m/s
    assert np.max(error[:, 3:]) < 5e-5  # rad/s


def test_instants_may_come_at_any_spacing(monkeypatch):
    monkeypatch.setattr(simulate, "MAX_STEP", 0.001)
    t = np.cumsum([0.0, 0.02, 0.02, 0.5, 0.1, 0.003, 1.0, 0.017])
    wrench = pushes(LOPSIDED, len(t), 3)
    assert max(deviation(LOPSIDED, START, t, wrench)) < 2e-9


def test_only_differences_of_time_matter():
    t = np.arange(0.0, 2.0, 0.05)
    wrench = pushes(LOPSIDED, len(t), 3)
    run = simulate.simulate(LOPSIDED, t, wrench, START[6:])
    later = simulate.simulate(LOPSIDED, t + 1.7e9, wrench, START[6:])
    # Seconds since 1970 are rounded to 2e-7 s, at up to 10 m/s2.
    np.testing.assert_allclose(later.nu, run.nu, atol=1e-5)


def test_error_falls_with_the_fourth_power_of_the_step(monkeypatch):
    """Smooth drag only: |u| u has a corner, and no method keeps its order across one."""
    terms = {"X_u": -10.0, "Y_v": -15.0, "Z_w": -20.0, "K_p": -0.5, "M_q": -0.6, "N_r": -0.7}
    model = build(LOPSIDED.body, terms | {"X_udot": -6.0, "Y_rdot": 0.4, "X_rr": -0.6})
    t = np.arange(0.0, 1.61, 0.16)
    wrench = pushes(model, len(t), 4)
    expected = reference(model, t, wrench, START)[:, 6:]
    errors = []
    for step in (0.04, 0.02, 0.01):
        monkeypatch.setattr(simulate, "MAX_STEP", step)
        run = simulate.simulate(model, t, wrench, START[6:], START[:3], quaternion(START[3:6]))
        errors.append(np.linalg.norm(run.nu - expected))
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(order, 4.0, atol=0.1)


def test_a_wrench_may_rise_within_an_interval(monkeypatch):
    """Linearly about its mean, as the samples of a measured wrench do."""
    monkeypatch.setattr(simulate, "MAX_STEP", 0.001)
    t = np.arange(0.0, 2.01, 0.25)
    wrench, slope = pushes(LOPSIDED, len(t), 7), 4.0 * pushes(LOPSIDED, len(t), 8)
    start = np.concatenate([np.zeros(6), START[6:]])
    run = simulate.simulate(LOPSIDED, t, wrench, START[6:], wrench_slope=slope)
    expected = reference(LOPSIDED, t, wrench, start, slope)
    np.testing.assert_allclose(run.nu, expected[:, 6:], rtol=0, atol=1e-8)
    np.testing.assert_allclose(run.position, expected[:, :3], rtol=0, atol=1e-8)


@pytest.mark.parametrize("free", [(0,), (0, 1, 5), (2, 3, 4), (5,)])
def test_guided_by_its_own_motion_the_free_components_move_as_before(free):
    """The couplings, inertia included, come from the components that follow the guide."""
    t = np.arange(0.0, 3.0, 0.005)
    wrench = manoeuvre("multisine", LOPSIDED, t, np.random.default_rng(3))
    run = simulate.simulate(LOPSIDED, t, wrench)
    mask = np.isin(np.arange(6), free)
    guide = Guide(mask, run.nu, run.orientation)
    guided = simulate.simulate(LOPSIDED, t, wrench, guide=guide)
    np.testing.assert_array_equal(guided.nu[:, ~mask], run.nu[:, ~mask])
    # Between instants the guide is a straight line: off by dt^2/8 of its second derivative.
    np.testing.assert_allclose(guided.nu[:, mask], run.nu[:, mask], rtol=0, atol=1e-4)
    alone = simulate.simulate(LOPSIDED, t, wrench, guide=Guide(mask, 0.0 * run.nu, run.orientation))
    assert np.max(np.abs(alone.nu[:, mask] - run.nu[:, mask])) > 0.02  # it did matter


def test_nu_dot_is_the_forward_dynamics_at_each_instant():
    t = np.linspace(0.0, 1.0, 11)
    wrench = pushes(LOPSIDED, len(t), 5)
    run = simulate.simulate(LOPSIDED, t, wrench, START[6:], orientation=quaternion(START[3:6]))
    for i in range(len(t)):
        down = matrix_of(run.orientation[i])[2]
        expected = LOPSIDED.acceleration(run.nu[i], wrench[i], down)
        np.testing.assert_allclose(run.nu_dot[i], expected, rtol=1e-11, atol=1e-11)


def test_start_is_the_first_row_and_defaults_to_rest_level_at_the_origin():
    run = simulate.simulate(LOPSIDED, np.array([0.0, 1.0]), np.zeros((2, 6)))
    first = np.concatenate([run.position[0], run.orientation[0], run.nu[0]])
    assert first.tolist() == [0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    q = quaternion(START[3:6])
    run = simulate.simulate(LOPSIDED, np.array([7.0]), np.zeros((1, 6)), START[6:], START[:3], q)
    np.testing.assert_array_equal(run.position, [START[:3]])
    np.testing.assert_array_equal(run.orientation, [q])
    np.testing.assert_array_equal(run.nu, [START[6:]])


def test_quaternion_stays_a_unit_one_however_long_it_tumbles():
    body = RigidBody(10.0, 0.0, 0.0, np.zeros(3), np.zeros(3), np.diag([0.2, 0.3, 0.4]))
    t = np.arange(0.0, 300.0, 0.1)
    run = simulate.simulate(
        build(body, {}), t, np.zeros((len(t), 6)), np.array([0.0, 0.0, 0.0, 1.0, 2.0, -3.0])
    )
    np.testing.assert_allclose(np.linalg.norm(run.orientation, axis=1), 1.0, rtol=0, atol=1e-15)


def test_nothing_writes_into_its_arguments():
    t, wrench, nu = np.linspace(0.0, 1.0, 5), pushes(LOPSIDED, 5, 6), START[6:].copy()
    position, orientation = START[:3].copy(), quaternion(START[3:6])
    before = [a.copy() for a in (t, wrench, nu, position, orientation, LOPSIDED.theta)]
    first = simulate.simulate(LOPSIDED, t, wrench, nu, position, orientation)
    second = simulate.simulate(LOPSIDED, t, wrench, nu, position, orientation)
    np.testing.assert_array_equal(first.nu, second.nu)
    for a, b in zip((t, wrench, nu, position, orientation, LOPSIDED.theta), before):
        np.testing.assert_array_equal(a, b)


# ------------------------------------------------------------------ closed solutions


def surge_model(linear: float, quadratic: float) -> Model:
    """Neutral and symmetric: along x nothing but mass and drag."""
    body = RigidBody(12.0, 100.0, 100.0, np.zeros(3), np.zeros(3), np.diag([0.2, 0.3, 0.4]))
    return build(body, {"X_udot": -6.0, "X_u": -linear, "X_uu": -quadratic})


MASS = 18.0  # kg, with the added mass


@pytest.mark.parametrize("thrust", [40.0, -40.0])
@pytest.mark.parametrize(("linear", "quadratic"), [(14.0, 141.0), (0.0, 58.4), (39.0, 0.0)])
def test_terminal_velocity_is_where_drag_equals_thrust(thrust, linear, quadratic):
    """The root of ``quadratic u^2 + linear u = |thrust|``."""
    t = np.arange(0.0, 30.0, 0.1)
    wrench = np.tile([thrust, 0.0, 0.0, 0.0, 0.0, 0.0], (len(t), 1))
    run = simulate.simulate(surge_model(linear, quadratic), t, wrench)
    speed = 2.0 * abs(thrust) / (linear + np.sqrt(linear**2 + 4.0 * quadratic * abs(thrust)))
    assert run.nu[-1, 0] == pytest.approx(np.sign(thrust) * speed, rel=1e-12)
    assert np.all(run.nu[:, 1:] == 0.0)


@pytest.mark.parametrize("start", [1.5, -1.5])
def test_coast_down_by_quadratic_drag(start):
    """``u = u0 / (1 + c |u0| t)`` and ``x = ln(1 + c |u0| t) / c``, with ``c = -X_uu / mass``."""
    t = np.arange(0.0, 20.0, 0.02)
    nu = np.array([start, 0.0, 0.0, 0.0, 0.0, 0.0])
    run = simulate.simulate(surge_model(0.0, 141.0), t, np.zeros((len(t), 6)), nu)
    c = 141.0 / MASS
    # Of the order of step^4: (0.02 s * 12/s)^4 / 100 at the beginning.
    np.testing.assert_allclose(run.nu[:, 0], start / (1.0 + c * abs(start) * t), rtol=2e-5)
    distance = np.sign(start) * np.log1p(c * abs(start) * t) / c
    np.testing.assert_allclose(run.position[:, 0], distance, atol=1e-5)


def test_coast_down_by_linear_drag():
    t = np.arange(0.0, 5.0, 0.02)
    nu = np.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    run = simulate.simulate(surge_model(14.0, 0.0), t, np.zeros((len(t), 6)), nu)
    np.testing.assert_allclose(run.nu[:, 0], 1.5 * np.exp(-14.0 / MASS * t), rtol=1e-8)


def test_rigid_body_in_empty_space_moves_straight_and_keeps_its_spin():
    """The CG goes straight on in the world and the angular momentum about it stays as it is."""
    inertia = np.array([[0.3, 0.02, -0.03], [0.02, 0.35, 0.01], [-0.03, 0.01, 0.4]])
    cog = np.array([0.1, -0.2, 0.15])
    model = build(RigidBody(10.0, 0.0, 0.0, cog, np.zeros(3), inertia), {})
    t = np.arange(0.0, 5.0, 0.005)
    run = simulate.simulate(model, t, np.zeros((len(t), 6)), START[6:], START[:3])
    turns = np.array([matrix_of(q) for q in run.orientation])
    path = run.position + turns @ cog
    velocity = START[6:9] + np.cross(START[9:], cog)
    np.testing.assert_allclose(path, path[0] + t[:, None] * velocity, atol=1e-8)
    spin = np.einsum("nij,jk,nk->ni", turns, inertia, run.nu[:, 3:])
    np.testing.assert_allclose(spin, np.tile(spin[0], (len(t), 1)), atol=1e-9)


def test_impulse_of_body_and_water_stays_in_the_world():
    """Kirchhoff: without weight, thrust and drag the linear and angular impulse are constant."""
    body = RigidBody(13.5, 0.0, 0.0, LOPSIDED.body.cog, LOPSIDED.body.cob, LOPSIDED.body.inertia)
    names = [name for name in LOPSIDED.names if name.endswith("dot")]
    model = build(body, {name: LOPSIDED.theta[LOPSIDED.names.index(name)] for name in names})
    t = np.arange(0.0, 5.0, 0.005)
    run = simulate.simulate(model, t, np.zeros((len(t), 6)), START[6:], START[:3])
    momentum = run.nu @ model.mass_matrix
    turns = np.array([matrix_of(q) for q in run.orientation])
    linear = np.einsum("nij,nj->ni", turns, momentum[:, :3])
    angular = np.einsum("nij,nj->ni", turns, momentum[:, 3:]) + np.cross(run.position, linear)
    np.testing.assert_allclose(linear, np.tile(linear[0], (len(t), 1)), atol=1e-7)
    np.testing.assert_allclose(angular, np.tile(angular[0], (len(t), 1)), atol=1e-7)


# ------------------------------------------------------------------ which way is up


def test_a_light_vehicle_rises_and_a_heavy_one_sinks():
    """Down is positive: in the world, and in the body of a level vehicle."""
    t = np.arange(0.0, 5.0, 0.1)
    for surplus in (1.6, -1.6):
        body = RigidBody(13.5, 132.4, 132.4 + surplus, np.zeros(3), np.zeros(3), 0.3 * np.eye(3))
        run = simulate.simulate(build(body, {"Z_w": -33.0}), t, np.zeros((len(t), 6)))
        assert run.nu[-1, 2] == pytest.approx(-surplus / 33.0, rel=1e-3)
        assert np.sign(run.position[-1, 2]) == -np.sign(surplus)
        assert np.all(run.position[:, :2] == 0.0)


@pytest.mark.parametrize("angles", [(1.0, 0.0, 0.3), (0.0, -1.0, 2.0), (-0.7, 0.8, -2.0)])
def test_buoyancy_above_the_weight_rights_the_vehicle(angles):
    t = np.arange(0.0, 60.0, 0.1)
    assert HEAVY.body.cob[2] < HEAVY.body.cog[2]
    start = quaternion(np.array(angles))
    run = simulate.simulate(HEAVY, t, np.zeros((len(t), 6)), orientation=start)
    upright = np.array([matrix_of(q)[2, 2] for q in run.orientation])
    assert upright[-1] > 0.999 > upright[0]


def test_buoyancy_below_the_weight_turns_it_over():
    body = HEAVY.body
    upset = RigidBody(body.mass, body.weight, body.weight, body.cog, -body.cob, body.inertia)
    model = build(upset, dict(zip(HEAVY.names, HEAVY.theta)))
    t = np.arange(0.0, 60.0, 0.1)
    start = quaternion(np.array([0.05, 0.0, 0.0]))
    run = simulate.simulate(model, t, np.zeros((len(t), 6)), orientation=start)
    assert matrix_of(run.orientation[-1])[2, 2] < -0.99


def test_thrust_and_turn_go_where_the_axes_say():
    """Ahead when heading east is east; a positive yaw moment turns from north to east."""
    t = np.arange(0.0, 2.0, 0.1)
    ahead = np.tile([20.0, 0, 0, 0, 0, 0], (len(t), 1))
    east = quaternion(np.array([0.0, 0.0, np.pi / 2]))
    run = simulate.simulate(surge_model(14.0, 141.0), t, ahead, orientation=east)
    assert run.position[-1, 1] > 0.1
    assert abs(run.position[-1, 0]) < 1e-12
    turning = np.tile([0, 0, 0, 0, 0, 0.1], (len(t), 1))
    run = simulate.simulate(surge_model(14.0, 141.0), t, turning)
    nose = matrix_of(run.orientation[-1])[:, 0]
    assert nose[1] > 0.1
    assert nose[2] == 0.0


# ------------------------------------------------------------------ models that no vehicle has


def test_a_diverging_model_is_named_with_the_time():
    """A drag that drives: the speed is infinite before 0.2 s, ``mass / (X_uu u0)``."""
    wrong = surge_model(0.0, 1.0).with_values({"X_uu": 90.0})
    t = np.arange(0.0, 10.0, 0.1)
    message = r"diverges (\d\.\d) s after its start: check the signs and sizes of the coefficients"
    with pytest.raises(UserError, match=message) as error:
        simulate.simulate(wrong, t + 50.0, np.zeros((len(t), 6)), np.array([1.0, 0, 0, 0, 0, 0]))
    assert 0.2 <= float(str(error.value).split("diverges ")[1].split()[0]) < 1.0


def test_open_loop_starts_every_window_from_what_was_measured():
    t = 100.0 + np.arange(0.0, 10.0, 0.05)
    wrench = manoeuvre("multisine", HEAVY, t, np.random.default_rng(1))
    run = simulate.simulate(HEAVY, t, wrench)
    # Of its own motion the model predicts all; measured with an error, it starts with the error.
    predicted = open_loop(HEAVY, t, wrench, run.nu, run.orientation, 3.0)
    np.testing.assert_allclose(predicted, run.nu, rtol=0, atol=1e-9)
    predicted = open_loop(HEAVY, t, wrench, run.nu + 0.1, run.orientation, 3.0)
    error = predicted - run.nu
    starts = np.flatnonzero(np.all(np.abs(error - 0.1) < 1e-12, axis=1))
    np.testing.assert_allclose(t[starts] - 100.0, [0.0, 3.0, 6.0, 9.0], atol=0.06)
    assert np.all(np.abs(error[starts[1:] - 1, 0]) < 0.05)  # forgotten at the end of a window


def test_open_loop_goes_on_after_a_window_that_diverges():
    wrong = surge_model(0.0, 1.0).with_values({"X_uu": 90.0})
    t = np.arange(0.0, 4.0, 0.1)
    nu, level = np.zeros((len(t), 6)), np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    nu[20, 0] = 1.0  # the start of the second window
    predicted = open_loop(wrong, t, np.zeros((len(t), 6)), nu, level, 2.0)
    assert np.all(predicted[:20] == 0.0)
    assert np.all(np.isinf(predicted[20:]))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
@pytest.mark.parametrize("name", MANOEUVRES)
def test_shipped_vehicles_survive_every_manoeuvre(path, name):
    """Finite, and at speeds (m/s, rad/s) that a vehicle of the kind may have."""
    model = config.load(path).model
    t = np.arange(0.0, 60.0, 0.1)
    wrench = manoeuvre(name, model, t, np.random.default_rng(2))
    assert wrench.shape == (len(t), 6)
    run = simulate.simulate(model, t, wrench)
    assert np.all(np.abs(run.nu) < 6.0)


def test_an_unknown_manoeuvre_is_named_with_those_there_are():
    with pytest.raises(UserError, match="no manoeuvre 'zigzag': choose one of steps, multisine"):
        manoeuvre("zigzag", HEAVY, np.arange(3.0), np.random.default_rng(0))
