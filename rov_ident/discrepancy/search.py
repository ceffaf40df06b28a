"""The search for what a model of the dynamics lacks.

1. The coefficients that the model has are refitted: that is tuning, not physics. 2. Every effect is
scored on the linearisation of that fit (`screening`), the best few are fitted in full, and the best
of them, if significant, joins the model; and again, until nothing is left or the simulation budget
is spent. 3. Each named effect is compared with its rivals, the others in place: other effects, and
patterns of no known cause (`patterns`). One that does not earn its place leaves.
"""

import contextlib
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rov_ident.config import Config
from rov_ident.config.prior import cob_std
from rov_ident.core.errors import UserError
from rov_ident.core.linalg import scaled_inverse, scaled_solve
from rov_ident.discrepancy.hypothesis import (
    COEFFICIENTS,
    UNKNOWN,
    Hypothesis,
    Key,
    at_bound,
    axis_of,
    bounds,
    effect_of,
    is_shared,
    of_record,
    onsets,
    reach,
    record_of,
    role_of,
    shared,
    trim_std,
)
from rov_ident.discrepancy.linearisation import linearise
from rov_ident.discrepancy.output_error import FIRST_NOISE, Fitted, fit, refit, with_best_onsets
from rov_ident.discrepancy.patterns import INTERPLAY, PatternSearch, choice_penalty
from rov_ident.discrepancy.screening import FARTHEST, HULL_DAMPING, Candidate, Screening
from rov_ident.discrepancy.selection import PENALTY, VERY_STRONG, variance_inflation_of
from rov_ident.discrepancy.windowed_problem import Spans, WindowedProblem
from rov_ident.effects import EFFECTS, with_trait
from rov_ident.model.coefficients import parse
from rov_ident.model.thruster_allocation import is_known, matrix
from rov_ident.sampling.raw_streams import Streams

Progress = Callable[[str], None]
Task = Callable[[], Fitted | None]

LIKELIEST = (*HULL_DAMPING, *with_trait("likely"))
INTERPLAY_NAME = f"{UNKNOWN} {INTERPLAY}"  # it makes a name unsure, and is none itself
LATE_THRUST = with_trait("late")

# What is likelier beforehand needs less evidence. The rates in docs/explain-bench.md were measured
# with these.
HULL_DAMPING_ASKED = 0.0  # penalised score; of other effects VERY_STRONG is asked
_MORE_THAN_DAMPING = 0.5  # of what hull damping explains: a rival of it must explain as much more
_MORE_THAN_NAMED = 0.05  # of what a named effect explains: a pattern must explain as much more
_NOISE_STD = 2.0  # standard deviations of the squares that noise of the reading makes, of one draw
_OWN_DRAG = 0.5  # of the hull's drag that must remain beside an effect that imitates it

# Effort: the times and rates in docs/explain-bench.md were measured with these.
_FITTED = 6  # candidates that are fitted in full at each step, ...
_FITTED_WHITE = 3  # ... and those with the best scores as if what they leave were white
_PROMISED = 0.5  # of what a linearisation promises; with less, the fit begins once more elsewhere
_LEAST_SHARE = 0.3  # of the best score: a candidate with less is not fitted
_MOST_EFFECTS = 6  # added one after the other: twice as many as the study hides
_MOST_PATTERNS = 3  # without a name, which are told, not mended
_ROUNDS = 3  # in which effects may give way to rivals
_ARM_STEPS = 4  # of Gauss-Newton in the height of the centre of buoyancy, which is nearly linear
_SHORT = 1.0  # s; of windows from which a fit begins: as long as a small vehicle's response, ...
_FEWEST_SHORT = 10  # ... and messages in them: more than a window needs at least
_ZERO = 1e-300  # what may be zero is divided by it
BUDGET = 1_000_000  # of work, for each second of data (docs/explain.md, the card of an effect)


