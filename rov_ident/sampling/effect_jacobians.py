"""How a sample changes with the parameters of the configured effects.

An estimator treats such a parameter as a linear one, about the value p0 by which the sample was
made; the sampler follows the estimate (`Sampler.recentre`), so that what is not linear in the
parameter (a lag, the place of a tether) is right in the end. With ``d = p - p0`` the equations of
motion and the measured velocity become::

    M nu_dot + h(nu) - G down = wrench + J d,      measured = nu + V d + noise

``J`` (6, k) is the change of the wrench: difference quotients of the input effects, run beside the
configured ones, of effects on fins in what the configured fins make, and of the wrench effects, at
the measured motion; of effects on the rigid body
``dG down - dM nu_dot - C(dM nu) nu``, with the acceleration that the IMU measures ("Trim" in
docs/choices.md). ``V`` (6, k) is the change of the measured velocity: of moving water, and of
effects on the velocity sensors.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.config.prior import theta_of
from rov_ident.core.jit import inlined, kernel
from rov_ident.core.messages import Array
from rov_ident.core.quaternions import rotation
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
    steer,
    steering_memory,
)
from rov_ident.effects.base import EffectParameter, Reading
from rov_ident.model.coefficients import AXES, INPUTS
from rov_ident.model.equations import Structure, coriolis, force_of_one

_ZERO = np.zeros(3)
_FOLLOWING_TIME = 1.0  # s; longer than a thruster takes, shorter than a vehicle rests
_ACCELERATION_TIME = 0.2  # s; over which the noise of a measured acceleration is averaged
_ASTRAY = 10.0  # m/s from what is measured: the present model runs away


class EffectJacobians:
    """The Jacobians of the samples of one configuration, fed with what its sampler sees."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.size = k = len(config.estimate_effects)
        self._forces: list[int] = []  # indices of parameters
        self._bodies: list[int] = []
        self._steers: list[tuple[int, Acting, Acting]] = []
        self._senses: list[tuple[int, Values, Values]] = []
        self._water = np.zeros((3, k))  # world
        self._latency = -1  # index of the velocities' delay; none
        self._about = theta_of(config)[len(config.model.theta) :]
        self._mask = np.ones((6, k))  # 0 where a parameter belongs to another axis
        self._width = np.ones(k)  # of the difference quotients
        variants: list[Acting] = []  # of each force one with less and one with more
        mass, restoring = [], []
        for i, (name, own) in enumerate(config.estimate_effects):
            effect = EFFECTS[name]
            p = parameter(name, own)
            low, high = self._displaced(name, p, effect.of_actuators)
            self._width[i] = high[name][own] - low[name][own]
            if p.axis:
                self._mask[:, i] = [axis == p.axis for axis in AXES]
            if effect.late is not None:
                self._latency = i
            elif effect.act is not None or effect.wrench is not None:
                self._forces.append(i)
                variants += [compiled(low), compiled(high)]
            elif effect.steer is not None:
                self._steers.append((i, compiled(low), compiled(high)))
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
        self._variants = (
            Acting(*(np.array(part) for part in zip(*variants, strict=True))) if variants else None
        )
        model = config.dynamics
        self._motion = _Motion(
            model.structure,
            model.mass_matrix,
            model.theta,
            np.asarray(np.linalg.inv(model.mass_matrix), dtype=np.float64),
            model.body.restoring,
            np.array(self._bodies, dtype=np.int64),
            np.array(mass).reshape(-1, 6, 6),
            np.array(restoring).reshape(-1, 6, 3),
            self._water,
            self._latency,
        )
        self._scale = self._mask / self._width
        self._acts = np.array(self._forces, dtype=np.int64)
        self._surrounded = self._variants is not None and bool(self._variants.wrenches.any())
        self.forget()
        self._velocity = np.zeros((6, k))

    def _displaced(self, name: str, p: EffectParameter, is_input: bool) -> tuple[Values, Values]:
        """The configured effects with one parameter a step lower, and higher, inside its bounds."""
        here = self.config.effects[name][p.name]
        # an input effect may have kinks (a deadband) or whole steps (a delay) that a step must pass
        step = (0.05 if is_input else 1e-3) * p.typical

        def at(value: float) -> Values:
            effects = self.config.effects
            return {**effects, name: {**effects[name], p.name: value}}

        return at(max(here - step, p.lower)), at(min(here + step, p.upper))

    def forget(self) -> None:
        """The command before the next one is not known."""
        count = len(self._variants.inputs) if self._variants is not None else 0
        self._memory = np.zeros((count, *memory().shape))
        self._impulse = np.zeros((count, 6))
        self._around = np.zeros((count, 6))
        self._time = 0.0
        self._followed = np.zeros((2, 3))
        self._lacking, self._rate = np.zeros(6), np.zeros(3)
        self._steering = np.zeros((len(self._steers), 2, *steering_memory().shape))
        self._steered = np.zeros((len(self._steers), 2, 2, len(INPUTS)))

    def steer(self, dt: float, inputs: Array) -> None:
        """The inputs (2, 4) that were read of the interval dt: means, and values at its end."""
        for k, (_, *variants) in enumerate(self._steers):
            for v, acting in enumerate(variants):
                self._steered[k, v] = inputs
                steer(acting, self._steering[k, v], dt, self._steered[k, v])

    def act(self, t: float, dt: float, command: Array) -> None:
        """The command (6,) holds from t to t + dt."""
        if self._variants is not None:
            _act(self._variants, self._memory, t, dt, command, self._impulse)
            self._time += dt

    def about(self, config: Config, acting: Array, steering: Array) -> "EffectJacobians":
        """The same of a configuration with other values of the parameters; what is known stays.

        What effects on inputs remember, the variants here and the configured ones in ``acting``
        and ``steering``, moves to first order to what it would be with these values: or a lag would
        go on with thrust that was scaled otherwise. The values that the columns of the rigid body
        are about stay, as the estimator's own body does: these columns are linear.
        """
        new = EffectJacobians(config)
        names = "_around _impulse _time _velocity _followed _lacking _rate"
        for name in names.split():
            setattr(new, name, getattr(self, name))
        moved = (new._about - self._about) / self._width
        low, high = self._memory[0::2], self._memory[1::2]
        acts = np.tensordot(moved[self._acts], high - low, 1)
        low, high = self._steering[:, 0], self._steering[:, 1]
        steers = np.tensordot(moved[[i for i, *_ in self._steers]], high - low, 1)
        new._memory, new._steering = self._memory + acts, self._steering + steers
        acting += acts
        steering += steers
        new._about[new._bodies] = self._about[self._bodies]
        return new

    def measure(self, motion: NDArray[np.void], has_imu: bool) -> None:
        """The kinematic filter's ``motion`` (1,), velocity and rate over ground before the next
        sample.

        Not the measured ones: their noise would be in column and innovation alike.
        """
        for i, low, high in self._senses:
            v, omega = motion["v"][0], motion["rate"][0]
            given = sense(Reading(v, omega, omega, _ZERO), self.config.effects)
            before, after = correct(given, low), correct(given, high)
            rate = before.gyro - after.gyro if has_imu else before.angular - after.angular
            change = np.concatenate([before.linear - after.linear, rate])
            self._velocity[:, i] = change / self._width[i]

    def extend(self, sample: NDArray[np.void], sides: Array, acceleration: Array) -> None:
        """Fill sides (13, k) of the sample (1,) with J, V and p0, and begin the next interval.

        ``acceleration`` (3,) [m/s2] is that over ground, in body axes, by the IMU; it is not read
        where the sample has no gyro.
        """
        if self._surrounded:
            self._surround(sample[0])
        _fill(
            self._motion, sample, self._acts, self._impulse, self._time, self._scale,
            self._velocity, self._about, self._followed, acceleration, self._lacking, self._rate,
            sides,
        )  # fmt: skip
        for k, (i, *_) in enumerate(self._steers):
            low, high = (_force(self._motion, sample, inputs) for inputs in self._steered[k, :, 0])
            sides[:6, i] = (low - high) / self._width[i]
        self.begin_interval()

    def begin_interval(self) -> None:
        """What acted so far is in a sample, or before all of them."""
        self._impulse[:] = 0.0
        self._time = 0.0

    def _surround(self, row: np.void) -> None:
        """Add the impulse of the variants' wrench effects along the motion."""
        now = np.zeros_like(self._around)
        thrust = row["wrench"] - row["surroundings"]
        to_world = rotation(row["orientation"])
        _surround(self._variants, row["t"], row["position"], row["nu"], to_world, thrust, now)
        before = now if row["restart"] else self._around
        self._time = self._time or 1.0
        self._impulse += 0.5 * self._time * (before + now)
        self._around = now


