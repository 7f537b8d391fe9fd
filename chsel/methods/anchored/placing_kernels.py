"""Blocks of poses that put points of the object's surface onto contacts.

All poses of a block go through a step together, each in a lane of vector instructions: a step is a
loop over the poses, over rows of one array, and tables are read in loops of their own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.compiler import inner, leaf

DRAWS = 6  # random numbers that a pose takes
LANES = 256  # poses of a block
DRAWN = LANES + 16  # room for the numbers that they draw for one purpose
# Rows of a block: rotations, translations, two points, and a frame with a third point.
ROTATION, SHIFT, _FROM, _ONTO, _FRAME = 0, 9 * LANES, 12 * LANES, 15 * LANES, 18 * LANES
PLACED = 12 * LANES  # from here on, rows are free once poses are placed
FURTHER = 30 * LANES  # a row that placing leaves to others
ROWS = 31
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_TWO, _FOUR = np.float32(2.0), np.float32(4.0)
_ALIKE = np.float32(1e-9)  # squared lengths below which a vector has no direction
_FAR = np.float32(0.6)  # from an axis: the cosine of the angle to it is less
_QUARTER_TURN = np.float32(0.5 * np.pi)
_SINE = tuple(np.float32(c) for c in (-1 / 5040, 1 / 120, -1 / 6))
_COSINE = tuple(np.float32(c) for c in (1 / 40320, -1 / 720, 1 / 24, -1 / 2))


class Anchors(NamedTuple):
    """Contacts, and the points of the object's surface that can be put onto them.

    A span is the first index and the number of them.
    """

    kinds: tuple[int, int]  # how many poses are placed by pairs, and by pairs or single contacts
    surface: Any  # (Q, 3), object frame
    normals: Any  # (Q, 3)
    by_distance: Any  # (P, 2), pairs of surface points by their distance
    frames: Any  # (C, 12), two contacts: a frame along their line row by row, then their middle
    pair_spans: Any  # (C, 2), in by_distance, of the surface pairs as far apart
    singles: Any  # (S, 4), a contact, and its signed distance
    single_spans: Any  # (S, 2), in by_height, of the surface points that can meet it
    by_height: Any  # (Q,), surface points in the order of their heights over a plane
    lower: Any  # (3,), where the object's origin may be in the world
    upper: Any  # (3,)
    planar: bool
    plane: Any  # (31,), if planar: a, o, then R_0, hat(a) R_0 and hat(a)^2 R_0 row by row


@inner
def place(anchors, draws, count, number, lanes):
    """Fill the rotations and translations of a block from draws, DRAWS rows of DRAWN numbers.

    number: of its first pose among all, which are of one kind up to the last of the block.
    """
    pairs, anchored = anchors.kinds
    if number < pairs:
        _place_on_pairs(anchors, draws, count, lanes)
    else:
        _turn(anchors, draws, count, lanes)
        if number < anchored:
            _place_on_contacts(anchors, draws, count, lanes)
        else:
            _place_anywhere(anchors, draws, count, lanes)
        if anchors.planar:
            _put_on_plane(anchors.plane, lanes, count)


@leaf
def _index(share, size):
    """Which of `size` things a share from 0 to 1 chooses."""
    return min(int(share * np.float32(size)), size - 1)


@leaf
def _sine_cosine(share):
    """Sine and cosine of a share of a turn, 0 to 1, to about seven digits."""
    quarters = share * _FOUR
    quadrant = np.int32(quarters + HALF)
    r = (quarters - np.float32(quadrant)) * _QUARTER_TURN
    z = r * r
    sine = r + r * z * ((_SINE[0] * z + _SINE[1]) * z + _SINE[2])
    cosine = ONE + z * (((_COSINE[0] * z + _COSINE[1]) * z + _COSINE[2]) * z + _COSINE[3])
    odd = quadrant & 1
    a = cosine if odd else sine
    b = sine if odd else cosine
    a = -a if quadrant & 2 else a
    b = -b if (quadrant + 1) & 2 else b
    return a, b


@inner
def _turn(anchors, draws, count, lanes):
    """Rotations, uniform on SO(3) (Shoemake, 1992), or about the plane's axis."""
    if anchors.planar:
        p = anchors.plane
        for i in range(count):
            sine, cosine = _sine_cosine(draws[3 * DRAWN + i])
            back = ONE - cosine
            for j in range(9):
                turned = p[4 + j] + sine * p[13 + j] + back * p[22 + j]
                lanes[j * LANES + i] = turned
        return
    for i in range(count):
        s, c = _sine_cosine(draws[3 * DRAWN + i])
        sine, cosine = _sine_cosine(draws[4 * DRAWN + i])
        share = draws[5 * DRAWN + i]
        small, large = np.sqrt(ONE - share), np.sqrt(share)
        w, x, y, z = small * s, small * c, large * sine, large * cosine
        lanes[i] = ONE - _TWO * (y * y + z * z)
        lanes[LANES + i] = _TWO * (x * y - w * z)
        lanes[2 * LANES + i] = _TWO * (x * z + w * y)
        lanes[3 * LANES + i] = _TWO * (x * y + w * z)
        lanes[4 * LANES + i] = ONE - _TWO * (x * x + z * z)
        lanes[5 * LANES + i] = _TWO * (y * z - w * x)
        lanes[6 * LANES + i] = _TWO * (x * z - w * y)
        lanes[7 * LANES + i] = _TWO * (y * z + w * x)
        lanes[8 * LANES + i] = ONE - _TWO * (x * x + y * y)


