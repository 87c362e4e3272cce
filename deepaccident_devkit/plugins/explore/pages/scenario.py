"""Pages of a scenario: its replay, story, pairs, lead times, twin and findings.

There are also pages of a moment, with its boxes, pictures and points.
"""

import math
import re
from collections.abc import Callable, Mapping
from functools import partial
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
from deepaccident_devkit.plugins.explore.pages.responses import (
    PICTURE_CACHING,
    Variables,
    add_slash,
    find_root,
    get_explorer,
    render_page,
    render_template,
    send_picture,
)
from deepaccident_devkit.plugins.safety import COALITIONS, PARTNERS, lead_times, twin_diff
from deepaccident_devkit.release.images import picture_bytes
from deepaccident_devkit.render import detached_figure, render_motion_labels, render_sample
from deepaccident_devkit.render.boxes import recorders_of
from deepaccident_devkit.render.replay import cloud_text, script_json
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, short_name
from deepaccident_devkit.validation import findings

_SCENARIO_ROUTE = "/scenario/{type}/{name}"
# Widths of images; they are few, so that the images stay in memory.
_WIDTHS_PX = (160, 320, 640, 960, 1600)
_JPEG_QUALITY = 80
# The function that renders each view of a moment, and the view's width and height in inches.
_VIEWS: Mapping[str, tuple[Callable[..., Any], tuple[float, float]]] = {
    "sample": (render_sample, (15.5, 5.4)),
    "truth": (
        partial(render_sample, layers=("image", "bev", "boxes", "trajectories", "grid")),
        (15.5, 5.9),
    ),
    "labels": (render_motion_labels, (12.5, 9.4)),
}
_MAX_PAIRS = 30
# Heading of each part.
PARTS: Final[Mapping[str, str]] = {
    "story": "What happens",
    "pairs": "Closest encounters",
    "ledger": "Who sees the danger, and when",
    "twins": "Compared with its twin",
    "findings": "Findings of validate",
}


def routes() -> list[Route]:
    """Return the routes of the pages."""
    return [
        Route(_SCENARIO_ROUTE, add_slash),
        Route(f"{_SCENARIO_ROUTE}/", _show_scenario),
        Route(f"{_SCENARIO_ROUTE}/player", _show_player),
        Route(f"{_SCENARIO_ROUTE}/twin", _show_twin),
        Route(f"{_SCENARIO_ROUTE}/parts/{{part}}", _show_part),
        Route(f"{_SCENARIO_ROUTE}/moment/{{agent}}/{{frame:int}}", _show_moment),
        Route("/thumbnail/{type}/{name}.jpg", _show_thumbnail),
        Route(f"{_SCENARIO_ROUTE}/images/{{agent}}/{{channel}}/{{frame:int}}", _show_image),
        Route(f"{_SCENARIO_ROUTE}/points/{{agent}}/{{frame:int}}", _show_points),
        Route(f"{_SCENARIO_ROUTE}/moment/{{agent}}/{{frame:int}}/{{view}}.png", _show_view),
    ]


def _read_scenario_token(request: Request) -> str:
    """Return the token of the scenario that an address names."""
    return "{type}/{name}".format(**request.path_params)


def read_sample_token(request: Request) -> str:
    """Return the token of the sample that an address names.

    Raises HTTPException if the agent or the frame is impossible.
    """
    agent = request.path_params["agent"]
    frame = request.path_params["frame"]
    if agent not in AGENTS or not 0 < frame < 1000:
        raise HTTPException(404)
    return f"{_read_scenario_token(request)}/{agent}/{frame:03d}"


def _show_scenario(request: Request) -> Response:
    explorer = get_explorer(request)
    token = _read_scenario_token(request)
    if token not in explorer.scenarios.row_of:
        return _show_broken_scenario(request, explorer, token)
    context = make_scenario_context(explorer, token, request.query_params.get("model"))
    return render_page(request, "scenario.html", **context)


def _show_broken_scenario(request: Request, explorer: Explorer, token: str) -> Response:
    """Return the page of a broken scenario, which shows only findings.

    Raises TokenError if there is no such scenario.
    """
    broken_scenarios = [problem.scenario for problem in explorer.dataset.problems]
    if token not in broken_scenarios:
        raise TokenError(f"the release has no scenario {token!r}")
    context: Variables = {"token": token, "findings": findings(explorer.dataset, token)}
    return render_page(request, "broken.html", **context)


