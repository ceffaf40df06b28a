"""What vehicles publish, into the three messages of the core: one definition for topics and bags.

A :class:`Reader` takes messages of the configured types (``inputs``) as bytes and gives what the
sampler takes: a wrench, stamped on arrival (in a bag: its log time) where it comes without a stamp,
which presumes that the computer's clock is that of the sensors; commands of single thrusters
through `Allocator`, pulses at the voltage of the battery that was last heard; a twist and the poses
around it joined into odometry at the stamp of the twist, position straight in between, attitude
along the shortest rotation.
"""

from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from itertools import islice
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from rov_ident.config import Config, Inputs, schema, thruster_signal
from rov_ident.core.errors import UserError
from rov_ident.core.frames import from_core, quaternion_between
from rov_ident.core.messages import (
    DRIVE,
    IMU,
    ODOMETRY,
    WRENCH,
    Commands,
    Message,
    Odometry,
    Pose,
    Twist,
    Wrench,
)
from rov_ident.core.progress import Progress, silent
from rov_ident.io import cdr
from rov_ident.io.bag_reader import Bag, RawMessage
from rov_ident.model.thruster_allocation import Allocator, knows

ROLE_NAMES = {ODOMETRY: "odom", IMU: "imu/data", WRENCH: "thruster_wrench", DRIVE: "joint_states"}
"""Topics as the nodes call them."""

_USUAL = {
    ODOMETRY: ("odometry/filtered", "odometry"),
    IMU: ("imu",),
    WRENCH: ("thruster_manager/input", "wrench"),
    "velocity": ("velocity_body", "dvl/twist", "twist"),
    "pose": ("local_position/pose",),
    "thruster_pwm": ("rc/out",),
    "battery": ("battery_state",),
}
"""As robot_localization, mavros and uuv_simulator call them: taken where no topic has our name."""

POSE, BATTERY, RUDDER = "pose", "battery", "rudder"
_JOINTS = "sensor_msgs/JointState"
_COMMANDS = {"std_msgs/msg/Float64": "f8", "std_msgs/msg/Float32": "f4"}

_STAMPED = ("geometry_msgs/WrenchStamped", "sensor_msgs/JointState", "mavros_msgs/RCOut")
_NAMED = 5  # topics; of arrays of numbers a bag may have dozens
_FIRST = 200  # messages that tell how late a topic is: some seconds
_LONGEST_GAP = 500_000_000  # ns; poses further apart are not interpolated
_HELD = 1000  # poses and twists that wait for each other
_NOT_MEASURED = np.full(3, 1e6)  # a variance from which nothing is believed
_FRAME = "base_link"  # of a wrench that comes without a frame: the axes are those of frames.body

_CHOICES = {
    ODOMETRY: schema.ODOMETRY_TYPES,
    POSE: schema.POSE_TYPES,
    WRENCH: schema.BY_KEY["inputs.wrench"].choices,
}

_FOREIGN = {  # what such topics and types are called, and what they could be
    ODOMETRY: (
        ("dvl", "bottomtrack", "odom", "velocity", "twist"),
        "geometry_msgs/TwistStamped (velocity in body axes) beside a geometry_msgs/PoseStamped",
    ),
    POSE: (("pose", "attitude", "ahrs"), "geometry_msgs/PoseStamped"),
    WRENCH: (
        ("thrust", "wrench", "pwm", "servo", "actuator"),
        "sensor_msgs/JointState (a force for each thruster) or geometry_msgs/WrenchStamped",
    ),
}

ONE_CLOCK = 1.0
"""s; topics that come together and are stamped further apart are of two clocks: no driver takes so
long, and the sampler waits no longer for a late topic."""

USUAL: Any = SimpleNamespace(
    inputs=Inputs(), topics=schema.Topics(), frames=schema.Frames(), thrusters=schema.Thrusters()
)
"""What a configuration says by default of how messages are read: for whoever is given none."""


class Source(NamedTuple):
    """A topic that is listened to: its relative name and its type, as `geometry_msgs/Wrench`."""

    topic: str
    type_name: str


def sources(inputs: Inputs) -> dict[str, Source]:
    """The topics by role: `odom`, `imu`, `wrench`; `pose` where the motion is a twist; `battery`
    and `inputs` where there are such."""
    thrust = ROLE_NAMES[WRENCH]
    if inputs.is_allocated:
        thrust = "thruster_forces" if inputs.wrench in schema.FORCE_TYPES else "thruster_pwm"
    found = {
        ODOMETRY: Source("velocity" if inputs.is_twist else ROLE_NAMES[ODOMETRY], inputs.odom),
        IMU: Source(ROLE_NAMES[IMU], "sensor_msgs/Imu"),
        WRENCH: Source(thrust, inputs.wrench),
    }
    if inputs.is_twist:
        found[POSE] = Source("pose", inputs.pose)
    if inputs.battery != "none":
        found[BATTERY] = Source("battery", inputs.battery)
    if inputs.joints:
        found[DRIVE] = Source(ROLE_NAMES[DRIVE], _JOINTS)
    return found


