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


def _run(name: str) -> int:
    # Not by an exception: modules that are being loaded catch some. Nothing is open yet.
    for number in INTERRUPTS:
        signal.signal(number, lambda *_: os._exit(0))
    limit_process()  # before numpy is loaded
    module = import_module(f"rov_ident.nodes.{name}")
    for number in INTERRUPTS:
        signal.signal(number, signal.default_int_handler)
    try:
        return int(module.main())
    except KeyboardInterrupt:
        return 0


rls_node = partial(_run, "rls_node")
ukf_node = partial(_run, "ukf_node")
controller_bridge = partial(_run, "controller_bridge")
dashboard_node = partial(_run, "dashboard_node")
example_controller = partial(_run, "example_controller")
