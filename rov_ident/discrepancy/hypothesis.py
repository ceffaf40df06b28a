"""A hypothesis about what the vehicle is: a configuration with free parameters.

Each parameter is named by a key (section, name): a coefficient ``("coefficients", "X_uu")`` or a
parameter of an effect ``("thruster_lag", "time_constant")``. One that a single record has of its
own has the number of that record in its name: ``("payload", "mass_wet@2")``.
"""

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rov_ident.config import Config
from rov_ident.config.prior import typical
from rov_ident.config.schema import missing_inputs
from rov_ident.discrepancy.multiple_shooting import Equations, equations
from rov_ident.effects import EFFECTS, compiled, rigid_body, with_trait
from rov_ident.effects import parameter as effect_parameter
from rov_ident.effects.base import Effect, EffectParameter
from rov_ident.model.coefficients import AXES, Coefficient, parse
from rov_ident.model.equations import Array, Model
from rov_ident.model.scales import semi_axes

Key = tuple[str, str]
COEFFICIENTS = "coefficients"
THRUST_SCALE: Key = ("thrust_scale", "scale")

_WIDE = 10.0  # times the size of a coefficient: one that is configured as zero, on an axis without
# other damping, has a size of 2 N s/m where drag is 80, and would be held near zero. With what the
# configuration states of a measured boat, which was a guess, a fit ended in a model that turns
# broadside, twice as far off as the file (docs/explain-bench.md)
_TRIM = "buoyancy", "cog_offset"
_OF_RECORD = "@"  # in the name of a parameter before the number of the record that has it
_WEIGHT = set(with_trait("weight"))
_OF_A_DIVE = {  # water, ballast, batteries and what winds round a propeller change between dives
    name
    for trait in ("dive", "weight", "factor")
    for name in with_trait(trait)
    if not EFFECTS[name].of_sensors
}
_FARTHEST_ARM = 2.0  # half lengths of the hull from the origin: an arm or a skid as long as it


@dataclass(frozen=True)
class Hypothesis:
    """A configuration with free parameters: ``values`` (in the order of ``keys``) replace its own.
    Effects and coefficients that it lacks are added; parameters of an added effect that are not
    among the keys stay at their null."""

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
                both = (COEFFICIENTS, parse(name).symmetric)
                limit = -values.get(both, centre(self.config, both))
                kept[section, name] = min(kept[section, name], limit)
        return Hypothesis(self.config, kept, self.constants)

    def shaped(self, constants: Mapping[Key, float]) -> "Hypothesis":
        """The same with these parameters known."""
        return replace(self, constants={**self.constants, **constants})

    def thruster(self, effect: str) -> float | None:
        """The number of the single thruster that an effect is of; None where it is of axes."""
        return self.constants.get((effect, "thruster"))

    @cached_property
    def structure(self) -> object:
        """What two hypotheses share that differ in values alone."""
        return frozenset(self.values), frozenset(self.constants.items())

    def without(self, keys: Iterable[Key]) -> "Hypothesis":
        """The same without some parameters, and without the shapes of effects that are gone."""
        gone = set(keys)
        left = self.at({k: v for k, v in self.values.items() if k not in gone})
        there = {section for section, _ in left.values}
        constants = left.constants.items()
        kept = {k: v for k, v in constants if k[0] in there or role_of(k) != "shape"}
        return replace(left, constants=kept)

    @cached_property
    def owners(self) -> frozenset[int]:
        """The records that have parameters of their own."""
        return frozenset(r for k in self.values if (r := record_of(k)) is not None)

    @cached_property
    def shared(self) -> "Hypothesis":
        """Without what single records have of their own."""
        return self.without([k for k in self.values if record_of(k) is not None])

    def in_record(self, record: int) -> "Hypothesis":
        """What it says of one of several records, which has no others' own parameters."""
        if not self.owners:
            return self
        return self._in_records[record] if record in self.owners else self.shared

    @cached_property
    def _in_records(self) -> "dict[int, Hypothesis]":
        own = {
            r: {shared(k): v for k, v in self.values.items() if record_of(k) == r}
            for r in self.owners
        }
        return {r: self.shared.having(values) for r, values in own.items()}

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
        """Those that all records share."""
        effects = {name: dict(values) for name, values in self.config.effects.items()}
        for key, value in self.values.items():
            if key[0] in EFFECTS and record_of(key) is None:
                effects.setdefault(key[0], self.nulls(key[0]))[key[1]] = value
        return effects

    def has(self, effect: str) -> bool:
        """Whether an effect is there, be it in one record."""
        return effect in self.effects or any(section == effect for section, _ in self.values)

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
        found = in_order(values)
        theta = np.array([values[c.name] for c in found])
        return Model(rigid_body(self.config.model.body, self.effects), found, theta)

    @cached_property
    def equations(self) -> Equations:
        return equations(self.model, compiled(self.effects))


