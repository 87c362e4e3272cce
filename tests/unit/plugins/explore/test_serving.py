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
from asking import TinyApp, ask, cookie_of
from click.testing import CliRunner
from refusals import assert_refused

import deepaccident_devkit.plugins.explore as package
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, MissingExtraError
from deepaccident_devkit.evaluation.runs.bundles import SUMMARY_FILE
from deepaccident_devkit.plugins.explore import serving as module
from deepaccident_devkit.plugins.explore.access import AsgiScope, Receive, Send
from deepaccident_devkit.plugins.explore.serving import Served, need_extra, serve, serving

pytestmark = pytest.mark.slow

AT_ONCE = 60.0
"""Seconds after which a server that should have ended is taken for one that hangs."""


ANYWHERE = "0.0.0.0"  # noqa: S104


class StopError(Exception):
    """Ends `serve` in a test, as Ctrl-C does otherwise."""


@contextmanager
def shown(served: Served, target: str) -> Iterator[HTTPConnection]:
    """A connection of a reader who has asked for something."""
    connection = HTTPConnection("127.0.0.1", served.port, timeout=AT_ONCE)
    connection.request("GET", target, headers=dict([cookie_of(served)]))
    yield connection
    connection.close()


def opened(
    monkeypatch: pytest.MonkeyPatch,
    environment: Mapping[str, str] = MappingProxyType({"BROWSER": "x"}),
    **arguments: Any,
) -> tuple[list[str], list[str]]:
    """The lines that `serve` says, and the addresses that it opens in a browser."""
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
        assert (served.url, len(served.token) >= 32) == (
            f"http://127.0.0.1:{served.port}/?token={served.token}",
            True,
        )
        assert ask(served.port, "/page", cookie_of(served)).body == "/page /page"
        assert (other.token != served.token, other.port != served.port) == (True, True)
        assert ask(other.port, "/", cookie_of(served)).status == 401
    with pytest.raises(ConnectionRefusedError):
        ask(served.port)
    with serving(TinyApp(), port=served.port) as again:  # the port is free at once
        ask(again.port)


def started(**arguments: Any) -> Callable[[], object]:
    """A call that starts a server, for a moment."""

    def start() -> None:
        with serving(**{"app": TinyApp(), "port": 0, **arguments}):
            pass

    return start


def test_by_default_it_takes_the_first_free_port(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        first, second = taken.getsockname()[1], free.getsockname()[1]
        free.close()
        monkeypatch.setattr(module, "PORTS", (first, second))
        with serving(TinyApp()) as served, serving(TinyApp()) as other:
            assert (served.port, other.port not in (first, second)) == (
                second,
                True,
            )  # none is left


def test_a_place_where_it_cannot_listen_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert_refused(
            (started(port=port), ConfigError, (f"port {port}", "another program", "--address")),
            (started(port=65536), ConfigError, ("port: ", "up to 65535", "found 65536")),
            (started(port=-1), ConfigError, ("port: ", "up to 65535", "found -1")),
            (started(host=""), ConfigError, ("host: ", "found nothing")),
            (
                started(host="192.0.2.1"),
                ConfigError,
                ("host 192.0.2.1: cannot listen", "--address"),
            ),
            (started(host="x" * 70), ConfigError, ("host xx", "cannot listen")),
            (started(host="no host"), ConfigError, ("host no host", "cannot listen")),
            (started(root_path="user"), ConfigError, ("--root-path",)),
        )
    monkeypatch.setattr(
        socket.socket, "bind", Mock(side_effect=PermissionError(13, "Permission denied"))
    )
    assert_refused((started(port=80), ConfigError, ("port 80", "not allowed", "from 1024 on")))


class Endless(TinyApp):
    """Answers without end."""

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await super().__call__(scope, receive, send)
            return
        await send({"type": "http.response.start", "status": 200, "headers": []})
        while True:
            await send({"type": "http.response.body", "body": b"x" * 1_000_000, "more_body": True})
            self.begun.set()


@pytest.mark.parametrize("reader", ["idle", "waits for an answer", "takes nothing"])
def test_no_reader_holds_the_stop(reader: str) -> None:
    app = Endless() if reader == "takes nothing" else TinyApp()
    with ExitStack() as readers:
        with serving(app, port=0) as served:
            connection = readers.enter_context(
                shown(served, "/slow" if reader == "waits for an answer" else "/")
            )
            (thread,) = (each for each in threading.enumerate() if each.name == "explorer")
            if reader == "idle":
                connection.getresponse().read()
            else:
                assert app.begun.wait(AT_ONCE)
            assert all(each.daemon for each in threading.enumerate() if "AnyIO" in each.name)
        with pytest.raises(ConnectionRefusedError):
            ask(served.port)
        app.go_on.set()  # not before: the server stopped while the answer was being made
        thread.join(AT_ONCE)
        assert not thread.is_alive()


def test_pages_that_cannot_start_are_an_error(caplog: pytest.LogCaptureFixture) -> None:
    async def broken(scope: AsgiScope, receive: Receive, send: Send) -> None:
        raise LookupError("no index")

    assert_refused((started(app=broken), RuntimeError, ("server did not start",)))
    assert "no index" in caplog.text


def test_a_server_that_fails_later_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(TinyApp(), port=0) as served:
        monkeypatch.setattr("uvicorn.Server.on_tick", Mock(side_effect=MemoryError))
        assert_refused((served.wait, RuntimeError, ("server failed",)))


ELSEWHERE = "warning: anyone who can reach this machine can try to open the pages"


def test_a_browser_is_opened_with_a_token_for_one_use(monkeypatch: pytest.MonkeyPatch) -> None:
    [said, _], [address] = opened(monkeypatch, page="models/")
    origin, _, token = said.split()[-1].partition("=")
    assert (address.partition("=")[0], token not in address, origin[-14:]) == (
        origin,
        True,
        "/models/?token",
    )


@pytest.mark.parametrize("name", ["starlette", "uvicorn"])
def test_a_missing_extra_is_an_error_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    need_extra()
    monkeypatch.setitem(sys.modules, name, None)
    told = (f"needs {name}", "pip install '.[explore]'")
    assert_refused((need_extra, MissingExtraError, told), (started(), MissingExtraError, told))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--out", "out", "--address", "9000"], "--address changes nothing with --out"),
        (["--out", "out", "--no-open"], "--no-open changes nothing with --out"),
        (["--out", "out", "--root-path", "/x"], "--root-path changes nothing with --out"),
        (["--where", "town=Town03"], "--where changes nothing without --out"),
        (["--address", "localhost:0"], "expected HOST:PORT, HOST or PORT, found 'localhost:0'"),
        (["--address", "::1"], "expected HOST:PORT, HOST or PORT, found '::1'"),
    ],
)
def test_the_verb_refuses_options_that_change_nothing(words: list[str], sentence: str) -> None:
    result = CliRunner().invoke(deepaccident, ["explore", ".", *words])
    assert (result.exit_code, sentence in result.output) == (2, True)


