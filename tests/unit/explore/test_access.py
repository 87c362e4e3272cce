import asyncio
import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from http.client import IncompleteRead
from typing import Any
from urllib.parse import urlsplit

import pytest
from asking import Answer, TinyApp, ask, cookie_of

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.explore.access import HEADERS, Access, App, Gate, HostPort, Message, RootPath
from deepaccident_devkit.explore.serving import Served, serving

ROOT = "/user/me/proxy/8000"
URL = f"https://hub.example.org{ROOT}"
NAVIGATE, DOCUMENT = ("Sec-Fetch-Mode", "navigate"), ("Sec-Fetch-Dest", "document")
ANYWHERE = "0.0.0.0"  # noqa: S104
START = Callable[..., Served]


@pytest.fixture(scope="module")
def start() -> Iterator[START]:
    """Servers of the tiny application by their arguments, each started once."""
    servers: dict[tuple[tuple[str, str], ...], Served] = {}
    with ExitStack() as stack:

        def started(**arguments: str) -> Served:
            key = tuple(sorted(arguments.items()))
            if key not in servers:
                opened: AbstractContextManager[Served] = serving(TinyApp(), port=0, **arguments)
                servers[key] = stack.enter_context(opened)
            return servers[key]

        yield started


@pytest.fixture
def served(start: START) -> Served:
    return start()


def asked(served: Served, target: str = "/", *headers: tuple[str, str], **more: Any) -> Answer:
    """The answer to a reader who has the cookie."""
    return ask(served.port, target, cookie_of(served), *headers, **more)


def passed(app: App, access: Access, **changes: Any) -> list[Message]:
    """What a gate sends for a request that no client library would make."""
    sent: list[Message] = []
    scope = {"type": "http", "method": "GET", "path": "/", "query_string": b"", "headers": [], **changes}

    async def receive() -> Message:
        return {"type": "websocket.connect"}

    async def send(message: Message) -> None:
        sent.append(message)

    asyncio.run(Gate(app, access)(scope, receive, send))
    return sent


def test_without_a_token_the_answer_is_a_sentence(served: Served) -> None:
    answer = ask(served.port)
    assert answer.status == 401
    assert "Open the address that the command" in answer.body
    assert answer.headers["content-type"] == "text/plain; charset=utf-8"


def test_the_right_token_becomes_a_cookie(served: Served) -> None:
    answer = ask(served.port, f"/?token={served.token}")
    assert (answer.status, answer.headers["location"], answer.body) == (303, "./", "")
    assert answer.headers["cache-control"] == "no-store"
    cookie, *attributes = answer.headers["set-cookie"].split("; ")
    assert attributes == ["Path=/", "HttpOnly", "SameSite=Lax"]
    assert cookie.startswith(f"deepaccident_explore_{served.port}=")
    assert served.token not in cookie
    assert ask(served.port, "/page", ("Cookie", answer.cookie)).body == "/page /page"
    assert ask(served.port, f"/?token={served.token}", method="HEAD").status == 303


@pytest.mark.parametrize("query", ["token=wrong", "token=", "token", "token={0}x", "token={0}&token={0}", "token=%ff"])
def test_a_wrong_token_is_refused_even_with_a_cookie(served: Served, query: str) -> None:
    answer = asked(served, "/?" + query.format(served.token))
    assert answer.status == 403
    assert "set-cookie" not in answer.headers
    assert "The token is wrong" in answer.body


@pytest.mark.parametrize("name", ["token", "%74oken"])
@pytest.mark.parametrize(
    ("target", "location"),
    [
        ("/?{0}", "./"),
        ("/a/b?{0}", "./b"),
        ("/a/b/?{0}", "./"),
        ("/a?x=1&{0}&y=2", "./a?x=1&y=2"),
        ("/a:b?{0}&x=%20", "./a:b?x=%20"),
        ("//evil.example/x?{0}", "./x"),
        ("//evil.example?{0}", "./evil.example"),
        ("/\\evil.example?{0}", "./%5Cevil.example"),
        ("/a?tokens=1&{0}", "./a?tokens=1"),
    ],
)
def test_the_address_without_the_token_is_relative(served: Served, target: str, location: str, name: str) -> None:
    answer = ask(served.port, target.format(f"{name}={served.token}"))
    assert (answer.status, answer.headers["location"]) == (303, location)


