"""A model's samples: of a group or a scenario, the worst first, and each with its ground truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
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
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.runs.setups import SampleLoader, agent_of, scenario_of
from deepaccident_devkit.plugins.explore.background import Job
from deepaccident_devkit.plugins.explore.choices import MAX_WORD_LENGTH
from deepaccident_devkit.plugins.explore.evaluations import finite, other_values, verdict_text
from deepaccident_devkit.plugins.explore.explorer import Explorer
from deepaccident_devkit.plugins.explore.models import Model, sample_values_job
from deepaccident_devkit.plugins.explore.pages.responses import explorer_of, page, part_of, picture
from deepaccident_devkit.plugins.explore.pages.scenario import sample_of
from deepaccident_devkit.plugins.explore.scenarios import UNKNOWN_VALUE
from deepaccident_devkit.render.figures import detached_figure
from deepaccident_devkit.render.outcomes import render_evaluation, render_outcome_in_cameras
from deepaccident_devkit.render.outcomes.evaluation import FIGURE_SIZES
from deepaccident_devkit.support.pages import path_in_address
from deepaccident_devkit.support.text import natural_order
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

_SampleOrder = Literal["worst", "best", "time"]
# Order → its name for readers.
ORDERS: Final[Mapping[_SampleOrder, str]] = {
    "worst": "worst first",
    "best": "best first",
    "time": "in time",
}
_PictureKind = Literal["above", "cameras"]
_PictureSize = Literal["whole", "half"]
# Width and height in inches; half is for two pictures side by side. A whole picture from above has
# its task's own size.
_FIGURE_SIZES: Final[Mapping[tuple[_PictureKind, _PictureSize], tuple[float, float]]] = {
    ("above", "half"): (7.7, 4.6),
    ("cameras", "whole"): (15.2, 7.4),
    ("cameras", "half"): (7.7, 4.7),
}
# Seconds that the pictures of explicit accidents look ahead.
_ACCIDENT_HORIZON_S: Final = 2.0
SAMPLE = "{type}/{name}/{agent}/{frame:int}"
# Number of samples on a page of the list.
SAMPLES_PER_PAGE: Final = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleChoices:
    """What a reader chose of a model's samples.

    Attributes:
        by: An attribute; empty for all samples.
        value: Value of the attribute, `unknown` where it is not known.
        scenario: Token of a scenario; empty for all.
        order: Order of the list; None for the default: the worst first, or in time where samples
            have no numbers.
    """

    by: str = ""
    value: str = ""
    scenario: str = ""
    order: _SampleOrder | None = None

    @classmethod
    def of(cls, parameters: Mapping[str, str]) -> SampleChoices:
        """Return the choices of the parameters of an address.

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
        """Return the parameters of the address: `?by=agent&value=ego_vehicle`.

        Keyword arguments change some of the choices; `ahead` is a frame ahead.
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
        """Return the choices in words: `time to impact 1 s`; empty for all samples."""
        words = []
        if self.by:
            words.append(f"{self.by.replace('_', ' ')} {self.value}")
        if self.scenario:
            words.append(self.scenario)
        return ", ".join(words)


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleList:
    """The samples that match choices.

    Attributes:
        tokens: Tokens, in order.
        order: Order of the samples.
        ranked: Whether they can be in another order than in time.
        groups: Value of the chosen attribute → number of samples; empty without an attribute, and
            until they are known.
        unknown: Number of samples that are not in this release, so that their group is unknown.
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
    """Return the samples of a model that match choices."""
    tokens = list(model.tokens)
    attributes = None
    if choices.by:
        attributes = attributes_job(explorer, model)
    ranks = None
    if model.bundle is not None:
        ranks = sample_values_job(explorer.jobs, model)
    jobs = [job for job in (attributes, ranks) if job is not None]
    # Listed before the results are read, so that a job that ends meanwhile is not missed.
    waiting = [job for job in jobs if not job.is_done]
    groups: dict[str, int] = {}
    num_unknown = 0
    if attributes is not None:
        by_token: Mapping[str, SampleAttributes] | None = attributes.result
        values = {
            token: sample.value(choices.by) or UNKNOWN_VALUE
            for token, sample in (by_token or {}).items()
        }
        counts = Counter(values.values())
        groups = {value: counts[value] for value in sorted(counts, key=natural_order)}
        if by_token is not None:
            num_unknown = len(tokens) - len(values)
        tokens = [token for token in tokens if values.get(token) == choices.value]
    if choices.scenario:
        tokens = [token for token in tokens if scenario_of(token) == choices.scenario]
    ranked, numbers = _ranking(ranks)
    order: _SampleOrder = choices.order or "worst" if ranked else "time"
    return SampleList(
        tokens=tuple(_order_samples(tokens, order, numbers)),
        order=order,
        ranked=ranked,
        groups=groups,
        unknown=num_unknown,
        waits=tuple(job.title for job in waiting if job is attributes or order != "time"),
        faults=tuple(f"{job.title}: {job.error}" for job in jobs if job.state == "failed"),
    )


