"""What is known before any data: values, standard deviations and bounds of what is estimated."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.effects import EFFECTS, parameter
from rov_ident.model.coefficients import DIAGONAL
from rov_ident.model.equations import Array, Model, RigidBody
from rov_ident.model.scales import WORKING_SPEED, authority


@dataclass(frozen=True, eq=False)
class Prior:
    """What to estimate, before any data: coefficients, then parameters of effects.

    ``estimated`` (n,) are their indices into theta, behind which the parameters of effects are
    counted on; mean and std (n,) in their own units. ``negative`` (n,) marks the coefficients that
    no passive hull has positive; lower and upper (n,) are the bounds of the parameters of effects.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    estimated: NDArray[np.int64]
    mean: Array
    std: Array
    negative: NDArray[np.bool_]
    lower: Array
    upper: Array


def prior_of(config: Config, effects: bool = False) -> Prior:
    """The prior that a configuration states, of its coefficients or of all that it estimates.

    The standard deviation of a coefficient is relative to its value, but not less than a share of
    what such a term would weigh at working speed: a published zero means "not known", not "exactly
    zero".
    """
    model = config.dynamics
    index = [model.names.index(name) for name in config.estimate]
    scale = typical(model)
    std = np.array(
        [
            config.prior.std.get(
                name, config.prior.relative_std * max(abs(model.theta[i]), 0.2 * scale[i])
            )
            for name, i in zip(config.estimate, index, strict=True)
        ]
    )
    chosen = [model.coefficients[i] for i in index]
    keys = config.estimate_effects if effects else ()
    more = [parameter(*key) for key in keys]
    nuisance = config.nuisance_std
    spread = np.array([nuisance.get(key, p.typical) for key, p in zip(keys, more)])
    mean = np.array([config.effects[name][own] for name, own in keys])
    # what is only assumed is bounded: further off, the assumption itself is wrong
    reach = np.array([_REACH * nuisance.get(key, np.inf) for key in keys])
    k, none = len(more), np.full(len(chosen), np.inf)
    return Prior(
        (*config.estimate, *(".".join(key) for key in keys)),
        (*(c.unit for c in chosen), *(p.unit for p in more)),
        np.array([*index, *range(len(model.theta), len(model.theta) + k)], dtype=np.int64),
        np.concatenate([model.theta[index], mean]),
        np.concatenate([std, spread]),
        np.array([c.is_diagonal for c in chosen] + [False] * k, dtype=bool),
        np.concatenate([-none, np.maximum([p.lower for p in more], mean - reach)]),
        np.concatenate([none, np.minimum([p.upper for p in more], mean + reach)]),
    )


_REACH = 3.0  # of 1000 normal deviates, three are further off
_CURRENT_TIME = 1200.0  # s; a choice: tens of minutes, over which a stream or a depth changes
_ATTITUDE_TIME = 1500.0  # s; a lasting error of the attitude wanders by its deviation in half of it
ATTITUDE_LASTS = 15.0  # s; over which an AHRS is off in one direction, until gravity corrects it
ONE_AXIS = 1.0 / 3.0
"""of the standard deviation of the thrust's scale: how far the thrust of one axis may be off by
itself, 5 % by default. Hull and wakes take that from the thrusters of one axis and not of another
("thrust deduction": Faltinsen 1990, Sea Loads on Ships and Offshore Structures, ch. 8)."""
STAMPS = 0.001
"""s; to which a driver's stamps are good: its process waits as long for its turn."""
_TO_AND_FRO = 2.0  # rad/s; of a motion to and fro in three seconds, as steps and pilots make
_TIMES = ("thruster_lag", "time_constant"), ("velocity_latency", "delay")
_COB, _ARM = 0.005, 0.15  # m, as of the centre of gravity; of the arm, as of the thrust: a drawing
# has it from volumes and weights of parts, and files of one vehicle differ by far more
_FIRST_LAG = 0.4  # prior standard deviations ("Times" in docs/live.md)


def first_centre(config: Config) -> dict[str, float]:
    """The values of effects' parameters, by name, about which samples are linear at first.

    Those configured; but a lag that may be there is taken as half a standard deviation: from none
    at all, the columns of samples lead to none ("Times" in docs/live.md).
    """
    prior = prior_of(config, effects=True)
    centre = {}
    for name, mean, std, lower in zip(prior.names, prior.mean, prior.std, prior.lower, strict=True):
        if "." in name:
            is_input = EFFECTS[name.partition(".")[0]].of_actuators
            centre[name] = float(mean + _FIRST_LAG * std if is_input and mean == lower else mean)
    return centre


