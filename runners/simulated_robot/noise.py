"""The noise of depth sensors: a stereo camera, worst at occlusion edges, and the bubbles."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from chsel.numerics.arrays import FloatArray
from chsel.problem.streams import normals
from chsel.sensing.depth_camera import PinholeCamera

EDGE = 0.03  # m: a jump of depth among neighbours that is an occlusion edge
NOISE = 0.0025  # m: standard deviation at 1 m; it grows with the depth squared
BASELINE = 0.05  # m: between the two eyes of the outer camera
NEAREST = 0.15  # m: the outer camera measures nothing nearer
FURTHEST = 5.0  # m: nor further
PATCH = 8  # pixels of 640: the size of the patches that a stereo camera matches
STRAY = 2.5  # pixels of 640: how far off a matched patch is, standard deviation
LOST = 0.004  # of all pixels
LOST_AT_EDGES = 0.4
LOST_IN_SHADOW = 0.8  # where one eye sees what the other does not
FLYING = 0.25  # of the pixels at edges
_WIDTH = 640  # pixels, of the numbers above

BUBBLE_NOISE = 0.0003  # m: standard deviation
BUBBLE_STEP = 0.0001  # m: to which a bubble's camera rounds
BUBBLE_LOST = 0.001


def stereo_depth(  # noqa: PLR0917
    depth: FloatArray, camera: PinholeCamera, stream: np.random.Generator
) -> np.ndarray:
    """Return what the outer camera measures of depths (H, W), metres: uint16 mm, 0 for none.

    Whole patches are matched a little beside where they are, so that a band along every edge
    reports the wrong side of it; some pixels at edges float between both sides; pixels that only
    one eye sees are mostly lost; and all depths are noisy by the square of their size.
    """
    scale = camera.width / _WIDTH
    shadow = _shadow(depth, camera.fx * BASELINE)
    measured = _strayed(depth, PATCH * scale, stray=STRAY * scale, stream=stream)
    low, high = ndimage.minimum_filter(depth, 3), ndimage.maximum_filter(depth, 3)
    low, high = np.minimum(low, measured), np.maximum(high, measured)
    edge = high - low > EDGE
    chance, mix = stream.random((2, *depth.shape))
    flying = edge & (chance < FLYING)
    measured = np.where(flying, low + mix * (high - low), measured)
    measured = measured + NOISE * measured**2 * normals(stream, depth.shape)
    chance = stream.random(depth.shape)
    lost = chance < np.where(shadow, LOST_IN_SHADOW, np.where(edge, LOST_AT_EDGES, LOST))
    lost |= (measured < NEAREST) | (measured > FURTHEST)
    return np.where(lost, 0.0, np.rint(measured * 1000.0)).astype(np.uint16)


def bubble_depth(depth: FloatArray, stream: np.random.Generator) -> np.ndarray:
    """Return what a bubble's camera measures of depths (H, W): float32 metres, 0 for none."""
    measured = depth + BUBBLE_NOISE * normals(stream, depth.shape)
    measured = np.rint(measured / BUBBLE_STEP) * BUBBLE_STEP
    return np.where(stream.random(depth.shape) < BUBBLE_LOST, 0.0, measured).astype(np.float32)


def _strayed(
    depth: FloatArray, patch: float, *, stray: float, stream: np.random.Generator
) -> FloatArray:
    """Return depths (H, W), each taken from some pixels beside; near pixels stray alike."""
    height, width = depth.shape
    side = max(round(patch), 1)
    coarse = (2, -(-height // side) + 1, -(-width // side) + 1)
    offsets = stray * normals(stream, coarse)
    v, u = np.indices(depth.shape)
    # Between the corners of patches the offsets are those of the nearest corner, at random, or
    # else straight borders of patches would show along the edges.
    jitter = stream.random((2, height, width))
    at = np.floor(v / side + jitter[0]).astype(int), np.floor(u / side + jitter[1]).astype(int)
    rows = np.clip(np.rint(v + offsets[0][at]), 0, height - 1).astype(int)
    columns = np.clip(np.rint(u + offsets[1][at]), 0, width - 1).astype(int)
    return depth[rows, columns]


def _shadow(depth: FloatArray, focal_baseline: float) -> np.ndarray:
    """Return the pixels (H, W) that the right eye does not see, as something nearer covers them.

    There, pixel u is at u - focal * baseline / depth; what comes from further right covers it.
    """
    seen = np.arange(depth.shape[1]) - focal_baseline / depth
    least = np.minimum.accumulate(seen[:, ::-1], axis=1)[:, ::-1]
    return seen > least + 1.0
