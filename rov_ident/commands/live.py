"""Looking at running nodes: in a browser, in the terminal, and in other programs."""

import argparse
import json
import re
from collections.abc import Mapping
from pathlib import Path

from rov_ident import config as configuration
from rov_ident.commands.common import CONFIG, ERR, OUT, Commands, port, positive
from rov_ident.errors import UserError


def add(commands: Commands) -> None:
    dashboard = commands.add_parser(
        "dashboard", help="a live page of the running nodes, for a browser on this computer"
    )
    dashboard.add_argument("--port", type=port, default=8050, help="0: any that is free (8050)")
    dashboard.add_argument(
        "--foxglove", type=port, nargs="?", const=8765, default=-1, metavar="PORT",
        help="serve Foxglove, too (8765)",
    )  # fmt: skip
    dashboard.add_argument(
        "--json", action="store_true", help="print the addresses as a line of JSON"
    )
    dashboard.set_defaults(run=_dashboard)

    watch = commands.add_parser("watch", help="a live table of the running nodes")
    watch.add_argument("--once", action="store_true", help="print what there is, and end")
    watch.add_argument(
        "--json", action="store_true", help="a line of JSON for each report, not a table"
    )
    watch.add_argument(
        "--wait", type=positive, default=10.0, metavar="S",
        help="with --once: for an estimator to be heard (10)",
    )  # fmt: skip
    watch.set_defaults(run=_watch)

    layouts = commands.add_parser(
        "layouts", help="layouts of this vehicle's topics for Foxglove and PlotJuggler"
    )
    layouts.add_argument("--config", required=True, type=Path, help=CONFIG)
    layouts.add_argument("--namespace", default="", help="of the nodes (none)")
    layouts.add_argument(
        "--out", required=True, type=Path, metavar="DIR",
        help="folder for foxglove.json and plotjuggler.xml",
    )  # fmt: skip
    layouts.set_defaults(run=_layouts)


def _dashboard(options: argparse.Namespace) -> None:
    from rov_ident.nodes.dashboard_node import dashboard

    def announce(addresses: Mapping[str, str]) -> None:
        if options.json:
            print(json.dumps(dict(addresses)), flush=True)
            return
        for what, address in addresses.items():
            OUT.print(f"{what}: {address}")

    dashboard(options.port, options.foxglove, announce)


def _watch(options: argparse.Namespace) -> None:
    from rov_ident.nodes.watch_terminal import watch, watch_once

    if options.once:
        watch_once(options.wait, options.json, OUT)
    else:
        watch(options.json, OUT, ERR)


def _layouts(options: argparse.Namespace) -> None:
    from rov_ident import layouts
    from rov_ident.fit import write_text

    if not re.fullmatch(r"(/?[A-Za-z_]\w*)*/?", options.namespace):
        raise UserError(f"{options.namespace!r} is no namespace of ROS 2, such as rov1")
    config = configuration.load(options.config)
    for name, write in (
        ("foxglove.json", layouts.foxglove),
        ("plotjuggler.xml", layouts.plotjuggler),
    ):
        write_text(options.out / name, write(config, options.namespace))
        ERR.print(f"written: {options.out / name}")
