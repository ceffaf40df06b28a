"""Accuracy on data as vehicles give it: right, or said to be wrong.

    python -m bench.studies.at_sea [--cases TEXT,...] [--driving KIND,...] [--estimators KIND,...]
                                   [--dives N] [--seconds T] [--jobs N] [--minutes T] [--folder DIR]

Each case is something that a vehicle does and its configuration file does not say, with a strength
drawn by seed; besides, the file's coefficients are off by up to 25 %. It states that it knows the
righting arm where it does: without that, the arm alone may be off by more than the bars. The
simulator (sea.py) shares no code with the package. A dive is fitted as a user would do it: a bag,
a file, `ri.fit`.

Bars (exit status 1 where one is missed), of each case, driving and estimator:

* the median error of the coefficients is at most 5 %, in a current 3 %, driven by a pilot 10 %, and
  0.1 % where the file is right and says so ("known");
* 95 % intervals hold the truth in 90 to 98 % of cases, or 95 % of the dives are said not to agree
  with the model;
* of a clean dive at most 2 % are;
* RLS and UKF have at most 1.5 times the median error of ML.

Of sensors that lie: in 95 % of dives everything called converged is within three standard
deviations, or the dive is said not to agree with the model. A fit that is refused says so, too.

Each fit leaves one line in a file of FOLDER, so that a run can be broken off and taken up again;
with --minutes no fit is begun after so many, and what is missing counts as a bar missed.
"""

import argparse
import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import yaml

import rov_ident as ri
from bench.harness import Bars, Line, announce, digest, lines_of, table
from bench.simulators import sea
from bench.simulators.sea import DRIVING, Sea, Vehicle
from rov_ident.config import Config
from rov_ident.config.schema import BY_KEY
from rov_ident.core.messages import Message
from rov_ident.io import topics as inputs
from rov_ident.io.bag_reader import Bag
from rov_ident.io.write_messages import write_messages

ESTIMATORS = ("rls", "ukf", "ml")

Draw = Callable[[np.random.Generator, Vehicle], dict[str, Any]]


# ------------------------------------------------------------------ cases: the fields of Sea


