"""Records of any MCAP file: what mcap's own readers do not promise, and what ours does."""

from __future__ import annotations

import contextlib
import io
import struct
import tracemalloc
import zlib
from collections.abc import Callable

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader, make_reader
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC, Writer

from replay.mcap.file import LIMITS
from replay.mcap.record_bytes import HEAD, MALFORMED, parsed, parts, unpacked
from replay.mcap.records import TOO_MUCH_DAMAGE, Damage, Record, Records
from replay.mcap.summary import summary
from replay.raw.raw_reading import LIMITS as RAW_LIMITS

DATA = bytes(range(256)) * 8
PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "zstd": zstandard.ZstdCompressor().compress,
    "lz4": lz4.frame.compress,
}


def chunk(name: str = "", *, data: bytes | None = None, size: int = len(DATA), crc: int = -1):
    """A chunk of DATA; or with other bytes, or claims."""
    packed = PACKERS.get(name, bytes)(DATA) if data is None else data
    return Chunk(name, packed, 0, 0, zlib.crc32(DATA) if crc < 0 else crc, size)


def written() -> bytes:
    """A file with an attachment and three chunks of a message each."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=1, enable_data_crcs=True)
    writer.start()
    writer.add_attachment(0, 0, "mesh.ply", "model/ply", b"attached" * 9)
    channel = writer.register_channel("/a", "json", 0)
    for number in range(3):
        writer.add_message(channel, number, b"%d" % number * 99, number, number)
    writer.finish()
    return file.getvalue()


def flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


def found(data: bytes, limits=LIMITS) -> tuple[list[int], list[str]]:
    """Opcodes of chunks and attachments, and reasons of damage, in a file."""
    walked = list(Records(io.BytesIO(data), limits).whole())
    kinds = [r.opcode for r in walked if isinstance(r, Record)]
    reasons = [r.reason for r in walked if isinstance(r, Damage)]
    return [kind for kind in kinds if kind in (Opcode.CHUNK, Opcode.ATTACHMENT)], reasons


def test_a_whole_file_is_found_whole() -> None:
    data = written()
    assert found(data) == ([Opcode.ATTACHMENT, *[Opcode.CHUNK] * 3], [])
    records = list(Records(io.BytesIO(data), LIMITS).up_to_damage())
    assert [record for record in records if isinstance(record, Damage)] == []
    assert [record.end for record in records[:-1]] == [record.start for record in records[1:]]
    assert len(list(summary(io.BytesIO(data), checked=True))) == 6


def test_mcap_compares_no_checksum_of_attachments_and_summary_and_ours_does() -> None:
    data = written()
    damaged = flipped(data, data.index(b"attached"))
    (attachment,) = make_reader(io.BytesIO(damaged), validate_crcs=True).iter_attachments()
    assert attachment.data != b"attached" * 9
    assert found(damaged)[1] == ["the checksum of an attachment is wrong"]
    damaged = flipped(data, data.rindex(b"/a"))
    told = SeekingReader(io.BytesIO(damaged), validate_crcs=True).get_summary()
    assert told is not None
    assert [channel.topic for channel in told.channels.values()] != ["/a"]
    with pytest.raises(ValueError, match="its checksum is wrong"):
        list(summary(io.BytesIO(damaged), checked=True))


def test_mcap_reads_beyond_a_record_and_ours_does_not() -> None:
    builder = RecordBuilder()
    Schema(1, b"", "", "ab").write(builder)
    Channel(7, "/a", "", {}, 1).write(builder)
    data = bytearray(builder.end())
    data[HEAD.size + 2 + 6 + 4] = 27  # the length of the schema's data, and of the next record
    (schema,) = breakup_chunk(chunk(data=bytes(data), crc=zlib.crc32(data)), validate_crc=True)
    assert isinstance(schema, Schema)
    assert b"/a" in schema.data
    opcode, start, end = next(parts(bytes(data)))
    with pytest.raises(ValueError, match="27 bytes do not fit into their record"):
        parsed(opcode, bytes(data[start:end]))


@pytest.mark.parametrize("name", ["zstd", "lz4"])
def test_mcap_unpacks_all_that_a_chunk_holds_and_ours_what_it_may(name: str) -> None:
    zeros = HEAD.pack(200, 2**25) + bytes(2**25)
    bomb = chunk(name, data=PACKERS[name](zeros), size=100, crc=0)
    limited = {}
    for reader in ("mcap", "ours"):
        tracemalloc.start()
        with contextlib.suppress(*MALFORMED):
            breakup_chunk(bomb) if reader == "mcap" else unpacked(bomb, 2**20, checked=False)
        limited[reader] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert limited["ours"] < 2**20 < 2**24 < limited["mcap"]


def test_mcap_reads_nothing_behind_damage_and_ours_does() -> None:
    data = written()
    start = data.index(b"\x04\0\0\0zstd") - 37
    cut = data[:-60]
    with pytest.raises(McapError):
        SeekingReader(io.BytesIO(cut)).get_summary()
    with pytest.raises((EndOfFile, struct.error)):
        list(StreamReader(io.BytesIO(cut), emit_chunks=True).records)
    assert found(cut)[0].count(Opcode.CHUNK) == 3
    lying = data[: start + 1] + struct.pack("<Q", 2**40) + data[start + 9 :]
    with pytest.raises(McapError, match="exceeds limit"):
        list(StreamReader(io.BytesIO(lying), emit_chunks=True).records)
    kinds, reasons = found(lying)
    assert kinds.count(Opcode.CHUNK) == 2
    assert reasons == ["it is cut within a record, or a length in it is wrong"]


def test_a_record_that_swallows_chunks_does_not_hide_them() -> None:
    data = written()
    first = data.index(b"\x04\0\0\0zstd") - 37
    length = data.index(b"\x04\0\0\0zstd", first + 60) + 5 - first
    swallowing = data[:first] + struct.pack("<BQ", 200, length) + data[first:]
    kinds, reasons = found(swallowing)
    assert kinds.count(Opcode.CHUNK) == 3
    assert len(reasons) == 1


@pytest.mark.parametrize("name", PACKERS)
def test_chunks_are_unpacked_and_wrong_ones_refused(name: str) -> None:
    assert unpacked(chunk(name), 10**6, checked=True) == DATA
    assert unpacked(chunk(name, crc=0), 10**6, checked=False) == DATA  # as writers in a hurry do
    packed = PACKERS[name](DATA)
    broken = [chunk(name, size=size, crc=0) for size in (100, len(DATA) - 1, len(DATA) + 1)]
    broken += [chunk(name, data=data) for data in (packed[:-9], flipped(packed, -9 % len(packed)))]
    for wrong in (*broken, chunk(name, data=b""), chunk(name, crc=7)):
        with pytest.raises(MALFORMED):
            unpacked(wrong, 10**6, checked=False)
    with pytest.raises(ValueError, match="checksum"):
        unpacked(chunk(name, crc=0), 10**6, checked=True)
    with pytest.raises(ValueError, match="claims 2048 bytes"):
        unpacked(chunk(name), 2047, checked=False)


def test_zstd_frames_need_not_say_their_size() -> None:
    streamed = zstandard.ZstdCompressor(write_content_size=False).compress(DATA)
    assert unpacked(chunk("zstd", data=streamed), 10**6, checked=True) == DATA
    with pytest.raises(MALFORMED):
        unpacked(chunk("zstd", data=streamed, size=100, crc=0), 10**6, checked=False)
    with pytest.raises(ValueError, match="larger than it claims"):
        unpacked(chunk("zstd", size=100, crc=0), 10**6, checked=False)
    with pytest.raises(ValueError, match="accepted: zstd, lz4"):
        unpacked(chunk("br"), 10**6, checked=False)


def test_records_must_fit_into_their_chunk() -> None:
    good = struct.pack("<BQ", 5, 3) + b"abc"
    assert list(parts(good * 2)) == [(5, 9, 12), (5, 21, 24)]
    for broken in (good[:-1], good + b"\5", struct.pack("<BQ", 5, 2**63)):
        with pytest.raises(ValueError, match=r"fit into its chunk|within a record"):
            list(parts(broken))


class Counting(io.BytesIO):
    """Counts the bytes that are read."""

    total = 0

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        self.total += len(data)
        return data


@pytest.mark.parametrize("limits", [LIMITS, RAW_LIMITS], ids=["recordings", "logs"])
@pytest.mark.parametrize("ends_apart", [1, 0])
def test_thousands_of_chunks_within_chunks_are_not_all_tried(limits, ends_apart: int) -> None:
    """Each claims all that follows, so that believing their heads would take for ever."""
    count, head = 6000, 53
    size = 8 + count * head + 400_000
    file = bytearray(MCAP0_MAGIC)
    for index in range(count):
        left = size - len(file) - head - ends_apart * (index + 1)
        file += struct.pack("<BQ", Opcode.CHUNK, left + 44)
        file += struct.pack("<QQQII4sQ", 0, 0, left, 1, 4, b"zstd", left)
    file += b"\xff" * (size - len(file))
    counting = Counting(bytes(file))
    *damages, last = Records(counting, limits).whole()
    assert all(isinstance(damage, Damage) for damage in damages)
    assert isinstance(last, Damage)
    assert last.reason == TOO_MUCH_DAMAGE
    assert counting.total < limits.size + 9 * size
