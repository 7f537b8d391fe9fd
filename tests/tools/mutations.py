"""Ways to change a recording, from its raw bytes to what its numbers mean."""

from __future__ import annotations

import dataclasses
import json
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import zstandard
from google.protobuf.message import DecodeError
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from chsel.errors import ChselError
from chsel.problem.points import KnownPoints
from replay.events import (
    ActionsOffered,
    Decided,
    Event,
    Probe,
    ProblemPosed,
    SessionStarted,
)
from replay.mcap.encoding import message_class
from replay.mcap.foxglove_messages import FOXGLOVE
from replay.mcap.schemas import RECORDS
from tests.tools.small_recordings import write_recording

Random = np.random.Generator
Record = tuple[int, bytes]  # opcode, content
_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")  # first and last time, size, checksum
_EXTREMES = (0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e300, -1e300, 5e-324, 1e9, 1e-9)
_WHOLE = (-(2**63), -(2**31), -2, -1, 0, 1, 2, 3, 7, 100, 2**31 - 1, 2**32 - 1, 2**63 - 1)
_WRONG = (
    ChselError,
    ValueError,
    OverflowError,
    AttributeError,
    TypeError,
    KeyError,
    struct.error,
)
_TEXTS = ("", "x", "\x1b[2J", "é" * 7, "a\nb", "nan", "/etc/passwd", "builtins.eval", "9" * 400)


def raw(whole: bytes, random: Random) -> bytes:
    """Bytes changed, cut, put in, left out, zeroed, swapped or repeated."""
    data = bytearray(whole)
    for _ in range(int(random.integers(1, 4))):
        if not data:
            break
        first, second = np.sort(random.integers(0, len(data) + 1, 2)).tolist()
        length = min(second - first, int(random.choice([1, 4, 16, 300])))
        part = bytes(data[first : first + length])
        match int(random.integers(8)):
            case 0:
                data[min(first, len(data) - 1)] ^= 1 << int(random.integers(8))
            case 1:
                data[min(first, len(data) - 1)] = int(random.integers(256))
            case 2:
                del data[first:]
            case 3:
                data[first:first] = random.bytes(length + 1)
            case 4:
                del data[first : first + length + 1]
            case 5:
                data[first : first + 4096] = bytes(len(data[first : first + 4096]))
            case 6:
                data[first : first + length], data[second : second + length] = (
                    data[second : second + length],
                    part,
                )
            case 7:
                data[second:second] = part
    return bytes(data)


def records(whole: bytes, random: Random) -> bytes:
    """Records, also those within chunks, swapped, repeated, dropped, moved or of other kinds."""
    everything = split(whole[len(MCAP0_MAGIC) : -len(MCAP0_MAGIC)])
    chunks = [i for i, (opcode, _) in enumerate(everything) if opcode == Opcode.CHUNK]
    if random.random() < 0.5:
        place = int(random.choice(chunks))
        inside = split(unpacked(everything[place][1]))
        content = joined(_rearranged(inside, random))
        everything[place] = (Opcode.CHUNK, packed(content, compressed=random.random() < 0.5))
        return file_of(everything)
    return file_of(_rearranged(everything, random))


def messages(whole: bytes, random: Random) -> bytes:
    """A message or an attachment of other content, all checksums right."""
    everything = split(whole[len(MCAP0_MAGIC) : -len(MCAP0_MAGIC)])
    kind = Opcode.ATTACHMENT if random.random() < 0.1 else Opcode.CHUNK
    places = [i for i, (opcode, _) in enumerate(everything) if opcode == kind]
    place = int(random.choice(places))
    if kind == Opcode.ATTACHMENT:
        everything[place] = (kind, _other_attachment(everything[place][1], random))
        return file_of(everything)
    inside = split(unpacked(everything[place][1]))
    topics = topics_of(everything)
    within = [i for i, (opcode, _) in enumerate(inside) if opcode == Opcode.MESSAGE]
    for _ in range(int(random.integers(1, 3))):
        chosen = int(random.choice(within))
        head, content = inside[chosen][1][:22], inside[chosen][1][22:]
        if random.random() < 0.1:
            head = raw(head, random).ljust(22, b"\0")[:22]
        topic = topics.get(struct.unpack_from("<H", inside[chosen][1])[0], "/log")
        inside[chosen] = (Opcode.MESSAGE, head + _other_content(topic, content, random))
    everything[place] = (Opcode.CHUNK, packed(joined(inside)))
    return file_of(everything)


