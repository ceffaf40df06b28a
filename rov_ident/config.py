"""The parameter file of nodes and commands, as frozen dataclasses.

Every key is declared once, as a field with :func:`option`: its type, default, unit, bounds and
meaning. Reading, checking, writing, the declaration of ROS parameters and the documentation all
follow from the declarations, so that a new key is one new field.

Vectors in the file are in the axes of ``vehicle.frame``; a :class:`Config` holds them in
forward-starboard-down. Coefficients (SNAME) and effects are forward-starboard-down in the file too.
"""

import dataclasses
import difflib
import math
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from rov_ident import thrusters
from rov_ident.coefficients import catalogue, parse, parse_fin
from rov_ident.effects import EFFECTS, estimable, rigid_body
from rov_ident.errors import UserError
from rov_ident.frames import FrameDefaults, to_core
from rov_ident.messages import Wrench
from rov_ident.model import GRAVITY, Array, Model, RigidBody, build

T = TypeVar("T")
Vector = tuple[float, ...]
Names = tuple[str, ...]

POSITIVE = 1e-9
"""The lower bound of what must be greater than zero."""

ANY = -1
"""The ``size`` of a list of any length."""

LARGEST = 1e20
"""No number of a vehicle is larger; below it nothing computed from them overflows."""

# Parameters that ROS itself adds to any node.
_ROS_OWN = {"use_sim_time", "qos_overrides", "start_type_description_service"}


# ------------------------------------------------------------------ declarations


def option(
    default: T | None,
    description: str,
    unit: str = "",
    *,
    lower: float = -math.inf,
    upper: float = math.inf,
    choices: Names = (),
    size: int = 0,
    live: bool = False,
    required: bool = False,
) -> T:
    """A key of the file: see :class:`Parameter`. Without a default it is required or computed."""
    metadata = {
        "default": default,
        "description": description,
        "unit": unit,
        "lower": lower,
        "upper": upper,
        "choices": choices,
        "size": size or (len(default) if isinstance(default, tuple) else 0),
        "live": live,
        "required": required,
    }
    return field(default=default, metadata=metadata)  # type: ignore[return-value]


@dataclass(frozen=True)
class Parameter:
    """One key of the parameter file.

    ``type`` is float, int, bool, str, Vector (of ``size`` numbers, or ANY) or Names. ``default`` is
    None for what is required or computed from other keys. ``lower`` and ``upper`` are inclusive,
    for vectors of every element. ``live``: may change while a node runs.
    """

    key: str
    type: Any
    default: Any
    description: str
    unit: str
    lower: float
    upper: float
    choices: Names
    size: int
    live: bool
    required: bool


def own(
    key: str,
    type: Any,
    default: Any,
    description: str,
    unit: str = "",
    *,
    lower: float = -math.inf,
    upper: float = math.inf,
    choices: Names = (),
    live: bool = False,
) -> Parameter:
    """A parameter that belongs to one node and not to the file's keys for all."""
    return Parameter(
        key, type, default, description, unit, lower, upper, choices, 0, live, required=False
    )


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """`vehicle`: the rigid body as the file states it."""

    name: str = option(None, "name of the vehicle", required=True)
    frame: str = option(
        None,
        "axes of every vector in the file: forward-right-down (frd, also called fsd) or "
        "forward-left-up (flu)",
        choices=("frd", "fsd", "flu"),
        required=True,
    )
    mass: float = option(
        None, "mass in air, with enclosed air", "kg", lower=POSITIVE, required=True
    )
    weight: float = option(None, "weight; left out: gravity * mass", "N", lower=POSITIVE)
    buoyancy: float = option(
        None, "weight of the displaced water", "N", lower=POSITIVE, required=True
    )
    cog: Vector = option(None, "centre of gravity from the body origin", "m", size=3, required=True)
    cob: Vector = option(
        None, "centre of buoyancy from the body origin", "m", size=3, required=True
    )
    inertia: Vector = option(
        None,
        "entries xx yy zz xy xz yz of the inertia tensor about the centre of gravity",
        "kg m2",
        size=6,
        required=True,
    )


