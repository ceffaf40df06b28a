"""The main job on the shipped bag: two live nodes, the coefficients converging, a report."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rov_ident.cli.common import ERR, LIVE, OUT, Commands, command, rate
from rov_ident.core.files import shipped, write_file

if TYPE_CHECKING:
    from rich.table import Table

    from rov_ident.config import Config
    from rov_ident.estimation.online import Report


def add(commands: Commands) -> None:
    text, files = "the main job on the shipped bag, live over DDS", "report.html convergence.png"
    demo = command(commands, "demo", text, _demo, "", f"{files} coefficients.mcap")
    demo.add_argument("--rate", type=rate, default=4.0, help="speed of the replay (default 4)")
    demo.add_argument(
        "--out", type=Path, default=Path("out/demo"), help="folder of the report (out/demo)"
    )


def _demo(options: argparse.Namespace) -> None:
    import numpy as np
    from rich.console import Console
    from rich.live import Live

    from rov_ident import config as configuration
    from rov_ident.cli import demo_page as pages
    from rov_ident.nodes.replay import replay
    from rov_ident.reports import plots
    from rov_ident.reports.result import NORMAL
    from rov_ident.sampling.records import read_record

    # Its own pictures are the progress: with --quiet there are none.
    err = Console(stderr=True, quiet=True) if options.quiet else ERR
    coefficients, path, picture = (
        options.out / name for name in ("coefficients.mcap", "report.html", "convergence.png")
    )
    bag, start = shipped("bags/demo.mcap"), shipped("config/bluerov2_heavy_demo.yaml")
    config = configuration.load(start)
    model = configuration.load(shipped("config/bluerov2_heavy.yaml")).model
    truth = dict(zip(model.names, model.theta.tolist(), strict=True))
    seen: dict[str, list[Report]] = {name: [] for name in LIVE}

    err.print(
        f"Playing {bag.name} over DDS at {options.rate:g} x into rls_node and ukf_node, which "
        f"start from {start.name}: coefficients off by up to 50 %."
    )
    with Live(console=err, refresh_per_second=4, transient=True) as live:

        def show(name: str, state: "Report") -> None:
            if state.stamp:
                seen[name].append(state)
                live.update(_table(config, truth, seen))

        result = replay(bag, start, LIVE, options.rate, coefficients, show)
    OUT.print(_table(config, truth, seen))

    record = read_record(bag, config)
    histories = {name: pages.history_of(reports) for name, reports in seen.items()}
    write_file(path, pages.page(config, truth, histories, record))
    write_file(picture, plots.to_png(plots.convergence(histories, truth)))
    for name, history in histories.items():
        true = np.array([truth[n] for n in history.names])
        begun = np.abs(np.array([config.value(n) for n in history.names]) / true - 1.0)
        error = np.abs(history.values[-1] / true - 1.0)
        z = np.abs(history.values[-1] - true) / history.std[-1]
        OUT.print(
            f"{name}: the median error of a coefficient fell from {100 * np.median(begun):.0f} % "
            f"to {100 * np.median(error):.2f} %, largest {100 * error.max():.1f} % "
            f"({history.names[int(np.argmax(error))]}); {np.sum(z < NORMAL)} of {len(z)} true "
            "values inside their 95 % interval"
        )
    OUT.print(f"{result.messages} messages in {result.seconds:.1f} s; report: {path}")


def _table(config: "Config", truth: dict[str, float], seen: "dict[str, list[Report]]") -> "Table":
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from rov_ident.reports.result import NORMAL

    # Lines between the columns would need more than 80 characters.
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("")
    for column in ("truth", "start", *LIVE, "unit"):
        table.add_column(column, justify="left" if column == "unit" else "right")
    latest = {name: reports[-1] for name, reports in seen.items() if reports}
    for i, name in enumerate(config.estimate):
        cells = []
        for estimator in LIVE:
            state = latest.get(estimator)
            if state is None:
                cells.append(Text())
                continue
            colour = ("green", "yellow", "red", "dim")[state.levels[i]]
            cells.append(Text(f"{state.values[i]:.4g} ± {NORMAL * state.std[i]:.2g}", colour))
        start = config.value(name)
        unit = config.model.coefficients[config.model.names.index(name)].unit
        table.add_row(name, f"{truth[name]:.4g}", f"{start:.4g}", *cells, unit)
    return table
