"""A plain log (CSV) into a bag of the topics `odom` and `thruster_wrench`.

Nothing is resampled or filtered. What the log does not tell (an attitude, a position) is filled in
so that it agrees with the velocities, and said in the report.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from rov_ident import cdr, frames
from rov_ident.bags import BagWriter
from rov_ident.errors import UserError
from rov_ident.messages import Array, Odometry, Wrench

_VELOCITIES = ("u", "v", "w", "p", "q", "r")
_WRENCH = ("X", "Y", "Z", "K", "M", "N")
_POSITIONS = ("x", "y", "z")
_ANGLES = ("roll", "pitch", "yaw")
_QUATERNION = ("qw", "qx", "qy", "qz")
_REQUIRED = ("t_s", *_VELOCITIES, *_WRENCH)
NAMES = (*_REQUIRED, *_POSITIONS, *_ANGLES, *_QUATERNION)

_FRAME_IDS = {"frd": ("world_ned", "base_link_frd"), "flu": ("odom", "base_link")}
_SECOND = 1_000_000_000  # ns
_LONGEST_STEP = 10.0  # s; a median step beyond it is no log of a dive but another unit
_WRAP_JUMP = 1.0  # rad within one row, and back in the next: no vehicle does that


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
    paths: Sequence[str | Path],
    out: str | Path,
    columns: Mapping[str, str] | None = None,
    body_frame: str = "frd",
    mask_rates_above: float | None = None,
    wrench_timing: str = "held",
) -> ImportReport:
    """Writes the rows of one or several CSV files (in the order of time) as a bag.

    A message is stamped `t_s` + 1 s (no stamp is zero); a log that begins before zero is moved to
    begin at 1 s. A wrench message holds from its stamp until the next.

    Args:
        paths: files with the columns `NAMES`; the position, angles and quaternion may be absent.
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

    Raises:
        UserError: a file, column or cell that cannot be used, or a unit that cannot be right.
    """
    if body_frame not in _FRAME_IDS:
        raise UserError(f"The body frame must be `frd` or `flu`, not `{body_frame}`.")
    if wrench_timing not in ("held", "mean", "bin"):
        raise UserError(
            f"The wrench timing must be `held`, `mean` or `bin`, not `{wrench_timing}`."
        )
    if mask_rates_above is not None and not mask_rates_above > 0.0:
        raise UserError(f"The limit of the rates must be positive, not {mask_rates_above}.")
    log = _Log.read([Path(path) for path in paths], columns or {})
    log.check_time()
    log.check_angles()

    time = log.data["t_s"]
    start = min(0.0, float(time[0]))
    notes = []
    if start < 0.0:
        notes.append(f"times begin at {start} s: moved to begin at 1 s")
    stamps = np.rint((time - start) * _SECOND).astype(np.int64) + _SECOND
    linear = log.matrix(_VELOCITIES[:3])
    angular = log.matrix(_VELOCITIES[3:])
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
    world, body = _FRAME_IDS[body_frame]
    force = log.matrix(_WRENCH[:3])
    torque = log.matrix(_WRENCH[3:])
    not_given = np.zeros(6)
    with BagWriter(out) as writer:
        for k in range(len(stamps)):
            # The wrench first: at equal stamps it already acts on the velocity that follows.
            stamp = int(wrench_stamps[k])
            wrench = Wrench(stamp, body, force[k], torque[k])
            writer.write("/thruster_wrench", cdr.WRENCH_TYPE, stamp, cdr.encode(wrench))
            if kept[k]:
                stamp = int(stamps[k])
                odometry = Odometry(
                    stamp,
                    world,
                    body,
                    position[k],
                    orientation[k],
                    linear[k],
                    angular[k],
                    not_given,
                )
                writer.write("/odom", cdr.ODOMETRY_TYPE, stamp, cdr.encode(odometry))
    return ImportReport(
        rows=len(stamps),
        odometry=int(np.count_nonzero(kept)),
        masked=int(np.count_nonzero(masked)),
        wrapped=int(np.count_nonzero(wrapped)),
        duration=float(time[-1] - time[0]),
        notes=tuple(notes),
    )


def _bin_widths(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """The width (ns) of the bin that begins at each stamp: until the next, but for gaps."""
    steps = np.diff(stamps)
    usual = int(np.median(steps))
    return np.append(np.where(steps > 2 * usual, usual, steps), usual)


def parse_columns(items: Sequence[str]) -> dict[str, str]:
    """The columns of `--map`: each item is `name=heading`, or a YAML file of such pairs.

    Raises:
        UserError: neither of the two.
    """
    columns: dict[str, str] = {}
    for item in items:
        name, equals, heading = item.partition("=")
        if equals:
            columns[name.strip()] = heading.strip()
            continue
        try:
            pairs = yaml.safe_load(Path(item).read_text("utf-8"))
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise UserError(
                f"{item} is neither name=heading nor a YAML file of such pairs."
            ) from error
        if not isinstance(pairs, dict):
            raise UserError(f"{item} must hold pairs, as in `u: surge_speed`.")
        columns.update({str(key): str(value) for key, value in pairs.items()})
    return columns


def _attitude(log: "_Log", angular: Array, notes: list[str]) -> tuple[Array, NDArray[np.bool_]]:
    """Quaternions (n, 4), and which rows have none because their angles were averaged."""
    none = np.zeros(len(angular), dtype=bool)
    if log.has(_QUATERNION):
        quaternion = log.matrix(_QUATERNION)
        length = np.linalg.norm(quaternion, axis=1)
        if (bad := np.flatnonzero(np.abs(length - 1.0) > 0.1)).size:
            raise UserError(
                f"{log.place(bad[0])}: qw qx qy qz have length {length[bad[0]]:.3g}, "
                "but a quaternion has length 1: check their columns."
            )
        return frames.quaternion_normalise(quaternion), none

    roll, pitch = (log.data.get(name, np.zeros(len(angular))) for name in ("roll", "pitch"))
    if "yaw" in log.data:
        yaw = log.data["yaw"]
    else:
        rate = (angular[:, 1] * np.sin(roll) + angular[:, 2] * np.cos(roll)) / np.cos(pitch)
        yaw = _integrated(log.data["t_s"], rate)
        notes.append("no yaw is given: it is integrated from the rates, from 0")
    if missing := [name for name in ("roll", "pitch") if name not in log.data]:
        notes.append(f"no {' and '.join(missing)} given: taken as 0")
    quaternion = frames.quaternion_from_euler(roll, pitch, yaw)
    return quaternion, _wrapped(quaternion)


def _wrapped(quaternion: Array) -> NDArray[np.bool_]:
    """Rows whose attitude jumps away and back at once.

    A log that averages Euler angles over a bin turns +179 and -179 degrees into 0.
    """
    step = _angle_between(quaternion[1:], quaternion[:-1])
    bridge = _angle_between(quaternion[2:], quaternion[:-2])
    jump = np.minimum(step[1:], step[:-1])
    wrapped = np.zeros(len(quaternion), dtype=bool)
    wrapped[1:-1] = (jump > _WRAP_JUMP) & (bridge < 0.5 * jump)
    return wrapped


def _angle_between(p: Array, q: Array) -> Array:
    return 2.0 * np.arccos(np.minimum(np.abs(np.sum(p * q, axis=-1)), 1.0))


def _position(log: "_Log", linear: Array, orientation: Array, notes: list[str]) -> Array:
    """Positions (n, 3); a component not given is dead-reckoned, to agree with the velocity."""
    velocity = np.einsum("nij,nj->ni", frames.quaternion_to_matrix(orientation), linear)
    if missing := [name for name in _POSITIONS if name not in log.data]:
        notes.append(
            f"no {' '.join(missing)} given: dead-reckoned from the velocities, so that comparing "
            "pose with velocity tells nothing"
        )
    return np.column_stack(
        [
            log.data[name] if name in log.data else _integrated(log.data["t_s"], velocity[:, k])
            for k, name in enumerate(_POSITIONS)
        ]
    )


def _integrated(time: Array, rate: Array) -> Array:
    """The integral of a sampled rate by the trapezoidal rule, from 0."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])


