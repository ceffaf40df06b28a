"""Matrices for the Marine Systems Simulator (Fossen and Perez) and other MATLAB code, as text.

A function file that returns a struct: ``MRB``, ``MA``, linear damping ``D`` and diagonal quadratic
damping ``Dn`` (positive for a hull), weight, buoyancy and their centres, forward-starboard-down.
"""

import re

import numpy as np

from rov_ident.config import Config
from rov_ident.consumer.formats.base import Written, diagonal, lost_besides, lost_terms
from rov_ident.model.coefficients import DIAGONAL, ONE

_KEYWORDS = (  # what iskeyword of MATLAB lists
    "break case catch classdef continue else elseif end for function global if otherwise parfor "
    "persistent return spmd switch try while"
).split()


def write(config: Config) -> Written:
    """``vehicle = NAME()`` with the fields above."""
    model, body = config.dynamics, config.dynamics.body
    values = config.model.values
    linear = [c for c in model.coefficients if c.left == ONE and not (c.is_one_sided or c.inputs)]
    held = {c.name for c in linear} | {c.name for c in model.coefficients if c.is_added_mass}
    lost = lost_terms(model.coefficients, held | set(DIAGONAL["quadratic"]))
    lost += lost_besides(config)
    name = re.sub(r"\W", "_", config.name, flags=re.ASCII)
    name = name if name[:1].isalpha() and name not in _KEYWORDS else f"vehicle_{name}"
    fields = {
        "m": [[body.mass]],
        "W": [[body.weight]],
        "B": [[body.buoyancy]],
        "rg": [[x] for x in body.cog],
        "rb": [[x] for x in body.cob],
        "MRB": body.mass_matrix,
        "MA": model.added_mass,
        "D": model.damping_matrix(np.zeros(6)),
        "Dn": np.diag(-np.array(diagonal(values, "quadratic"))),
    }
    lines = [
        f"function vehicle = {name}()",
        "% MRB*nu_dot + CRB(nu)*nu + MA*nur_dot + CA(nur)*nur + (D + Dn*diag(abs(nur)))*nur",
        "%   + g(eta) = tau;  W, B at rg, rb; SI; forward-starboard-down",
        *(f"vehicle.{key} = {_matrix(value)};" for key, value in fields.items()),
        "end",
    ]
    return Written("\n".join(lines) + "\n", tuple(lost))


def _matrix(value: object) -> str:
    rows = np.atleast_2d(np.asarray(value, dtype=float)) + 0.0
    text = "; ".join(" ".join(repr(float(x)) for x in row) for row in rows)
    return text if rows.size == 1 else f"[{text}]"
