"""Coefficients on their way into a controller."""

import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench import HEAVY
from bench.simulators.live import end_node
from rov_ident import config
from rov_ident.config.prior import prior_of
from rov_ident.consumer.hydrodynamic_model import HydrodynamicModel
from rov_ident.core.errors import UserError
from rov_ident.core.frames import from_core, gravity_direction, quaternion_from_euler
from rov_ident.core.messages import Odometry
from rov_ident.core.states import Level
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.estimation.physical import is_passive
from rov_ident.model.equations import build
from rov_ident.simulation import virtual_sensors as sensors
from rov_ident.simulation.open_loop import simulate

HEAVY_CONFIG = config.load(HEAVY)
UNITS = {"X_u": "N s/m", "X_uu": "N s2/m2", "X_udot": "kg", "Z_ww": "N s2/m2"}


def status(name, value, unit=None, level=b"\x00"):
    values = {"value": value, "std": "1.0", "unit": UNITS.get(name, "") if unit is None else unit}
    pairs = [SimpleNamespace(key=k, value=v) for k, v in values.items() if v is not None]
    return SimpleNamespace(name=name, level=level, message="in words", values=pairs)


def message(*statuses, stamp=1.0):
    sec, nanosec = divmod(round(stamp * 1e9), 10**9)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec))
    return SimpleNamespace(header=header, status=list(statuses))


def present(model, name):
    return model.model.theta[model.model.names.index(name)]


@pytest.fixture
def hydrodynamics(heavy):
    return HydrodynamicModel(heavy)


def test_trim_and_thrust_that_the_estimator_finds_are_taken_along(hydrodynamics, heavy):
    """Its coefficients are right only with them: hovering took a force of the wrong sign."""
    level = [0.0, 0.0, 1.0]
    before = hydrodynamics.g(level)
    found = [
        status("X_u", "-20.0"),
        status("thrust_scale.scale", "0.85", "1"),
        status("buoyancy.delta", "2.5", "N"),
        status("thruster_lag.time_constant", "0.2", "s"),  # of no matrix
        status("cog_offset.dx", "0.01", "m", b"\x01"),
    ]
    taken = hydrodynamics.take(message(*found), 0.0)
    assert taken.values == {"X_u": -20.0, "thrust_scale.scale": 0.85, "buoyancy.delta": 2.5}
    assert list(taken.refused) == ["cog_offset.dx"] and hydrodynamics.fresh(0.0)
    assert hydrodynamics.thrust_scale == 0.85
    np.testing.assert_allclose(hydrodynamics.g(level) - before, [0, 0, -2.5, 0, 0, 0], atol=1e-9)
    wrong = [status("X_u", "-20.0"), status("thrust_scale.scale", "0.0", "1")]
    assert "beyond" in hydrodynamics.take(message(*wrong), 0.1).refused["thrust_scale.scale"]
    assert hydrodynamics.thrust_scale == 0.85
    assert HydrodynamicModel(heavy).thrust_scale == 1.0


def test_matrices(hydrodynamics):
    """They are the model's, and together the wrench; attitude is a quaternion or a direction."""
    rng = np.random.default_rng(1)
    nu, nu_dot = rng.standard_normal((2, 6))
    q = quaternion_from_euler(0.3, -0.2, 1.0)
    M, C, D = hydrodynamics.M, hydrodynamics.C(nu), hydrodynamics.D(nu)
    g = hydrodynamics.g(q)
    np.testing.assert_allclose(
        hydrodynamics.wrench(nu, nu_dot, q), M @ nu_dot + C @ nu + D @ nu + g, rtol=1e-12
    )
    np.testing.assert_array_equal(C, -C.T)
    assert np.linalg.eigvalsh(D + D.T)[0] >= 0.0
    np.testing.assert_array_equal(hydrodynamics.g(gravity_direction(q)), g)
    np.testing.assert_allclose(hydrodynamics.g(2.0 * q), g, rtol=1e-14)
    np.testing.assert_allclose(hydrodynamics.g(9.81 * gravity_direction(q)), g, rtol=1e-14)
    # 1.6 N lighter than water: to hold still it must be pushed down.
    np.testing.assert_allclose(hydrodynamics.g([0.0, 0.0, 1.0])[2], 134.0 - 9.81 * 13.5)


