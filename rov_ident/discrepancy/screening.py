"""Which effects of the library may be missing from a fit, by their penalised scores.

All effects are scored on the linearisation of the fit, its own parameters refitted along. What is
not linear in a parameter (an onset, a place of attachment, a frequency) is scanned.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from rov_ident.discrepancy.hypothesis import (
    COEFFICIENTS,
    Hypothesis,
    Key,
    axis_of,
    bounds,
    is_shared,
    of_record,
    own_units,
    parameter,
    record_of,
    role_of,
    units,
)
from rov_ident.discrepancy.output_error import Fitted
from rov_ident.discrepancy.selection import PENALTY, scores_of
from rov_ident.discrepancy.windowed_problem import WindowedProblem
from rov_ident.effects import EFFECTS, configured_noise, with_trait
from rov_ident.effects.base import Effect
from rov_ident.model.coefficients import AXES
from rov_ident.model.equations import Array
from rov_ident.sampling.wrench_scatter import SHARE

HULL_DAMPING = with_trait("hull")  # what a model lacks of it is the likeliest cause

FARTHEST = 3.0  # typical sizes from null at which a fit of an input effect begins, as the wrench is
# not linear in a lag or a deadband; and of the distance of a place of attachment from the origin
_ONSETS = 24  # scanned evenly over the bag: every 7 s of three minutes, about a window apart
_FINE_ONSETS = 17  # scanned around the best of them, to an eighth of that distance
_ONSET_RANGE = 0.04  # of the bag to either side: the distance of the even ones
_LIMITS = (0.9, 0.75, 0.6, 0.45, 0.3)  # of the largest command; below that a limit is no longer one
_THRUSTERS = 3  # of which a failure is tried in full; effort
_PEAKS = 3  # of the spectrum that are tried as the frequency of a wave; effort


@dataclass(frozen=True)
class Candidate:
    """An effect that may be missing: the parameters to add with their first values, its penalised
    score, and the same as if the residuals that it leaves were white: where a model is far off,
    only a fit shows what there is. ``constants`` say of which thruster it is."""

    name: str
    start: Mapping[Key, float]
    score: float
    white_score: float
    constants: Mapping[Key, float] = field(default_factory=dict)


class Screening:
    """The candidates for what a fit lacks."""

    def __init__(
        self, problem: WindowedProblem, records: int = 1, thrusters: Array | None = None
    ) -> None:
        """``records``: how many there are that may differ; ``thrusters`` (6, n): their allocation,
        where it is known."""
        self._problem, self._records = problem, records
        self._shapes = {
            e.name: [{(e.name, n): v for n, v in of.items()} for of in e.of_thrusters(thrusters)]
            for e in EFFECTS.values()
            if e.of_thrusters is not None and thrusters is not None
        }
        self._known: dict[object, list[Candidate]] = problem.memory()

    def candidates(self, now: Fitted) -> list[Candidate]:
        """The best first; remembered for each structure."""
        known = now.hypothesis.structure
        if known not in self._known:
            self._known[known] = self._screened(now)
        return self._known[known]

    def _screened(self, now: Fitted) -> list[Candidate]:
        h, linearisation = now.hypothesis, now.linearisation
        smooth = [
            e
            for e in EFFECTS.values()
            if all(p.role in ("amplitude", "fixed") for p in e.parameters)
        ]
        linear = [(e.name, self.units(e, h)) for e in smooth]
        linear += [(e.name, self.own_units(e, h)) for e in smooth]
        extra = list(dict.fromkeys(k for _, groups in linear for u in groups for k in u))
        scores = scores_of(linearisation, extra, linearisation.sensitivity_of(h, extra))
        candidates = []
        for name, groups in linear:
            apart = not all(map(is_shared, groups))
            found, score, white = scores.select(groups, bounds, apart or name in HULL_DAMPING)
            keys, change = found.keys, found.change
            if name in HULL_DAMPING and score == -np.inf:
                keys = [k for unit in groups for k in unit]
                change = scores.solve(keys, bounds)[0]
            if keys:
                start = first_values(dict(zip(keys, change.tolist(), strict=True)))
                candidates.append(Candidate(name, start, score, white))
        others = [e for e in EFFECTS.values() if not h.has(e.name)]
        tasks = [partial(self._scanned, now, effect) for effect in others]
        placed = [e for e in EFFECTS.values() if any(p.role == "place" for p in e.parameters)]
        own = [(e, unit) for e in placed for unit in self.own_units(e, h)]
        tasks += [partial(self._of_record, now, *of) for of in own]
        candidates += [c for found in self._problem.map(lambda t: t(), tasks) for c in found]
        return sorted(candidates, key=lambda c: (-c.score, -c.white_score))

    def _of_record(self, now: Fitted, effect: Effect, unit: tuple[Key, ...]) -> list[Candidate]:
        """An effect that one of several records has at a place of its own."""
        found = self._best_shape(now, effect, [{}], unit)
        return [] if found is None else [found]

    def units(self, effect: Effect, h: Hypothesis) -> list[tuple[Key, ...]]:
        """Parameters of an effect that h lacks, on axes that show them, in the groups in which they
        may join."""
        groups = [] if effect.of_sensors else units(effect, h, ("amplitude",))
        return [unit for unit in groups if all(self._is_shown(k, h) for k in unit)]

    def own_units(self, effect: Effect, h: Hypothesis) -> list[tuple[Key, ...]]:
        """The same of those that each record may have of its own."""
        groups = own_units(effect, h, self._records)
        return [unit for unit in groups if all(self._is_shown(k, h) for k in unit)]

    def lacks_plainer(self, name: str, h: Hypothesis) -> bool:
        """Whether an effect imitates another that every vehicle has (``Effect.beyond``), and the
        model lacks that one on an axis that is simulated."""
        plainer = EFFECTS[name].beyond if name in EFFECTS else ""
        own = [(COEFFICIENTS, c) for c in EFFECTS[plainer].coefficients[:3]] if plainer else []
        return any(k[1] not in h.coefficients and self._is_simulated(k) for k in own)

    def _is_shown(self, key: Key, h: Hypothesis) -> bool:
        """Whether its axis is simulated, and most that is read of the thrust there is thrust: where
        noise of the reading is believed and not far below it, it is not."""
        if not self._is_simulated(key):
            return False
        axis = axis_of(key)
        if not axis or key[0] not in EFFECTS or EFFECTS[key[0]].act is None:
            return True
        i = AXES.index(axis)
        noise = configured_noise(h.config.effects)[i] ** 2
        return bool(noise <= SHARE * np.mean(self._problem.streams.demand[:, i] ** 2))

    def _is_simulated(self, key: Key) -> bool:
        axis = axis_of(key)
        return not (axis and self._problem.guided[AXES.index(axis)])

    def _scanned(self, now: Fitted, effect: Effect) -> list[Candidate]:
        """An effect with parameters in which the wrench is not linear: an onset, the neighbourhood
        of the origin for a place of attachment, a limit, a frequency."""
        roles = {p.role for p in effect.parameters}
        found: list[Candidate | None] = []
        if "onset" in roles:
            found = [self._with_onset(now, effect), *self._of_thrusters(now, effect)]
        elif "place" in roles:
            places = [p for p in effect.parameters if p.role == "place"]
            signs = itertools.product((-1.0, 0.0, 1.0), repeat=len(places))
            grid = [
                {p.name: s * p.typical for p, s in zip(places, of, strict=True)} for of in signs
            ]
            found = [self._best_shape(now, effect, grid)]
        elif "limit" in roles:
            found = [self._limited(now, effect)]
        elif "frequency" in roles:
            found = self._oscillating(now, effect)
        return [c for c in found if c is not None]

    def _of_thrusters(self, now: Fitted, effect: Effect) -> list[Candidate]:
        """An effect of each of a few thrusters, from the start or with an onset. What a lost one
        leaves is far from white until it is in the model, however well it suits."""
        found = []
        for shape in self._shapes.get(effect.name, ()):
            of = Fitted(now.hypothesis.shaped(shape), now.linearisation, now.converged)
            both = self._best_shape(of, effect, [{}]), self._with_onset(of, effect)
            best = max(filter(None, both), key=lambda c: c.white_score, default=None)
            if best is not None:
                found.append(replace(best, constants=shape))
        return sorted(found, key=lambda c: -c.white_score)[:_THRUSTERS]

    def _with_onset(self, now: Fitted, effect: Effect) -> Candidate | None:
        """The best onset, sought coarsely, then around the best."""
        duration = self._problem.streams.duration
        coarse = np.linspace(_ONSET_RANGE, 1.0 - _ONSET_RANGE, _ONSETS)
        best = self._best_shape(now, effect, [{"onset": t * duration} for t in coarse])
        if best is None:
            return None
        near = np.linspace(-_ONSET_RANGE, _ONSET_RANGE, _FINE_ONSETS) * duration
        onsets = best.start[effect.name, "onset"] + near
        return self._best_shape(now, effect, [{"onset": float(t)} for t in onsets]) or best

    def _limited(self, now: Fitted, effect: Effect) -> Candidate | None:
        """Limits of the thrust on single axes, or of fins, at shares of the largest command: beyond
        it a limit does nothing, so that no derivative at the null shows it."""
        problem, h, motion = self._problem, now.hypothesis, now.linearisation.motion
        given = {k: problem.largest(k) for k in self._own(effect, h) if role_of(k) == "limit"}
        largest = {k: top for k, top in given.items() if top > 0.0}
        columns, labels = [], []
        for share in _LIMITS:
            values = {k: share * top for k, top in largest.items()}
            for k in largest:
                of = values if axis_of(k) else {k: values[k]}  # axes act apart
                change = problem.change(h, motion, effect, h.having(of).effects)
                if axis := axis_of(k):
                    change = np.where(np.arange(6) == AXES.index(axis), change, 0.0)
                columns.append(change)
                labels.append((k[1], str(share)))
        if not labels:
            return None
        sensitivity = now.linearisation.sensitivity_to(np.stack(columns, axis=2))
        scores = scores_of(now.linearisation, labels, sensitivity)
        gains = {k: scores.solve([k])[1] for k in labels if scores.solve([k])[0][0] > 0.0}
        best = [
            max(mine, key=lambda k: gains[k])
            for own in largest
            if (mine := [k for k in gains if k[0] == own[1]])
        ]
        selected, score, white = scores.select([(k,) for k in best])
        start = {
            (effect.name, own): float(share) * largest[effect.name, own]
            for own, share in selected.keys
        }
        return Candidate(effect.name, start, score, white) if start else None

    def _own(self, effect: Effect, h: Hypothesis) -> list[Key]:
        """All parameters that h lacks of an effect, on axes that show them."""
        own = units(effect, h, ("amplitude", "limit", "fixed", "place", "onset"))
        return [k for unit in own for k in unit if self._is_shown(k, h)]

    def _best_shape(
        self,
        now: Fitted,
        effect: Effect,
        shapes: Sequence[Mapping[str, float]],
        own: Sequence[Key] = (),
    ) -> Candidate | None:
        """The shape (onset, place) of an effect that scores best, with its linear amplitudes, which
        may be those that a record has of its ``own``. Where a place is not part of the shape, the
        moments that it makes are fitted as well."""
        linearisation = now.linearisation
        record = record_of(own[0]) if own else None
        own = own or [k for unit in units(effect, now.hypothesis, ("amplitude",)) for k in unit]
        keys = [key for key in own if self._is_shown(key, now.hypothesis)]
        if not keys:
            return None
        places = [p for p in effect.parameters if p.role == "place" and p.name not in shapes[0]]
        moments = [(f"{effect.name} moment", p.name) for p in places]
        best: Candidate | None = None
        forces: list[Array] = []
        for shape in shapes:
            at_origin = self._force(now, effect, shape, keys)
            moved = (self._force(now, effect, {**shape, p.name: 1.0}, keys) for p in places)
            forces += [at_origin, *(force - at_origin for force in moved)]
        every = linearisation.sensitivity_to(np.concatenate(forces, axis=2))
        for shape, columns in zip(shapes, np.split(every, len(shapes), axis=1), strict=True):
            scores = scores_of(linearisation, [*keys, *moments], columns)
            groups = [(*keys, *moments)] if moments else [(k,) for k in keys]
            selected, score, white = scores.select(groups, bounds)
            own_penalty = PENALTY * bool(shape)
            both = score - own_penalty, white - own_penalty
            if selected.keys and (best is None or both > (best.score, best.white_score)):
                found = dict(zip(selected.keys, selected.change.tolist(), strict=True))
                if moments and found[keys[0]] == 0.0:
                    continue  # at its bound: where it acts has no meaning
                start = first_values({k: found[k] for k in keys if k in found})
                there = dict(shape)
                for p, m in zip(places, moments, strict=True):
                    limit = FARTHEST * p.typical
                    there[p.name] = float(np.clip(found[m] / found[keys[0]], -limit, limit))
                names = [p.name for p in effect.parameters if p.name in there]
                start |= {_of(record, (effect.name, name)): there[name] for name in names}
                best = Candidate(effect.name, start, *both)
        return best

    def _force(
        self, now: Fitted, effect: Effect, shape: Mapping[str, float], keys: Sequence[Key]
    ) -> Array:
        """The wrench (K, 6, P) of a unit of each amplitude of an effect of this shape."""
        record = record_of(keys[0])
        h = now.hypothesis.having({_of(record, (effect.name, n)): v for n, v in shape.items()})
        return self._problem.columns(h, now.linearisation.motion, keys)

    def _oscillating(self, now: Fitted, effect: Effect) -> list[Candidate | None]:
        """Sinusoidal forces in the world, at the peaks of the spectrum of what is missing: the same
        in all records, and those of each."""
        line, best = now.linearisation, list[Candidate | None]()
        keys = [(effect.name, p.name) for p in effect.parameters if p.role == "amplitude"]
        _, lowest, highest = bounds((effect.name, "frequency"))
        frequencies = [f for f in line.frequencies(_PEAKS) if lowest <= f <= highest]
        shapes = [[{"frequency": f, "phase": p} for p in (0.5 * np.pi, 0.0)] for f in frequencies]
        forces = [[self._force(now, effect, shape, keys) for shape in both] for both in shapes]
        moved = [line.sensitivity_to(np.concatenate(both, axis=2)) for both in forces]
        apart = range(len(self.own_units(effect, now.hypothesis)))
        ways: list[Sequence[int | None]] = [[None], *([apart] if apart else [])]
        for owners in ways:
            found = (self._waves(now, keys, *of, owners) for of in zip(frequencies, moved))
            best.append(max(found, key=lambda c: c.score, default=None))
        return best

    def _waves(
        self,
        now: Fitted,
        keys: Sequence[Key],
        frequency: float,
        columns: Array,
        owners: Sequence[int | None],
    ) -> Candidate:
        """Forces of one frequency, of all records or of each of the ``owners``; ``columns`` (R, 6)
        are what units along north, east and down do, a quarter of a period ahead and as they are.
        """
        line, name = now.linearisation, keys[0][0]
        own = [columns if r is None else columns * line.rows_of(r)[:, None] for r in owners]
        parts = itertools.product(owners, ("cos", "sin"), keys)
        labels = [(f"{name} {part}", _of(r, k)[1]) for r, part, k in parts]
        scores = scores_of(line, labels, np.hstack(own))
        change, gain = scores.solve(labels)
        start: dict[Key, float] = {}
        for r, part in zip(owners, np.split(change, len(owners)), strict=True):
            # one phase for all directions: the best approximation of rank one
            cosine, sine = np.split(part, 2)
            turn = 0.5 * np.arctan2(2.0 * cosine @ sine, cosine @ cosine - sine @ sine)
            amplitude = np.cos(turn) * cosine + np.sin(turn) * sine
            mine = dict(zip(keys, amplitude.tolist(), strict=True))
            mine |= {(name, "frequency"): frequency, (name, "phase"): 0.5 * np.pi - float(turn)}
            start |= {_of(r, key): value for key, value in mine.items()}
        inflations = scores.inflation_with(labels, change), scores.white_inflation(gain, labels)
        both = [gain / inflation - PENALTY * len(start) for inflation in inflations]
        return Candidate(name, start, both[0], both[1])


def _of(record: int | None, key: Key) -> Key:
    return key if record is None else of_record(key, record)


def first_values(change: Mapping[Key, float]) -> dict[Key, float]:
    """First values from a linear estimate, inside the bounds and not too far for input effects."""
    start = {}
    for key, delta in change.items():
        null, lower, upper = bounds(key)
        if key[0] in EFFECTS and EFFECTS[key[0]].of_actuators:
            farthest = FARTHEST * parameter(key).typical
            if parameter(key).unit in ("N", "N m"):
                farthest = np.inf
            delta = float(np.clip(delta, -farthest, farthest))
        start[key] = float(np.clip(null + delta, lower, upper))
    return start