def rudder_name(config: Config) -> str:
    """The topic of Nomoto's rudder as the nodes call it: measured angles, or else commands."""
    return ROLE_NAMES[DRIVE] if config.rudder_joint else RUDDER


class Reader:
    """Bytes of the configured topics into messages of the core, axes as on the wire.

    ``counts`` holds, by role and reason, what could not be used. ``on_arrival`` tells whether the
    thrust comes without a stamp.
    """

    def __init__(self, config: Config) -> None:
        self.counts: Counter[str] = Counter()
        self._frames = config.frames
        self._is_twist = config.inputs.is_twist
        heard = sources(config.inputs).items()
        self._types = {role: _full_name(source.type_name) for role, source in heard}
        self.on_arrival = config.inputs.wrench not in _STAMPED
        self._allocator = None
        if config.inputs.is_allocated:
            signal = thruster_signal(config.inputs, config.thrusters)
            self._allocator = Allocator(config.thrusters, signal)
        self._voltage = config.thrusters.voltage
        self._poses: deque[Pose] = deque(maxlen=_HELD)
        self._twists: deque[Twist] = deque()

    def read(self, role: str, data: bytes, arrival: int) -> list[tuple[str, Message]]:
        """What the sampler is to take, (role, message); ``arrival`` [ns] stamps what has none."""
        type_name = self._types[role]
        try:
            if role == DRIVE:
                return [(DRIVE, cdr.decode_joints(data))]
            message = cdr.DECODERS[type_name](data)
        except ValueError:
            self.counts[f"{role}: bytes that are no {type_name}"] += 1
            return []
        if role == BATTERY:
            if knows(message):
                self._voltage = message
            else:
                self.counts["battery: a voltage for which the T200 has no curve"] += 1
            return []
        if role == WRENCH:
            return self._wrench(message, arrival)
        if not self._is_twist or role == IMU:
            return [(role, message)]
        return self._joined(message)

    def flush(self) -> None:
        """The input has ended: twists still without a pose are given up."""
        if self._twists:
            self.counts["odom: a twist without a pose around it"] += len(self._twists)
            self._twists.clear()

    def _wrench(self, message: Wrench | Commands, arrival: int) -> list[tuple[str, Message]]:
        if isinstance(message, Wrench):
            if self.on_arrival:
                message = message._replace(stamp=arrival, frame_id=_FRAME)
            return [(WRENCH, message)]
        assert self._allocator is not None
        try:
            tau = self._allocator.wrench(message.values, self._voltage)
        except ValueError as reason:
            self.counts[f"{WRENCH}: {reason}"] += 1
            return []
        stamp = arrival if self.on_arrival else message.stamp
        wrench = Wrench(stamp, _FRAME, tau[:3], tau[3:])
        return [(WRENCH, from_core(wrench, self._frames))]

    def _joined(self, message: Twist | Pose) -> list[tuple[str, Message]]:
        if isinstance(message, Pose):
            if self._poses and message.stamp <= self._poses[-1].stamp:
                if self._poses[-1].stamp - message.stamp < 1_000_000_000:
                    self.counts["pose: duplicate or backward stamp"] += 1
                    return []
                self._poses.clear()  # a bag that starts over
                self._twists.clear()
            self._poses.append(message)
        else:
            self._twists.append(message)
            if len(self._twists) > _HELD:
                self._twists.popleft()
                self.counts["odom: a twist without a pose around it"] += 1
        done: list[tuple[str, Message]] = []
        while self._twists and self._poses and self._poses[-1].stamp >= self._twists[0].stamp:
            twist = self._twists.popleft()
            pose = self._pose_at(twist.stamp)
            if pose is None:
                self.counts["odom: a twist without a pose around it"] += 1
                continue
            variance = twist.variance
            if not twist.angular.any():  # a velocity log (DVL) that has no rates to say
                variance = np.concatenate([variance[:3], _NOT_MEASURED])
            attitude, velocity = pose.orientation, (twist.linear, twist.angular)
            frames = pose.frame_id, twist.frame_id
            odometry = Odometry(twist.stamp, *frames, pose.position, attitude, *velocity, variance)
            done.append((ODOMETRY, odometry))
        return done

    def _pose_at(self, stamp: int) -> Pose | None:
        """Between the poses before and after; None where there are none close enough."""
        i = bisect_left(self._poses, stamp, key=lambda pose: pose.stamp)
        after = self._poses[i]
        if after.stamp == stamp:
            return after
        if i == 0 or after.stamp - self._poses[i - 1].stamp > _LONGEST_GAP:
            return None
        before = self._poses[i - 1]
        share = (stamp - before.stamp) / (after.stamp - before.stamp)
        return after._replace(
            stamp=stamp,
            position=before.position + share * (after.position - before.position),
            orientation=quaternion_between(before.orientation, after.orientation, share),
        )


