import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection
from importlib import import_module
from ipaddress import ip_address
from itertools import chain
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from asking import TinyApp, ask, cookie_of
from click.testing import CliRunner

import deepaccident_devkit.explore as package
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, MissingExtraError
from deepaccident_devkit.evaluation.runs.bundles import SUMMARY_FILE
from deepaccident_devkit.explore import serving as module
from deepaccident_devkit.explore.access import Access, Receive, RootPath, Scope, Send
from deepaccident_devkit.explore.serving import Served, need_extra, serve, serving

ANYWHERE = "0.0.0.0"  # noqa: S104
STOPPED = 1.0
"""Seconds that a server may need to end; tests allow twice as much, on a machine that does other things too."""


class StopError(Exception):
    """Ends `serve` in a test, as Ctrl-C does otherwise."""


@contextmanager
def shown(app: TinyApp, target: str, served: Served) -> Iterator[threading.Thread]:
    """A reader who waits for an answer."""

    def read() -> None:
        connection.request("GET", target, headers=dict([cookie_of(served)]))
        with suppress(OSError):
            connection.getresponse().read()

    connection = HTTPConnection("127.0.0.1", served.port, timeout=10)
    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield reader
    finally:
        app.go_on.set()
        reader.join()
        connection.close()


def opened(monkeypatch: pytest.MonkeyPatch, **arguments: Any) -> tuple[list[str], list[str]]:
    """The lines that `serve` says, and the addresses that it opens in a browser."""
    lines: list[str] = []
    addresses: list[str] = []

    def stop(_served: Served) -> None:
        raise StopError

    with monkeypatch.context() as patch:
        patch.setenv("BROWSER", "x")
        patch.setattr(webbrowser, "open", addresses.append)
        patch.setattr(Served, "wait", stop)
        with pytest.raises(StopError):
            serve(TinyApp(), port=0, say=lines.append, **arguments)
        for thread in threading.enumerate():
            if thread.name == "browser":
                thread.join()
    return lines, addresses


def test_a_server_answers_when_its_address_is_known_and_not_afterwards() -> None:
    with serving(TinyApp(), port=0) as served:
        assert served.url == f"http://127.0.0.1:{served.port}/?token={served.token}"
        assert len(served.token) >= 32
        assert ask(served.port, "/page", cookie_of(served)).body == "/page /page"
        with serving(TinyApp(), port=0) as other:
            assert other.token != served.token
            assert other.port != served.port
            assert ask(other.port, "/", cookie_of(served)).status == 401
    with pytest.raises(ConnectionRefusedError):
        ask(served.port)


def test_the_port_is_free_at_once() -> None:
    with serving(TinyApp(), port=0) as served:
        ask(served.port)
    with serving(TinyApp(), port=served.port) as again:
        ask(again.port)


def test_a_taken_port_is_an_error_with_the_remedy() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with (
            pytest.raises(ConfigError, match=f"port {port}: another program listens there; choose another port"),
            serving(TinyApp(), port=port),
        ):
            pass


def test_by_default_it_takes_the_first_free_port(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        first, second = taken.getsockname()[1], free.getsockname()[1]
        free.close()
        monkeypatch.setattr(module, "_PORTS", (first, second))
        with serving(TinyApp()) as served:
            assert served.port == second
            with serving(TinyApp()) as other:  # none is left
                assert other.port not in (first, second)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"port": 65536}, "port: expected a number up to 65535, found 65536"),
        ({"port": -1}, "port: expected a number up to 65535, found -1"),
        ({"host": ""}, "host: expected a name or an address of this machine, found nothing"),
        ({"host": "192.0.2.1"}, r"host 192.0.2.1: cannot listen there \(.*\); give a name or an address"),
        ({"host": "x" * 70}, "host x+: cannot listen there"),
        ({"host": "no host"}, "host no host: cannot listen there"),
        ({"root_path": "user"}, "--root-path: expected a path"),
    ],
)
def test_a_place_where_it_cannot_listen_is_an_error(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence), serving(TinyApp(), **{"port": 0, **arguments}):
        pass


def test_a_port_that_only_root_may_use_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_socket: socket.socket, _address: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(socket.socket, "bind", refuse)
    with pytest.raises(ConfigError, match="port 80: not allowed here; choose a port from 1024 on"):
        module._listen("127.0.0.1", 80)


