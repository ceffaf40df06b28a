"""What a simulation may lack: one file for each effect, found because it is in this folder, and
those of installed packages (docs/own-effects.md).

Knows equations and no data: effects on the input, the motion, the wrench and the rigid body. The
kernels below run all effects of one place; :func:`compiled` makes their arguments from the section
``effects`` of a configuration.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.core import plugins
from rov_ident.core.errors import UserError
from rov_ident.core.jit import inlined, kernel, lean
from rov_ident.effects.base import (
    MEMORY,
    SIZE,
    STEER_MEMORY,
    Array,
    Effect,
    EffectParameter,
    Reading,
    Trait,
    a_reading,
)
from rov_ident.effects.checks import faults
from rov_ident.model.coefficients import parse
from rov_ident.model.equations import Model, RigidBody, add_current


def _installed_effects(taken: Mapping[str, Effect]) -> Iterator[tuple[str, Effect]]:
    """Effects that installed packages bring, by the names of their entry points. UserError if one
    is invalid, or its name is taken."""
    names: dict[str, str] = dict.fromkeys(taken, "rov_ident")
    for package, point in plugins.installed():
        effect, name = plugins.loaded(package, point), point.name
        fault = faults(effect)
        if name in names:
            fault = f"has the name of one that {names[name]} has"
        elif not re.fullmatch("[a-z][a-z0-9_]*", name):
            fault = "needs a name of small letters, digits and underscores"
        if fault:
            raise UserError(
                f"the effect {name} of the installed package {package} {fault}: mend or uninstall "
                "that package"
            )
        names[name] = package
        yield name, replace(effect, name=name)


def _library() -> dict[str, Effect]:
    ours = {
        module.name: replace(import_module(f"{__name__}.{module.name}").EFFECT, name=module.name)
        for module in iter_modules(__path__)
        if module.name not in ("base", "checks")
    }
    return {**dict(_installed_effects(ours)), **ours}


EFFECTS: dict[str, Effect] = _library()  # every effect by the name users give it

_INPUT = sorted((e for e in EFFECTS.values() if e.act), key=lambda e: (e.order, e.name))
_STEER = sorted((e for e in EFFECTS.values() if e.steer), key=lambda e: (e.order, e.name))
_WRENCH = [e for e in EFFECTS.values() if e.wrench]
_SENSE = sorted((e for e in EFFECTS.values() if e.sense), key=lambda e: (e.order, e.name))


def _in_turn(calls: list[Any]) -> Any:
    """A function for kernels that makes every call whose effect is there, in turn, from i = 0 on.

    Not a loop over a tuple of functions: numba may take that for one of pointers, which do not
    survive in its cache.
    """
    if not calls:
        return inlined(lambda i, there, arguments: None)
    first, others = calls[0], _in_turn(calls[1:])

    def make(i, there, arguments):  # type: ignore[no-untyped-def]
        if there[i]:
            first(i, arguments)
        others(i + 1, there, arguments)

    return inlined(make)


def _act(act: Any) -> Any:  # of (parameters, state, t, dt, wrench)
    return inlined(lambda i, a: act(a[0][i], a[1][i], a[2], a[3], a[4]))


def _wrench(wrench: Any) -> Any:  # of (parameters, t, position, nu, rotation, thrust, out)
    return inlined(lambda i, a: wrench(a[0][i], a[1], a[2], a[3], a[4], a[5], a[6]))


def _steer(steer: Any) -> Any:  # of (parameters, state, dt, inputs)
    return inlined(lambda i, a: steer(a[0][i], a[1][i], a[2], a[3]))


_ALL_ACTS = _in_turn([_act(effect.act) for effect in _INPUT])
_ALL_STEERS = _in_turn([_steer(effect.steer) for effect in _STEER])
_ALL_WRENCHES = _in_turn([_wrench(effect.wrench) for effect in _WRENCH])

Values = Mapping[str, Mapping[str, float]]
"""The section ``effects`` of a configuration: {effect: {parameter: value}}, complete."""


class Acting(NamedTuple):
    """The effects of a configuration that have kernels."""

    inputs: NDArray[np.bool_]  # which of the input effects are there
    input_parameters: Array  # (inputs, SIZE)
    wrenches: NDArray[np.bool_]
    wrench_parameters: Array  # (wrenches, SIZE)
    water: Array  # (3,) velocity of the water in the world [m/s]
    steers: NDArray[np.bool_]
    steer_parameters: Array  # (steers, SIZE)


def compiled(effects: Values) -> Acting:
    """The effects of a configuration for the kernels."""
    water = np.zeros(3)
    for name, values in effects.items():
        effect = EFFECTS[name]
        if effect.water is not None:
            water = water + effect.water(**values)
    return Acting(
        *_table(_INPUT, effects), *_table(_WRENCH, effects), water, *_table(_STEER, effects)
    )


def on_clock(acting: Acting, begin: float) -> Acting:
    """The same effects, by a clock that begins at ``begin`` [s]: what sets in does so that much
    earlier."""
    if begin == 0.0:
        return acting
    earlier = (begin * _onsets(library) for library in (_INPUT, _WRENCH))
    parameters = acting.input_parameters, acting.wrench_parameters
    inputs, wrenches = (p - e for p, e in zip(parameters, earlier, strict=True))
    return acting._replace(input_parameters=inputs, wrench_parameters=wrenches)


def _onsets(library: list[Effect]) -> Array:
    """One where a parameter (effects, SIZE) is an onset, else zero."""
    out = np.zeros((len(library), SIZE))
    for row, effect in enumerate(library):
        for i, p in enumerate(effect.parameters):
            out[row, i] = p.role == "onset"
    return out


def _table(library: list[Effect], effects: Values) -> tuple[NDArray[np.bool_], Array]:
    there, parameters = np.zeros(len(library), dtype=bool), np.zeros((len(library), SIZE))
    for row, effect in enumerate(library):
        if effect.name in effects:
            values = [effects[effect.name][p.name] for p in effect.parameters]
            there[row], parameters[row, : len(values)] = True, values
    return there, parameters


def rigid_body(body: RigidBody, effects: Values) -> RigidBody:
    """The body with its effects."""
    for name, values in effects.items():
        change = EFFECTS[name].body
        if change is not None:
            body = change(body, **values)
    return body


def sense(reading: Reading, effects: Values) -> Reading:
    """What the sensors give for true velocities."""
    for effect in _SENSE:
        if effect.sense is not None and effect.name in effects:
            reading = effect.sense(reading, **effects[effect.name])
    return reading


def correct(reading: Reading, effects: Values) -> Reading:
    """The true velocities from what the sensors give: the inverse of :func:`sense`."""
    for effect in reversed(_SENSE):
        if effect.correct is not None and effect.name in effects:
            reading = effect.correct(reading, **effects[effect.name])
    return reading


def velocity_delay(effects: Values) -> float:
    """By how many seconds the linear velocities of the odometry are older than its stamp."""
    return sum(late(**v) for n, v in effects.items() if (late := EFFECTS[n].late) is not None)


def heading_error(effects: Values) -> float:
    """What the heading of the odometry's attitude reads too much [rad]."""
    turns = ((EFFECTS[name].heading, values) for name, values in effects.items())
    return sum(heading(**values) for heading, values in turns if heading is not None)


