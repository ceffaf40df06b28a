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

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.model.coefficients import INPUTS

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

    ``of_thrusters(allocation (6, n))``: the shapes that the effect may have, {parameter: value},
    one of each thruster. With one of them its parameters of no axis act; without, those of axes.
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
    of_thrusters: Callable[[Array], list[dict[str, float]]] | None = None

    @property
    def of_actuators(self) -> bool:
        """Whether it lies between what is commanded or read of an actuator and what acts."""
        return bool(self.act or self.steer)

    @property
    def of_sensors(self) -> bool:
        """Whether it changes what is measured, and no motion."""
        return bool(self.sense or self.late or self.heading or self.noise)
