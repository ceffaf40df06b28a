"""A sea trial from raw logs to a model, the procedure of Zhao et al. (2018) step by step.

    .venv/bin/python examples/sea_trial.py --out sea_trial

The vehicle is simulated, so that what comes out can be held against the truth; with a vehicle of
your own only `raw_log` goes. Its configuration is off by up to 40 %. In the folder are left: the
prepared logs and bags of five runs, `fitted.yaml`, and `report.html` and `joint.png`, the open-loop
simulation of the joint run (speed change and turn), which no fit has seen, before and after.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rov_ident import config as configuration
from rov_ident.cli import main as program
from rov_ident.cli.demo import shipped
from rov_ident.config import Config
from rov_ident.core.files import write_file
from rov_ident.core.frames import quaternion_to_euler
from rov_ident.core.messages import Array
from rov_ident.core.states import State
from rov_ident.experiment import closed_loop_manoeuvres
from rov_ident.experiment.closed_loop_manoeuvres import AlternatingTargets, Limits
from rov_ident.offline.archive import opened
from rov_ident.offline.batch_fit import Settings, curves, fit_batch, open_loop_rmse
from rov_ident.offline.fit import Curves, Fit
from rov_ident.offline.report import page
from rov_ident.reports import plots
from rov_ident.reports.result import provenance
from rov_ident.sampling.records import VELOCITIES
from rov_ident.simulation.open_loop import simulate

DVL = (0.15, 0.0, 0.1)  # m, from the body origin
PERIOD = 0.05  # s, of the log
IDLE = 8.0  # s before and after each run
STILL = (9.0, 9.0, 9.0, 9.0)


@dataclasses.dataclass(frozen=True)
class Course(AlternatingTargets):
    """Legs of constant speed and heading, each (duration [s], speed [m/s], heading [rad])."""

    legs: tuple[tuple[float, float, float], ...] = ()

    def target(self, t: float) -> Array:
        """Position [m] and heading [rad] (4,) aimed at; at the end of the last leg it stays."""
        target = np.zeros(4)
        for duration, speed, heading in self.legs:
            gone = speed * min(t, duration)
            target[:2] += gone * np.cos(heading), gone * np.sin(heading)
            target[3] = heading
            t -= duration
            if t <= 0.0:
                break
        return target


# The controller stays closed: alternating waypoints drive the thrusters between their limits.
RUNS = {
    ("surge",): AlternatingTargets("surge", (1.0, 0.0, 0.0, 0.0), (3.0, *STILL[1:])),
    ("roll",): AlternatingTargets("roll", (0.0, 0.0, 0.0, 0.0), STILL, (0.7, 0.0)),
    ("sway", "yaw"): AlternatingTargets("lateral", (0.0, 1.0, 0.0, 0.9), (9.0, 3.3, 9.0, 2.7)),
    ("heave", "pitch"): AlternatingTargets(
        "longitudinal", (0.0, 0.0, 0.7, 0.0), (9.0, 9.0, 3.7, 9.0), (0, 0.7)
    ),
}
# Ahead slowly, then fast, a turn to starboard at speed, one back to port, and slowly on. Sharper
# turns make a vehicle with a centimetre between its centres roll and pitch away in open loop: the
# Munk moments of the sway are stronger than its restoring moments.
JOINT = Course(
    "joint",
    (0.0,) * 4,
    (1.0,) * 4,
    legs=((8.0, 0.3, 0.0), (10.0, 0.6, 0.0), (10.0, 0.6, 0.6), (8.0, 0.4, 0.1), (4.0, 0.2, 0.1)),
)


@dataclasses.dataclass(frozen=True)
class Log:
    """What the vehicle's computers wrote, on one clock: rows (N,) and depths from three sources."""

    t: Array
    velocity: Array  # (N, 3) m/s, of the DVL where it is mounted
    omega: Array  # (N, 3) rad/s
    angles: Array  # (N, 3) rad, roll pitch yaw
    wrench: Array  # (N, 6) command from each row to the next
    depth: dict[str, Array]  # by source (N,) m, NaN in rows where it has not measured


def raw_log(vehicle: Config, run: AlternatingTargets, duration: float, seed: int) -> Log:
    """A run of the true vehicle as its sensors see it, with outliers, levers and idle minutes."""
    rng = np.random.default_rng(seed)
    flown = closed_loop_manoeuvres.fly(vehicle, run, duration, Limits())
    t = np.arange(0.0, duration + 2.0 * IDLE, PERIOD)
    held = np.searchsorted(flown.t, t - IDLE + 1e-9, side="right") - 1
    at_work = (held >= 0) & (t < IDLE + duration)
    # moored before and after: only the trim is held
    trim = -vehicle.dynamics.body.restoring @ np.array([0.0, 0.0, 1.0])
    wrench = np.where(at_work[:, None], flown.demand[np.clip(held, 0, None)], trim)
    fine = np.arange(0.0, t[-1] + 1e-9, 0.1 * PERIOD)
    truth = simulate(vehicle.dynamics, fine, np.repeat(wrench, 10, axis=0)[: len(fine)])
    rows = slice(None, None, 10)
    nu, n = truth.nu[rows], len(t)
    velocity = nu[:, :3] + np.cross(nu[:, 3:], DVL) + 0.008 * rng.standard_normal((n, 3))
    spikes = rng.random(n) < 0.01
    velocity[spikes] += rng.uniform(-2.0, 2.0, (spikes.sum(), 3))
    angles = quaternion_to_euler(truth.orientation[rows])

    def depth(every: int, std: float, bias: float = 0.0) -> Array:
        z = truth.position[rows][:, 2] + bias + std * rng.standard_normal(n)
        return np.where(np.arange(n) % every == 0, z, np.nan)

    return Log(
        t,
        velocity,
        nu[:, 3:] + 0.003 * rng.standard_normal((n, 3)),
        angles + 0.002 * rng.standard_normal((n, 3)),
        wrench,
        {"pressure": depth(4, 0.03), "inertial": depth(2, 0.02, 0.4), "tracking": depth(20, 0.3)},
    )


