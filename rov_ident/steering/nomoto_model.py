"""Nomoto's steering model from zigzag tests: heading psi as the response to the rudder delta.

First and second order (Nomoto 1957), with Norrbin's cubic term (Norrbin 1963)::

    T r' + r + n3 r^3 = K (delta - delta_0)
    T1 T2 r'' + (T1 + T2) r' + r + n3 r^3 = K (delta - delta_0) + K T3 delta',    psi' = r

K has the sign of the data: with SNAME axes a rudder of positive angle that turns the vehicle to
port (Prestero's N_uudr < 0) gives K < 0. ``delta_0`` is the rudder angle that keeps the course.
Inside, the model is written so that it stays regular for a vehicle without course stability (T
infinite or negative)::

    x1' = -a1 x1 + x2 + b1 (delta - delta_0)        first order: x1' = -a0 x1 - c x1^3 + b0 (...)
    x2' = -a0 x1 - c x1^3 + b0 (delta - delta_0)    r = x1
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.core.jit import kernel
from rov_ident.core.messages import Array
from rov_ident.core.runge_kutta import NODES, runge_kutta
from rov_ident.reports.result import NORMAL, Result, as_json
from rov_ident.steering.zigzag import Zigzag

STEP = 0.05  # s, largest of the integration
MOST_JUMPS = 200  # of a rudder, beyond which their instants are not estimated


class Structure(NamedTuple):
    """Which terms a model has: those of ``order`` 1 or 2, and with ``nonlinear`` the cubic one."""

    order: int
    nonlinear: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Of theta (n,), see the head of the module."""
        linear = ("a0", "b0") if self.order == 1 else ("a0", "a1", "b0", "b1")
        return (*linear, *(("c",) if self.nonlinear else ()), "delta_0")

    def numbers(self, theta: Array) -> tuple[float, float, float, float, float, float]:
        """a0, a1, b0, b1, c and delta_0, as :func:`simulate_heading` takes them."""
        x = dict(zip(self.names, theta))
        return x["a0"], x.get("a1", 0.0), x["b0"], x.get("b1", 0.0), x.get("c", 0.0), x["delta_0"]


@dataclass(frozen=True, kw_only=True)
class Nomoto(Result):
    """A fitted model. Its numbers are K, T (and T1 T2 T3, n3, delta_0); T1 and T2 are left out
    where they are complex.

    ``theta`` (n,) is what was fitted. ``unit`` is that of the input. ``stable``: whether the
    straight course is; None where the 95 % intervals leave it open. ``cross_validation`` has by
    order the heading RMSE [rad] on parts left out of the fit; empty where the order was given.
    """

    structure: Structure
    theta: Array
    unit: str
    rmse: float  # rad, of the heading
    stable: bool | None
    cross_validation: Mapping[int, float] = dataclasses.field(default_factory=dict)

    @property
    def order(self) -> int:
        return self.structure.order

    @property
    def growth(self) -> float:
        """The slowest pole [1/s] of a disturbance of the straight course: negative, it dies out."""
        characteristic = [1.0, self.theta[0]] if self.order == 1 else [1.0, *self.theta[1::-1]]
        return float(np.roots(characteristic).real.max())


def model_of(
    structure: Structure, estimator: str, theta: Array, covariance: Array, unit: str, rmse: float
) -> Nomoto:
    """The result that theta (n,) with its covariance (n, n) makes, by linear propagation."""
    functions = {
        name: (function, of)
        for name, (function, of) in _functions(structure, unit).items()
        if np.isfinite(function(theta))
    }
    poles = theta[: structure.order]  # a0 (a1), all positive: stable
    half = NORMAL * np.sqrt(np.diag(covariance)[: structure.order])
    stable = True if (poles > half).all() else None
    if (poles < -half).any():
        stable = False
    slopes = np.array([_gradient(function, theta) for function, _ in functions.values()])
    return Nomoto(
        estimator=estimator,
        names=tuple(functions),
        units=tuple(of for _, of in functions.values()),
        values=np.array([function(theta) for function, _ in functions.values()]),
        covariance=slopes @ covariance @ slopes.T,
        structure=structure,
        theta=theta,
        unit=unit,
        rmse=rmse,
        stable=stable,
    )


