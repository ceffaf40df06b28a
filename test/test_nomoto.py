"""Nomoto's model: what the estimators find, at which rates, and what densifying does."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from test_bags import write_ros1
from test_inputs import twist_and_pose, with_twist
from test_inputs import write as write_rows
from tiers import more

from bench import DATA, ROOT
from rov_ident import config
from rov_ident.cli.program import main
from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_from_euler
from rov_ident.core.messages import Odometry
from rov_ident.io.bag_writer import BagWriter
from rov_ident.io.cdr import ODOMETRY_TYPE, encode
from rov_ident.model.equations import build
from rov_ident.steering import autopilot, nomoto, nomoto_equation_error, nomoto_model
from rov_ident.steering.heading_interpolation import densify, spiral
from rov_ident.steering.zigzag import Zigzag, read

KVLCC2 = DATA / "kvlcc2-model"
FINE = 0.01  # s


def simulated(K, T, rate, n3=0.0, T2=0.0, T3=0.0, duration=100.0, rudder=0.26, noise=0.0, seed=0):
    """A zigzag of the model itself, rudder and switching at FINE, its rudder linear in between.

    Integrated step by step with the exact transition where it is linear.
    """
    n = round(duration / FINE) + 1
    heading, delta = np.zeros(n), np.zeros(n)
    side, last, x = 1.0, 0.0, np.zeros(2)
    for i in range(n - 1):
        if abs(heading[i]) >= rudder and np.sign(heading[i]) != last:
            side, last = -side, np.sign(heading[i])
        wanted = side * rudder if i * FINE >= 2.0 else 0.0
        step = wanted - delta[i]
        delta[i + 1] = delta[i] + (
            step if rate is None else np.clip(step, -rate * FINE, rate * FINE)
        )
        if rate is None:  # the jump is at the instant i
            delta[i] = delta[i + 1]
        slope = (delta[i + 1] - delta[i]) / FINE

        def motion(t, y, i=i, slope=slope):
            d = delta[i] + slope * t
            if T2 == 0.0:
                return [y[1], (K * d - y[1] - n3 * y[1] ** 3) / T, 0.0]
            rest = K * d + K * T3 * slope - y[1] - n3 * y[1] ** 3 - (T + T2) * y[2]
            return [y[1], y[2], rest / (T * T2)]

        # classical Runge-Kutta, written here a second time
        y = np.array([heading[i], *x])
        a = np.array(motion(0.0, y))
        b = np.array(motion(0.5 * FINE, y + 0.5 * FINE * a))
        c = np.array(motion(0.5 * FINE, y + 0.5 * FINE * b))
        d = np.array(motion(FINE, y + FINE * c))
        y = y + FINE / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        heading[i + 1], x = y[0], y[1:]
    t = FINE * np.arange(n)
    noisy = heading + noise * np.random.default_rng(seed).standard_normal(n)
    return Zigzag("simulated", t, noisy, delta)


def every(run, step):
    k = round(step / (run.t[1] - run.t[0]))
    return Zigzag(run.name, run.t[::k], run.heading[::k], run.rudder[::k], run.unit)


def blanked(run, step):
    """Headings every ``step`` only, all of the rudder."""
    k = round(step / (run.t[1] - run.t[0]))
    rows = np.arange(len(run.t)) % k == 0
    return Zigzag(run.name, run.t, np.where(rows, run.heading, np.nan), run.rudder)


# ------------------------------------------------------------------ on data of the model


@pytest.mark.parametrize(
    "K, T, rate",
    [
        (-0.92, 0.95, None),
        (0.3, 4.0, np.radians(20.0)),
        (-0.92, 0.95, np.radians(5.0)),
        *more((0.3, 4.0, None), (-0.92, 0.95, np.radians(20.0)), (0.3, 4.0, np.radians(5.0))),
    ],
)
def test_output_error_finds_k_and_t_at_every_rate(K, T, rate):
    run = simulated(K, T, rate)
    for step in (0.1, 0.2, 0.5):
        model = nomoto.fit([every(run, step)])
        assert model.value("K") == pytest.approx(K, rel=0.01)
        assert model.value("T") == pytest.approx(T, rel=0.01)


def test_second_order():
    run = simulated(0.4, 5.0, 0.1, T2=1.0, T3=2.0)
    model = nomoto.fit([every(run, 0.1)], order=2)
    for name, truth in (("K", 0.4), ("T1", 5.0), ("T2", 1.0), ("T3", 2.0), ("T", 4.0)):
        assert model.value(name) == pytest.approx(truth, rel=0.01), name


def test_norrbin():
    run = simulated(0.4, 5.0, 0.1, n3=80.0)
    model = nomoto.fit([every(run, 0.1)], nonlinear=True)
    for name, truth in (("K", 0.4), ("T", 5.0), ("n3", 80.0)):
        assert model.value(name) == pytest.approx(truth, rel=0.01), name


def test_norrbin_of_an_unstable_vehicle():
    """T and K negative: the inner form of the model does not mind."""
    run = simulated(-0.3, -15.0, 0.1, n3=-1500.0, rudder=0.17, duration=200.0)
    model = nomoto.fit([every(run, 0.2)], nonlinear=True)
    assert model.value("T") == pytest.approx(-15.0, rel=0.02)
    assert model.value("K") == pytest.approx(-0.3, rel=0.02)
    assert model.stable is False and "no course stability" in model.notes[0]


@pytest.mark.parametrize("order, lags", [(1, {}), (2, {"T2": 1.0, "T3": 2.0})])
def test_the_data_choose_the_order(order, lags):
    run = every(simulated(0.4, 5.0, 0.1, noise=1e-3, seed=4, **lags), 0.2)
    model = nomoto.fit([run], "auto")
    assert model.order == order
    first, second = model.cross_validation[1], model.cross_validation[2]
    assert (second < 0.5 * first) == (order == 2)


def test_the_second_order_must_be_worth_its_parameters():
    """Of a first-order vehicle: the error of this run is less by more than a standard error."""
    run = simulated(0.4, 5.0, 0.1, noise=1e-3, seed=0, duration=60.0)
    assert nomoto.fit([every(run, 0.2)], "auto").order == 1


def test_the_second_order_is_not_chosen_for_a_response_slower_than_the_run():
    """Of this first-order vehicle it predicts the parts left out better, with K = 0.046 for 0.3."""
    run = every(simulated(0.3, 4.0, np.radians(20.0), duration=20.0), 0.1)
    noise = 0.002 * np.random.default_rng(14).normal(size=len(run.t))
    assert nomoto.fit([replace(run, heading=run.heading + noise)], "auto").order == 1


def test_a_response_slower_than_the_run_is_said():
    slow = every(simulated(0.3, 400.0, 0.1, duration=40.0), 0.2)
    assert any("slower than the longest run (40 s)" in note for note in nomoto.fit([slow]).notes)


def test_a_heading_that_answers_late_is_said():
    """An all-pass, which a dead time looks like, and no rudder."""
    run = every(simulated(0.3, 4.0, 0.2, noise=1e-3), 0.1)
    late = replace(run, heading=np.interp(run.t - 0.6, run.t, run.heading))
    (note,) = (n for n in nomoto.fit([late], 2).notes if n.startswith("T3 is negative"))
    assert "answers some 0.6" in note


def test_a_cubic_term_that_helps_the_turn_is_not_fitted():
    """Its model would run away as soon as a manoeuvre is faster than those fitted."""
    model = nomoto.fit([every(simulated(0.3, 4.0, 0.1, n3=-5.0), 0.2)], nonlinear=True)
    assert model.value("n3") == pytest.approx(0.0, abs=1e-9)
    assert any("held at zero" in note for note in model.notes)


def test_stability_is_said():
    stable = every(simulated(0.3, 4.0, 0.2), 0.2)
    model = nomoto.fit([stable])
    assert model.stable is True and model.growth == pytest.approx(-0.25, rel=0.01)
    assert "course-stable" in model.notes[0] and "4 s" in model.notes[0]
    noise = 0.5 * np.random.default_rng(0).standard_normal(len(stable.t))
    open_question = nomoto.fit([replace(stable, heading=stable.heading + noise)], order=2)
    assert open_question.stable is None and "leave open" in open_question.notes[0]


def test_unscented_filter():
    run = every(simulated(0.3, 4.0, 0.2, noise=3e-3, seed=1), 0.2)
    model = nomoto.fit([run], method="ukf")
    for name, truth in (("K", 0.3), ("T", 4.0)):
        entry = model.entries()[name]
        assert entry["value"] == pytest.approx(truth, rel=0.01)
        assert abs(entry["value"] - truth) < 3.0 * entry["std"] < 0.02 * truth


def test_instruments_cure_what_noise_does_to_differences():
    run = simulated(0.3, 4.0, 0.2, noise=1e-4, seed=1)
    dense = every(run, 0.1)
    least, instruments = (nomoto.fit([dense], method=m) for m in ("fd", "iv"))
    clean = nomoto.fit([every(simulated(0.3, 4.0, 0.2), 0.1)], method="fd")
    assert abs(least.value("T") / clean.value("T") - 1.0) > 0.05
    assert abs(instruments.value("T") / clean.value("T") - 1.0) < 0.03


def test_what_the_intervals_do_not_contain_is_said():
    run = every(simulated(0.3, 4.0, 0.2, noise=0.003), 0.1)
    late = replace(run, heading=np.interp(run.t - 0.6, run.t, run.heading))
    late = replace(
        late, heading=late.heading + 0.003 * np.random.default_rng(1).normal(size=len(run.t))
    )
    assert len(nomoto.fit([run]).notes) == 1  # of stability
    assert any("no white noise" in note for note in nomoto.fit([late]).notes)
    assert any("biases fd" in note for note in nomoto.fit([run], method="fd").notes)


def test_only_what_was_not_tried_is_advised():
    run = every(simulated(0.3, 4.0, 0.2, noise=0.003), 0.1)
    swaying = replace(run, heading=run.heading + 0.02 * np.sin(0.9 * run.t))  # by waves
    for options, advice in (
        ({"order": 1}, "try --order 2 and --nonlinear, and check"),
        ({"order": 1, "nonlinear": True}, "try --order 2, and check"),
        ({"order": 2}, "try --nonlinear, and check"),
        ({"order": "auto"}, "try --nonlinear, and check"),  # which has tried both orders
        ({"order": 2, "nonlinear": True}, "intervals; check"),
    ):
        (note,) = (n for n in nomoto.fit([swaying], **options).notes if "no white noise" in n)
        assert advice in note


def test_recursive_follows_a_change():
    """A vehicle whose K doubles half-way: with forgetting the last estimate is the new one."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(600, 2))
    truth = np.where(np.arange(600)[:, None] < 300, [1.0, -2.0], [2.0, -2.0])
    y = np.sum(x * truth, axis=1) + 0.01 * rng.normal(size=600)
    history = nomoto_equation_error.recursive(y, x)
    np.testing.assert_allclose(history[290], [1.0, -2.0], atol=0.01)
    np.testing.assert_allclose(history[-1], [2.0, -2.0], atol=0.02)
    stubborn = nomoto_equation_error.recursive(y, x, lowest=1.0)
    assert abs(stubborn[-1, 0] - 2.0) > 0.2