@inner
def _place_on_contacts(anchors, draws, count, lanes):
    """Translations that put a surface point, or one at the known distance, onto a contact."""
    singles, surface, normals = anchors.singles, anchors.surface, anchors.normals
    for i in range(count):
        single = _index(draws[i], len(singles))
        first, size = anchors.single_spans[single, 0], anchors.single_spans[single, 1]
        q = anchors.by_height[first + _index(draws[DRAWN + i], size)]
        for j in range(3):
            lanes[_FROM + j * LANES + i] = singles[single, j]
            lanes[_ONTO + j * LANES + i] = surface[q, j] + singles[single, 3] * normals[q, j]
    _move(lanes, count)


@inner
def _place_anywhere(anchors, draws, count, lanes):
    """Translations that put the object's origin anywhere in its bounds."""
    for i in range(count):
        for j in range(3):
            low, high = anchors.lower[j], anchors.upper[j]
            lanes[_FROM + j * LANES + i] = low + draws[j * DRAWN + i] * (high - low)
            lanes[_ONTO + j * LANES + i] = ZERO
    _move(lanes, count)


@inner
def _move(lanes, count):
    """Translations that move a point p onto another: t = q - R p."""
    for i in range(count):
        x, y, z = lanes[_FROM + i], lanes[_FROM + LANES + i], lanes[_FROM + 2 * LANES + i]
        u = lanes[i] * x + lanes[LANES + i] * y + lanes[2 * LANES + i] * z
        v = lanes[3 * LANES + i] * x + lanes[4 * LANES + i] * y + lanes[5 * LANES + i] * z
        w = lanes[6 * LANES + i] * x + lanes[7 * LANES + i] * y + lanes[8 * LANES + i] * z
        lanes[SHIFT + i] = lanes[_ONTO + i] - u
        lanes[SHIFT + LANES + i] = lanes[_ONTO + LANES + i] - v
        lanes[SHIFT + 2 * LANES + i] = lanes[_ONTO + 2 * LANES + i] - w


@inner
def _put_on_plane(plane, lanes, count):
    """Move poses along the plane's axis onto the plane: a . t = o."""
    a, b, c, offset = plane[0], plane[1], plane[2], plane[3]
    for i in range(count):
        u, v, w = lanes[SHIFT + i], lanes[SHIFT + LANES + i], lanes[SHIFT + 2 * LANES + i]
        off = offset - (a * u + b * v + c * w)
        lanes[SHIFT + i] = u + off * a
        lanes[SHIFT + LANES + i] = v + off * b
        lanes[SHIFT + 2 * LANES + i] = w + off * c