def test_only_converged(hydrodynamics, heavy):
    """The level may be a byte, as rclpy has it, or a number."""
    taken = hydrodynamics.take(
        message(
            status("X_u", "-20.0", level=Level.OK),
            status("X_uu", "-100.0", level=b"\x00"),
            status("Z_w", "-1.0", "N s/m", level=b"\x01"),
            status("Z_ww", "-1.0", level=2),
            status("X_udot", "-1.0", level=b"\x03"),
        ),
        now=0.0,
    )
    assert taken.values == {"X_u": -20.0, "X_uu": -100.0}
    assert taken.reason == ""
    assert taken.refused == {
        "Z_w": "WARN: in words",
        "Z_ww": "ERROR: in words",
        "X_udot": "STALE: in words",
    }
    expected = heavy.model.with_values(taken.values)
    np.testing.assert_array_equal(hydrodynamics.model.theta, expected.theta)
    np.testing.assert_array_equal(hydrodynamics.M, heavy.model.mass_matrix)
    assert hydrodynamics.D(np.zeros(6))[0, 0] == 20.0


@pytest.mark.parametrize(
    "bad, reason",
    [
        (status("X_u", "nan"), "not finite"),
        (status("X_u", "-inf"), "not finite"),
        (status("X_u", "-1e300"), "no sensible size"),
        (status("X_u", "-13,7"), "'-13,7' is not a number"),
        (status("X_u", ""), "'' is not a number"),
        (status("X_u", None), "comes without value"),
        (status("X_u", "-20.0", "kN s/m"), "is in 'kN s/m', but must be in 'N s/m'"),
        (status("X_u", "-20.0", level=b""), "none of OK"),
        (status("X_u", "-20.0", level=7), "none of OK"),
        (status("Y_v", "-20.0", "N s/m"), "not a coefficient of this model"),
        (status("", "-20.0"), "not a coefficient of this model"),
    ],
)
def test_malformed(hydrodynamics, heavy, bad, reason):
    """The one is refused with its reason; the others are taken up."""
    alone = hydrodynamics.take(message(bad), now=0.0)
    assert alone.reason == "it has no coefficient that can be read"
    assert not hydrodynamics.fresh(0.0)
    taken = hydrodynamics.take(message(bad, status("X_uu", "-99.0")), now=0.0)
    assert reason in taken.refused[bad.name] and not taken.reason
    assert taken.values == {"X_uu": -99.0}
    assert present(hydrodynamics, "X_u") == -13.7


def test_empty_and_repeated(hydrodynamics):
    assert hydrodynamics.take(message(), 0.0).reason
    taken = hydrodynamics.take(message(status("X_u", "-1.0"), status("X_u", "-2.0")), 0.0)
    assert taken.refused == {"X_u": "given twice"}
    assert present(hydrodynamics, "X_u") == -13.7


@pytest.mark.parametrize(
    "name, value, reason",
    [
        ("X_u", "0.1", "coefficients.X_u is 0.1, but must not be positive"),
        ("X_udot", "30.0", "coefficients.X_udot"),
        ("Y_rdot", "5.0", "not positive definite"),
        ("N_v", "60.0", "feed energy"),
    ],
)
def test_unphysical_as_a_whole(heavy, name, value, reason):
    """Of a set that no hull has nothing is taken, and the stream does not count as fresh for it."""
    values = dict(zip(heavy.model.names, heavy.model.theta)) | {"Y_rdot": 0.0, "N_v": 0.0}
    model = build(heavy.model.body, values)
    units = {c.name: c.unit for c in model.coefficients}
    hydrodynamics = HydrodynamicModel(heavy.with_model(model))
    good = hydrodynamics.take(message(status("X_uu", "-99.0")), now=0.0)
    assert not good.reason
    before = hydrodynamics.model
    taken = hydrodynamics.take(
        message(status("Z_ww", "-99.0"), status(name, value, units[name]), stamp=2.0), now=1.9
    )
    assert reason in taken.reason
    assert not taken.values
    assert set(taken.refused) == {name, "Z_ww"}
    assert hydrodynamics.model is before
    assert not hydrodynamics.fresh(2.1)


