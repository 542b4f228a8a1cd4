"""The guard of the service: it checks token, host, page and size of each request."""

import asyncio
import errno
import logging
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ...api.photo_reader import describe_failure
from ...system.errors import ResourceError, printable
from .access import LOOPBACK, Access

LOG = logging.getLogger(__name__)
RETRY = {"Retry-After": "2"}
SHORTAGE = (OSError, MemoryError, ResourceError)
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
COOKIE = "piccolo_token"
OPEN = ("/health", "/enter")  # paths that need no token
# [s] for which the rest of a refused body is read before the connection is closed: a client that is still
# sending would miss the answer. On a connection that stays open uvicorn reads the rest itself
DROP_S = 10.0
SECURITY = {
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Body:
    """The body of a request, read up to a limit."""

    def __init__(self, receive: Receive, max_bytes: int) -> None:
        self._receive = receive
        self._max_bytes = max_bytes
        self._num_bytes = 0
        self._is_whole = False

    async def receive(self) -> Message:
        """Return the next part. Raise HTTPException if the body is larger than the limit."""
        message = await self._next()
        if self._num_bytes > self._max_bytes:
            raise too_large(self._max_bytes)
        return message

    async def drop_rest(self) -> None:
        """Read the rest of a refused body, for DROP_S at most."""
        try:
            async with asyncio.timeout(DROP_S):
                while not self._is_whole:
                    await self._next()
        except TimeoutError:
            self._is_whole = True

    async def _next(self) -> Message:
        message = await self._receive()
        self._num_bytes += len(message.get("body", b""))
        self._is_whole = self._is_whole or not message.get("more_body", False)
        return message


class Guard:
    """A middleware that passes permitted requests on to an application."""

    def __init__(self, app: ASGIApp, max_bytes: int, access: Access) -> None:
        self.app = app
        self.max_bytes = max_bytes
        self.access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it with a line of JSON."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        scope["path"] = self.without_prefix(scope["path"])
        body = Body(receive, self.max_bytes)
        headers = Headers(scope=scope)

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                if headers.get("connection", "").lower() == "close":
                    await body.drop_rest()
                MutableHeaders(scope=message).update(SECURITY)
            await send(message)

        try:
            self.check(scope, headers)
        except HTTPException as error:
            await answer_refusal(error)(scope, body.receive, answer)
            return
        await self.app(scope, body.receive, answer)

    def without_prefix(self, path: str) -> str:
        """Return a path without the page's own path before it, which some proxies leave in."""
        prefix = self.access.path.rstrip("/")
        return path.removeprefix(prefix) if path.startswith(f"{prefix}/") else path

    def check(self, scope: Scope, headers: Headers) -> None:
        """Raise HTTPException for a request with a foreign host or page, without the token, or too large."""
        token = self.access.token
        self.check_addresses(headers.get("host", ""), headers.get("origin"))
        if token is not None and scope["path"] not in OPEN and not knows_token(scope, headers, token):
            found = "found no token, or another: open the address that the service printed"
            raise HTTPException(401, found, {"WWW-Authenticate": "Bearer"})
        if int(headers.get("content-length", "0")) > self.max_bytes:
            raise too_large(self.max_bytes)

    def check_addresses(self, host: str, origin: str | None) -> None:
        """Raise HTTPException for a host or an origin that is not this service's."""
        try:
            name = urlsplit(f"//{host}").hostname
            page = host if origin is None else urlsplit(origin).netloc
        except ValueError:
            raise HTTPException(403, "found no name of a host") from None
        if self.access.token is None and name not in LOOPBACK:
            found = f"found the host {host[:80]!r}, wanted localhost"
            raise HTTPException(403, f"{found}; behind a proxy the service needs `public_url`")
        own = (host, urlsplit(self.access.public_url or "").netloc)
        if page not in own and origin not in self.access.origins:
            found = f"found a page of {printable(origin or '')[:80]}, wanted one of this service"
            advice = "it needs `public_url` behind a proxy, `allow_origin` for other sites' pages"
            raise HTTPException(403, f"{found}; {advice}")


def knows_token(scope: Scope, headers: Headers, token: str) -> bool:
    """Return True if a request has the token, as a bearer token or in the page's cookie."""
    scheme, _, bearer = headers.get("authorization", "").partition(" ")
    sent_token = bearer if scheme.lower() == "bearer" else Request(scope).cookies.get(COOKIE, "")
    return secrets.compare_digest(sent_token.encode(), token.encode())


def too_large(max_bytes: int) -> HTTPException:
    """Return the refusal of a body that is too large."""
    return HTTPException(413, f"found a larger body, wanted at most {max_bytes} bytes")


def refusal_of(error: Exception) -> HTTPException:
    """Return the refusal for an error of SHORTAGE, a lack of disk, memory or files, and log a line.

    Its status is 507 for a full disk, else 503.
    """
    LOG.error("a request could not be answered: %s", printable(describe_failure(error)))
    cause = error.__cause__ if isinstance(error, ResourceError) else error
    reason = os.strerror(cause.errno or 0) if isinstance(cause, OSError) else "not enough memory"
    if isinstance(cause, OSError) and cause.errno in NO_ROOM:
        return HTTPException(507, f"found no room on the disk of the service ({reason}), wanted some")
    return HTTPException(503, f"found too little of what the service needs ({reason}), try again", RETRY)


@contextmanager
def refusing_shortage() -> Iterator[None]:
    """Turn errors of SHORTAGE in the block into an HTTPException."""
    try:
        yield
    except SHORTAGE as error:
        raise refusal_of(error) from error


def answer_refusal(error: HTTPException) -> JSONResponse:
    """Return the response to a refused request: the refusal's text as JSON, in one line."""
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)
