"""Chunks of any compression, and what claims more than it holds."""

import struct
import zlib
from collections.abc import Callable

import lz4.frame
import pytest
import zstandard
from replay.raw.chunks import UNPACKING_ERRORS, records, unpacked

DATA = bytes(range(256)) * 8
PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "zstd": zstandard.ZstdCompressor().compress,
    "lz4": lz4.frame.compress,
}


def chunk(
    name: str = "", *, data: bytes | None = None, size: int = len(DATA), checksum: int | None = None
) -> bytes:
    """The body of a chunk record."""
    data = PACKERS.get(name, bytes)(DATA) if data is None else data
    checksum = zlib.crc32(DATA) if checksum is None else checksum
    head = struct.pack("<QQQII", 0, 0, size, checksum, len(name)) + name.encode()
    return head + struct.pack("<Q", len(data)) + data


@pytest.mark.parametrize("name", PACKERS)
def test_chunks_are_unpacked(name: str) -> None:
    assert unpacked(chunk(name), 10**6) == DATA
    assert unpacked(chunk(name, checksum=0), 10**6) == DATA  # as writers in a hurry leave it


def test_zstd_frames_need_not_tell_their_size() -> None:
    streamed = zstandard.ZstdCompressor(write_content_size=False).compress(DATA)
    assert unpacked(chunk("zstd", data=streamed), 10**6) == DATA
    with pytest.raises(UNPACKING_ERRORS):
        unpacked(chunk("zstd", data=streamed, size=100, checksum=0), 10**6)


@pytest.mark.parametrize("name", PACKERS)
@pytest.mark.parametrize("size", [100, len(DATA) - 1, len(DATA) + 1])
def test_a_wrong_size_is_an_error(name: str, size: int) -> None:
    with pytest.raises(UNPACKING_ERRORS):
        unpacked(chunk(name, size=size, checksum=0), 10**6)


@pytest.mark.parametrize("name", PACKERS)
def test_changed_bytes_and_cut_chunks_are_errors(name: str) -> None:
    body = bytearray(chunk(name))
    body[-9] ^= 1
    for broken in (bytes(body), chunk(name)[:-1], chunk(name)[:40], b"", chunk(name, checksum=7)):
        with pytest.raises(UNPACKING_ERRORS):
            unpacked(broken, 10**6)


def test_a_zstd_frame_that_tells_of_more_is_refused_before_room_is_made_for_it() -> None:
    with pytest.raises(ValueError, match="larger than it claims"):
        unpacked(chunk("zstd", size=100, checksum=0), 10**6)


def test_more_than_is_allowed_is_refused_before_it_is_unpacked() -> None:
    with pytest.raises(ValueError, match="claims 2048 bytes"):
        unpacked(chunk("zstd"), 2047)
    with pytest.raises(ValueError, match="claims 1099511627776 bytes"):
        unpacked(chunk("zstd", size=2**40), 2**50)
    with pytest.raises(ValueError, match="accepted: zstd, lz4"):
        unpacked(chunk("br"), 10**6)


def test_records_must_fit_into_their_chunk() -> None:
    good = struct.pack("<BQ", 5, 3) + b"abc"
    assert list(records(good * 2)) == [(5, 9, 12), (5, 21, 24)]
    for broken in (good[:-1], good + b"\5", struct.pack("<BQ", 5, 2**63)):
        with pytest.raises(ValueError, match=r"fit into its chunk|within a record"):
            list(records(broken))
