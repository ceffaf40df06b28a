"""Names of the hydrodynamic coefficients: the grammar, and each name's place in the equations.

SNAME derivatives with their usual signs (SNAME 1950; Fossen 2021, ch. 6 and 8):

=============  ==========================================  ============================
name           term on the hydrodynamic side of the axis    example
=============  ==========================================  ============================
``A_bdot``     added mass, ``M = M_RB - sym(A_bdot)``       ``X_udot``, ``Y_rdot``
``A_b``        linear damping ``A_b b``                     ``X_u``, ``N_v``
``A_bb``       ``|b| b``, or ``b b`` where mirror symmetry  ``X_uu``; ``X_vv``, ``M_rr``
               makes the term even
``A_bc``       plain product ``b c``                        ``Y_uv``
``A_b_abs_c``  ``b |c|``                                    ``Y_v_abs_r``
``A_b_neg``    ``min(b, 0)``, added to ``A_b b``; only      ``Z_w_neg``
               where b is the axis's own velocity
``A_bb_neg``   ``|b| min(b, 0)``, added to ``A_bb |b| b``   ``Z_ww_neg``
``A_uudr``     fin ``u^2 dr``; with ``ds``, ``da`` alike;   ``N_uudr``, ``X_uudsds``
               ``A_uudrdr``: ``u^2 |dr| dr``, or plain
               square where even; ``A_udr``, ``A_dr``,
               ``A_nndr``: behind a propeller, where not
               u^2 decides
``A_nn``       propeller ``|n| n``; ``A_n``: ``n``;         ``X_nn``, ``K_nn``, ``X_un``
               ``A_un``: ``u n``, of the inflow
=============  ==========================================  ============================

A *term* is the product of two entries of the extended state: ``[1, nu, |nu|, min(nu, 0), u^2]``,
and behind these for each input x (fin angles, the propeller's speed of rotation) ``x, |x| x, x^2``.
So every coefficient but added mass is a row and two indices: simulator, regressor and Kalman filter
loop over one table, and a new name in the grammar needs no new equation.

A fin meets the flow at its own angle and at that of the motion there, ``delta + (v + x_f r) / u``:
its lift ``u^2 (delta + ...)`` has further terms ``u v`` and ``u r``. Hull and fins share these
(``Y_uv Y_ur N_uv N_ur``, ``Z_uw Z_uq M_uw M_uq``): no motion tells them apart.
"""

import re
from dataclasses import dataclass
from functools import cache

from rov_ident.core.errors import UserError

AXES = "XYZKMN"
VELOCITIES = "uvwpqr"
MOTIONS = ("surge", "sway", "heave", "roll", "pitch", "yaw")
WRENCH_UNITS = ("N",) * 3 + ("N m",) * 3  # of AXES

DIAGONAL = {
    "added_mass": tuple(f"{a}_{b}dot" for a, b in zip(AXES, VELOCITIES)),
    "linear": tuple(f"{a}_{b}" for a, b in zip(AXES, VELOCITIES)),
    "quadratic": tuple(f"{a}_{b}{b}" for a, b in zip(AXES, VELOCITIES)),
}
"""The eighteen coefficients of a hull without couplings, each kind in the order X Y Z K M N."""

# Even under port-starboard or up-down mirror symmetry, hence a plain square.
EVEN = frozenset("X_vv X_ww X_pp X_qq X_rr Z_uu Z_pp Z_rr M_uu M_pp M_rr".split())

INPUTS = ("delta_s", "delta_r", "delta_a", "n")
"""What drives a vehicle beside the thrusters' wrench: equivalent cross-tail angles [rad] of stern
planes, rudder and aileron (:mod:`rov_ident.model.fins`), the propeller's revolutions a second."""
FINS = INPUTS[:3]
INPUT_LETTERS = "sran"  # the inputs in the names of coefficients

# Places in the extended state [1, nu, |nu|, min(nu, 0), u^2, inputs] of equations.extend.
ONE = 0
PLAIN = 1
ABSOLUTE = 7
NEGATIVE = 13
SQUARE = 19
INPUT = 20  # x, |x| x, x^2 of the first input, and so on
EXTENDED_SIZE = INPUT + 3 * len(INPUTS)

_GRAMMAR = re.compile(
    r"(?P<axis>[XYZKMN])_(?P<first>[uvwpqr])"
    r"(?:(?P<dot>dot)|_abs_(?P<abs>[uvwpqr])|(?P<second>[uvwpqr])?(?P<neg>_neg)?)"
)

_INPUT_GRAMMAR = re.compile(
    r"(?P<axis>[XYZKMN])_(?:"
    r"(?P<speed>u{0,2}|nn)d(?P<fin>[sra])(?P<square>d(?P=fin))?|(?P<propeller>n|nn|un|nu))"
)
_FIN_EVEN = {"X": "sra", "Z": "ra", "M": "ra"}  # by the same symmetries as EVEN
_FIN_NAMES = {"s": "stern plane", "r": "rudder", "a": "aileron"}


