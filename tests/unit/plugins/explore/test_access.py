import asyncio
import functools
import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from http.client import IncompleteRead
from typing import Any

import pytest
from asking import Answer, TinyApp, ask, cookie_of
from refusals import assert_refused
from wording import holding, lacking

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.explore.access import (
    HEADERS,
    Access,
    AsgiMessage,
    Gate,
    HostPort,
    RootPath,
)
from deepaccident_devkit.plugins.explore.serving import Served, serving

ROOT = "/user/me/proxy/8000"
URL = f"https://hub.example.org{ROOT}"
NAVIGATE, DOCUMENT = ("Sec-Fetch-Mode", "navigate"), ("Sec-Fetch-Dest", "document")
ANYWHERE = "0.0.0.0"  # noqa: S104
START = Callable[..., Served]
HERE = ("Origin", "http://localhost")
IMAGE = (("Sec-Fetch-Mode", "no-cors"), ("Sec-Fetch-Dest", "image"))
Headers = tuple[tuple[str, str], ...]


@pytest.fixture(scope="module")
def start() -> Iterator[START]:
    """Servers of the tiny application by their arguments, each started once."""
    with ExitStack() as stack:

        @functools.cache
        def started(**arguments: str) -> Served:
            opened: AbstractContextManager[Served] = serving(TinyApp(), port=0, **arguments)
            return stack.enter_context(opened)

        yield started


@pytest.fixture
def served(start: START) -> Served:
    return start()


def asked(served: Served, target: str = "/", *headers: tuple[str, str], **more: Any) -> Answer:
    """The answer to a reader who has the cookie."""
    return ask(served.port, target, cookie_of(served), *headers, **more)


def passed(gate: Gate, **changes: Any) -> list[AsgiMessage]:
    """What a gate sends for a request that no client library would make."""
    sent: list[AsgiMessage] = []
    scope = {
        "type": "http",
        "method": "GET",
        "path": "/",
        "query_string": b"",
        "headers": [],
        **changes,
    }

    async def receive() -> AsgiMessage:
        return {"type": "websocket.connect"}

    async def send(message: AsgiMessage) -> None:
        sent.append(message)

    asyncio.run(gate(scope, receive, send))
    return sent


def test_the_right_token_becomes_a_cookie(served: Served) -> None:
    answer = ask(served.port, f"/?token={served.token}")
    assert (answer.status, answer.headers["location"], answer.body) == (303, "./", "")
    assert answer.headers["cache-control"] == "no-store"
    cookie, *attributes = answer.headers["set-cookie"].split("; ")
    assert (cookie.partition("=")[0], attributes) == (
        f"deepaccident_explore_{served.port}",
        ["Path=/", "HttpOnly", "SameSite=Lax"],
    )
    assert served.token not in cookie
    assert ask(served.port, "/page", ("Cookie", answer.cookie)).body == "/page /page"
    assert ask(served.port, f"/?token={served.token}", method="HEAD").status == 303


@pytest.mark.parametrize(
    "query", ["token=wrong", "token=", "token", "token={0}x", "token={0}&token={0}", "token=%ff"]
)
def test_a_wrong_token_is_refused_even_with_a_cookie(served: Served, query: str) -> None:
    answer = asked(served, "/?" + query.format(served.token))
    assert (answer.status, "set-cookie" in answer.headers, "The token is wrong" in answer.body) == (
        403,
        False,
        True,
    )


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
def test_the_address_without_the_token_is_relative(
    served: Served, target: str, location: str, name: str
) -> None:
    answer = ask(served.port, target.format(f"{name}={served.token}"))
    assert (answer.status, answer.headers["location"]) == (303, location)


@pytest.mark.parametrize(
    ("cookie", "status"),
    [
        ("{name}={session}", 200),
        ("other=1; {name}={session}; last", 200),
        ("{name}=tossed; {name}={session}", 200),
        ("{name}={session}x", 401),
        ("deepaccident_explore_1={session}", 401),
        ("{name}={token}", 401),
        ("{name}=é", 401),
    ],
)
def test_a_cookie_opens_the_pages(served: Served, cookie: str, status: int) -> None:
    access = served.access
    value = cookie.format(name=access.cookie, session=access.session, token=served.token)
    assert ask(served.port, "/", ("Cookie", value)).status == status


def test_a_ticket_is_right_once_and_for_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    access = Access(port=1)
    gate = Gate(TinyApp(), access)

    def status(token: str) -> int:
        return int(
            passed(gate, query_string=f"token={token}".encode(), headers=[(b"host", b"localhost")])[
                0
            ]["status"]
        )

    ticket = gate.ticket()
    assert [status(ticket), status(ticket)] == [303, 403]
    monkeypatch.setattr("deepaccident_devkit.plugins.explore.access.TICKET_SECONDS", -0.001)
    assert [status(gate.ticket()), status(access.token)] == [403, 303]


