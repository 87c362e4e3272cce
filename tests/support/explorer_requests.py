"""A small application behind the explorer's gate, and HTTP requests to it with full control over
the headers.
"""

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import HTTPConnection

import anyio.to_thread

from deepaccident_devkit.plugins.explore.access import App, AsgiScope, Receive, Send
from deepaccident_devkit.plugins.explore.serving import Served


class TinyApp:
    """Answer with the requested path; a few paths behave specially.

    Attributes:
        scopes: Scopes of all requests so far.
        begun: Set when a request for `/slow` arrives.
        go_on: Set by a test to let `/slow` finish.
    """

    def __init__(self) -> None:
        self.scopes: list[AsgiScope] = []
        self.begun = threading.Event()
        self.go_on = threading.Event()

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._lifespan(receive, send)
            return
        self.scopes.append(scope)
        path = scope["path"]
        headers = []
        if path == "/fail":
            raise LookupError("no such page")
        if path == "/slow":
            self.begun.set()
            await anyio.to_thread.run_sync(self.go_on.wait)
        if path == "/own":
            headers = [(b"Cache-Control", b"max-age=60"), (b"X-Frame-Options", b"DENY")]

        status = 404 if path == "/missing" else 200
        await send({"type": "http.response.start", "status": status, "headers": headers})
        if path == "/half":
            raise LookupError("no other half")
        body = b""
        if scope["method"] != "HEAD":
            body = f"{path} {scope['raw_path'].decode()}".encode()
        await send({"type": "http.response.body", "body": body})

    @staticmethod
    async def _lifespan(receive: Receive, send: Send) -> None:
        for event in ("startup", "shutdown"):
            message = await receive()
            assert message["type"] == f"lifespan.{event}"
            await send({"type": f"lifespan.{event}.complete"})


app: App = TinyApp()


@dataclass(frozen=True)
class HttpResponse:
    """A response with header names in lower case; of equal headers, the last one counts."""

    status: int
    headers: Mapping[str, str]
    body: str

    @property
    def cookie(self) -> str:
        """Return the part of the Set-Cookie header that a browser sends back."""
        return self.headers["set-cookie"].partition(";")[0]


def send_request(
    port: int,
    target: str = "/",
    *headers: tuple[str, str],
    method: str = "GET",
    host: str | None = "localhost",
) -> HttpResponse:
    """Send one request with exactly these headers, and with `Host` unless it is None."""
    connection = HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.putrequest(method, target, skip_host=True, skip_accept_encoding=True)
        if host is not None:
            connection.putheader("Host", host)
        for name, value in headers:
            connection.putheader(name, value)
        connection.endheaders()
        response = connection.getresponse()
        response_headers = {name.lower(): value for name, value in response.getheaders()}
        return HttpResponse(response.status, response_headers, response.read().decode())
    finally:
        connection.close()


def session_cookie(served: Served) -> tuple[str, str]:
    """Return the Cookie header of a browser that has opened the printed address."""
    return "Cookie", f"{served.access.cookie}={served.access.session}"
