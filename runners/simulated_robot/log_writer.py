"""A log as a robot's recorder writes it: ROS 2 messages in the order of their arrival."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.records import Schema
from mcap_ros2.writer import Writer

from runners.sensors.log.ros2_definitions import full_definition


class LogWriter:
    """Writes an MCAP file. Times are nanoseconds; log times must be after the latest `flush`."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self._schemas: dict[str, Schema] = {}
        self._counts: Counter[str] = Counter()
        self._waiting: list[tuple[int, int, str, str, Mapping[str, Any], int]] = []
        self.messages = 0

    def add(
        self, topic: str, kind: str, message: Mapping[str, Any], stamp: int, log_time: int
    ) -> None:
        """A message of a type of DEFINITIONS, sent at `stamp` and received at `log_time`."""
        self.messages += 1
        heapq.heappush(self._waiting, (log_time, self.messages, topic, kind, message, stamp))

    def flush(self, now: int) -> None:
        """Write what was received until now."""
        while self._waiting and self._waiting[0][0] <= now:
            log_time, _, topic, kind, message, stamp = heapq.heappop(self._waiting)
            if kind not in self._schemas:
                name = kind.replace("/", "/msg/")
                self._schemas[kind] = self._writer.register_msgdef(name, full_definition(kind))
            self._counts[topic] += 1
            self._writer.write_message(
                topic, self._schemas[kind], message, log_time, stamp, self._counts[topic]
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
