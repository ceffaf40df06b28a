"""Which parameters are worth adding: stepwise selection on a linear view of the data."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from rov_ident.evidence import Linear
from rov_ident.hypothesis import Key
from rov_ident.model import Array, Indices

PRICE = 12.0
"""What one more parameter must take off the scaled squared residuals to be worth having.

Twice the logarithm of the likelihood ratio of a parameter that does nothing is above 12 in one of
2000 cases; the Bayesian information criterion asks for 8 to 10 at these sizes.
"""

SURE = 10.0
"""Difference of scaled squared residuals by which one model beats another beyond doubt."""


class Scores:
    """What adding parameters to a fit would do, the fit's own (``base``) refitted along with them.

    ``kappa`` is by how much the scores of whole windows scatter more than those of white residuals:
    squared residuals divided by it count as if the residuals were white.
    """

    def __init__(self, linear: Linear, base: Sequence[Key]) -> None:
        self.keys = [k for k in linear.keys if k not in set(base)]
        self._place = {k: i for i, k in enumerate(self.keys)}
        b, c = linear.index(base), linear.index(self.keys)
        gradient = linear.gradient.sum(axis=0)
        size = np.sqrt(np.maximum(np.diag(linear.normal), 1e-30))
        scaled = linear.normal / np.outer(size, size)
        onto = np.linalg.solve(scaled[np.ix_(b, b)] + 1e-9 * np.eye(len(b)), scaled[np.ix_(b, c)])
        onto = onto * size[c] / size[b][:, None]  # (B, C): columns c by columns b
        self.normal = linear.normal[np.ix_(c, c)] - linear.normal[np.ix_(c, b)] @ onto
        self.gradient = gradient[c] - gradient[b] @ onto
        self.kappa = inflation(linear, b)

    def best(
        self, units: Iterable[Sequence[Key]], bounds: Callable[[Key], tuple[float, float, float]]
    ) -> tuple[list[Key], Array, float]:
        """Of units of parameters that join together those worth having, one after the other.

        Gives their keys, their estimated distance from null, and what they take off the scaled
        squared residuals beyond their price.
        """
        left = [list(u) for u in units]
        chosen: list[Key] = []
        change, gain = np.zeros(0), 0.0
        while left:
            trials = [(*self.solve(chosen + unit, bounds), unit) for unit in left]
            worth = [t[1] / self.kappa - gain - PRICE * len(t[2]) for t in trials]
            pick = int(np.argmax(worth))
            if worth[pick] <= 0.0:
                break
            change, reached, unit = trials[pick]
            chosen, gain = chosen + unit, reached / self.kappa
            left.remove(unit)
        return chosen, change, gain - PRICE * len(chosen)

    def solve(
        self,
        keys: Sequence[Key],
        bounds: Callable[[Key], tuple[float, float, float]] | None = None,
    ) -> tuple[Array, float]:
        """Distances from null and the reduction of the squared residuals.

        A parameter that begins at one of its bounds and would leave it stays at its null.
        """
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
    w = len(linear.rss)
    variance = linear.rss.sum() / max(linear.count - len(at), 1)
    if len(at) == 0 or w < 4:
        return float(max(variance, 1e-9))
    own = linear.gradient[:, at] - linear.gradient[:, at].mean(axis=0)
    ratio = (own**2).sum(axis=0) / np.maximum(np.diag(linear.normal)[at], 1e-300)
    return float(max(np.median(ratio) * w / (w - 1), variance, 1e-9))
