"""Ready layouts for Foxglove and PlotJuggler: the topics of both nodes, by the names they have.

Both read `~/coefficients`, where a coefficient is found by its name whatever else is estimated.
Foxglove's plots take the numbers of its texts as they are, PlotJuggler's parser of DiagnosticArray
makes a series `TOPIC/HARDWARE_ID/NAME/KEY` of each, with the vehicle's name for hardware id.
"""

import json
import math
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

from rov_ident.config import Config

NODES = ("rls_node", "ukf_node")
AXES = ("force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z")
_COLOURS = {"rls_node": "#0072b2", "ukf_node": "#d55e00"}
_BOUND_COLOURS = {"rls_node": "#8fbfdd", "ukf_node": "#eab28a"}
_KEYS = ("value", "lower", "upper")
_STREAMER = "ROS2 Topic Subscriber"


def _tabs(config: Config) -> dict[str, list[str]]:
    """The estimated coefficients by kind."""
    kinds: dict[str, list[str]] = {}
    own = {coefficient.name: coefficient for coefficient in config.model.coefficients}
    for name in config.estimate:
        coefficient = own[name]
        linear = coefficient.left == 0 or coefficient.right == 0
        mass = coefficient.is_added_mass
        kind = "Added mass" if mass else "Linear damping" if linear else "Other damping"
        kinds.setdefault(kind, []).append(name)
    effects = [f"{effect}.{parameter}" for effect, parameter in config.estimate_effects]
    return kinds | ({"Effects": effects} if effects else {})


def _nodes(namespace: str) -> dict[str, str]:
    """The full names of the nodes, by their own."""
    above = f"/{namespace.strip('/')}" if namespace.strip("/") else ""
    return {name: f"{above}/{name}" for name in NODES}


def topics(namespace: str = "") -> list[str]:
    """What the layouts show, except `/diagnostics`."""
    own = ("coefficients", "wrench_residual")
    return [f"{node}/{topic}" for node in _nodes(namespace).values() for topic in own]


# ------------------------------------------------------------------ Foxglove


def foxglove(config: Config, namespace: str = "") -> str:
    """A layout to import: tabs of plots, one plot a coefficient, and the health of the nodes."""
    nodes = _nodes(namespace)
    panels: dict[str, Any] = {}
    tabs = []
    for title, names in _tabs(config).items():
        plots: list[str] = []
        for name in names:
            paths = [
                _path(
                    f'{node}/coefficients.status[:]{{name=="{name}"}}.values[:]{{key=="{key}"}}.value',
                    short if key == "value" else f"{short} {key}",
                    (_COLOURS if key == "value" else _BOUND_COLOURS)[short],
                )
                for short, node in nodes.items()
                for key in _KEYS
            ]
            plots.append(_panel(panels, f"Plot!{name}", _plot(name, paths, legend=not plots)))
        tabs.append({"title": title, "layout": _grid(plots)})
    residuals: list[str] = []
    for axis, sname in zip(AXES, "XYZKMN"):
        paths = [
            _path(f"{node}/wrench_residual.wrench.{axis}", short, _COLOURS[short])
            for short, node in nodes.items()
        ]
        title = f"residual {sname}, in the axes of thruster_wrench"
        plot = _plot(title, paths, legend=not residuals)
        residuals.append(_panel(panels, f"Plot!residual_{sname}", plot))
    tabs.append({"title": "Residual", "layout": _grid(residuals)})
    summary = {
        "minLevel": 0,
        "pinnedIds": [],
        "hardwareIdFilter": config.name,
        "topicToRender": "/diagnostics",
        "sortByLevel": True,
    }
    details = []
    for short, node in nodes.items():
        status = {
            "selectedHardwareId": config.name,
            "selectedName": f"{node.lstrip('/')}: model",
            "topicToRender": "/diagnostics",
        }
        details.append(_panel(panels, f"DiagnosticStatusPanel!{short}", status))
    health = [_panel(panels, "DiagnosticSummary!all", summary), _split(details, "row")]
    tabs.append({"title": "Health", "layout": _split(health, "column")})
    panels["Tab!rov_ident"] = {"activeTabIdx": 0, "tabs": tabs}
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": "Tab!rov_ident",
    }
    return json.dumps(layout, indent=1) + "\n"


def _panel(panels: dict[str, Any], identity: str, settings: dict[str, Any]) -> str:
    identity = identity.replace(".", "_")
    panels[identity] = settings
    return identity


def _path(value: str, label: str, colour: str) -> dict[str, Any]:
    """A series over the time of reception: the stamps of a bag that is played into the nodes are
    far from the clock of a live connection, and so would be the plot."""
    return {
        "value": value,
        "label": label,
        "color": colour,
        "enabled": True,
        "timestampMethod": "receiveTime",
        "showLine": True,
    }


