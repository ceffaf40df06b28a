"""The 6-DOF equations of motion, written once.

In body axes (forward, starboard, down) about the body origin (Fossen 2021, eq. 8.1; Kirchhoff)::

    p   = M nu                                      momentum of body and added water
    tau = M nu_dot + C(nu) nu - d(nu) + g
    C(nu) nu = [omega x p1; omega x p2 + v x p1]
    M   = M_RB - sym(added-mass coefficients)
    d   = sum of  coefficient * extended[left] * extended[right]
    extended = [1, nu, |nu|, min(nu, 0), u^2, inputs]
    g   = -[(W - B) k; (W r_g - B r_b) x k]         k: unit vector down, in body axes

The inputs are fin angles and the propeller's speed: what they make is part of d. ``C(nu) nu`` from
the momentum of the *total* mass matrix holds for rigid body and added mass, with the centre of
gravity anywhere, off-diagonal terms included, and does no work by construction.

:func:`generalized_force` gives ``C nu - d`` for states side by side ("lanes": one in simulation,
many of sigma points as vector instructions), :func:`columns` the same per unit of each coefficient.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.errors import UserError
from rov_ident.core.jit import floats, inlined, kernel, lean, record
from rov_ident.model.coefficients import (
    ABSOLUTE,
    EXTENDED_SIZE,
    INPUT,
    INPUTS,
    NEGATIVE,
    ONE,
    PLAIN,
    SQUARE,
    Coefficient,
    parse,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

GRAVITY = 9.81  # m/s2, where nothing else is said
INERTIA = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
"""Entries of the tensor of inertia, in the order in which files have them."""


class Structure(NamedTuple):
    """Which coefficients a model has, as tables the kernels loop over.

    The parameter vector theta holds the ``len(mass_row)`` added-mass coefficients first, then one
    for each term ``extended[left] * extended[right]`` on axis ``row``. ``inputs`` are the places in
    INPUTS of those that any term depends on.
    """

    mass_row: Indices
    mass_column: Indices
    row: Indices
    left: Indices
    right: Indices
    inputs: Indices


@dataclass(frozen=True, eq=False)
class RigidBody:
    """What the vehicle weighs and where, about the body origin, SI, forward-starboard-down.

    mass [kg]; weight and buoyancy [N]; cog and cob (3,) [m]; inertia (3, 3) [kg m2] about the
    centre of gravity.
    """

    mass: float
    weight: float
    buoyancy: float
    cog: Array
    cob: Array
    inertia: Array

    @cached_property
    def mass_matrix(self) -> Array:
        """M_RB (6, 6) about the body origin (Fossen 2021, eq. 3.49)."""
        m, s = self.mass, skew(self.cog)
        out = m * np.eye(6)  # not np.block, which takes ten times as long
        out[:3, 3:], out[3:, :3], out[3:, 3:] = -m * s, m * s, self.inertia - m * s @ s
        return out

    @cached_property
    def restoring(self) -> Array:
        """(6, 3): the gravity and buoyancy wrench is ``restoring @ k``, k the unit vector down."""
        lever = self.weight * self.cog - self.buoyancy * self.cob
        return np.vstack([(self.weight - self.buoyancy) * np.eye(3), skew(lever)])

    @property
    def righting_arm(self) -> float:
        """What rights the hull for each radian of roll or pitch, over the weight [m]; negative: it
        would capsize."""
        return float(self.restoring[4, 0]) / self.weight


@dataclass(frozen=True, eq=False)
class Model:
    """A rigid body and its hydrodynamic coefficients: all that the equations of motion need.

    ``coefficients`` are in the order of the parameter vector ``theta`` (added mass first). Inputs
    (4,), where a method takes them, are in the order of INPUTS; left out, they are zero.
    """

    body: RigidBody
    coefficients: tuple[Coefficient, ...]
    theta: Array

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.coefficients)

    @property
    def values(self) -> dict[str, float]:
        """``theta`` by name."""
        return dict(zip(self.names, self.theta.tolist(), strict=True))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Those of INPUTS that a coefficient depends on."""
        found = {name for c in self.coefficients for name in c.inputs}
        return tuple(name for name in INPUTS if name in found)

    @property
    def fins(self) -> dict[str, float]:
        """The coefficients of inputs by name."""
        return {c.name: self.values[c.name] for c in self.coefficients if c.inputs}

    @cached_property
    def structure(self) -> Structure:
        mass = [(c.row, c.column) for c in self.coefficients if c.is_added_mass]
        terms = [(c.row, c.left, c.right) for c in self.coefficients if not c.is_added_mass]
        inputs = [[INPUTS.index(name) for name in self.inputs]]
        tables = [np.array(mass).reshape(-1, 2).T, np.array(terms).reshape(-1, 3).T]
        tables.append(np.array(inputs))
        return Structure(*(column.astype(np.int64) for table in tables for column in table))

    def with_theta(self, theta: Array) -> "Model":
        """The same structure with another parameter vector (m,).

        Raises UserError if it has another length.
        """
        if np.shape(theta) != self.theta.shape:
            raise UserError(f"theta needs shape {self.theta.shape}, not {np.shape(theta)}")
        out = replace(self, theta=_vector(theta))
        vars(out).update(names=self.names, structure=self.structure)
        return out

    def with_values(self, values: Mapping[str, float]) -> "Model":
        """The same structure with some coefficients replaced by name.

        Raises UserError if the model has no such coefficient.
        """
        theta = self.theta.copy()
        for name, value in values.items():
            if name not in self.names:
                raise UserError(
                    f"the model has no coefficient {name}, only {', '.join(self.names)}"
                )
            theta[self.names.index(name)] = value
        return self.with_theta(theta)

    def with_terms(self, names: Iterable[str]) -> "Model":
        """The same with further coefficients, which are zero."""
        every = sorted((*self.coefficients, *map(parse, names)), key=lambda c: not c.is_added_mass)
        theta = np.array([self.values.get(c.name, 0.0) for c in every])
        return Model(self.body, tuple(every), theta)

    def input_wrench(self, nu: Array, inputs: Array) -> Array:
        """The wrench (..., 6) of fins and propeller at nu (..., 6) for inputs (..., 4)."""
        states = extended_states(
            _vector(nu).reshape(-1, 6), _vector(inputs).reshape(-1, len(INPUTS))
        )
        out = np.zeros((len(states), 6))
        for c, value in zip(self.coefficients, self.theta, strict=True):
            if c.inputs:
                out[:, c.row] += value * states[:, c.left] * states[:, c.right]
        return out.reshape(np.shape(nu))

    def damping_force(self, nu: Array) -> Array:
        """d(nu) (..., 6) at nu (..., 6), without inputs."""
        massless, at_rest = np.zeros((6, 6)), np.zeros(len(INPUTS))
        velocity = _vector(nu).reshape(-1, 6)
        out = [force_of_one(self.structure, massless, self.theta, v, at_rest) for v in velocity]
        return -np.reshape(out, np.shape(nu))

    def _force(self, nu: Array, inputs: Array | None) -> Array:
        given = np.zeros(len(INPUTS)) if inputs is None else _vector(inputs)
        return force_of_one(self.structure, self.mass_matrix, self.theta, _vector(nu), given)

    @cached_property
    def mass_matrix(self) -> Array:
        """M (6, 6): rigid body and added mass."""
        return self.body.mass_matrix + self.added_mass

    @cached_property
    def added_mass(self) -> Array:
        """M_A (6, 6)."""
        m = np.zeros((6, 6, 1))
        add_added_mass(self.structure, self.theta[:, None], m)
        return m[:, :, 0]

    def coriolis_force(self, nu: Array) -> Array:
        """C(nu) nu (6,)."""
        return coriolis(self.mass_matrix @ nu, _vector(nu))

    def damping_matrix(self, nu: Array) -> Array:
        """D(nu) (6, 6) with ``d(nu) = -D(nu) nu`` without inputs: each term's second factor is its
        velocity."""
        extended = extended_states(_vector(nu)[None], np.zeros((1, len(INPUTS))))[0]
        matrix = np.zeros((6, 6))
        for c, value in zip(self.coefficients, self.theta, strict=True):
            if c.is_added_mass or c.inputs:
                continue
            if not (c.is_one_sided and nu[c.velocity] >= 0.0):
                matrix[c.row, c.velocity] -= value * extended[c.left]
        return matrix

    def coriolis_matrix(self, nu: Array) -> Array:
        """Skew-symmetric C(nu) (6, 6) with ``C(nu) nu`` = :meth:`coriolis_force`."""
        p = self.mass_matrix @ nu
        upper = -skew(p[:3])
        return np.block([[np.zeros((3, 3)), upper], [upper, -skew(p[3:])]])

    def restoring_force(self, down: Array) -> Array:
        """g (6,), on the left-hand side of the equations; ``down`` is k in body axes."""
        return -self.body.restoring @ down

    def wrench(self, nu: Array, nu_dot: Array, down: Array, inputs: Array | None = None) -> Array:
        """The thruster wrench (6,) that this motion takes: the inverse dynamics."""
        h = self._force(nu, inputs)
        return self.mass_matrix @ nu_dot + h + self.restoring_force(down)

    def acceleration(
        self, nu: Array, tau: Array, down: Array, inputs: Array | None = None
    ) -> Array:
        """nu_dot (6,) under the thruster wrench tau: the forward dynamics."""
        h = self._force(nu, inputs)
        wrench = tau - h - self.restoring_force(down)
        return np.asarray(np.linalg.solve(self.mass_matrix, wrench), dtype=np.float64)

    def regressor(self, nu: Array, nu_dot: Array, inputs: Array | None = None) -> Array:
        """Y (6, n): ``wrench = M_RB nu_dot + C_RB nu + g + Y theta``."""
        structure, n = self.structure, len(self.theta)
        momentum, force, of_rate = np.zeros((6, n)), np.zeros((6, n)), np.zeros((6, n))
        momentum_columns(structure, _vector(nu_dot), of_rate)
        extended = extended_by(structure, np.zeros(len(INPUTS)) if inputs is None else inputs)
        columns(structure, _vector(nu), momentum, force, extended)
        return of_rate + force