def test_recursive_does_not_wind_up():
    """Without excitation the gain must not grow: the first new row is not swallowed whole."""
    rng = np.random.default_rng(0)
    x = np.zeros((20200, 2))
    x[:200], x[-1] = rng.normal(size=(200, 2)), [1.0, 1.0]
    y = x @ [1.0, -2.0] + 0.1 * rng.normal(size=len(x))
    y[-1] = -1.0 + 0.3
    history = nomoto_equation_error.recursive(y, x)
    assert np.abs(history[-1] - history[-2]).max() < 0.15


def test_standard_deviations_are_honest_under_coloured_noise():
    """Over seeds with slowly wandering heading noise the 95 % intervals hold the truth."""
    clean = every(simulated(0.3, 4.0, 0.2, duration=150.0), 0.5)
    rng = np.random.default_rng(3)
    inside, naive = [], []
    for _ in range(40):
        wander = np.zeros(len(clean.t))
        for i in range(1, len(wander)):
            wander[i] = 0.9 * wander[i - 1] + 0.004 * rng.standard_normal()
        run = Zigzag("x", clean.t, clean.heading + wander, clean.rudder)
        model = nomoto.fit([run])
        for name, truth in (("K", 0.3), ("T", 4.0)):
            entry = model.entries()[name]
            inside.append(entry["lower"] < truth < entry["upper"])
            naive.append(abs(entry["value"] - truth) / entry["std"])
    assert np.mean(inside) >= 0.85
    assert np.sqrt(np.mean(np.square(naive))) > 0.5  # nor far too wide


