"""Images of one channel: depth as messages carry it, and files of any numbers."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError
from PIL.TiffImagePlugin import BITSPERSAMPLE, SAMPLEFORMAT, TiffImageFile

from chsel.errors import SessionError
from chsel.numerics.arrays import refuse_special_file
from runners.sensors.log.messages import UnusableMessage

_KINDS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_COMPRESSED_DEPTH = struct.Struct("<iff")  # format, and the quantisation's two numbers
_FORMATS = {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"}


def pixel_rows(
    data: bytes, encoding: str, *, size: tuple[int, int], step: int, big_endian: bool = False
) -> np.ndarray:
    """Return values (H, W), uint16 or float32, of rows of `step` bytes.

    size: width, height, pixels.
    """
    width, height = size
    if encoding not in _KINDS:
        kinds = ", ".join(_KINDS)
        raise UnusableMessage(f"encoding {encoding!r} is no depth; accepted: {kinds}")
    kind = np.dtype(_KINDS[encoding]).newbyteorder(">" if big_endian else "<")
    row = width * kind.itemsize
    if row * height == len(data):
        step = row  # drivers leave it at 0
    if not 0 < row <= step or height < 1 or step * height != len(data):
        raise UnusableMessage(
            f"an image of {width} x {height} in rows of {step} bytes cannot have {len(data)} bytes"
        )
    rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, :row]
    return np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="), copy=False)


def compressed_pixels(data: bytes, image_format: str) -> np.ndarray:
    """Return values (H, W) of a PNG, as sensor_msgs/CompressedImage has it.

    They are uint16, or float32, metres.

    Formats of "compressedDepth" begin with 12 bytes; theirs of floating point hold the inverse
    depth as whole numbers n > 0, depth = a / (n - b), and 0 where there is none.
    """
    encoding, _, transport = image_format.partition(";")
    if "compressedDepth" not in transport:
        return _png_pixels(data)
    if "rvl" in transport.lower():
        raise UnusableMessage("compressedDepth by RVL is not read; accepted: PNG")
    pixels = _png_pixels(data[_COMPRESSED_DEPTH.size :])
    if encoding.strip() != "32FC1":
        return pixels
    _, scale, offset = _COMPRESSED_DEPTH.unpack_from(data)
    with np.errstate(all="ignore"):
        depth = scale / (pixels.astype(np.float64) - offset)
        depth = depth.astype(np.float32)
    depth[(pixels == 0) | ~(depth > 0.0)] = np.nan
    return depth


def _png_pixels(data: bytes) -> np.ndarray:
    """Return values (H, W), uint16, of a grey PNG of 16 bits."""
    try:
        image = Image.open(BytesIO(data), formats=("PNG",))
        values = np.asarray(image)
    except Exception as error:  # Pillow raises whatever it stumbles over
        kind = "a JPEG, which is lossy" if data.startswith(b"\xff\xd8") else type(error).__name__
        raise UnusableMessage(f"an image is no PNG ({kind}); accepted: PNG of 16 bits") from None
    if not image.mode.startswith("I"):
        raise UnusableMessage(f"a PNG of mode {image.mode} is no depth; accepted: 16 bits")
    return values.astype(np.uint16, copy=False)


def _is_unsigned(image: Image.Image) -> bool:
    """Return whether Pillow reads numbers of 32 bits as signed ones that are not."""
    if not isinstance(image, TiffImageFile) or image.mode != "I":
        return False
    tags = image.tag_v2
    return tags.get(BITSPERSAMPLE) == (32,) and tags.get(SAMPLEFORMAT, (1,)) == (1,)


def read_image(path: Path, where: str) -> np.ndarray:
    """Return the stored values (H, W) of a .png, .tiff or .npy: integers or floating point.

    Palette images give their indices. where: names the file in messages. Raise SessionError for
    a file that is missing, broken, or of several channels.
    """
    kind = path.suffix.lower()
    refuse_special_file(f"{where} {path}", path, error=SessionError)
    try:
        if kind == ".npy":
            values = np.load(path, allow_pickle=False)
        elif kind in _FORMATS:
            with Image.open(path, formats=(_FORMATS[kind],)) as image:
                values = np.asarray(image)
                if _is_unsigned(image):
                    values = values.view(np.uint32)
        else:
            raise SessionError("of no known kind")
    except UnidentifiedImageError:
        raise SessionError(
            f"{where} {path}: not a {_FORMATS[kind]} that is read; accepted: integers of 8, 16 or "
            "32 bits, or float32 (tifffile writes numpy's float64 as it is)"
        ) from None
    except Exception as error:  # numpy and Pillow raise whatever they stumble over
        reason = " ".join(str(error).split())[:120]
        raise SessionError(f"{where} {path}: {reason}; accepted: .png, .tiff, .npy") from None
    if values.ndim != 2 or values.dtype.kind not in "buif":
        raise SessionError(
            f"{where} {path}: {values.dtype} of shape {values.shape}; accepted: numbers, (height, "
            "width), one channel"
        )
    return values.astype(np.uint8) if values.dtype.kind == "b" else values
