"""A model's samples: those of a group or a scenario, the worst first, and each of them over its truth."""

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
from deepaccident_devkit.plugins.explore.choices import MOST_WORD
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
# Inches; half is for two side by side. A whole picture from above has its task's own size.
_SIZES: Final[Mapping[tuple[_PictureKind, _PictureSize], tuple[float, float]]] = {
    ("above", "half"): (7.7, 4.6),
    ("cameras", "whole"): (15.2, 7.4),
    ("cameras", "half"): (7.7, 4.7),
}
# Seconds that the pictures of explicit accidents look ahead.
_OTHER_HORIZON: Final = 2.0
SAMPLE = "{type}/{name}/{agent}/{frame:int}"
# Samples on a page of the list.
SAMPLES_PER_PAGE: Final = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleChoices:
    """What a reader chose of a model's samples.

    Attributes:
        by: an attribute; empty for all samples.
        value: of the attribute, `unknown` where it is not known.
        scenario: token; empty for all.
        order: None for the usual one: the worst first, or in time where samples have no numbers.
    """

    by: str = ""
    value: str = ""
    scenario: str = ""
    order: _SampleOrder | None = None

    @classmethod
    def of(cls, given: Mapping[str, str]) -> SampleChoices:
        """Those of the parameters of an address. Raises ChoiceError: there is no such attribute."""
        by: str = given.get("by", "")
        order: Any = given.get("order")
        return cls(
            by=attribute_name(by) if by else "",
            value=given.get("value", "")[:MOST_WORD] if by else "",
            scenario=given.get("scenario", "")[:MOST_WORD],
            order=order if order in get_args(_SampleOrder) else None,
        )

    def address(self, *, ahead: int = 0, **changed: Any) -> str:
        """The parameters of the address with some choices changed, and a frame ahead: `?by=agent&value=ego_vehicle`."""
        chosen = replace(self, **changed)
        pairs = [("by", chosen.by), ("value", chosen.value)] if chosen.by else []
        pairs += [("scenario", chosen.scenario)] * bool(chosen.scenario)
        pairs += [("order", str(chosen.order))] * (chosen.order is not None)
        pairs += [("ahead", str(ahead))] * (ahead > 0)
        return f"?{urlencode(pairs)}" if pairs else ""

    def words(self) -> str:
        """In words: `time to impact 1 s`; empty for all samples."""
        group = [f"{self.by.replace('_', ' ')} {self.value}"] if self.by else []
        return ", ".join([*group, *[self.scenario] * bool(self.scenario)])


@dataclass(frozen=True, slots=True, kw_only=True)
class Listed:
    """The samples that choices come to.

    Attributes:
        tokens: in order.
        order: in which they are.
        ranked: whether they can be in another order than in time.
        groups: value → how many samples, of the attribute of choice; empty without one, and until they are known.
        unknown: samples that are not in this release, so that nothing is known of their group.
        waits: titles of the work that is waited for.
        faults: sentences on what cannot be told.
    """

    tokens: tuple[str, ...]
    order: _SampleOrder
    ranked: bool
    groups: Mapping[str, int]
    unknown: int
    waits: tuple[str, ...]
    faults: tuple[str, ...]


def listed_samples(explorer: Explorer, model: Model, choices: SampleChoices) -> Listed:
    """The samples of a model that choices come to."""
    tokens = list(model.tokens)
    known = attributes_job(explorer, model) if choices.by else None
    ranks = sample_values_job(explorer.jobs, model) if model.bundle is not None else None
    jobs = [job for job in (known, ranks) if job is not None]
    waiting = [
        job for job in jobs if not job.is_done
    ]  # before their results are read: what comes later is not missed
    groups: dict[str, int] = {}
    unknown = 0
    if known is not None:
        found: Mapping[str, SampleAttributes] | None = known.result
        values = {
            token: each.value(choices.by) or UNKNOWN_VALUE for token, each in (found or {}).items()
        }
        groups = dict(
            sorted(Counter(values.values()).items(), key=lambda item: natural_order(item[0]))
        )
        unknown = 0 if found is None else len(tokens) - len(values)
        tokens = [token for token in tokens if values.get(token) == choices.value]
    if choices.scenario:
        tokens = [token for token in tokens if scenario_of(token) == choices.scenario]
    # warnings are judged over recordings: single samples have no numbers
    ranked = ranks is not None and (
        ranks.result is None or any(each is not None for each in ranks.result.values())
    )
    order: _SampleOrder = choices.order or "worst" if ranked else "time"
    return Listed(
        tokens=tuple(_ordered(tokens, order, ranks.result or {} if ranks is not None else {})),
        order=order,
        ranked=ranked,
        groups=groups,
        unknown=unknown,
        waits=tuple(job.title for job in waiting if job is known or order != "time"),
        faults=tuple(f"{job.title}: {job.error}" for job in jobs if job.state == "failed"),
    )


