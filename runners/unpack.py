"""Unpacking of downloaded archives, which are trusted with nothing."""

from __future__ import annotations

import gzip
import os
import shutil
import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Any, cast

from runners.download import CHUNK, DownloadError

LARGEST_CONTENT = 1_000_000_000  # bytes, unpacked
MOST_MEMBERS = 10_000


def unpack(archive: Path, folder: Path, *, limit: int = LARGEST_CONTENT) -> None:
    """Unpack the files of a .tgz `archive` into `folder`.

    The whole archive is looked through first. Raises DownloadError, with nothing written, if it
    is damaged, holds more than `limit` bytes, or has a member that is a link or device, lies
    outside of `folder`, or takes the place of another.
    """
    try:
        _check_members([member for _, member in _walk(archive, limit)])
        for tar, member in _walk(archive, limit):
            _write(tar, member, folder / _path(member))
    except (tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise DownloadError(f"archive {archive.name} cannot be unpacked: {error}") from None


class _Bounded:
    """A stream of which at most `limit` bytes can be read."""

    def __init__(self, stream: IO[bytes], limit: int) -> None:
        self._stream, self._left = stream, limit

    def read(self, size: int) -> bytes:
        data = self._stream.read(min(size, self._left + 1))
        self._left -= len(data)
        if self._left < 0:
            raise tarfile.ReadError("it is too large when unpacked")
        return data


def _walk(archive: Path, limit: int) -> Iterator[tuple[tarfile.TarFile, tarfile.TarInfo]]:
    """The members in order, each with the archive while it stands there; no byte is skipped."""
    with gzip.open(archive) as stream:
        bounded = _Bounded(cast(IO[bytes], stream), limit)
        with tarfile.open(fileobj=cast(Any, bounded), mode="r|") as tar:
            for count, member in enumerate(tar):
                if count >= MOST_MEMBERS:
                    raise tarfile.ReadError(f"it has over {MOST_MEMBERS} members")
                yield tar, member
        while bounded.read(CHUNK):  # up to the checksum at the end
            pass


def _check_members(members: list[tarfile.TarInfo]) -> None:
    """Raise ReadError unless all members can be written, each to a place of its own."""
    files: set[PurePosixPath] = set()
    folders = {PurePosixPath(".")}
    for member in members:
        path = _path(member)
        if member.issparse() or not (member.isreg() or member.isdir()):
            raise tarfile.ReadError(f"member {member.name!r} is neither a plain file nor a folder")
        if path in files:
            raise tarfile.ReadError(f"member {member.name!r} is there twice")
        (folders if member.isdir() else files).add(path)
        folders.update(path.parents)
    if clash := files & folders:
        raise tarfile.ReadError(f"member {str(min(clash))!r} is both a file and a folder")


def _path(member: tarfile.TarInfo) -> PurePosixPath:
    """Where a member belongs, below the folder; ReadError if that is elsewhere on any system."""
    path = PurePosixPath(member.name)
    if path.is_absolute() or ".." in path.parts or any(mark in member.name for mark in "\\:\0"):
        raise tarfile.ReadError(f"member {member.name!r} lies outside of the folder")
    return path


def _write(tar: tarfile.TarFile, member: tarfile.TarInfo, path: Path) -> None:
    if member.isdir():
        path.mkdir(parents=True, exist_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    source = tar.extractfile(member)
    assert source is not None
    with source, path.open("xb") as file:
        shutil.copyfileobj(source, file)
        file.flush()
        os.fsync(file.fileno())
