"""The page of `forces`: what was fitted, how well, and why this structure."""

from collections.abc import Mapping, Sequence

import numpy as np

from rov_ident.core.messages import Array
from rov_ident.model.coefficients import AXES, WRENCH_UNITS
from rov_ident.offline.captive_tests import AxisFit, headline
from rov_ident.reports import html as report
from rov_ident.reports import plots
from rov_ident.reports.table import estimate

_LISTED = 8  # structures below the pictures, or so many that the chosen one is among them


def page(name: str, fits: Mapping[str, AxisFit], notes: Sequence[str] = ()) -> str:
    sections = [headline(fits).html()]
    sections += [report.bullets(notes)] if notes else []
    for axis, f in fits.items():
        unit = WRENCH_UNITS[AXES.index(axis)]
        sizes: Array = np.array([len(c.terms) for c in f.candidates], dtype=np.float64)
        errors: Array = np.array([c.cv_rmse for c in f.candidates], dtype=np.float64)
        chosen = [set(c.terms) for c in f.candidates].index(set(f.names))
        listed = f.candidates[: max(_LISTED, chosen + 1)]
        tried = [[" ".join(c.terms), f"{c.cv_rmse:.4g}"] for c in listed]
        sections += [
            report.heading(f"{axis}: R2 {f.r2:.4f}, residual {f.rmse:.3g} {unit}"),
            report.panels(
                [
                    plots.to_svg(plots.parity(f.measured, f.fitted, axis, unit), f"fit-{axis}-"),
                    plots.to_svg(
                        plots.structures(sizes, errors, chosen, "structures tried", unit),
                        f"tried-{axis}-",
                    ),
                ],
                "Left: every row of the table. Right: the best structures that were tried.",
            ),
            report.paragraph(f"Chosen because: {f.why}."),
            report.table(["structure", f"cross-validated error [{unit}]"], tried),
        ]
    lead = "; ".join(
        f"{name} = {' ± '.join(estimate(value, half))} {unit}"
        for f in fits.values()
        for name, unit, value, half in zip(f.names, f.units, f.values, f.quantile * f.std)
    )
    origin = report.origin(next(iter(fits.values())))
    return report.page(f"Coefficients from {name}", lead, sections, origin)
