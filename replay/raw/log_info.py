"""What is in an MCAP file of another program: topics, types, rates and frames."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from chsel.errors import SessionError
from replay.mcap.schemas import PROFILE
from replay.raw.channels import Channel
from replay.raw.frames import frames
from replay.raw.raw_file import ROS1_BAG, RawFile
from replay.raw.raw_reading import RawMessage

_HEADER = struct.Struct("<BQI")  # opcode, length, length of the profile's name
_LONGEST_PROFILE = 1000
_MOST_CHUNKS = 32  # that are read for the names of frames
_MOST_FRAMES = 20  # of a topic
_MOST_FAULTS = 100  # different ones
_LOOKED_AT, _EVERY = 1000, 100  # messages of a topic for its frames, and every so many of the rest
_SECOND = 10**9


@dataclass(frozen=True)
class TopicInfo:
    """The messages of one topic and type."""

    topic: str
    type: str  # the schema's name
    encoding: str
    count: int
    rate: float | None  # messages a second from its first to its last; None: not known
    frames: tuple[str, ...]  # names in its messages; of transforms "PARENT > CHILD"
    more_frames: bool = False  # whether it has more than are listed


@dataclass(frozen=True)
class LogInfo:
    """What `info` shows of a log."""

    path: Path
    size: int  # of the file, bytes
    topics: tuple[TopicInfo, ...]  # by name
    begin: int  # first and last log time, nanoseconds; 0 without messages
    end: int
    remarks: tuple[str, ...]  # how it was read
    faults: Mapping[str, int]  # what is wrong, with how often
    checked: bool  # whether all messages were read

    @property
    def damage(self) -> str | None:
        """What is wrong, in a line; None if nothing is."""
        shown = [text if count == 1 else f"{text} ({count} times)" for text, count in self._worst()]
        more = len(self.faults) - len(shown)
        return "; ".join(shown + [f"{more} other faults"] * (more > 0)) or None

    @property
    def count(self) -> int:
        """Of all messages."""
        return sum(topic.count for topic in self.topics)

    @property
    def integrity(self) -> str:
        """A line about what holds of the file."""
        if self.damage is not None:
            return f"damaged or unfinished: {self.damage}; what is whole was counted"
        if self.checked:
            return "all messages were read, the checksums of their chunks are right"
        return (
            "counts are those of its index, frames those of some chunks (--check reads everything)"
        )

    def plain(self) -> dict[str, Any]:
        """All of it as JSON has it."""
        integrity = {"whole": self.damage is None, "checked": self.checked, "damage": self.damage}
        return {
            "path": str(self.path),
            "bytes": self.size,
            "log": True,
            "begin": self.begin,
            "end": self.end,
            "integrity": integrity,
            "remarks": [*self.remarks],
            "topics": [{**vars(topic), "frames": [*topic.frames]} for topic in self.topics],
        }

    def _worst(self) -> list[tuple[str, int]]:
        return sorted(self.faults.items(), key=lambda item: -item[1])[:3]


def is_other_programs(path: str | Path) -> bool:
    """Whether a file is a robot's: a ROS 1 bag, or MCAP, by its header not a recording of ours."""
    path = Path(path).expanduser()
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            start = file.read(len(MCAP0_MAGIC) + _HEADER.size + _LONGEST_PROFILE)
    except OSError:
        return False
    if start.startswith(ROS1_BAG):
        return True
    if len(start) < len(MCAP0_MAGIC) + _HEADER.size or not start.startswith(MCAP0_MAGIC):
        return False
    opcode, _, length = _HEADER.unpack_from(start, len(MCAP0_MAGIC))
    profile = start[len(MCAP0_MAGIC) + _HEADER.size :][:length]
    return opcode == Opcode.HEADER and profile != PROFILE.encode()