def make_scenario_context(explorer: Explorer, token: str, model: str | None) -> Variables:
    """Return what the page of a scenario shows.

    Args:
        explorer: Explorer of the release.
        token: Token of the scenario.
        model: Name of the model that made the replay's predictions; None for none.
    """
    scenarios = explorer.scenarios
    row = scenarios.row_of[token]
    models = []
    for name, candidate in explorer.models.items():
        if candidate.results and token in candidate.scenarios:
            models.append(name)
    replayed_model = model if model in models else None
    twin = twin_of(explorer.dataset, token)
    replay = explorer.replay(token, replayed_model)
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


def _show_player(request: Request) -> Response:
    """Return a page with only the replay, for a page that shows two replays side by side."""
    explorer = get_explorer(request)
    token = _read_scenario_token(request)
    context = make_scenario_context(explorer, token, request.query_params.get("model"))
    return render_page(request, "player.html", **context)


def _show_twin(request: Request) -> Response:
    """Return a page with a scenario and its twin side by side, which play in step."""
    explorer = get_explorer(request)
    token = _read_scenario_token(request)
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
    context: Variables = {
        "token": token,
        "twin": twin["token"],
        "shift": shift,
        "offset": offset.tolist(),
    }
    return render_page(request, "twins.html", **context)


# The parts of a page below the replay.


def _show_part(request: Request) -> Response:
    name = request.path_params["part"]
    if name not in PARTS:
        raise HTTPException(404)
    token = _read_scenario_token(request)
    root = find_root(request.scope["path"])
    return HTMLResponse(part_html(get_explorer(request), token, name, root))


def part_html(explorer: Explorer, token: str, name: str, root: str) -> str:
    """Return one of the `PARTS` of a scenario as HTML."""
    context = make_part_context(explorer.dataset, token, name)
    return render_template(explorer, f"parts/{name}.html", root, **context)


def make_part_context(dataset: Dataset, token: str, name: str) -> Variables:
    """Return the variables of the template of one of the `PARTS`.

    If the part is not available, `missing` is a sentence with the reason.
    """
    try:
        context = _CONTEXTS[name](dataset, token)
    except NotAvailableError as error:
        context = {"missing": str(error)}
    return {"token": token, "missing": None, **context}


def _list_pairs(dataset: Dataset, token: str) -> Variables:
    """Return the pairs of actors that come close to each other, the soonest collision first."""
    pairs = interactions(dataset, token).pairs
    name_of = _make_namer(dataset, token)
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


def _make_namer(dataset: Dataset, token: str) -> Callable[[int], str]:
    """Return a function for the names of a scenario's actors."""
    agents = {actor: short_name(agent) for actor, agent in recorders_of(dataset, token).items()}

    def format_name(actor: int) -> str:
        category = dataset.get("instance", f"{token}/actor/{actor}")["category"]
        if actor in agents:
            return f"{category} {actor} ({agents[actor]})"
        return f"{category} {actor}"

    return format_name


def _make_ledger(dataset: Dataset, token: str) -> Variables:
    """Return when each set of agents first sees both colliding actors, and each partner's gain."""
    times = lead_times(dataset, token)
    if times is None:
        raise NotAvailableError(f"{token}: nobody collides, so there is no lead time")
    leads = times.leads.tolist()
    first_frames = times.first_frames.tolist()
    sets = []
    for agents, lead, frame in zip(COALITIONS, leads, first_frames, strict=True):
        if not math.isnan(lead):
            names = ", ".join(map(short_name, agents))
            sets.append({"agents": names, "lead": lead, "frame": frame})
    partner_names = map(short_name, PARTNERS)
    gains = times.gains.tolist()
    losses = times.losses.tolist()
    shapley = times.shapley.tolist()
    partners = zip(partner_names, gains, losses, shapley, strict=True)
    return {"sets": sets, "partners": list(partners)}


