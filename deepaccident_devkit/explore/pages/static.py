"""Styles and scripts, by addresses that change with their content, so that browsers may keep them."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.resources import files
from typing import Final

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.render.markup import STYLE
from deepaccident_devkit.render.replay import SCRIPTS, replay_part
from deepaccident_devkit.render.replay import STYLE as REPLAY_STYLE
from deepaccident_devkit.render.theme import DARK

_KINDS: Final = {"css": "text/css", "js": "text/javascript"}
_FOREVER: Final = "private, max-age=31536000, immutable"
_REPLAY: Final = "replay-player"
"""The scripts of a replay, in one file as they are in a replay's own page."""


def static_routes() -> list[Route]:
    """Where they are."""
    return [Route("/static/{digest}/{name}", _answer)]


def asset(root: str, name: str) -> str:
    """The relative address of a style or script from a page whose way to the first page is `root`."""
    content = assets()[name]
    digest = hashlib.blake2b(content.encode(), digest_size=6).hexdigest()
    return f"{root}static/{digest}/{name}"


@cache
def assets() -> dict[str, str]:
    """Name → text."""
    folder = files("deepaccident_devkit.explore") / "static"
    own = {each.name: each.read_text(encoding="utf-8") for each in folder.iterdir() if each.name[0] != "_"}
    return {
        **own,
        "pages.css": STYLE + DARK,
        "replay.css": replay_part(REPLAY_STYLE),
        "sorting.js": (files("deepaccident_devkit.render.safety") / "sorting.js").read_text(encoding="utf-8"),
        f"{_REPLAY}.js": "".join(map(replay_part, SCRIPTS)),
    }


async def _answer(request: Request) -> Response:
    name = request.path_params["name"]
    if name not in assets():
        raise HTTPException(404)
    kind = _KINDS[name.rpartition(".")[2]]
    return Response(assets()[name], media_type=kind, headers={"Cache-Control": _FOREVER})
