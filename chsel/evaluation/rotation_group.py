"""Finite groups of rotations from approximate elements."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray

LARGEST = 60  # the icosahedron's; a larger one cannot be distinguished from revolution
_SAME = np.deg2rad(10.0)  # between two approximations of one element
_IMPROVEMENTS = 5


def angles_between(turns: FloatArray, others: FloatArray) -> FloatArray:
    """Angles (T, O), radians, between rotations (T, 3, 3) and (O, 3, 3)."""
    trace = turns.reshape(-1, 9) @ others.reshape(-1, 9).T
    return np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))


def is_among(turn: FloatArray, turns: FloatArray) -> bool:
    """Whether a rotation (3, 3) approximates one of others (T, 3, 3)."""
    return bool(angles_between(turn[None], turns).min() <= _SAME)


def distinct(turns: FloatArray, most: int) -> FloatArray:
    """Rotations (T, 3, 3) without those near an earlier one, at most so many."""
    kept: list[FloatArray] = []
    while len(turns) and len(kept) < most:
        kept.append(turns[0])
        turns = turns[angles_between(turns, turns[:1])[:, 0] > _SAME]
    return np.array(kept).reshape(-1, 3, 3)


def generated(turns: FloatArray) -> FloatArray | None:
    """The group (S, 3, 3) of all products of approximate rotations (T, 3, 3), the identity first.

    None if it has more than 60 elements, or is not a group. Every element is replaced by the mean
    of what the table of products says it is, which converges to an exact group (Grove, Karcher and
    Ruh, 1974, "Group actions and curvature").
    """
    turns = distinct(np.concatenate([np.eye(3)[None], turns]), LARGEST + 1)
    while True:
        products = np.einsum("iab,jbc->ijac", turns, turns).reshape(-1, 3, 3)
        angles = angles_between(products, turns)
        new = products[angles.min(axis=1) > _SAME]
        if len(new) == 0:
            break
        turns = np.concatenate([turns, distinct(new, LARGEST + 1)])
        if len(turns) > LARGEST:
            return None
    table = angles.argmin(axis=1).reshape(len(turns), len(turns))
    if (np.sort(table, axis=1) != np.arange(len(turns))).any():
        return None
    for _ in range(_IMPROVEMENTS):
        means = np.einsum("jba,jkbc->kac", turns, turns[table])
        left, _, right = np.linalg.svd(means)
        turns = left @ right
    turns[0] = np.eye(3)  # without the rounding
    return turns
