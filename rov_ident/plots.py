"""Pictures, each a function of results; the only module that knows matplotlib."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rov_ident.messages import Array

matplotlib.rcParams.update(
    {
        "svg.hashsalt": "rov_ident",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.alpha": 0.25,
        "font.size": 9,
        "legend.frameon": False,
    }
)

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")  # Okabe and Ito: told apart by everyone


@dataclass(frozen=True)
class History:
    """Coefficients over time as published: t (k,) [s], values and std (k, n)."""

    t: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    std: Array


def convergence(histories: Mapping[str, History], truth: Mapping[str, float]) -> Figure:
    """Every coefficient over time with its 95 % interval, and the truth where it is known."""
    first = next(iter(histories.values()))
    columns = 3
    rows = -(-len(first.names) // columns)
    figure = Figure(figsize=(11.0, 1.7 * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for ax in axes.flat[len(first.names) :]:
        ax.axis("off")
    for i, (ax, name) in enumerate(zip(axes.flat, first.names)):
        for colour, (label, history) in zip(COLOURS, histories.items()):
            value, half = history.values[:, i], 1.96 * history.std[:, i]
            ax.fill_between(history.t, value - half, value + half, color=colour, alpha=0.18, lw=0)
            ax.plot(history.t, value, color=colour, lw=1.4, label=label)
        shown = np.concatenate([h.values[:, i] for h in histories.values()])
        if name in truth:
            ax.axhline(truth[name], color="black", lw=1.0, ls="--", label="truth")
            shown = np.append(shown, truth[name])
        middle, reach = 0.5 * (shown.min() + shown.max()), 0.75 * np.ptp(shown)
        if reach > 0:
            ax.set_ylim(middle - reach, middle + reach)
        ax.set_title(f"{name}  [{first.units[i]}]", loc="left", fontsize=9)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
    return figure


def open_loop(
    t: Array,
    measured: Array,
    simulated: Mapping[str, Array],
    components: Sequence[str],
    units: Sequence[str],
) -> Figure:
    """Measured velocities (k, 6) beside simulated ones, one panel a component."""
    figure = Figure(figsize=(11.0, 8.0), layout="constrained")
    axes: NDArray[np.object_] = figure.subplots(len(components), 1, sharex=True)
    for i, (ax, name, unit) in enumerate(zip(axes, components, units)):
        ax.plot(t, measured[:, i], color="black", lw=1.6, alpha=0.55, label="measured")
        for colour, (label, run) in zip(COLOURS[1:], simulated.items()):
            ax.plot(t, run[:, i], color=colour, lw=1.0, label=label)
        ax.set_ylabel(f"{name} [{unit}]")
    axes[-1].set_xlabel("time [s]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
    return figure


def to_png(figure: Figure, dpi: int = 110) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def to_svg(figure: Figure) -> str:
    """An svg element without XML head, to stand inside a page."""
    buffer = BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue().decode()
    return text[text.index("<svg") :]
