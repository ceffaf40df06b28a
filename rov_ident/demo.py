"""The main job on the shipped bag: two live nodes, the coefficients converging, a report."""

import math
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table

from rov_ident import config as configuration
from rov_ident import plots, report
from rov_ident.config import Config
from rov_ident.errors import UserError
from rov_ident.fit import write_text
from rov_ident.online import Report
from rov_ident.records import HORIZON, VELOCITIES, Record, predicted, read_record, score

ESTIMATORS = ("rls", "ukf")
UNITS = ("m/s",) * 3 + ("rad/s",) * 3
_FOLDERS = (Path(__file__).resolve().parents[1], Path(sys.prefix) / "share" / "rov_ident")


def shipped(name: str) -> Path:
    """A file that comes with the project: beside the package, or where it was installed.

    Raises
    ------
    UserError
        If it is in neither place.
    """
    for folder in _FOLDERS:
        if (folder / name).exists():
            return folder / name
    raise UserError(f"{name} is not here: run the demo from a checkout of the project")


def demo(out: Path, rate: float, err: Console, console: Console) -> None:
    """Replay the shipped bag over DDS into both nodes and report against the simulator's truth."""
    from rov_ident.nodes.replay import replay

    bag, start = shipped("bags/demo.mcap"), shipped("config/bluerov2_heavy_demo.yaml")
    config = configuration.load(start)
    model = configuration.load(shipped("config/bluerov2_heavy.yaml")).model
    truth = dict(zip(model.names, model.theta.tolist(), strict=True))
    seen: dict[str, list[Report]] = {name: [] for name in ESTIMATORS}

    err.print(
        f"Playing {bag.name} over DDS at {rate:g} x into rls_node and ukf_node, which start from "
        f"{start.name}: coefficients off by up to 50 %."
    )
    with Live(console=err, refresh_per_second=4, transient=True) as live:

        def show(name: str, state: Report) -> None:
            if state.stamp:
                seen[name].append(state)
                live.update(_table(config, truth, seen))

        coefficients = out / "coefficients.mcap"
        out.mkdir(parents=True, exist_ok=True)
        result = replay(bag, start, ESTIMATORS, rate, coefficients, show)
    console.print(_table(config, truth, seen))

    record = read_record(bag, config)
    histories = {name: _history(reports) for name, reports in seen.items()}
    path = out / "report.html"
    write_text(path, _page(config, truth, histories, record))
    (out / "convergence.png").write_bytes(plots.to_png(plots.convergence(histories, truth)))
    for name, history in histories.items():
        true = np.array([truth[n] for n in history.names])
        error = np.abs(history.values[-1] / true - 1.0)
        z = np.abs(history.values[-1] - true) / history.std[-1]
        console.print(
            f"{name}: error median {100 * np.median(error):.2f} %, largest {100 * error.max():.1f} "
            f"% ({history.names[int(np.argmax(error))]}); {np.sum(z < 1.96)} of {len(z)} true "
            "values inside their 95 % interval"
        )
    console.print(f"{result.messages} messages in {result.seconds:.1f} s; report: {path}")


def _table(config: Config, truth: dict[str, float], seen: dict[str, list[Report]]) -> Table:
    # Lines between the columns would need more than 80 characters.
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("")
    for column in ("truth", "start", *ESTIMATORS, "unit"):
        table.add_column(column, justify="left" if column == "unit" else "right")
    latest = {name: reports[-1] for name, reports in seen.items() if reports}
    for i, name in enumerate(config.estimate):
        cells = []
        for estimator in ESTIMATORS:
            state = latest.get(estimator)
            if state is None:
                cells.append("")
                continue
            colour = ("green", "yellow", "red", "dim")[state.levels[i]]
            cells.append(f"[{colour}]{state.values[i]:.4g} ± {1.96 * state.std[i]:.2g}[/]")
        start = config.value(name)
        unit = config.model.coefficients[config.model.names.index(name)].unit
        table.add_row(name, f"{truth[name]:.4g}", f"{start:.4g}", *cells, unit)
    return table


def _history(reports: list[Report]) -> plots.History:
    return plots.History(
        np.array([(r.stamp - reports[0].stamp) * 1e-9 for r in reports]),
        reports[0].names,
        reports[0].units,
        np.array([r.values for r in reports]),
        np.array([r.std for r in reports]),
    )


def _page(
    config: Config, truth: dict[str, float], histories: dict[str, plots.History], record: Record
) -> str:
    models = {"as configured": config.model}
    for name, history in histories.items():
        values = dict(zip(history.names, history.values[-1].tolist(), strict=True))
        models[f"identified by {name}"] = config.model.with_values(values)
    samples = record.samples
    stretch = samples["t"] < 60.0
    runs = {label: predicted(model, samples, math.inf) for label, model in models.items()}
    scores = {label: score(model, samples) for label, model in models.items()}
    rows = [[label, *(f"{value:.4f}" for value in scores[label].rmse)] for label in models]
    coefficients = [
        [name, f"{truth[name]:.5g}"]
        + [
            f"{history.values[-1, i]:.5g} ± {1.96 * history.std[-1, i]:.2g}"
            for history in histories.values()
        ]
        + [history.units[i]]
        for i, name in enumerate(history.names)
    ]
    colours = [plots.css(colour) for colour in plots.COLOURS]
    return report.page(
        f"{config.name}: coefficients identified live",
        f"Both nodes started from coefficients off by up to 50 % and saw {record.duration:.0f} s "
        "of simulated odometry, IMU and thruster wrench, replayed over DDS.",
        [
            report.heading("Coefficients converging to the simulator's truth"),
            report.legend(
                {n: (c, "", 1.0) for n, c in zip(histories, colours)}
                | {"truth": ("currentColor", "6,4", 1.0)}
            ),
            report.panels(
                [
                    plots.to_svg(plots.history(histories, truth, i), f"history{i}")
                    for i in range(len(config.estimate))
                ],
                "Published values over the time of the bag with their 95 % intervals; dashed: the "
                "coefficients the bag was simulated with.",
            ),
            report.table(
                ["", "truth", *histories, "unit"], coefficients, text=[2 + len(histories)]
            ),
            report.heading("What it means for a simulation"),
            report.legend(
                {"measured": ("currentColor", "", 0.35)}
                | {label: (c, "", 1.0) for label, c in zip(runs, colours[1:])}
            ),
            report.panels(
                [
                    plots.to_svg(
                        plots.motion(
                            samples["t"][stretch],
                            samples["nu"][stretch, i],
                            {label: run[stretch, i] for label, run in runs.items()},
                            f"{name} [{unit}]",
                        ),
                        f"motion{i}",
                    )
                    for i, (name, unit) in enumerate(zip(VELOCITIES, UNITS))
                ],
                "The first minute: open-loop simulation from the first state, driven by the "
                "recorded wrench alone, before and after.",
                wide=True,
            ),
            report.paragraph(f"Root mean square error over open-loop windows of {HORIZON:g} s:"),
            report.table(["", *(f"{n} [{u}]" for n, u in zip(VELOCITIES, UNITS))], rows),
        ],
        f"rov_ident {version('rov_ident')}, bag {record.path.name}, sha256 {record.sha256[:16]}",
    )
