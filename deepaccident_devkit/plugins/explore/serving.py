"""Run the pages: a server on a port of this machine, in its own thread, behind a `Gate`."""

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
_EXTRA_PACKAGES: Final = ("starlette", "uvicorn")
# Ports that are tried before the machine chooses one.
PORTS: Final = range(8765, 8785)
_MAX_PORT: Final = 0xFFFF
# Time in which a connection must send a complete request.
_REQUEST_SECONDS: Final = 10.0
# Number of connections above which all that have sent no complete request by the next sweep are
# closed.
_MAX_CONNECTIONS: Final = 200
# Time between two sweeps over all connections.
_SWEEP_SECONDS: Final = 0.1
# Time for unfinished answers when the server stops; after it they are left to their threads.
_STOP_SECONDS: Final = 0.7
_EXPOSURE_WARNING: Final = (
    "warning: anyone who can reach this machine can try to open the pages, and anyone who has the "
    "address with the token sees the release. Nothing is encrypted: prefer an SSH tunnel, which "
    "needs no --address."
)


def need_extra() -> None:
    """Raise MissingExtraError unless the extra `explore` is installed."""
    missing = [name for name in _EXTRA_PACKAGES if find_spec(name) is None]
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
    """Show the pages on a host and port of this machine until an exception, such as of Ctrl-C.

    A browser is opened if there is a display and no proxy.

    Args:
        app: Application that answers requests.
        host: Host to listen on.
        port: Port to listen on; by default the first free one from 8765 on.
        root_path: Path or URL at which a proxy shows the pages.
        page: Page that the addresses lead to; by default the first.
        open_browser: Whether to open a browser.
        say: Function that gets the addresses, line by line.

    Raises:
        MissingExtraError: The extra `explore` is not installed.
        ConfigError: The server cannot listen there, or the root path is neither a path nor a URL.
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
    """Show the pages as `serve` does, but only while the block runs; port 0 is any free one."""
    need_extra()
    host = host.removeprefix("[").removesuffix("]")
    root = RootPath.parse(root_path)
    listener = _listen(host, port)
    address, port_number = listener.getsockname()[:2]
    bound = ip_address(address)
    access = Access(
        port=port_number, root=root, names=_names(host, bound), any_address=bound.is_unspecified
    )
    gate = Gate(app, access)
    running = _Running(gate, listener)
    try:
        running.start()
        yield Served(host, bound, access, gate, running, page)
    finally:
        running.stop()


@dataclass(frozen=True, slots=True)
class Served:
    """A running server of the pages.

    Attributes:
        host: Name or address that was requested.
        bound: Address on which the server listens.
        access: What is let in.
        page: Page that the addresses lead to.
    """

    host: str
    bound: IPv4Address | IPv6Address
    access: Access
    _gate: Gate = field(repr=False)
    _running: _Running = field(repr=False)
    page: str = ""

    @property
    def port(self) -> int:
        """Port on which the server listens."""
        return self.access.port

    @property
    def token(self) -> str:
        """Secret that opens the pages."""
        return self.access.token

    @property
    def origin(self) -> str:
        """Address of the server, as this machine sees it, without a path."""
        if self.bound.is_unspecified:
            return _origin(LOOPBACK if self.bound.version == 4 else "::1", self.port)
        return _origin(str(self.bound) if self.bound.is_loopback else self.host, self.port)

    @property
    def url(self) -> str:
        """Address that opens the pages."""
        return f"{self.origin}/{self.page}?token={self.token}"

    def lines(self) -> list[str]:
        """Return all addresses for the reader, and notes about them."""
        machine, query = socket.gethostname(), f"/{self.page}?token={self.token}"
        lines = [] if self.bound.is_loopback else [_EXPOSURE_WARNING]
        lines.append(f"the explorer runs until Ctrl-C; open {self.url}")
        if self.bound.is_unspecified:
            lines.append(f"on other machines: {_origin(machine, self.port)}{query}")
        root = self.access.root
        if root.location is not None:
            lines.append(f"behind the proxy: {root}{query}")
        elif root.path:
            lines.append(f"on your notebook server or portal: {root}{query}")
        inner = "localhost" if self.bound.is_loopback or self.bound.is_unspecified else self.host
        tunnel = f"ssh -L {self.port}:{HostPort(inner, None)}:{self.port} {machine}"
        local_address = f"{_origin('localhost', self.port)}{query}"
        lines.append(f"from another machine: {tunnel}, and there {local_address}")
        return lines

    def open_browser(self) -> None:
        """Open the pages in a browser, if there is one; its command line lacks the token."""
        url = f"{self.origin}/{self.page}?token={self._gate.ticket()}"
        threading.Thread(target=_open, args=(url,), name="browser", daemon=True).start()

    def wait(self) -> None:
        """Wait until the server ends, which it does not do by itself."""
        self._running.wait()


class _Running:
    """A server in a thread.

    Neither it nor the threads that it starts keep the process alive.
    """

    def __init__(self, app: App, listener: socket.socket) -> None:
        import uvicorn

        self._listener = listener
        self._ended = threading.Event()
        self._failure: BaseException | None = None
        # Everything is named explicitly: by default uvicorn uses whatever is installed.
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                http="h11",
                loop="asyncio",
                ws="none",
                lifespan="on",
                log_config=None,
                # The gate logs failures; bad requests, which anyone may send, are no news.
                log_level="critical",
                access_log=False,
                proxy_headers=False,
                server_header=False,
                timeout_graceful_shutdown=1,  # a whole number; nobody waits for its end
            )
        )

    def start(self) -> None:
        """Start the server, and return when it answers."""
        threading.Thread(target=self._run, name="explorer", daemon=True).start()
        while not self._server.started:
            if self._ended.wait(0.005):
                raise RuntimeError("the explorer's server did not start") from self._failure

    def wait(self) -> None:
        """Wait until the server ends; unlike a thread's `join`, this can be interrupted."""
        self._ended.wait()
        if self._failure is not None:
            raise RuntimeError("the explorer's server failed") from self._failure

    def stop(self) -> None:
        """End the server, and free its port, within a second."""
        self._server.should_exit = True
        self._ended.wait(_STOP_SECONDS)
        self._listener.close()

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as failure:  # noqa: BLE001 - raised in the main thread
            self._failure = failure
        finally:
            self._ended.set()

    async def _serve(self) -> None:
        closing = asyncio.create_task(self._close_idle_connections())
        await self._server.serve(sockets=[self._listener])
        closing.cancel()
        for connection in [*self._server.server_state.connections]:  # readers that read nothing
            connection.transport.abort()

    async def _close_idle_connections(self) -> None:
        """Close each connection that sends no complete request in time.

        Of too many connections, close all that wait for a request.
        """
        from h11 import IDLE, SEND_BODY

        connections: Any = self._server.server_state.connections
        sweeps: dict[Any, int] = {}
        while True:
            await asyncio.sleep(_SWEEP_SECONDS)
            waiting = [
                (connection, connection.cycle)
                for connection in connections
                if connection.conn.their_state in (IDLE, SEND_BODY)
            ]
            sweeps = {key: sweeps.get(key, 0) + 1 for key in waiting}
            max_sweeps = _REQUEST_SECONDS / _SWEEP_SECONDS
            if len(connections) > _MAX_CONNECTIONS:
                max_sweeps = 1
            for (connection, _), count in sweeps.items():
                if count > max_sweeps:
                    connection.transport.abort()


