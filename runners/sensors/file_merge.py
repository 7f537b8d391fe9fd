"""The messages of several files of one log as one sequence."""

from __future__ import annotations

import heapq
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence

from replay.raw.raw_reading import RawMessage

Span = tuple[int, int]
"""First and last log time of a file, nanoseconds."""


def merged(
    spans: Sequence[Span], read: Callable[[int], Iterator[RawMessage]]
) -> Iterator[RawMessage]:
    """Messages by log time, of equal ones those of earlier files first. read: by a file's number.

    No file is opened before its time comes: of the successive splits of a recording one is open at
    a time, of files that hold a topic each, all are.
    """
    later = sorted(range(len(spans)), key=lambda n: (spans[n][0], n), reverse=True)
    heads: list[tuple[int, int, RawMessage, Iterator[RawMessage]]] = []
    while later or heads:
        if later and (not heads or spans[later[-1]][0] <= heads[0][0]):
            number = later.pop()
            messages = read(number)
        else:
            _, number, message, messages = heapq.heappop(heads)
            yield message
        following = next(messages, None)
        if following is not None:
            heapq.heappush(heads, (following.log_time, number, following, messages))


def most_at_once(spans: Sequence[Span]) -> int:
    """How many of the files are open at a time, at most."""
    firsts, lasts = (sorted(span[end] for span in spans) for end in (0, 1))
    return max(bisect_right(firsts, first) - bisect_left(lasts, first) for first in firsts)
