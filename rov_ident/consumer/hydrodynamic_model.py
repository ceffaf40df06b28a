"""For controllers: the model matrices, kept up to date from `~/coefficients`.

No middleware: a message is anything with the fields of diagnostic_msgs/DiagnosticArray.
"""

import math
import os
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any

import numpy as np

from rov_ident.config import LARGEST, Config, load
from rov_ident.config.prior import THRUST_SCALE, prior_of
from rov_ident.core.errors import UserError, require
from rov_ident.core.frames import gravity_direction, quaternion_normalise
from rov_ident.core.messages import SECOND
from rov_ident.core.states import Level
from rov_ident.effects import EFFECTS, parameter, rigid_body
from rov_ident.estimation.physical import is_passive
from rov_ident.model.equations import Array, Model, build


@dataclass(frozen=True)
class Taken:
    """What became of one message.

    ``values`` are the coefficients taken up, ``refused`` says of each other one why it keeps its
    last good value. Where ``reason`` is not empty, the message was refused as a whole.
    """

    values: dict[str, float] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    reason: str = ""


class HydrodynamicModel:
    """M, C(nu), D(nu) and g of the last good coefficients; at first those of the configuration.

    :meth:`take` is given every message; of a message only the converged coefficients are taken up,
    and only if the whole set is physical with them. Sets are exchanged in one assignment: ``model``
    is the present one, and a controller thread that needs several matrices of the same set keeps
    it in a variable. Of the effects in the configuration, and of those that the estimator finds
    beside it, those on the rigid body are in the matrices, and ``thrust_scale`` is what the thrust
    is off by; the others are left out.

    ``config`` is the path of a parameter file, or a Config; ``hold_after`` is the time in seconds
    without a message after which :meth:`fresh` says no. ``now`` is always a time in seconds on a
    steady clock of the caller's, such as ``time.monotonic()``. Vectors are SI, body
    forward-starboard-down; an attitude is either the quaternion (4,) w x y z, body to
    north-east-down, or the unit vector down (3,) in body axes.

    Raises
    ------
    UserError
        If ``hold_after`` is not positive, the parameter file wrong, an attitude zero, or a vector
        not of its shape.
    """

    def __init__(self, config: str | os.PathLike[str] | Config, hold_after: float = 2.0) -> None:
        require(Real, "a number", hold_after=hold_after)
        if not hold_after > 0.0:
            raise UserError(f"hold_after is {hold_after} s, but must be positive")
        config = load(config)
        self.hold_after = hold_after
        self._model, self._body = config.dynamics, config.model.body
        self._prior = prior_of(config)
        self._effects = {n: dict(v) for n, v in config.effects.items()}
        self._units = {c.name: c.unit for c in config.model.coefficients}
        self._units |= {
            f"{name}.{p.name}": p.unit
            for name, effect in EFFECTS.items()
            for p in effect.parameters
            if effect.body or f"{name}.{p.name}" == THRUST_SCALE
        }
        self._stamp: int | None = None  # ns, of the last message in order
        self._renewed = -math.inf  # s, on the caller's clock

    def take(self, message: Any, now: float) -> Taken:
        """Take up what is good in a message; never raises for what is in it.

        A stamp before the last one is refused while the stream is fresh. Once it is not, its
        source has begun anew (a bag that loops, a simulation reset) and any stamp is accepted.
        """
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        if self._stamp is not None and stamp < self._stamp and self.fresh(now):
            late = (self._stamp - stamp) / SECOND
            return Taken(reason=f"its stamp is {late:.3f} s before the last one")
        values: dict[str, float] = {}
        refused: dict[str, str] = {}
        levels: set[Level] = set()
        names = [status.name for status in message.status]
        for status in message.status:
            is_coefficient = "." not in status.name
            if not is_coefficient and status.name not in self._units:
                continue  # a parameter of an effect that is in neither matrices nor command
            try:
                if names.count(status.name) > 1:
                    raise ValueError("given twice")
                level, value = self._read(status)
            except ValueError as error:
                refused[status.name] = str(error)
                continue
            if is_coefficient:
                levels.add(level)
            if level == Level.OK:
                values[status.name] = value
            else:
                refused[status.name] = f"{level.name}: {status.message}"
        if not levels:
            return Taken(refused=refused, reason="it has no coefficient that can be read")
        effects = {n: dict(v) for n, v in self._effects.items()}
        for name in values:
            effect, _, own = name.partition(".")
            if own:
                nulls = {p.name: p.null for p in EFFECTS[effect].parameters}
                effects.setdefault(effect, nulls)[own] = values[name]
        coefficients = {n: x for n, x in values.items() if "." not in n}
        candidate = replace(
            self._model.with_values(coefficients), body=rigid_body(self._body, effects)
        )
        reason = self.why_unphysical(candidate) if values else ""
        if reason:
            return Taken(refused=refused | dict.fromkeys(values, reason), reason=reason)
        self._model, self._effects = candidate, effects
        self._stamp = stamp
        self._renewed = -math.inf if levels == {Level.STALE} else now
        return Taken(values, refused)

    def fresh(self, now: float) -> bool:
        """Whether the estimator is at work: heard within ``hold_after``, and not itself stale.

        Otherwise the last good set goes on being used. Whoever may not rely on old coefficients
        asks here.
        """
        return 0.0 <= now - self._renewed <= self.hold_after

    def _read(self, status: Any) -> tuple[Level, float]:
        """Level and value of one coefficient; raises ValueError with the reason against it."""
        if status.name not in self._units:
            raise ValueError("not a coefficient of this model")
        pairs = {pair.key: pair.value for pair in status.values}
        for key in ("value", "unit"):
            if key not in pairs:
                raise ValueError(f"comes without {key}")
        if pairs["unit"] != self._units[status.name]:
            wanted = self._units[status.name]
            raise ValueError(f"is in {pairs['unit']!r}, but must be in {wanted!r}")
        try:
            value = float(pairs["value"])
        except (TypeError, ValueError):
            raise ValueError(f"{pairs['value']!r} is not a number") from None
        effect, _, own = status.name.partition(".")
        if own and not parameter(effect, own).lower < value < parameter(effect, own).upper:
            raise ValueError(f"{pairs['value']} is beyond what it can be")
        if not abs(value) <= LARGEST:
            raise ValueError(f"{pairs['value']} is not finite or of no sensible size")
        level = status.level
        try:  # rclpy gives it as one byte
            return Level(ord(level) if isinstance(level, bytes) else level), value
        except (TypeError, ValueError):
            raise ValueError(f"its level {level!r} is none of OK, WARN, ERROR, STALE") from None

    def why_unphysical(self, candidate: Model) -> str:
        """Why no passive hull has these coefficients; empty where one may."""
        try:
            build(candidate.body, candidate.values)
        except UserError as error:
            return str(error)
        if not is_passive(candidate, self._prior, candidate.theta[self._prior.estimated]):
            return "the damping would feed energy to the motion"
        return ""

    @property
    def model(self) -> Model:
        """The present set, whole: it stays as it is when the next one comes."""
        return self._model

    @property
    def thrust_scale(self) -> float:
        """What the thrusters give, over what their wrench says (`thrust_scale`); 1 if not known: to
        get a wrench, command it divided by this."""
        effect, _, own = THRUST_SCALE.partition(".")
        return self._effects.get(effect, {}).get(own, 1.0)

    @property
    def M(self) -> Array:
        """(6, 6): rigid body and added mass."""
        return self._model.mass_matrix.copy()  # the caller's own

    def C(self, nu: Array) -> Array:
        """(6, 6), skew-symmetric."""
        return self._model.coriolis_matrix(_six(nu, "nu"))

    def D(self, nu: Array) -> Array:
        """(6, 6), on the left-hand side: ``D nu`` is the drag that thrust must overcome."""
        return self._model.damping_matrix(_six(nu, "nu"))

    def g(self, attitude: Array) -> Array:
        """(6,): the wrench that holds the vehicle still at this attitude."""
        return self._model.restoring_force(_down(attitude))

    def wrench(self, nu: Array, nu_dot: Array, attitude: Array) -> Array:
        """(6,): ``M nu_dot + C(nu) nu + D(nu) nu + g``, the thrust that this motion takes."""
        return self._model.wrench(_six(nu, "nu"), _six(nu_dot, "nu_dot"), _down(attitude))


def _six(x: Array, name: str) -> Array:
    x = np.asarray(x, dtype=float)
    if x.shape != (6,):
        raise UserError(f"{name} has the shape {x.shape}, but must be (6,): u v w p q r")
    return x


def _down(attitude: Array) -> Array:
    attitude = np.asarray(attitude, dtype=float)
    known = attitude.shape in ((3,), (4,))
    # an IMU without orientation sends zeros
    if not (known and 0.0 < np.linalg.norm(attitude) < np.inf):
        raise UserError(
            f"the attitude is {attitude.tolist()}, but must be a quaternion w x y z or down in "
            "body axes, of any length but zero"
        )
    is_down = len(attitude) != 4
    down: Array = attitude if is_down else gravity_direction(quaternion_normalise(attitude))
    return down / np.linalg.norm(down)  # it may be given as gravity [m/s2]
