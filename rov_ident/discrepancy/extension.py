"""Makes sure that the configuration written predicts no worse than the one given.

On held-out data each velocity must be predicted better than by the configuration as given; else the
coefficients of its axis stay as they were. As the axes are coupled, all choices of axes are tried.
"""

from collections.abc import Collection
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from rov_ident.discrepancy.held_out import Judge, log_ratio, surely_less
from rov_ident.discrepancy.hypothesis import COEFFICIENTS, Hypothesis
from rov_ident.model.coefficients import AXES, parse
from rov_ident.model.equations import Array

EXTENDED = "the extended configuration"


@dataclass(frozen=True)
class Kept:
    """The axes of XYZKMN whose coefficients stay as they were, and the model with those; None where
    no choice of axes will do: then nothing of what was found may be written."""

    axes: tuple[str, ...]
    model: Hypothesis | None

    @property
    def note(self) -> str:
        """What stays as it was, in words; empty where nothing does."""
        if self.model is None:
            return (
                f"{EXTENDED} is the one given: on held-out data no part of what was "
                "found predicts every velocity as well"
            )
        if not self.axes:
            return ""
        return (
            f"{EXTENDED} keeps the coefficients of {', '.join(self.axes)} as they "
            "were: on held-out data those found do not predict every velocity as well"
        )


@dataclass(frozen=True)
class AsGiven:
    """A judge, and the squared errors (C, 6) that the configuration as given has there, summed over
    chunks of time."""

    judge: Judge
    errors: Array

    def surely_worse(self, h: Hypothesis) -> NDArray[np.bool_]:
        """Which velocities (6,) a hypothesis predicts worse, beyond chance."""
        after = self.judge.summed(h)
        return np.array(
            [
                free and surely_less(self.errors[:, [i]], after[:, [i]])
                for i, free in enumerate(self.judge.free)
            ]
        )


def kept(as_given: AsGiven, unweighted: AsGiven, h: Hypothesis) -> Kept:
    """What of a hypothesis may be written.

    Of the choices that are nowhere worse (on axes whose coefficients stay: beyond chance) that
    which predicts best. Without any coefficient or effect it is the configuration given.

    ``unweighted``: the same with every error counting alike. Weights say how noise grows in the
    likeliest model; where that is wrongly unstable they excuse its own errors.
    """
    rows = [a for a in AXES if any(row_of(h, k) == a for k in h.keys)]
    judge, given = as_given.judge, as_given.errors
    best: tuple[float, Kept] | None = None
    for count in range(len(rows) + 1):
        for axes in combinations(rows, count):
            there = without_rows(h, axes)
            growth = log_ratio(judge.summed(there).sum(axis=0), given.sum(axis=0))
            own = np.array([a in rows and a not in axes for a in AXES])
            worse = np.where(own, growth > 0.0, as_given.surely_worse(there))
            total = float(growth[judge.free].sum())  # guided axes have no errors
            if (
                not worse[judge.free].any()
                and (best is None or total < best[0])
                and not unweighted.surely_worse(there).any()
            ):
                best = total, Kept(axes, there)
        if best is not None and count == 0:
            break  # nothing has to stay
    return Kept((), None) if best is None else best[1]


def row_of(h: Hypothesis, key: tuple[str, str]) -> str:
    """The axis of a fitted coefficient that the configuration has; of all else nothing."""
    is_own = key[0] == COEFFICIENTS and key[1] in h.config.model.names
    return AXES[parse(key[1]).row] if is_own else ""


def without_rows(h: Hypothesis, axes: Collection[str]) -> Hypothesis:
    """With the coefficients of some axes as configured."""
    return h.without([k for k in h.keys if row_of(h, k) in axes]) if axes else h
