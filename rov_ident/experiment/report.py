"""The pages of `check` and `plan`: what a dive would tell, and which to make next."""

from collections.abc import Sequence
from importlib.metadata import version

import numpy as np

from rov_ident.config import Config
from rov_ident.core.messages import Array
from rov_ident.core.states import CONVERGED
from rov_ident.experiment.data_quality import Check, Prospect
from rov_ident.experiment.design import Proposal
from rov_ident.experiment.messages_alone import BAD, GOOD, WARNING
from rov_ident.model.coefficients import AXES, VELOCITIES, WRENCH_UNITS
from rov_ident.model.scales import authority
from rov_ident.reports import html as report
from rov_ident.reports import plots
from rov_ident.sampling.records import HORIZON, UNITS, measured_motion, predicted

_MOST = 2000  # points of a curve


def of_check(found: Check) -> str:
    """A self-contained HTML document about a bag."""
    config = found.config
    bad, doubtful, good = (
        [f"{r.level}: {r.subject}: {r.text}" for r in found.remarks if r.level == level]
        for level in (BAD, WARNING, GOOD)
    )
    sections = [
        *([report.bullets(bad + doubtful)] if bad or doubtful else []),
        report.heading("What a quick fit tells"),
        report.beside_table(
            [p.html() for p in found.table().parts[1:]], [_precision(check_picture(found))]
        ),
        report.heading("Excitation"),
        _excitation(found, config),
        report.heading("Measured, and the simulation as configured"),
        _motion(found, config),
        report.heading("Pauses between messages"),
        _pauses(found),
        report.heading("What is as it should be"),
        report.bullets(good),
    ]
    footer = f"rov_ident {version('rov_ident')}; {found.bag} {found.record.sha256[:12]}"
    return report.page(f"Check of {found.bag} for {config.name}", found.sentence, sections, footer)


def of_plan(found: Proposal) -> str:
    """A self-contained HTML document about the manoeuvre to run next."""
    best, config = found.best, found.config
    dive = best.dive(config, seed=0)
    others = [[name, f"{100.0 * s:.1f} %"] for name, s in found.others if np.isfinite(s)]
    sections = [
        report.heading("What it would tell"),
        report.beside_table([found.table().html()], [_precision(plan_picture(found))]),
        report.heading("The manoeuvre"),
        _demand(best.flight.t, best.flight.demand),
        _path_panel(dive.truth.position, best.limits.tank),
        report.heading("Manoeuvres compared"),
        report.paragraph(
            "By the standard deviation of the coefficient known worst afterwards, relative to its "
            "value or, where that is small, to a fifth of what is usual."
        ),
        report.table(["manoeuvre", "worst"], others),
    ]
    if said := (*found.left_out, *found.notes):
        sections.append(report.bullets(said))
    lead = f"{found.sentence[:1].upper()}{found.sentence[1:]}."
    return report.page(
        f"Next manoeuvre for {config.name}", lead, sections, f"rov_ident {version('rov_ident')}"
    )


def _known(prospects: Sequence[Prospect], **stds: Sequence[float]) -> plots.Figure:
    """Standard deviations relative to the values, in percent, by label."""
    size = 0.01 * np.array([abs(p.value) or p.prior_std for p in prospects])
    shares = {label.replace("_", " "): np.array(std) / size for label, std in stds.items()}
    return plots.precision([p.name for p in prospects], shares, 100.0 * CONVERGED)


def check_picture(found: Check) -> plots.Figure:
    now, then = ([p.prior_std for p in found.prospects], [p.std for p in found.prospects])
    return _known(found.prospects, configured=now, after_a_fit=then)


def plan_picture(found: Proposal) -> plots.Figure:
    now, then = ([p.std for p in known] for known in (found.before, found.after))
    return _known(found.before, now=now, after_it=then)


def _precision(figure: plots.Figure) -> str:
    caption = (
        "Standard deviation relative to the value; left of the dashed line a coefficient "
        "counts as known well."
    )
    return report.figure(plots.zoomable(figure, "precision"), caption)


def _excitation(found: Check, config: Config) -> str:
    """Velocity against wrench: what is covered, in both directions."""
    samples = found.record.samples
    keep = slice(None, None, max(1, len(samples) // _MOST))
    nu, tau = measured_motion(samples)[keep], samples["wrench"][keep]
    limits = authority(config.dynamics)
    pictures = []
    for i, (axis, name) in enumerate(zip(AXES, VELOCITIES, strict=True)):
        unit, force = UNITS[i], WRENCH_UNITS[i]
        figure = plots.cloud(
            nu[:, i], tau[:, i], f"{axis} against {name}", f"{name} [{unit}]", f"{axis} [{force}]",
            limits[i],
        )  # fmt: skip
        pictures.append(plots.zoomable(figure, f"cloud{i}"))
    caption = (
        "Every sample: wrench over velocity. The dashed lines are the wrench that holds working "
        "speed. Two empty halves: what differs ahead and astern does not show."
    )
    return report.panels(pictures, caption)


def _motion(found: Check, config: Config) -> str:
    samples = found.record.samples
    run = predicted(config.dynamics, samples, HORIZON)
    keep = slice(None, None, max(1, len(samples) // _MOST))
    t, nu = samples["t"][keep], measured_motion(samples)[keep]
    models = {"as configured": run[keep]}
    pictures = plots.motion_panels(t, models, "{name} [{unit}]", "motion", nu)
    caption = f"Measured (grey), and simulated open loop in windows of {HORIZON:g} s."
    return report.panels(pictures, caption, wide=True)


def _pauses(found: Check) -> str:
    streams = found.streams
    pictures = []
    for name, t in (("odometry", streams.t), ("imu", streams.imu_t), ("wrench", streams.demand_t)):
        if len(t) < 3:
            continue
        figure = plots.steps(t[1:], 1e3 * np.diff(t), name, "time [s]", "ms since the last")
        pictures.append(plots.zoomable(figure, f"pause-{name}"))
    return report.panels(pictures, "Time between the stamps of two messages, largest of its span.")


def _demand(t: Array, demand: Array) -> str:
    pictures = []
    for i, axis in enumerate(AXES):
        figure = plots.steps(t, demand[:, i], axis, "time [s]", f"{axis} [{WRENCH_UNITS[i]}]")
        pictures.append(plots.zoomable(figure, f"demand{i}"))
    return report.panels(pictures, "The wrench that is asked for.", wide=True)


def _path_panel(position: Array, tank: Sequence[float]) -> str:
    length, width, depth = tank
    moved = position - position[0]
    keep = slice(None, None, max(1, len(moved) // _MOST))
    north, east, down = moved[keep].T
    half = 0.5 * width, 0.5 * length
    above = plots.way(east, north, "from above", "east [m]", "north [m]", half)
    half = 0.5 * length, 0.5 * depth
    aside = plots.way(north, -down, "from the side", "north [m]", "up [m]", half)
    svgs = [plots.zoomable(above, "above"), plots.zoomable(aside, "aside")]
    return report.panels(svgs, "The way of the simulated vehicle; dashed: the free water.")
