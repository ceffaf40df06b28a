"""Bags cut into short windows, on which a hypothesis is simulated.

:class:`WindowedProblem` holds the measured velocities, the wrench and the attitude of all windows,
simulates a hypothesis through them, and says how the wrench on the vehicle changes with each of
its parameters.
"""

import contextlib
import copy
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rov_ident.core import forks
from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_to_matrix, turns
from rov_ident.core.linalg import integral, interpolated
from rov_ident.core.noise import robust_std
from rov_ident.discrepancy.hypothesis import (
    COEFFICIENTS,
    Hypothesis,
    Key,
    in_order,
    is_shared,
    parameter,
    precision,
    record_of,
    shared,
)
from rov_ident.discrepancy.multiple_shooting import (
    Equations,
    Motion,
    Steps,
    acted,
    equations,
    guided_by,
    regressors,
    shoot,
    tangent,
    thrust,
    thrusts,
    wrenches,
)
from rov_ident.discrepancy.reading_noise import SMALL, draws
from rov_ident.effects import (
    EFFECTS,
    Acting,
    Values,
    compiled,
    configured_noise,
    of_the_vehicle,
    on_clock,
    rigid_body,
    steered,
)
from rov_ident.effects.base import Effect, EffectParameter
from rov_ident.model.coefficients import AXES, INPUTS
from rov_ident.model.equations import INERTIA, Array, Indices, Model, RigidBody
from rov_ident.sampling import wrench_scatter
from rov_ident.sampling.raw_streams import Streams, orientation_at
from rov_ident.simulation.open_loop import Guide, simulate

MAX_GAP = 0.5  # s without odometry: no window reaches across; stated in the error message below
FEWEST = 8  # odometry messages in a window: the initial velocity takes one
ONSET_STEP = 0.2  # s; of the difference quotient: several messages, as thrust acts in steps
_AMPLITUDE_STEP = 0.05  # typical sizes; the same for an input effect, whose thrust has kinks
_SMALL_STEP = 1e-3  # typical sizes; the same where the wrench is smooth
_COUNTED_RATE = 50.0  # Hz; the search allows more time for data that are denser (docs/explain.md)
_COUNTED_SECONDS = 120.0  # to fit, of three minutes: a shorter dive may take as long as these
_FASTEST = 1e6  # m/s, rad/s; of what noise is taken to become: squares of it stay finite
_KURTOSIS = 3.0  # mean fourth power of a normal number
_REMEMBERED_NOISE = 8  # the same under noise, which is larger
_REMEMBERED_THRUSTS = 64  # input effects and values: more than one round of candidates

T = TypeVar("T")
R = TypeVar("R")
Spans = list[tuple[float, float]]  # from and to [s] each


class _Remembered:
    """Arrays by key, ``most`` of them; with one more all are forgotten."""

    def __init__(self, most: int) -> None:
        self._most, self._known = most, dict[object, Array]()

    def of(self, key: object, make: Callable[[], Array]) -> Array:
        """The array of a key, which ``make`` makes where it is not known."""
        found = self._known.get(key)
        if found is None:
            if len(self._known) > self._most:
                self._known = {}
            found = self._known[key] = make()
        return found


