"""Pages of a scenario: its replay, story, pairs, lead times, twin and findings.

Also a moment's boxes, with its pictures and points.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, Final

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route

from deepaccident_devkit.collisions import twin_of
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.descriptions import describe
from deepaccident_devkit.errors import NotAvailableError, TokenError
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.plugins.explore.explorer import Explorer
from deepaccident_devkit.plugins.explore.models import FORESEEN
from deepaccident_devkit.plugins.explore.pages.responses import (
    PICTURE_CACHING,
    explorer_of,
    page,
    picture,
    rendered_page,
    root_of,
    with_slash,
)
from deepaccident_devkit.plugins.safety import COALITIONS, PARTNERS, lead_times, twin_diff
from deepaccident_devkit.release.images import picture_bytes
from deepaccident_devkit.render import detached_figure, render_motion_labels, render_sample
from deepaccident_devkit.render.boxes import recorders_of
from deepaccident_devkit.render.replay import cloud_text, script_json
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, short_name
from deepaccident_devkit.validation import findings

_SCENARIO_ROUTE: Final = "/scenario/{type}/{name}"
# Widths of images in pixels: few, so that they stay in memory.
_WIDTHS: Final = (160, 320, 640, 960, 1600)
_JPEG_QUALITY: Final = 80
# View of a moment → the function that renders it, and its width and height in inches.
_VIEWS: Final[Mapping[str, tuple[Callable[..., Any], tuple[float, float]]]] = {
    "sample": (render_sample, (15.5, 5.4)),
    "labels": (render_motion_labels, (12.5, 9.4)),
}
_MAX_PAIRS: Final = 30
# Part → its heading.
PARTS: Final[Mapping[str, str]] = {
    "story": "What happens",
    "pairs": "Who comes near whom",
    "ledger": "Who sees the danger, and when",
    "twins": "Beside its twin",
    "findings": "Findings of validate",
}


def routes() -> list[Route]:
    """Return the routes of the pages."""
    return [
        Route(_SCENARIO_ROUTE, with_slash),
        Route(f"{_SCENARIO_ROUTE}/", _scenario),
        Route(f"{_SCENARIO_ROUTE}/player", _player),
        Route(f"{_SCENARIO_ROUTE}/twin", _twin),
        Route(f"{_SCENARIO_ROUTE}/parts/{{part}}", _part),
        Route(f"{_SCENARIO_ROUTE}/moment/{{agent}}/{{frame:int}}", _moment),
        Route("/thumbnail/{type}/{name}.jpg", _thumbnail),
        Route(f"{_SCENARIO_ROUTE}/images/{{agent}}/{{channel}}/{{frame:int}}", _image),
        Route(f"{_SCENARIO_ROUTE}/points/{{agent}}/{{frame:int}}", _points),
        Route(f"{_SCENARIO_ROUTE}/moment/{{agent}}/{{frame:int}}/{{view}}.png", _view),
    ]


def _scenario_token(request: Request) -> str:
    """Return the scenario that an address names."""
    return "{type}/{name}".format(**request.path_params)


def sample_of(request: Request) -> str:
    """Return the sample that an address names; raise HTTPException for an impossible agent."""
    agent, frame = request.path_params["agent"], request.path_params["frame"]
    if agent not in AGENTS or not 0 < frame < 1000:
        raise HTTPException(404)
    return f"{_scenario_token(request)}/{agent}/{frame:03d}"


def _scenario(request: Request) -> Response:
    explorer, token = explorer_of(request), _scenario_token(request)
    if token not in explorer.scenarios.row_of:
        return _broken_scenario(request, explorer, token)
    context = scenario_context(explorer, token, request.query_params.get("model"))
    return page(request, "scenario.html", **context)


def _broken_scenario(request: Request, explorer: Explorer, token: str) -> Response:
    """Return the page of a broken scenario, which only has findings; raise TokenError."""
    if token not in {problem.scenario for problem in explorer.dataset.problems}:
        raise TokenError(f"the release has no scenario {token!r}")
    context: dict[str, Any] = {"token": token, "findings": findings(explorer.dataset, token)}
    return page(request, "broken.html", **context)


def scenario_context(explorer: Explorer, token: str, model: str | None) -> dict[str, Any]:
    """Return what a scenario's page shows.

    Args:
        explorer: Explorer of the release.
        token: Token of the scenario.
        model: Name of the model with the predictions of the replay; None for none.
    """
    scenarios = explorer.scenarios
    row = scenarios.row_of[token]
    models = [
        name
        for name, candidate in explorer.models.items()
        if candidate.results and token in candidate.scenarios
    ]
    replayed_model = None
    if model in models and explorer.models[model].setup.task in (*FORESEEN, "warning"):
        replayed_model = model
    twin, replay = twin_of(explorer.dataset, token), explorer.replay(token, replayed_model)
    return {
        "token": token,
        "before": scenarios.tokens[row - 1] if row else None,
        "after": scenarios.tokens[row + 1] if row + 1 < len(scenarios) else None,
        "twin": None if twin is None else twin["token"],
        "telling": models,
        "model": replayed_model,
        "data": script_json(replay),
        "parts": PARTS,
        "first_agent": replay["agents"][0]["name"],
    }


def _player(request: Request) -> Response:
    """Return a page with only the replay, for a page that shows two of them side by side."""
    explorer, token = explorer_of(request), _scenario_token(request)
    context = scenario_context(explorer, token, request.query_params.get("model"))
    return page(request, "player.html", **context)


def _twin(request: Request) -> Response:
    """Return a scenario and its twin side by side, in step."""
    explorer, token = explorer_of(request), _scenario_token(request)
    twin = twin_of(explorer.dataset, token)
    if twin is None:
        raise NotAvailableError(
            f"{token}: this release has no twin of it, with the same name and subtype"
        )
    try:
        diff = twin_diff(explorer.dataset, token)
        shift = diff.shift if diff.accident == token else -diff.shift
    except NotAvailableError:
        shift = 0
    offset = explorer.recording(twin["token"]).origin - explorer.recording(token).origin
    context: dict[str, Any] = {
        "token": token,
        "twin": twin["token"],
        "shift": shift,
        "offset": offset.tolist(),
    }
    return page(request, "twins.html", **context)


# The parts below a replay.


def _part(request: Request) -> Response:
    explorer, token = explorer_of(request), _scenario_token(request)
    name = request.path_params["part"]
    if name not in PARTS:
        raise HTTPException(404)
    return HTMLResponse(part_html(explorer, token, name, root_of(request.scope["path"])))


def part_html(explorer: Explorer, token: str, name: str, root: str) -> str:
    """Return one of `PARTS` of a scenario as HTML."""
    context = part_context(explorer.dataset, token, name)
    return rendered_page(explorer, f"parts/{name}.html", root, **context)


def part_context(dataset: Dataset, token: str, name: str) -> dict[str, Any]:
    """Return the variables of the template of one of `PARTS`.

    If it is not available, `missing` is a sentence with the reason.
    """
    try:
        context = _CONTEXTS[name](dataset, token)
    except NotAvailableError as error:
        context = {"missing": str(error)}
    return {"token": token, "missing": None, **context}


def _pairs(dataset: Dataset, token: str) -> dict[str, Any]:
    """Return pairs that come near each other, the soonest collision first."""
    pairs = interactions(dataset, token).pairs
    name_of = _actor_names(dataset, token)
    rows = []
    for index in range(len(pairs)):
        rows.append(
            {
                "names": [name_of(actor) for actor in pairs.actor_ids[index].tolist()],
                "moving": bool(pairs.moving[index]),
                "min_ttc": float(pairs.min_ttc[index]),
                "min_gap": float(pairs.min_gap[index]),
                "max_drac": float(pairs.max_drac[index]),
                "pet": float(pairs.pet[index]),
                "ttc_frame": int(pairs.min_ttc_frame[index]),
                "gap_frame": int(pairs.min_gap_frame[index]),
            }
        )
    rows.sort(key=lambda row: (not row["moving"], row["min_ttc"], row["min_gap"]))
    return {"rows": rows[:_MAX_PAIRS], "more": max(0, len(rows) - _MAX_PAIRS)}


def _actor_names(dataset: Dataset, token: str) -> Callable[[int], str]:
    agents = {actor: short_name(agent) for actor, agent in recorders_of(dataset, token).items()}

    def name(actor: int) -> str:
        category = dataset.get("instance", f"{token}/actor/{actor}")["category"]
        if actor in agents:
            return f"{category} {actor} ({agents[actor]})"
        return f"{category} {actor}"

    return name


def _ledger(dataset: Dataset, token: str) -> dict[str, Any]:
    """Return since when sets of agents see both colliders, and what each partner adds."""
    times = lead_times(dataset, token)
    if times is None:
        raise NotAvailableError(f"{token}: nobody collides, so that there is no lead time")
    sets = []
    for agents, lead, frame in zip(
        COALITIONS, times.leads.tolist(), times.first_frames.tolist(), strict=True
    ):
        if not math.isnan(lead):
            names = ", ".join(map(short_name, agents))
            sets.append({"agents": names, "lead": lead, "frame": frame})
    partners = zip(
        map(short_name, PARTNERS),
        times.gains.tolist(),
        times.losses.tolist(),
        times.shapley.tolist(),
        strict=True,
    )
    return {"sets": sets, "partners": list(partners)}


def _twins(dataset: Dataset, token: str) -> dict[str, Any]:
    diff = twin_diff(dataset, token).to_dict()
    actors = [actor for actor in diff["actors"] if actor["parting_frame"]]
    return {"told": diff, "actors": actors, "is_accident": diff["accident"] == token}


def _findings(dataset: Dataset, token: str) -> dict[str, Any]:
    """Return what `validate` finds, and how many of the sensor files and frames exist.

    A frame exists if it has any sensor file.
    """
    files, num_frames = dataset.sensor_frames(token), dataset.get("scenario", token)["num_frames"]
    recorded_frames = set().union(*files.values())
    return {
        "findings": findings(dataset, token),
        "files": {"here": sum(map(len, files.values())), "whole": num_frames * len(files)},
        "frames": {"here": len(recorded_frames), "whole": num_frames},
    }


_CONTEXTS: Final[Mapping[str, Callable[[Dataset, str], dict[str, Any]]]] = {
    "story": lambda dataset, token: {"text": describe(dataset, token).text},
    "pairs": _pairs,
    "ledger": _ledger,
    "twins": _twins,
    "findings": _findings,
}


# Moments.


def _moment(request: Request) -> Response:
    """Return what an agent recorded at a moment.

    This is its cameras and LiDAR with boxes, motion labels, and the boxes in numbers.
    """
    explorer, token, sample = explorer_of(request), _scenario_token(request), sample_of(request)
    record = explorer.dataset.get("sample", sample)
    boxes = explorer.dataset.get_boxes(record, "ego")
    scenario = explorer.dataset.get("scenario", token)
    samples = explorer.dataset.samples_of(record["frame_token"])
    agent, frame = request.path_params["agent"], request.path_params["frame"]
    recorded_frames: set[int] = set()
    for (name, _), frames in explorer.dataset.sensor_frames(token).items():
        if name == agent:
            recorded_frames.update(frames)
    nearest = min(recorded_frames, key=lambda number: abs(number - frame), default=frame)
    return page(
        request,
        "moment.html",
        token=token,
        sample=sample,
        agent=agent,
        frame=frame,
        nearest=nearest,
        frames=scenario["num_frames"],
        agents=[other["agent"] for other in samples],
        labelled=record["labelled"],
        boxes=boxes,
    )


def _thumbnail(request: Request) -> Response:
    return picture(explorer_of(request).thumbnail(_scenario_token(request)), "jpeg")


def _image(request: Request) -> Response:
    """Return a camera's image; smaller ones stay in memory for the next reader."""
    sample, channel = sample_of(request), request.path_params["channel"]
    if channel not in CAMERAS:
        raise HTTPException(404)
    explorer = explorer_of(request)
    width = _width(request.query_params.get("width", ""))
    key = (sample, channel, width)
    content = explorer.pictures.get(key, lambda: _jpeg(explorer, sample, channel, width))
    return picture(content, "jpeg")


