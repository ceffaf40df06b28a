"""Coefficients into a running controller: what is sent and what is not, over DDS."""

import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from controller import AT_FIRST, LISTS
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from bench import HEAVY
from bench.simulators.live import end_node
from rov_ident.consumer import parameter_bridge as bridge
from rov_ident.consumer.hydrodynamic_model import HydrodynamicModel
from rov_ident.consumer.parameter_bridge import Target
from rov_ident.core.errors import UserError
from rov_ident.core.states import Level, State
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.model.coefficients import DIAGONAL
from rov_ident.nodes.conversions import to_diagnostics

TWO = 'mapping:=["X_u=hydrodynamics.X_u", "X_uu=hydrodynamics.X_uu"]'


# ------------------------------------------------------------------ without ROS


def test_a_message_that_is_no_good_is_ignored(heavy):
    """One that is late had taken the set in use with it."""
    from rov_ident.nodes.controller_bridge import ControllerBridge

    node = SimpleNamespace(
        _lock=threading.Lock(), _model=HydrodynamicModel(heavy),
        _targets=bridge.targets(heavy, "{name}"), _wanted={}, _std={},
        _refusal="no coefficients were heard yet",
    )  # fmt: skip
    report = OnlineEstimator(heavy, "rls").report()
    converged = replace(report, states=(State.CONVERGED,) * len(report.names))
    assert ControllerBridge._usable(node)[2] == "no coefficients were heard yet"
    wrong = replace(converged, stamp=3 * 10**9, units=("cubits",) * len(report.names))
    for message in (replace(converged, stamp=2 * 10**9), replace(converged, stamp=10**9), wrong):
        ControllerBridge._take(node, to_diagnostics(message, heavy.name))
        wanted, std, refusal = ControllerBridge._usable(node)
        assert wanted.keys() == std.keys() == set(heavy.estimate) and not refusal
    node._model.hold_after = 0.0
    assert "no coefficient that can be read" in ControllerBridge._usable(node)[2]


def test_targets(heavy):
    everywhere = bridge.targets(heavy, "damping/{name}")
    assert [target.coefficient for target in everywhere] == list(heavy.estimate)
    assert everywhere[0].parameter == f"damping/{heavy.estimate[0]}"
    some = bridge.targets(heavy, "", ["X_u = -drag.x", "X_uu=drag.q[0]", "Z_ww=drag.q[2]"])
    assert some == (
        Target("X_u", "drag.x", None, -1.0),
        Target("X_uu", "drag.q", 0),
        Target("Z_ww", "drag.q", 2),
    )


@pytest.mark.parametrize(
    "template, mapping, layout, sentence",
    [
        ("{name}{name}", [], "none", "must have {name} in it once"),
        ("x", [], "none", "must have {name} in it once"),
        ("", ["X_u"], "none", "must be NAME=PARAMETER"),
        ("", ["X_y=a"], "none", "X_y is not estimated"),
        ("", ["X_u=a[b]"], "none", "is no place of a parameter"),
        ("", ["X_u=a", "X_uu=a"], "none", "a would be given more than one"),
        ("", ["X_u=a", "X_uu=a[1]"], "none", "a would be given more than one"),
        ("", [], "ardusub", "layout is 'ardusub'"),
    ],
)
def test_bad_targets(heavy, template, mapping, layout, sentence):
    with pytest.raises(UserError) as refused:
        bridge.targets(heavy, template, mapping, layout)
    assert sentence in str(refused.value)


def test_read_and_write():
    places = (Target("X_u", "x", None, -1.0), Target("X_uu", "q", 0), Target("Z_ww", "q", 2))
    has = {"x": 3.0, "q": (-1.0, -2.0, -3.0)}
    assert bridge.read(places, has) == {"X_u": -3.0, "X_uu": -1.0, "Z_ww": -3.0}
    new = bridge.write(places, has, {"X_u": -4.0, "X_uu": -5.0, "Z_ww": -6.0})
    assert new == {"x": 4.0, "q": (-5.0, -2.0, -6.0)}
    assert bridge.write(places, has, {"X_u": -4.0}) == {"x": 4.0}
    for wrong in ({"x": (3.0,)}, {"q": 1.0}, {"q": (1.0, 2.0)}, {"x": float("nan")}):
        with pytest.raises(UserError):
            bridge.read(places, has | wrong)