def _functions(structure: Structure, unit: str) -> dict[str, tuple[Callable[[Array], float], str]]:
    """The numbers that theta stands for, and their units."""
    names = structure.names
    b0, off = names.index("b0"), names.index("delta_0")
    rate = "1/s" if unit == "rad" else "rad/(s N m)"
    found: dict[str, tuple[Callable[[Array], float], str]] = {"K": (lambda x: x[b0] / x[0], rate)}
    if structure.order == 1:
        found["T"] = (lambda x: 1.0 / x[0], "s")
    else:
        found |= {
            "T": (lambda x: x[1] / x[0] - x[3] / x[b0], "s"),
            "T1": (lambda x: _root(x[0], x[1], 1.0), "s"),
            "T2": (lambda x: _root(x[0], x[1], -1.0), "s"),
            "T3": (lambda x: x[3] / x[b0], "s"),
            "T1T2": (lambda x: 1.0 / x[0], "s2"),
            "T1_plus_T2": (lambda x: x[1] / x[0], "s"),
        }
    if structure.nonlinear:
        c = names.index("c")
        found["n3"] = (lambda x: x[c] / x[0], "s2/rad2")
    found["delta_0"] = (lambda x: x[off], unit)
    return found


def _root(a0: float, a1: float, sign: float) -> float:
    """T1 (sign +) or T2 (-) with T1 T2 = 1/a0 and T1 + T2 = a1/a0; NaN where they are complex."""
    square = (a1 / a0) ** 2 - 4.0 / a0
    return float(0.5 * (a1 / a0 + sign * np.sqrt(square))) if square >= 0.0 else float("nan")


def _gradient(function: Callable[[Array], float], x: Array) -> Array:
    steps = 1e-6 * np.maximum(np.abs(x), 1e-3)
    return np.array([(function(x + d) - function(x - d)) / (2.0 * d.sum()) for d in np.diag(steps)])


def to_json(model: Nomoto, validation: float | None = None, diverges: bool = False) -> str:
    """The result as JSON; ``validation`` is the heading RMSE [rad] on another run, ``diverges``
    whether that prediction does."""
    document: dict[str, object] = {
        "order": model.order,
        **model.entries(),
        "heading_rmse_rad": model.rmse,
        "nonlinear": model.structure.nonlinear,
        "method": model.estimator,
        "stability": {"course_stable": model.stable, "growth_per_s": model.growth},
        "notes": list(model.notes),
        "provenance": model.provenance,
    }
    if model.cross_validation:
        document["cross_validation"] = {
            str(order): {"heading_rmse_rad": error}
            for order, error in model.cross_validation.items()
        }
    if validation is not None:
        document["validation"] = {"heading_rmse_rad": validation, "diverges": diverges}
    return as_json(document)


@kernel
def simulate_heading(order, a0, a1, b0, b1, c, bias, t, rudder, held, first, max_step, out):  # type: ignore[no-untyped-def]
    """Classical Runge-Kutta; out (n,) the heading, from first = [psi, x1, x2], which ends as the
    last state."""
    state, reached, slope, end = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    n = len(t)
    for j in range(3):
        end[j] = first[j]
    out[0] = first[0]
    for i in range(n - 1):
        span = t[i + 1] - t[i]
        steps = max(1, int(np.ceil(span / max_step - 1e-9)))
        h = span / steps
        turn = 0.0 if held else (rudder[i + 1] - rudder[i]) / span
        for s in range(steps):
            for j in range(3):
                state[j] = reached[j] = end[j]
            for stage in range(4):
                y1, y2 = reached[1], reached[2]
                d = rudder[i] + turn * (s + NODES[stage]) * h - bias
                slope[0] = y1
                if order == 1:
                    slope[1] = -a0 * y1 - c * y1 * y1 * y1 + b0 * d
                else:
                    slope[1] = -a1 * y1 + y2 + b1 * d
                    slope[2] = -a0 * y1 - c * y1 * y1 * y1 + b0 * d
                runge_kutta(stage, h, state, slope, reached, end)
        if not abs(end[1]) < 1e3:
            out[i + 1 :] = 1e6
            return
        out[i + 1] = end[0]
    for j in range(3):
        first[j] = end[j]


