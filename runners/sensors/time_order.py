"""Messages in the order of the times that they speak of, in bounded memory."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator

from runners.sensors.messages import CloudMessage, ImageMessage, Received

SLACK = 1_000_000_000  # ns of the log's time that a message waits for those before it
MOST_BYTES = 256 * 2**20  # of waiting messages


def in_time_order(
    messages: Iterable[Received], time_of: Callable[[Received], int]
) -> Iterator[tuple[int, Received]]:
    """Times and messages, by time; what comes too late for its place comes when it comes."""
    waiting: list[tuple[int, int, Received]] = []
    held = 0
    for count, message in enumerate(messages):
        heapq.heappush(waiting, (time_of(message), count, message))
        held += _bytes(message)
        while waiting and (message.log_time - waiting[0][2].log_time > SLACK or held > MOST_BYTES):
            time, _, earliest = heapq.heappop(waiting)
            held -= _bytes(earliest)
            yield time, earliest
    while waiting:
        time, _, earliest = heapq.heappop(waiting)
        yield time, earliest


def _bytes(message: Received) -> int:
    if isinstance(message.content, ImageMessage):
        return message.content.values.nbytes
    return message.content.points.nbytes if isinstance(message.content, CloudMessage) else 1000
