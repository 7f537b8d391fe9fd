"""Raw logs of robots: MCAP files and bags of ROS, as messages that are decoded."""

from __future__ import annotations

import hashlib
import heapq
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import yaml

from chsel.errors import SessionError
from replay.files import file_digest
from replay.logs.mcap_log import ACCEPTED, Channel, RawFile, RawMessage
from replay.logs.rosbag import RosbagFile, open_log_file
from replay.mcap.texts import one_line
from runners.sensors.log.decoding import decoder
from runners.sensors.log.messages import Decode, Received, TransformMessage, UnusableMessage

Progress = Callable[[int, int], None]  # bytes so far, and of all

_DIGEST_SIZE = 16  # bytes
_MOST_LISTED = 60
_SUFFIXES = (".mcap", ".db3", ".bag")
_STATIC = "tf_static"  # what a topic of transforms that hold for all times ends with


class RawLog:
    """A log that is read as often as wanted, in memory that does not grow with the log."""

    files: list[Path]
    """Files in their order."""

    size: int
    """Size of all files, bytes."""

    topics: dict[str, str]
    """Schemas by the names of topics."""

    begin: int
    """First log time, nanoseconds, 0 without messages."""

    end: int
    """Last log time, nanoseconds, 0 without messages."""

    faults: Counter[str]
    """How often messages were skipped so far, by "topic: reason"; a second reading adds none."""

    def __init__(self, path: str | Path, *, progress: Progress = lambda done, size: None) -> None:
        """Open a log. Raise SessionError for a path that is none."""
        self.path = Path(path).expanduser()
        self.faults = Counter()
        self.topics = {}
        self.files = log_files(self.path)
        self._parts = [open_log_file(file) for file in self.files]
        self.size = sum(part.size for part in self._parts)
        spans = [self._span(part, progress) for part in self._parts]
        times = [time for span in spans for time in span]
        self.begin, self.end = min(times, default=0), max(times, default=0)
        self._series = _series(spans)

    @property
    def warnings(self) -> list[str]:
        """Lines for the user on how the log is read; all of them once it has been."""
        of_files = [(part.path.name, remark) for part in self._parts for remark in part.remarks]
        return [f"{name}: {remark}" for name, remark in [*_missing(self.path), *of_files]]

    def messages(
        self, topics: Collection[str], *, progress: Progress = lambda done, size: None
    ) -> Iterator[Received]:
        """Yield the messages on topics, in order of log time where the files have an index.

        What cannot be read is skipped, and counted in `faults`. Raise SessionError if the log has
        none of the topics.
        """
        known = frozenset(topics) & self.topics.keys()
        if not known:
            named = ", ".join(sorted(topics)) or "none"
            raise SessionError(f"log {self.path} has no topic {named}; it has {self.listing()}")
        return self._received(known, progress)

    def listing(self) -> str:
        """Return all topics with their schemas, for messages to the user."""
        shown = sorted(f"{name} ({schema})" for name, schema in self.topics.items())
        more = [f"{len(shown) - _MOST_LISTED} more"] if len(shown) > _MOST_LISTED else []
        damage = "".join(f" ({fault})" for fault, _ in self.faults.most_common(1))
        return ", ".join(shown[:_MOST_LISTED] + more) or f"no topics{damage}"

    def digest(self) -> str:
        """Return BLAKE2b (128 bit, hexadecimal) of the file, or of the digests of a folder."""
        digests = [file_digest(path) for path in self.files]
        if self.path.is_file():
            return digests[0]
        whole = "".join(f"{digest}\n" for digest in digests).encode()
        return hashlib.blake2b(whole, digest_size=_DIGEST_SIZE).hexdigest()

    def _received(self, topics: frozenset[str], progress: Progress) -> Iterator[Received]:
        faults: Counter[str] = Counter()
        done = [0] * len(self._parts)
        decoders: dict[Channel, Decode] = {}

        def fault(text: str) -> None:
            faults[one_line(text)] += 1

        def report(number: int, of_file: int) -> None:
            done[number] = of_file
            progress(sum(done), self.size)

        def read(number: int) -> Iterator[RawMessage]:
            return self._parts[number].messages(topics, fault, progress=partial(report, number))

        readings = [chain.from_iterable(map(read, numbers)) for numbers in self._series]
        for message in heapq.merge(*readings, key=lambda message: message.log_time):
            channel = message.channel
            if channel not in decoders:
                decoders[channel] = decoder(
                    channel.schema, channel.encoding, definition=channel.definition
                )
            for stamp, content in decoders[channel](message.data):
                if isinstance(content, UnusableMessage):
                    fault(f"{channel.topic}: {content}")
                    continue
                if isinstance(content, TransformMessage) and channel.topic.endswith(_STATIC):
                    content = replace(content, static=True)
                yield Received(channel.topic, message.log_time, stamp=stamp, content=content)
        self.faults |= faults
        progress(self.size, self.size)

    def _span(self, part: RawFile | RosbagFile, progress: Progress) -> tuple[int, ...]:
        """Return first and last log time of a file, which is read through if it has no index."""
        span = part.times or ()
        if not part.is_indexed:
            faults: Counter[str] = Counter()
            read = part.messages(
                None,
                lambda text: faults.update([one_line(text)]),
                progress=lambda done: progress(done, self.size),
            )
            for message in read:
                times = message.log_time, *span
                span = min(times), max(times)
            self.faults |= faults
        for channel in part.channels.values():
            self.topics.setdefault(channel.topic, channel.schema)
        return span