def respond(
    structure: Structure, theta: Array, run: Zigzag, first: Array, shares: Array | None = None
) -> Array:
    """The simulated heading (n,) [rad] of a run from its first state [psi, x1, x2], zeros at its
    end left out.

    The rudder is linear between the rows, or where the run says so, held. ``shares`` (j,) from 0
    to 1 says when within its step each of ``run.reversals`` came about; None or empty: not at all.
    """
    t, rudder, rows = run.t, run.rudder, None
    state = np.zeros(3)
    state[: len(first)] = first
    if shares is not None and len(shares):
        # Two rows at every jump, the rudder before and after it.
        after = run.reversals + 1
        begin, end = t[after - 1], t[after]
        instants = begin + np.clip(shares, 1e-6, 1.0 - 1e-6) * (end - begin)
        moment = 1e-8 * (end - begin)
        twice = np.repeat(after, 2)
        rows = np.arange(len(t)) + np.searchsorted(twice, np.arange(len(t)), side="right")
        t = np.insert(t, twice, np.column_stack([instants - moment, instants + moment]).ravel())
        rudder = np.insert(
            rudder, twice, np.column_stack([rudder[after - 1], rudder[after]]).ravel()
        )
    out = np.empty(len(t))
    numbers = structure.numbers(theta)
    simulate_heading(structure.order, *numbers, t, rudder, run.held, state, STEP, out)
    return out if rows is None else out[rows]


def predict(model: Nomoto, run: Zigzag, rudder: Zigzag | None = None) -> tuple[Array, float]:
    """The heading (n,) that the model predicts for a run, its first state fitted; and the RMSE.

    ``rudder`` is the same run with more rows, if there is one. As in the fit, a rudder that jumps
    has the instants of its jumps fitted, each within its step, and the motion begins anew after a
    pause; NaN where too little is known between two of them.

    Raises UserError if the run has another kind of input than those of the fit.
    """
    if run.unit != model.unit:
        raise UserError(
            f"{run.name} has an input in {run.unit}, but the model was fitted to one in "
            f"{model.unit}: validate on a run of the same kind"
        )
    heading = np.full(len(run.t), np.nan)
    for rows in run.parts:
        heading[rows] = _predict_part(model, run[rows], rudder)
    return heading, rmse(run.heading - heading)


def _predict_part(model: Nomoto, run: Zigzag, rudder: Zigzag | None) -> Array:
    """The heading (n,) of a run without a pause, see :func:`predict`."""
    fine = run.cornered()
    if rudder is not None:
        both = np.union1d(rudder.t, run.t)
        heading = np.full(len(both), np.nan)
        heading[np.searchsorted(both, run.t)] = run.heading
        fine = dataclasses.replace(
            run, t=both, heading=heading, rudder=np.interp(both, rudder.t, rudder.rudder)
        )
    first, shares = first_state(model.structure, model.theta, fine)
    heading = respond(model.structure, model.theta, fine, first, shares)
    return heading[np.searchsorted(fine.t, run.t)] if len(fine.t) > len(run.t) else heading


def rmse(error: Array) -> float:
    return float(np.sqrt(np.nanmean(error**2)))


def jumps_of(run: Zigzag) -> int:
    """How many instants of jumps are to be estimated: none where the record has them."""
    count = len(run.reversals)
    return 0 if run.held or count > MOST_JUMPS else count


def first_state(structure: Structure, theta: Array, run: Zigzag) -> tuple[Array, Array]:
    """First state (order + 1,) and shares (see :func:`respond`) that fit the heading best.

    Levenberg-Marquardt's damping matters where the model is unstable: a full step from rest may
    lead to a motion that leaves all reason, from where no slope leads back.
    """
    from scipy.optimize import least_squares  # here: a node does not need it

    order, known, jumps = structure.order, run.known, jumps_of(run)
    states = order + 1
    begins = [np.concatenate([[run.heading[known][0]], np.zeros(order), np.full(jumps, 0.5)])]
    if structure.nonlinear:  # also from the linear part's, which cannot run away within the run
        linear = np.delete(theta, structure.names.index("c"))
        begins.append(np.concatenate(first_state(Structure(order), linear, run)))
    speed = max(float(np.std(np.gradient(run.heading[known], run.t[known]))), 1e-9)
    sizes = np.concatenate([[0.1], np.full(order, speed), np.ones(jumps)])
    free = np.full(states, np.inf)

    def error(x: Array) -> Array:
        x = x * sizes
        return (respond(structure, theta, run, x[:states], x[states:]) - run.heading)[known]

    best, cost = begins[0], np.inf
    for begin in begins:
        begin[states:] = np.clip(begin[states:], 0.01, 0.99)
        found = least_squares(
            error, begin / sizes, xtol=1e-9, ftol=1e-9, gtol=1e-9,
            max_nfev=30 if jumps else 30 * (1 + len(begin)), method="trf" if jumps else "lm",
            bounds=(np.append(-free, np.zeros(jumps)), np.append(free, np.ones(jumps))),
        )  # fmt: skip
        if found.cost < cost:
            best, cost = found.x * sizes, found.cost
    return best[:states], best[states:]
