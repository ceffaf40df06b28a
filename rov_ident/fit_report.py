"""The page of a fit: coefficients, and the open-loop simulation before and after."""

from collections.abc import Sequence

import numpy as np

from rov_ident import plots
from rov_ident.batch import Curves
from rov_ident.config import Config
from rov_ident.fit import Fit
from rov_ident.messages import Array
from rov_ident.records import HORIZON, VELOCITIES
from rov_ident.report import bullets, heading, legend, origin, panels, paragraph, table
from rov_ident.report import page as document

_BEFORE, _AFTER = "as configured", "retuned"
_TITLES = {"ls": "least squares", "iv": "instrumental variables", "ml": "maximum likelihood",
           "rls": "recursive least squares", "ukf": "unscented Kalman filter"}  # fmt: skip
_MOST = 4  # bags that are drawn


def page(fit: Fit, config: Config, drawn: Sequence[Curves], judged: Sequence[Curves] = ()) -> str:
    """A self-contained HTML document; ``judged`` are runs that no fit has seen."""
    rows = []
    for i, name in enumerate(fit.names):
        was = config.model.theta[config.model.names.index(name)]
        state = "yes" if fit.identifiable[i] else "no: the prior decides"
        rows.append(
            [name, f"{fit.values[i]:.5g}", f"{fit.std[i]:.2g}", fit.units[i], f"{was:.5g}", state]
        )
    sections = [
        heading(f"Open-loop simulation in windows of {HORIZON:g} s, before and after"),
        legend({label: (plots.css(colour), ",".join(str(3 * d) for d in dashes), 1.0)
                for label, (colour, dashes) in plots.MODELS.items()
                if label in (_BEFORE, _AFTER)}),
    ]  # fmt: skip
    if judged:
        sections += [heading("On what no fit has seen"), *_curves(judged, "judged")]
    if drawn:
        sections += [heading("On what was fitted"), *_curves(drawn, "fitted")]
    sections += [
        heading("Coefficients"),
        table(["", "value", "std", "unit", "configured", "identifiable"], rows, text=(3, 5)),
    ]
    if fit.notes:
        sections += [heading("Notes"), bullets(fit.notes)]
    bags = len(fit.provenance["bags"])
    lead = (
        f"{_TITLES[fit.estimator].capitalize()} on {bags} bag{'s' * (bags != 1)}, "
        f"{fit.duration:.0f} s."
    )
    return document(f"Fit of {config.name}", lead, sections, origin(fit))


def _curves(drawn: Sequence[Curves], key: str) -> list[str]:
    before = _rmse([c.before - c.measured for c in drawn])
    after = _rmse([c.after - c.measured for c in drawn])
    sections = [_bars(before, after, key)]
    for k, curve in enumerate(drawn[:_MOST]):
        name = curve.name
        sections.append(_motion(curve, f"{name}: measured (grey) and simulated", f"{key}-m{k}"))
        sections.append(_error(curve, f"{name}: error of the simulation", f"{key}-e{k}"))
    if len(drawn) > _MOST:
        sections.append(paragraph(f"The first {_MOST} of {len(drawn)} bags are drawn."))
    return sections


def _rmse(errors: Sequence[Array]) -> Array:
    joined = np.concatenate(errors)
    joined = joined[np.isfinite(joined).all(axis=1)]
    rmse: Array = np.sqrt(np.mean(joined**2, axis=0)) if len(joined) else np.full(6, np.nan)
    return rmse


def _unit(i: int) -> str:
    return "m/s" if i < 3 else "rad/s"


def _bars(before: Array, after: Array, key: str) -> str:
    parts = []
    for label, pick in (("linear", slice(0, 3)), ("angular", slice(3, 6))):
        models = {_BEFORE: before[pick], _AFTER: after[pick]}
        unit = _unit(0 if label == "linear" else 3)
        drawn = plots.bars(VELOCITIES[pick], models, f"RMSE, {label} [{unit}]", unit)
        parts.append(plots.to_svg(drawn, f"{key}-{label}"))
    return panels(parts, "Root mean square error over all bags.")


def _motion(curve: Curves, caption: str, key: str) -> str:
    pictures = [
        plots.curves(
            curve.t, {_BEFORE: curve.before[:, i], _AFTER: curve.after[:, i]}, name, "time [s]",
            f"{name} [{_unit(i)}]", measured=curve.measured[:, i],
        )
        for i, name in enumerate(VELOCITIES)
    ]  # fmt: skip
    svgs = [plots.to_svg(p, f"{key}{i}") for i, p in enumerate(pictures)]
    return panels(svgs, caption, wide=True)


def _error(curve: Curves, caption: str, key: str) -> str:
    before, after = (np.abs(x - curve.measured) for x in (curve.before, curve.after))
    pictures = [
        plots.curves(
            curve.t, {_BEFORE: before[:, i], _AFTER: after[:, i]}, name, "time [s]",
            f"|error| [{_unit(i)}]",
        )
        for i, name in enumerate(VELOCITIES)
    ]  # fmt: skip
    svgs = [plots.to_svg(p, f"{key}{i}") for i, p in enumerate(pictures)]
    return panels(svgs, caption, wide=True)
