"""Nomoto's steering model fitted to zigzag tests: see `nomoto_model` for its equations.

Five estimators: output error (`oe`: the simulated heading is fitted, first state estimated; white
heading noise does not bias it), forward differences (`fd`: the equation itself, least squares, as
in the literature on sparse zigzags), the same with instruments (`iv`) and recursive (`rls`), and an
unscented Kalman filter whose state holds the parameters (`ukf`).
"""

import contextlib
import dataclasses
from collections.abc import Sequence

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.core.messages import Array
from rov_ident.reports.result import provenance
from rov_ident.steering import heading_interpolation as densify
from rov_ident.steering.nomoto_equation_error import equation_error
from rov_ident.steering.nomoto_filter import unscented
from rov_ident.steering.nomoto_model import Nomoto, Structure, predict, rmse
from rov_ident.steering.nomoto_output_error import descend, output_error
from rov_ident.steering.zigzag import FEWEST, Zigzag

METHODS = ("oe", "fd", "iv", "rls", "ukf")
ORDERS = (1, 2)
_BIASED = 1.5  # times the least RMSE; data of the model itself leave 1.0
_COLOURED = 0.3  # between neighbours; white noise of 100 rows exceeds it one time in 700
_PARTS = 6  # a choice: of each run in cross-validation, of which four are left out in turn


def fit(
    runs: Sequence[Zigzag],
    order: int | str = 1,
    nonlinear: bool = False,
    method: str = "oe",
    interpolate: str = "none",
    step: float | None = None,
) -> Nomoto:
    """One model for all runs; after a pause a run begins anew (:attr:`Zigzag.parts`).

    ``order`` is 1, 2 or `auto`: the second where it predicts parts of the runs left out of its fit
    better than the first (:func:`cross_validated`). ``interpolate`` densifies sparse headings
    first (:func:`dense`), to ``step`` [s].

    Raises UserError for runs too short, at rest, of different kinds, or with which the fit does not
    converge.
    """
    if order not in (*ORDERS, "auto"):
        raise UserError(f"the order is 1, 2 or auto, not {order}")
    if method not in METHODS:
        raise UserError(f"there is no method '{method}': choose one of {', '.join(METHODS)}")
    if not runs:
        raise UserError("no run is given: name at least one file")
    for run in runs:
        check(run)
        if run.unit != runs[0].unit:
            raise UserError(
                f"{run.name} has an input in {run.unit}, but {runs[0].name} in {runs[0].unit}: fit "
                "runs of one kind together"
            )
    parts = [run[rows] for run in runs for rows in run.parts]
    used = [run.cornered() for run in parts]
    if interpolate != "none":
        used = [dense(run, interpolate, step) for run in parts]
    if isinstance(order, str):
        model = cross_validated(used, nonlinear)
    else:
        model = output_error(used, Structure(order, nonlinear))
    fitted = model.rmse
    if method == "ukf":
        model = unscented(used, model)
    elif method != "oe":
        model = equation_error(used, model, method)
    errors = [run.heading - predict(model, run, u)[0] for run, u in zip(parts, used)]
    measured = np.concatenate(errors)
    notes = [_stability(model), *model.notes, *_remarks(model, errors, fitted, nonlinear)]
    notes += _doubtful_times(model, parts)
    notes += [
        f"{run.name} pauses: what the rudder did meanwhile is unknown, so the motion begins anew"
        for run in runs
        if run.parts != [slice(0, len(run.t))]
    ]
    notes += [note for run in runs for note in run.notes]
    return dataclasses.replace(
        model,
        rmse=rmse(measured),
        notes=tuple(notes),
        provenance=provenance((run.name, run.sha256) for run in runs),
    )


def _doubtful_times(model: Nomoto, runs: Sequence[Zigzag]) -> list[str]:
    """What makes the time constants doubtful, in words."""
    notes = []
    if _outlasts(model, runs):
        notes.append(
            f"the response is slower than the longest run ({_longest(runs):.3g} s), which hardly "
            "tells it from the first state and delta_0: K, T and their intervals may be far off; "
            + ("try --order 1, or fit" if model.order == 2 else "fit")
            + " a longer run"
        )
    if model.order == 2 and "T1" not in model.names:
        notes.append("T1 and T2 are complex: only T1T2 and T1_plus_T2 are given")
    elif model.order == 2 and model.upper[model.names.index("T3")] < 0.0:
        late = model.value("T2") - model.value("T3")
        notes.append(
            f"T3 is negative: the heading answers some {late:.2g} s late, which no rudder does; T "
            "contains a dead time, the servo (is the rudder angle the command?) or two clocks"
        )
    return notes


