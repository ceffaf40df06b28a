"""Which motion shows which coefficient: the tables of docs/driving.md.

Predicted standard deviations relative to the value, from the information along simulated motions of
a BlueROV2 Heavy, whose coefficients are taken as known to 50 % before, and all else as known.
"""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bench import HEAVY
from bench.harness import announce, table
from rov_ident import config
from rov_ident.config import Config
from rov_ident.experiment.design import information_of, known_after, propose
from rov_ident.offline import archive
from rov_ident.sampling.records import Record, samples_of
from rov_ident.simulation.virtual_sensors import Suite, dive

UNKNOWN = 0.4  # of the value: as good as the prior of 50 %


def percent(share: float) -> str:
    return "-" if share > UNKNOWN else f"{100.0 * share:.2g}"


def row(settings: Config, information: np.ndarray) -> list[str]:
    return [percent(p.std / abs(p.value)) for p in known_after(settings, information)]


def measured(settings: Config, name: str, duration: float, suite: Suite) -> np.ndarray:
    run = dive(settings, name, duration, suite, seed=1)
    samples = np.concatenate(list(samples_of(settings, run)))
    record = Record(Path(name), samples, Counter(), (), "")
    return information_of(archive.of_records([record], settings), settings)


def main() -> None:
    announce()
    settings, full = config.load(HEAVY), Suite()

    def show(head: str, informations: Mapping[str, np.ndarray]) -> None:
        rows = [[label, *row(settings, i)] for label, i in informations.items()]
        table([head, *settings.estimate], rows)

    found = propose(settings, duration=60.0)
    show("manoeuvre, 60 s", {c.manoeuvre.name: c.information for c in found.candidates})
    lengths = (15, 30, 60, 120)
    show("steps on all axes", {f"{t} s": measured(settings, "steps", t, full) for t in lengths})
    suites = {
        "odometry 20 Hz, IMU 100 Hz": full,
        "odometry 5 Hz, IMU 100 Hz": Suite(odometry_rate=5.0),
        "odometry 20 Hz, no IMU": Suite(imu_rate=0.0),
        "odometry 5 Hz, no IMU": Suite(odometry_rate=5.0, imu_rate=0.0),
    }
    show(
        "sensors, steps for 60 s",
        {label: measured(settings, "steps", 60.0, suite) for label, suite in suites.items()},
    )
    kinds = ("rest", "single-axis", "pilot", "multisine", "steps")
    show("driven for 60 s", {kind: measured(settings, kind, 60.0, full) for kind in kinds})


if __name__ == "__main__":
    main()