UNKNOWN = "unknown"
"""Section of the keys of patterns (`basis_functions`): wrenches of no known cause."""


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
    return effect_parameter(*shared(key))


def of_record(key: Key, record: int) -> Key:
    """The parameter that one of several records, the first of which is 0, has of its own."""
    return key[0], f"{key[1]}{_OF_RECORD}{record + 1}"


def shared(key: Key) -> Key:
    """The parameter without the record that has it."""
    return key[0], key[1].partition(_OF_RECORD)[0]


def record_of(key: Key) -> int | None:
    """The record that has a parameter of its own; None where all share it."""
    number = key[1].partition(_OF_RECORD)[2]
    return int(number) - 1 if number else None


def in_order(names: Iterable[str]) -> tuple[Coefficient, ...]:
    """The coefficients as a model wants them: the added masses first."""
    return tuple(sorted(map(parse, names), key=lambda c: not c.is_added_mass))


def centre(config: Config, key: Key) -> float:
    """The prior's mean of a parameter."""
    section, name = key
    if section == COEFFICIENTS and name in config.model.names:
        return float(config.model.theta[config.model.names.index(name)])
    return bounds(key)[0]


def coefficient_sizes(model: Model) -> dict[Key, float]:
    """How large each coefficient is, at least a fifth of what is typical of such a vehicle."""
    sizes = np.maximum(np.abs(model.theta), 0.2 * typical(model)).tolist()
    return {(COEFFICIENTS, name): size for name, size in zip(model.names, sizes, strict=True)}


def precision(h: Hypothesis, forces: bool) -> Array:
    """Prior precision (P,): wide, so that it decides only where the data say nothing. Where no
    ``forces`` are recorded, the motion tells them in proportion to each other, and of their common
    scale only the righting moment tells something: there the file says what it says in every fit.
    """
    wide = _WIDE if forces else h.config.prior.relative_std
    width = {key: wide * size for key, size in coefficient_sizes(h.config.model).items()}
    width |= {key: 1e3 * parameter(key).typical for key in h.keys if key[0] in EFFECTS}
    width |= reach(h.config, h.keys)
    # what all thrusters lack alike is what every coefficient has more: where only mass and weight
    # could tell, and do not, the file says how far off thrust may be
    if (scale := h.config.wrench.scale_std) > 0.0:
        width |= {key: scale for key in h.keys if shared(key) == THRUST_SCALE}
    if not forces:
        trim = trim_std(h.config)
        width |= {key: trim[shared(key)] for key in h.keys if shared(key) in trim}
    return np.array([width.get(key, np.inf) for key in h.keys]) ** -2.0


def trim_std(config: Config) -> dict[Key, float]:
    """How far trim may be off that the file does not know, by parameter."""
    return {key: std for key, std in config.nuisance_std.items() if key[0] in _TRIM}


def reach(config: Config, keys: Iterable[Key]) -> dict[Key, float]:
    """How far [m] from the origin that may be, by coordinate, which is attached to the hull at a
    place among the keys."""
    far = dict(zip("xyz", (_FARTHEST_ARM * semi_axes(config.model.body)).tolist(), strict=True))
    places = [k for k in keys if role_of(k) == "place" and parameter(k).name in far]
    return {k: max(far[parameter(k).name], parameter(k).typical) for k in places}  # also of a plate


def is_shared(keys: Iterable[Key]) -> bool:
    """Whether no record has one of the parameters of its own."""
    return all(record_of(key) is None for key in keys)


def largest_step(key: Key) -> float:
    """How far one step of a fit may go in a parameter that is not linear: an onset by the distance
    at which better ones are tried [s], a frequency by half the width of a spectral peak of three
    minutes [Hz], a phase by what keeps a sine linear within 4 % [rad]."""
    if key[0] not in EFFECTS:
        return np.inf
    p = parameter(key)
    steps = {"onset": 2.0, "frequency": 0.003, "phase": 0.5, "place": 2.0 * p.typical}
    return steps.get(p.role, np.inf)


