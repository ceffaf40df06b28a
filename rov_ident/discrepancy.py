"""The search for what a model of the dynamics lacks.

1. The coefficients that the model has are refitted: what that gains is tuning, not physics.
2. Every effect of the library is scored about that fit, all at once (linear, with the base
   coefficients refitted along); the best few are fitted in full, and the best of them, if it is
   significant, joins the model. This repeats until nothing is left, or enough was simulated.
3. Each named effect is tried against its rivals once more, with the others in place: other effects,
   and patterns of no known cause. What does not earn its place leaves.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.special import stdtrit

from rov_ident.coefficients import AXES, parse
from rov_ident.config import Config
from rov_ident.effects import EFFECTS
from rov_ident.effects.base import Effect
from rov_ident.evidence import Evidence, Fitted, Look, onsets
from rov_ident.hypothesis import COEFFICIENTS, UNKNOWN, Hypothesis, Key, bounds, parameter
from rov_ident.model import Array
from rov_ident.patterns import Pattern, patterns
from rov_ident.scores import PRICE, SURE, Scores, inflation, own_inflation, scores_of
from rov_ident.streams import Streams

T = TypeVar("T")
R = TypeVar("R")

Progress = Callable[[str], None]

PLAIN = ("quadratic_damping", "linear_damping")
"""Terms that every hull has: what a model lacks of them is the first thing to suspect."""

LATE = ("thruster_lag", "actuation_delay")
"""What every thruster has a little of."""

PLAINLY = 0.0  # what such a term must take off the cost; of others: SURE
_LIKELIER = 0.5  # share of what a plain term explains that a rival must explain beyond it
_OWN = 0.5  # of what a hull has of such a term that must stay its own beside one like it
_FITTED = 6  # candidates that are fitted in full at each step
_HOPEFUL = 3  # and of those that promise most if what they leave is white
_MOST = 6  # effects at most
_BOLD = 3.0  # typical sizes: the farthest from null that a fit begins for what is not linear
_SCORED = 10  # patterns that are scored properly
_ROUNDS = 3  # of trials in which effects may give way to rivals
_MOST_PATTERNS = 3
_PATTERNS_TRIED = 2
_PATTERN_ROUNDS = 4
_IMITATION = 0.05  # share of what a named effect explains that a pattern must explain beyond it
_CLUSTERS = 8  # windows from which their scatter tells anything
_SHARE = 0.3  # of the best promise: what promises less is not fitted
_THREADS = 2  # that fit: more would wait for each other, as some of a fit is Python
_STEPS = 24_000  # simulated for each second of data, after which nothing further is tried


@dataclass(frozen=True)
class Candidate:
    """Something that might be there: parameters to add, where to start, what is promised.

    ``promise`` is what it takes off the scaled squared residuals beyond its price, ``hope`` the
    same if what is left were white: where a model is so far off that a linear view of it leaves
    colour, only a fit shows what there is.
    """

    name: str
    start: Mapping[Key, float]
    promise: float
    hope: float


@dataclass(frozen=True)
class Trial:
    """A named effect put to the test: the model without it, and with each rival in its stead.

    ``rivals`` is None where the search had simulated enough before it came to them.
    """

    rest: Fitted
    rivals: Mapping[str, Fitted] | None


Trials = dict[str, Trial]


class Scanned(NamedTuple):
    """The best shape {parameter: value} of an effect, its linear amplitudes, and their promise."""

    promise: float
    hope: float
    shape: Mapping[str, float]
    change: Mapping[Key, float]


class Search:
    """A bag searched for what a configuration lacks."""

    def __init__(
        self, streams: Streams, config: Config, spans: Sequence[tuple[float, float]]
    ) -> None:
        self.streams, self.config = streams, config
        self.evidence = Evidence(streams, spans)
        base = {
            (COEFFICIENTS, name): float(value)
            for name, value in zip(config.model.names, config.model.theta, strict=True)
            if name in config.estimate and not streams.guided[parse(name).row]
        }
        duration = {
            (e.name, p.name): streams.duration
            for e in EFFECTS.values()
            for p in e.parameters
            if p.role == "fixed"
        }
        self.given = Hypothesis(config, base, duration)
        self._pool = ThreadPoolExecutor(_THREADS, "fit")
        self.cut_short = False  # whether something was left untried
        self._screened: dict[frozenset[Key], list[Candidate]] = {}

    def _enough(self) -> bool:
        """Whether so much has been simulated that nothing further is tried; ``cut_short`` from then
        on.

        It is counted, not timed: a bag gives the same findings however busy the computer is.
        """
        self.cut_short = self.evidence.simulated > _STEPS
        return self.cut_short

    def _each(self, function: Callable[[T], R], of: Iterable[T]) -> list[R]:
        """What a function gives for each of several things, in threads, in their order; an
        interrupt does not wait for their fits."""
        try:
            return list(self._pool.map(function, of))
        except BaseException:
            self.evidence.stop()
            raise

    # -------------------------------------------------------------- the search

    def run(self, progress: Progress | None = None) -> list[Fitted]:
        """The fit of the model as it is structured, then that of each longer one."""
        start = self.evidence.fit(self.given)
        if start is None:
            return []
        path = [start]
        while len(path) <= _MOST and not self._enough():
            longer = self.longer(path[-1], progress)
            if longer is None:
                break
            path.append(longer)
        return path

    def unexplained(self, final: Fitted) -> list[Fitted]:
        """Fits with what patterns are left, one after the other."""
        found: list[Fitted] = []
        while len(found) < _MOST_PATTERNS and not (found and self._enough()):
            screened = self.screen_patterns(final)
            if not screened:
                break
            tried = self.fit_patterns(final, screened[:_PATTERNS_TRIED])
            price = SURE + _choice(self._patterns(final))
            fits = [f for f in tried if f is not None and self.worth(final, f, f) >= price]
            if not fits:
                break
            final = min(fits, key=lambda f: self.cost(f, fits[0]))
            found.append(final)
        return found

    def longer(self, now: Fitted, progress: Progress | None = None) -> Fitted | None:
        """The model with the one effect more that explains most; None where nothing is left."""
        candidates = [c for c in self.screen(now) if not self._early(c.name, now.hypothesis)]
        if progress is not None:
            progress(", ".join(f"{c.name} {c.promise:.0f}" for c in candidates[:5]))
        fits = self.fit_best(now, candidates)
        best = self._best(now, fits) or self._ahead(now, candidates)
        if best is None:
            best = self._best(now, [f for f in fits if self.newest(now, f) in PLAIN], PLAINLY)
        if best is None:
            return None
        return self.evidence.fit(best.hypothesis, best.look, update_noise=True) or best

    def _best(self, now: Fitted, fits: Sequence[Fitted], asked: float = SURE) -> Fitted | None:
        """The fit that is worth most, if any is; a plain term first."""
        if not fits:
            return None
        closest = min(fits, key=lambda f: f.rss)
        worth = [f for f in fits if self.worth(now, f, closest) >= asked and self.held(now, f)]
        plain = [f for f in worth if self.newest(now, f) in PLAIN]
        return min(plain or worth, key=lambda f: self.cost(f, closest), default=None)

    def _ahead(self, now: Fitted, candidates: Sequence[Candidate]) -> Fitted | None:
        """A plain term with one effect more, where neither shows without the other.

        What comes late is tried whatever it promises: a model without drag makes up for it by added
        mass, and from there a linear view sees nothing of it.
        """
        for candidate in candidates:
            if candidate.name not in PLAIN:
                continue
            start = dict.fromkeys(
                (k for u in self.units(EFFECTS[candidate.name], now.hypothesis) for k in u), 0.0
            )
            first = self.evidence.fit(now.hypothesis.having({**start, **candidate.start}), now.look)
            if first is None:
                continue
            others = [c for c in self.screen(first) if not self._early(c.name, now.hypothesis)]
            fits = self.fit_best(first, others)
            for name in LATE:
                if name not in now.hypothesis.effects:
                    (p,) = EFFECTS[name].parameters
                    late = {(name, p.name): p.null + _BOLD * p.typical}
                    there = self.evidence.fit(first.hypothesis.having(late), first.look)
                    fits += [there] if there is not None else []
            pruned = [self.pruned(f, now) for f in fits]
            both = [f for f in pruned if f and set(start) & set(f.hypothesis.keys)]
            best = self._best(now, both)
            if best is not None:
                return best
        return None

    def settle(self, final: Fitted, progress: Progress | None = None) -> tuple[Fitted, Trials]:
        """Every effect against its rivals, the others in place, until nothing changes."""
        trials: Trials = {}
        for last in (False,) * _ROUNDS + (True,):
            trials, better = {}, None
            for name in self.named(final):
                rest = self.evidence.fit(self._without(final, name), final.look)
                if rest is None:
                    continue
                trials[name] = self._trial(rest, name)
                better = self._better(final, name, trials[name])
                if better is not None and (last or self._enough()):
                    better = None  # no end in sight, or no time to try it: what is there stays
                elif better is not None:
                    if progress is not None:
                        progress(f"{name} gives way")
                    break
            if better is None:
                break
            final = self.evidence.fit(better.hypothesis, better.look, update_noise=True) or better
            final = (None if self._enough() else self.longer(final)) or final
        return final, trials

    def trials(self, final: Fitted) -> Trials:
        """Every effect against its rivals, the others in place."""
        names = self.named(final)
        rests = self._each(lambda n: self.evidence.fit(self._without(final, n), final.look), names)
        pairs = zip(names, rests, strict=True)
        return {n: self._trial(rest, n) for n, rest in pairs if rest is not None}

    def _trial(self, rest: Fitted, name: str) -> Trial:
        return Trial(rest, None if self._enough() else self.rivals(rest, name))

    def _better(self, final: Fitted, name: str, trial: Trial) -> Fitted | None:
        """What should stand in the stead of ``name``, if anything.

        A pattern can imitate any cause, with the freedom to follow noise besides, and what a model
        should have anyway is likelier than what few vehicles meet: the rival must explain clearly
        more. A pattern that is in the model anyway need not.
        """
        now = self.cost(final, final)
        there = self.named(final)
        explained = max(trial.rest.rss - final.rss, 1e-9)
        choices = [trial.rest]
        for rival, fit in (trial.rivals or {}).items():
            margin = 0.0
            if rival in EFFECTS and EFFECTS[rival].beyond == name:
                continue
            if rival.startswith(UNKNOWN) and not name.startswith(UNKNOWN):
                margin = 0.0 if rival in there else _IMITATION
            elif name in PLAIN and rival not in PLAIN:
                margin = _LIKELIER
            if margin == 0.0 or (
                now - self.cost(fit, final) > 3.0 * SURE
                and final.rss - fit.rss > margin * explained
            ):
                choices += [fit] if self.held(trial.rest, fit) else []
        best = min(choices, key=lambda f: self.cost(f, final))
        return best if self.cost(best, final) < now else None

    def _without(self, fitted: Fitted, name: str) -> Hypothesis:
        return fitted.hypothesis.without(self.keys_of(fitted, name))

    def rivals(self, rest: Fitted, name: str) -> dict[str, Fitted]:
        """What else might explain what ``name`` explains: fits by the name of the rival."""
        candidates = [
            c
            for c in self.screen(rest)
            if c.name != name
            and (not self._early(c.name, rest.hypothesis) or EFFECTS[c.name].beyond == name)
        ]
        fits = {self.newest(rest, f): f for f in self.fit_best(rest, candidates)}
        screened = self.screen_patterns(rest)[:_PATTERNS_TRIED]
        for (candidate, _), fit in zip(screened, self.fit_patterns(rest, screened), strict=True):
            if fit is not None:
                fits[candidate.name] = fit
        return fits

    def fit_patterns(
        self, now: Fitted, screened: Sequence[tuple[Candidate, Pattern]]
    ) -> list[Fitted | None]:
        """With each of some patterns."""
        if any(section == UNKNOWN for section, _ in now.hypothesis.keys):
            # one that the model has already is brought up to date by what fits it: no two at once
            return [self.fit_pattern(now, *s) for s in screened]
        return self._each(lambda s: self.fit_pattern(now, *s), screened)

    def fit_pattern(self, now: Fitted, candidate: Candidate, pattern: Pattern) -> Fitted | None:
        """With a pattern; its columns follow the motion that the fit arrives at."""
        best: Fitted | None = None
        h, look = now.hypothesis.having(candidate.start), now.look
        for _ in range(_PATTERN_ROUNDS):
            self.adopt(pattern)
            fit = self.evidence.fit(h, look)
            if fit is None or (best is not None and fit.rss > 0.98 * best.rss):
                break
            best, h, look = fit, fit.hypothesis, fit.look
            if pattern.frequency:
                break
            pattern = next(p for p in self._patterns(best) if p.name == pattern.name)
            more, start, _ = self._score(best, pattern)
            h = h.having(dict(zip(more, start, strict=True)))
        return best

    def _score(self, now: Fitted, pattern: Pattern) -> tuple[list[Key], list[float], float]:
        """Columns of a pattern that are worth adding, how much of each, and what they promise if
        what they leave is white."""
        h, look = now.hypothesis, now.look
        columns = [i for i, k in enumerate(pattern.keys) if k not in h.values]
        keys = [pattern.keys[i] for i in columns]
        if not keys:
            return [], [], 0.0
        scores = scores_of(look, keys, look.of(pattern.force()[:, :, columns]))
        units = [keys] if pattern.frequency else [(k,) for k in keys]
        chosen, change, _, hope = _chosen(scores, units)
        return chosen, change.tolist(), hope - (PRICE if pattern.frequency else 0.0)

    def newest(self, rest: Fitted, longer: Fitted) -> str:
        old = set(rest.hypothesis.keys)
        return next(group_of(k) for k in longer.hypothesis.keys if k not in old)

    def fit_best(self, now: Fitted, candidates: Sequence[Candidate]) -> list[Fitted]:
        """Full fits of what promises most, and of what every hull has, whatever it promises: a
        model that lacks it can be too far off for a linear view."""
        least = max(_SHARE * candidates[0].promise, 0.0) if candidates else 0.0
        chosen = [c for c in candidates[:_FITTED] if c.promise >= least]
        hopeful = sorted((c for c in candidates if c.hope > 0.0), key=lambda c: -c.hope)
        chosen += [c for c in hopeful[:_HOPEFUL] if c not in chosen]
        chosen += [c for c in candidates if c.name in PLAIN and c not in chosen]
        fits = self._each(lambda c: self._fit_candidate(now, c), chosen)
        return [f for f in fits if f is not None]

    def _fit_candidate(self, now: Fitted, candidate: Candidate) -> Fitted | None:
        there = self.evidence.fit(now.hypothesis.having(candidate.start), now.look)
        if there is not None and candidate.name in PLAIN:
            there = self.pruned(there, now)
        if there is None or there.hypothesis.keys == now.hypothesis.keys:
            return None
        return self.evidence.dated(there, candidate.start)

    def pruned(self, fitted: Fitted | None, base: Fitted) -> Fitted | None:
        """Without the parameters beyond ``base`` that are not worth their price."""
        while fitted is not None:
            h, linear = fitted.hypothesis, fitted.linear
            added = [k for k in h.keys if k not in base.hypothesis.values and k[0] == COEFFICIENTS]
            size = np.sqrt(np.maximum(np.diag(linear.normal), 1e-30))
            inverse = np.linalg.pinv(linear.normal / np.outer(size, size), hermitian=True)
            width = np.sqrt(np.maximum(np.diag(inverse), 1e-30)) / size
            kappa = inflation(linear, linear.index(h.keys))
            worth = [
                (h.values[k] - bounds(k)[0]) ** 2 / width[linear.index([k])[0]] ** 2 for k in added
            ]
            if min(worth, default=np.inf) > PRICE * kappa:
                return fitted
            less = h.without([added[int(np.argmin(worth))]])
            fitted = self.evidence.fit(less, fitted.look)
        return None

    def worth(self, now: Fitted, longer: Fitted, best: Fitted) -> float:
        """What a longer model takes off the cost, also by the scatter of what is new in it.

        An onset does not count for that: all that is known of it comes from one window.
        """
        gain = self.cost(now, best) - self.cost(longer, best)
        new = [k for k in longer.hypothesis.keys if k not in now.hypothesis.values]
        dates = onsets(longer.hypothesis)
        own = own_inflation(longer.look, [k for k in new if k not in dates])
        return min(gain, (now.rss - longer.rss) / max(own, 1e-9) - PRICE * len(new))

    def held(self, now: Fitted, longer: Fitted) -> bool:
        """Whether the data, not the bounds, hold the parameters that a longer model has more."""
        h, wide = longer.hypothesis, covariance(longer)
        std = dict(zip(longer.linear.keys, np.sqrt(np.maximum(np.diag(wide), 0.0)), strict=True))
        new = [k for k in h.keys if k not in now.hypothesis.values]
        name = self.newest(now, longer)
        plainer = EFFECTS[name].beyond if name in EFFECTS else ""
        own = [(COEFFICIENTS, c) for c in EFFECTS[plainer].coefficients] if plainer else []
        # what takes over most of the hull's own drag is that drag
        taken = any(
            abs(h.values[k]) < _OWN * abs(now.hypothesis.values[k]) for k in own if k in h.values
        )
        # a failure that has been there from the start is no failure at a time
        early = any(
            h.values[k] <= 0.0 and len(EFFECTS[k[0]].lasting) == 1 for k in onsets(h) if k in new
        )
        return not (taken or early) and not any(pinned(k, h.values[k], std[k]) for k in new)

    def cost(self, fitted: Fitted, best: Fitted) -> float:
        """Squared residuals in the units of ``best``, and the price of the added parameters.

        Comparable between fits of the same noise.
        """
        linear = best.linear
        kappa = inflation(linear, linear.index(best.hypothesis.keys))
        extra = len(fitted.hypothesis.keys) - len(self.given.keys)
        scale = (fitted.noise / best.noise) ** 2
        rss = fitted.rss if np.allclose(scale, 1.0) else self._rescored(fitted, best.noise)
        return rss / kappa + PRICE * extra

    def _rescored(self, fitted: Fitted, noise: Array) -> float:
        look = self.evidence.look(fitted.hypothesis, fitted.look.starts, noise)
        assert look is not None
        return look.rss

    def named(self, fitted: Fitted) -> list[str]:
        """The effects (and patterns) that a model has beyond the given one."""
        own = set(self.given.keys)
        return list(dict.fromkeys(group_of(k) for k in fitted.hypothesis.keys if k not in own))

    def keys_of(self, fitted: Fitted, name: str) -> list[Key]:
        own = set(self.given.keys)
        return [k for k in fitted.hypothesis.keys if k not in own and group_of(k) == name]

    # -------------------------------------------------------------- candidates

    def screen(self, now: Fitted) -> list[Candidate]:
        """Candidates, the most promising first; remembered for each set of parameters."""
        keys = frozenset(now.hypothesis.keys)
        if keys not in self._screened:
            self._screened[keys] = self._screen(now)
        return self._screened[keys]

    def _screen(self, now: Fitted) -> list[Candidate]:
        h, look = now.hypothesis, now.look
        plain = {
            e.name: self.units(e, h)
            for e in EFFECTS.values()
            if all(p.role in ("amplitude", "fixed") for p in e.parameters)
        }
        extra = list(dict.fromkeys(k for units in plain.values() for u in units for k in u))
        columns = look.of(self.evidence.columns(h, look.motion, extra))
        scores = scores_of(look, extra, columns)
        candidates = []
        for name, units in plain.items():
            chosen, change, promise, hope = _chosen(scores, units, name in PLAIN)
            if units and name in PLAIN and promise == -np.inf:
                chosen = [k for unit in units for k in unit]
                change = scores.solve(chosen, bounds)[0]
            if chosen:
                start = self._start(dict(zip(chosen, change.tolist(), strict=True)))
                candidates.append(Candidate(name, start, promise, hope))
        others = [e for e in EFFECTS.values() if e.name not in h.effects]
        for found in self._each(lambda effect: self._shaped(now, effect), others):
            candidates += found
        return sorted(candidates, key=lambda c: (-c.promise, -c.hope))

    def _shaped(self, now: Fitted, effect: Effect) -> list[Candidate]:
        """An effect with parameters in which nothing is linear: its shape is scanned."""
        roles = {p.role for p in effect.parameters}
        if "onset" in roles:
            return self._beginning(now, effect)
        if "place" in roles:
            return self._attached(now, effect)
        return self._oscillating(now, effect) if "frequency" in roles else []

    def units(self, effect: Effect, h: Hypothesis) -> list[tuple[Key, ...]]:
        """Parameters of an effect that h lacks, in the groups in which they may join."""
        if effect.sense is not None:
            return []
        if effect.coefficients:
            have = {parse(n).place for n in h.coefficients}
            missing = [parse(n) for n in effect.coefficients]
            missing = [c for c in missing if c.place not in have and self._simulated(c.row)]
            return [((COEFFICIENTS, c.name),) for c in missing]
        mine = [(effect.name, p.name) for p in effect.parameters if p.role == "amplitude"]
        if any(p.axis for p in effect.parameters):
            free = [k for k in mine if self._simulated(AXES.index(parameter(k).axis))]
            return [(key,) for key in free if key not in h.values]
        return [] if effect.name in h.effects else [tuple(mine)]

    def _early(self, name: str, h: Hypothesis) -> bool:
        """Whether an effect is not to be looked for before another that every vehicle has, along
        each axis that is simulated."""
        plainer = EFFECTS[name].beyond if name in EFFECTS else ""
        own = EFFECTS[plainer].coefficients[:3] if plainer else ()
        return any(c not in h.coefficients and self._simulated(parse(c).row) for c in own)

    def _simulated(self, axis: int) -> bool:
        return not self.streams.guided[axis]

    def _start(self, change: Mapping[Key, float]) -> dict[Key, float]:
        """Start values from a linear estimate, inside the bounds and not too bold."""
        start = {}
        for key, delta in change.items():
            null, lower, upper = bounds(key)
            if key[0] in EFFECTS and EFFECTS[key[0]].act is not None:
                reach = _BOLD * parameter(key).typical
                if parameter(key).unit in ("N", "N m"):
                    reach = np.inf
                delta = float(np.clip(delta, -reach, reach))
            start[key] = float(np.clip(null + delta, lower, upper))
        return start

    def _beginning(self, now: Fitted, effect: Effect) -> list[Candidate]:
        """An effect that begins at a time: scanned coarsely, then around the best."""
        duration = self.streams.duration
        best = self._scan(
            now, effect, [{"onset": t * duration} for t in np.linspace(0.04, 0.96, 24)]
        )
        if best is None:
            return []
        near = best.shape["onset"] + np.linspace(-0.04, 0.04, 17) * duration
        best = self._scan(now, effect, [{"onset": float(t)} for t in near]) or best
        return [self._scanned(effect, best)]

    def _attached(self, now: Fitted, effect: Effect) -> list[Candidate]:
        """An effect that attaches somewhere: the neighbourhood of the origin is scanned."""
        places = [p for p in effect.parameters if p.role == "place"]
        grid = [
            {p.name: s * p.typical for p, s in zip(places, signs, strict=True)}
            for signs in itertools.product((-1.0, 0.0, 1.0), repeat=len(places))
        ]
        best = self._scan(now, effect, grid)
        return [] if best is None else [self._scanned(effect, best)]

    def _scan(
        self, now: Fitted, effect: Effect, shapes: Sequence[Mapping[str, float]]
    ) -> "Scanned | None":
        """The most promising shape (onset, place) of an effect, with its linear amplitudes.

        Where a place is not part of the shape, the moments that it makes are fitted as well: a
        wrench is linear in amplitude times place.
        """
        h, look = now.hypothesis, now.look
        keys = [(effect.name, p.name) for p in effect.parameters if p.role == "amplitude"]
        places = [p for p in effect.parameters if p.role == "place" and p.name not in shapes[0]]
        moments = [(f"{effect.name} moment", p.name) for p in places]

        def column(shape: Mapping[str, float]) -> Array:
            values = {(effect.name, n): v for n, v in shape.items()}
            return self.evidence.columns(h.having(values), look.motion, keys)

        best: Scanned | None = None
        for shape in shapes:
            at_origin = column(shape)
            moved = [column({**shape, p.name: 1.0}) - at_origin for p in places]
            mine = look.of(np.concatenate([at_origin, *moved], axis=2))
            scores = scores_of(look, [*keys, *moments], mine)
            units = [(*keys, *moments)] if moments else [(k,) for k in keys]
            chosen, change, promise, hope = _chosen(scores, units)
            if chosen and (best is None or (promise, hope) > (best.promise, best.hope)):
                found = dict(zip(chosen, change.tolist(), strict=True))
                there = {
                    p.name: float(
                        np.clip(found[m] / found[keys[0]], -3.0 * p.typical, 3.0 * p.typical)
                    )
                    for p, m in zip(places, moments, strict=True)
                }
                change_of = {k: found[k] for k in keys if k in found}
                best = Scanned(promise, hope, {**shape, **there}, change_of)
        return best

    def _scanned(self, effect: Effect, best: "Scanned") -> Candidate:
        start = self._start(best.change)
        start |= {
            (effect.name, p.name): best.shape.get(p.name, p.null)
            for p in effect.parameters
            if p.role in ("onset", "place")
        }
        return Candidate(effect.name, start, best.promise - PRICE, best.hope - PRICE)

    def _oscillating(self, now: Fitted, effect: Effect) -> list[Candidate]:
        """Sinusoidal forces in the world: the spectrum of the adjoint shows their frequency."""
        h, look = now.hypothesis, now.look
        keys = [(effect.name, p.name) for p in effect.parameters if p.role == "amplitude"]
        candidates = []
        _, lowest, highest = bounds((effect.name, "frequency"))
        for frequency in look.frequencies(count=3):
            if not lowest <= frequency <= highest:
                continue
            columns = []
            for phase in (0.5 * np.pi, 0.0):
                values = {(effect.name, "frequency"): frequency, (effect.name, "phase"): phase}
                columns.append(self.evidence.columns(h.having(values), look.motion, keys))
            labels = [(f"{effect.name} {part}", k[1]) for part in ("cos", "sin") for k in keys]
            scores = scores_of(look, labels, look.of(np.concatenate(columns, axis=2)))
            change, gain = scores.solve(labels)
            # one phase for all directions: the best approximation of rank one
            cosine, sine = change[: len(keys)], change[len(keys) :]
            turn = 0.5 * np.arctan2(2.0 * cosine @ sine, cosine @ cosine - sine @ sine)
            amplitude = np.cos(turn) * cosine + np.sin(turn) * sine
            start = dict(zip(keys, amplitude.tolist(), strict=True))
            start[effect.name, "frequency"] = frequency
            start[effect.name, "phase"] = 0.5 * np.pi - float(turn)
            promise, hope = (
                gain / spread - PRICE * len(start)
                for spread in (scores.scatter(labels, change), scores.variance(gain, len(labels)))
            )
            candidates.append(Candidate(effect.name, start, promise, hope))
        return sorted(candidates, key=lambda c: -c.promise)[:1]

    # -------------------------------------------------------------- patterns

    def screen_patterns(self, now: Fitted) -> list[tuple[Candidate, Pattern]]:
        """Wrenches of no known cause that would explain something, the best first.

        All are ranked by what they would explain with all their columns, the first few scored
        properly, but as if what they leave were white: only a fit shows what they do leave.
        """
        tried = self._patterns(now)
        price = _choice(tried)
        reach = self._each(lambda p: self._reach(now.look, p), tried)
        ranked = [tried[i] for i in np.argsort(-np.array(reach), kind="stable")]
        found = []
        for pattern in ranked[:_SCORED]:
            chosen, start, promise = self._score(now, pattern)
            if chosen and promise > price:
                values = dict(zip(chosen, start, strict=True))
                rest = promise - price
                found.append((Candidate(group_of(chosen[0]), values, rest, rest), pattern))
        return sorted(found, key=lambda f: -f[0].promise)

    def _reach(self, look: Look, pattern: Pattern) -> float:
        """What all columns of a pattern could take off the squared residuals, less the price of
        each by the plain criterion of Akaike."""
        columns = look.of(pattern.force())
        linear = look.having(pattern.keys, columns)
        known = len(look.linear.keys)
        normal, slope = linear.normal, linear.gradient.sum(axis=0)
        size = np.sqrt(np.maximum(np.diag(normal), 1e-30))
        normal = normal / np.outer(size, size) + 1e-6 * np.eye(len(size))
        slope = slope / size
        whole = slope @ np.linalg.solve(normal, slope)
        base = slope[:known] @ np.linalg.solve(normal[:known, :known], slope[:known])
        return float(whole - base - 2.0 * columns.shape[1])

    def _patterns(self, now: Fitted) -> list[Pattern]:
        """Patterns along the simulated motion: the measured one has the residual's noise in it."""
        streams, steps, look = self.streams, self.evidence.steps, now.look
        middle = 0.5 * (steps.t[1:] + steps.t[:-1])
        position = None
        if streams.has_pose:
            position = np.stack(
                [np.interp(middle, streams.t, x) for x in streams.position.T], axis=1
            )
        found = list(patterns(steps, position, look.motion.middle))
        for axis in range(6):
            for frequency in look.frequencies(1, axis):
                angle = 2.0 * np.pi * frequency * middle
                waves = np.stack([np.cos(angle), np.sin(angle)], axis=1)
                found.append(Pattern(axis, "time", waves, frequency=frequency))
        return [p for p in found if self._simulated(p.axis)]

    def adopt(self, pattern: Pattern) -> None:
        """Make the parameters of a pattern known to the evidence."""
        force = pattern.force()
        for i, key in enumerate(pattern.keys):
            self.evidence.patterns[key] = force[:, :, i]


