"""A scenario: its replay, below it its story, pairs, lead times, twin and findings; a moment's boxes and labels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Final

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError, TokenError
from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.pages.answers import explorer_of, page, rendered, root_of, with_slash
from deepaccident_devkit.explore.pages.pictures import SCENARIO, sample_of, token_of
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.render.boxes import recorders_of
from deepaccident_devkit.render.replay import script_json
from deepaccident_devkit.safety import COALITIONS, PARTNERS, describe, lead_times, twin_diff, twin_of
from deepaccident_devkit.taxonomy import short_name
from deepaccident_devkit.validation import findings

_MOST_PAIRS: Final = 30


def routes() -> list[Route]:
    """The addresses."""
    return [
        Route(SCENARIO, with_slash),
        Route(f"{SCENARIO}/", _scenario),
        Route(f"{SCENARIO}/player", _player),
        Route(f"{SCENARIO}/twin", _twin),
        Route(f"{SCENARIO}/parts/{{part}}", _part),
        Route(f"{SCENARIO}/moment/{{agent}}/{{frame:int}}", _moment),
    ]


def _scenario(request: Request) -> Response:
    explorer, token = explorer_of(request), token_of(request)
    if token not in explorer.scenarios.row_of:
        return _left_out(request, explorer, token)
    return page(request, "scenario.html", **scenario_context(explorer, token, request.query_params.get("model")))


def _left_out(request: Request, explorer: Explorer, token: str) -> Response:
    """A scenario that is broken has findings alone; raises TokenError if there is none of this name."""
    if token not in {problem.scenario for problem in explorer.dataset.problems}:
        raise TokenError(f"the release has no scenario {token!r}")
    context: dict[str, Any] = {"token": token, "findings": findings(explorer.dataset, token)}
    return page(request, "broken.html", **context)


def scenario_context(explorer: Explorer, token: str, model: str | None) -> dict[str, Any]:
    """What a scenario's page shows.

    Args:
        explorer: of the release.
        token: the scenario.
        model: name of a model, whose predictions the replay shows; None for none.
    """
    row, rows = explorer.scenarios.row_of[token], explorer.scenarios
    telling = [name for name, each in explorer.models.items() if each.results and token in each.scenarios]
    shown = model if model in telling and explorer.models[model].setup.task != "detection" else None
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
    explorer, token = explorer_of(request), token_of(request)
    context = scenario_context(explorer, token, request.query_params.get("model"))
    return page(request, "player.html", **context)


def _twin(request: Request) -> Response:
    """A scenario and its twin side by side, in step."""
    explorer, token = explorer_of(request), token_of(request)
    twin = twin_of(explorer.dataset, token)
    if twin is None:
        raise NotAvailableError(f"{token}: this release has no twin of it, with the same name and subtype")
    try:
        diff = twin_diff(explorer.dataset, token)
        shift = diff.shift if diff.accident == token else -diff.shift
    except NotAvailableError:
        shift = 0
    others: dict[str, Any] = {"token": token, "twin": twin["token"], "shift": shift}
    return page(request, "twins.html", **others)


# the parts below a replay


def _part(request: Request) -> Response:
    explorer, token, name = explorer_of(request), token_of(request), request.path_params["part"]
    if name not in PARTS:
        raise HTTPException(404)
    return HTMLResponse(part_html(explorer, token, name, root_of(request.scope["path"])))


def part_html(explorer: Explorer, token: str, name: str, root: str) -> str:
    """One of `PARTS` of a scenario as HTML."""
    return rendered(explorer, f"parts/{name}.html", root, **part_context(explorer.dataset, token, name))


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
            **{name: float(getattr(pairs, name)[at]) for name in ("min_ttc", "min_gap", "max_drac", "pet")},
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
        for agents, lead, frame in zip(COALITIONS, leads.leads.tolist(), leads.first_frames.tolist(), strict=True)
        if not math.isnan(lead)
    ]
    partners = zip(PARTNERS, leads.gains.tolist(), leads.losses.tolist(), leads.shapley.tolist(), strict=True)
    return {"sets": sets, "partners": [(short_name(name), *values) for name, *values in partners]}


def _twins(dataset: Dataset, token: str) -> dict[str, Any]:
    told = twin_diff(dataset, token).to_dict()
    actors = [each for each in told["actors"] if each["parting_frame"]]
    return {"told": told, "actors": actors, "is_accident": told["accident"] == token}


PARTS: Final[Mapping[str, str]] = {
    "story": "What happens",
    "pairs": "Who comes near whom",
    "ledger": "Who sees the danger, and when",
    "twins": "Beside its twin",
    "findings": "Findings of validate",
}
"""Part → its heading."""
_CONTEXTS: Final[Mapping[str, Callable[[Dataset, str], dict[str, Any]]]] = {
    "story": lambda dataset, token: {"text": describe(dataset, token).text},
    "pairs": _pairs,
    "ledger": _ledger,
    "twins": _twins,
    "findings": lambda dataset, token: {"findings": findings(dataset, token)},
}


# a moment


def _moment(request: Request) -> Response:
    """What an agent recorded at a moment: its cameras and LiDAR with boxes, motion labels, and the boxes in numbers."""
    explorer, token, sample = explorer_of(request), token_of(request), sample_of(request)
    record = explorer.dataset.get("sample", sample)
    boxes = explorer.dataset.get_boxes(record, "ego")
    scenario = explorer.dataset.get("scenario", token)
    agents = [each["agent"] for each in explorer.dataset.samples_of(record["frame_token"])]
    return page(
        request,
        "moment.html",
        token=token,
        sample=sample,
        agent=request.path_params["agent"],
        frame=request.path_params["frame"],
        frames=scenario["num_frames"],
        agents=agents,
        labelled=record["labelled"],
        boxes=boxes,
    )
