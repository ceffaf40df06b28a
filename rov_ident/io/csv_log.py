"""A plain log (CSV) into a bag of the topics `odom`, `thruster_wrench` and `joint_states`.

Nothing is resampled or filtered. What the log does not tell (an attitude, a position) is filled in
so that it agrees with the velocities, and said in the report.
"""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rov_ident.core import frames
from rov_ident.core.errors import UserError
from rov_ident.core.linalg import integral
from rov_ident.core.messages import (
    DRIVE,
    ODOMETRY,
    SECOND,
    WRENCH,
    Array,
    Joints,
    Message,
    Odometry,
    Wrench,
    fault,
)
from rov_ident.core.yaml_file import parse_file
from rov_ident.io.csv_table import read_csv
from rov_ident.io.write_messages import write_messages
from rov_ident.model.coefficients import AXES, VELOCITIES

_VELOCITIES, _WRENCH = tuple(VELOCITIES), tuple(AXES)
_POSITIONS = ("x", "y", "z")
_ANGLES = ("roll", "pitch", "yaw")
_LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
_DRIFTED = 0.7  # rad; up to there an angle and its sine differ by 8 % at most
_QUATERNION = ("qw", "qx", "qy", "qz")
_REQUIRED = ("t_s", *_VELOCITIES, *_WRENCH)
_FINS = ("delta_s", "delta_r", "delta_a")
_DRIVEN = (*_FINS, "rpm")
NAMES = (*_REQUIRED, *_POSITIONS, *_ANGLES, *_QUATERNION, *_DRIVEN)

_FRAME_IDS = {"frd": ("world_ned", "base_link_frd"), "flu": ("odom", "base_link")}
_LONGEST_STEP = 0.5  # s; as nothing is interpolated across more, rows further apart tell nothing
_IN_RADIANS = (*_VELOCITIES[3:], *_ANGLES, *_FINS)
_LARGEST_FIN = 1.6  # rad; no fin turns further than across the flow: beyond it are degrees
_CLEARLY = 0.5  # of the squares: degrees agree with the rates only where these explain the angle
_WRAP_JUMP = 1.0  # rad within one row, and back in the next: no vehicle does that

Prepare = Callable[
    [Mapping[str, Array], Mapping[str, Array]],
    tuple[dict[str, Array], NDArray[np.bool_], list[str]],
]
"""From columns (n,) by our names and by other headings: the first changed, which rows (n,) to keep,
and what was done, in words."""


@dataclass(frozen=True)
class ImportReport:
    """What became of a log."""

    rows: int
    odometry: int  # messages written
    masked: int  # rows without odometry: a rate above the limit
    wrapped: int  # rows without odometry: Euler angles averaged across their wrap
    duration: float  # s
    notes: tuple[str, ...]  # what was assumed, in words


