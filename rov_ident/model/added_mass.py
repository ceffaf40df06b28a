"""Added mass from dimensions, as coefficients (SNAME signs: negative), about the hull's middle.

Fore-aft and top-bottom symmetry leave the diagonal only.
"""

import math

from rov_ident.core.errors import UserError

WATER = 1025.0  # kg/m3, sea water


def cylinder(length: float, radius: float, rho: float = WATER) -> dict[str, float]:
    """A slender circular cylinder of length and radius [m]: strip theory.

    A tenth of the displaced mass in surge (as usual in the literature: the theory has none);
    ``Y_vdot = Z_wdot = -pi rho R^2 L``, ``M_qdot = N_rdot = -pi rho R^2 L^3 / 12``, no roll.

    Raises UserError if a dimension is not positive.
    """
    _check(length, radius, rho)
    mass = math.pi * rho * radius**2 * length
    turn = mass * length**2 / 12.0
    return {
        "X_udot": -0.1 * mass, "Y_vdot": -mass, "Z_wdot": -mass, "M_qdot": -turn, "N_rdot": -turn
    }  # fmt: skip


def spheroid(length: float, radius: float, rho: float = WATER) -> dict[str, float]:
    """A prolate spheroid of length 2a and radius b < a [m]: Lamb (1932), arts. 114, 115, exact.

    With the eccentricity e::

        l = ln((1 + e)/(1 - e))
        alpha = 2 (1 - e^2)/e^3 (l/2 - e),   beta = 1/e^2 - (1 - e^2)/(2 e^3) l
        k1 = alpha/(2 - alpha),   k2 = beta/(2 - beta)
        k' = e^4 (beta - alpha) / ((2 - e^2) (2 e^2 - (2 - e^2)(beta - alpha)))

    of the displaced mass (k1 along, k2 across) and of its moment of inertia m (a^2 + b^2)/5 (k').

    Raises UserError if a dimension is not positive, or the body is not longer than wide.
    """
    _check(length, radius, rho)
    a, b = 0.5 * length, radius
    if not b < a:
        raise UserError(
            f"a spheroid of length {length:g} and radius {radius:g} m is not slender: the length "
            "must exceed twice the radius"
        )
    mass = 4.0 / 3.0 * math.pi * rho * a * b**2
    e = math.sqrt(1.0 - (b / a) ** 2)
    logarithm = math.log((1.0 + e) / (1.0 - e))
    alpha = 2.0 * (1.0 - e**2) / e**3 * (0.5 * logarithm - e)
    beta = 1.0 / e**2 - (1.0 - e**2) / (2.0 * e**3) * logarithm
    k1, k2 = alpha / (2.0 - alpha), beta / (2.0 - beta)
    difference = beta - alpha
    k = e**4 * difference / ((2.0 - e**2) * (2.0 * e**2 - (2.0 - e**2) * difference))
    turn = k * mass * (a**2 + b**2) / 5.0
    return {
        "X_udot": -k1 * mass, "Y_vdot": -k2 * mass, "Z_wdot": -k2 * mass,
        "M_qdot": -turn, "N_rdot": -turn,
    }  # fmt: skip


HULLS = {"cylinder": cylinder, "spheroid": spheroid}


def parse_hull(text: str) -> dict[str, float]:
    """The added mass of `cylinder:L=1.6,R=0.1` or `spheroid:...`, maybe with `rho=`.

    Raises UserError for another form.
    """
    kind, _, rest = text.partition(":")
    names = {"L": "length", "R": "radius", "rho": "rho"}
    values: dict[str, float] = {}
    for part in rest.split(","):
        name, _, number = part.partition("=")
        try:
            values[names[name.strip()]] = float(number)
        except (KeyError, ValueError):
            values = {}
            break
    if kind not in HULLS or not {"length", "radius"} <= set(values):
        raise UserError(
            f"--hull {text}: give cylinder:L=LENGTH,R=RADIUS or spheroid:L=LENGTH,R=RADIUS in m"
        )
    return HULLS[kind](**values)


def _check(length: float, radius: float, rho: float) -> None:
    for name, value in (("length", length), ("radius", radius), ("rho", rho)):
        if not 0.0 < value < math.inf:
            raise UserError(f"the hull's {name} is {value:g}, but must be positive")
