"""Answers: pages from templates, pictures, styles and scripts, and who may keep them how long.

Styles and scripts have addresses that change with their content, so that browsers may keep them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Final
from urllib.parse import quote, urlencode

from markupsafe import Markup
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import Route

from deepaccident_devkit.plugins.explore.explorer import Explorer
from deepaccident_devkit.render.captions import scenario_words
from deepaccident_devkit.render.replay import replay_script, replay_style
from deepaccident_devkit.render.styles import page_style
from deepaccident_devkit.support.pages import part, path_in_address
from deepaccident_devkit.support.pages import rendered as filled
from deepaccident_devkit.support.scripts import bundled

# A browser may keep pictures for some minutes: files of a release seldom change.
KEPT: Final = "private, max-age=600"
_FOREVER: Final = "private, max-age=31536000, immutable"
_LAST_PAGE: Final = 1_000_000
# Those that pages load; they import the other ones beside them.
_SCRIPTS: Final = ("copy", "keys", "list", "moment", "parts", "twins", "waiting")
_KINDS: Final = {"css": "text/css", "js": "text/javascript"}


def explorer_of(request: Request) -> Explorer:
    """The explorer whose pages these are."""
    explorer: Explorer = request.app.state.explorer
    return explorer


def root_of(path: str) -> str:
    """The relative address of the first page from another one: `../../` from `/scenario/a`."""
    return "../" * (path.count("/") - 1) or "./"


def page(request: Request, template: str, *, status: int = 200, **context: Any) -> Response:
    """A page from a template."""
    root = root_of(request.scope["path"])
    return HTMLResponse(
        rendered_page(explorer_of(request), template, root, **context), status_code=status
    )


def rendered_page(explorer: Explorer, template: str, root: str, **context: Any) -> str:
    """A template as text, given the relative address of the first page (`root`); all texts are escaped."""
    addresses: dict[str, Any] = {
        "asset": asset,
        "scenario_at": scenario_address,
        "thumbnail_at": thumbnail_address,
    }
    addresses["named"] = lambda token: scenario_words(explorer.dataset.scenario.get(token))
    served = {
        "root": root,
        "models": [*explorer.models],
        "static": False,
        "frame_number": frame_button,
    }
    return filled(template, **addresses, **served, **context)


async def with_slash(request: Request) -> Response:
    """The address of a folder ends in a slash, so that the addresses in its page are below it."""
    query = f"?{request.url.query}" if request.url.query else ""
    last = quote(request.scope["path"].rsplit("/", 1)[1], safe="")
    return RedirectResponse(f"./{last}/{query}", status_code=307)


def picture(content: bytes, kind: str) -> Response:
    """A picture, of kind `jpeg` or `png`."""
    return Response(content, media_type=f"image/{kind}", headers={"Cache-Control": KEPT})


def scenario_address(root: str, token: str) -> str:
    """The relative address of a scenario's page."""
    return f"{root}scenario/{path_in_address(token)}/"


def thumbnail_address(root: str, token: str) -> str:
    """The relative address of a scenario's thumbnail."""
    return f"{root}thumbnail/{path_in_address(token)}.jpg"


def frame_button(number: int) -> Markup:
    """A button that takes the replay of the page to a frame."""
    return Markup('<button type="button" data-frame="{0}">{0}</button>').format(number)


def static_routes() -> list[Route]:
    """Where they are."""
    return [Route("/static/{digest}/{name}", _answer)]


def asset(root: str, name: str) -> str:
    """The relative address of a style or script from a page whose way to the first page is `root`."""
    digest = hashlib.blake2b(assets()[name].encode(), digest_size=6).hexdigest()
    return f"{root}static/{digest}/{name}"


@cache
def assets() -> dict[str, str]:
    """Name → text."""
    folder = files("deepaccident_devkit.plugins.explore") / "static"

    def read(name: str) -> str:
        return (folder / name).read_text(encoding="utf-8")

    return {
        **{f"{name}.js": bundled(read, name) for name in _SCRIPTS},
        "explore.css": read("explore.css"),
        "pages.css": page_style(),
        "replay.css": replay_style(),
        "replay-player.js": replay_script(),
        "sorting.js": bundled(part, "sorting"),
    }


async def _answer(request: Request) -> Response:
    name = request.path_params["name"]
    if name not in assets():
        raise HTTPException(404)
    kind = _KINDS[name.rpartition(".")[2]]
    return Response(assets()[name], media_type=kind, headers={"Cache-Control": _FOREVER})


@dataclass(frozen=True, slots=True, kw_only=True)
class _ListPage:
    """A page of a long list.

    Attributes:
        entries: of this page.
        count: of all pages.
        here: number of this page, from 1.
        pages: number of the last page.
        before: parameters of the address of the page before; empty if this is the first one.
        after: of the page after.
    """

    entries: Sequence[Any]
    count: int
    here: int
    pages: int
    before: str
    after: str


def part_of(request: Request, items: Sequence[Any], size: int) -> _ListPage:
    """The page of a list that the address names by `page`, with so many entries."""
    given = request.query_params.get("page", "")
    pages = max(1, -(-len(items) // size))
    asked = (
        int(given)
        if given.isascii() and given.isdigit() and len(given) < len(str(_LAST_PAGE))
        else 1
    )
    here = min(max(asked, 1), pages)

    def address(number: int) -> str:
        others = [
            (name, value) for name, value in request.query_params.multi_items() if name != "page"
        ]
        return f"?{urlencode([*others, ('page', str(number))])}" if 1 <= number <= pages else ""

    return _ListPage(
        entries=items[(here - 1) * size : here * size],
        count=len(items),
        here=here,
        pages=pages,
        before=address(here - 1),
        after=address(here + 1),
    )
