"""What is in an MCAP file of another program: topics, types, counts, rates, time span."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mcap.records import Header
from mcap.stream_reader import StreamReader

from replay.mcap.file import MALFORMED
from replay.mcap.log_file import ROS1_BAG, Channel, RawFile
from replay.mcap.schemas import PROFILE

_SECOND = 10**9
_LONGEST_HEADER = 4096  # bytes


@dataclass(frozen=True)
class LogInfo:
    """What `info` shows of a log."""

    path: Path
    size: int  # of the file, bytes
    topics: tuple[tuple[Channel, int], ...]  # with how many messages, by name
    begin: int  # first and last log time, nanoseconds; 0 without messages
    end: int
    damage: str | None  # what is wrong, None if nothing is

    @property
    def count(self) -> int:
        """Of all messages."""
        return sum(count for _, count in self.topics)

    @property
    def seconds(self) -> float:
        """From the first message to the last."""
        return (self.end - self.begin) / _SECOND

    @property
    def span(self) -> str:
        """First and last time in words, UTC."""
        times = [datetime.fromtimestamp(t / _SECOND, UTC) for t in (self.begin, self.end)]
        return f"{times[0]:%Y-%m-%d %H:%M:%S} to {times[1]:%Y-%m-%d %H:%M:%S} UTC"

    def rate(self, count: int) -> float | None:
        """Messages a second, over the time span of the file."""
        return count / self.seconds if self.seconds > 0.0 else None

    def plain(self) -> dict[str, Any]:
        """All of it as JSON has it."""
        return {
            "path": str(self.path),
            "bytes": self.size,
            "log": True,
            "begin": self.begin,
            "end": self.end,
            "integrity": {"whole": self.damage is None, "damage": self.damage},
            "topics": [
                {
                    "topic": channel.topic,
                    "type": channel.schema,
                    "encoding": channel.encoding,
                    "count": count,
                    "rate": self.rate(count),
                }
                for channel, count in self.topics
            ],
        }


def is_other_programs(path: str | Path) -> bool:
    """Whether a file is a robot's: a ROS 1 bag, or MCAP, by its header not a recording of ours."""
    path = Path(path).expanduser()
    if not path.is_file():  # a FIFO would be waited for
        return False
    try:
        with path.open("rb") as file:
            if file.read(len(ROS1_BAG)) == ROS1_BAG:
                return True
            file.seek(0)
            header = next(StreamReader(file, record_size_limit=_LONGEST_HEADER).records, None)
    except (*MALFORMED, OSError):
        return False
    return isinstance(header, Header) and header.profile != PROFILE


def log_info(path: str | Path) -> LogInfo:
    """What is in an MCAP file of any program, by its summary; without one, everything is read.

    Raises SessionError for a file that cannot be read, or is not MCAP.
    """
    file, faults = RawFile(Path(path).expanduser()), list[str]()
    counts: Counter[Channel] = Counter()
    times = file.times
    if not file.is_indexed:
        for message in file.messages(None, faults.append):
            counts[message.channel] += 1
            first, last = times or (message.log_time, message.log_time)
            times = min(first, message.log_time), max(last, message.log_time)
    for number, channel in file.channels.items():
        counts[channel] += file.counts.get(number, 0)
    topics = sorted(counts.items(), key=lambda item: (item[0].topic, item[0].schema))
    damage = f"unfinished or damaged: {faults[0]}; what is whole was counted" if faults else None
    return LogInfo(file.path, file.size, tuple(topics), *(times or (0, 0)), damage)