def _ordered(
    tokens: Iterable[str], order: _SampleOrder, values: Mapping[str, float | None]
) -> list[str]:
    """By the main number, samples without one last; in time as long as they are not known."""
    in_time = sorted(tokens)
    chosen = set() if order == "time" else set(in_time)
    ranked = [token for token, value in values.items() if value is not None and token in chosen]
    others = set(ranked)
    return [
        *(ranked if order == "worst" else ranked[::-1]),
        *(token for token in in_time if token not in others),
    ]


def attributes_job(explorer: Explorer, model: Model) -> Job:
    """The work that gives the attributes of a model's samples, as far as they are in the release."""
    dataset = explorer.dataset
    return explorer.jobs.ask(
        f"attributes {model.name}",
        f"attributes of the samples of {model.name}",
        lambda: sample_attributes(
            dataset, [token for token in model.tokens if is_sample(dataset, token)]
        ),
    )


def is_sample(dataset: Dataset, token: str) -> bool:
    """Whether the release has a sample."""
    try:
        dataset.getind("sample", token)
    except TokenError:
        return False
    return True


@dataclass(frozen=True, slots=True, kw_only=True)
class _PictureChoice:
    """Which picture.

    Attributes:
        kind: from above or in the cameras.
        size: of the picture.
        ahead: of motion in cameras: frames ahead, 0 for the present.
    """

    kind: _PictureKind
    size: _PictureSize = "whole"
    ahead: int = 0


def why_not(explorer: Explorer, model: Model, token: str) -> str:
    """Why there is no picture of a sample, in a sentence; empty if there is one."""
    if not is_sample(explorer.dataset, token):
        return "This sample is not in this release."
    if model.results is None:
        return f"The predictions of {model.name} were not given."
    if not model.has(token):
        return f"{model.name} predicts nothing for this sample."
    if _task(model) not in FIGURE_SIZES:
        return f"There are no pictures of {model.setup.task}."
    try:
        SampleLoader(explorer.dataset, model.results, model.setup)
    except EvaluationError as error:
        return str(error)
    return _why_no_truth(explorer, token, needs_meta=_task(model) == "accident")


def _why_no_truth(explorer: Explorer, token: str, *, needs_meta: bool) -> str:
    if not explorer.dataset.get("sample", token)["labelled"]:
        return "This sample has no label, so that there is no truth to compare with."
    if needs_meta and explorer.dataset.get("scenario", scenario_of(token))["weather"] is None:
        return "This scenario has no meta file, which names the colliding pair."
    return ""


def rules_words(model: Model) -> str:
    """How far the pictures are not made by the bundle's own rules; empty if they are."""
    if model.setup.task == "warning":
        return "Warnings are judged over whole recordings; these pictures judge single accidents."
    if _task(model) == "accident" and model.results is not None:
        form = model.results.form
        ahead = _OTHER_HORIZON if form is None else (form.frames - 1) * form.step
        if abs(ahead - model.setup.horizon) > FRAME_PERIOD / 2:
            return (
                f"These pictures look {ahead:g} s ahead, the evaluation {model.setup.horizon:g} s."
            )
    return ""


def _sample_picture(explorer: Explorer, model: Model, token: str, shown: _PictureChoice) -> bytes:
    """A picture as PNG; raises NotAvailableError with the words of `why_not`, or ChoiceError: no such frame."""
    reason = why_not(explorer, model, token)
    if reason:
        raise NotAvailableError(f"{token}: {reason}")
    return explorer.drawn(
        ("predicted", model.name, token, shown), lambda: _figure(explorer, model, token, shown)
    )


def frames_ahead(explorer: Explorer, model: Model, token: str) -> list[float]:
    """Seconds ahead of the frames that motion is evaluated at and that are recorded; none of other tasks."""
    form = None if model.results is None else model.results.form
    if model.setup.task != "motion" or form is None or not is_sample(explorer.dataset, token):
        return []
    last = min(model.setup.horizon, float(explorer.dataset.get("sample", token)["time_to_end"]))
    return [number * form.step for number in range(int((last + FRAME_PERIOD / 2) / form.step) + 1)]


def _task(model: Model) -> str:
    return "accident" if model.setup.task == "warning" else model.setup.task


def _figure(explorer: Explorer, model: Model, token: str, shown: _PictureChoice) -> Any:
    results = model.results
    if results is None:
        raise NotAvailableError(f"{model.name}: its predictions were not given")
    loader = SampleLoader(explorer.dataset, results, model.setup)
    prediction, rules = loader.prediction(token), model.setup.rules
    how: dict[str, Any] = {
        "task": _task(model),
        "protocol": None if model.setup.task == "warning" else rules,
    }
    if not isinstance(prediction, DetectedBoxes):
        how["label"] = loader.label(token)
    figure = detached_figure(_SIZES.get((shown.kind, shown.size), FIGURE_SIZES[_task(model)]))
    if shown.kind == "above":
        return render_evaluation(explorer.dataset, token, prediction, **how, fig=figure)
    frame = shown.ahead if model.setup.task == "motion" else None
    return render_outcome_in_cameras(
        explorer.dataset, token, prediction, **how, frame=frame, fig=figure
    )


