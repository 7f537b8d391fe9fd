"""The least number in a window around every pixel of an image."""

from __future__ import annotations

from chsel.kernels.compiler import compiled


@compiled
def window_minimum(image, size):  # type: ignore[no-untyped-def]
    """Replace each pixel of image (H, W) by the least of the size x size right of and below it.

    Those of the last size - 1 rows and columns, whose windows are not whole, are of no use. Windows
    grow to twice their side each time, until they have the size.
    """
    rows, columns = image.shape
    side = 1
    while side < size:
        step = min(side, size - side)
        for row in range(rows - step):
            line, below = image[row], image[row + step]
            for column in range(columns):
                line[column] = min(line[column], below[column])
        for row in range(rows):
            line = image[row]
            for column in range(columns - step):
                line[column] = min(line[column], line[column + step])
        side += step