class _Motion(NamedTuple):
    """What the columns of water, rigid body and latency are made of."""

    structure: Structure
    mass: Array  # (6, 6)
    theta: Array  # (m,)
    inverse: Array  # (6, 6)
    restoring: Array  # (6, 3)
    bodies: NDArray[np.int64]  # (b,): indices of parameters of the rigid body
    of_mass: Array  # (b, 6, 6): change of the mass matrix
    of_restoring: Array  # (b, 6, 3)
    water: Array  # (3, k): change of the water's velocity in the world
    latency: int


@inlined
def _effects_of_variant(variants, v):
    """One of the variants, which are stacked."""
    return Acting(
        variants.inputs[v], variants.input_parameters[v], variants.wrenches[v],
        variants.wrench_parameters[v], variants.water[v], variants.steers[v],
        variants.steer_parameters[v],
    )  # fmt: skip


@kernel
def _act(variants, state, t, dt, command, impulse):
    for v in range(len(variants.inputs)):
        wrench = command.copy()
        act(_effects_of_variant(variants, v), state[v], t, dt, wrench)
        for i in range(6):
            impulse[v, i] += dt * wrench[i]


@kernel
def _surround(variants, t, position, nu, rotation, thrust, out):
    for v in range(len(variants.inputs)):
        add_wrenches(_effects_of_variant(variants, v), t, position, nu, rotation, thrust, out[v])


