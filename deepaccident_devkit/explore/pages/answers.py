"""Answers: pages from templates, pictures, and who may keep them how long."""

from __future__ import annotations

from functools import cache
from typing import Any, Final
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response

from deepaccident_devkit._version import __version__
from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.pages.static import asset
from deepaccident_devkit.render import markup
from deepaccident_devkit.render.roles import short_name
from deepaccident_devkit.text import fixed_text, size_text

KEPT: Final = "private, max-age=600"
"""A browser may keep pictures for some minutes: files of a release seldom change."""


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
    return HTMLResponse(rendered(explorer_of(request), template, root, **context), status_code=status)


def rendered(explorer: Explorer, template: str, root: str, **context: Any) -> str:
    """A template as text.

    Args:
        explorer: whose page it is.
        template: its file.
        root: relative address of the first page.
        **context: what it shows; all texts are escaped.
    """
    models = [*explorer.models]
    return environment().get_template(template).render(root=root, models=models, **context)


async def with_slash(request: Request) -> Response:
    """The address of a folder ends in a slash, so that the addresses in its page are below it."""
    query = f"?{request.url.query}" if request.url.query else ""
    last = quote(request.scope["path"].rsplit("/", 1)[1], safe="")
    return RedirectResponse(f"./{last}/{query}", status_code=307)


def picture(content: bytes, kind: str) -> Response:
    """A picture, of kind `jpeg` or `png`."""
    return Response(content, media_type=f"image/{kind}", headers={"Cache-Control": KEPT})


@cache
def environment() -> Environment:
    """The templates; whatever is not `Markup` is escaped, and a name that is not there is an error.

    The addresses are those of served pages; pages that are written as files set others (`static_pages`).
    """
    made = Environment(
        loader=PackageLoader("deepaccident_devkit.explore"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    made.filters |= {
        "path": path_of,
        "number": number,
        "scalar": markup.scalar,
        "agent": short_name,
        "breakable": breakable,
        "thousands": thousands,
        "counted": counted,
        "size": size,
    }
    made.globals |= {
        "asset": asset,
        "frame_number": frame_button,
        "scenario_at": scenario_address,
        "static": False,
        "thumbnail_at": thumbnail_address,
        "version": __version__,
    }
    return made


def scenario_address(root: str, token: str) -> str:
    """The relative address of a scenario's page."""
    return f"{root}scenario/{path_of(token)}/"


def thumbnail_address(root: str, token: str) -> str:
    """The relative address of a scenario's thumbnail."""
    return f"{root}thumbnail/{path_of(token)}.jpg"


def frame_button(number: int) -> Markup:
    """A button that takes the replay of the page to a frame."""
    return Markup('<button type="button" data-frame="{0}">{0}</button>').format(number)


def path_of(text: str) -> str:
    """A token as a part of an address."""
    return quote(text, safe="/")


def number(value: float | None, digits: int = 1) -> str:
    """A number with so many decimals; a dash for an unknown one, `never` for an infinite one."""
    if value is None or value != value:  # noqa: PLR0124 - NaN
        return "–"
    return "never" if value in (float("inf"), float("-inf")) else fixed_text(value, digits)


def thousands(count: int) -> str:
    """A whole number with commas."""
    return f"{count:,}"


def counted(count: int, word: str) -> str:
    """A number and what it is of: `1 scenario`, `1,200 scenarios`."""
    return f"{count:,} {word}{'' if count == 1 else 's'}"


def size(count: int | None) -> str:
    """Bytes in a unit that suits them; `unknown` for None."""
    return "unknown" if count is None else size_text(count)


def breakable(text: str) -> Markup:
    """A name that may be broken after `/`, `_` and `=`."""
    return Markup(markup.breakable(text))  # noqa: S704 - it escapes