def test_simulation_is_that_of_the_equations():
    """The kernel beside scipy's integrator, second order with everything in it."""
    t = np.linspace(0.0, 20.0, 201)
    run = Zigzag("x", t, np.zeros(201), 0.3 * np.sin(0.7 * t))
    theta = np.array([0.2, 1.2, 0.06, 0.1, 3.0, 0.02])  # a0 a1 b0 b1 c delta_0
    first = np.array([0.1, 0.05, 0.01])

    def motion(s, y):
        d = np.interp(s, t, run.rudder) - 0.02
        return [y[1], -1.2 * y[1] + y[2] + 0.1 * d, -0.2 * y[1] - 3.0 * y[1] ** 3 + 0.06 * d]

    expected = solve_ivp(motion, (0.0, 20.0), first, t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.1)
    found = nomoto_model.respond(nomoto_model.Structure(2, True), theta, run, first)
    np.testing.assert_allclose(found, expected.y[0], atol=1e-6)


def test_corners_of_a_sampled_rudder_are_found_again():
    run = simulated(0.3, 4.0, 0.2)
    sparse = every(run, 0.5).cornered()
    error = np.interp(run.t, sparse.t, sparse.rudder) - run.rudder
    cut = np.interp(run.t, run.t[::50], run.rudder[::50]) - run.rudder
    assert np.abs(cut).max() > 0.015 and np.abs(error).max() < 0.003
    assert np.isnan(sparse.heading).sum() == len(sparse.t) - len(run.t[::50]) > 10
    smooth = Zigzag("x", run.t, run.heading, np.sin(run.t))  # no levels, no corners
    assert smooth.cornered() is smooth


