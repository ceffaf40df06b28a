"""The parameter file of nodes and commands: its keys, and how it is read, checked and written.

Knows the model and the effects; nothing of messages, bags or ROS. A new key is one field in
`schema`.
"""

from rov_ident.config.reading import checked, from_parameters, load, thruster_signal
from rov_ident.config.schema import (
    ESTIMATOR_PARAMETERS,
    LARGEST,
    PARAMETERS,
    VEHICLE_PARAMETERS,
    Config,
    Fin,
    Inputs,
    Names,
    Parameter,
    Qos,
    Shaft,
    Thrusters,
    Vector,
)
from rov_ident.config.writing import as_file_name, dump, to_parameters

__all__ = ["ESTIMATOR_PARAMETERS", "LARGEST", "PARAMETERS", "VEHICLE_PARAMETERS", "Config", "Fin"]
__all__ += ["Inputs", "Names", "Parameter", "Qos", "Shaft", "Thrusters", "Vector", "as_file_name"]
__all__ += ["checked", "dump", "from_parameters", "load", "thruster_signal", "to_parameters"]
