"""The first configuration of a vehicle, from what a bag, a log or a URDF tells of it."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rov_ident import config as configuration
from rov_ident.api.reading import File, existing
from rov_ident.config.writing import annotated
from rov_ident.consumer.formats import holds_hydrodynamics, import_model, is_urdf
from rov_ident.core.errors import UserError
from rov_ident.core.files import VEHICLES, shipped, write_file
from rov_ident.core.frames import FLIP_BODY
from rov_ident.core.messages import IMU, ODOMETRY, WRENCH
from rov_ident.core.progress import Progress
from rov_ident.core.yaml_file import parse_file
from rov_ident.io import topics
from rov_ident.io.ardupilot_log import FRAMES, SUFFIXES, read_log
from rov_ident.io.bag_reader import Bag
from rov_ident.io.mounting import TURNED, sensor_placement, turned

_MODELS = (".urdf", ".xml", ".sdf")
_OF_FRAME = {1: "bluerov2", 2: "bluerov2_heavy"}  # FRAME_CONFIG of ArduSub
_HEAD = """Written by `rov-ident init`. Options at their defaults are commented out.
Lines with UNKNOWN need a value; "from" says where a value comes from; check what is ASSUMED.
Then: rov-ident check DIVE --config THIS_FILE"""


# of a mass that nobody has weighed: what is built onto a vehicle, and ballast, are a tenth of it
_BORROWED = 0.1


@dataclass(frozen=True)
class Draft:
    """A commented parameter file: ``text``; ``notes`` on what it is from and what is still open."""

    text: str
    unknown: tuple[str, ...]
    notes: tuple[str, ...] = ()
    unfit: str = ""  # the record to which nothing can be fitted

    @property
    def sentence(self) -> str:
        """What is left to do."""
        if self.unknown:
            return f"To be given before it can be used: {', '.join(self.unknown)}."
        other = f", with other records than {self.unfit}" if self.unfit else " as it is"
        return f"It can be used{other}; check what is marked ASSUMED."

    def save(self, path: File) -> None:
        """Write the file. Raises UserError if it cannot be written."""
        write_file(path, self.text)


@dataclass
class _Found:
    """Nested parameters and, by dotted name, where each is from."""

    parameters: dict[str, Any] = field(default_factory=dict)
    remarks: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    unfit: str = ""

    def put(self, key: str, value: Any, source: str) -> None:
        section = self.parameters
        *above, name = key.split(".")
        for part in above:
            section = section.setdefault(part, {})
        section[name] = value
        self.remarks[key] = source

    def start_from(self, vehicle: str) -> None:
        """A shipped vehicle's own file."""
        document = parse_file(shipped(f"config/{vehicle}.yaml"))
        self.parameters, self.remarks = document["/**"]["ros__parameters"], {}
        assumed = f"{vehicle}.yaml: ASSUMED"
        for name in ("mass", "buoyancy", "cog", "cob", "inertia"):
            self.remarks[f"vehicle.{name}"] = assumed
        for name in self.parameters["coefficients"]:
            self.remarks[f"coefficients.{name}"] = assumed
        for name in ("mass_std", "inertia_std"):
            self.put(f"vehicle.{name}", _BORROWED, "a guess: remove it once it is weighed")
        self.notes.append(
            f"Mass and buoyancy are those of {vehicle}.yaml. Weigh yours: thrust, mass and all "
            "coefficients k times as large move alike, so all are wrong by as much as the mass"
        )


def init(
    record: File | None = None, vehicle: str = "", *, progress: Progress | None = None
) -> Draft:
    """Draft the configuration of a vehicle.

    Parameters
    ----------
    record
        Path of a bag (gives topics, frames, rates, mounting from ``/tf_static``), a log of ArduSub
        or PX4 (thrusters and their directions, battery), or a URDF or SDFormat model.
    vehicle
        Name of a shipped vehicle to start from: one of `VEHICLES`.
    progress
        As in :func:`rov_ident.read`.

    Returns
    -------
    Draft
        ``text``, the commented parameter file; ``save(path)`` writes it.

    Raises
    ------
    UserError
        If there is no such vehicle, or the record cannot be read.
    """
    if vehicle and vehicle not in VEHICLES:
        raise UserError(f"there is no vehicle {vehicle!r}: use one of {', '.join(VEHICLES)}")
    found = _Found()
    if vehicle:
        found.start_from(vehicle)
    else:
        found.put("vehicle.frame", "frd", "the convention of this package")
    if record is not None:
        path = existing(record)
        if progress:
            progress(f"reading {path.name}")
        if path.suffix.lower() in SUFFIXES:
            _add_log(path, found, vehicle)
        elif path.suffix.lower() in _MODELS:
            _add_model(path, found, vehicle)
        else:
            _add_bag(path, found)
    text = annotated(found.parameters, found.remarks, _HEAD)
    unknown = tuple(re.findall(r"^ *(\w+): *# UNKNOWN", text, re.MULTILINE))
    if not unknown:  # what is drafted can be read
        configuration.from_parameters(found.parameters)
    return Draft(text, unknown, tuple(found.notes), found.unfit)


