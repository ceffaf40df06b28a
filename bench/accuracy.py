"""Accuracy of the live estimators on simulated dives, over seeds: the tables in docs/accuracy.md.

    python bench/accuracy.py [--seeds N] [--study NAME ...]

Vehicles are drawn within 25 % of the BlueROV2 Heavy with all eighteen diagonal coefficients; the
configuration starts off by up to 50 %. Errors are relative to the true value.
"""

import argparse
import dataclasses
import functools
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.demo import shipped
from rov_ident.estimate import prior_of
from rov_ident.online import ESTIMATORS
from rov_ident.sensors import Suite, dive, samples_of

EXTRA = {"Y_v": -8.0, "K_p": -0.1, "N_r": -0.1}  # published as zero: 5 to 20 % of the axis's drag
SUITE = Suite()
DURATION = 180.0  # s


def settings(section: str, **values: object):
    """A change of one section of the configuration."""

    def change(config: Config) -> Config:
        old = getattr(config, section)
        return dataclasses.replace(config, **{section: dataclasses.replace(old, **values)})

    return change


def sensors(**values: object) -> Suite:
    return dataclasses.replace(SUITE, **values)


# study -> rows of (label, sensors, change of the configuration, manoeuvre)
STUDIES = {
    "conditions": [
        ("odometry 20 Hz, IMU 100 Hz, wrench 50 Hz", SUITE, None, "steps"),
        ("no IMU", sensors(imu_rate=0.0), None, "steps"),
        ("noise x 3", SUITE.scaled(3.0), None, "steps"),
        ("odometry 5 Hz", sensors(odometry_rate=5.0), None, "steps"),
        ("5 Hz and no IMU", sensors(odometry_rate=5.0, imu_rate=0.0), None, "steps"),
        ("late, 5 % lost", sensors(delay=0.005, jitter=0.02, drop=0.05), None, "steps"),
        ("sines instead of steps", SUITE, None, "multisine"),
    ],
    "corner": [
        (f"corner {corner:g} rad/s", SUITE, settings("rls", filter_corner=corner), "steps")
        for corner in (1.0, 2.0, 3.0, 5.0, 8.0)
    ],
    "corner without IMU": [
        (f"corner {w:g} rad/s", sensors(imu_rate=0.0), settings("rls", filter_corner=w), "steps")
        for w in (1.0, 2.0, 3.0, 5.0, 8.0)
    ],
    "accelerometer": [
        (f"trust {std:g} m/s2", SUITE, settings("imu", accelerometer_std=std), "steps")
        for std in (0.03, 0.1, 0.3, 1.0, 10.0)
    ],
}  # fmt: skip


@functools.cache
def case(seed: int, suite: Suite, manoeuvre: str):
    """True theta (n,), the dive and the configuration to start from."""
    base = configuration.load(shipped("config/bluerov2_heavy.yaml"))
    parameters = configuration.to_parameters(base)
    parameters["coefficients"] = parameters["coefficients"] | EXTRA
    base = configuration.from_parameters(parameters)
    rng = np.random.default_rng(seed)
    n = len(base.model.theta)
    theta = base.model.theta * rng.uniform(0.75, 1.25, n)
    true = base.with_model(base.model.with_theta(theta))
    start = base.with_model(base.model.with_theta(theta * rng.uniform(0.5, 1.5, n)))
    return theta, dive(true, manoeuvre, DURATION, suite, seed), start


def errors(job):
    """Relative errors and errors in standard deviations (n,) for each estimator."""
    study, row, seed = job
    _, suite, change, manoeuvre = STUDIES[study][row]
    theta, run, config = case(seed, suite, manoeuvre)
    config = change(config) if change else config
    samples = np.concatenate(list(samples_of(config, run)))
    out = {}
    for name, module in ESTIMATORS.items():
        task = module.problem(config)
        state, _ = module.fold(task, module.init(task), samples)
        estimate = module.estimate(task, state, prior_of(config))
        error = estimate.values - theta
        out[name] = error / theta, error / estimate.std
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--study", nargs="+", choices=STUDIES, default=list(STUDIES))
    options = parser.parse_args()
    with ProcessPoolExecutor(2) as pool:
        for study in options.study:
            print(
                f"\n{study}, {options.seeds} seeds, {DURATION:g} s: median error, 90th percentile,"
            )
            print("share of true values inside the 95 % interval\n")
            print("| | rls | | | ukf | | |\n| --- | --- | --- | --- | --- | --- | --- |")
            for row, (label, *_) in enumerate(STUDIES[study]):
                jobs = [(study, row, seed) for seed in range(options.seeds)]
                results = list(pool.map(errors, jobs))
                cells = []
                for name in ESTIMATORS:
                    relative = np.abs([r[name][0] for r in results])
                    z = np.abs([r[name][1] for r in results])
                    cells += [
                        f"{100 * np.median(relative):.2f} %",
                        f"{100 * np.quantile(relative, 0.9):.2f} %",
                        f"{100 * np.mean(z < 1.96):.0f} %",
                    ]
                print(f"| {label} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