def select(bag: Bag, config: Config, roles: Collection[str] = ()) -> dict[str, str]:
    """The topic of each role that the bag has; given ``roles``, of these alone.

    Raises UserError if a role is missing, ambiguous or of another type than ``inputs`` says.
    """
    wanted = vars(config.topics)
    chosen: dict[str, str] = {}
    for role, (name, type_name) in sources(config.inputs).items():
        if roles and role not in roles:
            continue
        beside = chosen.get(ODOMETRY, wanted[ODOMETRY])
        try:
            topic = _select_topic(bag, role, name, _full_name(type_name), wanted[role], beside)
        except UserError as error:
            hint = _other_type(bag, role, type_name, wanted[role])
            if role == WRENCH and config.inputs.joints:
                hint = " If fins and shafts alone drive the vehicle, record a wrench of zeros."
            raise UserError(f"{error}{hint}") from error
        if topic:
            chosen[role] = topic
    return chosen


def _candidates(bag: Bag, role: str, name: str, type_name: str, beside: str = "") -> list[str]:
    """The topics that may play a ``role``, as `odom`, that is called ``name`` and of ``type_name``.

    Those of that name in whatever namespace; else of a usual name; else all of the type. Where
    these are several, the one alone that shares the first name of ``beside``, the odometry's topic:
    a bag may hold two vehicles. Topics without messages do not count.
    """
    typed = [t for t, (kind, count) in bag.topics.items() if kind == type_name and count]
    usual = (name, *_USUAL.get(name, ()), *_USUAL.get(role, ()))
    tiers = [[topic for topic in typed if f"/{topic}".endswith(f"/{n}")] for n in usual]
    found = next(filter(None, tiers), typed)
    if len(found) > 1:  # mavros has vision_pose/pose beside local_position/pose
        own = [topic for topic in found if topic.split("/")[1:2] == beside.split("/")[1:2]]
        closer = ([topic for topic in tier if topic in found] for tier in tiers)
        found = next((some for some in (*closer, own) if len(some) == 1), found)
    return found


def _select_topic(
    bag: Bag, role: str, name: str, type_name: str, override: str, beside: str = ""
) -> str | None:
    """Which topic plays a ``role``: an ``override`` (if not empty), else the only one of
    :func:`_candidates`. None: there is none, and need not be.

    Raises UserError: the role is missing, ambiguous or taken by a topic of another type.
    """
    filled = {topic: info.type_name for topic, info in bag.topics.items() if info.message_count}
    holds = ", ".join(f"{topic} ({type_})" for topic, type_ in filled.items())
    if override:
        topic = "/" + override.lstrip("/")
        if topic not in filled:
            raise UserError(f"{bag.path} has no messages on {topic}; it has {holds}.")
        if filled[topic] != type_name:
            raise UserError(f"{topic} in {bag.path} is {filled[topic]}, but {role} is {type_name}.")
        return topic
    found = _candidates(bag, role, name, type_name, beside)
    if len(found) == 1:
        return found[0]
    if found:
        raise UserError(
            f"{bag.path} has several topics that may be {role}: {', '.join(found)}; "
            f"name the one to use, as in topics.{role}: {found[0]}."
        )
    named = [topic for topic in filled if f"/{topic}".endswith(f"/{name}")]
    if named:
        raise UserError(
            f"{named[0]} in {bag.path} is {filled[named[0]]}, but {role} must be {type_name}."
        )
    if role == IMU:  # it may well have none
        return None
    raise UserError(
        f"{bag.path} has no {name} topic ({type_name}): record it too; the bag has {holds}."
    )


def rudder_topic(bag: Bag, measured: bool = False) -> str:
    """The topic of a bag whose name ends in `rudder`, [rad], or of one that is ``measured``, in
    `joint_states`; empty where there is none.

    Raises UserError if there are several.
    """
    name = ROLE_NAMES[DRIVE] if measured else RUDDER
    types = (_full_name(_JOINTS),) if measured else _COMMANDS
    found = [
        topic
        for topic, info in bag.topics.items()
        if info.type_name in types and topic.endswith(name) and info.message_count
    ]
    if len(found) > 1:
        raise UserError(f"{bag.path} has several rudders, {', '.join(found)}: keep one")
    return found[0] if found else ""