def configured_noise(effects: Values) -> Array:
    """Standard deviations (6,) of what is read of the wrench beside the command [N, N m]."""
    parts = ((EFFECTS[name].noise, values) for name, values in effects.items())
    squares = [noise(**values) ** 2 for noise, values in parts if noise is not None]
    return np.sqrt(np.sum([np.zeros(6), *squares], axis=0))


def of_the_vehicle(effects: Values) -> Values:
    """Without those that only change what is read of the wrench."""
    return {name: values for name, values in effects.items() if EFFECTS[name].noise is None}


def affects_sensors(effects: Values) -> bool:
    """Whether :func:`correct` changes anything."""
    return any(effect.name in effects for effect in _SENSE)


def missing_terms(model: Model) -> tuple[str, ...]:
    """The coefficients of motion that an effect has and the model has not."""
    there = {c.place for c in model.coefficients}
    every = [parse(name) for effect in EFFECTS.values() for name in effect.coefficients]
    missing = {c.place: c.name for c in every if c.place not in there and not c.inputs}
    return tuple(missing.values())


def with_trait(trait: Trait) -> tuple[str, ...]:
    """The names of the effects that have it."""
    return tuple(name for name, effect in EFFECTS.items() if trait in effect.traits)


def parameter(effect: str, name: str) -> EffectParameter:
    return next(p for p in EFFECTS[effect].parameters if p.name == name)


