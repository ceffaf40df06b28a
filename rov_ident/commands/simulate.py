"""Open-loop simulation, of a manoeuvre or beside a bag."""

import argparse
import dataclasses
import math
from pathlib import Path

import numpy as np

from rov_ident import config as configuration
from rov_ident.commands.common import (
    CONFIG,
    ERR,
    OUT,
    Commands,
    channels,
    check_outputs,
    finite,
    json_option,
    new_table,
    positive,
    progress,
    rate,
    read_bag,
    seed,
    share,
    write_json,
)
from rov_ident.errors import UserError


def add(commands: Commands) -> None:
    simulate = commands.add_parser(
        "simulate",
        help="simulate open loop: a manoeuvre measured by simulated sensors, or a bag's wrench",
    )
    simulate.add_argument("--config", required=True, type=Path, help=CONFIG)
    source = simulate.add_mutually_exclusive_group(required=True)
    source.add_argument("--bag", type=Path, help="drive by the wrench of this bag and compare")
    source.add_argument("--manoeuvre", help="steps, multisine, single-axis, pilot or rest")
    simulate.add_argument(
        "--channels",
        type=channels,
        metavar="surge,sway,...",
        help="with --bag: simulate these alone, the other velocities and the attitude as measured",
    )
    simulate.add_argument("--out", required=True, type=Path, metavar="BAG", help="bag to write")
    simulate.add_argument("--duration", type=positive, default=180.0, help="s (180)")
    simulate.add_argument("--seed", type=seed, default=0, help="of manoeuvre and noise (0)")
    simulate.add_argument("--odometry-rate", type=positive, default=20.0, help="Hz (20)")
    simulate.add_argument("--imu-rate", type=rate, default=100.0, help="Hz; 0: no IMU (100)")
    simulate.add_argument("--wrench-rate", type=positive, default=50.0, help="Hz (50)")
    simulate.add_argument("--noise", type=rate, default=1.0, help="factor on all noise (1)")
    simulate.add_argument("--delay", type=rate, default=0.0, help="s until a message arrives (0)")
    simulate.add_argument("--jitter", type=rate, default=0.0, help="s, of the delay (0)")
    simulate.add_argument("--drop", type=share, default=0.0, help="share of messages lost (0)")
    json_option(simulate)
    simulate.set_defaults(run=_simulate)


def _simulate(options: argparse.Namespace) -> None:
    check_outputs([options.out, options.json], [options.bag, options.config])
    config = configuration.load(options.config)
    if options.bag:
        _compare(config, options)
        return
    from rov_ident.recording import write_messages
    from rov_ident.sensors import Suite, dive

    suite = dataclasses.replace(
        Suite().scaled(options.noise),
        odometry_rate=options.odometry_rate,
        imu_rate=options.imu_rate,
        wrench_rate=options.wrench_rate,
        delay=options.delay,
        jitter=options.jitter,
        drop=options.drop,
    )
    with progress(options) as tell:
        tell("simulating")
        run = dive(config, options.manoeuvre, options.duration, suite, options.seed)
        tell("writing")
        write_messages(options.out, run.messages)
    ERR.print(f"{options.out}: {len(run.messages)} messages, {options.duration:g} s")
    write_json(options.json, {"messages": len(run.messages), "duration_s": options.duration})


def _compare(config: configuration.Config, options: argparse.Namespace) -> None:
    """Open-loop simulation of a whole bag beside what it measured."""
    from rov_ident.effects import compiled
    from rov_ident.recording import write_messages
    from rov_ident.records import HORIZON, VELOCITIES, predicted, score
    from rov_ident.sensors import odometry_of

    free = options.channels
    model, effects = config.dynamics, compiled(config.effects)
    with progress(options) as tell:
        record = read_bag(options.bag, config, tell)
        tell("simulating")
        run = predicted(model, record.samples, math.inf, free, effects)
    if not np.isfinite(run).all():
        raise UserError(
            f"the simulation diverges on {options.bag}: check the signs and sizes of the "
            "coefficients and of the wrench"
        )
    write_messages(options.out, odometry_of(record.samples["t"], run))
    whole = score(model, record.samples, math.inf, free, effects)
    windows = score(model, record.samples, HORIZON, free, effects)
    chosen = [i for i in range(6) if free is None or free[i]]
    write_json(
        options.json,
        {
            "bag": options.bag.name,
            "horizon_s": HORIZON,
            "velocities": {
                VELOCITIES[i]: {
                    "r2": finite(whole.r2[i]),
                    "rmse": finite(whole.rmse[i]),
                    "rmse_windows": finite(windows.rmse[i]),
                    "unit": "m/s" if i < 3 else "rad/s",
                }
                for i in chosen
            },
        },
    )
    table = new_table(
        f"open-loop simulation against {options.bag.name}",
        "R2, one run", "RMSE, one run", f"RMSE, {HORIZON:g} s windows", "unit",
    )  # fmt: skip
    for i in chosen:
        table.add_row(
            VELOCITIES[i], f"{whole.r2[i]:.3f}", f"{whole.rmse[i]:.4f}", f"{windows.rmse[i]:.4f}",
            "m/s" if i < 3 else "rad/s",
        )  # fmt: skip
    OUT.print(table)
