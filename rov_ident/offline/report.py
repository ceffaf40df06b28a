"""The page of a fit: coefficients, and the open-loop simulation before and after."""

from collections.abc import Sequence

import numpy as np

from rov_ident.core.messages import Array
from rov_ident.model.coefficients import VELOCITIES
from rov_ident.offline.fit import Fit
from rov_ident.offline.prediction_error import Curves
from rov_ident.reports import plots
from rov_ident.reports.html import beside_table, bullets, heading, legend, origin, panels, paragraph
from rov_ident.reports.html import page as document
from rov_ident.reports.table import Tables
from rov_ident.sampling.records import HORIZON

_BEFORE, _AFTER = "as configured", "retuned"
_MOST = 4  # bags that are drawn


def page(fit: Fit) -> str:
    """A self-contained HTML document: the coefficients first, then the evidence."""
    shown = fit.table()
    coefficients = shown.parts[0] if isinstance(shown, Tables) else shown
    judged, drawn = fit.judged, fit.curves
    sections = [
        beside_table(
            [heading("Coefficients"), coefficients.html()],
            [heading("What to do next"), bullets(fit.advice)],
        ),
        heading(f"Open-loop simulation in windows of {HORIZON:g} s, before and after"),
        legend({label: (plots.css(colour), ",".join(str(3 * d) for d in dashes), 1.0)
                for label, (colour, dashes) in plots.MODELS.items()
                if label in (_BEFORE, _AFTER)}),
    ]  # fmt: skip
    if judged:
        sections += [heading("On the bag to validate"), *_curves(judged, "judged")]
    if drawn:
        sections += [heading("On what was fitted"), *_curves(drawn, "fitted")]
    if fit.notes:
        sections += [heading("Notes"), bullets(fit.notes)]
    return document(f"Fit of {fit.given.name}", fit.sentence, sections, origin(fit))


def _curves(drawn: Sequence[Curves], key: str) -> list[str]:
    before = _rmse([c.before - c.measured for c in drawn])
    after = _rmse([c.after - c.measured for c in drawn])
    sections = [_bars(before, after, key)]
    for k, curve in enumerate(drawn[:_MOST]):
        name = curve.name
        simulated = (curve.before, curve.after)
        errors = [np.abs(x - curve.measured) for x in simulated]
        sections += [
            _motion(curve, simulated, "{name} [{unit}]", curve.measured,
                    f"{name}: measured (grey) and simulated", f"{key}-m{k}"),
            _motion(curve, errors, "|error| [{unit}]", None,
                    f"{name}: error of the simulation", f"{key}-e{k}"),
        ]  # fmt: skip
    if len(drawn) > _MOST:
        sections.append(paragraph(f"The first {_MOST} of {len(drawn)} bags are drawn."))
    return sections


def _rmse(errors: Sequence[Array]) -> Array:
    joined = np.concatenate(errors)
    known = np.isfinite(joined).any(axis=0)  # without a velocity sensor u, v, w are not
    joined = joined[np.isfinite(joined[:, known]).all(axis=1)]
    return np.sqrt(np.mean(joined**2, axis=0)) if len(joined) else np.full(6, np.nan)


def _bars(before: Array, after: Array, key: str) -> str:
    parts = []
    for label, pick, unit in (
        ("linear", slice(0, 3), "m/s"), ("angular", slice(3, 6), "rad/s")
    ):  # fmt: skip
        if not np.isfinite(before[pick]).any():
            continue  # not measured
        models = {_BEFORE: before[pick], _AFTER: after[pick]}
        drawn = plots.bars(list(VELOCITIES[pick]), models, f"RMSE, {label} [{unit}]", unit)
        parts.append(plots.zoomable(drawn, f"{key}-{label}"))
    return panels(parts, "Root mean square error over all bags.")


def _motion(
    curve: Curves, pair: Sequence[Array], label: str, measured: Array | None, caption: str, key: str
) -> str:
    """Six panels of ``pair``, before and after (k, 6)."""
    models = dict(zip((_BEFORE, _AFTER), pair, strict=True))
    return panels(plots.motion_panels(curve.t, models, label, key, measured), caption, wide=True)
