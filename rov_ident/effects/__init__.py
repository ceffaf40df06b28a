"""What a simulation may lack: one file an effect, found by being in this folder."""

from importlib import import_module
from pkgutil import iter_modules

from rov_ident.effects.base import Effect

EFFECTS: dict[str, Effect] = {
    module.name: import_module(f"{__name__}.{module.name}").EFFECT
    for module in iter_modules(__path__)
    if module.name != "base"
}
"""Every effect by the name users give it."""