def test_the_loopback_of_ipv6_serves_too() -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no IPv6 here")
    for host in ("::1", "[::1]"):
        with serving(TinyApp(), host=host, port=0) as served:
            assert served.url.startswith(f"http://[::1]:{served.port}/?token=")
            connection = HTTPConnection("::1", served.port, timeout=10)
            connection.request("GET", "/page", headers=dict([cookie_of(served)]))
            assert connection.getresponse().read() == b"/page /page"
            connection.close()


def test_an_idle_connection_does_not_hold_the_stop() -> None:
    with serving(TinyApp(), port=0) as served:
        connection = HTTPConnection("127.0.0.1", served.port, timeout=10)
        connection.request("GET", "/", headers=dict([cookie_of(served)]))
        connection.getresponse().read()
        begin = time.monotonic()
    assert time.monotonic() - begin < 2 * STOPPED
    connection.close()


def test_an_answer_in_the_making_does_not_hold_the_stop() -> None:
    app = TinyApp()
    with serving(app, port=0) as served:
        with shown(app, "/slow", served) as reader:
            assert app.begun.wait(10)
            [thread] = [each for each in threading.enumerate() if each.name == "explorer"]
            assert all(each.daemon for each in threading.enumerate() if "AnyIO" in each.name)
            begin = time.monotonic()
            served._running.stop()
            assert time.monotonic() - begin < 2 * STOPPED
            assert reader.is_alive()
            with pytest.raises(ConnectionRefusedError):
                ask(served.port)
        thread.join(10)
        assert not thread.is_alive()


def test_a_reader_who_takes_nothing_does_not_hold_the_stop() -> None:
    class Endless(TinyApp):
        async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
            if scope["type"] == "lifespan":
                await self._lifespan(receive, send)
                return
            await send({"type": "http.response.start", "status": 200, "headers": []})
            while True:
                await send({"type": "http.response.body", "body": b"x" * 1_000_000, "more_body": True})
                self.begun.set()

    app = Endless()
    with serving(app, port=0) as served:
        connection = HTTPConnection("127.0.0.1", served.port, timeout=10)
        connection.request("GET", "/", headers=dict([cookie_of(served)]))
        assert app.begun.wait(10)
        begin = time.monotonic()
    assert time.monotonic() - begin < 2 * STOPPED
    assert served._running._ended.wait(10)
    connection.close()


def test_pages_that_cannot_start_are_an_error(caplog: pytest.LogCaptureFixture) -> None:
    async def broken(scope: Scope, receive: Receive, send: Send) -> None:
        raise LookupError("no index")

    with pytest.raises(RuntimeError, match="the explorer's server did not start"), serving(broken, port=0):
        pass
    assert "no index" in caplog.text


def test_a_server_that_fails_later_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(TinyApp(), port=0) as served:
        monkeypatch.setattr(served._running._server, "on_tick", Mock(side_effect=MemoryError))
        with pytest.raises(RuntimeError, match="the explorer's server failed"):
            served.wait()


def lines_of(*, host: str = "127.0.0.1", bound: str = "127.0.0.1", root: str = "") -> list[str]:
    """What a server there would say."""
    access = Access(port=9000, root=RootPath.parse(root), token="secret")  # noqa: S106
    return Served(host, ip_address(bound), access, Mock(), Mock()).lines()


@pytest.fixture
def _node17(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "node17")


@pytest.mark.usefixtures("_node17")
def test_the_address_and_a_tunnel_are_said() -> None:
    assert lines_of() == [
        "the explorer runs until Ctrl-C; open http://127.0.0.1:9000/?token=secret",
        "from another machine: ssh -L 9000:localhost:9000 node17, and there http://localhost:9000/?token=secret",
    ]


@pytest.mark.parametrize(
    ("root", "line"),
    [
        ("/user/me/proxy/8000/", "on your notebook server or portal: /user/me/proxy/8000/?token=secret"),
        ("https://hub.example.org/x", "behind the proxy: https://hub.example.org/x/?token=secret"),
        ("https://hub.example.org", "behind the proxy: https://hub.example.org/?token=secret"),
    ],
)
def test_the_address_behind_a_proxy_is_said(root: str, line: str) -> None:
    assert lines_of(root=root)[1] == line


@pytest.mark.usefixtures("_node17")
def test_a_server_for_the_network_warns() -> None:
    warning, address, network, tunnel = lines_of(host=ANYWHERE, bound=ANYWHERE)
    assert warning.startswith("warning: anyone who can reach this machine can try to open the pages")
    assert "Nothing is encrypted: prefer an SSH tunnel" in warning
    assert address.endswith("open http://127.0.0.1:9000/?token=secret")
    assert network == "on other machines: http://node17:9000/?token=secret"
    assert "ssh -L 9000:localhost:9000 node17," in tunnel
    assert "open http://[::1]:9000/" in lines_of(host="::", bound="::")[1]


