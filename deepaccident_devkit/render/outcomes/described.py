"""The drawing of a sample's prediction, from the task that evaluates it."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, MissingFileError, NotAvailableError
from deepaccident_devkit.evaluation.alarms import LABEL_STEP
from deepaccident_devkit.evaluation.drawing import Drawing
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.forecasting import Forecast
from deepaccident_devkit.evaluation.planning import Plan
from deepaccident_devkit.evaluation.predicted_boxes import DetectedBoxes, Tracks
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results import Form, MotionForm, SegmentationForm
from deepaccident_devkit.evaluation.runs.setups import SampleLoader, evaluator_class
from deepaccident_devkit.evaluation.segmentation import SegmentationOutput
from deepaccident_devkit.evaluation.task import headlines, value_text
from deepaccident_devkit.evaluation.truth import RELEASED_HORIZON
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.human_names import human_name, metric_name

# Kind of results by the type of a sample's prediction, or of the items of its list.
_KINDS: Mapping[type, str] = {
    MotionOutput: "motion",
    DetectedBoxes: "detection",
    Tracks: "tracking",
    Accident: "accident",
    Plan: "planning",
    Forecast: "forecasting",
    SegmentationOutput: "segmentation",
}
# Kinds of predictions that are lists.
_LIST_KINDS = ("accident", "planning", "forecasting")
# Number of headlines in the title of a sample without a main number.
_OTHER_NUMBERS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleDrawing(ShortRepr):
    """What a task draws of a sample.

    Attributes:
        sample: Token of the sample.
        drawing: What is drawn.
        words: The task, and the outcome of the sample.
    """

    sample: str
    drawing: Drawing
    words: str


def prediction_kind(prediction: object, possible: Collection[str] = ("accident",)) -> str:
    """Return the kind of results that a sample's prediction belongs to; empty if it has none.

    Args:
        prediction: A sample's prediction.
        possible: Kinds that an empty list may be of.
    """
    item: object = prediction
    if isinstance(prediction, list | tuple):
        if not len(prediction):
            return next((kind for kind in _LIST_KINDS if kind in possible), "accident")
        item = prediction[0]
    return _KINDS.get(type(item), "")


def sample_drawing(
    dataset: Dataset,
    sample: RowArgument,
    prediction: Any,
    *,
    task: str | None = None,
    protocol: Any = None,
) -> SampleDrawing:
    """Evaluate a sample's prediction, and let the task describe its picture.

    Args:
        dataset: The release.
        sample: Token or record of the sample.
        prediction: Prediction of a kind that the task is evaluated from; boxes may be in any frame.
        task: Name of a task of the devkit or of a plug-in; None for the one that the prediction is
            for.
        protocol: Name of a protocol of the task, or your own; None for the first one.

    Raises:
        TokenError: No such sample.
        ChoiceError: No such task or protocol, the prediction is for another task, or the object is
            not a prediction.
        NotAvailableError: The release lacks the truth that the task needs.
    """
    evaluator = _evaluator_of(prediction, task, protocol)
    token = dataset.get("sample", sample)["token"]
    form, horizon = _form_and_horizon(prediction)
    truth = evaluator.truth(dataset, token, form, horizon)
    return _describe(evaluator, dataset, token, prediction, *truth)


def described_sample(loader: SampleLoader, token: str) -> SampleDrawing:
    """Describe the picture of a sample (a token) of results."""
    return _describe(loader.setup.evaluator(), loader.dataset, token, *loader(token))


def _describe(
    evaluator: Evaluator[Any], dataset: Dataset, token: str, prediction: Any, *truth: Any
) -> SampleDrawing:
    drawing = evaluator.drawing(dataset, token, prediction, *truth)
    words = drawing.words or _number_words(evaluator, token, prediction, *truth)
    heading = human_name(evaluator.task)
    return SampleDrawing(sample=token, drawing=drawing, words=f"{heading}: {words}")


def task_drawing(dataset: Dataset, token: str, prediction: Any, task: str | None = None) -> Drawing:
    """Return what a task draws of a sample, without computing numbers.

    If the release lacks the truth that the task needs, only the prediction is drawn. Arguments and
    other errors are as for `sample_drawing`.
    """
    evaluator = _evaluator_of(prediction, task)
    form, horizon = _form_and_horizon(prediction)
    try:
        truth = evaluator.truth(dataset, token, form, horizon)
    except (NotAvailableError, MissingFileError):
        return Evaluator.drawing(evaluator, dataset, token, prediction)
    return evaluator.drawing(dataset, token, prediction, *truth)


def _evaluator_of(prediction: Any, task: str | None, protocol: Any = None) -> Evaluator[Any]:
    """Return an evaluator of a task; raise ChoiceError if the prediction is for another task."""
    name = task or prediction_kind(prediction)
    if not name:
        raise ChoiceError(
            "prediction: expected a MotionOutput, DetectedBoxes, or a list of Accidents, Plans or "
            f"Forecasts for a sample, found {type(prediction).__name__}"
        )
    evaluator_type = evaluator_class(name)
    kind = prediction_kind(prediction, evaluator_type.result_kinds)
    if kind not in evaluator_type.result_kinds:
        kinds = " or ".join(evaluator_type.result_kinds)
        raise ChoiceError(
            f"task {evaluator_type.task!r}: is evaluated from {kinds} results, found "
            f"{kind or type(prediction).__name__}; give such a prediction, or choose another task"
        )
    if protocol is None and (name, kind) == ("accident", "accident"):
        protocol = "boxes"  # the first protocol compares only motion
    return evaluator_type(protocol or next(iter(evaluator_type.protocols), ""))


def _form_and_horizon(prediction: Any) -> tuple[Form | None, float]:
    """Return how maps would be stored, None for other predictions, and seconds to look ahead."""
    if isinstance(prediction, SegmentationOutput):
        return SegmentationForm.of(prediction), RELEASED_HORIZON
    if not isinstance(prediction, MotionOutput):
        return None, RELEASED_HORIZON
    if prediction.instances is not None:
        frames = int(prediction.instances.shape[1])
    else:
        frames = len((prediction.heads or ())[-1].segmentation)
    form = MotionForm(
        stored="instances", grid=prediction.grid, predictions=len(prediction), frames=frames
    )
    return form, (frames - 1) * LABEL_STEP


def _number_words(evaluator: Evaluator[Any], token: str, prediction: Any, *truth: Any) -> str:
    """Return the main numbers of a sample in words, or some other headlines if it has none."""
    evaluator.update(token, prediction, *truth)
    main_words = []
    other_words = []
    for number in headlines(evaluator.compute([token])):
        if number.value is None or not np.isfinite(number.value):
            continue
        name, _, detail = metric_name(number.name).partition(", ")
        if detail:
            name = f"{name} ({detail})"
        words = f"{name} {value_text(number.value, number.unit)}"
        if number.path in evaluator.main_numbers:
            main_words.append(words)
        else:
            other_words.append(words)
    shown_words = main_words or other_words[:_OTHER_NUMBERS]
    return "; ".join(shown_words) or "nothing counts in this sample"
