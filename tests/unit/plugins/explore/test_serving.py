import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from http.client import HTTPConnection
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any
from unittest.mock import Mock

import pytest
from click.testing import CliRunner
from support.expected_errors import assert_raises
from support.explorer_requests import TinyApp, send_request, session_cookie

import deepaccident_devkit.plugins.explore as package
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, MissingExtraError
from deepaccident_devkit.evaluation.runs.bundles import SUMMARY_FILE
from deepaccident_devkit.plugins.explore import serving as module
from deepaccident_devkit.plugins.explore.access import AsgiScope, Receive, Send
from deepaccident_devkit.plugins.explore.serving import Served, need_extra, serve, serving

pytestmark = pytest.mark.slow

MAX_WAIT_S = 60.0
"""Time after which a server that should have ended counts as hanging."""


class StopError(Exception):
    """End `serve` in a test, as Ctrl-C does otherwise."""


@contextmanager
def open_connection(served: Served, target: str) -> Iterator[HTTPConnection]:
    """Open a connection of a reader with the cookie, and send a request."""
    connection = HTTPConnection("127.0.0.1", served.port, timeout=MAX_WAIT_S)
    connection.request("GET", target, headers=dict([session_cookie(served)]))
    yield connection
    connection.close()


def serve_until_stop(
    monkeypatch: pytest.MonkeyPatch,
    environment: Mapping[str, str] = MappingProxyType({"BROWSER": "x"}),
    **arguments: Any,
) -> tuple[list[str], list[str]]:
    """Return the lines that `serve` prints, and the addresses that it opens in a browser."""
    lines: list[str] = []
    addresses: list[str] = []
    with monkeypatch.context() as patch:
        for name in ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION"):
            patch.delenv(name, raising=False)
        for name, value in environment.items():
            patch.setenv(name, value)
        patch.setattr(webbrowser, "open", arguments.pop("browser", addresses.append))
        patch.setattr(Served, "wait", Mock(side_effect=StopError))
        with pytest.raises(StopError):
            serve(TinyApp(), port=0, say=lines.append, **arguments)
        for thread in threading.enumerate():
            if thread.name == "browser":
                thread.join()
    return lines, addresses


def test_a_server_answers_when_its_address_is_known_and_not_afterwards() -> None:
    with serving(TinyApp(), port=0) as served, serving(TinyApp(), port=0) as other:
        assert served.url == f"http://127.0.0.1:{served.port}/?token={served.token}"
        assert len(served.token) >= 32
        assert send_request(served.port, "/page", session_cookie(served)).body == "/page /page"
        assert other.token != served.token
        assert other.port != served.port
        assert send_request(other.port, "/", session_cookie(served)).status == 401
    with pytest.raises(ConnectionRefusedError):
        send_request(served.port)
    with serving(TinyApp(), port=served.port) as successor:  # the port is free at once
        send_request(successor.port)


def make_starter(**arguments: Any) -> Callable[[], object]:
    """Return a function that starts a server and stops it at once."""

    def start() -> None:
        with serving(**{"app": TinyApp(), "port": 0, **arguments}):
            pass

    return start


