"""Records of steering: heading and rudder over time, from a CSV file or a bag."""

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.frames import quaternion_to_euler, to_core
from rov_ident.core.messages import ODOMETRY, WRENCH, Array, Odometry, Wrench
from rov_ident.io.bag_reader import SUFFIXES, Bag
from rov_ident.io.csv_table import CsvTable, read_csv
from rov_ident.io.topics import POSE, USUAL, doubts, messages, rudder_commands, rudder_topic, select

FEWEST = 20  # headings of a run: three for each of six parameters, and the first state
GAP = 3.0  # s without a sample, after which the motion before is unknown
_GAP_ROWS = 3.0  # of the usual distance: rows of a ship may be further apart than that
_STEEPEST = np.radians(100.0)  # a rudder beyond it is no angle in radians
_TURNED = 2.5 * np.pi  # a heading beyond it counts turns, or is in degrees
_FAINT = 1.0  # deg; a zigzag whose angles all stay below it is one in radians
_RARE, _LONG = 5.0, 6 * 3600.0  # s between rows, s in all: zigzags take half an hour at most (ITTC
# 7.5-04-02-01), but half a minute at 200 Hz has such numbers in milliseconds


@dataclass(frozen=True)
class Zigzag:
    """A run: t (n,) [s] increasing, heading (n,) [rad] unwrapped, NaN where not known, rudder (n,)
    [rad]; ``unit`` is that of the rudder (`rad`, or `N m` for a yaw moment in its stead).
    ``held``: the rudder is known to stay as it is from one row to the next. ``notes`` say in words
    what was assumed of the file, or is missing from it."""

    name: str
    t: Array
    heading: Array
    rudder: Array
    unit: str = "rad"
    held: bool = False
    sha256: str = ""
    notes: tuple[str, ...] = ()

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which rows have a heading."""
        return np.isfinite(self.heading)

    @property
    def step(self) -> float:
        """Median time between two headings [s]."""
        return float(np.median(np.diff(self.t[self.known])))

    @property
    def parts(self) -> list[slice]:
        """The rows between pauses, in which nobody knows what the rudder did: those with enough
        headings, which move on from a first state of their own.

        Raises UserError if there is none.
        """
        apart = np.diff(self.t)
        pauses = np.flatnonzero(apart > max(GAP, _GAP_ROWS * float(np.median(apart)))) + 1
        if not len(pauses):
            return [slice(0, len(self.t))]
        ends = [0, *pauses.tolist(), len(self.t)]
        found = [
            slice(*rows) for rows in pairwise(ends) if self.known[slice(*rows)].sum() >= FEWEST
        ]
        if not found:
            raise UserError(
                f"{self.name} pauses so often that no {FEWEST} headings follow on each other: "
                "record it without pauses"
            )
        return found

    def __getitem__(self, rows: slice | NDArray[np.bool_]) -> "Zigzag":
        """These rows as a run."""
        t, heading, rudder = self.t[rows], self.heading[rows], self.rudder[rows]
        return replace(self, t=t, heading=heading, rudder=rudder)

    @property
    def reversals(self) -> NDArray[np.intp]:
        """Rows after which a rudder that otherwise stands still has jumped: the two steps beside
        are level. When it jumped within the step is not in the record."""
        level = np.abs(np.diff(self.rudder)) < 1e-3 * np.ptp(self.rudder)
        jumps = np.flatnonzero(~level)
        inside = jumps[(jumps > 0) & (jumps < len(level) - 1)]
        return inside[level[inside - 1] & level[inside + 1]]

    def cornered(self) -> "Zigzag":
        """The run with rows added where the rudder begins and ends to move.

        A servo goes from one level to another at its own rate. Straight lines between samples cut
        the corners, as if the rudder turned earlier and less; at that rate, known from within the
        longer movements, the lines through the first and last moving sample meet the levels at the
        corners. Added rows have no heading; movements not at one rate are left as they are.
        """
        if self.held or len(self.t) < 4:
            return self
        slope = np.diff(self.rudder) / np.diff(self.t)
        level = np.abs(np.diff(self.rudder)) < 1e-3 * np.ptp(self.rudder)
        inner = ~level[1:-1] & ~level[:-2] & ~level[2:]
        if not inner.any():
            return self
        usual = float(np.median(np.abs(slope[1:-1][inner])))
        begin = np.flatnonzero(level[:-1] & ~level[1:]) + 1  # row where it still stands
        added: list[tuple[float, float]] = []
        for i in begin:
            still = np.flatnonzero(level[i:])
            if not len(still) or still[0] < 2:
                continue
            j = i + still[0]  # row where it stands again
            own = np.abs(slope[i + 1 : j - 1])
            rate = float(np.median(own)) if len(own) else usual
            if len(own) and np.ptp(own) > 0.1 * rate:
                continue  # no movement at one rate
            first = self.t[i + 1] - abs(self.rudder[i + 1] - self.rudder[i]) / rate
            last = self.t[j - 1] + abs(self.rudder[j] - self.rudder[j - 1]) / rate
            if self.t[i] < first < self.t[i + 1]:
                added.append((first, self.rudder[i]))
            if self.t[j - 1] < last < self.t[j]:
                added.append((last, self.rudder[j]))
        if not added:
            return self
        t, rudder = np.array(added).T
        apart = np.abs(t[:, None] - self.t).min(axis=1) > 1e-6 * np.diff(self.t).min()
        t, rudder = t[apart], rudder[apart]
        rows = np.searchsorted(self.t, t)
        return replace(
            self,
            t=np.insert(self.t, rows, t),
            heading=np.insert(self.heading, rows, np.nan),
            rudder=np.insert(self.rudder, rows, rudder),
        )


def read(path: Path, config: Config | None = None, measured: bool = False) -> Zigzag:
    """A run from a bag (a file or a rosbag2 directory) or else a CSV file.

    ``config`` says which types and axes a bag has that are not the usual ones, ``measured`` that
    its rudder is a measured angle.

    Raises UserError if it cannot be read, lacks a column or topic, or is in other units than it
    says.
    """
    is_bag = path.is_dir() or path.suffix in SUFFIXES
    return from_bag(path, config, measured) if is_bag else from_csv(path)


def from_csv(path: Path) -> Zigzag:
    """Columns `t_s`, `heading_rad|deg` (empty where not measured) and `rudder_rad|deg`."""
    table = read_csv(path)
    if "t_s" not in table.cells:
        raise UserError(
            f"{path} has no column t_s, the time in seconds: it has {', '.join(table.cells)}"
        )
    t = table.numbers("t_s")
    if (bad := np.flatnonzero(np.diff(t) <= 0.0)).size:
        raise UserError(
            f"{path}, line {table.lines[bad[0] + 1]}: t_s goes from {t[bad[0]]:g} to "
            f"{t[bad[0] + 1]:g}, but time must increase: sort the rows"
        )
    if (step := (t[-1] - t[0]) / max(len(t) - 1, 1)) >= _RARE and t[-1] - t[0] > _LONG:
        raise UserError(
            f"{path}: t_s has rows {step:g} s apart for {(t[-1] - t[0]) / 3600.0:.3g} hours, which "
            "looks like milliseconds: divide it by 1000, or cut out the zigzag"
        )
    rudder = _angle(table, "rudder", blank=False)
    heading = _angle(table, "heading", blank=True)
    known = np.isfinite(heading)
    heading[known] = np.unwrap(heading[known])
    return Zigzag(path.name, t, heading, rudder, sha256=table.sha256)


def _angle(table: CsvTable, name: str, blank: bool) -> Array:
    """The column `name_rad` or `name_deg` in radians; its unit is checked against its values."""
    found = [f"{name}_{unit}" for unit in ("rad", "deg") if f"{name}_{unit}" in table.cells]
    if not found:
        hint = f"say its unit by renaming it {name}_rad or {name}_deg" if name in table.cells else (
            f"it has {', '.join(table.cells)}"
        )  # fmt: skip
        raise UserError(f"{table.path} has no column {name}_rad or {name}_deg: {hint}")
    values = table.numbers(found[0], blank)
    moved = values[np.isfinite(values)]
    if len(moved) == 0:
        raise UserError(f"{table.path}: the column {found[0]} is empty: fill it in")
    if len(found) == 2:
        apart = np.nanmax(np.abs(np.radians(table.numbers(found[1], blank)) - values), initial=0.0)
        if not apart < 0.01 + 1e-3 * np.nanmax(np.abs(values)):
            raise UserError(f"{table.path}: {found[0]} and {found[1]} disagree: remove one of them")
    if found[0].endswith("_rad"):
        largest = float(np.abs(moved).max())
        if largest > (_STEEPEST if name == "rudder" else _TURNED):
            way_out = "" if name == "rudder" else ", else wrap it to +-pi"
            raise UserError(
                f"{table.path}: {found[0]} reaches {largest:g}, which looks like degrees: rename "
                f"the column {name}_deg if it is{way_out}"
            )
        return values
    if 0.0 < np.ptp(moved) < _FAINT:
        raise UserError(
            f"{table.path}: {found[0]} varies by {np.ptp(moved):.3g} only, which looks like "
            f"radians: rename the column {name}_rad if it is"
        )
    return np.radians(values)


def from_bag(path: Path, config: Config | None = None, measured: bool = False) -> Zigzag:
    """Heading of the odometry; the rudder from a std_msgs/Float64 (or 32) topic [rad] whose name
    ends in `rudder`, stamped as recorded, or without one the yaw moment of the thruster wrench.

    A command is held until the next one. A rudder that is ``measured`` is linear in between.
    """
    bag = Bag(path)
    steered = rudder_topic(bag)
    roles = (ODOMETRY,) if steered else (ODOMETRY, WRENCH)
    config = config or USUAL
    chosen = select(bag, config, (*roles, POSE))
    rows: dict[str, list[tuple[float, float]]] = {ODOMETRY: [], WRENCH: []}
    for role, message in messages(bag, chosen, config):
        if not isinstance(message, Odometry | Wrench):
            continue
        core = to_core(message, config.frames)
        if isinstance(core, Odometry):
            value = float(quaternion_to_euler(core.orientation)[2])
        else:
            value = float(core.torque[2])
        if np.isfinite(value):
            rows[role].append((1e-9 * core.stamp, value))
    if steered:
        commands = rudder_commands(bag, steered)
        rows[WRENCH] = [(1e-9 * raw.log_time, angle) for angle, raw in commands]
    (t, heading), (at, steering) = (np.array(rows[k]).reshape(-1, 2).T for k in (ODOMETRY, WRENCH))
    t, first = np.unique(t, return_index=True)
    at, once = np.unique(at, return_index=True)
    heading = np.unwrap(heading[first])
    steering = steering[once]
    measured = measured and bool(steered)
    # Nobody knows the rudder before its first message, nor a measured angle after its last one.
    end = at.max(initial=-np.inf) if measured else np.inf
    inside = (t >= at.min(initial=np.inf)) & (t <= end)
    t, heading = t[inside], heading[inside]
    if len(t) < 2:
        raise UserError(
            f"{path} has too few headings after the first message of the rudder: record a longer "
            "run, and stamp both by one clock"
        )
    notes = [*doubts(bag, chosen, config), *filter(None, [bag.damage])]
    if steered and not measured:
        notes.append(
            f"{path.name}: {steered} counts as a command, held until the next one: if it is a "
            "measured angle, give --measured, or T comes out too short"
        )
    # Heading and input on the instants of either, so that a step of the input keeps its time.
    both = np.unique(np.concatenate([t, at[(at > t[0]) & (at < t[-1])]]))
    index = np.searchsorted(at, both, side="right") - 1
    known = np.full(len(both), np.nan)
    known[np.searchsorted(both, t)] = heading
    return Zigzag(
        path.name, both - t[0], known,
        np.interp(both, at, steering) if measured else steering[index],
        "rad" if steered else "N m", not measured, bag.sha256, tuple(notes),
    )  # fmt: skip
