"""Elementary functions and eigenvectors with the same bits everywhere."""

import math

import mpmath
import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.numerics.eigen import decompose
from chsel.numerics.elementary import (
    arctangent,
    arctangents,
    exp,
    exps,
    log,
    logs,
    sine_cosine,
    sine_cosine_of_share,
    sines_cosines,
)

LIMIT = 0.9  # ulp
COUNT = 1000


@pytest.fixture(autouse=True)
def _many_digits():
    with mpmath.workprec(250):
        yield


def error(found, exact):
    """In units of the last place of the exact value, whose sign counts where it is 0."""
    return float(abs((mpmath.mpf(float(found)) - exact) / math.ulp(float(exact))))


def scattered(low, high, *, seed):
    """Numbers of both signs, their sizes spread evenly over the powers of two in between."""
    stream = np.random.Generator(np.random.Philox(seed))
    powers = np.floor(stream.uniform(low, high, COUNT)).astype(int)
    sizes = np.ldexp(1.0 + stream.random(COUNT), powers)
    return sizes * np.where(stream.random(COUNT) < 0.5, -1.0, 1.0)


def even(low, high, *, seed):
    return np.random.Generator(np.random.Philox(seed)).uniform(low, high, COUNT)


def near_quarter_turns():
    """The doubles around multiples of pi/2, where the reduced argument is all cancellation."""
    turns = np.unique(np.floor(np.abs(scattered(0, 19, seed=1))))
    with mpmath.workprec(250):
        nearest = np.array([float(n * mpmath.pi / 2) for n in turns.astype(int).tolist()])
    return np.concatenate([nearest, np.nextafter(nearest, 0), -np.nextafter(nearest, np.inf)])


def sine(x):
    return sine_cosine(x)[0]


def cosine(x):
    return sine_cosine(x)[1]


