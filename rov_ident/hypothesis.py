"""A hypothesis about what the vehicle is: a configuration with free parameters.

Each parameter is named by a key (section, name): a coefficient ``("coefficients", "X_uu")`` or a
parameter of an effect ``("thruster_lag", "time_constant")``.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rov_ident.coefficients import parse
from rov_ident.config import Config
from rov_ident.effects import EFFECTS, compiled
from rov_ident.effects.base import EffectParameter
from rov_ident.estimate import typical
from rov_ident.model import Array, Model
from rov_ident.shooting import Equations, equations

Key = tuple[str, str]
COEFFICIENTS = "coefficients"


@dataclass(frozen=True)
class Hypothesis:
    """A configuration with free parameters: ``values`` (in the order of ``keys``) replace its own.

    Effects and coefficients that the configuration lacks are added; parameters of an added effect
    that are not among the keys stay at their null.
    """

    config: Config
    values: Mapping[Key, float]
    constants: Mapping[Key, float] = field(default_factory=dict)
    """Parameters that are known, such as the duration of the bag, where their effect is there."""

    @property
    def keys(self) -> tuple[Key, ...]:
        return tuple(self.values)

    def having(self, values: Mapping[Key, float]) -> "Hypothesis":
        """The same with other values, or further parameters."""
        return self.at({**self.values, **values})

    def at(self, values: Mapping[Key, float]) -> "Hypothesis":
        """The same with just these free parameters; damping that differs for negative velocity is
        kept dissipative."""
        kept = dict(values)
        for section, name in values:
            if section == COEFFICIENTS and name.endswith("_neg"):
                both = parse(name).symmetric
                model = self.config.model
                own = float(model.theta[model.names.index(both)]) if both in model.names else 0.0
                limit = -values.get((COEFFICIENTS, both), own)
                kept[section, name] = min(kept[section, name], limit)
        return Hypothesis(self.config, kept, self.constants)

    def without(self, keys: Iterable[Key]) -> "Hypothesis":
        gone = set(keys)
        return self.at({k: v for k, v in self.values.items() if k not in gone})

    def value(self, key: Key) -> float:
        """Of a parameter, free or not, there or not."""
        section, name = key
        if key in self.values:
            return self.values[key]
        if section == COEFFICIENTS:
            return self.coefficients.get(name, 0.0)
        return self.effects.get(section, {}).get(name, bounds(key)[0])

    @cached_property
    def effects(self) -> dict[str, dict[str, float]]:
        """The section ``effects``, complete."""
        effects = {name: dict(values) for name, values in self.config.effects.items()}
        for (section, name), value in self.values.items():
            if section in EFFECTS:
                effects.setdefault(section, self.nulls(section))[name] = value
        return effects

    def nulls(self, effect: str) -> dict[str, float]:
        """The parameters of an effect that does nothing."""
        nulls = {p.name: p.null for p in EFFECTS[effect].parameters}
        return nulls | {n: v for (section, n), v in self.constants.items() if section == effect}

    @cached_property
    def coefficients(self) -> dict[str, float]:
        own = dict(zip(self.config.model.names, self.config.model.theta.tolist(), strict=True))
        added = {n: v for (section, n), v in self.values.items() if section == COEFFICIENTS}
        return {**own, **added}

    @cached_property
    def model(self) -> Model:
        """The equations of motion; unphysical values are not refused here."""
        values = self.coefficients
        found = sorted((parse(n) for n in values), key=lambda c: not c.is_added_mass)
        body = self.config.model.body
        for name, parameters in self.effects.items():
            change = EFFECTS[name].body
            if change is not None:
                body = change(body, **parameters)
        theta = np.array([values[c.name] for c in found])
        return Model(body, tuple(found), theta, self.config.model.fins)

    @cached_property
    def equations(self) -> Equations:
        return equations(self.model, compiled(self.effects))


UNKNOWN = "unknown"
"""Section of the keys of patterns (:mod:`rov_ident.patterns`): wrenches of no known cause."""


def bounds(key: Key) -> tuple[float, float, float]:
    """Null, lower and upper bound of a parameter."""
    section, name = key
    if section == COEFFICIENTS:
        return 0.0, -np.inf, 0.0 if parse(name).is_diagonal else np.inf
    if section not in EFFECTS:
        return 0.0, -np.inf, np.inf
    p = parameter(key)
    return p.null, p.lower, p.upper


def parameter(key: Key) -> EffectParameter:
    return next(p for p in EFFECTS[key[0]].parameters if p.name == key[1])


def centre(config: Config, key: Key) -> float:
    """What a parameter is taken to be without data."""
    section, name = key
    if section == COEFFICIENTS and name in config.model.names:
        return float(config.model.theta[config.model.names.index(name)])
    return bounds(key)[0]


def precision(h: Hypothesis) -> Array:
    """Prior precision (P,): wide, so that only what no data reach is held by it."""
    model = h.config.model
    known = np.maximum(np.abs(model.theta), 0.2 * typical(model))
    width = {
        (COEFFICIENTS, name): size for name, size in zip(model.names, known.tolist(), strict=True)
    }
    width |= {key: 1e3 * parameter(key).typical for key in h.keys if key[0] in EFFECTS}
    return np.array([width.get(key, np.inf) for key in h.keys]) ** -2.0


def reach(key: Key) -> float:
    """How far one step may go: what is not linear is followed in small steps."""
    if key[0] not in EFFECTS:
        return np.inf
    p = parameter(key)
    steps = {"onset": 2.0, "frequency": 0.003, "phase": 0.5, "place": 2.0 * p.typical}
    return steps.get(p.role, np.inf)