@kernel
def _force(motion, samples, inputs):
    """What the model needs (6,) at a sample (1,) for no acceleration, with other inputs (4,)."""
    return force_of_one(motion.structure, motion.mass, motion.theta, samples[0].nu, inputs)


@inlined
def _acceleration(motion, sample, nu):
    """nu_dot (6,) of the configured model at velocities nu (6,)."""
    h = force_of_one(motion.structure, motion.mass, motion.theta, nu, sample.inputs[1])
    return motion.inverse @ (sample.wrench + motion.restoring @ sample.down - h)


@inlined
def _follow(motion, sample, followed):
    """v_dot (3,) of a motion of the configured model, drawn to what was measured before.

    ``followed`` (2, 3) are its velocities and those measured, at the sample before; now at this.
    """
    nu, v_dot = sample.nu.copy(), np.zeros(3)
    for i in range(3):
        if sample.restart or not abs(followed[0, i] - nu[i]) < _ASTRAY:
            followed[0, i] = followed[1, i] = nu[i]
        nu[i] = followed[0, i]
    nu_dot = _acceleration(motion, sample, nu)
    for i in range(3):
        v_dot[i] = nu_dot[i] + (followed[1, i] - followed[0, i]) / _FOLLOWING_TIME
        followed[0, i] += sample.dt * v_dot[i]
        followed[1, i] = sample.nu[i]
    return v_dot


@inlined
def _measured_acceleration(motion, sample, acceleration, lacking, rate):
    """nu_dot (6,) through the water; by the configured model alone where there is no IMU.

    ``lacking`` (6,) is what the model lacked of it of late, ``rate`` (3,) that of the sample
    before; now of this. What is quicker than _ACCELERATION_TIME is the model's, the rest measured.
    """
    nu_dot, nu = _acceleration(motion, sample, sample.nu), sample.nu
    inertial = np.isfinite(sample.gyro[0])
    if inertial and sample.dt > 0.0 and not sample.restart:
        blend = sample.dt / (_ACCELERATION_TIME + sample.dt)
        for i in range(3):
            j, m = (i + 1) % 3, (i + 2) % 3
            turned = nu[3 + j] * sample.water[m] - nu[3 + m] * sample.water[j]
            lacking[i] += blend * (acceleration[i] + turned - nu_dot[i] - lacking[i])
            measured = (nu[3 + i] - rate[i]) / sample.dt
            lacking[3 + i] += blend * (measured - nu_dot[3 + i] - lacking[3 + i])
    for i in range(6):
        if not inertial:
            lacking[i] = 0.0
        nu_dot[i] += lacking[i]
    for i in range(3):
        rate[i] = nu[3 + i]
    return nu_dot


@kernel
def _fill(
    motion, samples, acts, impulse, time, scale, velocity, about, followed, acceleration, lacking,
    rate, sides,
):  # fmt: skip
    """sides (13, k): rows of the wrench, of the measured velocity, and the values they are about.

    Of a change of the rigid body ``dG down - dM nu_dot - C(dM nu) nu``; of a later velocity
    ``-v_dot``, in which the noise of the measured velocity must not be ("The column of the delay"
    in docs/samples.md).
    """
    sample = samples[0]
    for j in range(len(about)):
        for i in range(6):
            sides[i, j] = 0.0
            sides[6 + i, j] = velocity[i, j]
        sides[12, j] = about[j]
    if time > 0.0:
        for a in range(len(acts)):
            for i in range(6):
                change = (impulse[2 * a + 1, i] - impulse[2 * a, i]) / time
                sides[i, acts[a]] = change * scale[i, acts[a]]
    to_world = rotation(sample.orientation)
    for j in range(len(about)):
        for i in range(3):
            for a in range(3):
                sides[6 + i, j] += to_world[a, i] * motion.water[a, j]
    if len(motion.bodies) > 0:
        nu_dot = _measured_acceleration(motion, sample, acceleration, lacking, rate)
        down = sample.down - 0.5 * sample.dt * sample.down_slope  # as the estimators take it
        for b in range(len(motion.bodies)):
            j, momentum = motion.bodies[b], np.zeros(6)
            for i in range(6):
                for a in range(3):
                    sides[i, j] += motion.of_restoring[b, i, a] * down[a]
                for a in range(6):
                    sides[i, j] -= motion.of_mass[b, i, a] * nu_dot[a]
                    momentum[i] += motion.of_mass[b, i, a] * sample.nu[a]
            change = coriolis(momentum, sample.nu)
            for i in range(6):
                sides[i, j] -= change[i]
    # without an IMU a late velocity looks like thrust that comes early, whatever delays it
    if motion.latency >= 0 and np.isfinite(sample.gyro[0]):
        v_dot = _follow(motion, sample, followed)
        for i in range(3):
            sides[6 + i, motion.latency] = -v_dot[i]