def _series(spans: list[tuple[int, ...]]) -> list[list[int]]:
    """Return numbers of files by series in which each begins when the one before has ended.

    So of the successive splits of a recording one is open at a time.
    """
    series: list[list[int]] = []
    for number in sorted(range(len(spans)), key=lambda number: (spans[number][:1], number)):
        ended = [one for one in series if spans[one[-1]][1:] <= spans[number][:1]]
        if ended:
            ended[0].append(number)
        else:
            series.append([number])
    return series


def log_files(path: Path) -> list[Path]:
    """Return the files of a log, bag_2 before bag_10. Raise SessionError unless of one kind."""
    if not path.exists():
        raise SessionError(f"log {path} does not exist; {ACCEPTED}")
    if not path.is_dir():
        return [path]
    kinds = [suffix for suffix in _SUFFIXES if any(path.glob(f"*{suffix}"))]
    found = sorted(path.glob(f"*{kinds[0]}"), key=_natural) if kinds else []
    names = {file.name for file in found}
    packed = [
        file
        for suffix in _SUFFIXES
        for file in path.glob(f"*{suffix}.zst*")
        if file.stem not in names
    ]
    if packed:
        raise SessionError(
            f"log {path} has {len(packed)} files that are compressed, such as {packed[0].name}; "
            f"{ACCEPTED}: unpack them with `zstd -d FILE`, or convert it with `ros2 bag convert`"
        )
    active = [file.name for file in path.glob("*.bag.active")]
    if active:
        raise SessionError(
            f"log {path} has {active[0]}, which was not finished; {ACCEPTED}: `rosbag reindex` "
            "makes of it one that is"
        )
    if len(kinds) != 1:
        what = f"{' and '.join(kinds)} files" if kinds else "none of these files"
        raise SessionError(f"log {path} is a folder with {what}; {ACCEPTED}")
    return found


def _missing(folder: Path) -> list[tuple[str, str]]:
    """Return names of files that a rosbag2 folder's metadata lists and it lacks, with a remark."""
    try:
        metadata = yaml.safe_load((folder / "metadata.yaml").read_text())
        names = metadata["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [folder / Path(name).name.removesuffix(".zstd") for name in names]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, AttributeError):
        return []  # there need not be any
    return [
        (file.name, "it is not there, though metadata.yaml lists it")
        for file in files
        if not file.exists()
    ]


def _natural(path: Path) -> list[Any]:
    """Return a key by which bag_2 comes before bag_10."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
