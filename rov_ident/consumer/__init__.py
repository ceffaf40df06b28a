"""Uses of the coefficients: controllers in Python, parameters of other nodes, other simulators.

Takes estimates or configurations and gives them in others' terms; identifies nothing.
"""

from rov_ident.consumer.hydrodynamic_model import HydrodynamicModel, Taken

__all__ = ["HydrodynamicModel", "Taken"]
