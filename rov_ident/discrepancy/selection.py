"""Which parameters are worth adding: stepwise selection by penalised score on a linearised fit.

Residuals of a simulation are correlated in time, so that squares of them count too much. How much,
the scores (gradients of the squared residuals) of whole windows tell: if residuals were white,
their variance would be the normal matrix (Newey and West 1987, with windows as clusters). The ratio
is the variance inflation.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from rov_ident.core.linalg import scaled_solve
from rov_ident.discrepancy.hypothesis import Key, may_leave_null
from rov_ident.discrepancy.linearisation import Linearisation, LinearProblem
from rov_ident.model.equations import Array, Indices

PENALTY = 12.0
"""What one more parameter must take off the scaled squared residuals to be worth having.

Twice the logarithm of the likelihood ratio of a parameter that does nothing is above 12 in one of
2000 cases (Wilks 1938); the Bayesian information criterion asks for 8 to 10 at these sizes.
"""

VERY_STRONG = 10.0
"""Difference of penalised scores by which one model is preferred to another for certain.

"Very strong" on the scale of Kass and Raftery (1995): twice the logarithm of the Bayes factor.
"""

_MOST_LEVERAGE = 0.9
"""A larger leverage counts as this: without its window the parameter would not be known at all."""

_FEWEST_SCORES = 4  # windows; from fewer the scatter of scores is not estimated
_UNSEEN = 1e-12  # of the largest information: a parameter that nothing responds to

Bounds = Callable[[Key], tuple[float, float, float]] | None
"""Null, lower and upper bound of a parameter; None: no parameter has any."""


def variance_inflation(linear: LinearProblem, at: Indices) -> float:
    """Scatter of the windows' scores over that of white residuals, of the parameters ``at``: the
    median over them, and never below the plain variance of the residuals."""
    variance = linear.rss.sum() / max(linear.count - len(at), 1)
    if len(at) == 0 or len(linear.rss) < _FEWEST_SCORES:
        return float(max(variance, 1e-9))
    scatter = _median_inflation(linear.gradient[:, at], np.diag(linear.normal)[at])
    return max(scatter, float(variance))


def variance_inflation_of(linearisation: Linearisation, keys: list[Key]) -> float:
    """The same of these parameters alone, the others refitted along: the mean over them, as one
    axis may be noisier, and its noise slower, than most."""
    linear = linearisation.linear
    at = linear.index(keys)
    rest = linear.index(k for k in linear.keys if k not in set(keys))
    if not len(at):
        return 0.0
    base, new = linearisation.columns[:, rest], linearisation.columns[:, at]
    onto = regressed(linear.normal, rest, at)
    return mean_inflation(new - base @ onto, linearisation.error, linearisation.first)


def regressed(normal: Array, base: Indices, at: Indices) -> Array:
    """The parameters ``base`` (B, A) that imitate a unit of each parameter ``at`` best."""
    return scaled_solve(normal[np.ix_(base, base)], normal[np.ix_(base, at)], 1e-9)


def mean_inflation(columns: Array, error: Array, first: Indices) -> float:
    """The mean over sensitivities (R, C) of the scatter of their windows' scores; windows begin at
    the rows ``first`` of the residuals ``error`` (R,)."""
    gradient = np.add.reduceat(columns * error[:, None], first)
    normal = np.maximum(np.sum(columns**2, axis=0), 1e-300)
    if len(first) < _FEWEST_SCORES:
        return 0.0
    # The fit has already taken from a window's score what its leverage is (the jackknife).
    leverage = np.minimum(np.add.reduceat(columns**2, first) / normal, _MOST_LEVERAGE)
    return float(np.mean(((gradient / (1.0 - leverage)) ** 2).sum(axis=0) / normal))


def _median_inflation(gradient: Array, normal: Array) -> float:
    """The median over parameters of the scatter of scores (W, P) about their mean, over ``normal``
    (P,); parameters that nothing responds to do not count."""
    w = len(gradient)
    seen = normal > _UNSEEN * max(float(normal.max(initial=0.0)), 1e-300)
    own = gradient - gradient.mean(axis=0)
    ratio = (own**2).sum(axis=0)[seen] / normal[seen]
    return float(max(np.median(ratio) * w / (w - 1), 1e-9)) if seen.any() else 1e-9


class Selected(NamedTuple):
    """Parameters worth adding, how far each is from its null, what they take off the squared
    residuals, and the variance inflation that they leave."""

    keys: list[Key]
    change: Array
    gain: float
    inflation: float

    @property
    def score(self) -> float:
        """The penalised score: the scaled gain less the penalty of each."""
        return self.gain / self.inflation - PENALTY * len(self.keys)


class Rows(NamedTuple):
    """Residuals ``error`` (R,) and their ``columns`` (R, P) of the parameters that are fitted
    anyway; windows begin at the rows ``first``."""

    columns: Array
    error: Array
    first: Indices


def scores_of(linearisation: Linearisation, keys: Sequence[Key], columns: Array) -> "Scores":
    """Candidates ``keys``, of the sensitivities ``columns`` (R, C), on top of a fit."""
    base = linearisation.hypothesis.keys
    return Scores(linearisation.having(keys, columns), base, linearisation, columns)


class Scores:
    """What adding parameters to a fit would do, the fit's own (``base``) refitted along with them.
    Squared residuals divided by the variance inflation count as if the residuals were white. What
    is missing makes residuals correlated, too, so a candidate is judged by the inflation that is
    left with it; that takes the ``fit`` and the sensitivities ``columns`` (R, C) of the candidates.
    """

    def __init__(
        self,
        linear: LinearProblem,
        base: Sequence[Key],
        fit: Linearisation | Rows | None = None,
        columns: Array | None = None,
    ) -> None:
        self._linear, self._base, self._fit = linear, linear.index(base), fit
        self._columns = columns
        keys = [k for k in linear.keys if k not in set(base)]
        self._place = {k: i for i, k in enumerate(keys)}
        b, c = self._base, linear.index(keys)
        gradient = linear.gradient.sum(axis=0)
        self._onto = onto = regressed(linear.normal, b, c)
        self._normal = linear.normal[np.ix_(c, c)] - linear.normal[np.ix_(c, b)] @ onto
        self._gradient = gradient[c] - gradient[b] @ onto
        self._inflation = variance_inflation(linear, b)

    def select(
        self, units: Iterable[Sequence[Key]], bounds: Bounds = None, together: bool = False
    ) -> tuple[Selected, float, float]:
        """Of units of parameters that join together those worth having, one after the other; their
        penalised score, and the same as if the residuals that they leave were white.

        ``together``: also beginning with all, as each may show only beside the others. Where none
        is worth having, those are given that would be if what they leave were white, with a score
        of minus infinity: where a linear view is far from the truth, only a fit shows what they do.
        """
        lists = [list(u) for u in units]
        begins = [[], lists] if together and len(lists) > 1 else [[]]
        for white in (False, True):
            steps = (self._stepwise(begin, lists, bounds, white) for begin in begins)
            found = max(steps, key=lambda f: f.score)
            if found.keys and not white:
                gain = self.solve(found.keys, bounds)[1]
                same = found._replace(gain=gain, inflation=self.white_inflation(gain, found.keys))
                return found, found.score, same.score
        return found, -np.inf, found.score

    def _stepwise(
        self, begin: Sequence[list[Key]], units: Sequence[list[Key]], bounds: Bounds, white: bool
    ) -> Selected:
        """From the units ``begin``: those that are not worth their penalty leave, others join."""
        have = list(begin)
        now = self._eliminated(have, bounds, white)
        left = [u for u in units if all(u is not h for h in have)]
        while left:
            trials = [(now.keys + u, *self.solve(now.keys + u, bounds)) for u in left]
            gains = np.array([gain for _, _, gain in trials]) - now.gain
            penalties = PENALTY * np.array([len(u) for u in left])
            best = int(np.argmax(gains / now.inflation - penalties))
            if gains[best] <= 0.0:
                break
            larger = self._selected(*trials[best], white)
            if gains[best] / larger.inflation <= penalties[best]:
                break
            now = larger
            del left[best]
        return now

    def _eliminated(self, have: list[list[Key]], bounds: Bounds, white: bool) -> Selected:
        """Units that are not worth their penalty taken out of ``have``; what the rest does."""
        while have:
            keys = [k for u in have for k in u]
            now = self._selected(keys, *self.solve(keys, bounds), white)
            lost = []
            for u in have:
                gain = self.solve([k for o in have if o is not u for k in o], bounds)[1]
                lost.append((now.gain - gain) / now.inflation - PENALTY * len(u))
            worst = int(np.argmin(lost))
            if lost[worst] > 0.0:
                return now
            del have[worst]
        none = self.white_inflation(0.0, []) if white else self._inflation
        return Selected([], np.zeros(0), 0.0, none)

    def _selected(self, keys: list[Key], change: Array, gain: float, white: bool) -> Selected:
        left = self.white_inflation(gain, keys) if white else self.inflation_with(keys, change)
        return Selected(keys, change, gain, left)

    def white_inflation(self, gain: float, keys: Sequence[Key]) -> float:
        """The plain variance of the residuals with parameters that take ``gain`` off their
        squares."""
        free = self._linear.count - len(keys) - len(self._base)
        return max((float(self._linear.rss.sum()) - gain) / max(free, 1), 1e-9)

    def inflation_with(self, keys: Sequence[Key], change: Array) -> float:
        """The variance inflation with parameters changed and the base refitted along: of the scores
        of the base, if that is less than before, and of the candidates' own."""
        if self._fit is None or self._columns is None:
            return self._inflation
        at = [self._place[k] for k in keys]
        base, first = self._fit.columns, self._fit.first
        new = self._columns[:, at] - base @ self._onto[:, at]
        left = self._fit.error - new @ change
        gradient = np.add.reduceat(base * left[:, None], first)
        variance = float(left @ left) / max(self._linear.count - len(at) - base.shape[1], 1)
        normal = np.diag(self._linear.normal)[self._base]
        common = max(_median_inflation(gradient, normal), variance)
        return max(min(self._inflation, common), mean_inflation(new, left, first))

    def left_of(self, keys: Sequence[Key]) -> Array:
        """The normal matrix (k, k) of parameters, less what the base imitates of them."""
        at = [self._place[k] for k in keys]
        return self._normal[np.ix_(at, at)]

    def solve(self, keys: Sequence[Key], bounds: Bounds = None) -> tuple[Array, float]:
        """Distances from null and the reduction of the squared residuals; a parameter that begins
        at one of its bounds and would leave it stays at its null."""
        if not keys:
            return np.zeros(0), 0.0
        n, g = self.left_of(keys), self._gradient[[self._place[k] for k in keys]]
        delta = scaled_solve(n, g, 1e-6)
        for i, key in enumerate(keys):
            if bounds is not None and not may_leave_null(bounds(key), delta[i]):
                delta[i] = 0.0
        return delta, float(2.0 * g @ delta - delta @ n @ delta)
