"""Which parameters are worth adding: stepwise selection by penalised score on a linearised fit.

Residuals of a simulation are correlated in time, so that squares of them count too much. How much,
the scores (gradients of the squared residuals) of whole windows tell: if residuals were white,
their variance would be the normal matrix (Newey and West 1987, with windows as clusters). The ratio
is the variance inflation.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from rov_ident.core.linalg import scaled_solve, unit_diagonal
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
_RIDGE = 1e-6  # of the information on a parameter: less than that tells it from no other
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


def variance_inflation_of(linear: LinearProblem, keys: list[Key]) -> float:
    """The same of these parameters alone, the others refitted along: the mean over them, as one
    axis may be noisier, and its noise slower, than most."""
    assert linear.normals is not None
    at, rest = linear.index(keys), linear.index(k for k in linear.keys if k not in set(keys))
    if not len(at):
        return 0.0
    beside = np.zeros((len(linear.keys), len(at)))
    beside[at], beside[rest] = np.eye(len(at)), -regressed(linear.normal, rest, at)
    return _mean_inflation(linear.gradient @ beside, _squares(linear.normals, beside))


def regressed(normal: Array, base: Indices, at: Indices) -> Array:
    """The parameters ``base`` (B, A) that imitate a unit of each parameter ``at`` best."""
    return scaled_solve(normal[np.ix_(base, base)], normal[np.ix_(base, at)], 1e-9)


def mean_inflation(columns: Array, error: Array, first: Indices) -> float:
    """The mean over sensitivities (R, C) of the scatter of their windows' scores; windows begin at
    the rows ``first`` of the residuals ``error`` (R,)."""
    products = columns * error[:, None], columns**2
    gradient, squares = (np.add.reduceat(product, first) for product in products)
    return _mean_inflation(gradient, squares)


def _mean_inflation(gradient: Array, squares: Array) -> float:
    """The same by the windows' scores (W, C) and squared sensitivities (W, C)."""
    if len(squares) < _FEWEST_SCORES:
        return 0.0
    normal = np.maximum(squares.sum(axis=0), 1e-300)
    # The fit has already taken from a window's score what its leverage is (the jackknife).
    leverage = np.minimum(squares / normal, _MOST_LEVERAGE)
    return float(np.mean(((gradient / (1.0 - leverage)) ** 2).sum(axis=0) / normal))


def _squares(normals: Array, beside: Array) -> Array:
    """Of each window (W, C) the squared sensitivities to changes ``beside`` (P, C)."""
    squares: Array = np.einsum("pc,wpc->wc", beside, normals @ beside)
    return squares


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


def scores_of(linearisation: Linearisation, keys: Sequence[Key], columns: Array) -> "Scores":
    """Candidates ``keys``, of the sensitivities ``columns`` (R, C), on top of a fit."""
    return Scores(linearisation.having(keys, columns), linearisation.hypothesis.keys)


class Scores:
    """What adding parameters to a fit would do, the fit's own (``base``) refitted along with them.
    Squared residuals divided by the variance inflation count as if the residuals were white. What
    is missing makes residuals correlated, too, so a candidate is judged by the inflation that is
    left with it, where ``normals`` of the windows are known.
    """

    def __init__(self, linear: LinearProblem, base: Sequence[Key]) -> None:
        self._linear, self._base = linear, linear.index(base)
        keys = [k for k in linear.keys if k not in set(base)]
        self._place = {k: i for i, k in enumerate(keys)}
        b, c = self._base, linear.index(keys)
        self._new = c
        gradient = linear.gradient.sum(axis=0)
        self._onto = onto = regressed(linear.normal, b, c)
        self._normal = linear.normal[np.ix_(c, c)] - linear.normal[np.ix_(c, b)] @ onto
        self._gradient = gradient[c] - gradient[b] @ onto
        self._unit, self._size = unit_diagonal(self._normal)
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
        linear, b = self._linear, self._base
        if linear.normals is None:
            return self._inflation
        at = [self._place[k] for k in keys]
        both = np.concatenate([b, self._new[at]])
        normals, before = linear.normals[:, both[:, None], both], linear.gradient[:, both]
        beside = np.vstack([-self._onto[:, at], np.eye(len(at))])
        gradient = before - normals @ (beside @ change)
        squares = linear.rss.sum() - (before + gradient).sum(axis=0) @ (beside @ change)
        variance = float(squares) / max(linear.count - len(both), 1)
        common = _median_inflation(gradient[:, : len(b)], np.diag(linear.normal)[b])
        alone = _mean_inflation(gradient @ beside, _squares(normals, beside))
        return max(min(self._inflation, max(common, variance)), alone)

    def left_of(self, keys: Sequence[Key]) -> Array:
        """The normal matrix (k, k) of parameters, less what the base imitates of them."""
        at = [self._place[k] for k in keys]
        return self._normal[np.ix_(at, at)]

    def solve(self, keys: Sequence[Key], bounds: Bounds = None) -> tuple[Array, float]:
        """Distances from null and the reduction of the squared residuals; a parameter that begins
        at one of its bounds and would leave it stays at its null."""
        if not keys:
            return np.zeros(0), 0.0
        at = np.array([self._place[k] for k in keys])
        n, size = self._unit[at[:, None], at], self._size[at]
        g = self._gradient[at] / size
        delta: Array = np.linalg.solve(n + _RIDGE * np.eye(len(at)), g)
        for i, key in enumerate(keys):
            if bounds is not None and not may_leave_null(bounds(key), delta[i]):
                delta[i] = 0.0
        return delta / size, float(2.0 * g @ delta - delta @ n @ delta)