def test_a_cookie_opens_the_pages(served: Served) -> None:
    name, value = cookie_of(served)
    assert asked(served).status == 200
    assert ask(served.port, "/", (name, f"other=1; {value}; last")).status == 200
    assert ask(served.port, "/", (name, f"{served.access.cookie}=tossed; {value}")).status == 200
    assert ask(served.port, "/", (name, f"{value}x")).status == 401
    assert ask(served.port, "/", (name, value.replace(str(served.port), "1"))).status == 401
    assert ask(served.port, "/", (name, f"{served.access.cookie}={served.token}")).status == 401
    assert ask(served.port, "/", (name, f"{served.access.cookie}=é")).status == 401


def test_a_ticket_is_right_once_and_for_a_minute(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    first = served._gate.ticket()
    assert asked(served).status == 200
    assert ask(served.port, f"/?token={first}").status == 303
    assert ask(served.port, f"/?token={first}").status == 403
    monkeypatch.setattr("deepaccident_devkit.explore.access._TICKET_SECONDS", -0.001)
    assert ask(served.port, f"/?token={served._gate.ticket()}").status == 403
    assert ask(served.port, f"/?token={served.token}").status == 303


def test_the_application_gets_no_cookies_and_no_token(served: Served) -> None:
    app = TinyApp()
    access = Access(port=1)
    headers = [
        (b"host", b"localhost"),
        (b"Cookie", f"{access.cookie}={access.session}; other=1".encode()),
        (b"a", b"b"),
    ]
    passed(app, access, path="/a é", headers=headers)
    assert app.scopes[0]["headers"] == [(b"host", b"localhost"), (b"a", b"b")]
    assert (app.scopes[0]["path"], app.scopes[0]["raw_path"]) == ("/a é", b"/a%20%C3%A9")


def test_only_get_and_head_are_answered(served: Served) -> None:
    head = asked(served, "/page", method="HEAD")
    assert (head.status, head.body) == (200, "")
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "TRACE", "get"):
        answer = asked(served, method=method)
        assert (answer.status, answer.headers["allow"]) == (405, "GET, HEAD")
    refused = ask(served.port, method="HEAD")
    assert (refused.status, refused.body) == (401, "")
    assert int(refused.headers["content-length"]) == len(ask(served.port).body)


@pytest.mark.parametrize("host", ["localhost", "LocalHost", "127.0.0.1", "[::1]", "[0:0:0:0:0:0:0:1]"])
@pytest.mark.parametrize("port", ["", ":9000"])
def test_a_tunnel_may_have_another_port(served: Served, host: str, port: str) -> None:
    assert asked(served, host=host + port).status == 200


@pytest.mark.parametrize(
    "host",
    [
        "evil.example", "evil.example:{0}", "localhost.evil.example", "localhost.", "127.0.0.1.evil.example", ANYWHERE,
        "192.0.2.1:{0}", "[::2]", "", ":{0}", "localhost:", "localhost:x", "localhost:99999", "me@localhost", "[::1",
        "[:]", "::1", "localhost/x", "localhost,localhost", "127.1", "2130706433",
    ],
)  # fmt: skip
def test_another_host_is_refused(served: Served, host: str) -> None:
    answer = asked(served, f"/?token={served.token}", host=host.format(served.port))
    assert answer.status == 400
    assert "--root-path" in answer.body
    assert "--address" in answer.body
    assert "evil" not in answer.body


