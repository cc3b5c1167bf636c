"""``/metrics`` and ``/healthz`` over HTTP: one thread, few connections, little time for each."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
from collections.abc import Callable
from http import HTTPStatus

from adapters.command_line import listening
from monitor.service.health import Health, health_json
from monitor.service.metrics import render

MAX_CONNECTIONS = 16
"""Most connections. Chosen: scrapers and a health check need two or three."""
MAX_REQUEST_BYTES = 8192
"""Largest request: what web servers commonly accept as headers."""
REQUEST_S = 2.0
"""Longest time of a request. Chosen: a scraper on any network sends its request within it."""

_JSON = "application/json"
_TEXT = "text/plain; charset=utf-8"


class MetricsServer:
    """Answers GET and HEAD at ``"host:port"`` until closed; each connection serves one request.

    A client that is slow, sends too much or stays connected is cut off after :data:`REQUEST_S`; connections beyond
    :data:`MAX_CONNECTIONS` are closed at once. ``refused`` counts both. ``snapshot`` is called in the server's thread
    for each request; if it raises, the answer is 503. Port 0 takes a free port, which ``port`` names. Raises UsageError
    if the address is invalid, or cannot be listened on.
    """

    def __init__(self, address: str, snapshot: Callable[[], Health]) -> None:
        self.refused = 0
        self._snapshot = snapshot
        self._connections = 0
        self._socket = listening("metrics address", address, "127.0.0.1:9464")
        self.port = int(self._socket.getsockname()[1])
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering; a second call does nothing."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(timeout=REQUEST_S + 1.0)

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._connection, sock=self._socket, limit=MAX_REQUEST_BYTES)
        async with server:
            await self._stop.wait()

    async def _connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        try:
            if self._connections > MAX_CONNECTIONS:
                self.refused += 1
                return
            async with asyncio.timeout(REQUEST_S):
                head = await reader.readuntil(b"\r\n\r\n")
                writer.write(self._answer(head.decode("latin-1")))
                # only then has the system taken the whole answer
                writer.transport.set_write_buffer_limits(high=0)
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, OSError):
            self.refused += 1
        finally:
            writer.transport.abort()
            self._connections -= 1

    def _answer(self, head: str) -> bytes:
        first, *lines = head.split("\r\n")
        words = first.split(" ")
        if len(words) != 3 or not words[2].startswith("HTTP/1."):
            return _response(HTTPStatus.BAD_REQUEST, b"not HTTP/1\n", _TEXT)
        method, path = words[0], words[1].split("?")[0]
        if method not in ("GET", "HEAD"):
            return _response(HTTPStatus.METHOD_NOT_ALLOWED, b"GET or HEAD only\n", _TEXT, "Allow: GET, HEAD\r\n")
        headers = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        return _response(*self._page(path, headers.get("accept", "")), with_body=method == "GET")

    def _page(self, path: str, accept: str) -> tuple[HTTPStatus, bytes, str]:
        if path not in ("/metrics", "/healthz"):
            return HTTPStatus.NOT_FOUND, b"/metrics and /healthz are here\n", _TEXT
        try:
            health = self._snapshot()
            if path == "/metrics":
                body, content_type = render(health, accept)
                return HTTPStatus.OK, body, content_type
            answer = health_json(health)
            status = HTTPStatus.OK if answer["status"] == "ok" else HTTPStatus.SERVICE_UNAVAILABLE
            return status, json.dumps(answer).encode() + b"\n", _JSON
        except Exception as error:
            # whatever it is, the answer is "not well", and the server goes on
            answer = {"status": "trouble", "problems": [f"no snapshot: {type(error).__name__}: {error}"]}
            return HTTPStatus.SERVICE_UNAVAILABLE, json.dumps(answer).encode() + b"\n", _JSON


def _response(status: HTTPStatus, body: bytes, content_type: str, more: str = "", with_body: bool = True) -> bytes:
    head = (
        f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: {content_type}\r\nContent-Length: {len(body)}\r\n"
        f"Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\nConnection: close\r\n{more}\r\n"
    )
    return head.encode("latin-1") + (body if with_body else b"")