def _ranking(ranks: Job | None) -> tuple[bool, Mapping[str, float | None]]:
    """Return whether samples can be ranked, and their main numbers as far as they are computed.

    Warnings are judged over recordings: single samples have no numbers.
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
    """Return tokens by the main number, samples without one last.

    They are in time as long as the numbers are unknown.
    """
    in_time = sorted(tokens)
    if order == "time":
        return in_time
    present = set(in_time)
    ranked = [token for token, value in values.items() if value is not None and token in present]
    ranked_set = set(ranked)
    if order == "best":
        ranked.reverse()
    return [*ranked, *(token for token in in_time if token not in ranked_set)]


def attributes_job(explorer: Explorer, model: Model) -> Job:
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
    """A picture of a sample.

    Attributes:
        kind: From above or in the cameras.
        size: Size of the picture.
        ahead: Frames ahead, for motion in cameras; 0 for the present.
    """

    kind: _PictureKind
    size: _PictureSize = "whole"
    ahead: int = 0


def why_not(explorer: Explorer, model: Model, token: str) -> str:
    """Return why there is no picture of a sample, in a sentence; empty if there is one."""
    if not is_sample(explorer.dataset, token):
        return "This sample is not in this release."
    if model.results is None:
        return f"The predictions of {model.name} were not given."
    if not model.has(token):
        return f"{model.name} predicts nothing for this sample."
    if _picture_task(model) not in FIGURE_SIZES:
        return f"There are no pictures of {model.setup.task}."
    try:
        SampleLoader(explorer.dataset, model.results, model.setup)
    except EvaluationError as error:
        return str(error)
    return _why_no_truth(explorer, token, needs_meta=_picture_task(model) == "accident")


def _why_no_truth(explorer: Explorer, token: str, *, needs_meta: bool) -> str:
    if not explorer.dataset.get("sample", token)["labelled"]:
        return "This sample has no label, so that there is no truth to compare with."
    if needs_meta and explorer.dataset.get("scenario", scenario_of(token))["weather"] is None:
        return "This scenario has no meta file, which names the colliding pair."
    return ""


def rules_words(model: Model) -> str:
    """Return how the pictures deviate from the bundle's own rules; empty if they do not."""
    if model.setup.task == "warning":
        return "Warnings are judged over whole recordings; these pictures judge single accidents."
    if _picture_task(model) == "accident" and model.results is not None:
        form = model.results.form
        ahead = _ACCIDENT_HORIZON_S if form is None else (form.frames - 1) * form.step
        horizon = model.setup.horizon
        if abs(ahead - horizon) > FRAME_PERIOD / 2:
            return f"These pictures look {ahead:g} s ahead, the evaluation {horizon:g} s."
    return ""


