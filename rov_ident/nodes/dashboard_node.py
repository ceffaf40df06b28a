"""`dashboard_node`, and `rov-ident dashboard`: the live page of all estimators on this network."""

import asyncio
import contextlib
import sys
import time
from collections.abc import Callable
from typing import Any

from rclpy.executors import ExternalShutdownException

from rov_ident.config import Parameter as Own
from rov_ident.core.errors import UserError
from rov_ident.core.interrupts import INTERRUPTS, end_at_once
from rov_ident.dashboard.server import serving
from rov_ident.dashboard.store import Store
from rov_ident.nodes import parameters
from rov_ident.nodes.watch_node import WatchNode, watching

_OWN = (
    Own("port", int, 8050, "port of the page on 127.0.0.1; 0: any that is free", lower=0.0,
        upper=65535.0),
)  # fmt: skip

Announce = Callable[[str], None]  # called with the address of the page


def dashboard(port: int, announce: Announce) -> None:
    """Serve the page until interrupted (SIGINT, SIGTERM).

    Raises UserError if the port is taken.
    """
    _live([], lambda _: port, announce)


def main() -> int:
    """The node's whole life; 0 after an interrupt, 2 for a wrong use."""
    try:
        _live(
            None,
            lambda node: parameters.declare_own(node, _OWN)["port"],
            lambda address: print(address, flush=True),
        )
    except UserError as error:
        print(f"dashboard_node: {error}", file=sys.stderr)
        return 2
    return 0


def _live(
    arguments: list[str] | None, port: Callable[[WatchNode], int], announce: Announce
) -> None:
    """Run node and server until the end; ``arguments`` None: those of the program."""
    end_at_once(0)  # a server may be ended at any time
    store = Store(time.monotonic)
    with watching(store, "dashboard", arguments) as (node, executor):
        asyncio.run(_serve(store, executor, port(node), announce))
        end_at_once(0)  # again: the server had handlers of its own


async def _serve(store: Store, executor: Any, port: int, announce: Announce) -> None:
    ended = asyncio.Event()
    for number in INTERRUPTS:
        asyncio.get_running_loop().add_signal_handler(number, ended.set)

    def spin() -> None:
        with contextlib.suppress(ExternalShutdownException):
            while executor.context.ok() and not ended.is_set():
                executor.spin_once(timeout_sec=0.2)

    async with serving(store, port) as address:
        hearing = asyncio.create_task(asyncio.to_thread(spin))
        announce(address)
        await ended.wait()
        await hearing