def tampered(whole: bytes, random: Random) -> bytes | None:
    """One message on any topic changed or left out, all checksums and numbers right, no seal.

    None if the change leaves it as it was.
    """
    everything = split(whole[len(MCAP0_MAGIC) : -len(MCAP0_MAGIC)])
    topics = topics_of(everything)
    count = sum(1 for _ in _messages_in(everything))
    chosen = int(random.integers(count))

    def change(topic: str, number: int, content: bytes) -> bytes | None:
        if number != chosen or topic == "/seal":
            return content
        return None if random.random() < 0.2 else _other_content(topic, content, random)

    made = changed_messages(everything, topics, change)
    return None if made == everything else file_of(made)


def changed_messages(
    everything: Sequence[Record],
    topics: Mapping[int, str],
    change: Callable[[str, int, bytes], bytes | None],
) -> list[Record]:
    """Records with other messages, numbered anew; seals stay as they are.

    change: gets topic, number and bytes of a message, and gives its new bytes, None to drop it.
    """
    made, number, dropped = [], 0, 0
    for opcode, content in everything:
        if opcode == Opcode.CHUNK:
            inside: list[Record] = []
            for kind, data in split(unpacked(content)):
                if kind == Opcode.MESSAGE:
                    channel = struct.unpack_from("<H", data)[0]
                    other = change(topics[channel], number, data[22:])
                    number += 1
                    if other is None:
                        dropped += 1
                        continue
                    sequence = struct.pack("<I", number - 1 - dropped)
                    data = data[:2] + sequence + data[6:22] + other
                inside.append((kind, data))
            if joined(inside) != unpacked(content):
                content = packed(joined(inside))
        made.append((opcode, content))
    return made


def _messages_in(everything: Sequence[Record]) -> Iterator[bytes]:
    for opcode, content in everything:
        if opcode == Opcode.CHUNK:
            for kind, data in split(unpacked(content)):
                if kind == Opcode.MESSAGE:
                    yield data


def meaning(events: Sequence[Event], path: Path, random: Random) -> bytes | None:
    """Other values, with all digests theirs; None if not even the library makes such values.

    Half of them are written with the writer's own checks left out.
    """
    careless = random.random() < 0.5
    try:
        changed = _consistent(_other_events(list(events), random))
        if careless:
            with (
                mock.patch("replay.mcap.writer.check_message"),
                mock.patch("replay.mcap.validation.EventOrder.take"),
                mock.patch("replay.mcap.plain_config._check_plain"),
                mock.patch("replay.mcap.foxglove_messages.check_text"),
            ):
                return write_recording(path, changed)
        return write_recording(path, changed)
    except _WRONG:
        return None


def split(data: bytes) -> list[Record]:
    """The records in bytes."""
    found, place = [], 0
    while place < len(data):
        opcode, length = _HEAD.unpack_from(data, place)
        place += _HEAD.size + length
        found.append((opcode, data[place - length : place]))
    return found


def joined(parts: Sequence[Record]) -> bytes:
    """The bytes of records."""
    return b"".join(_HEAD.pack(opcode, len(content)) + content for opcode, content in parts)


def unpacked(chunk: bytes) -> bytes:
    """What is in the content of a chunk record."""
    _, _, size, _ = _CHUNK.unpack_from(chunk)
    (name,) = struct.unpack_from("<I", chunk, _CHUNK.size)
    data = chunk[_CHUNK.size + 4 + name + 8 :]
    return zstandard.decompress(data, size) if name else data