@pytest.mark.parametrize(
    ("words", "told"),
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
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: list[str], told: dict[str, Any]
) -> None:
    called = Mock()
    monkeypatch.setattr(
        import_module("deepaccident_devkit.plugins.explore.cli"), "DeepAccident", dict
    )
    for name in ("explore", "export_pages", "Explorer"):
        monkeypatch.setitem(vars(package), name, called)
    (tmp_path / SUMMARY_FILE).touch()
    command = ["explore", "release", "--results", str(tmp_path), "--results", "c.json", *words]
    CliRunner().invoke(deepaccident, command, catch_exceptions=False)
    given = {name: value for call in called.call_args_list for name, value in call.kwargs.items()}
    assert given.items() >= {"bundles": [tmp_path], "results": [Path("c.json")], **told}.items()


HALF = b"GET /page HTTP/1.1\r\nHost: localhost"
WHOLE = HALF + b"\r\n\r\n"
SLOW = {
    "nothing": (b"", b""),
    "half a request": (HALF, b""),
    "a header letter by letter": (HALF, b"a"),
    "a body letter by letter": (
        b"POST /page HTTP/1.1\r\nHost: localhost\r\nContent-Length: 999\r\n\r\n",
        b"a",
    ),
    "half a request after a whole one": (WHOLE + HALF, b"a"),
    "a body without an end": (
        b"POST / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"1\r\na\r\n",
    ),
}


@pytest.mark.parametrize(("first", "later"), SLOW.values(), ids=SLOW)
def test_who_sends_no_whole_request_in_time_is_cut_off(
    first: bytes, later: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_REQUEST_SECONDS", 0.5)
    with (
        serving(TinyApp(), port=0) as served,
        socket.create_connection(("127.0.0.1", served.port)) as slow,
    ):
        slow.sendall(first)
        slow.settimeout(0.05)
        end = time.monotonic() + AT_ONCE
        is_open = True
        while is_open:
            assert time.monotonic() < end
            try:
                slow.sendall(later)
                is_open = slow.recv(4096) != b""
            except TimeoutError:
                continue
            except ConnectionError:
                is_open = False
        assert ask(served.port, "/page", cookie_of(served)).status == 200


def test_half_requests_leave_room_for_whole_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MAX_CONNECTIONS", 20)
    app = TinyApp()
    with serving(app, port=0) as served, ExitStack() as stack:
        reader = stack.enter_context(
            shown(served, "/slow")
        )  # who waits for an answer keeps the connection
        assert app.begun.wait(AT_ONCE)
        half = [
            stack.enter_context(socket.create_connection(("127.0.0.1", served.port)))
            for _ in range(100)
        ]
        for each in half:
            with suppress(ConnectionError):
                each.sendall(HALF)
        assert [ask(served.port, "/page", cookie_of(served)).status for _ in range(5)] == [200] * 5
        for each in half[:50]:
            each.settimeout(AT_ONCE)
            with suppress(ConnectionError):
                assert each.recv(1) == b""
        app.go_on.set()
        assert reader.getresponse().status == 200