@dataclass(frozen=True, kw_only=True)
class Prior:
    """`prior`: how well the coefficients in the file are known before any data."""

    relative_std: float = option(
        0.5, "standard deviation of a coefficient relative to its value", lower=POSITIVE
    )
    std: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of single coefficients by name, in their units; overrides the above."""


@dataclass(frozen=True, kw_only=True)
class Frames(FrameDefaults):
    """`frames`: axes of the topics whose frame ids do not end in _frd, _fsd or _ned."""

    body: str = option("flu", "body axes of the topics", choices=("flu", "frd"))
    world: str = option("enu", "world axes of the topics", choices=("enu", "ned"))


@dataclass(frozen=True, kw_only=True)
class Topics:
    """`topics`: which topics of a bag to read; empty: found by name, then by type."""

    odom: str = option("", "topic in a bag of the type inputs.odom")
    imu: str = option("", "sensor_msgs/Imu topic in a bag")
    wrench: str = option("", "topic in a bag of the type inputs.wrench")
    pose: str = option("", "topic in a bag of the type inputs.pose, where inputs.odom is a twist")
    battery: str = option("", "topic in a bag of the type inputs.battery")


ODOMETRY_TYPES = (
    "nav_msgs/Odometry",
    "geometry_msgs/TwistStamped",
    "geometry_msgs/TwistWithCovarianceStamped",
)
POSE_TYPES = ("geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped")
WRENCH_TYPES = ("geometry_msgs/WrenchStamped", "geometry_msgs/Wrench")
FORCE_TYPES = ("sensor_msgs/JointState", "std_msgs/Float64MultiArray", "std_msgs/Float32MultiArray")
BATTERY_TYPE = "sensor_msgs/BatteryState"
PULSE_TYPES = ("std_msgs/UInt16MultiArray", "std_msgs/Int16MultiArray", "mavros_msgs/RCOut")


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """`inputs`: the types in which motion and thrust are published."""

    odom: str = option(
        "nav_msgs/Odometry",
        "type of the motion: odometry, or a twist in body axes that is joined with the poses of "
        "topic pose by their stamps",
        choices=ODOMETRY_TYPES,
    )
    pose: str = option(
        "geometry_msgs/PoseStamped",
        "type of the pose that goes with a twist; interpolated to the stamp of the twist",
        choices=POSE_TYPES,
    )
    wrench: str = option(
        "geometry_msgs/WrenchStamped",
        "type of the thrust: a wrench, or an array of thruster commands that `thrusters` turns "
        "into one; a type without a header is stamped on arrival",
        choices=WRENCH_TYPES + FORCE_TYPES + PULSE_TYPES,
    )
    battery: str = option(
        "none",
        "type of the supply of the thrusters, for the curve of the T200; none: thrusters.voltage",
        choices=("none", BATTERY_TYPE),
    )

    @property
    def is_twist(self) -> bool:
        return self.odom != ODOMETRY_TYPES[0]

    @property
    def is_allocated(self) -> bool:
        """Whether the thrust comes as commands of single thrusters."""
        return self.wrench not in WRENCH_TYPES


@dataclass(frozen=True, kw_only=True)
class Thrusters:
    """`thrusters`: from the commands of single thrusters to a wrench."""

    signal: str = option(
        "auto",
        "what a command is: a force (N), a pulse width (us), normalized (-1 to 1, for 1100 to 1900 "
        "us); auto: a force in arrays of floats, a pulse width in arrays of whole numbers",
        choices=("auto", *thrusters.SIGNALS),
    )
    position: Vector = option(
        (), "of each thruster from the body origin: x y z of the first, the second and so on", "m",
        size=ANY,
    )  # fmt: skip
    direction: Vector = option(
        (),
        "in which each thruster pushes the vehicle at a positive command (a pulse above 1500 us): "
        "x y z of the first, the second and so on; any length",
        size=ANY,
    )
    allocation: Vector = option(
        (),
        "in place of position and direction: X Y Z K M N per newton of the first thruster, the "
        "second and so on",
        "1, m",
        size=ANY,
    )
    channels: Vector = option(
        (), "which element of the array is each thruster, from 1; empty: the first ones", size=ANY
    )
    voltage: float = option(
        16.0,
        "supply of the thrusters, for the curve of the T200; with inputs.battery until it is heard",
        "V",
        lower=POSITIVE,
    )
    curve_pwm: Vector = option(
        (), "pulse widths of another thruster's curve of thrust; empty: the T200's", "us", size=ANY
    )
    curve_force: Vector = option((), "thrust at each of curve_pwm", "N", size=ANY)


@dataclass(frozen=True, kw_only=True)
class OdometrySensor:
    """`odometry`: the velocity sensor."""

    position: Vector = option((0.0, 0.0, 0.0), "velocity sensor from the body origin", "m")
    linear_std: float = option(
        0.01, "noise of a velocity, where the message gives no variance", "m/s", lower=POSITIVE
    )
    angular_std: float = option(
        0.005, "noise of an angular rate, where the message gives none", "rad/s", lower=POSITIVE
    )
    attitude_std: float = option(0.005, "noise of an attitude angle", "rad", lower=POSITIVE)
    gate: float = option(
        5.0, "a velocity further off the integrated IMU is refused", "sigma", lower=POSITIVE
    )


@dataclass(frozen=True, kw_only=True)
class ImuSensor:
    """`imu`: the inertial measurement unit."""

    position: Vector = option((0.0, 0.0, 0.0), "IMU from the body origin", "m")
    rotation: Vector = option(
        (0.0, 0.0, 0.0), "roll, pitch, yaw of the sensor axes from the body axes", "rad"
    )
    accelerometer_std: float = option(
        1.0,
        "trust in the integrated acceleration between odometry messages: noise, vibration and "
        "thrust that steps between two samples (docs/samples.md shows how it was chosen)",
        "m/s2",
        lower=POSITIVE,
    )
    gyro_std: float = option(
        0.003, "noise of an angular rate, where the message gives none", "rad/s", lower=POSITIVE
    )
    accelerometer_bias_std: float = option(
        0.1, "prior standard deviation of the accelerometer bias", "m/s2", lower=0.0
    )
    gyro_bias_std: float = option(
        0.01, "prior standard deviation of the gyroscope bias", "rad/s", lower=0.0
    )


@dataclass(frozen=True, kw_only=True)
class WrenchNoise:
    """`wrench`: how well the thruster wrench is known."""

    relative_std: float = option(0.01, "standard deviation relative to the wrench", lower=0.0)
    correlation_time: float = option(
        0.02,
        "how long an error of the wrench lasts; at least until the next message",
        "s",
        lower=POSITIVE,
    )
    floor_std: Vector = option(
        (0.0,) * 6, "standard deviation at zero wrench: X Y Z, K M N", "N, N m", lower=0.0
    )


@dataclass(frozen=True, kw_only=True)
class Rls:
    """`rls`: the recursive least-squares estimator."""

    forgetting: str = option(
        "variable", "how old data lose weight", choices=("variable", "constant")
    )
    forgetting_factor: float = option(
        1.0,
        "weight kept per 0.1 s by constant forgetting, in directions that move",
        lower=POSITIVE,
        upper=1.0,
        live=True,
    )
    gate: float = option(
        5.0, "a sample further off than this is refused", "sigma", lower=POSITIVE, live=True
    )


@dataclass(frozen=True, kw_only=True)
class Ukf:
    """`ukf`: the unscented Kalman filter."""

    alpha: float = option(0.5, "spread of the sigma points", lower=1e-4, upper=1.0)
    beta: float = option(2.0, "weight of the centre point: 2 suits a Gaussian", lower=0.0)
    kappa: float = option(0.0, "secondary spread of the sigma points", lower=0.0)
    gate: float = option(
        5.0, "a sample further off than this is refused", "sigma", lower=POSITIVE, live=True
    )
    change_threshold: float = option(
        3.0,
        "normalised innovation squared of an axis, over 2 s, from which the vehicle is taken to "
        "have changed and its coefficients are learnt anew; 1 is expected, higher where the model "
        "is rough",
        lower=1.0,
    )
    random_walk: float = option(
        0.0,
        "drift of a coefficient relative to its value, without any evidence of a change",
        "1/sqrt(h)",
        lower=0.0,
    )


@dataclass(frozen=True, kw_only=True)
class Qos:
    """`qos`: quality of service of the subscriptions."""

    reliability: str = option(
        "best_effort",
        "best_effort receives from every publisher",
        choices=("best_effort", "reliable"),
    )
    depth: int = option(1000, "messages queued for a busy node", lower=1)


@dataclass(frozen=True, kw_only=True)
class Config:
    """A checked configuration; vectors in forward-starboard-down.

    ``estimate`` names the coefficients to estimate, in the order of ``model.names``; the others
    are held. ``estimate_effects`` are the parameters of effects to estimate, (effect, parameter);
    in the file both are names under ``estimate``. ``effects`` are part of the simulation: {effect:
    {parameter: value}}, complete.
    ``model`` is what ``vehicle`` and ``coefficients`` say, :attr:`dynamics` what really moves.
    """

    name: str
    model: Model
    estimate: Names = option(
        (),
        "coefficients to estimate, and parameters of effects such as thruster_lag.time_constant; "
        "empty: all, of effects what is there from the start and not at its null",
    )
    gravity: float = option(GRAVITY, "acceleration of free fall", "m/s2", lower=9.7, upper=9.9)
    prior: Prior = Prior()
    frames: Frames = Frames()
    topics: Topics = Topics()
    inputs: Inputs = Inputs()
    thrusters: Thrusters = Thrusters()
    odometry: OdometrySensor = OdometrySensor()
    imu: ImuSensor = ImuSensor()
    wrench: WrenchNoise = WrenchNoise()
    process_std: Vector = option(
        (0.0001,) * 6,
        "least density of the acceleration that the model does not explain, besides the noise of "
        "the wrench (more is found from the innovations): surge sway heave, roll pitch yaw",
        "m/s2/sqrt(Hz), rad/s2/sqrt(Hz)",
        lower=0.0,
    )
    residual_corner: float = option(
        3.0, "corner of the filter on the published wrench residual", "rad/s", lower=POSITIVE
    )
    rls: Rls = Rls()
    ukf: Ukf = Ukf()
    qos: Qos = Qos()
    publish_rate: float = option(
        5.0, "rate of the published coefficients", "Hz", lower=0.01, upper=1000.0, live=True
    )
    timeout: float = option(
        1.0, "inputs silent for longer are reported as stopped", "s", lower=POSITIVE, live=True
    )
    grace: float = option(0.3, "how long a late topic is waited for, in stamp time", "s", lower=0.0)
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    estimate_effects: tuple[tuple[str, str], ...] = ()

    @property
    def dynamics(self) -> Model:
        """The model with the effects on the rigid body: that of simulation and estimation."""
        return dataclasses.replace(self.model, body=rigid_body(self.model.body, self.effects))

    def value(self, name: str) -> float:
        """Of a coefficient, or of a parameter of an effect such as thruster_lag.time_constant."""
        effect, _, own = name.partition(".")
        if own:
            return self.effects[effect][own]
        return float(self.model.theta[self.model.names.index(name)])

    @property
    def with_effects_held(self) -> "Config":
        """The same, with the parameters of effects as they are: samples need not follow them."""
        return dataclasses.replace(self, estimate_effects=())

    def with_values(self, values: Mapping[str, float]) -> "Config":
        """The same with other values of coefficients, and of parameters of its effects by names
        such as thruster_lag.time_constant.

        Raises
        ------
        UserError
            If there is no such coefficient or parameter.
        """
        effects = {name: dict(own) for name, own in self.effects.items()}
        for key, value in values.items():
            effect, _, name = key.partition(".")
            if name and name not in effects.get(effect, {}):
                raise UserError(f"the configuration has no {key} under effects")
            if name:
                effects[effect][name] = value
        model = self.model.with_values({k: v for k, v in values.items() if "." not in k})
        return dataclasses.replace(self, model=model, effects=effects)

    def with_model(self, model: Model) -> "Config":
        """The same with another model: what was held stays held, new coefficients are estimated."""
        held = set(self.model.names) - set(self.estimate)
        estimate = tuple(name for name in model.names if name not in held)
        std = {name: value for name, value in self.prior.std.items() if name in model.names}
        prior = dataclasses.replace(self.prior, std=std)
        return dataclasses.replace(self, model=model, estimate=estimate, prior=prior)


def _declared(section: type, prefix: str = "") -> tuple[Parameter, ...]:
    """The keys that a dataclass declares, and those of its sections."""
    parameters: list[Parameter] = []
    for item in dataclasses.fields(section):
        if item.metadata:
            parameters.append(Parameter(key=prefix + item.name, type=item.type, **item.metadata))
        elif dataclasses.is_dataclass(item.type) and item.default is not dataclasses.MISSING:
            inner: Any = item.type
            parameters.extend(_declared(inner, f"{prefix}{item.name}."))
    return tuple(parameters)


VEHICLE_PARAMETERS = _declared(Vehicle, "vehicle.")
"""The keys of ``vehicle``; those of ``coefficients`` are the names of the coefficients."""

PARAMETERS = _declared(Config)
"""Every other key with a fixed name; ``prior.std.*`` and ``effects.*`` are open to names."""

_BY_KEY = {p.key: p for p in VEHICLE_PARAMETERS + PARAMETERS}


# ------------------------------------------------------------------ reading


def load(path: str | os.PathLike[str], node: str = "", own: Collection[str] = ()) -> Config:
    """Read a parameter file.

    The section ``/**`` is taken, overridden by that of ``node`` where there is one; a file without
    either must have a single section. ``own`` are parameters of the node that are not ours.

    Raises
    ------
    UserError
        One sentence naming the file, the key and what to change.
    """
    path = Path(path)
    try:
        section = _section(_parse(path), node)
        theirs = {name.partition(".")[0] for name in own}
        return from_parameters(
            {k: v for k, v in section.items() if k.partition(".")[0] not in theirs}
        )
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def from_parameters(parameters: Mapping[str, Any]) -> Config:
    """The configuration of nested mappings, dotted names, or a mixture of both.

    Raises
    ------
    UserError
        One sentence naming the key and what to change.
    """
    values = unflatten(parameters)
    for own in _ROS_OWN:
        values.pop(own, None)
    for key in ("vehicle", "coefficients"):
        if key not in values:
            raise UserError(f"{key} is missing: a configuration needs vehicle and coefficients")
    vehicle = Vehicle(**_read_section(Vehicle, values.pop("vehicle"), "vehicle."))
    coefficients = _numbers(values.pop("coefficients"), "coefficients")
    settings = _read_section(Config, values, "")
    model = _model(vehicle, coefficients, settings.get("gravity", Config.gravity))
    settings["estimate"], settings["estimate_effects"] = _estimated(
        model, settings.get("effects", {}), settings.get("estimate", ())
    )
    signs = _signs(vehicle.frame)
    for section, names in (("odometry", ("position",)), ("imu", ("position", "rotation"))):
        if section in settings:
            sensor = settings[section]
            turned = {name: tuple((signs * getattr(sensor, name) + 0.0).tolist()) for name in names}
            settings[section] = dataclasses.replace(sensor, **turned)
    if "thrusters" in settings:
        settings["thrusters"] = _turned(settings["thrusters"], signs)
    inputs = settings.get("inputs", Inputs())
    if inputs.is_allocated:
        chosen = settings.get("thrusters", Thrusters())
        thrusters.check(chosen, thruster_signal(inputs, chosen))
    if inputs.battery != "none":
        chosen = settings.get("thrusters", Thrusters())
        signal = thruster_signal(inputs, chosen) if inputs.is_allocated else thrusters.FORCE
        if signal == thrusters.FORCE or chosen.curve_pwm:
            raise UserError(
                f"inputs.battery is {inputs.battery}, but only the curve of the T200 depends on "
                "it, from pulses to forces: leave it out"
            )
    if "prior" in settings:
        prior = settings["prior"]
        std = {_in_model(model, k, f"prior.std.{k}"): value for k, value in prior.std.items()}
        settings["prior"] = dataclasses.replace(prior, std=std)
    config = Config(name=vehicle.name, model=model, **settings)
    if np.linalg.eigvalsh(config.dynamics.mass_matrix)[0] <= 0:
        raise UserError("effects.cog_offset makes the mass matrix indefinite: give a smaller one")
    return config


def unflatten(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Nested mappings from dotted names: ``{"rls.gate": 5.0}`` gives ``{"rls": {"gate": 5.0}}``.

    Raises
    ------
    UserError
        If a name is given twice, or both as a value and as a section.
    """
    nested: dict[str, Any] = {}
    for path, value in _leaves(parameters):
        section = nested
        for place, name in enumerate(path[:-1], start=1):
            section = section.setdefault(name, {})
            if not isinstance(section, dict):
                value_name = ".".join(path[:place])
                raise UserError(f"{'.'.join(path)} is given, but {value_name} is a value: keep one")
        if path[-1] in section:
            raise UserError(f"{'.'.join(path)} is given twice: keep one of them")
        section[path[-1]] = value
    return nested


def _leaves(parameters: Mapping[str, Any], above: Names = ()) -> Iterator[tuple[Names, Any]]:
    """Every value, and every empty section, with the path of names that leads to it."""
    for name, value in parameters.items():
        path = (*above, *str(name).split("."))
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, path)
        else:
            yield path, {} if isinstance(value, Mapping) else value


def _read_section(section: type, values: Any, prefix: str) -> dict[str, Any]:
    """The checked fields of a dataclass from what the file gives for it; defaults are left out."""
    if not isinstance(values, Mapping):
        raise UserError(f"{prefix[:-1]} is {_shown(values)}, but must be a section of keys")
    fields = {item.name: item for item in dataclasses.fields(section)}
    if section is Config:  # these are made from `vehicle` and `coefficients`
        del fields["name"], fields["model"]
    for name in values:
        if name not in fields:
            others = ["vehicle", "coefficients"] if section is Config else []
            raise UserError(
                f"{prefix}{name} is an unknown key: {_suggestion(name, [*fields, *others])}"
            )
    read: dict[str, Any] = {}
    for name, item in fields.items():
        key = prefix + name
        if name not in values:
            if key in _BY_KEY and _BY_KEY[key].required:
                parameter = _BY_KEY[key]
                raise UserError(
                    f"{key} is missing: {parameter.description}, {_expected(parameter)}"
                )
        elif key in _BY_KEY:
            read[name] = checked(_BY_KEY[key], values[name])
        elif key == "prior.std":
            read[name] = _numbers(values[name], key, lower=POSITIVE)
        elif key == "effects":
            read[name] = _effects(values[name])
        else:
            inner: Any = item.type
            read[name] = inner(**_read_section(inner, values[name], f"{key}."))
    return read


def checked(parameter: Parameter, value: Any) -> Any:
    """The value as its declared type, within its bounds."""
    key, kind = parameter.key, parameter.type
    refusal = f"{key} is {_shown(value)}, but must be {_expected(parameter)}"
    if kind is str:
        if not isinstance(value, str) or (parameter.choices and value not in parameter.choices):
            raise UserError(refusal)
        return value
    if kind is bool:
        if not isinstance(value, bool):
            raise UserError(refusal)
        return value
    if kind in (Vector, Names):
        # ROS hands arrays over as array.array or ndarray.
        if not isinstance(value, Iterable) or isinstance(value, str | Mapping):
            raise UserError(refusal)
        items = tuple(value)
        if kind is Names:
            if not all(isinstance(item, str) for item in items):
                raise UserError(refusal)
            return items
        if parameter.size not in (ANY, len(items)):
            raise UserError(f"{key} has {len(items)} values, but must be {_expected(parameter)}")
        numbers = tuple(_number(item, key, _expected(parameter)) for item in items)
        for number in numbers:
            _check_bounds(parameter, number)
        return numbers
    number = _number(value, key, _expected(parameter))
    if kind is int and not number.is_integer():
        raise UserError(refusal)
    _check_bounds(parameter, number)
    return kind(number)


def _number(value: Any, key: str, expected: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{key} is {_shown(value)}, but must be {expected}")
    if not abs(value) <= LARGEST:
        raise UserError(f"{key} is {_shown(value)}, but must be finite and of a sensible size")
    return float(value)


def _numbers(values: Any, key: str, lower: float = -math.inf) -> dict[str, float]:
    """An open mapping of names to numbers."""
    if not isinstance(values, Mapping):
        raise UserError(f"{key} is {_shown(values)}, but must be a section of names and numbers")
    numbers = {str(n): _number(v, f"{key}.{n}", "a number") for n, v in values.items()}
    for name, number in numbers.items():
        if number < lower:
            raise UserError(f"{key}.{name} is {number}, but must be positive")
    return numbers


def _check_bounds(parameter: Parameter, number: float) -> None:
    lower, upper = parameter.lower, parameter.upper
    if lower <= number <= upper:
        return
    if math.isfinite(lower) and math.isfinite(upper):
        wanted = f"between {0 if lower == POSITIVE else lower:g} and {upper:g}"
    elif lower == POSITIVE:
        wanted = "positive"
    else:
        wanted = f"at least {lower:g}" if number < lower else f"at most {upper:g}"
    unit = f" {parameter.unit}" if parameter.unit else ""
    raise UserError(f"{parameter.key} is {number:g}{unit}, but must be {wanted}")


def _effects(values: Any) -> dict[str, dict[str, float]]:
    """Checked effects, parameters left out at the value where they vanish."""
    if not isinstance(values, Mapping):
        raise UserError(f"effects is {_shown(values)}, but must be a section of effects")
    effects = {}
    for name, given in values.items():
        if name not in EFFECTS:
            raise UserError(f"effects.{name} is an unknown effect: {_suggestion(name, EFFECTS)}")
        if names := EFFECTS[name].coefficients:
            raise UserError(
                f"effects.{name} is a family of coefficients: put {', '.join(names)}, or some of "
                "them, under coefficients"
            )
        declared = {p.name: p for p in EFFECTS[name].parameters}
        numbers = _numbers(given, f"effects.{name}")
        for parameter, number in numbers.items():
            key = f"effects.{name}.{parameter}"
            if parameter not in declared:
                raise UserError(f"{key} is an unknown key: {_suggestion(parameter, declared)}")
            lower, upper = declared[parameter].lower, declared[parameter].upper
            if not lower <= number <= upper:
                unit = declared[parameter].unit
                raise UserError(
                    f"{key} is {number:g} {unit}, but must be between {lower:g} and {upper:g}"
                )
        effects[name] = {p.name: numbers.get(p.name, p.null) for p in declared.values()}
    return effects


def _model(vehicle: Vehicle, coefficients: Mapping[str, float], gravity: float) -> Model:
    if not coefficients:
        raise UserError("coefficients is empty: give at least one, such as X_udot or X_u")
    for name in coefficients:
        if parse_fin(name) is not None:
            continue
        try:
            parse(name)
        except UserError as error:
            close = difflib.get_close_matches(name, [c.name for c in catalogue()], 1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise UserError(f"coefficients.{name}: {error}{hint}") from error
    signs = _signs(vehicle.frame)
    xx, yy, zz, xy, xz, yz = vehicle.inertia
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) * np.outer(signs, signs)
    if np.linalg.eigvalsh(inertia)[0] <= 0:
        raise UserError(
            f"vehicle.inertia {list(vehicle.inertia)} is not positive definite: "
            "check its values and their order xx yy zz xy xz yz"
        )
    body = RigidBody(
        mass=vehicle.mass,
        weight=gravity * vehicle.mass if vehicle.weight is None else vehicle.weight,
        buoyancy=vehicle.buoyancy,
        cog=signs * vehicle.cog + 0.0,  # + 0.0 turns -0.0 into 0.0
        cob=signs * vehicle.cob + 0.0,
        inertia=inertia + 0.0,
    )
    return build(body, coefficients)


def _estimated(
    model: Model, effects: Mapping[str, Mapping[str, float]], names: Names
) -> tuple[Names, tuple[tuple[str, str], ...]]:
    """What to estimate, in the order of the model and of the effects; no names given: all."""
    possible = {f"{e}.{p}": (e, p) for e, values in effects.items() for p in values}
    for name in names:
        effect, _, parameter = name.partition(".")
        if not parameter:
            continue
        if name not in possible:
            raise UserError(f"estimate: {name} is not in effects: {_suggestion(name, possible)}")
        if parameter not in estimable(effect):
            raise UserError(f"estimate: {name} cannot be estimated live: leave it out")
    chosen = {_in_model(model, n, f"estimate: {n}") for n in names if "." not in n}
    usual = [
        f"{name}.{p}"
        for name, values in effects.items()
        for p, null in estimable(name).items()
        if null is None or values[p] != null
    ]
    return (
        tuple(name for name in model.names if not names or name in chosen),
        tuple(key for name, key in possible.items() if name in (names or usual)),
    )


def thruster_signal(inputs: Inputs, chosen: Thrusters) -> str:
    """What a command is: one of thrusters.SIGNALS."""
    if chosen.signal != "auto":
        return chosen.signal
    return thrusters.PWM if inputs.wrench in PULSE_TYPES else thrusters.FORCE


def _turned(given: Thrusters, signs: Array) -> Thrusters:
    """The same in forward-starboard-down: vectors of ``vehicle.frame`` in threes."""
    turned: dict[str, Any] = {}
    for name in ("position", "direction", "allocation"):
        values = np.array(getattr(given, name))
        if len(values) % 3 == 0:  # else refused where it is used
            turned[name] = tuple((np.tile(signs, len(values) // 3) * values + 0.0).tolist())
    return dataclasses.replace(given, **turned)


def _in_model(model: Model, name: str, key: str) -> str:
    """The model's own name of a coefficient (N_vdot may be its Y_rdot)."""
    by_place = {c.place: c.name for c in model.coefficients}
    try:
        return by_place[parse(name).place]
    except (UserError, KeyError):
        raise UserError(f"{key} is not in coefficients: {_suggestion(name, model.names)}") from None


def _signs(frame: str) -> Array:
    """(3,) factors that turn a vector of ``vehicle.frame`` into forward-starboard-down."""
    ones = np.ones(3)
    body = "flu" if frame == "flu" else "frd"
    return to_core(Wrench(0, "", ones, ones), FrameDefaults(body=body)).force


# ------------------------------------------------------------------ writing


def to_parameters(config: Config) -> dict[str, Any]:
    """Nested plain values from which :func:`from_parameters` makes the same configuration.

    Settings at their defaults are left out.
    """
    body = config.model.body
    inertia = body.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    vehicle = {
        "name": config.name,
        "frame": "frd",
        "mass": float(body.mass),
        "weight": float(body.weight),
        "buoyancy": float(body.buoyancy),
        "cog": body.cog.tolist(),
        "cob": body.cob.tolist(),
        "inertia": inertia.tolist(),
    }
    coefficients = dict(zip(config.model.names, config.model.theta.tolist(), strict=True))
    coefficients |= config.model.fins
    settings = _changed(config)
    estimate = (*config.estimate, *(f"{e}.{p}" for e, p in config.estimate_effects))
    usual = _estimated(config.model, config.effects, ())
    settings.pop("estimate", None)
    if (config.estimate, config.estimate_effects) != usual:
        settings["estimate"] = list(estimate)
    return {"vehicle": vehicle, "coefficients": coefficients, **settings}


def dump(config: Config, path: str | os.PathLike[str], comment: str = "") -> None:
    """Write a parameter file that :func:`load` reads as the same configuration, to the last bit.

    ``comment`` goes above the parameters. The file appears whole or not at all.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    path = Path(path)
    document = {"/**": {"ros__parameters": to_parameters(config)}}
    text = "".join(f"# {line}\n" for line in comment.splitlines())
    text += yaml.dump(document, Dumper=_Dumper, sort_keys=False, width=1000)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        try:
            partial.write_text(text, encoding="utf-8")
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from error


def _changed(section: Any) -> dict[str, Any]:
    """What differs from the defaults, as plain values."""
    changed: dict[str, Any] = {}
    for item in dataclasses.fields(section):
        value = getattr(section, item.name)
        if dataclasses.is_dataclass(value):
            if item.default is not dataclasses.MISSING and (inner := _changed(value)):
                changed[item.name] = inner
        elif isinstance(value, Mapping):
            if value:
                changed[item.name] = _plain(value)
        elif item.metadata and value != item.default:
            changed[item.name] = list(value) if isinstance(value, tuple) else value
    return changed


def _plain(value: Any) -> Any:
    """Mappings as dict, numbers as float."""
    if isinstance(value, Mapping):
        return {name: _plain(inner) for name, inner in value.items()}
    return float(value)


def as_file_name(name: str) -> str:
    """A vehicle's name as part of a file's name: nothing that would lead to another folder."""
    return re.sub(r"[^\w.-]", "_", name).lstrip(".") or "vehicle"


# ------------------------------------------------------------------ words


def _shown(value: Any) -> str:
    """A value as the user wrote it, and what it was read as."""
    if value is None:
        return "empty"
    if isinstance(value, Mapping):
        return "a section of keys"
    kinds: dict[type, str] = {
        bool: "true or false",
        str: "text",
        int: "a number",
        float: "a number",
    }
    text = repr(value)
    text = text if len(text) <= 60 else f"{text[:57]}..."
    return f"{text} ({kinds.get(type(value), 'a list')})"


def _expected(parameter: Parameter) -> str:
    if parameter.choices:
        return "one of " + ", ".join(parameter.choices)
    unit = f" ({parameter.unit})" if parameter.unit else ""
    if parameter.type is Vector and parameter.size == ANY:
        return f"a list of numbers{unit}"
    if parameter.type is Vector:
        return f"a list of {parameter.size} numbers{unit}"
    words = {
        float: "a number",
        int: "a whole number",
        bool: "true or false",
        str: "text",
        Names: "a list of names",
    }
    return words[parameter.type] + unit


def _suggestion(name: Any, known: Iterable[str]) -> str:
    known = list(known)
    close = difflib.get_close_matches(str(name), known, 1)
    return f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}"


# ------------------------------------------------------------------ YAML


class _Loader(yaml.SafeLoader):
    """YAML as ROS reads it: `1e-3` is a number; and a key given twice is refused."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"the key {key.value} is given twice", problem_mark=key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Sections in block style, lists on one line."""


for _yaml in (_Loader, _Dumper):  # the dumper, to quote text that looks like such a number
    _yaml.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"),
        list("-+.0123456789"),
    )
_Dumper.add_representer(
    list, lambda dumper, items: dumper.represent_sequence("tag:yaml.org,2002:seq", items, True)
)


def _parse(path: Path) -> Any:
    try:
        text = path.read_text(encoding="utf-8")
        return yaml.load(text, _Loader)  # nosec B506
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError("is not a text file: give a YAML parameter file") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        what = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise UserError(f"is not valid YAML{where}: {what}") from error
    except (ValueError, RecursionError) as error:  # an impossible date, bottomless brackets
        raise UserError(f"is not valid YAML: {error}") from error


def _section(document: Any, node: str) -> dict[str, Any]:
    """The parameters that the file gives for ``node``."""
    if document is None:
        raise UserError("is empty: give a section /**: with ros__parameters: below it")
    if not isinstance(document, Mapping):
        raise UserError(f"is {_shown(document)} at the top, but must begin with /**:")
    sections = {
        str(name).rpartition("/")[2]: content["ros__parameters"]
        for name, content in document.items()
        if isinstance(content, Mapping) and "ros__parameters" in content
    }
    if not sections:
        raise UserError("has no ros__parameters: put /**: and ros__parameters: above the keys")
    chosen = [sections[name] for name in ("**", node) if name in sections]
    if not chosen and len(sections) == 1:
        chosen = list(sections.values())
    if not chosen:
        raise UserError(f"has no section /**: only for {', '.join(sections)}; rename one of them")
    merged: dict[str, Any] = {}
    for parameters in chosen:
        if not isinstance(parameters, Mapping):
            raise UserError(
                f"ros__parameters is {_shown(parameters)}, but must be a section of keys"
            )
        _merge(merged, unflatten(parameters))
    return merged


def _merge(base: dict[str, Any], over: Mapping[str, Any]) -> None:
    """Put the values of ``over`` into ``base``, section by section."""
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            _merge(base[key], value)
        else:
            base[key] = value