def _plot(title: str, paths: list[dict[str, Any]], legend: bool) -> dict[str, Any]:
    """A plot with or without the legend open, which covers a good part of a small one."""
    return {
        "foxglovePanelTitle": title,
        "paths": paths,
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": legend,
        "legendDisplay": "floating",
        "floatingLegendPosition": "top-right",
        "showPlotValuesInLegend": False,
        "sidebarDimension": 240,
    }


def _grid(panels: Sequence[str]) -> Any:
    """Panels in rows of about as many as there are rows; Foxglove splits in two, and again."""
    return _split([_split(row, "row") for row in _rows(panels)], "column")


def _rows(items: Sequence[Any]) -> list[Sequence[Any]]:
    width = math.ceil(math.sqrt(len(items)))
    return [items[i : i + width] for i in range(0, len(items), width)]


def _split(parts: Sequence[Any], direction: str) -> Any:
    if len(parts) == 1:
        return parts[0]
    half = len(parts) // 2
    return {
        "first": _split(parts[:half], direction),
        "second": _split(parts[half:], direction),
        "direction": direction,
        "splitPercentage": 100.0 * half / len(parts),
    }


# ------------------------------------------------------------------ PlotJuggler


def plotjuggler(config: Config, namespace: str = "") -> str:
    """A layout to load: the same tabs; it offers to start the subscriber of ROS 2 topics."""
    nodes = _nodes(namespace)
    root = ElementTree.Element("root")
    window = _add(root, "tabbed_widget", parent="main_window", name="Main Window")
    for title, names in _tabs(config).items():
        plots = {
            name: [
                (
                    f"{node}/coefficients/{config.name}/{name}/{key}",
                    (_COLOURS if key == "value" else _BOUND_COLOURS)[short],
                )
                for short, node in nodes.items()
                for key in _KEYS
            ]
            for name in names
        }
        _tab(window, title, plots)
    residuals = {
        f"residual {sname}": [
            (f"{node}/wrench_residual/wrench/{axis.replace('.', '/')}", _COLOURS[short])
            for short, node in nodes.items()
        ]
        for axis, sname in zip(AXES, "XYZKMN")
    }
    _tab(window, "Residual", residuals)
    _add(window, "currentTabIndex", index="0")
    _add(root, "use_relative_time_offset", enabled="1")
    plugin = _add(_add(root, "Plugins"), "plugin", ID=_STREAMER)
    for key, value in (
        ("use_header_stamp", "true"),
        ("discard_large_arrays", "false"),
        ("max_array_size", "1000"),
        ("boolean_strings_to_number", "false"),
        ("remove_suffix_from_strings", "false"),
        ("selected_topics", ";".join(topics(namespace))),
    ):
        _add(plugin, key, value=value)
    _add(root, "previouslyLoaded_Datafiles")
    _add(root, "previouslyLoaded_Streamer", name=_STREAMER)
    ElementTree.indent(root, " ")
    text = ElementTree.tostring(root, encoding="unicode")
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{text}\n"


def _tab(window: ElementTree.Element, title: str, plots: dict[str, list[tuple[str, str]]]) -> None:
    tab = _add(window, "Tab", tab_name=title, containers="1")
    rows = _rows(list(plots))
    below = _splitter(_add(tab, "Container"), "-", len(rows))
    for row in rows:
        beside = _splitter(below, "|", len(row))
        for name in row:
            plot = _add(
                _add(beside, "DockArea", name=name), "plot",
                mode="TimeSeries", style="Lines", flip_x="false", flip_y="false",
            )  # fmt: skip
            _add(plot, "range", left="0", right="1", bottom="-1", top="1")
            _add(plot, "limitY")
            for curve, colour in plots[name]:
                _add(plot, "curve", name=curve, color=colour)
    _expect(tab, [curve for curves in plots.values() for curve, _ in curves])


def _expect(tab: ElementTree.Element, curves: list[str]) -> None:
    """Names the curves of a tab where PlotJuggler 3 looks for those to await from a stream.

    It looks one splitter deep, and drops from plots further down what has not been received by
    then. A splitter without a direction is looked through, but not shown.
    """
    hidden = _add(_add(tab, "Container"), "DockSplitter", orientation="", count="0", sizes="")
    plot = _add(_add(hidden, "DockArea"), "plot", mode="TimeSeries")
    for curve in curves:
        _add(plot, "curve", name=curve)


def _splitter(parent: ElementTree.Element, orientation: str, count: int) -> ElementTree.Element:
    sizes = ";".join([f"{1.0 / count:.6f}"] * count)
    return _add(parent, "DockSplitter", orientation=orientation, sizes=sizes, count=str(count))


def _add(parent: ElementTree.Element, tag: str, /, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, attributes)
