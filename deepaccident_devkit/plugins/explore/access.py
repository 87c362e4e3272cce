"""Access to the pages: the checks that each request must pass before a page answers it.

The server often runs on a machine that others use too, and any of them can reach its port; so can
any page that is open in the reader's browser. A token in the printed address keeps out other users.
`Host`, `Origin` and `Sec-Fetch-Site` keep out pages of other sites, and names of other sites that
lead to this machine.
"""

from __future__ import annotations

import logging
import re
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from dataclasses import dataclass, field, replace
from ipaddress import ip_address
from typing import Any, Final
from urllib.parse import quote, unquote, unquote_plus, urlsplit

from deepaccident_devkit.errors import ConfigError

_HOST = re.compile(r"([A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::([0-9]{1,5}))?")
_ROOT = re.compile(r"(/[A-Za-z0-9._~!$&'()*+,=:@%-]+)*/?")
# Default port of each scheme.
_SCHEME_PORTS = {"http": 80, "https": 443}
AsgiScope = MutableMapping[str, Any]
AsgiMessage = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[AsgiMessage]]
Send = Callable[[AsgiMessage], Awaitable[None]]
# An ASGI application.
App = Callable[[AsgiScope, Receive, Send], Awaitable[None]]
_log = logging.getLogger(__name__)
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_METHODS = ("GET", "HEAD")
TICKET_SECONDS: Final = 60.0
# Characters that need no quoting in a relative address, since none of them can end it or a header.
_SAFE_CHARACTERS = "!$&'()*+,;=:@/?%[]|^`{}-._~"
# Headers of every answer, unless the application has set another value.
HEADERS: Final[Mapping[bytes, bytes]] = {
    b"content-security-policy": b"default-src 'none'; script-src 'self'; style-src 'self'; "
    b"img-src 'self' data:; connect-src 'self'; frame-src 'self'; frame-ancestors 'self'; "
    b"form-action 'self'; base-uri 'none'",
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"cross-origin-opener-policy": b"same-origin",
    b"x-frame-options": b"SAMEORIGIN",
    b"permissions-policy": b"camera=(), microphone=(), geolocation=()",
    b"cache-control": b"no-store",
}


@dataclass(frozen=True, slots=True)
class HostPort:
    """A host, in small letters and without brackets, and its port if there is one."""

    name: str
    port: int | None

    @classmethod
    def parse(cls, text: str) -> HostPort | None:
        """Parse a text such as `localhost:8765` or `[::1]`; return None if it is malformed."""
        match = _HOST.fullmatch(text)
        if match is None or int(match[2] or 0) > 0xFFFF:
            return None
        name = match[1].lower()
        if name.startswith("["):
            try:
                name = str(ip_address(name[1:-1]))
            except ValueError:
                return None
        return cls(name, int(match[2]) if match[2] else None)

    def __str__(self) -> str:
        """Return the host and the port as written in an address."""
        name = self.name
        if ":" in self.name:
            name = f"[{self.name}]"
        if self.port is None:
            return name
        return f"{name}:{self.port}"

    @property
    def is_address(self) -> bool:
        """Whether the host is an IP address instead of a name."""
        try:
            ip_address(self.name)
        except ValueError:
            return False
        return True

    def is_same(self, scheme: str, other: HostPort) -> bool:
        """Return whether both are equal under a scheme, whose default port may be left out."""
        default_port = _SCHEME_PORTS[scheme]
        own_port = self.port or default_port
        other_port = other.port or default_port
        return self.name == other.name and own_port == other_port


