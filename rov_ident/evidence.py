"""What a bag says of a hypothesis: output error over windows, linearised and minimised.

:class:`Evidence` cuts a bag into windows. :meth:`Evidence.look` simulates a hypothesis and gives a
:class:`Look`: residuals and their sensitivities, with the windows' starting velocities eliminated
(projected out), so that further parameters can be tried on it at little cost.
"""

import contextlib
import itertools
import threading
from collections.abc import Container, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.coefficients import AXES, parse
from rov_ident.effects import EFFECTS, compiled
from rov_ident.effects.base import Effect
from rov_ident.errors import UserError
from rov_ident.frames import quaternion_to_matrix
from rov_ident.hypothesis import (
    COEFFICIENTS,
    Hypothesis,
    Key,
    bounds,
    centre,
    parameter,
    precision,
    reach,
)
from rov_ident.model import Array, Model, RigidBody
from rov_ident.shooting import (
    Indices,
    Motion,
    Steps,
    adjoint,
    equations,
    guided_by,
    regressors,
    shoot,
    start_tangent,
    tangent,
    thrust,
    wrenches,
)
from rov_ident.simulate import Guide, simulate
from rov_ident.streams import Streams, orientation_at

_MAX_STEP = 0.05  # s
_MAX_GAP = 0.5  # s without odometry: no window reaches across
_LEAST = 8  # odometry messages in a window
_ITERATIONS = 15
_ONSET_STEP = 0.2  # s; of the difference quotient
_NEARBY = 14.0  # s; in which a better onset is looked for
_SHOWS = 4.0  # scaled squared residuals by which an onset is too far off: two standard deviations
_FARTHEST = 30.0  # s; an onset less certain than that is not known at all
_ASTRAY = 2.0  # times the squared residuals that were foretold: not as foretold
_LOST = 10.0  # standard deviations of a start from what was measured there
_RATE = 50.0  # Hz; what is measured more often may take longer
_OUTLIER = 8.0  # robust standard deviations


@dataclass(frozen=True)
class Linear:
    """Least squares in the neighbourhood of a hypothesis, in units of the noise.

    normal (P, P) = J'J over the parameters ``keys``, gradient (W, P) = J'r of each window, ``rss``
    (W,) its squared residuals, ``count`` the number of residuals less that of the starts.
    """

    keys: tuple[Key, ...]
    normal: Array
    gradient: Array
    rss: Array
    count: int

    def index(self, keys: Iterable[Key]) -> Indices:
        place = {key: i for i, key in enumerate(self.keys)}
        return np.array([place[key] for key in keys], dtype=np.int64)


class Sensitivities(NamedTuple):
    """How a look changes with the parameters of its hypothesis."""

    starts: Sequence[Array]  # of each window (6, P): what the start makes up for
    columns: Array  # (6 N, P), the starts eliminated
    linear: Linear


