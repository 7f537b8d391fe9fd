"""Eigenvalues and eigenvectors of a small symmetric matrix."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import inner

_MOST_SWEEPS = 30


@inner
def decompose(
    matrix: FloatArray, work: FloatArray, values: FloatArray, vectors: FloatArray
) -> None:
    """Fill values (n,), ascending, and vectors (n, n), in columns, of a symmetric matrix (n, n).

    Cyclic Jacobi by rows (Golub and Van Loan, 2013, Sec. 8.5); work (n, n) is scratch. The entry of
    largest absolute value of each eigenvector, the first of equals, is positive.
    """
    n = len(values)
    for i in range(n):
        for j in range(n):
            work[i, j] = matrix[i, j]
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(_MOST_SWEEPS):
        turned = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                turned |= _rotate(work, vectors, p, q)
        if not turned:
            break
    for i in range(n):
        values[i] = work[i, i]
    _sort(values, vectors)
    _orient(vectors)


@inner
def _rotate(work: FloatArray, vectors: FloatArray, p: int, q: int) -> bool:
    """Make entry (p, q) zero by a rotation; False if it is negligible beside the diagonal."""
    off = work[p, q]
    a = work[p, p]
    b = work[q, q]
    if abs(a) + abs(off) == abs(a) and abs(b) + abs(off) == abs(b):
        return False
    cotangent = (b - a) / (2.0 * off)  # of twice the angle
    tangent = 1.0 / (abs(cotangent) + np.sqrt(cotangent * cotangent + 1.0))
    if cotangent < 0.0:
        tangent = -tangent
    cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for i in range(len(work)):
        x, y = vectors[i, p], vectors[i, q]
        vectors[i, p], vectors[i, q] = cosine * x - sine * y, sine * x + cosine * y
        if i not in (p, q):
            x, y = work[i, p], work[i, q]
            x, y = cosine * x - sine * y, sine * x + cosine * y
            work[i, p], work[p, i], work[i, q], work[q, i] = x, x, y, y
    work[p, p], work[q, q] = a - tangent * off, b + tangent * off
    work[p, q] = work[q, p] = 0.0
    return True


@inner
def _sort(values: FloatArray, vectors: FloatArray) -> None:
    for i in range(1, len(values)):
        at = i
        while at > 0 and values[at - 1] > values[at]:
            values[at - 1], values[at] = values[at], values[at - 1]
            for row in range(len(values)):
                x = vectors[row, at]
                vectors[row, at] = vectors[row, at - 1]
                vectors[row, at - 1] = x
            at -= 1


@inner
def _orient(vectors: FloatArray) -> None:
    n = len(vectors)
    for column in range(n):
        largest = 0
        for i in range(1, n):
            if abs(vectors[i, column]) > abs(vectors[largest, column]):
                largest = i
        if vectors[largest, column] < 0.0:
            for i in range(n):
                vectors[i, column] = -vectors[i, column]
