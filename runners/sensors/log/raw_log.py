"""Raw logs of robots: MCAP files and rosbag2 folders, as messages that are decoded."""

from __future__ import annotations

import hashlib
import heapq
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from chsel.errors import SessionError
from replay.files import file_digest
from replay.mcap.log_file import ACCEPTED, Channel, Fault, RawFile, RawMessage
from replay.mcap.texts import one_line
from runners.sensors.log.decoding import decoder
from runners.sensors.log.messages import Decode, Received, TransformMessage, UnusableMessage
from runners.sensors.yaml_file import read_yaml

Progress = Callable[[int, int], None]  # bytes so far, and of all
Span = tuple[int, int]  # first and last log time of a file, nanoseconds

_METADATA = "metadata.yaml"
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

    def __init__(self, path: str | Path, *, progress: Progress = lambda done, size: None) -> None:
        self.path = Path(path).expanduser()
        self._warnings: list[str] = []
        self.faults: Counter[str] = Counter()
        self.topics: dict[str, Topic] = {}
        try:
            self.files = tuple(log_files(self.path, self._warnings))
        except OSError as error:
            reason = error.strerror or error
            raise SessionError(f"log {self.path} cannot be read: {reason}") from None
        self._parts = [RawFile(file) for file in self.files]
        self.size = sum(part.size for part in self._parts)
        self._spans = self._find_topics(progress)
        spans = [span for span in self._spans if span != (0, 0)]
        self.begin = min((begin for begin, _ in spans), default=0)
        self.end = max((end for _, end in spans), default=0)

    @property
    def warnings(self) -> list[str]:
        """What a user should know of how the log is read; all of it once it has been."""
        return self._warnings + [
            f"{part.path.name}: {remark}" for part in self._parts for remark in part.remarks
        ]

    def messages(
        self, topics: Collection[str], *, progress: Progress = lambda done, size: None
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

    def _received(self, topics: frozenset[str], progress: Progress) -> Iterator[Received]:
        fault, done = self._new_faults(), [0] * len(self._parts)
        decoders: dict[Channel, Decode] = {}

        def read(number: int) -> Iterator[RawMessage]:
            return self._read(number, topics, fault, done, progress)

        for message in merged(self._spans, read):
            channel = message.channel
            if channel not in decoders:
                decoders[channel] = decoder(channel.schema, channel.encoding, channel.definition)
            for stamp, content in decoders[channel](message.data):
                if isinstance(content, UnusableMessage):
                    fault(f"{channel.topic}: {content}")
                    continue
                if isinstance(content, TransformMessage) and channel.topic.endswith(_STATIC):
                    content = replace(content, static=True)
                yield Received(channel.topic, message.log_time, stamp, content)
        progress(self.size, self.size)

    def _read(
        self,
        number: int,
        topics: frozenset[str] | None,
        fault: Fault,
        done: list[int],
        progress: Progress,
    ) -> Iterator[RawMessage]:
        """The messages of one file; done: how many bytes of each were read."""

        def report(of_file: int) -> None:
            done[number] = of_file
            progress(sum(done), self.size)

        return self._parts[number].messages(topics, fault, report)

    def _find_topics(self, progress: Progress) -> list[Span]:
        """From the indices of files, also their spans; files without an index are read through."""
        spans, fault, done = [], self._new_faults(), [0] * len(self._parts)
        for number, part in enumerate(self._parts):
            counts: Counter[Channel] = Counter()
            times = list(part.times or ())
            if not part.is_indexed:
                for message in self._read(number, None, fault, done, progress):
                    counts[message.channel] += 1
                    times = [min([message.log_time, *times]), max([message.log_time, *times])]
            for index, channel in part.channels.items():
                counts[channel] += part.counts.get(index, 0)
            for channel, count in counts.items():
                self._add_topic(channel, count)
            done[number] = part.size
            spans.append((min(times, default=0), max(times, default=0)))
        return spans

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


def log_files(path: Path, warnings: list[str]) -> list[Path]:
    """The MCAP files of a log in their order; what a user should know of it goes into warnings.

    Raises SessionError if there are none, or if they are compressed or stored in another way.
    """
    if not path.exists():
        raise SessionError(f"log {path} does not exist; {ACCEPTED}")
    if path.is_file():
        _require_mcap([path])
        return [path]
    if not path.is_dir():
        raise SessionError(f"log {path} is neither a file nor a folder; {ACCEPTED}")
    named = _named_files(path, warnings)
    inside = sorted((file for file in path.iterdir() if file.is_file()), key=_natural)
    _require_mcap([*named, *inside])
    found = [file for file in named if file.is_file()]
    for file in named:
        if not file.is_file():
            warnings.append(f"file {file.name}, which {_METADATA} names, is missing")
    if not found:
        found = [file for file in inside if file.suffix == ".mcap"]
    if not found:
        raise SessionError(f"log {path} is a folder without .mcap files; {ACCEPTED}")
    return found


def _named_files(folder: Path, warnings: list[str]) -> list[Path]:
    """The files that a bag's metadata name, none if they cannot be read."""
    in_order_of_names = "its .mcap files are read in the order of names"
    if not (folder / _METADATA).exists():
        warnings.append(f"{_METADATA} is missing: {in_order_of_names}")
        return []
    try:
        about = read_yaml(folder / _METADATA)["rosbag2_bagfile_information"]
        storage = about.get("storage_identifier", "mcap")
        compression = about.get("compression_mode")
        # Some versions put the folder's name ahead; and no file of another folder is the bag's.
        files = [folder / Path(name).name for name in about["relative_file_paths"]]
    except (SessionError, LookupError, TypeError, AttributeError) as error:
        reason = one_line(str(error) or type(error).__name__)[:200]
        warnings.append(f"{_METADATA} cannot be read ({reason}): {in_order_of_names}")
        return []
    convert = "convert it with `ros2 bag convert`"
    if storage != "mcap":
        raise SessionError(f"log {folder} has storage {storage!r}; {ACCEPTED}: {convert}")
    if compression:
        raise SessionError(
            f"log {folder} is compressed by rosbag2 ({compression}); {ACCEPTED}, not compressed "
            f"but by MCAP itself: {convert}"
        )
    return files


def _require_mcap(files: list[Path]) -> None:
    for file in files:
        if file.name.endswith((".mcap.zstd", ".mcap.lz4", ".mcap.zst")):
            raise SessionError(
                f"log {file} is compressed as a whole; accepted: .mcap: unpack it with `zstd -d`"
            )


def _natural(path: Path) -> list[Any]:
    """A key by which bag_2 comes before bag_10."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


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
