"""Where a soft membrane with a camera behind it is pressed in (CHSEL, Sec. V-B)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import uniform_filter

from chsel.errors import PointsError, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray


def deformation(
    reference: FloatArray, depth: FloatArray, *, valid: BoolArray | None = None
) -> FloatArray:
    """How far (H, W), in metres, a membrane is pressed towards its camera.

    reference (H, W): depths of the untouched membrane. depth (H, W): depths now. 0 where either is
    missing (0, negative, not finite) or is not `valid` (H, W). Raises PointsError for shapes that
    differ.
    """
    reference, depth = np.asarray(reference, np.float64), np.asarray(depth, np.float64)
    if reference.shape != depth.shape:
        raise PointsError(
            f"the reference image has shape {reference.shape}; accepted: {depth.shape}, as the "
            "images that are compared with it"
        )
    measured = np.isfinite(reference) & np.isfinite(depth) & (reference > 0.0) & (depth > 0.0)
    if valid is not None:
        measured &= valid
    return np.subtract(reference, depth, out=np.zeros(depth.shape), where=measured)


def smooth(image: FloatArray, side: int) -> FloatArray:
    """The image (H, W) under a mean filter of side x side pixels; borders are reflected.

    An even side reaches one pixel further up and left than down and right. Values that are not
    finite count as 0; otherwise they would spread over their row and column.
    """
    require_positive("side of the filter", side)
    image = np.asarray(image, np.float64)
    return uniform_filter(np.where(np.isfinite(image), image, 0.0), size=side, mode="reflect")


def contact_mask(
    deformation: FloatArray,
    *,
    quantile: float,
    threshold: float,
    valid: BoolArray | None = None,
) -> BoolArray:
    """Pixels (H, W) in contact: deformed by more than a quantile of all and by over `threshold` m.

    valid (H, W): pixels that count; None: all.
    """
    counted = np.ones(deformation.shape, dtype=bool) if valid is None else np.asarray(valid)
    if not counted.any():
        return np.zeros(deformation.shape, dtype=bool)
    level = max(float(np.quantile(deformation[counted], quantile)), threshold)
    return counted & (deformation > level)


def contact_subset(count: int, most: int, stream: np.random.Generator) -> IntArray:
    """Ascending indices of at most `most` out of `count` pixels, every subset equally likely.

    All of them, without drawing from the stream, if there are no more than that.
    """
    if count <= most:
        return np.arange(count)
    return np.sort(np.argsort(stream.random(count), kind="stable")[:most])


def share(counts: Sequence[int], most: int) -> list[int]:
    """How many of at most `most` points each camera gets, in proportion to its count.

    They sum to `most`, or to all points if these are fewer. The remainders of the division go to
    the cameras with the largest fractions, to the first among equals.
    """
    total = sum(counts)
    if total <= most:
        return list(counts)
    shares = [count * most // total for count in counts]
    by_remainder = sorted(range(len(counts)), key=lambda n: -(counts[n] * most % total))
    for n in by_remainder[: most - sum(shares)]:
        shares[n] += 1
    return shares
