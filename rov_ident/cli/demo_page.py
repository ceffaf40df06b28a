"""The page of `rov-ident demo`: the coefficients converging to the simulator's truth."""

import math
from collections.abc import Mapping, Sequence
from importlib.metadata import version

import numpy as np

from rov_ident.config import Config
from rov_ident.estimation.online import Report
from rov_ident.model.coefficients import VELOCITIES
from rov_ident.reports import html as report
from rov_ident.reports import plots
from rov_ident.reports.result import NORMAL
from rov_ident.reports.table import estimate
from rov_ident.sampling.records import HORIZON, UNITS, Record, predicted, score


def history_of(reports: Sequence[Report]) -> plots.History:
    return plots.History(
        np.array([(r.stamp - reports[0].stamp) * 1e-9 for r in reports]),
        reports[0].names,
        reports[0].units,
        np.array([r.values for r in reports]),
        np.array([r.std for r in reports]),
    )


def page(
    config: Config,
    truth: Mapping[str, float],
    histories: Mapping[str, plots.History],
    record: Record,
) -> str:
    models = {"as configured": config.model}
    for name, history in histories.items():
        values = dict(zip(history.names, history.values[-1].tolist(), strict=True))
        models[f"identified by {name}"] = config.model.with_values(values)
    samples = record.samples
    stretch = samples["t"] < 60.0
    t, measured = samples["t"][stretch], samples["nu"][stretch]
    runs = {name: predicted(model, samples, math.inf)[stretch] for name, model in models.items()}
    rows = []
    for name, model in models.items():
        rmse = score(samples, predicted(model, samples, HORIZON)).rmse
        rows.append([name, *(f"{value:.4f}" for value in rmse)])
    labels = [f"{name} [{unit}]" for name, unit in zip(VELOCITIES, UNITS)]
    motions = [
        plots.motion(t, measured[:, i], {name: run[:, i] for name, run in runs.items()}, label)
        for i, label in enumerate(labels)
    ]
    coefficients = [
        [name, f"{truth[name]:.5g}"]
        + [
            " ± ".join(estimate(history.values[-1, i], NORMAL * history.std[-1, i]))
            for history in histories.values()
        ]
        + [history.units[i]]
        for i, name in enumerate(history.names)
    ]
    true = np.array([truth[name] for name in next(iter(histories.values())).names])
    off = [
        f"{100 * np.median(np.abs(history.values[-1] / true - 1.0)):.2f} % by {name}"
        for name, history in histories.items()
    ]
    colours = [plots.css(colour) for colour in plots.COLOURS]
    return report.page(
        f"{config.name}: coefficients identified live",
        f"Both nodes started from coefficients off by up to 50 % and saw {record.duration:.0f} s "
        "of simulated odometry, IMU and thruster wrench, replayed over DDS. Now the median error "
        f"of a coefficient is {' and '.join(off)}.",
        [
            report.heading("Coefficients converging to the simulator's truth"),
            report.legend(
                {n: (c, "", 1.0) for n, c in zip(histories, colours)}
                | {"truth": ("currentColor", "6,4", 1.0)}
            ),
            report.panels(
                [
                    plots.zoomable(plots.history(histories, truth, i), f"history{i}")
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
                [plots.zoomable(motion, f"motion{i}") for i, motion in enumerate(motions)],
                "The first minute: open-loop simulation from the first state, driven by the "
                "recorded wrench alone, before and after.",
                wide=True,
            ),
            report.paragraph(f"Root mean square error over open-loop windows of {HORIZON:g} s:"),
            report.table(["", *labels], rows),
        ],
        f"rov_ident {version('rov_ident')}, bag {record.path.name}, sha256 {record.sha256[:16]}",
    )