class WindowedProblem:
    """The windows of one or more bags on which hypotheses are simulated.

    ``measured`` (N, 6) are the velocities at ``times`` (N,), which are the ``nodes`` (N,) of the
    time axis ``steps``; ``window`` (N,) says in which window each lies, ``first`` and ``last``
    (W,) are the nodes where windows begin and end. ``guided`` (6,): axes that follow the
    measurement. ``patterns``: wrenches (K, 6) of no known cause, by key. ``reading_std`` (6,):
    noise of the wrench's reading, which ``lasts`` (6,) so many of them. ``records`` are those of
    the joined ones in which there are steps; ``record`` (K,) is that of each step.
    """

    def __init__(self, streams: Streams, spans: Sequence[tuple[float, float]]) -> None:
        """``spans``: from and to [s] of each window. UserError if there is not enough odometry in
        any."""
        self.streams = streams
        ends, begins = streams.recordings
        keep = np.isfinite(streams.nu).all(axis=1) & within(spans, streams.t)
        keep &= streams.t >= begins[np.searchsorted(ends, streams.t)]
        t = streams.t[keep]
        nodes = _subdivided(t, streams.max_step)
        # From the first command on: lag and delay remember those before the first window. Late
        # thrust changes within a step without a new command: three parts tell how.
        third = np.diff(nodes) / 3.0
        parts = nodes, nodes[:-1] + third, nodes[1:] - third
        pieces = np.unique(np.concatenate([*parts, streams.demand_t]))
        pieces = pieces[pieces <= nodes[-1]]
        held = self._held = np.searchsorted(streams.demand_t, pieces[:-1], side="right") - 1
        self.lasts = streams.noise_lasts
        self.reading_std = wrench_scatter.reading_noise(streams.demand, self.lasts)
        self.orientation, self.guided = orientation_at(streams, nodes), streams.guided
        given = np.empty((0, 6))  # accelerations of the guided axes, from each node to the next
        if self.guided.any():
            nu_dot = np.diff(self._measured_at(nodes), axis=0) / np.diff(nodes)[:, None]
            given = np.where(self.guided, nu_dot, 0.0)
        means, self._ends = _driven(streams, nodes)
        middle = 0.5 * (nodes[1:] + nodes[:-1])
        self.steps = Steps(
            nodes,
            quaternion_to_matrix(self.orientation),
            quaternion_to_matrix(orientation_at(streams, middle)),
            interpolated(streams.t, streams.position, middle),
            pieces,
            streams.demand[held],
            np.isin(pieces[:-1], begins),
            np.searchsorted(pieces, nodes[:-1]),
            means,
            given,
            streams.begin_of(nodes[:-1]),
            streams.begin_of(pieces[:-1]),
        )
        self.record = np.searchsorted(streams.begins, self.steps.begin)
        self.records: list[int] = np.unique(self.record).tolist()
        at = np.searchsorted(nodes, t)
        first, last = [], []
        for begin, end in spans:
            inside = np.flatnonzero((t >= begin) & (t < end))
            for run in np.split(inside, np.flatnonzero(np.diff(t[inside]) > MAX_GAP) + 1):
                if len(run) >= FEWEST:
                    first.append(at[run[0]])
                    last.append(at[run[-1]])
        if not first:
            raise UserError(
                f"odometry with a wrench comes nowhere for {FEWEST} messages without a gap of "
                f"more than {MAX_GAP} s where it is needed: record it at 4 Hz or more, in a "
                "longer bag"
            )
        self.first, self.last = np.array(first, dtype=np.int64), np.array(last, dtype=np.int64)
        window = np.searchsorted(self.first, at, side="right") - 1
        in_window = (window >= 0) & (at <= self.last[np.maximum(window, 0)])
        self.nodes, self.window = at[in_window], window[in_window]
        self.measured = streams.nu[keep][in_window]
        self.times = t[in_window]
        self._memories: list[dict[Any, Any]] = []
        self.patterns: dict[Key, Array] = self.memory()
        self._moves = 0  # of wrenches and simulations, through all windows
        self._driven = _Remembered(_REMEMBERED_THRUSTS)
        self._tilted: Array | None = None
        self._told: NDArray[np.bool_] | None = None
        self._forget()

    def _forget(self) -> None:
        """What is remembered of the thrust."""
        self._thrusts = _Remembered(_REMEMBERED_THRUSTS)
        self._noisy = _Remembered(_REMEMBERED_NOISE)
        self._along: Array | None = None  # the motion along which wrenches are remembered, ...
        self._wrenches_along: dict[object, Array] = {}  # ... and they

    def _measured_at(self, t: Array) -> Array:
        """Velocities (k, 6) between those measured."""
        good = np.isfinite(self.streams.nu).all(axis=1)
        return interpolated(self.streams.t[good], self.streams.nu[good], t)

    def measured_means(self) -> Array:
        """Velocities (K, 6) as measured in the middle of each step."""
        return self._measured_at(0.5 * (self.steps.t[1:] + self.steps.t[:-1]))

    @property
    def work(self) -> float:
        """Steps and measurements through which velocities were simulated, or moved by a wrench
        (each of ``sensitivities``), for each second of data, so far; data count as if they came at
        _COUNTED_RATE at most, and for _COUNTED_SECONDS at least."""
        t, first, last = self.steps.t, self.first, self.last
        once, seconds = np.sum(last - first) + len(self.nodes), float(np.sum(t[last] - t[first]))
        rate = min(float(once) / seconds, 2.0 * _COUNTED_RATE)
        return self._moves * rate * min(seconds / _COUNTED_SECONDS, 1.0)

    def precision(self, h: Hypothesis) -> Array:
        """Of a hypothesis's prior, (P,)."""
        return precision(h, self.streams.has_forces)

    @property
    def seen(self) -> float:
        """The end of the first window [s]: what began before that is told from what was there
        before the bag by that window alone, whose thrust comes from commands that nobody knows."""
        return float(self.steps.t[self.last[0]])

    def count(self, moves: int) -> None:
        """Count simulations, or sensitivities to so many wrenches, of all windows."""
        self._moves += moves

    def memory(self) -> dict[Any, Any]:
        """A dict in which, after :meth:`map`, is what was noted in either process."""
        self._memories.append({})
        return self._memories[-1]

    def map(self, function: Callable[[T], R], of: Iterable[T]) -> list[R]:
        """The function of each of several things, in their order, by two processes. Each begins
        from what is counted and noted now, as if it were the first; all of that is added up."""
        moves, noted = self._moves, [dict(m) for m in self._memories]

        def begun(x: T) -> tuple[R, int, list[dict[Any, Any]]]:
            self._go_back_to(moves, noted)
            out = function(x)
            pairs = zip(self._memories, noted, strict=True)
            new = [{k: v for k, v in m.items() if b.get(k) is not v} for m, b in pairs]
            return out, self._moves - moves, new

        found = forks.divided(begun, of, known=(self, self.streams))
        self._go_back_to(moves, noted)
        for _, more, new in found:
            self._moves += more
            for memory, entries in zip(self._memories, new, strict=True):
                memory |= entries
        return [out for out, _, _ in found]

    def _go_back_to(self, moves: int, noted: Sequence[dict[Any, Any]]) -> None:
        self._moves = moves
        for memory, before in zip(self._memories, noted, strict=True):
            memory.clear()
            memory |= before

    def thrust(self, effects: Values) -> Array:
        """Mean and slope (2, K, 6) of the thrusters' wrench after the input effects."""
        return self._thrusts.of(_inputs(effects), lambda: thrust(self.steps, compiled(effects)))

    def thrust_of(self, h: Hypothesis) -> Array:
        """The same where each record may have its own."""
        thrust = shared = self.thrust(h.effects)
        for record in h.owners:
            own = self.thrust(h.in_record(record).effects)
            if own is not shared:
                thrust = np.where((self.record == record)[:, None], own, thrust)
        return thrust

    def driven(self, effects: Values) -> Steps:
        """The time axis with the inputs as they act, after the effects on fins."""
        key = tuple(sorted((n, *v.values()) for n, v in effects.items() if EFFECTS[n].steer))
        if not key:
            return self.steps
        steps = self.steps

        def acting() -> Array:
            return steered(compiled(effects), np.diff(steps.t), steps.inputs, self._ends)

        return steps._replace(inputs=self._driven.of(key, acting))

    def noisy_thrust(self, effects: Values) -> Array:
        """What noise of the reading adds to the mean thrust in each step, (K, 6, draws)."""

        def added() -> Array:
            of = draws(SMALL * self.reading_std, self.lasts, len(self.streams.demand))
            return self._changed(effects, of[:, self._held]).transpose(1, 2, 0) / SMALL

        return self._noisy.of(_inputs(effects), added)

    def thrust_at_rest(self, effects: Values) -> tuple[Array, Array]:
        """The mean thrust in each step of what is read while a command is taken to rest, (K, 6),
        and of noise alone in its place, (draws, K, 6)."""
        steps, acting, counts = self._as_commanded(effects)

        noise = draws(configured_noise(effects), self.lasts, len(self.streams.demand))
        readings = np.concatenate([self.steps.demand[None], noise[:, self._held]])
        found = thrusts(steps, acting, np.where(counts, 0.0, readings))[:, 0]
        return found[0], found[1:]

    def response(self, effects: Values) -> Array:
        """What a unit of each reading of the wrench adds to the mean thrust in each step, (K, 6,
        D), by changes of the size of their noise."""
        step = SMALL * np.where(self.reading_std > 0.0, self.reading_std, 1.0)
        at = self._held == np.arange(len(self.streams.demand))[:, None]
        return (self._changed(effects, at[:, :, None] * step) / step).transpose(1, 2, 0)

    def _changed(self, effects: Values, changes: Array) -> Array:
        """What changes (N, J, 6) of the pieces as read add to the mean thrust in each step, (N, K,
        6), where they count."""
        steps, acting, counts = self._as_commanded(effects)
        moved = thrusts(steps, acting, steps.demand + counts * changes)[:, 0]
        return moved - thrust(steps, acting)[0]

    def _as_commanded(self, effects: Values) -> tuple[Steps, Acting, NDArray[np.bool_]]:
        """The time axis without what is read while a command is taken to rest, the effects beside
        that, and which readings of the pieces (shaped as ``demand``) still count. A little more
        noise changes nothing of which they are: the threshold between them is a jump."""
        of_vehicle = of_the_vehicle(effects)
        of_reading = {name: values for name, values in effects.items() if name not in of_vehicle}
        demand = self.steps.demand
        read = acted(self.steps, compiled(of_reading), demand[None])[0]
        return self.steps._replace(demand=read), compiled(of_vehicle), read == demand

    def with_less(self, taken: Array) -> "WindowedProblem":
        """The same with something (D, 6) taken off what was read of the wrench."""
        other = copy.copy(self)
        other.steps = self.steps._replace(demand=self.steps.demand - taken[self._held])
        other._forget()
        return other

    def motion(self, h: Hypothesis, starts: Array) -> Motion | None:
        """Simulate from initial velocities (W, 6); None where that diverges, or where the mass
        matrix is not positive definite."""
        masses = np.array([there.model.mass_matrix for there in self._each(h)])
        if not np.isfinite([*h.values.values()]).all() or np.linalg.eigvalsh(masses).min() <= 0.0:
            return None
        wrench = self.thrust_of(h)
        for key, value in h.values.items():
            if key in self.patterns:
                wrench = np.stack([wrench[0] + value * self.patterns[key], wrench[1]])
        self.count(1)
        motion = self._shot(h, wrench, self.first, self.last, starts)
        return motion if np.isfinite(motion.nu[self.nodes]).all() else None

    def _shot(
        self, h: Hypothesis, wrench: Array, first: Indices, last: Indices, starts: Array
    ) -> Motion:
        return shoot(self._equations(h), self.driven(h.effects), wrench, first, last, starts)

    def _each(self, h: Hypothesis) -> list[Hypothesis]:
        """What a hypothesis says of each of the records."""
        return [h.in_record(r) for r in self.records]

    def _equations(self, h: Hypothesis) -> list[Equations]:
        """The equations of motion of each of the records."""
        return [guided_by(there.equations, self.guided) for there in self._each(h)]

    def growth(self, h: Hypothesis) -> Array:
        """Sensitivities (N, 6, 6) to the first velocity of each window along the measured motion:
        of steps that each begin with what was measured."""
        self.count(6)
        inside = [np.arange(a, b) for a, b in zip(self.first, self.last, strict=True)]
        each = np.concatenate(inside)
        starts = self._measured_at(self.steps.t[each])
        along = self._shot(h, self.thrust_of(h), each, each + 1, starts)
        return tangent(along, self.first, self.last, self.nodes)

    def columns(self, h: Hypothesis, motion: Motion, keys: Sequence[Key]) -> Array:
        """How the wrench on the vehicle changes with each parameter, (K, 6, P)."""
        out = np.zeros((len(motion.middle), 6, len(keys)))
        place = {key: i for i, key in enumerate(keys)}
        apart = bool(h.owners) or not is_shared(keys)
        names = [n for section, n in keys if section == COEFFICIENTS]
        if names:
            found = in_order(names)
            model = Model(h.model.body, found, np.zeros(len(found)))
            at, eq = [place[COEFFICIENTS, c.name] for c in found], h.equations.acting
            own = regressors(
                equations(model, eq), self.driven(h.effects), self._relative(h, motion)
            )
            if at == list(range(len(keys))):
                return own
            if at == list(range(len(at))):
                out[:, :, : len(at)] = own  # ten times as fast as by places
            else:
                out[:, :, at] = own
        for key in keys:
            if key in self.patterns:
                out[:, :, place[key]] = self.patterns[key]
        of_effects = [key for key in keys if key[0] in EFFECTS]
        if of_effects and not apart:
            out[:, :, [place[key] for key in of_effects]] = self._of_effects(h, motion, of_effects)
        for record in self.records if of_effects and apart else ():
            rows, there = self.record == record, h.in_record(record)
            mine = [key for key in of_effects if record_of(key) in (None, record)]
            plain = list(dict.fromkeys(shared(key) for key in mine))
            own = self._of_effects(there, motion, plain)[rows]
            at = [plain.index(shared(key)) for key in mine]
            out[np.ix_(rows, range(6), [place[key] for key in mine])] = own[:, :, at]
        return out

    def _of_effects(self, h: Hypothesis, motion: Motion, keys: Sequence[Key]) -> Array:
        """The same of parameters of effects, where all records share them."""
        out = np.zeros((len(motion.middle), 6, len(keys)))
        place = {key: i for i, key in enumerate(keys)}
        for section in dict.fromkeys(s for s, _ in keys):
            effect = EFFECTS[section]
            mine = [p for p in effect.parameters if (section, p.name) in place]
            # parameters of single axes act apart: one difference quotient for all of them
            groups = [[p] for p in mine if not p.axis]
            of_axis = [[p for p in mine if p.axis == a] for a in AXES]
            groups += [[p for p in g if p] for g in itertools.zip_longest(*of_axis)]
            for group in filter(None, groups):
                change = self._difference(h, motion, effect, group)
                for p in group:
                    axes = AXES.index(p.axis) if p.axis else slice(None)
                    out[:, axes, place[section, p.name]] = change[:, axes]
        return out

    def _relative(self, h: Hypothesis, motion: Motion) -> Motion:
        """The motion through the water, where there is a current."""
        each = np.array([there.equations.acting.water for there in self._each(h)])
        if not each.any():
            return motion
        water = each[np.searchsorted(self.records, self.record)]
        drift = np.einsum("kji,kj->ki", self.steps.middle, water)
        turning = np.cross(motion.middle[:, 3:], drift)
        zero = np.zeros_like(drift)
        return motion._replace(
            middle=motion.middle - np.hstack([drift, zero]),
            nu_dot=motion.nu_dot + np.hstack([turning, zero]),
        )

    def _wrenches(self, h: Hypothesis, effects: Values, motion: Motion) -> Array:
        """Wrench effects and current (K, 6) along a motion; remembered for the last one."""
        acting = compiled(effects)
        acted = self.thrust(effects)[0]
        key = tuple(part.tobytes() for part in acting)
        if self._along is not motion.middle:
            self._along, self._wrenches_along = motion.middle, {}
        known = self._wrenches_along
        if key not in known:
            known[key] = wrenches(
                h.equations._replace(acting=acting), self.driven(effects), acted, motion
            )
        return known[key]

    def _difference(
        self, h: Hypothesis, motion: Motion, effect: Effect, group: Sequence[EffectParameter]
    ) -> Array:
        """Change (K, 6) of the wrench per unit of some parameters, all moved at once."""
        now = h.effects.get(effect.name) or h.nulls(effect.name)
        moved, per_unit = dict(now), np.ones(6)
        for p in group:
            step = ONSET_STEP if p.role == "onset" else _SMALL_STEP * p.typical
            if effect.of_actuators and p.role == "amplitude":
                step = _AMPLITUDE_STEP * p.typical
            step = step if now[p.name] + step <= p.upper else -step
            moved[p.name] = now[p.name] + step
            per_unit[AXES.index(p.axis) if p.axis else slice(None)] = step
        return self.change(h, motion, effect, {**h.effects, effect.name: moved}) / per_unit

    def change(
        self, h: Hypothesis, motion: Motion, effect: Effect,
        after: Values,
    ) -> Array:  # fmt: skip
        """Change (K, 6) of the wrench where an effect has other parameters."""
        now = h.effects.get(effect.name) or h.nulls(effect.name)
        before = {**h.effects, effect.name: now}
        change: Array
        if effect.act is not None:
            change = self.thrust(after)[0] - self.thrust(before)[0]
        elif effect.steer is not None:
            nu = self._relative(h, motion).middle
            made = [h.model.input_wrench(nu, self.driven(e).inputs) for e in (before, after)]
            change = made[1] - made[0]
        elif effect.body is not None:
            bodies = [rigid_body(h.config.model.body, e) for e in (before, after)]
            was, there = (_of_body(body, motion, self.steps) for body in bodies)
            change = there - was
        else:
            change = self._wrenches(h, after, motion) - self._wrenches(h, before, motion)
        return change

    def tilted(self, make: Callable[[], Array]) -> Array:
        """The sensitivities (N, 6, 6) to :meth:`tilting`, made once."""
        if self._tilted is None:
            self._tilted = make()
        return self._tilted

    def told(self, make: Callable[[], NDArray[np.bool_]]) -> NDArray[np.bool_]:
        """Which measurements (N,) a simulation from the first velocity predicts, made once."""
        if self._told is None:
            self._told = make()
        return self._told

    def tilting(self, body: RigidBody) -> Array:
        """What an error of the attitude about each body axis adds to the wrench, (K, 6, 6): three
        that fade over each window, and three that grow."""
        wrench = self._tilted_by(body)
        grown = np.zeros((len(wrench), 1, 1))
        for first, last in zip(self.first, self.last, strict=True):
            grown[first:last, 0, 0] = (np.arange(last - first) + 0.5) / (last - first)
        out: Array = np.concatenate([(1.0 - grown) * wrench, grown * wrench], axis=2)
        return out

    def _tilted_by(self, body: RigidBody) -> Array:
        """What a constant error of the attitude about each body axis adds to it, (K, 6, 3)."""
        down = np.cross(self.steps.middle[:, 2, None], np.eye(3))  # how it turns, an axis a row
        wrench: Array = np.swapaxes(down @ body.restoring.T, 1, 2)
        return wrench

    def raising(self, body: RigidBody) -> Array:
        """What a centre of buoyancy one metre further along the body's z axis adds to the wrench,
        (K, 6)."""
        raised = replace(body, cob=body.cob + np.array([0.0, 0.0, 1.0]))
        wrench: Array = self.steps.middle[:, 2] @ (raised.restoring - body.restoring).T
        return wrench

    def of_rigid_body(self, body: RigidBody, motion: Motion) -> Array:
        """What a kilogram more of mass (of the same weight) and 1 kg m2 more of each moment and
        product of inertia, in the order of ``inertia``, adds to the wrench, (K, 6, 7)."""
        others = [replace(body, mass=body.mass + 1.0)]
        for i, j in INERTIA.values():
            more = np.zeros((3, 3))
            more[i, j] = more[j, i] = 1.0
            others.append(replace(body, inertia=body.inertia + more))
        here = _of_body(body, motion, self.steps)
        return np.stack([_of_body(b, motion, self.steps) - here for b in others], axis=2)

    def largest(self, key: Key) -> float:
        """Of what is commanded, where a parameter is a limit of it; of a rate, at which a fin would
        turn from side to side in half a second."""
        p = parameter(key)
        if p.axis:
            return float(np.abs(self.steps.demand[:, AXES.index(p.axis)]).max())
        inputs = np.abs(self.steps.inputs).max(axis=0)
        return float(inputs[INPUTS.index(p.input)] if p.input else 4.0 * inputs[:3].max())

    def errors(self, h: Hypothesis) -> Array:
        """Measured minus simulated velocity (N, 6) in open loop, each window from its measured
        state; NaN where that diverges."""
        guide, nu = None, self._measured_at(self.steps.t)
        simulated = np.full((len(self.steps.t), 6), np.nan)
        starts, records = self.measured_starts(), self.record[self.first].tolist()
        for record, first, last, start in zip(records, self.first, self.last, starts, strict=True):
            there = h.in_record(record)
            (mean, slope), inputs = self.thrust(there.effects), self.driven(there.effects).inputs
            nodes, begin = slice(first, last + 1), float(self.steps.begin[first])
            at = np.minimum(np.arange(first, last + 1), len(mean) - 1)
            if self.guided.any():
                guide = Guide(~self.guided, nu[nodes], self.orientation[nodes])
            with contextlib.suppress(UserError):
                simulated[nodes] = simulate(
                    there.model, self.steps.t[nodes] - begin, mean[at], start,
                    self.steps.position[at[0]], orientation=self.orientation[first],
                    wrench_slope=slope[at], guide=guide,
                    effects=on_clock(compiled(there.effects), begin), inputs=inputs[at],
                ).nu  # fmt: skip
        return self.measured - simulated[self.nodes]

    def variance_of_errors(self, h: Hypothesis) -> Array:
        """Mean squares (N, 6) of :meth:`errors` where nothing but noise is wrong, without that of
        the velocity measured there: what the noise of each window's first state, and of the
        wrench's reading, has become. ``Phi P0 Phi'`` of the linearised equations, and the next term
        along the direction that has grown most: surge has errors of sway times yaw rate.

        About the motion as measured: a simulation that noise has taken elsewhere may have come to
        where no noise grows."""
        t, middle, starts = self.steps.t, self.steps.middle, self._measured_at(self.steps.t)[:-1]
        equations, each = self._equations(h), np.arange(len(starts))
        thrust, driven = self.thrust_of(h), self.driven(h.effects)

        def shot(aside: Array) -> Motion:
            return shoot(equations, driven, thrust, each, each + 1, starts + aside)

        step, dt = shot(np.zeros(6)), np.diff(t)[:, None, None]
        turning, std = dt * middle, self.noise_std()
        if self.guided[3:].any():  # the attitude is measured
            turning, std[:3] = np.zeros_like(turning), 0.0
        std[3:] *= ~self.guided
        righting = step.gamma @ self._tilted_by(h.model.body) @ np.swapaxes(middle, 1, 2)
        read = step.gamma @ self.noisy_thrust(h.effects)
        added = np.concatenate([np.zeros((len(read), 6, 9)), read], axis=2)
        added /= np.sqrt(read.shape[2])

        def carried(begin: Array, added: Array) -> Array:
            """How far (K + 1, 6, C) each of C causes has moved the velocity: a change ``begin``
            (9, C) of each window's first attitude and velocity, and one of the velocity that is
            ``added`` (K, 6, C) in each step. The attitude turns about axes of the world."""
            out = np.zeros((len(t), *begin[3:].shape))
            for first, last in zip(self.first, self.last, strict=True):
                turn, out[first] = self.steps.rotation[first] @ begin[:3], begin[3:]
                for k in range(first, last):
                    turn = turn + 0.5 * turning[k] @ out[k, 3:]
                    moved = step.phi[k] @ out[k] + righting[k] @ turn + added[k]
                    out[k + 1] = np.clip(moved, -_FASTEST, _FASTEST)
                    turn = turn + 0.5 * turning[k] @ out[k + 1, 3:]
            return np.nan_to_num(out, nan=_FASTEST)

        moved = carried(np.diag(std) @ np.eye(9, added.shape[2]), added)
        size = self.measured.std(axis=0) + 1e-9
        power, axes = np.linalg.eigh(np.einsum("kic,kjc->kij", moved, moved) / np.outer(size, size))
        most = size * axes[:-1, :, -1] * np.sqrt(np.maximum(power[:-1, -1:], 0.0))
        bent = 0.5 * (shot(most).nu_dot + shot(-most).nu_dot) - step.nu_dot
        second = carried(np.zeros((9, 1)), dt * bent[:, :, None])
        squares: Array = np.sum(moved**2, axis=2) + _KURTOSIS * second[:, :, 0] ** 2
        return squares[self.nodes]

    def noise_std(self) -> Array:
        """Standard deviations (9,) of the noise of attitude [rad] and velocities, from second
        differences: steady motion adds nothing to these, and quick motion is rare."""
        good = np.isfinite(self.streams.nu).all(axis=1)
        q, nu = self.streams.orientation[good], self.streams.nu[good]
        second = np.hstack([np.diff(turns(q), axis=0), np.diff(nu, 2, axis=0)]) / np.sqrt(6.0)
        return robust_std(second)

    def measured_starts(self) -> Array:
        """The measured velocity (W, 6) at the beginning of each window."""
        at = np.flatnonzero(np.diff(self.window, prepend=-1))
        return self.measured[at].copy()


