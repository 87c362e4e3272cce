"""Pictures and points: thumbnails, cameras' images in the size that is asked for, LiDAR clouds, rendered views."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping
from typing import Any, Final

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.pages.answers import KEPT, explorer_of, picture
from deepaccident_devkit.render import detached_figure, render_motion_labels, render_sample
from deepaccident_devkit.render.replay import cloud_text
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS

SCENARIO: Final = "/scenario/{type}/{name}"
_WIDTHS: Final = (160, 320, 640, 960, 1600)
"""Pixels that an image may be asked for: few, so that they are kept."""
_QUALITY: Final = 80
_VIEWS: Final[Mapping[str, tuple[Callable[..., Any], tuple[float, float]]]] = {
    "sample": (render_sample, (15.5, 5.4)),
    "labels": (render_motion_labels, (12.5, 9.4)),
}
"""What is rendered of a moment → by what, and how large in inches."""


def routes() -> list[Route]:
    """The addresses."""
    return [
        Route("/thumbnail/{type}/{name}.jpg", _thumbnail),
        Route(f"{SCENARIO}/images/{{agent}}/{{channel}}/{{frame:int}}", _image),
        Route(f"{SCENARIO}/points/{{agent}}/{{frame:int}}", _points),
        Route(f"{SCENARIO}/moment/{{agent}}/{{frame:int}}/{{view}}.png", _view),
    ]


def token_of(request: Request) -> str:
    """The scenario that an address names."""
    return "{type}/{name}".format(**request.path_params)


def sample_of(request: Request) -> str:
    """The sample that an address names; raises HTTPException for an agent that cannot be."""
    agent, frame = request.path_params["agent"], request.path_params["frame"]
    if agent not in AGENTS or not 0 < frame < 1000:
        raise HTTPException(404)
    return f"{token_of(request)}/{agent}/{frame:03d}"


def _thumbnail(request: Request) -> Response:
    return picture(explorer_of(request).thumbnail(token_of(request)), "jpeg")


def _image(request: Request) -> Response:
    """A camera's image; smaller ones in memory for the next reader."""
    sample, channel = sample_of(request), request.path_params["channel"]
    if channel not in CAMERAS:
        raise HTTPException(404)
    explorer = explorer_of(request)
    width = _width(request.query_params.get("width", ""))
    made = explorer.pictures.get((sample, channel, width), lambda: _jpeg(explorer, sample, channel, width))
    return picture(made, "jpeg")


def _width(asked: str) -> int:
    if not re.fullmatch(r"\d{1,4}", asked):
        return _WIDTHS[-1]
    return next((width for width in _WIDTHS if width >= int(asked)), _WIDTHS[-1])


def _jpeg(explorer: Explorer, sample: str, channel: str, width: int) -> bytes:
    from PIL import Image

    lens = explorer.dataset.camera(sample, channel)
    size = min(width, lens.width), max(1, round(lens.height * min(width, lens.width) / lens.width))
    image = explorer.dataset.load_image(sample, channel, least=size[::-1], size=size[::-1])
    written = io.BytesIO()
    Image.fromarray(image).save(written, "JPEG", quality=_QUALITY)
    return written.getvalue()


def _points(request: Request) -> Response:
    sample, explorer = sample_of(request), explorer_of(request)
    recording = explorer.recording(token_of(request))
    coded = cloud_text(recording, request.path_params["agent"], request.path_params["frame"])
    if coded is None:
        raise HTTPException(404, f"{sample}: no LiDAR file")
    return PlainTextResponse(coded, headers={"Cache-Control": KEPT})


def _view(request: Request) -> Response:
    explorer, sample, name = explorer_of(request), sample_of(request), request.path_params["view"]
    if name not in _VIEWS:
        raise HTTPException(404)
    draw, size = _VIEWS[name]
    made = explorer.drawn((name, sample), lambda: draw(explorer.dataset, sample, fig=detached_figure(size)))
    return picture(made, "png")
