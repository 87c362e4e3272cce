import asyncio
import functools
import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from http.client import IncompleteRead
from typing import Any

import pytest
from support.expected_errors import assert_raises
from support.explorer_requests import HttpResponse, TinyApp, send_request, session_cookie
from support.text_contents import contained_parts, missing_parts

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

ROOT_PATH = "/user/me/proxy/8000"
ROOT_URL = f"https://hub.example.org{ROOT_PATH}"
NAVIGATE, DOCUMENT = ("Sec-Fetch-Mode", "navigate"), ("Sec-Fetch-Dest", "document")
ANYWHERE = "0.0.0.0"  # noqa: S104
StartServer = Callable[..., Served]
LOCAL_HOSTS = ("localhost", "LocalHost", "127.0.0.1", "[::1]", "[0:0:0:0:0:0:0:1]")
OTHER_SITES = ("cross-site", "same-site", "new-site")
SAME_ORIGIN = ("Origin", "http://localhost")
IMAGE_REQUEST = (("Sec-Fetch-Mode", "no-cors"), ("Sec-Fetch-Dest", "image"))
Headers = tuple[tuple[str, str], ...]


@pytest.fixture(scope="module")
def start_server() -> Iterator[StartServer]:
    """Return a function that starts a server of the tiny application, once for equal arguments."""
    with ExitStack() as stack:

        @functools.cache
        def start(**arguments: str) -> Served:
            server: AbstractContextManager[Served] = serving(TinyApp(), port=0, **arguments)
            return stack.enter_context(server)

        yield start


@pytest.fixture
def served(start_server: StartServer) -> Served:
    return start_server()


def send_with_cookie(
    served: Served, target: str = "/", *headers: tuple[str, str], **options: Any
) -> HttpResponse:
    """Send a request as a browser that has the cookie."""
    return send_request(served.port, target, session_cookie(served), *headers, **options)


def gate_messages(gate: Gate, **changes: Any) -> list[AsgiMessage]:
    """Return the messages of a gate for a request that no client library would send."""
    messages: list[AsgiMessage] = []
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
        messages.append(message)

    asyncio.run(gate(scope, receive, send))
    return messages


def test_the_right_token_becomes_a_cookie(served: Served) -> None:
    response = send_request(served.port, f"/?token={served.token}")
    assert (response.status, response.headers["location"], response.body) == (303, "./", "")
    assert response.headers["cache-control"] == "no-store"
    cookie, *attributes = response.headers["set-cookie"].split("; ")
    assert cookie.partition("=")[0] == f"deepaccident_explore_{served.port}"
    assert attributes == ["Path=/", "HttpOnly", "SameSite=Lax"]
    assert served.token not in cookie
    assert send_request(served.port, "/page", ("Cookie", response.cookie)).body == "/page /page"
    assert send_request(served.port, f"/?token={served.token}", method="HEAD").status == 303


@pytest.mark.parametrize(
    "query", ["token=wrong", "token=", "token", "token={0}x", "token={0}&token={0}", "token=%ff"]
)
def test_a_wrong_token_is_refused_even_with_a_cookie(served: Served, query: str) -> None:
    response = send_with_cookie(served, "/?" + query.format(served.token))
    assert response.status == 403
    assert "set-cookie" not in response.headers
    assert "The token is wrong" in response.body


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
    response = send_request(served.port, target.format(f"{name}={served.token}"))
    assert (response.status, response.headers["location"]) == (303, location)


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
    assert send_request(served.port, "/", ("Cookie", value)).status == status


def test_a_ticket_is_right_once_and_for_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    access = Access(port=1)
    gate = Gate(TinyApp(), access)

    def status(token: str) -> int:
        query = f"token={token}".encode()
        start, *_ = gate_messages(gate, query_string=query, headers=[(b"host", b"localhost")])
        return int(start["status"])

    ticket = gate.ticket()
    assert [status(ticket), status(ticket)] == [303, 403]
    monkeypatch.setattr("deepaccident_devkit.plugins.explore.access.TICKET_SECONDS", -0.001)
    assert [status(gate.ticket()), status(access.token)] == [403, 303]