@dataclass
class _Log:
    """The columns in our names, and where each row stands."""

    data: dict[str, Array]  # name: (n,)
    headings: dict[str, str]  # name: heading in the file
    places: list[tuple[Path, int]]  # of each row: file, line

    @classmethod
    def read(cls, paths: Sequence[Path], columns: Mapping[str, str]) -> "_Log":
        if unknown := [name for name in columns if name not in NAMES]:
            raise UserError(f"`{unknown[0]}` cannot be mapped: use one of {' '.join(NAMES)}.")
        rows: list[list[float]] = []
        places: list[tuple[Path, int]] = []
        headings: dict[str, str] | None = None
        for path in paths:
            lines = _lines(path)
            _, header = next(lines, (0, []))
            found = _headings(path, header, columns)
            if headings is not None and found.keys() != headings.keys():
                raise UserError(f"{path} has other columns than {paths[0]}: import them apart.")
            headings = found
            numbers = [None if _constant(h, header) else header.index(h) for h in found.values()]
            for line, cells in lines:
                if len(cells) != len(header):
                    raise UserError(
                        f"{path}, line {line}: {len(cells)} cells under {len(header)} headings."
                    )
                rows.append(
                    [
                        _number(heading if at is None else cells[at], path, line, heading)
                        for heading, at in zip(found.values(), numbers, strict=True)
                    ]
                )
                places.append((path, line))
        if headings is None or len(rows) < 3:
            raise UserError(f"{' '.join(map(str, paths))}: {len(rows)} rows are too few for a log.")
        table = np.array(rows)
        return cls({name: table[:, k] for k, name in enumerate(headings)}, headings, places)

    def has(self, names: Sequence[str]) -> bool:
        return all(name in self.data for name in names)

    def matrix(self, names: Sequence[str]) -> Array:
        """Columns side by side, (n, len(names))."""
        return np.column_stack([self.data[name] for name in names])

    def place(self, row: int) -> str:
        path, line = self.places[row]
        return f"{path}, line {line}"

    def check_time(self) -> None:
        time, heading = self.data["t_s"], self.headings["t_s"]
        steps = np.diff(time)
        if (bad := np.flatnonzero(steps <= 0.0)).size:
            row = int(bad[0]) + 1
            raise UserError(
                f"{self.place(row)}: {heading} goes from {time[row - 1]:g} to {time[row]:g}, but "
                "time must increase: sort the rows, or import files of separate dives apart."
            )
        if np.median(steps) > _LONGEST_STEP or time[-1] - min(0.0, time[0]) > 2**31 - 2:
            raise UserError(
                f"{self.place(0)}: {heading} has steps of {np.median(steps):g} and ends at "
                f"{time[-1]:g}; it must be in seconds."
            )

    def check_angles(self) -> None:
        """Refuses degrees. A yaw may count its turns; then it grows no faster than the rates."""
        for name in _ANGLES:
            if name not in self.data:
                continue
            angle = self.data[name]
            large = np.flatnonzero(np.abs(angle) > 2.0 * np.pi)
            if not large.size:
                continue
            turned = np.linalg.norm(self.matrix(_VELOCITIES[3:]), axis=1)
            path_of_rates = _integrated(self.data["t_s"], turned)[-1]
            if name != "yaw" or np.abs(np.diff(angle)).sum() > 10.0 * path_of_rates:
                raise UserError(
                    f"{self.place(large[0])}: {self.headings[name]} is {angle[large[0]]:g}, which "
                    "looks like degrees: convert it to rad."
                )


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """(line number, cells) of a CSV file without comments and empty lines; the header first."""
    try:
        # utf-8-sig: spreadsheets begin their files with a byte order mark.
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream, skipinitialspace=True)
            for cells in reader:
                if any(cells) and not cells[0].startswith("#"):
                    yield reader.line_num, [cell.strip() for cell in cells]
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): check the path.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} is not a CSV text file: {error}.") from error


def _headings(path: Path, header: Sequence[str], columns: Mapping[str, str]) -> dict[str, str]:
    """The heading of each of our names that the file (or a constant) provides."""
    headings = {}
    for name in NAMES:
        heading = columns.get(name, name)
        if heading in header or _constant(heading, header):
            headings[name] = heading
        elif name in columns or name in _REQUIRED:
            raise UserError(
                f"{path} has no column `{heading}`: it has {', '.join(header) or 'none'}; name "
                f"the right one with --map {name}=HEADING (or a number, if it was not logged)."
            )
    return headings


def _constant(heading: str, header: Sequence[str]) -> bool:
    """Whether a heading stands for a number instead of a column."""
    if heading in header:
        return False
    try:
        float(heading)
    except ValueError:
        return False
    return True


def _number(text: str, path: Path, line: int, heading: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise UserError(
            f"{path}, line {line}, column `{heading}`: `{text}` is not a number; correct or "
            "remove the row."
        )
    return value
