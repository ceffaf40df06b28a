"""The nodes as programs, which end silently even if they are interrupted while starting.

Loading modules is half of a start: otherwise a launch file that is stopped at once would fill the
screen with a traceback of each of its nodes.
"""

from functools import partial
from importlib import import_module

from rov_ident.core.interrupts import end_at_once
from rov_ident.core.threads import limit_process


def _run(name: str, *arguments: str) -> int:
    end_at_once(0)
    limit_process()  # before numpy is loaded
    module = import_module(f"rov_ident.nodes.{name}")
    try:
        return int(module.main(*arguments))
    except KeyboardInterrupt:
        return 0


rls_node = partial(_run, "estimator_node", "rls")
ukf_node = partial(_run, "estimator_node", "ukf")
controller_bridge = partial(_run, "controller_bridge")
dashboard_node = partial(_run, "dashboard_node")
example_controller = partial(_run, "example_controller")