def rudder_commands(bag: Bag, topic: str) -> Iterator[tuple[float, RawMessage]]:
    """The angle [rad] of each message of a commanded rudder."""
    kind = _COMMANDS[bag.topics[topic].type_name]
    for raw in bag.iter_raw([topic]):
        yield float(np.frombuffer(raw.data, ("<" if raw.data[1] else ">") + kind, 1, 4)[0]), raw


def doubts(bag: Bag, topics: Mapping[str, str], config: Config) -> list[str]:
    """Notes on a choice of :func:`select` that could be another, and on topics whose stamps are of
    different clocks."""
    notes = []
    for role, topic in topics.items():
        kind = bag.topics[topic].type_name
        others = [t for t, i in bag.topics.items() if i.type_name == kind and i.message_count]
        others = [other for other in others if other not in topics.values()]
        if others and not vars(config.topics)[role]:
            more = " ..." if len(others) > _NAMED else ""
            notes.append(
                f"{role} is {topic}; topics.{role} chooses another of its type: "
                f"{', '.join(others[:_NAMED])}{more}"
            )
    behind = {role: _behind_arrival(bag, role, topic, config) for role, topic in topics.items()}
    for role, seconds in behind.items():
        apart = seconds - behind[ODOMETRY]
        if abs(apart) > ONE_CLOCK:
            notes.append(
                f"{topics[role]} is stamped {abs(apart):.3g} s {'before' if apart > 0 else 'after'}"
                f" {topics[ODOMETRY]}, though they were recorded at the same time: have one clock "
                "stamp both (beside a simulator: use_sim_time, of the recorder, too)"
            )
    return [f"{bag.path.name}: {note}" for note in notes]


def _behind_arrival(bag: Bag, role: str, topic: str, config: Config) -> float:
    """How long [s] the first messages were stamped before they were recorded; 0 of those that are
    stamped on arrival, NaN where nothing tells."""
    if role == BATTERY:
        return np.nan
    if role == WRENCH and config.inputs.wrench not in _STAMPED:
        return 0.0
    decode = cdr.decode_joints if role == DRIVE else cdr.DECODERS[bag.topics[topic].type_name]
    ages = []
    for raw in islice(bag.iter_raw([topic]), _FIRST):
        with suppress(ValueError):
            ages.append((raw.log_time - decode(raw.data).stamp) * 1e-9)
    return float(np.median(ages)) if ages else np.nan


def _other_type(bag: Bag, role: str, type_name: str, wanted: str) -> str:
    """Which other type the role could have in this bag."""
    named = "/" + wanted.lstrip("/")
    others = [
        (topic, other)
        for other in _CHOICES.get(role, ())
        for topic, info in bag.topics.items()
        if other != type_name and info.type_name == _full_name(other) and info.message_count
        if not wanted or topic == named
    ]
    if not others:
        return _unknown_type(bag, role)
    topic, other = others[0]
    return f" Or is it {topic}? Then set inputs.{role} to {other}."


def _unknown_type(bag: Bag, role: str) -> str:
    """Which topic of a type that is not known may be meant, and what to do with it."""
    words, instead = _FOREIGN.get(role, ((), ""))
    packages = {name.partition("/")[0] for name in cdr.DECODERS}
    for topic, info in bag.topics.items():
        package, _, kind = info.type_name.partition("/msg/")
        named = any(word in f"{topic} {kind}".lower() for word in words)
        if named and info.message_count and package not in packages:
            return (
                f" {topic} may be meant, but only the package {package} knows what its type "
                f"{kind} holds: republish it as {instead}."
            )
    return ""


def messages(
    bag: Bag,
    topics: Mapping[str, str],
    config: Config,
    counts: Counter[str] | None = None,
    say: Progress = silent,
) -> Iterator[tuple[str, Message]]:
    """(role, message) in the order of log times, axes as on the wire; ``topics`` of :func:`select`.

    What cannot be used is added to ``counts`` at the end.
    """
    reader = Reader(config)
    for role, message, _ in _read(bag, topics, reader, say):
        yield role, message
    if counts is not None:
        counts.update(reader.counts)