# ------------------------------------------------------------------ densification


def test_spiral_joins_the_samples_and_starts_along_the_last():
    t = np.arange(0.0, 10.0, 0.5)
    heading = 0.3 * np.sin(t)
    fine = np.arange(0.0, 9.5, 0.01)
    dense = spiral(t, heading, fine)
    np.testing.assert_allclose(dense[::50], heading[:19], atol=1e-9)
    assert np.abs(dense - 0.3 * np.sin(fine)).max() < 0.02
    # straight data: straight curve
    np.testing.assert_allclose(spiral(t, 0.2 * t, fine), 0.2 * fine, atol=1e-12)


def test_spiral_does_not_care_where_time_starts():
    """The printed sign of rho does: half of its segments fold back."""
    t = np.arange(0.0, 10.0, 0.5)
    fine = np.arange(0.0, 9.5, 0.1)
    here = spiral(t, 0.3 * np.sin(t), fine)
    there = spiral(t + 1e4, 0.3 * np.sin(t), fine + 1e4)
    np.testing.assert_allclose(there, here, atol=1e-7)


def test_spiral_depends_on_the_units_of_its_plane():
    t = np.arange(0.0, 10.0, 0.5)
    fine = np.arange(0.0, 9.5, 0.1)
    rad, deg = (spiral(t, 0.3 * np.sin(t), fine, s) for s in (1.0, 180.0 / np.pi))
    assert np.abs(rad - deg).max() > 1e-3


@pytest.fixture(scope="module")
def remus():
    """The REMUS 100's zigzag of 15 deg at 0.02 s."""
    model = config.load(ROOT / "config" / "remus100.yaml").model
    return autopilot.manoeuvre(model, "zigzag", np.radians(15.0)).zigzag()


def test_sparse_remus_densified_as_good_as_dense(remus):
    """0.5 s headings, rudder at 0.1 s: K within 1.5 %, T within 3 % of the dense data's own fit,
    heading within 1.1 x of the best first-order fit to the dense data."""
    dense = every(remus, 0.1)
    sparse = blanked(dense, 0.5)
    best = nomoto.fit([dense])
    for method in ("oe", "fd"):
        own = nomoto.fit([dense], method=method)
        model = nomoto.fit([sparse], method=method, interpolate="spline")
        assert model.value("K") == pytest.approx(own.value("K"), rel=0.015)
        assert model.value("T") == pytest.approx(own.value("T"), rel=0.03)
    model = nomoto.fit([sparse], interpolate="spline")
    assert nomoto_model.predict(model, dense)[1] <= 1.1 * best.rmse
    # without densifying, differences over 0.5 s are far off
    own, raw = nomoto.fit([dense], method="fd"), nomoto.fit([every(remus, 0.5)], method="fd")
    assert abs(raw.value("T") / own.value("T") - 1.0) > 0.2


def test_spline_is_closer_to_the_dense_data_than_the_spiral(remus):
    dense = every(remus, 0.1)
    error = {
        method: np.sqrt(np.mean((densify(dense.t[::5], dense.heading[::5], dense.t, method)
                                 - dense.heading)[:-5] ** 2))
        for method in ("none", "spline", "spiral")
    }  # fmt: skip
    assert error["spline"] < error["spiral"] < error["none"]


def test_k_is_reported_with_the_sign_of_the_data(remus):
    """Prestero's N_uudr is negative: a positive rudder turns to port."""
    dense = every(remus, 0.2)
    assert nomoto.fit([dense]).value("K") < 0.0
    turned = Zigzag("x", dense.t, dense.heading, -dense.rudder)
    assert nomoto.fit([turned]).value("K") == pytest.approx(-nomoto.fit([dense]).value("K"))


def stable(remus_config):
    """A REMUS with linear damping instead of its cross-flow drag, and without rolling in turns."""
    model = remus_config.model
    body = replace(model.body, cog=np.zeros(3))
    values = dict(zip(model.names, model.theta)) | model.fins | {"Y_v": -60.0, "N_r": -15.0}
    for name in ("Y_vv", "N_rr", "Y_rr", "N_vv"):
        del values[name]
    return build(body, values)


