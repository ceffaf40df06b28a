"""Tail fins: from the angles of single fins to equivalent cross-tail angles, and back.

The span of fin i points outwards along ``e_i = (0, e_y, e_z)``. A positive angle turns the fin
about its span by the right-hand rule, so that its nose goes towards ``m_i = e_i x x``: that is
where the flow from ahead then pushes it. With the fin at x_f (negative: a tail) and ``rho`` off the
axis, the force per lift ``L`` and angle, and its moment ``r x F``, are::

    F_i = L m_i = L (0, e_z, -e_y)
    r x F = L (-rho (e_y^2 + e_z^2), x_f e_y, x_f e_z)

Every fin rolls alike, whatever its place; pitch goes with e_y, yaw with e_z. Hence the equivalents

    delta_s = sum(e_y delta_i) / sum(e_y^2)      pushes the tail up: Z < 0, and M < 0 (nose down)
    delta_r = sum(e_z delta_i) / sum(e_z^2)      pushes the tail to starboard: Y > 0, and N < 0
    delta_a = -mean(delta_i)                     rolls to starboard: K > 0

and the fins that make them, ``delta_i = e_y delta_s + e_z delta_r - delta_a``: with Prestero's
coefficients (Y_uudr > 0, N_uudr < 0, Z_uuds < 0, M_uuds < 0) these are his angles. In an X tail,
|e_y| = |e_z| = 1/sqrt(2), and the sums and differences are over sqrt(2).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rov_ident.core.messages import Array

_DIAGONAL = float(np.sqrt(0.5))


@dataclass(frozen=True)
class Tail:
    """Fins by name, each with the direction (e_y, e_z) of its span: starboard, down."""

    name: str
    spans: Mapping[str, tuple[float, float]]

    def to_equivalent(self, fins: Array) -> Array:
        """delta_s, delta_r, delta_a (..., 3) of fin angles (..., fins)."""
        spans = np.array(list(self.spans.values()))
        mixing = np.column_stack([spans, -np.ones(len(spans))])  # fin angles per delta
        return np.asarray(fins) @ (mixing / np.sum(mixing**2, axis=0))


CROSS = Tail(
    "cross",
    {"upper": (0.0, -1.0), "lower": (0.0, 1.0), "port": (-1.0, 0.0), "starboard": (1.0, 0.0)},
)
X = Tail(
    "x",
    {
        "ul": (-_DIAGONAL, -_DIAGONAL),  # upper left, seen from aft: port, up
        "ur": (_DIAGONAL, -_DIAGONAL),
        "ll": (-_DIAGONAL, _DIAGONAL),
        "lr": (_DIAGONAL, _DIAGONAL),
    },
)
