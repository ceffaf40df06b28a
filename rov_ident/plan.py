"""Which manoeuvre to run next: safe, and best for the coefficient that is known worst.

Candidates (:mod:`rov_ident.swing`) are flown in simulation with the present coefficients, and with
some that the present uncertainty allows; those that leave the tank are made smaller. What each adds
to the information is predicted along its simulated motion, and the one after which the worst
coefficient is known best is proposed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rov_ident import swing
from rov_ident.archive import Archive
from rov_ident.batch import predicted_information
from rov_ident.check import Prospect, prospects
from rov_ident.config import Config
from rov_ident.errors import UserError
from rov_ident.estimate import is_passive, prior_of, typical
from rov_ident.hindsight import hindsight
from rov_ident.maximum_likelihood import LIKELY, assumed, inverse_of, one_pass
from rov_ident.model import Array
from rov_ident.sensors import Dive, Suite, samples_of
from rov_ident.swing import Flown, Limits, Swing

__all__ = ["Limits", "Proposal", "propose"]

_TILT = 1.0  # rad; further the vehicle is not to lean
_DRAWS = 3  # vehicles that the present uncertainty allows, with which a manoeuvre must be safe
_SHRINK = 0.75
_SMALLEST = 0.15  # of the size in the library


@dataclass(frozen=True)
class Candidate:
    """A safe manoeuvre and the information (n, n) that it is predicted to add."""

    swing: Swing
    flown: Flown
    information: Array
    duration: float
    limits: Limits

    def dive(self, config: Config, seed: int = 0) -> Dive:
        """Simulate it on a vehicle."""
        return swing.dive(config, self.swing, self.duration, self.limits, Suite(), seed)


@dataclass(frozen=True)
class Proposal:
    """The best candidate, and what is known before and predicted after it."""

    best: Candidate
    worst: str
    before: tuple[Prospect, ...]
    after: tuple[Prospect, ...]
    others: tuple[tuple[str, float], ...]
    """Every candidate's name and the relative standard deviation of its worst coefficient."""
    left_out: tuple[str, ...]
    candidates: tuple[Candidate, ...] = ()

    @property
    def sentence(self) -> str:
        now = next(p for p in self.before if p.name == self.worst)
        then = next(p for p in self.after if p.name == self.worst)
        f = self.best.flown
        return (
            f"{self.best.swing.name}, {self.best.duration:g} s: {self.worst}, known worst, goes "
            f"from +-{now.std:.2g} to +-{then.std:.2g} {now.unit}; stays within "
            f"{f.reach[0]:.1f} m north, {f.reach[1]:.1f} m east, {f.reach[2]:.1f} m down of the "
            f"start and leans {np.degrees(f.tilt):.0f} deg at most"
        )

    def to_dict(self) -> dict[str, Any]:
        best = self.best
        return {
            "manoeuvre": swing.described(best.swing, best.duration, best.limits, best.flown),
            "worst": self.worst,
            "sentence": self.sentence,
            "coefficients": {
                b.name: {"std_now": b.std, "std_after": a.std, "unit": b.unit}
                for b, a in zip(self.before, self.after, strict=True)
            },
            "candidates": [
                {"name": n, "worst_relative_std": s if np.isfinite(s) else None}
                for n, s in self.others
            ],
            "left_out": list(self.left_out),
        }


def propose(
    config: Config,
    bags: Archive | None = None,
    duration: float = 60.0,
    limits: Limits | None = None,
    say: Callable[[str], None] | None = None,
) -> Proposal:
    """The manoeuvre to run next, after ``bags`` or, without, from the prior alone.

    Raises
    ------
    UserError
        If no manoeuvre is safe within the limits.
    """
    limits = limits or Limits()
    tell = say or (lambda what: None)
    if duration < 10.0:
        raise UserError(f"a manoeuvre of {duration:g} s shows nothing: 10 s are the least")
    n = len(config.estimate)
    now = predicted_information(bags, config) if bags is not None else np.zeros((n, n))
    before = prospects(config, now)
    size = _sizes(config)
    relative = np.array([p.std for p in before]) / size
    worst = before[int(np.argmax(relative))].name
    vehicles = _vehicles(config, now)
    candidates, left_out, scores = [], [], []
    for one in swing.library(limits):
        tell(one.name)
        found = _safe(config, vehicles, one, duration, limits)
        if found is None:
            left_out.append(f"{one.name}: not safe within the limits, however small")
            continue
        information = _information(config, *found, duration, limits)
        std = np.array([p.std for p in prospects(config, now + information)])
        candidates.append(Candidate(*found, information, duration, limits))
        # the worst first; the others decide where two are alike
        scores.append(float((std / size).max() * (1.0 + 0.05 * np.mean(std / size))))
    if not candidates:
        raise UserError("no manoeuvre is safe within these limits: allow more room or less thrust")
    best = int(np.argmin(scores))
    after = prospects(config, now + candidates[best].information)
    others = [(c.swing.name, s) for c, s in zip(candidates, scores, strict=True)]
    return Proposal(
        candidates[best], worst, before, after, tuple(sorted(others, key=lambda o: o[1])),
        tuple(left_out), tuple(candidates),
    )  # fmt: skip


def _sizes(config: Config) -> Array:
    """What a standard deviation is compared with (n,): the value, or a share of what matters."""
    prior, model = prior_of(config), config.dynamics
    size: Array = np.maximum(np.abs(prior.mean), 0.2 * typical(model)[prior.estimated])
    return size


def _vehicles(config: Config, information: Array) -> list[Config]:
    """The configured vehicle and some that what is known allows."""
    prior = prior_of(config)
    covariance = inverse_of(information + np.diag(prior.std**-2.0))
    rng = np.random.default_rng(0)
    found = [config]
    for values in rng.multivariate_normal(prior.mean, covariance, 30 * _DRAWS):
        if len(found) > _DRAWS:
            break
        values = np.where(prior.negative, np.minimum(values, 0.0), values)
        if is_passive(config.dynamics, prior, values):
            named = dict(zip(prior.names, values.tolist(), strict=True))
            found.append(config.with_model(config.model.with_values(named)))
    return found


def _safe(
    config: Config, vehicles: list[Config], one: Swing, duration: float, limits: Limits
) -> tuple[Swing, Flown] | None:
    """The manoeuvre as large as is safe with every vehicle."""
    factor = 1.0
    while factor >= _SMALLEST:
        trial = one.scaled(factor)
        try:
            flown = [swing.fly(v, trial, duration, limits) for v in vehicles]
        except UserError:
            flown = []
        if flown and all((f.reach <= limits.half).all() and f.tilt <= _TILT for f in flown):
            reach = np.max([f.reach for f in flown], axis=0)
            return trial, Flown(flown[0].t, flown[0].demand, reach, max(f.tilt for f in flown))
        factor *= _SHRINK
    return None


def _information(
    config: Config, one: Swing, flown: Flown, duration: float, limits: Limits
) -> Array:
    run = swing.dive(config, one, duration, limits, Suite())
    samples = hindsight(np.concatenate(list(samples_of(config, run))))
    noise = assumed(config, LIKELY)
    found = one_pass(samples, config.dynamics, prior_of(config).estimated, noise)
    return found.information
