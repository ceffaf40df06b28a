"""Which motion shows which coefficient: the tables of docs/driving.md.

Predicted standard deviations relative to the value, from the information along simulated motions of
a BlueROV2 Heavy, whose coefficients are taken as known to 50 % before.
"""

from collections import Counter
from pathlib import Path

import numpy as np

from rov_ident import archive, config
from rov_ident.batch import predicted_information
from rov_ident.check import prospects
from rov_ident.config import Config
from rov_ident.plan import propose
from rov_ident.records import Record
from rov_ident.sensors import Suite, dive, samples_of

HEAVY = Path(__file__).parent.parent / "config" / "bluerov2_heavy.yaml"
UNKNOWN = 0.4  # of the value: as good as the prior of 50 %


def percent(share: float) -> str:
    return "-" if share > UNKNOWN else f"{100.0 * share:.2g}"


def row(settings: Config, information: np.ndarray) -> list[str]:
    return [percent(p.std / abs(p.value)) for p in prospects(settings, information)]


def table(head: str, names: tuple[str, ...], rows: dict[str, list[str]]) -> None:
    print(f"\n| {head} | {' | '.join(names)} |")
    print("| --- |" + " --- |" * len(names))
    for label, cells in rows.items():
        print(f"| {label} | {' | '.join(cells)} |")


def measured(settings: Config, name: str, duration: float, suite: Suite) -> np.ndarray:
    run = dive(settings, name, duration, suite, seed=1)
    samples = np.concatenate(list(samples_of(settings, run)))
    record = Record(Path(name), samples, Counter(), (), "")
    return predicted_information(archive.of_records([record]), settings)


def main() -> None:
    settings = config.load(HEAVY)
    names = settings.estimate
    found = propose(settings, duration=60.0)
    table(
        "manoeuvre, 60 s", names,
        {c.swing.name: row(settings, c.information) for c in found.candidates},
    )  # fmt: skip
    full = Suite()
    lengths = {f"{t} s": measured(settings, "steps", t, full) for t in (15, 30, 60, 120)}
    table("steps on all axes", names, {label: row(settings, i) for label, i in lengths.items()})
    suites = {
        "odometry 20 Hz, IMU 100 Hz": full,
        "odometry 5 Hz, IMU 100 Hz": Suite(odometry_rate=5.0),
        "odometry 20 Hz, no IMU": Suite(imu_rate=0.0),
        "odometry 5 Hz, no IMU": Suite(odometry_rate=5.0, imu_rate=0.0),
    }
    table(
        "sensors, steps for 60 s", names,
        {label: row(settings, measured(settings, "steps", 60.0, s)) for label, s in suites.items()},
    )  # fmt: skip
    kinds = ("rest", "single-axis", "pilot", "multisine", "steps")
    table(
        "driven for 60 s", names,
        {kind: row(settings, measured(settings, kind, 60.0, full)) for kind in kinds},
    )  # fmt: skip


if __name__ == "__main__":
    main()
