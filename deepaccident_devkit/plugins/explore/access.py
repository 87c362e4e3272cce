"""Who may see the pages: what is checked of every request before the explorer's own pages answer it.

The server often runs on a machine that others use too, and any of them can reach its port; so can any page that is
open in the reader's browser. A token in the printed address keeps out the former. `Host`, `Origin` and
`Sec-Fetch-Site` keep out the latter: pages of other sites, and other sites' names that lead to this machine.
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

_HOST: Final = re.compile(r"([A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::([0-9]{1,5}))?")
_ROOT: Final = re.compile(r"(/[A-Za-z0-9._~!$&'()*+,=:@%-]+)*/?")
# Scheme → its own port.
_SCHEME_PORTS: Final = {"http": 80, "https": 443}
AsgiScope = MutableMapping[str, Any]
AsgiMessage = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[AsgiMessage]]
Send = Callable[[AsgiMessage], Awaitable[None]]
# An ASGI application.
App = Callable[[AsgiScope, Receive, Send], Awaitable[None]]
_log = logging.getLogger(__name__)
_LOOPBACK: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_METHODS: Final = ("GET", "HEAD")
TICKET_SECONDS: Final = 60.0
# What a relative address keeps as it is: all that cannot end it or a header.
_SAFE: Final = "!$&'()*+,;=:@/?%[]|^`{}-._~"
# Of every answer, unless the application has set another value.
HEADERS: Final[Mapping[bytes, bytes]] = {
    b"content-security-policy": b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    b"connect-src 'self'; frame-src 'self'; frame-ancestors 'self'; form-action 'self'; base-uri 'none'",
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
    """A host, in small letters and without brackets, and a port if there is one."""

    name: str
    port: int | None

    @classmethod
    def parse(cls, text: str) -> HostPort | None:
        """Read `localhost:8765`, `[::1]` and the like; None if it is malformed."""
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
        """Return it as it stands in an address."""
        name = f"[{self.name}]" if ":" in self.name else self.name
        return name if self.port is None else f"{name}:{self.port}"

    @property
    def is_address(self) -> bool:
        """Whether it is an IP address and no name."""
        try:
            ip_address(self.name)
        except ValueError:
            return False
        return True

    def is_at(self, scheme: str, other: HostPort) -> bool:
        """Whether both are the same to a scheme, whose own port can be left out."""
        usual = _SCHEME_PORTS[scheme]
        return self.name == other.name and (self.port or usual) == (other.port or usual)


@dataclass(frozen=True, slots=True)
class RootPath:
    """Where a proxy shows the pages: nowhere else, below a path, or at a whole URL.

    Attributes:
        path: `/user/me/proxy/8000`, or nothing.
        scheme: `http` or `https` of a URL.
        place: host and port of a URL.
    """

    path: str = ""
    scheme: str = ""
    place: HostPort | None = None

    @classmethod
    def parse(cls, text: str) -> RootPath:
        """Read a path or a URL. Raises ConfigError."""
        try:
            parts = urlsplit(text)
        except ValueError:  # brackets that do not match
            parts = urlsplit("?")
        place = HostPort.parse(parts.netloc)
        if place is not None and parts.scheme in _SCHEME_PORTS:
            whole = f"{parts.scheme}://{parts.netloc}{parts.path}"
        else:
            whole, place = parts.path, None
        if text != whole or not _ROOT.fullmatch(parts.path):
            raise ConfigError(
                "--root-path: expected a path such as /user/me/proxy/8000 or a URL such as "
                f"https://hub.example.org/user/me/proxy/8000, found {text!r}"
            )
        return cls(parts.path.rstrip("/"), parts.scheme, place)

    def __str__(self) -> str:
        """Return the path or the URL, without a slash at its end."""
        return self.path if self.place is None else f"{self.scheme}://{self.place}{self.path}"

    def below(self, path: str) -> str | None:
        """What of a request's path comes after this one; None if it does not begin with it, segment by segment."""
        own, given = self.path.split("/"), path.split("/")
        if not self.path or [*map(unquote, own)] != [*map(unquote, given[: len(own)])]:
            return None
        return "".join(f"/{segment}" for segment in given[len(own) :])


@dataclass(frozen=True, slots=True, kw_only=True)
class Access:
    """What a `Gate` lets in.

    Attributes:
        port: where the server listens; it only names the cookie, since a tunnel may show another port.
        root: where a proxy shows the pages.
        names: the hosts that a request may name, apart from `localhost`, `127.0.0.1` and `::1`.
        any_address: whether a request may name any IP address, as the server listens on all of the machine's.
        token: the secret of the printed address.
        session: the secret of the cookie.
    """

    port: int
    root: RootPath = field(default_factory=RootPath)
    names: frozenset[str] = frozenset()
    any_address: bool = False
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)
    session: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    @property
    def cookie(self) -> str:
        """The cookie's name."""
        return f"deepaccident_explore_{self.port}"

    def knows(self, host: HostPort) -> bool:
        """Whether a request may name this host.

        Behind a proxy of which only the path is given, it may name any: the proxy passes its own name on, which only
        the proxy knows. There the token alone keeps out names of other sites that lead to this machine.
        """
        return (
            host.name in _LOOPBACK
            or host.name in self.names
            or (self.any_address and host.is_address)
            or (self.root.place is None and bool(self.root.path))
            or (self.root.place is not None and host.name == self.root.place.name)
        )