def drift_of(config: Config, names: tuple[str, ...]) -> Array:
    """Rate [1/s] at which the variance of each of the ``names`` (n,) grows back to its prior's.

    That of a current: it turns, and differs from place to place. And that of a trim: the error of
    an attitude lasts, and that of the righting moment with it, which a vehicle at rest does not
    tell from a centre of gravity that moves ("Trim" in docs/choices.md). Neither where the file
    says that it is known (``current_std: 0`` ...).
    """
    supposed = {".".join(key): std for key, std in config.nuisance_std.items()}
    # m: so far off, a centre of gravity looks like the error of the attitude
    offset = config.model.body.righting_arm * config.odometry.attitude_std

    def rate(name: str) -> float:
        effect, _, own = name.partition(".")
        if name in supposed and effect == "ocean_current":
            return 1.0 / _CURRENT_TIME
        if name in supposed and effect == "cog_offset" and own in ("dx", "dy"):
            return 2.0 * float((offset / supposed[name]) ** 2) / _ATTITUDE_TIME
        return 0.0

    return np.array([rate(name) for name in names])


def attitude_covariance(
    config: Config, names: tuple[str, ...], seconds: float, gain: Array | None = None
) -> Array:
    """What the attitude's error adds to the covariance (n, n) of estimates from ``seconds``.

    It lasts, and the moment of weight turned by it is that of a centre of gravity that is to one
    side by the arm times the error ("Trim" in docs/choices.md): by their mean over the record.
    """
    mean = np.sqrt(min(2.0 * ATTITUDE_LASTS / max(seconds, 1e-9), 1.0))
    body = config.model.body
    aside = abs(body.righting_arm) * config.odometry.attitude_std * mean
    return _consider_covariance([{n: aside} for n in _COG_OFFSET[:2]], names, gain)


def rigid_body_covariance(
    config: Config, names: tuple[str, ...], values: Array, gain: Array | None = None
) -> Array:
    """What an uncertain rigid body adds to the covariance (n, n) of the estimates ``values`` (n,).

    ``gain`` (n, n) is how far estimates follow what the data alone would say, None: all the way. A
    narrow prior holds them where the data, with a wrong mass, say something else.

    An error of a moment of inertia is one of K_pdot, M_qdot or N_rdot, as a motion shows their sum.
    So is an error of the mass one of X_udot, Y_vdot and Z_wdot, where the thrust is known. Where
    its scale is estimated, the mass is what all forces are compared with: the equations of motion
    stay the same with mass, inertia, weight, buoyancy, thrust and all coefficients times k.
    """
    known, body = config.vehicle_uncertainty, config.model.body
    masses, moments = _own_inertia(body)
    if scaled := _with_thrust(body, names, values):
        # relative to the inertia that the file gives and that does not change with the mass
        of_mass = {n: v - moments.get(n, 0.0) for n, v in scaled.items()}
    else:
        of_mass = masses
    sources = [{n: known.mass_std * v for n, v in of_mass.items()}]
    sources += [{n: known.inertia_std * moment} for n, moment in moments.items()]
    return _consider_covariance(sources, names, gain)


def axis_std_of(config: Config, names: tuple[str, ...]) -> Array:
    """Standard deviation by which the thrust of each axis may be off by itself, relative to it,
    beside the scale of all: (6,), or (0,) where that scale is not among the ``names``."""
    return np.full(6 if THRUST_SCALE in names else 0, ONE_AXIS * config.wrench.scale_std)


def covariance_beyond_driving(
    config: Config,
    names: tuple[str, ...],
    values: Array,
    gain: Array | None = None,
    by_axis: Array | None = None,
) -> Array:
    """What no manoeuvre tells adds to the same, scales and errors of stamps: as driving does not
    reduce it, convergence is judged without it.

    The equations of motion stay the same with the righting moment, thrust, drag and all inertia,
    added and own, times k. So only the righting arm, and the thrust in roll and pitch, determine a
    scale of the thrust that is estimated, and an error of either scales all of these; and with them
    the centre of gravity, as a heel at rest tells how far it is to one side in shares of the arm.
    And a velocity sensor that reads too much makes the same forces belong to velocities and
    accelerations that are as much smaller.

    The thrust of each axis may be off by itself. What q such errors do to the estimates, only the
    data say: ``by_axis`` (n, q). About what acts along the axis is scaled; but inertias so scaled
    are those of no body, and their Munk moments lead the linear damping of roll and yaw further
    astray.

    Of the stamps see :func:`_of_stamps`.
    """
    masses, _ = _own_inertia(config.model.body)
    of_all = dict(zip(names, values.tolist(), strict=True))
    sources = _of_stamps(config, names)
    if scaled := _beside_righting(config, names, values):
        share = share_of_arm(config, of_all[THRUST_SCALE])
        sources.append({n: share * v for n, v in scaled.items()})
    of_velocity = {n: _degree(n) * (v - masses.get(n, 0.0)) for n, v in of_all.items()}
    sources.append({n: config.odometry.scale_std * v for n, v in of_velocity.items()})
    covariance = _consider_covariance(sources, names, gain)
    return covariance if by_axis is None else covariance + by_axis @ by_axis.T