def _compare_twins(dataset: Dataset, token: str) -> Variables:
    diff = twin_diff(dataset, token).to_dict()
    actors = [actor for actor in diff["actors"] if actor["parting_frame"]]
    return {"told": diff, "actors": actors, "is_accident": diff["accident"] == token}


def _collect_findings(dataset: Dataset, token: str) -> Variables:
    """Return what `validate` finds, and how many of the sensor files and frames exist.

    A frame exists if it has any sensor file.
    """
    files = dataset.sensor_frames(token)
    num_frames = dataset.get("scenario", token)["num_frames"]
    recorded_frames = set().union(*files.values())
    return {
        "findings": findings(dataset, token),
        "files": {"here": sum(map(len, files.values())), "whole": num_frames * len(files)},
        "frames": {"here": len(recorded_frames), "whole": num_frames},
    }


_CONTEXTS: Mapping[str, Callable[[Dataset, str], Variables]] = {
    "story": lambda dataset, token: {"text": describe(dataset, token).text},
    "pairs": _list_pairs,
    "ledger": _make_ledger,
    "twins": _compare_twins,
    "findings": _collect_findings,
}


# Pages of moments.


def _show_moment(request: Request) -> Response:
    """Return the page about what an agent recorded at a moment.

    It shows the cameras and the LiDAR with boxes, motion labels, and the boxes as a table.
    """
    dataset = get_explorer(request).dataset
    token = _read_scenario_token(request)
    sample = read_sample_token(request)
    record = dataset.get("sample", sample)
    boxes = dataset.get_boxes(record, "ego")
    scenario = dataset.get("scenario", token)
    samples = dataset.samples_of(record["frame_token"])
    agent = request.path_params["agent"]
    frame = request.path_params["frame"]
    recorded_frames: set[int] = set()
    for (name, _), frames in dataset.sensor_frames(token).items():
        if name == agent:
            recorded_frames.update(frames)
    nearest = min(recorded_frames, key=lambda number: abs(number - frame), default=frame)
    return render_page(
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


def _show_thumbnail(request: Request) -> Response:
    return send_picture(get_explorer(request).thumbnail(_read_scenario_token(request)), "jpeg")


def _show_image(request: Request) -> Response:
    """Return a camera image; resized images are cached in memory."""
    sample = read_sample_token(request)
    channel = request.path_params["channel"]
    if channel not in CAMERAS:
        raise HTTPException(404)
    explorer = get_explorer(request)
    width = _choose_width(request.query_params.get("width", ""))
    key = (sample, channel, width)
    make = partial(_encode_jpeg, explorer, *key)
    return send_picture(explorer.pictures.get(key, make), "jpeg")


def _choose_width(text: str) -> int:
    """Return the smallest available image width that is at least `text`; otherwise the largest."""
    if re.fullmatch(r"\d{1,4}", text):
        for width in _WIDTHS_PX:
            if width >= int(text):
                return width
    return _WIDTHS_PX[-1]


def _encode_jpeg(explorer: Explorer, sample: str, channel: str, width: int) -> bytes:
    from PIL import Image

    camera = explorer.dataset.camera(sample, channel)
    width = min(width, camera.width)
    height = max(1, round(camera.height * width / camera.width))
    size = (height, width)
    image = explorer.dataset.load_image(sample, channel, min_size=size, size=size)
    return picture_bytes(Image.fromarray(image), "JPEG", quality=_JPEG_QUALITY)


def _show_points(request: Request) -> Response:
    sample = read_sample_token(request)
    recording = get_explorer(request).recording(_read_scenario_token(request))
    text = cloud_text(recording, request.path_params["agent"], request.path_params["frame"])
    if text is None:
        raise HTTPException(404, f"{sample}: no LiDAR file")
    return PlainTextResponse(text, headers={"Cache-Control": PICTURE_CACHING})


def _show_view(request: Request) -> Response:
    explorer = get_explorer(request)
    sample = read_sample_token(request)
    name = request.path_params["view"]
    if name not in _VIEWS:
        raise HTTPException(404)
    render, size = _VIEWS[name]

    def draw() -> Any:
        return render(explorer.dataset, sample, fig=detached_figure(size))

    return send_picture(explorer.drawn((name, sample), draw), "png")
