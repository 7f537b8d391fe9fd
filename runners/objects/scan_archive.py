"""The archive of a scan: downloaded whole or not at all, and unpacked without trusting it."""

from __future__ import annotations

import gzip
import os
import shutil
import tarfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import IO, Any, cast

import pooch
import requests

from chsel.errors import ChselError

LARGEST_DOWNLOAD = 500_000_000  # bytes; the archives of scans have up to some tens of millions
LARGEST_CONTENT = 1_000_000_000  # bytes, unpacked
MOST_MEMBERS = 10_000
RETRIES = 3  # pooch waits a second before the first, and a second longer before each further one
TIMEOUT = 30.0  # seconds without a byte
CHUNK = 1 << 16
_HEADERS = {"Accept-Encoding": "identity", "User-Agent": "chsel-replay"}
_IN_THE_WAY = (FileExistsError, NotADirectoryError, IsADirectoryError)

Progress = Callable[[int, int | None], None]  # bytes so far, and of all where known


class DownloadError(ChselError):
    """A file could not be downloaded, or is not what was asked for."""


def download(
    url: str,
    target: Path,
    *,
    progress: Progress = lambda done, total: None,
    limit: int = LARGEST_DOWNLOAD,
    retries: int = RETRIES,
) -> None:
    """Download `url` to the file `target`, which appears only when it is complete.

    Raises DownloadError if the server refuses, the file is larger than `limit` bytes, or the
    connection fails once more than there are retries.
    """
    pooch.get_logger().setLevel("ERROR")
    name = target.name
    files = pooch.create(
        target.parent, "", registry={name: None}, urls={name: url}, retry_if_failed=retries
    )
    bounded = _Bounded(url, progress, limit)
    try:
        files.fetch(name, downloader=_Downloader(bounded, CHUNK, timeout=TIMEOUT, headers=_HEADERS))
    except requests.RequestException as error:
        reason = " ".join(str(error).split())
        raise DownloadError(f"{url}: {reason}; run the command again to retry") from None


class _Downloader(pooch.HTTPDownloader):
    """Does not ask again for what the server refuses."""

    def __call__(self, *given: Any, **named: Any) -> Any:
        try:
            return super().__call__(*given, **named)
        except requests.HTTPError as error:
            answer = error.response
            if answer is None or answer.status_code >= 500 or answer.status_code == 429:
                raise
            text = f"the server answered {answer.status_code} {answer.reason}"
            raise DownloadError(f"{answer.url}: {text}") from None


class _Bounded:
    """The progress bar that pooch writes to: ends a download that is too large."""

    def __init__(self, url: str, show: Progress, limit: int) -> None:
        self._url, self._show, self._limit = url, show, limit
        self._done = self._total = 0

    @property
    def total(self) -> int:
        """Bytes of the file; 0 if the server does not say."""
        return self._total

    @total.setter
    def total(self, total: int) -> None:
        self._done, self._total = 0, total
        self._check(total)
        self._show(0, total or None)

    def update(self, count: int) -> None:
        """So many bytes, or fewer with the last ones, have come."""
        self._check(self._done)
        self._done += count
        self._show(min(self._done, self._total or self._done), self._total or None)

    def reset(self) -> None:
        """All bytes have come; pooch counts them once more."""
        self._done = 0

    def close(self) -> None:
        """The bar is the caller's to close."""

    def _check(self, size: int) -> None:
        if size > self._limit:
            raise DownloadError(f"{self._url}: too large; accepted: up to {self._limit} bytes")


def unpack(archive: Path, folder: Path, *, limit: int = LARGEST_CONTENT) -> None:
    """Unpack the files of a .tgz `archive` into `folder`, a new one.

    Raises DownloadError if it is damaged, holds more than `limit` bytes, or has a member that is a
    link or device, lies outside of `folder`, or takes the place of another; some members may be
    unpacked then.
    """
    try:
        with gzip.open(archive) as unzipped:
            stream = _BoundedStream(cast(IO[bytes], unzipped), limit)
            with tarfile.open(fileobj=cast(Any, stream), mode="r|") as tar:
                for count, member in enumerate(tar, start=1):
                    if count > MOST_MEMBERS:
                        raise tarfile.ReadError(f"it has over {MOST_MEMBERS} members")
                    _write(tar, member, folder)
            while stream.read(CHUNK):  # up to the checksum at the end
                pass
    except (tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise DownloadError(f"archive {archive.name} cannot be unpacked: {error}") from None


class _BoundedStream:
    """A stream of which at most `limit` bytes can be read."""

    def __init__(self, stream: IO[bytes], limit: int) -> None:
        self._stream, self._left = stream, limit

    def read(self, size: int) -> bytes:
        data = self._stream.read(min(size, self._left + 1))
        self._left -= len(data)
        if self._left < 0:
            raise tarfile.ReadError("it is too large when unpacked")
        return data


def _write(tar: tarfile.TarFile, member: tarfile.TarInfo, folder: Path) -> None:
    """Write a member below the folder; ReadError if it is not a new plain file or a folder there.

    Also refused are names that would lie outside of the folder on another system alone.
    """
    inside = PurePosixPath(member.name)
    if inside.is_absolute() or ".." in inside.parts or any(sign in member.name for sign in "\\:\0"):
        raise tarfile.ReadError(f"member {member.name!r} lies outside of the folder")
    if member.issparse() or not (member.isreg() or member.isdir()):
        raise tarfile.ReadError(f"member {member.name!r} is neither a plain file nor a folder")
    path = folder / inside
    try:
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
    except _IN_THE_WAY:
        raise tarfile.ReadError(f"member {member.name!r} takes the place of another") from None