def test_dead_band():
    held, std = {"X_u": -10.0, "X_uu": -100.0}, {"X_u": 0.05, "X_uu": 2.0}
    beyond = {"X_u": -10.2, "X_uu": -100.5}
    assert bridge.changes(held, {"X_u": -10.04, "X_uu": -101.5}, std, 1.0, 0.0) == []
    # One is out of the band: the whole set goes.
    changed = bridge.changes(held, beyond, std, 1.0, 1.0)
    assert [(c.coefficient, c.held, c.wanted) for c in changed] == [
        ("X_u", -10.0, -10.2),
        ("X_uu", -100.0, -100.5),
    ]
    assert bridge.changes(held, beyond, std, 1.0, 3.0) == []
    assert bridge.changes(held, beyond, std, 5.0, 1.0) == []


def test_layout_is_that_of_auv_controllers_before_0_1_0(heavy):
    """Of each kind a list, in the order X Y Z K M N; and the layout says whom it reaches."""
    model = dict(zip(heavy.model.names, heavy.model.theta.tolist(), strict=True))
    kinds = {
        "added_mass": "added_mass",
        "linear_damping": "linear",
        "quadratic_damping": "quadratic",
    }
    parameters = {
        f"hydrodynamics.{key}": tuple(model.get(name, 0.0) for name in DIAGONAL[kind])
        for key, kind in kinds.items()
    }
    read = bridge.read(bridge.targets(heavy, "", (), "auv_controllers"), parameters)
    assert read == {name: model[name] for name in heavy.estimate}
    assert "before 0.1.0 only" in bridge.LAYOUT_NOTES["auv_controllers"]


# ------------------------------------------------------------------ over DDS


class Bridge:
    """The bridge and a controller in processes; here the estimator and the operator."""

    def __init__(self, mode, options, heavy):
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        from rov_ident.nodes.common import LATCHED, Executor

        python = [sys.executable]
        self.controller = subprocess.Popen(
            [*python, Path(__file__).with_name("controller.py"), mode]
        )
        command = [*python, "-m", "rov_ident.nodes", "controller_bridge", "--ros-args"]
        command += ["--params-file", str(HEAVY), "-p", "controller:=/controller"]
        for option in ("dead_band.percent:=0.5", *options):
            command += ["-p", option]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("operator", context=self.context)
        self.executor = Executor(context=self.context)
        self.executor.add_node(self.node)
        self.publisher = self.node.create_publisher(DiagnosticArray, "coefficients", LATCHED)
        self.statuses, self.pending = [], []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10)
        self.node.create_subscription(
            DiagnosticArray,
            "/controller_bridge/pending",
            lambda m: self.pending.append({s.name: s for s in m.status}),
            LATCHED,
        )
        self.report = OnlineEstimator(heavy, "rls").report()
        self.stamp = 10**9
        self.says = None  # what the estimator goes on saying

    def _hear(self, message):
        self.statuses.append(message.status[0])

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)

    def until(self, ready, seconds=300.0):
        """Whether it comes to pass; the estimator speaks ten times a second meanwhile."""
        end = time.monotonic() + seconds
        while not ready():
            words = [status.message for status in self.statuses[-3:]]
            assert time.monotonic() < end, f"nothing of the kind in time; it says {words}"
            self.speak()
            self.spin(0.1)

    def speak(self):
        if self.says is None:
            return

        values, levels = self.report.values.copy(), [Level.WARN] * len(self.report.names)
        for name, (value, level) in self.says.items():
            i = self.report.names.index(name)
            values[i], levels[i] = value, level
        self.stamp += 100_000_000
        said = replace(
            self.report, stamp=self.stamp, values=values, std=np.abs(values) / 1000.0,
            states=tuple(map(State.at, levels)),
        )  # fmt: skip
        self.publisher.publish(to_diagnostics(said, "heavy"))

    def hears(self, words):
        self.until(lambda: any(words in status.message for status in self.statuses[-2:]))

    def call(self, type_, name, request):
        client = self.node.create_client(type_, name)
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def ask(self, service):
        return self.call(Trigger, f"/controller_bridge/{service}", Trigger.Request())

    def held(self, names=tuple(AT_FIRST)):
        request = GetParameters.Request(names=list(names))
        answer = self.call(GetParameters, "/controller/get_parameters", request)
        return [
            v.double_value if v.type == 3 else list(v.double_array_value) for v in answer.values
        ]

    def set(self, node, **values):
        parameters = [
            Parameter(name.replace("__", "."), value=v).to_parameter_msg()
            for name, v in values.items()
        ]
        request = SetParameters.Request(parameters=parameters)
        return self.call(SetParameters, f"/{node}/set_parameters", request).results[0]

    def close(self):
        import rclpy

        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)
        self.controller.terminate()
        self.controller.wait(240)
        status, said = end_node(self.process)
        assert status == 0, said
        assert "Traceback" not in said