@dataclass(frozen=True)
class Trial:
    """A named effect put to the test: the model without it, and with each rival in its place;
    ``whole``: with patterns of no known cause, too, for which the budget may not be left."""

    rest: Fitted
    rivals: Mapping[str, Fitted]
    whole: bool = True


Trials = dict[str, Trial]


class Search:
    """A bag searched for what a configuration lacks."""

    def __init__(
        self,
        streams: Streams,
        config: Config,
        spans: Sequence[tuple[float, float]],
        apart: bool = True,
    ) -> None:
        """``apart``: whether records that were joined may differ in what belongs to a dive."""
        self.config, self.problem = config, WindowedProblem(streams, spans)
        self._spans = spans
        base = {
            (COEFFICIENTS, name): float(value)
            for name, value in zip(config.model.names, config.model.theta, strict=True)
            if name in config.estimate and not streams.guided[parse(name).row]
        }
        if not streams.has_forces:  # ... and what trim makes is then taken for a larger scale
            trim = [k for k in trim_std(config) if k[0] not in config.effects]
            base |= {k: bounds(k)[0] for k in trim}
        parameters = [(e.name, p) for e in EFFECTS.values() for p in e.parameters]
        duration = {(e, p.name): streams.longest for e, p in parameters if p.role == "fixed"}
        self.given = Hypothesis(config, base, duration)
        self._records = len(streams.begins) if apart else 1
        thrusters = matrix(config.thrusters) if is_known(config.thrusters) else None
        self.screening = Screening(self.problem, self._records, thrusters)
        self.patterns = PatternSearch(self.problem)
        self._ends: dict[object, Hypothesis] = self.problem.memory()  # of fits, by structure
        self.cut_short = False  # whether something was left untried

    def _budget_spent(self) -> bool:
        """Whether nothing further is tried; ``cut_short`` from then on. Work is counted, not
        timed: a bag gives the same findings however busy the computer is."""
        self.cut_short = self.problem.work > BUDGET
        return self.cut_short

    def start(self) -> Fitted | None:
        """The fit of the model as it is: the likeliest of those that begin from the coefficients as
        configured and from those that fit windows of a second, which is nearly least squares and
        has hardly a second minimum. None where neither can be simulated."""
        begins, spans = [self.given], shortened(self.problem.streams, self._spans)
        with contextlib.suppress(UserError):  # too little odometry in any
            short = fit(WindowedProblem(self.problem.streams, spans), self.given)
            begins += [] if short is None else [short.hypothesis]
        # What errors of the attitude make is taken along the first motion that is simulated: that
        # of the configuration, if it can be.
        measured = self.problem.measured_starts(), np.full(6, FIRST_NOISE)
        next(filter(None, (linearise(self.problem, h, *measured) for h in begins)), None)
        fits = self.problem.map(lambda h: fit(self.problem, h), begins)
        return likeliest(fits)

    def run(self, progress: Progress | None = None, start: Fitted | None = None) -> list[Fitted]:
        """The fit of the model as it is, then that of each larger one."""
        start = start or self.start()
        if start is None:
            return []
        path = [start]
        while len(path) <= _MOST_EFFECTS and not self._budget_spent():
            larger = self.extended(path[-1], progress)
            if larger is None:
                break
            path.append(larger)
        return path

    def extended(self, now: Fitted, progress: Progress | None = None) -> Fitted | None:
        """The model with the one effect more that explains most; None where nothing is left."""
        candidates = self.candidates(now)
        if progress is not None:
            progress(", ".join(f"{c.name} {c.score:.0f}" for c in candidates[:5]))
        fits = self.fit_best(now, candidates, [*self._late_thrust(now), *self._apart(now)])
        best = self._best(now, fits)
        if best is None or added_effect(now, best) not in HULL_DAMPING:
            both = self._best(now, self._damping_and_late_thrust(now, candidates))
            best = self._cheapest([best, both])
        if best is None:
            damping = [f for f in fits if added_effect(now, f) in HULL_DAMPING]
            best = self._best(now, damping, HULL_DAMPING_ASKED)
        return best and (refit(best.hypothesis, best.linearisation, update_noise=True) or best)

    def candidates(self, now: Fitted, name: str = "") -> list[Candidate]:
        """But for those that imitate a term that every vehicle has and the model lacks, unless that
        term is the effect ``name``."""
        h, lacking = now.hypothesis, self.screening.lacks_plainer
        found = self.screening.candidates(now)
        return [c for c in found if EFFECTS[c.name].beyond == name or not lacking(c.name, h)]

    def _best(
        self, now: Fitted, fits: Sequence[Fitted], asked: float = VERY_STRONG
    ) -> Fitted | None:
        """The fit with the best penalised score, if it is as good as asked; hull damping first, and
        what lasts before what would have begun before anything could be seen of it."""
        if not fits:
            return None
        closest = min(fits, key=lambda f: f.squares)
        good = [f for f in fits if self.improvement(now, f, closest) >= asked]
        good = [f for f in good if self.is_determined(now, f)]
        names = {added_effect(now, f) for f in good}
        good = [f for f in good if not (self._was_there(now, f) & names)]
        damping = [f for f in good if added_effect(now, f) in HULL_DAMPING]
        return min(damping or good, key=lambda f: self.cost(f, closest), default=None)

    def _was_there(self, now: Fitted, larger: Fitted) -> set[str]:
        """The lasting effects that one with an onset is the same as, where that lies before the end
        of the first window; none elsewhere."""
        h, seen = larger.hypothesis, self.problem.seen
        early = [k for k in onsets(h) if k not in now.hypothesis.values and h.values[k] <= seen]
        return {name for effect, _ in early for name in EFFECTS[effect].lasting}

    def _cheapest(self, fits: Sequence[Fitted | None]) -> Fitted | None:
        """The fit with the best penalised score of those that there are."""
        there = [f for f in fits if f is not None]
        closest = min(there, key=lambda f: f.squares, default=None)
        return closest and min(there, key=lambda f: self.cost(f, closest))

    def _damping_and_late_thrust(
        self, now: Fitted, candidates: Sequence[Candidate]
    ) -> list[Fitted]:
        """Full fits of hull damping and late thrust at once, where neither shows without the other:
        what shows by itself in a model that lacks both may only imitate the two, as a limit of the
        thrust, or products of velocities, on the measured record of docs/tank.md."""
        if set(LATE_THRUST) <= set(now.hypothesis.effects):
            return []
        damping = [c for c in candidates if c.name in HULL_DAMPING]
        fits = self.problem.map(lambda c: self._with_damping(now, c), damping)
        return [f for of in fits for f in of]

    def _with_damping(self, now: Fitted, candidate: Candidate) -> list[Fitted]:
        """Full fits with hull damping, and late thrust."""
        units = self.screening.units(EFFECTS[candidate.name], now.hypothesis)
        zeros = dict.fromkeys((k for u in units for k in u), 0.0)
        begin = now.hypothesis.having({**zeros, **candidate.start})
        damped = refit(begin, now.linearisation)
        late = [late() for late in self._late_thrust(damped)] if damped else []
        pruned = [self._pruned(fitted, now) for fitted in late]
        return [f for f in pruned if f is not None and set(zeros) & set(f.hypothesis.keys)]

    def _late_thrust(self, now: Fitted) -> list[Task]:
        """Full fits of late thrust, begun well away from none: a model that lacks it has taken so
        much added mass in its stead that its linearisation does not show it."""
        lacking = [n for n in LATE_THRUST if n not in now.hypothesis.effects]
        starts = [
            {(name, p.name): p.null + FARTHEST * p.typical}
            for name in lacking
            for p in EFFECTS[name].parameters
        ]
        return [partial(refit, now.hypothesis.having(s), now.linearisation) for s in starts]

    def _apart(self, now: Fitted) -> list[Task]:
        """Full fits in which each record has values of its own of one effect of a dive."""
        fits: list[Task] = []
        for name in self.named(now):
            keys, effect = self.keys_of(now, name), EFFECTS.get(name)
            if effect is None or any(role_of(k) == "onset" for k in keys):
                continue
            units = self.screening.own_units(effect, now.hypothesis.without(keys))
            own = {k for unit in units for k in unit}
            each = itertools.product(keys, range(self._records))
            if is_shared(keys) and own.issuperset(
                of_record(k, r) for k, r in each if role_of(k) == "amplitude"
            ):
                values = [{k: now.hypothesis.values[k] for k in keys}] * self._records
                fits.append(partial(with_own, now, keys, values))
        return fits

    def fit_best(
        self, now: Fitted, candidates: Sequence[Candidate], others: Sequence[Task] = ()
    ) -> list[Fitted]:
        """Full fits of the best candidates, and of what is lacking most often, whatever its score:
        a model that lacks it can be too far off for its linearisation to show it; and ``others``,
        divided between two processes with these."""
        least = max(_LEAST_SHARE * candidates[0].score, 0.0) if candidates else 0.0
        chosen = [c for c in candidates[:_FITTED] if c.score >= least]
        white = sorted((c for c in candidates if c.white_score > 0.0), key=lambda c: -c.white_score)
        chosen += [c for c in white[:_FITTED_WHITE] if c not in chosen]
        chosen += [c for c in candidates if c.name in LIKELIEST and c not in chosen]
        tasks = [partial(self._fit_candidate, now, c) for c in chosen] + [*others]
        found = self.problem.map(lambda task: task(), tasks)
        if chosen and _is_far_from(now, found[0], chosen[0]):
            both = filter(None, (found[0], self._fit_candidate(now, chosen[0], from_file=True)))
            found[0] = min(both, key=lambda f: f.squares, default=None)
        for f in found[: len(chosen)]:
            if f is not None:
                self._ends[f.hypothesis.structure] = f.hypothesis
        return [f for f in found if f is not None]

    def _fit_candidate(
        self, now: Fitted, candidate: Candidate, from_file: bool = False
    ) -> Fitted | None:
        """A full fit; one of the same parameters, as rivals often are, begins where the last one
        has ended."""
        h = now.hypothesis.shaped(candidate.constants).having(candidate.start)
        known = self._ends.get(h.structure)
        start = now.linearisation
        there = self._from_file(now, h) if from_file else refit(h, start, known=known)
        apart = any(p.axis for p in EFFECTS[candidate.name].parameters)
        if there is not None and (apart or candidate.name in HULL_DAMPING):
            there = self._pruned(there, now)
        if there is None:
            return None
        new = [k for k in there.hypothesis.keys if k not in now.hypothesis.values]
        if not any(role_of(k) in ("amplitude", "limit") for k in new):
            return None
        return there if known is not None else with_best_onsets(there, candidate.start)

    def _from_file(self, now: Fitted, h: Hypothesis) -> Fitted | None:
        """A full fit that begins from the coefficients as configured: those of a model that lacks
        an effect may be too far off for one that has it to come back."""
        there = fit(self.problem, h.having(self.given.values))
        if there is None:
            return None
        starts = there.linearisation.starts
        begin = linearise(self.problem, there.hypothesis, starts, now.noise)
        return None if begin is None else refit(there.hypothesis, begin)

    def _pruned(self, fitted: Fitted | None, base: Fitted) -> Fitted | None:
        """Without the coefficients, and parameters of single axes, beyond ``base`` that are not
        worth their penalty. Of the parameters of an effect a single window is not enough, as of an
        axis that is hardly driven; the drag of a hull is there anyway.
        """
        while fitted is not None:
            worthless = _worthless(fitted, base)
            if not worthless:
                return fitted
            fitted = refit(fitted.hypothesis.without(worthless), fitted.linearisation)
        return None

    def try_rivals(self, final: Fitted, progress: Progress | None = None) -> tuple[Fitted, Trials]:
        """Every effect against its rivals, the others in place, until nothing changes, or only what
        was tried before would come again: costs are in units of what each model leaves, by which
        each of two may seem the better."""
        seen: set[object] = set()
        while True:
            last = len(seen) == _ROUNDS or final.hypothesis.structure in seen
            seen.add(final.hypothesis.structure)
            # patterns first: one is replaced more often than a name, and then all are tried again
            names = sorted(self.named(final), key=lambda n: not n.startswith(UNKNOWN))
            rests = list(self.rests(final, names).items())
            trials: Trials = {}
            better: dict[str, Fitted] = {}
            while len(trials) < len(rests) and not better:
                pair = dict(rests[len(trials) : len(trials) + 2])  # one for each of two processes
                trials |= self.trials(pair)
                if not (last or self._budget_spent()):
                    each = ((name, self._better(final, name, trials[name])) for name in pair)
                    better = {name: fitted for name, fitted in each if fitted is not None}
            if not better:
                return final, trials
            name, final = next(iter(better.items()))
            if progress is not None:
                progress(f"{name} gives way")
            final = refit(final.hypothesis, final.linearisation, update_noise=True) or final
            if final.hypothesis.structure not in seen and not self._budget_spent():
                final = self.extended(final) or final

    def rests(self, final: Fitted, names: Sequence[str]) -> dict[str, Fitted]:
        """The fits without each of these effects."""
        rests = self.problem.map(lambda n: self.rest(final, n), names)
        return {n: rest for n, rest in zip(names, rests, strict=True) if rest is not None}

    def trials(self, rests: Mapping[str, Fitted]) -> Trials:
        """Of each of several effects, from the fits without it."""
        found = self.problem.map(lambda of: self._trial(of[1], of[0]), rests.items())
        self.cut_short |= any(not trial.whole for trial in found)
        return dict(zip(rests, found, strict=True))

    def _trial(self, rest: Fitted, name: str) -> Trial:
        whole = not self._budget_spent()
        rivals = self._rivals(rest, name) if whole or name in EFFECTS else {}
        return Trial(rest, rivals | self._patterns_for(rest, name) if whole else rivals, whole)

    def rest(self, fitted: Fitted, name: str) -> Fitted | None:
        """The fit without an effect."""
        rest = fitted.hypothesis.without(self.keys_of(fitted, name))
        return refit(rest, fitted.linearisation)

    def with_other_factors(self, final: Fitted, rest: Fitted, key: Key) -> Fitted | None:
        """The fit that has in place of one parameter of an effect, in ``final`` and not in
        ``rest``, those of other axes that are worth their penalty."""
        h = final.hypothesis.without([key])
        others = [k for u in self.screening.units(EFFECTS[key[0]], h) for k in u if k != key]
        begin = h.having({k: bounds(k)[0] for k in others})
        return self._pruned(refit(begin, final.linearisation), rest) if others else None

    def with_others_off(self, final: Fitted, key: Key) -> Fitted | None:
        """The fit in which, in place of the thrust of one record by a factor, that of all others is
        off by the inverse, and drag and inertia with it."""
        h, record = final.hypothesis, record_of(key)
        inverse = 1.0 / max(h.values[key], 1e-9)
        if not bounds(key)[1] < inverse < bounds(key)[2]:
            return None
        of_others = (of_record(shared(key), r) for r in range(self._records) if r != record)
        coefficients = [k for k in h.keys if k[0] == COEFFICIENTS]
        mine = [k for k in coefficients if axis_of(key) in ("", axis_of(k))]
        scaled = {k: inverse * h.values[k] for k in mine}
        begin = h.without([key]).having(scaled | dict.fromkeys(of_others, inverse))
        return refit(begin, final.linearisation)

    def with_other_thruster(self, final: Fitted, rest: Fitted, name: str) -> Fitted | None:
        """The fit that has in place of an effect of one thruster, in ``final`` and not in ``rest``,
        that of the thruster that suits second best."""
        mine = final.hypothesis.thruster(name)
        found = [c for c in self.candidates(rest, name=name) if c.name == name]
        others = [c for c in found if rest.hypothesis.shaped(c.constants).thruster(name) != mine]
        return self._cheapest([self._fit_candidate(rest, c) for c in others])

    def with_own_arm(self, fitted: Fitted, inflation: float) -> tuple[Fitted, float]:
        """The fit with the height of the centre of buoyancy that suits it, as far as the file
        leaves that open, where squares count as if white over ``inflation``; and the square of how
        far that is, in standard deviations."""
        std, raised = cob_std(self.config), 0.0
        for _ in range(_ARM_STEPS if std > 0.0 else 0):
            h, line = fitted.hypothesis, fitted.linearisation
            column = line.sensitivity_to(std * self.problem.raising(h.model.body)[:, :, None])
            base = line.columns
            column -= base @ scaled_solve(fitted.linear.normal, base.T @ column, 1e-9)
            slope, normal = float(column[:, 0] @ line.error), float(np.sum(column**2))
            step = (slope - inflation * raised) / (normal + inflation)
            model = h.config.model
            cob = model.body.cob + [0.0, 0.0, std * step]
            model = replace(model, body=replace(model.body, cob=cob))
            there = refit(replace(h, config=h.config.with_model(model)), line)
            if there is None or there.rss + inflation * (2.0 * raised + step) * step > fitted.rss:
                break
            fitted, raised = there, raised + step
        return fitted, raised**2

    def _rivals(self, rest: Fitted, name: str) -> dict[str, Fitted]:
        """What other effects might explain what ``name`` explains: fits by the name of the rival.
        An effect is not named without them, whatever the budget: they take little of it."""
        candidates = [c for c in self.candidates(rest, name=name) if c.name != name]
        fits = self.by_effect(rest, self.fit_best(rest, candidates))
        fits.pop(name, None)  # two families share some coefficients
        return fits

    def by_effect(self, rest: Fitted, fits: Iterable[Fitted]) -> dict[str, Fitted]:
        """Fits that each have one effect more than ``rest``, the best of each effect by its name:
        all records may share it, or single ones have it."""
        found: dict[str, list[Fitted]] = {}
        for f in fits:
            found.setdefault(added_effect(rest, f), []).append(f)
        best = {name: self._cheapest(of) for name, of in found.items()}
        return {name: f for name, f in best.items() if f is not None}

    def _patterns_for(self, rest: Fitted, name: str) -> dict[str, Fitted]:
        """The same of patterns of no known cause."""
        fits, given = self.patterns.fits(rest), (*HULL_DAMPING, "thrust_advance")
        if name in EFFECTS and EFFECTS[name].place in ("wrench", "input") and name not in given:
            interplay = self.patterns.interplay(rest)
            fits |= {} if interplay is None else {INTERPLAY_NAME: interplay}
        return fits

    def _better(self, final: Fitted, name: str, trial: Trial) -> Fitted | None:
        """What should stand in place of ``name``, if anything. A pattern can imitate any cause, and
        what a model should have anyway is likelier than what few vehicles meet: such a rival must
        explain clearly more, unless it is in the model anyway."""
        now = self.cost(final, final)
        there = self.named(final)
        explained = max(trial.rest.squares - final.squares, 1e-9)
        choices = [trial.rest]
        for rival, fitted in trial.rivals.items():
            margin = 0.0
            if rival == INTERPLAY_NAME or (rival in EFFECTS and EFFECTS[rival].beyond == name):
                continue
            if rival.startswith(UNKNOWN) and not name.startswith(UNKNOWN):
                margin = 0.0 if rival in there else _MORE_THAN_NAMED
            elif name in HULL_DAMPING and rival not in HULL_DAMPING:
                margin = _MORE_THAN_DAMPING
            clear = now - self.cost(fitted, final) > 3.0 * VERY_STRONG
            clear = clear and final.squares - fitted.squares > margin * explained
            if (margin == 0.0 or clear) and self.is_determined(trial.rest, fitted):
                choices.append(fitted)
        best = min(choices, key=lambda f: self.cost(f, final))
        return best if self.cost(best, final) < now else None

    def unexplained(self, final: Fitted) -> list[Fitted]:
        """Fits with the patterns that are left, one after the other."""
        found: list[Fitted] = []
        while len(found) < _MOST_PATTERNS and not (found and self._budget_spent()):
            asked = VERY_STRONG + choice_penalty(self.patterns.patterns(final))
            tried = self.patterns.fits(final).values()
            fits = [f for f in tried if self.improvement(final, f, f) >= asked]
            if not fits:
                break
            final = min(fits, key=lambda f: self.cost(f, fits[0]))
            found.append(final)
        return found

    def improvement(self, now: Fitted, larger: Fitted, best: Fitted) -> float:
        """The penalised score of what a larger model has more, in the units of ``best``; also by
        the variance inflation of that alone (but for onsets, known from one window), whichever is
        less. What noise of the reading can make by chance is taken off."""
        gain = self.cost(now, best) - self.cost(larger, best)
        new = [k for k in larger.hypothesis.keys if k not in now.hypothesis.values]
        dates = onsets(larger.hypothesis)
        own = variance_inflation_of(larger.linear, [k for k in new if k not in dates])
        by_chance = _NOISE_STD * (now.noise_squares - larger.noise_squares).std(ddof=1)
        gain -= by_chance / best.inflation
        alone = (now.squares - larger.squares - by_chance) / max(own, 1e-9) - PENALTY * len(new)
        return float(min(gain, alone))

    def is_determined(self, now: Fitted, larger: Fitted) -> bool:
        """Whether the data, not the bounds, determine the parameters that a larger model has more:
        no effect took over most of the drag of the hull, no failure at a time was there from the
        start, no Coriolis term is larger than the mass that it would come from, and nothing hangs
        surely farther out than on an arm as long as the hull."""
        h, variance = larger.hypothesis, np.diag(larger.covariance)
        std = dict(zip(larger.linear.keys, np.sqrt(np.maximum(variance, 0.0)), strict=True))
        new = [k for k in h.keys if k not in now.hypothesis.values]
        name = added_effect(now, larger)
        plainer = EFFECTS[name].beyond if name in EFFECTS else ""
        own = [(COEFFICIENTS, c) for c in EFFECTS[plainer].coefficients] if plainer else []
        left = [(h.values[k], now.hypothesis.values[k]) for k in own if k in h.values]
        begun = [k for k in onsets(h) if k in new and len(EFFECTS[k[0]].lasting) == 1]
        is_drag = any(abs(after) < _OWN_DRAG * abs(before) for after, before in left)
        is_gain = any(h.values[k] <= 0.0 for k in begun)
        mass = np.diag(h.model.mass_matrix)[:3].max()  # no product of velocities has more
        is_absurd = any(abs(h.values[k]) > mass for k in new if effect_of(k, new) == "coriolis")
        arms = reach(self.config, new).items()
        is_absurd |= any(abs(h.values[k]) - 2.0 * std[k] > far for k, far in arms)
        return not (
            is_drag or is_gain or is_absurd or any(at_bound(k, h.values[k], std[k]) for k in new)
        )

    def cost(self, fitted: Fitted, best: Fitted) -> float:
        """Squared residuals in the units of ``best``, and the penalty of the added parameters."""
        extra, squares = len(fitted.hypothesis.keys) - len(self.given.keys), fitted.squares
        if not np.allclose((fitted.noise / best.noise) ** 2, 1.0):
            starts = fitted.linearisation.starts
            there = linearise(self.problem, fitted.hypothesis, starts, best.noise)
            assert there is not None
            squares = Fitted(fitted.hypothesis, there, fitted.converged).squares
        return squares / best.inflation + PENALTY * extra

    def named(self, fitted: Fitted) -> list[str]:
        """The effects (and patterns) that a model has beyond the given one."""
        added = self._added(fitted)
        return list(dict.fromkeys(effect_of(k, added) for k in added))

    def keys_of(self, fitted: Fitted, name: str) -> list[Key]:
        added = self._added(fitted)
        return [k for k in added if effect_of(k, added) == name]

    def _added(self, fitted: Fitted) -> list[Key]:
        own = set(self.given.keys)
        return [k for k in fitted.hypothesis.keys if k not in own]


