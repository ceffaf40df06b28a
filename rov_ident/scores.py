"""Which parameters are worth adding: stepwise selection on a linear view of the data."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from rov_ident.evidence import Linear, Look
from rov_ident.hypothesis import Key
from rov_ident.model import Array, Indices

PRICE = 12.0
"""What one more parameter must take off the scaled squared residuals to be worth having.

Twice the logarithm of the likelihood ratio of a parameter that does nothing is above 12 in one of
2000 cases; the Bayesian information criterion asks for 8 to 10 at these sizes.
"""

SURE = 10.0
"""Difference of scaled squared residuals by which one model beats another beyond doubt."""


Bounds = Callable[[Key], tuple[float, float, float]]
"""Null, lower and upper bound of a parameter."""


_LEVERAGE = 0.9


class Rows(NamedTuple):
    """Residuals (R,) with their sensitivities to the base (R, B) and to the candidates (R, C), and
    where each window begins in them."""

    base: Array
    candidates: Array
    error: Array
    first: Indices


def scores_of(look: Look, keys: Sequence[Key], columns: Array) -> "Scores":
    """Candidates ``keys``, of the sensitivities ``columns`` (R, C), on top of a fit."""
    rows = Rows(look.columns, columns, look.error, look.first)
    return Scores(look.having(keys, columns), look.hypothesis.keys, rows)


class Scores:
    """What adding parameters to a fit would do, the fit's own (``base``) refitted along with them.

    ``kappa`` is by how much the scores of whole windows scatter more than those of white residuals:
    squared residuals divided by it count as if the residuals were white. What is missing makes them
    hang together as well, so a candidate is judged by the scatter that is left with it, which takes
    ``rows``.
    """

    def __init__(self, linear: Linear, base: Sequence[Key], rows: Rows | None = None) -> None:
        self._linear, self._base, self._rows = linear, linear.index(base), rows
        self.keys = [k for k in linear.keys if k not in set(base)]
        self._place = {k: i for i, k in enumerate(self.keys)}
        b, c = linear.index(base), linear.index(self.keys)
        gradient = linear.gradient.sum(axis=0)
        size = np.sqrt(np.maximum(np.diag(linear.normal), 1e-30))
        scaled = linear.normal / np.outer(size, size)
        onto = np.linalg.solve(scaled[np.ix_(b, b)] + 1e-9 * np.eye(len(b)), scaled[np.ix_(b, c)])
        onto = onto * size[c] / size[b][:, None]  # (B, C): columns c by columns b
        self._onto = onto
        self.normal = linear.normal[np.ix_(c, c)] - linear.normal[np.ix_(c, b)] @ onto
        self.gradient = gradient[c] - gradient[b] @ onto
        self.kappa = inflation(linear, b)

    def best(
        self,
        units: Iterable[Sequence[Key]],
        bounds: Bounds,
        together: bool = False,
        white: bool = False,
    ) -> tuple[list[Key], Array, float]:
        """Of units of parameters that join together those worth having, one after the other.

        Gives their keys, their estimated distance from null, and what they take off the scaled
        squared residuals beyond their price. ``together``: where that is more, beginning with all
        of them; each alone may not show while the others are missing. ``white``: as if what is left
        were white, which is too good to believe but good enough to try.
        """
        left = [list(u) for u in units]
        found = self._grown([], left, bounds, white)
        if together and len(left) > 1:
            other = self._grown(left, left, bounds, white)
            found = max(found, other, key=lambda f: f[2])
        return found

    def _grown(
        self, begin: Sequence[list[Key]], units: Sequence[list[Key]], bounds: Bounds, white: bool
    ) -> tuple[list[Key], Array, float]:
        """From the units ``begin`` on: those that are not worth their price leave, others join."""
        have = list(begin)
        nothing = self.variance(0.0, 0) if white else self.kappa
        change, reached, kappa = np.zeros(0), 0.0, nothing
        while have:
            keys = [k for u in have for k in u]
            change, reached = self.solve(keys, bounds)
            kappa = self.variance(reached, len(keys)) if white else self.scatter(keys, change)
            without = [[k for o in have if o is not u for k in o] for u in have]
            lost = [
                (reached - self.solve(rest, bounds)[1]) / kappa - PRICE * len(u)
                for rest, u in zip(without, have, strict=True)
            ]
            worst = int(np.argmin(lost))
            if lost[worst] > 0.0:
                break
            del have[worst]
            change, reached, kappa = np.zeros(0), 0.0, nothing
        left = [u for u in units if all(u is not h for h in have)]
        while left:
            chosen = [k for u in have for k in u]
            trials = [(*self.solve(chosen + unit, bounds), unit) for unit in left]
            worth = [(t[1] - reached) / kappa - PRICE * len(t[2]) for t in trials]
            there, new, unit = trials[int(np.argmax(worth))]
            if new <= reached:
                break
            keys = chosen + unit
            scatter = self.variance(new, len(keys)) if white else self.scatter(keys, there)
            if (new - reached) / scatter <= PRICE * len(unit):
                break
            change, reached, kappa = there, new, scatter
            have.append(unit)
            left = [u for u in left if u is not unit]
        chosen = [k for u in have for k in u]
        return chosen, change, reached / kappa - PRICE * len(chosen)

    def variance(self, reached: float, count: int) -> float:
        """Of the residuals, with ``count`` parameters that take ``reached`` off their squares."""
        total, b = float(self._linear.rss.sum()), len(self._base)
        return max((total - reached) / max(self._linear.count - count - b, 1), 1e-9)

    def scatter(self, keys: Sequence[Key], change: Array) -> float:
        """``kappa`` with the parameters changed and the base refitted along."""
        if self._rows is None:
            return self.kappa
        at = [self._place[k] for k in keys]
        base, candidates, error, first = self._rows
        new = candidates[:, at] - base @ self._onto[:, at]
        left = error - new @ change
        gradient = np.add.reduceat(base * left[:, None], first)
        variance = float(left @ left) / max(self._linear.count - len(at) - base.shape[1], 1)
        common = max(_scatter(gradient, np.diag(self._linear.normal)[self._base]), variance)
        return max(min(self.kappa, common), _own(new, left, first))

    def solve(
        self,
        keys: Sequence[Key],
        bounds: Bounds | None = None,
    ) -> tuple[Array, float]:
        """Distances from null and the reduction of the squared residuals.

        A parameter that begins at one of its bounds and would leave it stays at its null.
        """
        if not keys:
            return np.zeros(0), 0.0
        at = [self._place[k] for k in keys]
        n, g = self.normal[np.ix_(at, at)], self.gradient[at]
        size = np.sqrt(np.maximum(np.diag(n), 1e-30))
        delta = np.linalg.solve(n / np.outer(size, size) + 1e-6 * np.eye(len(at)), g / size) / size
        for i, key in enumerate(keys):
            if bounds is not None:
                null, lower, upper = bounds(key)
                if (null == lower and delta[i] < 0.0) or (null == upper and delta[i] > 0.0):
                    delta[i] = 0.0
        return delta, float(2.0 * g @ delta - delta @ n @ delta)


def inflation(linear: Linear, at: Indices) -> float:
    """Scatter of the windows' scores over that of white residuals, of the parameters ``at``.

    At the fit the scores sum to zero; a window's own deviation tells how its residuals hang
    together. The median over parameters, and never below the plain variance of the residuals.
    """
    variance = linear.rss.sum() / max(linear.count - len(at), 1)
    if len(at) == 0 or len(linear.rss) < 4:
        return float(max(variance, 1e-9))
    return max(_scatter(linear.gradient[:, at], np.diag(linear.normal)[at]), float(variance))


def own_inflation(look: Look, keys: Sequence[Key]) -> float:
    """Of these parameters of a fit alone, the others refitted along.

    An axis can be noisier, and its noise slower, than most.
    """
    linear = look.linear
    at = linear.index(keys)
    rest = linear.index(k for k in linear.keys if k not in set(keys))
    if not len(at):
        return 0.0
    base, new = look.columns[:, rest], look.columns[:, at]
    size = np.sqrt(np.maximum(np.diag(linear.normal)[rest], 1e-30))
    normal = linear.normal[np.ix_(rest, rest)] / np.outer(size, size) + 1e-9 * np.eye(len(rest))
    onto = np.linalg.solve(normal, linear.normal[np.ix_(rest, at)] / size[:, None]) / size[:, None]
    return _own(new - base @ onto, look.error, look.first)


def _own(new: Array, left: Array, first: Indices) -> float:
    """The mean over columns ``new`` (R, C) of the scatter of their windows' scores."""
    gradient = np.add.reduceat(new * left[:, None], first)
    normal = np.maximum(np.sum(new**2, axis=0), 1e-300)
    if len(first) < 4:
        return 0.0
    # Of what a window says for itself, the fit has already taken its share away (the jackknife).
    share = np.minimum(np.add.reduceat(new**2, first) / normal, _LEVERAGE)
    return float(np.mean(((gradient / (1.0 - share)) ** 2).sum(axis=0) / normal))


def _scatter(gradient: Array, normal: Array) -> float:
    """The median over parameters; those that nothing responds to do not count."""
    w = len(gradient)
    seen = normal > 1e-12 * max(float(normal.max(initial=0.0)), 1e-300)
    own = gradient - gradient.mean(axis=0)
    ratio = (own**2).sum(axis=0)[seen] / normal[seen]
    return float(max(np.median(ratio) * w / (w - 1), 1e-9)) if seen.any() else 1e-9
