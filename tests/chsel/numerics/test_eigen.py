import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.numerics.eigen import decompose


@numba.njit
def decomposed(matrix, work, values, vectors):
    decompose(matrix, work, values, vectors)


def eigen(matrix):
    n = len(matrix)
    values, vectors = np.full(n, np.nan), np.full((n, n), np.nan)
    before = matrix.copy()
    decomposed(matrix, np.full((n, n), np.nan), values, vectors)
    np.testing.assert_array_equal(matrix, before)
    return values, vectors


def check(matrix):
    """Values as LAPACK has them, orthonormal vectors that give the matrix back."""
    values, vectors = eigen(matrix)
    size = float(np.abs(matrix).max()) or 1.0
    assert (np.diff(values) >= 0.0).all()
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), rtol=0, atol=size * 1e-14)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(len(matrix)), rtol=0, atol=1e-14)
    back = (vectors * (values / size)) @ vectors.T
    np.testing.assert_allclose(back, matrix / size, rtol=0, atol=1e-14)
    for column in vectors.T:
        assert column[np.abs(column).argmax()] > 0.0


@settings(deadline=None, max_examples=100)
@given(
    st.sampled_from([1, 2, 3, 4, 9]), st.integers(0, 2**32 - 1), st.floats(-6, 6), st.integers(0, 3)
)
def test_random_matrices_some_of_repeated_eigenvalues(n, seed, exponent, different):
    matrix = np.random.default_rng(seed).standard_normal((n, n))
    if different:
        basis = np.linalg.qr(matrix)[0]
        matrix = (basis * np.resize(np.arange(different) + 1.0, n)) @ basis.T
    check((matrix + matrix.T) * 10.0**exponent)


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((3, 3)),
        np.eye(9),
        np.array([[0.0, 1.0], [1.0, 0.0]]),
        np.array([[1.0, 1e-9, 0.0], [1e-9, 1.0, 1e-9], [0.0, 1e-9, 1.0]]),
        np.array([[1.0, 1e-20], [1e-20, 1e-40]]),
        1e-300 * np.array([[2.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 1.0]]),
    ],
)
def test_special_matrices(matrix):
    check(matrix)


def test_small_eigenvalues_of_a_positive_matrix_are_relatively_accurate():
    scale = np.diag([1.0, 1e-6, 1e-12])
    correlation = np.array([[1.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 1.0]])
    values, _ = eigen(scale @ correlation @ scale)
    # Schur complements, as the scales are far apart: 1, 1 - 0.09, and what is left of 1.
    last = np.linalg.det(correlation) / (1.0 - 0.09)
    np.testing.assert_allclose(values, [last * 1e-24, 0.91e-12, 1.0], rtol=1e-11)


def test_diagonal_matrices_are_sorted_with_unit_vectors_and_nan_ends():
    values, vectors = eigen(np.diag([3.0, 1.0, 2.0]))
    np.testing.assert_array_equal(values, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(vectors, np.eye(3)[:, [1, 2, 0]])
    assert np.isnan(eigen(np.full((3, 3), np.nan))[0]).all()
