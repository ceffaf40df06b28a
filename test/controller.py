"""A controller as others write it: a node with parameters. `controller.py MODE`, in a process."""

import contextlib
import sys
import time

import rclpy
from rcl_interfaces.msg import ParameterValue, SetParametersResult
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.node import Node

AT_FIRST = {"hydrodynamics.X_u": -10.0, "hydrodynamics.X_uu": -100.0}
LISTS = {
    "hydrodynamics.added_mass": [0.0] * 6,
    "hydrodynamics.linear_damping": [-10.0, 0.0, -20.0, 0.0, -0.5, 0.0],
    "hydrodynamics.quadratic_damping": [-100.0, -200.0, -150.0, -1.0, -0.4, -1.2],
}


class Strict(Node):
    """A usual one: takes sets whole; refuses a drag of more than 1000 N s2/m2."""

    def __init__(self, parameters):
        super().__init__("controller")
        for name, value in parameters.items():
            self.declare_parameter(name, value)
        self.add_on_set_parameters_callback(self._check)

    def _check(self, parameters):
        wild = [p.name for p in parameters if p.name.endswith("_uu") and p.value < -1000.0]
        return SetParametersResult(successful=not wild, reason=f"too much: {wild}" if wild else "")


class Sloppy(Node):
    """Without atomic sets. Of the first set it takes only one parameter, and takes its time."""

    def __init__(self, delay):
        super().__init__("controller", start_parameter_services=False)
        self._delay = delay
        self._values = dict(AT_FIRST)
        self.create_service(GetParameters, "~/get_parameters", self._get)
        self.create_service(ListParameters, "~/list_parameters", self._list)
        self.create_service(SetParameters, "~/set_parameters", self._set)
        self._sets = 0

    def _get(self, request, response):
        response.values = [
            ParameterValue(type=3, double_value=self._values[name]) for name in request.names
        ]
        return response

    def _list(self, _, response):
        response.result.names = list(self._values)
        return response

    def _set(self, request, response):
        self._sets += 1
        time.sleep(self._delay if self._sets == 1 else 0.0)
        for i, parameter in enumerate(request.parameters):
            taken = i == 0 or self._sets > 1
            if taken:
                self._values[parameter.name] = parameter.value.double_value
            response.results.append(
                SetParametersResult(successful=taken, reason="" if taken else "not this one")
            )
        return response


def main():
    rclpy.init()
    mode = sys.argv[1]
    nodes = {
        "usual": lambda: Strict(AT_FIRST),
        "lists": lambda: Strict(LISTS),
        "sloppy": lambda: Sloppy(0.0),
        "slow": lambda: Sloppy(2.0),
    }
    node = nodes[mode]()
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.spin(node)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
