"""Offers sessions to other programs: JSON over HTTP, a thread for each session."""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import sys
import threading
import traceback
import zlib
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from aiohttp import web

from chsel.errors import ChselError, SettingError, quoted
from chsel.session.recording import one_line
from chsel.session.session import Session
from replay.console import print_error
from runners.serving import messages

MOST_BYTES = 256 * 2**20  # of a request
PATIENCE = 0.25  # seconds that requests have to finish once the server ends
_AT_ONCE = 8  # recordings that end, as each waits for the disk
_LEAST_PRIORITY = 19  # of a thread in Linux
_LONGEST_LINE = 2**16  # bytes, so that a long name is answered as others are
_WITH_HEADER = 32 + zlib.MAX_WBITS  # of zlib: that of gzip or of deflate
_LOGGER = logging.getLogger(__name__)  # of aiohttp, about what clients do wrong
_LOGGER.addHandler(logging.NullHandler())


class _Served(NamedTuple):
    """A session, and the one thread that calls it: its requests wait for each other."""

    session: Session
    thread: ThreadPoolExecutor
    thread_id: int  # of the system
    about: messages.Json

    def yield_processor(self) -> None:
        """Let all other threads go first, where threads have priorities of their own."""
        if sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, self.thread_id, _LEAST_PRIORITY)


class Server:
    """The sessions that are open, and the application that offers them."""

    def __init__(self, token: str, folder: Path) -> None:
        """Start without sessions. token: of every request. folder: of the recordings."""
        self._token, self._folder = token, folder
        self._served: dict[str, _Served] = {}
        self._count = 0  # sessions opened so far
        self._ending = False  # nothing is begun any more
        self.is_computing = False  # for a session whose recording has ended
        self._opener = ThreadPoolExecutor(1)  # which compiles kernels and makes grids
        connections = {"logger": _LOGGER, "max_line_size": _LONGEST_LINE, "auto_decompress": False}
        self.app = web.Application(
            middlewares=[self._answered], client_max_size=MOST_BYTES, handler_args=connections
        )
        self.app.router.add_get("/sessions", self._list)
        self.app.router.add_post("/sessions", self._open)
        self.app.router.add_post(
            f"/sessions/{{name}}/{{verb:{'|'.join(messages.REQUESTS)}}}", self._ask
        )
        self.app.on_shutdown.append(self._close_all)  # before clients are waited for

    @web.middleware
    async def _answered(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[Any]]
    ) -> web.Response:
        """Return the answer as JSON, if the token is right; an error is one line."""
        header = request.headers.get("Authorization", "").encode(errors="replace")
        status = 200
        try:
            if not secrets.compare_digest(header, f"Bearer {self._token}".encode()):
                text = "the token is missing or wrong; accepted: Authorization: Bearer TOKEN"
                raise web.HTTPUnauthorized(text=text)
            answer = await handler(request)
        except ChselError as error:
            status = 400
            answer = {"error": one_line(error)}
        except web.HTTPException as error:  # also of aiohttp, such as 404 for an unknown path
            status = error.status
            answer = {"error": error.text}
        except (ConnectionError, web.RequestPayloadError):  # nobody may be there to read this
            status, answer = 400, {"error": "the body is cut; accepted: as long as it says"}
        except OSError as error:  # of a file that a request names
            status = 400
            answer = {"error": one_line(error)}
        except Exception as error:
            traceback.print_exc()
            status = 500
            answer = {"error": one_line(error)}
        return web.json_response(messages.plain(answer), status=status)

    async def _list(self, _: web.Request) -> Any:
        sessions = list(self._served.values())  # the opener may add one
        return {"sessions": [{**each.about, "step": each.session.step} for each in sessions]}

    async def _open(self, request: web.Request) -> Any:
        return await _in_thread(self._opener, self._opened, await _body(request))

    def _opened(self, body: bytes) -> messages.Json:
        self._check_open()
        session, about = messages.open_session(body, self._folder)
        self._count += 1
        about = {"session": str(self._count), **about}
        thread = ThreadPoolExecutor(1)
        thread_id = thread.submit(threading.get_native_id).result()
        self._served[about["session"]] = _Served(session, thread, thread_id=thread_id, about=about)
        return about

    async def _ask(self, request: web.Request) -> Any:
        body = await _body(request)
        name, verb = request.match_info["name"], request.match_info["verb"]
        served = self._served.get(name)
        if served is None:
            accepted = ", ".join(self._served) or "none is open"
            raise web.HTTPNotFound(text=f"session {name} is not open; accepted: {accepted}")
        answer = await _in_thread(served.thread, self._asked, verb, served.session, body)
        if verb == "close":
            self._served.pop(name, None)
            served.thread.shutdown(wait=False)
        return answer

    def _asked(self, verb: str, session: Session, body: bytes) -> messages.Json:  # noqa: PLR0917
        self._check_open()
        return messages.answered(verb, session, body=body)

    def _check_open(self) -> None:
        """Raise HTTPServiceUnavailable if the server ends, for a request that waited."""
        if self._ending:
            raise web.HTTPServiceUnavailable(text="the server ends; accepted: nothing more")

    async def _close_all(self, _: web.Application) -> None:
        """End every recording, also of sessions for which something is still being computed."""
        self._ending = True
        await self._close_served()
        opened = asyncio.ensure_future(_in_thread(self._opener, self._served.copy))
        await asyncio.wait([opened], timeout=PATIENCE)
        self.is_computing = self.is_computing or not opened.done()
        await self._close_served()

    async def _close_served(self) -> None:
        served, self._served = self._served, {}
        closing = {
            asyncio.ensure_future(_in_thread(each.thread, each.session.close, "interrupted")): each
            for each in served.values()
        }
        if not closing:
            return
        done, computing = await asyncio.wait(closing, timeout=PATIENCE)
        self.is_computing = self.is_computing or bool(computing)
        for waiting in computing:
            closing[waiting].yield_processor()
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            interrupted = [
                asyncio.ensure_future(_in_thread(pool, closing[waiting].session.interrupt))
                for waiting in computing
            ]
            await asyncio.gather(*interrupted, return_exceptions=True)
        for ended in [*done, *interrupted]:
            error = ended.exception()
            if error is not None:
                print_error(one_line(error))


async def _body(request: web.Request) -> bytes:
    """Return the body of a request, unpacked; raise SettingError if that cannot be done."""
    body = await request.read()
    encoding = request.headers.get("Content-Encoding", "").lower()
    if encoding in ("", "identity"):
        return body
    if encoding not in ("gzip", "deflate"):
        accepted = "accepted: gzip, deflate, or none"
        raise SettingError(f"Content-Encoding is {quoted(encoding)}; {accepted}")
    unpacking = zlib.decompressobj(_WITH_HEADER)
    try:
        body = unpacking.decompress(body, MOST_BYTES)
    except zlib.error as error:
        raise SettingError(f"the body is not {encoding} ({error})") from None
    if not unpacking.eof:
        accepted = f"accepted: a whole one of at most {MOST_BYTES} bytes"
        raise SettingError(f"the body in {encoding} is cut, or too long; {accepted}")
    return body


async def _in_thread(
    thread: ThreadPoolExecutor, function: Callable[..., Any], *arguments: Any
) -> Any:
    return await asyncio.get_running_loop().run_in_executor(thread, function, *arguments)
