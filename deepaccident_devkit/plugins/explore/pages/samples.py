"""A model's samples: lists of them, the worst first, and each sample with its ground truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal, get_args
from urllib.parse import urlencode

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.errors import EvaluationError, NotAvailableError, TokenError
from deepaccident_devkit.evaluation.breakdowns import (
    SampleAttributes,
    attribute_name,
    sample_attributes,
)
from deepaccident_devkit.evaluation.results import MotionForm
from deepaccident_devkit.evaluation.runs.setups import (
    SampleLoader,
    agent_of,
    evaluator_class,
    scenario_of,
)
from deepaccident_devkit.plugins.explore.background import Job
from deepaccident_devkit.plugins.explore.choices import MAX_WORD_LENGTH
from deepaccident_devkit.plugins.explore.evaluations import (
    list_other_values,
    read_finite,
    verdict_text,
)
from deepaccident_devkit.plugins.explore.explorer import Explorer
from deepaccident_devkit.plugins.explore.models import Model, request_sample_values
from deepaccident_devkit.plugins.explore.pages.responses import (
    Variables,
    get_explorer,
    render_page,
    select_page,
    send_picture,
)
from deepaccident_devkit.plugins.explore.pages.scenario import read_sample_token
from deepaccident_devkit.plugins.explore.scenarios import UNKNOWN_VALUE
from deepaccident_devkit.render.figures import detached_figure
from deepaccident_devkit.render.outcomes import render_evaluation, render_outcome_in_cameras
from deepaccident_devkit.render.outcomes.evaluation import FIGURE_SIZE_IN
from deepaccident_devkit.support.human_names import metric_name
from deepaccident_devkit.support.pages import path_in_address
from deepaccident_devkit.support.text import natural_order
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

_SampleOrder = Literal["worst", "best", "time"]
# Name for readers of each order.
ORDERS: Final[Mapping[_SampleOrder, str]] = {
    "worst": "worst first",
    "best": "best first",
    "time": "in time",
}
_PictureKind = Literal["above", "cameras"]
_PictureSize = Literal["whole", "half"]
# Width and height of pictures in inches; half is for two pictures side by side. A whole picture
# from above has the size of its task.
_FIGURE_SIZES: Mapping[tuple[_PictureKind, _PictureSize], tuple[float, float]] = {
    ("above", "half"): (7.7, 4.6),
    ("cameras", "whole"): (15.2, 7.4),
    ("cameras", "half"): (7.7, 4.7),
}
# How far ahead pictures of explicit accidents look.
_ACCIDENT_HORIZON_S = 2.0
SAMPLE = "{type}/{name}/{agent}/{frame:int}"
# Number of samples on a page of the list.
SAMPLES_PER_PAGE: Final = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleChoices:
    """A reader's choices among a model's samples.

    Attributes:
        by: Name of an attribute; empty for all samples.
        value: Value of the attribute, `unknown` if it is not known.
        scenario: Token of a scenario; empty for all.
        order: Order of the list; None for the default, which is the worst first, or in time if
            samples have no numbers.
    """

    by: str = ""
    value: str = ""
    scenario: str = ""
    order: _SampleOrder | None = None

    @classmethod
    def of(cls, parameters: Mapping[str, str]) -> SampleChoices:
        """Return the choices in the parameters of an address.

        Raises ChoiceError if there is no such attribute.
        """
        by: str = parameters.get("by", "")
        order: Any = parameters.get("order")
        return cls(
            by=attribute_name(by) if by else "",
            value=parameters.get("value", "")[:MAX_WORD_LENGTH] if by else "",
            scenario=parameters.get("scenario", "")[:MAX_WORD_LENGTH],
            order=order if order in get_args(_SampleOrder) else None,
        )

    def address(self, *, ahead: int = 0, **changes: Any) -> str:
        """Return these choices as the parameters of an address: `?by=agent&value=ego_vehicle`.

        Keyword arguments change some of the choices; `ahead` is a number of frames ahead.
        """
        choices = replace(self, **changes)
        pairs: list[tuple[str, str]] = []
        if choices.by:
            pairs += [("by", choices.by), ("value", choices.value)]
        if choices.scenario:
            pairs.append(("scenario", choices.scenario))
        if choices.order is not None:
            pairs.append(("order", str(choices.order)))
        if ahead > 0:
            pairs.append(("ahead", str(ahead)))
        if pairs:
            return f"?{urlencode(pairs)}"
        return ""

    def words(self) -> str:
        """Return the choices in words, such as `time to impact 1 s`; empty for all samples."""
        words = []
        if self.by:
            words.append(f"{self.by.replace('_', ' ')} {self.value}")
        if self.scenario:
            words.append(self.scenario)
        return ", ".join(words)


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleList:
    """The samples that match a reader's choices.

    Attributes:
        tokens: Tokens, in order.
        order: Order of the samples.
        ranked: Whether they can be sorted by their numbers instead of by time.
        groups: Number of samples for each value of the chosen attribute; empty without an
            attribute, and until the attributes are known.
        unknown: Number of samples with an unknown group, since they are not in this release.
        waits: Titles of jobs that are not done.
        faults: Sentences on failed jobs.
    """

    tokens: tuple[str, ...]
    order: _SampleOrder
    ranked: bool
    groups: Mapping[str, int]
    unknown: int
    waits: tuple[str, ...]
    faults: tuple[str, ...]


def list_samples(explorer: Explorer, model: Model, choices: SampleChoices) -> SampleList:
    """Return the samples of a model that match a reader's choices."""
    tokens = list(model.tokens)
    attributes = None
    if choices.by:
        attributes = request_attributes(explorer, model)
    ranks = None
    if model.bundle is not None:
        ranks = request_sample_values(explorer.jobs, model)
    jobs = [job for job in (attributes, ranks) if job is not None]
    # They are listed before the results are read, so that no job that ends meanwhile is missed.
    waiting = [job for job in jobs if not job.is_done]
    groups: dict[str, int] = {}
    num_unknown = 0
    if attributes is not None:
        values = {}
        if attributes.result is not None:
            for token, sample in attributes.result.items():
                values[token] = sample.value(choices.by) or UNKNOWN_VALUE
            num_unknown = len(tokens) - len(values)
        counts = Counter(values.values())
        groups = {value: counts[value] for value in sorted(counts, key=natural_order)}
        tokens = [token for token in tokens if values.get(token) == choices.value]
    if choices.scenario:
        tokens = [token for token in tokens if scenario_of(token) == choices.scenario]
    ranked, numbers = _read_ranking(ranks)
    order: _SampleOrder = "time"
    if ranked:
        order = choices.order or "worst"
    return SampleList(
        tokens=tuple(_order_samples(tokens, order, numbers)),
        order=order,
        ranked=ranked,
        groups=groups,
        unknown=num_unknown,
        waits=tuple(job.title for job in waiting if job is attributes or order != "time"),
        faults=tuple(f"{job.title}: {job.error}" for job in jobs if job.state == "failed"),
    )