def test_the_application_gets_no_cookies_and_no_token() -> None:
    app, access = TinyApp(), Access(port=1)
    cookie = f"{access.cookie}={access.session}; other=1".encode()
    passed(
        Gate(app, access),
        path="/a é",
        headers=[(b"host", b"localhost"), (b"Cookie", cookie), (b"a", b"b")],
    )
    told = {name: app.scopes[0][name] for name in ("headers", "path", "raw_path")}
    assert told == {
        "headers": [(b"host", b"localhost"), (b"a", b"b")],
        "path": "/a é",
        "raw_path": b"/a%20%C3%A9",
    }


def test_only_get_and_head_are_answered(served: Served) -> None:
    head, refused = asked(served, "/page", method="HEAD"), ask(served.port, method="HEAD")
    assert (head.status, head.body, refused.status, refused.body) == (200, "", 401, "")
    assert int(refused.headers["content-length"]) == len(ask(served.port).body)
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "TRACE", "get"):
        answer = asked(served, method=method)
        assert (answer.status, answer.headers["allow"]) == (405, "GET, HEAD")


def fetched(site: str, *more: tuple[str, str]) -> Headers:
    return (("Sec-Fetch-Site", site), *more)


@pytest.mark.parametrize(
    ("status", "headers", "how"),
    [
        # a tunnel may have another port
        *(
            (200, (), {"host": host + port})
            for host in ("localhost", "LocalHost", "127.0.0.1", "[::1]", "[0:0:0:0:0:0:0:1]")
            for port in ("", ":9000")
        ),
        # the host must be there once
        (400, (("Host", "localhost"),), {}),
        (400, (), {"host": None}),
        # a request for no path is refused
        *(
            (400, (), {"target": target})
            for target in ("http://localhost:{0}/", "http://evil.example/", "localhost:{0}", "*", "page")  # noqa: E501
        ),
        # the origin must be the host
        (200, (("Origin", "http://localhost:9000"),), {"host": "localhost:9000"}),
        (200, (("Origin", "http://[::1]:9000"),), {"host": "[::1]:9000"}),
        *((200, (("Origin", f"{origin}"),), {}) for origin in (HERE[1], f"{HERE[1]}:80", "https://localhost:443")),
        (403, (("Origin", "https://localhost:80"),), {}),
        *(
            (403, (("Origin", origin),), {"host": "localhost:9000"})
            for origin in (
                "http://localhost:9001", "http://127.0.0.1:9000", "https://evil.example", "null", "",  # noqa: E501
                "file://localhost:9000", "http://localhost:9000/",
            )
        ),
        (403, (HERE, HERE), {}),
        # other sites may only link to a page, and the pages ask for all
        *((200, fetched(site, *IMAGE), {}) for site in ("same-origin", "none")),
        *((200, fetched(site, NAVIGATE, DOCUMENT), {}) for site in ("cross-site", "same-site", "new-site")),  # noqa: E501
        *(
            (403, fetched(site, *more), {})
            for site in ("cross-site", "same-site", "new-site")
            for more in (
                (),
                (NAVIGATE,),
                (DOCUMENT,),
                (NAVIGATE, ("Sec-Fetch-Dest", "iframe")),
                IMAGE,
                (("Sec-Fetch-Mode", "no-cors"), ("Sec-Fetch-Dest", "script")),
                (("Sec-Fetch-Mode", "cors"), ("Sec-Fetch-Dest", "empty")),
            )
        ),
    ],
)  # fmt: skip
def test_who_is_answered(
    served: Served, status: int, headers: Headers, how: dict[str, Any]
) -> None:
    target = how.get("target", "/").format(served.port)
    assert asked(served, target, *headers, host=how.get("host", "localhost")).status == status


@pytest.mark.parametrize(
    "host",
    [
        "evil.example", "evil.example:{0}", "localhost.evil.example", "localhost.", "127.0.0.1.evil.example", ANYWHERE,  # noqa: E501
        "192.0.2.1:{0}", "[::2]", "", ":{0}", "localhost:", "localhost:x", "localhost:99999", "me@localhost", "[::1",  # noqa: E501
        "[:]", "::1", "localhost/x", "localhost,localhost", "127.1", "2130706433",
    ],
)  # fmt: skip
def test_another_host_is_refused(served: Served, host: str) -> None:
    answer = asked(served, f"/?token={served.token}", host=host.format(served.port))
    assert (answer.status, "evil" in answer.body) == (400, False)
    assert not lacking(answer.body, "--root-path", "--address")


def test_a_link_with_the_token_may_come_from_a_mail(served: Served) -> None:
    target, headers = f"/?token={served.token}", fetched("cross-site", NAVIGATE, DOCUMENT)
    assert [ask(served.port, target, *headers[:count]).status for count in (3, 1)] == [303, 403]


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
def test_every_answer_has_the_headers(
    served: Served, target: str, headers: bool, method: str, status: int
) -> None:
    answer = ask(served.port, target, *([cookie_of(served)] if headers else []), method=method)
    assert (answer.status, "server" in answer.headers) == (status, False)
    assert (
        HEADERS.items()
        <= {name.encode(): value.encode() for name, value in answer.headers.items()}.items()
    )
    assert HEADERS.keys() <= {
        name.encode() for name in ask(served.port, f"/?token={served.token}").headers
    }


