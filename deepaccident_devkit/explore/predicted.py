"""A model's prediction over the truth, as pictures: from above and in the cameras, by the bundle's rules."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from deepaccident_devkit.errors import EvaluationError, NotAvailableError
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.runs.selection import scenario_of
from deepaccident_devkit.evaluation.runs.setups import SampleLoader
from deepaccident_devkit.explore.sample_lists import is_sample
from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.render.outcomes import render_evaluation, render_outcome_in_cameras
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from deepaccident_devkit.explore.explorer import Explorer
    from deepaccident_devkit.explore.models import Model

Kind = Literal["above", "cameras"]
Size = Literal["whole", "half"]
_SIZES: Final[Mapping[tuple[Kind, Size], tuple[float, float]]] = {
    ("above", "whole"): (12.4, 6.9),
    ("above", "half"): (7.7, 4.6),
    ("cameras", "whole"): (15.2, 7.4),
    ("cameras", "half"): (7.7, 4.7),
}
"""Inches; half is for two side by side."""
_OTHER_HORIZON: Final = 2.0
"""Seconds that the pictures of explicit accidents look ahead."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """Which picture.

    Attributes:
        kind: from above or in the cameras.
        size: of the picture.
        ahead: of motion in cameras: frames ahead, 0 for the present.
    """

    kind: Kind
    size: Size = "whole"
    ahead: int = 0


def why_not(explorer: Explorer, model: Model, token: str) -> str:
    """Why there is no picture of a sample, in a sentence; empty if there is one."""
    if not is_sample(explorer.dataset, token):
        return "This sample is not in this release."
    if model.results is None:
        return f"The predictions of {model.name} were not given."
    if not model.has(token):
        return f"{model.name} predicts nothing for this sample."
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
            return f"These pictures look {ahead:g} s ahead, the evaluation {model.setup.horizon:g} s."
    return ""


def picture_of(explorer: Explorer, model: Model, token: str, shown: Shown) -> bytes:
    """A picture as PNG; raises NotAvailableError with the words of `why_not`, or ChoiceError: no such frame."""
    reason = why_not(explorer, model, token)
    if reason:
        raise NotAvailableError(f"{token}: {reason}")
    return explorer.drawn(("predicted", model.name, token, shown), lambda: _figure(explorer, model, token, shown))


def frames_ahead(explorer: Explorer, model: Model, token: str) -> list[float]:
    """Seconds ahead of the frames that motion is evaluated at and that are recorded; none of other tasks."""
    form = None if model.results is None else model.results.form
    if model.setup.task != "motion" or form is None or not is_sample(explorer.dataset, token):
        return []
    left = float(explorer.dataset.get("sample", token)["time_to_end"])
    last = min(model.setup.horizon, left)
    return [number * form.step for number in range(int((last + FRAME_PERIOD / 2) / form.step) + 1)]


def _task(model: Model) -> str:
    return "accident" if model.setup.task == "warning" else model.setup.task


def _figure(explorer: Explorer, model: Model, token: str, shown: Shown) -> Any:
    results = model.results
    if results is None:
        raise NotAvailableError(f"{model.name}: its predictions were not given")
    loader = SampleLoader(explorer.dataset, results, model.setup)
    prediction, rules = results.prediction(token), model.setup.rules
    how: dict[str, Any] = {"task": _task(model), "protocol": None if model.setup.task == "warning" else rules}
    if isinstance(prediction, DetectedBoxes):
        prediction = loader.detected(token, prediction, rules.frame)
    else:
        how["label"] = loader.label(token)
    figure = detached_figure(_SIZES[shown.kind, shown.size])
    if shown.kind == "above":
        return render_evaluation(explorer.dataset, token, prediction, **how, fig=figure)
    frame = shown.ahead if model.setup.task == "motion" else None
    return render_outcome_in_cameras(explorer.dataset, token, prediction, **how, frame=frame, fig=figure)