def _read_ranking(ranks: Job | None) -> tuple[bool, Mapping[str, float | None]]:
    """Return whether samples can be ranked, and the main numbers that are already computed.

    Single samples have no numbers if the task is warning, which is judged over whole recordings.
    """
    if ranks is None:
        return False, {}
    numbers: Mapping[str, float | None] | None = ranks.result
    if numbers is None:
        return True, {}
    return any(number is not None for number in numbers.values()), numbers


def _order_samples(
    tokens: Iterable[str], order: _SampleOrder, values: Mapping[str, float | None]
) -> list[str]:
    """Sort tokens by their main numbers, with samples without one at the end.

    Until the numbers are known, tokens are sorted by time.
    """
    in_time = sorted(tokens)
    if order == "time":
        return in_time
    unranked = dict.fromkeys(in_time)
    ranked = []
    for token, value in values.items():
        if value is not None and token in unranked:
            ranked.append(token)
            del unranked[token]
    if order == "best":
        ranked.reverse()
    return [*ranked, *unranked]


def request_attributes(explorer: Explorer, model: Model) -> Job:
    """Return the job that computes the attributes of a model's samples in the release."""
    dataset = explorer.dataset

    def attributes() -> Mapping[str, SampleAttributes]:
        tokens = [token for token in model.tokens if is_sample(dataset, token)]
        return sample_attributes(dataset, tokens)

    title = f"attributes of the samples of {model.name}"
    return explorer.jobs.ask(f"attributes {model.name}", title, attributes)


