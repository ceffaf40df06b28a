"""`dashboard_node`, and `rov-ident dashboard`: the live page of all estimators that are heard."""

import asyncio
import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.signals import SignalHandlerOptions

from rov_ident.config import own
from rov_ident.dashboard.server import serving
from rov_ident.dashboard.store import Store
from rov_ident.errors import UserError
from rov_ident.nodes import parameters
from rov_ident.nodes.common import Executor
from rov_ident.nodes.watch_node import WatchNode

PORT = 8050
_LARGEST_PORT = 65535.0
_PARAMETERS = (
    own(
        "port", int, PORT, "port of the page on 127.0.0.1; 0: any that is free", lower=0.0,
        upper=_LARGEST_PORT,
    ),
    own(
        "foxglove_port", int, -1,
        "port for Foxglove on 127.0.0.1 (it asks for 8765); 0: any that is free, -1: none",
        lower=-1.0, upper=_LARGEST_PORT,
    ),
)  # fmt: skip

Announce = Callable[[Mapping[str, str]], None]
"""Is given the addresses: `page`, and `foxglove` where it is served."""


def dashboard(port: int, foxglove_port: int, announce: Announce) -> None:
    """Serve the page until interrupted (SIGINT, SIGTERM); ``announce`` is given the addresses.

    A negative ``foxglove_port``: no server for Foxglove.

    Raises
    ------
    UserError
        If a port is taken, or what is asked for is not installed.
    """
    _live([], lambda _: {"port": port, "foxglove_port": foxglove_port}, announce)


def main() -> int:
    """The node's whole life; 0 after an interrupt, 2 where the user can mend it."""
    try:
        _live(
            None,
            lambda node: parameters.declare_own(node, _PARAMETERS),
            lambda addresses: print(*addresses.values(), flush=True),
        )
    except UserError as error:
        print(f"dashboard_node: {error}", file=sys.stderr)
        return 2
    return 0


def _live(
    arguments: list[str] | None,
    settings: Callable[[WatchNode], Mapping[str, int]],
    announce: Announce,
) -> None:
    """Node and server from beginning to end; ``arguments`` None: those of the program."""
    context = Context()
    try:
        rclpy.init(args=arguments, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy gives its RCLError no public name
        raise UserError(str(error).partition(", at ")[0]) from error
    try:
        store = Store(time.monotonic)
        node = WatchNode(store, "dashboard", context)
        try:
            asyncio.run(_serve(node, store, announce=announce, **settings(node)))
        finally:
            node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)


async def _serve(
    node: WatchNode, store: Store, port: int, foxglove_port: int, announce: Announce
) -> None:
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    async with contextlib.AsyncExitStack() as stack:
        addresses = {"page": await stack.enter_async_context(serving(store, port))}
        if foxglove_port >= 0:
            from rov_ident.dashboard import foxglove as for_foxglove

            foxglove = await stack.enter_async_context(for_foxglove.serving(foxglove_port))
            node.forward = foxglove.forward
            addresses["foxglove"] = foxglove.address
        stack.enter_context(_hearing(node))
        announce(addresses)
        await ended.wait()


@contextlib.contextmanager
def _hearing(node: WatchNode) -> Iterator[Any]:
    """A thread of its own for the node."""
    executor = Executor(context=node.context)
    executor.add_node(node)
    over = threading.Event()

    def spin() -> None:
        with contextlib.suppress(ExternalShutdownException):
            while node.context.ok() and not over.is_set():
                executor.spin_once(timeout_sec=0.2)

    thread = threading.Thread(target=spin, name="ros")
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        executor.shutdown()


if __name__ == "__main__":
    sys.exit(main())
