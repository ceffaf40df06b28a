"""Who uses the coefficients: controllers in Python, parameters of other nodes, other simulators.
Estimates or configurations are given in others' terms; nothing is identified."""

from rov_ident.consumer.hydrodynamic_model import HydrodynamicModel, Taken

__all__ = ["HydrodynamicModel", "Taken"]