def _clean(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {}


def _thrust_scale(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"thrust_scale": rng.uniform(0.8, 1.1)}


def _lag(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"lag": rng.uniform(0.1, 0.4)}


def _current(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """It swings by up to a third of its speed, in five to fifteen minutes."""
    speed, course = rng.uniform(0.1, 0.3), rng.uniform(-np.pi, np.pi)
    swing = speed / 3.0 * rng.uniform(-1.0, 1.0, 2)
    return {
        "current": (speed * np.cos(course), speed * np.sin(course)),
        "current_swing": tuple(swing.tolist()),
        "current_period": rng.uniform(300.0, 900.0),
    }


def _trim(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    lift = 0.02 * sea.GRAVITY * vehicle.mass * rng.uniform(-1.0, 1.0)
    return {"lift": lift, "cog": tuple(rng.uniform(-0.005, 0.005, 3).tolist())}


def _arm(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """A file has it from volumes and weights of parts: 15 % of it, as the package supposes."""
    return {"cob_off": 0.15 * float(vehicle.cog[2] - vehicle.cob[2]) * rng.standard_normal()}


def _late(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"velocity_delay": rng.uniform(0.05, 0.15)}


def _mass(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """As uncertain as the file takes them to be."""
    return {
        "mass_factor": 1.0 + 0.01 * rng.standard_normal(),
        "inertia_factor": tuple((1.0 + 0.05 * rng.standard_normal(3)).tolist()),
    }


def _smoothed(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"smoothing": rng.uniform(0.05, 0.15)}


def _sag(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """A battery's inner resistance and its cables, half its charge, and a propeller's pitch."""
    return {
        "resistance": rng.uniform(0.01, 0.03),
        "discharge": rng.uniform(0.3, 1.0),
        "advance": rng.uniform(0.1, 0.3),
    }


def _wrench_noise(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"wrench_floor": (0.5,) * 3 + (rng.uniform(0.04, 0.08),) * 3}


def _biases(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """Of a gyro that is calibrated at rest; half of the vehicles copy it into the odometry."""
    return {
        "gyro_bias": tuple((0.01 * rng.standard_normal(3)).tolist()),
        "accelerometer_bias": tuple((0.05 * rng.standard_normal(3)).tolist()),
        "gyro_is_shared": bool(rng.random() < 0.5),
    }


def _clocks(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"odometry_rate": 10.0, "imu_clock": 0.02 * rng.choice([-1.0, 1.0])}


def _ordinary(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """Sensors as they mostly are: small biases, a gyro that the odometry copies, and an attitude
    whose error lasts; a trim of some millimetres; thrust as in the case of it."""
    return {
        **_thrust_scale(rng, vehicle),
        "cog": tuple(rng.uniform(-0.003, 0.003, 3).tolist()),
        "wander": rng.uniform(0.001, 0.003),
        "gyro_bias": tuple(rng.uniform(-0.001, 0.001, 3).tolist()),
        "accelerometer_bias": tuple(rng.uniform(-0.02, 0.02, 3).tolist()),
        "gyro_is_shared": True,
    }


def _supposed(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    """All that is uncertain by default, each drawn with the standard deviation that is supposed of
    it (docs/inputs.md): the intervals then have to hold in 95 % of cases, neither less nor more."""
    normal, arm = rng.standard_normal, float(vehicle.cog[2] - vehicle.cob[2])
    return {
        **_mass(rng, vehicle),
        "thrust_scale": max(1.0 + 0.15 * normal(), 0.6),
        "of_reading": tuple((1.0 + 0.05 * normal(6)).tolist()),
        "lag": abs(0.2 * normal()),
        "current": tuple((0.3 * normal(2)).tolist()),
        "lift": 0.02 * sea.GRAVITY * vehicle.mass * normal(),
        "cog": tuple((0.005 * normal(3)).tolist()),
        "cob_off": max(max(0.005, 0.15 * arm) * normal(), -0.5 * arm),
        "velocity_delay": abs(0.1 * normal()),
        "velocity_scale": 1.0 + 0.01 * normal(),
        "imu_clock": 0.001 * normal(),
    }


ALONE: dict[str, Draw] = {
    "thrust scale": _thrust_scale,
    "thruster lag": _lag,
    "current": _current,
    "trim": _trim,
    "righting arm": _arm,
    "late velocities": _late,
    "mass and inertia": _mass,
    "smoothed odometry": _smoothed,
    "sag and advance": _sag,
    "wrench noise": _wrench_noise,
    "biases": _biases,
    "clocks": _clocks,
}


def _everything(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    for draw in ALONE.values():
        changes |= draw(rng, vehicle)
    return changes


def _frozen(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"frozen_from": 60.0}


def _turned(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"imu_turned": True}


def _reversed(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"reversed_axis": int(rng.integers(6))}


def _gyro(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    bias = np.zeros(3)
    bias[rng.integers(3)] = 0.05 * rng.choice([-1.0, 1.0])
    return {"gyro_bias": tuple(bias.tolist()), "gyro_is_shared": bool(rng.random() < 0.5)}


def _stamps(rng: np.random.Generator, vehicle: Vehicle) -> dict[str, Any]:
    return {"odometry_clock": 0.2}


CASES: dict[str, Draw] = {
    "known": _clean, "clean": _clean, **ALONE, "ordinary sensors": _ordinary,
    "as supposed": _supposed, "all together": _everything,
}  # fmt: skip
LIES: dict[str, Draw] = {
    "velocity frozen": _frozen,
    "IMU turned": _turned,
    "wrench axis reversed": _reversed,
    "gyro bias 0.05 rad/s": _gyro,
    "stamps 0.2 s late": _stamps,
}

KNOWN: dict[str, Any] = {
    "vehicle.mass_std": 0.0, "vehicle.inertia_std": 0.0, "wrench.scale_std": 0.0,
    "wrench.lag_std": 0.0, "current_std": 0.0, "odometry.latency_std": 0.0,
    "odometry.scale_std": 0.0,
    "vehicle.buoyancy_std": 0.0, "vehicle.cog_std": 0.0, "vehicle.cob_std": 0.0,
}  # fmt: skip
"""What the file of the case "known" says besides; keys that do not exist are left out."""


# ------------------------------------------------------------------ one fit


@dataclass(frozen=True)
class Trial:
    case: str
    driving: str
    seed: int
    seconds: float
    estimator: str


@dataclass(frozen=True)
class Dive:
    vehicle: Vehicle
    sea: Sea
    bag: bytes
    parameters: dict[str, Any]


def _stream(seed: int, purpose: str) -> np.random.Generator:
    """Random numbers for one purpose: vehicle and driving are the same in all cases of a seed."""
    return np.random.default_rng([seed, crc32(purpose.encode())])


@lru_cache(maxsize=1)  # the fits of one dive follow each other
def dive_of(case: str, driving: str, seed: int, seconds: float, draw: Draw | None = None) -> Dive:
    """Draw the vehicle and the strength of the case, dive, and write the bag; ``draw``: of a case
    that is not in the lists above."""
    vehicle = sea.draw_vehicle(_stream(seed, "vehicle"))
    draw = draw or CASES.get(case) or LIES[case]
    unknown = replace(Sea(), **draw(_stream(seed, case), vehicle))
    truth = sea.dive(vehicle, unknown, driving, seconds, _stream(seed, driving))
    messages = sea.measured(truth, unknown, _stream(seed, "sensors"))
    parameters = sea.told(vehicle, unknown, _stream(seed, "file"))
    if not (unknown.cob_off or unknown.cog[2]):
        parameters["vehicle"]["cob_std"] = 0.0
    for key, value in KNOWN.items() if case == "known" else ():
        if key in BY_KEY:
            section, _, name = key.rpartition(".")
            (parameters.setdefault(section, {}) if section else parameters)[name] = value
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dive.mcap"
        write_messages(path, messages)
        return Dive(vehicle, unknown, path.read_bytes(), parameters)


def messages_of(dive: Dive, config: Config) -> list[tuple[str, Message]]:
    """Role and message of all that the dive's bag holds, as a fit reads it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dive.mcap"
        path.write_bytes(dive.bag)
        bag = Bag(path)
        return list(inputs.messages(bag, inputs.select(bag, config), config))


def answered(dive: Dive, question: Callable[[Path, Path], Line]) -> Line:
    """What was drawn, and the answer to a question about the bag and the file; or why none."""
    line: Line = {
        "drawn": {f.name: v for f in fields(Sea) if (v := getattr(dive.sea, f.name)) != f.default}
    }
    with tempfile.TemporaryDirectory() as folder:
        bag, file = Path(folder) / "dive.mcap", Path(folder) / "vehicle.yaml"
        bag.write_bytes(dive.bag)
        file.write_text(yaml.safe_dump({"/**": {"ros__parameters": dive.parameters}}))
        try:
            return line | question(bag, file)
        except ri.UserError as error:
            return line | {"refused": str(error)}
        except Exception as error:  # the study goes on; a crash is a bar missed
            return line | {"crashed": f"{type(error).__name__}: {error}"}


def measure(trial: Trial) -> Line:
    """The line of one fit."""
    dive = dive_of(trial.case, trial.driving, trial.seed, trial.seconds)
    return answered(dive, lambda bag, file: _fitted(dive, bag, file, trial.estimator))


def _fitted(dive: Dive, bag: Path, file: Path, estimator: str) -> Line:
    begin = time.monotonic()
    fit = json.loads(ri.fit(bag, file, estimator).to_json())
    entries = {name: fit["coefficients"][name] for name in dive.vehicle.theta}
    lower = [e.get("lower", e["value"] - Z * e["std"]) for e in entries.values()]
    upper = [e.get("upper", e["value"] + Z * e["std"]) for e in entries.values()]
    verdict = fit.get("consistency", {})
    return {
        "seconds": time.monotonic() - begin,
        "names": list(entries),
        "true": list(dive.vehicle.theta.values()),
        "value": [e["value"] for e in entries.values()],
        "std": [e["std"] for e in entries.values()],
        "lower": lower,
        "upper": upper,
        "state": [e["state"] for e in entries.values()],
        "others": {k: e for k, e in fit["coefficients"].items() if k not in entries},
        "consistent": verdict.get("consistent", True),
        "sentence": verdict.get("sentence", ""),
    }


Z = 1.959963984540054  # of the normal distribution, 97.5 %


# ------------------------------------------------------------------ tables


@dataclass(frozen=True)
class Group:
    """The lines of one case, driving and estimator; arrays (dives, coefficients)."""

    lines: list[Line]

    @property
    def fitted(self) -> list[Line]:
        return [line for line in self.lines if "value" in line]

    def _all(self, key: str) -> np.ndarray:
        return np.array([line[key] for line in self.fitted])

    @property
    def error(self) -> np.ndarray:
        return self._all("value") - self._all("true")

    @property
    def median(self) -> float:
        """Of the error relative to the truth."""
        if not self.fitted:
            return np.inf
        return float(np.median(np.abs(self.error / self._all("true"))))

    @property
    def covered(self) -> float:
        true = self._all("true")
        return float(np.mean((self._all("lower") <= true) & (true <= self._all("upper"))))

    @property
    def sigmas(self) -> np.ndarray:
        return np.abs(self.error) / self._all("std")

    @property
    def converged(self) -> np.ndarray:
        return self._all("state") == "converged"

    @property
    def disagrees(self) -> float:
        """Share of the dives that are said not to fit the model; refused ones are among them."""
        said = [not line.get("consistent", True) or "refused" in line for line in self.lines]
        return float(np.mean(said))

    @property
    def honest(self) -> float:
        """Share of the dives in which all that is called converged is within three sigma."""
        good = iter(((self.sigmas <= 3.0) | ~self.converged).all(axis=1)) if self.fitted else None
        held = [
            "refused" in line or ("value" in line and (next(good) or not line["consistent"]))
            for line in self.lines
        ]
        return float(np.mean(held))


Groups = dict[tuple[str, str, str], Group]


def grouped(lines: Sequence[Line]) -> Groups:
    """By case, driving and estimator, in the order of the lines."""
    found: dict[tuple[str, str, str], list[Line]] = defaultdict(list)
    for line in lines:
        t = line["trial"]
        found[t["case"], t["driving"], t["estimator"]].append(line)
    return {key: Group(group) for key, group in found.items()}


def _limit(case: str, driving: str) -> float:
    """The bar of the median error."""
    if driving != "six-axis":
        return 0.1
    return {"known": 0.001, "current": 0.03}.get(case, 0.05)


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"


def _failed(group: Group, what: str, bars: Bars) -> str:
    """Fits without a result: refused, and crashed."""
    refused = sum("refused" in line for line in group.lines)
    crashed = sum("crashed" in line for line in group.lines)
    return bars.check(not crashed, f"{refused}, {crashed}", f"{what}: refused, crashed")


def accuracy(groups: Groups, bars: Bars) -> None:
    """Errors, intervals and verdicts of the cases."""
    rows = []
    for (case, driving, estimator), group in groups.items():
        what = f"{case}, {driving}, {estimator}"
        row = [case, driving, estimator, str(len(group.lines)), _failed(group, what, bars)]
        if not group.fitted:
            rows.append([*row, *["-"] * 6])
            continue
        said, covered = group.disagrees, group.covered
        text = _percent(group.median)
        row.append(bars.check(group.median <= _limit(case, driving), text, f"{what}: error"))
        ml = groups.get((case, driving, "ml"))
        if estimator == "ml" or ml is None or not ml.fitted:
            row.append("")
        else:
            ratio = group.median / ml.median
            row.append(bars.check(ratio <= 1.5, f"{ratio:.2f}", f"{what}: error over ML's"))
        right = 0.9 <= covered <= 0.98 or said >= 0.95
        row.append(bars.check(right, _percent(covered), f"{what}: coverage"))
        if case in ("known", "clean"):
            row.append(bars.check(said <= 0.02, _percent(said), f"{what}: false alarms"))
        else:
            row.append(_percent(said))
        row += [_percent(group.converged.mean()), f"{np.median(group.sigmas):.2f}"]
        rows.append(row)
    table(
        "case | driving | | dives | refused, crashed | median error | over ML's | 95 % cover"
        " | said to disagree | converged | median error / std",
        rows,
    )


def lies(groups: Groups, bars: Bars) -> None:
    """Sensors that lie: right, or said to be wrong."""
    rows = []
    for (case, driving, estimator), group in groups.items():
        what = f"{case}, {driving}, {estimator}"
        row = [case, driving, estimator, str(len(group.lines)), _failed(group, what, bars)]
        honest = bars.check(group.honest >= 0.95, _percent(group.honest), f"{what}: honest")
        row += [honest, _percent(group.disagrees)]
        if group.fitted:
            worst = np.where(group.converged, group.sigmas, 0.0).max(axis=1)
            row += [_percent(group.median), _percent(group.converged.mean()),
                    f"{np.median(worst):.1f}, {worst.max():.1f}"]  # fmt: skip
        else:
            row += ["-"] * 3
        rows.append(row)
    table(
        "fault | driving | | dives | refused, crashed | right, or said to be wrong"
        " | said to disagree | median error | converged"
        " | worst error / std of what is converged: median dive, worst dive",
        rows,
    )


# ------------------------------------------------------------------ the study


def trials(
    cases: Sequence[str], driving: Sequence[str], estimators: Sequence[str], dives: int,
    seconds: float,
) -> list[Trial]:  # fmt: skip
    """Seed by seed, so that a run that is broken off is a smaller sample of all rows."""
    return [
        Trial(case, how, seed, seconds, estimator)
        for seed in range(dives)
        for case in cases
        for how in driving
        for estimator in estimators
    ]


def source() -> str:
    """The digest of what makes a line: the tables do not."""
    here = Path(__file__).read_text().split("- tables\n")[0]
    return digest(Path(sea.__file__).read_bytes(), here.encode())


def chosen(text: str, known: Sequence[str], parser: argparse.ArgumentParser) -> list[str]:
    """The words of an option, all that are known by default."""
    asked = [word.strip() for word in text.split(",")] if text else list(known)
    if wrong := set(asked) - set(known):
        parser.error(f"there is no {', '.join(sorted(wrong))}: use {', '.join(known)}")
    return asked


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default="", help=f"of {', '.join((*CASES, *LIES))}")
    parser.add_argument("--driving", default="", help=f"of {', '.join(DRIVING)}")
    parser.add_argument("--estimators", default="", help=f"of {', '.join(ESTIMATORS)}")
    parser.add_argument("--dives", type=int, default=20, help="vehicles in each row")
    parser.add_argument("--seconds", type=float, default=180.0, help="length of a dive")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument(
        "--minutes", type=float, default=np.inf, help="of measuring: no fit is begun after"
    )
    parser.add_argument("--folder", type=Path, default=Path("build/at_sea"))
    options = parser.parse_args()
    cases = chosen(options.cases, (*CASES, *LIES), parser)
    driving = chosen(options.driving, tuple(DRIVING), parser)
    estimators = chosen(options.estimators, ESTIMATORS, parser)
    asked = trials(cases, driving, estimators, options.dives, options.seconds)
    bars, path = Bars(), options.folder / "fits.jsonl"
    announce()
    if "known" in cases and (absent := [name for name in KNOWN if name not in BY_KEY]):
        print(f"\nThe file of the case known cannot say (no such keys): {', '.join(absent)}.")
    lines = lines_of(
        asked, measure, lambda _: path, source(), jobs=options.jobs, minutes=options.minutes
    )
    order = {key: i for i, key in enumerate((*CASES, *LIES))}
    groups = grouped(sorted(lines, key=lambda line: order[line["trial"]["case"]]))
    if ours := {key: group for key, group in groups.items() if key[0] in CASES}:
        accuracy(ours, bars)
    if faults := {key: group for key, group in groups.items() if key[0] in LIES}:
        lies(faults, bars)
    if len(lines) < len(asked):
        bars.missed.append(f"only {len(lines)} of {len(asked)} fits")
    return bars.status()


if __name__ == "__main__":
    sys.exit(main())
