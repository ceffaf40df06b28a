"""Ready layouts for Foxglove and PlotJuggler: the topics of both nodes, by the names they have.

Both read `~/coefficients`. Foxglove plots the numbers in its texts; PlotJuggler's parser of
DiagnosticArray makes a series `TOPIC/HARDWARE_ID/NAME/KEY` of each, the hardware id being the
vehicle's name. What all vehicles share is in `foxglove.json` and `plotjuggler.xml` of this folder.
"""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from importlib.resources import files
from typing import Any
from xml.etree import ElementTree

from rov_ident.config import Config

AXES = ("force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z")
_RESIDUAL = "Residual"
_COLOURS = {
    "rls_node": ("#0072b2", "#8fbfdd", "#8fbfdd"),
    "ukf_node": ("#d55e00", "#eab28a", "#eab28a"),
}
"""Of a node's values, and of the lower and upper ends of their intervals."""

_add = ElementTree.SubElement

Curve = tuple[str, str, str]  # its path, label and colour


def _nodes(namespace: str) -> dict[str, str]:
    """The full names of the nodes, by their own."""
    above = f"/{namespace.strip('/')}" if namespace.strip("/") else ""
    return {name: f"{above}/{name}" for name in _COLOURS}


def _tabs(
    config: Config,
    nodes: dict[str, str],
    coefficient: Callable[[str, str, str], str],
    residual: Callable[[str, str], str],
) -> dict[str, dict[str, list[Curve]]]:
    """The curves by plot, by tab: the estimated coefficients by kind, and the residuals.

    The path of a curve is ``coefficient(node, name, key)`` or ``residual(node, axis)``.
    """
    config = config.with_nuisance  # as the nodes estimate
    kinds: dict[str, list[str]] = {}
    own = {coefficient.name: coefficient for coefficient in config.model.coefficients}
    for name in config.estimate:
        linear = own[name].left == 0 or own[name].right == 0
        damping = "Linear damping" if linear else "Other damping"
        kind = "Fins and propeller" if own[name].inputs else damping
        kinds.setdefault("Added mass" if own[name].is_added_mass else kind, []).append(name)
    if config.estimate_effects:
        kinds["Effects"] = [
            f"{effect}.{parameter}" for effect, parameter in config.estimate_effects
        ]
    tabs = {
        kind: {
            name: [
                (coefficient(node, name, key), f"{short} {key}".removesuffix(" value"), colour)
                for short, node in nodes.items()
                for key, colour in zip(("value", "lower", "upper"), _COLOURS[short])
            ]
            for name in names
        }
        for kind, names in kinds.items()
    }
    tabs[_RESIDUAL] = {
        f"residual {sname}": [
            (residual(node, axis), short, _COLOURS[short][0]) for short, node in nodes.items()
        ]
        for axis, sname in zip(AXES, "XYZKMN")
    }
    return tabs


def _rows(items: Sequence[Any]) -> list[Sequence[Any]]:
    """As many in a row as there are rows, or nearly."""
    width = math.ceil(math.sqrt(len(items)))
    return [items[i : i + width] for i in range(0, len(items), width)]


def foxglove(config: Config, namespace: str = "") -> str:
    """A layout to import: tabs of plots, one plot a coefficient, and the health of the nodes.

    Series are over the time of reception: the stamps of a bag that is played into the nodes are far
    from the clock of a live connection, and so would be the plot. One plot of a tab has its legend
    open, which covers a good part of a small one.
    """
    template = json.loads((files("rov_ident.dashboard") / "foxglove.json").read_text("utf-8"))
    nodes, layout = _nodes(namespace), template["layout"]
    panels, tabs = layout["configById"], []
    curves = _tabs(
        config,
        nodes,
        '{}/coefficients.status[:]{{name=="{}"}}.values[:]{{key=="{}"}}.value'.format,
        "{}/wrench_residual.wrench.{}".format,
    )
    for tab, plots in curves.items():
        shown: list[str] = []
        for name, series in plots.items():
            where = ", in the axes of thruster_wrench" if tab == _RESIDUAL else ""
            identity = f"Plot!{name}".replace(".", "_").replace(" ", "_")
            panels[identity] = template["plot"] | {
                "foxglovePanelTitle": name + where,
                "paths": [
                    template["series"] | {"value": path, "label": label, "color": colour}
                    for path, label, colour in series
                ],
                "showLegend": not shown,
            }
            shown.append(identity)
        rows = [_split(row, "row") for row in _rows(shown)]
        tabs.append({"title": tab, "layout": _split(rows, "column")})
    details = [f"DiagnosticStatusPanel!{short}" for short in nodes]
    for identity, node in zip(details, nodes.values()):
        names = {"selectedHardwareId": config.name, "selectedName": f"{node.lstrip('/')}: model"}
        panels[identity] = template["detail"] | names
    panels["DiagnosticSummary!all"] = template["summary"] | {"hardwareIdFilter": config.name}
    health = _split(["DiagnosticSummary!all", _split(details, "row")], "column")
    tabs.append({"title": "Health", "layout": health})
    panels[layout["layout"]] = {"activeTabIdx": 0, "tabs": tabs}
    return json.dumps(layout, indent=1) + "\n"


def _split(parts: Sequence[Any], direction: str) -> Any:
    """Foxglove splits in two, and again."""
    if len(parts) == 1:
        return parts[0]
    half = len(parts) // 2
    return {
        "first": _split(parts[:half], direction),
        "second": _split(parts[half:], direction),
        "direction": direction,
        "splitPercentage": 100.0 * half / len(parts),
    }


def plotjuggler(config: Config, namespace: str = "") -> str:
    """A layout to load: the same tabs; it offers to start the subscriber of ROS 2 topics."""
    nodes = _nodes(namespace)
    root = ElementTree.fromstring(
        (files("rov_ident.dashboard") / "plotjuggler.xml").read_text("utf-8")
    )
    selected, window = root.find(".//selected_topics"), root.find("tabbed_widget")
    assert selected is not None and window is not None
    topics = (f"{n}/{t}" for n in nodes.values() for t in ("coefficients", "wrench_residual"))
    selected.set("value", ";".join(topics))
    tabs = _tabs(
        config,
        nodes,
        lambda node, name, key: f"{node}/coefficients/{config.name}/{name}/{key}",
        lambda node, axis: f"{node}/wrench_residual/wrench/{axis.replace('.', '/')}",
    )
    for i, (title, plots) in enumerate(tabs.items()):
        tab = ElementTree.Element("Tab", tab_name=title, containers="1")
        window.insert(i, tab)
        _fill(tab, plots)
    ElementTree.indent(root, " ")
    text = ElementTree.tostring(root, encoding="unicode")
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{text}\n"


def _fill(tab: ElementTree.Element, plots: dict[str, list[Curve]]) -> None:
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
            for path, _, colour in plots[name]:
                _add(plot, "curve", name=path, color=colour)
    _expect(tab, [path for curves in plots.values() for path, _, _ in curves])


def _expect(tab: ElementTree.Element, curves: Iterable[str]) -> None:
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