def _remarks(model: Nomoto, errors: Sequence[Array], fitted: float, nonlinear: bool) -> list[str]:
    """What the errors of the simulated heading, run by run, say against the model; ``fitted`` is
    the RMSE of output error [rad], ``nonlinear`` whether the cubic term was asked for."""
    seen = [error[~np.isnan(error)] for error in errors]
    off = rmse(np.concatenate(seen))
    if off > _BIASED * fitted:
        return [
            f"with these values the simulated heading is {np.degrees(off):.3g} deg off (RMSE), "
            f"with those of --method oe {np.degrees(fitted):.3g} deg: noise or the step "
            f"size biases {model.estimator}, and its intervals do not contain that"
        ]
    alike = sum(e[1:] @ e[:-1] for e in seen) / (sum(e @ e for e in seen) + 1e-300)
    if alike < max(_COLOURED, 3.0 / np.sqrt(sum(map(len, seen)))):
        return []
    untried = ["--order 2"] if model.order == 1 and not model.cross_validation else []
    untried += [] if nonlinear else ["--nonlinear"]
    advice = f"try {' and '.join(untried)}, and check" if untried else "check"
    return [
        f"the error of the simulated heading is no white noise (correlation {alike:.2f} between "
        "neighbours): K and T are those of the best model of this structure, and the vehicle's may "
        f"lie outside their intervals; {advice} that the rudder angle is measured rather than "
        "commanded, and that both columns have one clock"
    ]


def cross_validated(runs: Sequence[Zigzag], nonlinear: bool) -> Nomoto:
    """Output error of the order that the runs themselves choose.

    Each run is cut in parts of equal length. Each part is left out in turn, from all runs at once,
    and predicted by a fit to the rest, which runs through it; not so the first and the last, where
    the course of an unstable vehicle depends on the state rather than the order. The second order
    is chosen if its mean squared error is less by more than one standard error of the difference
    over the parts (Breiman et al. 1984, sec. 3.4.3), which chance exceeds one time in five with
    four parts, and by more than its two further parameters cost (Schwarz 1978). But not if it alone
    ends with a response slower than the runs, of which K is what is left over.
    """
    models: dict[int, Nomoto] = {}
    for order in ORDERS:
        with contextlib.suppress(UserError):
            models[order] = output_error(runs, Structure(order, nonlinear))
    if not models:
        raise UserError("the fit does not converge with either order: try without --nonlinear")
    errors = {order: _left_out(runs, model) for order, model in models.items()}
    chosen = min(models)
    if len(models) == 2:
        gain = errors[1] - errors[2]
        headings = sum(int(run.known.sum()) for run in runs)
        price = 2.0 * np.log(headings) / headings * errors[1].mean()
        sure = gain.mean() > max(gain.std(ddof=1) / np.sqrt(len(gain)), price)
        chosen = 2 if sure and (_outlasts(models[1], runs) or not _outlasts(models[2], runs)) else 1
    found = {order: float(np.sqrt(error.mean())) for order, error in errors.items()}
    return dataclasses.replace(models[chosen], cross_validation=found)


def _longest(runs: Sequence[Zigzag]) -> float:
    return max(float(np.ptp(run.t)) for run in runs)


def _outlasts(model: Nomoto, runs: Sequence[Zigzag]) -> bool:
    """Whether the slowest response is slower than the longest run: the first state and delta_0 then
    do what K does."""
    return _longest(runs) * abs(model.growth) < 1.0


def _left_out(runs: Sequence[Zigzag], model: Nomoto) -> Array:
    """Mean squared heading error (runs x parts left out,) [rad2]."""
    errors = []
    for part in range(1, _PARTS - 1):
        kept, gone = [], []
        for run in runs:
            place = np.floor(_PARTS * (run.t - run.t[0]) / (run.t[-1] - run.t[0]))
            out = np.minimum(place, _PARTS - 1) == part
            kept.append(dataclasses.replace(run, heading=np.where(out, np.nan, run.heading)))
            gone.append(out & run.known)
        fitted = descend(kept, model.structure, model.theta)
        for run, rest, out in zip(runs, kept, gone):
            if out.any():
                heading = predict(fitted, rest)[0]
                errors.append(float(np.mean((heading - run.heading)[out] ** 2)))
    return np.array(errors)


def _stability(model: Nomoto) -> str:
    """In words, whether the straight course is stable."""
    if model.stable is None:
        return (
            "the intervals leave open whether the vehicle is course-stable, and with it the signs "
            "of K and T: fit more runs, also with small rudder angles"
        )
    if model.stable:
        return (
            "the vehicle is course-stable: a disturbance dies out with a time constant of "
            f"{-1.0 / model.growth:.3g} s"
        )
    return (
        "the vehicle has no course stability: a disturbance of the straight course grows e-fold in "
        f"{1.0 / model.growth:.3g} s; K and T describe the slope of an unstable balance"
    )


def diverges(model: Nomoto, run: Zigzag) -> bool:
    """Whether a prediction is farther off (RMSE) than the heading ever moves in the run."""
    return predict(model, run)[1] > float(np.nanmax(run.heading) - np.nanmin(run.heading))


def others(
    model: Nomoto, runs: Sequence[Zigzag], interpolate: str = "none", step: float | None = None
) -> dict[str, Nomoto]:
    """The same model by every other method that succeeds, by name."""
    found = {}
    for method in METHODS:
        if method != model.estimator:
            with contextlib.suppress(UserError, np.linalg.LinAlgError):
                found[method] = fit(runs, *model.structure, method, interpolate, step)
    return found


def check(run: Zigzag) -> None:
    """Whether a run can tell anything about the model.

    Raises UserError: too few headings, or a rudder or heading that never moves.
    """
    known = run.heading[run.known]
    if len(known) < FEWEST:
        raise UserError(
            f"{run.name} has {len(known)} headings, but a fit needs at least {FEWEST}: "
            "give a longer run"
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
