"""A scenario: its replay, story, pairs, lead times, twin and findings; a moment's boxes; its pictures and points."""

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
    KEPT,
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
# Pixels that an image may be asked for: few, so that they are kept.
_WIDTHS: Final = (160, 320, 640, 960, 1600)
_QUALITY: Final = 80
# What is rendered of a moment → by what, and how large in inches.
_VIEWS: Final[Mapping[str, tuple[Callable[..., Any], tuple[float, float]]]] = {
    "sample": (render_sample, (15.5, 5.4)),
    "labels": (render_motion_labels, (12.5, 9.4)),
}
_MOST_PAIRS: Final = 30
# Part → its heading.
PARTS: Final[Mapping[str, str]] = {
    "story": "What happens",
    "pairs": "Who comes near whom",
    "ledger": "Who sees the danger, and when",
    "twins": "Beside its twin",
    "findings": "Findings of validate",
}


def routes() -> list[Route]:
    """The addresses."""
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
    """The scenario that an address names."""
    return "{type}/{name}".format(**request.path_params)


def sample_of(request: Request) -> str:
    """The sample that an address names; raises HTTPException for an agent that cannot be."""
    agent, frame = request.path_params["agent"], request.path_params["frame"]
    if agent not in AGENTS or not 0 < frame < 1000:
        raise HTTPException(404)
    return f"{_scenario_token(request)}/{agent}/{frame:03d}"


def _scenario(request: Request) -> Response:
    explorer, token = explorer_of(request), _scenario_token(request)
    if token not in explorer.scenarios.row_of:
        return _left_out(request, explorer, token)
    return page(
        request,
        "scenario.html",
        **scenario_context(explorer, token, request.query_params.get("model")),
    )


def _left_out(request: Request, explorer: Explorer, token: str) -> Response:
    """A scenario that is broken has findings alone; raises TokenError if there is none of this name."""
    if token not in {problem.scenario for problem in explorer.dataset.problems}:
        raise TokenError(f"the release has no scenario {token!r}")
    context: dict[str, Any] = {"token": token, "findings": findings(explorer.dataset, token)}
    return page(request, "broken.html", **context)


def scenario_context(explorer: Explorer, token: str, model: str | None) -> dict[str, Any]:
    """What a scenario's page shows, with the predictions of a model (a name) in its replay; None for none."""
    row, rows = explorer.scenarios.row_of[token], explorer.scenarios
    telling = [
        name for name, each in explorer.models.items() if each.results and token in each.scenarios
    ]
    shown = (
        model
        if model in telling and explorer.models[model].setup.task in (*FORESEEN, "warning")
        else None
    )
    twin, played = twin_of(explorer.dataset, token), explorer.replay(token, shown)
    return {
        "token": token,
        "before": rows.tokens[row - 1] if row else None,
        "after": rows.tokens[row + 1] if row + 1 < len(rows) else None,
        "twin": None if twin is None else twin["token"],
        "telling": telling,
        "model": shown,
        "data": script_json(played),
        "parts": PARTS,
        "first_agent": played["agents"][0]["name"],
    }


def _player(request: Request) -> Response:
    """The replay alone, for a page that shows two of them side by side."""
    explorer, token = explorer_of(request), _scenario_token(request)
    return page(
        request,
        "player.html",
        **scenario_context(explorer, token, request.query_params.get("model")),
    )


def _twin(request: Request) -> Response:
    """A scenario and its twin side by side, in step."""
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
    others: dict[str, Any] = {
        "token": token,
        "twin": twin["token"],
        "shift": shift,
        "offset": offset.tolist(),
    }
    return page(request, "twins.html", **others)


# the parts below a replay


def _part(request: Request) -> Response:
    explorer, token, name = (
        explorer_of(request),
        _scenario_token(request),
        request.path_params["part"],
    )
    if name not in PARTS:
        raise HTTPException(404)
    return HTMLResponse(part_html(explorer, token, name, root_of(request.scope["path"])))


def part_html(explorer: Explorer, token: str, name: str, root: str) -> str:
    """One of `PARTS` of a scenario as HTML."""
    return rendered_page(
        explorer, f"parts/{name}.html", root, **part_context(explorer.dataset, token, name)
    )


def part_context(dataset: Dataset, token: str, name: str) -> dict[str, Any]:
    """What the template of one of `PARTS` shows; where it cannot be told, `missing` is a sentence that says why."""
    try:
        context = _CONTEXTS[name](dataset, token)
    except NotAvailableError as error:
        context = {"missing": str(error)}
    return {"token": token, "missing": None, **context}


def _pairs(dataset: Dataset, token: str) -> dict[str, Any]:
    """Pairs that come near each other, the soonest collision first."""
    pairs = interactions(dataset, token).pairs
    names = _actor_names(dataset, token)
    rows = [
        {
            "names": [names(actor) for actor in pairs.actor_ids[at].tolist()],
            "moving": bool(pairs.moving[at]),
            **{
                name: float(getattr(pairs, name)[at])
                for name in ("min_ttc", "min_gap", "max_drac", "pet")
            },
            "ttc_frame": int(pairs.min_ttc_frame[at]),
            "gap_frame": int(pairs.min_gap_frame[at]),
        }
        for at in range(len(pairs))
    ]
    rows.sort(key=lambda row: (not row["moving"], row["min_ttc"], row["min_gap"]))
    return {"rows": rows[:_MOST_PAIRS], "more": max(0, len(rows) - _MOST_PAIRS)}


