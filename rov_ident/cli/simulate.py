"""Open-loop simulation, of a manoeuvre or beside a bag."""

import argparse
import dataclasses
from pathlib import Path

from rov_ident.cli import common


def add(commands: common.Commands) -> None:
    text = "simulate open loop: a manoeuvre measured by simulated sensors, or a bag's wrench"
    simulate = common.command(commands, "simulate", text, _simulate, "--config --json", "bag")
    source = simulate.add_mutually_exclusive_group(required=True)
    source.add_argument("--bag", type=Path, help="drive by the wrench of this bag and compare")
    source.add_argument(
        "--manoeuvre",
        help="steps, multisine, single-axis, pilot or rest; under fins: waypoints, zigzag, turn, "
        "heading or dive",
    )
    simulate.add_argument(
        "--channels", metavar="surge,sway,...",
        help="with --bag: simulate these alone, the other velocities and the attitude as measured",
    )  # fmt: skip
    simulate.add_argument("--out", required=True, type=Path, metavar="BAG", help="bag to write")
    simulate.add_argument("--duration", type=common.positive, default=180.0, help="s (180)")
    simulate.add_argument("--seed", type=common.seed, default=0, help="of manoeuvre and noise (0)")
    simulate.add_argument("--odometry-rate", type=common.positive, default=20.0, help="Hz (20)")
    simulate.add_argument("--imu-rate", type=common.rate, default=100.0, help="Hz; 0: no IMU (100)")
    simulate.add_argument("--wrench-rate", type=common.positive, default=50.0, help="Hz (50)")
    simulate.add_argument("--noise", type=common.rate, default=1.0, help="factor on all noise (1)")
    simulate.add_argument(
        "--delay", type=common.rate, default=0.0, help="s until a message arrives (0)"
    )
    simulate.add_argument("--jitter", type=common.rate, default=0.0, help="s, of the delay (0)")
    simulate.add_argument(
        "--drop", type=common.share, default=0.0, help="share of messages lost (0)"
    )


def _simulate(options: argparse.Namespace) -> None:
    from rov_ident.api.simulation import simulate
    from rov_ident.core.files import write_file
    from rov_ident.io.write_messages import write_messages
    from rov_ident.simulation.virtual_sensors import Suite

    given = ("odometry_rate", "imu_rate", "wrench_rate", "delay", "jitter", "drop")
    suite = Suite().scaled(options.noise)
    suite = dataclasses.replace(suite, **{name: getattr(options, name) for name in given})
    with common.progress(options) as tell:
        run = simulate(
            options.config,
            bag=options.bag,
            manoeuvre=options.manoeuvre,
            channels=options.channels,
            duration=options.duration,
            sensors=None if suite == Suite() else suite,
            seed=options.seed,
            progress=tell,
        )
        tell("writing")
        write_messages(options.out, run.messages)
    if options.json:
        write_file(options.json, run.to_json())
    if options.bag:
        common.show(run, run.notes)
    else:
        counted = f"{options.out}: {len(run.messages)} messages, {options.duration:g} s"
        common.say(counted, *run.notes)
