"""The nodes as programs, which end without a word also when interrupted before they are up.

Half of a start is loading modules: a launch file that is stopped at once would fill the screen with
where each of its nodes was.
"""

import os
import signal
from importlib import import_module

INTERRUPTS = (signal.SIGINT, signal.SIGTERM)


def _run(name: str) -> int:
    # No exception: modules that are being loaded catch some, and nothing is open yet.
    for number in INTERRUPTS:
        signal.signal(number, lambda *_: os._exit(0))
    module = import_module(f"rov_ident.nodes.{name}")
    for number in INTERRUPTS:
        signal.signal(number, signal.default_int_handler)
    try:
        return int(module.main())
    except KeyboardInterrupt:
        return 0


def rls_node() -> int:
    return _run("rls_node")


def ukf_node() -> int:
    return _run("ukf_node")


def controller_bridge() -> int:
    return _run("controller_bridge")


def dashboard_node() -> int:
    return _run("dashboard_node")


def example_controller() -> int:
    return _run("example_controller")
