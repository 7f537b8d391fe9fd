"""Mean squared distances between an object's surface in one pose and in another, from its SDF."""

from __future__ import annotations

from typing import NamedTuple

from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Places, locate, places_for
from chsel.numerics.compiler import compiled, leaf
from chsel.problem.sdf_lookup import DistanceField, distance_beyond_box, distance_in_box


class Moved(NamedTuple):
    """Scratch of one thread."""

    places: Places


def moved_for(points: int) -> Moved:
    """Scratch for so many surface points."""
    return Moved(places_for(points))


@leaf
def _after(left, b, right, p):
    """The move by row p of `right`, then by row b of `left`: R x + t of twelve numbers."""
    a, c, d = left[b, 0], left[b, 1], left[b, 2]
    e, f, g = left[b, 3], left[b, 4], left[b, 5]
    h, i, j = left[b, 6], left[b, 7], left[b, 8]
    k, m, n = right[p, 0], right[p, 1], right[p, 2]
    o, q, r = right[p, 3], right[p, 4], right[p, 5]
    s, t, u = right[p, 6], right[p, 7], right[p, 8]
    x, y, z = right[p, 9], right[p, 10], right[p, 11]
    return (
        a * k + c * o + d * s,
        a * m + c * q + d * t,
        a * n + c * r + d * u,
        e * k + f * o + g * s,
        e * m + f * q + g * t,
        e * n + f * r + g * u,
        h * k + i * o + j * s,
        h * m + i * q + j * t,
        h * n + i * r + j * u,
        a * x + c * y + d * z + left[b, 9],
        e * x + f * y + g * z + left[b, 10],
        h * x + i * y + j * z + left[b, 11],
    )


@leaf
def _inverse(move):
    """x -> R^T x - R^T t."""
    x, y, z = move[9], move[10], move[11]
    u = move[0] * x + move[3] * y + move[6] * z
    v = move[1] * x + move[4] * y + move[7] * z
    w = move[2] * x + move[5] * y + move[8] * z
    return (
        move[0],
        move[3],
        move[6],
        move[1],
        move[4],
        move[7],
        move[2],
        move[5],
        move[8],
        -u,
        -v,
        -w,
    )


@compiled
def mean_squares(
    field: DistanceField, points, to_object, to_world, back, out, first, last, scratch
):
    """Fill out (B, P) with the mean of s^2 over points (3, Q), metres^2, of rows first to last.

    Points are moved by world_from_object, to_world (P, 12), then by object_from_world, to_object
    (B, 12); `back`: by the inverse of both instead.
    """
    places = scratch.places
    xs, ys, zs = points[0], points[1], points[2]
    for b in range(first, last):
        for p in range(len(to_world)):
            move = _after(to_object, b, to_world, p)
            if back:
                move = _inverse(move)
            locate(move, field.box, xs, ys, zs, places, len(xs))
            total = 0.0
            for n in range(len(xs)):
                inside = distance_in_box(field.trilinear, field.box, field.table, places, n)
                if places.beyond[n] > 0.0:
                    x, y, z = xs[n], ys[n], zs[n]
                    u = move[0] * x + move[1] * y + move[2] * z + move[9]
                    v = move[3] * x + move[4] * y + move[5] * z + move[10]
                    w = move[6] * x + move[7] * y + move[8] * z + move[11]
                    inside = distance_beyond_box(field.box_distance, field.box, inside, u, v, w)
                total += inside[0] * inside[0]
            out[b, p] = total / len(xs)


@compiled
def relative_moves(to_object: FloatArray, to_world: FloatArray, back, out: FloatArray):
    """Fill out (N, 12) with the moves by to_world (N, 12), then by to_object (N, 12).

    `back`: with the inverse of both instead.
    """
    for n in range(len(out)):
        move = _after(to_object, n, to_world, n)
        if back:
            move = _inverse(move)
        for i in range(12):
            out[n, i] = move[i]


@compiled
def moved_points(points: FloatArray, moves: FloatArray, out: FloatArray) -> None:
    """Fill out (N, Q, 3) with points (3, Q) moved by moves (N, 12)."""
    for n in range(len(moves)):
        for q in range(points.shape[1]):
            for i in range(3):
                total = moves[n, 3 * i] * points[0, q] + moves[n, 3 * i + 1] * points[1, q]
                out[n, q, i] = total + moves[n, 3 * i + 2] * points[2, q] + moves[n, 9 + i]
