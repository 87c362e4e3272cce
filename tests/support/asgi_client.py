"""Requests to an ASGI application without a server."""

from __future__ import annotations

import asyncio
from typing import Any, NamedTuple
from urllib.parse import unquote


class Response(NamedTuple):
    """The response of an application.

    Attributes:
        status: HTTP status, such as 200.
        headers: Values by header name, in lower case.
        body: Content in bytes.
    """

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode()


def get_response(app: Any, address: str, headers: dict[str, str] | None = None) -> Response:
    """Request an address such as `/scenario/a?frame=3`, percent-encoded as in a browser."""
    path, _, query = address.partition("?")
    encoded_headers = [(b"host", b"localhost")]
    for name, value in (headers or {}).items():
        encoded_headers.append((name.encode(), value.encode()))
    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": "GET",
        "scheme": "http",
        "path": unquote(path),
        "raw_path": path.encode(),
        "root_path": "",
        "query_string": query.encode(),
        "headers": encoded_headers,
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 80),
        "state": {},
    }
    messages: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: dict[str, Any]) -> None:
        messages.append(message)

    asyncio.run(app(scope, receive, send))

    start, *parts = messages
    response_headers = {name.decode().lower(): value.decode() for name, value in start["headers"]}
    body = b"".join(part.get("body", b"") for part in parts)
    return Response(start["status"], response_headers, body)
