"""Answers: pages from templates, pictures, styles and scripts, and their caching.

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
from deepaccident_devkit.support.pages import part, path_in_address, rendered
from deepaccident_devkit.support.scripts import bundled

# A browser may cache pictures for some minutes, since files of a release seldom change.
PICTURE_CACHING: Final = "private, max-age=600"
_ASSET_CACHING: Final = "private, max-age=31536000, immutable"
_MAX_PAGE: Final = 1_000_000
# Scripts that pages load; they import the other scripts beside them.
_SCRIPTS: Final = ("copy", "keys", "list", "moment", "parts", "twins", "waiting")
_KINDS: Final = {"css": "text/css", "js": "text/javascript"}


def explorer_of(request: Request) -> Explorer:
    """Return the explorer that serves a request."""
    explorer: Explorer = request.app.state.explorer
    return explorer


def root_of(path: str) -> str:
    """Return the relative address of the first page from a path: `../../` from `/scenario/a`."""
    return "../" * (path.count("/") - 1) or "./"


def page(request: Request, template: str, *, status: int = 200, **context: Any) -> Response:
    """Return a page from a template."""
    root = root_of(request.scope["path"])
    text = rendered_page(explorer_of(request), template, root, **context)
    return HTMLResponse(text, status_code=status)


def rendered_page(explorer: Explorer, template: str, root: str, **context: Any) -> str:
    """Return a filled template as text; all texts are escaped.

    Args:
        explorer: The explorer that serves the page.
        template: Name of the template.
        root: Relative address of the first page.
        **context: Further variables of the template.
    """
    variables: dict[str, Any] = {
        "asset": asset,
        "scenario_at": scenario_address,
        "thumbnail_at": thumbnail_address,
        "named": lambda token: scenario_words(explorer.dataset.scenario.get(token)),
        "root": root,
        "models": [*explorer.models],
        "static": False,
        "frame_number": frame_button,
    }
    return rendered(template, **variables, **context)


async def with_slash(request: Request) -> Response:
    """Redirect to the address with a slash at its end.

    A folder's address ends in a slash, so that the addresses in its page are below it.
    """
    query = ""
    if request.url.query:
        query = f"?{request.url.query}"
    name = quote(request.scope["path"].rsplit("/", 1)[1], safe="")
    return RedirectResponse(f"./{name}/{query}", status_code=307)


def picture(content: bytes, kind: str) -> Response:
    """Return a picture as an answer; its kind is `jpeg` or `png`."""
    return Response(content, media_type=f"image/{kind}", headers={"Cache-Control": PICTURE_CACHING})


def scenario_address(root: str, token: str) -> str:
    """Return the relative address of a scenario's page."""
    return f"{root}scenario/{path_in_address(token)}/"


def thumbnail_address(root: str, token: str) -> str:
    """Return the relative address of a scenario's thumbnail."""
    return f"{root}thumbnail/{path_in_address(token)}.jpg"


def frame_button(number: int) -> Markup:
    """Return a button that moves the page's replay to a frame."""
    return Markup('<button type="button" data-frame="{0}">{0}</button>').format(number)


def static_routes() -> list[Route]:
    """Return the route of styles and scripts."""
    return [Route("/static/{digest}/{name}", _answer)]


def asset(root: str, name: str) -> str:
    """Return the relative address of a style or script; `root` leads to the first page."""
    digest = hashlib.blake2b(assets()[name].encode(), digest_size=6).hexdigest()
    return f"{root}static/{digest}/{name}"


@cache
def assets() -> dict[str, str]:
    """Return the styles and scripts: name → text."""
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
    return Response(assets()[name], media_type=kind, headers={"Cache-Control": _ASSET_CACHING})


@dataclass(frozen=True, slots=True, kw_only=True)
class _ListPage:
    """A page of a long list.

    Attributes:
        entries: Entries of this page.
        count: Number of entries of all pages.
        number: Number of this page, from 1.
        pages: Number of the last page.
        before: Parameters of the address of the previous page; empty if this is the first one.
        after: Parameters of the address of the next page; empty if this is the last one.
    """

    entries: Sequence[Any]
    count: int
    number: int
    pages: int
    before: str
    after: str


def part_of(request: Request, items: Sequence[Any], size: int) -> _ListPage:
    """Return the page of a list that the address names by `page`, with `size` entries."""
    text = request.query_params.get("page", "")
    pages = max(1, -(-len(items) // size))
    number = 1
    if text.isascii() and text.isdigit() and len(text) < len(str(_MAX_PAGE)):
        number = int(text)
    number = min(max(number, 1), pages)
    parameters = request.query_params.multi_items()
    other_parameters = [(name, value) for name, value in parameters if name != "page"]

    def address(page_number: int) -> str:
        if not 1 <= page_number <= pages:
            return ""
        return f"?{urlencode([*other_parameters, ('page', str(page_number))])}"

    return _ListPage(
        entries=items[(number - 1) * size : number * size],
        count=len(items),
        number=number,
        pages=pages,
        before=address(number - 1),
        after=address(number + 1),
    )
