"""Raw logs of robots: MCAP files and rosbag2 folders, as messages that are decoded."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from chsel.errors import SessionError
from replay.files import file_digest
from replay.mcap.log_file import Channel, Fault, RawFile, RawMessage
from replay.mcap.texts import one_line
from runners.sensors.log.foxglove import foxglove_decoder
from runners.sensors.log.log_files import Span, log_files, merged
from runners.sensors.log.messages import (
    Decode,
    Received,
    TransformMessage,
    UnusableMessage,
)
from runners.sensors.log.ros2 import ros2_decoder

Progress = Callable[[int, int], None]  # bytes so far, and of all

_PROGRESS_STEP = 2**22  # bytes
_DIGEST_SIZE = 16  # bytes
_MOST_LISTED = 60
_STATIC = "tf_static"  # what a topic of transforms that hold for all times ends with


@dataclass(frozen=True)
class Topic:
    """Its messages' schema and encoding as in the file, and how many there are."""

    schema: str
    encoding: str
    count: int


class RawLog:
    """Reads one log, as often as wanted, in memory that does not grow with the log.

    files: in their order. size: of all, bytes. topics: by name. begin, end: first and last log
    time, nanoseconds, 0 without messages. faults: "topic: reason" of what had to be passed
    by, with how often, as met so far; reading again does not count it again. Raises SessionError
    for what is no log.
    """

    def __init__(self, path: str | Path, *, progress: Progress | None = None) -> None:
        self.path = Path(path).expanduser()
        self._warnings: list[str] = []
        self.faults: Counter[str] = Counter()
        self.topics: dict[str, Topic] = {}
        self.begin = self.end = 0
        try:
            self.files = tuple(log_files(self.path, self._warnings))
        except OSError as error:
            reason = error.strerror or error
            raise SessionError(f"log {self.path} cannot be read: {reason}") from None
        self._parts = [RawFile(file) for file in self.files]
        self.size = sum(part.size for part in self._parts)
        self._spans: list[Span] = []
        self._find_topics(progress)

    @property
    def warnings(self) -> list[str]:
        """What a user should know of how the log is read; all of it once it has been."""
        return self._warnings + [
            f"{part.path.name}: {remark}" for part in self._parts for remark in part.remarks
        ]

    def messages(
        self, topics: Collection[str], *, progress: Progress | None = None
    ) -> Iterator[Received]:
        """The messages on topics, in order of log time where the files have an index.

        What cannot be read is skipped, and counted in `faults`. Raises SessionError if the log has
        none of the topics.
        """
        known = frozenset(topics) & self.topics.keys()
        if not known:
            named = ", ".join(sorted(topics)) or "none"
            raise SessionError(f"log {self.path} has no topic {named}; it has {self.listing()}")
        return self._received(known, progress)

    def listing(self) -> str:
        """All topics with their schemas, for messages to the user."""
        shown = sorted(f"{name} ({topic.schema})" for name, topic in self.topics.items())
        more = [f"{len(shown) - _MOST_LISTED} more"] if len(shown) > _MOST_LISTED else []
        damage = "".join(f" ({fault})" for fault, _ in self.faults.most_common(1))
        return ", ".join(shown[:_MOST_LISTED] + more) or f"no topics{damage}"

    def digest(self) -> str:
        """BLAKE2b (128 bit, hexadecimal) of the file, or of the digests of a folder's files."""
        digests = [file_digest(path) for path in self.files]
        if self.path.is_file():
            return digests[0]
        whole = "".join(f"{digest}\n" for digest in digests).encode()
        return hashlib.blake2b(whole, digest_size=_DIGEST_SIZE).hexdigest()

    def _received(self, topics: frozenset[str], progress: Progress | None) -> Iterator[Received]:
        fault, report = self._new_faults(), _seldom(progress, self.size)
        decoders: dict[Channel, Decode | UnusableMessage] = {}
        for message in self._raw_messages(topics, fault, report):
            channel = message.channel
            if channel not in decoders:
                decoders[channel] = _decoder(channel)
            decode = decoders[channel]
            try:
                if isinstance(decode, UnusableMessage):
                    raise decode
                for stamp, content in decode(message.data):
                    if isinstance(content, UnusableMessage):
                        fault(f"{channel.topic}: {content}")
                        continue
                    if isinstance(content, TransformMessage) and channel.topic.endswith(_STATIC):
                        content = replace(content, static=True)
                    yield Received(channel.topic, message.log_time, stamp, content)
            except UnusableMessage as error:
                fault(f"{channel.topic}: {error}")

    def _raw_messages(
        self, topics: frozenset[str], fault: Fault, report: Callable[[int], None]
    ) -> Iterator[RawMessage]:
        done = [0] * len(self._parts)

        def read(number: int) -> Iterator[RawMessage]:
            def report_file(of_file: int) -> None:
                done[number] = of_file
                report(sum(done))

            return self._parts[number].messages(topics, fault, report_file)

        yield from merged(self._spans, read)
        report(self.size)

    def _find_topics(self, progress: Progress | None) -> None:
        """From the indices of files; files without one are read through."""
        all_times: list[int] = []
        report, done, fault = _seldom(progress, self.size), 0, self._new_faults()
        for part in self._parts:
            counts: dict[Channel, int] = {}
            times = list(part.times or ())
            if not part.is_indexed:
                for message in part.messages(None, fault, _after(done, report)):
                    counts[message.channel] = counts.get(message.channel, 0) + 1
                    times = [min([message.log_time, *times]), max([message.log_time, *times])]
            for number, channel in part.channels.items():
                counts[channel] = counts.get(channel, 0) + part.counts.get(number, 0)
            for channel, count in counts.items():
                self._add_topic(channel, count)
            done += part.size
            self._spans.append((min(times, default=0), max(times, default=0)))
            all_times += times
        if all_times:
            self.begin, self.end = min(all_times), max(all_times)

    def _add_topic(self, channel: Channel, count: int) -> None:
        known = self.topics.get(channel.topic)
        if known is None:
            self.topics[channel.topic] = Topic(channel.schema, channel.encoding, count)
            return
        if (known.schema, known.encoding) != (channel.schema, channel.encoding):
            self._warnings.append(
                f"topic {channel.topic} carries {known.schema} and {channel.schema}"
            )
        total = known.count + count
        self.topics[channel.topic] = Topic(known.schema, known.encoding, total)

    def _new_faults(self) -> Fault:
        """Counts the faults of one reading; those of an earlier one are not counted again."""
        found: Counter[str] = Counter()

        def fault(text: str) -> None:
            text = one_line(text)
            found[text] += 1
            self.faults[text] = max(self.faults[text], found[text])

        return fault


def _decoder(channel: Channel) -> Decode | UnusableMessage:
    """Decodes the messages of a channel; or why they are not read."""
    try:
        decode = {
            "cdr": lambda: ros2_decoder(channel.schema, channel.definition),
            "protobuf": lambda: foxglove_decoder(channel.schema),
        }.get(channel.encoding, lambda: None)()
    except UnusableMessage as error:
        return error
    if decode is None:
        encoding = channel.encoding or "unknown bytes"
        return UnusableMessage(f"messages {channel.schema} as {encoding} are not read")
    return decode


def _after(before: int, report: Callable[[int], None]) -> Callable[[int], None]:
    """Reports the bytes of one file as those of all."""
    return lambda done: report(before + done)


def _seldom(progress: Progress | None, total: int) -> Callable[[int], None]:
    """Calls progress once in some megabytes, and at the end."""
    reported = 0

    def report(done: int) -> None:
        nonlocal reported
        if progress is not None and (done >= reported + _PROGRESS_STEP or done == total):
            reported = done
            progress(done, total)

    return report