def role_of(key: Key) -> str:
    """What a parameter says of its effect (`EffectParameter`). The wrench is (nearly) linear in an
    amplitude, however far it moves; so it is in a coefficient and in a pattern."""
    return parameter(key).role if key[0] in EFFECTS else "amplitude"


def onsets(h: Hypothesis) -> list[Key]:
    """Parameters that say when something begins."""
    return [k for k in h.keys if role_of(k) == "onset"]


def may_leave_null(limits: tuple[float, float, float], change: float) -> bool:
    """Whether a parameter with these null, lower and upper bound may change from null this way."""
    null, lower, upper = limits
    return not ((null == lower and change < 0.0) or (null == upper and change > 0.0))


def at_bound(key: Key, value: float, std: float) -> bool:
    """Whether a parameter of an effect is within two standard deviations of the end of its range:
    then it stands for something else.

    Zero is no such end: a thruster may fail altogether.
    """
    if key[0] not in EFFECTS or parameter(key).role != "amplitude":
        return False
    margin = max(2.0 * std, 1e-3 * abs(value))
    return any(b != 0.0 and abs(value - b) < margin for b in bounds(key)[1:])


def effect_of(key: Key, beside: Iterable[Key] = ()) -> str:
    """The effect that a parameter belongs to; of a pattern its axis and dependence. A coefficient
    that two families have (lift and Coriolis terms) belongs to that of which more is ``beside``.
    """
    section, name = key
    if section == UNKNOWN:
        return f"{UNKNOWN} " + name.rpartition("|")[0]
    if section != COEFFICIENTS:
        return section
    families = [e for e in reversed(EFFECTS.values()) if name in e.coefficients]
    there = {n for s, n in beside if s == COEFFICIENTS} if len(families) > 1 else set()
    families.sort(key=lambda e: -len(there & set(e.coefficients)))
    return families[0].name if families else "coupled_damping"


def axis_of(key: Key) -> str:
    """The axis of XYZKMN that a parameter belongs to; empty if it acts on several."""
    section, name = key
    return AXES[parse(name).row] if section == COEFFICIENTS else parameter(key).axis


def units(effect: Effect, h: Hypothesis, roles: Container[str]) -> list[tuple[Key, ...]]:
    """The parameters of an effect that ``h`` lacks, in the groups in which they may join."""
    if effect.coefficients:
        have = {parse(n).place for n in h.coefficients}
        new = [c for c in map(parse, effect.coefficients) if c.place not in have]
        return [((COEFFICIENTS, c.name),) for c in new if not missing_inputs(c, h.config.inputs)]
    mine = [
        (effect.name, p.name) for p in effect.parameters if p.role in roles and _acts(effect, p, h)
    ]
    if effect.steer and not any(f in h.config.inputs.joints for f in h.model.inputs if f != "n"):
        return []
    # of none of the inputs, or of one that is heard and does something
    heard = {"", *h.model.inputs} & {"", *h.config.inputs.joints}
    mine = [key for key in mine if parameter(key).input in heard]
    if any(p.axis or p.input for p in effect.parameters):
        return [(key,) for key in mine if key not in h.values]
    return [] if h.has(effect.name) else [tuple(mine)]


def _acts(effect: Effect, p: EffectParameter, h: Hypothesis) -> bool:
    """Whether a parameter does anything: of axes, or of the thruster of which ``h`` knows."""
    if effect.of_thrusters is None or p.role != "amplitude":
        return True
    return bool(p.axis) != any(section == effect.name for section, _ in h.constants)


def own_units(effect: Effect, h: Hypothesis, records: int) -> list[tuple[Key, ...]]:
    """The amplitudes that each of several ``records`` may have of its own of an effect that belongs
    to a dive and that ``h`` lacks there. Of what weighs or floats a record has one thing at most:
    a load is buoyancy and a centre of gravity together."""
    if records < 2 or effect.name not in _OF_A_DIVE or effect.name in h.effects:
        return []
    mine = [(effect.name, p.name) for p in effect.parameters if p.role == "amplitude"]
    if all(p.axis for p in effect.parameters):
        own = [of_record(key, r) for r in range(records) for key in mine]
        return [(key,) for key in own if key not in h.values]
    alike = _WEIGHT if effect.name in _WEIGHT else {effect.name}
    return [
        tuple(of_record(key, r) for key in mine)
        for r in range(records)
        if not any(key[0] in alike and record_of(key) == r for key in h.keys)
    ]


def unit_of(key: Key) -> str:
    return parse(key[1]).unit if key[0] == COEFFICIENTS else parameter(key).unit
