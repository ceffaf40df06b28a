"""Offline identification against the truth of simulated dives: the tables in docs/offline.md.

    python -m bench.studies.validate [PART ...] [--seeds N] [--jobs N] [--lines FILE]

Parts: ``accuracy`` (three minutes, 18 coefficients, against the Cramer-Rao bound of bound.py)
and ``noise`` (the bias of least squares, and its cure). Each dive leaves a line in FILE, so that a
run can be taken up again. Exit status 1 where a bar is missed.

Vehicles are drawn within 25 % of the BlueROV2 Heavy with all 18 diagonal coefficients; those that
are published as zero are given 5 to 20 % of their axis's damping at working speed. The
configuration that the fits start from is off by up to 50 %.
"""

import argparse
import dataclasses
import sys
from collections import Counter
from pathlib import Path

import numpy as np

from bench import HEAVY
from bench.harness import Bars, Line, announce, digest, lines_of, table
from bench.studies import bound
from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.config.prior import prior_of
from rov_ident.model.scales import WORKING_SPEED
from rov_ident.offline.archive import Archive, of_records
from rov_ident.offline.batch_fit import Settings, fit_batch
from rov_ident.sampling.records import Record, samples_of
from rov_ident.sampling.sample import joined
from rov_ident.simulation.virtual_sensors import Dive, Suite, dive

ESTIMATORS = {
    "ls": ("least squares", "ls", Settings()),
    "iv": ("instrumental variables", "iv", Settings()),
    "ml": ("maximum likelihood", "ml", Settings()),
    "oe": ("output error alone (wrench taken as exact)", "ml", Settings(process=False)),
}
SMALL = ("Y_v", "K_p", "N_r")  # published as zero
BARS = {"ls": (1.5, 5.0), "ml": (1.0, 3.0)}  # %: median and 90th percentile
Z = 1.959963984540054


def vehicle(rng: np.random.Generator) -> Config:
    """All 18 coefficients, none of them zero."""
    parameters = configuration.to_parameters(configuration.load(HEAVY))
    model = configuration.from_parameters(parameters).model
    at_speed = np.diag(model.damping_matrix(WORKING_SPEED))
    for name, axis in zip(SMALL, (1, 3, 5), strict=True):
        parameters["coefficients"][name] = -float(rng.uniform(0.05, 0.2) * at_speed[axis])
    config = configuration.from_parameters(parameters)
    factor = rng.uniform(0.75, 1.25, len(config.model.theta))
    return config.with_model(config.model.with_theta(config.model.theta * factor))


def told(true: Config, rng: np.random.Generator, offset: float = 0.5) -> Config:
    """What the fits start from."""
    factor = 1.0 + offset * rng.uniform(-1.0, 1.0, len(true.model.theta))
    return true.with_model(true.model.with_theta(true.model.theta * factor))


def archive_of(config: Config, run: Dive) -> Archive:
    """A simulated dive as a fit sees a bag."""
    samples = joined(list(samples_of(config, run)))
    return of_records([Record(Path("simulated"), samples, Counter(), (), "")], config)


@dataclasses.dataclass(frozen=True)
class Trial:
    """One dive; ``noise`` multiplies that of the velocities."""

    seed: int
    noise: float

    @property
    def kinds(self) -> tuple[str, ...]:
        """The estimators that see it."""
        return ("ls", "iv", "ml", "oe") if self.noise == 1.0 else ("ls", "iv", "ml")


def measure(trial: Trial) -> Line:
    """The line of one dive."""
    rng = np.random.default_rng([trial.seed, 7])
    true = vehicle(rng)
    start = told(true, rng)
    base, noise = Suite(), trial.noise
    suite = dataclasses.replace(
        base, linear_std=noise * base.linear_std, angular_std=noise * base.angular_std,
        gyro_std=noise * base.gyro_std,
    )  # fmt: skip
    run = dive(true, "steps", 180.0, suite, trial.seed)
    line: Line = {"true": true.model.theta.tolist(), "names": list(true.model.names)}
    line["bound"] = np.sqrt(np.diag(bound.bound(true, run, suite))).tolist()
    archive = archive_of(start, run)
    order = [prior_of(start).names.index(n) for n in true.model.names]
    for kind in trial.kinds:
        _, estimator, settings = ESTIMATORS[kind]
        fit = fit_batch(archive, start, estimator, settings)
        line[kind] = {"value": fit.values[order].tolist(), "std": fit.std[order].tolist()}
    return line