def build(body: RigidBody, values: Mapping[str, float]) -> Model:
    """The model with the named coefficients, in the order of theta.

    ``Y_rdot`` and ``N_vdot`` name the same entry of the symmetric added mass: given both, they must
    agree, and the first is kept.

    Raises UserError for a name outside the grammar, a term given twice, or values that no passive
    hull has.
    """
    by_place: dict[tuple[int, ...], Coefficient] = {}
    for name, value in values.items():
        coefficient = parse(name)
        if not np.isfinite(value):
            raise UserError(f"coefficients.{name} is {value}, but must be a finite number")
        known = by_place.setdefault(coefficient.place, coefficient)
        if known is not coefficient and not (known.is_added_mass and values[known.name] == value):
            raise UserError(
                f"coefficients.{name} and coefficients.{known.name} are the same term: keep one"
            )
        if coefficient.is_diagonal and value > 0:
            raise UserError(
                f"coefficients.{name} is {value}, but must not be positive: damping and added mass "
                "are negative derivatives (SNAME signs)"
            )
        if coefficient.is_one_sided and values.get(coefficient.symmetric, 0.0) + value > 0:
            raise UserError(
                f"coefficients.{name} is {value}, but its sum with {coefficient.symmetric} must "
                "not be positive: the hull would be driven where the velocity is negative"
            )
    coefficients = sorted(by_place.values(), key=lambda c: not c.is_added_mass)
    theta = np.array([float(values[c.name]) for c in coefficients])
    model = Model(body, tuple(coefficients), theta)
    if np.linalg.eigvalsh(model.mass_matrix)[0] <= 0:
        raise UserError(
            "the mass matrix (rigid body plus added mass) is not positive definite: "
            "check vehicle.mass, vehicle.inertia and the added-mass coefficients"
        )
    return model