@pytest.fixture
def start(domain, heavy):
    started = []

    def begin(mode, *options):
        started.append(Bridge(mode, options, heavy))
        return started[-1]

    yield begin
    for one in started:
        one.close()


GOOD = {"X_u": (-13.0, Level.OK), "X_uu": (-140.0, Level.OK)}


def test_approval_and_revert(start):
    """Nothing without approval; a set at once with it; and back to what was there at first."""
    one = start("usual", TWO)
    one.hears("no coefficients were heard yet")
    one.says = {"X_u": (-13.0, Level.WARN), "X_uu": (-140.0, Level.ERROR)}
    one.hears("no coefficient has converged")
    assert not one.ask("approve").success

    one.says = GOOD
    one.hears("waiting for ~/approve")
    one.until(lambda: one.pending and set(one.pending[-1]) == {"X_u", "X_uu"})
    shown = {pair.key: pair.value for pair in one.pending[-1]["X_uu"].values}
    assert (shown["held"], shown["wanted"]) == ("-100.0", "-140.0")
    assert one.held() == [-10.0, -100.0]
    answer = one.ask("approve")
    assert answer.success and "X_u -10 -> -13" in answer.message
    assert one.held() == [-13.0, -140.0]
    one.hears("the controller has what is converged")

    # A drag that is no drag is refused by us, one that is too much by the controller.
    one.says = {"X_u": (-14.0, Level.OK), "X_uu": (5.0, Level.OK)}
    one.hears("X_uu is 5.0, but must not be positive")
    one.says = {"X_u": (-14.0, Level.OK), "X_uu": (-2000.0, Level.OK)}
    one.hears("waiting for ~/approve")
    answer = one.ask("approve")
    assert not answer.success and "too much" in answer.message
    assert one.held() == [-13.0, -140.0]

    # What converged beside something of the controller's own that no hull has.
    assert one.set("controller", hydrodynamics__X_u=5.0).successful
    one.says = {"X_u": (-14.0, Level.WARN), "X_uu": (-150.0, Level.OK)}
    one.hears("together with what the controller has: coefficients.X_u is 5.0")
    assert one.set("controller", hydrodynamics__X_u=-13.0).successful

    # Only what is converged goes, and nothing that is old.
    one.says = {"X_u": (-14.0, Level.OK), "X_uu": (-150.0, Level.WARN)}
    one.until(lambda: one.pending and set(one.pending[-1]) == {"X_u"})
    one.says = None
    one.hears("stale")
    answer = one.ask("approve")
    assert not answer.success and "stale" in answer.message
    assert one.held() == [-13.0, -140.0]

    answer = one.ask("revert")
    assert answer.success, answer.message
    assert one.held() == [-10.0, -100.0]
    one.says = GOOD
    one.hears("disabled")
    assert not one.ask("approve").success
    one.call(SetBool, "/controller_bridge/enable", SetBool.Request(data=True))
    one.hears("waiting for ~/approve")
    one.call(SetBool, "/controller_bridge/enable", SetBool.Request(data=False))
    answer = one.ask("approve")  # what was pending before is not, although nothing has looked since
    assert not answer.success and one.held() == [-10.0, -100.0]