def test_the_host_must_be_there_once(served: Served) -> None:
    assert asked(served, "/", ("Host", "localhost")).status == 400
    assert asked(served, host=None).status == 400
    own = (b"cookie", f"{served.access.cookie}={served.access.session}".encode())
    for headers in ([own], [own, (b"host", b"localhost"), (b"host", b"localhost")]):
        assert passed(TinyApp(), served.access, headers=headers)[0]["status"] == 400
    assert passed(TinyApp(), served.access, headers=[own, (b"host", b"localhost")])[0]["status"] == 200


@pytest.mark.parametrize("target", ["http://localhost:{0}/", "http://evil.example/", "localhost:{0}", "*", "page"])
def test_a_request_for_no_path_is_refused(served: Served, target: str) -> None:
    assert asked(served, target.format(served.port)).status == 400


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("localhost:9000", "http://localhost:9000", 200),
        ("localhost", "http://localhost", 200),
        ("localhost", "http://localhost:80", 200),
        ("localhost", "https://localhost:443", 200),
        ("[::1]:9000", "http://[::1]:9000", 200),
        ("localhost:9000", "http://localhost:9001", 403),
        ("localhost:9000", "http://127.0.0.1:9000", 403),
        ("localhost", "https://localhost:80", 403),
        ("localhost:9000", "https://evil.example", 403),
        ("localhost:9000", "null", 403),
        ("localhost:9000", "", 403),
        ("localhost:9000", "file://localhost:9000", 403),
        ("localhost:9000", "http://localhost:9000/", 403),
    ],
)
def test_the_origin_must_be_the_host(served: Served, host: str, origin: str, status: int) -> None:
    assert asked(served, "/", ("Origin", origin), host=host).status == status


def test_two_origins_are_refused(served: Served) -> None:
    own = ("Origin", "http://localhost")
    assert asked(served, "/", own).status == 200
    assert asked(served, "/", own, own).status == 403


@pytest.mark.parametrize("site", ["cross-site", "same-site", "new-site"])
def test_other_sites_may_only_link_to_a_page(served: Served, site: str) -> None:
    header = ("Sec-Fetch-Site", site)
    assert asked(served, "/", header, NAVIGATE, DOCUMENT).status == 200
    for more in (
        (),
        (NAVIGATE,),
        (DOCUMENT,),
        (NAVIGATE, ("Sec-Fetch-Dest", "iframe")),
        (("Sec-Fetch-Mode", "no-cors"), ("Sec-Fetch-Dest", "image")),
        (("Sec-Fetch-Mode", "no-cors"), ("Sec-Fetch-Dest", "script")),
        (("Sec-Fetch-Mode", "cors"), ("Sec-Fetch-Dest", "empty")),
    ):
        assert asked(served, "/", header, *more).status == 403


@pytest.mark.parametrize("site", ["same-origin", "none"])
def test_the_pages_may_ask_for_all(served: Served, site: str) -> None:
    image = (("Sec-Fetch-Mode", "no-cors"), ("Sec-Fetch-Dest", "image"))
    assert asked(served, "/", ("Sec-Fetch-Site", site), *image).status == 200


def test_a_link_with_the_token_may_come_from_a_mail(served: Served) -> None:
    cross = ("Sec-Fetch-Site", "cross-site")
    assert ask(served.port, f"/?token={served.token}", cross, NAVIGATE, DOCUMENT).status == 303
    assert ask(served.port, f"/?token={served.token}", cross).status == 403