def _sample_picture(explorer: Explorer, model: Model, token: str, choice: _PictureChoice) -> bytes:
    """Return a picture as PNG.

    Raises NotAvailableError with the words of `why_not`, or ChoiceError if there is no such frame.
    """
    reason = why_not(explorer, model, token)
    if reason:
        raise NotAvailableError(f"{token}: {reason}")
    key = ("predicted", model.name, token, choice)
    return explorer.drawn(key, lambda: _render_picture(explorer, model, token, choice))


def frames_ahead(explorer: Explorer, model: Model, token: str) -> list[float]:
    """Return the seconds ahead of the recorded frames at which motion is evaluated.

    Empty for other tasks.
    """
    form = None
    if model.results is not None:
        form = model.results.form
    if model.setup.task != "motion" or form is None or not is_sample(explorer.dataset, token):
        return []
    time_to_end = float(explorer.dataset.get("sample", token)["time_to_end"])
    max_time = min(model.setup.horizon, time_to_end)
    count = int((max_time + FRAME_PERIOD / 2) / form.step) + 1
    return [number * form.step for number in range(count)]


def _picture_task(model: Model) -> str:
    if model.setup.task == "warning":
        return "accident"
    return model.setup.task


def _render_picture(explorer: Explorer, model: Model, token: str, choice: _PictureChoice) -> Any:
    results = model.results
    if results is None:
        raise NotAvailableError(f"{model.name}: its predictions were not given")
    loader = SampleLoader(explorer.dataset, results, model.setup)
    prediction, task = loader.prediction(token), _picture_task(model)
    protocol = None if model.setup.task == "warning" else model.setup.rules
    arguments: dict[str, Any] = {"task": task, "protocol": protocol}
    if not isinstance(prediction, DetectedBoxes):
        arguments["label"] = loader.label(token)
    size = _FIGURE_SIZES.get((choice.kind, choice.size), FIGURE_SIZES[task])
    arguments["fig"] = detached_figure(size)
    if choice.kind == "above":
        return render_evaluation(explorer.dataset, token, prediction, **arguments)
    arguments["frame"] = choice.ahead if model.setup.task == "motion" else None
    return render_outcome_in_cameras(explorer.dataset, token, prediction, **arguments)


def model_of(request: Request, name: str = "model") -> Model:
    """Return the model that a part of an address names; raise NotAvailableError."""
    model_name, models = request.path_params[name], explorer_of(request).models
    if model_name not in models:
        raise NotAvailableError(
            f"there is no model {model_name!r}; those that were given: "
            f"{', '.join(models) or 'none'}"
        )
    return models[model_name]


def sample_path(token: str) -> str:
    """Return a sample's path in an address: `type/scenario/agent/12`."""
    scenario, _, frame = token.rpartition("/")
    if frame.isdecimal() and frame.isascii():
        return path_in_address(f"{scenario}/{int(frame)}")
    return path_in_address(token)


def known_sample(request: Request, *models: Model) -> str:
    """Return the sample that an address names.

    Raises TokenError if neither the release nor a model has it.
    """
    token = sample_of(request)
    if is_sample(explorer_of(request).dataset, token):
        return token
    if not any(token in model.tokens for model in models):
        names = ", ".join(model.name for model in models)
        raise TokenError(f"neither the release nor {names} has the sample {token!r}")
    return token


def neighbours_in_time(tokens: Iterable[str], token: str) -> tuple[str | None, str | None]:
    """Return the samples of the same agent before and after a sample."""
    recording = token.rpartition("/")[0] + "/"
    samples = [sample for sample in tokens if sample.startswith(recording)]
    before = max((sample for sample in samples if sample < token), default=None)
    after = min((sample for sample in samples if sample > token), default=None)
    return before, after


def titles(jobs: Iterable[Job]) -> list[str]:
    """Return the titles of the jobs that are not done."""
    return [job.title for job in jobs if not job.is_done]


def models_of_task(explorer: Explorer, task: str) -> list[Model]:
    """Return the evaluated models of a task."""
    return [
        model
        for model in explorer.models.values()
        if model.bundle is not None and model.setup.task == task
    ]