@inner
def _place_on_pairs(anchors, draws, count, lanes):
    """Poses that put two surface points onto the line of two contacts, turned about it."""
    surface, frames = anchors.surface, anchors.frames
    for i in range(count):
        pair = _index(draws[i], len(frames))
        first, size = anchors.pair_spans[pair, 0], anchors.pair_spans[pair, 1]
        at = first + _index(draws[DRAWN + i], size)
        flip = 1 if draws[2 * DRAWN + i] < HALF else 0
        k, m = anchors.by_distance[at, flip], anchors.by_distance[at, 1 - flip]
        for j in range(3):
            lanes[_FROM + j * LANES + i] = surface[k, j]
            lanes[_ONTO + j * LANES + i] = surface[m, j]
        for j in range(12):
            lanes[_FRAME + j * LANES + i] = frames[pair, j]
    _turn_pairs(draws, count, lanes)


@inner
def _turn_pairs(draws, count, lanes):
    """R = G^T F, with the frames' vectors as rows, and t = q - R p of the middles."""
    for i in range(count):
        sine, cosine = _sine_cosine(draws[3 * DRAWN + i])
        d, e, f = lanes[_FROM + i], lanes[_FROM + LANES + i], lanes[_FROM + 2 * LANES + i]
        u, v, w = lanes[_ONTO + i], lanes[_ONTO + LANES + i], lanes[_ONTO + 2 * LANES + i]
        x, y, z = u - d, v - e, w - f
        over = ONE / np.sqrt(max(x * x + y * y + z * z, _ALIKE))
        x, y, z = x * over, y * over, z * over
        # The cross product with an axis that it is far from.
        first = abs(x) < _FAR
        a, b, c = (ZERO if first else z), (-z if first else ZERO), (y if first else -x)
        over = ONE / np.sqrt(max(a * a + b * b + c * c, _ALIKE))
        a, b, c = a * over, b * over, c * over
        g, h, k = y * c - z * b, z * a - x * c, x * b - y * a
        p, q, r = cosine * a + sine * g, cosine * b + sine * h, cosine * c + sine * k
        g, h, k = cosine * g - sine * a, cosine * h - sine * b, cosine * k - sine * c
        mx, my, mz = (
            lanes[_FRAME + 9 * LANES + i],
            lanes[_FRAME + 10 * LANES + i],
            lanes[_FRAME + 11 * LANES + i],
        )
        fa, fb, fc = lanes[_FRAME + i], lanes[_FRAME + LANES + i], lanes[_FRAME + 2 * LANES + i]
        fd, fe, ff = (
            lanes[_FRAME + 3 * LANES + i],
            lanes[_FRAME + 4 * LANES + i],
            lanes[_FRAME + 5 * LANES + i],
        )
        fg, fh, fi = (
            lanes[_FRAME + 6 * LANES + i],
            lanes[_FRAME + 7 * LANES + i],
            lanes[_FRAME + 8 * LANES + i],
        )
        ra, rb, rc = x * fa + p * fd + g * fg, x * fb + p * fe + g * fh, x * fc + p * ff + g * fi
        rd, re, rf = y * fa + q * fd + h * fg, y * fb + q * fe + h * fh, y * fc + q * ff + h * fi
        rg, rh, ri = z * fa + r * fd + k * fg, z * fb + r * fe + k * fh, z * fc + r * ff + k * fi
        lanes[i], lanes[LANES + i], lanes[2 * LANES + i] = ra, rb, rc
        lanes[3 * LANES + i], lanes[4 * LANES + i], lanes[5 * LANES + i] = rd, re, rf
        lanes[6 * LANES + i], lanes[7 * LANES + i], lanes[8 * LANES + i] = rg, rh, ri
        lanes[SHIFT + i] = HALF * (d + u) - (ra * mx + rb * my + rc * mz)
        lanes[SHIFT + LANES + i] = HALF * (e + v) - (rd * mx + re * my + rf * mz)
        lanes[SHIFT + 2 * LANES + i] = HALF * (f + w) - (rg * mx + rh * my + ri * mz)
