"""The server of the pages, in its own thread on a port of this machine, behind a `Gate`."""

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
_EXTRA_PACKAGES = ("starlette", "uvicorn")
# Ports that are tried before the machine chooses one.
PORTS: Final = range(8765, 8785)
_MAX_PORT = 0xFFFF
# Time within which a connection must send a complete request.
_REQUEST_SECONDS = 10.0
# Number of connections above which the next sweep closes all without a complete request.
_MAX_CONNECTIONS = 200
# Time between two sweeps over all connections.
_SWEEP_SECONDS = 0.1
# Time for unfinished answers when the server stops; then they are left to their threads.
_STOP_SECONDS = 0.7
_EXPOSURE_WARNING = (
    "warning: anyone who can reach this machine can try to open the pages, and anyone who has the "
    "address with the token sees the release. Nothing is encrypted: prefer an SSH tunnel, which "
    "needs no --address."
)


def need_extra() -> None:
    """Raise MissingExtraError unless the extra `explore` is installed."""
    missing = [name for name in _EXTRA_PACKAGES if find_spec(name) is None]
    if missing:
        raise MissingExtraError(
            f"the explorer needs {', '.join(missing)}; run pip install '.[explore]' in a checkout"
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
    """Serve the pages on a host and port of this machine until an exception, such as Ctrl-C.

    A browser is opened if there is a display and no proxy.

    Args:
        app: Application that answers requests.
        host: Host to listen on.
        port: Port to listen on; None for the first free one from 8765 on.
        root_path: Path or URL at which a proxy shows the pages.
        page: Page that the addresses lead to; empty for the first one.
        open_browser: Whether to open a browser.
        say: Function that is called with each line about the addresses.

    Raises:
        MissingExtraError: If the extra `explore` is not installed.
        ConfigError: If the server cannot listen there, or the root path is neither a path nor a
            URL.
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
    """Serve the pages as `serve` does, but only within the block; port 0 means any free port."""
    need_extra()
    host = host.removeprefix("[").removesuffix("]")
    root = RootPath.parse(root_path)
    listener = _listen(host, port)
    address, port_number = listener.getsockname()[:2]
    bound = ip_address(address)
    access = Access(
        port=port_number,
        root=root,
        names=_find_host_names(host, bound),
        any_address=bound.is_unspecified,
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
        access: Requests that are let in.
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
        """Address of the server without a path, as this machine sees it."""
        if self.bound.is_unspecified:
            host = LOOPBACK if self.bound.version == 4 else "::1"
        elif self.bound.is_loopback:
            host = str(self.bound)
        else:
            host = self.host
        return _format_origin(host, self.port)

    @property
    def url(self) -> str:
        """Address that opens the pages."""
        return self._format_url(self.token)

    def lines(self) -> list[str]:
        """Return all addresses for the reader, and notes about them."""
        machine = socket.gethostname()
        query = f"/{self.page}?token={self.token}"
        lines = []
        if not self.bound.is_loopback:
            lines.append(_EXPOSURE_WARNING)
        lines.append(f"the explorer runs until Ctrl-C; open {self.url}")
        if self.bound.is_unspecified:
            lines.append(f"on other machines: {_format_origin(machine, self.port)}{query}")
        root = self.access.root
        if root.location is not None:
            lines.append(f"behind the proxy: {root}{query}")
        elif root.path:
            lines.append(f"on your notebook server or portal: {root}{query}")
        inner_host = self.host
        if self.bound.is_loopback or self.bound.is_unspecified:
            inner_host = "localhost"
        tunnel = f"ssh -L {self.port}:{HostPort(inner_host, None)}:{self.port} {machine}"
        local_address = f"{_format_origin('localhost', self.port)}{query}"
        lines.append(f"from another machine: run {tunnel} there, and open {local_address}")
        return lines

    def open_browser(self) -> None:
        """Open the pages in a browser, if there is one, by a command line without the token."""
        url = self._format_url(self._gate.ticket())
        thread = threading.Thread(target=_open_in_browser, args=(url,), name="browser", daemon=True)
        thread.start()

    def _format_url(self, token: str) -> str:
        return f"{self.origin}/{self.page}?token={token}"

    def wait(self) -> None:
        """Wait until the server ends, which it does not do by itself."""
        self._running.wait()


class _Running:
    """A server in a thread, which does not keep the process alive.

    The same holds for all threads that it starts.
    """

    def __init__(self, app: App, listener: socket.socket) -> None:
        import uvicorn

        self._listener = listener
        self._ended = threading.Event()
        self._failure: BaseException | None = None
        # Everything is named explicitly, since uvicorn otherwise uses whatever is installed.
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                http="h11",
                loop="asyncio",
                ws="none",
                lifespan="on",
                log_config=None,
                # The gate logs failures, and bad requests, which anyone may send, are no news.
                log_level="critical",
                access_log=False,
                proxy_headers=False,
                server_header=False,
                timeout_graceful_shutdown=1,  # It must be a whole number; nothing waits for it.
            )
        )

    def start(self) -> None:
        """Start the server, and return as soon as it answers."""
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
        """End the server and free its port, within a second."""
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
        # The other ends of the remaining connections do not read their answers.
        for connection in [*self._server.server_state.connections]:
            connection.transport.abort()

    async def _close_idle_connections(self) -> None:
        """Close each connection that sends no complete request in time.

        If there are too many connections, close all that wait for a request.
        """
        from h11 import IDLE, SEND_BODY

        connections: Any = self._server.server_state.connections
        sweeps: dict[Any, int] = {}
        while True:
            await asyncio.sleep(_SWEEP_SECONDS)
            waiting = []
            for connection in connections:
                if connection.conn.their_state in (IDLE, SEND_BODY):
                    waiting.append((connection, connection.cycle))
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
    """Return a socket that listens; raise ConfigError if it cannot."""
    if not host:
        raise ConfigError("host: expected a name or an address of this machine, found nothing")
    if port is not None and not 0 <= port <= _MAX_PORT:
        raise ConfigError(f"port: expected a number up to {_MAX_PORT}, found {port}")
    if port is None:
        for candidate in PORTS:
            with suppress(_PortInUseError):
                return _open_listener(host, candidate)
    return _open_listener(host, port or 0)


def _open_listener(host: str, port: int) -> socket.socket:
    try:
        candidates = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        family, _, _, _, address = min(candidates, key=lambda info: info[0] != socket.AF_INET)
        is_ipv6 = family == socket.AF_INET6
        return socket.create_server(address, family=family, dualstack_ipv6=is_ipv6)
    except PermissionError as error:
        raise ConfigError(
            f"port {port}: you are not allowed to use this port; choose a port from 1024"
        ) from error
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise _PortInUseError(
                f"port {port}: another program listens on this port; choose another port, or "
                "omit --address"
            ) from error
        raise ConfigError(
            f"host {host}: cannot listen on this host ({error}); give a name or an address of "
            "this machine, or omit --address"
        ) from error


def _find_host_names(host: str, bound: IPv4Address | IPv6Address) -> frozenset[str]:
    """Return the hosts that a request may name; there are several if other machines can connect."""
    names = {host, str(bound)}
    if not bound.is_loopback:
        name = socket.gethostname()
        names |= {name, name.partition(".")[0], socket.getfqdn()}
    return frozenset(name.lower() for name in names)


def _format_origin(host: str, port: int) -> str:
    return f"http://{HostPort(host, port)}"


def _is_display_likely(environment: Mapping[str, str]) -> bool:
    """Return whether a browser would probably open on the reader's own screen.

    Over an SSH connection it would not, unless the environment names a browser.
    """
    if "BROWSER" in environment:
        return True
    if "SSH_CONNECTION" in environment:
        return False
    has_display = "DISPLAY" in environment or "WAYLAND_DISPLAY" in environment
    return sys.platform == "darwin" or has_display


def _open_in_browser(url: str) -> None:
    with suppress(webbrowser.Error, OSError, ValueError):
        webbrowser.open(url)
