"""Pages of models: a list of them, the evaluation of each, and comparisons of two."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any, Literal
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
from deepaccident_devkit.plugins.explore.models import Model, Score, rank_samples, require_scores
from deepaccident_devkit.plugins.explore.pages import samples
from deepaccident_devkit.plugins.explore.pages.responses import (
    Variables,
    add_slash,
    get_explorer,
    render_page,
    select_page,
)
from deepaccident_devkit.plugins.explore.pages.samples import (
    SAMPLE,
    SAMPLES_PER_PAGE,
    SampleChoices,
    find_model,
    find_models,
    find_neighbours,
    find_position,
    find_sample,
    list_frames_ahead,
    list_samples,
    list_titles,
    make_rows,
    make_sample_context,
    read_frame_ahead,
    sample_path,
)

# Number of samples on a model's page.
_NUM_WORST_SAMPLES = 12
# Number of headline numbers in the list of models.
_NUM_HEADLINES = 3
Better = Literal["", "a", "b"]
_SIDES = ("a", "b")
_OTHER_SIDE = {"a": "b", "b": "a"}


def routes() -> list[Route]:
    """Return the routes of the pages.

    `better=a|b` selects samples, and `common=1` compares only the samples that both models have.
    """
    return [
        Route("/models", add_slash),
        Route("/models/", _show_models),
        Route("/model/{model}", add_slash),
        Route("/model/{model}/", _show_model),
        *samples.routes(),
        Route("/compare/{a}/{b}", add_slash),
        Route("/compare/{a}/{b}/", _show_comparison),
        Route(f"/compare/{{a}}/{{b}}/sample/{SAMPLE}", _show_sample),
    ]


def _show_models(request: Request) -> Response:
    """Render the page that lists the models and the pairs that can be compared."""
    explorer = get_explorer(request)
    models = list(explorer.models.values())
    evaluated = [model for model in models if model.bundle is not None]
    pairs = [(a, b) for a, b in combinations(evaluated, 2) if a.setup.task == b.setup.task]
    return render_page(
        request,
        "models.html",
        models_with_numbers=[(model, _list_numbers(model)) for model in models],
        pairs=pairs,
        command=shlex.join(["deepaccident", "explore", str(explorer.dataset.dataroot)]),
    )


def _list_numbers(model: Model) -> Variables:
    """Return what the list of models shows about one model."""
    if model.bundle is None:
        return {"mark": "", "headlines": (), "samples": len([*model.tokens])}
    numbers = read_numbers(model.bundle)
    headlines = numbers.headlines[:_NUM_HEADLINES]
    return {"mark": numbers.mark, "headlines": headlines, "samples": len(model.rows)}


def _show_model(request: Request) -> Response:
    explorer = get_explorer(request)
    model = find_model(request)
    same_task = find_models(explorer, model.setup.task)
    known_scenarios = explorer.scenarios.row_of
    context: Variables = {
        "model": model,
        "others": [other for other in same_task if other is not model],
        "away": sorted(token for token in model.scenarios if token not in known_scenarios),
        "count": len([*model.tokens]),
    }
    if model.bundle is None:
        return render_page(
            request, "model_results.html", **context, **_make_results_context(explorer, model)
        )
    return render_page(
        request, "model.html", **context, **_make_bundle_context(explorer, model, model.bundle)
    )


def _make_bundle_context(explorer: Explorer, model: Model, bundle: Bundle) -> Variables:
    choices = SampleChoices()
    worst = list_samples(explorer, model, choices)
    rows = []
    if not worst.waits:
        rows = make_rows(explorer, model, worst.tokens[:_NUM_WORST_SAMPLES])
    return {
        "told": read_numbers(bundle),
        "worst": rows,
        "ranked": worst.ranked,
        "faults": worst.faults,
        "waits": [*worst.waits],
        "choices": choices,
    }


def _make_results_context(explorer: Explorer, model: Model) -> Variables:
    if model.results is None:
        return {}
    setup = model.setup
    dataset = explorer.dataset
    command = ["deepaccident", "evaluate", setup.task, str(dataset.dataroot)]
    command += ["--version", dataset.version, "--results", str(model.results.path)]
    command += ["--protocol", setup.protocol, "--out", f"{model.name}_bundle"]
    tokens = sorted(model.tokens)[:_NUM_WORST_SAMPLES]
    return {
        "text": results_text(model.results),
        "command": shlex.join(command),
        "first": make_rows(explorer, model, tokens),
        "choices": SampleChoices(),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedSample:
    """A sample with the scores of two models.

    Attributes:
        token: Token of the sample.
        a: Main number of the first model.
        b: Main number of the second model.
        difference: Difference b − a of their values in `rank_samples`; None is replaced by the best
            possible value, since nothing is false or missed.
        better: The better model; empty if both are equally good.
    """

    token: str
    a: Score
    b: Score
    difference: float
    better: Better


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedSamples:
    """All samples with scores of two models.

    Attributes:
        number: Name of the main number.
        samples: Samples, the ones with the largest differences first.
        left_out: Number of samples that only one model has.
    """

    number: str
    samples: tuple[ComparedSample, ...]
    left_out: int

    def chosen(self, better: str) -> Sequence[ComparedSample]:
        """Return the samples at which model `a` or `b` is better; all samples for other texts."""
        if better not in _SIDES:
            return self.samples
        return [sample for sample in self.samples if sample.better == better]


def require_bundle(model: Model) -> Bundle:
    """Return the bundle of a model; raise NotAvailableError if it has none."""
    if model.bundle is None:
        raise NotAvailableError(
            f"{model.name}: these are results without an evaluation; only evaluations are compared"
        )
    return model.bundle


def request_comparison(explorer: Explorer, a: Model, b: Model, *, common: bool) -> Job:
    """Return the job that computes the `Comparison` of two models.

    Args:
        explorer: Explorer of the models.
        a: The first model.
        b: The second model.
        common: Whether to compare only the samples that both models have.
    """
    folder_a = require_bundle(a).folder
    folder_b = require_bundle(b).folder
    name = f"compare {(a.name, b.name, common)}"
    title = f"which differences of {a.name} and {b.name} are real"
    work = partial(compare_bundles, folder_a, folder_b, common=common)
    return explorer.jobs.ask(name, title, work)


def request_differences(explorer: Explorer, a: Model, b: Model) -> Job:
    """Return the job that computes the `ComparedSamples` of two models, after their scores."""
    for model in (a, b):
        _ = model.job  # This job begins first.
    name = f"differences {(a.name, b.name)}"
    title = f"at which samples {a.name} and {b.name} differ"
    return explorer.jobs.ask(name, title, partial(_compare_samples, a, b))


def _compare_samples(a: Model, b: Model) -> ComparedSamples:
    scores_a = require_scores(a)
    scores_b = require_scores(b)
    higher_is_better = scores_a.higher_is_better
    main = read_numbers(require_bundle(a)).main
    best_value = 0.0
    if higher_is_better:
        best_value = 1.0
        if main is not None:
            best_value = main.limit
    values_a = _fill_values(a, best_value)
    values_b = _fill_values(b, best_value)
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


def _fill_values(model: Model, best_value: float) -> dict[str, float]:
    """Return the values of `rank_samples` of a model, with the best value instead of None."""
    values = rank_samples(model).items()
    return {token: best_value if value is None else value for token, value in values}


def _find_model_pair(request: Request) -> tuple[Model, Model]:
    """Return the models `a` and `b` of a request; raise NotAvailableError without both bundles."""
    a = find_model(request, "a")
    b = find_model(request, "b")
    require_bundle(a)
    require_bundle(b)
    return a, b


def _show_comparison(request: Request) -> Response:
    explorer = get_explorer(request)
    a, b = _find_model_pair(request)
    common = request.query_params.get("common") == "1"
    # The tests take longer, so they come after the differences.
    differences = None
    if a.setup.task == b.setup.task:
        differences = request_differences(explorer, a, b)
    tests = request_comparison(explorer, a, b, common=common)
    jobs = [tests] if differences is None else [differences, tests]
    # Titles are read before the results, so that no job that ends meanwhile is missed.
    waits = list_titles(jobs)
    samples: ComparedSamples | None = None if differences is None else differences.result
    comparison: Comparison | None = tests.result
    better = _read_better_side(request)
    part = select_page(request, () if samples is None else samples.chosen(better), SAMPLES_PER_PAGE)
    numbers_a = read_numbers(require_bundle(a))
    numbers_b = read_numbers(require_bundle(b))
    side_marks = {"a": numbers_a.mark, "b": numbers_b.mark}
    marks = [(side, mark) for side, mark in side_marks.items() if mark]
    if comparison is None:
        numbers = _make_untested_rows(numbers_a, numbers_b)
    else:
        numbers = [_make_tested_row(number) for number in comparison.numbers if number.headline]
    counts: dict[str, int] = {}
    if samples:
        counts[""] = len(samples.samples)
        for side in _SIDES:
            counts[side] = len(samples.chosen(side))
    common_text = "1" if common else ""
    return render_page(
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
        address=partial(_format_query, better=better, common=common_text),
        swapped=_format_query(better=_OTHER_SIDE.get(better, ""), common=common_text),
        part=part,
        rows=[_make_sample_row(a, b, sample) for sample in part.entries],
        waits=waits,
    )


def _read_better_side(request: Request) -> str:
    side = request.query_params.get("better", "")
    if side in _SIDES:
        return side
    return ""


def _format_query(**parameters: object) -> str:
    """Return the parameters of an address; empty parameters are left out."""
    present = {name: value for name, value in parameters.items() if value}
    if present:
        return f"?{urlencode(present)}"
    return ""


def _make_tested_row(number: ComparedNumber) -> dict[str, str]:
    """Return a headline number of both models, and whether they differ significantly."""
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


def _make_untested_rows(a: EvaluationNumbers, b: EvaluationNumbers) -> list[dict[str, str]]:
    """Return the headline numbers of both models, without tests."""
    texts_a = {headline["name"]: headline["text"] for headline in a.headlines}
    texts_b = {headline["name"]: headline["text"] for headline in b.headlines}
    rows = []
    for name in {**texts_a, **texts_b}:
        rows.append({"name": name, "a": texts_a.get(name, "–"), "b": texts_b.get(name, "–")})
    return rows


def _make_sample_row(a: Model, b: Model, sample: ComparedSample) -> Variables:
    token = sample.token
    return {
        "sample": sample,
        "path": sample_path(token),
        "a": verdict_text(a.setup.task, a.rows.get(token, {})),
        "b": verdict_text(b.setup.task, b.rows.get(token, {})),
    }


def _show_sample(request: Request) -> Response:
    explorer = get_explorer(request)
    a, b = _find_model_pair(request)
    token = find_sample(request, a, b)
    before, after = find_neighbours(a.rows.keys() & b.rows.keys(), token)
    job = request_differences(explorer, a, b)
    better = _read_better_side(request)
    waits = list_titles([job])  # They are read before the result.
    samples: ComparedSamples | None = job.result
    ranked: tuple[str, ...] = ()
    if samples is not None:
        ranked = tuple(sample.token for sample in samples.chosen(better))
    return render_page(
        request,
        "compare_sample.html",
        a=a,
        b=b,
        token=token,
        path=sample_path(token),
        sides=[make_sample_context(explorer, model, token) for model in (a, b)],
        before=before,
        after=after,
        place=find_position(ranked, token),
        better=better,
        address=partial(_format_query, better=better),
        swapped=_format_query(better=_OTHER_SIDE.get(better, "")),
        ahead=read_frame_ahead(request),
        aheads=list_frames_ahead(explorer, a, token) and list_frames_ahead(explorer, b, token),
        waits=waits,
        sample_path=sample_path,
    )
