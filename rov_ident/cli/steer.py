"""A simulated vehicle under its fins."""

import argparse
import math
from pathlib import Path

from rov_ident.cli import common
from rov_ident.core.errors import UserError
from rov_ident.core.files import write_file


def add(commands: common.Commands) -> None:
    text = "simulate a vehicle under its fins: zigzag, turn, heading change, dive"
    steer = common.command(commands, "steer", text, _steer, "--config --json")
    steer.add_argument(
        "--manoeuvre", required=True, choices=("zigzag", "turn", "heading", "dive", "waypoints"),
        help="what to steer",
    )  # fmt: skip
    steer.add_argument(
        "--angle", type=common.number, default=15.0,
        help="deg: of the rudder, or the course of heading (15)",
    )  # fmt: skip
    steer.add_argument("--switch", type=common.positive, help="deg, of a zigzag (as the rudder)")
    steer.add_argument("--depth", type=common.positive, default=5.0, help="m, of a dive (5)")
    steer.add_argument("--duration", type=common.positive, default=100.0, help="s (100)")
    steer.add_argument("--speed", type=common.positive, default=1.5, help="m/s (1.5)")
    steer.add_argument("--servo-rate", type=common.positive, default=20.0, help="deg/s (20)")
    steer.add_argument("--sample", type=common.positive, default=0.1, help="s between rows (0.1)")
    steer.add_argument("--noise", type=common.rate, default=0.0, help="deg, of the heading (0)")
    steer.add_argument("--seed", type=common.seed, default=0, help="of the noise (0)")
    steer.add_argument("--out", required=True, type=Path, metavar="CSV", help="log to write")


def _steer(options: argparse.Namespace) -> None:
    import numpy as np

    from rov_ident import config as configuration
    from rov_ident.steering import autopilot

    if not abs(options.angle) <= 180.0:
        raise UserError(f"--angle {options.angle:g}: give degrees from -180 to 180")
    config = configuration.load(options.config)
    run = autopilot.manoeuvre(
        config.dynamics,
        options.manoeuvre,
        math.radians(options.angle),
        math.radians(options.switch) if options.switch else None,
        options.depth,
        options.duration,
        options.speed,
        autopilot.Servo(rate=math.radians(options.servo_rate)),
        effects=config.effects,
    )
    noise = math.radians(options.noise)
    write_file(options.out, autopilot.to_csv(run, options.sample, noise, options.seed))
    heading = np.degrees(run.angles[:, 2])
    common.OUT.print(
        f"{options.manoeuvre}: heading from {heading.min():.1f} to {heading.max():.1f} deg, depth "
        f"at the end {run.position[-1, 2]:.2f} m, speed {run.nu[-1, 0]:.2f} m/s"
    )
    result = {
        "manoeuvre": options.manoeuvre,
        "heading_deg": [float(heading.min()), float(heading.max())],
        "depth_m": float(run.position[-1, 2]),
        "speed_mps": float(run.nu[-1, 0]),
    }
    common.write_json(options.json, result)