def is_sample(dataset: Dataset, token: str) -> bool:
    """Return whether the release has a sample."""
    try:
        dataset.getind("sample", token)
    except TokenError:
        return False
    return True


@dataclass(frozen=True, slots=True, kw_only=True)
class _PictureChoice:
    """The choice of a picture of a sample.

    Attributes:
        kind: View: from above, or in the cameras.
        size: Size of the picture.
        ahead: Number of frames ahead, for motion in cameras; 0 for the current frame.
    """

    kind: _PictureKind
    size: _PictureSize = "whole"
    ahead: int = 0


def explain_missing_picture(explorer: Explorer, model: Model, token: str) -> str:
    """Explain in a sentence why a sample has no picture; empty if it has one."""
    if not is_sample(explorer.dataset, token):
        return "This sample is not in this release."
    if model.results is None:
        return model.missing_results
    if not model.has(token):
        return f"{model.name} has no prediction for this sample."
    try:
        SampleLoader(explorer.dataset, model.results, model.setup)
    except EvaluationError as error:
        return str(error)
    needs_meta = evaluator_class(model.setup.task).needs_meta
    return _explain_missing_truth(explorer, token, needs_meta=needs_meta)


def _explain_missing_truth(explorer: Explorer, token: str, *, needs_meta: bool) -> str:
    dataset = explorer.dataset
    if not dataset.get("sample", token)["labelled"]:
        return "This sample has no label, so there is no truth to compare with."
    has_meta = dataset.get("scenario", scenario_of(token))["weather"] is not None
    if needs_meta and not has_meta:
        return "This scenario has no meta file, which names the colliding pair."
    return ""


def describe_rules(model: Model) -> str:
    """Explain how pictures deviate from the bundle's rules; empty if they do not."""
    if model.setup.task in ("accident", "warning") and model.results is not None:
        form = model.results.form
        ahead = _ACCIDENT_HORIZON_S
        if form is not None:
            ahead = form.lookahead
        horizon = model.setup.horizon
        if abs(ahead - horizon) > FRAME_PERIOD / 2:
            return f"These pictures look {ahead:g} s ahead; the evaluation looks {horizon:g} s."
    return ""


def _draw_sample(explorer: Explorer, model: Model, token: str, choice: _PictureChoice) -> bytes:
    """Draw a picture of a sample as PNG.

    Raises NotAvailableError with the words of `explain_missing_picture`, or ChoiceError if there is
    no such frame.
    """
    reason = explain_missing_picture(explorer, model, token)
    if reason:
        raise NotAvailableError(f"{token}: {reason}")
    key = ("predicted", model.name, token, choice)
    return explorer.drawn(key, partial(_render_picture, explorer, model, token, choice))


def list_frames_ahead(explorer: Explorer, model: Model, token: str) -> list[float]:
    """Return the times of the recorded frames at which motion is evaluated, in seconds ahead.

    The list is empty for other tasks.
    """
    form = None
    if model.results is not None:
        form = model.results.form
    is_motion = model.setup.task == "motion" and is_sample(explorer.dataset, token)
    if not is_motion or not isinstance(form, MotionForm):
        return []
    time_to_end = float(explorer.dataset.get("sample", token)["time_to_end"])
    max_time = min(model.setup.horizon, time_to_end)
    count = int((max_time + FRAME_PERIOD / 2) / form.step) + 1
    return [number * form.step for number in range(count)]


