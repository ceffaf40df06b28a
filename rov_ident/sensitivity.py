"""How a sample changes with the parameters of the configured effects.

An estimator treats such a parameter as a linear one, about the value p0 by which the sample was
made; the sampler follows the estimate (:meth:`rov_ident.samples.Sampler.recentre`), so that what
bends with the parameter (a lag, the place of a tether) is right in the end. With ``d = p - p0`` the
equations of motion and the measured velocity become::

    M nu_dot + h(nu) - G down = wrench + J d,      measured = nu + V d + noise

``J`` (6, k) is the change of the wrench: difference quotients of the input effects, run beside the
configured ones, and of the wrench effects at the measured motion; of effects on the rigid body
``dG down - dM nu_dot - C(dM nu) nu``, with the acceleration of the configured model. ``V`` (6, k)
is the change of the measured velocity: of moving water, and of effects on the velocity sensors.
"""

import numpy as np

from rov_ident.coefficients import AXES
from rov_ident.config import Config
from rov_ident.effects import (
    EFFECTS,
    Acting,
    Values,
    act,
    add_wrenches,
    compiled,
    correct,
    memory,
    parameter,
    rigid_body,
    sense,
)
from rov_ident.effects.base import EffectParameter, Reading
from rov_ident.estimate import theta_of
from rov_ident.jit import kernel
from rov_ident.messages import Array
from rov_ident.model import coriolis, force_of_one

_ZERO = np.zeros(3)


