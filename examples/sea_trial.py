"""A sea trial from raw logs to a model, by the commands a user would type (Zhao et al. 2018).

    .venv/bin/python examples/sea_trial.py --out sea_trial

The vehicle is a simulated REMUS 100 with rudder, stern planes and a propeller, steered in closed
loop to alternating waypoints, so that what comes out can be held against the truth. With a vehicle
of your own only `raw_log` goes; the commands are printed as they are run. The configuration begins
up to 40 % off. In the folder are left: the logs and bags of five runs, what each command wrote,
and `joint.html`, judged on a run with changes of speed, depth and course that no fit has seen.
"""

import argparse
import dataclasses
import json
import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from rov_ident import config as configuration
from rov_ident.cli import main as program
from rov_ident.cli.demo import shipped
from rov_ident.config import Config
from rov_ident.core.messages import Array
from rov_ident.steering import autopilot

DVL = (0.25, 0.0, 0.05)  # m, from the body origin
PERIOD = 0.04  # s, of the log
IDLE = 8.0  # s on a line before each run
PROPELLED = {"X_n": 0.05, "X_nn": 0.0145, "K_nn": -4e-4, "K_uudr": 0.12, "K_p": -0.25}
"""Beyond the shipped file: thrust k1 n + k2 n^2, the propeller's torque, and a rudder whose upper
half is larger, so that it rolls; n in revolutions a second."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """A run of the closed loop: courses [rad], depths [m] and speeds [m/s] by time."""

    course: Callable[[float], float]
    depth: Callable[[float], float]
    speed: Callable[[float], float]
    duration: float = 90.0


def steps(every: float, *values: float) -> Callable[[float], float]:
    """One value after the other, each for ``every`` s, the last one for good."""
    return lambda t: values[min(int(t / every), len(values) - 1)]


def swinging(every: float, *values: float) -> Callable[[float], float]:
    """The values in turn, for ever."""
    return lambda t: values[int(t / every) % len(values)]


TRIALS = {
    "surge": Trial(lambda t: 0.0, lambda t: 2.0, steps(10.0, 0.8, 1.2, 1.6, 2.0, 0.0), 80.0),
    "lateral": Trial(swinging(7.0, 0.5, -0.5, 0.2, -0.2), lambda t: 2.0, swinging(21.0, 1.5, 1.9)),
    "longitudinal": Trial(lambda t: 0.0, swinging(9.0, 6.0, 1.0), swinging(27.0, 1.5, 1.9)),
    "joint": Trial(swinging(9.0, 0.4, -0.3), swinging(14.0, 4.0, 1.0), swinging(13.0, 1.4, 1.9)),
}


def vehicle() -> Config:
    """The true one: the shipped REMUS 100 with its propeller, its joints, and a DVL ahead."""
    plain = configuration.to_parameters(configuration.load(shipped("config/remus100.yaml")))
    plain.pop("estimate", None)
    plain["coefficients"] |= PROPELLED
    plain["inputs"] = {name: {"joint": name} for name in ("delta_s", "delta_r", "n")}
    plain["inputs"]["n"]["scale"] = 1.0 / (2.0 * np.pi)
    plain["odometry"] = {"position": list(DVL)}
    return configuration.from_parameters(plain)


def begun(true: Config, seed: int) -> Config:
    """The configuration as it is before the trial: what the tank and the table books say."""
    model = true.model
    off = np.random.default_rng(seed).uniform(0.6, 1.4, len(model.theta))
    return true.with_model(model.with_theta(model.theta * off))


def raw_log(true: Config, trial: Trial, seed: int) -> Mapping[str, Array]:
    """What the vehicle's computers wrote: columns (N,) with outliers, a stern plane that counts the
    other way round, depths from three sources, and the DVL's velocity where it is mounted."""
    rng, model = np.random.default_rng(seed), true.model
    yaw, pitch = (float(np.sign(model.fins[name])) for name in ("N_uudr", "M_uuds"))

    def law(now: autopilot.Now) -> Mapping[str, float]:
        course = autopilot.to_heading(trial.course(now.t), yaw)(now)
        return {**course, **autopilot.to_depth(trial.depth(now.t), pitch)(now)}

    run = autopilot.steer(model, law, trial.duration, 0.0, depth=2.0, speeds=trial.speed)
    every = round(PERIOD / (run.t[1] - run.t[0]))
    n = len(run.t[::every])
    waiting = round(IDLE / PERIOD)

    def column(values: Array, noise: float, rest: float = 0.0) -> Array:
        """At the log's instants, after the time of waiting."""
        x = np.concatenate([np.full(waiting, rest), values[::every]])
        return x + noise * rng.standard_normal(len(x))

    velocity = run.nu[:, :3] + np.cross(run.nu[:, 3:], DVL)
    spoilt = [column(v, 0.008) for v in velocity.T]
    for v in spoilt:
        v[rng.random(len(v)) < 0.01] += rng.uniform(-2.0, 2.0)
    columns = {"t_s": PERIOD * np.arange(waiting + n)} | dict(zip("uvw", spoilt))
    columns |= {name: column(x, 0.003) for name, x in zip("pqr", run.nu[:, 3:].T)}
    names = ("roll", "pitch", "yaw")
    columns |= {name: column(x, 0.002) for name, x in zip(names, run.angles.T)}
    columns |= {"rudder": column(run.fins["r"], 1e-3), "planes": column(-run.fins["s"], 1e-3)}
    columns["rpm"] = 60.0 * column(run.revolutions, 0.0)
    z, k = run.position[:, 2], np.arange(waiting + n)
    columns["pressure"] = np.where(k % 4 == 0, column(z, 0.03, 2.0), np.nan)
    columns["inertial"] = np.where(k % 2 == 0, column(z + 0.4, 0.02, 2.4), np.nan)
    columns["tracking"] = np.where(k % 20 == 0, column(z, 0.3, 2.0), np.nan)
    return columns