def test_what_the_nodes_publish(hydrodynamics, heavy):
    """From an estimator through its message, to the last bit."""
    from rov_ident.nodes.conversions import to_diagnostics

    online = OnlineEstimator(heavy, "rls")
    for _, role, incoming in sensors.dive(heavy, "pilot", 40.0, seed=1).messages:
        online.push(role, incoming)  # two coefficients would converge later
    report = online.report()
    converged = [level == Level.OK for level in report.levels]
    assert any(converged) and not all(converged)
    taken = hydrodynamics.take(to_diagnostics(report, heavy.name), now=0.0)
    assert not taken.reason and hydrodynamics.fresh(0.0)
    expected = np.where(converged, report.values, heavy.model.theta)
    np.testing.assert_array_equal(hydrodynamics.model.theta, expected)


def test_sets_are_exchanged_whole(hydrodynamics):
    """Who holds the model of a moment keeps it, whatever comes in."""
    held = hydrodynamics.model
    theta = held.theta.copy()
    hydrodynamics.take(message(status("X_u", "-1.0"), status("X_uu", "-2.0")), 0.0)
    np.testing.assert_array_equal(held.theta, theta)
    assert hydrodynamics.model is not held


def test_backward_stamps(hydrodynamics):
    """Refused while newer ones keep coming; once those have ended, time has begun anew."""
    take = hydrodynamics.take
    assert take(message(status("X_u", "-1.0"), stamp=10.0), now=0.0).values
    assert take(message(status("X_u", "-2.0"), stamp=10.0), now=0.1).values
    late = take(message(status("X_u", "-3.0"), stamp=9.5), now=0.2)
    assert late.reason == "its stamp is 0.500 s before the last one"
    assert not late.values and present(hydrodynamics, "X_u") == -2.0
    assert take(message(status("X_u", "-4.0"), stamp=9.6), now=2.0).reason
    assert take(message(status("X_u", "-5.0"), stamp=1.0), now=2.2).values
    assert take(message(status("X_u", "-6.0"), stamp=1.2), now=2.3).values


def test_freshness(hydrodynamics):
    """Silence and STALE are told, and nothing is forgotten for them."""
    assert not hydrodynamics.fresh(0.0)
    hydrodynamics.take(message(status("X_u", "-20.0")), now=5.0)
    assert hydrodynamics.fresh(5.0) and hydrodynamics.fresh(7.0)
    assert not hydrodynamics.fresh(7.1)
    assert not hydrodynamics.fresh(4.0)  # the caller's clock was set back
    hydrodynamics.take(message(status("X_u", "-21.0", level=b"\x01"), stamp=2.0), now=8.0)
    assert hydrodynamics.fresh(8.0)
    stale = message(status("X_u", "-30.0", level=b"\x03"), stamp=2.0)
    assert hydrodynamics.take(stale, now=8.1).refused == {"X_u": "STALE: in words"}
    assert not hydrodynamics.fresh(8.1)
    assert present(hydrodynamics, "X_u") == -20.0


def test_hold_after(heavy):
    with pytest.raises(UserError, match="hold_after is 0.0 s"):
        HydrodynamicModel(heavy, hold_after=0.0)


def test_a_vector_of_another_shape_is_refused(heavy):
    hydrodynamics, level = HydrodynamicModel(heavy), [1.0, 0.0, 0.0, 0.0]
    for ask in (
        lambda: hydrodynamics.D(np.zeros((1, 6))),
        lambda: hydrodynamics.C(np.zeros(5)),
        lambda: hydrodynamics.wrench(np.zeros(6), np.zeros(3), level),
    ):
        with pytest.raises(UserError, match=r"nu.* has the shape \(.*\), but must be \(6,\)"):
            ask()


@pytest.mark.parametrize(
    "attitude", [[0.0] * 4, [0.0] * 3, [np.nan, 0.0, 0.0, 1.0], np.ones(5), np.eye(3)]
)
def test_an_attitude_without_a_direction_is_refused(heavy, attitude):
    """Zeros are what an IMU without orientation sends: they made NaN of the thrust."""
    hydrodynamics = HydrodynamicModel(heavy)
    for ask in (
        lambda: hydrodynamics.wrench(np.zeros(6), np.zeros(6), attitude),
        lambda: hydrodynamics.g(attitude),
    ):
        with pytest.raises(UserError, match="of any length but zero"):
            ask()


