"""What the model may lack, watched while it runs: the cheap part of :mod:`rov_ident.explain`.

The motion is cut into windows of a few seconds. Each is simulated with the coefficients as they are
estimated then, and every effect of the library that acts on the wrench is scored at its null:
sensitivities of the simulated velocity to its parameters against what the simulation leaves
unexplained (:mod:`rov_ident.evidence`, the same as the offline search). What is remembered of a
window is its normal equations about a common origin, so that windows of different coefficients add
up::

    J'J,  J'(r + J theta_w),  r'r + 2 r'J theta_w + (J theta_w)'(J theta_w)

The score of an effect is what it takes off the squared residuals of the last minutes, beyond what
another choice of the estimated coefficients can, over how much more whole windows scatter than
white residuals (:func:`rov_ident.scores.inflation`). It is worth a word when it passes the price
for the number of effects tried and explains a share of the residual that matters.

Effects on sensors are not watched: they do not act on the wrench, and what gives them away is that
two sensors disagree. Nor is a wave, whose frequency takes a search, nor the slow fade of a battery,
which in the memory of some minutes looks like a thruster gain. Effects with an onset are watched as
if they had always been there; the memory is short enough for that.
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rov_ident.coefficients import ABSOLUTE, AXES, NEGATIVE, ONE, VELOCITIES, parse
from rov_ident.config import Config
from rov_ident.effects import EFFECTS
from rov_ident.effects.base import Effect
from rov_ident.estimate import typical
from rov_ident.evidence import Evidence, Linear, Look
from rov_ident.excitation import authority
from rov_ident.hypothesis import COEFFICIENTS, Hypothesis, Key, bounds, centre, parameter
from rov_ident.messages import Array
from rov_ident.model import Model
from rov_ident.samples import SAMPLE, joined
from rov_ident.scores import SURE, inflation
from rov_ident.shooting import Motion
from rov_ident.streams import Streams
from rov_ident.warm import any_vehicle, end_with_parent

WINDOW = 5.0  # s
MEMORY = 36  # windows
FEWEST = 12  # windows, from which on their scatter says something
ALARM = 1e-4
"""How often a memory full of windows with nothing missing may raise a false alarm."""
SHARE = 0.5
"""The least that an effect must explain: of the residual's power in one of six components."""
LEAST = 0.2
"""The least size of an effect, over one that matters: less is what the attitude is off by."""

_SPACING = 0.045  # s; measurements closer than that add cost, hardly information
_GAP = 0.5  # s without samples: no window reaches across
_NOISE_TIME = 60.0  # s; over which the size of the residual is followed
_MOST = 3  # effects named at once
_AS_GOOD = 0.8  # of what the best explains: what explains more may be it, beyond first order
_ALIKE = 0.9  # of it: what explains that much, with fewer parameters, is named instead
_FITTED = 12  # units that are scored in full

