"""Nomoto's steering model fitted to zigzag tests: see `nomoto_model` for its equations.

Four estimators: output error (`oe`: the simulated heading is fitted, first state estimated; white
heading noise does not bias it), forward differences (`fd`: the equation itself, least squares, as
in the literature on sparse zigzags), the same with instruments (`iv`) and recursive (`rls`).
"""

import contextlib
import dataclasses
from collections.abc import Sequence

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.reports.result import provenance
from rov_ident.steering import heading_interpolation as densify
from rov_ident.steering.nomoto_equation_error import equation_error
from rov_ident.steering.nomoto_model import Nomoto, predict, rmse
from rov_ident.steering.nomoto_output_error import output_error
from rov_ident.steering.zigzag import Zigzag

METHODS = ("oe", "fd", "iv", "rls")
_MIN_SAMPLES = 20


def fit(
    runs: Sequence[Zigzag],
    order: int = 1,
    nonlinear: bool = False,
    method: str = "oe",
    interpolate: str = "none",
    step: float | None = None,
) -> Nomoto:
    """One model for all runs.

    ``interpolate`` densifies sparse headings first (:func:`dense`), to ``step`` [s].

    Raises UserError for runs too short, at rest, of different kinds, or with which the fit does not
    converge.
    """
    if order not in (1, 2):
        raise UserError(f"the order is 1 or 2, not {order}")
    if method not in METHODS:
        raise UserError(f"there is no method '{method}': choose one of {', '.join(METHODS)}")
    if not runs:
        raise UserError("no run is given: name at least one file")
    for run in runs:
        check(run, order, nonlinear)
        if run.unit != runs[0].unit:
            raise UserError(
                f"{run.name} has an input in {run.unit}, but {runs[0].name} in {runs[0].unit}: fit "
                "runs of one kind together"
            )
    used = [run.cornered() for run in runs]
    if interpolate != "none":
        used = [dense(run, interpolate, step) for run in runs]
    model = output_error(used, order, nonlinear)
    if method != "oe":
        model = equation_error(used, model, method)
    measured = np.concatenate(
        [run.heading - predict(model, run, u)[0] for run, u in zip(runs, used)]
    )
    notes = list(model.notes)
    if model.theta[0] <= 0.0:
        notes.append(
            "T is not positive: the vehicle has no course stability in this model; K and T then "
            "describe the slope of an unstable balance"
        )
    elif order == 2 and "T1" not in model.names:
        notes.append("T1 and T2 are complex: only T1T2 and T1_plus_T2 are given")
    return dataclasses.replace(
        model,
        rmse=rmse(measured),
        notes=tuple(notes),
        provenance=provenance((run.name, run.sha256) for run in runs),
    )


def others(
    model: Nomoto, runs: Sequence[Zigzag], interpolate: str = "none", step: float | None = None
) -> dict[str, Nomoto]:
    """The same model by every other method that succeeds, by name."""
    found = {}
    for method in METHODS:
        if method != model.estimator:
            with contextlib.suppress(UserError, np.linalg.LinAlgError):
                found[method] = fit(runs, model.order, model.nonlinear, method, interpolate, step)
    return found


def check(run: Zigzag, order: int = 1, nonlinear: bool = False) -> None:
    """Whether a run can tell anything about the model.

    Raises UserError: too few headings, or a rudder or heading that never moves.
    """
    known = run.heading[run.known]
    if len(known) < _MIN_SAMPLES:
        raise UserError(
            f"{run.name} has {len(known)} headings, but a fit of order {order} needs at least "
            f"{_MIN_SAMPLES}: give a longer run"
        )
    for name, values in (("rudder", run.rudder), ("heading", known)):
        if np.ptp(values) < 1e-6:
            raise UserError(
                f"{run.name}: the {name} is constant, so nothing can be identified: give a zigzag"
            )


def dense(run: Zigzag, method: str, step: float | None = None) -> Zigzag:
    """The run with a heading at every row, or where all rows have one, at every ``step`` [s].

    The default step is a fifth of the heading's. The rudder keeps what is known of it: rows
    between headings as they are, else straight lines.
    """
    known, t, fine = run.known, run.t, run.cornered()
    if step is not None or known.all():
        step = step or run.step / 5.0
        t = t[0] + step * np.arange(int(np.floor((t[-1] - t[0]) / step + 1e-6)) + 1)
    inside = (t >= run.t[known][0] - 1e-9) & (t <= run.t[known][-1] + 1e-9)
    t = t[inside]
    heading = densify.densify(run.t[known], run.heading[known], t, method)
    return dataclasses.replace(
        run, t=t, heading=heading, rudder=np.interp(t, fine.t, fine.rudder), held=False
    )
