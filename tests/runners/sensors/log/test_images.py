"""Images and clouds as bytes: both orders of bytes, padding, and what is no depth."""

import struct

import numpy as np
import pytest

from runners.sensors.log.decoding import packed_points
from runners.sensors.log.images import compressed_pixels, pixel_rows
from runners.sensors.log.messages import UnusableMessage
from tests.runners.sensors.small_logs import png

VALUES = np.random.default_rng(0).integers(0, 2**16, (4, 7)).astype(np.uint16)


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("encoding", "kind"), [("16UC1", "u2"), ("mono16", "u2"), ("32FC1", "f4")])
@pytest.mark.parametrize("padding", [0, 3])
def test_rows_of_pixels(encoding, kind, big_endian, padding):
    stored = VALUES.astype((">" if big_endian else "<") + kind)
    rows = np.pad(stored.view(np.uint8).reshape(4, -1), ((0, 0), (0, padding)))
    found = pixel_rows(rows.tobytes(), encoding, (7, 4), rows.shape[1], big_endian=big_endian)
    assert found.dtype == np.dtype(kind)
    np.testing.assert_array_equal(found, VALUES)
    for size, step in (((7, 5), rows.shape[1]), ((7, 4), 7)):
        with pytest.raises(UnusableMessage, match=f"cannot have {rows.size} bytes"):
            pixel_rows(rows.tobytes(), encoding, size, step)


@pytest.mark.parametrize(
    ("data", "text", "reason"),
    [
        (png(VALUES.astype(np.uint8)), "png", "mode L"),
        (png(np.zeros((2, 2, 3), np.uint8)), "png", "mode RGB"),
        (png(VALUES)[:-40], "png", "is no PNG"),
        (b"\xff\xd8\xff\xe0", "jpeg", "JPEG"),
        (bytes(30), "16UC1; compressedDepth rvl", "RVL"),
        (b"short", "16UC1; compressedDepth", "is no PNG"),
    ],
)
def test_what_is_no_depth_is_refused(data, text, reason):
    with pytest.raises(UnusableMessage, match=reason):
        compressed_pixels(data, text)


def test_compressed_depth_is_that_of_image_transport():
    np.testing.assert_array_equal(compressed_pixels(png(VALUES), "png"), VALUES)
    whole = struct.pack("<iff", 0, 0.0, 0.0) + png(VALUES)
    np.testing.assert_array_equal(compressed_pixels(whole, "16UC1; compressedDepth png"), VALUES)
    depth = np.array([[0.5, 2.0], [8.0, np.nan]])  # as the sender quantises: n = a / depth + b
    scale, offset = 100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0
    numbers = np.where(np.isnan(depth), 0, np.rint(scale / np.nan_to_num(depth, nan=1.0) + offset))
    data = struct.pack("<iff", 1, scale, offset) + png(numbers.astype(np.uint16))
    found = compressed_pixels(data, "32FC1; compressedDepth")
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, depth, rtol=5e-3)


@pytest.mark.parametrize("order", ["<", ">"])
def test_points_of_several_rows_with_gaps(order):
    points = np.random.default_rng(1).normal(size=(2, 3, 3))
    points[..., 1] = points[..., 1].astype(np.float32)
    kinds = [order + kind for kind in ("f8", "f4", "f8")]
    layout = np.dtype(
        {"names": list("xyz"), "formats": kinds, "offsets": [8, 16, 0], "itemsize": 30}
    )
    packed = np.zeros((2, 3), layout)
    for axis, name in enumerate("xyz"):
        packed[name] = points[:, :, axis]
    rows = np.pad(packed.view(np.uint8).reshape(2, 90), ((0, 0), (0, 40)))
    fields = {"x": (8, 8), "intensity": (24, 4), "y": (16, 7), "z": (0, 8)}
    big = order == ">"
    found = packed_points(rows.tobytes(), fields, 30, size=(3, 2), row=130, big_endian=big)
    np.testing.assert_array_equal(found, points.reshape(-1, 3))
    for size in ((5, 2), (3, 3)):
        with pytest.raises(UnusableMessage, match="cannot have 260 bytes"):
            packed_points(rows.tobytes(), fields, 30, size=size, row=130)
    with pytest.raises(UnusableMessage, match="has no field z of float32 or float64"):
        packed_points(b"", {"x": (0, 7), "y": (4, 7), "z": (0, 5)}, 30, size=(0, 1), row=0)
    assert packed_points(b"", fields, 30, size=(0, 1), row=0).shape == (0, 3)
