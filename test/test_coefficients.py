"""Names of the coefficients: which there are, where each stands, in which unit."""

import re
from collections import Counter

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rov_ident.core.errors import UserError
from rov_ident.model.coefficients import (
    ABSOLUTE,
    AXES,
    EXTENDED_SIZE,
    NEGATIVE,
    ONE,
    PLAIN,
    VELOCITIES,
    catalogue,
    parse,
)

# The names that configurations and controllers script against.
CONTRACT = """
    X_udot Y_vdot Z_wdot K_pdot M_qdot N_rdot Y_rdot X_u Y_v Z_w K_p M_q N_r N_v
    X_uu Y_vv Z_ww K_pp M_qq N_rr X_vv X_ww X_pp X_qq X_rr Z_uu Z_pp Z_rr M_uu M_pp M_rr
    Y_uv Z_uw M_uw N_uv Y_v_abs_r Z_ww_neg Z_w_neg
""".split()
PLAIN_SQUARES = "X_vv X_ww X_pp X_qq X_rr Z_uu Z_pp Z_rr M_uu M_pp M_rr".split()

u, v, w, p, q, r = range(6)


def dimensions(unit: str) -> Counter[str]:
    """Exponents of the base units: "N m s2/(m rad)" -> N 1, s 2, rad -1 (kg as N s2/m)."""
    exponents: Counter[str] = Counter()
    above, _, below = unit.partition("/")
    for sign, part in ((1, above), (-1, below.strip("()"))):
        for base, exponent in re.findall(r"([a-zA-Z]+)(\d*)", part):
            exponents[base] += sign * int(exponent or 1)
    kilograms = exponents.pop("kg", 0)
    exponents.update({"N": kilograms, "s": 2 * kilograms, "m": -kilograms})
    return Counter({base: n for base, n in exponents.items() if n})


def of_velocity(index: int) -> Counter[str]:
    return Counter({"m" if index < 3 else "rad": 1, "s": -1})


def test_every_name_of_the_contract_is_in_the_catalogue():
    assert set(CONTRACT) <= {c.name for c in catalogue()}


def test_the_catalogue_has_every_term_once():
    """21 of a symmetric matrix; on each axis 6 linear, 6 squares, 15 products, 30 b |c|, 2 neg."""
    coefficients = catalogue()
    assert (
        len({c.place for c in coefficients}) == len(coefficients) == 21 + 6 * (6 + 6 + 15 + 30 + 2)
    )
    assert sum(c.is_added_mass for c in coefficients) == 21


def test_every_name_says_its_place_itself():
    """Equal names, equal coefficients; the axis is the first letter; the places exist."""
    for c in catalogue():
        assert parse(c.name) == c
        assert AXES[c.row] == c.name[0]
        assert VELOCITIES[c.column] == c.name[2]
        if not c.is_added_mass:
            assert 0 <= c.left < EXTENDED_SIZE
            # The second factor is always a velocity: what lets D(nu) be a matrix.
            assert PLAIN <= c.right < ABSOLUTE or (c.is_one_sided and c.right < EXTENDED_SIZE)
            assert VELOCITIES[c.velocity] in c.name[2:]


@pytest.mark.parametrize(
    ("name", "row", "left", "right"),
    [
        ("X_u", 0, ONE, PLAIN + u),
        ("N_v", 5, ONE, PLAIN + v),
        ("X_uu", 0, ABSOLUTE + u, PLAIN + u),
        ("Z_qq", 2, ABSOLUTE + q, PLAIN + q),
        ("M_ww", 4, ABSOLUTE + w, PLAIN + w),
        ("X_vv", 0, PLAIN + v, PLAIN + v),
        ("M_rr", 4, PLAIN + r, PLAIN + r),
        ("Y_uv", 1, PLAIN + u, PLAIN + v),
        ("K_pr", 3, PLAIN + p, PLAIN + r),
        ("Y_v_abs_r", 1, ABSOLUTE + r, PLAIN + v),
        ("Z_w_neg", 2, ONE, NEGATIVE + w),
        ("N_rr_neg", 5, ABSOLUTE + r, NEGATIVE + r),
    ],
)
def test_the_factors_of_a_term(name, row, left, right):
    c = parse(name)
    assert (c.row, c.left, c.right) == (row, left, right)
    assert not c.is_added_mass


def test_doubled_letters_are_plain_squares_just_where_symmetry_makes_them_even():
    squares = [c for c in catalogue() if re.fullmatch(r"\w_(\w)\1", c.name)]
    assert len(squares) == 36
    assert {c.name for c in squares if c.left == c.right} == set(PLAIN_SQUARES)


