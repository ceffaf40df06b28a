"""Pictures, each a function of arrays; the only module that knows matplotlib.

matplotlib's settings are those of the caller: ours hold only while we draw.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any, TypeVar, cast

import matplotlib
import matplotlib.colors
import matplotlib.figure
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from rov_ident.core.messages import Array
from rov_ident.reports.result import NORMAL

_STYLE = {
    "svg.hashsalt": "rov_ident",
    "svg.fonttype": "none",  # text stays text: sharp, and found by a search
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "font.size": 9,
    "legend.frameon": False,
}
Draw = TypeVar("Draw", bound=Callable[..., Any])


def styled(draw: Draw) -> Draw:
    """Let a function draw in our style."""
    return matplotlib.rc_context(_STYLE)(draw)


class Figure(matplotlib.figure.Figure):  # type: ignore[misc]
    """A figure that a notebook shows without pyplot, which would keep it in a global list."""

    def _repr_png_(self) -> bytes:
        return to_png(self)


COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")  # Okabe and Ito: told apart by everyone
INK = "#000000"
PANEL = (4.6, 1.9)  # inches; read at the width of a telephone, and side by side on a screen
_TALL = (4.6, 3.4)  # inches
LIMIT = 1.0  # a simulated curve may leave the measured range by so many ranges, then it is cut

_APART = ((None, None), (4.0, 2.0), (1.0, 2.0))
"""Dashes by which curves that lie on each other are told apart."""

_PAUSE = 10.0  # usual steps, after which a curve breaks: nothing was measured there
MEASURED = "measured"
MODELS: Mapping[str, tuple[str, tuple[float, ...]]] = {
    "as configured": (COLOURS[1], (3.0, 1.2)),
    "retuned": (COLOURS[0], (1.0, 1.0)),
    "extended": (COLOURS[2], ()),
}
"""The three models of `explain`: the same colour and dashes in every picture."""


@dataclass(frozen=True)
class History:
    """Coefficients over time as published: t (k,) [s], values and std (k, n)."""

    t: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    std: Array


@styled
def convergence(histories: Mapping[str, History], truth: Mapping[str, float]) -> Figure:
    """Every coefficient over time with its 95 % interval, and the truth where it is known."""
    first = next(iter(histories.values()))
    columns = 3
    rows = -(-len(first.names) // columns)
    figure = Figure(figsize=(11.0, 1.7 * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for ax in axes.flat[len(first.names) :]:
        ax.axis("off")
    for i, ax in enumerate(axes.flat[: len(first.names)]):
        _draw_history(ax, histories, truth, i)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    outside_legend(figure, axes.flat[0], "outside upper right")
    return figure


@styled
def history(histories: Mapping[str, History], truth: Mapping[str, float], i: int) -> Figure:
    """One panel of :func:`convergence`: the coefficient number i."""
    figure, ax = panel("", "time [s]", "")
    _draw_history(ax, histories, truth, i)
    return figure


def _draw_history(
    ax: Axes, histories: Mapping[str, History], truth: Mapping[str, float], i: int
) -> None:
    first = next(iter(histories.values()))
    name = first.names[i]
    for colour, (label, history) in zip(COLOURS, histories.items()):
        value, half = history.values[:, i], NORMAL * history.std[:, i]
        ax.fill_between(history.t, value - half, value + half, color=colour, alpha=0.18, lw=0)
        ax.plot(history.t, value, color=colour, lw=1.4, label=label)
    shown = np.concatenate([h.values[:, i] for h in histories.values()])
    if name in truth:
        ax.axhline(truth[name], color=INK, lw=1.0, ls="--", label="truth")
        shown = np.append(shown, truth[name])
    middle, reach = 0.5 * (shown.min() + shown.max()), 0.75 * np.ptp(shown)
    if reach > 0:
        ax.set_ylim(middle - reach, middle + reach)
    ax.set_title(f"{name}  [{first.units[i]}]", loc="left", fontsize=9)


@styled
def motion(t: Array, measured: Array, simulated: Mapping[str, Array], y_label: str) -> Figure:
    """One panel: a measured velocity (k,) behind simulated ones, in the order of COLOURS[1:]."""
    figure, ax = panel("", "time [s]", y_label)
    ax.plot(t, measured, color=INK, lw=3.2, alpha=0.35, label=MEASURED)
    for colour, dashes, (label, run) in zip(COLOURS[1:], _APART, simulated.items()):
        ax.plot(t, run, color=colour, lw=1.3, dashes=dashes, label=label)
    return figure


@styled
def curves(
    x: Array, models: Mapping[str, Array], title: str, x_label: str, y_label: str, **how: Any
) -> Figure:
    """One panel drawn by :func:`draw_curves`."""
    figure, ax = panel(title, x_label, y_label)
    draw_curves(ax, x, models, **how)
    return figure


def motion_panels(
    t: Array, models: Mapping[str, Array], label: str, key: str, measured: Array | None = None
) -> list[str]:
    """For a page: as :func:`motions`, each velocity apart, by :func:`curves`; ``label`` of the
    y-axis is filled in with `{name}` and `{unit}`, ``key`` begins the ids."""
    panels = []
    for i, name in enumerate("uvwpqr"):
        columns = {model: y[:, i] for model, y in models.items()}
        y_label = label.format(name=name, unit="m/s" if i < 3 else "rad/s")
        behind = None if measured is None else measured[:, i]
        drawn = curves(t, columns, name, "time [s]", y_label, measured=behind)
        panels.append(zoomable(drawn, f"{key}{i}"))
    return panels


@styled
def panel(
    title: str, x_label: str, y_label: str, size: tuple[float, float] = PANEL
) -> tuple[Figure, Axes]:
    """A small figure of one pair of axes."""
    figure = Figure(figsize=size, layout="constrained")
    ax = figure.subplots()
    ax.set(xlabel=x_label, ylabel=y_label)
    ax.set_title(title, loc="left", fontsize=9)
    return figure, ax


@styled
def draw_curves(
    ax: Axes,
    x: Array,
    models: Mapping[str, Array],
    *,
    measured: Array | None = None,
    shaded: Sequence[tuple[float, float]] = (),
    marker: str = "",
) -> None:
    """A curve (k,) over x (k,) for each of MODELS, broken at pauses, held-out spans shaded. Without
    ``measured`` the curves are errors, from zero."""
    steps = np.diff(x)
    pauses = 1 + np.flatnonzero(steps > _PAUSE * (np.median(steps) if len(steps) else 1.0))
    at = np.insert(x, pauses, 0.5 * (x[pauses - 1] + x[pauses]))
    for begin, end in shaded:
        if end > x[0] and begin < x[-1]:
            ax.axvspan(max(begin, x[0]), min(end, x[-1]), color=INK, alpha=0.08, lw=0)
    if measured is not None:
        behind = np.insert(measured, pauses, np.nan)
        ax.plot(at, behind, color=INK, lw=3.2, alpha=0.35, label=MEASURED)
    if measured is not None and np.isfinite(measured).any():
        low, high = np.nanmin(measured), np.nanmax(measured)
        reach = LIMIT * (high - low)
        drawn = np.concatenate([[low, high], *models.values()])
        drawn = np.clip(drawn[np.isfinite(drawn)], low - reach, high + reach)
        edge = 0.05 * np.ptp(drawn) + 1e-9
        ax.set_ylim(drawn.min() - edge, drawn.max() + edge)
    for label, y in models.items():
        colour, dashes = MODELS[label]
        line: dict[str, Any] = {"color": colour, "dashes": dashes or (None, None), "lw": 1.3}
        ax.plot(at, np.insert(y, pauses, np.nan), marker=marker, ms=2.5, label=label, **line)
    if measured is None:
        ax.set_ylim(bottom=0.0)
    if not marker and len(x) and x[0] < x[-1]:
        ax.set_xlim(x[0], x[-1])


@styled
def steering(
    t: Array,
    heading: Array,
    rudder: Array,
    simulated: Mapping[str, Array],
    title: str,
    units: tuple[str, str] = ("deg", "deg"),
) -> Figure:
    """Heading (k,) measured and simulated above, their difference and the rudder below."""
    figure = Figure(figsize=(7.4, 4.6), layout="constrained")
    upper, middle, lower = figure.subplots(3, 1, sharex=True, height_ratios=(2.2, 1.0, 1.0))
    known = np.isfinite(heading)
    upper.plot(t[known], heading[known], color=INK, lw=3.2, alpha=0.35, label=MEASURED)
    for colour, (label, y) in zip(COLOURS, simulated.items()):
        upper.plot(t, y, color=colour, lw=1.3, label=label)
        middle.plot(t[known], (y - heading)[known], color=colour, lw=1.1, label=label)
    lower.plot(t, rudder, color=INK, lw=1.0, label="input")
    upper.set_title(title, loc="left", fontsize=9)
    upper.set_ylabel(f"heading [{units[0]}]")
    middle.set_ylabel(f"error [{units[0]}]")
    lower.set(ylabel=f"input [{units[1]}]", xlabel="time [s]")
    upper.legend(loc="upper right", ncols=1 + len(simulated))
    upper.margins(y=0.18)
    return figure


@styled
def parity(measured: Array, fitted: Array, title: str, unit: str) -> Figure:
    """Fitted over measured values (k,), the line of equality behind."""
    figure, ax = panel(title, f"measured [{unit}]", f"fitted [{unit}]", _TALL)
    ends = [float(min(measured.min(), fitted.min())), float(max(measured.max(), fitted.max()))]
    ax.plot(ends, ends, color=INK, lw=1.0, alpha=0.5)
    ax.plot(measured, fitted, color=COLOURS[0], marker="o", ms=3.5, lw=0.0, alpha=0.7)
    return figure


@styled
def structures(sizes: Array, errors: Array, chosen: int, title: str, unit: str) -> Figure:
    """The cross-validated error of every structure tried over its number of terms."""
    figure, ax = panel(title, "terms", f"cross-validated error [{unit}]", _TALL)
    ax.plot(sizes, errors, color=COLOURS[0], marker="o", ms=4.0, lw=0.0, alpha=0.5, label="tried")
    ax.plot(
        sizes[chosen], errors[chosen], color=COLOURS[1], marker="o", ms=9.0, lw=0.0,
        fillstyle="none", mew=2.0, label="chosen",
    )  # fmt: skip
    ax.set_xticks(np.unique(sizes))
    ax.legend()
    return figure


@styled
def bars(groups: Sequence[str], models: Mapping[str, Array], title: str, y_label: str) -> Figure:
    """One panel: a bar for each of MODELS in every group; values (groups,)."""
    figure, ax = panel(title, "", y_label)
    draw_bars(ax, groups, models)
    return figure


@styled
def draw_bars(ax: Axes, groups: Sequence[str], models: Mapping[str, Array]) -> None:
    """As :func:`bars`, on given axes."""
    width = 0.8 / len(models)
    for i, (label, values) in enumerate(models.items()):
        at = np.arange(len(groups)) + (i - 0.5 * (len(models) - 1)) * width
        drawn = ax.bar(at, values, 0.92 * width, color=MODELS[label][0], label=label)
        ax.bar_label(drawn, fmt="%.2g", fontsize=6.5, padding=1)
    ax.set_xticks(np.arange(len(groups)), groups)
    ax.grid(False, axis="x")
    ax.margins(y=0.12)


@styled
def precision(names: Sequence[str], models: Mapping[str, Array], limit: float) -> Figure:
    """A row for each name: from the first to the last of the values (n,) in percent, logarithmic;
    ``limit`` is marked."""
    size = (5.2, 0.22 * len(names) + 1.0)
    figure, ax = panel("", "standard deviation [% of the value]", "", size)
    rows = np.arange(len(names))[::-1]
    first, *_, last = models.values()
    ax.hlines(rows, first, last, color=INK, lw=1.2, alpha=0.35)
    for colour, (label, values) in zip((COLOURS[1], COLOURS[0]), models.items()):
        ax.plot(values, rows, color=colour, marker="o", ms=5.0, lw=0.0, label=label)
    ax.axvline(limit, color=INK, lw=1.0, ls="--", alpha=0.6)
    ax.set_xscale("log")
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.set_yticks(rows, names)
    ax.margins(y=0.04)
    figure.legend(loc="outside upper left", ncols=len(models))
    return figure


@styled
def cloud(x: Array, y: Array, title: str, x_label: str, y_label: str, limit: float) -> Figure:
    """One panel of points (k,), with lines at y = +-limit where these are near."""
    figure, ax = panel(title, x_label, y_label)
    ax.plot(x, y, color=COLOURS[0], marker="o", ms=1.6, lw=0.0, alpha=0.35, rasterized=True)
    if np.abs(y).max() > 0.1 * limit:
        for side in (-limit, limit):
            ax.axhline(side, color=INK, lw=1.0, ls="--", alpha=0.5)
    return figure


@styled
def steps(t: Array, y: Array, title: str, x_label: str, y_label: str) -> Figure:
    """One panel of what is held from each instant (k,) to the next; thinned to its extremes.

    What is never negative is drawn from zero.
    """
    figure, ax = panel(title, x_label, y_label)
    group = max(1, len(t) // 1500)
    if group > 1:
        whole = len(t) // group * group
        blocks = y[:whole].reshape(-1, group)
        largest = np.abs(blocks).argmax(axis=1)
        t, y = t[:whole:group], blocks[np.arange(len(blocks)), largest]
    ax.step(t, y, color=COLOURS[0], lw=1.0, where="post", label=title)
    ax.set_xlim(t[0], t[-1])
    if y.min() >= 0.0:
        ax.set_ylim(0.0, 1.2 * y.max() + 1e-9)
    return figure


@styled
def way(
    x: Array, y: Array, title: str, x_label: str, y_label: str, half: tuple[float, float]
) -> Figure:
    """One panel of a path (k,) within a box of half sides ``half`` about its start."""
    figure, ax = panel(title, x_label, y_label, _TALL)
    right, top = half
    corners = [(-right, -top), (right, -top), (right, top), (-right, top), (-right, -top)]
    ax.plot(*zip(*corners), color=INK, lw=1.0, ls="--", alpha=0.5)
    ax.plot(x, y, color=COLOURS[0], lw=1.2)
    ax.plot(x[0], y[0], color=COLOURS[1], marker="o", ms=6.0, lw=0.0)
    ax.set_aspect("equal")
    return figure


@styled
def intervals(
    names: Sequence[str],
    rows: Mapping[str, tuple[Array, Array]],
    x_label: str,
    ax: Axes | None = None,
) -> Figure:
    """A row for each name: of every label a value (n,) and half of its 95 % interval (n,)."""
    if ax is None:
        ax = panel("", "", "", (7.0, 0.27 * len(names) + 1.1))[1]
    step = 0.7 / len(rows)
    for i, (colour, (label, (value, half))) in enumerate(zip(COLOURS, rows.items())):
        at = -np.arange(len(names)) - (i - 0.5 * (len(rows) - 1)) * step
        ax.errorbar(
            value, at, xerr=half, color=colour, fmt="o", ms=4.0, lw=1.6, capsize=2.5, label=label
        )
    ax.axvline(0.0, color=INK, lw=1.0, ls="--", alpha=0.6)
    ax.set_yticks(-np.arange(len(names)), names)
    ax.set_xlabel(x_label)
    ax.grid(False, axis="y")
    ax.margins(y=0.03)
    if len(rows) > 1:
        outside_legend(ax.figure, ax, "outside upper left")
    return cast(Figure, ax.figure)


@styled
def motions(
    t: Array, measured: Array | None, models: Mapping[str, Array], figure: Any = None
) -> Figure:
    """Six panels: the velocities (k, 6) measured, and of each of MODELS, at t (k,)."""
    drawn = figure or Figure((9.0, 5.2), layout="constrained")
    for i, ax in enumerate(drawn.subplots(3, 2, sharex=True).T.flat):
        columns = {label: y[:, i] for label, y in models.items()}
        if measured is None:
            ax.plot(t, next(iter(columns.values())), color=COLOURS[0], lw=1.3)
        else:
            draw_curves(ax, t, columns, measured=measured[:, i])
        ax.set_title(f"{'uvwpqr'[i]}  [{'m/s' if i < 3 else 'rad/s'}]", loc="left", fontsize=9)
        if i % 3 == 2:
            ax.set_xlabel("time [s]")
    if measured is not None:
        outside_legend(drawn, drawn.axes[0])
    return cast(Figure, drawn)


@styled
def fitted(
    names: Sequence[str],
    change: tuple[Array, Array],
    motion: tuple[Array, Array, Mapping[str, Array]],
) -> Figure:
    """Coefficients with their intervals, and beside them the arguments of :func:`motions`."""
    label = "change by the fit [%], with its 95 % interval"
    figure = Figure((11.5, max(5.4, 0.22 * len(names) + 1.2)), layout="constrained")
    left, right = cast(Any, figure.subfigures(1, 2, width_ratios=(1.0, 1.7)))
    intervals(names, {"fitted": change}, label, left.subplots())
    motions(*motion, right)
    return figure


@styled
def overview(title: str) -> tuple[Figure, tuple[Axes, Axes, Axes, Axes]]:
    """A figure of one wide pair of axes above three."""
    figure = Figure(figsize=(11.0, 5.6), layout="constrained")
    grid = figure.add_gridspec(2, 3)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, wrap=True)
    left, middle, right = (figure.add_subplot(grid[1, i]) for i in range(3))
    return figure, (figure.add_subplot(grid[0, :]), left, middle, right)


@styled
def outside_legend(figure: Any, ax: Axes, where: str = "outside lower left") -> None:
    """A legend of what is on the axes, outside of them."""
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc=where, ncols=len(labels))


def css(colour: str) -> str:
    """A colour of COLOURS as the style of a page may change it."""
    return f"var(--colour-{COLOURS.index(colour)}, {colour})"


@styled
def to_png(figure: matplotlib.figure.Figure) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


_TIME = "time [s]"


def zoomable(figure: matplotlib.figure.Figure, name: str = "") -> str:
    """:func:`to_svg`, and where it shows curves over time the numbers that a page makes charts of.

    Axes with the same limits in time are zoomed together; other pictures stay as they are.
    """
    drawn = to_svg(figure, name)
    axes = figure.axes
    if not axes or _TIME not in {ax.get_xlabel() for ax in axes}:
        return drawn
    charts = json.dumps([_chart(ax) for ax in axes], allow_nan=False).replace("<", "\\u003c")
    script = f"<script type='application/json' class='curves'>{charts}</script>"
    return f"<div class='zoom'>{drawn}{script}</div>"


def _chart(ax: Axes) -> dict[str, Any]:
    """The curves, bands and shaded spans on a pair of axes."""
    limits = _numbers(np.array(ax.get_xlim()))
    lines, bands = [], []
    for line in ax.get_lines():
        x, y = (np.asarray(part, dtype=float) for part in line.get_data())
        if line.get_transform() != ax.transData:  # a level across the axes
            x, y = np.array(ax.get_xlim()), np.full(2, y[0])
        label = str(line.get_label())
        _, dashes = MODELS.get(label, ("", (2.0, 1.0) if line.is_dashed() else ()))
        lines.append({
            "x": _numbers(x), "y": _numbers(y), "label": label.lstrip("_"),
            "width": line.get_linewidth(), "dash": [3.0 * d for d in dashes],
            "step": "steps" in line.get_drawstyle(),
            "marked": line.get_marker() not in ("", "None"),
            "colour": _named(str(line.get_color())), "alpha": line.get_alpha() or 1.0,
        })  # fmt: skip
    for band in ax.collections:
        corners = np.asarray(band.get_paths()[0].vertices)
        n = (len(corners) - 3) // 2  # there along one edge, back along the other
        there, back = corners[1 : n + 1], corners[n + 2 : 2 * n + 2][::-1]
        colour = matplotlib.colors.to_hex(band.get_facecolor()[0])
        bands.append({
            "x": _numbers(there[:, 0]), "low": _numbers(there[:, 1]), "high": _numbers(back[:, 1]),
            "colour": _named(colour), "alpha": band.get_alpha() or 1.0,
        })  # fmt: skip
    patches = [p for p in ax.patches if isinstance(p, Rectangle)]
    return {
        "x": limits, "y": _numbers(np.array(ax.get_ylim())), "title": ax.get_title(loc="left"),
        "label": ax.get_ylabel(), "lines": lines, "bands": bands,
        "spans": [[p.get_x(), p.get_x() + p.get_width()] for p in patches],
    }  # fmt: skip


def _numbers(values: Array) -> list[float | None]:
    """To five digits, which is a tenth of a pixel; null for what does not exist."""
    return [float(f"{x:.5g}") if np.isfinite(x) else None for x in values.tolist()]


def _named(colour: str) -> str:
    """A colour as the page's style may change it."""
    return "currentColor" if colour == INK else css(colour) if colour in COLOURS else colour


@styled
def to_svg(figure: matplotlib.figure.Figure, name: str = "") -> str:
    """An svg element without XML head, to stand inside a page.

    Ink and COLOURS follow the style of the page (``color``, ``--colour-0`` ...). ``name`` keeps
    the ids of several pictures on one page apart.
    """
    buffer = BytesIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", metadata=metadata, transparent=True)
    text = buffer.getvalue().decode()
    text = text[text.index("<svg") :]
    text = text.replace(INK, "currentColor")
    for colour in COLOURS:
        text = text.replace(colour, css(colour))
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", text)
    used = set(re.findall(r"[(\"]#([\w-]+)[)\"]", text))
    text = re.sub(r' id="([\w.-]+)"', lambda m: f' id="{name}{m[1]}"' if m[1] in used else "", text)
    return re.sub(r"([(\"]#)([\w-]+[)\"])", rf"\g<1>{name}\g<2>", text)
