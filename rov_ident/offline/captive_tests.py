"""Coefficients from tables of steady forces: CFD, towing tank, rotating arm, PMM.

Every row is a state (velocities, fin angles) and the forces and moments on the vehicle in it. On
each axis the terms of the grammar that the table excites are candidates. Structures are grown term
by term and refined by exchange, each judged by leave-one-out cross-validation, exactly, from the
projection ``h`` of least squares: ``e_i / (1 - h_i)``. Chosen is the smallest whose squared error
exceeds the best's by less than two standard errors of the difference, row by row paired. (A term
that acts on a few rows alone makes that standard error large by itself; if clearly seen, it is
kept.)

Repeated runs of a condition are averaged first: they share what is wrong with it (setting, mesh),
so that as separate rows they would vouch for one another.

Intervals allow for noise that grows with the force: heteroscedastic covariance HC3 (MacKinnon and
White 1985), Student's distribution; and for the choice of the structure. Steady forces hold the
Coriolis forces of the added mass (Munk's moment and its kind): with ``added_mass`` they are taken
off first, or a model would count them twice.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

from rov_ident.config import Config
from rov_ident.core.errors import UserError
from rov_ident.core.linalg import sandwich, scaled_inverse, widened
from rov_ident.core.messages import Array
from rov_ident.io.csv_table import CsvTable, read_csv
from rov_ident.model.coefficients import AXES, INPUT_LETTERS, VELOCITIES, WRENCH_UNITS, parse
from rov_ident.model.equations import Model, build, coriolis, extended_states
from rov_ident.model.fins import CROSS, X
from rov_ident.reports.result import Result, as_json, provenance
from rov_ident.reports.table import PLUS_MINUS, Table

_FIN_COLUMNS = {
    "r": ("rudder", "delta_r", "dr", "deltar", "delta"),
    "s": ("stern", "stern_plane", "delta_s", "ds", "deltas", "elevator", "delta_e", "de"),
    "a": ("aileron", "delta_a", "da", "deltaa"),
}
_SLOWEST = 1e-6  # m/s; below it is a zero that was rounded
_FASTEST = 2.0 * math.pi  # rad/s; a turn a second: beyond it are degrees
_MOST_ROWS = 100_000  # a guard: a hundred candidate columns take 80 MB
_ALIKE = 0.995  # cosine between two columns, which then inflate each other's variance a hundredfold
_CONDITION = 100.0  # of a structure's scaled columns: beyond it collinearity ruins a fit (Belsley,
# Kuh and Welsch 1980, sec. 3.2)
_ROWS_PER_TERM = 3  # conditions, so that two of three are left to judge by
_FEWEST = 2 * _ROWS_PER_TERM  # conditions: with one term there is nothing to choose from
_PATIENCE = 3  # a choice: sizes without a better cross-validation until structures grow no further
_SHOWN = 20  # candidates, beside the chosen: a screenful
_WORTH = 2.0  # standard errors, which chance exceeds one time in forty
_FAR = 12.0  # median errors: eight standard deviations (0.674 each) of a normal distribution
_LIGHT = 1e-3  # weight of a structure, the best one's being 1, which changes no standard deviation
_SLIP = 0.5  # share of the force: its noise is less, a slip of sign or unit makes more
_UNLIKE = 0.25  # of the force (RMS); runs of a condition repeat to a few percent, poor ones to ten
_DOUBT = 12.0  # of a term, in mean squared errors over the rows: beyond |t| of about five


@dataclass(frozen=True)
class ForceTable:
    """States nu (n, 6), fin angles {letter: (n,)} [rad], forces {axis letter: (n,)} [N, N m]; and
    the headings of the file that say nothing to us."""

    name: str
    nu: Array
    fins: Mapping[str, Array]
    forces: Mapping[str, Array]
    notes: tuple[str, ...] = ()
    sha256: str = ""
    not_understood: tuple[str, ...] = ()  # headings


@dataclass(frozen=True)
class Candidate:
    """A structure that was tried, and its error in cross-validation."""

    terms: tuple[str, ...]
    cv_rmse: float


@dataclass(frozen=True, kw_only=True)
class AxisFit(Result):
    """The structure chosen on an axis, its values, and why this one."""

    axis: str
    cv_rmse: float
    rmse: float
    r2: float
    candidates: tuple[Candidate, ...]
    why: str
    pool: tuple[str, ...]
    left_out: Mapping[str, Array] = field(default_factory=dict)
    """By term that the table moves and the structure lacks: by how much each value (n,) would be
    less per unit of it (the regression of its column on those of the structure)."""
    aliases: Mapping[str, str] = field(default_factory=dict)
    unlike: float = 0.0
    """Standard deviation of repeated runs of a condition, over the force (RMS)."""
    measured: Array = field(default_factory=lambda: np.zeros(0))
    fitted: Array = field(default_factory=lambda: np.zeros(0))


def parse_nondimensional(text: str) -> dict[str, float]:
    """`rho=1000,L=7,T=0.46` as numbers.

    Raises UserError: another form, a missing rho or L, or a value that is not positive.
    """
    values = {}
    for part in text.split(","):
        name, _, number = (piece.strip() for piece in part.partition("="))
        try:
            values[name] = float(number)
        except ValueError:
            values[name] = math.nan
        if name not in ("rho", "L", "T") or not values[name] > 0.0:
            raise UserError(
                f"--nondimensional {text}: give rho=DENSITY,L=LENGTH and, where areas are L T, "
                "T=DRAUGHT, all positive"
            )
    for name in ("rho", "L"):
        if name not in values:
            raise UserError(f"--nondimensional {text} lacks {name}: give rho=DENSITY,L=LENGTH")
    return values


def read_table(
    path: Path,
    columns: Mapping[str, str] | None = None,
    nondimensional: Mapping[str, float] | None = None,
    drift: str = "auto",
) -> ForceTable:
    """A CSV of states and forces; ``columns`` maps our names to its headings.

    States: `u v w p q r` (m/s, rad/s), or `U_mps` with `alpha_deg|rad`, `beta_deg|rad`, and a
    turning radius `R_m` (r = U / R; empty: straight on). Fins: `rudder_deg`, `stern_deg`,
    `aileron_deg` (or `delta_r_deg` ...; or `_rad`), the fins of an X tail `ul ur ll lr` or a cross
    tail `upper lower port starboard`. Forces: `X Y Z K M N`; with ``nondimensional`` also
    `X'` ..., and the rates `p' q' r'` over U / L.

    ``drift`` says what a positive beta (and alpha) means: `starboard` v = U sin(beta) (Fossen),
    `port` v = -U sin(beta) (SNAME, towing tanks), `auto`: as a hull resists its motion.

    Raises UserError: columns that lack, are constant, ambiguous, or in another unit than they say.
    """
    table = read_csv(path)
    if len(table.lines) > _MOST_ROWS:
        raise UserError(f"{path} has {len(table.lines)} rows: thin it to {_MOST_ROWS}")
    reader = _Reader(table, dict(columns or {}))
    notes: list[str] = []
    nu, speed = _states(reader, drift, nondimensional)
    fins = _fins(reader)
    reader.refuse_likely()
    forces = _forces(reader, speed, nondimensional)
    if np.ptp(np.column_stack([nu, *fins.values()]), axis=0).max() < 1e-12:
        raise UserError(
            f"{path}: every row is the same condition: vary speed, drift, turning or fin angles"
        )
    if drift == "auto" and reader.has_flow:
        nu = _with_resisting_signs(nu, fins, forces, notes)
    unused = tuple(heading for heading in table.cells if heading not in reader.used)
    if unused:
        notes.insert(
            0, f"headings not understood, columns left out (--map names them): {', '.join(unused)}"
        )
    return ForceTable(path.name, nu, fins, forces, tuple(notes), table.sha256, unused)


class _Reader:
    """Columns in our names, remembering which headings were used."""

    def __init__(self, table: CsvTable, columns: dict[str, str]) -> None:
        self.table, self.columns = table, columns
        self.used: set[str] = set()
        self.has_flow = False
        for name, heading in columns.items():
            if heading not in table.cells:
                raise UserError(
                    f"{table.path} has no column `{heading}` for {name}: it has "
                    f"{', '.join(table.cells)}"
                )
            if (unit := _in_other_unit(heading)) and not name.endswith(("_deg", "_rad")):
                raise UserError(
                    f"{table.path}: `{heading}` seems to be in {unit}, but {name} is read in SI "
                    "units: convert the column, and rename it"
                )
            if name in ("p", "q", "r") and heading.endswith("'"):
                raise UserError(
                    f"{table.path}: `{heading}` looks non-dimensional, but {name} is read in "
                    f"rad/s: map it to {name}'"
                )

    def column(self, name: str, blank: bool = False) -> Array | None:
        heading = self.columns.get(name, name)
        if heading not in self.table.cells:
            return None
        self.used.add(heading)
        return self.table.numbers(heading, blank)

    def angle(self, name: str) -> Array | None:
        """A column `name_rad` or `name_deg` in radians; None where there is neither."""
        path, bare = self.table.path, self.columns.get(name, name)
        found = {unit: self.column(f"{name}_{unit}") for unit in ("rad", "deg")}
        given = {unit: values for unit, values in found.items() if values is not None}
        if not given:
            if bare in self.table.cells:
                raise UserError(
                    f"{path}: is the column `{bare}` in degrees or radians? Say so with "
                    f'--map {name}_deg="{bare}" or {name}_rad="{bare}"'
                )
            return None
        if len(given) == 2:
            raise UserError(f"{path} has both {name}_rad and {name}_deg: remove one of them")
        ((unit, values),) = given.items()
        largest = float(np.abs(values).max())
        if unit == "rad" and largest > 0.5 * math.pi + 0.1:
            raise UserError(
                f"{path}: {name}_rad reaches {largest:g}, which looks like degrees: "
                f"name the column {name}_deg if it is"
            )
        if unit == "deg" and 0.0 < largest < 1.0:
            raise UserError(
                f"{path}: {name}_deg never exceeds {largest:.3g}, which looks like "
                f"radians: name the column {name}_rad if it is"
            )
        return values if unit == "rad" else np.radians(values)

    def refuse_likely(self) -> None:
        """Once states and fins are read.

        Raises UserError if a heading that was not used looks like a speed or an angle that varies
        and is not given otherwise: without it the forces would be laid to something else.
        """
        for heading in self.table.cells:
            if heading in self.used or self._is_constant(heading):
                continue
            name = _guessed_name(heading)
            if (
                name
                and not {self.columns.get(n, n) for n in (name, *_SAME.get(name, ()))} & self.used
            ):
                raise UserError(
                    f"{self.table.path}: the heading `{heading}` is not understood, and looks like "
                    f'{name}: say so with --map {name}="{heading}", or remove the column'
                )
            if heading.endswith(("_deg", "_rad")) and not name:
                raise UserError(
                    f"{self.table.path}: the angle `{heading}` is not known here: name it with "
                    f"--map rudder_{heading[-3:]}={heading} (or stern, aileron, alpha, beta), or "
                    "remove the column"
                )

    def _is_constant(self, heading: str) -> bool:
        """Also where a cell is no number: then it is a remark."""
        try:
            return float(np.ptp(self.table.numbers(heading))) == 0.0
        except UserError:
            return True


# By our name, other names of ours that say the same.
_SAME = {
    "U_mps": ("u",),
    **{f"beta_{unit}": ("v", "beta_deg", "beta_rad") for unit in ("deg", "rad")},
    **{f"alpha_{unit}": ("w", "alpha_deg", "alpha_rad") for unit in ("deg", "rad")},
    "r": ("R_m", "radius_m", "r'"),
    **{
        f"{names[0]}_{unit}": tuple(f"{name}_{u}" for name in names for u in ("deg", "rad"))
        for names in _FIN_COLUMNS.values()
        for unit in ("deg", "rad")
    },
}
_WORDS = {
    **dict.fromkeys(("speed", "velocity", "vel", "towing speed"), "U_mps"),
    **dict.fromkeys(("beta", "drift", "drift angle", "sideslip"), "beta"),
    **dict.fromkeys(("alpha", "angle of attack", "aoa"), "alpha"),
    **dict.fromkeys(("yaw rate", "r"), "r"),
    **{name: name for name in "uvwpq"},
    **{name.replace("_", " "): names[0] for names in _FIN_COLUMNS.values() for name in names},
}


_OTHER_UNIT = re.compile(
    r"[(\[](k[tn]s?|knots|km/?h|ft/s|mph|[mc]m/s|[km]n\W?m?|lbf|kgf|deg/s)[)\]]"
)


def _in_other_unit(heading: str) -> str:
    """The unit in the brackets of a heading such as `X [kN]`, if it is a usual one but not SI."""
    found = _OTHER_UNIT.search(heading.lower())
    return heading[slice(*found.span(1))] if found else ""


def _guessed_name(heading: str) -> str:
    """What a heading such as `beta(deg)` or `Speed [m/s]` may be in our names, if anything."""
    bare, _, unit = re.sub(r"[(\[\]),/ _-]+", " ", heading.lower()).strip().partition(" ")
    words = f"{bare} {unit}".split()
    known = "deg" if {"deg", "degrees", "degree"} & set(words) else "rad"
    while words and words[-1] in ("deg", "degrees", "degree", "rad", "m", "s", "mps", "angle"):
        words.pop()
    name = _WORDS.get(" ".join(words), "")
    angular = name in ("alpha", "beta") or name in {names[0] for names in _FIN_COLUMNS.values()}
    if name in ("p", "q", "r") and known == "deg":
        return ""  # degrees a second, which are not read
    return f"{name}_{known}" if angular else name


def _states(
    reader: _Reader, drift: str, nondimensional: Mapping[str, float] | None
) -> tuple[Array, Array]:
    """nu (n, 6) and the speed (n,)."""
    n, path = len(reader.table.lines), reader.table.path
    direct = {name: x for name in VELOCITIES if (x := reader.column(name)) is not None}
    flow = {name: x for name in ("alpha", "beta") if (x := reader.angle(name)) is not None}
    total = reader.column("U_mps")
    nu = np.zeros((n, 6))
    for name, values in direct.items():
        nu[:, VELOCITIES.index(name)] = values
        if name in "pqr" and np.abs(values).max() > _FASTEST:
            raise UserError(
                f"{path}: {name} reaches {np.abs(values).max():g} rad/s, which looks like "
                "degrees a second: convert the column to rad/s"
            )
    if total is not None:
        if clash := [name for name in "uvw" if name in direct]:
            raise UserError(f"{path} has U_mps and {clash[0]}: keep one way to state the velocity")
        if (total < 0.0).any():
            raise UserError(
                f"{path}: U_mps is negative in a row, but it is a speed: check its sign"
            )
        alpha, beta = (flow.get(name, np.zeros(n)) for name in ("alpha", "beta"))
        side = -1.0 if drift == "port" else 1.0
        nu[:, 0] = total * np.cos(alpha) * np.cos(beta)
        nu[:, 1] = side * total * np.sin(beta)
        nu[:, 2] = total * np.sin(alpha) * np.cos(beta)
        reader.has_flow = True
    elif flow:
        raise UserError(f"{path} has alpha or beta but no speed: add U_mps, or map it with --map")
    elif not direct:
        raise UserError(
            f"{path} has no velocities: name u v w p q r, or U_mps with alpha_deg and beta_deg, "
            f"with --map; it has {', '.join(reader.table.cells)}"
        )
    speed = np.linalg.norm(nu[:, :3], axis=1)
    for name in ("R_m", "radius_m"):
        radius = reader.column(name, blank=True)
        if radius is None:
            continue
        if "r" in direct:
            raise UserError(f"{path} has r and {name}: keep one of them")
        if (radius == 0.0).any():
            raise UserError(f"{path}: {name} is 0 in a row: leave it empty for straight runs")
        nu[:, 5] = np.where(np.isnan(radius), 0.0, speed / radius)
    for name in "pqr":
        primed = reader.column(f"{name}'")
        if primed is None:
            continue
        if nu[:, VELOCITIES.index(name)].any():
            raise UserError(f"{path} says {name} and {name}': keep one of them")
        if not nondimensional:
            raise UserError(
                f"{path}: {name}' looks non-dimensional: give --nondimensional rho=...,L=..., or "
                f"{name} in rad/s beside forces in newtons"
            )
        nu[:, VELOCITIES.index(name)] = primed * speed / nondimensional["L"]
    return nu, speed


def _forces(
    reader: _Reader, speed: Array, nondimensional: Mapping[str, float] | None
) -> dict[str, Array]:
    path = reader.table.path
    forces: dict[str, Array] = {}
    for axis in AXES:
        values = reader.column(axis)
        if values is None and nondimensional:
            values = reader.column(f"{axis}'")
        if values is None:
            continue
        if np.ptp(values) < 1e-300:
            raise UserError(
                f"{path}: the column {reader.columns.get(axis, axis)} is constant, "
                f"{values[0]:g}: remove it, or map the right one to {axis}"
            )
        forces[axis] = values
    if not forces:
        primed = [f"{axis}'" for axis in AXES if f"{axis}'" in reader.table.cells]
        hint = (
            f"{', '.join(primed)} look non-dimensional: give --nondimensional rho=...,L=..."
            if primed
            else f"name X Y Z K M N with --map; it has {', '.join(reader.table.cells)}"
        )
        raise UserError(f"{path} has no forces: {hint}")
    if nondimensional:
        if speed.min() < _SLOWEST:
            raise UserError(
                f"{path}: a row has no speed, so that its non-dimensional forces mean nothing: "
                "remove it"
            )
        rho, length = nondimensional["rho"], nondimensional["L"]
        area = length * nondimensional.get("T", length)
        scale = 0.5 * rho * speed**2 * area
        for axis in forces:
            forces[axis] = forces[axis] * scale * (1.0 if axis in "XYZ" else length)
    return forces


def _fins(reader: _Reader) -> dict[str, Array]:
    path = reader.table.path
    fins: dict[str, Array] = {}
    for letter, names in _FIN_COLUMNS.items():
        for name in names:
            if (values := reader.angle(name)) is not None:
                if letter in fins:
                    raise UserError(
                        f"{path} has two columns for the {names[0]}: remove one of them"
                    )
                fins[letter] = values
    for tail in (X, CROSS):
        single = {name: x for name in tail.spans if (x := reader.angle(name)) is not None}
        if not single:
            continue
        if fins:
            raise UserError(f"{path} has single fins and equivalent angles: keep one of them")
        if lacking := set(tail.spans) - set(single):
            raise UserError(
                f"{path} lacks the fin {min(lacking)}_deg of the {tail.name} tail: add it"
            )
        fins = dict(zip("sra", tail.to_equivalent(np.column_stack(list(single.values()))).T))
    return fins


def _with_resisting_signs(
    nu: Array, fins: Mapping[str, Array], forces: Mapping[str, Array], notes: list[str]
) -> Array:
    """Turns v and w round where the force would otherwise drive the hull along them, by its
    regression on all states: on a rotating arm, the force of turning may be the larger one."""
    out = nu.copy()
    states = np.column_stack([nu, *fins.values()])
    states = states - states.mean(axis=0)
    states = states / np.maximum(np.abs(states).max(axis=0), _SLOWEST)
    sides = (("Y", 1, "v", "beta", "starboard"), ("Z", 2, "w", "alpha", "below"))
    for axis, i, velocity, angle, side in sides:
        if axis not in forces:
            continue
        slopes = np.linalg.lstsq(states, forces[axis] - forces[axis].mean(), rcond=None)[0]
        if np.ptp(nu[:, i]) > 0.0 and slopes[i] > 0.0:
            out[:, i] *= -1.0
            notes.append(
                f"{axis} would push along {velocity} with a positive {angle} to {side}, so it is "
                f"read the other way, {velocity} = -U sin({angle}); --drift says otherwise"
            )
    return out


def pool(axis: str) -> tuple[str, ...]:
    """The terms that may stand on an axis, the more usual first; `A_0` is a constant."""
    if axis == "X":
        terms = "uu vv ww qq rr vr wq pp u uudrdr uudsds drdr dsds 0"
    elif axis == "K":
        terms = "p pp up uv v vv ur r rr uuda uudr da dr 0"
    else:
        a, b, d = ("v", "r", "dr") if axis in "YN" else ("w", "q", "ds")
        terms = f"u{a} {a}{a} u{b} {b}{b} uu{d} {a} {b} {a}_abs_{b} {b}_abs_{a} uu{d}{d} u{d} {d}"
        terms += " uu 0"
    return tuple(f"{axis}_{term}" for term in terms.split())


def column(name: str, nu: Array, fins: Mapping[str, Array]) -> Array:
    """What a term multiplies, (n,): the force is ``value * column``."""
    if name.endswith("_0"):
        return np.ones(len(nu))
    c, inputs = parse(name), [fins.get(x, np.zeros(len(nu))) for x in INPUT_LETTERS]
    extended = extended_states(np.ascontiguousarray(nu), np.ascontiguousarray(np.array(inputs).T))
    return extended[:, c.left] * extended[:, c.right]


def unit(name: str) -> str:
    """The unit of a term."""
    if name.endswith("_0"):
        return WRENCH_UNITS[AXES.index(name[0])]
    return parse(name).unit


def fit(table: ForceTable, added_mass: Model | None = None) -> dict[str, AxisFit]:
    """A structure and its values for every axis of the table.

    With ``added_mass`` the Coriolis forces of that model's added mass are taken off first.

    Raises UserError if an axis has too few conditions for any structure.
    """
    munk = np.zeros_like(table.nu)  # C_A(nu) nu
    if added_mass is not None:
        momentum = table.nu @ added_mass.added_mass
        munk = np.array([coriolis(*row) for row in zip(momentum, table.nu, strict=True)])
    fits = {}
    for axis, force in table.forces.items():
        # M nu_dot + C nu = d + ...: measured is d - C_A nu.
        found = fit_axis(axis, table.nu, table.fins, force + munk[:, AXES.index(axis)])
        fits[axis] = replace(found, provenance=provenance([(table.name, table.sha256)]))
    return fits


def fit_axis(axis: str, nu: Array, fins: Mapping[str, Array], force: Array) -> AxisFit:
    """The structure of one axis, see the head of this module."""
    states = np.column_stack([nu, *fins.values()])
    _, first, which = np.unique(states.round(9), axis=0, return_index=True, return_inverse=True)
    conditions, repeats, which = len(first), len(force) - len(first), which.ravel()
    mean = np.bincount(which, force) / np.bincount(which)
    repeated = math.sqrt(float(np.sum((force - mean[which]) ** 2)) / max(repeats, 1))
    unlike, force = repeated / max(_rms(force), 1e-300), mean
    nu, fins = nu[first], {letter: angle[first] for letter, angle in fins.items()}
    if conditions < _FEWEST:
        raise UserError(
            f"{axis}: {conditions} different conditions are too few to tell structures apart: give "
            f"at least {_FEWEST}"
        )
    names, matrix, aliases = _excited(axis, nu, fins)
    if not names:
        raise UserError(f"{axis}: no velocity or fin angle varies that this axis depends on")
    most = min(len(names), max(1, conditions // _ROWS_PER_TERM))
    size = np.sqrt(np.mean(matrix**2, axis=0))
    scaled = matrix / size
    errors = {s: _left_out(scaled[:, s], force) for s in _grow(scaled, force, most)}
    rms = {s: _rms(error) for s, error in errors.items()}
    words = {s: tuple(names[i] for i in s) for s in errors}
    chosen, why = _most_parsimonious(errors, rms, words)
    terms, x, scale = words[chosen], scaled[:, chosen], size[list(chosen)]
    values = np.asarray(np.linalg.lstsq(x, force, rcond=None)[0], dtype=np.float64)
    covariance = sandwich(scaled_inverse(x.T @ x), (x.T * errors[chosen] ** 2) @ x)  # HC3
    apart = _of_structures(scaled, force, rms, chosen, values)
    covariance = widened(covariance, np.diag(covariance) + apart)
    fitted = x @ values
    every = {name: matrix[:, i] for i, name in enumerate(names)}
    every |= {name: column(name, nu, fins) for name in aliases}
    spread = float(np.sum((force - force.mean()) ** 2))
    shown = {*sorted(rms, key=lambda s: rms[s])[:_SHOWN], chosen}
    return AxisFit(
        estimator="ls",
        names=terms,
        units=tuple(unit(name) for name in terms),
        values=values / scale,
        covariance=covariance / np.outer(scale, scale),
        quantile=float(stdtrit(max(len(force) - len(terms), 1), 0.975)),
        axis=axis,
        cv_rmse=rms[chosen],
        rmse=_rms(force - fitted),
        r2=1.0 - float(np.sum((force - fitted) ** 2)) / max(spread, 1e-300),
        candidates=tuple(Candidate(words[s], rms[s]) for s in sorted(shown, key=lambda s: rms[s])),
        why=why,
        pool=tuple(names),
        left_out={
            name: np.linalg.lstsq(x, z, rcond=None)[0] / scale
            for name, z in every.items()
            if name not in terms
        },
        aliases={a: b for a, b in aliases.items() if b in terms},
        unlike=unlike,
        measured=force,
        fitted=fitted,
    )


def _excited(
    axis: str, nu: Array, fins: Mapping[str, Array]
) -> tuple[list[str], Array, dict[str, str]]:
    """Terms that the table moves, and of those alike in it only the first; {left out: kept}."""
    names: list[str] = []
    columns: list[Array] = []
    aliases: dict[str, str] = {}
    for name in pool(axis):
        x = column(name, nu, fins)
        length = float(np.linalg.norm(x))
        if length < 1e-9 * math.sqrt(len(x)):
            continue
        for other, y in zip(names, columns):
            if abs(x @ y) > _ALIKE * length * float(np.linalg.norm(y)):
                aliases[name] = other
                break
        else:
            names.append(name)
            columns.append(x)
    return names, np.column_stack(columns) if columns else np.zeros((len(nu), 0)), aliases


def _grow(x: Array, y: Array, most: int) -> list[tuple[int, ...]]:
    """Structures of every size: the best found by adding a term and exchanging terms, and all that
    differ from it by one term."""
    gram, right = x.T @ x, x.T @ y
    power = float(y @ y)

    def cost(subset: tuple[int, ...]) -> float:
        own = right[list(subset)]
        try:
            return power - float(own @ np.linalg.solve(gram[np.ix_(subset, subset)], own))
        except np.linalg.LinAlgError:
            return power

    tried: dict[tuple[int, ...], None] = {}  # in the order in which they were found
    current: tuple[int, ...] = ()
    n, errors = x.shape[1], list[float]()
    for _ in range(most):
        if len(errors) > _PATIENCE and min(errors[-_PATIENCE:]) > min(errors):
            break
        grown = [tuple(sorted((*current, i))) for i in range(n) if i not in current]
        current = min(grown, key=cost)
        while True:
            exchanged = [
                tuple(sorted((*(k for k in current if k != out), i)))
                for out in current
                for i in range(n)
                if i not in current
            ]
            better = min(exchanged, key=cost, default=current)
            # Where a table is exact only rounding is left, at times below zero, which has no end.
            least = max(1e-9 * cost(current), 1e-15 * power)
            if cost(better) >= cost(current) - least:
                break
            current = better
        errors.append(_rms(_left_out(x[:, current], y)))
        tried |= dict.fromkeys([current, *sorted({*grown, *exchanged}, key=cost)[:8]])
    return [s for s in tried if np.linalg.cond(x[:, s]) < _CONDITION] or [min(tried, key=len)]


def _left_out(x: Array, y: Array) -> Array:
    """Errors (n,) of predicting each row by a fit to all others."""
    q = np.linalg.qr(x)[0]
    h = np.minimum(np.sum(q**2, axis=1), 1.0 - 1e-9)
    return (y - q @ (q.T @ y)) / (1.0 - h)


def _most_parsimonious(
    errors: Mapping[tuple[int, ...], Array],
    rms: Mapping[tuple[int, ...], float],
    words: Mapping[tuple[int, ...], Sequence[str]],
) -> tuple[tuple[int, ...], str]:
    """The best structure of the smallest size at which one is not worse than the best of all by
    more than chance, and why."""
    best = min(errors, key=lambda s: float(np.mean(errors[s] ** 2)))
    n, mean = len(errors[best]), float(np.mean(errors[best] ** 2))
    sizes = []
    for subset, error in errors.items():
        excess = error**2 - errors[best] ** 2
        of_term = _DOUBT * max(len(best) - len(subset), 1) * mean / n
        doubt = min(float(np.std(excess)) / math.sqrt(n), of_term)
        if float(np.mean(excess)) <= _WORTH * doubt + 1e-18:
            sizes.append(len(subset))
    chosen = min((s for s in rms if len(s) == min(sizes)), key=lambda s: rms[s])
    why = f"cross-validated error {rms[chosen]:.4g}"
    if chosen != best:
        why += (
            f"; {' '.join(words[best])} has {rms[best]:.4g}, not better by more than two standard "
            "errors, and has more terms"
        )
    else:
        why += ", the least of all tried; no smaller structure comes within two standard errors"
    if smaller := [s for s in rms if len(s) < len(chosen)]:
        nearest = min(smaller, key=lambda s: rms[s])
        why += f"; with fewer terms the best is {' '.join(words[nearest])} at {rms[nearest]:.4g}"
    return chosen, why


def _of_structures(
    x: Array, y: Array, rms: Mapping[tuple[int, ...], float], chosen: tuple[int, ...], values: Array
) -> Array:
    """What the choice among structures adds to the variances (n,) of the ``values`` of the chosen
    one: the mean square by which a term is another in other structures, zero where they lack it,
    weighted by how well they predict (Burnham and Anderson 2002, sec. 4.3; a cross-validated error
    weighs as AIC does: Stone 1977)."""
    least = min(rms.values())
    total, apart = 0.0, np.zeros(len(chosen))
    for structure, error in rms.items():
        weight = (least / max(error, 1e-300)) ** len(y) if least > 0.0 else float(error == least)
        if weight < _LIGHT:
            continue
        there = dict(zip(structure, np.linalg.lstsq(x[:, structure], y, rcond=None)[0].tolist()))
        total += weight
        apart += weight * (np.array([there.get(term, 0.0) for term in chosen]) - values) ** 2
    return apart / max(total, _LIGHT)


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


def to_json(
    fits: Mapping[str, AxisFit],
    notes: Sequence[str] = (),
    not_understood: Sequence[str] = (),
    coriolis_taken_off: bool = False,
) -> str:
    """The result as JSON; ``covariance`` and ``left_out`` of an axis are in the order of its terms.

    ``coriolis_taken_off``: whether the terms are free of the Coriolis forces of the added mass.
    """
    axes = {
        axis: {
            "terms": f.entries(),
            "cv_rmse": f.cv_rmse,
            "rmse": f.rmse,
            "r2": f.r2,
            "covariance": f.covariance.tolist(),
            "left_out": {name: slope.tolist() for name, slope in f.left_out.items()},
            "candidates": [asdict(c) for c in f.candidates],
            "why": f.why,
            "indistinguishable": dict(f.aliases),
        }
        for axis, f in fits.items()
    }
    document = {
        "axes": axes,
        "not_understood": list(not_understood),
        "coriolis_taken_off": coriolis_taken_off,
        "notes": list(notes),
        "provenance": next(iter(fits.values())).provenance,  # all axes are of one table
    }
    return as_json(document)


def headline(fits: Mapping[str, AxisFit]) -> Table:
    """Every coefficient of the table: value, half of its 95 % interval, the interval, unit."""
    rows = []
    for f in fits.values():
        for row, low, high in zip(f.numbers("").rows, f.lower, f.upper, strict=True):
            rows.append([*row, f"{low:.5g}", f"{high:.5g}"])
    return Table("Coefficients", ["", "value", PLUS_MINUS, "unit", "lower", "upper"], rows, (3,))


def remarks(fits: Mapping[str, AxisFit], with_config: bool) -> list[str]:
    """What a reader of the coefficients should know."""
    out = []
    for axis, f in fits.items():
        velocity = VELOCITIES[AXES.index(axis)]
        own = {f"{axis}_{of}{velocity}" for of in ("", velocity, "u")} & {*f.names}
        driven = [n for n, low in zip(f.names, f.lower) if n in own and low > 0.0]
        if driven and len(driven) == len(own):
            out.append(
                f"{driven[0]} is positive, so {axis} would drive the vehicle along its own motion: "
                "the table must hold the forces on the vehicle, not its resistance, in axes "
                f"forward, starboard, down; reverse the sign of {axis} if it does not"
            )
        if f.unlike > _UNLIKE:
            out.append(
                f"{axis}: rows of the same condition differ by {100.0 * f.unlike:.0f} % of the "
                "force: if that is not noise, something else varies that the table lacks or whose "
                "heading is not understood, and the values hold for its average: add its column"
            )
        if len(f.names) == len(f.measured) // _ROWS_PER_TERM < len(f.pool):
            out.append(
                f"{axis}: {len(f.measured)} conditions allow for no more than these "
                f"{len(f.names)} terms; if the force has others, intervals do not hold: add rows"
            )
        off = np.abs(f.measured - f.fitted)
        if (far := (off > _FAR * np.median(off)) & (off > _SLIP * np.abs(f.measured))).any():
            shown = ", ".join(f"{x:.4g}" for x in f.measured[far][:5])
            out.append(
                f"{axis}: {far.sum()} of {len(far)} conditions are far off the fit (forces {shown}"
                f"{' ...' if far.sum() > 5 else ''}) and may have spoilt it: check these rows for "
                "slips of sign or unit, and correct or remove them"
            )
        if f.aliases:
            pairs = ", ".join(f"{a} for {b}" for a, b in f.aliases.items())
            out.append(f"{axis}: this table would be fitted as well with {pairs}")
        if f"{axis}_0" in f.names:
            out.append(
                f"{axis}_0 is a constant (propeller, asymmetry or an offset of the balance): it is "
                "no coefficient of the hull and is not written to a configuration"
            )
    if not with_config:
        out.append(
            "products such as Y_ur and N_uv hold the Coriolis forces of the added mass: give "
            "--config to have those of the vehicle taken off"
        )
    return out


def with_hull(config: Config, hull: Mapping[str, float]) -> Config:
    """The configuration with the added mass of ``hull`` in the place of its own."""
    model = config.model
    values = {n: x for n, x in model.values.items() if not parse(n).is_added_mass}
    return config.with_model(build(model.body, {**hull, **values}))


def configured(config: Config, fits: Mapping[str, AxisFit]) -> Config:
    """The configuration with the fitted coefficients in the place of all that the table could have
    told (the axes' terms it excites).

    Raises UserError if the values make no passive hull.
    """
    values = dict(config.model.values)
    for f in fits.values():
        told = {parse(n).place for n in (*f.pool, *f.aliases) if not n.endswith("_0")}
        values = {n: x for n, x in values.items() if parse(n).place not in told}
        values |= {n: float(x) for n, x in zip(f.names, f.values) if not n.endswith("_0")}
    return config.with_model(build(config.model.body, values))
