"""The web console: pages, a stream of news, and operators' commands, served by a thread of its own."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import ipaddress
import itertools
import json
import threading
from collections.abc import AsyncIterator, Collection, MutableMapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from adapters.command_line import listening
from adapters.errors import FauioError, printable
from monitor.bus.operators import VERBS
from monitor.bus.payload import to_json
from monitor.console.fleet_view import FleetView
from monitor.console.operator_client import past_events, send_command
from monitor.console.vehicle_history import Since

if TYPE_CHECKING:
    import zenoh


COOKIE: Final = "fauio-console"
LOGIN: Final = "/login"
PUBLIC: Final = (LOGIN, "/page/console.css", "/page/mark.svg", "/page/login.js")
_STALLED_S: Final = 30.0
"""Seconds that a browser may take to read an answer before its connection is cut off. Chosen: a phone that changes its
network is back before; a browser that was stopped is not."""
_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; form-action 'self'; "
    "base-uri 'none'; frame-ancestors 'none'"
)
_HEADERS: Final = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class Guard:
    """Refuses requests without permission, and adds security headers to the application's answers.

    A name in ``Host`` that is not among ``hosts`` may belong to another site that was made to point here; an address
    cannot. With a ``token`` all pages except the login page require the cookie, or the token as a bearer token.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str], token: str | None) -> None:
        self._app = app
        self._hosts = frozenset(host.lower() for host in hosts) | {"localhost"}
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it to the application."""
        if scope["type"] != "http":
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(_HEADERS)
                headers.setdefault("Cache-Control", "no-store")
            # a page that does not read for so long is cut off, as another may need its connection
            async with asyncio.timeout(_STALLED_S):
                await send(message)

        await (self._refusal(scope) or self._app)(scope, receive, send_guarded)

    def _refusal(self, scope: MutableMapping[str, Any]) -> ASGIApp | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if not self._knows(host):
            return PlainTextResponse("this is not my name; the console is started with --host NAME for others\n", 421)
        if scope["method"] == "POST":
            origin = headers.get("origin")
            if headers.get("sec-fetch-site", "same-origin") != "same-origin" or (
                origin is not None and origin.partition("://")[2].lower() != host.lower()
            ):
                return PlainTextResponse("a page of another site may not command\n", 403)
        if self._token is None or scope["path"] in PUBLIC or self._proves(headers, self._token):
            return None
        if scope["path"] == "/":
            return RedirectResponse(LOGIN, 303)
        return PlainTextResponse("a token is needed\n", 401)

    def _knows(self, host: str) -> bool:
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdecimal() and not host.endswith("]") else host
        name = name.strip("[]").lower().removesuffix(".")
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in self._hosts
        return True

    def _proves(self, headers: Headers, token: str) -> bool:
        kind, _, given = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer":
            return same(given, token)
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            return False
        return morsel is not None and same(morsel.value, cookie_of(token))


def cookie_of(token: str) -> str:
    """Return the value of the cookie, which a browser keeps in place of a token."""
    return hmac.digest(token.encode(), b"fauio console", hashlib.sha256).hex()


def same(given: str, right: str) -> bool:
    """Return whether two secrets are equal, in a time that does not depend on where they differ."""
    return hmac.compare_digest(given.encode(), right.encode())


PERIOD_S: Final = 0.25
"""Seconds between two pieces of news. Chosen: it looks live, and an alarm has a second to appear."""
_ALIVE_S: Final = 5.0
"""Seconds without news after which a stream sends a sign of life. Chosen: a page takes 12 s without one for a lost
connection."""
_MAX_STREAMS: Final = 64
"""Largest number of open streams. Chosen: four pages for each of 16 vehicles."""
_MAX_BODY: Final = 4096
"""Largest size of a command, bytes. Chosen: as much as a monitor accepts."""
_MAX_HISTORY: Final = 500
"""Largest number of events on a page. Chosen: a journal of a busy week; ``fauio alarms --history`` has all."""
_CLOSE_S: Final = 3.0
"""Seconds to wait for open streams at the end. Chosen: they end within a period; one that hangs is not waited for."""
_LOGIN_PAUSE_S: Final = 1.0
"""Seconds between two guesses of a token. Chosen: a guess a second finds no token."""
LISTEN = "127.0.0.1:8600"
_PAGE: Final = Path(__file__).parent / "page"
_UPLOT: Final = Path(__file__).parent.parent / "views" / "uplot"


@dataclass(frozen=True, slots=True)
class ConsoleOptions:
    """Options of a console: what it serves, and to whom."""

    listen: str = LISTEN
    prefix: str = "fauio"
    commands: bool = False  # whether alarms may be acknowledged, shelved and closed
    token: str | None = None
    hosts: Collection[str] = ()  # names, beside addresses and localhost, under which it is reached
    clips: Path | None = None  # folder of recordings that may be downloaded


class ConsoleServer:
    """Serves the console until closed; the session is left open.

    Raises UsageError if the address cannot be listened on.
    """

    def __init__(self, session: zenoh.Session, options: ConsoleOptions) -> None:
        self._session = session
        self._options = options
        self.streams = 0  # open pages
        self._ended = False
        self._guesses = asyncio.Lock()
        self._socket = listening("--listen", options.listen, LISTEN)
        host, port = self._socket.getsockname()[:2]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}/"
        self.fleet = FleetView(session, options.prefix)
        routes = [
            Route("/", self._index),
            Route(LOGIN, self._login, methods=["GET", "POST"]),
            Route("/stream", self._stream),
            Route("/command", self._command, methods=["POST"]),
            Route("/history", self._history),
            Route("/clips", self._clip_list),
            Route("/clips/{name}", self._clip),
            Mount("/page", StaticFiles(directory=_PAGE)),
            Mount("/uplot", StaticFiles(directory=_UPLOT)),
        ]
        app = Guard(Starlette(routes=routes), options.hosts, options.token)
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                log_config=None,
                log_level="critical",  # a page that was cut off is no error
                access_log=False,
                lifespan="off",
                ws="none",
                server_header=False,
                proxy_headers=False,
                limit_concurrency=4 * _MAX_STREAMS,
                timeout_graceful_shutdown=1,
            )
        )
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="console", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End streams and stop serving; a second call does nothing."""
        if not self._ended:
            self._ended = self._server.should_exit = True
            self._thread.join(_CLOSE_S)
            self._socket.close()
            self.fleet.close()

    def wait(self, timeout_s: float) -> bool:
        """Wait until serving ends, at most so long; return whether it still runs."""
        self._thread.join(timeout_s)
        return self._thread.is_alive()

    async def _index(self, request: Request) -> Response:
        del request
        return FileResponse(_PAGE / "index.html")

    async def _login(self, request: Request) -> Response:
        token = self._options.token
        if token is None:
            return RedirectResponse("/", 303)
        if request.method == "GET":
            return FileResponse(_PAGE / "login.html")
        body = await _body(request)
        async with self._guesses:
            if body is None or not isinstance(given := body.get("token"), str) or not same(given.strip(), token):
                await asyncio.sleep(_LOGIN_PAUSE_S)
                return JSONResponse({"error": "this is not the token"}, 403)
        answer = JSONResponse({"ok": True})
        answer.set_cookie(COOKIE, cookie_of(token), httponly=True, samesite="strict")
        return answer

    async def _stream(self, request: Request) -> Response:
        if self.streams >= _MAX_STREAMS:
            return JSONResponse({"error": "too many pages are open"}, 503, {"Retry-After": "5"})
        vehicle = request.query_params.get("vehicle")
        return StreamingResponse(
            self._news(vehicle), media_type="text/event-stream", headers={"X-Accel-Buffering": "no"}
        )

    async def _news(self, vehicle: str | None) -> AsyncIterator[bytes]:
        """Yield news: nothing waits for a slow reader, who gets the latest data when it reads again."""
        self.streams += 1
        try:
            clips = self._options.clips is not None
            hello = {"version": version("fauio"), "commands": self._options.commands, "clips": clips}
            yield b"retry: 1000\n" + _event("hello", hello)
            have: Since = {}
            silent_s = 0.0
            while not self._server.should_exit:
                news = self.fleet.news(have, vehicle)
                silent_s = 0.0 if news else silent_s + PERIOD_S
                if news:
                    yield _event("news", news)
                elif silent_s >= _ALIVE_S:
                    silent_s = 0.0
                    yield _event("alive", {})
                await asyncio.sleep(PERIOD_S)
        finally:
            self.streams -= 1

    async def _command(self, request: Request) -> Response:
        if not self._options.commands:
            return JSONResponse({"error": "this console is read-only; start it with --commands"}, 403)
        body = await _body(request)
        if body is None:
            return JSONResponse({"error": "no command"}, 400)
        vehicle, verb = body.get("vehicle"), body.get("verb")
        if not isinstance(vehicle, str) or verb not in VERBS or vehicle not in self.fleet.subscriber.live:
            return JSONResponse({"error": "no such vehicle or command"}, 400)
        wanted = {name: body[name] for name in ("id", "channel", "by", "reason", "minutes") if body.get(name)}
        try:
            reply = await run_in_threadpool(
                send_command, self._session, self._options.prefix, vehicle, str(verb), wanted
            )
        except FauioError as error:
            return JSONResponse({"error": printable(str(error))}, 409)
        return _json(reply)

    async def _history(self, request: Request) -> Response:
        vehicle = request.query_params.get("vehicle") or "*"
        try:
            events = await run_in_threadpool(past_events, self._session, self._options.prefix, vehicle)
        except FauioError as error:
            return JSONResponse({"error": printable(str(error))}, 400)
        events.sort(key=lambda event: (-event.time_ns, -event.seq))
        return _json({"events": [event.to_json() for event in events[:_MAX_HISTORY]], "all": len(events)})

    async def _clip_list(self, request: Request) -> Response:
        del request
        clips = []
        for name, path in (await run_in_threadpool(self._clips)).items():
            with contextlib.suppress(OSError):
                state = path.stat()
                clips.append({"name": name, "bytes": state.st_size, "time_ns": state.st_mtime_ns})
        return _json({"clips": clips})

    async def _clip(self, request: Request) -> Response:
        name = request.path_params["name"]
        path = (await run_in_threadpool(self._clips)).get(name)
        if path is None:
            return JSONResponse({"error": "no such clip"}, 404)
        return FileResponse(path, filename=name, media_type="application/octet-stream")

    def _clips(self) -> dict[str, Path]:
        """Return the newest clips by name: plain files of the folder, and of the folders of vehicles in it."""
        folder = self._options.clips
        if folder is None:
            return {}
        found: list[tuple[int, Path]] = []
        for path in itertools.chain(folder.glob("*.mcap"), folder.glob("*/*.mcap")):
            with contextlib.suppress(OSError):
                plain = path.is_file() and not path.is_symlink() and not path.parent.is_symlink()
                if plain and path.name.isprintable():
                    found.append((path.stat().st_mtime_ns, path))
        return {path.name: path for _, path in sorted(found, reverse=True)[:_MAX_HISTORY]}


async def _body(request: Request) -> dict[str, Any] | None:
    """Return the JSON object of a request, or None if it is no object or too long."""
    if Headers(scope=request.scope).get("content-type", "").partition(";")[0].strip() != "application/json":
        return None
    data = b""
    async for chunk in request.stream():
        data += chunk
        if len(data) > _MAX_BODY:
            return None
    try:
        body = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return body if isinstance(body, dict) else None


def _json(payload: dict[str, Any]) -> Response:
    return Response(to_json(payload), media_type="application/json")


def _event(name: str, payload: dict[str, Any]) -> bytes:
    return f"event: {name}\ndata: ".encode() + to_json(payload) + b"\n\n"
