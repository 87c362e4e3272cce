"""Models: all that were given, what an evaluation says of one, and two side by side."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any, Final, Literal
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation.runs import (
    Bundle,
    ComparedNumber,
    Comparison,
    compare_bundles,
    results_text,
)
from deepaccident_devkit.evaluation.task import value_text
from deepaccident_devkit.plugins.explore.background import Job
from deepaccident_devkit.plugins.explore.evaluations import Evaluated, evaluated, verdict_text
from deepaccident_devkit.plugins.explore.explorer import Explorer
from deepaccident_devkit.plugins.explore.models import Model, Score, sample_values, scores_of
from deepaccident_devkit.plugins.explore.pages import samples
from deepaccident_devkit.plugins.explore.pages.responses import (
    explorer_of,
    page,
    part_of,
    with_slash,
)
from deepaccident_devkit.plugins.explore.pages.samples import (
    SAMPLE,
    SAMPLES_PER_PAGE,
    SampleChoices,
    asked_ahead,
    beside_in_time,
    frames_ahead,
    known_sample,
    list_position,
    listed_samples,
    model_of,
    models_of_task,
    rows_of,
    sample_context,
    sample_path,
    titles,
)

# Samples on a model's page.
_WORST: Final = 12
# Headline numbers in the list of models.
_FIRST: Final = 3
Better = Literal["", "a", "b"]
_BETTER: Final = ("a", "b")
_OTHER: Final = {"a": "b", "b": "a"}


def routes() -> list[Route]:
    """The addresses: `better=a|b` chooses samples, `common=1` compares only the samples that both have."""
    return [
        Route("/models", with_slash),
        Route("/models/", _models),
        Route("/model/{model}", with_slash),
        Route("/model/{model}/", _model),
        *samples.routes(),
        Route("/compare/{a}/{b}", with_slash),
        Route("/compare/{a}/{b}/", _comparison),
        Route(f"/compare/{{a}}/{{b}}/sample/{SAMPLE}", _sample),
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
        "others": [
            each for each in models_of_task(explorer, model.setup.task) if each is not model
        ],
        "away": sorted(
            token for token in model.scenarios if token not in explorer.scenarios.row_of
        ),
        "count": len([*model.tokens]),
    }
    if model.bundle is None:
        return page(request, "model_results.html", **context, **_results_context(explorer, model))
    return page(request, "model.html", **context, **_bundle_context(explorer, model, model.bundle))


def _bundle_context(explorer: Explorer, model: Model, bundle: Bundle) -> dict[str, Any]:
    choices = SampleChoices()
    worst = listed_samples(explorer, model, choices)
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
    command = [
        "deepaccident",
        "evaluate",
        setup.task,
        str(dataset.dataroot),
        "--version",
        dataset.version,
    ]
    command += [
        "--results",
        str(model.results.path),
        "--protocol",
        setup.protocol,
        "--out",
        f"{model.name}_bundle",
    ]
    return {
        "text": results_text(model.results),
        "command": shlex.join(command),
        "first": rows_of(explorer, model, sorted(model.tokens)[:_WORST]),
        "choices": SampleChoices(),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedSample:
    """A sample that two models are evaluated at.

    Attributes:
        token: of the sample.
        a: main number of the first.
        b: of the second.
        difference: b − a of their `sample_values`, where None is as good as can be: nothing is false or missed.
        better: which of them is; empty if they are equally good.
    """

    token: str
    a: Score
    b: Score
    difference: float
    better: Better


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedSamples:
    """All samples that two models are evaluated at.

    Attributes:
        number: name of the main number.
        samples: those with the largest differences first.
        left_out: samples that only one of them has.
    """

    number: str
    samples: tuple[ComparedSample, ...]
    left_out: int

    def chosen(self, better: str) -> Sequence[ComparedSample]:
        """Those where `a` or `b` is better; all for any other text."""
        return (
            [each for each in self.samples if each.better == better]
            if better in ("a", "b")
            else self.samples
        )


def bundle_of(model: Model) -> Bundle:
    """A model's bundle; raises NotAvailableError if it has none."""
    if model.bundle is None:
        raise NotAvailableError(
            f"{model.name}: these are results without an evaluation; only evaluations are compared"
        )
    return model.bundle


def comparison_job(explorer: Explorer, a: Model, b: Model, *, common: bool) -> Job:
    """The work that gives the `Comparison` of two models, at the samples that both have if `common`."""
    first, second = bundle_of(a).folder, bundle_of(b).folder
    name = f"compare {(a.name, b.name, common)}"
    title = f"which differences of {a.name} and {b.name} are real"
    return explorer.jobs.ask(name, title, lambda: compare_bundles(first, second, common=common))


def differences_job(explorer: Explorer, a: Model, b: Model) -> Job:
    """The work that gives the `ComparedSamples` of two models, after that which gives their scores."""
    for model in (a, b):
        _ = model.job  # which comes first
    title = f"at which samples {a.name} and {b.name} differ"
    return explorer.jobs.ask(f"differences {(a.name, b.name)}", title, lambda: _compared(a, b))