def import_csv(
    paths: Sequence[str | Path], out: str | Path, columns: Mapping[str, str] | None = None,
    body_frame: str = "frd", mask_rates_above: float | None = None, wrench_timing: str = "held",
    prepare: Prepare | None = None, depths: Sequence[str] = (), degrees: Sequence[str] = (),
) -> ImportReport:  # fmt: skip
    """Writes the rows of one or several CSV files (in the order of time) as a bag.

    A message is stamped `t_s` + 1 s (no stamp is zero); a log that begins before zero is moved to
    begin at 1 s. A wrench message holds from its stamp until the next.

    Args:
        paths: files with the columns `NAMES`; the position, angles and quaternion may be absent;
            with fin angles (rad) or the propeller's `rpm` also the wrench. These become joints of
            the names `delta_s`, `delta_r`, `delta_a` and `n`.
        out: the bag, see `BagWriter`.
        columns: our name -> heading in the files; or a number, for what was not logged (`w=0`).
        body_frame: `frd` (the world is then NED) or `flu` (ENU).
        mask_rates_above: rad/s. Odometry with |p|, |q| or |r| above is left out: motion capture
            that flickers. The wrench of the row stays.
        wrench_timing: `held`: a row's velocity and pose are samples at its time, its wrench begins
            there. `mean`: the wrench is the mean over the time around the row; it changes midway
            between the rows. `bin`: the whole row is the mean from its time to that of the next
            row, so that the wrench begins at the row's time, and velocity and pose, which are
            means too, are stamped in the middle.
        prepare: what is done to the columns before (`sampling.preprocess.Preparation`).
        degrees: names of columns (rates, angles, fins) that hold degrees instead of radians.
        depths: further headings, of columns that `prepare` is given; their cells may be empty.

    Raises UserError: a file, column or cell that cannot be used, or a unit that cannot be right.
    """
    _check_options(body_frame, wrench_timing, mask_rates_above)
    log = _Log.read([Path(path) for path in paths], columns or {}, depths)
    log.check_time()
    log.take_degrees(degrees)
    log.check_angles()
    log.check_tilt()
    notes = log.prepare(prepare) if prepare else []
    if log.left_out:
        notes.insert(0, f"columns left out (--map names them): {', '.join(log.left_out)}")
    if given := [
        name for name in _WRENCH if log.headings[name] == "0" != (columns or {}).get(name)
    ]:
        notes.append(f"no {' '.join(given)} given: fins and propeller drive alone")

    time = log.data["t_s"]
    start = min(0.0, float(time[0]))
    if start < 0.0:
        notes.append(f"times begin at {start} s: moved to begin at 1 s")
    stamps = np.rint((time - start) * SECOND).astype(np.int64) + SECOND
    linear, angular = log.matrix(_VELOCITIES[:3]), log.matrix(_VELOCITIES[3:])
    orientation, wrapped = _attitude(log, angular, notes)
    position = _position(log, linear, orientation, notes)

    limit = np.inf if mask_rates_above is None else mask_rates_above
    masked = np.abs(angular).max(axis=1) > limit
    kept = ~(masked | wrapped)
    if wrapped.any():
        notes.append(
            f"{np.count_nonzero(wrapped)} rows have Euler angles averaged across their wrap: "
            "their odometry is left out"
        )
    if not kept.any():
        raise UserError(f"All rows have a rate above {mask_rates_above} rad/s: raise the limit.")

    wrench_stamps = stamps.copy()
    if wrench_timing == "mean":
        wrench_stamps[1:] = stamps[:-1] + np.diff(stamps) // 2
    elif wrench_timing == "bin":
        stamps = stamps + _bin_widths(stamps) // 2
    motion = position, orientation, linear, angular
    with np.errstate(all="ignore"):  # what is absurdly large is refused
        rows = _rows(log, stamps.tolist(), wrench_stamps.tolist(), motion, kept, body_frame)
        write_messages(out, _checked(log, rows))
    odometry, left_out, averaged = (int(np.count_nonzero(n)) for n in (kept, masked, wrapped))
    duration = float(time[-1] - time[0])
    return ImportReport(len(stamps), odometry, left_out, averaged, duration, tuple(notes))


def _check_options(body_frame: str, wrench_timing: str, mask_rates_above: float | None) -> None:
    """Raises UserError for one that :func:`import_csv` does not know."""
    if body_frame not in _FRAME_IDS:
        raise UserError(f"The body frame must be `frd` or `flu`, not `{body_frame}`.")
    if wrench_timing not in ("held", "mean", "bin"):
        raise UserError(
            f"The wrench timing must be `held`, `mean` or `bin`, not `{wrench_timing}`."
        )
    if mask_rates_above is not None and not mask_rates_above > 0.0:
        raise UserError(f"The limit of the rates must be positive, not {mask_rates_above}.")


def _rows(
    log: "_Log",
    stamps: Sequence[int],
    wrench_stamps: Sequence[int],
    motion: tuple[Array, Array, Array, Array],
    kept: NDArray[np.bool_],
    body_frame: str,
) -> Iterator[tuple[int, str, Message]]:
    """(row, role, message) of every row (n,); ``motion`` (position, orientation, linear and angular
    velocity, each (n, ...)) of those ``kept`` as odometry."""
    world, body = _FRAME_IDS[body_frame]
    force, torque, joints = log.matrix(_WRENCH[:3]), log.matrix(_WRENCH[3:]), log.joints()
    for k, (at, acts) in enumerate(zip(stamps, wrench_stamps, strict=True)):
        # The wrench first: at equal stamps it already acts on the velocity that follows.
        yield k, WRENCH, Wrench(acts, body, force[k], torque[k])
        if joints is not None:
            names, angle, turning = joints
            yield k, DRIVE, Joints(at, body, names, angle[k], turning[k])
        if kept[k]:
            position, orientation, linear, angular = (x[k] for x in motion)
            pose = position, orientation
            yield k, ODOMETRY, Odometry(at, world, body, *pose, linear, angular, np.zeros(6))