def model_of(request: Request, name: str = "model") -> Model:
    """The model that a part of an address names; raises NotAvailableError."""
    given, models = request.path_params[name], explorer_of(request).models
    if given not in models:
        raise NotAvailableError(
            f"there is no model {given!r}; those that were given: {', '.join(models) or 'none'}"
        )
    return models[given]


def sample_path(token: str) -> str:
    """A sample in an address: `type/scenario/agent/12`."""
    scenario, _, frame = token.rpartition("/")
    return path_in_address(
        f"{scenario}/{int(frame)}" if frame.isdecimal() and frame.isascii() else token
    )


def known_sample(request: Request, *models: Model) -> str:
    """The sample that an address names; raises TokenError if neither the release nor a model has it."""
    token = sample_of(request)
    if not is_sample(explorer_of(request).dataset, token) and not any(
        token in model.tokens for model in models
    ):
        raise TokenError(
            f"neither the release nor {', '.join(each.name for each in models)} has the sample {token!r}"
        )
    return token


def beside_in_time(tokens: Iterable[str], token: str) -> tuple[str | None, str | None]:
    """The samples before and after one, of those of the same agent."""
    recording = token.rpartition("/")[0] + "/"
    same = sorted(each for each in tokens if each.startswith(recording))
    before, after = [each for each in same if each < token], [each for each in same if each > token]
    return before[-1] if before else None, after[0] if after else None


def titles(jobs: Iterable[Job]) -> list[str]:
    """What is waited for, of the jobs that are not done."""
    return [job.title for job in jobs if not job.is_done]


def models_of_task(explorer: Explorer, task: str) -> list[Model]:
    """The evaluated models of a task."""
    return [
        each
        for each in explorer.models.values()
        if each.bundle is not None and each.setup.task == task
    ]


def routes() -> list[Route]:
    """The addresses; those of a sample take the choices of the list, so that the way through it is known."""
    return [
        Route("/model/{model}/samples", _samples),
        Route(f"/model/{{model}}/sample/{SAMPLE}", _sample),
        Route(f"/model/{{model}}/sample/{SAMPLE}/{{kind}}.png", _picture),
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
                "verdict": "" if row is None else verdict_text(model.setup.task, row),
                "number": samples[token].text if token in samples else "",
                "here": is_sample(explorer.dataset, token),
            }
        )
    return rows


def _samples(request: Request) -> Response:
    explorer, model = explorer_of(request), model_of(request)
    choices = SampleChoices.of(request.query_params)
    found = listed_samples(explorer, model, choices)
    part = part_of(request, found.tokens, SAMPLES_PER_PAGE)
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
    found = listed_samples(explorer, model, choices)
    return page(
        request,
        "sample.html",
        **sample_context(explorer, model, token),
        before=before,
        after=after,
        choices=choices,
        place=list_position(found.tokens, token),
        order=ORDERS[found.order],
        ahead=asked_ahead(request),
        waits=[*found.waits],
        aheads=frames_ahead(explorer, model, token),
        sample_path=sample_path,
    )


def sample_context(explorer: Explorer, model: Model, token: str) -> dict[str, Any]:
    """What is shown of a model at a sample."""
    row = model.rows.get(token)
    name, score = (
        ("", None) if model.scores is None else (model.scores.name, model.scores.samples.get(token))
    )
    return {
        "model": model,
        "token": token,
        "path": sample_path(token),
        "scenario": scenario_of(token),
        "agent": agent_of(token),
        "frame": int(token.rpartition("/")[2]),
        "here": is_sample(explorer.dataset, token),
        "evaluated": row is not None,
        "verdict": "" if row is None else verdict_text(model.setup.task, row, whole=True),
        "values": {} if row is None else other_values(row),
        "number": "" if score is None or score.value is None else f"{name} {score.text}",
        "why_not": why_not(explorer, model, token),
        "rules": rules_words(model),
        "tall": round(80 * FIGURE_SIZES.get(_task(model), (0.0, 0.0))[1]),
        "remedy": _remedy(model),
    }


def _remedy(model: Model) -> str:
    """Where the results were of a bundle that has none to show; empty if there are results."""
    return (
        ""
        if model.results is not None or model.bundle is None
        else str(model.bundle.summary["results"]["path"])
    )


def list_position(tokens: Sequence[str], token: str) -> dict[str, Any] | None:
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


def _picture(request: Request) -> Response:
    explorer, model, kind = explorer_of(request), model_of(request), request.path_params["kind"]
    if kind not in get_args(_PictureKind):
        raise HTTPException(404)
    size: _PictureSize = "half" if request.query_params.get("size") == "half" else "whole"
    shown = _PictureChoice(
        kind=kind, size=size, ahead=asked_ahead(request) if kind == "cameras" else 0
    )
    return picture(_sample_picture(explorer, model, known_sample(request, model), shown), "png")


def asked_ahead(request: Request) -> int:
    """The frame that cameras show; raises HTTPException."""
    given = request.query_params.get("ahead", "0")
    if not (given.isascii() and given.isdecimal() and len(given) < 3):
        raise HTTPException(404)
    return int(given)
