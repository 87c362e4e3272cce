"""A small application behind the explorer's gate, and requests to it that say exactly what a test
wants them to.
"""

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import HTTPConnection

import anyio.to_thread

from deepaccident_devkit.plugins.explore.access import App, AsgiScope, Receive, Send
from deepaccident_devkit.plugins.explore.serving import Served


class TinyApp:
    """Answers with the paths that it got; some paths are special. `/slow` ends when `go_on` is
    set.
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
        path, headers = scope["path"], []
        if path == "/fail":
            raise LookupError("no such page")
        if path == "/slow":
            self.begun.set()
            await anyio.to_thread.run_sync(self.go_on.wait)
        if path == "/own":
            headers = [(b"Cache-Control", b"max-age=60"), (b"X-Frame-Options", b"DENY")]
        await send(
            {
                "type": "http.response.start",
                "status": 404 if path == "/missing" else 200,
                "headers": headers,
            }
        )
        if path == "/half":
            raise LookupError("no other half")
        body = f"{path} {scope['raw_path'].decode()}".encode()
        await send(
            {"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else body}
        )

    @staticmethod
    async def _lifespan(receive: Receive, send: Send) -> None:
        for event in ("startup", "shutdown"):
            assert (await receive())["type"] == f"lifespan.{event}"
            await send({"type": f"lifespan.{event}.complete"})


app: App = TinyApp()


@dataclass(frozen=True)
class Answer:
    """What came back; names of headers are in small letters, and of several alike the last one
    counts.
    """

    status: int
    headers: Mapping[str, str]
    body: str

    @property
    def cookie(self) -> str:
        """What a browser sends back of the cookie that is set."""
        return self.headers["set-cookie"].partition(";")[0]


def ask(
    port: int,
    target: str = "/",
    *headers: tuple[str, str],
    method: str = "GET",
    host: str | None = "localhost",
) -> Answer:
    """Send one request with these headers and no others, and `Host` unless it is None."""
    connection = HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.putrequest(method, target, skip_host=True, skip_accept_encoding=True)
        for name, value in (*([] if host is None else [("Host", host)]), *headers):
            connection.putheader(name, value)
        connection.endheaders()
        response = connection.getresponse()
        found = {name.lower(): value for name, value in response.getheaders()}
        return Answer(response.status, found, response.read().decode())
    finally:
        connection.close()


def cookie_of(served: Served) -> tuple[str, str]:
    """The header of a reader who has opened the printed address."""
    return "Cookie", f"{served.access.cookie}={served.access.session}"
