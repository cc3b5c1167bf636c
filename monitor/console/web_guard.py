"""Who may see the console: names of the host, a token, requests of other sites, what pages may load."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
from collections.abc import Collection, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

COOKIE: Final = "fauio-console"
LOGIN: Final = "/login"
PUBLIC: Final = (LOGIN, "/page/console.css", "/page/mark.svg", "/page/login.js")
_STALLED_S: Final = 30.0
"""Chosen: a phone that changes its network is back before; a browser that was stopped is not."""
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
    """Lets through what may pass to an application, and adds the headers of security.

    A name in ``Host`` that was not given might be another site's that was made to point here; addresses cannot be.
    With a ``token`` all but the page that asks for it needs the cookie, or the token as a bearer's.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str], token: str | None) -> None:
        self._app = app
        self._hosts = frozenset(host.lower() for host in hosts) | {"localhost"}
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or let the application."""
        if scope["type"] != "http":
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(_HEADERS)
                headers.setdefault("Cache-Control", "no-store")
            # who does not read for so long is cut off, and his place is another's
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
    """Return what a browser keeps in place of a token."""
    return hmac.digest(token.encode(), b"fauio console", hashlib.sha256).hex()


def same(given: str, right: str) -> bool:
    """Return whether two secrets are the same, in a time that does not depend on where they differ."""
    return hmac.compare_digest(given.encode(), right.encode())