@dataclass(frozen=True, slots=True)
class RootPath:
    """Where a proxy shows the pages: at the root, below a path, or at a complete URL.

    Attributes:
        path: Path, such as `/user/me/proxy/8000`; empty for the root.
        scheme: Scheme of a URL, `http` or `https`; empty for a path.
        location: Host and port of a URL; None for a path.
    """

    path: str = ""
    scheme: str = ""
    location: HostPort | None = None

    @classmethod
    def parse(cls, text: str) -> RootPath:
        """Parse a path or a URL; raise ConfigError for any other text."""
        try:
            parts = urlsplit(text)
        except ValueError:  # The brackets do not match.
            parts = urlsplit("?")
        address = parts.path
        location = None
        if parts.scheme in _SCHEME_PORTS:
            location = HostPort.parse(parts.netloc)
        if location is not None:
            address = f"{parts.scheme}://{parts.netloc}{parts.path}"
        if text != address or not _ROOT.fullmatch(parts.path):
            raise ConfigError(
                "--root-path: expected a path such as /user/me/proxy/8000 or a URL such as "
                f"https://hub.example.org/user/me/proxy/8000, found {text!r}"
            )
        return cls(parts.path.rstrip("/"), parts.scheme, location)

    def __str__(self) -> str:
        """Return the path or the URL, without a slash at the end."""
        if self.location is None:
            return self.path
        return f"{self.scheme}://{self.location}{self.path}"

    def remove_from(self, path: str) -> str | None:
        """Return the part of a request's path that follows this path.

        Return None if the request's path does not begin with this one, segment by segment.
        """
        own_segments = self.path.split("/")
        segments = path.split("/")
        first_segments = segments[: len(own_segments)]
        is_below = list(map(unquote, own_segments)) == list(map(unquote, first_segments))
        if not self.path or not is_below:
            return None
        return "".join(f"/{segment}" for segment in segments[len(own_segments) :])


@dataclass(frozen=True, slots=True, kw_only=True)
class Access:
    """The requests that a `Gate` lets in.

    Attributes:
        port: Port of the server. It is only used in the cookie's name, since browsers may see
            another port through a tunnel.
        root: Where a proxy shows the pages.
        names: Hosts that a request may name, apart from `localhost`, `127.0.0.1` and `::1`.
        any_address: Whether a request may name any IP address, because the server listens on all
            addresses of the machine.
        token: Secret of the printed address.
        session: Secret of the cookie.
    """

    port: int
    root: RootPath = field(default_factory=RootPath)
    names: frozenset[str] = frozenset()
    any_address: bool = False
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)
    session: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    @property
    def cookie(self) -> str:
        """Name of the cookie."""
        return f"deepaccident_explore_{self.port}"

    def knows(self, host: HostPort) -> bool:
        """Return whether a request may name this host.

        If the root is only the path of a proxy, any host is allowed, since the proxy passes on its
        own host name, which this server does not know. In that case, only the token keeps out other
        sites' host names that resolve to this machine.
        """
        location = self.root.location
        if location is None and self.root.path:
            return True
        is_proxy = location is not None and host.name == location.name
        is_address = self.any_address and host.is_address
        return host.name in _LOOPBACK or host.name in self.names or is_address or is_proxy


@dataclass(frozen=True, slots=True)
class _Answer:
    """An answer of the gate itself, in plain text that repeats nothing from the request."""

    status: int
    sentence: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)

    async def send(self, send: Send, *, head: bool) -> None:
        body = b""
        if self.sentence:
            body = f"{self.sentence}\n".encode()
        headers = {
            "content-type": "text/plain; charset=utf-8",
            "content-length": str(len(body)),
            **self.headers,
        }
        encoded = [(name.encode("ascii"), value.encode("ascii")) for name, value in headers.items()]
        await send({"type": "http.response.start", "status": self.status, "headers": encoded})
        await send({"type": "http.response.body", "body": b"" if head else body})


_PATH_MISSING = _Answer(400, "The request has no path.")
_HOST_UNKNOWN = _Answer(
    400,
    "The explorer does not know the host in the request. Behind a proxy, start the explorer "
    "with --root-path and the address that the browser shows; otherwise start it with --address "
    "and that host.",
)
_METHOD_NOT_ALLOWED = _Answer(
    405, "The explorer is read-only: it answers only GET and HEAD.", {"allow": ", ".join(_METHODS)}
)
_FOREIGN_PAGE = _Answer(
    403, "This request came from a page of another site; open the address that the command printed."
)
_TOKEN_WRONG = _Answer(
    403,
    "The token is wrong; open the address that the command printed. Each start of the explorer "
    "creates a new token.",
)
_TOKEN_MISSING = _Answer(
    401, "Open the address that `deepaccident explore` printed; it contains the token."
)


