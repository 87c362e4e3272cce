"""Models: all that were given, and what an evaluation says of one; results without one show how to evaluate them."""

from __future__ import annotations

import shlex
from collections import Counter
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.evaluation.runs import (
    Bundle,
    results_text,
    scenario_hashes,
)
from deepaccident_devkit.evaluation.runs.selection import agent_of
from deepaccident_devkit.explore.background import Job
from deepaccident_devkit.explore.evaluations import evaluated
from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.models import Model
from deepaccident_devkit.explore.pages import comparison, samples
from deepaccident_devkit.explore.pages.answers import explorer_of, page, with_slash
from deepaccident_devkit.explore.pages.samples import model_of, models_of_task, rows_of, titles
from deepaccident_devkit.explore.sample_lists import SampleChoices, listed
from deepaccident_devkit.taxonomy import AGENTS, SPLITS

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.evaluation.results import Results
    from deepaccident_devkit.explore.explorer import Explorer
    from deepaccident_devkit.explore.models import Model

_USUAL_VERSION: Final = "v1"
_WORST: Final = 12
"""Samples on a model's page."""
_FEW: Final = 64
"""Scenarios up to which their files are read without being asked to."""
_FIRST: Final = 3
"""Headline numbers in the list of models."""


def evaluate_command(dataset: Dataset, model: Model, results: Results) -> str:
    """The command for a shell that makes a bundle of results: of their split and agents, with the usual samples."""
    present = set(map(agent_of, results.tokens))
    agents = [name for name in AGENTS if name in present]
    words = ["deepaccident", "evaluate", model.setup.task, str(dataset.dataroot)]
    words += ["--version", dataset.version] if dataset.version != _USUAL_VERSION else []
    words += ["--results", str(results.path), "--split", split_of(dataset, results)]
    if agents and any(agent["name"] not in present for agent in dataset.agent):
        words += ["--agents", ",".join(agents)]
    words += ["--protocol", model.setup.protocol, "--horizon", f"{model.setup.horizon:g}"]
    return shlex.join([*words, "--out", f"{model.name}_bundle"])


def split_of(dataset: Dataset, results: Results) -> str:
    """The split of most of the scenarios that results tell of; `val` if they are of none."""
    scenarios = {token.rsplit("/", 2)[0] for token in results.tokens}
    splits = Counter(each["split"] for each in dataset.scenario if each["token"] in scenarios)
    known = {name: count for name, count in splits.items() if name in SPLITS}
    return max(known, key=lambda name: known[name], default="val")


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
    asked = request.query_params.get("check") == "truth"
    return page(request, "model.html", **context, **_bundle_context(explorer, model, model.bundle, asked=asked))


def _bundle_context(explorer: Explorer, model: Model, bundle: Bundle, *, asked: bool) -> dict[str, Any]:
    choices = SampleChoices()
    truth: Job | None = None
    if asked or len(model.scenarios) <= _FEW:
        truth = truth_job(explorer, model.name, bundle)
    worst = listed(explorer, model, choices)
    return {
        "told": evaluated(bundle),
        "truth": truth,
        "worst": rows_of(explorer, model, worst.tokens[:_WORST]) if not worst.waits else [],
        "ranked": worst.ranked,
        "faults": worst.faults,
        "waits": [*worst.waits],
        "checks": titles([truth] if truth is not None else []),
        "choices": choices,
        "path": bundle.summary["results"]["path"],
    }


def _results_context(explorer: Explorer, model: Model) -> dict[str, Any]:
    if model.results is None:
        return {}
    return {
        "text": results_text(model.results),
        "command": evaluate_command(explorer.dataset, model, model.results),
        "first": rows_of(explorer, model, sorted(model.tokens)[:_WORST]),
        "choices": SampleChoices(),
    }


def truth_job(explorer: Explorer, name: str, bundle: Bundle) -> Job:
    """The work that compares the truth of a model's bundle with the release's: it reads the files of all its scenarios.

    It gives `checked`, how many scenarios both have, and `differing`, those whose label, meta or calib files differ.
    """

    def work() -> dict[str, Any]:
        stated = bundle.scenarios()
        found = scenario_hashes(explorer.dataset, stated, workers=explorer.workers)
        differing = tuple(token for token, each in found.items() if each.as_dict() != stated[token])
        return {"checked": len(found), "differing": differing}

    return explorer.jobs.ask(f"truth {name}", f"whether the labels are those that {name} was evaluated with", work)
