"""Errors of poses by the definitions of the BOP challenge (Hodan et al., ECCV 2018 and 2020).

    MSSD = min_S max_x |P x - T S x|     MSPD = min_S max_x |proj(P x) - proj(T S x)|

of an estimate P and the true pose T, over the vertices x of the model and the symmetries S that its
dataset declares. A continuous symmetry is sampled so finely that no vertex moves by more than 1 %
of the diameter from one to the next.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray, frozen
from chsel.problem.poses import axis_angle, compose, product, rotated

METRES = 0.001  # of a millimetre
_STEP = 0.01  # of the diameter, see above
_AT_ONCE = 2_000_000  # vertices times symmetries


class BopErrors(NamedTuple):
    """Errors of estimates."""

    surface: FloatArray  # MSSD (B,), metres
    projection: FloatArray  # MSPD (B,), pixels; infinite for what is not before the camera


def declared_symmetries(info: Mapping[str, Any]) -> FloatArray:
    """Return the symmetries (S, 4, 4), metres, of an object's entry in models_info.json.

    The identity first. Raise SettingError for an entry that is none.
    """
    discrete, axes = model_symmetries(info, scale=METRES)
    continuous = [np.eye(4)]
    for direction, offset in axes:
        axis = direction / np.sqrt((direction**2).sum())
        count = math.ceil(math.pi / _STEP)
        angles = np.arange(float(count)) * (2.0 * math.pi / count)
        turns = axis_angle(np.tile(axis, (count, 1)), angles)
        about = compose(turns, offset - rotated(turns, offset))
        continuous += list(about[1:])
    found = np.array([then @ first for first in [np.eye(4), *discrete] for then in continuous])
    return frozen("symmetries", found, shape=(None, 4, 4), error=SettingError)


def model_symmetries(info: Mapping[str, Any], *, scale: float) -> tuple[FloatArray, FloatArray]:
    """Return turns (T, 4, 4) and axes (K, 2, 3) of an object's entry in models_info.json, metres.

    As `chsel.ObjectSymmetry.declared` takes them. scale: metres in the unit of the entry. Raise
    SettingError for an entry that is none.
    """
    try:
        turns = np.zeros((0, 4, 4))
        if info.get("symmetries_discrete"):
            turns = np.array(info["symmetries_discrete"], dtype=np.float64).reshape(-1, 4, 4)
        turns[:, :3, 3] *= scale
        axes = np.zeros((0, 2, 3))
        if info.get("symmetries_continuous"):
            each = [(one["axis"], one["offset"]) for one in info["symmetries_continuous"]]
            axes = np.array(each, dtype=np.float64).reshape(-1, 2, 3)
        axes[:, 1] *= scale
        if not (axes[:, 0] != 0.0).any(axis=1).all():
            raise ValueError("an axis of length 0")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise SettingError(
            f"models_info has symmetries that are not read ({' '.join(str(error).split())}); "
            "accepted: symmetries_discrete of 16 numbers, symmetries_continuous of axis and offset"
        ) from None
    return turns, axes


def bop_errors(
    camera_from_object: FloatArray,
    truth: FloatArray,
    *,
    vertices: FloatArray,
    symmetries: FloatArray,
    camera: FloatArray,
) -> BopErrors:
    """Return the errors of estimates (B, 4, 4) to the true camera_from_object (4, 4), metres.

    vertices (V, 3): of the model. symmetries (S, 4, 4): see declared_symmetries. camera (3, 3): its
    matrix, pixels.
    """
    true_poses = product(truth[:3, :3], symmetries[:, :3, :3])
    true_places = rotated(truth[:3, :3], symmetries[:, :3, 3]) + truth[:3, 3]
    surface = np.full(len(camera_from_object), np.inf)
    projection = np.full(len(camera_from_object), np.inf)
    size = max(1, _AT_ONCE // len(vertices))
    for n, estimate in enumerate(camera_from_object):
        there = vertices @ estimate[:3, :3].T + estimate[:3, 3]
        seen = _projected(there, camera)
        for first in range(0, len(symmetries), size):
            some = slice(first, first + size)
            true = rotated(true_poses[some, None], vertices) + true_places[some, None]
            away = np.sqrt(((there - true) ** 2).sum(axis=-1)).max(axis=1)
            shifts = np.sqrt(((seen - _projected(true, camera)) ** 2).sum(axis=-1)).max(axis=1)
            surface[n] = min(surface[n], away.min())
            projection[n] = min(projection[n], np.nan_to_num(shifts, nan=np.inf).min())
    return BopErrors(surface, projection)


def _projected(points: FloatArray, camera: FloatArray) -> FloatArray:
    """Return pixels (..., 2) of points (..., 3); infinite where they are not before the camera."""
    depth = np.where(points[..., 2:] > 0.0, points[..., 2:], np.nan)
    return points[..., :2] / depth * np.diag(camera)[:2] + camera[:2, 2]