def _inputs(effects: Values) -> tuple[object, ...]:
    """What the thrust depends on."""
    inputs = {n: tuple(v.values()) for n, v in effects.items() if EFFECTS[n].act is not None}
    return tuple(sorted(inputs.items()))


def _of_body(body: RigidBody, motion: Motion, steps: Steps) -> Array:
    """What the rigid body adds to the wrench side of the equations, (K, 6)."""
    mass, (v, omega) = body.mass_matrix, np.hsplit(motion.middle, 2)
    linear, angular = np.hsplit(motion.middle @ mass.T, 2)
    coriolis = np.hstack([np.cross(omega, linear), np.cross(omega, angular) + np.cross(v, linear)])
    wrench: Array = steps.middle[:, 2] @ body.restoring.T - motion.nu_dot @ mass.T - coriolis
    return wrench


def _driven(streams: Streams, nodes: Array) -> tuple[Array, Array]:
    """The inputs as read, means (K, 4) over the steps between nodes (K + 1,) and values (K, 4) at
    their ends."""
    if not len(streams.inputs_t):
        none = np.zeros((len(nodes) - 1, streams.inputs.shape[1]))
        return none, none
    t = np.unique(np.concatenate([nodes, streams.inputs_t]))
    total = integral(t, interpolated(streams.inputs_t, streams.inputs, t))
    means: Array = np.diff(total[np.searchsorted(t, nodes)], axis=0) / np.diff(nodes)[:, None]
    return means, interpolated(streams.inputs_t, streams.inputs, nodes[1:])


def _subdivided(t: Array, longest: float) -> Array:
    """The instants t and as many between that no step is longer than ``longest``, gaps aside."""
    length = np.diff(t)
    count = np.where(length > MAX_GAP, 1, np.ceil(length / longest - 1e-6)).astype(int)
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