def write_csv(path: Path, columns: Mapping[str, Array]) -> None:
    rows = [",".join(columns)]
    for row in zip(*columns.values(), strict=True):
        rows.append(",".join("" if np.isnan(x) else f"{x:.9g}" for x in row))
    path.write_text("\n".join(rows) + "\n")


def command(*words: str | Path) -> None:
    """Run a command of the program, printed as it would be typed."""
    print("$ rov-ident", shlex.join(str(word) for word in words), flush=True)
    if program([str(word) for word in words]):
        raise SystemExit(1)


IMPORT = (
    *("--map", "delta_r=rudder", "delta_s=planes", "x=0", "y=0"),
    *("--polarity", "delta_s", "--despike"),
    *("--depth", "pressure=0.03", "inertial=0.02,0.5", "tracking=0.3,0.1"),
    *("--cut", "8.1", "200"),  # before, the vehicle hangs on its line
)
CHANNELS = (("surge", "surge"), ("lateral", "roll"), ("lateral", "sway,yaw"),
            ("longitudinal", "heave,pitch"))  # fmt: skip
"""The run of each channel, in the order of Zhao et al.: roll before the lateral channel."""


def by_channel(folder: Path, name: str, *options: str) -> Path:
    """The channels one after the other, each from its run; the configuration that comes out."""
    config = folder / "begun.yaml"
    for run, channel in CHANNELS:
        fitted = folder / f"{name}_{channel.replace(',', '_')}.yaml"
        command(
            "fit", folder / f"{run}.mcap", "--config", config, "--channels", channel, *options,
            "--save", fitted, "--json", fitted.with_suffix(".json"),
        )  # fmt: skip
        config = fitted
    return config


def judged(folder: Path, config: Path) -> Mapping[str, float]:
    """RMSE by component on the joint run, in open loop over 10 s."""
    out = folder / f"joint_{config.stem}"
    command(
        "simulate", "--config", config, "--bag", folder / "joint.mcap",
        "--out", out.with_suffix(".mcap"), "--json", out.with_suffix(".json"),
    )  # fmt: skip
    told = json.loads(out.with_suffix(".json").read_text())["velocities"]
    return {name: told[name]["rmse_windows"] for name in told}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("sea_trial"))
    parser.add_argument("--seed", type=int, default=8)
    parser.add_argument(
        "--channels-only", action="store_true",
        help="leave out the fit of all runs together, which takes the most time",
    )  # fmt: skip
    options = parser.parse_args(arguments)
    folder, seed = options.out, options.seed
    folder.mkdir(parents=True, exist_ok=True)
    true = vehicle()
    configuration.dump(true, folder / "true.yaml", "The vehicle that was simulated.")
    configuration.dump(begun(true, seed), folder / "begun.yaml", "As it is before the trial.")
    for k, (name, trial) in enumerate(TRIALS.items()):
        write_csv(folder / f"{name}.csv", raw_log(true, trial, seed + k))
        command("import", folder / f"{name}.csv", "--out", folder / f"{name}.mcap", *IMPORT)

    channels = by_channel(folder, "zhao", "--estimator", "ml", "--output-error")
    rows = {"as configured": folder / "begun.yaml", "channel by channel, output error": channels}
    if not options.channels_only:
        runs = [folder / f"{name}.mcap" for name in TRIALS if name != "joint"]
        together = rows["all runs together, ml"] = folder / "together.yaml"
        command(
            "fit", *runs, "--config", folder / "begun.yaml", "--estimator", "ml",
            "--validate", folder / "joint.mcap", "--report", folder / "joint.html",
            "--save", together, "--json", folder / "together.json",
        )  # fmt: skip
    rows["the true vehicle"] = folder / "true.yaml"
    table = {name: judged(folder, config) for name, config in rows.items()}
    print("the joint run in open loop over 10 s, RMSE, and coefficients off (median):")
    for name, rmse in table.items():
        theta = configuration.load(rows[name]).model.values
        wrong = np.median([abs(theta[c] / x - 1.0) for c, x in true.model.values.items()])
        errors = "  ".join(f"{x} {rmse[x]:.4f}" for x in "uvwpqr")
        print(f"  {name:34s} {errors}  {100 * wrong:.1f} %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