def test_the_application_gets_no_cookies_and_no_token() -> None:
    app, access = TinyApp(), Access(port=1)
    cookie = f"{access.cookie}={access.session}; other=1".encode()
    headers = [(b"host", b"localhost"), (b"Cookie", cookie), (b"a", b"b")]
    gate_messages(Gate(app, access), path="/a é", headers=headers)
    scope = app.scopes[0]
    assert scope["headers"] == [(b"host", b"localhost"), (b"a", b"b")]
    assert scope["path"] == "/a é"
    assert scope["raw_path"] == b"/a%20%C3%A9"


def test_only_get_and_head_are_answered(served: Served) -> None:
    head = send_with_cookie(served, "/page", method="HEAD")
    refused_head = send_request(served.port, method="HEAD")
    assert (head.status, head.body) == (200, "")
    assert (refused_head.status, refused_head.body) == (401, "")
    refused_get = send_request(served.port)
    assert int(refused_head.headers["content-length"]) == len(refused_get.body)
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "TRACE", "get"):
        response = send_with_cookie(served, method=method)
        assert (response.status, response.headers["allow"]) == (405, "GET, HEAD")


def fetch_headers(site: str, *headers: tuple[str, str]) -> Headers:
    return (("Sec-Fetch-Site", site), *headers)


@pytest.mark.parametrize(
    ("status", "headers", "request_options"),
    [
        # a tunnel may have another port
        *(
            (200, (), {"host": host + port})
            for host in LOCAL_HOSTS
            for port in ("", ":9000")
        ),
        # exactly one host is required
        (400, (("Host", "localhost"),), {}),
        (400, (), {"host": None}),
        # a target that is no path is refused
        *(
            (400, (), {"target": target})
            for target in ("http://localhost:{0}/", "http://evil.example/", "localhost:{0}", "*", "page")  # noqa: E501
        ),
        # the origin must be the host
        (200, (("Origin", "http://localhost:9000"),), {"host": "localhost:9000"}),
        (200, (("Origin", "http://[::1]:9000"),), {"host": "[::1]:9000"}),
        *(
            (200, (("Origin", origin),), {})
            for origin in ("http://localhost", "http://localhost:80", "https://localhost:443")
        ),
        (403, (("Origin", "https://localhost:80"),), {}),
        *(
            (403, (("Origin", origin),), {"host": "localhost:9000"})
            for origin in (
                "http://localhost:9001", "http://127.0.0.1:9000", "https://evil.example", "null", "",  # noqa: E501
                "file://localhost:9000", "http://localhost:9000/",
            )
        ),
        (403, (SAME_ORIGIN, SAME_ORIGIN), {}),
        # other sites may only link to a page; the pages themselves may request everything
        *((200, fetch_headers(site, *IMAGE_REQUEST), {}) for site in ("same-origin", "none")),
        *((200, fetch_headers(site, NAVIGATE, DOCUMENT), {}) for site in OTHER_SITES),
        *(
            (403, fetch_headers(site, *headers), {})
            for site in OTHER_SITES
            for headers in (
                (),
                (NAVIGATE,),
                (DOCUMENT,),
                (NAVIGATE, ("Sec-Fetch-Dest", "iframe")),
                IMAGE_REQUEST,
                (("Sec-Fetch-Mode", "no-cors"), ("Sec-Fetch-Dest", "script")),
                (("Sec-Fetch-Mode", "cors"), ("Sec-Fetch-Dest", "empty")),
            )
        ),
    ],
)  # fmt: skip
def test_hosts_targets_and_origins_decide_whether_a_request_is_answered(
    served: Served, status: int, headers: Headers, request_options: dict[str, Any]
) -> None:
    target = request_options.get("target", "/").format(served.port)
    host = request_options.get("host", "localhost")
    assert send_with_cookie(served, target, *headers, host=host).status == status


@pytest.mark.parametrize(
    "host",
    [
        "evil.example", "evil.example:{0}", "localhost.evil.example", "localhost.", "127.0.0.1.evil.example", ANYWHERE,  # noqa: E501
        "192.0.2.1:{0}", "[::2]", "", ":{0}", "localhost:", "localhost:x", "localhost:99999", "me@localhost", "[::1",  # noqa: E501
        "[:]", "::1", "localhost/x", "localhost,localhost", "127.1", "2130706433",
    ],
)  # fmt: skip
def test_another_host_is_refused(served: Served, host: str) -> None:
    target = f"/?token={served.token}"
    response = send_with_cookie(served, target, host=host.format(served.port))
    assert (response.status, "evil" in response.body) == (400, False)
    assert not missing_parts(response.body, "--root-path", "--address")