def imported(log: Log, table: Path) -> Path:
    """The log as a CSV file, and prepared as a bag: cut, cleaned, its depths fused.

    Not smoothed: the noise is in the model of maximum likelihood, and smoothing would hide it.
    """
    columns = np.column_stack([log.t, log.velocity, log.omega, log.wrench, log.angles])
    head = "t_s,u,v,w,p,q,r,X,Y,Z,K,M,N,roll,pitch,yaw"
    columns = np.column_stack([columns, *log.depth.values()])
    np.savetxt(table, columns, "%.9g", ",", header=",".join([head, *log.depth]), comments="")
    bag = table.with_suffix(".mcap")
    depths = ["pressure=0.03", "inertial=0.02,0.5", "tracking=0.3,0.1"]
    prepared = ["--despike", "--depth", *depths, "--cut-idle", "3"]
    command = ["import", str(table), "--map", "x=0", "y=0", "--out", str(bag), *prepared]
    if program(command):
        raise SystemExit(f"{table} cannot be imported")
    return bag


def fitted(bag: Path, config: Config, channels: tuple[str, ...]) -> Fit:
    with opened([bag], config, jobs=1) as bags:
        return fit_batch(bags, config, "ml", Settings((channels,)))


def together(fits: list[Fit], judged: list[Curves]) -> Fit:
    """One result of fits in a row: of each, the coefficients that its run could tell."""
    covariance = fits[0].covariance.copy()
    for fit in fits[1:]:
        known = np.flatnonzero(fit.identifiable)
        covariance[np.ix_(known, known)] = fit.covariance[np.ix_(known, known)]
    return dataclasses.replace(
        fits[-1],
        given=fits[0].given,
        judged=tuple(judged),
        covariance=covariance,
        states=tuple(map(_best, zip(*(fit.states for fit in fits)))),
        notes=tuple(note for fit in fits for note in fit.notes),
        duration=sum(fit.duration for fit in fits),
        provenance=provenance(
            (bag["file"], bag["sha256"]) for fit in fits for bag in fit.provenance["bags"]
        ),
    )


def _best(states: tuple[State, ...]) -> State:
    """Of a coefficient's states in several fits, that of the last one which identified it."""
    return next((state for state in reversed(states) if state is not State.HELD), State.HELD)


def picture(joint: Curves) -> bytes:
    """The joint run measured and simulated, as PNG."""
    figure = Figure(figsize=(10.0, 5.6), layout="constrained")
    for i, ax in enumerate(figure.subplots(3, 2, sharex=True).T.flat):
        simulated = {"as configured": joint.before[:, i], "retuned": joint.after[:, i]}
        plots.draw_curves(ax, joint.t, simulated, measured=joint.measured[:, i])
        ax.set_title(f"{VELOCITIES[i]} [{'m/s' if i < 3 else 'rad/s'}]", loc="left", fontsize=9)
    plots.outside_legend(figure, figure.axes[0])
    return plots.to_png(figure)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("sea_trial"))
    parser.add_argument("--seed", type=int, default=8)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    true = configuration.load(shipped("config/bluerov2_heavy.yaml"))
    # takes the lever arm of the DVL off
    true = dataclasses.replace(true, odometry=dataclasses.replace(true.odometry, position=DVL))
    off = np.random.default_rng(options.seed).uniform(0.6, 1.4, len(true.model.theta))
    start = true.with_model(true.model.with_theta(true.model.theta * off))

    bags = {}
    for k, (channels, run) in enumerate([*RUNS.items(), ((), JOINT)]):
        log = raw_log(true, run, 40.0, options.seed + k)
        bags[channels] = imported(log, options.out / f"{run.name}.csv")

    config, fits = start, []
    for channels in RUNS:
        fits.append(fitted(bags[channels], config, channels))
        config = config.with_model(fits[-1].model)
        print(f"{' and '.join(channels)}: {'; '.join(fits[-1].notes) or 'fitted'}")
    configuration.dump(config, options.out / "fitted.yaml", "Fitted channel by channel.")

    with opened([bags[()]], start, jobs=1) as judge:
        errors = [open_loop_rmse(judge, c) for c in (start, config, true)]
        drawn = curves(judge, start, config)
    write_file(options.out / "report.html", page(together(fits, drawn)))
    (options.out / "joint.png").write_bytes(picture(drawn[0]))
    print("the joint run in open loop, RMSE before, after, and of the true vehicle:")
    for name, *rmse in zip(VELOCITIES, *errors, strict=True):
        print(f"  {name} {'  '.join(f'{x:.4f}' for x in rmse)}")
    wrong = np.abs(config.model.theta / true.model.theta - 1.0)
    print(f"coefficients: {100 * np.median(wrong):.1f} % off (median)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
