"""Dives without a velocity sensor: do the intervals of maximum likelihood hold?

    python -m bench.studies.without_velocity [--driving KIND,...] [--cases CASE,...] [--dives N]
                                             [--seconds T] [--jobs N] [--folder DIR]

The dives are those of at_sea.py, of whose odometry every linear velocity is marked as not measured.
Bars (exit status 1 where one is missed), of each case and driving:

* 95 % intervals of the coefficients of heave, roll, pitch and yaw hold the truth in at least 90 %
  of cases, or 95 % of the dives are said not to be told, as surge or sway is driven, or not to
  agree with the model;
* everything called converged is within four standard deviations (of a thousand, 0.1 are not).
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

import rov_ident as ri
from bench.harness import Bars, Line, announce, digest, lines_of, table
from bench.simulators import sea
from bench.studies import at_sea
from rov_ident.core.messages import Odometry
from rov_ident.io.write_messages import write_messages

NOT_MEASURED = 1e6  # a variance
SEEN, UNSEEN = "ZKMN", "XY"  # axes whose coefficients are told, and those that are not


@dataclass(frozen=True)
class Trial:
    case: str
    driving: str
    seed: int
    seconds: float


def stripped(messages: sea.Messages) -> sea.Messages:
    """The messages without linear velocities."""
    out = []
    for arrival, role, message in messages:
        if isinstance(message, Odometry):
            variance = message.twist_variance.copy()
            variance[:3] = NOT_MEASURED
            message = message._replace(linear=np.zeros(3), twist_variance=variance)
        out.append((arrival, role, message))
    return out


def measure(trial: Trial) -> Line:
    """The line of one fit."""
    stream = at_sea._stream
    vehicle = sea.draw_vehicle(stream(trial.seed, "vehicle"))
    drawn = at_sea.CASES[trial.case](stream(trial.seed, trial.case), vehicle)
    unknown = sea.Sea(**drawn)
    rng = stream(trial.seed, trial.driving)
    truth = sea.dive(vehicle, unknown, trial.driving, trial.seconds, rng)
    messages = stripped(sea.measured(truth, unknown, stream(trial.seed, "sensors")))
    parameters = sea.told(vehicle, unknown, stream(trial.seed, "file"))
    with tempfile.TemporaryDirectory() as folder:
        bag, file = Path(folder) / "dive.mcap", Path(folder) / "vehicle.yaml"
        write_messages(bag, messages)
        file.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))
        try:
            fit = ri.fit(bag, file, "ml")
        except ri.UserError as error:
            return {"refused": str(error)}
    at = [fit.names.index(name) for name in vehicle.theta]
    return {
        "names": list(vehicle.theta),
        "true": list(vehicle.theta.values()),
        "value": fit.values[at].tolist(),
        "std": fit.std[at].tolist(),
        "prior_std": [0.5 * abs(fit.given.value(name)) for name in vehicle.theta],
        "state": [fit.states[i].value for i in at],
        "consistent": fit.consistency.consistent,
        "sentence": fit.consistency.sentence,
        "notes": list(fit.notes),
    }


def row(lines: list[Line], axes: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the coefficients of these axes in all lines (N,): errors in standard deviations and
    relative to the value, and whether they are called converged."""
    sigmas, errors, converged = [], [], []
    for line in lines:
        for i, name in enumerate(line["names"]):
            if name[0] in axes:
                off = line["value"][i] - line["true"][i]
                sigmas.append(off / line["std"][i])
                errors.append(abs(off / line["true"][i]))
                converged.append(line["state"][i] == "converged")
    return np.array(sigmas), np.array(errors), np.array(converged)


def tables(lines: list[Line], bars: Bars) -> None:
    """A row for each case and driving."""
    rows = []
    kinds = dict.fromkeys((line["trial"]["case"], line["trial"]["driving"]) for line in lines)
    for case, driving in kinds:
        own = [
            line for line in lines
            if (line["trial"]["case"], line["trial"]["driving"]) == (case, driving)
        ]  # fmt: skip
        fitted, what = [line for line in own if "value" in line], f"{case}, {driving}"
        doubted = 1.0 - np.mean([line.get("consistent", False) for line in own])
        cells: list[object] = [case, driving, len(own)]
        for axes in (SEEN, UNSEEN) if fitted else ():
            sigmas, errors, converged = row(fitted, axes)
            covered = float(np.mean(np.abs(sigmas) <= at_sea.Z))
            held = covered >= 0.9 or doubted >= 0.95 or axes == UNSEEN
            cells.append(bars.check(held, f"{100.0 * covered:.0f} %", f"{what}, {axes}: held"))
            if axes == SEEN:
                worst = float(np.max(np.abs(sigmas[converged]), initial=0.0))
                cells += [
                    bars.check(worst <= 4.0, f"{worst:.1f}", f"{what}: worst called converged"),
                    f"{100.0 * np.mean(converged):.0f} %",
                    f"{100.0 * np.median(errors[converged]):.1f} %" if converged.any() else "",
                ]
        rows.append([*cells, f"{100.0 * doubted:.0f} %"])
    head = (
        "case | driving | dives | intervals that hold | worst converged, std | converged | their "
        "median error | surge, sway: intervals that hold | said to disagree"
    )
    table(head, rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--driving", default="heave,roll,pitch,yaw,four-axis,six-axis,pilot")
    parser.add_argument("--cases", default="clean,all together")
    parser.add_argument("--dives", type=int, default=10, help="vehicles in each row")
    parser.add_argument("--seconds", type=float, default=180.0, help="length of a dive")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--folder", type=Path, default=Path("build/without_velocity"))
    options = parser.parse_args()
    bars = Bars()
    asked = [
        Trial(case, driving, seed, options.seconds)
        for seed in range(options.dives)
        for case in options.cases.split(",")
        for driving in options.driving.split(",")
    ]
    announce()
    here = Path(__file__).read_text().split("def row")[0]
    source = digest(Path(sea.__file__).read_bytes(), here.encode())
    path = options.folder / "fits.jsonl"
    lines = lines_of(asked, measure, lambda _: path, source, jobs=options.jobs)
    tables(lines, bars)
    return bars.status()


if __name__ == "__main__":
    sys.exit(main())