def estimable(name: str) -> dict[str, float | None]:
    """The parameters of an effect that an estimator can follow while the vehicle moves.

    With each of them the value at which it is better left alone unless asked for: the null of a
    parameter of one axis or fin, of which an effect has several, and of a limit; None for others.
    An onset, a frequency and a phase are not among them, nor what shows in no velocity (the sampler
    finds the biases of an IMU itself), nor the noise of a reading.
    """
    effect = EFFECTS[name]
    if effect.heading or effect.noise:
        return {}
    if effect.sense is not None and effect.correct is not None:
        nulls = {p.name: p.null for p in effect.parameters}
        beside = [{**nulls, p.name: p.null + p.typical} for p in effect.parameters]
        same, *moved = (effect.correct(a_reading(), **values) for values in (nulls, *beside))
        if all((m.linear == same.linear).all() for m in moved):
            return {}
    return {
        p.name: p.null if p.axis or p.input or p.role == "limit" or effect.of_thrusters else None
        for p in effect.parameters
        if p.role in ("amplitude", "limit", "place")
    }


def memory() -> Array:
    """The state of all input effects before the first command."""
    return np.zeros((len(_INPUT), MEMORY))


@lean
def act(acting, state, t, dt, wrench):
    """wrench (6,), commanded from t to t + dt, becomes the mean of what acts in that time."""
    _ALL_ACTS(0, acting.inputs, (acting.input_parameters, state, t, dt, wrench))


@kernel
def acted(acting, t, command):
    """The wrench (N, 6) that acts on average from each t (N,) to the next, for a command (N, 6)."""
    out, state = command.copy(), np.zeros((len(acting.inputs), MEMORY))
    for k in range(len(t)):
        dt = t[k + 1] - t[k] if k + 1 < len(t) else 0.0
        act(acting, state, t[k], dt, out[k])
    return out


def steering_memory() -> Array:
    """The state of all effects on fins before the first reading."""
    return np.zeros((len(_STEER), STEER_MEMORY))


@kernel
def steer(acting, state, dt, inputs):
    """Turn inputs (2, 4) as read, means over dt and values at its end, into those that act."""
    _ALL_STEERS(0, acting.steers, (acting.steer_parameters, state, dt, inputs))


@kernel
def steered(acting, dt, means, ends):
    """Means (N, 4) of the inputs that act over steps of dt (N,), from ``means`` and values at the
    ``ends`` (N, 4) as read."""
    out, state = means.copy(), np.zeros((len(acting.steers), STEER_MEMORY))
    inputs = np.empty((2, means.shape[1]))
    for k in range(len(dt)):
        inputs[0], inputs[1] = means[k], ends[k]
        steer(acting, state, dt[k], inputs)
        out[k] = inputs[0]
    return out


@inlined
def surrounds(acting):
    """Whether :func:`add_surroundings` adds anything: most vehicles have none of it."""
    return acting.wrenches.any() or acting.water.any()


@inlined
def add_wrenches(acting, t, position, nu, rotation, thrust, out):
    """Add to out (6,) what the wrench effects do at time t, at ``position`` (3,) in the world and
    nu (6,) relative to the water, while the thrusters give ``thrust`` (6,)."""
    arguments = (acting.wrench_parameters, t, position, nu, rotation, thrust, out)
    _ALL_WRENCHES(0, acting.wrenches, arguments)


@inlined
def add_surroundings(
    acting, structure, added_mass, theta, t, position, nu, rotation, thrust, s, out
):  # fmt: skip
    """Add to out (6,) what wrench effects and moving water do at time t, ``position`` (3,) and nu
    (6,) over ground, while the thrusters give ``thrust`` (6,).

    ``structure``, ``added_mass`` (6, 6, 1), ``theta`` (n, 1): of the model; ``rotation`` (3, 3):
    body axes into the world; s: a record of :data:`rov_ident.model.equations.CURRENT`, work space.
    One version for any effects, as each takes ten seconds to compile.
    """
    north, east, down = acting.water[0], acting.water[1], acting.water[2]
    if north != 0.0 or east != 0.0 or down != 0.0:
        water = (
            rotation[0, 0] * north + rotation[1, 0] * east + rotation[2, 0] * down,
            rotation[0, 1] * north + rotation[1, 1] * east + rotation[2, 1] * down,
            rotation[0, 2] * north + rotation[1, 2] * east + rotation[2, 2] * down,
        )
        add_current(structure, added_mass, theta, nu, water, s, out)
    else:
        for i in range(6):
            s.relative[i] = nu[i]
    add_wrenches(acting, t, position, s.relative, rotation, thrust, out)