def packed(data: bytes, *, compressed: bool = True) -> bytes:
    """The content of a chunk record."""
    name = b"zstd" if compressed else b""
    stored = zstandard.compress(data, 1) if compressed else data
    head = _CHUNK.pack(0, 2**62, len(data), zlib.crc32(data))
    return head + struct.pack("<I", len(name)) + name + struct.pack("<Q", len(stored)) + stored


def file_of(everything: Sequence[Record]) -> bytes:
    """A file of records, its checksums right."""
    opcodes = [opcode for opcode, _ in everything]
    if Opcode.DATA_END not in opcodes:
        return MCAP0_MAGIC + joined(everything) + MCAP0_MAGIC
    end = opcodes.index(Opcode.DATA_END)
    data = MCAP0_MAGIC + joined(everything[:end])
    data += joined([(Opcode.DATA_END, struct.pack("<I", zlib.crc32(data)))])
    summary = joined([part for part in everything[end + 1 :] if part[0] != Opcode.FOOTER])
    footer = _HEAD.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", len(data), 0)
    crc = struct.pack("<I", zlib.crc32(summary + footer))
    return data + summary + footer + crc + MCAP0_MAGIC


def _rearranged(parts: Sequence[Record], random: Random) -> list[Record]:
    parts = list(parts)
    i, j = random.integers(0, len(parts), 2).tolist()
    match int(random.integers(6)):
        case 0:
            parts[i], parts[j] = parts[j], parts[i]
        case 1:
            parts.insert(j, parts[i])
        case 2:
            del parts[i]
        case 3:
            parts.insert(j, parts.pop(i))
        case 4:
            opcode = int(random.choice([0, 1, 4, 5, 6, 9, 12, 15, 16, 200, 255]))
            parts[i] = (opcode, parts[i][1])
        case 5:
            content = struct.pack("<I", 4) + b"name" + struct.pack("<I", 0)
            parts.insert(j, (int(random.choice([Opcode.METADATA, 128, 200])), content))
    return parts


def topics_of(everything: Sequence[Record]) -> dict[int, str]:
    """Topics by channel, from the summary."""
    topics = {}
    for opcode, content in everything:
        if opcode == Opcode.CHANNEL:
            number, _, length = struct.unpack_from("<HHI", content)
            topics[number] = content[8 : 8 + length].decode()
    return topics


def _other_attachment(content: bytes, random: Random) -> bytes:
    head = 16
    for _ in range(2):  # name and media type
        head += 4 + struct.unpack_from("<I", content, head)[0]
    data = content[head + 8 : -4]
    if content[20:24] == b"sdf_" and random.random() < 0.7:
        data = _other_message(message_class("SdfGrid"), data, random)
    else:
        data = raw(data, random)
    body = content[:head] + struct.pack("<Q", len(data)) + data
    return body + struct.pack("<I", zlib.crc32(body))


def _other_content(topic: str, content: bytes, random: Random) -> bytes:
    if random.random() < 0.2:
        return raw(content, random)
    kind = message_class(RECORDS[topic]) if topic in RECORDS else FOXGLOVE[topic]
    return _other_message(kind, content, random)


def _other_message(kind: Any, content: bytes, random: Random) -> bytes:
    try:
        message = kind.FromString(content)
    except DecodeError:  # it has been changed before
        return content
    for _ in range(int(random.integers(1, 3))):
        _change_field(message, random)
    return bytes(message.SerializeToString())


def _change_field(message: Any, random: Random) -> None:
    """Another value for a field, at any depth."""
    field = message.DESCRIPTOR.fields[int(random.integers(len(message.DESCRIPTOR.fields)))]
    value = getattr(message, field.name)
    if random.random() < 0.1:
        message.ClearField(field.name)
    elif field.is_repeated:
        _change_list(message, field, value, random)
    elif field.message_type is not None:
        if message.DESCRIPTOR.name == "Array" or value.DESCRIPTOR.name == "Array":
            _change_array(value, random)
        else:
            _change_field(value, random)
    else:
        _set(message, field, _other_scalar(field, value, random))


