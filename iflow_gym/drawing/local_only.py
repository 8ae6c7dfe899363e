"""ASGI middleware that keeps the page to this machine and to itself.

The server listens on the loopback address alone. A page from elsewhere, in the same browser, can
still send requests there; hence:

- The Host header has to be the server's own: a foreign name that resolves to 127.0.0.1 (DNS
  rebinding) is refused.
- What changes something has to come with the page's own Origin: another site's form or script is
  refused.
- A request's body has a greatest size.
- Every answer carries a content security policy under which the page loads nothing from elsewhere
  and is framed by nobody.
"""

from __future__ import annotations

from collections.abc import Collection

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_BYTES = 4_000_000
"""Of a request's body: some hundred thousand samples."""

SAFE_METHODS = ("GET", "HEAD")

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class LocalOnly:
    """The middleware.

    Parameters
    ----------
    app : ASGI application
    hosts : collection of str
        Host headers that are the server's own, with the port.
    most_bytes : int
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str], most_bytes: int = MOST_BYTES) -> None:
        self._app, self._hosts, self._most_bytes = app, frozenset(hosts), most_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":  # there are no websockets here
            return

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
            await send(message)

        refusal = self._refusal(scope)
        if refusal is None:
            body = await _body(receive, self._most_bytes)
            if body is not None:
                await self._app(scope, _replayed(body, receive), sent)
                return
            refusal = (413, f"Expected at most {self._most_bytes} bytes: draw less at a time.")
        status, why = refusal
        await JSONResponse({"error": why}, status)(scope, receive, sent)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if host not in self._hosts:
            return 421, f"Expected the host {' or '.join(sorted(self._hosts))}, got {host!r}."
        if scope["method"] not in SAFE_METHODS:
            origin = headers.get("origin", "")
            if origin not in {f"http://{own}" for own in self._hosts}:
                return 403, f"Expected a request from the page itself, got the origin {origin!r}."
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > self._most_bytes:
            return 413, f"Expected at most {self._most_bytes} bytes: draw less at a time."
        return None


async def _body(receive: Receive, most_bytes: int) -> bytes | None:
    """Return a request's body; None where it is larger than that."""
    body, more = bytearray(), True
    while more:
        message = await receive()
        if message["type"] != "http.request":  # the browser has gone
            break
        body += message.get("body", b"")
        more = message.get("more_body", False)
        if len(body) > most_bytes:
            return None
    return bytes(body)


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Return what hands the body over once, and then what comes after it."""
    handed = False

    async def again() -> Message:
        nonlocal handed
        if handed:
            return await receive()
        handed = True
        return {"type": "http.request", "body": body, "more_body": False}

    return again