def linearised(model, speed):
    """The second-order model of the equations of motion for small motions at ``speed`` [m/s].

    Sway and yaw alone, ``M (v', r') = A (v, r) + B delta``; eliminating v gives, with
    ``F = M^-1 A``, ``G = M^-1 B``: ``a0 = det F, a1 = -tr F, b1 = G_2, b0 = F_21 G_1 - F_11 G_2``.
    """
    down, still = np.array([0.0, 0.0, 1.0]), np.zeros(6)
    rows = np.array([1, 5])
    f = np.empty((2, 2))
    inverse = np.linalg.inv(model.mass_matrix[np.ix_(rows, rows)])
    for i, row in enumerate(rows):
        ends = []
        for side in (-1e-6, 1e-6):
            nu = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
            nu[row] = side
            ends.append(-inverse @ model.wrench(nu, still, down)[rows])
        f[:, i] = (ends[1] - ends[0]) / 2e-6
    rudder = np.array([0.0, 1.0, 0.0, 0.0])
    g = inverse @ model.input_wrench(np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0]), rudder)[rows]
    b0 = f[1, 0] * g[0] - f[0, 0] * g[1]
    theta = np.array([np.linalg.det(f), -np.trace(f), b0, g[1], 0.0])
    return nomoto_model.model_of(
        nomoto_model.Structure(2), "linearised", theta, np.zeros((5, 5)), "rad", 0.0
    )


def test_linearised_equations_of_motion():
    """Nomoto's constants from the model, beside the formulas of the literature and a zigzag."""
    model = stable(config.load(ROOT / "config" / "remus100.yaml"))
    of_model = linearised(model, 1.5)
    found = dict(zip(of_model.names, of_model.values))
    # eliminated by hand (couplings Y_rdot, N_vdot kept)
    c, u = dict(zip(model.names, model.theta)) | model.fins, 1.5
    mass = model.mass_matrix
    m22, m26, m66 = mass[1, 1], mass[1, 5], mass[5, 5]
    y_v, n_r = c["Y_uv"] * u + c["Y_v"], c["N_ur"] * u + c["N_r"] - (-c["Y_rdot"]) * u
    y_r = c["Y_ur"] * u - (model.body.mass - c["X_udot"]) * u
    n_v = c["N_uv"] * u - (c["X_udot"] - c["Y_vdot"]) * u
    y_d, n_d = c["Y_uudr"] * u**2, c["N_uudr"] * u**2
    det = y_v * n_r - y_r * n_v
    assert found["K"] == pytest.approx((n_v * y_d - y_v * n_d) / det, rel=1e-6)
    assert found["T1T2"] == pytest.approx((m22 * m66 - m26**2) / det, rel=1e-6)
    total = -(m22 * n_r + m66 * y_v - m26 * (y_r + n_v)) / det
    assert found["T1_plus_T2"] == pytest.approx(total, rel=1e-6)
    t3 = (m22 * n_d - m26 * y_d) / (n_v * y_d - y_v * n_d)
    assert found["T3"] == pytest.approx(t3, rel=1e-6)
    # so small that cross-flow drag and the loss of speed do not matter
    run = autopilot.manoeuvre(model, "zigzag", np.radians(0.1), duration=60.0).zigzag()
    fitted = nomoto.fit([run], order=2)
    for name, near in (("K", 0.03), ("T1", 0.03), ("T2", 0.1), ("T3", 0.1)):
        assert fitted.value(name) == pytest.approx(found[name], rel=near), name


def test_second_order_is_never_worse_than_first(remus):
    for run in (every(remus, 0.1), every(remus, 0.5)):
        assert nomoto.fit([run], order=2).rmse <= nomoto.fit([run]).rmse


# ------------------------------------------------------------------ measured zigzags


@pytest.mark.skipif(not KVLCC2.is_dir(), reason="the measured zigzags are not here")
@pytest.mark.parametrize("fitted, judged, limit", [((10, 25), 20, 2.5), *more(((10, 20), 25, 3.0))])
@pytest.mark.parametrize("order", [1, 2])
def test_measured_zigzags_are_predicted(fitted, judged, limit, order):
    runs = {a: read(KVLCC2 / f"hsva_Z_{a}_05.csv") for a in (10, 20, 25)}
    model = nomoto.fit([runs[a] for a in fitted], order, nonlinear=True)
    assert np.degrees(nomoto_model.predict(model, runs[judged])[1]) < limit