def routes() -> list[Route]:
    """Return the routes of the pages.

    The addresses of samples take the choices of the list, so that the position in it is known.
    """
    return [
        Route("/model/{model}/samples", _samples),
        Route(f"/model/{{model}}/sample/{SAMPLE}", _sample),
        Route(f"/model/{{model}}/sample/{SAMPLE}/{{kind}}.png", _picture),
    ]


def rows_of(explorer: Explorer, model: Model, tokens: Iterable[str]) -> list[dict[str, Any]]:
    """Return what lists show of samples."""
    scores = model.scores.samples if model.scores is not None else {}
    rows = []
    for token in tokens:
        row = model.rows.get(token)
        time_to_impact, verdict = None, ""
        if row is not None:
            time_to_impact = finite(row.get("time_to_impact"))
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


def _samples(request: Request) -> Response:
    explorer, model = explorer_of(request), model_of(request)
    choices = SampleChoices.of(request.query_params)
    samples = list_samples(explorer, model, choices)
    part = part_of(request, samples.tokens, SAMPLES_PER_PAGE)
    number = ""
    if model.scores is not None and samples.ranked:
        number = model.scores.name
    return page(
        request,
        "samples.html",
        model=model,
        choices=choices,
        found=samples,
        orders=ORDERS,
        part=part,
        rows=rows_of(explorer, model, part.entries),
        waits=[*samples.waits],
        number=number,
    )


def _sample(request: Request) -> Response:
    explorer, model = explorer_of(request), model_of(request)
    token = known_sample(request, model)
    choices = SampleChoices.of(request.query_params)
    before, after = neighbours_in_time(model.tokens, token)
    samples = list_samples(explorer, model, choices)
    return page(
        request,
        "sample.html",
        **sample_context(explorer, model, token),
        before=before,
        after=after,
        choices=choices,
        place=list_position(samples.tokens, token),
        order=ORDERS[samples.order],
        ahead=requested_frame(request),
        waits=[*samples.waits],
        aheads=frames_ahead(explorer, model, token),
        sample_path=sample_path,
    )


def sample_context(explorer: Explorer, model: Model, token: str) -> dict[str, Any]:
    """Return what is shown of a model at a sample."""
    row = model.rows.get(token)
    verdict = ""
    values: dict[str, str] = {}
    if row is not None:
        verdict = verdict_text(model.setup.task, row, in_full=True)
        values = other_values(row)
    number, scores = "", model.scores
    if scores is not None and token in scores.samples:
        score = scores.samples[token]
        if score.value is not None:
            number = f"{scores.name} {score.text}"
    _, figure_height = FIGURE_SIZES.get(_picture_task(model), (0.0, 0.0))
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
        "why_not": why_not(explorer, model, token),
        "rules": rules_words(model),
        "tall": round(80 * figure_height),
        "remedy": _remedy(model),
    }


def _remedy(model: Model) -> str:
    """Return the path of the results of a bundle without a copy; empty if there are results."""
    if model.results is not None or model.bundle is None:
        return ""
    return str(model.bundle.summary["results"]["path"])


def list_position(tokens: Sequence[str], token: str) -> dict[str, Any] | None:
    """Return where a sample is in a list; None if it is not in it.

    This is its number, the length of the list, and the samples before and after it.
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


def _picture(request: Request) -> Response:
    explorer, model, kind = explorer_of(request), model_of(request), request.path_params["kind"]
    if kind not in get_args(_PictureKind):
        raise HTTPException(404)
    size: _PictureSize = "half" if request.query_params.get("size") == "half" else "whole"
    ahead = 0
    if kind == "cameras":
        ahead = requested_frame(request)
    choice = _PictureChoice(kind=kind, size=size, ahead=ahead)
    token = known_sample(request, model)
    return picture(_sample_picture(explorer, model, token, choice), "png")


def requested_frame(request: Request) -> int:
    """Return the frame ahead that cameras show; raise HTTPException."""
    text = request.query_params.get("ahead", "0")
    if not (text.isascii() and text.isdecimal() and len(text) < 3):
        raise HTTPException(404)
    return int(text)
