"""The page of `nomoto`: what was fitted, and how well."""

from collections.abc import Mapping, Sequence

import numpy as np

from rov_ident.reports import html as report
from rov_ident.reports import plots
from rov_ident.reports.table import estimate
from rov_ident.steering import nomoto_model
from rov_ident.steering.nomoto_model import Nomoto
from rov_ident.steering.zigzag import Zigzag

_EQUATIONS = {
    1: "T r' + r{} = K (delta - delta_0)",
    2: "T1 T2 r'' + (T1 + T2) r' + r{} = K (delta - delta_0) + K T3 delta'",
}
_METHODS = {
    "oe": "output error: the simulated heading fitted to the measured one",
    "fd": "least squares on forward differences",
    "iv": "forward differences with instruments from the simulated heading",
    "ukf": "an unscented Kalman filter whose state holds the parameters",
    "rls": "recursive least squares on forward differences, with dynamic forgetting",
}


def page(
    model: Nomoto,
    runs: Sequence[Zigzag],
    judge: Zigzag | None,
    others: Mapping[str, Nomoto] | None = None,
) -> str:
    """The page of a Nomoto fit; ``others`` are fits by other methods, for comparison."""
    cubic = " + n3 r^3" if model.structure.nonlinear else ""
    sections = [
        report.numbers(model),
        report.paragraph(
            f"{_EQUATIONS[model.order].format(cubic)}, r = d(heading)/dt; fitted by "
            f"{_METHODS[model.estimator]}."
        ),
        *(_run(model, run, "fitted", f"run{i}-") for i, run in enumerate(runs)),
    ]
    if judge is not None:
        heading = report.heading("On a run not used for the fit")
        sections += [heading, _run(model, judge, "predicted", "judge-")]
    sections += [report.bullets(model.notes)] if model.notes else []
    if model.cross_validation:
        errors = " and ".join(
            f"{np.degrees(error):.3g} deg with order {order}"
            for order, error in model.cross_validation.items()
        )
        sections.append(report.paragraph(f"Parts of the runs left out are predicted to {errors}."))
    if others:
        rows = []
        for name, other in {model.estimator: model, **others}.items():
            # K and T are the first two of every model
            pairs = list(zip(other.values, other.quantile * other.std))[:2]
            cells = [f"{value:.4g} ± {half:.2g}" for value, half in pairs]
            rows.append([_METHODS[name], *cells, f"{np.degrees(other.rmse):.3g}"])
        head = ["", f"K [{model.units[0]}]", "T [s]", "heading RMSE [deg]"]
        legend = "± is half of the 95 % interval, coloured noise allowed for."
        sections += [report.heading("By other estimators"), report.table(head, rows)]
        sections.append(report.paragraph(legend))
    halves = model.quantile * model.std
    told = zip(model.names, model.values, halves, model.units)
    main = [
        f"{n} = {' ± '.join(estimate(float(x), float(h)))} {unit}"
        for n, x, h, unit in told
        if n[0] in "KT"
    ]
    lead = f"{', '.join(main)}. Heading RMSE {np.degrees(model.rmse):.3g} deg on what was fitted"
    if judge is not None:
        lead += f", {np.degrees(nomoto_model.predict(model, judge)[1]):.3g} deg on {judge.name}"
    names = ", ".join(run.name for run in runs)
    return report.page(f"Nomoto's model from {names}", lead, sections, report.origin(model))


def _run(model: Nomoto, run: Zigzag, word: str, name: str) -> str:
    simulated, rmse = nomoto_model.predict(model, run)
    angle = run.unit == "rad"
    figure = plots.steering(
        run.t,
        np.degrees(run.heading),
        np.degrees(run.rudder) if angle else run.rudder,
        {word: np.degrees(simulated)},
        f"{run.name}: RMSE {np.degrees(rmse):.3g} deg",
        ("deg", "deg" if angle else run.unit),
    )
    caption = "Open loop from a fitted first state: only the input is given along the way."
    return report.figure(plots.zoomable(figure, name), caption)