@pytest.mark.skipif(not KVLCC2.is_dir(), reason="the measured zigzags are not here")
@pytest.mark.parametrize("nonlinear", [*more(False), True])
@pytest.mark.parametrize("fitted", ["10_05", *more("20_05", "25_05")])
def test_measured_zigzags_choose_the_second_order(fitted, nonlinear):
    """An unstable ship, and K of one sign, whichever run is fitted; with the cubic term, too,
    the smallest zigzag is predicted."""
    model = nomoto.fit([read(KVLCC2 / f"hsva_Z_{fitted}.csv")], "auto", nonlinear)
    assert model.order == 2 and model.value("K") > 0.0 and model.stable is not True
    assert model.cross_validation[2] < 0.8 * model.cross_validation[1] < np.radians(2.1)
    small = read(KVLCC2 / "hsva_Z_10_01.csv")
    assert np.degrees(nomoto_model.predict(model, small)[1]) < 2.5


# ------------------------------------------------------------------ files


def write(path, run, heading="heading_deg", rudder="rudder_deg", extra=""):
    factor = [180.0 / np.pi if name.endswith("_deg") else 1.0 for name in (heading, rudder)]
    lines = ["# a zigzag", f"t_s,{heading},{rudder},other"]
    for t, h, d in zip(run.t, run.heading, run.rudder):
        first = "" if np.isnan(h) else f"{factor[0] * h:.9g}"
        lines.append(f"{t:.6g},{first},{factor[1] * d:.9g},x")
    path.write_text("\n".join(lines) + "\n" + extra)
    return path


@pytest.fixture(scope="module")
def short():
    return every(simulated(0.3, 4.0, 0.2), 0.5)


def test_json_as_promised(short, tmp_path):
    files = [
        write(tmp_path / "a.csv", short),
        write(tmp_path / "b.csv", short, "heading_rad", "rudder_rad"),
    ]
    result, page = tmp_path / "n.json", tmp_path / "n.html"
    arguments = ["nomoto", str(files[0]), "--validate", str(files[1]), "--json", str(result)]
    assert main([*arguments, "--report", str(page)]) == 0
    document = json.loads(result.read_text())
    assert document["order"] == 1
    assert document["K"]["value"] == pytest.approx(0.3, rel=0.01) and document["K"]["unit"] == "1/s"
    assert document["T"]["value"] == pytest.approx(4.0, rel=0.01) and document["T"]["unit"] == "s"
    assert document["K"]["std"] > 0.0 and document["heading_rmse_rad"] < 0.01
    judged = document["validation"]["heading_rmse_rad"]
    assert judged == pytest.approx(document["heading_rmse_rad"], abs=1e-7)
    text = page.read_text()
    assert text.count("<svg") >= 2 and "http" not in text.split("</style>")[1].replace(
        "http://www.w3.org", ""
    )


def test_a_prediction_that_diverges_is_said(short, tmp_path, capsys):
    """Written all the same, but not with exit status 0."""
    ship = replace(short, heading=0.01 * short.heading)  # turns a hundred times less
    files = [write(tmp_path / "a.csv", short), write(tmp_path / "b.csv", ship, "heading_rad")]
    result = tmp_path / "n.json"
    words = ["nomoto", str(files[0]), "--validate", str(files[1]), "--json", str(result)]
    assert main(words) == 2
    assert "the prediction of b.csv diverges" in capsys.readouterr().err
    document = json.loads(result.read_text())
    assert document["validation"]["diverges"] is True
    assert document["stability"]["course_stable"] is True
    assert set(document["cross_validation"]) == {"1", "2"}


@pytest.mark.parametrize(
    "options", [["--order", "2"], ["--nonlinear"], ["--interpolate", "spline"],
                ["--interpolate", "spiral"], ["--method", "iv"], ["--method", "rls"],
                ["--method", "ukf"]]
)  # fmt: skip
def test_options(short, tmp_path, options):
    result = tmp_path / "n.json"
    path = write(tmp_path / "a.csv", short)
    assert main(["nomoto", str(path), *options, "--json", str(result)]) == 0
    assert json.loads(result.read_text())["K"]["value"] == pytest.approx(0.3, rel=0.1)


def test_headings_may_be_empty_between_samples(remus, tmp_path):
    sparse = blanked(every(remus, 0.1), 0.5)
    run = read(write(tmp_path / "a.csv", sparse))
    np.testing.assert_allclose(run.heading, sparse.heading, atol=1e-7)
    assert run.step == pytest.approx(0.5)


def test_heading_across_the_wrap(short, tmp_path):
    shifted = Zigzag("x", short.t, np.angle(np.exp(1j * (short.heading + np.pi))), short.rudder)
    run = read(write(tmp_path / "a.csv", shifted))
    np.testing.assert_allclose(run.heading - run.heading[0], short.heading, atol=1e-7)


