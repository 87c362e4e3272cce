"""Pages of models: the list, the evaluation of each, and comparisons of two."""

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
from deepaccident_devkit.plugins.explore.evaluations import (
    EvaluationNumbers,
    read_numbers,
    verdict_text,
)
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
    frames_ahead,
    known_sample,
    list_position,
    list_samples,
    model_of,
    models_of_task,
    neighbours_in_time,
    requested_frame,
    rows_of,
    sample_context,
    sample_path,
    titles,
)

# Number of samples on a model's page.
_NUM_WORST_SAMPLES: Final = 12
# Number of headline numbers in the list of models.
_NUM_HEADLINES: Final = 3
Better = Literal["", "a", "b"]
_SIDES: Final = ("a", "b")
_OTHER_SIDE: Final = {"a": "b", "b": "a"}


def routes() -> list[Route]:
    """Return the routes of the pages.

    `better=a|b` chooses samples, `common=1` compares only the samples that both models have.
    """
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
    models = [*explorer.models.values()]
    evaluated = [model for model in models if model.bundle is not None]
    pairs = [(a, b) for a, b in combinations(evaluated, 2) if a.setup.task == b.setup.task]
    return page(
        request,
        "models.html",
        given=[(model, _list_numbers(model)) for model in models],
        pairs=pairs,
        command=shlex.join(["deepaccident", "explore", str(explorer.dataset.dataroot)]),
    )


def _list_numbers(model: Model) -> dict[str, Any]:
    """Return what the list shows of a model."""
    if model.bundle is None:
        return {"mark": "", "headlines": (), "samples": len([*model.tokens])}
    numbers = read_numbers(model.bundle)
    headlines = numbers.headlines[:_NUM_HEADLINES]
    return {"mark": numbers.mark, "headlines": headlines, "samples": len(model.rows)}


def _model(request: Request) -> Response:
    explorer, model = explorer_of(request), model_of(request)
    same_task = models_of_task(explorer, model.setup.task)
    known_scenarios = explorer.scenarios.row_of
    context: dict[str, Any] = {
        "model": model,
        "others": [other for other in same_task if other is not model],
        "away": sorted(token for token in model.scenarios if token not in known_scenarios),
        "count": len([*model.tokens]),
    }
    if model.bundle is None:
        return page(request, "model_results.html", **context, **_results_context(explorer, model))
    return page(request, "model.html", **context, **_bundle_context(explorer, model, model.bundle))