class Sensitivity:
    """The Jacobians of the samples of one configuration, fed with what its sampler sees."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.size = k = len(config.estimate_effects)
        self._forces: list[int] = []  # indices of parameters
        self._bodies: list[int] = []
        self._senses: list[tuple[int, Values, Values]] = []
        self._water = np.zeros((3, k))  # world
        self._present = theta_of(config)[len(config.model.theta) :]
        self._mask = np.ones((6, k))
        self._width = np.ones(k)
        sides: list[Acting] = []
        mass, restoring = [], []
        for i, (name, own) in enumerate(config.estimate_effects):
            effect = EFFECTS[name]
            p = parameter(name, own)
            low, high = self._moved(name, p, effect.act is not None)
            self._width[i] = high[name][own] - low[name][own]
            if p.axis:
                self._mask[:, i] = [axis == p.axis for axis in AXES]
            if effect.act is not None or effect.wrench is not None:
                self._forces.append(i)
                sides += [compiled(low), compiled(high)]
            elif effect.water is not None:
                self._water[:, i] = compiled(high).water - compiled(low).water
                self._water[:, i] /= self._width[i]
            elif effect.body is not None:
                self._bodies.append(i)
                there = [rigid_body(config.model.body, values) for values in (high, low)]
                width = self._width[i]
                mass.append((there[0].mass_matrix - there[1].mass_matrix) / width)
                restoring.append((there[0].restoring - there[1].restoring) / width)
            else:
                self._senses.append((i, low, high))
        self._sides = (
            Acting(*(np.array(part) for part in zip(*sides, strict=True))) if sides else None
        )
        self._mass, self._restoring = np.array(mass), np.array(restoring)
        self._inverse = np.linalg.inv(config.dynamics.mass_matrix)
        self.forget()
        self._velocity = np.zeros((6, k))

    def _moved(self, name: str, p: EffectParameter, is_input: bool) -> tuple[Values, Values]:
        """The configured effects with one parameter a step lower, and higher, inside its bounds."""
        here = self.config.effects[name][p.name]
        step = (0.05 if is_input else 1e-3) * p.typical

        def at(value: float) -> Values:
            effects = self.config.effects
            return {**effects, name: {**effects[name], p.name: value}}

        return at(max(here - step, p.lower)), at(min(here + step, p.upper))

    def forget(self) -> None:
        """The demand before is not known."""
        count = len(self._sides.inputs) if self._sides is not None else 0
        self._memory = np.zeros((count, *memory().shape))
        self._impulse = np.zeros((count, 6))
        self._around = np.zeros((count, 6))
        self._time = 0.0

    def act(self, t: float, dt: float, demand: Array) -> None:
        """The demand (6,) holds from t to t + dt."""
        if self._sides is not None:
            _act(self._sides, self._memory, t, dt, demand, self._impulse)
            self._time += dt

    def about(self, config: Config) -> "Sensitivity":
        """The same of a configuration with other values of the parameters; what is known stays."""
        new = Sensitivity(config)
        new._memory, new._around = self._memory, self._around
        new._impulse, new._time = self._impulse, self._time
        new._velocity = self._velocity
        return new

    def measure(self, v: Array, omega: Array, has_imu: bool) -> None:
        """The velocity (3,) and rate (3,) over ground before the next sample.

        Not the measured ones: their noise would be in column and innovation alike.
        """
        for i, low, high in self._senses:
            given = sense(Reading(v, omega, omega, _ZERO), self.config.effects)
            before, after = correct(given, low), correct(given, high)
            rate = before.gyro - after.gyro if has_imu else before.angular - after.angular
            change = np.concatenate([before.linear - after.linear, rate])
            self._velocity[:, i] = change / self._width[i]

    def take(self, sample: np.void, rotation: Array) -> Array:
        """J and V and the parameters (13, k) of a sample; what has acted before is used up."""
        sides = np.empty((13, self.size))
        out = sides[:12].reshape(2, 6, self.size)
        out[:] = 0.0
        sides[12] = self._present
        if self._sides is not None:
            count = len(self._sides.inputs)
            now = np.zeros((count, 6))
            _surround(self._sides, sample["t"], sample["nu"], rotation, now)
            before = now if sample["restart"] else self._around
            wrench = 0.5 * (before + now)
            if self._time > 0.0:
                wrench += self._impulse / self._time
            out[0][:, self._forces] = (wrench[1::2] - wrench[::2]).T
            self._around, self._time = now, 0.0
            self._impulse[:] = 0.0
        out[0] *= self._mask / self._width
        if self._bodies:
            model = self.config.dynamics
            columns = np.empty((len(self._bodies), 6))
            nu, wrench, down = (sample[name].copy() for name in ("nu", "wrench", "down"))
            _turn_body(
                model.structure, model.mass_matrix, model.theta, self._inverse,
                model.body.restoring, self._mass, self._restoring, nu, wrench, down, columns,
            )  # fmt: skip
            out[0][:, self._bodies] = columns.T
        out[1] = self._velocity
        out[1, :3] += rotation.T @ self._water
        return sides


@kernel
def _act(sides, state, t, dt, demand, impulse):
    for v in range(len(sides.inputs)):
        wrench = demand.copy()
        side = Acting(
            sides.inputs[v], sides.input_parameters[v], sides.wrenches[v],
            sides.wrench_parameters[v], sides.water[v],
        )  # fmt: skip
        act(side, state[v], t, dt, wrench)
        for i in range(6):
            impulse[v, i] += dt * wrench[i]


@kernel
def _surround(sides, t, nu, rotation, out):
    for v in range(len(sides.inputs)):
        side = Acting(
            sides.inputs[v], sides.input_parameters[v], sides.wrenches[v],
            sides.wrench_parameters[v], sides.water[v],
        )  # fmt: skip
        add_wrenches(side, t, nu, rotation, out[v])


@kernel
def _turn_body(
    structure, mass, theta, inverse, restoring, of_mass, of_restoring, nu, wrench, down, out
):  # fmt: skip
    """out (k, 6): ``dG down - dM nu_dot - C(dM nu) nu`` of each change of the rigid body."""
    h = force_of_one(structure, mass, theta, nu)
    nu_dot = inverse @ (wrench + restoring @ down - h)
    for i in range(len(out)):
        out[i] = of_restoring[i] @ down - of_mass[i] @ nu_dot - coriolis(of_mass[i] @ nu, nu)