class _PortInUseError(ConfigError):
    """Another program listens on the port."""


def _listen(host: str, port: int | None) -> socket.socket:
    """Return a socket that listens; raise ConfigError."""
    if not host:
        raise ConfigError("host: expected a name or an address of this machine, found nothing")
    if port is not None and not 0 <= port <= _MAX_PORT:
        raise ConfigError(f"port: expected a number up to {_MAX_PORT}, found {port}")
    for candidate in PORTS if port is None else ():
        with suppress(_PortInUseError):
            return _listener(host, candidate)
    return _listener(host, port or 0)


def _listener(host: str, port: int) -> socket.socket:
    try:
        candidates = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        family, _, _, _, address = min(candidates, key=lambda info: info[0] != socket.AF_INET)
        is_ipv6 = family == socket.AF_INET6
        return socket.create_server(address, family=family, dualstack_ipv6=is_ipv6)
    except PermissionError as error:
        raise ConfigError(f"port {port}: not allowed here; choose a port from 1024 on") from error
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise _PortInUseError(
                f"port {port}: another program listens there; choose another port (--address), or "
                "leave it out"
            ) from error
        raise ConfigError(
            f"host {host}: cannot listen there ({error}); give a name or an address of this "
            "machine (--address), or leave it out"
        ) from error


def _names(host: str, bound: IPv4Address | IPv6Address) -> frozenset[str]:
    """Return the hosts that a request may name: all of this machine if others can reach it."""
    names = {host, str(bound)}
    if not bound.is_loopback:
        name = socket.gethostname()
        names |= {name, name.partition(".")[0], socket.getfqdn()}
    return frozenset(name.lower() for name in names)


def _origin(host: str, port: int) -> str:
    return f"http://{HostPort(host, port)}"


def _is_display_likely(environment: Mapping[str, str]) -> bool:
    """Return whether a browser would open where the reader sits.

    It would not at the far end of SSH, unless a browser is named.
    """
    if "BROWSER" in environment:
        return True
    if "SSH_CONNECTION" in environment:
        return False
    return sys.platform == "darwin" or "DISPLAY" in environment or "WAYLAND_DISPLAY" in environment


def _open(url: str) -> None:
    with suppress(webbrowser.Error, OSError, ValueError):
        webbrowser.open(url)
