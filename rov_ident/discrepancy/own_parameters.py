"""Parameters that belong to each of several records, beside those that the records share.

A current, a trim or a payload that differs from dive to dive, fitted to all as one, is an average
that no dive has, and pulls the shared coefficients along.
"""

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rov_ident.core.linalg import scaled_solve
from rov_ident.discrepancy.hypothesis import Hypothesis, Key, bounds, centre, precision, role_of
from rov_ident.discrepancy.output_error import Fitted
from rov_ident.model.equations import Array

_RIDGE = 1e-9  # what a record says nothing of stays where its own fit has it


def parted(
    alone: Sequence[Fitted | None], last: Hypothesis, own: Container[Key]
) -> tuple[Hypothesis, list[dict[Key, float]]]:
    """What several records share, and the values in each of the parameters ``own`` of the model
    ``last``, which belong to each record.

    The shared parameters minimise the sum of the squares of the fits ``alone``, each linearised at
    its own values; the own ones of each record follow (nuisance parameters, which are eliminated:
    Schur complements of the normal equations). A record without a fit has nothing of its own.
    """
    shared = last.without([k for k in last.keys if k in own])
    keys = _smooth(shared.keys)
    records = [
        None
        if there is None
        else _Record.of(there, keys, _smooth(k for k in last.keys if k in own))
        for there in alone
    ]
    fitted = [r for r in records if r is not None]
    forces = any(f.linearisation.problem.streams.has_forces for f in alone if f is not None)
    prior = precision(shared.at({k: shared.values[k] for k in keys}), forces)
    normal, slope = np.diag(prior), prior * np.array([centre(shared.config, k) for k in keys])
    normal = normal + sum(r.information for r in fitted)
    slope = slope + sum(r.information @ r.values + r.gradient for r in fitted)
    mean = scaled_solve(normal, slope, _RIDGE)
    shared = shared.having(_within_bounds(keys, mean))
    return shared, [{} if r is None else r.beside(mean) for r in records]


@dataclass(frozen=True)
class _Record:
    """The fit to one record: at its ``values`` (S,) of the shared parameters their ``information``
    (S, S) and ``gradient`` (S,), both after its own parameters, ``own``, which change by ``change``
    (O,) and by ``moves`` (O, S) for a change of the shared ones."""

    own: Mapping[Key, float]
    keys: Sequence[Key]
    values: Array
    information: Array
    gradient: Array
    change: Array
    moves: Array

    @classmethod
    def of(cls, there: Fitted, shared: Sequence[Key], own: Sequence[Key]) -> "_Record":
        linear, h = there.linear, there.hypothesis
        normal = linear.normal / there.inflation
        gradient = linear.gradient.sum(axis=0) / there.inflation
        s, o = linear.index(shared), linear.index(own)
        inner, across = normal[np.ix_(o, o)], normal[np.ix_(o, s)]
        moves = -scaled_solve(inner, across, _RIDGE)
        return cls(
            {k: v for k, v in h.values.items() if k not in shared},
            own,
            np.array([h.values[k] for k in shared]),
            normal[np.ix_(s, s)] + across.T @ moves,
            gradient[s] + moves.T @ gradient[o],
            scaled_solve(inner, gradient[o], _RIDGE),
            moves,
        )

    def beside(self, mean: Array) -> dict[Key, float]:
        """The own parameters, with the shared ones at their ``mean`` (S,)."""
        values = np.array([self.own[k] for k in self.keys])
        values += self.change + self.moves @ (mean - self.values)
        return {**self.own, **_within_bounds(self.keys, values)}


def _smooth(keys: Iterable[Key]) -> list[Key]:
    """Without onsets, which stay as each fit has them."""
    return [k for k in keys if role_of(k) != "onset"]


def _within_bounds(keys: Sequence[Key], values: Array) -> dict[Key, float]:
    limits = [bounds(k)[1:] for k in keys]
    return {k: float(np.clip(v, *of)) for k, v, of in zip(keys, values, limits, strict=True)}
