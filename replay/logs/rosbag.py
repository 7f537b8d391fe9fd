"""Bags of ROS 1, and of rosbag2 in sqlite3: their messages in order of time, as of MCAP files.

The package `rosbags`, of the extra "sensors", reads them. Messages of ROS 1 become those of ROS 2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chsel.errors import SessionError
from chsel.numerics.arrays import refuse_special_file
from replay.logs.mcap_log import Channel, Fault, RawFile, RawMessage
from replay.mcap.texts import one_line

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

ROS1 = b"#ROSBAG "
SQLITE = b"SQLite f"
_HEADER = "std_msgs/msg/Header"
_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}  # messages of ROS 1, as ROS 2 has them
_PER_REPORT = 1000  # messages between two reports of progress


def open_log_file(path: Path) -> RawFile | RosbagFile:
    """Return a file of a log, of whichever kind. Raise SessionError if it is of none."""
    refuse_special_file(f"log {path}", path, error=SessionError)
    try:
        with path.open("rb") as file:
            begin = file.read(len(ROS1))
    except OSError as error:
        raise SessionError(f"log {path} cannot be read: {error.strerror or error}") from None
    if begin in (ROS1, SQLITE):
        return RosbagFile(path, is_ros1=begin == ROS1)
    return RawFile(path)


class RosbagFile:
    """One file, which can be read several times, as a RawFile is.

    Raises SessionError if it cannot be read, or was not finished.
    """

    is_indexed = True

    def __init__(self, path: Path, *, is_ros1: bool) -> None:
        """is_ros1: else it is a file in sqlite3."""
        self.path = path
        self.remarks: list[str] = []  # how it is read: there is nothing to say
        self.channels: dict[int, Channel] = {}  # by id
        self.counts: dict[int, int] = {}  # messages by channel
        self.times: tuple[int, int] | None = None  # first and last log time, nanoseconds
        self.size = path.stat().st_size
        self._is_ros1 = is_ros1
        self._refuse_unfinished()
        with _opened(path, is_ros1=is_ros1) as bag:
            for connection in bag.connections:
                self.channels[connection.id] = self._described(connection)[0]
                self.counts[connection.id] = connection.msgcount
            if bag.message_count:
                self.times = bag.start_time, bag.end_time - 1

    def messages(
        self,
        topics: frozenset[str] | None,
        fault: Fault,
        *,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Iterator[RawMessage]:
        """Yield the messages on topics (None: all). fault and progress: called with damage, bytes.

        Nothing is read behind the first damage of the file.
        """
        with _opened(self.path, is_ros1=self._is_ros1) as bag:
            described = {one.id: self._described(one) for one in bag.connections}
            wanted = [
                one
                for one in bag.connections
                if topics is None or described[one.id][0].topic in topics
            ]
            share = self.size / max(sum(one.msgcount for one in wanted), 1)
            read = iter(bag.messages(wanted) if wanted else ())
            for count in range(sum(one.msgcount for one in wanted)):
                if count % _PER_REPORT == 0:
                    progress(int(count * share))
                try:
                    found = next(read, None)
                except Exception as error:  # whatever the package stumbles over
                    fault(f"{self.path.name}: {_reason(error)}")
                    return
                if found is None:
                    fault(f"{self.path.name}: messages are missing")
                    return
                connection, time, data = found
                channel, to_cdr = described[connection.id]
                try:
                    message = RawMessage(channel, time, data=bytes(to_cdr(data)))
                except Exception as error:
                    what = f"a message is not a valid {channel.schema}"
                    fault(f"{channel.topic}: {what} ({_reason(error)})")
                    continue
                yield message

    def _described(self, connection: Connection) -> tuple[Channel, Callable[[bytes], Any]]:
        """Return the channel of a connection, and what makes its messages those of ROS 2."""
        from rosbags.interfaces import MessageDefinitionFormat

        topic = one_line(connection.topic)
        name = _RENAMED.get(connection.msgtype, one_line(connection.msgtype))
        text = connection.msgdef.data
        if not self._is_ros1:
            encoding = one_line(getattr(connection.ext, "serialization_format", ""))
            # Definitions in IDL are left out: of the messages that are read, ROS 2's are known.
            is_text = connection.msgdef.format is MessageDefinitionFormat.MSG
            definition = text if is_text else None
            return Channel(topic, encoding, schema=name, definition=definition), bytes
        try:
            definition, to_cdr = _as_ros2(name, text)
        except Exception:  # whatever the parser stumbles over
            return Channel(topic, "ros1, whose definition is not read", schema=name), bytes
        return Channel(topic, "cdr", schema=name, definition=definition), to_cdr

    def _refuse_unfinished(self) -> None:
        """Raise SessionError if messages are in the file that sqlite3 keeps beside an open one."""
        for end in ("wal", "journal"):
            beside = self.path.with_name(f"{self.path.name}-{end}")
            if not self._is_ros1 and beside.exists() and beside.stat().st_size:
                raise SessionError(
                    f"log {self.path} is not finished: {beside.name} holds a part of it; accepted: "
                    f"what `sqlite3 {self.path.name} vacuum` makes of both"
                )


@contextmanager
def _opened(path: Path, *, is_ros1: bool) -> Iterator[Any]:
    """Open a bag for reading."""
    from rosbags import rosbag1, rosbag2  # of the extra "sensors"

    try:
        bag = rosbag1.Reader(path) if is_ros1 else rosbag2.Reader(path)
        bag.open()
    except Exception as error:  # whatever the package stumbles over
        kind = "ROS 1 bag" if is_ros1 else "rosbag2 file in sqlite3"
        advice = "one with its index, which `rosbag reindex` makes" if is_ros1 else "a whole one"
        raise SessionError(
            f"log {path} cannot be read as a {kind}: {_reason(error)}; accepted: {advice}"
        ) from None
    try:
        yield bag
    finally:
        bag.close()


def _as_ros2(name: str, definition: str) -> tuple[str, Callable[[bytes], Any]]:
    """Return a ROS 1 message's definition by ROS 2, and what converts its messages to CDR.

    Fields have the names of ROS 2, in small letters, and headers no number.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_types_from_msg(definition, name)
    for kind, (constants, fields) in types.items():
        kept = [(field, of) for field, of in fields if (kind, field) != (_HEADER, "seq")]
        types[kind] = (constants, [(field.lower(), of) for field, of in kept])
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    text, _ = store.generate_msgdef(name, ros_version=2)
    return text, lambda data: store.ros1_to_cdr(data, name)


def _reason(error: Exception) -> str:
    return one_line(str(error) or type(error).__name__).rstrip(".")[:200]