def turning_covariance(
    config: Config, names: tuple[str, ...], values: Array, turning: Array, lasting: float
) -> Array:
    """What the attitude's error adds to the covariance (n, n) of estimates of a vehicle that hardly
    turns: ``turning`` (2,) is the mean square [rad2/s4] of its angular acceleration about x and y,
    ``lasting`` the variance of the error as it shows against a gyro, over what is stated.

    An estimate that predicts this acceleration takes it from moments along the measured attitude.
    Of them the error of the righting moment, G s for an attitude s off, is no acceleration, and
    makes inertia and with it thrust and drag too large by the share (G s)^2 / (I p_dot)^2
    (attenuation by a noisy regressor: Fuller 1987, sec. 1.1). How large s is only the file tells,
    and that there is such an error the gyro; the share is no larger than the estimates have moved
    ("Trim" in docs/choices.md).
    """
    scaled = _beside_righting(config, names, values)
    if not scaled:
        return np.zeros((len(names), len(names)))
    body = config.model.body
    error = 2.0 * (body.weight * body.righting_arm * config.odometry.attitude_std) ** 2
    error *= min(lasting, 1.0)
    moment = float(np.diag(config.dynamics.mass_matrix)[3:5] ** 2 @ turning)
    share = min(error / max(moment, 1e-12), _moved(config, scaled[THRUST_SCALE]))
    return _consider_covariance([{n: share * v for n, v in scaled.items()}], names, None)


def _beside_righting(config: Config, names: tuple[str, ...], values: Array) -> dict[str, float]:
    """What is larger by the same factor in the same motion, where the righting moment is; nothing
    if no scale of the thrust is estimated."""
    body = config.model.body
    masses, moments = _own_inertia(body)
    own = masses | moments
    scaled = {n: v - own.get(n, 0.0) for n, v in _with_thrust(body, names, values).items()}
    of_all = dict(zip(names, values.tolist(), strict=True))
    return scaled | _off_centre(config, of_all) if scaled else {}


def _moved(config: Config, scale: float) -> float:
    """How far an estimated scale of the thrust is from the configured one."""
    effect, name = THRUST_SCALE.split(".")
    return abs(scale - config.effects[effect][name])


def _of_stamps(config: Config, names: tuple[str, ...]) -> list[dict[str, float]]:
    """What it does to added mass and damping that linear velocities, or rates, are stamped late by
    a standard deviation. Nothing where the file knows all times.

    With ``M nu_dot + D nu + K x = tau``, a wrench that is d early is ``tau - d tau'``, in a motion
    to and fro at w: ``(M - d D) nu_dot + (D + d (w^2 M - K)) nu + K x``. A lag and a delay of the
    velocities take that up only where they stay positive.
    """
    if not any(f"{effect}.{own}" in names for effect, own in _TIMES):
        return []
    model = config.dynamics
    of_mass, sources = authority(model) / WORKING_SPEED, []
    stiffness = np.zeros(6)
    stiffness[3:5] = model.body.weight * model.body.righting_arm
    of_damping = np.hypot(_TO_AND_FRO**2 * np.diag(model.mass_matrix), stiffness)
    changes = {
        "added_mass": of_mass, "linear": of_damping, "quadratic": of_damping / WORKING_SPEED
    }  # fmt: skip
    for kind, change in changes.items():
        moved = dict(zip(DIAGONAL[kind], (STAMPS * change).tolist(), strict=True))
        for rows in ("XYZ", "KMN"):
            sources.append({name: x for name, x in moved.items() if name[0] in rows})
    return sources


def cob_std(config: Config) -> float:
    """The standard deviation [m] of the height of the centre of buoyancy."""
    stated = config.vehicle_uncertainty.cob_std
    return max(_COB, _ARM * abs(config.model.body.righting_arm)) if stated is None else stated


def share_of_arm(config: Config, scale: float) -> float:
    """The relative standard deviation that an uncertain righting arm gives an estimated ``scale``
    of the thrust: no more than is supposed of it, as a body without an arm tells nothing of the
    scale, unless the data have moved it by more."""
    arm = cob_std(config) / max(abs(config.model.body.righting_arm), 1e-9)
    return min(arm, max(config.wrench.scale_std, _moved(config, scale)))


