"""The layouts for Foxglove and PlotJuggler: each name in them is one that the nodes publish."""

import json
import re
import types
from dataclasses import fields, replace
from typing import Literal, Union, get_args, get_origin, get_type_hints
from xml.etree import ElementTree

import foxglove.layouts as sdk
import pytest
from geometry_msgs.msg import WrenchStamped

from bench import HEAVY, ROOT
from rov_ident import config
from rov_ident.cli.program import main
from rov_ident.dashboard import layouts
from rov_ident.estimation.online import OnlineEstimator
from rov_ident.nodes.conversions import to_diagnostics

FOLDER = ROOT / "config"


@pytest.fixture(params=["", "rov1"])
def namespace(request):
    return request.param


@pytest.fixture
def with_effects(heavy):
    """A vehicle with a parameter of an effect and couplings to estimate, besides the diagonal."""
    return replace(
        heavy,
        effects={"thruster_lag": {"time_constant": 0.1}},
        estimate_effects=(("thruster_lag", "time_constant"),),
    )


def published(configuration, namespace):
    """A message of each topic, as a node sends it."""
    report = OnlineEstimator(configuration, "rls").report()
    above = f"/{namespace}" if namespace else ""
    messages = {}
    for node in ("rls_node", "ukf_node"):
        messages[f"{above}/{node}/coefficients"] = to_diagnostics(report, configuration.name)
        messages[f"{above}/{node}/wrench_residual"] = WrenchStamped()
    return messages


def follow(message, path):
    """What is at a Foxglove message path: fields, `[:]`, and filters `{field=="text"}`."""
    found = [message]
    for field, every, name, text in re.findall(r'\.(\w+)(\[:\])?(?:\{(\w+)=="([^"]*)"\})?', path):
        found = [getattr(item, field) for item in found]
        if every:
            found = [part for item in found for part in item]
        if name:
            found = [item for item in found if getattr(item, name) == text]
    return found


def panels_of(layout):
    """The panels that a layout shows, each as often as it does."""
    if isinstance(layout, str):
        return [layout]
    return panels_of(layout["first"]) + panels_of(layout["second"])


def test_foxglove(with_effects, namespace):
    messages = published(with_effects, namespace)
    layout = json.loads(layouts.foxglove(with_effects, namespace))
    panels = layout["configById"]
    tabs = panels[layout["layout"]]["tabs"]
    shown = [panel for tab in tabs for panel in panels_of(tab["layout"])]
    assert sorted([*shown, layout["layout"]]) == sorted(panels)
    plotted = set()
    for identity, panel in panels.items():
        for path in panel.get("paths", []):
            topic, rest = re.fullmatch(r"((?:/\w+)+)(\..+)", path["value"]).groups()
            value = follow(messages[topic], rest)
            assert len(value) == 1, path
            float(value[0])
            plotted.add((topic, identity))
    names = [*with_effects.estimate, "thruster_lag_time_constant"]
    names += [f"residual_{axis}" for axis in "XYZKMN"]
    assert {identity for _, identity in plotted} == {f"Plot!{name}" for name in names}
    assert {topic for topic, _ in plotted} == set(messages)
    for tab in tabs[:-1]:  # one open legend a tab: a plot is small
        plots = [panels[panel] for panel in panels_of(tab["layout"])]
        assert [plot["showLegend"] for plot in plots] == [True] + [False] * (len(plots) - 1)
    statuses = [p["selectedName"] for k, p in panels.items() if k.startswith("DiagnosticStatus")]
    above = f"{namespace}/" if namespace else ""
    assert statuses == [f"{above}rls_node: model", f"{above}ukf_node: model"]


CONFIGS = {
    "Plot": sdk.PlotConfig,
    "DiagnosticSummary": sdk.DiagnosticsSummaryConfig,
    "DiagnosticStatusPanel": sdk.DiagnosticsDetailConfig,
}


def is_one_of(value, hint):
    """Whether a value out of JSON is what a type of the SDK allows."""
    if get_origin(hint) in (Union, types.UnionType):
        return any(is_one_of(value, each) for each in get_args(hint))
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    if get_origin(hint) is list:
        return all(is_one_of(each, get_args(hint)[0]) for each in value)
    if isinstance(value, dict):
        return hint in (sdk.PlotSeries,) and understood(value, hint)
    return type(value) is hint or (hint is float and type(value) is int)


def understood(settings, kind):
    """Whether Foxglove's SDK has all these settings of a panel or a series, and of these types."""
    hints = get_type_hints(kind, vars(sdk))
    keys = dict(zip(kind()._to_dict(), (f.name for f in fields(kind)), strict=True))
    own = set(keys) | {"foxglovePanelTitle"}
    return set(settings) <= own and all(
        is_one_of(value, hints[keys[key]]) for key, value in settings.items() if key in keys
    )