@pytest.mark.parametrize(
    ("target", "headers", "method", "status"),
    [
        ("/", True, "GET", 200),
        ("/", True, "HEAD", 200),
        ("/missing", True, "GET", 404),
        ("/fail", True, "GET", 500),
        ("/", False, "GET", 401),
        ("/?token=wrong", False, "GET", 403),
        ("/", True, "POST", 405),
        ("*", True, "GET", 400),
    ],
)
def test_every_answer_has_the_headers(served: Served, target: str, headers: bool, method: str, status: int) -> None:
    answer = ask(served.port, target, *([cookie_of(served)] if headers else []), method=method)
    assert answer.status == status
    assert HEADERS.items() <= {name.encode(): value.encode() for name, value in answer.headers.items()}.items()
    assert "server" not in answer.headers
    assert HEADERS.keys() <= {name.encode() for name in ask(served.port, f"/?token={served.token}").headers}


def test_the_applications_own_headers_stay(served: Served) -> None:
    answer = asked(served, "/own")
    assert answer.headers["cache-control"] == "max-age=60"
    assert answer.headers["x-frame-options"] == "DENY"
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_failure_is_logged_and_the_server_goes_on(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    answer = asked(served, "/fail")
    assert answer.status == 500
    assert "no such page" not in answer.body
    assert "no such page" in caplog.text
    with pytest.raises(IncompleteRead):
        asked(served, "/half")
    assert asked(served).status == 200


def test_no_secret_is_logged(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG):
        for target in ("/", "/fail", "/missing", f"/?token={served.token}", f"/fail?token={served.token}x", "*"):
            asked(served, target)
        ask(served.port, f"/?token={served.token}", host="evil.example")
        ask(served.port, f"/?token={served.token}", ("Upgrade", "websocket"), ("Connection", "Upgrade"))
    assert "a page of the explorer failed" in caplog.text
    assert served.token not in caplog.text
    assert served.access.session not in caplog.text
    assert served.token not in repr(served)
    assert served.access.session not in repr(served)


def test_a_websocket_is_closed(served: Served) -> None:
    upgrade = (("Upgrade", "websocket"), ("Connection", "Upgrade"), ("Sec-WebSocket-Key", "x" * 24))
    assert ask(served.port, "/", *upgrade, ("Sec-WebSocket-Version", "13")).status == 401
    assert passed(TinyApp(), served.access, type="websocket") == [{"type": "websocket.close", "code": 1008}]


@pytest.mark.parametrize("host", ["hub.example.org", "hub.example.org:8443", "node17:8000", "localhost:8888"])
def test_below_a_root_path_any_host_is_known(start: START, host: str) -> None:
    served = start(root_path=ROOT)
    assert asked(served, host=host).status == 200
    assert asked(served, host="not a host").status == 400
    assert ask(served.port, host=host).status == 401


@pytest.mark.parametrize("root", [ROOT, ROOT + "/", URL])
@pytest.mark.parametrize(
    ("target", "path"),
    [
        ("/", "/ /"),
        ("/a/b", "/a/b /a/b"),
        (ROOT + "/", "/ /"),
        (ROOT + "/a%20b", "/a b /a%20b"),
        ("/user/m%65/proxy/8000/a", "/a /a"),
        (ROOT + "0/a", f"{ROOT}0/a {ROOT}0/a"),
        ("/user/me/proxy", "/user/me/proxy /user/me/proxy"),
        ("/user/me%2Fproxy/8000/a", f"{ROOT}/a /user/me%2Fproxy/8000/a"),
        (ROOT + ROOT + "/a", f"{ROOT}/a {ROOT}/a"),
        ("/x" + ROOT + "/a", f"/x{ROOT}/a /x{ROOT}/a"),
    ],
)
def test_a_root_path_is_taken_off_if_it_is_there(start: START, root: str, target: str, path: str) -> None:
    served = start(root_path=root)
    assert asked(served, target, host="hub.example.org").body == path


def test_the_root_path_itself_gets_a_slash(start: START) -> None:
    served = start(root_path=ROOT)
    answer = asked(served, ROOT + "?x=1")
    assert (answer.status, answer.headers["location"]) == (308, "./8000/?x=1")
    answer = ask(served.port, f"{ROOT}?token={served.token}")
    assert (answer.status, answer.headers["location"]) == (303, "./8000")


@pytest.mark.parametrize(
    ("root", "target", "host", "attributes"),
    [
        (ROOT, "/", "hub.example.org", [f"Path={ROOT}"]),
        (ROOT, ROOT + "/", "hub.example.org", [f"Path={ROOT}"]),
        (ROOT, ROOT + "/", "localhost:8888", [f"Path={ROOT}"]),
        (ROOT, "/", "localhost:9000", ["Path=/"]),
        (URL, "/", "hub.example.org", [f"Path={ROOT}", "Secure"]),
        (URL, ROOT + "/", "localhost:9000", [f"Path={ROOT}"]),
        ("https://hub.example.org", "/", "hub.example.org", ["Path=/", "Secure"]),
    ],
)
def test_the_cookie_is_for_the_root_path(
    start: START, root: str, target: str, host: str, attributes: list[str]
) -> None:
    served = start(root_path=root)
    answer = ask(served.port, f"{target}?token={served.token}", host=host)
    assert answer.headers["location"] == "./"
    found = answer.headers["set-cookie"].split("; ")[1:]
    assert [each for each in found if each not in ("HttpOnly", "SameSite=Lax")] == attributes


def test_a_root_path_as_url_names_the_host_and_the_origin(start: START) -> None:
    served = start(root_path=URL)
    for host in ("hub.example.org", "hub.example.org:443", "HUB.example.org", "localhost:9000"):
        assert asked(served, host=host).status == 200
        assert asked(served, "/", ("Origin", "https://hub.example.org"), host=host).status == 200
        assert asked(served, "/", ("Origin", "https://evil.example"), host=host).status == 403
    assert asked(served, "/", ("Origin", "http://hub.example.org:8000"), host="localhost").status == 403
    for host in ("evil.example", "example.org", "x.hub.example.org", "node17:8000"):
        assert asked(served, host=host).status == 400


def test_the_hosts_of_a_server_for_the_network(start: START, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("socket.gethostname", lambda: "Node17")
        patch.setattr("socket.getfqdn", lambda: "node17.cluster.example")
        served = start(host=ANYWHERE)
    for host in ("localhost", "node17:9000", "NODE17.cluster.example", "192.0.2.1", "[2001:db8::1]:80", ANYWHERE):
        assert asked(served, host=host).status == 200
    for host in ("evil.example", "cluster.example", "node18"):
        assert asked(served, host=host).status == 400


def test_a_named_host_is_known_with_its_address() -> None:
    access = Access(port=1, names=frozenset({"node17", "192.0.2.1"}))
    known = {host: access.knows(HostPort(host, 9)) for host in ("node17", "192.0.2.1", "192.0.2.2", "localhost")}
    assert known == {"node17": True, "192.0.2.1": True, "192.0.2.2": False, "localhost": True}


@pytest.mark.parametrize(
    "root",
    [
        "user/me", "//hub.example.org/x", "/a//b", "/a b", "/a;b", "/a?b", "/a#b", "/é", "https://", "https:///x",
        "https://me@hub.example.org/x", "https://hub.example.org/x?y", "ftp://hub.example.org/x", "https://[::1/x",
        "https://hub.example.org:99999/", "hub.example.org/x", "/a\n",
    ],
)  # fmt: skip
def test_a_root_path_that_is_none_is_refused(root: str) -> None:
    with pytest.raises(ConfigError, match=r"--root-path: expected a path such as .* or a URL such as"):
        RootPath.parse(root)


@pytest.mark.parametrize("root", ["", "/a/b", "/user/me%40example.org/x", "https://[::1]:8443/a", "http://h"])
def test_a_root_path_is_written_as_it_was_read(root: str) -> None:
    assert str(RootPath.parse(root)) == root
    assert RootPath.parse(root + "/") == RootPath.parse(root)
    assert RootPath.parse(root).path == urlsplit(root).path
