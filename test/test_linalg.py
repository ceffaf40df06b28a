"""Scaled systems against plain ones, and where plain ones fail."""

import numpy as np
import pytest

from rov_ident.core.linalg import sandwich, scaled_inverse, scaled_solve, unit_diagonal, widened

UNITS = np.logspace(-9.0, 9.0, 6)


@pytest.fixture
def matrix():
    """A well-conditioned normal matrix (6, 6), in units that make its condition number 1e36."""
    rows = np.random.default_rng(1).normal(size=(40, 6))
    return (rows.T @ rows) * np.outer(UNITS, UNITS)


def test_units_do_not_matter(matrix):
    unit, size = unit_diagonal(matrix)
    assert np.diag(unit) == pytest.approx(1.0)
    plain = matrix / np.outer(UNITS, UNITS)
    right = np.arange(12.0).reshape(6, 2)
    expected = np.linalg.solve(plain, right) / UNITS[:, None]
    assert scaled_solve(matrix, right * UNITS[:, None]) == pytest.approx(expected, rel=1e-12)
    assert scaled_solve(matrix, right[:, 0] * UNITS) == pytest.approx(expected[:, 0], rel=1e-12)
    given = scaled_solve(matrix, right[:, 0] * UNITS, 0.0, 3.0 * size)
    assert given == pytest.approx(expected[:, 0], rel=1e-12)
    inverse = scaled_inverse(matrix) * np.outer(UNITS, UNITS)
    assert inverse == pytest.approx(np.linalg.inv(plain), rel=1e-11)


def test_a_ridge_and_a_pseudo_inverse_decide_what_the_matrix_does_not(matrix):
    matrix[5], matrix[:, 5] = 0.0, 0.0
    right = np.append(np.ones(5), 0.0) * UNITS
    with pytest.raises(np.linalg.LinAlgError):
        scaled_solve(matrix, right)
    assert scaled_solve(matrix, right, 1e-9)[5] == 0.0
    assert scaled_inverse(matrix)[5, 5] == 0.0
    twice = np.array([[1.0, 1.0], [1.0, 1.0]])
    assert scaled_inverse(twice) == pytest.approx(0.25 * twice)


def test_a_sandwich_and_a_widened_covariance():
    inverse = np.array([[2.0, 0.5], [0.5, 1.0]])
    assert sandwich(inverse, np.linalg.inv(inverse)) == pytest.approx(inverse)
    wide = widened(inverse, np.array([8.0, 0.5]))
    assert np.diag(wide) == pytest.approx([8.0, 1.0])
    assert wide[0, 1] / np.sqrt(8.0) == pytest.approx(0.5 / np.sqrt(2.0))
    assert np.array_equal(widened(inverse, np.diag(inverse)), inverse)
