"""Coefficients from tables of forces."""

import argparse
from pathlib import Path

from rov_ident.cli import common
from rov_ident.core.errors import UserError
from rov_ident.core.files import write_file


def add(commands: common.Commands) -> None:
    text = "coefficients from CFD, towing-tank, rotating-arm or PMM tables"
    forces = common.command(commands, "forces", text, _forces, "--json --report")
    forces.add_argument("table", type=Path, metavar="TABLE.csv", help="velocities and forces")
    common.columns_option(forces, 'beta_deg="beta(deg)"')
    forces.add_argument(
        "--nondimensional", metavar="rho=,L=[,T=]",
        help="forces are over rho/2 U^2 L^2 (with T: L T), moments over L times that",
    )  # fmt: skip
    forces.add_argument(
        "--drift", choices=("auto", "starboard", "port"), default="auto",
        help="positive beta is a drift to starboard, v = U sin(beta), or to port (default: as a "
        "hull resists its motion)",
    )  # fmt: skip
    forces.add_argument(
        "--config", type=Path,
        help="the vehicle: the Coriolis forces of its added mass are not counted twice",
    )  # fmt: skip
    forces.add_argument(
        "--hull", metavar="cylinder:L=,R=",
        help="with --config: added mass of a cylinder or spheroid of length L, radius R [m], rho",
    )  # fmt: skip
    forces.add_argument(
        "--out", type=Path, metavar="CONFIG", help="write the vehicle with the fitted values"
    )


def _forces(options: argparse.Namespace) -> None:
    from rov_ident import config as configuration
    from rov_ident.io.csv_log import parse_columns
    from rov_ident.model.added_mass import parse_hull
    from rov_ident.offline import captive_tests as force_tables

    if not options.config and (options.out or options.hull):
        raise UserError("--out and --hull need --config: the vehicle's mass, inertia and buoyancy")
    config = configuration.load(options.config) if options.config else None
    if config and options.hull:
        config = force_tables.with_hull(config, parse_hull(options.hull))
    scale = options.nondimensional
    table = force_tables.read_table(
        options.table,
        parse_columns(options.map),
        force_tables.parse_nondimensional(scale) if scale else None,
        options.drift,
    )
    with common.progress(options) as tell:
        tell("fitting")
        fits = force_tables.fit(table, config.model if config else None)
    notes = (*table.notes, *force_tables.remarks(fits, config is not None))
    new = force_tables.configured(config, fits) if config and options.out else None
    if options.json:
        write_file(
            options.json,
            force_tables.to_json(fits, notes, table.not_understood, config is not None),
        )
    if options.report:
        from rov_ident.offline import captive_report

        write_file(options.report, captive_report.page(table.name, fits, notes))
    if new:
        configuration.dump(
            new, options.out, f"Coefficients from {options.table.name} by rov-ident forces."
        )
    common.OUT.print(force_tables.headline(fits))
    for axis, f in fits.items():
        common.OUT.print(f"{axis}: R2 {f.r2:.4f}, {f.why}")
    common.say(*notes)