def test_by_default_it_takes_the_first_free_port(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as used_socket, socket.socket() as free_socket:
        free_socket.bind(("127.0.0.1", 0))
        used_port = used_socket.getsockname()[1]
        free_port = free_socket.getsockname()[1]
        free_socket.close()
        monkeypatch.setattr(module, "PORTS", (used_port, free_port))
        with serving(TinyApp()) as served, serving(TinyApp()) as other:
            assert served.port == free_port
            assert other.port not in (used_port, free_port)  # none of them is left


def test_an_address_where_it_cannot_listen_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as used_socket:
        port = used_socket.getsockname()[1]
        assert_raises(
            (
                make_starter(port=port),
                ConfigError,
                (f"port {port}", "another program", "--address"),
            ),
            (make_starter(port=65536), ConfigError, ("port: ", "up to 65535", "found 65536")),
            (make_starter(port=-1), ConfigError, ("port: ", "up to 65535", "found -1")),
            (make_starter(host=""), ConfigError, ("host: ", "found nothing")),
            (
                make_starter(host="192.0.2.1"),
                ConfigError,
                ("host 192.0.2.1: cannot listen", "--address"),
            ),
            (make_starter(host="x" * 70), ConfigError, ("host xx", "cannot listen")),
            (make_starter(host="no host"), ConfigError, ("host no host", "cannot listen")),
            (make_starter(root_path="user"), ConfigError, ("--root-path",)),
        )
    monkeypatch.setattr(
        socket.socket, "bind", Mock(side_effect=PermissionError(13, "Permission denied"))
    )
    assert_raises((make_starter(port=80), ConfigError, ("port 80", "not allowed", "from 1024")))


class EndlessApp(TinyApp):
    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await super().__call__(scope, receive, send)
            return
        await send({"type": "http.response.start", "status": 200, "headers": []})
        while True:
            await send({"type": "http.response.body", "body": b"x" * 1_000_000, "more_body": True})
            self.begun.set()


@pytest.mark.parametrize("reader", ["idle", "waits for an answer", "takes nothing"])
def test_no_reader_delays_the_stop(reader: str) -> None:
    app = EndlessApp() if reader == "takes nothing" else TinyApp()
    target = "/slow" if reader == "waits for an answer" else "/"
    with ExitStack() as connections:
        with serving(app, port=0) as served:
            connection = connections.enter_context(open_connection(served, target))
            threads = threading.enumerate()
            (server_thread,) = (thread for thread in threads if thread.name == "explorer")
            if reader == "idle":
                connection.getresponse().read()
            else:
                assert app.begun.wait(MAX_WAIT_S)
            workers = [thread for thread in threading.enumerate() if "AnyIO" in thread.name]
            assert all(thread.daemon for thread in workers)
        with pytest.raises(ConnectionRefusedError):
            send_request(served.port)
        app.go_on.set()  # only now: the server stopped while the answer was being made
        server_thread.join(MAX_WAIT_S)
        assert not server_thread.is_alive()


def test_pages_that_cannot_start_are_an_error(caplog: pytest.LogCaptureFixture) -> None:
    async def broken_app(scope: AsgiScope, receive: Receive, send: Send) -> None:
        raise LookupError("no index")

    assert_raises((make_starter(app=broken_app), RuntimeError, ("server did not start",)))
    assert "no index" in caplog.text


def test_a_server_that_fails_later_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(TinyApp(), port=0) as served:
        monkeypatch.setattr("uvicorn.Server.on_tick", Mock(side_effect=MemoryError))
        assert_raises((served.wait, RuntimeError, ("server failed",)))


def test_a_browser_is_opened_with_a_token_for_one_use(monkeypatch: pytest.MonkeyPatch) -> None:
    [address_line, _], [browser_address] = serve_until_stop(monkeypatch, page="models/")
    printed_page, _, token = address_line.split()[-1].partition("=")
    assert printed_page.endswith("/models/?token")
    assert browser_address.partition("=")[0] == printed_page
    assert token not in browser_address


@pytest.mark.parametrize("name", ["starlette", "uvicorn"])
def test_a_missing_extra_is_an_error_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    need_extra()
    monkeypatch.setitem(sys.modules, name, None)
    message_parts = (f"needs {name}", "pip install '.[explore]'")
    assert_raises(
        (need_extra, MissingExtraError, message_parts),
        (make_starter(), MissingExtraError, message_parts),
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "out", "--address", "9000"], "--address has no effect with --out"),
        (["--out", "out", "--no-open"], "--no-open has no effect with --out"),
        (["--out", "out", "--root-path", "/x"], "--root-path has no effect with --out"),
        (["--where", "town=Town03"], "--where has no effect without --out"),
        (["--address", "localhost:0"], "expected HOST:PORT, HOST or PORT, found 'localhost:0'"),
        (["--address", "::1"], "expected HOST:PORT, HOST or PORT, found '::1'"),
    ],
)
def test_the_verb_refuses_options_that_change_nothing(options: list[str], message: str) -> None:
    result = CliRunner().invoke(deepaccident, ["explore", ".", *options])
    assert (result.exit_code, message in result.output) == (2, True)