def test_a_link_with_the_token_may_come_from_a_mail(served: Served) -> None:
    target = f"/?token={served.token}"
    link = fetch_headers("cross-site", NAVIGATE, DOCUMENT)
    assert send_request(served.port, target, *link).status == 303
    assert send_request(served.port, target, *fetch_headers("cross-site")).status == 403


@pytest.mark.parametrize(
    ("target", "has_cookie", "method", "status"),
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
    served: Served, target: str, has_cookie: bool, method: str, status: int
) -> None:
    request_headers = [session_cookie(served)] if has_cookie else []
    response = send_request(served.port, target, *request_headers, method=method)
    assert (response.status, "server" in response.headers) == (status, False)
    headers = {name.encode(): value.encode() for name, value in response.headers.items()}
    assert HEADERS.items() <= headers.items()
    redirect = send_request(served.port, f"/?token={served.token}")
    assert HEADERS.keys() <= {name.encode() for name in redirect.headers}


def test_a_failure_is_logged_and_the_server_goes_on(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    response = send_with_cookie(served, "/fail")
    assert (response.status, "no such page" in response.body) == (500, False)
    assert "no such page" in caplog.text
    with pytest.raises(IncompleteRead):
        send_with_cookie(served, "/half")
    assert send_with_cookie(served).status == 200


def test_no_secret_is_logged(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    correct_target = f"/?token={served.token}"
    with caplog.at_level(logging.DEBUG):
        for target in (
            "/",
            "/fail",
            "/missing",
            correct_target,
            f"/fail?token={served.token}x",
            "*",
        ):
            send_with_cookie(served, target)
        send_request(served.port, correct_target, host="evil.example")
        send_request(
            served.port, correct_target, ("Upgrade", "websocket"), ("Connection", "Upgrade")
        )
    assert "a page of the explorer failed" in caplog.text
    assert not contained_parts(caplog.text + repr(served), served.token, served.access.session)


def test_a_websocket_is_closed(served: Served) -> None:
    upgrade_headers = (
        ("Upgrade", "websocket"),
        ("Connection", "Upgrade"),
        ("Sec-WebSocket-Key", "x" * 24),
        ("Sec-WebSocket-Version", "13"),
    )
    assert send_request(served.port, "/", *upgrade_headers).status == 401
    messages = gate_messages(Gate(TinyApp(), served.access), type="websocket")
    assert messages == [{"type": "websocket.close", "code": 1008}]


@pytest.mark.parametrize(
    "host", ["hub.example.org", "hub.example.org:8443", "node17:8000", "localhost:8888"]
)
def test_below_a_root_path_any_host_is_known(start_server: StartServer, host: str) -> None:
    served = start_server(root_path=ROOT_PATH)
    assert send_with_cookie(served, host=host).status == 200
    assert send_with_cookie(served, host="not a host").status == 400
    assert send_request(served.port, host=host).status == 401


@pytest.mark.parametrize("root", [ROOT_PATH, ROOT_PATH + "/", ROOT_URL])
@pytest.mark.parametrize(
    ("target", "path"),
    [
        ("/", "/ /"),
        ("/a/b", "/a/b /a/b"),
        (ROOT_PATH + "/", "/ /"),
        (ROOT_PATH + "/a%20b", "/a b /a%20b"),
        ("/user/m%65/proxy/8000/a", "/a /a"),
        (ROOT_PATH + "0/a", f"{ROOT_PATH}0/a {ROOT_PATH}0/a"),
        ("/user/me/proxy", "/user/me/proxy /user/me/proxy"),
        ("/user/me%2Fproxy/8000/a", f"{ROOT_PATH}/a /user/me%2Fproxy/8000/a"),
        (ROOT_PATH + ROOT_PATH + "/a", f"{ROOT_PATH}/a {ROOT_PATH}/a"),
        ("/x" + ROOT_PATH + "/a", f"/x{ROOT_PATH}/a /x{ROOT_PATH}/a"),
    ],
)
def test_a_root_path_is_removed_if_present(
    start_server: StartServer, root: str, target: str, path: str
) -> None:
    served = start_server(root_path=root)
    assert send_with_cookie(served, target, host="hub.example.org").body == path


def test_the_root_path_itself_gets_a_slash(start_server: StartServer) -> None:
    served = start_server(root_path=ROOT_PATH)
    page = send_with_cookie(served, ROOT_PATH + "?x=1")
    login = send_request(served.port, f"{ROOT_PATH}?token={served.token}")
    assert (page.status, page.headers["location"]) == (308, "./8000/?x=1")
    assert (login.status, login.headers["location"]) == (303, "./8000")


@pytest.mark.parametrize(
    ("root", "target", "host", "attributes"),
    [
        (ROOT_PATH, "/", "hub.example.org", [f"Path={ROOT_PATH}"]),
        (ROOT_PATH, ROOT_PATH + "/", "hub.example.org", [f"Path={ROOT_PATH}"]),
        (ROOT_PATH, ROOT_PATH + "/", "localhost:8888", [f"Path={ROOT_PATH}"]),
        (ROOT_PATH, "/", "localhost:9000", ["Path=/"]),
        (ROOT_URL, "/", "hub.example.org", [f"Path={ROOT_PATH}", "Secure"]),
        (ROOT_URL, ROOT_PATH + "/", "localhost:9000", [f"Path={ROOT_PATH}"]),
        ("https://hub.example.org", "/", "hub.example.org", ["Path=/", "Secure"]),
    ],
)
def test_the_cookie_is_for_the_root_path(
    start_server: StartServer, root: str, target: str, host: str, attributes: list[str]
) -> None:
    served = start_server(root_path=root)
    headers = send_request(served.port, f"{target}?token={served.token}", host=host).headers
    _, *cookie_attributes = headers["set-cookie"].split("; ")
    constant_attributes = ("HttpOnly", "SameSite=Lax")
    assert headers["location"] == "./"
    assert [word for word in cookie_attributes if word not in constant_attributes] == attributes


HUB = "hub.example.org"
HUB_HOSTS = (HUB, f"{HUB}:443", HUB.upper(), "localhost:9000")


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        *((host, None, 200) for host in HUB_HOSTS),
        *((host, f"https://{HUB}", 200) for host in HUB_HOSTS),
        *((host, "https://evil.example", 403) for host in HUB_HOSTS),
        ("localhost", f"http://{HUB}:8000", 403),
        *((host, None, 400) for host in ("evil.example", "example.org", f"x.{HUB}", "node17:8000")),
    ],
)
def test_a_root_path_as_url_names_the_host_and_the_origin(
    start_server: StartServer, host: str, origin: str | None, status: int
) -> None:
    served = start_server(root_path=ROOT_URL)
    headers = [] if origin is None else [("Origin", origin)]
    assert send_with_cookie(served, "/", *headers, host=host).status == status