def _width(text: str) -> int:
    if not re.fullmatch(r"\d{1,4}", text):
        return _WIDTHS[-1]
    return next((width for width in _WIDTHS if width >= int(text)), _WIDTHS[-1])


def _jpeg(explorer: Explorer, sample: str, channel: str, width: int) -> bytes:
    from PIL import Image

    camera = explorer.dataset.camera(sample, channel)
    width = min(width, camera.width)
    size = max(1, round(camera.height * width / camera.width)), width
    image = explorer.dataset.load_image(sample, channel, min_size=size, size=size)
    return picture_bytes(Image.fromarray(image), "JPEG", quality=_JPEG_QUALITY)


def _points(request: Request) -> Response:
    sample, explorer = sample_of(request), explorer_of(request)
    recording = explorer.recording(_scenario_token(request))
    text = cloud_text(recording, request.path_params["agent"], request.path_params["frame"])
    if text is None:
        raise HTTPException(404, f"{sample}: no LiDAR file")
    return PlainTextResponse(text, headers={"Cache-Control": PICTURE_CACHING})


def _view(request: Request) -> Response:
    explorer, sample, name = explorer_of(request), sample_of(request), request.path_params["view"]
    if name not in _VIEWS:
        raise HTTPException(404)
    render, size = _VIEWS[name]

    def draw() -> Any:
        return render(explorer.dataset, sample, fig=detached_figure(size))

    return picture(explorer.drawn((name, sample), draw), "png")
