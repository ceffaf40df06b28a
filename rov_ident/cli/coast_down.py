"""Thrust, drag and added mass in surge from step-ups and coast-downs."""

import argparse
import dataclasses
from pathlib import Path

from rov_ident.cli import common
from rov_ident.core.files import write_file


def add(commands: common.Commands) -> None:
    text = "thrust, drag and added mass in surge from step-ups and coast-downs"
    coast = common.command(commands, "coast-down", text, _coast_down, "--config --save --json")
    coast.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN.csv",
        help="t_s, shaft speed n held from each row on, measured surge speed u [m/s]",
    )  # fmt: skip
    common.columns_option(coast, "n=rpm")
    coast.add_argument(
        "--bollard", nargs=2, type=common.number, metavar=("N", "THRUST"),
        help="shaft speed and thrust [N] of a bollard pull, which gives the added mass (default: "
        "X_udot of the configuration)",
    )  # fmt: skip


def _coast_down(options: argparse.Namespace) -> None:
    from rov_ident import config as configuration
    from rov_ident.api.reading import once, several
    from rov_ident.config.prior import prior_of
    from rov_ident.io.csv_log import parse_columns
    from rov_ident.offline import coast_down
    from rov_ident.reports.result import provenance

    config = configuration.load(options.config)
    model = config.model
    columns = parse_columns(options.map)
    paths, repeated = once(several(options.runs))
    runs, digests = zip(*(coast_down.read_run(path, columns) for path in paths))
    anchor = {"bollard": options.bollard} if options.bollard else {}
    if not anchor and "X_udot" in model.names:
        (std,) = prior_of(dataclasses.replace(config, estimate=("X_udot",))).std
        anchor = {"added_mass": config.value("X_udot"), "added_mass_std": std}
    mass = model.body.mass
    anchor["mass_std"] = config.vehicle_uncertainty.mass_std * mass
    anchor |= {"current_std": config.current_std, "lag_std": config.wrench.lag_std}
    with common.progress(options) as tell:
        tell("fitting")
        found = coast_down.fit_coast_downs(runs, mass, **anchor)
    files = zip((path.name for path in paths), digests)
    made = provenance(files, vehicle=config.name)
    found = dataclasses.replace(found, provenance=made, notes=(*repeated, *found.notes))
    if options.json:
        write_file(options.json, found.to_json())
    if options.save:
        names = ", ".join(path.name for path in paths)
        comment = f"X_u, X_uu, X_udot from {names} by rov-ident coast-down."
        configuration.dump(coast_down.configured(config, found), options.save, comment)
    common.OUT.print(found.numbers("thrust k1 n + k2 |n| n, drag and added mass in surge"))
    common.say(f"speed RMSE {found.rmse:.3g} m/s", *found.notes)