@dataclass(frozen=True, slots=True)
class _Request:
    """The parts of a request that the gate checks; paths are raw.

    Attributes:
        method: HTTP method.
        target: Path of the request.
        path: Path of the request without the root path.
        has_root: Whether the request had the root path.
        query: Parameters of the address.
        headers: Values of each header, by name in lower case.
    """

    method: str
    target: str
    path: str
    has_root: bool
    query: str
    headers: Mapping[str, tuple[str, ...]]

    @classmethod
    def of(cls, scope: AsgiScope, root: RootPath) -> _Request:
        raw_path = scope.get("raw_path") or quote(scope["path"]).encode("ascii")
        target = raw_path.partition(b"?")[0].decode("latin-1")
        path = root.remove_from(target)
        headers: dict[str, tuple[str, ...]] = {}
        for raw_name, value in scope["headers"]:
            name = raw_name.decode("latin-1").lower()
            headers[name] = (*headers.get(name, ()), value.decode("latin-1"))
        return cls(
            method=scope["method"],
            target=target,
            path=target if path is None else path,
            has_root=path is not None,
            query=scope.get("query_string", b"").decode("latin-1"),
            headers=headers,
        )

    @property
    def host(self) -> HostPort | None:
        """The host that the request names; None if it names none or several."""
        values = self.headers.get("host", ())
        if len(values) == 1:
            return HostPort.parse(values[0])
        return None

    @property
    def tokens(self) -> list[str]:
        """Values of the parameter `token`."""
        tokens = []
        for part in self.query.split("&"):
            if _is_token_parameter(part):
                tokens.append(unquote_plus(part.partition("=")[2]))
        return tokens

    def without_token(self) -> _Request:
        """Return the request without the parameter `token`."""
        parts = [part for part in self.query.split("&") if not _is_token_parameter(part)]
        return replace(self, query="&".join(parts))

    def address(self, end: str = "") -> str:
        """Return the address of the request, with `end` after its path.

        It is relative, so that it is right behind any proxy.
        """
        query = ""
        if self.query:
            query = f"?{self.query}"
        page = self.target.rpartition("/")[2]
        address = f"./{page}{end}{query}"
        return quote(address.encode("latin-1"), safe=_SAFE_CHARACTERS)


