"""A raw log as a robot's recorder writes it: ROS 2 messages in the order of their arrival."""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.writer import CompressionType, Writer

from runners.simulated_robot.schemas import encode, schema_name, schema_text

_CHUNK = 2**20  # bytes


class LogWriter:
    """Writes an MCAP file. Times are nanoseconds; log times must be after the latest `flush`."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._writer = Writer(
            self._file, _CHUNK, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self._writer.start(profile="ros2", library="chsel-replay")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._waiting: list[tuple[int, int, str, int, bytes]] = []
        self.messages = 0

    def add(
        self, topic: str, kind: str, message: Mapping[str, Any], stamp: int, log_time: int
    ) -> None:
        """A message of a type of schemas.TYPES, sent at `stamp` and received at `log_time`."""
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schema(kind))
        self.messages += 1
        entry = (log_time, self.messages, topic, stamp, encode(kind, message))
        heapq.heappush(self._waiting, entry)

    def flush(self, now: int) -> None:
        """Write what was received until now."""
        while self._waiting and self._waiting[0][0] <= now:
            log_time, _, topic, stamp, data = heapq.heappop(self._waiting)
            self._counts[topic] = self._counts.get(topic, 0) + 1
            self._writer.add_message(
                self._channels[topic], log_time, data, stamp, self._counts[topic]
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with self._file:
            if kind is None:
                self.flush(2**63)
                self._writer.finish()

    def _schema(self, kind: str) -> int:
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(
                schema_name(kind), "ros2msg", schema_text(kind).encode()
            )
        return self._schemas[kind]