def _off_centre(config: Config, values: Mapping[str, float]) -> dict[str, float]:
    """How far the centre of gravity is from above or below that of buoyancy, and its height, by the
    names of what is estimated of it."""
    body = config.model.body
    aside = body.cog - np.array([1.0, 1.0, 0.0]) * body.cob * body.buoyancy / body.weight
    offsets = zip(_COG_OFFSET, aside.tolist(), strict=True)
    return {n: off + values[n] for n, off in offsets if n in values}


def _degree(name: str) -> int:
    """In linear velocities, or accelerations, of the force of a coefficient."""
    return sum(map(name.partition("_")[2].count, "uvw")) if "." not in name else 0


def _own_inertia(body: RigidBody) -> tuple[dict[str, float], dict[str, float]]:
    """The mass and the moments of inertia, by the name of the added mass that a motion shows with
    it."""
    moments = np.diag(body.inertia).tolist()
    return (
        dict.fromkeys(("X_udot", "Y_vdot", "Z_wdot"), body.mass),
        dict(zip(("K_pdot", "M_qdot", "N_rdot"), moments, strict=True)),
    )


def _with_thrust(body: RigidBody, names: tuple[str, ...], values: Array) -> dict[str, float]:
    """What is proportional to the thrust in the same motion, if its scale is estimated. Of a lost
    buoyancy it is what weight and buoyancy leave together."""
    if THRUST_SCALE not in names:
        return {}
    of_all = dict(zip(names, values.tolist(), strict=True))
    scaled = {n: v for n, v in of_all.items() if n == THRUST_SCALE or moves_with_thrust(n)}
    if _BUOYANCY in scaled:
        scaled[_BUOYANCY] += body.weight - body.buoyancy
    return scaled


def _consider_covariance(
    sources: list[dict[str, float]], names: tuple[str, ...], gain: Array | None
) -> Array:
    """The covariance (n, n) of what sources of unit variance do to the estimates."""
    rows = np.array([[source.get(name, 0.0) for name in names] for source in sources])
    if gain is not None:
        rows = rows @ gain.T
    covariance: Array = rows.T @ rows
    return covariance


def gain_of(covariance: Array, std: Array) -> Array:
    """The share (n, n) of the data in an estimate: I - P P0^-1, P (n, n) after them and P0 the
    prior's, diagonal with ``std`` (n,).

    In prior standard deviations P is at most 1 where the data were weighed as a prior is, and then
    no element of the share is above the root of its row's diagonal. Where P is not (consider
    parameters, errors in a row), it is kept to that: what is known no better than before follows
    the data in nothing, even if others are known only relative to it.
    """
    gain = np.eye(len(std)) - covariance / std**2
    limit = np.outer(np.sqrt(np.maximum(np.diag(gain), 0.0)) * std, 1.0 / std)
    return np.clip(gain, -limit, limit)


THRUST_SCALE, _BUOYANCY = "thrust_scale.scale", "buoyancy.delta"
_COG_OFFSET = ("cog_offset.dx", "cog_offset.dy", "cog_offset.dz")


def moves_with_thrust(name: str) -> bool:
    """Whether it must be k times as large where the thrust is, for the same motion: a force, or
    the coefficient of one."""
    return "." not in name or name == _BUOYANCY


def theta_of(config: Config) -> Array:
    """(m + k,): the coefficients, then the configured values of the estimated parameters."""
    effects = [config.effects[effect][name] for effect, name in config.estimate_effects]
    return np.concatenate([config.model.theta, effects])


_WORKING_INPUTS = (0.3, 0.3, 0.3, 10.0)
"""rad, 1/s; of INPUTS. Half of where fins stall, and a small propeller at 600 revolutions a minute;
by such a share of the working wrench a published zero may be off."""


@lru_cache(maxsize=16)  # as `authority`
def typical(model: Model) -> Array:
    """(m,) the size at which each term alone would take its axis's whole working wrench."""
    wrench, inertia = authority(model), np.diag(model.body.mass_matrix)
    motion, driven = [1.0, *WORKING_SPEED, *WORKING_SPEED, *WORKING_SPEED], []
    for x in _WORKING_INPUTS:
        driven += [x, x * x, x * x]
    speed = np.array([*motion, WORKING_SPEED[0] ** 2, *driven])
    sizes = [
        np.sqrt(inertia[c.row] * inertia[c.column])
        if c.is_added_mass
        else wrench[c.row] / (speed[c.left] * speed[c.right])
        for c in model.coefficients
    ]
    out = np.array(sizes)
    out.flags.writeable = False
    return out