def recorded(run):
    """The messages (topic, type, stamp, bytes) of a bag of this run, with a rudder topic."""
    zeros = np.zeros(3)
    for t, heading, rudder in zip(run.t, run.heading, run.rudder):
        stamp = 1_000_000_000 + round(1e9 * t)
        yield "/rudder", "std_msgs/msg/Float64", stamp, struct.pack("<4Bd", 0, 1, 0, 0, rudder)
        pose = quaternion_from_euler(0.0, 0.0, heading)
        odometry = Odometry(
            stamp, "world_ned", "base_link_frd", zeros, pose, zeros, zeros, np.zeros(6)
        )
        yield "/odom", ODOMETRY_TYPE, stamp, encode(odometry)


def as_mcap(path, rows):
    with BagWriter(path) as writer:
        for topic, kind, stamp, data in rows:
            writer.write(topic, kind, stamp, data)
    return path


@pytest.mark.parametrize(("name", "write_bag"), [("a.mcap", as_mcap), ("a.bag", write_ros1)])
def test_bag_with_a_rudder_topic(name, write_bag, short, tmp_path):
    run = read(write_bag(tmp_path / name, recorded(short)))
    np.testing.assert_allclose(run.heading, short.heading, atol=1e-9)
    np.testing.assert_allclose(run.rudder, short.rudder)
    assert run.unit == "rad" and run.held


def test_headings_before_the_first_message_of_the_rudder_tell_nothing(short, tmp_path):
    late = [row for row in recorded(short) if row[0] == "/odom" or row[2] >= 21_000_000_000]
    run = read(as_mcap(tmp_path / "late.mcap", late))
    np.testing.assert_allclose(run.rudder, short.rudder[short.t >= 20.0])
    early = [row for row in recorded(short) if row[0] == "/odom" or row[2] >= 101_000_000_000]
    with pytest.raises(UserError, match="too few headings after the first message of the rudder"):
        read(as_mcap(tmp_path / "early.mcap", early))


def test_what_holds_between_the_messages_of_a_rudder_is_asked(tmp_path):
    """Counted as held, T is at least half a step of 0.2 s too short."""
    fine = simulated(0.5, 4.0, 0.1, noise=0.0035)
    path = as_mcap(tmp_path / "a.mcap", recorded(every(fine, 0.2)))
    measured = nomoto.fit([read(path, measured=True)])
    assert abs(measured.value("T") - 4.0) < 3.0 * measured.std[measured.names.index("T")]
    assert not any("--measured" in note for note in measured.notes)
    held = nomoto.fit([read(path)])
    assert held.value("T") < 3.9
    assert any("give --measured" in note for note in held.notes)


def test_doubts_about_a_bag_are_said(short, tmp_path, capsys):
    rows = [*recorded(short)]
    rows += [("/truth", *row[1:]) for row in rows if row[0] == "/odom"]
    path = as_mcap(tmp_path / "two.mcap", rows)
    assert main(["nomoto", str(path), "--order", "1"]) == 0
    assert "topics.odom chooses another of its type: /truth" in capsys.readouterr().err


def test_a_file_given_twice_counts_once(short, tmp_path, capsys):
    path, copy = (write(tmp_path / name, short) for name in ("run.csv", "copy.csv"))
    told = []
    for files in ((path,), (path, copy)):
        result = tmp_path / "result.json"
        words = ["nomoto", *map(str, files), "--order", "1", "--json", str(result)]
        assert main(words) == 0
        told.append(json.loads(result.read_text()))
    note = f"{copy} holds the same data as {path}: it counts once"
    assert told[1].pop("notes") == [note, *told[0].pop("notes")]
    assert told[0] == told[1]
    assert note in capsys.readouterr().err


def test_a_run_with_a_pause_counts_as_two():
    """Rows lost while the zigzag goes on. Simulated through, they made a K of -0.02."""
    whole = every(simulated(0.5, 4.0, 0.35, duration=80.0, noise=0.0035), 0.2)
    lost = (whole.t > 25.0) & (whole.t < 45.0)
    model = nomoto.fit([whole[~lost]])
    assert abs(model.value("K") - 0.5) < 0.005 and abs(model.value("T") - 4.0) < 0.05
    assert any("pauses" in note for note in model.notes)
    assert nomoto_model.predict(model, whole[~lost])[1] == pytest.approx(0.0035, rel=0.2)
    few = (whole.t > 2.0) & (whole.t < 77.0)  # no 20 headings on either side
    with pytest.raises(UserError, match="record it without pauses"):
        nomoto.fit([whole[~few]])
    rare = replace(whole, t=100.0 * whole.t)  # of a ship; no pause
    assert rare.parts == [slice(0, len(rare.t))]