ANGLES = [
    scattered(-80, 2, seed=1),
    even(-7, 7, seed=2),
    even(-(2.0**20), 2.0**20, seed=4),
    near_quarter_turns(),
]
POSITIVE = [
    np.abs(scattered(-1022, 1023, seed=1)),
    1.0 + scattered(-52, -2, seed=2),
    even(0.3, 3.0, seed=3),
]
POSITIVE += [np.abs(scattered(-1074, -1023, seed=4))]  # subnormals
SEAMS = 1.0 + scattered(-52, -8, seed=11)  # of the table of arctangents
COORDINATES = [
    (scattered(-3, 3, seed=1), scattered(-3, 3, seed=2)),
    (scattered(-1022, 1023, seed=3), scattered(-1022, 1023, seed=4)),
    (scattered(-1e3, -990, seed=5), scattered(-1e3, -990, seed=6)),
    (scattered(1010, 1023, seed=7), scattered(1010, 1023, seed=8)),
    (scattered(-36, -20, seed=9), scattered(0, 1, seed=10)),
    (np.tile([0.25, 0.5, 0.75, 1.0], COUNT // 4), SEAMS),
    (np.abs(scattered(-1074, -1023, seed=12)), np.abs(scattered(0, 3, seed=13))),
]
EXPONENTS = [even(-745, 709.7, seed=1), scattered(-60, 3, seed=2), even(-745.13, -708, seed=3)]


@pytest.mark.parametrize(
    ("function", "exact", "arguments"),
    [
        (exp, mpmath.exp, EXPONENTS),
        (log, mpmath.log, POSITIVE),
        (sine, mpmath.sin, ANGLES),
        (cosine, mpmath.cos, ANGLES),
        (arctangent, mpmath.atan2, COORDINATES),
    ],
)
def test_a_function_is_within_an_ulp(function, exact, arguments):
    for each in arguments:
        for values in np.atleast_2d(each).T.tolist():
            assert error(function(*values), exact(*values)) < LIMIT, values


@pytest.mark.parametrize(
    ("function", "x", "value"),
    [
        (exp, -0.0, 1.0),
        (exp, -math.inf, 0.0),
        (exp, 709.782712893384, 1.7976931348622732e308),
        (exp, 709.782712893385, math.inf),
        (exp, -745.1332191019411, 5e-324),
        (exp, -745.1332191019412, 0.0),
        (log, -0.0, -math.inf),
        (log, 1.0, 0.0),
    ],
)
def test_values_at_the_ends_are_those_of_ieee_754(function, x, value):
    assert function(x) == value


def test_what_has_no_value_is_nan():
    assert math.isnan(exp(math.nan))
    assert all(math.isnan(log(x)) for x in (math.nan, -5e-324, -math.inf))
    assert all(math.isnan(v) for x in (math.nan, math.inf, -math.inf) for v in sine_cosine(x))
    assert math.isnan(arctangent(math.nan, 1.0))
    assert math.isnan(arctangent(0.0, math.nan))


def test_sine_keeps_the_sign_of_zero_and_the_smallest_numbers():
    for x in (0.0, -0.0, 5e-324, -1e-9):
        found = sine(x)
        assert (found, math.copysign(1.0, found), cosine(x)) == (x, math.copysign(1.0, x), 1.0)


@pytest.mark.parametrize("x", [2.0**20, -1234567.8, 3e15, 1.7976931348623157e308])
def test_beyond_2_to_the_20_an_angle_is_taken_modulo_the_double_next_to_a_turn(x):
    left = math.fmod(x, 2.0 * math.pi)
    assert abs(sine(x) - mpmath.sin(left)) < 1.2e-16
    assert abs(cosine(x) - mpmath.cos(left)) < 1.2e-16
    if abs(x) < 1e12:
        assert abs(sine(x) - mpmath.sin(x)) < 4e-17 * abs(x) + 1.2e-16


def test_zeros_and_infinities_of_the_arctangent_are_those_of_c():
    values = [0.0, 5e-324, 1.0, 1e308, math.inf]
    values += [-v for v in values]
    for y in values:
        for x in values:
            found = arctangent(y, x)
            expected = math.atan2(y, x)
            assert found == pytest.approx(expected, rel=3e-16, abs=0.0), (y, x)
            assert math.copysign(1.0, found) == math.copysign(1.0, expected), (y, x)


@pytest.mark.parametrize(
    ("arrays", "scalar"),
    [
        (exps, exp),
        (logs, log),
        (lambda x: sines_cosines(x)[0], sine),
        (lambda x: sines_cosines(x)[1], cosine),
        (lambda x: arctangents(x, 0.3), lambda x: arctangent(x, 0.3)),
    ],
)
def test_arrays_keep_their_shape_and_hold_the_scalars(arrays, scalar):
    values = np.abs(scattered(-3, 3, seed=1))[:24].reshape(2, 3, 4)
    values.setflags(write=False)
    for x in (values.transpose(2, 0, 1), values[:, ::2, 1:], values[:0], values[0, 0, 0], 2):
        expected = [scalar(float(v)) for v in np.ravel(x).tolist()]
        np.testing.assert_array_equal(arrays(x), np.reshape(expected, np.shape(x)))


@numba.njit
def decomposed(matrix, work, values, vectors):
    decompose(matrix, work, values, vectors)


def eigen(matrix):
    n = len(matrix)
    values = np.full(n, np.nan)
    vectors = np.full((n, n), np.nan)
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


@numba.njit
def fill_of_shares(shares, out):
    for n in range(len(shares)):
        out[n, 0], out[n, 1] = sine_cosine_of_share(shares[n])


def test_sines_and_cosines_of_shares_are_those_of_a_turn():
    shares = np.concatenate([np.linspace(0.0, 1.0, 10_001), [0.125, 0.375, 0.625, 0.875]])
    found = np.empty((len(shares), 2))
    fill_of_shares(shares, found)
    exact = [
        [float(mpmath.sin(2 * mpmath.pi * mpmath.mpf(share))) for share in shares],
        [float(mpmath.cos(2 * mpmath.pi * mpmath.mpf(share))) for share in shares],
    ]
    np.testing.assert_allclose(found.T, exact, rtol=0.0, atol=1e-15)