def _compared(a: Model, b: Model) -> ComparedSamples:
    first, second = scores_of(a), scores_of(b)
    main = evaluated(bundle_of(a)).main
    best = 0.0 if not first.higher_is_better else 1.0 if main is None else main.limit
    ranked = [
        {token: best if value is None else value for token, value in sample_values(model).items()}
        for model in (a, b)
    ]
    shared = sorted(ranked[0].keys() & ranked[1].keys())
    samples = []
    for token in shared:
        difference = ranked[1][token] - ranked[0][token]
        is_better = (difference > 0) == first.higher_is_better
        better: Better = "" if not difference else "b" if is_better else "a"
        scores = {"a": first.samples[token], "b": second.samples[token]}
        samples.append(ComparedSample(token=token, **scores, difference=difference, better=better))
    samples.sort(key=lambda each: -abs(each.difference))
    left_out = len(first.samples) + len(second.samples) - 2 * len(shared)
    return ComparedSamples(number=first.name, samples=tuple(samples), left_out=left_out)


def _pair(request: Request) -> tuple[Model, Model]:
    """Both models; raises NotAvailableError if there is no such one, or one has no bundle."""
    a, b = model_of(request, "a"), model_of(request, "b")
    bundle_of(a), bundle_of(b)
    return a, b


def _comparison(request: Request) -> Response:
    explorer, (a, b) = explorer_of(request), _pair(request)
    common = request.query_params.get("common") == "1"
    differences = differences_job(explorer, a, b) if a.setup.task == b.setup.task else None
    tests = comparison_job(
        explorer, a, b, common=common
    )  # after the differences, since it takes longer
    work = [tests] if differences is None else [differences, tests]
    waits = titles(work)  # before their results are read: what comes later is not missed
    found: ComparedSamples | None = None if differences is None else differences.result
    compared: Comparison | None = tests.result
    better = _asked_better(request)
    part = part_of(request, () if found is None else found.chosen(better), SAMPLES_PER_PAGE)
    told = evaluated(bundle_of(a)), evaluated(bundle_of(b))
    return page(
        request,
        "compare.html",
        a=a,
        b=b,
        marks=[(name, each.mark) for name, each in zip(_BETTER, told, strict=True) if each.mark],
        tests=tests,
        comparison=compared,
        numbers=_sides(*told)
        if compared is None
        else [_tested(each) for each in compared.numbers if each.headline],
        partly=not common and a.rows.keys() != b.rows.keys(),
        found=found,
        fault="" if differences is None else differences.error,
        counts={"": len(found.samples), **{each: len(found.chosen(each)) for each in _BETTER}}
        if found
        else {},
        better=better,
        address=partial(_address, better=better, common="1" if common else ""),
        swapped=_address(better=_OTHER.get(better, ""), common="1" if common else ""),
        part=part,
        rows=[_row(a, b, each) for each in part.entries],
        waits=waits,
    )


def _asked_better(request: Request) -> str:
    given = request.query_params.get("better", "")
    return given if given in _BETTER else ""


def _address(**chosen: object) -> str:
    """The parameters of the address with these choices; those that are empty are left out."""
    given = {name: value for name, value in chosen.items() if value}
    return f"?{urlencode(given)}" if given else ""


def _tested(number: ComparedNumber) -> dict[str, str]:
    """A headline number of both, and whether its difference is real."""
    unit: Any = number.unit
    return {
        "name": str(number.headline),
        "a": value_text(number.a, unit),
        "b": value_text(number.b, unit),
        "difference": value_text(number.difference, unit, signed=True),
        "interval": ""
        if number.low is None or number.high is None
        else f"{number.low:+.3f} to {number.high:+.3f}",
        "p": "–" if number.adjusted_p is None else f"{number.adjusted_p:.3f}",
        "decision": number.decision,
    }


def _sides(a: Evaluated, b: Evaluated) -> list[dict[str, str]]:
    """The headline numbers of both, without tests."""
    values = [{each["name"]: each["text"] for each in told.headlines} for told in (a, b)]
    names = list(dict.fromkeys(name for each in values for name in each))
    return [
        {
            "name": name,
            **{side: each.get(name, "–") for side, each in zip(_BETTER, values, strict=True)},
        }
        for name in names
    ]


def _row(a: Model, b: Model, each: ComparedSample) -> dict[str, Any]:
    words = [verdict_text(model.setup.task, model.rows.get(each.token, {})) for model in (a, b)]
    return {"sample": each, "path": sample_path(each.token), "a": words[0], "b": words[1]}


def _sample(request: Request) -> Response:
    explorer, (a, b) = explorer_of(request), _pair(request)
    token = known_sample(request, a, b)
    before, after = beside_in_time(a.rows.keys() & b.rows.keys(), token)
    job = differences_job(explorer, a, b)
    better = _asked_better(request)
    waits = titles([job])
    found: ComparedSamples | None = job.result
    ranked = () if found is None else tuple(each.token for each in found.chosen(better))
    return page(
        request,
        "compare_sample.html",
        a=a,
        b=b,
        token=token,
        path=sample_path(token),
        sides=[sample_context(explorer, model, token) for model in (a, b)],
        before=before,
        after=after,
        place=list_position(ranked, token),
        better=better,
        address=partial(_address, better=better),
        swapped=_address(better=_OTHER.get(better, "")),
        ahead=asked_ahead(request),
        aheads=frames_ahead(explorer, a, token) and frames_ahead(explorer, b, token),
        waits=waits,
        sample_path=sample_path,
    )
