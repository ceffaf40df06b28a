"""The pages of `check` and `plan`: what a dive would tell, and which to make next."""

from collections.abc import Mapping, Sequence
from importlib.metadata import version

import numpy as np

from rov_ident import plots, report
from rov_ident.check import BAD, GOOD, WARNING, WELL, Check, Prospect
from rov_ident.coefficients import VELOCITIES
from rov_ident.config import Config
from rov_ident.excitation import authority
from rov_ident.messages import Array
from rov_ident.plan import Proposal
from rov_ident.records import HORIZON, over_ground, predicted

_AXES = "XYZKMN"
_MOST = 2000  # points of a curve
_KNOWN = {"well": "well", "roughly": "roughly", "not": "no: the prior decides"}


def of_check(found: Check, config: Config) -> str:
    """A self-contained HTML document about a bag."""
    good = "fit for identification" if found.fit else "not fit for identification"
    known = sum(p.verdict == "well" for p in found.prospects)
    lead = (
        f"{found.duration:.0f} s, {good}: it would tell {known} of {len(found.prospects)} "
        "coefficients well."
    )
    order = (BAD, WARNING, GOOD)
    remarks = sorted(found.remarks, key=lambda r: order.index(r.level))
    shares = {"configured": _prior(found.prospects), "after a fit": _share(found.prospects)}
    numbers = [
        [p.name, f"{p.value:.4g}", f"{p.std:.2g}", p.unit, _KNOWN[p.verdict]]
        for p in found.prospects
    ]
    table = report.table(["", "configured", "std", "unit", "known"], numbers, text=(3, 4))
    said = [(r.level, f"{r.level}: {r.subject}: {r.text}") for r in remarks]
    doubts = [text for level, text in said if level != GOOD]
    sections = [
        *([report.bullets(doubts)] if doubts else []),
        report.heading("What a fit of it would tell"),
        report.beside([_precision(shares, found.prospects)], [table]),
        report.heading("Excitation"),
        _excitation(found, config),
        report.heading("Measured, and the simulation as configured"),
        _motion(found, config),
        report.heading("Pauses between messages"),
        _pauses(found),
        report.heading("What is as it should be"),
        report.bullets([text for level, text in said if level == GOOD]),
    ]
    footer = f"rov_ident {version('rov_ident')}; {found.bag} {found.record.sha256[:12]}"
    return report.page(f"Check of {found.bag} for {config.name}", lead, sections, footer)


def of_plan(found: Proposal, config: Config) -> str:
    """A self-contained HTML document about the manoeuvre to run next."""
    best = found.best
    dive = best.dive(config, seed=0)
    others = [[name, f"{100.0 * s:.1f} %"] for name, s in found.others if np.isfinite(s)]
    shares = {"now": _share(found.before), "after it": _share(found.after)}
    numbers = [
        [b.name, f"{b.value:.4g}", f"{b.std:.2g}", f"{a.std:.2g}", b.unit]
        for b, a in zip(found.before, found.after, strict=True)
    ]
    table = report.table(["", "configured", "std now", "std after it", "unit"], numbers, text=(4,))
    sections = [
        report.heading("What it would tell"),
        report.beside([_precision(shares, found.before)], [table]),
        report.heading("The manoeuvre"),
        _demand(best.flown.t, best.flown.demand),
        _way(dive.truth.position, best.limits.tank),
        report.heading("Manoeuvres compared"),
        report.paragraph(
            "By the standard deviation of the coefficient known worst afterwards, relative to its "
            "value or, where that is small, to a fifth of what is usual."
        ),
        report.table(["manoeuvre", "worst"], others),
    ]
    if found.left_out:
        sections.append(report.bullets(found.left_out))
    lead = f"{found.sentence[:1].upper()}{found.sentence[1:]}."
    return report.page(
        f"Next manoeuvre for {config.name}", lead, sections, f"rov_ident {version('rov_ident')}"
    )


# ------------------------------------------------------------------ pictures


def _share(prospects: Sequence[Prospect]) -> Array:
    """Standard deviations relative to the values, in percent."""
    return _relative(prospects, [p.std for p in prospects])


