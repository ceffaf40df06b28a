"""Headings between sparse samples: Archimedes spirals and cubic splines.

An Archimedes spiral through point A with start direction sigma (a segment of the paper's curve)::

    P(theta) = A + k theta [cos(sigma + rho theta), sin(sigma + rho theta)],   0 <= theta <= theta_e

It leaves A along sigma; the point at theta lies in the direction sigma + rho theta from A. It ends
in B where that direction is the chord's, alpha, and k theta_e the chord's length::

    theta_e = |alpha - sigma|,   rho = sign(alpha - sigma),   k = |AB| / theta_e

(the sign printed in the literature, of the cross product of the two position vectors, depends on
where time starts). The tangent there, from dP/dtheta, has the direction
``alpha + rho atan(theta_e)``: the curve overshoots the chord by as much as it had to turn, and the
next segment, which starts along it, has to turn back. Time and heading are mixed in one plane:
``scale`` says how many seconds a radian is drawn as, and the result depends on it.
"""

import numpy as np
from scipy.interpolate import CubicSpline

from rov_ident.core.errors import UserError
from rov_ident.core.frames import wrap_angle
from rov_ident.core.messages import Array

METHODS = ("none", "spline", "spiral")
_FINE = 200  # points of a spiral, between which time is inverted linearly


def densify(t: Array, heading: Array, at: Array, method: str, scale: float = 1.0) -> Array:
    """The heading (k,) at the instants ``at`` (k,) within t (n,) [s], from heading (n,) [rad].

    ``method`` is one of METHODS (`none`: straight lines); ``scale`` [s/rad] of the spiral's plane.

    Raises UserError for fewer than three samples, or an unknown method.
    """
    if len(t) < 3:
        raise UserError(f"{len(t)} headings cannot be densified: give at least 3")
    if method == "spline":
        return CubicSpline(t, heading, bc_type="not-a-knot" if len(t) > 3 else "natural")(at)
    if method == "spiral":
        return spiral(t, heading, at, scale)
    if method == "none":
        return np.interp(at, t, heading)
    raise UserError(f"there is no densification '{method}': choose one of {', '.join(METHODS)}")


def spiral(t: Array, heading: Array, at: Array, scale: float = 1.0) -> Array:
    """Archimedes-spiral segments from sample to sample, see the head of this module.

    Where a segment would turn back in time (its direction leaves the right half plane) there is no
    single heading for an instant: the first crossing of it counts.
    """
    out = np.empty(len(at))
    rows = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    direction = np.arctan2(scale * (heading[1] - heading[0]), t[1] - t[0])
    for i in range(len(t) - 1):
        dt, dy = t[i + 1] - t[i], scale * (heading[i + 1] - heading[i])
        chord = np.arctan2(dy, dt)
        turn = wrap_angle(chord - direction)
        inside = rows == i
        if inside.any():
            share = np.linspace(0.0, 1.0, _FINE)  # theta / theta_e
            angle = direction + share * turn
            reach = np.hypot(dt, dy) * share
            time = np.maximum.accumulate(reach * np.cos(angle))
            out[inside] = heading[i] + np.interp(
                at[inside] - t[i], time, reach * np.sin(angle) / scale
            )
        direction = chord + np.sign(turn) * np.arctan(abs(turn))
    return out