@dataclass(frozen=True, slots=True)
class _Answer:
    """An answer of the gate itself: plain text that has nothing of the request."""

    status: int
    sentence: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)

    async def send(self, send: Send, *, head: bool) -> None:
        body = f"{self.sentence}\n".encode() if self.sentence else b""
        headers = {
            "content-type": "text/plain; charset=utf-8",
            "content-length": str(len(body)),
            **self.headers,
        }
        encoded = [(name.encode("ascii"), value.encode("ascii")) for name, value in headers.items()]
        await send({"type": "http.response.start", "status": self.status, "headers": encoded})
        await send({"type": "http.response.body", "body": b"" if head else body})


_NO_TARGET = _Answer(400, "The request has no path.")
_NO_HOST = _Answer(
    400,
    "The explorer does not know the host that the request names: start it with --root-path and the address that the "
    "browser shows, if a proxy is between them, or else with --address and that host.",
)
_METHOD = _Answer(
    405, "The explorer only shows: it answers GET and HEAD.", {"allow": ", ".join(_METHODS)}
)
_FOREIGN = _Answer(
    403, "A page of another site asked for this; open the address that the command printed."
)
_WRONG_TOKEN = _Answer(
    403,
    "The token is wrong; open the address that the command printed. Every start of it makes a new token.",
)
_NO_TOKEN = _Answer(
    401, "Open the address that the command `deepaccident explore` printed: it has the token."
)


@dataclass(frozen=True, slots=True)
class _Request:
    """What the gate looks at; the path is raw, and `kept` says whether it had the root path."""

    method: str
    asked: str
    path: str
    kept: bool
    query: str
    headers: Mapping[str, tuple[str, ...]]

    @classmethod
    def of(cls, scope: AsgiScope, root: RootPath) -> _Request:
        raw = scope.get("raw_path") or quote(scope["path"]).encode("ascii")
        asked = raw.partition(b"?")[0].decode("latin-1")
        rest = root.below(asked)
        headers: dict[str, tuple[str, ...]] = {}
        for raw_name, value in scope["headers"]:
            name = raw_name.decode("latin-1").lower()
            headers[name] = (*headers.get(name, ()), value.decode("latin-1"))
        query = scope.get("query_string", b"").decode("latin-1")
        return cls(
            scope["method"],
            asked,
            asked if rest is None else rest,
            rest is not None,
            query,
            headers,
        )

    @property
    def host(self) -> HostPort | None:
        """The host it names, if it is one."""
        given = self.headers.get("host", ())
        return HostPort.parse(given[0]) if len(given) == 1 else None

    @property
    def tokens(self) -> list[str]:
        """The values of the parameter `token`."""
        return [
            unquote_plus(part.partition("=")[2])
            for part in self.query.split("&")
            if _is_token(part)
        ]

    def without_token(self) -> _Request:
        """The same without the parameter."""
        return replace(
            self, query="&".join(part for part in self.query.split("&") if not _is_token(part))
        )

    def address(self, end: str = "") -> str:
        """Its own address and, behind it, `end`: relative, so that it is right behind all proxies."""
        address = (
            "./" + self.asked.rpartition("/")[2] + end + (f"?{self.query}" if self.query else "")
        )
        return quote(address.encode("latin-1"), safe=_SAFE)