def _vector(a: Sequence[float] | Array) -> Array:
    """As the kernels take it: float64, contiguous."""
    return np.ascontiguousarray(a, dtype=np.float64)


def skew(a: Sequence[float] | Array) -> Array:
    """S(a) (3, 3) with ``S(a) b = a x b``."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


#
# ``lanes`` is passed as a literal by a caller that inlines these, so that the inner loops either
# vanish (one lane) or become vector instructions. These want one long expression a lane and rows of
# known length, hence the tuples.


@inlined
def extend(lanes, nu, extended):
    """[1, nu, |nu|, min(nu, 0), u^2], the first rows of extended, from nu (6, lanes).

    The others are those of the inputs, which change more slowly: :func:`extend_inputs`.
    """
    for k in range(lanes):
        extended[ONE, k] = 1.0
        extended[SQUARE, k] = nu[0, k] * nu[0, k]
    for i in range(6):
        for k in range(lanes):
            extended[PLAIN + i, k] = nu[i, k]
            extended[ABSOLUTE + i, k] = abs(nu[i, k])
            extended[NEGATIVE + i, k] = min(nu[i, k], 0.0)


@inlined
def _extend_input(lanes, which, x, extended):
    row = INPUT + 3 * which
    for k in range(lanes):
        extended[row, k] = x
        extended[row + 1, k] = abs(x) * x
        extended[row + 2, k] = x * x


@inlined
def extend_inputs(lanes, structure, inputs, extended):
    """The rows of the inputs (4,) in extended (EXTENDED_SIZE, lanes), of those that terms use.

    They stay there while velocities change.
    """
    for i in range(len(structure.inputs)):
        _extend_input(lanes, structure.inputs[i], inputs[structure.inputs[i]], extended)


@inlined
def six(a, k):
    """Lane k of a (6, lanes), as a tuple."""
    return a[0, k], a[1, k], a[2, k], a[3, k], a[4, k], a[5, k]


@inlined
def symmetric_product(m, x, k):
    """Lane k of the symmetric m (6, 6, lanes), its lower half read, times a tuple of six."""
    a, b, c, d, e, f = x
    return (
        m[0, 0, k] * a + m[1, 0, k] * b + m[2, 0, k] * c
        + m[3, 0, k] * d + m[4, 0, k] * e + m[5, 0, k] * f,
        m[1, 0, k] * a + m[1, 1, k] * b + m[2, 1, k] * c
        + m[3, 1, k] * d + m[4, 1, k] * e + m[5, 1, k] * f,
        m[2, 0, k] * a + m[2, 1, k] * b + m[2, 2, k] * c
        + m[3, 2, k] * d + m[4, 2, k] * e + m[5, 2, k] * f,
        m[3, 0, k] * a + m[3, 1, k] * b + m[3, 2, k] * c
        + m[3, 3, k] * d + m[4, 3, k] * e + m[5, 3, k] * f,
        m[4, 0, k] * a + m[4, 1, k] * b + m[4, 2, k] * c
        + m[4, 3, k] * d + m[4, 4, k] * e + m[5, 4, k] * f,
        m[5, 0, k] * a + m[5, 1, k] * b + m[5, 2, k] * c
        + m[5, 3, k] * d + m[5, 4, k] * e + m[5, 5, k] * f,
    )  # fmt: skip


@inlined
def coriolis_of(momentum, nu):
    """C(nu) nu from the momentum M nu; all tuples of six."""
    (a, b, c, d, e, f), (u, v, w, p, q, r) = momentum, nu
    return (
        q * c - r * b,
        r * a - p * c,
        p * b - q * a,
        q * f - r * e + v * c - w * b,
        r * d - p * f + w * a - u * c,
        p * e - q * d + u * b - v * a,
    )


@inlined
def generalized_force(lanes, structure, mass, theta, nu, h, extended):
    """h = C(nu) nu - d(nu) (6, lanes).

    mass (6, 6, lanes), theta (n, lanes), nu (6, lanes); extended (EXTENDED_SIZE, lanes) is work
    space that holds the inputs (:func:`extend_inputs`). Of the mass matrices the lower half is
    read.
    """
    for k in range(lanes):
        x = six(nu, k)
        p = symmetric_product(mass, x, k)
        h[0, k], h[1, k], h[2, k], h[3, k], h[4, k], h[5, k] = coriolis_of(p, x)
    extend(lanes, nu, extended)
    first = len(structure.mass_row)
    for term in range(len(structure.row)):
        row, left, right = structure.row[term], structure.left[term], structure.right[term]
        for k in range(lanes):
            h[row, k] -= theta[first + term, k] * extended[left, k] * extended[right, k]


@lean
def add_added_mass(structure, theta, mass):
    """mass (6, 6, lanes) += M_A: each coefficient enters its entry and the mirrored one."""
    lanes = mass.shape[2]
    for c in range(len(structure.mass_row)):
        i, j = structure.mass_row[c], structure.mass_column[c]
        for k in range(lanes):
            mass[i, j, k] -= theta[c, k]
            if i != j:
                mass[j, i, k] -= theta[c, k]


@lean
def momentum_columns(structure, nu, momentum):
    """The momentum (6, n) at nu (6,) per unit of each coefficient; the array is overwritten."""
    for i in range(6):
        for c in range(momentum.shape[1]):
            momentum[i, c] = 0.0
    for c in range(len(structure.mass_row)):
        i, j = structure.mass_row[c], structure.mass_column[c]
        momentum[i, c] = -nu[j]
        momentum[j, c] = -nu[i]


@lean
def columns(structure, nu, momentum, force, extended):
    """The regressor's two parts: per unit of each coefficient, momentum and force (6, n).

    ``wrench = d/dt(momentum @ theta) + force @ theta + known``: the derivative is left to the
    caller, who may differentiate (:func:`momentum_columns` of nu_dot), filter or integrate by
    parts. Both arrays are overwritten; extended (EXTENDED_SIZE, 1) is work space that holds the
    inputs (:func:`extend_inputs`).
    """
    momentum_columns(structure, nu, momentum)
    first = len(structure.mass_row)
    for i in range(6):
        for c in range(first, force.shape[1]):
            force[i, c] = 0.0
    for c in range(first):
        h = coriolis_of(six(momentum, c), (nu[0], nu[1], nu[2], nu[3], nu[4], nu[5]))
        for k in range(6):
            force[k, c] = h[k]
    extend(1, nu.reshape(6, 1), extended)
    for term in range(len(structure.row)):
        left, right = structure.left[term], structure.right[term]
        force[structure.row[term], first + term] = -extended[left, 0] * extended[right, 0]


@lean
def in_motion(structure, moving, out):
    """out (n,): whether every velocity that a coefficient multiplies is among the moving (6,).

    An input has no noise to speak of: where it is zero, its columns are.
    """
    first = len(structure.mass_row)
    for c in range(first):
        out[c] = moving[structure.mass_row[c]] != 0 and moving[structure.mass_column[c]] != 0
    for term in range(len(structure.row)):
        moves = True
        for index in (structure.left[term], structure.right[term]):
            if index == SQUARE:
                moves = moves and moving[0] != 0
            elif index != ONE and index < INPUT:
                moves = moves and moving[(index - PLAIN) % 6] != 0
        out[first + term] = moves


@kernel
def coriolis(p, nu):
    """C(nu) nu (6,) from the momentum p = M nu (6,)."""
    return np.array(coriolis_of(six(p.reshape(6, 1), 0), six(nu.reshape(6, 1), 0)))


CURRENT = record(
    [
        ("relative", "f8", (6,)),  # nu through the water
        *floats((6, 1), "nu h through_water"),
        ("extended", "f8", (EXTENDED_SIZE, 1)),
    ]
)
"""Work space of :func:`add_current`."""


@inlined
def add_current(structure, added_mass, theta, nu, water, s, out):
    """Add to out (6,) what steadily moving water adds to the thruster wrench in still water.

    ``added_mass`` (6, 6, 1), ``theta`` (n, 1), ``nu`` (6,) over ground and the velocity of the
    ``water`` in body axes [m/s], a tuple of three: irrotational and constant in the world. s is a
    record of CURRENT and keeps the velocity ``relative`` to the water. The hydrodynamic forces are
    those of ``nu_r = nu - nu_c`` (Fossen 2021, sec. 10.3)::

        M_RB nu_dot + C_RB(nu) nu + M_A nu_r_dot + C_A(nu_r) nu_r - d(nu_r) + g = tau
        nu_c = [water; 0],   nu_c_dot = [-omega x water; 0]

    Moving what differs from the equation for still water to the right leaves
    ``M_A nu_c_dot + (C_A(nu) nu - d(nu)) - (C_A(nu_r) nu_r - d(nu_r))``.
    """
    for i in range(6):
        s.nu[i, 0] = nu[i]
    generalized_force(1, structure, added_mass, theta, s.nu, s.h, s.extended)
    s.nu[0, 0] -= water[0]
    s.nu[1, 0] -= water[1]
    s.nu[2, 0] -= water[2]
    generalized_force(1, structure, added_mass, theta, s.nu, s.through_water, s.extended)
    turning = (
        nu[5] * water[1] - nu[4] * water[2],
        nu[3] * water[2] - nu[5] * water[0],
        nu[4] * water[0] - nu[3] * water[1],
    )
    for i in range(6):
        s.relative[i] = s.nu[i, 0]
        out[i] += s.h[i, 0] - s.through_water[i, 0]
        for j in range(3):
            out[i] += added_mass[i, j, 0] * turning[j]


@kernel
def force_of_one(structure, mass, theta, nu, inputs):
    """:func:`generalized_force` for a single state: mass (6, 6), theta (n,), nu (6,), inputs (4,).

    The result is (6,).
    """
    h = np.empty((6, 1))
    extended = np.empty((EXTENDED_SIZE, 1))
    extend_inputs(1, structure, inputs, extended)
    one_mass = np.ascontiguousarray(mass).reshape(6, 6, 1)
    generalized_force(1, structure, one_mass, theta.reshape(-1, 1), nu.reshape(6, 1), h, extended)
    return h[:, 0]


@kernel
def extended_by(structure, inputs):
    """Work space extended (EXTENDED_SIZE, 1) that holds the inputs (4,)."""
    extended = np.zeros((EXTENDED_SIZE, 1))
    extend_inputs(1, structure, inputs, extended)
    return extended


@kernel
def extended_states(nu, inputs):
    """The extended states (N, EXTENDED_SIZE) of nu (N, 6) and inputs (N, 4)."""
    out, extended = np.empty((len(nu), EXTENDED_SIZE)), np.empty((EXTENDED_SIZE, 1))
    for k in range(len(nu)):
        extend(1, nu[k].reshape(6, 1), extended)
        for i in range(inputs.shape[1]):
            _extend_input(1, i, inputs[k, i], extended)
        out[k] = extended[:, 0]
    return out
