"""What every effect states about itself, and the places where one can enter.

An effect says what it does by exactly one of these, each in the file of the effect:

``coefficients``
    Names that it adds to ``coefficients`` (damping and added-mass terms). The equations of motion
    know them already.
``body``
    ``body(rigid_body, **parameters) -> rigid_body``: another rigid body (centre of gravity,
    buoyancy).
``wrench``
    A kernel ``wrench(p, t, position, nu, rotation, thrust, out)`` that adds to the wrench ``out``
    (6,) on the body: ``p`` the parameters in their order (padded to :data:`SIZE`; an array or a
    tuple, to be read one by one), ``t`` [s] since the first message, ``position`` (3,) in the world
    (NED), ``nu`` (6,) body velocities relative to the water, ``rotation`` (3, 3) body -> world,
    ``thrust`` (6,) what the thrusters give after the effects on the input.
``water``
    ``water(**parameters) -> (3,)``: the velocity of the water in the world [m/s].
``act``
    A kernel ``act(p, state, t, dt, wrench)``: on entry ``wrench`` (6,) is commanded from ``t`` to
    ``t + dt``, on return it holds the mean of what acts meanwhile. ``state`` (:data:`MEMORY`,) is
    the effect's own, all zeros before the first call; where estimated parameters move, it moves
    along to first order, so that what is no smooth function of them must not depend on them.
    Effects act in the order of ``order``. With
    ``noise(**parameters) -> (6,)``, the standard deviation of what is read beside the command,
    ``act`` takes back what it can of that, and nothing of it acts on a true command.
``steer``
    A kernel ``steer(p, state, dt, inputs)``: on entry ``inputs`` (2, 4) holds what was read of
    :data:`rov_ident.model.coefficients.INPUTS`, the means over ``dt`` and the values at its end; on
    return the same of what acts; with no ``dt`` the fins restart. ``state``
    (:data:`STEER_MEMORY`,) is the effect's own, as of ``act``.
``sense``
    ``sense(reading, **parameters) -> reading`` and its inverse ``correct``: what the sensors give
    for true velocities, and back. A reading is a :class:`Reading` of one instant or of rows. The
    sensors apply them in the order of ``order``, the way back is the opposite one.
``late``
    ``late(**parameters) -> float``: by how many seconds the linear velocities of the odometry are
    older than its stamp, its pose and its angular velocities.
``heading``
    ``heading(**parameters) -> float``: what the heading of the odometry's attitude reads too much
    [rad], about world down; its position is in the world.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.errors import UserError
from rov_ident.model.coefficients import INPUTS, parse
from rov_ident.model.equations import RigidBody

Array = NDArray[np.float64]

SIZE = 44  # the most parameters that a kernel takes

Place = Literal["input", "motion", "wrench"]
Trait = Literal["hull", "likely", "late", "factor", "neglecting", "dive", "weight"]
Role = Literal["amplitude", "limit", "place", "onset", "frequency", "phase", "fixed", "shape"]
Axes = tuple[str, str, str]

MEMORY = 1024  # numbers that an input effect may keep from one call to the next
STEER_MEMORY = 8  # the same of an effect on fins
FORCE, MOMENT = 50.0, 10.0
"""N, N m; at which effects that grow with thrust are stated: the most of a T200, at 0.2 m."""


class Reading(NamedTuple):
    """What velocity sensor and IMU measure at the body origin, body axes, each (..., 3)."""

    linear: Array  # m/s, of the odometry
    angular: Array  # rad/s, of the odometry
    gyro: Array  # rad/s
    specific_force: Array  # m/s2


def a_reading() -> Reading:
    """One in which nothing is zero or like another."""
    return Reading(*np.arange(1.0, 13.0).reshape(4, 3))


@dataclass(frozen=True)
class EffectParameter:
    """One parameter: the effect vanishes where all of them are at ``null``.

    ``typical`` is a size at which the effect matters on a small ROV: the step from which a search
    starts and the width of the prior of an estimator. An ``amplitude`` makes the effect vanish at
    its null; so does a ``limit``, which shows only once it is below what the thrusters are asked
    for. The other roles (where it attaches, when it begins, its frequency and phase) do nothing
    while the amplitudes are at their nulls; ``fixed`` and ``shape`` are never estimated as such.
    """

    name: str
    unit: str
    meaning: str
    null: float
    lower: float
    upper: float
    typical: float
    axis: str = ""  # of a parameter that belongs to one axis of X Y Z K M N
    role: Role = "amplitude"
    input: str = ""  # of one that belongs to one of INPUTS


def per_axis(
    prefix: str, meaning: str, null: float, lower: float, upper: float, typical: float,
    units: tuple[str, str] = ("1", "1"), moment: float = 1.0, role: Role = "amplitude",
) -> tuple[EffectParameter, ...]:  # fmt: skip
    """One parameter for each axis (``gain_X`` ... ``gain_N``), ``units`` of forces and moments.

    ``moment`` is what a typical size is multiplied by on K, M and N.
    """
    sizes = [(axis, units[0], typical) for axis in "XYZ"]
    sizes += [(axis, units[1], typical * moment) for axis in "KMN"]
    return tuple(
        EffectParameter(
            f"{prefix}_{axis}", unit, f"{meaning} of {axis}", null, lower, upper, size, axis, role
        )
        for axis, unit, size in sizes
    )


def per_fin(
    meaning: str, null: float, lower: float, upper: float, typical: float, role: Role = "amplitude"
) -> tuple[EffectParameter, ...]:
    """One parameter [rad] for each fin angle of INPUTS, named like it."""
    return tuple(
        EffectParameter(
            fin, "rad", f"{meaning} {fin}", null, lower, upper, typical, role=role, input=fin
        )
        for fin in INPUTS[:3]
    )


FRD, NED = ("forward", "starboard", "down"), ("north", "east", "down")
ONSET = EffectParameter(
    "onset", "s", "when, since the first message", 0.0, 0.0, 1e6, 60.0, role="onset"
)


def vector(
    names: str, unit: str, meaning: str, limit: float, typical: float, axes: Axes = FRD,
    role: Role = "amplitude",
) -> tuple[EffectParameter, ...]:  # fmt: skip
    """One parameter for each component along the ``axes``: null 0, between -limit and limit."""
    return tuple(
        EffectParameter(name, unit, f"{meaning} {axis}", 0.0, -limit, limit, typical, role=role)
        for name, axis in zip(names.split(), axes, strict=True)
    )


@dataclass(frozen=True)
class Effect:
    """An effect of the library; see the module for the hooks, of which each has exactly one.

    ``place``: it enters between what is commanded and what acts (*input*), between the motion
    through the water and what is measured (*motion*), or in the *wrench*. ``manoeuvre``: the run
    that shows it and tells it from its neighbours. ``beyond``: the effect that does nearly the same
    and that every vehicle has, without which this one is not looked for. ``lasting``: what one with
    an onset cannot be told from if it was there from the start. ``within``: the effect of which
    this is a special case. ``blurs``: effects that are not sure where this one is.

    ``traits``: *hull*, drag that every hull has; *likely*, lacking so often that it is always tried
    in full; *late*, thrust comes later, as every thruster's does a little; *factor*, its parameters
    are factors of the thrust, of all axes or of one; *neglecting*, with it a model may follow the
    wrench as read less, and noise with it; *dive*, it is the dive's and not the vehicle's;
    *weight*, of what weighs or floats, which with another righting arm look like one another.
    """

    place: Place
    summary: str
    source: str
    manoeuvre: str
    name: str = ""  # that of its file
    parameters: tuple[EffectParameter, ...] = ()
    coefficients: tuple[str, ...] = ()
    beyond: str = ""
    lasting: tuple[str, ...] = ()
    within: str = ""
    blurs: tuple[str, ...] = ()
    traits: tuple[Trait, ...] = ()
    body: Callable[..., Any] | None = None
    wrench: Callable[..., None] | None = None
    water: Callable[..., Array] | None = None
    act: Callable[..., None] | None = None
    order: int = 0
    steer: Callable[..., None] | None = None
    sense: Callable[..., Reading] | None = None
    correct: Callable[..., Reading] | None = None
    noise: Callable[..., Array] | None = None
    late: Callable[..., float] | None = None
    heading: Callable[..., float] | None = None

    @property
    def of_actuators(self) -> bool:
        """Whether it lies between what is commanded or read of an actuator and what acts."""
        return bool(self.act or self.steer)

    @property
    def of_sensors(self) -> bool:
        """Whether it changes what is measured, and no motion."""
        return bool(self.sense or self.late or self.heading or self.noise)


_HOOKS = ("coefficients", "body", "wrench", "water", "act", "steer", "sense", "late", "heading")


def faults(effect: Any) -> str:
    """What is wrong with an effect that was written elsewhere, in words; empty if nothing is."""
    if not isinstance(effect, Effect):
        return "is no rov_ident.effects.base.Effect"
    if effect.place not in get_args(Place):
        return f"must have one of {', '.join(get_args(Place))} as its place"
    if sum(bool(getattr(effect, hook)) for hook in _HOOKS) != 1:
        return f"must have exactly one of {', '.join(_HOOKS)}"
    if bool(effect.sense) != bool(effect.correct):
        return "must have sense and correct, or neither"
    if not isinstance(effect.parameters, tuple) or not all(
        isinstance(p, EffectParameter) for p in effect.parameters
    ):
        return "must have a tuple of EffectParameter as its parameters"
    if len(effect.parameters) > SIZE:
        return f"has {len(effect.parameters)} parameters, but may have {SIZE} at most"
    if bool(effect.parameters) == bool(effect.coefficients):
        return "must have parameters, or coefficients"
    if len({p.name for p in effect.parameters}) < len(effect.parameters):
        return "must have a name of its own for each parameter"
    for p in effect.parameters:
        if not re.fullmatch(r"[A-Za-z]\w*", p.name, re.ASCII):
            return f"needs letters, digits and underscores as the name of its parameter {p.name!r}"
        if not (p.lower <= p.null <= p.upper and p.typical > 0.0):
            return f"needs lower <= null <= upper and typical > 0 of its parameter {p.name}"
    try:
        for name in effect.coefficients:
            parse(name)
    except UserError as error:
        return f"has a coefficient that is none: {error}"
    return _fault_of_hooks(effect)


def _fault_of_hooks(effect: Effect) -> str:
    """What goes wrong when the hooks are called at the nulls, where they must do nothing, and at
    the typical sizes; empty if nothing.

    Kernels are called as the Python functions they are: compiled, an index beyond the end of an
    array would read and write other numbers, and nobody would be told.
    """
    nulls = {p.name: p.null for p in effect.parameters}
    typical = {p.name: min(p.null + p.typical, p.upper) for p in effect.parameters}
    return _fault_at(effect, nulls, True) or _fault_at(effect, typical, False)


def _fault_at(effect: Effect, values: Mapping[str, float], is_null: bool) -> str:
    p, six, three, eye = np.zeros(SIZE), np.full(6, 0.1), np.ones(3), np.eye(3)
    p[: len(values)] = list(values.values())
    for given in (p, six, three, eye):
        given.flags.writeable = False  # no hook may change them: others read them, too
    body = RigidBody(1.0, 10.0, 10.0, np.zeros(3), np.zeros(3), np.eye(3))
    kernels: dict[str, tuple[Any, ...]] = {
        "wrench": (p, 1.0, three, six, eye, six, six.copy()),
        "act": (p, np.zeros(MEMORY), 1.0, 0.1, six.copy()),
        "steer": (p, np.zeros(STEER_MEMORY), 0.1, np.full((2, len(INPUTS)), 0.1)),
    }
    functions: dict[str, tuple[tuple[Any, ...], tuple[int, ...] | None]] = {
        "body": ((body,), None),
        "water": ((), (3,)),
        "late": ((), ()),
        "heading": ((), ()),
        "noise": ((), (6,)),
        "sense": ((a_reading(),), (4, 3)),
        "correct": ((a_reading(),), (4, 3)),
    }
    name = ""
    try:
        with np.errstate(all="ignore"):
            for name, arguments in kernels.items():
                if (hook := getattr(effect, name)) is not None:
                    if not hasattr(hook, "py_func"):
                        return f"must have a kernel as its {name} (rov_ident.core.jit.kernel)"
                    before = arguments[-1].copy()
                    hook.py_func(*arguments)
                    if not np.isfinite(arguments[-1]).all():
                        return f"gives numbers that are not finite from its {name}"
                    if is_null and not np.allclose(arguments[-1], before):
                        return f"must do nothing at its nulls, but its {name} does"
            for name, (arguments, shape) in functions.items():
                if (hook := getattr(effect, name)) is not None:
                    found = hook(*arguments, **values)
                    if arguments and not isinstance(found, type(arguments[0])):
                        return f"must return a {type(arguments[0]).__name__} from its {name}"
                    if shape is not None and np.shape(found) != shape:
                        return f"must return numbers of the shape {shape} from its {name}"
                    same = arguments[0] if shape == (4, 3) else 0.0
                    if is_null and shape is not None and not np.allclose(found, same):
                        return f"must do nothing at its nulls, but its {name} does"
    except Exception as error:  # it is code of others
        return f"fails in its {name} ({type(error).__name__}: {error})"
    return ""