class Gate:
    """An ASGI application before another one: it answers what is not allowed, and passes all else on.

    The other one gets paths without the root path, whether the proxy has taken it off or not, and no cookies. All
    answers, its own too, have `HEADERS`. If it fails, that is logged, and the answer is 500.

    The right token in the address is exchanged for a cookie, so that no later address has it. Cookies do not know
    ports: a browser sends ours to all servers of the same host name, such as others behind `localhost` at the end of
    tunnels, and any of them could set one of the same name. So it has a secret of its own, which opens nothing but
    this server and ends with it, and a name with the port, so that two explorers do not replace each other's. Do not
    open pages of people whom you do not trust under the same host name.
    """

    def __init__(self, app: App, access: Access) -> None:
        """Guard `app`."""
        self._app = app
        self._access = access
        self._ticket: tuple[str, float] | None = None
        self._checks = (
            self._target,
            self._host,
            self._method,
            self._origin,
            self._fetch,
            self._token,
            self._slash,
        )

    def ticket(self) -> str:
        """A token that is right once, and within a minute: other users see the command line that opens a browser."""
        ticket = secrets.token_urlsafe(32)
        self._ticket = ticket, time.monotonic() + TICKET_SECONDS
        return ticket

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        """Answer a request, or let the application do so."""
        if scope["type"] == "http":
            await self._http(scope, receive, _Sender(send))
        elif scope["type"] == "lifespan":
            await self._lifespan(scope, receive, send)
        else:
            await receive()
            await send({"type": "websocket.close", "code": 1008})

    async def _lifespan(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        try:
            await self._app(scope, receive, send)
        except Exception:
            _log.exception("the explorer's pages failed at their start or end")
            raise

    async def _http(self, scope: AsgiScope, receive: Receive, send: _Sender) -> None:
        request = _Request.of(scope, self._access.root)
        head = request.method == "HEAD"
        for check in self._checks:
            answer = check(request)
            if answer is not None:
                await answer.send(send, head=head)
                return
        path = request.path
        headers = [pair for pair in scope["headers"] if pair[0].lower() != b"cookie"]
        passed = {
            **scope,
            "path": unquote(path),
            "raw_path": path.encode("latin-1"),
            "headers": headers,
        }
        try:
            await self._app(passed, receive, send)
        except Exception:  # noqa: BLE001 - an error of ours, which the reader's terminal shows
            _log.exception("a page of the explorer failed")
            if not send.started:
                await _Answer(500, "The page failed; the terminal of the command says why.").send(
                    send, head=head
                )

    def _target(self, request: _Request) -> _Answer | None:
        return None if request.asked.startswith("/") else _NO_TARGET

    def _host(self, request: _Request) -> _Answer | None:
        host = request.host
        return None if host is not None and self._access.knows(host) else _NO_HOST

    def _method(self, request: _Request) -> _Answer | None:
        return None if request.method in _METHODS else _METHOD

    def _origin(self, request: _Request) -> _Answer | None:
        given = request.headers.get("origin")
        if given is None:
            return None
        scheme, _, rest = given[0].partition("://")
        origin = HostPort.parse(rest)
        if len(given) > 1 or scheme not in _SCHEME_PORTS or origin is None:
            return _FOREIGN
        own = (request.host, self._access.root.place)
        return (
            None
            if any(place is not None and origin.is_at(scheme, place) for place in own)
            else _FOREIGN
        )

    def _fetch(self, request: _Request) -> _Answer | None:
        """Let other sites only link to the pages. Other ports of this host are the same site, but not the reader's."""
        if request.headers.get("sec-fetch-site") in (None, ("same-origin",), ("none",)):
            return None
        followed = (request.headers.get("sec-fetch-mode"), request.headers.get("sec-fetch-dest"))
        return None if followed == (("navigate",), ("document",)) else _FOREIGN

    def _token(self, request: _Request) -> _Answer | None:
        given = request.tokens
        if not given:
            return None if self._has_cookie(request) else _NO_TOKEN
        if len(given) > 1 or not self._is_right(given[0]):
            return _WRONG_TOKEN
        return _Answer(
            303,
            headers={
                "location": request.without_token().address(),
                "set-cookie": self._set_cookie(request),
                "cache-control": "no-store",
            },
        )

    def _slash(self, request: _Request) -> _Answer | None:
        """Relative links of a page at the root path itself need a slash at its end."""
        return (
            _Answer(308, headers={"location": request.address("/")}) if request.path == "" else None
        )

    def _is_right(self, token: str) -> bool:
        ticket, until = self._ticket or ("", 0.0)
        if ticket and time.monotonic() < until and _same(token, ticket):
            self._ticket = None
            return True
        return _same(token, self._access.token)

    def _has_cookie(self, request: _Request) -> bool:
        pairs = [
            pair.strip().partition("=")
            for text in request.headers.get("cookie", ())
            for pair in text.split(";")
        ]
        return any(
            name == self._access.cookie and _same(value, self._access.session)
            for name, _, value in pairs
        )

    def _set_cookie(self, request: _Request) -> str:
        """For the root path alone, if the reader may see the pages there; without a proxy they are below `/`."""
        access, host = self._access, request.host
        direct = not request.kept and host is not None and host.name in _LOOPBACK
        path = "/" if direct else access.root.path or "/"
        behind = (
            access.root.place is not None
            and host is not None
            and host.name == access.root.place.name
        )
        secure = behind and access.root.scheme == "https"
        kept = f"{access.cookie}={access.session}; Path={path}; HttpOnly; SameSite=Lax"
        return f"{kept}; Secure" if secure else kept


class _Sender:
    """Sends an answer with `HEADERS`, and knows whether it has begun."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self.started = False

    async def __call__(self, message: AsgiMessage) -> None:
        if message["type"] == "http.response.start":
            self.started = True
            given = [*message.get("headers", ())]
            names = {name.lower() for name, _ in given}
            added = [pair for pair in HEADERS.items() if pair[0] not in names]
            message = {**message, "headers": [*given, *added]}
        await self._send(message)


def _is_token(part: str) -> bool:
    return unquote_plus(part.partition("=")[0]) == "token"


def _same(one: str, other: str) -> bool:
    return secrets.compare_digest(one.encode("utf-8", "replace"), other.encode())
