"""The parameter file of nodes and commands, as frozen dataclasses.

Every key is declared once, as a field with :func:`option`: its type, default, unit, bounds and
meaning, from which reading, checking, writing, ROS parameters and documentation follow.

Vectors in the file are in the axes of ``vehicle.frame``, those of a :class:`Config` in
forward-starboard-down; so are coefficients (SNAME) and effects, in the file too.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

from rov_ident.core.errors import UserError
from rov_ident.core.frames import FrameDefaults, quaternion_from_euler, quaternion_to_matrix
from rov_ident.core.messages import Array
from rov_ident.effects import EFFECTS, Values, rigid_body
from rov_ident.model import thruster_allocation as thrusters
from rov_ident.model.coefficients import FINS, INPUTS, Coefficient
from rov_ident.model.equations import GRAVITY, Model

T = TypeVar("T")
Vector = tuple[float, ...]
Names = tuple[str, ...]

POSITIVE = 1e-9  # the lower bound of what must be greater than zero
ANY = -1  # the ``size`` of a list of any length
LARGEST = 1e20  # no number of a vehicle is larger; below it nothing computed from them overflows


def option(default: T | None, description: str, unit: str = "", **details: Any) -> T:
    """A key of the file: see :class:`Parameter`. Without a default it is required or computed."""
    details |= {"default": default, "description": description, "unit": unit}
    if isinstance(default, tuple):
        details.setdefault("size", len(default))
    return field(default=default, metadata=details)  # type: ignore[return-value]


def positive(default: float | None, description: str, unit: str = "", **details: Any) -> Any:
    """The same of what must be greater than zero."""
    return option(default, description, unit, lower=POSITIVE, **details)


def not_negative(default: T, description: str, unit: str = "", **details: Any) -> T:
    """The same of what may be zero, but not less; of a vector each element."""
    return option(default, description, unit, lower=0.0, **details)


@dataclass(frozen=True)
class Parameter:
    """One key of the parameter file.

    ``type`` is float, int, bool, str, Vector (of ``size`` numbers, or ANY) or Names. ``default`` is
    None for what is required, or ``computed`` from other keys. ``lower`` and ``upper`` are
    inclusive, for vectors of every element. ``live``: may change while a node runs.
    """

    key: str
    type: Any
    default: Any
    description: str
    unit: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    choices: Names = ()
    size: int = 0
    live: bool = False
    computed: bool = False

    @property
    def required(self) -> bool:
        return self.default is None and not self.computed


@dataclass(frozen=True, kw_only=True)
class VehicleUncertainty:
    """`vehicle`: how well the rigid body is known; standard deviations, zero: exactly."""

    mass_std: float = not_negative(0.01, "of the mass, relative; it widens X_udot Y_vdot Z_wdot")
    inertia_std: float = not_negative(
        0.05, "of the moments of inertia, relative; it widens K_pdot M_qdot N_rdot"
    )
    buoyancy_std: float = not_negative(0.02, "of the buoyancy, relative to the weight")
    cog_std: float = not_negative(0.005, "of the centre of gravity, each component", "m")
    cob_std: float = option(
        None, "of the height of the centre of buoyancy; it widens the thrust scale; left out: "
        "0.005, or 0.15 of the righting arm where that is more", "m", lower=0.0,
        computed=True,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Vehicle(VehicleUncertainty):
    """`vehicle`: the rigid body as the file states it."""

    name: str = option(None, "name of the vehicle")
    frame: str = option(
        None,
        "axes of every vector in the file: forward-right-down (frd, also called fsd) or "
        "forward-left-up (flu)",
        choices=("frd", "fsd", "flu"),
    )
    mass: float = positive(None, "mass in air, with enclosed air", "kg")
    weight: float = positive(None, "weight; left out: gravity * mass", "N", computed=True)
    buoyancy: float = positive(None, "weight of the displaced water", "N")
    cog: Vector = option(None, "centre of gravity from the body origin", "m", size=3)
    cob: Vector = option(None, "centre of buoyancy from the body origin", "m", size=3)
    inertia: Vector = option(
        None,
        "entries xx yy zz xy xz yz of the inertia tensor about the centre of gravity",
        "kg m2",
        size=6,
    )


@dataclass(frozen=True, kw_only=True)
class Prior:
    """`prior`: how well the coefficients in the file are known before any data."""

    relative_std: float = positive(0.5, "standard deviation of a coefficient relative to its value")
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
    inputs: str = option("", "sensor_msgs/JointState topic in a bag, of the joints of inputs")


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
class Fin:
    """`inputs.delta_s`, `delta_r`, `delta_a`: an angle, by the position of a joint."""

    joint: str = option("", "name of the joint; empty: none, the angle counts as zero")
    scale: float = option(
        1.0, "rad of the angle per rad of the joint: -1 where the joint counts the other way round"
    )


@dataclass(frozen=True, kw_only=True)
class Shaft:
    """`inputs.n`: revolutions a second of the propeller, by the velocity of a joint."""

    joint: str = option("", "name of the joint; empty: none, the speed counts as zero")
    scale: float = option(0.5 / math.pi, "revolutions per rad of the joint, with its sign", "1/rad")


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

    delta_s: Fin = Fin()
    delta_r: Fin = Fin()
    delta_a: Fin = Fin()
    n: Shaft = Shaft()
    fin_lag_std: float = not_negative(
        0.5, "of the time constant with which fins follow the angles that are read; zero: at once",
        "s",
    )  # fmt: skip

    @property
    def joints(self) -> dict[str, Fin | Shaft]:
        """What drives the vehicle beside the wrench: of model.coefficients.INPUTS, those heard."""
        every: dict[str, Fin | Shaft] = {name: getattr(self, name) for name in INPUTS}
        return {name: given for name, given in every.items() if given.joint}

    @property
    def standard(self) -> "Inputs":
        """The same joints beside odometry and a wrench."""
        given = {name: getattr(self, name) for name in (*INPUTS, "fin_lag_std")}
        return Inputs(**given)

    @property
    def is_twist(self) -> bool:
        return self.odom != ODOMETRY_TYPES[0]

    @property
    def is_allocated(self) -> bool:
        """Whether the thrust comes as commands of single thrusters."""
        return self.wrench not in WRENCH_TYPES


@dataclass(frozen=True, kw_only=True)
class Thrusters(thrusters.Geometry):
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
    voltage: float = positive(
        16.0,
        "supply of the thrusters, for the curve of the T200; with inputs.battery until it is heard",
        "V",
    )
    curve_pwm: Vector = option(
        (), "pulse widths of another thruster's curve of thrust; empty: the T200's", "us", size=ANY
    )
    curve_force: Vector = option((), "thrust at each of curve_pwm", "N", size=ANY)


@dataclass(frozen=True, kw_only=True)
class OdometrySensor:
    """`odometry`: the velocity sensor."""

    position: Vector = option(
        (0.0, 0.0, 0.0), "velocity sensor from the body origin; the pose is the origin's", "m"
    )
    linear_std: float = positive(
        0.01, "noise of a velocity, where the message gives no variance", "m/s"
    )
    angular_std: float = positive(
        0.005, "noise of an angular rate, where the message gives none", "rad/s"
    )
    attitude_std: float = positive(0.005, "noise of an attitude angle", "rad")
    latency_std: float = not_negative(
        0.1, "how late linear velocities may be against their stamps; zero: not at all", "s"
    )
    scale_std: float = not_negative(
        0.01, "of the factor by which linear velocities read too much; zero: none"
    )
    gate: float = positive(5.0, "a velocity further off the integrated IMU is refused", "sigma")


@dataclass(frozen=True, kw_only=True)
class ImuSensor:
    """`imu`: the inertial measurement unit."""

    position: Vector = option((0.0, 0.0, 0.0), "IMU from the body origin", "m")
    rotation: Vector = option(
        (0.0, 0.0, 0.0), "roll, pitch, yaw of the sensor axes from the body axes", "rad"
    )
    accelerometer_std: float = positive(
        1.0,
        "trust in the integrated acceleration between odometry messages: noise, vibration and "
        "thrust that steps between two samples (docs/samples.md shows how it was chosen)",
        "m/s2",
    )
    gyro_std: float = positive(
        0.003, "noise of an angular rate, where the message gives none", "rad/s"
    )
    accelerometer_bias_std: float = not_negative(
        0.1, "prior standard deviation of the accelerometer bias", "m/s2"
    )
    gyro_bias_std: float = not_negative(
        0.01, "prior standard deviation of the gyroscope bias", "rad/s"
    )

    @property
    def to_body(self) -> Array:
        """The matrix (3, 3) that takes vectors in sensor axes to body axes."""
        return quaternion_to_matrix(quaternion_from_euler(*self.rotation))


@dataclass(frozen=True, kw_only=True)
class WrenchNoise:
    """`wrench`: how well the thruster wrench is known."""

    scale_std: float = not_negative(0.15, "of one factor on the whole wrench; zero: it is exact")
    lag_std: float = not_negative(
        0.2, "time constant that the thrusters' lag may have; zero: none", "s"
    )
    relative_std: float = not_negative(0.01, "standard deviation relative to the wrench")
    correlation_time: float = positive(
        0.02, "how long an error of the wrench lasts; at least until the next message", "s"
    )
    floor_std: Vector = not_negative(
        (0.0,) * 6, "standard deviation at zero wrench: X Y Z, K M N", "N, N m"
    )


@dataclass(frozen=True, kw_only=True)
class Rls:
    """`rls`: the recursive least-squares estimator."""

    forgetting: str = option(
        "variable", "how old data lose weight", choices=("variable", "constant")
    )
    forgetting_factor: float = positive(
        1.0,
        "weight kept per 0.1 s by constant forgetting, in directions that move",
        upper=1.0,
        live=True,
    )
    gate: float = positive(5.0, "a sample further off than this is refused", "sigma", live=True)


@dataclass(frozen=True, kw_only=True)
class Ukf:
    """`ukf`: the unscented Kalman filter."""

    alpha: float = option(0.5, "spread of the sigma points", lower=1e-4, upper=1.0)
    beta: float = not_negative(2.0, "weight of the centre point: 2 suits a Gaussian")
    kappa: float = not_negative(0.0, "secondary spread of the sigma points")
    gate: float = positive(5.0, "a sample further off than this is refused", "sigma", live=True)
    change_threshold: float = option(
        3.0,
        "normalised innovation squared of an axis, over 2 s, from which the vehicle is taken to "
        "have changed and its coefficients are learnt anew; 1 is expected, higher where the model "
        "is rough",
        lower=1.0,
    )
    random_walk: float = not_negative(
        0.0,
        "drift of a coefficient relative to its value, without any evidence of a change",
        "1/sqrt(h)",
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

    ``model`` is what ``vehicle`` and ``coefficients`` say, :attr:`dynamics` what moves with the
    ``effects``: {effect: {parameter: value}}, complete. ``estimate`` names the coefficients to
    estimate, in the order of ``model.names``, the others are held; ``estimate_effects`` the
    parameters of effects, (effect, parameter). In the file both are under ``estimate``.
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
    process_std: Vector = not_negative(
        (0.0001,) * 6,
        "least density of the acceleration that the model does not explain, besides the noise of "
        "the wrench (more is found from the innovations): surge sway heave, roll pitch yaw",
        "m/s2/sqrt(Hz), rad/s2/sqrt(Hz)",
    )
    residual_corner: float = positive(
        3.0, "corner of the filter on the published wrench residual", "rad/s"
    )
    rls: Rls = Rls()
    ukf: Ukf = Ukf()
    qos: Qos = Qos()
    publish_rate: float = option(
        5.0, "rate of the published coefficients", "Hz", lower=0.01, upper=1000.0, live=True
    )
    timeout: float = positive(
        1.0, "inputs silent for longer are reported as stopped", "s", live=True
    )
    grace: float = not_negative(0.3, "how long a late topic is waited for, in stamp time", "s")
    current_std: float = not_negative(
        0.3, "of the velocity of the water north and east; zero: it is still", "m/s"
    )
    vehicle_uncertainty: VehicleUncertainty = field(default_factory=VehicleUncertainty)
    nomoto: bool = option(
        False,
        "whether the nodes also identify K and T of Nomoto's model, from the heading of the "
        "odometry and the rudder",
    )
    rudder_joint: str = option(
        "",
        "the rudder's name in joint_states (sensor_msgs/JointState, position in rad); empty: its "
        "command is on the topic rudder (std_msgs/Float64, rad), stamped on arrival",
    )
    effects: Values = field(default_factory=dict)
    estimate_effects: tuple[tuple[str, str], ...] = ()

    @cached_property
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
    def effect_names(self) -> Names:
        """Of the estimated parameters of effects, such as thruster_lag.time_constant."""
        return tuple(".".join(key) for key in self.estimate_effects)

    @cached_property
    def nuisance_std(self) -> dict[tuple[str, str], float]:
        """Prior standard deviations of what no vehicle's file knows, by (effect, parameter)."""
        body, vehicle = self.model.body, self.vehicle_uncertainty
        turned = {name for c in self.model.coefficients for name in c.inputs} & {*FINS}
        has_fins = bool(turned & self.inputs.joints.keys())
        std = {
            ("thrust_scale", "scale"): self.wrench.scale_std,
            ("thruster_lag", "time_constant"): self.wrench.lag_std,
            ("ocean_current", "north"): self.current_std,
            ("ocean_current", "east"): self.current_std,
            ("buoyancy", "delta"): vehicle.buoyancy_std * body.weight,
            **{("cog_offset", name): vehicle.cog_std for name in ("dx", "dy", "dz")},
            ("velocity_latency", "delay"): self.odometry.latency_std,
            ("fin_lag", "time_constant"): self.inputs.fin_lag_std if has_fins else 0.0,
        }
        return {key: value for key, value in std.items() if value > 0.0}

    @property
    def with_nuisance(self) -> "Config":
        """The same, with what no vehicle's file knows among the parameters to estimate.

        An effect that the file gives is left to what it says of it under `estimate`.
        """
        added = [key for key in self.nuisance_std if key[0] not in self.effects]
        effects = {name: {p.name: p.null for p in EFFECTS[name].parameters} for name, _ in added}
        return dataclasses.replace(
            self,
            effects={**self.effects, **effects},
            estimate_effects=(*self.estimate_effects, *added),
        )

    @property
    def unheard(self) -> dict[str, Names]:
        """Coefficients that wait for an input which no joint gives: {input: names}."""
        found: dict[str, list[str]] = {}
        for c in self.model.coefficients:
            for name in missing_inputs(c, self.inputs):
                found.setdefault(name, []).append(c.name)
        return {name: tuple(names) for name, names in found.items()}

    @property
    def with_effects_held(self) -> "Config":
        """The same, with the parameters of effects as they are: samples need not follow them."""
        return dataclasses.replace(self, estimate_effects=())

    def with_values(self, values: Mapping[str, float]) -> "Config":
        """The same with other values of coefficients, and of parameters of its effects by names
        such as thruster_lag.time_constant.

        Raises UserError if there is no such coefficient or parameter.
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
        held |= {c.name for c in model.coefficients if missing_inputs(c, self.inputs)}
        estimate = tuple(name for name in model.names if name not in held)
        std = {name: value for name, value in self.prior.std.items() if name in model.names}
        prior = dataclasses.replace(self.prior, std=std)
        return dataclasses.replace(self, model=model, estimate=estimate, prior=prior)


def missing_inputs(coefficient: Coefficient, inputs: Inputs) -> Names:
    """The inputs that a coefficient depends on and that no joint gives."""
    return tuple(name for name in coefficient.inputs if name not in inputs.joints)


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

ESTIMATOR_PARAMETERS = (
    Parameter("save_path", str, "",
        "file that ~/save writes; empty: named by vehicle, namespace and node"),
    Parameter("checkpoint_path", str, "",
        "file in which what is learnt outlives a crash, or a folder for it; empty: none"),
    Parameter("lockstep", bool, False, "a player sets the pace"),
)  # fmt: skip
"""Of the nodes that estimate. They may stand in the file, too: whatever else reads it passes over
them."""

BY_KEY = {p.key: p for p in VEHICLE_PARAMETERS + PARAMETERS}