def _render_picture(explorer: Explorer, model: Model, token: str, choice: _PictureChoice) -> Any:
    results = model.results
    if results is None:
        raise NotAvailableError(model.missing_results)
    loader = SampleLoader(explorer.dataset, results, model.setup)
    prediction = loader.prediction(token)
    task = model.setup.task
    arguments: dict[str, Any] = {"task": task, "protocol": model.setup.rules}
    size = _FIGURE_SIZES.get((choice.kind, choice.size), FIGURE_SIZE_IN)
    arguments["fig"] = detached_figure(size)
    if choice.kind == "above":
        return render_evaluation(explorer.dataset, token, prediction, **arguments)
    arguments["frame"] = choice.ahead if model.setup.task == "motion" else None
    return render_outcome_in_cameras(explorer.dataset, token, prediction, **arguments)


def find_model(request: Request, name: str = "model") -> Model:
    """Return the model that an address names; raise NotAvailableError if there is none such."""
    model_name = request.path_params[name]
    models = get_explorer(request).models
    if model_name not in models:
        raise NotAvailableError(
            f"there is no model {model_name!r}; those that were given: "
            f"{', '.join(models) or 'none'}"
        )
    return models[model_name]


def sample_path(token: str) -> str:
    """Return the path of a sample in an address, such as `type/scenario/agent/12`."""
    scenario, _, frame = token.rpartition("/")
    if frame.isdecimal() and frame.isascii():
        return path_in_address(f"{scenario}/{int(frame)}")
    return path_in_address(token)


def find_sample(request: Request, *models: Model) -> str:
    """Return the token of the sample that an address names.

    Raises TokenError if neither the release nor a model has it.
    """
    token = read_sample_token(request)
    if is_sample(get_explorer(request).dataset, token):
        return token
    if not any(token in model.tokens for model in models):
        names = ", ".join(model.name for model in models)
        raise TokenError(f"neither the release nor {names} has the sample {token!r}")
    return token


def find_neighbours(tokens: Iterable[str], token: str) -> tuple[str | None, str | None]:
    """Return the samples of the same agent before and after a sample; None if there is none."""
    recording = token.rpartition("/")[0] + "/"
    samples = [sample for sample in tokens if sample.startswith(recording)]
    before = max((sample for sample in samples if sample < token), default=None)
    after = min((sample for sample in samples if sample > token), default=None)
    return before, after


def list_titles(jobs: Iterable[Job]) -> list[str]:
    """Return the titles of the jobs that are not done."""
    return [job.title for job in jobs if not job.is_done]


def find_models(explorer: Explorer, task: str) -> list[Model]:
    """Return the evaluated models of a task."""
    return [
        model
        for model in explorer.models.values()
        if model.bundle is not None and model.setup.task == task
    ]


def routes() -> list[Route]:
    """Return the routes of the pages.

    The address of a sample includes the choices of the list, so that its position there is known.
    """
    return [
        Route("/model/{model}/samples", _show_samples),
        Route(f"/model/{{model}}/sample/{SAMPLE}", _show_sample),
        Route(f"/model/{{model}}/sample/{SAMPLE}/{{kind}}.png", _show_picture),
    ]


def make_rows(explorer: Explorer, model: Model, tokens: Iterable[str]) -> list[Variables]:
    """Return what lists show about each sample."""
    scores = model.scores.samples if model.scores is not None else {}
    rows = []
    for token in tokens:
        row = model.rows.get(token)
        time_to_impact = None
        verdict = ""
        if row is not None:
            time_to_impact = read_finite(row.get("time_to_impact"))
            verdict = verdict_text(model.setup.task, row)
        rows.append(
            {
                "token": token,
                "path": sample_path(token),
                "scenario": scenario_of(token),
                "agent": agent_of(token),
                "frame": token.rpartition("/")[2],
                "ahead": time_to_impact,
                "verdict": verdict,
                "number": scores[token].text if token in scores else "",
                "here": is_sample(explorer.dataset, token),
            }
        )
    return rows