def _prior(prospects: Sequence[Prospect]) -> Array:
    return _relative(prospects, [p.prior_std for p in prospects])


def _relative(prospects: Sequence[Prospect], std: Sequence[float]) -> Array:
    size = np.array([abs(p.value) or p.prior_std for p in prospects])
    relative: Array = 100.0 * np.array(std) / size
    return relative


def _precision(models: Mapping[str, Array], prospects: Sequence[Prospect]) -> str:
    names = [p.name for p in prospects]
    figure = plots.precision(names, models, 100.0 * WELL)
    caption = (
        "Predicted standard deviation relative to the value; left of the dashed line a coefficient "
        "counts as known well."
    )
    return report.figure(plots.to_svg(figure, "precision"), caption)


def _excitation(found: Check, config: Config) -> str:
    """Velocity against wrench: what is covered, in both directions."""
    samples = found.record.samples
    keep = slice(None, None, max(1, len(samples) // _MOST))
    nu, tau = over_ground(samples)[keep], samples["wrench"][keep]
    limits = authority(config.dynamics)
    pictures = []
    for i, (axis, name) in enumerate(zip(_AXES, VELOCITIES, strict=True)):
        unit, force = _units(i)
        figure = plots.cloud(
            nu[:, i], tau[:, i], f"{axis} against {name}", f"{name} [{unit}]", f"{axis} [{force}]",
            limits[i],
        )  # fmt: skip
        pictures.append(plots.to_svg(figure, f"cloud{i}"))
    caption = (
        "Every sample: wrench over velocity. The dashed lines are the wrench that holds working "
        "speed. Two empty halves: what differs ahead and astern does not show."
    )
    return report.panels(pictures, caption)


def _motion(found: Check, config: Config) -> str:
    samples = found.record.samples
    run = predicted(config.dynamics, samples, HORIZON)
    keep = slice(None, None, max(1, len(samples) // _MOST))
    t, nu = samples["t"][keep], over_ground(samples)[keep]
    pictures = []
    for i, name in enumerate(VELOCITIES):
        figure = plots.curves(
            t, {"as configured": run[keep][:, i]}, name, "time [s]", f"{name} [{_units(i)[0]}]",
            measured=nu[:, i],
        )  # fmt: skip
        pictures.append(plots.to_svg(figure, f"motion{i}"))
    caption = f"Measured (grey), and simulated open loop in windows of {HORIZON:g} s."
    return report.panels(pictures, caption, wide=True)


def _pauses(found: Check) -> str:
    streams = found.streams
    pictures = []
    for name, t in (
        ("odometry", streams.t),
        ("imu", streams.imu_t),
        ("wrench", streams.demand_t),
    ):
        if len(t) < 3:
            continue
        figure = plots.steps(t[1:], 1e3 * np.diff(t), name, "time [s]", "ms since the last")
        pictures.append(plots.to_svg(figure, f"pause-{name}"))
    return report.panels(pictures, "Time between the stamps of two messages, largest of its span.")


def _demand(t: Array, demand: Array) -> str:
    pictures = []
    for i, axis in enumerate(_AXES):
        figure = plots.steps(t, demand[:, i], axis, "time [s]", f"{axis} [{_units(i)[1]}]")
        pictures.append(plots.to_svg(figure, f"demand{i}"))
    return report.panels(pictures, "The wrench that is asked for.", wide=True)


def _way(position: Array, tank: Sequence[float]) -> str:
    length, width, depth = tank
    moved = position - position[0]
    keep = slice(None, None, max(1, len(moved) // _MOST))
    north, east, down = moved[keep].T
    above = plots.way(
        east, north, "from above", "east [m]", "north [m]", (0.5 * width, 0.5 * length)
    )
    aside = plots.way(
        north, -down, "from the side", "north [m]", "up [m]", (0.5 * length, 0.5 * depth)
    )
    svgs = [plots.to_svg(above, "above"), plots.to_svg(aside, "aside")]
    return report.panels(svgs, "The way of the simulated vehicle; dashed: the free water.")


def _units(i: int) -> tuple[str, str]:
    return ("m/s", "N") if i < 3 else ("rad/s", "N m")