def test_the_sdk_of_foxglove_knows_every_setting(with_effects):
    panels = json.loads(layouts.foxglove(with_effects))["configById"]
    kinds = {identity: identity.partition("!")[0] for identity in panels}
    assert set(kinds.values()) == {*CONFIGS, "Tab"}
    for identity, settings in panels.items():
        if kinds[identity] != "Tab":
            kind = CONFIGS[kinds[identity]]
            assert understood(settings, kind), identity
            assert not understood({**settings, "showLegends": True}, kind)
            key = next(k for k in settings if k != "foxglovePanelTitle")
            assert not understood({**settings, key: {"no": 1}}, kind)


def series(messages):
    """The names that PlotJuggler gives to the numbers of these messages."""
    for topic, message in messages.items():
        for status in getattr(message, "status", []):
            for pair in status.values:
                yield f"{topic}/{status.hardware_id}/{status.name}/{pair.key}"
        for kind in ("force", "torque") if hasattr(message, "wrench") else ():
            for axis in getattr(message.wrench, kind).get_fields_and_field_types():
                yield f"{topic}/wrench/{kind}/{axis}"


def test_plotjuggler(with_effects, namespace):
    messages = published(with_effects, namespace)
    root = ElementTree.fromstring(layouts.plotjuggler(with_effects, namespace).encode())
    shown = [splitter for splitter in root.iter("DockSplitter") if splitter.get("orientation")]
    curves = [c.get("name") for s in shown for c in s.iterfind("DockArea/plot/curve")]
    assert set(curves) <= set(series(messages))
    assert len(curves) == len(set(curves)) == 2 * (3 * (len(with_effects.estimate) + 1) + 6)
    for splitter in shown:
        assert len(splitter) == int(splitter.get("count")) == len(splitter.get("sizes").split(";"))
        assert splitter.get("orientation") in ("|", "-")
        assert {child.tag for child in splitter} <= {"DockSplitter", "DockArea"}
        for area in splitter.iterfind("DockArea"):
            assert [child.tag for child in area] == ["plot"]
            assert area.find("plot").get("mode") == "TimeSeries"
    # Where PlotJuggler 3 looks for what to await from a stream; it draws the first container.
    awaited = root.iterfind("tabbed_widget/Tab/Container/DockSplitter/DockArea/plot/curve")
    assert sorted(curve.get("name") for curve in awaited) == sorted(curves)
    for tab in root.iter("Tab"):
        drawn, hidden = tab.iterfind("Container/DockSplitter")
        assert drawn in shown and not hidden.get("orientation")
    streamer = root.find("previouslyLoaded_Streamer").get("name")
    plugin = root.find(f"Plugins/plugin[@ID='{streamer}']")
    assert set(plugin.find("selected_topics").get("value").split(";")) == set(messages)


def test_shipped(tmp_path, capsys):
    """The files in config/ are what the command writes for the vehicle of the demo."""
    assert main(["layouts", "--config", str(HEAVY), "--out", str(tmp_path)]) == 0
    for name in ("foxglove.json", "plotjuggler.xml"):
        assert (FOLDER / name).read_text() == (tmp_path / name).read_text()
    bad = ["layouts", "--config", str(HEAVY), "--out", str(tmp_path), "--namespace", "a b"]
    assert main(bad) == 2
    assert "is no namespace" in capsys.readouterr().err
    # at once: a pattern that splits a name in every way takes twice as long for each letter
    assert main([*bad[:-1], f"{100 * 'rov_'}-1"]) == 2
    assert main([*bad[:-1], "/fleet/rov_1/"]) == 0
    with pytest.raises(SystemExit, match="2"):
        main(["layouts", "--config", str(HEAVY), "--out", ""])
    assert "an empty name is no folder" in capsys.readouterr().err


def test_all_that_is_published_is_plotted():
    """Also what no vehicle's file knows, which is estimated by default."""
    vehicle = config.load(FOLDER / "bluerov2_heavy.yaml")
    names = OnlineEstimator(vehicle, "rls").prior.names
    assert "thrust_scale.scale" in names
    panels = json.loads(layouts.foxglove(vehicle))["configById"].values()
    root = ElementTree.fromstring(layouts.plotjuggler(vehicle).encode())
    areas = {area.get("name") for area in root.iter("DockArea")}
    assert set(names) <= {panel.get("foxglovePanelTitle") for panel in panels} & areas


def test_every_shipped_vehicle():
    for path in sorted(FOLDER.glob("*.yaml")):
        vehicle = config.load(path)
        json.loads(layouts.foxglove(vehicle))
        ElementTree.fromstring(layouts.plotjuggler(vehicle).encode())