MOTIONS = ("surge", "sway", "heave", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class Suspicion:
    """An effect that the model seems to lack, or one of ``rivals`` that these data cannot tell.

    ``axes`` are letters of XYZKMN, where it shows most; ``parameters`` {name: value}, a linear
    estimate from the effect's null, with ``units``; ``score`` is what it takes off the scaled
    squared residuals, ``price`` what that must exceed, ``share`` what it explains over the mean
    power of a component of the residual.
    """

    effect: str
    axes: str
    parameters: Mapping[str, float]
    units: Mapping[str, str]
    score: float
    price: float
    share: float
    rivals: tuple[str, ...]
    sentence: str


class Window(NamedTuple):
    """What is remembered of a window; P parameters: the estimated ones, then those watched."""

    t: float  # s, of its end
    normal: Array  # (P, P)
    moment: Array  # (P,): J'(r + J theta), theta zero for those watched
    power: float  # of r + J theta
    residuals: int  # so many of them
    strength: (
        Array  # (6, C) of those watched: squared wrenches of a unit of each, over those of work
    )


class Task(NamedTuple):
    """What does not change from window to window."""

    config: Config
    base: tuple[Key, ...]
    units: tuple[tuple[Key, ...], ...]
    prior: Array  # (B,) precision of the base about its values in the configuration
    centre: Array  # (B,)
    sizes: Mapping[Key, float]  # at which a watched parameter matters


class State(NamedTuple):
    """All that the next window needs."""

    windows: tuple[Window, ...]
    noise: Array  # (6,): standard deviation of what a window leaves unexplained


def watched(effect: Effect) -> bool:
    """Whether an effect can be scored as it stands: it acts on the wrench, and at once."""
    searched = {"frequency", "fixed"}
    return effect.sense is None and not any(p.role in searched for p in effect.parameters)


def problem(config: Config) -> Task:
    """What is to be watched in the model of a configuration."""
    model = config.model
    base = (*((COEFFICIENTS, name) for name in config.estimate), *config.estimate_effects)
    size = dict(
        zip(model.names, np.maximum(np.abs(model.theta), 0.2 * typical(model)), strict=True)
    )
    prior = [size[name] ** -2.0 for name in config.estimate]
    prior += [parameter(key).typical ** -2.0 for key in config.estimate_effects]
    units = [u for e in EFFECTS.values() if watched(e) for u in _units(e, config)]
    return Task(
        config,
        base,
        tuple(units),
        np.array(prior),
        np.array(
            [config.effects[e][n] if e in EFFECTS else centre(config, (e, n)) for e, n in base]
        ),
        _sizes(config, [key for unit in units for key in unit]),
    )


def _sizes(config: Config, keys: Sequence[Key]) -> dict[Key, float]:
    """The size at which each parameter matters; of a place times its amplitude."""
    found = tuple(parse(name) for section, name in keys if section == COEFFICIENTS)
    absent = typical(Model(config.model.body, found, np.zeros(len(found))))
    sizes = {(COEFFICIENTS, c.name): float(s) for c, s in zip(found, absent, strict=True)}
    for key in keys:
        if key[0] != COEFFICIENTS:
            sizes[key] = parameter(key).typical
            if _is_place(key):
                amplitude = next(p for p in EFFECTS[key[0]].parameters if p.role == "amplitude")
                sizes[key] *= amplitude.typical
    return sizes


def _units(effect: Effect, config: Config) -> list[tuple[Key, ...]]:
    """The parameters of an effect that the model lacks, in the groups that belong together."""
    if effect.coefficients:
        have = {parse(name).place for name in config.model.names}
        return [
            ((COEFFICIENTS, name),) for name in effect.coefficients if parse(name).place not in have
        ]
    if effect.name in config.effects:
        return []
    roles = ("amplitude", "place")
    mine = [(effect.name, p.name) for p in effect.parameters if p.role in roles]
    return [(key,) for key in mine] if effect.parameters[0].axis else [tuple(mine)]


def init(task: Task) -> State:
    """Nothing seen."""
    odometry, imu = task.config.odometry, task.config.imu
    angular = min(odometry.angular_std, imu.gyro_std)
    return State((), np.repeat([odometry.linear_std, angular], 3))


def step(
    task: Task, state: State, samples: NDArray[np.void], demands: Array, values: Mapping[str, float]
) -> State:
    """Take in a window: samples (k,) of SAMPLE, the demands (d, 7) [t, wrench] that led to them,
    and the estimated coefficients; the next state. The same state where it says nothing."""
    streams = _streams(samples, demands)
    if streams is None:
        return state
    evidence = Evidence(streams, [(float(streams.t[0]), float(streams.t[-1]) + 1e-6)])
    if len(evidence.first) != 1:
        return state
    h = Hypothesis(task.config, {key: values[_label(key)] for key in task.base})
    look = evidence.look(h, evidence.begin(), state.noise)
    if look is None:
        return state
    force = _columns(task, evidence, h, look.motion)
    linear, seen = _levelled(task, look, force)
    theta = np.array(list(h.values.values()))
    b = len(theta)
    through = linear.normal[:, :b] @ theta
    gradient = linear.gradient[0]
    window = Window(
        float(streams.t[-1]),
        linear.normal,
        gradient + through,
        float(linear.rss[0] + 2.0 * gradient[:b] @ theta + theta @ through[:b]),
        linear.count,
        np.sum((force / authority(h.model)[:, None]) ** 2, axis=0),
    )
    blend = min(WINDOW / _NOISE_TIME, 1.0) if state.windows else 1.0
    noise = np.sqrt((1.0 - blend) * state.noise**2 + blend * np.maximum(seen, 1e-6) ** 2)
    return State((*state.windows[-(MEMORY - 1) :], window), noise)


def _levelled(task: Task, look: Look, force: Array) -> tuple[Linear, Array]:
    """The window with its own tilt eliminated, and the size (6,) of what is left in it.

    A filtered attitude is off by about as much throughout a window, and a vehicle that is lightly
    damped and weakly righted, such as a slender one in roll, is turned by that for seconds: per
    window a rotation of unknown size, as large as the attitude's noise, on what is watched, whose
    ``force`` is (K, 6, C).
    """
    evidence, h = look.evidence, look.hypothesis
    down = evidence.steps.middle[:, 2, :]
    tilted = np.cross(np.eye(3)[None], down[:, None, :]) @ h.model.body.restoring.T  # (K, 3, 6)
    columns = look.of(np.concatenate([force, tilted.transpose(0, 2, 1)], axis=2))
    extra = [key for unit in task.units for key in unit]
    whole = look.having((*extra, *(("tilt", a) for a in "xyz")), columns)
    p = len(whole.keys) - 3
    kept = np.eye(3) / task.config.odometry.attitude_std**2 + whole.normal[p:, p:]
    onto = np.linalg.solve(kept, whole.normal[p:, :p])
    turn = np.linalg.solve(kept, whole.gradient[0, p:])
    left = (look.error - columns[:, -3:] @ turn).reshape(-1, 6) * look.noise
    linear = Linear(
        whole.keys[:p],
        whole.normal[:p, :p] - whole.normal[:p, p:] @ onto,
        whole.gradient[:, :p] - whole.gradient[:, p:] @ onto,
        whole.rss - whole.gradient[0, p:] @ turn,
        whole.count,
    )
    return linear, np.sqrt(np.mean(left**2, axis=0))


def _label(key: Key) -> str:
    """A parameter's name among the estimated ones."""
    return key[1] if key[0] == COEFFICIENTS else ".".join(key)


def _columns(task: Task, evidence: Evidence, h: Hypothesis, motion: Motion) -> Array:
    """The wrench (K, 6, C) of a unit of each watched parameter.

    Of an effect that attaches somewhere the columns are those of its amplitude at the body origin,
    and of the amplitude times each coordinate of the place.
    """
    extra = [key for unit in task.units for key in unit]
    plain = [key for key in extra if not _is_place(key)]
    found = dict(zip(plain, evidence.columns(h, motion, plain).transpose(2, 0, 1), strict=True))
    for key in extra:
        if _is_place(key):
            amplitude = next(k for k in plain if k[0] == key[0])
            arm = parameter(key).typical
            there = Hypothesis(h.config, h.values, {key: arm})
            vars(there).update(model=h.model, equations=h.equations)  # the same, and slow to make
            column = evidence.columns(there, motion, [amplitude])[:, :, 0]
            found[key] = (column - found[amplitude]) / arm
    return np.stack([found[key] for key in extra], axis=2)


def _is_place(key: Key) -> bool:
    return key[0] != COEFFICIENTS and parameter(key).role == "place"


def _streams(samples: NDArray[np.void], demands: Array) -> Streams | None:
    """The measured part of the samples as the offline search has it, over ground."""
    kept, last = [], -np.inf
    for i in np.flatnonzero(samples["measured"]).tolist():
        if samples["t"][i] - last >= _SPACING:
            kept.append(i)
            last = samples["t"][i]
    if len(kept) < 8 or len(demands) == 0:
        return None
    rows = samples[kept]
    nu = rows["nu"].copy()
    nu[:, :3] += rows["water"]
    n, none = len(rows), np.zeros((0, 3))
    return Streams(
        rows["t"].copy(), np.zeros((n, 3)), rows["orientation"].copy(), nu,
        np.zeros(0), none, none, demands[:, 0].copy(), demands[:, 1:].copy(),
    )  # fmt: skip


class Watcher:
    """Cuts samples into windows and keeps the suspicions up to date: what a node asks for.

    ``run`` calls a function with its arguments, now or later (a thread's ``submit``); later calls
    must keep their order.
    """

    def __init__(self, config: Config, run: Callable[..., object] | None = None) -> None:
        self._run = run or _at_once
        self._task = problem(config)
        self._samples: list[NDArray[np.void]] = []
        self._demands: list[tuple[float, Array]] = []
        self._begin = np.nan
        self._forget()

    def reset(self) -> None:
        """Forget everything."""
        self._samples.clear()
        self._demands.clear()
        self._run(self._forget)

    def _forget(self) -> None:
        self._state = init(self._task)
        self.suspicions: list[Suspicion] = []

    def take(
        self, samples: NDArray[np.void], demands: list[tuple[float, Array]]
    ) -> tuple[NDArray[np.void], Array] | None:
        """Take samples (k,) and the demands so far, which are emptied; a window that is full."""
        self._demands += demands
        demands.clear()
        t = float(samples["t"][-1])
        if samples["restart"].any() and self._samples:
            # a lone outlier restarts the estimator's observer, but breaks no window
            steps = np.diff(samples["t"], prepend=self._samples[-1]["t"][-1])
            back = np.flatnonzero(steps < 0.0)
            if len(back) or not (steps[samples["restart"]] <= _GAP).all():
                self._samples.clear()
            if len(back):  # a bag that starts again, say: what was before is of another time
                samples = samples[back[-1] :]
                self._demands = _latest(self._demands, t)
        if not self._samples:
            self._begin = float(samples["t"][0])
        self._samples.append(samples)
        if t - self._begin < WINDOW:
            return None
        rows = joined(self._samples)
        told = np.array([[at, *wrench] for at, wrench in self._demands]).reshape(-1, 7)
        # a window begins at the last sample of the one before, with the demand that holds then
        self._samples, self._begin = [rows[-1:]], t
        first = max(int(np.searchsorted(told[:, 0], t, side="right")) - 1, 0)
        self._demands = self._demands[first:]
        return rows, told

    def look(self, window: tuple[NDArray[np.void], Array], values: Mapping[str, float]) -> None:
        """Judge a window by the coefficients as they are now, when there is time for it."""
        self._run(self._look, *window, values)

    def _look(self, samples: NDArray[np.void], demands: Array, values: Mapping[str, float]) -> None:
        self._state = step(self._task, self._state, samples, demands, values)
        self.suspicions = suspicions(self._task, self._state)


def _latest(demands: list[tuple[float, Array]], t: float) -> list[tuple[float, Array]]:
    """Those after the last jump backwards of their clock, which is ``t`` now."""
    for i in range(len(demands) - 1, 0, -1):
        if demands[i][0] < demands[i - 1][0]:
            return demands[i:]
    return [demand for demand in demands if demand[0] <= t]


def is_compiled() -> bool:
    """Whether :func:`compile_all` has been through on this computer."""
    return _COMPILED.exists()


def compile_all() -> None:
    """Compile all kernels on a vehicle at rest, or fetch them compiled."""
    config = any_vehicle()
    rest = np.zeros(101, dtype=SAMPLE)
    rest["t"] = np.linspace(0.0, WINDOW, len(rest))
    rest["measured"], rest["orientation"][:, 0], rest["down"][:, 2] = True, 1.0, 1.0
    task = problem(config)
    step(task, init(task), rest, np.zeros((1, 7)), {"X_u": -1.0})
    with contextlib.suppress(OSError):
        _COMPILED.touch()


_COMPILED = Path(numba.config.CACHE_DIR) / "watch"


def _at_once(function: Callable[..., object], *arguments: object) -> None:
    function(*arguments)


# ------------------------------------------------------------------ judgement


def suspicions(task: Task, state: State) -> list[Suspicion]:
    """What the remembered windows say is missing, the plainest first; empty when nothing is."""
    if len(state.windows) < FEWEST:
        return []
    memory = _Memory(task, state.windows)
    chosen: list[Key] = []
    found: list[Suspicion] = []
    units = list(task.units)
    while len(found) < _MOST:
        best = memory.best(chosen, units)
        if best is None:
            break
        found.append(best)
        chosen += [_key(best.effect, name) for name in best.parameters]
        # The remainder of an effect looks like others, to second order: only its own axes follow.
        units = [u for u in units if _effect(u) == best.effect and not set(u) & set(chosen)]
    own = [[_key(s.effect, name) for name in s.parameters] for s in found]
    return [s for s, keys in zip(found, own, strict=True) if memory.stands(keys, chosen)]


def price(size: int, tried: int) -> float:
    """What ``size`` parameters must take off the scaled squared residuals.

    Chance makes it x with a probability of at most exp(-(x - size) / 2) (x / size)^(size / 2)
    (Chernoff), and that ``tried`` times.
    """
    x = 0.0
    for _ in range(50):
        x = size + size * np.log(max(x, size) / size) + 2.0 * np.log(tried / ALARM)
    return float(x)


class _Trial(NamedTuple):
    """Watched parameters, estimated from their nulls, and the linear problem with them."""

    unit: tuple[Key, ...]
    change: Array
    after: Linear


class _Memory:
    """The sum of windows, ready to be solved for any choice of parameters."""

    def __init__(self, task: Task, windows: Sequence[Window]) -> None:
        self.task, self.windows = task, windows
        self.keys = (*task.base, *(key for unit in task.units for key in unit))
        self.place = {key: i for i, key in enumerate(self.keys)}
        self.normals = np.array([w.normal for w in windows])
        self.moments = np.array([w.moment for w in windows])
        self.powers = np.array([w.power for w in windows])
        self.normal, self.moment = self.normals.sum(axis=0), self.moments.sum(axis=0)
        self.count = sum(w.residuals for w in windows)
        self.strength = np.sum([w.strength for w in windows], axis=0)

    def solve(self, extra: Sequence[Key]) -> tuple[Array, Linear]:
        """The best values (B + E,) of base and extra, and the linear problem there."""
        b = len(self.task.base)
        at = np.array([*range(b), *(self.place[key] for key in extra)])
        prior = np.zeros(len(at))
        prior[:b] = 1e-6 * self.task.prior
        n, m = self.normal[np.ix_(at, at)] + np.diag(prior), self.moment[at]
        m[:b] += prior[:b] * self.task.centre
        size = np.sqrt(np.maximum(np.diag(n), 1e-30))
        value = np.linalg.solve(n / np.outer(size, size) + 1e-9 * np.eye(len(at)), m / size) / size
        gradient = self.moments[:, at] - self.normals[:, at[:, None], at] @ value
        rss = np.maximum(self.powers - (self.moments[:, at] + gradient) @ value, 0.0)
        return value, Linear(tuple(self.keys[i] for i in at), n, gradient, rss, self.count)

    def best(self, chosen: list[Key], units: Sequence[tuple[Key, ...]]) -> Suspicion | None:
        """The unit most worth adding to the chosen parameters, with those that do as well."""
        _, before = self.solve(chosen)
        rss = float(before.rss.sum())
        trials = []
        least = price(1, len(self.task.units)) * rss / self.count
        for unit in self._promising(chosen, units, least):
            value, after = self.solve([*chosen, *unit])
            change = value[len(before.keys) :]
            amplitudes = [(k, d) for k, d in zip(unit, change, strict=True) if not _is_place(k)]
            matters = np.abs(change / [self.task.sizes[key] for key in unit]).max() > LEAST
            if matters and all(_allowed(key, delta) for key, delta in amplitudes):
                trials.append(_Trial(unit, change, after))
        if not trials:
            return None
        tried = len(self.task.units)
        several = [*trials, *self._together(chosen, trials)]
        after = min(several, key=lambda t: t.after.rss.sum()).after
        kappa = inflation(after, np.arange(len(after.keys)))

        def taken(trial: _Trial) -> float:
            return rss - float(trial.after.rss.sum())

        def worth(trial: _Trial) -> float:
            return taken(trial) / kappa - price(len(trial.unit), tried)

        # the plainest of those that explain about as much
        most = max(several, key=worth)
        alike = [t for t in several if taken(t) >= _ALIKE * taken(most)]
        whole = min(alike, key=lambda t: (len(t.unit), _has_onset(t.unit), -worth(t)))
        best = max((t for t in trials if set(t.unit) <= set(whole.unit)), key=worth)
        unit, change = best.unit, best.change
        score = taken(best) / kappa
        asked = price(len(unit), tried)
        share = 6.0 * taken(best) / rss
        if score < asked or share < SHARE:
            return None
        rivals = [
            t.unit
            for t in trials
            if _effect(t.unit) != _effect(unit)
            and (worth(whole) - worth(t) < SURE or taken(t) > _AS_GOOD * taken(whole))
        ]
        axes = self._axes(unit, change)
        values = [bounds(key)[0] + d for key, d in zip(unit, change.tolist(), strict=True)]
        for i, key in enumerate(unit):
            if _is_place(key):
                values[i] = change[i] / change[0] if change[0] else 0.0
        return Suspicion(
            _effect(unit),
            axes,
            {key[1]: float(v) for key, v in zip(unit, values, strict=True)},
            {key[1]: _unit(key) for key in unit},
            float(score),
            asked,
            float(share),
            tuple(dict.fromkeys(_effect(u) for u in rivals)),
            _sentence(unit, axes, rivals),
        )

    def stands(self, keys: Sequence[Key], chosen: Sequence[Key]) -> bool:
        """Whether parameters pass their price without the window that speaks most for them, all
        the others that are ``chosen`` in place: a gust or a knock fills one window, and anything
        may fit it.
        """
        rest = [k for k in chosen if k not in keys]
        _, before = self.solve(rest)
        _, after = self.solve([*rest, *keys])
        taken = before.rss - after.rss
        kappa = inflation(after, np.arange(len(after.keys)))
        asked = price(len(keys), len(self.task.units))
        return bool(taken.sum() - taken.max() > asked * kappa)

    def _together(self, chosen: list[Key], trials: Sequence["_Trial"]) -> list["_Trial"]:
        """All units of an effect that has several, to be compared with effects of one unit."""
        found = []
        for effect in dict.fromkeys(_effect(t.unit) for t in trials):
            own = [t.unit for t in trials if _effect(t.unit) == effect]
            if len(own) > 1:
                unit = tuple(key for u in own for key in u)
                value, after = self.solve([*chosen, *unit])
                found.append(_Trial(unit, value[-len(unit) :], after))
        return found

    def _promising(
        self, chosen: Sequence[Key], units: Sequence[tuple[Key, ...]], least: float
    ) -> list[tuple[Key, ...]]:
        """The units that take most off the squared residuals, and at least that much."""
        b = np.array([*range(len(self.task.base)), *(self.place[key] for key in chosen)])
        n = self.normal
        size = np.sqrt(np.maximum(np.diag(n), 1e-30))
        scaled, moment = n / np.outer(size, size), self.moment / size
        onto = np.linalg.solve(scaled[np.ix_(b, b)] + 1e-9 * np.eye(len(b)), scaled[b])
        left = scaled - scaled[:, b] @ onto
        gradient = moment - moment[b] @ onto
        gains = []
        for unit in units:
            at = np.array([self.place[key] for key in unit])
            a, g = left[np.ix_(at, at)], gradient[at]
            # what the base can mimic to four digits cannot be told from it
            if np.linalg.eigvalsh(a)[0] < 1e-4:
                gains.append(0.0)
            else:
                gains.append(float(g @ np.linalg.solve(a, g)))
        order = np.argsort(gains)[::-1][:_FITTED]
        return [units[i] for i in order if gains[i] > least]

    def _axes(self, unit: Sequence[Key], change: Array) -> str:
        """Where a unit acts: as its name says, or where it moves the vehicle most."""
        own = [_axis(key) for key in unit]
        if all(own):
            return "".join(dict.fromkeys(own))
        at = [self.place[key] - len(self.task.base) for key in unit]
        strength = self.strength[:, at] @ change**2
        return "".join(AXES[i] for i in np.flatnonzero(strength > 0.3 * strength.max()))


def _allowed(key: Key, delta: float) -> bool:
    """Whether a parameter may leave its null this way."""
    null, lower, upper = bounds(key)
    return not ((null == lower and delta < 0.0) or (null == upper and delta > 0.0))


def _has_onset(unit: Sequence[Key]) -> bool:
    section = unit[0][0]
    return section != COEFFICIENTS and any(p.role == "onset" for p in EFFECTS[section].parameters)


def _key(effect: str, name: str) -> Key:
    return (COEFFICIENTS if EFFECTS[effect].coefficients else effect, name)


def _effect(unit: Sequence[Key]) -> str:
    section, name = unit[0]
    if section != COEFFICIENTS:
        return section
    return next(e.name for e in EFFECTS.values() if name in e.coefficients)


def _axis(key: Key) -> str:
    """The axis that the name of a parameter says, or none."""
    section, name = key
    return AXES[parse(name).row] if section == COEFFICIENTS else parameter(key).axis


def _unit(key: Key) -> str:
    section, name = key
    return parse(name).unit if section == COEFFICIENTS else parameter(key).unit


def _sentence(unit: Sequence[Key], axes: str, rivals: Sequence[Sequence[Key]]) -> str:
    where = " and ".join(MOTIONS[AXES.index(a)] for a in axes)
    names = dict.fromkeys(_words(u) for u in [unit, *rivals])
    return f"residual in {where} follows {_pattern(unit)}: {' or '.join(names)} missing?"


def _words(unit: Sequence[Key]) -> str:
    return _effect(unit).replace("_", " ")


def _pattern(unit: Sequence[Key]) -> str:
    """What the residual follows, as a pilot would say or write it."""
    section, name = unit[0]
    if section != COEFFICIENTS:
        return _FOLLOWS.get(EFFECTS[section].place, "").format(_words(unit))
    c = parse(name)
    if c.is_added_mass:
        return f"the acceleration in {MOTIONS[c.column]}"
    right = _factor(c.right)
    return right if c.left == ONE else f"{_factor(c.left)}{right}"


_FOLLOWS = {
    "input": "the thrust",
    "wrench": "attitude, motion or heading",
    "motion": "the heading",
}


def _factor(place: int) -> str:
    """An entry of the extended velocity [1, nu, |nu|, min(nu, 0)]."""
    v = VELOCITIES[(place - 1) % 6]
    if place >= NEGATIVE:
        return f"min({v}, 0)"
    return f"|{v}|" if place >= ABSOLUTE else v


if __name__ == "__main__":
    end_with_parent()
    compile_all()
