"""The nodes as programs, which end silently even if they are interrupted while starting.

Loading modules is half of a start: otherwise a launch file that is stopped at once would fill the
screen with a traceback of each of its nodes.
"""

import os
import signal
from functools import partial
from importlib import import_module

from rov_ident.core.threads import limit_process

INTERRUPTS = (signal.SIGINT, signal.SIGTERM)


def end_at_once() -> None:
    """Have an interrupt end the process, until the node has handlers of its own.

    Not by an exception: some are caught where modules are loaded or objects finalised, and one that
    crosses a C++ library aborts the process. There is nothing to be tidied up yet: files are
    written whole or not at all, and compilers end with their parent.
    """
    for number in INTERRUPTS:
        signal.signal(number, lambda *_: os._exit(0))


def _run(name: str) -> int:
    end_at_once()
    limit_process()  # before numpy is loaded
    module = import_module(f"rov_ident.nodes.{name}")
    try:
        return int(module.main())
    except KeyboardInterrupt:
        return 0


rls_node = partial(_run, "rls_node")
ukf_node = partial(_run, "ukf_node")
controller_bridge = partial(_run, "controller_bridge")
dashboard_node = partial(_run, "dashboard_node")
example_controller = partial(_run, "example_controller")
