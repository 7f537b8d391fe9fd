"""Depth images as messages carry them: rows of numbers, PNG, and image_transport's own format."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO

import numpy as np
from PIL import Image

from runners.sensors.log.messages import UnusableMessage

MOST_PIXELS = 2**25  # a 33-megapixel image; the largest depth cameras have a tenth of it
_KINDS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_HEAD = struct.Struct(">I4sIIBB")  # length, IHDR, width, height, bits, colours
_GREY = 0
_COLOURS = {2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_COMPRESSED_DEPTH = struct.Struct("<iff")  # format, and the quantisation's two numbers
_PILLOW_ERRORS = (
    OSError,
    ValueError,
    SyntaxError,  # how Pillow calls a broken PNG
    EOFError,
    OverflowError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)


def pixel_rows(
    data: bytes, encoding: str, size: tuple[int, int], step: int, *, big_endian: bool = False
) -> np.ndarray:
    """Values (H, W), uint16 or float32, of rows of `step` bytes; size: width, height, pixels."""
    width, height = size
    if encoding not in _KINDS:
        kinds = ", ".join(_KINDS)
        raise UnusableMessage(f"encoding {encoding!r} is no depth; accepted: {kinds}")
    _check_size(width, height)
    kind = np.dtype(_KINDS[encoding]).newbyteorder(">" if big_endian else "<")
    row = width * kind.itemsize
    if step < row or step * height != len(data):
        raise UnusableMessage(
            f"an image of {width} x {height} in rows of {step} bytes cannot have {len(data)} bytes"
        )
    rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, :row]
    return np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="), copy=False)


def png_pixels(data: bytes) -> np.ndarray:
    """Values (H, W), uint16, of a grey PNG of 16 bits; its size is looked at before it is made."""
    if not data.startswith(_PNG):
        kind = "JPEG, which is lossy, is" if data.startswith(b"\xff\xd8") else "this is"
        raise UnusableMessage(f"{kind} no depth; accepted: PNG")
    if len(data) < len(_PNG) + _PNG_HEAD.size:
        raise UnusableMessage("a PNG ends within its head")
    _, name, width, height, bits, colours = _PNG_HEAD.unpack_from(data, len(_PNG))
    if name != b"IHDR":
        raise UnusableMessage("a PNG has no head")
    if bits != 16 or colours != _GREY:
        kind = _COLOURS.get(colours, "grey")
        raise UnusableMessage(f"a PNG of {bits} bits, {kind}, is no depth; accepted: 16, grey")
    _check_size(width, height)
    try:
        with Image.open(BytesIO(data), formats=("PNG",)) as image:
            pixels = np.asarray(image)
    except _PILLOW_ERRORS as error:
        raise UnusableMessage(f"a PNG is broken: {type(error).__name__}") from None
    if pixels.shape != (height, width):
        raise UnusableMessage(f"a PNG has another size than {width} x {height}, as it says")
    return pixels.astype(np.uint16, copy=False)


def compressed_pixels(data: bytes, image_format: str) -> np.ndarray:
    """Values (H, W) of an image of sensor_msgs/CompressedImage: uint16, or float32, metres.

    Formats of "compressedDepth" begin with 12 bytes; theirs of floating point hold the inverse
    depth as whole numbers n > 0, depth = a / (n - b), and 0 where there is none.
    """
    encoding, _, transport = image_format.partition(";")
    if "compressedDepth" not in transport:
        return png_pixels(data)
    if "rvl" in transport.lower():
        raise UnusableMessage("compressedDepth by RVL is not read; accepted: PNG")
    if len(data) < _COMPRESSED_DEPTH.size:
        raise UnusableMessage("an image of compressedDepth ends within its head")
    _, scale, offset = _COMPRESSED_DEPTH.unpack_from(data)
    pixels = png_pixels(data[_COMPRESSED_DEPTH.size :])
    if encoding.strip() != "32FC1":
        return pixels
    if not (np.isfinite(scale) and np.isfinite(offset) and scale > 0.0):
        raise UnusableMessage(f"the quantisation of a depth image is {scale:.3g}, {offset:.3g}")
    with np.errstate(all="ignore"):
        depth = scale / (pixels.astype(np.float64) - offset)
        depth = depth.astype(np.float32)
    depth[(pixels == 0) | ~(depth > 0.0)] = np.nan
    return depth


def _check_size(width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        raise UnusableMessage(
            f"an image of {width} x {height} pixels; accepted: 1 to {MOST_PIXELS} of them"
        )
