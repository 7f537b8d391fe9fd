"""Draws: sessions registered again with other random numbers, each under a label of its own."""

from __future__ import annotations

import re
from collections.abc import Collection

from chsel.errors import require_at_most, require_positive
from chsel.problem.streams import StreamKey

MOST_REPEATS = 1000
_APART = 2**32  # between the seeds of two draws, so that these are no seeds of other sessions
_LABEL = re.compile(r"(?P<label>.+)\+(?P<draw>[1-9]\d{0,2})")


def require_repeats(draws: int) -> None:
    """Raise SettingError for a number of draws that there cannot be."""
    require_positive("draws", draws)
    require_at_most("draws", draws, MOST_REPEATS)


def repeat_label(label: str, draw: int) -> str:
    """What tables call a draw: the first one as if there were no others, then LABEL+1, LABEL+2."""
    return f"{label}+{draw}" if draw else label


def repeat_of(label: str, labels: Collection[str]) -> tuple[str, int]:
    """The label without its draw, and the draw. labels: all that there are."""
    match = _LABEL.fullmatch(label)
    if match is None or match["label"] not in labels:
        return label, 0
    return match["label"], int(match["draw"])


def repeat_seed(seed: int, draw: int) -> int:
    """The seed of all random streams of a draw, of a session with this seed."""
    return StreamKey(seed + _APART * draw, 0).seed