def _worthless(fitted: Fitted, base: Fitted) -> list[Key]:
    """The parameters of single axes beyond ``base`` that are not worth their penalty: one after the
    other leaves, the rest refitted linearly."""
    h, linear = fitted.hypothesis, fitted.linear
    value = np.array([h.values[k] - bounds(k)[0] for k in linear.keys])
    inverse = scaled_inverse(linear.normal)
    by_window = np.array([k[0] != COEFFICIENTS for k in linear.keys])
    wider = by_window * np.diag(fitted.covariance) / np.maximum(np.diag(inverse), _ZERO)
    factor = np.maximum(fitted.inflation, wider)
    left = [k for k in h.keys if k not in base.hypothesis.values and axis_of(k)]
    gone = []
    while left:
        at = linear.index(left)
        variance = (factor * np.diag(inverse))[at]
        seen = variance > 0.0  # of the others nothing is known
        gains = np.divide(value[at] ** 2, variance, out=np.zeros(len(at)), where=seen)
        least = int(np.argmin(gains))
        if gains[least] > PENALTY:
            break
        gone.append(left.pop(least))
        i = at[least]
        column = inverse[:, i] / max(inverse[i, i], _ZERO)
        value, inverse = value - column * value[i], inverse - np.outer(column, inverse[i])
    return gone


