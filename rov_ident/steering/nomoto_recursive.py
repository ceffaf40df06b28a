"""K and T of Nomoto's first-order model, recursively, from heading and rudder as they come in.

``r' + a0 r = b0 (delta - delta_0)``, r the rate of the heading; K = b0 / a0, T = 1 / a0.

`rls`: recursive least squares on this equation, filtered as a whole by F(s) = (c / (s + c))^2, in
which both derivatives of the heading are exact (Young 1981). What the filter does not know of the
motion before is a combination of e^-ct and ct e^-ct: two more columns. Differences, as in the
literature, halve T on measured headings. The corner c has to be near the vehicle's own 1 / T: six
recursions run side by side; of those whose T fits their corner, the surest gives the result.

`ukf`: the filter of :mod:`nomoto_filter`, started from half of what the recursion finds, as soon as
that is roughly known, on the same samples. Four filters differ in the noise that stands for what
the structure lacks; the likeliest gives the result.

The rudder is linear from one sample to the next. Where it is commanded, it jumps at each command.
"""

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rov_ident.core.messages import Array
from rov_ident.steering.nomoto_filter import Filter, heading_noise
from rov_ident.steering.nomoto_model import Structure
from rov_ident.steering.zigzag import FEWEST, GAP

STEP = 0.1  # s between the samples used: a tenth of the least T in docs/nomoto.md
_CORNERS = 0.01 * 4.0 ** np.arange(6)  # rad/s: T from a tanker's to less than a second
_MATCH = 2.0  # of c T: on measured zigzags, K and T are those of output error from about 1 to 5
_REACH = math.log(3.0)  # either side, more than half of the distance between two corners
_FIRST = 1e4  # variance of parameters in units of c and of angles, before any data
_ROUGHLY = 0.3  # relative standard deviation of K and T with which filters can begin
_DRIVES = np.exp([-6.0, -4.5, -3.0, -1.5])  # over the rate; about those that docs/nomoto.md finds
_MOST = 6000  # samples that filters begin with: ten minutes; commands between two samples


@dataclass(frozen=True)
class KandT:
    """values and std (2,) of K [1/s] and T [s], with their covariance (2, 2)."""

    values: Array
    covariance: Array

    @property
    def std(self) -> Array:
        return np.sqrt(np.diag(self.covariance))


class _Step(NamedTuple):
    """From one sample to the next: t (n,) [s] and rudder (n,) [rad] of both and of the commands in
    between, ``held`` as in :class:`Zigzag`; heading (2,) [rad]. ``begins``: of the motion before
    the end nothing is known."""

    t: Array
    rudder: Array
    held: bool
    heading: Array
    begins: bool


class _Recursion:
    """Least squares in units of the corner: theta = a0/c, b0/c^2, b0 delta_0/c^2, two transients.

    A row is taken every half of 1/c. Rows are correlated over 4/c, the integral of the filter's
    autocorrelation, so that eight count for one.
    """

    def __init__(self, corner: float) -> None:
        self.c = corner
        self.theta, self.p = np.zeros(5), _FIRST * np.eye(5)
        self.square, self.count = 0.0, 0
        self.sections, self.since, self.last = [0.0] * 4, 0.0, 0.0

    def _begin(self, heading: float, rudder: float) -> None:
        """A motion of which nothing is known before; the parameters are kept."""
        self.sections = [heading, heading, rudder, rudder]
        self.since = self.last = 0.0
        self.theta[3:] = 0.0
        self.p[3:, :] = self.p[:, 3:] = 0.0
        self.p[3, 3] = self.p[4, 4] = _FIRST

    def step(self, step: _Step) -> None:
        """The heading is linear from one sample to the next."""
        begin, end = step.heading.tolist()
        if step.begins:
            self._begin(end, float(step.rudder[-1]))
            return
        span = float(step.t[-1] - step.t[0])
        self._filter(0, span, begin, end)
        rows = zip(step.t.tolist(), step.rudder.tolist(), strict=True)
        for (since, angle), (until, after) in pairwise(rows):
            self._filter(2, until - since, angle, angle if step.held else after)
        self.since += self.c * span
        if self.since - self.last < 0.5:
            return
        self.last = self.since
        a1, a2, _, b2 = self.sections
        left = end - 2.0 * a1 + a2  # the filtered acceleration, over c^2
        fading = math.exp(-self.since)
        row = np.array([a2 - a1, b2, -1.0, fading, self.since * fading])
        pr = self.p @ row
        total = 1.0 + float(row @ pr)
        error = left - float(row @ self.theta)
        self.theta = self.theta + pr * error / total
        self.p = self.p - np.outer(pr, pr) / total
        self.square += error**2 / total
        self.count += 1

    def _filter(self, first: int, span: float, begin: float, end: float) -> None:
        """Two sections, the ``first`` and the next, by an input that is linear for a span [s]."""
        if span == 0.0:  # a command at the instant of a sample
            return
        decay = math.exp(-self.c * span)
        mean = (1.0 - decay) / (self.c * span)
        for i in (first, first + 1):
            before = self.sections[i]
            self.sections[i] = decay * before + (mean - decay) * begin + (1.0 - mean) * end
            begin, end = before, self.sections[i]

    @property
    def result(self) -> KandT | None:
        """None while the rows are too few, or T could be anything."""
        if self.count < 12:
            return None
        a0, b0 = self.theta[0] * self.c, self.theta[1] * self.c**2
        units = np.array([self.c, self.c**2])
        covariance = 8.0 * self.square / (self.count - 5) * self.p[:2, :2] * np.outer(units, units)
        return _k_and_t(a0, b0, covariance)