texts = st.one_of(
    st.floats().map(repr), st.floats(-300.0, 300.0).map(repr), st.text(max_size=5), st.none()
)
statuses = st.builds(
    status,
    st.sampled_from([*UNITS, "Y_q", "?"]),
    texts,
    st.sampled_from([None, None, None, "kg", ""]),
    st.sampled_from([b"\x00", b"\x00", 0, 1, b"\x03", 9, b"ab"]),
)
messages = st.builds(
    lambda content, stamp: message(*content, stamp=stamp),
    st.lists(statuses, max_size=5),
    st.floats(0.0, 5.0),
)


@given(st.lists(st.tuples(messages, st.floats(0.0, 10.0)), max_size=6))
def test_whatever_comes(stream):
    """Nothing raises, and the set in use stays finite and physical."""
    hydrodynamics = HydrodynamicModel(HEAVY_CONFIG)
    prior = prior_of(HEAVY_CONFIG)
    for content, now in stream:
        taken = hydrodynamics.take(content, now)
        names = {s.name for s in content.status}
        assert taken.reason or set(taken.values) | set(taken.refused) == names
        theta = hydrodynamics.model.theta
        assert is_passive(hydrodynamics.model, prior, theta[prior.estimated])
        assert all(theta[hydrodynamics.model.names.index(n)] == v for n, v in taken.values.items())


# ------------------------------------------------------------------ the controller over DDS

COMMAND = np.array([0.4, -0.2, 0.1, 0.0, 0.0, 0.3])  # m/s, rad/s, forward-starboard-down
STEP = 0.02  # s


