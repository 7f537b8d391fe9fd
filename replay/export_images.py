"""The images of sensors as other programs read them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay.arguments import chosen_steps
from replay.events import SensorImage
from replay.export import Exported, require_any
from replay.mcap.reader import Recording

_NAMES = ("step", "sensor", "image", "kind", "height", "width", "counting", "unit")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_ENTRIES = tuple(f"m{row}{column}" for row in range(4) for column in range(4))


def exported_images(recording: Recording, steps: str | None) -> Exported:
    """The depth and deformation images of each step's sensors, in their order.

    npz: `steps` (S,), those with images; for image I of sensor NAME at step K, `step_K/NAME_I/`
    with `values` (H, W), `unit` (metres that 1 stands for; 0 is no measurement), `mask` (H, W),
    the pixels that count, `intrinsics` (4,), fx, fy, cx, cy in pixels, and `world_from_camera`
    (4, 4). csv, json: a row an image, without its pixels; m00 to m33 are world_from_camera.
    """
    require_any(recording, "image of a sensor", recording.image_steps)
    chosen = chosen_steps(steps, recording.image_steps)
    rows = [_row(number, seen) for number, seen in _numbered(recording, chosen)]
    header = (*_NAMES, *_INTRINSICS, *_ENTRIES)
    document = [dict(zip(header, row, strict=True)) for row in rows]
    return Exported(_arrays(recording, chosen), document, header, rows)


def _numbered(recording: Recording, steps: Sequence[int]) -> Iterator[tuple[int, SensorImage]]:
    """The images of some steps, one at a time, each with its number of its sensor and step."""
    counts: Counter[tuple[int, str]] = Counter()
    for seen in recording.sensor_images(steps):
        yield counts[seen.step, seen.sensor], seen
        counts[seen.step, seen.sensor] += 1


def _arrays(recording: Recording, steps: Sequence[int]) -> Iterator[tuple[str, NDArray[Any]]]:
    yield "steps", np.array(steps, dtype=np.int64)
    for number, seen in _numbered(recording, steps):
        folder = f"step_{seen.step}/{seen.sensor}_{number}"
        yield f"{folder}/unit", np.array(seen.unit)
        for name in ("values", "mask", "intrinsics", "world_from_camera"):
            yield f"{folder}/{name}", getattr(seen, name)


def _row(number: int, seen: SensorImage) -> tuple[Any, ...]:
    size = (*seen.values.shape, int(seen.mask.sum()), seen.unit)
    pose = seen.world_from_camera.ravel().tolist()
    return (seen.step, seen.sensor, number, seen.kind, *size, *seen.intrinsics.tolist(), *pose)
