"""Answers: pages from templates, pictures, styles and scripts, and their caching.

The addresses of styles and scripts change with their content, so that browsers may keep them.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Final, TypeAlias
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

# Browsers may cache pictures for some minutes, since files of a release seldom change.
PICTURE_CACHING: Final = "private, max-age=600"
_ASSET_CACHING = "private, max-age=31536000, immutable"
# Largest number of digits of the number of a page; a longer number is ignored.
_MAX_PAGE_DIGITS = 6
# Scripts that pages load; they import the other scripts in the same folder.
_SCRIPTS = ("copy", "keys", "list", "moment", "parts", "twins", "waiting")
# Variables of a template by their names.
Variables: TypeAlias = "dict[str, Any]"
_KINDS = {"css": "text/css", "js": "text/javascript"}


def get_explorer(request: Request) -> Explorer:
    """Return the explorer that serves a request."""
    explorer: Explorer = request.app.state.explorer
    return explorer


def find_root(path: str) -> str:
    """Return the relative address of the first page: `../../` for the path `/scenario/a`."""
    return "../" * (path.count("/") - 1) or "./"


def render_page(request: Request, template: str, *, status: int = 200, **context: Any) -> Response:
    """Return a page that is made from a template."""
    root = find_root(request.scope["path"])
    text = render_template(get_explorer(request), template, root, **context)
    return HTMLResponse(text, status_code=status)


def render_template(explorer: Explorer, template: str, root: str, **context: Any) -> str:
    """Return a filled template as text, in which all values are escaped.

    Args:
        explorer: The explorer that serves the page.
        template: Name of the template.
        root: Relative address of the first page.
        **context: Further variables of the template.
    """
    variables: Variables = {
        "asset": format_asset_address,
        "scenario_at": format_scenario_address,
        "thumbnail_at": format_thumbnail_address,
        "named": lambda token: scenario_words(explorer.dataset.scenario.get(token)),
        "root": root,
        "models": [*explorer.models],
        "static": False,
        "frame_number": make_frame_button,
    }
    return rendered(template, **variables, **context)


async def add_slash(request: Request) -> Response:
    """Redirect to the address with a slash at the end.

    The address of a folder ends in a slash, so that the addresses in its page are below it.
    """
    query = ""
    if request.url.query:
        query = f"?{request.url.query}"
    name = quote(request.scope["path"].rsplit("/", 1)[1], safe="")
    return RedirectResponse(f"./{name}/{query}", status_code=307)


def send_picture(content: bytes, kind: str) -> Response:
    """Answer with a picture; `kind` is `jpeg` or `png`."""
    return Response(content, media_type=f"image/{kind}", headers={"Cache-Control": PICTURE_CACHING})


def format_scenario_address(root: str, token: str) -> str:
    """Return the relative address of a scenario's page."""
    return f"{root}scenario/{path_in_address(token)}/"


def format_thumbnail_address(root: str, token: str) -> str:
    """Return the relative address of a scenario's thumbnail."""
    return f"{root}thumbnail/{path_in_address(token)}.jpg"


def make_frame_button(number: int) -> Markup:
    """Return a button that moves the page's replay to a frame."""
    return Markup('<button type="button" data-frame="{0}">{0}</button>').format(number)


def static_routes() -> list[Route]:
    """Return the route of styles and scripts."""
    return [Route("/static/{digest}/{name}", _show_asset)]


def format_asset_address(root: str, name: str) -> str:
    """Return the relative address of a style or script; `root` leads to the first page."""
    digest = hashlib.blake2b(assets()[name].encode(), digest_size=6).hexdigest()
    return f"{root}static/{digest}/{name}"


@cache
def assets() -> dict[str, str]:
    """Return the texts of the styles and scripts, by name."""
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


async def _show_asset(request: Request) -> Response:
    name = request.path_params["name"]
    if name not in assets():
        raise HTTPException(404)
    kind = _KINDS[name.rpartition(".")[2]]
    return Response(assets()[name], media_type=kind, headers={"Cache-Control": _ASSET_CACHING})


@dataclass(frozen=True, slots=True, kw_only=True)
class _ListPage:
    """One page of a long list.

    Attributes:
        entries: Entries on this page.
        count: Number of entries on all pages.
        number: Number of this page, from 1.
        pages: Number of the last page.
        before: Parameters of the address of the previous page; empty on the first page.
        after: Parameters of the address of the next page; empty on the last page.
    """

    entries: Sequence[Any]
    count: int
    number: int
    pages: int
    before: str
    after: str


def select_page(request: Request, items: Sequence[Any], size: int) -> _ListPage:
    """Return the page of a list that the parameter `page` names, with `size` entries."""
    text = request.query_params.get("page", "")
    num_pages = max(1, math.ceil(len(items) / size))
    number = 1
    if text.isascii() and text.isdigit() and len(text) <= _MAX_PAGE_DIGITS:
        number = int(text)
    number = min(max(number, 1), num_pages)
    parameters = request.query_params.multi_items()
    other_parameters = [(name, value) for name, value in parameters if name != "page"]

    def format_address(page_number: int) -> str:
        if not 1 <= page_number <= num_pages:
            return ""
        return f"?{urlencode([*other_parameters, ('page', str(page_number))])}"

    return _ListPage(
        entries=items[(number - 1) * size : number * size],
        count=len(items),
        number=number,
        pages=num_pages,
        before=format_address(number - 1),
        after=format_address(number + 1),
    )
