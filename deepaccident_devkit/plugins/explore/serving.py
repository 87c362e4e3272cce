"""Run the pages: a server on a port of this machine, in a thread of its own, behind a `Gate`."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any, Final

from deepaccident_devkit.errors import ConfigError, MissingExtraError
from deepaccident_devkit.plugins.explore.access import Access, App, Gate, HostPort, RootPath

LOOPBACK: Final = "127.0.0.1"
_NEEDED: Final = ("starlette", "uvicorn")
# Tried first; then the machine chooses one.
PORTS: Final = range(8765, 8785)
_LAST_PORT: Final = 0xFFFF
# Time in which a connection must bring a whole request.
_REQUEST_SECONDS: Final = 10.0
# With more of them, those that have brought no whole request by the next look are closed.
_MOST_CONNECTIONS: Final = 200
# Between two looks at all connections.
_SWEEP_SECONDS: Final = 0.1
# Time for answers that are being made when the server stops; then they are left to their threads.
_STOP_SECONDS: Final = 0.7
_EXPOSED: Final = (
    "warning: anyone who can reach this machine can try to open the pages, and anyone who has the address with the "
    "token sees the release. Nothing is encrypted: prefer an SSH tunnel, which needs no --address."
)


def need_extra() -> None:
    """Raise MissingExtraError unless the extra `explore` is installed."""
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        raise MissingExtraError(
            f"the explorer needs {', '.join(missing)}; in a checkout: pip install '.[explore]'"
        )


def serve(
    app: App,
    *,
    host: str = LOOPBACK,
    port: int | None = None,
    root_path: str = "",
    page: str = "",
    open_browser: bool = True,
    say: Callable[[str], object],
) -> None:
    """Show the pages on a host and port of this machine until an exception, such as that of Ctrl-C, ends it.

    The port is by default the first free one from 8765 on; the root path is the path or URL at which a proxy shows the
    pages; the addresses lead to a `page`, by default the first. A browser is opened if there is a display and no proxy;
    `say` gets the addresses, line by line. Raises MissingExtraError, and ConfigError if the server cannot listen there
    or the root path is neither.
    """
    with serving(app, host=host, port=port, root_path=root_path, page=page) as served:
        for line in served.lines():
            say(line)
        if open_browser and not root_path and _is_display_likely(os.environ):
            served.open_browser()
        served.wait()


@contextmanager
def serving(
    app: App, *, host: str = LOOPBACK, port: int | None = None, root_path: str = "", page: str = ""
) -> Iterator[Served]:
    """As `serve`, but the pages are shown while the block runs; port 0 is any free one."""
    need_extra()
    host = host.removeprefix("[").removesuffix("]")
    root = RootPath.parse(root_path)
    listening = _listen(host, port)
    address, number = listening.getsockname()[:2]
    bound = ip_address(address)
    access = Access(
        port=number, root=root, names=_names(host, bound), any_address=bound.is_unspecified
    )
    gate = Gate(app, access)
    running = _Running(gate, listening)
    try:
        running.start()
        yield Served(host, bound, access, gate, running, page)
    finally:
        running.stop()


@dataclass(frozen=True, slots=True)
class Served:
    """Where the pages are shown.

    Attributes:
        host: name or address that was asked for.
        bound: address on which the server listens.
        access: what is let in.
        page: to which the addresses lead.
    """

    host: str
    bound: IPv4Address | IPv6Address
    access: Access
    _gate: Gate = field(repr=False)
    _running: _Running = field(repr=False)
    page: str = ""

    @property
    def port(self) -> int:
        """Where the server listens."""
        return self.access.port

    @property
    def token(self) -> str:
        """The secret that opens the pages."""
        return self.access.token

    @property
    def origin(self) -> str:
        """The address of the server, as this machine sees it, without a path."""
        if self.bound.is_unspecified:
            return _origin(LOOPBACK if self.bound.version == 4 else "::1", self.port)
        return _origin(str(self.bound) if self.bound.is_loopback else self.host, self.port)

    @property
    def url(self) -> str:
        """The address that opens the pages."""
        return f"{self.origin}/{self.page}?token={self.token}"

    def lines(self) -> list[str]:
        """All addresses for the reader, and what to know about them."""
        here, query = socket.gethostname(), f"/{self.page}?token={self.token}"
        lines = [] if self.bound.is_loopback else [_EXPOSED]
        lines.append(f"the explorer runs until Ctrl-C; open {self.url}")
        if self.bound.is_unspecified:
            lines.append(f"on other machines: {_origin(here, self.port)}{query}")
        root = self.access.root
        if root.place is not None:
            lines.append(f"behind the proxy: {root}{query}")
        elif root.path:
            lines.append(f"on your notebook server or portal: {root}{query}")
        inner = "localhost" if self.bound.is_loopback or self.bound.is_unspecified else self.host
        tunnel = f"ssh -L {self.port}:{HostPort(inner, None)}:{self.port} {here}"
        lines.append(
            f"from another machine: {tunnel}, and there {_origin('localhost', self.port)}{query}"
        )
        return lines

    def open_browser(self) -> None:
        """Open the pages in a browser, as far as there is one; the token is not in its command line."""
        threading.Thread(
            target=_open,
            args=(f"{self.origin}/{self.page}?token={self._gate.ticket()}",),
            name="browser",
            daemon=True,
        ).start()

    def wait(self) -> None:
        """Wait until the server ends, which it does not do by itself."""
        self._running.wait()


class _Running:
    """A server in a thread. Whatever it does, neither it nor the threads that it starts keep the process."""

    def __init__(self, app: App, listening: socket.socket) -> None:
        import uvicorn

        self._listening = listening
        self._ended = threading.Event()
        self._failure: BaseException | None = None
        # all by name: by default it takes what else is installed
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                http="h11",
                loop="asyncio",
                ws="none",
                lifespan="on",
                log_config=None,
                log_level="critical",  # what anyone may send is no news, and the gate logs what fails
                access_log=False,
                proxy_headers=False,
                server_header=False,
                timeout_graceful_shutdown=1,  # a whole number; nobody waits for its end
            )
        )

    def start(self) -> None:
        """Return when it answers."""
        threading.Thread(target=self._run, name="explorer", daemon=True).start()
        while not self._server.started:
            if self._ended.wait(0.005):
                raise RuntimeError("the explorer's server did not start") from self._failure

    def wait(self) -> None:
        """Until it ends; unlike a thread's `join`, an event's `wait` can be interrupted."""
        self._ended.wait()
        if self._failure is not None:
            raise RuntimeError("the explorer's server failed") from self._failure

    def stop(self) -> None:
        """End it, and free its port, within a second."""
        self._server.should_exit = True
        self._ended.wait(_STOP_SECONDS)
        self._listening.close()

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as failure:  # noqa: BLE001 - raised in the main thread
            self._failure = failure
        finally:
            self._ended.set()

    async def _serve(self) -> None:
        closing = asyncio.create_task(self._close_unasking())
        await self._server.serve(sockets=[self._listening])
        closing.cancel()
        for connection in [*self._server.server_state.connections]:  # to readers who take nothing
            connection.transport.abort()

    async def _close_unasking(self) -> None:
        """Close each connection that brings no whole request in time, and of too many all that wait for one."""
        from h11 import IDLE, SEND_BODY

        connections: Any = self._server.server_state.connections
        looks: dict[Any, int] = {}
        while True:
            await asyncio.sleep(_SWEEP_SECONDS)
            waiting = [
                (each, each.cycle)
                for each in connections
                if each.conn.their_state in (IDLE, SEND_BODY)
            ]
            looks = {key: looks.get(key, 0) + 1 for key in waiting}
            most = 1 if len(connections) > _MOST_CONNECTIONS else _REQUEST_SECONDS / _SWEEP_SECONDS
            for (connection, _), count in looks.items():
                if count > most:
                    connection.transport.abort()


class _TakenError(ConfigError):
    """Another program listens there."""


def _listen(host: str, port: int | None) -> socket.socket:
    """A socket that listens. Raises ConfigError."""
    if not host:
        raise ConfigError("host: expected a name or an address of this machine, found nothing")
    if port is not None and not 0 <= port <= _LAST_PORT:
        raise ConfigError(f"port: expected a number up to {_LAST_PORT}, found {port}")
    for candidate in PORTS if port is None else ():
        with suppress(_TakenError):
            return _listener(host, candidate)
    return _listener(host, port or 0)


def _listener(host: str, port: int) -> socket.socket:
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        family, _, _, _, address = min(found, key=lambda each: each[0] != socket.AF_INET)
        return socket.create_server(
            address, family=family, dualstack_ipv6=family == socket.AF_INET6
        )
    except PermissionError as error:
        raise ConfigError(f"port {port}: not allowed here; choose a port from 1024 on") from error
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise _TakenError(
                f"port {port}: another program listens there; choose another port (--address), or leave it out"
            ) from error
        raise ConfigError(
            f"host {host}: cannot listen there ({error}); give a name or an address of this machine (--address), or "
            "leave it out"
        ) from error


def _names(host: str, bound: IPv4Address | IPv6Address) -> frozenset[str]:
    """The hosts that a request may name: if other machines reach it, all names of this one."""
    names = {host, str(bound)}
    if not bound.is_loopback:
        name = socket.gethostname()
        names |= {name, name.partition(".")[0], socket.getfqdn()}
    return frozenset(name.lower() for name in names)


def _origin(host: str, port: int) -> str:
    return f"http://{HostPort(host, port)}"


def _is_display_likely(environment: Mapping[str, str]) -> bool:
    """Whether a browser would open where the reader sits: not at the far end of SSH, unless one is named."""
    if "BROWSER" in environment:
        return True
    if "SSH_CONNECTION" in environment:
        return False
    return sys.platform == "darwin" or "DISPLAY" in environment or "WAYLAND_DISPLAY" in environment


def _open(url: str) -> None:
    with suppress(webbrowser.Error, OSError, ValueError):
        webbrowser.open(url)
