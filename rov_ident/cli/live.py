"""Looking at running nodes: in a browser, in the terminal, and in other programs."""

import argparse
import json
import re

from rov_ident.cli.common import ERR, OUT, Commands, command, folder, port, positive
from rov_ident.core.errors import UserError
from rov_ident.core.files import write_file


def add(commands: Commands) -> None:
    text = "a live page of the running nodes, for a browser on this computer"
    dashboard = command(commands, "dashboard", text, _dashboard)
    dashboard.add_argument("--port", type=port, default=8050, help="0: any that is free (8050)")
    dashboard.add_argument("--json", action="store_true", help="print the address as JSON")

    watch = command(commands, "watch", "a live table of the running nodes", _watch)
    watch.add_argument("--once", action="store_true", help="print what there is, and end")
    watch.add_argument(
        "--json", action="store_true", help="a line of JSON for each report, not a table"
    )
    watch.add_argument(
        "--wait", type=positive, default=10.0, metavar="S",
        help="with --once: for an estimator to be heard (10)",
    )  # fmt: skip

    text = "layouts of this vehicle's topics for Foxglove and PlotJuggler"
    layouts = command(
        commands, "layouts", text, _layouts, "--config", "foxglove.json plotjuggler.xml"
    )
    layouts.add_argument("--namespace", default="", help="of the nodes (none)")
    layouts.add_argument(
        "--out", required=True, type=folder, metavar="DIR",
        help="folder for foxglove.json and plotjuggler.xml",
    )  # fmt: skip


def _dashboard(options: argparse.Namespace) -> None:
    from rov_ident.nodes.dashboard_node import dashboard

    def announce(page: str) -> None:
        print(json.dumps({"page": page}) if options.json else f"page: {page}", flush=True)

    dashboard(options.port, announce)


def _watch(options: argparse.Namespace) -> None:
    from rov_ident.nodes.watch_terminal import watch, watch_once

    if options.once:
        watch_once(options.wait, options.json, OUT)
    else:
        watch(options.json, OUT, ERR)


def _layouts(options: argparse.Namespace) -> None:
    from rov_ident import config as configuration
    from rov_ident.dashboard import layouts

    if not re.fullmatch(r"(/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*)?/?", options.namespace, re.ASCII):
        raise UserError(f"{options.namespace!r} is no namespace of ROS 2, such as rov1")
    writers = {
        options.out / "foxglove.json": layouts.foxglove,
        options.out / "plotjuggler.xml": layouts.plotjuggler,
    }
    config = configuration.load(options.config)
    for path, write in writers.items():
        write_file(path, write(config, options.namespace))