def _checked(
    log: "_Log", rows: Iterable[tuple[int, str, Message]]
) -> Iterator[tuple[int, str, Message]]:
    """(arrival [ns], role, message). Raises UserError for one that no vehicle can have."""
    for k, role, message in rows:
        if wrong := fault(message):
            raise UserError(f"{log.place(k)}: no vehicle has this {role}, {wrong}: correct it")
        yield message.stamp, role, message


def _bin_widths(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """The width (ns) of the bin that begins at each stamp: until the next, but for gaps."""
    steps = np.diff(stamps)
    usual = int(np.median(steps))
    return np.append(np.where(steps > 2 * usual, usual, steps), usual)


def parse_columns(items: Sequence[str]) -> dict[str, str]:
    """The columns of `--map`: each item is `name=heading`, or a YAML file of such pairs.

    Raises UserError: neither of the two.
    """
    columns: dict[str, str] = {}
    for item in items:
        name, equals, heading = item.partition("=")
        if equals:
            columns[name.strip()] = heading.strip()
            continue
        try:
            pairs = parse_file(Path(item))
        except UserError as error:
            raise UserError(
                f"{item} is neither name=heading nor a YAML file of such pairs: it {error}"
            ) from error
        if not isinstance(pairs, dict):
            raise UserError(f"{item} must hold pairs, as in `u: surge_speed`.")
        columns.update({str(key): str(value) for key, value in pairs.items()})
    return columns


def _attitude(log: "_Log", angular: Array, notes: list[str]) -> tuple[Array, NDArray[np.bool_]]:
    """Quaternions (n, 4), and which rows have none because their angles were averaged."""
    none = np.zeros(len(angular), dtype=bool)
    if all(name in log.data for name in _QUATERNION):
        quaternion = log.matrix(_QUATERNION)
        length = np.linalg.norm(quaternion, axis=1)
        if (bad := np.flatnonzero(np.abs(length - 1.0) > 0.1)).size:
            raise UserError(
                f"{log.place(bad[0])}: qw qx qy qz have length {length[bad[0]]:.3g}, "
                "but a quaternion has length 1: check their columns."
            )
        return frames.quaternion_normalise(quaternion), none

    t = log.data["t_s"]
    tilt: dict[str, Array] = {n: log.data[n] for n in ("roll", "pitch") if n in log.data}
    if missing := [name for name in ("roll", "pitch") if name not in tilt]:
        integrated = _tilt(t - t[0], angular)
        text = "integrated from the rates, level on average" if integrated else "taken as 0"
        notes.append(f"no {' and '.join(missing)} given: {text}")
        level = {name: np.zeros(len(t)) for name in missing}
        tilt = (integrated or level) | tilt
    roll, pitch = tilt["roll"], tilt["pitch"]
    if "yaw" in log.data:
        yaw = log.data["yaw"]
    else:
        rate = (angular[:, 1] * np.sin(roll) + angular[:, 2] * np.cos(roll)) / np.cos(pitch)
        yaw = integral(t, rate[:, None])[:, 0]
        notes.append("no yaw is given: it is integrated from the rates, from 0")
    quaternion = frames.quaternion_from_euler(roll, pitch, yaw)
    return quaternion, _jumps_back(quaternion)


def _tilt(t: Array, angular: Array) -> dict[str, Array]:
    """Roll and pitch (n,) [rad] from the angular velocities (n, 3) at the times t (n,) [s].

    Mean and drift of the tilt are taken away: weight keeps a vehicle level, and a gyro has a bias.
    Nothing where that has turned the vehicle too far for a line.
    """
    turns = frames.quaternion_from_rotation_vector(np.diff(integral(t, angular), axis=0))
    attitudes = np.array([*accumulate(turns, frames.quaternion_multiply, initial=_LEVEL)])
    down = frames.quaternion_to_matrix(attitudes)[:, :2, 2]  # north and east of the body's z
    north, east = (down - _off_the_line(t, down)).T
    if max(np.ptp(north), np.ptp(east)) > _DRIFTED:
        return {}
    back = frames.quaternion_from_rotation_vector(np.column_stack([east, -north, 0.0 * t]))
    euler = frames.quaternion_to_euler(frames.quaternion_multiply(back, attitudes))
    return {"roll": euler[:, 0], "pitch": euler[:, 1]}


def _off_the_line(t: Array, x: Array) -> Array:
    """Columns x (n, k) without their mean and drift over the times t (n,) [s]."""
    line = np.vander(t, 2)
    return x - line @ np.linalg.lstsq(line, x)[0]


def _jumps_back(quaternion: Array) -> NDArray[np.bool_]:
    """Rows whose attitude jumps away and back at once.

    A log that averages Euler angles over a bin turns +179 and -179 degrees into 0.
    """
    step = frames.quaternion_angle(quaternion[1:], quaternion[:-1])
    bridge = frames.quaternion_angle(quaternion[2:], quaternion[:-2])
    jump = np.minimum(step[1:], step[:-1])
    wrapped = np.zeros(len(quaternion), dtype=bool)
    wrapped[1:-1] = (jump > _WRAP_JUMP) & (bridge < 0.5 * jump)
    return wrapped


def _position(log: "_Log", linear: Array, orientation: Array, notes: list[str]) -> Array:
    """Positions (n, 3); a component not given is dead-reckoned, to agree with the velocity."""
    velocity = np.einsum("nij,nj->ni", frames.quaternion_to_matrix(orientation), linear)
    if missing := [name for name in _POSITIONS if name not in log.data]:
        notes.append(
            f"no {' '.join(missing)} given: dead-reckoned from the velocities, so that comparing "
            "pose with velocity tells nothing"
        )
    dead_reckoned = dict(zip(_POSITIONS, integral(log.data["t_s"], velocity).T, strict=True))
    return np.column_stack([log.data.get(name, dead_reckoned[name]) for name in _POSITIONS])


@dataclass
class _Log:
    """The columns in our names, and where each row stands."""

    data: dict[str, Array]  # name: (n,)
    headings: dict[str, str]  # name: heading in the file
    places: list[tuple[Path, int]]  # of each row: file, line
    more: dict[str, Array]  # further columns by heading: (n,), NaN where empty
    left_out: tuple[str, ...]  # headings of which nothing is made

    @classmethod
    def read(
        cls, paths: Sequence[Path], columns: Mapping[str, str], more: Sequence[str] = ()
    ) -> "_Log":
        if unknown := [name for name in columns if name not in NAMES]:
            raise UserError(f"`{unknown[0]}` cannot be mapped: use one of {' '.join(NAMES)}.")
        tables: list[dict[str, Array]] = []
        places: list[tuple[Path, int]] = []
        headings: dict[str, str] = {}
        left_out: dict[str, None] = {}
        for path in paths:
            table = read_csv(path)
            found = _headings(path, table.cells, columns)
            if tables and found.keys() != headings.keys():
                raise UserError(f"{path} has other columns than {paths[0]}: import them apart.")
            headings = found
            used = {*found.values(), *more}
            left_out |= dict.fromkeys(name for name in table.cells if name not in used)
            if missing := [name for name in more if name not in table.cells]:
                raise UserError(
                    f"{path} has no column `{missing[0]}`: it has {', '.join(table.cells)}."
                )
            tables.append(
                {
                    name: table.numbers(heading)
                    if heading in table.cells
                    else np.full(len(table.lines), float(heading))
                    for name, heading in found.items()
                }
                | {name: table.numbers(name, blank=True) for name in more}
            )
            places += [(path, line) for line in table.lines]
        if len(places) < 3:
            files = " ".join(map(str, paths))
            raise UserError(f"{files}: {len(places)} rows are too few for a log.")
        data = {name: np.concatenate([part[name] for part in tables]) for name in tables[0]}
        further = {name: data.pop(name) for name in more}
        return cls(data, headings, places, further, tuple(left_out))

    def prepare(self, how: Prepare) -> list[str]:
        """Change the columns, leave rows out; what was done, in words."""
        data, kept, notes = how(self.data, self.more)
        self.data = {name: column[kept] for name, column in data.items()}
        self.places = [place for place, keep in zip(self.places, kept, strict=True) if keep]
        return notes

    def matrix(self, names: Sequence[str]) -> Array:
        """Columns side by side, (n, len(names))."""
        return np.column_stack([self.data[name] for name in names])

    def joints(self) -> tuple[tuple[str, ...], Array, Array] | None:
        """Names (k,), positions (n, k) and velocities (n, k) of fins and shaft, if any is given."""
        names = tuple(name for name in _DRIVEN if name in self.data)
        if not names:
            return None
        velocity = np.array([name == "rpm" for name in names])
        x = self.matrix(names)
        x[:, velocity] *= 2.0 * np.pi / 60.0
        shown = tuple("n" if name == "rpm" else name for name in names)
        return shown, np.where(velocity, 0.0, x), np.where(velocity, x, 0.0)

    def place(self, row: int) -> str:
        path, line = self.places[row]
        return f"{path}, line {line}"

    def check_time(self) -> None:
        time, heading = self.data["t_s"], self.headings["t_s"]
        steps = np.diff(time)
        if (bad := np.flatnonzero(steps <= 0.0)).size:
            row = int(bad[0]) + 1
            if steps[bad[0]] == 0.0:
                raise UserError(
                    f"{self.place(row)}: {heading} is {time[row]:.12g} as in the row before, but "
                    "time must increase: remove rows that are there twice, or write stamps with "
                    "more digits."
                )
            raise UserError(
                f"{self.place(row)}: {heading} goes from {time[row - 1]:g} to {time[row]:g}, but "
                "time must increase: sort the rows, or import files of separate dives apart."
            )
        if np.median(steps) > _LONGEST_STEP or time[-1] - min(0.0, time[0]) > 2**31 - 2:
            raise UserError(
                f"{self.place(0)}: {heading} has steps of {np.median(steps):g} and ends at "
                f"{time[-1]:g}; it must be in seconds, with steps of {_LONGEST_STEP} at most."
            )

    def take_degrees(self, names: Sequence[str]) -> None:
        """Convert columns that hold degrees. Raises UserError for one that is no angle or rate."""
        for name in dict.fromkeys(names):
            if name not in self.data or name not in _IN_RADIANS:
                raise UserError(f"--degrees {name}: the log has no such column of angles or rates")
            self.data[name] = np.radians(self.data[name])

    def check_angles(self) -> None:
        """Refuses degrees. A yaw may count its turns; then it grows no faster than the rates, of
        which a few may be wild."""
        for name in _VELOCITIES[3:]:
            if (fast := float(np.quantile(np.abs(self.data[name]), 0.9))) > 2.0 * np.pi:
                raise UserError(
                    f"{self.headings[name]} exceeds {fast:.3g} rad/s in a tenth of the rows, more "
                    "than a turn a second: convert it from degrees, or name it in --degrees."
                )
        for name in (*_FINS, *_ANGLES):
            angle = self.data.get(name, np.zeros(1))
            most = _LARGEST_FIN if name in _FINS else 2.0 * np.pi
            large = np.flatnonzero(np.abs(angle) > most)
            if not large.size:
                continue
            turned = np.linalg.norm(self.matrix(_VELOCITIES[3:]), axis=1)
            path_of_rates = integral(self.data["t_s"], turned[:, None])[-1, 0]
            if name != "yaw" or np.abs(np.diff(angle)).sum() > 10.0 * path_of_rates:
                raise UserError(
                    f"{self.place(large[0])}: {self.headings[name]} is {angle[large[0]]:g}, which "
                    "looks like degrees: convert it to rad, or name it in --degrees."
                )

    def check_tilt(self) -> None:
        """Refuses roll and pitch that are too small to look like degrees, but agree with the rates
        only as such."""
        t = self.data["t_s"] - self.data["t_s"][0]
        tilt = [name for name in ("roll", "pitch") if name in self.data]
        with np.errstate(all="ignore"):  # what is absurdly large is refused later
            turned = _tilt(t, self.matrix(_VELOCITIES[3:])) if tilt else {}
        for name in tilt if turned else ():
            given, rates = _off_the_line(t, np.column_stack([self.data[name], turned[name]])).T
            radians, degrees = (np.sum((given - x) ** 2) for x in (rates, np.degrees(rates)))
            if degrees < _CLEARLY * radians:
                raise UserError(
                    f"{self.place(0)}: {self.headings[name]} changes as the rates do in degrees: "
                    "convert it to rad, or name it in --degrees."
                )


def _headings(path: Path, header: Collection[str], columns: Mapping[str, str]) -> dict[str, str]:
    """The heading of each of our names that the file (or a constant) provides."""
    headings = {}
    is_driven = any(columns.get(name, name) in header for name in _DRIVEN)
    for name in NAMES:
        heading = columns.get(name, name)
        if is_driven and name in _WRENCH and heading == name and name not in header:
            heading = "0"
        if heading in header or _constant(heading):
            headings[name] = heading
        elif name in columns or name in _REQUIRED:
            raise UserError(
                f"{path} has no column `{heading}`: it has {', '.join(header) or 'none'}; name "
                f"the right one with --map {name}=HEADING (or a number, if it was not logged)."
            )
    return headings


def _constant(heading: str) -> bool:
    """Whether a heading stands for a number instead of a column."""
    try:
        return math.isfinite(float(heading))
    except ValueError:
        return False
