"""What all encodings share: names, times and numbers of messages, checked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from replay.mcap.texts import LONGEST_NAME, one_line
from runners.sensors.messages import (
    CameraInfoMessage,
    CloudMessage,
    Content,
    JointsMessage,
    MarkerMessage,
)
from runners.sensors.unusable import UnusableMessage

Said = tuple[int | None, Content | UnusableMessage]
"""The sender's time, nanoseconds, where it gave one, and one thing that a message says."""

_NANOSECONDS = 10**9
_END_OF_TIME = 2**63
_MOST_PIXELS_A_SIDE = 2**16


def stamp_of(seconds: int, nanoseconds: int) -> int | None:
    """A time in nanoseconds; None for 0, which says that there is none."""
    stamp = seconds * _NANOSECONDS + nanoseconds
    if not 0 <= stamp < _END_OF_TIME:
        raise UnusableMessage("its time stamp is no time")
    return stamp or None


@lru_cache(maxsize=1024)  # transforms repeat them hundreds of times a second
def frame_name(name: str, *, needed: bool = False) -> str:
    """The name of a frame without the slash that old programs put ahead."""
    name = name.removeprefix("/")
    if needed and not name:
        raise UnusableMessage("a transform lacks the name of a frame")
    if len(name) > LONGEST_NAME or one_line(name) != name:
        raise UnusableMessage("the name of a frame is no name on one line")
    return name


def intrinsics(
    frame: str,
    size: tuple[int, int],
    focal: tuple[float, float],
    centre: tuple[float, float],
    distortion: Sequence[float],
) -> CameraInfoMessage:
    """Intrinsics; UnusableMessage for those that are none, as of a camera without calibration."""
    numbers = (*focal, *centre, *distortion)
    if not all(map(math.isfinite, numbers)) or min(focal) <= 0.0:
        raise UnusableMessage(
            f"a camera's focal lengths are {focal[0]:.3g} and {focal[1]:.3g}, its centre "
            f"{centre[0]:.3g}, {centre[1]:.3g}; accepted: finite, lengths above 0"
        )
    if not all(0 < side <= _MOST_PIXELS_A_SIDE for side in size):
        raise UnusableMessage(f"a camera has {size[0]} x {size[1]} pixels")
    return CameraInfoMessage(frame, *size, *focal, *centre, distorted=any(distortion))


def joints(positions: Iterable[tuple[str, float]]) -> JointsMessage:
    """Positions by name; UnusableMessage if one is not finite."""
    found = {one_line(name): float(position) for name, position in positions}
    for name, position in found.items():
        if not math.isfinite(position):
            raise UnusableMessage(f"joint {name} is at {position}")
    return JointsMessage(found)


def marker(text: str) -> MarkerMessage:
    """A text on one line, of bounded length."""
    return MarkerMessage(one_line(text))


def require_length(what: str, have: int, others: str, want: int) -> None:
    """Raise UnusableMessage unless two lists are as long as one another."""
    if have != want:
        raise UnusableMessage(f"it has {have} {what} for {want} {others}")


def positions(frame: str, points: Iterable[Any]) -> CloudMessage:
    """Points that have x, y and z, in a frame."""
    values = np.array([(p.x, p.y, p.z) for p in points]).reshape(-1, 3)
    return CloudMessage(frame_name(frame), values)