def test_a_failure_is_logged_and_the_server_goes_on(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    answer = asked(served, "/fail")
    assert (answer.status, "no such page" in answer.body, "no such page" in caplog.text) == (
        500,
        False,
        True,
    )
    with pytest.raises(IncompleteRead):
        asked(served, "/half")
    assert asked(served).status == 200


def test_no_secret_is_logged(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    right = f"/?token={served.token}"
    with caplog.at_level(logging.DEBUG):
        for target in ("/", "/fail", "/missing", right, f"/fail?token={served.token}x", "*"):
            asked(served, target)
        ask(served.port, right, host="evil.example")
        ask(served.port, right, ("Upgrade", "websocket"), ("Connection", "Upgrade"))
    assert "a page of the explorer failed" in caplog.text
    assert not holding(caplog.text + repr(served), served.token, served.access.session)


def test_a_websocket_is_closed(served: Served) -> None:
    upgrade = (("Upgrade", "websocket"), ("Connection", "Upgrade"), ("Sec-WebSocket-Key", "x" * 24))
    assert ask(served.port, "/", *upgrade, ("Sec-WebSocket-Version", "13")).status == 401
    assert passed(Gate(TinyApp(), served.access), type="websocket") == [
        {"type": "websocket.close", "code": 1008}
    ]


@pytest.mark.parametrize(
    "host", ["hub.example.org", "hub.example.org:8443", "node17:8000", "localhost:8888"]
)
def test_below_a_root_path_any_host_is_known(start: START, host: str) -> None:
    served = start(root_path=ROOT)
    answers = (
        asked(served, host=host),
        asked(served, host="not a host"),
        ask(served.port, host=host),
    )
    assert [each.status for each in answers] == [200, 400, 401]


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
def test_a_root_path_is_taken_off_if_it_is_there(
    start: START, root: str, target: str, path: str
) -> None:
    assert asked(start(root_path=root), target, host="hub.example.org").body == path


def test_the_root_path_itself_gets_a_slash(start: START) -> None:
    served = start(root_path=ROOT)
    answers = asked(served, ROOT + "?x=1"), ask(served.port, f"{ROOT}?token={served.token}")
    assert [(each.status, each.headers["location"]) for each in answers] == [
        (308, "./8000/?x=1"),
        (303, "./8000"),
    ]


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
    headers = ask(served.port, f"{target}?token={served.token}", host=host).headers
    found = [
        each
        for each in headers["set-cookie"].split("; ")[1:]
        if each not in ("HttpOnly", "SameSite=Lax")
    ]
    assert (headers["location"], found) == ("./", attributes)


HUB = "hub.example.org"


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        *((host, None, 200) for host in (HUB, f"{HUB}:443", HUB.upper(), "localhost:9000")),
        *(
            (host, f"https://{HUB}", 200)
            for host in (HUB, f"{HUB}:443", HUB.upper(), "localhost:9000")
        ),
        *(
            (host, "https://evil.example", 403)
            for host in (HUB, f"{HUB}:443", HUB.upper(), "localhost:9000")
        ),
        ("localhost", f"http://{HUB}:8000", 403),
        *((host, None, 400) for host in ("evil.example", "example.org", f"x.{HUB}", "node17:8000")),
    ],
)
def test_a_root_path_as_url_names_the_host_and_the_origin(
    start: START, host: str, origin: str | None, status: int
) -> None:
    headers = [] if origin is None else [("Origin", origin)]
    assert asked(start(root_path=URL), "/", *headers, host=host).status == status


def test_the_hosts_of_a_server_for_the_network(
    start: START, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("socket.gethostname", lambda: "Node17")
        patch.setattr("socket.getfqdn", lambda: "node17.cluster.example")
        served = start(host=ANYWHERE)
    known = (
        "localhost",
        "node17:9000",
        "NODE17.cluster.example",
        "192.0.2.1",
        "[2001:db8::1]:80",
        ANYWHERE,
    )
    statuses = {
        host: asked(served, host=host).status
        for host in (*known, "evil.example", "cluster.example", "node18")
    }
    assert statuses == {host: 200 if host in known else 400 for host in statuses}


def test_a_named_host_is_known_with_its_address() -> None:
    access = Access(port=1, names=frozenset({"node17", "192.0.2.1"}))
    known = {
        host: access.knows(HostPort(host, 9))
        for host in ("node17", "192.0.2.1", "192.0.2.2", "localhost")
    }
    assert known == {"node17": True, "192.0.2.1": True, "192.0.2.2": False, "localhost": True}


@pytest.mark.parametrize(
    "root",
    [
        "user/me", "//hub.example.org/x", "/a//b", "/a b", "/a;b", "/a?b", "/a#b", "/é", "https://", "https:///x",  # noqa: E501
        "https://me@hub.example.org/x", "https://hub.example.org/x?y", "ftp://hub.example.org/x", "https://[::1/x",
        "https://hub.example.org:99999/", "hub.example.org/x", "/a\n",
    ],
)  # fmt: skip
def test_a_root_path_that_is_none_is_refused(root: str) -> None:
    assert_refused(
        (
            lambda: RootPath.parse(root),
            ConfigError,
            ("--root-path", "a path such as", "a URL such as"),
        )
    )
