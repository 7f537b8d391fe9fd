"""Download of one file over HTTP: resumed, bounded, and placed whole or not at all."""

from __future__ import annotations

import http.client
import json
import os
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from urllib.parse import urlsplit

from chsel.errors import ChselError, SettingError

LARGEST_DOWNLOAD = 500_000_000  # bytes; the archives of scans have up to some tens of millions
WAITS = (1.0, 2.0, 4.0)  # seconds before each further attempt
TIMEOUT = 30.0  # seconds without a byte
CHUNK = 1 << 16

Progress = Callable[[int, int | None], None]  # bytes so far, and of all where known


class DownloadError(ChselError):
    """A file could not be downloaded, or is not what was asked for."""


class _Interrupted(Exception):
    """The connection ended early: another attempt may go on from there."""


def download(
    url: str,
    target: Path,
    *,
    progress: Progress = lambda done, total: None,
    limit: int = LARGEST_DOWNLOAD,
    waits: Sequence[float] = WAITS,
) -> None:
    """Download `url` to the file `target`, which appears only when it is complete.

    What arrives is kept in `target`.part and continued by the next attempt or the next call, if
    the server can and its file has not changed. Raises DownloadError if the server refuses, the
    file is larger than `limit` bytes, or the connection fails once more than there are `waits`.
    """
    require_web_address("url", url)
    target.parent.mkdir(parents=True, exist_ok=True)
    transfer = _Transfer(url, target, progress, limit)
    for wait in [*waits, None]:
        try:
            transfer.attempt()
        except _Interrupted as interruption:
            if wait is None:
                message = f"{url}: {interruption}; {transfer.outlook()}"
                raise DownloadError(message) from None
            time.sleep(wait)
        else:
            return


def require_web_address(name: str, url: str) -> None:
    """Raise SettingError unless `url` is an http or https address."""
    try:
        parts = urlsplit(url)
        accepted = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # a port or host that is none
        accepted = False
    if not accepted or re.search(r"[^!-~]", url):
        raise SettingError(f"{name} is {url!r}; accepted: an http:// or https:// address")


@dataclass(frozen=True)
class _Transfer:
    """One download, over several attempts; its state lies in two files beside the target."""

    url: str
    target: Path
    progress: Progress
    limit: int

    @property
    def part(self) -> Path:
        """What has arrived."""
        return self.target.with_name(self.target.name + ".part")

    @property
    def origin(self) -> Path:
        """Which version of which address the part belongs to, so that no other continues it."""
        return self.target.with_name(self.target.name + ".part.json")

    def attempt(self) -> None:
        """Bring the part to its full length and place it, or raise _Interrupted."""
        headers = self._resumption()
        with self._connect(headers) as response:
            done = self.part.stat().st_size if headers else 0
            if response.status == 206:
                self._check_range(response, done)
            else:  # the whole file: it has changed, or the server cannot continue
                done = 0
            total = _total(response)
            if total is not None and total > self.limit:
                raise DownloadError(f"{self.url}: {total} bytes; accepted: up to {self.limit}")
            with self.part.open("ab" if done else "wb") as file:
                if not done:
                    origin = {"url": self.url, "validator": _validator(response)}
                    self.origin.write_text(json.dumps(origin))
                done = self._receive(response, file, done, total)
                file.flush()
                os.fsync(file.fileno())
        if total is not None and done != total:
            raise _Interrupted(f"the connection ended after {done} of {total} bytes")
        os.replace(self.part, self.target)
        self.discard()

    def outlook(self) -> str:
        """What the next call will do about an interruption."""
        resumes = bool(self._resumption())
        return "run the command again to " + (f"go on from {self.part}" if resumes else "retry")

    def discard(self) -> None:
        """Remove what an unfinished download has left."""
        self.part.unlink(missing_ok=True)
        self.origin.unlink(missing_ok=True)

    def _resumption(self) -> dict[str, str]:
        """The headers that ask for the rest of the part, if it is the part of a known version."""
        try:
            origin = json.loads(self.origin.read_text())
            done = self.part.stat().st_size
            known = origin["url"] == self.url and isinstance(origin["validator"], str)
        except (OSError, ValueError, TypeError, KeyError):
            return {}
        if not (known and origin["validator"] and done):
            return {}
        return {"Range": f"bytes={done}-", "If-Range": origin["validator"]}

    def _connect(self, headers: dict[str, str]) -> http.client.HTTPResponse:
        try:
            return _open(self.url, headers)
        except urllib.error.HTTPError as error:
            answer = f"the server answered {error.code} {error.reason}"
            error.close()
            if error.code == 416:  # the part is no part of what the server has now
                self.discard()
            if error.code in (416, 429) or error.code >= 500:
                raise _Interrupted(answer) from None
            raise DownloadError(f"{self.url}: {answer}") from None
        except (http.client.HTTPException, OSError) as error:
            raise _Interrupted(f"no connection ({_reason(error)})") from None

    def _check_range(self, response: http.client.HTTPResponse, done: int) -> None:
        content_range = response.headers.get("Content-Range", "")
        if not content_range.startswith(f"bytes {done}-"):
            self.discard()
            raise _Interrupted(f"asked for bytes from {done} on, the server sent {content_range!r}")

    def _receive(
        self, response: http.client.HTTPResponse, file: IO[bytes], done: int, total: int | None
    ) -> int:
        """Write the body behind the `done` bytes in `file`; how many bytes are there then."""
        self.progress(done, total)
        while chunk := _read(response):
            done += len(chunk)
            if done > self.limit:
                self.discard()
                raise DownloadError(f"{self.url}: too large; accepted: up to {self.limit} bytes")
            file.write(chunk)
            self.progress(done, total)
        return done


def _open(url: str, headers: dict[str, str]) -> http.client.HTTPResponse:
    """The answer to a GET, by way of http and https alone: no redirection leads elsewhere."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler(),
        urllib.request.HTTPHandler(),
        urllib.request.HTTPSHandler(),
        urllib.request.HTTPRedirectHandler(),
        urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPErrorProcessor(),
        urllib.request.UnknownHandler(),
    ):
        opener.add_handler(handler)
    headers = {"Accept-Encoding": "identity", "User-Agent": "chsel-replay", **headers}
    response = opener.open(urllib.request.Request(url, headers=headers), timeout=TIMEOUT)
    assert isinstance(response, http.client.HTTPResponse)
    return response


def _read(response: http.client.HTTPResponse) -> bytes:
    try:
        return response.read(CHUNK)
    except (http.client.HTTPException, OSError) as error:
        raise _Interrupted(f"the connection failed ({_reason(error)})") from None


def _total(response: http.client.HTTPResponse) -> int | None:
    """The size of the whole file, if the server tells it."""
    if response.status == 206:
        size = response.headers.get("Content-Range", "").rpartition("/")[2]
    else:
        size = response.headers.get("Content-Length", "")
    return int(size) if size.isdecimal() else None


def _validator(response: http.client.HTTPResponse) -> str:
    """What tells versions of the file apart: the strong ETag or the time of the last change."""
    etag = response.headers.get("ETag", "")
    return etag if etag.startswith('"') else response.headers.get("Last-Modified", "")


def _reason(error: Exception) -> str:
    return str(getattr(error, "reason", "") or error) or type(error).__name__