class Look:
    """A hypothesis simulated through all windows: residuals and sensitivities."""

    def __init__(
        self, evidence: "Evidence", h: Hypothesis, starts: Array, noise: Array, motion: Motion
    ) -> None:
        self.evidence, self.hypothesis, self.starts = evidence, h, starts
        self.noise, self.motion = noise, motion
        error = (evidence.measured - motion.nu[evidence.nodes]) / noise
        spread = 1.4826 * np.median(np.abs(error), axis=0)
        self._weight = (np.abs(error) < _OUTLIER * np.maximum(spread, 1.0)) / noise
        self._weight[:, evidence.guided] = 0.0
        error = error * (self._weight > 0.0)
        self._rows = np.flatnonzero(np.diff(evidence.window, prepend=-1))  # first of each window
        j0 = start_tangent(motion, evidence.first, evidence.last, evidence.nodes)
        j0 = j0[:, :, ~evidence.guided] * self._weight[:, :, None]
        self._q, self._r = [], []
        for a, b in self._spans():
            q, r = np.linalg.qr(j0[a:b].reshape(6 * (b - a), -1))
            self._q.append(q)
            self._r.append(r)
        self._starting = [
            q.T @ error[a:b].ravel() for q, (a, b) in zip(self._q, self._spans(), strict=True)
        ]
        self.error = self._projected(error.reshape(-1, 1))[:, 0]
        self._squares = np.add.reduceat(self.error**2, self.first)
        self._sensitivities: Sensitivities | None = None

    def linearised(self) -> "Sensitivities":
        """Computed when first asked for: of a trial that is no better only the residuals count.

        Not a cached_property, for which all threads wait for each other under Python 3.11.
        """
        if self._sensitivities is None:
            keys = self.hypothesis.keys
            raw = self._sensed(self.evidence.columns(self.hypothesis, self.motion, keys))
            spans = zip(self._q, self._spans(), strict=True)
            starts = [q.T @ raw[6 * a : 6 * b] for q, (a, b) in spans]
            columns = self._projected(raw)
            self._sensitivities = Sensitivities(starts, columns, self._linear(keys, columns))
        return self._sensitivities

    @property
    def columns(self) -> Array:
        return self.linearised().columns

    @property
    def linear(self) -> Linear:
        return self.linearised().linear

    @property
    def rss(self) -> float:
        """Squared residuals; those left out as outliers count as the least that is left out.

        If they counted nothing, a fit could do better by losing a window.
        """
        out = np.count_nonzero(self._weight[:, ~self.evidence.guided] == 0.0)
        return float(self._squares.sum() + _OUTLIER**2 * out)

    def _spans(self) -> Iterable[tuple[int, int]]:
        edges = [*self._rows.tolist(), len(self.evidence.nodes)]
        return itertools.pairwise(edges)

    def _projected(self, raw: Array) -> Array:
        """Columns (6 N, P) without what the starts can explain."""
        for q, (a, b) in zip(self._q, self._spans(), strict=True):
            part = raw[6 * a : 6 * b]
            part -= q @ (q.T @ part)
        return raw

    @property
    def first(self) -> Indices:
        """Where each window begins in the residuals (6 N,)."""
        return 6 * self._rows

    def _linear(self, keys: Sequence[Key], columns: Array) -> Linear:
        return Linear(
            tuple(keys),
            columns.T @ columns,
            np.add.reduceat(columns * self.error[:, None], self.first),
            self._squares,
            int(np.count_nonzero(self._weight)) - 6 * len(self.first),
        )

    def of(self, force: Array) -> Array:
        """Sensitivities (6 N, C) of the residuals to wrenches (K, 6, C)."""
        return self._projected(self._sensed(force))

    def _sensed(self, force: Array) -> Array:
        """The same (6 N, C) from a start that does not give."""
        e = self.evidence
        j = tangent(self.motion, e.first, e.last, force, e.nodes)
        return (j * self._weight[:, :, None]).reshape(-1, force.shape[2])

    def having(self, keys: Sequence[Key], columns: Array) -> Linear:
        """With further parameters, whose sensitivities are ``columns`` (6 N, C)."""
        cross = self.columns.T @ columns
        gradient = np.add.reduceat(columns * self.error[:, None], self.first)
        return Linear(
            (*self.linear.keys, *keys),
            np.block([[self.linear.normal, cross], [cross.T, columns.T @ columns]]),
            np.hstack([self.linear.gradient, gradient]),
            self.linear.rss,
            self.linear.count,
        )

    def left_out(self, at: Indices) -> Array:
        """How the estimate (W, A) of the parameters ``at`` (A,) moves as each window is left out
        (the jackknife); the others are taken as known."""
        linear = self.linear
        normal, gradient = linear.normal[np.ix_(at, at)], linear.gradient[:, at]
        size = np.sqrt(np.maximum(np.diag(normal), 1e-30))
        edges = [*self.first.tolist(), len(self.columns)]
        moves = np.empty_like(gradient)
        for w, (a, b) in enumerate(itertools.pairwise(edges)):
            own = self.columns[a:b, at] / size
            rest = normal / np.outer(size, size) - own.T @ own + 1e-9 * np.eye(len(size))
            moves[w] = np.linalg.solve(rest, gradient[w] / size) / size
        return moves

    def foretold(self, at: Indices) -> Array:
        """Squared residuals (W, 6) of each window, by axis, as foretold from all the others."""
        moves = self.left_out(at)
        window = np.repeat(np.arange(len(moves)), np.diff([*self.first, len(self.columns)]))
        error = self.error + np.einsum("rp,rp->r", self.columns[:, at], moves[window])
        return np.add.reduceat(error.reshape(-1, 6) ** 2, self._rows)

    def starts_after(self, change: Array) -> Array:
        """The starts (W, 6) that suit a change (P,) of the parameters."""
        parts = zip(self._r, self._starting, self.linearised().starts, strict=True)
        moves = [np.linalg.solve(r, e - a @ change) for r, e, a in parts]
        starts = self.starts.copy()
        starts[:, ~self.evidence.guided] += moves
        return starts

    def residual(self) -> Array:
        """Measured minus simulated velocity (N, 6), outliers as they are."""
        return self.evidence.measured - self.motion.nu[self.evidence.nodes]

    def clean(self) -> Array:
        """The residual (N, 6), outliers and what the starts can explain taken out."""
        error: Array = self.error.reshape(-1, 6) * self.noise
        return error

    def rescaled(self) -> Array:
        """Standard deviation (6,) of the residual, outliers left out."""
        good = self._weight > 0.0
        power = np.sum(np.where(good, self.residual(), 0.0) ** 2, axis=0)
        std: Array = np.sqrt(np.maximum(power / np.maximum(good.sum(axis=0), 1), 1e-16))
        return std

    def adjoint(self) -> Array:
        """Per step, how the fit would improve with a wrench there: (K, 6)."""
        e = self.evidence
        error = self.error.reshape(-1, 6) * self._weight
        return adjoint(self.motion, e.first, e.last, error, e.nodes)

    def frequencies(self, count: int, axis: int | None = None) -> list[float]:
        """Frequencies [Hz] at which a force in the world, or along a body axis, would help most."""
        e = self.evidence
        wrench = self.adjoint()
        if axis is None:
            force = np.einsum("kij,kj->ki", e.steps.middle, wrench[:, :3])
        else:
            force = wrench[:, axis : axis + 1]
        t = 0.5 * (e.steps.t[1:] + e.steps.t[:-1])
        step = 2.0 * _MAX_STEP
        bins = ((t - t[0]) / step).astype(int)
        size = 4 * (bins[-1] + 1)
        power = np.zeros(size // 2 + 1)
        for column in force.T:
            power += np.abs(np.fft.rfft(np.bincount(bins, column), size)) ** 2
        frequency = np.fft.rfftfreq(size, step)
        power[(frequency < 1.0 / (t[-1] - t[0])) | (frequency > 2.0)] = 0.0
        from scipy.ndimage import median_filter  # here: 13 MB that nodes, which watch, do not need

        level = median_filter(power, max(5, size // 64)) + 1e-3 * power.max()
        peaks = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
        strongest = peaks[np.argsort(-power[peaks] / np.maximum(level[peaks], 1e-300))]
        return [float(frequency[i]) for i in strongest[:count]]


@dataclass(frozen=True)
class Fitted:
    """The best values of a hypothesis on the windows of an :class:`Evidence`."""

    hypothesis: Hypothesis
    look: Look
    converged: bool

    def __post_init__(self) -> None:
        self.look.linearised()  # before a pattern is brought up to date

    @property
    def linear(self) -> Linear:
        return self.look.linear

    @property
    def noise(self) -> Array:
        return self.look.noise

    @property
    def rss(self) -> float:
        return self.look.rss


class Evidence:
    """The windows of one or more bags on which hypotheses are fitted."""

    def __init__(self, streams: Streams, spans: Sequence[tuple[float, float]]) -> None:
        """``spans``: from and to [s] of each window.

        Raises
        ------
        UserError
            If there is not enough odometry in any of them.
        """
        self.streams = streams
        keep = (streams.t >= streams.demand_t[0]) & np.isfinite(streams.nu).all(axis=1)
        keep &= within(spans, streams.t)
        t = streams.t[keep]
        nodes = _subdivided(t)
        pieces = np.unique(np.concatenate([nodes, streams.demand_t]))
        pieces = pieces[(pieces >= nodes[0]) & (pieces <= nodes[-1])]
        held = np.searchsorted(streams.demand_t, pieces[:-1], side="right") - 1
        self.orientation, self.guided = orientation_at(streams, nodes), streams.guided
        self.steps = Steps(
            nodes,
            quaternion_to_matrix(self.orientation),
            quaternion_to_matrix(orientation_at(streams, 0.5 * (nodes[1:] + nodes[:-1]))),
            pieces,
            streams.demand[held],
            np.searchsorted(pieces, nodes[:-1]),
            self._given(nodes),
        )
        at = np.searchsorted(nodes, t)
        first, last = [], []
        for begin, end in spans:
            inside = np.flatnonzero((t >= begin) & (t < end))
            for run in np.split(inside, np.flatnonzero(np.diff(t[inside]) > _MAX_GAP) + 1):
                if len(run) >= _LEAST:
                    first.append(at[run[0]])
                    last.append(at[run[-1]])
        if not first:
            raise UserError(
                f"odometry with a wrench comes nowhere for {_LEAST} messages without a gap of more "
                f"than {_MAX_GAP} s where it is needed: record it at 4 Hz or more, in a longer bag"
            )
        self.first, self.last = np.array(first, dtype=np.int64), np.array(last, dtype=np.int64)
        window = np.searchsorted(self.first, at, side="right") - 1
        inside = (window >= 0) & (at <= self.last[np.maximum(window, 0)])
        self.nodes, self.window = at[inside], window[inside]
        self.measured = streams.nu[keep][inside]
        self.times = t[inside]
        self.patterns: dict[Key, Array] = {}  # wrenches (K, 6) of no known cause, by key
        self._looks = 0  # simulations of all windows so far
        self._stopped = False
        self._thrusts: dict[object, Array] = {}
        self._remembered = threading.local()  # wrenches along a motion
        self._counting = threading.Lock()

    def _given(self, nodes: Array) -> Array:
        """Accelerations (K, 6) of the guided axes, from each node to the next."""
        if not self.guided.any():
            return np.empty((0, 6))
        nu = self._measured_at(nodes)
        return np.where(self.guided, np.diff(nu, axis=0) / np.diff(nodes)[:, None], 0.0)

    def _measured_at(self, t: Array) -> Array:
        """Velocities (k, 6) between those measured."""
        good = np.isfinite(self.streams.nu).all(axis=1)
        at, nu = self.streams.t[good], self.streams.nu[good]
        return np.stack([np.interp(t, at, x) for x in nu.T], axis=1)

    @property
    def simulated(self) -> float:
        """Steps simulated so far for each second of data, of which a look counts _RATE at most."""
        t, first, last = self.steps.t, self.first, self.last
        rate = float(np.sum(last - first) / np.sum(t[last] - t[first]))
        return self._looks * min(rate, _RATE)

    def stop(self) -> None:
        """No thread simulates any longer: what it is at ends by a CancelledError."""
        self._stopped = True

    def thrust(self, effects: Mapping[str, Mapping[str, float]]) -> Array:
        """Mean and slope (2, K, 6) of the thrusters' wrench after the input effects."""
        inputs = {n: tuple(v.values()) for n, v in effects.items() if EFFECTS[n].act is not None}
        key = tuple(sorted(inputs.items()))
        known = self._thrusts.get(key)
        if known is None:
            if len(self._thrusts) > 64:
                self._thrusts = {}
            known = self._thrusts[key] = thrust(self.steps, compiled(effects))
        return known

    def look(self, h: Hypothesis, starts: Array, noise: Array) -> Look | None:
        """Simulate; None where that diverges, or the masses are none."""
        mass = h.model.mass_matrix
        if not np.isfinite(list(h.values.values())).all() or np.linalg.eigvalsh(mass)[0] <= 0.0:
            return None
        wrench = self.thrust(h.effects)
        for key, value in h.values.items():
            if key in self.patterns:
                wrench = np.stack([wrench[0] + value * self.patterns[key], wrench[1]])
        if self._stopped:
            raise CancelledError
        with self._counting:
            self._looks += 1
        motion = shoot(
            guided_by(h.equations, self.guided), self.steps, wrench, self.first, self.last, starts
        )
        if not np.isfinite(motion.nu[self.nodes]).all():
            return None
        return Look(self, h, starts, noise, motion)

    def columns(self, h: Hypothesis, motion: Motion, keys: Sequence[Key]) -> Array:
        """How the wrench on the vehicle changes with each parameter, (K, 6, P)."""
        out = np.zeros((len(motion.middle), 6, len(keys)))
        place = {key: i for i, key in enumerate(keys)}
        names = [n for section, n in keys if section == COEFFICIENTS]
        if names:
            found = sorted((parse(n) for n in names), key=lambda c: not c.is_added_mass)
            model = Model(h.model.body, tuple(found), np.zeros(len(found)))
            at = [place[COEFFICIENTS, c.name] for c in found]
            relative = self._relative(h, motion)
            out[:, :, at] = regressors(equations(model, h.equations.acting), relative)
        for key in keys:
            if key in self.patterns:
                out[:, :, place[key]] = self.patterns[key]
        for section in dict.fromkeys(s for s, _ in keys if s in EFFECTS):
            effect = EFFECTS[section]
            mine = [p for p in effect.parameters if (section, p.name) in place]
            # parameters of single axes do not disturb each other: all of them in one go
            alone = [[p] for p in mine if not p.axis]
            for group in [*alone, [p for p in mine if p.axis]]:
                if not group:
                    continue
                change = self._difference(h, motion, effect, [p.name for p in group])
                for p in group:
                    column = out[:, :, place[section, p.name]]
                    if p.axis:
                        axis = AXES.index(p.axis)
                        column[:, axis] = change[:, axis]
                    else:
                        column[:] = change
        return out

    def _relative(self, h: Hypothesis, motion: Motion) -> Motion:
        """The motion through the water, where there is a current."""
        water = h.equations.acting.water
        if not water.any():
            return motion
        drift = np.einsum("kji,j->ki", self.steps.middle, water)
        turning = np.cross(motion.middle[:, 3:], drift)
        zero = np.zeros_like(drift)
        return motion._replace(
            middle=motion.middle - np.hstack([drift, zero]),
            pace=motion.pace + np.hstack([turning, zero]),
        )

    def _wrenches(
        self, h: Hypothesis, effects: Mapping[str, Mapping[str, float]], motion: Motion
    ) -> Array:
        """Wrench effects and current (K, 6) along a motion; the last few are remembered."""
        acting = compiled(effects)
        key = (acting.wrench_parameters.tobytes(), acting.water.tobytes())
        mine = self._remembered
        if getattr(mine, "along", None) is not motion.middle:
            mine.along, mine.wrenches = motion.middle, {}
        known: dict[object, Array] = mine.wrenches
        if key not in known:
            known[key] = wrenches(h.equations._replace(acting=acting), self.steps, motion)
        return known[key]

    def _difference(
        self, h: Hypothesis, motion: Motion, effect: Effect, names: Sequence[str]
    ) -> Array:
        """Change (K, 6) of the wrench per unit of the named parameters, all moved at once."""
        now = h.effects.get(effect.name) or h.nulls(effect.name)
        steps, moved = {}, dict(now)
        for p in effect.parameters:
            if p.name in names:
                step = _ONSET_STEP if p.role == "onset" else 1e-3 * p.typical
                if effect.act is not None and p.role == "amplitude":
                    step = 0.05 * p.typical
                steps[p.name] = step if now[p.name] + step <= p.upper else -step
                moved[p.name] = now[p.name] + steps[p.name]
        per_unit = np.ones(6)
        for p in effect.parameters:
            if p.name in names:
                per_unit[AXES.index(p.axis) if p.axis else slice(None)] = steps[p.name]
        before, after = {**h.effects, effect.name: now}, {**h.effects, effect.name: moved}
        if effect.act is not None:
            change = self.thrust(after)[0] - self.thrust(before)[0]
        elif effect.body is not None:
            base = h.model.body
            there = effect.body(base, **{k: moved[k] - now[k] for k in now})
            change = _of_body(there, motion, self.steps) - _of_body(base, motion, self.steps)
        else:
            change = self._wrenches(h, after, motion) - self._wrenches(h, before, motion)
        return change / per_unit

    def errors(self, h: Hypothesis) -> Array:
        """Measured minus simulated (N, 6) in open loop: velocity and attitude of each window begin
        as measured and are the simulation's own from there. NaN where it diverges."""
        mean, slope = self.thrust(h.effects)
        acting, guide = compiled(h.effects), None
        nu = self._measured_at(self.steps.t)
        simulated = np.full((len(self.steps.t), 6), np.nan)
        for first, last, start in zip(self.first, self.last, self.begin(), strict=True):
            nodes = slice(first, last + 1)
            at = np.minimum(np.arange(first, last + 1), len(mean) - 1)
            if self.guided.any():
                guide = Guide(~self.guided, nu[nodes], self.orientation[nodes])
            with contextlib.suppress(UserError):
                simulated[nodes] = simulate(
                    h.model,
                    self.steps.t[nodes],
                    mean[at],
                    start,
                    orientation=self.orientation[first],
                    wrench_slope=slope[at],
                    guide=guide,
                    effects=acting,
                ).nu
        return self.measured - simulated[self.nodes]

    # -------------------------------------------------------------- fit

    def begin(self) -> Array:
        """Starts (W, 6) as measured."""
        at = np.flatnonzero(np.diff(self.window, prepend=-1))
        return self.measured[at].copy()

    def fit(
        self,
        h: Hypothesis,
        start: Look | None = None,
        iterations: int = _ITERATIONS,
        update_noise: bool = False,
    ) -> Fitted | None:
        """Gauss-Newton with step halving, inside the bounds; None where nothing simulates.

        Begins with the starts and the noise of ``start``; the noise is estimated where there is
        none, or on demand.
        """
        if start is None:
            look, update_noise = self.look(h, self.begin(), np.full(6, 0.02)), True
        else:
            look = self._led(h, start)
        if look is None:
            return None
        fitted = self._descend(look, iterations)
        for _ in range(4 if update_noise else 0):
            noise = fitted.look.rescaled()
            starts = self._recalled(fitted.look.starts, noise)
            settled = np.abs(np.log(noise / fitted.noise)).max() < 0.05
            settled = settled and starts is fitted.look.starts
            again = self.look(fitted.hypothesis, starts, noise)
            if again is None:  # from where it was it can be simulated
                again = self.look(fitted.hypothesis, fitted.look.starts, noise)
            assert again is not None
            if settled:
                return Fitted(fitted.hypothesis, again, fitted.converged)
            fitted = self._descend(again, iterations)
        return fitted

    def _recalled(self, starts: Array, noise: Array) -> Array:
        """Starts (W, 6), those that have gone astray as measured again.

        Where a vehicle tumbles, a poor model can push one so far that a better one does not find
        the way back.
        """
        measured = self.begin()
        far: Array = np.max(np.abs(starts - measured) / noise, axis=1, keepdims=True)
        return np.where(far > _LOST, measured, starts) if far.max() > _LOST else starts

    def _led(self, h: Hypothesis, start: Look) -> Look | None:
        """A hypothesis simulated where, of what it shares with the one before, everything follows
        (linearly) what is new in it or gone.

        Otherwise a drag that joins or leaves throws the simulation far off, and the way back is
        long, or ends elsewhere.
        """
        before = start.hypothesis
        added = [k for k in h.keys if k not in before.values]
        moves = {k: h.value(k) - before.value(k) for k in (*before.keys, *added) if _scales(k)}
        moves = {k: d for k, d in moves.items() if d != 0.0}
        begin = self._recalled(start.starts, start.noise)
        if not moves:
            return self.look(h, begin, start.noise)
        linear = start.linear
        if added:
            without = before.having({k: (before if _scales(k) else h).value(k) for k in added})
            columns = self.columns(without, start.motion, added)
            linear = start.having(added, start.of(columns))
        follow = [k for k in before.keys if h.values.get(k) == before.values[k]]
        at, moved = linear.index(follow), linear.index(moves)
        far = np.array(list(moves.values()))
        slope = linear.gradient.sum(axis=0)
        normal = linear.normal[np.ix_(at, at)]
        lower, upper = _room(h, follow)
        change = np.zeros(len(linear.keys))
        change[moved] = far
        change[at] = _bounded(
            normal + np.diag(precision(h.at({k: h.values[k] for k in follow}))),
            slope[at] - linear.normal[np.ix_(at, moved)] @ far,
            lower,
            upper,
        )
        there = h.having({k: h.values[k] + change[i] for k, i in zip(follow, at, strict=True)})
        starts = self._recalled(start.starts_after(change[: len(before.keys)]), start.noise)
        led = self.look(there, starts, start.noise)
        foretold = start.rss - 2.0 * slope @ change + change @ linear.normal @ change
        if led is not None and led.rss < _ASTRAY * foretold:
            return led
        looks = (led, self.look(h, begin, start.noise))
        return min((x for x in looks if x), key=lambda x: x.rss, default=None)

    def dated(self, fitted: Fitted, keys: Container[Key] | None = None) -> Fitted:
        """The same with the best onset near by, of all effects or of these parameters.

        Where an onset falls between two windows nothing tells how to move it, and a far one looks
        no better on the way there.
        """
        for key in onsets(fitted.hypothesis):
            if keys is not None and key not in keys:
                continue
            now = fitted.hypothesis.values[key]
            around = now + np.arange(-_NEARBY, _NEARBY + 0.1, _NEARBY / 7.0)
            rss = [self.rss_at(fitted, key, float(max(onset, 0.0))) for onset in around]
            best = int(np.argmin(rss))
            if rss[best] < self.rss_at(fitted, key, now):
                there = fitted.hypothesis.having({key: float(max(around[best], 0.0))})
                again = self.fit(there, fitted.look)
                if again is not None and again.rss < fitted.rss:
                    fitted = again
        return fitted

    def rss_at(self, fitted: Fitted, key: Key, value: float) -> float:
        """Squared residuals with one parameter moved and the others refitted (linearly)."""
        there = fitted.hypothesis.having({key: value})
        look = self.look(there, fitted.look.starts, fitted.noise)
        if look is None:
            return np.inf
        linear = look.linear
        others = linear.index(k for k in linear.keys if k != key)
        normal = linear.normal[np.ix_(others, others)]
        size = np.sqrt(np.maximum(np.diag(normal), 1e-30))
        slope = linear.gradient.sum(axis=0)[others] / size
        normal = normal / np.outer(size, size) + 1e-6 * np.eye(len(size))
        return float(look.rss - slope @ np.linalg.solve(normal, slope))

    def onset_std(self, fitted: Fitted, key: Key, kappa: float) -> float:
        """Standard deviation [s] of an onset, from how far off it can be before that shows.

        Its residuals are far from quadratic in it: flat between windows, steep where thrust steps.
        """
        now, limit = fitted.hypothesis.values[key], _SHOWS * kappa
        base = self.rss_at(fitted, key, now)
        ends = []
        for way in (-1.0, 1.0):
            near, far = 0.0, _ONSET_STEP
            while far < _FARTHEST and self.rss_at(fitted, key, now + way * far) < base + limit:
                near, far = far, 2.0 * far
            for _ in range(4):
                middle = 0.5 * (near + far)
                shows = self.rss_at(fitted, key, now + way * middle) >= base + limit
                near, far = (near, middle) if shows else (middle, far)
            ends.append(far)
        return max(ends) / np.sqrt(_SHOWS)

    def _descend(self, look: Look, iterations: int) -> Fitted:
        """Gauss-Newton at fixed noise."""
        h = look.hypothesis
        prior, mean = precision(h), np.array([centre(h.config, key) for key in h.keys])
        for _ in range(iterations):
            linear = look.linear
            value = np.array(list(h.values.values()))
            slope = linear.gradient.sum(axis=0) + prior * (mean - value)
            change = _bounded(linear.normal + np.diag(prior), slope, *_room(h, h.keys))
            if slope @ change < 1e-4 * linear.count:
                return Fitted(h, look, True)
            cost = look.rss + prior @ (mean - value) ** 2
            factor = 1.0
            while factor > 0.05:
                there = h.at(dict(zip(h.keys, (value + factor * change).tolist(), strict=True)))
                found = self.look(there, look.starts_after(factor * change), look.noise)
                if found is not None:
                    new = found.rss + prior @ (mean - value - factor * change) ** 2
                    if new < cost:
                        break
                factor *= 0.4
            else:
                return Fitted(h, look, True)
            assert found is not None
            h, look = there, found
            if cost - new < 1e-4 * linear.count:
                return Fitted(h, look, True)
        return Fitted(h, look, False)


def _scales(key: Key) -> bool:
    """Whether the wrench is (nearly) linear in a parameter, however far it moves."""
    return key[0] not in EFFECTS or parameter(key).role == "amplitude"


def _room(h: Hypothesis, keys: Sequence[Key]) -> tuple[Array, Array]:
    """How far parameters may move in one step, downwards and upwards."""
    value = np.array([h.values[k] for k in keys])
    lower, upper = np.array([bounds(k)[1:] for k in keys]).reshape(-1, 2).T
    limit = np.array([reach(k) for k in keys])
    return np.maximum(lower - value, -limit), np.minimum(upper - value, limit)


def onsets(h: Hypothesis) -> list[Key]:
    """Parameters that say when something begins."""
    return [k for k in h.keys if k[0] in EFFECTS and parameter(k).role == "onset"]


def _bounded(normal: Array, slope: Array, lower: Array, upper: Array) -> Array:
    """The change that solves ``normal change = slope`` within bounds (active set)."""
    free = np.ones(len(slope), dtype=bool)
    change = np.zeros(len(slope))
    size = np.sqrt(np.diag(normal)) + 1e-12
    for _ in range(len(slope)):
        rest = slope - normal[:, ~free] @ change[~free]
        a = (normal / np.outer(size, size))[np.ix_(free, free)] + 1e-10 * np.eye(free.sum())
        change[free] = np.linalg.solve(a, (rest / size)[free]) / size[free]
        beyond = free & ((change < lower) | (change > upper))
        if not beyond.any():
            break
        change[beyond] = np.clip(change[beyond], lower[beyond], upper[beyond])
        free &= ~beyond
    return change


def _of_body(body: RigidBody, motion: Motion, steps: Steps) -> Array:
    """What the rigid body adds to the wrench side of the equations, (K, 6)."""
    mass = body.mass_matrix
    nu = motion.middle
    p = nu @ mass.T
    linear, angular = p[:, :3], p[:, 3:]
    v, omega = nu[:, :3], nu[:, 3:]
    coriolis = np.hstack([np.cross(omega, linear), np.cross(omega, angular) + np.cross(v, linear)])
    down = steps.middle[:, 2, :]
    wrench: Array = down @ body.restoring.T - motion.pace @ mass.T - coriolis
    return wrench


def _subdivided(t: Array) -> Array:
    """The instants t and as many between them that no step is longer than _MAX_STEP, gaps aside."""
    length = np.diff(t)
    count = np.where(length > _MAX_GAP, 1, np.ceil(length / _MAX_STEP - 1e-6)).astype(int)
    count = np.maximum(count, 1)
    at = np.repeat(np.arange(len(length)), count)
    part = np.arange(len(at)) - np.repeat(np.cumsum(count) - count, count)
    return np.append(t[at] + part * length[at] / count[at], t[-1])


def within(spans: Iterable[tuple[float, float]], t: Array) -> NDArray[np.bool_]:
    """Which of the instants t (k,) lie in one of the spans (from and to [s])."""
    out: NDArray[np.bool_] = np.zeros(len(t), dtype=bool)
    for begin, end in spans:
        out |= (t >= begin) & (t < end)
    return out