def test_bag_of_other_types(short, tmp_path):
    """The configuration says the types, as to the other commands."""
    zeros = np.zeros(3)
    rows = []
    for t, heading, rudder in zip(short.t, short.heading, short.rudder):
        stamp = 1_000_000_000 + round(1e9 * t)
        q = quaternion_from_euler(0.0, 0.0, heading)
        odometry = Odometry(
            stamp, "world_ned", "base_link_frd", zeros, q, zeros, zeros, np.zeros(6)
        )
        rows += [(stamp, *row) for row in twist_and_pose("plain", odometry)]
        rudder_bytes = struct.pack("<4Bd", 0, 1, 0, 0, rudder)
        rows.append((stamp, "/rudder", "std_msgs/Float64", rudder_bytes))
    path = write_rows(tmp_path / "run.mcap", rows)
    with pytest.raises(UserError, match="nav_msgs/msg/Odometry"):
        read(path)
    run = read(path, with_twist("plain"))
    known = np.isfinite(run.heading)
    np.testing.assert_allclose(run.heading[known], short.heading, atol=1e-9)
    np.testing.assert_allclose(run.rudder[known], short.rudder)
    config.dump(with_twist("plain"), tmp_path / "twist.yaml")
    result = tmp_path / "result.json"
    words = ["nomoto", str(path), "--config", str(tmp_path / "twist.yaml"), "--json", str(result)]
    assert main(words) == 0
    assert json.loads(result.read_text())["K"]["unit"] == "1/s"


def test_bag_without_rudder_takes_the_yaw_moment():
    run = read(ROOT / "bags" / "demo.mcap")
    assert run.unit == "N m" and run.held and np.ptp(run.rudder) > 0.0


# ------------------------------------------------------------------ what is refused


def changed(path, old, new):
    path.write_text(path.read_text().replace(old, new))


BAD = {
    "no time": (lambda p, r: changed(write(p, r), "t_s", "time"), "has no column t_s"),
    "no heading": (lambda p, r: changed(write(p, r), "heading_deg", "course"), "heading_rad or"),
    "no unit": (lambda p, r: changed(write(p, r), "rudder_deg", "rudder"), "say its unit"),
    "radians called degrees": (
        lambda p, r: changed(write(p, r, rudder="rudder_rad"), "rudder_rad", "rudder_deg"),
        "looks like radians",
    ),
    "degrees called radians": (
        lambda p, r: changed(write(p, r), "rudder_deg", "rudder_rad"), "looks like degrees"
    ),
    "heading in degrees called radians": (
        lambda p, r: changed(write(p, r), "heading_deg", "heading_rad"), "else wrap it"
    ),
    "time back": (lambda p, r: write(p, r, extra="3,0,0,x\n"), "time must increase"),
    "milliseconds": (
        lambda p, r: write(p, replace(r, t=1000.0 * r.t)), "looks like milliseconds: divide"
    ),
    "no number": (lambda p, r: write(p, r, extra="101,0,hard,x\n"), "`hard` is not a number"),
    "ragged": (lambda p, r: write(p, r, extra="101,0\n"), "2 cells under 4 headings"),
    "too short": (
        lambda p, r: write(p, Zigzag("x", r.t[:9], r.heading[:9], r.rudder[:9])), "looks like"
    ),
    "few": (
        lambda p, r: write(p, Zigzag("x", r.t[:15], r.heading[:15] + np.arange(15), r.rudder[:15])),
        "15 headings",
    ),
    "rudder at rest": (
        lambda p, r: write(p, Zigzag("x", r.t, r.heading, 0.0 * r.rudder)), "rudder is constant"
    ),
    "empty": (lambda p, r: p.write_text(""), "has no rows"),
    "binary": (lambda p, r: p.write_bytes(bytes(range(128, 256))), "is not a CSV text file"),
    "UTF-16": (lambda p, r: p.write_text("t_s,psi\n", "utf-16"), "start byte): save it as one"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused_in_a_sentence(case, short, tmp_path, capsys):
    make, sentence = BAD[case]
    path = tmp_path / "a.csv"
    make(path, short)
    assert main(["nomoto", str(path), "--json", str(tmp_path / "n.json")]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]


def test_kinds_of_input_are_not_mixed(short, tmp_path):
    other = Zigzag("moment", short.t, short.heading, short.rudder, "N m")
    with pytest.raises(UserError, match="runs of one kind"):
        nomoto.fit([short, other])
    with pytest.raises(UserError, match="a run of the same kind"):
        nomoto_model.predict(nomoto.fit([short]), other)