def _add_model(path: Path, found: _Found, vehicle: str) -> None:
    urdf = is_urdf(path)
    if vehicle and not urdf:
        raise UserError(
            f"{path} is a whole vehicle, to which vehicle (--vehicle) adds nothing: leave it out"
        )
    whole = not vehicle and (not urdf or holds_hydrodynamics(path))
    base = None if whole else configuration.load(shipped(f"config/{vehicle or VEHICLES[0]}.yaml"))
    config, notes = import_model(path, base)
    found.parameters = configuration.to_parameters(config)
    found.remarks = dict.fromkeys(("vehicle.mass", "vehicle.inertia", "vehicle.cog"), path.name)
    if base is None or vehicle:
        found.notes += notes
        if not any(c.is_added_mass for c in config.model.coefficients):
            found.notes.append(
                f"{path.name} has no added mass (0 counts as none), so none will be estimated: add "
                "X_udot, Y_vdot, Z_wdot, K_pdot, M_qdot and N_rdot to the coefficients"
            )
    else:  # a URDF holds no hydrodynamics
        assumed, read = configuration.to_parameters(base), found.parameters
        found.parameters = {k: v for k, v in read.items() if v != assumed.get(k)}
        body = {key: read["vehicle"][key] for key in ("frame", "mass", "inertia", "cog")}
        found.parameters |= {"vehicle": {"name": path.stem, **body}, "coefficients": {}}


def _add_log(path: Path, found: _Found, vehicle: str) -> None:
    log = read_log(path)
    found.notes += log.notes
    frame = int(log.parameters.get("FRAME_CONFIG", -1))
    if not vehicle and frame in _OF_FRAME:
        found.start_from(_OF_FRAME[frame])
        found.notes.append(f"FRAME_CONFIG is {frame} ({FRAMES[frame][0]}): starts from its file")
    elif frame >= 0 and frame not in FRAMES:
        found.notes.append(f"FRAME_CONFIG is {frame}, which is not known here: give thrusters")
    positions = found.parameters.get("thrusters", {}).get("position", [])
    if motors := log.motors:
        n = len(motors["direction"])
        if "position" not in motors and len(positions) != n:
            found.notes.append(
                f"the log has {n // 3} thrusters, but not where they are: give thrusters.position"
            )
        for key, value in motors.items():
            found.put(f"thrusters.{key}", value, f"{path.name}, as the autopilot has it")
    if volts := log.battery:
        found.put("thrusters.voltage", round(float(np.median(volts)), 2), f"{path.name}, median")
    lacks = [
        name
        for name, track in (
            ("velocity (a DVL or another aid of the EKF)", log.motion),
            ("attitude", log.attitude or log.angles),
            ("angular rates", log.imu or log.rates),
            ("thruster outputs", log.outputs),
        )
        if len(track) < 2
    ]
    if lacks:
        found.notes.append(f"{path.name} has no {', no '.join(lacks)}: nothing can be fitted to it")
        found.unfit = path.name
        return
    armed = [log.is_armed(t) for t in log.outputs.t]
    if armed and len(log.armed):
        found.notes.append(f"armed in {100 * np.mean(armed):.0f} % of {path.name}")
    found.notes.append(f"next: rov-ident import {path.name} --config THIS_FILE --out dive.mcap")


def _add_bag(path: Path, found: _Found) -> None:
    bag = Bag(path)
    seen, notes = topics.survey(bag)
    for role, source in seen.items():
        frame = f", frame {source.frames[0]}" if source.frames[0] else ""
        if role != IMU and f"inputs.{role}" in configuration.schema.BY_KEY:
            found.put(f"inputs.{role}", source.type_name, path.name)
        told = f"{source.rate:.3g} Hz in {path.name}{frame}"
        found.put(f"topics.{role}", source.topic, told)
    for role in (ODOMETRY, WRENCH):
        if role not in seen:
            found.notes.append(
                f"{path.name} has nothing that can be {role}: record it too (docs/inputs.md)"
            )
            found.unfit = path.name
    if IMU not in seen:
        found.notes.append(f"{path.name} has no IMU: angular rates come from the odometry alone")
    found.notes += notes
    signs = FLIP_BODY if found.parameters["vehicle"].get("frame") == "flu" else np.ones(3)
    mounted = sensor_placement(bag, {role: source.frames for role, source in seen.items()})
    for key, vector in mounted.items():
        if key == TURNED:
            found.notes += turned(vector, path.name)
            continue
        found.put(key, [round(float(x), 6) + 0.0 for x in signs * vector], "/tf_static")
    if "/tf_static" in bag.topics and not mounted:
        found.notes.append("/tf_static does not say where IMU and velocity sensor are")
