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
from rov_ident import plots, preprocess, swing
from rov_ident.archive import opened
from rov_ident.batch import Curves, Settings, curves, fit_batch, open_loop_rmse
from rov_ident.config import Config
from rov_ident.demo import shipped
from rov_ident.fit import Fit, write_text
from rov_ident.fit_report import page
from rov_ident.frames import quaternion_to_euler
from rov_ident.importer import import_csv
from rov_ident.messages import Array
from rov_ident.records import VELOCITIES
from rov_ident.result import provenance
from rov_ident.simulate import simulate
from rov_ident.swing import Course, Limits, Swing

DVL = np.array([0.15, 0.0, 0.1])  # m, from the body origin
PERIOD = 0.05  # s, of the log
IDLE = 8.0  # s before and after each run
STILL = (9.0, 9.0, 9.0, 9.0)

# The controller stays closed: alternating waypoints swing the thrusters between their limits.
RUNS = {
    ("surge",): Swing("surge", (1.0, 0.0, 0.0, 0.0), (3.0, *STILL[1:])),
    ("roll",): Swing("roll", (0.0, 0.0, 0.0, 0.0), STILL, (0.7, 0.0)),
    ("sway", "yaw"): Swing("lateral", (0.0, 1.0, 0.0, 0.9), (9.0, 3.3, 9.0, 2.7)),
    ("heave", "pitch"): Swing("longitudinal", (0.0, 0.0, 0.7, 0.0), (9.0, 9.0, 3.7, 9.0), (0, 0.7)),
}
# Ahead slowly, then fast, a turn to starboard at speed, one back to port, and slowly on. Sharper
# turns make a vehicle with a centimetre between its centres roll and pitch away in open loop: the
# Munk moments of the sway are stronger than its restoring moments.
JOINT = Course(
    "joint", ((8.0, 0.3, 0.0), (10.0, 0.6, 0.0), (10.0, 0.6, 0.6), (8.0, 0.4, 0.1), (4.0, 0.2, 0.1))
)


@dataclasses.dataclass(frozen=True)
class Log:
    """What the vehicle's computers wrote, on one clock: rows (N,) and depths from three sources."""

    t: Array
    velocity: Array  # (N, 3) m/s, of the DVL where it is mounted
    omega: Array  # (N, 3) rad/s
    angles: Array  # (N, 3) rad, roll pitch yaw
    wrench: Array  # (N, 6) demanded from each row to the next
    depth: list[preprocess.Source]


def raw_log(vehicle: Config, run: Swing | Course, duration: float, seed: int) -> Log:
    """A run of the true vehicle as its sensors see it, with outliers, levers and idle minutes."""
    rng = np.random.default_rng(seed)
    flown = swing.fly(vehicle, run, duration, Limits())
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

    def depth(name: str, every: int, std: float, bias: float, bias_std: float) -> preprocess.Source:
        z = truth.position[rows][::every, 2]
        return preprocess.Source(
            name, t[::every], z + bias + std * rng.standard_normal(len(z)), std, bias_std
        )

    sources = [
        depth("pressure", 4, 0.03, 0.0, 0.0),
        depth("inertial", 2, 0.02, 0.4, 0.5),
        depth("tracking", 20, 0.3, 0.0, 0.1),
    ]
    return Log(
        t,
        velocity,
        nu[:, 3:] + 0.003 * rng.standard_normal((n, 3)),
        angles + 0.002 * rng.standard_normal((n, 3)),
        wrench,
        sources,
    )


def prepared(log: Log, path: Path) -> str:
    """Cut, cleaned and brought to the origin, as a CSV file for `rov-ident import`; in words."""
    trim = np.median(log.wrench[log.t < 0.5 * IDLE], axis=0)
    effort = np.abs(log.wrench - trim)
    effort = (effort / np.maximum(effort.max(axis=0), 1e-9)).max(axis=1)
    begin, end = preprocess.dynamic_stretch(log.t, effort, margin=3.0)
    velocity, bad = preprocess.without_outliers(log.velocity)
    # No smoothing: the noise is in the model of maximum likelihood, and smoothing would hide it.
    velocity = preprocess.velocity_at_origin(velocity, log.omega, DVL)
    depth = preprocess.fused(log.depth, log.t)
    keep = (log.t >= begin) & (log.t <= end)
    columns = np.column_stack(
        [log.t, velocity, log.omega, log.wrench, 0.0 * log.t, 0.0 * log.t, depth.value, log.angles]
    )[keep]
    head = "t_s,u,v,w,p,q,r,X,Y,Z,K,M,N,x,y,z,roll,pitch,yaw"
    np.savetxt(path, columns, "%.9g", ",", header=head, comments="")
    return (
        f"{path.stem}: {begin:.0f} to {end:.0f} s of {log.t[-1]:.0f}, "
        f"{np.count_nonzero(bad.any(axis=1))} outliers, depth to {1e3 * np.median(depth.std):.0f} "
        f"mm, the inertial one {depth.bias['inertial']:+.2f} m off"
    )


def fitted(bag: Path, config: Config, channels: tuple[str, ...]) -> Fit:
    with opened([bag], config, jobs=1) as bags:
        return fit_batch(bags, config, "ml", Settings((channels,)))


def together(fits: list[Fit]) -> Fit:
    """One result of fits in a row: of each, the coefficients that its run could tell."""
    covariance = fits[0].covariance.copy()
    for fit in fits[1:]:
        known = np.flatnonzero(fit.identifiable)
        covariance[np.ix_(known, known)] = fit.covariance[np.ix_(known, known)]
    return dataclasses.replace(
        fits[-1],
        covariance=covariance,
        identifiable=tuple(any(known) for known in zip(*(fit.identifiable for fit in fits))),
        notes=tuple(note for fit in fits for note in fit.notes),
        duration=sum(fit.duration for fit in fits),
        provenance=provenance(
            (bag["file"], bag["sha256"]) for fit in fits for bag in fit.provenance["bags"]
        ),
    )


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
    off = np.random.default_rng(options.seed).uniform(0.6, 1.4, len(true.model.theta))
    start = true.with_model(true.model.with_theta(true.model.theta * off))

    bags = {}
    for k, (channels, run) in enumerate([*RUNS.items(), ((), JOINT)]):
        table = options.out / f"{run.name}.csv"
        print(prepared(raw_log(true, run, 40.0, options.seed + k), table))
        bags[channels] = table.with_suffix(".mcap")
        import_csv([table], bags[channels])

    config, fits = start, []
    for channels in RUNS:
        fits.append(fitted(bags[channels], config, channels))
        config = config.with_model(fits[-1].model)
        print(f"{' and '.join(channels)}: {'; '.join(fits[-1].notes) or 'fitted'}")
    configuration.dump(config, options.out / "fitted.yaml", "Fitted channel by channel.")

    with opened([bags[()]], start, jobs=1) as judge:
        errors = [open_loop_rmse(judge, c) for c in (start, config, true)]
        drawn = curves(judge, start, config)
    write_text(options.out / "report.html", page(together(fits), start, [], drawn))
    (options.out / "joint.png").write_bytes(picture(drawn[0]))
    print("the joint run in open loop, RMSE before, after, and of the true vehicle:")
    for name, *rmse in zip(VELOCITIES, *errors, strict=True):
        print(f"  {name} {'  '.join(f'{x:.4f}' for x in rmse)}")
    wrong = np.abs(config.model.theta / true.model.theta - 1.0)
    print(f"coefficients: {100 * np.median(wrong):.1f} % off (median)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
