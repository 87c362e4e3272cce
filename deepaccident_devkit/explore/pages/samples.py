"""A model's samples: those of a group, the worst first; and one of them: prediction over truth, and the verdict."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.evaluation.runs.selection import agent_of, scenario_of
from deepaccident_devkit.explore.evaluations import finite
from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.models import Model
from deepaccident_devkit.explore.pages.answers import explorer_of, page, picture
from deepaccident_devkit.explore.pages.model_addresses import (
    SAMPLE,
    beside_in_time,
    known_sample,
    model_of,
    sample_path,
)
from deepaccident_devkit.explore.pages.release_tabs import part_of
from deepaccident_devkit.explore.predicted import Shown, frames_ahead, picture_of, rules_words, why_not
from deepaccident_devkit.explore.sample_lists import ORDERS, SampleChoices, is_sample, listed
from deepaccident_devkit.explore.verdicts import other_values, verdict

PAGE: Final = 60
"""Samples on a page of the list."""


def routes() -> list[Route]:
    """The addresses; those of a sample take the choices of the list, so that the way through it is known."""
    return [
        Route("/model/{model}/samples", _samples),
        Route(f"/model/{{model}}/sample/{SAMPLE}", _sample),
        Route(f"/model/{{model}}/sample/{SAMPLE}/above.png", _above),
        Route(f"/model/{{model}}/sample/{SAMPLE}/cameras.png", _cameras),
    ]


def rows_of(explorer: Explorer, model: Model, tokens: Iterable[str]) -> list[dict[str, Any]]:
    """What lists show of samples."""
    samples = model.scores.samples if model.scores is not None else {}
    rows = []
    for token in tokens:
        row = model.rows.get(token)
        rows.append(
            {
                "token": token,
                "path": sample_path(token),
                "scenario": scenario_of(token),
                "agent": agent_of(token),
                "frame": token.rpartition("/")[2],
                "ahead": None if row is None else finite(row.get("time_to_impact")),
                "verdict": "" if row is None else verdict(model.setup.task, row),
                "number": samples[token].text if token in samples else "",
                "here": is_sample(explorer.dataset, token),
            }
        )
    return rows


def _samples(request: Request) -> Response:
    explorer, model = explorer_of(request), model_of(request)
    choices = SampleChoices.of(request.query_params)
    found = listed(explorer, model, choices)
    part = part_of(request, found.tokens, PAGE)
    return page(
        request,
        "samples.html",
        model=model,
        choices=choices,
        found=found,
        orders=ORDERS,
        part=part,
        rows=rows_of(explorer, model, part.entries),
        waits=[*found.waits],
        number=model.scores.name if model.scores is not None and found.ranked else "",
    )


def _sample(request: Request) -> Response:
    explorer, model = explorer_of(request), model_of(request)
    token = known_sample(request, model)
    choices = SampleChoices.of(request.query_params)
    before, after = beside_in_time(model.tokens, token)
    found = listed(explorer, model, choices)
    return page(
        request,
        "sample.html",
        **sample_context(explorer, model, token),
        before=before,
        after=after,
        choices=choices,
        place=place_in(found.tokens, token),
        order=ORDERS[found.order],
        ahead=asked_ahead(request),
        waits=[*found.waits],
        aheads=frames_ahead(explorer, model, token),
        sample_path=sample_path,
    )


def sample_context(explorer: Explorer, model: Model, token: str) -> dict[str, Any]:
    """What is shown of a model at a sample."""
    row = model.rows.get(token)
    name, score = ("", None) if model.scores is None else (model.scores.name, model.scores.samples.get(token))
    return {
        "model": model,
        "token": token,
        "path": sample_path(token),
        "scenario": scenario_of(token),
        "agent": agent_of(token),
        "frame": int(token.rpartition("/")[2]),
        "here": is_sample(explorer.dataset, token),
        "evaluated": row is not None,
        "verdict": "" if row is None else verdict(model.setup.task, row, whole=True),
        "values": {} if row is None else other_values(row),
        "number": "" if score is None or score.value is None else f"{name} {score.text}",
        "why_not": why_not(explorer, model, token),
        "rules": rules_words(model),
        "remedy": _remedy(model),
    }


def _remedy(model: Model) -> str:
    """Where the results were of a bundle that has none to show; empty if there are results."""
    if model.results is not None or model.bundle is None:
        return ""
    path: str = model.bundle.summary["results"]["path"]
    return path


def place_in(tokens: Sequence[str], token: str) -> dict[str, Any] | None:
    """Where a sample is in a list: its number, how many there are, and those before and after it; None if it is not."""
    if token not in tokens:
        return None
    at = tokens.index(token)
    before, after = tokens[:at][-1:], tokens[at + 1 : at + 2]
    return {
        "number": at + 1,
        "count": len(tokens),
        "before": before[0] if before else None,
        "after": after[0] if after else None,
    }


def _above(request: Request) -> Response:
    return _picture(request, Shown(kind="above", size=_size(request)))


def _cameras(request: Request) -> Response:
    return _picture(request, Shown(kind="cameras", size=_size(request), ahead=asked_ahead(request)))


def _picture(request: Request, shown: Shown) -> Response:
    explorer, model = explorer_of(request), model_of(request)
    return picture(picture_of(explorer, model, known_sample(request, model), shown), "png")


def _size(request: Request) -> Any:
    return "half" if request.query_params.get("size") == "half" else "whole"


def asked_ahead(request: Request) -> int:
    """The frame that cameras show; raises HTTPException."""
    given = request.query_params.get("ahead", "0")
    if not (given.isascii() and given.isdecimal() and len(given) < 3):
        raise HTTPException(404)
    return int(given)