def accuracy(found: list[Line], bars: Bars) -> None:
    """The main table."""
    rows = []
    true, crb = (np.array([line[key] for line in found]) for key in ("true", "bound"))
    for key in ESTIMATORS:
        value, std = (np.array([line[key][part] for line in found]) for part in ("value", "std"))
        error = value - true
        relative = 100.0 * np.abs(error / true)
        middle, high = np.median(relative), np.quantile(relative, 0.9)
        ratio = np.sqrt(np.mean((error / crb) ** 2))
        each = np.sqrt(np.mean((error / crb) ** 2, axis=0))
        inside = 100.0 * np.mean(np.abs(error) <= Z * std)
        errors = [f"{middle:.2f} %", f"{high:.2f} %"]
        if key in BARS:
            limits = zip((middle, high), BARS[key], errors, ("median", "90th percentile"))
            errors = [bars.check(x <= bar, text, f"{key}: {what}") for x, bar, text, what in limits]
        of_bound, covered = f"{ratio:.2f}", f"{inside:.1f} %"
        if key == "ml":
            of_bound = bars.check(ratio <= 1.15, of_bound, "ml: RMSE over the bound")
            covered = bars.check(92.0 <= inside <= 98.0, covered, "ml: intervals hold")
        each_of = f"{each.min():.2f} to {each.max():.2f}"
        rows.append([ESTIMATORS[key][0], *errors, of_bound, each_of, covered])
    table(
        f"{len(found)} dives | median error | 90th percentile | RMSE / bound | by coefficient | "
        "inside 95 % interval",
        rows,
    )


def bias(by_noise: dict[float, list[Line]]) -> None:
    """Mean error in standard errors of the mean: what does not average out is bias."""
    rows = []
    for noise, found in by_noise.items():
        true = np.array([line["true"] for line in found])
        for key in ("ls", "iv", "ml"):
            error = np.array([line[key]["value"] for line in found]) / true - 1.0
            mean = error.mean(axis=0)
            sure = mean / (error.std(axis=0, ddof=1) / np.sqrt(len(found)))
            worst = np.argsort(-np.abs(sure))[:3]
            names = found[0]["names"]
            rows.append(
                [f"x {noise:g}", ESTIMATORS[key][0], f"{100 * np.median(np.abs(error)):.2f} %",
                 f"{np.mean(np.square(sure)):.1f}",
                 ", ".join(f"{names[i]} {100 * mean[i]:+.2f} %" for i in worst)]
            )  # fmt: skip
    table("noise | estimator | median error | mean square of mean / its error | most biased", rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=["accuracy", "noise"])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--noisy-seeds", type=int, default=12)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--lines", type=Path, default=Path("out/validate.jsonl"))
    options = parser.parse_args()
    if unknown := set(options.parts) - {"accuracy", "noise"}:
        parser.error(f"no part {min(unknown)!r}")
    announce()
    bars = Bars()
    measuring = Path(__file__).read_text().split("def accuracy")[0]
    source = digest(Path(bound.__file__).read_bytes(), measuring.encode())

    def lines(seeds: int, noise: float) -> list[Line]:
        trials = [Trial(seed, noise) for seed in range(seeds)]
        return lines_of(trials, measure, lambda _: options.lines, source, jobs=options.jobs)

    if "accuracy" in options.parts:
        accuracy(lines(options.seeds, 1.0), bars)
    if "noise" in options.parts:
        bias({noise: lines(options.noisy_seeds, noise) for noise in (1.0, 3.0, 6.0)})
    return bars.status()


if __name__ == "__main__":
    sys.exit(main())
