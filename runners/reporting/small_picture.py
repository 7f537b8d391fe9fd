"""Pictures as small files."""

from __future__ import annotations

import io
from collections.abc import Sequence

from PIL import Image

_COLORS = 256
_QUALITY = 62  # of 100, of an animation


def small_png(picture: bytes | Image.Image) -> bytes:
    """A picture (of a PNG file, or an image) in few colours, as a PNG file."""
    image = Image.open(io.BytesIO(picture)) if isinstance(picture, bytes) else picture
    stream = io.BytesIO()
    few = image.convert("RGB").quantize(
        _COLORS,
        method=Image.Quantize.FASTOCTREE,  # which keeps colours of few pixels, such as contacts
        dither=Image.Dither.NONE,
    )
    few.save(stream, format="png", optimize=True)
    return stream.getvalue()


def animation(frames: Sequence[Image.Image], milliseconds: Sequence[int]) -> bytes:
    """Frames of one size, each shown for its time, again and again, as a WebP file."""
    stream = io.BytesIO()
    first, *others = (frame.convert("RGB") for frame in frames)
    first.save(
        stream,
        format="webp",
        save_all=True,
        append_images=others,
        duration=list(milliseconds),
        loop=0,
        quality=_QUALITY,
        method=6,
    )
    return stream.getvalue()