def _actor_names(dataset: Dataset, token: str) -> Callable[[int], str]:
    agents = {actor: short_name(agent) for actor, agent in recorders_of(dataset, token).items()}

    def name(actor: int) -> str:
        kind = dataset.get("instance", f"{token}/actor/{actor}")["category"]
        return f"{kind} {actor}" + (f" ({agents[actor]})" if actor in agents else "")

    return name


def _ledger(dataset: Dataset, token: str) -> dict[str, Any]:
    """Since when sets of agents see both colliders, and what each partner adds."""
    leads = lead_times(dataset, token)
    if leads is None:
        raise NotAvailableError(f"{token}: nobody collides, so that there is no lead time")
    sets = [
        {
            "agents": ", ".join(map(short_name, agents)),
            "lead": lead,
            "frame": frame,
        }
        for agents, lead, frame in zip(
            COALITIONS, leads.leads.tolist(), leads.first_frames.tolist(), strict=True
        )
        if not math.isnan(lead)
    ]
    partners = zip(
        PARTNERS, leads.gains.tolist(), leads.losses.tolist(), leads.shapley.tolist(), strict=True
    )
    return {"sets": sets, "partners": [(short_name(name), *values) for name, *values in partners]}


def _twins(dataset: Dataset, token: str) -> dict[str, Any]:
    told = twin_diff(dataset, token).to_dict()
    actors = [each for each in told["actors"] if each["parting_frame"]]
    return {"told": told, "actors": actors, "is_accident": told["accident"] == token}


def _findings(dataset: Dataset, token: str) -> dict[str, Any]:
    """What `validate` finds, how many sensor files there are of how many, and at how many frames any."""
    files, frames = dataset.sensor_frames(token), dataset.get("scenario", token)["num_frames"]
    return {
        "findings": findings(dataset, token),
        "files": {"here": sum(map(len, files.values())), "whole": frames * len(files)},
        "frames": {"here": len(set().union(*files.values())), "whole": frames},
    }


_CONTEXTS: Final[Mapping[str, Callable[[Dataset, str], dict[str, Any]]]] = {
    "story": lambda dataset, token: {"text": describe(dataset, token).text},
    "pairs": _pairs,
    "ledger": _ledger,
    "twins": _twins,
    "findings": _findings,
}


# a moment


def _moment(request: Request) -> Response:
    """What an agent recorded at a moment: its cameras and LiDAR with boxes, motion labels, and the boxes in numbers."""
    explorer, token, sample = explorer_of(request), _scenario_token(request), sample_of(request)
    record = explorer.dataset.get("sample", sample)
    boxes = explorer.dataset.get_boxes(record, "ego")
    scenario = explorer.dataset.get("scenario", token)
    agents = [each["agent"] for each in explorer.dataset.samples_of(record["frame_token"])]
    agent, frame = request.path_params["agent"], request.path_params["frame"]
    files = explorer.dataset.sensor_frames(token).items()
    filed = {number for (name, _), frames in files if name == agent for number in frames}
    return page(
        request,
        "moment.html",
        token=token,
        sample=sample,
        agent=agent,
        frame=frame,
        nearest=min(filed, key=lambda number: abs(number - frame), default=frame),
        frames=scenario["num_frames"],
        agents=agents,
        labelled=record["labelled"],
        boxes=boxes,
    )


def _thumbnail(request: Request) -> Response:
    return picture(explorer_of(request).thumbnail(_scenario_token(request)), "jpeg")


def _image(request: Request) -> Response:
    """A camera's image; smaller ones in memory for the next reader."""
    sample, channel = sample_of(request), request.path_params["channel"]
    if channel not in CAMERAS:
        raise HTTPException(404)
    explorer = explorer_of(request)
    width = _width(request.query_params.get("width", ""))
    made = explorer.pictures.get(
        (sample, channel, width), lambda: _jpeg(explorer, sample, channel, width)
    )
    return picture(made, "jpeg")


def _width(asked: str) -> int:
    if not re.fullmatch(r"\d{1,4}", asked):
        return _WIDTHS[-1]
    return next((width for width in _WIDTHS if width >= int(asked)), _WIDTHS[-1])


def _jpeg(explorer: Explorer, sample: str, channel: str, width: int) -> bytes:
    from PIL import Image

    lens = explorer.dataset.camera(sample, channel)
    size = min(width, lens.width), max(1, round(lens.height * min(width, lens.width) / lens.width))
    image = explorer.dataset.load_image(sample, channel, min_size=size[::-1], size=size[::-1])
    return picture_bytes(Image.fromarray(image), "JPEG", quality=_QUALITY)


def _points(request: Request) -> Response:
    sample, explorer = sample_of(request), explorer_of(request)
    recording = explorer.recording(_scenario_token(request))
    coded = cloud_text(recording, request.path_params["agent"], request.path_params["frame"])
    if coded is None:
        raise HTTPException(404, f"{sample}: no LiDAR file")
    return PlainTextResponse(coded, headers={"Cache-Control": KEPT})


def _view(request: Request) -> Response:
    explorer, sample, name = explorer_of(request), sample_of(request), request.path_params["view"]
    if name not in _VIEWS:
        raise HTTPException(404)
    draw, size = _VIEWS[name]
    made = explorer.drawn(
        (name, sample), lambda: draw(explorer.dataset, sample, fig=detached_figure(size))
    )
    return picture(made, "png")