@pytest.mark.parametrize(("name", "other"), [("Y_rdot", "N_vdot"), ("Y_uv", "Y_vu")])
def test_two_names_of_one_term_have_one_place(name, other):
    assert parse(name).place == parse(other).place


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("Y_vdot", "Y_v"),
        ("Y_v_abs_r", "Y_r_abs_v"),
        ("Y_v_abs_r", "Y_vr"),
        ("Y_v", "N_v"),
        ("Y_r", "N_v"),  # damping is not symmetric
        ("X_u", "X_uu"),
        ("X_u", "X_u_neg"),
        ("X_uu", "X_uu_neg"),
        ("X_u_neg", "X_uu_neg"),
    ],
)
def test_different_terms_have_different_places(name, other):
    assert parse(name).place != parse(other).place


def test_own_motion_is_diagonal_and_nothing_else():
    own = {f"{a}_{b}{kind}" for a, b in zip(AXES, VELOCITIES) for kind in ("dot", "", b)}
    assert {c.name for c in catalogue() if c.is_diagonal} == own


def test_one_sided_is_an_axis_own_damping_and_nothing_else():
    own = {f"{a}_{b}{kind}_neg" for a, b in zip(AXES, VELOCITIES) for kind in ("", b)}
    one_sided = [c for c in catalogue() if c.is_one_sided]
    assert {c.name for c in one_sided} == own
    assert all(f"{c.symmetric}_neg" == c.name and parse(c.symmetric).is_diagonal for c in one_sided)


@pytest.mark.parametrize("name", ["Y_r_neg", "X_vv_neg", "Y_uv_neg", "M_w_neg"])
def test_couplings_have_no_side(name):
    with pytest.raises(UserError, match="only an axis's own damping may differ.*_neg or "):
        parse(name)


def test_units_make_forces_and_moments():
    """Coefficient times velocities is a force or a moment (an angle in added mass is a number)."""
    for c in catalogue():
        found = dimensions(c.unit)
        if c.is_added_mass:
            found.update({"m": c.column < 3, "s": -2})
        else:
            for factor in (c.left, c.right):
                if factor != ONE:
                    found.update(of_velocity((factor - PLAIN) % 6))
        expected = {"N": 1} if c.row < 3 else {"N": 1, "m": 1}
        assert {base: n for base, n in found.items() if n} == expected, c


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("X_udot", "kg"),
        ("Y_rdot", "kg m"),
        ("N_vdot", "kg m"),
        ("N_rdot", "kg m2"),
        ("X_u", "N s/m"),
        ("Y_r", "N s/rad"),
        ("N_r", "N m s/rad"),
        ("X_uu", "N s2/m2"),
        ("N_rr", "N m s2/rad2"),
        ("N_v_abs_r", "N m s2/(m rad)"),
        ("Z_w_neg", "N s/m"),
        ("N_rr_neg", "N m s2/rad2"),
    ],
)
def test_units_as_they_are_printed(name, unit):
    assert parse(name).unit == unit


def test_meanings_show_the_term():
    assert parse("X_udot").meaning == "added mass: force X per du/dt"
    assert parse("N_r").meaning.endswith("moment N = N_r r")
    assert parse("X_uu").meaning.endswith("force X = X_uu |u| u")
    assert parse("X_vv").meaning.endswith("force X = X_vv v^2")
    assert parse("Z_w_neg").meaning.endswith("force Z = Z_w_neg min(w, 0)")
    assert parse("Z_ww_neg").meaning.endswith("force Z = Z_ww_neg |w| min(w, 0)")
    assert parse("Y_v_abs_r").meaning.endswith("force Y = Y_v_abs_r v |r|")


@pytest.mark.parametrize(
    "name",
    [
        "",
        "X",
        "X_",
        "X_x",
        "x_u",
        "X_udott",
        "X_uuu",
        "X_u_abs_",
        "X_udot_neg",
        "X_u_neg_",
        "X_u ",
        " X_u",
        "X_u\n",
        "Xu",
    ],
)
def test_an_unknown_name_is_named_with_examples(name):
    with pytest.raises(UserError, match="not a hydrodynamic coefficient: use names such") as error:
        parse(name)
    assert f"'{name}'" in str(error.value)


def test_one_velocity_with_its_own_absolute_value_is_a_doubled_letter():
    with pytest.raises(UserError, match="'X_u_abs_u' is written X_uu"):
        parse("X_u_abs_u")


PLACES = {c.place for c in catalogue()}


@given(st.text(alphabet="XYZKMN_uvwpqrdotabsneg \n", max_size=12))
@example("K_da")
def test_any_text_is_a_coefficient_of_that_name_or_refused(name):
    try:
        c = parse(name)
    except UserError:
        return
    assert c.name == name
    assert c.inputs or c.place in PLACES  # the catalogue has no fins