def _choice(tried: Sequence[Pattern]) -> float:
    """What the best of so many must explain more than one that was meant from the outset."""
    return 2.0 * float(np.log(max(len(tried), 1)))


def _chosen(
    scores: Scores, units: Iterable[Sequence[Key]], together: bool = False
) -> tuple[list[Key], Array, float, float]:
    """The parameters worth having, by the scatter that they leave or else as if that were white,
    what they promise, and what if it is."""
    units = list(units)
    chosen, change, promise = scores.best(units, bounds, together)
    if not chosen:
        chosen, change, hope = scores.best(units, bounds, together, white=True)
        return chosen, change, -np.inf, hope
    reached = scores.solve(chosen, bounds)[1]
    hope = reached / scores.variance(reached, len(chosen)) - PRICE * len(chosen)
    return chosen, change, promise, hope


def group_of(key: Key) -> str:
    """The effect that a parameter belongs to; of a pattern its axis and dependence."""
    section, name = key
    if section == UNKNOWN:
        return f"{UNKNOWN} " + name.rpartition("|")[0]
    if section != COEFFICIENTS:
        return section
    return next((e.name for e in EFFECTS.values() if name in e.coefficients), "coupled_damping")


def foretold(fitted: Fitted) -> Array:
    """Squared residuals (W, 6) by axis, each window's foretold from all the others; onsets are
    taken as known."""
    dates = onsets(fitted.hypothesis)
    at = fitted.linear.index(k for k in fitted.linear.keys if k not in dates)
    return fitted.look.foretold(at)


