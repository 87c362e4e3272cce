"""Models: all that were given, and what an evaluation says of one; results without one show how to evaluate them."""

from __future__ import annotations

import shlex
from itertools import combinations
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.evaluation.runs import Bundle, results_text
from deepaccident_devkit.explore.evaluations import evaluated
from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.models import Model
from deepaccident_devkit.explore.pages import comparison, samples
from deepaccident_devkit.explore.pages.answers import explorer_of, page, with_slash
from deepaccident_devkit.explore.pages.samples import model_of, models_of_task, rows_of
from deepaccident_devkit.explore.sample_lists import SampleChoices, listed

_WORST: Final = 12
"""Samples on a model's page."""
_FIRST: Final = 3
"""Headline numbers in the list of models."""


def routes() -> list[Route]:
    """The addresses."""
    return [
        Route("/models", with_slash),
        Route("/models/", _models),
        Route("/model/{model}", with_slash),
        Route("/model/{model}/", _model),
        *samples.routes(),
        *comparison.routes(),
    ]


def _models(request: Request) -> Response:
    explorer = explorer_of(request)
    given = [*explorer.models.values()]
    return page(
        request,
        "models.html",
        given=[(each, _numbers(each)) for each in given],
        pairs=[
            (one, other)
            for one, other in combinations([each for each in given if each.bundle is not None], 2)
            if one.setup.task == other.setup.task
        ],
        command=shlex.join(["deepaccident", "explore", str(explorer.dataset.dataroot)]),
    )


def _numbers(model: Model) -> dict[str, Any]:
    """What the list says of a model."""
    if model.bundle is None:
        return {"mark": "", "headlines": (), "samples": len([*model.tokens])}
    told = evaluated(model.bundle)
    return {"mark": told.mark, "headlines": told.headlines[:_FIRST], "samples": len(model.rows)}


def _model(request: Request) -> Response:
    explorer, model = explorer_of(request), model_of(request)
    context: dict[str, Any] = {
        "model": model,
        "others": [each for each in models_of_task(explorer, model.setup.task) if each is not model],
        "away": sorted(token for token in model.scenarios if token not in explorer.scenarios.row_of),
        "count": len([*model.tokens]),
    }
    if model.bundle is None:
        return page(request, "model_results.html", **context, **_results_context(explorer, model))
    return page(request, "model.html", **context, **_bundle_context(explorer, model, model.bundle))


def _bundle_context(explorer: Explorer, model: Model, bundle: Bundle) -> dict[str, Any]:
    choices = SampleChoices()
    worst = listed(explorer, model, choices)
    return {
        "told": evaluated(bundle),
        "worst": rows_of(explorer, model, worst.tokens[:_WORST]) if not worst.waits else [],
        "ranked": worst.ranked,
        "faults": worst.faults,
        "waits": [*worst.waits],
        "choices": choices,
        "path": bundle.summary["results"]["path"],
    }


def _results_context(explorer: Explorer, model: Model) -> dict[str, Any]:
    if model.results is None:
        return {}
    setup, dataset = model.setup, explorer.dataset
    command = ["deepaccident", "evaluate", setup.task, str(dataset.dataroot), "--version", dataset.version]
    command += ["--results", str(model.results.path), "--protocol", setup.protocol, "--out", f"{model.name}_bundle"]
    return {
        "text": results_text(model.results),
        "command": shlex.join(command),
        "first": rows_of(explorer, model, sorted(model.tokens)[:_WORST]),
        "choices": SampleChoices(),
    }
