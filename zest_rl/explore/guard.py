"""Whom the page's server answers: pages of its own on this machine, which know the address with its random token."""

from __future__ import annotations

import secrets
from collections.abc import Sequence

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEADERS = {
    "content-security-policy": "default-src 'none'; img-src 'self' data:; style-src 'self'; script-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cache-control": "no-store",
}


class Guard:
    """Lets a request through that knows the token and comes from a page of this server or from none."""

    def __init__(self, app: ASGIApp, token: str, hosts: Sequence[str]) -> None:
        """`hosts` are the server's own names, with its port."""
        self._app, self._token, self._hosts = app, token, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 403 or 404 to all others."""
        headers = Headers(scope=scope)
        origins = [f"http://{host}" for host in self._hosts]
        if headers.get("host") not in self._hosts or headers.get("origin", origins[0]) not in origins:
            await PlainTextResponse("this page is for this machine alone", 403)(scope, receive, send)
            return
        given = scope["path"].split("/")[1]
        if not secrets.compare_digest(given.encode(), self._token.encode()):
            await PlainTextResponse("zest explore prints the address of its page", 404)(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        await self._app(scope, receive, send_guarded)
