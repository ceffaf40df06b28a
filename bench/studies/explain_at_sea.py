"""What `explain` makes of data as vehicles give it: docs/explain-bench.md.

    python -m bench.studies.explain_at_sea [--cases TEXT,...] [--driving KIND,...] [--dives N]
                                           [--seconds T] [--jobs N] [--minutes T] [--folder DIR]

The dives are those of :mod:`at_sea`, with more cases and more driving: sticks that rest, and one
axis at a time. The simulator (sea.py) shares no code with the package, keeps none of the
assumptions of `explain`, and a case need not be in its library. Each dive is explained as a user
would do it: a bag, a file whose coefficients are off by up to 25 %, `ri.explain`.

Bars (exit status 1 where one is missed), of each case and driving: at most 2 % of the dives have a
name that is wrong and sure; of a case in which the file lacks nothing that moves the vehicle, 99 %
have no wrong name at all; none crashes. A name is wrong if it is not among the right ones of the
case (:data:`CASES`). What is right is often too slight to be named (below 2 % of a prediction): how
often it is named first is told, and of dives in which something is named 90 % must name it rightly.
"""

import argparse
import json
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import rov_ident as ri
from bench.harness import Bars, Line, announce, digest, lines_of, table
from bench.simulators import sea
from bench.simulators.sea import SPARSE, Vehicle
from bench.studies import at_sea
from bench.studies.at_sea import ALONE, Draw, answered, chosen, dive_of


