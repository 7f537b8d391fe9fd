"""Offers sessions to other programs: JSON over HTTP, a thread for each session."""

from __future__ import annotations

import asyncio
import secrets
import traceback
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from aiohttp import web

from chsel.errors import ChselError
from chsel.registration import one_line
from chsel.session import Session
from replay.console import print_error
from runners.serving import messages

MOST_BYTES = 256 * 2**20  # of a request


class _Served(NamedTuple):
    """A session, and the one thread that calls it: its requests wait for each other."""

    session: Session
    thread: ThreadPoolExecutor
    about: messages.Json


class Server:
    """The sessions that are open, and the application that offers them."""

    def __init__(self, token: str, folder: Path) -> None:
        """token: that every request must bring. folder: where recordings go."""
        self._token, self._folder = token, folder
        self._served: dict[str, _Served] = {}
        self._count = 0  # sessions opened so far
        self._opener = ThreadPoolExecutor(1)  # which compiles kernels and makes grids
        self.app = web.Application(middlewares=[self._answered], client_max_size=MOST_BYTES)
        self.app.router.add_get("/sessions", self._list)
        self.app.router.add_post("/sessions", self._open)
        self.app.router.add_post(
            f"/sessions/{{name}}/{{verb:{'|'.join(messages.REQUESTS)}}}", self._ask
        )
        self.app.on_cleanup.append(self._close_all)

    @web.middleware
    async def _answered(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[Any]]
    ) -> web.Response:
        """The answer as JSON, to who has the token; an error is one line."""
        header = request.headers.get("Authorization", "").encode(errors="replace")
        status = 200
        try:
            if not secrets.compare_digest(header, f"Bearer {self._token}".encode()):
                text = "the token is missing or wrong; accepted: Authorization: Bearer TOKEN"
                raise web.HTTPUnauthorized(text=text)
            answer = await handler(request)
        except ChselError as error:
            status, answer = 400, {"error": one_line(error)}
        except web.HTTPException as error:  # also of aiohttp, such as 404 for an unknown path
            status, answer = error.status, {"error": error.text}
        except Exception as error:
            traceback.print_exc()
            status, answer = 500, {"error": one_line(error)}
        return web.json_response(messages.plain(answer), status=status)

    async def _list(self, _: web.Request) -> Any:
        sessions = list(self._served.values())  # the opener may add one
        return {"sessions": [{**each.about, "step": each.session.step} for each in sessions]}

    async def _open(self, request: web.Request) -> Any:
        return await _in_thread(self._opener, self._opened, await request.read())

    def _opened(self, body: bytes) -> messages.Json:
        session, about = messages.open_session(body, self._folder)
        self._count += 1
        about = {"session": str(self._count), **about}
        self._served[about["session"]] = _Served(session, ThreadPoolExecutor(1), about)
        return about

    async def _ask(self, request: web.Request) -> Any:
        body = await request.read()
        name, verb = request.match_info["name"], request.match_info["verb"]
        served = self._served.get(name)
        if served is None:
            accepted = ", ".join(self._served) or "none is open"
            raise web.HTTPNotFound(text=f"session {name} is not open; accepted: {accepted}")
        answer = await _in_thread(served.thread, messages.answered, verb, served.session, body)
        if verb == "close":
            self._served.pop(name, None)
            served.thread.shutdown(wait=False)
        return answer

    async def _close_all(self, _: web.Application) -> None:
        """Wait for what is going on, and end every recording."""
        self._opener.shutdown()
        for served in self._served.values():
            closing = served.thread.submit(served.session.close, "interrupted")
            if (error := closing.exception()) is not None:
                print_error(one_line(error))


async def _in_thread(
    thread: ThreadPoolExecutor, function: Callable[..., Any], *arguments: Any
) -> Any:
    return await asyncio.get_running_loop().run_in_executor(thread, function, *arguments)
