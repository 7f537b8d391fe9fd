"""Images of one channel: depth as messages carry it, and files of any numbers."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from chsel.errors import SessionError
from runners.sensors.log.messages import UnusableMessage

_KINDS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_PNG = b"\x89PNG\r\n\x1a\n"
_COMPRESSED_DEPTH = struct.Struct("<iff")  # format, and the quantisation's two numbers
_FORMATS = {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"}


def pixel_rows(
    data: bytes, encoding: str, size: tuple[int, int], step: int, *, big_endian: bool = False
) -> np.ndarray:
    """Values (H, W), uint16 or float32, of rows of `step` bytes; size: width, height, pixels."""
    width, height = size
    if encoding not in _KINDS:
        kinds = ", ".join(_KINDS)
        raise UnusableMessage(f"encoding {encoding!r} is no depth; accepted: {kinds}")
    kind = np.dtype(_KINDS[encoding]).newbyteorder(">" if big_endian else "<")
    row = width * kind.itemsize
    if not 0 < row <= step or height < 1 or step * height != len(data):
        raise UnusableMessage(
            f"an image of {width} x {height} in rows of {step} bytes cannot have {len(data)} bytes"
        )
    rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, :row]
    return np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="), copy=False)


def png_pixels(data: bytes) -> np.ndarray:
    """Values (H, W), uint16, of a grey PNG of 16 bits."""
    if not data.startswith(_PNG):
        kind = "JPEG, which is lossy, is" if data.startswith(b"\xff\xd8") else "this is"
        raise UnusableMessage(f"{kind} no depth; accepted: PNG")
    try:
        with Image.open(BytesIO(data), formats=("PNG",)) as image:
            if not image.mode.startswith("I"):
                raise UnusableMessage(f"a PNG of mode {image.mode} is no depth; accepted: 16 bit")
            return np.asarray(image).astype(np.uint16, copy=False)
    except UnusableMessage:
        raise
    except Exception as error:  # Pillow raises whatever it stumbles over
        raise UnusableMessage(f"a PNG is broken: {type(error).__name__}") from None


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


def read_image(path: Path, where: str) -> np.ndarray:
    """The values (H, W) of a .png, .tiff or .npy as they stand there: integers or floating point.

    Palette images give their indices. where: names the file in messages. Raises SessionError for
    a file that is missing, broken, or of several channels.
    """
    kind = path.suffix.lower()
    if kind not in (".npy", *_FORMATS):
        raise SessionError(f"{where} {path}: of no known kind; accepted: .png, .tiff, .npy")
    if not path.is_file():
        raise SessionError(f"{where} {path}: no such file; accepted: a .png, .tiff or .npy file")
    try:
        if kind == ".npy":
            values = np.load(path, allow_pickle=False)
        else:
            with Image.open(path, formats=(_FORMATS[kind],)) as image:
                values = np.asarray(image)
    except Exception as error:  # numpy and Pillow raise whatever they stumble over
        reason = " ".join(str(error).split())[:120]
        raise SessionError(f"{where} {path}: broken ({reason}); accepted: {kind}") from None
    if values.ndim != 2 or values.dtype.kind not in "buif":
        raise SessionError(
            f"{where} {path}: {values.dtype} of shape {values.shape}; accepted: numbers, (height, "
            "width), one channel"
        )
    return values.astype(np.uint8) if values.dtype.kind == "b" else values