@pytest.mark.parametrize(
    ("options", "arguments"),
    [
        (
            ["--no-open", "--address", "[::1]:9000"],
            {"host": "::1", "port": 9000, "root_path": "", "open_browser": False},
        ),
        (["--root-path", "/x"], {"root_path": "/x", "open_browser": True}),
        (
            ["--out", "out", "--where", "town=Town03", "--where", "a=1"],
            {"where": ("town=Town03", "a=1")},
        ),
    ],
)
def test_options_of_the_verb_reach_the_server_or_the_export(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, options: list[str], arguments: dict[str, Any]
) -> None:
    mock = Mock()
    cli = import_module("deepaccident_devkit.plugins.explore.cli")
    monkeypatch.setattr(cli, "DeepAccident", dict)
    for name in ("explore", "export_pages", "Explorer"):
        monkeypatch.setitem(vars(package), name, mock)
    (tmp_path / SUMMARY_FILE).touch()
    results = ["--results", str(tmp_path), "--results", "c.json"]
    command = ["explore", "release", *results, *options]
    CliRunner().invoke(deepaccident, command, catch_exceptions=False)

    received = {}
    for call in mock.call_args_list:
        received.update(call.kwargs)
    expected = {"bundles": [tmp_path], "results": [Path("c.json")], **arguments}
    assert received.items() >= expected.items()


HALF_REQUEST = b"GET /page HTTP/1.1\r\nHost: localhost"
WHOLE_REQUEST = HALF_REQUEST + b"\r\n\r\n"
SLOW_READERS = {
    "nothing": (b"", b""),
    "half a request": (HALF_REQUEST, b""),
    "a header letter by letter": (HALF_REQUEST, b"a"),
    "a body letter by letter": (
        b"POST /page HTTP/1.1\r\nHost: localhost\r\nContent-Length: 999\r\n\r\n",
        b"a",
    ),
    "half a request after a whole one": (WHOLE_REQUEST + HALF_REQUEST, b"a"),
    "a body without an end": (
        b"POST / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"1\r\na\r\n",
    ),
}


@pytest.mark.parametrize(("first", "later"), SLOW_READERS.values(), ids=SLOW_READERS)
def test_a_reader_without_a_whole_request_in_time_is_cut_off(
    first: bytes, later: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_REQUEST_SECONDS", 0.5)
    with (
        serving(TinyApp(), port=0) as served,
        socket.create_connection(("127.0.0.1", served.port)) as connection,
    ):
        connection.sendall(first)
        connection.settimeout(0.05)
        end = time.monotonic() + MAX_WAIT_S
        is_open = True
        while is_open:
            assert time.monotonic() < end
            try:
                connection.sendall(later)
                is_open = connection.recv(4096) != b""
            except TimeoutError:
                continue
            except ConnectionError:
                is_open = False
        assert send_request(served.port, "/page", session_cookie(served)).status == 200


def test_half_requests_leave_room_for_whole_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MAX_CONNECTIONS", 20)
    app = TinyApp()
    with serving(app, port=0) as served, ExitStack() as stack:
        # a reader who waits for an answer keeps the connection
        reader = stack.enter_context(open_connection(served, "/slow"))
        assert app.begun.wait(MAX_WAIT_S)
        connections = []
        for _ in range(100):
            connection = socket.create_connection(("127.0.0.1", served.port))
            connections.append(stack.enter_context(connection))
        for connection in connections:
            with suppress(ConnectionError):
                connection.sendall(HALF_REQUEST)

        for _ in range(5):
            assert send_request(served.port, "/page", session_cookie(served)).status == 200
        for connection in connections[:50]:
            connection.settimeout(MAX_WAIT_S)
            with suppress(ConnectionError):
                assert connection.recv(1) == b""
        app.go_on.set()
        assert reader.getresponse().status == 200
