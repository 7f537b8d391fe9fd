"""An image of one channel from a file: .png, .tiff or .npy."""

from __future__ import annotations

import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from chsel.errors import SessionError

MOST_PIXELS = 2**25
_FORMATS = {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"}
_BROKEN = (
    OSError,
    ValueError,
    SyntaxError,  # how Pillow calls a broken PNG
    EOFError,
    OverflowError,
    TypeError,
    KeyError,
    IndexError,
    MemoryError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
    Image.DecompressionBombWarning,
)


def read_image(path: Path, where: str) -> np.ndarray:
    """The values (H, W) of an image as they stand in the file: integers or floating point.

    Palette images give their indices. where: names the file in messages. Raises SessionError for
    a file that is missing, broken, of several channels, or too large, before it is decoded.
    """
    kind = path.suffix.lower()
    if kind not in (".npy", *_FORMATS):
        raise SessionError(f"{where} {path}: of no known kind; accepted: .png, .tiff, .npy")
    if not path.is_file():
        raise SessionError(f"{where} {path}: no such file; accepted: a .png, .tiff or .npy file")
    try:
        values = _array(path) if kind == ".npy" else _picture(path, _FORMATS[kind])
    except SessionError as error:
        raise SessionError(f"{where} {path}: {error}") from None
    except _BROKEN as error:
        reason = " ".join(str(error).split())[:120]
        raise SessionError(f"{where} {path}: broken ({reason}); accepted: {kind}") from None
    return values


def _array(path: Path) -> np.ndarray:
    # Mapped, so that a shape larger than the file is an error rather than memory.
    mapped = np.load(path, mmap_mode="r", allow_pickle=False)
    if mapped.dtype.kind not in "uif" or mapped.ndim != 2:
        raise SessionError(
            f"type {mapped.dtype} and shape {mapped.shape}; accepted: numbers, (height, width)"
        )
    _check_size(mapped.shape[1], mapped.shape[0])
    return np.array(mapped)


def _picture(path: Path, kind: str) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        with Image.open(path, formats=(kind,)) as image:
            _check_size(*image.size)
            values = np.asarray(image)
    if values.ndim != 2 or values.dtype.kind not in "buif":
        raise SessionError(f"mode {image.mode}; accepted: one channel of numbers")
    return values.astype(np.uint8) if values.dtype.kind == "b" else values


def _check_size(width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        raise SessionError(f"{width} x {height} pixels; accepted: 1 to {MOST_PIXELS} of them")