@pytest.mark.usefixtures("_node17")
def test_a_host_is_said_as_it_was_given() -> None:
    _, address, tunnel = lines_of(host="login1", bound="192.0.2.1")
    assert "open http://login1:9000/" in address
    assert "ssh -L 9000:login1:9000 node17," in tunnel
    _, address, tunnel = lines_of(host="2001:db8::1", bound="2001:db8::1")
    assert "open http://[2001:db8::1]:9000/" in address
    assert "ssh -L 9000:[2001:db8::1]:9000 node17," in tunnel


def test_a_browser_is_opened_with_a_token_for_one_use(monkeypatch: pytest.MonkeyPatch) -> None:
    [said, _], [address] = opened(monkeypatch)
    origin, _, token = said.split()[-1].partition("=")
    assert address.partition("=")[0] == origin
    assert token not in address


@pytest.mark.parametrize("arguments", [{"open_browser": False}, {"root_path": "/user/me/proxy/8000"}])
def test_a_browser_is_not_opened_behind_a_proxy_or_if_it_is_not_wanted(
    monkeypatch: pytest.MonkeyPatch, arguments: dict[str, Any]
) -> None:
    assert opened(monkeypatch, **arguments)[1] == []


@pytest.mark.parametrize(
    ("environment", "likely"),
    [
        ({"DISPLAY": ":0"}, True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, True),
        ({}, sys.platform == "darwin"),
        ({"DISPLAY": "localhost:10.0", "SSH_CONNECTION": "x"}, False),
        ({"BROWSER": "helper", "SSH_CONNECTION": "x"}, True),
    ],
)
def test_a_browser_is_opened_where_the_reader_sits(environment: dict[str, str], likely: bool) -> None:
    assert module._is_display_likely(environment) is likely


def test_a_browser_that_fails_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    for error in (webbrowser.Error("no browser"), OSError("no program")):

        def fail(_url: str, error: Exception = error) -> None:
            raise error

        monkeypatch.setattr(webbrowser, "open", fail)
        module._open("http://127.0.0.1:1/")


@pytest.mark.parametrize("name", ["starlette", "uvicorn"])
def test_a_missing_extra_is_an_error_with_the_remedy(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    need_extra()
    monkeypatch.setitem(sys.modules, name, None)
    sentence = rf"the explorer needs {name}; in a checkout: pip install '\.\[explore\]'"
    with pytest.raises(MissingExtraError, match=sentence):
        need_extra()
    with pytest.raises(MissingExtraError, match=sentence), serving(TinyApp(), port=0):
        pass


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
    assert result.exit_code == 2
    assert sentence in result.output


def test_the_verb_makes_one_call(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def called(*arguments: Any, **options: Any) -> None:
        calls.append((arguments, options))

    def verb(*words: str) -> tuple[tuple[Any, ...], dict[str, Any]]:
        command = ["explore", "release", *chain.from_iterable(("--results", str(path)) for path in given), *words]
        CliRunner().invoke(deepaccident, command, catch_exceptions=False)
        return calls.pop()

    monkeypatch.setattr(import_module("deepaccident_devkit.explore.cli"), "DeepAccident", dict)
    for name in ("explore", "export_pages"):
        monkeypatch.setitem(vars(package), name, called)
    monkeypatch.setitem(vars(package), "Explorer", lambda *given, **options: (*given, options))
    given = [tmp_path / "a", tmp_path / "b", tmp_path / "c.json"]
    shared = {"bundles": given[:2], "results": given[2:]}
    for folder in given[:2]:
        folder.mkdir()
        (folder / SUMMARY_FILE).touch()
    ((dataset, opened),), options = verb("--no-open", "--address", "[::1]:9000", "--workers", "1")
    say: Callable[[str], object] = options.pop("say")
    say("")
    assert dataset == {
        "dataroot": Path("release"), "version": "v1", "index_dir": None, "workers": 1, "on_error": "raise",
    }  # fmt: skip
    assert opened == {**shared, "workers": 1}
    assert options == {"host": "::1", "port": 9000, "root_path": "", "open_browser": False}
    assert verb("--root-path", "/x")[1].items() >= {"root_path": "/x", "open_browser": True}.items()
    (_, target), options = verb("--out", "out", "--where", "town=Town03", "--where", "length=1..9")
    wanted = {**shared, "where": ("town=Town03", "length=1..9"), "workers": None, "progress": True}
    assert (target, options) == (Path("out"), wanted)