class Plant:
    """A vehicle that behaves as ``model`` says, at the other end of the controller's topics.

    It waits for a wrench before each step, so that a busy computer changes nothing.
    """

    def __init__(self, model):
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import Twist, WrenchStamped
        from nav_msgs.msg import Odometry as OdometryMessage
        from rclpy.signals import SignalHandlerOptions

        from rov_ident.nodes.common import LATCHED, STREAM, Executor

        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("plant", context=self.context)
        self.executor = Executor(context=self.context)
        self.executor.add_node(self.node)
        self.coefficients = self.node.create_publisher(
            DiagnosticArray, "/rls_node/coefficients", LATCHED
        )
        self.odom = self.node.create_publisher(OdometryMessage, "odom", STREAM)
        self.cmd_vel = self.node.create_publisher(Twist, "cmd_vel", STREAM)
        self.wrenches = []
        self.node.create_subscription(WrenchStamped, "thruster_wrench", self._push, STREAM)
        self.model, self.t = model, 100.0
        self.nu, self.position, self.orientation = (
            np.zeros(6),
            np.zeros(3),
            np.array([1.0, 0, 0, 0]),
        )

    def _push(self, message):
        assert message.header.frame_id == "base_link"
        force, torque = message.wrench.force, message.wrench.torque
        flu = np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])
        assert np.isfinite(flu).all()
        self.wrenches.append(flu * [1.0, -1.0, -1.0, 1.0, -1.0, -1.0])

    def next_wrench(self, seconds=300.0):
        self.wrenches.clear()
        end = time.monotonic() + seconds
        while not self.wrenches:
            assert time.monotonic() < end, "no wrench in time"
            self.executor.spin_once(timeout_sec=0.1)
        return self.wrenches[-1]

    def sail(self, seconds, command=COMMAND, broken=None):
        """The velocity (6,) after this time of odometry and, unless None, commands."""
        from geometry_msgs.msg import Twist, Vector3

        from rov_ident.io.cdr import encode

        for _ in range(round(seconds / STEP)):
            stamp, frames = round(self.t * 1e9), ("odom", "base_link")
            linear, angular = self.nu[:3], self.nu[3:]
            pose = self.position, self.orientation
            odometry = Odometry(stamp, *frames, *pose, linear, angular, np.zeros(6))
            if broken is not None:
                bad = odometry._replace(stamp=stamp + 1, linear=np.full(3, broken))
                self.odom.publish(encode(from_core(bad)))
            self.odom.publish(encode(from_core(odometry)))
            if command is not None:
                u, v, w, p, q, r = command.tolist()
                twist = Twist(linear=Vector3(x=u, y=-v, z=-w), angular=Vector3(x=p, y=-q, z=-r))
                self.cmd_vel.publish(twist)
            wrench = np.tile(self.next_wrench(), (2, 1))
            state = self.nu, self.position, self.orientation
            run = simulate(self.model, np.array([0.0, STEP]), wrench, *state)
            self.nu, self.position, self.orientation = (
                run.nu[1],
                run.position[1],
                run.orientation[1],
            )
            self.t += STEP
        return self.nu

    def tell(self, values, level=Level.OK):
        """Publish coefficients as an estimator does."""
        from builtin_interfaces.msg import Time
        from diagnostic_msgs.msg import DiagnosticArray

        from rov_ident.nodes.conversions import to_status

        units = {c.name: c.unit for c in self.model.coefficients}
        array = DiagnosticArray()
        array.header.stamp = Time(sec=int(self.t), nanosec=round(self.t % 1.0 * 1e9))
        array.status = [
            to_status(name, "", level, "", {"value": repr(value), "unit": units[name]})
            for name, value in values.items()
        ]
        self.coefficients.publish(array)

    def close(self):
        import rclpy

        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def start_controller(*options, path=HEAVY):
    command = [sys.executable, "-m", "rov_ident.nodes", "example_controller", "--ros-args"]
    command += ["--params-file", str(path), "-r", "coefficients:=/rls_node/coefficients"]
    for option in options:
        command += ["-p", option]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def test_controller(domain, heavy):
    """A hull with half as much drag again: only with its coefficients it sails as commanded."""
    of_hull = {
        c.name: float(value) * (1.0 if c.is_added_mass else 1.5)
        for c, value in zip(heavy.model.coefficients, heavy.model.theta)
    }
    limit = "limit:=[200.0, 200.0, 200.0, 50.0, 50.0, 50.0]"
    process = start_controller("timeout:=0.5", limit)
    plant = Plant(heavy.model.with_values(of_hull))
    try:
        np.testing.assert_array_equal(plant.next_wrench(), np.zeros(6))
        ordered = [0, 1, 2, 5]  # roll and pitch are free
        error = plant.sail(2.0)[ordered] - COMMAND[ordered]
        assert np.linalg.norm(error) > 0.1  # with the coefficients of the configuration

        def tracks(seconds, **kwargs):
            reached = plant.sail(seconds, **kwargs)[ordered]
            np.testing.assert_allclose(reached, COMMAND[ordered], atol=0.01)

        plant.tell(of_hull)
        tracks(2.5)
        plant.tell(dict.fromkeys(of_hull, float("nan")))
        tracks(0.5, broken=np.nan)
        plant.tell({"X_u": 30.0})
        tracks(0.5, broken=1e200)
        plant.tell(dict.fromkeys(of_hull, -1.0), Level.STALE)
        tracks(0.5)

        plant.sail(0.8, command=None)  # s; and as long on the clock at least
        np.testing.assert_array_equal(plant.next_wrench(), np.zeros(6))
    finally:
        plant.close()
        code, said = end_node(process)
    assert code == 0, said
    for words in (
        "stopped: nothing usable on odom and cmd_vel",
        "controlling with fresh coefficients",
        "coefficients refused: it has no coefficient that can be read",
        "coefficients refused: coefficients.X_u is 30.0",
        "controlling with the last good coefficients",
        "stopped: nothing usable on cmd_vel",
    ):
        assert words in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    "option, sentence",
    [
        ("gain:=[1.0, 2.0]", "gain must be six numbers"),
        ("vehicle.mass:=-1.0", "vehicle.mass is -1 kg"),
    ],
)
def test_bad_parameters(domain, option, sentence):
    process = start_controller(option)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 2, said
    assert said.splitlines()[-1].startswith("example_controller: ")
    assert sentence in said and "Traceback" not in said


def test_unreadable_parameters(domain, tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text("/**:\n  ros__parameters\n    vehicle: [")
    process = start_controller(path=path)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 2, said
    assert said.splitlines()[-1].startswith("example_controller: ")
    assert "Traceback" not in said