def log_info(path: str | Path, *, check: bool = False) -> LogInfo:
    """What is in an MCAP file of any program, in memory that does not grow with the file.

    Of a file with an index, that and some chunks are read. With `check`, and without an index, all
    is. Raises SessionError for a file that cannot be read, or is no MCAP file.
    """
    file = RawFile(Path(path).expanduser())
    found = _Gathered()
    everything = check or not file.is_indexed
    try:
        messages = (
            file.written(found.fault) if everything else file.samples(found.fault, _MOST_CHUNKS)
        )
        for message in messages:
            found.take(message)
    except OSError as error:
        raise SessionError(f"log {file.path} cannot be read: {error.strerror or error}") from None
    if file.index_fault:
        found.fault(f"its index cannot be used: {file.index_fault}")
    if file.is_indexed and everything:
        found.compare(file)
    times = found.times() if everything else file.times
    begin, end = times or (0, 0)
    topics = found.topics(file, counted=everything)
    return LogInfo(
        path=file.path,
        size=file.size,
        topics=tuple(sorted(topics, key=lambda topic: (topic.topic, topic.type))),
        begin=begin,
        end=end,
        remarks=tuple(file.remarks),
        faults=dict(found.faults),
        checked=everything,
    )


def moment(nanoseconds: int) -> str:
    """A time in words, UTC; seconds where it is none of a calendar."""
    seconds = nanoseconds / _SECOND
    try:
        return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3] + " UTC"
    except (OverflowError, ValueError, OSError):
        return f"{seconds:.3f} s"


@dataclass
class _Seen:
    """Of the messages of one channel that were read."""

    count: int = 0
    first: int = 0
    last: int = 0
    frames: set[str] = field(default_factory=set)


class _Gathered:
    """Counts of messages, times and frames by channel, and what is wrong with the file."""

    def __init__(self) -> None:
        self.faults: Counter[str] = Counter()
        self._seen: dict[Channel, _Seen] = {}

    def fault(self, text: str) -> None:
        """Take note of damage."""
        known = text in self.faults or len(self.faults) < _MOST_FAULTS
        self.faults[text if known else "further faults"] += 1

    def take(self, message: RawMessage) -> None:
        """Take note of a message."""
        seen, time = self._seen.get(message.channel), message.log_time
        if seen is None:
            seen = self._seen[message.channel] = _Seen(0, time, time)
        if len(seen.frames) <= _MOST_FRAMES and (
            seen.count < _LOOKED_AT or seen.count % _EVERY == 0
        ):
            seen.frames.update(frames(message.channel, message.data))
        seen.count += 1
        seen.first, seen.last = min(seen.first, time), max(seen.last, time)

    def times(self) -> tuple[int, int] | None:
        """First and last log time of all."""
        if not self._seen:
            return None
        all_seen = self._seen.values()
        return min(seen.first for seen in all_seen), max(seen.last for seen in all_seen)

    def compare(self, file: RawFile) -> None:
        """A fault for every topic of which the index has another number of messages."""
        for channel, (indexed, _) in _indexed(file).items():
            count = self._seen[channel].count if channel in self._seen else 0
            if indexed != count:
                self.fault(
                    f"its index has {indexed} messages on {channel.topic}, there are {count}"
                )

    def topics(self, file: RawFile, *, counted: bool) -> Iterator[TopicInfo]:
        """What is known of each topic. counted: by the messages read, not by the index."""
        indexed = _indexed(file)
        for channel in dict.fromkeys([*file.channels.by_id.values(), *self._seen]):
            seen = self._seen.get(channel, _Seen())
            count, span = seen.count, (seen.first, seen.last)
            if not counted:
                count, span = indexed.get(channel, (0, (0, 0)))
            seconds = (span[1] - span[0]) / _SECOND
            names = sorted(seen.frames)
            yield TopicInfo(
                topic=channel.topic,
                type=channel.schema,
                encoding=channel.encoding,
                count=count,
                rate=(count - 1) / seconds if count > 1 and seconds > 0.0 else None,
                frames=tuple(names[:_MOST_FRAMES]),
                more_frames=len(names) > _MOST_FRAMES,
            )


def _indexed(file: RawFile) -> dict[Channel, tuple[int, tuple[int, int]]]:
    """Counts, first and last time of each channel, from an index."""
    found: dict[Channel, tuple[int, tuple[int, int]]] = {}
    spans = file.spans()
    for number, channel in file.channels.by_id.items():
        count = (file.counts or {}).get(number, 0)
        span = spans.get(number) or file.times or (0, 0)
        before, (first, last) = found.get(channel, (0, span))
        found[channel] = before + count, (min(first, span[0]), max(last, span[1]))
    return found