def test_rate_and_lists(start, heavy):
    """Sets follow one another by the period; a list is changed in its places only."""
    one = start("lists", "layout:=auv_controllers", "approval:=false", "period:=3.0")
    names = list(LISTS)
    one.says = {"X_udot": (-6.0, Level.OK), "X_u": (-13.0, Level.OK), "Z_ww": (-170.0, Level.OK)}
    one.until(lambda: one.held(names)[1][0] == -13.0)
    began = time.monotonic()
    assert one.held(names) == [
        [-6.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [-13.0, 0.0, -20.0, 0.0, -0.5, 0.0],
        [-100.0, -200.0, -170.0, -1.0, -0.4, -1.2],
    ]
    one.says = one.says | {"X_u": (-13.01, Level.OK)}  # within the dead band
    one.hears("the controller has what is converged")
    one.says = one.says | {"X_u": (-15.0, Level.OK)}
    one.hears("waiting for the period")
    one.until(lambda: one.held(names)[1][0] == -15.0)
    assert time.monotonic() - began > 2.0
    # The settings that may change while running do, within their ranges.
    assert not one.set("controller_bridge", period=0.0).successful
    assert not one.set("controller_bridge", controller="/other").successful
    assert one.set("controller_bridge", period=0.5, approval=True).successful
    one.says = one.says | {"X_u": (-16.0, Level.OK)}
    one.hears("waiting for ~/approve")
    request = DescribeParameters.Request(names=["period", "dead_band.percent"])
    described = one.call(
        DescribeParameters, "/controller_bridge/describe_parameters", request
    ).descriptors
    assert [(d.floating_point_range[0].from_value, "[" in d.description) for d in described] == [
        (0.1, True),
        (0.0, True),
    ]


@pytest.mark.parametrize(
    "mode, words", [("sloppy", "not this one"), ("slow", "gave no answer within 0.5 s")]
)
def test_half_a_set(start, mode, words):
    """A controller that takes a part of a set gets back what it had, even if it is not heard."""
    one = start(mode, TWO, "patience:=0.5")
    one.says = GOOD
    one.hears("waiting for ~/approve")
    answer = one.ask("approve")
    assert not answer.success and words in answer.message
    one.statuses.clear()
    one.hears("waiting for ~/approve")
    assert one.held() == [-10.0, -100.0]
    # It is a controller that mends its ways.
    assert one.ask("approve").success
    assert one.held() == [-13.0, -140.0]


@pytest.mark.parametrize(
    "options, sentence",
    [
        (["controller:=velocity"], "must be the full name"),
        (["controller:=/c", "approval:=maybe"], "approval is 'maybe' (text), but must be true or"),
    ],
)
def test_bad_parameters(domain, options, sentence):
    command = [sys.executable, "-m", "rov_ident.nodes", "controller_bridge", "--ros-args"]
    command += ["--params-file", str(HEAVY), *(part for o in options for part in ("-p", o))]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 2
    last = ended.stderr.strip().splitlines()[-1]
    assert last.startswith("controller_bridge: ") and sentence in last
    assert "Traceback" not in ended.stderr


def test_wrong_names(start):
    """What the controller does not have is named."""
    one = start("usual", "parameter:=wrong.{name}")
    one.says = GOOD
    one.hears("/controller has no value of wrong.K_p")