def covariance(final: Fitted) -> Array:
    """Covariance (P, P) of the parameters, widened by what coloured residuals take away.

    The mean of two estimates: white residuals times their common inflation, which varies little,
    and leaving out each window in turn, which knows where each parameter comes from. Onsets, whose
    residuals are not linear in them, are taken as known (:meth:`Evidence.onset_std`).
    """
    linear, keys = final.linear, final.linear.keys
    at = linear.index(k for k in keys if k not in onsets(final.hypothesis))
    normal = linear.normal[np.ix_(at, at)]
    size = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    inverse = np.linalg.pinv(normal / np.outer(size, size), hermitian=True)
    wide = inflation(linear, at) * inverse / np.outer(size, size)
    moves = final.look.left_out(at)
    w = len(moves)
    if w >= _CLUSTERS:
        few = (stdtrit(w - 1, 0.975) / 1.96) ** 2  # Student's: the scatter of few is uncertain
        wide = 0.5 * (wide + few * (w - 1) / w * moves.T @ moves)
    out = np.zeros((len(keys), len(keys)))
    out[np.ix_(at, at)] = wide
    return out


def pinned(key: Key, value: float, std: float) -> bool:
    """Whether a parameter of an effect is held by nothing but what it may be at most: then it
    stands for something else.

    Zero is a value like others: a thruster may fail altogether.
    """
    if key[0] not in EFFECTS or parameter(key).role != "amplitude":
        return False
    reach = max(2.0 * std, 1e-3 * abs(value))
    return any(b != 0.0 and abs(value - b) < reach for b in bounds(key)[1:])