def _show_samples(request: Request) -> Response:
    explorer = get_explorer(request)
    model = find_model(request)
    choices = SampleChoices.of(request.query_params)
    samples = list_samples(explorer, model, choices)
    part = select_page(request, samples.tokens, SAMPLES_PER_PAGE)
    number = ""
    if model.scores is not None and samples.ranked:
        number = metric_name(model.scores.name)
    return render_page(
        request,
        "samples.html",
        model=model,
        choices=choices,
        found=samples,
        orders=ORDERS,
        part=part,
        rows=make_rows(explorer, model, part.entries),
        waits=[*samples.waits],
        number=number,
    )


def _show_sample(request: Request) -> Response:
    explorer = get_explorer(request)
    model = find_model(request)
    token = find_sample(request, model)
    choices = SampleChoices.of(request.query_params)
    before, after = find_neighbours(model.tokens, token)
    samples = list_samples(explorer, model, choices)
    return render_page(
        request,
        "sample.html",
        **make_sample_context(explorer, model, token),
        before=before,
        after=after,
        choices=choices,
        place=find_position(samples.tokens, token),
        order=ORDERS[samples.order],
        ahead=read_frame_ahead(request),
        waits=[*samples.waits],
        aheads=list_frames_ahead(explorer, model, token),
        sample_path=sample_path,
    )


def make_sample_context(explorer: Explorer, model: Model, token: str) -> Variables:
    """Return what the page of a sample shows about one model."""
    row = model.rows.get(token)
    verdict = ""
    values: dict[str, str] = {}
    if row is not None:
        verdict = verdict_text(model.setup.task, row, in_full=True)
        values = list_other_values(row)
    number = ""
    scores = model.scores
    if scores is not None and token in scores.samples:
        score = scores.samples[token]
        if score.value is not None:
            number = f"{metric_name(scores.name)} {score.text}"
    _, figure_height = FIGURE_SIZE_IN
    return {
        "model": model,
        "token": token,
        "path": sample_path(token),
        "scenario": scenario_of(token),
        "agent": agent_of(token),
        "frame": int(token.rpartition("/")[2]),
        "here": is_sample(explorer.dataset, token),
        "evaluated": row is not None,
        "verdict": verdict,
        "values": values,
        "number": number,
        "why_not": explain_missing_picture(explorer, model, token),
        "rules": describe_rules(model),
        "tall": round(80 * figure_height),
    }


def find_position(tokens: Sequence[str], token: str) -> Variables | None:
    """Return the position of a sample in a list; None if the sample is not in the list.

    It consists of the sample's number, the list's length, and the samples before and after it.
    """
    if token not in tokens:
        return None
    index = tokens.index(token)
    return {
        "number": index + 1,
        "count": len(tokens),
        "before": tokens[index - 1] if index else None,
        "after": tokens[index + 1] if index + 1 < len(tokens) else None,
    }


def _show_picture(request: Request) -> Response:
    explorer = get_explorer(request)
    model = find_model(request)
    kind = request.path_params["kind"]
    if kind not in get_args(_PictureKind):
        raise HTTPException(404)
    size: _PictureSize = "half" if request.query_params.get("size") == "half" else "whole"
    ahead = 0
    if kind == "cameras":
        ahead = read_frame_ahead(request)
    choice = _PictureChoice(kind=kind, size=size, ahead=ahead)
    token = find_sample(request, model)
    return send_picture(_draw_sample(explorer, model, token, choice), "png")


def read_frame_ahead(request: Request) -> int:
    """Read the number of frames ahead from an address; raise HTTPException if it is invalid."""
    text = request.query_params.get("ahead", "0")
    if not (text.isascii() and text.isdecimal() and len(text) < 3):
        raise HTTPException(404)
    return int(text)