@dataclass(frozen=True)
class Coefficient:
    """One coefficient: its place in the model, unit and meaning.

    ``row`` is the axis (0..5). For added mass ``column`` is the velocity it multiplies and
    ``left = right = -1``; otherwise the term is ``extended[left] * extended[right]``. ``right`` is
    a velocity, or an input. ``formula`` is what the coefficient multiplies.
    """

    name: str
    row: int
    column: int
    left: int
    right: int
    unit: str
    meaning: str
    formula: str

    @property
    def is_added_mass(self) -> bool:
        return self.left < 0

    @property
    def inputs(self) -> tuple[str, ...]:
        """Those of INPUTS that the term depends on."""
        places = {(i - INPUT) // 3: None for i in (self.left, self.right) if i >= INPUT}
        return tuple(INPUTS[place] for place in places)

    @property
    def is_diagonal(self) -> bool:
        """Of an axis's own motion (``X_udot``, ``X_u``, ``X_uu``): never positive for a hull."""
        if self.is_added_mass:
            return self.row == self.column
        own = PLAIN + self.row
        return (self.left, self.right) in ((ONE, own), (ABSOLUTE + self.row, own))

    @property
    def velocity(self) -> int:
        """The component of nu (0..5) in the second factor; of an input's term that of its axis."""
        return self.row if self.right >= INPUT else (self.right - PLAIN) % 6

    @property
    def motions(self) -> frozenset[int]:
        """Components of nu (0..5): that of its axis, and those that it multiplies."""
        if self.is_added_mass:
            return frozenset((self.row, self.column))
        factors = [i for i in (self.left, self.right) if PLAIN <= i < INPUT]
        return frozenset((self.row, *(0 if i == SQUARE else (i - PLAIN) % 6 for i in factors)))

    @property
    def is_one_sided(self) -> bool:
        """Acts only where the axis's own velocity is negative (``Z_ww_neg``)."""
        return NEGATIVE <= self.right < SQUARE

    @property
    def symmetric(self) -> str:
        """The name of the same term for both directions: ``Z_ww`` of ``Z_ww_neg``."""
        return self.name.removesuffix("_neg")

    @property
    def place(self) -> tuple[int, ...]:
        """Equal for two names of the same term (``Y_rdot``/``N_vdot``, ``Y_uv``/``Y_vu``)."""
        if self.is_added_mass:
            return (-1, min(self.row, self.column), max(self.row, self.column))
        return (self.row, min(self.left, self.right), max(self.left, self.right))


@cache
def parse(name: str) -> Coefficient:
    """The coefficient called ``name``.

    Raises UserError if the name is not in the grammar.
    """
    if (driven := parse_input(name)) is not None:
        return driven
    if name in ("T_n", "T_nn", "T_nu", "T_un"):
        raise UserError(
            f"'{name}' is written X_{name[2:]}: the propeller's thrust on the vehicle, less what "
            "the hull loses by its suction"
        )
    match = _GRAMMAR.fullmatch(name)
    if match is None:
        raise UserError(
            f"'{name}' is not a hydrodynamic coefficient: use names such as X_udot, X_u, X_uu, "
            "Y_uv or Y_v_abs_r (`rov-ident coefficients` prints them all)"
        )
    row = AXES.index(match["axis"])
    first = VELOCITIES.index(match["first"])
    force = "N" if row < 3 else "N m"
    axis = f"{'force' if row < 3 else 'moment'} {match['axis']}"
    b = match["first"]
    if match["dot"]:
        unit = ("kg", "kg m", "kg m2")[(row >= 3) + (first >= 3)]
        meaning = f"added mass: {axis} per d{b}/dt"
        return Coefficient(name, row, first, -1, -1, unit, meaning, f"d{b}/dt")
    if match["abs"]:
        second, c = VELOCITIES.index(match["abs"]), match["abs"]
        if first == second:
            square = f"{match['axis']}_{b}{b}"
            if square in EVEN:
                raise UserError(f"'{name}' is odd in {b}, but symmetry makes it {square} ({b}^2)")
            raise UserError(f"'{name}' is written {square}")
        left, right, formula = ABSOLUTE + second, PLAIN + first, f"{b} |{c}|"
    elif match["second"]:
        second, c = VELOCITIES.index(match["second"]), match["second"]
        if first != second:
            left, right, formula = PLAIN + first, PLAIN + second, f"{b} {c}"
        elif name in EVEN:
            left, right, formula = PLAIN + first, PLAIN + first, f"{b}^2"
        else:
            left, right, formula = ABSOLUTE + first, PLAIN + first, f"|{b}| {b}"
    else:
        second, left, right, formula = first, ONE, PLAIN + first, b
    if match["neg"]:
        if not first == second == row:
            own = VELOCITIES[row]
            raise UserError(
                f"'{name}': only an axis's own damping may differ for negative velocity, "
                f"{match['axis']}_{own}_neg or {match['axis']}_{own}{own}_neg"
            )
        right = NEGATIVE + first
        formula = formula.removesuffix(b) + f"min({b}, 0)"
    meaning = f"{'linear damping' if left == ONE else 'quadratic term'}: {axis} = {name} {formula}"
    order = [first] if left == ONE else [first, second]
    return Coefficient(name, row, first, left, right, _unit(force, order), meaning, formula)


@cache
def parse_input(name: str) -> Coefficient | None:
    """The coefficient of an input called ``name``; None for any other name."""
    match = _INPUT_GRAMMAR.fullmatch(name)
    if match is None:
        return None
    row, axis = AXES.index(match["axis"]), match["axis"]
    force, side = ("N", "force") if row < 3 else ("N m", "moment")
    n = INPUT + 3 * INPUT_LETTERS.index("n")
    if match["propeller"]:
        left, right, formula, unit = {
            "n": (ONE, n, "n", f"{force} s"),
            "nn": (ONE, n + 1, "|n| n", f"{force} s2"),
        }.get(match["propeller"], (PLAIN, n, "u n", f"{force} s2/m"))
        meaning = f"propeller: {side} {axis} = {name} {formula}, n in revolutions a second"
        return Coefficient(name, row, -1, left, right, unit, meaning, formula)
    fin, square = match["fin"], match["square"] is not None
    even = square and fin in _FIN_EVEN.get(axis, "")
    own = INPUT + 3 * INPUT_LETTERS.index(fin)
    left, factor, above, below = {
        "": (ONE, "", "", ""),
        "u": (PLAIN, "u ", "s", "m"),
        "uu": (SQUARE, "u^2 ", "s2", "m2"),
        "nn": (n + 1, "|n| n ", "s2", ""),
    }[match["speed"]]
    right = own + (0 if not square else 2 if even else 1)
    angle = f"d{fin}" if not square else f"d{fin}^2" if even else f"|d{fin}| d{fin}"
    formula = f"{factor}{angle}"
    radians = "rad2" if square else "rad"
    unit = f"{force} {above}".strip() + (f"/({below} {radians})" if below else f"/{radians}")
    meaning = f"fin ({_FIN_NAMES[fin]}): {side} {axis} = {name} {formula}"
    return Coefficient(name, row, -1, left, right, unit, meaning, formula)


def input_catalogue() -> list[Coefficient]:
    """Every coefficient of an input, one name a term."""
    names = [
        f"{axis}_{speed}d{fin}{square}"
        for speed in ("uu", "u", "", "nn")
        for axis in AXES
        for fin in "sra"
        for square in ("", f"d{fin}")
    ]
    names += [f"{axis}_{factor}" for factor in ("n", "nn", "un") for axis in AXES]
    return [c for name in names if (c := parse_input(name))]


def _unit(force: str, velocities: list[int]) -> str:
    """``force`` over the product of the velocities, e.g. ``N s2/m2``, ``N m s2/(m rad)``."""
    metres = sum(v < 3 for v in velocities)
    radians = len(velocities) - metres
    seconds = "s" if len(velocities) == 1 else f"s{len(velocities)}"
    below = [
        base if count == 1 else f"{base}{count}"
        for base, count in (("m", metres), ("rad", radians))
        if count
    ]
    return f"{force} {seconds}/" + (below[0] if len(below) == 1 else f"({' '.join(below)})")


def catalogue() -> list[Coefficient]:
    """Every coefficient of the vehicle's own motion, one name a term, by axis within kind."""
    names = [f"{a}_{b}dot" for a in AXES for b in VELOCITIES]
    names += [f"{a}_{b}" for a in AXES for b in VELOCITIES]
    names += [f"{a}_{b}{b}" for a in AXES for b in VELOCITIES]
    pairs = [(b, c) for i, b in enumerate(VELOCITIES) for c in VELOCITIES[i + 1 :]]
    names += [f"{a}_{b}{c}" for a in AXES for b, c in pairs]
    names += [f"{a}_{b}_abs_{c}" for a in AXES for b in VELOCITIES for c in VELOCITIES if b != c]
    own = list(zip(AXES, VELOCITIES, strict=True))
    names += [f"{a}_{b}_neg" for a, b in own] + [f"{a}_{b}{b}_neg" for a, b in own]
    unique: dict[tuple[int, ...], Coefficient] = {}
    for name in names:
        coefficient = parse(name)
        unique.setdefault(coefficient.place, coefficient)
    return list(unique.values())