class RecursiveNomoto:
    """K and T by `rls` or `ukf`; samples come in the order of their time."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._recursions = [_Recursion(float(c)) for c in _CORNERS]
        self._last: tuple[float, float, float] | None = None
        # t and rudder, since the last sample
        self._commands: deque[tuple[float, float]] = deque(maxlen=_MOST)
        self._steps: list[_Step] = []
        self._filters: list[Filter] = []
        self.result: KandT | None = None  # after the last sample; None while nothing is known

    def push(self, t: float, heading: float, rudder: float) -> None:
        """A sample at t [s], both in rad; one that is less than STEP from the last is left out, as
        is one that comes twice."""
        if not math.isfinite(t + heading + rudder):
            return
        last = self._last
        if last is not None and abs(t - last[0]) < 0.999 * STEP:
            return
        begins = last is None or not 0.0 < t - last[0] <= GAP
        last = last or (t, heading, rudder)
        heading = last[1] + math.remainder(heading - last[1], 2.0 * math.pi)
        times, angles = np.array([(last[0], last[2]), *self._commands, (t, rudder)]).T
        held = len(self._commands) > 0
        step = _Step(times, angles, held, np.array([last[1], heading]), begins)
        self._last = (t, heading, rudder)
        self._commands.clear()
        for recursion in self._recursions:
            recursion.step(step)
        self.result = self._estimate()
        if self.kind == "ukf":
            self._filter(step)

    def command(self, t: float, rudder: float) -> None:
        """From t [s] on, or from the last sample if that is later, the rudder is held at an angle
        [rad]; samples have the angle that is held then."""
        if math.isfinite(t + rudder):
            self._commands.append((t if self._last is None else max(t, self._last[0]), rudder))

    def _estimate(self) -> KandT | None:
        found = [(r.c, r.result) for r in self._recursions]
        known = [(abs(math.log(c * abs(k.values[1]) / _MATCH)), k) for c, k in found if k]
        fitting = [k for off, k in known if off <= _REACH]
        if fitting:
            return min(fitting, key=lambda k: float(k.std[1] / abs(k.values[1])))
        return min(known, key=lambda pair: pair[0])[1] if known else None

    def _filter(self, step: _Step) -> None:
        if self._filters:
            self._advance(step)
        else:
            self._steps = [*self._steps[-_MOST:], step]
            rough = self.result
            if len(self._steps) < FEWEST:
                return
            if rough is None or (rough.std > _ROUGHLY * np.abs(rough.values)).any():
                return
            self._filters = self._first_filters(rough)
            for i, each in enumerate(self._steps):
                self._advance(each._replace(begins=each.begins or i == 0))
            self._steps = []
        if self._filters:
            best = min(self._filters, key=lambda f: f.cost)
            n = best.states
            (a0, b0, _), sizes = best.x[n:] * best.sizes, best.sizes[:2]
            own = best.p[n : n + 2, n : n + 2] * np.outer(sizes, sizes)
            self.result = _k_and_t(a0, b0, own) or self.result

    def _first_filters(self, rough: KandT) -> list[Filter]:
        k, time = rough.values
        ends = [(each.t[-1], each.heading[-1], each.rudder[-1]) for each in self._steps]
        t, heading, rudder = np.array(ends).T
        theta = np.array([1.0 / time, k / time, 0.0])
        sizes = np.array([*np.abs(theta[:2]), 0.1 * max(float(np.std(rudder)), 1e-6)])
        rate = max(float(np.std(np.diff(heading) / np.diff(t))), 1e-9)
        given = Structure(1), 0.5 * theta, sizes, rate, heading_noise([heading])
        return [Filter(*given, rate * drive) for drive in _DRIVES]

    def _advance(self, step: _Step) -> None:
        heading = float(step.heading[-1])
        good = []
        for f in self._filters:
            try:
                if step.begins:
                    f.begin(heading)
                else:
                    f.predict(step.t, step.rudder, step.held)
                    f.correct(heading)
            except np.linalg.LinAlgError:
                continue
            if np.isfinite(f.x).all():
                good.append(f)
        self._filters = good


def _k_and_t(a0: float, b0: float, covariance: Array) -> KandT | None:
    """From a0, b0 and their covariance (2, 2), linearised; None where that means nothing."""
    if not abs(a0) > 1e-9:
        return None
    slopes = np.array([[-b0 / a0**2, 1.0 / a0], [-1.0 / a0**2, 0.0]])
    found = KandT(np.array([b0 / a0, 1.0 / a0]), slopes @ covariance @ slopes.T)
    return found if np.isfinite([*found.values, *found.std]).all() else None