class Gate:
    """An ASGI application in front of another one, which refuses forbidden requests.

    It passes all other requests on without cookies, and without the root path, whether or not the
    proxy has already removed that. All answers have `HEADERS`, including the gate's own answers.
    If the application fails, the error is logged, and the answer is 500.

    The right token in the address is exchanged for a cookie, so that no later address contains it.
    Cookies are not bound to a port: a browser sends ours to all servers with the same host name,
    such as other tunnels' `localhost`, and any of them could set a cookie with the same name. The
    cookie therefore has its own secret, which is valid only for this server and while it runs.
    Its name contains the port, so that two explorers do not overwrite each other's cookie. Do not
    open pages of people that you do not trust under the same host name.
    """

    def __init__(self, app: App, access: Access) -> None:
        """Guard an application with the checks of `access`."""
        self._app = app
        self._access = access
        self._ticket: tuple[str, float] | None = None
        self._checks = (
            self._check_address,
            self._check_origin,
            self._check_fetch,
            self._check_token,
            self._check_slash,
        )

    def ticket(self) -> str:
        """Return a token that is valid only once, within a minute.

        It is needed because other users can see the command line that opens a browser.
        """
        ticket = secrets.token_urlsafe(32)
        self._ticket = ticket, time.monotonic() + TICKET_SECONDS
        return ticket

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        """Answer a request, or let the application answer it."""
        if scope["type"] == "http":
            await self._answer_request(scope, receive, _Sender(send))
        elif scope["type"] == "lifespan":
            await self._serve_lifespan(scope, receive, send)
        else:
            await receive()
            await send({"type": "websocket.close", "code": 1008})

    async def _serve_lifespan(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        try:
            await self._app(scope, receive, send)
        except Exception:
            _log.exception("the explorer failed while it started or stopped")
            raise

    async def _answer_request(self, scope: AsgiScope, receive: Receive, send: _Sender) -> None:
        request = _Request.of(scope, self._access.root)
        head = request.method == "HEAD"
        for check in self._checks:
            answer = check(request)
            if answer is not None:
                await answer.send(send, head=head)
                return
        path = request.path
        headers = [pair for pair in scope["headers"] if pair[0].lower() != b"cookie"]
        inner_scope = {
            **scope,
            "path": unquote(path),
            "raw_path": path.encode("latin-1"),
            "headers": headers,
        }
        try:
            await self._app(inner_scope, receive, send)
        except Exception:  # noqa: BLE001 - our own error, which the reader's terminal shows
            _log.exception("a page of the explorer failed")
            if not send.started:
                failure = _Answer(500, "The page failed; the terminal of the command says why.")
                await failure.send(send, head=head)

    def _check_address(self, request: _Request) -> _Answer | None:
        """Check the path, the host and the method of a request."""
        if not request.target.startswith("/"):
            return _PATH_MISSING
        host = request.host
        if host is None or not self._access.knows(host):
            return _HOST_UNKNOWN
        if request.method not in _METHODS:
            return _METHOD_NOT_ALLOWED
        return None

    def _check_origin(self, request: _Request) -> _Answer | None:
        values = request.headers.get("origin")
        if values is None:
            return None
        scheme, _, host = values[0].partition("://")
        origin = HostPort.parse(host)
        if len(values) > 1 or scheme not in _SCHEME_PORTS or origin is None:
            return _FOREIGN_PAGE
        for own_host in (request.host, self._access.root.location):
            if own_host is not None and origin.is_same(scheme, own_host):
                return None
        return _FOREIGN_PAGE

    def _check_fetch(self, request: _Request) -> _Answer | None:
        """Refuse requests from other sites, except links to the pages.

        Other ports of this host belong to the same site, but may be other users' pages.
        """
        headers = request.headers
        if headers.get("sec-fetch-site") in (None, ("same-origin",), ("none",)):
            return None
        is_navigation = headers.get("sec-fetch-mode") == ("navigate",)
        if is_navigation and headers.get("sec-fetch-dest") == ("document",):
            return None
        return _FOREIGN_PAGE

    def _check_token(self, request: _Request) -> _Answer | None:
        tokens = request.tokens
        if not tokens:
            if self._has_cookie(request):
                return None
            return _TOKEN_MISSING
        if len(tokens) > 1 or not self._is_right(tokens[0]):
            return _TOKEN_WRONG
        return _Answer(
            303,
            headers={
                "location": request.without_token().address(),
                "set-cookie": self._format_cookie(request),
                "cache-control": "no-store",
            },
        )

    def _check_slash(self, request: _Request) -> _Answer | None:
        """Add a slash to the root path, since the relative links of its page need it."""
        if request.path:
            return None
        return _Answer(308, headers={"location": request.address("/")})

    def _is_right(self, token: str) -> bool:
        ticket, expiry = self._ticket or ("", 0.0)
        if ticket and time.monotonic() < expiry and _is_same_secret(token, ticket):
            self._ticket = None
            return True
        return _is_same_secret(token, self._access.token)

    def _has_cookie(self, request: _Request) -> bool:
        for header in request.headers.get("cookie", ()):
            for pair in header.split(";"):
                name, _, value = pair.strip().partition("=")
                is_our_cookie = name == self._access.cookie
                if is_our_cookie and _is_same_secret(value, self._access.session):
                    return True
        return False

    def _format_cookie(self, request: _Request) -> str:
        """Return the cookie for the root path if the reader may see the pages there.

        Without a proxy, the pages are below `/`.
        """
        access = self._access
        root = access.root
        host_name = ""
        if request.host is not None:
            host_name = request.host.name
        is_direct = not request.has_root and host_name in _LOOPBACK
        path = "/" if is_direct else root.path or "/"
        cookie = f"{access.cookie}={access.session}; Path={path}; HttpOnly; SameSite=Lax"
        is_behind_proxy = root.location is not None and host_name == root.location.name
        if is_behind_proxy and root.scheme == "https":
            return f"{cookie}; Secure"
        return cookie


class _Sender:
    """A function that sends an answer with `HEADERS` and knows whether the answer has begun."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self.started = False

    async def __call__(self, message: AsgiMessage) -> None:
        if message["type"] == "http.response.start":
            self.started = True
            headers = [*message.get("headers", ())]
            names = {name.lower() for name, _ in headers}
            defaults = [(name, value) for name, value in HEADERS.items() if name not in names]
            message = {**message, "headers": [*headers, *defaults]}
        await self._send(message)


def _is_token_parameter(part: str) -> bool:
    name = part.partition("=")[0]
    return unquote_plus(name) == "token"


def _is_same_secret(text: str, secret: str) -> bool:
    content = text.encode("utf-8", "replace")
    return secrets.compare_digest(content, secret.encode())
