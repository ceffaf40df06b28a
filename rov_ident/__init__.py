"""Identify the hydrodynamic coefficients of a marine vehicle while it moves, and from its records.

    import rov_ident as ri

    fit = ri.fit("dive.mcap", "bluerov2_heavy.yaml")
    print(fit)

What is listed here is public, with `rov_ident.config` and `rov_ident.consumer`; the rest is
private (ARCHITECTURE.md shows its rooms). Nothing is loaded before it is used, and importing
changes nothing in the caller's process.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rov_ident.api.comparison import Comparison as Comparison
    from rov_ident.api.comparison import compare as compare
    from rov_ident.api.functions import check as check
    from rov_ident.api.functions import explain as explain
    from rov_ident.api.functions import fit as fit
    from rov_ident.api.functions import plan as plan
    from rov_ident.api.identification import Identification as Identification
    from rov_ident.api.identification import identify as identify
    from rov_ident.api.reading import coefficients as coefficients
    from rov_ident.api.reading import load as load
    from rov_ident.api.reading import read as read
    from rov_ident.api.simulation import Simulation as Simulation
    from rov_ident.api.simulation import simulate as simulate
    from rov_ident.api.start import Draft as Draft
    from rov_ident.api.start import init as init
    from rov_ident.config import Config as Config
    from rov_ident.consumer import HydrodynamicModel as HydrodynamicModel
    from rov_ident.core.errors import UserError as UserError
    from rov_ident.core.messages import Imu as Imu
    from rov_ident.core.messages import Odometry as Odometry
    from rov_ident.core.messages import Wrench as Wrench
    from rov_ident.discrepancy.explain import Explanation as Explanation
    from rov_ident.effects import EFFECTS as EFFECTS
    from rov_ident.estimation.online import OnlineEstimator as OnlineEstimator
    from rov_ident.estimation.online import Report as Report
    from rov_ident.experiment.data_quality import Check as Check
    from rov_ident.experiment.design import Proposal as Proposal
    from rov_ident.model.equations import Model as Model
    from rov_ident.offline.fit import Fit as Fit
    from rov_ident.sampling.records import Record as Record
    from rov_ident.simulation.virtual_sensors import Suite as Suite

    __version__: str

_PLACES = {
    "api.comparison": "Comparison compare",
    "api.functions": "check explain fit plan",
    "api.identification": "Identification identify",
    "api.reading": "coefficients load read",
    "api.simulation": "Simulation simulate",
    "api.start": "Draft init",
    "config": "Config",
    "consumer": "HydrodynamicModel",
    "core.errors": "UserError",
    "core.messages": "Imu Odometry Wrench",
    "discrepancy.explain": "Explanation",
    "effects": "EFFECTS",
    "estimation.online": "OnlineEstimator Report",
    "experiment.data_quality": "Check",
    "experiment.design": "Proposal",
    "model.equations": "Model",
    "offline.fit": "Fit",
    "sampling.records": "Record",
    "simulation.virtual_sensors": "Suite",
}
_PUBLIC = {name: place for place, names in _PLACES.items() for name in names.split()}
_MODULES = ("config", "consumer")

__all__ = [*_PUBLIC, "__version__"]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        value: Any = getattr(import_module(f"rov_ident.{_PUBLIC[name]}"), name)
    elif name in _MODULES:
        return import_module(f"rov_ident.{name}")
    elif name == "__version__":
        from importlib.metadata import version

        value = version("rov_ident")
    else:
        raise AttributeError(f"module 'rov_ident' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES])