def _is_far_from(now: Fitted, there: Fitted | None, candidate: Candidate) -> bool:
    """Whether a full fit explains far less than the linearisation of ``now`` promised."""
    explained = 0.0 if there is None else now.squares - there.squares
    return explained < _PROMISED * candidate.white_score > VERY_STRONG


def likeliest(fits: Iterable[Fitted | None]) -> Fitted | None:
    """Of fits of a structure, each with the noise that it leaves, the likeliest that there is."""
    there = [f for f in fits if f is not None]

    def spread(f: Fitted) -> float:
        return float(np.log(f.noise[~f.linearisation.problem.guided]).sum())

    return min(there, key=spread, default=None)


def shortened(streams: Streams, spans: Sequence[tuple[float, float]]) -> Spans:
    """The spans cut into windows of about a second."""
    length = max(_SHORT, _FEWEST_SHORT * float(np.median(np.diff(streams.t))))
    edges = (np.linspace(a, b, max(1, int((b - a) / length)) + 1) for a, b in spans)
    return [pair for of in edges for pair in itertools.pairwise(of.tolist())]


def with_own(
    now: Fitted, keys: Sequence[Key], values: Sequence[Mapping[Key, float]]
) -> Fitted | None:
    """The fit in which the parameters ``keys`` belong to each of several records, from the
    ``values`` of each; one that is empty has none."""
    own = {of_record(k, r): of[k] for r, of in enumerate(values) if of for k in keys}
    return refit(now.hypothesis.without(keys).having(own), now.linearisation)


def added_effect(rest: Fitted, larger: Fitted) -> str:
    """The effect (or pattern) that a larger model has more."""
    old = set(rest.hypothesis.keys)
    added = [k for k in larger.hypothesis.keys if k not in old]
    return effect_of(added[0], added)