def _bundle_context(explorer: Explorer, model: Model, bundle: Bundle) -> dict[str, Any]:
    choices = SampleChoices()
    worst = list_samples(explorer, model, choices)
    rows = []
    if not worst.waits:
        rows = rows_of(explorer, model, worst.tokens[:_NUM_WORST_SAMPLES])
    return {
        "told": read_numbers(bundle),
        "worst": rows,
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
    command = ["deepaccident", "evaluate", setup.task, str(dataset.dataroot)]
    command += ["--version", dataset.version, "--results", str(model.results.path)]
    command += ["--protocol", setup.protocol, "--out", f"{model.name}_bundle"]
    tokens = sorted(model.tokens)[:_NUM_WORST_SAMPLES]
    return {
        "text": results_text(model.results),
        "command": shlex.join(command),
        "first": rows_of(explorer, model, tokens),
        "choices": SampleChoices(),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedSample:
    """A sample of the evaluations of two models.

    Attributes:
        token: Token of the sample.
        a: Main number of the first model.
        b: Main number of the second model.
        difference: b − a of their `sample_values`, where None is as good as can be: nothing is
            false or missed.
        better: The better model; empty if they are equally good.
    """

    token: str
    a: Score
    b: Score
    difference: float
    better: Better


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedSamples:
    """All samples of the evaluations of two models.

    Attributes:
        number: Name of the main number.
        samples: Samples, the largest differences first.
        left_out: Number of samples that only one model has.
    """

    number: str
    samples: tuple[ComparedSample, ...]
    left_out: int

    def chosen(self, better: str) -> Sequence[ComparedSample]:
        """Return the samples where `a` or `b` is better; all for any other text."""
        if better not in ("a", "b"):
            return self.samples
        return [sample for sample in self.samples if sample.better == better]


def bundle_of(model: Model) -> Bundle:
    """Return a model's bundle; raise NotAvailableError if it has none."""
    if model.bundle is None:
        raise NotAvailableError(
            f"{model.name}: these are results without an evaluation; only evaluations are compared"
        )
    return model.bundle


def comparison_job(explorer: Explorer, a: Model, b: Model, *, common: bool) -> Job:
    """Return the job that computes the `Comparison` of two models.

    If `common`, it only compares the samples that both have.
    """
    folder_a, folder_b = bundle_of(a).folder, bundle_of(b).folder
    name = f"compare {(a.name, b.name, common)}"
    title = f"which differences of {a.name} and {b.name} are real"
    work = partial(compare_bundles, folder_a, folder_b, common=common)
    return explorer.jobs.ask(name, title, work)


def differences_job(explorer: Explorer, a: Model, b: Model) -> Job:
    """Return the job that computes the `ComparedSamples` of two models, after their scores."""
    for model in (a, b):
        _ = model.job  # begins first
    name = f"differences {(a.name, b.name)}"
    title = f"at which samples {a.name} and {b.name} differ"
    return explorer.jobs.ask(name, title, partial(_compare_samples, a, b))


def _compare_samples(a: Model, b: Model) -> ComparedSamples:
    scores_a, scores_b = scores_of(a), scores_of(b)
    higher_is_better = scores_a.higher_is_better
    main = read_numbers(bundle_of(a)).main
    best_value = 0.0
    if higher_is_better:
        best_value = 1.0
        if main is not None:
            best_value = main.limit
    values_a, values_b = _filled_values(a, best_value), _filled_values(b, best_value)
    common_tokens = sorted(values_a.keys() & values_b.keys())
    samples = []
    for token in common_tokens:
        difference = values_b[token] - values_a[token]
        better: Better = ""
        if difference:
            better = "b" if (difference > 0) == higher_is_better else "a"
        sample = ComparedSample(
            token=token,
            a=scores_a.samples[token],
            b=scores_b.samples[token],
            difference=difference,
            better=better,
        )
        samples.append(sample)
    samples.sort(key=lambda sample: -abs(sample.difference))
    left_out = len(scores_a.samples) + len(scores_b.samples) - 2 * len(common_tokens)
    return ComparedSamples(number=scores_a.name, samples=tuple(samples), left_out=left_out)


def _filled_values(model: Model, best_value: float) -> dict[str, float]:
    """Return the `sample_values` of a model, with the best value for None."""
    values = sample_values(model).items()
    return {token: best_value if value is None else value for token, value in values}


def _model_pair(request: Request) -> tuple[Model, Model]:
    """Return both models; raise NotAvailableError if one does not exist, or has no bundle."""
    a, b = model_of(request, "a"), model_of(request, "b")
    bundle_of(a)
    bundle_of(b)
    return a, b


def _comparison(request: Request) -> Response:
    explorer, (a, b) = explorer_of(request), _model_pair(request)
    common = request.query_params.get("common") == "1"
    # The tests take longer, so they come after the differences.
    differences = None
    if a.setup.task == b.setup.task:
        differences = differences_job(explorer, a, b)
    tests = comparison_job(explorer, a, b, common=common)
    jobs = [tests] if differences is None else [differences, tests]
    waits = titles(jobs)  # read before the results, so that a job that ends meanwhile is not missed
    samples: ComparedSamples | None = None if differences is None else differences.result
    comparison: Comparison | None = tests.result
    better = _better_side(request)
    part = part_of(request, () if samples is None else samples.chosen(better), SAMPLES_PER_PAGE)
    numbers_a, numbers_b = read_numbers(bundle_of(a)), read_numbers(bundle_of(b))
    marks = [
        (side, mark)
        for side, mark in zip(_SIDES, (numbers_a.mark, numbers_b.mark), strict=True)
        if mark
    ]
    if comparison is None:
        numbers = _untested_rows(numbers_a, numbers_b)
    else:
        numbers = [_tested_row(number) for number in comparison.numbers if number.headline]
    counts: dict[str, int] = {}
    if samples:
        counts[""] = len(samples.samples)
        for side in _SIDES:
            counts[side] = len(samples.chosen(side))
    common_text = "1" if common else ""
    return page(
        request,
        "compare.html",
        a=a,
        b=b,
        marks=marks,
        tests=tests,
        comparison=comparison,
        numbers=numbers,
        partly=not common and a.rows.keys() != b.rows.keys(),
        found=samples,
        fault="" if differences is None else differences.error,
        counts=counts,
        better=better,
        address=partial(_address, better=better, common=common_text),
        swapped=_address(better=_OTHER_SIDE.get(better, ""), common=common_text),
        part=part,
        rows=[_sample_row(a, b, sample) for sample in part.entries],
        waits=waits,
    )


def _better_side(request: Request) -> str:
    side = request.query_params.get("better", "")
    if side in _SIDES:
        return side
    return ""


def _address(**parameters: object) -> str:
    """Return the parameters of an address; empty ones are left out."""
    present = {name: value for name, value in parameters.items() if value}
    if present:
        return f"?{urlencode(present)}"
    return ""


def _tested_row(number: ComparedNumber) -> dict[str, str]:
    """Return a headline number of both models, and whether its difference is real."""
    unit: Any = number.unit
    interval = ""
    if number.low is not None and number.high is not None:
        interval = f"{number.low:+.3f} to {number.high:+.3f}"
    return {
        "name": str(number.headline),
        "a": value_text(number.a, unit),
        "b": value_text(number.b, unit),
        "difference": value_text(number.difference, unit, signed=True),
        "interval": interval,
        "p": "–" if number.adjusted_p is None else f"{number.adjusted_p:.3f}",
        "decision": number.decision,
    }


def _untested_rows(a: EvaluationNumbers, b: EvaluationNumbers) -> list[dict[str, str]]:
    """Return the headline numbers of both models, without tests."""
    texts_a = {headline["name"]: headline["text"] for headline in a.headlines}
    texts_b = {headline["name"]: headline["text"] for headline in b.headlines}
    names = list(dict.fromkeys([*texts_a, *texts_b]))
    return [
        {"name": name, "a": texts_a.get(name, "–"), "b": texts_b.get(name, "–")} for name in names
    ]


def _sample_row(a: Model, b: Model, sample: ComparedSample) -> dict[str, Any]:
    token = sample.token
    return {
        "sample": sample,
        "path": sample_path(token),
        "a": verdict_text(a.setup.task, a.rows.get(token, {})),
        "b": verdict_text(b.setup.task, b.rows.get(token, {})),
    }


def _sample(request: Request) -> Response:
    explorer, (a, b) = explorer_of(request), _model_pair(request)
    token = known_sample(request, a, b)
    before, after = neighbours_in_time(a.rows.keys() & b.rows.keys(), token)
    job = differences_job(explorer, a, b)
    better = _better_side(request)
    waits = titles([job])  # read before the result
    samples: ComparedSamples | None = job.result
    ranked: tuple[str, ...] = ()
    if samples is not None:
        ranked = tuple(sample.token for sample in samples.chosen(better))
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
        swapped=_address(better=_OTHER_SIDE.get(better, "")),
        ahead=requested_frame(request),
        aheads=frames_ahead(explorer, a, token) and frames_ahead(explorer, b, token),
        waits=waits,
        sample_path=sample_path,
    )