def _pose(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """A heading that is wrong and an attitude that was set to zero while the vehicle heeled."""
    return {
        "heading": rng.uniform(0.05, 0.2) * rng.choice([-1.0, 1.0]),
        "tilt": tuple(rng.uniform(-0.03, 0.03, 2).tolist()),
    }


def _heading(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"heading": rng.uniform(0.05, 0.2) * rng.choice([-1.0, 1.0])}


def _drift(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """A heading that drifts, slowly or fast, of a position fix or of dead reckoning."""
    rate = 10.0 ** rng.uniform(-3.0, -1.5) * rng.choice([-1.0, 1.0])
    return {"heading_drift": rate, "dead_reckoned": bool(rng.random() < 0.3)}


def _dead_reckoned(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """The position is the sum of the velocities, along the attitude."""
    return {"dead_reckoned": True}


def _on_the_way(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"on_the_way": tuple(rng.uniform(0.0, 0.2, 3).tolist())}


def _stamps(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """The odometry is stamped as it arrives."""
    return {"odometry_clock": rng.uniform(0.02, 0.1)}


def _wandering(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """An attitude whose error lasts for a quarter of a minute."""
    return {"wander": rng.uniform(0.001, 0.003)}


def _wandering_and_biased(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    biased: dict[str, Any] = at_sea.ALONE["biases"](rng, vehicle)
    return {**_wandering(rng, vehicle), **biased}


def _slightly_tilted(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {**_wandering(rng, vehicle), "tilt": tuple(rng.uniform(-0.02, 0.02, 2).tolist())}


def _lasting_noise(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """Commands to each reading, of which the telemetry that makes its noise renews less often."""
    return {**ALONE["wrench noise"](rng, vehicle), "floor_lasts": int(rng.integers(2, 11))}


def _turned(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """A velocity sensor that is mounted at an angle."""
    angles = rng.uniform(0.05, 0.15, 3) * rng.choice([-1.0, 1.0], 3)
    return {"velocity_turned": tuple(angles.tolist())}


def both(*names: str) -> Draw:
    return lambda rng, vehicle: {k: v for n in names for k, v in ALONE[n](rng, vehicle).items()}


SCALE = ("thrust_scale", "thruster_gain")
"""One factor on all thrusters, or one for each axis."""
CASES: dict[str, tuple[Draw, tuple[str, ...]]] = {
    "clean": (at_sea.CASES["clean"], ()),
    "mass and inertia": (ALONE["mass and inertia"], ()),
    "clocks": (ALONE["clocks"], ()),
    "delays to the recorder": (_on_the_way, ()),
    "dead reckoning": (_dead_reckoned, ()),
    "attitude that wanders": (_wandering, ()),
    "attitude that wanders, and biases": (_wandering_and_biased, ("imu_bias",)),
    "wrench noise": (ALONE["wrench noise"], ("wrench_noise",)),
    "wrench noise that lasts": (_lasting_noise, ("wrench_noise",)),
    "biases": (ALONE["biases"], ("imu_bias",)),
    "thrust scale": (ALONE["thrust scale"], SCALE),
    "thruster lag": (ALONE["thruster lag"], ("thruster_lag",)),
    "current": (ALONE["current"], ("ocean_current",)),
    "trim": (ALONE["trim"], ("buoyancy", "cog_offset")),
    "late velocities": (ALONE["late velocities"], ("velocity_latency",)),
    "smoothed odometry": (ALONE["smoothed odometry"], ("velocity_latency",)),
    # voltage falls with the load and with time
    "sag and advance": (
        ALONE["sag and advance"], ("battery_resistance", "battery_sag", "thrust_advance", *SCALE),
    ),
    "heading": (_heading, ("heading_offset",)),
    "heading that drifts": (_drift, ("heading_offset",)),
    # where the attitude is tilted, velocities and IMU are turned against it, and so is the weight
    "tilted heading": (
        _pose, ("heading_offset", "sensor_misalignment", "imu_bias", "cog_offset"),
    ),
    "attitude slightly tilted": (_slightly_tilted, ("imu_bias", "cog_offset")),
    "velocity sensor turned": (_turned, ("sensor_misalignment",)),
    "late stamps": (_stamps, ("actuation_delay", "velocity_latency")),
    "lag under wrench noise": (
        both("thruster lag", "wrench noise"), ("thruster_lag", "wrench_noise"),
    ),
    "thrust scale and smoothed odometry": (
        both("thrust scale", "smoothed odometry"), (*SCALE, "velocity_latency"),
    ),
    "trim and biases": (both("trim", "biases"), ("buoyancy", "cog_offset", "imu_bias")),
    "all together": (
        at_sea.CASES["all together"],
        (
            *SCALE, "thruster_lag", "ocean_current", "buoyancy", "cog_offset", "velocity_latency",
            "battery_resistance", "battery_sag", "thrust_advance", "wrench_noise", "imu_bias",
        ),
    ),
}  # fmt: skip
"""What the file does not say, and the names that are right for it."""
NOTHING = tuple(CASES)[:10]
"""Cases in which the vehicle moves as the file says, but for its coefficients."""
KINDS = ("six-axis", "pilot", *SPARSE)


# ------------------------------------------------------------------ one dive


@dataclass(frozen=True)
class Trial:
    case: str
    driving: str
    seed: int
    seconds: float


def measure(trial: Trial) -> Line:
    """What a dive is said to lack."""
    draw = CASES[trial.case][0]
    return answered(dive_of(trial.case, trial.driving, trial.seed, trial.seconds, draw), _explained)


def _explained(bag: Path, file: Path) -> Line:
    begin = time.process_time()
    said = json.loads(ri.explain(bag, file).to_json())
    return {
        "cpu": time.process_time() - begin,
        "verdict": said["verdict"],
        "found": [_told(f) for f in said["effects"]],
        "minor": [_told(f) for f in said["minor"]],
        "residual": said["residual"],
        "notes": said["notes"],
    }


def _told(finding: dict[str, Any]) -> Line:
    gain = finding["gain"]
    return {
        "effect": finding["effect"],
        "axes": "".join(finding["axes"]),
        "sure": finding["separable"],
        "alternatives": [a["effect"] for a in finding["alternatives"]],
        "gain": [gain["percent"], gain["low"], gain["high"]],
        "component": gain["component"],
        "parameters": {n: [v["value"], v["std"]] for n, v in finding["parameters"].items()},
    }


# ------------------------------------------------------------------ tables


def right_names(line: Line) -> tuple[str, ...]:
    return CASES[line["trial"]["case"]][1]


def right(line: Line) -> bool:
    """What is named first is right, or said not to be told from what is right."""
    first = line["found"][0]
    others = () if first["sure"] else first["alternatives"]
    return bool({first["effect"], *others} & set(right_names(line)))


def wrong(line: Line) -> list[str]:
    """The names that are wrong, and not said not to be told from a right one; "!": sure."""
    names = right_names(line)
    return [
        f["effect"] + "!" * f["sure"]
        for f in line["found"]
        if f["effect"] not in names and (f["sure"] or not set(f["alternatives"]) & set(names))
    ]


def sure(line: Line) -> list[str]:
    return [name for name in wrong(line) if name.endswith("!")]


def _share(count: int, total: int) -> str:
    return f"{count} of {total}"


def report(lines: Sequence[Line], bars: Bars) -> None:
    """One row for each case and driving."""
    groups: dict[tuple[str, str], list[Line]] = defaultdict(list)
    for line in lines:
        groups[line["trial"]["case"], line["trial"]["driving"]].append(line)
    rows = []
    for (case, driving), group in groups.items():
        what, there = f"{case}, {driving}", [line for line in group if "found" in line]
        refused = sum("refused" in line for line in group)
        crashed = sum("crashed" in line for line in group)
        failed = bars.check(not crashed, f"{refused}, {crashed}", f"{what}: refused, crashed")
        n, named = len(there), [line for line in there if line["found"]]
        good = sum(map(right, named))
        first = _share(good, len(named))
        if case not in NOTHING:
            first = bars.check(good >= 0.9 * len(named), first, f"{what}: right where named")
        bad = [name for line in there for name in wrong(line)]
        count = sum(bool(wrong(line)) for line in there)
        told = _share(count, n) + "".join(f", {name}" for name in dict.fromkeys(bad))
        if case in NOTHING:
            told = bars.check(count <= 0.01 * n, told, f"{what}: a wrong name")
        certain = sum(bool(sure(line)) for line in there)
        certain_text = _share(certain, n)
        certain_text = bars.check(certain <= 0.02 * n, certain_text, f"{what}: wrong and sure")
        verdicts = [line["verdict"] for line in there]
        counted = ", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(sorted(verdicts)))
        cpu = f"{np.median([line['cpu'] for line in there]):.0f}" if there else ""
        rows.append([case, driving, len(group), failed, first, told, certain_text, counted, cpu])
    table(
        "case | driving | dives | refused, crashed | right first, of those named | a wrong name"
        " | wrong and sure | verdict | CPU [s]",
        rows,
    )


# ------------------------------------------------------------------ the study


def trials(cases: Sequence[str], driving: Sequence[str], dives: int, seconds: float) -> list[Trial]:
    """Seed by seed, so that a run that is broken off is a smaller sample of all rows."""
    return [
        Trial(case, how, seed, seconds)
        for seed in range(dives)
        for case in cases
        for how in driving
    ]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default="", help=f"of {', '.join(CASES)}")
    parser.add_argument("--driving", default="", help=f"of {', '.join(KINDS)}")
    parser.add_argument("--dives", type=int, default=5, help="vehicles in each row")
    parser.add_argument("--seconds", type=float, default=150.0, help="length of a dive")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument(
        "--minutes", type=float, default=np.inf, help="of measuring: no dive is begun after"
    )
    parser.add_argument("--folder", type=Path, default=Path("build/explain_at_sea"))
    parser.add_argument("--keep", action="store_true", help="use lines of other sources, too")
    options = parser.parse_args()
    cases = chosen(options.cases, tuple(CASES), parser)
    driving = chosen(options.driving, KINDS, parser)
    asked = trials(cases, driving, options.dives, options.seconds)
    bars, path = Bars(), options.folder / "dives.jsonl"
    announce()
    here = Path(__file__).read_text().split("- tables\n")[0]
    source = digest(Path(sea.__file__).read_bytes(), here.encode())
    lines = lines_of(
        asked, measure, lambda _: path, source,
        jobs=options.jobs, minutes=options.minutes, keep=options.keep,
    )  # fmt: skip
    order = {case: i for i, case in enumerate(CASES)}
    report(sorted(lines, key=lambda line: order[line["trial"]["case"]]), bars)
    if len(lines) < len(asked):
        bars.missed.append(f"only {len(lines)} of {len(asked)} dives")
    return bars.status()


if __name__ == "__main__":
    sys.exit(main())