def _change_list(message: Any, field: Any, value: Any, random: Random) -> None:
    if len(value) and random.random() < 0.4:
        del value[int(random.integers(len(value)))]
    elif field.message_type is not None:
        if len(value) and random.random() < 0.7:
            _change_field(value[int(random.integers(len(value)))], random)
        else:
            value.add()
    else:
        item = _other_scalar(field, value[0] if len(value) else 0, random)
        try:
            value.append(item)
        except (ValueError, TypeError):
            value.append(value[0]) if len(value) else None


def _change_array(array: Any, random: Random) -> None:
    """Another type, shape or content of an Array."""
    match int(random.integers(5)):
        case 0:
            array.dtype = str(random.choice(["<f8", "<f4", ">f8", "|O", "<i8", "|b1", "<U9", ""]))
        case 1 if len(array.shape):
            place = int(random.integers(len(array.shape)))
            lengths = (0, 1, min(array.shape[place] + 1, 9), 2**32, 2**63, 2**64 - 1)
            array.shape[place] = lengths[int(random.integers(len(lengths)))]
        case 2:
            array.shape.append(int(random.choice([0, 1, 2])))
        case 3:
            array.data = raw(array.data, random)
        case _ if len(array.data) >= 8:
            numbers = np.frombuffer(array.data[: len(array.data) // 8 * 8]).copy()
            numbers[int(random.integers(len(numbers)))] = random.choice(_EXTREMES)
            array.data = numbers.tobytes()


def _other_scalar(field: Any, value: Any, random: Random) -> Any:
    kind = field.cpp_type
    if kind == field.CPPTYPE_STRING:
        if field.type == field.TYPE_BYTES:
            return raw(value or b"", random)
        if isinstance(value, str) and value.startswith("{") and random.random() < 0.8:
            return _other_json(value, random)
        return str(random.choice(_TEXTS))
    if kind in (field.CPPTYPE_DOUBLE, field.CPPTYPE_FLOAT):
        return float(random.choice(_EXTREMES))
    if kind == field.CPPTYPE_BOOL:
        return not value
    return int(random.choice(_WHOLE))


def _set(message: Any, field: Any, value: Any) -> None:
    try:
        setattr(message, field.name, value)
    except (ValueError, TypeError):  # beyond its type
        setattr(message, field.name, type(getattr(message, field.name))())


def _other_json(text: str, random: Random) -> str:
    match int(random.integers(6)):
        case 0:
            place = int(random.integers(len(text)))
            return text[:place] + str(random.choice(list('{}[]",:0e-9nt\\'))) + text[place + 1 :]
        case 1:
            return "[" * int(random.choice([10, 40, 3000, 100_000]))
        case 2:
            return text.replace("{", '{"seed": NaN, ', 1)
        case 3:
            return text.replace("{", '{"seed": 1' + "0" * int(random.choice([30, 500, 9000])) + ",")
        case _:
            config = json.loads(text)
            _change_leaf(config, random)
            return json.dumps(config)


def _other_events(events: list[Event], random: Random) -> list[Event]:
    """One or two events with another value, or in another place."""
    for _ in range(int(random.integers(1, 3))):
        place = int(random.integers(len(events)))
        match int(random.integers(12)):
            case 0:
                del events[place]
            case 1:
                events.insert(int(random.integers(len(events))), events[place])
            case 2:
                events.insert(int(random.integers(len(events))), events.pop(place))
            case _:
                events[place] = _other_value(events[place], random)
        if not events:
            break
    return events


def _other_value(value: Any, random: Random) -> Any:
    """A value like this, but for one number or text in it."""
    match value:
        case bool():
            return not value
        case int():
            return int(random.choice(_WHOLE))
        case float():
            return float(random.choice([*_EXTREMES, value * 1.5, np.nextafter(value, 9.0)]))
        case str():
            return str(random.choice(_TEXTS))
        case np.ndarray():
            return _other_array(value, random)
        case tuple() if value:
            parts = list(value)
            place = int(random.integers(len(parts)))
            parts[place] = _other_value(parts[place], random)
            return tuple(parts)
        case Mapping():
            changed = json.loads(json.dumps(dict(value)))
            _change_leaf(changed, random)
            return changed
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    names = [field.name for field in dataclasses.fields(value)]
    name = str(random.choice(names))
    return dataclasses.replace(value, **{name: _other_value(getattr(value, name), random)})


def _other_array(array: np.ndarray, random: Random) -> np.ndarray:
    changed = np.array(array)
    match int(random.integers(6)):
        case 0 if len(changed):
            changed = np.delete(changed, int(random.integers(len(changed))), axis=0)
        case 1:
            changed = random.permutation(changed)
        case 2:
            changed = np.concatenate([changed, changed[:1]])
        case _ if changed.size:
            flat = changed.reshape(-1)
            place = int(random.integers(flat.size))
            if changed.dtype == np.float64:
                near = [np.nextafter(flat[place], 9.0), -flat[place], flat[place] * 1.001]
                flat[place] = random.choice([*near, *_EXTREMES] if random.random() < 0.6 else near)
            elif changed.dtype == np.bool_:
                flat[place] = not flat[place]
            else:
                flat[place] = int(random.choice([-(2**63), -1, 0, 1, 5, 35, 36, 2**63 - 1]))
    return changed


def _change_leaf(config: Any, random: Random) -> None:
    """Another value somewhere in nested plain values."""
    place: Any = None
    while isinstance(config, dict | list) and len(config):
        keys = list(config) if isinstance(config, dict) else list(range(len(config)))
        place = keys[int(random.integers(len(keys)))]
        if not isinstance(config[place], dict | list) or not config[place]:
            break
        config = config[place]
    if place is None:
        return
    value = config[place]
    others: list[Any] = [None, True, "x", [], {}, -1, 0, 0.0, 1e-300, 1e300, 2**62, 10**18, -0.5]
    if isinstance(value, str):
        others += ["initial", "best", "none", "nearest", "interior", "exact", "cma_me", "so3"]
    if isinstance(value, int | float) and not isinstance(value, bool):
        others += [value + 1, value * 2, value * 0.5]
    config[place] = others[int(random.integers(len(others)))]


def _consistent(events: list[Event]) -> list[Event]:
    """Problems with the grid, the points and the actions that the events before them give."""
    made: list[Event] = []
    offered: ActionsOffered | None = None
    start: SessionStarted | None = None
    points = KnownPoints()
    for event in events:
        if isinstance(event, SessionStarted):
            start, points = event, event.initial_points
        elif isinstance(event, Probe):
            points = points.merged(event.new_points)
        elif isinstance(event, ProblemPosed) and start is not None:
            problem = dataclasses.replace(event.problem, points=points, sdf=start.sdf)
            event = ProblemPosed(event.step, problem)
        elif isinstance(event, ActionsOffered):
            offered = event
        elif isinstance(event, Decided) and start is not None and offered is not None:
            parts = {"actions": offered.actions, "hand": offered.hand, "points": points}
            parts |= {"sdf": start.sdf, "workspace": start.workspace}
            parts |= {"free_resolution": start.free_resolution}
            event = dataclasses.replace(event, problem=dataclasses.replace(event.problem, **parts))
        made.append(event)
    return made


LAYERS: dict[str, Callable[[bytes, Random], bytes | None]] = {
    "raw": raw,
    "records": records,
    "messages": messages,
    "tampered": tampered,
}
"""Those that take a file; the fifth is `meaning`."""