def as_played(
    bag: Bag, topics: Mapping[str, str], config: Config
) -> Iterator[tuple[str, RawMessage]]:
    """(role, message as bytes) of the types that the estimators know, whatever the bag's.

    A message without a stamp could not be stamped on arrival when it is played at another speed.
    """
    if config.inputs == config.inputs.standard:
        roles = {topic: role for role, topic in topics.items()}
        for raw in bag.iter_raw(roles):
            yield roles[raw.topic], raw
        return
    for role, message, raw in _read(bag, topics, Reader(config)):
        if role != DRIVE:
            raw = raw._replace(type_name=cdr.ROLE_TYPES[role], data=cdr.encode(message))
        yield role, raw


def _read(
    bag: Bag, topics: Mapping[str, str], reader: Reader, say: Progress = silent
) -> Iterator[tuple[str, Message, RawMessage]]:
    roles, what = {topic: role for role, topic in topics.items()}, f"reading {bag.path.name}"
    total = sum(bag.topics[topic].message_count for topic in roles)
    for done, raw in enumerate(bag.iter_raw(roles)):
        if done % 2000 == 0:
            say(what, done / max(total, 1))
        for role, message in reader.read(roles[raw.topic], raw.data, raw.log_time):
            yield role, message, raw
    reader.flush()
    say(what, 1.0)


def _full_name(type_name: str) -> str:
    package, _, name = type_name.partition("/")
    return f"{package}/msg/{name}"


FrameIds = tuple[str, str]


class Seen(NamedTuple):
    """A topic of a bag that can serve: `topic`, its type as `nav_msgs/Odometry`, its rate [Hz], and
    the frames of its first message."""

    topic: str
    type_name: str
    rate: float
    frames: FrameIds


def survey(bag: Bag) -> tuple[dict[str, Seen], list[str]]:
    """What of a bag can serve as which input, in the order in which the types are preferred; and
    notes on what is doubtful."""
    found: dict[str, Seen] = {}
    notes: list[str] = []

    def look(role: str, kinds: Collection[str], name: str = "") -> None:
        for kind in kinds:
            typed: dict[str, Any] = {role: kind}
            of_kind = [t for t, i in bag.topics.items() if i.type_name == _full_name(kind)]
            if kind.startswith("std_msgs"):  # arrays of numbers are of everything
                of_kind = [t for t in of_kind if "thrust" in t or "pwm" in t or "rc" in t]
            if not of_kind or not any(bag.topics[t].message_count for t in of_kind):
                continue
            called = name or sources(Inputs(**typed))[role].topic
            beside = found[ODOMETRY].topic if ODOMETRY in found else ""
            several = _candidates(bag, role, called, _full_name(kind), beside)
            several = [topic for topic in several if topic in of_kind] or of_kind
            topic = max(several, key=lambda t: bag.topics[t].message_count)
            if len(several) > 1:
                notes.append(
                    f"{role}: of {', '.join(several)} the one with most messages is taken, "
                    f"{topic}: correct topics.{role} if another is meant"
                )
            found[role] = _source_of(bag, topic, kind)
            return

    look(ODOMETRY, schema.ODOMETRY_TYPES)
    look(IMU, ("sensor_msgs/Imu",), ROLE_NAMES[IMU])
    look(WRENCH, _CHOICES[WRENCH])
    if ODOMETRY in found and found[ODOMETRY].type_name != schema.ODOMETRY_TYPES[0]:
        look(POSE, schema.POSE_TYPES, "pose")
    if WRENCH in found and found[WRENCH].type_name in schema.PULSE_TYPES:
        look(BATTERY, (schema.BATTERY_TYPE,))
    return found, notes


def _source_of(bag: Bag, topic: str, kind: str) -> Seen:
    times, first = [], None
    for raw in bag.iter_raw([topic]):
        times.append(raw.log_time)
        if first is None:
            with suppress(ValueError):
                first = cdr.DECODERS[_full_name(kind)](raw.data)
    span = max(times, default=0) - min(times, default=0)
    frames = getattr(first, "frame_id", ""), getattr(first, "child_frame_id", "")
    return Seen(topic, kind, 1e9 * (len(times) - 1) / span if span else 0.0, frames)


def first_frames(bag: Bag, chosen: Mapping[str, str], config: Config) -> dict[str, FrameIds]:
    """(frame_id, child_frame_id) of the first message of odometry and IMU, by role; ``chosen`` are
    the topics by role."""
    found: dict[str, FrameIds] = {}
    only = {role: topic for role, topic in chosen.items() if role in (ODOMETRY, POSE, IMU)}
    for role, message in messages(bag, only, config):
        found.setdefault(role, (message.frame_id, getattr(message, "child_frame_id", "")))
        if len(found) == len({ODOMETRY, IMU} & set(only)):
            break
    return found