def test_the_hosts_of_a_server_for_the_network(
    start_server: StartServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("socket.gethostname", lambda: "Node17")
        patch.setattr("socket.getfqdn", lambda: "node17.cluster.example")
        served = start_server(host=ANYWHERE)
    known_hosts = (
        "localhost",
        "node17:9000",
        "NODE17.cluster.example",
        "192.0.2.1",
        "[2001:db8::1]:80",
        ANYWHERE,
    )
    for host in known_hosts:
        assert send_with_cookie(served, host=host).status == 200, host
    for host in ("evil.example", "cluster.example", "node18"):
        assert send_with_cookie(served, host=host).status == 400, host


def test_a_named_host_is_known_with_its_address() -> None:
    access = Access(port=1, names=frozenset({"node17", "192.0.2.1"}))
    for host in ("node17", "192.0.2.1", "localhost"):
        assert access.knows(HostPort(host, 9))
    assert not access.knows(HostPort("192.0.2.2", 9))


@pytest.mark.parametrize(
    "root",
    [
        "user/me", "//hub.example.org/x", "/a//b", "/a b", "/a;b", "/a?b", "/a#b", "/é", "https://", "https:///x",  # noqa: E501
        "https://me@hub.example.org/x", "https://hub.example.org/x?y", "ftp://hub.example.org/x", "https://[::1/x",
        "https://hub.example.org:99999/", "hub.example.org/x", "/a\n",
    ],
)  # fmt: skip
def test_an_invalid_root_path_is_refused(root: str) -> None:
    message_parts = ("--root-path", "a path such as", "a URL such as")
    assert_raises((lambda: RootPath.parse(root), ConfigError, message_parts))
